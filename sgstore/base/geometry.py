"""Plane geometry of points, angles and boxes on arrays, with the axis conventions of the project.

Conventions
-----------
* Axes are OpenDRIVE's inertial axes: right-handed, x east, y north, z up; metres.
* Angles are radians, counter-clockwise, heading 0 along +x. Outputs (views, patterns, JSON) use degrees.
* A *bearing* of b from a is the direction from a's centre to b's centre in a's axes: 0 dead ahead, positive
  to the left, in (-π, π].
* Times are ``int64`` nanoseconds and end in ``_ns``; everything else is SI without suffix.
* A box is an oriented rectangle in the plane: centre, heading, length along the heading, width across it.
* A missing number is NaN. A result computed from NaN is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"


def wrapped(angle: Floats) -> Floats:
    """Wrap angles into (-π, π]; rad. An infinite angle becomes NaN."""
    with np.errstate(invalid="ignore"):
        turned = angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))
    return np.minimum(turned, np.pi)  # Rounding can exceed π slightly.


def corners(boxes: Floats) -> Floats:
    """Return the four corners of each box (rectangle given by centre, heading, length and width).

    Parameters
    ----------
    boxes : (K, 5) float64
        ``x, y, heading, length, width``; m, m, rad, m, m.

    Returns
    -------
    (K, 4, 2) float64
        Front left, rear left, rear right, front right: counter-clockwise; m.
    """
    x, y, heading, length, width = boxes.T
    ahead = np.multiply.outer(length / 2, (1, -1, -1, 1))
    left = np.multiply.outer(width / 2, (1, 1, -1, -1))
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return np.stack(
        [x[:, None] + ahead * cos - left * sin, y[:, None] + ahead * sin + left * cos], axis=-1
    )


def offsets(dx: Floats, dy: Floats, heading: Floats) -> tuple[Floats, Floats]:
    """Split vectors into a part in the direction ``heading``, and a part to the left of it."""
    cos, sin = np.cos(heading), np.sin(heading)
    return dx * cos + dy * sin, dy * cos - dx * sin


def bearings(dx: Floats, dy: Floats, heading: Floats) -> Floats:
    """Return the directions of vectors relative to a heading, in (-π, π]; rad. Zero vectors give 0."""
    # The difference of two angles is exact for common headings (0, π/2, π). The angle of rotated components
    # is not: the cosine of the double nearest to π/2 is 6e-17.
    return np.where((dx == 0) & (dy == 0), 0 * heading, wrapped(np.arctan2(dy, dx) - heading))


def gap_to_points(boxes: Floats, x: Floats, y: Floats) -> Floats:
    """Return the shortest distance between each box and its point; 0 if the point is in the box.

    Parameters
    ----------
    boxes : (K, 5) float64
        ``x, y, heading, length, width``; m, m, rad, m, m.
    x, y : (K,) float64
        The points; m.
    """
    lon, lat = offsets(x - boxes[:, 0], y - boxes[:, 1], boxes[:, 2])
    ahead = np.maximum(np.abs(lon) - boxes[:, 3] / 2, 0)
    aside = np.maximum(np.abs(lat) - boxes[:, 4] / 2, 0)
    return np.sqrt(ahead * ahead + aside * aside)


Corner = Sequence[float]


def is_simple(corners: Sequence[Corner]) -> bool:
    """Return True if a polygon does not cross or touch itself."""
    sides = list(zip(corners, (*corners[1:], corners[0]), strict=True))
    folded_back = any(
        _turn(*side, following[1]) == 0 and not _is_ahead(*side, following[1])
        for side, following in zip(sides, (*sides[1:], sides[0]), strict=True)
    )
    crossing = any(
        _meet(sides[i], sides[j])
        for i in range(len(sides))
        for j in range(i + 2, len(sides) - (i == 0))
    )
    return not folded_back and not crossing


def _meet(one: tuple[Corner, Corner], other: tuple[Corner, Corner]) -> bool:
    """Return True if two sides of a polygon have a point in common."""
    ends = ((*one, other[0]), (*one, other[1]), (*other, one[0]), (*other, one[1]))
    turns = [_turn(*three) for three in ends]
    if turns[0] * turns[1] < 0 and turns[2] * turns[3] < 0:
        return True
    return any(turn == 0 and _is_between(*three) for turn, three in zip(turns, ends, strict=True))


def _is_between(a: Corner, b: Corner, c: Corner) -> bool:
    """Return True if c is between a and b. The three points must be on one line."""
    return all(min(p, q) <= r <= max(p, q) for p, q, r in zip(a, b, c, strict=True))


def _is_ahead(a: Corner, b: Corner, c: Corner) -> bool:
    """Return True if b to c continues in the direction from a to b. The points must be on one line."""
    return (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]) > 0


def _turn(a: Corner, b: Corner, c: Corner) -> float:
    """Return twice the signed area of a triangle; positive for a turn to the left at b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
