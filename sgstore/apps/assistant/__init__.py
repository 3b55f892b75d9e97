"""Server of the Model Context Protocol for a store; its tools run queries in a sandbox.

``_worker`` runs the queries in its own process. ``_tools`` has the tools, ``_vocabulary`` the texts
for prompts, and ``_server`` connects them to the protocol.
"""

from sgstore.apps.assistant._server import serve, server_of
from sgstore.apps.assistant._tools import StoreTools

__all__ = [
    "StoreTools",
    "serve",
    "server_of",
]
