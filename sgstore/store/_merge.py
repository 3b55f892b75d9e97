"""Answers of parts of a collection, which wait in Parquet files, as tables of one statement.

The statement is ours (:mod:`sgstore.lang._parts`): it puts rows in order, or groups what the parts have
grouped. What does not fit into memory spills to disk.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import sgstore.store._schema as shape
from sgstore.errors import StoreError
from sgstore.quoting import literal, quoted
from sgstore.records import dataclass
from sgstore.store._locking import default_memory, spill_folder, translated, without_faults
from sgstore.store._packing import SEQ_BITS
from sgstore.store._rows import Batches, ParquetTable
from sgstore.store._staging import scratch
from sgstore.vocabulary import NAMES

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping, Sequence

    from sgstore.store._file import StoreFile
    from sgstore.store._rows import Given, Parameters


_EXACT: Final = {"HUGEINT": "DECIMAL(38,0)", "UHUGEINT": "DECIMAL(38,0)"}
"""Types that Parquet has not, and those that hold the same whole numbers."""


@dataclass(frozen=True, slots=True)
class PartFile:
    """Rows of one part of an answer.

    Attributes
    ----------
    path : Path
    columns, types : tuple of str
        Of the rows; types as the database calls them.
    rows : int
    """

    path: Path
    columns: tuple[str, ...]
    types: tuple[str, ...]
    rows: int

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        about = {"columns": list(self.columns), "types": list(self.types), "rows": self.rows}
        return {"path": str(self.path)} | about

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PartFile:
        """The part that plain values describe."""
        columns, types = tuple(values["columns"]), tuple(values["types"])
        return cls(Path(values["path"]), columns, types, values["rows"])


def write_part(
    file: StoreFile, sql: str, parameters: Parameters, given: Iterable[Given], to: Path
) -> PartFile:
    """Write the rows of a statement of ours on a store to a Parquet file, as they come."""
    with file.batches(sql, parameters, given=given) as batches:
        kinds = [_EXACT.get(kind, kind) for kind in batches.types]
        # Their names may differ in case alone, which Parquet does not tell apart.
        columns = [(f"c{number}", kind) for number, kind in enumerate(kinds)]
        with ParquetTable(to, columns) as table:
            for batch in batches:
                table.add_rows(batch.values)
        return PartFile(to, batches.columns, batches.types, table.rows)


def write_classes(
    file: StoreFile, abstraction: str, traces: Sequence[int], table: str, to: Path
) -> PartFile:
    """Write the classes that frames have in an abstraction: of some traces, or of a user's own table.

    Parameters
    ----------
    file : StoreFile
    abstraction : str
    traces : sequence of int
        Ids; those that are elsewhere do not count.
    table : str
        The name of the table; empty: of the traces.
    to : Path
    """
    of = "SELECT DISTINCT c.class FROM classes c"
    known = "c.abstraction = $1 AND c.class IS NOT NULL"
    if table:
        sql = f"{of} JOIN {quoted(table)} u ON u.frame_id = c.frame_id WHERE {known}"
        return write_part(file, sql, [abstraction], (), to)
    sql = (
        f"{of} WHERE {known} AND c.frame_id >> {SEQ_BITS} IN (SELECT unnest(CAST($2 AS BIGINT[])))"
    )
    return write_part(file, sql, [abstraction, [*traces]], (), to)


@contextmanager
def merged_parts(
    parts: Mapping[str, Sequence[PartFile]],
    words: Mapping[str, Sequence[str]],
    sql: str,
    values: Sequence[Any],
    *,
    memory: int = 0,
) -> Generator[Batches]:
    """The rows of a statement over the answers of parts.

    Parameters
    ----------
    parts : mapping of str to sequence of PartFile
        Table of the statement → its rows; those of a table have the same columns.
    words : mapping of str to sequence of str
        Enumeration → the values that stores of the collection have beside those of ``schema.sql``.
    sql : str
    values : sequence
        What it binds.
    memory : int
        Most memory that it may take; bytes. 0: as a store takes.
    """
    connection = scratch(
        spill_folder(), memory=memory or default_memory(), threads=os.cpu_count() or 1
    )
    with connection, translated(Path("collection")):
        without_faults(connection)
        for enum in NAMES:
            labels = [*shape.own_labels(enum), *words.get(enum, ())]
            listed = ", ".join(map(literal, dict.fromkeys(labels)))
            connection.execute(f"CREATE TYPE {enum} AS ENUM ({listed})")
        for table, files in parts.items():
            connection.execute(f"CREATE TEMP VIEW {quoted(table)} AS {_rows_of(files)}")
        yield Batches(connection, sql, {str(n): v for n, v in enumerate(values, 1)})


def _rows_of(files: Sequence[PartFile]) -> str:
    """The statement whose rows are those of some files, with the types that they had."""
    if not files:
        raise StoreError("nothing was answered")
    first = files[0]
    if any(one.columns != first.columns for one in files):
        raise StoreError("parts of an answer have different columns")
    listed: list[str] = []
    for number, name in enumerate(first.columns):
        kinds = {one.types[number] for one in files}
        listed.append(f"CAST(c{number} AS {_common(kinds)}) AS {quoted(name)}")
    places = ", ".join(literal(str(one.path)) for one in files)
    return f"SELECT {', '.join(listed)} FROM read_parquet([{places}], union_by_name = true)"


_WIDTHS: Final = (
    *("BOOLEAN", "TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "FLOAT", "DOUBLE"),
)


def _common(kinds: set[str]) -> str:
    """The type that holds the values of some types of one column: a part may know no value of it."""
    enums = {_enum_of(kind) for kind in kinds if kind.startswith("ENUM")}
    if enums:
        return enums.pop() if len(enums) == 1 and len(kinds - {'"NULL"'}) >= 1 else "VARCHAR"
    known = kinds - {'"NULL"', "NULL"}
    if len(known) <= 1:
        return next(iter(known), "INTEGER")
    if known <= set(_WIDTHS):
        return max(known, key=_WIDTHS.index)
    return "VARCHAR"


def _enum_of(kind: str) -> str:
    """The enumeration of ours that a type is, by its first values: stores may have added some."""
    for enum in NAMES:
        head = ", ".join(map(literal, shape.own_labels(enum)))
        if kind.startswith(f"ENUM({head}"):
            return enum
    return "VARCHAR"
