"""Waypoints (points along lanes) as map nodes of scene graphs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

import numpy as np

from sgstore.base.tables import chained, spread, taken
from sgstore.errors import ConfigError
from sgstore.maps.roads import LaneCourses, LaneHits, MapEdges, MapNodes, MapPlaces, RoadMap
from sgstore.model.vocabulary import DRIVING, KIND_CODE, RELATION_CODE

if TYPE_CHECKING:
    from sgstore.graphs.relations._scene import Bodies
    from sgstore.maps.roads import LanePoints
    from sgstore.model.config import LaneSettings
    from sgstore.model.world import Floats, Ints


FIRST_LANE: Final = 1
"""Index of the first lane among the nodes of a map."""

MOST: Final = 500_000
"""Largest number of waypoints of a map, because every frame stores the presence of each waypoint."""


ROUNDING: Final = 1e-6
"""Rounding error of positions along roads; m."""


class Waypoints:
    """Waypoints (points along lanes) of a map, added to the map as nodes with edges.

    Parameters
    ----------
    road_map : RoadMap
    lanes : LaneSettings
        Their spacing, and the types of lanes to use.

    Attributes
    ----------
    road_map : RoadMap
        The map with its waypoints (nodes after all other nodes) and their edges. It is another map
        with another digest.

    Raises
    ------
    ConfigError
        There are more than :data:`MOST`.
    """

    def __init__(self, road_map: RoadMap, lanes: LaneSettings) -> None:
        self._spacing = lanes.spacing
        self._lengths = road_map.ribbons.lengths
        many = float(np.sum(self._lengths) / lanes.spacing)
        if many > MOST:
            raise ConfigError(
                f"setting 'lanes.spacing' is {lanes.spacing}: about {many:,.0f} waypoints on the map "
                f"{road_map.name}; expected a spacing that makes at most {MOST:,}"
            )
        count = len(road_map.ribbons)
        types = road_map.nodes.lane_type[FIRST_LANE : FIRST_LANE + count]
        wanted = {kind.lower() for kind in lanes.types}
        has = np.array(
            [k in DRIVING and (not wanted or k.lower() in wanted) for k in types], np.bool_
        )
        points = road_map.waypoints(lanes.spacing)
        rows = np.flatnonzero(has[points.lane])
        points = taken(points, rows)
        self._counts = np.bincount(points.lane, minlength=count)
        self._first = len(road_map.nodes) + np.cumsum(self._counts) - self._counts
        self.road_map = self._extended(road_map, points)

    def _extended(self, road_map: RoadMap, points: LanePoints) -> RoadMap:
        edges = road_map.edges
        parts = [(edges.relation, edges.src, edges.dst)]
        for name, src, dst in (
            ("isIn", *self._inside(points)),
            ("travelsTo", *self._onward(edges)),
        ):
            code = np.full(len(src), RELATION_CODE[name], np.int8)
            parts.append((code, -1 - src, -1 - dst))
        shapes = RoadMap.point_shapes(points.x, points.y)
        no_signals = np.zeros(0, np.int64)
        return replace(
            road_map,
            nodes=chained([road_map.nodes, self._nodes(road_map.nodes, points)]),
            edges=MapEdges(*(np.concatenate(column) for column in zip(*parts, strict=True))),
            shapes=np.concatenate([road_map.outlines(), shapes]),
            stops=(no_signals, no_signals, np.zeros(0)),
            stop_lines=no_signals,
            courses=LaneCourses.none(),
            broad_lines=MapPlaces.none(),
            own={**road_map.own, **_markings(road_map, points)},
            variant=f" {road_map.digest} waypoints {self._spacing} {sorted(set(points.lane.tolist()))}",
        )

    def _nodes(self, nodes: MapNodes, points: LanePoints) -> MapNodes:
        lane = nodes.take(FIRST_LANE + points.lane)
        names = [f"{name}@{at:g}" for name, at in zip(lane.name, points.along, strict=True)]
        place = points.along / self._spacing
        length = self._lengths[points.lane]
        low = np.maximum(place - 0.5, 0) * self._spacing
        last = np.append(np.diff(points.lane) != 0, True)[: len(place)]
        high = np.where(last, length, np.minimum((place + 0.5) * self._spacing, length))
        return replace(
            lane,
            kind=np.full(len(names), KIND_CODE["waypoint"], np.int8),
            name=tuple(names),
            x=points.x,
            y=points.y,
            z=points.z,
            heading=points.heading,
            length=high - low,
            width=points.width,
            curvature=points.curvature,
        )

    def _inside(self, points: LanePoints) -> tuple[Ints, Ints]:
        """Return pairs of node rows: a waypoint, and its lane."""
        return self._first[0] + np.arange(len(points.lane)), FIRST_LANE + points.lane

    def _onward(self, edges: MapEdges) -> tuple[Ints, Ints]:
        """Return pairs of node rows: a waypoint, and the next waypoint on the lane."""
        total = int(self._counts.sum())
        begin = int(self._first[0]) if len(self._first) else 0
        column = begin + np.arange(total)
        ends = self._first + self._counts - 1
        inner = column[~np.isin(column, ends)]
        flow = edges.relation == RELATION_CODE["travelsTo"]
        src, dst = -1 - FIRST_LANE - edges.src[flow], -1 - FIRST_LANE - edges.dst[flow]
        both = (self._counts[src] > 0) & (self._counts[dst] > 0)
        return (
            np.concatenate([inner, ends[src[both]]]),
            np.concatenate([inner + 1, self._first[dst[both]]]),
        )

    def of(self, hits: LaneHits, along: Floats, bodies: Bodies) -> tuple[Ints, Ints]:
        """Return pairs of an object and a waypoint below it: object row, node id of the waypoint.

        Parameters
        ----------
        hits : LaneHits
            Lanes that bodies touch.
        along : (H,) float64
            Place of the body's centre along each lane, also beyond its ends; m.
        bodies : Bodies
        """
        lane, row = -1 - FIRST_LANE - hits.lane, hits.row
        cos, sin = np.abs(np.cos(hits.heading_error)), np.abs(np.sin(hits.heading_error))
        reach = cos * np.nan_to_num(bodies.length[row]) + sin * np.nan_to_num(bodies.width[row])
        last = self._counts[lane] - 1
        low, high = (
            np.clip(np.floor((along + side * reach / 2) / self._spacing + 0.5), 0, last)
            for side in (-1, 1)
        )
        count = np.where(last < 0, 0, high - low + 1).astype(np.int64)
        hit, column = spread((self._first[lane] + low).astype(np.int64), count)
        return row[hit], -1 - column


def _markings(road_map: RoadMap, points: LanePoints) -> dict[int, dict[str, Any]]:
    """Return the attributes of lane markings at waypoints: node row → attributes."""
    found: dict[int, dict[str, Any]] = {}
    for row, sides in road_map.marking_parts.items():
        low, high = np.searchsorted(points.lane, (row - FIRST_LANE, row - FIRST_LANE + 1)).tolist()
        for parts in sides:
            starts = [start for start, _ in parts]
            last = np.searchsorted(starts, points.s[low:high] + ROUNDING, side="right") - 1
            for point, part in enumerate(last.tolist(), start=low):
                if part >= 0:
                    found.setdefault(len(road_map.nodes) + point, {}).update(parts[part][1])
    return found


_KNOWN: WeakKeyDictionary[RoadMap, tuple[LaneSettings, Waypoints]] = WeakKeyDictionary()


def waypoints_of(road_map: RoadMap | None, lanes: LaneSettings) -> Waypoints | None:
    """Return the waypoints (points along lanes) of a map, if the settings request them."""
    if road_map is None or lanes.granularity != "waypoint":
        return None
    known = _KNOWN.get(road_map)
    if known is None or known[0] != lanes:
        known = lanes, Waypoints(road_map, lanes)
        _KNOWN[road_map] = known
    return known[1]
