"""One recording → sealed segments, one for each ego."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.config import ALL_EGOS
from sgstore.errors import SgstoreError, TraceError
from sgstore.ingest.maps import Maps
from sgstore.ingest.outcomes import TraceOutcome
from sgstore.ingest.tally import Tally
from sgstore.relations.keeping import renamed
from sgstore.sgg import SceneGraphGenerator, map_of_graphs
from sgstore.store import Segment, StoreFile, new_segment
from sgstore.traces import on_map, open_trace
from sgstore.vocabulary import KIND_CODE, kinds_labelled

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.ingest.jobs import Job
    from sgstore.roads import RoadMap
    from sgstore.traces import Trace
    from sgstore.world import Codes, FrameBlock, Ints, TraceInfo

EGOS_AT_ONCE: Final = 4
"""Egos whose graphs are built in one pass over a recording: each needs the memory of a segment."""

_VEHICLES: Final = np.array([KIND_CODE[kind] for kind in kinds_labelled("Vehicle") or ()])


@dataclass(slots=True)
class View:
    """A recording as one ego has it.

    Attributes
    ----------
    outcome : TraceOutcome
    sealed : Path or None
        Folder of its segment, if one was built.
    """

    outcome: TraceOutcome
    sealed: Path | None = None


@dataclass(slots=True)
class _Wanted:
    """A view that is to be read.

    What is known of the recording, with its ego; the ego's node id, once that is known; whether a frame had it.
    """

    view: View
    info: TraceInfo
    node: int = -1
    met: bool = False


class Reading:
    """Reads recordings, one after another.

    Parameters
    ----------
    job : Job
    on_block : function
        Called after every block with the frames done, about how many bytes of the file were read, and its size.

    Raises
    ------
    MapError
        The road map that is given cannot be read.
    """

    def __init__(self, job: Job, on_block: Callable[[int, int, int], None]) -> None:
        self._job = job
        self._on_block = on_block
        self._maps = Maps(job.road_map, job.config.signs)
        self._file: StoreFile | None = None

    def read(self, path: Path, folder: Path) -> list[View]:
        """Read a recording; segments are built in folders below the one that is given, which need not exist."""
        start = time.perf_counter()
        views: list[View] = []
        try:
            self._read(path, folder, views)
        except SgstoreError as error:
            views = views or [View(TraceOutcome(path))]
            for view in views:
                if view.outcome.status == "failed" and view.outcome.error is None:
                    view.outcome.error = error
        for view in views:
            view.outcome.seconds = time.perf_counter() - start
        return views

    def _read(self, path: Path, folder: Path, views: list[View]) -> None:
        job = self._job
        with open_trace(
            path,
            ego=job.config.ego,
            digest=self._known_digest(path),
            mapping=job.config.mapping,
        ) as trace:
            road_map, odd = self._maps.of(trace.info)
            on_map(trace, road_map)
            wanted = [one for one in self._wanted(trace, views) if self._is_new(one, road_map)]
            if job.dry_run:
                for one in wanted:
                    one.view.outcome.status = "new"
                    one.view.outcome.warnings += odd
                return
            for first in range(0, len(wanted), EGOS_AT_ONCE):
                group = wanted[first : first + EGOS_AT_ONCE]
                for one in group:
                    one.view.outcome.warnings += odd
                self._build(trace, group, road_map, folder / str(first))

    # Which views ----------------------------------------------------------------------------------------------

    def _wanted(self, trace: Trace, views: list[View]) -> Iterator[_Wanted]:
        """The views of a recording that are asked for; one whose ego is not in it has an error."""
        info, egos = trace.info, self._job.config.egos
        if not egos:
            views.append(View(TraceOutcome(info.path, ego=info.ego)))
            yield _Wanted(views[0], info)
            return
        everyone, seen = egos == (ALL_EGOS,), set[str]()
        for name in self._vehicles(trace) if everyone else egos:
            view = View(TraceOutcome(info.path, ego=name))
            views.append(view)
            try:
                found = name if everyone else _ident(info, name, self._job.config.mapping)
            except SgstoreError as error:
                view.outcome.error = error
                continue
            if found in seen:  # two names of one
                views.pop()
                continue
            seen.add(found)
            view.outcome.ego = found
            yield _Wanted(view, replace(info, ego=found))

    def _vehicles(self, trace: Trace) -> list[str]:
        """The ids of all vehicles of a recording."""
        found: list[str] = []
        for block in trace.blocks(self._job.block_frames):
            entities = self._meant(block).entities
            rows = np.flatnonzero(np.isin(entities.kind, _VEHICLES))
            found += [entities.ident[row] for row in rows.tolist()]
        if not found:
            raise TraceError("no vehicle in it can be the ego", path=trace.info.path)
        return found

    def _is_new(self, wanted: _Wanted, road_map: RoadMap | None) -> bool:
        """Whether the store lacks a view, or it is to be read anew."""
        store, job, outcome = self._store(), self._job, wanted.view.outcome
        if store is None or job.force:
            return True
        part = (job.part.since, job.part.until)
        try:
            shown = map_of_graphs(road_map, job.config)
            name = store.stored(wanted.info, job.config, shown, part)
        except SgstoreError as error:
            outcome.error = error
            return False
        if name is None:
            return True
        outcome.status, outcome.name = "present", name
        outcome.frames = store.trace(name).frames
        return False

    def _known_digest(self, path: Path) -> str:
        """The digest of a file that the store knows by path, size and time of change: it need not be hashed."""
        store = self._store()
        return "" if store is None or self._job.force else store.known_digest(path)

    def _store(self) -> StoreFile | None:
        if self._file is None and self._job.store.exists():
            self._file = StoreFile(self._job.store)
        return self._file

    # Building -------------------------------------------------------------------------------------------------

    def _build(
        self, trace: Trace, group: list[_Wanted], road_map: RoadMap | None, folder: Path
    ) -> None:
        """Build the segments of some views in one pass over the recording."""
        job, size = self._job, self._job.block_frames
        generator = SceneGraphGenerator(road_map, job.config)
        tally = Tally()
        blocks = job.part.blocks(map(self._meant, trace.blocks(size)), size)
        first = next(blocks, None)
        if first is None:
            raise TraceError("no frame of it can be read", path=trace.info.path)
        with ExitStack() as stack:
            segments: list[Segment] = []
            for number, one in enumerate(group):
                place = folder.with_name(f"{folder.name}-{number}")
                place.mkdir(parents=True)
                part = (job.part.since, job.part.until)
                segment = new_segment(
                    job.store,
                    one.info,
                    job.config,
                    road_map=map_of_graphs(road_map, job.config),
                    answers=generator.answers,
                    part=part,
                    folder=place,
                )
                segments.append(stack.enter_context(segment))
                one.view.sealed = place
            while block := first or next(blocks, None):
                first = None
                self._append(generator, block, group, segments)
                tally.see(block)
                self._on_block(tally.frames, _reached(block, trace.info.size), trace.info.size)
            self._seal(trace, group, segments, tally, generator.parked)

    def _append(
        self,
        generator: SceneGraphGenerator,
        block: FrameBlock,
        group: list[_Wanted],
        segments: list[Segment],
    ) -> None:
        # Origins do not depend on the ego, so all segments keep the same numbers.
        kept, *_ = [segment.as_kept(block) for segment in segments]
        if not self._job.config.egos:
            graphs = [generator.block(kept)]
        else:
            graphs = generator.blocks(kept, [_ego_of(block, one) for one in group])
        for segment, graph in zip(segments, graphs, strict=True):
            segment.append(graph)

    def _seal(
        self,
        trace: Trace,
        group: list[_Wanted],
        segments: list[Segment],
        tally: Tally,
        parked: Codes,
    ) -> None:
        report, told = trace.report, tally.as_dict()
        moot = report.about_ego if self._job.config.egos else []
        warnings = [warning for warning in report.warnings if warning not in moot]
        for one, segment in zip(group, segments, strict=True):
            outcome = one.view.outcome
            if self._job.config.egos and not one.met:
                reason = f"the ego {one.info.ego!r} is in none of the frames that were read"
                outcome.error = TraceError(reason, path=one.info.path)
                continue
            outcome.frames = tally.frames
            outcome.entities = tally.entities
            outcome.clock_jumps, outcome.gaps = told["clock_jumps"], told["gaps"]
            outcome.unknown_types = self._job.config.unknown_of(report.unknown_types)
            outcome.warnings += warnings
            outcome.losses += report.losses
            kept = replace(report, warnings=outcome.warnings, about_ego=[])
            segment.seal(kept, told, parked)
            outcome.status = "sealed"

    def _meant(self, block: FrameBlock) -> FrameBlock:
        """The frames, their entities as the client says that type names are meant."""
        return replace(block, entities=renamed(block.entities, self._job.config.types))


def _ident(info: TraceInfo, name: str, mapping: str) -> str:
    """The id of the ego that a name means, as the reader of the recording understands it."""
    with open_trace(info.path, ego=name, digest=info.digest, mapping=mapping) as trace:
        return trace.info.ego


def _ego_of(block: FrameBlock, one: _Wanted) -> Ints:
    """(F,) int64: node id of an ego in each frame, -1 where it is absent."""
    if one.node < 0 and one.info.ego in block.entities.ident:
        one.node = block.entities.first + block.entities.ident.index(one.info.ego)
    here = np.zeros(len(block), np.bool_)
    here[block.frame_of[block.states.node == one.node]] = True
    one.met = one.met or bool(here.any())
    return np.where(here, one.node, -1)


def _reached(frames: FrameBlock, size: int) -> int:
    """About how much of a file has been read with a block."""
    messages = frames.messages
    places = np.where(messages.chunk_offset < 0, messages.offset, messages.chunk_offset)
    return min(int(places.max(initial=0)), size)
