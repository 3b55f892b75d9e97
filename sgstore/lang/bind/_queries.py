"""Binder of queries: resolves the names and types of a ``MATCH`` statement and its settings.

The binder and the parser find all errors of the user, before any SQL is built.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import excerpts
from sgstore.errors import QueryError, TextSpan
from sgstore.lang import ir as b
from sgstore.lang.bind._datasets import asked
from sgstore.lang.bind._expressions import parameter
from sgstore.lang.bind._functions import FUNCTIONS
from sgstore.lang.bind._patterns import ALL_BINDERS, bind_block
from sgstore.lang.bind._renaming import names_returned
from sgstore.lang.bind._results import bind_columns, bind_result
from sgstore.lang.bind._sequences import bind_sequence
from sgstore.lang.bind._stages import StageBinder
from sgstore.lang.bind._symbols import ScopeBuilder, Session, SymbolTable
from sgstore.lang.bind._temporal import settled
from sgstore.lang.bind._topics import tolerance_of
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import entity_kinds, normalize_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.lang.catalog import Catalog


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
    "TOLERANCE",
)
"""Settings allowed after ``USING``."""

SCOPES: Final = ("graph", "world")
"""Scopes of a statement: the graphs only, or all known data."""


def bind_query(
    text: str, statements: Sequence[s.Statement], catalog: Catalog, parameters: Mapping[str, Any]
) -> b.Query:
    """Return the query of a text with one ``MATCH``. Its names are resolved, and its types are known.

    The text may also define predicates.

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
    session = Session(text, parameters, ALL_BINDERS)
    session.ask(catalog)
    match = _only_match(statements, session)
    settings = chosen(match.settings, session, catalog)
    session.look_beyond(catalog, world=settings.scope == "world")
    if settings.end is not None:
        session.refuse("USING END is allowed only in a CHECK", match.settings[0].span)
    if settings.gaps == "unknown":
        session.refuse("USING GAPS unknown is allowed only in a CHECK", match.settings[0].span)
    if settings.range is not None:
        session.refuse("USING RANGE is allowed only in a CHECK", match.settings[0].span)
    query = _of_match(match, session)
    refuse_unused(session)
    refuse_strange(session, catalog)
    session.doubts += [*_merged_names(query, catalog), *_absent_egos(query, catalog)]
    return replace(
        query,
        relations=frozenset(session.relations),
        injective=session.injective,
        ego=settings.ego,
        unknown_is_false=settings.unknown_is_false,
        policy=settings.policy or "all",
        gaps=settings.gaps or "break",
        world=settings.scope == "world",
        doubts=tuple(dict.fromkeys(session.doubts)),
        calls=session.written,
    )


def _merged_names(query: b.Query, catalog: Catalog) -> list[str]:
    """If a query groups by an entity's name or id, return a note: they are unique only in one trace."""
    values = [column.value for column in query.result.columns]
    parts = [part for value in values for part in b.walk(value)]
    grouped = query.result.distinct or any(isinstance(part, b.Aggregate) for part in parts)
    if not grouped or len(catalog.traces) < 2 or query.result.form != "rows":
        return []
    if any(isinstance(part, b.TraceAttribute | b.FrameAttribute) for part in parts):
        return []
    for value in values:
        match value:
            case b.NodeAttribute(node=node, attribute=one) if one.name in {"name", "id"}:
                shown = f"{node}.{one.name}"
            case b.NodeValue(node=node):
                shown = node
            case _:
                continue
        if _is_entity(query, node):
            return [
                f"{shown} is unique only in its trace: entities of several traces merge in a row;"
                " add trace.name"
            ]
    return []


def _absent_egos(query: b.Query, catalog: Catalog) -> list[str]:
    """If braces name an ego, return a note on the traces without one. Their pattern matches nothing there."""
    nodes = (node for scope in query.required for node in scope.nodes.values())
    if any(_is_ego(node) for node in nodes):
        return []  # traces without an ego are left out, with this reason
    values = [value for scope in query.patterns for value in scope.where]
    values += [value for step in query.steps for value in step.when]
    inside = (block.scope for block in b.all_blocks([*values, *query.result.values]))
    if not any(_is_ego(node) for scope in inside for node in scope.nodes.values()):
        return []
    traces = [one for one in catalog.traces if catalog.only is None or one.trace_id in catalog.only]
    names = [one.name for one in traces if not one.ego]
    if not names:
        return []
    said = "trace has no ego" if len(names) == 1 else "traces have no ego"
    return [f"{len(names)} {said}, so (:Ego) in braces matches nothing there: {excerpts(names)}"]


def _is_ego(node: b.Node) -> bool:
    return bool(node.kinds.ego) and not node.kinds.other


def _is_entity(query: b.Query, node: str) -> bool:
    scopes = [query.scope, *(step.scope for step in query.steps)]
    kinds = [scope.kinds(node) for scope in scopes if node in scope.nodes]
    return any(one.every & entity_kinds() for one in kinds)


def _of_match(match: s.MatchClause, session: Session) -> b.Query:
    named = any(path.name for path in match.block.paths)
    if not match.later and not (named and _is_plain(match)):
        return _of_one_step(match, session) if _is_plain(match) else _of_steps(match, session)
    if not _is_plain(match):
        session.refuse(
            "OPTIONAL MATCH and WITH need a pattern of one frame; this is a sequence",
            match.later[0].span,
            "return the values of a step directly; use EXISTS {…} or COUNT {…} for optional parts",
        )
    stages = StageBinder(match, session, bind_block, bind_columns)
    result = stages.result(bind_result(match.returns, stages.names))
    return b.Query(stages.scope(), result, frozenset(), stages=stages.stages())


def _is_plain(match: s.MatchClause) -> bool:
    """True if a query is for single frames: one step without a duration or a name."""
    first = match.sequence.steps[0]
    if len(match.sequence.steps) > 1 or not isinstance(first, s.StepClause):
        return False
    return bool(first.block.paths) and not first.hold and first.name is None


def _of_one_step(match: s.MatchClause, session: Session) -> b.Query:
    """Return the resolved query of a pattern for single frames.

    If it uses other frames, the result is a sequence of one step.
    """
    names = SymbolTable(session, ScopeBuilder(session))
    bind_block(match.block, names)
    result = bind_result(match.returns, names)
    scope = names.scope.finished()  # after RETURN is bound, which may name the ego
    where = tuple(settled(part, session) for part in scope.where)
    when = tuple(part for part in where if b.is_temporal(part))
    if not when and not any(b.is_temporal(value) for value in result.values):
        return b.Query(replace(scope, where=where), result, frozenset())
    still = replace(scope, where=tuple(part for part in where if not b.is_temporal(part)))
    step = b.BoundStep(still, when, None, absent=False, span=match.block.span)
    return b.Query(_told(scope), result, frozenset(), steps=(step,))


def _of_steps(match: s.MatchClause, session: Session) -> b.Query:
    """Return the resolved query of a sequence: steps whose patterns match one after another."""
    returned = names_returned(match.returns)
    found = bind_sequence(match.sequence, session, bind_block, returned)
    names = SymbolTable(session, found.scope(), found.meanings)
    result = bind_result(match.returns, names)
    found.take_in_ego(names.scope)
    steps, ways = tuple(found.steps), tuple(found.ways)
    query = b.Query(_told(names.scope.finished()), result, frozenset(), steps=steps)
    if len(ways) == 1 and ways[0].steps == tuple(range(len(steps))):
        return replace(query, links=ways[0].links)
    return replace(query, alternatives=ways)


def _told(scope: b.Scope) -> b.Scope:
    """Return the nodes and edges that a match reports: those with names, the ego, and nodes of named edges."""
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
                "a CHECK has a verdict, not matches",
                statement.span,
                "run it with check: sgstore check STORE …",
            )
        elif isinstance(statement, s.UnionClause):
            session.refuse(
                "a UNION combines several queries; expected one query here",
                statement.span,
                "run each part separately",
            )
        elif found is not None:
            session.refuse("expected only one MATCH", statement.span, "answers are joined by UNION")
        else:
            found = statement
    if found is None:
        names = [
            d.name for d in session.predicates.values() if isinstance(d.body, s.SequenceClause)
        ]
        hint = f"add MATCH {names[0]}()" if names else "add MATCH …"
        session.refuse("the text contains no query", TextSpan(0, len(session.text)), hint)
    return found


def define(statement: s.Define, session: Session) -> None:
    """Add a predicate or scenario defined in the query text to the known names.

    Duplicate names raise an error.

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
        session.refuse(f"'{statement.name}' is the name of a function", statement.name_span)
    session.predicates[name] = statement


@dataclass(slots=True)
class UsingChoice:
    """Settings from the ``USING`` clauses of a statement, with None for absent settings."""

    ego: str | None = None
    unknown_is_false: bool = False
    policy: str | None = None
    gaps: str | None = None
    end: str | None = None
    scope: str | None = None
    range: float | None = None


def chosen(settings: Sequence[s.Setting], session: Session, catalog: Catalog) -> UsingChoice:
    """Return the settings from the ``USING`` clauses of a statement. The session stores the tolerance.

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
        elif name == "tolerance":
            session.tolerance_ns = tolerance_of(value, setting.span, session)
        elif name == "dataset":
            asked(value, setting.span, session)
        elif name == "abstraction":
            if catalog.under(value) is None:
                hint = None if catalog.sets else "the store has none; run sgstore derive"
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
    """Store a ``USING`` setting. Its value is one of a few fixed words, as in ``NODES any``."""
    name, word = normalize_name(setting.name), value.lower()
    if word not in _CHOICES[name]:
        session.unknown(f"value of {setting.name}", value, setting.span, _CHOICES[name])
    match name:
        case "nodes":
            session.injective = word == "distinct"
        case "unknown":
            found.unknown_is_false, session.strict = True, False
        case "matches":
            found.policy = word
        case "gaps":
            found.gaps = word
        case "scope":
            found.scope = word
        case _:
            found.end = word


def _metres(value: str, setting: s.Setting, session: Session) -> float:
    """Return the distance of ``USING RANGE``: a check uses only entities within it; m."""
    try:
        metres = float(value)
    except ValueError:
        metres = -1.0
    if not 0 <= metres < math.inf:
        session.refuse(
            f"USING RANGE {value} is not a distance", setting.span, "metres: USING RANGE 200"
        )
    return metres


def _setting_value(setting: s.Setting, session: Session) -> str:
    if isinstance(setting.value, str):
        return setting.value
    return str(parameter(setting.value, SymbolTable(session, ScopeBuilder(session))))


def refuse_unused(session: Session) -> None:
    """Raise an error if the caller passes a query parameter that the query does not use."""
    unused = sorted(set(session.parameters) - session.used)
    if unused:
        name, hint = unused[0], f"write a parameter as ${unused[0]}"
        if name == "limit":
            hint = "for fewer rows write LIMIT in the query, or call .limit(n) on its matches"
        raise QueryError(f"the query has no parameter '{name}'", hint=hint)


def refuse_strange(session: Session, catalog: Catalog) -> None:
    """Raise an error if the query uses a relation that does not exist in the abstraction."""
    if catalog.relations is None:
        return
    strange = sorted(session.relations - catalog.relations)
    if strange:
        raise QueryError(
            f"the abstraction {catalog.name!r} has no relation '{strange[0]}'",
            hint=f"it has: {', '.join(sorted(catalog.relations)) or 'none'}",
        )
