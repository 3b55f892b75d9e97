"""Binder of graph patterns: resolves nodes, edges, labels and patterns in braces."""

from __future__ import annotations

from typing import Final

from sgstore.errors import TextSpan
from sgstore.lang import ir as b
from sgstore.lang.bind._expressions import BINDERS, edge_attribute, node_attribute
from sgstore.lang.bind._functions import call
from sgstore.lang.bind._match_values import over_match
from sgstore.lang.bind._possible import check_edges
from sgstore.lang.bind._recorded_events import happens
from sgstore.lang.bind._stages import name_path
from sgstore.lang.bind._symbols import (
    RESERVED,
    THE_EGO,
    Binders,
    Session,
    Symbol,
    SymbolTable,
    call_hint,
)
from sgstore.lang.bind._temporal import refuse_window, tense, timespan
from sgstore.lang.bind._topics import topic_field
from sgstore.lang.bind._world_scope import whole_block
from sgstore.lang.catalog import Type
from sgstore.lang.syntax import hint_at, said_of
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import (
    RELATION_ALIASES,
    entity_kinds,
    kinds_labelled,
    known_names,
    labels,
    normalize_name,
    relation_named,
)


def bind_block(block: s.Block, names: SymbolTable) -> None:
    """Resolve the names in the paths and the condition of a pattern, and add both to the current pattern.

    All nodes and edges are bound before any condition. So a condition inside a node can use later nodes.
    """
    the_ego = names.session.checks and not _asks_for_a_node(block)
    pending: list[tuple[s.NodePattern | s.EdgePattern, str]] = []
    joined: list[tuple[s.EdgePattern, s.NodePattern, s.NodePattern, str]] = []
    for path in block.paths:
        keys = [_node(node, names, the_ego=the_ego) for node in path.nodes]
        pending += zip(path.nodes, keys, strict=True)
        edges = [
            (edge, _edge(edge, left, right, names))
            for edge, left, right in zip(path.edges, keys, keys[1:], strict=False)
        ]
        pending += edges
        joined += [
            (edge, left, right, key)
            for (edge, key), left, right in zip(edges, path.nodes, path.nodes[1:], strict=False)
        ]
        if path.name is not None:
            name_path(path, keys, [key for _, key in edges], names)
    check_edges(joined, names)
    for pattern, key in pending:
        _inline(pattern, key, names)
    if block.where is not None:
        names.scope.where += b.conjuncts(names.condition(block.where))


def _asks_for_a_node(block: s.Block) -> bool:
    """True if a pattern is a single node without conditions, such as ``(:Ego)``."""
    (node, *others) = [node for path in block.paths for node in path.nodes]
    return not (others or node.properties or node.where or block.where)


def _block(e: s.BlockExpression, names: SymbolTable) -> b.Bound:
    session, inner = names.session, names.block()
    bind_block(e.block, inner)
    value = inner.number(e.value) if e.value is not None else None
    kind = Type.boolean if e.word == "EXISTS" else Type.number
    session.blocks += 1
    text = " ".join(session.text[e.span.start : e.span.end].split())
    source = None if session.calls or session.shipped else (text, e.span.start)
    block = b.BlockValue(e.word, inner.scope.finished(), value, kind, session.blocks, source)
    found = whole_block(block, session.blocks + 1)
    session.blocks += sum(isinstance(part, b.BlockValue) for part in b.walk(found)) - 1
    return found


ALL_BINDERS: Final[Binders] = {
    **BINDERS,
    s.BlockExpression: _block,
    s.Call: call,
    s.Duration: timespan,
    s.HappensExpression: happens,
    s.OverExpression: over_match,
    s.Temporal: tense,
    s.TopicExpression: topic_field,
    s.FrameWindow: refuse_window,
}
"""Binder of each kind of expression."""


def _node(node: s.NodePattern, names: SymbolTable, *, the_ego: bool = False) -> str:
    """Return the key of a node; add a new node to the pattern. ``the_ego``: label ``Ego`` means key ``ego``."""
    kinds = kinds_of(node.label, names.session) if node.label else b.any_kinds()
    if not kinds:
        names.session.refuse("no node can have this label", node.span)
    key = _known_node(node, names)
    if key is None and the_ego and not kinds.other:
        key = names.node(THE_EGO, node.span)
        if node.name is not None:
            names.meanings[node.name] = Symbol(node=key)
    if key is None:
        _refuse_bare_label(node, names)
        key = names.scope.add(node.name, kinds, node.span, named=node.name is not None)
        if node.name is not None:
            names.meanings[node.name] = Symbol(node=key)
        return key
    if node.label:
        names.scope.narrow(key, kinds)
        if not names.scope.kinds(key):
            names.session.refuse(f"'{node.name}' has two labels that exclude each other", node.span)
        if key in names.scope.outer:
            names.scope.where.append(b.LabelTest(key, kinds))
    return key


def _refuse_bare_label(node: s.NodePattern, names: SymbolTable) -> None:
    """Raise an error for ``(Car)`` or ``(EGO)``. The user probably means ``(:Car)`` or ``(ego)``."""
    if node.name and node.name.lower() == THE_EGO and not node.label:
        names.session.refuse(
            f"({node.name}) matches any node and names it {node.name}",
            node.name_span,
            "write the ego as (ego), or as a label: (e:Ego)",
        )
    if node.name and node.name[0].isupper() and not node.label and node.name in labels():
        names.session.refuse(
            f"({node.name}) matches any node and names it {node.name}",
            node.name_span,
            f"write a label after a colon: (:{node.name})",
        )


def _known_node(node: s.NodePattern, names: SymbolTable) -> str | None:
    """Return the key of a pattern node if an earlier part of the query defines its name; otherwise None."""
    if node.name is None:
        return None
    if node.name in RESERVED:
        names.session.refuse(f"'{node.name}' cannot name a node", node.name_span)
    meaning = names.meaning(node.name)
    if meaning is None:
        return _the_ego(node, names)
    if meaning.node is None:
        names.session.refuse(f"'{node.name}' is not a node", node.name_span)
    names.scope.mention(meaning.node)
    return meaning.node


def _the_ego(node: s.NodePattern, names: SymbolTable) -> str | None:
    """If a node is named ``ego``, add the ego to the pattern, and return its key; otherwise None."""
    if node.name != THE_EGO:
        return None
    if names.scope.parent is None:
        key = names.scope.add(THE_EGO, b.ego_kinds(), node.span, named=True)
        names.session.the_ego = key
        names.meanings[THE_EGO] = Symbol(node=key)
        return key
    return names.node(THE_EGO, node.name_span)


def _edge(edge: s.EdgePattern, left: str, right: str, names: SymbolTable) -> str:
    session = names.session
    if edge.name is not None and names.meaning(edge.name) is not None:
        session.refuse(f"'{edge.name}' is bound already", edge.span)
    if edge.name is not None and edge.low is not None:
        session.refuse(
            "a repeated edge cannot have a name", edge.span, "-[:near*1..3]->, or edge by edge"
        )
    if edge.name is not None and not edge.label and relation_named(edge.name):
        session.refuse(
            f"-[{edge.name}]-> matches an edge of any relation and names it {edge.name}",
            edge.span,
            f"write a relation after a colon: -[:{edge.name}]->",
        )
    relations = _relations(edge.label, session) if edge.label else b.any_relation()
    if not relations:
        session.refuse(
            "no edge can have this label: an edge has one relation",
            edge.span,
            "two edges: (a)-[:near]->(b), (a)-[:visible]->(b)",
        )
    key = session.key(edge.name)
    src, dst = (right, left) if edge.direction == "left" else (left, right)
    low, high = edge.low or 1, edge.high or 1
    if edge.name is not None:
        names.meanings[edge.name] = Symbol(edge=key)
    names.scope.edges.append(
        b.Edge(
            key,
            src,
            dst,
            relations,
            edge.direction == "any",
            low,
            high,
            edge.name is not None,
            edge.span,
            known=names.scope.parent is not None,
            beyond=session.beyond if names.scope.parent is not None else (),
            online=session.online and names.scope.parent is not None,
        )
    )
    return key


def _inline(pattern: s.NodePattern | s.EdgePattern, key: str, names: SymbolTable) -> None:
    """Add the properties and the condition inside a node or edge to the conditions of the pattern."""
    for prop in pattern.properties:
        attribute_of = node_attribute if isinstance(pattern, s.NodePattern) else edge_attribute
        attribute = attribute_of(key, prop.name, prop.name_span, names)
        names.scope.where.append(_equality(attribute, prop, names))
    if pattern.where is not None:
        names.scope.where += b.conjuncts(names.condition(pattern.where))


def _equality(attribute: b.Bound, prop: s.Property, names: SymbolTable) -> b.Bound:
    """Return the condition ``attribute = value`` for a property ``name: value``, with names resolved.

    The attribute gets an internal name that queries cannot use.
    """
    inner = names.body({"": Symbol(value=attribute)})
    inner.parent = names
    span = TextSpan(prop.name_span.start, prop.value.span.end)
    return inner.condition(s.Comparison("=", s.Variable("", prop.name_span), prop.value, span))


def kinds_of(label: s.LabelExpression, session: Session) -> b.Kinds:
    """Return the kinds of node that a label expression such as ``Car|Truck`` allows.

    Raises
    ------
    QueryNameError
        Unknown label.
    """
    if isinstance(label, s.Label):
        return _labelled(label, session)
    operands = [kinds_of(operand, session) for operand in label.operands]
    result = operands[0]
    for operand in operands[1:]:
        result = result & operand if label.word == "&" else result | operand
    return ~result if label.word == "!" else result


def _labelled(label: s.Label, session: Session) -> b.Kinds:
    if label.name == "%":
        return b.any_kinds()
    if normalize_name(label.name) == "ego":
        return b.ego_kinds()
    kinds = kinds_labelled(label.name)
    if kinds is None:
        if relation_named(label.name):
            session.refuse(
                f"'{label.name}' is a relation, not a label",
                label.span,
                f"write -[:{label.name}]->",
            )
        session.unknown("label", label.name, label.span, labels(), said_of("labels", label.name))
    every = frozenset(kinds)
    return b.Kinds(every & entity_kinds(), every)


def _relations(label: s.LabelExpression, session: Session) -> frozenset[str]:
    if isinstance(label, s.Label):
        return _related(label, session)
    operands = [_relations(operand, session) for operand in label.operands]
    result = operands[0]
    for operand in operands[1:]:
        result = result & operand if label.word == "&" else result | operand
    return b.any_relation() - result if label.word == "!" else result


def _related(label: s.Label, session: Session) -> frozenset[str]:
    if label.name == "%":
        return b.any_relation()
    relation = relation_named(label.name)
    if relation is None:
        if kinds_labelled(label.name):
            session.refuse(
                f"'{label.name}' is a label of nodes, not a relation",
                label.span,
                f"write (x:{label.name})",
            )
        known = (*known_names("relation"), *RELATION_ALIASES)
        said = said_of("relations", label.name)
        if (called := call_hint(label.name)) is not None:
            said = f"{called}; {said or hint_at(label.name, known)}"
        session.unknown("relation", label.name, label.span, known, said)
    session.relations.add(relation)
    return frozenset({relation})
