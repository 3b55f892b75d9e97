"""Relations (edge types) of scene graphs, each computed by an array function over many frames.

A relation has one file in this package and one line in :mod:`sgstore.base.plugins`, or one file in
another package and one entry point. The registration adds it to the vocabulary, the generator, the
table of ``docs/relations.md``, pictures, and the law tests: no self edges; symmetric relations are
symmetric; moving or turning the world does not change the result, nor does computing it frame by
frame.
"""

from sgstore.graphs.relations._contact import contacts, contacts_of
from sgstore.graphs.relations._crowds import NEAR, TOUCHING, Crowds, pieces
from sgstore.graphs.relations._driven_lanes import DrivenLanes
from sgstore.graphs.relations._extent import Areas, EgoPoses, Extent
from sgstore.graphs.relations._following import gaps
from sgstore.graphs.relations._graph_filter import Keeping, renamed
from sgstore.graphs.relations._hitches import Hitches
from sgstore.graphs.relations._map_context import LaneContact
from sgstore.graphs.relations._pairs import (
    StillPairs,
    gathered,
    joined_pairs,
    near_pairs,
    of_kinds,
    related_pairs,
)
from sgstore.graphs.relations._parking import Parking
from sgstore.graphs.relations._registry import as_markdown, relations, relations_under
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    IS_UPRIGHT,
    IS_USER,
    BlockScene,
    Bodies,
    BodyPairs,
    EdgeRoom,
    MapContext,
    Relation,
    Standing,
    edges_between,
    edges_to_map,
)
from sgstore.graphs.relations._waypoints import waypoints_of

__all__ = [
    "IS_SIGNAL",
    "IS_UPRIGHT",
    "IS_USER",
    "NEAR",
    "TOUCHING",
    "Areas",
    "BlockScene",
    "Bodies",
    "BodyPairs",
    "Crowds",
    "DrivenLanes",
    "EdgeRoom",
    "EgoPoses",
    "Extent",
    "Hitches",
    "Keeping",
    "LaneContact",
    "MapContext",
    "Parking",
    "Relation",
    "Standing",
    "StillPairs",
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
