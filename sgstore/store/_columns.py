"""Columns of the store's tables as arrays, with their types and sort order."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.tables import ascending
from sgstore.errors import StoreError
from sgstore.model.frame_ids import FRAME_BITS
from sgstore.store._packing import MISSING, packed
from sgstore.store._schema import expected

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.store._packing import Columns

    Words = NDArray[np.uint64]


MESSAGES: Final = {
    "channel": "INTEGER",
    **dict.fromkeys(("log_time_ns", "chunk_offset", "offset", "length"), "BIGINT"),
}
"""Columns of recorded messages. They are prepared like a table until the join to frames."""

TEXTS: Final = {"VARCHAR", "VARCHAR[]", "JSON", "TIMESTAMP", "UUID"}

_WHOLE: Final = {
    "BIGINT": np.dtype(np.int64),
    **dict.fromkeys(("INTEGER", "SMALLINT", "TINYINT", "BOOLEAN"), np.dtype(np.int32)),
}
_FLOATS: Final = {"FLOAT": np.dtype(np.float32), "DOUBLE": np.dtype(np.float64)}


@cache
def types_of(table: str) -> Mapping[str, str]:
    """Return the column types of a table in ``schema.sql``: column → type. Enumerations have type ``ENUM``."""
    if table == "message":
        return MESSAGES
    found: dict[str, str] = {}
    depth, name = 0, ""
    for word in expected().tables[table][4:-1]:
        depth += (word == "(") - (word == ")")
        if word == "," and not depth:
            name = ""
        elif not name:
            name = word
        elif name not in found:
            found[name] = word
        elif word == "[":
            found[name] += "[]"
    return found


def kept(table: str, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Convert a numeric column to the array type of its table, with NaN or :data:`MISSING` for missing values.

    Raises
    ------
    StoreError
        A value is too large for the column.
    """
    kind = types_of(table)[name]
    if kind in _FLOATS:
        plain = values.astype(_FLOATS[kind], copy=False)
        odd = np.isinf(plain)
        return np.where(odd, plain.dtype.type(np.nan), plain) if odd.any() else plain
    wanted = _WHOLE.get(kind, np.dtype(np.int32))
    if values.dtype.kind == "f":
        known = np.isfinite(values)
        values = np.where(known, np.rint(np.where(known, values, 0)), MISSING).astype(np.int64)
    if values.dtype.itemsize > wanted.itemsize:
        bound = np.iinfo(wanted)
        if len(values) and not bound.min <= values.min() <= values.max() <= bound.max:
            raise StoreError(f"a number is too large for {table}.{name}")
        return values.astype(wanted)
    return values


def blank(table: str, name: str, count: int) -> NDArray[Any]:
    """Return an array with only missing values for a table column."""
    kind = types_of(table)[name]
    if kind in _FLOATS:
        return np.full(count, np.nan, _FLOATS[kind])
    if kind in TEXTS:
        return np.full(count, -1, np.int32)
    return np.full(count, MISSING, _WHOLE.get(kind, np.dtype(np.int32)))


def missing_of(table: str, name: str, values: NDArray[Any]) -> NDArray[np.bool_] | None:
    """Return a mask of the missing values in a table column; ``None`` if no value is missing."""
    if types_of(table)[name] in TEXTS:
        missing = values < 0
    elif values.dtype.kind == "f":
        missing = np.isnan(values)
    elif values.dtype.kind == "i" and values.dtype.itemsize >= 4:
        missing = values == MISSING
    else:
        return None
    return missing if missing.any() else None


ORDERS: Final = {
    "state": "is_ego DESC, repeated, kind, frame_id >> 6, node_id, frame_id",
    "lane_single": "kind, bucket, node_id, lane, bit",
    "lane_repeated": "kind, bucket, node_id, lane, mask",
    "world_state": "repeated, kind, frame_id >> 6, node_id, frame_id",
    "world_lane_single": "kind, bucket, node_id, lane, bit",
    "world_lane_repeated": "kind, bucket, node_id, lane, mask",
    "world_gap_single": "bucket, src, dst, bit",
    "world_gap_repeated": "bucket, src, dst, mask",
    "gap_single": "bucket, src, dst, bit",
    "gap_repeated": "bucket, src, dst, mask",
    "derived_gap": "set_name, bucket, src, dst, bit",
    "frame": "frame_id",
    "payload": "channel_id, bucket, bit",
    "map_node": "node_id DESC",
    "message": "",
}
"""Row order of tables in a trace and in a rewritten store. Other tables are sorted by all columns."""

MASKS: Final = (
    *(
        "node",
        "world_node",
        "edge",
        "world_edge",
        "frame_class",
        "lane_role",
        "later_class",
        "derived_node",
        "derived_edge",
    ),
)
"""Tables with a mask of frames. Rows that differ only in the mask are merged."""

STATES: Final = ("state", "world_state")
"""Names of the tables with states of entities, inside and outside the graphs."""

REPEATED: Final = {
    "lane_single": "lane_repeated",
    "world_lane_single": "world_lane_repeated",
    "world_gap_single": "world_gap_repeated",
    "gap_single": "gap_repeated",
}
"""Tables with one row per frame → tables with one row for several frames with equal values."""


@cache
def _keys(table: str) -> tuple[tuple[str, int, bool], ...]:
    """Return the sort order of a table: for each column, its name, a right shift (bits), and if it descends."""
    if table not in ORDERS:
        names = [name for name in types_of(table) if name != "mask" or table not in MASKS]
        return tuple((name, 0, False) for name in names)
    found: list[tuple[str, int, bool]] = []
    for term in filter(None, ORDERS[table].split(", ")):
        name, *words = term.split()
        shift = int(words[words.index(">>") + 1]) if ">>" in words else 0
        found.append((name, shift, "DESC" in words))
    return tuple(found)


def in_order(table: str, columns: Columns, texts: Sequence[str]) -> Columns:
    """Sort the rows of a table. Rows that differ only in their bit mask of frames become one row.

    Parameters
    ----------
    table : str
    columns : dict
        Staged columns: texts are indices into ``texts``; -1 means missing.
    texts : sequence of str
    """
    rank = np.empty(len(texts) + 1, np.int64)
    rank[sorted(range(len(texts)), key=texts.__getitem__)] = np.arange(len(texts))
    rank[-1] = len(texts)
    keys: list[NDArray[Any]] = []
    for name, shift, down in _keys(table):
        if name not in columns:
            continue
        key = columns[name]
        if types_of(table)[name] in TEXTS:
            key = rank[key]
        elif key.dtype.kind == "i" and (missing := missing_of(table, name, key)) is not None:
            key = np.where(missing, np.iinfo(key.dtype).max, key)  # NULL sorts last
        key = key >> shift if shift else key
        keys.append(-key.astype(np.int64) if down else key)
    if not keys or len(keys[0]) < 2:
        return columns
    number = packed(keys)
    order = np.lexsort(keys[::-1]) if number is None else ascending(number)
    if table not in MASKS:
        return {name: values[order] for name, values in columns.items()}
    ranked = keys if number is None else [number]
    fresh = np.ones(len(order), np.bool_)
    fresh[1:] = False
    for key in (key[order] for key in ranked):
        fresh[1:] |= key[1:] != key[:-1]
    first = np.flatnonzero(fresh)
    whole = {name: values[order[first]] for name, values in columns.items()}
    if len(first) < len(order):
        whole["mask"] = np.bitwise_or.reduceat(columns["mask"][order], first)
    return whole


def parted(columns: Columns) -> tuple[Columns, Columns]:
    """Split rows into those that differ from frame to frame, and runs of equal rows. Return two tables.

    Parameters
    ----------
    columns : dict
        Staged columns with ``bucket`` and ``bit``.

    Returns
    -------
    single, repeated : dict
        Single rows, unchanged; and groups of consecutive rows that differ only in ``bit``, each as one row with
        ``mask``.
    """
    bit = columns["bit"].astype(np.int64)
    values = {name: of for name, of in columns.items() if name != "bit"}
    starts = np.flatnonzero(np.append(True, ~_as_before(values)))
    lengths = np.diff(starts, append=len(bit))
    alone, first = starts[lengths == 1], starts[lengths > 1]
    mask = np.bitwise_or.reduceat(np.left_shift(1, bit), starts)[lengths > 1]
    single = {name: of[alone] for name, of in columns.items()}
    return single, {name: of[first] for name, of in values.items()} | {"mask": mask}


def marked(columns: Columns) -> Columns:
    """Add a column ``repeated``: True if the next or previous frame has equal values. Sort the rows."""
    bucket = columns["frame_id"] >> FRAME_BITS
    values = {name: of for name, of in columns.items() if name != "frame_id"}
    same = _as_before({"bucket": bucket, **values})
    repeated = np.append(False, same) | np.append(same, False)
    order = np.lexsort((repeated, ~columns["is_ego"].astype(np.bool_)))
    return {name: of[order] for name, of in {**columns, "repeated": repeated}.items()}


def _as_before(columns: Columns) -> NDArray[np.bool_]:
    """Return a mask of the rows that equal the row before them, without an entry for the first row."""
    same = np.ones(len(next(iter(columns.values()))) - 1, np.bool_)
    for values in columns.values():
        if not same.any():
            break
        bits = values.view(f"i{values.itemsize}") if values.dtype.kind == "f" else values
        same &= bits[1:] == bits[:-1]
    return same


def chained(table: str, blocks: Sequence[Columns]) -> Columns:
    """Concatenate blocks of rows of a table. The result has every column that occurs in a block."""
    if len(blocks) == 1:
        return blocks[0]
    return {
        name: np.concatenate(
            [
                block[name]
                if name in block
                else blank(table, name, len(next(iter(block.values()))))
                for block in blocks
            ]
        )
        for name in dict.fromkeys(name for block in blocks for name in block)
    }
