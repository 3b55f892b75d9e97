"""A scene graph as networkx has it."""

from __future__ import annotations

import networkx as nx

from sgstore.model.graph import SceneGraph

GRAPH = SceneGraph(
    frame_id=64,
    trace="drive",
    seq=4,
    time_ns=400,
    ego=0,
    nodes={0: {"kind": "car", "is_ego": True}, 1: {"kind": "person"}, -1: {"kind": "off_road"}},
    edges=[
        (0, "near", 1, {}),
        (1, "near", 0, {}),
        (1, "toLeftOf", 0, {}),
        (1, "isIn", -1, {"overlap": 0.5}),
    ],
)


def test_networkx_has_every_node_edge_and_attribute() -> None:
    graph = GRAPH.to_networkx()

    assert dict(graph.nodes(data=True)) == GRAPH.nodes
    assert set(graph.edges(keys=True)) == {(s, d, relation) for s, relation, d, _ in GRAPH.edges}
    assert graph.edges[1, -1, "isIn"] == {"relation": "isIn", "overlap": 0.5}
    assert graph.graph == {"frame_id": 64, "trace": "drive", "seq": 4, "time_ns": 400, "ego": 0}


def test_two_relations_between_the_same_nodes_are_two_edges() -> None:
    graph = GRAPH.to_networkx()

    assert isinstance(graph, nx.MultiDiGraph)
    assert graph.number_of_edges(1, 0) == 2
