"""Statement results: rows, arrays, Arrow, pandas, polars, CSV and Parquet."""

from __future__ import annotations

import csv
import json
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

import duckdb
import numpy as np

from sgstore.base.files import without_controls, working_folder, written_at, written_text
from sgstore.base.json_text import shortest
from sgstore.base.quoting import literal, quoted
from sgstore.errors import ExportError, MissingExtraError, SqlError
from sgstore.store._interrupts import interrupt, interruptible
from sgstore.store._locking import EngineError, engine_fault, spill_fault
from sgstore.store._schema import INSIDE, expected
from sgstore.store._temporary_tables import Given, give

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Parameters = Sequence[object] | Mapping[str, object]
    ArrowStream = tuple[list[tuple[str, str]], Iterator[Any]]
    """Names and types of columns, and batches of their rows."""


T = TypeVar("T")

# Results of a statement: rows in memory, arrays, or a stream of rows ----------------------------

BATCH: Final = 10_000
"""Rows of a batch."""

IN_NOTEBOOK: Final = 20
"""Number of result rows shown in a notebook."""

MAX_SQL: Final = 1 << 20
"""Longest statement of a user; characters."""

_TO_A_TABLE: Final = re.compile(rf'Did you mean "{INSIDE}\.\w+"\?')
"""Hint in DuckDB errors at an internal table. Users can query only the views."""

_READS: Final = {"SELECT", "EXPLAIN"}
"""Types of statements that only read: WITH, FROM, VALUES, TABLE, DESCRIBE, SHOW and SUMMARIZE are SELECT."""


class Tabular:
    """Source of rows that converts to tables of other packages and to files."""

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        raise NotImplementedError

    def _described(self) -> tuple[tuple[str, ...], tuple[str, ...] | None]:
        raise NotImplementedError

    def _table(self) -> Any:
        return None

    def arrow(self) -> Any:
        """Return all rows as a ``pyarrow.Table``.

        Raises
        ------
        MissingExtraError
            pyarrow is not installed.
        """
        arrow = _package("pyarrow")
        table = self._table()
        if table is not None:
            return table
        names, types = self._described()
        kinds = [getattr(arrow, _ARROW[kind])() if kind in _ARROW else None for kind in types or ()]
        columns = _columns(names, self)
        arrays = map(arrow.array, columns, kinds) if kinds else map(arrow.array, columns)
        return arrow.table(list(arrays), names=list(names))

    def df(self) -> Any:
        """Return all rows as a ``pandas.DataFrame``.

        Raises
        ------
        MissingExtraError
            pandas is not installed.
        """
        pandas = _package("pandas")
        if (table := self._by_values()) is not None:
            return table.to_pandas()
        names, _ = self._described()
        return pandas.DataFrame.from_records(list(self), columns=list(names))

    def polars(self) -> Any:
        """Return all rows as a ``polars.DataFrame``.

        Raises
        ------
        MissingExtraError
            polars is not installed.
        """
        polars = _package("polars")
        if (table := self._by_values()) is not None:
            return polars.from_arrow(table)
        names, _ = self._described()
        columns = zip(names, _columns(names, self), strict=True)
        return polars.DataFrame([polars.Series(name, of, strict=False) for name, of in columns])

    def _by_values(self) -> Any:
        """Return an Arrow table with types inferred from Python values, or ``None`` if unavailable."""
        with suppress(MissingExtraError):
            _package("pyarrow")
            table = self._table()
            return None if table is None else as_told([table])
        return None

    def parquet(self, path: str | Path) -> int:
        """Stream all rows to a Parquet file, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.
        """
        names, types = self._described()
        return write_parquet(names, self, Path(path), types)

    def csv(self, path: str | Path) -> int:
        """Stream all rows to a CSV file, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.
        """
        return write_csv(self._described()[0], self, Path(path))

    def relation(self) -> duckdb.DuckDBPyRelation:
        """Return all rows as a DuckDB relation, for filters, joins, aggregates and plots.

        ::

            gaps = store.find("MATCH (e:Ego), (v:Vehicle) RETURN v.kind AS kind, gap(e, v) AS metres")
            gaps.relation().filter("metres < 5").aggregate("kind, count(*) AS often").df()

        The rows are queried once and copied into a new database as the table ``answer``, in memory or on disk.
        Further relations are computed when they are fetched.

        Raises
        ------
        ExportError
            Disk and memory are too small for the rows.
        """
        from sgstore.store._relation import relation_of

        return relation_of(self.parquet)


class Rows(Tabular):
    """Result of a statement.

    Attributes
    ----------
    columns : tuple of str
        Column names.
    types : tuple of str
        Database types: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``, …
    truncated : bool
        True if there were more rows than requested.
    reasons : mapping of str to str
        Reasons why a pattern in the statement skips traces, by trace name.
    """

    def __init__(
        self,
        columns: tuple[str, ...],
        types: tuple[str, ...],
        values: list[tuple[Any, ...]],
        *,
        truncated: bool = False,
    ) -> None:
        self.columns, self.types, self.truncated = columns, types, truncated
        self.reasons: Mapping[str, str] = {}
        self._values = values

    @property
    def values(self) -> list[tuple[Any, ...]]:
        """Rows as tuples. Enumeration values are ``str``; NULL is ``None``."""
        return self._values

    def __repr__(self) -> str:
        more = " and more" * self.truncated
        return f"<{len(self):,} rows{more} of {', '.join(self.columns)}>"

    def _repr_html_(self) -> str:
        """Return the first rows as an HTML table, for notebooks."""
        from sgstore.base.display import html_table

        some = self._values[:IN_NOTEBOOK]
        more = self.truncated or len(self._values) > len(some)
        return html_table(self.columns, some, below=f"the first {len(some)} rows" if more else "")

    def __len__(self) -> int:
        return len(self.values)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        return iter(self.values)

    def _described(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return self.columns, self.types

    def dicts(self) -> list[dict[str, Any]]:
        """Return each row as a dict: column → value."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.values]


class LaterRows(Rows):
    """Large result with its first rows loaded. The rest is loaded on demand.

    Parameters
    ----------
    first : Rows
        First rows.
    ask : callable
        Function that returns all rows; they are cached.
    table : callable
        Function that returns an Arrow table; see :meth:`Tabular._table`.
    parquet : callable
        Function that writes a Parquet file, and returns the number of rows.
    """

    def __init__(
        self,
        first: Rows,
        ask: Callable[[], Rows],
        table: Callable[[], Any],
        parquet: Callable[[Path], int],
    ) -> None:
        super().__init__(first.columns, first.types, first.values)
        self._ask, self._ask_table, self._ask_parquet = ask, table, parquet
        self._whole = False

    def __repr__(self) -> str:
        if self._whole:
            return super().__repr__()
        return f"<over {len(self._values):,} rows of {', '.join(self.columns)}>"

    @property
    def values(self) -> list[tuple[Any, ...]]:
        """Rows as tuples. Enumeration values are ``str``; NULL is ``None``."""
        if not self._whole:
            self._values, self._whole = self._ask().values, True
        return self._values

    def _table(self) -> Any:
        return None if self._whole else self._ask_table()

    def parquet(self, path: str | Path) -> int:
        """Stream all rows to a Parquet file, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.
        """
        return super().parquet(path) if self._whole else self._ask_parquet(Path(path))


class Batches:
    """Result of a statement as a stream of batches; each batch is :class:`Rows`.

    Attributes
    ----------
    columns, types : tuple of str
        See :class:`Rows`.
    shortened : bool
        True to return float32 values as the float64 with the shortest text.
    """

    def __init__(
        self,
        connection: DuckDBPyConnection,
        sql: str,
        parameters: Parameters | None = None,
        size: int = BATCH,
        *,
        shortened: bool = False,
    ) -> None:
        self._connection = connection
        self._size = size

        def begin() -> list[tuple[Any, ...]]:
            return connection.execute(sql, parameters or None).fetchmany(size)

        # Errors of the statement are raised before its first row.
        self._next = interruptible(connection, begin)
        self.columns, self.types = _described(connection)
        self._single = [i for i, kind in enumerate(self.types) if kind == "FLOAT" and shortened]

    def _told(self, values: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Round float32 values in the rows to the float64 with the shortest text."""
        if not self._single:
            return values
        columns = list(zip(*values, strict=True))
        for place in self._single:
            columns[place] = tuple(map(shortest, columns[place]))
        return list(zip(*columns, strict=True))

    def _more(self) -> list[tuple[Any, ...]]:
        return interruptible(self._connection, lambda: self._connection.fetchmany(self._size))

    def __iter__(self) -> Iterator[Rows]:
        while values := self._next:
            yield Rows(self.columns, self.types, self._told(values))
            self._next = self._more() if len(values) == self._size else []


def table_of(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Any:
    """Return all rows of a statement as a ``pyarrow.Table``. Enumeration values are texts.

    ``None`` means that a column is not a number, truth value or text; the statement does not run. Arrow and
    Python values of other types differ.
    """

    def step() -> Any:
        relation: Any = connection.sql(sql, params=parameters or None)
        return relation.to_arrow_table() if _is_plain(relation) else None

    table = interruptible(connection, step)
    if table is None:
        return None
    arrow = _package("pyarrow")
    columns = [
        column.cast(arrow.string()) if arrow.types.is_dictionary(column.type) else column
        for column in table.columns
    ]
    return arrow.table(columns, names=table.column_names)


def _is_plain(relation: Any) -> bool:
    kinds = (str(kind) for kind in relation.types)
    return all(kind in _ARROW or _ENUM.fullmatch(kind) for kind in kinds)


def as_told(
    tables: Sequence[Any], columns: Sequence[str] | None = None, most: int | None = None
) -> Any:
    """Concatenate Arrow tables, with the types that Python values would have.

    Parameters
    ----------
    tables : sequence of pyarrow.Table
        At least one table; all with the same columns.
    columns : sequence of str, optional
        New column names.
    most : int, optional
        Largest number of rows.
    """
    arrow = _package("pyarrow")
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


def run(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Rows:
    """Run a trusted SQL statement, and return all rows."""
    values = interruptible(
        connection, lambda: connection.execute(sql, parameters or None).fetchall()
    )
    return Rows(*_described(connection), values)


def _described(result: DuckDBPyConnection) -> tuple[tuple[str, ...], tuple[str, ...]]:
    description = result.description or []
    return tuple(str(one[0]) for one in description), tuple(str(one[1]) for one in description)


def arrays(
    connection: DuckDBPyConnection, sql: str, parameters: Parameters | None, *, plain: bool = False
) -> dict[str, NDArray[np.generic]]:
    """Return all columns as arrays with NULL masked. Enumerations become texts unless ``plain`` is true."""
    given = parameters or None
    described = [] if plain else connection.execute(f"DESCRIBE {sql}", given).fetchall()
    listed = [quoted(str(row[0])) for row in described if "ENUM" in str(row[1])]
    if listed:  # enumerations would become pandas categories
        texts = ", ".join(f"{name}::VARCHAR AS {name}" for name in listed)
        sql = f"SELECT * REPLACE ({texts}) FROM ({sql})"

    def fetched() -> dict[str, NDArray[np.generic]]:
        return connection.execute(sql, given).fetchnumpy()

    return interruptible(connection, fetched)


@contextmanager
def user_statement(
    connection: DuckDBPyConnection, sql: str, timeout_s: float | None, ask: Callable[[], T]
) -> Generator[T]:
    """Run a user's SQL statement on a connection that can read only the store and its views.

    ``ask`` starts the statement. Read the result inside the block.

    Raises
    ------
    SqlError
        The text is not a single read-only statement, the database rejects it, or it runs for too long.
    """
    with _refused(sql, timeout_s):
        _check(connection, sql)
    with _interrupted_after(connection, timeout_s), _refused(sql, timeout_s):
        yield ask()


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
    """Convert DuckDB errors to errors of the user's statement."""
    try:
        yield
    except duckdb.InterruptException as error:
        after = "" if timeout_s is None else f" after {timeout_s:g} s"
        raise SqlError(f"stopped{after}: {_shown(sql)}") from error
    except duckdb.Error as error:
        if (fault := engine_fault(error)) is not None:
            raise EngineError(fault) from error
        message = spill_fault(str(error)) or str(error).strip()
        if "pytz" in message:  # before DuckDB 2.0.1
            message = "times with a time zone cannot be shown; cast them: now()::TIMESTAMP"
        raise SqlError(_TO_A_TABLE.sub(_views, message)) from error


def _views(_: re.Match[str]) -> str:
    return f"The views are {', '.join(expected().views)}."


def _shown(sql: str) -> str:
    line = " ".join(sql.split())
    return line if len(line) <= 80 else f"{line[:79]}…"


@contextmanager
def _interrupted_after(connection: DuckDBPyConnection, timeout_s: float | None) -> Generator[None]:
    """Interrupt the connection after a timeout, repeatedly, until the block ends."""
    if timeout_s is None:
        yield
        return
    done = threading.Event()

    def watch() -> None:
        pause = timeout_s
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


# Rows → tables of optional packages (imported on demand), and CSV -------------------

_ARROW: Final = {
    "BIGINT": "int64",
    "INTEGER": "int32",
    "DOUBLE": "float64",
    "FLOAT": "float32",
    "BOOLEAN": "bool_",
    "VARCHAR": "string",
}
"""Database type → pyarrow function. Other types are inferred from values."""


_ENUM: Final = re.compile(r"ENUM\(('([^']|'')*'(, )?)*\)")

_EXTRAS: Final = {
    "pyarrow": ("tables of Arrow", "arrow"),
    "pandas": ("data frames", "pandas"),
    "polars": ("data frames of polars", "polars"),
}
"""Optional packages: purpose, and the extra that installs them."""


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(*_EXTRAS[name]) from error


def write_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]], to: Path) -> int:
    """Write rows to a CSV file. Missing values are empty; lists and dicts are JSON.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    ExportError
        The file is not writable.
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
    """Convert a Parquet file to an Arrow file (IPC, Feather 2), batch by batch.

    Raises
    ------
    ExportError
        The file is not writable.
    MissingExtraError
        pyarrow is not installed.
    """
    arrow = _package("pyarrow")
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
    """Transpose rows to columns in batches, which keeps related values close in memory."""
    found: list[list[Any]] = [[] for _ in columns]
    rows = iter(rows)
    while batch := list(islice(rows, BATCH)):
        for values, more in zip(found, zip(*batch, strict=True), strict=True):
            values.extend(more)
    return found


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple | dict):
        value = json.dumps(value, ensure_ascii=False, default=str)
    return "" if value is None else without_controls(value) if isinstance(value, str) else value


# Columns or rows → Parquet, block by block, written by DuckDB without another package -----------------

ROW_GROUP: Final = 122_880
"""Rows of a row group."""

_TOGETHER: Final = 50_000
"""Rows written at once. They also determine column types that are not given."""

_TYPES: Final = ((bool, "BOOLEAN"), (int, "BIGINT"), ((int, float), "DOUBLE"))


class ParquetTable:
    """Parquet file, written in blocks of rows. Use it as a context manager.

    Rows wait in a temporary file, not in memory. Equal blocks give equal bytes.

    Parameters
    ----------
    to : Path
        Output file; an existing file is replaced.
    columns : iterable of (str, str)
        Names and DuckDB types: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``.
    enums : bool
        True to keep enumerations. By default they become texts, because not every Parquet reader supports
        dictionaries.
    called : Path, optional
        File name in error messages; default ``to``.

    Attributes
    ----------
    rows : int
        Number of rows written.

    Raises
    ------
    ExportError
        The file is not writable.
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
            rows.execute("SET threads = 1")  # keeps the order of row groups
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
        """Append rows. The data are given as columns.

        Parameters
        ----------
        columns : mapping
            Name → values, for every column. Missing values are masked or ``None``.

        Raises
        ------
        ExportError
            A value does not fit the type of its column, or the disk is full.
        """
        self._add([columns[name] for name in self._columns])

    def add_rows(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append rows of Python values; ``None`` means missing. See :meth:`add`."""
        rows = iter(rows)
        while batch := list(islice(rows, _TOGETHER)):
            self._add([[row[i] for row in batch] for i in range(len(self._columns))])

    def add_arrow(self, block: Any) -> None:
        """Append the rows of a ``pyarrow.Table`` with distinct column names; see :meth:`add`."""
        self._insert(block, len(block))

    def _add(self, columns: Sequence[NDArray[Any] | Sequence[Any]]) -> None:
        data: dict[str, NDArray[Any]] = {}
        for i, values in enumerate(columns):
            if isinstance(values, np.ndarray):
                data[f"c{i}"] = values
            else:
                listed = data[f"c{i}"] = np.empty(len(values), object)
                listed[:] = values
        self._insert(data, len(data["c0"]))

    def _insert(self, block: object, number: int) -> None:
        if not number:
            return
        with self._translated():
            self._connection.register("block", block)
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
    """Write rows to a Parquet file. An existing file is replaced.

    Parameters
    ----------
    columns : sequence of str
        Distinct names.
    rows : iterable of sequences
        Plain Python values; ``None`` means missing.
    to : Path
    types : sequence of str, optional
        DuckDB's types of the columns. Default: the narrowest type of the first 50,000 rows: truth value,
        integer, number, else text.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    ExportError
        The file is not writable, or a later row does not fit the type of its column.
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


def record_batches(
    connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None
) -> ArrowStream | None:
    """Return the columns of a statement, and a stream of Arrow batches, one in memory at a time.

    ``None`` means that pyarrow is missing, or a column is not plain (:func:`table_of`); the statement does not
    run.
    """
    try:
        _package("pyarrow")
    except MissingExtraError:
        return None

    def begun() -> Any:
        relation: Any = connection.sql(sql, params=parameters or None)
        if not _is_plain(relation):
            return None, ()
        begin = getattr(relation, "to_arrow_reader", None) or relation.fetch_record_batch
        return begin(_TOGETHER), list(zip(relation.columns, map(str, relation.types), strict=True))

    def more() -> Any:
        try:
            return next(reader, None)
        except (OSError, ValueError) as error:  # Arrow wraps a database error
            stopped = "INTERRUPT" in str(error)
            raise (duckdb.InterruptException if stopped else duckdb.Error)(str(error)) from error

    reader, columns = interruptible(connection, begun)
    return reader and (columns, iter(lambda: interruptible(connection, more), None))


def as_told_batches(columns: Sequence[str], stream: ArrowStream) -> ArrowStream:
    """Return an Arrow stream with new column names and with the types that Python values would have."""
    (named, batches), first, rows = stream, list[Any](), 0
    for batch in batches:
        first.append(batch)
        if (rows := rows + len(batch)) >= _TOGETHER:
            break
    arrow = _package("pyarrow")
    seen = arrow.Table.from_batches(first).slice(0, _TOGETHER) if first else ()
    wide = {"INTEGER": "BIGINT", "FLOAT": "DOUBLE"}
    kinds = ["VARCHAR" if kind.startswith("ENUM") else wide.get(kind, kind) for _, kind in named]
    for i in range(len(kinds)):
        if not rows or seen[i].null_count == len(seen):
            kinds[i] = "VARCHAR"
    return list(zip(columns, kinds, strict=True)), chain(first, batches)


def write_batches(stream: ArrowStream, to: Path) -> int:
    """Write Arrow batches to a Parquet file like :func:`write_parquet`, and return the number of rows.

    Raises
    ------
    ExportError
        The file is not writable.
    """
    columns, batches = stream
    arrow = _package("pyarrow")
    names = [f"c{i}" for i in range(len(columns))]
    with written_at(to) as place, ParquetTable(place, columns, enums=True, called=to) as table:
        for batch in batches:
            arrays = [_without_nan(column) for column in batch.columns]
            table.add_arrow(arrow.Table.from_arrays(arrays, names=names))
    return table.rows


def _without_nan(column: Any) -> Any:
    compute = import_module("pyarrow.compute")
    if not import_module("pyarrow").types.is_floating(column.type):
        return column
    return compute.if_else(compute.is_nan(column), None, column)


def _type_of(values: list[Any]) -> str:
    known = [value for value in values if value is not None]
    for kind, name in _TYPES:
        narrow = all(isinstance(v, kind) for v in known)
        truth = any(isinstance(v, bool) for v in known)
        if known and narrow and truth == (name == "BOOLEAN"):
            return name
    return "VARCHAR"


def count_parquet(file: Path) -> tuple[int, tuple[str, ...]]:
    """Read a whole Parquet file, and return its number of rows and its column names.

    Raises
    ------
    ExportError
        The file is not readable.
    """
    try:
        with duckdb.connect() as connection:
            found = Batches(connection, "FROM read_parquet(?)", [str(file)])
            return sum(len(batch) for batch in found), found.columns
    except duckdb.Error as error:
        raise ExportError(f"{file.name}: cannot be read back: {str(error).strip()}") from error


# Temporary tables of a user's statement ------------------------------------------------------------

UserTablesGiven = Callable[[], Iterable[Given]]
"""Function that returns the temporary tables of a user's statement. Called while the store is open."""


def give_to_user(
    connection: DuckDBPyConnection,
    given: UserTablesGiven | None,
    sql: str,
    timeout_s: float | None,
) -> None:
    """Create temporary tables for a user's SQL statement, by trusted statements.

    Raises
    ------
    SqlError
        The statements take too long, or too much memory.
    """
    if given is None:
        return
    with _interrupted_after(connection, timeout_s), _refused(sql, timeout_s):
        connection.execute(f"USE {INSIDE}")
        give(connection, given())
        connection.execute("USE main")
