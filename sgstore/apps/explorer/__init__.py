"""Explorer: a local web page that shows the contents of a store and the matches of queries.

A server in this process serves the page. A pool of sandboxes runs the queries of users. This
process reads states, pictures and graphs by trace and frame.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
