"""The schema of a store, and how an empty one is made."""

from __future__ import annotations

import os
from functools import cache
from importlib import resources
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

import duckdb

from sgstore.errors import StoreError
from sgstore.quoting import literal
from sgstore.store.access import STORAGE_VERSION, translated
from sgstore.store.folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection

SCHEMA_VERSION: Final = "3"
"""Version of ``schema.sql``. A store of another version is refused: a store is a cache of its traces."""


_VIEWS: Final = "-- The public views "
"""Where the views begin in ``schema.sql``."""


@cache
def schema_sql() -> str:
    """The text of ``schema.sql``: types, tables and views."""
    return resources.files("sgstore").joinpath("schema.sql").read_text(encoding="utf-8")


def tables_sql() -> str:
    """The part of it that makes types and tables: all that a segment needs, in a third of the time."""
    return schema_sql().partition(_VIEWS)[0]


def create(path: Path) -> None:
    """Make an empty store, whole or not at all; nothing that exists is overwritten.

    Raises
    ------
    StoreError
        There is no such folder, or it cannot be written.
    """
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
    file = literal(str(place))
    connection.execute(f"ATTACH {file} AS fresh (STORAGE_VERSION '{STORAGE_VERSION}')")
    connection.execute("USE fresh")
    connection.execute(schema_sql())
    about = {"schema_version": SCHEMA_VERSION, "created_by": f"sgstore {version('sgstore')}"}
    for key, value in about.items():
        connection.execute("INSERT INTO store_info VALUES (?, ?)", [key, value])
    connection.execute("USE memory")


def check_version(connection: DuckDBPyConnection, path: Path) -> None:
    """Refuse a database that is no store, or one of another version.

    Raises
    ------
    StoreError
    """
    try:
        found = connection.execute(
            "SELECT value FROM store_info WHERE key = 'schema_version'"
        ).fetchone()
    except duckdb.CatalogException as error:
        raise StoreError(
            f"{path}: a DuckDB database, but not a store; expected a file that 'sgstore ingest' made"
        ) from error
    if found != (SCHEMA_VERSION,):
        held = found[0] if found else "unknown"
        raise StoreError(
            f"{path}: a store of version {held}, expected {SCHEMA_VERSION};"
            " ingest its recordings again into a new store"
        )
