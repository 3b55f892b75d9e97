"""Patterns built step by step or drawn as graphs mean what their texts mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest

from sgstore.errors import QueryError
from sgstore.lang.syntax import Pattern

if TYPE_CHECKING:
    from sgstore.query import Store

TEXT = """
MATCH (e:Ego)-[:isIn]->(lane:Lane {lane_type: 'driving'})<-[:isIn]-(p:Person)
WHERE abs(bearing(e, p)) < 45
"""


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


def test_built_pattern_equals_its_text(store: Store) -> None:
    pattern = (
        Pattern()
        .node("e", "Ego")
        .node("lane", "Lane", lane_type="driving")
        .node("p", "Person")
        .edge("e", "isIn", "lane")
        .edge("p", "isIn", "lane")
        .where("abs(bearing(e, p)) < $most", most=45)
    )
    rows = sorted(store.find(pattern.returns("frame.seq, p.id")))

    assert rows == sorted(store.find(f"{TEXT} RETURN frame.seq, p.id"))
    assert len(rows) > 10


def test_networkx_pattern_equals_its_text(store: Store) -> None:
    graph = nx.DiGraph()
    graph.add_node("e", label="Ego")
    graph.add_node("lane", kind="lane", lane_type="driving")
    graph.add_node("p", label="Person", where="abs(bearing(e, p)) < 45")
    graph.add_edge("e", "lane", relation="isIn")
    graph.add_edge("p", "lane", relation="isIn")

    assert store.find(graph).count() == store.find(TEXT).count() > 10


def test_undirected_graph_gives_undirected_edges(store: Store) -> None:
    graph = nx.MultiGraph()
    graph.add_nodes_from([(1, {"label": "Ego"}), (2, {"label": "Bus"})])
    graph.add_edge(2, 1, relation=["inDFrontOf", "atDRearOf"])

    text = "MATCH (a:Ego), (b:Bus), (a)-[:inDFrontOf|atDRearOf]-(b)"
    assert store.find(graph).count() == store.find(text).count() > 0


def test_example_frame_pattern_matches_its_frame(store: Store) -> None:
    graph = store.graph("town@20s")
    near = [n for n, d in graph.nodes(data=True) if d["kind"] == "bus" or d["is_ego"]]
    drawn = nx.MultiDiGraph()
    drawn.add_nodes_from((n, {"kind": graph.nodes[n]["kind"]}) for n in near)
    drawn.add_edges_from(
        (a, b, {"relation": r}) for a, b, r in graph.subgraph(near).edges(keys=True)
    )

    assert 200 in {frame.seq for frame in store.find(drawn).frames()}


@pytest.mark.parametrize(
    "build",
    [
        lambda: Pattern().node("e) MATCH (x"),
        lambda: Pattern().node("e", "Ego) RETURN (x"),
        lambda: Pattern().node("e", **{"x: 1}) //": 2}),
        lambda: Pattern().edge("a", "near]->(b)-[:near", "b"),
        lambda: Pattern().node("a").edge("a", "near", "b", times="1..3]"),
        lambda: str(Pattern()),
    ],
)
def test_invalid_pattern_parts_are_refused(build: Any) -> None:
    with pytest.raises(QueryError):
        build()


def test_pattern_values_are_bound_parameters() -> None:
    pattern = Pattern().node("v", "Vehicle", special="x'; DROP TABLE inside.trace --")

    assert str(pattern) == "MATCH (v:Vehicle {special: $v_special})"
    assert pattern.parameters == {"v_special": "x'; DROP TABLE inside.trace --"}
