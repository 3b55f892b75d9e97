"""A store for assistants: a server of the Model Context Protocol, whose tools ask in the sandbox.

``_worker`` answers the questions in a process of its own, ``_tools`` are the tools around it, ``_text`` is how
answers read in a prompt, and ``_server`` gives all that to the protocol.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
