"""Selections of frames, missing values as queries, and result tables.

Missing features and slot values are returned as queries that users can run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import StoreError, one_store_needed, url_named
from sgstore.lang.syntax import node_of_kind
from sgstore.model.frame_ids import begins, seq_of, trace_of
from sgstore.model.scope import scope_of
from sgstore.model.vocabulary import KINDS
from sgstore.model.world import longest_step_ns
from sgstore.query import Store
from sgstore.testsets.locks import ENDING as LOCK
from sgstore.testsets.locks import frames_of_lock, read_lock, store_beside

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager

    from sgstore.collection import Collection, CollectionFrames
    from sgstore.lang.catalog import TraceFacts
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.store import Abstracted, StoredTrace


_EGOS: Final = ("ego", "ego_car")
_ROLE: Final = re.compile(r"Ego Lane|(Left|Right) \d+ of Ego Lane|Opposing Lane \d+")
_PARTS: Final = {
    "Lane": ":Lane",
    "Off Road": ":OffRoad",
    "Road": ":Road",
    "Root Road": ":Road",
    "Junction": ":Junction",
}


def query_of_features(features: Sequence[tuple[str, ...]]) -> str | None:
    """Return a query for frames with all of these features; ``None`` if a feature has no pattern.

    Parameters
    ----------
    features : sequence
        Labels of an edge's source, edge and destination; or of a node.
    """
    patterns = [_pattern(feature) for feature in features]
    known = [pattern for pattern in patterns if pattern is not None]
    if len(known) < len(patterns):
        return None
    rest = " AND ".join(f"EXISTS {{{pattern}}}" for pattern in known[1:])
    return f"MATCH {known[0]}{' WHERE ' if rest else ''}{rest} RETURN FRAMES"


def is_of_ego(feature: Sequence[str]) -> bool:
    """True for a feature of the ego, or of a lane by its role relative to the ego."""
    return any(label in _EGOS or _ROLE.fullmatch(label) for label in feature[::2])


def _pattern(feature: Sequence[str]) -> str | None:
    nodes = [_node(label) for label in feature[::2]]
    if any(node is None for node in nodes):
        return None
    return f"{nodes[0]}-[:{feature[1]}]->{nodes[1]}" if len(feature) > 1 else nodes[0]


def _node(label: str) -> str | None:
    """Return the pattern of a node with a label of an abstraction."""
    if label in _EGOS:
        return "(:Ego)"
    if label in _PARTS:
        return f"({_PARTS[label]})"
    if _ROLE.fullmatch(label):
        return f"(:Lane {{role: '{label}'}})"
    if label in KINDS:
        return node_of_kind(label)
    return None


_PATTERN: Final = re.compile(r"\s*MATCH\b(?P<body>.*)", re.IGNORECASE | re.DOTALL)
_BEYOND: Final = re.compile(
    r"\b(RETURN|ORDER\s+BY|LIMIT|SAMPLE|THEN|UNTIL|FOR|CHECK|USING|DEFINE)\b|;|(?<!<)--(?!\(|>\s*\()|/\*",
    re.IGNORECASE,
)
_TEXT: Final = re.compile(r"'(?:[^'\\]|\\.|'')*'")


def block_of(pattern: str) -> str | None:
    """Convert ``MATCH … WHERE …`` to the content of ``EXISTS {…}``; ``None`` for other clauses."""
    found = _PATTERN.fullmatch(pattern)
    if found is None or _BEYOND.search(_TEXT.sub("''", found["body"])):
        return None
    return found["body"].strip()


def query_of_blocks(there: Sequence[str], absent: Sequence[str]) -> str:
    """Return a query for frames with some blocks and without others."""
    parts = [f"EXISTS {{{block}}}" for block in there]
    parts += [f"NOT EXISTS {{{block}}}" for block in absent]
    where = f" WHERE {' AND '.join(parts)}" if parts else ""
    return f"MATCH (){where} RETURN FRAMES"


# Results of the commands of coverage: a table, and notes about its denominators.

Row = tuple[Any, ...]


@dataclass(frozen=True)
class ReportTable:
    """Table with column names.

    Attributes
    ----------
    columns : tuple of str
    rows : list of tuple
    said : list of str
        Notes that are needed to read the table.
    """

    columns: tuple[str, ...]
    rows: list[Row]
    said: list[str] = field(default_factory=list[str])

    def without(self, *names: str) -> ReportTable:
        """Return the table without some columns."""
        kept = [place for place, name in enumerate(self.columns) if name not in names]
        rows = [tuple(row[place] for place in kept) for row in self.rows]
        return ReportTable(tuple(self.columns[place] for place in kept), rows, self.said)

    def column(self, name: str) -> list[Any]:
        """Return the values of a column."""
        place = self.columns.index(name)
        return [row[place] for row in self.rows]

    def dicts(self) -> list[dict[str, Any]]:
        """Return the rows as dicts from column to value."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


SHARES = ("measure", "part", "of", "share", "denominator")
"""Columns of a table of shares, with the denominator of each share."""


def share(measure: str, part: float, of: float, denominator: str) -> Row:
    """Return a row of a table of shares; the share is ``None`` for an empty denominator."""
    return measure, part, of, part / of if of else None, denominator


def of_unknown(unknown: int, text: str) -> list[str]:
    """Return the note about frames without a class, or an empty list."""
    if not unknown:
        return []
    return [
        f"{unknown} frames of {text} are too symmetric for a class to be told; they count nowhere"
    ]


# Which frames coverage is of: a store, or what a query finds in it ------------------------------


@dataclass(frozen=True, slots=True)
class ChosenFrames:
    """Frames of a store, or of a collection.

    Attributes
    ----------
    text : str
        Text that selected them.
    store : Store or Collection
    frame_id : int64 or None
        Ascending; ``None`` means all frames.
    reasons : mapping of str to str
        Traces that cannot answer the query, with the reason.
    """

    text: str
    store: Store | Collection
    frame_id: Ints | None = None
    reasons: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the traces that cannot answer the query."""
        return tuple(self.reasons)

    def scope(self, *, world: bool) -> dict[str, Any]:
        """Return the omissions by settings, as :func:`sgstore.model.scope.scope_of`."""
        chosen = None
        if self.frame_id is not None:
            chosen = set(np.unique(trace_of(self.frame_id)).tolist())
        if not isinstance(self.store, Store):
            return self.store.snapshot.scope(world=world, traces=chosen)
        traces = [one for one in self.store.info() if chosen is None or one.trace_id in chosen]
        return scope_of((one.report for one in traces), world=world)

    @property
    def one_store(self) -> Store:
        """Return the store of the frames.

        Raises
        ------
        StoreError
            The frames belong to a collection.
        """
        if isinstance(self.store, Store):
            return self.store
        raise one_store_needed(self.store.place.url)

    def joined(self, tables: Mapping[str, Path]) -> ChosenFrames:
        """Return the same frames with user tables for patterns; see :class:`sgstore.query.Store`."""
        if not tables:
            return self
        if isinstance(self.store, Store):
            return replace(self, store=Store(self.store.file.path, tables=tables))
        return replace(self, store=self.store.joined(tables))

    @property
    def abstracted(self) -> Abstracted | CollectionFrames:
        """Return the interface of its store for abstractions."""
        return self.store.file.abstracted

    @property
    def place(self) -> str:
        """Return the path or URL of its store."""
        if isinstance(self.store, Store):
            return str(self.store.file.path.resolve())
        return self.store.place.url

    def snapshot(self) -> AbstractContextManager[object]:
        """Keep a store open for several queries; a collection never changes."""
        return self.store.file.snapshot()

    def rows_of(self, frame_id: Ints) -> Ints:
        """Return the rows of the chosen frames among frames with ascending ids."""
        if self.frame_id is None:
            return np.arange(len(frame_id))
        at = np.searchsorted(frame_id, self.frame_id)
        known = at < len(frame_id)
        known[known] = frame_id[at[known]] == self.frame_id[known]
        return at[known].astype(np.int64)


def selection_of(
    text: str, *, max_spill: int = 0, engine: str = "local", partial: bool = False
) -> ChosenFrames:
    """Parse a selection: a store, frames of it by a query, or frames of a lock.

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
    """Split a text into the place of a store or collection, and the query after it."""
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
"""Colon before a query, but not one inside a URL."""


def _opened(
    place: str, *, max_spill: int = 0, engine: str = "local", partial: bool = False
) -> Store | Collection:
    """Open a store or a collection; options as in :func:`selection_of`."""
    if not _is_collection(place):
        return Store(place, max_spill=max_spill)
    from sgstore.collection import Collection

    return Collection(place, engine=engine, partial=partial)


def frames_of(store: Store | Collection, query: str, /, **parameters: object) -> Ints:
    """Return the ids of the frames that match a query, ascending; ``**parameters`` are its ``$name`` values."""
    if block_of(query) is not None:  # read as columns
        found = store.find(f"{query} RETURN FRAMES", **parameters).numpy()["frame_id"]
        return np.unique(found.astype(np.int64))
    rows = (frame.frame_id for frame in store.find(query, **parameters).frames())
    return np.unique(np.fromiter(rows, np.int64))


def traces_of(store: Store | Collection) -> Sequence[StoredTrace | TraceFacts]:
    """Return the traces of a store or collection, by name."""
    return store.info() if isinstance(store, Store) else store.catalog.traces


def recordings_of(store: Store | Collection) -> dict[int, str]:
    """Return the digest of the recording of each trace, by trace id."""
    if isinstance(store, Store):
        return {one.trace_id: one.digest for one in store.info()}
    return {one["trace_id"]: one["digest"] for one in store.traces()}


def periods_of(store: Store | Collection, frame_id: Ints) -> Floats:
    """Return the median period of the trace of each frame, (N,); ns."""
    periods = {one.trace_id: one.period_ns for one in traces_of(store)}
    traces, number = np.unique(trace_of(frame_id), return_inverse=True)
    return np.array([periods.get(one, 0) for one in traces.tolist()], np.float64)[number]


def run_begins(store: Store | Collection, frame_id: Ints, time_ns: Ints) -> Bools:
    """Return a mask (N,) of frames that begin a run: the first of a trace, or after a gap."""
    step = np.diff(time_ns, prepend=time_ns[:1])
    periods, place = np.unique(periods_of(store, frame_id), return_inverse=True)
    longest = np.array([longest_step_ns(int(period)) for period in periods.tolist()])
    return begins(frame_id) | (step > longest[place]) | (step < 0)


def names_of(store: Store | Collection, frame_id: Sequence[int] | Ints) -> list[str]:
    """Return the names of frames in the usual notation, ``TRACE#SEQ``."""
    traces = {trace.trace_id: trace.name for trace in traces_of(store)}
    ids = np.asarray(frame_id, np.int64)
    return [
        f"{traces.get(trace, trace)}#{seq}"
        for trace, seq in zip(trace_of(ids).tolist(), seq_of(ids).tolist(), strict=True)
    ]
