"""Plain lanes → ``RoadMap``, and their cross sections from lines.

A plain lane is its cross sections in the direction of travel and the lanes that it is related to. All else
that a :class:`~sgstore.roads.RoadMap` holds follows: roads, junctions, turns, conflicts, lengths and widths.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.columns import chained
from sgstore.roads._courses import lane_courses
from sgstore.roads._map import STOREY, LaneChanges, MapEdges, MapNodes, RoadMap, turn_words
from sgstore.roads._places import broad_lines
from sgstore.roads._ribbons import Ribbons, conflicts, mean_widths, turned, wrapped
from sgstore.vocabulary import DRIVING, RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.world import Bools, Floats, Ints


_SIDEWAYS: Final = 0.9
"""A step of which a larger share than this goes across the lane is a jump."""
_FIRST_LANE: Final = 1
"""Row of the first lane among the nodes: ``off_road`` comes before it."""


@dataclass(frozen=True, slots=True)
class PlainLane:
    """A lane. Other lanes are named by their number in the list that this one stands in.

    Attributes
    ----------
    name, type, road, junction : str
        As :class:`~sgstore.roads.MapNodes` has them.
    section, number : int
        Section and lane number in the road; 0 where there is none.
    left, right : (n, 2) float64
        Ends of the cross sections, in the direction of travel; m. Two at least.
    z : (n,) float64
        Heights of the cross sections; m.
    onto : tuple of int
        Lanes that traffic flows on to.
    left_beside, right_beside : tuple of int
        Lanes that lie beside it, as its own traffic sees them.
    against : tuple of int
        Those of them whose traffic comes the other way.
    changes : tuple of (int, float, float)
        Lanes that traffic may change to, from where to where along this one; m.
    speed_limit : float
        m/s; NaN where there is none.
    roundabout : str
        The one that its road is in; empty: none.
    broad : tuple of str
        ``left``, ``right``: sides on which a broad marking bounds it.
    """

    name: str
    type: str
    road: str
    junction: str
    section: int
    number: int
    left: Floats
    right: Floats
    z: Floats
    onto: tuple[int, ...] = ()
    left_beside: tuple[int, ...] = ()
    right_beside: tuple[int, ...] = ()
    against: tuple[int, ...] = ()
    changes: tuple[tuple[int, float, float], ...] = ()
    speed_limit: float = np.nan
    roundabout: str = ""
    broad: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PlainSignal:
    """A traffic light or sign.

    Attributes
    ----------
    name, kind : str
        Its id, and one of :data:`sgstore.vocabulary.SIGNALS`.
    x, y, z, heading : float
        Where it stands and faces; m, rad. NaN: not known.
    lanes : tuple of int
        Lanes that it applies to, by their number.
    stops : tuple of (int, float)
        Lanes on which it has a place, as the line before which one waits, and where along them; m.
    is_stop_line : bool
        Whether it is a line painted on the road.
    line : (n, 2) float64
        Its own line; m. Empty: it is a place.
    speed_limit : float
        m/s; NaN where it tells none.
    """

    name: str
    kind: str
    x: float = np.nan
    y: float = np.nan
    z: float = np.nan
    heading: float = np.nan
    lanes: tuple[int, ...] = ()
    stops: tuple[tuple[int, float], ...] = ()
    is_stop_line: bool = False
    line: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    speed_limit: float = np.nan


@dataclass(frozen=True, slots=True)
class PlainCrosswalk:
    """A place where people cross.

    Attributes
    ----------
    name : str
    outline : (n, 2) float64
        Corners all around; m. Three at least.
    z : float
        Its height; m.
    """

    name: str
    outline: Floats
    z: float


@dataclass(frozen=True, slots=True)
class PlainObject(PlainCrosswalk):
    """What stands beside the lanes, by its outline on the ground.

    Attributes
    ----------
    name, outline, z
        As of :class:`PlainCrosswalk`.
    kind : str
        One of :data:`OBJECT_KINDS`.
    """

    kind: str


OBJECT_KINDS: Final = ("building", "vegetation", "prop")


def road_map_of(
    lanes: Sequence[PlainLane],
    signals: Sequence[PlainSignal] = (),
    crosswalks: Sequence[PlainCrosswalk] = (),
    objects: Sequence[PlainObject] = (),
    *,
    name: str,
    text: str,
    warnings: Iterable[str] = (),
) -> RoadMap:
    """The road map of plain lanes, signals, crosswalks and objects; ``text`` is what they were read from.

    Raises
    ------
    MapError
        A junction has more lanes than can be looked at in pairs.
    """
    ribbons = ribbons_of(lanes)
    surfaces = plain_nodes(lanes, ribbons)
    roads, junctions = _road_nodes(lanes, ribbons), _junction_nodes(lanes)
    off_road = MapNodes.of("off_road", ["off_road"])
    larger = [junctions, _roundabout_nodes(lanes)]
    before = [off_road, surfaces, roads, *larger, _crosswalk_nodes(crosswalks)]
    nodes = chained([*before, _signal_nodes(signals), _object_nodes(objects)])
    first = sum(map(len, before))
    shapes = np.full(len(nodes), None, object)
    outlines = [shapely.Polygon(crosswalk.outline) for crosswalk in crosswalks]
    lines = [shapely.LineString(s.line) if len(s.line) > 1 else None for s in signals]
    grounds = [shapely.Polygon(one.outline) for one in objects]
    shapes[first - len(outlines) :] = [*outlines, *lines, *grounds]
    return RoadMap(
        name=name,
        text=text,
        nodes=nodes,
        edges=_edges(lanes, ribbons, roads, larger, signals, first),
        ribbons=ribbons,
        shapes=shapes,
        lane_changes=_lane_changes(lanes),
        warnings=warnings,
        stops=_stops(signals, first),
        stop_lines=np.array([first + r for r, s in enumerate(signals) if s.is_stop_line], np.int64),
        # Formats of lanes as lines have 0 where a point has no height.
        courses=lane_courses(ribbons, ribbons.height if ribbons.z.any() else None),
        broad_lines=broad_lines(
            [
                (row, side == "left", 0.0, float(length))
                for row, (lane, length) in enumerate(zip(lanes, ribbons.lengths, strict=True))
                for side in lane.broad
            ]
        ),
    )


def _stops(signals: Sequence[PlainSignal], first: int) -> tuple[Ints, Ints, Floats]:
    """Signals, as columns among the nodes, lanes on which they have a place, and where."""
    rows = [(first + row, *stop) for row, signal in enumerate(signals) for stop in signal.stops]
    column, lane = np.array([one[:2] for one in rows], np.int64).reshape(-1, 2).T
    return column, lane, np.array([along for *_, along in rows], np.float64)


def ribbons_of(lanes: Sequence[PlainLane]) -> Ribbons:
    """The surface of plain lanes."""
    counts = np.array([len(lane.z) for lane in lanes], np.int64)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    left = np.concatenate([np.zeros((0, 2)), *(lane.left for lane in lanes)])
    right = np.concatenate([np.zeros((0, 2)), *(lane.right for lane in lanes)])
    x, y = ((left + right) / 2).T
    first = np.zeros(len(x), np.bool_)
    first[offsets[:-1]] = True
    run_x, run_y = np.diff(x, prepend=0.0), np.diff(y, prepend=0.0)
    step = np.where(first, 0.0, np.hypot(run_x, run_y))
    run = np.cumsum(step)
    along = run - np.repeat(run[offsets[:-1]], counts)
    # Where a lane jumps to the side, no traffic goes that way.
    across_x, across_y = (left - right).T
    aside = np.abs(run_x * across_x + run_y * across_y)
    width = np.hypot(across_x, across_y)
    jumps = (width > 0) & (aside > _SIDEWAYS * step * width)
    square = np.arctan2(-across_x, across_y)
    return Ribbons(
        offsets=offsets,
        left_x=left[:, 0],
        left_y=left[:, 1],
        right_x=right[:, 0],
        right_y=right[:, 1],
        z=np.concatenate([np.zeros(0), *(lane.z for lane in lanes)]),
        heading=headings(x, y, first | jumps, square),
        s=along,
        along=along,
    )


def headings(x: Floats, y: Floats, first: Bools, alone: Floats | None = None) -> Floats:
    """Headings of polylines at their points: (N,), not wrapped; ``first`` marks where each line begins.

    A line of one point has that of ``alone``. Within a line it is the mean of the two pieces' directions,
    weighted by their lengths, so that the cubic through points and headings strays from neither far; at an end
    it is what the nearest piece would have if it were part of a circle.
    """
    if not len(x):
        return np.zeros(0)
    inner = ~first[1:]
    length = np.where(inner, np.hypot(np.diff(x), np.diff(y)), 0.0)
    direction = np.arctan2(np.diff(y), np.diff(x))
    before, after = np.append(0.0, length), np.append(length, 0.0)
    into, out = np.append(0.0, direction), np.append(direction, 0.0)
    turn = wrapped(out - into)
    total = before + after
    both = (before > 0) & (after > 0)
    share = after / np.where(total > 0, total, 1.0)
    heading = np.where(both, into + turn * share, np.where(after > 0, out, into))
    if alone is not None:
        heading = np.where(total > 0, heading, alone)
    # A line's ends: as far beyond the piece's direction as its other end is before it.
    starts, ends = np.flatnonzero(~both & (after > 0)), np.flatnonzero(~both & (before > 0))
    for rows, others, pieces in ((starts, starts + 1, out), (ends, ends - 1, into)):
        bend = wrapped(heading[others] - pieces[rows])
        curved = both[others] & (np.abs(bend) < np.pi / 4)
        heading[rows] = pieces[rows] - np.where(curved, bend, 0.0)
    return heading


def plain_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """The nodes of plain lanes with these surfaces."""
    every, length = np.arange(len(ribbons)), ribbons.lengths
    middle = ribbons.at(every, length / 2)
    turns = turn_words(turned(ribbons))
    return MapNodes.of(
        "lane",
        [lane.name for lane in lanes],
        x=middle.x,
        y=middle.y,
        z=middle.z,
        heading=middle.heading,
        lane_type=tuple(lane.type for lane in lanes),
        road=tuple(lane.road for lane in lanes),
        junction=tuple(lane.junction for lane in lanes),
        turn=tuple(word if lane.junction else "" for word, lane in zip(turns, lanes, strict=True)),
        section=np.array([lane.section for lane in lanes], np.int64),
        lane=np.array([lane.number for lane in lanes], np.int64),
        length=length,
        width=mean_widths(ribbons),
        speed_limit=np.array([lane.speed_limit for lane in lanes], np.float64),
    )


def _road_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """Roads in the order of their first lanes; a road is as long as the longest lanes of its sections."""
    junction: dict[str, str] = {}
    longest: dict[str, dict[int, float]] = {}
    for lane, length in zip(lanes, ribbons.lengths.tolist(), strict=True):
        junction.setdefault(lane.road, lane.junction)
        sections = longest.setdefault(lane.road, {})
        sections[lane.section] = max(sections.get(lane.section, 0.0), length)
    names = tuple(junction)
    return MapNodes.of(
        "road",
        names,
        length=np.array([sum(longest[name].values()) for name in names], np.float64),
        road=names,
        junction=tuple(junction.values()),
    )


def _junction_nodes(lanes: Sequence[PlainLane]) -> MapNodes:
    names = tuple(dict.fromkeys(lane.junction for lane in lanes if lane.junction))
    return MapNodes.of("junction", names, junction=names)


def _roundabout_nodes(lanes: Sequence[PlainLane]) -> MapNodes:
    return MapNodes.of(
        "roundabout", tuple(dict.fromkeys(lane.roundabout for lane in lanes if lane.roundabout))
    )


def _crosswalk_nodes(crosswalks: Sequence[PlainCrosswalk]) -> MapNodes:
    middles = np.array([one.outline.mean(axis=0) for one in crosswalks]).reshape(-1, 2)
    z = np.array([one.z for one in crosswalks], np.float64)
    names = [one.name for one in crosswalks]
    return MapNodes.of("crosswalk", names, x=middles[:, 0], y=middles[:, 1], z=z)


def _object_nodes(objects: Sequence[PlainObject]) -> MapNodes:
    """Objects as the smallest boxes around them, which look along their longer side."""
    boxes = [shapely.Polygon(one.outline).minimum_rotated_rectangle for one in objects]
    sides = np.array([np.diff(shapely.get_coordinates(box)[:3], axis=0) for box in boxes])
    sides = sides.reshape(-1, 2, 2)
    long = np.hypot(sides[..., 0], sides[..., 1])
    longer = np.take_along_axis(sides, long.argmax(axis=1)[:, None, None], axis=1)[:, 0]
    middles = np.array([shapely.get_coordinates(box.centroid)[0] for box in boxes]).reshape(-1, 2)
    return MapNodes.of(
        [one.kind for one in objects],
        [one.name for one in objects],
        x=middles[:, 0],
        y=middles[:, 1],
        z=np.array([one.z for one in objects], np.float64),
        heading=np.arctan2(longer[:, 1], longer[:, 0]),
        length=long.max(axis=1, initial=0.0),
        width=long.min(axis=1, initial=np.inf),
    )


def _signal_nodes(signals: Sequence[PlainSignal]) -> MapNodes:
    columns = {
        name: np.array([getattr(signal, name) for signal in signals], np.float64)
        for name in ("x", "y", "z", "heading", "speed_limit")
    }
    kinds = [signal.kind for signal in signals]
    return MapNodes.of(kinds, [signal.name for signal in signals], **columns)


def _edges(
    lanes: Sequence[PlainLane],
    ribbons: Ribbons,
    roads: MapNodes,
    larger: Sequence[MapNodes],
    signals: Sequence[PlainSignal],
    first_signal: int,
) -> MapEdges:
    first_road = _FIRST_LANE + len(lanes)
    road = {name: first_road + row for row, name in enumerate(roads.name)}
    first = first_road + len(roads)
    junction, roundabout = (
        {name: begin + row for row, name in enumerate(nodes.name)}
        for nodes, begin in zip(larger, (first, first + len(larger[0])), strict=True)
    )
    within = [(_FIRST_LANE + row, road[lane.road]) for row, lane in enumerate(lanes)]
    within += [(road[r], junction[j]) for r, j in zip(roads.name, roads.junction, strict=True) if j]
    within += {(road[lane.road], roundabout[lane.roundabout]) for lane in lanes if lane.roundabout}
    flow = _spread([lane.onto for lane in lanes])
    crossing = [row for row, lane in enumerate(lanes) if lane.junction and lane.type in DRIVING]
    one, other = conflicts(
        ribbons,
        np.array(crossing, np.int64),
        [lane.junction for lane in lanes],
        (flow[:, 0], flow[:, 1]),
        STOREY,
    )
    against = _spread([lane.against for lane in lanes])
    change = np.array(
        [(row, to) for row, lane in enumerate(lanes) for to, _, _ in lane.changes], np.int64
    ).reshape(-1, 2)
    among_lanes = {
        "travelsTo": flow,
        "laneChange": change,
        "toLeftOf": _spread([lane.left_beside for lane in lanes])[:, ::-1],
        "toRightOf": _spread([lane.right_beside for lane in lanes])[:, ::-1],
        "opposes": np.concatenate((against, against[:, ::-1])),
        "conflictsWith": np.column_stack((np.append(one, other), np.append(other, one))),
    }
    parts = {"isIn": np.array(within, np.int64).reshape(-1, 2)}
    parts |= {relation: _FIRST_LANE + pairs for relation, pairs in among_lanes.items()}
    controls = [
        (first_signal + row, _FIRST_LANE + lane)
        for row, signal in enumerate(signals)
        for lane in signal.lanes
        if lanes[lane].type in DRIVING
    ]
    parts["controlsTrafficOf"] = np.array(controls, np.int64).reshape(-1, 2)
    return edges_of([(relation, pairs[:, 0], pairs[:, 1]) for relation, pairs in parts.items()])


Edge = tuple[str, "Ints", "Ints"]
"""A relation, and the rows of its sources and destinations among the nodes."""


def edges_of(parts: Sequence[Edge]) -> MapEdges:
    """Edges among rows of nodes as edges among node ids, each once, ordered."""
    code = np.concatenate([np.full(len(src), RELATION_CODE[name]) for name, src, _ in parts])
    src = np.concatenate([s for _, s, _ in parts])
    dst = np.concatenate([d for _, _, d in parts])
    table = np.unique(np.column_stack((code, src, dst)), axis=0).reshape(-1, 3)
    return MapEdges(table[:, 0].astype(np.int8), -1 - table[:, 1], -1 - table[:, 2])


def _spread(groups: Sequence[tuple[int, ...]]) -> Ints:
    """(n, 2): each row's number with each of its group."""
    row = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return np.column_stack((row, np.array([*chain(*groups)], np.int64)))


def _lane_changes(lanes: Sequence[PlainLane]) -> LaneChanges:
    rows = [(row, *change) for row, lane in enumerate(lanes) for change in lane.changes]
    if not rows:
        return LaneChanges.none()
    lane, to, start, end = zip(*sorted(rows), strict=True)
    return LaneChanges(
        np.array(lane, np.int64), np.array(to, np.int64), np.array(start), np.array(end)
    )


# Cross sections of lanes that are told as lines: a centre line and its borders --------------------

APART: Final = 0.05
"""Least distance between points of a line that are kept, and between cross sections; m."""
WIDE: Final = 3.5
"""Width of a lane of which nothing tells how wide it is; m."""
NEIGHBOURS: Final = (2.0, 6.0)
"""Distances of centre lines between which lanes side by side tell how wide they are; m."""
_LOOKS: Final = 9
"""Places along a lane at which the distance of those beside it is looked at."""
_STEP: Final = 1.0
"""Distance of the cross sections of a way through an area; m."""
_FEW: Final = 20_000
"""Pairs of a place and a piece of a line up to which looking at all of them takes less than a tree."""
_AHEAD: Final = 0.2, 0.1, 0.5
"""How far ahead or behind a cross section the end of a border may be that is taken for it: so many metres, and
this share of its distance to the side; at the ends of a lane, which need not be square, this share of it."""


@dataclass(frozen=True, slots=True)
class Sections:
    """Cross sections along a line, in its own direction; shape (n, 2) and (n,)."""

    left: Floats
    right: Floats
    z: Floats
    middle: Floats = field(init=False)
    """(n, 2): the centre line."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "middle", (self.left + self.right) / 2)

    def turned_round(self) -> Sections:
        """The same against the line's direction."""
        return Sections(self.right[::-1], self.left[::-1], self.z[::-1])

    def up_to(self, left: Floats, right: Floats, z: float) -> Sections:
        """The same with one more cross section at the end of the line."""
        return Sections(
            np.vstack((self.left, left)), np.vstack((self.right, right)), np.append(self.z, z)
        )


def thinned(line: Floats) -> Floats:
    """A line (n, 3) without points that are closer than :data:`APART` to the one before; its end stays."""
    if len(line) < 2:
        return line
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    if (step >= APART).all():
        return line
    kept, run = [0], 0.0
    for number, length in enumerate(step.tolist(), 1):
        run += length
        if run >= APART:
            kept.append(number)
            run = 0.0
    if kept[-1] != len(line) - 1 and len(kept) > 1:
        kept[-1] = len(line) - 1
    return line[kept]


def run_of(line: Floats) -> Floats:
    """(n,): length of a line (n, 2 or 3) up to each of its points, as seen from above; m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))))


@dataclass(frozen=True, slots=True)
class Feet:
    """The points of lines that are nearest to some places; shape (n,) and (n, 2).

    ``along``: length of the line up to there, lines laid end to end. ``is_end``: it is the end of a line.
    """

    at: Floats
    along: Floats
    is_end: Bools


def sections_between(left: Floats, right: Floats) -> Sections:
    """Cross sections of a lane from its two borders, by shares of their lengths, at every point of both.

    Parameters
    ----------
    left, right : (n, 3) and (m, 3) float64
        In the direction of the lane, thinned; two points at least.

    Notes
    -----
    Points of both that lie across from one another, to :data:`APART`, are the ends of one cross section, so
    that the outline of the lane is that of its borders.
    """
    runs = run_of(left), run_of(right)
    shares = [run / run[-1] for run in runs]
    near = APART / max(runs[0][-1], runs[1][-1])
    here = there = 0
    pairs: list[tuple[float, float]] = []
    while here < len(left) or there < len(right):
        one = shares[0][here] if here < len(left) else np.inf
        other = shares[1][there] if there < len(right) else np.inf
        both = abs(one - other) <= near
        pairs.append((one if both else min(one, other), other if both else min(one, other)))
        here += bool(both or one < other)
        there += bool(both or other < one)
    at = np.maximum.accumulate(np.array(pairs), axis=0).T
    ends = [
        np.column_stack([np.interp(along, share, column) for column in line.T])
        for along, share, line in zip(at, shares, (left, right), strict=True)
    ]
    return Sections(ends[0][:, :2], ends[1][:, :2], (ends[0][:, 2] + ends[1][:, 2]) / 2)


def feet(places: Floats, lines: Sequence[Floats]) -> Feet:
    """Nearest points on lines to places (n, 2); each line has two different points at least."""
    start = np.concatenate([line[:-1, :2] for line in lines])
    way = np.concatenate([line[1:, :2] for line in lines]) - start
    x, y = places.T
    squared = np.maximum(way[:, 0] ** 2 + way[:, 1] ** 2, 1e-18)
    if len(places) * len(start) <= _FEW:
        away_x, away_y = x[:, None] - start[:, 0], y[:, None] - start[:, 1]
        shares = (away_x * way[:, 0] + away_y * way[:, 1]) / squared
        shares = np.minimum(np.maximum(shares, 0.0), 1.0)
        away_x -= shares * way[:, 0]
        away_y -= shares * way[:, 1]
        piece = np.argmin(away_x * away_x + away_y * away_y, axis=1)
    else:
        pieces: Any = shapely.linestrings(np.stack((start, start + way), axis=1))
        points: Any = shapely.points(places)
        _, piece = shapely.STRtree(pieces).query_nearest(points, all_matches=False)
    begin, step = start[piece], way[piece]
    share = ((x - begin[:, 0]) * step[:, 0] + (y - begin[:, 1]) * step[:, 1]) / squared[piece]
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    length = np.sqrt(squared)
    before = np.cumsum(length) - length
    first = np.zeros(len(start) + 1, np.bool_)
    first[np.cumsum([0, *(len(line) - 1 for line in lines)])] = True
    is_end = ((share <= 0) & first[piece]) | ((share >= 1) & first[piece + 1])
    return Feet(begin + share[:, None] * step, before[piece] + share * length[piece], is_end)


def along_line(line: Floats, places: Floats) -> Floats:
    """(n,): lengths of a line up to its points nearest to places (n, 2); m."""
    return feet(places, [line]).along


def cross_sections(
    centre: Floats, lefts: Sequence[Floats], rights: Sequence[Floats], half: float
) -> tuple[Sections, bool]:
    """Cross sections of a lane, and whether its borders say how wide it is.

    Parameters
    ----------
    centre : (n, 3) float64
        Centre line, thinned; two points at least.
    lefts, rights : sequence of (k, 3) float64
        Borders to its left and right, thinned, as many pieces as there are, in any order. Where only one
        side has any, the other lies as far away; where none has, both lie ``half`` away.
    half : float
        m.
    """
    run = run_of(centre)
    at = _cuts(run, [along_line(centre, line[:, :2]) for line in (*lefts, *rights)])
    x, y, z = (np.interp(at, run, column) for column in centre.T)
    first = np.zeros(len(at), np.bool_)
    first[0] = True
    heading = headings(x, y, first)
    ahead = np.column_stack((np.cos(heading), np.sin(heading)))
    to_left = np.column_stack((-ahead[:, 1], ahead[:, 0]))
    places = np.column_stack((x, y))
    sides = [
        _side(places, ahead, sign * to_left, borders)
        for sign, borders in ((1.0, lefts), (-1.0, rights))
    ]
    told = any(side is not None for side in sides)
    one, other = sides if told else (None, None)
    plain = np.full(len(at), half)
    left_away = one.away if one else other.away if other else plain
    right_away = other.away if other else left_away
    left = one.points if one else places + to_left * left_away[:, None]
    right = other.points if other else places - to_left * right_away[:, None]
    return Sections(left, right, z), told


def _cuts(run: Floats, more: Sequence[Floats]) -> Floats:
    """Places along a line where it is cut: at its own points, and at others that are not too close to one."""
    inner = np.concatenate([run[1:-1], *more])
    own = np.arange(len(inner)) < len(run) - 2
    inside = (inner > APART) & (inner < run[-1] - APART)
    inner, own = inner[inside], own[inside]
    order = np.lexsort((~own, inner))
    inner = inner[order]
    if len(inner):
        kept = [float(inner[0])]
        for place in inner[1:].tolist():
            if place - kept[-1] >= APART:
                kept.append(place)
        inner = np.array(kept)
    return np.concatenate(([0.0], inner, [run[-1]]))


@dataclass(frozen=True, slots=True)
class _Side:
    points: Floats
    away: Floats


def _side(places: Floats, ahead: Floats, aside: Floats, borders: Sequence[Floats]) -> _Side | None:
    """Ends of the cross sections through places on one side; ``None`` if no border is beside any of them."""
    if not borders:
        return None
    found = feet(places, borders)
    nearest = found.at
    way = nearest - places
    away, beyond = (way * aside).sum(axis=1), (way * ahead).sum(axis=1)
    share = np.full(len(away), _AHEAD[1])
    share[[0, -1]] = _AHEAD[2]
    beside: Bools = ~found.is_end | (np.abs(beyond) <= _AHEAD[0] + share * np.abs(away))
    if not beside.any():
        return None
    rows: Ints = np.flatnonzero(beside)
    # Where a border is missing the lane stays as wide as it is beside the next piece of it.
    away = np.where(beside, away, np.interp(np.arange(len(away)), rows, away[rows]))
    points = np.where(beside[:, None], nearest, places + aside * away[:, None])
    return _Side(points, away)


def half_width(centre: Floats, others: Sequence[Floats]) -> float:
    """Half the width of a lane without borders, from the centre lines of the lanes beside it; m."""
    run = run_of(centre)
    places = np.linspace(0.0, run[-1], _LOOKS)
    middle = np.column_stack([np.interp(places, run, column) for column in centre[:, :2].T])
    gaps: list[float] = []
    for other in others:
        found = feet(middle, [other])
        length = run_of(other)[-1]
        beside = (found.along > 0) & (found.along < length)
        if beside.any():
            gap = float(np.median(np.hypot(*(found.at - middle)[beside].T)))
            gaps += [gap] * (NEIGHBOURS[0] <= gap <= NEIGHBOURS[1])
    return min(gaps, default=WIDE) / 2


def way_between(
    start: tuple[Floats, float, float, float], end: tuple[Floats, float, float, float]
) -> Sections:
    """A lane from one place to another: place (2,), heading, width and height at both ends.

    The cubic whose tangents are as long as they would be on a part of a circle of that turn.
    """
    (p0, heading0, width0, z0), (p1, heading1, width1, z1) = start, end
    chord = float(np.hypot(*(p1 - p0)))
    turn = abs(float(np.remainder(heading1 - heading0 + np.pi, 2 * np.pi) - np.pi))
    tangent = chord / np.cos(turn / 4) ** 2
    t0 = tangent * np.array((np.cos(heading0), np.sin(heading0)))
    t1 = tangent * np.array((np.cos(heading1), np.sin(heading1)))
    n = int(np.clip(chord / _STEP, 8, 64)) + 1
    t = np.linspace(0.0, 1.0, n)[:, None]
    place = (
        (1 + 2 * t) * (1 - t) ** 2 * p0
        + t * (1 - t) ** 2 * t0
        + t * t * (3 - 2 * t) * p1
        - t * t * (1 - t) * t1
    )
    slope = 6 * t * (t - 1) * (p0 - p1) + (1 - t) * (1 - 3 * t) * t0 + t * (3 * t - 2) * t1
    slope /= np.maximum(np.hypot(*slope.T), 1e-9)[:, None]
    share = t[:, 0]
    half = (width0 + share * (width1 - width0))[:, None] / 2
    to_left = np.column_stack((-slope[:, 1], slope[:, 0]))
    return Sections(place + to_left * half, place - to_left * half, z0 + share * (z1 - z0))


# Lines painted across lanes ----------------------------------------------------------------------

_ON_LANE: Final = 0.1
"""How far a stop line may be from the centre line of a lane to lie on it; m."""
_AT_START: Final = 0.5
"""A line this close to the start of a lane belongs to the lane before, if it lies on it too; m."""


def painted_across(lanes: Sequence[PlainLane], lines: Sequence[Floats]) -> list[dict[int, float]]:
    """The lanes of motor traffic on which each of some lines (n, 2 or 3) lies, and where along them; m.

    Where one lane ends and the next begins a line lies on the first.
    """
    found: list[dict[int, float]] = [{} for _ in lines]
    rows = [row for row, lane in enumerate(lanes) if lane.type in DRIVING]
    long = [number for number, line in enumerate(lines) if len(line) > 1]
    if not rows or not long:
        return found
    centres: Any = np.array(
        [shapely.LineString((lanes[row].left + lanes[row].right) / 2) for row in rows], object
    )
    painted: Any = np.array([shapely.LineString(lines[one][:, :2]) for one in long], object)
    line, lane = shapely.STRtree(centres).query(painted, predicate="dwithin", distance=_ON_LANE)
    nearest: Any = shapely.shortest_line(centres[lane], painted[line])
    places: Any = shapely.line_locate_point(centres[lane], shapely.get_point(nearest, 0))
    for one, row, along in zip(line.tolist(), lane.tolist(), places.tolist(), strict=True):
        found[long[one]][rows[row]] = along
    for places in found:
        onward = {to for row in places for to in lanes[row].onto}
        for row in [row for row, at in places.items() if at < _AT_START and row in onward]:
            del places[row]
    return found
