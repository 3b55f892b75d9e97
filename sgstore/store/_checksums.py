"""Checksums of table rows. Rows in memory and the same rows in the database have equal checksums.

They do not depend on the order of rows, nor on the DuckDB version.

A row is mixed to 64 bits, and the checksum is the sum of all rows modulo 2⁶⁴. So rows can come in parts and in
any order. The mixing is SplitMix64's (Steele, Lea, Flood: Fast splittable pseudorandom number generators,
2014): it detects accidental changes, not attacks.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.quoting import quoted
from sgstore.model.vocabulary import NAMES
from sgstore.store._columns import TEXTS, missing_of, types_of
from sgstore.store._schema import INSIDE, code_sql, enums_of, own_labels

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._packing import Columns

    Words = NDArray[np.uint64]

_STEP: Final = 0x9E3779B97F4A7C15

_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)

_SECOND: Final = np.uint64(0x94D049BB133111EB)

_MISSING: Final = np.uint64(0x6E756C6C6E756C6C)
"""Hash value that represents NULL."""

_AT_ONCE: Final = 1 << 13
"""Number of rows that are hashed at once, so that their hashes fit into the processor cache."""

_ASSIGNED: Final = {
    ("trace", "name"),
    ("trace", "ingested_at"),
    ("map", "name"),
    ("recording", "place"),
}
"""Tables and columns whose values the store assigns when it inserts a trace."""


@dataclass(slots=True)
class Checksum:
    """Checksum of the rows of a table. It does not depend on the row order.

    Attributes
    ----------
    rows : int
    value : int
        0 … 2⁶³ - 1.
    """

    rows: int = 0
    value: int = 0

    def add(self, columns: Mapping[str, NDArray[Any] | None]) -> None:
        """Add rows to the checksum, as columns of numbers and truth values. Missing values are masked.

        ``None`` means an all-missing column.
        """
        hashes = row_words(columns)
        self.value = (self.value + int(hashes.sum(dtype=np.uint64))) & 0x7FFFFFFFFFFFFFFF
        self.rows += len(hashes)


def row_words(columns: Mapping[str, NDArray[Any] | None]) -> Words:
    """Return a hash of each row, (N,). The columns are as for :meth:`Checksum.add`."""
    count = next((len(values) for values in columns.values() if values is not None), 0)
    hashes = np.zeros(count, np.uint64)
    words, shifted = (np.empty(min(count, _AT_ONCE), np.uint64) for _ in range(2))
    # Masked arrays are slow to slice.
    parts = [
        (None, None) if (one := columns[name]) is None else (np.ma.getdata(one), _mask_of(one))
        for name in sorted(columns)
    ]
    for first in range(0, count, _AT_ONCE):
        here = slice(first, first + _AT_ONCE)
        mixed = hashes[here]
        word, spare = words[: len(mixed)], shifted[: len(mixed)]
        for number, (values, missing) in enumerate(parts):
            step = np.uint64((number + 1) * _STEP & 0xFFFFFFFFFFFFFFFF)
            if values is None:
                mixed += _MISSING ^ step
            else:
                np.bitwise_xor(_words(values[here]), step, out=word)
                if missing is not None:
                    word[missing[here]] = _MISSING ^ step
                mixed += word
            _mix(mixed, spare)
    return hashes


def _mask_of(values: NDArray[Any]) -> NDArray[np.bool_] | None:
    known = np.ma.getmask(values) is np.ma.nomask
    return None if known else np.ma.getmaskarray(values)


def _mix(words: Words, spare: Words) -> None:
    for shift, factor in ((30, _FIRST), (27, _SECOND), (31, None)):
        np.right_shift(words, np.uint64(shift), out=spare)
        words ^= spare
        if factor is not None:
            words *= factor


def _words(values: NDArray[Any]) -> NDArray[np.uint32 | np.uint64]:
    """Return the values of a column as words of 32 or 64 bits, for the checksum of rows."""
    if values.dtype.kind != "f":
        return values.astype(np.int64, copy=False).view(np.uint64)
    values = values + values.dtype.type(0)  # merges -0 and 0: DuckDB 1.5 drops the sign
    return values.view(np.uint32 if values.dtype.itemsize == 4 else np.uint64)


def as_summed(table: str, columns: Columns, texts: Sequence[str]) -> dict[str, NDArray[Any] | None]:
    """Convert table columns to numbers for :meth:`Checksum.add`. An absent column becomes ``None``."""
    enums = enums_of(table)
    found: dict[str, NDArray[Any] | None] = {}
    for name, kind in types_of(table).items():
        values = columns.get(name)
        if (table, name) in _ASSIGNED:
            continue
        if values is not None:
            missing = missing_of(table, name, values)
            if kind in TEXTS:
                used, index = np.unique(values, return_inverse=True)
                numbers = [_number(kind, str(texts[at])) if at >= 0 else 0 for at in used.tolist()]
                values = np.array(numbers, np.int64)[index]
            elif name in enums:
                values = _coded(enums[name], values)
            if missing is not None:
                values = np.ma.MaskedArray(values, missing)
        found[name] = values
    return found


@lru_cache(maxsize=1 << 14)
def _number(kind: str, text: str) -> int:
    if kind == "UUID" and "-" not in text:
        text = "-".join((text[:8], text[8:12], text[12:16], text[16:20], text[20:]))
    return int.from_bytes(hashlib.md5(text.encode(), usedforsecurity=False).digest()[:8]) >> 4


def _coded(enum: str, codes: NDArray[Any]) -> NDArray[Any]:
    """Convert enumeration codes to numbers that are equal in all stores. Values of users become hashes."""
    own = len(own_labels(enum))
    if codes.max(initial=0) < own:
        return codes
    names = NAMES[enum]
    table = [*range(own), *(_number("VARCHAR", name) for name in names[own:])]
    return np.array(table, np.int64)[np.maximum(codes, 0)]


def columns_of(
    connection: DuckDBPyConnection, table: str, catalog: str = ""
) -> list[tuple[str, str]]:
    """Return the name and the type of each column of a table. This is faster than ``duckdb_columns()``."""
    place = f"{quoted(catalog)}.{INSIDE}" if catalog else INSIDE
    rows = connection.execute(f"DESCRIBE {place}.{quoted(table)}").fetchall()
    return [(name, kind) for name, kind, *_ in rows]


def expressions(
    connection: DuckDBPyConnection, table: str, catalog: str = "", only: Sequence[str] = ()
) -> str:
    """Return an SQL list of a table's columns as numbers, for a checksum of the stored rows.

    Numbers stay unchanged. Enumerations become codes, and texts become 60 bits of their MD5. ``only``: columns
    to return; empty means all.
    """
    listed: list[str] = []
    place = f"{quoted(catalog)}.{INSIDE}" if catalog else INSIDE
    for name, kind in columns_of(connection, table, catalog):
        value = quoted(name)
        if kind.startswith("ENUM"):
            value = code_sql(value, kind)
        elif kind in {"DOUBLE[]", "FLOAT[]"}:
            value = _list_number(value, f"{place}.{quoted(table)}")
        elif kind in TEXTS or kind.endswith("]") or kind == "BLOB":
            value = _text_number(value)
        if (table, name) not in _ASSIGNED and (not only or name in only):
            listed.append(f"{value} AS {quoted(name)}")
    return ", ".join(listed)


def _text_number(value: str) -> str:
    return f"('0x' || md5({value}::VARCHAR)[:15])::BIGINT"


def _list_number(value: str, table: str) -> str:
    """Return SQL that converts a list of numbers to one number; 7 times faster for lists equal to the first.

    Many topics have lists that never change, such as covariances. Lists with -0 or NaN do not count, because
    equal lists can then have different texts.
    """
    odd = f"list_bool_or(list_transform({value}, lambda x: signbit(x) AND (x = 0 OR isnan(x))))"
    plain = f"NOT coalesce({odd}, FALSE)"
    first = f"(SELECT {value} FROM {table} WHERE {plain} LIMIT 1)"
    number = f"(SELECT {_text_number(value)} FROM (SELECT {first} AS {value}))"
    return f"CASE WHEN {value} = {first} AND {plain} THEN {number} ELSE {_text_number(value)} END"
