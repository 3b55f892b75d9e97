"""Compiler: converts query text to SQL statements, with subgraphs and ``--explain``.

With ``RETURN SUBGRAPHS`` each match is a small graph, built from the columns of one statement.

The graph of a match contains the nodes bound by the pattern, named or not, with all known attributes, and the
edges of the pattern. A path of exactly n edges is shown edge by edge. A path of m to n edges is shown as one
edge from end to end, with a relation such as ``isIn*1..3``. An undirected edge has the direction in which it
is written, and a mark ``either_way``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import sgstore.lang.sql._results as results
from sgstore.base.logs import logger
from sgstore.lang.bind import bind_checks, bind_query, traces_in
from sgstore.lang.catalog import (
    EDGE_ATTRIBUTES,
    FRAME_ATTRIBUTES,
    NODE_ATTRIBUTES,
    Attribute,
    Catalog,
    Type,
)
from sgstore.lang.ir import (
    FRAME_COLUMNS,
    INTERVAL_COLUMNS,
    PASSED,
    WINDOWS,
    Aggregate,
    BlockValue,
    Bound,
    Choices,
    Edge,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    Happened,
    Kinds,
    LabelTest,
    MatchStage,
    Node,
    NodeAttribute,
    NodeValue,
    Operation,
    OverMatch,
    PairNumber,
    Query,
    Result,
    ReturnColumn,
    Scope,
    SignalCall,
    Stage,
    StepTime,
    Tense,
    TraceAttribute,
    Value,
    any_kinds,
    any_relation,
    is_passed_on,
)
from sgstore.lang.operators import INFIX
from sgstore.lang.sql._frame_relations import SPAN, external_matches, nothing, with_places
from sgstore.lang.sql._rewrite import rewritten, unfold_paths
from sgstore.lang.sql._stages import staged_matches
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause, MatchClause
from sgstore.model.pair_numbers import as_written
from sgstore.model.vocabulary import KINDS, RELATIONS, asking, entity_kinds, normalize_name

_log = logger("lang")

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.lang.bind import CheckInCatalog
    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.sql._frame_relations import ExternalRelation
    from sgstore.lang.sql._masks import SqlBuilder
    from sgstore.lang.sql._plan import Window
    from sgstore.lang.sql._results import SqlStatement
    from sgstore.lang.syntax.tree import Statement


Record = dict[str, Any]
"""Node or edge in the node-link form of networkx."""

COLUMNS: Final = ("nodes", "edges")
"""Columns with the graph of a row: lists of :data:`Record`."""

_TWICE: Final = frozenset({"id", "type"})
"""Attributes that are already present, or present under other names (``type_name``, ``lane_type``)."""


@dataclass(frozen=True, slots=True)
class _ValuePlace:
    """Node or edge of the pattern, with the columns of its values in a row."""

    part: Node | Edge
    first: int
    names: tuple[str, ...]

    def known(self, row: Sequence[Any]) -> Record:
        """Return the known values of the node or edge in a row."""
        values = zip(self.names, row[self.first :], strict=False)
        return {name: value for name, value in values if value is not None}


@dataclass(frozen=True, slots=True)
class Layout:
    """Query whose rows contain all values of the match graphs.

    Attributes
    ----------
    query : Query
        Bound query. It returns frames with values, one row for each match.
    columns : tuple of str
        Names of the columns of :meth:`row`.
    places : tuple of _ValuePlace
        Columns of each node and edge in a row of the query.
    """

    query: Query
    columns: tuple[str, ...]
    places: tuple[_ValuePlace, ...]
    _width: int

    @classmethod
    def of(cls, query: Query) -> Layout:
        """Return the layout of the match graphs of a query. Its own result columns are kept."""
        scope = _bound_variables(query)
        result = query.result
        kept = result.form == "subgraphs" or result.whole
        own = result.columns if kept else ()
        columns, places = list(own), list[_ValuePlace]()
        for part in (*scope.nodes.values(), *scope.edges):
            if isinstance(part, Edge) and part.high > 1:
                places.append(_ValuePlace(part, 0, ()))
                continue
            known = _of_node(part) if isinstance(part, Node) else _of_edge(part)
            first = len(FRAME_COLUMNS) + len(columns)
            places.append(_ValuePlace(part, first, tuple(name for name, _ in known)))
            columns += [ReturnColumn(f":{part.key}.{name}", value) for name, value in known]
        framed = replace(
            result if kept else Result(),
            form="rows",
            columns=tuple(columns),
            whole=False,
            framed=True,
        )
        names = (*FRAME_COLUMNS, *(column.name for column in own), *COLUMNS)
        width = len(FRAME_COLUMNS) + len(own)
        return cls(replace(query, scope=scope, result=framed), names, tuple(places), width)

    def row(self, row: Sequence[Any]) -> tuple[Any, ...]:
        """Convert a row of the query to a row with a graph."""
        bound = {place.part.key: place.known(row) for place in self.places}
        parts = [(place.part, bound[place.part.key]) for place in self.places]
        return (*row[: self._width], *graph_of(parts))


def _bound_variables(query: Query) -> Scope:
    """Return the pattern with all nodes and single edges bound. Paths of fixed length are expanded."""
    scope = unfold_paths(query.scope, Catalog(), injective=query.injective)
    nodes = {
        key: replace(node, role="unnamed") if node.role == "hidden" else node
        for key, node in scope.nodes.items()
    }
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    return replace(scope, nodes=nodes, edges=edges)


def graph_of(parts: Sequence[tuple[Node | Edge, Record]]) -> tuple[list[Record], list[Record]]:
    """Return the nodes and edges of a match, in the order of the pattern.

    Parameters
    ----------
    parts : sequence of (Node or Edge, dict)
        All nodes of the pattern with their known attributes, including ``id``; then the edges, with
        ``relation`` and attributes.

    Returns
    -------
    nodes : list of dict
        ``id``, ``variables`` (names in the pattern), and attributes. A node bound to several variables occurs
        once.
    edges : list of dict
        ``source`` and ``target`` (ids), ``relation``, and attributes; ``either_way`` for an undirected edge.
        An edge that occurs twice in the pattern is listed once.
    """
    ids: dict[str, int] = {}
    nodes: dict[int, Record] = {}
    edges: dict[tuple[Any, ...], Record] = {}
    for part, known in parts:
        if isinstance(part, Node):
            if "id" not in known:  # of an OPTIONAL MATCH
                continue
            node = ids[part.key] = known["id"]
            record = nodes.setdefault(node, {"id": node, "variables": [], **known})
            record["variables"] += [part.key] if part.role == "named" else []
            continue
        if part.src not in ids or part.dst not in ids or (part.high == 1 and not known):
            continue
        ends: Record = {"source": ids[part.src], "target": ids[part.dst]}
        record = ends | {"relation": path_text(part)} | known
        record |= {"either_way": True} if part.both else {}
        edges[(*ends.values(), record["relation"], part.both)] = record
    return list(nodes.values()), list(edges.values())


def path_text(edge: Edge) -> str:
    """Return a path of edges as text, such as ``isIn*1..3`` or ``*2..4``."""
    relations = "|".join(sorted(edge.relations)) if edge.relations != any_relation() else ""
    return f"{relations}*{edge.low}..{edge.high}"


def _of_node(node: Node) -> list[tuple[str, NodeValue | NodeAttribute]]:
    """Return the id and the possible attributes of a node, by name."""
    known: list[tuple[str, NodeValue | NodeAttribute]] = [("id", NodeValue(node.key))]
    return known + [
        (attribute.name, NodeAttribute(node.key, attribute, attribute.type))
        for attribute in NODE_ATTRIBUTES.values()
        if attribute.kinds & node.kinds.every and attribute.name not in _TWICE
    ]


def _of_edge(edge: Edge) -> list[tuple[str, EdgeRelation | EdgeAttribute]]:
    known: list[tuple[str, EdgeRelation | EdgeAttribute]] = [("relation", EdgeRelation(edge.key))]
    return known + [
        (attribute.name, EdgeAttribute(edge.key, attribute, attribute.type))
        for attribute in edge_attributes(edge)
    ]


def edge_attributes(edge: Edge) -> Iterator[Attribute]:
    """Yield the attributes that an edge of a pattern can have."""
    if edge.high > 1 or len(edge.relations) > 1:
        return
    for attribute in EDGE_ATTRIBUTES.values():
        gap = attribute.name == "gap"
        if gap and edge.relations <= {"leads", "follows"} and not edge.both:
            yield attribute
        if not gap and edge.relations == frozenset({"isIn"}):
            yield attribute


def _shown(
    nodes: Sequence[Mapping[str, Any]], edges: Sequence[Mapping[str, Any]]
) -> tuple[str, str]:
    """Return nodes and edges of a graph as text: ``e = car 0, v = car 3`` and ``car 0 -near-> car 3``."""
    called = {node["id"]: str(node.get("name", node["id"])) for node in nodes}
    named = (" = ".join([*node["variables"], called[node["id"]]]) for node in nodes)
    lines = (
        f"{called[edge['source']]} -{edge['relation']}-{'>' * ('either_way' not in edge)} "
        f"{called[edge['target']]}"
        for edge in edges
    )
    return ", ".join(named), ", ".join(lines)


# Rows for display ---


def for_people(
    columns: tuple[str, ...], rows: Iterable[tuple[Any, ...]], *, graphs: bool
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Return shorter columns and rows for display.

    Parameters
    ----------
    columns : tuple of str
        Columns of the query.
    rows : iterable of tuple
    graphs : bool
        True if each row ends in a graph, as with ``RETURN SUBGRAPHS``.

    Returns
    -------
    columns, rows
        A frame, or the first frame of an interval, as ``trace#seq``, which every command accepts; a variable
        as the name of its node; a graph as two texts. Rows without frame and interval are unchanged.
    """
    if columns[: len(INTERVAL_COLUMNS)] == INTERVAL_COLUMNS:
        return _intervals(columns, rows)
    if columns[: len(FRAME_COLUMNS)] != FRAME_COLUMNS:
        return columns, rows
    width = len(FRAME_COLUMNS)
    rest = columns[width:]
    named = {name.removesuffix(".name") for name in rest if name.endswith(".name")}
    keep = [i for i, name in enumerate(rest) if name not in named]
    called = (rest[i].removesuffix(".name") if _named(rest[i]) in rest else rest[i] for i in keep)

    def lines() -> Iterator[tuple[Any, ...]]:
        for row in rows:
            _, trace, seq, _, t = row[:width]
            values = [row[width + i] for i in keep]
            values[-2:] = _shown(*values[-2:]) if graphs else values[-2:]
            yield (f"{trace}#{seq}", round(t, 3), *values)

    return ("frame", "t", *called), lines()


def _named(name: str) -> str | None:
    """Return the variable whose name a column holds, or None."""
    return name.removesuffix(".name") if name.endswith(".name") else None


def _intervals(
    columns: tuple[str, ...], rows: Iterable[tuple[Any, ...]]
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    width = len(INTERVAL_COLUMNS)
    trace, first, start, end, frames = (
        INTERVAL_COLUMNS.index(name) for name in ("trace", "start_seq", "start", "end", "frames")
    )
    lines = (
        (
            f"{row[trace]}#{row[first]}",
            round(row[start], 3),
            round(row[end], 3),
            row[frames],
            *row[width:],
        )
        for row in rows
    )
    return ("from", "start", "end", "frames", *columns[width:]), lines


# The stages of the compiler as text, for ``--explain`` ------------------------------------------

_PLACES: Final = frozenset({"span", "name_span"})


def tree_text(part: Any) -> str:
    """Return a syntax tree as text, one part per line, without positions and absent parts."""
    return "\n".join(_tree(part, ""))


def _tree(part: Any, indent: str) -> list[str]:
    if not is_dataclass(part) or isinstance(part, type):
        return [f"{indent}{part!r}"]
    lines = [indent + type(part).__name__]
    for field in fields(part):
        value = getattr(part, field.name)
        if field.name in _PLACES or value in (None, (), False):
            continue
        inner = value if isinstance(value, tuple) else (value,)
        if any(is_dataclass(item) for item in inner):
            lines.append(f"{indent}  {field.name}:")
            lines += [line for item in inner for line in _tree(item, indent + "    ")]
        else:
            lines[0] += f" {field.name}={value!r}"
    return lines


def statements_text(statements: tuple[Statement, ...]) -> str:
    """Return the syntax trees of statements as text."""
    return "\n".join(tree_text(statement) for statement in statements)


def query_text(query: Query) -> str:
    """Return a bound query as text: variables, conditions and results."""
    lines = [line for stage in query.stages for line in _stage(stage)]
    lines += [] if query.stages else _scope(query.scope, "")
    result = query.result
    shown = [f"{column.name} = {value_text(column.value)}" for column in result.columns]
    lines.append(f"return {result.form}" + (f": {', '.join(shown)}" if shown else ""))
    if query.ego is not None:
        lines.append(f"ego {query.ego!r}")
    return "\n".join(lines)


def _stage(stage: Stage) -> list[str]:
    """Return the text lines of one stage of a query."""
    if isinstance(stage, MatchStage):
        return ["optional match" if stage.optional else "match", *_scope(stage.scope, "  ")]
    nodes = [new if new == key else f"{key} AS {new}" for new, key in stage.nodes]
    edges = [e.key if e.key == key else f"{key} AS {e.key}" for e, key in stage.edges]
    values = [f"{value_text(column.value)} AS {column.name}" for column in stage.values]
    lines = [f"with {'each ' * stage.grouped}{', '.join([*nodes, *edges, *values])}"]
    keys = [
        value_text(key.value) + " DESC" * key.descending
        for key in stage.order
        if not isinstance(key.value, str)
    ]
    lines += [f"  order by {', '.join(keys)}"] if keys else []
    lines += [f"  skip {stage.skip}"] if stage.skip else []
    lines += [] if stage.limit is None else [f"  limit {stage.limit}"]
    return [*lines, *(f"  where {value_text(condition)}" for condition in stage.where)]


def _passed(name: str) -> str:
    """Return the name in the query of a value that ``WITH`` passes on."""
    return name.removeprefix(PASSED).rpartition(" ")[0]


def _scope(scope: Scope, indent: str) -> list[str]:
    lines = [
        f"{indent}node {node.key}: {kinds_text(node.kinds)}"
        + ("" if node.role == "named" else f" ({node.role})")
        for node in scope.nodes.values()
    ]
    lines += [f"{indent}outside {key}: {kinds_text(kinds)}" for key, kinds in scope.outer.items()]
    lines += [f"{indent}edge {edge.key}: {edge_text(edge)}" for edge in scope.edges]
    lines += [f"{indent}where {value_text(condition, indent)}" for condition in scope.where]
    pairs = ", ".join(f"{a} ≠ {b}" for a, b in sorted(scope.distinct))
    return [*lines, f"{indent}distinct {pairs}"] if pairs else lines


def edge_text(edge: Edge) -> str:
    """Return an edge as text, with the keys of its nodes."""
    some = [relation for relation in RELATIONS if relation in edge.relations]
    label = "" if edge.relations == any_relation() else f":{'|'.join(some)}"
    times = "" if edge.high == 1 else f"*{edge.low}..{edge.high}"
    arrow = "-" if edge.both else "->"
    return f"({edge.src})-[{label}{times}]{arrow}({edge.dst})"


def kinds_text(kinds: Kinds) -> str:
    """Return the kinds of a node as text."""
    if kinds == any_kinds():
        return "anything"
    entities = entity_kinds()
    if not kinds.other:
        which = "" if kinds.ego == entities else f", a {_kinds(kinds.ego)}"
        return "the ego" + which
    without = "" if kinds.ego == kinds.other & entities else ", not the ego"
    if kinds.ego - kinds.other:
        without = ", or the ego"
    return _kinds(kinds.other) + without


def _kinds(kinds: frozenset[str]) -> str:
    return "|".join(kind for kind in KINDS if kind in kinds) or "nothing"


def unnumbered_text(value: Bound) -> str:
    """Return an expression as text, as :func:`value_text`, but without the numbers of unnamed nodes."""
    return _NUMBERED.sub(lambda found: "#" if found[0][0] == "#" else found[0], value_text(value))


_NUMBERED: Final = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|#\d+""")
"""Quoted texts, which are kept, and numbers of unnamed nodes."""


def value_text(value: Bound, indent: str = "") -> str:  # noqa: PLR0911 - a case each
    """Return an expression as text, close to the query language."""
    match value:
        case Value(value=constant):
            return "NULL" if constant is None else repr(constant)
        case Choices(items=items):
            return "[" + ", ".join(value_text(item) for item in items) + "]"
        case Operation():
            return _operation(value, indent)
        case BlockValue():
            return _block(value, indent)
        case Tense() | SignalCall() | StepTime() | OverMatch():
            return _over_time(value, indent)
        case Aggregate(word=word, operand=operand, distinct=distinct, share=share):
            inner = "*" if operand is None else value_text(operand, indent)
            inner += f", {share * 100:g}" if word == "percentile" else ""
            return f"{word}({'DISTINCT ' * distinct}{inner})"
        case GroupKey(name=name):
            return name
        case _:
            return _leaf(value)


def _over_time(value: Tense | SignalCall | StepTime | OverMatch, indent: str) -> str:
    match value:
        case Tense(word=word, operands=operands):
            bound = _bound(value)
            if len(operands) == 1:
                return f"{word}{bound} {value_text(operands[0], indent)}"
            left, right = (value_text(operand, indent) for operand in operands)
            return f"({left} {word}{bound} {right})"
        case SignalCall(word=word, operand=operand):
            back = word in {"delta", *WINDOWS}
            by = f", {_length(value.by, frames=value.frames)}" if back else ""
            counted = " in frames" if word in {"run_length", "since_true"} and value.frames else ""
            return f"{word}({value_text(operand, indent)}{by}){counted}"
        case StepTime(step=step):
            return f"t(step {step + 1})"
        case OverMatch(word=word, operand=operand, at=at):
            told = ", ".join(value_text(one, indent) for one in (operand, at) if one is not None)
            return f"{word.upper()}({told}) OVER {_part(value)}"


def _part(value: OverMatch) -> str:
    if value.start is None or value.end is None:
        return "match"
    same = value.start == value.end
    return f"step {value.start + 1}" + ("" if same else f"..{value.end + 1}")


def _bound(tense: Tense) -> str:
    if not tense.low and tense.high is None:
        return ""
    high = "INF" if tense.high is None else _length(tense.high, frames=tense.frames)
    return f"[{_length(tense.low, frames=tense.frames)}, {high}]"


def _length(amount: int, *, frames: bool) -> str:
    return f"{amount}frames" if frames else f"{amount / 1e9:g}s"


def _leaf(value: Bound) -> str:
    match value:
        case NodeValue(node=node):
            text = node
        case NodeAttribute(node=owner) | EdgeAttribute(edge=owner):
            text = f"{owner}.{value.attribute.name}"
        case FrameAttribute(attribute=attribute) if attribute.of_store or is_passed_on(value):
            text = _passed(attribute.name) if is_passed_on(value) else attribute.name
        case FrameAttribute(attribute=attribute):
            text = f"frame.{attribute.name}"
        case TraceAttribute(attribute=attribute):
            text = f"trace.{attribute.name}"
        case EdgeRelation(edge=edge):
            text = f"type({edge})"
        case PairNumber(function=function, a=a, b=b):
            text = as_written(function, a, b)
        case Happened(kind=kind, nodes=nodes):
            text = f"HAPPENS {kind}({', '.join(nodes)})"
        case LabelTest(node=node, kinds=kinds):
            text = f"{node} is {kinds_text(kinds)}"
        case _:
            text = repr(value)
    return text


def _operation(operation: Operation, indent: str) -> str:
    parts = [value_text(operand, indent) for operand in operation.operands]
    word = operation.word
    if word in INFIX:
        return "(" + f" {word} ".join(parts) + ")"
    if word == "case":
        pairs = zip(parts[::2], parts[1::2], strict=False)
        told = " ".join(f"WHEN {condition} THEN {value}" for condition, value in pairs)
        return f"CASE {told} ELSE {parts[-1]} END"
    if word.startswith("IS "):
        return f"({parts[0]} {word})"
    if word in {"NOT", "negative"}:
        return f"{'NOT ' if word == 'NOT' else '-'}{parts[0]}"
    return f"{word}({', '.join(parts)})"


def _block(block: BlockValue, indent: str) -> str:
    inside = _scope(block.scope, indent + "    ")
    if block.value is not None:
        inside.append(f"{indent}    value {value_text(block.value, indent)}")
    return "\n".join([f"{block.word} {{", *inside, f"{indent}  }}"])


# Compiler stages from text to statements: parse, bind, rewrite, emit. Each is a pure function ----


@dataclass(frozen=True, slots=True)
class Compiled:
    """Compiled query, ready to run on a store.

    Attributes
    ----------
    text : str
        Text of the query.
    bound : Query
        Query from the binder.
    query : Query
        Rewritten query.
    catalog : Catalog
        Catalog used for the compilation: of the named abstraction, or of the store.
    stored : Catalog, optional
        Catalog of the store.
    finder : function, optional
        For a query with steps: function that returns the matches and their computed values in a window of
        whole traces.
    """

    text: str
    bound: Query
    query: Query
    catalog: Catalog
    stored: Catalog | None = None
    finder: Callable[[tuple[Bound, ...], Window | None], ExternalRelation] | None = None

    @property
    def whole(self) -> Query:
        """Bound query. For a query that returns graphs: the query of the rows that form the graphs."""
        return self.bound if self.layout is None else Layout.of(self.bound).query

    @property
    def layout(self) -> Layout | None:
        """Layout of the result graphs. ``None`` if the query does not return graphs."""
        return Layout.of(self.bound) if self.bound.result.form == "subgraphs" else None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the result columns."""
        if self.layout is not None:
            return self.layout.columns
        return results.names_of(self.query)

    @property
    def chosen(self) -> tuple[TraceFacts, ...]:
        """Traces selected by the query, including traces that cannot answer it."""
        only, ego = self.catalog.only, self.query.ego
        chosen = [t for t in self.catalog.traces if ego in {None, t.ego}]
        return tuple(t for t in chosen if only is None or t.trace_id in only)

    @property
    def reasons(self) -> dict[str, str]:
        """Reason for each selected trace that lacks a relation of the query, by trace name."""
        if self.query.unknown_is_false:
            return {}
        wanted = self.query.relations
        missing = {trace.name: sorted(wanted - trace.answers) for trace in self.chosen}
        return {n: f"it knows nothing of {', '.join(some)}" for n, some in missing.items() if some}

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the selected traces that lack a relation of the query."""
        return tuple(self.reasons)

    def rows(self, window: Window | None = None, query: Query | None = None) -> SqlStatement:
        """Return the SQL for the rows of the query, or of another query with the same pattern."""
        query, writer, span = self._told(query or self.query, window)
        return results.rows(query, self.catalog, window, writer, span)

    def _told(
        self, query: Query, window: Window | None
    ) -> tuple[Query, SqlBuilder | None, results.Span | None]:
        """Return the query, a builder if its matches are already known, and the span of its matches."""
        if query.stages:
            return query, staged_matches(query, self.catalog, window), None
        if not query.steps:
            return query, None, None
        query, places = with_places(query)
        span = SPAN if query.spans else None
        told = (*places.values(), *(span or ()))
        if self.finder is None:
            found = nothing(query, len(told))
        elif window is not None:
            found = self.finder(tuple(places), window)
        else:
            found = partial(self.finder, tuple(places))
        return query, external_matches(query, self.catalog, found, told), span

    def frames(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for the matching frames, without duplicates, with their log times."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.frames(query, self.catalog, window, writer)

    def bindings(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for frames and bindings. ``RETURN`` is ignored."""
        return self.rows(window, replace(self.query, result=Result()))

    def intervals(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for intervals with constant results. Without ``RETURN``: with constant bindings.

        If the query returns rows, its order and its limit are ignored.
        """
        query, result = self.query, self.query.result
        if result.whole or result.aggregated or self.layout is not None:
            query = results.with_bindings(query)
        elif result.form != "intervals":
            result = Result(form="intervals", columns=result.columns, whole=False)
            query = replace(query, result=result)
        return self.rows(window, query)

    def bound_intervals(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for intervals in which the same nodes are bound. ``RETURN`` is ignored."""
        return self.rows(window, results.with_bindings(self.query))

    def clips(self, before_ns: int, after_ns: int, window: Window | None = None) -> SqlStatement:
        """Return the SQL for clips around the matching frames. Offsets of ``RETURN CLIPS`` take precedence.

        Parameters
        ----------
        before_ns, after_ns : int
            Time added before the first and after the last frame of each clip; ns.
        window : Window, optional
        """
        result = self.query.result
        if result.form != "clips":
            result = Result(form="clips", whole=False, before=-before_ns, after=after_ns)
        return self.rows(window, replace(self.query, result=result))

    def told_apart(self) -> Compiled:
        """Return the query with extra columns: the owner of each returned node, if rows have no frame."""
        result = results.with_owners(self.query.result)
        return replace(self, query=replace(self.query, result=result))

    def limited(self, most: int) -> Compiled:
        """Return the query with at most ``most`` rows, as with ``LIMIT``."""

        def limit(query: Query) -> Query:
            held = query.result.limit
            least = most if held is None else min(held, most)
            return replace(query, result=replace(query.result, limit=least))

        return replace(self, bound=limit(self.bound), query=limit(self.query))

    @property
    def in_windows(self) -> bool:
        """True if the rows can be computed window by window, independently of other windows."""
        result = self.query.result
        framed = result.whole or result.framed or result.form != "rows"
        across = result.distinct and not framed
        chosen = result.order or result.sample or result.top or result.skip
        return not (chosen or result.aggregated or across)

    @property
    def limited_to_frames(self) -> Compiled | None:
        """Query for the frame and log time of each row. ``None`` if the rows are not limited."""
        result = self.query.result
        if not result.chooses or result.form != "rows" or result.aggregated:
            return None
        time = FrameAttribute(FRAME_ATTRIBUTES["logtimens"], Type.number)
        columns = (*result.columns, ReturnColumn(f":{results.LOG_TIME}", time))
        result = replace(result, framed=True, columns=columns)
        return replace(self, query=replace(self.query, result=result))

    def stages(self) -> str:
        """Return the text after each stage of the compiler."""
        statements = parse(self.text)
        statement = self.rows()
        values = "".join(f"\n${i} = {v!r}" for i, v in enumerate(statement.values, start=1))
        parts = (
            ("parse", statements_text(statements)),
            ("bind", query_text(self.bound)),
            ("rewrite", query_text(self.query)),
            ("emit", statement.sql + values),
        )
        return "\n\n".join(f"---- {name}\n{text}" for name, text in parts)

    def count(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for the number of matching frames."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.count(query, self.catalog, window, writer)


def compile_query(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> Compiled:
    """Compile a query for a store.

    Parameters
    ----------
    text : str
        Text with one ``MATCH`` and the predicates that it needs.
    catalog : Catalog
        Catalog of the store.
    parameters : mapping of str to value
        Values of ``$name``: numbers, texts, truth values, or lists of these.

    Raises
    ------
    QuerySyntaxError
        The text does not match the grammar.
    QueryNameError
        An unknown name.
    QueryError
        Types do not match.
    """
    _log.debug("compiled for %d traces: %s", len(catalog.traces), text)
    with asking(catalog.names):
        statements = parse(text)
        seen = _seen(statements, catalog, parameters or {})
        bound = bind_query(text, statements, seen, parameters or {})
    whole = Layout.of(bound).query if bound.result.form == "subgraphs" else bound
    query = whole if whole.steps else rewritten(whole, seen)
    return Compiled(text, bound, query, seen, catalog)


def compile_checks(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> tuple[CheckInCatalog, ...]:
    """Bind the checks of a text. Their single-frame parts are compiled when the check runs.

    Parameters
    ----------
    text : str
        Text with ``CHECK`` statements and the predicates that they need.
    catalog, parameters
        As in :func:`compile_query`.

    Raises
    ------
    QueryError
        As in :func:`compile_query`, or a text without a check.
    """
    given = parameters or {}
    with asking(catalog.names):
        return bind_checks(text, parse(text), lambda one: _seen([one], catalog, given), given)


def _seen(statements: Sequence[object], catalog: Catalog, parameters: Mapping[str, Any]) -> Catalog:
    """Return the catalog for the abstraction, dataset and scope that the settings of a query select."""
    seen, world = catalog, any(isinstance(one, CheckClause) for one in statements)
    for statement in statements:
        for setting in (
            statement.settings if isinstance(statement, MatchClause | CheckClause) else ()
        ):
            value = setting.value
            name = value if isinstance(value, str) else str(parameters.get(value.name, ""))
            if normalize_name(setting.name) == "scope":
                world = name.lower() == "world"
            elif normalize_name(setting.name) == "abstraction":
                seen = replace(catalog.under(name) or catalog, only=seen.only)
            elif normalize_name(setting.name) == "dataset":
                only = traces_in(name, catalog.traces, catalog.tables, part=catalog.part)
                seen = replace(seen, only=only)
    return seen.in_world() if world else seen
