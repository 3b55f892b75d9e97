"""Classes of all frames of a store as numbers, and the graphs of some frames: what coverage is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.store.packing import BUCKET_BITS, FRAME_BITS
from sgstore.store.seen import WINDOW
from sgstore.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.abstractions import Labelled
    from sgstore.abstractions.columns import Seen
    from sgstore.store.seen import Graphs
    from sgstore.world import Ints

_CLASSES: Final = """
WITH kept AS (
  SELECT class, bucket, mask FROM frame_class WHERE abstraction = $name
  UNION ALL SELECT class, bucket, mask FROM later_class WHERE abstraction = $name),
numbered AS (
  SELECT class, row_number() OVER (ORDER BY class) - 1 AS code
  FROM (SELECT DISTINCT class FROM kept WHERE class IS NOT NULL))
"""
_NAMES: Final = (
    f"{_CLASSES} SELECT replace(class::VARCHAR, '-', '') AS name FROM numbered ORDER BY code"
)
_MASKS: Final = f"""{_CLASSES}
SELECT k.bucket, k.mask, coalesce(n.code, -1) AS code FROM kept k LEFT JOIN numbered n ON n.class = k.class
"""
_IMPORTED: Final = "SELECT graph, frame_id FROM imports"
_TIMES: Final = "SELECT frame_id, time_ns FROM frame ORDER BY frame_id"

SEQ_BITS: Final = BUCKET_BITS + FRAME_BITS
"""Bits of a frame's id below those of its trace."""


@dataclass(frozen=True, slots=True)
class CodedClasses:
    """The class of each frame in an abstraction.

    Attributes
    ----------
    names : tuple of str
        The classes that there are.
    frame_id : (N,) int64
        Ascending.
    code : (N,) int64
        Index into ``names``; -1: too symmetric to be told.
    """

    names: tuple[str, ...]
    frame_id: Ints
    code: Ints


def coded_classes(connection: DuckDBPyConnection, name: str) -> CodedClasses:
    """The classes in an abstraction that a store keeps.

    Parameters
    ----------
    connection : DuckDBPyConnection
    name : str
        As the store has it.
    """
    names = connection.execute(_NAMES, {"name": name}).fetchall()
    rows = connection.execute(_MASKS, {"name": name}).fetchnumpy()
    frame_id, row = frames_of(rows["bucket"].astype(np.int64), rows["mask"].astype(np.int64))
    code = rows["code"].astype(np.int64)[row]
    order = np.argsort(frame_id, kind="stable")
    return CodedClasses(tuple(one for (one,) in names), frame_id[order], code[order])


def frames_of(bucket: Ints, mask: Ints) -> tuple[Ints, Ints]:
    """The frames of masks: their ids, and the row of each."""
    ids: list[Ints] = []
    rows: list[Ints] = []
    for bit in range(BUCKET_FRAMES):
        row = np.flatnonzero(mask >> bit & 1)
        ids.append((bucket[row] << FRAME_BITS) + bit)
        rows.append(row)
    return np.concatenate(ids), np.concatenate(rows)


def trace_of(frame_id: Ints) -> Ints:
    """Ids of the traces of frames."""
    return frame_id >> SEQ_BITS


def seq_of(frame_id: Ints) -> Ints:
    """Numbers of frames in their traces."""
    bucket = (frame_id >> FRAME_BITS) & ((1 << BUCKET_BITS) - 1)
    return bucket * BUCKET_FRAMES + frame_id % (1 << FRAME_BITS)


def times(connection: DuckDBPyConnection) -> tuple[Ints, Ints]:
    """Ids of all frames, ascending, and their simulation times; ns."""
    rows = connection.execute(_TIMES).fetchnumpy()
    return rows["frame_id"].astype(np.int64), rows["time_ns"].astype(np.int64)


def imported_names(connection: DuckDBPyConnection) -> dict[str, int]:
    """What imported files call their graphs, and the frames that these became; of several the last one."""
    return dict(connection.execute(_IMPORTED).fetchall())


def seen_of(
    connection: DuckDBPyConnection, graphs: Graphs, frame_id: Ints
) -> Iterator[tuple[Ints, NDArray[np.intp], Seen]]:
    """The graphs of frames, whose ids ascend, some buckets at a time.

    Yields
    ------
    ids : int64
        Those of the frames that are in these buckets.
    row : intp
        Their rows in what was seen.
    seen : Seen
        Which may hold frames between them, too.
    """
    bucket = frame_id >> FRAME_BITS
    first = 0
    while first < len(frame_id):
        same_trace = trace_of(frame_id[first : first + 1])[0]
        end = int(np.searchsorted(bucket, bucket[first] + WINDOW))
        end = min(end, int(np.searchsorted(trace_of(frame_id), same_trace, side="right")))
        ids = frame_id[first:end]
        seq, seen = graphs.of_frames(connection, int(ids[0]), int(ids[-1]))
        yield ids, np.searchsorted(seq, seq_of(ids)), seen
        first = end


def triples(graphs: Labelled, rows: NDArray[np.intp]) -> list[dict[tuple[str, ...], int]]:
    """How often nodes and edges occur in frames: by label, and by the labels of both ends and their own.

    Parameters
    ----------
    graphs : Labelled
    rows : intp
        Frames, ascending.
    """
    found: list[dict[tuple[str, ...], int]] = [{} for _ in range(len(rows))]
    place = np.full(graphs.frames, -1)
    place[rows] = np.arange(len(rows))
    label_of = {
        (frame, node): label
        for frame, node, label in zip(
            graphs.node_frame.tolist(),
            graphs.node.tolist(),
            graphs.node_label.tolist(),
            strict=True,
        )
        if place[frame] >= 0
    }
    names = graphs.labels
    for (frame, _), label in label_of.items():
        one = found[place[frame]]
        key = (names[label],)
        one[key] = one.get(key, 0) + 1
    wanted = np.flatnonzero(place[graphs.frame] >= 0)
    columns = (graphs.frame, graphs.src, graphs.label, graphs.dst)
    for frame, src, label, dst in zip(
        *(column[wanted].tolist() for column in columns), strict=True
    ):
        one = found[place[frame]]
        ends = names[label_of[frame, src]], names[label_of[frame, dst]]
        for single in (label,) if label >= 0 else graphs.bundles[-1 - label]:
            key = (ends[0], names[single], ends[1])
            one[key] = one.get(key, 0) + 1
    return found
