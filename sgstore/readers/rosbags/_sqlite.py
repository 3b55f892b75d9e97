"""Reader of rosbag2's SQLite files (``.db3``). Files and messages may be compressed.

Source: rosbag2, ``rosbag2_storage_sqlite3/README.md`` (tables of all versions of the schema).
"""

from __future__ import annotations

import sqlite3
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zstandard

from sgstore.errors import TraceError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

MAX_FILE: Final = 4 << 30
"""Maximum size of a decompressed file; bytes."""
MAX_MESSAGE: Final = 256 << 20
"""Maximum size of a message; bytes."""
MAX_TOPICS: Final = 10_000
MAX_TORN: Final = 1_000
"""Maximum number of damaged parts in a table."""
MAX_ROW: Final = 1 << 60
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_FAULTS: Final = (sqlite3.Error, zstandard.ZstdError, OSError, OverflowError, UnicodeDecodeError)


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic of a bag: name, type (``package/Name``), text of its definition, and ROS version.

    ``encoding`` is ``ros2msg``, ``ros1msg`` or another one; empty without a definition.
    """

    name: str
    type: str
    encoding: str = ""
    definition: str = ""
    is_ros1: bool = False


class SqliteBag:
    """Messages of one or more SQLite files, in the order of the files.

    Parameters
    ----------
    path : Path
        The bag.
    files : list of Path
        Its files.
    lose : function
        Called with the reason of each loss.

    Attributes
    ----------
    topics : dict
        Number → topic, from 1.
    channel, times : int64
        Topic and time (ns) of each message.

    Raises
    ------
    TraceError
        No file can be read.
    """

    def __init__(self, path: Path, files: list[Path], lose: Callable[[str], None]) -> None:
        self.path = path
        self.topics: dict[int, Topic] = {}
        self._numbers: dict[tuple[str, str], int] = {}
        self._files: list[tuple[int, sqlite3.Connection]] = []
        self._rows: list[int] = []
        columns: list[tuple[int, int]] = []
        faults: list[str] = []
        for file in files:
            if file.suffix == ".yaml":
                continue
            try:
                self._add(file, columns, lose)
            except (*_FAULTS, TraceError) as error:
                faults.append(f"{file.name} cannot be read: {error}"[:200])
        if not self._files:
            raise TraceError(faults[0] if faults else "it lists no file that exists", path=path)
        for fault in faults:
            lose(fault)
        told = np.array(columns, np.int64).reshape(-1, 2)
        self.channel, self.times = told[:, 0], told[:, 1]

    def close(self) -> None:
        """Close the files."""
        for _, connection in self._files:
            connection.close()

    def data(self, number: int) -> bytes:
        """Return the bytes of a message. A damaged message raises a ``TraceError``."""
        row = self._rows[number]
        at = bisect_right(self._files, number, key=lambda one: one[0]) - 1
        try:
            found = (
                self._files[at][1]
                .execute("SELECT data FROM messages WHERE rowid = ?", (row,))
                .fetchone()
            )
            data = found[0] if found else None
            if not isinstance(data, bytes):
                raise TraceError("a message has no data", path=self.path)
            if data[:4] == _ZSTD:
                data = zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_MESSAGE)
        except _FAULTS as error:
            raise TraceError(f"a message cannot be read: {error}"[:200], path=self.path) from error
        return data

    def _add(self, file: Path, columns: list[tuple[int, int]], lose: Callable[[str], None]) -> None:
        connection = _opened(file)
        try:
            topics = self._read_topics(connection)
        except BaseException:
            connection.close()
            raise
        self._files.append((len(self._rows), connection))
        odd = 0
        torn: list[str] = []
        for row in _rows(connection, "rowid, topic_id, timestamp", "messages", torn):
            usable = isinstance(row[2], int) and row[1] in topics and 0 <= row[2] < 1 << 62
            odd += not usable
            if usable:
                self._rows.append(row[0])
                columns.append((topics[row[1]], row[2]))
        if torn:
            words = f"{file.name}: messages in {len(torn)} damaged parts cannot be read: {torn[0]}"
            lose(words[:200])
        if odd:
            lose(f"{file.name}: {odd} messages without a topic or a time")

    def _read_topics(self, connection: sqlite3.Connection) -> dict[int, int]:
        """Read the topics of a file. Return the number of each topic by its id."""
        texts: dict[str, tuple[str, str]] = {}
        known = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        if "message_definitions" in known:
            query = (
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            with suppress(*_FAULTS):  # The types of known packages need no definition.
                texts = {row[0]: (str(row[1]), str(row[2])) for row in connection.execute(query)}
        found: dict[int, int] = {}
        for ident, name, kind in _rows(connection, "id, name, type", "topics", []):
            key = str(name), str(kind)
            if key not in self._numbers:
                if len(self._numbers) >= MAX_TOPICS:
                    raise TraceError(f"more than {MAX_TOPICS:,} topics", path=self.path)
                number = self._numbers[key] = len(self._numbers) + 1
                self.topics[number] = Topic(*key, *texts.get(key[1], ("", "")))
            found[ident] = self._numbers[key]
        return found


def _rows(
    connection: sqlite3.Connection, columns: str, table: str, torn: list[str]
) -> Iterator[tuple[Any, ...]]:
    """Yield the readable rows of a table in order of row number. Append faults to ``torn``."""
    start = 0
    while len(torn) < MAX_TORN:
        query = f"SELECT rowid, {columns} FROM {table} WHERE rowid >= ? ORDER BY rowid"  # noqa: S608
        try:
            for row in connection.execute(query, (start,)):
                if row[0] < start:
                    raise sqlite3.DatabaseError("rows are out of order")
                start = row[0] + 1
                yield row[1:]
        except _FAULTS as error:
            torn.append(str(error))
            start = _next_readable(connection, table, start)
            if start < 0:
                return
        else:
            return


def _next_readable(connection: sqlite3.Connection, table: str, start: int) -> int:
    """Return the number of the first readable row after a damaged part; -1 without one."""

    def fails(number: int) -> bool:
        query = f"SELECT rowid FROM {table} WHERE rowid >= ? ORDER BY rowid LIMIT 1"  # noqa: S608
        try:
            connection.execute(query, (number,)).fetchone()
        except _FAULTS:
            return True
        return False

    step = 1
    while fails(start + step):
        step *= 2
        if step > MAX_ROW:
            return -1
    low, high = start + step // 2, start + step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fails(middle) else (low, middle)
    return high


def _opened(file: Path) -> sqlite3.Connection:
    """Open a SQLite file for reading. A compressed file is decompressed in memory."""
    with file.open("rb") as stream:
        packed = stream.read(4) == _ZSTD
    if packed:
        with (
            file.open("rb") as stream,
            zstandard.ZstdDecompressor().stream_reader(stream) as reader,
        ):
            content = reader.read(MAX_FILE + 1)
        if len(content) > MAX_FILE:
            raise TraceError(f"larger than {MAX_FILE:,} bytes", path=file)
        connection: Any = sqlite3.connect(":memory:")
        connection.deserialize(content)
    else:
        name = str(file.resolve()).replace("%", "%25").replace("?", "%3f").replace("#", "%23")
        connection = sqlite3.connect(
            f"file:{name}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
    connection.execute("PRAGMA trusted_schema = 0")
    connection.execute("PRAGMA cell_size_check = 1")
    try:
        connection.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
    except sqlite3.DatabaseError:  # SQLite then reads files that were cut, too.
        connection.execute("PRAGMA writable_schema = 1")
    return connection
