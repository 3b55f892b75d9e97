"""The cases of a lock in a store: their frames, and their clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sgstore.errors import StoreError
from sgstore.locks.contents import locked
from sgstore.locks.lock import read_lock
from sgstore.query import Store
from sgstore.store.contents import marks
from sgstore.store.packing import frame_ids
from sgstore.store.traces import trace_id_of

if TYPE_CHECKING:
    from sgstore.locks.lock import Lock, LockedCase, LockedTrace
    from sgstore.store import StoredTrace
    from sgstore.world import Ints


def cases_of(lock: Path | Lock, store: Store) -> list[tuple[str, int, int, str]]:
    """The clips that a lock names, as a store has them.

    Parameters
    ----------
    lock : Path or Lock
    store : Store

    Returns
    -------
    list of tuple
        Name of the trace in the store, first and last log time (ns), and id, in the order of the lock.

    Raises
    ------
    StoreError
        The lock cannot be read; or the store lacks a trace of it, or has it read in another way. Whether graphs
        and payloads are the same is not looked at: :func:`sgstore.locks.verify` does that.
    """
    known = read_lock(lock) if isinstance(lock, Path) else lock
    names = {one.name: _same(one, store).name for one in known.traces}
    return [(names[case.trace], case.start_ns, case.end_ns, case.id) for case in known.cases]


def _same(trace: LockedTrace, store: Store) -> StoredTrace:
    """The trace of a store that is one of a lock, read in the same way."""
    trace_id = trace_id_of(trace.recording, trace.ego)
    found = next((one for one in store.info() if one.trace_id == trace_id), None)
    if found is None:
        raise StoreError(
            f"{store.file.path}: no trace {trace.name!r} of the recording {trace.recording[:12]}…, which the"
            " lock names; ingest it"
        )
    mine = locked(found, marks(store.file)[trace_id])
    for name, said in (("config", "other settings"), ("map", "another road map")):
        if getattr(mine, name) != getattr(trace, name):
            raise StoreError(
                f"{store.file.path}: {found.name!r} was read with {said} than the lock says"
            )
    if (mine.since, mine.until) != (trace.since, trace.until):
        raise StoreError(
            f"{store.file.path}: another part of {found.name!r} was read than the lock says"
        )
    return found


def rows_of(case: LockedCase, trace_id: int, frame_id: Ints) -> slice:
    """Which of the frames of a store, by ascending id, are those of a case."""
    first, last = frame_ids(trace_id, np.array([case.first, case.last]))
    return slice(
        int(np.searchsorted(frame_id, first)), int(np.searchsorted(frame_id, last, side="right"))
    )


def frames_of_lock(lock: Lock, store: Store) -> Ints:
    """Ids of the frames of a lock's cases in a store, ascending.

    Raises
    ------
    StoreError
        The store lacks a trace of the lock, or has it read in another way.
    """
    traces = {one.name: _same(one, store).trace_id for one in lock.traces}
    there, _ = store.file.abstracted.times()
    wanted = np.zeros(len(there), np.bool_)
    for case in lock.cases:
        wanted[rows_of(case, traces[case.trace], there)] = True
    return there[wanted]


def store_beside(path: Path, lock: Lock) -> Path:
    """The one store in a lock's folder, or where the program runs, that has all traces of the lock.

    Raises
    ------
    StoreError
        There is none, or there are several.
    """
    beside = {one.resolve(): one for folder in (path.parent, Path()) for one in _stores(folder)}
    wanted = {trace_id_of(one.recording, one.ego) for one in lock.traces}
    having: list[Path] = []
    for one in beside.values():
        try:
            if wanted <= {trace.trace_id for trace in Store(one).info()}:
                having.append(one)
        except StoreError:  # of another version, or no store: not what is looked for
            continue
    if len(having) == 1:
        return having[0]
    names = ", ".join(one.name for one in having) or "none"
    raise StoreError(
        f"{path}: which store? Those beside it that have its traces: {names}; write STORE:{path}"
    )


def _stores(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.sgstore"))
