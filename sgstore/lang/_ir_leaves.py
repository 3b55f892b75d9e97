"""Leaf expressions of the IR: constants, attributes and numbers of pairs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sgstore.lang.catalog import Attribute, Type

if TYPE_CHECKING:
    from sgstore.errors import TextSpan
    from sgstore.lang._kind_sets import Kinds


@dataclass(frozen=True, slots=True)
class Value:
    """Bound constant.

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
        """Constant as written in the query, before rounding."""
        return self.value if self.written is None else self.written


@dataclass(frozen=True, slots=True)
class Choices:
    """List of constants after ``IN``."""

    items: tuple[Value, ...]
    type: Type = Type.list


@dataclass(frozen=True, slots=True)
class NodeValue:
    """Reference to a node."""

    node: str
    type: Type = Type.node


@dataclass(frozen=True, slots=True)
class NodeAttribute:
    """Attribute of a node."""

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
    """Relation that an edge variable is bound to."""

    edge: str
    type: Type = Type.text


@dataclass(frozen=True, slots=True)
class EdgeAttribute:
    """Attribute of an edge from an entity to a lane."""

    edge: str
    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class FrameAttribute:
    """Attribute of the frame: ``frame.name``."""

    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class TraceAttribute:
    """Attribute of the trace: ``trace.name``."""

    attribute: Attribute
    type: Type


@dataclass(frozen=True, slots=True)
class PairNumber:
    """Number computed for an ordered pair of entities, such as ``gap(a, b)``."""

    function: str
    a: str
    b: str
    type: Type = Type.number


@dataclass(frozen=True, slots=True)
class Happened:
    """Test that the recording has an event of a kind in this frame.

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
