"""Answers as they are read in a prompt: few characters, and nothing left out that is not told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.display import cell

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MOST: Final = 30_000
"""Characters of rows in one answer; some ten thousand tokens."""

LONGEST: Final = 400
"""Characters of one value; of a query more than a table of a notebook has room for."""


def rows_text(reply: Mapping[str, Any]) -> str:
    """Rows as lines with ``|`` between the values, and what has to be known of them.

    Parameters
    ----------
    reply : mapping
        ``columns``, ``rows``, ``truncated``; ``notes`` and ``left_out`` where there are any.
    """
    rows = reply["rows"]
    lines, shown = _lines(reply["columns"], rows)
    told = lines if rows else ["nothing"]
    if shown < len(rows):
        told.append(
            f"({shown} of {len(rows)} rows: more have no room in an answer; return less of each)"
        )
    elif reply["truncated"]:
        told.append(
            f"(the first {len(rows)} rows; there are more: raise limit, count, or narrow it)"
        )
    return "\n".join([*told, *remarks(reply)])


def _lines(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> tuple[list[str], int]:
    """A head and as many rows as have room; and how many these are."""
    lines = [" | ".join(columns)]
    left = MOST
    for number, row in enumerate(rows):
        line = " | ".join(cell(value, LONGEST) for value in row)
        left -= len(line) + 1
        if left < 0 and number:
            return lines, number
        lines.append(line)
    return lines, len(rows)


def remarks(reply: Mapping[str, Any]) -> list[str]:
    """Sentences on the traces that cannot answer, and on what may be a mistake."""
    of: dict[str, list[str]] = {}
    for name, reason in reply.get("left_out", {}).items():
        of.setdefault(reason, []).append(name)
    left_out = [f"(cannot answer: {', '.join(names)}: {reason})" for reason, names in of.items()]
    return [*left_out, *(f"(note: {note})" for note in reply.get("notes", ()))]
