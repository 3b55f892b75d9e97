# Names of this package, which lazy_loader imports when they are used.

from ._server import serve as serve
from ._server import server_of as server_of
from ._tools import StoreTools as StoreTools
