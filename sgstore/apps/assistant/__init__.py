"""Server that lets an AI assistant query a store, by the Model Context Protocol (MCP).

``_worker`` runs the queries in its own process. ``_tools`` has the tools, ``_vocabulary`` the texts
for prompts, and ``_server`` connects them to the protocol.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
