"""Symbol table of the query language: the names known at a place of the query, and their meanings.

There are two chains from the inside out. *Names*: a block can use the names around it, the body of a
predicate can use only its parameters. *Scopes* hold nodes: a node used in an inner scope becomes an outer
node of every scope between.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, Final, NoReturn

from sgstore.errors import QueryError, QueryNameError
from sgstore.lang.bind._in_range import scopes_of
from sgstore.lang.catalog import PAIR_NAMES, RECORDED_OWN, TOLERANCE_NS, Type, topic_attribute
from sgstore.lang.ir import (
    Bound,
    Edge,
    FrameAttribute,
    Kinds,
    Node,
    Scope,
    ego_kinds,
    same_chain,
    with_operands,
)
from sgstore.lang.library import predicates
from sgstore.lang.syntax import condition_hint, hint_at, variable_hint
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.errors import TextSpan
    from sgstore.lang import ir as b
    from sgstore.lang.catalog import Catalog, TableFacts, TopicFacts, TraceFacts
    from sgstore.lang.syntax.tree import Define


THE_EGO: Final = "ego"
"""Name that is always bound to the ego of the frame."""

RESERVED: Final = frozenset({"env", "frame", "trace"})
"""Reserved names, such as ``frame``, that have attributes but are not nodes."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """Meaning of a name in a query: a node, an edge, or a value."""

    node: str | None = None
    edge: str | None = None
    value: Bound | None = None


Binder = Callable[[Any, "SymbolTable"], Bound]
"""Function that binds one kind of expression."""

Binders = Mapping[type, Binder]


@dataclass(slots=True)
class Session:
    """Shared state while the names of a query are resolved.

    Attributes
    ----------
    text : str
        Text of the query, for messages.
    parameters : mapping of str to value
    binders : mapping of type to Binder
        Binder of each kind of expression. They are passed as arguments, because calls, blocks and temporal
        operators contain expressions, and expressions contain them.
    predicates : dict of str to Define
        Definitions by folded name.
    injective : bool
        True if different nodes of a pattern must be bound to different nodes.
    used : set of str
        Parameters that the query uses.
    relations : set of str
        Relations that the query names.
    keys : set of str
        Used keys in lower case, because the database ignores case.
    calls : list of str
        Predicates whose bodies are being bound.
    classed : tuple of str
        Abstractions whose frame classes are in the store.
    tables : mapping of str to TableFacts
        User tables by name.
    traces : tuple of TraceFacts
        Traces of the store.
    own : mapping of str to Type
        User-defined attributes, by name.
    topics : mapping of str to TopicFacts
        Topics of the recordings, by name.
    tolerance_ns : int or None
        Largest time between a message and a frame, if ``topic()`` has none; ``None`` means unlimited.
    part : bool
        True if the store is a part of a collection: see :attr:`sgstore.lang.catalog.Catalog.part`.
    online : bool
        True if later frames are unknown.
    dropped : set of str
        Names that a ``WITH`` does not pass on.
    maybe : set of str
        Keys of nodes of an ``OPTIONAL MATCH``, which may be NULL.
    the_ego : str or None
        Key of the ego, after its first use as ``ego``.
    numbers, blocks : int
        Numbers of unnamed nodes and edges, and of blocks, so far.
    beyond : Scopes
        Relation scopes of the traces, if a statement uses data beyond the graphs; otherwise empty.
    kinds_left : dict of str to Kinds
        Kinds that the edges of a recording leave for each node.
    strict : bool
        True if all graphs are of recordings, so that impossible patterns are errors. ``USING UNKNOWN false``
        accepts them.
    doubts : list of str
        Notes on parts of the query that never hold, or always.
    shipped : bool
        True in a sequence of the library, whose text is not that of the query.
    checks : bool
        True in a ``CHECK``, where a node with the label ``Ego`` in braces is the node ``ego``.
    """

    text: str
    parameters: Mapping[str, Any]
    binders: Binders
    predicates: dict[str, Define] = field(default_factory=dict[str, "Define"])
    injective: bool = True
    used: set[str] = field(default_factory=set[str])
    relations: set[str] = field(default_factory=set[str])
    keys: set[str] = field(default_factory=set[str])
    calls: list[str] = field(default_factory=list[str])
    written: dict[b.Bound, str] = field(default_factory=dict["b.Bound", str])
    classed: tuple[str, ...] = ()
    tables: Mapping[str, TableFacts] = field(default_factory=dict[str, "TableFacts"])
    traces: tuple[TraceFacts, ...] = ()
    own: Mapping[str, Type] = field(default_factory=dict[str, Type])
    own_edges: Mapping[str, Type] = field(default_factory=dict[str, Type])
    topics: Mapping[str, TopicFacts] = field(default_factory=dict[str, "TopicFacts"])
    tolerance_ns: int | None = TOLERANCE_NS
    part: bool = False
    online: bool = False
    dropped: set[str] = field(default_factory=set[str])
    maybe: set[str] = field(default_factory=set[str])
    the_ego: str | None = None
    numbers: int = 0
    blocks: int = 0
    beyond: b.Scopes = ()
    kinds_left: dict[str, Kinds] = field(default_factory=dict[str, "Kinds"])
    strict: bool = True
    doubts: list[str] = field(default_factory=list[str])
    shipped: bool = False
    checks: bool = False

    def ask(self, catalog: Catalog) -> None:
        """Copy the known names (attributes, tables, traces) from the catalog of a store."""
        self.classed, self.tables, self.traces = catalog.classed, catalog.tables, catalog.traces
        self.own = {**RECORDED_OWN, **catalog.own}
        self.own_edges, self.part = catalog.own_edges, catalog.part
        self.online, self.topics = catalog.online, catalog.topics
        others = catalog.names and catalog.names.get("relation")
        self.strict = not (catalog.part or others or any(one.reach is None for one in self.traces))

    def look_beyond(self, catalog: Catalog, *, world: bool) -> None:
        """Load the pair settings of all traces if the statement uses entities outside the scene graphs."""
        if world and (catalog.world or catalog.online):
            self.beyond = scopes_of(self.traces)

    def key(self, name: str | None) -> str:
        """Return an unused key for a node or edge: its name if possible; ``#1``, ``#2``, … without a name."""
        self.numbers += name is None
        wanted = name or f"#{self.numbers}"
        key, copy = wanted, 2
        while key.lower() in self.keys:
            key, copy = f"{wanted}~{copy}", copy + 1
        self.keys.add(key.lower())
        return key

    def refuse(self, reason: str, span: TextSpan, hint: str | None = None) -> NoReturn:
        """Raise a :class:`QueryError` that marks the faulty part of the query text."""
        raise QueryError(reason, text=self.text, span=span, hint=hint)

    def impossible(self, reason: str, span: TextSpan, hint: str) -> None:
        """Raise an error for a part that no recording can match. Inside a predicate, add a note instead."""
        if self.strict and not self.calls and not self.shipped:
            self.refuse(reason, span, hint)
        self.doubt(f"{reason}; {hint}")

    def doubt(self, note: str) -> None:
        """Add a note about a part of the query, unless it comes from the query library."""
        written = (self.predicates[normalize_name(name)] for name in self.calls)
        library = predicates() if self.calls else {}
        shipped = any(library.get(normalize_name(one.name)) is one for one in written)
        if not shipped and not self.shipped:
            self.doubts.append(note)

    def unknown(
        self, what: str, name: str, span: TextSpan, known: Iterable[str], hint: str | None = None
    ) -> NoReturn:
        """Raise a :class:`QueryNameError` for an unknown name, with similar or known names as a hint."""
        hint = hint or hint_at(name, known)
        raise QueryNameError(f"unknown {what} '{name}'", text=self.text, span=span, hint=hint)


@dataclass(slots=True)
class ScopeBuilder:
    """Nodes, edges and conditions of a pattern while its names are resolved."""

    session: Session
    parent: ScopeBuilder | None = None
    nodes: dict[str, Node] = field(default_factory=dict[str, Node])
    outer: dict[str, Kinds] = field(default_factory=dict[str, Kinds])
    edges: list[Edge] = field(default_factory=list[Edge])
    where: list[Bound] = field(default_factory=list[Bound])

    @property
    def top(self) -> ScopeBuilder:
        """Outermost pattern: that of the ``MATCH`` around a pattern in braces."""
        return self.parent.top if self.parent else self

    def kinds(self, key: str) -> Kinds:
        """Return the kinds of node that a variable can match in this pattern."""
        return self.nodes[key].kinds if key in self.nodes else self.outer[key]

    def mention(self, key: str) -> None:
        """Record that this pattern in braces uses a node of an outer pattern. Ignore a node of its own."""
        if key in self.nodes or key in self.outer or self.parent is None:
            return
        self.parent.mention(key)
        self.outer[key] = self.parent.kinds(key)

    def narrow(self, key: str, kinds: Kinds) -> None:
        """Restrict a node to some kinds within this pattern only."""
        if key in self.outer:
            self.outer[key] = self.outer[key] & kinds
        else:
            node = self.nodes[key]
            self.nodes[key] = replace(node, kinds=node.kinds & kinds)

    def add(self, name: str | None, kinds: Kinds, span: TextSpan, *, named: bool) -> str:
        """Add a node to the pattern and return its key."""
        key = self.session.key(name)
        self.nodes[key] = Node(key, kinds, "named" if named else "unnamed", span)
        return key

    def the_ego(self, span: TextSpan) -> str:
        """Return the key of the ego node of the pattern. If the pattern has none, add it."""
        for node in self.nodes.values():
            if not node.kinds.other:
                return node.key
        return self.add(THE_EGO, ego_kinds(), span, named=False)

    def finished(self) -> Scope:
        """Return the finished pattern, with the pairs of its nodes that must differ."""
        where = tuple(self.where)
        return Scope(self.nodes, self.outer, tuple(self.edges), where, self.distinct())

    def distinct(self) -> frozenset[tuple[str, str]]:
        """Return the pairs of nodes that must differ, here or with nodes of outer patterns."""
        if not self.session.injective:
            return frozenset()
        pairs = {*combinations(self.nodes, 2), *product(self.nodes, self.outer)}
        for a, other in sorted(pairs):
            if not self.kinds(a).other and not self.kinds(other).other:
                self.session.refuse(
                    "two nodes are the ego, but different nodes of a pattern cannot be equal",
                    self.nodes[a].span,
                    "a frame has one ego: write (ego) in both places, or USING NODES any",
                )
        mates = {pair for one in same_chain(self.where) for pair in (one, one[::-1])}
        return frozenset(pairs - mates)


@dataclass(slots=True)
class SymbolTable:
    """Names that a part of a query can use, and the pattern to which this part belongs.

    Attributes
    ----------
    session : Session
    scope : ScopeBuilder
    meanings : dict of str to Symbol
    parent : SymbolTable or None
        Enclosing names, also visible.
    aggregates : bool
        True if aggregates such as ``COUNT(*)`` are allowed here.
    aggregated : bool
        True inside an aggregate.
    over : bool
        True if values over a match are allowed here.
    paths : list of PathValue or None
        Named paths. ``None`` if they are not allowed here.
    aliases : mapping of str to Bound
        Values of ``RETURN`` by name, where these can be used. Such a name is not a variable there.
    """

    session: Session
    scope: ScopeBuilder
    meanings: dict[str, Symbol] = field(default_factory=dict[str, Symbol])
    parent: SymbolTable | None = None
    aggregates: bool = False
    aggregated: bool = False
    over: bool = False
    paths: list[b.PathValue] | None = None
    aliases: Mapping[str, Bound] = field(default_factory=dict[str, "Bound"])

    def block(self) -> SymbolTable:
        """Return a symbol table (known names) for a pattern in braces inside this part."""
        return SymbolTable(self.session, ScopeBuilder(self.session, self.scope), parent=self)

    def body(self, meanings: dict[str, Symbol]) -> SymbolTable:
        """Return a symbol table (known names) for the body of a predicate that this part of the query calls.

        The body sees only the given names.
        """
        return SymbolTable(self.session, self.scope, meanings)

    def meaning(self, name: str) -> Symbol | None:
        """Return the meaning of a name in a query, or None for an unknown name.

        The name ``ego`` is not resolved here.
        """
        names: SymbolTable | None = self
        while names is not None:
            if name in names.meanings:
                return names.meanings[name]
            names = names.parent
        return None

    def node(self, name: str, span: TextSpan) -> str:
        """Return the key of the pattern node with this name, and record that the pattern uses it.

        Raises
        ------
        QueryNameError
            Unknown name.
        QueryError
            The name is not a node.
        """
        meaning = self.meaning(name)
        if meaning is None and name == THE_EGO:
            key = self.session.the_ego = self.scope.top.the_ego(span)
        elif meaning is None:
            known = {*self.visible(), *self.session.tables}
            hint = self._hint(name)
            self.session.unknown("variable", name, span, known, hint)
        elif meaning.node is None:
            way = meaning.value is not None and meaning.value.type is Type.list
            hint = f"use length({name}) or nodes({name}) for a path" if way else None
            self.session.refuse(f"'{name}' is not a node", span, hint)
        else:
            key = meaning.node
        self.scope.mention(key)
        return key

    def _hint(self, name: str) -> str | None:
        """Return a hint for a name that is not known at this place of the query, or None."""
        if self.session.calls:
            return f"{self.session.calls[-1]}() can use only its parameters and ego"
        if name in self.session.dropped:
            return f"WITH does not pass it on: WITH …, {name}"
        elsewhere = name.lower() in self.session.keys
        return variable_hint(name, self.visible(), elsewhere) or call_hint(name)

    def bind(self, expression: s.Expression) -> Bound:
        """Resolve the names and types of an expression of any type.

        Raises
        ------
        QueryNameError
            An unknown name.
        QueryError
            Types do not match.
        """
        return self.session.binders[type(expression)](expression, self)

    def condition(self, expression: s.Expression) -> Bound:
        """Resolve the names and types of an expression that must be a condition (true, false or unknown).

        Raises
        ------
        QueryError
            The expression has another type.
        """
        found = of_type(self.bind(expression), Type.boolean)
        if found.type not in {Type.boolean, Type.null}:
            written = self.session.text[expression.span.start : expression.span.end]
            self.session.refuse(
                f"expected a condition, but this is a {found.type.value}",
                expression.span,
                condition_hint(found.type, written),
            )
        return found

    def number(self, expression: s.Expression) -> Bound:
        """Resolve the names and types of an expression that must be a number.

        Raises
        ------
        QueryError
            The expression has another type.
        """
        found = of_type(self.bind(expression), Type.number)
        if found.type is not Type.number:
            named = expression.name if isinstance(expression, s.Variable) else ""
            self.session.refuse(
                f"expected a number, but this is a {found.type.value}",
                expression.span,
                f"one of its attributes: {named}.speed" if found.type is Type.node else None,
            )
        return found

    def visible(self) -> set[str]:
        """Return the variable names that this place can use, except ``frame``, ``trace`` and ``env``."""
        outside = self.parent.visible() if self.parent else {THE_EGO}
        return outside | set(self.meanings) | set(self.aliases)


def of_type(value: Bound, kind: Type) -> Bound:
    """Return an expression. If it is a topic value of unknown type, give it the given type."""
    if value.type is not Type.open or kind in {Type.open, Type.null}:
        return value
    if isinstance(value, FrameAttribute):
        topic = value.attribute.topic
        assert topic is not None  # noqa: S101 - other attributes have a type
        return FrameAttribute(topic_attribute(topic, kind), kind)
    return replace(with_operands(value, lambda part: of_type(part, kind)), type=kind)


def call_hint(name: str) -> str | None:
    """If a name is a predicate or a function of two entities, return a hint with its signature."""
    word = normalize_name(name)
    if (found := predicates().get(word)) is not None:
        formals = ", ".join(formal.name for formal in found.parameters)
        return f"write the predicate as {found.name}({formals})"
    return f"it is a function: {PAIR_NAMES[word]}(a, b)" if word in PAIR_NAMES else None
