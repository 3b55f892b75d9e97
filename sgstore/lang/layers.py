"""Numbers of pairs and conditions on values of frames: statements around the join that brings the values.

Each number is computed in terms of others, in layers, one statement within the other, so that each part has a
name and is computed once; a condition stands in the first layer that has all its parts. Of ``gap`` and ``ttc``,
which are dear, a cheap lower bound is compared before.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.lang.bound import (
    BlockValue,
    Bound,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    NodeAttribute,
    NodeValue,
    Operation,
    PairNumber,
    TraceAttribute,
)
from sgstore.lang.catalog import Type
from sgstore.lang.formulas import (
    Aliases,
    Leaf,
    Select,
    expression_text,
    leaves,
    nested,
)
from sgstore.lang.pairs import WAY, needed_for, pair_column, pair_text, parts_of, stage_of
from sgstore.quoting import literal, quoted
from sgstore.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.formulas import Values

_DEAR: Final = {"gap", "ttc"}
_LESS: Final = {"<", "<=", "="}
_MORE: Final = {">", ">=", "="}

Part = tuple[str, str, str]
"""A number of a pair: its name, and the nodes."""


def _pairs(found: Iterable[Leaf]) -> list[PairNumber]:
    """The numbers of pairs among values that are computed in layers."""
    return [leaf for leaf in found if isinstance(leaf, PairNumber) and leaf.function != WAY]


@dataclass(slots=True)
class Join:
    """The join of the second phase in the making.

    Attributes
    ----------
    select : Select
    frame : str
        The column of the frame; empty as long as there is none.
    trace : str
        The id of the trace; empty: that of the frame's.
    nodes, edges : dict of str to str
        Node → the column of its id, edge → the column of its relation.
    at : dict of str to Aliases
        Tables of a node's values that are joined.
    texts : dict of Leaf to str
        Values that are there, as they are computed.
    lanes : set of str
        Aliases of the rows that are joined for attributes of edges.
    """

    select: Select = field(default_factory=Select)
    frame: str = ""
    trace: str = ""
    nodes: dict[str, str] = field(default_factory=dict[str, str])
    edges: dict[str, str] = field(default_factory=dict[str, str])
    at: dict[str, Aliases] = field(default_factory=dict[str, Aliases])
    texts: dict[Leaf, str] = field(default_factory=dict[Leaf, str])
    lanes: set[str] = field(default_factory=set[str])


@dataclass(slots=True)
class Layers:
    """The statements around a join that compute numbers of pairs and test conditions.

    What no cheap condition needs is computed after these have been tested.

    Attributes
    ----------
    join : Join
    needed : list of Leaf
        Values that conditions or results are made of.
    conditions : list of Bound
    early : set of Part
        What the conditions are made of that no dear number is in.
    tested : int
        The layer after which these are tested.
    """

    join: Join
    needed: list[Leaf]
    conditions: list[Bound]
    early: set[Part] = field(default_factory=set["Part"])
    tested: int = 0

    def __post_init__(self) -> None:
        cheap = [c for c in self.conditions if not any(_dear(leaf) for leaf in leaves(c))]
        pairs = [pair for c in cheap for pair in _pairs(leaves(c))]
        self.early = {
            (name, p.a, p.b) for p in pairs for name in needed_for(p.function) if stage_of(name)
        }
        self.tested = max((stage_of(name) for name, _, _ in self.early), default=0)

    def stage(self, name: str, a: str, b: str) -> int:
        """The layer in which a number of a pair is computed; 0 for a raw column."""
        if not stage_of(name):
            return 0
        found = 1 + max(self.stage(part, a, b) for part in parts_of(name))
        return found if (name, a, b) in self.early else max(found, self.tested + 1)

    def stage_of_test(self, condition: Bound) -> int:
        """The layer after which a condition can be tested."""
        pairs = _pairs(leaves(condition))
        return max((self.stage(pair.function, pair.a, pair.b) for pair in pairs), default=0)

    def text(self, values: Values, keys: list[str], wanted: list[Leaf]) -> str:
        """The whole: frame, keys and the values that are wanted."""
        pairs = _pairs(self.needed)
        last = max((self.stage(pair.function, pair.a, pair.b) for pair in pairs), default=0)
        innermost = self.join.select
        innermost.where += [
            expression_text(c, self.join.texts.__getitem__, values)
            for c in self.conditions
            if self.stage_of_test(c) == 0
        ]
        ids = {quoted(f"{k}.id"): v for k, v in self.join.nodes.items()}
        ids |= {quoted(f"{k}.type"): v for k, v in self.join.edges.items()}
        names = ['"frame_id"', *keys, *(quoted(column_of(leaf)) for leaf in wanted)]
        texts = {quoted(column_of(leaf)): text for leaf, text in self.join.texts.items()}
        known = {'"frame_id"': self.join.frame, **ids, **texts}
        if last == 0:
            innermost.columns = [named(known[n], n) for n in dict.fromkeys(names)]
            return innermost.text()
        carried = dict.fromkeys([*names, *texts])
        innermost.columns = [named(known[n], n) for n in carried if n in known]
        innermost.columns += [named(text, n) for n, text in self._raw(pairs).items()]
        text = innermost.text()
        for stage in range(1, last + 1):
            text = self._layer(values, text, stage, pairs)
        final = Select(list(dict.fromkeys(names)), [nested(text, f":layer {last}")])
        final.where = self._tests(values, last)
        return final.text()

    def _layer(self, values: Values, text: str, stage: int, pairs: list[PairNumber]) -> str:
        select = Select(["*"], [nested(text, f":layer {stage - 1}")])
        parts = dict.fromkeys(
            (name, pair.a, pair.b)
            for pair in pairs
            for name in sorted(needed_for(pair.function))
            if self.stage(name, pair.a, pair.b) == stage
        )
        select.columns += [named(pair_text(*part), pair_column(*part)) for part in parts]
        select.where = self._tests(values, stage - 1) if stage > 1 else []
        return select.text()

    def _tests(self, values: Values, stage: int) -> list[str]:
        return [
            expression_text(c, lambda leaf: quoted(column_of(leaf)), values)
            for c in self.conditions
            if self.stage_of_test(c) == stage
        ]

    def _raw(self, pairs: list[PairNumber]) -> dict[str, str]:
        """The raw columns that numbers of pairs are made of."""
        columns: dict[str, str] = {}
        for pair in pairs:
            for name in sorted(needed_for(pair.function)):
                if stage_of(name) == 0:
                    key = pair.a if name[0] == "a" else pair.b
                    columns[pair_column(name, pair.a, pair.b)] = _raw_text(
                        name[1:], self.join.at[key]
                    )
        return columns


_PLACES: Final = ", ".join(literal(kind) for kind in MAP_KINDS)


def _raw_text(name: str, at: Aliases) -> str:
    """A raw column of a node, wherever it lives; positions about the trace's origin."""
    parts: list[str] = []
    if at.state:
        parts.append(f"CAST({at.state}.{quoted(name)} AS DOUBLE)")
    if at.entity and name not in {"vx", "vy"}:
        parts.append(f"CAST({at.entity}.{quoted(name)} AS DOUBLE)")
    if at.map and name not in {"vx", "vy"}:
        value = f"{at.map}.{quoted(name)}"
        value = f'{value} - {at.trace}."origin_{name}"' if name in {"x", "y", "z"} else value
        # Signs and lights of a map are entities; of lanes and roads there are no numbers of pairs.
        parts.append(f'CASE WHEN {at.map}."kind" NOT IN ({_PLACES}) THEN {value} END')
    if not parts:
        return "CAST(NULL AS DOUBLE)"
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def named(text: str, name: str) -> str:
    """A column under its name, which need not be said if it is called so anyway."""
    return text if text == name or text.endswith(f".{name}") else f"{text} AS {name}"


def column_of(leaf: Leaf) -> str:
    """The name of the column of a value."""
    match leaf:
        case NodeValue(node=owner):
            name = "id"
        case NodeAttribute(node=owner, attribute=attribute):
            name = attribute.name
        case EdgeRelation(edge=owner):
            name = "type"
        case EdgeAttribute(edge=owner, attribute=attribute):
            name = attribute.name
        case FrameAttribute(attribute=attribute):
            owner, name = "frame", attribute.name
        case TraceAttribute(attribute=attribute):
            owner, name = "trace", attribute.name
        case PairNumber(function=function, a=a, b=b):
            return f"{function}({a}, {b})"
        case BlockValue(number=number):
            return f"block {number}"
    return f"{owner}.{name}"


def bounds(conditions: list[Bound]) -> list[Bound]:
    """Conditions that follow from others and are cheap to test: ``gap < t`` needs circles that near."""
    found: list[Bound] = []
    for condition in conditions:
        match condition:
            case Operation(word, (PairNumber() as pair, limit)) if word in _LESS:
                found += _bound(pair, limit)
            case Operation(word, (limit, PairNumber() as pair)) if word in _MORE:
                found += _bound(pair, limit)
            case _:
                pass
    return found


def _bound(pair: PairNumber, limit: Bound) -> list[Bound]:
    if pair.function not in _DEAR or any(_dear(leaf) for leaf in leaves(limit)):
        return []
    least = PairNumber("at_least", pair.a, pair.b)
    if pair.function == "ttc":
        closing = PairNumber("closing_speed", pair.a, pair.b)
        limit = Operation("*", (limit, closing), Type.number)
    return [Operation("<=", (least, limit), Type.boolean)]


def _dear(leaf: Leaf) -> bool:
    return isinstance(leaf, PairNumber) and leaf.function in _DEAR
