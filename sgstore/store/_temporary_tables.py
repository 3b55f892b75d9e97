"""Temporary SQL tables with rows from outside the store. They exist during one statement.

Rows come block by block. DuckDB moves data beyond the memory limit to temporary files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.quoting import quoted
from sgstore.store._encounters import show_recorded
from sgstore.store._interrupts import interruptible

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection


@dataclass(frozen=True, slots=True)
class GivenTable:
    """Temporary SQL table of rows from outside the store: name, columns and rows.

    Attributes
    ----------
    name : str
        Table name in the statement, different from all store tables.
    types : mapping of str to str
        Database type of each column.
    blocks : function
        Function that returns blocks of columns, in the order of ``types``. Each call starts from the first
        block.
    """

    name: str
    types: Mapping[str, str]
    blocks: Callable[[], Iterable[Sequence[list[Any]]]]


Given = GivenTable | tuple[str, Mapping[str, object]]
"""Temporary table of a statement: its rows, or trusted SQL that creates it, with parameter values."""


def give(connection: DuckDBPyConnection, given: Iterable[Given]) -> None:
    """Create temporary SQL tables that are visible only on one database connection."""
    for table in given:
        if isinstance(table, tuple):
            show_recorded(connection, table[0])
            interruptible(connection, partial(connection.execute, table[0], table[1] or None))
            continue
        columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in table.types.items())
        connection.execute(f"CREATE OR REPLACE TEMP TABLE {quoted(table.name)} ({columns})")
        for block in table.blocks():
            if len(block[0]):
                _insert(connection, quoted(table.name), block, [*table.types.values()])


_BLOCK: Final = ":block"
"""Name under which rows are registered in DuckDB during an insert. User tables cannot have this name."""


def _insert(
    connection: DuckDBPyConnection, name: str, block: Sequence[list[Any]], kinds: Sequence[str]
) -> None:
    """Insert rows into a temporary table, as arrays if their types allow it."""
    arrays = _arrays_of(block, kinds)
    if arrays is None:
        values = ", ".join(f"unnest(CAST(? AS {kind}[]))" for kind in kinds)
        connection.execute(f"INSERT INTO {name} SELECT {values}", list(block))
        return
    connection.register(_BLOCK, arrays)
    try:
        connection.execute(f"INSERT INTO {name} FROM {quoted(_BLOCK)}")
    finally:
        connection.unregister(_BLOCK)


_NUMBERS: Final[Mapping[str, tuple[str, object]]] = {
    "BIGINT": ("i", 0),
    "DOUBLE": ("fi", 0.0),
    "BOOLEAN": ("b", False),
}
"""Database types that DuckDB reads from arrays: type → allowed kinds of array, and the substitute for NULL."""


def _arrays_of(block: Sequence[list[Any]], kinds: Sequence[str]) -> dict[str, Any] | None:
    """Return columns as arrays, because DuckDB reads arrays ten times faster. ``None`` if impossible.

    NaN is unsuitable, because it would become NULL.
    """
    made: dict[str, Any] = {}
    for number, (values, kind) in enumerate(zip(block, kinds, strict=True)):
        if kind == "VARCHAR":
            column: Any = np.empty(len(values), object)
            column[:] = values
        else:
            fits, blank = _NUMBERS.get(kind, ("", None))
            known = np.array([blank if value is None else value for value in values])
            if known.dtype.kind not in fits or np.isnan(known).any():
                return None
            column = np.ma.masked_array(known, [value is None for value in values])
        made[f"column {number}"] = column
    return made
