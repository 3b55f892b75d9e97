"""Compiled loops (numba) for footprints on lane surfaces. ``_footprints`` has the same in numpy."""

# ruff: noqa: PLR0913, PLR0917

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.base.numba_loops import compiled

if TYPE_CHECKING:
    from sgstore.model.world import Bools, Floats, Ints

    Shapes = tuple[Floats, Floats, Floats, Floats, Floats, Floats]


@compiled
def touching(
    rows: Ints,
    cells: tuple[Ints, Ints],
    shapes: Shapes,
    grid: tuple[Ints, Ints, Ints, int, Ints],
    circles: tuple[Floats, Floats, Floats],
    corners: Floats,
    turn: Floats,
    touch: float,
) -> tuple[Ints, Ints, Bools, Floats]:
    """Return touching pairs of an object footprint and a lane piece, with overlap area and centre mask.

    Parameters
    ----------
    rows : (R,) int64
        Footprints to look up.
    cells : tuple of (2, R) int64
        First and last cells of their grid rectangle.
    shapes : tuple of (N,) float64
        ``x, y, cos, sin, a, b`` of footprints.
    grid : tuple
        Keys of cells, ascending; start of the quadrangles of each cell; these quadrangles; cells
        per column; and the first cell (2, Q) of each quadrangle.
    circles : tuple of (Q,) float64
        Around quadrangles.
    corners : (Q, 8) float64
    turn : (Q,) float64
    touch : float
        m.
    """
    x, y, _, _, a, b = shapes
    keys, begin, held, high, quad_first = grid
    found = np.empty((max(8 * len(rows), 8), 2), np.int64)
    inside, numbers = np.empty(len(found), np.bool_), np.empty((len(found), 3))
    at_x, at_y = np.empty(4), np.empty(4)
    count = 0
    for i in range(len(rows)):
        row = rows[i]
        size = float(a[row]), float(b[row])
        around = np.hypot(size[0], size[1]) + touch
        for cell_x in range(cells[0][0, i], cells[1][0, i] + 1):
            for cell_y in range(cells[0][1, i], cells[1][1, i] + 1):
                key = cell_x * high + cell_y
                place = np.searchsorted(keys, key)
                if place == len(keys) or keys[place] != key:
                    continue
                for quad in held[begin[place] : begin[place + 1]]:
                    if not _counts(cell_x, cell_y, cells[0][:, i], quad_first[:, quad]):
                        continue
                    away_x, away_y = circles[0][quad] - x[row], circles[1][quad] - y[row]
                    if away_x**2 + away_y**2 > (circles[2][quad] + around) ** 2:
                        continue
                    _place(corners[quad], shapes, row, at_x, at_y)
                    meets, within = _meets(at_x, at_y, size, float(turn[quad]), touch)
                    if not meets:
                        continue
                    if count == len(found):
                        found, inside, numbers = _doubled(found, inside, numbers)
                    found[count, 0], found[count, 1], inside[count] = row, quad, within
                    numbers[count, 0], numbers[count, 1] = _beside(at_x, at_y)
                    numbers[count, 2] = _common_area(at_x, at_y, size)
                    count += 1
    return (
        found[:count, 0].copy(),
        found[:count, 1].copy(),
        inside[:count],
        numbers[:count].T.copy(),
    )


@compiled
def _counts(cell_x: int, cell_y: int, first: Ints, quad_first: Ints) -> bool:
    """Return True if a lane piece counts in a grid cell, so that each lane piece is found only once."""
    if cell_x > first[0] and quad_first[0] != cell_x:
        return False
    return cell_y == first[1] or quad_first[1] == cell_y


@compiled
def _doubled(found: Ints, inside: Bools, numbers: Floats) -> tuple[Ints, Bools, Floats]:
    """Return copies of the result arrays with twice the size."""
    return (
        np.concatenate((found, np.empty_like(found))),
        np.concatenate((inside, np.empty_like(inside))),
        np.concatenate((numbers, np.empty_like(numbers))),
    )


@compiled
def _place(corners: Floats, shapes: Shapes, row: int, at_x: Floats, at_y: Floats) -> None:
    """Convert the corners of a lane piece into the axes of an object footprint."""
    x, y, cos, sin, _, _ = shapes
    for corner in range(4):
        dx, dy = corners[corner] - x[row], corners[4 + corner] - y[row]
        at_x[corner] = dx * cos[row] + dy * sin[row]
        at_y[corner] = dy * cos[row] - dx * sin[row]


@compiled
def _meets(
    x: Floats, y: Floats, size: tuple[float, float], turn: float, touch: float
) -> tuple[bool, bool]:
    """Return two flags: footprint and lane piece touch; the footprint's centre is in the piece."""
    a, b = size[0] + touch, size[1] + touch
    if x.min() > a or x.max() < -a or y.min() > b or y.max() < -b:
        return False, False
    inside = True
    for i in range(4):
        edge_x, edge_y = x[i - 3] - x[i], y[i - 3] - y[i]
        beyond = (edge_x * y[i] - edge_y * x[i]) * turn
        edge_x, edge_y = abs(edge_x), abs(edge_y)
        if beyond > a * edge_y + b * edge_x:
            return False, False
        inside = inside and beyond <= touch * (edge_x + edge_y)
    return True, inside


@compiled
def _beside(x: Floats, y: Floats) -> tuple[float, float]:
    """Return the relative position of a footprint along the lane piece, and the squared distance."""
    from_x, from_y = (x[0] + x[3]) / 2, (y[0] + y[3]) / 2
    along_x, along_y = (x[1] + x[2]) / 2 - from_x, (y[1] + y[2]) / 2 - from_y
    share = -(from_x * along_x + from_y * along_y) / max(along_x**2 + along_y**2, 1e-18)
    at = min(max(share, 0.0), 1.0)
    return share, (from_x + at * along_x) ** 2 + (from_y + at * along_y) ** 2


@compiled
def _common_area(corner_x: Floats, corner_y: Floats, size: tuple[float, float]) -> float:
    """Return the overlap area of an object footprint and a lane piece; m²."""
    a, b = size
    area = 0.0
    for i in range(4):
        x, y = corner_x[i], corner_y[i]
        run, rise = corner_x[i - 3] - x, corner_y[i - 3] - y
        low, high = min(max(y, -b), b), min(max(corner_y[i - 3], -b), b)
        slope = run / (rise if abs(rise) > 1e-12 else 1.0)
        from_x, to_x = x + slope * (low - y), x + slope * (high - y)
        from_held, to_held = min(max(from_x, -a), a), min(max(to_x, -a), a)
        across = to_x - from_x
        mean = from_held
        if abs(across) >= 1e-9:
            mean = to_held * (to_x - to_held / 2) - from_held * (from_x - from_held / 2)
            mean /= across
        area += (high - low) * mean
    return area
