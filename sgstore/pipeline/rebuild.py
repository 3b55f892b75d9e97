"""Rebuild of a store from its recordings, such as after a change of the database schema.

A store is a cache of its traces. A rebuild is needed after a change of the table format or of the tables. The
new store grows beside the old one in ``STORE.rebuild``. A stopped run continues there. The new store replaces
the old one only after it contains everything.
"""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import excerpts
from sgstore.base.temporary_folders import working_folder
from sgstore.errors import ConfigError, SgstoreError, StoreError, TraceError, reason_of, url_named
from sgstore.ingest import ingest, recordings
from sgstore.mcap import digest_of, mark_of
from sgstore.model.config import Config, from_dict
from sgstore.pipeline.derive import derive, keep_abstraction
from sgstore.pipeline.importing import Words, import_graphs
from sgstore.readers import open_trace
from sgstore.store import Remains, StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    from sgstore.pipeline.recording_ingest import Progress
    from sgstore.store import OldMap, OldTrace


try:
    import fcntl
except ImportError:  # not on Windows, where two runs would collide at the new file
    fcntl = None


_SHOWN: Final = 10
"""Largest number of recordings that a message names. Further ones are counted."""


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Result of rebuilding one trace.

    Attributes
    ----------
    trace : str
        Its name, the same as before.
    status : str
        ``added``; ``present``: an earlier, stopped run had added it.
    frames : int
    path : Path
        Its recording.
    """

    trace: str
    status: str
    frames: int
    path: Path


@dataclass(frozen=True, slots=True)
class _ReadingStep:
    """Traces that a rebuild ingests in one pass: their settings, time range and map are equal."""

    config: Config
    part: tuple[float | None, float | None]
    map_id: int | None
    paths: tuple[Path, ...]


def rebuild(
    store: str | Path,
    *,
    look_in: Sequence[str | Path] = (),
    leave_out: Sequence[str] = (),
    jobs: int = 1,
    on_progress: Callable[[Progress], None] | None = None,
) -> list[Rebuilt]:
    """Rebuild a store from its recordings, with the same settings, time ranges, maps, egos and names.

    Derived sets and requested classes are rebuilt, too. The old store stays until the new one is complete. A
    stopped run continues at its last trace.

    Parameters
    ----------
    store : str or Path
        A store of this or an older version. Changed tables are allowed if the table of traces is readable.
    look_in : sequence of str or Path, optional
        Folders to search for moved recordings.
    leave_out : sequence of str, optional
        Names of traces to drop, for example because their recordings are missing.
    jobs : int
        Number of recordings read at the same time.
    on_progress : function, optional
        As in :func:`sgstore.ingest.ingest`.

    Returns
    -------
    list of Rebuilt
        The traces, in the order of the old store.

    Raises
    ------
    StoreError
        Recordings are missing, changed or unreadable (the message names them), or the store contains other
        tables. The old store is then unchanged.
    """
    path = Path(store)
    whole = Remains.of(path)
    old = _without(path, whole, leave_out)
    _check_settings(path, old.traces)
    if old.others:
        raise StoreError(
            f"{path}: not rebuilt, because tables of other programs would be lost: {excerpts(old.others, 100)};"
            " move them to another file first"
        )
    fresh = path.with_name(f"{path.name}.rebuild")
    with _alone(fresh):
        places = _found(path, old.traces, look_in)
        _resume(fresh, old)
        if not fresh.exists():
            StoreFile.create(fresh)
        before = {one.trace_id for one in StoreFile(fresh).traces()}
        for step in _steps(old.traces, places):
            if isinstance(step, _ReadingStep):
                _read(fresh, step, old.maps, jobs, on_progress)
            else:
                _import(fresh, step, places[step.trace_id], old.maps)
        _complete(path, fresh, old)
        old.give_names(fresh)
        made = {one.trace_id: one for one in StoreFile(fresh).traces()}
        whole.replace(fresh, path)
    return [
        Rebuilt(
            one.name,
            "present" if one.trace_id in before else "added",
            made[one.trace_id].frames,
            made[one.trace_id].path,
        )
        for one in old.traces
    ]


def _without(path: Path, whole: Remains, leave_out: Sequence[str]) -> Remains:
    """Return the description of an old store, reduced to the traces to rebuild."""
    names = [one.name for one in whole.traces]
    strange = [name for name in leave_out if name not in names]
    if strange:
        raise StoreError(f"{path}: no trace {strange[0]!r}; there are: {excerpts(names)}")
    kept = tuple(one for one in whole.traces if one.name not in leave_out)
    used = {one.map_id for one in kept}
    maps = {number: one for number, one in whole.maps.items() if number in used}
    ids = {one.trace_id for one in kept}
    sets = [replace(one, traces=tuple(i for i in one.traces if i in ids)) for one in whole.sets]
    return replace(whole, traces=kept, maps=maps, sets=tuple(one for one in sets if one.traces))


@contextmanager
def _alone(fresh: Path) -> Generator[None]:
    """Context manager that holds a lock file, so that only one process rebuilds a store."""
    lock = fresh.with_name(f"{fresh.name}-lock")
    try:
        held = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise StoreError(f"{fresh.parent}: cannot be written: {reason_of(error)}") from error
    try:
        if fcntl is not None:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(f"{fresh}: another process is at work on it") from error
            except OSError as error:
                raise StoreError(f"{lock}: cannot be locked: {reason_of(error)}") from error
        yield
        with suppress(OSError):
            lock.unlink()
    finally:
        os.close(held)


def _found(
    path: Path, traces: Sequence[OldTrace], look_in: Sequence[str | Path]
) -> dict[int, Path]:
    """Return the path of each trace's recording: trace id → path. Raise an error if some are missing.

    Raises
    ------
    StoreError
        Recordings are missing or changed; the message names them.
    """
    known: dict[tuple[Path, str], Path | str] = {}
    candidates = _by_size(look_in)
    for one in traces:
        key = (one.path, one.digest)
        if key not in known:
            known[key] = _place(one, candidates)
    lost = [f"{recording}: {why}" for (recording, _), why in known.items() if isinstance(why, str)]
    if lost:
        more = [f"… and {len(lost) - _SHOWN} more"] if len(lost) > _SHOWN else []
        listed = "\n  ".join([*lost[:_SHOWN], *more])
        raise StoreError(
            f"{path}: left as it is: {len(lost)} of {len(known)} recordings cannot be read:\n  {listed}\n"
            "  add --look-in FOLDER to find them, or --leave-out TRACE to drop a trace"
        )
    places = {one.trace_id: known[one.path, one.digest] for one in traces}
    return {trace_id: place for trace_id, place in places.items() if isinstance(place, Path)}


def _place(trace: OldTrace, candidates: dict[int, list[Path]]) -> Path | str:
    """Return the path of a trace's recording. If no usable file exists, return the reason."""
    reason = "changed since it was ingested"
    try:
        mark = mark_of(trace.path)
        if mark == (trace.size, trace.mtime_ns):
            return trace.path
        if mark[0] == trace.size and digest_of(trace.path) == trace.digest:
            return trace.path
    except FileNotFoundError:
        reason = "gone"
    except (OSError, SgstoreError) as error:
        reason = getattr(error, "strerror", None) or str(error)
    for path in candidates.get(trace.size, []):
        with suppress(SgstoreError):
            if digest_of(path) == trace.digest:
                return path
    return reason


def _by_size(folders: Sequence[str | Path]) -> dict[int, list[Path]]:
    """Return the files in some folders, file size → paths, to search for moved recordings."""
    found: dict[int, list[Path]] = {}
    for path in recordings(folders) if folders else ():
        with suppress(OSError, TraceError):
            found.setdefault(mark_of(path)[0], []).append(
                path if url_named(path) else path.absolute()
            )
    return found


def _resume(fresh: Path, old: Remains) -> None:
    """Prepare the new store after an interrupted rebuild: keep its valid traces, or delete an invalid file."""
    if not fresh.exists():
        return
    try:
        file = StoreFile(fresh)
        there = file.traces()
    except StoreError:
        fresh.unlink()
        fresh.with_name(f"{fresh.name}.wal").unlink(missing_ok=True)
        return
    wanted = {one.trace_id: one for one in old.traces}
    for trace in there:
        one = wanted.get(trace.trace_id)
        same = one is not None and _settings(one) == from_dict(trace.settings)
        if one is None or not same or (one.since, one.until) != (trace.since, trace.until):
            file.remove(trace.trace_id)
    file.settle()


def _check_settings(path: Path, traces: Sequence[OldTrace]) -> None:
    """Raise an error if this version does not support the settings of an old trace."""
    try:
        for one in traces:
            _settings(one)
    except ConfigError as error:
        raise StoreError(f"{path}: not changed: settings of a trace: {error}") from error


def _settings(trace: OldTrace) -> Config:
    return replace(from_dict(trace.settings), ego="", egos=())


def _steps(
    traces: Sequence[OldTrace], places: dict[int, Path]
) -> Iterator[_ReadingStep | OldTrace]:
    """Yield groups of traces to ingest together, and imported traces, in the order of the old store."""
    steps: list[_ReadingStep | OldTrace] = []
    alike = groupby(traces, key=lambda t: (t.digest, t.settings, t.since, t.until, t.map_id))
    for _, views in alike:
        group = list(views)
        first = group[0]
        if first.imported is not None:
            steps += group
            continue
        path, part = places[first.trace_id], (first.since, first.until)
        step = _ReadingStep(_as_egos(path, group), part, first.map_id, (path,))
        last = steps[-1] if steps else None
        if isinstance(last, _ReadingStep) and replace(last, paths=step.paths) == step:
            steps[-1] = replace(last, paths=(*last.paths, path))
        else:
            steps.append(step)
    yield from steps


def _as_egos(path: Path, views: Sequence[OldTrace]) -> Config:
    """Return settings with which the ingest of a recording selects the same egos as in the old store."""
    config = _settings(views[0])
    if len(views) > 1:
        return replace(config, egos=tuple(one.ego for one in views))
    ego = views[0].ego
    with open_trace(path, digest=views[0].digest, mapping=config.mapping) as trace:
        return config if trace.info.ego == ego else replace(config, ego=ego)


def _read(
    fresh: Path,
    step: _ReadingStep,
    maps: dict[int, OldMap],
    jobs: int,
    on_progress: Callable[[Progress], None] | None,
) -> None:
    """Ingest the recordings of a group of traces into the new store. Skip traces that it already has."""
    with _map_file(maps.get(step.map_id) if step.map_id is not None else None) as road_map:
        outcomes = ingest(
            fresh,
            step.paths,
            road_map=road_map,
            config=step.config,
            jobs=jobs,
            since=step.part[0],
            until=step.part[1],
            on_progress=on_progress,
        )
    wrong = [str(one.error) for one in outcomes if one.error is not None]
    if wrong:
        raise StoreError(_stopped(fresh, wrong))


def _stopped(fresh: Path, wrong: list[str]) -> str:
    listed = "\n  ".join(wrong[:_SHOWN])
    return f"{fresh}: not complete, so the old store stays; the next run goes on from there:\n  {listed}"


@contextmanager
def _map_file(road_map: OldMap | None) -> Generator[Path | None]:
    """Context manager: write a map of the old store to a temporary file, for recordings without a map."""
    if road_map is None or not road_map.text.lstrip("\ufeff \t\r\n").startswith("<"):
        yield None
        return
    with working_folder("map") as folder:
        path = folder / "map.xodr"
        # The byte order mark overrides the encoding in the text.
        path.write_bytes(road_map.text.encode("utf-16", "surrogatepass"))
        yield path


def _import(fresh: Path, trace: OldTrace, path: Path, maps: dict[int, OldMap]) -> None:
    """Import a graph file of another tool into the new store, with the same options as for the old store."""
    how: dict[str, Any] = {"relations": trace.answers, "period_s": trace.period_ns / 1e9 or 1.0}
    how |= trace.imported or {}
    form, words = how.pop("form"), how.pop("words", {})
    try:
        (done,) = import_graphs(fresh, [path], form, words=Words(**words), **how)
    except (TypeError, ValueError) as error:
        raise StoreError(_stopped(fresh, [f"{path}: {error}"])) from error
    reason = str(done.error or "")
    unknown = f"import it again afterwards, and add --leave-out {trace.name!r} now"
    if reason and "words" not in (trace.imported or {}):
        reason += f" (an older version did not keep how it was imported: {unknown})"
    if not reason and trace.map_id is not None:
        now = {one.digest for one in Remains.of(fresh).maps.values()}
        if maps[trace.map_id].digest not in now:
            StoreFile(fresh).remove(trace.trace_id)
            reason = f"{path}: it lacks its import options (--kind, --relation, …): {unknown}"
    if reason:
        raise StoreError(_stopped(fresh, [reason]))


def _complete(path: Path, fresh: Path, old: Remains) -> None:
    """Rebuild the derived relations and frame classes of the old store, and check that no trace is missing."""
    file = StoreFile(fresh)
    there = {one.trace_id for one in file.traces()}
    missing = [f"{one.name}: {one.path}" for one in old.traces if one.trace_id not in there]
    if missing:
        raise StoreError(_stopped(fresh, [f"gives another trace: {one}" for one in missing]))
    for one in old.sets:
        traces = [trace_id for trace_id in one.traces if trace_id in there]
        if set(one.settings) == {"abstraction"}:
            keep_abstraction(fresh, one.settings["abstraction"], traces)
        else:
            derive(fresh, from_dict(one.settings), one.name, traces, replace_old=True)
    for name in old.abstractions:
        with suppress(SgstoreError):  # A client's own abstraction is computed on demand.
            file.abstracted.complete(name)
    if set(there) != {one.trace_id for one in old.traces}:
        raise StoreError(f"{path}: left as it is: {fresh} holds other traces; remove that file")
