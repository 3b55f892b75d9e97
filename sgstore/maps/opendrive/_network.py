"""Lanes, roads and junctions as nodes, with traffic flow and lane changes.

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

from sgstore.maps.opendrive._document import last_before
from sgstore.maps.roads import (
    STOREY,
    LaneChanges,
    MapNodes,
    broad_lines,
    conflicts,
    mean_widths,
    turn_words,
    turned,
)
from sgstore.model.vocabulary import DRIVING, TRAFFIC

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.maps.opendrive._document import Document, ElementTable
    from sgstore.maps.opendrive._lanes import LaneTable
    from sgstore.maps.roads import Edge, MapPlaces, Ribbons
    from sgstore.model.world import Bools, Floats, Ints


START: Final = "start"
END: Final = "end"

_OTHER: Final = {START: END, END: START}


class Target(NamedTuple):
    """Place where traffic enters a section: at its start, at its end, or within."""

    section: int
    contact: str
    """``start``, ``end``, ``+`` or ``-`` (within, along or against s), or empty: within, in both directions."""


_Connection = tuple[Target, tuple[tuple[int, int], ...]]
"""A way through a junction: its target, and the pairs of lanes that it connects."""


@dataclass(slots=True)
class Network:
    """Lanes of all roads, with look-ups by the ids of the map.

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
        """Build the network of a document's lanes."""
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
        """Return the section of a road at ``s``."""
        starts = self.lanes.sections.start[self.first[road] : self.last[road] + 1]
        within = int(np.searchsorted(starts, s, side="right")) - 1
        return self.first[road] + max(within, 0)

    def target(self, attributes: dict[str, str]) -> Target | None:
        """Return the section that a link between roads leads to, or ``None`` for an unknown road."""
        road = self.roads.get(attributes.get("elementId", ""))
        if road is None:
            return None
        if "elementS" in attributes:
            s = _number(attributes["elementS"])
            return Target(self.section_at(road, s), attributes.get("elementDir", ""))
        contact = attributes.get("contactPoint", START)
        return Target(self.first[road] if contact == START else self.last[road], contact)

    def enters(self, lane: int, contact: str) -> bool:
        """True if traffic at the end ``contact`` of a section may enter this lane."""
        if self.lanes.both[lane] or not contact:
            return True
        return bool(self.lanes.forward[lane]) == (contact in {START, "+"})


def flows(document: Document, network: Network) -> tuple[Ints, Ints]:
    """Return all pairs of lanes (from, to) with traffic flow, each once."""
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
    """Look-up of the lanes after the ends of lanes."""

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
        """Return the lanes after one end of a lane that its traffic may enter."""
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
    """Map (junction, incoming road) to its connections; a direct junction connects both ways."""
    ways: dict[tuple[str, str], list[_Connection]] = defaultdict(list)
    junctions = document["junction"]
    links = _lane_pairs(document)
    road_ends = _junction_ends(document)
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


def _junction_ends(document: Document) -> dict[tuple[str, str], list[str]]:
    """Map (junction, road) to the ends of the road at the junction."""
    ends: dict[tuple[str, str], list[str]] = defaultdict(list)
    for kind, contact in (("road/predecessor", START), ("road/successor", END)):
        for row, attributes in _road_links(document[kind]).items():
            if attributes.get("elementType") == "junction":
                key = (attributes.get("elementId", ""), document.road_ids[row])
                ends[key].append(contact)
    return ends


def _branches(document: Document, network: Network) -> Iterator[tuple[int, int]]:
    """Yield pairs of a main road's lane and a lane that branches off in a virtual junction."""
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
        place = _number(link.get("elementS", junction.get("sStart", "0")))
        section = network.section_at(main, place)
        for source, to in links[row]:
            src, dst = network.lane.get((section, source)), network.lane.get((onward.section, to))
            if src is not None and dst is not None and network.enters(dst, onward.contact):
                yield src, dst


def _whole(text: str) -> int:
    """Parse a lane id; 0 (never a lane with traffic) for an invalid one."""
    try:
        return int(text)
    except ValueError:
        return 0


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


# Lanes, roads and junctions as nodes with relations, and lane changes from road marks -----------

NARROW: Final = 1e-2
"""A lane that is nowhere wider has no neighbours: the lanes on both sides are neighbours; m."""

SPEED_UNITS: Final = {"": 1.0, "m/s": 1.0, "mph": 0.44704, "km/h": 1 / 3.6, "kmh": 1 / 3.6}
"""Units of speed → m/s. (ASAM OpenDRIVE 1.8, ``e_unitSpeed``.)"""

FIRST_LANE: Final = 1
"""Row of the first lane: row 0 is ``off_road``."""


def lane_nodes(document: Document, lanes: LaneTable, ribbons: Ribbons) -> MapNodes:
    """Return the nodes of the lanes, in their order."""
    road_names = document.road_ids
    sections = lanes.sections
    number = sections.number[lanes.section]
    roads = [road_names[r] for r in lanes.road.tolist()]
    names = [
        f"{road}/{section}/{ident}"
        for road, section, ident in zip(roads, number.tolist(), lanes.ident.tolist(), strict=True)
    ]
    length = ribbons.lengths
    middle = ribbons.at(np.arange(len(lanes)), length / 2)
    return MapNodes.of(
        "lane",
        names,
        x=middle.x,
        y=middle.y,
        z=middle.z,
        heading=middle.heading,
        lane_type=tuple(lanes.type),
        road=tuple(roads),
        junction=tuple(junction_of(document, road) for road in lanes.road.tolist()),
        turn=_turns(document, lanes, ribbons),
        section=number,
        lane=lanes.ident,
        length=length,
        width=mean_widths(ribbons),
        speed_limit=_speed_limits(document, lanes),
    )


def junction_of(document: Document, road: int) -> str:
    """Return the id of the junction of a road, or an empty text."""
    junction = document["road"].attributes[road].get("junction", "-1")
    return "" if junction == "-1" else junction


def _turns(document: Document, lanes: LaneTable, ribbons: Ribbons) -> tuple[str, ...]:
    """Return turns of lanes in junctions; a road with several sections has one turn in total."""
    sign = np.where(lanes.forward, 1.0, -1.0)
    _, one = np.unique(lanes.section, return_index=True)
    of_road = np.zeros(len(document["road"]))
    np.add.at(of_road, lanes.road[one], (turned(ribbons) * sign)[one])
    turn = of_road[lanes.road] * sign
    return tuple(
        word if junction_of(document, road) else ""
        for word, road in zip(turn_words(turn), lanes.road.tolist(), strict=True)
    )


def _speed_limits(document: Document, lanes: LaneTable) -> Floats:
    """Return speed limits at the middle of lanes: own record, else the road's; m/s."""
    sections = lanes.sections
    start, end = sections.start[lanes.section], sections.end[lanes.section]
    middle = (start + end) / 2
    kind = "road/laneSection/lane/speed"
    record = last_before(
        lanes.row[document[kind].of],
        document.numbers(kind, "sOffset", 0.0),
        np.arange(len(lanes)),
        middle - start,
    )
    own = np.append(_speeds(document, kind), np.nan)[record]
    of_type = document["road/type"]
    kind = "road/type/speed"
    limit = np.full(len(of_type) + 1, np.nan)
    limit[document[kind].of] = _speeds(document, kind)
    at = document.numbers("road/type", "s", 0.0)
    of_road = limit[last_before(of_type.road, at, lanes.road, middle)]
    return np.where(np.isnan(own), of_road, own)


def _speeds(document: Document, kind: str) -> Floats:
    table = document[kind]
    texts = zip(table.texts("max"), table.texts("unit"), strict=True)
    return np.array([speed(value, unit) for value, unit in texts], np.float64)


def speed(value: str, unit: str) -> float:
    """Convert a speed to m/s; NaN for ``no limit``, ``undefined`` and invalid values."""
    try:
        metres = float(value) * SPEED_UNITS[unit.strip().lower()]
    except (ValueError, KeyError):
        return np.nan
    return metres if 0 < metres < 1000 else np.nan


def wide_pairs(lanes: LaneTable, ribbons: Ribbons) -> Ints:
    """Return pairs of lanes that share a border, the left one first, (2, n)."""
    return _pairs(lanes, np.flatnonzero(mean_widths(ribbons) > NARROW))


def neighbours(lanes: LaneTable, ribbons: Ribbons) -> list[Edge]:
    """Return the edges ``toLeftOf``, ``toRightOf`` and ``opposes`` among lanes.

    Neighbours share a border. Lanes of traffic with only lanes without traffic between them (a
    median, a strip of grass) are also neighbours, because drivers look across it.
    """
    wide = np.flatnonzero(mean_widths(ribbons) > NARROW)
    traffic = _pairs(lanes, wide[[lanes.type[lane] in TRAFFIC for lane in wide.tolist()]])
    forward, both = lanes.forward, lanes.both
    left, right = np.concatenate((wide_pairs(lanes, ribbons), traffic), axis=1)
    from_left, from_right = forward[left], forward[right]
    against = (forward[traffic[0]] != forward[traffic[1]]) | both[traffic].any(axis=0)
    opposing = traffic[:, against] + FIRST_LANE
    left, right = left + FIRST_LANE, right + FIRST_LANE
    return [
        ("toRightOf", right[from_left], left[from_left]),
        ("toLeftOf", right[~from_left], left[~from_left]),
        ("toLeftOf", left[from_right], right[from_right]),
        ("toRightOf", left[~from_right], right[~from_right]),
        ("opposes", np.concatenate(opposing), np.concatenate(opposing[::-1])),
    ]


def _pairs(lanes: LaneTable, rows: Ints) -> Ints:
    """Return pairs of consecutive lanes of a section among ``rows``, from left to right, (2, n)."""
    same: Bools = np.diff(lanes.section[rows]) == 0
    return np.stack((rows[:-1][same], rows[1:][same]))


def flow_edges(
    lanes: LaneTable, nodes: MapNodes, ribbons: Ribbons, flow: tuple[Ints, Ints]
) -> list[Edge]:
    """Return the edges ``travelsTo`` and ``conflictsWith`` among lanes; ``nodes`` are their nodes."""
    crossing = [
        lane
        for lane, (kind, junction) in enumerate(zip(lanes.type, nodes.junction, strict=True))
        if junction and kind in DRIVING
    ]
    one, other = conflicts(ribbons, np.array(crossing, np.int64), nodes.junction, flow, STOREY)
    both = np.concatenate((one, other)), np.concatenate((other, one))
    return [
        ("travelsTo", flow[0] + FIRST_LANE, flow[1] + FIRST_LANE),
        ("conflictsWith", both[0] + FIRST_LANE, both[1] + FIRST_LANE),
    ]


def road_nodes(document: Document) -> list[MapNodes]:
    """Return the nodes of roads, junctions and roundabouts."""
    every = range(len(document["road"]))
    road = MapNodes.of(
        "road",
        document.road_ids,
        length=document.numbers("road", "length"),
        road=tuple(document.road_ids),
        junction=tuple(junction_of(document, row) for row in every),
    )
    names = document["junction"].texts("id")
    junction = MapNodes.of("junction", names, junction=tuple(names))
    return [road, junction, MapNodes.of("roundabout", [*_roundabouts(document)])]


def _roundabouts(document: Document) -> dict[str, set[str]]:
    """Return roundabouts with their junctions: junction groups of that type (ASAM OpenDRIVE 1.8, 12.14)."""
    groups, members = document["junctionGroup"], document["junctionGroup/junctionReference"]
    names, found = groups.texts("id"), dict[str, set[str]]()
    kinds = groups.texts("type")
    for group, junction in zip(members.parent, members.texts("junction"), strict=True):
        if kinds[group].strip() == "roundabout":
            found.setdefault(names[group], set()).add(junction)
    return found


def _in_roundabouts(document: Document) -> Iterator[tuple[int, int]]:
    """Yield pairs of a road and its roundabout, as rows."""
    ends: list[list[str]] = [[] for _ in range(len(document["road"]))]
    for kind in ("road/predecessor", "road/successor"):
        table = document[kind]
        for road, link in zip(table.parent, table.attributes, strict=True):
            if link.get("elementType") == "junction":
                ends[road].append(link.get("elementId", ""))
    for row, junctions in enumerate(_roundabouts(document).values()):
        for road, at in enumerate(ends):
            between = len(at) == 2 and junctions.issuperset(at)
            if between or junction_of(document, road) in junctions:
                yield road, row


def road_types(document: Document) -> dict[str, tuple[tuple[float, str], ...]]:
    """Map each road with a type to the start of each type along it."""
    table = document["road/type"]
    found: dict[str, list[tuple[float, str]]] = {}
    places = document.rough_numbers("road/type", "s").tolist()
    for road, s, name in zip(table.road.tolist(), places, table.texts("type"), strict=True):
        found.setdefault(document.road_ids[road], []).append((s, name))
    return {road: tuple(sorted(types)) for road, types in found.items()}


def junction_types(document: Document) -> dict[str, str]:
    """Map each junction to its type; by default ``default`` (ASAM OpenDRIVE 1.8, 12)."""
    table = document["junction"]
    pairs = zip(table.texts("id"), table.texts("type", "default"), strict=True)
    return {name: kind.strip() or "default" for name, kind in pairs}


def containment(document: Document, road: Ints) -> list[Edge]:
    """Return the edges ``isIn``: lanes in roads, roads in junctions and roundabouts.

    ``road``: rows of the roads of all lanes.
    """
    first_road = FIRST_LANE + len(road)
    first_junction = first_road + len(document["road"])
    junctions: dict[str, int] = {}
    for row, name in enumerate(document["junction"].texts("id")):
        junctions.setdefault(name, row)
    pairs = [
        (row, junctions[name])
        for row in range(len(document["road"]))
        if (name := junction_of(document, row)) in junctions
    ]
    roads, within = np.array(pairs, np.int64).reshape(-1, 2).T
    round_roads, around = np.array([*_in_roundabouts(document)], np.int64).reshape(-1, 2).T
    every = np.arange(len(road))
    return [
        ("isIn", FIRST_LANE + every, first_road + road),
        ("isIn", first_road + roads, first_junction + within),
        ("isIn", first_road + round_roads, first_junction + len(document["junction"]) + around),
    ]


# Road marks → where traffic may change lanes ----------------------------------------------------
# The mark of a lane is on its outer border; the mark of the centre lane is on the line between left
# and right. The attribute ``laneChange`` decides. Without it the type of the mark decides: broken
# lines may be crossed, and for a double line the one on one's own side counts. A border without a
# mark allows changes. (ASAM OpenDRIVE 1.8, 11.9.)

_ATTRIBUTE: Final = {
    "both": (True, True),
    "none": (False, False),
    "increase": (True, False),
    "decrease": (False, True),
}
"""``laneChange`` → permission to change towards higher ids (to the left along s), and towards lower ids."""

_CROSSED: Final = frozenset({"none", "broken", "broken broken", "botts dots"})
"""Types of marks that may be crossed from both sides."""


def permitted(kind: str, attribute: str, owner: int) -> tuple[bool, bool]:
    """Return the lane changes that a mark permits: towards higher and towards lower lane ids.

    Parameters
    ----------
    kind, attribute : str
        ``type`` and ``laneChange`` of the mark.
    owner : int
        Id of the lane with the mark. Double lines are named from the inside out, those of the
        centre lane from left to right.
    """
    if attribute in _ATTRIBUTE:
        return _ATTRIBUTE[attribute]
    if kind in _CROSSED:
        return True, True
    if kind not in {"solid broken", "broken solid"}:
        return False, False
    # To the right of the centre, inside is to the left. Crossing is allowed from the side with the
    # broken line.
    left_is_broken = (kind == "broken solid") == (owner <= 0)
    return not left_is_broken, left_is_broken


_Stretch = tuple[float, float, bool, bool]
"""Part of a border: start and end, and the permission to change to the left and to the right."""


def read_lane_changes(document: Document, lanes: LaneTable, ribbons: Ribbons) -> LaneChanges:
    """Return stretches for lane changes: neighbouring driving lanes with traffic in one direction."""
    left, right = wide_pairs(lanes, ribbons)
    driving = np.array([kind in DRIVING for kind in lanes.type], bool)
    one_way = lanes.forward[left] == lanes.forward[right]
    one_way |= lanes.both[left] | lanes.both[right]
    kept = driving[left] & driving[right] & one_way
    left, right = left[kept], right[kept]
    marks = _marks(document, lanes)
    rows: list[tuple[int, int, float, float]] = []
    for a, b in zip(left.tolist(), right.tolist(), strict=True):
        for start, end, to_left, to_right in marks(a, b):
            rows += [(b, a, start, end)] * to_left + [(a, b, start, end)] * to_right
    table = np.array(rows, np.float64).reshape(-1, 4)
    lane, to = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    return _along(ribbons, lane, to, table[:, 2:])


def _marks(document: Document, lanes: LaneTable) -> Callable[[int, int], list[_Stretch]]:
    """Return a function from two neighbouring lanes to the stretches of their common border."""
    kind = "road/laneSection/lane/roadMark"
    table = document[kind]
    offsets = document.rough_numbers(kind, "sOffset").tolist()
    columns = table.parent, offsets, table.texts("type", "none"), table.texts("laneChange")
    records: dict[int, list[tuple[float, str, str]]] = {}
    for raw, offset, mark, attribute in zip(*columns, strict=True):
        if np.isfinite(offset):
            record = (offset, mark.strip().lower(), attribute.strip().lower())
            records.setdefault(raw, []).append(record)
    of_lane = {int(lanes.row[raw]): marks for raw, marks in records.items()}
    centres = {raw: int(lanes.centre[raw]) for raw in records}
    of_centre = {centre: records[raw] for raw, centre in centres.items() if centre >= 0}

    def between(left: int, right: int) -> list[_Stretch]:
        section = int(lanes.section[left])
        idents = int(lanes.ident[left]), int(lanes.ident[right])
        owner = right if idents[1] > 0 else left
        if idents[0] > 0 > idents[1]:
            found, ident = of_centre.get(section, []), 0
        else:
            found, ident = of_lane.get(owner, []), int(lanes.ident[owner])
        start, end = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        found = sorted([(-np.inf, "none", ""), *found], key=lambda record: record[0])
        cuts = [min(max(start + offset, start), end) for offset, _, _ in found] + [end]
        return [
            (cuts[i], cuts[i + 1], *permitted(kind, attribute, ident))
            for i, (_, kind, attribute) in enumerate(found)
            if cuts[i + 1] > cuts[i]
        ]

    return between


def read_broad_lines(document: Document, lanes: LaneTable, ribbons: Ribbons) -> MapPlaces:
    """Return ``bold`` markings: at the outer border of one lane, at the inner border of the next."""
    kind = "road/laneSection/lane/roadMark"
    table, offsets = document[kind], document.rough_numbers(kind, "sOffset").tolist()
    columns = table.parent, offsets, table.texts("type", "none"), table.texts("weight")
    records: dict[int, list[tuple[float, bool]]] = {}
    for raw, offset, mark, weight in zip(*columns, strict=True):
        if np.isfinite(offset):
            bold = weight.strip().lower() == "bold" and mark.strip().lower() != "none"
            records.setdefault(int(raw), []).append((offset, bold))
    names = zip(lanes.section.tolist(), lanes.ident.tolist(), strict=True)
    row_of = {name: row for row, name in enumerate(names)}
    rows: list[tuple[int, bool, float, float]] = []
    for raw, marks in records.items():
        own, centre = int(lanes.row[raw]), int(lanes.centre[raw])
        section = centre if own < 0 else int(lanes.section[own])
        ident = 0 if own < 0 else int(lanes.ident[own])
        outer = (1, -1) if ident == 0 else (ident + (1 if ident > 0 else -1),)
        beside = [(own, False)] * (own >= 0)
        beside += [(row_of[section, one], True) for one in outer if (section, one) in row_of]
        start, end = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        cuts = [min(max(start + offset, start), end) for offset, _ in sorted(marks)] + [end]
        for (_, bold), first, last in zip(sorted(marks), cuts, cuts[1:], strict=False):
            for row, inner in beside if bold and last > first else ():
                # Inside is left for a lane on the right of its road's direction.
                left = inner == ((lanes.ident[row] < 0) == lanes.forward[row])
                rows.append((row, bool(left), first, last))
    lane = np.array([row[0] for row in rows], np.int64)
    ends = np.sort(
        [ribbons.along_at(lane, np.array([row[i] for row in rows], np.float64)) for i in (2, 3)],
        axis=0,
    )
    return broad_lines(
        [(row[0], row[1], *along) for row, along in zip(rows, ends.T.tolist(), strict=True)]
    )


def _along(ribbons: Ribbons, lane: Ints, to: Ints, ends: Floats) -> LaneChanges:
    """Convert stretches from s to lengths of the centre line, and join consecutive ones."""
    one, other = ribbons.along_at(lane, ends[:, 0]), ribbons.along_at(lane, ends[:, 1])
    start, end = np.minimum(one, other), np.maximum(one, other)
    order = np.lexsort((start, to, lane))
    lane, to, start, end = lane[order], to[order], start[order], end[order]
    follows = (np.diff(lane) == 0) & (np.diff(to) == 0) & (np.abs(start[1:] - end[:-1]) < 1e-6)
    begins = np.concatenate((np.ones(min(len(lane), 1), bool), ~follows))
    ends_here = np.concatenate((~follows, np.ones(min(len(lane), 1), bool)))
    return LaneChanges(lane[begins], to[begins], start[begins], end[ends_here])
