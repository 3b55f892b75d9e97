"""Neighbours of lanes that share a border, for map formats that name borders but no neighbours."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from sgstore.maps.roads._cross_sections import APART, feet, run_of, thinned

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.maps.roads._lane_lines import LaneLine
    from sgstore.model.world import Floats

_SAMPLES: Final = 9
"""Number of places along a lane and along a border that are compared."""

_LEAST_COMMON: Final = 0.1
"""Smallest common part of a border for two neighbouring lanes, as a share of the shorter lane."""

_LaneSide: TypeAlias = "tuple[int, int]"
"""Row of a lane, and its side: 0 for left, 1 for right."""


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Part of a border that a lane uses: its start and end along the border (m), and the lane's side."""

    start: float
    end: float
    left_of_border: bool

    def is_opposite(self, other: _Stretch) -> bool:
        """Return True if two lanes lie on different sides of a common part of the border."""
        common = min(self.end, other.end) - max(self.start, other.start)
        shorter = min(self.end - self.start, other.end - other.start)
        across = self.left_of_border != other.left_of_border
        return across and common > max(_LEAST_COMMON * shorter, APART)


def with_shared_borders(lines: Sequence[LaneLine]) -> list[LaneLine]:
    """Make lanes that share a border neighbours of each other. Return the changed lanes.

    Two lanes share a border if they are on its two sides, along the same part of it. A side with a
    neighbour from the source stays unchanged.
    """
    neighbours: dict[_LaneSide, list[str]] = defaultdict(list)
    for border_of in _borders_by_name(lines).values():
        open_sides = [side for side in border_of if not _has_neighbour(lines, side)]
        if len(border_of) < 2 or not open_sides or min(map(len, border_of.values())) < 2:
            continue
        stretches = {
            side: _stretch(lines[side[0]].centre, border) for side, border in border_of.items()
        }
        for side in open_sides:
            neighbours[side] += [
                lines[other[0]].ident
                for other in border_of
                if other[0] != side[0] and stretches[side].is_opposite(stretches[other])
            ]
    return [
        replace(
            line,
            left_beside=line.left_beside or tuple(dict.fromkeys(neighbours[row, 0])),
            right_beside=line.right_beside or tuple(dict.fromkeys(neighbours[row, 1])),
        )
        for row, line in enumerate(lines)
    ]


def _borders_by_name(lines: Sequence[LaneLine]) -> dict[str, dict[_LaneSide, Floats]]:
    """Return the line of each named border for each lane that uses it: border → (lane, side) → line."""
    borders: dict[str, dict[_LaneSide, Floats]] = defaultdict(dict)
    for row, line in enumerate(lines):
        if len(thinned(line.centre)) < 2:
            continue
        for side, own in enumerate((line.lefts, line.rights)):
            for border in own:
                if border.ident and len(border.line) > 1:
                    borders[border.ident][row, side] = thinned(border.line)
    return borders


def _has_neighbour(lines: Sequence[LaneLine], lane_side: _LaneSide) -> bool:
    row, side = lane_side
    return bool((lines[row].left_beside, lines[row].right_beside)[side])


def _stretch(centre: Floats, border: Floats) -> _Stretch:
    """Return the part of a border that a lane uses. It has no length if the lane is beyond the border."""
    centre, border = thinned(centre)[:, :2], border[:, :2]
    on_lane, on_border = _sampled(centre), _sampled(border)
    onto, back = feet(on_lane, [border]), feet(on_border, [centre])
    beside = np.concatenate((~onto.is_end, ~back.is_end))
    if not beside.any():
        return _Stretch(0.0, 0.0, left_of_border=True)
    along = np.concatenate((onto.along, _stations(border)))[beside]
    to_lane = np.concatenate((on_lane - onto.at, back.at - on_border))[beside]
    piece = np.clip(np.searchsorted(run_of(border), along, "right") - 1, 0, len(border) - 2)
    step = np.diff(border, axis=0)[piece]
    area = float((step[:, 0] * to_lane[:, 1] - step[:, 1] * to_lane[:, 0]).sum())
    return _Stretch(float(along.min()), float(along.max()), left_of_border=area > 0)


def _stations(line: Floats) -> Floats:
    """Return lengths at equal distances along a line, from its start to its end; m."""
    return run_of(line)[-1] * np.linspace(0.0, 1.0, _SAMPLES)


def _sampled(line: Floats) -> Floats:
    """Return the positions (n, 2) of points at equal distances along a line."""
    run, stations = run_of(line), _stations(line)
    return np.column_stack([np.interp(stations, run, column) for column in line[:, :2].T])
