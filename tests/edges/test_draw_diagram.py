"""Diagrams: a graph as nodes and edges beside the view from above."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from drawing import Crossing, crowd, entity, graph_of, related
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from sgstore.draw import draw_frame
from sgstore.draw._diagram import NEIGHBOURS, excerpt_of, rows, scattered

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.graph import SceneGraph

SVG = "{http://www.w3.org/2000/svg}"
NONE: frozenset[int] = frozenset()


def gids(path: Path) -> set[str]:
    root = ET.fromstring(path.read_text(encoding="utf-8"))
    return {g.get("id", "") for g in root.iter(f"{SVG}g")}


def texts(path: Path) -> list[str]:
    root = ET.fromstring(path.read_text(encoding="utf-8"))
    return ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]


def town() -> tuple[SceneGraph, Crossing]:
    road_map = Crossing()
    return crowd(road_map), road_map


def small() -> SceneGraph:
    """The ego and a person in lanes of a road of a junction; a light controls the ego's lane."""
    nodes: dict[int, dict[str, Any]] = {
        0: entity("car", 0.0, 0.0, 90.0, is_ego=True),
        1: entity("person", 0.0, 9.0, 0.0),
        2: entity("traffic_light", 3.0, 20.0, 0.0, light_state="red"),
        3: entity("building", 5.0, 5.0, 0.0),
        4: entity("car", 60.0, 5.0, 0.0),
        -2: {"kind": "lane", "name": "1/0/-1", "x": 0.0, "y": 5.0},
        -3: {"kind": "lane", "name": "1/0/1", "x": -3.5, "y": 5.0},
        -4: {"kind": "lane", "name": "9/0/1", "x": 50.0, "y": 5.0},
        -5: {"kind": "road", "name": "1"},
        -6: {"kind": "junction", "name": "7"},
        -7: {"kind": "crosswalk", "name": "z"},
    }
    edges = [
        (0, "isIn", -2, {"is_primary": True}),
        (0, "isIn", -4, {"is_primary": False}),
        (1, "isIn", -3, {"is_primary": True}),
        (1, "isIn", -7, {}),
        (1, "near", 0, {}),
        (0, "near", 1, {}),
        (1, "inDFrontOf", 0, {}),
        (3, "near", 0, {}),
        (4, "inDFrontOf", 0, {}),
        (2, "controlsTrafficOf", -2, {}),
        (-2, "opposes", -3, {}),
        (-3, "opposes", -2, {}),
        (-2, "isIn", -5, {}),
        (-5, "isIn", -6, {}),
        (-4, "travelsTo", -2, {}),
    ]
    return graph_of(nodes, edges)


# What is shown ------------------------------------------------------------------------------------


def test_shown_are_the_ego_its_neighbours_their_lanes_and_what_those_belong_to() -> None:
    nodes, lines = excerpt_of(small(), NONE, "ego")

    assert nodes == {
        0: "entity",
        1: "entity",
        2: "entity",
        -2: "lane",
        -3: "lane",
        -7: "lane",
        -5: "road",
        -6: "junction",
    }
    lines = {(line.a, line.b): line for line in lines}
    assert lines[1, 0].text == "near, inDFrontOf"
    assert (0, 1) not in lines
    assert lines[2, -2].family == "light"
    assert lines[-2, -5].family == lines[-5, -6].family == "part"
    assert lines[0, -2].family == "isIn"
    opposes = lines.get((-3, -2)) or lines[-2, -3]
    assert (opposes.text, opposes.relations, opposes.back) == (
        "opposes",
        ("opposes",),
        ("opposes",),
    )


def test_what_is_matched_is_shown_whatever_it_is_and_in_both_directions() -> None:
    nodes, lines = excerpt_of(small(), frozenset({0, 1, 4, -4}), "ego")

    assert {4, -4} <= nodes.keys()
    matched = [line for line in lines if line.family == "matched"]
    assert {frozenset((line.a, line.b)) for line in matched} == {
        frozenset((0, 1)),
        frozenset((0, 4)),
    }


@pytest.mark.parametrize("relations", ["ego", "all", "none"])
def test_every_line_stands_for_edges_that_are_there(relations: Any) -> None:
    graph, _ = town()
    edges = {(a, r, b) for a, r, b, _ in graph.edges}

    nodes, lines = excerpt_of(graph, NONE, relations)

    told = [(k.a, r, k.b) for k in lines for r in k.relations]
    told += [(k.b, r, k.a) for k in lines for r in k.back]
    assert set(told) <= edges
    assert {end for a, _, b in told for end in (a, b)} <= nodes.keys()
    among = [1 for k in lines if k.family in {"ego", "entity"}]
    assert bool(among) == (relations != "none")


def test_all_relations_among_what_is_shown_are_there_if_all_are_asked_for() -> None:
    graph, _ = town()
    nodes, lines = excerpt_of(graph, NONE, "all")

    shown = {(a, r, b) for a, r, b, _ in graph.edges if {a, b} <= nodes.keys() and a != b}
    told = {(k.a, r, k.b) for k in lines for r in k.relations}
    told |= {(k.b, r, k.a) for k in lines for r in k.back}
    both_ways = {(b, r, a) for a, r, b in told}
    assert shown <= told | both_ways


def test_of_many_neighbours_the_nearest_are_shown() -> None:
    nodes = {0: entity("car", 0.0, 0.0, 90.0, is_ego=True)}
    nodes |= {i: entity("car", 0.0, 2.0 * i, 90.0) for i in range(1, 40)}

    nodes, _ = excerpt_of(graph_of(nodes, related(nodes)), NONE, "ego")

    assert list(nodes) == list(range(NEIGHBOURS))


# Where it lies ------------------------------------------------------------------------------------

numbers = st.floats(-300, 300, allow_nan=False)


@settings(deadline=None, max_examples=25)
@example([(0.0, 0.0)] * 8 + [(1.0, 0.0), (2.0, 0.0), (0.0, 0.0), (2.0, 0.0)])
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=14))
def test_nodes_do_not_overlap_and_stay_in_their_window(places: list[tuple[float, float]]) -> None:
    box, size = (10.0, 20.0, 510.0, 340.0), np.array((60.0, 14.0))
    spots = scattered(np.array(places), np.tile(size, (len(places), 1)), box)

    assert (spots - size / 2 >= np.array(box[:2]) - 1e-6).all()
    assert (spots + size / 2 <= np.array(box[2:]) + 1e-6).all()
    for a, b in itertools.combinations(spots, 2):
        assert (np.abs(a - b) >= size).any()


def test_nodes_lie_as_the_ego_sees_them() -> None:
    places = np.array([(0, 0), (0, 30), (0, -30), (20, 0), (-20, 0), (15, 25)], float)

    spots = scattered(places, np.tile((50.0, 14.0), (6, 1)), (0.0, 0.0, 500.0, 400.0))

    ego, ahead, behind, right, left, aside = spots
    assert ego == pytest.approx((250, 200))
    assert ahead[1] > ego[1] > behind[1]
    assert right[0] > ego[0] > left[0]
    assert aside[0] > ego[0] + 20
    assert aside[1] > ego[1] + 20


def test_what_has_no_place_is_put_at_the_border_and_at_one_place_they_fan_out() -> None:
    places = np.array([(0, 0), (np.nan, np.nan), (5, 5), (5, 5), (5, 5)], float)

    spots = scattered(places, np.tile((50.0, 14.0), (5, 1)), (0.0, 0.0, 500.0, 400.0))

    assert np.isfinite(spots).all()
    assert spots[1, 1] > 300
    assert len(np.unique(spots.round(), axis=0)) == 5


def test_rows_are_dealt_out_from_left_to_right() -> None:
    order = np.array([3.0, 1.0, 2.0, 0.0])

    spots, count = rows(order, np.full(4, 60.0), (0.0, 0.0, 400.0, 100.0))
    assert count == 1
    assert np.argsort(spots[:, 0]).tolist() == [3, 1, 2, 0]

    spots, count = rows(np.arange(10.0), np.full(10, 60.0), (0.0, 0.0, 400.0, 100.0))
    assert count == 2
    assert len(set(spots[:, 1].tolist())) == 2


# The picture --------------------------------------------------------------------------------------


def test_the_diagram_stands_beside_the_view_with_every_node_and_edge_that_is_shown(
    tmp_path: Path,
) -> None:
    graph, road_map = town()
    nodes, lines = excerpt_of(graph, NONE, "ego")

    draw_frame(graph, road_map, tmp_path / "a.svg", diagram=True)

    drawn = gids(tmp_path / "a.svg")
    assert {f"vertex-{node}" for node in nodes} <= drawn
    assert {f"edge-{line.a}-{line.b}" for line in lines} <= drawn
    assert f"node-{graph.ego}" in drawn
    told = " ".join(texts(tmp_path / "a.svg"))
    assert f"shown: {len(nodes)} of {len(graph.nodes)} nodes" in told
    assert (
        f"{sum(len(line.relations + line.back) for line in lines)} of {len(graph.edges)} edges"
        in told
    )


def test_lines_whose_words_find_no_room_are_counted(tmp_path: Path) -> None:
    graph, road_map = town()
    _, lines = excerpt_of(graph, NONE, "all")

    draw_frame(graph, road_map, tmp_path / "a.svg", diagram=True, relations="all")

    told = " ".join(texts(tmp_path / "a.svg"))
    written = {gid for gid in gids(tmp_path / "a.svg") if gid.startswith("words-")}
    worded = [line for line in lines if line.text and line.family != "entity"]
    left_out = len(worded) - len(written)
    assert (f"({left_out} without words)" in told) is (left_out > 0)
    assert "without words" in told or left_out == 0


def test_a_matched_node_bears_its_variable_and_a_light_its_state(tmp_path: Path) -> None:
    draw_frame(small(), None, tmp_path / "a.svg", diagram=True, highlight={"p": 1, "l": 2})

    told = texts(tmp_path / "a.svg")
    assert "p = person 1" in told
    assert "l = traffic_light 2: red" in told


def test_the_same_graph_gives_the_same_bytes(tmp_path: Path) -> None:
    graph, road_map = town()
    for name in ("a.png", "b.png"):
        draw_frame(graph, road_map, tmp_path / name, diagram=True)

    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width > 1.5 * picture.height


@pytest.mark.parametrize(
    "graph",
    [
        pytest.param(graph_of({}, []), id="empty"),
        pytest.param(graph_of({0: entity("car", 0, 0, 0, is_ego=True)}, []), id="only the ego"),
        pytest.param(graph_of({3: entity("car", 0, 0, 0)}, []), id="no ego"),
        pytest.param(graph_of({0: {"kind": "car", "is_ego": True}}, []), id="an ego nowhere"),
        pytest.param(
            graph_of({0: entity("car", 0, 0, 0, is_ego=True), 1: {"kind": "person"}},
                     [(1, "near", 0, {})]),
            id="a neighbour nowhere",
        ),
    ],
)  # fmt: skip
@pytest.mark.parametrize("relations", ["ego", "all", "none"])
def test_graphs_of_next_to_nothing_are_drawn_too(
    tmp_path: Path, graph: SceneGraph, relations: Any
) -> None:
    draw_frame(graph, None, tmp_path / "a.svg", diagram=True, relations=relations)

    nodes = {f"vertex-{node}" for node, a in graph.nodes.items() if a}
    assert nodes <= gids(tmp_path / "a.svg")
