"""SQL of ``HAPPENS name(…)``, which is true if the frame has this recorded event."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal, quoted
from sgstore.lang.sql._select import Select, nested

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.lang.ir import Happened


def happened_rows(happened: Happened) -> str:
    """Return SQL for the frames of a recorded event, with its nodes in the columns ``:0`` and ``:1``."""
    if happened.table:
        return _rows_of_table(happened)
    told, ends = [literal(happened.kind)], ('"node_id"', '"other"')
    ways = [ends, ends[::-1]][
        : 1 + bool(happened.nodes)
    ]  # an event of two nodes is found in either order
    rows: list[str] = []
    for way in ways:
        columns = [f'{end} AS ":{n}"' for n, end in enumerate(way[: len(happened.nodes)])]
        rows.append(Select(['"frame_id"', *columns], ['"events"'], [f'"kind" = {told[0]}']).text())
    return "\nUNION ALL\n".join(rows)


def _rows_of_table(happened: Happened) -> str:
    select = Select(['"u"."frame_id" AS "frame_id"'], [f'{quoted(happened.kind)} AS "u"'])
    for place, name in enumerate(happened.table[: len(happened.nodes)]):
        column = f'"u".{quoted(name)}'
        if name.lower() in {"node_id", "other", "src", "dst"}:
            select.columns.append(f'TRY_CAST({column} AS BIGINT) AS ":{place}"')
            continue
        alias = quoted(f"e{place}")
        on = [f'{alias}."trace_id" = "u"."frame_id" >> 24']
        on.append(f'{alias}."ident" = CAST({column} AS VARCHAR)')
        select.join(f'"entity" AS {alias}', on, "LEFT JOIN")
        select.columns.append(f'{alias}."node_id" AS ":{place}"')
    return select.text()


def happened_text(happened: Happened, frame: str, nodes: Sequence[str]) -> str:
    """Return SQL that is true if a frame has a recorded event that involves the given nodes.

    NULL means that the trace does not record such events.
    """
    where = [f'":e"."frame_id" = {frame}']
    where += [f'":e".":{place}" = {node}' for place, node in enumerate(nodes)]
    there = Select(["1"], [nested(happened_rows(happened), ":e")], where)
    if happened.table:
        return f"EXISTS ({there.text()})"
    told = f"{frame} >> 24 IN ({told_events(happened.kind)})"
    return f"CASE WHEN EXISTS ({there.text()}) THEN TRUE WHEN {told} THEN FALSE END"


def happened_in_frame(happened: Happened) -> str:
    """Return SQL for the nodes of a recorded event in one frame: two columns, NULL for a missing node."""
    told = [f'":{place}"' for place in range(len(happened.nodes))]
    columns = [*told, "NULL", "NULL"][:2]
    rows = nested(happened_rows(happened), ":e")
    return Select(columns, [rows], ['"frame_id" = $1']).text()


EVENT_SCHEMAS: Final = {
    "collision": "CarlaCollisionEvent",
    "lane_invasion": "CarlaLaneInvasionEvent",
}
"""Ends of the schema names of event channels. A trace with such a channel and no messages has no events."""


def told_events(kind: str) -> str:
    """Return SQL for the ids of the traces that record events of a kind.

    They have such an event, or a channel for it.
    """
    events = Select(['"trace_id"'], ['"event"'], [f'"kind" = {literal(kind)}'])
    if kind not in EVENT_SCHEMAS:
        return events.text()
    end = literal(f"%{EVENT_SCHEMAS[kind]}")
    channels = Select(['"trace_id"'], ['"channel"'], [f'"schema" LIKE {end}'])
    return f"{events.text()}\nUNION\n{channels.text()}"


def recorded_events(schemas: Iterable[str]) -> frozenset[str]:
    """Return the kinds of event that recordings with the given message schemas can contain."""
    names = tuple(schemas)
    return frozenset(k for k, end in EVENT_SCHEMAS.items() if any(n.endswith(end) for n in names))
