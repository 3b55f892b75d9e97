"""Search for the test cases of a lock in a store: their frames and clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sgstore.errors import StoreError
from sgstore.model.frame_ids import frame_ids
from sgstore.query import Store
from sgstore.store import Identity, Mark, StoredTrace
from sgstore.testsets.locks._cases import locked
from sgstore.testsets.locks._text import (
    Lock,
    LockedCase,
    LockedTrace,
    lock_from,
    made_with,
    read_lock,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.collection import Collection
    from sgstore.model.world import Ints

    Payload = dict[str, str]


def cases_of(lock: str | Path | Lock, store: Store) -> list[tuple[str, int, int, str]]:
    """Return the clips of a lock: trace name in the store, first and last log time (ns), and case id.

    Parameters
    ----------
    lock : str, Path or Lock
    store : Store

    Returns
    -------
    list of tuple
        Name of the trace in the store, first and last log time (ns), and id, in the order of
        :attr:`Lock.ordered`.

    Raises
    ------
    StoreError
        The lock is unreadable; or the store lacks one of its traces, or has it with other settings.
        Graphs and payloads are not compared: :func:`sgstore.testsets.locks.verify` does that.
    """
    known = read_lock(lock) if isinstance(lock, str | Path) else lock
    names = {one.name: _same(one, store).name for one in known.traces}
    return [(names[case.trace], case.start_ns, case.end_ns, case.id) for case in known.ordered]


def _same(trace: LockedTrace, store: Store) -> StoredTrace:
    """Return the stored trace of a lock entry. If it is missing, or was read differently, raise an error."""
    trace_id = Identity.id_of(trace.recording, trace.ego)
    found = next((one for one in store.info() if one.trace_id == trace_id), None)
    if found is None:
        raise _not_there(trace, store.file.path)
    mine = locked(found, Mark.of_traces(store.file)[trace_id])
    for name, said in (("config", "other settings"), ("map", "another road map")):
        if getattr(mine, name) != getattr(trace, name):
            raise StoreError(
                f"{store.file.path}: {found.name!r} was read with {said} than the lock says"
            )
    if (mine.since, mine.until) != (trace.since, trace.until):
        raise StoreError(
            f"{store.file.path}: another part of {found.name!r} was read than the lock records"
        )
    return found


def _not_there(trace: LockedTrace, place: str | Path) -> StoreError:
    return StoreError(
        f"{place}: no trace {trace.name!r} of the recording {trace.recording[:12]}…, which the"
        " lock names; ingest it"
    )


def rows_of(
    cases: Sequence[LockedCase], trace_ids: Sequence[int], frame_id: Ints
) -> tuple[Ints, Ints]:
    """For each test case, return its range in an array of ascending frame ids: first index, end index."""
    of = np.array(trace_ids, np.int64)
    first = frame_ids(of, np.array([case.first for case in cases], np.int64))
    last = frame_ids(of, np.array([case.last for case in cases], np.int64))
    return np.searchsorted(frame_id, first), np.searchsorted(frame_id, last, side="right")


def frames_of_lock(lock: Lock, store: Store | Collection) -> Ints:
    """Return the ids of all frames in the test cases of a lock, ascending.

    Raises
    ------
    StoreError
        The store lacks a trace of the lock, or has it with other settings.
    """
    if not isinstance(store, Store):
        own, lacking = by_bundle(lock, store)
        if lacking:
            raise _not_there(lacking[0], store.place.url)
        asked = {bundle: {"lock": part.text()} for bundle, part in own.items()}
        found = [np.array(own, np.int64) for _, own in store.each(frames_in, asked)]
        return np.sort(np.concatenate([np.zeros(0, np.int64), *found]))
    traces = {one.name: _same(one, store).trace_id for one in lock.traces}
    there, _ = store.file.abstracted.times()
    begin, end = rows_of(lock.cases, [traces[case.trace] for case in lock.cases], there)
    step = np.zeros(len(there) + 1, np.int64)
    np.add.at(step, begin, 1)
    np.add.at(step, end, -1)
    return there[np.cumsum(step)[:-1] > 0]


def frames_in(store: Store, lock: str) -> list[int]:
    """For one bundle of a collection, return the frame ids of a lock's test cases, ascending."""
    return frames_of_lock(lock_from(lock), store).tolist()


def by_bundle(
    lock: Lock, whole: Collection, *, by_name: bool = False
) -> tuple[dict[str, Lock], list[LockedTrace]]:
    """Split a lock into one part for each bundle (store) of a collection. Also return traces in no bundle."""
    names = {row["name"]: row["bundle"] for row in whole.traces()} if by_name else {}
    home: dict[str, str] = {}
    for one in lock.traces:
        found = whole.snapshot.homes.get(Identity.id_of(one.recording, one.ego)) or names.get(
            one.name
        )
        if found is not None:
            home[one.name] = found
    by_bundle: dict[str, Lock] = {}
    for bundle in dict.fromkeys(home.values()):
        traces = tuple(one for one in lock.traces if home.get(one.name) == bundle)
        cases = tuple(one for one in lock.cases if home.get(one.trace) == bundle)
        by_bundle[bundle] = Lock(made_with(), {}, traces, cases, lock.format)
    return by_bundle, [one for one in lock.traces if one.name not in home]


def store_beside(path: str | Path, lock: Lock) -> Path:
    """Return the only store with all traces of a lock, from the lock's folder or the working folder.

    Raises
    ------
    StoreError
        There is no such store, or several.
    """
    folders = Path(path).parent, Path()
    beside = {one.resolve(): one for f in folders for one in sorted(f.glob("*.sgstore"))}
    wanted = {Identity.id_of(one.recording, one.ego) for one in lock.traces}
    having: list[Path] = []
    for one in beside.values():
        try:
            if wanted <= {trace.trace_id for trace in Store(one).info()}:
                having.append(one)
        except StoreError:  # another version, or not a store: skip it
            continue
    if len(having) == 1:
        return having[0]
    names = ", ".join(one.name for one in having) or "none"
    raise StoreError(
        f"{path}: which store? Those beside it that have its traces: {names}; write STORE:{path}"
    )
