"""Frame classes (groups of frames with equal abstracted graphs), stored at ingest or at the first query.

Classes are stored as masks, like edges: one row per class and bucket, because driving repeats itself. Ingest
publishes some classes with their trace. Other classes are computed and stored at the first query.
"""

from __future__ import annotations

from collections import OrderedDict
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.graphs.abstractions import (
    AT_INGEST,
    Classes,
    GraphColumns,
    MapColumns,
    abstraction_named,
    contents_of,
    found,
    lane_roles,
)
from sgstore.model.frame_ids import SEQ_BITS, frames_of, trace_bucket
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store._graphs import Graphs
from sgstore.store._packing import masks_of, texts
from sgstore.store._publish import add, note, writing
from sgstore.store._staging import Staging
from sgstore.store._traces import frame_named, trace_named

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.graphs.abstractions import Labelled
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Codes, Ints
    from sgstore.store._locking import Access
    from sgstore.store._packing import Columns

_LATER: Final = "later_class"

_MISSING: Final = """
SELECT trace_id, frames FROM {0}trace WHERE trace_id NOT IN (
  SELECT bucket >> 18 FROM {0}later_class WHERE abstraction = $name UNION ALL
  SELECT bucket >> 18 FROM {0}frame_class WHERE abstraction = $name)
ORDER BY ingested_at, name
"""

_TOGETHER: Final = 2000
"""Approximate number of frames whose classes are added in one transaction."""
_REMEMBERED: Final = 4096
"""Number of frames with cached classes."""
_FEW_EDGES: Final = 1 << 16
"""Largest number of edges for which all abstractions are in memory at once."""


class TraceClasses:
    """Frame classes of one trace for several abstractions. Callers add blocks of frames one after another.

    Parameters
    ----------
    names : sequence of str
        Abstractions.
    """

    def __init__(self, names: Sequence[str] = AT_INGEST) -> None:
        self._of = [abstraction_named(name) for name in names]
        self._classes = Classes()
        self._known: OrderedDict[bytes, list[str]] = OrderedDict()

    def columns(self, seen: GraphColumns, trace_id: int, seq: Ints) -> Columns:
        """For a block of frames, return the scene classes as columns of the table ``later_class``."""
        return self._columns(self._named(seen), trace_id, seq)

    def ingested(self, seen: GraphColumns, trace_id: int, seq: Ints) -> Columns:
        """For a block of frames, return the scene classes as columns of the table ``frame_class``.

        Frames with equal content use the same cached classes.
        """
        contents = contents_of(seen)
        rows = {content: row for row, content in enumerate(contents) if content not in self._known}
        fresh = sorted(rows.values())
        if fresh:
            named = zip(*self._named(seen.taken(np.array(fresh))), strict=True)
            for row, names in zip(fresh, named, strict=True):
                self._known[contents[row]] = list(names)
        of_frames = [self._known[content] for content in contents]
        while len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        return self._columns([*zip(*of_frames, strict=True)], trace_id, seq)

    def _named(self, seen: GraphColumns) -> list[tuple[str, ...]]:
        """For each abstraction, return the class names of some frames: a tuple with one name per frame."""
        # Crowded frames are processed one abstraction at a time, to limit memory.
        together = len(self._of) if len(seen.frame) < _FEW_EDGES else 1
        named: list[str] = []
        for first in range(0, len(self._of), together):
            named += self._classes.of(
                *(of.function(seen) for of in self._of[first : first + together])
            )
        count = seen.frames
        return [tuple(named[i * count : (i + 1) * count]) for i in range(len(self._of))]

    def _columns(self, named: Sequence[tuple[str, ...]], trace_id: int, seq: Ints) -> Columns:
        rows: list[tuple[str, str]] = []
        buckets: list[Ints] = []
        masks: list[Ints] = []
        bucket = trace_bucket(trace_id, seq)
        for abstraction, names in zip(self._of, named, strict=True):
            number = {name: i for i, name in enumerate(dict.fromkeys(names))}
            code = np.array([number[name] for name in names], np.int64)
            first, mask = masks_of((bucket, code), seq % BUCKET_FRAMES)
            rows += [(abstraction.name, names[row]) for row in first.tolist()]
            buckets.append(bucket[first])
            masks.append(mask)
        return {
            "abstraction": texts(abstraction for abstraction, _ in rows),
            "class": texts(name for _, name in rows),
            "bucket": np.concatenate(buckets),
            "mask": np.concatenate(masks),
        }


class IngestedClasses:
    """Frame classes and lane roles of one trace, computed during ingest."""

    def __init__(self, road_map: RoadMap | None) -> None:
        self._grounds = None if road_map is None else MapColumns.of(road_map)
        self._classes = TraceClasses()

    def tables(self, graph: GraphBlock, trace_id: int, kinds: Codes) -> dict[str, Columns]:
        """Return the tables ``frame_class`` and ``lane_role`` for a block of graphs."""
        seen = GraphColumns.of(graph, kinds, self._grounds)
        seq = graph.frames.seq
        return {
            "frame_class": self._classes.ingested(seen, trace_id, seq),
            "lane_role": _role_columns(seen, trace_id, seq),
        }


def _role_columns(seen: GraphColumns, trace_id: int, seq: Ints) -> Columns:
    frame, lane, roles = lane_roles(seen)
    number = {role: i for i, role in enumerate(dict.fromkeys(roles))}
    code = np.array([number[role] for role in roles], np.int64)
    bucket = trace_bucket(trace_id, seq[frame])
    first, mask = masks_of((code, bucket, lane), seq[frame] % BUCKET_FRAMES)
    return {
        "role": texts(roles[row] for row in first.tolist()),
        "bucket": bucket[first],
        "node_id": lane[first],
        "mask": mask,
    }


class Abstracted:
    """Abstracted graphs and frame classes of a store. Created by :attr:`StoreFile.abstracted`."""

    def __init__(self, path: Path, access: Access) -> None:
        self._path = path
        self._access = access
        self._graphs = Graphs()

    def complete(self, name: str) -> int:
        """Compute and store missing frame classes of an abstraction. Return the number of completed traces.

        Each transaction covers traces with some thousand frames. After an interruption, the next call continues
        with the rest.

        Returns
        -------
        int
            Number of traces without these classes before.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            Another process uses the store for too long, or the disk is full.
        """
        name = abstraction_named(name).name
        with self._access.reading() as connection:
            missing = _missing(connection, name)
        together: list[int] = []
        count = 0
        for trace_id, frames in missing.items():
            together.append(trace_id)
            count += frames
            if count >= _TOGETHER:
                self._complete(name, together)
                together, count = [], 0
        if together:
            self._complete(name, together)
        return len(missing)

    def _complete(self, name: str, traces: Sequence[int]) -> None:
        with ExitStack() as staged:
            made: dict[int, Staging] = {}
            with self._access.reading() as connection:
                for trace_id in traces:
                    made[trace_id] = staging = Staging(self._path)
                    staged.callback(staging.close)
                    classes = TraceClasses((name,))
                    for seq, seen in self._graphs.of_trace(connection, trace_id):
                        staging.settle(whole=True)
                        staging.insert(_LATER, classes.columns(seen, trace_id, seq))
                    staging.seal()
            with writing(self._access) as connection:
                # Another process may have added the classes, or removed a trace.
                missing = _missing(connection, name, "store.inside.")
                for trace_id, staging in made.items():
                    if trace_id in missing:
                        add(connection, self._path, staging)
                        note(connection, trace_id, [_LATER])

    def classes(self, name: str, trace: int | str | None = None) -> dict[str, NDArray[np.generic]]:
        """Return each frame's class in an abstraction, as columns. Missing classes are computed.

        Returns
        -------
        dict
            ``frame_id``, int64, ascending; ``class``, str, empty for a graph that is too symmetric.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            The trace does not exist, or another process uses the store for too long.
        """
        self.complete(name)
        with self._access.reading() as connection:
            low, high = 0, (1 << 63) - 1
            if trace is not None:
                low, _ = trace_named(connection, str(trace))
                low, high = (one << SEQ_BITS for one in (low, low + 1))
                high -= 1
            found = connection.execute(
                "SELECT frame_id, coalesce(class, '') AS class FROM classes WHERE abstraction = ?"
                " AND frame_id >= ? AND frame_id <= ? ORDER BY frame_id",
                [abstraction_named(name).name, low, high],
            ).fetchnumpy()
        return {"frame_id": found["frame_id"], "class": np.asarray(found["class"], object)}

    def class_of(self, frame_id: int, name: str) -> str | None:
        """Return the stored class of a frame in an abstraction; ``None`` if no class is stored.

        ``None`` means not stored, or abandoned as too symmetric.
        """
        with self._access.reading() as connection:
            found = connection.execute(
                "SELECT any_value(class) FROM classes WHERE frame_id = ? AND abstraction = ?",
                [frame_id, name],
            ).fetchone()
        return found[0] if found else None

    def roles_of(self, frame_id: int) -> dict[int, str]:
        """Return the roles of lanes relative to the ego in a frame: node id of the lane → role."""
        with self._access.reading() as connection:
            found = connection.execute(
                "SELECT node_id, role FROM roles WHERE frame_id = ?", [frame_id]
            ).fetchall()
        return dict(found)

    def coded(self, name: str) -> CodedClasses:
        """Return the class of each frame in an abstraction as a number. Missing classes are computed.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            Another process uses the store for too long.
        """
        self.complete(name)
        with self._access.reading() as connection:
            return coded_classes(connection, abstraction_named(name).name)

    def masks(self, name: str) -> Iterator[tuple[str | None, int, int]]:
        """Yield (class, bucket, bit mask) for all frames; a bucket has 60 frames. Missing classes are computed.

        Computed classes are not stored.
        """
        name = abstraction_named(name).name
        with self._access.reading() as connection:
            rows = connection.execute(f"SELECT * FROM ({CLASSES})", {"name": name}).fetchall()
            yield from ((kept and kept.hex, bucket, mask) for kept, bucket, mask in rows)
            for trace_id in _missing(connection, name):
                classes = TraceClasses((name,))
                for seq, seen in self._graphs.of_trace(connection, trace_id):
                    found = classes.columns(seen, trace_id, seq)
                    of = found["class"].tolist(), found["bucket"].tolist(), found["mask"].tolist()
                    yield from ((own or None, *rest) for own, *rest in zip(*of, strict=True))

    def times(self) -> tuple[Ints, Ints]:
        """Return the ids of all frames of a store in ascending order, and their simulation times; ns."""
        with self._access.reading() as connection:
            rows = connection.execute("SELECT frame_id, time_ns FROM frame ORDER BY 1").fetchnumpy()
        return rows["frame_id"].astype(np.int64), rows["time_ns"].astype(np.int64)

    def imported_names(self) -> dict[str, int]:
        """Return the names of the graphs that come from imported files: graph name → frame id."""
        with self._access.reading() as connection:
            return dict(connection.execute("SELECT graph, frame_id FROM imports").fetchall())

    def features(self, name: str, frame_id: Ints) -> Iterator[tuple[Ints, Triples]]:
        """For given frames, yield the counts of node and edge labels in their graphs, in groups of frames.

        Parameters
        ----------
        name : str
        frame_id : int64
            Ascending.

        Yields
        ------
        rows : int64
            Indices of these frames in the input.
        triples : Triples

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        """
        function = abstraction_named(name).function
        with self._access.reading() as connection:
            for rows, seen in self._graphs.of_ids(connection, frame_id):
                yield rows, triples(function(seen))

    def frames(self, name: str, first: int, last: int) -> tuple[Ints, GraphColumns, Labelled]:
        """For a range of frames of one trace, return frame numbers, graphs and abstracted graphs.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            Another process uses the store for too long.
        """
        function = abstraction_named(name).function
        with self._access.reading() as connection:
            seq, seen = self._graphs.of_frames(connection, first, last)
        return seq, seen, function(seen)

    def labelled(self, ref: int | str, name: str) -> tuple[Labelled, dict[str, int | str]]:
        """Return the abstracted graph of one frame as columns, and the frame's id, trace, number and time.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            The frame does not exist.
        """
        abstraction = abstraction_named(name)
        with self._access.reading() as connection:
            frame = frame_named(connection, ref)
            _, seen = self._graphs.of_frames(connection, frame.frame_id, frame.frame_id)
        about = {name: getattr(frame, name) for name in ("frame_id", "trace", "seq", "time_ns")}
        return abstraction.function(seen), about | {"abstraction": abstraction.name}


def _missing(connection: DuckDBPyConnection, name: str, catalog: str = "") -> dict[int, int]:
    """Return the traces whose frame classes are not stored for an abstraction: trace id → number of frames."""
    return dict(connection.execute(_MISSING.format(catalog), {"name": name}).fetchall())


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
    """Run SQL that returns ``class``, ``bucket``, ``mask``. Return the class of each frame as a number."""
    names = connection.execute(_NAMES.format(kept), values).fetchnumpy()["name"]
    rows = connection.execute(_MASKS.format(kept), values).fetchnumpy()
    frame_id, row = frames_of(rows["bucket"].astype(np.int64), rows["mask"].astype(np.int64))
    code = rows["code"].astype(np.int64)[row]
    order = np.argsort(frame_id, kind="stable")
    return CodedClasses(tuple(names.tolist()), frame_id[order], code[order])


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
    """Return the distinct pairs (frame, label number), and how often each pair occurs."""
    frame, key = of
    span = int(key.max(initial=0)) + 1
    both, often = np.unique(frame * span + key, return_counts=True)
    return both // span, both % span, often
