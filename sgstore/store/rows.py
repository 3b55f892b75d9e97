"""What a statement gives: rows in memory, arrays, or a stream of rows."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.errors import SqlError
from sgstore.quoting import quoted
from sgstore.store.dataframes import arrow_table, pandas_frame, polars_frame, write_csv
from sgstore.store.parquet import write_parquet

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Mapping, Sequence

    import numpy as np
    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Parameters = Sequence[object] | Mapping[str, object]

MAX_SQL: Final = 1 << 20
"""Longest statement of a user; characters."""

_READS: Final = {"SELECT", "EXPLAIN"}
"""Types of statements that only read: WITH, FROM, VALUES, TABLE, DESCRIBE, SHOW and SUMMARIZE are SELECT."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The result of a statement.

    Attributes
    ----------
    columns : tuple of str
        Their names.
    types : tuple of str
        Their types in the database: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``, …
    values : list of tuple
        The rows; enumerations as ``str``, NULL as ``None``.
    truncated : bool
        Whether there were more rows than asked for.
    """

    columns: tuple[str, ...]
    types: tuple[str, ...]
    values: list[tuple[Any, ...]]
    truncated: bool = False

    def __len__(self) -> int:
        return len(self.values)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        return iter(self.values)

    def dicts(self) -> list[dict[str, Any]]:
        """The rows, each as a dict from column to value."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.values]

    def arrow(self) -> Any:
        """The rows as a ``pyarrow.Table``.

        Raises
        ------
        MissingExtraError
            pyarrow is not installed.
        """
        return arrow_table(self.columns, self.values, self.types)

    def df(self) -> Any:
        """The rows as a ``pandas.DataFrame``.

        Raises
        ------
        MissingExtraError
            pandas is not installed.
        """
        return pandas_frame(self.columns, self.values)

    def polars(self) -> Any:
        """The rows as a ``polars.DataFrame``.

        Raises
        ------
        MissingExtraError
            polars is not installed.
        """
        return polars_frame(self.columns, self.values)

    def parquet(self, path: str | Path) -> int:
        """Write the rows to a Parquet file, in the types of the database; how many there are.

        Raises
        ------
        ExportError
            The file cannot be written.
        """
        return write_parquet(self.columns, self.values, Path(path), self.types)

    def csv(self, path: str | Path) -> int:
        """Write the rows to a CSV file; how many there are.

        Raises
        ------
        ExportError
            The file cannot be written.
        """
        return write_csv(self.columns, self.values, Path(path))


class Batches:
    """The result of a statement as a stream; each batch is :class:`Rows`.

    Attributes
    ----------
    columns, types : tuple of str
        As in :class:`Rows`.
    """

    def __init__(self, result: DuckDBPyConnection, size: int) -> None:
        description = result.description or []
        self.columns = tuple(str(column[0]) for column in description)
        self.types = tuple(str(column[1]) for column in description)
        self._result = result
        self._size = size

    def __iter__(self) -> Iterator[Rows]:
        while values := self._result.fetchmany(self._size):
            yield Rows(self.columns, self.types, values)


def run(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Rows:
    """All rows of a statement of ours."""
    batches = Batches(connection.execute(sql, parameters or None), 1)
    return Rows(batches.columns, batches.types, connection.fetchall())


def arrays(
    connection: DuckDBPyConnection, sql: str, parameters: Parameters | None
) -> dict[str, NDArray[np.generic]]:
    """All columns of a statement of ours; masked arrays where something is NULL, enumerations as texts."""
    described = connection.execute(f"DESCRIBE {sql}", parameters or None).fetchall()
    # As enumerations they would come as categories of pandas.
    listed = [quoted(str(row[0])) for row in described if "ENUM" in str(row[1])]
    if listed:
        texts = ", ".join(f"{name}::VARCHAR AS {name}" for name in listed)
        sql = f"SELECT * REPLACE ({texts}) FROM ({sql})"
    return connection.execute(sql, parameters or None).fetchnumpy()


@contextmanager
def user_statement(
    connection: DuckDBPyConnection, sql: str, *, timeout_s: float | None, size: int
) -> Generator[Batches]:
    """Run a statement of a user's on a connection that can read the store and nothing else.

    Raises
    ------
    SqlError
        It is not one statement that only reads, the database refuses it, or it runs for too long.
    """
    with _refused(sql, timeout_s):
        _check(connection, sql)
    with _interrupted_after(connection, timeout_s), _refused(sql, timeout_s):
        yield Batches(connection.execute(sql), size)


def _check(connection: DuckDBPyConnection, sql: str) -> None:
    if len(sql) > MAX_SQL:
        raise SqlError(f"the statement has {len(sql)} characters; {MAX_SQL} are allowed")
    statements = connection.extract_statements(sql)
    if len(statements) != 1:
        raise SqlError(f"expected one statement, found {len(statements)}")
    kind = statements[0].type.name
    if kind not in _READS:
        raise SqlError(
            f"the store is read only here: {kind} is not allowed; expected SELECT, WITH, FROM, VALUES,"
            " DESCRIBE, SHOW, SUMMARIZE or EXPLAIN"
        )


@contextmanager
def _refused(sql: str, timeout_s: float | None) -> Generator[None]:
    """Errors of DuckDB as errors of the user's statement."""
    try:
        yield
    except duckdb.InterruptException as error:
        raise SqlError(f"stopped after {timeout_s:g} s: {_shown(sql)}") from error
    except duckdb.Error as error:
        message = str(error).strip()
        if "pytz" in message:
            message = "times with a time zone cannot be shown; cast them: now()::TIMESTAMP"
        raise SqlError(message) from error


def _shown(sql: str) -> str:
    line = " ".join(sql.split())
    return line if len(line) <= 80 else f"{line[:79]}…"


@contextmanager
def _interrupted_after(connection: DuckDBPyConnection, timeout_s: float | None) -> Generator[None]:
    """Stop whatever the connection does when the time is up; again and again, until the block is left."""
    if timeout_s is None:
        yield
        return
    done = threading.Event()

    def watch() -> None:
        pause = timeout_s
        while not done.wait(pause):
            connection.interrupt()
            pause = 0.01

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
