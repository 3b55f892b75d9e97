"""Where the nodes of a diagram go: entities where the ego sees them, the parts of the map in rows below.

The same graph gives the same layout, and a small change of the scene a small change of the layout: places
come from geometry and from nothing else. Distances are compressed, so that what is near has room and what is
far is still there; then nodes that overlap push one another apart. All measures are points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.draw.labels import Rect
    from sgstore.world import Floats

GAP: Final = (26.0, 11.0)
"""Room between two nodes, to the sides and up and down, so that lines between them can be seen."""
ROUNDS: Final = 200
ROW: Final = 17.0
"""Height of a row of parts of the map."""
_PULL: Final = 0.06
"""Share of the way back to its own place that a node makes in each round."""


def scattered(places: Floats, sizes: Floats, box: Rect, *, pinned: int = 1) -> Floats:
    """Middles of nodes that lie as their places do, and do not overlap if there is room.

    Parameters
    ----------
    places : (N, 2) float64
        Where things are, in any measure, from the first one; NaN: nowhere, these are put at the border.
    sizes : (N, 2) float64
        Width and height of the nodes.
    box : Rect
        They stay in it.
    pinned : int
        The first nodes that do not move.

    Returns
    -------
    (N, 2) float64
    """
    if not len(places):
        return np.zeros((0, 2))
    low, high = np.array(box[:2]), np.array(box[2:])
    half = (high - low) / 2
    away = np.nan_to_num(places - places[0])
    nowhere = np.isnan(places).any(axis=1)
    away[nowhere, 1] = np.nanmax(np.abs(away), initial=1.0)
    # Roads are longer than wide: what is narrow is drawn wider, up to a half.
    reach = np.maximum(np.abs(away).max(axis=0), np.abs(away).max() / 2)
    away /= np.maximum(reach, 1e-9)
    # The root compresses: a thing at a quarter of the way is drawn in the middle.
    share = np.abs(away).max(axis=1)
    scale = np.divide(1.0, np.sqrt(share), out=np.zeros_like(share), where=share > 0)
    room = half - sizes.max(axis=0) / 2
    wanted = (low + high) / 2 + away * scale[:, None] * room
    return _freed(_apart(wanted, sizes, box, pinned), sizes, box, pinned)


def _apart(wanted: Floats, sizes: Floats, box: Rect, pinned: int) -> Floats:
    """Push nodes apart that overlap, each pair along the shorter way, and pull all back to their places."""
    count = len(wanted)
    low = np.array(box[:2]) + sizes / 2
    high = np.array(box[2:]) - sizes / 2
    # Those at one place fan out: else nobody would know which way to push.
    number = np.arange(count)
    loose = number >= pinned
    spots = wanted + 0.01 * np.stack([np.cos(number), np.sin(number)], axis=1) * loose[:, None]
    needed = (sizes[:, None] + sizes[None]) / 2 + GAP
    for turn in range(ROUNDS):
        way = spots[:, None] - spots[None]
        lacking = needed - np.abs(way)
        meet = (lacking[:, :, 0] > 0) & (lacking[:, :, 1] > 0) & ~np.eye(count, dtype=np.bool_)
        if not meet.any() and turn > ROUNDS // 2:
            break
        across = lacking[:, :, 0] / needed[:, :, 0] < lacking[:, :, 1] / needed[:, :, 1]
        sign = np.where(way >= 0, 1.0, -1.0)
        sign = np.where((way == 0) & (number < number[:, None])[..., None], -1, sign)
        push = np.where(np.stack([across, ~across], axis=2), lacking * sign, 0.0)
        push[~meet] = 0.0
        calm = 1.0 if turn < ROUNDS // 2 else 0.0
        step = 0.3 * push.sum(axis=1) + calm * _PULL * (wanted - spots)
        spots[loose] += step[loose]
        spots = np.clip(spots, low, high)
    return spots


def _freed(spots: Floats, sizes: Floats, box: Rect, pinned: int) -> Floats:
    """Put each node that still lies on an earlier one into the nearest free place, if there is any."""
    low, high = np.array(box[:2]), np.array(box[2:])
    spots = spots.copy()
    for node in range(pinned, len(spots)):
        needed = (sizes[:node] + sizes[node]) / 2 + 1.0
        if not (np.abs(spots[:node] - spots[node]) < needed).all(axis=1).any():
            continue
        half = sizes[node] / 2
        steps = (
            np.arange(low[i] + half[i], high[i] - half[i] + 1e-6, half[i] / (2 - i)) for i in (0, 1)
        )
        places = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        taken = (np.abs(places[:, None] - spots[:node]) < needed).all(axis=2).any(axis=1)
        if not taken.all():
            far = np.hypot(*(places - spots[node]).T)
            spots[node] = places[np.argmin(np.where(taken, np.inf, far))]
    return spots


def rows(order: Floats, widths: Floats, box: Rect) -> tuple[Floats, int]:
    """Middles of nodes side by side, in as many rows as they need, in an order from left to right.

    Parameters
    ----------
    order : (N,) float64
        What is smaller is further to the left.
    widths : (N,) float64
    box : Rect
        Left and right bound the rows; the first row lies at the top.

    Returns
    -------
    spots : (N, 2) float64
    count : int
        Number of rows.
    """
    left, _, right, top = box
    placed = np.zeros((len(order), 2))
    if not len(order):
        return placed, 0
    sequence = np.argsort(order, kind="stable")
    count = _rows_needed(widths, right - left)
    for row in range(
        count
    ):  # dealt out, so that neighbours stand in different rows and have room for arrows
        inside = sequence[row::count]
        free = (right - left - widths[inside].sum()) / (len(inside) + 1)
        ends = np.cumsum(widths[inside] + free)
        placed[inside, 0] = left + ends - widths[inside] / 2
        placed[inside, 1] = top - ROW * row - ROW / 2
    return placed, count


def _rows_needed(widths: NDArray[np.float64], room: float) -> int:
    count = 1
    while True:
        fullest = max(
            widths[row::count].sum() + GAP[0] / 2 * len(widths[row::count]) for row in range(count)
        )
        if fullest <= room or count >= len(widths):
            return count
        count += 1
