"""Bundles: store files of a collection. A bundle has sorted traces of one or several stores.

Ids of traces, maps, recordings and settings come from digests. They are equal in every store, so rows are
copied unchanged.
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import sgstore.store._schema as shape
from sgstore.base.quoting import literal, quoted
from sgstore.errors import StoreError
from sgstore.model.frame_ids import BUCKET_BITS, SEQ_BITS
from sgstore.model.vocabulary import NAMES
from sgstore.store._columns import ORDERS, types_of
from sgstore.store._creation import attach_empty
from sgstore.store._engine_errors import translated
from sgstore.store._locking import Access, default_memory, spill_folder
from sgstore.store._publish import SCATTERED, SHARED
from sgstore.store._rows import run
from sgstore.store._staging import Sealed, scratch
from sgstore.store._table_stream import FILE, TableFile
from sgstore.store._topics import FRAME, LISTING, TOPIC_FILES, copy_topic_tables
from sgstore.store._traces import stored_traces

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._file import StoreFile

TOGETHER: Final = 64
"""Largest number of stores in one join. More stores are joined in several steps."""

_TRACE_OF: Final = {
    FRAME: f"{quoted(FRAME)} >> {SEQ_BITS}",
    "trace_id": "trace_id",
    "bucket": f"bucket >> {BUCKET_BITS}",
    "frame_id": f"frame_id >> {SEQ_BITS}",
}
"""SQL of the trace id of a row, by column. The first column that a table has is used."""


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
            scratch(spill_folder(), memory=_memory(), threads=threads) as connection,
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


def _memory() -> int:
    """Return the memory limit of the database while a bundle is made; bytes."""
    return default_memory() * 5 // 8


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
        scratch(spill_folder(), memory=_memory(), threads=threads) as connection,
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
    topics = copy_topic_tables(connection, sources, "fresh")
    for table, having in (dict.fromkeys(shape.expected().tables, sources) | topics).items():
        if table not in {"store_info", "bits"}:  # every new store has their rows
            rows = " UNION ALL BY NAME ".join(_chosen(table, name) for name in having)
            if table in _ONCE or table == "manifest":
                rows = f"SELECT DISTINCT * FROM ({rows})"
            order = (
                f" ORDER BY {ORDERS.get(table, 'ALL')}" if table in SCATTERED else " ORDER BY ALL"
            )
            if table in topics:
                order = ""  # in order of time in each trace
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
    """Create temporary SQL tables with the selected traces, and with the new names of road maps."""
    for table, kind, values in (("chosen", "BIGINT", traces), ("named", "VARCHAR", maps)):
        connection.execute(
            f"CREATE OR REPLACE TEMP TABLE {table} AS SELECT unnest(CAST($1 AS {kind}[])) AS key,"
            " unnest(CAST($2 AS VARCHAR[])) AS name",
            [[*values], [*values.values()]],
        )


_ONCE: Final = {table: owner for owner, tables in SHARED.items() for table in tables}
"""Tables whose rows several traces share → table that refers to these rows."""


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
    own = shape.expected().tables
    columns = types_of(table) if table in own else {"trace_id" if table == LISTING else FRAME}
    column = next(name for name in _TRACE_OF if name in columns)
    return f"SELECT * FROM {inside}.{table} WHERE {_TRACE_OF[column]} IN (SELECT key FROM chosen)"


CATALOGUE: Final = {
    table: dict(column.split() for column in columns.split(", "))
    for table, columns in {
        "bundle": "bundle VARCHAR, bytes BIGINT, frames BIGINT, traces BIGINT, schema_version VARCHAR, "
        "schema_digest VARCHAR, created_by VARCHAR, start_ns BIGINT, end_ns BIGINT",
        "trace": "bundle VARCHAR, trace_id BIGINT, name VARCHAR, digest VARCHAR, ego VARCHAR, "
        "map VARCHAR, map_digest VARCHAR, config VARCHAR, answers VARCHAR, frames BIGINT, "
        "start_ns BIGINT, end_ns BIGINT, period_ns BIGINT, uri VARCHAR, first_bucket BIGINT, "
        "buckets BIGINT, scope VARCHAR, segment VARCHAR",
        "config": "config VARCHAR, settings VARCHAR",
        "triple": "bundle VARCHAR, set VARCHAR, moving BOOLEAN, relation VARCHAR, src_kind VARCHAR, "
        "dst_kind VARCHAR, rows BIGINT",
        "kind": "bundle VARCHAR, home VARCHAR, kind VARCHAR",
        "word": "bundle VARCHAR, what VARCHAR, word VARCHAR, type VARCHAR, place BIGINT",
        "class_count": "bundle VARCHAR, abstraction VARCHAR, class VARCHAR, frames BIGINT, traces BIGINT",
        "set": "bundle VARCHAR, name VARCHAR, trace_id BIGINT, digest VARCHAR, settings VARCHAR, "
        "answers VARCHAR",
    }.items()
}
"""Tables of the catalogue of a collection: table → column → database type.

``word``: the names that the compiler must know beside its own: of an enumeration (``kind``, ``relation``,
``light_state``), of user-defined attributes (``own``, ``own_edges``, with their types), of abstractions
with stored frame classes (``classed``), and of topics with their stored fields (``topic``, as JSON;
their types, or the reason why a topic cannot be decoded). ``trace.scope``: counts of excluded data from its
report, as JSON; empty or NULL: unknown.
"""

Facts = dict[str, list[tuple[Any, ...]]]
"""Rows of the catalogue of a collection, by table."""

_TRACES: Final = """
SELECT t.trace_id, t.name, r.digest, coalesce(t.ego, ''), coalesce(m.name, ''), coalesce(m.digest, ''),
c.digest,
       to_json(t.answers)::VARCHAR, t.frames, t.start_ns, t.end_ns, t.period_ns, r.uri, b.first, b.buckets,
       coalesce(json_extract(t.report, '$.scope')::VARCHAR, '')
FROM trace t JOIN recording r ON r.recording_id = t.recording_id JOIN config c ON c.config_id = t.config_id
     LEFT JOIN map m ON m.map_id = t.map_id
     JOIN (SELECT trace_id, min(bucket) AS first, max(bucket) - min(bucket) + 1 AS buckets FROM bucket GROUP BY
     trace_id) b
       ON b.trace_id = t.trace_id
ORDER BY t.trace_id
"""

_CLASSES: Final = """
SELECT abstraction, replace(class::VARCHAR, '-', ''), CAST(sum(bit_count(mask)) AS BIGINT),
       count(DISTINCT bucket >> 18)
FROM (SELECT * FROM frame_class UNION ALL SELECT * FROM later_class)
WHERE class IS NOT NULL GROUP BY ALL ORDER BY ALL
"""

_SETS: Final = """
SELECT name, trace_id, digest, settings::VARCHAR, to_json(answers)::VARCHAR FROM derived ORDER BY name, trace_id
"""

_INFO: Final = "SELECT key, value FROM store_info"


def facts_of(file: StoreFile, bundle: str, size: int) -> Facts:
    """Return table rows that summarise a store: its traces, frame classes, names and settings.

    For triples outside the graphs, ``moving`` is NULL.

    Parameters
    ----------
    file : StoreFile
    bundle : str
        Name of the bundle in the catalogue.
    size : int
        File size in bytes.
    """
    with file.access.reading() as connection:
        catalog = file.catalog()
        info = dict(run(connection, _INFO).values)
        traces = run(connection, _TRACES).values
        sets = run(connection, _SETS).values
        classes = run(connection, _CLASSES).values
        settings = run(connection, "SELECT digest, settings FROM config ORDER BY digest").values
    found: Facts = {
        "bundle": [
            (
                *(bundle, size, sum(row[8] for row in traces), len(traces)),
                *(info[name] for name in ("schema_version", "schema_digest", "created_by")),
                min((row[9] for row in traces), default=0),
                max((row[10] for row in traces), default=0),
            )
        ],
        "trace": [(bundle, *row, "") for row in traces],
        "config": settings,
        "triple": [],
        "kind": [
            (bundle, home, kind)
            for home in ("moving", "fixed", "mapped")
            for kind in sorted(getattr(catalog, home))
        ],
        "word": [*_words(bundle, catalog)],
        "class_count": [(bundle, *row) for row in classes],
        "set": [(bundle, *row) for row in sets],
    }
    for name in ["", *sorted({row[0] for row in sets})]:
        seen = catalog.under(name) if name else catalog
        if seen is None:
            continue
        for moving, table in (
            (True, seen.edges),
            (False, seen.map_edges),
            (None, seen.beyond_edges),
        ):
            found["triple"] += [
                (bundle, name, moving, *triple, n) for triple, n in sorted(table.items())
            ]
    return found


def _words(bundle: str, catalog: Any) -> Iterator[tuple[Any, ...]]:
    for enum, names in (catalog.names or {}).items():
        for place, name in enumerate(names):
            yield bundle, enum, name, "", place
    for what in ("own", "own_edges"):
        for name, kind in sorted(getattr(catalog, what).items()):
            yield bundle, what, name, kind.value, 0
    for name in catalog.classed:
        yield bundle, "classed", name, "", 0
    for name, topic in sorted(catalog.topics.items()):
        yield bundle, "topic", json.dumps([name, ""]), topic.refused, 0
        for field in topic.source().values() if topic.stored else ():
            yield bundle, "topic", json.dumps([name, field.name]), field.declared, 0


def split_segment(sealed: Path, to: Path, of_map: Path) -> str:
    """Copy an unpublished trace to a folder, and its map to another. Return the map digest; empty if none.

    Parameters
    ----------
    sealed : Path
        Folder of the segment.
    to, of_map : Path
        Existing empty folders for the segment without its map, and for the map.

    Raises
    ------
    StoreError
        The segment is not readable, or a file is not writable.
    """
    told = Sealed.read(sealed)
    _copy_pieces([sealed], lambda table: of_map if table in SHARED["map"] else to, [to, of_map])
    replace(told, folder=to).write()
    _copy_topics(sealed, to)
    return told.identity.map_digest


def whole_segment(folders: Sequence[Path], to: Path) -> Sealed:
    """Combine the files of an unpublished trace and of its road map in a new folder.

    Parameters
    ----------
    folders : sequence of Path
        Folder of the trace, and of its road map if it has one.
    to : Path
        Existing empty folder.

    Raises
    ------
    StoreError
        A file is not readable or writable, or is not a staging file.
    """
    _copy_pieces(folders, lambda _: to, [to])
    whole = replace(Sealed.read(folders[0]), folder=to)
    whole.write()
    _copy_topics(folders[0], to)
    return whole


def _copy_topics(source: Path, to: Path) -> None:
    for file in source.glob(TOPIC_FILES):
        shutil.copyfile(file, to / file.name)


def _copy_pieces(
    sources: Sequence[Path], place: Callable[[str], Path], folders: Sequence[Path]
) -> None:
    """Copy the tables of segments to new folders. ``place`` returns the folder for a table name."""
    with ExitStack() as stack:
        fresh = {
            to: stack.enter_context(closing(TableFile(to / FILE, to, new=True))) for to in folders
        }
        for source in sources:
            tables = stack.enter_context(closing(TableFile(source / FILE, source)))
            for piece in tables.all():
                to = fresh[place(piece.table)]
                to.append(piece.table, tables.read(piece), tables.texts(piece))
