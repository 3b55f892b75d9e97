"""Where texts go: beside what they name, on top of nothing that matters.

Greedy: texts come in the order of their weight, each takes the first free place around its anchor,
and one that finds none is left out. All measures are points of the page.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

Rect = tuple[float, float, float, float]
"""Left, bottom, right, top."""

_ROUND: Final = tuple(
    math.radians(a) for a in (0, 180, 30, -30, 150, -150, 90, -90, 60, 120, -60, -120)
)
_STEPS: Final = (2.0, 8.0, 16.0, 26.0)


class Placer:
    """Free and taken room in a window.

    Parameters
    ----------
    bounds : Rect
        The window; no text leaves it.
    """

    def __init__(self, bounds: Rect) -> None:
        self._bounds = bounds
        self._taken: list[Rect] = []

    def block(self, rect: Rect) -> None:
        """Keep a rectangle free of texts."""
        self._taken.append(rect)

    def beside(
        self, x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The middle of a free place for a text beside a thing, near first; taken at once.

        Parameters
        ----------
        x, y : float
            Middle of the thing.
        reach : (float, float)
            How far the thing extends from there, to its sides and up and down.
        size : (float, float)
            Width and height of the text.

        Returns
        -------
        (float, float) or None
            ``None`` if there is no room.
        """
        half_w, half_h = size[0] / 2, size[1] / 2
        spots = [
            (
                x + (reach[0] + step) * math.cos(a) + half_w * _sign(math.cos(a)),
                y + (reach[1] + step) * math.sin(a) + half_h * _sign(math.sin(a)),
            )
            for step in _STEPS
            for a in _ROUND
        ]
        return self.first_free(spots, size)

    def along(
        self, a: tuple[float, float], b: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The middle of a free place for a text on the line from ``a`` to ``b``; taken at once."""
        spots = [
            (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]))
            for t in (0.55, 0.65, 0.45, 0.75, 0.35)
        ]
        return self.first_free(spots, size)

    def first_free(
        self, spots: list[tuple[float, float]], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The first of some spots that is free for a text of a size; taken at once."""
        middles = np.array(spots)
        half = np.array(size) / 2
        low, high = middles - half, middles + half
        left, bottom, right, top = self._bounds
        free = (low >= (left, bottom)).all(axis=1) & (high <= (right, top)).all(axis=1)
        if self._taken:
            taken = np.array(self._taken)
            meets = (low[:, None] < taken[:, 2:]) & (high[:, None] > taken[:, :2])
            free &= ~(meets[:, :, 0] & meets[:, :, 1]).any(axis=1)
        if not free.any():
            return None
        chosen = int(free.argmax())
        self._taken.append((*low[chosen].tolist(), *high[chosen].tolist()))
        return spots[chosen]


def _sign(value: float) -> float:
    return 0.0 if abs(value) < 1e-9 else math.copysign(1.0, value)
