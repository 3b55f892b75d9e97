"""Classes of all frames of a store as numbers, and the graphs of some frames: what coverage is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.abstractions import found
from sgstore.store._packing import BUCKET_BITS, FRAME_BITS
from sgstore.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sgstore.abstractions import Labelled
    from sgstore.world import Bools, Ints


_CLASSES: Final = """
WITH kept AS (
  SELECT class, bucket, mask FROM frame_class WHERE abstraction = $name
  UNION ALL SELECT class, bucket, mask FROM later_class WHERE abstraction = $name)
"""
_NAMES: Final = f"""{_CLASSES}
SELECT replace(class::VARCHAR, '-', '') AS name FROM (SELECT DISTINCT class FROM kept WHERE class IS NOT NULL)
ORDER BY class
"""
_MASKS: Final = f"""{_CLASSES}
SELECT bucket, mask, CASE WHEN class IS NULL THEN -1 ELSE dense_rank() OVER (ORDER BY class NULLS LAST) - 1 END
  AS code FROM kept
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
    names = connection.execute(_NAMES, {"name": name}).fetchnumpy()["name"]
    rows = connection.execute(_MASKS, {"name": name}).fetchnumpy()
    frame_id, row = frames_of(rows["bucket"].astype(np.int64), rows["mask"].astype(np.int64))
    code = rows["code"].astype(np.int64)[row]
    order = np.argsort(frame_id, kind="stable")
    return CodedClasses(tuple(names.tolist()), frame_id[order], code[order])


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


def begins(frame_id: Ints) -> Bools:
    """(N,): which frames do not come next after the one before them, in its trace."""
    trace, seq = trace_of(frame_id), seq_of(frame_id)
    found = np.ones(len(frame_id), np.bool_)
    found[1:] = (trace[1:] != trace[:-1]) | (seq[1:] != seq[:-1] + 1)
    return found


def times(connection: DuckDBPyConnection) -> tuple[Ints, Ints]:
    """Ids of all frames, ascending, and their simulation times; ns."""
    rows = connection.execute(_TIMES).fetchnumpy()
    return rows["frame_id"].astype(np.int64), rows["time_ns"].astype(np.int64)


def imported_names(connection: DuckDBPyConnection) -> dict[str, int]:
    """What imported files call their graphs, and the frames that these became; of several the last one."""
    return dict(connection.execute(_IMPORTED).fetchall())


@dataclass(frozen=True, slots=True)
class Triples:
    """What some graphs are made of; one row a frame and feature.

    Attributes
    ----------
    names : list of tuple of str
        Features: labels of an edge's source, of itself and of its destination; or of a node alone.
    frame : (N,) int64
        Frames, counted from 0.
    feature : (N,) int64
        Index into ``names``.
    often : (N,) int64
        How often it occurs.
    """

    names: list[tuple[str, ...]]
    frame: Ints
    feature: Ints
    often: Ints


def triples(graphs: Labelled) -> Triples:
    """How often nodes and edges occur in frames: by label, and by the labels of both ends and their own."""
    size = len(graphs.labels)
    of_node = graphs.node_frame.astype(np.int64), graphs.node_label.astype(np.int64)
    ends = [
        graphs.node_label[found(graphs.node_frame, graphs.node, graphs.frame, end)]
        for end in (graphs.src, graphs.dst)
    ]
    edge, label = _single(graphs)
    src, dst = (end.astype(np.int64)[edge] for end in ends)
    of_edge = graphs.frame[edge].astype(np.int64), (src * size + label) * size + dst
    frame, key, often = _counted(of_node)
    edge_frame, edge_key, edge_often = _counted(of_edge)
    nodes, feature = np.unique(key, return_inverse=True)
    edges, edge_feature = np.unique(edge_key, return_inverse=True)
    names: list[tuple[str, ...]] = [(graphs.labels[code],) for code in nodes.tolist()]
    for code in edges.tolist():
        rest, last = divmod(code, size)
        names.append(tuple(graphs.labels[part] for part in (*divmod(rest, size), last)))
    return Triples(
        names,
        np.concatenate([frame, edge_frame]),
        np.concatenate([feature, len(nodes) + edge_feature]),
        np.concatenate([often, edge_often]),
    )


def _single(graphs: Labelled) -> tuple[Ints, Ints]:
    """Edges with several labels as several: the edge, and its label."""
    bundles = [np.array(one, np.int64) for one in graphs.bundles]
    label = graphs.label.astype(np.int64)
    many = np.ones(len(label), np.int64)
    several = np.flatnonzero(label < 0)
    lengths = np.array([len(one) for one in bundles] or [0])
    many[several] = lengths[-1 - label[several]]
    edge = np.repeat(np.arange(len(label)), many)
    flat = np.concatenate([*bundles, np.zeros(0, np.int64)])
    starts = np.cumsum(lengths) - lengths
    within = np.arange(len(edge)) - np.repeat(np.cumsum(many) - many, many)
    given = label[edge]
    bundled = given < 0
    given[bundled] = flat[starts[-1 - given[bundled]] + within[bundled]]
    return edge, given


def _counted(of: tuple[Ints, Ints]) -> tuple[Ints, Ints, Ints]:
    """Pairs of numbers, each once, and how often each comes."""
    frame, key = of
    span = int(key.max(initial=0)) + 1
    both, often = np.unique(frame * span + key, return_counts=True)
    return both // span, both % span, often
