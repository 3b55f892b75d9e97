"""The schema of a store, and how an empty one is made."""

from __future__ import annotations

import os
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

import duckdb

from sgstore.errors import StoreError
from sgstore.quoting import literal
from sgstore.store._locking import STORAGE_VERSION, Folder, refuse_odd_name, translated
from sgstore.store._schema import schema_digest, schema_sql, schema_version

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection


SCHEMA_VERSION: Final = schema_version()
"""Version of ``schema.sql``. A store of another version is refused: a store is a cache of its traces."""


def create(path: Path) -> None:
    """Make an empty store, whole or not at all; nothing that exists is overwritten.

    Raises
    ------
    StoreError
        There is no such folder, or it cannot be written.
    """
    refuse_odd_name(path)
    if not path.parent.is_dir():
        raise StoreError(f"{path}: there is no folder {path.parent}")
    with Folder(path) as beside, translated(path):
        place = beside.path / "store"
        with duckdb.connect(":memory:") as connection:
            attach_empty(connection, place)
            connection.execute("DETACH fresh")
        _name(place, path)


def _name(place: Path, path: Path) -> None:
    """Give a file its name, unless that is taken: of two that make the same store the first one stays."""
    try:
        os.link(place, path)
    except FileExistsError:
        pass
    except OSError:  # a file system that has no links
        try:
            if not path.exists():
                place.rename(path)
        except OSError as error:
            raise StoreError(f"{path}: cannot be made: {error.strerror}") from error


def attach_empty(connection: DuckDBPyConnection, place: Path) -> None:
    """Make an empty store and attach it as ``fresh``."""
    file = literal(str(place.absolute()))
    connection.execute(f"ATTACH {file} AS fresh (STORAGE_VERSION '{STORAGE_VERSION}')")
    connection.execute("USE fresh")
    connection.begin()  # one transaction: of its own, each of the 130 statements would be written through
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
