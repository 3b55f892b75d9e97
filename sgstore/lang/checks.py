"""``CHECK``: what must be true of a trace, bound."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sgstore.errors import Span
from sgstore.lang import bound as b
from sgstore.lang import over_time as o
from sgstore.lang.binder import chosen, kinds_of, refuse_strange, refuse_unused
from sgstore.lang.conditions import condition
from sgstore.lang.names import RESERVED, Meaning, Names, Session
from sgstore.lang.steps import StepScope
from sgstore.lang.syntax import Check as WrittenCheck
from sgstore.lang.syntax import Define, Match
from sgstore.lang.tenses import settled
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.syntax import Quantifier, Statement


@dataclass(frozen=True, slots=True)
class BoundCheck:
    """A check with the catalog that it was bound to: of the store, or of the abstraction that it names."""

    check: o.Check
    catalog: Catalog


def bind_checks(
    text: str,
    statements: Sequence[Statement],
    seen: Callable[[Statement], Catalog],
    parameters: Mapping[str, Any],
) -> tuple[BoundCheck, ...]:
    """Every ``CHECK`` of a text, with the predicates that it defines before it.

    Parameters
    ----------
    text : str
        For messages.
    statements : sequence of Statement
    seen : function
        The catalog that a statement is asked of.
    parameters : mapping of str to value
        Values of ``$name``.

    Raises
    ------
    QueryError
        There is none, or one has no meaning; it says where.
    """
    found: list[BoundCheck] = []
    defined: dict[str, Define] = {}
    used: set[str] = set()
    for statement in statements:
        session = Session(text, parameters, dict(defined), used=used)
        if isinstance(statement, Define):
            defined[folded(statement.name)] = statement
        elif isinstance(statement, Match):
            session.refuse("a MATCH has matches, and no verdict", statement.span, "ask it by find")
        else:
            catalog = seen(statement)
            session.ask(catalog)
            name = statement.name or f"check {len(found) + 1}"
            if name in {one.check.name for one in found}:
                session.refuse(f"two checks are called '{name}'", statement.span)
            found.append(BoundCheck(_check(statement, name, session, catalog), catalog))
    session = Session(text, parameters, used=used)
    if not found:
        session.refuse("nothing is checked", Span(0, len(text)), "add CHECK ALWAYS …")
    refuse_unused(session)
    return tuple(found)


def _check(written: WrittenCheck, name: str, session: Session, catalog: Catalog) -> o.Check:
    settings = chosen(written.settings, session, catalog)
    if settings.policy is not None:
        session.refuse("USING MATCHES belongs to sequences", written.settings[0].span)
    scope = StepScope(session)
    names = Names(session, scope)
    quantifiers = tuple(_quantifier(one, names, scope) for one in written.quantifiers)
    formula = settled(condition(written.formula, names), session)
    reset = None
    if written.reset is not None:
        reset = settled(condition(written.reset, names), session)
    refuse_strange(session, catalog)
    return o.Check(
        name,
        replace(scope.finished(), distinct=scope.distinct()),
        quantifiers,
        formula,
        reset,
        frozenset(session.relations),
        session.injective,
        settings.ego,
        settings.unknown_is_false,
        settings.end or "strong",
        settings.gaps or "break",
    )


def _quantifier(written: Quantifier, names: Names, scope: StepScope) -> o.Quantifier:
    session = names.session
    keys: list[str] = []
    for node in written.nodes:
        if node.name in RESERVED or names.meaning(node.name) is not None:
            session.refuse(f"'{node.name}' is bound already", node.span)
        kinds = kinds_of(node.label, session)
        if not kinds:
            session.refuse("no node can have this label", node.span)
        key = scope.add(node.name, kinds, node.span, named=True)
        names.meanings[node.name] = Meaning(node=key)
        keys.append(key)
    where = None
    if written.where is not None:
        where = settled(condition(written.where, names), session)
        if b.is_temporal(where):
            session.refuse(
                "what restricts a quantifier looks at one frame",
                written.where.span,
                "put it into the formula: … IMPLIES …",
            )
    return o.Quantifier(written.word, tuple(keys), where, written.absent)
