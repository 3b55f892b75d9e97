"""Patterns on a real recording, against networkx over the graph of every frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
import pytest

import sgstore
from sgstore.ingest import ingest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.query import Store

VEHICLES = {"car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer", "train", "vehicle"}
Graph = nx.MultiDiGraph

pytestmark = [pytest.mark.data, pytest.mark.seconds(6)]


@pytest.fixture(scope="module")
def store(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    path = tmp_path_factory.mktemp("swarm") / "swarm.sgstore"
    (outcome,) = ingest(path, [data / "traces" / "esmini" / "swarm_Town04.mcap"])
    assert outcome.frames == 602
    store = sgstore.open(path)
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def graphs(store: Store) -> list[Graph]:
    frames = np.array([frame.frame_id for frame in store.find("MATCH (n)").frames()])
    return [graph.to_networkx() for graph in store.file.graphs(frames)]


def subgraphs(pattern: nx.DiGraph, graph: Graph) -> bool:
    """Whether a pattern with labels on nodes and one relation on each edge is a subgraph of a graph."""
    wanted = {relation for _, _, relation in pattern.edges.data("relation")}
    simple = nx.DiGraph()
    simple.add_nodes_from(graph.nodes.data())
    for src, dst, relation in graph.edges(keys=True):
        if relation in wanted:
            simple.add_edge(src, dst, relations={relation} | relations(simple, src, dst))
    matcher = nx.algorithms.isomorphism.DiGraphMatcher(
        simple,
        pattern,
        node_match=lambda node, label: label["label"](node),
        edge_match=lambda edge, wanted: wanted["relation"] in edge["relations"],
    )
    return any(True for _ in matcher.subgraph_monomorphisms_iter())


def relations(graph: nx.DiGraph, src: int, dst: int) -> set[str]:
    return graph.edges[src, dst]["relations"] if graph.has_edge(src, dst) else set()


def pattern_of(
    labels: dict[str, Callable[[dict], bool]], edges: list[tuple[str, str, str]]
) -> nx.DiGraph:
    pattern = nx.DiGraph()
    for name, label in labels.items():
        pattern.add_node(name, label=label)
    for src, relation, dst in edges:
        pattern.add_edge(src, dst, relation=relation)
    return pattern


def ego(node: dict) -> bool:
    return node["is_ego"]


def vehicle(node: dict) -> bool:
    return node["kind"] in VEHICLES


def lane(node: dict) -> bool:
    return node["kind"] == "lane"


def test_frames_with_a_vehicle_in_the_lane_of_the_ego(store: Store, graphs: list[Graph]) -> None:
    text = "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v:Vehicle)"
    pattern = pattern_of(
        {"e": ego, "l": lane, "v": vehicle}, [("e", "isIn", "l"), ("v", "isIn", "l")]
    )

    frames = sum(subgraphs(pattern, graph) for graph in graphs)

    assert len(graphs) == 602
    assert store.find(text).count() == frames
    assert frames > 50


def test_frames_with_three_vehicles_in_a_row(store: Store, graphs: list[Graph]) -> None:
    text = "MATCH (a:Vehicle)-[:near]->(b:Vehicle)-[:inDFrontOf]->(c:Vehicle)"
    pattern = pattern_of(
        {"a": vehicle, "b": vehicle, "c": vehicle}, [("a", "near", "b"), ("b", "inDFrontOf", "c")]
    )

    frames = sum(subgraphs(pattern, graph) for graph in graphs)

    assert store.find(text).count() == frames
    assert 50 < frames < 602


def test_frames_with_an_oncoming_lane_and_nobody_near(store: Store, graphs: list[Graph]) -> None:
    text = """
        MATCH (v:Vehicle)-[:isIn]->(l:Lane)-[:opposes]->(m:Lane)
        WHERE v.speed > 10 AND NOT EXISTS {(v)-[:near|very_near|super_near|near_coll]-(:Vehicle)}
    """
    close = {"near", "very_near", "super_near", "near_coll"}

    frames = 0
    for graph in graphs:
        lanes = {a for a, b, r in graph.edges(keys=True) if r == "opposes" and lane(graph.nodes[a])}
        crowded = {
            node
            for a, b, r in graph.edges(keys=True)
            if r in close and vehicle(graph.nodes[a]) and vehicle(graph.nodes[b])
            for node in (a, b)
        }
        frames += any(
            r == "isIn"
            and b in lanes
            and vehicle(graph.nodes[a])
            and a not in crowded
            and graph.nodes[a].get("speed", 0) > 10
            for a, b, r in graph.edges(keys=True)
        )

    assert store.find(text).count() == frames
    assert 20 < frames < 602


def test_every_frame_has_the_edges_that_patterns_find(store: Store, graphs: list[Graph]) -> None:
    found = {row[0]: row[1] for row in store.find("MATCH (a)-[d]->(b) RETURN frame.id, COUNT(*)")}

    assert found == {
        g.graph["frame_id"]: g.number_of_edges() for g in graphs if g.number_of_edges()
    }


def test_two_rows_of_the_view_edges_are_the_pattern(store: Store) -> None:
    sql = """
        SELECT count(DISTINCT a.frame_id) FROM edges a JOIN edges b USING (frame_id, dst)
        WHERE a.relation = 'isIn' AND a.src_is_ego AND a.dst_kind = 'lane'
          AND b.relation = 'isIn' AND b.src_kind IN ('car', 'truck', 'van', 'bus') AND b.src <> a.src
    """

    pattern = store.find("MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v:Car|Truck|Van|Bus)")

    assert store.sql(sql).values == [(pattern.count(),)]
