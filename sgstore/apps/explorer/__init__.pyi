# Names of this package, which lazy_loader imports when they are used.

from ._app import Explorer as Explorer
from ._app import application as application
from ._live import LiveRun as LiveRun
from ._live import live_application as live_application
from ._serve import serve as serve
from ._serve import serve_live as serve_live
from ._store_reader import Reads as Reads
from ._wire import PAGE as PAGE
from ._wire import as_json as as_json
from ._wire import packed as packed
from ._worker import answer as answer
