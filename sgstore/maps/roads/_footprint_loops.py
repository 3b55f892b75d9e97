"""Compiled loops (numba) for footprints on lane surfaces.

``_footprints`` has the same in numpy, with explanations. Both must round equally: change both together.
"""

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
    """Return pairs of a footprint and a lane piece that touch, common areas, and a mask of centres inside.

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
        Around quadrangles: centre x, centre y, radius.
    corners : (Q, 8) float64
        Corners of quadrangles: x, then y.
    turn : (Q,) float64
        +1 for a quadrangle with counter-clockwise corners, else -1.
    touch : float
        Distance at which a footprint still touches a lane; m.

    Returns
    -------
    footprint, quad : (P,) int64
    inside : (P,) bool
        True if the centre of the footprint is in the quadrangle.
    measures : (3, P) float64
        Relative position along the quadrangle, squared distance from its centre line, common area.
    """
    x, y, _, _, a, b = shapes
    keys, begin, quads, cells_per_column, quad_first = grid
    pairs = np.empty((max(8 * len(rows), 8), 2), np.int64)
    inside, measures = np.empty(len(pairs), np.bool_), np.empty((len(pairs), 3))
    corner_x, corner_y = np.empty(4), np.empty(4)
    count = 0
    for i in range(len(rows)):
        row = rows[i]
        size = float(a[row]), float(b[row])
        radius = np.hypot(size[0], size[1]) + touch
        for cell_x in range(cells[0][0, i], cells[1][0, i] + 1):
            for cell_y in range(cells[0][1, i], cells[1][1, i] + 1):
                key = cell_x * cells_per_column + cell_y
                cell = np.searchsorted(keys, key)
                if cell == len(keys) or keys[cell] != key:
                    continue
                for quad in quads[begin[cell] : begin[cell + 1]]:
                    if not _counts_here(cell_x, cell_y, cells[0][:, i], quad_first[:, quad]):
                        continue
                    away_x, away_y = circles[0][quad] - x[row], circles[1][quad] - y[row]
                    if away_x**2 + away_y**2 > (circles[2][quad] + radius) ** 2:
                        continue
                    _to_footprint_axes(corners[quad], shapes, row, corner_x, corner_y)
                    touches, is_inside = _meet(corner_x, corner_y, size, float(turn[quad]), touch)
                    if not touches:
                        continue
                    if count == len(pairs):
                        pairs, inside, measures = _doubled(pairs, inside, measures)
                    pairs[count, 0], pairs[count, 1], inside[count] = row, quad, is_inside
                    measures[count, 0], measures[count, 1] = _along_middle(corner_x, corner_y)
                    measures[count, 2] = _common_area(corner_x, corner_y, size)
                    count += 1
    return (
        pairs[:count, 0].copy(),
        pairs[:count, 1].copy(),
        inside[:count],
        measures[:count].T.copy(),
    )


@compiled
def _counts_here(cell_x: int, cell_y: int, first: Ints, quad_first: Ints) -> bool:
    """Return True in exactly one of the grid cells that a footprint and a lane piece share."""
    if cell_x > first[0] and quad_first[0] != cell_x:
        return False
    return cell_y == first[1] or quad_first[1] == cell_y


@compiled
def _doubled(pairs: Ints, inside: Bools, measures: Floats) -> tuple[Ints, Bools, Floats]:
    """Return copies of the result arrays with twice the length."""
    return (
        np.concatenate((pairs, np.empty_like(pairs))),
        np.concatenate((inside, np.empty_like(inside))),
        np.concatenate((measures, np.empty_like(measures))),
    )


@compiled
def _to_footprint_axes(
    corners: Floats, shapes: Shapes, row: int, corner_x: Floats, corner_y: Floats
) -> None:
    """Convert the corners of a lane piece to the axes of a footprint, and write them into two arrays."""
    x, y, cos, sin, _, _ = shapes
    for corner in range(4):
        dx, dy = corners[corner] - x[row], corners[4 + corner] - y[row]
        corner_x[corner] = dx * cos[row] + dy * sin[row]
        corner_y[corner] = dy * cos[row] - dx * sin[row]


@compiled
def _meet(
    x: Floats, y: Floats, size: tuple[float, float], turn: float, touch: float
) -> tuple[bool, bool]:
    """Return two flags: footprint and lane piece touch, and the footprint's centre is in the piece."""
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
def _along_middle(x: Floats, y: Floats) -> tuple[float, float]:
    """Return how far along a lane piece a footprint is (0 to 1), and its squared distance from the line."""
    from_x, from_y = (x[0] + x[3]) / 2, (y[0] + y[3]) / 2
    along_x, along_y = (x[1] + x[2]) / 2 - from_x, (y[1] + y[2]) / 2 - from_y
    share = -(from_x * along_x + from_y * along_y) / max(along_x**2 + along_y**2, 1e-18)
    at = min(max(share, 0.0), 1.0)
    return share, (from_x + at * along_x) ** 2 + (from_y + at * along_y) ** 2


@compiled
def _common_area(corner_x: Floats, corner_y: Floats, size: tuple[float, float]) -> float:
    """Return the common area of a footprint and a lane piece; m²."""
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
