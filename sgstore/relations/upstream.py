"""Which lanes a signal may affect: those from which it lies ahead."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations.scene import IS_SIGNAL
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.relations.along import Centrelines
    from sgstore.relations.lanenet import LaneNet
    from sgstore.roads import RoadMap
    from sgstore.world import Bools, Ints


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
        self._nodes, self._net, self._lines, self._ahead = road_map.nodes, net, lines, ahead
        edges = road_map.edges
        controls = (edges.relation == RELATION_CODE["controlsTrafficOf"]) & (ahead > 0)
        self._src, self._dst = edges.src[controls], edges.dst[controls]
        self._columns = np.unique(-1 - self._src)
        self._columns = self._columns[IS_SIGNAL[road_map.nodes.kind[self._columns]]]
        self._of = {road_map.nodes.name[column]: column for column in self._columns.tolist()}
        self._known: dict[int, Ints] = {}

    def of(self, signal: str) -> Ints:
        """Node ids of the lanes that a signal of the map may affect; none for one that is not there."""
        column = self._of.get(signal)
        return np.zeros(0, np.int64) if column is None else self._lanes(column)

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
            x, y = self._nodes.x[column], self._nodes.y[column]
            controlled = -2 - self._dst[self._src == -1 - column]
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
            self._known[column] = -2 - np.array(sorted(lanes), np.int64)
        return self._known[column]
