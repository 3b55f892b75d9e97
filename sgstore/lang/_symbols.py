"""The symbol table, data sets and tests of texts.

Two chains run from the inside out. *Names* are what a text may say: those of a block see those around it,
those of a predicate's body see its parameters only. *Scopes* are where nodes live; a node that is spoken of
in a scope further in becomes an outer node of every scope between.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from fnmatch import fnmatchcase
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, Final, NoReturn

from sgstore.errors import QueryError, QueryNameError
from sgstore.lang import ir as b
from sgstore.lang import syntax as s
from sgstore.lang._catalog import PAIR_NAMES, Attribute, DisplayUnit, Home, Type
from sgstore.lang._hints import condition_hint, hint_at, variable_hint
from sgstore.lang._needs import scopes_of
from sgstore.lang.ir import Bound, Edge, Kinds, Node, Scope, ego_kinds
from sgstore.lang.library import predicates
from sgstore.records import dataclass
from sgstore.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.errors import TextSpan
    from sgstore.lang._catalog import Catalog, TableFacts, TraceFacts
    from sgstore.lang.syntax import Define


THE_EGO: Final = "ego"
"""The name that is always bound: to the ego of the frame."""

RESERVED: Final = frozenset({"env", "frame", "trace"})
"""Names of what is not a node but has attributes all the same."""


@dataclass(frozen=True, slots=True)
class Symbol:
    """Meaning of a name: a node, an edge, or (for the parameter of a predicate) a value."""

    node: str | None = None
    edge: str | None = None
    value: Bound | None = None


Binder = Callable[[Any, "SymbolTable"], Bound]
"""The function that binds one kind of expression."""

Binders = Mapping[type, Binder]


@dataclass(slots=True)
class Session:
    """State that the whole of a query shares while it is bound.

    Attributes
    ----------
    text : str
        The query, for messages.
    parameters : mapping of str to value
    binders : mapping of type to Binder
        The binder of each kind of expression. They are handed in, because calls, blocks and temporal operators
        hold expressions, and expressions hold them.
    predicates : dict of str to Define
        By folded name.
    injective : bool
        Whether different nodes of a pattern are bound to different nodes.
    used : set of str
        Parameters that the query speaks of.
    relations : set of str
        Relations that it names.
    keys : set of str
        Keys taken, without regard to case: the database sees no difference.
    calls : list of str
        Predicates whose bodies are being bound.
    classed : tuple of str
        Abstractions in which the store has the classes of frames.
    tables : mapping of str to TableFacts
        Tables of users' own that are joined, by name.
    traces : tuple of TraceFacts
        Of the store.
    own : mapping of str to Type
        Attributes of a client's own, by name.
    part : bool
        Whether the store is a part of a collection: see :attr:`sgstore.lang.Catalog.part`.
    online : bool
        Whether nothing later is known.
    dropped : set of str
        Names that a ``WITH`` does not pass on.
    maybe : set of str
        Keys of nodes that an ``OPTIONAL MATCH`` binds, or leaves NULL.
    the_ego : str or None
        The key of the ego, once the query has named it ``ego``, wherever that is.
    numbers, blocks : int
        Unnamed nodes and edges, and blocks, so far.
    beyond : Scopes
        Which relations traces have, of a statement that asks for them beyond the graphs; else empty.
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
    classed: tuple[str, ...] = ()
    tables: Mapping[str, TableFacts] = field(default_factory=dict[str, "TableFacts"])
    traces: tuple[TraceFacts, ...] = ()
    own: Mapping[str, Type] = field(default_factory=dict[str, Type])
    own_edges: Mapping[str, Type] = field(default_factory=dict[str, Type])
    part: bool = False
    online: bool = False
    dropped: set[str] = field(default_factory=set[str])
    maybe: set[str] = field(default_factory=set[str])
    the_ego: str | None = None
    numbers: int = 0
    blocks: int = 0
    beyond: b.Scopes = ()

    def ask(self, catalog: Catalog) -> None:
        """Take over what a catalog says of the store that is asked."""
        self.classed, self.tables, self.traces = catalog.classed, catalog.tables, catalog.traces
        self.own, self.own_edges, self.part = catalog.own, catalog.own_edges, catalog.part
        self.online = catalog.online

    def look_beyond(self, catalog: Catalog, *, world: bool) -> None:
        """Take over which relations traces have, if a statement asks for them beyond the graphs."""
        if world and (catalog.world or catalog.online):
            self.beyond = scopes_of(self.traces)

    def key(self, name: str | None) -> str:
        """A key that is not taken: the name itself if it can be; ``#1``, ``#2``, … for what has none."""
        self.numbers += name is None
        wanted = name or f"#{self.numbers}"
        key, copy = wanted, 2
        while key.lower() in self.keys:
            key, copy = f"{wanted}~{copy}", copy + 1
        self.keys.add(key.lower())
        return key

    def refuse(self, reason: str, span: TextSpan, hint: str | None = None) -> NoReturn:
        """Raise a :class:`QueryError` about a part of the text."""
        raise QueryError(reason, text=self.text, span=span, hint=hint)

    def unknown(
        self, what: str, name: str, span: TextSpan, known: Iterable[str], hint: str | None = None
    ) -> NoReturn:
        """Raise a :class:`QueryNameError` about a name, with what is most like it or else all that is known."""
        hint = hint or hint_at(name, known)
        raise QueryNameError(f"unknown {what} '{name}'", text=self.text, span=span, hint=hint)


@dataclass(slots=True)
class ScopeBuilder:
    """A scope in the making."""

    session: Session
    parent: ScopeBuilder | None = None
    nodes: dict[str, Node] = field(default_factory=dict[str, Node])
    outer: dict[str, Kinds] = field(default_factory=dict[str, Kinds])
    edges: list[Edge] = field(default_factory=list[Edge])
    where: list[Bound] = field(default_factory=list[Bound])

    @property
    def top(self) -> ScopeBuilder:
        """The scope of ``MATCH``."""
        return self.parent.top if self.parent else self

    def kinds(self, key: str) -> Kinds:
        """Return the kinds that a node may have here."""
        return self.nodes[key].kinds if key in self.nodes else self.outer[key]

    def mention(self, key: str) -> None:
        """Take note that a node is spoken of here; it is one of this scope or of one around it."""
        if key in self.nodes or key in self.outer or self.parent is None:
            return
        self.parent.mention(key)
        self.outer[key] = self.parent.kinds(key)

    def narrow(self, key: str, kinds: Kinds) -> None:
        """A node is asked to be of some kinds, here."""
        if key in self.outer:
            self.outer[key] = self.outer[key] & kinds
        else:
            node = self.nodes[key]
            self.nodes[key] = replace(node, kinds=node.kinds & kinds)

    def add(self, name: str | None, kinds: Kinds, span: TextSpan, *, named: bool) -> str:
        """A new node; its key."""
        key = self.session.key(name)
        self.nodes[key] = Node(key, kinds, "named" if named else "unnamed", span)
        return key

    def the_ego(self, span: TextSpan) -> str:
        """The key of the ego: of the node that is labelled so in ``MATCH``, or of one that is added there."""
        for node in self.nodes.values():
            if not node.kinds.other:
                return node.key
        return self.add(THE_EGO, ego_kinds(), span, named=False)

    def finished(self) -> Scope:
        """The scope, with what must differ."""
        where = tuple(self.where)
        return Scope(self.nodes, self.outer, tuple(self.edges), where, self.distinct())

    def distinct(self) -> frozenset[tuple[str, str]]:
        """Return the pairs of nodes that must differ: own nodes from each other and from outer ones."""
        if not self.session.injective:
            return frozenset()
        pairs = {*combinations(self.nodes, 2), *product(self.nodes, self.outer)}
        for a, other in sorted(pairs):
            if not self.kinds(a).other and not self.kinds(other).other:
                self.session.refuse(
                    "two nodes are both the ego, and different nodes of a pattern are never the same",
                    self.nodes[a].span,
                    "a frame has one ego: use one variable, or USING NODES any",
                )
        return frozenset(pairs)


@dataclass(slots=True)
class SymbolTable:
    """The names that a part of a text may use, and the scope that it stands in.

    Attributes
    ----------
    session : Session
    scope : ScopeBuilder
    meanings : dict of str to Symbol
    parent : SymbolTable or None
        Names around these, visible too.
    aggregates : bool
        Whether ``COUNT(*)`` and the like may stand here.
    aggregated : bool
        Whether what stands here is inside of one.
    over : bool
        Whether values over a match may stand here.
    paths : list of PathValue or None
        Paths with names, where there may be some.
    aliases : mapping of str to Bound
        What ``RETURN`` calls its values, where these may be spoken of; a name of one is no variable there.
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
        """Names for a block in this place."""
        return SymbolTable(self.session, ScopeBuilder(self.session, self.scope), parent=self)

    def body(self, meanings: dict[str, Symbol]) -> SymbolTable:
        """Names for the body of a predicate that is called in this place."""
        return SymbolTable(self.session, self.scope, meanings)

    def meaning(self, name: str) -> Symbol | None:
        """Return the meaning of a name here; ``None`` if it is not known. ``ego`` is not looked up."""
        names: SymbolTable | None = self
        while names is not None:
            if name in names.meanings:
                return names.meanings[name]
            names = names.parent
        return None

    def node(self, name: str, span: TextSpan) -> str:
        """The key of the node that a name means; the scope takes note of it.

        Raises
        ------
        QueryNameError
            No such name.
        QueryError
            It does not mean a node.
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
            hint = f"of a path there are length({name}) and nodes({name})" if way else None
            self.session.refuse(f"'{name}' is not a node", span, hint)
        else:
            key = meaning.node
        self.scope.mention(key)
        return key

    def _hint(self, name: str) -> str | None:
        """Return a hint for a name that has no meaning here."""
        if self.session.calls:
            return f"{self.session.calls[-1]}() knows its parameters and ego only"
        if name in self.session.dropped:
            return f"WITH does not pass it on: WITH …, {name}"
        elsewhere = name.lower() in self.session.keys
        return variable_hint(name, self.visible(), elsewhere) or call_hint(name)

    def bind(self, expression: s.Expression) -> Bound:
        """Bind an expression of any type.

        Raises
        ------
        QueryNameError
            It names what is not known.
        QueryError
            Its types do not fit together.
        """
        return self.session.binders[type(expression)](expression, self)

    def condition(self, expression: s.Expression) -> Bound:
        """Bind an expression that is true, false or unknown.

        Raises
        ------
        QueryError
            It is something else.
        """
        found = self.bind(expression)
        if found.type not in {Type.boolean, Type.null}:
            written = self.session.text[expression.span.start : expression.span.end]
            self.session.refuse(
                f"expected a condition, but this is a {found.type.value}",
                expression.span,
                condition_hint(found.type, written),
            )
        return found

    def number(self, expression: s.Expression) -> Bound:
        """Bind an expression that is a number.

        Raises
        ------
        QueryError
            It is something else.
        """
        found = self.bind(expression)
        if found.type is not Type.number:
            named = expression.name if isinstance(expression, s.Variable) else ""
            self.session.refuse(
                f"expected a number, but this is a {found.type.value}",
                expression.span,
                f"one of its attributes: {named}.speed" if found.type is Type.node else None,
            )
        return found

    def visible(self) -> set[str]:
        """All names that may be used here, but those of frame and trace."""
        outside = self.parent.visible() if self.parent else {THE_EGO}
        return outside | set(self.meanings) | set(self.aliases)


def call_hint(name: str) -> str | None:
    """Say how a function of two entities or a predicate of that name is written; ``None`` if there is none."""
    word = normalize_name(name)
    if (found := predicates().get(word)) is not None:
        formals = ", ".join(formal.name for formal in found.parameters)
        return f"it is a predicate: {found.name}({formals})"
    return f"it is a function: {PAIR_NAMES[word]}(a, b)" if word in PAIR_NAMES else None


# Datasets in queries: traces whose names are alike, or a table of one's own that says which -----

CLASSES_GIVEN: Final = "sgstore_classes"
"""The table with the classes of all parts of a collection: ``dataset`` (empty: of all frames), ``abstraction``,
``class``, ``frames``."""

CLASSES: Final = "datasetclasses"
"""The function after ``IN``, folded: ``frame.class IN dataset_classes('train')``."""


def traces_in(
    name: str,
    traces: Iterable[TraceFacts],
    tables: Mapping[str, TableFacts],
    *,
    part: bool = False,
) -> frozenset[int] | None:
    """Ids of the traces of a dataset; ``None`` if nothing is called so.

    Parameters
    ----------
    name : str
        A table of one's own whose rows are of traces, or a name of traces, in which ``*`` and ``?`` stand for
        anything.
    traces : iterable of TraceFacts
    tables : mapping of str to TableFacts
    part : bool
        Whether there are other stores, which may have what is not here.
    """
    if name in tables:
        return tables[name].traces
    found = frozenset(t.trace_id for t in traces if fnmatchcase(t.name, name))
    return found if found or part else None


def asked(name: str, span: TextSpan, session: Session) -> frozenset[int]:
    """Ids of the traces that ``USING DATASET`` chooses.

    Raises
    ------
    QueryError
        There is no such dataset, or it is a table of single frames.
    """
    found = traces_in(name, session.traces, session.tables, part=session.part)
    if found is None and name in session.tables:
        session.refuse(
            f"'{name}' is a table of single frames, and USING DATASET chooses traces",
            span,
            f"ask for its columns: WHERE {name}.… IS NOT NULL",
        )
    return _known(found, name, span, session)


def seen_in(
    classes: b.FrameAttribute, name: str, span: TextSpan, session: Session
) -> b.FrameAttribute:
    """Return the condition that the class of a frame occurs in a dataset: traces, or a table with frames.

    Raises
    ------
    QueryError
        There is no such dataset.
    """
    found = traces_in(name, session.traces, session.tables, part=session.part)
    table = session.tables.get(name)
    if found is None and table is not None and not table.joins:
        session.refuse(f"the rows of '{name}' belong to no frames", span)
    if table is None:
        found = _known(found, name, span, session)
    (abstraction,) = classes.attribute.columns.values()
    attribute = Attribute(
        f"class_{abstraction} in {name}",
        Type.boolean,
        {Home.state: abstraction},
        "whether its class is in a dataset",
        DisplayUnit.seen,
        table=name if found is None else "",
        traces=tuple(sorted(found or ())),
        given=CLASSES_GIVEN if session.part else "",
    )
    return b.FrameAttribute(attribute, Type.boolean)


def class_count(abstraction: str, *, part: bool = False) -> b.FrameAttribute:
    """Return the number of frames in the store, or in all parts, that are of the class of the frame."""
    attribute = Attribute(
        f"class_count({abstraction})",
        Type.number,
        {Home.state: abstraction},
        "frames of its class",
        DisplayUnit.counted,
        given=CLASSES_GIVEN if part else "",
    )
    return b.FrameAttribute(attribute, Type.number)


def abstraction_named(name: str, span: TextSpan, session: Session) -> str:
    """The abstraction in which the store has the classes of frames, in its own spelling.

    Raises
    ------
    QueryNameError
        The store has none of that name.
    """
    found = next(
        (one for one in session.classed if normalize_name(one) == normalize_name(name)), None
    )
    if found is None:
        session.unknown("abstraction", name, span, session.classed)
    return found


def _known(
    found: frozenset[int] | None, name: str, span: TextSpan, session: Session
) -> frozenset[int]:
    if found is None:
        known = [*session.tables, *(trace.name for trace in session.traces)]
        session.unknown("dataset", name, span, known)
    return found


# Tests of texts: ``CONTAINS`` and the like, and regular expressions -----------------------------

_NOT_RE2: Final = re.compile(r"\(\?(?!:|P<\w+>|[ims]+[:)])|\\[1-9NuUZ]|[*+?}]\+")


def text_test(e: s.Comparison, left: b.Bound, right: b.Bound, names: SymbolTable) -> b.Operation:
    """A test of one text by another, bound.

    Raises
    ------
    QueryError
        A side is no text, or what stands after ``=~`` is no regular expression that can be searched for.
    """
    for side, written in ((left, e.left), (right, e.right)):
        if side.type is not Type.text:
            names.session.refuse(
                f"{e.word} compares texts, but this is a {side.type.value}", written.span
            )
    if e.word == "=~":
        _check_regex(right, e.right.span, names)
    return b.Operation(e.word, (left, right), Type.boolean)


def regex(text: str) -> re.Pattern[str]:
    """Compile a regular expression that Python and the database read alike.

    Raises
    ------
    re.error
        It is none, or a set in it may hold a set, which they read differently: ``[[:alpha:]]``, ``[a&&b]``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        try:
            return re.compile(text)
        except FutureWarning:
            raise re.error(
                "a set in a set; write a backslash before [, -, &, | or ~ in a set"
            ) from None


def _check_regex(pattern: b.Bound, span: TextSpan, names: SymbolTable) -> None:
    if not isinstance(pattern, b.Value):
        names.session.refuse("the pattern after =~ must be a constant", span)
    text = str(pattern.value)
    try:
        regex(text)
    except re.error as error:
        names.session.refuse(f"not a regular expression: {error}", span)
    if _NOT_RE2.search(text):
        names.session.refuse(
            "not a regular expression that can be searched for",
            span,
            "no look-around, no back-references",
        )
