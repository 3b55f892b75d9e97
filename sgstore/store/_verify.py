"""Verification of a store: row checksums, bit masks of frames, and references between rows.

Reading a table also verifies DuckDB's block checksums.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.errors import SgstoreError, StoreError
from sgstore.model.config import from_dict
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store._checksums import Checksum, expressions
from sgstore.store._columns import REPEATED, STATES
from sgstore.store._engine_errors import translated
from sgstore.store._locking import Access
from sgstore.store._packing import LONGEST_STEP
from sgstore.store._publish import SHARED, checksum_of, owned
from sgstore.store._schema import schema_faults
from sgstore.store._traces import stored_traces

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from duckdb import DuckDBPyConnection

    from sgstore.store._traces import StoredTrace


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault found by the verification of a store, with the trace and a description.

    Attributes
    ----------
    trace : str
        Name of the trace; empty for a fault of the whole store.
    check : str
        ``schema``, ``rows``, ``masks``, ``frames``, ``references``, ``map``, ``payloads``.
    detail : str
        Description of the fault.
    """

    trace: str
    check: str
    detail: str


@dataclass(slots=True)
class Verification:
    """Result of the verification of a store: faults, and numbers of checked traces and rows.

    Attributes
    ----------
    traces, rows, recordings : int
        Numbers of verified traces and rows, and of hashed recordings.
    faults : list of Fault
    others : tuple of str
        User tables and views; they are not verified.
    """

    traces: int = 0
    rows: int = 0
    recordings: int = 0
    faults: list[Fault] = field(default_factory=list[Fault])
    others: tuple[str, ...] = ()


_RULES: Final[tuple[tuple[str, str, str], ...]] = (
    *(
        (
            "masks",
            f"{what} in no frame, or in frames that the trace does not have",
            f"""
            SELECT r.bucket >> 18 FROM {table} r LEFT JOIN bucket b ON b.bucket = r.bucket
            WHERE b.bucket IS NULL OR r.mask = 0 OR (r.mask & ~b.valid) <> 0""",
        )
        for what, tables in (
            ("an edge holds", ("edge", "world_edge")),
            ("a static node is present", ("node", "world_node")),
        )
        for table in tables
    ),
    *(
        (
            "masks",
            f"a row of {table} is of no frame, or of frames that the trace does not have",
            f"""
            SELECT r.bucket >> 18 FROM {table} r LEFT JOIN bucket b ON b.bucket = r.bucket
            WHERE b.bucket IS NULL OR r.mask = 0 OR (r.mask & ~b.valid) <> 0""",
        )
        for table in REPEATED.values()
    ),
    (
        "masks",
        "the frames of a bucket differ from its number of frames, or are not consecutive",
        f"""
        SELECT coalesce(b.trace_id, f.trace_id)
        FROM bucket b FULL JOIN (
          SELECT bucket, any_value(trace_id) AS trace_id, bit_or(one) AS valid,
                 bit_or(CASE WHEN step BETWEEN 0 AND {LONGEST_STEP} THEN one ELSE 0 END) AS joined
          FROM (SELECT f.bucket, f.trace_id, t.period_ns, 1::BIGINT << f.bit AS one,
                       f.time_ns - lag(f.time_ns) OVER (PARTITION BY f.trace_id ORDER BY f.frame_id) AS step
                FROM frame f LEFT JOIN trace t ON t.trace_id = f.trace_id)
          GROUP BY bucket) f ON f.bucket = b.bucket
        WHERE b.valid IS DISTINCT FROM f.valid OR b.trace_id IS DISTINCT FROM f.trace_id
           OR b.joined IS DISTINCT FROM f.joined""",
    ),
    (
        "frames",
        "the number of frames differs from that of the trace, or the numbers do not run from 0 without gaps",
        """
        SELECT t.trace_id FROM trace t LEFT JOIN (
          SELECT trace_id, count(*) AS frames, count(DISTINCT seq) AS seqs, min(seq) AS first,
                 max(seq) AS last
          FROM frame GROUP BY trace_id) f ON f.trace_id = t.trace_id
        WHERE coalesce(f.frames, 0) <> t.frames OR f.seqs <> t.frames OR f.first <> 0
           OR f.last <> t.frames - 1""",
    ),
    (
        "frames",
        "a frame's id is not that of its trace and number",
        """
        SELECT trace_id FROM frame
        WHERE bucket <> (trace_id << 18) + seq // 60 OR bit <> seq % 60 OR frame_id <> (bucket << 6) + bit""",
    ),
    (
        "references",
        "rows of a trace that is not in the store",
        "SELECT f.trace_id FROM frame f WHERE f.trace_id NOT IN (SELECT trace_id FROM trace)",
    ),
    (
        "references",
        "a recording, settings or a map that are not in the store",
        """
        SELECT trace_id FROM trace
        WHERE config_id NOT IN (SELECT config_id FROM config)
           OR recording_id NOT IN (SELECT recording_id FROM recording)
           OR (map_id IS NOT NULL AND map_id NOT IN (SELECT map_id FROM map))""",
    ),
    *(
        (
            "references",
            f"the number of a {table} is not that of its digest",
            f"SELECT NULL FROM {table} WHERE {table}_id <> ('0x' || digest[:15])::BIGINT",
        )
        for table in SHARED
    ),
    (
        "references",
        "a frame lies on another map than its trace",
        "SELECT f.trace_id FROM frame f JOIN trace t ON t.trace_id = f.trace_id"
        " WHERE f.map_id IS DISTINCT FROM t.map_id",
    ),
    (
        "references",
        "an ego is not an entity of the trace",
        "SELECT f.trace_id FROM frame f WHERE f.ego IS NOT NULL AND NOT EXISTS"
        " (SELECT 1 FROM entity e WHERE e.trace_id = f.trace_id AND e.node_id = f.ego)",
    ),
    *(
        (
            "references",
            "a state belongs to no entity or no frame, or has another kind than its entity",
            f"""
            SELECT s.frame_id >> 24 FROM {states} s
            LEFT JOIN entity e ON e.trace_id = s.frame_id >> 24 AND e.node_id = s.node_id
            LEFT JOIN frame f ON f.frame_id = s.frame_id
            WHERE e.kind IS DISTINCT FROM s.kind OR f.frame_id IS NULL""",
        )
        for states in STATES
    ),
    (
        "references",
        "an entity is in the graph of a frame and beyond it",
        "SELECT w.frame_id >> 24 FROM world_state w JOIN state s USING (frame_id, node_id)",
    ),
    (
        "references",
        "an entity lies in a lane missing from its map, or is not an entity of the trace",
        """
        SELECT l.bucket >> 18
        FROM (SELECT bucket, node_id, kind, lane FROM lane_single UNION ALL
              SELECT bucket, node_id, kind, lane FROM lane_repeated UNION ALL
              SELECT bucket, node_id, kind, lane FROM world_lane_single UNION ALL
              SELECT bucket, node_id, kind, lane FROM world_lane_repeated) l
        LEFT JOIN trace t ON t.trace_id = l.bucket >> 18
        LEFT JOIN entity e ON e.trace_id = t.trace_id AND e.node_id = l.node_id
        LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = l.lane
        WHERE e.kind IS DISTINCT FROM l.kind OR m.node_id IS NULL""",
    ),
    *(
        (
            "references",
            f"an edge {way} a node that is not in the trace or its map, or its kind differs",
            f"""
            SELECT e.bucket >> 18
            FROM (SELECT DISTINCT bucket, {end} AS node, {end}_kind AS kind
                  FROM (SELECT * FROM edge UNION ALL SELECT * FROM world_edge)) e
            LEFT JOIN trace t ON t.trace_id = e.bucket >> 18
            LEFT JOIN entity n ON n.trace_id = t.trace_id AND n.node_id = e.node
            LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = e.node
            WHERE coalesce(n.kind, m.kind) IS DISTINCT FROM e.kind""",
        )
        for end, way in (("src", "comes from"), ("dst", "leads to"))
    ),
    (
        "references",
        "a static node is neither an entity of the trace nor a part of its map, or its kind differs",
        """
        SELECT k.bucket >> 18 FROM (SELECT * FROM node UNION ALL SELECT * FROM world_node) k
        LEFT JOIN trace t ON t.trace_id = k.bucket >> 18
        LEFT JOIN entity n ON n.trace_id = t.trace_id AND n.node_id = k.node_id
        LEFT JOIN map_node m ON m.map_id = t.map_id AND m.node_id = k.node_id
        WHERE coalesce(n.kind, m.kind) IS DISTINCT FROM k.kind""",
    ),
    (
        "references",
        "a payload is of no channel or of no frame",
        """
        SELECT p.trace_id FROM payload p
        LEFT JOIN channel c ON c.trace_id = p.trace_id AND c.channel_id = p.channel_id
        LEFT JOIN frame f ON f.bucket = p.bucket AND f.bit = p.bit
        WHERE c.channel_id IS NULL OR f.frame_id IS NULL""",
    ),
    (
        "map",
        "an edge of a map leads to a node outside the map",
        """
        SELECT NULL FROM map_edge e
        LEFT JOIN map_node a ON a.map_id = e.map_id AND a.node_id = e.src
        LEFT JOIN map_node b ON b.map_id = e.map_id AND b.node_id = e.dst
        WHERE a.kind IS DISTINCT FROM e.src_kind OR b.kind IS DISTINCT FROM e.dst_kind""",
    ),
    (
        "map",
        "a way along lanes of a map leads to a node that is not a lane of it",
        """
        SELECT NULL FROM map_reach r
        LEFT JOIN map_node a ON a.map_id = r.map_id AND a.node_id = r.src
        LEFT JOIN map_node b ON b.map_id = r.map_id AND b.node_id = r.dst
        WHERE a.kind IS DISTINCT FROM 'lane' OR b.kind IS DISTINCT FROM 'lane'""",
    ),
    (
        "map",
        "a place along lanes of a map belongs to a node outside the map, or lies on a node that is not a lane",
        """
        SELECT NULL FROM map_place p
        LEFT JOIN map_node a ON a.map_id = p.map_id AND a.node_id = p.node_id
        LEFT JOIN map_node b ON b.map_id = p.map_id AND b.node_id = p.lane
        WHERE a.kind IS NULL OR b.kind IS DISTINCT FROM 'lane'""",
    ),
    (
        "map",
        "a course of a lane of a map belongs to a node that is not a lane",
        """
        SELECT NULL FROM map_course c
        LEFT JOIN map_node n ON n.map_id = c.map_id AND n.node_id = c.lane
        WHERE n.kind IS DISTINCT FROM 'lane'""",
    ),
)
"""Check name, fault text, and the SQL that returns the ids of faulty traces."""


def verify_file(path: str | Path, *, recordings: bool = False) -> Verification:
    """Verify the content of a store file. The schema may be too altered for normal opening.

    If the schema was altered, only that fault is returned, and the tables are not read.

    Parameters
    ----------
    path : str or Path
    recordings : bool
        See :meth:`StoreFile.verify`.

    Raises
    ------
    StoreError
        The file does not exist, or is not a store.
    """
    place = Path(path)
    access = Access(place, checked=False)
    with access.reading() as connection:
        altered, others = schema_faults(connection, place)
    if altered:
        return Verification(faults=[Fault("", "schema", text) for text in altered], others=others)
    result = verify_store(Access(place, diagnose=damage), recordings=recordings)
    result.others = others
    return result


def verify_store(access: Access, *, recordings: bool = False) -> Verification:
    """Verify the content of an open store, and return the faults."""
    with access.reading() as connection:
        result = verify(connection, access.path)
        if recordings:
            _verify_recordings(connection, access, result)
    return result


def verify(connection: DuckDBPyConnection, path: Path) -> Verification:
    """Verify the content of an open store, and return the faults.

    An unreadable table becomes a fault.

    Raises
    ------
    StoreError
        The table of traces is not readable.
    """

    def attempt(check: Callable[[], Iterable[Fault]]) -> list[Fault]:
        try:
            with translated(path):
                return list(check())
        except StoreError as error:
            return [Fault("", "rows", str(error))]

    result = Verification()
    traces = {trace.trace_id: trace for trace in stored_traces(connection)}
    result.traces = len(traces)
    published = _published(connection)
    result.faults += attempt(partial(_content_faults, connection))
    for trace in traces.values():
        result.faults += attempt(partial(_trace_faults, connection, trace, published, result))
    result.faults += attempt(partial(_shared_faults, connection, published, result))
    names = {trace_id: trace.name for trace_id, trace in traces.items()}
    for rule in _RULES:
        result.faults += attempt(partial(_rule_faults, connection, names, *rule))
    return result


def damage(connection: DuckDBPyConnection, path: Path) -> str:
    """Return the first fault of a store as text; empty without a fault."""
    try:
        faults = verify(connection, path).faults
    except SgstoreError as error:
        return str(error)
    return f"{faults[0].trace} {faults[0].detail}".strip() if faults else ""


def _content_faults(connection: DuckDBPyConnection) -> Iterator[Fault]:
    """Yield faults of a store: unreadable settings, duplicate names or ids, and a wrong table of mask bits."""
    for number, text in connection.execute("SELECT config_id, settings FROM config").fetchall():
        try:
            from_dict(json.loads(text))
        except (SgstoreError, ValueError, TypeError, AttributeError) as error:
            yield Fault("", "references", f"settings {number} cannot be read: {error}")
    for table, column in (
        ("trace", "name"),
        ("trace", "trace_id"),
        *((table, f"{table}_id") for table in SHARED),
    ):
        sql = f"SELECT {column} FROM {table} GROUP BY {column} HAVING count(*) > 1"
        for (value,) in connection.execute(sql).fetchall():
            yield Fault("", "references", f"table {table} has {column} {value!r} more than once")
    bits = connection.execute("SELECT bit, m FROM bits ORDER BY bit, m").fetchall()
    if bits != [(bit, 1 << bit) for bit in range(BUCKET_FRAMES)]:
        yield Fault("", "rows", "table bits does not hold the bits of a mask")


def _verify_recordings(
    connection: DuckDBPyConnection, access: Access, result: Verification
) -> None:
    """Compare the recording files of all traces with the stored hashes, and add the faults."""
    from sgstore.mcap import digest_of

    digests: dict[Path, str | SgstoreError] = {}
    for trace in stored_traces(connection, access.path, access.root):
        if trace.path not in digests:
            try:
                digests[trace.path] = digest_of(trace.path)
            except SgstoreError as error:
                digests[trace.path] = error
        digest = digests[trace.path]
        if isinstance(digest, SgstoreError):
            result.faults.append(Fault(trace.name, "payloads", str(digest)))
        elif digest != trace.digest:
            reason = f"{trace.path}: not the file that was ingested; ingest it anew"
            result.faults.append(Fault(trace.name, "payloads", reason))
    result.recordings = len(digests)


_Published = dict[tuple[str, int], dict[str, Checksum]]


def _published(connection: DuckDBPyConnection) -> _Published:
    """Return the stored checksums: (owner kind such as "trace" or "map", id) → table → checksum."""
    sql = 'SELECT owner, id, "table", rows, checksum FROM manifest'
    published: _Published = {}
    for owner, number, table, rows, value in connection.execute(sql).fetchall():
        published.setdefault((owner, number), {})[table] = Checksum(rows, value)
    return published


def _trace_faults(
    connection: DuckDBPyConnection, trace: StoredTrace, published: _Published, result: Verification
) -> Iterator[Fault]:
    """Yield faults of a trace: tables whose rows differ from the published rows."""
    manifest = published.get(("trace", trace.trace_id), {})
    if not manifest:
        yield Fault(trace.name, "rows", "its record of publication is missing")
    tables = {table for (owner, _), of in published.items() if owner == "trace" for table in of}
    database = _database(connection)
    for table, _ in list(owned(connection, database)):
        if table in tables:
            checksum = checksum_of(connection, database, table, trace.trace_id, trace.frames)
            result.rows += checksum.rows
            if checksum != manifest.get(table, Checksum()):
                yield Fault(trace.name, "rows", _difference(table, checksum, manifest.get(table)))


def _difference(table: str, now: Checksum, then: Checksum | None) -> str:
    rows = then.rows if then else 0
    if now.rows != rows:
        return f"table {table} has {now.rows} rows of it; {rows} were published"
    return f"table {table} holds other values than were published"


_NAME_COLUMNS: Final = {"recording": "uri", "config": "config_id", "map": "name"}


def _shared_faults(
    connection: DuckDBPyConnection, published: _Published, result: Verification
) -> Iterator[Fault]:
    """Yield faults of a store: recordings, settings and road maps that differ from the published ones."""
    database = _database(connection)
    for owner, tables in SHARED.items():
        sql = f"SELECT {owner}_id, {_NAME_COLUMNS[owner]} FROM {owner}"
        for number, name in connection.execute(sql).fetchall():
            manifest = published.get((owner, number), {})
            for table in tables:
                checksum = Checksum()
                select = expressions(connection, table, database)
                sql = f"SELECT {select} FROM {table} WHERE {owner}_id = ?"
                checksum.add(connection.execute(sql, [number]).fetchnumpy())
                result.rows += checksum.rows
                if checksum != manifest.get(table, Checksum()):
                    difference = _difference(table, checksum, manifest.get(table))
                    check = "map" if owner == "map" else "rows"
                    yield Fault("", check, f"{owner} {name!r}: {difference}")


def _rule_faults(
    connection: DuckDBPyConnection, names: dict[int, str], check: str, detail: str, sql: str
) -> Iterator[Fault]:
    """Yield one fault for each trace with rows that break a rule."""
    grouped = f"SELECT trace_id, count(*) FROM ({sql}) AS found(trace_id) GROUP BY ALL ORDER BY ALL"
    for trace_id, count in connection.execute(grouped).fetchall():
        name = "" if trace_id is None else names.get(trace_id, str(trace_id))
        yield Fault(name, check, f"{detail} ({count} times)")


def _database(connection: DuckDBPyConnection) -> str:
    (name,) = connection.execute("SELECT current_database()").fetchall()[0]
    return name
