"""From bound expressions that look at several frames to formulas over atoms: the one form that is evaluated.

A :class:`Plan` has all that an expression, or several of one statement, need of single frames, once each:

* an **atom** is a condition on one frame. It has free variables (keys of nodes) and is a query of its own:
  its matches say in which frames, and for which entities, it is true. A store answers it by SQL; in memory
  :class:`sgstore.lang.match.Matcher` does, with the same ``query``.
* a **signal** is a value of one frame, of the same kind: a query, and the value that is asked of its matches.
* a **test** is an expression over values of several frames, in which ``prev``, ``delta``, ``run_length``,
  ``since_true`` and ``age`` stand over signals and formulas.

In a :class:`~sgstore.temporal.formulas.Formula` of the plan, a proposition is the name of an atom or of a test.

**What is unknown is false, where time begins.** An atom that is NULL is false; so is one that speaks of an
entity that is absent (or true, where ``ABSENT AS TRUE`` says so). Logic outside of atoms has two values. Which
part of a condition becomes an atom is chosen for speed: its value is that of its smallest conditions, each
being true or false.

For whoever evaluates a plan frame by frame (a monitor): for each frame, ask each atom for its matches, project
them to ``variables``, and step a formula for each binding with ``letter[name] = projection in matches``. Of an
entity that was never seen all atoms are false that have it among their variables, so one engine that has seen
none can be copied when it comes. Values of signals at former frames are kept as far back as ``delta`` looks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING, Final

from sgstore.lang import bound as b
from sgstore.lang.catalog import Type
from sgstore.lang.printing import unnumbered_text
from sgstore.temporal import formulas as f

if TYPE_CHECKING:
    from collections.abc import Iterable

_CONNECTIVES: Final = frozenset({"AND", "OR", "NOT", "XOR", "IMPLIES"})
_KNOWN: Final = frozenset({"IS NULL", "IS NOT NULL"})
FALSE: Final = b.Value(value=False, type=Type.boolean)
TRUE: Final = b.Value(value=True, type=Type.boolean)


@dataclass(frozen=True, slots=True, eq=False)
class Atom:
    """A condition on one frame.

    Attributes
    ----------
    name : str
        The proposition.
    query : Query
        Its nodes and the condition; matches say where it is true.
    variables : tuple of str
        Those of its nodes that a binding speaks of, in order; the others (the ego) are only asked to exist.
    """

    name: str
    query: b.Query
    variables: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """A value of one frame: the one column of ``query``; ``variables`` as of :class:`Atom`."""

    name: str
    query: b.Query
    variables: tuple[str, ...]
    value: b.Bound


@dataclass(frozen=True, slots=True, eq=False)
class Test:
    """An expression over values of several frames.

    Attributes
    ----------
    name : str
        The proposition, if it is a condition.
    expression : Bound
        Constants, operations and courses; other parts are the values of ``signals``.
    variables : tuple of str
    signals : dict of Bound to Signal
        By the part of the expression that each is.
    formulas : dict of Bound to Formula
        Of the conditions within ``run_length`` and ``since_true``.
    presence : dict of str to str
        Node → the atom that says where it is, for ``age``.
    """

    name: str
    expression: b.Bound
    variables: tuple[str, ...]
    signals: dict[b.Bound, Signal] = field(default_factory=dict[b.Bound, Signal])
    formulas: dict[b.Bound, f.Formula] = field(default_factory=dict[b.Bound, f.Formula])
    presence: dict[str, str] = field(default_factory=dict[str, str])

    __test__ = False  # it is no test of pytest's


@dataclass(slots=True)
class Plan:
    """What some expressions need of single frames.

    Parameters
    ----------
    whole : Query
        The statement: settings and relations are taken from it, and of its scope the nodes.
    bound : frozenset of str
        Keys of the nodes that a binding speaks of.
    absent : frozenset of str
        Those of which conditions are true where they are absent.

    Attributes
    ----------
    atoms, signals, tests : dict of str to Atom, Signal, Test
        By name.
    """

    whole: b.Query
    bound: frozenset[str]
    absent: frozenset[str] = frozenset()
    atoms: dict[str, Atom] = field(default_factory=dict[str, Atom])
    signals: dict[str, Signal] = field(default_factory=dict[str, Signal])
    tests: dict[str, Test] = field(default_factory=dict[str, Test])
    _names: dict[str, str] = field(default_factory=dict[str, str])

    def formula(self, expression: b.Bound) -> f.Formula:
        """The formula of a condition; atoms and tests that it needs become part of the plan."""
        if b.is_temporal(expression):
            return self._over_time(expression)
        nodes = b.nodes_of(expression)
        if _guarded(expression) == nodes and not nodes & self.absent:
            return self._atom(expression, nodes)
        return self._logic(expression)

    def _over_time(self, expression: b.Bound) -> f.Formula:
        match expression:
            case b.Tense(word=word, operands=operands):
                bound = f.Bound(expression.low, expression.high, expression.frames)
                return _TENSES[word](tuple(self.formula(operand) for operand in operands), bound)
            case b.Course(word="exists_now", operand=operand):
                return self.present(next(iter(b.nodes_of(operand))))
            case b.Operation(word=word) if word in _CONNECTIVES:
                return self._logic(expression)
            case _:
                return self._lapsing(self.test(expression).name, b.nodes_of(expression))

    def _logic(self, expression: b.Bound) -> f.Formula:
        match expression:
            case b.Operation("AND", operands):
                return f.And(tuple(map(self.formula, self._merged(operands))))
            case b.Operation(word, operands) if word in _CONNECTIVES:
                return f.LOGIC[word](*map(self.formula, operands))
            case b.Value(value=value):
                return f.Constant(value is True)
            case _:
                return self._atom(expression, b.nodes_of(expression))

    def _merged(self, operands: tuple[b.Bound, ...]) -> list[b.Bound]:
        """Conditions that are all to be true, with those that others guard made one with them.

        What speaks of no more entities than another condition, which is false where one of these is absent, is
        asked together with it: one question finds few, where each alone might find many.
        """
        flat = [part for operand in operands for part in _flat(operand)]
        if self.absent:
            return flat
        nodes = {id(part): b.nodes_of(part) for part in flat}
        plain = [part for part in flat if not b.is_temporal(part)]
        leaders = [part for part in plain if nodes[id(part)] and _guarded(part) == nodes[id(part)]]
        leaders.sort(key=lambda part: -len(nodes[id(part)]))
        groups: list[tuple[frozenset[str], list[b.Bound]]] = []
        for part in leaders:
            group = next((g for g in groups if nodes[id(part)] <= g[0]), None)
            if group is None:
                groups.append((nodes[id(part)], [part]))
            else:
                group[1].append(part)
        rest = [part for part in flat if not any(part is leader for leader in leaders)]
        alone: list[b.Bound] = []
        for part in rest:
            group = next((g for g in groups if nodes[id(part)] <= g[0]), None)
            if group is None or b.is_temporal(part):
                alone.append(part)
            else:
                group[1].append(part)
        return [_all(parts) for _, parts in groups] + alone

    def present(self, node: str) -> f.Formula:
        """That a node is there."""
        return self._atom(TRUE, frozenset({node}))

    def _atom(self, expression: b.Bound, nodes: frozenset[str]) -> f.Formula:
        if isinstance(expression, b.Value) and not nodes:
            return f.Constant(expression.value is True)
        key = unnumbered_text(expression) + f" of {sorted(nodes)}"
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"a{len(self.atoms) + 1}"
            where = () if expression == TRUE else tuple(_flat(_two_valued(expression)))
            self.atoms[name] = Atom(name, self._query(nodes, where), self._variables(nodes))
        return self._lapsing(name, frozenset() if expression == TRUE else nodes)

    def _lapsing(self, name: str, nodes: Iterable[str]) -> f.Formula:
        """A proposition, or that a node is absent of which conditions are true then."""
        lapses = [f.Not(self.present(node)) for node in sorted(self.absent & set(nodes))]
        return f.Or((f.Proposition(name), *lapses)) if lapses else f.Proposition(name)

    def test(self, expression: b.Bound) -> Test:
        """An expression over values of several frames, of any type."""
        key = "=" + unnumbered_text(expression)
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"t{len(self.tests) + 1}"
            test = Test(name, expression, self._variables(b.nodes_of(expression)))
            self.tests[name] = test
            self._measure(expression, test)
        return self.tests[name]

    def _measure(self, expression: b.Bound, test: Test) -> None:
        match expression:
            case b.Course(word="run_length" | "since_true", operand=operand):
                test.formulas[operand] = self.formula(operand)
            case b.Course(word="age" | "exists_now", operand=operand):
                node = next(iter(b.nodes_of(operand)))
                present = self._atom(TRUE, frozenset({node}))
                assert isinstance(present, f.Proposition)  # noqa: S101 - it speaks of a node
                test.presence[node] = present.name
            case b.Tense():
                test.formulas[expression] = self.formula(expression)
            case b.Course(operand=operand):
                test.signals[operand] = self._signal(operand)
            case b.Operation(operands=operands) if b.is_temporal(expression):
                for operand in operands:
                    self._measure(operand, test)
            case b.Value() | b.Choices() | b.Moment():
                pass
            case _:
                test.signals[expression] = self._signal(expression)

    def _signal(self, value: b.Bound) -> Signal:
        nodes = b.nodes_of(value)
        key = ":" + unnumbered_text(value) + f" of {sorted(nodes)}"
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"s{len(self.signals) + 1}"
            query = self._query(nodes, ())
            self.signals[name] = Signal(name, query, self._variables(nodes), value)
        return self.signals[name]

    def _variables(self, nodes: frozenset[str]) -> tuple[str, ...]:
        return tuple(sorted(nodes & self.bound))

    def _query(self, nodes: frozenset[str], where: tuple[b.Bound, ...]) -> b.Query:
        known = self.whole.scope.nodes
        own = {key: replace(known[key], role="named") for key in sorted(nodes)}
        pairs = combinations(own, 2) if self.whole.injective else ()
        scope = b.Scope(own, {}, (), where, frozenset(pairs))
        return b.Query(
            scope,
            b.Result(),
            self.whole.relations,
            self.whole.injective,
            self.whole.ego,
            self.whole.unknown_is_false,
        )


def _flat(expression: b.Bound) -> list[b.Bound]:
    if isinstance(expression, b.Operation) and expression.word == "AND":
        return [part for operand in expression.operands for part in _flat(operand)]
    return [expression]


def _all(parts: list[b.Bound]) -> b.Bound:
    return parts[0] if len(parts) == 1 else b.Operation("AND", tuple(parts), Type.boolean)


def _guarded(expression: b.Bound) -> frozenset[str]:
    """Nodes whose absence makes a condition on one frame false, its smallest conditions being false then."""
    match expression:
        case b.Operation("AND", operands):
            return frozenset().union(*map(_guarded, operands))
        case b.Operation("OR" | "XOR", operands):
            return frozenset.intersection(*map(_guarded, operands))
        case b.Operation("NOT" | "IMPLIES"):
            return frozenset()
        case _:
            return b.nodes_of(expression)


def _two_valued(expression: b.Bound, *, outermost: bool = True) -> b.Bound:  # noqa: PLR0911 - a case each
    """A condition on one frame whose smallest conditions are false where they are unknown.

    Where it is only asked whether all of some conditions are true, nothing need be done: unknown is not true.
    """
    match expression:
        case b.Operation("AND", operands):
            parts = tuple(_two_valued(operand, outermost=outermost) for operand in operands)
            return b.Operation("AND", parts, Type.boolean)
        case b.Operation("OR", operands) if outermost:
            parts = tuple(_two_valued(operand) for operand in operands)
            return b.Operation("OR", parts, Type.boolean)
        case b.Operation(word, operands) if word in _CONNECTIVES:
            parts = tuple(_two_valued(operand, outermost=False) for operand in operands)
            return b.Operation(word, parts, Type.boolean)
        case b.BlockValue(word="EXISTS") | b.LabelTest():
            return expression
        case b.Operation(word=word) if word in _KNOWN:
            return expression
        case b.Value(value=None):
            return FALSE
        case _ if outermost or isinstance(expression, b.Value):
            return expression
        case _ if _never_unknown(expression):
            return expression
        case _:
            return b.Operation("coalesce", (expression, FALSE), Type.boolean)


def _never_unknown(expression: b.Bound) -> bool:
    """Whether it compares a number of matches with a constant, which is known always."""
    match expression:
        case b.Operation(operands=(b.BlockValue(word="COUNT"), b.Value(value=value))):
            return value is not None
        case _:
            return False


# Operators --------------------------------------------------------------------------------------------------


_Operands = tuple[f.Formula, ...]
_Operator = Callable[[_Operands, f.Bound], f.Formula]


def _one(make: Callable[[f.Formula, f.Bound], f.Formula]) -> _Operator:
    def operator(operands: _Operands, bound: f.Bound) -> f.Formula:
        return make(operands[0], bound)

    return operator


def _two(make: Callable[[f.Formula, f.Formula, f.Bound], f.Formula]) -> _Operator:
    def operator(operands: _Operands, bound: f.Bound) -> f.Formula:
        return make(operands[0], operands[1], bound)

    return operator


def _next(operand: f.Formula, _: f.Bound) -> f.Formula:
    return f.Next(operand)


def _weak_next(operand: f.Formula, _: f.Bound) -> f.Formula:
    return f.Next(operand, weak=True)


def _previous(operand: f.Formula, _: f.Bound) -> f.Formula:
    return f.Previous(operand)


_TENSES: Final[dict[str, _Operator]] = {
    "ALWAYS": _one(f.always),
    "EVENTUALLY": _one(f.eventually),
    "HISTORICALLY": _one(f.historically),
    "ONCE": _one(f.once),
    "NEXT": _one(_next),
    "WEAKNEXT": _one(_weak_next),
    "PREVIOUS": _one(_previous),
    "UNTIL": _two(f.Until),
    "SINCE": _two(f.Since),
    "RELEASE": _two(f.release),
}
