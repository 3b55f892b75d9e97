"""Recorded topics in a store: the messages of selected channels, as tables with one column per field.

The table ``topic`` lists the topics of each trace. The messages are in tables ``topic_…``, whose names are
digests of the topic and its fields: tables of equal names have equal columns, in every store. All of them are
optional, and are made with the first topic. A store is not trusted: a table counts only if its statement lists
plain columns.

Messages reach a table through Parquet files, in batches, so that memory does not grow with a recording.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from sgstore.base.display import excerpt
from sgstore.base.quoting import literal, quoted
from sgstore.errors import StoreError
from sgstore.model.frame_ids import frame_ids
from sgstore.store._schema import INSIDE, TOPIC_TYPES, topic_statements
from sgstore.store._staging import scratch

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.readers import TopicBatch, TopicReading
    from sgstore.store._staging import Sealed

    Ints = NDArray[np.int64]


LISTING: Final = "topic"
TOPIC_FILES: Final = "topic-*.parquet"
"""Name pattern of the files with the messages of topics."""
_LISTING: Final = (
    f'{LISTING}(trace_id BIGINT NOT NULL, topic VARCHAR NOT NULL, "table" VARCHAR NOT NULL,'
    " schema VARCHAR NOT NULL, encoding VARCHAR NOT NULL, fields JSON NOT NULL, messages BIGINT NOT NULL,"
    " lost BIGINT NOT NULL)"
)
FRAME: Final = ":frame"
KEYS: Final = {
    FRAME: "BIGINT",  # id of the last frame at or before the message, else of the first frame
    ":run": "INTEGER",  # of the clock of the frames: a backward step begins the next one
    ":number": "BIGINT",  # of the message in its channel
    ":time_ns": "BIGINT",  # by the clock of the frames
    "log_time_ns": "BIGINT",
    "publish_time_ns": "BIGINT",
}
"""Columns that every table of messages has, before the columns of the fields."""


@dataclass(frozen=True, slots=True)
class TopicFile:
    """Messages of a topic in Parquet files.

    Attributes
    ----------
    topic, schema, encoding : str
    parts : list of str
        Names of the files in their folder.
    fields : dict
        Field → database type.
    messages, lost : int
        Numbers of messages: in the files, and not decoded.
    """

    topic: str
    schema: str = ""
    encoding: str = ""
    parts: list[str] = field(default_factory=list[str])
    fields: dict[str, str] = field(default_factory=dict[str, str])
    messages: int = 0
    lost: int = 0

    def __post_init__(self) -> None:
        for kind in self.fields.values():  # a segment or a store is not trusted
            if kind.removesuffix("[]") not in TOPIC_TYPES:
                raise StoreError(
                    f"topic {excerpt(self.topic)!r} has a field of type {excerpt(kind)!r}"
                )

    @property
    def table(self) -> str:
        """Name of the table for messages with these fields."""
        told = json.dumps([self.topic, list(self.fields.items())])
        return f"{LISTING}_{hashlib.sha256(told.encode('utf-8', 'replace')).hexdigest()[:16]}"

    def rows(self, folder: Path) -> str:
        """Return SQL that reads the messages, with the columns of their table."""
        paths = ", ".join(literal(str(folder / part)) for part in self.parts)
        casts = [
            f"CAST({quoted(name)} AS {kind}) AS {quoted(name)}"
            for name, kind in self.fields.items()
        ]
        listed = ", ".join([*map(quoted, KEYS), *casts])
        return f"SELECT {listed} FROM read_parquet([{paths}], union_by_name = true)"


_FAR_NS: Final = 1 << 62
"""Largest time between a message and its frame: 146 years; ns."""


class FrameClock:
    """Clock of a trace. It converts the log time of a message to a frame and a simulation time.

    Parameters
    ----------
    frame_id, time_ns, log_time_ns : (F,) int64
        At least one frame.
    """

    def __init__(self, frame_id: Ints, time_ns: Ints, log_time_ns: Ints) -> None:
        run = np.cumsum(np.diff(time_ns, prepend=time_ns[:1]) < 0, dtype=np.int64)
        order = np.argsort(log_time_ns, kind="stable")
        self.frame_id, self.time_ns, self.log = frame_id[order], time_ns[order], log_time_ns[order]
        self.run = run[order]
        step, log_step = np.diff(self.time_ns), np.diff(self.log)
        even = (np.diff(self.run) == 0) & (step > 0) & (log_step > 0)
        rate = np.where(even, step / np.maximum(log_step, 1), 1.0)
        self._rate = np.append(rate, 1.0)

    @classmethod
    def of_trace(cls, trace_id: int, time_ns: Ints, log_time_ns: Ints) -> Self:
        """Return the clock (log time → frame and simulation time) of a trace that is not stored yet."""
        return cls(frame_ids(trace_id, np.arange(len(time_ns))), time_ns, log_time_ns)

    @classmethod
    def of_stored(cls, connection: DuckDBPyConnection, trace_id: int) -> Self:
        """Return the clock of a stored trace."""
        names = "frame_id, time_ns, log_time_ns"
        sql = f"SELECT {names} FROM {INSIDE}.frame WHERE trace_id = ? ORDER BY seq"
        found = connection.execute(sql, [trace_id]).fetchnumpy()
        return cls(*(np.ma.getdata(found[name]) for name in names.split(", ")))

    def columns(self, log_time_ns: Ints) -> dict[str, Ints]:
        """For log times, return columns: frame, number of earlier backward clock jumps, and simulation time."""
        at = np.maximum(np.searchsorted(self.log, log_time_ns, side="right") - 1, 0)
        past = log_time_ns - self.log[at]
        rate = np.where(past >= 0, self._rate[at], 1.0)
        step = np.clip(np.rint(past * rate), -_FAR_NS, _FAR_NS)  # a log time can be absurd
        time_ns = self.time_ns[at] + step.astype(np.int64)
        return {FRAME: self.frame_id[at], ":run": self.run[at], ":time_ns": time_ns}


def topic_scratch(spill: Path) -> DuckDBPyConnection:
    """Open a database for a :class:`TopicWriter`. Data beyond the memory limit go to a folder."""
    return scratch(spill, memory=MEMORY)


MEMORY: Final = 256 << 20
"""Memory limit of the database that writes the messages of topics; bytes."""


class TopicWriter:
    """Writer of the messages of topics to Parquet files.

    Parameters
    ----------
    connection : DuckDBPyConnection
        Connection of an own database.
    folder : Path
    clock : FrameClock
    bounded : bool
        True to drop messages before the first and after the last frame, except the last one before.
    """

    def __init__(
        self,
        connection: DuckDBPyConnection,
        folder: Path,
        clock: FrameClock,
        *,
        bounded: bool = False,
    ) -> None:
        self._connection, self._folder, self._clock = connection, folder, clock
        self._bounds = (clock.log[0], clock.log[-1]) if bounded else None
        self._files: dict[str, TopicFile] = {}
        self._before: dict[str, TopicBatch] = {}

    def add(self, batch: TopicBatch) -> None:
        """Write a batch of messages to a new file."""
        if self._bounds is not None:
            first, last = self._bounds
            before = np.flatnonzero(batch.log_time_ns < first)
            if len(before):
                newest = batch.take(before[np.argmax(batch.log_time_ns[before])][None])
                known = self._before.setdefault(batch.topic, newest)
                if known.log_time_ns[0] <= newest.log_time_ns[0]:
                    self._before[batch.topic] = newest
            batch = batch.take(
                np.flatnonzero((batch.log_time_ns >= first) & (batch.log_time_ns <= last))
            )
        self._write(batch)

    def _write(self, batch: TopicBatch) -> None:
        file = self._files.setdefault(batch.topic, TopicFile(batch.topic))
        part = f"topic-{[*self._files].index(batch.topic)}-{len(file.parts)}.parquet"
        place = self._folder / part
        arrays: dict[str, Any] = {
            **self._clock.columns(batch.log_time_ns),
            ":number": batch.number,
            "log_time_ns": batch.log_time_ns,
            "publish_time_ns": batch.publish_time_ns,
        }
        listed = [
            f"CAST({quoted(name)} AS {kind}) AS {quoted(name)}" for name, kind in KEYS.items()
        ]
        for number, (name, (declared, values)) in enumerate(batch.columns.items()):
            listed.append(f"{_value(f'c{number}', declared, values, arrays)} AS {quoted(name)}")
            file.fields.setdefault(name, declared)
        self._connection.register("block", arrays)
        try:
            self._connection.execute(
                f"COPY (SELECT {', '.join(listed)} FROM block) TO {literal(str(place))}"
                " (FORMAT parquet, COMPRESSION lz4)"
            )
        finally:
            self._connection.unregister("block")
        file.parts.append(part)
        self._files[batch.topic] = replace(file, messages=file.messages + len(batch.number))

    def files(self, reading: TopicReading) -> list[TopicFile]:
        """Write the waiting batches. Return all written topics, with the types of their fields."""
        for batch in self._before.values():
            self._write(batch)
        self._before.clear()
        found: list[TopicFile] = []
        for topic, file in self._files.items():
            schema, encoding = reading.schema(topic)
            lost = reading.losses[topic].messages
            fields = self._types(file)
            found.append(replace(file, fields=fields, schema=schema, encoding=encoding, lost=lost))
        return found

    def _types(self, file: TopicFile) -> dict[str, str]:
        paths = ", ".join(literal(str(self._folder / part)) for part in file.parts)
        rows = self._connection.execute(
            f"DESCRIBE SELECT * FROM read_parquet([{paths}], union_by_name = true)"
        ).fetchall()
        found = {str(row[0]): str(row[1]) for row in rows}
        return {name: kind for name, kind in found.items() if name not in KEYS}


def _value(name: str, declared: str, values: Any, arrays: dict[str, Any]) -> str:
    """Add the values of a field to ``arrays``, and return the SQL that makes a column of them."""
    if values.ndim == 2:
        names = [f"{name}_{at}" for at in range(values.shape[1])]
        arrays |= {one: np.ascontiguousarray(values[:, at]) for at, one in enumerate(names)}
        return f"CAST(list_value({', '.join(names)}) AS {declared})"
    arrays[name] = values
    if values.dtype.kind != "O":
        return f"CAST({name} AS {declared})"
    text = f"CAST({name} AS VARCHAR)"
    if declared == "BLOB":
        return f"from_hex({text})"
    return (
        f"""from_json({text}, '["VARCHAR"]')"""
        if declared == "VARCHAR[]"
        else f"CAST({text} AS {declared})"
    )


# Tables of a store.


def topic_tables(connection: DuckDBPyConnection, database: str) -> dict[str, str]:
    """Return the tables of topics in an attached store: name → CREATE statement without the schema name."""
    rows = connection.execute(
        "SELECT table_name, sql FROM system.main.duckdb_tables()"
        " WHERE database_name = $1 AND schema_name = $2 AND starts_with(table_name, $3)",
        [database, INSIDE, LISTING],
    ).fetchall()
    return topic_statements(rows)


def copy_topic_tables(
    connection: DuckDBPyConnection, sources: Iterable[str], to: str
) -> dict[str, list[str]]:
    """Create empty tables of topics in a database, for all topics of some attached stores.

    Returns
    -------
    dict
        Name of the table → sources that have it.
    """
    found: dict[str, list[str]] = {}
    for one in sources:
        for name, sql in topic_tables(connection, one).items():
            connection.execute(f"CREATE TABLE IF NOT EXISTS {quoted(to)}.{INSIDE}.{sql}")
            found.setdefault(name, []).append(one)
    return found


def publish_topics(connection: DuckDBPyConnection, sealed: Sealed) -> list[str]:
    """Insert the topics of a new trace into the attached store, and return the names of their tables."""
    if not sealed.topics:
        return []
    inside = f"store.{INSIDE}"
    connection.execute(f"CREATE TABLE IF NOT EXISTS {inside}.{_LISTING}")
    for told in sealed.topics:
        file = TopicFile(**told)
        columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in (KEYS | file.fields).items())
        connection.execute(f"CREATE TABLE IF NOT EXISTS {inside}.{file.table}({columns})")
        connection.execute(f"INSERT INTO {inside}.{file.table} BY NAME {file.rows(sealed.folder)}")
        row = [sealed.identity.trace_id, file.topic, file.table, file.schema, file.encoding]
        row += [json.dumps(file.fields), file.messages, file.lost]
        connection.execute(f"INSERT INTO {inside}.{LISTING} VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
    return [LISTING, *dict.fromkeys(TopicFile(**told).table for told in sealed.topics)]


def drop_topic_tables(connection: DuckDBPyConnection) -> None:
    """Delete tables of topics from the attached store if no trace has messages in them."""
    tables = topic_tables(connection, "store")
    used = {LISTING}
    if LISTING in tables:
        sql = f'SELECT DISTINCT "table" FROM store.{INSIDE}.{LISTING}'
        rows = connection.execute(sql).fetchall()
        used = {name for (name,) in rows} | ({LISTING} if rows else set[str]())
    for name in tables.keys() - used:
        connection.execute(f"DROP TABLE store.{INSIDE}.{name}")
