"""Input of the coverage search: classes of all frames as numbers, and label counts of graphs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.graphs.abstractions import found
from sgstore.model.frame_ids import frames_of

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sgstore.graphs.abstractions import Labelled
    from sgstore.model.world import Ints

CLASSES: Final = """
  SELECT class, bucket, mask FROM frame_class WHERE abstraction = $name
  UNION ALL SELECT class, bucket, mask FROM later_class WHERE abstraction = $name
"""

_NAMES: Final = """WITH kept AS ({})
SELECT replace(class::VARCHAR, '-', '') AS name FROM (SELECT DISTINCT class FROM kept WHERE class IS NOT NULL)
ORDER BY class
"""

_MASKS: Final = """WITH kept AS ({})
SELECT bucket, mask, CASE WHEN class IS NULL THEN -1 ELSE dense_rank() OVER (ORDER BY class NULLS LAST) - 1 END
  AS code FROM kept
"""

_IMPORTED: Final = "SELECT graph, frame_id FROM imports"

_TIMES: Final = "SELECT frame_id, time_ns FROM frame ORDER BY frame_id"


@dataclass(frozen=True, slots=True)
class CodedClasses:
    """Class of each frame in one abstraction, as an index into a list of class names.

    Attributes
    ----------
    names : tuple of str
        Distinct classes.
    frame_id : (N,) int64
        Ascending.
    code : (N,) int64
        Index into ``names``; -1: too symmetric.
    """

    names: tuple[str, ...]
    frame_id: Ints
    code: Ints


def coded_classes(connection: DuckDBPyConnection, name: str) -> CodedClasses:
    """Return the stored class of each frame in an abstraction, as a number per frame.

    Parameters
    ----------
    connection : DuckDBPyConnection
    name : str
        Name of the abstraction in the store.
    """
    return classes_coded(connection, CLASSES, {"name": name})


def classes_coded(
    connection: DuckDBPyConnection, kept: str, values: dict[str, Any] | None = None
) -> CodedClasses:
    """Run SQL with columns ``class``, ``bucket``, ``mask``, and return the class of each frame as a number."""
    names = connection.execute(_NAMES.format(kept), values).fetchnumpy()["name"]
    rows = connection.execute(_MASKS.format(kept), values).fetchnumpy()
    frame_id, row = frames_of(rows["bucket"].astype(np.int64), rows["mask"].astype(np.int64))
    code = rows["code"].astype(np.int64)[row]
    order = np.argsort(frame_id, kind="stable")
    return CodedClasses(tuple(names.tolist()), frame_id[order], code[order])


def times(connection: DuckDBPyConnection) -> tuple[Ints, Ints]:
    """Return the ids of all frames of a store in ascending order, and their simulation times; ns."""
    rows = connection.execute(_TIMES).fetchnumpy()
    return rows["frame_id"].astype(np.int64), rows["time_ns"].astype(np.int64)


def imported_names(connection: DuckDBPyConnection) -> dict[str, int]:
    """Return the graph names from imported files: name → frame id. Of equal names, the last frame is used."""
    return dict(connection.execute(_IMPORTED).fetchall())


@dataclass(frozen=True, slots=True)
class Triples:
    """Features of graphs (labels of nodes and edges) with their counts, one row per frame and feature.

    Attributes
    ----------
    names : list of tuple of str
        Features: labels of source, edge and destination; or the label of a node.
    frame : (N,) int64
        Frames, counted from 0.
    feature : (N,) int64
        Index into ``names``.
    often : (N,) int64
        Count of the feature in the frame.
    """

    names: list[tuple[str, ...]]
    frame: Ints
    feature: Ints
    often: Ints


def triples(graphs: Labelled) -> Triples:
    """Count the labels of each frame: labels of nodes, and labels of edges with both end nodes."""
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
    """Return one row (edge, label) for each label of each edge, because an edge can have several labels."""
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
    """Return the distinct pairs of numbers, and the count of each pair."""
    frame, key = of
    span = int(key.max(initial=0)) + 1
    both, often = np.unique(frame * span + key, return_counts=True)
    return both // span, both % span, often
