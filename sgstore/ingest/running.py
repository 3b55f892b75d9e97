"""The run: recordings are read, here or in other processes, and published in the order that was given.

So the store is the same whatever the number of processes, and a run that was killed and begun again ends with
the same store as one that was not.
"""

from __future__ import annotations

import shutil
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.config import Config
from sgstore.errors import SgstoreError
from sgstore.ingest.jobs import Job
from sgstore.ingest.maps import Maps
from sgstore.ingest.outcomes import Progress, TraceOutcome
from sgstore.ingest.parts import Part
from sgstore.ingest.reading import Reading
from sgstore.ingest.workers import Workers
from sgstore.store import Folder, Sealed, StoreFile
from sgstore.traces import mark_of
from sgstore.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from sgstore.ingest.reading import View

BLOCK_FRAMES: Final = 2 * BUCKET_FRAMES
"""Frames that are worked on at once: whole buckets, so that a mask is one row."""


def ingest(  # noqa: PLR0913  as many options as there are ways to read
    store: str | Path,
    traces: Sequence[str | Path],
    *,
    road_map: str | Path | None = None,
    config: Config | None = None,
    egos: Sequence[str] = (),
    jobs: int = 1,
    since: float | None = None,
    until: float | None = None,
    rate: float | None = None,
    force: bool = False,
    dry_run: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> list[TraceOutcome]:
    """Read recordings into a store, which is made if there is none and something comes into it.

    Parameters
    ----------
    store : str or Path
    traces : sequence of str or Path
        Files; :func:`sgstore.ingest.recordings` finds them in folders and by patterns.
    road_map : str or Path, optional
        An OpenDRIVE file for the recordings that carry no map of their own, or a folder of files ``NAME.xodr``
        for those that say what their map is called.
    config : Config, optional
    egos : sequence of str, optional
        Ids, roles or names of several egos, each of which makes a trace of its own; ``all``: every vehicle.
        By default what the config says.
    jobs : int
        Processes that read at the same time, each a recording. The store is the same whatever their number.
    since, until : float, optional
        From and up to when frames are read; seconds since the first frame of a recording.
    rate : float, optional
        Frames that are kept of a second. By default what the config says.
    force : bool
        Whether recordings that are in the store already are read anew, and replaced.
    dry_run : bool
        Whether it is only said what would be done.
    on_progress : function, optional
        Called after every block of frames.

    Returns
    -------
    list of TraceOutcome
        For each recording, in the order given, one for each ego.

    Raises
    ------
    StoreError
        What is at the place of the store is none, or one of another version; or nothing can be written there.
    MapError
        The file given for the road map cannot be read.
    """
    config = config or Config()
    if egos:
        config = replace(config, ego="", egos=tuple(egos))
    if rate is not None:
        config = replace(config, rate=rate)
    job = Job(
        store=Path(store),
        road_map=None if road_map is None else Path(road_map),
        config=config,
        part=Part(since, until, config.rate),
        force=force,
        dry_run=dry_run,
        block_frames=BLOCK_FRAMES,
    )
    run = _Run(job, [Path(path) for path in traces], on_progress)
    return run.outcomes(jobs)


class _Run:
    """One call of :func:`ingest`."""

    def __init__(
        self, job: Job, paths: list[Path], on_progress: Callable[[Progress], None] | None
    ) -> None:
        self._job = job
        self._paths = paths
        self._store = StoreFile(job.store) if job.store.exists() else None
        if self._store is not None and not job.dry_run:
            self._store.settle()
        self._meter = _Meter(paths, on_progress)

    def outcomes(self, jobs: int) -> list[TraceOutcome]:
        job = self._job
        found: list[TraceOutcome] = []
        with ExitStack() as stack:
            folder = Path() if job.dry_run else stack.enter_context(Folder(job.store)).path
            if min(jobs, len(self._paths)) > 1:
                Maps(
                    job.road_map, job.config.signs
                )  # one that cannot be read stops the run before anything is done
                workers = stack.enter_context(Workers(job, jobs, self._meter.see))
                read = workers.read(self._paths, folder)
            else:
                read = self._one_by_one(folder)
            for number, views in enumerate(read):
                for view in views:
                    self._publish(view)
                    found.append(view.outcome)
                shutil.rmtree(folder / str(number), ignore_errors=True)
                self._meter.finish(number)
        return found

    def _one_by_one(self, folder: Path) -> Iterator[list[View]]:
        number = 0

        def see(frames: int, reached: int, size: int) -> None:
            self._meter.see(number, frames, reached, size)

        reading = Reading(self._job, see)
        for number, path in enumerate(self._paths):
            yield reading.read(path, folder / str(number))

    def _publish(self, view: View) -> None:
        """Bring a view into the store, if it was built."""
        outcome = view.outcome
        if view.sealed is None or outcome.status != "sealed":
            return
        outcome.status = "failed"
        try:
            store = self._store = self._store or StoreFile.create(self._job.store)
            sealed = Sealed.read(view.sealed)
            name = store.has(sealed, as_it_is=not self._job.force)
            if name is not None and not self._job.force:  # the same recording twice in one run
                known = (outcome.path, "present", name, outcome.ego, outcome.frames)
                view.outcome = TraceOutcome(*known, seconds=outcome.seconds)
                return
            outcome.name = store.publish(sealed, replace=self._job.force)
            outcome.status = "added" if name is None else "replaced"
        except SgstoreError as error:
            outcome.error = error


class _Meter:
    """How far a run has come."""

    def __init__(self, paths: list[Path], on_progress: Callable[[Progress], None] | None) -> None:
        self._paths = paths
        self._on_progress = on_progress
        self._sizes = [_size(path) for path in paths]
        self._frames = [0] * len(paths)
        self._bytes = [0] * len(paths)
        self._done = 0

    def see(self, number: int, frames: int, reached: int, size: int) -> None:
        """A block of a recording has been read."""
        self._frames[number], self._bytes[number] = frames, reached
        self._tell(number, size)

    def finish(self, number: int) -> None:
        """A recording is done."""
        self._done += 1
        self._bytes[number] = self._sizes[number]

    def _tell(self, number: int, size: int) -> None:
        if self._on_progress is not None:
            progress = Progress(
                path=self._paths[number],
                frames=self._frames[number],
                bytes_done=self._bytes[number],
                size=size,
                all_frames=sum(self._frames),
                all_bytes=sum(self._bytes),
                all_size=sum(self._sizes),
                files_done=self._done,
                files=len(self._paths),
            )
            self._on_progress(progress)


def _size(path: Path) -> int:
    try:
        return mark_of(path)[0]
    except (OSError, SgstoreError):  # told when it is opened
        return 0
