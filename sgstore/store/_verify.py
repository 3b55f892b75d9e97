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
from sgstore.store._engine_errors import translated
from sgstore.store._locking import Access
from sgstore.store._publish import SHARED, checksum_of, owned
from sgstore.store._schema import schema_faults
from sgstore.store._traces import stored_traces
from sgstore.store._verify_rules import RULES

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
