"""Why a graph does not match a pattern: the first part that fails with those before it, and how near it came.

The parts of a pattern are taken in reading order: its nodes, each edge as soon as both its ends are there, then
the conditions. So the answer names one part, and the parts before it do hold together.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang import bound as b
from sgstore.lang.evaluation import Binding, FrameView
from sgstore.lang.formulas import leaves
from sgstore.lang.match import Search, expression
from sgstore.lang.printing import edge_text, kinds_text, value_text
from sgstore.vocabulary import KINDS, RELATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

MOST_LOOKED_AT: Final = 10_000
"""Ways to bind the parts that hold, among which the nearest to a match is looked for."""


@dataclass(frozen=True, slots=True)
class WhyNot:
    """How far a pattern holds in a graph.

    Attributes
    ----------
    held : tuple of str
        Parts of the pattern that hold together, in reading order.
    failed : str
        The first part that does not hold with these; empty if the whole pattern holds.
    nearest : mapping of str to str
        What the variables are bound to where the failed part comes nearest to be true (or where all of it is).
    found : str
        What is there instead: the values in the failed condition, the relations between the two nodes, the
        kinds of nodes in the graph.
    """

    held: tuple[str, ...]
    failed: str
    nearest: Mapping[str, str]
    found: str

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values."""
        return {
            "matches": not self.failed,
            "held": list(self.held),
            "failed": self.failed or None,
            "nearest": dict(self.nearest),
            "found": self.found or None,
        }

    def __str__(self) -> str:
        lines = [f"holds   {part}" for part in self.held]
        if self.failed:
            lines.append(f"FAILS   {self.failed}")
        if self.found:
            lines.append(f"found   {self.found}")
        if self.nearest:
            bound = ", ".join(f"{name} = {node}" for name, node in self.nearest.items())
            lines.append(f"{'nearest' if self.failed else 'with   '} {bound}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class WhyNotSteps:
    """How far each step of a sequence holds in one graph; how long it does, and what comes when, is left aside.

    Attributes
    ----------
    texts : tuple of str
        The steps as they were written.
    steps : tuple of WhyNot
        Each by itself: its variables are bound anew.
    """

    texts: tuple[str, ...]
    steps: tuple[WhyNot, ...]

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values."""
        pairs = zip(self.texts, self.steps, strict=True)
        return {"steps": [{"step": text, **step.as_dict()} for text, step in pairs]}

    def __str__(self) -> str:
        lines: list[str] = []
        for number, (text, step) in enumerate(zip(self.texts, self.steps, strict=True), start=1):
            lines += [f"step {number} of {len(self.steps)}: {text}"]
            lines += [f"  {line}" for line in str(step).splitlines()]
        return "\n".join(
            [*lines, "what looks at other frames (FOR, THEN, EVENTUALLY …) is not asked"]
        )


def why_not(query: b.Query, view: FrameView, text: str = "") -> WhyNot | WhyNotSteps:
    """How far a bound pattern, written as ``text``, holds in a graph; of a sequence, each of its steps."""
    if not query.steps:
        return _in_frame(query.scope, query, view)
    texts = (" ".join(text[step.span.start : step.span.end].split()) for step in query.steps)
    steps = tuple(_in_frame(step.scope, query, view) for step in query.steps)
    return WhyNotSteps(tuple(texts), steps)


def _in_frame(asked: b.Scope, query: b.Query, view: FrameView) -> WhyNot:
    scope, parts = _nothing(asked), _parts(asked)
    held: list[str] = []
    for part, wider in _growing(asked, scope, parts):
        if not _first(wider, query, view):
            return _failure(part, scope, query, view, tuple(held))
        scope = wider
        held.append(_text(part, scope))
    at = _first(scope, query, view)
    return WhyNot(tuple(held), "", _named(at, scope) if at else {}, "")


def looked_up(query: b.Query) -> list[b.FrameAttribute]:
    """What a pattern asks of a frame that only the store can tell: its weather, tables of users' own."""
    found: dict[str, b.FrameAttribute] = {}

    def look(scope: b.Scope) -> None:
        for condition in scope.where:
            for leaf in leaves(condition):
                if isinstance(leaf, b.BlockValue):
                    look(leaf.scope)
                elif isinstance(leaf, b.FrameAttribute) and leaf.attribute.of_store:
                    found[leaf.attribute.name] = leaf

    for scope in (query.scope, *(step.scope for step in query.steps)):
        look(scope)
    return list(found.values())


_Part = b.Node | b.Edge | b.Bound


def _nothing(scope: b.Scope) -> b.Scope:
    return b.Scope({}, scope.outer, (), (), frozenset())


def _parts(scope: b.Scope) -> list[_Part]:
    parts: list[_Part] = []
    seen: set[str] = set()
    edges = list(scope.edges)
    for key, node in scope.nodes.items():
        parts.append(node)
        seen.add(key)
        complete = [edge for edge in edges if {edge.src, edge.dst} <= seen]
        edges = [edge for edge in edges if edge not in complete]
        parts += complete
    return [*parts, *edges, *scope.where]


def _growing(whole: b.Scope, scope: b.Scope, parts: list[_Part]) -> Iterator[tuple[_Part, b.Scope]]:
    """Each part, with the scope of all parts up to it."""
    for part in parts:
        if isinstance(part, b.Node):
            scope = replace(scope, nodes={**scope.nodes, part.key: part})
            distinct = frozenset(p for p in whole.distinct if set(p) <= set(scope.nodes))
            scope = replace(scope, distinct=distinct)
        elif isinstance(part, b.Edge):
            scope = replace(scope, edges=(*scope.edges, part))
        else:
            scope = replace(scope, where=(*scope.where, part))
        yield part, scope


def _bindings(scope: b.Scope, query: b.Query, view: FrameView) -> Iterator[Binding]:
    at = Binding(view)
    search = Search(scope, injective=query.injective)
    for _ in search.run(at):
        yield at


def _first(scope: b.Scope, query: b.Query, view: FrameView) -> Binding | None:
    return next(_bindings(scope, query, view), None)


def _failure(
    part: _Part, scope: b.Scope, query: b.Query, view: FrameView, held: tuple[str, ...]
) -> WhyNot:
    best, nearest, found = math.inf, dict[str, str](), ""
    if isinstance(part, b.Node):
        at = _first(scope, query, view)
        nearest = _named(at, scope) if at else {}
        found = _population(view)
        return WhyNot(held, _text(part, scope), nearest, found)
    # A condition on an edge needs the edge bound, which a scope without conditions on it does not do.
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    for at in islice(_bindings(replace(scope, edges=edges), query, view), MOST_LOOKED_AT):
        short = _apart(part, at) if isinstance(part, b.Edge) else shortfall(part, at, query)
        if short < best or not found:
            best, nearest = short, _named(at, scope)
            found = _between(part, at) if isinstance(part, b.Edge) else _values(part, at, query)
    return WhyNot(held, _text(part, scope), nearest, found)


def shortfall(condition: b.Bound, at: Binding, query: b.Query) -> float:
    """How far a condition is from being true: 0 if it is, else by how much its numbers miss; inf if unknown."""
    if _value(condition, at, query) is True:
        return 0.0
    match condition:
        case b.Operation(word="AND", operands=operands):
            return sum(shortfall(operand, at, query) for operand in operands)
        case b.Operation(word="OR", operands=operands):
            return min(shortfall(operand, at, query) for operand in operands)
        case b.Operation(word=word, operands=(left, right)) if word in _COMPARED:
            one, other = _value(left, at, query), _value(right, at, query)
            numbers = all(isinstance(v, int | float) for v in (one, other))
            return abs(one - other) if numbers else math.inf
        case _:
            return math.inf


_COMPARED: Final = frozenset({"<", "<=", ">", ">=", "="})


def _value(of: b.Bound, at: Binding, query: b.Query) -> Any:
    return expression(of, injective=query.injective)(at)


def _apart(edge: b.Edge, at: Binding) -> float:
    """How near the ends of an edge are to one another: their distance, or inf where they have none."""
    distance = at.view.pair("dist", at.nodes[edge.src], at.nodes[edge.dst])
    return math.inf if distance is None else distance


# As text ----------------------------------------------------------------------------------------------------


def _text(part: _Part, scope: b.Scope) -> str:
    """A part as a person reads it: what has no name is called by its kinds."""
    if isinstance(part, b.Node):
        kinds = kinds_text(part.kinds)
        return f"some {kinds}" if part.key.startswith("#") else f"({part.key}) is {kinds}"
    if isinstance(part, b.Edge):
        return _NAMELESS.sub(lambda key: f"({_kind(key[1], scope)})", edge_text(part))
    text = re.sub(r"\{.*\}", "{…}", value_text(part), flags=re.DOTALL)
    return text[1:-1] if text.startswith("(") and text.endswith(")") else text


_NAMELESS: Final = re.compile(r"\((#\d+)\)")


def _kind(key: str, scope: b.Scope) -> str:
    return kinds_text(scope.nodes[key].kinds) if key in scope.nodes else "something"


def _named(at: Binding, scope: b.Scope) -> dict[str, str]:
    """Names of the nodes that the named variables are bound to."""
    return {
        key: _name(at.view, at.nodes[key])
        for key, node in scope.nodes.items()
        if node.role == "named" and key in at.nodes
    }


def _name(view: FrameView, node: int) -> str:
    return str(view.nodes[node].get("name", node))


def _population(view: FrameView) -> str:
    """How many nodes there are of each kind."""
    counts = Counter(attributes["kind"] for attributes in view.nodes.values())
    return ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind]) or "an empty graph"


def _between(edge: b.Edge, at: Binding) -> str:
    """The relations that there are between the ends of an edge, both ways."""
    src, dst = at.nodes[edge.src], at.nodes[edge.dst]
    ways = []
    for one, other in ((src, dst), (dst, src)):
        there = at.view.links.get((one, other), {})
        if there:
            relations = "|".join(relation for relation in RELATIONS if relation in there)
            names = _name(at.view, one), _name(at.view, other)
            ways.append(f"({names[0]})-[{relations}]->({names[1]})")
    distance = at.view.pair("dist", src, dst)
    ways += [] if distance is None else [f"{distance:.2f} m apart"]
    return ", ".join(ways) or "no edge between them"


def _values(condition: b.Bound, at: Binding, query: b.Query) -> str:
    """What the values in a condition are."""
    texts: dict[str, str] = {}
    for leaf in leaves(condition):
        if isinstance(leaf, b.NodeValue):
            texts[leaf.node] = _name(at.view, at.nodes[leaf.node])
        else:
            label = f"{leaf.word} {{…}}" if isinstance(leaf, b.BlockValue) else value_text(leaf)
            texts[label] = _shown(_value(leaf, at, query))
    return ", ".join(f"{name} = {value}" for name, value in texts.items())


def _shown(value: Any) -> str:
    if value is None:
        return "unknown"
    return f"{value:.4g}" if isinstance(value, float) else repr(value)
