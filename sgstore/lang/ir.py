"""Queries after parsing and before SQL: patterns, sequences and checks with resolved names.

All names are resolved and all values have types ("bound"). The stages after the binder share these classes.

A *scope* is the content of one ``MATCH`` or one pair of braces: nodes, edges, conditions that must all be
true, and pairs of nodes that must differ. Node keys are unique in the query, ignoring case. Keys of unnamed
nodes begin with ``#``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, TypeGuard

from sgstore.errors import QueryError
from sgstore.lang.catalog import NODE_ATTRIBUTES, Attribute, DisplayUnit, RelationScope, Type
from sgstore.model.vocabulary import KINDS, RELATIONS, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.errors import TextSpan


@dataclass(frozen=True, slots=True)
class Kinds:
    """Kinds of node, such as car or lane, that a query variable may match.

    There is one set for the ego and one for other nodes.
    """

    ego: frozenset[str]
    other: frozenset[str]

    def __and__(self, more: Kinds) -> Kinds:
        return Kinds(self.ego & more.ego, self.other & more.other)

    def __or__(self, more: Kinds) -> Kinds:
        return Kinds(self.ego | more.ego, self.other | more.other)

    def __invert__(self) -> Kinds:
        every = any_kinds()
        return Kinds(every.ego - self.ego, every.other - self.other)

    def __bool__(self) -> bool:
        return bool(self.ego or self.other)

    def only(self, kinds: frozenset[str]) -> Kinds:
        """Return a copy in which only the given kinds of node are allowed."""
        return Kinds(self.ego & kinds, self.other & kinds)

    @property
    def every(self) -> frozenset[str]:
        """All allowed kinds of node, as the ego and as other nodes."""
        return self.ego | self.other

    @property
    def one_a_frame(self) -> bool:
        """True if only the ego is allowed. A frame has at most one such node."""
        return not self.other


def any_kinds() -> Kinds:
    """Return all known kinds of node, for the ego and for other nodes.

    Readers, settings and stores may add kinds.
    """
    return Kinds(entity_kinds(), frozenset(KINDS))


def ego_kinds() -> Kinds:
    """Return the kinds allowed for a variable that must be the ego: all kinds of entity."""
    return Kinds(entity_kinds(), frozenset())


def any_relation() -> frozenset[str]:
    """Return the names of all known relations. Stores and settings may add relations."""
    return frozenset(RELATIONS)


Scopes = tuple[tuple[RelationScope | None, tuple[int, ...]], ...]
"""Relation scopes (settings for entity pairs), each with the ids of its traces. ``None``: unknown scope."""


@dataclass(frozen=True, slots=True)
class Node:
    """Node of a graph pattern in a query.

    Attributes
    ----------
    key : str
    kinds : Kinds
    role : str
        ``named``: part of the match; ``unnamed``: without a name, but counted; ``hidden``: made by a
        rewriting, must only exist.
    span : TextSpan
    """

    key: str
    kinds: Kinds
    role: Literal["named", "unnamed", "hidden"]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Edge:
    """Edge of a graph pattern in a query, or path of several such edges (from ``low`` to ``high``).

    Attributes
    ----------
    key : str
        Name in the query, or a number.
    src, dst : str
        Keys of the two nodes.
    relations : frozenset of str
    both : bool
        True if the edge may also run from ``dst`` to ``src``.
    low, high : int
    named : bool
        True if the relation is part of a match.
    span : TextSpan
    known : bool
        True for an edge in braces: it is searched in all data of the scope. An edge of a pattern is searched
        in the graph only.
    beyond : Scopes
        For an edge in braces in scope ``world``: the relations of the traces. Empty if the edge covers all
        data, or if there is no data outside the graphs.
    online : bool
        True for an edge in braces in online mode: ``leads`` and ``follows`` may be unknown.
    """

    key: str
    src: str
    dst: str
    relations: frozenset[str]
    both: bool
    low: int
    high: int
    named: bool
    span: TextSpan
    known: bool = False
    beyond: Scopes = ()
    online: bool = False


@dataclass(frozen=True, slots=True)
class Value:
    """Constant in a query expression, with its type.

    Attributes
    ----------
    value, type
    closed : bool
        True for a canonical word of the vocabulary, false for a text of the user.
    unit : str
        ``s`` or ``frames`` if it was written as a duration, such as ``2s``. Ignored in comparisons.
    span : TextSpan or None
        Place of the duration in the query.
    written : float or None
        The original number, if it was rounded for a comparison.
    """

    value: int | float | str | bool | None
    type: Type
    closed: bool = False
    unit: str = field(default="", compare=False)
    span: TextSpan | None = field(default=None, compare=False)
    written: float | None = field(default=None, compare=False)

    @property
    def shown(self) -> float | str | bool | None:
        """Constant before rounding, as the query text has it."""
        return self.value if self.written is None else self.written


@dataclass(frozen=True, slots=True)
class Choices:
    """List of constants after ``IN`` in a query condition."""

    items: tuple[Value, ...]
    type: Type = Type.list


@dataclass(frozen=True, slots=True)
class NodeValue:
    """Expression whose value is a node of the pattern."""

    node: str
    type: Type = Type.node


@dataclass(frozen=True, slots=True)
class NodeAttribute:
    """Expression for an attribute of a node, such as ``v.speed``.

    ``online`` means online mode: roles of lanes may be unknown.
    """

    node: str
    attribute: Attribute
    type: Type
    online: bool = False


@dataclass(frozen=True, slots=True)
class LabelTest:
    """Condition: a node of an outer pattern has a label."""

    node: str
    kinds: Kinds
    type: Type = Type.boolean


@dataclass(frozen=True, slots=True)
class EdgeRelation:
    """Expression whose value is the name of the relation that an edge variable matches."""

    edge: str
    type: Type = Type.text


@dataclass(frozen=True, slots=True)
class EdgeAttribute:
    """Expression for an attribute of an edge from an entity to a lane.

    ``online`` means online mode: the primary lane may be unknown.
    """

    edge: str
    attribute: Attribute
    type: Type
    online: bool = False


@dataclass(frozen=True, slots=True)
class FrameAttribute:
    """Expression for an attribute of the frame: ``frame.name``.

    ``online`` means online mode: classes of graphs may be unknown.
    """

    attribute: Attribute
    type: Type
    online: bool = False


@dataclass(frozen=True, slots=True)
class TraceAttribute:
    """Expression for an attribute of the trace: ``trace.name``."""

    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class PairNumber:
    """Number computed for an ordered pair of entities, such as ``gap(a, b)``.

    ``online`` means online mode: distances along lanes may be unknown.
    """

    function: str
    a: str
    b: str
    type: Type = Type.number
    online: bool = False


@dataclass(frozen=True, slots=True)
class Happened:
    """Condition: the recording has an event of a given kind in this frame.

    Attributes
    ----------
    kind : str
        Kind of the event, one of :data:`sgstore.model.vocabulary.EVENT_KINDS`; or the name of a user table.
    nodes : tuple of str
        Nodes that the event involves: none, one or two.
    table : tuple of str
        For a user table: the columns with the entities, one for each node; one empty name if there are no
        nodes. Empty for an event of the recording, where the order of two entities does not matter.
    """

    kind: str
    nodes: tuple[str, ...]
    table: tuple[str, ...] = ()
    type: Type = Type.boolean


@dataclass(frozen=True, slots=True)
class Operation:
    """Operator or function with its operands, such as ``AND``, ``<``, ``+``, ``abs`` or ``IS NULL``."""

    word: str
    operands: tuple[Bound, ...]
    type: Type


@dataclass(frozen=True, slots=True)
class BlockValue:
    """Pattern in braces, as in ``EXISTS {…}``, ``COUNT {…}`` or ``MIN {… | value}``.

    ``number`` is unique in the query. ``source`` is its text in the query, with its place.
    """

    word: str
    scope: Scope
    value: Bound | None
    type: Type
    number: int
    source: tuple[str, int] | None = field(default=None, compare=False)

    @property
    def inside(self) -> tuple[Bound, ...]:
        """All expressions inside the braces: the conditions, and the value after ``|``."""
        return self.scope.where if self.value is None else (*self.scope.where, self.value)


@dataclass(frozen=True, slots=True)
class Aggregate:
    """Aggregate over the matches of a query, such as ``AVG(x)``, or ``COUNT(*)`` without an operand.

    ``share`` is the fraction of a percentile: 0.95 is the 95th percentile.
    """

    word: str
    operand: Bound | None
    distinct: bool
    type: Type
    share: float = 0.0


@dataclass(frozen=True, slots=True)
class GroupKey:
    """Grouping value of a query with aggregates: matches with equal values are one group.

    ``name`` is the name of its result column.
    """

    name: str
    type: Type


@dataclass(frozen=True, slots=True)
class Tense:
    """Temporal operator, such as ``EVENTUALLY``. Its operands are conditions at other frames.

    Attributes
    ----------
    word : str
        ``ALWAYS``, ``UNTIL``, ``PREVIOUS``, … as written.
    operands : tuple of Bound
        One or two conditions.
    low, high : int
        Bounds of the time window, relative to this frame, in ns or frames. If ``high`` is ``None``, the
        window reaches to the end of the trace.
    frames : bool
        True if the bounds count frames.
    """

    word: str
    operands: tuple[Bound, ...]
    low: int = 0
    high: int | None = None
    frames: bool = False
    type: Type = Type.boolean


@dataclass(frozen=True, slots=True)
class SignalCall:
    """Function of a value over time, such as ``prev(x)`` or ``delta(x, 2s)``, with its arguments.

    Attributes
    ----------
    word : str
        ``prev``, ``delta``, one of :data:`WINDOWS`, ``run_length``, ``since_true``, ``age``, ``exists_now`` or
        ``robustness``.
    operand : Bound
        A value, a condition (``run_length``, ``since_true``, ``robustness``), or a node (``age``,
        ``exists_now``).
    by : int
        Time step of ``delta``, or length of a window; ns or frames.
    frames : bool
        True if ``by``, or the result, counts frames; otherwise they are times.
    type : Type
    ahead : int
        Length of the part of a window after the frame; ns or frames.
    """

    word: str
    operand: Bound
    by: int = 0
    frames: bool = False
    type: Type = Type.number
    ahead: int = 0


WINDOWS: Final = ("min_over", "max_over", "avg_over", "sum_over")
"""Functions over a window of the last frames, or of frames on both sides."""

ANGLES: Final = frozenset(
    {"heading", "pitch", "roll", "bearing", "rel_heading", "apparent_heading", "heading_error"}
)
"""Names of angles: values that wrap around at 360 degrees."""


@dataclass(frozen=True, slots=True)
class StepTime:
    """Time at which a sequence step matches, in seconds since the start of the trace."""

    step: int
    type: Type = Type.number


OF_MATCH: Final = ("min", "max", "avg", "sum", "first", "last", "argmin", "argmax")
"""Functions over the frames of a match."""

PLACES: Final = frozenset({"argmin", "argmax"})
"""Functions over a match that select one of its frames."""


@dataclass(frozen=True, slots=True)
class OverMatch:
    """Aggregate over the frames of a match or of some steps, such as ``MIN(ttc(e, v)) OVER match``.

    Attributes
    ----------
    word : str
        One of :data:`OF_MATCH`.
    operand : Bound
        Value in each frame.
    start, end : int or None
        Numbers of the steps at which the part begins and ends. If equal: the run of frames in which the step
        holds. ``None`` means the whole match.
    at : Bound or None
        For ``argmin`` and ``argmax``: the value to return from the selected frame.
    type : Type
    """

    word: str
    operand: Bound
    start: int | None
    end: int | None
    at: Bound | None = None
    type: Type = Type.number


Bound = (
    Value
    | Choices
    | NodeValue
    | NodeAttribute
    | LabelTest
    | EdgeRelation
    | EdgeAttribute
    | FrameAttribute
    | TraceAttribute
    | PairNumber
    | Happened
    | Operation
    | BlockValue
    | Aggregate
    | GroupKey
    | Tense
    | SignalCall
    | StepTime
    | OverMatch
)

Calls = dict[Bound, str]
"""Compiled condition of a predicate call → text of the call in the query."""


@dataclass(frozen=True, slots=True, eq=False)
class Scope:
    """Graph pattern (nodes, edges, conditions) of one ``MATCH`` or one pair of braces.

    Two scopes are equal only if they are the same object.

    Attributes
    ----------
    nodes : mapping of str to Node
        Own nodes by key.
    outer : mapping of str to Kinds
        Nodes of enclosing scopes that this scope or its blocks use, with the kinds allowed here.
    edges : tuple of Edge
    where : tuple of Bound
        Conditions that must all be true.
    distinct : frozenset of pairs
        Keys of nodes that must not be bound to the same node.
    """

    nodes: Mapping[str, Node]
    outer: Mapping[str, Kinds]
    edges: tuple[Edge, ...]
    where: tuple[Bound, ...]
    distinct: frozenset[tuple[str, str]]

    def kinds(self, key: str) -> Kinds:
        """Return the kinds that a node may have, in this pattern or in the pattern around it."""
        return self.nodes[key].kinds if key in self.nodes else self.outer[key]


FRAME_COLUMNS: Final = ("frame_id", "trace", "seq", "time_ns", "t")
"""Columns that identify the frame of a row. ``t`` is in seconds since the start of the trace."""

INTERVAL_COLUMNS: Final = (
    "trace",
    "start_seq",
    "end_seq",
    "start_ns",
    "end_ns",
    "start",
    "end",
    "frames",
)
"""Columns of an interval: its ends as frame numbers, simulation times, and seconds since the start of the
trace."""

CLIP_COLUMNS: Final = ("trace", "start_ns", "end_ns")
"""Columns of a clip. Its start and end are log times that include the offsets around the match."""

Form = Literal["rows", "intervals", "clips", "subgraphs"]


@dataclass(frozen=True, slots=True)
class ReturnColumn:
    """Column of a query result: an expression, and the name of the column.

    Attributes
    ----------
    name : str
    value : Bound
    single : bool
        True if the value has 32 bits. It is returned with the shortest decimal text of that number.
    """

    name: str
    value: Bound
    single: bool = False


@dataclass(frozen=True, slots=True)
class SortKey:
    """Key of ``ORDER BY``: an expression, or the name of a result column."""

    value: Bound | str
    descending: bool


@dataclass(frozen=True, slots=True)
class Sampling:
    """Limit per group: a query result has at most ``number`` rows for each value of ``per``.

    If ``per`` is ``None``, the limit is for all results.
    """

    number: int
    per: Bound | str | None


@dataclass(frozen=True, slots=True)
class Result:
    """Result clause of a query: its columns, and its form, such as rows or intervals.

    Attributes
    ----------
    form : str
        ``rows``, ``intervals``, ``clips`` or ``subgraphs``.
    columns : tuple of ReturnColumn
        Returned values; empty without ``RETURN``.
    whole : bool
        True if the frame and the variables are returned too: without ``RETURN``, or for ``*``.
    framed : bool
        True if the frame is returned with the values.
    distinct : bool
    having : Bound or None
        Condition that a returned group or interval must meet.
    order : tuple of SortKey
    sample : Sampling or None
    top : Sampling or None
        Limit of the first results for each value.
    skip : int
        Number of rows to skip.
    limit : int or None
    before, after : int
        Offsets of clips; ns, negative is earlier.
    keyed : bool
        True if intervals and clips also have the columns that order results of several stores: see
        :mod:`sgstore.lang.sql.collection_parts`.
    """

    form: Form = "rows"
    columns: tuple[ReturnColumn, ...] = ()
    whole: bool = True
    framed: bool = False
    distinct: bool = False
    having: Bound | None = None
    order: tuple[SortKey, ...] = ()
    sample: Sampling | None = None
    top: Sampling | None = None
    skip: int = 0
    limit: int | None = None
    before: int = 0
    after: int = 0
    keyed: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the first result columns: those that identify a frame, an interval or a clip."""
        if self.form == "subgraphs":
            return FRAME_COLUMNS
        if self.form != "rows":
            return INTERVAL_COLUMNS if self.form == "intervals" else CLIP_COLUMNS
        return FRAME_COLUMNS if self.whole or self.framed else ()

    @property
    def values(self) -> list[Bound]:
        """All expressions of the result clause, from columns, ``HAVING``, sorting and sampling."""
        per = [chosen.per for chosen in (self.sample, self.top) if chosen is not None]
        values = [*(column.value for column in self.columns), *(key.value for key in self.order)]
        every = (*values, self.having, *per)
        return [v for v in every if v is not None and not isinstance(v, str)]

    @property
    def aggregated(self) -> bool:
        """True if the result has aggregates such as ``COUNT(*)``, instead of a list of matches."""
        having = [] if self.having is None else [self.having]
        values = (*(column.value for column in self.columns), *having)
        return any(isinstance(e, Aggregate) for value in values for e in walk(value))

    @property
    def groups(self) -> bool:
        """True if one row may come from several frames: by aggregates, or by ``DISTINCT`` values."""
        return self.aggregated or (self.distinct and not (self.whole or self.framed))

    @property
    def chooses(self) -> bool:
        """True if ``SKIP``, ``LIMIT`` or ``HAVING`` may remove matches from the result."""
        chosen = self.limit is not None or self.top is not None or self.skip > 0
        return chosen or (self.having is not None and not self.aggregated)

    @property
    def among_rows(self) -> list[str]:
        """Names of the clauses that need all rows at once, because they sort, select or aggregate them."""
        clauses = {
            "aggregates such as COUNT(*)": self.aggregated,
            "DISTINCT": self.distinct,
            "ORDER BY": bool(self.order),
            "SAMPLE": self.sample is not None,
            "LIMIT … PER": self.top is not None,
            "SKIP": self.skip > 0,
            "LIMIT": self.limit is not None,
        }
        return [word for word, used in clauses.items() if used]

    def having_of_match(self, reason: str) -> Bound | None:
        """Return the ``HAVING`` condition for a single match, in which expressions replace the column names.

        Parameters
        ----------
        reason : str
            The reason for an error: "a monitor reports single matches".

        Raises
        ------
        QueryError
            The condition is about groups of matches, or about the ends of intervals.
        """
        if self.having is None:
            return None
        hint = "write a value of the match: HAVING MIN(x) OVER match < 1 or HAVING LAST(frame.t) OVER match > 5"
        if self.aggregated:
            raise QueryError(f"{reason}, so HAVING has no groups", hint=hint)
        columns = {column.name: column.value for column in self.columns}

        def resolved(part: Bound) -> Bound:
            if not isinstance(part, GroupKey):
                return with_operands(part, resolved)
            if part.name not in columns:
                told = f"{reason}, so '{part.name}' of {self.form} is unknown"
                raise QueryError(told, hint=hint)
            return columns[part.name]

        return resolved(self.having)

    def changed(self, change: Callable[[Bound], Bound]) -> Result:
        """Return a copy of the result clause with a function applied to every expression."""

        def key(value: Bound | str) -> Bound | str:
            return value if isinstance(value, str) else change(value)

        def each(one: Sampling | None) -> Sampling | None:
            return one and replace(one, per=one.per and key(one.per))

        return replace(
            self,
            columns=tuple(replace(column, value=change(column.value)) for column in self.columns),
            having=self.having and change(self.having),
            order=tuple(replace(one, value=key(one.value)) for one in self.order),
            sample=each(self.sample),
            top=each(self.top),
        )


@dataclass(frozen=True, slots=True)
class PathValue:
    """Named path of a pattern. Its value is the list of its nodes.

    Attributes
    ----------
    place : FrameAttribute
        Placeholder for the path in expressions.
    nodes : tuple of str
        Keys of the nodes written in the path.
    edges : tuple of (str, bool)
        Keys of the edges between these nodes. The flag is true if the edge is written from ``dst`` to ``src``.
    """

    place: FrameAttribute
    nodes: tuple[str, ...]
    edges: tuple[tuple[str, bool], ...]


@dataclass(frozen=True, slots=True)
class PathWay:
    """Graph pattern in which each path has a fixed length. ``nodes``: the node keys of each path."""

    scope: Scope
    nodes: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class MatchStage:
    """Clause ``MATCH`` or ``OPTIONAL MATCH`` of a query with several clauses.

    Attributes
    ----------
    scope : Scope
        Pattern of the ``MATCH``. Its outer nodes are the nodes of earlier stages that it uses.
    optional : bool
        True for ``OPTIONAL MATCH``: earlier matches are kept if this stage has no match.
    paths : tuple of PathValue
    ways : tuple of PathWay
        In a rewritten query: one pattern for each combination of path lengths.
    apart : tuple of (str, str)
        Own nodes, each with a node of an earlier stage that it must differ from, unless that one is NULL.
        The scope does not use the earlier node.
    """

    scope: Scope
    optional: bool
    paths: tuple[PathValue, ...] = ()
    ways: tuple[PathWay, ...] = ()
    apart: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class WithStage:
    """Clause ``WITH``: in each frame, it selects the variables and values that later clauses can use.

    Attributes
    ----------
    before, after : Scope
        Nodes and edges bound before and after the stage; without conditions.
    nodes : tuple of (str, str)
        Keys of the passed nodes, after and before the stage.
    edges : tuple of (Edge, str)
        Passed edges, and their keys before the stage.
    values : tuple of ReturnColumn
        Computed values.
    places : tuple of FrameAttribute
        Placeholder for each value in later stages.
    grouped : bool
        True with an aggregate or with ``DISTINCT``: variables that are not passed end here, and each
        combination of passed values occurs once.
    order : tuple of SortKey
    skip : int
    limit : int or None
        Limit of rows in each frame.
    where : tuple of Bound
    """

    before: Scope
    after: Scope
    nodes: tuple[tuple[str, str], ...]
    edges: tuple[tuple[Edge, str], ...]
    values: tuple[ReturnColumn, ...]
    places: tuple[FrameAttribute, ...]
    grouped: bool
    order: tuple[SortKey, ...] = ()
    skip: int = 0
    limit: int | None = None
    where: tuple[Bound, ...] = ()

    @property
    def expressions(self) -> tuple[Bound, ...]:
        """All expressions of the ``WITH`` clause."""
        order = (key.value for key in self.order if not isinstance(key.value, str))
        return (*(column.value for column in self.values), *order, *self.where)

    def changed(self, change: Callable[[Bound], Bound]) -> WithStage:
        """Return a copy of the ``WITH`` clause with a function applied to every expression."""
        values = tuple(replace(column, value=change(column.value)) for column in self.values)
        order = tuple(
            replace(key, value=change(key.value))
            for key in self.order
            if not isinstance(key.value, str)
        )
        return replace(self, values=values, order=order, where=tuple(map(change, self.where)))


Stage = MatchStage | WithStage

PASSED: Final = ":with "
"""Prefix of the names of values that ``WITH`` passes on."""


def passed_on(
    name: str, kind: Type, precision: str = "", *, stored: bool = False
) -> FrameAttribute:
    """Return a placeholder expression for a value that ``WITH`` passes on."""
    attribute = Attribute(name, kind, {}, "", DisplayUnit.whole, precision=precision, stored=stored)
    return FrameAttribute(attribute, kind)


def is_passed_on(value: Bound) -> TypeGuard[FrameAttribute]:
    """True if an expression is a placeholder for a value that ``WITH`` passes on."""
    return isinstance(value, FrameAttribute) and value.attribute.name.startswith(PASSED)


def items_of(value: Bound) -> Type | None:
    """If an expression is a collected list, return the type of its items; otherwise None."""
    if isinstance(value, Aggregate) and value.type is Type.list and value.operand is not None:
        return value.operand.type
    if not is_passed_on(value) or value.type is not Type.list or is_path(value):
        return None
    return Type(value.attribute.meaning)


def is_path(value: Bound) -> bool:
    """True if an expression is a placeholder for a named path."""
    return is_passed_on(value) and value.attribute.name.rpartition(" ")[2][0] == "p"


@dataclass(frozen=True, slots=True)
class Query:
    """Query with resolved names and known types, as the SQL generator uses it.

    Attributes
    ----------
    scope : Scope
        Pattern of the ``MATCH``. With steps or stages: all their nodes and their named edges, without
        conditions.
    result : Result
    relations : frozenset of str
        All relations named in the query. A trace must know them.
    injective : bool
        True if different nodes of a pattern must be bound to different nodes.
    ego : str or None
        Simulator id of the chosen ego.
    unknown_is_false : bool
        True if relations that a trace does not know count as absent.
    steps : tuple of BoundStep
        Steps of a query over several frames; otherwise empty.
    links : tuple of StepLink
        Links between the steps; empty if :attr:`alternatives` hold them.
    alternatives : tuple of StepWay
        All sequences that an expression of steps stands for.
    policy : str
        Matches of a sequence to return: ``all``, ``first``, ``longest``.
    gaps : str
        ``break``: a gap in the recording ends a run; ``bridge``: it does not.
    stages : tuple of MatchStage and WithStage
        Parts of a query with ``OPTIONAL MATCH``, ``WITH`` or a named path. The first is a pattern.
    world : bool
        True in scope ``world``: the query also covers data outside the graphs.
    calls : mapping of Bound to str
        Calls of predicates in the query: meaning → text.
    doubts : tuple of str
        Notes on parts that never hold in recordings, or always.
    """

    scope: Scope
    result: Result
    relations: frozenset[str]
    injective: bool = True
    ego: str | None = None
    unknown_is_false: bool = False
    steps: tuple[BoundStep, ...] = ()
    links: tuple[StepLink, ...] = ()
    alternatives: tuple[StepWay, ...] = ()
    policy: str = "all"
    gaps: str = "break"
    stages: tuple[Stage, ...] = ()
    world: bool = False
    doubts: tuple[str, ...] = ()
    calls: Calls = field(default_factory=dict["Bound", str], compare=False, repr=False)

    @property
    def ways(self) -> tuple[StepWay, ...]:
        """Plain step sequences of the query: several for groups such as ``(A | B)``, otherwise one."""
        if self.alternatives:
            return self.alternatives
        happen = tuple(n for n, step in enumerate(self.steps) if not step.absent)
        return (StepWay(tuple(range(len(self.steps))), happen, self.links),)

    @property
    def spans(self) -> bool:
        """True if a match of the query can be longer than one frame."""
        return len(self.steps) > 1 or bool(self.alternatives)

    @property
    def certain(self) -> frozenset[int]:
        """Numbers of the sequence steps that every match contains."""
        return frozenset.intersection(*(frozenset(way.happen) for way in self.ways))

    @property
    def patterns(self) -> tuple[Scope, ...]:
        """All graph patterns of the query: those of its steps, or of its ``MATCH`` clauses."""
        stages = (stage.scope for stage in self.stages if isinstance(stage, MatchStage))
        found = (*(step.scope for step in self.steps), *stages)
        return found or (self.scope,)

    @property
    def required(self) -> tuple[Scope, ...]:
        """Graph patterns that every match must meet: all except those of ``OPTIONAL MATCH``."""
        stages = (s for s in self.stages if isinstance(s, MatchStage) and not s.optional)
        return tuple(stage.scope for stage in stages) or (self.scope,)

    @property
    def first(self) -> Scope:
        """Graph pattern of the first ``MATCH`` clause for single frames."""
        return self.required[0]


def passed_values(query: Query) -> tuple[FrameAttribute, ...]:
    """Return placeholders for the ``WITH`` values and paths that exist after the last clause."""
    found: tuple[FrameAttribute, ...] = ()
    for stage in query.stages:
        if isinstance(stage, WithStage):
            found = stage.places if stage.grouped else found + stage.places
        else:
            found += tuple(path.place for path in stage.paths)
    return found


def any_of(conditions: Iterable[Bound]) -> Bound:
    """Join conditions by ``OR``.

    Without conditions it is false.
    """
    found = tuple(conditions)
    if len(found) < 2:
        return found[0] if found else Value(value=False, type=Type.boolean)
    return Operation("OR", found, Type.boolean)


def all_of(*conditions: Bound) -> Bound:
    """Join conditions by ``AND``. At least one condition is required."""
    return conditions[0] if len(conditions) == 1 else Operation("AND", conditions, Type.boolean)


def inverse(condition: Bound) -> Operation:
    """Return the negation of a condition."""
    return Operation("NOT", (condition,), Type.boolean)


def is_one_of(value: Bound, numbers: Iterable[int]) -> Operation:
    """Return a condition: true if a value is in a list of numbers."""
    choices = Choices(tuple(Value(number, Type.number) for number in numbers))
    return Operation("IN", (value, choices), Type.boolean)


def node_among(node: str, ids: Iterable[int]) -> Operation:
    """Return a condition: true if the id of a node is in a list of ids."""
    return is_one_of(NodeAttribute(node, NODE_ATTRIBUTES["id"], Type.number), ids)


def operands_of(expression: Bound) -> tuple[Bound, ...]:
    """Return the direct operands of an expression. Expressions inside braces do not count."""
    match expression:
        case Operation(operands=operands) | Tense(operands=operands):
            return operands
        case Aggregate(operand=operand) | SignalCall(operand=operand) if operand is not None:
            return (operand,)
        case OverMatch(operand=operand, at=at):
            return (operand,) if at is None else (operand, at)
        case _:
            return ()


def with_operands(expression: Bound, change: Callable[[Bound], Bound]) -> Bound:
    """Return a copy of an expression with a function applied to each direct operand."""
    match expression:
        case Operation(operands=operands) | Tense(operands=operands):
            return replace(expression, operands=tuple(map(change, operands)))
        case Aggregate(operand=operand) | SignalCall(operand=operand) if operand is not None:
            return replace(expression, operand=change(operand))
        case OverMatch(operand=operand, at=at):
            return replace(expression, operand=change(operand), at=at and change(at))
        case _:
            return expression


def walk(expression: Bound) -> Iterator[Bound]:
    """Yield an expression and all its subexpressions. Expressions inside braces do not count."""
    yield expression
    for operand in operands_of(expression):
        yield from walk(operand)


def conjuncts(expression: Bound) -> list[Bound]:
    """Split an expression at ``AND``, and return the conditions as a list."""
    if isinstance(expression, Operation) and expression.word == "AND":
        return [part for operand in expression.operands for part in conjuncts(operand)]
    return [expression]


def is_temporal(expression: Bound) -> bool:
    """True if the value of an expression depends on more than one frame."""
    return any(
        isinstance(part, Tense | SignalCall | StepTime | OverMatch) for part in walk(expression)
    )


def is_formula(expression: Bound) -> bool:
    """True if an expression is a condition over time, such as ``NOT EVENTUALLY x``.

    Such a condition is never unknown.

    Conditions joined by ``AND`` are handled separately, as in ``WHERE``. A condition on this frame alone may
    be unknown.
    """
    if not isinstance(expression, Operation):
        return isinstance(expression, Tense)
    joined = expression.word in {"OR", "NOT", "XOR", "IMPLIES"} and is_temporal(expression)
    of_matches = StepTime | OverMatch | Aggregate | GroupKey
    return joined and not any(
        isinstance(part, of_matches) or is_passed_on(part) for part in walk(expression)
    )


def is_angle(value: Bound) -> bool:
    """True if the value of an expression is an angle, which restarts after 360 degrees."""
    match value:
        case NodeAttribute(attribute=attribute) | EdgeAttribute(attribute=attribute):
            return attribute.name in ANGLES
        case PairNumber(function=function):
            return function in ANGLES
        case _:
            return False


def is_counted(expression: Bound) -> bool:
    """True if an expression contains an aggregate over all matches."""
    return any(isinstance(part, Aggregate) for part in walk(expression))


def same_chain(where: Iterable[Bound]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of lanes for which a condition requires the same chain. They may be one lane."""
    for condition in where:
        match condition:
            case Operation("=", (NodeAttribute(a, of_a), NodeAttribute(b, of_b))) if (
                of_a.unit is of_b.unit is DisplayUnit.chain
            ):
                yield a, b
            case _:
                pass


def nodes_of(expression: Bound) -> frozenset[str]:
    """Return the keys of the nodes in an expression. In braces, only nodes of the outer pattern count."""
    found: set[str] = set()
    for part in walk(expression):
        match part:
            case NodeValue(node=node) | NodeAttribute(node=node) | LabelTest(node=node):
                found.add(node)
            case PairNumber(a=a, b=b):
                found |= {a, b}
            case Happened(nodes=nodes):
                found |= set(nodes)
            case BlockValue(scope=scope):
                found |= set(scope.outer)
            case _:
                pass
    return frozenset(found)


def edges_of(expression: Bound) -> frozenset[str]:
    """Return the keys of the edges in an expression. Edges inside braces do not count."""
    edges = (EdgeRelation, EdgeAttribute)
    return frozenset(part.edge for part in walk(expression) if isinstance(part, edges))


def blocks_of(expression: Bound) -> tuple[BlockValue, ...]:
    """Return the patterns in braces, such as ``EXISTS {…}``, in an expression; not those inside them."""
    return tuple(part for part in walk(expression) if isinstance(part, BlockValue))


def all_blocks(expressions: Iterable[Bound]) -> Iterator[BlockValue]:
    """Yield all patterns in braces in some expressions, also those inside others."""
    for expression in expressions:
        for block in blocks_of(expression):
            yield block
            yield from all_blocks(block.inside)


@dataclass(frozen=True, slots=True)
class Length:
    """Duration in a query: a number of nanoseconds or of frames."""

    amount: int
    frames: bool


_COMPARE: Final[Mapping[str, Callable[[Any, int, int], Any]]] = {
    ">=": lambda length, amount, by: length >= amount - by,
    ">": lambda length, amount, by: length > amount + by,
    "<=": lambda length, amount, by: length <= amount + by,
    "<": lambda length, amount, by: length < amount - by,
    "=": lambda length, amount, by: abs(length - amount) <= by,
}
"""Comparison operators for lengths. Lengths within the tolerance are equal."""


@dataclass(frozen=True, slots=True)
class BoundHold:
    """Required duration of a sequence step, from the first to the last frame in which it matches.

    Attributes
    ----------
    comparison : str
    length : Length
        Duration to compare with; if in frames, the number of frames.
    inclusive : bool
        True if one median frame period is added to the duration of the run.
    """

    comparison: str
    length: Length
    inclusive: bool

    def fits(self, length: Any, tolerance: int) -> Any:
        """Return True if a duration meets the condition. For an array, return an array.

        Parameters
        ----------
        length : int or (R,) int
            Length of the run; ns or frames.
        tolerance : int
            Tolerance for times; ns.

        Returns
        -------
        bool or (R,) bool
        """
        by = 0 if self.length.frames else tolerance
        return _COMPARE[self.comparison](length, self.length.amount, by)


@dataclass(frozen=True, slots=True)
class StepLink:
    """Time relation between a sequence step and the step before it, such as ``THEN WITHIN 5s``.

    Attributes
    ----------
    kind : str
        ``then``: in a later frame, at least ``after`` and at most ``within`` later; ``immediately``: in the
        next frame; ``until``: in the frame after a run of the previous step; ``while``: in the same frame.
    after, within : Length or None
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Length | None
    within: Length | None


@dataclass(frozen=True, slots=True)
class StepWay:
    """Plain sequence of steps, one of several of a query: ``A THEN B``, from ``A THEN (B | C)``.

    Attributes
    ----------
    steps : tuple of int
        Numbers of the steps. A repeated step occurs several times.
    happen : tuple of int
        Numbers of the steps that must occur, without absent steps.
    links : tuple of StepLink
    """

    steps: tuple[int, ...]
    happen: tuple[int, ...]
    links: tuple[StepLink, ...]


@dataclass(frozen=True, slots=True)
class BoundStep:
    """Step of a sequence: a graph pattern, with additional conditions and a duration.

    Attributes
    ----------
    scope : Scope
        Pattern that one frame must match. Nodes shared with other steps have the same keys.
    when : tuple of Bound
        Further conditions, which use other frames.
    hold : BoundHold or None
    absent : bool
        True for ``NOT MATCH``: the pattern must not occur between the neighbouring steps.
    span : TextSpan
    """

    scope: Scope
    when: tuple[Bound, ...]
    hold: BoundHold | None
    absent: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class BoundQuantifier:
    """Quantifier of a check: ``FORALL`` or ``FORSOME`` over the entities of a trace.

    Attributes
    ----------
    word : str
    nodes : tuple of str
        Keys of the variables.
    where : Bound or None
        Condition that the entities must meet in at least one frame to be included.
    absent : bool
        True if a condition on an absent entity counts as true; otherwise it is false.
    """

    word: str
    nodes: tuple[str, ...]
    where: Bound | None
    absent: bool


@dataclass(frozen=True, slots=True)
class BoundCheck:
    """``CHECK`` statement with resolved names: a condition that a trace must meet from its first frame.

    Attributes
    ----------
    name : str
    scope : Scope
        Nodes of the check: its variables and the ego; without conditions.
    quantifiers : tuple of BoundQuantifier
    formula : Bound
    reset : Bound or None
        After a violation, the check restarts in the frame after this condition holds.
    relations : frozenset of str
    injective : bool
    ego : str or None
    unknown_is_false : bool
        As in :class:`Query`.
    end : str
        Meaning of the end of a trace for unmet obligations: ``bounded`` (pending if the bound has not passed,
        otherwise failed), ``strong`` (failed), ``weak`` (met), ``pending`` (pending).
    gaps : str
        ``break``: a gap in the recording ends a run; ``bridge``: it does not; ``unknown``: the events in the
        gap are unknown.
    robustness : bool
        True if the robustness of the formula is computed: the margin by which it is true or false.
    returns : tuple of ReturnColumn
        Values to return for each violation.
    having : Bound or None
        Condition of the listed violations, on their values. The verdict does not depend on it.
    world : bool
        As in :class:`Query`.
    range : float or None
        Explicit range of the check around the ego; m. ``None`` means the range of the formula.
    limit : float or None
        The range, if traces may cover more. Entities farther away count as absent; m.
    doubts : tuple of str
        As in :class:`Query`.
    """

    name: str
    scope: Scope
    quantifiers: tuple[BoundQuantifier, ...]
    formula: Bound
    reset: Bound | None
    relations: frozenset[str]
    injective: bool = True
    ego: str | None = None
    unknown_is_false: bool = False
    end: str = "bounded"
    gaps: str = "break"
    robustness: bool = False
    returns: tuple[ReturnColumn, ...] = ()
    having: Bound | None = None
    world: bool = True
    range: float | None = None
    limit: float | None = None
    doubts: tuple[str, ...] = ()
