"""Explanation why a pattern does not match: its first part that a scene graph does not contain.

The parts of a pattern are tested in reading order: its nodes, each edge as soon as both its ends are bound,
then the conditions. So the result names one part, and the parts before it hold together.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import number_of
from sgstore.lang import ir as b
from sgstore.lang.help._pattern_parts import parts_of
from sgstore.lang.help._pattern_text import Writer, joined_calls, kind_label, text_written
from sgstore.lang.memory import Binding, FrameView, NodePair, ScopeSearch, expression
from sgstore.lang.operators import MIRRORED
from sgstore.lang.sql import TRACE_OF_FRAME, happened_in_frame, leaves, told_events
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import EVENT_KINDS, KINDS, RELATIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    Ask = Callable[[str, list[object]], Sequence[tuple[Any, ...]]]


_WRITTEN_NUMBER: Final = re.compile(
    r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|--[^\n]*|(?<![\w.])(\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)"""
)
"""Regular expression: quoted texts and comments, which are skipped, or a number."""


def _beyond(sign: str, limit: float, value: float) -> float:
    """Return a round limit, with few digits, at which a false comparison becomes true for a value."""
    if sign == "=":
        return value
    up = sign in {"<", "<="}
    span = abs(value - limit) or abs(value) or 1.0
    step = 10.0 ** math.floor(math.log10(span))
    rounded = (math.ceil(value / step) if up else math.floor(value / step)) * step
    if rounded == value and sign in {"<", ">"}:
        rounded += step if up else -step
    return round(rounded, 12)


MOST_LOOKED_AT: Final = 10_000
"""Largest number of partial matches that are searched for the nearest match."""


@dataclass(frozen=True, slots=True)
class WhyNot:
    """Explanation why a pattern does not match a scene graph: matching parts, and the first part that fails.

    Attributes
    ----------
    held : tuple of str
        Parts of the pattern that hold together, in reading order.
    failed : str
        First part that does not hold together with ``held``; empty if the whole pattern holds.
    nearest : mapping of str to str
        Binding for which the failed part is nearest to true, or a match if the whole pattern holds.
    found : str
        Actual facts: the values in the failed condition, the relations between the two nodes, or the kinds of
        nodes in the graph.

    All of them are text of the query language. ``held`` and ``failed`` can be used in queries, as patterns
    after ``MATCH`` and as conditions after ``WHERE``.

    ``gaps`` lists each false comparison with a number in the failed condition, for the nearest binding: the
    comparison sign, the number in the query, and the actual value.
    """

    held: tuple[str, ...]
    failed: str
    nearest: Mapping[str, str]
    found: str
    gaps: tuple[tuple[str, float, float], ...] = ()

    def relaxed(self, text: str) -> Iterator[tuple[int, int, str]]:
        """Yield changes of numbers in the query text that could make the false condition true.

        Each result is the start, the end and the new text. A number may occur several times in the query, so
        the caller must test each replacement.

        Parameters
        ----------
        text : str
            Text of the query.
        """
        for sign, limit, value in self.gaps:
            for found in _WRITTEN_NUMBER.finditer(text):
                if found[1] is not None and float(found[1]) == abs(limit):
                    new = _beyond(sign, limit, value)
                    minus = limit < 0 and text[: found.start(1)].rstrip().endswith("-")
                    if new >= 0 and not minus:
                        yield found.start(1), found.end(1), f"{new:.12g}"
                    elif minus:
                        start = text[: found.start(1)].rstrip().rindex("-")
                        yield start, found.end(1), f"{new:.12g}"

    def as_dict(self) -> dict[str, Any]:
        """Return the explanation as a dictionary of texts and numbers."""
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
            named = (f"{name}.name = {text_written(node)}" for name, node in self.nearest.items())
            bound = " AND ".join(named)
            lines.append(f"{'nearest' if self.failed else 'with   '} {bound}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class WhyNotSteps:
    """Explanation why a sequence does not match: for each step, the parts that match in a scene graph.

    Attributes
    ----------
    texts : tuple of str
        Text of each step.
    steps : tuple of WhyNot
        Explanation of each step, with its own bindings. Durations and order are ignored.
    trace : str
        Trace whose frames were all tested; empty for a single graph.
    frames : tuple of int
        Number of frames of the trace in which each step holds, without its duration; empty for a single graph.
    apart : tuple of (int, str)
        Steps that hold in the trace, but never follow the step before as required: the number of the step,
        from 1, and the link to the step before, such as ``THEN WITHIN 1s``.
    """

    texts: tuple[str, ...]
    steps: tuple[WhyNot, ...]
    trace: str = ""
    frames: tuple[int, ...] = ()
    apart: tuple[tuple[int, str], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the explanation of all steps as a dictionary of texts and numbers."""
        pairs = zip(self.texts, self.steps, strict=True)
        steps = [{"step": text, **step.as_dict()} for text, step in pairs]
        if not self.trace:
            return {"steps": steps}
        counted = [{**step, "frames": n} for step, n in zip(steps, self.frames, strict=True)]
        apart = [{"step": number, "link": link} for number, link in self.apart]
        return {"steps": counted, "trace": self.trace, "apart": apart}

    def __str__(self) -> str:
        lines: list[str] = []
        for number, (text, step) in enumerate(zip(self.texts, self.steps, strict=True), start=1):
            lines += [f"step {number} of {len(self.steps)}: {text}"]
            lines += [f"  {line}" for line in str(step).splitlines()]
        if not self.trace:
            lines.append("parts that need other frames (FOR, THEN, EVENTUALLY …) are not tested")
        for number, count in enumerate(self.frames, start=1):
            where = f"in {number_of(count, 'frame')} of" if count else "in no frame of"
            lines.append(f"step {number} holds {where} {self.trace}")
        lines += [
            f"step {number} never follows step {number - 1} in {self.trace}: {link}"
            for number, link in self.apart
        ]
        return "\n".join(lines)


def why_not(query: b.Query, view: FrameView, text: str = "") -> WhyNot | WhyNotSteps:
    """Return an explanation why a query does not match a scene graph: which parts match, and which do not.

    For a sequence, it explains each step.
    """
    if not query.steps:
        return _in_frame(query.first, query, view)
    texts = (" ".join(text[step.span.start : step.span.end].split()) for step in query.steps)
    steps = tuple(_in_frame(step.scope, query, view) for step in query.steps)
    return WhyNotSteps(tuple(texts), steps)


def _in_frame(asked: b.Scope, query: b.Query, view: FrameView) -> WhyNot:
    scope, writer = _nothing(asked), Writer(asked, query.calls)
    held: list[str] = []
    for part, wider in growing(asked, query.calls):
        if not _first(wider, query, view):
            return _failure(part, scope, query, view, writer, tuple(held))
        scope = wider
        held.append(part_text(part, scope, writer))
    at = _first(scope, query, view)
    return WhyNot(tuple(held), "", _named(at, scope) if at else {}, "")


def looked_up(query: b.Query) -> list[b.FrameAttribute]:
    """Return the frame attributes that a query uses and a scene graph lacks: weather, user tables."""
    found: dict[str, b.FrameAttribute] = {}

    def look(scope: b.Scope) -> None:
        for condition in scope.where:
            for leaf in leaves(condition):
                if isinstance(leaf, b.BlockValue):
                    look(leaf.scope)
                elif isinstance(leaf, b.FrameAttribute) and leaf.attribute.of_store:
                    found[leaf.attribute.name] = leaf

    for scope in (query.scope, *query.patterns):
        look(scope)
    return list(found.values())


def events_in(query: b.Query, frame_id: int, ask: Ask) -> dict[str, list[NodePair]]:
    """Return the recorded events in a frame that a query uses: event kind → pairs of entities.

    Parameters
    ----------
    query : Query
    frame_id : int
    ask : function
        Function that runs a statement with its values and returns the rows.

    Returns
    -------
    dict
        Kind, or name of a user table → nodes. Kinds that the trace does not record are omitted.
    """
    found: dict[str, list[NodePair]] = {}
    for one in _happened_anywhere(query):
        if one.table or frame_id >> TRACE_OF_FRAME in {
            row[0] for row in ask(told_events(one.kind), [])
        }:
            pairs = ask(happened_in_frame(one), [frame_id])
            found[one.kind] = [(pair[0], pair[1]) for pair in pairs]
    return found


def _happened_anywhere(query: b.Query) -> list[b.Happened]:
    """Return the tests for recorded events in a query.

    For each kind of event, keep the test with most nodes.
    """
    found: dict[str, b.Happened] = {}

    def look(scope: b.Scope) -> None:
        for leaf in (leaf for condition in scope.where for leaf in leaves(condition)):
            if isinstance(leaf, b.BlockValue):
                look(leaf.scope)
            elif isinstance(leaf, b.Happened):
                most = "" if leaf.table else "a" * EVENT_KINDS[leaf.kind]
                wider = leaf if leaf.table else replace(leaf, nodes=tuple(most))
                known = found.get(leaf.kind, wider)
                found[leaf.kind] = max(known, wider, key=lambda one: len(one.nodes))

    for scope in (query.scope, *(step.scope for step in query.steps)):
        look(scope)
    return list(found.values())


_Part = b.Node | b.Edge | b.Bound


def _nothing(scope: b.Scope) -> b.Scope:
    return b.Scope({}, scope.outer, (), (), frozenset())


def _parts(scope: b.Scope, calls: b.Calls) -> list[_Part]:
    parts: list[_Part] = []
    seen: set[str] = set()
    edges = list(scope.edges)
    for key, node in scope.nodes.items():
        parts.append(node)
        seen.add(key)
        complete = [edge for edge in edges if {edge.src, edge.dst} <= seen]
        edges = [edge for edge in edges if edge not in complete]
        parts += complete
    return [*parts, *edges, *joined_calls(scope.where, calls)]


def growing(whole: b.Scope, calls: b.Calls) -> Iterator[tuple[b.Node | b.Edge | b.Bound, b.Scope]]:
    """Yield each part of a pattern (node, edge or condition), and the pattern from the start up to it."""
    scope = _nothing(whole)
    for part in _parts(whole, calls):
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
    search = ScopeSearch(scope, injective=query.injective)
    for _ in search.run(at):
        yield at


def _first(scope: b.Scope, query: b.Query, view: FrameView) -> Binding | None:
    return next(_bindings(scope, query, view), None)


def _failure(
    part: _Part,
    scope: b.Scope,
    query: b.Query,
    view: FrameView,
    writer: Writer,
    held: tuple[str, ...],
) -> WhyNot:
    best, nearest, found = math.inf, dict[str, str](), ""
    gaps: tuple[tuple[str, float, float], ...] = ()
    if isinstance(part, b.Node):
        at = _first(scope, query, view)
        nearest = _named(at, scope) if at else {}
        return WhyNot(held, part_text(part, scope, writer), nearest, _population(view))
    # A condition on an edge needs a bound edge. A scope without such conditions does not bind it.
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    for at in islice(_bindings(replace(scope, edges=edges), query, view), MOST_LOOKED_AT):
        short = _apart(part, at) if isinstance(part, b.Edge) else shortfall(part, at, query)
        if short < best or not found:
            best, nearest = short, _named(at, scope)
            between = isinstance(part, b.Edge)
            plain = writer.expanded()
            found = _between(part, at, writer) if between else _values(part, at, query, plain)
            gaps = () if between else tuple(_gaps(part, at, query))
    return WhyNot(held, part_text(part, scope, writer), nearest, found, gaps)


def _gaps(condition: b.Bound, at: Binding, query: b.Query) -> Iterator[tuple[str, float, float]]:
    """Yield the false comparisons in a condition: comparison sign, limit and actual value of each."""
    for part in b.walk(condition):
        match part:
            case b.Operation(word=word, operands=(left, right)) if word in _COMPARED:
                if isinstance(_constant_of(left), float):
                    word, left, right = MIRRORED[word], right, left
                limit = _constant_of(right)
                if limit is None or _value(part, at, query) is not False:
                    continue
                value = _value(left, at, query)
                if isinstance(value, int | float) and not isinstance(value, bool):
                    yield word, limit, float(value)
            case _:
                pass


def _constant_of(value: b.Bound) -> float | None:
    """If an expression is a number, return its value; otherwise None."""
    match value:
        case b.Value(shown=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case b.Operation(word="negative", operands=(b.Value(value=int() | float() as number),)):
            return -float(number)
        case _:
            return None


def shortfall(condition: b.Bound, at: Binding, query: b.Query) -> float:
    """Return how far a condition is from being true for a match: 0 if it is true, inf if unknown."""
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
    """Return the distance of the two nodes of an edge; m; inf if unknown."""
    distance = at.view.pair("dist", at.nodes[edge.src], at.nodes[edge.dst])
    return math.inf if distance is None else distance


def part_text(part: _Part, scope: b.Scope, writer: Writer) -> str:
    """Return a part of a pattern as query text: a node, edge or condition. Unnamed nodes get names."""
    if isinstance(part, b.Node):
        return writer.node(part.key, part.kinds)
    return writer.edge(part, scope) if isinstance(part, b.Edge) else writer.expression(part)


def _named(at: Binding, scope: b.Scope) -> dict[str, str]:
    """Return the names of the nodes in a match: variable → name of its node."""
    return {
        key: _name(at.view, at.nodes[key])
        for key, node in scope.nodes.items()
        if node.role == "named" and key in at.nodes
    }


def _name(view: FrameView, node: int) -> str:
    return str(view.nodes[node].get("name", node))


def _population(view: FrameView) -> str:
    counts = Counter(attributes["kind"] for attributes in view.nodes.values())
    found = [(kind_label(kind), counts[kind]) for kind in KINDS if counts[kind]]
    return " AND ".join(f"COUNT {{(:{label})}} = {many}" for label, many in found)


def _between(edge: b.Edge, at: Binding, writer: Writer) -> str:
    """Return the relations that exist between two nodes as query text, in both directions."""
    src, dst = at.nodes[edge.src], at.nodes[edge.dst]
    called = {src: writer.name(edge.src), dst: writer.name(edge.dst)}
    ways = []
    for one, other in ((src, dst), (dst, src)):
        there = at.view.linked(edge).links.get((one, other), {})
        if there:
            relations = "|".join(relation for relation in RELATIONS if relation in there)
            ways.append(f"({called[one]})-[:{relations}]->({called[other]})")
    distance = at.view.pair("dist", src, dst)
    apart = f"dist({called[src]}, {called[dst]}) = {distance:.4g}" if distance is not None else ""
    if not ways:
        nothing = f"NOT EXISTS {{({called[src]})--({called[dst]})}}"
        ways, apart = (
            [f"({name})" for name in called.values()],
            " AND ".join(filter(None, [nothing, apart])),
        )
    return ", ".join(ways) + (f" WHERE {apart}" if apart else "")


def _values(condition: b.Bound, at: Binding, query: b.Query, writer: Writer) -> str:
    """Return the values in a condition as query text, such as ``e.speed = 5.697``."""
    texts: dict[str, str] = {}
    for leaf in leaves(condition):
        name = writer.expression(leaf)
        if isinstance(leaf, b.NodeValue):
            texts[name] = f"{name}.name = {text_written(_name(at.view, at.nodes[leaf.node]))}"
        else:
            texts[name] = _shown(name, _value(leaf, at, query))
    return " AND ".join(texts.values())


@dataclass(frozen=True, slots=True)
class MeasuredValue:
    """Value in a condition of a pattern, for one frame and one binding.

    Attributes
    ----------
    name : str
        Text in the query language, such as ``e.speed``.
    value : float, int, str or None
        ``None`` means unknown.
    unit : str
        Unit of a number; empty without one.
    """

    name: str
    value: float | str | None
    unit: str


ConditionValues = tuple[tuple[tuple[MeasuredValue, ...], ...], ...]
"""Values for each part of a pattern, in each of its conditions. Truth values are left out."""


def condition_values(
    query: b.Query, view: FrameView, binding: Mapping[str, int]
) -> ConditionValues:
    """Return the values in the conditions of a pattern, whether they hold or not.

    Parameters
    ----------
    query : Query
        A bound query.
    view : FrameView
    binding : mapping of str to int
        Node ids of variables. For other variables, the nodes that match or come nearest.

    Returns
    -------
    tuple
        For each part of the pattern (:func:`parts_of`), and each of its conditions. Without a binding for the
        part, or in conditions on other frames, there are no values.

    Raises
    ------
    QueryNameError
        The pattern does not contain the variable.
    """
    found = list[tuple[tuple[MeasuredValue, ...], ...]]()
    for part in parts_of(query, {name: (node,) for name, node in binding.items()}):
        tests = tuple(test for test in part.tests if not b.is_temporal(test))
        at = _nearest_binding(part.query, tests, view) if tests else None
        writer = Writer(part.query.first, query.calls).expanded()
        found.append(
            tuple(
                () if at is None or test not in tests else tuple(_measured(test, at, query, writer))
                for test in part.tests
            )
        )
    return tuple(found)


def _nearest_binding(query: b.Query, tests: Sequence[b.Bound], view: FrameView) -> Binding | None:
    """Return the binding that meets conditions, or comes nearest to it. Missing edges are ignored."""
    apart = {part for test in tests for part in b.conjuncts(test)}
    scope = query.first
    pinned = replace(scope, where=tuple(one for one in scope.where if one not in apart))
    edges = tuple(replace(edge, named=True) if edge.high == 1 else edge for edge in scope.edges)
    ways = [replace(pinned, edges=edges)]
    if not any(b.edges_of(test) for test in tests):
        ways.append(replace(pinned, edges=()))
    for way in ways:
        best, nearest = math.inf, None
        for at in islice(_bindings(way, query, view), MOST_LOOKED_AT):
            short = sum(shortfall(test, at, query) for test in tests)
            if nearest is None or short < best:
                best, nearest = short, replace(at, nodes={**at.nodes}, edges={**at.edges})
            if best == 0:
                break
        if nearest is not None:
            return nearest
    return None


def _measured(
    condition: b.Bound, at: Binding, query: b.Query, writer: Writer
) -> Iterator[MeasuredValue]:
    seen = set[str]()
    for leaf in leaves(condition):
        if isinstance(leaf, b.NodeValue) or (name := writer.expression(leaf)) in seen:
            continue
        seen.add(name)
        value = _value(leaf, at, query)
        if not isinstance(value, bool):
            is_number = isinstance(value, int | float)
            plain = value if value is None or is_number else str(value)
            yield MeasuredValue(name, plain, _unit(leaf) if is_number else "")


_UNITS: Final = {
    **{one: one for one in ("m", "s", "ns", "m/s", "m/s²", "s²", "1/m", "J")},
    "degrees": "°",
}
"""Unit at the end of a meaning in the catalogue → unit beside a number."""


def _unit(leaf: b.Bound) -> str:
    """Return the unit of a value, from its meaning in the catalogue; empty without one."""
    match leaf:
        case b.PairNumber(function=function):
            meaning = PAIR_FUNCTIONS[function].unit if function in PAIR_FUNCTIONS else ""
        case b.NodeAttribute(attribute=attribute) | b.EdgeAttribute(attribute=attribute):
            meaning = attribute.meaning
        case b.FrameAttribute(attribute=attribute) | b.TraceAttribute(attribute=attribute):
            meaning = attribute.meaning
        case _:
            meaning = ""
    return _UNITS.get(meaning.rpartition("; ")[2], "")


def _shown(name: str, value: Any) -> str:
    """Return a value with its name as query text, such as ``e.speed = 5.697``."""
    if value is None:
        return f"{name} IS NULL"
    if isinstance(value, bool):
        return name if value else f"NOT {name}"
    return f"{name} = {text_written(value) if isinstance(value, str) else f'{value:.4g}'}"
