"""Look-up of the lanes below footprints (ground rectangles of objects), with common area and lateral offset.

Every frame needs this look-up, so it must be fast. A lane is a chain of quadrangles
(:class:`~sgstore.maps.roads._ribbons.Ribbons`), short where it bends. A grid brings footprints and
nearby quadrangles together. Separating axes find the pairs that touch. The share of a footprint in
a quadrangle is a sum over the quadrangle's edges in closed form. numpy does this over chunks of
footprints that fit the caches; shapely's intersection takes longer.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.numba_loops import worth
from sgstore.base.tables import chained, spread
from sgstore.maps.roads._ribbons import Ribbons, wrapped

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.world import Bools, Floats, Ints


TOUCH: Final = 1e-3
"""Distance up to which a footprint touches a lane, so that a seam between lanes is no gap; m."""

_CELL: Final = 4.0
"""Side length of a grid cell; m."""
_CHUNK: Final = 1 << 13
"""Number of pairs (footprint, grid cell) that are processed at once."""
_MOST_ENTRIES: Final = 32
"""Largest mean number of cells for each lane piece. A finer grid is made coarser."""
_MOST_IN_ALL: Final = 1 << 21
"""Largest number of entries (lane piece in a cell) in a grid. A larger map may have four entries for each
lane piece. An entry takes about 60 bytes. Lanes of towns need 2 to 7 entries each."""
_POINT: Final = 1e-9
"""Length below which a value counts as zero; m."""
_MOST_STEPS: Final = 256
"""Largest number of lane pieces between a footprint and the piece at its centre."""


@dataclass(frozen=True, slots=True)
class Touches:
    """Pairs of a footprint (ground rectangle of an object) and a lane that it touches; shape (H,).

    ``row``, ``lane`` (from 0), ``overlap``, ``offset``, ``heading_error`` as in
    :class:`~sgstore.maps.roads.LaneHits`; ``inside``: True if the footprint's centre is in the lane.
    """

    row: Ints
    lane: Ints
    overlap: Floats
    offset: Floats
    heading_error: Floats
    inside: Bools


@dataclass(frozen=True, slots=True)
class _Quads:
    """Pieces of lane surfaces as quadrangles, sorted by lane and along the lane; Q pieces.

    The corners are right start, right end, left end, left start: counter-clockwise, ``turn`` +1,
    unless the lane has a negative width there. The whole quadrangle is within ``radius`` of its
    middle.
    """

    lane: Ints
    first: Bools  # of its lane
    last: Bools
    x: Floats
    y: Floats
    corners: Floats  # (Q, 8): x, then y
    turn: Floats
    middle_x: Floats
    middle_y: Floats
    radius: Floats
    z: Floats  # (2, Q): at its start and its end
    heading: Floats  # (2, Q)


def _quads(ribbons: Ribbons) -> _Quads:
    lane = ribbons.lane
    start = np.flatnonzero(lane[1:] == lane[:-1])
    right, left = (ribbons.right_x, ribbons.right_y), (ribbons.left_x, ribbons.left_y)
    x, y = (
        np.stack((this[start], this[start + 1], other[start + 1], other[start]))
        for this, other in zip(right, left, strict=True)
    )
    _unfold(x, y)
    twice = (x[2] - x[0]) * (y[3] - y[1]) - (x[3] - x[1]) * (y[2] - y[0])
    kept = np.abs(twice) > 1e-9
    start, x, y = start[kept], x[:, kept], y[:, kept]
    lane = lane[start]
    middle_x, middle_y = x.mean(axis=0), y.mean(axis=0)
    change = np.diff(lane) != 0
    one = np.ones(min(len(lane), 1), bool)
    heading = np.stack((ribbons.heading[start], ribbons.heading[start + 1]))
    heading[1] = heading[0] + wrapped(heading[1] - heading[0])
    return _Quads(
        lane=lane,
        first=np.concatenate((one, change)),
        last=np.concatenate((change, one)),
        x=x,
        y=y,
        corners=np.ascontiguousarray(np.concatenate((x, y)).T),
        turn=np.sign(twice[kept]),
        middle_x=middle_x,
        middle_y=middle_y,
        radius=np.hypot(x - middle_x, y - middle_y).max(axis=0),
        z=np.stack((ribbons.z[start], ribbons.z[start + 1])),
        heading=heading,
    )


def _unfold(x: Floats, y: Floats) -> None:
    """Repair lane pieces that fold over in tight bends: end them where their ends cross. Changes x and y.

    In a bend that is tighter than the lane is wide, the inner border runs backwards, beyond the
    centre of the bend. This part adds no area to the lane.
    """
    from_x, from_y = x[0] - x[3], y[0] - y[3]  # from left to right, at the start
    to_x, to_y = x[1] - x[2], y[1] - y[2]  # and at the end
    side = from_x * to_y - from_y * to_x
    parallel = np.abs(side) < 1e-12
    side = np.where(parallel, 1.0, side)
    step_x, step_y = x[2] - x[3], y[2] - y[3]
    at_start = (step_x * to_y - step_y * to_x) / side
    at_end = (step_x * from_y - step_y * from_x) / side
    crossing = ~parallel & (at_start > 0) & (at_start < 1) & (at_end > 0) & (at_end < 1)
    cross_x, cross_y = x[3] + at_start * from_x, y[3] + at_start * from_y
    for which, (start, end) in ((at_start < 0.5, (3, 2)), (at_start >= 0.5, (0, 1))):
        rows = np.flatnonzero(crossing & which)
        x[start, rows] = x[end, rows] = cross_x[rows]
        y[start, rows] = y[end, rows] = cross_y[rows]


class _Grid:
    """Square grid over the map. Each cell has a list of the lane pieces in it."""

    def __init__(self, quads: _Quads) -> None:
        low = np.stack((quads.x.min(axis=0), quads.y.min(axis=0)))
        high = np.stack((quads.x.max(axis=0), quads.y.max(axis=0)))
        self.origin = low.min(axis=1, initial=np.inf)[:, None]
        self.cell = _CELL
        n = low.shape[1]
        most = min(_MOST_ENTRIES * max(n, 64), max(_MOST_IN_ALL, 4 * n))
        while True:
            self.first, last = self.cells(low), self.cells(high)
            self.shape = last.max(axis=1, initial=0)[:, None] + 1
            # As floats: the number of cells of distant lanes can overflow an integer.
            entries = (last - self.first + 1).prod(axis=0, dtype=np.float64).sum()
            if entries <= most and self.shape.max() < 1 << 30:
                break
            self.cell *= 2
        quad, x, y = _cells_between(self.first, last)
        key = x * self.shape[1] + y
        order = np.argsort(key, kind="stable")
        self.quad = quad[order]
        key = key[order]
        begin = np.flatnonzero(np.diff(key, prepend=-1))
        self.keys, self.begin = key[begin], np.append(begin, len(key))

    def cells(self, places: Floats) -> Ints:
        """Return the grid cell (two integers) of each position, (2, N)."""
        return np.floor((places - self.origin) / self.cell).astype(np.int64)

    def pairs(self, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Return the lane pieces in rectangles of grid cells, as pairs: rectangle, lane piece.

        Each pair occurs once: a pair that shares several cells counts in the first of them.
        """
        row, x, y = _cells_between(first, last)
        key = x * self.shape[1] + y
        place = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        held = np.flatnonzero(self.keys[place] == key)
        row, x, y, place = row[held], x[held], y[held], place[held]
        sizes = self.begin[place + 1] - self.begin[place]
        cell, at = spread(self.begin[place], sizes)
        quad = self.quad[at]
        # In the first cell of the rectangle all quadrangles count; in the others only those that
        # begin there.
        inner_x, inner_y = (x > first[0][row])[cell], (y > first[1][row])[cell]
        once = (~inner_x | (self.first[0][quad] == x[cell])) & (
            ~inner_y | (self.first[1][quad] == y[cell])
        )
        return row[cell[once]], quad[once]


def _cells_between(first: Ints, last: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the cells in rectangles of a grid, as pairs: rectangle, cell."""
    spans = np.maximum(last - first + 1, 0)
    sizes = spans[0] * spans[1]
    row, number = spread(np.zeros_like(sizes), sizes)
    x, y = np.divmod(number, np.maximum(spans[1], 1)[row])
    return row, first[0][row] + x, first[1][row] + y


@dataclass(frozen=True, slots=True)
class _Shapes:
    """Footprints (ground rectangles) of N objects: position, heading, half size and height.

    ``a`` and ``b`` are half of length and width, ``z`` is the height.
    """

    x: Floats
    y: Floats
    cos: Floats
    sin: Floats
    a: Floats
    b: Floats
    z: Floats
    heading: Floats

    @classmethod
    def of(cls, boxes: Floats, z: Floats) -> _Shapes:
        """Return the footprints of boxes (N, 5). A side that is missing or zero becomes very short."""
        half = np.maximum(np.nan_to_num(np.abs(boxes[:, 3:5].T)) / 2, TOUCH / 2)
        heading = np.nan_to_num(boxes[:, 2])
        x, y = np.ascontiguousarray(boxes[:, :2].T)
        return cls(x, y, np.cos(heading), np.sin(heading), half[0], half[1], z, heading)


class LaneIndex:
    """Spatial index of all lanes of a map, to find the lanes below object footprints.

    Parameters
    ----------
    ribbons : Ribbons
    storey : float
        Greatest difference of height between a footprint and a lane that it touches; m.
    """

    def __init__(self, ribbons: Ribbons, storey: float) -> None:
        self._quads = _quads(ribbons)
        self._grid = _Grid(self._quads)
        self._storey = storey

    def touches(self, boxes: Floats, z: Floats) -> Touches:
        """Return the lanes that footprints (ground rectangles of objects) touch."""
        shapes = _Shapes.of(boxes, z)
        found = [self._touching(shapes)] if worth() else self._touching_in_chunks(shapes)
        return chained([_no_touches(), *(self._gathered(shapes, *touching) for touching in found)])

    def _touching(self, shapes: _Shapes) -> tuple[Ints, Ints, Bools, Floats]:
        """Return pairs of a footprint and a lane piece that touch, common areas, and a mask: centre inside."""
        from sgstore.maps.roads import _footprint_loops

        grid, quads = self._grid, self._quads
        rows, first, last = self._cells(shapes)
        return _footprint_loops.touching(
            rows,
            (first, last),
            (shapes.x, shapes.y, shapes.cos, shapes.sin, shapes.a, shapes.b),
            (grid.keys, grid.begin, grid.quad, int(grid.shape[1, 0]), grid.first),
            (quads.middle_x, quads.middle_y, quads.radius),
            quads.corners,
            quads.turn,
            TOUCH,
        )

    def _touching_in_chunks(self, shapes: _Shapes) -> Iterator[tuple[Ints, Ints, Bools, Floats]]:
        for row, quad in self._candidates(shapes):
            near = _Pairs.of(self._quads, shapes, row, quad)
            touch, inside = near.touching()
            touch = np.flatnonzero(touch)
            near = near.take(touch)
            yield (
                near.row,
                near.quad,
                inside[touch],
                np.stack([*near.beside(), near.common_areas()]),
            )

    def _cells(self, shapes: _Shapes) -> tuple[Ints, Ints, Ints]:
        """Return the footprints with a known position, and the first and last grid cell of each."""
        grid = self._grid
        cos, sin = np.abs(shapes.cos), np.abs(shapes.sin)
        reach = np.stack((cos * shapes.a + sin * shapes.b, sin * shapes.a + cos * shapes.b)) + TOUCH
        centre = np.stack((shapes.x, shapes.y))
        rows = np.flatnonzero(np.isfinite(centre + reach).all(axis=0))
        if not len(grid.quad):
            rows = rows[:0]
        low, high = (centre - reach)[:, rows], (centre + reach)[:, rows]
        top = grid.origin + grid.shape * grid.cell
        first = np.maximum(grid.cells(np.minimum(low, top)), 0)
        last = np.minimum(grid.cells(np.clip(high, grid.origin - 1.0, top)), grid.shape - 1)
        return rows, first, last

    def _candidates(self, shapes: _Shapes) -> Iterator[tuple[Ints, Ints]]:
        """Yield each pair of a footprint and a near lane piece once, for a group of footprints at a time."""
        grid, quads = self._grid, self._quads
        rows, first, last = self._cells(shapes)
        if not len(rows):
            return
        around = np.hypot(shapes.a, shapes.b) + TOUCH
        total = np.cumsum(np.maximum(last - first + 1, 0).prod(axis=0))
        cuts = np.searchsorted(total, np.arange(_CHUNK, total[-1] + _CHUNK, _CHUNK)) + 1
        for begin, end in pairwise([0, *np.unique(cuts).tolist()]):
            row, quad = grid.pairs(first[:, begin:end], last[:, begin:end])
            row = rows[begin:end][row]
            squared = (quads.middle_x[quad] - shapes.x[row]) ** 2
            squared += (quads.middle_y[quad] - shapes.y[row]) ** 2
            close = squared <= (quads.radius[quad] + around[row]) ** 2
            yield row[close], quad[close]

    def _gathered(
        self, shapes: _Shapes, row: Ints, quad: Ints, inside: Bools, measures: Floats
    ) -> Touches:
        quads = self._quads
        share, distance, area = measures
        z = quads.z[:, quad]
        level = z[0] + (z[1] - z[0]) * np.clip(share, 0.0, 1.0)
        apart = np.abs(level - shapes.z[row]) > self._storey
        if apart.any():
            same = np.flatnonzero(~apart)
            row, quad, inside = row[same], quad[same], inside[same]
            distance, area = distance[same], area[same]
        if not len(row):
            return _no_touches()
        lane = quads.lane[quad]
        key = row * (int(quads.lane[-1]) + 1) + lane
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        best = order[_first_least(distance[order], starts)]
        area = np.add.reduceat(np.abs(area)[order], starts)
        row = row[best]
        overlap = np.minimum(area / (4 * shapes.a[row] * shapes.b[row]), 1.0)
        within = np.logical_or.reduceat(inside[order], starts)
        offset, error = self._aside(shapes, row, quad[best])
        return Touches(row, lane[best], overlap, offset, error, within)

    def _aside(self, shapes: _Shapes, row: Ints, quad: Ints) -> tuple[Floats, Floats]:
        """Return the lateral offset (m) and heading error (rad) of footprints relative to lanes they touch.

        The offset refers to the place of the lane whose cross section runs through the footprint's
        centre. This place may be in a quadrangle that the footprint does not touch. Between two
        cross sections the centre line is approximated by the parabola with their headings.
        """
        quads = self._quads
        here = _Pairs.of(quads, shapes, row, quad)
        walking, towards = np.arange(len(quad)), np.zeros(len(quad), np.int64)
        quad, there = quad.copy(), here.between()
        for _ in range(_MOST_STEPS):
            at = quad[walking]
            step = ((there > 1) & ~quads.last[at]).astype(np.int64)
            step -= (there < 0) & ~quads.first[at]
            # In a folded lane two quadrangles may point to each other; the search never turns back.
            goes = np.flatnonzero((step != 0) & (step != -towards))
            walking, towards = walking[goes], step[goes]
            if not len(walking):
                break
            quad[walking] += towards
            there = _Pairs.of(quads, shapes, row[walking], quad[walking]).between()
        here = _Pairs.of(quads, shapes, row, quad)
        share = np.clip(here.between(), 0.0, 1.0)
        heading = quads.heading[:, quad]
        bend = heading[1] - heading[0]
        error = wrapped(shapes.heading[row] - heading[0] - bend * share)
        x, y, along_x, along_y = here.middle_line()
        bulge = np.hypot(along_x, along_y) * bend * share * (1 - share) / 2
        foot_x, foot_y = x + share * along_x, y + share * along_y
        return bulge - foot_x * np.sin(error) - foot_y * np.cos(error), error


def _first_least(values: Floats, starts: Ints) -> Ints:
    """Return the index of the first smallest value in each group of consecutive values."""
    least = np.minimum.reduceat(values, starts)
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(values)))
    rows = np.flatnonzero(values == least[group])[::-1]
    first = np.empty(len(starts), np.int64)
    first[group[rows]] = rows  # numpy keeps the last of several assignments to one place
    return first


def _no_touches() -> Touches:
    none, nothing = np.zeros(0, np.int64), np.zeros(0)
    return Touches(none, none, nothing, nothing, nothing, np.zeros(0, bool))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Pairs of a footprint and a piece of a lane surface (quadrangle); n pairs."""

    row: Ints
    quad: Ints
    a: Floats
    b: Floats
    turn: Floats
    x: Floats
    y: Floats

    @classmethod
    def of(cls, quads: _Quads, shapes: _Shapes, row: Ints, quad: Ints) -> _Pairs:
        # The four corners of a quadrangle are fetched together, from one cache line. Then each
        # corner gets its own run of memory, which makes the sums below fast.
        corners = quads.corners.take(quad, axis=0).T
        x = np.subtract(corners[:4], shapes.x[row], order="C")
        y = np.subtract(corners[4:], shapes.y[row], order="C")
        cos, sin = shapes.cos[row], shapes.sin[row]
        along, across = x * cos + y * sin, y * cos - x * sin
        return cls(row, quad, shapes.a[row], shapes.b[row], quads.turn[quad], along, across)

    def take(self, rows: Ints) -> _Pairs:
        """Return the given pairs of a footprint and a lane piece, by index."""
        return _Pairs(
            self.row[rows],
            self.quad[rows],
            self.a[rows],
            self.b[rows],
            self.turn[rows],
            self.x.take(rows, axis=1),
            self.y.take(rows, axis=1),
        )

    def touching(self) -> tuple[Bools, Bools]:
        """Return two masks: footprint and lane piece touch, and the footprint's centre is in the piece."""
        a, b = self.a + TOUCH, self.b + TOUCH
        x, y = self.x, self.y
        apart = (x.min(axis=0) > a) | (x.max(axis=0) < -a)
        apart |= (y.min(axis=0) > b) | (y.max(axis=0) < -b)
        inside = np.ones(len(apart), bool)
        for i in range(4):
            edge_x, edge_y = x[i - 3] - x[i], y[i - 3] - y[i]
            beyond = (edge_x * y[i] - edge_y * x[i]) * self.turn
            edge_x, edge_y = np.abs(edge_x), np.abs(edge_y)
            apart |= beyond > a * edge_y + b * edge_x
            inside &= beyond <= TOUCH * (edge_x + edge_y)
        return ~apart, inside

    def middle_line(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the start of each lane piece's centre line, and the vector from there to its end."""
        x, y = (self.x[0] + self.x[3]) / 2, (self.y[0] + self.y[3]) / 2
        return x, y, (self.x[1] + self.x[2]) / 2 - x, (self.y[1] + self.y[2]) / 2 - y

    def beside(self) -> tuple[Floats, Floats]:
        """Return how far along the lane piece the footprint is (0 to 1), and its squared distance."""
        x, y, along_x, along_y = self.middle_line()
        share = -(x * along_x + y * along_y) / np.maximum(along_x**2 + along_y**2, 1e-18)
        at = np.clip(share, 0.0, 1.0)
        return share, (x + at * along_x) ** 2 + (y + at * along_y) ** 2

    def between(self) -> Floats:
        """Return how far a footprint's centre is from the start to the end of a lane piece, 0 to 1.

        Unlike the projection, this share continues from quadrangle to quadrangle without a gap or
        overlap.
        """
        ahead, start = self._ahead(0, 3)
        behind, end = self._ahead(1, 2)
        both = ahead - behind
        usable = (start > _POINT) & (end > _POINT) & (both > _POINT)
        return np.where(usable, ahead / np.where(usable, both, 1.0), self.beside()[0])

    def _ahead(self, right: int, left: int) -> tuple[Floats, Floats]:
        """Return how far a footprint's centre is beyond one end of a lane piece, and the width of that end."""
        across_x, across_y = self.x[left] - self.x[right], self.y[left] - self.y[right]
        width = np.hypot(across_x, across_y)
        ahead = self.y[right] * across_x - self.x[right] * across_y
        return ahead / np.maximum(width, _POINT), width

    def common_areas(self) -> Floats:
        """Return the common area of footprint and lane piece; m². It is negative for a clockwise piece.

        The area of a polygon P in the box [-a, a] × [-b, b] is ∮ x̂ dy along P's edges where |y| ≤ b, with
        x̂ = x held within ±a: Green's theorem for the field (x̂, 0). Along an edge the integral of x̂ is a
        difference of x̂ (x - x̂ / 2), its antiderivative.
        """
        a, b = self.a, self.b
        area = np.zeros(len(a))
        for i in range(4):
            x, y = self.x[i], self.y[i]
            run, rise = self.x[i - 3] - x, self.y[i - 3] - y
            low = np.minimum(np.maximum(y, -b), b)
            high = np.minimum(np.maximum(self.y[i - 3], -b), b)
            slope = run / np.where(np.abs(rise) > 1e-12, rise, 1.0)
            from_x, to_x = x + slope * (low - y), x + slope * (high - y)
            from_held = np.minimum(np.maximum(from_x, -a), a)
            to_held = np.minimum(np.maximum(to_x, -a), a)
            across = to_x - from_x
            level = np.abs(across) < 1e-9
            integral = to_held * (to_x - to_held / 2) - from_held * (from_x - from_held / 2)
            mean = np.where(level, from_held, integral / np.where(level, 1.0, across))
            area += (high - low) * mean
        return area
