"""Digests of scene graphs. Frames with equal digests have equal nodes, edges and attributes.

A digest covers the bits of numbers, the characters of texts, and frame numbers in the trace. So the digest of a
part of a trace does not depend on the store, nor on its other content.

Each row is mixed to 64 bits as for a checksum. The sums of the rows in a frame, by table, are mixed to two
words for the frame. The digest of a group is the sum of the words of its frames. It detects accidental changes,
not attacks. A row with a mask of frames counts at the bounds of its runs; running sums then reach all frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.model.frame_ids import FRAME_BITS, seq_of
from sgstore.store._checksums import expressions, row_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Ints
    from sgstore.store._file import StoreFile

    Words = NDArray[np.uint64]


FIRST: Final = 50
"""Number of frame buckets in the first read. Later reads are limited by the number of rows:"""
_ROWS_TOGETHER: Final = 700_000

_WANTED: Final = (
    "(SELECT unnest($buckets) AS bucket, unnest($masks) AS mask,"
    " unnest(range(len($buckets)))::INTEGER AS place) w"
)
_BUCKETS: Final = "bucket BETWEEN $first AND $last"
_FRAMES: Final = "frame_id BETWEEN $first << 6 AND ($last << 6) + 63"
_TRACES: Final = "trace_id BETWEEN $first >> 18 AND $last >> 18"
_MAPS: Final = f"map_id IN (SELECT map_id FROM bucket WHERE {_BUCKETS})"

_LANES: Final = (
    "node_id lane overlap lane_offset heading_error is_primary along is_own",
    _BUCKETS,
)
_GAPS: Final = "src dst gap", _BUCKETS
_COLUMNS: Final = {
    "frame": ("seq ego", _FRAMES),
    "state": (
        "kind node_id is_ego x y z heading pitch roll speed vx vy vz ax ay az yaw_rate length width height"
        " lights light_state steer throttle brake gear hand_brake derived carrier special subkind",
        _FRAMES,
    ),
    "node": ("kind node_id", _BUCKETS),
    "edge": ("src relation dst", _BUCKETS),
    "lane_single": _LANES,
    "lane_repeated": _LANES,
    "gap_single": _GAPS,
    "gap_repeated": _GAPS,
    "attribute": ("node_id relation dst attribute value", _FRAMES),
    "entity": ("kind special subkind x y z heading length width height", _TRACES),
    "map_node": (
        "kind x y z heading length width lane_type road section lane junction turn speed_limit curvature",
        _MAPS,
    ),
    "map_edge": ("src relation dst", _MAPS),
}
"""Table → columns that define a scene graph, and condition for its rows. A change alters all digests."""

_OF_FRAME: Final = f"""
SELECT r.* EXCLUDE (frame_id), w.place, w.mask & (1::BIGINT << (r.frame_id & 63)) AS mask
FROM {{rows}} r JOIN {_WANTED} ON w.bucket = r.frame_id >> 6"""
_OF_BUCKET: Final = f"""
SELECT r.* EXCLUDE (bucket, mask), w.place, w.mask & r.mask AS mask
FROM {{rows}} r JOIN {_WANTED} ON w.bucket = r.bucket WHERE (w.mask & r.mask) <> 0"""

_GRAPHS: Final = {
    "frames": f"""
SELECT r.* EXCLUDE (frame_id), (f.bucket << 6) + f.bit - r.frame_id AS moved,
       t.origin_x, t.origin_y, t.origin_z, w.place, w.mask & (1::BIGINT << (r.frame_id & 63)) AS mask
FROM {{frame}} r JOIN frame f ON f.frame_id = r.frame_id JOIN trace t ON t.trace_id = f.trace_id
     JOIN {_WANTED} ON w.bucket = r.frame_id >> 6
WHERE f.{_FRAMES}""",
    "states": _OF_FRAME.format(
        rows=f"""(SELECT r.* FROM {{state}} r
        JOIN (SELECT trace_id, node_id FROM entity WHERE {_TRACES}) e
             ON e.trace_id = r.frame_id >> 24 AND e.node_id = r.node_id)"""
    ),
    "nodes": f"""
SELECT k.kind, k.node_id, e.rowid AS entity, m.rowid AS map_node, w.place, w.mask & k.mask AS mask
FROM {{node}} k JOIN {_WANTED} ON w.bucket = k.bucket JOIN bucket b ON b.bucket = k.bucket
     LEFT JOIN entity e ON e.trace_id = k.bucket >> 18 AND e.node_id = k.node_id
     LEFT JOIN map_node m ON m.map_id = b.map_id AND m.node_id = k.node_id
WHERE (w.mask & k.mask) <> 0""",
    "edges": _OF_BUCKET.format(rows="{edge}"),
    "map edges": f"""
SELECT e.rowid AS map_edge, w.place, w.mask & s.mask & d.mask AS mask
FROM bucket b JOIN {_WANTED} ON w.bucket = b.bucket JOIN {{node}} s ON s.bucket = b.bucket
     JOIN map_edge e ON e.map_id = b.map_id AND e.src = s.node_id
     JOIN {{node}} d ON d.bucket = b.bucket AND d.node_id = e.dst
WHERE b.{_BUCKETS} AND (w.mask & s.mask & d.mask) <> 0""",
    "lane states": _OF_BUCKET.format(
        rows="(FROM {lane_single} UNION ALL BY NAME FROM {lane_repeated})"
    ),
    "gaps": _OF_BUCKET.format(rows="(FROM {gap_single} UNION ALL BY NAME FROM {gap_repeated})"),
    "attributes": _OF_FRAME.format(rows="{attribute}"),
}
"""Part of a scene graph → SQL of its rows, with a place (index of the bucket) and a mask of frames."""

_SHARED: Final = ("entity", "map_node", "map_edge")
"""Tables whose rows belong to many frames. Each row is hashed only once, and found by its row id."""


def graph_digests(file: StoreFile, frames: Sequence[Ints], *, older: bool = False) -> list[str]:
    """Return one digest for each group of frames. Groups with equal graphs have equal digests.

    Parameters
    ----------
    file : StoreFile
    frames : sequence of int64
        Groups of frame ids, each ascending and not empty. Groups can be in any order; the store is read once,
        in its own order.
    older : bool
        True to return the digests of locks of format 1.
    """
    if older:
        from sgstore.store._older_graph_digests import older_graph_digests

        return older_graph_digests(file, frames)
    if not frames:
        return []
    every = np.concatenate(frames)
    wanted = every if (np.diff(every) > 0).all() else np.unique(every)
    starts = np.flatnonzero(np.diff(wanted >> FRAME_BITS, prepend=-1))
    cuts = np.append(starts, len(wanted))
    words = np.empty((len(wanted), 2), np.uint64)
    first, many = 0, FIRST
    with file.snapshot():
        tables = _tables(file)
        while first < len(starts):
            behind = min(first + many, len(starts))
            here = slice(cuts[first], cuts[behind])
            words[here], rows = _frame_words(file, tables, wanted[here])
            many = int(np.clip(_ROWS_TOGETHER * (behind - first) // max(rows, 1), 1, 10 * many))
            first = behind
    if wanted is not every:
        words = words[np.searchsorted(wanted, every)]
    sizes = np.fromiter(map(len, frames), np.int64, len(frames))
    sums = np.add.reduceat(words, np.cumsum(sizes) - sizes, axis=0)
    text = sums.astype(">u8").tobytes().hex()
    return [text[at : at + 32] for at in range(0, len(text), 32)]


def _tables(file: StoreFile) -> dict[str, str]:
    """Return SQL for the rows of each table, with all values as numbers: table → subquery."""
    found: dict[str, str] = {}
    with file.access.reading() as connection:
        for table, (names, condition) in _COLUMNS.items():
            mask = "1::BIGINT << bit AS mask" if table.endswith("single") else "mask"
            keys = {_FRAMES: ["frame_id"], _BUCKETS: ["bucket", mask]}
            listed = keys.get(condition, ["rowid AS row"])
            values = expressions(connection, table, only=names.split())
            found[table] = f"(SELECT {', '.join(listed)}, {values} FROM {table} WHERE {condition})"
    return found


def _frame_words(file: StoreFile, tables: dict[str, str], frame_id: Ints) -> tuple[Words, int]:
    """Return two 64-bit hashes for each frame, (N, 2), and the number of rows that were read."""
    bucket, bit = frame_id >> FRAME_BITS, frame_id & ((1 << FRAME_BITS) - 1)
    starts = np.flatnonzero(np.diff(bucket, prepend=-1))
    buckets = bucket[starts]
    values: dict[str, Any] = {
        "first": int(buckets[0]),
        "last": int(buckets[-1]),
        "buckets": buckets.tolist(),
        "masks": np.bitwise_or.reduceat(1 << bit, starts).tolist(),
    }
    shared = {table: _hashed(file, tables[table], values) for table in _SHARED}
    at = np.searchsorted(buckets, bucket) << FRAME_BITS | bit
    count = 0
    sums: dict[str, NDArray[Any] | None] = {"": seq_of(frame_id)}
    for name, sql in _GRAPHS.items():
        rows = file.arrays(sql.format(**tables), values, plain=True)
        place, mask = (rows.pop(column).astype(np.int64) for column in ("place", "mask"))
        for table in shared.keys() & rows.keys():
            rows[table] = _of_rows(shared[table], rows[table])
        sums[name] = _by_frame(place, mask, row_words(rows), len(buckets))[at]
        count += len(place)
    first = row_words(sums)
    return np.stack([first, row_words({"first": first, **sums})], axis=1), count


def _hashed(file: StoreFile, table: str, values: dict[str, Any]) -> tuple[int, Words]:
    """Return the hashes of a table's rows as an array by row id, and the row id of the first hash."""
    bounds = {name: values[name] for name in ("first", "last")}
    rows = file.arrays(f"FROM {table}", bounds, plain=True)
    number = rows.pop("row").astype(np.int64)
    first, behind = (int(number.min()), int(number.max()) + 1) if len(number) else (0, 0)
    found = np.zeros(behind - first, np.uint64)
    found[number - first] = row_words(rows)
    return first, found


def _of_rows(hashed: tuple[int, Words], number: NDArray[Any]) -> NDArray[Any]:
    """Return the hash of each given row id. A missing row id gives a missing hash."""
    first, words = hashed
    missing = np.ma.getmaskarray(number)
    found = np.zeros(len(number), np.uint64)
    found[~missing] = words[np.ma.getdata(number)[~missing] - first]
    return np.ma.MaskedArray(found, missing)


def _by_frame(place: Ints, mask: Ints, hashes: Words, count: int) -> Words:
    """Return the sum of row hashes for each frame id, (64 B,). B counts the buckets (60 frames, 64 ids)."""
    sums = np.zeros(count << FRAME_BITS, np.uint64)
    first, behind = place << FRAME_BITS, mask << 1
    _add_at_bits(sums, first, mask & ~behind, hashes)
    _add_at_bits(sums, first, behind & ~mask, -hashes)
    return np.cumsum(sums.reshape(count, -1), axis=1, dtype=np.uint64).ravel()


def _add_at_bits(sums: Words, first: Ints, bits: Ints, words: Words) -> None:
    """Add each row's hash to ``sums`` at the set bits of its mask. Bit 0 is at the index ``first``."""
    while len(bits):
        low = bits & -bits
        np.add.at(sums, first + np.bitwise_count(low - 1), words)
        bits = bits ^ low
        left = bits != 0
        bits, first, words = bits[left], first[left], words[left]
