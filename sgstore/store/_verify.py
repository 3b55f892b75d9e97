"""Verification of a store: row checksums, bit masks of frames, and references between rows.

Reading a table also verifies DuckDB's block checksums.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.base.display import excerpt, number_of
from sgstore.errors import SgstoreError, StoreError
from sgstore.model.config import from_dict
from sgstore.model.frame_ids import BUCKET_BITS
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store._checksums import Checksum
from sgstore.store._engine_errors import translated
from sgstore.store._locking import Access, default_memory
from sgstore.store._publish import SHARED, checksums, owned
from sgstore.store._schema import schema_faults
from sgstore.store._traces import stored_traces
from sgstore.store._verify_rules import RULES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from duckdb import DuckDBPyConnection

    from sgstore.store._traces import StoredTrace


_MEMORY: Final = 1 << 29
"""Memory limit of the database; bytes. A larger cache has no use, because the file is read only once."""


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

    @property
    def remedy(self) -> str:
        """Command that repairs the store. A changed recording needs its old file, or a new ingest."""
        if self.check == "payloads":
            return "put the old recording back, or run 'sgstore ingest --force'"
        return "run 'sgstore rebuild'"


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


def verify_file(
    path: str | Path,
    *,
    recordings: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Verify the content of a store file. The schema may be too altered for normal opening.

    If the schema was altered, only that fault is returned, and the tables are not read.

    Parameters
    ----------
    path : str or Path
    recordings : bool
        See :meth:`StoreFile.verify`.
    progress : callable, optional
        Called with the number of rows that were read, and the number of all rows.

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
    result = verify_store(
        Access(place, diagnose=damage, memory=min(default_memory(), _MEMORY)),
        recordings=recordings,
        progress=progress,
    )
    result.others = others
    return result


def verify_store(
    access: Access,
    *,
    recordings: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Verify the content of an open store, and return the faults."""
    with access.reading() as connection:
        result = verify(connection, access.path, progress)
        if recordings:
            _verify_recordings(connection, access, result)
    return result


def verify(
    connection: DuckDBPyConnection,
    path: Path,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Verify the content of an open store, and return the faults.

    An unreadable table becomes a fault. ``progress`` receives the number of rows that were read, and of all.

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
    total = sum(one.rows for tables in published.values() for one in tables.values())

    def count(rows: int) -> None:
        result.rows += rows
        if progress is not None:
            progress(result.rows, max(result.rows, total))

    faults = [
        Fault(trace.name, "rows", "its record of publication is missing")
        for trace_id, trace in traces.items()
        if not published.get(("trace", trace_id))
    ]
    read = partial(checksums, connection, _database(connection), count=count)
    for table in _trace_tables(connection, published):
        found = attempt(partial(_trace_faults, read, table, traces, published))
        if [fault.trace for fault in found] == [""]:  # unreadable: find out which traces
            read_one = partial(read, table, "trace", count=None)
            each = (
                (trace.name, attempt(partial(_read_faults, read_one, trace_id)))
                for trace_id, trace in traces.items()
            )
            found = [replace(one, trace=name) for name, its in each for one in its] or found
        faults += found
    places = {trace.name: place for place, trace in enumerate(traces.values())}
    result.faults += sorted(faults, key=lambda fault: places.get(fault.trace, -1))
    for owner in SHARED:
        result.faults += attempt(partial(_shared_faults, connection, read, owner, published))
    names = {trace_id: trace.name for trace_id, trace in traces.items()}
    for rule in RULES:
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
    """Yield faults of a store: unreadable settings, duplicate names or ids, wrong rows in ``bits``."""
    for number, text in connection.execute("SELECT config_id, settings FROM config").fetchall():
        try:
            from_dict(json.loads(text))
        except (SgstoreError, ValueError, TypeError, AttributeError) as error:
            yield Fault("", "references", f"settings {number} cannot be read: {excerpt(error)}")
    for table, column in (
        ("trace", "name"),
        ("trace", "trace_id"),
        *((table, f"{table}_id") for table in SHARED),
    ):
        sql = f"SELECT {column} FROM {table} GROUP BY {column} HAVING count(*) > 1"
        for (value,) in connection.execute(sql).fetchall():
            yield Fault(
                "", "references", f"table {table} has {column} {excerpt(value)!r} more than once"
            )
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


def _trace_tables(connection: DuckDBPyConnection, published: _Published) -> list[str]:
    tables = {table for (owner, _), of in published.items() if owner == "trace" for table in of}
    return [table for table, _ in owned(connection, _database(connection)) if table in tables]


_ROWS_TOGETHER: Final = 500_000


def _cuts(traces: Mapping[int, StoredTrace], published: _Published, table: str) -> Iterator[int]:
    """Yield bucket numbers that divide a table into ranges that fit into memory. A bucket has 60 frames."""
    together = 0
    for trace_id, trace in sorted(traces.items()):
        rows = published.get(("trace", trace_id), {}).get(table, Checksum()).rows
        if together + rows > _ROWS_TOGETHER:
            buckets = -(-trace.frames // BUCKET_FRAMES)
            step = max(buckets * _ROWS_TOGETHER // rows, 1)
            yield from ((trace_id << BUCKET_BITS) + at for at in range(0, buckets, step))
            together = 0
        together += rows


def _trace_faults(
    read: Callable[..., dict[int, Checksum]],
    table: str,
    traces: Mapping[int, StoredTrace],
    published: _Published,
) -> Iterator[Fault]:
    """For each trace, compare a table's rows with the published rows. Yield a fault for each difference."""
    found = read(table, "trace", _cuts(traces, published, table))
    for trace_id, trace in traces.items():
        then = published.get(("trace", trace_id), {}).get(table)
        now = found.get(trace_id, Checksum())
        if now != (then or Checksum()):
            yield Fault(trace.name, "rows", _difference(table, now, then))


def _read_faults(read: Callable[..., object], trace_id: int) -> tuple[()]:
    """Read the rows of one trace in a table. If the database can read them, return no faults."""
    read(only=trace_id)
    return ()


def _difference(table: str, now: Checksum, then: Checksum | None) -> str:
    rows = then.rows if then else 0
    if now.rows != rows:
        return f"table {table} has {number_of(now.rows, 'row')} of it; published: {rows}"
    return f"table {table} holds other values than were published"


_NAME_COLUMNS: Final = {"recording": "uri", "config": "config_id", "map": "name"}


def _shared_faults(
    connection: DuckDBPyConnection,
    read: Callable[..., dict[int, Checksum]],
    owner: str,
    published: _Published,
) -> Iterator[Fault]:
    """Yield faults of recordings, settings or road maps that differ from the published ones."""
    sql = f"SELECT {owner}_id, {_NAME_COLUMNS[owner]} FROM {owner}"
    names = connection.execute(sql).fetchall()
    for table in SHARED[owner]:
        found = read(table, owner)
        for number, name in names:
            then = published.get((owner, number), {}).get(table)
            now = found.get(number, Checksum())
            if now != (then or Checksum()):
                check = "map" if owner == "map" else "rows"
                yield Fault(
                    "", check, f"{owner} {excerpt(name)!r}: {_difference(table, now, then)}"
                )


def _rule_faults(
    connection: DuckDBPyConnection, names: dict[int, str], check: str, detail: str, sql: str
) -> Iterator[Fault]:
    """Yield one fault for each trace with rows that break a rule."""
    grouped = f"SELECT trace_id, count(*) FROM ({sql}) AS found(trace_id) GROUP BY ALL ORDER BY ALL"
    for trace_id, count in connection.execute(grouped).fetchall():
        name = "" if trace_id is None else names.get(trace_id, str(trace_id))
        yield Fault(name, check, f"{detail} ({number_of(count, 'time')})")


def _database(connection: DuckDBPyConnection) -> str:
    (name,) = connection.execute("SELECT current_database()").fetchall()[0]
    return name
