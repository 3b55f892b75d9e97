# The face of this package: what others may import from it.

from ._server import serve as serve
from ._server import server_of as server_of
from ._tools import StoreTools as StoreTools

__all__ = ["StoreTools", "serve", "server_of"]
