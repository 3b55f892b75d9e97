"""Ingest of one recording: for each ego, the scene graphs are written to a segment (file of one trace).

Types for the progress and the outcome of an ingest.

The function ``main`` runs in a worker process (:mod:`sgstore.base.processes`). Its first request is
the job, each further one a recording. Its replies are progress and outcomes.
"""

from __future__ import annotations

import json
import time
import traceback
from array import array
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from sgstore import errors
from sgstore.base.display import number_of
from sgstore.base.logs import logger
from sgstore.base.processes import requests, send_reply
from sgstore.errors import SgstoreError, TraceError, failure, place_named
from sgstore.graphs.relations import Crowds, renamed
from sgstore.maps.map_files import Maps, lost_lanes
from sgstore.mcap import Findings, Loss, check_name, near
from sgstore.model.config import ALL_EGOS, Config, from_dict
from sgstore.model.trace_sampling import TracePart
from sgstore.model.vocabulary import KIND_CODE, KINDS, VEHICLES, kinds_labelled
from sgstore.model.world import covered_s, longest_step_ns
from sgstore.pipeline.plausibility import Plausibility
from sgstore.readers import TopicReading, on_map, open_trace
from sgstore.sgg import SceneGraphGenerator, map_of_graphs
from sgstore.store import Identity, OnMap, Segment, StoreFile

_log = logger("segments")

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import Codes, FrameBlock, Ints, TraceInfo
    from sgstore.readers import MessageTrace


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of an ingest: within the current recording, and in total.

    Attributes
    ----------
    path : Path
    frames : int
        Frames done of this recording.
    bytes_done, size : int
        Bytes read of the file (approximate), and its size.
    all_frames, all_bytes, all_size : int
        The same numbers, summed over all recordings.
    files_done, files : int
        Recordings done, and their total number.
    """

    path: Path
    frames: int
    bytes_done: int
    size: int
    all_frames: int = 0
    all_bytes: int = 0
    all_size: int = 0
    files_done: int = 0
    files: int = 1


@dataclass(slots=True, repr=False)
class TraceOutcome:
    """Result of the ingest of one recording for one ego: status, trace name, losses or error.

    Attributes
    ----------
    path : Path
    status : str
        ``added``; ``replaced``: read again; ``present``: the store already had the trace with the same
        settings; ``new``: a real run would add it (dry run); ``failed``.
    name : str
        Name of the trace in the store; empty if it failed.
    ego : str
        The simulator's id of the ego; empty without a known ego.
    frames : int
    entities : dict
        Number of entities by kind, in and out of range.
    unknown_types : dict
        Number of entities by type name, for type names without a mapping.
    clock_jumps, gaps : int
        Number of backward steps of the recording's clock, and of steps longer than 2.5 periods.
    seconds : float
        Duration of the ingest; s.
    warnings : list of str
        Oddities without loss of data.
    losses : list of Loss
        Unusable parts of the recording.
    scope : dict
        Number of states cut by the settings, as in the report of the trace; empty if it failed.
    other : str
        Ego of the trace that has the plain name, if it is from the same recording.
    error : SgstoreError or None
        Reason of the failure.
    """

    path: Path
    status: str = "failed"
    name: str = ""
    ego: str = ""
    frames: int = 0
    entities: dict[str, int] = field(default_factory=dict[str, int])
    unknown_types: dict[str, int] = field(default_factory=dict[str, int])
    clock_jumps: int = 0
    gaps: int = 0
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])
    scope: dict[str, Any] = field(default_factory=dict[str, Any])
    other: str = ""
    error: SgstoreError | None = None

    def __repr__(self) -> str:
        about = f"{number_of(self.frames, 'frame')}, {number_of(len(self.losses), 'loss', 'es')}"
        about = str(self.error) if self.error else about
        return f"<TraceOutcome {self.name or self.path.name!r}: {self.status}, {about}>"

    @property
    def taken_name(self) -> str:
        """If a trace was renamed because its name was taken, the taken name; otherwise empty."""
        name, _, number = self.name.rpartition("~")
        renamed = self.status == "added" and self.name != self.path.stem
        return name if renamed and number.isdecimal() else ""

    def as_dict(self) -> dict[str, Any]:
        """Return the result of an ingest as JSON values; :meth:`from_dict` is the inverse."""
        told = {"class": type(self.error).__name__, "message": str(self.error)}
        return asdict(self) | {
            "path": place_named(self.path),
            "error": told if self.error else None,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the ingest result that a JSON object contains. Errors keep their class and message."""
        told = values["error"]
        error = getattr(errors, told["class"])(told["message"]) if told else None
        changed: dict[str, Any] = {
            "path": Path(values["path"]),
            "error": error,
            "losses": [Loss(**loss) for loss in values["losses"]],
        }
        return cls(**(values | changed))


# Settings of a run, as a value for another process.


@dataclass(frozen=True, slots=True)
class Job:
    """Settings for the ingest of recordings. Worker processes receive them.

    Attributes
    ----------
    store : Path
        The store; the file may be missing.
    road_map : Path or None
        A file, or a folder of them; see :class:`sgstore.maps.map_files.Maps`.
    config : Config
    part : TracePart
        Time span and rate of the frames to read.
    force : bool
        Read recordings again that the store already contains.
    dry_run : bool
        Only report the outcomes; write nothing.
    block_frames : int
        Frames per block.
    """

    store: Path
    road_map: Path | None = None
    config: Config = field(default_factory=Config)
    part: TracePart = field(default_factory=TracePart)
    force: bool = False
    dry_run: bool = False
    block_frames: int = 120

    def as_dict(self) -> dict[str, Any]:
        """Return the ingest settings as JSON values; :meth:`from_dict` is the inverse."""
        return {
            "store": str(self.store),
            "road_map": None if self.road_map is None else str(self.road_map),
            "config": self.config.as_dict(),
            "part": [self.part.since, self.part.until, self.part.rate],
            "force": self.force,
            "dry_run": self.dry_run,
            "block_frames": self.block_frames,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the ingest settings that a JSON object contains."""
        road_map = values["road_map"]
        changed: dict[str, Any] = {
            "store": Path(values["store"]),
            "road_map": None if road_map is None else Path(road_map),
            "config": from_dict(values["config"]),
            "part": TracePart(*values["part"]),
        }
        return cls(**(values | changed))


# Counters during the reading of a trace: frames, entities by kind, steps of the clock.

SHOWN: Final = 20
"""Largest number of jumps and gaps that a report lists. Further ones are counted."""

_CANDIDATES: Final = 5
"""Largest number of vehicles that a warning about a missing ego lists."""


@dataclass(slots=True)
class TraceTally:
    """Counts of frames and entities of a trace during an ingest, with the times of its frames.

    Attributes
    ----------
    frames : int
    kinds : Counter
        Number of entities by kind code.
    times : array
        Simulation times of the frames, 8 bytes each; ns.
    checked : Plausibility
        Check for implausible data.
    noise : float
        Noise of the positions; m.
    present : dict or None
        Vehicles in all frames so far: node id → id and kind. Empty with an ego; None before the first frame.
    """

    frames: int = 0
    noise: float = 0.0
    present: dict[int, str] | None = None
    kinds: Counter[int] = field(default_factory=Counter[int])
    times: array[int] = field(default_factory=lambda: array("q"))
    checked: Plausibility = field(default_factory=Plausibility)

    def see(self, frames: FrameBlock) -> None:
        """Add a block of frames to the counts of the trace."""
        self.frames += len(frames)
        self.noise = frames.noise
        self.kinds.update(frames.entities.kind.tolist())
        self.times.frombytes(frames.time_ns.astype(np.int64).tobytes())
        self.checked.see(frames)
        if self.present != {} and len(frames):
            self._keep_present(frames)

    def _keep_present(self, frames: FrameBlock) -> None:
        """Remove the vehicles that are not in all frames of a block."""
        if self.present is None:
            new = frames.entities
            called = zip(new.ident, (KINDS[code] for code in new.kind.tolist()), strict=True)
            self.present = {
                node: f"{ident} ({kind})"
                for node, (ident, kind) in enumerate(called, start=new.first)
                if kind in VEHICLES
            }
        nodes, counts = np.unique(frames.states.node, return_counts=True)
        whole = set() if (frames.ego >= 0).any() else {*nodes[counts == len(frames)].tolist()}
        self.present = {node: text for node, text in self.present.items() if node in whole}

    @property
    def ego_hint(self) -> str:
        """Remedy for a missing ego: the option, and the vehicles that are present in all frames."""
        known = [*(self.present or {}).values()]
        more = f", … ({len(known)} in all)" if len(known) > _CANDIDATES else ""
        listed = f"in all frames: {', '.join(known[:_CANDIDATES])}{more}"
        return f"name the ego with --ego ID; {listed if known else 'no vehicle is in all frames'}"

    @property
    def entities(self) -> dict[str, int]:
        """Number of entities of the trace by kind, in the order of the vocabulary."""
        return {KINDS[code]: self.kinds[code] for code in sorted(self.kinds)}

    @property
    def seconds(self) -> float:
        """Duration of the trace; s. See :func:`sgstore.model.world.covered_s`."""
        if not self.times:
            return 0.0
        steps = np.sort(np.diff(np.frombuffer(self.times, np.int64)))
        period = int(steps[(len(steps) - 1) // 2]) if len(steps) else 0
        return covered_s(self.times[0], self.times[-1], self.frames, period)

    def as_dict(self) -> dict[str, Any]:
        """Return the counts of the trace as JSON values.

        Returns
        -------
        dict
            ``entities``; ``noise`` of the positions, if not 0 (m); ``clock_jumps``: number of backward steps of
            the clock; ``gaps``: number of steps longer than 2.5 median periods; ``clock_jumps_at``,
            ``gaps_at``: the first ones, each with the number of the frame after the step (``seq``), its time
            since the start of the trace (``t``), and the step (``seconds``).
        """
        times = np.frombuffer(self.times, np.int64)
        steps = np.diff(times)
        forward = steps[steps > 0]
        period = float(np.median(forward)) if len(forward) else 0.0
        report: dict[str, Any] = {"entities": self.entities}
        if self.noise:
            report["noise"] = self.noise
        longest = longest_step_ns(int(max(period, 1)))
        for name, found in (("clock_jumps", steps < 0), ("gaps", steps > longest)):
            rows = np.flatnonzero(found)
            report[name] = len(rows)
            report[f"{name}_at"] = [
                {
                    "seq": row + 1,
                    "t": int(times[row + 1] - times[0]) / 1e9,
                    "seconds": int(steps[row]) / 1e9,
                }
                for row in rows[:SHOWN].tolist()
            ]
        return report


# One recording → sealed segments, one per ego.

EGOS_AT_ONCE: Final = 8
"""Number of egos that one pass over a recording processes. Each ego needs the memory of one segment."""

_VEHICLES: Final = np.array([KIND_CODE[kind] for kind in kinds_labelled("Vehicle") or ()])


@dataclass(slots=True)
class _EgoView:
    """State of an ingest for one of the recording's egos: its segment and its result.

    Attributes
    ----------
    outcome : TraceOutcome
    info : TraceInfo
        Facts of the recording, with this ego.
    sealed : Path or None
        Folder of the segment; ``None`` means not built.
    nodes : list of int
        Node ids of the ego; each frame has at most one of them.
    met : bool
        True if a frame contains the ego.
    crowds : Crowds
        Frames with too many pairs.
    """

    outcome: TraceOutcome
    info: TraceInfo
    sealed: Path | None = None
    nodes: list[int] = field(default_factory=list[int])
    met: bool = False
    crowds: Crowds = field(default_factory=Crowds)


class SegmentReader:
    """Ingest of recordings, one after another. For each ego, it writes a segment (file of one trace).

    Parameters
    ----------
    job : Job
    on_block : function
        Called after every block with the frames done, the bytes of the file read (approximate), and its size.

    Raises
    ------
    MapError
        The road map of the job cannot be read.
    """

    def __init__(self, job: Job, on_block: Callable[[int, int, int], None]) -> None:
        self._job = job
        self._on_block = on_block
        self._maps = Maps(job.road_map, job.config.signs)
        self._file: StoreFile | None = None
        self._on_map: OnMap | None = None

    def read(self, path: Path, folder: Path) -> list[tuple[TraceOutcome, Path | None]]:
        """Read a recording, and write a segment (file of one trace) for each ego into ``folder``.

        ``folder`` is created if needed. The result has one entry per ego: the outcome, and the folder of the
        segment or ``None``.
        """
        start = time.perf_counter()
        views: list[_EgoView] = []
        failed: SgstoreError | None = None
        present: TraceOutcome | None = None
        try:
            check_name(path)
            with near(path, folder / "copy"):
                present = self._present(path)
                if present is None:
                    self._read(path, folder, views)
        except Exception as error:  # noqa: BLE001  the other recordings must still be read
            failed = failure(error, path)
            if failed is not error:
                _log.debug("%s: %s", path, traceback.format_exc())
        found = [(view.outcome, view.sealed) for view in views]
        found = found or [(present or TraceOutcome(path), None)]
        for outcome, _ in found:
            if outcome.status == "failed" and outcome.error is None:
                outcome.error = failed
            outcome.seconds = time.perf_counter() - start
        return found

    def _store(self) -> StoreFile | None:
        """Return the store in which to look for existing traces; ``None`` if every recording must be read."""
        if self._file is None and self._job.store.exists():
            self._file = StoreFile(self._job.store)
        return None if self._job.force else self._file

    @cached_property
    def _request(self) -> str:
        """Return all inputs that determine a trace, as JSON. Empty if other files also affect the trace.

        A list of egos gives several traces. A folder of maps and a file of a mapping can change.
        """
        part, config, maps = self._job.part, self._job.config, self._maps
        if config.egos or config.mapping or maps.folder is not None:
            return ""
        parts = [part.since, part.until, part.rate]
        return json.dumps([version("sgstore"), config.as_dict(), maps.digest, parts])

    def _present(self, path: Path) -> TraceOutcome | None:
        """Return the result for a recording whose trace is in the store. The recording is not opened.

        ``None`` means not known: the file has changed, or the trace was read by another request.
        """
        store = self._store()
        found = store.requested(path, self._request) if store and self._request else None
        if found is None:
            return None
        name, ego, frames, report = found
        return TraceOutcome(path, "present", name, ego, frames, scope=report.get("scope", {}))

    def _read(self, path: Path, folder: Path, views: list[_EgoView]) -> None:
        job, config, store = self._job, self._job.config, self._store()
        digest = store.known_digest(path) if store else ""  # A known digest saves the hashing.
        with open_trace(path, ego=config.ego, digest=digest, mapping=config.mapping) as trace:
            trace.noise = config.noise
            _log.debug("%s: a recording of flavour %s", path, trace.info.flavour)
            if config.topics:
                TopicReading(trace.recording, config.topics)  # rejects unknown topics
            road_map, odd = self._maps.of(trace.info)
            lost = lost_lanes(trace.info, road_map)
            on_map(trace, road_map)
            wanted = [
                one
                for one in self._wanted(trace, views)
                if store is None or self._is_new(store, one, road_map)
            ]
            if store is not None and wanted:  # The publishing process can then write at once.
                store.close()
            if wanted and not job.dry_run:
                config = replace(config, exclude_ids=self._excluded(trace))
            for first in range(0, len(wanted), EGOS_AT_ONCE):
                group = wanted[first : first + EGOS_AT_ONCE]
                for one in group:
                    one.outcome.warnings += [*odd, *config.notes]
                    one.outcome.losses += lost
                    if job.dry_run:
                        one.outcome.status = "new"
                if not job.dry_run:
                    self._build(trace, group, road_map, config, folder / str(first))

    def _wanted(self, trace: MessageTrace, views: list[_EgoView]) -> Iterator[_EgoView]:
        """Yield the egos of a recording that the settings select. Unknown names get a result with an error."""
        info, egos = trace.info, self._job.config.egos
        if not egos:
            views.append(_EgoView(TraceOutcome(info.path, ego=info.ego), info))
            yield views[0]
            return
        everyone, seen = egos == (ALL_EGOS,), set[str]()
        for name in self._vehicles(trace) if everyone else egos:
            view = _EgoView(TraceOutcome(info.path, ego=name), info)
            try:
                found = name if everyone else self._ident(trace, name)
            except SgstoreError as error:
                view.outcome.error = error
                views.append(view)
                continue
            if found not in seen:  # Otherwise, two names mean the same ego.
                seen.add(found)
                view.outcome.ego, view.info = found, replace(info, ego=found)
                views.append(view)
                yield view

    def _excluded(self, trace: MessageTrace) -> tuple[str, ...]:
        """Return the ids of the entities that the settings exclude by role, name or id."""
        found: list[str] = []
        for name in self._job.config.exclude_ids:
            with suppress(SgstoreError):
                found.append(self._ident(trace, name))
            found.append(name)
        return tuple(dict.fromkeys(found))

    def _ident(self, trace: MessageTrace, name: str) -> str:
        """Return the id of an ego in a recording, given by its id, role or name."""
        info = trace.info
        try:
            found = trace.ego_named(name)
        except TraceError as error:
            raise TraceError(error.reason, path=info.path) from error
        if found is not None:
            return found
        mapping = self._job.config.mapping
        with open_trace(info.path, ego=name, digest=info.digest, mapping=mapping) as again:
            return again.info.ego

    def _vehicles(self, trace: MessageTrace) -> list[str]:
        """Return the ids of all vehicles of a recording, which can be egos."""
        found: list[str] = []
        for block in trace.blocks(self._job.block_frames):
            entities = self._meant(block).entities
            rows = np.flatnonzero(np.isin(entities.kind, _VEHICLES))
            found += [entities.ident[row] for row in rows.tolist()]
        if not found:
            raise TraceError("no vehicle in it can be the ego", path=trace.info.path)
        return found

    def _is_new(self, store: StoreFile, view: _EgoView, road_map: RoadMap | None) -> bool:
        """True if the store has no trace of this recording and ego. Otherwise, the result gets a new status."""
        job, outcome = self._job, view.outcome
        try:
            shown = map_of_graphs(road_map, job.config)
            name = store.stored(view.info, job.config, shown, (job.part.since, job.part.until))
        except SgstoreError as error:
            outcome.error = error
            return False
        if name is None:
            return True
        outcome.status, outcome.name = "present", name
        stored = store.trace(name)
        outcome.frames, outcome.scope = stored.frames, stored.report.get("scope", {})
        return False

    def _build(
        self,
        trace: MessageTrace,
        group: list[_EgoView],
        road_map: RoadMap | None,
        config: Config,
        folder: Path,
    ) -> None:
        """Write the segments of several egos in one pass over the recording."""
        job, size = self._job, self._job.block_frames
        generator = SceneGraphGenerator(road_map, config)
        tally = TraceTally(checked=Plausibility(road_map))
        blocks = job.part.blocks(map(self._meant, trace.blocks(size)), size)
        first = next(blocks, None)
        if first is None:
            raise TraceError("no frame of it can be read", path=trace.info.path)
        with ExitStack() as stack:
            segments: list[Segment] = []
            shown, part = map_of_graphs(road_map, job.config), (job.part.since, job.part.until)
            if self._on_map is None or self._on_map.road_map is not shown:
                self._on_map = OnMap(shown)
            for number, one in enumerate(group):
                one.sealed = folder.with_name(f"{folder.name}-{number}")
                one.sealed.mkdir(parents=True)
                identity = Identity.of(one.info, job.config, shown, part)
                place = (one.sealed, len(group))
                segment = Segment(
                    job.store,
                    one.info,
                    identity,
                    self._on_map,
                    generator.answers,
                    place=place,
                )
                segments.append(stack.enter_context(segment))
            kept = (_kept(segments, block) for block in chain([first], blocks))
            for block in generator.recorded(kept):
                self._append(generator, block, group, segments)
                tally.see(block)
                self._on_block(tally.frames, _reached(block, trace.info.size), trace.info.size)
            self._seal(trace, group, segments, tally, (generator.parked, generator.world_parked))

    def _append(
        self,
        generator: SceneGraphGenerator,
        block: FrameBlock,
        group: list[_EgoView],
        segments: list[Segment],
    ) -> None:
        egos = [block.ego]
        if self._job.config.egos:
            egos = [_ego_of(block, one) for one in group]
        for piece in generator.pieces(block, len(egos)):
            first = int(piece.seq[0] - block.seq[0]) if len(piece) else 0
            here = [ego[first : first + len(piece)] for ego in egos]
            graphs = generator.one_by_one(piece, here)
            for one, segment in zip(group, segments, strict=True):
                graph = next(graphs)
                one.crowds.see(graph)
                segment.append(graph)
                del graph  # Free this graph before the next one is built.

    def _seal(
        self,
        trace: MessageTrace,
        group: list[_EgoView],
        segments: list[Segment],
        tally: TraceTally,
        parked: Sequence[Codes],
    ) -> None:
        report, told, egos = trace.report, tally.as_dict(), self._job.config.egos
        if self._job.config.topics:
            report.losses += self._keep_topics(trace, segments)
        moot = [*report.about_ego] if egos else []
        found = tally.checked.findings(report)
        moot += [one.value for one in found]
        warnings = [warning for warning in report.warnings if warning not in moot]
        warnings += [str(one) for one in found if not (egos and one.kind == "ego missing")]
        if report.about_ego and not egos and not group[0].info.ego:
            warnings.append(tally.ego_hint)
        for one, segment in zip(group, segments, strict=True):
            outcome = one.outcome
            if egos and not one.met:
                reason = f"the ego {one.info.ego!r} is missing from all frames"
                outcome.error = TraceError(reason, path=one.info.path)
                continue
            outcome.frames = tally.frames
            outcome.entities = tally.entities
            outcome.clock_jumps, outcome.gaps = told["clock_jumps"], told["gaps"]
            outcome.unknown_types = self._job.config.unknown_of(report.unknown_types)
            outcome.warnings += warnings
            outcome.losses += [*report.losses, *one.crowds.losses(self._job.config)]
            kept = replace(report, warnings=outcome.warnings, losses=outcome.losses, about_ego=[])
            outcome.scope = segment.scope.get("scope", {})
            request = segment.identity.request(self._request)
            segment.seal(kept, told | {"request": request} if request else told, parked)
            outcome.status = "sealed"

    def _keep_topics(self, trace: MessageTrace, segments: Sequence[Segment]) -> list[Loss]:
        """Write the messages of the configured topics to the segments. Return the losses of these topics."""
        reading = TopicReading(trace.recording, self._job.config.topics)
        with ExitStack() as stack:
            writers = [stack.enter_context(segment.topics(reading)) for segment in segments]
            for batch in reading.batches(Findings()):
                for writer in writers:
                    writer.add(batch)
        return [
            Loss(f"topic {name!r}: {text}", bytes=0)
            for name, lost in reading.losses.items()
            for text in lost.texts()
        ]

    def _meant(self, block: FrameBlock) -> FrameBlock:
        """Return a block of frames with the kinds that the settings define for type names."""
        return replace(block, entities=renamed(block.entities, self._job.config.types))


def _kept(segments: Sequence[Segment], block: FrameBlock) -> FrameBlock:
    """Return a block in the form that a store keeps. It is equal for all egos."""
    kept, *_ = [segment.as_kept(block) for segment in segments]
    return kept


def _ego_of(block: FrameBlock, one: _EgoView) -> Ints:
    """Return the node id of the ego in each frame, (F,); -1 without it. Record if the ego occurred."""
    idents = enumerate(block.entities.ident, start=block.entities.first)
    one.nodes += [node for node, ident in idents if ident == one.info.ego]
    rows = np.isin(block.states.node, one.nodes)
    found = np.full(len(block), -1, np.int64)
    found[block.frame_of[rows]] = block.states.node[rows]
    one.met = one.met or bool(rows.any())
    return found


def _reached(frames: FrameBlock, size: int) -> int:
    """Return about how many bytes of the recording have been read."""
    messages = frames.messages
    places = np.where(messages.chunk_offset < 0, messages.offset, messages.chunk_offset)
    return min(int(places.max(initial=0)), size)


# Worker process that reads recordings for its parent.


def main() -> None:
    """Main function of a worker process that ingests recordings. The parent's first request is the job."""
    asked = requests()

    def on_block(frames: int, reached: int, size: int) -> None:
        send_reply({"frames": frames, "bytes": reached, "size": size, "more": True})

    reading = SegmentReader(Job.from_dict(next(asked)), on_block)
    for task in asked:
        views = reading.read(Path(task["path"]), Path(task["folder"]))
        send_reply({"done": [[one.as_dict(), sealed and str(sealed)] for one, sealed in views]})
