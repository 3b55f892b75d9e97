# The public API: what people import from ``sgstore``; loaded when it is used.

from .collection import Collection as Collection
from .collection import open as open
from .model.config import Config as Config
from .errors import AbstractionError as AbstractionError
from .errors import ConfigError as ConfigError
from .errors import ExportError as ExportError
from .errors import MapError as MapError
from .errors import MissingExtraError as MissingExtraError
from .errors import QueryError as QueryError
from .errors import SgstoreError as SgstoreError
from .errors import SqlError as SqlError
from .errors import StoreError as StoreError
from .errors import TraceError as TraceError
from .model.graph import SceneGraph as SceneGraph
from .lang.syntax import Pattern as Pattern
from .maps.map_files import read_map_file as read_map_file
from .matches import Interval as Interval
from .matches import Matches as Matches
from .query import ClipAnimation as ClipAnimation
from .query import Store as Store
from .query import StoreFrame as StoreFrame
from .sgg import SceneGraphGenerator as SceneGraphGenerator
from .graphs.online import Frame as Frame
from .store import FrameRef as FrameRef
from .store import duckdb as duckdb
from .store import Rows as Rows
from .temporal import CheckRun as CheckRun
from .temporal import Monitor as Monitor
from .temporal import Verdict as Verdict
from .model.world import Clip as Clip

__version__: str

def load_ipython_extension(ipython: object) -> None: ...

__all__ = [
    "AbstractionError",
    "CheckRun",
    "Clip",
    "ClipAnimation",
    "Collection",
    "Config",
    "ConfigError",
    "ExportError",
    "Frame",
    "FrameRef",
    "Interval",
    "MapError",
    "Matches",
    "MissingExtraError",
    "Monitor",
    "Pattern",
    "QueryError",
    "Rows",
    "SceneGraph",
    "SceneGraphGenerator",
    "SgstoreError",
    "SqlError",
    "Store",
    "StoreError",
    "StoreFrame",
    "TraceError",
    "Verdict",
    "open",
    "read_map_file",
    "duckdb",
]
