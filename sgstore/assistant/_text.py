"""Answers as they are read in a prompt: few characters, and nothing left out that is not told."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Final

from sgstore.files import without_controls

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MOST: Final = 30_000
"""Characters of rows in one answer; some ten thousand tokens."""

LONGEST: Final = 400
"""Characters of one value."""


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
        line = " | ".join(map(cell, row))
        left -= len(line) + 1
        if left < 0 and number:
            return lines, number
        lines.append(line)
    return lines, len(rows)


def cell(value: Any) -> str:
    """A value on one line."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else str(value)
    text = json.dumps(value, ensure_ascii=False) if isinstance(value, list | dict) else str(value)
    text = without_controls(" ".join(text.split()))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"


def remarks(reply: Mapping[str, Any]) -> list[str]:
    """Sentences on the traces that cannot answer, and on what may be a mistake."""
    of: dict[str, list[str]] = {}
    for name, reason in reply.get("left_out", {}).items():
        of.setdefault(reason, []).append(name)
    left_out = [f"(cannot answer: {', '.join(names)}: {reason})" for reason, names in of.items()]
    return [*left_out, *(f"(note: {note})" for note in reply.get("notes", ()))]


def finite(value: Any) -> Any:
    """A value without the numbers that JSON has not: infinity and NaN become ``None``."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return [finite(item) for item in value] if isinstance(value, list | tuple) else value  # pyright: ignore[reportUnknownVariableType]
