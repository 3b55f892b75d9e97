"""The IR: bound patterns, sequences and checks.

Every name is resolved and every value typed. The stages after the binder share these classes.

A *scope* is what stands in one ``MATCH`` or one pair of braces: nodes, edges, conditions that all must be true,
and which nodes must differ. Nodes have keys that are unique in the query whatever the case of letters; those of
unnamed nodes begin with ``#``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, Literal, TypeGuard

from sgstore.lang._catalog import NODE_ATTRIBUTES, Attribute, DisplayUnit, RelationScope, Type
from sgstore.lang._durations import (
    BoundHold,  # noqa: TC001  they are of this module
    Length,  # noqa: F401  # pyright: ignore[reportUnusedImport]
)
from sgstore.lang._ir_leaves import (
    Choices,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    Happened,
    LabelTest,
    NodeAttribute,
    NodeValue,
    PairNumber,
    TraceAttribute,
    Value,
)
from sgstore.lang._kind_sets import Kinds as Kinds  # noqa: PLC0414, TC001
from sgstore.lang._kind_sets import any_kinds as any_kinds  # noqa: PLC0414
from sgstore.lang._kind_sets import any_relation as any_relation  # noqa: PLC0414
from sgstore.lang._kind_sets import ego_kinds as ego_kinds  # noqa: PLC0414
from sgstore.lang._links import StepLink, StepWay
from sgstore.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.errors import TextSpan


Scopes = tuple[tuple[RelationScope | None, tuple[int, ...]], ...]
"""Which pairs of entities are related in traces, and the ids of the traces; ``None``: that is not known."""


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a pattern.

    Attributes
    ----------
    key : str
    kinds : Kinds
    role : str
        ``named`` in the query and part of what is found; ``unnamed``, but counted; or ``hidden``: made by a
        rewriting, only asked to exist.
    span : TextSpan
    """

    key: str
    kinds: Kinds
    role: Literal["named", "unnamed", "hidden"]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Edge:
    """An edge of a pattern, or a path of ``low`` to ``high`` edges.

    Attributes
    ----------
    key : str
        Its name in the query, or a number.
    src, dst : str
        Keys of its nodes.
    relations : frozenset of str
    both : bool
        Whether it may also run from ``dst`` to ``src``.
    low, high : int
    named : bool
        Whether its relation is part of a match.
    span : TextSpan
    known : bool
        Whether it is asked of all that is known in the scope: it stands in braces. One of a pattern is an
        edge of the graph in every scope.
    beyond : Scopes
        Of one in braces, in scope ``world``: which relations the traces have. Empty where it is told of all
        that is known, or nothing is beyond the graphs.
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


# Expressions --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Operation:
    """Anything that is computed of its operands: ``AND``, ``<``, ``+``, ``abs``, ``IN``, ``IS NULL``."""

    word: str
    operands: tuple[Bound, ...]
    type: Type


@dataclass(frozen=True, slots=True)
class BlockValue:
    """``EXISTS {…}``, ``COUNT {…}``, ``MIN {… | value}``; ``number`` tells the blocks of a query apart."""

    word: str
    scope: Scope
    value: Bound | None
    type: Type
    number: int

    @property
    def inside(self) -> tuple[Bound, ...]:
        """The conditions in its braces, and the value behind them."""
        return self.scope.where if self.value is None else (*self.scope.where, self.value)


@dataclass(frozen=True, slots=True)
class Aggregate:
    """``COUNT(*)``, ``AVG(x)``, … over the matches of a query; ``COUNT(*)`` has no operand.

    ``share`` is that of a percentile: 0.95 is the 95th.
    """

    word: str
    operand: Bound | None
    distinct: bool
    type: Type
    share: float = 0.0


@dataclass(frozen=True, slots=True)
class GroupKey:
    """A value by which matches are grouped, beside what is counted of them: the column that is called so."""

    name: str
    type: Type


@dataclass(frozen=True, slots=True)
class Tense:
    """An operator of time: its operands at other frames than this one.

    Attributes
    ----------
    word : str
        ``ALWAYS``, ``UNTIL``, ``PREVIOUS``, … as written.
    operands : tuple of Bound
        One or two conditions.
    low, high : int
        From when to when it looks, away from this frame; ns, or frames. ``high`` is ``None`` if it looks as far
        as the trace goes.
    frames : bool
        Whether the bound counts frames.
    """

    word: str
    operands: tuple[Bound, ...]
    low: int = 0
    high: int | None = None
    frames: bool = False
    type: Type = Type.boolean


@dataclass(frozen=True, slots=True)
class SignalCall:
    """A function of how something went.

    Attributes
    ----------
    word : str
        ``prev``, ``delta``, one of :data:`WINDOWS`, ``run_length``, ``since_true``, ``age``, ``exists_now`` or
        ``robustness``.
    operand : Bound
        A value, a condition (``run_length``, ``since_true``, ``robustness``), or a node (``age``,
        ``exists_now``).
    by : int
        How far ``delta`` looks back, and how long a window is; ns, or frames.
    frames : bool
        Whether ``by``, or the number that it gives, counts frames; else time.
    type : Type
    """

    word: str
    operand: Bound
    by: int = 0
    frames: bool = False
    type: Type = Type.number


WINDOWS: Final = ("min_over", "max_over", "avg_over", "sum_over")
"""Functions of the values of the last frames."""

ANGLES: Final = frozenset(
    {"heading", "pitch", "roll", "bearing", "rel_heading", "apparent_heading", "heading_error"}
)
"""Values that come round after 360 degrees."""


@dataclass(frozen=True, slots=True)
class StepTime:
    """The time of a step of a sequence; s since the trace began. ``step`` is its number."""

    step: int
    type: Type = Type.number


OF_MATCH: Final = ("min", "max", "avg", "sum", "first", "last", "argmin", "argmax")
"""Functions of the values during a match."""

PLACES: Final = frozenset({"argmin", "argmax"})
"""Those of them that tell of a frame."""


@dataclass(frozen=True, slots=True)
class OverMatch:
    """A value made of those that an expression has in the frames of a match, or of a part of it.

    Attributes
    ----------
    word : str
        One of :data:`OF_MATCH`.
    operand : Bound
        A value at a frame.
    start, end : int or None
        Numbers of the steps in whose frames the part begins and ends; the same: the run of frames in which the
        step holds. ``None``: the match.
    at : Bound or None
        Of ``argmin`` and ``argmax``: the value that is told of the frame.
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


@dataclass(frozen=True, slots=True, eq=False)
class Scope:
    """Pattern of one ``MATCH`` or one block. Two scopes are equal only if they are the same object.

    Attributes
    ----------
    nodes : mapping of str to Node
        Its own nodes by key.
    outer : mapping of str to Kinds
        Nodes of scopes around it that it, or a block in it, speaks of; with what they may be here.
    edges : tuple of Edge
    where : tuple of Bound
        Conditions; each must be true.
    distinct : frozenset of pairs
        Keys of nodes that must not be bound to the same node.
    """

    nodes: Mapping[str, Node]
    outer: Mapping[str, Kinds]
    edges: tuple[Edge, ...]
    where: tuple[Bound, ...]
    distinct: frozenset[tuple[str, str]]

    def kinds(self, key: str) -> Kinds:
        """Return the kinds of a node of this scope, or of one that it speaks of."""
        return self.nodes[key].kinds if key in self.nodes else self.outer[key]


# Queries ------------------------------------------------------------------------------------------

FRAME_COLUMNS: Final = ("frame_id", "trace", "seq", "time_ns", "t")
"""Columns that say which frame a row is of: ``t`` is seconds since the trace began."""

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
"""Columns of an interval: its ends by number, simulation time, and seconds since the trace began."""

CLIP_COLUMNS: Final = ("trace", "start_ns", "end_ns")
"""Columns of a clip: log times, offsets included."""

Form = Literal["rows", "intervals", "clips", "subgraphs"]


@dataclass(frozen=True, slots=True)
class ReturnColumn:
    """A value to return, and what it is called.

    Attributes
    ----------
    name : str
    value : Bound
    single : bool
        Whether the value has 32 bits: it is returned as the shortest text of these.
    """

    name: str
    value: Bound
    single: bool = False


@dataclass(frozen=True, slots=True)
class SortKey:
    """Key to order by: a value, or the name of a result."""

    value: Bound | str
    descending: bool


@dataclass(frozen=True, slots=True)
class Sampling:
    """At most ``number`` results of each value of ``per`` (of all, if it is ``None``)."""

    number: int
    per: Bound | str | None


@dataclass(frozen=True, slots=True)
class Result:
    """Values and form in which matches are returned.

    Attributes
    ----------
    form : str
        ``rows``, ``intervals``, ``clips`` or ``subgraphs``.
    columns : tuple of ReturnColumn
        Values returned; empty without ``RETURN``.
    whole : bool
        Whether frame and variables are returned too: without ``RETURN``, or for ``*``.
    framed : bool
        Whether the frame is returned with the values.
    distinct : bool
    having : Bound or None
        What must be true of a group, or of an interval, so that it is returned.
    order : tuple of SortKey
    sample : Sampling or None
    top : Sampling or None
        How many of each value are returned: the first ones.
    skip : int
        How many rows are left out before the first.
    limit : int or None
    before, after : int
        Offsets of clips; ns, negative is earlier.
    keyed : bool
        Whether intervals and clips also have what puts those of several stores in order: see
        :mod:`sgstore.lang._parts`.
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
        """Names of the columns that are not values: those of frames, intervals or clips."""
        if self.form == "subgraphs":
            return FRAME_COLUMNS
        if self.form != "rows":
            return INTERVAL_COLUMNS if self.form == "intervals" else CLIP_COLUMNS
        return FRAME_COLUMNS if self.whole or self.framed else ()

    @property
    def values(self) -> list[Bound]:
        """The expressions in it: what it returns, groups must fulfil, orders by and samples by."""
        per = [chosen.per for chosen in (self.sample, self.top) if chosen is not None]
        values = [*(column.value for column in self.columns), *(key.value for key in self.order)]
        every = (*values, self.having, *per)
        return [v for v in every if v is not None and not isinstance(v, str)]

    @property
    def aggregated(self) -> bool:
        """Tell whether it counts or sums over matches, rather than listing them."""
        having = [] if self.having is None else [self.having]
        values = (*(column.value for column in self.columns), *having)
        return any(isinstance(e, Aggregate) for value in values for e in walk(value))

    @property
    def chooses(self) -> bool:
        """Tell whether it lists some of the rows only, so many of them or so many of each value."""
        return self.limit is not None or self.top is not None or self.skip > 0

    def changed(self, change: Callable[[Bound], Bound]) -> Result:
        """The same with a change made to every value."""

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
    """A path that has a name: its value is the list of its nodes.

    Attributes
    ----------
    place : FrameAttribute
        What stands for it.
    nodes : tuple of str
        Keys of the nodes that are written in it.
    edges : tuple of (str, bool)
        Keys of the edges between these, and whether each is written from its ``dst`` to its ``src``.
    """

    place: FrameAttribute
    nodes: tuple[str, ...]
    edges: tuple[tuple[str, bool], ...]


@dataclass(frozen=True, slots=True)
class PathWay:
    """A pattern whose paths with names have certain lengths; ``nodes`` are the keys of the nodes of each."""

    scope: Scope
    nodes: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class MatchStage:
    """A pattern of a query in several parts.

    Attributes
    ----------
    scope : Scope
        What stands in ``MATCH``; its outer nodes are those of the stages before that it speaks of.
    optional : bool
        Whether what goes before stays where it has no match.
    paths : tuple of PathValue
    ways : tuple of PathWay
        Of a rewritten query: the pattern once for all the lengths that its paths may have.
    """

    scope: Scope
    optional: bool
    paths: tuple[PathValue, ...] = ()
    ways: tuple[PathWay, ...] = ()


@dataclass(frozen=True, slots=True)
class WithStage:
    """``WITH``: what of the matches so far is passed on, frame by frame.

    Attributes
    ----------
    before, after : Scope
        Nodes and edges that are bound before and after it; without conditions.
    nodes : tuple of (str, str)
        Keys of the nodes that it passes on, after and before.
    edges : tuple of (Edge, str)
        The edges that it passes on, and their keys before.
    values : tuple of ReturnColumn
        What it works out.
    places : tuple of FrameAttribute
        What stands for each of them behind it.
    grouped : bool
        Whether what is not passed on ends here, each combination of the rest being there once: with an
        aggregate, or with ``DISTINCT``.
    order : tuple of SortKey
    skip : int
    limit : int or None
        Of the rows of each frame.
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
        """All expressions in it."""
        order = (key.value for key in self.order if not isinstance(key.value, str))
        return (*(column.value for column in self.values), *order, *self.where)

    def changed(self, change: Callable[[Bound], Bound]) -> WithStage:
        """The same with a change made to every expression."""
        values = tuple(replace(column, value=change(column.value)) for column in self.values)
        order = tuple(
            replace(key, value=change(key.value))
            for key in self.order
            if not isinstance(key.value, str)
        )
        return replace(self, values=values, order=order, where=tuple(map(change, self.where)))


Stage = MatchStage | WithStage

PASSED: Final = ":with "
"""What the names of values begin with that ``WITH`` passes on."""


def passed_on(
    name: str, kind: Type, precision: str = "", *, stored: bool = False
) -> FrameAttribute:
    """What stands for a value that ``WITH`` passes on, each time another."""
    attribute = Attribute(name, kind, {}, "", DisplayUnit.whole, precision=precision, stored=stored)
    return FrameAttribute(attribute, kind)


def is_passed_on(value: Bound) -> TypeGuard[FrameAttribute]:
    """Tell whether something stands for a value that ``WITH`` passes on."""
    return isinstance(value, FrameAttribute) and value.attribute.name.startswith(PASSED)


def is_path(value: Bound) -> bool:
    """Tell whether something stands for a path."""
    return is_passed_on(value) and value.attribute.name.rpartition(" ")[2][0] == "p"


@dataclass(frozen=True, slots=True)
class Query:
    """A bound query.

    Attributes
    ----------
    scope : Scope
        What stands in ``MATCH``; of a query with steps or stages, their nodes and the edges that have names,
        without conditions.
    result : Result
    relations : frozenset of str
        Relations that it names, anywhere: what a trace must be able to answer.
    injective : bool
        Whether different nodes of a pattern are bound to different nodes.
    ego : str or None
        The simulator's id of the ego that was chosen.
    unknown_is_false : bool
        Whether relations that a trace cannot answer count as absent.
    steps : tuple of BoundStep
        Of a query that looks at more than one frame at a time; else empty.
    links : tuple of StepLink
        Between the steps; empty where :attr:`alternatives` have them.
    alternatives : tuple of StepWay
        Of an expression of steps: all sequences that it stands for.
    policy : str
        Which matches of a sequence are told: ``all``, ``first``, ``longest``.
    gaps : str
        Whether a gap in the recording ends a run (``break``) or not (``bridge``).
    stages : tuple of MatchStage and WithStage
        Of a query with ``OPTIONAL MATCH``, ``WITH`` or a path with a name: its parts; the first is a pattern.
    world : bool
        Whether it is about all that is known of the world around, beyond the graphs, too.
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

    @property
    def ways(self) -> tuple[StepWay, ...]:
        """The sequences of its steps: mostly one."""
        if self.alternatives:
            return self.alternatives
        happen = tuple(n for n, step in enumerate(self.steps) if not step.absent)
        return (StepWay(tuple(range(len(self.steps))), happen, self.links),)

    @property
    def spans(self) -> bool:
        """Tell whether a match may be of several frames, so that it is told once."""
        return len(self.steps) > 1 or bool(self.alternatives)

    @property
    def certain(self) -> frozenset[int]:
        """Numbers of the steps that happen in every match."""
        return frozenset.intersection(*(frozenset(way.happen) for way in self.ways))

    @property
    def patterns(self) -> tuple[Scope, ...]:
        """All its patterns: of its steps, of its stages, or the one that it is."""
        stages = (stage.scope for stage in self.stages if isinstance(stage, MatchStage))
        found = (*(step.scope for step in self.steps), *stages)
        return found or (self.scope,)

    @property
    def required(self) -> tuple[Scope, ...]:
        """The patterns of a frame without which there is no match: all but those of ``OPTIONAL MATCH``."""
        stages = (s for s in self.stages if isinstance(s, MatchStage) and not s.optional)
        return tuple(stage.scope for stage in stages) or (self.scope,)

    @property
    def first(self) -> Scope:
        """The pattern of a frame that it begins with."""
        return self.required[0]


def passed_values(query: Query) -> tuple[FrameAttribute, ...]:
    """What stands for the values that matches of a query have in the end."""
    found: tuple[FrameAttribute, ...] = ()
    for stage in query.stages:
        if isinstance(stage, WithStage):
            found = stage.places if stage.grouped else found + stage.places
        else:
            found += tuple(path.place for path in stage.paths)
    return found


def any_of(conditions: Iterable[Bound]) -> Bound:
    """Return the condition that one of some conditions is true; false without conditions."""
    found = tuple(conditions)
    if len(found) < 2:
        return found[0] if found else Value(value=False, type=Type.boolean)
    return Operation("OR", found, Type.boolean)


def all_of(*conditions: Bound) -> Bound:
    """Return the condition that some conditions, at least one, are true."""
    return conditions[0] if len(conditions) == 1 else Operation("AND", conditions, Type.boolean)


def inverse(condition: Bound) -> Operation:
    """Return the condition that another one is false."""
    return Operation("NOT", (condition,), Type.boolean)


def is_one_of(value: Bound, numbers: Iterable[int]) -> Operation:
    """The condition that a value is one of some numbers."""
    choices = Choices(tuple(Value(number, Type.number) for number in numbers))
    return Operation("IN", (value, choices), Type.boolean)


def node_among(node: str, ids: Iterable[int]) -> Operation:
    """The condition that a node is one of those with some ids."""
    return is_one_of(NodeAttribute(node, NODE_ATTRIBUTES["id"], Type.number), ids)


def operands_of(expression: Bound) -> tuple[Bound, ...]:
    """The expressions that one is made of, but not what stands in the braces of a block."""
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
    """An expression with a change made to each of its :func:`operands_of`."""
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
    """An expression and all its parts, but not what stands in the blocks in it."""
    yield expression
    for operand in operands_of(expression):
        yield from walk(operand)


def conjuncts(expression: Bound) -> list[Bound]:
    """The conditions that an expression joins by ``AND``."""
    if isinstance(expression, Operation) and expression.word == "AND":
        return [part for operand in expression.operands for part in conjuncts(operand)]
    return [expression]


def is_temporal(expression: Bound) -> bool:
    """Tell whether an expression looks at more than one frame."""
    return any(
        isinstance(part, Tense | SignalCall | StepTime | OverMatch) for part in walk(expression)
    )


def is_formula(expression: Bound) -> bool:
    """Tell whether a part of a value is a condition over time: true or false, since there nothing is unknown.

    What ``AND`` joins are conditions of their own, as in ``WHERE``: one of this frame alone may be unknown.
    """
    if not isinstance(expression, Operation):
        return isinstance(expression, Tense)
    joined = expression.word in {"OR", "NOT", "XOR", "IMPLIES"} and is_temporal(expression)
    of_matches = StepTime | OverMatch | Aggregate | GroupKey
    return joined and not any(
        isinstance(part, of_matches) or is_passed_on(part) for part in walk(expression)
    )


def is_angle(value: Bound) -> bool:
    """Tell whether a value comes round after 360 degrees."""
    match value:
        case NodeAttribute(attribute=attribute) | EdgeAttribute(attribute=attribute):
            return attribute.name in ANGLES
        case PairNumber(function=function):
            return function in ANGLES
        case _:
            return False


def is_counted(expression: Bound) -> bool:
    """Tell whether an expression speaks of all matches, and not of one of them alone."""
    return any(isinstance(part, Aggregate) for part in walk(expression))


def nodes_of(expression: Bound) -> frozenset[str]:
    """Keys of the nodes that an expression speaks of; of a block's, those outside it."""
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
    """Keys of the edges that an expression speaks of; what stands in blocks speaks of none outside."""
    edges = (EdgeRelation, EdgeAttribute)
    return frozenset(part.edge for part in walk(expression) if isinstance(part, edges))


def blocks_of(expression: Bound) -> tuple[BlockValue, ...]:
    """The blocks in an expression, not those within them."""
    return tuple(part for part in walk(expression) if isinstance(part, BlockValue))


# Bound forms of what happens over time: the steps and links of a sequence, and checks -----------


@dataclass(frozen=True, slots=True)
class BoundStep:
    """A step of a sequence.

    Attributes
    ----------
    scope : Scope
        What one frame must show; nodes of other steps have the same keys here.
    when : tuple of Bound
        Further conditions, which look at other frames.
    hold : BoundHold or None
    absent : bool
        Whether it must not happen between its neighbours.
    span : TextSpan
    """

    scope: Scope
    when: tuple[Bound, ...]
    hold: BoundHold | None
    absent: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class BoundQuantifier:
    """``FORALL`` or ``FORSOME``: over the entities of a trace.

    Attributes
    ----------
    word : str
    nodes : tuple of str
        Keys of its variables.
    where : Bound or None
        What must be true of them in some frame, so that they count.
    absent : bool
        Whether a condition on an absent one of them counts for it; else it is false.
    """

    word: str
    nodes: tuple[str, ...]
    where: Bound | None
    absent: bool


@dataclass(frozen=True, slots=True)
class BoundCheck:
    """A bound check: what is to be true from the first frame of a trace on.

    Attributes
    ----------
    name : str
    scope : Scope
        The nodes that it speaks of: its variables, and the ego; without conditions.
    quantifiers : tuple of BoundQuantifier
    formula : Bound
    reset : Bound or None
        After a violation, the check begins anew in the frame after that in which this holds.
    relations : frozenset of str
    injective : bool
    ego : str or None
    unknown_is_false : bool
        As in :class:`Query`.
    end : str
        How the end of a trace is taken: ``bounded`` (an operator whose bound is not over is pending, others
        have failed), ``strong`` (what is still due is missed), ``weak`` (it is forgiven), ``pending`` (all that
        is still due is pending).
    gaps : str
        Whether a gap in the recording ends a run (``break``) or not (``bridge``); with ``unknown`` nothing is
        known of what happened in it.
    robustness : bool
        Whether it is asked by how much the formula is true, or false.
    returns : tuple of ReturnColumn
        Values of each violation.
    world : bool
        As in :class:`Query`.
    range : float or None
        How far from the ego it looks, as it says; m. ``None``: as its formula says.
    limit : float or None
        The same, if traces may know more: who is farther is as if absent.
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
    world: bool = True
    range: float | None = None
    limit: float | None = None
