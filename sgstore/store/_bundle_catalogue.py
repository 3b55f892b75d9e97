"""Catalogue of a bundle (store in a collection): its traces, frame classes, names and relations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.base.quoting import quoted
from sgstore.errors import StoreError
from sgstore.store._rows import Rows, run

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from sgstore.store._file import StoreFile

CATALOGUE: Final[dict[str, dict[str, str]]] = {
    "bundle": {
        "bundle": "VARCHAR",
        "bytes": "BIGINT",
        "frames": "BIGINT",
        "traces": "BIGINT",
        "schema_version": "VARCHAR",
        "schema_digest": "VARCHAR",
        "created_by": "VARCHAR",
        "start_ns": "BIGINT",
        "end_ns": "BIGINT",
    },
    "trace": {
        "bundle": "VARCHAR",
        "trace_id": "BIGINT",
        "name": "VARCHAR",
        "digest": "VARCHAR",
        "ego": "VARCHAR",
        "map": "VARCHAR",
        "map_digest": "VARCHAR",
        "config": "VARCHAR",
        "answers": "VARCHAR",
        "frames": "BIGINT",
        "start_ns": "BIGINT",
        "end_ns": "BIGINT",
        "period_ns": "BIGINT",
        "uri": "VARCHAR",
        "first_bucket": "BIGINT",
        "buckets": "BIGINT",
        "scope": "VARCHAR",
        "segment": "VARCHAR",
    },
    "config": {"config": "VARCHAR", "settings": "VARCHAR"},
    "triple": {
        "bundle": "VARCHAR",
        "set": "VARCHAR",
        "moving": "BOOLEAN",
        "relation": "VARCHAR",
        "src_kind": "VARCHAR",
        "dst_kind": "VARCHAR",
        "rows": "BIGINT",
    },
    "kind": {"bundle": "VARCHAR", "home": "VARCHAR", "kind": "VARCHAR"},
    "word": {
        "bundle": "VARCHAR",
        "what": "VARCHAR",
        "word": "VARCHAR",
        "type": "VARCHAR",
        "place": "BIGINT",
    },
    "class_count": {
        "bundle": "VARCHAR",
        "abstraction": "VARCHAR",
        "class": "VARCHAR",
        "frames": "BIGINT",
        "traces": "BIGINT",
    },
    "set": {
        "bundle": "VARCHAR",
        "name": "VARCHAR",
        "trace_id": "BIGINT",
        "digest": "VARCHAR",
        "settings": "VARCHAR",
        "answers": "VARCHAR",
    },
}
"""Tables of a catalogue, with their columns and the types of these in the database.

``word``: the names that the compiler must know beside its own: of an enumeration (``kind``, ``relation``,
``light_state``), of user-defined attributes (``own``, ``own_edges``, with their types), and of abstractions
with stored frame classes (``classed``). ``trace.scope``: counts of excluded data from its report, as JSON;
empty or NULL: unknown.
"""

LATER: Final = frozenset({"scope"})
"""Columns that old catalogues lack."""

Facts = dict[str, list[tuple[Any, ...]]]
"""Rows of a catalogue by table."""

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


def parquet_rows(path: Path, columns: Iterable[str]) -> list[tuple[Any, ...]]:
    """Return some columns of an sgstore Parquet file as rows. Columns that older files lack are NULL.

    Raises
    ------
    StoreError
        The file is not readable, or lacks a column.
    """
    names = [*columns]
    listed = ", ".join(map(quoted, names))
    later = ", ".join(f"NULL::VARCHAR AS {quoted(name)}" for name in names if name in LATER)
    try:
        with duckdb.connect(":memory:") as connection:
            rows = "FROM read_parquet(?)"
            if later:
                rows = f"FROM (SELECT {later} WHERE FALSE UNION ALL BY NAME {rows})"
            sql = f"SELECT {listed} {rows}"
            found: Rows = run(connection, sql, [str(path)])
            return found.values
    except duckdb.Error as error:
        raise StoreError(f"{path}: cannot be read: {str(error).strip()}") from error
