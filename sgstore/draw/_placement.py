"""Placement of texts near their objects in a picture, without overlaps."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.draw._page import Rect

    Pixels = NDArray[np.uint8]
    Colours = NDArray[np.float32]

# Greedy placement: texts come in order of importance, each takes the first free place around its
# anchor, and a text without a free place is left out. All measures are points of the page.

_ROUND: Final = tuple(
    math.radians(a) for a in (0, 180, 30, -30, 150, -150, 90, -90, 60, 120, -60, -120)
)

_STEPS: Final = (2.0, 8.0, 16.0, 26.0)

_CLEAR: Final = 4.0
"""Smallest difference by which a name must be closer to its own object than to others; points."""


class Placer:
    """Occupied areas of a picture. It finds free places for texts.

    Parameters
    ----------
    bounds : Rect
        The window; texts stay inside it.
    """

    def __init__(self, bounds: Rect) -> None:
        self._bounds = bounds
        self._taken: list[Rect] = []
        self._things: list[Rect] = []

    def stand(self, x: float, y: float, reach: tuple[float, float]) -> None:
        """Mark the position of an object, so that other objects' names are written elsewhere."""
        self._things.append(_around(x, y, reach))

    def block(self, rect: Rect) -> None:
        """Keep a rectangle free of texts."""
        self._taken.append(rect)

    def beside(
        self, x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """Reserve the free place for a text that is nearest to an object; return the middle of that place.

        Parameters
        ----------
        x, y : float
            Middle of the object.
        reach : (float, float)
            Extent of the object, horizontal and vertical.
        size : (float, float)
            Width and height of the text.

        Returns
        -------
        (float, float) or None
            ``None`` means no room.
        """
        return self.first_free(_spots(x, y, reach, size), size)

    def named(
        self, x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
    ) -> tuple[tuple[float, float], bool] | None:
        """Reserve a place for an object's name. Return its middle, and True if no other object is as near.

        The flag is true if no other object is as near to the name.

        Places with a clear owner have priority.
        """
        spots = _spots(x, y, reach, size)
        own = _around(x, y, reach)
        others = np.array([thing for thing in self._things if thing != own]).reshape(-1, 4)
        texts = np.array([_around(*spot, (size[0] / 2, size[1] / 2)) for spot in spots])
        rival = _gaps(texts, others).min(axis=1, initial=np.inf)
        clear = _gaps(texts, np.array([own]))[:, 0] + _CLEAR <= rival
        for wanted in (clear, ~clear):
            chosen = [spot for spot, is_wanted in zip(spots, wanted, strict=True) if is_wanted]
            spot = self.first_free(chosen, size) if chosen else None
            if spot is not None:
                return spot, wanted is clear
        return None

    def along(
        self, a: tuple[float, float], b: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """Reserve a place for a text on the line from ``a`` to ``b``; return the middle of the place."""
        spots = [
            (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]))
            for t in (0.55, 0.65, 0.45, 0.75, 0.35)
        ]
        return self.first_free(spots, size)

    def first_free(
        self, spots: list[tuple[float, float]], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """Reserve the first free place for a text. Return its middle, or ``None`` if no place is free."""
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


def _spots(
    x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
) -> list[tuple[float, float]]:
    """Return possible centres of a label next to an object, nearest first."""
    half_w, half_h = size[0] / 2, size[1] / 2
    return [
        (
            x + (reach[0] + step) * math.cos(a) + half_w * _sign(math.cos(a)),
            y + (reach[1] + step) * math.sin(a) + half_h * _sign(math.sin(a)),
        )
        for step in _STEPS
        for a in _ROUND
    ]


def _around(x: float, y: float, reach: tuple[float, float]) -> Rect:
    return (x - reach[0], y - reach[1], x + reach[0], y + reach[1])


def _gaps(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (n, m) from n rectangles to m rectangles; 0 if two rectangles overlap."""
    apart = np.maximum(one[:, None, :2] - other[:, 2:], other[:, :2] - one[:, None, 2:])
    return np.hypot(*np.moveaxis(np.maximum(apart, 0.0), -1, 0))


def _sign(value: float) -> float:
    return 0.0 if abs(value) < 1e-9 else math.copysign(1.0, value)
