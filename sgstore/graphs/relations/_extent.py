"""Range of a scene graph around the ego: an area and a storey. Objects in the range become nodes.

An area is a disc, the inside of a polygon in the ego's axes, or a strip along lines (the lanes
ahead). An entity is in the area if its footprint touches it, or if its centre is in it, depending
on the settings; a part of a map if its shape touches it. The edge belongs to the area. *Frames
without an ego*, or without its position (or a needed heading), have no range: everything is in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.geometry import gap_to_points
from sgstore.base.tables import begins, spread
from sgstore.graphs.relations._lane_net import Centrelines
from sgstore.graphs.relations._scene import IS_SIGNAL, joined, parts
from sgstore.model.pair_numbers import gap
from sgstore.model.vocabulary import DRIVING, KIND_CODE, RELATION_CODE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.maps.roads import LanePoints, RoadMap
    from sgstore.model.config import RangeSettings
    from sgstore.model.world import Bools, Floats, Ints

    Rows = NDArray[np.intp]


TOUCH: Final = 1e-9
"""Rounding tolerance for objects that touch the border of an area; m."""

HANG: Final = 6.0
"""Largest height of signals above the ground of their storey; m. The clearance over roads is 4.5 to 5.5 m."""

STEP: Final = 2.0
"""Distance between the points of a lane whose heights are known; m."""
MOST_POINTS: Final = 1_000_000
"""Largest number of points with a height in a map. Above 2,000 km of lanes, their distance grows."""


@dataclass(frozen=True, slots=True)
class EgoPoses:
    """Poses of the ego in F frames. They are NaN in frames without an ego.

    Attributes
    ----------
    x, y, heading : float64
        m, m, rad.
    ground : float64
        Height of the lower side of the box; m.
    """

    x: Floats
    y: Floats
    heading: Floats
    ground: Floats

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True, slots=True)
class LaneHeights:
    """Points along the centre lines of all lanes. Each lane has a lowest and a highest point.

    Attributes
    ----------
    points : LanePoints
        Ordered by lane.
    first : (L + 1,) int64
        Rows of each lane in ``points``.
    low, high : (L,) float64
        m.
    """

    points: LanePoints
    first: Ints
    low: Floats
    high: Floats

    @classmethod
    def of(cls, road_map: RoadMap) -> LaneHeights:
        """Compute the heights of all lanes of a map."""
        whole = float(road_map.ribbons.lengths.sum())
        points = road_map.waypoints(max(STEP, whole / MOST_POINTS))
        first = np.searchsorted(points.lane, np.arange(len(road_map.ribbons) + 1))
        low, high = (
            of.reduceat(points.z, first[:-1]) if len(points) else points.z
            for of in (np.minimum, np.maximum)
        )
        return cls(points, first, low, high)


class Extent:
    """Range of scene graphs around the ego, from the settings.

    Parameters
    ----------
    settings : RangeSettings
    road_map : RoadMap or None
        The map for corridors along lanes. Without a map a corridor is straight.
    """

    def __init__(self, settings: RangeSettings, road_map: RoadMap | None) -> None:
        self.settings = settings
        self._map = road_map
        self._heights: LaneHeights | None = None
        if road_map is not None and settings.height:
            self._heights = LaneHeights.of(road_map)
        self._driving: Bools = np.zeros(0, np.bool_)
        self._centres: Centrelines | None = None
        if road_map is not None and settings.shape == "corridor":
            self._centres = Centrelines(road_map.ribbons)
            self._driving = np.array([t in DRIVING for t in road_map.nodes.lane_type], np.bool_)

    def areas(self, egos: EgoPoses) -> Areas:
        """Return the areas around the ego in several frames."""
        areas = self._areas(egos)
        areas.heights = self._heights
        return areas

    def _areas(self, egos: EgoPoses) -> Areas:
        settings = self.settings
        if settings.shape == "radius":
            return Discs(settings, egos, settings.radius)
        if settings.shape == "corridor":
            return Strips(settings, egos, *self._lines(egos))
        corners = settings.polygon
        if settings.shape == "rectangle":
            front, rear, side = settings.front, settings.rear, settings.side
            corners = ((front, side), (-rear, side), (-rear, -side), (front, -side))
        return Outlines(settings, egos, np.array(corners))

    def _lines(self, egos: EgoPoses) -> tuple[Rows, Floats]:
        """Return centre lines of the ego's corridor (lanes ahead) as straight pieces: frame, ends (S, 2, 2)."""
        length = self.settings.length
        there = np.flatnonzero(_exist(egos, turned=True))
        owner, ends = np.zeros(0, np.intp), np.zeros((0, 2, 2))
        if self._map is not None and self._centres is not None:
            owner, ends = self._lane_lines(self._map, self._centres, egos, there)
        lost = there[~np.isin(there, owner)]
        start = np.stack([egos.x[lost], egos.y[lost]], axis=1)
        ahead = np.stack([np.cos(egos.heading[lost]), np.sin(egos.heading[lost])], axis=1)
        straight = np.stack([start, start + length * ahead], axis=1)
        return np.concatenate([owner, lost]), np.concatenate([ends, straight])

    def _lane_lines(
        self, road_map: RoadMap, centres: Centrelines, egos: EgoPoses, there: Rows
    ) -> tuple[Rows, Floats]:
        """Return the centre lines of the ego's lane and the lanes that follow it, in straight pieces."""
        points = np.column_stack([egos.x[there], egos.y[there], np.zeros((len(there), 3))])
        points[:, 2] = egos.heading[there]
        hits = road_map.lanes_of(points, egos.ground[there])
        on = self._driving[-1 - hits.lane] & (np.abs(hits.heading_error) < np.pi / 2)
        row, lane = hits.row[on], -2 - hits.lane[on]
        lengths, length = road_map.ribbons.lengths, self.settings.length
        along = np.clip(centres.along(lane, points[row, 0], points[row, 1]), 0, lengths[lane])
        ended, other, distance = road_map.downstream(length)
        source, way = joined(ended, lane)
        before = lengths[lane[source]] - along[source] + distance[way]
        near = before < length
        frame = there[np.concatenate([row, row[source[near]]])]
        lane = np.concatenate([lane, other[way[near]]])
        begin = np.concatenate([along, np.zeros(np.count_nonzero(near))])
        end = np.concatenate([along + length, length - before[near]])
        order = np.lexsort((-end, begin, lane, frame))
        frame, lane, begin, end = frame[order], lane[order], begin[order], end[order]
        first = begins(frame, lane, begin)
        owner, ends = _pieces(road_map, lane[first], begin[first], end[first])
        return frame[first][owner], ends


class Areas:
    """Areas around the ego in several frames. Objects inside become nodes of the scene graph.

    Parameters
    ----------
    settings : RangeSettings
    egos : EgoPoses
    reach : float
        Greatest distance of a point of an area from its ego's centre; m.
    turned : bool
        True if the areas follow the ego's heading.

    Attributes
    ----------
    exist : (F,) bool
        False for a frame without an area; everything is in range there.
    heights : LaneHeights or None
        Heights of the lanes of the map, if storeys matter.
    """

    heights: LaneHeights | None = None

    def __init__(
        self, settings: RangeSettings, egos: EgoPoses, reach: float, *, turned: bool = True
    ) -> None:
        self.settings = settings
        self.egos = egos
        self.reach = reach
        self.exist = _exist(egos, turned=turned)

    def near(self, x: Floats, y: Floats, extent: Floats) -> tuple[Rows, Rows]:
        """Return pairs (frame, object) of objects that may be in the area: all inside, and some outside.

        Parameters
        ----------
        x, y, extent : (N,) float64
            Centres, and greatest distance of a point of each object from its centre; m.
        """
        reach = (self.reach + np.nan_to_num(extent)) * (1 + 1e-9) + TOUCH
        far = np.subtract.outer(self.egos.x, x) ** 2 + np.subtract.outer(self.egos.y, y) ** 2
        frame, row = np.nonzero(~(far > reach**2) | ~self.exist[:, None])
        return frame, row

    def hold(
        self,
        frame: Ints,
        boxes: Floats,
        ground: Floats,
        *,
        static: bool = False,
        hung: Bools | None = None,
    ) -> Bools:
        """Return a mask of the object footprints inside the area of their frame.

        Parameters
        ----------
        frame : (N,) int64
        boxes : (N, 5) float64
            ``x, y, heading, length, width``; m, m, rad, m, m. A footprint without extent or heading
            is a point; a footprint without position is never in range.
        ground : (N,) float64
            Height of the lower side of each box; m. NaN means any height.
        static : bool
            True for entities that never move.
        hung : (N,) bool, optional
            Mask of the entities that may hang above the ground (:data:`HANG`).
        """
        boxes = boxes.copy()
        by = self.settings.static_by if static else self.settings.by
        points = np.isnan(boxes).any(axis=1) | (by == "centre")
        boxes[points, 2:] = 0
        inside = ~self.exist[frame]
        x, y = self.egos.x[frame] - boxes[:, 0], self.egos.y[frame] - boxes[:, 1]
        extent = np.sqrt(boxes[:, 3] ** 2 + boxes[:, 4] ** 2) / 2
        near = np.flatnonzero(~inside & (np.hypot(x, y) <= self.reach + extent + TOUCH))
        inside[near] = self._meet(np.asarray(frame)[near], boxes[near])
        if self.settings.height and self.settings.height_of_entities:
            inside &= self._level(np.asarray(frame), np.hypot(x, y), ground, hung)
        return inside

    def parts(self, road_map: RoadMap) -> Bools:
        """Return a mask (F, K) of the map nodes inside the area of each frame.

        Roads and junctions have no shape: they are in range if one of their lanes is. ``off_road``
        never is.
        """
        inside = np.ones((len(self.egos), len(road_map.nodes)), np.bool_)
        there = np.flatnonzero(self.exist)
        inside[there] = False
        rows, nodes = self._meet_map(road_map)
        inside[rows, -1 - nodes] = True
        if self.heights is not None:
            self._keep_storey(road_map, self.heights, inside)
        # A road is in range if one of its lanes is; a parent of roads is in range if one of them
        # is.
        kind, edges = road_map.nodes.kind, road_map.edges
        within = edges.relation == RELATION_CODE["isIn"]
        child, parent = -1 - edges.src[within], -1 - edges.dst[within]
        for name in ("road", "junction", "roundabout"):
            columns = np.flatnonzero(kind == KIND_CODE[name])
            inside[np.ix_(there, columns)] = False
            of = kind[parent] == KIND_CODE[name]
            row, edge = np.nonzero(inside[np.ix_(there, child[of])])
            inside[there[row], parent[of][edge]] = True
        return inside

    def _meet(self, frame: Ints, boxes: Floats) -> Bools:
        """Return a mask of the boxes that touch the area of their frame."""
        raise NotImplementedError

    def _meet_map(self, road_map: RoadMap) -> tuple[Rows, Ints]:
        """Return pairs of a frame and a map node that touches the area of the frame."""
        raise NotImplementedError

    def _level(self, frame: Ints, away: Floats, height: Floats, hung: Bools | None = None) -> Bools:
        """Return a mask of the positions on the ego's storey, by their height and distance."""
        rise = height - self.egos.ground[frame]
        lowest, highest = self.settings.height
        if hung is not None:  # the lowest possible height
            rise = np.where(hung, np.clip(highest, rise - HANG, rise), rise)
        off = (rise < lowest) | (rise > highest)  # missing values stay in range
        return ~off | (np.abs(rise) < self.settings.grade * away) | ~self.exist[frame]

    def _keep_storey(self, road_map: RoadMap, heights: LaneHeights, inside: Bools) -> None:
        """In a mask of map nodes, set nodes on another storey than the ego to False.

        A lane is on the storey if one of its points within reach is. If no point is within reach,
        the nearest point counts.
        """
        nodes, lanes = road_map.nodes, len(heights.low)
        frame, column = np.nonzero(inside & self.exist[:, None])
        is_lane = (column >= 1) & (column <= lanes)
        other = np.flatnonzero(~is_lane)
        at, place = frame[other], column[other]
        away = np.hypot(nodes.x[place] - self.egos.x[at], nodes.y[place] - self.egos.y[at])
        off = ~self._level(at, away, nodes.z[place], IS_SIGNAL[nodes.kind[place]])
        inside[at[off], place[off]] = False

        frame, lane = frame[is_lane], column[is_lane] - 1
        # Most lanes are completely on the storey; only the other lanes need a test of their points.
        level = self._level(frame, np.zeros(len(frame)), heights.low[lane])
        level &= self._level(frame, np.zeros(len(frame)), heights.high[lane])
        frame, lane = frame[~level], lane[~level]
        kept = self._touch_storey(heights, frame, lane)
        inside[frame[~kept], 1 + lane[~kept]] = False

    def _touch_storey(self, heights: LaneHeights, frame: Ints, lane: Ints) -> Bools:
        """Return a mask of the lanes that have a point on the ego's storey."""
        points, count = heights.points, np.diff(heights.first)[lane]
        owner, point = spread(heights.first[lane], count)
        at = frame[owner]
        away = np.hypot(points.x[point] - self.egos.x[at], points.y[point] - self.egos.y[at])
        level = self._level(at, away, points.z[point])
        starts = np.cumsum(count) - count
        nearest = np.minimum.reduceat(away, starts) if len(starts) else away
        counts = (away <= self.reach) | (away == nearest[owner])
        return np.bincount(owner[level & counts], minlength=len(lane)) > 0


class Discs(Areas):
    """Areas around the ego: circles."""

    def __init__(self, settings: RangeSettings, egos: EgoPoses, radius: float) -> None:
        super().__init__(settings, egos, radius, turned=False)

    def _meet(self, frame: Ints, boxes: Floats) -> Bools:
        return gap_to_points(boxes, self.egos.x[frame], self.egos.y[frame]) <= self.reach

    def _meet_map(self, road_map: RoadMap) -> tuple[Rows, Ints]:
        there = np.flatnonzero(self.exist)
        rows, nodes = road_map.near(self.egos.x[there], self.egos.y[there], self.reach)
        return there[rows], nodes


class Outlines(Areas):
    """Areas around the ego: polygons that turn with the ego.

    Parameters
    ----------
    settings : RangeSettings
    egos : EgoPoses
    corners : (V, 2) float64
        Ahead and to the left of the ego's centre, all around; m.
    """

    def __init__(self, settings: RangeSettings, egos: EgoPoses, corners: Floats) -> None:
        super().__init__(settings, egos, float(np.hypot(*corners.T).max()))
        cos, sin = np.cos(egos.heading)[:, None], np.sin(egos.heading)[:, None]
        ahead, left = corners.T
        self._corners = np.stack(
            [
                egos.x[:, None] + ahead * cos - left * sin,
                egos.y[:, None] + ahead * sin + left * cos,
            ],
            axis=-1,
        )

    def _meet(self, frame: Ints, boxes: Floats) -> Bools:
        inside = self._inside(frame, boxes[:, 0], boxes[:, 1])
        ends = np.roll(self._corners, -1, axis=1)
        for side in range(self._corners.shape[1]):
            out = np.flatnonzero(~inside)
            pieces = np.stack([self._corners[:, side], ends[:, side]], axis=1)
            lines = _as_boxes(pieces)[frame[out]]
            inside[out] = gap(lines, boxes[out]) <= TOUCH
        return inside

    def _inside(self, frame: Ints, x: Floats, y: Floats) -> Bools:
        """Return a mask of the points inside the polygon of their frame."""
        odd = np.zeros(len(x), np.bool_)
        ends = np.roll(self._corners, -1, axis=1)
        for side in range(self._corners.shape[1]):
            (ax, ay), (bx, by) = self._corners[frame, side].T, ends[frame, side].T
            crosses = (ay > y) != (by > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                at = ax + (y - ay) / (by - ay) * (bx - ax)
            odd ^= crosses & (x > at)
        return odd

    def _meet_map(self, road_map: RoadMap) -> tuple[Rows, Ints]:
        there = np.flatnonzero(self.exist)
        rows, nodes = road_map.near_shapes(self._corners[there], 0.0)
        return there[rows], nodes


class Strips(Areas):
    """Areas around the ego: strips of fixed width along lines (corridors).

    Parameters
    ----------
    settings : RangeSettings
    egos : EgoPoses
    frame : (S,) intp
        Frame of each line.
    ends : (S, 2, 2) float64
        Both ends; m.
    """

    def __init__(self, settings: RangeSettings, egos: EgoPoses, frame: Rows, ends: Floats) -> None:
        away = np.hypot(
            ends[..., 0] - egos.x[frame][:, None], ends[..., 1] - egos.y[frame][:, None]
        )
        super().__init__(settings, egos, float(away.max(initial=0)) + settings.width / 2)
        order = np.argsort(frame, kind="stable")
        self._frame, self._ends = frame[order], ends[order]

    def _meet(self, frame: Ints, boxes: Floats) -> Bools:
        inside: Bools = np.zeros(len(frame), np.bool_)
        lines, half = _as_boxes(self._ends), self.settings.width / 2
        first = np.searchsorted(self._frame, frame)
        count = np.searchsorted(self._frame, frame, side="right") - first
        reach = np.sqrt(boxes[:, 3] ** 2 + boxes[:, 4] ** 2) / 2 + half + TOUCH
        for part in parts(count):
            owner, line = spread(first[part], count[part])
            owner += part.start
            dx, dy = lines[line, 0] - boxes[owner, 0], lines[line, 1] - boxes[owner, 1]
            near = np.hypot(dx, dy) <= reach[owner] + lines[line, 3] / 2
            owner, line = owner[near], line[near]
            inside[owner[gap(lines[line], boxes[owner]) <= half + TOUCH]] = True
        return inside

    def _meet_map(self, road_map: RoadMap) -> tuple[Rows, Ints]:
        # Consecutive frames share most pieces of lanes: each distinct piece is tested once.
        ends, same = np.unique(self._ends.reshape(-1, 4), axis=0, return_inverse=True)
        rows, nodes = road_map.near_shapes(ends.reshape(-1, 2, 2), self.settings.width / 2)
        line, index = joined(rows, same.ravel())
        return self._frame[line], nodes[index]


def _exist(egos: EgoPoses, *, turned: bool) -> Bools:
    placed = np.isfinite(egos.x) & np.isfinite(egos.y)
    return placed & np.isfinite(egos.heading) if turned else placed


def _as_boxes(ends: Floats) -> Floats:
    """Convert lines (S, 2, 2) to boxes without width, (S, 5)."""
    x, y = (ends[:, 0] + ends[:, 1]).T / 2
    dx, dy = (ends[:, 1] - ends[:, 0]).T
    return np.stack([x, y, np.arctan2(dy, dx), np.hypot(dx, dy), np.zeros(len(ends))], axis=1)


def _pieces(road_map: RoadMap, lane: Ints, begin: Floats, end: Floats) -> tuple[Rows, Floats]:
    """Return parts of centre lines as straight pieces: the index of the line, and both ends (S, 2, 2)."""
    ribbons = road_map.ribbons
    owner, row = spread(ribbons.offsets[lane], np.diff(ribbons.offsets)[lane] - 1)
    here = (ribbons.along[row] < end[owner]) & (ribbons.along[row + 1] > begin[owner])
    owner, row = owner[here], row[here]
    start = ribbons.along[row]
    span = ribbons.along[row + 1] - start
    a, b = np.stack(_centre(road_map, row), axis=1), np.stack(_centre(road_map, row + 1), axis=1)
    cut = [np.clip((at[owner] - start) / span, 0, 1)[:, None] for at in (begin, end)]
    return owner, np.stack([a + share * (b - a) for share in cut], axis=1)


def _centre(road_map: RoadMap, row: Rows) -> tuple[Floats, Floats]:
    of = road_map.ribbons
    return (of.left_x[row] + of.right_x[row]) / 2, (of.left_y[row] + of.right_y[row]) / 2
