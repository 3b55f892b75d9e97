"""Rows → tables of Arrow, pandas and polars, and CSV; the packages are imported when they are asked for."""

from __future__ import annotations

import csv
import json
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

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
    try:
        with to.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            for row in rows:
                writer.writerow([_cell(value) for value in row])
                number += 1
    except OSError as error:
        raise ExportError(f"{to}: {error.strerror or error}") from error
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
    try:
        with (
            parquet.ParquetFile(source) as file,
            arrow.OSFile(str(to), "wb") as sink,
            arrow.ipc.new_file(sink, file.schema_arrow) as writer,
        ):
            for batch in file.iter_batches():
                writer.write_batch(batch)
    except OSError as error:
        raise ExportError(f"{to}: {error.strerror or error}") from error


def _columns(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    found = [list(values) for values in zip(*rows, strict=True)]
    return found or [[] for _ in columns]


def _cell(value: Any) -> Any:
    if isinstance(value, list | tuple | dict):
        return json.dumps(value, ensure_ascii=False, default=str)
    return "" if value is None else value


def _package(name: str, purpose: str, extra: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(purpose, extra) from error
