"""From a segment into the store: what one transaction does."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import StoreError
from sgstore.store.packing import plain
from sgstore.store.traces import already_stored, free_name

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sgstore.roads import RoadMap
    from sgstore.store.staging import Staging
    from sgstore.store.traces import Identity
    from sgstore.world import TraceInfo

_PLAIN: Final = """
INSERT INTO store.channel BY NAME SELECT * REPLACE ($trace_id AS trace_id) FROM channel;
INSERT INTO store.context BY NAME SELECT * REPLACE ($trace_id AS trace_id) FROM context ORDER BY log_time_ns;
INSERT INTO store.entity BY NAME SELECT * REPLACE ($trace_id AS trace_id) FROM entity ORDER BY node_id;
INSERT INTO store.frame BY NAME
SELECT * REPLACE ($trace_id AS trace_id, $map_id AS map_id) FROM frame ORDER BY frame_id;
INSERT INTO store.bucket
SELECT bucket, $trace_id, $map_id, bit_or(1::BIGINT << bit) FROM frame GROUP BY bucket ORDER BY bucket;
INSERT INTO store.payload SELECT * FROM payload ORDER BY channel_id, bucket, bit;
"""

_TRACE: Final = """
INSERT INTO store.trace BY NAME
WITH steps AS (SELECT time_ns - lag(time_ns) OVER (ORDER BY frame_id) AS step FROM frame)
SELECT $trace_id AS trace_id, $name AS name, $uri AS uri, $size AS size, $mtime_ns AS mtime_ns,
       $digest AS digest, $flavour AS flavour, nullif($ego, '') AS ego, $map_id AS map_id,
       $config_id AS config_id, count(*) AS frames,
       arg_min(time_ns, frame_id) AS start_ns, arg_max(time_ns, frame_id) AS end_ns,
       coalesce((SELECT quantile_disc(step, 0.5) FROM steps), 0) AS period_ns,
       $origin_x AS origin_x, $origin_y AS origin_y, $origin_z AS origin_z, $answers AS answers,
       $report AS report, $ingested_at AS ingested_at, $version AS version
FROM frame
"""


def publish(
    staging: Staging,
    info: TraceInfo,
    identity: Identity,
    values: dict[str, Any],
    road_map: RoadMap | None,
) -> str:
    """Copy the tables of a trace into the store that is attached to their connection.

    Parameters
    ----------
    values : dict
        Columns of table ``trace`` that the segment knows.

    Returns
    -------
    str
        The name of the trace.

    Raises
    ------
    StoreError
        The trace is in the store already.
    """
    connection = staging.connection
    name = already_stored(connection, identity, catalog="store.")
    if name is not None:
        raise StoreError(f"{info.path}: came into the store meanwhile, as {name!r}")
    names = connection.execute("SELECT name FROM store.trace").fetchall()
    name = free_name(plain(info.path.stem), {taken for (taken,) in names})
    keys = {
        "trace_id": identity.trace_id,
        "map_id": _map_id(connection, road_map),
    }
    for statement in _PLAIN.split(";\n")[:-1]:
        used = {key: value for key, value in keys.items() if f"${key}" in statement}
        connection.execute(statement, used)
    for table in ("state", "lane_state", "node", "edge"):
        for part in staging.parts(table):
            connection.execute(f"INSERT INTO store.{table} BY NAME {part}")
    about = {
        "name": name,
        "uri": plain(str(info.path.resolve())),
        "size": info.size,
        "mtime_ns": info.mtime_ns,
        "digest": info.digest,
        "flavour": info.flavour,
        "ego": identity.ego,
        "config_id": _config_id(connection, identity),
        "ingested_at": datetime.now(UTC).replace(tzinfo=None),
        "version": version("sgstore"),
    }
    connection.execute(_TRACE, keys | about | values)
    return name


def _config_id(connection: DuckDBPyConnection, identity: Identity) -> int:
    """The number of the settings in the store, where they are now if they were not before."""
    rows = connection.execute("SELECT config_id, digest FROM store.config").fetchall()
    for number, digest in rows:
        if digest == identity.settings_digest:
            return number
    new = max((number for number, _ in rows), default=0) + 1
    connection.execute(
        "INSERT INTO store.config VALUES (?, ?, ?)",
        [new, identity.settings_digest, identity.settings],
    )
    return new


def _map_id(connection: DuckDBPyConnection, road_map: RoadMap | None) -> int | None:
    """The number of the map in the store, where it is now with its nodes and edges if it was not before."""
    if road_map is None:
        return None
    rows = connection.execute("SELECT map_id, digest, name FROM store.map").fetchall()
    for number, digest, _ in rows:
        if digest == road_map.digest:
            return number
    new = max((number for number, _, _ in rows), default=0) + 1
    name = free_name(plain(road_map.name) or "map", {name for _, _, name in rows})
    connection.execute(
        "INSERT INTO store.map VALUES (?, ?, ?, ?)",
        [new, road_map.digest, name, plain(road_map.text)],
    )
    for table, order in (("map_node", "node_id DESC"), ("map_edge", "ALL")):
        connection.execute(
            f"INSERT INTO store.{table} BY NAME SELECT * REPLACE (? AS map_id) FROM {table} ORDER BY {order}",
            [new],
        )
    return new


_REMOVED: Final = {
    "trace_id = $trace_id": ("trace", "channel", "context", "entity", "bucket", "frame", "payload"),
    "bucket >= $trace_id << 18 AND bucket < ($trace_id + 1) << 18": ("node", "edge"),
    "frame_id >= $trace_id << 24 AND frame_id < ($trace_id + 1) << 24": ("state", "lane_state"),
}
"""Conditions on the rows of a trace; ranges where the column that they are about is all that a scan needs."""

_ORPHANS: Final = """
DELETE FROM store.config WHERE config_id NOT IN (SELECT config_id FROM store.trace);
DELETE FROM store.map WHERE map_id NOT IN (SELECT map_id FROM store.trace WHERE map_id IS NOT NULL);
DELETE FROM store.map_node WHERE map_id NOT IN (SELECT map_id FROM store.map);
DELETE FROM store.map_edge WHERE map_id NOT IN (SELECT map_id FROM store.map);
"""


def remove(connection: DuckDBPyConnection, trace_id: int) -> None:
    """Delete a trace from the attached store, with the settings and the map that no other trace has."""
    for condition, tables in _REMOVED.items():
        for table in tables:
            connection.execute(
                f"DELETE FROM store.{table} WHERE {condition}", {"trace_id": trace_id}
            )
    connection.execute(_ORPHANS)


_SORTED: Final = {
    "state": "SELECT * FROM store.state ORDER BY kind, frame_id >> 6, node_id, frame_id",
    "lane_state": "SELECT * FROM store.lane_state ORDER BY kind, frame_id >> 6, node_id, frame_id, lane",
    "node": "SELECT kind, bucket, node_id, bit_or(mask) AS mask FROM store.node GROUP BY ALL ORDER BY ALL",
    "edge": """
SELECT relation, src_is_ego, dst_is_ego, src_kind, dst_kind, bucket, src, dst, bit_or(mask) AS mask
FROM store.edge GROUP BY ALL ORDER BY ALL""",
    "frame": "SELECT * FROM store.frame ORDER BY frame_id",
}
"""The large tables, sorted over all traces: then a scan for one relation or kind skips all else."""


def copy_sorted(connection: DuckDBPyConnection) -> None:
    """Fill the empty store that is attached as ``fresh`` from the one attached as ``store``."""
    tables = connection.execute(
        "SELECT table_name FROM duckdb_tables() WHERE database_name = 'fresh'"
    ).fetchall()
    for (table,) in tables:
        select = _SORTED.get(table, f"SELECT * FROM store.{table}")
        connection.execute(f"DELETE FROM fresh.{table}")
        connection.execute(f"INSERT INTO fresh.{table} BY NAME {select}")
