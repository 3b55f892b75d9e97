"""Classes for the syntax tree of a query. Each object has its position in the text.

Words are not checked against a vocabulary here; the binder does that. :mod:`sgstore.lang.syntax._parse` makes
these trees from text.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.errors import TextSpan


@dataclass(frozen=True, slots=True)
class Constant:
    """Number, text, truth value or ``NULL`` in a query."""

    value: int | float | str | bool | None
    span: TextSpan


LONGEST: Final = 1e18
"""Largest amount of a :class:`Duration`, in any unit. It exceeds every trace."""
TOO_LONG: Final = "this duration is longer than any trace can be"
"""Error message for a duration above the limit."""


@dataclass(frozen=True, slots=True)
class Duration:
    """Duration in a query: ``amount`` in ``ms``, ``s``, ``min`` or ``frames``."""

    amount: float
    unit: str
    span: TextSpan

    @property
    def ns(self) -> int:
        """Duration in nanoseconds; 0 for a duration in frames."""
        return round(self.amount * {"ms": 1e6, "s": 1e9, "min": 60e9}.get(self.unit, 0))


@dataclass(frozen=True, slots=True)
class FrameWindow:
    """Time window around a frame, such as ``-1s..2s``: its length ``before`` and ``ahead`` of the frame."""

    before: Duration
    ahead: Duration
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Parameter:
    """Query parameter ``$name``. Its value is passed with the query."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Variable:
    """Variable in a query: a name from a pattern, or ``ego``, ``frame`` or ``trace``."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class AttributeOf:
    """Attribute access in a query: ``owner.name``."""

    owner: Variable
    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Call:
    """Function call in a query: ``name(arguments)``. ``COUNT(DISTINCT x)`` is also a call."""

    name: str
    arguments: tuple[Expression, ...]
    distinct: bool
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class TopicExpression:
    """Field of a recorded message in a query: ``topic('/imu', nearest, 0.1s).linear_acceleration.z``.

    Attributes
    ----------
    topic : Constant or Parameter
    path : tuple of str or int
        Names of fields, and indices of list elements.
    rule : str
        ``last``, ``nearest`` or ``linear``.
    tolerance : Duration, Parameter or None
        Largest time between message and frame. ``None`` means the setting of the statement.
    path_span : TextSpan
        Place of the path.
    span : TextSpan
    """

    topic: Constant | Parameter
    path: tuple[str | int, ...]
    rule: str
    tolerance: Duration | Parameter | None
    path_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class CountAll:
    """Query expression ``COUNT(*)``."""

    span: TextSpan


@dataclass(frozen=True, slots=True)
class ListOf:
    """List in a query: ``[a, b, …]``."""

    items: tuple[Expression, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Logic:
    """Logical expression: ``NOT a``, ``a AND b AND …``, ``OR``, ``XOR`` or ``a IMPLIES b``."""

    word: Literal["NOT", "AND", "OR", "XOR", "IMPLIES"]
    operands: tuple[Expression, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison such as ``a = b``, ``STARTS WITH``, ``ENDS WITH``, ``CONTAINS`` or ``=~``."""

    word: str
    left: Expression
    right: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class NullTest:
    """Test for NULL: ``a IS NULL``; if ``negated``, ``a IS NOT NULL``."""

    operand: Expression
    negated: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Membership:
    """Membership test: ``a IN list``; if ``negated``, ``a NOT IN list``."""

    operand: Expression
    choices: Expression
    negated: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """Chain of arithmetic operators of equal precedence, evaluated from left to right: ``a + b - c``."""

    first: Expression
    rest: tuple[tuple[str, Expression], ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Negative:
    """Negation of a number: ``-a``."""

    operand: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class BlockExpression:
    """Pattern in braces: ``EXISTS {…}``, ``COUNT {…}``, or ``MIN``, ``MAX``, ``AVG``, ``SUM {… | value}``."""

    word: str
    block: Block
    value: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class When:
    """Branch of a ``CASE``: ``WHEN condition THEN value``."""

    condition: Expression
    value: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Case:
    """Query expression ``CASE WHEN condition THEN value … ELSE value END``.

    ``CASE x WHEN y`` is read as ``CASE WHEN x = y``.
    """

    branches: tuple[When, ...]
    otherwise: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Temporal:
    """Temporal operator such as ``EVENTUALLY``, with its operands and time bound.

    A bound of ``None`` means unbounded.

    The upper end of a bound is ``None`` for ``INF``.
    """

    word: str
    operands: tuple[Expression, ...]
    span: TextSpan
    bound: tuple[Duration | Parameter, Duration | Parameter | None] | None = None


@dataclass(frozen=True, slots=True)
class OverExpression:
    """Aggregate over a match (``MIN(x) OVER match``) or over some of its steps (``OVER start..end``)."""

    call: Expression
    start: Variable | None
    end: Variable | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class HappensExpression:
    """Event test: ``HAPPENS kind(arguments)`` is true if the frame has a recorded event."""

    kind: str
    arguments: tuple[Expression, ...]
    kind_span: TextSpan
    span: TextSpan


Expression = (
    Constant
    | Duration
    | Parameter
    | Variable
    | AttributeOf
    | Call
    | TopicExpression
    | CountAll
    | ListOf
    | Logic
    | Comparison
    | NullTest
    | Membership
    | Arithmetic
    | Negative
    | BlockExpression
    | Case
    | Temporal
    | OverExpression
    | HappensExpression
    | FrameWindow
)


Given = Constant | Duration | Parameter | Variable
"""Syntax tree types that can be arguments of a scenario."""


@dataclass(frozen=True, slots=True)
class Label:
    """Label of a node or edge in a pattern. The label ``%`` matches any."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LabelLogic:
    """Combination of labels: ``!a``, ``a & b`` or ``a | b``."""

    word: Literal["!", "&", "|"]
    operands: tuple[LabelExpression, ...]
    span: TextSpan


LabelExpression = Label | LabelLogic


@dataclass(frozen=True, slots=True)
class Property:
    """Property of a node or edge in a pattern, in braces: ``name: value``."""

    name: str
    value: Expression
    name_span: TextSpan


@dataclass(frozen=True, slots=True)
class NodePattern:
    """Node pattern: ``(name:label {properties} WHERE condition)``. Each part is optional."""

    name: str | None
    label: LabelExpression | None
    properties: tuple[Property, ...]
    where: Expression | None
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class EdgePattern:
    """Edge pattern: ``-[name:label*low..high {properties} WHERE condition]->``."""

    name: str | None
    label: LabelExpression | None
    low: int | None
    high: int | None
    properties: tuple[Property, ...]
    where: Expression | None
    direction: Literal["right", "left", "any"]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Path:
    """Path of a pattern: nodes with edges between them, such as ``name = (a)-->(b)``. The name is optional."""

    nodes: tuple[NodePattern, ...]
    edges: tuple[EdgePattern, ...]
    name: str | None = None
    name_span: TextSpan | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """Graph pattern: paths and a condition, after ``MATCH`` or in braces."""

    paths: tuple[Path, ...]
    where: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Setting:
    """Query setting: ``USING name value``."""

    name: str
    value: str | Parameter
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Item:
    """Item of ``RETURN``: a named value, ``*``, ``FRAMES``, ``INTERVALS``, ``SUBGRAPHS`` or ``CLIPS``.

    ``before`` and ``after`` are the two offsets of ``CLIPS``; ns, negative is earlier.
    """

    form: Literal["value", "all", "frames", "intervals", "subgraphs", "clips"]
    value: Expression | None
    name: str | None
    before: int
    after: int
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Sort:
    """Sort key of ``ORDER BY``: ``value ASC`` or ``value DESC``."""

    value: Expression
    descending: bool


@dataclass(frozen=True, slots=True)
class Sample:
    """Sampling clause: ``SAMPLE number PER value``."""

    number: int
    per: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Returns:
    """Return clause: ``RETURN DISTINCT items HAVING … ORDER BY … SAMPLE … LIMIT n PER … SKIP … LIMIT …``.

    ``top`` is ``LIMIT n PER value``.
    """

    distinct: bool
    items: tuple[Item, ...]
    order: tuple[Sort, ...]
    sample: Sample | None
    limit: int | None
    span: TextSpan
    having: Expression | None = None
    top: Sample | None = None
    skip: int = 0


@dataclass(frozen=True, slots=True)
class HoldClause:
    """Minimum or maximum duration of a sequence step: ``FOR >= duration INCLUSIVE``."""

    comparison: str
    duration: Duration | Parameter
    inclusive: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class StepClause:
    """Step of a sequence: a graph pattern, optionally with a name and a duration.

    Attributes
    ----------
    block : Block
        Pattern after ``MATCH``. For ``HOLDS (condition)``: a block without paths.
    absent : bool
        True for ``NOT MATCH``.
    hold : HoldClause or None
    name : str or None
        Name after ``AS``.
    span : TextSpan
    """

    block: Block
    absent: bool
    hold: HoldClause | None
    name: str | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class ScenarioStep:
    """Call of a named scenario as a sequence step: ``MATCH name(parameter = value, …)``."""

    name: str
    given: tuple[Argument, ...]
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Argument:
    """Argument of a scenario call, ``name = value``: sets a parameter, or renames a variable."""

    name: str
    value: Given
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LinkClause:
    """Time relation between two steps of a sequence, such as ``THEN WITHIN 5s``.

    Attributes
    ----------
    kind : str
        ``then``, ``immediately``, ``until`` or ``while``.
    after, within : Duration, Parameter or None
        Shortest and longest time of ``then``.
    span : TextSpan
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Duration | Parameter | None
    within: Duration | Parameter | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class GroupStep:
    """Group of alternative step sequences with a repeat count: ``(A | B THEN C){2,3}``.

    Attributes
    ----------
    alternatives : tuple of SequenceClause
    low, high : int
        Smallest and largest number of repetitions.
    span : TextSpan
    """

    alternatives: tuple[SequenceClause, ...]
    low: int
    high: int
    span: TextSpan


@dataclass(frozen=True, slots=True)
class SequenceClause:
    """Sequence of steps with a time relation between neighbouring steps."""

    steps: tuple[StepClause | ScenarioStep | GroupStep, ...]
    links: tuple[LinkClause, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LaterMatch:
    """``OPTIONAL MATCH …``, or a ``MATCH …`` after ``OPTIONAL MATCH`` or ``WITH``."""

    block: Block
    optional: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class WithClause:
    """``WITH`` clause: ``WITH DISTINCT items ORDER BY … SKIP … LIMIT … WHERE …``."""

    distinct: bool
    items: tuple[Item, ...]
    order: tuple[Sort, ...]
    skip: int
    limit: int | None
    where: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class MatchClause:
    """Complete query: ``USING … MATCH … WHERE … THEN … OPTIONAL MATCH … WITH … RETURN …``."""

    settings: tuple[Setting, ...]
    sequence: SequenceClause
    returns: Returns | None
    span: TextSpan
    later: tuple[LaterMatch | WithClause, ...] = ()

    @property
    def block(self) -> Block:
        """Graph pattern of the first sequence step; an empty pattern if the step is a scenario."""
        first = self.sequence.steps[0]
        return first.block if isinstance(first, StepClause) else Block((), None, first.span)


@dataclass(frozen=True, slots=True)
class UnionClause:
    """Union of queries: ``MATCH … UNION MATCH …``; if not ``distinct``, with ``UNION ALL``."""

    parts: tuple[MatchClause, ...]
    distinct: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Formal:
    """Parameter in the definition of a predicate or scenario.

    A parameter of a scenario may have a default value.
    """

    name: str
    default: Constant | Duration | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Define:
    """Definition of a predicate or scenario: ``DEFINE PREDICATE name(parameters) AS condition``."""

    name: str
    parameters: tuple[Formal, ...]
    body: Expression | SequenceClause
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class QuantifiedNode:
    """Quantified variable ``name:label`` of a check, after ``FORALL`` or ``FORSOME``."""

    name: str
    label: LabelExpression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class QuantifierClause:
    """Quantifier of a check: ``FORALL (a:Label, b:Label WHERE condition ABSENT AS TRUE)``, or ``FORSOME``."""

    word: str
    nodes: tuple[QuantifiedNode, ...]
    where: Expression | None
    absent: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class CheckClause:
    """Check statement: a rule that a whole trace must meet.

    ``USING … CHECK name: quantifiers formula RESET WHEN condition ROBUSTNESS RETURN items HAVING condition``.
    """

    settings: tuple[Setting, ...]
    name: str | None
    quantifiers: tuple[QuantifierClause, ...]
    formula: Expression
    reset: Expression | None
    robustness: bool
    returns: tuple[Item, ...]
    span: TextSpan
    having: Expression | None = None


Statement = MatchClause | UnionClause | Define | CheckClause


def parameters_in(part: object) -> Iterator[str]:
    """Yield the names of all query parameters (``$name``) in part of a syntax tree."""
    return (one.name for one in parts_of(part) if isinstance(one, Parameter))


def parts_of(part: object) -> Iterator[object]:
    """Yield part of a syntax tree, and all parts inside it."""
    yield part
    inner = part if isinstance(part, tuple) else ()
    if is_dataclass(part):
        inner = tuple(getattr(part, one.name) for one in fields(part))
    for one in inner:  # pyright: ignore[reportUnknownVariableType]
        yield from parts_of(one)  # pyright: ignore[reportUnknownArgumentType]
