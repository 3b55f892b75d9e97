"""Binder of sequences (steps of a ``MATCH``, with links). Named scenarios are replaced by their steps.

Each step has its own scope, about one frame. A node of several steps has the same key in all of them: it is
the same entity.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind._expressions import parameter
from sgstore.lang.bind._renaming import (
    names_of_group,
    names_written,
    own_names,
    renamed,
    values_given,
)
from sgstore.lang.bind._symbols import RESERVED, ScopeBuilder, Session, Symbol, SymbolTable
from sgstore.lang.bind._temporal import length, settled
from sgstore.lang.library import patterns
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence

    from sgstore.errors import TextSpan
    from sgstore.lang.library import NamedPattern

MAX_STEPS: Final = 50
"""Largest number of steps in a sequence, including the steps of its scenarios."""

SEQUENCES: Final = frozenset({"concept", "scenario"})
"""Kinds of library patterns that can be used as steps."""


@dataclass(slots=True)
class StepScope(ScopeBuilder):
    """Nodes and conditions of a sequence step while its names are resolved.

    Attributes
    ----------
    known : dict of str to Node
        Nodes bound by other steps, by key.
    """

    known: dict[str, b.Node] = field(default_factory=dict[str, b.Node])

    def mention(self, key: str) -> None:
        """Record that this step uses a node of another step. Ignore a node that the step already has."""
        if key not in self.nodes and key in self.known:
            self.nodes[key] = self.known[key]

    def kinds(self, key: str) -> b.Kinds:
        """Return the kinds of node that a variable can match in this step."""
        return self.nodes[key].kinds if key in self.nodes else self.known[key].kinds

    def the_ego(self, span: TextSpan) -> str:
        """Return the key of the ego node of the sequence. If no step has it, add it to this step."""
        for node in (*self.nodes.values(), *self.known.values()):
            if not node.kinds.other:
                self.mention(node.key)
                return node.key
        return self.add("ego", b.ego_kinds(), span, named=False)


@dataclass(slots=True)
class BoundSequence:
    """Sequence of steps, with nodes and links, while its names are resolved.

    Attributes
    ----------
    session : Session
    known : dict of str to Node
        Nodes that later steps can use: named nodes and the ego.
    edges : list of Edge
        Named edges.
    ends : dict of str to Node
        Nodes at the ends of these edges, named or not.
    meanings : dict of str to Symbol
        Symbols by name, after all steps.
    partial : set of str
        Names that are bound only in some of the possible sequences.
    steps : list
    ways : list
        Sequences that the steps stand for.
    """

    session: Session
    known: dict[str, b.Node] = field(default_factory=dict[str, b.Node])
    edges: list[b.Edge] = field(default_factory=list[b.Edge])
    ends: dict[str, b.Node] = field(default_factory=dict[str, b.Node])
    meanings: dict[str, Symbol] = field(default_factory=dict[str, Symbol])
    partial: set[str] = field(default_factory=set[str])
    steps: list[b.BoundStep] = field(default_factory=list[b.BoundStep])
    ways: list[b.StepWay] = field(default_factory=list[b.StepWay])

    def scope(self) -> ScopeBuilder:
        """Return the nodes and edges that ``RETURN`` can use: those with names, and the ego."""
        return ScopeBuilder(self.session, nodes=self.ends | self.known, edges=list(self.edges))

    def take_in_ego(self, told: ScopeBuilder) -> None:
        """If the query uses the ego, but no required step has it, add it to the last one.

        ``told`` is the scope of the values of a match.
        """
        key = self.session.the_ego
        if key is None:
            return
        for way in self.ways:
            happen = way.happen
            if not any(key in self.steps[number].scope.nodes for number in happen):
                self._take_in(key, happen[-1], told)

    def _take_in(self, key: str, number: int, told: ScopeBuilder) -> None:
        spoken_of = [scope.nodes for scope in (told, *(step.scope for step in self.steps))]
        told.nodes[key] = ego = next(nodes[key] for nodes in spoken_of if key in nodes)
        last = self.steps[number]
        pairs = {(other, key) for other in last.scope.nodes} if self.session.injective else set()
        scope = replace(
            last.scope,
            nodes={**last.scope.nodes, key: ego},
            distinct=last.scope.distinct | pairs,
        )
        self.steps[number] = replace(last, scope=scope)


@dataclass(frozen=True, slots=True)
class _Written:
    """Step of a sequence in the syntax tree, with the parameter values of its scenario.

    ``called`` is the place of the call, if the text of the scenario is in the library.
    """

    step: s.StepClause
    values: Mapping[str, Any] | None
    name: str
    called: TextSpan | None = None


@dataclass(frozen=True, slots=True)
class _WrittenSteps:
    """Steps of a sequence in the syntax tree, with the links between neighbouring steps."""

    steps: list[_Written | _WrittenGroup]
    links: list[tuple[s.LinkClause, Mapping[str, Any] | None]]

    def changed(self, change: Callable[[_Written], _Written]) -> _WrittenSteps:
        """Return a copy of the sequence in which each step is replaced by the result of a function."""
        return _WrittenSteps(
            [
                change(one)
                if isinstance(one, _Written)
                else replace(one, alternatives=[each.changed(change) for each in one.alternatives])
                for one in self.steps
            ],
            self.links,
        )

    def given(self, values: Mapping[str, Any]) -> _WrittenSteps:
        """Return a copy of the sequence in which steps and links have additional parameter values.

        Existing values stay.
        """
        links: list[tuple[s.LinkClause, Mapping[str, Any] | None]] = [
            (link, {**values, **(more or {})}) for link, more in self.links
        ]
        steps = [
            replace(one, values={**values, **(one.values or {})})
            if isinstance(one, _Written)
            else replace(one, alternatives=[each.given(values) for each in one.alternatives])
            for one in self.steps
        ]
        return _WrittenSteps(steps, links)

    def flat(self) -> Iterator[_Written]:
        """Yield all steps of the sequence in reading order, including those inside groups."""
        for one in self.steps:
            if isinstance(one, _Written):
                yield one
            else:
                for each in one.alternatives:
                    yield from each.flat()


@dataclass(frozen=True, slots=True)
class _WrittenGroup:
    """Group in brackets: alternative step sequences that repeat a number of times.

    ``fresh`` are the variables of the group alone. If there are some, each repetition has its own steps
    (``rounds``) and its own bindings of these variables.
    """

    group: s.GroupStep
    alternatives: list[_WrittenSteps]
    fresh: frozenset[str] = frozenset()

    @property
    def rounds(self) -> list[list[_WrittenSteps]]:
        """Alternatives of the group: one list for each repetition if repetitions have own steps, else one."""
        size = len(self.alternatives) // (self.group.high if self.fresh else 1)
        every = self.alternatives
        return [every[first : first + size] for first in range(0, len(every), size)]


def bind_sequence(
    sequence: s.SequenceClause,
    session: Session,
    bind_block: Callable[[s.Block, SymbolTable], None],
    returned: frozenset[str] = frozenset(),
) -> BoundSequence:
    """Resolve the steps and links of a ``MATCH``. Named scenarios are replaced by their steps.

    Parameters
    ----------
    sequence : syntax.BoundSequence
    session : Session
    bind_block : function
        Function of the binder that binds paths and a condition.
    returned : frozenset of str
        Variables that ``RETURN`` uses.

    Raises
    ------
    QueryError
        A step or a link is not allowed at its place.
    """
    found = BoundSequence(session)
    written = _spelled_out(sequence, session, 0, returned)
    ways = _ways(written, [], sequence.span, session)
    for steps, links in ways:
        _check_absent(steps, links, session)
    _bind_steps(written, found, bind_block)
    numbers = {id(step): number for number, step in enumerate(written.flat())}
    bound: dict[int, b.StepLink] = {}
    for steps, links in ways:
        for link, values in links:
            if id(link) not in bound:
                bound[id(link)] = _link(link, values, session)
        told = tuple(bound[id(link)] for link, _ in links)
        happen = tuple(numbers[id(one)] for one in steps if not one.step.absent)
        found.ways.append(b.StepWay(tuple(numbers[id(one)] for one in steps), happen, told))
    return found


_Way = tuple[list[_Written], list[tuple[s.LinkClause, "Mapping[str, Any] | None"]]]

MAX_WAYS: Final = 100
"""Largest number of sequences that an expression of steps can stand for."""


def _ways(
    written: _WrittenSteps, before: list[_Way], span: TextSpan, session: Session
) -> list[_Way]:
    """Return all plain sequences that a sequence with groups can mean.

    Each one is appended to each of the given beginnings.
    """
    found = before or [([], [])]
    for number, one in enumerate(written.steps):
        if number:
            found = [(steps, [*links, written.links[number - 1]]) for steps, links in found]
        if isinstance(one, _Written):
            found = [([*steps, one], links) for steps, links in found]
        else:
            found = _ways_on(one, found, session)
        if len(found) > MAX_WAYS:
            reason = f"these steps expand to more than {MAX_WAYS} sequences"
            session.refuse(reason, span, "repeat fewer steps, or each step less often")
    if any(len(steps) > MAX_STEPS for steps, _ in found):
        session.refuse(f"a sequence has at most {MAX_STEPS} steps", span)
    return found


def _ways_on(written: _WrittenGroup, before: list[_Way], session: Session) -> list[_Way]:
    """Extend step sequences by a group: one result for each alternative and number of repetitions."""
    group, found = written.group, list[_Way]()
    again = s.LinkClause("then", None, None, group.span)
    open_ended, rounds = before, written.rounds
    for number in range(1, group.high + 1):
        if number > 1:
            open_ended = [(steps, [*links, (again, None)]) for steps, links in open_ended]
        open_ended = [
            way
            for one in rounds[(number - 1) % len(rounds)]
            for way in _ways(one, open_ended, group.span, session)
        ]
        if number >= group.low:
            found += open_ended
        if len(open_ended) + len(found) > 2 * MAX_WAYS:
            break
    return found


def _bind_steps(
    written: _WrittenSteps,
    found: BoundSequence,
    bind_block: Callable[[s.Block, SymbolTable], None],
    *,
    again: bool = False,
) -> None:
    """Resolve the steps of a sequence in reading order. ``again``: True if a group repeats these steps."""
    for one in written.steps:
        if isinstance(one, _Written):
            if again and one.step.name is not None:
                found.session.refuse(
                    f"'{one.step.name}' names a repeated step",
                    one.step.span,
                    "name a step before or after the brackets, or write the repetitions one by one",
                )
            _bind_step(one, found, bind_block)
        else:
            for alternatives in one.rounds:
                _forget(one.fresh, found)
                _bind_group(alternatives, found, bind_block, again=again or one.group.high > 1)
            _forget(one.fresh, found)


def _forget(names: frozenset[str], found: BoundSequence) -> None:
    """Remove the variables of a group from the known names, so that a repetition can define them again."""
    symbols = {name: found.meanings.pop(name) for name in names & found.meanings.keys()}
    keys = {symbol.node or symbol.edge for symbol in symbols.values()}
    found.known = {key: node for key, node in found.known.items() if key not in keys}
    found.edges = [edge for edge in found.edges if edge.key not in keys]
    found.partial -= names


def _bind_group(
    alternatives: Sequence[_WrittenSteps],
    found: BoundSequence,
    bind_block: Callable[[s.Block, SymbolTable], None],
    *,
    again: bool,
) -> None:
    """Resolve the alternatives of a group of steps.

    Later steps can use only names that all alternatives define.
    """
    session = found.session
    known, meanings, keys = dict(found.known), dict(found.meanings), set(session.keys)
    edges, ends, partial = list(found.edges), dict(found.ends), set(found.partial)
    told: list[tuple[dict[str, b.Node], dict[str, Symbol], set[str]]] = []
    taken = set(keys)
    for one in alternatives:
        # The same name is the same node in all alternatives, so it has the same key.
        found.known, found.meanings, session.keys = dict(known), dict(meanings), set(keys)
        found.edges, found.ends, found.partial = list(edges), dict(ends), set(partial)
        _bind_steps(one, found, bind_block, again=again)
        told.append((found.known, found.meanings, found.partial))
        taken |= session.keys
    session.keys, found.edges, found.ends = taken, edges, ends
    every = set.intersection(*(set(bound) for bound, _, _ in told))
    found.known = {
        key: _either([bound[key] for bound, _, _ in told]) for key in told[0][0] if key in every
    }
    found.meanings, found.partial = dict(meanings), set(partial).union(*(p for _, _, p in told))
    for name, symbol in (item for _, means, _ in told for item in means.items()):
        if symbol.node in every or name in meanings or symbol.value is not None:
            found.meanings.setdefault(name, symbol)
        else:
            found.partial.add(name)


def _either(nodes: list[b.Node]) -> b.Node:
    """Return a node that allows every kind of several nodes with the same name."""
    kinds = nodes[0].kinds
    for node in nodes[1:]:
        kinds = kinds | node.kinds
    return replace(nodes[0], kinds=kinds)


def _spelled_out(
    sequence: s.SequenceClause, session: Session, depth: int, outside: frozenset[str]
) -> _WrittenSteps:
    """Return the steps and links of a sequence, in which steps replace each named scenario.

    ``outside`` are the variables that the query uses outside the sequence.
    """
    steps: list[_Written | _WrittenGroup] = []
    links: list[tuple[s.LinkClause, Mapping[str, Any] | None]] = []
    taken = names_written(sequence)
    for number, step in enumerate(sequence.steps):
        if number:
            links.append((sequence.links[number - 1], None))
        if isinstance(step, s.StepClause):
            steps.append(_Written(step, None, ""))
            continue
        if isinstance(step, s.GroupStep):
            others = (*sequence.steps[:number], *sequence.steps[number + 1 :])
            around = outside | names_written(replace(sequence, steps=others))
            fresh = names_of_group(step) - around if step.high > 1 else frozenset[str]()
            alternatives = [
                _spelled_out(one, session, depth, around)
                for _ in range(step.high if fresh else 1)
                for one in step.alternatives
            ]
            steps.append(_WrittenGroup(step, alternatives, fresh))
            continue
        shipped = _shipped(step, session)
        if shipped is not None:
            inner = _spelled_out(shipped, session, depth + 1, outside | taken)
            inner = _with_own_names(step, inner, _parameters_shipped(step), taken, session)
            about = {"name": step.name, "called": step.name_span}
            steps += inner.changed(lambda one, about=about: replace(one, **about)).steps
            links += [(link, {}) for link, _ in inner.links]
            continue
        definition = _scenario(step, session)
        if depth >= MAX_STEPS:
            session.refuse(f"{definition.name}() is defined by itself", step.name_span)
        body = definition.body
        assert isinstance(body, s.SequenceClause)  # noqa: S101 - it was found as a scenario
        values = _values(step, definition, session)
        inner = _spelled_out(body, session, depth + 1, outside | taken)
        formals = (formal.name for formal in definition.parameters)
        inner = _with_own_names(step, inner, formals, taken, session).given(values)
        called = definition.name
        steps += inner.changed(lambda one, called=called: replace(one, name=called)).steps
        links += inner.links
    return _WrittenSteps(steps, links)


def _with_own_names(
    step: s.ScenarioStep,
    inner: _WrittenSteps,
    parameters: Iterable[str],
    taken: frozenset[str],
    session: Session,
) -> _WrittenSteps:
    """Return the steps of a named pattern. Variables have the names that the call gives them."""
    names = own_names(step, [one.step for one in inner.flat()], parameters, taken, session)
    return inner.changed(lambda one: replace(one, step=renamed(one.step, names)))


def _entry(step: s.ScenarioStep) -> NamedPattern | None:
    name = normalize_name(step.name)
    like = (p for p in patterns().values() if normalize_name(p.name) == name)
    return patterns().get(step.name) or next(like, None)  # CutIn and cut_in are different patterns


def _parameters_shipped(step: s.ScenarioStep) -> dict[str, str]:
    entry = _entry(step)
    return {} if entry is None else {p.name: p.default for p in entry.parameters.values()}


def _shipped(step: s.ScenarioStep, session: Session) -> s.SequenceClause | None:
    """Return the steps of a pattern from the query library.

    ``None`` if the query defines the name or it is unknown.
    """
    entry = None if normalize_name(step.name) in session.predicates else _entry(step)
    if entry is None or entry.kind not in SEQUENCES:
        return None
    names = SymbolTable(session, ScopeBuilder(session))
    chosen = values_given(step, _parameters_shipped(step), session)
    values = {given.name: _given_text(given.value, names) for given in chosen}
    try:
        statements = parse(entry.written(**values))
    except QueryError as error:
        session.refuse(error.reason, step.span, error.hint)
    found: s.SequenceClause | None = None
    for statement in statements:
        if isinstance(statement, s.Define):
            session.predicates.setdefault(normalize_name(statement.name), statement)
        elif isinstance(statement, s.MatchClause):
            found = statement.sequence
    return found


def _given_text(value: s.Given, names: SymbolTable) -> Any:
    if isinstance(value, s.Parameter):
        return parameter(value, names)
    return f"{value.amount:g}{value.unit}" if isinstance(value, s.Duration) else _value(value)


def _scenario(step: s.ScenarioStep, session: Session) -> s.Define:
    known = {k: d for k, d in session.predicates.items() if isinstance(d.body, s.SequenceClause)}
    found = known.get(normalize_name(step.name))
    if found is None:
        names = [definition.name for definition in known.values()]
        names += [entry.name for entry in patterns().values() if entry.kind in SEQUENCES]
        session.unknown("scenario", step.name, step.name_span, names)
    return found


def _values(step: s.ScenarioStep, definition: s.Define, session: Session) -> dict[str, Any]:
    """Return the parameter values of a scenario call: parameter name → argument or default value."""
    formals = {formal.name: formal for formal in definition.parameters}
    names = SymbolTable(session, ScopeBuilder(session))
    values: dict[str, Any] = {f.name: _value(f.default) for f in formals.values() if f.default}
    for given in values_given(step, dict.fromkeys(formals, ""), session):
        if isinstance(given.value, s.Parameter):
            values[given.name] = parameter(given.value, names)
        else:
            values[given.name] = _value(given.value)
    missing = [name for name in formals if name not in values]
    strange = (one for one in step.given if not isinstance(one.value, s.Variable))
    if missing and all(one.name in formals for one in strange):  # other errors are reported later
        session.refuse(
            f"{definition.name} needs a value of {missing[0]}",
            step.span,
            f"write MATCH {definition.name}({missing[0]} = …)",
        )
    return values


def _value(value: s.Given) -> Any:
    if isinstance(value, s.Constant):
        return value.value
    assert isinstance(value, s.Duration)  # noqa: S101 - other types were handled before
    return f"{value.amount:g}frames" if value.unit == "frames" else value.ns / 1e9


def _check_absent(
    steps: list[_Written], links: list[tuple[s.LinkClause, Any]], session: Session
) -> None:
    """Raise an error if ``NOT MATCH`` is at a wrong place of a sequence, or next to a wrong link."""
    for number, written in enumerate(steps):
        if not written.step.absent:
            continue
        before = links[number - 1][0] if number else None
        if before is None:
            session.refuse(
                "a sequence cannot begin with NOT MATCH",
                written.step.span,
                "write MATCH … WHERE NOT EXISTS {…} for a frame without a pattern",
            )
        after = links[number][0] if number < len(links) else None
        last = after is None
        if before.kind != "then" or (not last and (before.after or before.within)):
            session.refuse("before NOT MATCH stands THEN alone", before.span, "… THEN NOT MATCH …")
        if last and (before.within is None or before.after is not None):
            session.refuse(
                "a sequence that ends with NOT MATCH needs a duration",
                written.step.span,
                "write THEN WITHIN 5s NOT MATCH …",
            )
        if after is not None and after.kind != "then":
            session.refuse("after NOT MATCH stands THEN", after.span)
        if after is not None and steps[number + 1].step.absent:
            session.refuse("write one NOT MATCH between two steps", steps[number + 1].step.span)


def _bind_step(
    written: _Written, found: BoundSequence, bind_block: Callable[[s.Block, SymbolTable], None]
) -> None:
    session, step = found.session, written.step
    for name in sorted(found.partial & names_written(s.SequenceClause((step,), (), step.span))):
        session.refuse(
            f"'{name}' is bound only in some alternatives of the steps before",
            written.called or step.span,
            "bind it in all alternatives, or before them",
        )
    scope = StepScope(session, known=dict(found.known))
    names = SymbolTable(session, scope, dict(found.meanings))
    with _parameters(session, written.values, written.name, written.called):
        if step.block.paths:
            bind_block(step.block, names)
        elif step.block.where is not None:
            scope.where.append(names.condition(step.block.where))
        parts = [part for whole in scope.where for part in b.conjuncts(whole)]
        where = [settled(part, session) for part in parts]
        hold = _hold(step.hold, names) if step.hold else None
    scope.where = [part for part in where if not b.is_temporal(part)]
    when = tuple(part for part in where if b.is_temporal(part))
    found.steps.append(b.BoundStep(scope.finished(), when, hold, step.absent, step.span))
    if step.absent:
        return
    shared = {k: n for k, n in scope.nodes.items() if n.role == "named" or not n.kinds.other}
    found.known |= {k: n for k, n in shared.items() if k not in found.known}
    named = [edge for edge in scope.edges if edge.named]
    found.edges += named
    found.ends |= {end: scope.nodes[end] for edge in named for end in (edge.src, edge.dst)}
    found.meanings |= names.meanings
    _name_step(step, found)


def _name_step(step: s.StepClause, found: BoundSequence) -> None:
    if step.name is None:
        return
    if step.name in found.meanings or step.name in {*RESERVED, "ego"}:
        found.session.refuse(f"'{step.name}' is bound already", step.span)
    found.meanings[step.name] = Symbol(value=b.StepTime(len(found.steps) - 1))


def _hold(hold: s.HoldClause, names: SymbolTable) -> b.BoundHold:
    return b.BoundHold(hold.comparison, length(hold.duration, names), hold.inclusive)


def _link(link: s.LinkClause, values: Mapping[str, Any] | None, session: Session) -> b.StepLink:
    names = SymbolTable(session, ScopeBuilder(session))
    with _parameters(session, values):
        after = length(link.after, names) if link.after else None
        within = length(link.within, names) if link.within else None
    if after and within:
        if after.frames != within.frames:
            session.refuse("a bound must be in time or in frames, not both", link.span)
        if within.amount < after.amount:
            session.refuse("the end of the bound is before its start", link.span)
    return b.StepLink(link.kind, after, within)


@contextmanager
def _parameters(
    session: Session,
    values: Mapping[str, Any] | None,
    name: str = "",
    called: TextSpan | None = None,
) -> Generator[None]:
    """Context manager in which names of a scenario are resolved with its own parameter values."""
    outside = session.parameters, session.shipped
    session.shipped = called is not None
    if values is not None:
        session.parameters = values
    try:
        yield
    except QueryError as error:
        if not name:
            raise
        reason, span = f"in {name}(): {error.reason}", called or error.span
        raise type(error)(reason, text=session.text, span=span, hint=error.hint) from None
    finally:
        session.parameters, session.shipped = outside
