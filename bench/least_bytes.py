"""Floors of tables: the bytes that their columns hold, told by a packer that has nothing to do with the store.

The rows of some traces are taken trace by trace, as they lie in the store, so that no replica makes another one
small. Each column is packed by itself, by the best of several ways: as it is, as differences of the row before,
each of these with the first bytes of all values first, then the second ones, …; then zstd at a high level. No
scan could be asked to undo that. What is told by other columns of the same row counts nothing, once that was
seen in all these rows.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import zstandard

from bench.measure import Measure

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

LEVEL = 15
OWNERS = {
    "frame_id": "frame_id >> 24",
    "bucket": "bucket >> 18",
    "trace_id": "trace_id",
}
"""Columns that tell the trace of a row."""
SPEED = "sqrt(vx::DOUBLE * vx + vy::DOUBLE * vy + coalesce(vz, 0)::DOUBLE * coalesce(vz, 0))::FLOAT"
TOLD = {
    "state": {"speed": SPEED},
    "frame": {
        "bucket": "frame_id >> 6",
        "bit": "frame_id & 63",
        "trace_id": "frame_id >> 24",
        "seq": "((frame_id >> 6) & 262143) * 60 + (frame_id & 63)",
    },
    "payload": {"trace_id": "bucket >> 18"},
    "bucket": {"trace_id": "bucket >> 18"},
    "imported": {"trace_id": "bucket >> 18"},
    "event": {"trace_id": "frame_id >> 24"},
}
"""What other columns of a row tell: no more bytes are needed for it."""
OF_MAPS = re.compile("map|light_lane")
"""Tables that grow with the number of maps, not of frames."""
BOUND = "what bounds the file: exact values in blocks of 2,048 that a scan reads without the rows before"
"""Said beside the bytes of FLOAT columns."""
_UUIDS = re.compile(r"([0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\n)+")


def traces(connection: duckdb.DuckDBPyConnection) -> list[int]:
    """One trace of each recording and ego: replicas differ in the number at the end of their names."""
    rows = connection.execute(
        "SELECT arg_min(trace_id, (ingested_at, trace_id)) FROM trace"
        " GROUP BY regexp_replace(name, '-[0-9]+$', '') ORDER BY 1"
    )
    return [number for (number,) in rows.fetchall()]


def floors(store: Path) -> Iterator[tuple[str, float, dict[str, float]]]:
    """Bytes a frame of each table that holds rows of traces, and of each of its columns."""
    with duckdb.connect(str(store), read_only=True) as connection:
        connection.execute("USE inside")
        chosen = traces(connection)
        sql = "SELECT sum(frames) FROM trace WHERE list_contains($1, trace_id)"
        ((frames,),) = connection.execute(sql, [chosen]).fetchall()
        named = connection.execute(
            "SELECT table_name, list(column_name), list(data_type) FROM duckdb_columns()"
            " WHERE schema_name = 'inside' AND table_name IN (SELECT table_name FROM duckdb_tables())"
            " GROUP BY table_name ORDER BY table_name"
        ).fetchall()
        for table, names, types in named:
            owner = next((OWNERS[name] for name in OWNERS if name in names), None)
            if owner is None:
                continue
            kinds = dict(zip(names, types, strict=True))
            for name in _told(connection, table, owner, chosen):
                del kinds[name]
            found = dict.fromkeys(kinds, 0.0)
            for trace in chosen:
                columns = _columns(connection, table, kinds, f"{owner} = {trace}")
                for name, values in columns.items():
                    found[name] += packed(values) / frames
            yield table, sum(found.values()), found


def _told(
    connection: duckdb.DuckDBPyConnection, table: str, owner: str, chosen: list[int]
) -> list[str]:
    """Columns that are told by others in all rows of these traces."""
    listed = ", ".join(map(str, chosen))
    found: list[str] = []
    for name, text in TOLD.get(table, {}).items():
        sql = f'SELECT count(*) FROM {table} WHERE {owner} IN ({listed}) AND "{name}" IS DISTINCT FROM {text}'
        ((others,),) = connection.execute(sql).fetchall()
        if not others:
            found.append(name)
    return found


def _columns(
    connection: duckdb.DuckDBPyConnection, table: str, kinds: dict[str, str], which: str
) -> dict[str, NDArray[Any]]:
    """Columns of some rows: numbers as they are, all else as texts; NULL as a value of its own."""
    listed = ", ".join(_plain(name, kind) for name, kind in kinds.items())
    found = connection.execute(f"SELECT {listed} FROM {table} WHERE {which}").fetchnumpy()
    return {name: np.ma.filled(values, _missing(values)) for name, values in found.items()}


def _plain(name: str, kind: str) -> str:
    if kind.startswith("ENUM"):
        return f'enum_code("{name}") AS "{name}"'
    number = kind in {"BIGINT", "INTEGER", "SMALLINT", "TINYINT", "BOOLEAN", "FLOAT", "DOUBLE"}
    return f'"{name}"' if number else f'"{name}"::VARCHAR AS "{name}"'


def _missing(values: NDArray[Any]) -> Any:
    if values.dtype.kind == "O":
        return ""
    return np.nan if values.dtype.kind == "f" else 0 if values.dtype.kind in "bu" else -1


def packed(values: NDArray[Any]) -> int:
    """Least bytes of a column."""
    if not len(values):
        return 0
    if values.dtype.kind == "O":
        whole = _UUIDS.fullmatch("".join(f"{value}\n" for value in values))
        digits = whole and whole[0].replace("-", "").replace("\n", "")
        return _squeezed(bytes.fromhex(digits) if digits else "\n".join(values).encode())
    values = values.view(np.uint8) if values.dtype.kind == "b" else values
    bits = values.view(f"u{values.itemsize}")
    if (bits == bits[0]).all():
        return 1
    steps, changes = np.diff(bits, prepend=bits[:1] * 0), bits.copy()
    changes[1:] ^= bits[:-1]
    ways = (bits, steps, changes)
    told = [way.tobytes() for way in ways]
    if bits.itemsize > 1:
        told += [way.view(np.uint8).reshape(len(way), -1).T.tobytes() for way in ways]
    return min(map(_squeezed, told))


def _squeezed(data: bytes) -> int:
    return len(zstandard.ZstdCompressor(level=LEVEL).compress(data))


def sizes(store: Path, folder: Path) -> Iterator[tuple[str, int, int]]:
    """Bytes and rows of each table, in a file of its own, of blocks as large, less one that holds a number."""

    def alone(source: str | None) -> tuple[int, int]:
        path = folder / f"alone-{source}.db"
        with duckdb.connect() as connection:
            connection.execute(f"ATTACH '{store}' AS store (READ_ONLY)")
            (block,) = connection.execute(
                "SELECT block_size FROM pragma_database_size() WHERE database_name = 'store'"
            ).fetchone()
            connection.execute(
                f"ATTACH '{path}' AS alone (STORAGE_VERSION 'v1.5.0', BLOCK_SIZE {block})"
            )
            told = "SELECT 1" if source is None else f"FROM store.inside.{source}"
            connection.execute(f"CREATE TABLE alone.t AS {told}")
            (rows,) = connection.execute("SELECT count(*) FROM alone.t").fetchone()
            connection.execute("CHECKPOINT alone")
            connection.execute("DETACH alone")
        size = path.stat().st_size
        path.unlink()
        return size, rows

    with duckdb.connect(str(store), read_only=True) as connection:
        names = connection.execute(
            "SELECT table_name FROM duckdb_tables() WHERE schema_name = 'inside' ORDER BY table_name"
        ).fetchall()
    empty, _ = alone(None)
    for (name,) in names:
        size, rows = alone(name)
        if rows:
            yield name, size - empty, rows


def of_fractions(store: Path) -> int:
    """Bytes of the segments that hold FLOAT columns, in tables that grow with frames."""
    sql = """
        SELECT coalesce(sum(bytes) FILTER (segment_type = 'FLOAT' AND counts), 0) FROM (
          SELECT segment_type, counts, lead(block_offset, 1, $1)
                 OVER (PARTITION BY block_id ORDER BY block_offset) - block_offset AS bytes
          FROM ({0}) WHERE block_id >= 0)
    """
    with duckdb.connect(str(store), read_only=True) as connection:
        (block,) = connection.execute("SELECT block_size FROM pragma_database_size()").fetchone()
        named = connection.execute(
            "SELECT table_name FROM duckdb_tables() WHERE schema_name = 'inside'"
        ).fetchall()
        parts = [
            f"SELECT segment_type, {not OF_MAPS.match(name)} AS counts, block_id, block_offset"
            f" FROM pragma_storage_info('inside.{name}')"
            for (name,) in named
        ]
        ((found,),) = connection.execute(sql.format(" UNION ALL ".join(parts)), [block]).fetchall()
    return int(found)


def bytes_of(path: Path, frames: int, folder: Path, aim: int) -> Iterator[Measure]:
    """Bytes a frame, whole and by table, beside the least that tables and their largest columns take."""
    table = list(sizes(path, folder))
    floor = {name: (least, columns) for name, least, columns in floors(path)}
    whole = path.stat().st_size
    maps = sum(size for label, size, _ in table if OF_MAPS.match(label))
    yield Measure("whole file without maps", (whole - maps) / frames, "B/frame", f"aim {aim}")
    for label, size, rows in sorted(table, key=lambda line: -line[1]):
        if size >= frames / 10:
            note = f"{rows / frames:.2f} rows a frame"
            least, columns = floor.get(label, (0.0, {}))
            if columns:
                named = sorted(columns, key=lambda name: -columns[name])
                large = [f"{name} {columns[name]:.0f}" for name in named if columns[name] >= 1]
                note += f"; floor {least:.1f}" + (f": {', '.join(large)}" if large else "")
            yield Measure(f"  {label}", size / frames, "B/frame", note)
    rest = whole - sum(size for _, size, _ in table)
    yield Measure("  what else is in the file", rest / frames, "B/frame")
    lowest = sum(least for least, _ in floor.values())
    yield Measure("floor of all tables but maps", lowest, "B/frame", "columns packed one by one")
    yield Measure("FLOAT columns as stored", of_fractions(path) / frames, "B/frame", BOUND)
    yield Measure("tables of maps", maps / 2**20, "MiB")
