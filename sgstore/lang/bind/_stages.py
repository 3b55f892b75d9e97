"""Binder of queries with several clauses: ``OPTIONAL MATCH``, ``WITH``, more ``MATCH``, named paths.

All stages are about one frame. A stage can use the variables of earlier stages, as a block can use the
variables around it. A variable that ``WITH`` does not pass on loses its name. Without grouping, it remains
part of the matches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._precision import is_stored, precision_of
from sgstore.lang.bind._symbols import (
    RESERVED,
    THE_EGO,
    ScopeBuilder,
    Session,
    Symbol,
    SymbolTable,
)
from sgstore.lang.bind._temporal import settled
from sgstore.lang.catalog import Type
from sgstore.lang.syntax import tree as s

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.errors import TextSpan

    BindBlock = Callable[[s.Block, SymbolTable], None]
    BindColumns = Callable[[Sequence[s.Item], SymbolTable], tuple[b.ReturnColumn, ...]]


@dataclass(slots=True)
class StagedScope(ScopeBuilder):
    """Nodes and edges of all clauses (``MATCH``, ``WITH``) of a query that are resolved so far.

    The first pattern always binds the ego.

    Attributes
    ----------
    first : ScopeBuilder
    ego : str
        Key of the ego after its first use as ``ego``.
    """

    first: ScopeBuilder = field(kw_only=True)
    ego: str = ""

    def the_ego(self, span: TextSpan) -> str:
        """Return the key of the ego node. If it is missing, add it to the first pattern of the query."""
        self.ego = self.first.the_ego(span)
        self.nodes.setdefault(self.ego, replace(self.first.nodes[self.ego], role="unnamed"))
        return self.ego


@dataclass(slots=True)
class _Match:
    """``MATCH`` clause with resolved names, and the variables of earlier clauses."""

    scope: ScopeBuilder
    paths: list[b.PathValue]
    earlier: dict[str, b.Node]
    optional: bool = field(kw_only=True)

    def finished(self, ego: b.Node | None) -> b.MatchStage:
        """Return the finished clause, with the pairs of its nodes and earlier nodes that must differ."""
        earlier = self.earlier | ({} if ego is None else {ego.key: ego})
        apart = tuple(
            (key, other)
            for key, node in self.scope.nodes.items()
            for other, old in earlier.items()
            if other not in self.scope.outer and _may_be_same(node.kinds, old.kinds)
        )
        apart = apart if self.scope.session.injective else ()
        return b.MatchStage(self.scope.finished(), self.optional, tuple(self.paths), apart=apart)


def _may_be_same(one: b.Kinds, other: b.Kinds) -> bool:
    """True if two variables can match the same node; False if both must be the ego."""
    return bool(one.other & other.other or (one.ego & other.ego and (one.other or other.other)))


@dataclass(slots=True)
class _With:
    """``WITH`` clause with resolved names, and the nodes before and after it."""

    stage: b.WithStage
    before: dict[str, b.Node]
    after: dict[str, b.Node]

    def finished(self, ego: b.Node | None) -> b.WithStage:
        """Return the finished ``WITH`` clause. It keeps the ego if a later clause uses it."""
        stage = self.stage
        if ego is not None:
            self.before.setdefault(ego.key, ego)
            if ego.key not in self.after:
                self.after[ego.key] = ego
                stage = replace(stage, nodes=(*stage.nodes, (ego.key, ego.key)))
        before = replace(stage.before, nodes=self.before)
        return replace(stage, before=before, after=replace(stage.after, nodes=self.after))


class StageBinder:
    """Binder of the clauses (``MATCH``, ``OPTIONAL MATCH``, ``WITH``) of a query, in order.

    Parameters
    ----------
    match : MatchClause
    session : Session
    bind_block : function
        Function that binds a block into the scope of a symbol table.
    bind_columns : function
        Function that binds values to return.

    Attributes
    ----------
    names : SymbolTable
        Names that the next stage can use.

    Raises
    ------
    QueryError
        A stage follows a sequence, or a stage is invalid.
    """

    def __init__(
        self,
        match: s.MatchClause,
        session: Session,
        bind_block: BindBlock,
        bind_columns: BindColumns,
    ) -> None:
        self._session, self._bind_block, self._bind_columns = session, bind_block, bind_columns
        self._span = match.later[0].span if match.later else match.span
        self._stages: list[_Match | _With] = []
        first = ScopeBuilder(session)
        self._told = StagedScope(session, first=first)
        self.names = SymbolTable(session, self._told)
        self._match(SymbolTable(session, first), match.block, optional=False)
        for part in match.later:
            self._span = part.span
            if isinstance(part, s.WithClause):
                self._with(part)
            else:
                inner = ScopeBuilder(session, self._told)
                names = SymbolTable(session, inner, parent=self.names)
                self._match(names, part.block, optional=part.optional)

    # Patterns

    def _match(self, names: SymbolTable, block: s.Block, *, optional: bool) -> None:
        names.paths = []
        self._bind_block(block, names)
        scope = names.scope
        self._refuse_many(scope, names.paths)
        scope.where = [self._checked(part) for part in scope.where]
        told = self._told
        known = (symbol.node for symbol in self.names.meanings.values())
        earlier = {key: told.nodes[key] for key in known if key is not None}
        self._stages.append(_Match(scope, names.paths, earlier, optional=optional))
        self._session.maybe |= set(scope.nodes) if optional else set()
        told.nodes |= scope.nodes
        told.edges += [edge for edge in scope.edges if edge.named]
        self.names = replace(self.names, meanings={**self.names.meanings, **names.meanings})

    def _refuse_many(self, scope: ScopeBuilder, paths: Iterable[b.PathValue]) -> None:
        lengths = {edge.key: edge.high - edge.low + 1 for edge in scope.edges}
        if math.prod(lengths[key] for path in paths for key, _ in path.edges) > MOST_WAYS:
            self._session.refuse(
                f"the repeated edges of these paths have more than {MOST_WAYS} combinations",
                self._span,
                "lower the bounds: -[:travelsTo*1..3]->",
            )

    def _checked(self, value: b.Bound) -> b.Bound:
        """Return an expression. Raise an error if a query with several clauses cannot use it.

        Temporal operators, and ``WITH`` values in braces, are not allowed.
        """
        found = settled(value, self._session)
        if b.is_temporal(found):
            self._session.refuse(
                "OPTIONAL MATCH and WITH are about one frame, and this query looks at others",
                self._span,
                "write a separate query for values of other frames",
            )
        if any(b.is_passed_on(part) for part in _in_blocks([found])):
            self._session.refuse(
                "a block in braces cannot use the values of WITH",
                self._span,
                "compare them outside: WHERE COUNT {…} > n; or write a MATCH after WITH",
            )
        return found

    # WITH

    def _with(self, clause: s.WithClause) -> None:
        told, session = self._told, self._session
        before, old = dict(told.nodes), replace(self.names, aggregates=True)
        symbols, values, places = self._passed(clause, old)
        before |= told.nodes  # the ego, if it was named here
        grouped = clause.distinct or any(b.is_counted(column.value) for column in values)
        nodes, edges = self._renamed(symbols)
        after = {} if grouped else {k: replace(n, role="unnamed") for k, n in before.items()}
        ends = {end for edge, _ in edges for end in (edge.src, edge.dst)}
        kept = tuple((k, k) for k in sorted(ends) if k not in dict(nodes)) if grouped else ()
        after |= {k: replace(before[k], role="unnamed") for k, _ in kept}
        after |= {new: replace(before[key], key=new, role="named") for new, key in nodes}
        stage = b.WithStage(
            _bare({}, told.edges), _bare({}, ()), (*nodes, *kept), edges, values, places, grouped
        )
        told.nodes, told.edges = dict(after), [edge for edge, _ in edges]
        session.dropped |= self.names.meanings.keys() - symbols.keys()
        self.names = SymbolTable(session, told, symbols)
        inner = (
            self.names if grouped else replace(self.names, parent=replace(old, aggregates=False))
        )
        if not grouped:  # variables that are not passed on can still be used here
            told.edges = [*{e.key: e for e in (*stage.before.edges, *told.edges)}.values()]
        order = tuple(
            b.SortKey(self._key(key.value, inner), key.descending) for key in clause.order
        )
        where = [] if clause.where is None else b.conjuncts(inner.condition(clause.where))
        where = [self._checked(part) for part in where]
        after |= told.nodes
        stage = replace(
            stage,
            after=_bare({}, told.edges),
            order=order,
            skip=clause.skip,
            limit=clause.limit,
            where=tuple(where),
        )
        told.edges = [edge for edge, _ in edges]
        self._stages.append(_With(stage, before, after))

    def _key(self, value: s.Expression, names: SymbolTable) -> b.Bound:
        found = self._checked(names.bind(value))
        if found.type is Type.list:
            self._session.refuse("a list cannot define an order", value.span)
        return found

    def _passed(
        self, clause: s.WithClause, names: SymbolTable
    ) -> tuple[dict[str, Symbol], tuple[b.ReturnColumn, ...], tuple[b.FrameAttribute, ...]]:
        """Return the names known after a ``WITH`` clause, its computed values, and placeholders for them."""
        symbols: dict[str, Symbol] = {}
        written: list[s.Item] = []
        for item in clause.items:
            found = (
                dict(names.meanings) if item.form == "all" else self._named(item, names, written)
            )
            for name, symbol in found.items():
                if name in symbols:
                    self._session.refuse(f"two results have the name '{name}'", item.span)
                symbols[name] = symbol
        columns = {column.name: column.value for column in self._bind_columns(written, names)}
        values: list[b.ReturnColumn] = []
        places: list[b.FrameAttribute] = []
        for name, symbol in symbols.items():
            value = columns.get(name, symbol.value)
            if value is None:
                continue
            self._checked(value)
            place = _place(name, value, self._session)
            values.append(b.ReturnColumn(name, value))
            places.append(place)
            symbols[name] = Symbol(value=place)
        return symbols, tuple(values), tuple(places)

    def _named(
        self, item: s.Item, names: SymbolTable, written: list[s.Item]
    ) -> Mapping[str, Symbol]:
        """Return the name and meaning of a ``WITH`` item. Append it to ``written``, unless it is a node."""
        value = item.value
        if isinstance(value, s.Variable):
            symbol = names.meaning(value.name)
            if symbol is None:
                symbol = Symbol(node=names.node(value.name, value.span))
            if symbol.value is None:
                return {item.name or value.name: symbol}
            item = replace(item, name=item.name or value.name)
        if item.name is None:
            self._session.refuse("a value in WITH needs a name", item.span, "WITH …, COUNT(*) AS n")
        written.append(item)
        return {item.name: Symbol()}

    def _renamed(
        self, symbols: dict[str, Symbol]
    ) -> tuple[tuple[tuple[str, str], ...], tuple[tuple[b.Edge, str], ...]]:
        """Give a unique key to each passed node and edge. Return pairs of new and old key.

        ``symbols`` is updated.
        """
        nodes: list[tuple[str, str]] = []
        edges: list[tuple[b.Edge, str]] = []
        known = {edge.key: edge for edge in self._told.edges}
        taken: set[str] = set()
        for name, symbol in list(symbols.items()):
            key = symbol.node or symbol.edge
            if key is None:
                continue
            same = key.partition("~")[0] == name and key not in taken
            new = key if same else self._session.key(name)
            taken.add(new)
            if symbol.node is not None:
                nodes.append((new, key))
                self._session.maybe |= {new} if key in self._session.maybe else set()
                symbols[name] = Symbol(node=new)
            else:
                edges.append((replace(known[key], key=new), key))
                symbols[name] = Symbol(edge=new)
        return tuple(nodes), tuple(edges)

    # The whole

    def result(self, result: b.Result) -> b.Result:
        """Return the result of the query. A result with whole matches also has the values of ``WITH``."""
        for value in result.values:
            self._checked(value)
        if not result.whole:
            return result
        own = {column.name for column in result.columns}
        more = tuple(
            b.ReturnColumn(name, symbol.value)
            for name, symbol in self.names.meanings.items()
            if symbol.value is not None and name not in own
        )
        return replace(result, columns=(*more, *result.columns))

    def scope(self) -> b.Scope:
        """Return all nodes and edges that a variable names after the last clause of the query."""
        return _bare(self._told.nodes, self._told.edges)

    def stages(self) -> tuple[b.Stage, ...]:
        """Return all clauses with resolved names. Any of them may add the ego, so call this last."""
        told = self._told
        ego = told.first.nodes.get(told.ego)
        ego = ego and replace(ego, role="unnamed")
        found: list[b.Stage] = []
        for part in self._stages:
            if isinstance(part, _With):
                found.append(part.finished(ego))
            else:
                found.append(part.finished(ego if found else None))
        return tuple(found)


MOST_WAYS: Final = 100
"""Largest number of combinations of path lengths in a pattern with named paths."""


def _place(name: str, value: b.Bound | None, session: Session) -> b.FrameAttribute:
    """Return a placeholder for a value that ``WITH`` passes on. Without a value, it is for a path."""
    session.numbers += 1
    if value is None or b.is_path(value):
        return b.passed_on(f"{b.PASSED}{name} p{session.numbers}", Type.list)
    precision = precision_of(value)
    word = "" if precision is None else precision.value
    called = f"{b.PASSED}{name} {session.numbers}"
    found = b.passed_on(called, value.type, word, stored=is_stored(value))
    items = b.items_of(value)  # a list passed on keeps the type of its items
    return (
        found
        if items is None
        else replace(found, attribute=replace(found.attribute, meaning=items))
    )


def name_path(path: s.Path, nodes: list[str], edges: list[str], names: SymbolTable) -> None:
    """Define the name of a path, such as ``p`` in ``p = (a)-[:near]->(b)``. It means the list of its nodes.

    Raises
    ------
    QueryError
        A name is not allowed here, or is already used.
    """
    session, span = names.session, path.name_span
    assert path.name is not None  # noqa: S101 - checked by the caller
    assert span is not None  # noqa: S101 - a name has a place
    if names.paths is None:
        hint = "MATCH p = (a)-[:near*1..2]->(b) RETURN nodes(p)"
        session.refuse("name a path only in a pattern of one frame, outside braces", span, hint)
    if path.name in RESERVED or path.name == THE_EGO or names.meaning(path.name) is not None:
        session.refuse(f"'{path.name}' is bound already", span)
    place = _place(path.name, None, session)
    backwards = [edge.direction == "left" for edge in path.edges]
    found = b.PathValue(place, tuple(nodes), tuple(zip(edges, backwards, strict=True)))
    names.paths.append(found)
    names.meanings[path.name] = Symbol(value=place)


def _bare(nodes: Mapping[str, b.Node], edges: Iterable[b.Edge]) -> b.Scope:
    """Return a pattern with the given nodes and edges, without conditions."""
    return b.Scope(nodes, {}, tuple(edges), (), frozenset())


def _in_blocks(values: Iterable[b.Bound]) -> Iterable[b.Bound]:
    """Yield all expressions that are inside braces, such as in ``EXISTS {…}``, in the given expressions."""
    for block in b.all_blocks(values):
        for inner in block.inside:
            yield from b.walk(inner)
