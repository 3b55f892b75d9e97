"""Cross sections of lanes (left point, centre, right point), computed from lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.maps.roads._lanes import headings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Bools, Floats, Ints


APART: Final = 0.05
"""Smallest distance between points of a line, and between cross sections; m."""

WIDE: Final = 3.5
"""Default width of a lane; m."""

NEIGHBOURS: Final = (2.0, 6.0)
"""Range of distances between centre lines for which two lanes count as neighbours, to derive their width; m."""

_LOOKS: Final = 9
"""Number of places along a lane at which the distance to its neighbours is measured."""

_STEP: Final = 1.0
"""Distance between the cross sections of a lane through an area; m."""

_FEW: Final = 20_000
"""Number of comparisons (position with line piece) up to which brute force is faster than a tree."""

_AHEAD: Final = 0.2, 0.1, 0.5
"""Largest offset along the lane between a cross section and a border end that it uses: a length in m, plus a
share of the sideways distance. At the ends of a lane, which may be oblique, the second share applies."""


_SWAPPED: Final = 0.1
"""Smallest distance between two borders on the wrong sides for which they are exchanged; m."""


@dataclass(frozen=True, slots=True)
class Sections:
    """Cross sections of a lane in n places along it: centre, left and right points."""

    left: Floats
    right: Floats
    z: Floats
    middle: Floats = field(init=False)
    """Points of the centre line, (n, 2)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "middle", (self.left + self.right) / 2)

    def turned_round(self) -> Sections:
        """Return the cross sections of the same lane in reverse: order reversed, left and right swapped."""
        return Sections(self.right[::-1], self.left[::-1], self.z[::-1])

    def is_crossed(self) -> bool:
        """Return True if the left border is right of the right border, for more than a metre of the lane."""
        step = np.diff(self.middle, axis=0)
        across = (self.left - self.right)[1:] + (self.left - self.right)[:-1]
        length = np.hypot(*step.T)
        width = step[:, 0] * across[:, 1] - step[:, 1] * across[:, 0]
        return bool(length[width < -_SWAPPED * length].sum() > 1.0)

    def up_to(self, left: Floats, right: Floats, z: float) -> Sections:
        """Return the cross sections with one more appended."""
        return Sections(
            np.vstack((self.left, left)), np.vstack((self.right, right)), np.append(self.z, z)
        )

    @staticmethod
    def between(left: Floats, right: Floats) -> Sections:
        """Compute the cross sections of a lane from its left and right border.

        Parameters
        ----------
        left, right : (n, 3) and (m, 3) float64
            In the direction of the lane, thinned; at least two points.

        Notes
        -----
        Opposite points of both borders, up to :data:`APART`, become the ends of one cross section.
        Therefore the outline of the lane equals its borders.
        """
        runs = run_of(left), run_of(right)
        shares = [run / run[-1] for run in runs]
        near = APART / max(runs[0][-1], runs[1][-1])
        here = there = 0
        pairs: list[tuple[float, float]] = []
        while here < len(left) or there < len(right):
            one = shares[0][here] if here < len(left) else np.inf
            other = shares[1][there] if there < len(right) else np.inf
            both = abs(one - other) <= near
            pairs.append((one if both else min(one, other), other if both else min(one, other)))
            here += bool(both or one < other)
            there += bool(both or other < one)
        at = np.maximum.accumulate(np.array(pairs), axis=0).T
        ends = [
            np.column_stack([np.interp(along, share, column) for column in line.T])
            for along, share, line in zip(at, shares, (left, right), strict=True)
        ]
        return Sections(ends[0][:, :2], ends[1][:, :2], (ends[0][:, 2] + ends[1][:, 2]) / 2)

    @staticmethod
    def across(
        centre: Floats, lefts: Sequence[Floats], rights: Sequence[Floats], half: float
    ) -> tuple[Sections, bool]:
        """Compute the cross sections of a lane from its centre line and the lines of its borders.

        Parameters
        ----------
        centre : (n, 3) float64
            Centre line, thinned; at least two points.
        lefts, rights : sequence of (k, 3) float64
            Thinned borders on its left and right, as any number of pieces in any order. If only one
            side has a border, the other side has the same distance; without any border, both distances
            are ``half``.
        half : float
            m.
        """
        run = run_of(centre)
        at = _cuts(run, [along_line(centre, line[:, :2]) for line in (*lefts, *rights)])
        x, y, z = (np.interp(at, run, column) for column in centre.T)
        first = np.zeros(len(at), np.bool_)
        first[0] = True
        heading = headings(x, y, first)
        ahead = np.column_stack((np.cos(heading), np.sin(heading)))
        to_left = np.column_stack((-ahead[:, 1], ahead[:, 0]))
        places = np.column_stack((x, y))
        sides = [
            _side(places, ahead, sign * to_left, borders)
            for sign, borders in ((1.0, lefts), (-1.0, rights))
        ]
        told = any(side is not None for side in sides)
        one, other = sides if told else (None, None)
        plain = np.full(len(at), half)
        left_away = one.away if one else other.away if other else plain
        right_away = other.away if other else left_away
        left = one.points if one else places + to_left * left_away[:, None]
        right = other.points if other else places - to_left * right_away[:, None]
        return Sections(left, right, z), told


def thinned(line: Floats) -> Floats:
    """Remove each point of a line (n, 3) that is too close to the point before."""
    if len(line) < 2:
        return line
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    if (step >= APART).all():
        return line
    kept, run = [0], 0.0
    for number, length in enumerate(step.tolist(), 1):
        run += length
        if run >= APART:
            kept.append(number)
            run = 0.0
    if kept[-1] != len(line) - 1 and len(kept) > 1:
        kept[-1] = len(line) - 1
    return line[kept]


def run_of(line: Floats) -> Floats:
    """Return the length of a line from its start to each point, (n,), without heights; m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))))


@dataclass(frozen=True, slots=True)
class Feet:
    """For some positions, the nearest points on lines, and the distances of these points along the lines.

    ``along``: length of the line up to the point, with all lines laid end to end. ``is_end``: True
    at the end of a line.
    """

    at: Floats
    along: Floats
    is_end: Bools


def feet(places: Floats, lines: Sequence[Floats]) -> Feet:
    """Return the nearest point on the given lines, for each position (n, 2)."""
    start = np.concatenate([line[:-1, :2] for line in lines])
    way = np.concatenate([line[1:, :2] for line in lines]) - start
    x, y = places.T
    squared = np.maximum(way[:, 0] ** 2 + way[:, 1] ** 2, 1e-18)
    if len(places) * len(start) <= _FEW:
        away_x, away_y = x[:, None] - start[:, 0], y[:, None] - start[:, 1]
        shares = (away_x * way[:, 0] + away_y * way[:, 1]) / squared
        shares = np.minimum(np.maximum(shares, 0.0), 1.0)
        away_x -= shares * way[:, 0]
        away_y -= shares * way[:, 1]
        piece = np.argmin(away_x * away_x + away_y * away_y, axis=1)
    else:
        pieces: Any = shapely.linestrings(np.stack((start, start + way), axis=1))
        points: Any = shapely.points(places)
        _, piece = shapely.STRtree(pieces).query_nearest(points, all_matches=False)
    begin, step = start[piece], way[piece]
    share = ((x - begin[:, 0]) * step[:, 0] + (y - begin[:, 1]) * step[:, 1]) / squared[piece]
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    length = np.sqrt(squared)
    before = np.cumsum(length) - length
    first = np.zeros(len(start) + 1, np.bool_)
    first[np.cumsum([0, *(len(line) - 1 for line in lines)])] = True
    is_end = ((share <= 0) & first[piece]) | ((share >= 1) & first[piece + 1])
    return Feet(begin + share[:, None] * step, before[piece] + share * length[piece], is_end)


def along_line(line: Floats, places: Floats) -> Floats:
    """Return the length along a line to the point nearest to each position (n, 2); m."""
    return feet(places, [line]).along


def _cuts(run: Floats, more: Sequence[Floats]) -> Floats:
    """Return the lengths along a lane's centre line at which cross sections are made; m."""
    inner = np.concatenate([run[1:-1], *more])
    own = np.arange(len(inner)) < len(run) - 2
    inside = (inner > APART) & (inner < run[-1] - APART)
    inner, own = inner[inside], own[inside]
    order = np.lexsort((~own, inner))
    inner = inner[order]
    if len(inner):
        kept = [float(inner[0])]
        for place in inner[1:].tolist():
            if place - kept[-1] >= APART:
                kept.append(place)
        inner = np.array(kept)
    return np.concatenate(([0.0], inner, [run[-1]]))


@dataclass(frozen=True, slots=True)
class _Side:
    points: Floats
    away: Floats


def _side(places: Floats, ahead: Floats, aside: Floats, borders: Sequence[Floats]) -> _Side | None:
    """Return the left or right points of a lane's cross sections; ``None`` if it has no border on this side."""
    if not borders:
        return None
    found = feet(places, borders)
    nearest = found.at
    way = nearest - places
    away, beyond = (way * aside).sum(axis=1), (way * ahead).sum(axis=1)
    share = np.full(len(away), _AHEAD[1])
    share[[0, -1]] = _AHEAD[2]
    beside: Bools = ~found.is_end | (np.abs(beyond) <= _AHEAD[0] + share * np.abs(away))
    if not beside.any():
        return None
    rows: Ints = np.flatnonzero(beside)
    # A lane without a border keeps the width at the nearest piece of its border.
    away = np.where(beside, away, np.interp(np.arange(len(away)), rows, away[rows]))
    points = np.where(beside[:, None], nearest, places + aside * away[:, None])
    return _Side(points, away)


def half_width(centre: Floats, others: Sequence[Floats]) -> float:
    """Return half the width of a lane without borders. It is half the distance to its neighbours; m."""
    run = run_of(centre)
    places = np.linspace(0.0, run[-1], _LOOKS)
    middle = np.column_stack([np.interp(places, run, column) for column in centre[:, :2].T])
    gaps: list[float] = []
    for other in others:
        found = feet(middle, [other])
        length = run_of(other)[-1]
        beside = (found.along > 0) & (found.along < length)
        if beside.any():
            gap = float(np.median(np.hypot(*(found.at - middle)[beside].T)))
            gaps += [gap] * (NEIGHBOURS[0] <= gap <= NEIGHBOURS[1])
    return min(gaps, default=WIDE) / 2


def way_between(
    start: tuple[Floats, float, float, float], end: tuple[Floats, float, float, float]
) -> Sections:
    """Return the cross sections of a smooth lane between two ends (position, heading, width, height).

    Its centre line is a cubic; the lengths of its tangents are those of an arc with the same turn.
    """
    (p0, heading0, width0, z0), (p1, heading1, width1, z1) = start, end
    chord = float(np.hypot(*(p1 - p0)))
    turn = abs(float(np.remainder(heading1 - heading0 + np.pi, 2 * np.pi) - np.pi))
    tangent = chord / np.cos(turn / 4) ** 2
    t0 = tangent * np.array((np.cos(heading0), np.sin(heading0)))
    t1 = tangent * np.array((np.cos(heading1), np.sin(heading1)))
    n = int(np.clip(chord / _STEP, 8, 64)) + 1
    t = np.linspace(0.0, 1.0, n)[:, None]
    place = (
        (1 + 2 * t) * (1 - t) ** 2 * p0
        + t * (1 - t) ** 2 * t0
        + t * t * (3 - 2 * t) * p1
        - t * t * (1 - t) * t1
    )
    slope = 6 * t * (t - 1) * (p0 - p1) + (1 - t) * (1 - 3 * t) * t0 + t * (3 * t - 2) * t1
    slope /= np.maximum(np.hypot(*slope.T), 1e-9)[:, None]
    share = t[:, 0]
    half = (width0 + share * (width1 - width0))[:, None] / 2
    to_left = np.column_stack((-slope[:, 1], slope[:, 0]))
    return Sections(place + to_left * half, place - to_left * half, z0 + share * (z1 - z0))
