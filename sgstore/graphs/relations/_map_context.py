"""Look-ups in the road map for the scene graph generator: map parts below objects and in graphs.

The look-up of lanes under a footprint is the most expensive query. Therefore it runs only for
footprints that have moved: traffic often waits, parks or queues, and scenery never moves.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.tables import begins
from sgstore.graphs.relations._following import following, own_hits
from sgstore.graphs.relations._lane_net import Centrelines, LaneNet
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    Bodies,
    MapContext,
    Standing,
    joined,
    kinds_mask,
)
from sgstore.graphs.relations._signal_reach import SignalReach
from sgstore.maps.roads import OFF_ROAD, LaneHits, RoadMap
from sgstore.model.noise import DeadBand
from sgstore.model.vocabulary import (
    DRIVING,
    NOT_FOR_MOTOR_TRAFFIC,
    RELATION_CODE,
    VEHICLES,
    are_entities,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sgstore.graphs.relations._extent import Areas
    from sgstore.graphs.relations._waypoints import Waypoints
    from sgstore.model.world import Bools, Floats, FrameBlock, Ints

    Rows = NDArray[np.intp]
    LookUp = Callable[[Floats, Floats], LaneHits]


ON_OR_OFF: Final = kinds_mask((*VEHICLES, "person", "animal", "prop"))
"""Kinds of entities that can be off the road. Trees and similar kinds cannot."""

SAME_PLACE: Final = 1.0
"""Largest distance between a recorded entity and its map object, if several map objects are alike; m."""

DEPTH: Final = 3
"""Number of ``isIn`` levels within a map: lane, road, junction."""


class LaneContact:
    """Look-ups in the road map for the objects of one trace, one block of frames after another.

    Parameters
    ----------
    road_map : RoadMap
    ahead : float
        Search distance along the lanes; m.
    waypoints : Waypoints, optional
        Waypoints of the map, if it has any.
    lanes_of : callable, optional
        Replaces :meth:`RoadMap.lanes_of`.

    Attributes
    ----------
    driving : (K,) bool
        Mask of the map nodes that are lanes for motor traffic.
    online : bool
        True if the driven lanes follow from earlier frames alone.

    Notes
    -----
    It remembers the entities that represent signals and objects of the map, and the last footprints
    of the previous block: its memory grows with the number of distinct entities, not with time.
    """

    def __init__(
        self,
        road_map: RoadMap,
        ahead: float,
        waypoints: Waypoints | None = None,
        lanes_of: LookUp | None = None,
    ) -> None:
        nodes, lines = road_map.nodes, Centrelines(road_map.ribbons)
        self.online = False
        self._map = road_map
        self._waypoints = waypoints
        self._ahead = ahead
        self._net = LaneNet(road_map)
        self._reach = SignalReach(road_map, self._net, lines, ahead)
        self._same = nodes.first_sections()
        self._footing = _Footing(road_map, lines, lanes_of or road_map.lanes_of)
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
        self._twins: tuple[Ints, Ints] = (none, none)  # column, and first frame in this block
        self._controls: tuple[Ints, Ints] = (none, none)
        self._affects: tuple[Ints, Ints] = (none, none)

    def learn(self, frames: FrameBlock) -> None:
        """Record the new objects of the next block of frames, and the poses of static objects."""
        self._twins = self._twins[0], np.zeros_like(self._twins[1])
        entities, scenery = frames.entities, frames.scenery
        if not len(entities):
            return
        places = dict(
            zip(scenery.node.tolist(), zip(scenery.x, scenery.y, strict=True), strict=True)
        )
        nodes, rows = np.unique(frames.states.node, return_index=True)
        since = dict(zip(nodes.tolist(), frames.frame_of[rows].tolist(), strict=True))
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
                twins.append((column, since.get(node, 0)))
            if is_signal and entities.subkind[row] not in NOT_FOR_MOTOR_TRAFFIC:
                controls += [(node, lane) for lane in self._map.lanes_of_signal(ref).tolist()]
                affects += [(node, lane) for lane in self._reach.of(ref, place).tolist()]
        self._twins = _appended(self._twins, twins)
        self._controls = _appended(self._controls, controls)
        self._affects = _appended(self._affects, affects)

    def _column(self, key: tuple[bool, str], place: tuple[float, float]) -> int | None:
        """Return the map node to which an object refers, such as a traffic light; ``None`` if not found."""
        columns = self._columns.get(key, [])
        if len(columns) < 2:
            return columns[0] if columns else None
        nodes = self._map.nodes
        apart = np.hypot(nodes.x[columns] - place[0], nodes.y[columns] - place[1])
        at = int(np.argmin(apart))
        return columns[at] if apart[at] <= SAME_PLACE else None

    def standing(self, bodies: Bodies, lane: Ints) -> Standing:
        """Return the map parts (lanes, crosswalks) below the objects of a block of frames.

        ``lane`` are the driven lanes of the first objects, as in ``States``.
        """
        hits, along, parts = self._footing.of(bodies)
        hits, sure = driven(hits, lane, self._same)
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
        own = own_hits(self._net, bodies, hits) & (hits.primary | ~sure)
        unsure = np.flatnonzero(lane > 0) if self.online else np.zeros(0, np.intp)
        own |= np.isin(hits.row, unsure) & self._net.traffic[-2 - hits.lane]
        return Standing(hits, along, own, parts, off_road, unsure)

    def ground(self, bodies: Bodies, standing: Standing, areas: Areas, kept: Bools) -> MapContext:
        """Return the map parts below objects, and the map parts in range of the egos.

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
            *following(self._net, bodies, standing, self._ahead),
        )

    def present(self, bodies: Bodies, standing: Standing, areas: Areas, kept: Bools) -> Bools:
        """Return a mask (F, K) of the map nodes that each frame's graph contains.

        A lane or crosswalk under a body is present even if it begins just out of range; so are its
        road and junction. ``off_road`` is present if a body is in it. A signal or object of the map
        is absent from the first frame on in which an entity of the trace represents it, also if that
        entity is out of range.
        """
        present: Bools = areas.parts(self._map)
        present[:, -1 - OFF_ROAD] = False
        columns, since = self._twins
        frame, index = np.nonzero(np.arange(len(present))[:, None] >= since)
        present[frame, columns[index]] = False
        hits, (at, parts), off_road = standing.hits, standing.parts, standing.off_road
        rows = np.concatenate([hits.row, at, off_road])
        nodes = np.concatenate([hits.lane, parts, np.full(len(off_road), OFF_ROAD)])
        frame, column = bodies.frame[rows], -1 - nodes
        for _ in range(DEPTH):
            present[frame, column] = True
            column = self._parent[column]
            frame, column = frame[column >= 0], column[column >= 0]
        return present & kept


def driven(hits: LaneHits, lane: Ints, same: Ints) -> tuple[LaneHits, Bools]:
    """Return touched lanes with the driven lane as primary lane, and a mask: the driven lane is certain.

    ``same`` is the first section of the same lane, as a column, for each map node. A driven lane
    that the footprint does not touch does not count, unless it touches another section.
    """
    lane = np.append(lane, np.zeros(int(hits.row.max(initial=-1)) + 1, np.int64))[hits.row]
    fits = np.flatnonzero((lane != 0) & (same[-1 - hits.lane] == same[np.abs(lane) - 1]))
    other = hits.lane[fits] != -np.abs(lane[fits])
    fits = fits[np.lexsort((-hits.overlap[fits], other, hits.row[fits]))]
    fits = fits[begins(hits.row[fits])]
    known = np.isin(hits.row, hits.row[fits])
    primary = hits.primary & ~known
    primary[fits] = True
    return replace(hits, primary=primary), known & (lane < 0)


def _appended(table: tuple[Ints, Ints], lines: list[tuple[int, int]]) -> tuple[Ints, Ints]:
    keys, values = np.array(lines, np.int64).reshape(-1, 2).T
    return np.append(table[0], keys), np.append(table[1], values)


Table = tuple["NDArray[Any]", ...]
"""Table of columns. The first column is the row of a footprint, in ascending order."""


class _Footing:
    """Cache of the lanes and crosswalks below objects. An entry is valid until the object moves."""

    def __init__(self, road_map: RoadMap, lines: Centrelines, lanes_of: LookUp) -> None:
        self._map, self._lanes_of = road_map, lanes_of
        self._lines = lines
        self._node: Ints = np.zeros(0, np.int64)
        self._box = np.zeros((0, 6))
        self._held = DeadBand()
        self._lanes, self._crosswalks = self._ask(np.zeros(0, np.intp), self._box)

    def of(self, bodies: Bodies) -> tuple[LaneHits, Floats, tuple[Ints, Ints]]:
        """Return the lanes that objects touch, their positions along these lanes, and crosswalks below them."""
        rows = np.flatnonzero(~IS_SIGNAL[bodies.kind])
        known = len(self._node)
        node = np.concatenate([self._node, bodies.node[rows]])
        frame = np.concatenate([np.full(known, -1), bodies.frame[rows]])
        new = np.column_stack([bodies.boxes, bodies.bottom])[rows]
        if bodies.band[rows].any():
            sides = bodies.node[rows], bodies.frame[rows], new[:, :2], new[:, 2], bodies.band[rows]
            new[:, :2] = self._held.held(*sides)
        box = np.concatenate([self._box, new])
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
        hits = self._lanes_of(boxes, bottom)
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
    """For each row, return the first row from which its box is unchanged, and the last row of each object."""
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
    """Return the table rows of those objects that are looked up."""
    owner, index = joined(table[0], wanted)
    return (owner, *(column[index] for column in table[1:]))
