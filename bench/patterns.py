"""Patterns over a million frames: how long each takes, beside rows a frame, a graph database, and networkx.

::

    python -m bench patterns [--quick]

The drives are made up (:mod:`bench.drives`). ``--quick`` takes 20,000 frames. Every answer of a baseline is
compared; a difference is an error. ``SGSTORE_BENCH_STORE=FILE`` keeps the store, and takes it if it is there.
networkx and the graph database (:mod:`bench.peers`, if there is one) are asked over a part of the frames, and
their times are given as ratios a frame. As a machine may be busy, each time is given as processor time too, and
as a share of that of a fixed statement.
"""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import duckdb
import networkx as nx
from networkx.algorithms.isomorphism import MultiDiGraphMatcher

from bench import drives, peers
from bench.least_bytes import sizes
from bench.measure import Measure
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, PairSettings
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Graph = nx.MultiDiGraph

FRAMES, QUICK = 1_000_000, 20_000
BASELINE_FRAMES = 1_000
"""Frames that networkx goes through."""
REFERENCE = "SELECT count(DISTINCT frame_id) FROM inside.state WHERE speed > 5"
"""The statement that processor times are compared with."""
WALL_MS, MEDIAN_MS, BYTES, PEAK_MB = 200, 40, 60, 1000
"""What is aimed at: of each question, of half of them, of edges, nodes and frames, and of memory."""
NEAR = ("safety_hazard", "near_coll", "super_near", "very_near", "near")
VEHICLES = {"car", "truck", "van", "bus"}


class Question(NamedTuple):
    """A pattern, and the same in SQL over rows a frame and as a search of a graph where it is a baseline."""

    label: str
    pattern: str
    rows: str = ""
    small: Callable[[], tuple[Graph, Callable[[Graph, dict[int, int]], bool]]] | None = None


def wanted(*edges: tuple[str, str, str], **kinds: str) -> Graph:  # pyright: ignore[reportUnknownParameterType]
    graph = nx.MultiDiGraph()
    graph.add_nodes_from((name, {"kind": kind}) for name, kind in kinds.items())
    for src, relation, dst in edges:
        graph.add_edge(src, dst, relation=relation)
    return graph


def _always(_: Graph, __: dict[int, int]) -> bool:
    return True


QUESTIONS = (
    Question(
        "one relation, selective",
        "MATCH (e:Ego)-[:near_coll]->(p:Person) RETURN FRAMES",
        "SELECT count(DISTINCT frame) FROM edge WHERE relation = 'near_coll' AND src_kind = 'ego'"
        " AND dst_kind = 'person'",
        lambda: (wanted(("e", "near_coll", "p"), e="ego", p="person"), _always),  # pyright: ignore[reportUnknownLambdaType]
    ),
    Question("one relation, nearly everywhere", "MATCH (e:Ego)-[:inDFrontOf]->(v:Car) RETURN COUNT(*)"),
    Question(
        "in one lane, near, and fast",
        "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(c:Car), (e)-[:near]->(c) WHERE c.speed > 10",
        "SELECT count(DISTINCT a.frame) FROM edge a JOIN edge b ON b.frame = a.frame AND b.dst = a.dst"
        " AND b.src <> a.src JOIN edge n ON n.frame = a.frame AND n.src = a.src AND n.dst = b.src"
        " JOIN node c ON c.frame = a.frame AND c.node = b.src"
        " WHERE a.relation = 'isIn' AND a.src_kind = 'ego' AND a.dst_kind = 'lane' AND b.relation = 'isIn'"
        " AND b.src_kind = 'car' AND n.relation = 'near' AND c.speed > 10",
        lambda: (  # pyright: ignore[reportUnknownLambdaType]
            wanted(("e", "isIn", "l"), ("c", "isIn", "l"), ("e", "near", "c"), e="ego", c="car", l="lane"),
            lambda graph, found: graph.nodes[_of(found, "c")]["speed"] > 10,  # pyright: ignore[reportUnknownLambdaType]
        ),
    ),
    Question(
        "a triangle",
        "MATCH (e:Ego)-[:super_near]->(a:Car)-[:super_near]->(b:Car), (e)-[:near]->(b)",
        "SELECT count(DISTINCT x.frame) FROM edge x JOIN edge y ON y.frame = x.frame AND y.src = x.dst"
        " JOIN edge z ON z.frame = x.frame AND z.src = x.src AND z.dst = y.dst"
        " WHERE x.relation = 'super_near' AND x.src_kind = 'ego' AND x.dst_kind = 'car'"
        " AND y.relation = 'super_near' AND y.dst_kind = 'car' AND z.relation = 'near'",
        lambda: (  # pyright: ignore[reportUnknownLambdaType]
            wanted(
                *(("e", "super_near", "a"), ("a", "super_near", "b"), ("e", "near", "b")),
                e="ego",
                a="car",
                b="car",
            ),
            _always,
        ),
    ),
    Question(
        "five nodes, all different",
        "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(a:Car), (e)-[:near]->(b:Truck)-[:isIn]->(m:Lane),"
        " (m)-[:toLeftOf]->(l)",
    ),
    Question(
        "not exists",
        "MATCH (e:Ego)-[:visible]->(p:Person) WHERE NOT EXISTS {(e)-[:near|very_near|super_near]->(:Vehicle)}",
        "SELECT count(DISTINCT x.frame) FROM edge x WHERE x.relation = 'visible' AND x.src_kind = 'ego'"
        " AND x.dst_kind = 'person' AND NOT EXISTS (FROM edge y WHERE y.frame = x.frame AND y.src = x.src"
        " AND y.relation IN ('near', 'very_near', 'super_near')"
        " AND y.dst_kind IN ('car', 'truck', 'van', 'bus'))",
    ),
    Question(
        "at least three",
        "MATCH (e:Ego) WHERE COUNT {(e)-[:near|very_near|super_near|near_coll]->(:Car)} >= 3 RETURN FRAMES",
        "SELECT count(*) FROM (SELECT frame FROM edge WHERE src_kind = 'ego' AND dst_kind = 'car'"
        " AND relation IN ('near', 'very_near', 'super_near', 'near_coll') GROUP BY frame"
        " HAVING count(DISTINCT dst) >= 3)",
    ),
    Question(
        "attributes of two nodes",
        "MATCH (e:Ego)-[:near]->(c:Car) WHERE c.speed - e.speed > 3",
        "SELECT count(DISTINCT x.frame) FROM edge x JOIN node e ON e.frame = x.frame AND e.node = x.src"
        " JOIN node c ON c.frame = x.frame AND c.node = x.dst WHERE x.relation = 'near'"
        " AND x.src_kind = 'ego' AND x.dst_kind = 'car' AND c.speed - e.speed > 3",
    ),
    Question(
        "a way of up to three lanes",
        "MATCH (e:Ego)-[:isIn]->(l:Lane)-[:travelsTo*1..3]->(m:Lane)<-[:isIn]-(t:Truck) RETURN FRAMES",
    ),
    Question(
        "numbers of a pair",
        "MATCH (e:Ego)-[:super_near]->(c:Car) WHERE gap(e, c) < 1.5 AND closing_speed(e, c) > 1",
    ),
    Question("a count of every pair of kinds", "MATCH (a)-[r:near|very_near]->(b)"
             " RETURN a.kind AS a, type(r) AS r, b.kind AS b, COUNT(*) AS n"),
    Question("the first ten", "MATCH (e:Ego)-[:near]->(c:Car) RETURN c.name LIMIT 10"),
    Question("three cars", "MATCH (e:Ego)-[:near]->(a:Car), (e)-[:very_near]->(b:Car), (e)-[:visible]->(c:Car)"
             " RETURN COUNT(*)"),
    Question(
        "two relations, and not a third",
        "MATCH (c:Car)-[:inDFrontOf]->(e:Ego), (e)-[:super_near]->(c)"
        " WHERE NOT EXISTS {(c)-[:isIn]->(:Lane)<-[:isIn]-(e)}",
    ),
    Question("any relation", "MATCH (e:Ego)-->(p:Person) WHERE p.speed > 1 RETURN FRAMES"),
    Question(
        "one of two kinds, in a lane",
        "MATCH (v:Truck|Bus)-[:isIn]->(l:Lane {lane: 1}), (e:Ego)-[:near]->(v)",
    ),
    Question("intervals", "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v.id, INTERVALS"),
    Question("longest tailgating", "MATCH (e:Ego), (v:Car) WHERE lead(e, v) AND headway(e, v) < 1"
             " RETURN v.name, INTERVALS ORDER BY frames DESC LIMIT 10"),
)  # fmt: skip


def built(path: Path, frames: int) -> tuple[float, float]:
    """Make a store; seconds in all, and of the generator alone."""
    config = Config(pairs=PairSettings(within=7.0, ego_within=25.0))
    maps = [read_map(drives.street(n), f"street {n}") for n in range(drives.MAPS)]
    store = StoreFile.create(path)
    start, graphs = time.perf_counter(), 0.0
    for number, length in enumerate(drives.lengths(frames)):
        road_map = maps[number % drives.MAPS]
        generator = SceneGraphGenerator(road_map, config)
        about = drives.info(number, length)
        with store.segment(about, config, road_map=road_map, answers=generator.answers) as segment:
            for block in drives.drive(number, length):
                kept = segment.as_kept(block)
                began = time.perf_counter()
                graph = generator.block(kept)
                graphs += time.perf_counter() - began
                segment.append(graph)
            store.publish(segment.seal(TraceReport(frames=length)))
    store.compact()
    return time.perf_counter() - start, graphs


def asked(store: Store, question: Question, times: int) -> tuple[float, float, object]:
    """Best time and best processor time of a question, whole, and its answer."""
    best, worked, answer = float("inf"), float("inf"), None
    for _ in range(times):
        start, before = time.perf_counter(), time.process_time()
        matches = store.find(question.pattern)
        if "LIMIT" in question.pattern:
            answer = len(matches.rows())  # few: as a stream, window by window
        elif "RETURN" in question.pattern and "RETURN FRAMES" not in question.pattern:
            answer = len(matches.numpy()[matches.columns[0]])
        else:
            answer = matches.count()
        best = min(best, time.perf_counter() - start)
        worked = min(worked, time.process_time() - before)
    return best, worked, answer


def reference(store: Store) -> float:
    """Processor time of the statement that others are compared with."""
    best = float("inf")
    for _ in range(5):
        before = time.process_time()
        store.sql(REFERENCE)
        best = min(best, time.process_time() - before)
    return best


def flat(store: StoreFile, path: Path) -> duckdb.DuckDBPyConnection:
    """Rows a frame, with the kinds of both ends, in the order of relation, kinds and frame."""
    connection = duckdb.connect(str(path))
    connection.execute(f"ATTACH '{store.path}' AS store (READ_ONLY)")
    connection.execute("USE store")
    connection.execute(
        "CREATE TABLE flat.main.edge AS SELECT frame_id AS frame, src, relation::VARCHAR AS relation, dst,"
        " CASE WHEN src_is_ego THEN 'ego' ELSE src_kind::VARCHAR END AS src_kind,"
        " CASE WHEN dst_is_ego THEN 'ego' ELSE dst_kind::VARCHAR END AS dst_kind FROM edges"
        " ORDER BY relation, src_kind, dst_kind, frame"
    )
    connection.execute(
        "CREATE TABLE flat.main.node AS SELECT frame_id AS frame, node_id AS node, kind::VARCHAR AS kind, x, y,"
        " heading, speed FROM nodes ORDER BY kind, frame"
    )
    connection.execute("USE flat")
    return connection


def searched(folder: Path, store: Store, frames: int) -> Iterator[tuple[Question, float, int]]:
    """What networkx finds in pickled graphs, and how long it takes a frame."""
    files = []
    for ref in frames_of(store, frames):
        graph = store.graph(ref)
        for _, node in graph.nodes(data=True):
            node["kind"] = "ego" if node.get("is_ego") else node["kind"]
        files.append(folder / f"{ref}.pickle")
        files[-1].write_bytes(pickle.dumps(graph))
    for question in QUESTIONS:
        if question.small is None:
            continue
        pattern, holds = question.small()
        start, hits = time.perf_counter(), 0
        for file in files:
            graph = pickle.loads(file.read_bytes())
            matcher = MultiDiGraphMatcher(
                graph,
                pattern,
                node_match=lambda a, b: a["kind"] == b["kind"],  # pyright: ignore[reportUnknownLambdaType]
                edge_match=lambda a, b: (  # pyright: ignore[reportUnknownLambdaType]
                    {e["relation"] for e in b.values()} <= {e["relation"] for e in a.values()}
                ),
            )
            hits += any(holds(graph, found) for found in matcher.subgraph_monomorphisms_iter())
        yield question, (time.perf_counter() - start) / len(files), hits


def _of(found: dict[int, str], name: str) -> int:
    return next(node for node, wanted_name in found.items() if wanted_name == name)


def frames_of(store: Store, frames: int) -> list[int]:
    sql = f"SELECT frame_id FROM frames ORDER BY frame_id LIMIT {frames}"
    return [row[0] for row in store.sql(sql).values]


PEAK = """
import re, sys
from pathlib import Path
from bench.patterns import QUESTIONS, asked
from sgstore.query import Store
store = Store(sys.argv[1])
for question in QUESTIONS:
    asked(store, question, 1)
print(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
"""


def peak_mb(path: Path) -> float:
    command = [sys.executable, "-c", PEAK, str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(run.stdout) / 1000


def run(quick: bool = False) -> list[Measure]:
    """Build, ask, and compare."""
    frames = QUICK if quick else FRAMES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = Path(os.environ.get("SGSTORE_BENCH_STORE") or folder / "million.sgstore")
        table = []
        if not path.exists():
            spent, graphs = built(path, frames)
            table.append(Measure("built", frames / spent, "frames/s", f"{frames:,} frames"))
            table.append(Measure("  the scene graphs of it", frames / graphs, "frames/s"))
        frames, measures = _sizes(path, folder)
        table += measures
        with Store(path) as store:
            table += _compared(store, folder, frames)
        table.append(
            Measure(
                "peak memory, all questions", peak_mb(path), "MB", f"aim {PEAK_MB:,}, of a process"
            )
        )
    return table


def _sizes(path: Path, folder: Path) -> tuple[int, list[Measure]]:
    """Number of frames, and what the store and its tables take."""
    with Store(path) as store:
        ((frames,),) = store.sql("SELECT count(*) FROM frames").values
        ((nodes,),) = store.sql("SELECT sum(bit_count(mask)) FROM inside.node").values
        ((states,),) = store.sql("SELECT count(*) FROM inside.state").values
        ((edges,),) = store.sql("SELECT sum(bit_count(mask)) FROM inside.edge").values
    tables = list(sizes(path, folder))  # by a connection of its own: not while the store is open
    structure = sum(size for label, size, _ in tables if label in {"edge", "node", "frame"})
    table = [
        Measure(
            "nodes, and edges without the map's",
            (nodes + states) / frames,
            "a frame",
            f"{edges / frames:.1f} edges",
        ),
        Measure("whole store", path.stat().st_size / frames, "B/frame"),
        Measure("edges, nodes and frames", structure / frames, "B/frame", f"aim {BYTES}"),
    ]
    for label, size, rows in tables:
        note = f"{rows / frames:.2f} rows a frame"
        table.append(Measure(f"  {label}", size / frames, "B/frame", note))
        if label == "state":
            table.append(Measure("  one object in state", size / rows, "B"))
    return frames, table


def _compared(store: Store, folder: Path, frames: int) -> Iterator[Measure]:
    rows = flat(store.file, folder / "flat.db")
    part = min(BASELINE_FRAMES, frames)
    last = frames_of(store, part)[-1]
    slow = {
        question.label: (spent, hits) for question, spent, hits in searched(folder, store, part)
    }
    of_peer = min(peers.FRAMES, frames)
    last_of_peer = frames_of(store, of_peer)[-1]
    peer = peers.loaded(rows, folder, last_of_peer)
    yield _peer(peer, of_peer)
    with store.file.snapshot():  # warm: the file stays open
        base = reference(store)
    yield Measure("reference, processor time", 1e3 * base, "ms", REFERENCE)
    times = []
    for question in QUESTIONS:
        with store.file.snapshot():
            spent, worked, answer = asked(store, question, 5)
        times.append(spent)
        notes = [f"processor {1e3 * worked:.0f} ms = {worked / base:.2f} of the reference"]
        if question.rows:
            start = time.perf_counter()
            (other,) = rows.execute(question.rows).fetchone()  # pyright: ignore[reportGeneralTypeIssues]
            notes.append(f"{(time.perf_counter() - start) / spent:.1f} times rows")
            _same(question, answer, other)
        if question.label in slow:
            seconds, hits = slow[question.label]
            notes.append(f"{seconds * frames / spent:,.0f} times networkx")
            _same(question, _until(store, question, last), hits)
        if peer is not None and question.label in peers.CYPHER:
            seconds, hits = peers.asked(peer, question.label)
            notes.append(f"{seconds * frames / of_peer / spent:,.1f} times {peer.name}")
            _same(question, _until(store, question, last_of_peer), hits)
        yield Measure(
            question.label, 1e3 * spent, "ms", f"{answer:>9,}  {', '.join(notes)}".rstrip()
        )
    times.sort()
    slowest = f"aim {MEDIAN_MS}; slowest {1e3 * times[-1]:.0f} ms, aim {WALL_MS}"
    yield Measure("median", 1e3 * times[len(times) // 2], "ms", slowest)
    rows.close()


def _peer(peer: peers.Peer | None, frames: int) -> Measure:
    """What a graph database took to take frames in."""
    if peer is None:
        return Measure("graph database", 0, "", peers.MISSING)
    return Measure(
        f"{peer.name}, its files",
        peer.bytes / frames,
        "B/frame",
        f"{frames:,} frames at {frames / peer.load_s:,.0f} a second",
    )


def _until(store: Store, question: Question, last: int) -> int:
    """How many frames up to one match, whatever the question returns."""
    found = store.find(re.sub(" RETURN.*", "", question.pattern)).frames()
    return sum(frame.frame_id <= last for frame in found)


def _same(question: Question, ours: object, theirs: object) -> None:
    if ours != theirs:
        raise AssertionError(f"{question.label}: {ours} here, {theirs} there")
