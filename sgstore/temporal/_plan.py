"""Evaluation plans: temporal formulas, and single-frame queries for the conditions in them.

A :class:`Plan` contains all single-frame data that the expressions of a statement need, without duplicates:

* an **atom** is a condition on one frame. It has free variables (keys of nodes) and is a separate query: its
  matches are the frames and entities for which it is true. A store answers it by SQL, and
  :class:`sgstore.lang.memory._search.ScopeSearch` answers it in memory.
* a **signal** is a value of one frame: a query, and a value of its matches. An edge variable represents the
  edges of its relations from its source to its destination in that frame. A condition is true if it is true
  for one of these edges. A value is that of the alphabetically first relation. So bindings contain only
  nodes, including the ends of edges.
* a **test** is an expression over values of several frames. In it, ``prev``, ``delta``, ``run_length``,
  ``since_true`` and ``age`` apply to signals and formulas.

In a :class:`~sgstore.temporal._formula.Formula` of the plan, a proposition is the name of an atom or of a test.

In steps and values, a NULL atom is false, and so is an atom on an absent entity. Logic outside of atoms is
two-valued. The split of a condition into atoms only affects speed, not its value. Checks have special plans
(:mod:`sgstore.temporal._check_plan`).

A monitor evaluates a plan frame by frame. It queries the matches of each atom, projects them to ``variables``,
and steps a formula for each binding with ``letter[name] = projection in matches``. All atoms on an unseen
entity are false, so a new entity starts with a copy of the engine for unseen entities. Signal values are kept
as far back as ``delta`` needs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING, Final

import sgstore.temporal._formula as f
from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind import CONNECTIVES, negated
from sgstore.lang.catalog import Type
from sgstore.lang.sql import relation, unnumbered_text, value_text
from sgstore.temporal._formula import formula_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import BoundCheck, BoundHold, BoundStep, Length, StepLink, StepWay
    from sgstore.lang.sql import SqlStatement


_KNOWN: Final = frozenset({"IS NULL", "IS NOT NULL"})
FALSE: Final = b.Value(value=False, type=Type.boolean)
TRUE: Final = b.Value(value=True, type=Type.boolean)


@dataclass(frozen=True, slots=True, eq=False)
class Ask:
    """Query on single frames, as a part of the evaluation of a temporal formula or a sequence.

    Attributes
    ----------
    name : str
        Name of the atom (the proposition) or signal.
    query : Query
        Nodes and condition. The matches are the frames in which it is true.
    variables : tuple of str
        Nodes in a binding, in order. Other nodes (the ego) only need to exist.
    value : Bound or None
        Value of each match, for a signal.
    edges : tuple of str
        Keys of the edges in a binding. For a signal: edges in its value. Among matches that differ only in
        these edges, the alphabetically first relations win.
    after : tuple of Ask
        Steps queried earlier. This query skips nodes for which they never hold.
    least : frozenset of str or None
        For a signal of which only the least values of a trace count for each binding: the signals of the same
        matches whose values must be known.
    """

    name: str
    query: b.Query
    variables: tuple[str, ...]
    value: b.Bound | None = None
    edges: tuple[str, ...] = ()
    after: tuple[Ask, ...] = ()
    least: frozenset[str] | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Keys of the nodes and edges that identify a match of the query."""
        return (*self.variables, *self.edges) if self.value is None else self.variables

    @property
    def everywhere(self) -> bool:
        """True if the query has no pattern and no condition, so that every frame matches."""
        scope = self.query.scope
        return self.value is None and not (scope.nodes or scope.edges or scope.where)

    @property
    def loose(self) -> bool:
        """True if edges do not connect all nodes of the query. Such a query can have many matches."""
        scope = self.query.scope
        groups = [{node} for node in scope.nodes]
        for edge in scope.edges:
            met = [group for group in groups if group & {edge.src, edge.dst}]
            groups = [group for group in groups if group not in met] + [set().union(*met)]
        return len(groups) > 1

    def among(self, nodes: Mapping[str, Iterable[int]]) -> Ask:
        """Return a copy of the query in which some nodes must have one of the given ids."""
        scope = self.query.scope
        where = (b.node_among(node, ids) for node, ids in nodes.items())
        narrower = replace(scope, where=(*scope.where, *where))
        return replace(self, query=replace(self.query, scope=narrower))


@dataclass(frozen=True, slots=True, eq=False)
class Test:
    """Expression that depends on several frames, evaluated for all frames of a trace.

    Attributes
    ----------
    name : str
        Name of the test; also the proposition of a condition.
    expression : Bound
        Constants, operations and time functions; other parts are values of ``signals``.
    variables : tuple of str
    signals : dict of Bound to Ask
        Part of the expression → its signal.
    formulas : dict of Bound to Formula
        Formulas of the conditions inside ``run_length`` and ``since_true``.
    quantities : dict of Bound to Formula
        Formulas over margins of the conditions inside ``robustness``.
    presence : dict of str to str
        Node → atom of its presence, for ``age``.
    """

    name: str
    expression: b.Bound
    variables: tuple[str, ...]
    signals: dict[b.Bound, Ask] = field(default_factory=dict[b.Bound, Ask])
    formulas: dict[b.Bound, f.Formula] = field(default_factory=dict[b.Bound, f.Formula])
    quantities: dict[b.Bound, f.Formula] = field(default_factory=dict[b.Bound, f.Formula])
    presence: dict[str, str] = field(default_factory=dict[str, str])

    __test__ = False  # not a pytest test class


@dataclass(slots=True)
class Plan:
    """Evaluation plan of temporal formulas: the single-frame queries and the expressions that they need.

    Parameters
    ----------
    whole : Query
        Statement with the settings, relations, nodes and edges.
    bound : tuple of str
        Keys of the nodes in a binding.
    prefix : str
        Prefix of names, to separate several plans.

    Attributes
    ----------
    atoms, signals : dict of str to Ask
    tests : dict of str to Test
        By name.
    margins : dict of str to Bound
        Name of the test of a difference → its comparison.
    """

    whole: b.Query
    bound: tuple[str, ...]
    prefix: str = ""
    atoms: dict[str, Ask] = field(default_factory=dict[str, Ask])
    signals: dict[str, Ask] = field(default_factory=dict[str, Ask])
    tests: dict[str, Test] = field(default_factory=dict[str, Test])
    margins: dict[str, b.Bound] = field(default_factory=dict[str, b.Bound])
    _names: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def asks(self) -> dict[str, Ask]:
        """All single-frame queries of the plan: name → query."""
        return self.atoms | self.signals

    def formula(self, expression: b.Bound) -> f.Formula:
        """Return the temporal formula of a condition.

        The single-frame queries that it needs are added to the plan.
        """
        if b.is_temporal(expression):
            return self._over_time(expression)
        things = self._things(expression)
        split = isinstance(expression, b.Operation) and bool(things & self._manifold)
        if self._guarded(expression) == things and not split:
            return self._atom(expression, things)
        return self._logic(expression)

    def quantity(self, expression: b.Bound) -> f.Formula:
        """Return the formula of a condition, for its robustness margin.

        Each comparison of numbers becomes a proposition in :attr:`margins`.
        """
        match expression:
            case b.Tense(word=word, operands=operands):
                bound = f.Bound(expression.low, expression.high, expression.frames)
                return f.TEMPORAL[word](*map(self.quantity, operands), bound)
            case b.Operation(word=word, operands=operands) if word in CONNECTIVES:
                return f.LOGIC[word](*map(self.quantity, operands))
            case b.Operation(word=word, operands=operands) if has_margin(expression):
                test = self.test(MARGINS[word](*operands))
                self.margins.setdefault(test.name, expression)
                return f.Proposition(test.name)
            case _:
                return self.formula(expression)

    @property
    def _manifold(self) -> frozenset[str]:
        edges = self.whole.scope.edges
        return frozenset(edge.key for edge in edges if len(edge.relations) > 1)

    def _things(self, expression: b.Bound) -> frozenset[str]:
        """Return the keys of the nodes and edges in an expression, and of the end nodes of these edges."""
        edges = b.edges_of(expression)
        ends = (
            e for edge in self.whole.scope.edges if edge.key in edges for e in (edge.src, edge.dst)
        )
        return b.nodes_of(expression) | edges | frozenset(ends)

    def _guarded(self, expression: b.Bound) -> frozenset[str]:
        """Return the nodes and edges that must exist for a single-frame condition to be true."""
        match expression:
            case b.Operation("AND", operands):
                return frozenset().union(*map(self._guarded, operands))
            case b.Operation("OR" | "XOR", operands):
                return frozenset.intersection(*map(self._guarded, operands))
            case b.Operation("NOT" | "IMPLIES"):
                return frozenset()
            case _:
                return self._things(expression)

    def _over_time(self, expression: b.Bound) -> f.Formula:
        match expression:
            case b.Tense(word=word, operands=operands):
                bound = f.Bound(expression.low, expression.high, expression.frames)
                return f.TEMPORAL[word](*map(self.formula, operands), bound)
            case b.SignalCall(word="exists_now", operand=operand):
                return self.present(next(iter(b.nodes_of(operand))))
            case b.Operation(word=word) if word in CONNECTIVES:
                return self._logic(expression)
            case _:
                return f.Proposition(self.test(expression).name)

    def _logic(self, expression: b.Bound) -> f.Formula:
        match expression:
            case b.Operation("AND", operands):
                return f.And(tuple(map(self.formula, self._merged(operands))))
            case b.Operation(word, operands) if word in CONNECTIVES:
                return f.LOGIC[word](*map(self.formula, operands))
            case b.Value(value=value):
                return f.TruthConstant(value is True)
            case _:
                return self._atom(expression, self._things(expression))

    def _merged(self, operands: tuple[b.Bound, ...]) -> list[b.Bound]:
        """Group the conditions that ``AND`` joins, so that one query evaluates each group.

        A condition joins a group if the group already uses all its nodes, and is false when one of them is
        absent. One combined query has fewer matches than separate queries.
        """
        flat = [part for operand in operands for part in b.conjuncts(operand)]
        nodes = {id(part): self._things(part) for part in flat}
        apart = self._manifold
        plain = [p for p in flat if not (b.is_temporal(p) or nodes[id(p)] & apart)]
        leaders = [p for p in plain if nodes[id(p)] and self._guarded(p) == nodes[id(p)]]
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
            if group is None or not any(part is one for one in plain):
                alone.append(part)
            else:
                group[1].append(part)
        return [_all(parts) for _, parts in groups] + alone

    def present(self, node: str) -> f.Formula:
        """Return a formula that is true in the frames in which a node is present."""
        return self._atom(TRUE, frozenset({node}))

    def _atom(self, expression: b.Bound, things: frozenset[str]) -> f.Formula:
        if isinstance(expression, b.Value) and not things:
            return f.TruthConstant(expression.value is True)
        key = unnumbered_text(expression) + f" of {sorted(things)}"
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"{self.prefix}a{len(self.atoms) + 1}"
            where = () if expression == TRUE else tuple(b.conjuncts(_two_valued(expression)))
            self.atoms[name] = Ask(name, self._query(things, where), self._variables(things))
        return f.Proposition(name)

    def test(self, expression: b.Bound) -> Test:
        """Return the plan entry of an expression over several frames. A new entry is added to the plan."""
        key = "=" + unnumbered_text(expression)
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"{self.prefix}t{len(self.tests) + 1}"
            test = Test(name, expression, self._variables(self._things(expression)))
            self.tests[name] = test
            self._measure(expression, test)
        return self.tests[name]

    def _measure(self, expression: b.Bound, test: Test) -> None:
        match expression:
            case b.SignalCall(word="run_length" | "since_true", operand=operand):
                test.formulas[operand] = self.formula(operand)
            case b.SignalCall(word="robustness", operand=operand):
                test.quantities[operand] = self.quantity(operand)
            case b.SignalCall(word="age" | "exists_now", operand=operand):
                node = next(iter(b.nodes_of(operand)))
                present = self._atom(TRUE, frozenset({node}))
                assert isinstance(present, f.Proposition)  # noqa: S101 - it speaks of a node
                test.presence[node] = present.name
            case _ if b.is_formula(expression):
                test.formulas[expression] = self.formula(expression)
            case b.SignalCall(operand=operand):
                test.signals[operand] = self._signal(operand)
            case b.Operation(operands=operands) if b.is_temporal(expression):
                for operand in operands:
                    self._measure(operand, test)
            case b.Value() | b.Choices() | b.StepTime():
                pass
            case _:
                test.signals[expression] = self._signal(expression)

    def _signal(self, value: b.Bound) -> Ask:
        things, edges = self._things(value), tuple(sorted(b.edges_of(value)))
        key = ":" + unnumbered_text(value) + f" of {sorted(things)}"
        name = self._names.get(key)
        if name is None:
            _refuse_large(value)
            name = self._names[key] = f"{self.prefix}s{len(self.signals) + 1}"
            query = self._query(things, ())
            self.signals[name] = Ask(name, query, self._variables(things), value, edges)
        return self.signals[name]

    def _variables(self, things: frozenset[str]) -> tuple[str, ...]:
        return tuple(sorted(things.intersection(self.bound)))

    def _query(self, things: frozenset[str], where: tuple[b.Bound, ...]) -> b.Query:
        known = self.whole.scope
        own = {k: replace(known.nodes[k], role="named") for k in sorted(things) if k in known.nodes}
        edges = tuple(replace(edge, named=True) for edge in known.edges if edge.key in things)
        pairs = combinations(own, 2) if self.whole.injective else ()
        scope = b.Scope(own, {}, edges, where, frozenset(pairs))
        return b.Query(
            scope,
            b.Result(),
            self.whole.relations,
            self.whole.injective,
            self.whole.ego,
            self.whole.unknown_is_false,
            world=self.whole.world,
        )


def plan_of_steps(query: b.Query, steps: Sequence[BoundStep]) -> Plan:
    """Return an evaluation plan for the temporal conditions of sequence steps.

    It uses the nodes of all steps.
    """
    nodes = {key: node for step in reversed(steps) for key, node in step.scope.nodes.items()}
    edges = tuple(edge for step in steps for edge in step.scope.edges)
    scope = b.Scope(nodes, {}, edges, (), frozenset())
    whole = replace(query, scope=scope, result=b.Result(), steps=(), links=())
    return Plan(whole, tuple(nodes))


def kept_throughout(check: b.BoundCheck) -> b.Bound | None:
    """Return the condition that a check requires in every frame; None for another form of check."""

    def lasting(formula: b.Bound) -> b.Bound | None:
        match formula:
            case b.Tense(word="ALWAYS", operands=(inner,), low=0, high=None):
                return inner
            case b.Operation(word="AND", operands=operands):
                found = tuple(one for one in map(lasting, operands) if one is not None)
                return replace(formula, operands=found) if len(found) == len(operands) else None
            case _:
                return None

    every = all(one.word == "FORALL" for one in check.quantifiers)
    return lasting(check.formula) if every else None


def never_applies(check: b.BoundCheck) -> b.BoundCheck | None:
    """Return the check that the premise of another check is never true; None without a premise.

    It has only the variables of the premise, and those with a ``WHERE``.
    """
    premise = premise_of(check)
    if premise is None:
        return None
    unused = {n for q in check.quantifiers if q.where is None for n in q.nodes} - b.nodes_of(
        premise
    )
    left = ((q, tuple(n for n in q.nodes if n not in unused)) for q in check.quantifiers)
    return replace(
        check,
        scope=replace(
            check.scope,
            nodes={key: one for key, one in check.scope.nodes.items() if key not in unused},
            distinct=frozenset(pair for pair in check.scope.distinct if not unused & {*pair}),
        ),
        quantifiers=tuple(replace(q, nodes=nodes) for q, nodes in left if nodes),
        formula=b.Tense("ALWAYS", (negated(premise),)),
        reset=None,
        gaps="break",
        robustness=False,
        returns=(),
        having=None,
    )


def premise_of(check: b.BoundCheck) -> b.Bound | None:
    """Return the premise of a check that requires a condition in every frame; None without a premise.

    That is the condition before ``IMPLIES``, or else the ``WHERE`` of the quantifiers.
    """

    def before(condition: b.Bound) -> b.Bound | None:
        match condition:
            case b.Operation("IMPLIES", (premise, _)):
                return premise
            case b.Operation("AND", operands):
                found = tuple(one for one in map(before, operands) if one is not None)
                whole = len(found) == len(operands)
                return b.Operation("OR", found, condition.type) if whole else None
            case _:
                return None

    body = kept_throughout(check)
    if body is None:
        return None
    guards = tuple(one.where for one in check.quantifiers if one.where is not None)
    if (premise := before(body)) is not None or not guards:
        return premise
    return guards[0] if len(guards) == 1 else b.Operation("AND", guards, body.type)


def plan_of_returned(check: BoundCheck) -> Plan:
    """Return an empty evaluation plan for the ``RETURN`` values of a check. The caller adds the queries."""
    return Plan(query_of_check(check), variables_of(check), prefix="returned ")


def query_of_check(check: BoundCheck) -> b.Query:
    """Return a query with the settings and the nodes of a check."""
    about = check.relations, check.injective, check.ego, check.unknown_is_false
    return b.Query(check.scope, b.Result(), *about, world=check.world)


def variables_of(check: BoundCheck) -> tuple[str, ...]:
    """Return the keys of all nodes in the quantifiers of a check."""
    return tuple(node for q in check.quantifiers for node in q.nodes)


def asks_of_steps(query: b.Query, steps: Sequence[BoundStep], kept: Iterable[str]) -> list[Ask]:
    """Return a query for each sequence step. The names are ``step 1``, ``step 2`` and so on.

    A query binds all nodes of a step if its conditions need them, else only the kept nodes.
    """
    asks = [_ask_of_step(query, step, kept, n) for n, step in enumerate(steps, start=1)]
    happen = [n for n, step in enumerate(steps) if not step.absent]
    ordered = sorted(happen, key=lambda n: asks[n].loose)
    with_others = _together(query, len(steps))
    found: list[Ask] = []
    for number, step in enumerate(steps):
        before = ordered if step.absent else ordered[: ordered.index(number)]
        after = tuple(asks[n] for n in before if n in with_others[number])
        found.append(replace(asks[number], after=after))
    return found


def tied_in_steps(query: b.Query) -> tuple[frozenset[str], frozenset[str]]:
    """Return the keys of the named nodes, and of the named edges, in the steps of a sequence."""
    happen = [step for step in query.steps if query.spans and not step.absent]
    nodes = (node for step in happen for node in step.scope.nodes.values())
    edges = (edge.key for step in happen for edge in step.scope.edges if edge.named)
    named = (node.key for node in nodes if node.role == "named" or not node.kinds.other)
    return frozenset(named), frozenset(edges)


def _together(query: b.Query, size: int) -> list[frozenset[int]]:
    """For each step of a sequence, return the steps that occur in each match that contains this step."""
    if not query.alternatives:
        return [frozenset(range(size))] * size
    ways = [frozenset(way.steps) for way in query.alternatives]
    return [
        frozenset.intersection(*(way for way in ways if number in way)) for number in range(size)
    ]


def _ask_of_step(query: b.Query, step: BoundStep, kept: Iterable[str], number: int) -> Ask:
    scope = step.scope
    bound = scope.nodes.keys() if step.when else scope.nodes.keys() & set(kept)
    edges = () if step.absent else sorted(edge.key for edge in scope.edges if edge.named)
    pattern = replace(query, scope=scope, result=b.Result(), steps=(), links=())
    return Ask(f"step {number}", pattern, tuple(sorted(bound)), None, tuple(edges))


def _operation(word: str, *operands: b.Bound) -> b.Operation:
    return b.Operation(word, operands, Type.number)


def _less(left: b.Bound, right: b.Bound) -> b.Bound:
    return _operation("-", right, left)


def _greater(left: b.Bound, right: b.Bound) -> b.Bound:
    return _operation("-", left, right)


def _apart(left: b.Bound, right: b.Bound) -> b.Bound:
    return _operation("abs", _operation("-", left, right))


def _equal(left: b.Bound, right: b.Bound) -> b.Bound:
    return _operation("negative", _apart(left, right))


MARGINS: Final[Mapping[str, Callable[[b.Bound, b.Bound], b.Bound]]] = {
    "<": _less,
    "<=": _less,
    ">": _greater,
    ">=": _greater,
    "=": _equal,
    "<>": _apart,
}
"""Comparison sign → margin of the comparison: positive if it is true, negative if it is false."""


def has_margin(comparison: b.Operation) -> bool:
    """True if a condition compares numbers that can change. Such a condition has a margin."""
    constants = b.Value | b.Operation
    return (
        comparison.word in MARGINS
        and all(operand.type is Type.number for operand in comparison.operands)
        and not all(isinstance(part, constants) for part in b.walk(comparison))
    )


def _all(parts: list[b.Bound]) -> b.Bound:
    return parts[0] if len(parts) == 1 else b.Operation("AND", tuple(parts), Type.boolean)


def _two_valued(expression: b.Bound, *, outermost: bool = True) -> b.Bound:  # noqa: PLR0911 - a case each
    """Return a single-frame condition in which comparisons with an unknown value count as false.

    A plain conjunction does not change: unknown is not true.
    """
    match expression:
        case b.Operation("AND", operands):
            parts = tuple(_two_valued(operand, outermost=outermost) for operand in operands)
            return b.Operation("AND", parts, Type.boolean)
        case b.Operation("OR", operands) if outermost:
            parts = tuple(_two_valued(operand) for operand in operands)
            return b.Operation("OR", parts, Type.boolean)
        case b.Operation(word, operands) if word in CONNECTIVES:
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
    """True if a condition compares ``COUNT {…}`` with a constant. Such a condition is never unknown."""
    match expression:
        case b.Operation(operands=(b.BlockValue(word="COUNT"), b.Value(value=value))):
            return value is not None
        case _:
            return False


def plan_text(
    plan: Plan, formula: f.Formula, reset: f.Formula | None, catalog: Catalog | None = None
) -> str:
    """Return an evaluation plan as text: temporal formula and queries. With ``catalog``, also their SQL."""
    lines = [f"formula {formula_text(formula)}"]
    lines += [f"reset {formula_text(reset)}"] if reset is not None else []
    lines += needs_text(plan, catalog)
    return "\n".join(lines)


def needs_text(plan: Plan, catalog: Catalog | None = None) -> list[str]:
    """Return the queries and expressions of a plan as lines of text. With ``catalog``, also their SQL."""
    lines: list[str] = []
    for ask in plan.asks.values():
        where = " AND ".join(value_text(part) for part in ask.query.scope.where) or "TRUE"
        what, told = ("atom", where) if ask.value is None else ("signal", value_text(ask.value))
        lines.append(f"{what} {ask.name}({', '.join(ask.variables)}) = {told}")
        values = () if ask.value is None else (ask.value,)
        lines += [] if catalog is None else sql_text(relation(ask.query, catalog, None, values))
    for test in plan.tests.values():
        lines.append(
            f"test {test.name}({', '.join(test.variables)}) = {value_text(test.expression)}"
        )
    return lines


def ask_text(ask: Ask) -> str:
    """Return a short text that describes a single-frame query in error messages."""
    if ask.value is not None:
        return value_text(ask.value)
    conditions = " AND ".join(value_text(part) for part in ask.query.scope.where)
    return ask.name if ask.name.startswith("step ") else conditions or ", ".join(ask.variables)


def sql_text(statement: SqlStatement) -> list[str]:
    """Return an SQL statement and its parameter values as indented text lines."""
    lines = [f"    {line}" for line in statement.sql.splitlines()]
    return lines + [f"    ${n} = {value!r}" for n, value in enumerate(statement.values, start=1)]


def hold_text(hold: BoundHold) -> str:
    """Return the duration condition of a sequence step as text."""
    inclusive = " INCLUSIVE" if hold.inclusive else ""
    return f"for {hold.comparison} {length_text(hold.length)}{inclusive}"


def link_text(link: StepLink) -> str:
    """Return the time relation between two sequence steps as text, such as ``then within 5s``."""
    after = f" after {length_text(link.after)}" if link.after else ""
    within = f" within {length_text(link.within)}" if link.within else ""
    return f"{link.kind}{after}{within}"


def way_text(way: StepWay) -> str:
    """Return one alternative step sequence of a query as text, such as ``sequence step 1 then step 2``."""
    links = ["", *(f"{link_text(link)} " for link in way.links)]
    steps = (f"{link}step {n + 1}" for link, n in zip(links, way.steps, strict=True))
    return f"sequence {' '.join(steps)}"


def length_text(length: Length) -> str:
    """Return a duration as text."""
    return f"{length.amount}frames" if length.frames else f"{length.amount / 1e9:g}s"


def _refuse_large(value: b.Bound) -> None:
    """Raise an error if an expression has integers that float64 cannot store exactly.

    Single-frame conditions are exact.

    Raises
    ------
    QueryError
    """
    match value:
        case b.NodeAttribute(attribute=attribute) | b.EdgeAttribute(attribute=attribute):
            if attribute.whole:
                raise QueryError(
                    f"values of '{attribute.name}' lie beyond 2^53, and values over time are 64-bit floats",
                    hint="compare it in one frame, such as x.n = 9007199254740993, or import it as text",
                )
        case b.Operation(operands=operands, type=Type.number):
            for operand in operands:
                _refuse_large(operand)
        case _:
            pass
