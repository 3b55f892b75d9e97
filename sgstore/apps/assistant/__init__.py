"""Server of the Model Context Protocol for a store; its tools run queries in a sandbox.

``_worker`` runs the queries in its own process. ``_tools`` has the tools, ``_vocabulary`` the texts
for prompts, and ``_server`` connects them to the protocol.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
