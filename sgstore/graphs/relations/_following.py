"""Relations ``leads`` and ``follows``, and parked vehicles.

``leads`` is from the next vehicle ahead along the lanes, ``follows`` is to it.

Vehicles take part, also parked ones, on lanes for traffic that they face along (by less than a
right angle). A vehicle that never moves follows no other. A trailer does not follow its tractor.

*Own lanes* are the primary lane of an entity and some other lanes of its junction, where lanes
overlap: those that contain its centre and, for a vehicle, have its direction (:data:`SAME_WAY`).
Therefore a vehicle at the entry of a junction is on all ways that begin there. They are stored,
because the distance along the lanes (``lane_dist``) depends on them.

*The next one ahead* is the first vehicle after the vehicle's centre along the lane. If there is
none on this lane, the search continues along ``travelsTo``, also through junctions. At a fork each
branch has a next one: the future way is unknown, so all of them lead the vehicle, with different
gaps. Where ways join, vehicles on several ways can have the same next one. At equal distance the
lower node id counts as nearer. Lane changes are not followed. A vehicle farther along the lanes
than the settings allow leads no other.

*The gap* is the distance of the centres along the centre lines minus half of both lengths: from
bumper to bumper, 0 for an overlap, missing for an unknown length. Of several ways the shortest
counts.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.numba_loops import worth
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    IS_VEHICLE,
    Relation,
    carried_by,
    edges_between,
    parts,
    spread,
)
from sgstore.model.graph import Edges, LaneGaps
from sgstore.model.vocabulary import RELATION_CODE, TRAFFIC

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.graphs.relations._scene import BlockScene, Bodies, MapContext, Standing
    from sgstore.maps.roads import LaneHits, Ribbons, RoadMap
    from sgstore.model.world import Bools, Codes, Entities, Floats, Ints, States

    Rows = NDArray[np.intp]
    Column = tuple[Rows, Rows, Floats]
    Best = tuple[Ints, Floats]

# Lanes as a graph: order along lanes, and lanes upstream of signals -----------------------------


class LaneNet:
    """Graph of the lanes of a map; lanes are counted from 0.

    Parameters
    ----------
    road_map : RoadMap

    Attributes
    ----------
    lengths, widths : (L,) float64
        Lengths and mean widths; m.
    traffic : (L,) bool
        True for lanes for vehicles of any kind.
    junction : (L,) int64
        Number of the junction, or -1.
    """

    def __init__(self, road_map: RoadMap) -> None:
        nodes, edges, count = road_map.nodes, road_map.edges, len(road_map.ribbons)
        lanes = slice(1, 1 + count)
        self.lengths = road_map.ribbons.lengths
        self.widths = nodes.width[lanes]
        self.traffic = np.array([kind in TRAFFIC for kind in nodes.lane_type[lanes]], np.bool_)
        names = {name: number for number, name in enumerate(dict.fromkeys(nodes.junction))}
        numbers = [names[name] if name else -1 for name in nodes.junction[lanes]]
        self.junction = np.array(numbers, np.int64)
        flow = (edges.relation == RELATION_CODE["travelsTo"]) & (edges.src >= -1 - count)
        src, dst = -2 - edges.src[flow], -2 - edges.dst[flow]  # waypoints have their own edges
        order = np.lexsort((dst, src))
        self._next = dst[order]
        self._first = np.searchsorted(src[order], np.arange(count + 1))
        order = np.lexsort((src, dst))
        self._before = src[order]
        self._from = np.searchsorted(dst[order], np.arange(count + 1))

    def onward(self, lane: Ints) -> tuple[Rows, Ints]:
        """Return the successors of lanes, as pairs of query row and lane."""
        first = self._first[lane]
        owner, index = spread(first, self._first[lane + 1] - first)
        return owner, self._next[index]

    def upstream(self, lane: int, along: float, limit: float) -> Ints:
        """Return the lane of a place and the lanes that end up to ``limit`` m before it."""
        nearest: dict[int, float] = {lane: 0.0}
        queue, settled = [(along, lane)], set[int]()
        while queue:
            distance, at = heapq.heappop(queue)
            if at in settled:
                continue
            settled.add(at)
            for before in self._before[self._from[at] : self._from[at + 1]].tolist():
                if distance <= limit and before not in settled:
                    nearest[before] = distance
                    heapq.heappush(queue, (distance + float(self.lengths[before]), before))
        return np.array(sorted(nearest), np.int64)


# Where along a lane a place is: the foot of the perpendicular on its centre line ----------------


RUN: Final = 8
"""Number of pieces of a centre line that are skipped together if none of them can be the nearest."""


class Centrelines:
    """Centre lines of all lanes, for look-ups of places along them.

    Parameters
    ----------
    ribbons : Ribbons
        The straight lines between the middles of their cross sections are used.
    """

    def __init__(self, ribbons: Ribbons) -> None:
        self._first = ribbons.offsets[:-1]
        self._count = np.diff(ribbons.offsets) - 1
        x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
        self._x, self._y, self._along = x, y, ribbons.along
        self._run_x, self._run_y = np.diff(x), np.diff(y)
        squared = self._run_x**2 + self._run_y**2
        self._squared = np.where(squared > 0, squared, 1.0)
        # Runs of pieces: the first run and the number of runs of each lane; the pieces and a circle
        # of each run.
        self._runs = -(-self._count // RUN)
        self._first_run = np.cumsum(self._runs) - self._runs
        lane, number = spread(np.zeros(len(self._runs), np.int64), self._runs)
        self._run_first = self._first[lane] + number * RUN
        self._run_count = np.minimum(self._count[lane] - number * RUN, RUN)
        self._middle = self._run_first + self._run_count // 2
        run, point = spread(self._run_first, self._run_count + 1)
        far = np.hypot(x[point] - x[self._middle[run]], y[point] - y[self._middle[run]])
        self._radius = np.zeros(len(self._run_first))
        np.maximum.at(self._radius, run, far)

    def along(self, lane: Ints, x: Floats, y: Floats) -> Floats:
        """Return the length along each lane's centre line to the point nearest to a place; m.

        Parameters
        ----------
        lane : (N,) int64
            Lanes, counted from 0.
        x, y : (N,) float64
            Places; m.

        Returns
        -------
        (N,) float64
            m. The foot is the nearest point, the first of several. At an end of the lane it
            continues along the straight extension: below 0, or above the lane's length.
        """
        if worth():
            from sgstore.graphs.relations import _loops

            line = self._x, self._y, self._run_x, self._run_y, self._squared, self._along
            return _loops.along(lane, x, y, self._first, self._count, line)
        found = np.empty(len(lane))
        for part in parts(self._count[lane]):
            found[part] = self._of(lane[part], x[part], y[part])
        return found

    def _of(self, lane: Ints, x: Floats, y: Floats) -> Floats:
        owner, piece = self._near(lane, x, y)
        if not len(owner):
            return np.zeros(len(lane))
        run_x, run_y = self._run_x[piece], self._run_y[piece]
        away_x, away_y = x[owner] - self._x[piece], y[owner] - self._y[piece]
        onward = (away_x * run_x + away_y * run_y) / self._squared[piece]
        share = np.minimum(np.maximum(onward, 0.0), 1.0)
        squared = (away_x - share * run_x) ** 2 + (away_y - share * run_y) ** 2
        # Every lane has at least one piece, so each owner has a nearest piece.
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        least = np.minimum.reduceat(squared, starts)
        nearest = np.flatnonzero(squared == least[owner])
        at = nearest[np.diff(owner[nearest], prepend=-1) != 0]
        first = self._first[lane]
        piece, onward = piece[at], onward[at]
        before, after = self._along[piece], self._along[piece + 1]
        out = (piece == first) & (onward < 0)
        out |= (piece == first + self._count[lane] - 1) & (onward > 1)
        return before + np.where(out, onward, share[at]) * (after - before)

    def _near(self, lane: Ints, x: Floats, y: Floats) -> tuple[Rows, Rows]:
        """Return pairs of a place and a piece of its lane that may be the nearest."""
        first, count = self._first_run[lane], self._runs[lane]
        owner, run = spread(first, count)
        away = np.hypot(
            x[owner] - self._x[self._middle[run]], y[owner] - self._y[self._middle[run]]
        )
        starts = np.cumsum(count) - count
        least = np.minimum.reduceat(away, starts) if len(starts) else away
        near = np.flatnonzero(~(away - self._radius[run] > least[owner] * (1 + 1e-9) + 1e-6))
        owner, run = owner[near], run[near]
        at, piece = spread(self._run_first[run], self._run_count[run])
        return owner[at], piece


# Which lanes a signal may affect: those from which it lies ahead --------------------------------


class SignalReach:
    """Lanes upstream of the signals of a map, computed on first use.

    A signal is on each lane that it controls, at the foot of its place. It may affect this lane,
    and the lanes that end at most the given distance before it.

    Parameters
    ----------
    road_map : RoadMap
    net : LaneNet
    lines : Centrelines
    ahead : float
        The distance; m. With 0, signals affect no lanes.
    """

    def __init__(self, road_map: RoadMap, net: LaneNet, lines: Centrelines, ahead: float) -> None:
        self._map, self._nodes = road_map, road_map.nodes
        self._net, self._lines, self._ahead = net, lines, ahead
        edges = road_map.edges
        controls = (edges.relation == RELATION_CODE["controlsTrafficOf"]) & (ahead > 0)
        self._src, self._dst = edges.src[controls], edges.dst[controls]
        self._columns = np.unique(-1 - self._src)
        self._columns = self._columns[IS_SIGNAL[road_map.nodes.kind[self._columns]]]
        self._of = {road_map.nodes.name[column]: column for column in self._columns.tolist()}
        self._known: dict[int, Ints] = {}

    def of(self, signal: str, place: tuple[float, float]) -> Ints:
        """Return node ids of the lanes that a signal may affect; empty if its lanes are unknown.

        Parameters
        ----------
        signal : str
            Its id in the map, or the result of :func:`sgstore.maps.roads.lanes_ref`.
        place : (float, float)
            Its position, if the map does not have the signal; m, NaN if unknown.
        """
        column = self._of.get(signal)
        if column is not None:
            return self._lanes(column)
        if not self._ahead:
            return np.zeros(0, np.int64)
        return self._upstream(-2 - self._map.lanes_of_signal(signal), *place)

    def of_map(self, present: Bools) -> tuple[Ints, Ints]:
        """Return node ids of map signals that are present in any frame, and of lanes that they may affect.

        Parameters
        ----------
        present : (F, K) bool
            Mask of the map nodes in each graph.
        """
        here = self._columns[present[:, self._columns].any(axis=0)].tolist()
        lanes = [np.zeros(0, np.int64), *(self._lanes(column) for column in here)]
        signals = np.repeat(
            np.array([0, *(-1 - column for column in here)]), [len(part) for part in lanes]
        )
        return signals, np.concatenate(lanes)

    def _lanes(self, column: int) -> Ints:
        if column not in self._known:
            controlled = -2 - self._dst[self._src == -1 - column]
            x, y = self._nodes.x[column], self._nodes.y[column]
            self._known[column] = self._upstream(controlled, float(x), float(y))
        return self._known[column]

    def _upstream(self, controlled: Ints, x: float, y: float) -> Ints:
        """Return node ids of these lanes and the lanes before them."""
        places = np.zeros(len(controlled))
        if np.isfinite(x) and np.isfinite(y):
            here = np.ones(len(controlled))
            places = self._lines.along(controlled, x * here, y * here)
            places = np.clip(places, 0, self._net.lengths[controlled])
        lanes = {
            lane
            for at, along in zip(controlled.tolist(), places.tolist(), strict=True)
            for lane in self._net.upstream(at, along, self._ahead).tolist()
        }
        return -2 - np.array(sorted(lanes), np.int64)


# The relations ``leads`` and ``follows``, and parked vehicles -----------------------------------

SAME_WAY: Final = np.pi / 4
"""Greatest difference of heading between a vehicle and its lane in a junction; rad."""


@dataclass(frozen=True, slots=True)
class OwnLanes:
    """Vehicles on their own lanes, sorted by frame, lane and place along it; shape (N,).

    Attributes
    ----------
    key : int64
        Frame times the number of lanes, plus the lane.
    row : intp
        Rows of :class:`Bodies`.
    lane : int64
        Lanes, counted from 0.
    along : float64
        Place of the centre along the lane; m.
    """

    key: Ints
    row: Rows
    lane: Ints
    along: Floats

    def first_in(self, key: Ints, but: Rows) -> tuple[Rows, Rows]:
        """Find the first other vehicle on each lane; return pairs of query row and vehicle row."""
        place = np.searchsorted(self.key, key)
        last = max(len(self.key) - 1, 0)
        itself = (self.row[np.minimum(place, last)] == but) & (place <= last)
        place += itself & (self.key[np.minimum(place, last)] == key)
        found = np.flatnonzero((place <= last) & (self.key[np.minimum(place, last)] == key))
        return found, place[found]


def own_hits(net: LaneNet, bodies: Bodies, hits: LaneHits) -> Bools:
    """Return a mask of the lane hits that are on a body's own lanes."""
    lane = -2 - hits.lane
    junction = np.full(len(bodies), -1)
    junction[hits.row[hits.primary]] = net.junction[lane[hits.primary]]
    within = np.abs(hits.offset) <= net.widths[lane] / 2
    beside = (net.junction[lane] >= 0) & (net.junction[lane] == junction[hits.row])
    its_way = (np.abs(hits.heading_error) <= SAME_WAY) | ~IS_VEHICLE[bodies.kind[hits.row]]
    return hits.primary | (beside & within & its_way)


def own_lanes(net: LaneNet, bodies: Bodies, standing: Standing) -> OwnLanes:
    """Return the vehicles on their own lanes, if they face along the lane."""
    hits = standing.hits
    lane = -2 - hits.lane
    own = standing.own & (np.abs(hits.heading_error) < np.pi / 2)
    known = IS_VEHICLE[bodies.kind] & ~np.isnan(bodies.heading)
    kept = np.flatnonzero(own & net.traffic[lane] & known[hits.row])
    row, lane = hits.row[kept], lane[kept]
    along = np.clip(standing.along[kept], 0, net.lengths[lane])
    key = bodies.frame[row] * len(net.lengths) + lane
    order = np.lexsort((bodies.node[row], along, key))
    return OwnLanes(key[order], row[order], lane[order], along[order])


def next_ahead(net: LaneNet, bodies: Bodies, standing: Standing, limit: float) -> Column:
    """Return pairs of a body and the next one ahead, as rows of bodies, and the gap; each pair once.

    Parameters
    ----------
    net : LaneNet
    bodies : Bodies
    standing : Standing
        Map parts under the bodies.
    limit : float
        Greatest distance of the centres along the lanes; m.
    """
    if not limit > 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0)
    own = own_lanes(net, bodies, standing)
    next_of = np.flatnonzero(own.key[1:] == own.key[:-1])  # in the same lane
    parts = [(next_of, next_of + 1, own.along[next_of + 1] - own.along[next_of])]
    parts += _beyond(net, own, limit)
    behind, ahead, distance = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    a, b = own.row[behind], own.row[ahead]
    kept = np.flatnonzero((distance <= limit) & bodies.moves[a] & ~carried_by(bodies, a, b))
    order = kept[np.lexsort((distance[kept], b[kept], a[kept]))]
    a, b, distance = a[order], b[order], distance[order]
    first = np.ones(len(a), np.bool_)
    first[1:] = (a[1:] != a[:-1]) | (b[1:] != b[:-1])
    a, b = a[first], b[first]
    gap = distance[first] - (bodies.length[a] + bodies.length[b]) / 2
    return a, b, np.maximum(gap, 0)


def _beyond(net: LaneNet, own: OwnLanes, limit: float) -> list[Column]:
    """Find the next vehicles ahead of the last vehicle on each lane, lane after lane."""
    source = np.flatnonzero(np.append(own.key[1:] != own.key[:-1], True)[: len(own.key)])
    at, base = own.lane[source], own.key[source] - own.lane[source]
    distance = net.lengths[at] - own.along[source]
    parts: list[Column] = []
    best: Best = (np.zeros(0, np.int64), np.zeros(0))
    # A shortest way never visits a lane twice.
    for _ in range(len(net.lengths)):
        fork, at = net.onward(at)
        source, base, distance = source[fork], base[fork], distance[fork]
        near = np.flatnonzero(distance <= limit)
        key = source[near] * len(net.lengths) + at[near]
        kept, best = _nearer(key, distance[near], best)
        kept = near[kept]
        source, at, base, distance = source[kept], at[kept], base[kept], distance[kept]
        if not len(source):
            break
        found, there = own.first_in(base + at, own.row[source])
        parts.append((source[found], there, distance[found] + own.along[there]))
        free = np.ones(len(source), np.bool_)
        free[found] = False
        source, at, base = source[free], at[free], base[free]
        distance = distance[free] + net.lengths[at]
    return parts


def _nearer(key: Ints, distance: Floats, best: Best) -> tuple[Rows, Best]:
    """Return the search fronts that are nearer than the best so far, and the updated best."""
    known, least = best
    place = np.minimum(np.searchsorted(known, key), max(len(known) - 1, 0))
    again = known[place] == key if len(known) else np.zeros(len(key), np.bool_)
    worse = again & (least[place] <= distance) if len(known) else again
    rows = np.flatnonzero(~worse)
    rows = rows[np.lexsort((distance[rows], key[rows]))]
    rows = rows[np.diff(key[rows], prepend=-1) != 0]
    keys, distances = np.concatenate([key[rows], known]), np.concatenate([distance[rows], least])
    # Of equal keys the new one, which is nearer, comes first.
    order = np.argsort(keys, kind="stable")
    order = order[np.diff(keys[order], prepend=-1) != 0]
    return rows, (keys[order], distances[order])


def gaps(bodies: Bodies, ground: MapContext | None) -> LaneGaps:
    """Return pairs of a follower and its leader, by node ids, and the gaps."""
    none = np.zeros(0, np.intp)
    a, b, gap = (none, none, np.zeros(0)) if ground is None else ground.following
    return LaneGaps(bodies.frame[a], bodies.node[a], bodies.node[b], gap)


def _edges(scene: BlockScene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("who follows whom needs a map")
    a, b, _ = ground.following
    return Edges.chained(
        [edges_between(scene, "leads", b, a), edges_between(scene, "follows", a, b)]
    )


LEADS, FOLLOWS = (
    Relation(
        name=name,
        doc=f"vehicle → vehicle: the next one {where} along the lanes, with `gap`, from bumper to bumper",
        edges=_edges,
        needs_map=True,
        settings=lambda config: config.lanes.ahead > 0,
        legend=f"next one {where} along the lane",
    )
    for name, where in (("leads", "ahead"), ("follows", "behind"))
)


# Which vehicles are parked: what can be told only when all of a trace has been seen -------------

MOVED: Final = 0.3
"""An entity that stays within this distance of its first position has not moved: poses tremble; m."""


class Parking:
    """Record of a trace's vehicles that finds parked ones; memory grows with vehicles, not with time.

    A vehicle is parked if the simulator marks it as static. It is also parked if it does not move
    in the whole trace and a lane for driving is never its primary lane. Without a map, or without
    time in range, the state of an unmoved vehicle is unknown. A moving vehicle is never parked.
    """

    def __init__(self) -> None:
        self._vehicle: Bools = np.zeros(0, np.bool_)
        self._static: Bools = np.zeros(0, np.bool_)
        self._moved: Bools = np.zeros(0, np.bool_)
        # Row 0: in graphs; row 1: in all known states.
        self._stood: Bools = np.zeros((2, 0), np.bool_)
        self._drove: Bools = np.zeros((2, 0), np.bool_)
        self._place: Floats = np.zeros((0, 2))

    def learn(self, entities: Entities) -> None:
        """Register entities on their first appearance."""
        no: Bools = np.zeros(len(entities), np.bool_)
        self._vehicle = np.append(self._vehicle, IS_VEHICLE[entities.kind])
        self._static = np.append(self._static, entities.static)
        self._moved = np.append(self._moved, no)
        both = np.stack([no, no])
        self._stood, self._drove = (
            np.concatenate([known, both], axis=1) for known in (self._stood, self._drove)
        )
        self._place = np.concatenate([self._place, np.full((len(entities), 2), np.nan)])

    def see(self, states: States) -> None:
        """Register positions, in the order of frames."""
        place = np.column_stack([states.x, states.y])
        node = states.node
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        new, first = np.unique(node[known], return_index=True)
        unseen = np.isnan(self._place[new, 0])
        self._place[new[unseen]] = place[known[first[unseen]]]
        away = np.hypot(*(place - self._place[node]).T) > MOVED
        self._moved[node[away]] = True

    def stand(
        self, bodies: Bodies, standing: Standing, driving: Bools, *, beyond: bool = False
    ) -> None:
        """Register the map parts under bodies; ``driving`` is the mask of driving lanes among the map nodes.

        ``beyond``: the bodies are all known ones, not only those in graphs.
        """
        hits = standing.hits
        primary = hits.primary & driving[-1 - hits.lane]
        self._drove[int(beyond), bodies.node[hits.row[primary]]] = True
        self._stood[int(beyond), bodies.node] = True

    @property
    def parked(self) -> Codes:
        """Return the parked state of each entity in graphs: 1 parked, 0 not, -1 unknown or no vehicle."""
        return self._parked(0)

    @property
    def world_parked(self) -> Codes:
        """Return the parked state of each entity from all known states; codes as in :meth:`parked`."""
        return self._parked(1)

    def _parked(self, row: int) -> Codes:
        known = self._stood[row] | self._moved | self._static
        parked = self._static | ~(self._moved | self._drove[row])
        return np.where(self._vehicle & known, parked, -1).astype(np.int8)
