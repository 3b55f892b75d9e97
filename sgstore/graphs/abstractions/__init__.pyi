# The face of this package: what others may import from it.

from ._classes import Classes as Classes
from ._classes import classes_of as classes_of
from ._classes import contents_of as contents_of
from ._columns import GraphColumns as GraphColumns
from ._columns import Labelled as Labelled
from ._columns import MapColumns as MapColumns
from ._columns import found as found
from ._features import GraphFeatures as GraphFeatures
from ._features import of_frames as of_frames
from ._features import without as without
from ._columns import lane_roles as lane_roles
from ._subsets import SUBSETS as SUBSETS
from ._subsets import Subset as Subset
from ._registry import ABSTRACTIONS as ABSTRACTIONS
from ._registry import AT_INGEST as AT_INGEST
from ._registry import Abstraction as Abstraction
from ._registry import abstraction_named as abstraction_named
from ._registry import abstractions as abstractions
from ._registry import check_name as check_name
from ._registry import register as register

__all__ = [
    "ABSTRACTIONS",
    "AT_INGEST",
    "Abstraction",
    "Classes",
    "GraphColumns",
    "GraphFeatures",
    "Labelled",
    "MapColumns",
    "SUBSETS",
    "Subset",
    "abstraction_named",
    "abstractions",
    "check_name",
    "classes_of",
    "contents_of",
    "found",
    "lane_roles",
    "of_frames",
    "register",
    "without",
]
