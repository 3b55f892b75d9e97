"""Nested SELECT statements: layer by layer, they compute numbers of entity pairs and test conditions.

Each part of a pair number has a name in its layer and is computed once. A condition is tested in the first
layer that has all its parts. For the expensive ``gap``, ``ttc`` and ``closing_time``, a cheap lower bound is
tested first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sgstore.base.quoting import quoted
from sgstore.lang.ir import Bound, PairNumber
from sgstore.lang.sql._attributes import Aliases, raw_text
from sgstore.lang.sql._expressions import (
    Leaf,
    column_of,
    expression_text,
    leaves,
    pair_column,
    pair_text,
)
from sgstore.lang.sql._lookups import LOOKED_UP, of_later, recorded_text
from sgstore.lang.sql._rewrite import is_dear
from sgstore.lang.sql._select import Select, nested
from sgstore.model.pair_numbers import needed_for, parts_of, stage_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.sql._select import BoundValues

Part = tuple[str, str, str]
"""Reference to a pair number: its name and the two nodes."""


def pairs_of(found: Iterable[Leaf]) -> list[PairNumber]:
    """Return the numbers of entity pairs, such as ``gap``, that nested SELECT statements must compute."""
    return [
        leaf for leaf in found if isinstance(leaf, PairNumber) and leaf.function not in LOOKED_UP
    ]


@dataclass(slots=True)
class Join:
    """Joined tables under construction, with one row for each match in each single frame.

    Attributes
    ----------
    select : Select
    frame : str
        Column of the frame id; empty until a table has it.
    trace : str
        SQL of the trace id; empty means derived from the frame id.
    nodes, edges : dict of str to str
        Column of the id by node, column of the relation by edge.
    at : dict of str to Aliases
        Joined tables of each node.
    texts : dict of Leaf to str
        SQL of the available values.
    lanes : set of str
        Aliases of the tables joined for edge attributes.
    world : bool
        True if recorded measures cover all data of scope ``world``.
    """

    select: Select = field(default_factory=Select)
    frame: str = ""
    trace: str = ""
    nodes: dict[str, str] = field(default_factory=dict[str, str])
    edges: dict[str, str] = field(default_factory=dict[str, str])
    at: dict[str, Aliases] = field(default_factory=dict[str, Aliases])
    texts: dict[Leaf, str] = field(default_factory=dict[Leaf, str])
    lanes: set[str] = field(default_factory=set[str])
    world: bool = False


@dataclass(slots=True)
class Layers:
    """SELECT statements nested around a join, which compute numbers of entity pairs and test conditions.

    Numbers that no cheap condition needs are computed after the tests of the cheap conditions.

    Attributes
    ----------
    join : Join
    needed : list of Leaf
        Values needed by conditions or results.
    conditions : list of Bound
    without : frozenset of str
        Marks that no pair of these traces needs (:data:`sgstore.model.pair_numbers.MARKS`).
    users : frozenset of str
        Nodes that are road users.
    early : set of Part
        Parts of the conditions without expensive numbers.
    tested : int
        Layer after which these conditions are tested.
    """

    join: Join
    needed: list[Leaf]
    conditions: list[Bound]
    without: frozenset[str] = frozenset()
    users: frozenset[str] = frozenset()
    early: set[Part] = field(default_factory=set["Part"])
    tested: int = 0
    _stages: dict[Part, int] = field(default_factory=dict["Part", int])

    def __post_init__(self) -> None:
        cheap = [c for c in self.conditions if not any(is_dear(leaf) for leaf in leaves(c))]
        pairs = [pair for c in cheap for pair in pairs_of(leaves(c))]
        self.early = {
            (name, p.a, p.b)
            for p in pairs
            for name in needed_for(p.function, self.without)
            if stage_of(name)
        }
        self.tested = max((stage_of(name, self.without) for name, _, _ in self.early), default=0)

    def stage(self, name: str, a: str, b: str) -> int:
        """Return the depth of the nested SELECT that computes a number of two entities; 0 if it is stored."""
        if not stage_of(name):
            return 0
        part = name, a, b
        if part not in self._stages:
            found = 1 + max(self.stage(one, a, b) for one in parts_of(name, self.without))
            self._stages[part] = found if part in self.early else max(found, self.tested + 1)
        return self._stages[part]

    def stage_of_test(self, condition: Bound) -> int:
        """Return the depth of the first nested SELECT in which SQL can test a condition."""
        pairs = pairs_of(leaves(condition))
        return max((self.stage(pair.function, pair.a, pair.b) for pair in pairs), default=0)

    def text(self, values: BoundValues, keys: list[str], wanted: list[Leaf]) -> str:
        """Return the nested SELECT statements as SQL, with columns for frame, keys and wanted values."""
        later = list(dict.fromkeys(of_later(self.needed)))
        if not later:
            return self._without_later(values, keys, wanted)
        last = [c for c in self.conditions if of_later(leaves(c))]
        self.conditions = [c for c in self.conditions if c not in last]
        kept = dict.fromkeys([*wanted, *(leaf for c in last for leaf in leaves(c))])
        ends = dict.fromkeys(quoted(f"{key}.id") for one in later for key in (one.a, one.b))
        known = [leaf for leaf in kept if leaf not in later]
        text = self._without_later(values, list(dict.fromkeys([*keys, *ends])), known)
        told = Select(["*"], [nested(text, ":tested")])
        told.columns += [
            named(recorded_text(one, world=self.join.world), quoted(column_of(one)))
            for one in later
        ]
        names = ['"frame_id"', *keys, *(quoted(column_of(leaf)) for leaf in wanted)]
        final = Select(list(dict.fromkeys(names)), [nested(told.text(), ":recorded")])
        final.where = [
            expression_text(c, lambda leaf: quoted(column_of(leaf)), values) for c in last
        ]
        return final.text()

    def _without_later(self, values: BoundValues, keys: list[str], wanted: list[Leaf]) -> str:
        """Return the nested SELECT statements as SQL, without numbers that depend on later frames."""
        pairs = pairs_of(self.needed)
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

    def _layer(self, values: BoundValues, text: str, stage: int, pairs: list[PairNumber]) -> str:
        select = Select(["*"], [nested(text, f":layer {stage - 1}")])
        parts = dict.fromkeys(
            (name, pair.a, pair.b)
            for pair in pairs
            for name in sorted(needed_for(pair.function, self.without))
            if self.stage(name, pair.a, pair.b) == stage
        )
        select.columns += [
            named(pair_text(*part, self.without), pair_column(*part)) for part in parts
        ]
        select.where = self._tests(values, stage - 1) if stage > 1 else []
        return select.text()

    def _tests(self, values: BoundValues, stage: int) -> list[str]:
        return [
            expression_text(c, lambda leaf: quoted(column_of(leaf)), values)
            for c in self.conditions
            if self.stage_of_test(c) == stage
        ]

    def _raw(self, pairs: list[PairNumber]) -> dict[str, str]:
        """Return the stored columns from which SQL computes the numbers of entity pairs: name → SQL."""
        columns: dict[str, str] = {}
        for pair in pairs:
            for name in sorted(needed_for(pair.function, self.without)):
                if stage_of(name) == 0:
                    key = pair.a if name[0] == "a" else pair.b
                    columns[pair_column(name, pair.a, pair.b)] = raw_text(
                        name[2:], self.join.at[key], upright=key in self.users
                    )
        return columns


def named(text: str, name: str) -> str:
    """Return SQL for a named output column. If the column already has this name, ``AS`` is omitted."""
    return text if text == name or text.endswith(f".{name}") else f"{text} AS {name}"
