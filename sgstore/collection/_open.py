"""Function ``open`` for a store or, with an engine, a collection of stores."""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from sgstore.collection._questions import Collection


@overload
def open(
    path: str | Path,
    *,
    create: bool = False,
    memory: int = 0,
    tables: Mapping[str, object] | None = None,
    max_spill: int = 0,
    root: str | Path | None = None,
) -> Store: ...


@overload
def open(
    path: str | Path,
    *,
    engine: str,
    tables: Mapping[str, object] | None = None,
    partial: bool = False,
) -> Collection: ...


def open(  # noqa: PLR0913  those of a store, and those of a collection
    path: str | Path,
    *,
    create: bool = False,
    memory: int = 0,
    tables: Mapping[str, object] | None = None,
    max_spill: int = 0,
    root: str | Path | None = None,
    engine: str = "",
    partial: bool = False,
) -> Store | Collection:
    """Open a store, or with ``engine`` a collection of stores.

    Parameters
    ----------
    path : str or Path
        Path of a store; place of a collection: a folder, or ``s3://bucket/prefix``.
    create, memory, tables, max_spill, root
        As in :class:`sgstore.Store`; for a collection only ``tables``.
    engine : str
        Engine for a collection: ``local``, ``local:8``, ``ray``, ``ray://HOST:PORT``, ``spark``.
    partial : bool
        True if results of a collection may lack stores that cannot answer.

    Raises
    ------
    StoreError
        The store or collection is missing, or has another version.

    Examples
    --------
    >>> import sgstore
    >>> with sgstore.open("demo.sgstore") as store:  # made by 'sgstore demo .'
    ...     print(store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)").count(), "frames")
    4 frames
    >>> with sgstore.open("fleet", engine="local") as fleet:  # made by 'sgstore collection pack'
    ...     print(len(fleet.traces()), "trace")
    1 trace
    """
    if not engine:
        return Store(
            path, create=create, memory=memory, tables=tables, max_spill=max_spill, root=root
        )
    from sgstore.collection._questions import Collection

    return Collection(path, engine=engine, tables=tables, partial=partial)
