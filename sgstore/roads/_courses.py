"""How lanes run: their curvature and slope, metre by metre.

A lane is cut into equal stretches of about :data:`STRETCH`, one at least and 10,000 at most. Its curvature on
a stretch is by how much its centre line turns from one end of it to the other, over the length; its slope is
by how much it rises, over the length as seen from above. So neither depends on how densely a file has its
points, and a fault of a file at one point (a piece of a road that does not go on quite as the one before
ended) stays small.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.columns import taken

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.roads._ribbons import Ribbons
    from sgstore.world import Floats, Ints

    Heights = Callable[[Ints, Floats], Floats]

STRETCH: Final = 1.0
"""About how long a stretch is over which curvature and slope are means; m."""
_MOST: Final = 10_000
"""Stretches of a lane: of one that is longer than 10 km, they are longer, too."""
_MOST_IN_ALL: Final = 1 << 20
"""About so many stretches of all lanes together: a map of strangers may be of any size."""
_DIGITS: Final = 7
"""Digits that are kept of both, so that stretches of a straight line or an arc are one."""


@dataclass(frozen=True, slots=True)
class LaneCourses:
    """Stretches of lanes, ordered by lane and start; those of a lane follow one another; shape (n,).

    A place before the start of its lane is on the first stretch, one beyond the end on the last.

    Attributes
    ----------
    lane : int64
        Lanes, counted from 0.
    start, end : float64
        Along the centre line of the lane; m. Of the last stretch of a lane the end is infinite.
    curvature : float64
        Positive where the lane turns to the left as its traffic sees it; 1/m.
    slope : float64
        Rise over run in the direction of travel: 0.05 is 5 % uphill. NaN: the map has no heights.
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
        """Nothing is known of any lane."""
        nowhere = np.zeros(0)
        return cls(np.zeros(0, np.int64), nowhere, nowhere, nowhere, nowhere)

    def rows(self) -> Iterator[tuple[int, float, float, float]]:
        """Node id of the lane, start, curvature and slope of each."""
        columns = (self.start, self.curvature, self.slope)
        return zip((-2 - self.lane).tolist(), *(one.tolist() for one in columns), strict=True)


def lane_courses(ribbons: Ribbons, heights: Heights | None) -> LaneCourses:
    """The courses of lanes.

    Parameters
    ----------
    ribbons : Ribbons
    heights : callable or None
        Lanes, and places along them, m → heights there, m. ``None``: nothing is known of any.
    """
    lengths = ribbons.lengths
    wanted = np.clip(np.rint(lengths / STRETCH), 1, _MOST)
    wanted = np.maximum(wanted // max(wanted.sum() / _MOST_IN_ALL, 1), 1)
    counts = np.where(lengths > 0, wanted, 0).astype(np.int64)
    lane = np.repeat(np.arange(len(ribbons)), counts)
    number = np.arange(len(lane)) - (np.cumsum(counts) - counts)[lane]
    step = lengths[lane] / counts[lane]
    start, end = number * step, (number + 1) * step
    # Where a stretch ends the next begins: places are the starts, and behind the last of a lane its end.
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
    """The same with one stretch for those that follow one another and are alike."""
    if not len(every):
        return every
    slope = np.nan_to_num(every.slope)
    change = np.flatnonzero(
        (np.diff(every.lane) != 0) | (np.diff(every.curvature) != 0) | (np.diff(slope) != 0)
    )
    first, last = np.append(0, change + 1), np.append(change, len(every) - 1)
    found = taken(every, first)
    return LaneCourses(found.lane, found.start, every.end[last], found.curvature, found.slope)
