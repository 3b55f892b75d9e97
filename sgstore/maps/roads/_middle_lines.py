"""Centre line of a lane, computed from its left and right border."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.roads._cross_sections import APART, feet, run_of, thinned

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Floats

MAX_PIECES: Final = 1_000
"""Largest number of pieces of a border. A lane with more is left out with a warning."""

_DOUBLE: Final = 1.0
"""Distance up to which two pieces of a border are parallel (double line), unless one continues the other; m."""

_ONE_SIDED: Final = 0.5
"""Smallest share of the length along which the left and right borders must be on the correct sides."""


def middle_between(lefts: Sequence[Floats], rights: Sequence[Floats]) -> Floats:
    """Return the centre line between the left and right borders of a lane.

    Parameters
    ----------
    lefts, rights : sequence of (k, 3) float64
        Pieces of the borders, in any order and direction. Two pieces can be next to each other, as
        double lines are.

    Returns
    -------
    middle : (n, 3) float64
        Its direction has the left border on the left.

    Raises
    ------
    ValueError
        A border has no length or too many pieces, or the borders cross or are equal.
    """
    left, right = _joined_pieces(lefts, "left"), _joined_pieces(rights, "right")
    same_way = np.hypot(*(left[[0, -1]] - right[[0, -1]])[:, :2].T).sum()
    opposite_way = np.hypot(*(left[[0, -1]] - right[[-1, 0]])[:, :2].T).sum()
    right = right if same_way <= opposite_way else right[::-1]
    for end in (0, -1):
        left, right = _cut_back(left, right, end), _cut_back(right, left, end)
    shares = [run_of(line) / run_of(line)[-1] for line in (left, right)]
    stations = np.unique(np.concatenate(shares))
    left, right = (
        np.column_stack([np.interp(stations, share, column) for column in line.T])
        for share, line in zip(shares, (left, right), strict=True)
    )
    middle = (left + right) / 2
    step, to_left = np.diff(middle[:, :2], axis=0), (left - right)[:, :2]
    to_left = (to_left[:-1] + to_left[1:]) / 2
    area = step[:, 0] * to_left[:, 1] - step[:, 1] * to_left[:, 0]
    if not abs(area.sum()) > max(_ONE_SIDED * np.abs(area).sum(), APART * run_of(middle)[-1]):
        raise ValueError("its boundaries cross, or are one and the same")
    return thinned(middle if area.sum() > 0 else middle[::-1])


def _joined_pieces(pieces: Sequence[Floats], side: str) -> Floats:
    """Join the pieces of a lane border: first the longest, then always the one with the nearest end."""
    free = [thin for piece in pieces if len(thin := thinned(piece)) > 1 and run_of(thin)[-1] > 0]
    if not free:
        raise ValueError(f"neither a centre line nor a boundary to its {side}")
    if len(free) > MAX_PIECES:
        raise ValueError(f"more than {MAX_PIECES} boundaries to its {side}")
    free.sort(key=lambda piece: -run_of(piece)[-1])
    chain, free = free[0], free[1:]
    ends = np.array([piece[[0, -1], :2] for piece in free]).reshape(-1, 2, 2)
    while free:
        # (piece, end of the piece, end of the chain)
        gaps = np.hypot(*np.moveaxis(ends[:, :, None] - chain[[0, -1], :2], -1, 0))
        nearest, piece_end, chain_end = (
            int(i) for i in np.unravel_index(gaps.argmin(), gaps.shape)
        )
        piece, ends = free.pop(nearest), np.delete(ends, nearest, axis=0)
        if _is_parallel(piece, chain):
            continue
        if chain_end == 1:
            chain = np.concatenate((chain, piece if piece_end == 0 else piece[::-1]))
        else:
            chain = np.concatenate((piece if piece_end == 1 else piece[::-1], chain))
    return thinned(chain)


def _is_parallel(piece: Floats, chain: Floats) -> bool:
    """Return True if the middle of a piece is close to the joined pieces, as in a double line."""
    run = run_of(piece)
    midpoint = np.array([[np.interp(run[-1] / 2, run, column) for column in piece[:, :2].T]])
    foot = feet(midpoint, [chain])
    return not foot.is_end[0] and bool(np.hypot(*(foot.at - midpoint)[0]) <= _DOUBLE)


def _cut_back(line: Floats, other: Floats, end: int) -> Floats:
    """Shorten a lane border at one end if it extends beyond the end of the other border."""
    run = run_of(line)
    foot = feet(other[[end], :2], [line])
    along, gap = float(foot.along[0]), float(np.hypot(*(foot.at[0] - other[end, :2])))
    beyond = along if end == 0 else run[-1] - along
    if beyond <= max(gap, APART) or not 0 < along < run[-1]:
        return line
    cut = np.array([[np.interp(along, run, column) for column in line.T]])
    return (
        np.concatenate((cut, line[run > along]))
        if end == 0
        else np.concatenate((line[run < along], cut))
    )
