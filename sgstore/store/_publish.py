"""Publishing and removing traces, and adding to published ones, in one transaction.

From a sealed segment into the store, and out of it: what one transaction does.
"""

from __future__ import annotations

from contextlib import contextmanager
from datetime import UTC, datetime
from glob import escape
from importlib.metadata import version
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import sgstore.store._schema as shape
from sgstore.errors import StoreError
from sgstore.quoting import literal, quoted
from sgstore.store._locking import spill_folder
from sgstore.store._packing import BUCKET_BITS, FRAME_BITS, LONGEST_STEP, plain
from sgstore.store._staging import Checksum, Staging, columns_of, expressions, scratch
from sgstore.store._traces import already_stored, free_name, id_of, place_below, stored_name
from sgstore.vocabulary import NAMES
from sgstore.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._locking import Access
    from sgstore.store._staging import Sealed
    from sgstore.store._traces import Identity
    from sgstore.world import TraceInfo


SHARED: Final = {
    "recording": ("recording",),
    "config": ("config",),
    "map": ("map", "map_node", "map_edge", "map_reach"),
}
"""Tables of what many traces may have: it comes into a store once, and is known there by its digest."""

_TRACE: Final = f"""
INSERT INTO trace BY NAME
WITH steps AS (SELECT time_ns - lag(time_ns) OVER (ORDER BY frame_id) AS step FROM frame)
SELECT $trace_id AS trace_id, $recording_id AS recording_id, $config_id AS config_id, $map_id AS map_id,
       $flavour AS flavour, nullif($ego, '') AS ego, $since AS since, $until AS until,
       count(*) AS frames,
       arg_min(time_ns, frame_id) AS start_ns, arg_max(time_ns, frame_id) AS end_ns,
       coalesce((SELECT quantile_disc(step, 0.5) FROM steps), 0) AS period_ns,
       $origin_x AS origin_x, $origin_y AS origin_y, $origin_z AS origin_z, $answers AS answers,
       $report AS report, $version AS version
FROM frame;
INSERT INTO bucket BY NAME
WITH steps AS (
  SELECT bucket, 1::BIGINT << bit AS one, time_ns - lag(time_ns) OVER (ORDER BY frame_id) AS step FROM frame)
SELECT bucket, $trace_id AS trace_id, $map_id AS map_id, bit_or(one) AS valid,
       bit_or(CASE WHEN step BETWEEN 0 AND {LONGEST_STEP} THEN one ELSE 0 END) AS joined
FROM steps CROSS JOIN trace GROUP BY bucket;
"""


def fill_trace(
    connection: DuckDBPyConnection, info: TraceInfo, identity: Identity, values: dict[str, Any]
) -> None:
    """Complete the tables of a trace: its own row, and its buckets.

    Parameters
    ----------
    values : dict
        Columns of table ``trace`` that the segment knows.
    """
    about = {"map_id": None} | identity.numbers | values
    about |= {
        "trace_id": identity.trace_id,
        "flavour": info.flavour,
        "ego": identity.ego,
        "since": identity.since,
        "until": identity.until,
        "version": version("sgstore"),
    }
    for statement in _TRACE.split(";\n")[:-1]:
        used = {key: value for key, value in about.items() if f"${key}" in statement}
        connection.execute(statement, used)


def publish_in(access: Access, sealed: Sealed, *, replace: bool = False) -> str:
    """Bring a trace into a store, in one transaction; see :meth:`StoreFile.publish`."""
    with scratch(spill_folder()) as connection, access.writing(connection, sealed.folder):
        return _publish(connection, access.path, sealed, replace=replace)


def _publish(connection: DuckDBPyConnection, path: Path, sealed: Sealed, *, replace: bool) -> str:
    """Copy the files of a trace into the attached store at a path; the name of the trace there."""
    identity = sealed.identity
    taken = connection.execute("SELECT name FROM store.inside.trace").fetchall()
    if not replace and already_stored(connection, identity, catalog="store.inside."):
        name = stored_name(connection, identity, catalog="store.inside.")
        raise StoreError(f"{sealed.path}: came into the store meanwhile, as {name!r}")
    name = stored_name(connection, identity, catalog="store.inside.")
    if name is None:
        name = free_name(plain(sealed.path.stem), {name for (name,) in taken})
    else:
        _delete(connection, identity.trace_id)
    shape.widen(connection, "store", sealed.words)
    for table, digest in identity.shared.items():
        _publish_shared(connection, path, sealed, table, digest)
    now = datetime.now(UTC).replace(tzinfo=None)
    shared = {table for tables in SHARED.values() for table in tables}
    own = [table for table in sealed.files if table not in shared]
    for table in own:
        given = {"name": name, "ingested_at": now} if table == "trace" else {}
        _insert(connection, sealed, table, given)
    _note(connection, sealed, "trace", identity.trace_id, own)
    connection.execute(ORPHANS)  # of a trace that was replaced
    return name


def _publish_shared(
    connection: DuckDBPyConnection, path: Path, sealed: Sealed, owner: str, digest: str
) -> None:
    """Insert a recording, settings or a map, if the store does not have it; of a recording, its place now.

    Raises
    ------
    StoreError
        The store has another one that has its number by chance.
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
    tables = [table for table in SHARED[owner] if table in sealed.files]
    given: dict[str, Any] = {}
    if owner == "recording":
        given = {"place": place_below(path, sealed.path) or None}
    elif owner == "map":
        taken = connection.execute("SELECT name FROM store.inside.map").fetchall()
        wanted = plain(sealed.identity.map_name) or "map"
        given = {"name": free_name(wanted, {name for (name,) in taken})}
    for table in tables:
        _insert(connection, sealed, table, given if table == owner else {})
    _note(connection, sealed, owner, number, tables)


_CALLED: Final = {"recording": "recording", "config": "set of settings", "map": "road map"}


def _insert(
    connection: DuckDBPyConnection, sealed: Sealed, table: str, given: dict[str, Any]
) -> None:
    """Insert the files of a table, with the values that only the store can give."""
    replaced = ", ".join(f"${name} AS {name}" for name in given)
    select = f"SELECT * REPLACE ({replaced})" if replaced else "SELECT *"
    for name in sealed.files[table]:
        # Reading takes a pattern, and a folder may be called anything.
        file = literal(escape(str(sealed.folder / name)))
        connection.execute(
            f"INSERT INTO store.inside.{table} BY NAME {select} FROM read_parquet({file})", given
        )


def _note(
    connection: DuckDBPyConnection, sealed: Sealed, owner: str, number: int, tables: Iterable[str]
) -> None:
    """Take down the checksums of what was inserted."""
    for table in tables:
        checksum = sealed.checksums[table]
        connection.execute(
            "INSERT INTO store.inside.manifest VALUES (?, ?, ?, ?, ?)",
            [owner, number, table, checksum.rows, checksum.value],
        )


_OWNED: Final = {
    "trace_id": "trace_id = $trace_id",
    "bucket": "bucket >= $trace_id << 18 AND bucket < ($trace_id + 1) << 18",
    "frame_id": "frame_id >= $trace_id << 24 AND frame_id < ($trace_id + 1) << 24",
}
"""Column → condition on the rows of a trace; of a table that has several, the first counts."""

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
"""Statements that delete what no trace has any more."""


def owned(connection: DuckDBPyConnection, database: str) -> Iterator[tuple[str, str]]:
    """The tables of a store that hold rows of traces, each with the condition on the rows of ``$trace_id``."""
    rows = connection.execute(
        """
        SELECT table_name, list(column_name) FROM duckdb_columns()
        WHERE database_name = $1 AND schema_name = 'inside' AND list_contains($2, table_name)
        GROUP BY table_name ORDER BY table_name
        """,
        [database, [*shape.expected().tables]],  # others may have tables of their own there
    ).fetchall()
    for table, columns in rows:
        found = next((column for column in _OWNED if column in columns), None)
        if found is not None:
            yield table, _OWNED[found]


def remove(connection: DuckDBPyConnection, trace_id: int) -> None:
    """Delete a trace from the attached store, with the settings and the map that no other trace has."""
    _delete(connection, trace_id)
    connection.execute(ORPHANS)


def _delete(connection: DuckDBPyConnection, trace_id: int) -> None:
    connection.execute(
        "DELETE FROM store.inside.manifest WHERE owner = 'trace' AND id = ?", [trace_id]
    )
    for table, condition in list(owned(connection, "store")):
        connection.execute(
            f"DELETE FROM store.inside.{table} WHERE {condition}", {"trace_id": trace_id}
        )


_SORTED: Final = {
    "state": "SELECT * FROM store.inside.state ORDER BY is_ego DESC, kind, frame_id >> 6, node_id, frame_id",
    "lane_state": "SELECT * FROM store.inside.lane_state ORDER BY kind, frame_id >> 6, node_id, frame_id, lane",
    "lane_gap": "SELECT * FROM store.inside.lane_gap ORDER BY frame_id >> 6, src, dst, frame_id",
    "node": """
SELECT kind, bucket, node_id, bit_or(mask) AS mask FROM store.inside.node GROUP BY ALL ORDER BY ALL""",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_or(mask) AS mask
FROM store.inside.edge GROUP BY ALL ORDER BY ALL""",
    "frame": "SELECT * FROM store.inside.frame ORDER BY frame_id",
    "frame_class": "SELECT * FROM store.inside.frame_class ORDER BY ALL",
    "lane_role": "SELECT * FROM store.inside.lane_role ORDER BY ALL",
    "later_class": "SELECT * FROM store.inside.later_class ORDER BY ALL",
    "derived_node": "SELECT * FROM store.inside.derived_node ORDER BY ALL",
    "derived_edge": "SELECT * FROM store.inside.derived_edge ORDER BY ALL",
    "derived_gap": "SELECT * FROM store.inside.derived_gap ORDER BY ALL",
}
"""The large tables, sorted over all traces: then a scan for one relation or kind skips all else."""


def copy_sorted(connection: DuckDBPyConnection) -> None:
    """Fill the empty store that is attached as ``fresh`` from the one attached as ``store``."""
    tables = connection.execute(
        "SELECT table_name FROM duckdb_tables() WHERE database_name = 'fresh'"
    ).fetchall()
    words = {enum: shape.labels_of(connection, "store", enum) for enum in NAMES}
    shape.widen(connection, "fresh", words)
    for (table,) in tables:
        select = _SORTED.get(table, f"SELECT * FROM store.inside.{table}")
        connection.execute(f"DELETE FROM fresh.inside.{table}")
        connection.execute(f"INSERT INTO fresh.inside.{table} BY NAME {select}")


# What is added to traces that are in a store already: built aside, brought in by one transaction, noted ----

STEP: Final = 64
"""Buckets whose rows are in memory at once: 3,840 frames."""


@contextmanager
def writing(access: Access, *folders: Path) -> Generator[DuckDBPyConnection]:
    """One transaction on a store, attached as ``store``; of files it sees those in the folders."""
    with scratch(spill_folder()) as connection, access.writing(connection, *folders):
        yield connection


def add_files(
    connection: DuckDBPyConnection, staging: Staging, files: dict[str, list[str]]
) -> None:
    """Insert the files that a staging sealed."""
    for table, names in files.items():
        for name in names:
            file = literal(escape(str(staging.folder / name)))
            connection.execute(
                f"INSERT INTO store.inside.{table} BY NAME SELECT * FROM read_parquet({file})"
            )


def note(connection: DuckDBPyConnection, trace_id: int, tables: Iterable[str]) -> None:
    """Take down what a trace has now in tables that change after it was published."""
    sql = "SELECT frames FROM store.inside.trace WHERE trace_id = ?"
    frames = sum(n for (n,) in connection.execute(sql, [trace_id]).fetchall())
    for table in tables:
        checksum = checksum_of(connection, "store", table, trace_id, frames)
        connection.execute(
            """DELETE FROM store.inside.manifest WHERE owner = 'trace' AND id = ? AND "table" = ?""",
            [trace_id, table],
        )
        if checksum.rows:
            connection.execute(
                "INSERT INTO store.inside.manifest VALUES ('trace', ?, ?, ?, ?)",
                [trace_id, table, checksum.rows, checksum.value],
            )


def checksum_of(
    connection: DuckDBPyConnection, database: str, table: str, trace_id: int, frames: int
) -> Checksum:
    """Checksum of the rows of a trace in a table, of which few are in memory at once."""
    checksum = Checksum()
    select = expressions(connection, table, database)
    for condition, values in _ranges(connection, database, table, trace_id, frames):
        rows = connection.execute(
            f"SELECT {select} FROM {quoted(database)}.inside.{table} WHERE {condition}", values
        )
        checksum.add(rows.fetchnumpy())
    return checksum


def _ranges(
    connection: DuckDBPyConnection, database: str, table: str, trace_id: int, frames: int
) -> Iterator[tuple[str, list[int]]]:
    """Conditions on the rows of a trace, each of so many as fit into memory."""
    names = {name for name, _ in columns_of(connection, table, database)}
    bits = {"bucket": 0, "frame_id": FRAME_BITS}
    column = next((name for name in bits if name in names), None)
    if column is None:
        yield "trace_id = ?", [trace_id]
        return
    first = trace_id << BUCKET_BITS
    behind = first + -(-frames // BUCKET_FRAMES)
    # In the last range, behind the last frame, there should be nothing.
    for low, high in pairwise([*range(first, behind, STEP), behind, (trace_id + 1) << BUCKET_BITS]):
        yield f"{column} >= ? AND {column} < ?", [low << bits[column], high << bits[column]]
