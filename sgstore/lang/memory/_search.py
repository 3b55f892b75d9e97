"""Search for query patterns in one scene graph in memory, with the same results as the SQL.

The nodes of a pattern are bound one after the other. If an edge leads to a node, its candidates are the
neighbours of a bound node. Each condition is tested as soon as all its variables are bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.memory._evaluate import Binding, Evaluate, crowd_test, evaluator
from sgstore.lang.memory._frame_view import Attributes, FrameView, crowd
from sgstore.lang.operators import OPERATORS
from sgstore.lang.sql import path_ways

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.lang.ir import BlockValue, Edge, Scope
    from sgstore.lang.memory._evaluate import Test


@dataclass(slots=True)
class _SearchStep:
    """Step of a pattern search: the variable, where its candidate nodes come from, and their tests.

    The tests in ``crowd`` run before binding, for all candidates at once.
    """

    key: str
    kinds: b.Kinds
    via: Edge | None
    others: tuple[str, ...] = ()
    edges: list[Edge] = field(default_factory=list["Edge"])
    crowd: list[Test] = field(default_factory=list["Test"])
    tests: list[Evaluate] = field(default_factory=list[Evaluate])
    named: list[_NamedEdge] = field(default_factory=list["_NamedEdge"])

    @property
    def among(self) -> bool:
        """True if the candidates are all nodes of some kinds: not just the ego, or neighbours of a node."""
        return bool(self.key) and self.via is None and bool(self.kinds.other)


@dataclass(slots=True)
class _NamedEdge:
    """Pattern edge that the search must choose, as the edge has a name or conditions."""

    edge: Edge
    tests: list[Evaluate]


class ScopeSearch:
    """Search plan of one graph pattern: the order of its variables, and the tests after each."""

    def __init__(self, scope: Scope, *, injective: bool) -> None:
        self._scope = scope
        self._injective = injective
        self._outer = tuple(scope.outer.items())
        self._first = _SearchStep("", b.any_kinds(), None)
        self._steps = [self._first]
        order = self._order()
        bound = set(scope.outer)
        pending = list(scope.edges)
        conditions = [(condition, *_needs(condition)) for condition in scope.where]
        bound_edges: set[str] = set()
        asked = {key for _, _, edges in conditions for key in edges}
        for step in [self._first, *order]:
            if step.key:
                bound.add(step.key)
                self._steps.append(step)
            for edge in [e for e in pending if {e.src, e.dst} <= bound]:
                pending.remove(edge)
                if edge.named or edge.key in asked:
                    bound_edges.add(edge.key)
                    step.named.append(_NamedEdge(edge, []))
                else:
                    step.edges.append(edge)
            for found in [c for c in conditions if c[1] <= bound and c[2] <= bound_edges]:
                conditions.remove(found)
                at_once = crowd_test(found[0], step.key) if step.among and not found[2] else None
                if at_once is not None:
                    step.crowd.append(at_once)
                    continue
                test = expression(found[0], injective=injective)
                last = reversed(step.named)  # edges of a step are chosen in their order
                place = next((n for n in last if n.edge.key in found[2]), None)
                (place.tests if place else step.tests).append(test)

    def _order(self) -> list[_SearchStep]:
        """Return the search steps in a fast order: the ego, then nodes at edges, then nodes of few kinds."""
        scope, bound, steps = self._scope, set(self._scope.outer), list[_SearchStep]()
        left = dict.fromkeys(scope.nodes)
        while left:
            ways = {key: self._way(key, bound) for key in left}

            def worth(key: str, ways: Mapping[str, Edge | None] = ways) -> tuple[bool, bool, int]:
                kinds = scope.nodes[key].kinds
                return bool(kinds.other), ways[key] is None, len(kinds.every)

            key = min(left, key=worth)
            others = [o for pair in scope.distinct if key in pair for o in pair if o != key]
            known = tuple(other for other in others if other in bound)
            steps.append(_SearchStep(key, scope.nodes[key].kinds, ways[key], known))
            bound.add(key)
            del left[key]
        return steps

    def _way(self, key: str, bound: set[str]) -> Edge | None:
        """Return an edge of the pattern from a node chosen earlier to the given node; None without one.

        Paths of several edges do not count.
        """
        for edge in self._scope.edges:
            other = edge.dst if edge.src == key else edge.src
            if key in {edge.src, edge.dst} and other in bound and edge.high == 1:
                return edge
        return None

    def run(self, at: Binding) -> Iterator[None]:
        """Yield once for each match of the pattern. Each time, ``at`` has the chosen nodes and edges."""
        if all(at.view.is_one(at.nodes[key], kinds) for key, kinds in self._outer):
            yield from self._bound(at, 0)

    def _bind(self, at: Binding, number: int) -> Iterator[None]:
        if number == len(self._steps):
            yield
            return
        step = self._steps[number]
        taken = {at.nodes[key] for key in step.others}
        if step.crowd:
            for node in _fitting(at, step):
                if node not in taken:
                    at.nodes[step.key] = node
                    yield from self._bound(at, number)
            return
        for node in _candidates(at, step):
            if node not in taken and at.view.is_one(node, step.kinds):
                at.nodes[step.key] = node
                yield from self._bound(at, number)

    def _bound(self, at: Binding, number: int) -> Iterator[None]:
        """Choose the nodes of the search step with this number, and of later steps. Yield once per match."""
        step = self._steps[number]
        if all(self._linked(at, edge) for edge in step.edges) and _all(step.tests, at):
            yield from self._name(at, number, 0)

    def _name(self, at: Binding, number: int, nth: int) -> Iterator[None]:
        """Choose the edges that a step tests or names, and match the later steps. Yield once for each match."""
        step = self._steps[number]
        if nth == len(step.named):
            yield from self._bind(at, number + 1)
            return
        named = step.named[nth]
        for found in _between(at, named.edge):
            at.edges[named.edge.key] = found
            if _all(named.tests, at):
                yield from self._name(at, number, nth + 1)
                if not named.edge.named:  # one such edge is sufficient
                    return

    def _linked(self, at: Binding, edge: Edge) -> bool:
        if edge.low == edge.high == 1:
            return any(True for _ in _between(at, edge))
        src, dst = at.nodes[edge.src], at.nodes[edge.dst]
        return any(
            self._walks(at.view, edge, src, dst, n, (src,)) for n in range(edge.low, edge.high + 1)
        )

    def _walks(
        self, view: FrameView, edge: Edge, here: int, dst: int, length: int, seen: tuple[int, ...]
    ) -> bool:
        """True if a path of ``length`` edges connects two nodes of the frame.

        If nodes must differ, the path visits each node once.
        """
        if length == 0:
            return here == dst
        for step in _steps(view.linked(edge), edge.relations, here, both=edge.both):
            if self._injective and length > 1 and (step in seen or step == dst):
                continue
            if self._walks(view, edge, step, dst, length - 1, (*seen, step)):
                return True
        return False


def expression(of: b.Bound, *, injective: bool) -> Evaluate:
    """Return a function that computes the value of an expression for the chosen nodes and edges.

    Parameters
    ----------
    of : Bound
    injective : bool
        True if different nodes of a block must be bound to different nodes.
    """
    return evaluator(of, lambda block: _block(block, injective=injective))


def _block(block: BlockValue, *, injective: bool) -> Evaluate:
    inner = ScopeSearch(block.scope, injective=injective)
    value = expression(block.value, injective=injective) if block.value is not None else None

    def of_block(at: Binding) -> Any:
        # The search changes bindings, but must not change the outer ones.
        within = Binding(at.view, dict(at.nodes), dict(at.edges))
        found = inner.run(within)
        if block.word == "EXISTS":
            return any(True for _ in found)
        if value is None:
            return sum(1 for _ in found)
        known = [v for v in (value(within) for _ in found) if v is not None]
        return _over(block.word, known)

    return of_block


def _over(word: str, values: list[Any]) -> Any:
    if word == "SUM":
        return float(sum(values))
    if not values:
        return None
    if word == "AVG":
        return sum(values) / len(values)
    return min(values) if word == "MIN" else max(values)


def _all(tests: list[Evaluate], at: Binding) -> bool:
    return all(test(at) is True for test in tests)


def _needs(condition: b.Bound) -> tuple[frozenset[str], frozenset[str]]:
    """Return the nodes and edges that must be chosen before a condition can be tested."""
    return b.nodes_of(condition), b.edges_of(condition)


def _candidates(at: Binding, step: _SearchStep) -> Iterator[int]:
    """Yield the nodes to try in a search step: neighbours of a chosen node, or all nodes of some kinds."""
    view, edge = at.view, step.via
    if edge is not None:
        forward = edge.dst == step.key
        here = at.nodes[edge.src if forward else edge.dst]
        linked = view.linked(edge)
        yield from _steps(linked, edge.relations, here, both=edge.both, forward=forward)
    elif not step.kinds.other:
        if view.graph.ego is not None and view.graph.ego in view.nodes:
            yield view.graph.ego
    else:
        for kind in step.kinds.every:
            yield from view.by_kind.get(kind, ())


def _fitting(at: Binding, step: _SearchStep) -> list[int]:
    """Return the nodes to try in a search step. Nodes that fail a test on arrays are left out."""
    among = crowd(at.view, step.kinds)
    fits = step.crowd[0](at, among)
    for test in step.crowd[1:]:
        fits = fits & test(at, among)
    return [among.nodes[place] for place in np.flatnonzero(fits).tolist()]


def _steps(
    view: FrameView, relations: frozenset[str], here: int, *, both: bool, forward: bool = True
) -> Iterator[int]:
    """Yield each neighbour of a node along edges with the given relations, without duplicates."""
    sides = (view.ahead, view.back) if both else (view.ahead,) if forward else (view.back,)
    found: dict[int, None] = {}
    for side in sides:
        for relation in relations:
            found.update(dict.fromkeys(side.get((relation, here), ())))
    yield from found


def _between(at: Binding, edge: Edge) -> Iterator[tuple[str, Attributes]]:
    """Yield relation and attributes of each edge between two chosen nodes that a pattern edge matches.

    Each relation occurs once.
    """
    src, dst = at.nodes[edge.src], at.nodes[edge.dst]
    links = at.view.linked(edge).links
    found = dict(links.get((src, dst), {}))
    if edge.both:
        found = {**links.get((dst, src), {}), **found}
    for relation, attributes in found.items():
        if relation in edge.relations:
            yield relation, attributes


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
        """Return a function that computes an expression for one match. Optional nodes may be missing."""
        return _value(of, injective=self._injective)


class _Joining:
    """``MATCH`` or ``OPTIONAL MATCH`` clause. It extends each match by the matches of its pattern."""

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
        """Yield one extended match for each match of the clause's pattern."""
        if _absent(row, self._stage.scope.outer, ()):
            return
        told: set[object] = set()
        for search, paths in self._ways:
            at = _row(view, row.nodes, row.edges, row.passed)
            for _ in search.run(at):
                if any(at.nodes[key] == row.nodes.get(other) for key, other in self._stage.apart):
                    continue
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
    """``WITH`` clause: it groups, sorts and limits the matches of a frame, and keeps the listed values."""

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
        """Return one match for each group: the combination of grouping values of a ``WITH`` clause."""
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
        """Return the value of an expression with aggregates for one group of matches."""
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
    """Return the key that sorts matches by default: node ids, relations and ``WITH`` values."""
    nodes = [row.nodes[key] for key in sorted(row.nodes)]
    edges = [row.edges[key] and row.edges[key][0] for key in sorted(row.edges)]
    return tuple((one is None, one or 0) for one in (*nodes, *edges, *row.passed.values()))


def _aggregate(of: b.Aggregate, rows: Rows, *, injective: bool) -> Any:
    """Return the value of an aggregate, such as ``COUNT``, for the given matches.

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
    "sum": lambda values, _: math.fsum(values),
    "avg": lambda values, _: fmean(values) if values else None,
    "stddev": lambda values, _: stdev(values) if len(values) > 1 else None,
    "median": _quantile,
    "percentile": _quantile,
    "collect": lambda values, of: sorted(values) if of.distinct else values,
}
"""Functions that compute an aggregate from its known values, by name."""


_OF_NOTHING: Final = {"EXISTS": False, "COUNT": 0, "SUM": 0.0}
"""Values of patterns in braces that use a missing optional node. All other words give an unknown value."""


def _value(of: b.Bound, *, injective: bool) -> Evaluate:
    """Return a function that computes an expression for one match. Optional nodes may be missing."""
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
