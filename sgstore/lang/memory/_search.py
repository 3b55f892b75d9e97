"""Search of query patterns in one scene graph in memory. The results equal those of the SQL.

The nodes of a pattern are bound one after the other. If an edge leads to a node, its candidates are the
neighbours of a bound node. Each condition is tested as soon as all its variables are bound.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.memory._column_evaluation import crowd_test
from sgstore.lang.memory._evaluate import Binding, Evaluate, evaluator
from sgstore.lang.memory._frame_view import Attributes, FrameView, crowd

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.lang.ir import BlockValue, Edge, Scope
    from sgstore.lang.memory._column_evaluation import Test


@dataclass(slots=True)
class _SearchStep:
    """Step of a pattern search: the variable, the source of its candidate nodes, and the tests of a candidate.

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
        """True if all nodes of some kinds are candidates, not only neighbours of a node or the ego."""
        return bool(self.key) and self.via is None and bool(self.kinds.other)


@dataclass(slots=True)
class _NamedEdge:
    """Pattern edge that the search must choose, because it has a name or conditions."""

    edge: Edge
    tests: list[Evaluate]


class ScopeSearch:
    """Search plan of one graph pattern: the order in which its nodes are chosen."""

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
                place = next((n for n in step.named if n.edge.key in found[2]), None)
                (place.tests if place else step.tests).append(test)

    def _order(self) -> list[_SearchStep]:
        """Return the search steps: first nodes reached by edges, then the ego, then nodes with few kinds."""
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
        """Return an edge of the pattern from a node already chosen to the given node, or None.

        Paths of several edges do not count.
        """
        for edge in self._scope.edges:
            other = edge.dst if edge.src == key else edge.src
            if key in {edge.src, edge.dst} and other in bound and edge.high == 1:
                return edge
        return None

    def run(self, at: Binding) -> Iterator[None]:
        """Yield None once for each match of the pattern. Meanwhile ``at`` holds the chosen nodes and edges."""
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
        """Yield once for each match that extends the chosen nodes, if all tests of a search step are true."""
        step = self._steps[number]
        if all(self._linked(at, edge) for edge in step.edges) and _all(step.tests, at):
            yield from self._name(at, number, 0)

    def _name(self, at: Binding, number: int, nth: int) -> Iterator[None]:
        """Choose the edges of a search step that have names or conditions. Yield once for each match."""
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
    """Return a function that evaluates a query expression for chosen nodes and edges.

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
    """Yield the candidate nodes of a search step: neighbours of a chosen node, or all nodes of some kinds."""
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
    """Return the candidate nodes of a search step that pass its array tests."""
    among = crowd(at.view, step.kinds)
    fits = step.crowd[0](at, among)
    for test in step.crowd[1:]:
        fits = fits & test(at, among)
    return [among.nodes[place] for place in np.flatnonzero(fits).tolist()]


def _steps(
    view: FrameView, relations: frozenset[str], here: int, *, both: bool, forward: bool = True
) -> Iterator[int]:
    """Yield the neighbours of a node along edges with some relations, without duplicates."""
    sides = (view.ahead, view.back) if both else (view.ahead,) if forward else (view.back,)
    found: dict[int, None] = {}
    for side in sides:
        for relation in relations:
            found.update(dict.fromkeys(side.get((relation, here), ())))
    yield from found


def _between(at: Binding, edge: Edge) -> Iterator[tuple[str, Attributes]]:
    """Yield relation and attributes of the edges between the two chosen nodes of a pattern edge.

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
