"""Quoting of SQL names and texts, and detection of SQL statements."""

from __future__ import annotations

import re
from typing import Final

_STATEMENT: Final = re.compile(
    r"(?:\s|--[^\n]*(?:\n|$))*(?:SELECT|WITH|FROM|VALUES|TABLE|DESCRIBE|SHOW|SUMMARIZE|EXPLAIN)\b",
    re.IGNORECASE,
)


def is_statement(text: str) -> bool:
    """Return True if a text is an SQL statement, according to its first word after comments."""
    return _STATEMENT.match(text) is not None


def quoted(name: str) -> str:
    """Return a name as a quoted SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def literal(text: str) -> str:
    """Return a text as a quoted SQL literal."""
    return "'" + text.replace("'", "''") + "'"
