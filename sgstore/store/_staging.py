"""Staged tables of a trace: arrays in a file next to the store, until publication.

Large tables are cut into parts of some ten thousand rows. Each part is sorted in store order and appended to
the file, so memory does not grow. In the end, one file has all tables, with a checksum of each.
"""

from __future__ import annotations

import json
from collections import defaultdict
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import duckdb
import numpy as np

from sgstore.errors import StoreError
from sgstore.model.vocabulary import NAMES
from sgstore.store._columns import (
    REPEATED,
    STATES,
    TEXTS,
    Checksum,
    as_summed,
    blank,
    chained,
    in_order,
    kept,
    marked,
    parted,
    types_of,
)
from sgstore.store._locking import Folder, memory_setting, without_faults
from sgstore.store._schema import enums_of, own_labels
from sgstore.store._traces import Identity

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._packing import Columns


# File of tables: consecutive pieces, each with a header line and its columns ----------------------------------

FILE: Final = "tables"

_ALIGNED: Final = 8
_HEAD: Final = 8
"""Size of the length field of a header line; bytes."""
_PLAIN: Final = frozenset({"|b1", "|i1", "<i2", "<i4", "<i8", "<f4", "<f8"})


class Piece(NamedTuple):
    """Group of rows of a table in a staging file.

    Attributes
    ----------
    table : str
    rows : int
    columns : dict
        Column → description: type and offset from ``at``, or a constant value; an offset added to each value;
        and the lengths, offset and size of its texts.
    at : int
        File offset of the columns.
    """

    table: str
    rows: int
    columns: dict[str, dict[str, Any]]
    at: int


class TableFile:
    """Private file of table rows. Its content is never run as code.

    Parameters
    ----------
    path : Path
    store : Path
        Target store, named in errors.
    new : bool
        True to create the file and write to it.
    """

    def __init__(self, path: Path, store: Path, *, new: bool = False) -> None:
        self._store = store
        self._pieces: list[Piece] = []
        try:
            self._file = path.open("w+b" if new else "rb", buffering=0)
            self._size = 0 if new else path.stat().st_size
        except OSError as error:
            raise self._wrong("cannot be opened", error) from error
        if not new:
            self._look()

    def _wrong(self, what: str, error: OSError | None = None) -> StoreError:
        reason = f": {error.strerror}" if error else ""
        return StoreError(f"{self._store}: what waits beside it {what}{reason}")

    def close(self) -> None:
        """Close the file. Its content stays."""
        self._file.close()

    def append(
        self, table: str, columns: Columns, texts: Mapping[str, list[str]] | None = None
    ) -> Piece:
        """Append rows. ``texts`` maps each text column to the texts behind its indices."""
        rows = len(next(iter(columns.values())))
        about: dict[str, dict[str, Any]] = {}
        body: list[NDArray[Any]] = []
        place = 0
        for name, values in columns.items():
            about[name], array = _narrowed(values)
            if array is not None:
                about[name]["at"] = place
                body.append(array)
                place += -(-array.nbytes // _ALIGNED) * _ALIGNED
            if texts and name in texts:
                joined = np.frombuffer("".join(texts[name]).encode(), np.uint8)
                about[name]["texts"] = [*map(len, texts[name])], place, len(joined)
                body.append(joined)
                place += -(-joined.nbytes // _ALIGNED) * _ALIGNED
        said = {"table": table, "rows": rows, "columns": about, "bytes": place}
        line = json.dumps(said, ensure_ascii=False).encode()
        line += b" " * (-len(line) % _ALIGNED)
        parts = [len(line).to_bytes(_HEAD, "little"), line]
        for array in body:
            parts += [array.tobytes(), bytes(-array.nbytes % _ALIGNED)]
        self._write(b"".join(parts))
        piece = Piece(table, rows, about, self._size + _HEAD + len(line))
        self._size = piece.at + place
        self._pieces.append(piece)
        return piece

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            self._file.seek(self._size)
            while view:
                view = view[self._file.write(view) or 0 :]
        except OSError as error:
            raise self._wrong("cannot be written", error) from error

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._size

    def behind(self, at: int) -> bytes:
        """Return the bytes of the file from an offset to the end."""
        return self._bytes(at, self._size - at)

    def adopt(self, pieces: bytes) -> None:
        """Append raw pieces of another file. This object does not list them; a new reader does."""
        self._write(pieces)
        self._size += len(pieces)

    def pieces(self, table: str) -> list[Piece]:
        """Return the pieces of a table in writing order."""
        return [piece for piece in self._pieces if piece.table == table]

    def all(self) -> list[Piece]:
        """Return all pieces in writing order."""
        return list(self._pieces)

    def read(self, piece: Piece, first: int = 0, end: int | None = None) -> Columns:
        """Return the columns of a range of rows in a piece.

        Raises
        ------
        StoreError
            The columns are missing or not readable.
        """
        return {name: self.column(piece, name, first, end) for name in piece.columns}

    def column(
        self, piece: Piece, name: str, first: int = 0, end: int | None = None
    ) -> NDArray[Any]:
        """Return one column of a range of rows in a piece."""
        about, end = piece.columns[name], piece.rows if end is None else end
        if about["type"] not in _PLAIN:
            raise self._wrong("is none of ours")
        kind = np.dtype(about["type"])
        if "value" in about:
            value = np.nan if about["value"] is None else about["value"]
            values = np.full(end - first, value, kind)
        else:
            data = self._bytes(
                piece.at + about["at"] + first * kind.itemsize, (end - first) * kind.itemsize
            )
            values = np.frombuffer(data, kind)
        return values.astype(np.int64) + about["base"] if "base" in about else values

    def values(self, piece: Piece, name: str, first: int, end: int) -> NDArray[Any]:
        """Return one column with texts in place of indices. A column that the piece lacks is all missing."""
        if name not in piece.columns:
            texts = types_of(piece.table)[name] in TEXTS
            count = end - first
            return np.full(count, "", object) if texts else blank(piece.table, name, count)
        values = self.column(piece, name, first, end)
        if "texts" not in piece.columns[name]:
            return values
        return np.array([*self._texts(piece, name), ""], object)[values]

    def texts(self, piece: Piece) -> dict[str, list[str]]:
        """Return the texts behind the indices of a piece, by column."""
        return {
            name: self._texts(piece, name)
            for name in piece.columns
            if "texts" in piece.columns[name]
        }

    def _texts(self, piece: Piece, name: str) -> list[str]:
        lengths, at, size = piece.columns[name]["texts"]
        joined = self._bytes(piece.at + at, size).decode()
        ends = [*accumulate(lengths)]
        return [joined[end - length : end] for length, end in zip(lengths, ends, strict=True)]

    def _bytes(self, at: int, count: int) -> bytes:
        try:
            self._file.seek(at)
            data = self._file.read(count)
        except OSError as error:
            raise self._wrong("cannot be read", error) from error
        if data is None or len(data) != count:
            raise self._wrong("ends before its rows do")
        return data

    def _look(self) -> None:
        """Read the headers of an existing file."""
        at = 0
        while at < self._size:
            length = int.from_bytes(self._bytes(at, _HEAD), "little")
            if length > self._size:
                raise self._wrong("is none of ours")
            said = json.loads(self._bytes(at + _HEAD, length))
            at += _HEAD + length
            self._pieces.append(Piece(said["table"], said["rows"], said["columns"], at))
            at += said["bytes"]
        if at != self._size:
            raise self._wrong("ends before its rows do")


def _narrowed(values: NDArray[Any]) -> tuple[dict[str, Any], NDArray[Any] | None]:
    """Encode values in few bytes. Return the description and the array to write."""
    kind = values.dtype.newbyteorder("<").str
    values = np.ascontiguousarray(values)
    if values.dtype.kind == "f":
        bits = values.view(f"i{values.itemsize}")
        if bits[0] == bits[-1] and (bits == bits[0]).all():
            return {"type": kind, "value": None if np.isnan(values[0]) else float(values[0])}, None
        return {"type": kind}, values
    low, high = values.min(), values.max()
    if low == high:
        return {"type": kind, "value": bool(low) if kind == "|b1" else int(low)}, None
    if values.dtype.itemsize == 8 and int(high) - int(low) < 1 << 31:
        return {"type": "<i4", "base": int(low)}, (values - low).astype(np.int32)
    return {"type": kind}, values


# Tables in memory, and in the file ----------------------------------------------------------------------------

PART_ROWS: Final = 20_000
"""Rows of all growing tables in memory."""

PIECE_ROWS: Final = 60_000
"""Largest number of rows read and inserted at once."""

MERGE_ROWS: Final = 1 << 19
"""Number of rows at which partial masks are merged before their bucket is complete."""

_GROWING: Final = (
    *("state", "lane_single", "gap_single", "node", "edge", "frame_class", "lane_role"),
    *("world_state", "world_lane_single", "world_gap_single", "world_node", "world_edge"),
    *("later_class", "derived_node", "derived_edge", "derived_gap", "message"),
)
"""Tables that grow with a trace."""

_ALONG: Final = ("frame", "imported", "attribute")
"""Tables that also grow, but do not count for the row limit."""

_CUT: Final = frozenset({*_GROWING, *_ALONG})
"""All tables split into parts."""

_RUNS: Final = {
    "node": "kind",
    "edge": "relation",
    "derived_node": "moves",
    "derived_edge": "relation",
}
"""Tables whose partial masks may exceed memory → first sort column."""


class StagedRows(NamedTuple):
    """Rows of whole tables, written by a :class:`Staging`.

    ``words``: enumeration → values that ``schema.sql`` lacks.
    """

    pieces: bytes
    checksums: dict[str, Checksum]
    words: dict[str, list[str]]


class Staging:
    """Staged tables of one trace.

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
        """Discard the tables in memory. Remove the folder if this object created it."""
        self._waiting.clear()
        self._file.close()
        if self._own is not None:
            self._own.remove()

    def insert(self, table: str, columns: Columns) -> None:
        """Append rows to a table. Missing values are non-finite, :data:`MISSING`, or empty."""
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
        """Collect enumeration values that ``schema.sql`` lacks."""
        own = len(own_labels(enum))
        if codes.max() < own:
            return
        noted = self._new.setdefault(enum, [])
        found = [NAMES[enum][code] for code in np.unique(codes).tolist() if code >= own]
        noted += [name for name in found if name not in noted]

    def words(self, answers: Iterable[str]) -> dict[str, list[str]]:
        """Return the enumeration values that the store must support: enumeration → values."""
        relations = sorted({*answers, *self._new.get("relation", ())})
        return {**self._new, "relation": relations}

    def shared(self) -> StagedRows:
        """Write all tables, and return their rows for other stagings. These tables must not grow afterwards."""
        for table in [*self._waiting]:
            self.write(table)
        return StagedRows(self._file.behind(0), dict(self.checksums), dict(self._new))

    def adopt(self, rows: StagedRows) -> None:
        """Take the shared tables of another staging, before any other rows."""
        self._file.adopt(rows.pieces)
        self.checksums.update(rows.checksums)
        self._new.update({enum: [*names] for enum, names in rows.words.items()})

    def mark(self, table: str, name: str, values: NDArray[Any]) -> None:
        """Add a column to the rows of a complete table."""
        first = 0
        for staged in self._waiting[table]:
            rows = len(next(iter(staged.values())))
            staged[name] = kept(table, name, values[first : first + rows])
            first += rows

    def settle(self, *, whole: bool) -> None:
        """Write large tables to the file to free memory. Called between blocks.

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
        """Merge rows that differ only in their masks. Write them to the file if many remain."""
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
        """Write the waiting rows of a table to the file, and free their memory."""
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
        """Merge sorted runs. Yield the rows of one value of the first column at a time."""
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
        """Yield all messages in groups."""
        for piece in self._file.pieces("message"):
            yield self._file.read(piece)
        yield from self._waiting["message"]

    def seal(self) -> None:
        """Write all tables to the file, and close it for additions."""
        for table in [*self._waiting, *self._runs]:
            self.write(table)
        self._file.close()
        self.checksums.pop("message", None)
        self.checksums = dict(sorted(self.checksums.items()))


# Databases in memory ------------------------------------------------------------------------------------------

MEMORY: Final = 48 << 20
"""Memory limit of a publishing database; bytes. Beyond it, the database writes temporary files."""


def scratch(spill: Path, *, memory: int = 0, threads: int = 1) -> DuckDBPyConnection:
    """Open an in-memory database that can attach files. It spills to a folder, which it creates if needed.

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


# Trace ready for publication: a folder with a file of tables and metadata -------------------------------------

_SAID: Final = "sealed.json"


@dataclass(frozen=True, slots=True)
class Sealed:
    """Complete segment. It does not depend on the process that built it.

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
    """

    folder: Path
    path: Path
    identity: Identity
    trace: dict[str, Any]
    checksums: dict[str, Checksum]
    words: dict[str, list[str]]

    def write(self) -> None:
        """Write the metadata for :meth:`read` into the folder.

        Raises
        ------
        StoreError
            The file is not writable.
        """
        values = asdict(self) | {"folder": "", "path": str(self.path)}
        try:
            (self.folder / _SAID).write_text(json.dumps(values), encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{self.folder}: cannot be written: {error.strerror}") from error

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a sealed segment from its folder.

        Raises
        ------
        StoreError
            The folder has no sealed segment.
        """
        try:
            values = json.loads((folder / _SAID).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise StoreError(f"{folder}: no segment that is complete: {error}") from error
        return cls(
            folder=folder,
            path=Path(values["path"]),
            identity=Identity.from_dict(values["identity"]),
            trace=values["trace"],
            checksums={name: Checksum(**one) for name, one in values["checksums"].items()},
            words=values["words"],
        )
