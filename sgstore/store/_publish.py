"""Addition of complete traces to a store, and removal of traces, each in one transaction.

Each function is part of one transaction on the store.
"""

from __future__ import annotations

from collections import defaultdict
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import sgstore.store._schema as shape
from sgstore.base.quoting import literal, quoted
from sgstore.errors import SgstoreError, StoreError
from sgstore.model.frame_ids import BUCKET_BITS, FRAME_BITS, SEQ_BITS
from sgstore.model.vocabulary import NAMES
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store._checksums import Checksum, columns_of, expressions, row_words
from sgstore.store._columns import (
    MASKS,
    ORDERS,
    REPEATED,
    STATES,
    TEXTS,
    blank,
    missing_of,
    types_of,
)
from sgstore.store._engine_errors import translated
from sgstore.store._locking import spill_folder, transaction
from sgstore.store._packing import MISSING, plain
from sgstore.store._staging import PIECE_ROWS, Staging, scratch
from sgstore.store._table_stream import FILE, TableFile
from sgstore.store._topics import (
    FRAME,
    LISTING,
    copy_topic_tables,
    drop_topic_tables,
    publish_topics,
    topic_tables,
)
from sgstore.store._traces import (
    Identity,
    already_stored,
    id_of,
    place_below,
    stored_name,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.model.world import Ints
    from sgstore.store._locking import Access
    from sgstore.store._packing import Columns
    from sgstore.store._staging import Sealed

    Words = NDArray[np.uint64]


SHARED: Final = {
    "recording": ("recording",),
    "config": ("config",),
    "map": ("map", "map_node", "map_edge", "map_reach", "map_place", "map_course"),
}
"""Tables whose rows several traces can share. Each row is stored once, by its digest."""


class PresentError(StoreError):
    """Error: the store already has this trace with the same settings and map.

    Attributes
    ----------
    name : str
        Stored name of the trace.
    """

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name


def publish_each(
    access: Access, sealed: Sequence[Sealed], *, replace: bool = False
) -> list[str | SgstoreError]:
    """Add complete traces to a store, one transaction per trace. The store is opened once."""
    found: list[str | SgstoreError] = []
    while len(found) < len(sealed):
        try:
            folders = [one.folder for one in sealed if one.topics]
            with scratch(spill_folder()) as connection, access.attached(connection, *folders):
                for one in sealed[len(found) :]:
                    try:
                        with translated(access.path), transaction(connection):
                            name = _publish(connection, access.path, one, replace=replace)
                        found.append(name)
                    except PresentError as error:  # the store itself is intact
                        found.append(error)
        except SgstoreError as error:
            if len(found) < len(sealed):  # the remaining traces use another connection
                found.append(error)
    return found


def _publish(connection: DuckDBPyConnection, path: Path, sealed: Sealed, *, replace: bool) -> str:
    """Add a complete trace to the attached store, and return its name in the store."""
    tables = TableFile(sealed.folder / FILE, path)
    try:
        return _put(connection, path, sealed, tables, replace=replace)
    finally:
        tables.close()


def _put(
    connection: DuckDBPyConnection, path: Path, sealed: Sealed, tables: TableFile, *, replace: bool
) -> str:
    identity = sealed.identity
    taken = connection.execute("SELECT name FROM store.inside.trace").fetchall()
    if not replace and already_stored(connection, identity, catalog="store.inside."):
        name = stored_name(connection, identity, catalog="store.inside.")
        raise PresentError(f"{sealed.path}: came into the store meanwhile, as {name!r}", name or "")
    name = stored_name(connection, identity, catalog="store.inside.")
    known = name is not None
    if name is None:
        name = Identity.free_name(plain(sealed.path.stem), {name for (name,) in taken})
    else:
        _delete(connection, identity.trace_id)
    widen(connection, sealed.words)
    for table, digest in identity.shared.items():
        _publish_shared(connection, path, sealed, tables, table, digest)
    shared = {table for tables in SHARED.values() for table in tables}
    own = [table for table in sealed.checksums if table not in shared]
    for table in own:
        insert(connection, tables, table)
    now = datetime.now(UTC).replace(tzinfo=None)
    row = sealed.trace | {"name": name, "ingested_at": now}
    values = ", ".join(f"${column} AS {column}" for column in row)
    connection.execute(f"INSERT INTO store.inside.trace BY NAME SELECT {values}", row)
    noted = {table: sealed.checksums[table] for table in own}
    own_row = checksums(connection, "store", "trace", "trace", only=identity.trace_id)
    noted["trace"] = own_row[identity.trace_id]
    _note(connection, "trace", identity.trace_id, noted)
    note(connection, identity.trace_id, publish_topics(connection, sealed))
    if known:
        connection.execute(ORPHANS)
    return name


def widen(connection: DuckDBPyConnection, words: Mapping[str, Iterable[str]]) -> None:
    """Add missing values to the enumerations of the attached store."""
    # Every store has the values of ``schema.sql``. Reading other values takes time.
    new = {
        enum: [name for name in names if name not in shape.own_labels(enum)]
        for enum, names in words.items()
    }
    shape.widen(connection, "store", {enum: names for enum, names in new.items() if names})


def _publish_shared(
    connection: DuckDBPyConnection,
    path: Path,
    sealed: Sealed,
    tables: TableFile,
    owner: str,
    digest: str,
) -> None:
    """Insert a recording, settings or a map if the store lacks it. Update the path of a known recording.

    Raises
    ------
    StoreError
        The store has different data with the same id (a hash collision).
    """
    number, place = id_of(digest), f"store.inside.{owner}"
    sql = f"SELECT digest FROM {place} WHERE {owner}_id = ?"
    for (known,) in connection.execute(sql, [number]).fetchall():
        if known != digest:
            raise StoreError(
                f"{sealed.path}: its {_CALLED[owner]} ({digest}) and another in the store ({known}) have the"
                f" same number {number} by chance; put it into a store of its own"
            )
        if owner != "recording":
            return
        connection.execute(f"DELETE FROM {place} WHERE recording_id = ?", [number])
        forgotten = "DELETE FROM store.inside.manifest WHERE owner = 'recording' AND id = ?"
        connection.execute(forgotten, [number])
    given: dict[str, Any] = {}
    if owner == "recording":
        given = {"place": place_below(path, sealed.path) or None}
    elif owner == "map":
        taken = connection.execute("SELECT name FROM store.inside.map").fetchall()
        wanted = plain(sealed.identity.map_name) or "map"
        given = {"name": Identity.free_name(wanted, {name for (name,) in taken})}
    noted = {table: sealed.checksums[table] for table in SHARED[owner] if table in sealed.checksums}
    for table in noted:
        insert(connection, tables, table, given if table == owner else {})
    _note(connection, owner, number, noted)


_CALLED: Final = {"recording": "recording", "config": "set of settings", "map": "road map"}


def insert(
    connection: DuckDBPyConnection,
    tables: TableFile,
    table: str,
    given: Mapping[str, object] | None = None,
) -> None:
    """Insert the rows of a new trace into a store table. The store assigns the values of some columns."""
    given = given or {}
    # The arrays are reused, because a transaction keeps all arrays until its end.
    staged = _buffers(tables, table)
    size = len(next(iter(staged.values())))
    connection.register("staged", staged)
    for count in _filled(tables, table, staged):
        listed = [f"${name} AS {name}" for name in given]
        listed += [
            f'{_value(table, name, values[:count])} AS "{name}"'
            for name, values in staged.items()
            if name not in given
        ]
        limit = "" if count == size else f" LIMIT {count}"
        connection.execute(
            f"INSERT INTO store.inside.{table} BY NAME SELECT {', '.join(listed)} FROM staged{limit}",
            given,
        )


def _buffers(tables: TableFile, table: str) -> Columns:
    """Return uninitialised arrays for a table's columns, as long as the largest group of rows to insert."""
    pieces, types = tables.pieces(table), types_of(table)
    size = min(sum(piece.rows for piece in pieces), PIECE_ROWS)
    return {
        name: np.full(size, "", object) if types[name] in TEXTS else blank(table, name, size)
        for name in dict.fromkeys(name for piece in pieces for name in piece.columns)
    }


def _filled(tables: TableFile, table: str, staged: Columns) -> Iterator[int]:
    """Fill the given arrays with the next rows of a table, until the table ends. Yield each row count."""
    size, count = len(next(iter(staged.values()))), 0
    for piece in tables.pieces(table):
        first = 0
        while first < piece.rows:
            more = min(size - count, piece.rows - first)
            for name, values in staged.items():
                values[count : count + more] = tables.values(piece, name, first, first + more)
            first, count = first + more, count + more
            if count == size:
                yield count
                count = 0
    if count:
        yield count


def _value(table: str, name: str, values: NDArray[Any]) -> str:
    """Return SQL that converts a prepared column: codes to enumeration values, missing values to NULL."""
    if values.dtype.kind == "O":
        return f"nullif(\"{name}\", '')" if values.any() else "NULL"
    enum = shape.enums_of(table).get(name)
    if enum is not None:
        codes = [code for code in np.unique(values).tolist() if code >= 0]
        cases = " ".join(
            f"WHEN {code} THEN {literal(str(NAMES[enum][code]))}::store.main.{enum}"
            for code in codes
        )
        return f'CASE "{name}" {cases} END' if codes else "NULL"
    if missing_of(table, name, values) is not None:
        return f'nullif("{name}", {MISSING})'
    return f'"{name}"'


def _note(
    connection: DuckDBPyConnection, owner: str, number: int, checksums: Mapping[str, Checksum]
) -> None:
    """Store the checksums of inserted rows, for a later verification of the store."""
    values = [
        (owner, number, table, checksum.rows, checksum.value)
        for table, checksum in checksums.items()
        if checksum.rows
    ]
    places = ", ".join(["(?, ?, ?, ?, ?)"] * len(values))
    if values:
        connection.execute(
            f"INSERT INTO store.inside.manifest VALUES {places}", [*chain.from_iterable(values)]
        )


_OWNED: Final = {
    FRAME: f"{quoted(FRAME)} >= $trace_id << 24 AND {quoted(FRAME)} < ($trace_id + 1) << 24",
    "trace_id": "trace_id = $trace_id",
    "bucket": "bucket >= $trace_id << 18 AND bucket < ($trace_id + 1) << 18",
    "frame_id": "frame_id >= $trace_id << 24 AND frame_id < ($trace_id + 1) << 24",
}
"""SQL condition for the rows of a trace, by key column. The first column that a table has is used."""

ORPHANS: Final = "".join(
    f"DELETE FROM store.inside.{table} WHERE {owner}_id NOT IN"
    f" (SELECT {owner}_id FROM store.inside.trace WHERE {owner}_id IS NOT NULL);\n"
    for owner, tables in SHARED.items()
    for table in tables
) + "".join(
    f"DELETE FROM store.inside.manifest WHERE owner = '{owner}' AND id NOT IN"
    f" (SELECT {owner}_id FROM store.inside.{owner});\n"
    for owner in (*SHARED, "trace")
)
"""SQL that deletes shared rows (such as maps and settings) and checksums that no trace uses."""


def owned(connection: DuckDBPyConnection, database: str) -> Iterator[tuple[str, str]]:
    """Yield each table with rows of a trace, and the SQL condition for the rows of ``$trace_id``."""
    rows = connection.execute(
        """
        SELECT table_name, list(column_name) FROM duckdb_columns()
        WHERE database_name = $1 AND schema_name = 'inside' AND list_contains($2, table_name)
        GROUP BY table_name ORDER BY table_name
        """,
        [database, [*shape.expected().tables, *topic_tables(connection, database)]],
    ).fetchall()
    for table, columns in rows:
        found = next((column for column in _OWNED if column in columns), None)
        if found is not None:
            yield table, _OWNED[found]


def remove(connection: DuckDBPyConnection, trace_id: int) -> None:
    """Delete a trace from the attached store, with the settings and map that no other trace uses."""
    _delete(connection, trace_id)
    connection.execute(ORPHANS)
    drop_topic_tables(connection)


def _delete(connection: DuckDBPyConnection, trace_id: int) -> None:
    connection.execute(
        "DELETE FROM store.inside.manifest WHERE owner = 'trace' AND id = ?", [trace_id]
    )
    for table, condition in list(owned(connection, "store")):
        connection.execute(
            f"DELETE FROM store.inside.{table} WHERE {condition}", {"trace_id": trace_id}
        )


SCATTERED: Final = (*STATES, *REPEATED, *REPEATED.values(), "frame", *MASKS, "derived_gap")
"""Large tables, sorted across all traces. A scan for one relation or kind can then skip other rows."""


def copy_sorted(connection: DuckDBPyConnection) -> None:
    """Copy the attached database ``store`` into the empty database ``fresh``, with sorted rows."""
    copy_topic_tables(connection, ["store"], "fresh")
    tables = connection.execute(
        "SELECT table_name FROM duckdb_tables() WHERE database_name = 'fresh'"
    ).fetchall()
    words = {enum: shape.labels_of(connection, "store", enum) for enum in NAMES}
    shape.widen(connection, "fresh", words)
    for (table,) in tables:
        order = f" ORDER BY {ORDERS.get(table, 'ALL')}" if table in SCATTERED else ""
        connection.execute(f"DELETE FROM fresh.inside.{table}")
        connection.execute(
            f"INSERT INTO fresh.inside.{table} BY NAME SELECT * FROM store.inside.{table}{order}"
        )


STEP: Final = 64
"""Number of frame buckets whose rows are in memory at once: 3,840 frames."""


@contextmanager
def writing(access: Access) -> Generator[DuckDBPyConnection]:
    """Context manager of a write transaction. It yields a connection with the store attached as ``store``."""
    with scratch(spill_folder()) as connection, access.writing(connection):
        yield connection


def add(connection: DuckDBPyConnection, path: Path, staging: Staging) -> None:
    """Insert all prepared tables of a trace into the attached store."""
    tables = TableFile(staging.folder / FILE, path)
    try:
        for table in staging.checksums:
            insert(connection, tables, table)
    finally:
        tables.close()


def note(connection: DuckDBPyConnection, trace_id: int, tables: Iterable[str]) -> None:
    """Compute the checksums of changed tables of a published trace anew, and store them."""
    sql = "SELECT frames FROM store.inside.trace WHERE trace_id = ?"
    frames = sum(n for (n,) in connection.execute(sql, [trace_id]).fetchall())
    first = trace_id << BUCKET_BITS
    end = first + -(-frames // BUCKET_FRAMES)
    for table in tables:
        step = STEP // 16 if table.startswith(LISTING) else STEP  # a frame can have many messages
        cuts = range(first, end, step)
        found = checksums(connection, "store", table, "trace", cuts, only=trace_id)
        connection.execute(
            """DELETE FROM store.inside.manifest WHERE owner = 'trace' AND id = ? AND "table" = ?""",
            [trace_id, table],
        )
        _note(connection, "trace", trace_id, {table: found.get(trace_id, Checksum())})


_ALL: Final = (1 << 63) - 1


def checksums(
    connection: DuckDBPyConnection,
    database: str,
    table: str,
    owner: str,
    cuts: Iterable[int] = (),
    *,
    only: int | None = None,
    count: Callable[[int], None] | None = None,
) -> dict[int, Checksum]:
    """Return one checksum of a table's rows per owner: a trace, or a recording, settings or map.

    Parameters
    ----------
    connection : DuckDBPyConnection
    database, table : str
    owner : str
        ``trace``, or a key of :data:`SHARED`.
    cuts : iterable of int
        Buckets at which the rows are cut into ranges that fit into memory.
    only : int, optional
        The only trace to read.
    count : callable, optional
        Called with the number of rows of each range.
    """
    names = {name for name, _ in columns_of(connection, table, database)}
    of_frames = (FRAME_BITS, SEQ_BITS)
    keys = {FRAME: of_frames, "bucket": (0, BUCKET_BITS), "frame_id": of_frames}
    key = next((name for name in keys if name in names), f"{owner}_id")
    low, high = keys.get(key, (-BUCKET_BITS, 0))
    ends = {-_ALL, _ALL} if only is None else {only << high, (only + 1) << high}
    bounds = sorted({cut << low if low >= 0 else cut >> -low for cut in cuts} | ends)
    select = expressions(connection, table, database)
    place, at = f"{quoted(database)}.inside.{table}", quoted(key)
    sql = f"SELECT {select} FROM {place} WHERE {at} >= ? AND {at} < ?"
    found: dict[int, Checksum] = defaultdict(Checksum)
    for bound in pairwise(bounds):
        rows = connection.execute(sql, bound).fetchnumpy()
        _add(found, np.ma.getdata(rows[key]).astype(np.int64) >> high, row_words(rows))
        if count is not None:
            count(len(rows[key]))
    return found


def _add(found: dict[int, Checksum], owner: Ints, hashes: Words) -> None:
    """Add row hashes to the checksums of their owners. This is fast if each owner's rows are adjacent."""
    starts = np.flatnonzero(np.diff(owner, prepend=owner[:1] - 1))
    ids, place = np.unique(owner[starts], return_inverse=True)
    sums, counts = np.zeros(len(ids), np.uint64), np.zeros(len(ids), np.int64)
    if len(starts):
        np.add.at(sums, place, np.add.reduceat(hashes, starts))
        np.add.at(counts, place, np.diff(starts, append=len(owner)))
    for one, value, rows in zip(ids.tolist(), sums.tolist(), counts.tolist(), strict=True):
        found[one].value = (found[one].value + value) & _ALL
        found[one].rows += rows
