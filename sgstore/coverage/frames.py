"""Which frames coverage is of: a store, or what a query finds in it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sgstore.coverage.asking import block_of
from sgstore.errors import StoreError
from sgstore.locks import frames_of_lock, read_lock, store_beside
from sgstore.locks.lock import ENDING as LOCK
from sgstore.query import Store
from sgstore.store.covering import begins, seq_of, trace_of
from sgstore.world import GAP

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.world import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class Chosen:
    """Frames of a store.

    Attributes
    ----------
    text : str
        What they were called.
    store : Store
    frame_id : int64 or None
        Ascending; ``None``: all.
    left_out : tuple of str
        Traces that cannot answer the query.
    """

    text: str
    store: Store
    frame_id: Ints | None = None
    left_out: tuple[str, ...] = ()

    def rows_of(self, frame_id: Ints) -> Ints:
        """Which of frames, by ascending id, are chosen: their rows."""
        if self.frame_id is None:
            return np.arange(len(frame_id))
        at = np.searchsorted(frame_id, self.frame_id)
        known = at < len(frame_id)
        known[known] = frame_id[at[known]] == self.frame_id[known]
        return at[known].astype(np.int64)


def selection_of(text: str) -> Chosen:
    """The frames that a text means: a store, those of it in which a query holds, or those of a lock.

    Parameters
    ----------
    text : str
        ``STORE``, ``STORE:QUERY``, ``STORE:LOCK``; or ``LOCK``, if one store beside it has all its traces. A
        lock is a file that is called ``….lock``.

    Raises
    ------
    StoreError
        There is no such store, the lock cannot be read, or the store lacks what it names.
    QueryError
        The query is none.
    """
    whole = Path(text)
    if whole.suffix == LOCK and whole.is_file():
        lock = read_lock(whole)
        store = Store(store_beside(whole, lock))
        return Chosen(text, store, frames_of_lock(lock, store))
    if whole.exists():
        return Chosen(text, Store(whole))
    for colon in re.finditer(":", text):
        path, query = Path(text[: colon.start()]), text[colon.end() :]
        if path.is_file():
            store = Store(path)
            if Path(query).suffix == LOCK and Path(query).is_file():
                return Chosen(text, store, frames_of_lock(read_lock(Path(query)), store))
            found = frames_of(store, query)
            return Chosen(text, store, found, store.find(query).left_out)
    raise StoreError(
        f"{text}: neither a store nor STORE:QUERY, such as 'drives.sgstore:MATCH (p:Person)', nor a"
        " lock"
    )


def frames_of(store: Store, query: str, /, **parameters: object) -> Ints:
    """Ids of the frames in which a query holds, ascending. ``**parameters``: values of ``$name`` in it."""
    if block_of(query) is not None:  # in columns
        found = store.find(f"{query} RETURN FRAMES", **parameters).numpy()["frame_id"]
        return np.unique(found.astype(np.int64))
    rows = (frame.frame_id for frame in store.find(query, **parameters).frames())
    return np.unique(np.fromiter(rows, np.int64))


def periods_of(store: Store, frame_id: Ints) -> Floats:
    """(N,): the median period of the trace of each frame; ns."""
    periods = {one.trace_id: one.period_ns for one in store.info()}
    traces, number = np.unique(trace_of(frame_id), return_inverse=True)
    return np.array([periods.get(one, 0) for one in traces.tolist()], np.float64)[number]


def run_begins(store: Store, frame_id: Ints, time_ns: Ints) -> Bools:
    """(N,): which frames begin a run: the first of a trace, and the first where some are missing before it."""
    step = np.diff(time_ns, prepend=time_ns[:1])
    return begins(frame_id) | (step > GAP * periods_of(store, frame_id)) | (step < 0)


def names_of(store: Store, frame_id: Sequence[int] | Ints) -> list[str]:
    """Frames as every command takes them: ``TRACE#SEQ``."""
    traces = {trace.trace_id: trace.name for trace in store.info()}
    ids = np.asarray(frame_id, np.int64)
    return [
        f"{traces.get(trace, trace)}#{seq}"
        for trace, seq in zip(trace_of(ids).tolist(), seq_of(ids).tolist(), strict=True)
    ]
