"""Staged tables of a trace, with checksums, until they are published.

Checksums of rows: the same for the same rows in any order, in any version of the database.

A row becomes 64 bits, mixed from the bits of its values, and the checksum is their sum modulo 2⁶⁴. So rows can
come in parts and be stored in any order. The mixing is SplitMix64's (Steele, Lea, Flood: Fast splittable
pseudorandom number generators, 2014): it is no cipher, and tells what happens by chance, not by intent.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import duckdb
import numpy as np

from sgstore.errors import StoreError
from sgstore.quoting import literal, quoted
from sgstore.store._locking import Folder, memory_setting, translated
from sgstore.store._packing import MISSING
from sgstore.store._schema import (
    INSIDE,
    code_sql,
    database_of,
    enums_of,
    own_labels,
    tables_sql,
    widen,
)
from sgstore.store._traces import Identity
from sgstore.vocabulary import NAMES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._packing import Columns
    from sgstore.world import Codes

    Words = NDArray[np.uint64]


_STEP: Final = 0x9E3779B97F4A7C15
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_MISSING: Final = np.uint64(0x6E756C6C6E756C6C)
"""What stands for NULL."""

_ASSIGNED: Final = {
    ("trace", "name"),
    ("trace", "ingested_at"),
    ("map", "name"),
    ("recording", "place"),
}
"""Tables and columns to which a store gives a value of its own."""

_TEXTS: Final = {"VARCHAR", "VARCHAR[]", "JSON", "TIMESTAMP", "UUID"}


@dataclass(slots=True)
class Checksum:
    """Checksum of some rows.

    Attributes
    ----------
    rows : int
    value : int
        0 … 2⁶³ - 1.
    """

    rows: int = 0
    value: int = 0

    def add(self, columns: dict[str, NDArray[Any]]) -> None:
        """Add rows, as columns of numbers and truth values, masked where they are missing."""
        hashes: Words = np.zeros(len(next(iter(columns.values()))), np.uint64)
        for number, name in enumerate(sorted(columns)):
            salt = np.uint64((number + 1) * _STEP & 0xFFFFFFFFFFFFFFFF)
            hashes = _mixed(hashes + (_words(columns[name]) ^ salt))
        self.rows += len(hashes)
        self.value = (self.value + int(hashes.sum(dtype=np.uint64))) & 0x7FFFFFFFFFFFFFFF


def _mixed(words: Words) -> Words:
    words = (words ^ (words >> np.uint64(30))) * _FIRST
    words = (words ^ (words >> np.uint64(27))) * _SECOND
    return words ^ (words >> np.uint64(31))


def _words(values: NDArray[Any]) -> Words:
    """The bits of values as words of 64."""
    plain = np.ma.getdata(values)
    if plain.dtype.kind == "f":
        plain = plain + plain.dtype.type(0)  # one zero: DuckDB 1.5 does not keep the sign of it
        words = plain.view(np.uint32 if plain.dtype.itemsize == 4 else np.uint64)
    else:
        words = plain.astype(np.int64).view(np.uint64)
    missing = np.ma.getmaskarray(values)
    return np.where(missing, _MISSING, words.astype(np.uint64))


def columns_of(
    connection: DuckDBPyConnection, table: str, catalog: str = ""
) -> list[tuple[str, str]]:
    """Names and types of the columns of a table of the schema; ``duckdb_columns()`` would bind every view."""
    place = f"{quoted(catalog)}.{INSIDE}" if catalog else INSIDE
    rows = connection.execute(f"DESCRIBE {place}.{quoted(table)}").fetchall()
    return [(name, kind) for name, kind, *_ in rows]


def expressions(connection: DuckDBPyConnection, table: str, catalog: str = "") -> str:
    """SQL of the columns of a table of the schema, or of a file of it, as :meth:`Checksum.add` takes them.

    Numbers are as they are, enumerations their codes, texts 60 bits of their MD5.
    """
    listed: list[str] = []
    for name, kind in columns_of(connection, table, catalog):
        value = f'"{name}"'
        if kind.startswith("ENUM"):  # words in a file
            value = code_sql(value, kind)
        elif kind in _TEXTS:
            value = f"('0x' || md5({value}::VARCHAR)[:15])::BIGINT"
        if (table, name) not in _ASSIGNED:
            listed.append(f'{value} AS "{name}"')
    return ", ".join(listed)


# Where the tables of a trace wait to be published: a little in memory, the rest in files beside the store
# ------------------------------------------------------------------------------------------------
# The tables that grow with a trace are cut into parts of some ten thousand rows, each sorted as the store is
# and written as a Parquet file into a folder beside the store, so that memory does not grow. In the end all of
# them are in files, with a checksum of the rows of each table.

MEMORY: Final = 48 << 20
"""Most memory of a database that publishes; bytes. Beyond it its tables spill to disk."""

MOST_MEMORY: Final = 64 << 20
"""The same where blocks are larger than usual; bytes."""

LEAST_MEMORY: Final = 24 << 20
"""The same where many wait beside one another, to begin with; bytes."""

_ROOM: Final = 8
"""How often the rows in memory must fit into it: to be copied, sorted and compressed."""

PART_ROWS: Final = 20_000
"""Rows of all growing tables together that are kept in memory."""

SUMMED_ROWS: Final = 250_000
"""Rows of which the checksum is computed together."""

MERGE_ROWS: Final = 1_000_000
"""Rows of these tables at which the pieces of masks within a bucket are merged before it is whole."""

MESSAGES: Final = (
    "CREATE TABLE message (channel INTEGER, log_time_ns BIGINT, chunk_offset BIGINT, "
    '"offset" BIGINT, length BIGINT)'
)

_GROWING: Final = {
    "state": """
SELECT s.* REPLACE (e.special AS special, e.subkind AS subkind)
FROM state s JOIN entity e ON e.node_id = s.node_id
ORDER BY s.is_ego DESC, s.kind, s.frame_id >> 6, s.node_id, s.frame_id""",
    "lane_state": "SELECT * FROM lane_state ORDER BY kind, frame_id >> 6, node_id, frame_id, lane",
    "lane_gap": "SELECT * FROM lane_gap ORDER BY frame_id >> 6, src, dst, frame_id",
    "node": "SELECT kind, bucket, node_id, mask FROM node ORDER BY ALL",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, mask FROM edge ORDER BY ALL""",
    "frame_class": "SELECT * FROM frame_class ORDER BY ALL",
    "lane_role": "SELECT * FROM lane_role ORDER BY ALL",
    "later_class": "SELECT * FROM later_class ORDER BY ALL",
    "derived_node": "SELECT * FROM derived_node ORDER BY ALL",
    "derived_edge": "SELECT * FROM derived_edge ORDER BY ALL",
    "derived_gap": "SELECT * FROM derived_gap ORDER BY ALL",
    "message": "SELECT * FROM message",
}
"""The tables that grow with a trace, sorted as they are published."""

_MERGED: Final = {
    "node": "SELECT kind, bucket, node_id, bit_or(mask) AS mask FROM node GROUP BY ALL ORDER BY ALL",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_or(mask) AS mask
FROM edge GROUP BY ALL ORDER BY ALL""",
    "frame_class": """
SELECT abstraction, class, bucket, bit_or(mask) AS mask FROM frame_class GROUP BY ALL ORDER BY ALL""",
    "lane_role": "SELECT role, bucket, node_id, bit_or(mask) AS mask FROM lane_role GROUP BY ALL ORDER BY ALL",
    "derived_node": """
SELECT set_name, moves, kind, bucket, node_id, bit_or(mask) AS mask FROM derived_node
GROUP BY ALL ORDER BY ALL""",
    "derived_edge": """
SELECT set_name, relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_or(mask) AS mask
FROM derived_edge GROUP BY ALL ORDER BY ALL""",
}
"""The same where blocks split buckets: the pieces of a mask become one row again."""


_ORDERS: Final = {"payload": "channel_id, bucket, bit", "map_node": "node_id DESC"}
"""How the others are sorted, where not by all their columns."""

_NOT_SEALED: Final = {"bits", "store_info"}
"""Tables that belong to no trace."""


class Staging:
    """The tables of one trace. ``connection`` has them in memory, under the names that they have in a store.

    Parameters
    ----------
    store : Path
        The store that they are meant for.
    place : tuple, optional
        The folder where the files are written, which the caller removes; and how many wait at a time, this one
        included: those of several egos share the memory. By default a folder beside the store, removed with
        this.
    """

    def __init__(self, store: Path, place: tuple[Path, int] | None = None) -> None:
        folder, beside = place or (None, 1)
        self._store = store
        self._rows = 0
        self._bytes = 0
        self._memory = max(min(MEMORY, 2 * MEMORY // beside), LEAST_MEMORY)
        self._most = MOST_MEMORY if self._memory == MEMORY else self._memory
        self._merge_at = MERGE_ROWS
        self._parts = 0
        self._files: dict[str, list[str]] = {}
        self._written: dict[str, int] = {}
        self._known = dict.fromkeys(NAMES, 0)
        self._new: dict[str, list[str]] = {}
        self.merge = False
        self._own = Folder(store) if folder is None else None
        self.folder = folder or (self._own.path if self._own else store)
        try:
            with translated(store):
                self.connection = scratch(self.folder / "spill", memory=self._memory)
                self._known = {enum: len(names) for enum, names in NAMES.items()}
                self.connection.execute(tables_sql())
                listed = self.connection.execute(
                    "SELECT table_name FROM duckdb_tables() WHERE NOT internal"
                ).fetchall()
                self._tables = {name for (name,) in listed} - _NOT_SEALED
                self.connection.execute(MESSAGES)
        except BaseException:
            if self._own is not None:
                self._own.remove()
            raise

    def close(self) -> None:
        """Forget the tables in memory, and the files if the folder is its own."""
        self.connection.close()
        if self._own is not None:
            self._own.remove()

    def insert(self, table: str, columns: Columns) -> None:
        """Append columns to a table; DuckDB finds them by the name of the variable."""
        rows = len(next(iter(columns.values())))
        if not rows:
            return
        with translated(self._store):
            self._bytes += sum(values.nbytes for values in columns.values())
            wanted = min(self._bytes * _ROOM, self._most)
            if wanted > self._memory:  # blocks that are larger than usual need more
                self._allow(wanted)
            for column, enum in enums_of(table).items():
                if column in columns:
                    self._learn(enum, columns[column])
            insert = f"INSERT INTO {table} BY NAME SELECT {_values(table, columns)} FROM columns"
            self._run(insert, columns)
        if table in _GROWING:
            self._rows += rows

    def _learn(self, enum: str, codes: NDArray[Any]) -> None:
        """Take note of values of an enumeration that ``schema.sql`` has not."""
        if codes.max() < len(own_labels(enum)):
            return
        names = NAMES[enum]
        if len(names) > self._known[enum]:
            self._known[enum] = len(names)
            widen(self.connection, database_of(self.connection), {enum: names})
        noted = self._new.setdefault(enum, [])
        found = [names[code] for code in np.unique(codes).tolist() if code >= len(own_labels(enum))]
        noted += [name for name in found if name not in noted]

    def words(self, answers: Iterable[str]) -> dict[str, list[str]]:
        """Enumeration → values that a store must be able to hold: relations that are answered, what is new."""
        relations = sorted({*answers, *self._new.get("relation", ())})
        return {**self._new, "relation": relations}

    def _allow(self, memory: int) -> None:
        self._memory = memory
        self.connection.execute(f"SET memory_limit = '{memory_setting(memory)}'")

    def _run(self, sql: str, columns: Columns | None = None) -> DuckDBPyConnection:
        """Run a statement; if its share of memory is too little for it, with more.

        ``columns`` are a table of that name for the statement: DuckDB looks for it among the variables here.
        """
        while True:
            try:
                return self.connection.execute(sql)
            except duckdb.OutOfMemoryException:
                if self._memory >= MOST_MEMORY:
                    raise
                self._allow(min(2 * self._memory, MOST_MEMORY))

    def mark_parked(self, parked: Codes) -> None:
        """Tell of the entities, by node id, whether they are parked: 1 or 0; -1: not known."""
        for value in (0, 1):
            self.connection.execute(
                "UPDATE entity SET parked = $value WHERE list_contains($nodes, node_id)",
                {"value": bool(value), "nodes": np.flatnonzero(parked == value).tolist()},
            )

    def settle(self, *, whole: bool) -> None:
        """Make room if the tables have grown; called between blocks.

        Parameters
        ----------
        whole : bool
            Whether the rows so far end with a bucket. Only then they can become a part: the pieces of a mask
            are merged within one.
        """
        self.merge = self.merge or not whole
        if whole and self._rows >= PART_ROWS:
            self._write_part()
        elif not whole and self._rows >= self._merge_at:
            self._merge()

    def _merge(self) -> None:
        """Make one row of the pieces of a mask: blocks of crowded frames are small, and their edges many."""
        left = self._rows
        with translated(self._store):
            for table, select in _MERGED.items():
                plain = select.replace(" ORDER BY ALL", "").replace("\nORDER BY ALL", "")
                left -= self._count(table)
                self._run(f"CREATE OR REPLACE TABLE {table} AS {plain}")
                left += self._count(table)
        self._bytes = self._bytes * left // max(self._rows, 1)
        self._rows, self._merge_at = left, max(MERGE_ROWS, 2 * left)

    def _count(self, table: str) -> int:
        (count,) = self.connection.execute(f"SELECT count(*) FROM {table}").fetchone() or (0,)
        return int(count)

    def _write_part(self) -> None:
        with translated(self._store):
            for table in _GROWING:
                self._write(table, self._sorted(table), f"{table}-{self._parts:06}")
                self.connection.execute(f"CREATE OR REPLACE TABLE {table} AS FROM {table} LIMIT 0")
        self._parts += 1
        self._rows = self._bytes = 0
        self._merge_at = MERGE_ROWS

    def _write(self, table: str, select: str, name: str) -> None:
        file = self.folder / f"{name}.parquet"
        copy = f"COPY ({select}) TO {literal(str(file))} (FORMAT parquet)"
        (self._written[file.name],) = self._run(copy).fetchone() or (0,)
        self._files.setdefault(table, []).append(file.name)

    def all_messages(self) -> str:
        """A statement that gives all messages, in no order."""
        if not self._parts:
            return "SELECT * FROM message"
        files = literal(f"{escape(str(self.folder))}/message-*.parquet")
        return f"SELECT * FROM read_parquet({files}) UNION ALL SELECT * FROM message"

    def seal(self) -> tuple[dict[str, list[str]], dict[str, Checksum]]:
        """Write everything into files.

        Returns
        -------
        files : dict
            Table → names of its files in the folder, in order; no table without rows.
        checksums : dict
            Table → checksum of its rows.
        """
        with translated(self._store):
            for table in sorted(self._tables):
                if not self.connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone():
                    continue
                if table in _GROWING:
                    self._write(table, self._sorted(table), f"{table}-{self._parts:06}")
                else:
                    order = _ORDERS.get(table, "ALL")
                    self._write(table, f"SELECT * FROM {table} ORDER BY {order}", table)
            files = {
                table: self._files[table] for table in sorted(self._files.keys() & self._tables)
            }
            return files, {table: self._checksum(table, names) for table, names in files.items()}

    def _checksum(self, table: str, names: list[str]) -> Checksum:
        """The checksum of the rows in files, as many at a time as fit into memory."""
        checksum = Checksum()
        select = expressions(self.connection, table)
        for name in names:
            file = literal(escape(str(self.folder / name)))
            from_file = f"SELECT {select} FROM read_parquet({file}, file_row_number = true)"
            for first in range(0, self._written[name], SUMMED_ROWS):
                part = (
                    f" WHERE file_row_number >= {first} AND file_row_number < {first + SUMMED_ROWS}"
                )
                whole = self._written[name] <= SUMMED_ROWS
                rows = self._run(from_file + ("" if whole else part))
                checksum.add(rows.fetchnumpy())
        return checksum

    def _sorted(self, table: str) -> str:
        return _MERGED[table] if self.merge and table in _MERGED else _GROWING[table]


def _values(table: str, columns: Columns) -> str:
    """SQL that selects columns: enumerations by their codes, and NULL for missing values."""
    enums = enums_of(table)
    listed: list[str] = []
    for name, values in columns.items():
        missing = {"i": str(MISSING), "O": "''"}.get(values.dtype.kind)
        known = f'nullif("{name}", {missing})' if missing else f'"{name}"'
        if values.dtype.kind == "f":
            known = f'CASE WHEN isfinite("{name}") THEN "{name}" END'
        elif name in enums:
            known = f"enum_range(NULL::{enums[name]})[{known} + 1]::{enums[name]}"
        listed.append(f'{known} AS "{name}"')
    return ", ".join(listed)


def scratch(spill: Path, *, memory: int = 0, threads: int = 1) -> DuckDBPyConnection:
    """A database in memory that may attach files; what does not fit goes into a folder that need not exist.

    Parameters
    ----------
    memory : int
        Most memory that it takes; bytes. 0: :data:`MEMORY`.
    threads : int
        Each has buffers of its own.
    """
    config: dict[str, str | bool | int | float | list[str]] = {
        "memory_limit": memory_setting(memory or MEMORY),
        "temp_directory": str(spill),
        "threads": threads,
        "autoload_known_extensions": False,
        "autoinstall_known_extensions": False,
    }
    connection = duckdb.connect(":memory:", config=config)
    connection.execute("SET enable_progress_bar = false")  # on stdout, where Python is interactive
    return connection


# A trace that is ready to be published: files in a folder, and what is said of them -------------

_FILE: Final = "sealed.json"


@dataclass(frozen=True, slots=True)
class Sealed:
    """A segment that is complete. It needs nothing of the process that built it.

    Attributes
    ----------
    folder : Path
    path : Path
        The recording.
    identity : Identity
    files : dict
        Table → names of its Parquet files in the folder, in the order in which they are published.
    checksums : dict
        Table → checksum of its rows.
    words : dict
        Enumeration → values in it that are not those of ``schema.sql``, or may not be: a store takes them, too.
    """

    folder: Path
    path: Path
    identity: Identity
    files: dict[str, list[str]]
    checksums: dict[str, Checksum]
    words: dict[str, list[str]]

    def write(self) -> None:
        """Write into the folder what :meth:`read` needs.

        Raises
        ------
        StoreError
            It cannot be written.
        """
        values = asdict(self) | {"folder": "", "path": str(self.path)}
        try:
            (self.folder / _FILE).write_text(json.dumps(values), encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{self.folder}: cannot be written: {error.strerror}") from error

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read what a process of ours sealed in a folder.

        Raises
        ------
        StoreError
            There is nothing.
        """
        try:
            values = json.loads((folder / _FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise StoreError(f"{folder}: no segment that is complete: {error}") from error
        return cls(
            folder=folder,
            path=Path(values["path"]),
            identity=Identity.from_dict(values["identity"]),
            files=values["files"],
            checksums={name: Checksum(**one) for name, one in values["checksums"].items()},
            words=values["words"],
        )
