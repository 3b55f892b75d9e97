"""Table rows of a new trace: arrays in a file next to the store, until the trace is published.

Large tables are cut into parts of some ten thousand rows. Each part is sorted in store order and appended to
the file, so memory does not grow. In the end, one file has all tables, with a checksum of each.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import duckdb
import numpy as np

from sgstore.errors import StoreError
from sgstore.model.vocabulary import NAMES
from sgstore.store._checksums import Checksum, as_summed
from sgstore.store._columns import (
    REPEATED,
    STATES,
    TEXTS,
    chained,
    in_order,
    kept,
    marked,
    parted,
    types_of,
)
from sgstore.store._engine_errors import os_fault
from sgstore.store._locking import memory_setting, without_faults
from sgstore.store._schema import enums_of, own_labels
from sgstore.store._store_paths import Folder
from sgstore.store._table_stream import FILE, Piece, TableFile
from sgstore.store._traces import Identity

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._packing import Columns


PART_ROWS: Final = 20_000
"""Largest number of rows in memory, for all growing tables together."""

PIECE_ROWS: Final = 60_000
"""Largest number of rows that are read and inserted at once."""

MERGE_ROWS: Final = 1 << 19
"""Number of rows at which incomplete masks are merged, before their bucket is complete."""

_GROWING: Final = (
    *("state", "lane_single", "gap_single", "node", "edge", "frame_class", "lane_role"),
    *("world_state", "world_lane_single", "world_gap_single", "world_node", "world_edge"),
    *("later_class", "derived_node", "derived_edge", "derived_gap", "message"),
)
"""Tables whose size grows with the length of a trace."""

_ALONG: Final = ("frame", "imported", "attribute")
"""Further growing tables, which do not count for the limit of rows in memory."""

_CUT: Final = frozenset({*_GROWING, *_ALONG})
"""All tables whose rows are written in parts."""

_RUNS: Final = {
    "node": "kind",
    "edge": "relation",
    "derived_node": "moves",
    "derived_edge": "relation",
}
"""Tables whose merged masks may exceed the memory → column by which they are sorted first."""


class StagedRows(NamedTuple):
    """Table rows that several new traces share (such as the rows of a road map), as bytes.

    ``words``: enumeration → values that ``schema.sql`` lacks.
    """

    pieces: bytes
    checksums: dict[str, Checksum]
    words: dict[str, list[str]]


class Staging:
    """Writer of the table rows of one new trace, in memory and in a file next to the store.

    Parameters
    ----------
    store : Path
        Target store.
    place : tuple, optional
        Folder of the file, removed by the caller; and the number of simultaneous stagings, which share the
        memory. Default: a folder next to the store, removed at close.

    Attributes
    ----------
    checksums : dict
        Table → checksum of its rows in the file; after sealing, of all rows.
    """

    def __init__(self, store: Path, place: tuple[Path, int] | None = None) -> None:
        folder, beside = place or (None, 1)
        self._store = store
        self._waiting: dict[str, list[Columns]] = defaultdict(list)
        self._rows: dict[str, int] = defaultdict(int)
        self._runs: dict[str, list[Piece]] = defaultdict(list)
        self._texts = {growing: {"": -1} for growing in (True, False)}
        self._most = MERGE_ROWS // beside
        self.checksums: dict[str, Checksum] = defaultdict(Checksum)
        self._new: dict[str, list[str]] = {}
        self._own = Folder(store) if folder is None else None
        self.folder = folder or (self._own.path if self._own else store)
        try:
            self._file = TableFile(self.folder / FILE, store, new=True)
        except BaseException:
            if self._own is not None:
                self._own.remove()
            raise

    def close(self) -> None:
        """Discard the table rows in memory, and remove the folder if this object created it."""
        self._waiting.clear()
        self._file.close()
        if self._own is not None:
            self._own.remove()

    def insert(self, table: str, columns: Columns) -> None:
        """Append rows to a table of the new trace. Missing values are non-finite, :data:`MISSING`, or empty."""
        rows = len(next(iter(columns.values())))
        if not rows:
            return
        types, enums = types_of(table), enums_of(table)
        staged: Columns = {}
        for name, values in columns.items():
            if types[name] in TEXTS:
                staged[name] = self._indices(table, values)
            else:
                staged[name] = kept(table, name, values)
            if name in enums:
                self._learn(enums[name], values)
        self._waiting[table].append(staged)
        self._rows[table] += rows
        if table in _RUNS and self._rows[table] >= self._most:
            self._merge(table)

    def _indices(self, table: str, values: NDArray[Any]) -> NDArray[np.int32]:
        known = self._texts[table in _CUT]
        found = [known.setdefault(text, len(known) - 1) for text in values.tolist()]
        return np.array(found, np.int32)

    def _learn(self, enum: str, codes: NDArray[Any]) -> None:
        """Collect the enumeration values of a column that are not in ``schema.sql``."""
        own = len(own_labels(enum))
        if codes.max() < own:
            return
        noted = self._new.setdefault(enum, [])
        found = [NAMES[enum][code] for code in np.unique(codes).tolist() if code >= own]
        noted += [name for name in found if name not in noted]

    def words(self, answers: Iterable[str]) -> dict[str, list[str]]:
        """Return the values that each enumeration type of the store must have: enumeration → values."""
        relations = sorted({*answers, *self._new.get("relation", ())})
        return {**self._new, "relation": relations}

    def shared(self) -> StagedRows:
        """Write all tables, and return their rows for other traces. Afterwards, the tables must not grow."""
        for table in [*self._waiting]:
            self.write(table)
        return StagedRows(self._file.behind(0), dict(self.checksums), dict(self._new))

    def adopt(self, rows: StagedRows) -> None:
        """Copy rows that another trace has written into this trace. Call this before rows are added."""
        self._file.adopt(rows.pieces)
        self.checksums.update(rows.checksums)
        self._new.update({enum: [*names] for enum, names in rows.words.items()})

    def mark(self, table: str, name: str, values: NDArray[Any]) -> None:
        """Add a column to all rows of a table. The table must not grow afterwards."""
        first = 0
        for staged in self._waiting[table]:
            rows = len(next(iter(staged.values())))
            staged[name] = kept(table, name, values[first : first + rows])
            first += rows

    def settle(self, *, whole: bool) -> None:
        """Write large tables to the file to free memory. Called between two blocks of frames.

        Parameters
        ----------
        whole : bool
            True if the rows end with a whole bucket. Only then can they form a part, because masks are merged
            within a part.
        """
        rows = sum(self._rows[table] for table in _GROWING)
        if whole and (rows >= PART_ROWS or any(self._runs.values())):
            for table in (*_GROWING, *_ALONG):
                self.write(table)
            self._texts[True] = {"": -1}

    def _merge(self, table: str) -> None:
        """Combine rows that differ only in their bit mask of frames. Write them to the file if many remain."""
        merged = self._gathered(table)
        rows = len(merged["mask"])
        self._waiting[table], self._rows[table] = [merged], rows
        if rows > self._most // 2:
            self._runs[table].append(self._file.append(f"{table} run", merged))
            self._waiting[table].clear()
            self._rows[table] = 0

    def _gathered(self, table: str) -> Columns:
        return in_order(table, chained(table, self._waiting.pop(table)), self._texts_of(table))

    def _texts_of(self, table: str) -> list[str]:
        return list(self._texts[table in _CUT])[1:]

    def write(self, table: str) -> None:
        """Move the rows of a table from memory to the file."""
        texts = self._texts_of(table)
        if self._runs[table]:
            if self._waiting[table]:
                self._runs[table].append(self._file.append(f"{table} run", self._gathered(table)))
            for columns in self._merged_runs(table, self._runs.pop(table)):
                self._put(table, columns, texts)
        elif self._waiting[table] and table in REPEATED:
            single, repeated = parted(self._gathered(table))
            self._put(table, single, texts)
            self._put(REPEATED[table], repeated, texts)
        elif self._waiting[table] and table in STATES:
            self._put(table, marked(self._gathered(table)), texts)
        elif self._waiting[table]:
            self._put(table, self._gathered(table), texts)
        self._waiting.pop(table, None)
        self._rows[table] = 0

    def _put(self, table: str, columns: Columns, texts: list[str]) -> None:
        count = len(next(iter(columns.values())))
        if not count:
            return
        self.checksums[table].add(as_summed(table, columns, texts))
        of_text = [name for name in columns if types_of(table)[name] in TEXTS]
        for first in range(0, count, PIECE_ROWS):
            some = {name: values[first : first + PIECE_ROWS] for name, values in columns.items()}
            said: dict[str, list[str]] = {}
            for name in of_text:
                used = np.unique(some[name])
                used = used[used >= 0]
                said[name] = [texts[index] for index in used.tolist()]
                at = np.searchsorted(used, some[name]).astype(np.int32)
                some[name] = np.where(some[name] < 0, np.int32(-1), at)
            self._file.append(table, some, said)

    def _merged_runs(self, table: str, runs: list[Piece]) -> Iterator[Columns]:
        """Merge sorted groups of rows of a table. Yield together the rows with the same value in column one."""
        name, texts = _RUNS[table], self._texts_of(table)
        firsts = [self._file.column(run, name) for run in runs]
        for value in np.unique(np.concatenate([np.unique(first) for first in firsts])).tolist():
            found: list[Columns] = []
            for run, first in zip(runs, firsts, strict=True):
                low, high = np.searchsorted(first, [value, value + 1]).tolist()
                if low < high:
                    found.append(self._file.read(run, low, high))
                if sum(len(one["mask"]) for one in found) > 2 * self._most:
                    found = [in_order(table, chained(table, found), texts)]
            yield in_order(table, chained(table, found), texts)

    def messages(self) -> Iterator[Columns]:
        """Yield the rows of all recorded messages in groups."""
        for piece in self._file.pieces("message"):
            yield self._file.read(piece)
        yield from self._waiting["message"]

    def seal(self) -> None:
        """Write all tables to the file. No rows can be added afterwards."""
        for table in [*self._waiting, *self._runs]:
            self.write(table)
        self._file.close()
        self.checksums.pop("message", None)
        self.checksums = dict(sorted(self.checksums.items()))


MEMORY: Final = 48 << 20
"""Memory limit of a publishing database; bytes. Beyond it, the database writes temporary files."""


def scratch(spill: Path, *, memory: int = 0, threads: int = 1) -> DuckDBPyConnection:
    """Open an in-memory database that can attach files. Data beyond the memory limit go to a folder.

    Parameters
    ----------
    memory : int
        Memory limit; bytes. 0: :data:`MEMORY`.
    threads : int
        Number of threads. Each has its own buffers.
    """
    config: dict[str, str | bool | int | float | list[str]] = {
        "memory_limit": memory_setting(memory or MEMORY),
        "temp_directory": str(spill),
        "threads": threads,
        "autoload_known_extensions": False,
        "autoinstall_known_extensions": False,
    }
    connection = duckdb.connect(":memory:", config=config)
    with suppress(
        duckdb.InvalidInputException
    ):  # Jupyter without ipywidgets has no progress bar, and raises an error
        connection.execute("SET enable_progress_bar = false")  # in interactive Python
    without_faults(connection)
    return connection


_SAID: Final = "sealed.json"
_PART: Final = re.compile(r"topic-\d+-\d+\.parquet", re.ASCII)


@dataclass(frozen=True, slots=True)
class Sealed:
    """Complete trace in files outside the store. Any process can add it to the store.

    Attributes
    ----------
    folder : Path
        Folder of its :class:`TableFile`.
    path : Path
        The recording.
    identity : Identity
    trace : dict
        Row of table ``trace``, without the values that the store assigns.
    checksums : dict
        Table → checksum of its rows.
    words : dict
        Enumeration → values that the store may have to add.
    topics : list of dict
        Topics with messages in files of the folder: attributes of :class:`sgstore.store._topics.TopicFile`.
    """

    folder: Path
    path: Path
    identity: Identity
    trace: dict[str, Any]
    checksums: dict[str, Checksum]
    words: dict[str, list[str]]
    topics: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])

    @property
    def files(self) -> list[str]:
        """Names of the files in the folder. The description comes first."""
        return [_SAID, FILE, *(part for topic in self.topics for part in topic["parts"])]

    def write(self) -> None:
        """Write the description of a complete trace into its folder, for :meth:`read`.

        Raises
        ------
        StoreError
            The file is not writable.
        """
        values = asdict(self) | {"folder": "", "path": str(self.path)}
        if not self.topics:  # so that a segment without topics has the digest of older versions
            del values["topics"]
        try:
            (self.folder / _SAID).write_text(json.dumps(values), encoding="utf-8")
        except OSError as error:
            raise os_fault(f"{self.folder}: cannot be written", error) from error

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the description of a complete, unpublished trace from its folder.

        Raises
        ------
        StoreError
            The folder has no sealed segment.
        """
        try:
            values = json.loads((folder / _SAID).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise StoreError(f"{folder}: no segment that is complete: {error}") from error
        topics = values.get("topics", [])
        if not all(_PART.fullmatch(part) for topic in topics for part in topic["parts"]):
            raise StoreError(f"{folder}: the segment names files outside its folder")
        return cls(
            folder=folder,
            path=Path(values["path"]),
            identity=Identity.from_dict(values["identity"]),
            trace=values["trace"],
            checksums={name: Checksum(**one) for name, one in values["checksums"].items()},
            words=values["words"],
            topics=topics,
        )
