"""Conflicts between lanes in junctions: lanes that cross or merge."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.base.tables import spread
from sgstore.errors import MapError
from sgstore.maps.roads._map import STOREY
from sgstore.maps.roads._ribbons import Ribbons, centre_lines, wrapped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Bools, Floats, Ints


SAME_PLACE: Final = 0.5
"""Largest distance between two lane ends with about the same direction that count as one place; m."""

MOST_PAIRS: Final = 2_000_000
"""Largest number of pairs of lanes that are compared. A junction of 200 lanes has 20,000."""


def conflicts(
    ribbons: Ribbons, lanes: Ints, junction: Sequence[str], flow: tuple[Ints, Ints]
) -> tuple[Ints, Ints]:
    """Return the pairs of lanes in the same junction that cross or merge.

    Lanes cross if the interiors of their centre lines meet. They merge if both flow into one lane
    or end in one place. Lanes that start in one place do not conflict, however long they overlap.
    Lanes on different storeys do not conflict either.

    Parameters
    ----------
    ribbons : Ribbons
    lanes : (n,) int64
        Lanes of traffic in junctions.
    junction : sequence of str
        The junction of every lane of the map.
    flow : (m,) int64 twice
        Pairs of lanes (from, to) of the traffic flow.

    Raises
    ------
    MapError
        The lanes make more than :data:`MOST_PAIRS` pairs.
    """
    one, other = _pairs(lanes, junction)
    lines = centre_lines(ribbons)
    merge = _share(flow[0], flow[1], one, other) | _together(ribbons, one, other, at_end=True)
    part = _share(flow[1], flow[0], one, other) | _together(ribbons, one, other, at_end=False)
    cross: Any = shapely.crosses(lines[one], lines[other])
    rows = np.flatnonzero(merge | (cross & ~part))
    one, other = one[rows], other[rows]
    level = np.abs(_heights(ribbons, lines, one, other)) <= STOREY
    return one[level], other[level]


def _pairs(lanes: Ints, junction: Sequence[str]) -> tuple[Ints, Ints]:
    """Return all pairs of lanes in the same junction. Each pair occurs once."""
    names = {name: number for number, name in enumerate(dict.fromkeys(junction))}
    group = np.array([names[name] for name in junction], np.int64)[lanes]
    order = np.lexsort((lanes, group))
    lanes, group = lanes[order], group[order]
    later = np.searchsorted(group, group, side="right") - np.arange(len(group)) - 1
    if later.sum() > MOST_PAIRS:
        reason = f"{later.sum():,} pairs of lanes in junctions; there may be {MOST_PAIRS:,}"
        raise MapError(reason, element="junction")
    first, second = spread(np.arange(len(lanes)) + 1, later)
    return lanes[first], lanes[second]


def _share(src: Ints, dst: Ints, one: Ints, other: Ints) -> Bools:
    """Return a mask of the pairs of lanes that have a successor in common."""
    after: dict[int, set[int]] = {}
    for lane, onward in zip(src.tolist(), dst.tolist(), strict=True):
        after.setdefault(lane, set()).add(onward)
    nothing: set[int] = set()
    return np.array(
        [
            not after.get(a, nothing).isdisjoint(after.get(b, nothing))
            for a, b in zip(one.tolist(), other.tolist(), strict=True)
        ],
        np.bool_,
    )


def _together(ribbons: Ribbons, one: Ints, other: Ints, *, at_end: bool) -> Bools:
    place = ribbons.offsets[1:] - 1 if at_end else ribbons.offsets[:-1]
    a, b = place[one], place[other]
    x, y = ribbons.left_x + ribbons.right_x, ribbons.left_y + ribbons.right_y
    distance = np.hypot(x[a] - x[b], y[a] - y[b]) / 2
    turn = np.abs(wrapped(ribbons.heading[a] - ribbons.heading[b]))
    return (distance < SAME_PLACE) & (turn < np.pi / 4)


def _heights(ribbons: Ribbons, lines: Any, one: Ints, other: Ints) -> Floats:
    """Return the height difference of each pair of lanes, where the two are closest; m."""
    shortest: Any = shapely.shortest_line(lines[one], lines[other])
    heights: list[Floats] = []
    for lanes, end in ((one, 0), (other, -1)):
        point = shapely.get_point(shortest, end)
        along: Any = shapely.line_locate_point(lines[lanes], point)
        heights.append(ribbons.at(lanes, along).z)
    return heights[0] - heights[1]
