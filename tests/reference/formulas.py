"""Formulas over propositions from text, and two slow ways to evaluate them: what engines are tested against."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import QueryError
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.temporal import evaluate
from sgstore.temporal._formula import (
    LOGIC,
    TEMPORAL,
    WHOLE,
    Bound,
    Formula,
    Proposition,
    TruthConstant,
)
from sgstore.temporal._progression import Progression, ProgressionFrame, Term, Tick

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.errors import TextSpan
    from sgstore.model.world import Bools, Ints


def formula_of(text: str) -> Formula:
    """The formula that a text of the query language says; its variables are propositions.

    Parameters
    ----------
    text : str
        ``ALWAYS (braking IMPLIES EVENTUALLY[0s, 2s] stopped)``.

    Raises
    ------
    QueryError
        It is no formula, or has something else than propositions, logic and time.
    """
    prefix = "CHECK "
    try:
        (statement,) = parse(prefix + text)
    except QueryError as error:
        raise _shifted(error, text, len(prefix)) from None
    if not isinstance(statement, s.CheckClause):
        raise QueryError("expected a formula", text=text)
    try:
        return _formula(statement.formula)
    except _Refused as refused:
        span = refused.span
        at = type(span)(span.start - len(prefix), span.end - len(prefix))
        raise QueryError(refused.reason, text=text, span=at) from None


class _Refused(Exception):  # noqa: N818 - not an error of its own: it carries a place
    def __init__(self, reason: str, span: TextSpan) -> None:
        super().__init__(reason)
        self.reason = reason
        self.span = span


def _shifted(error: QueryError, text: str, by: int) -> QueryError:
    span = error.span
    moved = type(span)(max(span.start - by, 0), max(span.end - by, 0)) if span else None
    return type(error)(error.reason, text=text, span=moved, hint=error.hint)


def _formula(e: s.Expression) -> Formula:
    match e:
        case s.Variable(name=name):
            return Proposition(name)
        case s.Constant(value=bool() as value):
            return TruthConstant(value)
        case s.Logic(word=word, operands=operands):
            return LOGIC[word](*map(_formula, operands))
        case s.Temporal(word=word, operands=operands):
            return _temporal(word, tuple(map(_formula, operands)), e)
        case _:
            raise _Refused("expected propositions, logic and time only", e.span)


def _temporal(word: str, operands: tuple[Formula, ...], e: s.Temporal) -> Formula:
    if e.bound is not None and word in {"NEXT", "WEAKNEXT", "PREVIOUS"}:
        raise _Refused(f"{word} has no bound", e.span)
    return TEMPORAL[word](*operands, _bound(e))


def _bound(e: s.Temporal) -> Bound:
    if e.bound is None:
        return WHOLE
    low, high = e.bound
    if isinstance(low, s.Parameter) or isinstance(high, s.Parameter):
        raise _Refused("a formula over given propositions has no parameters", e.span)
    units = {end.unit == "frames" for end in (low, high) if end is not None and end.amount}
    if len(units) > 1:
        raise _Refused("a bound must be in time or in frames, not both", e.span)
    frames = units == {True}
    ends = [None if end is None else int(end.amount) if frames else end.ns for end in (low, high)]
    if ends[1] is not None and ends[1] < (ends[0] or 0):
        raise _Refused("the end of the bound is before its start", e.span)
    return Bound(ends[0] or 0, ends[1], frames)


def prefix_verdicts(formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Bools:
    """The value of a formula at the first frame, if the trace ended at each of its frames in turn.

    Parameters
    ----------
    formula, columns, times
        As in :func:`evaluate`.

    Returns
    -------
    (F,) bool
        The verdict over the frames 0 … f. Time grows with the square of F.
    """
    found = np.zeros(len(times), np.bool_)
    for end in range(len(times)):
        part = {name: column[: end + 1] for name, column in columns.items()}
        found[end] = evaluate(formula, part, times[: end + 1])[0]
    return found


REMEMBERED: Final = 100_000
"""Steps of a formula without bounds and past that are remembered: (combination, letter) → what follows."""


class OnlineFormula:
    """A formula that is told one frame after the other.

    Parameters
    ----------
    formula : Formula
    every : bool
        Whether the value at every frame is to be told, or the verdict only, which is cheaper.
    tolerance : int
        Times that differ by no more are the same; ns.

    Attributes
    ----------
    verdict : bool or None
        The value at the first frame if the trace ended now; ``None`` before the first frame.
    certain : bool
        Whether that is the value whatever comes.
    """

    def __init__(self, formula: Formula, *, every: bool = True, tolerance: int = 0) -> None:
        self._progression = Progression(formula)
        self._formula = self._progression.formula
        self._every, self._tolerance = every, tolerance
        self.terms = self._progression.terms
        self._names = self._progression.names
        self._past = self._progression.begun
        self._plain = not self._past and self._progression.untimed
        self._steps: dict[tuple[Any, ...], Term] = {}
        self._open: dict[Term, list[int]] = {}
        self._first: Term | None = None
        self.number = -1
        self.time = 0
        self.verdict: bool | None = None

    @property
    def certain(self) -> bool:
        """Tell whether no further frame can change the verdict, as far as logic without search can tell."""
        return self._first is self.terms.true or self._first is self.terms.false

    def step(self, letter: Mapping[str, bool], time_ns: int) -> list[tuple[int, bool]]:
        """Tell the next frame.

        Parameters
        ----------
        letter : mapping of str to bool
            The propositions.
        time_ns : int
            Later than the frame before.

        Returns
        -------
        list of (int, bool)
            Frames whose value is known from now on, in order, and these values.

        Raises
        ------
        ValueError
            A proposition is missing, or time does not ascend.
        """
        if self.number >= 0 and time_ns <= self.time:
            raise ValueError("the times of the frames must ascend")
        missing = [name for name in self._names if name not in letter]
        if missing:
            raise ValueError(f"no value for the proposition {missing[0]!r}")
        self.number += 1
        self.time = time_ns
        tick = Tick(time_ns, self.number, self._tolerance)
        frame = ProgressionFrame(self._progression, self._past, letter, tick)
        if not self._every and self._first is not None:
            self._first = self._moved(self._first, letter, frame)
            self._past = frame.past()
            self.verdict = self._first.ended
            return []
        here = (
            frame.now(self._formula) if not self._plain else self._remembered(None, letter, frame)
        )
        moved: dict[Term, list[int]] = {}
        for term, numbers in self._open.items():
            moved.setdefault(self._moved(term, letter, frame), []).extend(numbers)
        moved.setdefault(here, []).append(self.number)
        self._first = here if self._first is None else self._moved(self._first, letter, frame)
        self._past = frame.past()
        self.verdict = self._first.ended
        known: list[tuple[int, bool]] = []
        for value, term in ((True, self.terms.true), (False, self.terms.false)):
            known += [(number, value) for number in moved.pop(term, ())]
        self._open = moved
        return sorted(known)

    @property
    def state(self) -> object:
        """The state on which the verdict still depends.

        If a step of a formula that is :attr:`plain` leaves it the same, it stays so while the propositions do.
        """
        return self._first

    @property
    def plain(self) -> bool:
        """Tell whether a step depends on the propositions alone: no bounds, and nothing of the past."""
        return self._plain

    def finish(self) -> list[tuple[int, bool]]:
        """End the trace: the frames whose value was not known yet, in order, and these values."""
        known = [(n, term.ended) for term, numbers in self._open.items() for n in numbers]
        self._open = {}
        return sorted(known)

    def _moved(self, term: Term, letter: Mapping[str, bool], frame: ProgressionFrame) -> Term:
        return self._remembered(term, letter, frame) if self._plain else frame.resolved(term)

    def _remembered(
        self, term: Term | None, letter: Mapping[str, bool], frame: ProgressionFrame
    ) -> Term:
        key = (term, *(letter[name] for name in self._names))
        found = self._steps.get(key)
        if found is None:
            found = frame.now(self._formula) if term is None else frame.resolved(term)
            if len(self._steps) < REMEMBERED:
                self._steps[key] = found
        return found
