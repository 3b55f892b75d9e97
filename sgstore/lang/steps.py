"""Sequences: the steps and links of a ``MATCH``, bound; scenarios become the steps that they stand for.

Each step is a scope of its own, about one frame. A node that several steps speak of has the same key in all of
them: it is the same entity.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError
from sgstore.lang import bound as b
from sgstore.lang import over_time as o
from sgstore.lang import syntax as s
from sgstore.lang.conditions import condition, parameter
from sgstore.lang.names import RESERVED, Meaning, Names, ScopeBuilder, Session
from sgstore.lang.parser import parse
from sgstore.lang.standard import patterns
from sgstore.lang.tenses import length, settled
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sgstore.errors import Span

MAX_STEPS: Final = 50
"""Most steps that a sequence may have, those of scenarios in it included."""

SEQUENCES: Final = frozenset({"concept", "scenario"})
"""Kinds of patterns of the library that stand for steps."""


@dataclass(slots=True)
class StepScope(ScopeBuilder):
    """The scope of one step, which may speak of nodes that other steps have bound.

    Attributes
    ----------
    known : dict of str to Node
        What those steps have bound, by key.
    """

    known: dict[str, b.Node] = field(default_factory=dict[str, b.Node])

    def mention(self, key: str) -> None:
        """Take note that a node is spoken of; one of another step becomes one of this step, too."""
        if key not in self.nodes and key in self.known:
            self.nodes[key] = self.known[key]

    def kinds(self, key: str) -> b.Kinds:
        """What a node may be here."""
        return self.nodes[key].kinds if key in self.nodes else self.known[key].kinds

    def the_ego(self, span: Span) -> str:
        """The key of the ego: of the node that is labelled so, here or in another step; or a new one."""
        for node in (*self.nodes.values(), *self.known.values()):
            if not node.kinds.other:
                self.mention(node.key)
                return node.key
        return self.add("ego", b.EGO, span, named=False)


@dataclass(slots=True)
class Sequence:
    """A sequence as it is bound.

    Attributes
    ----------
    session : Session
    known : dict of str to Node
        The nodes that steps have bound and that others may speak of: those with names, and the ego.
    edges : list of Edge
        Those with names.
    ends : dict of str to Node
        The nodes at their ends, named or not.
    meanings : dict of str to Meaning
        What names mean after all steps.
    steps, links : list
    """

    session: Session
    known: dict[str, b.Node] = field(default_factory=dict[str, b.Node])
    edges: list[b.Edge] = field(default_factory=list[b.Edge])
    ends: dict[str, b.Node] = field(default_factory=dict[str, b.Node])
    meanings: dict[str, Meaning] = field(default_factory=dict[str, Meaning])
    steps: list[o.Step] = field(default_factory=list[o.Step])
    links: list[o.Link] = field(default_factory=list[o.Link])

    def scope(self) -> ScopeBuilder:
        """What values of a match speak of: nodes and edges that have names, and the ego."""
        return ScopeBuilder(self.session, nodes=self.ends | self.known, edges=list(self.edges))


@dataclass(frozen=True, slots=True)
class _Written:
    """A step as it stands in the text, with the values of the scenario that it belongs to.

    ``called`` is where that is named, if its own text is in the library.
    """

    step: s.Step
    values: Mapping[str, Any] | None
    name: str
    called: Span | None = None


def bind_sequence(
    sequence: s.Sequence, session: Session, bind_block: Callable[[s.Block, Names], None]
) -> Sequence:
    """The steps of a ``MATCH``.

    Parameters
    ----------
    sequence : syntax.Sequence
    session : Session
    bind_block : function
        Binds paths and a condition; it belongs to the binder.

    Raises
    ------
    QueryError
        A step or a link has no meaning where it stands.
    """
    found = Sequence(session)
    steps, links = _spelled_out(sequence, session, 0)
    if len(steps) > MAX_STEPS:
        session.refuse(f"a sequence has at most {MAX_STEPS} steps", sequence.span)
    _check_absent(steps, links, session)
    for written in steps:
        _bind_step(written, found, bind_block)
    found.links = [_link(link, values, session) for link, values in links]
    return found


def _spelled_out(
    sequence: s.Sequence, session: Session, depth: int
) -> tuple[list[_Written], list[tuple[s.Link, Mapping[str, Any] | None]]]:
    """Steps and links, scenarios being what they stand for."""
    steps: list[_Written] = []
    links: list[tuple[s.Link, Mapping[str, Any] | None]] = []
    for number, step in enumerate(sequence.steps):
        if number:
            links.append((sequence.links[number - 1], None))
        if isinstance(step, s.Step):
            steps.append(_Written(step, None, ""))
            continue
        shipped = _shipped(step, session)
        if shipped is not None:
            inner, between = _spelled_out(shipped, session, depth + 1)
            steps += [replace(w, name=step.name, called=step.name_span) for w in inner]
            links += [(link, {}) for link, _ in between]
            continue
        definition = _scenario(step, session)
        if depth >= MAX_STEPS:
            session.refuse(f"{definition.name}() is defined by itself", step.name_span)
        body = definition.body
        assert isinstance(body, s.Sequence)  # noqa: S101 - it was found as a scenario
        values = _values(step, definition, session)
        inner, between = _spelled_out(body, session, depth + 1)
        steps += [
            replace(w, values={**values, **(w.values or {})}, name=definition.name) for w in inner
        ]
        links += [(link, {**values, **(more or {})}) for link, more in between]
    return steps, links


def _shipped(step: s.ScenarioStep, session: Session) -> s.Sequence | None:
    """The sequence of a pattern of the library; ``None`` if the text defines the name, or nothing has it."""
    name = folded(step.name)
    if name in session.predicates:
        return None
    like = (p for p in patterns().values() if folded(p.name) == name)
    entry = patterns().get(step.name) or next(like, None)  # CutIn and cut_in are two
    if entry is None or entry.kind not in SEQUENCES:
        return None
    names = Names(session, ScopeBuilder(session))
    values = {given.name: _given_text(given.value, names) for given in step.given}
    try:
        statements = parse(entry.written(**values))
    except QueryError as error:
        session.refuse(error.reason, step.span, error.hint)
    found: s.Sequence | None = None
    for statement in statements:
        if isinstance(statement, s.Define):
            session.predicates.setdefault(folded(statement.name), statement)
        elif isinstance(statement, s.Match):
            found = statement.sequence
    return found


def _given_text(value: s.Constant | s.Duration | s.Parameter, names: Names) -> Any:
    if isinstance(value, s.Parameter):
        return parameter(value, names)
    return value.value if isinstance(value, s.Constant) else f"{value.amount:g}{value.unit}"


def _scenario(step: s.ScenarioStep, session: Session) -> s.Define:
    known = {k: d for k, d in session.predicates.items() if isinstance(d.body, s.Sequence)}
    found = known.get(folded(step.name))
    if found is None:
        names = [definition.name for definition in known.values()]
        names += [entry.name for entry in patterns().values() if entry.kind in SEQUENCES]
        session.unknown("scenario", step.name, step.name_span, names)
    return found


def _values(step: s.ScenarioStep, definition: s.Define, session: Session) -> dict[str, Any]:
    """The values of a scenario's parameters: those given, or else their own."""
    formals = {formal.name: formal for formal in definition.parameters}
    names = Names(session, ScopeBuilder(session))
    values: dict[str, Any] = {f.name: _value(f.default) for f in formals.values() if f.default}
    for given in step.given:
        if given.name not in formals:
            session.unknown(f"parameter of {definition.name}", given.name, given.span, formals)
        if isinstance(given.value, s.Parameter):
            values[given.name] = parameter(given.value, names)
        else:
            values[given.name] = _value(given.value)
    missing = [name for name in formals if name not in values]
    if missing:
        session.refuse(
            f"{definition.name} needs a value of {missing[0]}",
            step.span,
            f"write MATCH {definition.name}({missing[0]} = …)",
        )
    return values


def _value(value: s.Constant | s.Duration) -> Any:
    if isinstance(value, s.Constant):
        return value.value
    return f"{value.amount:g}frames" if value.unit == "frames" else value.ns / 1e9


def _check_absent(steps: list[_Written], links: list[tuple[s.Link, Any]], session: Session) -> None:
    """Refuse what must not happen where it has no neighbour to stand beside."""
    for number, written in enumerate(steps):
        if not written.step.absent:
            continue
        before = links[number - 1][0] if number else None
        if before is None:
            session.refuse(
                "a sequence begins with something that happens",
                written.step.span,
                "a frame in which something is not: MATCH … WHERE NOT EXISTS {…}",
            )
        after = links[number][0] if number < len(links) else None
        last = after is None
        if before.kind != "then" or (not last and (before.after or before.within)):
            session.refuse("before NOT MATCH stands THEN alone", before.span, "… THEN NOT MATCH …")
        if last and (before.within is None or before.after is not None):
            session.refuse(
                "a sequence that ends with NOT MATCH says for how long",
                written.step.span,
                "write THEN WITHIN 5s NOT MATCH …",
            )
        if after is not None and after.kind != "then":
            session.refuse("after NOT MATCH stands THEN", after.span)
        if after is not None and steps[number + 1].step.absent:
            session.refuse("between two steps one NOT MATCH", steps[number + 1].step.span)


def _bind_step(
    written: _Written, found: Sequence, bind_block: Callable[[s.Block, Names], None]
) -> None:
    session, step = found.session, written.step
    scope = StepScope(session, known=dict(found.known))
    names = Names(session, scope, dict(found.meanings))
    with _Values(session, written):
        if step.block.paths:
            bind_block(step.block, names)
        elif step.block.where is not None:
            scope.where.append(condition(step.block.where, names))
        where = [part for whole in scope.where for part in _settled_parts(whole, session)]
        hold = _hold(step.hold, names) if step.hold else None
    scope.where = [part for part in where if not b.is_temporal(part)]
    when = tuple(part for part in where if b.is_temporal(part))
    found.steps.append(o.Step(scope.finished(), when, hold, step.absent, step.span))
    if step.absent:
        return
    shared = {k: n for k, n in scope.nodes.items() if n.role == "named" or not n.kinds.other}
    found.known |= {k: n for k, n in shared.items() if k not in found.known}
    named = [edge for edge in scope.edges if edge.named]
    found.edges += named
    found.ends |= {end: scope.nodes[end] for edge in named for end in (edge.src, edge.dst)}
    found.meanings |= names.meanings
    _name_step(step, found)


def _settled_parts(expression: b.Bound, session: Session) -> Iterator[b.Bound]:
    if isinstance(expression, b.Operation) and expression.word == "AND":
        for operand in expression.operands:
            yield from _settled_parts(operand, session)
    else:
        yield settled(expression, session)


def _name_step(step: s.Step, found: Sequence) -> None:
    if step.name is None:
        return
    if step.name in found.meanings or step.name in {*RESERVED, "ego"}:
        found.session.refuse(f"'{step.name}' is bound already", step.span)
    found.meanings[step.name] = Meaning(value=b.Moment(len(found.steps) - 1))


def _hold(hold: s.Hold, names: Names) -> o.Hold:
    return o.Hold(hold.comparison, length(hold.duration, names), hold.inclusive)


def _link(link: s.Link, values: Mapping[str, Any] | None, session: Session) -> o.Link:
    names = Names(session, ScopeBuilder(session))
    with _Values(session, _Written(_NOTHING, values, "")):
        after = length(link.after, names) if link.after else None
        within = length(link.within, names) if link.within else None
    if after and within:
        if after.frames != within.frames:
            session.refuse("a bound is either in time or in frames", link.span)
        if within.amount < after.amount:
            session.refuse("the bound ends before it begins", link.span)
    return o.Link(link.kind, after, within)


_NOTHING: Any = None


class _Values:
    """While a scenario's text is bound, its parameters are its own, and its errors say its name."""

    def __init__(self, session: Session, written: _Written) -> None:
        self._session, self._written = session, written
        self._outside = session.parameters

    def __enter__(self) -> None:
        if self._written.values is not None:
            self._session.parameters = self._written.values

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._session.parameters = self._outside
        if self._written.name and isinstance(error, QueryError):
            raise type(error)(
                f"in {self._written.name}(): {error.reason}",
                text=self._session.text,
                span=self._written.called or error.span,
                hint=error.hint,
            ) from None
