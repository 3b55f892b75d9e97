"""Conversion of lane lines with links and borders (OSI, CommonRoad, Lanelet2, SUMO) to a road map.

The input is lane lines and links, the output is plain lanes.

Simulators without OpenDRIVE describe lanes as lines with the ids of connected lanes. The direction
of a line can differ from the direction of its traffic. This module adds cross sections, turns lanes
into the direction of traffic, and relates them to one another. Unusable lanes are left out and
named in a warning.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import shapely

from sgstore.base.display import first_of
from sgstore.errors import MapError
from sgstore.maps.roads._cross_sections import (
    APART,
    WIDE,
    Sections,
    along_line,
    half_width,
    run_of,
    thinned,
    way_between,
)
from sgstore.maps.roads._lanes import PlainLane
from sgstore.maps.roads._map import STOREY
from sgstore.model.vocabulary import DRIVING, TRAFFIC

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from sgstore.model.world import Floats


MAX_POINTS: Final = 2_000_000
"""Largest number of points of all lines together."""
MAX_LANES: Final = 30_000
MAX_WAYS: Final = 20_000
"""Largest number of lanes that are added through junction areas."""
MAX_RELATED: Final = 500_000
"""Largest number of references between lanes (touching ends and neighbours)."""
GAP: Final = 5.0
"""Gap above which the ends of two lanes do not touch, even if the file links them; m."""
SEAM: Final = 1.0
"""Largest gap between a lane and the next one that is closed; m."""
LISTED: Final = 1_000
"""Largest number of lanes that a warning lists."""
_FEW: Final = 8
"""Largest number of lanes that a warning about a guess lists."""
_MOST_ACROSS: Final = 16
"""Largest number of lanes without traffic between two lanes that count as neighbours."""
_ABOUT: Final = 1.0
"""Distance between centre lines up to which two lanes of a junction belong together; m."""


class Joint(NamedTuple):
    """Link from an end of a lane to another lane, and to that lane's end: ``start``, ``end`` or unknown."""

    lane: str
    contact: str = ""

    START = "start"
    END = "end"


@dataclass(frozen=True, slots=True)
class Border:
    """Line on the left or right side of a lane. Crossing it may be permitted.

    Attributes
    ----------
    line : (k, 3) float64
    to_left, to_right : bool or None
        True if traffic may cross it from its right to its left (and from left to right), in the
        direction of the lane's line; ``None`` means unknown.
    ident : str
        Id by which lanes refer to it; empty if there is no id.
    broad : bool
        True for a broad marking.
    """

    line: Floats
    to_left: bool | None = None
    to_right: bool | None = None
    ident: str = ""
    broad: bool = False


@dataclass(frozen=True, slots=True)
class LaneLine:
    """Lane as a centre line with borders and links. Left and right are relative to the line, not the traffic.

    Attributes
    ----------
    ident : str
        Id by which other lanes refer to it.
    type : str
        Lane type of OpenDRIVE.
    centre : (n, 3) float64
        Its centre line; m.
    forward, both : bool
        ``forward``: traffic runs along the line. ``both``: traffic runs both ways.
    lefts, rights : tuple of Border
        In any order.
    sections : Sections, optional
        Known cross sections along the line; by default they are computed from the lines.
    before, after : tuple of Joint
        Lanes that touch its start and its end.
    left_beside, right_beside : tuple of str
    name, road, section, number
        As in :class:`~sgstore.maps.roads.MapNodes`; empty ``road``: it belongs to the road of its
        neighbours.
    junction : str or None
        ``None`` means a junction without a name.
    speed_limit : float
        m/s; NaN if there is no limit.
    roundabout : str
        Its roundabout, or empty.
    """

    ident: str
    type: str
    centre: Floats
    forward: bool = True
    both: bool = False
    lefts: tuple[Border, ...] = ()
    rights: tuple[Border, ...] = ()
    sections: Sections | None = None
    before: tuple[Joint, ...] = ()
    after: tuple[Joint, ...] = ()
    left_beside: tuple[str, ...] = ()
    right_beside: tuple[str, ...] = ()
    name: str = ""
    road: str = ""
    section: int = 0
    number: int = 0
    junction: str | None = ""
    speed_limit: float = np.nan
    roundabout: str = ""

    @staticmethod
    def with_junctions(lines: Sequence[LaneLine]) -> list[LaneLine]:
        """Group lanes that cross into junctions. Return the lanes with the names of their junctions.

        This applies to lanes that cross, diverge and merge, but not to lanes on different storeys.
        Lanes without sections stay unchanged.

        Raises
        ------
        MapError
            Too many lanes overlap.
        """
        rows = [row for row, line in enumerate(lines) if line.type in DRIVING and line.sections]
        sections = [one for row in rows if (one := lines[row].sections)]
        outlines: Any = shapely.make_valid(
            [shapely.Polygon(np.concatenate((one.right, one.left[::-1]))) for one in sections]
        )
        centres: Any = np.array([shapely.LineString(one.middle) for one in sections], object)
        tree = shapely.STRtree(outlines)
        inside: set[int] = set()
        pairs = 0
        for start in range(0, len(rows), _ASKED_AT_ONCE):
            one, other = tree.query(centres[start : start + _ASKED_AT_ONCE], predicate="intersects")
            pairs += len(one)
            if pairs > MAX_RELATED:
                raise MapError(f"more than {MAX_RELATED:,} lanes on one another", element="lane")
            one = one + start
            one, other = one[one != other], other[one != other]
            common: Any = shapely.intersection(centres[one], outlines[other])
            long = shapely.length(common) > _ON_ANOTHER
            for lane, crossed, part in zip(one[long], other[long], common[long], strict=True):
                place = shapely.point_on_surface(part)
                heights = [_height(sections[row], centres[row], place) for row in (lane, crossed)]
                if abs(heights[0] - heights[1]) <= STOREY:
                    inside |= {rows[lane], rows[crossed]}
        return [
            replace(line, junction=None) if row in inside and line.junction == "" else line
            for row, line in enumerate(lines)
        ]


@dataclass(frozen=True, slots=True)
class Area:
    """Junction as an area. It has pairs of lanes (from, to) that it connects."""

    ident: str
    ways: tuple[tuple[str, str], ...]


@dataclass(slots=True)
class _Network:
    """Lanes of a map with their surfaces, and look-ups of their ends and directions."""

    lines: list[LaneLine]
    sections: list[Sections]
    index: dict[str, int]
    warnings: list[str] = field(default_factory=list[str])
    _turned: dict[tuple[int, int], bool] = field(default_factory=dict[tuple[int, int], bool])

    def direction(self, lane: int) -> int:
        return 1 if self.lines[lane].forward else -1

    def end_of(self, lane: int, contact: str) -> Floats:
        """Return the start or end point of a lane's centre line."""
        middle = self.sections[lane].middle
        return middle[0 if contact == Joint.START else -1]

    def gap(self, lane: int, end: str, other: int, contact: str) -> float:
        """Return the distance between an end of a lane and an end of another lane; m."""
        return float(np.hypot(*(self.end_of(lane, end) - self.end_of(other, contact))))

    def runs_against(self, lane: int, other: int) -> bool:
        """Return True if the lines of two neighbouring lanes run in opposite directions."""
        key = (lane, other) if lane < other else (other, lane)
        if key not in self._turned:
            self._turned[key] = _turned_round(*(self.sections[row].middle for row in key))
        return self._turned[key]

    def exits(self, lane: int, contact: str) -> bool:
        """Return True if traffic leaves a lane at the given end of its line."""
        line = self.lines[lane]
        return line.both or line.forward == (contact == Joint.END)

    def enters(self, lane: int, contact: str) -> bool:
        """Return True if traffic enters a lane at the given end of its line."""
        line = self.lines[lane]
        return line.both or line.forward == (contact == Joint.START)


def plain_lanes(
    lines: Sequence[LaneLine], areas: Sequence[Area] = ()
) -> tuple[list[PlainLane], list[str]]:
    """Convert lane lines to lanes of a road map. Return the lanes, and warnings about guessed values.

    Raises
    ------
    MapError
        The map has too many lanes, neighbours or ways.

    Notes
    -----
    Each way through an area becomes a lane: the cubic from the end of one lane to the start of the
    other.
    """
    _check_numbers(lines, areas)
    network = _shaped(lines)
    _report(network, {area.ident for area in areas})
    _add_ways(network, areas)
    joints = _joints(network)
    beside = _beside(network)
    roads, junctions = _roads(network, beside), _junctions(network)
    onto = _onto(network, joints)
    names = _names(network)
    _close_seams(network, joints)
    lanes: list[PlainLane] = []
    for row, line in enumerate(network.lines):
        sections = network.sections[row]
        sections = sections if line.forward else sections.turned_round()
        left, right = beside[row] if line.forward else beside[row][::-1]
        bounds = (line.lefts, line.rights) if line.forward else (line.rights, line.lefts)
        against = set(_against(network, row, left | right))
        lanes.append(
            PlainLane(
                name=names[row],
                type=line.type,
                road=roads[row],
                junction=junctions[row],
                section=line.section,
                number=line.number,
                left=sections.left,
                right=sections.right,
                z=sections.z,
                onto=tuple(sorted(onto[row])),
                left_beside=tuple(sorted(left)),
                right_beside=tuple(sorted(right)),
                against=tuple(sorted(against)),
                changes=tuple(_changes(network, row, beside[row], against)),
                speed_limit=line.speed_limit,
                roundabout=line.roundabout,
                broad=tuple(
                    side
                    for side, borders in zip(("left", "right"), bounds, strict=True)
                    if borders and all(border.broad for border in borders)
                ),
            )
        )
    return lanes, network.warnings


def _check_numbers(lines: Sequence[LaneLine], areas: Sequence[Area]) -> None:
    related = sum(
        len(line.before) + len(line.after) + len(line.left_beside) + len(line.right_beside)
        for line in lines
    )
    ways = sum(len(area.ways) for area in areas)
    for number, limit, what in (
        (len(lines), MAX_LANES, "lanes"),
        (related, MAX_RELATED, "neighbours of lanes"),
        (ways, MAX_WAYS, "ways through intersections"),
    ):
        if number > limit:
            raise MapError(f"{number:,} {what}; a map may have {limit:,}", element="lane")


def _shaped(lines: Sequence[LaneLine]) -> _Network:
    """Compute the surfaces of lanes from their lines. Drop lanes without a surface."""
    network = _Network([], [], {})
    usable: list[LaneLine] = []
    short: list[str] = []
    twice: list[str] = []
    for line in lines:
        centre = thinned(line.centre)
        if line.ident in network.index:
            twice.append(line.ident)
        elif line.sections is None and (len(centre) < 2 or run_of(centre)[-1] < 1e-3):
            short.append(line.ident)
        else:
            network.index[line.ident] = len(usable)
            usable.append(replace(line, centre=centre))
    _tell(network, twice, "there are two of this id; the first one counts")
    _tell(network, short, "no centre line and no ways through: left out")
    guessed: list[str] = []
    for line in usable:
        sections, told = (line.sections, True) if line.sections else _cut(line, usable, network)
        network.lines.append(line)
        network.sections.append(sections)
        guessed += [line.ident] * (not told)
    width = f"no boundary beside them: as wide as lanes beside them are apart, else {WIDE} m"
    if guessed:
        network.warnings.append(about_lanes(guessed, width, _FEW))
    return network


def _cut(line: LaneLine, lines: Sequence[LaneLine], network: _Network) -> tuple[Sections, bool]:
    lefts, rights = (
        [thin for border in side if len(thin := thinned(border.line)) > 1]
        for side in (line.lefts, line.rights)
    )
    half = WIDE / 2
    if not lefts and not rights:
        beside = (network.index.get(i) for i in (*line.left_beside, *line.right_beside))
        others = [lines[row].centre for row in beside if row is not None]
        half = half_width(line.centre, [other for other in others if len(other) > 1])
    return Sections.across(line.centre, lefts, rights, half)


def about_lanes(lanes: Sequence[str], what: str, most: int = LISTED) -> str:
    """Return a warning text with the names of some lanes, at most ``most``."""
    return f"{'lanes' if len(lanes) > 1 else 'lane'} {first_of(lanes, most)}: {what}"


def _report(network: _Network, areas: set[str]) -> None:
    """Warn about links and neighbours that do not exist, and about borders on the wrong side."""
    missing: list[str] = []
    both: list[str] = []
    for line in network.lines:
        named = [joint.lane for joint in (*line.before, *line.after)]
        named += [*line.left_beside, *line.right_beside]
        absent = (one for one in named if one not in network.index and one not in areas)
        missing += [f"{line.ident} to {one}" for one in dict.fromkeys(absent)]
        twice = {*line.left_beside} & {*line.right_beside}
        both += [f"{line.ident} and {one}" for one in sorted(twice)]
    _tell(network, missing, "linked to a missing lane")
    _tell(network, both, "neighbours on both sides")
    pairs = zip(network.lines, network.sections, strict=True)
    turned = [line.ident for line, sections in pairs if sections.is_crossed()]
    _tell(network, turned, "its left border is on the right, so its width is negative")


def _tell(network: _Network, lanes: Sequence[str], what: str) -> None:
    if lanes:
        network.warnings.append(about_lanes(lanes, what))


def _add_ways(network: _Network, areas: Iterable[Area]) -> None:
    """For each junction area, add lanes that connect the end of one lane with the start of another."""
    missing: list[str] = []
    astray: list[str] = []
    for area in areas:
        number = 0
        for start, end in dict.fromkeys(area.ways):
            lanes = network.index.get(start), network.index.get(end)
            if lanes[0] is None or lanes[1] is None:
                missing.append(area.ident)
            elif not all(
                _touches(network.lines[lane], area.ident, at_exit=at_exit)
                for lane, at_exit in ((lanes[0], True), (lanes[1], False))
            ):
                astray.append(f"{area.ident} from {start} to {end}")
            else:
                number += 1
                _add_way(network, area.ident, number, (lanes[0], lanes[1]))
    _tell(network, list(dict.fromkeys(missing)), "a way through it leads to a missing lane")
    _tell(network, astray, "left out as a connection: the lanes at its ends do not confirm it")


def _touches(line: LaneLine, area: str, *, at_exit: bool) -> bool:
    """Return True if traffic of a lane enters (or leaves) a junction area, or if the lane has no links."""
    joints = line.after if line.forward == at_exit else line.before
    joints = (*line.before, *line.after) if line.both else joints
    untold = not line.before and not line.after
    return untold or any(joint.lane == area for joint in joints)


def _add_way(network: _Network, area: str, number: int, lanes: tuple[int, int]) -> None:
    start, end = (network.lines[lane] for lane in lanes)
    leaves, enters = (
        Joint.END if start.forward else Joint.START,
        Joint.START if end.forward else Joint.END,
    )
    sections = way_between(_gate(network, lanes[0], leaves), _gate(network, lanes[1], enters))
    ident = f"{area}:{start.ident}-{end.ident}"
    network.index[ident] = len(network.lines)
    network.sections.append(sections)
    network.lines.append(
        LaneLine(
            ident,
            start.type,
            np.column_stack((sections.middle, sections.z)),
            before=(Joint(start.ident, leaves),),
            after=(Joint(end.ident, enters),),
            name=f"{area}/0/{number}",
            road=area,
            number=number,
            junction=area,
        )
    )


def _gate(network: _Network, lane: int, contact: str) -> tuple[Floats, float, float, float]:
    """Return position, heading of the traffic, width and height at one end of a lane."""
    sections = network.sections[lane]
    at, other = (0, 1) if contact == Joint.START else (-1, -2)
    middle = sections.middle
    way = (middle[other] - middle[at]) * (1 if contact == Joint.START else -1)
    way *= network.direction(lane)
    width = float(np.hypot(*(sections.left[at] - sections.right[at])))
    return middle[at], float(np.arctan2(way[1], way[0])), width, float(sections.z[at])


_Joined = tuple[int, str, int, str]
"""Touching ends of two lanes: lane, its end, other lane, end of the other lane."""


def _joints(network: _Network) -> set[_Joined]:
    joints: set[_Joined] = set()
    far: list[str] = []
    turned: list[str] = []
    for row, line in enumerate(network.lines):
        for own, touched in ((Joint.START, line.before), (Joint.END, line.after)):
            for joint in touched:
                other = network.index.get(joint.lane)
                if other is None:
                    continue
                contact = joint.contact or _contact(network, row, own, other)
                back = Joint.END if contact == Joint.START else Joint.START
                if (
                    network.gap(row, own, other, contact)
                    > SEAM
                    >= network.gap(row, own, other, back)
                ):
                    contact = back
                    turned.append(f"{line.ident} to {joint.lane}")
                if network.gap(row, own, other, contact) > GAP:
                    far.append(f"{line.ident} to {joint.lane}")
                else:
                    joints |= {(row, own, other, contact), (other, contact, row, own)}
    _tell(network, far, f"not joined as declared: their ends are more than {GAP} m apart")
    _tell(network, turned, "linked to the far end: the end that touches counts")
    against = {
        " and ".join(sorted((network.lines[row].ident, network.lines[other].ident)))
        for row, end, other, contact in joints
        if network.exits(row, end) == network.exits(other, contact)
        and all(
            network.lines[lane].type in TRAFFIC and not network.lines[lane].both
            for lane in (row, other)
        )
    }
    _tell(network, sorted(against), "linked, but their traffic meets head on")
    return joints


def _contact(network: _Network, lane: int, end: str, other: int) -> str:
    """Return the end (start or end) of another lane that touches the given end of a lane."""
    line, ident = network.lines[other], network.lines[lane].ident
    says = {
        contact
        for contact, touched in ((Joint.START, line.before), (Joint.END, line.after))
        if any(joint.lane == ident for joint in touched)
    }
    if len(says) == 1:
        return says.pop()
    return min((Joint.START, Joint.END), key=lambda contact: network.gap(lane, end, other, contact))


def _onto(network: _Network, joints: Iterable[_Joined]) -> list[set[int]]:
    onto: list[set[int]] = [set() for _ in network.lines]
    for row, end, other, contact in joints:
        if network.exits(row, end) and network.enters(other, contact):
            onto[row].add(other)
    return onto


def _close_seams(network: _Network, joints: Iterable[_Joined]) -> None:
    """Extend lanes to the next lane if the gap between them is small."""
    nearest: dict[int, tuple[float, str, int, str]] = {}
    for row, end, other, contact in sorted(joints):
        gap = network.gap(row, end, other, contact)
        if network.exits(row, end) and network.enters(other, contact) and APART < gap <= SEAM:
            nearest[row] = min(nearest.get(row, (np.inf, "", 0, "")), (gap, end, other, contact))
    sections = list(network.sections)
    for row, (_, end, other, contact) in nearest.items():
        own, onward = sections[row], network.sections[other]
        own = own if end == Joint.END else own.turned_round()
        onward = onward if contact == Joint.START else onward.turned_round()
        own = own.up_to(onward.left[0], onward.right[0], float(onward.z[0]))
        network.sections[row] = own if end == Joint.END else own.turned_round()


_Sides = tuple[set[int], set[int]]
"""Two sets of lanes: those to the left of a line, and those to its right."""


def _beside(network: _Network) -> list[_Sides]:
    """Return the left and right neighbours of each lane. A link from one of two neighbours is enough."""
    beside: list[_Sides] = [(set(), set()) for _ in network.lines]
    for row, line in enumerate(network.lines):
        for side, idents in enumerate((line.left_beside, line.right_beside)):
            for ident in idents:
                other = network.index.get(ident)
                if other is None or other == row:
                    continue
                beside[row][side].add(other)
                back = side if network.runs_against(row, other) else 1 - side
                beside[other][back].add(row)
    across = [
        tuple(_across(network, beside, row, side) for side in (0, 1))
        for row in range(len(network.lines))
    ]
    for sides, more in zip(beside, across, strict=True):
        for side in (0, 1):
            sides[side].update(more[side])
    return beside


def _turned_round(one: Floats, other: Floats) -> bool:
    """Return True if two neighbouring lines run in opposite directions."""
    way, back = one[-1] - one[0], other[-1] - other[0]
    same = float(way @ back)
    if abs(same) < 0.5 * float(np.hypot(*way) * np.hypot(*back)):
        # Both lines bend: compare their directions where they are next to one another.
        near = along_line(one, other[[0, -1]])
        return bool(near[1] < near[0])
    return same < 0


def _across(network: _Network, beside: list[_Sides], row: int, side: int) -> set[int]:
    """Return the next driving lanes on one side of a lane, with only lanes without traffic between them."""
    if network.lines[row].type not in TRAFFIC:
        return set()
    found: set[int] = set()
    seen, front = {row}, [(row, side)]
    for _ in range(_MOST_ACROSS):
        onward: list[tuple[int, int]] = []
        for lane, towards in front:
            for other in sorted(beside[lane][towards] - seen):
                seen.add(other)
                if network.lines[other].type in TRAFFIC:
                    found.add(other)
                else:
                    turned = network.runs_against(lane, other)
                    onward.append((other, 1 - towards if turned else towards))
        front = onward
    return found


def _against(network: _Network, row: int, others: Iterable[int]) -> Iterator[int]:
    """Yield those neighbours of a lane that have oncoming traffic."""
    if network.lines[row].type not in TRAFFIC:
        return
    for other in others:
        if network.lines[other].type in TRAFFIC:
            turned = network.runs_against(row, other)
            same = (network.lines[row].forward == network.lines[other].forward) != turned
            if not same or network.lines[row].both or network.lines[other].both:
                yield other


def _changes(
    network: _Network, row: int, beside: _Sides, against: set[int]
) -> Iterator[tuple[int, float, float]]:
    """Yield the parts of a lane from which vehicles may change to a neighbouring lane."""
    line, middle = network.lines[row], network.sections[row].middle
    if line.type not in DRIVING:
        return
    length = float(run_of(middle)[-1])
    for side, others in enumerate(beside):
        reached = [
            other
            for other in sorted(others)
            if network.lines[other].type in DRIVING
            and (other not in against or line.both or network.lines[other].both)
        ]
        stretches = _open_stretches(network, row, side) if reached else []
        for other in reached if stretches else []:
            reach = along_line(middle, network.sections[other].middle)
            for start, end in stretches:
                low, high = max(start, float(reach.min())), min(end, float(reach.max()))
                if high > low:
                    yield (
                        (other, low, high) if line.forward else (other, length - high, length - low)
                    )


def _open_stretches(network: _Network, row: int, side: int) -> list[tuple[float, float]]:
    """Return the parts of a lane where vehicles may cross its border on one side."""
    line, middle = network.lines[row], network.sections[row].middle
    borders = [b for b in (line.lefts, line.rights)[side] if len(b.line) > 1]
    spans: list[tuple[float, float, float, bool]] = []
    for border in borders:
        along = along_line(middle, border.line[:, :2])
        start, end = float(along.min()), float(along.max())
        half = (start + end) / 2
        inner = np.column_stack([np.interp([half], run_of(middle), c) for c in middle.T])
        nearest = border.line[np.argmin(np.hypot(*(border.line[:, :2] - inner).T)), :2]
        allowed = bool(border.to_left if side == 0 else border.to_right)
        spans.append((start, end, float(np.hypot(*(nearest - inner[0]))), allowed))
    cuts = sorted({place for span in spans for place in span[:2]})
    found: list[tuple[float, float]] = []
    for start, end in pairwise(cuts):
        over = [span for span in spans if span[0] <= start and span[1] >= end]
        if over and min(over, key=lambda span: span[2])[3]:
            follows = bool(found) and found[-1][1] == start
            found.append((found.pop()[0] if follows else start, end))
    return found


def _names(network: _Network) -> list[str]:
    """Return a unique name for each lane. If a name is not unique, the lane's id is appended."""
    wanted = [line.name or line.ident for line in network.lines]
    count = Counter(wanted)
    return [
        name if count[name] == 1 else f"{name}#{line.ident}"
        for name, line in zip(wanted, network.lines, strict=True)
    ]


def _roads(network: _Network, beside: list[_Sides]) -> list[str]:
    """Return the name of each lane's road. A lane without a road joins the road of its neighbours."""
    road = [line.road for line in network.lines]
    for row, line in enumerate(network.lines):
        if road[row]:
            continue
        road[row] = line.ident
        front = [row] if line.junction == "" else []
        while front:
            for other in set().union(*beside[front.pop()]):
                if not road[other] and network.lines[other].junction == "":
                    road[other] = line.ident
                    front.append(other)
    return road


def _junctions(network: _Network) -> list[str]:
    """Return the name of each lane's junction. Lanes that cross or touch get a junction without a name."""
    junction = [line.junction or "" for line in network.lines]
    rows = [row for row, line in enumerate(network.lines) if line.junction is None]
    if not rows:
        return junction
    centres: Any = [shapely.LineString(network.sections[row].middle) for row in rows]
    union: Any = shapely.union_all(shapely.buffer(centres, _ABOUT / 2, quad_segs=1))
    parts: Any = shapely.get_parts(union)
    tree = shapely.STRtree(parts)
    starts: Any = [shapely.Point(network.sections[row].middle[0]) for row in rows]
    inside = dict(zip(*tree.query(starts, predicate="intersects").tolist(), strict=True))
    name: dict[int, str] = {}
    for number, row in enumerate(rows):
        part = inside[number]
        junction[row] = name.setdefault(part, network.lines[row].ident)
    return junction


_ON_ANOTHER: Final = 0.5
"""Smallest length of a centre line inside another lane for which both lanes form a junction; m."""
_ASKED_AT_ONCE: Final = 100


def _height(sections: Sections, centre: Any, place: Any) -> float:
    return float(
        np.interp(shapely.line_locate_point(centre, place), run_of(sections.middle), sections.z)
    )
