"""Result rows of a query in a short form for display."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sgstore.lang.ir import FRAME_COLUMNS, INTERVAL_COLUMNS
from sgstore.lang.sql._subgraphs import graph_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


def for_people(
    columns: tuple[str, ...], rows: Iterable[tuple[Any, ...]], *, graphs: bool
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Return columns and rows of a result in a short form for display.

    Parameters
    ----------
    columns : tuple of str
        Columns of the query.
    rows : iterable of tuple
    graphs : bool
        True if each row ends in a graph, as with ``RETURN SUBGRAPHS``.

    Returns
    -------
    columns, rows
        A frame, or the first frame of an interval, as ``trace#seq``, which every command accepts; a variable
        as the name of its node; a graph as two texts. Rows without frame and interval are unchanged.
    """
    if columns[: len(INTERVAL_COLUMNS)] == INTERVAL_COLUMNS:
        return _intervals(columns, rows)
    if columns[: len(FRAME_COLUMNS)] != FRAME_COLUMNS:
        return columns, rows
    width = len(FRAME_COLUMNS)
    rest = columns[width:]
    named = {name.removesuffix(".name") for name in rest if name.endswith(".name")}
    keep = [i for i, name in enumerate(rest) if name not in named]
    called = (rest[i].removesuffix(".name") if _named(rest[i]) in rest else rest[i] for i in keep)

    def lines() -> Iterator[tuple[Any, ...]]:
        for row in rows:
            _, trace, seq, _, t = row[:width]
            values = [row[width + i] for i in keep]
            values[-2:] = graph_text(*values[-2:]) if graphs else values[-2:]
            yield (f"{trace}#{seq}", round(t, 3), *values)

    return ("frame", "t", *called), lines()


def _named(name: str) -> str | None:
    """If the column is ``v.name``, return ``v``; otherwise None."""
    return name.removesuffix(".name") if name.endswith(".name") else None


def _intervals(
    columns: tuple[str, ...], rows: Iterable[tuple[Any, ...]]
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    width = len(INTERVAL_COLUMNS)
    trace, first, start, end, frames = (
        INTERVAL_COLUMNS.index(name) for name in ("trace", "start_seq", "start", "end", "frames")
    )
    lines = (
        (
            f"{row[trace]}#{row[first]}",
            round(row[start], 3),
            round(row[end], 3),
            row[frames],
            *row[width:],
        )
        for row in rows
    )
    return ("from", "start", "end", "frames", *columns[width:]), lines
