"""Detection of parked vehicles, after a whole trace is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.graphs.relations._scene import IS_VEHICLE

if TYPE_CHECKING:
    from sgstore.graphs.relations._scene import Bodies, Standing
    from sgstore.model.world import Bools, Codes, Entities, Floats, States


MOVED: Final = 0.3
"""An entity that stays within this distance of its first position has not moved: poses tremble; m."""


class Parking:
    """Record of the vehicles of a trace that detects parked ones. Memory grows with vehicles, not time.

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
        """Record the new objects of a block of frames, to detect parked vehicles later."""
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
        """Record the positions of vehicles in the next frames."""
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
        """Record the lanes and other map parts below vehicles in the next frames.

        ``beyond``: the bodies are all known ones, not only those in graphs.
        """
        hits = standing.hits
        primary = hits.primary & driving[-1 - hits.lane]
        self._drove[int(beyond), bodies.node[hits.row[primary]]] = True
        self._stood[int(beyond), bodies.node] = True

    @property
    def parked(self) -> Codes:
        """Parked state of each object in graphs: 1 parked, 0 not, -1 unknown or no vehicle."""
        return self._parked(0)

    @property
    def world_parked(self) -> Codes:
        """Parked state of each object, from its states inside and outside the graphs."""
        return self._parked(1)

    def _parked(self, row: int) -> Codes:
        known = self._stood[row] | self._moved | self._static
        parked = self._static | ~(self._moved | self._drove[row])
        return np.where(self._vehicle & known, parked, -1).astype(np.int8)
