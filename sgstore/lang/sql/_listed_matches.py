"""Queries for the matches behind the rows of a result. They return the same rows, with nodes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang.ir import (
    Bound,
    GroupKey,
    NodeValue,
    ReturnColumn,
    Sampling,
    SortKey,
    with_operands,
)
from sgstore.lang.sql._known_matches import TO
from sgstore.lang.sql._results import with_bindings

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.lang.ir import Query, Result

_ENDS: Final = {"trace": "trace", "seq": "end_seq", "time_ns": "end_ns", "t": "end"}
"""Column of the last frame of a row → column of an interval. The frame of a sequence row is its last frame."""


def listed_matches(query: Query) -> Query | None:
    """Return a query for the same rows in the same order, with columns for the nodes of each match.

    The values of ``RETURN`` are numbered (``:0 speed``), so that no name occurs twice. The matches of a
    sequence are intervals.

    Returns
    -------
    Query or None
        ``None`` if a row stands for several matches, or for a clip.
    """
    result = query.result
    if result.groups or result.form == "clips":
        return None
    result = _numbered(result)
    bound = with_bindings(query).result.columns
    if result.form == "intervals":
        own = {
            column.value.node for column in result.columns if isinstance(column.value, NodeValue)
        }
        bound = tuple(one for one in bound if one.name.removesuffix(".name") in own)
        result = replace(result, columns=(*bound, *result.columns))
    elif query.spans:
        result = _as_intervals(result, bound)
    elif not result.framed:
        result = replace(result, whole=True)
    return replace(query, result=result)


def _numbered(result: Result) -> Result:
    """Return a result whose columns have a number before their name, such as ``:0 speed``."""
    names = {
        column.name: f":{number} {column.name}" for number, column in enumerate(result.columns)
    }

    def renamed(value: Bound) -> Bound:
        if isinstance(value, GroupKey):
            return replace(value, name=names.get(value.name, value.name))
        return with_operands(value, renamed)

    return _with_keys(
        replace(
            result.changed(renamed),
            columns=tuple(replace(one, name=names[one.name]) for one in result.columns),
        ),
        lambda key: names.get(key, key) if isinstance(key, str) else key,
    )


def _as_intervals(result: Result, bound: tuple[ReturnColumn, ...]) -> Result:
    """Return a result of intervals instead of rows. Keys for sorting and sampling become columns."""
    keys = dict[Bound, str]()

    def named(key: Bound | str) -> str:
        if isinstance(key, str) and key != "frame_id":
            return _ENDS.get(key, key)
        value = TO if isinstance(key, str) else key
        return keys.setdefault(value, f":key{len(keys)}")

    result = _with_keys(result, named)
    columns = (*bound, *result.columns, *(ReturnColumn(name, key) for key, name in keys.items()))
    return replace(
        result, form="intervals", columns=columns, whole=False, framed=False, distinct=False
    )


def _with_keys(result: Result, change: Callable[[Bound | str], Bound | str]) -> Result:
    """Return a result in which a function has replaced the keys for sorting and sampling."""

    def each(one: Sampling | None) -> Sampling | None:
        return one if one is None or one.per is None else replace(one, per=change(one.per))

    order = tuple(SortKey(change(key.value), key.descending) for key in result.order)
    return replace(result, order=order, sample=each(result.sample), top=each(result.top))
