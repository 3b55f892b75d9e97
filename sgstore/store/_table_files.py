"""Table rows and columns as Parquet and CSV files, and as DuckDB relations (SQL table objects).

DuckDB writes Parquet without another package.
"""

from __future__ import annotations

import csv
import json
from contextlib import ExitStack, contextmanager
from importlib import import_module
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final, Self

import duckdb
import numpy as np

from sgstore.base.output_files import without_controls, written_at, written_text
from sgstore.base.quoting import literal, quoted
from sgstore.base.temporary_folders import temporary_folder, working_folder
from sgstore.errors import ExportError, StoreError
from sgstore.store._arrow import ROWS_AT_ONCE, as_told_batches, package
from sgstore.store._locking import default_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.store._arrow import ArrowStream


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


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple | dict):
        value = json.dumps(value, ensure_ascii=False, default=str)
    return "" if value is None else without_controls(value) if isinstance(value, str) else value


ROW_GROUP: Final = 122_880
"""Number of rows in a row group of a Parquet file."""


_TYPES: Final = ((bool, "BOOLEAN"), (int, "BIGINT"), ((int, float), "DOUBLE"))


class ParquetTable:
    """Writer of a Parquet file, in blocks of rows. It is a context manager.

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
        """Append rows to the Parquet file. The rows are given as columns.

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
        """Append rows of Python values to the Parquet file; ``None`` means missing."""
        rows = iter(rows)
        while batch := list(islice(rows, ROWS_AT_ONCE)):
            self._add([[row[i] for row in batch] for i in range(len(self._columns))])

    def add_arrow(self, block: Any) -> None:
        """Append the rows of a ``pyarrow.Table`` to the Parquet file. Column names must be distinct."""
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

    @staticmethod
    def write_rows(
        columns: Sequence[str],
        rows: Iterable[Sequence[Any]],
        to: Path,
        types: Sequence[str] | None = None,
    ) -> int:
        """Write rows of Python values to a Parquet file. An existing file is replaced.

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
            first = list(islice(rows, ROWS_AT_ONCE))
            types = [_type_of([row[i] for row in first]) for i in range(len(columns))]
            rows = chain(first, rows)
        with (
            written_at(to) as place,
            ParquetTable(place, zip(columns, types, strict=True), enums=True, called=to) as table,
        ):
            table.add_rows(rows)
        return table.rows

    @staticmethod
    def read_rows(path: Path, columns: Sequence[str], later: str = "") -> list[tuple[Any, ...]]:
        """Return some columns of a Parquet file as rows. If a file lacks the column ``later``, it is NULL.

        Raises
        ------
        StoreError
            The file is not readable, or lacks a column.
        """
        rows = "FROM read_parquet(?)"
        if later in columns:
            null = f"SELECT NULL::VARCHAR AS {quoted(later)} WHERE FALSE"
            rows = f"FROM ({null} UNION ALL BY NAME {rows})"
        try:
            with duckdb.connect(":memory:") as connection:
                sql = f"SELECT {', '.join(map(quoted, columns))} {rows}"
                return connection.execute(sql, [str(path)]).fetchall()
        except duckdb.Error as error:
            raise StoreError(f"{path}: cannot be read: {str(error).strip()}") from error

    @staticmethod
    def write_batches(stream: ArrowStream, to: Path, names: Sequence[str] | None = None) -> int:
        """Write Arrow batches to a Parquet file, and return the number of rows.

        Parameters
        ----------
        stream : (columns, batches)
        to : Path
        names : sequence of str, optional
            New column names. The columns then get the types that Python values would have.

        Raises
        ------
        ExportError
            The file is not writable.
        """
        columns, batches = stream if names is None else as_told_batches(names, stream)
        arrow = package("pyarrow")
        places = [f"c{i}" for i in range(len(columns))]
        with written_at(to) as place, ParquetTable(place, columns, enums=True, called=to) as table:
            for batch in batches:
                arrays = [_without_nan(column) for column in batch.columns]
                table.add_arrow(arrow.Table.from_arrays(arrays, names=places))
        return table.rows

    @staticmethod
    def to_arrow(source: Path, to: Path) -> None:
        """Convert a Parquet file to an Arrow file (IPC, Feather 2), batch by batch.

        Raises
        ------
        ExportError
            The file is not writable.
        MissingExtraError
            pyarrow is not installed.
        """
        arrow = package("pyarrow")
        parquet = import_module("pyarrow.parquet")
        with (
            written_at(to) as place,
            parquet.ParquetFile(source) as file,
            arrow.OSFile(str(place), "wb") as sink,
            arrow.ipc.new_file(sink, file.schema_arrow) as writer,
        ):
            for batch in file.iter_batches():
                writer.write_batch(batch)


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


def relation_of(write: Callable[[Path], object]) -> duckdb.DuckDBPyRelation:
    """Call a function that writes a Parquet file. Return its rows as a DuckDB table ``answer``."""
    with working_folder("relation") as folder:
        file = folder / "answer.parquet"
        write(file)
        spill, memory = temporary_folder() / "relations", f"{default_memory() >> 20}MiB"
        held = duckdb.connect(config={"temp_directory": str(spill), "memory_limit": memory})
        held.execute(f"CREATE TABLE answer AS FROM read_parquet({literal(str(file))})")
    return held.table("answer")
