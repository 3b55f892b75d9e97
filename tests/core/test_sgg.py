"""The generator: what is in range, what of the map is present, what it remembers and what it can answer."""

from __future__ import annotations

import gc
import math
import tracemalloc
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from builders import PaperMap, Patch, Recording, Thing, edges, frames, graph_of, present, thing

from sgstore.model.config import Config, Direction, PairSettings, Proximity, RangeSettings
from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY
from sgstore.model.world import SMOOTHED, STANDS
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from sgstore.model.graph import GraphBlock

PI = math.pi
STREET = PaperMap(
    Patch("east", -200, -4, 40, 0, road="main"),
    Patch("east on", 40, -4, 200, 0, road="main 2", junction="j", controlled_by="s1"),
    Patch("far", 70, 0, 200, 4, road="far road"),
    Patch("zebra", 52, -4, 56, 4, kind="crosswalk"),
    objects=(("s1", "traffic_light"), ("s2", "stop_sign"), ("o1", "pole")),
)


def nodes(graph: GraphBlock, frame: int = 0) -> list[str]:
    """Names of the entities whose states are in a frame."""
    of = graph.frames
    rows = slice(of.offsets[frame], of.offsets[frame + 1])
    return [of.entities.ident[node] for node in of.states.node[rows]]


# Range ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "inside"),
    [
        pytest.param(thing("c", 50, 0), True, id="centre on the edge"),
        pytest.param(thing("c", -52, 0), True, id="rear bumper on the edge"),
        pytest.param(thing("c", 52.001, 0), False, id="just out"),
        pytest.param(thing("c", 51.5, 0, PI / 2), False, id="crossing: the side counts"),
        pytest.param(thing("c", 51, 0, PI / 2), True, id="crossing, side on the edge"),
        pytest.param(thing("c", 37, 36), True, id="a corner of its box comes in"),
        pytest.param(thing("c", 49, 0, length=math.nan), True, id="no size: a point, inside"),
        pytest.param(thing("c", 51, 0, length=math.nan), False, id="no size: a point, outside"),
        pytest.param(thing("c", 51, 0, math.nan), False, id="no heading: a point"),
        pytest.param(thing("c", 3, math.nan), False, id="no position"),
        pytest.param(thing("c", 3, 0, z=90.0), True, id="any height"),
        pytest.param(thing("c", 3, 0, z=math.nan), True, id="no height"),
    ],
)
@pytest.mark.parametrize("static", [False, True])
def test_what_is_in_range_is_told_by_its_footprint(what: Thing, inside: bool, static: bool) -> None:
    graph = graph_of(frames([thing("ego"), replace(what, static=static)]))

    assert ("c" in nodes(graph) or 1 in present(graph)) == inside


def test_the_range_follows_the_ego_and_the_config() -> None:
    frame = [thing("ego", 100), thing("c", 120)]

    assert nodes(graph_of(frames(frame), None, Config(range=RangeSettings(10)))) == ["ego"]
    assert nodes(graph_of(frames(frame), None, Config(range=RangeSettings(18)))) == ["ego", "c"]


def test_what_is_out_of_range_has_no_state_and_no_relation() -> None:
    block = frames(
        [thing("far", 90), thing("ego"), thing("near", 9)],
        [thing("ego")],
        [thing("far", 50), thing("ego")],
    )

    graph = graph_of(block)

    assert [nodes(graph, i) for i in range(3)] == [["ego", "near"], ["ego"], ["far", "ego"]]
    assert graph.frames.offsets.tolist() == [0, 2, 3, 5]
    assert edges(graph, 1) == []


def test_without_an_ego_everything_is_in_the_graph_and_nothing_is_related_to_an_ego() -> None:
    frame = [thing("a"), thing("b", 3), thing("c", 900), thing("house", 50, kind="building")]

    graph = graph_of(frames([*frame[:3], replace(frame[3], static=True)]), STREET)

    assert nodes(graph) == ["a", "b", "c"]
    assert graph.frames.ego.tolist() == [-1]
    assert present(graph) == {3, *range(-len(STREET.nodes), 0)}  # c is off the road
    assert {(s, d) for s, r, d in edges(graph, 0, STREET) if r in PROXIMITY} == {
        ("a", "b"),
        ("b", "a"),
    }


def test_without_an_ego_nothing_is_off_the_road_that_is_on_it_or_nowhere() -> None:
    graph = graph_of(frames([thing("a", y=-2), thing("nowhere", math.nan)]), STREET)

    assert "off_road" not in names_present(graph)
    assert [e for e in edges(graph, 0, STREET) if e[1] == "isIn"] == [("a", "isIn", "east")]


def test_an_ego_without_position_gives_no_range_but_stays_the_ego() -> None:
    graph = graph_of(frames([thing("ego", math.nan), thing("a"), thing("b", 300)]))

    assert nodes(graph) == ["ego", "a", "b"]
    assert graph.frames.ego.tolist() == [0]
    assert edges(graph) == []


def test_an_ego_that_is_named_but_not_there_is_none() -> None:
    block = frames([thing("ego"), thing("a")])
    absent = replace(block, states=block.states.take(np.array([1])), offsets=np.array([0, 1]))

    graph = graph_of(absent)

    assert graph.frames.ego.tolist() == [-1]
    assert nodes(graph) == ["a"]


# Parts of the map -------------------------------------------------------------------------------


def names_present(graph: GraphBlock, frame: int = 0) -> set[str]:
    return {STREET.nodes.name[-1 - node] for node in present(graph, frame) if node < 0}


def test_the_map_is_present_as_far_as_the_range_reaches() -> None:
    graph = graph_of(frames([thing("ego", y=-2)], [thing("ego", 21, y=-2)]), STREET)

    objects = {"s1", "s2", "o1"}
    assert names_present(graph, 0) == {"east", "main", "east on", "main 2", "j"} | objects
    assert names_present(graph, 1) - names_present(graph, 0) == {"zebra", "far", "far road"}


def test_what_an_entity_is_in_is_present_even_out_of_range() -> None:
    truck = thing("truck", 51, 0, length=10, width=3)
    graph = graph_of(frames([thing("ego", y=-2), truck]), STREET, Config(range=RangeSettings(46.5)))

    assert ("truck", "isIn", "zebra") in edges(graph, 0, STREET)
    assert "zebra" in names_present(graph)


@pytest.mark.parametrize("seed", range(5))
def test_every_end_of_every_edge_is_in_its_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scenes = [
        [
            thing("ego", *rng.uniform(-60, 60, 2)),
            *(thing(f"c{i}", *rng.uniform(-90, 90, 2), rng.uniform(-4, 4)) for i in range(9)),
            thing("light", 45, 5, kind="traffic_light", map_ref="s1"),
            thing("wall", 30, 0, kind="barrier", length=90, static=True),
        ]
        for _ in range(4)
    ]

    graph = graph_of(frames(*scenes), STREET)

    for frame in range(4):
        of = graph.frames
        there = set(of.states.node[of.offsets[frame] : of.offsets[frame + 1]].tolist())
        there |= present(graph, frame)
        rows = graph.edges.frame == frame
        assert set(graph.edges.src[rows].tolist()) <= there
        assert set(graph.edges.dst[rows].tolist()) <= there


def test_a_lane_brings_its_road_and_its_junction() -> None:
    narrow = Config(range=RangeSettings(38))
    truck = thing("truck", 37, -2, length=10)

    alone = graph_of(frames([thing("ego", y=-2)]), STREET, narrow)
    graph = graph_of(frames([thing("ego", y=-2), truck]), STREET, narrow)

    assert names_present(graph) - names_present(alone) == {"east on", "main 2", "j"}


def test_off_road_is_present_where_something_is_off_the_road() -> None:
    graph = graph_of(frames([thing("ego", y=-2)], [thing("ego", y=9)]), STREET)

    assert "off_road" not in names_present(graph, 0)
    assert "off_road" in names_present(graph, 1)


def test_a_light_of_the_trace_takes_the_place_of_that_of_the_map() -> None:
    light = thing("light", 30, 5, kind="traffic_light", map_ref="s1")
    post = thing("post", 30, 5, kind="pole", map_ref="o1", static=True)

    scenes = [thing("ego")], [thing("ego"), light, post], [thing("ego"), post]
    graph = graph_of(frames(*scenes), STREET)

    shown = [{"s1", "s2", "o1"} & names_present(graph, frame) for frame in range(3)]
    assert shown == [{"s1", "s2"}, {"s2"}, {"s2"}]  # also after its last state
    assert ("light", "controlsTrafficOf", "east on") in edges(graph, 1, STREET)


def test_a_light_of_the_trace_that_is_out_of_range_is_not_that_of_the_map() -> None:
    """The signal of the map is in range; the light of the trace is out of range in the first frame."""
    narrow = Config(range=RangeSettings(46.5))
    light = thing("light", 50, 5, kind="traffic_light", map_ref="s1")
    graph = graph_of(frames([thing("ego"), light], [thing("ego", 10), light]), STREET, narrow)
    alone = graph_of(frames([thing("ego")], [thing("ego", 10)]), STREET, narrow)

    named = [names_present(of, frame) & {"s1"} for of in (graph, alone) for frame in (0, 1)]
    assert named == [set(), set(), {"s1"}, {"s1"}]
    assert [nodes(graph, frame) for frame in (0, 1)] == [["ego"], ["ego", "light"]]


def test_of_an_object_that_is_repeated_the_one_at_its_place_is_replaced() -> None:
    town = PaperMap(objects=(("rail#0", "pole"), ("rail#1", "pole"), ("rail#2", "pole")))
    town.nodes.x[:] = [0, 10, 20, 30]
    post = thing("post", 20.5, kind="pole", map_ref="rail", static=True)
    elsewhere = thing("elsewhere", 15, kind="unknown", map_ref="rail", static=True)

    graph = graph_of(frames([thing("ego"), post, elsewhere]), town)

    assert {node for node in present(graph) if node < -1} == {
        town.ids["rail#0"],
        town.ids["rail#2"],
    }


def test_lane_states_are_the_attributes_of_the_edges_to_lanes() -> None:
    graph = graph_of(frames([thing("ego", 40, -1.5)], [thing("ego", 30, -2, 0.1)]), STREET)

    of = graph.lanes
    rows = list(zip(of.frame, of.node, (STREET.nodes.name[-1 - n] for n in of.lane), strict=True))
    assert rows == [(0, 0, "east"), (0, 0, "east on"), (1, 0, "east")]
    assert of.overlap.tolist() == pytest.approx([0.5, 0.5, 1])
    assert of.offset.tolist() == pytest.approx([0.5, 0.5, 0])
    assert of.heading_error.tolist() == pytest.approx([0, 0, 0.1])
    assert of.primary.tolist() == [True, False, True]


# What it remembers ------------------------------------------------------------------------------


def test_scenery_stays_for_the_rest_of_the_trace() -> None:
    recording, generator = Recording(), SceneGraphGenerator(STREET, Config())
    wall = thing("wall", 20, kind="barrier", static=True)

    first = generator.block(recording.block([thing("ego"), wall]))
    second = generator.block(recording.block([thing("ego", 5)], [thing("ego", -100)]))

    assert 1 in present(first)
    assert 1 in present(second, 0)
    assert 1 not in present(second, 1)
    assert ("wall", "near", "ego") in edges(second, 0, STREET, recording.names)


def test_a_footprint_that_stays_is_not_looked_up_again() -> None:
    recording, town = Recording(), PaperMap(*STREET.patches)
    generator = SceneGraphGenerator(town, Config())
    parked = [thing(f"p{i}", 4 * i, -2, static=bool(i % 2)) for i in range(8)]

    for step in range(5):
        graph = generator.block(
            recording.block(*([thing("ego", step + i / 10, -2), *parked] for i in range(4)))
        )

    assert town.asked == 5 * 4 + 8
    of = edges(graph, 3, town, recording.names)
    assert [src for src, _, dst in of if dst == "east"] == ["ego", *(f"p{i}" for i in range(8))]


def test_what_has_left_is_forgotten() -> None:
    recording, town = Recording(), PaperMap(*STREET.patches)
    generator = SceneGraphGenerator(town, Config())
    ego, parked = thing("ego", y=-2), thing("p", 9, -2)

    for frame in ([ego, parked], [ego], [ego, parked]):
        generator.block(recording.block(frame))

    assert town.asked == 3


def test_a_footprint_that_moves_away_and_comes_back_is_looked_up_again() -> None:
    places = [-2, -2, 5, 5, -2, -2]
    recording, generator = Recording(), SceneGraphGenerator(STREET, Config())

    of = [
        edges(generator.block(recording.block([thing("ego", 0, y)])), 0, STREET, recording.names)
        for y in places
    ]

    assert [{dst for _, relation, dst in frame if relation == "isIn"} for frame in of] == [
        {"east" if y < 0 else "off_road"} for y in places
    ]


def test_memory_does_not_grow_with_time() -> None:
    recording, generator = Recording(), SceneGraphGenerator(STREET, Config())
    things = [thing(f"c{i}", 5 * i) for i in range(10)]
    wall = thing("wall", 20, kind="barrier", static=True)

    def run(blocks: int) -> int:
        for _ in range(blocks):
            generator.block(recording.block(*([thing("ego"), *things] for _ in range(3))))
        gc.collect()  # also empties Python's stocks of freed tuples
        return tracemalloc.get_traced_memory()[0]

    generator.block(recording.block([thing("ego"), *things, wall]))
    tracemalloc.start()
    after_10, after_100 = run(10), run(90)
    tracemalloc.stop()

    a_block = 3 * 11 * 23 * 8  # bytes of its states alone
    assert after_100 - after_10 < 5 * a_block


def test_a_state_of_a_stranger_is_refused() -> None:
    block = frames([thing("ego")])
    stranger = replace(block.states, node=np.array([5]))

    with pytest.raises(ValueError, match="node 5"):
        graph_of(replace(block, states=stranger))


def test_entities_must_be_introduced_one_after_another() -> None:
    block = frames([thing("ego")])

    with pytest.raises(ValueError, match="begin at 3"):
        graph_of(replace(block, entities=replace(block.entities, first=3)))


# Several egos -----------------------------------------------------------------------------------


def contents(graph: GraphBlock) -> list[object]:
    """All that is in a graph, to be compared."""
    of, there, lanes, gaps = graph.edges, graph.presence, graph.lanes, graph.gaps
    return [
        graph.frames.offsets.tolist(),
        graph.frames.ego.tolist(),
        graph.frames.states.node.tolist(),
        sorted(zip(there.frame.tolist(), there.node.tolist(), strict=True)),
        sorted(zip(*(of.frame, of.relation, of.src, of.dst), strict=True)),
        sorted(
            zip(*(lanes.frame, lanes.node, lanes.lane, lanes.overlap, lanes.primary), strict=True)
        ),
        sorted(zip(gaps.frame, gaps.src, gaps.dst, gaps.gap, strict=True)),
    ]


@pytest.mark.parametrize("seed", range(10))
def test_several_egos_in_one_pass_are_as_each_of_them_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    recording, together = Recording(), SceneGraphGenerator(STREET, Config())
    alone = [SceneGraphGenerator(STREET, Config()) for _ in range(3)]
    names = ["ego", *(f"c{i}" for i in range(9))]
    wall = thing("wall", 20, kind="barrier", static=True)

    for _ in range(3):
        scenes = [
            [thing(name, *rng.uniform(-120, 120, 2)) for name in names if rng.random() < 0.9]
            for _ in range(4)
        ]
        block = recording.block(*([*scene, wall] for scene in scenes))
        known = [recording.names.index(n) if n in recording.names else -1 for n in names[:3]]
        egos = [
            np.where([names[i] in {t.name for t in scene} for scene in scenes], node, -1)
            for i, node in enumerate(known)
        ]
        graphs = together.blocks(block, egos)
        for ego, generator, graph in zip(egos, alone, graphs, strict=True):
            assert contents(generator.block(replace(block, ego=ego))) == contents(graph)


def test_a_footprint_in_the_range_of_several_egos_is_looked_up_once() -> None:
    recording, town = Recording(), PaperMap(*STREET.patches)
    block = recording.block([thing("ego"), thing("a", 20), thing("b", -20)])

    graphs = SceneGraphGenerator(town, Config()).blocks(block, [np.array([n]) for n in range(3)])

    assert [len(graph.frames.states) for graph in graphs] == [3, 3, 3]
    assert town.asked == 3


# Parking ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("places", "other", "parked"),
    [
        pytest.param([(9, 9), (9.2, 9)], {}, 1, id="off the road, trembling"),
        pytest.param([(9, 9), (9.4, 9)], {}, 0, id="off the road, moving"),
        pytest.param([(9, 9), (20, 9), (9, 9)], {}, 0, id="there and back"),
        pytest.param([(9, -2), (9, -2)], {}, 0, id="on a lane for driving"),
        pytest.param([(9, -2), (9, -2)], {"static": True}, 1, id="static in the simulator"),
        pytest.param([(9, 9), (9, 9)], {"kind": "person"}, -1, id="no vehicle"),
        pytest.param([(90, 90), (90, 90)], {}, -1, id="never in range"),
        pytest.param([(90, 90), (95, 90)], {}, 0, id="never in range, moving"),
        pytest.param([(math.nan, 9), (9, 9)], {}, 1, id="at first nowhere"),
    ],
)
@pytest.mark.parametrize("blocks", [1, 2])
def test_what_is_parked_is_known_in_the_end(
    places: list[tuple[float, float]], other: dict[str, object], parked: int, blocks: int
) -> None:
    recording, generator = Recording(), SceneGraphGenerator(STREET, Config())
    scenes = [[thing("ego", i, -2), thing("c", *place, **other)] for i, place in enumerate(places)]

    for part in [scenes] if blocks == 1 else [[scene] for scene in scenes]:
        generator.block(recording.block(*part))

    assert generator.parked.tolist() == [0, parked]


@pytest.mark.parametrize(("share", "parked"), [(0.2, 1), (0.8, 0)])
def test_a_noisy_parked_vehicle_may_reach_into_a_lane(share: float, parked: int) -> None:
    found = []
    for bits in (0, SMOOTHED | STANDS):
        recording, generator = Recording(), SceneGraphGenerator(STREET, Config())
        for i in range(5):
            y = -4 - 2.0 * (0.5 - share)
            block = recording.block([thing("ego", i, -2), thing("c", 9, y)])
            derived = np.full(len(block.states), bits)
            generator.block(replace(block, states=replace(block.states, derived=derived)))
        found.append(generator.parked.tolist()[1])
    assert found == [0, parked]


def test_without_a_map_only_what_is_static_is_known_to_be_parked() -> None:
    generator = SceneGraphGenerator(None, Config())

    generator.block(frames([thing("ego"), thing("a", 5), thing("b", 9, static=True)]))

    assert generator.parked.tolist() == [-1, -1, 1]


# What it can answer -----------------------------------------------------------------------------


def test_without_a_map_nothing_is_known_of_lanes() -> None:
    without = SceneGraphGenerator(None, Config()).answers

    sides = {"toLeftOf", "toRightOf"}
    assert set(without) == {*PROXIMITY, *DIRECTIONS, *sides, "overlaps", "sees", "tows"}
    graph = graph_of(frames([thing("ego")]))
    assert len(graph.lanes) == len(graph.edges) == len(graph.presence) == 0


def test_with_a_map_lanes_and_signals_are_known_too() -> None:
    known = SceneGraphGenerator(STREET, Config()).answers

    assert set(known) == {
        *SceneGraphGenerator(None, Config()).answers,
        *("isIn", "travelsTo", "opposes", "laneChange", "conflictsWith"),
        *("controlsTrafficOf", "mayAffect", "leads", "follows"),
    }


def test_relations_that_the_config_leaves_out_are_not_answered() -> None:
    config = Config(
        proximity=Proximity(("near",), (16.0,)), direction=Direction(("inDFrontOf",), ())
    )

    answers = SceneGraphGenerator(None, config).answers

    assert set(answers) == {
        *("near", "inDFrontOf", "toLeftOf", "toRightOf", "overlaps", "sees", "tows")
    }


def test_where_no_pairs_are_related_their_relations_are_unknown() -> None:
    config = Config(pairs=PairSettings(within=0, ego=False), sees=False)

    assert SceneGraphGenerator(None, config).answers == ()
    assert edges(graph_of(frames([thing("ego"), thing("c", 3)]), None, config)) == []


def test_a_block_without_frames_is_a_graph_without_frames() -> None:
    graph = graph_of(frames(), STREET)

    assert len(graph) == len(graph.edges) == len(graph.presence) == len(graph.lanes) == 0


def test_an_empty_frame_has_a_graph() -> None:
    graph = graph_of(frames([], [thing("ego", y=-2)], []), STREET)

    assert [nodes(graph, i) for i in range(3)] == [[], ["ego"], []]
