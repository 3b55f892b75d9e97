"""Relation ``mayAffect``: the lanes that lead to a traffic signal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.graphs.relations._scene import IS_SIGNAL
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.graphs.relations._lane_net import Centrelines, LaneNet
    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import Bools, Ints


class SignalReach:
    """Lanes that lead to each traffic signal of a map, computed on first use.

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
        """Return node ids of the lanes that a traffic signal may affect; empty if its lanes are unknown.

        Parameters
        ----------
        signal : str
            Its id in the map, or the result of :meth:`sgstore.maps.roads.RoadMap.lanes_ref`.
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
        """Return pairs of node ids: a map signal that occurs in some frame, and a lane that it may affect.

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
        """Return the node ids of the given lanes, and of the lanes that lead to them."""
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
