"""Online: a client that owns the loop gets, step by step, the graphs that a store would hold."""

from __future__ import annotations

import gc
import math
import tracemalloc
from itertools import islice
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
import pytest
from builders import PaperMap, Patch, Recording, Thing, frame_of, thing
from thorough import LONG

from sgstore.apps.demo import RECORDING
from sgstore.graphs import online as stepping
from sgstore.graphs.online import Frame, Replay
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import RELATIONS
from sgstore.model.world import Origin, number, origin_of, quantize
from sgstore.query import Store
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.model.graph import GraphBlock, SceneGraph

pytestmark = pytest.mark.seconds(15)

STREET = PaperMap(
    Patch("east", -400, -4, 40, 0, road="main", controlled_by="s1"),
    Patch("west", -400, 0, 40, 4, road="main"),
    Patch("zebra", 22, -4, 26, 4, kind="crosswalk"),
    objects=(("s1", "traffic_light"), ("o1", "pole")),
)


def generator(road_map: PaperMap | None = STREET, **settings: Any) -> SceneGraphGenerator:
    return SceneGraphGenerator(road_map, Config(**settings))


def named(graph: SceneGraph) -> set[tuple[str, str, str]]:
    """Edges with the clients' ids of entities, and the names of parts of the map."""
    names = {node: a.get("ident", a.get("name", "")) for node, a in graph.nodes.items()}
    return {(names[a], relation, names[b]) for a, relation, b, _ in graph.edges}


# Frames of plain values ---------------------------------------------------------------------------


def test_a_client_gets_a_graph_with_its_own_ids_and_outward_units() -> None:
    frame = Frame(1_500_000_000, ego=7)
    frame.add(
        *(7, "car", 10.0, -2.0, 0.8),
        heading=90.0,
        length=4.5,
        width=1.9,
        height=1.6,
        vx=0.0,
        vy=8.0,
        ax=0.0,
        ay=-2.0,
        yaw_rate=3.0,
        lights=["light_brake"],
        throttle=0.25,
        gear=-1,
        hand_brake=True,
        special="taxi",
        type_name="vehicle.ford.crown",
    )
    frame.add("p", "Pedestrian", 12.0, 3.0, heading=float("inf"))

    graph = generator().step(frame)

    ego, person = graph.nodes[0], graph.nodes[1]
    assert graph.ego == 0
    assert graph.time_ns == 1_500_000_000
    assert ego["ident"] == "7"
    assert ego["is_ego"]
    assert ego["heading"] == pytest.approx(90.0)
    assert ego["speed"] == 8.0
    assert ego["accel"] == pytest.approx(-2.0)
    assert ego["yaw_rate"] == pytest.approx(3.0)
    assert ego["light_brake"]
    assert not ego["light_left"]
    assert ego["throttle"] == 0.25
    assert (ego["gear"], ego["hand_brake"]) == (-1, True)
    assert not {"gear", "hand_brake"} & person.keys()
    assert ego["special"] == "taxi"
    assert person["kind"] == "person"
    assert not {"heading", "speed", "light_left", "light_state", "length"} & person.keys()
    assert ("7", "isIn", "east") in named(graph)
    assert ("p", "inDFrontOf", "7") in named(graph)


def test_a_graph_goes_to_networkx() -> None:
    graph = generator().step(frame_of(thing("ego"), thing("c", 12)))

    out = graph.to_networkx()

    assert isinstance(out, nx.MultiDiGraph)
    assert out.has_edge(1, 0, key="near")
    assert out.nodes[1]["ident"] == "c"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"kind": "cra"}, "unknown kind 'cra'; did you mean 'car'"),
        ({"kind": "vru"}, "unknown kind 'vru'"),
        ({"kind": "lane"}, "unknown kind 'lane'"),
        ({"light_state": "rde"}, "unknown state of a traffic light 'rde'; did you mean 'red'"),
        ({"lights": ["light_brakes"]}, "did you mean 'light_brake'"),
        ({"special": "police"}, "unknown special kind 'police'"),
    ],
)
def test_a_word_that_is_not_known_is_refused_with_those_that_are(
    wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Frame(0).add("a", x=0.0, y=0.0, **{"kind": "car", **wrong})


def test_other_values_than_texts_become_texts() -> None:
    frame = Frame(0)
    frame.add(7, "car", 0.0, 0.0, type_name=[], subkind=3, map_ref=12)  # type: ignore[arg-type]
    (entity,) = frame.entities
    texts = entity.ident, entity.type_name, entity.subkind, entity.map_ref
    assert texts == ("7", "[]", "3", "12")


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([[thing("a"), thing("a", 5)]], "two entities have the id 'a'"),
        ([[thing("a", static=True), thing("a", 5)]], "two entities have the id 'a'"),
        ([[thing("a", static=True)], [thing("a", 5)]], "was static before and moves now"),
        ([[thing("a")], [thing("a", static=True)]], "moved before and is static now"),
    ],
)
def test_a_frame_that_contradicts_itself_or_the_past_is_refused_and_has_not_been(
    frames: list[list[Thing]], message: str
) -> None:
    online = generator()
    *before, wrong = frames
    for things in before:
        online.step(frame_of(*things))

    with pytest.raises(ValueError, match=message):
        online.step(frame_of(thing("new"), *wrong))

    after = online.step(frame_of(thing("b")))
    idents = {a["ident"]: node for node, a in after.nodes.items() if "ident" in a}
    assert idents["b"] == len(before)
    assert after.seq == len(before)


# The same as offline ------------------------------------------------------------------------------


def world(steps: int, seed: int) -> Iterator[list[Thing]]:
    """Things that come, wait, move and go; a house and a light that stay."""
    rng = np.random.default_rng(seed)
    house = thing("house", 30, 12, kind="building", static=True)
    for step in range(steps):
        there = [i for i in range(12) if (step + 3 * i) % 20 < 14]
        cars = [
            thing(
                f"c{i}",
                float(4 * i - 20 + (step // 3) * (i % 3)),
                float(rng.uniform(-4, 4)),
                0.1 * i,
                kind="person" if i % 4 == 0 else "car",
            )
            for i in there
        ]
        late = [thing("late", 5, 9, kind="pole", static=True)] if step == 7 else []
        light = thing("light", 38, -2, kind="traffic_light", map_ref="s1")
        yield [thing("ego", float(step), -2), *cars, light, *([house] if not step else []), *late]


def test_steps_and_blocks_give_the_same_edges() -> None:
    frames = list(world(40, seed=1))
    recording, offline, online = Recording(), generator(), generator()

    for start in range(0, 40, 20):
        part = frames[start : start + 20]
        block = recording.block(*part)
        graph = offline.block(block)
        for row, things in enumerate(part):
            shown = {t.name: t for f in frames[: start + 20] for t in f if t.static}
            step = online.step(frame_of(*things, *shown.values()))
            assert named(step) == block_edges(graph, row, recording.names)


def block_edges(graph: Any, row: int, names: list[str]) -> set[tuple[str, str, str]]:
    """Edges of a frame of a block, those among parts of the map too, by names."""
    edges, mapped = graph.edges, STREET.edges

    def name(node: int) -> str:
        return names[node] if node >= 0 else STREET.nodes.name[-1 - node]

    rows = edges.frame == row
    found = zip(edges.src[rows], edges.relation[rows], edges.dst[rows], strict=True)
    here = set(graph.presence.node[graph.presence.frame == row].tolist())
    found = [*found, *zip(mapped.src, mapped.relation, mapped.dst, strict=True)]
    return {
        (name(a), RELATIONS[r], name(b)) for a, r, b in found if a >= 0 or {int(a), int(b)} <= here
    }


def test_a_generator_that_is_made_anew_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = generator()
    expected = [usual.step(frame_of(*things)) for things in world(60, seed=2)]
    monkeypatch.setattr(stepping, "SPARE", -30)
    renewed = generator()
    made: list[object] = []
    plain = SceneGraphGenerator.__init__

    def counted(self: SceneGraphGenerator, *arguments: Any) -> None:
        made.append(self)
        plain(self, *arguments)

    monkeypatch.setattr(SceneGraphGenerator, "__init__", counted)

    assert [renewed.step(frame_of(*things)) for things in world(60, seed=2)] == expected
    assert len(made) > 10


def test_who_was_away_for_a_while_comes_back_with_the_same_node_id() -> None:
    online = generator()
    first = online.step(frame_of(thing("ego"), thing("c", 8)))
    for _ in range(50):
        online.step(frame_of(thing("ego")))

    again = online.step(frame_of(thing("ego"), thing("d", 5), thing("c", 9)))

    assert first.nodes[1]["ident"] == again.nodes[1]["ident"] == "c"


def test_who_was_away_while_many_others_came_is_somebody_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stepping, "REMEMBERED", 5)
    online = generator()
    online.step(frame_of(thing("ego"), thing("c", 8)))
    for i in range(6):
        online.step(frame_of(thing("ego"), thing(f"other {i}", 9)))

    again = online.step(frame_of(thing("ego"), thing("c", 9, kind="bus")))

    assert 1 not in again.nodes
    assert [a["kind"] for a in again.nodes.values() if a.get("ident") == "c"] == ["bus"]


def test_an_ego_of_the_config_serves_frames_that_name_none() -> None:
    online = generator(ego="ego")

    assert online.step(frame_of(thing("a"), thing("ego"), ego=None)).ego == 1
    assert online.step(frame_of(thing("a"), thing("ego"), ego="a")).ego == 0
    assert online.step(frame_of(thing("a"), ego=None)).ego is None
    assert online.step(frame_of(thing("a"), ego="nobody")).ego is None


# Memory -------------------------------------------------------------------------------------------


def test_several_egos_have_the_graphs_of_generators_of_their_own() -> None:
    together, others = generator(), {ego: generator() for ego in ("a", "b", "nobody")}
    for step in range(4):
        things = [thing("a", 3.0 * step, -2), thing("b", 30, -2), thing("c", -30 + step, 2)]
        graphs = together.steps(frame_of(*things, ego=None), tuple(others))
        for nth, (ego, alone) in enumerate(others.items()):
            graph = alone.step(frame_of(*things, ego=ego))
            assert graphs[nth] == graph
            assert together.class_of("RSV", nth) == alone.class_of("RSV")
    assert [graph.ego for graph in graphs] == [0, 1, None]


def test_memory_does_not_grow_with_steps_though_ids_come_and_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stepping, "REMEMBERED", 20)
    monkeypatch.setattr(stepping, "SPARE", 20)
    online = generator(None, range=RangeSettings(30))

    def run(first: int, count: int) -> int:
        for step in range(first, first + count):
            others = [thing(f"{step // 5}/{i}", 4.0 * i) for i in range(3)]
            online.step(frame_of(thing("ego"), *others))
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    run(0, 40)  # more names than are remembered
    tracemalloc.start()
    try:
        run(40, 80)  # what is remembered before was not counted: it is replaced little by little
        sizes = [run(20 * k, 20) for k in range(6, 12)]
    finally:
        tracemalloc.stop()
    assert max(sizes[3:]) < 1.1 * max(sizes[:3])


# Recordings as they are ---------------------------------------------------------------------------


def agree(online: SceneGraph, stored: SceneGraph, idents: dict[int, str]) -> bool:
    """Both are the same graph, to the last bit. False if a leader is known to the store alone.

    Only leaders and lanes of vehicles that the graph lists as unsure may be missing. A client meets entities
    in another order than a reader, so node ids may be others.
    """
    by_ident = {ident: node for node, ident in idents.items()}
    of = {n: by_ident[a["ident"]] if n >= 0 else n for n, a in online.nodes.items()}
    assert (None if online.ego is None else of[online.ego]) == stored.ego
    assert set(of.values()) == stored.nodes.keys()
    for node, attributes in online.nodes.items():
        same(attributes, stored.nodes[of[node]])
    ours = {(of[a], r, of[b]): attributes for a, r, b, attributes in online.edges}
    theirs = {(a, r, b): attributes for a, r, b, attributes in stored.edges}
    unsure_lane, unsure_lead = (
        {of[n] for n in one} for one in (online.unsure_lane, online.unsure_lead)
    )
    follower = {"follows": 0, "leads": 2}
    later = {
        edge
        for edge in theirs.keys() - ours.keys()
        if edge[1] in follower and edge[follower[edge[1]]] in unsure_lead
    }
    assert ours.keys() == theirs.keys() - later
    assert len(ours) == len(online.edges) == len(stored.edges) - len(later)
    for key, attributes in ours.items():
        unsure = (
            {"is_primary", "is_own"} if key[1] == "isIn" and key[0] in unsure_lane else set[str]()
        )
        same(attributes, {name: v for name, v in theirs[key].items() if name not in unsure})
    return not later


def same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        if name in {"heading", "accel"}:  # from radians by another library than numpy
            assert ours[name] == pytest.approx(value, rel=1e-12, abs=1e-12)
        elif name != "name" or "ident" not in ours:
            assert ours[name] == value, name


@pytest.mark.parametrize("name", ["carla/Town01.carla.mcap", "sumo/Town10HD_sumo_osi.mcap"])
def test_a_replayed_recording_keeps_the_node_ids_of_its_store(data: Path, name: str) -> None:
    """Also of entities that the reader lists before the first frame that has them."""
    online, replay, compared = SceneGraphGenerator(None, Config()), Replay(), 0
    with open_trace(data / "traces" / name) as recording:
        block = next(recording.blocks())
        idents = block.entities.ident
        for frame in islice(replay.frames(block), 3):
            for node, about in online.step(frame).nodes.items():
                assert about["ident"] == idents[node]
                compared += 1
    assert compared >= 3


def test_a_node_id_of_another_entity_is_not_used_again() -> None:
    online = SceneGraphGenerator(None, Config())
    frame = Frame(0)
    for ident, node in (("a", 5), ("b", -1), ("c", 2)):
        frame.add(ident, "car", 0.0, 10.0 * node, heading=0.0)
        frame.entities[-1] = frame.entities[-1]._replace(node=node)
    assert {about["ident"]: node for node, about in online.step(frame).nodes.items()} == {
        "a": 5,
        "b": 6,
        "c": 2,
    }
    later = Frame(100_000_000)
    later.add("d", "car", 0.0, 90.0, heading=0.0)
    later.entities[-1] = later.entities[-1]._replace(node=5)
    assert list(online.step(later).nodes) == [7]


BLOCKS = 6 if LONG else 3
"""Blocks of the bundled recording, of 60 frames each, that are driven step by step."""


def test_the_sample_driven_step_by_step_gives_what_the_store_has(town_store: Path) -> None:
    store = Store(town_store)
    idents = dict(store.sql("SELECT node_id, ident FROM entities").values)
    replay, compared = Replay(), 0
    with open_trace(RECORDING) as recording, store.file.snapshot():
        road_map = read_map(recording.info.map_text, recording.info.map_name)
        online = SceneGraphGenerator(road_map, Config())
        for block in islice(recording.blocks(), BLOCKS):
            for frame in replay.frames(block):
                graph = online.step(frame)
                if graph.seq % 8 == 0:
                    stored = store.file.graph(f"town#{graph.seq}")
                    names = ("E", "RSV", "junction") if agree(graph, stored, idents) else ()
                    for name in names:
                        known = store.file.abstracted.class_of(stored.frame_id, name)
                        assert online.class_of(name) == known
                    compared += 1
    assert compared == math.ceil(60 * BLOCKS / 8)


OF_OWN_LANES = {"leads", "follows"}
"""Relations that follow from driven lanes, which need the past online and the future in a recording."""


def columns(graph: GraphBlock, row: int, idents: list[str]) -> dict[str, set[Any]]:
    """What is in the graph of one frame of a block, by the simulator's ids of entities."""

    def name(node: int) -> str | int:
        return idents[node] if node >= 0 else node

    of, frames, there, lanes = graph.edges, graph.frames, graph.presence, graph.lanes
    edge, lane = of.frame == row, lanes.frame == row
    moving = frames.states.node[frames.offsets[row] : frames.offsets[row + 1]]
    edges = zip(
        of.src[edge].tolist(), of.relation[edge].tolist(), of.dst[edge].tolist(), strict=True
    )
    within = zip(lanes.node[lane].tolist(), lanes.lane[lane].tolist(), strict=True)
    return {
        "nodes": {name(n) for n in (*moving.tolist(), *there.node[there.frame == row].tolist())},
        "edges": {
            (name(a), RELATIONS[r], name(b))
            for a, r, b in edges
            if a >= 0 and RELATIONS[r] not in OF_OWN_LANES
        },
        "lanes": {
            (name(a), b, *map(float, rest))
            for (a, b), *rest in zip(
                within, number(lanes.overlap[lane]), number(lanes.offset[lane]), strict=True
            )
        },
    }


def shown(graph: SceneGraph) -> dict[str, set[Any]]:
    """The same of a graph that came online."""
    name = {n: a["ident"] if n >= 0 else n for n, a in graph.nodes.items()}
    kept = ("overlap", "lane_offset")
    return {
        "nodes": set(name.values()),
        "edges": {
            (name[a], r, name[b]) for a, r, b, _ in graph.edges if a >= 0 and r not in OF_OWN_LANES
        },
        "lanes": {
            (name[a], b, *(float(attributes[k]) for k in kept))
            for a, relation, b, attributes in graph.edges
            if attributes and relation == "isIn"
        },
    }


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "every"),
    [
        ("esmini/cut-in", 1),
        ("esmini/highway_merge", 1),
        ("esmini/pedestrian", 1),
        ("esmini/swarm_Town04", 4),
        ("esmini/traffic_lights", 1),
        ("omega_prime/osi_centerline_example", 1),
        ("sumo/Town10HD_sumo_osi", 4),
    ],
)
def test_recordings_driven_step_by_step_give_what_blocks_of_them_give(
    data: Path, name: str, every: int
) -> None:
    replay, idents, compared = Replay(), list[str](), 0
    with open_trace(data / "traces" / f"{name}.mcap") as recording:
        text = recording.info.map_text
        road_map = read_map(text, "map") if text.lstrip().startswith("<") else None
        offline = SceneGraphGenerator(road_map, Config())
        online = SceneGraphGenerator(road_map, Config())
        origin: Origin | None = None
        for block in islice(recording.blocks(40), 2):
            idents += block.entities.ident
            origin = origin or origin_of(block)
            assert origin is not None
            graph = offline.block(quantize(block, origin))
            for row, frame in enumerate(replay.frames(block)):
                if row % every == 0:
                    assert shown(online.step(frame)) == columns(graph, row, idents)
                    compared += 1
    assert compared >= 20
