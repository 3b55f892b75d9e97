"""What is to be exported: clips of a store, and the frames in them with their labels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters.clips import Source
from sgstore.store.covering import SEQ_BITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sgstore.exporters.labels import Labels
    from sgstore.query import Store
    from sgstore.store import StoredTrace
    from sgstore.world import Clip, Ints

WINDOW: Final = 240
"""Frames that are read from the store at once, as columns."""
FEW: Final = 60
"""The same, where single graphs are made of them: records take ten times the space of columns."""

_FRAMES: Final = """
SELECT frame_id, seq, time_ns, log_time_ns, t FROM frames
WHERE frame_id >= $first AND frame_id <= $last AND log_time_ns >= $start AND log_time_ns <= $end
ORDER BY frame_id
"""


@dataclass(frozen=True, slots=True)
class Export:
    """An export: which clips of which store, and how.

    Attributes
    ----------
    store : Store
    clips : tuple of Clip
        Log times, both ends included; intervals may overlap.
    labels : Labels, optional
        Values of the frames, by name; see :mod:`sgstore.exporters.labels`.
    abstraction : str
        What the graphs are seen as; empty: as the format has it by itself.
    with_graph : bool
        Whether clips of recordings bring the scene graphs with them.
    channels : tuple of str
        Topics of the sensors that are wanted; empty: all.
    clouds : str
        What clouds of points are written as: ``pcd``, ``npy`` or ``bin``.
    provenance : mapping
        What is to be known of it: ``query``, and whatever else the caller has.
    progress : callable, optional
        Called with the number of frames done and of all.
    """

    store: Store
    clips: tuple[Clip, ...]
    labels: Labels | None = None
    abstraction: str = ""
    with_graph: bool = False
    channels: tuple[str, ...] = ()
    clouds: str = "pcd"
    provenance: Mapping[str, str] = field(default_factory=dict[str, str])
    progress: Callable[[int, int], None] | None = None

    def sources(self) -> dict[str, Source]:
        """The recordings of the traces of the clips."""
        traces = {clip.trace: self.trace(clip.trace) for clip in self.clips}
        return {
            name: Source(trace.path, trace.digest, self.store.file.context(name))
            for name, trace in traces.items()
        }

    def trace(self, name: str) -> StoredTrace:
        """A trace of the store."""
        return self.store.file.trace(name)

    def frames(self) -> Iterator[ClipFrames]:
        """The frames of the clips, clip by clip; a frame comes with each clip that it is in.

        Raises
        ------
        ExportError
            There is no frame in a clip.
        """
        for number, clip in enumerate(self.clips, 1):
            frames = ClipFrames.of(self, number, clip)
            if not len(frames):
                raise ExportError(
                    f"no frame of {clip.trace!r} between {clip.start_ns} and {clip.end_ns} ns"
                )
            yield frames

    def windows(self, size: int = WINDOW) -> Iterator[ClipFrames]:
        """The frames of the clips, at most ``size`` at a time, of one clip each; tells the progress."""
        for frames in self.frames():
            yield from frames.windows(size)
            self.tell(frames.number, len(self.clips))

    def fresh_windows(self) -> Iterator[ClipFrames]:
        """As :meth:`windows`, but a frame comes with the first clip alone that it is in."""
        for frames in self.windows():
            time = frames.log_time_ns
            known = np.zeros(len(frames), np.bool_)
            for clip in self.clips[: frames.number - 1]:
                if clip.trace == frames.clip.trace:
                    known |= (time >= clip.start_ns) & (time <= clip.end_ns)
            if not known.all():
                yield frames.take(np.flatnonzero(~known))

    def tell(self, done: int, of: int) -> None:
        """Tell how far it is."""
        if self.progress is not None:
            self.progress(done, of)

    def label_columns(self, frame_id: Ints) -> dict[str, list[Any]]:
        """The labels of frames, by name."""
        return {} if self.labels is None else self.labels.of(frame_id)

    def about(self) -> dict[str, Any]:
        """What a manifest tells of it: clips, labels, and where all comes from."""
        traces = {clip.trace: self.trace(clip.trace) for clip in self.clips}
        return {
            "clips": [
                {
                    "trace": clip.trace,
                    "start_ns": clip.start_ns,
                    "end_ns": clip.end_ns,
                    "source": traces[clip.trace].path.name,
                    "source_sha256": traces[clip.trace].digest,
                }
                for clip in self.clips
            ],
            "labels": {} if self.labels is None else dict(self.labels.texts),
            "provenance": dict(self.provenance),
        }


@dataclass(frozen=True, slots=True)
class ClipFrames:
    """Frames of a clip, in order of their numbers; shape (n,).

    Attributes
    ----------
    number : int
        Of the clip in its export, counted from 1.
    clip : Clip
    frame_id, seq, time_ns, log_time_ns : int64
    t : float64
        Since the trace began; s.
    """

    number: int
    clip: Clip
    frame_id: Ints
    seq: Ints
    time_ns: Ints
    log_time_ns: Ints
    t: np.ndarray[Any, np.dtype[np.float64]]

    @classmethod
    def of(cls, export: Export, number: int, clip: Clip) -> ClipFrames:
        """The frames of the trace of a clip whose log times lie in it."""
        trace_id = export.trace(clip.trace).trace_id
        found = export.store.file.arrays(
            _FRAMES,
            {
                "first": trace_id << SEQ_BITS,
                "last": (trace_id + 1 << SEQ_BITS) - 1,
                "start": clip.start_ns,
                "end": clip.end_ns,
            },
        )
        return cls(
            number,
            clip,
            frame_id=found["frame_id"].astype(np.int64),
            seq=found["seq"].astype(np.int64),
            time_ns=found["time_ns"].astype(np.int64),
            log_time_ns=found["log_time_ns"].astype(np.int64),
            t=found["t"].astype(np.float64),
        )

    def __len__(self) -> int:
        return len(self.frame_id)

    def take(self, rows: slice | Ints) -> ClipFrames:
        """Some of them, in their order."""
        columns = ("frame_id", "seq", "time_ns", "log_time_ns", "t")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def windows(self, size: int = WINDOW) -> Iterator[ClipFrames]:
        """All of them, ``size`` at a time."""
        for start in range(0, len(self), size):
            yield self.take(slice(start, start + size))

    @property
    def bounds(self) -> dict[str, int]:
        """The first and the last ``frame_id``, as values of ``$first`` and ``$last``."""
        return {"first": int(self.frame_id[0]), "last": int(self.frame_id[-1])}
