"""Robustness of a temporal formula: positive if it is true, negative if it is false.

A comparison of numbers has a **margin**: positive if it holds, negative if it fails. Any other condition has an
infinite margin. Negation changes the sign, *and* is the minimum, *or* the maximum, and time operators are
minima and maxima over frames. A positive margin means true, a negative one false. The value stays the same as
long as no number in the recording changes by more than the margin (Fainekos and Pappas 2009, Donzé and Maler
2010).

Time, bounds and trace ends are as in :mod:`sgstore.temporal._formula`: the formula has the same form, with
margins as propositions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.help import in_words
from sgstore.lang.sql import value_text
from sgstore.temporal._check_plan import CheckPlan, base_name
from sgstore.temporal._formula import (
    TRUE,
    And,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    propositions,
)
from sgstore.temporal._signal_values import NS, lasts
from sgstore.temporal._signals import PropositionTable
from sgstore.temporal._windows import greatest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.operators import Column
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.temporal._plan import Ask, Plan, Test

    Places = NDArray[np.int32 | np.int64]


MARGIN_CELLS: Final = 16
"""Memory of a margin, as a multiple of the memory of a truth value."""


@dataclass(frozen=True, slots=True)
class Robustness:
    """Robustness of a check on a trace (margin of its verdict), and the condition and frame that decide.

    Attributes
    ----------
    value : float
        Positive for true, negative for false. Infinite if no comparison of numbers decides.
    condition : str
        Deciding comparison or condition; empty without one, for example if a quantifier has no bindings, or if
        only the trace end decides.
    seq, time_ns, t : int, int, float; or None
        Deciding frame: number, simulation time, and seconds since the trace start.
    nodes : mapping of str to int
        Deciding entities: variable → node id.
    names : mapping of str to str
        Entity names by variable.
    upper : float or None
        Margin with unknown values in favour of the check, if different; in ``value`` they count against it.
    """

    value: float
    condition: str = ""
    seq: int | None = None
    time_ns: int | None = None
    t: float | None = None
    nodes: Mapping[str, int] = field(default_factory=dict[str, int])
    names: Mapping[str, str] = field(default_factory=dict[str, str])
    upper: float | None = None


def apart_from_absence(found: Robustness, without: Callable[[], Robustness]) -> Robustness:
    """If an absent entity makes the margin minus infinity, return the margin without the absence.

    The other margin is computed without absence, and at most 0.

    Parameters
    ----------
    found : Robustness
    without : callable
        Function that returns the margin if absent entities count in favour of the check. If that margin is
        positive, no number measures the failure.
    """
    if found.value > -np.inf:
        return found
    other = without()
    if other.value == -np.inf:
        return found
    return other if other.value < 0 else replace(found, value=0.0)


def margin_of(test: Test, column: Column, tolerance: int, unknown: float = -np.inf) -> Floats:
    """Return the margin of a comparison, for each combination and frame, (B, F). Unknown counts as false.

    Parameters
    ----------
    test : Test
        Test of the difference.
    column : Column
        Values of the test.
    tolerance : int
        Time tolerance for equality; ns.
    unknown : float
        Margin of an unknown comparison.
    """
    values = np.asarray(column.values, np.float64)
    if lasts(test.expression):
        values = np.where(np.abs(values) <= tolerance / NS, 0.0, values)
    known = column.known & ~np.isnan(values)
    return np.where(known, values, unknown)


def margin_of_flags(flags: Bools) -> Floats:
    """Return the margins of a condition without numbers: infinity if it is true, else minus infinity."""
    return np.where(flags, np.inf, -np.inf)


def condition_text(plan: Plan, name: str) -> str:
    """Return the text of the condition that a proposition (name in a formula) represents."""
    name = base_name(name)
    meanings = plan.meanings if isinstance(plan, CheckPlan) else {}
    if name in meanings:
        return value_text(in_words(meanings[name])).removeprefix("(").removesuffix(")")
    if name in plan.margins:
        return value_text(in_words(plan.margins[name])).removeprefix("(").removesuffix(")")
    if name in plan.tests:
        return value_text(in_words(plan.tests[name].expression))
    ask = plan.atoms[name]
    where = [value_text(in_words(part)) for part in ask.query.scope.where]
    told = " ".join(" AND ".join(where).split())
    return told or f"exists_now({', '.join(ask.variables)})"


def margin_columns(
    plan: Plan,
    formula: Formula,
    tests: Callable[[Test], Column],
    flags: Callable[[str], Bools],
    tolerance: int,
    unknown: float = -np.inf,
) -> dict[str, Floats]:
    """Return the margins of each proposition (single-frame condition) of a formula: name → (B, F).

    Parameters
    ----------
    plan : Plan
    formula : Formula
    tests : function
        Function that returns the column of a test.
    flags : function
        Function that returns the mask of an atom or a Boolean test.
    tolerance : int
        Time tolerance; ns.
    unknown : float
        Margin of an unknown comparison.
    """
    found: dict[str, Floats] = {}
    for name in sorted(propositions(formula)):
        if name in plan.margins:
            column = tests(plan.tests[name])
            found[name] = margin_of(plan.tests[name], column, tolerance, unknown)
        else:
            found[name] = margin_of_flags(flags(name))
    return found


def least_values(plan: CheckPlan, always: Formula) -> dict[str, frozenset[str]]:
    """Return those values whose minimum determines the robustness margin of ``ALWAYS p``.

    Then each margin in p is the known value of a signal, and frames without its entities count in favour. The
    result is empty for any other p, because a frame with another value may decide.

    Parameters
    ----------
    plan : CheckPlan
    always : Formula
        Formula of p for its margin.

    Returns
    -------
    dict of str to frozenset of str
        Signal → signals of the same matches whose values must be known.
    """
    found: dict[str, frozenset[str]] = {}
    seen: set[str] = set()
    for part in always.operands if isinstance(always, And) else (always,):
        match part:
            case Or((And((Proposition(margin), Proposition(known))), Not(excluded))):
                either = excluded.operands if isinstance(excluded, Or) else (excluded,)
                names = {base_name(one.name) for one in either if isinstance(one, Proposition)}
            case _:
                return {}
        test = plan.tests[margin]
        others = [plan.tests[name] for name in names & plan.tests.keys()]
        states = {of.name for one in others for of in _states_in(plan, one)}
        if (
            len(names) < len(either)
            or len(others) < len(names)
            or known not in names
            or test.expression not in test.signals
            or any(isinstance(p, b.SignalCall) for one in others for p in b.walk(one.expression))
            or not states & plan.signals.keys()
        ):
            return {}
        found[test.signals[test.expression].name] = frozenset(states & plan.signals.keys())
        seen |= {margin, *names}
    return found if seen == plan.tests.keys() else {}


def _states_in(plan: CheckPlan, test: Test) -> Iterator[Ask]:
    """Yield the queries that provide the values for an expression over several frames."""
    for signal in test.signals.values():
        of, _ = plan.states.get(signal.name, (None, None))
        if of is not None:
            yield of


class MarginTable:
    """Robustness margins of temporal formulas in one trace, computed from single-frame conditions.

    Parameters
    ----------
    columns : mapping of str to (B, F) float64, or (1, F)
        Margins of each binding; (1, F) if equal for all bindings.
    times : (F,) int64
        Ascending; ns. F is at least 1.
    tolerance : int
        Time tolerance for equality; ns.
    """

    def __init__(self, columns: Mapping[str, Floats], times: Ints, tolerance: int = 0) -> None:
        self._columns, self._frames, self._tolerance = columns, len(times), tolerance
        self._clock = PropositionTable({}, times)
        self._known: dict[Formula, Floats] = {}

    def value(self, formula: Formula) -> Floats:
        """Return the robustness margin of a formula for each node combination and frame, (B, F).

        The shape is (1, F) if all node combinations have the same margin.
        """
        if formula not in self._known:
            self._known[formula] = self._value(formula)
        return self._known[formula]

    def _value(self, formula: Formula) -> Floats:  # noqa: PLR0911 - a case each
        match formula:
            case TruthConstant(value=value):
                return np.full((1, self._frames), np.inf if value else -np.inf)
            case Proposition(name=name):
                return self._columns[name]
            case Not(operand=operand):
                return -self.value(operand)
            case And(operands=operands):
                return reduce(np.minimum, map(self.value, operands))
            case Or(operands=operands):
                return reduce(np.maximum, map(self.value, operands))
            case Next(operand=operand, weak=weak):
                shifted = np.roll(self.value(operand), -1, axis=1)
                shifted[:, -1] = np.inf if weak else -np.inf
                return shifted
            case Previous(operand=operand):
                shifted = np.roll(self.value(operand), 1, axis=1)
                shifted[:, 0] = -np.inf
                return shifted
            case Until(left=left, right=right):
                first, end = self._asked(formula)
                sides = None if left == TRUE else self.value(left)
                return until(sides, self.value(right), first, end)
            case Since(left=left, right=right):
                first, end = (self._frames - one[::-1] for one in reversed(self._asked(formula)))
                sides = None if left == TRUE else self.value(left)[:, ::-1]
                return until(sides, self.value(right)[:, ::-1], first, end)[:, ::-1]

    def _asked(self, formula: Until | Since) -> tuple[Places, Places]:
        """For each frame, return the start and the end of an operator's time bound, as frames.

        The range is: first frame, and frame after the last.
        """
        forward = isinstance(formula, Until)
        bound = formula.bound.widened(self._tolerance)
        near, far = self._clock.window(bound, forward=forward)
        here, frames = self._clock.frames, self._frames
        near = here if near is None else near
        if far is None:
            far = np.full_like(here, frames - 1 if forward else 0)
        first, last = (near, far) if forward else (far, near)
        return np.clip(first, 0, frames), np.clip(last + 1, 0, frames)

    # Deciding frames

    def decisive(self, formula: Formula, row: int, frame: int) -> tuple[str, int] | None:  # noqa: PLR0911
        """Return the proposition that decides the margin of a formula, and its frame; or None.

        The first of several wins.

        ``None`` means that a trace end decides.
        """
        match formula:
            case TruthConstant():
                return None
            case Proposition(name=name):
                return name, frame
            case Not(operand=operand):
                return self.decisive(operand, row, frame)
            case And(operands=operands) | Or(operands=operands):
                wanted = self._at(formula, row)[frame]
                chosen = next(o for o in operands if self._at(o, row)[frame] == wanted)
                return self.decisive(chosen, row, frame)
            case Next(operand=operand):
                inside = frame + 1 < self._frames
                return self.decisive(operand, row, frame + 1) if inside else None
            case Previous(operand=operand):
                return self.decisive(operand, row, frame - 1) if frame else None
            case Until() | Since():
                return self._decisive_over_time(formula, row, frame)

    def _decisive_over_time(
        self, formula: Until | Since, row: int, frame: int
    ) -> tuple[str, int] | None:
        first, end = (int(one[frame]) for one in self._asked(formula))
        if first >= end:
            return None
        forward = isinstance(formula, Until)
        frames = np.arange(first, end) if forward else np.arange(end - 1, first - 1, -1)
        right = self._at(formula.right, row)[frames]
        way = np.arange(frame, end - 1) if forward else np.arange(frame, first, -1)
        left = self._at(formula.left, row)[way]
        # The left side also counts before the first frame of the bound.
        least = np.minimum.accumulate(np.concatenate(([np.inf], left)))[
            len(way) + 1 - len(frames) :
        ]
        best = int(np.argmax(np.minimum(right, least)))
        if right[best] <= least[best]:
            return self.decisive(formula.right, row, int(frames[best]))
        before = left[: len(way) + 1 - len(frames) + best]
        return self.decisive(formula.left, row, int(way[int(np.argmin(before))]))

    def _at(self, formula: Formula, row: int) -> Floats:
        found = self.value(formula)
        return found[min(row, len(found) - 1)]


def until(left: Floats | None, right: Floats, first: Places, end: Places) -> Floats:
    """Return the margin of an *until* for each node combination and frame, (B, F).

    Parameters
    ----------
    left, right : (B, F) float64, or (1, F)
        Margins of the two sides. Without ``left``, the left side is true.
    first, end : (F,) int
        First frame of the bound, and the frame after the last.
    """
    frames = right.shape[1]
    hit = _greatest_of(right, first, end)
    if left is None:
        return hit
    # A bounded *until* is the minimum of a bounded *eventually* and an unbounded *until* (Donzé, Ferrère and
    # Maler 2013).
    onward = np.take(_behind(_unbounded(left, right)), first, axis=1)
    found = np.minimum(hit, onward)
    here = np.arange(frames)
    if np.any(first > here):
        found = np.minimum(found, -greatest(-left, here, first))
    return found


def _greatest_of(values: Floats, first: Places, end: Places) -> Floats:
    frames = values.shape[1]
    if np.all(end == frames):
        onward = np.maximum.accumulate(values[:, ::-1], axis=1)[:, ::-1]
        return np.take(_behind(onward), first, axis=1)
    return greatest(values, first, end)


def _behind(values: Floats) -> Floats:
    return np.concatenate((values, np.full((len(values), 1), -np.inf)), axis=1)


def _unbounded(left: Floats, right: Floats) -> Floats:
    """Return the margin of an *until* without time bound, for each node combination and frame, (B, F).

    Each step is a clamp, and a sequence of clamps is a clamp. So blocks of frames are processed in parallel,
    then combined.
    """
    left, right = np.broadcast_arrays(left, right)
    rows, frames = right.shape
    size = int(np.ceil(np.sqrt(frames)))
    blocks = -(-frames // size)
    sides = np.full((2, rows, blocks * size), -np.inf)
    sides[0, :, :frames], sides[1, :, :frames] = left, right
    inner, outer = np.ascontiguousarray(sides.reshape(2, rows, blocks, size).transpose(0, 3, 1, 2))
    low, high = (
        np.full((size + 1, rows, blocks), -np.inf),
        np.full((size + 1, rows, blocks), np.inf),
    )
    for at in range(size - 1, -1, -1):
        for ends in (low, high):
            np.minimum(inner[at], ends[at + 1], out=ends[at])
            np.maximum(outer[at], ends[at], out=ends[at])
    later = np.full((rows, blocks), -np.inf)  # the value after each block
    for block in range(blocks - 2, -1, -1):
        whole = np.minimum(high[0, :, block + 1], later[:, block + 1])
        later[:, block] = np.maximum(low[0, :, block + 1], whole)
    found = np.maximum(low[:size], np.minimum(high[:size], later))
    return found.transpose(1, 2, 0).reshape(rows, blocks * size)[:, :frames]
