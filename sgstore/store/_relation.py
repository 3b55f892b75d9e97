"""Query results as DuckDB relations for further SQL."""

from __future__ import annotations

from typing import TYPE_CHECKING

import duckdb

from sgstore.base.files import temporary_folder, working_folder
from sgstore.base.quoting import literal
from sgstore.store._locking import default_memory

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def relation_of(write: Callable[[Path], object]) -> duckdb.DuckDBPyRelation:
    """Load the output of a Parquet writer function as the table ``answer`` of a new database."""
    with working_folder("relation") as folder:
        file = folder / "answer.parquet"
        write(file)
        spill, memory = temporary_folder() / "relations", f"{default_memory() >> 20}MiB"
        held = duckdb.connect(config={"temp_directory": str(spill), "memory_limit": memory})
        held.execute(f"CREATE TABLE answer AS FROM read_parquet({literal(str(file))})")
    return held.table("answer")
