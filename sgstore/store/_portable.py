"""Copy of some frames in a plain DuckDB file, which older versions of DuckDB can read, too."""

from __future__ import annotations

import os
import re
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

import duckdb
import numpy as np

import sgstore.store._schema as shape
from sgstore.base.quoting import literal, quoted
from sgstore.errors import ExportError
from sgstore.model.frame_ids import FRAME_BITS
from sgstore.model.vocabulary import NAMES
from sgstore.store._columns import ORDERS, types_of
from sgstore.store._engine_errors import translated
from sgstore.store._locking import default_memory, shut_in, spill_folder
from sgstore.store._publish import SCATTERED, SHARED
from sgstore.store._staging import scratch

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.model.world import Ints

_VERSION: Final = re.compile(r"v\d+\.\d+\.\d+|latest")

_ROWS: Final = {
    "frame_id": "SELECT x.* FROM {table} x JOIN chosen USING (frame_id)",
    "bit": "SELECT x.* FROM {table} x JOIN chosen c ON c.frame_id = (x.bucket << {bits}) + x.bit",
    "mask": "SELECT x.* REPLACE (x.mask & c.mask AS mask) FROM {table} x JOIN masks c USING (bucket)"
    " WHERE (x.mask & c.mask) <> 0",
    "valid": "SELECT x.* REPLACE (x.valid & c.mask AS valid, x.joined & c.mask AS joined)"
    " FROM {table} x JOIN masks c USING (bucket)",
    "trace_id": "SELECT * FROM {table} WHERE trace_id IN (SELECT frame_id >> 24 FROM chosen)",
}
"""SQL of the rows to copy for the chosen frames, by key column. The first column that a table has is used."""


def write_portable(
    store: Path,
    to: Path,
    frame_id: Ints,
    storage: str,
    labels: Mapping[str, tuple[str, Sequence[Any]]],
) -> None:
    """Copy frames of a store into a new DuckDB file with the public views.

    Parameters
    ----------
    store : Path
    to : Path
        Path of the new file, in a folder that no other process uses.
    frame_id : int64 (n,)
        Ids of the frames, each once.
    storage : str
        Oldest DuckDB version that can read the file: ``v1.0.0``, ``v1.2.0``, …; ``latest``.
    labels : mapping
        Name → type and values (n,) of each label. They become the table ``labels``.

    Raises
    ------
    ExportError
        The storage version is unknown, or the file is not writable.
    """
    if not _VERSION.fullmatch(storage):
        raise ExportError(f"storage version {storage!r} is unknown; expected v1.0.0, v1.2.0, …")
    memory = default_memory() * 5 // 8
    opened = scratch(spill_folder(), memory=memory, threads=os.cpu_count() or 1)
    with closing(opened) as connection, translated(to):
        shut_in(connection, store, (to.parent,))
        connection.execute(f"ATTACH {_place(store)} AS store (READ_ONLY)")
        shape.check(connection, "store", store)
        try:
            connection.execute(f"ATTACH {_place(to)} AS fresh (STORAGE_VERSION {literal(storage)})")
        except duckdb.Error as error:
            raise ExportError(f"DuckDB cannot write the storage version {storage!r}") from error
        connection.execute("USE fresh")
        connection.execute(shape.schema_sql())
        words = {enum: shape.labels_of(connection, "store", enum) for enum in NAMES}
        shape.widen(connection, "fresh", words)
        _copy(connection, frame_id)
        _rewrite_views(connection)
        if labels:
            _write_labels(connection, frame_id, labels)
        connection.execute("USE memory")
        connection.execute("DETACH fresh")


def _place(path: Path) -> str:
    return literal(str(path.absolute()))


def _copy(connection: DuckDBPyConnection, frame_id: Ints) -> None:
    """Copy the rows of some frames from the attached store to the new file."""
    connection.execute(
        "CREATE TEMP TABLE chosen AS SELECT unnest($1::BIGINT[]) AS frame_id", [frame_id]
    )
    connection.execute(
        f"CREATE TEMP TABLE masks AS SELECT frame_id >> {FRAME_BITS} AS bucket,"
        f" bit_or(1::BIGINT << (frame_id & {(1 << FRAME_BITS) - 1})) AS mask FROM chosen GROUP BY ALL"
    )
    owners = {table: owner for owner, tables in SHARED.items() for table in tables}
    for table in shape.expected().tables:
        if table in {"store_info", "manifest", "bits"}:  # of the file, or already present
            continue
        source = f"store.inside.{table}"
        if table in owners:
            key = f"{owners[table]}_id"
            traces = _ROWS["trace_id"].format(table="store.inside.trace")
            rows = f"SELECT * FROM {source} WHERE {key} IN (SELECT {key} FROM ({traces}))"
        else:
            column = next(name for name in _ROWS if name in types_of(table))
            rows = _ROWS[column].format(table=source, bits=FRAME_BITS)
        order = f" ORDER BY {ORDERS[table]}" if table in SCATTERED and table in ORDERS else ""
        connection.execute(f"INSERT INTO fresh.inside.{table} BY NAME {rows}{order}")


def _rewrite_views(connection: DuckDBPyConnection) -> None:
    """Rewrite the views of the copy: older DuckDB versions accept enumerations with NULL only as text."""
    for name in ("nodes", "world_nodes"):
        body = shape.expected().views[name]
        connection.execute(
            f"CREATE OR REPLACE VIEW main.{name} AS"
            f" SELECT * REPLACE (light_state::light_state AS light_state) FROM ({body})"
        )


def _write_labels(
    connection: DuckDBPyConnection,
    frame_id: Ints,
    labels: Mapping[str, tuple[str, Sequence[Any]]],
) -> None:
    columns = ", ".join(f"{quoted(name)} {kind}" for name, (kind, _) in labels.items())
    connection.execute(f"CREATE TABLE fresh.main.labels (frame_id BIGINT NOT NULL, {columns})")
    held: dict[str, NDArray[Any]] = {"frame_id": frame_id}
    for number, (_, values) in enumerate(labels.values()):
        held[f"c{number}"] = np.empty(len(frame_id), object)
        held[f"c{number}"][:] = values
    connection.register("held", held)
    connection.execute("INSERT INTO fresh.main.labels SELECT * FROM held")
    connection.unregister("held")
