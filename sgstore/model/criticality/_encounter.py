"""Tracks (recorded states) of two objects, and the frames in which they cover the same area."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.model.pair_numbers import PairNumbers

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.world import Bools, Floats, Ints

_BLOCK: Final = 16
"""Number of states that share one bounding circle."""
_CIRCLES: Final = 1 << 20
"""Number of pairs of bounding circles whose distances are computed at once."""
_TOGETHER: Final = 256
"""Number of pairs of bounding circles whose states are compared at once."""


@dataclass(frozen=True)
class Track:
    """Track of an object in a trace: its position, heading, size and motion in each frame.

    Attributes
    ----------
    times : (n,) float64
        Ascending; s.
    states : (n, 10) float64
        ``x, y, z, heading, length, width, vx, vy, ax, ay``, as input of
        :class:`~sgstore.model.pair_numbers.PairNumbers`.
    """

    times: Floats
    states: Floats

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def circles(self) -> tuple[Floats, Floats, Floats]:
        """Bounding circle of the footprints in each group of consecutive frames: x, y and radius."""
        count = -(-len(self) // _BLOCK)
        rows = np.minimum(np.arange(count * _BLOCK), len(self) - 1).reshape(count, _BLOCK)
        x, y = self.states[rows, 0], self.states[rows, 1]
        reach = np.hypot(self.states[rows, 4], self.states[rows, 5]) / 2
        middle_x, middle_y = x.mean(axis=1), y.mean(axis=1)
        away = np.hypot(x - middle_x[:, None], y - middle_y[:, None]) + reach
        return middle_x, middle_y, away.max(axis=1)


@dataclass(frozen=True)
class Encounter:
    """Tracks of two objects a and b of one trace. Criticality measures describe the risk of a.

    Attributes
    ----------
    a, b : Track
        Their tracks, with independent begin and end.
    """

    a: Track
    b: Track

    @cached_property
    def together(self) -> tuple[Ints, Ints]:
        """Row numbers of objects a and b in the frames that contain both."""
        _, rows_a, rows_b = np.intersect1d(
            self.a.times, self.b.times, assume_unique=True, return_indices=True
        )
        return rows_a, rows_b

    @property
    def times(self) -> Floats:
        """Times of the frames that have both objects, (T,); s."""
        return self.a.times[self.together[0]]

    @cached_property
    def numbers(self) -> PairNumbers:
        """Measures of the two objects (gap, closing speed, …) in each frame that has both."""
        rows_a, rows_b = self.together
        return PairNumbers(self.a.states[rows_a], self.b.states[rows_b])

    @cached_property
    def known(self) -> bool:
        """True if the sizes and positions of both objects are known in every frame."""
        return not any(np.isnan(one.states[:, [0, 1, 3, 4, 5]]).any() for one in (self.a, self.b))

    def crossings(self) -> Iterator[tuple[Ints, Ints]]:
        """Yield frame rows of a and of b in which both cover a common area, also at different times."""
        if not self.known:
            return
        (x1, y1, r1), (x2, y2, r2) = self.a.circles, self.b.circles
        step = max(_CIRCLES // max(len(x2), 1), 1)
        for first in range(0, len(x1), step):
            some = slice(first, first + step)
            away = np.hypot(x1[some, None] - x2, y1[some, None] - y2)
            blocks_a, blocks_b = np.nonzero(away <= (r1[some, None] + r2) * (1 + 1e-9))
            for start in range(0, len(blocks_a), _TOGETHER):
                part = slice(start, start + _TOGETHER)
                yield self._touching(first + blocks_a[part], blocks_b[part])

    def _touching(self, blocks_a: Ints, blocks_b: Ints) -> tuple[Ints, Ints]:
        """Within pairs of frame groups, return the frame rows of a and b in which their footprints touch."""
        inner = np.arange(_BLOCK)
        rows_a = (blocks_a[:, None] * _BLOCK + inner)[:, :, None]
        rows_b = (blocks_b[:, None] * _BLOCK + inner)[:, None, :]
        rows_a, rows_b = (one.ravel() for one in np.broadcast_arrays(rows_a, rows_b))
        there = (rows_a < len(self.a)) & (rows_b < len(self.b))
        rows_a, rows_b = rows_a[there], rows_b[there]
        on = _touch(self.a.states[rows_a], self.b.states[rows_b])
        return rows_a[on], rows_b[on]


def _touch(a: Floats, b: Floats) -> Bools:
    """Return a mask (K,) of the pairs of boxes that touch or overlap."""
    apart = np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1])
    reach = (np.hypot(a[:, 4], a[:, 5]) + np.hypot(b[:, 4], b[:, 5])) / 2
    found = apart <= reach * (1 + 1e-9)
    numbers = PairNumbers(a[found], b[found])
    beyond = np.maximum.reduce([numbers[f"out{axis}"] for axis in (1, 2, 3, 4)])
    found[found] = beyond <= 0
    return found
