"""Syntax trees: a query as it was written, every part with its place in the text.

Nothing here is checked against a vocabulary; that is the binder's work. :mod:`sgstore.lang.parser` makes these
trees from text.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from sgstore.errors import Span


# Expressions --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Constant:
    """A number, a text, a truth value or NULL as it stands in the query."""

    value: int | float | str | bool | None
    span: Span


@dataclass(frozen=True, slots=True)
class Duration:
    """A length of time: ``amount`` of ``ms``, ``s``, ``min`` or ``frames``."""

    amount: float
    unit: str
    span: Span

    @property
    def ns(self) -> int:
        """The same in nanoseconds; meaningless in frames."""
        return round(self.amount * {"ms": 1e6, "s": 1e9, "min": 60e9}.get(self.unit, 0))


@dataclass(frozen=True, slots=True)
class Parameter:
    """``$name``: a value that comes with the query."""

    name: str
    span: Span


@dataclass(frozen=True, slots=True)
class Variable:
    """A name that a pattern binds, or ``ego``, ``frame``, ``trace``."""

    name: str
    span: Span


@dataclass(frozen=True, slots=True)
class AttributeOf:
    """``owner.name``."""

    owner: Variable
    name: str
    span: Span


@dataclass(frozen=True, slots=True)
class Call:
    """``name(arguments)``; ``COUNT(DISTINCT x)`` is a call too."""

    name: str
    arguments: tuple[Expression, ...]
    distinct: bool
    name_span: Span
    span: Span


@dataclass(frozen=True, slots=True)
class CountAll:
    """``COUNT(*)``."""

    span: Span


@dataclass(frozen=True, slots=True)
class ListOf:
    """``[a, b, …]``."""

    items: tuple[Expression, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class Logic:
    """``NOT a``, ``a AND b AND …``, ``OR``, ``XOR``, ``a IMPLIES b``."""

    word: Literal["NOT", "AND", "OR", "XOR", "IMPLIES"]
    operands: tuple[Expression, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class Comparison:
    """``a = b`` and the like; also ``STARTS WITH``, ``ENDS WITH``, ``CONTAINS``, ``=~``."""

    word: str
    left: Expression
    right: Expression
    span: Span


@dataclass(frozen=True, slots=True)
class NullTest:
    """``a IS NULL``; negated: ``a IS NOT NULL``."""

    operand: Expression
    negated: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Membership:
    """``a IN list``; negated: ``a NOT IN list``."""

    operand: Expression
    choices: Expression
    negated: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """``first sign term sign term …`` with signs of one rank, from left to right."""

    first: Expression
    rest: tuple[tuple[str, Expression], ...]
    span: Span


@dataclass(frozen=True, slots=True)
class Negative:
    """``-a``."""

    operand: Expression
    span: Span


@dataclass(frozen=True, slots=True)
class BlockExpression:
    """``EXISTS {…}``, ``COUNT {…}``, and ``MIN {… | value}`` with ``MAX``, ``AVG``, ``SUM``."""

    word: str
    block: Block
    value: Expression | None
    span: Span


@dataclass(frozen=True, slots=True)
class Temporal:
    """An operator of the temporal layer with its operands and its bound: times from and to, or ``None``.

    The upper end of a bound is ``None`` where it is ``INF``.
    """

    word: str
    operands: tuple[Expression, ...]
    span: Span
    bound: tuple[Duration | Parameter, Duration | Parameter | None] | None = None


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
    | Temporal
)


# Patterns -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Label:
    """A label as written; the name ``%`` stands for any."""

    name: str
    span: Span


@dataclass(frozen=True, slots=True)
class LabelLogic:
    """``!a``, ``a & b``, ``a | b``."""

    word: Literal["!", "&", "|"]
    operands: tuple[LabelExpression, ...]
    span: Span


LabelExpression = Label | LabelLogic


@dataclass(frozen=True, slots=True)
class Property:
    """``name: value`` in braces."""

    name: str
    value: Expression
    name_span: Span


@dataclass(frozen=True, slots=True)
class NodePattern:
    """``(name:label {properties} WHERE condition)``; every part may be absent."""

    name: str | None
    label: LabelExpression | None
    properties: tuple[Property, ...]
    where: Expression | None
    name_span: Span
    span: Span


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
    span: Span


@dataclass(frozen=True, slots=True)
class Path:
    """Nodes with edges between them; there is one node more than edges."""

    nodes: tuple[NodePattern, ...]
    edges: tuple[EdgePattern, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """Paths and a condition: what stands in a ``MATCH`` or in braces."""

    paths: tuple[Path, ...]
    where: Expression | None
    span: Span


# Statements ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Setting:
    """``USING name value``."""

    name: str
    value: str | Parameter
    span: Span


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
    span: Span


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
    span: Span


@dataclass(frozen=True, slots=True)
class Returns:
    """``RETURN DISTINCT items ORDER BY … SAMPLE … LIMIT …``."""

    distinct: bool
    items: tuple[Item, ...]
    order: tuple[Sort, ...]
    sample: Sample | None
    limit: int | None
    span: Span


@dataclass(frozen=True, slots=True)
class Hold:
    """``FOR >= duration INCLUSIVE``: how long a step must last."""

    comparison: str
    duration: Duration | Parameter
    inclusive: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a sequence.

    Attributes
    ----------
    block : Block
        What stands after ``MATCH``; of ``HOLDS (condition)`` a block without paths.
    absent : bool
        Whether it is ``NOT MATCH``.
    hold : Hold or None
    name : str or None
        What ``AS`` calls it.
    span : Span
    """

    block: Block
    absent: bool
    hold: Hold | None
    name: str | None
    span: Span


@dataclass(frozen=True, slots=True)
class ScenarioStep:
    """``MATCH name(parameter = value, …)``: the steps of a scenario that has a name."""

    name: str
    given: tuple[Given, ...]
    name_span: Span
    span: Span


@dataclass(frozen=True, slots=True)
class Given:
    """``name = value``: the value of a parameter of a scenario."""

    name: str
    value: Constant | Duration | Parameter
    span: Span


@dataclass(frozen=True, slots=True)
class Link:
    """What stands between two steps: when the second one comes after the first.

    Attributes
    ----------
    kind : str
        ``then``, ``immediately``, ``until`` or ``while``.
    after, within : Duration, Parameter or None
        Least and greatest time of ``then``.
    span : Span
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Duration | Parameter | None
    within: Duration | Parameter | None
    span: Span


@dataclass(frozen=True, slots=True)
class Sequence:
    """Steps with links between them; there is one step more than links."""

    steps: tuple[Step | ScenarioStep, ...]
    links: tuple[Link, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class Match:
    """``USING … MATCH … WHERE … THEN … RETURN …``."""

    settings: tuple[Setting, ...]
    sequence: Sequence
    returns: Returns | None
    span: Span

    @property
    def block(self) -> Block:
        """The pattern of its first step; of a scenario, an empty one."""
        first = self.sequence.steps[0]
        return first.block if isinstance(first, Step) else Block((), None, first.span)


@dataclass(frozen=True, slots=True)
class Formal:
    """A parameter of a definition; that of a scenario may have a value that it takes if none is given."""

    name: str
    default: Constant | Duration | None
    span: Span


@dataclass(frozen=True, slots=True)
class Define:
    """``DEFINE PREDICATE name(parameters) AS condition``, ``DEFINE SCENARIO name(parameters) AS sequence``."""

    name: str
    parameters: tuple[Formal, ...]
    body: Expression | Sequence
    name_span: Span
    span: Span


@dataclass(frozen=True, slots=True)
class QuantifiedNode:
    """``name:label`` after ``FORALL`` or ``FORSOME``."""

    name: str
    label: LabelExpression
    span: Span


@dataclass(frozen=True, slots=True)
class Quantifier:
    """``FORALL (a:Label, b:Label WHERE condition ABSENT AS TRUE)``, or ``FORSOME``."""

    word: str
    nodes: tuple[QuantifiedNode, ...]
    where: Expression | None
    absent: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Check:
    """``USING … CHECK name: quantifiers formula RESET WHEN condition``."""

    settings: tuple[Setting, ...]
    name: str | None
    quantifiers: tuple[Quantifier, ...]
    formula: Expression
    reset: Expression | None
    span: Span


Statement = Match | Define | Check
