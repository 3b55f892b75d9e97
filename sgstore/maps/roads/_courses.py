"""Curvature and slope along lanes, in steps of one metre.

A lane is cut into 1 to 10,000 equal stretches of about :data:`STRETCH`. The curvature of a stretch
is the turn of its centre line from end to end, divided by the length. The slope is the rise divided
by the length seen from above. Therefore neither depends on the density of the points in a file. A
fault at one point (a small step between two pieces of a road) has a small effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.tables import begins, spread, taken

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.maps.roads._ribbons import Ribbons
    from sgstore.model.world import Floats, Ints

    Heights = Callable[[Ints, Floats], Floats]

STRETCH: Final = 1.0
"""Approximate length of a lane interval over which curvature and slope are averaged; m."""
_MOST: Final = 10_000
"""Largest number of intervals of a lane. Lanes longer than 10 km have longer intervals."""
_MOST_IN_ALL: Final = 1 << 20
"""Approximate largest number of intervals of all lanes together. It limits large maps from other sources."""
_DIGITS: Final = 7
"""Digits of curvature and slope. Rounding makes the intervals of a straight line or an arc equal."""


@dataclass(frozen=True, slots=True)
class LaneCourses:
    """Intervals of lanes with constant curvature and slope, sorted by lane and start; shape (n,).

    A place before the start of its lane is on the first stretch, a place after the end on the last.

    Attributes
    ----------
    lane : int64
        Lanes, counted from 0.
    start, end : float64
        Along the centre line of the lane; m. The end of the last stretch of a lane is infinite.
    curvature : float64
        Positive where the lane turns to the left, seen in the direction of travel; 1/m.
    slope : float64
        Rise over run in the direction of travel: 0.05 is 5 % uphill. NaN if the map has no heights.
    """

    lane: Ints
    start: Floats
    end: Floats
    curvature: Floats
    slope: Floats

    def __len__(self) -> int:
        return len(self.lane)

    @classmethod
    def none(cls) -> LaneCourses:
        """Return an empty table of the curvature and slope of lanes."""
        nowhere = np.zeros(0)
        return cls(np.zeros(0, np.int64), nowhere, nowhere, nowhere, nowhere)

    def rows(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield lane (node id), start, curvature and slope of each lane interval."""
        columns = (self.start, self.curvature, self.slope)
        return zip((-2 - self.lane).tolist(), *(one.tolist() for one in columns), strict=True)

    @staticmethod
    def of(ribbons: Ribbons, heights: Heights | None) -> LaneCourses:
        """Compute curvature and slope along all lanes from their surfaces.

        Parameters
        ----------
        ribbons : Ribbons
        heights : callable or None
            Function from lanes and places along them (m) to heights (m). ``None`` means unknown
            heights.
        """
        lengths = ribbons.lengths
        wanted = np.clip(np.rint(lengths / STRETCH), 1, _MOST)
        wanted = np.maximum(wanted // max(wanted.sum() / _MOST_IN_ALL, 1), 1)
        counts = np.where(lengths > 0, wanted, 0).astype(np.int64)
        lane, number = spread(np.zeros_like(counts), counts)
        step = lengths[lane] / counts[lane]
        start, end = number * step, (number + 1) * step
        # A stretch ends where the next one begins: the places are all starts, and the end of each lane.
        last = np.flatnonzero(number == counts[lane] - 1)
        at_lane = np.insert(lane, last + 1, lane[last])
        at = np.insert(start, last + 1, end[last])
        row = np.arange(len(lane)) + np.searchsorted(last, np.arange(len(lane)))
        turn = np.cumsum(ribbons.bends)
        turned = ribbons.between(at_lane, at, np.concatenate((np.zeros(1), turn[:-1])))
        curvature = np.round((turned[row + 1] - turned[row]) / step, _DIGITS) + 0.0
        slope = np.full(len(lane), np.nan)
        if heights is not None:
            height = heights(at_lane, at)
            slope = np.round((height[row + 1] - height[row]) / step, _DIGITS) + 0.0
        end[last] = np.inf
        every = LaneCourses(lane, start, end, curvature, slope)
        return _joined(every)


def _joined(every: LaneCourses) -> LaneCourses:
    """Join consecutive lane intervals with equal curvature and slope."""
    if not len(every):
        return every
    first = np.flatnonzero(begins(every.lane, every.curvature, np.nan_to_num(every.slope)))
    last = np.append(first[1:] - 1, len(every) - 1)
    found = taken(every, first)
    return LaneCourses(found.lane, found.start, every.end[last], found.curvature, found.slope)
