"""Truth values of temporal formulas on whole traces, and for each earlier end of the trace.

At a frame, a forward formula has a *course*: its value if the trace ends there, and the later ends at which the
value changes. Logic combines courses. An *until* with monotonic sides is true from one end on. At the requested
frame, the outermost *until* can have any course on its right side, because only one frame is needed: the code
counts the frames that fulfil it, for each end.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.temporal._decision_frames import Decided, known, met
from sgstore.temporal._formula import (
    TRUE,
    WHOLE,
    And,
    Formula,
    Next,
    Not,
    Or,
    Proposition,
    Until,
    looks_ahead,
    walk,
    with_operands,
)
from sgstore.temporal._progression import Progression, ProgressionFrame, Term, Tick
from sgstore.temporal._signals import PropositionTable, evaluate_rows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints
    from sgstore.temporal._signals import Places


class TooDeep(Exception):  # noqa: N818 - no error: who asks goes another way
    """Exception: a formula is nested too deeply for the fast evaluation, so a slower one must be used."""


@dataclass(frozen=True, slots=True)
class PrefixVerdicts:
    """Truth values of a formula at each frame, for each frame at which the trace could end.

    Attributes
    ----------
    start : (F,) bool
        Value if the trace ends at that frame.
    switches : (K, F) int
        Ends at which the value is negated, ascending; F: no more.
    """

    start: Bools
    switches: Places

    def at(self, ends: Places) -> Bools:
        """Return the formula's value at each frame. ``ends``: for each frame, where the trace ends."""
        return self.start ^ (np.sum(self.switches <= ends, axis=0) % 2 == 1)

    @property
    def rising(self) -> Places:
        """For each frame, return the end of the shortest trace that makes the formula true, or the frame count.

        Raises
        ------
        TooDeep
            The value does not stay true.
        """
        frames = len(self.start)
        first = self.switches[0] if len(self.switches) else np.full(frames, frames)
        if np.any(self.switches[1:] < frames) or np.any(self.start & (first < frames)):
            raise TooDeep
        return np.where(self.start, np.arange(frames), first)


def prefix_values(formula: Formula, table: PropositionTable) -> Bools:
    """Return the truth value of a formula at the first frame, for each frame at which the trace could end.

    Raises
    ------
    TooDeep
        The nesting of forward operators is too deep for columns.
    """
    return _at_first(formula, 0, table)


def _at_first(formula: Formula, at: int, table: PropositionTable) -> Bools:  # noqa: PLR0911
    """Return the truth value of a formula at one frame, for each frame at which the trace could end."""
    frames = len(table.times)
    if not looks_ahead(formula):
        return np.full(frames, table.whole(formula)[at])
    match formula:
        case Not(operand=operand):
            return ~_at_first(operand, at, table)
        case And(operands=operands):
            return np.logical_and.reduce([_at_first(one, at, table) for one in operands])
        case Or(operands=operands):
            return np.logical_or.reduce([_at_first(one, at, table) for one in operands])
        case Next(operand=operand, weak=weak):
            if at + 1 == frames:
                return np.full(frames, weak)
            return np.where(table.frames <= at, weak, _at_first(operand, at + 1, table))
        case Until(left=left) if not looks_ahead(left):
            return _shown(formula, at, table)
        case _:
            found = _course(formula, table)
            one = PrefixVerdicts(found.start[at : at + 1], found.switches[:, at : at + 1])
            return one.at(table.frames)


def _shown(formula: Until, at: int, table: PropositionTable) -> Bools:
    """For each frame at which the trace could end, return True if an *until* is fulfilled by then."""
    near, far = table.window(formula.bound, forward=True)
    frames = len(table.times)
    first = at if near is None else int(near[at])
    last = frames - 1 if far is None else min(int(far[at]), frames - 1)
    if formula.left != TRUE:
        failed = np.flatnonzero(~table.whole(formula.left)[at:])
        last = min(last, at + int(failed[0])) if len(failed) else last
    if first > last:
        return np.zeros(frames, np.bool_)
    found = _course(formula.right, table)
    places = slice(first, last + 1)
    # From this end on, one more frame is true, or one less.
    change = np.zeros(frames + 1, np.int64)
    true = found.start[places]
    np.add.at(change, table.frames[places][true], 1)
    for switch in found.switches:
        np.add.at(change, switch[places], np.where(true, -1, 1))
        true = ~true
    return np.cumsum(change[:-1]) > 0


def _course(formula: Formula, table: PropositionTable) -> PrefixVerdicts:
    """Return the truth values of a formula at all frames, for each frame at which the trace could end.

    Raises
    ------
    TooDeep
        See :func:`prefix_values`.
    """
    frames, here = len(table.times), table.frames
    if not looks_ahead(formula):
        return PrefixVerdicts(table.whole(formula), np.zeros((0, frames), here.dtype))
    match formula:
        case Not(operand=operand):
            found = _course(operand, table)
            return PrefixVerdicts(~found.start, found.switches)
        case And(operands=operands):
            return _joined([_course(one, table) for one in operands], np.logical_and.reduce)
        case Or(operands=operands):
            return _joined([_course(one, table) for one in operands], np.logical_or.reduce)
        case Next(operand=operand, weak=weak):
            found = _course(operand, table)
            never = np.full((len(found.switches), 1), frames)
            later = np.concatenate((found.switches[:, 1:], never), axis=1)
            turns = np.where(np.append(found.start[1:], weak) != weak, here + 1, frames)
            switches = np.sort(np.concatenate((turns[None], later)), axis=0)
            return PrefixVerdicts(np.full(frames, weak), switches)
        case Until(left=left, right=right, bound=bound):
            sides = None if left == TRUE else _course(left, table).rising
            true = met(_course(right, table).rising, sides, bound, table)
            start = true == here
            return PrefixVerdicts(start, np.where(start, frames, true)[None])
        case _:  # a past operator over a future one
            raise TooDeep


def _joined(courses: list[PrefixVerdicts], join: Any) -> PrefixVerdicts:
    """Combine the truth values of several formulas with a logical operator.

    There is a value for each frame and each last frame of the trace.
    """
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


# Offline verdicts of formulas: decision frames, violations and their durations
# A *violation* begins at the first frame after which no later frame can make the formula true (a trap of its
# automaton). It ends at the trace end or, with a *reset* formula, at the first later frame with a true reset.
# The evaluation restarts at the next frame. Past operators still see earlier frames.
#
# A formula that only the trace end can refute (``EVENTUALLY p``) is violated at the last frame.

STATUS: Final = ("false", "presumably_false", "presumably_true", "true")
"""Status words in the order of their codes. ``AND`` takes the minimum, ``OR`` the maximum of the codes."""

FALSE, PRESUMABLY_FALSE, PRESUMABLY_TRUE, CERTAINLY_TRUE = range(4)

Violation = tuple[int, int, bool]
"""First and last frame of a violation. The third value is True if only the end of the trace causes it."""


class Settled:
    """Evaluation of one temporal formula in one trace: truth values, violations and status.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
    times : (F,) int64
        Ascending; ns. F is at least 1.
    tolerance : int
        Tolerance added to the bounds of the formula; ns.
    """

    def __init__(
        self, formula: Formula, columns: Mapping[str, Bools], times: Ints, tolerance: int = 0
    ) -> None:
        self.formula, self._tolerance = formula, tolerance
        self._table = PropositionTable(columns, times)
        self._frames = len(times)

    @cached_property
    def value(self) -> Bools:
        """Mask of the frames in which the temporal formula is true."""
        return self._table.whole(self.formula)

    @cached_property
    def _known(self) -> Decided:
        return known(self.formula, self._table)

    def trap(self, start: int) -> int | None:
        """Return the frame at which the formula at ``start`` is decided as false; None if it never is."""
        trap = int(self._known[1][start])
        return trap if trap < self._frames else None

    @cached_property
    def _missed(self) -> Places:
        """For each frame, return where the formula that starts there becomes false. The trace has ended."""
        return known(self.formula, self._table, ended=self._tolerance)[1]

    def due(self, start: int, end: str) -> bool:
        """True if the formula at frame ``start`` stays undecided at the trace end, instead of false.

        Parameters
        ----------
        start : int
        end : str
            See :attr:`~sgstore.lang.ir.BoundCheck.end`.
        """
        if end == "pending":
            return True
        return end == "bounded" and int(self._missed[start]) >= self._frames

    def false_frames(self, end: str) -> Bools | None:
        """Return a mask of the frames in which the condition of an ``ALWAYS`` formula is false.

        ``None`` means another formula.

        Parameters
        ----------
        end : str
            See :attr:`~sgstore.lang.ir.BoundCheck.end`. A condition that is open at the trace end counts as
            false only if it counts as failed.
        """
        body = required_throughout(self.formula)
        if body is None:
            return None
        if end == "strong":
            return ~self._table.whole(body)
        ended = self._tolerance if end == "bounded" else None
        return known(body, self._table, ended=ended)[1] < self._frames

    def statuses(self) -> NDArray[np.int8]:
        """Return the status of the formula after each frame, as an index in :data:`STATUS`."""
        try:
            ended = prefix_values(self.formula, self._table)
        except TooDeep:
            ended = self._stepped()
        told = np.where(ended, PRESUMABLY_TRUE, PRESUMABLY_FALSE).astype(np.int8)
        told[self._known[0][0] :] = CERTAINLY_TRUE
        told[self._known[1][0] :] = FALSE
        return told

    def _stepped(self) -> Bools:
        """Return the truth value at the first frame, for each frame at which the trace could end, in order."""
        progression = Progression(self.formula)
        names, plain = progression.names, progression.untimed and not progression.past
        end = min(int(self._known[0][0]), int(self._known[1][0]), self._frames - 1) + 1
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
                    break  # no change while the letter is the same
        return ended

    def violations(self, reset: Bools | None, *, weak: bool = False) -> list[Violation]:
        """Return the violations of the formula as ranges of frames. Evaluation begins at the first frame.

        Parameters
        ----------
        reset : (F,) bool, optional
            Frames at which a violation ends. Evaluation restarts at the next frame.
        weak : bool
            True to ignore violations caused only by the trace end.
        """
        return self.judged(reset, "weak" if weak else "strong")[0]

    def judged(self, reset: Bools | None, end: str) -> tuple[list[Violation], bool]:
        """Return the violations of the formula as ranges of frames; True if it is undecided at the trace end.

        Parameters
        ----------
        reset : (F,) bool, optional
            See :meth:`violations`.
        end : str
            Meaning of the trace end; see :attr:`~sgstore.lang.ir.BoundCheck.end`.
        """
        frames = self._frames
        resets = np.flatnonzero(reset) if reset is not None else np.zeros(0, np.int64)
        found: list[Violation] = []
        start = 0
        while start < frames and not self.value[start]:
            trap = self.trap(start)
            if trap is None:
                due = self.due(start, end)
                found += [] if due or end == "weak" else [(frames - 1, frames - 1, True)]
                return found, due
            after = int(np.searchsorted(resets, trap))
            last = int(resets[after]) if after < len(resets) else frames - 1
            found.append((trap, last, False))
            start = last + 1
        return found, False


def violations_of_always(held: Bools, reset: Bools | None) -> list[Violation]:
    """Return the violations of ``ALWAYS p`` as ranges of frames. Each frame must decide p by itself.

    Parameters
    ----------
    held : (F,) bool
        Value of p at each frame.
    reset : (F,) bool, optional
        See :meth:`Settled.violations`.
    """
    broken = np.flatnonzero(~held)
    if reset is None:
        return [(int(broken[0]), len(held) - 1, False)] if len(broken) else []
    ends = np.append(np.flatnonzero(reset), len(held) - 1)
    ends = ends[np.searchsorted(ends[:-1], broken)]
    new = np.diff(ends, prepend=-1) != 0
    return [
        (first, last, False)
        for first, last in zip(broken[new].tolist(), ends[new].tolist(), strict=True)
    ]


def within_bounds(
    formula: Formula, columns: Mapping[str, Bools], times: Ints, gaps: Bools, rows: int
) -> tuple[Bools, Bools]:
    """Return the lowest and the highest value that a formula can have at the first frame.

    Unseen events in recording gaps may change the value.

    Each gap is treated as one additional frame with arbitrary propositions. For the lower value, they are the
    least favourable ones; for the upper value, the most favourable.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (B, F) bool, or (1, F)
    times : (F,) int64
        Ascending; ns. A gap is longer than a nanosecond.
    gaps : (F,) bool
        True if a gap ends at the frame.
    rows : int
        B.

    Returns
    -------
    least, most : (B,) bool
        If they differ, the value depends on the content of gaps.
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
    if isinstance(formula, Proposition):
        return Proposition(formula.name + ("+" if upper else "-"))
    inner = upper != isinstance(formula, Not)
    return with_operands(formula, lambda operand: _taken(operand, upper=inner))


def always_true(formula: Formula) -> Formula | None:
    """If a formula is ``ALWAYS p`` without time bound, return p; otherwise ``None``."""
    match formula:
        case Not(operand=Until(left=left, right=right, bound=bound)) if (
            left == TRUE and bound == WHOLE
        ):
            return right.operand if isinstance(right, Not) else Not(right)
        case _:
            return None


def required_throughout(formula: Formula) -> Formula | None:
    """Return the condition that a formula requires in every frame; ``None`` if it is not such a formula."""
    if not isinstance(formula, And):
        return always_true(formula)
    bodies = [one for one in map(required_throughout, formula.operands) if one is not None]
    return And(tuple(bodies)) if len(bodies) == len(formula.operands) else None


def bounded(formula: Formula) -> bool:
    """True if all future operators of a formula have an upper time bound."""
    return all(part.bound.high is not None for part in walk(formula) if isinstance(part, Until))
