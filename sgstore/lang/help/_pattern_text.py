"""Writer of graph patterns as query text that users can copy into a query.

Nodes and edges without a name get one if the text needs it: ``lane`` for a lane, ``lane2`` for the second.
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TextSpan
from sgstore.lang import ir as b
from sgstore.lang.catalog import FRAME_ATTRIBUTES, DisplayUnit
from sgstore.lang.operators import INFIX, ROUNDINGS
from sgstore.model.pair_numbers import as_written
from sgstore.model.vocabulary import KINDS, RELATIONS, SUPER_KINDS, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    Ask = Callable[[str, list[object]], Sequence[tuple[Any, ...]]]

_ESCAPES: Final = {"\\": "\\\\", "'": "\\'", "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def text_written(text: str) -> str:
    """Return a text constant in quotes and with escapes, as in a query."""
    return "'" + "".join(_ESCAPES.get(letter, letter) for letter in text) + "'"


def label_written(kinds: b.Kinds) -> str:
    """Return the label for a set of node kinds, such as ``Car|Truck``.

    It is empty if all kinds are allowed.
    """
    if kinds == b.any_kinds():
        return ""
    if not kinds.other:
        return "Ego" if kinds.ego == entity_kinds() else f"Ego&({_label(kinds.ego)})"
    label = _label(kinds.other)
    if kinds.ego == kinds.other & entity_kinds():
        return label
    if not kinds.ego:
        return f"({label})&!Ego" if "|" in label else f"{label}&!Ego"
    of_ego = "Ego" if kinds.ego == entity_kinds() else f"(Ego&({_label(kinds.ego)}))"
    if kinds.ego >= kinds.other & entity_kinds():
        return f"{label}|{of_ego}"
    return f"(({label})&!Ego)|{of_ego}"


def kind_label(kind: str) -> str:
    """Return the label for one kind of node, such as ``Car``."""
    return _label(frozenset({kind}))


def _label(kinds: frozenset[str]) -> str:
    if kinds == frozenset(KINDS):
        return "%"
    groups = {name: frozenset(of) for name, of in SUPER_KINDS.items()}
    whole = [name for name, of in groups.items() if of <= kinds and len(of) > 1]
    whole = [n for n in whole if not any(groups[n] < groups[other] for other in whole)]
    rest = kinds.difference(*(groups[name] for name in whole))
    names = [*whole]
    if "vehicle" in rest:  # as a label it means all vehicle kinds
        others = groups["vehicle"] - rest
        names.append(f"(Vehicle&!({'|'.join(_camel(k) for k in KINDS if k in others)}))")
        rest -= groups["vehicle"]
    return "|".join(_camel(name) for name in [*names, *(kind for kind in KINDS if kind in rest)])


def _camel(name: str) -> str:
    if not name.replace("_", "").isalnum() or not name.islower():
        return name
    return "".join(part.capitalize() for part in name.split("_"))


class Writer:
    """Writer of a graph pattern as query text. Nodes without a name get one.

    Parameters
    ----------
    scope : Scope
        Scope of the whole pattern.
    calls : mapping of Bound to str, optional
        Texts of conditions, for the calls of predicates.
    """

    def __init__(self, scope: b.Scope, calls: b.Calls | None = None) -> None:
        self.calls: b.Calls = calls or {}
        self._names: dict[str, str] = {}
        self._spoken_of: set[str] = set()
        named: list[str] = []
        for inner in _scopes(scope):
            named += [key for key in inner.nodes if not key.startswith("#")]
            named += [edge.key for edge in inner.edges if edge.named]
            self._spoken_of |= _edges_spoken_of(inner)
        self._taken = {*named, "ego", "env", "frame", "trace"}
        for key in named:  # different blocks may use the same name
            self._names[key] = key if "~" not in key else self._free(key.split("~")[0])

    def expanded(self) -> Writer:
        """Return a writer with the same names. It writes the definition of a predicate, not the call."""
        other = copy(self)
        other.calls = {}
        return other

    def _free(self, base: str) -> str:
        name, number = base, 2
        while name in self._taken:
            name, number = f"{base}{number}", number + 1
        self._taken.add(name)
        return name

    def name(self, key: str, kinds: b.Kinds | None = None) -> str:
        """Return the name of a node or edge in the query text. Without a name, it gets an unused one."""
        if key not in self._names:
            every = kinds.every if kinds else frozenset[str]()
            self._names[key] = self._free(next(iter(every)) if len(every) == 1 else "any")
        return self._names[key]

    # Patterns

    def node(self, key: str, kinds: b.Kinds) -> str:
        """Return a pattern node as query text, such as ``(lane:Lane)``."""
        label = label_written(kinds)
        return f"({self.name(key, kinds)}{':' if label else ''}{label})"

    def edge(self, edge: b.Edge, scope: b.Scope) -> str:
        """Return a pattern edge as query text, such as ``(e)-[:isIn]->(lane)``. Its nodes have no labels."""
        ends = (f"({self.name(key, scope.kinds(key))})" for key in (edge.src, edge.dst))
        return self._arrow(edge).join(ends)

    def labelled_edge(self, edge: b.Edge, scope: b.Scope) -> str:
        """Return a pattern edge as query text. Its nodes have labels."""
        ends = (self.node(key, scope.kinds(key)) for key in (edge.src, edge.dst))
        return self._arrow(edge).join(ends)

    def _arrow(self, edge: b.Edge) -> str:
        some = [relation for relation in RELATIONS if relation in edge.relations]
        label = "" if edge.relations == b.any_relation() else ":" + "|".join(some)
        times = "" if edge.high == 1 else f"*{edge.low}..{edge.high}"
        name = self.edge_name(edge.key) if edge.named or edge.key in self._spoken_of else ""
        return f"-[{name}{label or (':%' if times else '')}{times}]{'-' if edge.both else '->'}"

    def edge_name(self, key: str) -> str:
        """Return the name of an edge in the query text. Without a name, it gets an unused one."""
        if key not in self._names:
            self._names[key] = self._free("edge")
        return self._names[key]

    def block(self, scope: b.Scope) -> str:
        """Return the query text inside the braces of ``EXISTS {…}`` or similar."""
        tests = [one for one in scope.where if isinstance(one, b.LabelTest)]
        paths = [self.node(test.node, test.kinds) for test in tests]
        said = {test.node for test in tests}.union(*((e.src, e.dst) for e in scope.edges))
        # The own nodes differ from the outer nodes that the block uses.
        paths += [f"({self.name(key)})" for key in sorted(set(scope.outer) - said)]
        paths += [self.node(key, node.kinds) for key, node in scope.nodes.items()]
        paths += [self.edge(edge, scope) for edge in scope.edges]
        where = [self.expression(one, inner=True) for one in scope.where if one not in tests]
        return ", ".join(paths) + (f" WHERE {' AND '.join(where)}" if where else "")

    # Expressions

    def expression(self, value: b.Bound, *, inner: bool = False) -> str:
        """Return an expression as query text.

        ``inner`` adds brackets where neighbouring operators need them.
        """
        if self.calls and value in self.calls:
            return self.calls[value]
        match value:
            case b.Value():
                return _constant(value, inner=inner)
            case b.Choices(items=items):
                return "[" + ", ".join(_constant(item, inner=False) for item in items) + "]"
            case b.Operation():
                return self._operation(value, inner=inner)
            case b.BlockValue(word=word, scope=scope, value=told):
                told_text = "" if told is None else f" | {self.expression(told)}"
                return f"{word} {{{self.block(scope)}{told_text}}}"
            case _:
                return self._leaf(value)

    def _leaf(self, value: b.Bound) -> str:
        match value:
            case b.NodeValue(node=node):
                text = self.name(node)
            case b.LabelTest(node=node, kinds=kinds):
                text = f"EXISTS {{{self.node(node, kinds)}}}"
            case b.NodeAttribute(node=node, attribute=attribute):
                text = f"{self.name(node)}.{attribute.name}"
            case b.EdgeAttribute(edge=edge, attribute=attribute):
                text = f"{self.edge_name(edge)}.{attribute.name}"
            case b.EdgeRelation(edge=edge):
                text = f"type({self.edge_name(edge)})"
            case b.PairNumber(function=function, a=one, b=other):
                text = as_written(function, self.name(one), self.name(other))
            case b.Happened(kind=kind, nodes=nodes):
                text = f"HAPPENS {kind}({', '.join(map(self.name, nodes))})"
            case b.TraceAttribute(attribute=attribute):
                text = f"trace.{attribute.name}"
            case b.FrameAttribute():
                text = _of_frame(value)
            case _:
                text = repr(value)
        return text

    def _operation(self, operation: b.Operation, *, inner: bool) -> str:
        word, operands = operation.word, operation.operands
        if word in ROUNDINGS:
            return self.expression(operands[0], inner=inner)
        if word == "IS NOT NULL" and isinstance(operands[0], b.NodeValue):
            return f"known({self.expression(operands[0])})"
        if word == "case":
            *pairs, last = (self.expression(operand) for operand in operands)
            cases = zip(pairs[::2], pairs[1::2], strict=True)
            told = " ".join(f"WHEN {condition} THEN {value}" for condition, value in cases)
            return f"CASE {told} ELSE {last} END"
        if word not in INFIX and word not in {"IS NULL", "IS NOT NULL", "NOT", "negative"}:
            return f"{word}({', '.join(self.expression(operand) for operand in operands)})"
        parts = [self.expression(operand, inner=True) for operand in operands]
        if word in INFIX:
            text = f" {word} ".join(parts)
        elif word in {"NOT", "negative"}:
            text = f"{'NOT ' if word == 'NOT' else '-'}{parts[0]}"
        else:
            text = f"{parts[0]} {word}"
        return f"({text})" if inner else text


def joined_calls(where: Sequence[b.Bound], calls: b.Calls) -> Iterator[b.Bound]:
    """Yield the conditions of a pattern. Those that come from one predicate call are joined again."""
    joined = {parts: call for call in calls if len(parts := tuple(b.conjuncts(call))) > 1}
    at = 0
    while at < len(where):
        fits = (parts for parts in joined if tuple(where[at : at + len(parts)]) == parts)
        parts = next(fits, None)
        yield where[at] if parts is None else joined[parts]
        at += 1 if parts is None else len(parts)


def pattern_text(scope: b.Scope) -> str:
    """Return the query text of a pattern, as after ``MATCH``."""
    return Writer(scope).block(scope)


def in_words(value: b.Bound) -> b.Bound:
    """Return an expression in which the query's text replaces each pattern in braces.

    In scope ``world``, several patterns stand for one of the query.
    """
    blocks = b.blocks_of(value)
    alone = all(isinstance(part, b.Operation | b.BlockValue) for part in b.walk(value))
    sources = {block.source for block in blocks} if alone else set()
    if len(sources) == 1 and (source := sources.pop()) is not None:
        return b.GroupKey(source[0], value.type)
    if not isinstance(value, b.BlockValue):
        return b.with_operands(value, in_words)
    place = TextSpan(0, 0)
    nodes = {key: b.Node(key, kinds, "named", place) for key, kinds in value.scope.outer.items()}
    text = Writer(b.Scope(nodes, {}, (), (value,), frozenset())).expression(value)
    return b.GroupKey(text, value.type)


def _constant(value: b.Value, *, inner: bool) -> str:
    constant = value.shown
    if constant is None:
        return "NULL"
    if isinstance(constant, bool):
        return str(constant).upper()
    if isinstance(constant, str):
        return text_written(constant)
    return f"({constant!r})" if inner and constant < 0 else repr(constant)


def _of_frame(value: b.FrameAttribute) -> str:
    attribute = value.attribute
    (abstraction,) = attribute.columns.values() if attribute.columns else ("",)
    match attribute.unit:
        case DisplayUnit.seen:
            dataset = attribute.name.removeprefix(f"class_{abstraction} in ")
            classes = f"frame.class('{abstraction}')"
            return f"{classes} IN dataset_classes({text_written(dataset)})"
        case DisplayUnit.counted:
            return f"class_count('{abstraction}')"
        case DisplayUnit.classed if attribute is not FRAME_ATTRIBUTES["class"]:
            return f"frame.class('{abstraction}')"
        case _:
            return attribute.name if attribute.of_store else f"frame.{attribute.name}"


def _scopes(scope: b.Scope) -> Iterator[b.Scope]:
    yield scope
    for block in _blocks(scope.where):
        yield from _scopes(block.scope)


def _blocks(conditions: Iterable[b.Bound]) -> Iterator[b.BlockValue]:
    for condition in conditions:
        for block in b.blocks_of(condition):
            yield block
            if block.value is not None:
                yield from _blocks([block.value])


def _edges_spoken_of(scope: b.Scope) -> set[str]:
    values = [*scope.where, *(block.value for block in _blocks(scope.where) if block.value)]
    return {edge for value in values for edge in b.edges_of(value)}
