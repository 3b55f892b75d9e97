"""Binder of ``CHECK`` statements, which are rules for whole traces: resolves names and types."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from sgstore.errors import TextSpan
from sgstore.lang import ir as b
from sgstore.lang.bind._patterns import ALL_BINDERS, kinds_of
from sgstore.lang.bind._queries import chosen, refuse_strange, refuse_unused
from sgstore.lang.bind._results import bind_column
from sgstore.lang.bind._sequences import StepScope
from sgstore.lang.bind._symbols import RESERVED, Session, Symbol, SymbolTable
from sgstore.lang.bind._temporal import refuse_ahead, settled
from sgstore.lang.bind._world_scope import looks_less
from sgstore.lang.catalog import Catalog, Type
from sgstore.lang.syntax import tree as s
from sgstore.lang.syntax.tree import CheckClause as WrittenCheck
from sgstore.lang.syntax.tree import Define, MatchClause
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.syntax.tree import QuantifierClause, Statement


@dataclass(frozen=True, slots=True)
class CheckInCatalog:
    """``CHECK`` statement with resolved names, and the catalog (known names of a store) used for this."""

    check: b.BoundCheck
    catalog: Catalog


def bind_checks(
    text: str,
    statements: Sequence[Statement],
    seen: Callable[[Statement], Catalog],
    parameters: Mapping[str, Any],
) -> tuple[CheckInCatalog, ...]:
    """Resolve the names and types in every ``CHECK`` statement of a text.

    A check can use the predicates defined before it.

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
        session = Session(text, parameters, ALL_BINDERS, dict(defined), used=used)
        if isinstance(statement, Define):
            defined[normalize_name(statement.name)] = statement
        elif isinstance(statement, MatchClause | s.UnionClause):
            session.refuse("a MATCH has matches, not a verdict", statement.span, "run it with find")
        else:
            catalog = seen(statement)
            session.ask(catalog)
            name = statement.name or f"check {len(found) + 1}"
            if name in {one.check.name for one in found}:
                session.refuse(f"two checks have the name '{name}'", statement.span)
            found.append(CheckInCatalog(_check(statement, name, session, catalog), catalog))
    session = Session(text, parameters, ALL_BINDERS, used=used)
    if not found:
        session.refuse("the text contains no CHECK", TextSpan(0, len(text)), "add CHECK ALWAYS …")
    refuse_unused(session)
    return tuple(found)


def _check(written: WrittenCheck, name: str, session: Session, catalog: Catalog) -> b.BoundCheck:
    settings = chosen(written.settings, session, catalog)
    session.look_beyond(catalog, world=settings.scope != "graph")
    session.checks = True
    if settings.policy is not None:
        session.refuse("USING MATCHES is allowed only in sequences", written.settings[0].span)
    scope = StepScope(session)
    names = SymbolTable(session, scope)
    quantifiers = tuple(_quantifier(one, names, scope) for one in written.quantifiers)
    formula = settled(names.condition(written.formula), session)
    refuse_ahead(formula, written.span, names)
    reset = None
    if written.reset is not None:
        reset = settled(names.condition(written.reset), session)
    if written.robustness and settings.end == "weak":
        session.refuse(
            "USING END weak cannot be combined with ROBUSTNESS",
            written.span,
            "remove USING END weak or ROBUSTNESS, or bound the formula: EVENTUALLY[0s, 5s] …",
        )
    returns, having = _returned(written, names)
    refuse_strange(session, catalog)
    found = b.BoundCheck(
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
        having,
        world=settings.scope != "graph",
        range=settings.range,
        doubts=tuple(dict.fromkeys(session.doubts)),
    )
    if settings.range is None or _knows_no_more(session.traces, settings.range):
        return found
    ego = b.Node(session.key(None), b.ego_kinds(), "unnamed", written.span)
    return looks_less(replace(found, limit=settings.range), ego)


def _knows_no_more(traces: Iterable[TraceFacts], limit: float) -> bool:
    """True if no trace has data on entities farther from the ego than the given distance; m."""
    return all(one.reach is not None and one.reach.farthest <= limit for one in traces)


def _returned(
    written: WrittenCheck, names: SymbolTable
) -> tuple[tuple[b.ReturnColumn, ...], b.Bound | None]:
    """Return the columns of a check's ``RETURN`` clause, and its ``HAVING`` condition, with resolved names."""
    inner = replace(names, over=True)
    found = tuple(bind_column(item, inner) for item in written.returns)
    taken = [node.name for one in written.quantifiers for node in one.nodes]
    called = [column.name for column in found]
    for item, column in zip(written.returns, found, strict=True):
        if [*taken, *called].count(column.name) > 1:
            reason = f"two results have the name '{column.name}'"
            names.session.refuse(reason, item.span, "name them with AS")
        if column.value.type is Type.node:
            hint = "return its name, v.name, or a number: v.speed"
            names.session.refuse("a violation has values, not nodes", item.span, hint)
    if written.having is None:
        return found, None
    named = replace(inner, aliases={column.name: column.value for column in found})
    return found, settled(named.condition(written.having), names.session)


def _quantifier(
    written: QuantifierClause, names: SymbolTable, scope: StepScope
) -> b.BoundQuantifier:
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
                "the condition of a quantifier must refer to one frame",
                written.where.span,
                "put it into the formula: … IMPLIES …",
            )
    return b.BoundQuantifier(written.word, tuple(keys), where, written.absent)
