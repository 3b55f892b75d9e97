"""Frames whose coverage is measured: all frames of a store, or the matches of a query."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import StoreError, one_store_needed, url_named
from sgstore.model.frame_ids import begins, seq_of, trace_of
from sgstore.model.scope import scope_of
from sgstore.model.world import longest_step_ns
from sgstore.query import Store
from sgstore.testsets.coverage._frames import block_of
from sgstore.testsets.locks import ENDING as LOCK
from sgstore.testsets.locks import frames_of_lock, read_lock, store_beside

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager

    from sgstore.collection import Collection, CollectionFrames
    from sgstore.lang.catalog import TraceFacts
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.store import Abstracted, StoredTrace


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """Selected frames of a store or a collection (many stores).

    Attributes
    ----------
    text : str
        Text that selected them.
    store : Store or Collection
    frame_id : int64 or None
        Ascending; ``None`` means all frames.
    reasons : mapping of str to str
        Traces that cannot answer the query, with the reason.
    query : str
        Query that selected them; empty: none.
    parameters : mapping of str to value
        Values of ``$name`` in the query.
    notes : tuple of str
        Notes on likely mistakes in the query.
    """

    text: str
    store: Store | Collection
    frame_id: Ints | None = None
    reasons: Mapping[str, str] = field(default_factory=dict[str, str])
    query: str = ""
    parameters: Mapping[str, object] = field(default_factory=dict[str, object])
    notes: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the names of the traces that cannot answer the query."""
        return tuple(self.reasons)

    def scope(self, *, world: bool) -> dict[str, Any]:
        """Return which data the ingest settings excluded from the store of the frames, as JSON values."""
        chosen = None
        if self.frame_id is not None:
            chosen = set(np.unique(trace_of(self.frame_id)).tolist())
        if not isinstance(self.store, Store):
            return self.store.snapshot.scope(world=world, traces=chosen)
        traces = [one for one in self.store.info() if chosen is None or one.trace_id in chosen]
        return scope_of((one.report for one in traces), world=world)

    @property
    def one_store(self) -> Store:
        """Return the store of the frames. If the frames are of a collection, raise an error.

        Raises
        ------
        StoreError
            The frames belong to a collection.
        """
        if isinstance(self.store, Store):
            return self.store
        raise one_store_needed(self.store.place.url)

    def joined(self, tables: Mapping[str, Path]) -> ChosenFrames:
        """Return the same frames, with a store that has the given user tables for queries."""
        if not tables:
            return self
        if isinstance(self.store, Store):
            return replace(self, store=Store(self.store.file.path, tables=tables))
        return replace(self, store=self.store.joined(tables))

    @property
    def abstracted(self) -> Abstracted | CollectionFrames:
        """Return the object that computes scene classes and features of the frames for an abstraction."""
        return self.store.file.abstracted

    @property
    def place(self) -> str:
        """Return the path of the store, or the URL of the collection, that contains the frames."""
        if isinstance(self.store, Store):
            return str(self.store.file.path.resolve())
        return self.store.place.url

    def snapshot(self) -> AbstractContextManager[object]:
        """Return a context manager. Several queries inside it see the same state of the store."""
        return self.store.file.snapshot()

    def rows_of(self, frame_id: Ints) -> Ints:
        """Return the positions of the selected frames in an array of ascending frame ids."""
        if self.frame_id is None:
            return np.arange(len(frame_id))
        at = np.searchsorted(frame_id, self.frame_id)
        known = at < len(frame_id)
        known[known] = frame_id[at[known]] == self.frame_id[known]
        return at[known].astype(np.int64)


def selection_of(
    text: str, *, max_spill: int = 0, engine: str = "local", partial: bool = False
) -> ChosenFrames:
    """Return the frames that a text selects: a store, a store with a query, or a lock file.

    Parameters
    ----------
    text : str
        ``STORE``, ``STORE:QUERY``, ``STORE:LOCK``; or ``LOCK``, if exactly one store in its folder
        has all its traces. A lock is a file with the ending ``.lock``. ``STORE`` can be a
        collection: a folder, or a URL.
    max_spill : int
        As in :class:`sgstore.query.Store`; bytes.
    engine, partial : str, bool
        Engine of a collection, and True if bundles may be missing; as in
        :class:`sgstore.collection.Collection`.

    Raises
    ------
    StoreError
        The store is missing, the lock is unreadable, or the store lacks its contents.
    QueryError
        The query is invalid.
    """
    whole = Path(text)
    if whole.suffix == LOCK and whole.is_file():
        lock = read_lock(whole)
        store = Store(store_beside(whole, lock), max_spill=max_spill)
        return ChosenFrames(text, store, frames_of_lock(lock, store))
    place, query = _place_and_query(text)
    store = _opened(place, max_spill=max_spill, engine=engine, partial=partial)
    if not query:
        return ChosenFrames(text, store)
    if Path(query).suffix == LOCK and Path(query).is_file():
        return ChosenFrames(text, store, frames_of_lock(read_lock(Path(query)), store))
    return ChosenFrames(text, store, frames_of(store, query), store.find(query).reasons)


def _place_and_query(text: str) -> tuple[str, str]:
    """Split a text such as ``STORE:QUERY`` into the path of a store or collection, and the query."""
    if url_named(text) is not None:
        colon = _BEFORE_QUERY.search(text)
        return (text, "") if colon is None else (text[: colon.start()], text[colon.end() :])
    if Path(text).exists():
        return text, ""
    for colon in re.finditer(":", text):
        place, query = text[: colon.start()], text[colon.end() :]
        if Path(place).is_file() or _is_collection(place):
            return place, query
    raise StoreError(
        f"{text}: neither a store nor STORE:QUERY, such as 'drives.sgstore:MATCH (p:Person)', nor a"
        " lock"
    )


def _is_collection(place: str) -> bool:
    if url_named(place) is not None:
        return True
    if not Path(place).is_dir():
        return False
    from sgstore.collection import ABOUT

    return Path(place, ABOUT).is_file()


_BEFORE_QUERY: Final = re.compile(r":(?![/\d])")
"""Regular expression of the colon before a query. A colon inside a URL does not match."""


def _opened(
    place: str, *, max_spill: int = 0, engine: str = "local", partial: bool = False
) -> Store | Collection:
    """Open a store or a collection (many stores) for queries."""
    if not _is_collection(place):
        return Store(place, max_spill=max_spill)
    from sgstore.collection import Collection

    return Collection(place, engine=engine, partial=partial)


def frames_of(store: Store | Collection, query: str, /, **parameters: object) -> Ints:
    """Return the ids of the frames that match a query, ascending."""
    if block_of(query) is not None:  # read as columns
        found = store.find(f"{query} RETURN FRAMES", **parameters).numpy()["frame_id"]
        return np.unique(found.astype(np.int64))
    rows = (frame.frame_id for frame in store.find(query, **parameters).frames())
    return np.unique(np.fromiter(rows, np.int64))


def traces_of(store: Store | Collection) -> Sequence[StoredTrace | TraceFacts]:
    """Return the traces of a store or collection, sorted by name."""
    return store.info() if isinstance(store, Store) else store.catalog.traces


def recordings_of(store: Store | Collection) -> dict[int, str]:
    """Return the digest of the recording file of each trace, by trace id."""
    if isinstance(store, Store):
        return {one.trace_id: one.digest for one in store.info()}
    return {one["trace_id"]: one["digest"] for one in store.traces()}


def periods_of(store: Store | Collection, frame_id: Ints) -> Floats:
    """Return the frame period in ns for each frame, (N,): the median of its trace."""
    periods = {one.trace_id: one.period_ns for one in traces_of(store)}
    traces, number = np.unique(trace_of(frame_id), return_inverse=True)
    return np.array([periods.get(one, 0) for one in traces.tolist()], np.float64)[number]


def run_begins(store: Store | Collection, frame_id: Ints, time_ns: Ints) -> Bools:
    """Return a mask (N,): True for the first frame of a trace, and for a frame after a time gap."""
    step = np.diff(time_ns, prepend=time_ns[:1])
    periods, place = np.unique(periods_of(store, frame_id), return_inverse=True)
    longest = np.array([longest_step_ns(int(period)) for period in periods.tolist()])
    return begins(frame_id) | (step > longest[place]) | (step < 0)


def names_of(store: Store | Collection, frame_id: Sequence[int] | Ints) -> list[str]:
    """Return the names of frames in the form ``TRACE#SEQ``."""
    traces = {trace.trace_id: trace.name for trace in traces_of(store)}
    ids = np.asarray(frame_id, np.int64)
    return [
        f"{traces.get(trace, trace)}#{seq}"
        for trace, seq in zip(trace_of(ids).tolist(), seq_of(ids).tolist(), strict=True)
    ]
