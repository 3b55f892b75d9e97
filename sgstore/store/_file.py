"""Access to a store: one DuckDB file, which stays open for a short time after each query.

Imports for writing and drawing are local: they would take longer than a query.
"""

from __future__ import annotations

import hashlib
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

import sgstore.store._rows as rows
from sgstore.errors import SgstoreError, StoreError, TraceError
from sgstore.model.world import Channel, MessageRefs
from sgstore.store._arrow import record_batches, table_of
from sgstore.store._encounters import recorded_measures
from sgstore.store._engine_errors import EngineError, translated
from sgstore.store._locking import WAIT_S, Access, default_memory, spill_folder, stamp_of
from sgstore.store._rows import BATCH, Batches, Rows
from sgstore.store._temporary_tables import Given, give
from sgstore.store._traces import (
    FrameRef,
    Identity,
    StoredTrace,
    already_stored,
    frame_named,
    located,
    place_below,
    stored_name,
    stored_traces,
    trace_named,
    trace_of_request,
    unchanged,
    uri_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
    from contextlib import AbstractContextManager

    from duckdb import DuckDBPyConnection
    from mcap.records import Channel as McapChannel
    from mcap.records import Schema
    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Recording
    from sgstore.model.config import Config
    from sgstore.model.criticality import Meetings
    from sgstore.model.graph import SceneGraph
    from sgstore.model.world import TraceInfo
    from sgstore.readers import Media
    from sgstore.store._arrow import ArrowStream
    from sgstore.store._classes import Abstracted
    from sgstore.store._derive import Deriving
    from sgstore.store._graphs import Graphs
    from sgstore.store._joins import JoinedTable, UserTables
    from sgstore.store._locking import Stamp
    from sgstore.store._replayed_topics import ReplayedTopics
    from sgstore.store._rows import Parameters
    from sgstore.store._staging import Sealed
    from sgstore.store._user_sql import UserSql, UserTablesGiven
    from sgstore.store._verify import Verification
    from sgstore.store._write import Segment


T = TypeVar("T")

_AT_ONCE: Final = 64
"""Largest number of traces that are deleted in one transaction."""


def _damage(connection: DuckDBPyConnection, path: Path) -> str:
    from sgstore.store._verify import damage  # imported only after a fault

    return damage(connection, path)


class StoreFile:
    """Store of scene graphs (a DuckDB file), opened by its path.

    The file stays open for a second after a query, unless a writer process waits.

    Parameters
    ----------
    path : str or Path
    memory : int
        Memory limit of one query; bytes. 0: 1 GiB, or a quarter of the machine's memory if less. Beyond it, the
        database writes temporary files.
    wait_s : float
        Longest wait for other processes; s.
    spill : int
        Limit of the temporary files of one query; bytes. 0: 10 GB.
    tables : UserTables, optional
        User tables, visible next to the views.
    root : str or Path, optional
        New folder of the recordings; see :func:`sgstore.store._traces.located`.
    made : bool
        True if this process has just created the file. The store check is then skipped.

    Raises
    ------
    StoreError
        The file does not exist, is not a store, or has another version; or a table has the name of a store
        table.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        memory: int = 0,
        wait_s: float = WAIT_S,
        tables: UserTables | None = None,
        spill: int = 0,
        root: str | Path | None = None,
        made: bool = False,
    ) -> None:
        self.path = Path(path)
        self.tables = tables
        self.memory = memory or default_memory()
        self.access = Access(
            self.path,
            memory=self.memory,
            wait_s=wait_s,
            tables=tables,
            spill=spill,
            diagnose=_damage,
        )
        self.access.root = root
        self._graphs: Graphs | None = None
        self._abstracted: Abstracted | None = None
        self._known: tuple[Stamp, Catalog] | None = None
        self._answers: dict[str, dict[str, NDArray[np.generic]]] | None = None
        if not made:
            with self.access.reading():  # rejects an invalid store
                pass

    @classmethod
    def together(cls, path: str | Path) -> StoreFile:
        """Open a store in a database that all stores of its folder share. This is four times faster.

        Raises
        ------
        StoreError
            See :class:`StoreFile`.
        """
        file = cls(path, made=True)
        file.access.together = True
        with file.access.reading():
            return file

    @classmethod
    def create(cls, path: str | Path, *, memory: int = 0, wait_s: float = WAIT_S) -> StoreFile:
        """Open the store at a path. Create an empty store if the file is missing.

        Raises
        ------
        StoreError
            The file is not a store, or has another version; or the folder is not writable.
        """
        path = Path(path)
        made = not path.exists()
        if made:
            from sgstore.store._creation import create

            create(path)
        return cls(path, memory=memory, wait_s=wait_s, made=made)

    @staticmethod
    def replayed_topics(recording: Recording) -> AbstractContextManager[ReplayedTopics]:
        """Context manager that yields the topics of an open recording. No store is needed."""
        from sgstore.store._replayed_topics import replayed_topics

        return replayed_topics(recording)

    def snapshot(self) -> AbstractContextManager[object]:
        """Keep the store open for several queries. The queries see the same state and run faster."""
        return self.access.reading(idle=True)

    @contextmanager
    def shared(self) -> Generator[None]:
        """Keep the store open as in :meth:`snapshot`, and keep the query results that several patterns use."""
        with self.snapshot():
            self._answers = {}
            try:
                yield
            finally:
                self._answers = None

    def close(self) -> None:
        """Close the store file if no query is running. The next query opens it again."""
        self.access.close()

    def rows(
        self, sql: str, parameters: Parameters | None = None, *, given: Iterable[Given] = ()
    ) -> Rows:
        """Run a trusted SQL statement, and return all rows.

        Parameters
        ----------
        sql : str
            Trusted SQL. For a user's statement, use :meth:`user_sql`.
        parameters : sequence or mapping, optional
            Values of ``?`` or of ``$name``.
        given : iterable of Given
            Temporary tables for the statement.

        Raises
        ------
        StoreError
            The database rejects the statement.
        """
        with self.answered(lambda at, _: rows.run(at, sql, parameters), sql, given) as found:
            return found

    def arrays(
        self,
        sql: str,
        parameters: Parameters | None = None,
        *,
        given: Iterable[Given] = (),
        plain: bool = False,
    ) -> dict[str, NDArray[np.generic]]:
        """Run a trusted SQL statement, and return all columns as arrays. NULL values are masked.

        ``plain``: the result has no enumerations. This saves one planning of the statement.
        """
        given = list(given)
        kept = self._answers
        if not plain or not all(isinstance(one, tuple) for one in given):
            kept = None
        key = "" if kept is None else repr((sql, parameters, given))  # long with many ids
        if kept is not None and key in kept:
            return {**kept[key]}
        ask = partial(rows.arrays, sql=sql, parameters=parameters, plain=plain)
        with self.answered(lambda at, _: ask(at), sql, given) as found:
            if kept is not None:
                kept[key] = {**found}  # callers take columns out
                size = sum(one.nbytes for held in kept.values() for one in held.values())
                while size > self.memory // 4:  # the oldest ones are dropped
                    size -= sum(one.nbytes for one in kept.pop(next(iter(kept))).values())
            return found

    def table(
        self, sql: str, parameters: Parameters | None = None, *, given: Iterable[Given] = ()
    ) -> Any:
        """Run a trusted SQL statement, and return all rows as an Arrow table."""
        with self.answered(lambda at, _: table_of(at, sql, parameters), sql, given) as found:
            return found

    @contextmanager
    def batches(
        self,
        sql: str,
        parameters: Parameters | None = None,
        size: int = BATCH,
        *,
        given: Iterable[Given] = (),
    ) -> Generator[Batches]:
        """Run a trusted SQL statement, and stream its rows in batches of ``size`` rows."""
        with self.answered(lambda at, _: Batches(at, sql, parameters, size), sql, given) as found:
            yield found

    @contextmanager
    def asked(
        self, step: Callable[[DuckDBPyConnection], T], given: Iterable[Given] = ()
    ) -> Generator[T]:
        """Call a function with the database connection, and yield its result.

        Temporary tables are created before.
        """
        with self.answered(lambda x, _: rows.interruptible(x, partial(step, x)), "", given) as y:
            yield y

    @contextmanager
    def record_batches(
        self, sql: str, parameters: Parameters | None = None, *, given: Iterable[Given] = ()
    ) -> Generator[ArrowStream | None]:
        """Run a trusted SQL statement, and stream its rows as Arrow batches."""
        with self.answered(lambda x, _: record_batches(x, sql, parameters), sql, given) as y:
            yield y

    def user_sql(
        self, sql: str, timeout_s: float | None = None, given: UserTablesGiven | None = None
    ) -> UserSql:
        """Prepare a read-only SQL statement of a user, with a time limit in s and temporary tables.

        Examples
        --------
        >>> store.file.user_sql("SELECT count(*) FROM frames").rows().values
        [(750,)]
        """
        from sgstore.store._user_sql import UserSql

        return UserSql(self.answered, sql, timeout_s, given)

    @staticmethod
    def recording_sql(path: Path, sql: str, timeout_s: float | None = None) -> UserSql:
        """Prepare a read-only SQL statement of a user on the topics of a recording, without a store."""
        from sgstore.store._topic_views import RecordingSql
        from sgstore.store._user_sql import UserSql

        return UserSql(RecordingSql(path).answered, sql, timeout_s, None)

    @staticmethod
    def about_sql(sql: str) -> tuple[bool | None, tuple[str, ...]]:
        """Return if an SQL statement reads the ``world_…`` views (True) or graphs (False), and notes on kinds.

        The first value is False for views of graphs, and ``None`` without such views.
        """
        from sgstore.store._sql_words import kind_notes, world_read

        return world_read(sql), kind_notes(sql)

    @staticmethod
    def recorded_topics(path: Path) -> list[str]:
        """Return the names of the topics of a recording, sorted."""
        from sgstore.store._topic_views import topics_in

        return sorted(topics_in(path))

    def joined(self) -> dict[str, JoinedTable]:
        """Return the row counts of user tables that are joined with frames, by table name."""
        with self.access.reading() as connection:
            return {} if self.tables is None else self.tables.joined(connection)

    @property
    def stamp(self) -> str:
        """Return a short text that changes at every write to the store."""
        return hashlib.sha256(repr(stamp_of(self.path)).encode()).hexdigest()[:16]

    def catalog(self) -> Catalog:
        """Return names, types and counts of the store for the query compiler. Cached until the file changes."""
        if self._known is not None and self._known[0] == stamp_of(self.path):
            return self._known[1]  # opening the store takes longer than compiling a query
        from sgstore.store._catalog import catalog_of
        from sgstore.store._topic_views import topic_facts

        with self.access.reading() as connection:
            stamp, catalog = stamp_of(self.path), catalog_of(connection)
            if self.tables is not None:
                catalog = self.tables.known(connection, catalog)
            catalog = replace(catalog, topics=topic_facts(connection, self.access))
            self._known = stamp, catalog
            return catalog

    def traces(self) -> tuple[StoredTrace, ...]:
        """Return all traces of the store, by name in natural order (``run2`` before ``run10``)."""
        with self.access.reading() as connection:
            return stored_traces(connection, self.path, self.access.root)

    def trace(self, ref: int | str) -> StoredTrace:
        """Return a trace of the store by name, by id, or by a unique prefix of its name.

        Raises
        ------
        StoreError
            No trace or several traces match; the message lists them.
        """
        with self.access.reading() as connection:
            trace_id, _ = trace_named(connection, str(ref))
            known = stored_traces(connection, self.path, self.access.root)
            found = [one for one in known if one.trace_id == trace_id]
            if not found:
                raise StoreError(
                    f"{self.path}: the settings of {ref!r} are gone; see 'sgstore verify'"
                )
            return found[0]

    def frame(self, ref: int | str) -> FrameRef:
        """Return a frame by id, ``TRACE#SEQ`` or ``TRACE@12.3s``: the last frame at or before that time.

        Parameters
        ----------
        ref : int or str
            Frame. TRACE is as for :meth:`trace`; times are seconds since the trace start.

        Raises
        ------
        StoreError
            The frame does not exist; the message lists the frames.
        """
        with self.access.reading() as connection:
            return frame_named(connection, ref)

    def graph(self, ref: int | str) -> SceneGraph:
        """Return the scene graph of a frame, with all nodes, edges and attributes in the store.

        Raises
        ------
        StoreError
            The frame does not exist.
        """
        with self.access.reading() as connection:
            frame = frame_named(connection, ref)
            found = next(self._reader.scenes(connection, np.array([frame.frame_id])))
        return replace(found, around=partial(self._known_graph, frame.frame_id))

    def _known_graph(self, frame_id: int) -> SceneGraph:
        with self.access.reading() as connection:
            return next(self._reader.scenes(connection, np.array([frame_id]), known=True))

    def graphs(self, frame_id: NDArray[np.int64]) -> Iterator[SceneGraph]:
        """Yield the scene graphs of one trace for ascending frame ids. All columns are in memory together."""
        with self.access.reading() as connection:
            yield from self._reader.scenes(connection, frame_id)

    @property
    def _reader(self) -> Graphs:
        """Reader of scene graphs with a cache of road maps."""
        if self._graphs is None:
            from sgstore.store._graphs import Graphs

            self._graphs = Graphs()
        return self._graphs

    def trace_id(self, trace: int | str) -> int:
        """Return the id of a trace, given by name or id.

        Raises
        ------
        StoreError
            The trace does not exist.
        """
        with self.access.reading() as connection:
            return trace_named(connection, str(trace))[0]

    def meetings(self, measures: Sequence[str]) -> Iterator[Meetings]:
        """For each ego, yield its encounters with all other known objects, with the given measures."""
        from sgstore.store._meetings import meetings

        with translated(self.path), self.access.reading() as connection:
            yield from meetings(connection, measures)

    def recorded_encounters(self, measures: Sequence[str]) -> Rows:
        """Return the pairs of the view ``encounters`` with some of their criticality measures."""
        from sgstore.store._meetings import recorded_encounters

        pairs = self.arrays("SELECT trace_id, trace, src, dst, kind FROM encounters ORDER BY ALL")
        return Rows(*recorded_encounters(pairs, self.meetings(measures), measures))

    def road_map_text(self, trace: int | str) -> tuple[str, str] | None:
        """Return name and OpenDRIVE text of a trace's road map, or ``None`` without such a text."""
        sql = (
            "SELECT m.name, m.text FROM trace t JOIN map m ON m.map_id = t.map_id"
            " WHERE t.trace_id = ? AND m.text IS NOT NULL"  # a map of named parts has no text
        )
        return next(iter(self.rows(sql, [self.trace_id(trace)]).values), None)

    def channels(self, trace: int | str) -> tuple[Channel, ...]:
        """Return the channels of a trace's recording. Their message counts are -1 (unknown)."""
        sql = (
            "SELECT channel_id, coalesce(topic, ''), coalesce(schema, ''), coalesce(schema_encoding, ''),"
            " coalesce(message_encoding, ''), -1, role FROM channel WHERE trace_id = ? ORDER BY channel_id"
        )
        return tuple(Channel(*row) for row in self.rows(sql, [self.trace_id(trace)]).values)

    def stored_topics(self) -> dict[int, dict[str, dict[str, Any]]]:
        """Return the stored topics: trace id → topic → numbers of stored and lost messages, and fields."""
        from sgstore.store._topic_views import listed_topics

        with self.access.reading() as connection:
            return listed_topics(connection)

    def context(self, trace: int | str) -> MessageRefs:
        """Return file positions of messages on which later messages of a trace depend, such as maps.

        ``channel`` is an index into :meth:`channels`.
        """
        sql = (
            "WITH number AS (SELECT channel_id, row_number() OVER (ORDER BY channel_id) - 1 AS channel"
            " FROM channel WHERE trace_id = $trace)"
            ' SELECT n.channel, c.log_time_ns, c.chunk_offset, c."offset", c.length'
            " FROM context c JOIN number n ON n.channel_id = c.channel_id WHERE c.trace_id = $trace"
            ' ORDER BY c.log_time_ns, c.chunk_offset, c."offset"'
        )
        columns = self.arrays(sql, {"trace": self.trace_id(trace)})
        return MessageRefs(*(column.astype(np.int64) for column in columns.values()))

    def payload(self, ref: int | str, channel: str) -> bytes:
        """Return the raw bytes of a channel's message at a frame, read from the recording.

        Parameters
        ----------
        ref : int or str
            Frame, as for :meth:`frame`.
        channel : str
            Topic.

        Raises
        ------
        StoreError
            The frame or channel does not exist, or the frame has no message of the channel.
        TraceError
            The recording is missing, replaced, or damaged at this position.
        """
        from sgstore.readers import read_message

        path, _, place = self._payload_place(ref, channel)
        return read_message(path, **place)

    def carried(self, ref: int | str, channel: str) -> Media:
        """Return a channel's message at a frame as a picture, a video, or raw bytes.

        Parameters
        ----------
        ref, channel
            See :meth:`payload`.

        Returns
        -------
        Media
            A frame of H.264 or H.265 includes its key frame and all frames between.

        Raises
        ------
        StoreError
            See :meth:`payload`.
        TraceError
            See :meth:`payload`; or the recording lacks the data to decode the video frame.
        """
        from sgstore.readers import read_carried

        path, channel_id, place = self._payload_place(ref, channel)
        return read_carried(path, channel=channel_id, **place)

    def recorded(self, ref: int | str, channel: str) -> tuple[McapChannel, Schema | None, bytes]:
        """Return channel, schema and raw bytes of a channel's message at a frame, read from the recording.

        Parameters and errors are those of :meth:`payload`.
        """
        from sgstore.readers import open_recording, read_message

        path, channel_id, place = self._payload_place(ref, channel)
        data = read_message(path, **place)
        with open_recording(path) as recording:
            known = recording.channels[channel_id]
            return known, recording.schemas.get(known.schema_id), data

    def _payload_place(self, ref: int | str, channel: str) -> tuple[Path, int, dict[str, int]]:
        """Return recording path, channel id and file position of a channel's message at a frame."""
        from sgstore.store._payloads import payload_place

        with self.access.reading() as connection:
            frame = frame_named(connection, ref)
            found = payload_place(connection, frame, channel)
            sql = (
                "SELECT r.uri, r.place, r.size, r.mtime_ns, r.digest FROM trace t"
                " JOIN recording r ON r.recording_id = t.recording_id WHERE t.trace_id = ?"
            )
            ((uri, inside, size, *mark),) = connection.execute(sql, [frame.trace_id]).fetchall()
        channel_id, chunk_offset, offset, length = found
        place = {"chunk_offset": chunk_offset, "offset": offset, "length": length}
        path = located(uri, inside, size, self.path, self.access.root)
        return unchanged(path, size, *mark), channel_id, place

    def stored(
        self,
        info: TraceInfo,
        config: Config,
        road_map: RoadMap | None,
        part: tuple[float | None, float | None] = (None, None),
    ) -> str | None:
        """Return the stored trace name of a recording, or ``None`` if the store does not have the recording.

        Parameters
        ----------
        info, config, road_map
            See :meth:`segment`.
        part : tuple
            Start and end of the part to read; s.

        Raises
        ------
        StoreError
            The store has another part of the recording, or used another config or map; or another trace has the
            same id.
        """
        with self.access.reading() as connection:
            return already_stored(connection, Identity.of(info, config, road_map, part))

    def segment(
        self,
        info: TraceInfo,
        config: Config,
        *,
        road_map: RoadMap | None = None,
        answers: tuple[str, ...] = (),
    ) -> Segment:
        """Return a writer for the graphs of a new trace. The graphs stay outside the store until publication.

        Parameters
        ----------
        info : TraceInfo
        config : Config
            Config of the graphs.
        road_map : RoadMap, optional
            Road map of the graphs.
        answers : tuple of str
            Relations that the graphs can contain.
        """
        from sgstore.store._write import OnMap, Segment

        identity = Identity.of(info, config, road_map)
        return Segment(self.path, info, identity, OnMap(road_map), answers)

    def publish(self, sealed: Sealed, *, replace: bool = False) -> str:
        """Add a complete trace to the store in one transaction, and return its name in the store.

        Parameters
        ----------
        sealed : Sealed
        replace : bool
            True to replace the stored trace with the same id, under the same name.

        Returns
        -------
        str
            The name of the trace in the store.

        Raises
        ------
        StoreError
            The trace was added to the store in the meantime, another process uses the store for too long, or
            the disk is full.
        """
        (found,) = self.publish_each([sealed], replace=replace)
        if isinstance(found, SgstoreError):
            raise found
        return found

    def publish_each(
        self, sealed: Sequence[Sealed], *, replace: bool = False
    ) -> list[str | SgstoreError]:
        """Add complete traces to the store, one transaction per trace. The file is opened once.

        Returns
        -------
        list of str or SgstoreError
            Stored name of each trace, or its error.
        """
        from sgstore.store._publish import publish_each

        return publish_each(self.access, sealed, replace=replace)

    def has(self, sealed: Sealed, *, as_it_is: bool = True) -> str | None:
        """Find a new trace in the store. Return the trace's name in the store; ``None`` if it is not stored.

        Parameters
        ----------
        sealed : Sealed
        as_it_is : bool
            True if the settings must be equal, too.

        Raises
        ------
        StoreError
            See :meth:`stored`.
        """
        found = already_stored if as_it_is else stored_name
        with self.access.reading() as connection:
            return found(connection, sealed.identity)

    def known_digest(self, path: Path) -> str:
        """Return the digest of an ingested recording if size and time of its file are unchanged; else empty."""
        from sgstore.mcap import mark_of

        try:
            mark = mark_of(path)
        except (OSError, TraceError):
            return ""
        sql = (
            "SELECT any_value(digest) FROM recording WHERE (uri = ? OR place = ?)"
            " AND size = ? AND mtime_ns = ?"
        )
        places = uri_of(path), place_below(self.path, path)
        with self.access.reading() as connection:
            found = connection.execute(sql, [*places, *mark]).fetchone()
        return str(found[0]) if found and found[0] else ""

    def requested(self, path: Path, request: str) -> tuple[str, str, int, dict[str, Any]] | None:
        """Find the stored trace of the same ingest request. Return its name, ego, frames and report.

        ``None`` means no such trace, or a file that has changed.
        """
        with self.access.reading() as connection:
            digest = self.known_digest(path)
            return trace_of_request(connection, digest, request) if digest else None

    def remove(self, *traces: int | str) -> tuple[StoredTrace, ...]:
        """Delete traces, with the settings and maps that no other trace uses.

        Up to 64 traces are deleted in one transaction.

        Raises
        ------
        StoreError
            A trace does not exist, or another process uses the store for too long.
        """
        from sgstore.store._publish import remove
        from sgstore.store._staging import scratch

        with self.access.reading():
            gone = {trace.trace_id: trace for trace in map(self.trace, traces)}
        ids = list(gone)
        for first in range(0, len(ids), _AT_ONCE):
            # The database keeps all deletions of a transaction in memory.
            database = scratch(spill_folder(), memory=self.memory)
            with database as connection, self.access.writing(connection):
                for trace_id in ids[first : first + _AT_ONCE]:
                    remove(connection, trace_id)
        return tuple(gone.values())

    @property
    def abstracted(self) -> Abstracted:
        """Abstracted graphs of the store's frames, and the frame classes."""
        if self._abstracted is None:
            from sgstore.store._classes import Abstracted

            self._abstracted = Abstracted(self.path, self.access)
        return self._abstracted

    @property
    def deriving(self) -> Deriving:
        """Derived sets of relations: edges computed after ingest."""
        from sgstore.store._derive import Deriving

        return Deriving(self.path, self.access)

    def verify(self, *, recordings: bool = False) -> Verification:
        """Check the store's rows against the checksums of the published rows. Return the faults.

        Parameters
        ----------
        recordings : bool
            True to also read and hash all recordings.
        """
        from sgstore.store._verify import verify_store

        return verify_store(self.access, recordings=recordings)

    def settle(self) -> None:
        """Merge the write-ahead log of a killed writer process into the store file.

        Without a log, or if another process uses the store for too long, nothing happens.
        """
        from sgstore.store._rebuild import settle

        settle(self.path, self.access, self.memory)

    def compact(self) -> None:
        """Rewrite the store with its large tables sorted across all traces, and replace the old file.

        Ingest appends each trace, so a scan for one relation reads all traces, and removed traces leave holes.
        The compacted store gives the same results. Compaction is worthwhile after many ingests or removals.

        Raises
        ------
        StoreError
            Another process uses the store for too long, the disk lacks space for a second store, or the store
            has user tables, which would be lost.
        """
        from sgstore.store._rebuild import compact

        compact(self.path, self.access, self.memory)

    def write_portable(
        self,
        to: Path,
        frame_id: NDArray[np.int64],
        storage: str,
        labels: Mapping[str, tuple[str, Sequence[Any]]],
    ) -> None:
        """Copy frames into a plain DuckDB file; see :func:`sgstore.store._portable.write_portable`."""
        from sgstore.store._portable import write_portable

        write_portable(self.path, to, frame_id, storage, labels)

    def refuse_others(self) -> None:
        """Raise an error if the store has user tables or views, which compaction would delete."""
        from sgstore.store._rebuild import refuse_others

        refuse_others(self.path, self.access)

    def _show_topics(self, connection: DuckDBPyConnection, sql: str) -> None:
        """Create the views of the topics that a statement names."""
        if '":topic ' in sql:
            from sgstore.store._topic_views import show_topics

            show_topics(connection, self.access, sql)

    @contextmanager
    def answered(
        self,
        ask: Callable[[DuckDBPyConnection, ExitStack], T],
        sql: str,
        given: Iterable[Given] = (),
        *,
        public: bool = False,
    ) -> Generator[T]:
        """Context manager that runs a query, yields its result, and keeps the store open until the end.

        After an internal DuckDB fault, the query runs again. The exit stack of the query is closed at its end.
        """
        with ExitStack() as stack:
            while True:
                try:
                    connection = stack.enter_context(self.access.reading(public=public))
                    with translated(self.path):
                        stack.enter_context(recorded_measures(connection, self.access, sql))
                        self._show_topics(connection, sql)
                        give(connection, given)
                        found = ask(connection, stack)
                    break
                except EngineError:
                    stack.close()
                    if not self.access.restart():
                        raise
            yield found
