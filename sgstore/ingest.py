"""Ingest of recordings into a store, in one or more processes.

Resolution of names, folders, patterns and URLs to recordings.
"""

from __future__ import annotations

import re
import shutil
from contextlib import ExitStack, closing
from dataclasses import replace
from glob import glob, has_magic
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.base.logs import logger
from sgstore.base.processes import WorkerPool
from sgstore.errors import SgstoreError, StoreError, TraceError, failure, url_named
from sgstore.maps.map_files import Maps
from sgstore.mcap import METADATA, bag_folder, log_files, mark_of, parts_of, remote_names
from sgstore.model.config import Config
from sgstore.model.trace_sampling import TracePart
from sgstore.model.world import BUCKET_FRAMES
from sgstore.pipeline.recording_ingest import Job, Progress, SegmentReader, TraceOutcome
from sgstore.readers import ENDINGS, is_recording
from sgstore.store import Folder, PresentError, Sealed, StoreFile

_log = logger("ingest")

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Sequence

    from sgstore.mcap import BagPart

    Views = list[tuple[TraceOutcome, Path | None]]

__all__ = ["ingest", "recordings"]


def recordings(names: Iterable[str | Path]) -> list[Path]:
    """Return the recordings for names of files and folders, patterns and URLs, without duplicates.

    The result has the order of the names. The contents of a folder and the matches of a pattern are sorted.

    Parameters
    ----------
    names : iterable of str or Path
        Files; folders, searched recursively; bags, by their folder or their ``metadata.yaml``; and patterns
        that the shell has not expanded (``drives/*/day?.mcap``; ``**`` matches any depth). URLs are allowed,
        too: ``s3://bucket/drives/``, ``s3://bucket/*/day?.mcap``, ``https://host/a.mcap``. An ``https`` URL
        must name one file or bag, because a web server does not list its files.

    Raises
    ------
    StoreError
        A folder contains no recording, or a pattern has no match.
    TraceError
        An object store does not list its objects.
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
            raise StoreError(f"{path}: no file matches this pattern")
        for name in fitting:
            yield from _meant(Path(name))
    else:
        yield path


def _inside(folder: Path) -> Iterator[Path]:
    """Yield the recordings in a folder and its subfolders. A bag is one recording; its files are not listed."""
    bags = {path.parent for path in folder.rglob(METADATA) if bag_folder(path.parent) is not None}
    own = {part.path for bag in bags for part in _parts(bag)}
    own.update(bags, *(log_files(bag) or () for bag in bags))
    yield from bags
    for path in (folder, *folder.rglob("*")):
        if is_recording(path) and path not in own:
            yield path


def _meant_by(url: str) -> list[str]:
    """Return the recordings of a URL: the file, the files below it, or the matches of its pattern."""
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
            "no file matches this pattern"
            if pattern
            else f"no recording ({', '.join(ENDINGS)}) below it"
        )
        raise StoreError(f"{url}: {why}")
    return sorted(found)


def _fits(url: str, pattern: str) -> bool:
    """True if a URL or one of its parent folders matches a pattern. ``**`` matches any depth."""
    words = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}

    def word(found: re.Match[str]) -> str:
        text = found[0]
        if len(text) > 2 and text[0] == "[":
            return text.replace("[!", "[^")
        return words.get(text) or re.escape(text)

    text = re.sub(r"\*\*/|\*\*|\[!?[^]]+\]|.", word, pattern)
    return re.fullmatch(f"{text}(?:/.*)?", url) is not None


def _parts(bag: Path) -> tuple[BagPart, ...]:
    """Return the files of a bag. It is empty for an unreadable bag; the ingest then reports the fault."""
    try:
        return parts_of(bag)
    except TraceError:
        return ()


# Reading in several processes. Results come back in the order of the request.
# All processes are equal: a free process takes the next recording. If a process dies (for example, out of
# memory), its current recording fails, and a new process replaces it.

_AHEAD: Final = 2
"""Number of recordings that are assigned to a process at once: the current one and the next one."""

_WAITING: Final = 64
"""Largest number of recordings per process that are read but not yet published."""


def read_in_processes(
    job: Job,
    count: int,
    on_block: Callable[[int, int, int, int], None],
    paths: Sequence[Path],
    folder: Path,
) -> Generator[Views]:
    """Read recordings in several processes, and yield their outcomes in order. Closing ends the processes.

    Parameters
    ----------
    job : Job
    count : int
        Number of processes.
    on_block : function
        Called after each block with the number of the recording, its frames done, its bytes done (approximate)
        and its size.
    paths : sequence of Path
    folder : Path
        Folder of the segments, one subfolder per recording.
    """
    done, next_read, next_out = dict[int, "Views"](), 0, 0
    worker = "sgstore.pipeline.recording_ingest"
    with WorkerPool(count, worker, first=job.as_dict(), ahead=_AHEAD) as pool:
        while next_out < len(paths):
            end = min(next_out + _WAITING * count, len(paths))
            while next_read < end and pool.has_room:
                task = {"path": str(paths[next_read]), "folder": str(folder / str(next_read))}
                pool.put(next_read, task)
                next_read += 1
            if next_out in done:
                yield done.pop(next_out)
                next_out += 1
                continue
            index, reply = pool.get()
            if isinstance(reply, int):
                done[index] = [(_lost(paths[index], reply), None)]
            elif "done" in reply:
                done[index] = [
                    (TraceOutcome.from_dict(outcome), Path(sealed) if sealed else None)
                    for outcome, sealed in reply["done"]
                ]
            else:
                on_block(index, reply["frames"], reply["bytes"], reply["size"])


def _lost(path: Path, code: int) -> TraceOutcome:
    """Return the outcome of a recording whose process died."""
    how = f"was killed by signal {-code}; is there too little memory?"
    how = how if code < 0 else f"ended with code {code}; see its output on stderr"
    return TraceOutcome(path, error=TraceError(f"the process that read it {how}", path=path))


# The run: recordings are read, here or in other processes, and published in the given order.
# The store is therefore the same for any number of processes. A run that is killed and started again gives the
# same store as an uninterrupted run.

BLOCK_FRAMES: Final = 4 * BUCKET_FRAMES
"""Number of frames in a block: whole buckets, so that a mask of 60 frames is one row."""


def ingest(  # noqa: PLR0913  one option per way to read
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
    topics: Sequence[str] = (),
    force: bool = False,
    dry_run: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> list[TraceOutcome]:
    """Read recordings into a store and return the outcomes.

    If the store does not exist, the first successful trace creates it.

    Parameters
    ----------
    store : str or Path
    traces : sequence of str or Path
        Files; :func:`sgstore.ingest.recordings` finds them in folders and by patterns.
    road_map : str or Path, optional
        An OpenDRIVE or Lanelet2 file for recordings without their own map, or a folder of such files for
        recordings that contain the name of their map.
    config : Config, optional
    egos : sequence of str, optional
        Ids, roles or names of several egos; each makes its own trace. ``all``: every vehicle. Default: the
        egos of the config.
    jobs : int
        Number of reader processes, each with one recording at a time. The store does not depend on it.
    since, until : float, optional
        Start and end of the frames; seconds since the first frame of a recording.
    rate : float, optional
        Frames per second to keep. Default: the rate of the config.
    topics : sequence of str, optional
        Channels whose messages are stored as columns: ``/imu``. Default: the topics of the config.
    force : bool
        Read recordings again that the store already contains, and replace their traces.
    dry_run : bool
        Only report the outcomes; write nothing.
    on_progress : function, optional
        Called after every block of frames.

    Returns
    -------
    list of TraceOutcome
        For each recording, in the given order, one for each ego.

    Raises
    ------
    StoreError
        The file is not a store or has another version, or the folder is not writable.
    MapError
        The given road map cannot be read.
    """
    config = config or Config()
    if egos:
        config = replace(config, ego="", egos=tuple(egos))
    if rate is not None:
        config = replace(config, rate=float(rate))
    if topics:
        config = replace(config, topics=tuple(topics))
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
    Folder.refuse_name(job.store)
    file = StoreFile(job.store) if job.store.exists() else None
    if file is not None and not dry_run:
        file.settle()
    meter = _Meter(paths, on_progress)
    found: list[TraceOutcome] = []
    with ExitStack() as stack:
        folder = Path() if dry_run else stack.enter_context(Folder(job.store)).path
        if min(jobs, len(paths)) > 1:
            Maps(job.road_map, config.signs)  # An unreadable map stops the run at once.
            read = read_in_processes(job, jobs, meter.see, paths, folder)
            stack.enter_context(closing(read))
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


def _other_ego(file: StoreFile, outcome: TraceOutcome, sealed: Sealed) -> str:
    """Return the ego of the trace whose name was taken, if it is from the same recording."""
    if not (taken := outcome.taken_name):
        return ""
    trace = file.trace(taken)
    return trace.ego if trace.digest == sealed.identity.digest else ""


def _published(
    job: Job, file: StoreFile | None, views: Views
) -> tuple[StoreFile | None, list[TraceOutcome]]:
    """Add the segments of a recording to the store. Return the store (new if needed) and the outcomes."""
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
            outcome.other = _other_ego(file, outcome, ready[number]) if file else ""
        elif isinstance(name, PresentError):  # the same recording twice in one run
            same = (outcome.path, "present", name.name, outcome.ego, outcome.frames)
            outcomes[number] = TraceOutcome(*same, seconds=outcome.seconds)
        else:
            outcome.error = name
    return file, outcomes


class _Meter:
    """Progress counter of one ingest."""

    def __init__(self, paths: list[Path], on_progress: Callable[[Progress], None] | None) -> None:
        self._paths = paths
        self._on_progress = on_progress
        self._sizes = [_size(path) for path in paths]
        self._frames = [0] * len(paths)
        self._bytes = [0] * len(paths)
        self._done = 0

    def see(self, number: int, frames: int, reached: int, size: int) -> None:
        """Add one block of a recording, and call the progress function."""
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
        """Mark a recording as done."""
        self._done += 1
        self._bytes[number] = self._sizes[number]


def _size(path: Path) -> int:
    try:
        return mark_of(path)[0]
    except (OSError, SgstoreError):  # The opening reports it.
        return 0
