"""The lanes of a map as a net of ways, and what of it can be told without any traffic."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

import numpy as np

from sgstore.opendrive.nodes import TRAFFIC
from sgstore.relations.scene import spread
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.roads import RoadMap
    from sgstore.world import Ints

    Rows = NDArray[np.intp]


class LaneNet:
    """The lanes of a map as a net of ways, counted from 0.

    Parameters
    ----------
    road_map : RoadMap

    Attributes
    ----------
    lengths, widths : (L,) float64
        Lengths and mean widths; m.
    traffic : (L,) bool
        Whether they are made for vehicles of any kind.
    junction : (L,) int64
        Number of the junction; -1 where there is none.
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
        src, dst = -2 - edges.src[flow], -2 - edges.dst[flow]  # waypoints have ways of their own
        order = np.lexsort((dst, src))
        self._next = dst[order]
        self._first = np.searchsorted(src[order], np.arange(count + 1))
        order = np.lexsort((src, dst))
        self._before = src[order]
        self._from = np.searchsorted(dst[order], np.arange(count + 1))

    def onward(self, lane: Ints) -> tuple[Rows, Ints]:
        """For each lane in turn the lanes that follow: rows of the question, and lanes."""
        first = self._first[lane]
        owner, index = spread(first, self._first[lane + 1] - first)
        return owner, self._next[index]

    def upstream(self, lane: int, along: float, limit: float) -> Ints:
        """Lanes from which a place lies ahead: its own, and those that end up to ``limit`` m before it."""
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
