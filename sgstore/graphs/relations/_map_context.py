"""Queries of the road map for the generator: map parts under bodies, and map parts in graphs.

The look-up of lanes under a footprint is the most expensive query. Therefore it runs only for
footprints that have moved: traffic often waits, parks or queues, and scenery never moves.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

import numpy as np

from sgstore.base.tables import chained, taken
from sgstore.errors import ConfigError
from sgstore.graphs.relations._following import (
    Centrelines,
    LaneNet,
    SignalReach,
    next_ahead,
    own_hits,
)
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    Bodies,
    MapContext,
    Standing,
    joined,
    kinds_mask,
    spread,
)
from sgstore.maps.roads import OFF_ROAD, LaneHits, MapEdges, MapNodes, RoadMap, point_shapes
from sgstore.model.vocabulary import DRIVING, KIND_CODE, RELATION_CODE, VEHICLES, are_entities

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.graphs.relations._extent import Areas
    from sgstore.maps.roads import LanePoints
    from sgstore.model.config import LaneSettings
    from sgstore.model.world import Bools, Entities, Floats, Ints, States

    Rows = NDArray[np.intp]

# Points of lanes as nodes: a map at the granularity of waypoints ----------------------------------

FIRST_LANE: Final = 1
"""Column of the first lane among the nodes of a map."""

MOST: Final = 500_000
"""Greatest number of waypoints of a map: each frame stores the presence of each."""


class Waypoints:
    """Waypoints of a map.

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
        shapes = point_shapes(points.x, points.y)
        return RoadMap(
            name=road_map.name,
            text=road_map.text,
            nodes=chained([road_map.nodes, self._nodes(road_map.nodes, points)]),
            edges=MapEdges(*(np.concatenate(column) for column in zip(*parts, strict=True))),
            ribbons=road_map.ribbons,
            shapes=np.concatenate([road_map.outlines(), shapes]),
            lane_changes=road_map.lane_changes,
            road_types=road_map.road_types,
            junction_types=road_map.junction_types,
            controllers=road_map.controllers,
            warnings=road_map.warnings,
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
        """Return pairs of a waypoint and its lane, as node columns."""
        return self._first[0] + np.arange(len(points.lane)), FIRST_LANE + points.lane

    def _onward(self, edges: MapEdges) -> tuple[Ints, Ints]:
        """Return pairs of a waypoint and the next waypoint, as node columns."""
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
        """Return pairs of a body row and the node id of its waypoint, ordered by body.

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


_KNOWN: WeakKeyDictionary[RoadMap, tuple[LaneSettings, Waypoints]] = WeakKeyDictionary()


def waypoints_of(road_map: RoadMap | None, lanes: LaneSettings) -> Waypoints | None:
    """Return the waypoints of a map if the settings request them; cached per map."""
    if road_map is None or lanes.granularity != "waypoint":
        return None
    known = _KNOWN.get(road_map)
    if known is None or known[0] != lanes:
        known = lanes, Waypoints(road_map, lanes)
        _KNOWN[road_map] = known
    return known[1]


# Bodies on a map, and the parts of it that are in their graphs ------------------------------------

ON_OR_OFF: Final = kinds_mask((*VEHICLES, "person", "animal", "prop"))
"""Kinds that can be off the road even if they never move, unlike trees."""

SAME_PLACE: Final = 1.0
"""Greatest distance between an entity and its object in the map, if several are alike; m."""

DEPTH: Final = 3
"""Levels of ``isIn`` within a map: lane, road, junction."""


class LaneContact:
    """Road map queries for one trace, block after block.

    Parameters
    ----------
    road_map : RoadMap
    ahead : float
        Search distance along the lanes; m.
    waypoints : Waypoints, optional
        Waypoints of the map, if it has any.

    Attributes
    ----------
    driving : (K,) bool
        Mask of the map nodes that are lanes for motor traffic.

    Notes
    -----
    It remembers the entities that represent signals and objects of the map, and the last footprints
    of the previous block: its memory grows with the number of distinct entities, not with time.
    """

    def __init__(self, road_map: RoadMap, ahead: float, waypoints: Waypoints | None = None) -> None:
        nodes, lines = road_map.nodes, Centrelines(road_map.ribbons)
        self._map = road_map
        self._waypoints = waypoints
        self._ahead = ahead
        self._net = LaneNet(road_map)
        self._reach = SignalReach(road_map, self._net, lines, ahead)
        self._footing = _Footing(road_map, lines)
        self.driving = np.array([kind in DRIVING for kind in nodes.lane_type], np.bool_)
        # (K,): column of the parent of each map node, or -1.
        edges = road_map.edges
        inside = edges.relation == RELATION_CODE["isIn"]
        parent = np.full(len(road_map.nodes), -1)
        parent[-1 - edges.src[inside]] = -1 - edges.dst[inside]
        self._parent = parent
        self._columns: dict[tuple[bool, str], list[int]] = {}
        for column in np.flatnonzero(are_entities(nodes.kind)).tolist():
            ref = nodes.name[column].partition("#")[0]  # of a repeated object: ref#1, ref#2, …
            key = bool(IS_SIGNAL[nodes.kind[column]]), ref
            self._columns.setdefault(key, []).append(column)
        none = np.zeros(0, np.int64)
        self._twins: tuple[Ints, Ints] = (none, none)
        self._controls: tuple[Ints, Ints] = (none, none)
        self._affects: tuple[Ints, Ints] = (none, none)

    def learn(self, entities: Entities, scenery: States) -> None:
        """Register new entities and their poses, in order of node id."""
        places = dict(
            zip(scenery.node.tolist(), zip(scenery.x, scenery.y, strict=True), strict=True)
        )
        twins: list[tuple[int, int]] = []
        controls: list[tuple[int, int]] = []
        affects: list[tuple[int, int]] = []
        for row, ref in enumerate(entities.map_ref):
            if not ref:
                continue
            node, is_signal = entities.first + row, bool(IS_SIGNAL[entities.kind[row]])
            place = places.get(node, (np.nan, np.nan))
            column = self._column((is_signal, ref), place)
            if column is not None:
                twins.append((node, column))
            if is_signal:
                controls += [(node, lane) for lane in self._map.lanes_of_signal(ref).tolist()]
                affects += [(node, lane) for lane in self._reach.of(ref, place).tolist()]
        self._twins = _appended(self._twins, twins)
        self._controls = _appended(self._controls, controls)
        self._affects = _appended(self._affects, affects)

    def _column(self, key: tuple[bool, str], place: tuple[float, float]) -> int | None:
        """Return the column of a referenced map signal or object; the place selects one of several."""
        columns = self._columns.get(key, [])
        if len(columns) < 2:
            return columns[0] if columns else None
        nodes = self._map.nodes
        apart = np.hypot(nodes.x[columns] - place[0], nodes.y[columns] - place[1])
        at = int(np.argmin(apart))
        return columns[at] if apart[at] <= SAME_PLACE else None

    def standing(self, bodies: Bodies) -> Standing:
        """Return the map parts under the bodies of a block; call once per block."""
        hits, along, parts = self._footing.of(bodies)
        if self._waypoints is not None:
            rows, nodes = self._waypoints.of(hits, along, bodies)
            rows, nodes = np.concatenate([parts[0], rows]), np.concatenate([parts[1], nodes])
            order = np.argsort(rows, kind="stable")
            parts = rows[order], nodes[order]
        stands: Bools = np.zeros(len(bodies), np.bool_)
        stands[hits.row[self.driving[-1 - hits.lane]]] = True
        placed = np.isfinite(bodies.x) & np.isfinite(bodies.y)
        off_road = np.flatnonzero(
            ~stands & placed & ~IS_SIGNAL[bodies.kind] & (bodies.moves | ON_OR_OFF[bodies.kind])
        )
        own = own_hits(self._net, bodies, hits)
        return Standing(hits, along, own, parts, off_road)

    def ground(self, bodies: Bodies, standing: Standing, areas: Areas, kept: Bools) -> MapContext:
        """Return the map under bodies, and around the egos.

        Parameters
        ----------
        bodies : Bodies
        standing : Standing
            Map parts under the bodies.
        areas : Areas
            Range of the egos; without one the whole map is in range.
        kept : (K,) bool
            Mask of the map nodes that the caller keeps.

        Returns
        -------
        MapContext
        """
        present = self.present(bodies, standing, areas, kept)
        return MapContext(
            standing,
            present,
            self._controls,
            self._affects,
            self._reach.of_map(present),
            next_ahead(self._net, bodies, standing, self._ahead),
        )

    def present(self, bodies: Bodies, standing: Standing, areas: Areas, kept: Bools) -> Bools:
        """Return a mask (F, K) of the map nodes in each graph; see :meth:`ground`.

        A lane or crosswalk under a body is present even if it begins just out of range; so are its
        road and junction. ``off_road`` is present if a body is in it. A signal or object of the map
        is absent if an entity of the trace represents it.
        """
        present: Bools = areas.parts(self._map)
        present[:, -1 - OFF_ROAD] = False
        doubled, index = joined(self._twins[0], bodies.node)
        present[bodies.frame[doubled], self._twins[1][index]] = False
        hits, (at, parts), off_road = standing.hits, standing.parts, standing.off_road
        rows = np.concatenate([hits.row, at, off_road])
        nodes = np.concatenate([hits.lane, parts, np.full(len(off_road), OFF_ROAD)])
        frame, column = bodies.frame[rows], -1 - nodes
        for _ in range(DEPTH):
            present[frame, column] = True
            column = self._parent[column]
            frame, column = frame[column >= 0], column[column >= 0]
        return present & kept


def _appended(table: tuple[Ints, Ints], lines: list[tuple[int, int]]) -> tuple[Ints, Ints]:
    keys, values = np.array(lines, np.int64).reshape(-1, 2).T
    return np.append(table[0], keys), np.append(table[1], values)


Table = tuple["NDArray[Any]", ...]
"""Columns of equal length and different types; the first, ascending, is the row of a footprint."""


class _Footing:
    """Lanes and crosswalks under footprints; results are reused until a footprint moves."""

    def __init__(self, road_map: RoadMap, lines: Centrelines) -> None:
        self._map = road_map
        self._lines = lines
        self._node: Ints = np.zeros(0, np.int64)
        self._box = np.zeros((0, 6))
        self._lanes, self._crosswalks = self._ask(np.zeros(0, np.intp), self._box)

    def of(self, bodies: Bodies) -> tuple[LaneHits, Floats, tuple[Ints, Ints]]:
        """Return lanes that bodies touch, places along them, and crosswalks, by rows; none for signals."""
        rows = np.flatnonzero(~IS_SIGNAL[bodies.kind])
        known = len(self._node)
        node = np.concatenate([self._node, bodies.node[rows]])
        frame = np.concatenate([np.full(known, -1), bodies.frame[rows]])
        box = np.concatenate([self._box, np.column_stack([bodies.boxes, bodies.bottom])[rows]])
        same_as, last = _runs(node, frame, box)
        ask = np.flatnonzero(same_as[known:] == np.arange(known, len(node))) + known
        tables = [
            tuple(np.concatenate(column) for column in zip(old, new, strict=True))
            for old, new in zip((self._lanes, self._crosswalks), self._ask(ask, box), strict=True)
        ]
        last = last[frame[last] >= 0]
        self._node, self._box = node[last], box[last]
        self._lanes, self._crosswalks = (_looked_up(table, same_as[last]) for table in tables)
        lanes, crosswalks = (_looked_up(table, same_as[known:]) for table in tables)
        row, *hits, along = lanes
        return LaneHits(rows[row], *hits), along, (rows[crosswalks[0]], crosswalks[1])

    def _ask(self, rows: Rows, box: Floats) -> tuple[Table, Table]:
        boxes, bottom = box[rows, :5], box[rows, 5]
        hits = self._map.lanes_of(boxes, bottom)
        walkers, crosswalks = self._map.crosswalks_of(boxes, bottom)
        order = np.argsort(walkers, kind="stable")
        return (
            (
                rows[hits.row],
                *(getattr(hits, column.name) for column in fields(hits)[1:]),
                self._lines.along(-2 - hits.lane, boxes[hits.row, 0], boxes[hits.row, 1]),
            ),
            (rows[walkers[order]], crosswalks[order]),
        )


def _runs(node: Ints, frame: Ints, box: Floats) -> tuple[Rows, Rows]:
    """Return for each row the first row with the same unchanged box, and each node's last row."""
    order = np.lexsort((frame, node))
    node, bits = (
        node[order],
        box[order].view(np.int64),
    )  # compared as bits, because NaN is unequal to itself
    other = np.ones(len(node) + 1, np.bool_)
    other[1:-1] = node[1:] != node[:-1]
    begins = other[:-1].copy()
    begins[1:] |= (bits[1:] != bits[:-1]).any(axis=1)
    first = np.maximum.accumulate(np.where(begins, np.arange(len(node)), 0))
    same_as = np.empty(len(node), np.intp)
    same_as[order] = order[first]
    return same_as, order[other[1:]]


def _looked_up(table: Table, wanted: Rows) -> Table:
    """Return the lines of a table for selected rows, with new row numbers."""
    owner, index = joined(table[0], wanted)
    return (owner, *(column[index] for column in table[1:]))
