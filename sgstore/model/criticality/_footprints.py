"""Footprints of many objects over time, and the frames in which two objects cover a common area.

Notes
-----
Frames in which an object stands still are one row, because only the first and last frames in an area
count. Bounding boxes of eight rows each form a tree. A pair of boxes is skipped if the boxes are apart, or
if both lie between rows that are already known to be in the area. The memory depends on the number of
rows, not on the number of pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.model.pair_numbers import COLUMNS, PairNumbers

if TYPE_CHECKING:
    from sgstore.model.world import Bools, Floats, Ints

_FAN: Final = 8
"""Number of rows in a bounding box, and of boxes in a larger box."""
_TOGETHER: Final = 1 << 13
"""Number of pairs of bounding boxes that are divided at once."""
FOOTPRINT: Final = [COLUMNS.index(name) for name in ("x", "y", "heading", "length", "width")]
"""Columns of a state that describe the footprint of an object."""
_MARGIN: Final = 1e-6
"""Enlargement of bounding boxes, to exceed rounding errors; m."""


@dataclass(frozen=True)
class _Level:
    """Level of a tree of bounding boxes: the sides of each box, its first row, and its first child box."""

    sides: Floats
    rows: Ints
    below: Ints


class Footprints:
    """Footprints of objects. A row is a frame in which an object's footprint has changed.

    Parameters
    ----------
    objects : (K,) int64
        Object of each state; the states of an object are consecutive.
    boxes : (5, K) float64
        ``x, y, heading, length, width`` of each state, in order of time; m, m, rad, m, m.

    Attributes
    ----------
    objects : (n,) int64
        The different objects, in the order of their states.
    begins : (n + 1,) int64
        First row of each object.
    states : (R,) int64
        First state of each row.
    boxes : (5, R) float64
    """

    def __init__(self, objects: Ints, boxes: Floats) -> None:
        starts = np.ones(len(objects), np.bool_)
        starts[1:] = objects[1:] != objects[:-1]
        rows = starts.copy()
        for one in boxes:
            rows[1:] |= one[1:] != one[:-1]  # True for NaN
        self.states: Ints = np.flatnonzero(rows)
        self.boxes: Floats = boxes[:, self.states]
        first = np.flatnonzero(starts[self.states])
        self.begins: Ints = np.append(first, len(self.states))
        self.objects: Ints = objects[self.states[first]]

    @cached_property
    def known(self) -> Bools:
        """Mask of the objects whose position and size are known in every frame, (n,)."""
        if not len(self.objects):
            return np.zeros(0, np.bool_)
        unknown = np.isnan(self.boxes).any(axis=0)
        return ~np.logical_or.reduceat(unknown, self.begins[:-1])

    @cached_property
    def reach(self) -> Floats:
        """Radius of the circle around each footprint, (R,); m."""
        return np.hypot(self.boxes[3], self.boxes[4]) / 2

    @cached_property
    def directions(self) -> tuple[Floats, Floats]:
        """Cosine and sine of the heading of each footprint, (R,)."""
        return np.cos(self.boxes[2]), np.sin(self.boxes[2])

    @cached_property
    def levels(self) -> list[_Level]:
        """Tree of bounding boxes, by level: first the footprints, last one box for each object."""
        x, y = self.boxes[0], self.boxes[1]
        wide = self.reach * (1 + 1e-9) + _MARGIN
        sides = np.stack([x - wide, y - wide, -x - wide, -y - wide])
        rows = np.arange(len(x) + 1)
        levels = [_Level(sides, rows, rows)]
        begins = self.begins
        while len(levels[-1].rows) > len(self.begins):
            count = -(-np.diff(begins) // _FAN)
            above = np.append(0, np.cumsum(count))
            of = np.repeat(np.arange(len(count)), count)
            first = begins[of] + (np.arange(above[-1]) - above[of]) * _FAN
            below = np.append(first, begins[-1])
            sides = np.minimum.reduceat(levels[-1].sides, first, axis=1)
            levels.append(_Level(sides, levels[-1].rows[below], below))
            begins = above
        return levels

    def crossed(self, a: Ints, b: Ints) -> Ints:
        """Return the state rows in which two objects enter and leave their common area, for many pairs, (P, 4).

        Parameters
        ----------
        a, b : (P,) int64
            Indices of the objects in ``objects``.

        Returns
        -------
        (P, 4) int64
            State in which a enters, first state after a has left, and the same of b. -1 means unknown or
            no common area: the first state of the object is in the area, or its last one.
        """
        search = AreaSearch(self, len(a))
        known = np.flatnonzero(self.known[a] & self.known[b])
        search.run(known, a[known], b[known])
        crossed = np.full((len(a), 4), -1)
        for one, objects in enumerate((a, b)):
            enters, leaves = search.first[one], search.last[one] + 1
            begins = np.flatnonzero((enters > self.begins[objects]) & (leaves > 0))
            ends = np.flatnonzero((leaves < self.begins[objects + 1]) & (leaves > 0))
            crossed[begins, 2 * one] = self.states[enters[begins]]
            crossed[ends, 2 * one + 1] = self.states[leaves[ends]]
        return crossed


class AreaSearch:
    """Search for many pairs of objects: the first and last footprints of both in their common area.

    Attributes
    ----------
    first, last : (2, P) int64
        Rows of the first and of the second object; the first is greater than the last without a common area.
    """

    def __init__(self, of: Footprints, pairs: int) -> None:
        self._of = of
        self._inner = np.minimum(of.boxes[3], of.boxes[4]) / 2
        self.first = np.full((2, pairs), len(of.states))
        self.last = np.full((2, pairs), -1)

    def run(self, pair: Ints, a: Ints, b: Ints) -> None:
        """Compare pairs of objects: first their largest bounding boxes, then smaller and smaller ones."""
        waiting = [(len(self._of.levels) - 1, pair, a, b)]
        while waiting:
            level, pair, a, b = waiting.pop()
            most = _TOGETHER if level else _TOGETHER * _FAN
            if len(pair) > most:
                waiting.append((level, pair[most:], a[most:], b[most:]))
                pair, a, b = pair[:most], a[:most], b[:most]
            if not level:
                self._rows(pair, a, b)
                continue
            pair, a, b = self._near(level, pair, a, b)
            if len(pair):
                below = self._of.levels[level].below
                waiting.append((level - 1, *_divided(below, pair, a, b)))

    def _near(self, level: int, pair: Ints, a: Ints, b: Ints) -> tuple[Ints, Ints, Ints]:
        """Return overlapping pairs of boxes in which the objects may meet earlier or later than known."""
        boxes = self._of.levels[level]
        on = self._boxes_overlap(level, a, b)
        pair, a, b = pair[on], a[on], b[on]
        middle_a, middle_b = ((boxes.rows[one] + boxes.rows[one + 1]) // 2 for one in (a, b))
        sure = self._apart(middle_a, middle_b) < self._sure(middle_a, middle_b)
        self._found(pair[sure], middle_a[sure], middle_b[sure])
        ends_a, ends_b = (boxes.rows[one + 1] - 1 for one in (a, b))
        new = self._new(pair, (boxes.rows[a], boxes.rows[b]), (ends_a, ends_b))
        return pair[new], a[new], b[new]

    def _boxes_overlap(self, level: int, a: Ints, b: Ints) -> Bools:
        low_x, low_y, high_x, high_y = self._of.levels[level].sides  # the high sides are negative
        on = (low_x[a] <= -high_x[b]) & (low_x[b] <= -high_x[a])
        on &= (low_y[a] <= -high_y[b]) & (low_y[b] <= -high_y[a])
        return on

    def _rows(self, pair: Ints, a: Ints, b: Ints) -> None:
        """Compare the footprints of pairs of rows. Update the first and last row found for each object pair."""
        sure = self._apart(a, b) < self._sure(a, b)
        self._found(pair[sure], a[sure], b[sure])
        near = np.flatnonzero(~sure & self._circles_overlap(a, b))
        near = near[self._new(pair[near], (a[near], b[near]), (a[near], b[near]))]
        on = near[self._overlap(a[near], b[near])]
        self._found(pair[on], a[on], b[on])

    def _circles_overlap(self, a: Ints, b: Ints) -> Bools:
        reach = self._of.reach
        found: Bools = self._apart(a, b) <= ((reach[a] + reach[b]) * (1 + 1e-9)) ** 2
        return found

    def _overlap(self, a: Ints, b: Ints) -> Bools:
        """Return a mask of the pairs of rows whose footprints touch or overlap, (K,)."""
        of, (cosine, sine) = self._of, self._of.directions
        states = np.zeros((2, len(COLUMNS), len(a)))
        for one, rows in zip(states, (a, b), strict=True):
            one[FOOTPRINT] = of.boxes[:, rows]
        numbers = PairNumbers(states[0].T, states[1].T)
        level = np.zeros(len(a))  # without heights, all pairs are on one level
        numbers.update(level=level, solid=level)
        numbers.update(ca=cosine[a], sa=sine[a], cb=cosine[b], sb=sine[b])
        beyond = np.maximum.reduce([numbers[f"out{axis}"] for axis in (1, 2, 3, 4)])
        found: Bools = beyond <= 0
        return found

    def _apart(self, a: Ints, b: Ints) -> Floats:
        """Return the squared distance between the centres of two footprints, for pairs of rows; m²."""
        x, y = self._of.boxes[0], self._of.boxes[1]
        away_x, away_y = x[a] - x[b], y[a] - y[b]
        return away_x * away_x + away_y * away_y

    def _sure(self, a: Ints, b: Ints) -> Floats:
        """Return the squared distance below which two footprints surely overlap, for pairs of rows; m²."""
        return ((self._inner[a] + self._inner[b]) * (1 - 1e-9)) ** 2

    def _new(self, pair: Ints, first: tuple[Ints, Ints], last: tuple[Ints, Ints]) -> Bools:
        """Return a mask of row ranges that may contain an earlier first meeting or a later last one."""
        new = np.zeros(len(pair), np.bool_)
        for one in (0, 1):
            new |= (first[one] < self.first[one, pair]) | (last[one] > self.last[one, pair])
        return new

    def _found(self, pair: Ints, a: Ints, b: Ints) -> None:
        for one, rows in enumerate((a, b)):
            np.minimum.at(self.first[one], pair, rows)
            np.maximum.at(self.last[one], pair, rows)


def _divided(below: Ints, pair: Ints, a: Ints, b: Ints) -> tuple[Ints, Ints, Ints]:
    """For each pair of bounding boxes, return all pairs of their child boxes."""
    count_a, count_b = below[a + 1] - below[a], below[b + 1] - below[b]
    count = count_a * count_b
    of = np.repeat(np.arange(len(pair)), count)
    place = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    part_a, part_b = np.divmod(place, count_b[of])
    return pair[of], below[a][of] + part_a, below[b][of] + part_b
