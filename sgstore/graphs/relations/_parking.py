"""Detection of parked vehicles after the last frame of a trace."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.graphs.relations._scene import IS_VEHICLE
from sgstore.model.world import SMOOTHED, STANDS

if TYPE_CHECKING:
    from sgstore.graphs.relations._scene import Bodies, Standing
    from sgstore.model.world import Bools, Codes, Entities, Floats, FrameBlock, Ints


MOVED: Final = 0.3
"""Largest distance from the first position at which an object counts as not moved, because poses vary; m."""


STRAYED: Final = 2.0
"""Limit in place of :data:`MOVED` in recordings with noise, in which standing boxes vary more; m."""

SHARE: Final = 0.3
"""Smallest share of noisy frames in which a parked vehicle stands."""

DRIFT: Final = 0.2
"""Largest mean speed of a parked vehicle between its first and its last noisy position; m/s."""

IN_LANE: Final = 0.4
"""Smallest share of a noisy footprint in its primary lane for which the vehicle counts as in the lane."""

LEAST_NS: Final = 3_000_000_000 - 1_000
"""Shortest time for which a vehicle without a road map must be seen to count as parked; ns."""

NEVER: Final = np.iinfo(np.int64).min
"""Time value of a vehicle that was never seen."""


class Parking:
    """Detector of parked vehicles in a trace. Its memory grows with the vehicles, not with time.

    A vehicle is parked if the simulator marks it as static. It is also parked if it does not move
    in the whole trace and a lane for driving is never its primary lane. Without a map, it must be
    seen for 3 s. Without time in range of the map, or with less time, the state of an unmoved vehicle is
    unknown. A moving vehicle is never parked. In a recording with noise, it may stray while it stands, and
    reach into a lane by a part of its footprint.

    Parameters
    ----------
    on_map : bool
        True if the trace has a road map.
    """

    def __init__(self, *, on_map: bool) -> None:
        self._on_map = on_map
        # First and last time; number of frames with noise, and of those in which it stands.
        self._seen: Ints = np.zeros((4, 0), np.int64)
        self._vehicle: Bools = np.zeros(0, np.bool_)
        self._static: Bools = np.zeros(0, np.bool_)
        self._moved: Bools = np.zeros(0, np.bool_)
        # Row 0: in graphs; row 1: in all known states.
        self._stood: Bools = np.zeros((2, 0), np.bool_)
        self._drove: Bools = np.zeros((2, 0), np.bool_)
        self._place: Floats = np.zeros((0, 2))
        self._last: Floats = np.zeros((0, 2))

    def learn(self, entities: Entities) -> None:
        """Record the new objects of a block of frames, as candidates for parked vehicles."""
        no: Bools = np.zeros(len(entities), np.bool_)
        self._vehicle = np.append(self._vehicle, IS_VEHICLE[entities.kind])
        self._static = np.append(self._static, entities.static)
        self._moved = np.append(self._moved, no)
        both = np.stack([no, no])
        self._stood, self._drove = (
            np.concatenate([known, both], axis=1) for known in (self._stood, self._drove)
        )
        self._place = np.concatenate([self._place, np.full((len(entities), 2), np.nan)])
        self._last = np.concatenate([self._last, np.full((len(entities), 2), np.nan)])
        never = np.zeros((4, len(entities)), np.int64)
        never[:2] = NEVER
        self._seen = np.concatenate([self._seen, never], axis=1)

    def see(self, frames: FrameBlock) -> None:
        """Record the positions of vehicles in the next frames."""
        states = frames.states
        place = np.column_stack([states.x, states.y])
        node = states.node
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        new, first = np.unique(node[known], return_index=True)
        unseen = np.isnan(self._place[new, 0])
        self._place[new[unseen]] = place[known[first[unseen]]]
        noisy = states.derived & SMOOTHED > 0
        away = np.hypot(*(place - self._place[node]).T) > np.where(noisy, STRAYED, MOVED)
        self._moved[node[away]] = True
        self._last[node[known]] = place[known]
        time = frames.time_ns[frames.frame_of]
        begin, end, shaky, stood = self._seen
        begin[new] = np.where(begin[new] == NEVER, time[known[first]], begin[new])
        np.maximum.at(end, node[known], time[known])
        np.add.at(shaky, node[noisy], 1)
        np.add.at(stood, node[noisy & (states.derived & STANDS > 0)], 1)

    def stand(
        self, bodies: Bodies, standing: Standing, driving: Bools, *, beyond: bool = False
    ) -> None:
        """Record the lanes and other map parts below the vehicles in the next frames.

        ``beyond``: the bodies are all known ones, not only those in graphs.
        """
        hits = standing.hits
        noisy = self._seen[2, bodies.node[hits.row]] > 0
        primary = hits.primary & driving[-1 - hits.lane] & (~noisy | (hits.overlap >= IN_LANE))
        self._drove[int(beyond), bodies.node[hits.row[primary]]] = True
        self._stood[int(beyond), bodies.node] = True

    @property
    def parked(self) -> Codes:
        """Parking state of each object in the graphs: 1 parked, 0 not parked, -1 unknown or no vehicle."""
        return self._parked(0)

    @property
    def world_parked(self) -> Codes:
        """Parking state of each object, as :attr:`parked`. Object states outside the graphs also count."""
        return self._parked(1)

    def _parked(self, row: int) -> Codes:
        begin, end, shaky, stood = self._seen
        drift = np.hypot(*(self._last - self._place).T) > DRIFT * (end - begin) / 1e9
        moved = self._moved | (shaky > 0) & (drift | (stood < SHARE * shaky))
        long = (begin != NEVER) & (end - begin >= LEAST_NS) & ~np.array(self._on_map)
        known = self._stood[row] | moved | self._static | long
        parked = self._static | ~(moved | self._drove[row])
        return np.where(self._vehicle & known, parked, -1).astype(np.int8)
