"""Rows as a person wants to read them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sgstore.lang._compile import shown
from sgstore.lang.ir import FRAME_COLUMNS, INTERVAL_COLUMNS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    Rows = Iterable[tuple[Any, ...]]


def for_people(
    columns: tuple[str, ...], rows: Rows, *, graphs: bool
) -> tuple[tuple[str, ...], Rows]:
    """Columns and rows of an answer, shorter.

    Parameters
    ----------
    columns : tuple of str
        As a query gives them.
    rows : iterable of tuple
    graphs : bool
        Whether each row ends in a graph, as ``RETURN SUBGRAPHS`` asks.

    Returns
    -------
    columns, rows
        A frame, and the first one of an interval, as ``trace#seq``, which every command takes; a variable as
        the name of its node; a graph as two texts. What has neither frame nor interval comes as it is.
    """
    if columns[: len(INTERVAL_COLUMNS)] == INTERVAL_COLUMNS:
        return _intervals(columns, rows)
    if columns[: len(FRAME_COLUMNS)] != FRAME_COLUMNS:
        return columns, rows
    width = len(FRAME_COLUMNS)
    rest = columns[width:]
    named = {name.removesuffix(".name") for name in rest if name.endswith(".name")}
    keep = [i for i, name in enumerate(rest) if name not in named]
    called = (rest[i].removesuffix(".name") if _of(rest[i]) in rest else rest[i] for i in keep)

    def lines() -> Iterator[tuple[Any, ...]]:
        for row in rows:
            _, trace, seq, _, t = row[:width]
            values = [row[width + i] for i in keep]
            values[-2:] = shown(*values[-2:]) if graphs else values[-2:]
            yield (f"{trace}#{seq}", round(t, 3), *values)

    return ("frame", "t", *called), lines()


def _of(name: str) -> str | None:
    """The variable whose name a column holds."""
    return name.removesuffix(".name") if name.endswith(".name") else None


def _intervals(columns: tuple[str, ...], rows: Rows) -> tuple[tuple[str, ...], Rows]:
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
