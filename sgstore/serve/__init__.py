"""The explorer: a page on one's own machine that shows what a store holds and what a query finds.

A server of this process answers the page. What somebody typed is answered by a pool of sandboxes; what the page
reads by trace and frame (states, pictures, graphs) is read here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
