"""sgstore: find the driving scenes that matter.

Traces go in, scene graphs are kept, frames are found by what happens in them, test sets come out.

::

    import sgstore
    from sgstore.ingest import ingest

    ingest("drives.sgstore", ["monday.mcap"])
    store = sgstore.open("drives.sgstore")
    for match in store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)"):
        print(match)

Names are imported when they are first used, so that ``import sgstore`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from sgstore.config import Config
    from sgstore.errors import (
        ConfigError,
        ExportError,
        MapError,
        QueryError,
        SgstoreError,
        StoreError,
        TraceError,
    )
    from sgstore.matches import Matches
    from sgstore.query import Store
    from sgstore.world import Clip

_HOMES: Final = {
    "Clip": "world",
    "Config": "config",
    "ConfigError": "errors",
    "ExportError": "errors",
    "MapError": "errors",
    "Matches": "matches",
    "QueryError": "errors",
    "SgstoreError": "errors",
    "Store": "query",
    "StoreError": "errors",
    "TraceError": "errors",
}

__all__ = [
    "Clip",
    "Config",
    "ConfigError",
    "ExportError",
    "MapError",
    "Matches",
    "QueryError",
    "SgstoreError",
    "Store",
    "StoreError",
    "TraceError",
    "open",
]


def open(
    path: str | Path,
    *,
    memory: int = 0,
    tables: Mapping[str, object] | None = None,
    max_spill: int = 0,
) -> Store:
    """The store at a path; see :class:`sgstore.query.Store`.

    Raises
    ------
    StoreError
        There is no such file, it is no store, or one of another version.
    """
    from sgstore.query import Store

    return Store(path, memory=memory, tables=tables, max_spill=max_spill)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sgstore' has no attribute {name!r}")
    return getattr(import_module(f"sgstore.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
