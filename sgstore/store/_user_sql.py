"""SQL statements of users on a store: read-only, and interrupted after a time limit."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import duckdb

from sgstore.errors import SqlError
from sgstore.store._arrow import record_batches, table_of
from sgstore.store._edge_counts import counted_edges
from sgstore.store._engine_errors import EngineError, engine_fault, spill_fault
from sgstore.store._interrupts import interrupt
from sgstore.store._rows import BATCH, Batches, Rows
from sgstore.store._schema import INSIDE, add_trace, expected
from sgstore.store._sql_words import show_is_a
from sgstore.store._table_files import ParquetTable
from sgstore.store._temporary_tables import Given, give

if TYPE_CHECKING:
    from collections.abc import Generator
    from contextlib import AbstractContextManager, ExitStack

    from duckdb import DuckDBPyConnection

T = TypeVar("T")

MAX_SQL: Final = 1 << 20
"""Largest length of a user's SQL statement; characters."""

_TO_A_TABLE: Final = re.compile(rf'Did you mean "{INSIDE}\.\w+"\?')
"""Regular expression of a DuckDB hint to an internal table, which users cannot read."""

_READS: Final = {"SELECT", "EXPLAIN"}
"""DuckDB types of statements that only read."""

UserTablesGiven = Callable[[], Iterable[Given]]
"""Function that returns the temporary tables of a user's statement. It is called with the store open."""


class UserSql:
    """SQL statement of a user. It can read only the store and its views.

    Parameters
    ----------
    answered : function
        :meth:`StoreFile.answered` of the store.
    sql : str
        One read-only statement. It can read the store, but no files, and cannot change settings.
    timeout_s : float, optional
        Time limit; s.
    given : function, optional
        Function that returns the temporary tables of the statement. Trusted statements create them from the
        current store.

    Raises
    ------
    SqlError
        By each method: the text is not a single read-only statement, the database rejects it, or it runs for
        too long.
    """

    def __init__(
        self,
        answered: Callable[..., AbstractContextManager[Any]],
        sql: str,
        timeout_s: float | None,
        given: UserTablesGiven | None,
    ) -> None:
        self._answer, self._given = answered, given
        self.sql, self.timeout_s = sql, timeout_s
        if "topic" in sql.lower():
            from sgstore.lang.syntax import topic_tables  # slow import

            self.sql = topic_tables(sql)

    def batches(self, size: int = BATCH) -> AbstractContextManager[Batches]:
        """Stream the rows of the statement in batches."""
        return self._answered(lambda x, sql: Batches(x, sql, size=size, shortened=True))

    def rows(self, max_rows: int | None = None) -> Rows:
        """Return the rows of the statement; ``Rows.truncated`` is true if there are more than the limit."""
        size = BATCH if max_rows is None else max(min(BATCH, max_rows + 1), 1)
        values: list[tuple[Any, ...]] = []
        with self.batches(size) as batches:
            for batch in batches:
                values += batch.values
                if max_rows is not None and len(values) > max_rows:
                    break
        more = max_rows is not None and len(values) > max_rows
        return Rows(batches.columns, batches.types, values[:max_rows], truncated=more)

    def rows_on_demand(self, max_rows: int | None = None) -> Rows:
        """Return the rows of the statement. Rows beyond the first batch are loaded on demand."""
        first = self.rows(BATCH if max_rows is None else max_rows)
        return first if max_rows is not None or not first.truncated else LaterRows(first, self)

    def table(self) -> Any:
        """Return the rows of the statement as an Arrow table, or ``None`` if Arrow is not installed."""
        with self._answered(table_of) as found:
            return found

    def parquet(self, to: Path) -> int:
        """Write the rows of the statement to a Parquet file, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.
        """

        def write(connection: DuckDBPyConnection, sql: str) -> int | None:
            stream = record_batches(connection, sql)
            return None if stream is None else ParquetTable.write_batches(stream, to)

        with self._answered(write) as number:
            if number is not None:
                return number
        with self.batches() as batches:
            values = chain.from_iterable(batch.values for batch in batches)
            return ParquetTable.write_rows(batches.columns, values, to, batches.types)

    @contextmanager
    def _answered(self, step: Callable[[DuckDBPyConnection, str], T]) -> Generator[T]:
        """Run a function with a connection and the SQL statement, and yield its result."""

        def ask(connection: DuckDBPyConnection, until: ExitStack) -> T:
            if re.search(r"(?i)\btraces?\b", self.sql):
                with self._refused(connection):
                    add_trace(connection)
            with self._refused(connection):
                show_is_a(connection, self.sql)
            counted = None if self._given else counted_edges(self.sql)
            given = [(counted[0], {})] if counted else self._given and self._given()
            sql = counted[1] if counted else self.sql
            if given:
                with self._interrupted(connection), self._refused(connection):
                    connection.execute(f"USE {INSIDE}")
                    give(connection, given)
                    connection.execute("USE main")
            return until.enter_context(self._running(connection, lambda on: step(on, sql)))

        with self._answer(ask, self.sql, public=True) as found:
            yield found

    @contextmanager
    def _running(
        self, connection: DuckDBPyConnection, step: Callable[[DuckDBPyConnection], T]
    ) -> Generator[T]:
        with self._refused(connection):
            _check(connection, self.sql)
        with self._interrupted(connection), self._refused(connection):
            yield step(connection)

    @contextmanager
    def _refused(self, connection: DuckDBPyConnection) -> Generator[None]:
        """Context manager that converts DuckDB errors to errors of the user's SQL statement."""
        try:
            yield
        except duckdb.InterruptException as error:
            after = "" if self.timeout_s is None else f" after {self.timeout_s:g} s"
            raise SqlError(f"stopped{after}: {_shown(self.sql)}") from error
        except duckdb.Error as error:
            if (fault := engine_fault(error)) is not None:
                raise EngineError(fault) from error
            message = spill_fault(str(error)) or str(error).strip()
            if '":topic ' in self.sql:
                from sgstore.store._topic_views import field_fault

                message = field_fault(connection, self.sql, message) or message
            if "pytz" in message:  # before DuckDB 2.0.1
                message = "times with a time zone cannot be shown; cast them: now()::TIMESTAMP"
            raise SqlError(_TO_A_TABLE.sub(_views, message)) from error

    @contextmanager
    def _interrupted(self, connection: DuckDBPyConnection) -> Generator[None]:
        """Context manager that interrupts a database connection after a timeout."""
        if (limit := self.timeout_s) is None:
            yield
            return
        done = threading.Event()

        def watch() -> None:
            pause = limit
            while not done.wait(pause):
                interrupt(connection)
                pause = 0.01

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()


class LaterRows(Rows):
    """Large query result. The first rows are in memory; the others are loaded on demand.

    Parameters
    ----------
    first : Rows
        First rows.
    asked : UserSql
        Statement that loads all rows.
    """

    def __init__(self, first: Rows, asked: UserSql) -> None:
        super().__init__(first.columns, first.types, first.values)
        self._asked, self._whole = asked, False

    def __repr__(self) -> str:
        if self._whole:
            return super().__repr__()
        return f"<over {len(self._values):,} rows of {', '.join(self.columns)}>"

    @property
    def values(self) -> list[tuple[Any, ...]]:
        """Rows of the result as tuples. Enumeration values are ``str``; NULL is ``None``."""
        if not self._whole:
            self._values, self._whole = self._asked.rows().values, True
        return self._values

    def _table(self) -> Any:
        return None if self._whole else self._asked.table()

    def parquet(self, path: str | Path) -> int:
        """Write all rows of the result to a Parquet file as a stream, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.
        """
        return super().parquet(path) if self._whole else self._asked.parquet(Path(path))


def _check(connection: DuckDBPyConnection, sql: str) -> None:
    if len(sql) > MAX_SQL:
        raise SqlError(f"the statement has {len(sql)} characters; {MAX_SQL} are allowed")
    statements = connection.extract_statements(sql)
    if len(statements) != 1:
        raise SqlError(f"expected one statement, found {len(statements)}")
    kind = statements[0].type.name
    if kind not in _READS:
        more = "; write rows to a file with -o FILE, or Rows.parquet()" if kind == "COPY" else ""
        raise SqlError(
            f"the store is read only here: {kind} is not allowed; expected SELECT, WITH, FROM, VALUES,"
            f" DESCRIBE, SHOW, SUMMARIZE or EXPLAIN{more}"
        )


def _views(_: re.Match[str]) -> str:
    return f"The views are {', '.join(expected().views)}."


def _shown(sql: str) -> str:
    line = " ".join(sql.split())
    return line if len(line) <= 80 else f"{line[:79]}…"
