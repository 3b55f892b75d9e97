"""Tables and pictures as HTML for notebooks, and tables as text.

Texts from recordings are escaped, so they cannot add tags, styles or scripts to the page.
"""

from __future__ import annotations

import base64
import json
import math
from html import escape
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

IN_NOTEBOOK: Final = 20
"""Number of result rows that a notebook shows."""

LONGEST: Final = 200
"""Largest length of a value in a table cell; characters."""

_CELL: Final = "text-align:{align};padding:0.15em 0.8em;white-space:pre-wrap"


def cell(value: Any, longest: int = LONGEST) -> str:
    """Format a value as one line of text with at most ``longest`` characters."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else str(value)
    text = json.dumps(value, ensure_ascii=False) if isinstance(value, list | dict) else str(value)
    text = "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def number_of(number: int, what: str, more: str = "s") -> str:
    """Return a number and a noun as text. ``more`` is the ending of the plural.

    >>> number_of(1, "frame"), number_of(2000, "frame"), number_of(2, "match", "es")
    ('1 frame', '2,000 frames', '2 matches')
    """
    return f"{number:,} {what}{'' if number == 1 else more}"


def text_table(columns: Sequence[str], rows: Sequence[Sequence[Any]], below: str = "") -> str:
    """Return a table as lines of text, with a text below it. Numbers are right-aligned."""
    texts = [[str(name) for name in columns], *([cell(value) for value in row] for row in rows)]
    width = [max(map(len, column)) for column in zip(*texts, strict=True)]
    right = [all(isinstance(v, int | float) for v in column) for column in zip(*rows, strict=True)]
    right = right or [False] * len(width)
    texts.insert(1, ["─" * size for size in width])
    lines = [
        "  ".join(
            text.rjust(size) if numbers else text.ljust(size)
            for text, size, numbers in zip(line, width, right, strict=True)
        ).rstrip()
        for line in texts
    ]
    return "\n".join([*lines, below] if below else lines)


def html_table(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = "", below: str = ""
) -> str:
    """Return an HTML table with a caption above it and a text below it.

    Parameters
    ----------
    columns : sequence of str
    rows : iterable of sequences
        Plain values. Numbers are right-aligned.
    caption, below : str
        Plain texts. An empty text is omitted.
    """
    lines = [f"<p style='margin:0.3em 0'>{escape(caption)}</p>"] if caption else []
    if columns:
        head = "".join(_html_cell("th", name) for name in columns)
        body = "".join(f"<tr>{''.join(_html_cell('td', v) for v in row)}</tr>" for row in rows)
        lines.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
    lines += [f"<p style='margin:0.3em 0'>{escape(below)}</p>"] if below else []
    return f"<div>{''.join(lines)}</div>"


def _html_cell(tag: str, value: Any) -> str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    style = _CELL.format(align="right" if number else "left")
    return f"<{tag} style='{style}'>{escape(cell(value))}</{tag}>"


def html_media(data: bytes, kind: str, text: str = "") -> str:
    """Return HTML with an embedded picture or video, and a text below it.

    Parameters
    ----------
    data : bytes
        The content of a file.
    kind : str
        ``image/png``, ``video/mp4``, …
    text : str
        Plain text. An empty text is omitted.
    """
    source = f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
    shown = f"<img src='{source}' alt='{escape(text, quote=True)}'>"
    if kind.startswith("video/"):
        shown = f"<video src='{source}' controls loop muted></video>"
    said = f"<figcaption>{escape(text)}</figcaption>" if text else ""
    style = "display:inline-block;margin:0.3em 0.6em 0.3em 0"
    return f"<figure style='{style}'>{shown}{said}</figure>"


STORE_TEXT: Final = 80
"""Largest length of a text from a store in a message; characters."""


def excerpt(text: Any) -> str:
    """Shorten a text of a store for a message, to one line of at most :data:`STORE_TEXT` characters."""
    return cell(str(text)[: 4 * STORE_TEXT], STORE_TEXT)


def excerpts(names: Sequence[str], most: int = 8) -> str:
    """Return names of a store as text for a message: the first few, and the number of the others."""
    return first_of([*map(excerpt, names[:most]), *names[most:]], most)


def first_of(names: Sequence[str], most: int) -> str:
    """Return the first names of a list as text, with the number of the others: ``a, b and 3 more``."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"
