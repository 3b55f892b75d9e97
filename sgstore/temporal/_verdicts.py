"""Verdicts: values of formulas, when they are decided, and at every prefix.

At a frame, a formula that looks ahead has a *course*: what it is if the trace ends there, and at which later
ends it becomes something else. Logic joins courses; an *until* whose sides can only become true is true from
one end on. At the frame that is asked for, the last *until* may have any course on its right, for only one
frame's answer is wanted: the ends are counted at which some frame shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.temporal._formula import (
    TRUE,
    WHOLE,
    And,
    Bound,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Progression,
    ProgressionFrame,
    Proposition,
    Since,
    Term,
    Tick,
    TruthConstant,
    Until,
    looks_ahead,
    walk,
    with_operands,
)
from sgstore.temporal._signals import PropositionTable, evaluate_rows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.temporal._signals import Places
    from sgstore.world import Bools, Ints


class TooDeep(Exception):  # noqa: N818 - no error: who asks goes another way
    """A formula has no courses that are worked out at once."""


@dataclass(frozen=True, slots=True)
class PrefixVerdicts:
    """Values of a formula at each frame for each end of the trace.

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


def prefix_values(formula: Formula, table: PropositionTable) -> Bools:
    """The value at the first frame if the trace ended at each frame: (F,).

    Raises
    ------
    TooDeep
        An operator looks at what others make of later frames, in a way that is not worked out at once.
    """
    return _Endings(table).values(formula, 0)


class _Endings:
    def __init__(self, table: PropositionTable) -> None:
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
                one = PrefixVerdicts(course.start[at : at + 1], course.switches[:, at : at + 1])
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

    def course(self, formula: Formula) -> PrefixVerdicts:
        """Return the values of a formula at all frames for all ends.

        Raises
        ------
        TooDeep
            As :func:`prefix_values`.
        """
        if not looks_ahead(formula):
            return PrefixVerdicts(
                self._column(formula), np.zeros((0, self._frames), self._here.dtype)
            )
        match formula:
            case Not(operand=operand):
                course = self.course(operand)
                return PrefixVerdicts(~course.start, course.switches)
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
                return PrefixVerdicts(start, np.where(start, self._frames, true)[None])
            case _:  # of the past, about the future
                raise TooDeep

    def _next(self, course: PrefixVerdicts, *, weak: bool) -> PrefixVerdicts:
        never = np.full((len(course.switches), 1), self._frames)
        later = np.concatenate((course.switches[:, 1:], never), axis=1)
        following = np.append(course.start[1:], weak)
        turns = np.where(following != weak, self._here + 1, self._frames)
        switches = np.sort(np.concatenate((turns[None], later)), axis=0)
        return PrefixVerdicts(np.full(self._frames, weak), switches)


def _joined(courses: list[PrefixVerdicts], join: Any) -> PrefixVerdicts:
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
    return PrefixVerdicts(start, kept[: int(np.sum(kept < frames, axis=0).max(initial=0))])


# When the value of a formula is certain: the first frame that shows it, whatever may follow -----
# For each frame of a trace two numbers: from which frame on it is known that a formula is true there, and from
# which on that it is false; the number of frames, if the trace ends before that is known. They are made of
# those of the parts, as logic without search tells: a conjunction is false once one of its parts is known to
# be, and true once all are. It is what :mod:`sgstore.temporal._formula` knows frame by frame, for all
# frames at once.
#
# An *until* asks at each frame of its bound the same, so what is known of it is a chain of the least and the
# greatest of numbers; chains of 2, 4, 8, … frames are put together for all frames, in O(n log n).


@dataclass(frozen=True, slots=True)
class DecidedFrom:
    """From which frame on something is known of each frame, (F,); F: never.

    Attributes
    ----------
    true, false : (F,) int32 or int64
        That it is true, that it is false.
    """

    true: Places
    false: Places


def known(formula: Formula, table: PropositionTable) -> DecidedFrom:
    """Return the frame at which the value of a formula at each frame is certain.

    Parameters
    ----------
    formula : Formula
    table : PropositionTable
        The trace.
    """
    return _Knowing(table).of(formula)


class _Knowing:
    def __init__(self, table: PropositionTable) -> None:
        self._table = table
        self._frames = len(table.times)
        self._here = table.frames
        self._found: dict[Formula, DecidedFrom] = {}

    def of(self, formula: Formula) -> DecidedFrom:
        if formula not in self._found:
            self._found[formula] = self._of(formula)
        return self._found[formula]

    def _of(self, formula: Formula) -> DecidedFrom:  # noqa: PLR0911 - a case each
        match formula:
            case TruthConstant(value=value):
                return self._now(np.full(self._frames, value))
            case Proposition(name=name):
                return self._now(self._table.columns[name])
            case Not(operand=operand):
                told = self.of(operand)
                return DecidedFrom(told.false, told.true)
            case And(operands=operands):
                parts = [self.of(operand) for operand in operands]
                true = np.maximum.reduce([part.true for part in parts])
                return DecidedFrom(true, np.minimum.reduce([part.false for part in parts]))
            case Or(operands=operands):
                parts = [self.of(operand) for operand in operands]
                true = np.minimum.reduce([part.true for part in parts])
                return DecidedFrom(true, np.maximum.reduce([part.false for part in parts]))
            case Next(operand=operand):
                told = self.of(operand)
                never = np.full_like(self._here[:1], self._frames)
                return DecidedFrom(
                    *(np.append(part[1:], never) for part in (told.true, told.false))
                )
            case Previous(operand=operand):
                told = self.of(operand)
                true = np.append(np.full_like(self._here[:1], self._frames), told.true[:-1])
                false = np.append(self._here[:1], told.false[:-1])
                return DecidedFrom(np.maximum(true, self._here), np.maximum(false, self._here))
            case Until():
                return self._until(formula)
            case Since():
                return self._since(formula)

    def _now(self, flags: Bools) -> DecidedFrom:
        """Return the values that are decided at the frame itself."""
        never = self._here.dtype.type(self._frames)
        return DecidedFrom(np.where(flags, self._here, never), np.where(flags, never, self._here))

    def _until(self, formula: Until) -> DecidedFrom:
        left = None if formula.left == TRUE else self.of(formula.left)
        right = self.of(formula.right)
        true = met(right.true, left and left.true, formula.bound, self._table)
        start, end = _asked(formula.bound, self._table)
        # What is behind the bound is known to be nothing when a frame comes that is behind it.
        closed = np.full_like(self._here, self._frames) if end is None else end
        false = _chained(right.false, left and left.false, start, end, closed, least=False)
        if left is not None and formula.bound.low:
            false = np.minimum(false, -_most(-left.false, self._here, start))
        return DecidedFrom(true, false)

    def _since(self, formula: Since) -> DecidedFrom:
        """The same backwards; at the first frame everything before is known."""
        frames, here = self._frames, self._here
        last = frames - 1
        left = None if formula.left == TRUE else self._turned(self.of(formula.left))
        right = self._turned(self.of(formula.right))
        near, far = self._table.window(formula.bound, forward=False)
        start = here if near is None else last - np.maximum(near, -1)[::-1]
        end = None if far is None else frames - np.maximum(far, 0)[::-1]
        before, never = np.full_like(here, -1), np.full_like(here, frames)
        true = _chained(right.true, left and left.true, start, end, never, least=True)
        false = _chained(right.false, left and left.false, start, end, before, least=False)
        if left is not None and near is not None:
            true = np.maximum(true, _most(left.true, here, start))
            false = np.minimum(false, -_most(-left.false, here, start))
        return DecidedFrom(np.maximum(true[::-1], here), np.maximum(false[::-1], here))

    def _turned(self, told: DecidedFrom) -> DecidedFrom:
        return DecidedFrom(told.true[::-1], told.false[::-1])


def met(right: Places, left: Places | None, bound: Bound, table: PropositionTable) -> Places:
    """From when on an *until* is known to be true at each frame, if nothing that is true becomes false.

    Parameters
    ----------
    right, left : (F,) int
        From when on its sides are; F: never. Without ``left``, that is true always.
    bound : Bound
    table : PropositionTable
    """
    here = table.frames
    start, end = _asked(bound, table)
    never = np.full_like(here, len(here))
    true = _chained(right, left, start, end, never, least=True)
    return true if left is None or not bound.low else np.maximum(true, _most(left, here, start))


def _asked(bound: Bound, table: PropositionTable) -> tuple[Places, Places | None]:
    """The first frame that an *until* asks its right side of, and that behind the last one, if there is one."""
    here, frames = table.frames, len(table.times)
    near, far = table.window(bound, forward=True)
    start = here if near is None else np.minimum(near, frames)
    return start, None if far is None else np.minimum(far + 1, frames)


def _chained(
    right: Places,
    left: Places | None,
    start: Places,
    end: Places | None,
    last: Places,
    *,
    least: bool,
) -> Places:
    """The chain max(right, min(left, …)) over places from ``start`` to before ``end``, ``last`` behind them.

    Parameters
    ----------
    right, left, last : (F,) int
        Without ``left`` only the greatest.
    start, end : (F,) int
        Without ``end`` up to the last place.
    least : bool
        Whether least and greatest change places.
    """
    if least:
        other = None if left is None else -left
        return -_chained(-right, other, start, end, -last, least=False)
    if left is None:
        return np.maximum(_most(right, start, end), last)
    if end is None:
        end = np.full_like(start, len(right))
    low, high = right.copy(), np.maximum(right, left)
    found_low = np.full_like(right, np.iinfo(right.dtype).min)
    found_high = np.full_like(right, np.iinfo(right.dtype).max)
    at, length, size = start.copy(), np.maximum(end - start, 0), 1
    longest = int(length.max(initial=0))
    while size <= longest:
        takes = np.flatnonzero(length & size)
        places = at[takes]
        a, b = found_low[takes], found_high[takes]
        found_low[takes] = np.maximum(a, np.minimum(b, low[places]))
        found_high[takes] = np.maximum(a, np.minimum(b, high[places]))
        at[takes] += size
        # Of the last places, behind which there is nothing, no longer chain is asked for.
        joined = np.minimum(high[:-size], low[size:]), np.minimum(high[:-size], high[size:])
        low[:-size], high[:-size] = (np.maximum(low[:-size], one) for one in joined)
        size *= 2
    return np.maximum(found_low, np.minimum(found_high, last))


def _most(values: Places, start: Places, end: Places | None) -> Places:
    """The greatest value from ``start`` to before ``end``; the least number there is, where that is nothing."""
    nothing = np.iinfo(values.dtype).min
    if end is None:
        onward = np.append(np.maximum.accumulate(values[::-1])[::-1], nothing)
        return onward.astype(values.dtype)[start]
    length = np.maximum(end - start, 0)
    most, size, longest = values.copy(), 1, int(length.max(initial=0))
    found = np.full(len(start), nothing, values.dtype)
    # The greatest of so many places is that of two stretches that may overlap.
    while size <= longest:
        takes = np.flatnonzero((length >= size) & (length < 2 * size))
        first, second = start[takes], end[takes] - size
        found[takes] = np.maximum(most[first], most[second])
        most[:-size] = np.maximum(most[:-size], most[size:])
        size *= 2
    return found


# Verdicts of formulas over columns: what is known when, where a trace violates a formula, and for how long
# ------------------------------------------------------------------------------------------------
# A *violation* begins at the first frame from which on nothing that may follow can make the formula true (a
# trap of its automaton). It ends where the trace does or, with a formula for *reset*, at the first frame from
# there on at which that is true; from the next frame on the formula is asked anew. Operators of the past see
# what was before all the same.
#
# What no frame can refute, only the end of the trace (``EVENTUALLY p``), is violated at its last frame.

STATUS: Final = ("false", "presumably_false", "presumably_true", "true")
"""What is known at a frame, in order: the smaller of two holds for both, the greater for either."""

FALSE, PRESUMABLY_FALSE, PRESUMABLY_TRUE, CERTAINLY_TRUE = range(4)


@dataclass(frozen=True, slots=True)
class Violation:
    """Frames in which a formula is violated.

    Attributes
    ----------
    start, end : int
        First and last.
    at_end : bool
        Whether only the end of the trace made it one.
    """

    start: int
    end: int
    at_end: bool = False


class Settled:
    """A formula with its columns in one trace.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
    times : (F,) int64
        Ascending; ns. F is at least 1.
    """

    def __init__(self, formula: Formula, columns: Mapping[str, Bools], times: Ints) -> None:
        self.formula = formula
        self._table = PropositionTable(columns, times)
        self._frames = len(times)

    @cached_property
    def value(self) -> Bools:
        """(F,) where the formula is true."""
        return self._table.whole(self.formula)

    @cached_property
    def _known(self) -> DecidedFrom:
        return known(self.formula, self._table)

    def trap(self, start: int) -> int | None:
        """The frame at which it is certain that the formula is false at ``start``; ``None``: at none."""
        trap = int(self._known.false[start])
        return trap if trap < self._frames else None

    def statuses(self) -> NDArray[np.int8]:
        """(F,) what is known, as each frame is read, of the formula at the first: places in :data:`STATUS`."""
        try:
            ended = prefix_values(self.formula, self._table)
        except TooDeep:
            ended = self._stepped()
        told = np.where(ended, PRESUMABLY_TRUE, PRESUMABLY_FALSE).astype(np.int8)
        told[self._known.true[0] :] = CERTAINLY_TRUE
        told[self._known.false[0] :] = FALSE
        return told

    def _stepped(self) -> Bools:
        """The value at the first frame if the trace ended at each frame, one after the other."""
        progression = Progression(self.formula)
        names, plain = progression.names, progression.untimed and not progression.past
        end = min(int(self._known.true[0]), int(self._known.false[0]), self._frames - 1) + 1
        letters = np.array([self._table.columns[name][:end] for name in names], np.bool_)
        letters = letters.reshape(len(names), end)
        changes = np.ones(end, np.bool_)
        if plain:
            changes[1:] = np.any(letters[:, 1:] != letters[:, :-1], axis=0)
        ended = np.zeros(self._frames, np.bool_)
        term: Term | None = None
        past = progression.begun
        for first, following in pairwise([*np.flatnonzero(changes).tolist(), end]):
            letter = dict(zip(names, letters[:, first].tolist(), strict=True))
            for number in range(first, following):
                tick, before = Tick(int(self._table.times[number]), number), term
                frame = ProgressionFrame(progression, past, letter, tick)
                now = progression.formula
                term = frame.now(now) if term is None else frame.resolved(term)
                past = frame.past()
                ended[number:following] = term.ended
                if plain and term is before:
                    break  # nothing changes as long as the letter stays the same
        return ended

    def violations(self, reset: Bools | None, *, weak: bool = False) -> list[Violation]:
        """Return the violations of the formula, asked from the first frame on.

        Parameters
        ----------
        reset : (F,) bool, optional
            Where a violation ends, the formula being asked anew from the next frame on.
        weak : bool
            Whether what only the end of the trace refutes is forgiven.
        """
        frames = self._frames
        resets = np.flatnonzero(reset) if reset is not None else np.zeros(0, np.int64)
        found: list[Violation] = []
        start = 0
        while start < frames and not self.value[start]:
            trap = self.trap(start)
            if trap is None:
                found += [] if weak else [Violation(frames - 1, frames - 1, at_end=True)]
                break
            after = int(np.searchsorted(resets, trap))
            end = int(resets[after]) if after < len(resets) else frames - 1
            found.append(Violation(trap, end))
            start = end + 1
        return found


def within_bounds(
    formula: Formula, columns: Mapping[str, Bools], times: Ints, gaps: Bools, rows: int
) -> tuple[Bools, Bools]:
    """The value of a formula at the first frame, at least and at most, if nothing is known of gaps.

    In each gap one frame more is thought, of which every proposition may be true or false. What the formula
    asks to be true is taken to be false for the one, and true for the other.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (B, F) bool, or (1, F)
    times : (F,) int64
        Ascending; ns. A gap is longer than a nanosecond.
    gaps : (F,) bool
        Whether a gap ends at a frame.
    rows : int
        B.

    Returns
    -------
    least, most : (B,) bool
        Where they differ, the value depends on what is not known.
    """
    at = np.flatnonzero(gaps)
    between = times[at - 1] + (times[at] - times[at - 1]) // 2
    longer = np.insert(times, at, between)
    both = {
        name + suffix: np.insert(column, at, value, axis=1)
        for name, column in columns.items()
        for suffix, value in (("+", True), ("-", False))
    }
    least, most = (
        evaluate_rows(_taken(formula, upper=upper), both, longer, rows)[:, 0]
        for upper in (False, True)
    )
    return least, most


def _taken(formula: Formula, *, upper: bool) -> Formula:
    """A formula whose propositions are those that make it true most easily, or least."""
    if isinstance(formula, Proposition):
        return Proposition(formula.name + ("+" if upper else "-"))
    inner = upper != isinstance(formula, Not)
    return with_operands(formula, lambda operand: _taken(operand, upper=inner))


def always_true(formula: Formula) -> Formula | None:
    """Return the operand of an ``ALWAYS`` to the end of the trace; ``None`` if a formula has another form."""
    match formula:
        case Not(operand=Until(left=left, right=right, bound=bound)) if (
            left == TRUE and bound == WHOLE
        ):
            return right.operand if isinstance(right, Not) else Not(right)
        case _:
            return None


def bounded(formula: Formula) -> bool:
    """Tell whether a formula depends on later frames only up to some time."""
    return all(part.bound.high is not None for part in walk(formula) if isinstance(part, Until))
