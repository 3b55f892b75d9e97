"""Creation of empty store files (DuckDB databases with the tables of sgstore)."""

from __future__ import annotations

import os
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

import duckdb

from sgstore.base.quoting import literal
from sgstore.errors import StoreError
from sgstore.store._engine_errors import os_fault, translated
from sgstore.store._locking import BLOCK_SIZE, STORAGE_VERSION, trust
from sgstore.store._schema import SCHEMA_VERSION, schema_digest, schema_sql
from sgstore.store._store_paths import Folder, refuse_odd_name

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection


_NEW: Final = f"STORAGE_VERSION '{STORAGE_VERSION}', BLOCK_SIZE {BLOCK_SIZE}"
"""DuckDB options for a new store file."""


def create(path: Path) -> None:
    """Create an empty store file in one step. An existing file stays unchanged.

    Raises
    ------
    StoreError
        The folder does not exist, or is not writable.
    """
    refuse_odd_name(path)
    if not path.parent.is_dir():
        raise StoreError(f"{path}: the folder {path.parent} does not exist")
    with Folder(path) as beside:
        place = beside.path / "store"
        write_empty(place)
        made = place.stat()
        _name(place, path)
    trust(path, made)


def _name(place: Path, path: Path) -> None:
    """Rename a new store file to its final name. A store of another process at that name is kept."""
    try:
        os.link(place, path)
    except FileExistsError:
        pass
    except OSError:  # a file system without links
        try:
            if not path.exists():
                place.rename(path)
        except OSError as error:
            raise os_fault(f"{path}: cannot be made", error) from error


def attach_empty(connection: DuckDBPyConnection, place: Path) -> None:
    """Create an empty store file, and attach it to a DuckDB connection under the name ``fresh``."""
    write_empty(place)
    file = literal(str(place.absolute()))
    connection.execute(f"ATTACH {file} AS fresh ({_NEW})")


def write_empty(place: Path) -> None:
    """Create an empty store file at a path without a file.

    Raises
    ------
    StoreError
        The file is not writable.
    """
    try:
        if not _empty:
            with translated(place):
                _make_empty(place)
            _empty.append(place.read_bytes())
            return
        with place.open("xb") as file:
            file.write(_empty[0])
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise os_fault(f"{place}: cannot be made", error) from error


_empty: Final[list[bytes]] = []
"""Cached bytes of an empty store file. Copying them is a hundred times faster than a new database."""


def _make_empty(place: Path) -> None:
    file = literal(str(place.absolute()))
    with duckdb.connect(":memory:") as connection:
        connection.execute(f"ATTACH {file} AS fresh ({_NEW})")
        connection.execute("USE fresh")
        connection.begin()  # one transaction: otherwise each of the 130 statements would be synced to disk
        connection.execute(schema_sql())
        about = {
            "schema_version": SCHEMA_VERSION,
            "schema_digest": schema_digest(),
            "created_by": f"sgstore {version('sgstore')}",
        }
        for key, value in about.items():
            connection.execute("INSERT INTO store_info VALUES (?, ?)", [key, value])
        connection.commit()
        connection.execute("USE memory")
        connection.execute("DETACH fresh")
