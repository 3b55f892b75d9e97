"""Checksums of rows: the same for the same rows in any order, in any version of the database.

A row becomes 64 bits, mixed from the bits of its values, and the checksum is their sum modulo 2⁶⁴. So rows can
come in parts and be stored in any order. The mixing is SplitMix64's (Steele, Lea, Flood: Fast splittable
pseudorandom number generators, 2014): it is no cipher, and tells what happens by chance, not by intent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Words = NDArray[np.uint64]

_STEP: Final = 0x9E3779B97F4A7C15
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_MISSING: Final = np.uint64(0x6E756C6C6E756C6C)
"""What stands for NULL."""

_ASSIGNED: Final = {"map_id", "config_id", "name", "ingested_at"}
"""Columns that a store gives a value of its own."""

_TEXTS: Final = {"VARCHAR", "VARCHAR[]", "JSON", "TIMESTAMP", "UUID"}


@dataclass(slots=True)
class Checksum:
    """Checksum of some rows.

    Attributes
    ----------
    rows : int
    value : int
        0 … 2⁶³ - 1.
    """

    rows: int = 0
    value: int = 0

    def add(self, columns: dict[str, NDArray[Any]]) -> None:
        """Add rows, as columns of numbers and truth values, masked where they are missing."""
        hashes: Words = np.zeros(len(next(iter(columns.values()))), np.uint64)
        for number, name in enumerate(sorted(columns)):
            salt = np.uint64((number + 1) * _STEP & 0xFFFFFFFFFFFFFFFF)
            hashes = _mixed(hashes + (_words(columns[name]) ^ salt))
        self.rows += len(hashes)
        self.value = (self.value + int(hashes.sum(dtype=np.uint64))) & 0x7FFFFFFFFFFFFFFF


def _mixed(words: Words) -> Words:
    words = (words ^ (words >> np.uint64(30))) * _FIRST
    words = (words ^ (words >> np.uint64(27))) * _SECOND
    return words ^ (words >> np.uint64(31))


def _words(values: NDArray[Any]) -> Words:
    """The bits of values as words of 64."""
    plain = np.ma.getdata(values)
    if plain.dtype.kind == "f":
        words = plain.view(np.uint32 if plain.dtype.itemsize == 4 else np.uint64)
    else:
        words = plain.astype(np.int64).view(np.uint64)
    missing = np.ma.getmaskarray(values)
    return np.where(missing, _MISSING, words.astype(np.uint64))


def expressions(connection: DuckDBPyConnection, table: str, catalog: str = "") -> str:
    """What to select of a table of the schema, or of a file of it, so that :meth:`Checksum.add` can take it."""
    sql = (
        "SELECT column_name, data_type FROM duckdb_columns() WHERE table_name = ? AND NOT internal"
    )
    where = " AND database_name = ?" if catalog else ""
    rows = connection.execute(sql + where, [table, catalog] if catalog else [table]).fetchall()
    return ", ".join(
        f'{_expression(name, kind)} AS "{name}"' for name, kind in rows if name not in _ASSIGNED
    )


def _expression(name: str, kind: str) -> str:
    """A column as a number: numbers as they are, enumerations by their codes, texts by 60 bits of their MD5."""
    if kind.startswith("ENUM"):  # words in a file
        return f'enum_code("{name}"::{kind})'
    if kind in _TEXTS:
        return f"""('0x' || md5("{name}"::VARCHAR)[:15])::BIGINT"""
    return f'"{name}"'
