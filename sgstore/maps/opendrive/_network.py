"""Lanes of all OpenDRIVE roads with look-ups by road, section and lane id, and the links of roads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.base.markup import number

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document, ElementTable
    from sgstore.maps.opendrive._lanes import LaneTable


START: Final = "start"
END: Final = "end"


class Target(NamedTuple):
    """Place to which an OpenDRIVE link leads: a lane section, and the end at which traffic enters."""

    section: int
    contact: str
    """``start`` or ``end`` of the section; or within it: ``+`` along s, ``-`` against s, empty for both."""


@dataclass(slots=True)
class Network:
    """Lanes of all OpenDRIVE roads, with look-ups by road, section and lane id.

    Attributes
    ----------
    roads : dict
        Id of a road → its row.
    lane : dict
        (Section, lane id) → lane.
    first, last : list of int
        First and last section of each road, or -1.
    """

    lanes: LaneTable
    roads: dict[str, int]
    lane: dict[tuple[int, int], int]
    first: list[int]
    last: list[int]
    warnings: list[str]

    @classmethod
    def of(cls, document: Document, lanes: LaneTable) -> Network:
        """Build look-ups of an OpenDRIVE map's lanes by road, lane section and lane id."""
        roads: dict[str, int] = {}
        warnings: list[str] = []
        for row, name in enumerate(document.road_ids):
            if roads.setdefault(name, row) != row:
                warnings.append(f"road {name!r}: there are two of this id; links lead to the first")
        section_road = lanes.sections.road
        every = np.arange(len(document.road_ids))
        first = np.searchsorted(section_road, every, side="left")
        last = np.searchsorted(section_road, every, side="right") - 1
        keys = zip(lanes.section.tolist(), lanes.ident.tolist(), strict=True)
        lane = {key: row for row, key in enumerate(keys)}
        return cls(lanes, roads, lane, first.tolist(), last.tolist(), warnings)

    def section_at(self, road: int, s: float) -> int:
        """Return the lane section of a road at position ``s``."""
        starts = self.lanes.sections.start[self.first[road] : self.last[road] + 1]
        within = int(np.searchsorted(starts, s, side="right")) - 1
        return self.first[road] + max(within, 0)

    def target(self, attributes: dict[str, str]) -> Target | None:
        """Return the lane section to which a road link leads; ``None`` if the road is unknown."""
        road = self.roads.get(attributes.get("elementId", ""))
        if road is None:
            return None
        if "elementS" in attributes:
            s = number(attributes["elementS"], 0.0)
            return Target(self.section_at(road, s), attributes.get("elementDir", ""))
        contact = attributes.get("contactPoint", START)
        return Target(self.first[road] if contact == START else self.last[road], contact)

    def enters(self, lane: int, contact: str) -> bool:
        """Return True if traffic can enter a lane at the given end of its lane section."""
        if self.lanes.both[lane] or not contact:
            return True
        return bool(self.lanes.forward[lane]) == (contact in {START, "+"})


def road_links(table: ElementTable) -> dict[int, dict[str, str]]:
    """Return the predecessor or successor of each road: row of the road → XML attributes of the link."""
    return dict(zip(table.parent, table.attributes, strict=True))


def junction_ends(document: Document) -> Iterator[tuple[int, str, str]]:
    """Yield each end of a road that is at a junction: row of the road, start or end, id of the junction."""
    for kind, contact in (("road/predecessor", START), ("road/successor", END)):
        for row, attributes in road_links(document[kind]).items():
            if attributes.get("elementType") == "junction":
                yield row, contact, attributes.get("elementId", "")


def whole(text: str) -> int:
    """Return an OpenDRIVE lane id as an integer; 0 (the centre lane, without traffic) if it is invalid."""
    try:
        return int(text)
    except ValueError:
        return 0
