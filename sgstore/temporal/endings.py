"""What a formula would be if the trace ended at each of its frames, for all of them at once.

At a frame, a formula that looks ahead has a *course*: what it is if the trace ends there, and at which later
ends it becomes something else. Logic joins courses; an *until* whose sides can only become true is true from
one end on. At the frame that is asked for, the last *until* may have any course on its right, for only one
frame's answer is wanted: the ends are counted at which some frame shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.temporal.formulas import (
    TRUE,
    And,
    Formula,
    Next,
    Not,
    Or,
    Until,
    looks_ahead,
)
from sgstore.temporal.knowing import met

if TYPE_CHECKING:
    from sgstore.temporal.columns import Places, Table
    from sgstore.world import Bools


class TooDeep(Exception):  # noqa: N818 - no error: who asks goes another way
    """A formula has no courses that are worked out at once."""


@dataclass(frozen=True, slots=True)
class Course:
    """What a formula is at each frame for each end of the trace.

    Attributes
    ----------
    start : (F,) bool
        If the trace ends at that frame.
    switches : (K, F) int
        Ends from which on it is the contrary, ascending; F: there are no more.
    """

    start: Bools
    switches: Places

    def at(self, ends: Places) -> Bools:
        """(F,) what it is at each frame if the trace ends somewhere."""
        return self.start ^ (np.sum(self.switches <= ends, axis=0) % 2 == 1)

    @property
    def rising(self) -> Places:
        """(F,) the first end from which on it is true; F: none.

        Raises
        ------
        TooDeep
            It does not stay true.
        """
        frames = len(self.start)
        first = self.switches[0] if len(self.switches) else np.full(frames, frames)
        if np.any(self.switches[1:] < frames) or np.any(self.start & (first < frames)):
            raise TooDeep
        return np.where(self.start, np.arange(frames), first)


def prefix_values(formula: Formula, table: Table) -> Bools:
    """The value at the first frame if the trace ended at each frame: (F,).

    Raises
    ------
    TooDeep
        An operator looks at what others make of later frames, in a way that is not worked out at once.
    """
    return _Endings(table).values(formula, 0)


class _Endings:
    def __init__(self, table: Table) -> None:
        self._table = table
        self._frames = len(table.times)
        self._here = table.frames
        self._known: dict[Formula, Bools] = {}

    def _column(self, formula: Formula) -> Bools:
        """The values of what does not look ahead."""
        if formula not in self._known:
            self._known[formula] = self._table.whole(formula)
        return self._known[formula]

    def values(self, formula: Formula, at: int) -> Bools:  # noqa: PLR0911 - a case each
        """(F,) the value at one frame for each end from there on."""
        if not looks_ahead(formula):
            return np.full(self._frames, self._column(formula)[at])
        match formula:
            case Not(operand=operand):
                return ~self.values(operand, at)
            case And(operands=operands):
                return np.logical_and.reduce([self.values(operand, at) for operand in operands])
            case Or(operands=operands):
                return np.logical_or.reduce([self.values(operand, at) for operand in operands])
            case Next(operand=operand, weak=weak):
                if at + 1 == self._frames:
                    return np.full(self._frames, weak)
                return np.where(self._here <= at, weak, self.values(operand, at + 1))
            case Until(left=left) if not looks_ahead(left):
                return self._shown(formula, at)
            case _:
                course = self.course(formula)
                one = Course(course.start[at : at + 1], course.switches[:, at : at + 1])
                return one.at(self._here)

    def _shown(self, formula: Until, at: int) -> Bools:
        """An *until* at one frame: whether up to each end some frame shows its right side."""
        near, far = self._table.window(formula.bound, forward=True)
        first = at if near is None else int(near[at])
        last = self._frames - 1 if far is None else min(int(far[at]), self._frames - 1)
        if formula.left != TRUE:
            failed = np.flatnonzero(~self._column(formula.left)[at:])
            last = min(last, at + int(failed[0])) if len(failed) else last
        if first > last:
            return np.zeros(self._frames, np.bool_)
        course = self.course(formula.right)
        places = slice(first, last + 1)
        # One more is true, or one less, from an end on.
        change = np.zeros(self._frames + 1, np.int64)
        true = course.start[places]
        np.add.at(change, self._here[places][true], 1)
        for switch in course.switches:
            np.add.at(change, switch[places], np.where(true, -1, 1))
            true = ~true
        return np.cumsum(change[:-1]) > 0

    def course(self, formula: Formula) -> Course:
        """What a formula is at all frames for all ends.

        Raises
        ------
        TooDeep
            As :func:`prefix_values`.
        """
        if not looks_ahead(formula):
            return Course(self._column(formula), np.zeros((0, self._frames), self._here.dtype))
        match formula:
            case Not(operand=operand):
                course = self.course(operand)
                return Course(~course.start, course.switches)
            case And(operands=operands):
                return _joined([self.course(one) for one in operands], np.logical_and.reduce)
            case Or(operands=operands):
                return _joined([self.course(one) for one in operands], np.logical_or.reduce)
            case Next(operand=operand, weak=weak):
                return self._next(self.course(operand), weak=weak)
            case Until(left=left, right=right, bound=bound):
                sides = None if left == TRUE else self.course(left).rising
                true = met(self.course(right).rising, sides, bound, self._table)
                start = true == self._here
                return Course(start, np.where(start, self._frames, true)[None])
            case _:  # of the past, about the future
                raise TooDeep

    def _next(self, course: Course, *, weak: bool) -> Course:
        never = np.full((len(course.switches), 1), self._frames)
        later = np.concatenate((course.switches[:, 1:], never), axis=1)
        following = np.append(course.start[1:], weak)
        turns = np.where(following != weak, self._here + 1, self._frames)
        switches = np.sort(np.concatenate((turns[None], later)), axis=0)
        return Course(np.full(self._frames, weak), switches)


def _joined(courses: list[Course], join: Any) -> Course:
    """Courses joined by logic, without switches that change nothing."""
    frames = len(courses[0].start)
    start = join([course.start for course in courses])
    switches = np.sort(np.concatenate([course.switches for course in courses]), axis=0)
    before, kept = start, np.full_like(switches, frames)
    for number, ends in enumerate(switches):
        value = join([course.at(ends) for course in courses])
        there = (value != before) & (ends < frames)
        kept[number] = np.where(there, ends, frames)
        before = np.where(ends < frames, value, before)
    kept = np.sort(kept, axis=0)
    return Course(start, kept[: int(np.sum(kept < frames, axis=0).max(initial=0))])
