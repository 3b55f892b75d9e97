"""Splitting of a graph pattern into independent parts. Each part becomes a query.

The split follows from logic: "there is an x such that A and B" can be split if only one of A and B uses x.
Given nodes are constants, so conditions on given nodes are separate parts. Conditions and edges that share a
node that is not given, or a bound edge, stay together. So do nodes that must differ. A frame matches exactly
if all parts hold in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryNameError
from sgstore.lang import ir as b
from sgstore.lang.catalog import NODE_ATTRIBUTES, Type
from sgstore.lang.help._pattern_text import Writer, in_words, joined_calls, label_written
from sgstore.lang.sql import value_text
from sgstore.model.vocabulary import RELATIONS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence


@dataclass(frozen=True, slots=True)
class DrawnEdge:
    """Pattern edge for a drawing: its two nodes, its label, and True if it is undirected."""

    src: str
    dst: str
    label: str
    both: bool


@dataclass(frozen=True, slots=True)
class PatternPart:
    """Part of a graph pattern. It shares no variable with other parts, except nodes with a given id.

    Attributes
    ----------
    text : str
        Text in the query language, with calls of predicates as written.
    step : int
        Number of the step in a sequence, from 1; 0 for a single-frame pattern.
    query : Query
        Query for the frames in which the part holds for the given nodes; not rewritten.
    nodes : mapping of str to str
        Labels of the nodes of the part, by key.
    edges : tuple of DrawnEdge
    conditions : tuple of str
        Conditions as written.
    meanings : tuple of str
        The same conditions without calls of predicates.
    call : str
        Call of the predicate whose definition this part is from; empty if the part is written in the query.
    tests : tuple of Bound
        The same conditions as expressions.
    """

    text: str
    step: int
    query: b.Query
    nodes: Mapping[str, str]
    edges: tuple[DrawnEdge, ...]
    conditions: tuple[str, ...]
    meanings: tuple[str, ...]
    call: str = ""
    tests: tuple[b.Bound, ...] = ()


_Atom = b.Edge | b.Node | b.Bound


def parts_of(query: b.Query, given: Mapping[str, Collection[int]]) -> Iterator[PatternPart]:
    """Yield the independent parts of a query's patterns, step by step. ``given`` fixes nodes to ids.

    Parameters
    ----------
    query : Query
        Query from the binder.
    given : mapping of str to collection of int
        Allowed node ids of some variables; one each, unless :func:`separable`. For other variables, at least
        one node must exist.

    Raises
    ------
    QueryNameError
        Unknown variable.
    """
    keys = _keys_of(query)
    for name in given:
        if name.lower() not in keys:
            known = ", ".join(key for key in keys.values() if not key.startswith("#"))
            raise QueryNameError(f"the pattern has no node '{name}'", hint=f"it has: {known}")
    pins = {keys[name.lower()]: numbers for name, numbers in given.items()}
    if query.stages:
        pins = {key: numbers for key, numbers in pins.items() if key in query.first.nodes}
    if not query.steps:
        yield from _parts(query, query.first, (), pins, 0, None)
    for number, step in enumerate(query.steps, start=1):
        yield from _parts(query, step.scope, step.when, pins, number, step)


def separable(query: b.Query, names: Iterable[str]) -> bool:
    """True if no other node of the patterns must differ from the named nodes."""
    keys = {key for key in _keys_of(query).values() if key.lower() in {n.lower() for n in names}}
    scopes = [query.first, *(step.scope for step in query.steps)]
    pairs = (
        (scope, pair) for scope in scopes for pair in scope.distinct if len(keys & {*pair}) == 1
    )
    return not any((scope.kinds(one) & scope.kinds(other)) for scope, (one, other) in pairs)


def has_nodes(query: b.Query, names: Iterable[str]) -> bool:
    """True if the pattern of a query has a node for each given name."""
    return {name.lower() for name in names} <= _keys_of(query).keys()


def _keys_of(query: b.Query) -> dict[str, str]:
    scopes = [query.scope, *query.patterns]
    return {key.lower(): key for scope in scopes for key in scope.nodes}


def _parts(
    query: b.Query,
    scope: b.Scope,
    when: tuple[b.Bound, ...],
    pins: Mapping[str, Collection[int]],
    number: int,
    step: b.BoundStep | None,
) -> Iterator[PatternPart]:
    writer = Writer(scope, query.calls)
    for atoms in _groups(scope, when, pins):
        keys = _spoken_of(atoms, scope)
        part = _narrowed(scope, atoms, keys, pins, when)
        later = tuple(one for one in when if any(atom is one for atom in atoms))
        relations = query.relations & _relations([*part.edges], [*part.where, *later])
        asked = replace(
            query,
            scope=part,
            result=b.Result(),
            relations=relations,
            steps=(),
            links=(),
            stages=(),
        )
        if later and step is not None:
            alone = replace(step, scope=part, when=later, hold=None, absent=False)
            kept = {key: node for key, node in part.nodes.items() if node.role == "named"}
            seen = replace(part, nodes=kept, edges=(), where=(), distinct=frozenset())
            asked = replace(asked, scope=seen, steps=(alone,))
        yield _told(atoms, scope, keys, writer, number, asked)


def _told(
    atoms: Sequence[_Atom],
    scope: b.Scope,
    keys: Sequence[str],
    writer: Writer,
    number: int,
    query: b.Query,
) -> PatternPart:
    edges = [atom for atom in atoms if isinstance(atom, b.Edge)]
    conditions = [atom for atom in atoms if not isinstance(atom, b.Edge | b.Node)]
    whole = list(joined_calls(conditions, writer.calls))
    tests = [_written(one, writer) for one in whole]
    meanings = tuple(_written(one, writer.expanded()) for one in whole)
    alone = len(conditions) == len(atoms)
    call = _call_of(whole, scope, writer.calls) if alone else ""
    paths = [writer.node(atom.key, atom.kinds) for atom in atoms if isinstance(atom, b.Node)]
    paths += [writer.edge(edge, scope) for edge in edges]
    text = ", ".join(paths)
    text += (" WHERE " if paths and tests else "") + " AND ".join(tests)
    labels = {writer.name(key, scope.kinds(key)): label_written(scope.kinds(key)) for key in keys}
    drawn = tuple(
        DrawnEdge(writer.name(edge.src), writer.name(edge.dst), _label(edge), edge.both)
        for edge in edges
    )
    return PatternPart(
        text, number, query, labels, drawn, tuple(tests), meanings, call, tuple(whole)
    )


def _written(condition: b.Bound, writer: Writer) -> str:
    if not b.is_temporal(condition):
        return writer.expression(condition)

    def called(value: b.Bound) -> b.Bound:
        text = writer.calls.get(value)
        return b.with_operands(value, called) if text is None else b.GroupKey(text, value.type)

    return value_text(in_words(called(condition)))


def _call_of(conditions: Sequence[b.Bound], scope: b.Scope, calls: b.Calls) -> str:
    """Return the call of a predicate whose definition has these conditions and more; else an empty text."""
    for call, text in calls.items():
        parts = b.conjuncts(call)
        inside = len(parts) > len(conditions) and all(one in parts for one in conditions)
        if inside and call in joined_calls(scope.where, calls):
            return text
    return ""


def _label(edge: b.Edge) -> str:
    some = [relation for relation in RELATIONS if relation in edge.relations]
    label = "any" if edge.relations == b.any_relation() else "|".join(some)
    return label if edge.high == 1 else f"{label}*{edge.low}..{edge.high}"


def _groups(
    scope: b.Scope, when: tuple[b.Bound, ...], pins: Mapping[str, Collection[int]]
) -> Iterator[list[_Atom]]:
    """Yield groups of nodes, edges and conditions that share variables, in reading order.

    A variable is free if its node is not fixed.
    """
    conditions = [part for one in scope.where for part in b.conjuncts(one)]
    atoms: list[_Atom] = [*scope.edges, *conditions, *when]
    said = {key for atom in atoms for key in _nodes(atom)}
    atoms = [*(n for key, n in scope.nodes.items() if key not in said), *atoms]
    asked = {key for atom in (*conditions, *when) for key in b.edges_of(atom)}
    ties = [_ties(atom, pins, asked) for atom in atoms]
    for one, other in _apart(scope, pins):
        ties.append({f"node {one}", f"node {other}"})
    roots: dict[str, str] = {}

    def root(tie: str) -> str:
        while roots.setdefault(tie, tie) != tie:
            tie = roots[tie]
        return tie

    for together in ties:
        first, *others = sorted(together) or [""]
        for other in others:
            roots[root(other)] = root(first)
    groups: dict[object, list[_Atom]] = {}
    for place, atom in enumerate(atoms):
        name = root(min(ties[place])) if ties[place] else place
        groups.setdefault(name, []).append(atom)
    yield from groups.values()


def _ties(atom: _Atom, pins: Mapping[str, Collection[int]], asked: set[str]) -> set[str]:
    """Return the variables of a node, edge or condition: nodes without a given id, and named edges."""
    ties = {f"node {key}" for key in _nodes(atom) if key not in pins}
    if isinstance(atom, b.Edge):
        return ties | ({f"edge {atom.key}"} if atom.named or atom.key in asked else set())
    if isinstance(atom, b.Node):
        return ties
    return ties | {f"edge {key}" for key in b.edges_of(atom)}


def _apart(scope: b.Scope, pins: Mapping[str, Collection[int]]) -> Iterator[tuple[str, str]]:
    """Yield the pairs of nodes that must differ. Both have no given id, and can be of the same kind."""
    for one, other in scope.distinct:
        if one not in pins and other not in pins and (scope.kinds(one) & scope.kinds(other)):
            yield one, other


def _nodes(atom: _Atom) -> frozenset[str]:
    match atom:
        case b.Node(key=key):
            return frozenset({key})
        case b.Edge(src=src, dst=dst):
            return frozenset({src, dst})
        case _:
            return b.nodes_of(atom)


def _spoken_of(atoms: Iterable[_Atom], scope: b.Scope) -> list[str]:
    """Return the keys of the nodes that some nodes, edges and conditions use, in pattern order.

    Without such nodes, return one key.
    """
    found = {key for atom in atoms for key in _nodes(atom)}
    keys = [key for key in scope.nodes if key in found]
    anyone = sorted(scope.nodes, key=lambda key: bool(scope.nodes[key].kinds.other))
    return keys or anyone[:1]


def _narrowed(
    scope: b.Scope,
    atoms: Sequence[_Atom],
    keys: Sequence[str],
    pins: Mapping[str, Collection[int]],
    when: tuple[b.Bound, ...],
) -> b.Scope:
    """Return a pattern with only the given nodes, edges and conditions.

    Given nodes are fixed to their ids.
    """
    edges = tuple(atom for atom in atoms if isinstance(atom, b.Edge))
    where = [
        atom
        for atom in atoms
        if not isinstance(atom, b.Edge | b.Node) and not any(atom is one for one in when)
    ]
    where += [b.node_among(key, pins[key]) for key in keys if key in pins]
    for pair in sorted(scope.distinct):
        for one, other in (pair, pair[::-1]):
            free = one in keys and one not in pins and other in pins and other not in keys
            if free and scope.kinds(one) & scope.kinds(other):
                of = b.NodeAttribute(one, _ID, Type.number)
                (number,) = pins[other]
                value = b.Value(number, Type.number)
                where.append(b.Operation("<>", (of, value), Type.boolean))
    nodes = {key: scope.nodes[key] for key in keys}
    distinct = frozenset(pair for pair in scope.distinct if {*pair} <= {*keys})
    return b.Scope(nodes, {}, edges, tuple(where), distinct)


_ID: Final = NODE_ATTRIBUTES["id"]


def _relations(edges: list[b.Edge], conditions: list[b.Bound]) -> frozenset[str]:
    """Return the names of all relations of some edges, and of the edges in braces in some conditions."""
    found = frozenset[str]().union(*(edge.relations for edge in edges))
    for condition in conditions:
        for block in b.blocks_of(condition):
            found |= _relations([*block.scope.edges], [*block.inside])
    return found
