"""DuckDB connections to a store, for client programs with their own SQL statements."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import duckdb as engine

from sgstore.store._engine_errors import translated
from sgstore.store._locking import without_faults
from sgstore.store._sql_words import show_is_a
from sgstore.store._store_paths import refuse_special

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection


def duckdb(path: str | Path) -> DuckDBPyConnection:
    """Open a read-only DuckDB connection to a store. Optimizers that return wrong rows are disabled.

    Close the connection before another process writes to the store.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    StoreError
        The store does not exist, or a writer process uses it.

    Examples
    --------
    >>> connection = sgstore.duckdb("demo.sgstore")
    >>> connection.sql("SELECT trace, count(*) FROM frames GROUP BY trace").fetchall()
    [('town', 750)]
    >>> connection.close()
    """
    path = Path(path)
    refuse_special(path)
    with translated(path):
        connection = engine.connect(str(path.absolute()), read_only=True)
    without_faults(connection)
    show_is_a(connection)
    return connection
