"""Ingest: recordings into a store, in one process or several.

Which recordings are meant by the names that people give.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import threading
from collections import deque
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from glob import glob, has_magic
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Self

from sgstore.config import Config
from sgstore.errors import SgstoreError, StoreError, TraceError, failure, url_named
from sgstore.logs import logger
from sgstore.map_files import Maps
from sgstore.mcap import METADATA, bag_folder, mark_of, parts_of, remote_names
from sgstore.processes import command
from sgstore.readers import ENDINGS, is_recording
from sgstore.segments import Job, Progress, SegmentReader, TraceOutcome
from sgstore.store import Folder, PresentError, Sealed, StoreFile, refuse_name
from sgstore.trace_parts import TracePart
from sgstore.world import BUCKET_FRAMES

_log = logger("ingest")

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from sgstore.mcap import BagPart

    Event = tuple["_Worker", dict[str, Any] | None]
    Views = list[tuple[TraceOutcome, Path | None]]

__all__ = ["ingest", "recordings"]


def recordings(names: Iterable[str | Path]) -> list[Path]:
    """The files that are meant: each once, in the order in which they are named.

    Parameters
    ----------
    names : iterable of str or Path
        Files; folders, which stand for the recordings in them and below; bags, by their folder or their
        ``metadata.yaml``; and patterns (``drives/*/day?.mcap``, ``**`` for any depth) that no shell has
        expanded. What is in a folder or fits a pattern is sorted. URLs are such names, too:
        ``s3://bucket/drives/``, ``s3://bucket/*/day?.mcap``, ``https://host/a.mcap`` (a file or a bag: a web
        server does not tell what else it has).

    Raises
    ------
    StoreError
        A folder holds no recording, or nothing fits a pattern.
    TraceError
        An object store does not tell what it has.
    """
    return list(dict.fromkeys(path for name in names for path in _meant(Path(name))))


def _meant(path: Path) -> Iterator[Path]:
    if path.name == METADATA:
        yield path.parent
    elif (url := url_named(path)) is not None:
        yield from map(Path, _meant_by(url))
    elif path.is_dir():
        inside = sorted(_inside(path))
        if not inside:
            raise StoreError(
                f"{path}: no recording ({', '.join(ENDINGS)}) in this folder or below it"
            )
        yield from inside
    elif has_magic(str(path)) and not path.exists():
        fitting = sorted(glob(str(path), recursive=True))  # noqa: PTH207  absolute patterns, too
        if not fitting:
            raise StoreError(f"{path}: no file fits this pattern")
        for name in fitting:
            yield from _meant(Path(name))
    else:
        yield path


def _inside(folder: Path) -> Iterator[Path]:
    """The recordings in a folder and below it; the files that a bag consists of are none themselves."""
    bags = {path.parent for path in folder.rglob(METADATA) if bag_folder(path.parent) is not None}
    own = {part.path for bag in bags for part in _parts(bag)}
    yield from bags
    for path in folder.rglob("*"):
        if is_recording(path) and path.is_file() and path not in own:
            yield path


def _meant_by(url: str) -> list[str]:
    """The recordings that a URL means: itself, those below it, or those that fit it as a pattern."""
    pattern = has_magic(url)
    if url.startswith("http") or not (pattern or not url.lower().endswith(ENDINGS)):
        return [url]
    if not pattern and bag_folder(Path(url)) is not None:
        return [url]
    fixed = re.split(r"[*?[]", url, maxsplit=1)[0].rpartition("/")[0] if pattern else url
    inside = remote_names(fixed)
    bags = [name.removesuffix(f"/{METADATA}") for name in inside if name.endswith(f"/{METADATA}")]
    bags = [bag for bag in bags if bag_folder(Path(bag)) is not None]
    files = [name for name in inside if is_recording(Path(name))]
    found = bags + [name for name in files if not name.startswith(tuple(f"{b}/" for b in bags))]
    if pattern:
        found = [name for name in found if _fits(name, url)]
    if not found:
        why = (
            "nothing fits this pattern"
            if pattern
            else f"no recording ({', '.join(ENDINGS)}) below it"
        )
        raise StoreError(f"{url}: {why}")
    return sorted(found)


def _fits(url: str, pattern: str) -> bool:
    """Tell whether a URL, or a folder that it is in, fits a pattern; ``**`` stands for folders at any depth."""
    words = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}

    def word(found: re.Match[str]) -> str:
        text = found[0]
        if len(text) > 2 and text[0] == "[":
            return text.replace("[!", "[^")
        return words.get(text) or re.escape(text)

    text = re.sub(r"\*\*/|\*\*|\[!?[^]]+\]|.", word, pattern)
    return re.fullmatch(f"{text}(?:/.*)?", url) is not None


def _parts(bag: Path) -> tuple[BagPart, ...]:
    """The files of a bag; of one that cannot be read none, and reading it says why."""
    try:
        return parts_of(bag)
    except TraceError:
        return ()


# Recordings read in several processes; what they built comes back in the order in which it was asked for ----
# Processes are told apart from one another by nothing: whoever is free takes the next recording. One that dies
# (out of memory, say) costs the recording that it was reading, and another takes its place.

_AHEAD: Final = 2
"""Recordings that a process has been told of: the one that it reads, and the next."""

_WAITING: Final = 64
"""Recordings for each process that may be read before the first of them is published."""


@dataclass(eq=False)
class _Worker:
    """A process, and the numbers of the recordings that it was told to read."""

    process: subprocess.Popen[str]
    tasks: deque[int] = field(default_factory=deque[int])
    listener: threading.Thread | None = None

    def tell(self, values: dict[str, Any]) -> None:
        stdin = self.process.stdin
        if stdin is not None:
            try:
                stdin.write(f"{json.dumps(values)}\n")
                stdin.flush()
            except OSError:  # it has died: that is told where its stdout ends
                return

    def end(self) -> int:
        """End the process if it still runs; its exit code."""
        self.process.kill()
        code = self.process.wait()
        if self.listener is not None:
            self.listener.join()
        for pipe in (self.process.stdin, self.process.stdout):
            with suppress(OSError):  # what was not written is for nobody
                if pipe is not None:
                    pipe.close()
        return code


class Workers:
    """Processes that read recordings.

    Parameters
    ----------
    job : Job
    count : int
        How many.
    on_block : function
        Called with the number of a recording, the frames done of it, about how many bytes, and its size.

    Notes
    -----
    Use it as a context manager: the processes end with it, and with this process, however that ends.
    """

    def __init__(
        self, job: Job, count: int, on_block: Callable[[int, int, int, int], None]
    ) -> None:
        self._job = job
        self._count = count
        self._on_block = on_block
        self._workers: list[_Worker] = []
        self._events: SimpleQueue[Event] = SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.end()

    def read(self, paths: list[Path], folder: Path) -> Iterator[Views]:
        """Yield the outcomes of recordings, in order; segments are built in folders below the one given."""
        waiting, done, given = deque(range(len(paths))), dict[int, "Views"](), 0
        while given < len(paths):
            self._hire(min(self._count, len(waiting) + len(self._workers)))
            self._assign(waiting, paths, folder, given + _WAITING * self._count)
            worker, event = self._events.get()
            if event is None:
                self._replace(worker, waiting, paths, done)
            elif "done" in event:
                worker.tasks.remove(event["index"])
                done[event["index"]] = [
                    (TraceOutcome.from_dict(outcome), Path(sealed) if sealed else None)
                    for outcome, sealed in event["done"]
                ]
                self._assign(waiting, paths, folder, given + _WAITING * self._count)
            else:
                self._on_block(event["index"], event["frames"], event["bytes"], event["size"])
            while given in done:
                yield done.pop(given)
                given += 1

    def _hire(self, count: int) -> None:
        while len(self._workers) < count:
            separate: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
            process = subprocess.Popen(  # noqa: S603  a module of ours
                command("sgstore.segments"),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                encoding="utf-8",
                **separate,  # Ctrl-C is for us to deal with
            )
            worker = _Worker(process)
            self._workers.append(worker)
            worker.listener = threading.Thread(target=self._listen, args=(worker,), daemon=True)
            worker.listener.start()
            worker.tell(self._job.as_dict())

    def _listen(self, worker: _Worker) -> None:
        for line in worker.process.stdout or ():
            self._events.put((worker, json.loads(line)))
        self._events.put((worker, None))

    def _assign(self, waiting: deque[int], paths: list[Path], folder: Path, end: int) -> None:
        """Give the next recordings to those who have the fewest."""
        while waiting and waiting[0] < end:
            worker = min(self._workers, key=lambda one: len(one.tasks), default=None)
            if worker is None or len(worker.tasks) >= _AHEAD:
                return
            index = waiting.popleft()
            worker.tasks.append(index)
            place = folder / str(index)
            worker.tell({"index": index, "path": str(paths[index]), "folder": str(place)})

    def _replace(
        self, worker: _Worker, waiting: deque[int], paths: list[Path], done: dict[int, Views]
    ) -> None:
        """A process has died: what it was reading has failed, what it should have read next is still to do."""
        self._workers.remove(worker)
        code = worker.end()
        if worker.tasks:
            index = worker.tasks.popleft()
            how = f"was killed by signal {-code}; is there too little memory?"
            how = how if code < 0 else f"ended with code {code}; what it said of that is on stderr"
            error = TraceError(f"the process that read it {how}", path=paths[index])
            done[index] = [(TraceOutcome(paths[index], error=error), None)]
        waiting.extendleft(reversed(worker.tasks))


# The run: recordings are read, here or in other processes, and published in the order that was given ----
# So the store is the same whatever the number of processes, and a run that was killed and begun again ends with
# the same store as one that was not.

BLOCK_FRAMES: Final = 4 * BUCKET_FRAMES
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
        An OpenDRIVE or Lanelet2 file for the recordings that carry no map of their own, or a folder of such
        files for those that say what their map is called.
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
        config = replace(config, rate=float(rate))
    job = Job(
        store=Path(store),
        road_map=None if road_map is None else Path(road_map),
        config=config,
        part=TracePart(since, until, config.rate),
        force=force,
        dry_run=dry_run,
        block_frames=BLOCK_FRAMES,
    )
    paths = [Path(path) for path in traces]
    refuse_name(job.store)
    file = StoreFile(job.store) if job.store.exists() else None
    if file is not None and not dry_run:
        file.settle()
    meter = _Meter(paths, on_progress)
    found: list[TraceOutcome] = []
    with ExitStack() as stack:
        folder = Path() if dry_run else stack.enter_context(Folder(job.store)).path
        if min(jobs, len(paths)) > 1:
            Maps(job.road_map, config.signs)  # one that cannot be read stops the run at once
            read = stack.enter_context(Workers(job, jobs, meter.see)).read(paths, folder)
        else:
            read = _one_by_one(job, paths, folder, meter)
        for number, views in enumerate(read):
            file, outcomes = _published(job, file, views)
            found += outcomes
            for one in outcomes:
                _log.info(
                    "%s: %s, %d frames, %.1f s", one.path, one.status, one.frames, one.seconds
                )
            shutil.rmtree(folder / str(number), ignore_errors=True)
            meter.finish(number)
    return found


def _one_by_one(job: Job, paths: list[Path], folder: Path, meter: _Meter) -> Iterator[Views]:
    number = 0

    def see(frames: int, reached: int, size: int) -> None:
        meter.see(number, frames, reached, size)

    reading = SegmentReader(job, see)
    for number, path in enumerate(paths):
        yield reading.read(path, folder / str(number))


def _published(
    job: Job, file: StoreFile | None, views: Views
) -> tuple[StoreFile | None, list[TraceOutcome]]:
    """The store, made if there is none, with the segments of a recording; and what became of each view."""
    outcomes = [outcome for outcome, _ in views]
    ready: dict[int, Sealed] = {}
    known: dict[int, str | None] = {}
    for number, (outcome, place) in enumerate(views):
        if place is None or outcome.status != "sealed":
            continue
        outcome.status = "failed"
        try:
            file = file or StoreFile.create(job.store)
            sealed = Sealed.read(place)
            known[number] = file.has(sealed, as_it_is=False) if job.force else None
            ready[number] = sealed
        except SgstoreError as error:
            outcome.error = error
    told: Sequence[str | SgstoreError] = []
    if file and ready:
        try:
            told = file.publish_each([*ready.values()], replace=job.force)
        except Exception as error:
            if isinstance(error, SgstoreError):
                raise
            told = [failure(error, outcomes[0].path)] * len(ready)
    for number, name in zip(ready, told, strict=True):
        outcome = outcomes[number]
        if isinstance(name, str):
            outcome.name, outcome.status = name, "added" if known[number] is None else "replaced"
        elif isinstance(name, PresentError):  # the same recording twice in one run
            same = (outcome.path, "present", name.name, outcome.ego, outcome.frames)
            outcomes[number] = TraceOutcome(*same, seconds=outcome.seconds)
        else:
            outcome.error = name
    return file, outcomes


class _Meter:
    """Progress of a run."""

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

    def finish(self, number: int) -> None:
        """A recording is done."""
        self._done += 1
        self._bytes[number] = self._sizes[number]


def _size(path: Path) -> int:
    try:
        return mark_of(path)[0]
    except (OSError, SgstoreError):  # told when it is opened
        return 0
