"""Complete traces in the inbox of a collection, not yet in a store. Road maps are stored separately, once."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.store._publish import SHARED
from sgstore.store._staging import Sealed
from sgstore.store._table_stream import FILE, TableFile

if TYPE_CHECKING:
    from pathlib import Path


MAP_TABLES: Final = frozenset(SHARED["map"])
"""Tables of a segment that belong to its road map."""


def split_segment(sealed: Path, to: Path, of_map: Path) -> str:
    """Split an unpublished trace into trace and road map files. Return the map digest; empty without a map.

    Parameters
    ----------
    sealed : Path
        Folder of the segment.
    to, of_map : Path
        Existing empty folders for the segment without its map, and for the map.

    Raises
    ------
    StoreError
        The segment is not readable, or a file is not writable.
    """
    told = Sealed.read(sealed)
    tables = TableFile(sealed / FILE, sealed)
    parts = [TableFile(folder / FILE, folder, new=True) for folder in (to, of_map)]
    try:
        for piece in tables.all():
            part = parts[piece.table in MAP_TABLES]
            part.append(piece.table, tables.read(piece), tables.texts(piece))
    finally:
        for one in (tables, *parts):
            one.close()
    replace(told, folder=to).write()
    return told.identity.map_digest


def whole_segment(segment: Path, of_map: Path | None, to: Path) -> Sealed:
    """Combine the files of an unpublished trace and of its road map in a new folder.

    Raises
    ------
    StoreError
        A file is not readable or writable, or is not a staging file.
    """
    told = Sealed.read(segment)
    fresh = TableFile(to / FILE, to, new=True)
    try:
        for folder in (segment, *([] if of_map is None else [of_map])):
            tables = TableFile(folder / FILE, folder)
            try:
                for piece in tables.all():
                    fresh.append(piece.table, tables.read(piece), tables.texts(piece))
            finally:
                tables.close()
    finally:
        fresh.close()
    whole = replace(told, folder=to)
    whole.write()
    return whole
