"""Splitting of a ``UNION`` into single queries, and SQL that combines their rows.

Each part is a separate query with its own settings, order and limits. :class:`sgstore.matches.UnionMatches`
joins their answers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

from sgstore.base.quoting import quoted
from sgstore.errors import QueryError, TextSpan
from sgstore.lang.catalog import TRACE_ATTRIBUTES, Type
from sgstore.lang.ir import TraceAttribute
from sgstore.lang.sql._select import Select, nested
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.lang.ir import Result

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class UnionPart:
    """Single query of a ``UNION``, with its parameter values.

    Attributes
    ----------
    text : str
        The whole text, with blanks in place of the other parts, so that positions stay valid.
    values : mapping of str to value
        Values of the parameters that the part uses.
    span : TextSpan
        Position of the part in the text.
    """

    text: str
    values: Mapping[str, Any]
    span: TextSpan


@dataclass(frozen=True, slots=True)
class UnionParts:
    """Single queries of a ``UNION``. ``distinct`` is false for ``UNION ALL``."""

    parts: tuple[UnionPart, ...]
    distinct: bool

    def each(self, find: Callable[[str, Mapping[str, Any]], T], text: str) -> list[T]:
        """Call a function for each query of the union, and return its results as a list.

        Raises
        ------
        QueryError
            A part is invalid, or contains an unknown name.
        """
        try:
            return [find(part.text, part.values) for part in self.parts]
        except QueryError as error:  # the text of the error has blanks in place of the other parts
            reason, span = error.reason, error.span
            raise type(error)(reason, text=text, span=span, hint=error.hint) from None


_UNION: Final = re.compile(r"\bUNION\b", re.IGNORECASE)
_LETTER: Final = re.compile(r"[^\n]")


def union_parts(text: str, values: Mapping[str, Any]) -> UnionParts | None:
    """Return the single queries of a text with ``UNION``; None without ``UNION``.

    Parameters
    ----------
    text : str
    values : mapping of str to value
        Values of the parameters.

    Raises
    ------
    QuerySyntaxError
        The text does not match the grammar.
    QueryError
        The text has another query besides the union, or no part uses a parameter.
    """
    if not _UNION.search(text):  # most texts: they are parsed once
        return None
    statements = parse(text)
    union = next((one for one in statements if isinstance(one, s.UnionClause)), None)
    if union is None:
        return None
    defined = [one for one in statements if isinstance(one, s.Define)]
    other = next((one for one in statements if one is not union and one not in defined), None)
    if other is not None:
        hint = "run a CHECK with check" if isinstance(other, s.CheckClause) else None
        raise QueryError("expected only the UNION", text=text, span=other.span, hint=hint)
    named = [_parameters_of(part, defined) for part in union.parts]
    unused = sorted(set(values).difference(*named))
    if unused:
        hint = f"write a parameter as ${unused[0]}"
        raise QueryError(f"the query has no parameter '{unused[0]}'", hint=hint)
    parts: list[UnionPart] = []
    for part, names in zip(union.parts, named, strict=True):
        chosen = {name: value for name, value in values.items() if name in names}
        parts.append(UnionPart(_alone(text, union.span, part.span), chosen, part.span))
    return UnionParts(tuple(parts), union.distinct)


def _parameters_of(part: s.MatchClause, defined: Iterable[s.Define]) -> set[str]:
    """Return the names of the parameters that a query of a union uses, itself or by its definitions."""
    found, waiting = set(s.parameters_in(part)), {*_called(part)}
    by_name = {normalize_name(one.name): one for one in defined}
    while used := waiting & by_name.keys():
        definition = by_name.pop(used.pop())
        waiting |= {*_called(definition.body)}
        own = isinstance(definition.body, s.SequenceClause)
        formals = {formal.name for formal in definition.parameters} if own else set[str]()
        found |= set(s.parameters_in(definition.body)) - formals
    return found


def _called(part: object) -> Iterator[str]:
    return (
        normalize_name(one.name)
        for one in s.parts_of(part)
        if isinstance(one, s.Call | s.ScenarioStep)
    )


def _alone(text: str, union: TextSpan, part: TextSpan) -> str:
    before = _LETTER.sub(" ", text[union.start : part.start])
    after = _LETTER.sub(" ", text[part.end : union.end])
    return text[: union.start] + before + text[part.start : part.end] + after + text[union.end :]


def joined_rows(
    columns: Sequence[str], tables: Sequence[str], result: Sequence[Result], *, distinct: bool
) -> tuple[Select, bool]:
    """Return SQL that combines the rows of several result tables of a ``UNION``.

    Parameters
    ----------
    columns : sequence of str
        Columns that all tables have. Tables may have other columns, which distinguish rows.
    tables : sequence of str
    result : sequence of Result
        Result clause of each part.
    distinct : bool
        True to remove duplicate rows.

    Returns
    -------
    select : Select
    named : bool
        True if ``$1`` is the list of all trace names, in order.
    """
    parts: list[str] = []
    for number, table in enumerate(tables):
        select = Select(["*"], [quoted(table)])
        if not distinct:
            select.columns += [f'{number} AS ":number"', 'row_number() OVER () AS ":place"']
        parts.append(select.text())
    word = "\nUNION\n" if distinct else "\nUNION ALL\n"
    joined = Select([quoted(name) for name in columns], [nested(word.join(parts), ":parts")])
    first = result[0]
    ordered = any(one.order or one.sample for one in result)
    if not distinct and (ordered or not first.names):
        joined.order = ['":number"', '":place"']
        return joined, False
    # Sorted by trace name with numbers by value, then by time, then by the values.
    named = {one.name for one in first.columns if one.value == _TRACE_NAME}
    named |= {"trace"} & set(first.names)
    told = [name for name in columns if name != "frame_id" or not first.names]
    for name in told:
        place = f"list_position(CAST($1 AS VARCHAR[]), {quoted(name)})"
        joined.order.append(f"{place if name in named else quoted(name)} ASC NULLS LAST")
    return joined, bool(named)


_TRACE_NAME: Final = TraceAttribute(TRACE_ATTRIBUTES["name"], Type.text)


def each_match(statements: Iterable[s.Statement]) -> Iterator[s.Statement]:
    """Yield query statements. Each ``UNION`` is replaced by its single queries."""
    for statement in statements:
        yield from statement.parts if isinstance(statement, s.UnionClause) else (statement,)
