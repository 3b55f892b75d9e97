"""Graph of the lanes of a map and their successors, and positions along the centre lines of lanes."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.numba_loops import worth
from sgstore.base.tables import spread
from sgstore.graphs.relations._scene import parts
from sgstore.model.vocabulary import RELATION_CODE, TRAFFIC

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.maps.roads import Ribbons, RoadMap
    from sgstore.model.world import Floats, Ints

    Rows = NDArray[np.intp]


class LaneNet:
    """Graph of the lanes of a map and their successors. Lanes are counted from 0.

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
        """Return the successors of lanes as pairs: index of the query, successor lane."""
        first = self._first[lane]
        owner, index = spread(first, self._first[lane + 1] - first)
        return owner, self._next[index]

    def upstream(self, lane: int, along: float, limit: float) -> Ints:
        """Return the given lane, and lanes before it that end within ``limit`` metres of a position on it."""
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


RUN: Final = 8
"""Number of centre line pieces that one test can skip together."""


class Centrelines:
    """Centre lines of all lanes, to find positions along lanes.

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
        """Return the length along each lane's centre line to the point nearest to a given position; m.

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
        """Return pairs: a position, and a piece of its lane's centre line that may be nearest to it."""
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
