# The face of this package: what others may import from it.

from ._contact import contacts as contacts
from ._contact import contacts_of as contacts_of
from ._extent import Areas as Areas
from ._extent import EgoPoses as EgoPoses
from ._extent import Extent as Extent
from ._registry import Keeping as Keeping
from ._registry import renamed as renamed
from ._hitches import Hitches as Hitches
from ._following import Parking as Parking
from ._following import gaps as gaps
from ._map_context import LaneContact as LaneContact
from ._pairs import NEAR as NEAR
from ._pairs import TOUCHING as TOUCHING
from ._pairs import Crowds as Crowds
from ._pairs import StillPairs as StillPairs
from ._pairs import gathered as gathered
from ._pairs import joined_pairs as joined_pairs
from ._pairs import near_pairs as near_pairs
from ._pairs import of_kinds as of_kinds
from ._pairs import pieces as pieces
from ._pairs import related_pairs as related_pairs
from ._registry import as_markdown as as_markdown
from ._registry import relations as relations
from ._registry import relations_under as relations_under
from ._scene import IS_SIGNAL as IS_SIGNAL
from ._scene import IS_UPRIGHT as IS_UPRIGHT
from ._scene import IS_USER as IS_USER
from ._scene import BlockScene as BlockScene
from ._scene import Bodies as Bodies
from ._scene import BodyPairs as BodyPairs
from ._scene import EdgeRoom as EdgeRoom
from ._scene import MapContext as MapContext
from ._scene import Relation as Relation
from ._scene import Standing as Standing
from ._scene import edges_between as edges_between
from ._scene import edges_to_map as edges_to_map
from ._map_context import waypoints_of as waypoints_of

__all__ = [
    "Areas",
    "BlockScene",
    "Bodies",
    "BodyPairs",
    "Crowds",
    "EdgeRoom",
    "EgoPoses",
    "Extent",
    "Hitches",
    "IS_SIGNAL",
    "IS_UPRIGHT",
    "IS_USER",
    "Keeping",
    "LaneContact",
    "MapContext",
    "NEAR",
    "Parking",
    "Relation",
    "Standing",
    "StillPairs",
    "TOUCHING",
    "as_markdown",
    "contacts",
    "contacts_of",
    "edges_between",
    "edges_to_map",
    "gaps",
    "gathered",
    "joined_pairs",
    "near_pairs",
    "of_kinds",
    "pieces",
    "related_pairs",
    "relations",
    "relations_under",
    "renamed",
    "waypoints_of",
]
