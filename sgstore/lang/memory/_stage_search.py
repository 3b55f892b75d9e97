"""Search in one scene graph in memory for queries with ``OPTIONAL MATCH``, ``WITH`` or named paths.

Each stage converts the rows of the previous stage. A row holds the bound nodes and edges (``None`` means
absent), and the values of ``WITH`` and paths. :mod:`sgstore.lang.sql._stages` does the same in a store.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang import ir as b
from sgstore.lang.memory._evaluate import Binding, Evaluate
from sgstore.lang.memory._frame_view import FrameView
from sgstore.lang.memory._search import ScopeSearch, expression
from sgstore.lang.operators import OPERATORS
from sgstore.lang.sql import path_ways

if TYPE_CHECKING:
    from collections.abc import Iterator

Rows = list[Binding]
_Part = Callable[[FrameView, Rows], Rows]


class StageSearch:
    """Search plan for a query with several clauses (``MATCH``, ``OPTIONAL MATCH``, ``WITH``).

    Parameters
    ----------
    query : Query
        Bound query with stages.
    """

    def __init__(self, query: b.Query) -> None:
        self._injective = query.injective
        self._parts: list[_Part] = [
            _Passing(stage, query.injective).rows
            if isinstance(stage, b.WithStage)
            else _Joining(stage, query.injective).rows
            for stage in query.stages
        ]

    def rows(self, view: FrameView) -> Rows:
        """Return the matches of a query with several clauses in one scene graph."""
        rows = [Binding(view)]
        for part in self._parts:
            rows = part(view, rows)
        return rows

    def value(self, of: b.Bound) -> Evaluate:
        """Return a function that evaluates an expression for one match, whose optional nodes may be absent."""
        return _value(of, injective=self._injective)


class _Joining:
    """``MATCH`` or ``OPTIONAL MATCH`` clause: extends each previous match by the matches of a pattern."""

    def __init__(self, stage: b.MatchStage, injective: bool) -> None:  # noqa: FBT001
        self._stage = stage
        places = {path.place for path in stage.paths}
        late = [one for one in stage.scope.where if places.intersection(b.walk(one))]
        asked = {key for one in late for key in b.edges_of(one)}
        self._late = [_value(one, injective=injective) for one in late]
        self._ways: list[tuple[ScopeSearch, tuple[tuple[str, ...], ...]]] = []
        for way in path_ways(stage, injective=injective):
            edges = (replace(e, named=e.named or e.key in asked) for e in way.scope.edges)
            where = tuple(one for one in way.scope.where if one not in late)
            scope = replace(way.scope, edges=tuple(edges), where=where)
            self._ways.append((ScopeSearch(scope, injective=injective), way.nodes))
        self._nodes = [key for key, node in stage.scope.nodes.items() if node.role != "hidden"]
        self._edges = [edge.key for edge in stage.scope.edges if edge.named]

    def rows(self, view: FrameView, rows: Rows) -> Rows:
        found: Rows = []
        for row in rows:
            more = list(self._beside(view, row))
            if not more and self._stage.optional:
                absent = dict.fromkeys(path.place.attribute.name for path in self._stage.paths)
                nodes, edges = dict.fromkeys(self._nodes), dict.fromkeys(self._edges)
                more = [
                    _row(
                        view,
                        {**nodes, **row.nodes},
                        {**edges, **row.edges},
                        {**row.passed, **absent},
                    )
                ]
            found += more
        return found

    def _beside(self, view: FrameView, row: Binding) -> Iterator[Binding]:
        """Yield the given match, extended by each match of the next pattern."""
        if _absent(row, self._stage.scope.outer, ()):
            return
        told: set[object] = set()
        for search, paths in self._ways:
            at = _row(view, row.nodes, row.edges, row.passed)
            for _ in search.run(at):
                ways = [tuple(at.nodes[key] for key in keys) for keys in paths]
                key = tuple(at.nodes[key] for key in self._nodes), *ways
                key += tuple(at.edges[key][0] for key in self._edges)
                at.passed = {**row.passed, **self._told(ways)}
                if key not in told and all(test(at) is True for test in self._late):
                    told.add(key)
                    nodes = {**row.nodes, **{key: at.nodes[key] for key in self._nodes}}
                    edges = {**row.edges, **{key: at.edges[key] for key in self._edges}}
                    yield _row(view, nodes, edges, at.passed)

    def _told(self, ways: Sequence[tuple[int, ...]]) -> dict[str, Any]:
        names = (path.place.attribute.name for path in self._stage.paths)
        return {name: list(way) for name, way in zip(names, ways, strict=True)}


def _row(view: FrameView, nodes: Any, edges: Any, passed: Any) -> Binding:
    return Binding(view, dict(nodes), dict(edges), dict(passed))


class _Passing:
    """``WITH`` clause: converts the matches in a frame, as by grouping, sorting and limits."""

    def __init__(self, stage: b.WithStage, injective: bool) -> None:  # noqa: FBT001
        self._stage, self._injective = stage, injective
        self._where = [_value(one, injective=injective) for one in stage.where]
        self._order = [
            (_value(key.value, injective=injective), key.descending)
            for key in stage.order
            if not isinstance(key.value, str)
        ]
        names = [place.attribute.name for place in stage.places]
        self._values = list(zip(names, stage.values, strict=True))
        self._plain = [
            (name, column.name, _value(column.value, injective=injective))
            for name, column in self._values
            if not b.is_counted(column.value)
        ]

    def rows(self, _: FrameView, rows: Rows) -> Rows:
        stage = self._stage
        found = self._groups(rows) if stage.grouped else [self._passed(one) for one in rows]
        if stage.skip or stage.limit is not None:
            found.sort(key=_place)
            for value, descending in reversed(self._order):
                known = [row for row in found if value(row) is not None]
                known.sort(key=value, reverse=descending)
                found = known + [row for row in found if value(row) is None]
            end = None if stage.limit is None else stage.skip + stage.limit
            found = found[stage.skip : end]
        return [row for row in found if all(test(row) is True for test in self._where)]

    def _passed(self, row: Binding, *, bare: bool = False) -> Binding:
        """Return a match with the names and values that ``WITH`` passes on.

        With ``bare``, all others are removed.
        """
        stage = self._stage
        nodes = {new: row.nodes[old] for new, old in stage.nodes}
        edges = {edge.key: row.edges[old] for edge, old in stage.edges}
        passed = {name: value(row) for name, _, value in self._plain}
        if not bare:
            nodes, edges = {**row.nodes, **nodes}, {**row.edges, **edges}
            passed = {**row.passed, **passed}
        return Binding(row.view, nodes, edges, passed)

    def _groups(self, rows: Rows) -> Rows:
        """Return one row for each combination of the grouping values of ``WITH``."""
        members: dict[object, Rows] = {}
        kept: dict[object, Binding] = {}
        for row in rows:
            one = self._passed(row, bare=True)
            values = (tuple(v) if isinstance(v, list) else v for v in one.passed.values())
            relations = (edge and edge[0] for edge in one.edges.values())
            key = *one.nodes.values(), *relations, *values
            members.setdefault(key, []).append(row)
            kept.setdefault(key, one)
        for key, one in kept.items():
            told = {called: one.passed[name] for name, called, _ in self._plain}
            for name, column in self._values:
                if b.is_counted(column.value):
                    one.passed[name] = self._counted(column.value, members[key], told)
        return list(kept.values())

    def _counted(self, value: b.Bound, rows: Rows, told: Mapping[str, Any]) -> Any:
        """Return the value of an expression with aggregates, over the matches of one group."""
        match value:
            case b.Aggregate():
                return _aggregate(value, rows, injective=self._injective)
            case b.GroupKey(name=name):
                return told[name]
            case b.Operation(word=word, operands=operands):
                parts = [self._counted(one, rows, told) for one in operands]
                return OPERATORS[word].one([_always(part) for part in parts])(rows[0])
            case _:
                return _value(value, injective=self._injective)(rows[0])


def _always(value: Any) -> Evaluate:
    return lambda _: value


def _place(row: Binding) -> tuple[tuple[bool, Any], ...]:
    """Return the default sort key of a match: its node ids, relations and passed values."""
    nodes = [row.nodes[key] for key in sorted(row.nodes)]
    edges = [row.edges[key] and row.edges[key][0] for key in sorted(row.edges)]
    return tuple((one is None, one or 0) for one in (*nodes, *edges, *row.passed.values()))


def _aggregate(of: b.Aggregate, rows: Rows, *, injective: bool) -> Any:
    """Return the value of an aggregate such as ``COUNT`` over some matches.

    See :mod:`sgstore.lang.bind._aggregates`.
    """
    if of.operand is None:
        return len(rows)
    value = _value(of.operand, injective=injective)
    known = [one for one in map(value, sorted(rows, key=_place)) if one is not None]
    if of.distinct:
        known = list(dict.fromkeys(known))
    return AGGREGATE[of.word](known, of)


def _quantile(values: list[float], of: b.Aggregate) -> float | None:
    if not values:
        return None
    values = sorted(values)
    at = (len(values) - 1) * (of.share if of.word == "percentile" else 0.5)
    low, high = values[math.floor(at)], values[math.ceil(at)]
    return low + (high - low) * (at - math.floor(at))


AGGREGATE: Final[Mapping[str, Callable[[list[Any], b.Aggregate], Any]]] = {
    "count": lambda values, _: len(values),
    "min": lambda values, _: min(values, default=None),
    "max": lambda values, _: max(values, default=None),
    "sum": lambda values, _: math.fsum(values) if values else None,
    "avg": lambda values, _: fmean(values) if values else None,
    "stddev": lambda values, _: stdev(values) if len(values) > 1 else None,
    "median": _quantile,
    "percentile": _quantile,
    "collect": lambda values, of: sorted(values) if of.distinct else values,
}
"""Functions that compute aggregates from the known values."""


_OF_NOTHING: Final = {"EXISTS": False, "COUNT": 0, "SUM": 0.0}
"""Values of blocks that use an absent node. Other blocks are unknown."""


def _value(of: b.Bound, *, injective: bool) -> Evaluate:
    """Return a function that evaluates an expression for one match, whose optional nodes may be absent."""
    match of:
        case b.Operation(word=word, operands=operands):
            return OPERATORS[word].one([_value(one, injective=injective) for one in operands])
        case _:
            keys, edges = b.nodes_of(of), b.edges_of(of)
            told = expression(of, injective=injective)
            absent = _OF_NOTHING.get(of.word) if isinstance(of, b.BlockValue) else None

    def known(row: Binding) -> Any:
        if _absent(row, keys, edges):
            return absent
        return told(row)

    return known


def _absent(row: Binding, nodes: Iterable[str], edges: Iterable[str]) -> bool:
    bound = {**row.nodes, **row.edges}
    return any(bound.get(key) is None for key in (*nodes, *edges))
