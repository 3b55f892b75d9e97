"""Connections between OpenDRIVE lanes: successors, also through junctions.

A lane ends at one end of its section, or at both if traffic runs both ways. The lanes after it come
from links to the next section or road (also into a road, in its middle), or from the connecting
roads of a junction. A pair counts only if the next lane is entered where its own traffic enters:
maps also link lanes tail to tail. (ASAM OpenDRIVE 1.8, 10.3, 11.5 and 12.)
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.base.markup import number

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document, ElementTable
    from sgstore.maps.opendrive._lanes import LaneTable
    from sgstore.model.world import Ints


START: Final = "start"
END: Final = "end"

_OTHER: Final = {START: END, END: START}


class Target(NamedTuple):
    """End point of an OpenDRIVE link: a lane section, and where traffic enters it (start, end or within)."""

    section: int
    contact: str
    """``start``, ``end``, ``+`` or ``-`` (within, along or against s), or empty: within, in both directions."""


_Connection = tuple[Target, tuple[tuple[int, int], ...]]
"""A way through a junction: its target, and the pairs of lanes that it connects."""


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
        """Return the lane section that a road link leads to, or ``None`` for an unknown road."""
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


def flows(document: Document, network: Network) -> tuple[Ints, Ints]:
    """Return all pairs of connected OpenDRIVE lanes: traffic goes from the first to the second."""
    joints = _Joints(document, network)
    pairs = {
        (lane, beyond)
        for lane, contact in _exits(network.lanes)
        for beyond in joints.beyond(lane, contact)
    }
    pairs |= set(_branches(document, network))
    both = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def _exits(lanes: LaneTable) -> Iterator[tuple[int, str]]:
    for lane, (forward, both) in enumerate(zip(lanes.forward, lanes.both, strict=True)):
        if forward or both:
            yield lane, END
        if both or not forward:
            yield lane, START


class _Joints:
    """Look-up of the lanes that continue an OpenDRIVE lane at its start or end."""

    def __init__(self, document: Document, network: Network) -> None:
        self._network = network
        self._lane_links = {
            START: _lane_links(document["road/laneSection/lane/predecessor"], network.lanes),
            END: _lane_links(document["road/laneSection/lane/successor"], network.lanes),
        }
        self._road_links = {
            START: _road_links(document["road/predecessor"]),
            END: _road_links(document["road/successor"]),
        }
        self._junctions = _junctions(document, network)
        self._road_names = document.road_ids
        self._missed: set[str] = set()

    def beyond(self, lane: int, contact: str) -> list[int]:
        """Return the lanes that traffic may enter at one end of an OpenDRIVE lane."""
        network, lanes = self._network, self._network.lanes
        road, section, ident = (int(c[lane]) for c in (lanes.road, lanes.section, lanes.ident))
        linked = self._lane_links[contact].get(lane, [])
        if contact == END and section < network.last[road]:
            found = [(Target(section + 1, START), to) for to in linked]
        elif contact == START and section > network.first[road]:
            found = [(Target(section - 1, END), to) for to in linked]
        else:
            link = self._road_links[contact].get(road, {})
            found = self._across(road, ident, link, linked)
        onward: list[int] = []
        for target, to in found:
            other = network.lane.get((target.section, to))
            if other is None:
                self._miss(road, f"lane {ident} leads to a missing lane {to}")
            elif network.enters(other, target.contact):
                onward.append(other)
        return onward

    def _across(
        self, road: int, ident: int, link: dict[str, str], linked: list[int]
    ) -> list[tuple[Target, int]]:
        if link.get("elementType") == "junction":
            key = (link.get("elementId", ""), self._road_names[road])
            return [
                (start, to)
                for start, lanes in self._junctions.get(key, [])
                for source, to in lanes
                if source == ident
            ]
        target = self._network.target(link)
        if target is None and link:
            self._miss(road, f"leads to a missing road {link.get('elementId', '')!r}")
        return [(target, to) for to in linked] if target else []

    def _miss(self, road: int, what: str) -> None:
        warning = f"road {self._road_names[road]!r}: {what}"
        if warning not in self._missed:
            self._missed.add(warning)
            self._network.warnings.append(warning)


def _lane_links(table: ElementTable, lanes: LaneTable) -> dict[int, list[int]]:
    links: dict[int, list[int]] = defaultdict(list)
    for raw, attributes in zip(table.parent, table.attributes, strict=True):
        links[int(lanes.row[raw])].append(_whole(attributes.get("id", "")))
    return links


def _road_links(table: ElementTable) -> dict[int, dict[str, str]]:
    return dict(zip(table.parent, table.attributes, strict=True))


def _junctions(document: Document, network: Network) -> dict[tuple[str, str], list[_Connection]]:
    """Return the connections of junctions: (junction, incoming road) → list of connections."""
    ways: dict[tuple[str, str], list[_Connection]] = defaultdict(list)
    junctions = document["junction"]
    links = _lane_pairs(document)
    road_ends: dict[tuple[str, str], list[str]] = defaultdict(list)
    for road, contact, name in junction_ends(document):
        road_ends[name, document.road_ids[road]].append(contact)
    table = document["junction/connection"]
    for row, (parent, attributes) in enumerate(zip(table.parent, table.attributes, strict=True)):
        junction = junctions.attributes[parent].get("id", "")
        incoming = attributes.get("incomingRoad", "")
        direct = "linkedRoad" in attributes
        onward = attributes.get("linkedRoad" if direct else "connectingRoad", "")
        link = {"elementId": onward, "contactPoint": attributes.get("contactPoint", START)}
        target = network.target(link)
        if target is None:
            if onward:
                network.warnings.append(f"junction {junction!r} leads to a missing road {onward!r}")
            continue
        ways[junction, incoming].append((target, links[row]))
        if direct and incoming in network.roads:
            for contact in road_ends.get((junction, incoming), []):
                back = network.target({"elementId": incoming, "contactPoint": contact})
                if back is not None:
                    turned = tuple((to, source) for source, to in links[row])
                    ways[junction, onward].append((back, turned))
    return ways


def _lane_pairs(document: Document) -> dict[int, tuple[tuple[int, int], ...]]:
    pairs: dict[int, tuple[tuple[int, int], ...]] = defaultdict(tuple)
    table = document["junction/connection/laneLink"]
    for row, attributes in zip(table.parent, table.attributes, strict=True):
        pairs[row] += ((_whole(attributes.get("from", "")), _whole(attributes.get("to", ""))),)
    return pairs


def junction_ends(document: Document) -> Iterator[tuple[int, str, str]]:
    """Yield the ends of roads at junctions: row of the road, start or end, and id of the junction."""
    for kind, contact in (("road/predecessor", START), ("road/successor", END)):
        for row, attributes in _road_links(document[kind]).items():
            if attributes.get("elementType") == "junction":
                yield row, contact, attributes.get("elementId", "")


def _branches(document: Document, network: Network) -> Iterator[tuple[int, int]]:
    """Yield pairs of lanes in virtual junctions: lane of the main road, and lane that branches off."""
    links = _lane_pairs(document)
    table = document["junction/connection"]
    junctions = document["junction"].attributes
    for row, (parent, attributes) in enumerate(zip(table.parent, table.attributes, strict=True)):
        if junctions[parent].get("type") != "virtual":
            continue
        main = network.roads.get(attributes.get("incomingRoad", ""))
        onward = network.target(
            {
                "elementId": attributes.get("connectingRoad", ""),
                "contactPoint": attributes.get("contactPoint", START),
            }
        )
        if main is None or onward is None:
            continue
        junction = junctions[parent]
        kind = "road/predecessor" if onward.contact == START else "road/successor"
        road = int(network.lanes.sections.road[onward.section])
        link = _road_links(document[kind]).get(road, {})
        place = number(link.get("elementS", junction.get("sStart", "0")), 0.0)
        section = network.section_at(main, place)
        for source, to in links[row]:
            src, dst = network.lane.get((section, source)), network.lane.get((onward.section, to))
            if src is not None and dst is not None and network.enters(dst, onward.contact):
                yield src, dst


def _whole(text: str) -> int:
    """Parse an OpenDRIVE lane id; 0 (the centre lane, without traffic) for an invalid one."""
    try:
        return int(text)
    except ValueError:
        return 0
