"""Verdicts of formulas over columns: what is known when, where a trace violates a formula, and for how long.

A *violation* begins at the first frame from which on nothing that may follow can make the formula true (a trap
of its automaton). It ends where the trace does or, with a formula for *reset*, at the first frame from there on
at which that is true; from the next frame on the formula is asked anew. Operators of the past see what was
before all the same.

What no frame can refute, only the end of the trace (``EVENTUALLY p``), is violated at its last frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.temporal.columns import Table, evaluate_rows
from sgstore.temporal.endings import TooDeep, prefix_values
from sgstore.temporal.formulas import (
    TRUE,
    WHOLE,
    And,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    Until,
    propositions,
    walk,
)
from sgstore.temporal.knowing import Known, known
from sgstore.temporal.online import Online

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.world import Bools, Ints

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
        self._table = Table(columns, times)
        self._frames = len(times)

    @cached_property
    def value(self) -> Bools:
        """(F,) where the formula is true."""
        return self._table.whole(self.formula)

    @cached_property
    def _known(self) -> Known:
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
        engine = Online(self.formula, every=False)
        names = sorted(propositions(self.formula))
        end = min(int(self._known.true[0]), int(self._known.false[0]), self._frames - 1) + 1
        letters = np.array([self._table.columns[name][:end] for name in names], np.bool_)
        letters = letters.reshape(len(names), end)
        changes = np.ones(end, np.bool_)
        if engine.plain:
            changes[1:] = np.any(letters[:, 1:] != letters[:, :-1], axis=0)
        ended = np.zeros(self._frames, np.bool_)
        for first, following in pairwise([*np.flatnonzero(changes).tolist(), end]):
            letter = dict(zip(names, letters[:, first].tolist(), strict=True))
            before: object = None
            for number in range(first, following):
                engine.step(letter, int(self._table.times[number]))
                ended[number:following] = engine.verdict
                if engine.plain and engine.state is before:
                    break  # nothing changes as long as the letter stays the same
                before = engine.state
        return ended

    def violations(self, reset: Bools | None, *, weak: bool = False) -> list[Violation]:
        """Where the formula is violated, asked from the first frame on.

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


def _taken(formula: Formula, *, upper: bool) -> Formula:  # noqa: PLR0911 - a case each
    """A formula whose propositions are those that make it true most easily, or least."""
    match formula:
        case Proposition(name=name):
            return Proposition(name + ("+" if upper else "-"))
        case Not(operand=operand):
            return Not(_taken(operand, upper=not upper))
        case And(operands=operands):
            return And(tuple(_taken(operand, upper=upper) for operand in operands))
        case Or(operands=operands):
            return Or(tuple(_taken(operand, upper=upper) for operand in operands))
        case Next(operand=operand, weak=weak):
            return Next(_taken(operand, upper=upper), weak)
        case Previous(operand=operand):
            return Previous(_taken(operand, upper=upper))
        case Until(left=left, right=right, bound=bound):
            return Until(_taken(left, upper=upper), _taken(right, upper=upper), bound)
        case Since(left=left, right=right, bound=bound):
            return Since(_taken(left, upper=upper), _taken(right, upper=upper), bound)
        case _:
            return formula


def always_true(formula: Formula) -> Formula | None:
    """What a formula says to be true from here to the end of the trace; ``None`` if it is not of that form."""
    match formula:
        case Not(operand=Until(left=left, right=right, bound=bound)) if (
            left == TRUE and bound == WHOLE
        ):
            return right.operand if isinstance(right, Not) else Not(right)
        case _:
            return None


def bounded(formula: Formula) -> bool:
    """Whether a formula depends on later frames only up to some time."""
    return all(part.bound.high is not None for part in walk(formula) if isinstance(part, Until))
