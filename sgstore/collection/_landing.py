"""Ingest into a collection: each recording becomes segment files. A later commit makes bundles of them.

Landing needs no lock and no order: the name of a segment is its content hash, so that a repeated
landing writes the same. The digests of the recordings distribute them: each of N shards takes its
share, on any machine, in any order, and an interrupted shard can be repeated.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._storage import digest_of_file, place_at
from sgstore.errors import SgstoreError, StoreError, TraceError, url_named
from sgstore.ingest import BLOCK_FRAMES, read_in_processes
from sgstore.maps.map_files import Maps
from sgstore.mcap import digest_of, mark_of
from sgstore.model.config import Config
from sgstore.model.trace_sampling import TracePart
from sgstore.pipeline.recording_ingest import Job, SegmentReader, TraceOutcome
from sgstore.store import Sealed, split_segment

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from sgstore.collection._storage import Place

DESCRIPTION: Final = "sealed.json"
"""Name of the file that describes a landed segment. It is uploaded last."""


def land(  # noqa: PLR0913  as many options as there are ways to read
    url: str | Path,
    traces: Sequence[str | Path],
    *,
    shard: tuple[int, int] = (1, 1),
    road_map: str | Path | None = None,
    config: Config | None = None,
    egos: Sequence[str] = (),
    jobs: int = 1,
    since: float | None = None,
    until: float | None = None,
    rate: float | None = None,
    topics: Sequence[str] = (),
) -> list[TraceOutcome]:
    """Ingest recordings as segment files into a collection; a missing collection is created.

    Recordings that have landed with the same settings are not read again.

    Parameters
    ----------
    url : str or Path
        Place of the collection.
    traces : sequence of str or Path
        Files; :func:`sgstore.ingest.recordings` finds them in folders and by patterns.
    shard : (int, int)
        Share of the recordings to read, and number of shares: 1 … N, N.
    road_map, config, egos, jobs, since, until, rate, topics
        As in :func:`sgstore.ingest.ingest`.

    Returns
    -------
    list of TraceOutcome
        For each recording of the share, in input order, one per ego: ``landed``, ``present`` or
        ``failed``.

    Raises
    ------
    StoreError
        The collection is not writable, or the shard is out of range.
    MapError
        The road map file cannot be read.
    """
    number, of = shard
    if not 1 <= number <= of:
        raise StoreError(f"shard {number}/{of}: expected I/N with 1 ≤ I ≤ N")
    settings = config or Config()
    if egos:
        settings = replace(settings, ego="", egos=tuple(egos))
    if rate is not None:
        settings = replace(settings, rate=float(rate))
    if topics:
        settings = replace(settings, topics=tuple(topics))
    place = place_at(url)
    catalogue.create(place, catalogue.About())
    with working_folder("landing") as folder:
        job = Job(
            store=folder / "none.sgstore",  # empty: every recording is read
            road_map=None if road_map is None else Path(road_map),
            config=settings,
            part=TracePart(since, until, settings.rate),
            block_frames=BLOCK_FRAMES,
        )
        landing = _Landing(place, job, folder)
        return landing.landed([Path(path) for path in traces], number - 1, of, jobs)


@dataclass(slots=True)
class _Landing:
    place: Place
    job: Job
    folder: Path
    maps: set[str] = field(default_factory=set[str])

    def landed(self, paths: list[Path], share: int, of: int, jobs: int) -> list[TraceOutcome]:
        """Ingest share number ``share`` of ``of`` shares of the recordings. Write a segment file per trace."""
        Maps(self.job.road_map, self.job.config.signs)  # an unreadable map stops the run early
        found: dict[int, list[TraceOutcome]] = {}
        wanted: dict[int, tuple[Path, str]] = {}
        for place, path in enumerate(paths):
            try:
                digest = _mark(path)
            except SgstoreError as error:  # reported by always the same share
                if _share(hashlib.sha256(path.name.encode()).hexdigest(), of) == share:
                    found[place] = [TraceOutcome(path, error=error)]
                continue
            if _share(digest, of) != share:
                continue
            key = self._key(digest)
            told = self._told(key, path)
            if told is None:
                wanted[place] = path, key
            else:
                found[place] = told
        with closing(self._read([path for path, _ in wanted.values()], jobs)) as read:
            for number, (place, (_, key)) in enumerate(wanted.items()):
                found[place] = self._land(key, next(read))
                shutil.rmtree(self.folder / str(number), ignore_errors=True)
        return [outcome for place in sorted(found) for outcome in found[place]]

    def _read(
        self, paths: list[Path], jobs: int
    ) -> Generator[list[tuple[TraceOutcome, Path | None]]]:
        def see(*_told: int) -> None:
            """Do nothing: progress of reading is not shown."""

        if min(jobs, len(paths)) > 1:
            yield from read_in_processes(self.job, jobs, see, paths, self.folder)
            return
        reader = SegmentReader(self.job, see)
        for number, path in enumerate(paths):
            yield reader.read(path, self.folder / str(number))

    def _key(self, digest: str) -> str:
        """Return a key for an ingested recording: a hash of its digest, the settings and the map."""
        job = self.job
        road_map = ""
        if job.road_map is not None and job.road_map.is_file():
            road_map = digest_of_file(job.road_map)
        elif job.road_map is not None:
            road_map = str(job.road_map.resolve())
        settings = job.config.as_dict()
        if not job.config.topics:  # as before this setting
            del settings["topics"]
        about = [digest, settings, asdict(job.part), road_map]
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()

    def _told(self, key: str, path: Path) -> list[TraceOutcome] | None:
        """If a recording is already ingested with these settings, return the earlier results.

        ``None`` means that it was not.
        """
        name = f"landed/{key[:2]}/{key}.json"
        if not any(one == name for one, _, _ in self.place.names(f"landed/{key[:2]}")):
            return None
        told = json.loads(self.place.read(name))
        return [
            TraceOutcome(path, "present", "", one["ego"], one["frames"]) for one in told["traces"]
        ]

    def _land(self, key: str, views: list[tuple[TraceOutcome, Path | None]]) -> list[TraceOutcome]:
        told: list[dict[str, Any]] = []
        for outcome, sealed in views:
            if sealed is None or outcome.status != "sealed":
                continue
            outcome.status = "failed"
            try:
                segment = self._put(sealed)
            except SgstoreError as error:
                outcome.error = error
                continue
            outcome.status = "landed"
            told.append({"segment": segment, "ego": outcome.ego, "frames": outcome.frames})
        if told and len(told) == len(views):
            data = json.dumps({"traces": told}, indent=2).encode()
            self.place.write_new(f"landed/{key[:2]}/{key}.json", data)
        return [outcome for outcome, _ in views]

    def _put(self, sealed: Path) -> str:
        """Upload a segment file and its road map to the collection, and return the name of the segment."""
        with working_folder("segment") as folder:
            parts = [folder / name for name in ("segment", "map")]
            for part in parts:
                part.mkdir()
            of_map = split_segment(sealed, *parts)
            if of_map and of_map not in self.maps:
                name = f"maps/{of_map}/tables"
                if not any(one == name for one, _, _ in self.place.names(f"maps/{of_map}")):
                    self.place.upload(parts[1] / "tables", name)
                self.maps.add(of_map)
            files = Sealed.read(parts[0]).files
            digests = [digest_of_file(parts[0] / name) for name in files]
            segment = hashlib.sha256(" ".join(digests).encode()).hexdigest()
            for name in reversed(files):  # the completeness file is last
                self.place.upload(parts[0] / name, f"segments/{segment[:2]}/{segment}/{name}")
            return segment


def _mark(path: Path) -> str:
    """Return the digest of a recording file, which identifies the recording before it is read.

    A remote recording is identified by its URL, size and time: hashing would make every shard fetch
    it.
    """
    url = url_named(path)
    if url is None:
        return digest_of(path)
    try:
        return hashlib.sha256(json.dumps([url, *mark_of(path)]).encode()).hexdigest()
    except OSError as error:
        raise TraceError(error.strerror or "cannot be read", path=path) from error


def _share(digest: str, of: int) -> int:
    return int(digest[:15], 16) % of
