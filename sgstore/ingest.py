"""Recordings → store: read, make graphs, build aside, publish; one trace after another, block by block.

Memory does not grow with the length of a trace, and a trace is in the store with everything that belongs to
it or not at all. What cannot be read of one trace is said in its outcome and does not stop the others.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.config import Config
from sgstore.errors import MapError, SgstoreError, TraceError
from sgstore.opendrive import read_map
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile
from sgstore.traces import open_trace
from sgstore.vocabulary import KINDS
from sgstore.world import BUCKET_FRAMES, Loss

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sgstore.graph import GraphBlock
    from sgstore.roads import RoadMap
    from sgstore.traces import Trace
    from sgstore.world import FrameBlock

BLOCK_FRAMES: Final = 2 * BUCKET_FRAMES
"""Frames that are worked on at once: whole buckets, so that a mask is one row."""

MAX_MAP_BYTES: Final = 1 << 28
"""Largest file that is read as a road map."""

_SHOWN_WARNINGS: Final = 5
"""Defects of a road map that are named; the others are counted."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the work on a recording has come.

    Attributes
    ----------
    path : Path
    frames : int
        Frames done.
    bytes_done, size : int
        About how much of the file has been read, and its size.
    """

    path: Path
    frames: int
    bytes_done: int
    size: int


@dataclass(slots=True)
class TraceOutcome:
    """What became of a recording.

    Attributes
    ----------
    path : Path
    status : str
        ``added``; ``present``: the store had it already, read with the same settings; ``failed``.
    name : str
        Of the trace in the store; empty if it failed.
    frames : int
    entities : dict
        Kind → how many entities there are of it, in and out of range.
    unknown_types : dict
        Type names that no mapping knows → how many entities bear them.
    seconds : float
        How long it took.
    warnings : list of str
        What is odd but lost nothing.
    losses : list of Loss
        What of the recording could not be used.
    error : SgstoreError or None
        Why it failed.
    """

    path: Path
    status: str = "failed"
    name: str = ""
    frames: int = 0
    entities: dict[str, int] = field(default_factory=dict[str, int])
    unknown_types: dict[str, int] = field(default_factory=dict[str, int])
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])
    error: SgstoreError | None = None


def ingest(
    store: str | Path,
    traces: Sequence[str | Path],
    *,
    road_map: str | Path | None = None,
    config: Config | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> list[TraceOutcome]:
    """Read recordings into a store, which is made if there is none and something comes into it.

    Parameters
    ----------
    store : str or Path
    traces : sequence of str or Path
    road_map : str or Path, optional
        An OpenDRIVE file, for the recordings that carry no map of their own.
    config : Config, optional
    on_progress : function, optional
        Called after every block of frames.

    Returns
    -------
    list of TraceOutcome
        One for each recording, in the order given.

    Raises
    ------
    StoreError
        What is at the place of the store is none, or one of another version.
    MapError
        The file given for the road map cannot be read.
    """
    given = None if road_map is None else Path(road_map)
    run = _Run(Path(store), given, config or Config(), on_progress)
    return [run.outcome(Path(path)) for path in traces]


def read_map_file(path: Path) -> RoadMap:
    """The road map in an OpenDRIVE file.

    Raises
    ------
    MapError
        There is no such file, or it is no OpenDRIVE map.
    """
    try:
        if path.stat().st_size > MAX_MAP_BYTES:
            raise MapError(f"{path}: larger than {MAX_MAP_BYTES} bytes, which no road map is")
        text = _decoded(path.read_bytes())
    except (OSError, UnicodeDecodeError, LookupError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapError(f"{path}: cannot be read as an OpenDRIVE map: {reason}") from error
    try:
        return read_map(text, path.name)
    except MapError as error:
        raise MapError(f"{path}: {error}") from error


_ENCODING: Final = re.compile(rb"""\s*<\?xml[^>]{0,100}\sencoding=["']([A-Za-z0-9._-]{1,40})["']""")


def _decoded(content: bytes) -> str:
    """The text of an XML file in the encoding that it names, else UTF-8."""
    named = _ENCODING.match(content)
    if named and content[:2] not in {b"\xff\xfe", b"\xfe\xff"}:
        return content.decode(named[1].decode())
    return content.decode("utf-16" if content[:1] in {b"\xff", b"\xfe"} else "utf-8-sig")


class _Run:
    """One call of :func:`ingest`: what its traces share."""

    def __init__(
        self,
        path: Path,
        road_map: Path | None,
        config: Config,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self._path = path
        self._config = config
        self._on_progress = on_progress
        self._store = StoreFile(path) if path.exists() else None
        self._given = read_map_file(road_map) if road_map else None
        self._maps: dict[str, RoadMap | MapError] = {}

    def outcome(self, path: Path) -> TraceOutcome:
        """Read one recording."""
        outcome = TraceOutcome(path)
        start = time.perf_counter()
        try:
            with open_trace(path, ego=self._config.ego) as trace:
                self._read(trace, outcome)
        except SgstoreError as error:
            outcome.error = error
        outcome.seconds = time.perf_counter() - start
        return outcome

    def _read(self, trace: Trace, outcome: TraceOutcome) -> None:
        info = trace.info
        road_map = self._road_map(trace, outcome)
        if self._store is not None:
            name = self._store.stored(info, self._config, road_map)
            if name is not None:
                outcome.status, outcome.name = "present", name
                outcome.frames = self._store.trace(name).frames
                return
        generator = SceneGraphGenerator(road_map, self._config)
        blocks = trace.blocks(BLOCK_FRAMES)
        first = next(blocks, None)
        if first is None:
            raise TraceError("no frame of it can be read", path=info.path)
        self._store = self._store or StoreFile.create(self._path)
        with self._store.segment(
            info, self._config, road_map=road_map, answers=generator.answers
        ) as segment:
            while block := first or next(blocks, None):
                first = None
                graph = generator.block(segment.as_kept(block))
                segment.append(graph)
                self._note(trace, graph, outcome)
            report = trace.report
            outcome.warnings += report.warnings
            outcome.losses += report.losses
            outcome.unknown_types = report.unknown_types
            outcome.name = segment.publish(replace(report, warnings=outcome.warnings))
        outcome.status = "added"

    def _note(self, trace: Trace, graph: GraphBlock, outcome: TraceOutcome) -> None:
        frames = graph.frames
        counts = Counter(outcome.entities)
        counts.update(KINDS[code] for code in frames.entities.kind.tolist())
        outcome.entities = dict(counts)
        outcome.frames += len(frames)
        if self._on_progress is not None:
            size = trace.info.size
            self._on_progress(Progress(outcome.path, outcome.frames, _reached(frames, size), size))

    def _road_map(self, trace: Trace, outcome: TraceOutcome) -> RoadMap | None:
        """The map of a recording: its own, else the one that was given, else none."""
        info, road_map = trace.info, self._given
        if info.map_text:
            own = self._own_map(info.map_text, info.map_name)
            if isinstance(own, MapError):
                outcome.warnings.append(f"its road map cannot be read: {own}")
            else:
                road_map = own
        if road_map is None:
            outcome.warnings.append(
                "no road map: without road nodes and without relations that need them"
            )
            return None
        shown = road_map.warnings[:_SHOWN_WARNINGS]
        outcome.warnings += [f"road map {road_map.name}: {warning}" for warning in shown]
        more = len(road_map.warnings) - len(shown)
        if more:
            outcome.warnings.append(f"road map {road_map.name}: {more} more defects")
        return road_map

    def _own_map(self, text: str, name: str) -> RoadMap | MapError:
        if text not in self._maps:
            try:
                self._maps[text] = read_map(text, name)
            except MapError as error:
                self._maps[text] = error
        return self._maps[text]


def _reached(frames: FrameBlock, size: int) -> int:
    """About how much of a file has been read with a block."""
    messages = frames.messages
    places = np.where(messages.chunk_offset < 0, messages.offset, messages.chunk_offset)
    return min(int(places.max(initial=0)), size)
