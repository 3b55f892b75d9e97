"""Rows → Parquet, by DuckDB, so that nobody needs another package for it."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import duckdb
import numpy as np

from sgstore.errors import ExportError
from sgstore.quoting import literal, quoted

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Sequence

BATCH: Final = 50_000
"""Rows that are held at a time."""

_TYPES: Final = ((bool, "BOOLEAN"), (int, "BIGINT"), ((int, float), "DOUBLE"))


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
    batch = list(islice(rows, BATCH))
    types = types or [_type_of([row[i] for row in batch]) for i in range(len(columns))]
    named = ", ".join(f"{quoted(n)} {t}" for n, t in zip(columns, types, strict=True))
    number = 0
    # A file of its own, and not memory, takes what the rows add up to.
    with (
        tempfile.TemporaryDirectory() as folder,
        _translated(to),
        duckdb.connect(str(Path(folder) / "rows.duckdb")) as connection,
    ):
        connection.execute(f"CREATE TABLE output ({named})")
        while batch:
            _append(connection, batch, len(columns))
            number += len(batch)
            batch = list(islice(rows, BATCH))
        connection.execute(f"COPY output TO {literal(str(to))} (FORMAT parquet)")
    return number


def _append(connection: duckdb.DuckDBPyConnection, batch: list[Sequence[Any]], width: int) -> None:
    data: dict[str, np.ndarray[Any, np.dtype[np.object_]]] = {}
    for i in range(width):
        data[f"c{i}"] = np.empty(len(batch), np.object_)
        data[f"c{i}"][:] = [row[i] for row in batch]
    connection.register("batch", data)
    connection.execute("INSERT INTO output SELECT * FROM batch")
    connection.unregister("batch")


def _type_of(values: list[Any]) -> str:
    known = [value for value in values if value is not None]
    for kind, name in _TYPES:
        narrow = all(isinstance(v, kind) for v in known)
        truth = any(isinstance(v, bool) for v in known)
        if known and narrow and truth == (name == "BOOLEAN"):
            return name
    return "VARCHAR"


@contextmanager
def _translated(to: Path) -> Generator[None]:
    try:
        yield
    except duckdb.Error as error:
        raise ExportError(f"{to}: {str(error).strip()}") from error
