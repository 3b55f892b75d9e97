"""Relations ``leads`` and ``follows``: the next vehicle ahead on the same lanes.

``leads`` is from the next vehicle ahead along the lanes, ``follows`` is to it.

Vehicles take part, also parked ones, on lanes for traffic that they face along (by less than a
right angle). A vehicle that never moves follows no other. A trailer does not follow its tractor.

*Own lanes* are the primary lane of an entity. While the driven lane in a junction is not sure, they
are also the lanes of the junction that contain its centre and, for a vehicle, have its direction
(:data:`SAME_WAY`). They are stored, because the distance along the lanes (``lane_dist``) depends on
them.

*The next one ahead* is the first vehicle after the vehicle's centre along the lane. If there is
none on this lane, the search continues along ``travelsTo``, also through junctions. At a fork each
branch has a next one: the future way is unknown, so all of them lead the vehicle, with different
gaps. Where ways join, vehicles on several ways can have the same next one. At equal distance the
lower node id counts as nearer. Lane changes are not followed. A vehicle farther along the lanes
than the settings allow leads no other.

*In online mode* an edge exists only if it does so on every lane that an unsure vehicle may drive.
All other leaders of a vehicle are unknown if such a vehicle may be one of them.

*The gap* is the distance of the centres along the centre lines minus half of both lengths: from
bumper to bumper, 0 for an overlap, missing for an unknown length. Of several ways the shortest
counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.tables import begins
from sgstore.graphs.relations._scene import IS_VEHICLE, Relation, carried_by, edges_between
from sgstore.model.graph import Edges, LaneGaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.graphs.relations._lane_net import LaneNet
    from sgstore.graphs.relations._scene import BlockScene, Bodies, MapContext, Standing
    from sgstore.maps.roads import LaneHits
    from sgstore.model.world import Bools, Floats, Ints

    Rows = NDArray[np.intp]
    Column = tuple[Rows, Rows, Floats]
    Best = tuple[Ints, Floats]


SAME_WAY: Final = np.pi / 4
"""Largest angle between a vehicle and its lane in a junction; rad."""


@dataclass(frozen=True, slots=True)
class OwnLanes:
    """Vehicles on the lanes that they drive on, sorted by frame, lane and position on the lane; shape (N,).

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
        """Return the first vehicle on each lane, other than ``but``, as pairs: query row, vehicle row."""
        place = np.searchsorted(self.key, key)
        last = max(len(self.key) - 1, 0)
        itself = (self.row[np.minimum(place, last)] == but) & (place <= last)
        place += itself & (self.key[np.minimum(place, last)] == key)
        found = np.flatnonzero((place <= last) & (self.key[np.minimum(place, last)] == key))
        return found, place[found]


def own_hits(net: LaneNet, bodies: Bodies, hits: LaneHits) -> Bools:
    """Return a mask of touched lanes: the primary lane of each object, and parallel lanes in its junction."""
    lane = -2 - hits.lane
    junction = np.full(len(bodies), -1)
    junction[hits.row[hits.primary]] = net.junction[lane[hits.primary]]
    within = np.abs(hits.offset) <= net.widths[lane] / 2
    beside = (net.junction[lane] >= 0) & (net.junction[lane] == junction[hits.row])
    its_way = (np.abs(hits.heading_error) <= SAME_WAY) | ~IS_VEHICLE[bodies.kind[hits.row]]
    return hits.primary | (beside & within & its_way)


def own_lanes(net: LaneNet, bodies: Bodies, standing: Standing) -> OwnLanes:
    """Return the vehicles on the lanes that they drive on, if they face in the direction of the lane."""
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
    """Return pairs of a vehicle and the next vehicle ahead, with their gap along the lanes.

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
    first = begins(a, b)
    a, b = a[first], b[first]
    gap = distance[first] - (bodies.length[a] + bodies.length[b]) / 2
    return a, b, np.maximum(gap, 0)


def following(
    net: LaneNet, bodies: Bodies, standing: Standing, limit: float
) -> tuple[Column, Rows]:
    """Return only the certain pairs of :func:`next_ahead`, and the vehicles without a certain one."""
    found = next_ahead(net, bodies, standing, limit)
    if not len(standing.unsure):
        return found, standing.unsure
    sure = standing.own & ~np.isin(standing.hits.row, standing.unsure)
    less = next_ahead(net, bodies, replace(standing, own=sure), limit)
    known = ([np.nan_to_num(c, nan=-1).tolist() for c in of] for of in (found, less))
    one, other = (dict.fromkeys(zip(*columns, strict=True)) for columns in known)
    kept = np.flatnonzero([pair in other for pair in one])
    doubted = np.array([a for a, *_ in one.keys() ^ other.keys()], np.intp)
    column = found[0][kept], found[1][kept], found[2][kept]
    return column, np.union1d(doubted, standing.unsure)


def _beyond(net: LaneNet, own: OwnLanes, limit: float) -> list[Column]:
    """For the frontmost vehicle on each lane, find the next vehicle ahead on the lanes after it."""
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
    """For each key, return the row with the smallest distance, if below the best so far; and the new best."""
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
    """Return the pairs of a following and a leading vehicle as node ids, and their gaps along lanes."""
    none = np.zeros(0, np.intp)
    a, b, gap = (none, none, np.zeros(0)) if ground is None else ground.following
    return LaneGaps(bodies.frame[a], bodies.node[a], bodies.node[b], gap)


def _edges(scene: BlockScene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("leads and follows need a map")
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
