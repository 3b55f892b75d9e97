"""The questions of :mod:`bench.patterns` asked of a graph database: kuzu, or real-ladybug, which carries it on.

Neither is needed: ``pip install --group peers`` brings one. The graph is the disjoint union of those of the
first frames, with a table for each kind of node and for each relation, as these databases like it best.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import duckdb

PEERS = ("kuzu", "real_ladybug")
FRAMES = 20_000
"""So many frames it is given at most: it takes them in slowly."""

MISSING = "no kuzu and no real-ladybug here: 'pip install --group peers' for this comparison"

CYPHER = {
    "one relation, selective": "MATCH (e:ego)-[:near_coll]->(p:person)",
    "in one lane, near, and fast": "MATCH (e:ego)-[:isIn]->(l:lane)<-[:isIn]-(c:car), (e)-[:near]->(c)"
    " WHERE c.speed > 10",
    "a triangle": "MATCH (e:ego)-[:super_near]->(a:car)-[:super_near]->(b:car), (e)-[:near]->(b)",
    "not exists": "MATCH (e:ego)-[:visible]->(p:person)"
    " WHERE NOT EXISTS {MATCH (e)-[:near|:very_near|:super_near]->(v:car:truck:van:bus)}",
    "at least three": "MATCH (e:ego)-[:near|:very_near|:super_near|:near_coll]->(c:car)"
    " WITH e, count(DISTINCT c.id) AS n WHERE n >= 3",
    "attributes of two nodes": "MATCH (e:ego)-[:near]->(c:car) WHERE c.speed - e.speed > 3",
}
"""Questions by their label; each is about the ego, of which there is one a frame."""


class Peer(NamedTuple):
    """A graph database that holds the first frames."""

    name: str
    connection: Any
    load_s: float
    bytes: int


def loaded(rows: duckdb.DuckDBPyConnection, folder: Path, last: int) -> Peer | None:
    """A graph database with the frames up to one; ``None`` if there is none to be had.

    Parameters
    ----------
    rows : duckdb.DuckDBPyConnection
        Tables ``node`` and ``edge``, a row a frame, as :func:`bench.patterns.flat` makes them.
    folder : Path
        For its files.
    last : int
        frame_id of the last frame.
    """
    library = next(filter(None, map(_imported, PEERS)), None)
    if library is None:
        return None
    start = time.perf_counter()
    place = folder / "peer.db"
    connection = library.Connection(library.Database(str(place)))
    for statement in _statements(rows, folder, last):
        connection.execute(statement)
    spent = time.perf_counter() - start
    files = [place] if place.is_file() else [f for f in place.rglob("*") if f.is_file()]
    return Peer(library.__name__, connection, spent, sum(f.stat().st_size for f in files))


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        return None


def _statements(rows: duckdb.DuckDBPyConnection, folder: Path, last: int) -> Iterator[str]:
    """What makes the tables and fills them from files."""
    rows.execute(
        "CREATE OR REPLACE TEMP TABLE peer_node AS SELECT row_number() OVER () AS id, n.frame, n.node, n.speed,"
        " CASE WHEN e.src IS NULL THEN n.kind ELSE 'ego' END AS kind FROM node n LEFT JOIN (SELECT DISTINCT"
        " frame, src FROM edge WHERE src_kind = 'ego') e ON e.frame = n.frame AND e.src = n.node"
        f" WHERE n.frame <= {last}"
    )
    rows.execute(
        "CREATE OR REPLACE TEMP TABLE peer_edge AS SELECT a.id AS a, b.id AS b, e.relation, a.kind AS src,"
        " b.kind AS dst FROM edge e JOIN peer_node a ON a.frame = e.frame AND a.node = e.src"
        f" JOIN peer_node b ON b.frame = e.frame AND b.node = e.dst WHERE e.frame <= {last}"
    )
    for (kind,) in rows.execute("SELECT DISTINCT kind FROM peer_node").fetchall():
        file = folder / f"{kind}.parquet"
        rows.execute(
            f"COPY (SELECT id, frame, speed FROM peer_node WHERE kind = '{kind}' ORDER BY id) TO '{file}'"
        )
        yield f"CREATE NODE TABLE {kind}(id INT64, frame INT64, speed DOUBLE, PRIMARY KEY(id))"
        yield f"COPY {kind} FROM '{file}'"
    ends: dict[str, list[tuple[str, str]]] = {}
    triples = "SELECT DISTINCT relation, src, dst FROM peer_edge ORDER BY ALL"
    for relation, src, dst in rows.execute(triples).fetchall():
        ends.setdefault(relation, []).append((src, dst))
    for relation, pairs in ends.items():
        yield f"CREATE REL TABLE {relation}({', '.join(f'FROM {a} TO {b}' for a, b in pairs)})"
        for src, dst in pairs:
            file = folder / f"{relation}-{src}-{dst}.parquet"
            rows.execute(
                f"COPY (SELECT a, b FROM peer_edge WHERE relation = '{relation}' AND src = '{src}'"
                f" AND dst = '{dst}' ORDER BY ALL) TO '{file}'"
            )
            yield f"COPY {relation} FROM '{file}' (from='{src}', to='{dst}')"


def asked(peer: Peer, label: str) -> tuple[float, int]:
    """The best of two times of a question, and how many frames it finds."""
    best, frames = float("inf"), -1
    for _ in range(2):
        start = time.perf_counter()
        found = peer.connection.execute(f"{CYPHER[label]} RETURN count(DISTINCT e.frame)")
        frames = found.get_next()[0]
        best = min(best, time.perf_counter() - start)
    return best, frames
