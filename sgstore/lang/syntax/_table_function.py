"""In SQL, replace ``sgql('MATCH …')`` (matches) and ``topic('/imu')`` (messages) by tables.

The SQL statement is not parsed. Texts, quoted names and comments are skipped, so only real calls are found.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NoReturn

from sgstore.base.quoting import quoted
from sgstore.errors import QueryError, TextSpan

if TYPE_CHECKING:
    from collections.abc import Collection


@dataclass(frozen=True, slots=True)
class PatternTable:
    """Call ``sgql(…)`` in SQL: the text of its query, and the values of the query parameters.

    Attributes
    ----------
    name : str
        Name of the table that replaces the call.
    text : str
        Text of the query.
    values : tuple of (str, value)
        Values of the query parameters by name.
    """

    name: str
    text: str
    values: tuple[tuple[str, Any], ...]


_TEXT: Final = r"'(?:[^']|'')*'"
_DOLLARS: Final = r"\$(?P<tag>[A-Za-z_]\w*|)\$.*?\$(?P=tag)\$"
_BLANK: Final = re.compile(r"(?:\s+|--[^\n]*|/\*.*?\*/)*", re.DOTALL)
_PART: Final = re.compile(
    rf"""\be'(?:[^'\\]|\\.|'')*'|{_TEXT}|"(?:[^"]|"")*"|{_DOLLARS}|--[^\n]*|/\*.*?\*/"""
    r"|(?P<call>(?<![\w.\"])(?P<of>sgql|topic)\s*\()",
    re.DOTALL | re.IGNORECASE,
)
_VALUE: Final = re.compile(
    rf"(?P<text>{_TEXT})|{_DOLLARS}|(?P<number>[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)\b|(?P<word>true|false)\b",
    re.DOTALL | re.IGNORECASE,
)
_NAME: Final = re.compile(r"([A-Za-z_]\w*)\s*(?::=|=>|=)")
_OF_TOPIC: Final = "SELECT * FROM topic('/imu')"
_EXAMPLE: Final = "SELECT * FROM sgql('MATCH (e:Ego) RETURN FRAMES')"


def pattern_tables(sql: str, taken: Collection[str] = ()) -> tuple[str, tuple[PatternTable, ...]]:
    """Replace each ``sgql('MATCH …')`` in SQL by a table name. Return the new SQL, and the calls.

    Parameters
    ----------
    sql : str
    taken : collection of str
        Names that these tables must not have.

    Raises
    ------
    QueryError
        A call is not ``sgql('…')`` or ``sgql('…', name := value)``. The error has the place.
    """
    found: dict[tuple[str, tuple[tuple[str, Any], ...]], PatternTable] = {}
    parts: list[str] = []
    end = 0
    for call in _PART.finditer(sql):
        if (call["of"] or "").lower() != "sgql" or call.start() < end:
            continue
        arguments = _Arguments(sql, call.start(), call.end())
        text, values = arguments.read()
        table = found.get((text, values))
        if table is None:
            table = PatternTable(_free(taken, len(found)), text, values)
            found[text, values] = table
        parts += [sql[end : call.start()], quoted(table.name)]
        end = arguments.at
    return "".join([*parts, sql[end:]]), tuple(found.values())


TOPIC: Final = ":topic"
"""Prefix of the name of a view with the messages of a topic."""


def topic_tables(sql: str) -> str:
    """Replace each call such as ``topic('/imu')`` in SQL by the name of a view, and return the new SQL.

    Raises
    ------
    QueryError
        A call is not ``topic('…')``. The error has the place.

    Examples
    --------
    >>> topic_tables("SELECT x FROM topic('/imu')")
    'SELECT x FROM ":topic /imu"'
    """
    parts: list[str] = []
    end = 0
    for call in _PART.finditer(sql):
        if (call["of"] or "").lower() == "topic" and call.start() >= end:
            arguments = _Arguments(sql, call.start(), call.end())
            parts += [sql[end : call.start()], quoted(f"{TOPIC} {arguments.topic()}")]
            end = arguments.at
    return "".join([*parts, sql[end:]])


def topics_in_sql(sql: str) -> list[str]:
    """Return the topics that an SQL statement reads as views, without duplicates.

    Examples
    --------
    >>> topics_in_sql(topic_tables("SELECT x FROM topic('/imu')"))
    ['/imu']
    """
    return [name.replace('""', '"') for name in dict.fromkeys(_VIEW.findall(sql))]


_VIEW: Final = re.compile(rf'"{TOPIC} ((?:[^"]|"")+)"')


def _free(taken: Collection[str], number: int) -> str:
    """Return an unused table name for a call of ``sgql`` in SQL. The first table is named ``sgql``."""
    name = f"sgql {number + 1}" if number else "sgql"
    while name in taken:
        name += "_"
    return name


class _Arguments:
    """Reader of the arguments in ``sgql(…)`` in SQL. It stops after the closing bracket.

    Parameters
    ----------
    sql : str
    start, at : int
        Start of the call, and start of its arguments.
    """

    def __init__(self, sql: str, start: int, at: int) -> None:
        self.sql, self.start, self.at = sql, start, at

    def read(self) -> tuple[str, tuple[tuple[str, Any], ...]]:
        """Return the query text and the parameter values of a ``sgql(…)`` call."""
        first = self._next()
        text = self._value()
        if not isinstance(text, str):
            self._refuse("sgql() takes a query in quotes", first, _EXAMPLE)
        values: list[tuple[str, Any]] = []
        while self._sign() == ",":
            self.at += 1
            values.append(self._named())
        if self._sign() != ")":
            hint = "double a quote within the text: 'x.name = ''bus'''; or write $$MATCH …$$"
            self._refuse("expected ',' or ')' after the query", self.at, hint)
        self.at += 1
        return text, tuple(values)

    def topic(self) -> str:
        """Return the name in a ``topic(…)`` call."""
        first = self._next()
        name = self._value()
        if not isinstance(name, str) or not name or self._sign() != ")":
            self._refuse("topic() takes the name of a topic in quotes", first, _OF_TOPIC)
        self.at += 1
        return name

    def _next(self) -> int:
        found = _BLANK.match(self.sql, self.at)
        self.at = found.end() if found else self.at
        return self.at

    def _sign(self) -> str:
        return self.sql[self._next() : self.at + 1]

    def _named(self) -> tuple[str, Any]:
        name = _NAME.match(self.sql, self._next())
        if name is None:
            self._refuse(
                "expected the name of a parameter before the value",
                self.at,
                "sgql('… WHERE e.speed > $least', least := 10)",
            )
        self.at = name.end()
        first = self._next()
        value = self._list() if self._sign() == "[" else self._value()
        if value is None:
            self._refuse(
                "expected a number, a text, true or false, or a list of these", first, None
            )
        return name[1], value

    def _list(self) -> tuple[Any, ...]:
        items: list[Any] = []
        self.at += 1
        while self._sign() != "]":
            first = self._next()
            item = self._value()
            if item is None:
                self._refuse("a list holds numbers, texts, true and false", first, None)
            items.append(item)
            if self._sign() == ",":
                self.at += 1
        self.at += 1
        return tuple(items)

    def _value(self) -> Any:
        """If the next argument of ``sgql(…)`` is a constant, return its value; otherwise None."""
        found = _VALUE.match(self.sql, self._next())
        if found is None:
            return None
        self.at = found.end()
        if found["number"]:
            number = float(found["number"])
            return int(found["number"]) if found["number"].lstrip("+-").isdigit() else number
        if found["word"]:
            return found["word"].lower() == "true"
        if found["text"]:
            return found["text"][1:-1].replace("''", "'")
        mark = len(found["tag"]) + 2
        return found[0][mark:-mark]

    def _refuse(self, reason: str, at: int, hint: str | None) -> NoReturn:
        end = min(max(at + 1, self.start), len(self.sql))
        raise QueryError(reason, text=self.sql, span=TextSpan(self.start, end), hint=hint)
