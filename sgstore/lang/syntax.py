"""Syntax trees: a query as it was written, every part with its place in the text.

Nothing here is checked against a vocabulary; that is the binder's work. :mod:`sgstore.lang._parse` makes these
trees from text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from sgstore.records import dataclass

if TYPE_CHECKING:
    from sgstore.errors import TextSpan


# Expressions --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Constant:
    """A number, a text, a truth value or NULL as it stands in the query."""

    value: int | float | str | bool | None
    span: TextSpan


LONGEST: Final = 1e18
"""More than a trace lasts in any unit; the largest amount of a :class:`Duration`."""
TOO_LONG: Final = "no length of time that a trace may have"
"""Message about one that is longer."""


@dataclass(frozen=True, slots=True)
class Duration:
    """A length of time: ``amount`` of ``ms``, ``s``, ``min`` or ``frames``."""

    amount: float
    unit: str
    span: TextSpan

    @property
    def ns(self) -> int:
        """The same in nanoseconds; meaningless in frames."""
        return round(self.amount * {"ms": 1e6, "s": 1e9, "min": 60e9}.get(self.unit, 0))


@dataclass(frozen=True, slots=True)
class Parameter:
    """``$name``: a value that comes with the query."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Variable:
    """A name that a pattern binds, or ``ego``, ``frame``, ``trace``."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class AttributeOf:
    """``owner.name``."""

    owner: Variable
    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Call:
    """``name(arguments)``; ``COUNT(DISTINCT x)`` is a call too."""

    name: str
    arguments: tuple[Expression, ...]
    distinct: bool
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class CountAll:
    """``COUNT(*)``."""

    span: TextSpan


@dataclass(frozen=True, slots=True)
class ListOf:
    """``[a, b, …]``."""

    items: tuple[Expression, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Logic:
    """``NOT a``, ``a AND b AND …``, ``OR``, ``XOR``, ``a IMPLIES b``."""

    word: Literal["NOT", "AND", "OR", "XOR", "IMPLIES"]
    operands: tuple[Expression, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Comparison:
    """``a = b`` and the like; also ``STARTS WITH``, ``ENDS WITH``, ``CONTAINS``, ``=~``."""

    word: str
    left: Expression
    right: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class NullTest:
    """``a IS NULL``; negated: ``a IS NOT NULL``."""

    operand: Expression
    negated: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Membership:
    """``a IN list``; negated: ``a NOT IN list``."""

    operand: Expression
    choices: Expression
    negated: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """``first sign term sign term …`` with signs of one rank, from left to right."""

    first: Expression
    rest: tuple[tuple[str, Expression], ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Negative:
    """``-a``."""

    operand: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class BlockExpression:
    """``EXISTS {…}``, ``COUNT {…}``, and ``MIN {… | value}`` with ``MAX``, ``AVG``, ``SUM``."""

    word: str
    block: Block
    value: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class When:
    """``WHEN condition THEN value``: a branch of a ``CASE``."""

    condition: Expression
    value: Expression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Case:
    """``CASE WHEN condition THEN value … ELSE value END``; ``CASE x WHEN y`` is ``CASE WHEN x = y``."""

    branches: tuple[When, ...]
    otherwise: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Temporal:
    """An operator of the temporal layer with its operands and its bound: times from and to, or ``None``.

    The upper end of a bound is ``None`` where it is ``INF``.
    """

    word: str
    operands: tuple[Expression, ...]
    span: TextSpan
    bound: tuple[Duration | Parameter, Duration | Parameter | None] | None = None


@dataclass(frozen=True, slots=True)
class OverExpression:
    """``call OVER match``, ``call OVER start``, or ``call OVER start..end``: of a match, or of its steps."""

    call: Expression
    start: Variable | None
    end: Variable | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class HappensExpression:
    """``HAPPENS kind(arguments)``: whether something is recorded as having happened in the frame."""

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
)


Given = Constant | Duration | Parameter | Variable
"""What a scenario may be given."""


# Patterns -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Label:
    """A label as written; the name ``%`` stands for any."""

    name: str
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LabelLogic:
    """``!a``, ``a & b``, ``a | b``."""

    word: Literal["!", "&", "|"]
    operands: tuple[LabelExpression, ...]
    span: TextSpan


LabelExpression = Label | LabelLogic


@dataclass(frozen=True, slots=True)
class Property:
    """``name: value`` in braces."""

    name: str
    value: Expression
    name_span: TextSpan


@dataclass(frozen=True, slots=True)
class NodePattern:
    """``(name:label {properties} WHERE condition)``; every part may be absent."""

    name: str | None
    label: LabelExpression | None
    properties: tuple[Property, ...]
    where: Expression | None
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class EdgePattern:
    """``-[name:label*low..high {properties} WHERE condition]->``; ``low`` is ``None`` for a single edge."""

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
    """Nodes with edges between them, one node more than edges; ``name = (a)-->(b)`` has a name."""

    nodes: tuple[NodePattern, ...]
    edges: tuple[EdgePattern, ...]
    name: str | None = None
    name_span: TextSpan | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """Paths and a condition: what stands in a ``MATCH`` or in braces."""

    paths: tuple[Path, ...]
    where: Expression | None
    span: TextSpan


# Statements ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Setting:
    """``USING name value``."""

    name: str
    value: str | Parameter
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Item:
    """One thing to return: a value with its name, ``*``, ``FRAMES``, ``INTERVALS``, ``SUBGRAPHS``, ``CLIPS``.

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
    """``value ASC`` or ``DESC``."""

    value: Expression
    descending: bool


@dataclass(frozen=True, slots=True)
class Sample:
    """``SAMPLE number PER value``."""

    number: int
    per: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Returns:
    """``RETURN DISTINCT items HAVING … ORDER BY … SAMPLE … LIMIT n PER … SKIP … LIMIT …``.

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
    """``FOR >= duration INCLUSIVE``: how long a step must last."""

    comparison: str
    duration: Duration | Parameter
    inclusive: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class StepClause:
    """One step of a sequence.

    Attributes
    ----------
    block : Block
        What stands after ``MATCH``; of ``HOLDS (condition)`` a block without paths.
    absent : bool
        Whether it is ``NOT MATCH``.
    hold : HoldClause or None
    name : str or None
        What ``AS`` calls it.
    span : TextSpan
    """

    block: Block
    absent: bool
    hold: HoldClause | None
    name: str | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class ScenarioStep:
    """``MATCH name(parameter = value, …)``: the steps of a scenario that has a name."""

    name: str
    given: tuple[Argument, ...]
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Argument:
    """``name = value``: the value of a parameter of a scenario, or another name for one of its variables."""

    name: str
    value: Given
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LinkClause:
    """Link between two steps: when the second one comes after the first.

    Attributes
    ----------
    kind : str
        ``then``, ``immediately``, ``until`` or ``while``.
    after, within : Duration, Parameter or None
        Least and greatest time of ``then``.
    span : TextSpan
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Duration | Parameter | None
    within: Duration | Parameter | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class GroupStep:
    """``(A | B THEN C){2,3}``: one of several sequences, so many times, one time after another.

    Attributes
    ----------
    alternatives : tuple of SequenceClause
    low, high : int
        How often, at least and at most.
    span : TextSpan
    """

    alternatives: tuple[SequenceClause, ...]
    low: int
    high: int
    span: TextSpan


@dataclass(frozen=True, slots=True)
class SequenceClause:
    """Steps with links between them; there is one step more than links."""

    steps: tuple[StepClause | ScenarioStep | GroupStep, ...]
    links: tuple[LinkClause, ...]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class LaterMatch:
    """``OPTIONAL MATCH …``, or ``MATCH …`` behind one or behind ``WITH``."""

    block: Block
    optional: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class WithClause:
    """``WITH DISTINCT items ORDER BY … SKIP … LIMIT … WHERE …``."""

    distinct: bool
    items: tuple[Item, ...]
    order: tuple[Sort, ...]
    skip: int
    limit: int | None
    where: Expression | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class MatchClause:
    """``USING … MATCH … WHERE … THEN … OPTIONAL MATCH … WITH … RETURN …``."""

    settings: tuple[Setting, ...]
    sequence: SequenceClause
    returns: Returns | None
    span: TextSpan
    later: tuple[LaterMatch | WithClause, ...] = ()

    @property
    def block(self) -> Block:
        """The pattern of its first step; of a scenario, an empty one."""
        first = self.sequence.steps[0]
        return first.block if isinstance(first, StepClause) else Block((), None, first.span)


@dataclass(frozen=True, slots=True)
class UnionClause:
    """``MATCH … UNION MATCH …``; not ``distinct``: ``UNION ALL``."""

    parts: tuple[MatchClause, ...]
    distinct: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Formal:
    """A parameter of a definition; that of a scenario may have a value that it takes if none is given."""

    name: str
    default: Constant | Duration | None
    span: TextSpan


@dataclass(frozen=True, slots=True)
class Define:
    """``DEFINE PREDICATE name(parameters) AS condition``, ``DEFINE SCENARIO name(parameters) AS sequence``."""

    name: str
    parameters: tuple[Formal, ...]
    body: Expression | SequenceClause
    name_span: TextSpan
    span: TextSpan


@dataclass(frozen=True, slots=True)
class QuantifiedNode:
    """``name:label`` after ``FORALL`` or ``FORSOME``."""

    name: str
    label: LabelExpression
    span: TextSpan


@dataclass(frozen=True, slots=True)
class QuantifierClause:
    """``FORALL (a:Label, b:Label WHERE condition ABSENT AS TRUE)``, or ``FORSOME``."""

    word: str
    nodes: tuple[QuantifiedNode, ...]
    where: Expression | None
    absent: bool
    span: TextSpan


@dataclass(frozen=True, slots=True)
class CheckClause:
    """``USING … CHECK name: quantifiers formula RESET WHEN condition ROBUSTNESS RETURN items``."""

    settings: tuple[Setting, ...]
    name: str | None
    quantifiers: tuple[QuantifierClause, ...]
    formula: Expression
    reset: Expression | None
    robustness: bool
    returns: tuple[Item, ...]
    span: TextSpan


Statement = MatchClause | UnionClause | Define | CheckClause
