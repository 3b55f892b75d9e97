"""Plane geometry of many things at once, and the conventions that hold everywhere.

Conventions
-----------
* Axes are OpenDRIVE's inertial axes: right-handed, x east, y north, z up; metres.
* Angles are radians, counter-clockwise, heading 0 along +x. Outward (views, patterns, JSON): degrees.
* A *bearing* of b from a is the direction from a's centre to b's centre in a's axes: 0 dead ahead, positive
  to the left, in (-π, π].
* Times are ``int64`` nanoseconds and end in ``_ns``; everything else is SI without suffix.
* A box is an oriented rectangle in the plane: centre, heading, length along the heading, width across it.
* A missing number is NaN and makes whatever is computed from it NaN.

The numbers of a pair of entities are also the columns of the view ``pairs``: the same formulas stand in
``schema.sql``, and the two are tested against one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

if TYPE_CHECKING:
    from collections.abc import Callable

STANDSTILL: Final = 0.1
"""Speed up to which an entity stands, so that it has no time headway; m/s."""

TOGETHER: Final = 1e-6
"""Difference of velocities below which two entities keep their places to one another; m/s."""

_NEVER_ZERO: Final = 1e-200
"""Added to speeds that are divided by: what stands on an axis meets there in ages, or has met for ages."""


def wrapped(angle: Floats) -> Floats:
    """Angles brought into (-π, π]; rad. What is not finite becomes NaN."""
    with np.errstate(invalid="ignore"):
        turned = angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))
    return np.minimum(turned, np.pi)  # rounding may leave it a little above


def corners(boxes: Floats) -> Floats:
    """Corners of boxes.

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
    """Longitudinal (ahead) and lateral (to the left) parts of vectors, in axes turned by ``heading``."""
    cos, sin = np.cos(heading), np.sin(heading)
    return dx * cos + dy * sin, dy * cos - dx * sin


def bearings(dx: Floats, dy: Floats, heading: Floats) -> Floats:
    """Directions of vectors in axes turned by ``heading``, in (-π, π]; rad. 0 for a vector of no length."""
    # The difference of two angles is exact for the headings that people write (0, π/2, π), where the
    # angle of turned components is not: the cosine of the double nearest to π/2 is 6e-17.
    return np.where((dx == 0) & (dy == 0), 0 * heading, wrapped(np.arctan2(dy, dx) - heading))


def gap_to_points(boxes: Floats, x: Floats, y: Floats) -> Floats:
    """Shortest distance between each box and its point; 0 in or on the box.

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


def gap(a: Floats, b: Floats) -> Floats:
    """Shortest distance between the boxes of each pair; 0 where they touch or overlap.

    Parameters
    ----------
    a, b : (K, 5) float64
        ``x, y, heading, length, width`` of the two boxes of pair k; m, m, rad, m, m. A box without extent
        is a point or a line.

    Returns
    -------
    (K,) float64
        Metres; NaN where a number is missing.

    Notes
    -----
    The gap is the distance of b's centre from the Minkowski sum of the two boxes, an octagon around a's
    centre whose edges are the edges of both. Boxes are symmetric about their centres, so of two opposite
    edges only the one on the side of b's centre can be the nearest: four edges remain, two in a's axes and
    two in b's.
    """
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    cos, sin = np.cos(b[:, 2] - a[:, 2]), np.sin(b[:, 2] - a[:, 2])
    turn = np.abs(cos), np.abs(sin)
    # Of parallel boxes two corners reach equally far; each box takes the other one, so one sign serves both.
    hand = np.where(cos * sin < 0, -1.0, 1.0)
    half_a, half_b = (a[:, 3] / 2, a[:, 4] / 2), (b[:, 3] / 2, b[:, 4] / 2)
    front, side = _past_edges(offsets(dx, dy, a[:, 2]), half_a, half_b, turn, hand)
    rear, flank = _past_edges(offsets(dx, dy, b[:, 2]), half_b, half_a, turn, -hand)
    squared = np.minimum(np.minimum(front, side), np.minimum(rear, flank))
    apart = np.sqrt(np.where(np.isinf(squared), 0, squared))
    return np.where(np.isnan((a + b).sum(axis=1)), np.nan, apart)


def _past_edges(
    centre: tuple[Floats, Floats],
    mine: tuple[Floats, Floats],
    other: tuple[Floats, Floats],
    turn: tuple[Floats, Floats],
    hand: Floats,
) -> tuple[Floats, Floats]:
    """Squared distances to the octagon's edges across my two axes; inf: not beyond that edge.

    Each is my own front (or side), moved by the corner of the other box that reaches farthest along the axis.
    """
    (lon, lat), (cos, sin), (length, width) = centre, turn, other
    shift = hand * (length * sin - width * cos)
    front = _beyond(
        np.abs(lon) - mine[0] - (length * cos + width * sin),
        np.abs(np.where(lon < 0, -lat, lat) - shift) - mine[1],
    )
    shift = hand * (length * cos - width * sin)
    side = _beyond(
        np.abs(lat) - mine[1] - (length * sin + width * cos),
        np.abs(np.where(lat < 0, -lon, lon) - shift) - mine[0],
    )
    return front, side


def _beyond(out: Floats, past: Floats) -> Floats:
    """Squared distance from an edge: how far out, and how far past its end; inf where not out."""
    past = np.maximum(past, 0)
    return np.where(out > 0, out * out + past * past, np.inf)


@dataclass(frozen=True, slots=True)
class PairNumbers:
    """Numbers of ordered pairs (a, b), as in the view ``pairs``; shape (K,).

    Attributes
    ----------
    distance : float64
        Between the centres, in space; m.
    gap : float64
        Between the footprints, in the plane; m.
    bearing, rel_heading : float64
        Direction of b's centre in a's axes, and b's heading less a's, both in (-π, π]; rad. Where the centres
        coincide the bearing is 0.
    lon, lat : float64
        b's centre in a's axes: ahead, and to the left; m.
    lon_gap, lat_gap : float64
        How far the footprints are apart along a's axis, and across it; 0 where they overlap in that axis; m.
    apparent_heading : float64
        b's heading less the direction from a to b, in (-π, π]; rad: 0 is a tail, π a front. NaN where
        the centres coincide. (Scenic's apparent heading of b from a: Fremont et al., PLDI 2019, table 2.)
    closing_speed : float64
        How fast the centres approach one another in the plane; m/s. NaN where they coincide.
    closing_time : float64
        ``gap`` at ``closing_speed``; s. NaN where the centres do not approach one another.
    ttc : float64
        Time to collision: see :func:`first_contact`.
    headway : float64
        Time until a, at its speed, has come as far as b is now: from bumper to bumper along a's axis; s. NaN
        where b is not ahead or a stands (:data:`STANDSTILL`).
    rel_speed : float64
        Length of the difference of the velocities in the plane; m/s.
    """

    distance: Floats
    gap: Floats
    bearing: Floats
    rel_heading: Floats
    lon: Floats
    lat: Floats
    lon_gap: Floats
    lat_gap: Floats
    apparent_heading: Floats
    closing_speed: Floats
    closing_time: Floats
    ttc: Floats
    headway: Floats
    rel_speed: Floats


def pair_numbers(a: Floats, b: Floats) -> PairNumbers:
    """The numbers of each pair of boxes that move; see :class:`PairNumbers`.

    Parameters
    ----------
    a, b : (K, 8) float64
        ``x, y, z, heading, length, width, vx, vy`` of the two; m, m, m, rad, m, m, m/s, m/s.
    """
    dx, dy, dz, _, _, _, dvx, dvy = (b - a).T
    planar = np.sqrt(dx * dx + dy * dy)
    lon, lat = offsets(dx, dy, a[:, 3])
    along, across = _reach(b, b[:, 3] - a[:, 3])
    sight = wrapped(b[:, 3] - np.arctan2(dy, dx))
    footprint = [0, 1, 3, 4, 5]
    between = gap(a[:, footprint], b[:, footprint])
    closing = _quotient(-(dx * dvx + dy * dvy), planar, np.not_equal, 0)
    bumpers = np.maximum(lon - (a[:, 4] + b[:, 4]) / 2, 0)
    speed = np.sqrt(a[:, 6] * a[:, 6] + a[:, 7] * a[:, 7])
    headway = _quotient(bumpers, speed, np.greater, STANDSTILL)
    return PairNumbers(
        distance=np.sqrt(dx * dx + dy * dy + dz * dz),
        gap=between,
        bearing=bearings(dx, dy, a[:, 3]),
        rel_heading=wrapped(b[:, 3] - a[:, 3]),
        lon=lon,
        lat=lat,
        lon_gap=np.maximum(np.abs(lon) - a[:, 4] / 2 - along, 0),
        lat_gap=np.maximum(np.abs(lat) - a[:, 5] / 2 - across, 0),
        apparent_heading=np.where(planar > 0, sight, np.nan),
        closing_speed=closing,
        closing_time=_quotient(between, closing, np.greater, 0),
        ttc=first_contact(a, b),
        headway=np.where(lon > 0, headway, np.nan),
        rel_speed=np.sqrt(dvx * dvx + dvy * dvy),
    )


def first_contact(a: Floats, b: Floats) -> Floats:
    """Time until the boxes of each pair touch, if both keep their velocity and do not turn.

    Parameters
    ----------
    a, b : (K, 8) float64
        ``x, y, z, heading, length, width, vx, vy`` of the two; m, m, m, rad, m, m, m/s, m/s.

    Returns
    -------
    (K,) float64
        Seconds: 0 where they touch or overlap; NaN where they never do, where they are apart and their
        velocities differ by less than :data:`TOGETHER`, and where a number (other than z) is missing.

    Notes
    -----
    Two boxes meet where their shadows meet on each axis of both (separating axes: Gottschalk, Lin and
    Manocha, OBBTree, SIGGRAPH 1996). On one axis the shadows of boxes that move meet in one interval of
    time; what all four intervals have in common is when the boxes do.
    """
    dx, dy, _, turn, _, _, dvx, dvy = (b - a).T
    mine, other = _reach(b, turn), _reach(a, turn)
    centre = [*offsets(dx, dy, a[:, 3]), *offsets(dx, dy, b[:, 3])]
    speed = np.stack([*offsets(dvx, dvy, a[:, 3]), *offsets(dvx, dvy, b[:, 3])])
    half = np.stack([a[:, 4] / 2, a[:, 5] / 2, b[:, 4] / 2, b[:, 5] / 2])
    reach = half + np.stack([*mine, *other])
    # Each axis is turned so that b moves along it.
    behind = np.where(speed < 0, 1.0, -1.0) * np.stack(centre)
    speed = np.abs(speed) + _NEVER_ZERO
    meets = ((behind - reach) / speed).max(axis=0)
    parts = ((behind + reach) / speed).min(axis=0)
    moving = np.sqrt(dvx * dvx + dvy * dvy) >= TOGETHER
    touching = (meets <= parts) & (parts >= 0) & (moving | (meets <= 0))
    return np.where(touching, np.maximum(meets, 0), np.nan)


def _reach(boxes: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Reach of boxes that are turned from their centres, along two axes; m."""
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    length, width = boxes[:, 4] / 2, boxes[:, 5] / 2
    return length * cos + width * sin, length * sin + width * cos


def _quotient(
    numerator: Floats, divisor: Floats, compare: Callable[..., NDArray[np.bool_]], bound: float
) -> Floats:
    """``numerator / divisor`` where the divisor compares as told with the bound, else NaN."""
    missing = np.full(len(divisor), np.nan)
    return np.divide(numerator, divisor, out=missing, where=compare(divisor, bound))
