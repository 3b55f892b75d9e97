"""Reader of SUMO networks (``.net.xml``). It converts them to the lane text format of sgstore.

A lane is a line with a width; lane 0 of an edge is its rightmost. Lanes inside a junction
(``:J0_1_0``) are lanes of that junction. Crossings become crosswalks; walking areas are skipped.
The links of a traffic light apply to the lanes through the junction. Links with the same state in
all phases are one signal. Its name is the name of the traffic light, and with several signals also
the number of its first link (``J/3``). Coordinates are those of the network, as in all outputs of
SUMO.

Source: SUMO documentation, "SUMO Road Networks" (Eclipse, EPL-2.0).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.markup import MAX_MAP_ELEMENTS, MarkupParser, number, read_markup
from sgstore.errors import MapError
from sgstore.maps.roads import (
    MAX_LANES,
    MAX_NAME,
    MAX_POINTS,
    Border,
    Joint,
    LaneLine,
    PlainCrosswalk,
    PlainSignal,
    Sections,
    about_lanes,
    lane_text,
    plain_lanes,
    run_of,
    thinned,
)

if TYPE_CHECKING:
    from sgstore.model.world import Floats

WIDTH: Final = 3.2
"""Default width of a lane in SUMO; m."""
CROSSING_WIDTH: Final = 4.0
"""Default width of a crossing in SUMO; m."""
_LANE_TYPES: Final = (
    ({"pedestrian", "wheelchair"}, "sidewalk"),
    ({"bicycle", "scooter"}, "biking"),
    ({"tram"}, "tram"),
    ({"rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"}, "rail"),
    ({"bus", "coach", "taxi", "emergency", "authority"}, "bus"),
)
"""Vehicle classes → lane type for lanes on which only these and all previous classes are permitted."""
_HEAD: Final = 1 << 16
"""Number of characters at the start of a text that are checked to recognise a SUMO network."""
_ODD_LENGTH: Final = 5.0
_ODD_SHARE: Final = 0.2
"""Difference between a lane's length and its shape that counts as a contradiction: m, and share."""
_MAX_GAP: Final = 1.0
"""Largest gap between neighbouring lanes, beyond their widths; m."""


@dataclass(slots=True)
class _SumoEdge:
    ident: str
    function: str
    source: str
    target: str
    lanes: list[dict[str, str]] = field(default_factory=list[dict[str, str]])


@dataclass(slots=True)
class _SumoNet:
    """Contents of a SUMO network file: edges, connections, traffic light phases."""

    edges: list[_SumoEdge] = field(default_factory=list[_SumoEdge])
    connections: list[dict[str, str]] = field(default_factory=list[dict[str, str]])
    phases: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Traffic light → states of its links in all phases of all programs."""
    roundabouts: list[dict[str, str]] = field(default_factory=list[dict[str, str]])
    beside: dict[str, str] = field(default_factory=dict[str, str])
    """Lane → its left neighbour, which has the opposite direction."""
    logic: str = ""
    """Id of the traffic light whose phases are being read."""

    def start(self, tag: str, attributes: dict[str, str], depth: int) -> None:
        """Handle the start tag of an XML element."""
        if depth == 1 and tag != "net":
            raise MapError(f"the root element is <{tag[:80]}>, expected <net>")
        match depth, tag:
            case 2, "edge":
                names = (attributes.get(key, "") for key in ("id", "function", "from", "to"))
                ident, function, source, target = names
                self.edges.append(_SumoEdge(ident, function, source, target))
            case 2, "connection":
                self.connections.append(attributes)
            case 2, "roundabout":
                self.roundabouts.append(attributes)
            case 2, "tlLogic":
                self.logic = attributes.get("id", "")
            case 3, "phase":
                self.phases.setdefault(self.logic, []).append(attributes.get("state", ""))
            case 3, "lane" if self.edges:
                self.edges[-1].lanes.append(attributes)
            case 4, "neigh" if self.edges and self.edges[-1].lanes:
                self.beside[self.edges[-1].lanes[-1].get("id", "")] = attributes.get("lane", "")
            case _:
                pass


def is_sumo_net(text: str) -> bool:
    """Return True if a text is a SUMO network, by its first XML elements."""
    start = text[:_HEAD]
    return "<net " in start and ("<location " in start or "<edge " in start)


def sumo_net_text(text: str) -> str:
    """Convert a SUMO network to the lane text format of sgstore.

    Raises
    ------
    MapError
        The text is not XML or not a network, exceeds a limit, or has no usable lane.
    """
    net = _SumoNet()
    read_markup(MarkupParser(net.start, most=MAX_MAP_ELEMENTS), text)
    notes: list[str] = []
    lines, crosswalks = _lines(net, notes)
    _add_opposites(net, lines)
    if not lines:
        raise MapError("a network of SUMO without lanes", element="net")
    lanes, warnings = plain_lanes(_joined(net, lines, notes))
    row_of = {lane.name: row for row, lane in enumerate(lanes)}
    lights = _lights(net, lines, row_of)
    return lane_text(lanes, [*notes, *_contradictions(net), *warnings], lights, crosswalks)


def _lines(net: _SumoNet, notes: list[str]) -> tuple[dict[str, LaneLine], list[PlainCrosswalk]]:
    """Return the lanes of a SUMO network by id, and its crosswalks."""
    lines: dict[str, LaneLine] = {}
    crosswalks: list[PlainCrosswalk] = []
    points = 0
    roundabouts = _roundabouts(net)
    faults: dict[str, list[str]] = defaultdict(list)
    for edge in net.edges:
        if edge.function in {"walkingarea", "connector"}:
            continue
        is_crossing = edge.function == "crossing"
        for lane in edge.lanes:
            ident, centre = lane.get("id", ""), _centre_line(lane.get("shape", ""))
            points += len(centre)
            if points > MAX_POINTS:
                raise MapError(f"lanes of more than {MAX_POINTS:,} points", element="lane")
            width = number(lane.get("width", ""), CROSSING_WIDTH if is_crossing else WIDTH)
            if fault := _fault(ident, centre, width, lines):
                faults[fault].append(ident or edge.ident)
                continue
            sections, _ = Sections.across(centre, [], [], width / 2)
            if is_crossing:
                crosswalks.append(_crosswalk(ident, sections))
            else:
                lines[ident] = _lane_line(edge, lane, centre, sections, roundabouts)
        _add_neighbours(net, edge, lines)
    if len(lines) > MAX_LANES:
        raise MapError(f"{len(lines):,} lanes; a map may have {MAX_LANES:,}", element="lane")
    notes += [about_lanes(lanes, fault) for fault, lanes in faults.items()]
    return lines, crosswalks


def _fault(ident: str, centre: Floats, width: float, lines: dict[str, LaneLine]) -> str:
    """Return the reason to leave out a SUMO lane; empty if the lane is valid."""
    if not ident or len(ident) > MAX_NAME or len(centre) < 2:
        return "left out, because its shape is not a line"
    if not 0 < width < 1000:
        return "left out, because its width is not positive"
    return "there are two of this id; the first one counts" if ident in lines else ""


def _lane_line(
    edge: _SumoEdge,
    lane: dict[str, str],
    centre: Floats,
    sections: Sections,
    roundabouts: dict[tuple[str, str], str],
) -> LaneLine:
    """Return a SUMO lane. Its neighbours and links are added later."""
    in_junction = edge.ident.startswith(":")
    junction = edge.ident[1:].rpartition("_")[0] if in_junction else ""
    return LaneLine(
        lane["id"],
        _lane_type(lane),
        centre,
        sections=sections,
        lefts=(_side(sections, left=True),),
        rights=(_side(sections, left=False),),
        road=edge.ident,
        number=int(number(lane.get("index", ""), 0.0)) + 1,
        junction=junction,
        speed_limit=_speed(lane),
        roundabout=roundabouts.get(("node", junction) if in_junction else ("edge", edge.ident), ""),
    )


def _roundabouts(net: _SumoNet) -> dict[tuple[str, str], str]:
    """Return the roundabout of each SUMO node and edge that belongs to one: id → name."""
    names: dict[tuple[str, str], str] = {}
    for roundabout in net.roundabouts:
        nodes = roundabout.get("nodes", "").split()
        if nodes:
            name = nodes[0][:MAX_NAME]
            names |= {("node", node): name for node in nodes}
            names |= {("edge", edge): name for edge in roundabout.get("edges", "").split()}
    return names


def _crosswalk(ident: str, sections: Sections) -> PlainCrosswalk:
    outline = np.concatenate((sections.right, sections.left[::-1]))
    return PlainCrosswalk(ident, outline, float(sections.z.mean()))


def _side(sections: Sections, *, left: bool) -> Border:
    """Return a lane border that vehicles may cross in both directions, as on SUMO edges."""
    line = sections.left if left else sections.right
    return Border(np.column_stack((line, sections.z)), to_left=True, to_right=True)


def _add_neighbours(net: _SumoNet, edge: _SumoEdge, lines: dict[str, LaneLine]) -> None:
    """Add the left neighbour of each lane of a SUMO edge: the lane with the next index."""
    idents = [lane.get("id", "") for lane in edge.lanes]
    for right, left in pairwise(idents):
        if right in lines and left in lines:
            lines[right] = replace(lines[right], left_beside=(left,))
    for ident in idents:
        other = net.beside.get(ident)
        if ident in lines and other:
            lines[ident] = replace(lines[ident], left_beside=(*lines[ident].left_beside, other))


def _add_opposites(net: _SumoNet, lines: dict[str, LaneLine]) -> None:
    """If the leftmost lanes of opposite SUMO edges touch, make them neighbours."""
    edges_between: dict[tuple[str, str], list[_SumoEdge]] = defaultdict(list)
    for edge in net.edges:
        if not edge.function and edge.lanes:
            edges_between[edge.source, edge.target].append(edge)
    for (source, target), edges in edges_between.items():
        opposites = edges_between.get((target, source), []) if source < target else []
        if len(edges) != 1 or len(opposites) != 1:
            continue
        left, opposite = (pair[0].lanes[-1].get("id", "") for pair in (edges, opposites))
        if left in lines and opposite in lines and _side_by_side(lines[left], lines[opposite]):
            beside = dict.fromkeys((*lines[left].left_beside, opposite))
            lines[left] = replace(lines[left], left_beside=tuple(beside))


def _side_by_side(one: LaneLine, other: LaneLine) -> bool:
    if one.sections is None or other.sections is None:
        return False
    gaps = one.sections.left[[0, -1]] - other.sections.left[[-1, 0]]
    return bool((np.hypot(*gaps.T) < _MAX_GAP).all())


def _joined(net: _SumoNet, lines: dict[str, LaneLine], notes: list[str]) -> list[LaneLine]:
    """Return SUMO lanes with predecessors and successors added, also those inside junctions.

    An inner lane without a connection leads to the end of the connection through it.
    """
    after: dict[str, list[Joint]] = defaultdict(list)
    before: dict[str, list[Joint]] = defaultdict(list)

    def join(src: str, dst: str) -> None:
        if src in lines and dst in lines:
            after[src].append(Joint(dst, Joint.START))
            before[dst].append(Joint(src, Joint.END))

    known = {lane.get("id", "") for edge in net.edges for lane in edge.lanes}
    missing: list[str] = []
    for connection in net.connections:
        ends = _from_lane(connection), _to_lane(connection), connection.get("via", "")
        absent = [end for end in ends if end and end not in known]
        missing += [f"from {ends[0]} to {ends[1]}"] * bool(absent)
        join(ends[0], ends[2] if ends[2] in lines else ends[1])
    for connection in net.connections:
        if connection.get("via") in lines and not after[connection["via"]]:
            join(connection["via"], _to_lane(connection))
    if missing:
        listed = ", ".join(dict.fromkeys(missing))
        notes.append(f"connections {listed}: a lane of it is missing")
    lost = [one for one in lines if one.startswith(":") and not (before[one] and after[one])]
    notes += [about_lanes(lost, "in a junction, but no connection leads through it")] * bool(lost)
    return [
        replace(line, before=tuple(before[ident]), after=tuple(after[ident]))
        for ident, line in lines.items()
    ]


def _to_lane(connection: dict[str, str]) -> str:
    return f"{connection.get('to')}_{connection.get('toLane')}"


def _contradictions(net: _SumoNet) -> list[str]:
    """Return warnings about lengths, traffic lights and roundabouts that do not fit the lanes."""
    notes: list[str] = []
    edges = {edge.ident for edge in net.edges}
    for edge in net.edges:
        for lane in edge.lanes if edge.function != "crossing" else ():
            told, line = number(lane.get("length", "")), _centre_line(lane.get("shape", ""))
            shown = float(run_of(line)[-1]) if len(line) else np.nan
            if abs(told - shown) > max(_ODD_LENGTH, _ODD_SHARE * shown):
                what = f"length is {told:g} m, but its shape has {shown:g} m"
                notes.append(f"lane {lane.get('id', '')}: {what}")
    linked: set[str] = set()
    for connection in net.connections:
        name, index = connection.get("tl", ""), connection.get("linkIndex", "")
        if not name:
            continue
        linked.add(name)
        what = f"connection from {_from_lane(connection)} to {_to_lane(connection)}"
        states = net.phases.get(name)
        if states is None:
            notes.append(f"{what}: its traffic light {name!r} is missing")
        elif not index.isdecimal() or any(int(index) >= len(state) for state in states):
            notes.append(f"{what}: its link {index!r} of traffic light {name!r} is missing")
    notes += [
        f"traffic light {name!r}: no connection names it"
        for name in net.phases
        if name not in linked
    ]
    for roundabout in net.roundabouts:
        absent = [edge for edge in roundabout.get("edges", "").split() if edge not in edges]
        notes += [f"roundabout: its edge {edge!r} is missing" for edge in absent]
    return notes


def _from_lane(connection: dict[str, str]) -> str:
    return f"{connection.get('from')}_{connection.get('fromLane')}"


def _lights(net: _SumoNet, lines: dict[str, LaneLine], row_of: dict[str, int]) -> list[PlainSignal]:
    """Return the traffic lights of a SUMO network. Lanes share a light if their lights always agree."""
    links: dict[str, dict[tuple[str, ...], dict[int, str]]] = defaultdict(dict)
    for connection in net.connections:
        name, index = connection.get("tl", ""), connection.get("linkIndex", "0")
        lane = connection.get("via") or _from_lane(connection)
        if name and len(name) <= MAX_NAME and lane in row_of and index.isdecimal():
            link = int(index)
            states = tuple(state[link : link + 1] for state in net.phases.get(name, ()))
            links[name].setdefault(states, {})[link] = lane
    signals: list[PlainSignal] = []
    for name, groups in links.items():
        for lanes in groups.values():
            starts = np.array([lines[lane].centre[0] for lane in lanes.values()])
            x, y, z = starts.mean(axis=0).tolist()
            signal = name if len(groups) == 1 else f"{name}/{min(lanes)}"
            rows = tuple(sorted({row_of[lane] for lane in lanes.values()}))
            signals.append(PlainSignal(signal, "traffic_light", x, y, z, lanes=rows))
    return signals


def _lane_type(lane: dict[str, str]) -> str:
    """Return the lane type of a SUMO lane, from the vehicle classes that it permits."""
    allowed = {*lane.get("allow", "").split()}
    if not allowed and "all" in lane.get("disallow", "").split():
        return "none"
    classes: set[str] = set()
    for more_classes, lane_type in _LANE_TYPES:
        classes |= more_classes
        if allowed and allowed <= classes:
            return lane_type
    return "entry" if lane.get("acceleration") in {"1", "true"} else "driving"


def _centre_line(text: str) -> Floats:
    """Parse the points (n, 3) of a SUMO line; empty for an invalid line."""
    try:
        points = [[float(value) for value in point.split(",")] for point in text.split()]
        line = np.array([(*point, 0.0)[:3] for point in points], np.float64).reshape(-1, 3)
    except ValueError:
        return np.zeros((0, 3))
    line = thinned(line)
    usable = len(line) > 1 and bool((np.abs(line) < 1e8).all()) and run_of(line)[-1] > 0
    return line if usable else np.zeros((0, 3))


def _speed(lane: dict[str, str]) -> float:
    speed = number(lane.get("speed", ""), np.nan)
    return speed if 0 < speed < 1000 else np.nan
