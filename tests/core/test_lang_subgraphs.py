"""Matches as small graphs: from SQL, in memory, and against exhaustive search."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest
from matching import Matcher
from oracle import assignments
from oracle_patterns import Writer
from oracle_worlds import World, random_world
from test_lang_match import view_of
from thorough import LONG
from typer.testing import CliRunner

from sgstore.apps.cli import app
from sgstore.errors import QueryError
from sgstore.lang.sql import compile_query
from sgstore.lang.syntax import parse

if TYPE_CHECKING:
    from sgstore.query import Store

pytestmark = pytest.mark.seconds(10)

Shape = tuple[Any, ...]


def shape(frame: int, nodes: list[dict[str, Any]], edges: list[dict[str, Any]]) -> Shape:
    """A graph without attributes."""
    return (
        frame,
        tuple(sorted((node["id"], *node["variables"]) for node in nodes)),
        tuple(sorted((e["source"], e["relation"], e["target"]) for e in edges)),
    )


def by_sql(text: str, world: World) -> Counter[Shape]:
    compiled = compile_query(f"{text} RETURN SUBGRAPHS", world.catalog)
    layout, statement = compiled.layout, compiled.rows()
    assert layout is not None
    rows = world.connection.execute(statement.sql, list(statement.values)).fetchall()
    return Counter(shape(row[0], *layout.row(row)[-2:]) for row in rows)


def in_memory(text: str, world: World) -> Counter[Shape]:
    compiled = compile_query(text, world.catalog)
    matcher = Matcher(compiled.bound)
    return Counter(
        shape(frame.frame_id, *graph)
        for frame in world.frames
        if frame.trace.name not in compiled.left_out
        and compiled.query.ego in {None, frame.trace.hero}
        for graph in matcher.graphs(view_of(frame))
    )


@pytest.mark.parametrize("first", [0, 40] if LONG else [0])
def test_random_subgraphs_in_sql_equal_memory(first: int) -> None:
    tried = matched = 0
    for number in range(first, first + 40):
        if number % 20 == 0:
            world = random_world(number, static=number % 40 == 0)
        text = Writer(number).query()
        try:
            ours = in_memory(text, world)
        except QueryError:
            continue
        assert by_sql(text, world) == ours, f"pattern {number}: {text}"
        tried += 1
        matched += bool(ours)

    assert tried > 30
    assert matched > 8


def test_subgraph_nodes_equal_exhaustive_search() -> None:
    world, compared = random_world(77), 0
    for number in range(60):
        text = Writer(number).query()
        try:
            graphs = by_sql(text, world)
        except QueryError:
            continue
        match = parse(text)[-1]
        wanted = {
            (search.frame.frame_id, frozenset(v for v in binding.values() if isinstance(v, int)))
            for search, binding in assignments(match, world)
        }
        if "*" in text:  # a path of exactly n edges shows the nodes on its way too
            continue
        found = {(frame, frozenset(node[0] for node in nodes)) for frame, nodes, _ in graphs}
        assert found == wanted, f"pattern {number}: {text}"
        compared += len(wanted)

    assert compared > 200


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


LEADS = "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[r:isIn]-(v:Vehicle) WHERE EXISTS {(v)-[:leads]->(e)}"


def test_subgraph_attributes_equal_scene_graph(store: Store) -> None:
    graphs = list(store.find(f"{LEADS} LIMIT 3").subgraphs())

    assert len(graphs) == 3
    for graph in graphs:
        whole = store.graph(graph.graph["frame_id"])
        assert {tuple(data["variables"]) for _, data in graph.nodes(data=True)} == {
            ("e",),
            ("l",),
            ("v",),
        }
        for node, data in graph.nodes(data=True):
            for name in ("kind", "x", "speed", "length", "lane_type", "name"):
                assert data.get(name) == pytest.approx(whole.nodes[node].get(name)), name
        assert graph.number_of_edges() == 2
        for src, dst, key, data in graph.edges(keys=True, data=True):
            theirs = whole.edges[src, dst, key]
            assert data["overlap"] == pytest.approx(theirs["overlap"])


def test_path_of_fixed_length_is_shown_edge_by_edge(store: Store) -> None:
    query = "MATCH (e:Ego)-[:isIn*3]->(j:Junction) RETURN SUBGRAPHS LIMIT 4"

    for graph in store.find(query).subgraphs():
        (ego,) = [n for n, data in graph.nodes(data=True) if data.get("is_ego")]
        (junction,) = [n for n, data in graph.nodes(data=True) if data["kind"] == "junction"]
        assert len(nx.shortest_path(graph, ego, junction)) == 4
        assert set(graph.edges(keys=True)) <= set(
            store.graph(graph.graph["frame_id"]).edges(keys=True)
        )


def test_values_are_returned_beside_subgraphs(store: Store) -> None:
    found = store.find(
        "MATCH (e:Ego)-[:near|very_near]->(v:Vehicle)"
        " RETURN dist(e, v) AS d, SUBGRAPHS ORDER BY v.speed DESC LIMIT 20"
    )
    graphs = list(found.subgraphs())
    speeds = [
        max(d["speed"] for _, d in g.nodes(data=True) if d["variables"] == ["v"]) for g in graphs
    ]

    assert found.columns == ("frame_id", "trace", "seq", "time_ns", "t", "d", "nodes", "edges")
    assert speeds == sorted(speeds, reverse=True)
    assert len(graphs) == 20
    assert all(7 < graph.graph["d"] <= 16 for graph in graphs)


def test_frames_and_clips_of_subgraphs_equal_the_pattern(store: Store) -> None:
    plain, graphs = store.find(LEADS), store.find(f"{LEADS} RETURN SUBGRAPHS")

    assert graphs.count() == plain.count() > 10
    assert list(graphs.frames()) == list(plain.frames())
    assert list(graphs.clips(1, 2)) == list(plain.clips(1, 2))
    assert [i.frames for i in graphs.intervals()] == [i.frames for i in plain.intervals()]


@pytest.mark.parametrize("safe", [[], ["--safe", "--timeout", "20s"]])
def test_cli_output_is_readable_by_networkx(safe: list[str], store: Store) -> None:
    arguments = ["find", str(store.file.path), f"{LEADS} RETURN SUBGRAPHS LIMIT 2", *safe]

    rows = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    people = CliRunner().invoke(app, arguments).stdout

    expected = list(store.find(f"{LEADS} LIMIT 2").subgraphs())
    for row, graph in zip(rows, expected, strict=True):
        read = nx.node_link_graph(row, edges="edges")
        assert read.is_directed()
        assert set(read.edges(keys=True)) == set(graph.edges(keys=True))
        assert dict(read.nodes(data="x")) == dict(graph.nodes(data="x"))
    assert "e = car 0" in people
    assert "-isIn->" in people


def test_subgraphs_convert_to_arrow(store: Store) -> None:
    arrow = pytest.importorskip("pyarrow")

    table = store.find(f"{LEADS} RETURN SUBGRAPHS LIMIT 5").arrow()

    assert table.num_rows == 5
    assert arrow.types.is_list(table.schema.field("nodes").type)
    assert table.column("nodes")[0].as_py()[0]["kind"] == "car"
