"""Digests of scene graphs in the older format of locks, format 1. Equal digests mean equal graphs.

A digest covers the bits of numbers, the characters of texts, and frame numbers in the trace.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.model.frame_ids import seq_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints
    from sgstore.store._file import StoreFile

    Words = NDArray[np.uint64]


GRAPHS: Final = 500
"""Number of frames whose graphs are read at once. A usual frame has a thousand edges."""

DIGEST_BYTES: Final = 16

_WANTED: Final = "(SELECT unnest($frames) AS frame_id) w"

_NODES: Final = (
    "kind is_ego special subkind is_static x y z heading pitch roll speed vx vy vz accel ax "
    "ay az yaw_rate length width height light_state light_left light_right light_brake "
    "light_reverse light_position light_low_beam light_high_beam light_fog light_interior "
    "light_special1 light_special2 steer throttle brake derived_velocity derived_acceleration "
    "derived_yaw_rate lane_type road section lane junction turn speed_limit curvature"
)

_TABLES: Final = {
    "frames": ("seq", "ego"),
    "nodes": ("node_id", *_NODES.split()),
    "edges": ("src", "relation", "dst"),
    "lane_states": (
        *("src", "dst", "overlap", "lane_offset", "heading_error", "is_primary", "along", "is_own"),
    ),
    "lane_gaps": ("src", "dst", "gap"),
}
"""View → columns that define a scene graph. A change alters all digests."""

_LATER: Final = {
    "(SELECT * FROM nodes WHERE gear IS NOT NULL OR hand_brake IS NOT NULL)": (
        *("node_id", "gear", "hand_brake"),
    ),
}
"""View → newer columns that define a scene graph. The digest includes them only if they have values."""


def older_graph_digests(file: StoreFile, frames: Sequence[Ints]) -> list[str]:
    """Return one digest for each group of frames. Groups with equal graphs have equal digests.

    Parameters
    ----------
    file : StoreFile
    frames : sequence of int64
        Groups of frame ids, each ascending. Groups can be in any order; the store is read once, in its own
        order.
    """
    digests = [""] * len(frames)
    order = sorted(range(len(frames)), key=lambda number: int(frames[number][0]))
    with file.snapshot():
        tables = [(v, c, _labels(file, v, c)) for v, c in (_TABLES | _LATER).items()]
        for low, high in _windows([len(frames[number]) for number in order]):
            groups = [frames[number] for number in order[low:high]]
            hashes = [hashlib.blake2b(digest_size=DIGEST_BYTES) for _ in groups]
            wanted = np.unique(np.concatenate(groups))
            for view, columns, labels in tables:
                rows = _rows(file, view, columns, labels, wanted)
                for one, group in zip(hashes, groups, strict=True):
                    _add(one, rows, group, always=view in _TABLES)
            for number, one in zip(order[low:high], hashes, strict=True):
                digests[number] = one.hexdigest()
    return digests


def _windows(sizes: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yield ranges of groups. A range has at most :data:`GRAPHS` frames, or is a single larger group."""
    low = together = 0
    for high, size in enumerate(sizes):
        if together + size > GRAPHS and high > low:
            yield low, high
            low, together = high, 0
        together += size
    if low < len(sizes):
        yield low, len(sizes)


def _labels(file: StoreFile, view: str, columns: Sequence[str]) -> dict[str, Words]:
    """Return hashes of enumeration values: column → array of 64-bit words, indexed by enumeration code."""
    found: dict[str, Words] = {}
    for name, kind, *_ in file.rows(f"DESCRIBE SELECT * FROM {view}").values:
        if name in columns and kind.startswith("ENUM"):
            [[texts]] = file.rows(f"SELECT enum_range(NULL::{kind})").values
            found[name] = np.array([_word(text) for text in texts], np.uint64)
    return found


def _rows(
    file: StoreFile,
    view: str,
    columns: Sequence[str],
    labels: Mapping[str, Words],
    wanted: Ints,
) -> tuple[Ints, Words]:
    """Return the distinct rows of a view for some frames: frame ids, and values as 64-bit hashes, sorted."""
    listed = ", ".join(
        f'enum_code(v."{name}") AS "{name}"' if name in labels else f'v."{name}"'
        for name in columns
    )
    span = (
        f"v.frame_id BETWEEN {wanted[0]} AND {wanted[-1]}"  # the column that lets a scan skip rows
    )
    sql = f"SELECT v.frame_id, {listed} FROM {view} v JOIN {_WANTED} ON w.frame_id = v.frame_id WHERE {span}"
    found = file.arrays(sql, {"frames": wanted.tolist()})
    frame_id = found.pop("frame_id").astype(np.int64)
    told = [_words(values, labels.get(name)) for name, values in found.items()]
    order = np.lexsort((*told[2::-1], frame_id))  # the most selective column first
    if _like_before(order, frame_id, *told[:3]).any():
        order = np.lexsort((*told[::-1], frame_id))
        order = order[~_like_before(order, frame_id, *told)]
    frame_id = frame_id[order]
    words = np.empty((len(order), 1 + len(told)), np.uint64)
    words[:, 0] = seq_of(frame_id).astype(np.uint64)
    for place, column in enumerate(told, start=1):
        words[:, place] = column[order]
    return frame_id, words


def _like_before(order: NDArray[np.intp], *columns: NDArray[Any]) -> Bools:
    """Return a mask (N,) of the rows that equal the row before them, in the given order."""
    like = np.ones(len(order), np.bool_)
    like[:1] = False
    for column in columns:
        ordered = column[order]
        like[1:] &= ordered[1:] == ordered[:-1]
    return like


_MISSING_DIGEST: Final = np.uint64(0x6E756C6C6E756C6C)


def _words(values: NDArray[Any], labels: Words | None) -> Words:
    """Return the values of a column as 64-bit words. Enumeration codes become the hashes of their names."""
    plain = np.ma.getdata(values)
    missing = np.ma.getmaskarray(values)
    if labels is not None:
        words = labels[np.where(missing, 0, plain)]
    elif plain.dtype.kind == "f":
        numbers = plain.astype(np.float64) + 0.0  # merges -0 and 0
        missing = missing | np.isnan(numbers)
        words = numbers.view(np.uint64)
    elif plain.dtype.kind in "biu":
        words = plain.astype(np.int64).view(np.uint64)
    else:
        texts = np.where(missing, "", plain).tolist()
        known = {text: _word(text) for text in set(texts)}
        words = np.fromiter(map(known.__getitem__, texts), np.uint64, len(texts))
    return np.where(missing, _MISSING_DIGEST, words) if missing.any() else words


def _word(text: str) -> int:
    whole = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return int.from_bytes(whole, "little")


def _add(digest: Any, rows: tuple[Ints, Words], group: Ints, *, always: bool) -> None:
    frame_id, words = rows
    low = int(np.searchsorted(frame_id, group[0]))
    high = int(np.searchsorted(frame_id, group[-1], side="right"))
    own = words[low:high]
    if len(group) < group[-1] - group[0] + 1:  # other frames may lie between
        own = own[np.isin(frame_id[low:high], group)]
    if not len(own) and not always:
        return
    digest.update(np.array([len(own)], "<u8").tobytes())
    digest.update(np.ascontiguousarray(own, "<u8").tobytes())
