"""Conversion of lanes with cross sections, signals and objects to a road map.

A plain lane has its cross sections in the direction of travel and its related lanes. All other
parts of a :class:`~sgstore.maps.roads.RoadMap` follow from them: roads, junctions, turns, conflicts,
lengths and widths.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.base.tables import chained
from sgstore.maps.roads._conflicts import conflicts
from sgstore.maps.roads._courses import LaneCourses
from sgstore.maps.roads._map import LaneChanges, MapEdges, MapNodes, RoadMap, turn_words
from sgstore.maps.roads._places import MapPlaces
from sgstore.maps.roads._ribbons import Ribbons, wrapped
from sgstore.model.vocabulary import DRIVING, RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Bools, Floats, Ints


_SIDEWAYS: Final = 0.9
"""Share of a step that must go across the lane for the step to count as a jump."""
_FIRST_LANE: Final = 1
"""Row of the first lane among the map nodes, because row 0 is ``off_road``."""


@dataclass(frozen=True, slots=True)
class PlainLane:
    """Lane with cross sections, neighbours and successors. It does not depend on a map format.

    Attributes
    ----------
    name, type, road, junction : str
        As in :class:`~sgstore.maps.roads.MapNodes`.
    section, number : int
        Section and lane number in the road, or 0.
    left, right : (n, 2) float64
        Ends of the cross sections, in the direction of travel; m. At least two.
    z : (n,) float64
        Heights of the cross sections; m.
    onto : tuple of int
        Lanes that traffic flows on to.
    left_beside, right_beside : tuple of int
        Lanes next to it, seen in the direction of its traffic.
    against : tuple of int
        Its neighbours with oncoming traffic.
    changes : tuple of (int, float, float)
        Lanes that traffic may change to, with start and end along this lane; m.
    speed_limit : float
        m/s; NaN if there is no limit.
    roundabout : str
        The roundabout of its road, or empty.
    broad : tuple of str
        ``left``, ``right``: sides with a broad marking.
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

    @staticmethod
    def painted_across(
        lanes: Sequence[PlainLane], lines: Sequence[Floats]
    ) -> list[dict[int, float]]:
        """Return the driving lanes that painted lines (such as stop lines) cross, and the position along each.

        A line between two consecutive lanes belongs to the first.
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


@dataclass(frozen=True, slots=True)
class PlainSignal:
    """Traffic light or sign with its position and lanes. It does not depend on a map format.

    Attributes
    ----------
    name, kind : str
        Its id, and one of :data:`sgstore.model.vocabulary.SIGNALS`.
    x, y, z, heading : float
        Position and facing direction; m, rad. NaN means unknown.
    lanes : tuple of int
        Lanes that it applies to, by index.
    stops : tuple of (int, float)
        Lanes with a stopping place before the signal, and the place along each; m.
    is_stop_line : bool
        True for a line painted on the road.
    line : (n, 2) float64
        Its own line; m. Empty if it is a point.
    speed_limit : float
        m/s; NaN if it has none.
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
    """Pedestrian crossing with its outline. It does not depend on a map format.

    Attributes
    ----------
    name : str
    outline : (n, 2) float64
        Corners all around; m. At least three.
    z : float
        Its height; m.
    """

    name: str
    outline: Floats
    z: float


@dataclass(frozen=True, slots=True)
class PlainObject(PlainCrosswalk):
    """Object next to the lanes (such as a building) with its outline on the ground.

    Attributes
    ----------
    name, outline, z
        As in :class:`PlainCrosswalk`.
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
    warnings: Sequence[str] = (),
) -> RoadMap:
    """Build a road map from lanes, signals, crosswalks and objects.

    Raises
    ------
    MapError
        A junction has too many lanes for a comparison in pairs.
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
        # Formats of lanes as lines use 0 for an unknown height.
        courses=LaneCourses.of(ribbons, ribbons.height if ribbons.z.any() else None),
        broad_lines=MapPlaces.of_broad_lines(
            [
                (row, side == "left", 0.0, float(length))
                for row, (lane, length) in enumerate(zip(lanes, ribbons.lengths, strict=True))
                for side in lane.broad
            ]
        ),
    )


def _stops(signals: Sequence[PlainSignal], first: int) -> tuple[Ints, Ints, Floats]:
    """Return the stops before traffic lights and signs: node row of the signal, lane, and position along it."""
    rows = [(first + row, *stop) for row, signal in enumerate(signals) for stop in signal.stops]
    column, lane = np.array([one[:2] for one in rows], np.int64).reshape(-1, 2).T
    return column, lane, np.array([along for *_, along in rows], np.float64)


def ribbons_of(lanes: Sequence[PlainLane]) -> Ribbons:
    """Return the surfaces of lanes, as one table of cross sections."""
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
    # Traffic does not follow a sideways jump of a lane.
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
    """Return the heading of polylines at each of their points, (N,); rad. Angles can exceed ±π.

    A line of one point has the heading ``alone``. An inner point has the mean of the directions of
    both pieces, weighted by their lengths; the cubic through points and headings then stays close
    to both. An end has the heading of a circle through its piece.
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
    # Ends of a line: mirror the heading of the other end at the direction of the piece.
    starts, ends = np.flatnonzero(~both & (after > 0)), np.flatnonzero(~both & (before > 0))
    for rows, others, pieces in ((starts, starts + 1, out), (ends, ends - 1, into)):
        bend = wrapped(heading[others] - pieces[rows])
        curved = both[others] & (np.abs(bend) < np.pi / 4)
        heading[rows] = pieces[rows] - np.where(curved, bend, 0.0)
    return heading


def plain_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """Return one map node per lane, with type, length, speed limit and so on."""
    every, length = np.arange(len(ribbons)), ribbons.lengths
    middle = ribbons.at(every, length / 2)
    turns = turn_words(ribbons.turned())
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
        width=ribbons.mean_widths(),
        speed_limit=np.array([lane.speed_limit for lane in lanes], np.float64),
    )


def _road_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """Return one map node per road, with its length, sorted by the first lane of the road."""
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
    """Return one map node per object, with the smallest rectangle around the object."""
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
"""Edges of one relation: its name, rows of the sources, and rows of the destinations among the nodes."""


def edges_of(parts: Sequence[Edge]) -> MapEdges:
    """Convert edges between node rows to map edges between node ids, sorted and without duplicates."""
    code = np.concatenate([np.full(len(src), RELATION_CODE[name]) for name, src, _ in parts])
    src = np.concatenate([s for _, s, _ in parts])
    dst = np.concatenate([d for _, _, d in parts])
    table = np.unique(np.column_stack((code, src, dst)), axis=0).reshape(-1, 3)
    return MapEdges(table[:, 0].astype(np.int8), -1 - table[:, 1], -1 - table[:, 2])


def _spread(groups: Sequence[tuple[int, ...]]) -> Ints:
    """Return a pair (index of the group, member) for each member of each group, (n, 2)."""
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


_ON_LANE: Final = 0.1
"""Largest distance between a stop line and the centre line of its lane; m."""
_AT_START: Final = 0.5
"""Distance from the start of a lane up to which a line can belong to the previous lane instead; m."""
