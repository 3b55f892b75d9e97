"""File with rows of several tables, in pieces: a header line, then the columns of a group of rows."""

from __future__ import annotations

import json
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from sgstore.errors import StoreError
from sgstore.store._columns import TEXTS, blank, types_of
from sgstore.store._engine_errors import os_fault

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.store._packing import Columns

FILE: Final = "tables"

_ALIGNED: Final = 8

_HEAD: Final = 8
"""Size of the length field before a header line; bytes."""

_PLAIN: Final = frozenset({"|b1", "|i1", "<i2", "<i4", "<i8", "<f4", "<f8"})


class Piece(NamedTuple):
    """Position and size of one group of rows in a file of tables.

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
    """Private file with the rows of several tables. Its content is never run as code.

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
        message = f"{self._store}: what waits beside it {what}"
        return os_fault(message, error) if error else StoreError(message)

    def close(self) -> None:
        """Close the file of tables. Its content stays on disk."""
        self._file.close()

    def append(
        self, table: str, columns: Columns, texts: Mapping[str, list[str]] | None = None
    ) -> Piece:
        """Append rows of a table to the file, and return their position.

        ``texts`` maps each text column to the texts behind its indices.
        """
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
        """Size of the file of tables in bytes."""
        return self._size

    def behind(self, at: int) -> bytes:
        """Return the raw bytes of the file from an offset up to its end."""
        return self._bytes(at, self._size - at)

    def adopt(self, pieces: bytes) -> None:
        """Append raw bytes from another file of tables. Only readers opened later see these rows."""
        self._write(pieces)
        self._size += len(pieces)

    def pieces(self, table: str) -> list[Piece]:
        """Return the positions of a table's row groups in the file, in writing order."""
        return [piece for piece in self._pieces if piece.table == table]

    def all(self) -> list[Piece]:
        """Return the positions of all row groups in the file, in writing order."""
        return list(self._pieces)

    def read(self, piece: Piece, first: int = 0, end: int | None = None) -> Columns:
        """Return all columns of some rows in a row group of the file. A row group is a block of rows.

        Raises
        ------
        StoreError
            The columns are missing or not readable.
        """
        return {name: self.column(piece, name, first, end) for name in piece.columns}

    def column(
        self, piece: Piece, name: str, first: int = 0, end: int | None = None
    ) -> NDArray[Any]:
        """Return one column of some rows in a row group of the file. A row group is a block of rows."""
        about, end = piece.columns[name], piece.rows if end is None else end
        if about["type"] not in _PLAIN:
            raise self._wrong("is not a file of sgstore")
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
        """Return a column of a row group, with texts, not text indices. An absent column has missing values."""
        if name not in piece.columns:
            texts = types_of(piece.table)[name] in TEXTS
            count = end - first
            return np.full(count, "", object) if texts else blank(piece.table, name, count)
        values = self.column(piece, name, first, end)
        if "texts" not in piece.columns[name]:
            return values
        return np.array([*self._texts(piece, name), ""], object)[values]

    def texts(self, piece: Piece) -> dict[str, list[str]]:
        """Return the texts of a row group: text column → list of texts, indexed by the stored numbers."""
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
        """Read the header lines of an existing file, which list its row groups."""
        at = 0
        while at < self._size:
            length = int.from_bytes(self._bytes(at, _HEAD), "little")
            if length > self._size:
                raise self._wrong("is not a file of sgstore")
            said = json.loads(self._bytes(at + _HEAD, length))
            at += _HEAD + length
            self._pieces.append(Piece(said["table"], said["rows"], said["columns"], at))
            at += said["bytes"]
        if at != self._size:
            raise self._wrong("ends before its rows do")


def _narrowed(values: NDArray[Any]) -> tuple[dict[str, Any], NDArray[Any] | None]:
    """Shrink a column to save disk space: to a smaller integer type, or to one value if all are equal.

    Return the description of the column, and the array to write.
    """
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
