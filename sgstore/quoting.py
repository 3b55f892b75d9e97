"""Names and texts as they stand in SQL, and what is SQL."""

from __future__ import annotations

import re
from typing import Final

_STATEMENT: Final = re.compile(
    r"(?:\s|--[^\n]*(?:\n|$))*(?:SELECT|WITH|FROM|VALUES|TABLE|DESCRIBE|SHOW|SUMMARIZE|EXPLAIN)\b",
    re.IGNORECASE,
)


def is_statement(text: str) -> bool:
    """Tell a statement of SQL from a query, by the first word behind comments."""
    return _STATEMENT.match(text) is not None


def quoted(name: str) -> str:
    """An identifier."""
    return '"' + name.replace('"', '""') + '"'


def literal(text: str) -> str:
    """A text between its quotation marks."""
    return "'" + text.replace("'", "''") + "'"
