"""Which vehicles are parked: what can be told only when all of a trace has been seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.relations.following import IS_VEHICLE

if TYPE_CHECKING:
    from sgstore.relations.scene import Bodies, Standing
    from sgstore.world import Bools, Codes, Entities, Floats, States

MOVED: Final = 0.3
"""What has not come farther than this from where it was first seen has not moved: poses tremble; m."""


class Parking:
    """What a trace tells of its vehicles so far, whoever sees them; it grows with their number, not with time.

    A vehicle is parked if the simulator has it as static; or if it does not move in the whole trace and never
    stands on a lane for driving above all others (its primary lane). Without a map nothing is known of those
    that do not move, nor of those that were never in range; whatever moves is not parked.
    """

    def __init__(self) -> None:
        self._vehicle: Bools = np.zeros(0, np.bool_)
        self._static: Bools = np.zeros(0, np.bool_)
        self._moved: Bools = np.zeros(0, np.bool_)
        self._stood: Bools = np.zeros(0, np.bool_)
        self._drove: Bools = np.zeros(0, np.bool_)
        self._place: Floats = np.zeros((0, 2))

    def learn(self, entities: Entities) -> None:
        """Take note of entities that appear for the first time."""
        no: Bools = np.zeros(len(entities), np.bool_)
        self._vehicle = np.append(self._vehicle, IS_VEHICLE[entities.kind])
        self._static = np.append(self._static, entities.static)
        self._moved = np.append(self._moved, no)
        self._stood, self._drove = np.append(self._stood, no), np.append(self._drove, no)
        self._place = np.concatenate([self._place, np.full((len(entities), 2), np.nan)])

    def see(self, states: States) -> None:
        """Take note of where things are, in the order of frames."""
        place = np.column_stack([states.x, states.y])
        node = states.node
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        new, first = np.unique(node[known], return_index=True)
        unseen = np.isnan(self._place[new, 0])
        self._place[new[unseen]] = place[known[first[unseen]]]
        away = np.hypot(*(place - self._place[node]).T) > MOVED
        self._moved[node[away]] = True

    def stand(self, bodies: Bodies, standing: Standing, driving: Bools) -> None:
        """Take note of what things stand on; ``driving``: which nodes of the map are lanes for driving."""
        hits = standing.hits
        primary = hits.primary & driving[-1 - hits.lane]
        self._drove[bodies.node[hits.row[primary]]] = True
        self._stood[bodies.node] = True

    @property
    def parked(self) -> Codes:
        """(n,): 1: parked, 0: not, -1: not known, or no vehicle."""
        known = self._stood | self._moved | self._static
        parked = self._static | ~(self._moved | self._drove)
        return np.where(self._vehicle & known, parked, -1).astype(np.int8)
