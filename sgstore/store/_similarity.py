"""Search for frames whose graphs are similar to the graph of an example frame, most similar first."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from heapq import heappush, heapreplace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import AbstractionError
from sgstore.graphs.abstractions import (
    Abstraction,
    Classes,
    GraphFeatures,
    abstraction_named,
    of_frames,
    without,
)
from sgstore.model.vocabulary import (
    RELATION_ALIASES,
    RELATIONS,
    kinds_labelled,
    labels,
    natural,
    suggestion,
)
from sgstore.store._engine_errors import translated
from sgstore.store._graphs import Graphs
from sgstore.store._traces import FrameRef, frame_named, stored_traces

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.graphs.abstractions import Labelled
    from sgstore.store._file import StoreFile
    from sgstore.store._traces import StoredTrace


@dataclass(frozen=True, slots=True)
class SimilarFrames:
    """Run of consecutive frames of a trace that are equally similar to the example frame of a search.

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
        return f"<SimilarFrames from {first!r}: {self.frames} frames, similarity {self.similarity:.3g}>"


@dataclass(slots=True)
class _FrameRun:
    """Run of consecutive frames of a trace with equal graph features and equal similarity to the example.

    If the frames match all features, their class is equal, too.
    """

    key: tuple[Any, ...]
    similarity: float
    same: bool | None
    trace: int
    seq: int
    frames: int
    features: Counter[str]


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

        Memory does not grow with the store: graphs are read window by window.

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
        abstraction, graphs = abstraction_named(example.abstraction), Graphs()
        search = _RunSearch(example, max(limit, 0), each_trace=each_trace)
        first, last = example.beside
        beside = range(first, last + 1) if each_trace else range(0)
        with translated(file.path), file.access.reading() as connection:
            traces = stored_traces(connection)
            for number, trace in enumerate(traces):
                left_out = beside if trace.trace_id == example.trace_id else range(0)
                for seq, block in _blocks(connection, graphs, trace, abstraction):
                    search.look(number, seq, without(block, example.ignored), left_out)
            search.close()
            return [_like(connection, run, traces, search.example) for run in search.best()]

    @staticmethod
    def best(found: Iterable[SimilarFrames], limit: int) -> list[SimilarFrames]:
        """Return the most similar runs of frames from several stores, as from one combined store."""

        def place(one: SimilarFrames) -> tuple[Any, ...]:
            likeness = one.similarity + (one.same is True)
            return -likeness, natural(one.frame.trace), one.frame.seq

        return sorted(found, key=place)[:limit]


BESIDE_S: Final = 5.0
"""Frames of the same trace within this time are near the example, and similar for that reason; s."""


def _blocks(
    connection: DuckDBPyConnection, graphs: Graphs, trace: StoredTrace, abstraction: Abstraction
) -> Iterator[tuple[NDArray[np.int64], Labelled]]:
    for seq, seen in graphs.of_trace(connection, trace.trace_id):
        yield seq, abstraction.function(seen)


def _beside(connection: DuckDBPyConnection, frame: FrameRef) -> tuple[int, int]:
    """Return the numbers of the first and last frame close in time to a given frame."""
    sql = "SELECT min(seq), max(seq) FROM frames WHERE trace_id = ? AND abs(t - ?) < ?"
    found = connection.execute(sql, [frame.trace_id, frame.t, BESIDE_S]).fetchone()
    return found or (0, -1)


class _RunSearch:
    """Collector of the frame runs most similar to an example frame, overall or per trace."""

    def __init__(self, example: Example, limit: int, *, each_trace: bool) -> None:
        self.example = Counter(example.features)
        self._classes = Classes()
        self._class = example.graph_class
        self._limit = limit
        self._each: dict[int, tuple[float, int, int, _FrameRun]] | None = {} if each_trace else None
        self._heap: list[tuple[float, int, int, _FrameRun]] = []
        self._last: _FrameRun | None = None

    def look(
        self, trace: int, seq: NDArray[np.int64], graphs: Labelled, left_out: range = range(0)
    ) -> None:
        """Compare the next frames of a trace with the example frame. Some frame numbers can be excluded."""
        features = GraphFeatures.of(graphs)
        likeness, digest = features.likeness(self.example), features.digests()
        same: list[bool | None] = [False] * graphs.frames
        complete = likeness == 1
        if complete.any():
            classes = self._classes.of(of_frames(graphs, complete))
            for i in np.flatnonzero(complete).tolist():
                same[i] = classes[i] == self._class if classes[i] and self._class else None
        alike = (digest[1:] == digest[:-1]) & (np.diff(seq) == 1)
        alike &= np.array([a is b for a, b in pairwise(same)], np.bool_)
        out = (seq >= left_out.start) & (seq < left_out.stop)
        alike &= out[1:] == out[:-1]
        starts = np.flatnonzero(np.append(True, ~alike))
        for start, end in zip(starts.tolist(), [*starts.tolist()[1:], len(seq)], strict=True):
            if out[start]:
                self.close()
                continue
            key = (trace, int(digest[start]), same[start])
            last = self._last
            if last is not None and last.key == key and last.seq + last.frames == seq[start]:
                last.frames += end - start
                continue
            self.close()
            counts = Counter[str]()
            if self._wanted(trace, float(likeness[start])):
                counts = features.counts(start)
            self._last = _FrameRun(
                key,
                float(likeness[start]),
                same[start],
                trace,
                int(seq[start]),
                end - start,
                counts,
            )

    def close(self) -> None:
        """End the current run of frames. Keep it if it is among the most similar runs so far."""
        run, self._last = self._last, None
        if run is None or not self._wanted(run.trace, run.similarity):
            return
        # Among equally similar runs, a later one ranks lower.
        entry = (run.similarity + (run.same is True), -run.trace, -run.seq, run)
        if self._each is not None:
            if run.trace not in self._each or entry > self._each[run.trace]:
                self._each[run.trace] = entry
        elif len(self._heap) < self._limit:
            heappush(self._heap, entry)
        elif entry > self._heap[0]:
            heapreplace(self._heap, entry)

    def _wanted(self, trace: int, similarity: float) -> bool:
        if self._each is not None:
            best = self._each.get(trace)
            return best is None or similarity + (similarity == 1) > best[0]
        if len(self._heap) < self._limit:
            return True
        return bool(self._limit) and similarity + (similarity == 1) > self._heap[0][0]

    def best(self) -> list[_FrameRun]:
        """Return the runs of frames most similar to the example, in descending order of similarity."""
        every = self._heap if self._each is None else self._each.values()
        ordered = sorted(every, key=lambda e: e[:-1], reverse=True)
        return [entry[-1] for entry in ordered[: self._limit]]


def _like(
    connection: DuckDBPyConnection,
    run: _FrameRun,
    traces: Sequence[StoredTrace],
    example: Counter[str],
) -> SimilarFrames:
    frame = frame_named(connection, f"{traces[run.trace].name}#{run.seq}")
    return SimilarFrames(
        frame=frame,
        frames=run.frames,
        similarity=run.similarity,
        same=run.same,
        shared=_sorted(example & run.features),
        missing=_sorted(example - run.features),
        extra=_sorted(run.features - example),
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
            raise AbstractionError(f"nothing to ignore is called {name!r}{hint}")
