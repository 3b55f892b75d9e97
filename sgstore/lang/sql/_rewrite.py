"""Rules that rewrite a query into an equal, but faster query.

Each rule converts a scope to a scope. Its docstring explains the change and why the meaning stays the same.
No rule can fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, Any, Final, TypeGuard

from sgstore.lang.bind import Profile, entities_of_pairs
from sgstore.lang.catalog import (
    COMPUTED,
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    Catalog,
    DisplayUnit,
    Triple,
    Type,
)
from sgstore.lang.ir import (
    Aggregate,
    BlockValue,
    Bound,
    Choices,
    Edge,
    EdgeRelation,
    FrameAttribute,
    Kinds,
    LabelTest,
    MatchStage,
    Node,
    NodeAttribute,
    NodeValue,
    Operation,
    PairNumber,
    PathWay,
    Query,
    Result,
    ReturnColumn,
    Scope,
    Stage,
    TraceAttribute,
    Value,
    all_of,
    any_kinds,
    conjuncts,
    ego_kinds,
    is_one_of,
    nodes_of,
    same_chain,
    walk,
    with_operands,
)
from sgstore.lang.operators import MIRRORED
from sgstore.lang.sql._expressions import is_constant, leaves
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from sgstore.lang.sql._expressions import Leaf


FALSE: Final = Value(value=False, type=Type.boolean)
TRUE: Final = Value(value=True, type=Type.boolean)
_OPPOSITE: Final = {"=": "<>", "<>": "=", "<": ">=", ">=": "<", ">": "<=", "<=": ">"} | {
    "IS NULL": "IS NOT NULL",
    "IS NOT NULL": "IS NULL",
}


def rewritten(query: Query, catalog: Catalog) -> Query:
    """Apply all rewriting rules: return an equal query that runs faster."""
    if query.stages:
        return _staged(query, catalog)
    # Not for stages: a node of OPTIONAL MATCH lacks every value where it is absent.
    query = _in_scopes(values_lacking, query, catalog)
    query = _ruled(query, catalog)
    query = replace(query, result=query.result.changed(_attributes))
    return count_by_buckets(query, catalog)


def _ruled(query: Query, catalog: Catalog) -> Query:
    unfold = partial(unfold_paths, injective=query.injective)
    for rule in (
        nothing_beyond,
        computed_or_imported,
        push_negations,
        counts_to_existence,
        unfold,
        labels_from_conditions,
        open_exists,
        labels_from_conditions,
        labels_to_conditions,
        entities_of_pairs,
        narrowed,
        ordered,
    ):
        query = _in_scopes(rule, query, catalog)
    return query


def _staged(query: Query, catalog: Catalog) -> Query:
    """Apply all rewriting rules to a query with several clauses (``MATCH``, ``WITH``).

    The rules apply to each clause.

    Nodes are limited to the kinds that the patterns allow. A node that may be absent is looked up by its id.
    This includes the ego: even if the frame has an ego, the pattern may not bind it.
    """
    nothing = Scope({}, {}, (), (), frozenset())
    kinds: dict[str, Kinds] = {}

    def values(result: Result) -> Result:
        ruled = _ruled(replace(query, scope=nothing, result=result, stages=()), catalog)
        return ruled.result.changed(_attributes)

    def told(scope: Scope) -> Scope:
        nodes = {k: replace(n, kinds=kinds.get(k, n.kinds)) for k, n in scope.nodes.items()}
        return replace(scope, nodes=nodes)

    stages: list[Stage] = []
    for stage in query.stages:
        if isinstance(stage, MatchStage):
            ways: list[PathWay] = []
            for way in path_ways(stage, injective=query.injective):
                alone = replace(query, scope=way.scope, result=Result(), stages=())
                ways.append(replace(way, scope=_ruled(alone, catalog).scope))
            own = _kinds_in([way.scope for way in ways])
            if stage.optional:
                own = {key: Kinds(one.ego, one.every) for key, one in own.items()}
            kinds |= own
            scope = next((w.scope for w in ways if w.scope.where != (FALSE,)), ways[0].scope)
            stages.append(replace(stage, scope=scope, ways=tuple(ways)))
            continue
        kinds |= {new: kinds[key] for new, key in stage.nodes}
        result = Result(columns=stage.values)
        order = tuple(replace(k, value=_expression(k.value, values)) for k in stage.order)
        where = tuple(_expression(one, values) for one in stage.where)
        stages.append(
            replace(
                stage,
                before=told(stage.before),
                after=told(stage.after),
                values=values(result).columns,
                order=order,
                where=where,
            )
        )
    scope = told(query.scope)
    return replace(query, scope=scope, result=values(query.result), stages=tuple(stages))


def path_ways(stage: MatchStage, *, injective: bool) -> Iterator[PathWay]:
    """Yield patterns of a ``MATCH`` clause in which each named path has a fixed length."""
    edges = {edge.key: edge for edge in stage.scope.edges}
    repeated = [edges[key] for path in stage.paths for key, _ in path.edges if edges[key].high > 1]
    for lengths in product(*(range(edge.low, edge.high + 1) for edge in repeated)):
        scope, stops = stage.scope, dict[str, list[str]]()
        for edge, length in zip(repeated, lengths, strict=True):
            scope = chain(scope, edge, length, injective=injective)
            stops[edge.key] = [f"#{edge.key}.{number}" for number in range(1, length)]
        nodes: list[tuple[str, ...]] = []
        for path in stage.paths:
            keys = [path.nodes[0]]
            for (key, backwards), node in zip(path.edges, path.nodes[1:], strict=True):
                between = stops.get(key, [])
                keys += [*(reversed(between) if backwards else between), node]
            nodes.append(tuple(keys))
        yield PathWay(scope, tuple(nodes))


def _kinds_in(scopes: Iterable[Scope]) -> dict[str, Kinds]:
    """Return, for each node, the kinds that are possible in at least one of several patterns."""
    every = list(scopes)
    found: dict[str, Kinds] = {}
    for scope in [one for one in every if one.where != (FALSE,)] or every:
        for key, node in scope.nodes.items():
            found[key] = found[key] | node.kinds if key in found else node.kinds
    return found


def _expression(value: Any, values: Callable[[Result], Result]) -> Any:
    """Apply the rewriting rules for returned values to a single expression."""
    return values(Result(columns=(ReturnColumn("", value),))).columns[0].value


_Rule = Callable[[Scope, Catalog], Scope]


def _in_scopes(rule: _Rule, query: Query, catalog: Catalog) -> Query:
    """Apply a rewriting rule to all graph patterns of a query, first to patterns in braces."""

    def inside(expression: Bound) -> Bound:
        if isinstance(expression, BlockValue):
            value = expression.value and inside(expression.value)
            return replace(expression, scope=deep(expression.scope), value=value)
        return with_operands(expression, inside)

    def deep(scope: Scope) -> Scope:
        return rule(replace(scope, where=tuple(map(inside, scope.where))), catalog)

    return replace(query, scope=deep(query.scope), result=query.result.changed(inside))


def nothing_beyond(scope: Scope, catalog: Catalog) -> Scope:
    """Replace the attribute ``in_graph`` by true, unless the query uses entities outside scene graphs."""

    def known(value: Bound) -> Bound:
        if isinstance(value, NodeAttribute) and value.attribute.unit is DisplayUnit.inside:
            return Value(value=True, type=Type.boolean)
        return with_operands(value, known)

    return scope if catalog.world else replace(scope, where=tuple(map(known, scope.where)))


def computed_or_imported(scope: Scope, catalog: Catalog) -> Scope:
    """Replace the trace attribute ``computed`` by a condition on trace ids.

    It is true if sgstore computed the trace's relations.
    """
    ids = [trace.trace_id for trace in catalog.traces if trace.reach is not None]
    told: Bound = Value(value=bool(ids), type=Type.boolean)
    if 0 < len(ids) < len(catalog.traces):
        told = is_one_of(TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number), ids)

    def known(value: Bound) -> Bound:
        if isinstance(value, TraceAttribute) and value.attribute is COMPUTED:
            return told
        return with_operands(value, known)

    return replace(scope, where=tuple(map(known, scope.where)))


def values_lacking(scope: Scope, catalog: Catalog) -> Scope:
    """Replace ``v.heading IS NULL`` by a test of the node kinds that can lack a heading in the store.

    Such conditions come from checks, which ask whether a value is unknown. Most recordings have all values.
    """
    egos = catalog.moving - (frozenset(SIGNALS) - catalog.ego_signals)

    def told(value: Bound) -> Bound:
        match value:
            case Operation("IS NULL", (NodeAttribute(node=node, attribute=attribute),)) if (
                attribute.name in catalog.lacking
            ):
                if node not in scope.nodes and node not in scope.outer:
                    return value
                kinds, lacking = scope.kinds(node), catalog.lacking[attribute.name]
                every = (kinds.ego & egos) | kinds.other
                if not every & lacking:
                    return FALSE
                if every <= lacking:
                    return value
                return all_of(LabelTest(node, any_kinds().only(lacking)), value)
            case _:
                return _folded(with_operands(value, told))

    where = tuple(one for one in map(told, scope.where) if one != TRUE)
    return replace(scope, where=(FALSE,) if FALSE in where else where)


def _folded(value: Bound) -> Bound:
    """Return an equal condition: constants in AND, OR, NOT and CASE are removed."""
    match value:
        case Operation("=", (Value(value=one, type=kind), Value(value=other, type=same))) if (
            kind is same and one is not None and other is not None
        ):
            return TRUE if one == other else FALSE
        case Operation("case"):
            return _branch(value)
        case Operation("NOT", (operand,)) if operand == FALSE:
            return TRUE
        case Operation("AND" | "OR" as word, operands):
            return _joined(word, operands)
        case BlockValue(word="EXISTS", scope=Scope(where=(first,))) if first == FALSE:
            return FALSE
        case _:
            return value


def _branch(value: Operation) -> Bound:
    """Return an equal ``CASE``: the first branches are removed if their conditions are constant."""
    match value.operands:
        case (otherwise,):
            return otherwise
        case (first, chosen, *_) if first == TRUE:
            return chosen
        case (first, _, *rest) if first == FALSE:
            return _branch(replace(value, operands=tuple(rest)))
        case _:
            return value


def _joined(word: str, operands: tuple[Bound, ...]) -> Bound:
    """Join conditions by AND or OR. Constants are removed, and a label common to all parts comes first."""
    neutral, strong = (TRUE, FALSE) if word == "AND" else (FALSE, TRUE)
    rest = [one for one in operands if one != neutral]
    if not rest:
        return neutral
    if strong in rest:
        return strong
    joined = Operation(word, tuple(rest), Type.boolean) if len(rest) > 1 else rest[0]
    label = _common_label(rest) if word == "OR" and len(rest) > 1 else None
    return joined if label is None else all_of(label, joined)


def _common_label(ways: Sequence[Bound]) -> LabelTest | None:
    """If all conditions require a label of the same node, return the common label; otherwise None."""
    labels: list[LabelTest] = []
    for way in ways:
        label = way.operands[0] if isinstance(way, Operation) and way.word == "AND" else way
        if not isinstance(label, LabelTest) or (labels and label.node != labels[0].node):
            return None
        labels.append(label)
    kinds = labels[0].kinds
    for label in labels[1:]:
        kinds |= label.kinds
    return LabelTest(labels[0].node, kinds)


def push_negations(scope: Scope, _: Catalog) -> Scope:
    """Move ``NOT`` inside AND and OR in the conditions of a pattern. Then more parts can be separate.

    De Morgan's laws and ``NOT a < b`` = ``a >= b`` hold in three-valued logic too.
    """
    return replace(
        scope, where=tuple(part for c in scope.where for part in conjuncts(_positive(c)))
    )


def _positive(condition: Bound) -> Bound:
    match condition:
        case Operation("NOT", (operand,)):
            return _negated(operand)
        case Operation("IMPLIES", (left, right)):
            return Operation("OR", (_negated(left), _positive(right)), Type.boolean)
        case Operation(word="AND" | "OR" as word, operands=operands):
            return Operation(word, tuple(_positive(o) for o in operands), Type.boolean)
        case _:
            return condition


def _negated(condition: Bound) -> Bound:
    match condition:
        case Operation(word=word, operands=operands):
            return _negated_operation(word, operands)
        case Value(value=bool(value)):
            return Value(not value, Type.boolean)
        case LabelTest(node, kinds):
            return LabelTest(node, ~kinds)
        case _:
            return Operation("NOT", (condition,), Type.boolean)


def _negated_operation(word: str, operands: tuple[Bound, ...]) -> Bound:
    if word == "NOT":
        return _positive(operands[0])
    if word == "IMPLIES":
        operands = (_positive(operands[0]), _negated(operands[1]))
        return Operation("AND", operands, Type.boolean)
    if word in {"AND", "OR"}:
        other = "OR" if word == "AND" else "AND"
        return Operation(other, tuple(_negated(o) for o in operands), Type.boolean)
    if word in _OPPOSITE:
        return Operation(_OPPOSITE[word], operands, Type.boolean)
    return Operation("NOT", (Operation(word, operands, Type.boolean),), Type.boolean)


def counts_to_existence(scope: Scope, _: Catalog) -> Scope:
    """Replace ``COUNT {…} > 0`` by ``EXISTS {…}``, and ``COUNT {…} = 0`` by ``NOT EXISTS {…}``."""
    return replace(scope, where=tuple(map(_existence, scope.where)))


def _existence(condition: Bound) -> Bound:
    counted = counted_block(condition)
    if counted is None:
        if isinstance(condition, Operation) and condition.word in {"AND", "OR", "NOT", "XOR"}:
            return replace(condition, operands=tuple(_existence(o) for o in condition.operands))
        return condition
    block, sign, number = counted
    exists = replace(block, word="EXISTS", type=Type.boolean)
    if (sign, number) in {(">", 0), (">=", 1), ("<>", 0)}:
        return exists
    if (sign, number) in {("=", 0), ("<", 1), ("<=", 0)}:
        return Operation("NOT", (exists,), Type.boolean)
    return condition


def counted_block(condition: Bound) -> tuple[BlockValue, str, float] | None:
    """Split a condition ``COUNT {…} > n`` or similar into pattern, sign and number; None for others."""
    match condition:
        case Operation(
            word, (BlockValue(word="COUNT") as block, Value(value=int() | float() as n))
        ):
            return (block, word, n) if word in _OPPOSITE else None
        case Operation(
            word, (Value(value=int() | float() as n), BlockValue(word="COUNT") as block)
        ):
            return (block, MIRRORED[word], n) if word in _OPPOSITE else None
        case _:
            return None


def complement(sign: str) -> str:
    """Return the opposite of a comparison sign, such as ``>=`` for ``<``."""
    return _OPPOSITE[sign]


def unfold_paths(scope: Scope, _: Catalog, *, injective: bool) -> Scope:
    """Replace each path of exactly n edges by n edges. New nodes connect them.

    If nodes must differ, the hidden nodes differ from each other and from both ends. They may coincide with
    other nodes of the pattern. The same holds for a path of m to n edges.
    """
    for edge in scope.edges:
        if edge.low == edge.high > 1:
            scope = chain(scope, edge, edge.low, injective=injective)
    return scope


def chain(scope: Scope, edge: Edge, length: int, *, injective: bool) -> Scope:
    """Return a pattern in which single edges, connected by new nodes, replace a path."""
    between = [f"#{edge.key}.{number}" for number in range(1, length)]
    stops = [edge.src, *between, edge.dst]
    hidden = {key: Node(key, any_kinds(), "hidden", edge.span) for key in between}
    links = tuple(
        replace(edge, key=f"{edge.key}.{i + 1}", src=src, dst=dst, low=1, high=1)
        for i, (src, dst) in enumerate(pairwise(stops))
    )
    differ = {(a, b) for a, b in combinations(stops, 2) if a in hidden or b in hidden}
    return replace(
        scope,
        nodes={**scope.nodes, **hidden},
        edges=tuple(e for old in scope.edges for e in (links if old.key == edge.key else (old,))),
        distinct=scope.distinct | differ if injective else scope.distinct,
    )


def labels_from_conditions(scope: Scope, _: Catalog) -> Scope:
    """Replace conditions such as ``v.kind = 'car'`` or ``v.is_ego`` by labels. SQL tests labels faster."""
    nodes, rest = dict(scope.nodes), list[Bound]()
    for condition in scope.where:
        key, kinds = _label(condition)
        if key in nodes:
            nodes[key] = replace(nodes[key], kinds=nodes[key].kinds & kinds)
        else:
            rest.append(condition)
    return replace(scope, nodes=nodes, where=tuple(rest))


def _label(condition: Bound) -> tuple[str, Kinds]:
    match condition:
        case LabelTest(node, kinds):
            return node, kinds
        case NodeAttribute(node=node, attribute=attribute) if attribute.name == "is_ego":
            return node, ego_kinds()
        case Operation("NOT", (NodeAttribute(node=node, attribute=attribute),)) if (
            attribute.name == "is_ego"
        ):
            return node, ~ego_kinds()
        case Operation(
            "=", (NodeAttribute(node=node, attribute=attribute), Value(value=str(kind)))
        ) if attribute.name == "kind":
            return node, any_kinds().only(frozenset({kind}))
        case _:
            return "", any_kinds()


def open_exists(scope: Scope, catalog: Catalog) -> Scope:
    """Merge a required ``EXISTS {…}`` into the pattern around it. Its nodes are not reported.

    This needs a free node: one that the block binds, but no edge of the pattern. Otherwise, such a node would
    be tried with every entity of the frame. If several blocks are separate relations (:func:`stands_alone`),
    they are kept. The database would join all of them before it reads the edges.
    """
    alone = [one for one in scope.where if stands_alone(one, catalog)]
    while True:
        free = set(scope.nodes) - _ends(scope)
        opened = next(
            (
                condition
                for condition in scope.where
                if isinstance(condition, BlockValue)
                and condition.word == "EXISTS"
                and _ends(condition.scope) & free
                and (len(alone) < 2 or condition not in alone)
            ),
            None,
        )
        if opened is None:
            return scope
        scope = _merged(scope, opened)


LONG_WAY: Final = 3
"""Smallest number of edges of a pattern in braces that is evaluated as a separate subquery."""


def stands_alone(condition: Bound, catalog: Catalog) -> TypeGuard[BlockValue]:
    """True if SQL evaluates an ``EXISTS {…}`` with a long path as a subquery of its own.

    This occurs only in scope ``world``.
    """
    if not catalog.around or not isinstance(condition, BlockValue) or condition.word != "EXISTS":
        return False
    scope = condition.scope
    if len(scope.edges) < LONG_WAY or not scope.outer or not scope.outer.keys() <= _ends(scope):
        return False
    told = (leaf for one in scope.where for leaf in leaves(one))
    single = all(len(nodes_of(one)) == 1 for one in scope.where)
    return single and all(isinstance(leaf, NodeAttribute) and _of_table(leaf) for leaf in told)


def _of_table(leaf: NodeAttribute) -> bool:
    """True if the table of a node contains an attribute."""
    bare = {DisplayUnit.role, DisplayUnit.own, DisplayUnit.owner, DisplayUnit.inside}
    return leaf.attribute.unit not in bare


def _ends(scope: Scope) -> set[str]:
    return {key for edge in scope.edges for key in (edge.src, edge.dst)}


def _merged(scope: Scope, block: BlockValue) -> Scope:
    inner = block.scope
    hidden = {key: replace(node, role="hidden") for key, node in inner.nodes.items()}
    unnamed = tuple(replace(edge, named=False) for edge in inner.edges)
    where = tuple(condition for condition in scope.where if condition is not block)
    return Scope(
        {**scope.nodes, **hidden},
        scope.outer,
        scope.edges + unnamed,
        where + inner.where,
        scope.distinct | inner.distinct,
    )


def narrowed(scope: Scope, catalog: Catalog) -> Scope:
    """Restrict the nodes of a pattern to kinds that have the required edges in the store.

    If the edges of a pattern do not occur in the store, its condition becomes false.
    """
    triples = tuple({**catalog.map_edges, **catalog.edges})
    kinds = kinds_left(scope, triples, catalog.moving | catalog.fixed | catalog.mapped)
    if kinds is None:
        return replace(scope, where=(FALSE,))
    nodes = {key: replace(node, kinds=kinds[key]) for key, node in scope.nodes.items()}
    return replace(scope, nodes=nodes, outer={key: kinds[key] for key in scope.outer})


def kinds_left(
    scope: Scope, triples: Collection[Triple], held: frozenset[str]
) -> dict[str, Kinds] | None:
    """Return the kinds that each pattern node can have in a store with the given kinds of edges.

    ``None`` means no match.
    """
    kinds = {key: scope.kinds(key).only(held) for key in (*scope.nodes, *scope.outer)}
    single = [edge for edge in scope.edges if edge.high == 1]
    ways = [[*possible(e, kinds[e.src], kinds[e.dst], triples)] for e in single]
    while _pass(kinds, single, ways):
        pass
    return kinds if all(kinds.values()) else None


def _pass(kinds: dict[str, Kinds], edges: list[Edge], ways: list[list[Triple]]) -> bool:
    """Remove the kinds that the edges of a pattern exclude. Return True if at least one was removed."""
    changed = False
    for place, edge in enumerate(edges):
        starts, ends = kinds[edge.src].every, kinds[edge.dst].every
        found = ways[place] = [w for w in ways[place] if w[1] in starts and w[2] in ends]
        for key, side, held in ((edge.src, 1, starts), (edge.dst, 2, ends)):
            seen = {triple[side] for triple in found}
            if held <= seen:
                continue
            kinds[key] = kinds[key].only(frozenset(seen))
            changed = True
    return changed


def possible(edge: Edge, src: Kinds, dst: Kinds, triples: Iterable[Triple]) -> Iterator[Triple]:
    """Yield the triples (relation, source kind, destination kind) that a pattern edge can match.

    The second item is the kind of ``src``.
    """
    relations, starts, ends, both = edge.relations, src.every, dst.every, edge.both
    for triple in triples:
        relation, one, other = triple
        if relation not in relations:
            continue
        if one in starts and other in ends:
            yield triple
        if both and other in starts and one in ends:
            yield relation, other, one


def ordered(scope: Scope, catalog: Catalog, begin: Iterable[str] = ()) -> Scope:
    """Sort the edges of a pattern: rarest first, and each connected to an earlier one if possible.

    ``begin`` are additional nodes to begin at.
    """
    counts = {**catalog.map_edges, **catalog.edges}

    def rows(edge: Edge) -> int:
        found = possible(edge, scope.kinds(edge.src), scope.kinds(edge.dst), counts)
        return sum(counts.get(triple, 0) for triple in set(found))

    waiting, result, mates = list(scope.edges), list[Edge](), [*same_chain(scope.where)]
    seen = {*scope.outer, *begin}
    while waiting:
        seen |= {key for pair in mates if seen.intersection(pair) for key in pair}
        connected = [e for e in waiting if {e.src, e.dst} & seen] or waiting
        rarest = min(connected, key=rows)
        waiting.remove(rarest)
        result.append(rarest)
        seen |= {rarest.src, rarest.dst}
    return replace(scope, edges=tuple(result))


def labels_to_conditions(scope: Scope, _: Catalog) -> Scope:
    """Inside braces, replace labels of nodes of the outer pattern by conditions on their attributes."""
    return replace(scope, where=tuple(map(_attributes, scope.where)))


def _attributes(condition: Bound) -> Bound:
    """Return an expression in which conditions on the kind of a node replace labels."""
    if not isinstance(condition, LabelTest):
        return with_operands(condition, _attributes)
    kind = NodeAttribute(condition.node, NODE_ATTRIBUTES["kind"], Type.text)
    ego = NodeAttribute(condition.node, NODE_ATTRIBUTES["isego"], Type.boolean)
    other = Operation("NOT", (ego,), Type.boolean)
    either = tuple(
        Operation("AND", (mark, Operation("IN", (kind, _words(kinds)), Type.boolean)), Type.boolean)
        for mark, kinds in ((ego, condition.kinds.ego), (other, condition.kinds.other))
    )
    return Operation("OR", either, Type.boolean)


def _words(kinds: frozenset[str]) -> Choices:
    return Choices(tuple(Value(kind, Type.text, closed=True) for kind in KINDS if kind in kinds))


INVARIANT: Final = FrameAttribute(
    Attribute("held", Type.number, {}, "how many frames a row stands for"), Type.number
)
"""Number of frames that a row represents. ``COUNT(*)`` sums it if rows represent several frames."""


def is_lasting(leaf: Leaf, scope: Scope, catalog: Catalog) -> bool:
    """True if a value of a match cannot change within a bucket of 60 frames."""
    match leaf:
        case NodeValue() | EdgeRelation() | TraceAttribute():
            return True
        case NodeAttribute(node=node, attribute=attribute):
            if attribute.unit in {DisplayUnit.binding, DisplayUnit.owner} or is_constant(leaf):
                return True
            profile = Profile.of(scope.kinds(node), catalog)
            if attribute.unit in {DisplayUnit.role, DisplayUnit.own, DisplayUnit.inside}:
                return False
            return not profile.moving and not profile.fixed
        case _:
            return False


def count_by_buckets(query: Query, catalog: Catalog) -> Query:
    """Replace ``COUNT(*)`` by a sum of frame counts, if no value can change within a bucket.

    All values must be constant within a bucket. Other aggregates must not depend on how often a value occurs.
    """
    result = query.result
    values = result.values
    parts = [part for value in values for part in walk(value)]
    counts = [part for part in parts if isinstance(part, Aggregate)]
    listed = result.form != "rows" or result.whole or result.framed or result.sample is not None
    if listed or not any(_counts_all(part) for part in counts):
        return query
    if not all(
        _counts_all(part) or part.distinct or part.word in {"min", "max"} for part in counts
    ):
        return query
    if not all(
        is_lasting(leaf, query.scope, catalog) for value in values for leaf in leaves(value)
    ):
        return query
    return replace(query, result=result.changed(_weighed))


def _counts_all(part: Aggregate) -> bool:
    return part.word == "count" and part.operand is None


def _weighed(value: Bound) -> Bound:
    match value:
        case Aggregate() if _counts_all(value):
            return replace(value, operand=INVARIANT)
        case _:
            return with_operands(value, _weighed)


_LESS: Final = {"<", "<=", "="}
_MORE: Final = {">", ">=", "="}


def bounds(conditions: list[Bound]) -> list[Bound]:
    """Return conditions that follow from the given ones and are faster to test.

    Example: ``gap < t`` implies that a lower bound of ``gap`` is at most t.
    """
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
    if not is_dear(pair) or any(is_dear(leaf) for leaf in leaves(limit)):
        return []
    least = PairNumber("at_least", pair.a, pair.b)
    if PAIR_FUNCTIONS[pair.function].unit == "s":
        approach = PairNumber("approach", pair.a, pair.b)
        limit = Operation("*", (limit, approach), Type.number)
    return [Operation("<=", (least, limit), Type.boolean)]


def is_dear(leaf: Leaf) -> bool:
    """True if a number of two entities takes long to compute."""
    return (
        isinstance(leaf, PairNumber)
        and leaf.function in PAIR_FUNCTIONS
        and PAIR_FUNCTIONS[leaf.function].dear
    )
