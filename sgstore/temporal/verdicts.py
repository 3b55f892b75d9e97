"""Verdicts of formulas over columns: what is known when, where a trace violates a formula, and for how long.

A *violation* begins at the first frame from which on nothing that may follow can make the formula true (a trap
of its automaton). It ends where the trace does or, with a formula for *reset*, at the first frame from there on
at which that is true; from the next frame on the formula is asked anew. Operators of the past see what was
before all the same.

What no frame can refute, only the end of the trace (``EVENTUALLY p``), is violated at its last frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.temporal.columns import evaluate, evaluate_rows
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
    """A formula with its columns in one trace, the past being worked in: what only looks back is a column.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
    times : (F,) int64
        Ascending; ns. F is at least 1.
    """

    def __init__(self, formula: Formula, columns: Mapping[str, Bools], times: Ints) -> None:
        self._columns = dict(columns)
        self._times = times
        self._given = columns
        self.formula = self._without_past(formula)
        self._values: dict[Formula, Bools] = {}

    def _without_past(self, formula: Formula) -> Formula:  # noqa: PLR0911 - a case each
        if isinstance(formula, Previous | Since) and not looks_ahead(formula):
            name = f":{len(self._columns)}"
            self._columns[name] = evaluate(formula, self._given, self._times)
            return Proposition(name)
        match formula:
            case Not(operand=operand):
                return Not(self._without_past(operand))
            case And(operands=operands):
                return And(tuple(map(self._without_past, operands)))
            case Or(operands=operands):
                return Or(tuple(map(self._without_past, operands)))
            case Next(operand=operand, weak=weak):
                return Next(self._without_past(operand), weak)
            case Until(left=left, right=right, bound=bound):
                return Until(self._without_past(left), self._without_past(right), bound)
            case _:
                return formula

    def value(self, formula: Formula | None = None) -> Bools:
        """Where a formula, the whole one by default, is true."""
        formula = formula or self.formula
        if formula not in self._values:
            self._values[formula] = evaluate(formula, self._columns, self._times)
        return self._values[formula]

    def trap(self, start: int, formula: Formula | None = None) -> int | None:
        """The frame at which it is certain that the formula is false at ``start``; ``None``: at none."""
        formula = formula or self.formula
        if self.value(formula)[start]:
            return None
        if isinstance(formula, And):
            found = [self.trap(start, operand) for operand in formula.operands]
            return min((frame for frame in found if frame is not None), default=None)
        body = always_true(formula)
        if body is None or not bounded(body):
            return self._certain(formula, start, len(self._times))
        return self._first_broken(body, start)

    def _first_broken(self, body: Formula, start: int) -> int | None:
        """Where it is first certain that something, which is to be true always, is false at some frame."""
        broken = start + np.flatnonzero(~self.value(body)[start:])
        if not looks_ahead(body):
            return int(broken[0]) if len(broken) else None
        if not len(broken):
            return None
        # One engine tells of all frames from the first that is broken on; the first that it calls false is it.
        first = int(broken[0])
        engine = Online(body)
        names = sorted(propositions(body))
        rows = zip(*(self._columns[name][first:].tolist() for name in names), strict=True)
        letters = rows if names else iter([()] * (len(self._times) - first))
        for number, letter in enumerate(letters, start=first):
            known = engine.step(dict(zip(names, letter, strict=True)), int(self._times[number]))
            if any(not value for _, value in known):
                return number
        return None

    def _certain(self, formula: Formula, start: int, end: int) -> int | None:
        """The first frame before ``end`` at which the value of a formula at ``start`` is certain."""
        for number, verdict, certain in self._steps(formula, start, end):
            if certain:
                return None if verdict else number
        return None

    def _steps(self, formula: Formula, start: int, end: int) -> list[tuple[int, bool, bool]]:
        """Frames at which something changes: the frame, the verdict if the trace ended there, certainty."""
        engine = Online(formula, every=False)
        names = sorted(propositions(formula))
        letters = np.array([self._columns[name][start:end] for name in names], np.bool_)
        letters = letters.reshape(len(names), end - start)
        changes = np.ones(end - start, np.bool_)
        if engine.plain:
            changes[1:] = np.any(letters[:, 1:] != letters[:, :-1], axis=0)
        found: list[tuple[int, bool, bool]] = []
        places = [*np.flatnonzero(changes).tolist(), end - start]
        for first, following in pairwise(places):
            letter = dict(zip(names, letters[:, first].tolist(), strict=True))
            before: object = None
            for number in range(first, following):
                engine.step(letter, int(self._times[start + number]))
                found.append((start + number, bool(engine.verdict), engine.certain))
                if engine.certain:
                    return found
                if engine.plain and engine.state is before:
                    break  # nothing changes as long as the letter stays the same
                before = engine.state
        return found

    def statuses(self) -> NDArray[np.int8]:
        """(F,) what is known, as each frame is read, of the formula at the first: places in :data:`STATUS`."""
        frames = len(self._times)
        body = always_true(self.formula)
        if body is not None and not looks_ahead(body):
            broken = np.logical_or.accumulate(~self.value(body))
            return np.where(broken, FALSE, PRESUMABLY_TRUE).astype(np.int8)
        told = np.zeros(frames, np.int8)
        steps = self._steps(self.formula, 0, frames)
        ends = [number for number, *_ in steps[1:]] + [frames]
        for (number, verdict, certain), end in zip(steps, ends, strict=True):
            code = CERTAINLY_TRUE if certain else PRESUMABLY_TRUE
            told[number:end] = code if verdict else FALSE if certain else PRESUMABLY_FALSE
        return told

    def violations(self, reset: Bools | None, *, weak: bool = False) -> list[Violation]:
        """Where the formula is violated, asked from the first frame on.

        Parameters
        ----------
        reset : (F,) bool, optional
            Where a violation ends, the formula being asked anew from the next frame on.
        weak : bool
            Whether what only the end of the trace refutes is forgiven.
        """
        frames = len(self._times)
        found: list[Violation] = []
        start = 0
        while start < frames:
            if self.value()[start]:
                break
            trap = self.trap(start)
            if trap is None:
                found += [] if weak else [Violation(frames - 1, frames - 1, at_end=True)]
                break
            if reset is None:
                found.append(Violation(trap, frames - 1))
                break
            after = np.argmax(reset[trap:]) if reset[trap:].any() else frames - 1 - trap
            found.append(Violation(trap, int(trap + after)))
            start = int(trap + after) + 1
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


def looks_ahead(formula: Formula) -> bool:
    """Whether a formula depends on later frames."""
    return any(isinstance(part, Next | Until) for part in walk(formula))


def bounded(formula: Formula) -> bool:
    """Whether a formula depends on later frames only up to some time."""
    return all(part.bound.high is not None for part in walk(formula) if isinstance(part, Until))
