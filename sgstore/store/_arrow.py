"""Results of SQL statements as Arrow tables and batches. The package pyarrow is optional."""

from __future__ import annotations

import re
from importlib import import_module
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.errors import MissingExtraError
from sgstore.store._interrupts import interruptible

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from duckdb import DuckDBPyConnection

    Parameters = Sequence[object] | Mapping[str, object]
    ArrowStream = tuple[list[tuple[str, str]], Iterator[Any]]
    """Names and types of columns, with an iterator over batches of rows."""


def table_of(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Any:
    """Run an SQL statement, and return its rows as a ``pyarrow.Table``. Enumeration values are texts.

    ``None`` means that a column is not a number, truth value or text; the statement does not run. Arrow and
    Python values of other types differ.
    """

    def step() -> Any:
        relation: Any = connection.sql(sql, params=parameters or None)
        return relation.to_arrow_table() if is_plain(relation) else None

    table = interruptible(connection, step)
    if table is None:
        return None
    arrow = package("pyarrow")
    columns = [
        column.cast(arrow.string()) if arrow.types.is_dictionary(column.type) else column
        for column in table.columns
    ]
    return arrow.table(columns, names=table.column_names)


def is_plain(relation: Any) -> bool:
    kinds = (str(kind) for kind in relation.types)
    return all(kind in ARROW_TYPES or _ENUM.fullmatch(kind) for kind in kinds)


def as_told(
    tables: Sequence[Any], columns: Sequence[str] | None = None, most: int | None = None
) -> Any:
    """Concatenate Arrow tables, with all integers as int64 and all floats as float64.

    Parameters
    ----------
    tables : sequence of pyarrow.Table
        At least one table; all with the same columns.
    columns : sequence of str, optional
        New column names.
    most : int, optional
        Largest number of rows.
    """
    arrow = package("pyarrow")
    table = arrow.concat_tables(tables).slice(0, most)
    wide = {arrow.int32(): arrow.int64(), arrow.float32(): arrow.float64()}
    columns_told = (  # shortest text of a float32, as in Python
        column.cast(arrow.string()) if column.type == arrow.float32() else column
        for column in table.columns
    )
    arrays = [
        arrow.nulls(len(column))
        if column.null_count == len(column)
        else column.cast(wide.get(kind, kind))
        for column, kind in zip(columns_told, table.schema.types, strict=True)
    ]
    return arrow.table(arrays, names=list(columns or table.column_names))


ARROW_TYPES: Final = {
    "BIGINT": "int64",
    "INTEGER": "int32",
    "DOUBLE": "float64",
    "FLOAT": "float32",
    "BOOLEAN": "bool_",
    "VARCHAR": "string",
}
"""Database type → name of the pyarrow function for the type. Other types are inferred from the values."""


_ENUM: Final = re.compile(r"ENUM\(('([^']|'')*'(, )?)*\)")


_EXTRAS: Final = {
    "pyarrow": ("tables of Arrow", "arrow"),
    "pandas": ("data frames", "pandas"),
    "polars": ("data frames of polars", "polars"),
}
"""Optional packages: name → purpose, and the ``pip`` extra that installs the package."""


def package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(*_EXTRAS[name]) from error


ROWS_AT_ONCE: Final = 50_000
"""Rows written at once. The first such rows determine unspecified column types."""


def record_batches(
    connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None
) -> ArrowStream | None:
    """Run an SQL statement, and return its columns and an iterator of Arrow batches.

    ``None`` means that pyarrow is missing, or a column is not plain (:func:`table_of`); the statement does not
    run.
    """
    try:
        package("pyarrow")
    except MissingExtraError:
        return None

    def begun() -> Any:
        relation: Any = connection.sql(sql, params=parameters or None)
        if not is_plain(relation):
            return None, ()
        begin = getattr(relation, "to_arrow_reader", None) or relation.fetch_record_batch
        return begin(ROWS_AT_ONCE), list(
            zip(relation.columns, map(str, relation.types), strict=True)
        )

    def more() -> Any:
        try:
            return next(reader, None)
        except (OSError, ValueError) as error:  # Arrow wraps a database error
            stopped = "INTERRUPT" in str(error)
            raise (duckdb.InterruptException if stopped else duckdb.Error)(str(error)) from error

    reader, columns = interruptible(connection, begun)
    return reader and (columns, iter(lambda: interruptible(connection, more), None))


def as_told_batches(columns: Sequence[str], stream: ArrowStream) -> ArrowStream:
    """Rename the columns of Arrow batches, and convert 32-bit numbers to 64 bits."""
    (named, batches), first, rows = stream, list[Any](), 0
    for batch in batches:
        first.append(batch)
        if (rows := rows + len(batch)) >= ROWS_AT_ONCE:
            break
    arrow = package("pyarrow")
    seen = arrow.Table.from_batches(first).slice(0, ROWS_AT_ONCE) if first else ()
    wide = {"INTEGER": "BIGINT", "FLOAT": "DOUBLE"}
    kinds = ["VARCHAR" if kind.startswith("ENUM") else wide.get(kind, kind) for _, kind in named]
    for i in range(len(kinds)):
        if not rows or seen[i].null_count == len(seen):
            kinds[i] = "VARCHAR"
    return list(zip(columns, kinds, strict=True)), chain(first, batches)
