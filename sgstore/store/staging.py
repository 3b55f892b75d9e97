"""Where the tables of a trace wait to be published: a little in memory, the rest in files beside the store.

The tables that grow with a trace are cut into parts of some ten thousand rows, each sorted as the store is
and written as a Parquet file into a folder beside the store, so that memory does not grow. In the end all of
them are in files, with a checksum of the rows of each table.
"""

from __future__ import annotations

from glob import escape
from typing import TYPE_CHECKING, Any, Final

import duckdb
import numpy as np

from sgstore.quoting import literal
from sgstore.store.access import memory_setting, translated
from sgstore.store.checksums import Checksum, expressions
from sgstore.store.folder import Folder
from sgstore.store.packing import MISSING
from sgstore.store.schema import tables_sql

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store.packing import Columns
    from sgstore.world import Codes

MEMORY: Final = 48 << 20
"""Most memory of a database that publishes; bytes. Beyond it its tables spill to disk."""

_ROOM: Final = 8
"""How often the rows in memory must fit into it: to be copied, sorted and compressed."""

PART_ROWS: Final = 20_000
"""Rows of all growing tables together that are kept in memory."""

MESSAGES: Final = (
    "CREATE TABLE message (channel INTEGER, log_time_ns BIGINT, chunk_offset BIGINT, "
    '"offset" BIGINT, length BIGINT)'
)

_ENUMS: Final[dict[str, dict[str, str]]] = {
    "entity": {"kind": "kind"},
    "state": {"kind": "kind", "light_state": "light_state"},
    "node": {"kind": "kind"},
    "edge": {"relation": "relation", "src_kind": "kind", "dst_kind": "kind"},
    "lane_state": {"kind": "kind"},
    "derived_node": {"kind": "kind"},
    "derived_edge": {"relation": "relation", "src_kind": "kind", "dst_kind": "kind"},
    "map_node": {"kind": "kind"},
    "map_edge": {"relation": "relation", "src_kind": "kind", "dst_kind": "kind"},
}
"""Columns that come as codes, and the enumerations whose values they number."""

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
    folder : Path, optional
        Where the files are written; it belongs to the caller, who removes it. By default a folder beside the
        store, which is removed with this.
    """

    def __init__(self, store: Path, folder: Path | None = None) -> None:
        self._store = store
        self._rows = 0
        self._bytes = 0
        self._memory = MEMORY
        self._parts = 0
        self._files: dict[str, list[str]] = {}
        self.merge = False
        self._own = Folder(store) if folder is None else None
        self.folder = self._own.path if self._own else folder or store
        try:
            with translated(store):
                self.connection = scratch(self.folder / "spill")
                self.connection.execute(tables_sql())
                self._tables = self._names() - _NOT_SEALED
                self.connection.execute(MESSAGES)
        except BaseException:
            self._remove()
            raise

    def close(self) -> None:
        """Forget the tables in memory, and the files if the folder is its own."""
        self.connection.close()
        self._remove()

    def _remove(self) -> None:
        if self._own is not None:
            self._own.remove()

    def insert(self, table: str, columns: Columns) -> None:
        """Append columns to a table; DuckDB finds them by the name of the variable."""
        rows = len(next(iter(columns.values())))
        if not rows:
            return
        with translated(self._store):
            self._make_room(columns)
            self.connection.execute(
                f"INSERT INTO {table} BY NAME SELECT {_values(table, columns)} FROM columns"
            )
        if table in _GROWING:
            self._rows += rows

    def _make_room(self, columns: Columns) -> None:
        """Let the database take what blocks need that are larger than usual."""
        self._bytes += sum(values.nbytes for values in columns.values())
        if self._bytes * _ROOM > self._memory:
            self._memory = self._bytes * _ROOM
            self.connection.execute(f"SET memory_limit = '{memory_setting(self._memory)}'")

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

    def _write_part(self) -> None:
        with translated(self._store):
            for table in _GROWING:
                self._write(table, self._sorted(table), f"{table}-{self._parts:06}")
                self.connection.execute(f"CREATE OR REPLACE TABLE {table} AS FROM {table} LIMIT 0")
        self._parts += 1
        self._rows = self._bytes = 0

    def _write(self, table: str, select: str, name: str) -> None:
        file = self.folder / f"{name}.parquet"
        self.connection.execute(f"COPY ({select}) TO {literal(str(file))} (FORMAT parquet)")
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
            for table in sorted(filter(self._has_rows, self._tables)):
                if table in _GROWING:
                    self._write(table, self._sorted(table), f"{table}-{self._parts:06}")
                else:
                    order = _ORDERS.get(table, "ALL")
                    self._write(table, f"SELECT * FROM {table} ORDER BY {order}", table)
            files = {
                table: self._files[table] for table in sorted(self._files.keys() & self._tables)
            }
            return files, {table: self._checksum(table, names) for table, names in files.items()}

    def _names(self) -> set[str]:
        sql = "SELECT table_name FROM duckdb_tables() WHERE NOT internal"
        return {name for (name,) in self.connection.execute(sql).fetchall()}

    def _has_rows(self, table: str) -> bool:
        return self.connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None

    def _checksum(self, table: str, names: list[str]) -> Checksum:
        """The checksum of the rows in files; a part is small enough to be in memory."""
        checksum = Checksum()
        select = expressions(self.connection, table)
        for name in names:
            file = literal(escape(str(self.folder / name)))
            rows = self.connection.execute(f"SELECT {select} FROM read_parquet({file})")
            checksum.add(rows.fetchnumpy())
        return checksum

    def _sorted(self, table: str) -> str:
        return _MERGED[table] if self.merge and table in _MERGED else _GROWING[table]


def _values(table: str, columns: Columns) -> str:
    """What is selected from columns: enumerations by their codes, and NULL for what is missing."""
    enums = _ENUMS.get(table, {})
    return ", ".join(
        f'{_value(name, values, enums.get(name))} AS "{name}"' for name, values in columns.items()
    )


def _value(name: str, values: NDArray[Any], enum: str | None) -> str:
    if values.dtype.kind == "f":
        return f'CASE WHEN isfinite("{name}") THEN "{name}" END'
    missing = {"i": str(MISSING), "O": "''"}.get(values.dtype.kind)
    known = f'nullif("{name}", {missing})' if missing else f'"{name}"'
    return f"enum_range(NULL::{enum})[{known} + 1]::{enum}" if enum else known


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
    }
    return duckdb.connect(":memory:", config=config)
