"""Topics in SQL: views with their messages, and their values at frames.

Messages come from the tables of the store, and for traces without them from the recording: it is converted once
per process to Parquet files in the folder of user tables, which store connections can read.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import TYPE_CHECKING, Any, Final, TypeVar
from weakref import ref

import numpy as np

from sgstore.base.quoting import literal, quoted
from sgstore.errors import SqlError, StoreError, TraceError
from sgstore.lang.catalog import TopicFacts, TopicField, Type
from sgstore.lang.syntax import TOPIC, topics_in_sql
from sgstore.lang.topics import (
    WHOLE,
    TopicError,
    common_fields,
    field_list,
    field_named,
    fields_of,
    refusal,
    topic_of,
)
from sgstore.mcap import Findings, mark_of
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.model.world import AT_ZERO_NS, TOLERANCE_NS
from sgstore.store._joins import tables_folder
from sgstore.store._locking import default_memory, shut_in
from sgstore.store._schema import INSIDE
from sgstore.store._staging import scratch
from sgstore.store._topics import (
    FRAME,
    KEYS,
    LISTING,
    FrameClock,
    TopicFile,
    TopicWriter,
    topic_scratch,
    topic_tables,
)
from sgstore.store._traces import stored_traces, unchanged

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Generator, Iterator, Mapping
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.mcap import Recording
    from sgstore.readers import TopicReading
    from sgstore.store._locking import Access
    from sgstore.store._traces import StoredTrace

T = TypeVar("T")


def show_topics(connection: DuckDBPyConnection, access: Access, sql: str) -> None:
    """Create the views of topics that an SQL statement names, on its connection.

    Raises
    ------
    TopicError
        A topic does not exist, or its recording cannot be read.
    """
    with access.reading() as reading:
        known = topic_facts(reading, access)
    for topic in topics_in_sql(sql):
        _show(connection, access, topic_of(known, topic), topic)


def _show(connection: DuckDBPyConnection, access: Access, facts: TopicFacts, topic: str) -> None:
    """Create the views of a topic, named as in the statement: the ``/`` of the topic can be missing."""
    if facts.refused:
        fields_of(facts)
    with access.reading() as reading:
        sources = [*_sources(reading, access, facts)]
    # Other stores of a collection can have more fields. They are NULL here.
    more = access.topic_fields.get(facts.name, {})
    fields = common_fields([more, *(one.fields for one in sources)])
    rows = " UNION ALL ".join(one.rows(fields) for one in sources)
    view = quoted(f":messages {topic}")
    connection.execute(f"CREATE OR REPLACE TEMP VIEW {view} AS {rows}")
    listed = "".join(f", m.{quoted(name)}" for name in fields)
    time = f'coalesce({stamp_text(fields)}, m.":time_ns")'
    connection.execute(
        f"CREATE OR REPLACE TEMP VIEW {quoted(f'{TOPIC} {topic}')} AS"
        f" SELECT t.name AS trace, round(({time} - t.start_ns) / 1e3) / 1e6 AS t, m.log_time_ns,"
        f" m.publish_time_ns{listed} FROM {view} m"
        f" JOIN {INSIDE}.trace t ON t.trace_id = m.{quoted(FRAME)} >> {SEQ_BITS}"
    )


@dataclass(frozen=True, slots=True)
class _Source:
    """Messages of a topic, either from a table of the store or from files made from a recording."""

    table: str
    fields: Mapping[str, str]

    def rows(self, fields: Mapping[str, str]) -> str:
        """Return SQL that selects the messages. The columns are the same for all sources of a topic."""
        listed = [*map(quoted, KEYS)]
        for name, kind in fields.items():
            value = quoted(name) if name in self.fields else "NULL"
            same = self.fields.get(name) == kind
            listed.append(f"{value if same else f'CAST({value} AS {kind})'} AS {quoted(name)}")
        return f"SELECT {', '.join(listed)} FROM {self.table}"


def _sources(
    connection: DuckDBPyConnection, access: Access, facts: TopicFacts
) -> Iterator[_Source]:
    stored = _stored(connection).get(facts.name, {})
    for table, fields in dict(stored.values()).items():
        yield _Source(f"{INSIDE}.{table}", fields)
    missing = facts.traces - stored.keys()
    if missing:
        for trace in stored_traces(connection, access.path, access.root):
            if trace.trace_id in missing:
                yield _of_recording(connection, access, trace, facts.name)


def _stored(connection: DuckDBPyConnection) -> dict[str, dict[int, tuple[str, dict[str, str]]]]:
    """Return the stored topics: topic → trace id → table and fields."""
    found: dict[str, dict[int, tuple[str, dict[str, str]]]] = {}
    for trace_id, file in _listed(connection):
        found.setdefault(file.topic, {})[trace_id] = file.table, file.fields
    return found


def listed_topics(connection: DuckDBPyConnection) -> dict[int, dict[str, dict[str, Any]]]:
    """Return the stored topics: trace id → topic → numbers of messages, and fields."""
    found: dict[int, dict[str, dict[str, Any]]] = {}
    for trace_id, file in _listed(connection):
        about = {"messages": file.messages, "lost": file.lost, "fields": file.fields}
        found.setdefault(trace_id, {})[file.topic] = about
    return found


def _listed(connection: DuckDBPyConnection) -> Iterator[tuple[int, TopicFile]]:
    """Yield the stored topics with their trace ids."""
    ((database,),) = connection.execute("SELECT current_database()").fetchall()
    tables = topic_tables(connection, database)
    if LISTING not in tables:
        return
    columns = 'trace_id, topic, "table", schema, encoding, fields, messages, lost'
    rows = connection.execute(f"SELECT {columns} FROM {INSIDE}.{LISTING} ORDER BY topic, trace_id")
    for trace_id, topic, table, schema, encoding, fields, messages, lost in rows.fetchall():
        file = TopicFile(topic, schema, encoding, [], json.loads(fields), messages, lost)
        if file.table == table in tables:  # so the table has these columns
            yield trace_id, file


_converted: Final[dict[tuple[Any, ...], TopicFile]] = {}
"""Topics of recordings that this process has already converted to files, by key."""


def _of_recording(
    connection: DuckDBPyConnection, access: Access, trace: StoredTrace, topic: str
) -> _Source:
    """Convert a topic of a recording to files, once per process."""

    def convert(folder: Path) -> TopicFile:
        clock = FrameClock.of_stored(connection, trace.trace_id)
        bounded = (trace.since, trace.until) != (None, None)
        return converted(_recording(trace, topic), topic, folder, clock, bounded=bounded)

    return _once((trace.trace_id, trace.frames, trace.start_ns, trace.end_ns, topic), convert)


def _once(key: tuple[Any, ...], convert: Callable[[Path], TopicFile]) -> _Source:
    """Return the converted files of a topic. The first call in a process creates them."""
    name = hashlib.sha256(repr(key).encode("utf-8", "replace")).hexdigest()[:16]
    folder = tables_folder() / "topics" / name
    file = _converted.get((folder, *key))
    if file is None:
        file = _converted[folder, *key] = convert(folder)
    return _Source(f"({file.rows(folder)})", file.fields)


def _recording(trace: StoredTrace, topic: str) -> Path:
    """Return the path of the recording of a trace. It must exist and be unchanged."""
    try:
        return unchanged(trace.path, trace.size, trace.mtime_ns, trace.digest)
    except TraceError as error:
        hint = f"ingest it with --topics {topic} to store the topic, or give the folder of the recordings"
        raise TopicError(
            f"topic {topic!r} is read from the recording; {error}", f"{hint} (--root)"
        ) from error


def converted(
    path: Path, topic: str, folder: Path, clock: FrameClock | None = None, *, bounded: bool = False
) -> TopicFile:
    """Write the messages of a topic of a recording to Parquet files in a folder.

    Without a clock of frames, times begin with the first message of the recording.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with _reading(path, [topic]) as reading, topic_scratch(folder) as connection:
        if clock is None:
            first = np.array([_first_ns(reading.recording)])
            clock = FrameClock(np.zeros(1, np.int64), np.zeros(1, np.int64), first)
        writer = TopicWriter(connection, folder, clock, bounded=bounded)
        for batch in reading.batches(Findings()):
            writer.add(batch)
        (file,) = writer.files(reading)
    return file


@contextmanager
def _reading(path: Path, topics: Collection[str]) -> Generator[TopicReading]:
    """Open a recording, and yield a reader of some of its topics."""
    from sgstore.readers import TopicReading, open_recording  # most queries name no topic

    with open_recording(path) as recording:
        if not recording.channels:  # without a summary, the channels are known after a reading
            for _ in recording.walk(Findings()):
                pass
        yield TopicReading(recording, topics)


class RecordingSql:
    """SQL statements of users on the topics of a recording, without a store.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextmanager
    def answered(
        self, ask: Callable[[DuckDBPyConnection, ExitStack], T], sql: str, *, public: bool = False
    ) -> Generator[T]:
        """Context manager that yields the result of a query, as :meth:`StoreFile.answered`."""
        del public
        folder = tables_folder() / "topics"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        memory, threads = default_memory(), os.cpu_count() or 1
        with ExitStack() as stack, scratch(folder, memory=memory, threads=threads) as connection:
            for topic in topics_in_sql(sql):
                self._show(connection, topic)
            connection.execute(f"CREATE SCHEMA {INSIDE}")
            connection.execute(f"CREATE TABLE {INSIDE}.store_info (key VARCHAR, value VARCHAR)")
            shut_in(connection, folder / "none", (folder,))
            try:
                yield ask(connection, stack)
            except SqlError as error:
                lack = _NO_TABLE.search(str(error))
                if lack is None:
                    raise
                reason = f"{self._path}: a recording has no table {lack[1]!r}; it has only topics"
                example = "SELECT * FROM topic('/imu')"
                raise SqlError(f"{reason}: {example}; ingest it for scene graphs") from error

    def _show(self, connection: DuckDBPyConnection, topic: str) -> None:
        key = str(self._path), *mark_of(self._path), topic
        source = _once(key, partial(converted, self._path, topic))
        listed = "".join(f", {quoted(name)}" for name in source.fields)
        connection.execute(
            f"CREATE TEMP VIEW {quoted(f'{TOPIC} {topic}')} AS SELECT {literal(self._path.stem)} AS trace,"
            ' round(":time_ns" / 1e3) / 1e6 AS t, log_time_ns, publish_time_ns'
            f"{listed} FROM {source.table}"
        )


_NO_TABLE: Final = re.compile(r"Table with name (\S+) does not exist")


def _first_ns(recording: Recording) -> int:
    """Return the log time at which a recording begins, judged from its first messages; ns."""
    for run in recording.walk(Findings()):
        if len(run):
            return int(run.log_time_ns.min())
    return 0


def topic_facts(connection: DuckDBPyConnection, access: Access) -> dict[str, TopicFacts]:
    """Return the topics of a store, by name. Their fields are read on demand."""
    stored = _stored(connection)
    sql = (
        "SELECT topic, coalesce(message_encoding, ''), coalesce(schema_encoding, ''), list(trace_id)"
        f" FROM {INSIDE}.channel WHERE topic IS NOT NULL GROUP BY ALL ORDER BY ALL"
    )
    found: dict[str, TopicFacts] = {}
    for topic, encoding, schema, traces in connection.execute(sql).fetchall():
        known = found.get(topic)
        ids = frozenset(traces) | (known.traces if known else frozenset())
        reason = (known.refused if known else "") or refusal(encoding, schema)
        whole = stored.get(topic, {}).keys() >= ids
        # Compiled statements keep the facts; they must not keep the file open.
        source = cache(partial(_fields, ref(access), topic))
        found[topic] = TopicFacts(topic, ids, whole, "" if whole else reason, source)
    return found


def _fields(held: ref[Access], topic: str) -> Mapping[str, TopicField]:
    """Return the fields of a topic: from stored tables, and from one recording without such a table."""
    access = held()
    if access is None:
        raise StoreError("the store of these topics is closed")
    with access.reading() as connection:
        stored = _stored(connection).get(topic, {})
        told = [fields for _, fields in stored.values()]
        others = [
            trace
            for trace in stored_traces(connection, access.path, access.root)
            if trace.trace_id not in stored
            and connection.execute(
                f"SELECT 1 FROM {INSIDE}.channel WHERE trace_id = ? AND topic = ?",
                [trace.trace_id, topic],
            ).fetchone()
        ]
        for trace in others[:1]:
            fields = fields_in(_recording(trace, topic), topic)
            told.append(fields or dict(_of_recording(connection, access, trace, topic).fields))
    return field_list(common_fields(told).items())


def topics_in(path: Path) -> dict[str, TopicFacts]:
    """Return the topics of a recording, by name, without fields."""
    with _reading(path, ()) as reading:
        return reading.known


def fields_in(path: Path, topic: str) -> dict[str, str] | None:
    """Return the fields of a recorded topic: name → database type; ``None`` if it is JSON."""
    return _fields_at(path, mark_of(path), topic)


@lru_cache(maxsize=256)
def _fields_at(path: Path, _mark: tuple[int, int], topic: str) -> dict[str, str] | None:
    with _reading(path, [topic]) as reading:
        found = reading.fields(topic)
    return None if found is None else {name: one.declared for name, one in found.items()}


_UNKNOWN: Final = re.compile(r'Referenced (?P<what>column|table) "(?P<name>[^"]+)" not found')


def field_fault(connection: DuckDBPyConnection, sql: str, message: str) -> str:
    """Return the error for an unknown field of a topic in a user's SQL statement; empty for other errors.

    ``message``: error of the database.
    """
    found = _UNKNOWN.search(message)
    topics = topics_in_sql(sql)
    if found is None or not topics:
        return ""
    name = found["name"]
    for topic in topics:
        rows = connection.execute(f"DESCRIBE {quoted(f'{TOPIC} {topic}')}").fetchall()
        fields = field_list((str(row[0]), str(row[1])) for row in rows)
        within = [one for one in fields if one.lower().startswith(f"{name.lower()}.")]
        if found["what"] == "table" and within:
            reason = f"topic {topic!r} has no table {name!r}"
            return f'{reason}; write a dotted field in double quotes: "{within[0]}"'
        if found["what"] == "column":
            try:
                field_named(fields, topic, name)
            except TopicError as error:
                return str(error)
    return ""


# Values at frames.


_STAMPS: Final = (
    ("header.stamp.sec", "header.stamp.nanosec"),  # ROS
    ("stamp.sec", "stamp.nanosec"),  # ROS, Autoware
    ("timestamp.seconds", "timestamp.nanos"),  # OSI, protobuf of Foxglove
    ("timestamp.sec", "timestamp.nsec"),  # JSON and ROS of Foxglove
    ("timestamp.sec", "timestamp.nanosec"),  # ROS 2 of Foxglove
)
"""Fields with the time stamp of a message: seconds and nanoseconds."""
_AHEAD_NS: Final = 1_000_000_000
"""Largest time by which a usable stamp is later than the message's log time, by the clock of the frames; ns."""
_BEHIND_NS: Final = 60_000_000_000
"""Largest time by which a usable stamp is earlier; ns. Beyond it, the stamp is of another clock."""


def stamp_text(fields: Mapping[str, str]) -> str:
    """Return SQL for the time stamp of a message by the clock of the frames; NULL without a usable stamp.

    A stamp of another clock is not usable. A stamp of 0 is a time only near 0, because ROS writes 0 for
    "missing". A stamp far after its message is from before a backward step of the clock.
    """
    for pair in _STAMPS:
        if all(fields.get(name) in WHOLE for name in pair):
            sec, nano = (f"CAST({quoted(name)} AS HUGEINT)" for name in pair)
            stamp = f"({sec} * 1000000000 + {nano})"
            usable = (
                f'{stamp} - ":time_ns" BETWEEN {-_BEHIND_NS} AND {_AHEAD_NS}'
                f' AND ({stamp} <> 0 OR abs(":time_ns") <= {AT_ZERO_NS})'
            )
            return f"CASE WHEN {usable} THEN CAST({stamp} AS BIGINT) END"
    return "CAST(NULL AS BIGINT)"


def topic_values(
    connection: DuckDBPyConnection,
    access: Access,
    facts: TopicFacts,
    field: str,
    rule: str = "last",
    tolerance_ns: int | None = None,
) -> str:
    """Return SQL that selects frame id and value of a topic field. Frames without a known value are left out.

    Parameters
    ----------
    connection : DuckDBPyConnection
        Connection of the statement. It gets the views of the topic.
    access : Access
    facts : TopicFacts
    field : str
        ``linear_acceleration.z``, ``covariance[0]``
    rule : str
        ``last``: of the last message at or before the frame; ``nearest``: of the nearest one, the earlier one
        of two; ``linear``: interpolated between the messages before and after.
    tolerance_ns : int, optional
        Greatest time between the frame and the message; ns. ``None`` means unlimited.

    Raises
    ------
    TopicError
        The topic cannot be decoded; or the field does not exist, or cannot be interpolated.

    Notes
    -----
    A message belongs to the frame whose time is its stamp. If the messages have no stamp by the clock of the
    frames, log times are compared. Values never cross a backward step of that clock. Among messages of equal
    time, the last one counts.
    """
    known = field_named(fields_of(facts), facts.name, field)
    if rule == "linear" and known.type is not Type.number:
        reason = f"field {known.name!r} of topic {facts.name!r} is not a number"
        raise TopicError(reason, "rules for it are last and nearest")
    _show(connection, access, facts, facts.name)
    rows = connection.execute(f"DESCRIBE {quoted(f':messages {facts.name}')}").fetchall()
    stamp = stamp_text({str(row[0]): str(row[1]) for row in rows})
    return values_text(facts.name, known, rule, tolerance_ns, stamp)


def values_text(
    topic: str, field: TopicField, rule: str, tolerance_ns: int | None, stamp: str
) -> str:
    """Return SQL that selects a topic field's value at each frame. The view of the topic must exist.

    ``stamp``: see :func:`stamp_text`.
    """
    within = "" if tolerance_ns is None else f" <= {int(tolerance_ns)}"
    value = _value(field.name)
    if field.declared in {"FLOAT", "DOUBLE"}:
        value = f"CASE WHEN NOT isnan({value}) THEN {value} END"
    values = _VALUES.format(
        shift=SEQ_BITS,
        value=value,
        stamp=stamp,
        messages=quoted(f":messages {topic}"),
        inside=INSIDE,
        rounded=TOLERANCE_NS,
    )
    chosen = {"last": _LAST, "nearest": _NEAREST, "linear": _LINEAR}[rule]
    limits = {"before": f"f.at - b.at{within}", "after": f"a.at - f.at{within}"}
    if not within:
        limits = {"before": "b.at IS NOT NULL", "after": "a.at IS NOT NULL"}
    return values + chosen.format(**limits)


def _value(name: str) -> str:
    element = re.fullmatch(r"(.+)\[(\d+)\]", name)
    if element is None:
        return quoted(name)
    return f"{quoted(element[1])}[{int(element[2]) + 1}]"


_VALUES: Final = """WITH stamped AS (
  SELECT ":frame" >> {shift} AS trace_id, ":run" AS run, ":number", log_time_ns, ":time_ns",
         {stamp} AS stamp, count(stamp) OVER (PARTITION BY trace_id, run) > 0 AS by_stamp,
         {value} AS value
  FROM {messages}
), m AS (
  SELECT trace_id, run, by_stamp,
         CASE WHEN by_stamp THEN coalesce(stamp, ":time_ns") ELSE log_time_ns END AS at,
         arg_max_null(value, ":number") AS value
  FROM stamped GROUP BY ALL
), frames AS (
  SELECT frame_id, trace_id, time_ns, log_time_ns,
         CAST(coalesce(sum(back) OVER (PARTITION BY trace_id ORDER BY seq), 0) AS INTEGER) AS run
  FROM (
    SELECT *, CAST(time_ns < lag(time_ns) OVER (PARTITION BY trace_id ORDER BY seq) AS INTEGER) AS back
    FROM {inside}.frame
  )
), f AS (
  SELECT frame_id, trace_id, run, CASE WHEN by_stamp THEN time_ns ELSE log_time_ns END AS at,
         CASE WHEN by_stamp THEN {rounded} ELSE 0 END AS rounded
  FROM frames JOIN (SELECT DISTINCT trace_id, run, by_stamp FROM m) USING (trace_id, run)
)
"""
_BEFORE: Final = "m b ON b.trace_id = f.trace_id AND b.run = f.run AND f.at + f.rounded >= b.at"
_AFTER: Final = "m a ON a.trace_id = f.trace_id AND a.run = f.run AND f.at <= a.at"
_LAST: Final = f"SELECT f.frame_id, b.value FROM f ASOF JOIN {_BEFORE} WHERE {{before}} AND b.value IS NOT NULL"
_BOTH: Final = f"FROM f ASOF LEFT JOIN {_BEFORE} ASOF LEFT JOIN {_AFTER}"
_NEAREST: Final = f"""SELECT frame_id, value FROM (
  SELECT f.frame_id, CASE
    WHEN coalesce({{before}}, false) AND coalesce(f.at - b.at <= a.at - f.at OR NOT {{after}}, true)
    THEN b.value
    WHEN {{after}} THEN a.value END AS value
  {_BOTH}
) WHERE value IS NOT NULL"""
_LINEAR: Final = f"""SELECT f.frame_id,
  b.value + (CAST(a.value AS DOUBLE) - b.value) * (f.at - b.at) / greatest(a.at - b.at, 1) AS value
{_BOTH} WHERE {{before}} AND {{after}} AND a.value IS NOT NULL AND b.value IS NOT NULL"""
