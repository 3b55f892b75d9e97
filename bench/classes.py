"""Classes of frames: how fast, beside networkx, and what part of ingest they take.

::

    python -m bench classes [--quick]

The recording is that of the bench of ingest: 40 cars around an ego, all within 50 m. networkx gets the same
graphs, and the time to make them is not counted; its hash of Weisfeiler and Lehman tells fewer graphs apart,
and VF2 only says whether two graphs are the same.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
from networkx.algorithms.isomorphism import DiGraphMatcher

from bench.ingest import CARS, MINUTE, recording
from bench.measure import Measure
from sgstore.graphs.abstractions import (
    AT_INGEST,
    Classes,
    GraphColumns,
    Labelled,
    MapColumns,
    abstraction_named,
)
from sgstore.ingest import BLOCK_FRAMES
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.model.graph import GraphBlock

THEIRS = 12
"""Graphs that networkx gets."""


def run(quick: bool) -> Iterator[Measure]:
    """Measure everything."""
    frames = MINUTE // 4 if quick else MINUTE
    with tempfile.TemporaryDirectory() as folder:
        path = recording(Path(folder) / "drive.mcap", frames)
        blocks, kinds, grounds, generating = _graphs(path)
    yield Measure(
        "the scene graph generator alone", frames / generating, "frames/s", f"{CARS} cars"
    )
    start = time.perf_counter()
    seen = [GraphColumns.of(graph, kinds, grounds) for graph in blocks]
    seeing = time.perf_counter() - start
    total = seeing
    for name in AT_INGEST:
        known, function = Classes(), abstraction_named(name).function
        start = time.perf_counter()
        labelled = [function(one) for one in seen]
        made = time.perf_counter()
        classes = [of for one in labelled for of in known.of(one)]
        end = time.perf_counter()
        total += end - start
        graphs = [_networkx(labelled[0], frame) for frame in range(THEIRS)]
        wl, vf2 = _theirs(graphs)
        ours = (end - made) / frames
        note = f"{len(set(classes))} classes; making it {frames / (made - start):,.0f} frames/s"
        yield Measure(f"classes in {name}", 1 / ours, "frames/s", note)
        yield Measure("    networkx, hash of Weisfeiler and Lehman", wl / ours, "times ours")
        yield Measure("    networkx, VF2 on a graph and itself shuffled", vf2 / ours, "times ours")
    yield Measure("all five, with their abstractions", frames / total, "frames/s")
    share = total / (total + generating)
    yield Measure("    of the time of generator and classes", share * 100, "%")


def _graphs(path: Path) -> tuple[list[GraphBlock], NDArray[np.int8], MapColumns | None, float]:
    with open_trace(path) as trace:
        text = trace.info.map_text
        road_map = read_map(text, trace.info.map_name) if text else None
        generator = SceneGraphGenerator(road_map, Config())
        read = list(trace.blocks(BLOCK_FRAMES))
    start = time.perf_counter()
    blocks = [generator.block(frames) for frames in read]
    seconds = time.perf_counter() - start
    kinds = np.concatenate([graph.frames.entities.kind for graph in blocks])
    return blocks, kinds, MapColumns.of(road_map) if road_map else None, seconds


def _networkx(graphs: Labelled, frame: int) -> nx.DiGraph[str]:
    """A frame's graph with the labels of parallel edges joined: what networkx can hash."""
    nodes, edges = graphs.named(frame)
    graph: nx.DiGraph[str] = nx.DiGraph()
    for node, label in nodes.items():
        graph.add_node(node, label=label)
    labels: dict[tuple[str, str], list[str]] = {}
    for src, label, dst in edges:
        labels.setdefault((src, dst), []).append(label)
    for ends, of in labels.items():
        graph.add_edge(*ends, label=",".join(sorted(of)))
    return graph


def _theirs(graphs: list[nx.DiGraph[str]]) -> tuple[float, float]:
    """Seconds for a graph: hashing it, and finding that it is isomorphic to itself with other names."""
    start = time.perf_counter()
    for graph in graphs:
        nx.weisfeiler_lehman_graph_hash(graph, node_attr="label", edge_attr="label", iterations=3)
    middle = time.perf_counter()
    for graph in graphs[:2]:
        names = list(graph.nodes)
        other = nx.relabel_nodes(graph, dict(zip(names, reversed(names), strict=True)))
        DiGraphMatcher(graph, other, _alike, _alike).is_isomorphic()
    return (middle - start) / len(graphs), (time.perf_counter() - middle) / 2


def _alike(one: dict[str, str], other: dict[str, str]) -> bool:
    return one["label"] == other["label"]
