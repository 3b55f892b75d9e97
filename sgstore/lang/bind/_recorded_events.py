"""Binder of ``HAPPENS name(…)``, the test for a recorded event."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._functions import FUNCTIONS
from sgstore.lang.library import predicates
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import EVENT_KINDS, entity_kinds, normalize_name, relation_named

if TYPE_CHECKING:
    from sgstore.lang.bind._symbols import SymbolTable
    from sgstore.lang.catalog import TableFacts


def happens(e: s.HappensExpression, names: SymbolTable) -> b.Happened:
    """Return the resolved ``HAPPENS``: a test for an event in the recording or in a user table.

    Raises
    ------
    QueryNameError
        Unknown event kind and unknown table.
    QueryError
        Wrong number or kind of nodes.
    """
    session, wanted = names.session, normalize_name(e.kind)
    kind = next((one for one in EVENT_KINDS if normalize_name(one) == wanted), None)
    table = session.tables.get(e.kind)
    if table is None and kind is None:
        session.unknown("event", e.kind, e.kind_span, (*EVENT_KINDS, *session.tables), _no_event(e))
    nodes = tuple(_to_whom(e, argument, names) for argument in e.arguments)
    if len(set(nodes)) < len(nodes):
        session.refuse("an event between two nodes needs two different nodes", e.span)
    if table is not None:
        return b.Happened(table.name, nodes, _columns_of(table, e, names))
    assert kind is not None  # noqa: S101 - it was refused above
    if len(nodes) > EVENT_KINDS[kind]:
        most = {0: "to no node, only the frame", 1: "to one node", 2: "to two nodes at most"}
        session.refuse(
            f"{kind} happens {most[EVENT_KINDS[kind]]}, found {len(nodes)}",
            e.span,
            f"write HAPPENS {kind}({', '.join('ev'[: EVENT_KINDS[kind]])})",
        )
    return b.Happened(kind, nodes)


def _no_event(e: s.HappensExpression) -> str | None:
    """If an unknown event name is a predicate, relation or function, return a hint; otherwise None."""
    word = normalize_name(e.kind)
    if word in predicates() or relation_named(e.kind) or word in map(normalize_name, FUNCTIONS):
        called = ", ".join(a.name if isinstance(a, s.Variable) else "a" for a in e.arguments)
        how = (
            f"EXISTS {{(a)-[:{e.kind}]->(b)}}" if relation_named(e.kind) else f"{e.kind}({called})"
        )
        return f"it is not a recorded event, but a condition: {how}"
    return None


def _to_whom(e: s.HappensExpression, argument: s.Expression, names: SymbolTable) -> str:
    """Return the key of the pattern node that an argument of ``HAPPENS`` names."""
    found = names.bind(argument)
    if not isinstance(found, b.NodeValue):
        names.session.refuse(
            f"{e.kind} happens to nodes, but this is a {found.type.value}",
            argument.span,
            f"write HAPPENS {e.kind}(v)",
        )
    kinds = names.scope.kinds(found.node).every
    if not kinds & entity_kinds():
        names.session.refuse(
            f"{e.kind} happens to entities, but this is a {' or '.join(sorted(kinds))}",
            argument.span,
        )
    return found.node


_WHOM: Final = (("node_id", "other"), ("ident", "other_ident"), ("src", "dst"))
"""Columns of a user table with the entities of an event: node ids, or simulator ids."""


def _columns_of(table: TableFacts, e: s.HappensExpression, names: SymbolTable) -> tuple[str, ...]:
    """Return the columns of a user table that have the entities of an event.

    Without entities, return one empty name.
    """
    if not table.joins:
        names.session.refuse(
            f"the rows of {table.name} do not refer to frames",
            e.kind_span,
            "it needs frame_id, or trace and one of seq, time_ns, t",
        )
    if len(e.arguments) > len(_WHOM[0]):
        names.session.refuse(f"{table.name} happens to two nodes at most", e.span)
    there = {name.lower(): name for name in table.columns}
    for known in _WHOM:
        chosen = known[: len(e.arguments)]
        if all(name in there for name in chosen):
            return tuple(there[name] for name in chosen) or ("",)
    return names.session.refuse(
        f"{table.name} does not name the nodes: it lacks the column"
        f" {' or '.join(' and '.join(known[: len(e.arguments)]) for known in _WHOM)}",
        e.span,
        f"for the frame write HAPPENS {e.kind}()",
    )
