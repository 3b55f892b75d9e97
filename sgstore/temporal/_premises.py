"""Queries that must have matches if a check is false. Traces without these matches need no evaluation.

An *alternative* is a set of queries. If no alternative has matches for all its queries, the formula is true. So
only nodes in the matches of an alternative need evaluation, and only their data is read.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.catalog import Type
from sgstore.temporal._check_plan import CheckPlan, base_name
from sgstore.temporal._formula import (
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
from sgstore.temporal._joint_bindings import joined
from sgstore.temporal._offline import (
    Alternatives,
    PlanValues,
    Premises,
    TraceReader,
    no_rows,
    refuse_many,
)
from sgstore.temporal._signal_values import Clock, SignalValues

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import BoundCheck
    from sgstore.model.world import Ints
    from sgstore.temporal._plan import Ask, Test
    from sgstore.temporal._trace_group import TimedRelation

    Keys = NDArray[np.int64]

_ALWAYS: Final[Alternatives] = frozenset({frozenset[str]()})
_NEVER: Final[Alternatives] = frozenset()

MOST: Final = 64
"""Largest number of alternative sets of queries. A formula with more of them is always evaluated."""


def bindings_of(
    premises: Premises,
    trace: TraceReader,
    variables: tuple[str, ...],
    domains: Mapping[str, Ints],
    *,
    injective: bool,
) -> Keys:
    """Return the combinations of entities of a trace that need evaluation, sorted, one per row."""
    parts = [np.zeros((0, len(variables)), np.int64)]
    for one in premises.left(trace.relations):
        names = sorted(one, key=lambda name: len(trace.relations[name].keys))
        of = [(premises.asks[name].variables, trace.relations[name]) for name in names]
        rows, named = np.zeros((1, 0), np.int64), ()
        if some := _connected([pair for pair in of if pair[0]]):
            found = joined(some, variables * injective)
            rows, named = found.bindings, found.variables
        for name in variables:
            if name not in named:
                whose = f"FORALL {', '.join((*named, name))} is about too much"
                refuse_many(len(rows) * len(domains[name]), whose)
                added = np.tile(domains[name], len(rows))
                rows = np.column_stack((np.repeat(rows, len(domains[name]), axis=0), added))
                named = (*named, name)
        parts.append(rows[:, [named.index(name) for name in variables]])
    every = np.concatenate(parts)
    rows = np.unique(every, axis=0) if every.shape[1] else every[:1]
    kept = np.ones(len(rows), np.bool_)
    for column, name in enumerate(variables):
        kept &= np.isin(rows[:, column], domains[name])
        for other in range(column) if injective else ():
            kept &= rows[:, other] != rows[:, column]
    return rows[kept]


def premises_of(
    check: BoundCheck, plan: CheckPlan, formula: Formula, asks: Mapping[str, Ask]
) -> Premises | None:
    """Return the sets of queries that a false check needs; None if every trace needs evaluation."""
    for_all = all(quantifier.word == "FORALL" for quantifier in check.quantifiers)
    if not for_all or check.gaps == "unknown":
        return None
    found = _Ways(plan).ways(formula, value=False)
    return None if found == _ALWAYS else Premises(found, asks)


def _connected(
    relations: list[tuple[tuple[str, ...], TimedRelation]],
) -> list[tuple[tuple[str, ...], TimedRelation]]:
    """Sort tables of matches so that each table shares a variable with an earlier one, if possible."""
    found: list[tuple[tuple[str, ...], TimedRelation]] = []
    left = list(relations)
    while left:
        seen = {name for names, _ in found for name in names}
        chosen = next((n for n, (names, _) in enumerate(left) if seen & {*names}), 0)
        found.append(left.pop(chosen))
    return found


class _Ways:
    """Search for sets of queries. A formula has a value only if all queries of one set have matches."""

    def __init__(self, plan: CheckPlan) -> None:
        self._plan = plan
        self._tests: dict[str, Alternatives] = {}

    def ways(self, formula: Formula, *, value: bool) -> Alternatives:  # noqa: PLR0911 - a case each
        """Return sets of queries. The formula has ``value`` only if all queries of one set have matches."""
        match formula:
            case TruthConstant(value=constant):
                return _ALWAYS if constant == value else _NEVER
            case Proposition(name=name):
                return self._named(base_name(name)) if value else _ALWAYS
            case Not(operand=operand):
                return self.ways(operand, value=not value)
            case And(operands=operands) | Or(operands=operands):
                parts = [self.ways(one, value=value) for one in operands]
                return _all(parts) if isinstance(formula, And) == value else _any(parts)
            case Next(operand=operand, weak=weak):
                return _ALWAYS if weak == value else self.ways(operand, value=value)
            case Previous(operand=operand):
                return self.ways(operand, value=True) if value else _ALWAYS
            case Until(right=right, bound=bound) | Since(right=right, bound=bound):
                if not value and bound.low:
                    return _ALWAYS  # the bound may have no frame
                return self.ways(right, value=value)

    def _named(self, name: str) -> Alternatives:
        if name in self._plan.atoms:
            return frozenset({frozenset({name})})
        if name not in self._tests:
            test = self._plan.tests[name]
            self._tests[name] = self._tested(test.expression, test)
        return self._tests[name]

    def _tested(self, expression: b.Bound, test: Test) -> Alternatives:
        """Return sets of queries. The condition is true only if all queries of one set have matches."""
        if isinstance(expression, b.Operation) and expression.word == "AND":
            return _all([self._tested(one, test) for one in expression.operands])
        inputs = self._inputs(expression, test)
        if inputs is None or self._holds_without(replace(test, expression=expression)):
            return _ALWAYS
        needed = frozenset(self._needed(expression, test))
        return _all([frozenset({needed}), frozenset(frozenset({one}) for one in inputs)])

    def _needed(self, expression: b.Bound, test: Test) -> Iterator[str]:
        """Yield the queries that need matches, because without them the value of an expression is unknown."""
        if isinstance(expression, b.SignalCall) and expression.operand in test.signals:
            expression = expression.operand
        if expression in test.signals:
            ask = test.signals[expression]
            of, _ = self._plan.states.get(ask.name, (ask, None))
            yield from () if of is None else (of.name,)
        elif isinstance(expression, b.Operation) and expression.word in _STRICT:
            for operand in expression.operands:
                yield from self._needed(operand, test)

    def _inputs(self, expression: b.Bound, test: Test) -> set[str] | None:
        """Return the queries that a condition depends on; None if its value can change without any matches."""
        parts = set(b.walk(expression))
        calls = {part.operand for part in parts if isinstance(part, b.SignalCall)}
        names: set[str] = set()
        for value in (parts | calls) & test.signals.keys():
            ask = test.signals[value]
            of, doubt = self._plan.states.get(ask.name, (ask, None))
            if of is None or (of.value is not None and of.value.type not in _PLAIN):
                return None
            names |= {of.name, doubt or of.name}
        if test.quantities:
            return None
        for condition in (parts | calls) & test.formulas.keys():
            formula = test.formulas[condition]
            ways = self.ways(formula, value=True)
            names.update(map(base_name, propositions(formula)))
            if ways == _ALWAYS or names & self._plan.tests.keys():
                return None
        return names | set(test.presence.values())

    def _holds_without(self, test: Test) -> bool:
        """True if a condition over several frames is true when none of its queries has a match."""
        asks, two = self._plan.asks, np.arange(2)
        clock = Clock(two * _LONG, two * 0, _LONG)
        relations = {name: no_rows(ask) for name, ask in asks.items()}
        trace = TraceReader(0, "", two, two, two, two, 0, clock, relations)
        variables = self._plan.bound
        values = PlanValues(self._plan, trace, variables, np.zeros((1, len(variables)), np.int64))
        return bool(SignalValues.test(values, test).true.any())


_STRICT: Final = frozenset({"=", "<>", "<", "<=", ">", ">=", "+", "-", "*", "/", "abs"})
"""Operations whose result is unknown if an operand is unknown."""

_PLAIN: Final = frozenset({Type.number, Type.boolean})

_LONG: Final = 10**15


def _any(parts: Sequence[Alternatives]) -> Alternatives:
    return _fewest(one for part in parts for one in part)


def _all(parts: Sequence[Alternatives]) -> Alternatives:
    """Combine lists of sets: each result is the union of one set of each list. Long lists are skipped."""
    found = _ALWAYS
    for part in sorted(parts, key=len):
        if len(found) * len(part) <= MOST:
            found = _fewest(one | other for one, other in product(found, part))
    return found


def _fewest(sets: Iterable[frozenset[str]]) -> Alternatives:
    """Return the smallest sets: those that contain no other set of the list."""
    found: list[frozenset[str]] = []
    for one in sorted(sets, key=len):
        if not any(other <= one for other in found):
            found.append(one)
    return frozenset(found) if len(found) <= MOST else _ALWAYS
