"""Where the tables of a trace wait to be published: a little in memory, the rest in files beside the store.

The tables that grow with a trace are cut into parts of some ten thousand rows, each sorted as the store is
and written as a Parquet file into a folder beside the store, so that memory does not grow.
"""

from __future__ import annotations

from glob import escape
from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.store.access import memory_setting, translated
from sgstore.store.folder import Folder
from sgstore.store.packing import MISSING
from sgstore.store.schema import tables_sql

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store.packing import Columns

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
    "map_node": {"kind": "kind"},
    "map_edge": {"relation": "relation", "src_kind": "kind", "dst_kind": "kind"},
}
"""Columns that come as codes, and the enumerations whose values they number."""

_GROWING: Final = {
    "state": """
SELECT s.* REPLACE (e.special AS special, e.subkind AS subkind)
FROM state s JOIN entity e ON e.node_id = s.node_id
ORDER BY s.kind, s.frame_id >> 6, s.node_id, s.frame_id""",
    "lane_state": "SELECT * FROM lane_state ORDER BY kind, frame_id >> 6, node_id, frame_id, lane",
    "node": "SELECT kind, bucket, node_id, mask FROM node ORDER BY ALL",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, mask FROM edge ORDER BY ALL""",
    "message": "SELECT * FROM message",
}
"""The tables that grow with a trace, sorted as they are published."""

_MERGED: Final = {
    "node": "SELECT kind, bucket, node_id, bit_or(mask) AS mask FROM node GROUP BY ALL ORDER BY ALL",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_or(mask) AS mask
FROM edge GROUP BY ALL ORDER BY ALL""",
}
"""The same where blocks split buckets: the pieces of a mask become one row again."""


class Staging:
    """The tables of one trace. ``connection`` has them in memory, under the names that they have in a store.

    Parameters
    ----------
    store : Path
        The store that they are meant for.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._rows = 0
        self._bytes = 0
        self._memory = MEMORY
        self._parts = 0
        self.merge = False
        self._folder = Folder(store)
        try:
            with translated(store):
                self.connection = scratch(self._folder.path / "spill")
                self.connection.execute(tables_sql())
                self.connection.execute(MESSAGES)
        except BaseException:
            self._folder.remove()
            raise

    def close(self) -> None:
        """Forget the tables."""
        self.connection.close()
        self._folder.remove()

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
                file = _quoted(self._file(table, self._parts))
                self.connection.execute(
                    f"COPY ({self._sorted(table)}) TO '{file}' (FORMAT parquet)"
                )
                self.connection.execute(f"CREATE OR REPLACE TABLE {table} AS FROM {table} LIMIT 0")
        self._parts += 1
        self._rows = self._bytes = 0

    def parts(self, table: str) -> Iterator[str]:
        """Statements that give all rows of a growing table, part by part."""
        for part in range(self._parts):
            # Reading takes a pattern, and a folder may be called anything.
            yield f"SELECT * FROM read_parquet('{_quoted(escape(self._file(table, part)))}')"
        yield self._sorted(table)

    def all_messages(self) -> str:
        """A statement that gives all messages, in no order."""
        if not self._parts:
            return "SELECT * FROM message"
        files = f"{_quoted(escape(str(self._folder.path)))}/message-*.parquet"
        return f"SELECT * FROM read_parquet('{files}') UNION ALL SELECT * FROM message"

    def _sorted(self, table: str) -> str:
        return _MERGED[table] if self.merge and table in _MERGED else _GROWING[table]

    def _file(self, table: str, part: int) -> str:
        return str(self._folder.path / f"{table}-{part:06}.parquet")


def _quoted(text: str) -> str:
    return text.replace("'", "''")


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
