"""Clips of an export from a store, with the frames of each clip."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import safe_name
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.model.world import tolerance_ns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sgstore.exporters._labels import Labels
    from sgstore.exporters._transforms import Mount
    from sgstore.model.world import Clip, Ints
    from sgstore.query import Store
    from sgstore.store import StoredTrace


WINDOW: Final = 240
"""Number of frames that are read from the store at once as columns."""

FEW: Final = 60
"""Number of frames that are read at once as single graphs. These need ten times the memory of columns."""

_FRAMES: Final = """
SELECT frame_id, seq, time_ns, log_time_ns, t FROM frames
WHERE frame_id >= $first AND frame_id <= $last AND log_time_ns >= $start AND log_time_ns <= $end
ORDER BY frame_id
"""


_TYPES: Final[dict[str, Any]] = {
    **dict.fromkeys(("frame_id", "seq", "time_ns", "log_time_ns"), np.int64),
    "t": np.float64,
}
"""Types of the columns of :class:`ClipFrames`."""


@dataclass(frozen=True, slots=True)
class Export:
    """Export from a store: the clips, the labels of their frames, and the options.

    Attributes
    ----------
    store : Store
    clips : tuple of Clip
        Log times, both ends included; intervals may overlap.
    labels : Labels, optional
        Values of the frames, by name; see :mod:`sgstore.exporters._labels`.
    abstraction : str
        Abstraction of the graphs; empty means the default of the format.
    with_graph : bool
        True if clips of recordings include the scene graphs.
    mounts : tuple of Mount
        Poses of sensors, for clips with graphs; see :func:`sgstore.exporters.parse_mounts`.
    rebase_context : bool
        True if context messages from outside a clip get log times at its ends.
    graphml : bool
        True for additional GraphML files of networkx graphs, one per frame.
    channels : tuple of str
        Topics of the wanted sensors; empty means all.
    clouds : str
        File format of point clouds: ``pcd``, ``npy`` or ``bin``.
    storage : str
        Oldest version of DuckDB that can read a DuckDB file.
    crs : str
        Coordinate system of the road maps for GeoJSON, such as ``EPSG:32632``; empty means their own.
    provenance : mapping
        Values about the origin: ``query``, and others of the caller.
    progress : callable, optional
        Called with the number of finished frames and the total.
    """

    store: Store
    clips: tuple[Clip, ...]
    labels: Labels | None = None
    abstraction: str = ""
    with_graph: bool = False
    mounts: tuple[Mount, ...] = ()
    rebase_context: bool = False
    graphml: bool = False
    channels: tuple[str, ...] = ()
    clouds: str = "pcd"
    storage: str = "v1.0.0"
    crs: str = ""
    provenance: Mapping[str, str] = field(default_factory=dict[str, str])
    progress: Callable[[int, int], None] | None = None

    def trace(self, name: str) -> StoredTrace:
        """Return the trace of the store with a name."""
        return self.store.file.trace(name)

    def frames(self) -> Iterator[ClipFrames]:
        """Yield the frames of each clip. A frame in several clips occurs several times.

        Raises
        ------
        ExportError
            A clip has no frames.
        """
        for number, (clip, own) in enumerate(zip(self.clips, self.own_numbers(), strict=True), 1):
            frames = replace(ClipFrames.of(self, number, clip), own=own)
            if not len(frames):
                raise ExportError(
                    f"no frame of {clip.trace!r} between {clip.start_ns} and {clip.end_ns} ns"
                )
            yield frames

    def own_numbers(self) -> list[int]:
        """Return the number of each clip among the clips of its trace, counted from 1."""
        seen = Counter[str]()
        numbers: list[int] = []
        for clip in self.clips:
            name = safe_name(clip.trace, "clip").lower()  # names of files must differ
            seen[name] += 1
            numbers.append(seen[name])
        return numbers

    def windows(self, size: int = WINDOW) -> Iterator[ClipFrames]:
        """Yield the frames of all clips in groups of ``size`` frames, and report the progress."""
        for frames in self.frames():
            yield from frames.windows(size)
            self.tell(frames.number, len(self.clips))

    def fresh_windows(self) -> Iterator[ClipFrames]:
        """Yield groups of frames of all clips. A frame in several clips is included once, in its first clip."""
        for frames in self.windows():
            time = frames.log_time_ns
            slack = tolerance_ns(self.trace(frames.clip.trace).period_ns)
            known = np.zeros(len(frames), np.bool_)
            for clip in self.clips[: frames.number - 1]:
                if clip.trace == frames.clip.trace:
                    reach = clip.widened(slack)
                    known |= (time >= reach.start_ns) & (time <= reach.end_ns)
            if not known.all():
                yield frames.take(np.flatnonzero(~known))

    def tell(self, done: int, of: int) -> None:
        """Report the progress of the export to the caller."""
        if self.progress is not None:
            self.progress(done, of)

    def named_graphs(
        self, frames: ClipFrames, abstraction: str
    ) -> Iterator[tuple[dict[str, str], list[tuple[str, str, str]]]]:
        """Yield the graph of each frame in an abstraction: labels of nodes by name, and edges between names."""
        found, _, graphs = self.store.file.abstracted.frames(abstraction, **frames.bounds)
        for row in np.searchsorted(found, frames.seq).tolist():
            yield graphs.named(row)

    def label_columns(self, frame_id: Ints) -> dict[str, list[Any]]:
        """Return the labels of the given frames: label name → column of values."""
        return {} if self.labels is None else self.labels.of(frame_id)

    def label_types(self) -> dict[str, str]:
        """For each label, return the narrowest database type that can hold all of its values."""
        if self.labels is None:
            return {}
        return {name: _type_of(values.tolist()) for name, values in self.labels.values.items()}

    def label_cells(self, frame_id: Ints) -> Iterator[list[Any]]:
        """Yield the labels of each frame as a list of CSV cells."""
        columns = self.label_columns(frame_id).values()
        for values in zip(*columns, strict=True) if columns else [()] * len(frame_id):
            yield [
                "" if v is None else str(v).lower() if isinstance(v, bool) else v for v in values
            ]

    def about(self) -> dict[str, Any]:
        """Return the content of the manifest file: clips, recordings, labels and the origin of the export."""
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
    """Frames of a clip as columns (n,), ordered by frame number.

    Attributes
    ----------
    number : int
        Number of the clip in its export, from 1.
    clip : Clip
    frame_id, seq, time_ns, log_time_ns : int64
    t : float64
        Time since the start of the trace; s.
    own : int
        Number among the clips of its trace, from 1, for names of files.
    """

    number: int
    clip: Clip
    frame_id: Ints
    seq: Ints
    time_ns: Ints
    log_time_ns: Ints
    t: np.ndarray[Any, np.dtype[np.float64]]
    own: int = 0

    @classmethod
    def of(cls, export: Export, number: int, clip: Clip) -> ClipFrames:
        """Return the frames of a trace whose log times are within a clip."""
        trace = export.trace(clip.trace)
        trace_id, reach = trace.trace_id, clip.widened(tolerance_ns(trace.period_ns))
        found = export.store.file.arrays(
            _FRAMES,
            {
                "first": trace_id << SEQ_BITS,
                "last": (trace_id + 1 << SEQ_BITS) - 1,
                "start": reach.start_ns,
                "end": reach.end_ns,
            },
        )
        columns: dict[str, Any] = {name: found[name].astype(of) for name, of in _TYPES.items()}
        return cls(number, clip, **columns)

    def __len__(self) -> int:
        return len(self.frame_id)

    def take(self, rows: slice | Ints) -> ClipFrames:
        """Return the frames at the given indices."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _TYPES})

    def windows(self, size: int = WINDOW) -> Iterator[ClipFrames]:
        """Yield the frames of the clip in groups of ``size`` frames."""
        for start in range(0, len(self), size):
            yield self.take(slice(start, start + size))

    @property
    def bounds(self) -> dict[str, int]:
        """Return the ids of the first and last frame as SQL parameters ``$first`` and ``$last``."""
        return {"first": int(self.frame_id[0]), "last": int(self.frame_id[-1])}


def _type_of(values: Sequence[Any]) -> str:
    known = {type(value) for value in values} - {type(None)}
    if known <= {bool}:
        return "BOOLEAN"
    if known <= {int}:
        return "BIGINT"
    return "DOUBLE" if known <= {int, float} else "VARCHAR"
