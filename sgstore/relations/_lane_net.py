"""Lanes as a graph: order along lanes, and lanes upstream of signals.

The lanes of a map as a net of ways, and what of it can be told without any traffic.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations._scene import IS_SIGNAL, parts, spread
from sgstore.vocabulary import RELATION_CODE, TRAFFIC

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.roads import Ribbons, RoadMap
    from sgstore.world import Bools, Floats, Ints

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


# Where along a lane a place is: the foot of the perpendicular on its centre line ----------------


class Centrelines:
    """The centre lines of all lanes, to be asked for places along them.

    Parameters
    ----------
    ribbons : Ribbons
        Of which the straight lines between the middles of cross sections are taken.
    """

    def __init__(self, ribbons: Ribbons) -> None:
        self._first = ribbons.offsets[:-1]
        self._count = np.diff(ribbons.offsets) - 1
        x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
        self._x, self._y, self._along = x, y, ribbons.along
        self._run_x, self._run_y = np.diff(x), np.diff(y)
        squared = self._run_x**2 + self._run_y**2
        self._squared = np.where(squared > 0, squared, 1.0)

    def along(self, lane: Ints, x: Floats, y: Floats) -> Floats:
        """Length of the centre line from the lane's start up to the foot of the perpendicular from a place.

        Parameters
        ----------
        lane : (N,) int64
            Lanes, counted from 0.
        x, y : (N,) float64
            Places; m.

        Returns
        -------
        (N,) float64
            m. The foot is the nearest point, of several the first; where that is an end of the lane, it is
            where the lane would be if it went straight on: below 0, or above its length.
        """
        count = self._count[lane]
        found = np.empty(len(lane))
        for part in parts(count):
            found[part] = self._of(self._first[lane[part]], count[part], x[part], y[part])
        return found

    def _of(self, first: Ints, count: Ints, x: Floats, y: Floats) -> Floats:
        owner, piece = spread(first, count)
        if not len(owner):
            return np.zeros(len(first))
        run_x, run_y = self._run_x[piece], self._run_y[piece]
        away_x, away_y = x[owner] - self._x[piece], y[owner] - self._y[piece]
        onward = (away_x * run_x + away_y * run_y) / self._squared[piece]
        share = np.minimum(np.maximum(onward, 0.0), 1.0)
        squared = (away_x - share * run_x) ** 2 + (away_y - share * run_y) ** 2
        starts = np.cumsum(count) - count
        least = np.repeat(np.minimum.reduceat(squared, starts), count)
        # Every lane has a piece at least, so each owner has a first that is the nearest.
        nearest = np.flatnonzero(squared == least)
        _, at = np.unique(owner[nearest], return_index=True)
        at = nearest[at]
        before, after = self._along[piece[at]], self._along[piece[at] + 1]
        out = ((at == starts) & (onward[at] < 0)) | ((at == starts + count - 1) & (onward[at] > 1))
        return before + np.where(out, onward[at], share[at]) * (after - before)


# Which lanes a signal may affect: those from which it lies ahead --------------------------------


class SignalReach:
    """The lanes upstream of the signals of a map, looked up when first asked.

    A signal stands on each lane that it controls, where the map has it, at the foot of the perpendicular. It
    may affect this lane, and those that end at most the given distance before it along the lanes.

    Parameters
    ----------
    road_map : RoadMap
    net : LaneNet
    lines : Centrelines
    ahead : float
        The distance; m. 0: nothing is affected.
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
        """Node ids of the lanes that a signal may affect; none for one whose lanes nobody knows.

        Parameters
        ----------
        signal : str
            Its id in the map, or what :func:`sgstore.roads.lanes_ref` makes of its lanes.
        place : (float, float)
            Where it stands, if the map does not have it; m, NaN if unknown.
        """
        column = self._of.get(signal)
        if column is not None:
            return self._lanes(column)
        if not self._ahead:
            return np.zeros(0, np.int64)
        return self._upstream(-2 - self._map.lanes_of_signal(signal), *place)

    def of_map(self, present: Bools) -> tuple[Ints, Ints]:
        """Node ids of the signals of the map that are present in any frame, and of lanes that they may affect.

        Parameters
        ----------
        present : (F, K) bool
            Which nodes of the map are in which graph.
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
        """Node ids of lanes, and of those before them; both given as rows of the lanes."""
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
