"""Neighbouring lanes that share a border, and the centre line between two borders.

Lanes described by their borders only: the middle line, and lanes that share a border. The pieces of a border
have any order and direction; two of them can be next to each other, as double lines are. The direction of a
lane's line follows from its left and right border.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.roads._cross_sections import APART, feet, run_of, thinned

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.maps.roads._lane_lines import LaneLine
    from sgstore.model.world import Floats

MAX_PIECES: Final = 1_000
"""Greatest number of pieces of a border. A lane with more is left out and named in a warning."""

_DOUBLE: Final = 1.0
"""Pieces of a border this close are parallel (a double line), unless one continues the other; m."""

_ONE_SIDED: Final = 0.5
"""Least share of the way between two borders along which left and right must be correct."""

_BORDER_LOOKS: Final = 9
"""Number of sample places along a lane and along a border."""

_SHARED: Final = 0.1
"""Least common part of a border of two neighbouring lanes, as a share of the shorter lane."""


def middle_between(lefts: Sequence[Floats], rights: Sequence[Floats]) -> Floats:
    """Return the centre line between the left and right borders of a lane.

    Parameters
    ----------
    lefts, rights : sequence of (k, 3) float64
        Pieces of the borders.

    Returns
    -------
    middle : (n, 3) float64
        Its direction has the left border on the left.

    Raises
    ------
    ValueError
        A border has no length or too many pieces, or the borders cross or are equal.
    """
    left, right = _chained(lefts, "left"), _chained(rights, "right")
    along = np.hypot(*(left[[0, -1]] - right[[0, -1]])[:, :2].T).sum()
    across = np.hypot(*(left[[0, -1]] - right[[-1, 0]])[:, :2].T).sum()
    right = right if along <= across else right[::-1]
    for end in (0, -1):
        left, right = _cut_back(left, right, end), _cut_back(right, left, end)
    shares = [run_of(line) / run_of(line)[-1] for line in (left, right)]
    at = np.unique(np.concatenate(shares))
    one, other = (
        np.column_stack([np.interp(at, share, column) for column in line.T])
        for share, line in zip(shares, (left, right), strict=True)
    )
    middle = (one + other) / 2
    step, aside = np.diff(middle[:, :2], axis=0), (one - other)[:, :2]
    aside = (aside[:-1] + aside[1:]) / 2
    area = step[:, 0] * aside[:, 1] - step[:, 1] * aside[:, 0]
    if not abs(area.sum()) > max(_ONE_SIDED * np.abs(area).sum(), APART * run_of(middle)[-1]):
        raise ValueError("its boundaries cross, or are one and the same")
    return thinned(middle if area.sum() > 0 else middle[::-1])


def _chained(pieces: Sequence[Floats], side: str) -> Floats:
    """Join the pieces of a lane border, from the longest piece on, each time with the nearest end."""
    left = [thin for piece in pieces if len(thin := thinned(piece)) > 1 and run_of(thin)[-1] > 0]
    if not left:
        raise ValueError(f"neither a centre line nor a boundary to its {side}")
    if len(left) > MAX_PIECES:
        raise ValueError(f"more than {MAX_PIECES} boundaries to its {side}")
    left.sort(key=lambda piece: -run_of(piece)[-1])
    chain, left = left[0], left[1:]
    ends = np.array([piece[[0, -1], :2] for piece in left]).reshape(-1, 2, 2)
    while left:
        # (piece, end of the piece, end of the chain)
        away = np.hypot(*np.moveaxis(ends[:, :, None] - chain[[0, -1], :2], -1, 0))
        number, own, at = (int(i) for i in np.unravel_index(np.argmin(away), away.shape))
        piece, ends = left.pop(number), np.delete(ends, number, axis=0)
        half = run_of(piece)[-1] / 2
        middle = np.array([[np.interp(half, run_of(piece), piece[:, i]) for i in (0, 1)]])
        found = feet(middle, [chain])
        if not found.is_end[0] and np.hypot(*(found.at - middle)[0]) <= _DOUBLE:
            continue
        if at == 1:
            chain = np.concatenate((chain, piece if own == 0 else piece[::-1]))
        else:
            chain = np.concatenate((piece if own == 1 else piece[::-1], chain))
    return thinned(chain)


def _cut_back(line: Floats, other: Floats, end: int) -> Floats:
    """Cut the part of a lane border that extends beyond the end of the other border."""
    run = run_of(line)
    found = feet(other[[end], :2], [line])
    along, apart = float(found.along[0]), float(np.hypot(*(found.at[0] - other[end, :2])))
    beyond = along if end == 0 else run[-1] - along
    if beyond <= max(apart, APART) or not 0 < along < run[-1]:
        return line
    cut = np.array([[np.interp(along, run, column) for column in line.T]])
    return (
        np.concatenate((cut, line[run > along]))
        if end == 0
        else np.concatenate((line[run < along], cut))
    )


def with_shared_borders(lines: Sequence[LaneLine]) -> list[LaneLine]:
    """Return lanes with more neighbours: lanes that share a border are neighbours.

    Two lanes share a border if they are on its two sides, along the same part of it.
    """
    users: dict[str, dict[tuple[int, int], Floats]] = defaultdict(dict)
    for row, line in enumerate(lines):
        if len(thinned(line.centre)) < 2:
            continue
        for side, borders in enumerate((line.lefts, line.rights)):
            for border in borders:
                if border.ident and len(border.line) > 1:
                    users[border.ident][row, side] = thinned(border.line)
    beside: dict[tuple[int, int], list[str]] = defaultdict(list)
    for shared in users.values():
        untold = [key for key in shared if not _told(lines, key)]
        if len(shared) < 2 or not untold or min(map(len, shared.values())) < 2:
            continue
        places = {key: _place(lines[key[0]].centre, border) for key, border in shared.items()}
        for key in untold:
            beside[key] += [
                lines[other[0]].ident
                for other in shared
                if other[0] != key[0] and _share(places[key], places[other])
            ]
    return [
        replace(
            line,
            left_beside=line.left_beside or tuple(dict.fromkeys(beside[row, 0])),
            right_beside=line.right_beside or tuple(dict.fromkeys(beside[row, 1])),
        )
        for row, line in enumerate(lines)
    ]


def _told(lines: Sequence[LaneLine], key: tuple[int, int]) -> bool:
    row, side = key
    return bool((lines[row].left_beside, lines[row].right_beside)[side])


def _place(centre: Floats, border: Floats) -> tuple[float, float, bool]:
    """Return start and end of a lane along a border, and True if the lane is on the left of the border."""
    centre, border = thinned(centre)[:, :2], border[:, :2]
    own, at = _looks(centre), run_of(border)[-1] * np.linspace(0.0, 1.0, _BORDER_LOOKS)
    onto, back = feet(own, [border]), feet(_looks(border), [centre])
    beside = np.concatenate((~onto.is_end, ~back.is_end))
    if not beside.any():
        return 0.0, 0.0, True
    along = np.concatenate((onto.along, at))[beside]
    aside = np.concatenate((own - onto.at, back.at - _looks(border)))[beside]
    piece = np.clip(np.searchsorted(run_of(border), along, "right") - 1, 0, len(border) - 2)
    way = np.diff(border, axis=0)[piece]
    left = float((way[:, 0] * aside[:, 1] - way[:, 1] * aside[:, 0]).sum()) > 0
    return float(along.min()), float(along.max()), left


def _looks(line: Floats) -> Floats:
    """Return sample positions (n, 2) at equal distances along a line."""
    run = run_of(line)
    at = run[-1] * np.linspace(0.0, 1.0, _BORDER_LOOKS)
    return np.column_stack([np.interp(at, run, column) for column in line[:, :2].T])


def _share(one: tuple[float, float, bool], other: tuple[float, float, bool]) -> bool:
    common = min(one[1], other[1]) - max(one[0], other[0])
    shorter = min(one[1] - one[0], other[1] - other[0])
    return one[2] != other[2] and common > max(_SHARED * shorter, APART)
