"""Reader of user input: a pattern name, a query, a check or a formula."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError
from sgstore.lang.library._entries import patterns
from sgstore.lang.library._search import pattern_named

if TYPE_CHECKING:
    from collections.abc import Mapping

_NAME: Final = re.compile(r"\s*(\w+)\s*;?\s*")
_FIRST_WORD: Final = re.compile(r"(?:\s|--[^\n]*(?:\n|$))*(\w*)")
_STATEMENTS: Final = ("CHECK", "MATCH", "DEFINE", "USING", "OPTIONAL", "UNION", "RETURN", "WHERE")
_SQL: Final = ("SELECT", "WITH", "FROM", "DESCRIBE", "SHOW", "SUMMARIZE", "PIVOT", "VALUES")


def statement(
    text: str, values: Mapping[str, object], *, check: bool = False
) -> tuple[str, Mapping[str, object]]:
    """Return the user's text as a statement, and the values of its parameters.

    Parameters
    ----------
    text : str
        A query or checks; or the name of a pattern in the library.
    values : mapping of str to value
        Values of ``$name``, or of the parameters of the named pattern.
    check : bool
        True to read a formula such as ``ALWAYS ego.speed < 14`` as a check.

    Raises
    ------
    QueryError
        The name is unknown, or is that of a condition.

    Examples
    --------
    >>> from sgstore.lang.library import statement
    >>> statement("ALWAYS ego.speed < $most", {"most": 14}, check=True)
    ('CHECK ALWAYS ego.speed < $most', {'most': 14})
    """
    first = first_word(text)
    if first in _STATEMENTS:
        return text, values
    if (name := _NAME.fullmatch(text)) is not None:
        found = pattern_named(name[1], check=check)
        if found.kind == "predicate":
            hint = f"write it after WHERE: MATCH … WHERE {found.name}(…)"
            raise QueryError(f"{found.name} is a condition", hint=hint)
        return found.written(**values), {}
    if check and first and first not in _SQL:
        return f"CHECK {text}", values
    return text, values


def first_word(text: str) -> str:
    """Return the first word of a text in capitals. Comments are skipped. Without a word, return ""."""
    found = _FIRST_WORD.match(text)
    return "" if found is None else found[1].upper()


def require_sql(text: str) -> None:
    """Raise an error if a text is not SQL, but a query, a check or a pattern name.

    Raises
    ------
    QueryError
        The message gives the right verb.
    """
    name = _NAME.fullmatch(text)
    if first_word(text) in _STATEMENTS or (name is not None and name[1] in patterns()):
        verb = "check" if first_word(text) == "CHECK" else "find"
        hint = f"use {verb}; in SQL, a pattern is a table: FROM sgql('MATCH … RETURN …')"
        raise QueryError("this is a statement of the query language, not SQL", hint=hint)
