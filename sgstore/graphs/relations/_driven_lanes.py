"""Choice of the lane in which a vehicle crosses a junction: the cheapest path along connected lanes.

Lanes of a junction overlap, so that one footprint fits several of them. The *driven lane* is on the
cheapest path along ``travelsTo`` over all frames of a *crossing*, the part of a drive near junctions. The
cost of a path is its evidence (overlap, heading, offset) for each metre driven. It is much higher if the
lanes of the path are not linked.

In a recording, a crossing is decided after its last frame: :meth:`DrivenLanes.chosen` holds blocks
back until then. A crossing of more than :data:`MOST_STATES` states of the recording is decided in
parts, so that memory does not grow with time. Where blocks end does not matter. In online mode only
the past counts (:meth:`DrivenLanes.now`): the costs so far make the choice stable.

A choice is *unsure* if a lane that is not linked to it costs almost the same. In online mode later
frames can reverse a choice. It is then unsure until the other ways have ended, and while another lane
fits better. At equal costs, the lane with the lower number is chosen.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

import numpy as np

from sgstore.base.tables import begins, chained, spread, taken
from sgstore.graphs.relations._lane_net import LaneNet
from sgstore.graphs.relations._scene import IS_VEHICLE, joined
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.maps.roads import LaneHits, RoadMap
    from sgstore.model.world import Bools, Codes, Floats, FrameBlock, Ints

    Rows = NDArray[np.intp]


MOST_STATES: Final = 1 << 17
"""Number of states of a recording after which a crossing is decided in parts."""

APART: Final = 3
"""Number of frames away from all junctions after which a vehicle's crossing ends."""

NEAR: Final = 3.0
"""Largest distance of a vehicle's centre from junction lanes during a crossing; m."""

HOPS: Final = 3
"""Largest number of lane links between two successive frames. A short lane may have no frame of its own."""

SIDE: Final = 2.0
"""Cost of a change to the neighbouring lane. It equals 2 m of driving with the centre on the border."""

MISS: Final = 3.0
"""Cost of a lane that the vehicle does not touch, for each metre."""

JUMP: Final = 100.0
"""Cost of a change to a lane without a link from the current lane."""

SURE: Final = 0.3
"""Difference of costs above which the choice of a lane is certain."""

OPEN: Final = 60.0
"""Online mode: difference of costs up to which later frames can still reverse the choice of a lane."""

BESIDE: Final = 1.0
"""Online mode: the smaller difference of costs that applies to a neighbouring lane."""

EQUAL: Final = 1e-3
"""Difference of costs that is only rounding."""

LEAST: Final = 0.01
"""Smallest weight of a frame, used while a vehicle stands."""


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Lanes that vehicles touch near junctions, one row per vehicle, frame and lane; shape (n,).

    Attributes
    ----------
    node : int64
        Vehicle.
    seq, row : int64
        Number of the frame and of the state in the trace.
    inside : bool
        True if the vehicle touches a lane for traffic of a junction in this frame.
    lane : int64
        Lane, counted from 0.
    x, y : float64
        Place of the vehicle; m.
    cost : float64
        Mismatch of footprint and lane for each metre; of earlier frames in online mode, the sum.
    """

    node: Ints
    seq: Ints
    row: Ints
    inside: Bools
    lane: Ints
    x: Floats
    y: Floats
    cost: Floats

    def __len__(self) -> int:
        return len(self.node)


_NO_NUMBERS: Final = np.zeros(0, np.int64)
_NO_VALUES: Final = np.zeros(0)
_NONE: Final = _Candidates(
    *(_NO_NUMBERS, _NO_NUMBERS, _NO_NUMBERS, np.zeros(0, np.bool_), _NO_NUMBERS),
    *(_NO_VALUES, _NO_VALUES, _NO_VALUES),
)


class _Junctions:
    """Junctions of a map: their area, and the links between its lanes."""

    def __init__(self, road_map: RoadMap) -> None:
        net, edges, count = LaneNet(road_map), road_map.edges, len(road_map.ribbons)
        self.traffic, self.widths = net.traffic, np.maximum(net.widths, 1.0)
        self.lanes: Bools = net.traffic & (net.junction >= 0)
        self._count = count
        of = {name: edges.relation == RELATION_CODE[name] for name in _BESIDE}
        src, dst = -2 - edges.src, -2 - edges.dst
        opposed = src[of["opposes"]] * count + dst[of["opposes"]]
        beside = of["toLeftOf"] | of["toRightOf"]
        beside &= (src >= 0) & (dst >= 0)
        self._beside: Ints = np.setdiff1d(src[beside] * count + dst[beside], opposed)
        first, lane = np.arange(count), np.arange(count)
        linked = [first * count + lane]
        for _ in range(HOPS):
            owner, lane = net.onward(lane)
            first = first[owner]
            linked.append(first * count + lane)
        self._linked = np.unique(np.concatenate(linked)).astype(np.int64)
        self.surface = road_map.surface_of(np.flatnonzero(self.lanes), NEAR)

    def toll(self, src: Ints, dst: Ints) -> Floats:
        """Return the cost to change from one lane to another between two frames; 0 if they are linked."""
        key = src * self._count + dst
        beside = np.where(_among(self._beside, key), SIDE, JUMP)
        return np.where(_among(self._linked, key), 0.0, beside)


_BESIDE: Final = ("toLeftOf", "toRightOf", "opposes")

_KNOWN: WeakKeyDictionary[RoadMap, _Junctions] = WeakKeyDictionary()


def _junctions_of(road_map: RoadMap | None) -> _Junctions | None:
    """Return the junctions of a map; ``None`` if no lane is in a junction. They are computed once per map."""
    if road_map is None:
        return None
    found = _KNOWN.get(road_map)
    if found is None:
        found = _KNOWN[road_map] = _Junctions(road_map)
    return found if found.lanes.any() else None


def _among(keys: Ints, wanted: Ints) -> Bools:
    if not len(keys):
        return np.zeros(len(wanted), np.bool_)
    return keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted


class DrivenLanes:
    """Choice of the lane of each vehicle in the junctions of a map, for one trace.

    Parameters
    ----------
    road_map : RoadMap or None
        ``None`` means a trace without lanes.
    """

    def __init__(self, road_map: RoadMap | None) -> None:
        self._map = road_map
        self._kinds: Codes = np.zeros(0, np.int8)
        self._open = _NONE
        self._states = 0
        self._asked = deque["_Lookups"]()

    @cached_property
    def _junctions(self) -> _Junctions | None:
        return _junctions_of(self._map)

    def chosen(self, blocks: Iterable[FrameBlock]) -> Iterator[FrameBlock]:
        """Yield the blocks of a recording. Their states contain the chosen lanes in junctions."""
        if self._junctions is None:
            yield from blocks
            return
        waiting, lane = deque["FrameBlock"](), np.zeros(0, np.int64)
        for block in chain(blocks, [None]):
            if block is not None:
                found = self._candidates(self._junctions, block, block.states.node)
                self._open = _sorted([self._open, found])
                lane = np.append(lane, np.zeros(len(block.states), np.int64))
                waiting.append(block)
            first = self._states - len(lane)
            for row, driven in self._decided(self._junctions, block):
                lane[row - first] = driven
            settled = int(self._open.row.min(initial=self._states)) - first
            while waiting and len(waiting[0].states) <= settled:
                ready = waiting.popleft()
                count = len(ready.states)
                yield _with_lanes(ready, lane[:count])
                self._asked.popleft()
                lane, settled = lane[count:], settled - count

    def _decided(
        self, junctions: _Junctions, block: FrameBlock | None
    ) -> Iterator[tuple[Ints, Ints]]:
        """Choose the lane of each vehicle that has left a junction. Yield rows of states, and their lanes.

        ``block`` is the last block so far; ``None`` means that the recording is over.
        """
        again = True
        while again and len(self._open):
            of = self._open
            run = np.cumsum(begins(of.node) | (np.diff(of.seq, prepend=0) > APART))
            first = of.row[begins(run)][run - 1]
            late = of.row - first >= MOST_STATES
            run = np.cumsum(begins(run, late))
            last = np.flatnonzero(np.append(run[1:] != run[:-1], True))
            over = np.append(of.node[last[1:]] == of.node[last[:-1]], False)
            if block is None:
                over[:] = True
            elif len(block):
                over |= of.seq[last] < block.seq[-1] - APART
            over = over[run - 1] & ~late
            again = bool(late.any())
            self._open = taken(of, ~over)
            crossings = _Crossings(junctions, *_filled(taken(of, over), run[over]))
            cost = crossings.of.cost * crossings.metres
            cost = crossings.onward(cost) + crossings.back(cost) - cost
            yield crossings.chosen(cost, crossings.apart(cost) & (crossings.more(cost) < SURE))

    def lanes_of(self, boxes: Floats, z: Floats) -> LaneHits:
        """Return the lanes that footprints touch, as :class:`RoadMap` does. Use the cache of the last block."""
        known = self._asked[0] if self._asked else self._map
        if known is None:
            raise ValueError("lanes need a map")
        return known.lanes_of(boxes, z)

    def now(self, block: FrameBlock, node: Ints) -> FrameBlock:
        """Return the next frame in online mode. Its states contain the chosen lanes in junctions.

        Parameters
        ----------
        block : FrameBlock
            Of one frame.
        node : (N,) int64
            Numbers of the entities that stay the same over all frames.
        """
        if self._junctions is None:
            return block
        start = self._states
        found = self._candidates(self._junctions, block, node)
        recent = taken(self._open, self._open.seq >= int(block.seq[0]) - APART)
        of = _sorted([recent, found])
        crossings = _Crossings(self._junctions, of, np.cumsum(begins(of.node), dtype=np.int64))
        here = of.row >= start
        cost = crossings.onward(np.where(here, of.cost * crossings.metres, of.cost))
        row, driven = crossings.chosen(cost, crossings.may_change(cost))
        lane = np.zeros(len(block.states), np.int64)
        lane[row[row >= start] - start] = driven[row >= start]
        over = ~here & np.isin(of.node, found.node)
        self._open = taken(replace(of, cost=cost - crossings.least(cost)), ~over)
        self._asked.clear()
        return _with_lanes(block, lane)

    def _candidates(self, junctions: _Junctions, block: FrameBlock, node: Ints) -> _Candidates:
        """Return the lanes that the vehicles of the next block touch near junctions."""
        states, entities = block.states, block.entities
        self._kinds = np.concatenate([self._kinds[: entities.first], entities.kind])
        start, self._states = self._states, self._states + len(states)
        rows = np.flatnonzero(IS_VEHICLE[self._kinds[states.node]])
        rows = rows[junctions.surface.near(states.x[rows], states.y[rows])]
        rows = rows[np.argsort(node[rows], kind="stable")]
        of = states.take(rows)
        box = np.stack([of.x, of.y, of.heading, of.length, of.width], axis=1)
        box = np.column_stack([box, of.z - np.nan_to_num(of.height) / 2])
        # A vehicle that stands is looked up once.
        moved = begins(node[rows], *box.view(np.int64).T)
        assert self._map is not None  # noqa: S101 - it has junctions
        self._asked.append(_Lookups(self._map, box[moved]))
        hits = self._asked[-1].hits
        owner, hit = joined(hits.row, np.cumsum(moved) - 1)
        lane, row = -2 - hits.lane[hit], rows[owner]
        inside = np.bincount(owner, weights=junctions.lanes[lane], minlength=len(rows)) > 0
        aside = np.abs(hits.offset) / junctions.widths[-2 - hits.lane]
        cost = 1 - hits.overlap + np.abs(hits.heading_error) + np.minimum(aside, 1.0)
        return _Candidates(
            node[row],
            block.seq[block.frame_of[row]],
            start + row,
            inside[owner],
            lane,
            of.x[owner],
            of.y[owner],
            np.nan_to_num(cost, nan=1.0)[hit],
        )


class _Lookups:
    """Cache of the lanes below the footprints in a block. The lane choice and the graphs use it."""

    def __init__(self, road_map: RoadMap, box: Floats) -> None:
        self._map, self._box = road_map, box
        self.hits = road_map.lanes_of(box[:, :5], box[:, 5])
        keys = _keys(box)
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    def lanes_of(self, boxes: Floats, z: Floats) -> LaneHits:
        """Return the lanes that footprints touch, as :meth:`RoadMap.lanes_of` does."""
        if not len(self._keys):
            return self._map.lanes_of(boxes, z)
        box = np.column_stack([boxes, z])
        place = np.searchsorted(self._keys, _keys(box))
        twin = self._order[np.minimum(place, len(self._keys) - 1)]
        same = (self._box[twin].view(np.int64) == box.view(np.int64)).all(axis=1)
        known, new = np.flatnonzero(same), np.flatnonzero(~same)
        asked = self._map.lanes_of(boxes[new], z[new])
        owner, index = joined(self.hits.row, twin[known])
        both = chained(
            [
                replace(taken(self.hits, index), row=known[owner]),
                replace(asked, row=new[asked.row]),
            ]
        )
        return taken(both, np.argsort(both.row, kind="stable"))


def _keys(box: Floats) -> Ints:
    """Return a hash of each footprint."""
    return (box.view(np.int64) * _ODD).sum(axis=1)


_ODD: Final = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1, 0x2545F491])


def _sorted(tables: Sequence[_Candidates]) -> _Candidates:
    of = chained(tables)
    return taken(of, np.lexsort((of.lane, of.seq, of.node)))


def _filled(of: _Candidates, run: Ints) -> tuple[_Candidates, Ints]:
    """If a vehicle touches a lane again, make the lane a candidate in the frames between, at a high cost."""
    new = begins(run, of.seq)
    frame, first = np.cumsum(new) - 1, np.flatnonzero(new)
    order = np.lexsort((frame, of.lane, run))
    lane, at = of.lane[order], frame[order]
    again = np.flatnonzero(~begins(run[order], lane) & (np.diff(at, prepend=0) > 1))
    owner, missed = spread(at[again - 1] + 1, np.diff(at, prepend=0)[again] - 1)
    more = replace(
        taken(of, first[missed]), lane=lane[again][owner], cost=np.full(len(missed), MISS)
    )
    of, run = chained([of, more]), np.append(run, run[first[missed]])
    order = np.lexsort((of.lane, of.seq, run))
    return taken(of, order), run[order]


def _with_lanes(block: FrameBlock, lane: Ints) -> FrameBlock:
    return replace(block, states=replace(block.states, lane=lane))


class _Crossings:
    """Candidate lanes of vehicles that cross a junction, sorted by crossing, frame and lane.

    Parameters
    ----------
    junctions : _Junctions
    of : _Candidates
    run : (n,) int64
        Number of the crossing of each candidate, ascending.
    """

    def __init__(self, junctions: _Junctions, of: _Candidates, run: Ints) -> None:
        self.of, self._junctions = of, junctions
        new = begins(run, of.seq)
        self._first, self._frame = np.flatnonzero(new), np.cumsum(new) - 1
        count = np.diff(self._first, append=len(of))
        goes_on = ~begins(run[self._first])
        self._step = self._frame - self._frame[begins(run)][np.cumsum(begins(run)) - 1]
        before = np.maximum(self._frame - 1, 0)
        many = np.where(goes_on[self._frame], count[before], 0)
        # Pairs of a candidate and one of the frame before.
        self._dst, self._src = spread(self._first[before], many)
        self._toll = junctions.toll(of.lane[self._src], of.lane[self._dst])
        x, y = of.x[self._first], of.y[self._first]
        metres = np.hypot(np.diff(x, prepend=0.0), np.diff(y, prepend=0.0))
        metres = np.where(goes_on, np.maximum(metres, LEAST), 1.0)
        self.metres = np.nan_to_num(metres, nan=LEAST)[self._frame]

    def onward(self, cost: Floats) -> Floats:
        """Return the least cost of a path from the start of a crossing to each candidate lane."""
        return _summed(cost, self._step, self._src, self._dst, self._toll)

    def back(self, cost: Floats) -> Floats:
        """Return the least cost of a path from each candidate lane to the end of the crossing."""
        return _summed(cost, -self._step, self._dst, self._src, self._toll)

    def least(self, cost: Floats) -> Floats:
        """For each candidate lane, return the cost of the cheapest candidate in the same frame."""
        return np.minimum.reduceat(cost, self._first)[self._frame] if len(cost) else cost

    def more(self, cost: Floats) -> Floats:
        """Return how much more each candidate lane costs than the cheapest one of its frame."""
        return cost - self.least(cost)

    def best(self, cost: Floats) -> Ints:
        """Return the cheapest candidate lane of each frame."""
        best = np.flatnonzero(self.more(cost) <= EQUAL)
        return best[begins(self._frame[best])]

    def _toll_of(self, cost: Floats) -> Floats:
        """Return the cost to change between each candidate lane and the best one; 0 without traffic."""
        lane, toll = self.of.lane, self._junctions.toll
        best = lane[self.best(cost)][self._frame]
        change = np.minimum(toll(lane, best), toll(best, lane))
        return np.where(self._junctions.traffic[lane] & (lane != best), change, 0.0)

    def apart(self, cost: Floats) -> Bools:
        """Return a mask of the candidate lanes that are not linked with the best lane of their frame."""
        return self._toll_of(cost) == JUMP

    def may_change(self, cost: Floats) -> Bools:
        """Return a mask of the candidate lanes that could still become the best lane with later frames."""
        toll, more, own = self._toll_of(cost), self.more(cost), self.of.cost
        fits = own < own[self.best(cost)][self._frame]
        return (toll == JUMP) & (fits | (more < OPEN)) | (toll == SIDE) & (fits | (more < BESIDE))

    def chosen(self, cost: Floats, others: Bools) -> tuple[Ints, Ints]:
        """Return the rows of states in junctions, and the lane chosen for each, in the form of ``States``.

        ``others`` are the candidates that make a choice unsure.
        """
        best = self.best(cost)
        lane, inside = self.of.lane[best], self.of.inside[best]
        unsure = np.bincount(self._frame, weights=others, minlength=len(best)) > 0
        driven = np.where(unsure, 2 + lane, -2 - lane)
        return self.of.row[best][inside], driven[inside]


def _summed(cost: Floats, step: Ints, src: Rows, dst: Rows, toll: Floats) -> Floats:
    """Return the cost of the cheapest path to each candidate lane, computed frame by frame."""
    total, order = cost.copy(), np.lexsort((dst, step[dst]))
    src, dst, toll = src[order], dst[order], toll[order]
    heads = np.flatnonzero(begins(dst))
    ends = np.append(heads, len(dst))
    for a, b in pairwise([*np.flatnonzero(begins(step[dst[heads]])).tolist(), len(heads)]):
        pairs = slice(ends[a], ends[b])
        ways = total[src[pairs]] + toll[pairs]
        total[dst[heads[a:b]]] += np.minimum.reduceat(ways, heads[a:b] - heads[a])
    return total
