"""Query results of the stores of a collection, combined by one SQL statement over all stores' results.

The statement comes from :mod:`sgstore.lang.sql.collection_parts`: it sorts rows, or combines the groups of the
parts. Data beyond the memory limit spill to disk.
"""

from __future__ import annotations

import os
import secrets
import shutil
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import sgstore.store._schema as shape
from sgstore.base.quoting import literal, quoted
from sgstore.errors import StoreError
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.model.vocabulary import NAMES
from sgstore.store._engine_errors import move, translated
from sgstore.store._interrupts import interruptible
from sgstore.store._joins import tables_folder
from sgstore.store._lease import shared_instance
from sgstore.store._locking import default_memory, spill_folder
from sgstore.store._rows import Batches, arrays
from sgstore.store._staging import scratch
from sgstore.store._table_files import ParquetTable

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping, Sequence

    import numpy as np
    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._classes import CodedClasses
    from sgstore.store._file import StoreFile
    from sgstore.store._rows import Parameters
    from sgstore.store._temporary_tables import Given

    Written = tuple[Path | None, tuple[str, ...], int, list[tuple[Any, ...]]]
    """Partial result: path of its file or None, column types, number of rows, and the rows if few."""


_EXACT: Final = {"HUGEINT": "DECIMAL(38,0)", "UHUGEINT": "DECIMAL(38,0)"}
"""Types that Parquet lacks → types that hold the same integers."""

_NOTHING: Final = ""
"""Database type of a column in which all values are NULL."""

FEW: Final = 200
"""Largest number of rows that stay in memory. Writing a file would take as long as a query."""

_PLAIN: Final = frozenset(
    {"BOOLEAN", "TINYINT", "SMALLINT", "INTEGER", "BIGINT", "FLOAT", "DOUBLE", "VARCHAR"}
)
"""Database types whose values are equal in Python and JSON. Enumeration values become texts."""


@dataclass(frozen=True, slots=True)
class PartFile:
    """Rows of a query result from one part (store) of a collection, in memory or in a Parquet file.

    Attributes
    ----------
    path : Path
        File of the rows. It does not exist for no rows or few rows.
    columns, types : tuple of str
        Names and database types of the columns.
    rows : int
    few : list of tuple
        The rows if they are few and of plain types; else empty.
    """

    path: Path
    columns: tuple[str, ...]
    types: tuple[str, ...]
    rows: int
    few: Sequence[Sequence[Any]] = ()

    @property
    def written(self) -> bool:
        """True if the rows of the query result are in a file, not in memory."""
        return bool(self.rows) and not self.few

    def as_dict(self) -> dict[str, Any]:
        """Return the partial query result as a dict of plain values, for another process."""
        about = {"columns": list(self.columns), "types": list(self.types), "rows": self.rows}
        return {"path": str(self.path) if self.written else "", "few": self.few} | about

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PartFile:
        """Restore a partial query result from a dict of plain values."""
        columns, types = tuple(values["columns"]), tuple(values["types"])
        return cls(Path(values["path"]), columns, types, values["rows"], values["few"])

    def moved(self, folder: Path) -> PartFile:
        """Move the file of a partial query result into another folder, and return the moved result."""
        if not self.written:
            return self
        to = folder / self.path.name
        return replace(self, path=move(self.path, to, f"{folder}: cannot be written"))

    @staticmethod
    def of_statement(
        file: StoreFile,
        statement: tuple[str, Parameters],
        columns: Sequence[str],
        given: Iterable[Given],
        to: Path,
    ) -> PartFile:
        """Run a trusted SQL statement on a store, and write its rows to a Parquet file.

        Parameters
        ----------
        file : StoreFile
        statement : (str, values)
            SQL statement and its parameter values.
        columns : sequence of str
            Column names of the result.
        given : iterable
            Temporary tables, as for :meth:`StoreFile.batches`.
        to : Path
        """
        sql, values = statement
        made = _making(sql, len(columns))
        table: Any = made, values
        with file.asked(_written, [*given, table]) as (place, kinds, rows, few):
            if place is not None:
                shutil.move(place, to)
        return PartFile(to, tuple(columns), kinds, rows, few)

    @staticmethod
    def of_classes(
        file: StoreFile, abstraction: str, traces: Sequence[int], table: str, to: Path
    ) -> PartFile:
        """Write the class names of some traces, or of the frames in a user table, to a file.

        Parameters
        ----------
        file : StoreFile
        abstraction : str
        traces : sequence of int
            Trace ids; ids outside this store are ignored.
        table : str
            Name of the user table; empty: use ``traces``.
        to : Path
        """
        of = "SELECT DISTINCT c.class FROM classes c"
        known = "c.abstraction = $1 AND c.class IS NOT NULL"
        if table:
            sql = f"{of} JOIN {quoted(table)} u ON u.frame_id = c.frame_id WHERE {known}"
            return PartFile.of_statement(file, (sql, [abstraction]), ["class"], (), to)
        sql = f"{of} WHERE {known} AND c.frame_id >> {SEQ_BITS} IN (SELECT unnest(CAST($2 AS BIGINT[])))"
        return PartFile.of_statement(file, (sql, [abstraction, [*traces]]), ["class"], (), to)

    @staticmethod
    def of_coded(file: StoreFile, abstraction: str, to: Path) -> PartFile:
        """Write the class of each frame in an abstraction to a file, for :meth:`merged_classes`."""
        columns = {"class": "VARCHAR", "bucket": "BIGINT", "mask": "BIGINT"}
        return PartFile.of_rows(columns, file.abstracted.masks(abstraction), to)

    @staticmethod
    def of_rows(columns: Mapping[str, str], rows: Iterable[Sequence[Any]], to: Path) -> PartFile:
        """Write rows of Python values to a file, as a partial query result.

        ``columns`` maps column names to database types.
        """
        names, types = [f"c{number}" for number in range(len(columns))], (*columns.values(),)
        return PartFile(to, tuple(columns), types, ParquetTable.write_rows(names, rows, to, types))

    @staticmethod
    def merged_classes(parts: Sequence[PartFile]) -> CodedClasses:
        """Return the class of each frame, as a number, from the results of several stores."""
        from sgstore.store._classes import classes_coded

        with _tables({"parts": [*parts]}, {}) as connection:
            return classes_coded(connection, "SELECT class, bucket, mask FROM parts")

    @staticmethod
    def merged_arrays(
        parts: Parts, words: Mapping[str, Sequence[str]], sql: str, values: Sequence[Any]
    ) -> dict[str, NDArray[np.generic]]:
        """Run SQL over the query results of several stores, and return its columns as arrays.

        NULL values are masked.
        """
        with _tables(parts, words) as connection:
            return arrays(connection, sql, _numbered(values))

    @staticmethod
    @contextmanager
    def merged_rows(
        parts: Parts, words: Mapping[str, Sequence[str]], sql: str, values: Sequence[Any]
    ) -> Generator[Batches]:
        """Run SQL over the query results of several stores, and stream its rows.

        Parameters
        ----------
        parts : mapping of str to sequence of PartFile
            See :data:`Parts`.
        words : mapping of str to sequence of str
            Enumeration → values in the collection that ``schema.sql`` lacks.
        sql : str
        values : sequence
            Parameter values.
        """
        with _tables(parts, words) as connection:
            yield Batches(connection, sql, _numbered(values))

    @staticmethod
    def merged(
        parts: Parts,
        words: Mapping[str, Sequence[str]],
        statement: tuple[str, Sequence[Any]],
        columns: Sequence[str],
        to: Path,
    ) -> PartFile:
        """Run SQL over the query results of several stores, and write its rows as a new partial result.

        Parameters
        ----------
        parts, words
            See :meth:`merged_rows`.
        statement : (str, values)
            SQL statement and its parameter values.
        columns : sequence of str
            Column names of the result.
        to : Path
        """
        sql, values = statement
        with _tables(parts, words) as connection:
            made = _making(sql, len(columns))

            def step() -> Written:
                connection.execute(made, _numbered(values) or None)
                return _written(connection)

            place, kinds, rows, few = interruptible(connection, step)
        if place is not None:
            shutil.move(place, to)
        return PartFile(to, tuple(columns), kinds, rows, few)


_PART: Final = quoted(":part")


def _making(sql: str, columns: int) -> str:
    # Column names may differ only in case, which tables and Parquet do not distinguish.
    names = ", ".join(f"c{number}" for number in range(columns))
    return f"CREATE OR REPLACE TEMP TABLE {_PART} AS SELECT * FROM (\n{sql}\n) AS t({names})"


def _written(connection: DuckDBPyConnection) -> Written:
    """Write a partial result to a Parquet file and return its description. A small result stays in memory."""
    described = connection.execute(f"DESCRIBE {_PART}").fetchall()
    kinds = {str(row[0]): str(row[1]) for row in described}
    # A column with only NULL has no type, which a table does not support.
    whole = [name for name, kind in kinds.items() if kind == "INTEGER"]
    counted = ", ".join(["count(*)", *(f"count({name})" for name in whole)])
    rows, *known = connection.execute(f"SELECT {counted} FROM {_PART}").fetchall()[0]
    for name, number in zip(whole, known, strict=True):
        kinds[name] = kinds[name] if number else _NOTHING
    place, few = None, list[tuple[Any, ...]]()
    if rows and rows <= FEW and all(map(_is_plain, kinds.values())):
        few = connection.execute(f"SELECT * FROM {_PART}").fetchall()
    elif rows:
        place = tables_folder() / f"part-{secrets.token_hex(8)}.parquet"
        tables_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        listed = [
            f"CAST({n} AS {_EXACT[k]}) AS {n}" if k in _EXACT else n for n, k in kinds.items()
        ]
        copied = f"SELECT {', '.join(listed)} FROM {_PART}"
        connection.execute(f"COPY ({copied}) TO {literal(str(place))} (FORMAT parquet)")
    connection.execute(f"DROP TABLE {_PART}")
    return place, tuple(kinds.values()), rows, few


def _is_plain(kind: str) -> bool:
    return kind in _PLAIN or kind == _NOTHING or kind.startswith("ENUM")


Parts = dict[str, list[PartFile]]
"""Partial results by the name of their table in SQL. All results of a table have the same columns."""


def _numbered(values: Sequence[Any]) -> dict[str, Any]:
    return {str(n): v for n, v in enumerate(values, 1)}


@contextmanager
def _tables(parts: Parts, words: Mapping[str, Sequence[str]]) -> Generator[DuckDBPyConnection]:
    """Yield a database connection that has the query results of several stores as tables."""
    kinds = {
        enum: tuple(dict.fromkeys([*shape.own_labels(enum), *words.get(enum, ())]))
        for enum in NAMES
    }
    with translated(Path("collection")):
        instance = shared_instance(("merging", *kinds.items()), lambda: _merging(kinds))
    with instance.cursor() as connection, translated(Path("collection")):
        for table, files in parts.items():
            told = _told(connection, table, files)
            connection.execute(f"CREATE TEMP VIEW {quoted(table)} AS {_rows_of(files, told)}")
        yield connection


def _told(
    connection: DuckDBPyConnection, table: str, files: Sequence[PartFile]
) -> dict[tuple[str, ...], str]:
    """Create temporary tables for the partial results in memory. Return column types → table name."""
    alike: dict[tuple[str, ...], list[Sequence[Any]]] = {}
    for one in files:
        if one.few:
            alike.setdefault(one.types, []).extend(one.few)
    made: dict[tuple[str, ...], str] = {}
    for number, (types, rows) in enumerate(alike.items()):
        made[types] = quoted(f"{table} few {number}")
        kinds = [kind if kind in _PLAIN else "VARCHAR" for kind in types]
        listed = (f"unnest(CAST(${n} AS {k}[])) AS c{n - 1}" for n, k in enumerate(kinds, 1))
        columns = [list(column) for column in zip(*rows, strict=True)]
        connection.execute(
            f"CREATE TEMP TABLE {made[types]} AS SELECT {', '.join(listed)}", columns
        )
    return made


def _merging(kinds: Mapping[str, Sequence[str]]) -> DuckDBPyConnection:
    connection = scratch(spill_folder(), memory=default_memory(), threads=os.cpu_count() or 1)
    for enum, labels in kinds.items():
        connection.execute(f"CREATE TYPE {enum} AS ENUM ({', '.join(map(literal, labels))})")
    return connection


def _rows_of(files: Sequence[PartFile], told: Mapping[tuple[str, ...], str]) -> str:
    """Return SQL for the rows of several partial results (files and tables), with common column types."""
    if not files:
        raise StoreError("nothing was answered")
    first = files[0]
    if any(one.columns != first.columns for one in files):
        raise StoreError("parts of an answer have different columns")
    common = [_common(set(kinds)) for kinds in zip(*(one.types for one in files), strict=True)]
    alike: dict[tuple[str, ...], list[Path]] = {}
    for one in files:
        if one.written:
            alike.setdefault(one.types, []).append(one.path)
    sources = [*told.items()]
    for types, paths in alike.items():
        sources.append((types, f"read_parquet([{', '.join(literal(str(p)) for p in paths)}])"))
    if not sources:
        none = (
            f"CAST(NULL AS {k}) AS {quoted(n)}" for k, n in zip(common, first.columns, strict=True)
        )
        return f"SELECT {', '.join(none)} LIMIT 0"
    parts: list[str] = []
    for types, source in sources:
        values = ("NULL" if t == _NOTHING else f"c{n}" for n, t in enumerate(types))
        casts = (f"CAST({value} AS {kind})" for value, kind in zip(values, common, strict=True))
        listed = ", ".join(f"{c} AS {quoted(n)}" for c, n in zip(casts, first.columns, strict=True))
        parts.append(f"SELECT {listed} FROM {source}")
    return "\nUNION ALL\n".join(parts)


_WIDTHS: Final = (
    *("BOOLEAN", "TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "FLOAT", "DOUBLE"),
)


def _common(kinds: set[str]) -> str:
    """Return the common database type for several types of one column."""
    enums = {_enum_of(kind) for kind in kinds if kind.startswith("ENUM")}
    if enums:
        return enums.pop() if len(enums) == 1 and len(kinds - {_NOTHING}) >= 1 else "VARCHAR"
    known = kinds - {_NOTHING}
    if len(known) <= 1:
        return next(iter(known), "INTEGER")
    if known <= set(_WIDTHS):
        return max(known, key=_WIDTHS.index)
    return "VARCHAR"


def _enum_of(kind: str) -> str:
    """Return the name of the ``schema.sql`` enumeration that a database type extends."""
    for enum in NAMES:
        head = ", ".join(map(literal, shape.own_labels(enum)))
        if kind.startswith(f"ENUM({head}"):
            return enum
    return "VARCHAR"
