"""sgstore: find the driving scenes that matter.

Traces go in, scene graphs are kept, frames are found by what happens in them, test sets come out.

::

    import sgstore

    sgstore.ingest("drives.sgstore", ["monday.mcap"])
    store = sgstore.open("drives.sgstore")
    for match in store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)"):
        print(match)

Names are imported when they are first used, so that ``import sgstore`` costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
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
    from sgstore.ingest import ingest
    from sgstore.query import Matches, Store
    from sgstore.world import Clip

_HOMES: Final = {
    "Clip": "world",
    "Config": "config",
    "ConfigError": "errors",
    "ExportError": "errors",
    "MapError": "errors",
    "Matches": "query",
    "QueryError": "errors",
    "SgstoreError": "errors",
    "Store": "query",
    "StoreError": "errors",
    "TraceError": "errors",
    "ingest": "ingest",
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
    "ingest",
    "open",
]


def open(path: str | Path, *, memory: int = 0) -> Store:
    """The store at a path; see :class:`sgstore.query.Store`.

    Raises
    ------
    StoreError
        There is no such file, it is no store, or one of another version.
    """
    from sgstore.query import Store

    return Store(path, memory=memory)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sgstore' has no attribute {name!r}")
    module = import_module(f"sgstore.{_HOMES[name]}")
    return module if name == _HOMES[name] else getattr(module, name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _CallableModule(ModuleType):
    """``sgstore.ingest``: the module and, when called, its function of that name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.ingest(*args, **kwargs)


class _Package(ModuleType):
    """The package. Importing a submodule sets its name here, and ``ingest`` must stay callable then."""

    def __setattr__(self, name: str, value: object) -> None:
        if name == "ingest" and isinstance(value, ModuleType):
            value.__class__ = _CallableModule
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
