"""Lane surfaces as tables of cross sections, with look-ups of points along lanes.

Ribbons describe lane surfaces independent of the source format.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from threading import Lock
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.base.tables import chained, spread

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints

PREPARED: Final = Lock()
"""Lock, so that only one thread at a time prepares shapes for shapely."""


@dataclass(frozen=True, slots=True)
class Ribbons:
    """Surfaces of all lanes as cross sections. Lane i has the rows ``offsets[i]:offsets[i + 1]``.

    Between two cross sections a lane is the quadrangle of their four ends. A lane has at least two
    cross sections; they may be in one place. Where a lane jumps, its cross sections jump too.

    Attributes
    ----------
    offsets : (L + 1,) int64
    left_x, left_y, right_x, right_y : (S,) float64
        Ends of the cross section, to the left and to the right of the direction of travel; m.
    z : (S,) float64
        Height; m.
    heading : (S,) float64
        Direction of travel of the centre line; rad, not wrapped.
    s : (S,) float64
        Place on the reference line of its road; m. Decreases along lanes that run against it.
    along : (S,) float64
        Length of the centre line from the lane's start; m.
    """

    offsets: Ints
    left_x: Floats
    left_y: Floats
    right_x: Floats
    right_y: Floats
    z: Floats
    heading: Floats
    s: Floats
    along: Floats

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def followed_by(self, more: Ribbons) -> Ribbons:
        """Return the lane surfaces, with the surfaces of more lanes appended."""
        offsets = np.concatenate((self.offsets, self.offsets[-1] + more.offsets[1:]))
        return replace(chained([self, more]), offsets=offsets)

    @property
    def lengths(self) -> Floats:
        """Lengths of the centre lines of all lanes, (L,); m."""
        return self.along[self.offsets[1:] - 1]

    @property
    def lane(self) -> Ints:
        """Lane index of each cross section, (S,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def bends(self) -> Floats:
        """Angle from each cross section to the next one of the lane, (S,); rad.

        0 where the lane jumps, and at its end.
        """
        before = np.arange(len(self.along) - 1)
        first, last, _ = self._turns(before)
        bend = np.where(_is_smooth(first, last), wrapped(np.diff(self.heading)), 0.0)
        bend = np.append(bend, 0.0)
        bend[self.offsets[1:] - 1] = 0.0
        return bend

    def between(self, lane: Ints, along: Floats, column: Floats) -> Floats:
        """Interpolate one or more columns of the cross sections at positions along lanes.

        ``lane`` and ``along`` as in :meth:`at`.
        """
        before, share = self._place(self.along, np.ones(len(self)), lane, along)
        return column[..., before] + share * (column[..., before + 1] - column[..., before])

    def height(self, lane: Ints, along: Floats) -> Floats:
        """Return the road heights at given positions along lanes; m."""
        return self.between(lane, along, self.z)

    def at(self, lane: Ints, along: Floats) -> LanePoints:
        """Return points on centre lines (position, heading), at given positions along lanes.

        Parameters
        ----------
        lane : (N,) int64
            Lanes, counted from 0.
        along : (N,) float64
            Length of the centre line from the lane's start; m. Places outside the lane are moved to
            its start or end.

        Notes
        -----
        Between cross sections the centre line is the cubic that has their headings.
        """
        before, share = self._place(self.along, np.ones(len(self)), lane, along)
        after = before + 1
        x, y = (self.left_x + self.right_x) / 2, (self.left_y + self.right_y) / 2
        first, last, (run_x, run_y) = self._turns(before)
        # A step across, where the lane jumps, has no bulge.
        smooth = _is_smooth(first, last)
        aside = np.where(smooth, share * (1 - share) * (first * (1 - share) - last * share), 0.0)
        width = np.hypot(self.left_x - self.right_x, self.left_y - self.right_y)
        bend = wrapped(self.heading[after] - self.heading[before])
        length = self.along[after] - self.along[before]
        return LanePoints(
            lane=np.asarray(lane, np.int64),
            along=self.along[before] + share * length,
            s=self.s[before] + share * (self.s[after] - self.s[before]),
            x=x[before] + share * run_x - aside * run_y,
            y=y[before] + share * run_y + aside * run_x,
            z=self.z[before] + share * (self.z[after] - self.z[before]),
            heading=wrapped(self.heading[before] + share * bend),
            width=width[before] + share * (width[after] - width[before]),
            curvature=np.where(smooth & (length > 0), bend / np.where(length > 0, length, 1), 0.0),
        )

    def _turns(self, before: Ints) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Return the headings at both ends of centre line pieces, relative to their chords, and the chords."""
        after = before + 1
        x, y = (self.left_x + self.right_x) / 2, (self.left_y + self.right_y) / 2
        way = x[after] - x[before], y[after] - y[before]
        chord = np.arctan2(way[1], way[0])
        first, last = (wrapped(self.heading[rows] - chord) for rows in (before, after))
        return first, last, way

    def along_at(self, lane: Ints, s: Floats) -> Floats:
        """Convert road positions ``s`` to lengths along lane centre lines, (N,); m."""
        sign = np.where(self.s[self.offsets[1:] - 1] < self.s[self.offsets[:-1]], -1.0, 1.0)
        before, share = self._place(self.s, sign, lane, s)
        return self.along[before] + share * (self.along[before + 1] - self.along[before])

    def _place(
        self, column: Floats, sign: Floats, lane: Ints, value: Floats
    ) -> tuple[Ints, Floats]:
        """Return the cross section before each position on a lane, and the share of the way to the next one.

        ``column`` rises along lanes where ``sign`` is 1 and falls where it is -1. All lanes are
        searched at once, laid end to end with gaps of 1 m.
        """
        of = self.lane
        run = (column - column[self.offsets[:-1]][of]) * sign[of]
        extent = run[self.offsets[1:] - 1]
        base = np.cumsum(extent + 1.0) - extent
        into = np.clip((value - column[self.offsets[:-1]][lane]) * sign[lane], 0.0, extent[lane])
        place = np.searchsorted(run + base[of], into + base[lane], side="right") - 1
        before = np.clip(place, self.offsets[:-1][lane], self.offsets[1:][lane] - 2)
        gap = run[before + 1] - run[before]
        return before, np.clip((into - run[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)

    def mean_widths(self) -> Floats:
        """Return the mean width of each lane, (L,); m."""
        width = np.hypot(self.left_x - self.right_x, self.left_y - self.right_y)
        starts = self.offsets[:-1]
        step = np.abs(np.diff(self.s, append=0.0))
        step[self.offsets[1:] - 1] = 0.0
        total = np.add.reduceat(step, starts)
        weighted = np.add.reduceat(step * (width + np.append(width[1:], 0.0)) / 2, starts)
        plain = np.add.reduceat(width, starts) / np.diff(self.offsets)
        return np.where(total > 0, weighted / np.where(total > 0, total, 1.0), plain)

    def turned(self) -> Floats:
        """Return how much each lane turns from start to end, positive to the left, (L,); rad."""
        bend = wrapped(np.diff(self.heading, append=0.0))
        bend[self.offsets[1:] - 1] = 0.0
        return np.add.reduceat(bend, self.offsets[:-1])


@dataclass(frozen=True, slots=True)
class LanePoints:
    """Points on the centre lines of lanes: position, heading, height; shape (N,).

    Attributes
    ----------
    lane : int64
        Lane, counted from 0.
    along, s : float64
        Length of the centre line from the lane's start, and place on the road's reference line; m.
    x, y, z : float64
    heading : float64
        Direction of travel, in (-π, π]; rad.
    width : float64
        Width of the lane; m.
    curvature : float64
        Curvature of the centre line, positive to the left: the mean between the neighbouring cross
        sections; 1/m.
    """

    lane: Ints
    along: Floats
    s: Floats
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    width: Floats
    curvature: Floats

    def __len__(self) -> int:
        return len(self.lane)


def _is_smooth(first: Floats, last: Floats) -> Bools:
    """Return a mask of centre line pieces without a jump: both end headings are within 1 rad of the chord."""
    return (np.abs(first) < 1) & (np.abs(last) < 1)


def wrapped(angle: Floats) -> Floats:
    """Wrap angles into (-π, π]; rad."""
    return np.pi - (np.pi - angle) % (2 * np.pi)


def waypoints(ribbons: Ribbons, spacing: float) -> LanePoints:
    """Return points along the centre lines of all lanes, every ``spacing`` metres.

    Raises
    ------
    ValueError
        ``spacing`` is not above 0.
    """
    if not spacing > 0:
        raise ValueError(f"spacing is {spacing}; expected a length above 0, in metres")
    counts = np.floor(ribbons.lengths / spacing + 1e-9).astype(np.int64) + 1
    lane, number = spread(np.zeros_like(counts), counts)
    return ribbons.at(lane, number.astype(np.float64) * spacing)


def centre_lines(ribbons: Ribbons) -> NDArray[Any]:
    """Return the centre line of each lane as a shapely line, (L,)."""
    x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
    lines: Any = shapely.linestrings(np.column_stack((x, y)), indices=ribbons.lane)
    return lines


def lane_polygons(ribbons: Ribbons) -> NDArray[Any]:
    """Return the surface of each lane as a shapely polygon, (L,)."""
    counts = np.diff(ribbons.offsets)
    lane = ribbons.lane
    number = np.arange(len(lane)) - ribbons.offsets[lane]
    first = 2 * ribbons.offsets[lane] + lane  # each closed ring has one point more
    points = np.empty((2 * len(lane) + len(counts), 2))
    points[first + number] = np.column_stack((ribbons.right_x, ribbons.right_y))
    back = first + 2 * counts[lane] - 1 - number
    points[back] = np.column_stack((ribbons.left_x, ribbons.left_y))
    start = 2 * ribbons.offsets[:-1] + np.arange(len(counts))
    points[start + 2 * counts] = points[start]
    ring = np.repeat(np.arange(len(counts)), 2 * counts + 1)
    polygons: Any = shapely.polygons(shapely.linearrings(points, indices=ring))
    return polygons


class LaneSurface:
    """Surroundings of some lanes: all points within a distance of the lanes' surfaces.

    Parameters
    ----------
    polygons : (L,) object
        Valid shapely polygons of the lanes.
    distance : float
        m.
    """

    def __init__(self, polygons: NDArray[Any], distance: float) -> None:
        self._distance = distance
        self._parts: Any = shapely.get_parts(shapely.union_all(polygons))
        shapely.prepare(self._parts)
        around = np.array([-distance, -distance, distance, distance])
        self._boxes = shapely.STRtree(shapely.box(*(shapely.bounds(self._parts) + around).T))

    def near(self, x: Floats, y: Floats) -> Bools:
        """Return a mask of the points that are within the distance of the lanes."""
        points: Any = shapely.points(x, y)
        row, part = self._boxes.query(points)
        near = np.zeros(len(x), np.bool_)
        with PREPARED:
            near[row[shapely.dwithin(self._parts[part], points[row], self._distance)]] = True
        return near
