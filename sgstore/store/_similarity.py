"""Search for frames whose graphs are similar to the graph of an example frame, most similar first."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import number_of
from sgstore.errors import AbstractionError
from sgstore.graphs.abstractions import (
    Classes,
    GraphFeatures,
    abstraction_named,
    of_frames,
    without,
)
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.model.vocabulary import (
    RELATION_ALIASES,
    RELATIONS,
    kinds_labelled,
    labels,
    natural,
    suggestion,
)
from sgstore.store._classes import coded_classes
from sgstore.store._engine_errors import translated
from sgstore.store._graphs import Graphs
from sgstore.store._traces import FrameRef, frame_named, stored_traces

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.graphs.abstractions import Labelled
    from sgstore.model.world import Ints
    from sgstore.store._file import StoreFile
    from sgstore.store._traces import StoredTrace


@dataclass(frozen=True, slots=True)
class SimilarFrames:
    """Consecutive frames of a trace that are equally similar to the example frame of a search.

    Attributes
    ----------
    frame : FrameRef
        First frame.
    frames : int
        Number of frames.
    similarity : float
        From 0 (no common feature) to 1 (all features equal); see :mod:`sgstore.graphs.abstractions._features`.
    same : bool or None
        True if the graphs are isomorphic, so of the same class. ``None`` means too symmetric.
    shared, missing, extra : dict of str to int
        Feature counts: in both; only in the example; only in these frames.
    """

    frame: FrameRef
    frames: int
    similarity: float
    same: bool | None
    shared: dict[str, int]
    missing: dict[str, int]
    extra: dict[str, int]

    def __repr__(self) -> str:
        first = f"{self.frame.trace}#{self.frame.seq}"
        frames = number_of(self.frames, "frame")
        return f"<SimilarFrames from {first!r}: {frames}, similarity {self.similarity:.3g}>"


@dataclass(frozen=True, slots=True)
class Example:
    """Example frame for a similarity search, as label counts of its graph. It works in any store.

    Attributes
    ----------
    features : dict of str to int
        Feature counts, without ignored features.
    graph_class : str or None
        Class of the graph. ``None`` means too symmetric.
    trace_id : int
    beside : (int, int)
        Numbers of the first and last frame near the example, in its trace.
    abstraction : str
    ignored : list of str
    """

    features: dict[str, int]
    graph_class: str | None
    trace_id: int
    beside: tuple[int, int]
    abstraction: str
    ignored: list[str]

    @staticmethod
    def of(file: StoreFile, ref: int | str, name: str, ignored: Sequence[str]) -> Example:
        """Return a frame of a store as the example of a similarity search.

        Parameters
        ----------
        file : StoreFile
        ref : int or str
            Frame, as for :meth:`sgstore.store.StoreFile.frame`.
        name : str
            Abstraction of the compared graphs.
        ignored : sequence of str
            Labels and relations to ignore; see :func:`sgstore.graphs.abstractions._features.without`.

        Raises
        ------
        StoreError
            The frame does not exist.
        AbstractionError
            The abstraction does not exist, or no name matches ``ignored``.
        """
        abstraction = abstraction_named(name)
        with translated(file.path), file.access.reading() as connection:
            frame = frame_named(connection, ref)
            _, seen = Graphs().of_frames(connection, frame.frame_id, frame.frame_id)
            beside = _beside(connection, frame)
        whole = abstraction.function(seen)
        _check(ignored, whole)
        example = without(whole, ignored)
        (own,) = Classes().of(example)
        features = dict(GraphFeatures.of(example).counts(0))
        return Example(features, own, frame.trace_id, beside, name, [*ignored])

    @staticmethod
    def find(
        file: StoreFile, example: Example, limit: int, *, each_trace: bool = False
    ) -> list[SimilarFrames]:
        """Return runs of consecutive frames similar to the example: most similar first, then by trace and time.

        One frame of each stored class is read, in groups. Memory holds some 50 bytes for each frame.

        Parameters
        ----------
        file : StoreFile
        example : Example
            Frame of this or another store.
        limit : int
            Largest number of runs.
        each_trace : bool
            True for only the best run of each trace, without frames near the example.
        """
        first, last = example.beside
        beside = range(first, last + 1) if each_trace else range(0)
        with translated(file.path), file.access.reading() as connection:
            traces = stored_traces(connection)
            compared = _compared(connection, example)
            runs = compared.runs([one.trace_id for one in traces], example.trace_id, beside)
            best = runs.best(max(limit, 0), each_trace=each_trace)
            return [*_described(connection, best, traces, example)]

    @staticmethod
    def best(found: Iterable[SimilarFrames], limit: int) -> list[SimilarFrames]:
        """Return the most similar runs of frames from several stores, as from one combined store."""

        def place(one: SimilarFrames) -> tuple[Any, ...]:
            likeness = one.similarity + (one.same is True)
            return -likeness, natural(one.frame.trace), one.frame.seq

        return sorted(found, key=place)[:limit]


BESIDE_S: Final = 5.0
"""Frames of the same trace within this time of the example are left out, as they are always similar; s."""


def _beside(connection: DuckDBPyConnection, frame: FrameRef) -> tuple[int, int]:
    """Return the first and last number of the frames within :data:`BESIDE_S` seconds of the given frame."""
    sql = "SELECT min(seq), max(seq) FROM frames WHERE trace_id = ? AND abs(t - ?) < ?"
    found = connection.execute(sql, [frame.trace_id, frame.t, BESIDE_S]).fetchone()
    return found or (0, -1)


@dataclass(frozen=True, slots=True)
class _Runs:
    """Runs of consecutive frames with equal features. Each run is one row.

    Attributes
    ----------
    frame_id, seq, frames : (N,) int64
        First frame, its number in the trace, and the number of frames.
    trace : (N,) int64
        Number of the trace in natural order of names.
    likeness : (N,) float64
    same : (N,) int8
        1 for the class of the example, 0 for another one, -1 where the graph is too symmetric.
    """

    frame_id: Ints
    seq: Ints
    frames: Ints
    trace: Ints
    likeness: NDArray[np.float64]
    same: NDArray[np.int8]

    def best(self, limit: int, *, each_trace: bool) -> _Runs:
        """Return the most similar runs; of equally similar runs, the first ones by trace and time."""
        order = np.lexsort((self.seq, self.trace, -(self.likeness + (self.same == 1))))
        if each_trace:
            _, first = np.unique(self.trace[order], return_index=True)
            order = order[np.sort(first)]
        return self._rows(order[:limit])

    def _rows(self, rows: Ints) -> _Runs:
        return _Runs(
            self.frame_id[rows],
            self.seq[rows],
            self.frames[rows],
            self.trace[rows],
            self.likeness[rows],
            self.same[rows],
        )


@dataclass(frozen=True, slots=True)
class _Compared:
    """Similarity of every frame of a store to an example: arrays (N,), by ascending frame id.

    ``digest`` is equal for frames with equal features. ``same`` is as in :class:`_Runs`.
    """

    frame_id: Ints
    seq: Ints
    likeness: NDArray[np.float64]
    digest: NDArray[np.uint64]
    same: NDArray[np.int8]

    def runs(self, trace_ids: Sequence[int], example_trace: int, beside: range) -> _Runs:
        """Return the runs of consecutive frames with equal features, without frames close to the example."""
        trace_id = self.frame_id >> SEQ_BITS
        out = (trace_id == example_trace) & (self.seq >= beside.start) & (self.seq < beside.stop)
        differs = np.ones(len(trace_id), np.bool_)
        differs[1:] = np.diff(self.seq) != 1
        for column in (trace_id, self.digest, self.same, out):
            differs[1:] |= column[1:] != column[:-1]
        first = np.flatnonzero(differs)
        frames = np.diff(first, append=len(trace_id))
        kept = ~out[first]
        first, frames = first[kept], frames[kept]
        ids = np.array(trace_ids, np.int64)
        order = np.argsort(ids)
        return _Runs(
            self.frame_id[first],
            self.seq[first],
            frames,
            order[np.searchsorted(ids[order], trace_id[first])],
            self.likeness[first],
            self.same[first],
        )


def _compared(connection: DuckDBPyConnection, example: Example) -> _Compared:
    """Compute the similarity of each frame to an example. Isomorphic graphs have equal features.

    So one frame of each class is read. Frames without a stored class are read one by one.
    """
    abstraction = abstraction_named(example.abstraction)
    rows = connection.execute("SELECT frame_id, seq FROM frame ORDER BY frame_id").fetchnumpy()
    frame_id, seq = (rows[name].astype(np.int64) for name in ("frame_id", "seq"))
    coded = coded_classes(connection, abstraction.name)
    code = np.full(len(frame_id), -1)
    code[np.searchsorted(frame_id, coded.frame_id)] = coded.code
    alone = np.flatnonzero(code < 0)
    code[alone] = len(coded.names) + np.arange(len(alone))
    _, read, group = np.unique(code, return_index=True, return_inverse=True)
    by_time = np.argsort(read)
    likeness = np.zeros(len(read))
    digest = np.zeros(len(read), np.uint64)
    same = np.zeros(len(read), np.int8)
    counts, classes = Counter(example.features), Classes()
    for part, seen in Graphs().of_ids(connection, frame_id[read[by_time]]):
        graphs = without(abstraction.function(seen), example.ignored)
        features, groups = GraphFeatures.of(graphs), by_time[part]
        likeness[groups] = of_part = features.likeness(counts)
        digest[groups] = features.digests()
        complete = of_part == 1
        if complete.any():
            own = example.graph_class
            found = classes.of(of_frames(graphs, complete))
            for row in np.flatnonzero(complete).tolist():
                same[groups[row]] = found[row] == own if found[row] and own else -1
    return _Compared(frame_id, seq, likeness[group], digest[group], same[group])


def _described(
    connection: DuckDBPyConnection, runs: _Runs, traces: Sequence[StoredTrace], example: Example
) -> Iterator[SimilarFrames]:
    """Yield each run with its first frame, its similarity, and the features shared with the example."""
    function, counts = abstraction_named(example.abstraction).function, Counter(example.features)
    features: dict[int, Counter[str]] = {}
    ids = np.sort(runs.frame_id)
    for part, seen in Graphs().of_ids(connection, ids):
        of_part = GraphFeatures.of(without(function(seen), example.ignored))
        features |= {int(ids[row]): of_part.counts(i) for i, row in enumerate(part.tolist())}
    for i, frame_id in enumerate(runs.frame_id.tolist()):
        own = features[frame_id]
        name = traces[int(runs.trace[i])].name
        yield SimilarFrames(
            frame=frame_named(connection, f"{name}#{int(runs.seq[i])}"),
            frames=int(runs.frames[i]),
            similarity=float(runs.likeness[i]),
            same=None if runs.same[i] < 0 else bool(runs.same[i]),
            shared=_sorted(counts & own),
            missing=_sorted(counts - own),
            extra=_sorted(own - counts),
        )


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items()))


def _check(ignored: Sequence[str], graphs: Labelled) -> None:
    """Raise an error for an ignored name that is neither in the vocabulary nor in the example graph."""
    known = {*RELATIONS, *RELATION_ALIASES, *graphs.labels, *labels()}
    folds = {name.replace("_", "").lower() for name in known}
    for name in ignored:
        if name.replace("_", "").lower() not in folds and not kinds_labelled(name):
            like = suggestion(name, sorted(known))
            hint = f"; did you mean {like!r}?" if like else "; expected a label or a relation"
            raise AbstractionError(f"unknown kind or relation {name!r} to ignore{hint}")
