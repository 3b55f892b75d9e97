"""Binder: converts syntax trees of queries and checks to the IR.

The binder and the parser find all errors of the user, before any SQL is built.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryError, TextSpan
from sgstore.lang import ir as b
from sgstore.lang import ir as o
from sgstore.lang.bind._beyond import looks_less, whole_block
from sgstore.lang.bind._expressions import BINDERS, edge_attribute, node_attribute, parameter
from sgstore.lang.bind._functions import FUNCTIONS, call, happens
from sgstore.lang.bind._match_values import over_match
from sgstore.lang.bind._precision import is_stored
from sgstore.lang.bind._stages import StageBinder, name_path
from sgstore.lang.bind._symbols import (
    RESERVED,
    THE_EGO,
    Binders,
    ScopeBuilder,
    Session,
    Symbol,
    SymbolTable,
    asked,
)
from sgstore.lang.bind._temporal import StepScope, bind_sequence, settled, tense, timespan
from sgstore.lang.catalog import TRACE_ATTRIBUTES, Catalog, Type
from sgstore.lang.syntax import tree as s
from sgstore.lang.syntax.tree import CheckClause as WrittenCheck
from sgstore.lang.syntax.tree import Define, MatchClause
from sgstore.model.vocabulary import (
    RELATION_ALIASES,
    entity_kinds,
    kinds_labelled,
    known_names,
    labels,
    normalize_name,
    relation_named,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.syntax.tree import QuantifierClause, Statement


SETTINGS: Final = (
    "NODES",
    "EGO",
    "UNKNOWN",
    "ABSTRACTION",
    "DATASET",
    "MATCHES",
    "GAPS",
    "END",
    "SCOPE",
    "RANGE",
)
"""Settings allowed after ``USING``."""

SCOPES: Final = ("graph", "world")
"""Scopes of a statement: the graphs only, or all known data."""


def bind_query(
    text: str, statements: Sequence[s.Statement], catalog: Catalog, parameters: Mapping[str, Any]
) -> b.Query:
    """Bind the single ``MATCH`` of a text, with the predicates that the text defines.

    Parameters
    ----------
    text : str
        Text for messages.
    statements : sequence of Statement
        Parsed statements.
    catalog : Catalog
        Catalog of the store.
    parameters : mapping of str to value
        Values of ``$name``.

    Raises
    ------
    QueryNameError
        Unknown label, relation, attribute, variable, function or parameter.
    QueryError
        Types do not match, or a part is not allowed at its place.
    """
    session = Session(text, parameters, _BINDERS)
    session.ask(catalog)
    match = _only_match(statements, session)
    settings = chosen(match.settings, session, catalog)
    session.look_beyond(catalog, world=settings.scope == "world")
    if settings.end is not None:
        session.refuse("USING END belongs to CHECK", match.settings[0].span)
    if settings.gaps == "unknown":
        session.refuse("USING GAPS unknown belongs to CHECK", match.settings[0].span)
    if settings.range is not None:
        session.refuse("USING RANGE belongs to CHECK", match.settings[0].span)
    query = _of_match(match, session)
    refuse_unused(session)
    refuse_strange(session, catalog)
    return replace(
        query,
        relations=frozenset(session.relations),
        injective=session.injective,
        ego=settings.ego,
        unknown_is_false=settings.unknown_is_false,
        policy=settings.policy or "all",
        gaps=settings.gaps or "break",
        world=settings.scope == "world",
    )


def _of_match(match: s.MatchClause, session: Session) -> b.Query:
    named = any(path.name for path in match.block.paths)
    if not match.later and not (named and _is_plain(match)):
        return _of_one_step(match, session) if _is_plain(match) else _of_steps(match, session)
    if not _is_plain(match):
        session.refuse(
            "OPTIONAL MATCH and WITH go on from a pattern of one frame, and this is a sequence",
            match.later[0].span,
            "what a step finds is returned as it is; EXISTS {…} and COUNT {…} ask for what may be absent",
        )
    stages = StageBinder(match, session, bind_block, _columns)
    result = stages.result(_result(match.returns, stages.names))
    return b.Query(stages.scope(), result, frozenset(), stages=stages.stages())


def _is_plain(match: s.MatchClause) -> bool:
    """True if the query is a single pattern, without a duration or a name."""
    first = match.sequence.steps[0]
    if len(match.sequence.steps) > 1 or not isinstance(first, s.StepClause):
        return False
    return bool(first.block.paths) and not first.hold and first.name is None


def _of_one_step(match: s.MatchClause, session: Session) -> b.Query:
    """Bind a single-frame pattern. If it uses other frames, bind it as a sequence of one step."""
    names = SymbolTable(session, ScopeBuilder(session))
    bind_block(match.block, names)
    result = _result(match.returns, names)
    scope = names.scope.finished()  # after RETURN is bound, which may name the ego
    where = tuple(settled(part, session) for part in scope.where)
    when = tuple(part for part in where if b.is_temporal(part))
    if not when and not any(b.is_temporal(value) for value in result.values):
        return b.Query(replace(scope, where=where), result, frozenset())
    still = replace(scope, where=tuple(part for part in where if not b.is_temporal(part)))
    step = o.BoundStep(still, when, None, absent=False, span=match.block.span)
    return b.Query(_told(scope), result, frozenset(), steps=(step,))


def _of_steps(match: s.MatchClause, session: Session) -> b.Query:
    """Bind a sequence of steps."""
    found = bind_sequence(match.sequence, session, bind_block)
    names = SymbolTable(session, found.scope(), found.meanings)
    result = _result(match.returns, names)
    found.take_in_ego(names.scope)
    steps, ways = tuple(found.steps), tuple(found.ways)
    query = b.Query(_told(names.scope.finished()), result, frozenset(), steps=steps)
    if len(ways) == 1 and ways[0].steps == tuple(range(len(steps))):
        return replace(query, links=ways[0].links)
    return replace(query, alternatives=ways)


def _told(scope: b.Scope) -> b.Scope:
    """Return the scope of a match: named nodes and edges, the ends of these edges, and the ego."""
    edges = tuple(edge for edge in scope.edges if edge.named)
    ends = {end for edge in edges for end in (edge.src, edge.dst)}
    told = {
        k for k, n in scope.nodes.items() if n.role == "named" or not n.kinds.other or k in ends
    }
    nodes = {key: node for key, node in scope.nodes.items() if key in told}
    return replace(scope, nodes=nodes, edges=edges, where=(), distinct=frozenset())


def _only_match(statements: Sequence[s.Statement], session: Session) -> s.MatchClause:
    found: s.MatchClause | None = None
    for statement in statements:
        if isinstance(statement, s.Define):
            define(statement, session)
        elif isinstance(statement, s.CheckClause):
            session.refuse(
                "a CHECK has a verdict, and no matches",
                statement.span,
                "ask for it by check: sgstore check STORE …",
            )
        elif isinstance(statement, s.UnionClause):
            session.refuse(
                "a UNION joins the answers of several queries, and one is asked for here",
                statement.span,
                "ask of each part by itself",
            )
        elif found is not None:
            session.refuse("one MATCH at a time", statement.span, "answers are joined by UNION")
        else:
            found = statement
    if found is None:
        names = [
            d.name for d in session.predicates.values() if isinstance(d.body, s.SequenceClause)
        ]
        hint = f"add MATCH {names[0]}()" if names else "add MATCH …"
        session.refuse("nothing is asked", TextSpan(0, len(session.text)), hint)
    return found


def define(statement: s.Define, session: Session) -> None:
    """Add a definition of a predicate or scenario to the session.

    Raises
    ------
    QueryError
        The name is used by another definition or by a function. A query may redefine predicates of the
        library.
    """
    name = normalize_name(statement.name)
    if name in session.predicates:
        session.refuse(f"'{statement.name}' is defined twice", statement.name_span)
    if name in {normalize_name(function) for function in FUNCTIONS}:
        session.refuse(f"'{statement.name}' is a function already", statement.name_span)
    session.predicates[name] = statement


@dataclass(slots=True)
class UsingChoice:
    """Settings from ``USING``. ``None`` means not set."""

    ego: str | None = None
    unknown_is_false: bool = False
    policy: str | None = None
    gaps: str | None = None
    end: str | None = None
    scope: str | None = None
    range: float | None = None


def chosen(settings: Sequence[s.Setting], session: Session, catalog: Catalog) -> UsingChoice:
    """Return the ``USING`` settings of a statement.

    Raises
    ------
    QueryNameError
        Unknown setting, or unknown value of a setting.
    """
    found = UsingChoice()
    for setting in settings:
        name, value = normalize_name(setting.name), _setting_value(setting, session)
        if name in _CHOICES:
            _choose(found, setting, value, session)
        elif name == "ego":
            egos = {trace.ego for trace in catalog.traces if trace.ego}
            if value not in egos and not catalog.part:
                session.unknown("ego", value, setting.span, egos)
            found.ego = value
        elif name == "range":
            found.range = _metres(value, setting, session)
        elif name == "dataset":
            asked(value, setting.span, session)
        elif name == "abstraction":
            if catalog.under(value) is None:
                hint = None if catalog.sets else "the store has none yet: sgstore derive makes them"
                session.unknown("abstraction", value, setting.span, [*catalog.sets], hint)
        else:
            session.unknown("setting", setting.name, setting.span, SETTINGS)
    return found


_CHOICES: Final = {
    "nodes": ("distinct", "any"),
    "unknown": ("false",),
    "matches": ("all", "first", "longest"),
    "gaps": ("break", "bridge", "unknown"),
    "end": ("strong", "weak", "pending"),
    "scope": SCOPES,
}


def _choose(found: UsingChoice, setting: s.Setting, value: str, session: Session) -> None:
    """Store a setting that has a closed list of values."""
    name, word = normalize_name(setting.name), value.lower()
    if word not in _CHOICES[name]:
        session.unknown(f"value of {setting.name}", value, setting.span, _CHOICES[name])
    match name:
        case "nodes":
            session.injective = word == "distinct"
        case "unknown":
            found.unknown_is_false = True
        case "matches":
            found.policy = word
        case "gaps":
            found.gaps = word
        case "scope":
            found.scope = word
        case _:
            found.end = word


def _metres(value: str, setting: s.Setting, session: Session) -> float:
    """Return the range of a check in metres."""
    try:
        metres = float(value)
    except ValueError:
        metres = -1.0
    if not 0 <= metres < math.inf:
        session.refuse(
            f"USING RANGE {value} is no distance", setting.span, "metres: USING RANGE 200"
        )
    return metres


def _setting_value(setting: s.Setting, session: Session) -> str:
    if isinstance(setting.value, str):
        return setting.value
    return str(parameter(setting.value, SymbolTable(session, ScopeBuilder(session))))


def refuse_unused(session: Session) -> None:
    """Reject parameters that the query does not use."""
    unused = sorted(set(session.parameters) - session.used)
    if unused:
        name, hint = unused[0], f"it would be written ${unused[0]}"
        if name == "limit":
            hint = "for fewer rows write LIMIT into the query, or call .limit(n) on its matches"
        raise QueryError(f"the query has no parameter '{name}'", hint=hint)


def refuse_strange(session: Session, catalog: Catalog) -> None:
    """Reject relations that the abstraction does not have."""
    if catalog.relations is None:
        return
    strange = sorted(session.relations - catalog.relations)
    if strange:
        raise QueryError(
            f"the abstraction {catalog.name!r} has no relation '{strange[0]}'",
            hint=f"it has: {', '.join(sorted(catalog.relations)) or 'none'}",
        )


# Patterns -----------------------------------------------------------------------------------------


def bind_block(block: s.Block, names: SymbolTable) -> None:
    """Bind the paths and the condition of a block into the scope of ``names``.

    All nodes and edges are bound before any condition. So a condition inside a node can use later nodes.
    """
    pending: list[tuple[s.NodePattern | s.EdgePattern, str]] = []
    for path in block.paths:
        keys = [_node(node, names) for node in path.nodes]
        pending += zip(path.nodes, keys, strict=True)
        edges = [
            (edge, _edge(edge, left, right, names))
            for edge, left, right in zip(path.edges, keys, keys[1:], strict=False)
        ]
        pending += edges
        if path.name is not None:
            name_path(path, keys, [key for _, key in edges], names)
    for pattern, key in pending:
        _inline(pattern, key, names)
    if block.where is not None:
        names.scope.where += b.conjuncts(names.condition(block.where))


def _block(e: s.BlockExpression, names: SymbolTable) -> b.Bound:
    session, inner = names.session, names.block()
    bind_block(e.block, inner)
    value = inner.number(e.value) if e.value is not None else None
    kind = Type.boolean if e.word == "EXISTS" else Type.number
    session.blocks += 1
    block = b.BlockValue(e.word, inner.scope.finished(), value, kind, session.blocks)
    found = whole_block(block, session.blocks + 1)
    session.blocks += sum(isinstance(part, b.BlockValue) for part in b.walk(found)) - 1
    return found


_BINDERS: Final[Binders] = {
    **BINDERS,
    s.BlockExpression: _block,
    s.Call: call,
    s.Duration: timespan,
    s.HappensExpression: happens,
    s.OverExpression: over_match,
    s.Temporal: tense,
}
"""Binder of each kind of expression."""


def _node(node: s.NodePattern, names: SymbolTable) -> str:
    kinds = kinds_of(node.label, names.session) if node.label else b.any_kinds()
    if not kinds:
        names.session.refuse("no node can have this label", node.span)
    key = _known_node(node, names)
    if key is None:
        _refuse_bare_label(node, names)
        key = names.scope.add(node.name, kinds, node.span, named=node.name is not None)
        if node.name is not None:
            names.meanings[node.name] = Symbol(node=key)
        return key
    if node.label:
        names.scope.narrow(key, kinds)
        if not names.scope.kinds(key):
            names.session.refuse(f"'{node.name}' has two labels that no node has both", node.span)
        if key in names.scope.outer:
            names.scope.where.append(b.LabelTest(key, kinds))
    return key


def _refuse_bare_label(node: s.NodePattern, names: SymbolTable) -> None:
    """Reject ``(Car)``, which is a node named Car. The user probably means ``(:Car)``."""
    if node.name and node.name[0].isupper() and not node.label and node.name in labels():
        names.session.refuse(
            f"({node.name}) would be any node, called {node.name}",
            node.name_span,
            f"a label stands behind a colon: (:{node.name})",
        )


def _known_node(node: s.NodePattern, names: SymbolTable) -> str | None:
    """Return the key of a node that is already bound. ``None`` means a new node."""
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
    """Return the key of the ego if the node has the reserved name ``ego``, or None."""
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
            f"-[{edge.name}]-> would be an edge of any relation, called {edge.name}",
            edge.span,
            f"a relation stands behind a colon: -[:{edge.name}]->",
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
        )
    )
    return key


def _inline(pattern: s.NodePattern | s.EdgePattern, key: str, names: SymbolTable) -> None:
    """Bind the properties and the condition inside a node or an edge."""
    for prop in pattern.properties:
        attribute_of = node_attribute if isinstance(pattern, s.NodePattern) else edge_attribute
        attribute = attribute_of(key, prop.name, prop.name_span, names)
        names.scope.where.append(_equality(attribute, prop, names))
    if pattern.where is not None:
        names.scope.where += b.conjuncts(names.condition(pattern.where))


def _equality(attribute: b.Bound, prop: s.Property, names: SymbolTable) -> b.Bound:
    """Bind the property ``name: value`` as a comparison. The attribute gets a name unavailable to queries."""
    inner = names.body({"": Symbol(value=attribute)})
    inner.parent = names
    span = TextSpan(prop.name_span.start, prop.value.span.end)
    return inner.condition(s.Comparison("=", s.Variable("", prop.name_span), prop.value, span))


def kinds_of(label: s.LabelExpression, session: Session) -> b.Kinds:
    """Return the kinds that a label allows.

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
        session.unknown("label", label.name, label.span, labels())
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
        session.unknown(
            "relation", label.name, label.span, (*known_names("relation"), *RELATION_ALIASES)
        )
    session.relations.add(relation)
    return frozenset({relation})


# Results ------------------------------------------------------------------------------------------


_FORMS: Final[dict[str, b.Form]] = {
    "intervals": "intervals",
    "clips": "clips",
    "subgraphs": "subgraphs",
}


def _result(returns: s.Returns | None, names: SymbolTable) -> b.Result:
    if returns is None:
        return b.Result()
    inner = replace(names, aggregates=True, over=True)
    item = _special(returns, names.session)
    form = item.form if item is not None else "value"
    result = b.Result(
        form=_FORMS.get(form, "rows"),
        columns=_columns(returns.items, inner),
        whole=any(item.form == "all" for item in returns.items),
        framed=form == "frames",
        distinct=returns.distinct,
        skip=returns.skip,
        limit=returns.limit,
        before=item.before if item else 0,
        after=item.after if item else 0,
    )
    result = replace(result, having=_having(returns.having, result, inner))
    _check_result(result, returns, names.session)
    if result.aggregated or result.form in {"intervals", "clips"}:
        # Each row is unique already, and DISTINCT must not remove rows that are counted.
        result = replace(result, distinct=False)
    order = tuple(b.SortKey(_key(k.value, result, inner), k.descending) for k in returns.order)
    sample, top = _sampling(returns.sample, result, inner), _top(returns.top, result, inner)
    return replace(result, order=order, sample=sample, top=top)


def _special(returns: s.Returns, session: Session) -> s.Item | None:
    """Return the item ``FRAMES``, ``INTERVALS``, ``SUBGRAPHS`` or ``CLIPS``, or None."""
    special = [item for item in returns.items if item.form not in {"value", "all"}]
    if len(special) > 1:
        session.refuse("one of FRAMES, INTERVALS, SUBGRAPHS and CLIPS at a time", special[1].span)
    return special[0] if special else None


def _columns(items: Iterable[s.Item], names: SymbolTable) -> tuple[b.ReturnColumn, ...]:
    """Bind the values to return. An aggregating value may use the grouping values of the same ``RETURN``."""
    items = [item for item in items if item.form == "value"]
    found = [_column(item, names) for item in items]
    keys = _group_keys(found)
    columns: list[b.ReturnColumn] = []
    for item, column in zip(items, found, strict=True):
        assert item.value is not None  # noqa: S101 - the form of the item guarantees it
        value = _of_groups(column.value, keys) if b.is_counted(column.value) else column.value
        _refuse_mixed(value, item.value.span, names.session)
        columns.append(replace(column, value=value))
    return tuple(columns)


def _group_keys(columns: Iterable[b.ReturnColumn]) -> dict[b.Bound, str]:
    plain = (one for one in columns if not b.is_counted(one.value))
    return {one.value: one.name for one in plain if not isinstance(one.value, b.Value)}


def _of_groups(value: b.Bound, keys: Mapping[b.Bound, str]) -> b.Bound:
    """Replace grouping values in an expression by references to their columns."""
    if value in keys:
        return b.GroupKey(keys[value], value.type)
    if isinstance(value, b.Operation):
        return b.with_operands(value, lambda part: _of_groups(part, keys))
    return value


def _column(item: s.Item, names: SymbolTable) -> b.ReturnColumn:
    assert item.value is not None  # noqa: S101 - the form of the item guarantees it
    value = settled(names.bind(item.value), names.session)
    if value.type is Type.list and not (isinstance(value, b.Aggregate) or b.is_passed_on(value)):
        names.session.refuse("a list cannot be returned", item.span)
    text = names.session.text[item.value.span.start : item.value.span.end]
    return b.ReturnColumn(item.name or " ".join(text.split()), value, is_stored(value))


def _refuse_mixed(value: b.Bound, span: TextSpan, session: Session) -> None:
    """Reject a value that mixes single matches with an aggregate over all matches."""
    if b.is_counted(value) and _of_each(value):
        session.refuse(
            "a value of each match cannot stand beside one of all matches",
            span,
            "return both by themselves: x.speed, AVG(x.speed)",
        )


def _of_each(value: b.Bound) -> bool:
    """True if a value depends on single matches outside its aggregates."""
    if isinstance(value, b.Operation):
        return any(_of_each(operand) for operand in value.operands)
    return not isinstance(value, b.Aggregate | b.GroupKey | b.Value | b.Choices)


def _having(written: s.Expression | None, result: b.Result, names: SymbolTable) -> b.Bound | None:
    """Return the condition on groups of matches or on intervals, or None."""
    if written is None:
        return None
    session = names.session
    if result.form in {"intervals", "clips"}:
        own: dict[str, b.Bound] = {
            name: b.GroupKey(name, Type.text if name == "trace" else Type.number)
            for name in result.names
        }
        found = settled(replace(names, aliases=own).condition(written), session)
        if b.is_counted(found) or _of_each(found):
            session.refuse(
                f"behind HAVING, {result.form} have their ends and no other values",
                written.span,
                f"name one of: {', '.join(own)}; what a match must be stands behind WHERE",
            )
        return found
    own = {column.name: column.value for column in result.columns}
    found = settled(replace(names, aliases=own).condition(written), session)
    found = _of_groups(found, _group_keys(result.columns))
    if not b.is_counted(found) and not result.aggregated:
        session.refuse(
            "HAVING chooses among groups of matches, and nothing is counted here",
            written.span,
            "what a match must be stands behind WHERE, before RETURN",
        )
    if _of_each(found):
        session.refuse(
            "behind HAVING stand values of groups: what is counted, and what is returned beside it",
            written.span,
            "what a match must be stands behind WHERE, before RETURN",
        )
    return found


def _key(value: s.Expression, result: b.Result, names: SymbolTable) -> b.Bound | str:
    """Return a sort or sampling key: the name of a result, or a value of each match."""
    own = {column.name: column.value for column in result.columns}
    known = (*result.names, *own)
    taken = isinstance(value, s.Variable) and names.meaning(value.name) is not None
    if isinstance(value, s.Variable) and (value.name in own or (value.name in known and not taken)):
        return value.name
    if isinstance(value, s.Variable) and value.name not in {*names.visible(), *known}:
        names.session.unknown("variable", value.name, value.span, {*names.visible(), *known})
    found = settled(replace(names, aliases=own).bind(value), names.session)
    if result.aggregated and b.is_counted(found):
        found = _of_groups(found, _group_keys(result.columns))
    _refuse_mixed(found, value.span, names.session)
    if found.type is Type.list:
        names.session.refuse("a list puts nothing in an order", value.span)
    if isinstance(found, b.Value):
        hint = f"name a value, or one of: {', '.join(known)}"
        names.session.refuse("a constant puts nothing in an order", value.span, hint)
    same = next((column.name for column in result.columns if column.value == found), None)
    if result.form in {"intervals", "clips"} and found == _TRACE_NAME:
        same = "trace"
    if same is not None:
        return same
    counted = b.is_counted(found)
    one_each = not (result.distinct or result.framed or result.aggregated)
    listed = result.form in {"rows", "subgraphs"}
    if not listed or not (result.aggregated if counted else one_each):
        names.session.refuse(
            "only by what is returned can these results be ordered or sampled",
            value.span,
            f"name one of: {', '.join(known)}",
        )
    return found


def _sampling(sample: s.Sample | None, result: b.Result, names: SymbolTable) -> b.Sampling | None:
    if sample is None:
        return None
    if result.aggregated or (result.distinct and not (result.whole or result.framed)):
        reason = "SAMPLE chooses among matches, and these are not listed"
        names.session.refuse(reason, sample.span, "LIMIT n gives the first ones, by ORDER BY")
    return b.Sampling(sample.number, sample.per and _key(sample.per, result, names))


_TRACE_NAME: Final = b.TraceAttribute(TRACE_ATTRIBUTES["name"], Type.text)


def _top(top: s.Sample | None, result: b.Result, names: SymbolTable) -> b.Sampling | None:
    """Bind ``LIMIT n PER value``: the first rows for each value."""
    if top is None or top.per is None:
        return None
    per = _key(top.per, result, names)
    rows = result.form == "rows" and not (result.whole or result.framed)
    if not isinstance(per, str) and rows and (result.aggregated or result.distinct):
        names.session.refuse(
            "LIMIT n PER takes what is returned, where it is counted or DISTINCT",
            top.per.span,
            f"name one of: {', '.join(column.name for column in result.columns)}",
        )
    return b.Sampling(top.number, per)


def _check_result(result: b.Result, returns: s.Returns, session: Session) -> None:
    names = [*result.names, *(column.name for column in result.columns)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        session.refuse(f"two results are called '{twice}'", returns.span, "name them with AS")
    listed = result.form != "rows" or result.whole or result.framed
    if result.aggregated and listed:
        hint = "a number for each row is COUNT {(a)-[:near]->(b)} AS n"
        if result.form in {"intervals", "clips"}:
            hint = "frames says how many each has; a value over each is MIN(…) OVER match"
        session.refuse("matches are either counted or listed, not both", returns.span, hint)


# ``CHECK``: rules for whole traces -------------------------------------------------


@dataclass(frozen=True, slots=True)
class CheckInCatalog:
    """Check with the catalog to which it was bound: of the store, or of an abstraction."""

    check: o.BoundCheck
    catalog: Catalog


def bind_checks(
    text: str,
    statements: Sequence[Statement],
    seen: Callable[[Statement], Catalog],
    parameters: Mapping[str, Any],
) -> tuple[CheckInCatalog, ...]:
    """Bind every ``CHECK`` of a text, with the predicates defined before it.

    Parameters
    ----------
    text : str
        Text for messages.
    statements : sequence of Statement
    seen : function
        Function that returns the catalog for a statement.
    parameters : mapping of str to value
        Values of ``$name``.

    Raises
    ------
    QueryError
        No check, or an invalid check. The error has the place.
    """
    found: list[CheckInCatalog] = []
    defined: dict[str, Define] = {}
    used: set[str] = set()
    for statement in statements:
        session = Session(text, parameters, _BINDERS, dict(defined), used=used)
        if isinstance(statement, Define):
            defined[normalize_name(statement.name)] = statement
        elif isinstance(statement, MatchClause | s.UnionClause):
            session.refuse("a MATCH has matches, and no verdict", statement.span, "ask it by find")
        else:
            catalog = seen(statement)
            session.ask(catalog)
            name = statement.name or f"check {len(found) + 1}"
            if name in {one.check.name for one in found}:
                session.refuse(f"two checks are called '{name}'", statement.span)
            found.append(CheckInCatalog(_check(statement, name, session, catalog), catalog))
    session = Session(text, parameters, _BINDERS, used=used)
    if not found:
        session.refuse("nothing is checked", TextSpan(0, len(text)), "add CHECK ALWAYS …")
    refuse_unused(session)
    return tuple(found)


def _check(written: WrittenCheck, name: str, session: Session, catalog: Catalog) -> o.BoundCheck:
    settings = chosen(written.settings, session, catalog)
    session.look_beyond(catalog, world=settings.scope != "graph")
    if settings.policy is not None:
        session.refuse("USING MATCHES belongs to sequences", written.settings[0].span)
    scope = StepScope(session)
    names = SymbolTable(session, scope)
    quantifiers = tuple(_quantifier(one, names, scope) for one in written.quantifiers)
    formula = settled(names.condition(written.formula), session)
    reset = None
    if written.reset is not None:
        reset = settled(names.condition(written.reset), session)
    if written.robustness and settings.end == "weak":
        session.refuse(
            "USING END weak forgives what is due at the end of a trace, and robustness counts it",
            written.span,
            "leave out USING END weak, or ROBUSTNESS; bound the formula: EVENTUALLY[0s, 5s] …",
        )
    returns = _returned(written, names)
    refuse_strange(session, catalog)
    found = o.BoundCheck(
        name,
        replace(scope.finished(), distinct=scope.distinct()),
        quantifiers,
        formula,
        reset,
        frozenset(session.relations),
        session.injective,
        settings.ego,
        settings.unknown_is_false,
        settings.end or "bounded",
        settings.gaps or "break",
        written.robustness,
        returns,
        world=settings.scope != "graph",
        range=settings.range,
    )
    if settings.range is None or _knows_no_more(session.traces, settings.range):
        return found
    ego = b.Node(session.key(None), b.ego_kinds(), "unnamed", written.span)
    return looks_less(replace(found, limit=settings.range), ego)


def _knows_no_more(traces: Iterable[TraceFacts], limit: float) -> bool:
    """True if no trace has data on entities beyond the limit around the ego."""
    return all(one.reach is not None and one.reach.farthest <= limit for one in traces)


def _returned(written: WrittenCheck, names: SymbolTable) -> tuple[b.ReturnColumn, ...]:
    """Bind the values that are returned for each violation."""
    inner = replace(names, over=True)
    found = tuple(_column(item, inner) for item in written.returns)
    taken = [node.name for one in written.quantifiers for node in one.nodes]
    called = [column.name for column in found]
    for item, column in zip(written.returns, found, strict=True):
        if [*taken, *called].count(column.name) > 1:
            reason = f"two results are called '{column.name}'"
            names.session.refuse(reason, item.span, "name them with AS")
        if column.value.type is Type.node:
            hint = "its name, v.name, or a number: v.speed"
            names.session.refuse("a violation has values, not nodes", item.span, hint)
    return found


def _quantifier(
    written: QuantifierClause, names: SymbolTable, scope: StepScope
) -> o.BoundQuantifier:
    session = names.session
    keys: list[str] = []
    for node in written.nodes:
        if node.name in RESERVED or names.meaning(node.name) is not None:
            session.refuse(f"'{node.name}' is bound already", node.span)
        kinds = kinds_of(node.label, session)
        if not kinds:
            session.refuse("no node can have this label", node.span)
        key = scope.add(node.name, kinds, node.span, named=True)
        names.meanings[node.name] = Symbol(node=key)
        keys.append(key)
    where = None
    if written.where is not None:
        where = settled(names.condition(written.where), session)
        if b.is_temporal(where):
            session.refuse(
                "what restricts a quantifier looks at one frame",
                written.where.span,
                "put it into the formula: … IMPLIES …",
            )
    return o.BoundQuantifier(written.word, tuple(keys), where, written.absent)
