"""Statement results: rows, arrays, Arrow, pandas, polars, CSV and Parquet.

How a step of the database is waited for, so that a signal ends it at once.

Python runs the handler of a signal only between its own steps and in the main thread, and DuckDB lets it do so
only between its tasks, one of which may take minutes. So the main thread does no such step itself: it waits for
a thread that does, which Python can interrupt at any time, and then interrupts the database, which heeds that
within a task, too.
"""

from __future__ import annotations

import csv
import json
import threading
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import chain, islice
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

import duckdb
import numpy as np

from sgstore.errors import ExportError, MissingExtraError, SqlError
from sgstore.files import without_controls, working_folder, written_at, written_text
from sgstore.quoting import literal, quoted
from sgstore.store._locking import EngineError, engine_fault, spill_fault

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Parameters = Sequence[object] | Mapping[str, object]


T = TypeVar("T")

_LOOK_S: Final = 0.5
"""How often is looked for a signal where waiting is not interrupted by one (on Windows); s."""
_AGAIN_S: Final = 0.01
"""How often the database is interrupted until it has ended: one may come before the statement begins; s."""


def interruptible(connection: DuckDBPyConnection, step: Callable[[], T]) -> T:
    """Do a step of the database; whatever a handler of signals raises meanwhile ends it.

    Parameters
    ----------
    connection : DuckDBPyConnection
        The one that the step uses, and nobody else while it lasts.
    step : callable
        In another thread than the caller's, if that is the main thread: no other has handlers of signals.

    Returns
    -------
    Whatever the step returns.

    Raises
    ------
    BaseException
        What the step raises; or, once the step has ended, what a handler raised: ``KeyboardInterrupt`` after
        Ctrl-C.
    """
    if threading.current_thread() is not threading.main_thread():
        return step()
    task = _Task(step)
    try:
        began = _step_thread.begin(task)
        while began and not task.ended.wait(_LOOK_S):
            pass
    except BaseException:
        while not task.is_over():
            with suppress(BaseException):  # whoever asks twice does not leave a statement behind
                task.ended.wait(_AGAIN_S)
                connection.interrupt()
        task.forget()
        raise
    return task.result() if began else step()


class _Task(Generic[T]):
    """A step that another thread does."""

    def __init__(self, step: Callable[[], T]) -> None:
        self.ended = threading.Event()
        self._step = step
        # One turn, for whoever takes it first: the thread that does the step, or who wants it no more.
        self._turns = [None]
        self._found: list[T] = []
        self._error: BaseException | None = None

    def take(self) -> bool:
        """Take the turn; ``False`` if it was taken."""
        try:
            self._turns.pop()
        except IndexError:
            return False
        return True

    def is_over(self) -> bool:
        """Return whether the step has ended, or will never begin."""
        if self.take():
            self.ended.set()
        return self.ended.is_set()

    def result(self) -> T:
        """Return what the step returned, or raise what it raised."""
        try:
            if self._error is not None:
                raise self._error
            return self._found.pop()
        finally:
            self.forget()

    def forget(self) -> None:
        """Let go of the result: an error refers to what refers to it, and so would hold the connection."""
        self._error = None
        self._found.clear()

    def run(self) -> None:
        """Do the step, unless it is not wanted any more."""
        if not self.take():
            return
        try:
            self._found.append(self._step())
        except BaseException as error:  # noqa: BLE001  (raised again where it is waited for)
            self._error = error
        finally:
            self.ended.set()


class _StepThread:
    """The thread that does the steps of the main thread, one after another.

    It lasts, because to start one takes longer than a short question.
    """

    def __init__(self) -> None:
        self._tasks: SimpleQueue[_Task[Any]] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def begin(self, task: _Task[Any]) -> bool:
        """Hand over a task; ``False``: there can be no thread for it."""
        # A process that was forked off has no thread, and its queue may be locked for ever.
        if self._thread is None or not self._thread.is_alive():
            self._tasks = SimpleQueue()
            thread = threading.Thread(target=_do_all, args=(self._tasks,), daemon=True)
            try:
                thread.start()
            except RuntimeError:  # no more threads may be had
                return not task.take()
            self._thread = thread
        self._tasks.put(task)
        return True


def _do_all(tasks: SimpleQueue[_Task[Any]]) -> None:
    while True:
        tasks.get().run()  # not by a name, which would hold the connection until the next task


_step_thread: Final = _StepThread()


# What a statement gives: rows in memory, arrays, or a stream of rows ----------------------------

BATCH: Final = 10_000
"""Rows of a batch."""

MAX_SQL: Final = 1 << 20
"""Longest statement of a user; characters."""

_READS: Final = {"SELECT", "EXPLAIN"}
"""Types of statements that only read: WITH, FROM, VALUES, TABLE, DESCRIBE, SHOW and SUMMARIZE are SELECT."""


@dataclass(frozen=True, slots=True, repr=False)
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

    def __repr__(self) -> str:
        more = " and more" * self.truncated
        return f"<{len(self):,} rows{more} of {', '.join(self.columns)}>"

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

    def __init__(
        self,
        connection: DuckDBPyConnection,
        sql: str,
        parameters: Parameters | None = None,
        size: int = BATCH,
    ) -> None:
        self._connection = connection
        self._size = size
        interruptible(connection, lambda: connection.execute(sql, parameters or None))
        self.columns, self.types = _described(connection)
        self._next = self._more()  # faults of the statement come before its first row is given

    def _more(self) -> list[tuple[Any, ...]]:
        return interruptible(self._connection, lambda: self._connection.fetchmany(self._size))

    def __iter__(self) -> Iterator[Rows]:
        while values := self._next:
            yield Rows(self.columns, self.types, values)
            self._next = self._more()


def run(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Rows:
    """All rows of a statement of ours."""
    values = interruptible(
        connection, lambda: connection.execute(sql, parameters or None).fetchall()
    )
    return Rows(*_described(connection), values)


def _described(result: DuckDBPyConnection) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and types of the columns of a result."""
    description = result.description or []
    return tuple(str(one[0]) for one in description), tuple(str(one[1]) for one in description)


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

    def fetched() -> dict[str, NDArray[np.generic]]:
        return connection.execute(sql, parameters or None).fetchnumpy()

    return interruptible(connection, fetched)


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
        yield Batches(connection, sql, size=size)


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
        after = "" if timeout_s is None else f" after {timeout_s:g} s"
        raise SqlError(f"stopped{after}: {_shown(sql)}") from error
    except duckdb.Error as error:
        if (fault := engine_fault(error)) is not None:
            raise EngineError(fault) from error
        message = spill_fault(str(error)) or str(error).strip()
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


# Rows → tables of Arrow, pandas and polars, and CSV; the packages are imported when they are asked for ----

_ARROW: Final = {
    "BIGINT": "int64",
    "INTEGER": "int32",
    "DOUBLE": "float64",
    "FLOAT": "float32",
    "BOOLEAN": "bool_",
    "VARCHAR": "string",
}
"""Types of the database as functions of pyarrow; others are told by their values."""


def arrow_table(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], types: Sequence[str] | None = None
) -> Any:
    """Rows as a ``pyarrow.Table``.

    Parameters
    ----------
    columns : sequence of str
    rows : iterable of sequences
        Plain Python values; lists and dicts become lists and structs.
    types : sequence of str, optional
        Types of the columns in the database; else they are told by the values.

    Raises
    ------
    MissingExtraError
        pyarrow is not installed.
    """
    arrow = _package("pyarrow", "tables of Arrow", "arrow")
    by_column = _columns(columns, rows)
    declared = types or ["" for _ in columns]
    arrays = [
        arrow.array(values, getattr(arrow, _ARROW[kind])() if kind in _ARROW else None)
        for values, kind in zip(by_column, declared, strict=True)
    ]
    return arrow.table(arrays, names=list(columns))


def pandas_frame(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Any:
    """Rows as a ``pandas.DataFrame``.

    Raises
    ------
    MissingExtraError
        pandas is not installed.
    """
    pandas = _package("pandas", "data frames", "pandas")
    return pandas.DataFrame.from_records(list(rows), columns=list(columns))


def polars_frame(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Any:
    """Rows as a ``polars.DataFrame``.

    Raises
    ------
    MissingExtraError
        polars is not installed.
    """
    polars = _package("polars", "data frames of polars", "polars")
    by_column = zip(columns, _columns(columns, rows), strict=True)
    return polars.DataFrame(
        [polars.Series(name, values, strict=False) for name, values in by_column]
    )


def write_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]], to: Path) -> int:
    """Write rows to a CSV file; what is missing is empty, lists and dicts are JSON.

    Returns
    -------
    int
        How many rows were written.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    number = 0
    with written_text(to) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow([_cell(value) for value in row])
            number += 1
    return number


def arrow_file(source: Path, to: Path) -> None:
    """A Parquet file as a file of Arrow (IPC, Feather 2), batch by batch.

    Raises
    ------
    ExportError
        The file cannot be written.
    MissingExtraError
        pyarrow is not installed.
    """
    arrow = _package("pyarrow", "files of Arrow", "arrow")
    parquet = import_module("pyarrow.parquet")
    with (
        written_at(to) as place,
        parquet.ParquetFile(source) as file,
        arrow.OSFile(str(place), "wb") as sink,
        arrow.ipc.new_file(sink, file.schema_arrow) as writer,
    ):
        for batch in file.iter_batches():
            writer.write_batch(batch)


def _columns(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """Rows as columns. Some rows at a time: what was made together lies together in memory."""
    found: list[list[Any]] = [[] for _ in columns]
    rows = iter(rows)
    while batch := list(islice(rows, BATCH)):
        for values, more in zip(found, zip(*batch, strict=True), strict=True):
            values.extend(more)
    return found


def _cell(value: Any) -> Any:
    """A value as CSV has it: lists and dicts as JSON, control characters as escapes."""
    if isinstance(value, list | tuple | dict):
        value = json.dumps(value, ensure_ascii=False, default=str)
    return "" if value is None else without_controls(value) if isinstance(value, str) else value


def _package(name: str, purpose: str, extra: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(purpose, extra) from error


# Columns or rows → Parquet, block by block, by DuckDB, so that nobody needs another package for it ----

ROW_GROUP: Final = 122_880
"""Rows of a row group."""

_TOGETHER: Final = 50_000
"""Rows that are written at once, and tell the types of the columns where nobody else does."""

_TYPES: Final = ((bool, "BOOLEAN"), (int, "BIGINT"), ((int, float), "DOUBLE"))


class ParquetTable:
    """A Parquet file that is written a block of rows at a time; to be used in a ``with``.

    What the blocks add up to waits in a file of its own, not in memory. The same blocks are the same bytes.

    Parameters
    ----------
    to : Path
        The file; one that is there is replaced.
    columns : iterable of (str, str)
        Names, and types as DuckDB has them: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``.
    enums : bool
        Whether enumerations stay what they are. By default they become texts, because they would be
        dictionaries, which not every reader of Parquet knows.
    called : Path, optional
        The file as errors call it; by default as it is.

    Attributes
    ----------
    rows : int
        How many were written.

    Raises
    ------
    ExportError
        The file cannot be written.
    """

    def __init__(
        self,
        to: Path,
        columns: Iterable[tuple[str, str]],
        *,
        enums: bool = False,
        called: Path | None = None,
    ) -> None:
        self.rows = 0
        self._to = to
        self._called = called or to
        kinds = [
            (name, "VARCHAR" if kind.startswith("ENUM") and not enums else kind)
            for name, kind in columns
        ]
        self._columns = tuple(name for name, _ in kinds)
        named = ", ".join(f"{quoted(name)} {kind}" for name, kind in kinds)
        with ExitStack() as stack, self._translated():
            folder = stack.enter_context(working_folder("table"))
            rows = duckdb.connect(str(folder / "rows.duckdb"))
            self._connection = stack.enter_context(rows)
            rows.execute("SET threads = 1")  # so that row groups come in one order
            rows.execute(f"CREATE TABLE output ({named})")
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        with self._open, self._translated():
            if kind is None:
                to = literal(str(self._to))
                self._connection.execute(
                    f"COPY output TO {to} (FORMAT parquet, ROW_GROUP_SIZE {ROW_GROUP})"
                )

    def add(self, columns: Mapping[str, NDArray[Any] | Sequence[Any]]) -> None:
        """Add rows.

        Parameters
        ----------
        columns : mapping
            Name → values, for every column of the table; masked, or ``None``, where one is missing.

        Raises
        ------
        ExportError
            A value does not fit the type of its column, or the disk is full.
        """
        self._add([columns[name] for name in self._columns])

    def add_rows(self, rows: Iterable[Sequence[Any]]) -> None:
        """Add rows of plain Python values, ``None`` where one is missing; see :meth:`add`."""
        rows = iter(rows)
        while batch := list(islice(rows, _TOGETHER)):
            self._add([[row[i] for row in batch] for i in range(len(self._columns))])

    def _add(self, columns: Sequence[NDArray[Any] | Sequence[Any]]) -> None:
        data: dict[str, NDArray[Any]] = {}
        for i, values in enumerate(columns):
            if isinstance(values, np.ndarray):
                data[f"c{i}"] = values
            else:
                listed = data[f"c{i}"] = np.empty(len(values), object)
                listed[:] = values
        number = len(data["c0"])
        if not number:
            return
        with self._translated():
            self._connection.register("block", data)
            self._connection.execute("INSERT INTO output SELECT * FROM block")
            self._connection.unregister("block")
        self.rows += number

    @contextmanager
    def _translated(self) -> Generator[None]:
        try:
            yield
        except duckdb.Error as error:
            raise ExportError(f"{self._called}: {str(error).strip()}") from error


def write_parquet(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    to: Path,
    types: Sequence[str] | None = None,
) -> int:
    """Write rows to a Parquet file; one that is there is replaced.

    Parameters
    ----------
    columns : sequence of str
        Distinct names.
    rows : iterable of sequences
        Plain Python values, ``None`` where one is missing.
    to : Path
    types : sequence of str, optional
        DuckDB's types of the columns. By default the narrowest that holds the first 50,000 rows: truth
        value, whole number, number, else text.

    Returns
    -------
    int
        How many rows were written.

    Raises
    ------
    ExportError
        The file cannot be written, or a later row does not fit the type of its column.
    """
    rows = iter(rows)
    if types is None:
        first = list(islice(rows, _TOGETHER))
        types = [_type_of([row[i] for row in first]) for i in range(len(columns))]
        rows = chain(first, rows)
    with (
        written_at(to) as place,
        ParquetTable(place, zip(columns, types, strict=True), enums=True, called=to) as table,
    ):
        table.add_rows(rows)
    return table.rows


def _type_of(values: list[Any]) -> str:
    known = [value for value in values if value is not None]
    for kind, name in _TYPES:
        narrow = all(isinstance(v, kind) for v in known)
        truth = any(isinstance(v, bool) for v in known)
        if known and narrow and truth == (name == "BOOLEAN"):
            return name
    return "VARCHAR"


def count_parquet(file: Path) -> tuple[int, tuple[str, ...]]:
    """Count the rows of a Parquet file, and name its columns; it is read again as a whole.

    Raises
    ------
    ExportError
        It cannot be read.
    """
    try:
        with duckdb.connect() as connection:
            found = Batches(connection, "FROM read_parquet(?)", [str(file)])
            return sum(len(batch) for batch in found), found.columns
    except duckdb.Error as error:
        raise ExportError(f"{file.name}: cannot be read back: {str(error).strip()}") from error


# Rows that a statement of ours is given: a table that lasts as long as the statement is asked ----
# They come a block at a time, and the database moves what does not fit into memory to temporary files.


@dataclass(frozen=True, slots=True)
class GivenTable:
    """A table of rows that are not in the store.

    Attributes
    ----------
    name : str
        What the statement calls it; like no table of the store.
    types : mapping of str to str
        The type of each column in the database.
    blocks : function
        The columns of some rows, in the same order, and of the next ones; from the first whenever it is called.
    """

    name: str
    types: Mapping[str, str]
    blocks: Callable[[], Iterable[Sequence[list[Any]]]]


def give(connection: DuckDBPyConnection, given: Iterable[GivenTable]) -> None:
    """Make tables that nobody but this connection sees, until it is closed."""
    for table in given:
        columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in table.types.items())
        name = quoted(table.name)
        connection.execute(f"CREATE OR REPLACE TEMP TABLE {name} ({columns})")
        values = ", ".join(f"unnest(CAST(? AS {kind}[]))" for kind in table.types.values())
        for block in table.blocks():
            if len(block[0]):
                connection.execute(f"INSERT INTO {name} SELECT {values}", list(block))
