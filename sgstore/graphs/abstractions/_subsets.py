"""Abstractions that only remove nodes and edges of the scene graph. Queries need no new tables for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Mapping


SCENERY: Final = ("building", "pole", "barrier", "vegetation")
"""Kinds of scenery entities. Only the abstraction ``SG`` keeps them."""

BETWEEN_ENTITIES: Final = (*PROXIMITY, *DIRECTIONS, "toLeftOf", "toRightOf")
"""Relations between entities that the abstractions of the literature use."""

OF_JUNCTION: Final = (
    *BETWEEN_ENTITIES,
    *("isIn", "travelsTo", "laneChange", "opposes", "controlsTrafficOf", "mayAffect"),
)


@dataclass(frozen=True, slots=True)
class Subset:
    """Node kinds and relations that an abstraction keeps from the scene graph.

    Attributes
    ----------
    parts : frozenset of str or None
        Kinds of map parts among its nodes, in addition to traffic; ``None`` means all kinds and
        relations.
    moving : frozenset of str
        Relations of entities, to one another and to parts of the map.
    lasting : frozenset of str
        Relations among parts of the map.
    """

    parts: frozenset[str] | None
    moving: frozenset[str] = frozenset()
    lasting: frozenset[str] = frozenset()

    @property
    def kinds(self) -> frozenset[str] | None:
        """Node kinds that the abstraction keeps; ``None`` if it keeps all."""
        return None if self.parts is None else (entity_kinds() - {*SCENERY}) | self.parts


_LANES: Final = frozenset({"lane", "off_road"})
_RELATED: Final = frozenset(BETWEEN_ENTITIES)
_PARTS: Final = frozenset({*_LANES, "road", "junction"})

SUBSETS: Final[Mapping[str, Subset]] = {
    "E": Subset(frozenset()),
    "EL": Subset(_LANES, frozenset({"isIn"})),
    "ER": Subset(frozenset(), _RELATED),
    "RSV": Subset(_LANES, _RELATED | {"isIn"}),
    "junction": Subset(_PARTS, frozenset(OF_JUNCTION), frozenset(OF_JUNCTION)),
    "SG": Subset(None),
}
"""Abstraction → part of the scene graph that it keeps. In queries, lanes keep their own names."""
