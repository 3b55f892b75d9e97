"""User tables (such as labels or splits) that are joined to the frames of a store.

A table is a file (Parquet, CSV, JSON) or a data frame. A separate database reads it once and writes it as
Parquet into a folder of this process. Store connections can read files only there, and see each table as a
view. So memory does not grow with the length of a table.

Key columns of a row are ``frame_id``, or ``trace`` and one of ``seq``, ``time_ns``, ``t`` (seconds since the
trace start). A time selects the nearest frame within half a period of the trace. ``trace`` alone selects all
frames of the trace. The view of such a table has the column ``frame_id``, NULL for a missing frame. Join a
table without key columns yourself, by any of its columns.
"""

from __future__ import annotations

import re
import secrets
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.base.display import number_of
from sgstore.base.quoting import literal
from sgstore.base.temporary_folders import temporary_folder
from sgstore.errors import StoreError
from sgstore.lang.catalog import TableFacts, Type
from sgstore.store._packing import TOLERANCE

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping

    from duckdb import DuckDBPyConnection

    from sgstore.lang.catalog import Catalog


MEMORY: Final = 256 << 20
"""Memory limit for reading a table; bytes. Beyond it, the database writes temporary files."""

MAX_TABLES: Final = 64
"""Largest number of user tables of a store."""

_NAME: Final = re.compile(r"[A-Za-z_]\w{0,62}", re.ASCII)
_TAKEN: Final = frozenset({"ego", "env", "frame", "trace"})
"""Names that have another meaning in query patterns, and are not allowed for user tables."""

_READERS: Final = {
    ".parquet": "read_parquet({})",
    ".pq": "read_parquet({})",
    ".csv": "read_csv({}, header = true, sample_size = -1)",
    ".tsv": "read_csv({}, header = true, sample_size = -1)",
    ".json": "read_json_auto({})",
    ".jsonl": "read_json_auto({}, format = 'newline_delimited')",
    ".ndjson": "read_json_auto({}, format = 'newline_delimited')",
}

_BY_FRAME: Final = """
SELECT TRY_CAST(u.frame_id AS BIGINT) AS frame_id, u.* EXCLUDE (frame_id) FROM {0} u
"""
_BY_NUMBER: Final = """
SELECT f.frame_id, u.* FROM {0} u
LEFT JOIN frames f ON f.trace = CAST(u.trace AS VARCHAR) AND f.seq = TRY_CAST(u.seq AS BIGINT)
"""
_BY_TRACE: Final = """
SELECT f.frame_id, u.* FROM {0} u LEFT JOIN frames f ON f.trace = CAST(u.trace AS VARCHAR)
"""
_BY_TIME: Final = """
SELECT CASE WHEN u.":ns" <= f.until THEN f.frame_id END AS frame_id, u.* EXCLUDE (":ns")
FROM (
  SELECT u.*, {1} AS ":ns" FROM {0} u LEFT JOIN inside.trace t ON t.name = CAST(u.trace AS VARCHAR)
) u ASOF LEFT JOIN (
  SELECT t.name AS trace, f.frame_id, f.time_ns + coalesce(t.period_ns, 0) // 2 + {2} AS until,
         greatest(f.time_ns - coalesce(t.period_ns, 0) // 2 - {2},
                  (f.time_ns + lag(f.time_ns) OVER (PARTITION BY f.trace_id ORDER BY f.seq) + 1) // 2) AS since
  FROM inside.frame f JOIN inside.trace t ON t.trace_id = f.trace_id
) f ON f.trace = CAST(u.trace AS VARCHAR) AND u.":ns" >= f.since
"""
_NANOSECONDS: Final = {
    "time_ns": "TRY_CAST(u.time_ns AS BIGINT)",
    "t": "t.start_ns + CAST(round(TRY_CAST(u.t AS DOUBLE) * 1e9) AS BIGINT)",
}


@dataclass(frozen=True, slots=True)
class UserTable:
    """Table provided by a user, such as labels of frames, saved as a Parquet file.

    Attributes
    ----------
    name : str
    source : str
        Source file, or type of the data frame.
    place : Path
        Path of the Parquet copy.
    columns : mapping of str to str
        Column → database type.
    key : str
        Key of the join to frames: ``frame_id``, ``seq``, ``time_ns``, ``t``, ``trace`` (all frames of a trace);
        empty: no key.
    """

    name: str
    source: str
    place: Path
    columns: Mapping[str, str]
    key: str

    @property
    def view(self) -> str:
        """SQL that selects the rows of the user table, with their ``frame_id``."""
        rows = f"read_parquet({literal(str(self.place))})"
        match self.key:
            case "frame_id":
                return _BY_FRAME.format(rows)
            case "seq":
                return _BY_NUMBER.format(rows)
            case "trace":
                return _BY_TRACE.format(rows)
            case "time_ns" | "t":
                return _BY_TIME.format(rows, _NANOSECONDS[self.key], TOLERANCE)
            case _:
                return f"SELECT * FROM {rows}"


@dataclass(frozen=True, slots=True)
class JoinedTable:
    """How the rows of a user table match the frames of a store: numbers of rows.

    Attributes
    ----------
    rows : int
    matched : int
        Rows with a frame.
    frames : int
        Frames with rows.
    """

    rows: int
    matched: int
    frames: int


class UserTables:
    """Tables provided by a user, for queries together with a store.

    Parameters
    ----------
    given : mapping of str to str, Path or data frame
        Files, or data frames of pandas, polars, pyarrow.

    Raises
    ------
    StoreError
        A name is invalid, or a table is not readable.

    Attributes
    ----------
    tables : tuple of UserTable
    """

    def __init__(self, given: Mapping[str, object]) -> None:
        if len(given) > MAX_TABLES:
            raise StoreError(f"{len(given)} tables; {MAX_TABLES} can be joined at a time")
        names = [name.lower() for name in given]
        twice = next((name for name in given if names.count(name.lower()) > 1), None)
        if twice is not None:
            raise StoreError(
                f"there are two tables {twice!r}, if the case of letters does not count"
            )
        for name in given:
            if not _NAME.fullmatch(name) or name.lower() in _TAKEN:
                raise StoreError(
                    f"not a name for a table: {name!r}; expected letters, digits and '_', and none of"
                    f" {', '.join(sorted(_TAKEN))}"
                )
        folder = tables_folder() / secrets.token_hex(4)
        self.tables = tuple(_kept(name, table, folder) for name, table in given.items())

    def show(self, connection: DuckDBPyConnection) -> None:
        """Create views of the user tables on a database connection that reads a store.

        Raises
        ------
        StoreError
            The store has a table or view with the name of a user table.
        """
        for table in self.tables:
            taken = connection.execute(
                "SELECT 1 FROM information_schema.tables WHERE table_catalog = current_database()"
                " AND lower(table_name) = lower(?)",
                [table.name],
            ).fetchone()
            if taken:
                raise StoreError(
                    f"the store has a table or view {table.name!r} of its own; give yours another name"
                )
            connection.execute(f'CREATE TEMP VIEW "{table.name}" AS {table.view}')

    def known(self, connection: DuckDBPyConnection, catalog: Catalog) -> Catalog:
        """Return the catalog with the columns of user tables that patterns can use (one row per frame)."""
        single = {
            name: None
            if one.frames == one.matched
            else f"{number_of(one.matched, 'row')} for {number_of(one.frames, 'frame')}"
            for name, one in self.joined(connection).items()
        }
        found = {
            table.name: TableFacts(
                table.name,
                {column: type_of(declared) for column, declared in table.columns.items()},
                single.get(table.name, "no rows that belong to frames"),
                self._traces(connection, table),
                joins=bool(table.key),
            )
            for table in self.tables
        }
        return replace(catalog, tables=found)

    def _traces(self, connection: DuckDBPyConnection, table: UserTable) -> frozenset[int] | None:
        if table.key != "trace":
            return None
        sql = f'SELECT DISTINCT frame_id >> 24 FROM "{table.name}" WHERE frame_id IS NOT NULL'
        return frozenset(row[0] for row in connection.execute(sql).fetchall())

    def joined(self, connection: DuckDBPyConnection) -> dict[str, JoinedTable]:
        """Return the row counts of all user tables that are joined by a frame key: table name → counts."""
        found: dict[str, JoinedTable] = {}
        for table in self.tables:
            if table.key:
                sql = (
                    "SELECT count(*), count(f.frame_id), count(DISTINCT f.frame_id)"
                    f' FROM "{table.name}" u LEFT JOIN inside.frame f ON f.frame_id = u.frame_id'
                )
                found[table.name] = JoinedTable(*connection.execute(sql).fetchall()[0])
        return found


def type_of(declared: str) -> Type:
    """Return the query type (number, boolean or text) for a database column type."""
    if declared == "BOOLEAN":
        return Type.boolean
    numeric = declared.removeprefix("U").startswith(("TINYINT", "SMALLINT", "INT", "BIGINT"))
    other = declared.startswith(("HUGEINT", "UHUGEINT", "FLOAT", "DOUBLE", "DECIMAL"))
    return Type.number if (numeric or other) and not declared.endswith("]") else Type.text


def tables_folder() -> Path:
    """Return this process's folder for user tables. Store connections may read it. It may not exist yet."""
    return temporary_folder() / "tables"


def _kept(name: str, given: object, folder: Path) -> UserTable:
    """Read a table of a user, write it as a Parquet file, and return its description."""
    source = str(given) if isinstance(given, str | Path) else type(given).__name__
    place = folder / f"{name}.parquet"
    with _told(name, source), duckdb.connect(":memory:", config=_config(folder)) as connection:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        connection.execute(f"COPY ({_reading(connection, name, given)}) TO {literal(str(place))}")
        described = connection.execute(
            f"DESCRIBE SELECT * FROM read_parquet({literal(str(place))})"
        ).fetchall()
    columns = {str(row[0]): str(row[1]) for row in described}
    return UserTable(name, source, place, columns, _key_of(columns))


def _reading(connection: DuckDBPyConnection, name: str, given: object) -> str:
    """Return the SQL that reads a user table from a file, or from an object in memory."""
    if not isinstance(given, str | Path):
        connection.register("given", given)
        return "SELECT * FROM given"
    path = Path(given)
    if not path.is_file():
        raise StoreError(f"table {name}: {path}: file not found")
    if path.stat().st_size == 0:
        raise StoreError(f"table {name}: {path}: an empty file")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise StoreError(
            f"table {name}: {path}: cannot be read; expected a file that ends in {', '.join(_READERS)}"
        )
    return f"SELECT * FROM {reader.format(_literal(path))}"


def _literal(path: Path) -> str:
    # A name can contain wildcard characters.
    text = re.sub(r"([*?\[])", r"[\1]", str(path.resolve()))
    return literal(text)


def _config(folder: Path) -> dict[str, str | bool | int | float | list[str]]:
    return {
        "memory_limit": f"{MEMORY // 1024}KiB",
        "temp_directory": str(folder),
        "autoload_known_extensions": False,
        "autoinstall_known_extensions": False,
        "python_enable_replacements": False,
    }


def _key_of(columns: Mapping[str, Any]) -> str:
    names = {name.lower() for name in columns}
    if "frame_id" in names:
        return "frame_id"
    if "trace" not in names:
        return ""
    return next((key for key in ("seq", "time_ns", "t") if key in names), "trace")


@contextmanager
def _told(name: str, source: str) -> Generator[None]:
    """Context manager that converts database and disk errors to store errors with the table name."""
    try:
        yield
    except (duckdb.Error, OSError) as error:
        message = " ".join(str(error).split())
        raise StoreError(f"table {name}: {source}: {message}") from error
