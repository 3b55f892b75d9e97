"""Bundles: store files of a collection, with sorted and renamed traces of one or several stores.

Ids of traces, maps, recordings and settings come from digests. They are equal in every store, so rows are
copied unchanged.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import sgstore.store._schema as shape
from sgstore.base.quoting import literal, quoted
from sgstore.errors import StoreError
from sgstore.model.frame_ids import BUCKET_BITS, SEQ_BITS
from sgstore.model.vocabulary import NAMES
from sgstore.store._columns import MASKS, ORDERS, REPEATED, STATES, types_of
from sgstore.store._creation import attach_empty
from sgstore.store._engine_errors import translated
from sgstore.store._locking import Access, default_memory, spill_folder
from sgstore.store._publish import SHARED
from sgstore.store._rows import run
from sgstore.store._staging import scratch
from sgstore.store._traces import stored_traces

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from duckdb import DuckDBPyConnection


TOGETHER: Final = 64
"""Largest number of stores to join at once. More stores are joined in several steps."""

_TRACE_OF: Final = {
    "trace_id": "trace_id",
    "bucket": f"bucket >> {BUCKET_BITS}",
    "frame_id": f"frame_id >> {SEQ_BITS}",
}
"""Column → SQL of the trace of a row. The first column present in a table counts."""

_AS_MADE: Final = frozenset({"store_info", "bits"})
"""Tables with rows in every new store."""

_SORTED: Final = frozenset({*STATES, *REPEATED, *REPEATED.values(), "frame", *MASKS, "derived_gap"})
"""Large tables, sorted in a bundle."""


@dataclass(frozen=True, slots=True)
class BundleSource:
    """Read-only store from which traces are copied into a bundle (store file of a collection).

    Attributes
    ----------
    path : Path
    """

    path: Path

    def names(self) -> dict[int, tuple[str, str, str]]:
        """Return all traces by id, sorted by name: trace id → (name, recording digest, ego)."""
        with Access(self.path).reading() as connection:
            found = stored_traces(connection)
        return {one.trace_id: (one.name, one.digest, one.ego) for one in found}

    def maps(self, traces: Iterable[int]) -> dict[str, str]:
        """Return the road maps of some traces: map digest → map name."""
        sql = (
            "SELECT DISTINCT m.digest, m.name FROM trace t JOIN map m ON m.map_id = t.map_id"
            " WHERE t.trace_id IN (SELECT unnest(CAST($1 AS BIGINT[])))"
        )
        with Access(self.path).reading() as connection:
            return dict(run(connection, sql, [[*traces]]).values)

    def write(
        self, to: Path, traces: Mapping[int, str], maps: Mapping[str, str] | None = None
    ) -> None:
        """Copy some traces into a new store, with the table rows sorted across all traces.

        Parameters
        ----------
        to : Path
            Path of the new store, in a folder that no other process uses. The file must not exist.
        traces : mapping of int to str
            Trace id → name in the new store.
        maps : mapping of str to str, optional
            Digest of a road map → name in the new store.

        Raises
        ------
        StoreError
            The store lacks one of the traces, or a file is not readable or writable.
        """
        access = Access(self.path)
        threads = os.cpu_count() or 1
        with (
            scratch(spill_folder(), memory=default_memory(), threads=threads) as connection,
            access.attached(connection, to.parent),
        ):
            _copied(connection, ["store"], to, traces, maps or {})

    @staticmethod
    def join(
        sources: Sequence[Path], to: Path, traces: Mapping[int, str], maps: Mapping[str, str]
    ) -> None:
        """Copy traces of several stores into a new store. No process may write to these stores.

        Parameters
        ----------
        sources : sequence of Path
            Stores of this version. Each trace is in one of them.
        to, traces, maps
            See :meth:`write`.

        Raises
        ------
        StoreError
            A trace is missing from all stores, or a file is not readable or writable.
        """
        sources = list(sources)
        with ExitStack() as made:
            while len(sources) > TOGETHER:
                parts: list[Path] = []
                for first in range(0, len(sources), TOGETHER):
                    some = sources[first : first + TOGETHER]
                    part = to.with_name(f"{to.name}.part-{len(sources)}-{first}")
                    made.callback(part.unlink, missing_ok=True)
                    _join(some, part, traces, maps, whole=False)
                    parts.append(part)
                sources = parts
            _join(sources, to, traces, maps, whole=True)


def _join(
    sources: Sequence[Path],
    to: Path,
    traces: Mapping[int, str],
    maps: Mapping[str, str],
    *,
    whole: bool,
) -> None:
    threads = os.cpu_count() or 1
    with (
        scratch(spill_folder(), memory=default_memory(), threads=threads) as connection,
        translated(to),
    ):
        names = [f"store {number}" for number in range(len(sources))]
        for name, source in zip(names, sources, strict=True):
            with Access(source).reading():  # rejects an invalid store
                pass
            Access(source).close()
            place = literal(str(source.absolute()))
            connection.execute(f"ATTACH {place} AS {quoted(name)} (READ_ONLY)")
        _copied(connection, names, to, traces, maps, whole=whole)


def _copied(
    connection: DuckDBPyConnection,
    sources: Sequence[str],
    to: Path,
    traces: Mapping[int, str],
    maps: Mapping[str, str],
    *,
    whole: bool = True,
) -> None:
    """Create a new store, and copy the selected traces of attached stores into it."""
    attach_empty(connection, to)
    for database in sources:
        words = {enum: shape.labels_of(connection, database, enum) for enum in NAMES}
        shape.widen(connection, "fresh", words)
    _choose(connection, traces, maps)
    for table in shape.expected().tables:
        if table not in _AS_MADE:
            rows = " UNION ALL BY NAME ".join(_chosen(table, name) for name in sources)
            if table in _ONCE or table == "manifest":
                rows = f"SELECT DISTINCT * FROM ({rows})"
            order = f" ORDER BY {ORDERS.get(table, 'ALL')}" if table in _SORTED else " ORDER BY ALL"
            if table in {"map", "map_node"}:  # map texts are long, and a map has few rows
                order = f" ORDER BY map_id{', node_id DESC' * (table == 'map_node')}"
            connection.execute(f"INSERT INTO fresh.inside.{table} BY NAME {rows}{order}")
    ((found,),) = connection.execute("SELECT count(*) FROM fresh.inside.trace").fetchall()
    if whole and found != len(traces):
        raise StoreError(f"{to}: {len(traces) - found} of {len(traces)} traces are not there")
    connection.execute("DETACH fresh")


def _choose(
    connection: DuckDBPyConnection, traces: Mapping[int, str], maps: Mapping[str, str]
) -> None:
    """Create temporary SQL tables of the selected traces and of the new names of road maps."""
    for table, kind, values in (("chosen", "BIGINT", traces), ("named", "VARCHAR", maps)):
        connection.execute(
            f"CREATE OR REPLACE TEMP TABLE {table} AS SELECT unnest(CAST($1 AS {kind}[])) AS key,"
            " unnest(CAST($2 AS VARCHAR[])) AS name",
            [[*values], [*values.values()]],
        )


_ONCE: Final = {table: owner for owner, tables in SHARED.items() for table in tables}
"""Tables shared by several traces → table with the references."""


def _chosen(table: str, database: str) -> str:
    """Return SQL that selects the rows of the chosen traces from one table of an attached store."""
    inside = f"{quoted(database)}.inside"
    traces = f"(SELECT t.* FROM {inside}.trace t WHERE t.trace_id IN (SELECT key FROM chosen))"
    if table == "trace":
        return (
            f"SELECT t.* REPLACE (c.name AS name) FROM {inside}.trace t"
            " JOIN chosen c ON c.key = t.trace_id"
        )
    if table == "manifest":
        owners = " OR ".join(
            f"(owner = '{owner}' AND id IN (SELECT {owner}_id FROM {traces}"
            f" WHERE {owner}_id IS NOT NULL))"
            for owner in ("trace", *SHARED)
        )
        return f"SELECT * FROM {inside}.manifest WHERE {owners}"
    if table in _ONCE:
        key = f"{_ONCE[table]}_id"
        chosen = f"{key} IN (SELECT {key} FROM {traces} WHERE {key} IS NOT NULL)"
        if table == "map":
            return (
                f"SELECT m.* REPLACE (coalesce(n.name, m.name) AS name) FROM {inside}.map m"
                f" LEFT JOIN named n ON n.key = m.digest WHERE m.{chosen}"
            )
        place = " REPLACE (NULL AS place)" if table == "recording" else ""
        return f"SELECT *{place} FROM {inside}.{table} WHERE {chosen}"
    column = next(name for name in _TRACE_OF if name in types_of(table))
    return f"SELECT * FROM {inside}.{table} WHERE {_TRACE_OF[column]} IN (SELECT key FROM chosen)"
