"""What is added to traces that are in a store already: built aside, brought in by one transaction, noted."""

from __future__ import annotations

from contextlib import contextmanager
from glob import escape
from typing import TYPE_CHECKING, Any

from sgstore.quoting import literal
from sgstore.store.access import spill_folder
from sgstore.store.checksums import Checksum, expressions
from sgstore.store.packing import BUCKET_BITS, FRAME_BITS
from sgstore.store.staging import Staging, scratch

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from duckdb import DuckDBPyConnection

    from sgstore.store.access import Access

_WINDOW = 1024
"""Buckets of which a checksum is taken at once."""


@contextmanager
def writing(access: Access) -> Generator[DuckDBPyConnection]:
    """One transaction on a store, attached as ``store``."""
    with scratch(spill_folder()) as connection, access.writing(connection):
        yield connection


def add_files(
    connection: DuckDBPyConnection, staging: Staging, files: dict[str, list[str]]
) -> None:
    """Insert the files that a staging sealed."""
    for table, names in files.items():
        for name in names:
            file = literal(escape(str(staging.folder / name)))
            connection.execute(
                f"INSERT INTO store.{table} BY NAME SELECT * FROM read_parquet({file})"
            )


def note(connection: DuckDBPyConnection, trace_id: int, tables: Iterable[str]) -> None:
    """Take down what a trace has now in tables that change after it was published."""
    for table in tables:
        checksum = _checksum(connection, table, trace_id)
        connection.execute(
            'DELETE FROM store.manifest WHERE trace_id = ? AND "table" = ?', [trace_id, table]
        )
        if checksum.rows:
            connection.execute(
                "INSERT INTO store.manifest VALUES (?, NULL, ?, ?, ?)",
                [trace_id, table, checksum.rows, checksum.value],
            )


def _checksum(connection: DuckDBPyConnection, table: str, trace_id: int) -> Checksum:
    checksum = Checksum()
    select = expressions(connection, table, "store")
    for condition, values in _ranges(connection, table, trace_id):
        rows = connection.execute(f"SELECT {select} FROM store.{table} WHERE {condition}", values)
        checksum.add(rows.fetchnumpy())
    return checksum


def _ranges(
    connection: DuckDBPyConnection, table: str, trace_id: int
) -> Iterable[tuple[str, list[Any]]]:
    """Conditions on the rows of a trace, each of so many as fit into memory."""
    columns = connection.execute(
        "SELECT column_name FROM duckdb_columns() WHERE database_name = 'store' AND table_name = ?",
        [table],
    ).fetchall()
    bits = {"bucket": 0, "frame_id": FRAME_BITS}
    column = next((name for name in bits if (name,) in columns), None)
    if column is None:
        return [("trace_id = ?", [trace_id])]
    bit = bits[column]
    low, high = trace_id << BUCKET_BITS, (trace_id + 1) << BUCKET_BITS
    (last,) = connection.execute(
        f"SELECT max({column} >> {bit}) FROM store.{table} WHERE {column} >= ? AND {column} < ?",
        [low << bit, high << bit],
    ).fetchall()[0]
    end = low if last is None else last + 1
    return [
        (
            f"{column} >= ? AND {column} < ?",
            [first << bit, min(first + _WINDOW, end) << bit],
        )
        for first in range(low, end, _WINDOW)
    ]
