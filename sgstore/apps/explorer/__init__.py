"""Explorer: a local web page that shows the contents of a store and the matches of queries.

A server in this process serves the page. A pool of sandboxes runs the queries of users. This
process reads states, pictures and graphs by trace and frame.
"""

from sgstore.apps.explorer._app import Explorer, application
from sgstore.apps.explorer._live import LiveRun, live_application
from sgstore.apps.explorer._serve import serve, serve_live
from sgstore.apps.explorer._store_reader import Reads
from sgstore.apps.explorer._wire import PAGE, as_json, packed
from sgstore.apps.explorer._worker import answer

__all__ = [
    "PAGE",
    "Explorer",
    "LiveRun",
    "Reads",
    "answer",
    "application",
    "as_json",
    "live_application",
    "packed",
    "serve",
    "serve_live",
]
