"""Expressions of the IR that are made of no others: constants, attributes, numbers of pairs."""

from __future__ import annotations

from dataclasses import field
from typing import TYPE_CHECKING

from sgstore.lang._catalog import Attribute, Type
from sgstore.records import dataclass

if TYPE_CHECKING:
    from sgstore.errors import TextSpan
    from sgstore.lang._kind_sets import Kinds


@dataclass(frozen=True, slots=True)
class Value:
    """A constant.

    Attributes
    ----------
    value, type
    closed : bool
        Whether it is a canonical word of the vocabulary, not a text of the user's.
    unit : str
        ``s`` or ``frames`` if it was written as a length of time, such as ``2s``; no part of what it is.
    span : TextSpan or None
        Where a length of time was written.
    written : float or None
        The number as it was written, if it was rounded for a comparison.
    """

    value: int | float | str | bool | None
    type: Type
    closed: bool = False
    unit: str = field(default="", compare=False)
    span: TextSpan | None = field(default=None, compare=False)
    written: float | None = field(default=None, compare=False)

    @property
    def shown(self) -> float | str | bool | None:
        """The constant as the query has it."""
        return self.value if self.written is None else self.written


@dataclass(frozen=True, slots=True)
class Choices:
    """A list of constants, after ``IN``."""

    items: tuple[Value, ...]
    type: Type = Type.list


@dataclass(frozen=True, slots=True)
class NodeValue:
    """A node itself."""

    node: str
    type: Type = Type.node


@dataclass(frozen=True, slots=True)
class NodeAttribute:
    """An attribute of a node."""

    node: str
    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class LabelTest:
    """Test that a node, bound outside, has a label."""

    node: str
    kinds: Kinds
    type: Type = Type.boolean


@dataclass(frozen=True, slots=True)
class EdgeRelation:
    """The relation that an edge variable is bound to."""

    edge: str
    type: Type = Type.text


@dataclass(frozen=True, slots=True)
class EdgeAttribute:
    """An attribute of an edge from an entity to a lane."""

    edge: str
    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class FrameAttribute:
    """``frame.name``."""

    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class TraceAttribute:
    """``trace.name``."""

    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class PairNumber:
    """A number of an ordered pair of entities."""

    function: str
    a: str
    b: str
    type: Type = Type.number


@dataclass(frozen=True, slots=True)
class Happened:
    """Test that something is recorded as having happened in a frame.

    Attributes
    ----------
    kind : str
        Of the event: one of :data:`sgstore.vocabulary.EVENT_KINDS`; or the name of a table of a user's own.
    nodes : tuple of str
        To whom: none, one or two.
    table : tuple of str
        Of a table: the columns that say to whom, as many as there are nodes; for no node one that is empty.
        Empty: it is an event of the recording, which says it of two in either order.
    """

    kind: str
    nodes: tuple[str, ...]
    table: tuple[str, ...] = ()
    type: Type = Type.boolean
