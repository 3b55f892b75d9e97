"""Bytes a frame, table by table, and columns beside rows.

::

    python -m bench store [--quick]

The traces are made up (see :mod:`bench.ingest`) and ten to a store, so that what a file
takes anyway weighs little.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import duckdb

from bench.ingest import CARS, MINUTE, recording
from bench.least_bytes import bytes_of, sizes
from bench.measure import Measure
from sgstore.ingest import BLOCK_FRAMES
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import KINDS, RELATIONS
from sgstore.model.world import TraceReport
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import TraceInfo

BASELINE_FRAMES = 20
BYTES = 300
"""What is aimed at: bytes a frame of the compacted file, without the tables of maps."""


@dataclass
class Made:
    """All graphs of a recording, and what a store wants to know beside them."""

    graphs: list[GraphBlock]
    info: TraceInfo
    road_map: RoadMap
    answers: tuple[str, ...]

    @classmethod
    def of(cls, path: Path) -> Made:
        with open_trace(path) as trace:
            road_map = read_map(trace.info.map_text, trace.info.map_name)
            generator = SceneGraphGenerator(road_map, Config())
            graphs = [generator.block(block) for block in trace.blocks(BLOCK_FRAMES)]
            return cls(graphs, trace.info, road_map, generator.answers)

    def into(self, store: StoreFile, number: int = 0) -> float:
        """Bring the graphs into a store as a trace of its own; seconds."""
        info = replace(self.info, digest=f"{number:064x}"[::-1])
        start = time.perf_counter()
        with store.segment(info, Config(), road_map=self.road_map, answers=self.answers) as segment:
            for graph in self.graphs:
                segment.append(graph)
            store.publish(segment.seal(TraceReport()))
        return time.perf_counter() - start


def by_rows(graph: GraphBlock, frames: int, path: Path) -> tuple[float, int]:
    """Seconds to insert the nodes and edges of some frames row by row, and how many rows these are."""
    states, edges = graph.frames.states, graph.edges
    columns = (graph.frames.frame_of, states.node, states.x, states.y, states.heading)
    columns += (states.vx, states.vy)
    end = int(graph.frames.offsets[frames])
    nodes = [(*(column[i].item() for column in columns), KINDS[0]) for i in range(end)]
    links = [
        (int(f), int(s), RELATIONS[r], int(d))
        for f, s, r, d in zip(edges.frame, edges.src, edges.relation, edges.dst, strict=True)
        if f < frames
    ]
    with duckdb.connect(str(path)) as connection:
        connection.execute(
            "CREATE TABLE nodes (frame INT, node INT, x FLOAT, y FLOAT, heading FLOAT,"
            " vx FLOAT, vy FLOAT, kind TEXT)"
        )
        connection.execute("CREATE TABLE edges (frame INT, src INT, relation TEXT, dst INT)")
        start = time.perf_counter()
        connection.execute("BEGIN")
        connection.executemany("INSERT INTO nodes VALUES (?, ?, ?, ?, ?, ?, ?, ?)", nodes)
        connection.executemany("INSERT INTO edges VALUES (?, ?, ?, ?)", links)
        connection.execute("COMMIT")
        return time.perf_counter() - start, len(nodes) + len(links)


def filled(folder: Path, traces: int, minutes: int) -> tuple[StoreFile, int]:
    """A store of traces that differ in their digest only, and its number of frames."""
    store = StoreFile.create(folder / "many.db")
    made = Made.of(recording(folder / "m.mcap", minutes * MINUTE))
    for number in range(traces):
        made.into(store, number)
    return store, traces * minutes * MINUTE


def run(quick: bool = False) -> list[Measure]:
    """Sizes of a store, and what columns are worth."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store, frames = filled(folder, traces=3 if quick else 10, minutes=2 if quick else 10)
        store.close()  # connections of duckdb's own come
        whole = store.path.stat().st_size
        table = [
            Measure("whole store", whole / frames, "B/frame", f"{frames:,} frames, {CARS} cars")
        ]
        for label, size, rows in sizes(store.path, folder):
            per_frame = f"{rows / frames:.2f} rows a frame"
            table.append(Measure(f"  {label}", size / frames, "B/frame", per_frame))
            if label == "state":
                table.append(Measure("  one object in state", size / rows, "B"))
        start = time.perf_counter()
        store.compact()
        spent = time.perf_counter() - start
        note = f"in {spent:.1f} s"
        whole = store.path.stat().st_size
        table.append(Measure("compacted", whole / frames, "B/frame", note))
        store.close()
        table += bytes_of(store.path, frames, folder, BYTES)
        made = Made.of(recording(folder / "short.mcap", MINUTE))
        columns = made.into(StoreFile.create(folder / "columns.db")) / MINUTE
        seconds, count = by_rows(made.graphs[0], BASELINE_FRAMES, folder / "rows.db")
        rows = seconds / BASELINE_FRAMES
        table.append(Measure("graphs into the store, by columns", 1e6 * columns, "µs/frame"))
        note = f"{1e6 * seconds / count:.0f} µs a row"
        table.append(Measure("the same by executemany", 1e6 * rows, "µs/frame", note))
        table.append(Measure("ratio", rows / columns, "times"))
    return table
