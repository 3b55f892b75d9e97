"""Lanes of OpenDRIVE roads, and their surfaces as cross sections.

Along a lane section every lateral position (the centre lane's offset, the outer border of each
lane) is a cubic of s between *cuts*: places where a record of any kind starts. Between cuts cubics
can be added. Therefore lanes are stacked once per cut, as coefficients. They are then evaluated at
*stations*: enough of them that straight pieces follow the curves within :data:`SAGITTA`. A jump at
a cut has two stations in one place, one for each side.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.opendrive._document import coefficients_of
from sgstore.maps.opendrive._piecewise import (
    cubic,
    cubic_bend,
    cubic_slope,
    last_before,
    ragged,
    starts_of,
)
from sgstore.maps.opendrive._plan_view import PlanView, Poses, poses
from sgstore.maps.roads import Ribbons

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.maps.opendrive._document import Document
    from sgstore.model.world import Bools, Floats, Ints


SAGITTA: Final = 2e-3
"""Largest distance between a curved border and its straight pieces; m.

Half the tolerance would need half as many pieces more in every look-up. Centre lines are smoother,
because headings of the cross sections define their curves.
"""
RISE: Final = 2e-2
"""Largest error of heights; m."""
MAX_STEP: Final = 10.0
"""Largest length of a piece, so that its bounding box stays small; m."""
MAX_STATIONS: Final = 250_000
"""Largest number of cross sections on one road: 100 km of a winding motorway with eight lanes.

A cross section takes up to 700 bytes until the look-up of its lanes is ready.
"""
MAX_TOTAL: Final = 4_000_000
"""Largest number of cross sections in a map."""
MAX_OF_SMALL: Final = 500_000
"""Largest number of cross sections in a map whose text has fewer than :data:`CHARACTERS` characters for each.
It stops short texts with wrong numbers from needing gigabytes. Towns have 70 characters or more."""
CHARACTERS: Final = 8
"""Smallest number of characters for each cross section of a larger map."""
MAX_LANES: Final = 1_000
"""Largest number of lanes in a lane section."""
MAX_COORDINATE: Final = 1e8
JUMP: Final = 2e-4
"""Smallest sideways jump of a border between two intervals that counts as a jump; m."""
CORNER: Final = 2e-4
"""Smallest change of direction between two intervals that counts as a corner; rad."""
NEGATIVE: Final = 1e-3
"""Width below which a lane width counts as negative, and not as rounded; m. The sign is opposite."""
_SAME_PLACE: Final = 1e-6
_SAMPLES: Final = 5
"""Number of places in an interval at which the curvature is sampled."""


@dataclass(frozen=True, slots=True)
class LaneSections:
    """Lane sections (parts of a road with fixed lanes) of an OpenDRIVE map, by road and position s.

    Attributes
    ----------
    road : int64
        Row of the road.
    number : int64
        Number in its road, from 0.
    start, end : float64
        Along the road; m.
    """

    road: Ints
    number: Ints
    start: Floats
    end: Floats


@dataclass(frozen=True, slots=True)
class LaneTable:
    """All OpenDRIVE lanes except centre lanes, sorted by lane section and from left to right; shape (L,).

    Attributes
    ----------
    sections : LaneSections
    section, road, ident : int64
        Rows of section and road; the lane's number in its section.
    type : list of str
    forward : bool
        True if traffic runs along s.
    both : bool
        True if traffic runs both ways.
    inner : int64
        The next lane towards the centre lane; -1 means the centre lane itself.
    rank : int64
        Number of lanes between it and the centre lane.
    row : (raw,) int64
        Row of each element of the document, -1 for centre lanes.
    centre : (raw,) int64
        Section of each centre lane element, else -1.
    """

    sections: LaneSections
    section: Ints
    road: Ints
    ident: Ints
    type: list[str]
    forward: Bools
    both: Bools
    inner: Ints
    rank: Ints
    row: Ints
    centre: Ints

    def __len__(self) -> int:
        return len(self.section)

    def name(self, document: Document, lane: int) -> str:
        """Return the name of a lane for warnings: its road, number of its section, and lane id."""
        road = document.road_ids[self.road[lane]]
        return f"lane {road}/{self.sections.number[self.section[lane]]}/{self.ident[lane]}"


def read_lanes(document: Document) -> LaneTable:
    """Read all lane sections and lanes of an OpenDRIVE map. Record defects of roads."""
    sections, section_row = _read_sections(document)
    table = document["road/laneSection/lane"]
    ident = document.integers("road/laneSection/lane", "id")
    section = section_row[table.of]
    order = np.lexsort((-ident, section))
    twice = order[1:][(np.diff(section[order]) == 0) & (np.diff(ident[order]) == 0)]
    document.accuse("road/laneSection/lane", _marked(twice, len(table)), "two lanes of one id")
    crowd = np.bincount(section, minlength=len(sections.start))[section] > MAX_LANES
    document.accuse("road/laneSection/lane", crowd, f"more than {MAX_LANES:,} lanes in a section")
    row = np.full(len(table), -1, np.int64)
    order = order[ident[order] != 0]
    row[order] = np.arange(len(order))
    centre = np.where(ident == 0, section, -1)
    section, ident = section[order], ident[order]
    road = sections.road[section]
    types = [table.attributes[i].get("type", "none").strip() for i in order]
    left_hand = np.array([t.upper() == "LHT" for t in document["road"].texts("rule")], bool)
    direction = np.array([table.attributes[i].get("direction", "standard") for i in order], object)
    forward = (ident < 0) ^ left_hand[road] ^ (direction == "reversed")
    both = (direction == "both") | (np.array(types, object) == "bidirectional")
    inner, rank = _stack(section, ident)
    return LaneTable(
        sections, section, road, ident, types, forward, both, inner, rank, row, centre
    )  # fmt: skip


def odd_sections(document: Document) -> list[str]:
    """Return warnings about lane sections that declare one side of a road only. They are read as two-sided."""
    table = document["road/laneSection"]
    roads = {
        document.road_ids[road]
        for road, one_sided in zip(table.road.tolist(), table.texts("singleSide"), strict=True)
        if one_sided.lower() in {"true", "1"}
    }
    return [
        f"road {name!r}: a laneSection is for one side only; lanes of the other side end there"
        for name in sorted(roads)
    ]


def _marked(rows: Ints, n: int) -> Bools:
    mask = np.zeros(n, bool)
    mask[rows] = True
    return mask


def _read_sections(document: Document) -> tuple[LaneSections, Ints]:
    table = document["road/laneSection"]
    start = document.numbers("road/laneSection", "s")
    length = document.numbers("road", "length")
    document.accuse("road", length < 0, "attribute 'length' is negative")
    document.accuse("road", np.bincount(table.road, minlength=len(length)) == 0, "no laneSection")
    geometries = np.bincount(document["road/geometry"].road, minlength=len(length))
    document.accuse("road", geometries == 0, "no geometry in its planView")
    order = np.lexsort((start, table.road))
    road, start = table.road[order], start[order]
    last = np.append(road[1:] != road[:-1], True)
    end = np.where(last, length[road], np.append(start[1:], 0.0))
    number = np.arange(len(road)) - np.searchsorted(road, road)
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    # Rounded numbers can let a road end slightly before its last section starts.
    return LaneSections(road, number, start, np.maximum(end, start)), row


def _stack(section: Ints, ident: Ints) -> tuple[Ints, Ints]:
    """For each lane, return the next lane towards the road centre, and its number from the centre (from 0)."""
    n = len(ident)
    order = np.lexsort((np.abs(ident), ident > 0, section))
    same = (np.diff(section[order]) == 0) & (np.diff((ident > 0)[order].astype(np.int8)) == 0)
    follows = np.concatenate((np.zeros(min(n, 1), bool), same))
    inner = np.full(n, -1, np.int64)
    inner[order[1:][same]] = order[:-1][same]
    position = np.arange(n)
    first = np.maximum.accumulate(np.where(follows, 0, position))
    rank = np.empty(n, np.int64)
    rank[order] = position - first
    return inner, rank


@dataclass(frozen=True, slots=True)
class _LaneIntervals:
    """Intervals of OpenDRIVE lane sections. In each, lane widths and heights are single cubic polynomials."""

    section: Ints
    start: Floats
    end: Floats
    first: Ints  # (sections + 1,): start of the intervals of each section


def _intervals(document: Document, lanes: LaneTable, plan: PlanView) -> _LaneIntervals:
    sections = lanes.sections
    kinds = ("road/elevation", "road/laneOffset")
    road = np.concatenate([plan.road, *(document[kind].road for kind in kinds)])
    s = np.concatenate([plan.s, *(document.numbers(kind, "s") for kind in kinds)])
    section = last_before(sections.road, sections.start, road, s)
    cuts = [(section, s)]
    for kind in ("road/laneSection/lane/width", "road/laneSection/lane/border"):
        lane = lanes.row[document[kind].of]
        offset = document.numbers(kind, "sOffset", 0.0)[lane >= 0]
        of = lanes.section[lane[lane >= 0]]
        cuts.append((of, sections.start[of] + offset))
    cuts += _ends_of_width(document, lanes)
    section = np.concatenate([c for c, _ in cuts])
    s = np.concatenate([at for _, at in cuts])
    inside = (section >= 0) & (s > sections.start[section] + _SAME_PLACE)
    inside &= s < sections.end[section] - _SAME_PLACE
    section, s = section[inside], s[inside]
    every = np.arange(len(sections.start))
    section = np.concatenate((every, section))
    s = np.concatenate((sections.start, s))
    order = np.lexsort((s, section))
    section, s = section[order], s[order]
    new = np.concatenate(
        (np.ones(min(len(s), 1), bool), (np.diff(section) > 0) | (np.diff(s) > _SAME_PLACE))
    )
    section, s = section[new], s[new]
    first = starts_of(np.bincount(section, minlength=len(every)))
    end = np.append(s[1:], 0.0)
    last = first[1:] - 1
    end[last] = sections.end
    return _LaneIntervals(section, s, end, first)


def _ends_of_width(document: Document, lanes: LaneTable) -> list[tuple[Ints, Floats]]:
    """Return the positions at which the width of a lane changes its sign, by lane section.

    Each lane with a negative width causes a warning. Between the places its width counts as 0.
    """
    kind, sections = "road/laneSection/lane/width", lanes.sections
    lane = lanes.row[document[kind].of]
    rows = np.flatnonzero(lane >= 0)
    offset = document.numbers(kind, "sOffset", 0.0)
    rows = rows[np.lexsort((offset[rows], lane[rows]))]
    lane, offset, width = lane[rows], offset[rows], coefficients_of(document, kind)[rows]
    section = lanes.section[lane]
    span = sections.end[section] - sections.start[section]
    same = np.flatnonzero(lane[1:] == lane[:-1])
    span[same] = np.minimum(offset[same + 1], span[same])
    span -= offset
    at = np.linspace(0.0, 1.0, 2 * _SAMPLES - 1) * np.maximum(span, 0.0)[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        lowest = cubic(width[:, None], at).min(axis=1, initial=np.inf)
    cuts: list[tuple[Ints, Floats]] = []
    for row in np.flatnonzero((lowest < -NEGATIVE) & (span > 0)).tolist():
        roots = np.roots(np.trim_zeros(width[row, ::-1], "f"))
        ends = np.sort(roots[np.isreal(roots)].real)
        start = sections.start[section[row]] + offset[row]
        inside = ends[(ends > 0) & (ends < span[row])]
        cuts.append((np.full(len(inside), section[row]), start + inside))
        what = f"its width is negative ({lowest[row]:g} m), which counts as 0"
        document.warnings.append(f"{lanes.name(document, int(lane[row]))}: {what}")
    return cuts


def _shifted(coefficients: Floats, by: Floats) -> Floats:
    """Return cubic polynomials after a shift of their variable by ``by``."""
    return np.stack(
        (
            cubic(coefficients, by),
            cubic_slope(coefficients, by),
            cubic_bend(coefficients, by) / 2,
            coefficients[:, 3],
        ),
        axis=1,
    )


def _along_road(
    document: Document, kind: str, lanes: LaneTable, intervals: _LaneIntervals
) -> Floats:
    """Return the cubic polynomial of a road property (such as elevation) in each road interval, (n, 4)."""
    middle = (intervals.start + intervals.end) / 2
    at = document.numbers(kind, "s")
    record = last_before(document[kind].road, at, lanes.sections.road[intervals.section], middle)
    found = np.flatnonzero(record >= 0)
    result = np.zeros((len(middle), 4))
    by = np.maximum(intervals.start[found] - at[record[found]], 0.0)
    result[found] = _shifted(coefficients_of(document, kind)[record[found]], by)
    return result


@dataclass(frozen=True, slots=True)
class _LaneBorders:
    """Outer and inner borders of lanes, as cubic polynomials on intervals of the road."""

    first: Ints  # (L + 1,): start of the rows of each lane, one row per interval of its section
    interval: Ints
    inner: Floats
    outer: Floats


def _borders(
    document: Document, lanes: LaneTable, intervals: _LaneIntervals, centre: Floats
) -> _LaneBorders:
    counts = np.diff(intervals.first)[lanes.section]
    lane, number = ragged(counts)
    first = starts_of(counts)
    interval = intervals.first[lanes.section[lane]] + number
    middle = (intervals.start[interval] + intervals.end[interval]) / 2
    within = middle - lanes.sections.start[lanes.section[lane]]
    start = intervals.start[interval] - lanes.sections.start[lanes.section[lane]]
    width, has_width = _of_lanes(document, "width", lanes, (lane, within, start))
    border, has_border = _of_lanes(document, "border", lanes, (lane, within, start))
    half = (intervals.end - intervals.start)[interval] / 2
    width[cubic(width, half) < -NEGATIVE] = 0.0
    width *= np.sign(lanes.ident)[lane][:, None]
    by_border = has_border & ~has_width
    inner, outer = np.empty_like(width), np.empty_like(width)
    rank = lanes.rank[lane]
    by_rank = np.argsort(rank, kind="stable")
    ends = np.searchsorted(rank[by_rank], np.arange(rank.max(initial=-1) + 2))
    for begin, end in pairwise(ends):
        rows = by_rank[begin:end]
        below = lanes.inner[lane[rows]]
        inner[rows] = outer[first[below] + number[rows]] if begin else centre[interval[rows]]
        outer[rows] = np.where(by_border[rows][:, None], border[rows], inner[rows] + width[rows])
    between = cubic(outer, half) - cubic(inner, half)
    crossed = by_border & (between * np.sign(lanes.ident)[lane] < -NEGATIVE)
    for row in np.unique(lane[crossed]).tolist():
        what = "its border is on the wrong side of the lane inside it"
        document.warnings.append(f"{lanes.name(document, row)}: {what}")
    return _LaneBorders(first, interval, inner, outer)


def _of_lanes(
    document: Document, tag: str, lanes: LaneTable, at: tuple[Ints, Floats, Floats]
) -> tuple[Floats, Bools]:
    """Return the cubic polynomial of lane widths or borders at some positions, and a mask of known ones."""
    kind = f"road/laneSection/lane/{tag}"
    lane, middle, start = at
    of = lanes.row[document[kind].of]
    offset = document.numbers(kind, "sOffset", 0.0)
    record = last_before(of, offset, lane, middle)
    has = record >= 0
    result = np.zeros((len(lane), 4))
    coefficients = coefficients_of(document, kind)[record[has]]
    result[has] = _shifted(coefficients, np.maximum(start[has] - offset[record[has]], 0.0))
    return result, has


def _pieces(
    document: Document,
    lanes: LaneTable,
    plan: PlanView,
    parts: tuple[_LaneIntervals, _LaneBorders, Floats],
) -> tuple[Ints, Ints]:
    """Return the number of straight pieces of each road interval, and the row of its reference line record."""
    intervals, borders, heights = parts
    length = intervals.end - intervals.start
    road = lanes.sections.road[intervals.section]
    record = last_before(plan.road, plan.s, road, (intervals.start + intervals.end) / 2)
    share = np.linspace(0.0, 1.0, _SAMPLES)
    places = (intervals.start[:, None] + length[:, None] * share).ravel()
    curvature = poses(plan, np.repeat(record, _SAMPLES), places).curvature.reshape(-1, _SAMPLES)
    rate = np.ptp(curvature, axis=1) / np.maximum(length, _SAME_PLACE)
    at = length[borders.interval][:, None] * np.array([0.0, 0.5, 1.0])
    kappa = curvature[borders.interval][:, [0, _SAMPLES // 2, -1]]
    sharpest = np.abs(curvature).max(axis=1)[borders.interval][:, None]
    # An overflow is infinite: such roads are rejected below.
    with np.errstate(over="ignore", invalid="ignore"):
        bend = np.zeros(len(length))
        for side in (borders.inner, borders.outer):
            cubics = side[:, None, :]
            t, slope = cubic(cubics, at), np.abs(cubic_slope(cubics, at))
            # |p''| of p = r + t n, with r'' = κ n and n' = -κ r', is at most
            # |κ (1 - κ t)| + 2 |κ t'| + |κ' t| + |t''|.
            bound = sharpest * np.abs(1 - kappa * t) + 2 * sharpest * slope
            bound += rate[borders.interval][:, None] * np.abs(t) + np.abs(cubic_bend(cubics, at))
            np.maximum.at(bend, borders.interval, bound.max(axis=1))
        rise = np.abs(cubic_bend(heights[:, None, :], length[:, None] * np.array([0.0, 1.0])))
        steepest = np.maximum(bend / (8 * SAGITTA), rise.max(axis=1) / (8 * RISE))
        steepest = np.maximum(steepest, 1 / MAX_STEP**2)
        wanted = np.ceil(length * np.sqrt(steepest))
    wanted = np.where(np.isfinite(wanted), np.clip(wanted, 1, MAX_STATIONS), MAX_STATIONS)
    _bound(document, lanes, intervals, wanted)
    return wanted.astype(np.int64), record


def _bound(document: Document, lanes: LaneTable, intervals: _LaneIntervals, pieces: Floats) -> None:
    """Raise an error if the surface of a road, or of the whole map, needs too many pieces."""
    road = lanes.sections.road[intervals.section]
    lanes_here = np.bincount(lanes.section, minlength=len(lanes.sections.start)) + 1.0
    points = (pieces + 1) * lanes_here[intervals.section]
    total = np.bincount(road, points, minlength=len(document["road"]))
    many = f"so bent, long or finely recorded that it takes over {MAX_STATIONS:,} points"
    document.accuse("road", total > MAX_STATIONS, many)
    document.settle()
    most = min(max(MAX_OF_SMALL, document.characters // CHARACTERS), MAX_TOTAL)
    if points.sum() > most:
        raise MapError(f"takes over {most:,} points", element="OpenDRIVE")


_Stations = tuple["Ints", "Ints", "Floats", Poses, "Floats"]
"""Positions of cross sections, sorted by section and s: first position of each section (sections + 1,), then
interval, s, pose and z of each position."""


def _stations(
    plan: PlanView, parts: tuple[_LaneIntervals, _LaneBorders, Floats], pieces: Ints, record: Ints
) -> _Stations:
    intervals, borders, heights = parts
    interval, number = ragged(pieces + 1)
    length = (intervals.end - intervals.start)[interval]
    into = length * number / pieces[interval]
    s = intervals.start[interval] + into
    pose = poses(plan, record[interval], s)
    # The last station before a cut is dropped, unless there is a jump or corner.
    ends = np.cumsum(pieces + 1) - 1
    inner_cut = np.flatnonzero(np.diff(intervals.section) == 0)
    before, after = ends[inner_cut], ends[inner_cut] + 1
    jump = np.hypot(pose.x[after] - pose.x[before], pose.y[after] - pose.y[before])
    reach, step, corner = _lateral_jumps(intervals, borders)
    turn = 2 * np.abs(np.sin((pose.heading[after] - pose.heading[before]) / 2))
    jump += turn * reach[inner_cut] + step[inner_cut]
    keep = np.ones(len(s), bool)
    keep[before[(jump < JUMP) & (turn + corner[inner_cut] < CORNER)]] = False
    z = cubic(heights[interval], into)
    kept = Poses(pose.x[keep], pose.y[keep], pose.heading[keep], pose.curvature[keep])
    counts = np.bincount(intervals.section[interval[keep]], minlength=len(intervals.first) - 1)
    return starts_of(counts), interval[keep], s[keep], kept, z[keep]


def _lateral_jumps(
    intervals: _LaneIntervals, borders: _LaneBorders
) -> tuple[Floats, Floats, Floats]:
    """Return, at the end of each interval, the largest offset, jump and bend of lane borders."""
    n = len(intervals.section)
    length = (intervals.end - intervals.start)[borders.interval]
    reach, step, corner = np.zeros(n), np.zeros(n), np.zeros(n)
    for side in (borders.inner, borders.outer):
        at_end = cubic(side, length)
        np.maximum.at(reach, borders.interval, np.abs(at_end))
        rows = np.flatnonzero(np.diff(borders.interval) == 1)
        np.maximum.at(step, borders.interval[rows], np.abs(side[rows + 1, 0] - at_end[rows]))
        slope = cubic_slope(side, length)
        np.maximum.at(corner, borders.interval[rows], np.abs(side[rows + 1, 1] - slope[rows]))
    return reach, step, corner


def surface(document: Document, lanes: LaneTable, plan: PlanView) -> Ribbons:
    """Compute the surfaces of all OpenDRIVE lanes, as cross sections along the lanes.

    Raises
    ------
    Spoiled
        Some roads are too bent, too long, or too far away.
    MapError
        The map needs too many points in total.
    """
    intervals = _intervals(document, lanes, plan)
    _bound(document, lanes, intervals, np.ones(len(intervals.section)))
    centre = _along_road(document, "road/laneOffset", lanes, intervals)
    heights = _along_road(document, "road/elevation", lanes, intervals)
    borders = _borders(document, lanes, intervals, centre)
    document.settle()
    parts = (intervals, borders, heights)
    pieces, record = _pieces(document, lanes, plan, parts)
    stations = _stations(plan, parts, pieces, record)
    ribbons = _cross_sections(lanes, intervals, borders, stations)
    columns = (ribbons.left_x, ribbons.left_y, ribbons.right_x, ribbons.right_y, ribbons.z)
    wild = np.zeros(len(ribbons.z), bool)
    for column in columns:
        wild |= ~(np.abs(column) < MAX_COORDINATE)
    lane = np.searchsorted(ribbons.offsets, np.flatnonzero(wild), side="right") - 1
    roads = _marked(lanes.road[lane], len(document["road"]))
    document.accuse("road", roads, f"reaches farther than {MAX_COORDINATE:.0e} m from the origin")
    document.settle()
    return ribbons


def heights(
    document: Document, lanes: LaneTable, ribbons: Ribbons
) -> Callable[[Ints, Floats], Floats] | None:
    """Return a function from lane and position along it to the height (m); ``None`` if the map has no heights.

    Between cross sections a lane is straight. This is exact enough for heights, but not for slopes.
    ``ribbons`` can have more lanes, without a road.
    """
    kind = "road/elevation"
    road, at, cubics = (
        document[kind].road,
        document.numbers(kind, "s"),
        coefficients_of(document, kind),
    )
    if not len(road):
        return None

    def height(lane: Ints, along: Floats) -> Floats:
        found = ribbons.height(lane, along)
        rows = np.flatnonzero(lane < len(lanes))
        s = ribbons.between(lane[rows], along[rows], ribbons.s)
        record = last_before(road, at, lanes.road[lane[rows]], s)
        rows, s, record = rows[record >= 0], s[record >= 0], record[record >= 0]
        found[rows] = cubic(cubics[record], np.maximum(s - at[record], 0.0))
        return found

    return height


def _cross_sections(
    lanes: LaneTable, intervals: _LaneIntervals, borders: _LaneBorders, stations: _Stations
) -> Ribbons:
    first, interval, s, pose, z = stations
    counts = np.diff(first)[lanes.section]
    lane, number = ragged(counts)
    offsets = starts_of(counts)
    forward = lanes.forward[lane]
    number = np.where(forward, number, counts[lane] - 1 - number)
    at = first[lanes.section[lane]] + number
    interval, s = interval[at], s[at]
    row = borders.first[lane] + interval - intervals.first[intervals.section[interval]]
    into = s - intervals.start[interval]
    inner, outer = cubic(borders.inner[row], into), cubic(borders.outer[row], into)
    middle = (inner + outer) / 2
    slope = (cubic_slope(borders.inner[row], into) + cubic_slope(borders.outer[row], into)) / 2
    x, y = pose.x[at], pose.y[at]
    direction, bend = pose.heading[at], pose.curvature[at]
    turned = np.arctan2(slope, 1 - bend * middle) + np.where(forward, 0.0, np.pi)
    to_left_x, to_left_y = -np.sin(direction), np.cos(direction)
    inner_is_left = (lanes.ident[lane] < 0) == forward
    left, right = np.where(inner_is_left, (inner, outer), (outer, inner))
    centre_x, centre_y = x + middle * to_left_x, y + middle * to_left_y
    step = np.hypot(np.diff(centre_x, prepend=0.0), np.diff(centre_y, prepend=0.0))
    step[offsets[:-1]] = 0.0
    run = np.cumsum(step)
    return Ribbons(
        offsets=offsets,
        left_x=x + left * to_left_x,
        left_y=y + left * to_left_y,
        right_x=x + right * to_left_x,
        right_y=y + right * to_left_y,
        z=z[at],
        heading=direction + turned,
        s=s,
        along=run - run[offsets[:-1]][lane],
    )
