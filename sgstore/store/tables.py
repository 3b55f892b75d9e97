"""Columns → Parquet, block by block, by DuckDB, so that nobody needs another package for it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import duckdb

from sgstore.errors import ExportError
from sgstore.quoting import literal, quoted
from sgstore.store.rows import Batches

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

ROW_GROUP: Final = 122_880
"""Rows of a row group."""


class ParquetTable:
    """A Parquet file that is written a block of rows at a time; to be used in a ``with``.

    What the blocks add up to waits in a file of its own, not in memory. The same blocks are the same bytes.

    Parameters
    ----------
    to : Path
        The file; one that is there is replaced.
    columns : mapping
        Name → type as DuckDB has it: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``.

    Attributes
    ----------
    rows : int
        How many were written.

    Raises
    ------
    ExportError
        The file cannot be written.
    """

    def __init__(self, to: Path, columns: Mapping[str, str]) -> None:
        self.rows = 0
        self._to = to
        self._folder = tempfile.TemporaryDirectory()
        self._connection = duckdb.connect(str(Path(self._folder.name) / "rows.duckdb"))
        self._connection.execute("SET threads = 1")  # so that row groups come in one order
        # Enumerations would become dictionaries that not every reader of Parquet knows.
        self._columns = {
            name: "VARCHAR" if kind.startswith("ENUM") else kind for name, kind in columns.items()
        }
        named = ", ".join(f"{quoted(name)} {kind}" for name, kind in self._columns.items())
        self._do(f"CREATE TABLE output ({named})")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        try:
            if kind is None:
                to = literal(str(self._to))
                self._do(f"COPY output TO {to} (FORMAT parquet, ROW_GROUP_SIZE {ROW_GROUP})")
        finally:
            self._connection.close()
            self._folder.cleanup()

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
        import numpy as np  # with the caller's arrays it is there already

        data: dict[str, Any] = {}
        for i, name in enumerate(self._columns):
            values = columns[name]
            if not isinstance(values, np.ndarray):
                listed = np.empty(len(values), object)
                listed[:] = values
                values = listed
            data[f"c{i}"] = values
        number = len(data["c0"])
        if not number:
            return
        self._connection.register("block", data)
        self._do("INSERT INTO output SELECT * FROM block")
        self._connection.unregister("block")
        self.rows += number

    def _do(self, statement: str) -> None:
        try:
            self._connection.execute(statement)
        except duckdb.Error as error:
            raise ExportError(f"{self._to}: {str(error).strip()}") from error


def count_parquet(file: Path) -> tuple[int, tuple[str, ...]]:
    """How many rows a Parquet file has, and the names of its columns, read again as a whole.

    Raises
    ------
    ExportError
        It cannot be read.
    """
    try:
        with duckdb.connect() as connection:
            found = Batches(connection.execute("FROM read_parquet(?)", [str(file)]), 50_000)
            return sum(len(batch) for batch in found), found.columns
    except duckdb.Error as error:
        raise ExportError(f"{file.name}: cannot be read back: {str(error).strip()}") from error
