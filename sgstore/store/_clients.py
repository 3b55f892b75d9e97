"""Connections of DuckDB's own to a store, for clients that write their statements for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import duckdb as engine

from sgstore.store._locking import refuse_special, translated, without_faults

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection


def duckdb(path: str | Path) -> DuckDBPyConnection:
    """Connect DuckDB to a store, read-only, without the optimizers that give wrong rows of its views.

    Close the connection before another process writes to the store.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    StoreError
        There is no such store, or a writer has it.
    """
    path = Path(path)
    refuse_special(path)
    with translated(path):
        connection = engine.connect(str(path.absolute()), read_only=True)
    without_faults(connection)
    return connection
