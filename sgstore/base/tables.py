"""Tables as dataclasses with one array per column: row selection, concatenation and sorting.

A column is an array or a tuple. Any other field is constant for all rows; concatenation takes it from the first
table.
"""

from __future__ import annotations

from dataclasses import fields
from itertools import chain
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Table = TypeVar("Table")


def taken(table: Table, rows: NDArray[Any]) -> Table:
    """Return selected rows of a table. ``rows`` is an index array or a mask."""
    columns = (getattr(table, name) for name in _names(table))
    return type(table)(*(_taken(column, rows) for column in columns))


def _names(table: Any) -> list[str]:
    return [field.name for field in fields(table)]


def _taken(column: Any, rows: NDArray[Any]) -> Any:
    if isinstance(column, tuple):
        return tuple(column[row] for row in rows.tolist())
    return column[rows] if isinstance(column, np.ndarray) else column


def chained(tables: Sequence[Table]) -> Table:
    """Concatenate the rows of tables of one type."""
    columns = ([getattr(one, name) for one in tables] for name in _names(tables[0]))
    return type(tables[0])(*map(_chained, columns))


def _chained(parts: list[Any]) -> Any:
    if isinstance(parts[0], tuple):
        return tuple(chain(*parts))
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else parts[0]


def ascending(numbers: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the indices that sort non-negative integers; equal integers keep their order."""
    order = np.argsort(numbers.astype(np.uint16), kind="stable")
    for shift in range(16, int(numbers.max(initial=0)).bit_length(), 16):
        digits = (numbers[order] >> shift).astype(np.uint16)
        order = order[np.argsort(digits, kind="stable")]
    return order


def begins(*columns: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the rows that differ from the row before them in at least one column."""
    new = np.ones(len(columns[0]), np.bool_)
    new[1:] = np.logical_or.reduce([column[1:] != column[:-1] for column in columns])
    return new


def spread(
    starts: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Expand index ranges (start, count) into their indices. Also return the range number of each index.

    Returns
    -------
    owner, index : (sum of counts,) intp
        For each range i, ``counts[i]`` times i, and the indices from ``starts[i]`` on.
    """
    owner = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) + (starts - before)[owner]


def components(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find connected nodes. For each of ``count`` nodes, return the smallest node that is connected to it."""
    least = np.arange(count)
    while True:
        before, low = least.copy(), np.minimum(least[one], least[other])
        np.minimum.at(least, least[one], low)
        np.minimum.at(least, least[other], low)
        least = least[least]
        if np.array_equal(before, least):
            return least
