"""What is a pair of bodies: storeys, flat things, trailers and riders, in all ways in which one can ask.

Each scene is asked in the view of the store, in the language, in memory and online; and against a definition
that shares nothing with them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from builders import Recording, Thing, edges, frame_of, frames, graph_of, thing
from graph_blocks import trace_info
from scenes import NO_MESSAGES
from test_relations import bodies, flat, footprint, storeys_apart

from sgstore.graphs.online import Frame
from sgstore.graphs.relations import relations
from sgstore.lang.memory import FrameView
from sgstore.model.config import Config, Proximity
from sgstore.model.vocabulary import KINDS, PROXIMITY, SIGNALS
from sgstore.model.world import TraceReport
from sgstore.pipeline.derive import derive
from sgstore.query import Store
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.model.world import FrameBlock

NUMBERS = ("dist", "gap", "lon", "ttc", "closing_speed", "rss_margin", "clearance")
CLOSE = {*PROXIMITY, "overlaps", "leads", "follows"}


def store_of(path: Path, *of: list[Thing]) -> Store:
    """A store with a trace of these frames, without a map."""
    file, config = StoreFile.create(path), Config()
    generator = SceneGraphGenerator(None, config)
    info = trace_info("/bodies.mcap", digest="0" * 64, channels=(), ego="ego", context=NO_MESSAGES)
    with file.segment(info, config, road_map=None, answers=generator.answers) as segment:
        segment.append(generator.block(Recording().block(*of)))
        sealed = segment.seal(
            TraceReport(frames=len(of)), None, (generator.parked, generator.world_parked)
        )
        assert file.publish_each([sealed]) == ["bodies"]
    return Store(path)


def scene(seed: int) -> list[Thing]:
    """Things on several storeys, flat ones, some of which nobody knows the height of."""
    rng = np.random.default_rng(seed)
    kinds = ("car", "truck", "person", "prop", "prop", "unknown", "traffic_light")
    things = [thing("ego", 0, 0, 0.1, vx=8)]
    for number in range(9):
        kind = str(rng.choice(kinds))
        things.append(
            Thing(
                f"t{number}",
                kind,
                x=rng.uniform(-15, 25),
                y=rng.uniform(-6, 6),
                heading=rng.uniform(-math.pi, math.pi),
                z=float(rng.choice([0, 0.75, 0.75, 2.0, 2.5, 6.75, math.nan])),
                length=rng.uniform(1, 6),
                width=rng.uniform(0.5, 2.5),
                height=float(rng.choice([0, 0, 1.5, 1.5, 2.0, math.nan])),
                vx=rng.uniform(-5, 5),
            )
        )
    return things


def known(a: Thing, b: Thing) -> dict[str, bool]:
    """Which numbers of a pair are to be known, by the definition."""
    level, solid = not storeys_apart(a, b), not (flat(a) or flat(b))
    return dict.fromkeys(("dist", "lon", "closing_speed"), level) | dict.fromkeys(
        ("gap", "clearance", "rss_margin"), level and solid
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_numbers_of_a_pair_are_known_of_bodies_on_one_level(seed: int, tmp_path: Path) -> None:
    things = scene(seed)
    of = {t.name: t for t in things}
    store = store_of(tmp_path / "s.sgstore", things)
    calls = ", ".join(f"{name}(a, b)" for name in NUMBERS)

    rows = list(store.find(f"MATCH (a:Entity), (b:Entity) RETURN a.ident, b.ident, {calls}"))
    columns = ", ".join("distance" if name == "dist" else name for name in NUMBERS)
    view = store.sql(
        f"SELECT a.ident, b.ident, {columns} FROM criticality p JOIN nodes a ON a.frame_id = p.frame_id"
        " AND a.node_id = p.src JOIN nodes b ON b.frame_id = p.frame_id AND b.node_id = p.dst"
    )
    graph = SceneGraphGenerator(None, Config()).step(frame_of(*things))
    memory = FrameView(graph)
    nodes = {about["ident"]: node for node, about in graph.nodes.items()}

    asked = {tuple(row)[:2]: tuple(row)[2:] for row in rows}
    viewed = {tuple(row)[:2]: tuple(row)[2:] for row in view}
    assert len(asked) == len(viewed) == 90
    for (one, other), values in asked.items():
        expected = known(of[one], of[other])
        found = {name: v is not None for name, v in zip(NUMBERS, values, strict=True)}
        assert {name: found[name] for name in expected} == expected, (of[one], of[other])
        assert viewed[one, other] == pytest.approx(values, nan_ok=True, abs=1e-6)
        ours = [memory.pair(name, nodes[one], nodes[other]) for name in NUMBERS]
        assert ours == pytest.approx(list(values), nan_ok=True, abs=1e-5)
    assert 20 < sum(known(of[a], of[b])["gap"] for a, b in asked) < 80
    assert sum(not known(of[a], of[b])["dist"] for a, b in asked) > 3


def test_a_store_without_storeys_is_asked_without_marks(tmp_path: Path) -> None:
    level = store_of(tmp_path / "level.sgstore", [thing("ego"), thing("b", 9)])
    bridge = store_of(tmp_path / "bridge.sgstore", [thing("ego"), thing("b", 9, z=8)])
    paint = thing("p", 4, kind="prop", z=0, height=0)
    painted = store_of(tmp_path / "paint.sgstore", [thing("ego"), thing("b", 9), paint])
    query = "MATCH (a:Ego), (b:Vehicle) WHERE gap(a, b) < 9"

    def marks(store: Store, query: str = query) -> set[str]:
        text = store.explain(query)
        return {mark for mark in ("level(", "solid(") if mark in text}

    assert marks(level) == set()
    assert marks(bridge) == {"level("}
    assert marks(painted) == set()
    assert marks(painted, query.replace("Vehicle", "Prop")) == {"solid("}
    assert [len(list(store.find(query))) for store in (level, bridge, painted)] == [1, 0, 1]


def test_without_a_height_on_either_side_distances_are_in_the_plane(tmp_path: Path) -> None:
    things = [thing("ego"), thing("b", 3, 4, z=math.nan)]

    assert ("b", "super_near", "ego") in edges(graph_of(frames(things)))
    graph = SceneGraphGenerator(None, Config()).step(frame_of(*things))
    assert any(relation == "super_near" for _, relation, *_ in graph.edges)
    store = store_of(tmp_path / "s.sgstore", things)
    assert [
        tuple(row)
        for row in store.find("MATCH (a:Ego), (b:Car) WHERE dist(a, b) = 5 RETURN b.ident")
    ] == [("b",)]


def test_paint_on_the_road_is_no_body() -> None:
    paint = thing("paint", 1, kind="prop", z=0, height=0, length=2, width=0.3)
    ramp = thing("ramp", 1, kind="prop", z=0.05, height=0.1, length=2, width=0.3)

    def close(other: Thing) -> set[str]:
        of = edges(graph_of(frames([thing("ego"), other])))
        return {relation for _, relation, _ in of} & CLOSE

    assert close(paint) == set()
    assert close(ramp) == {"overlaps", "safety_hazard"}


def test_a_recording_that_gives_no_heights_has_bodies() -> None:
    for height in (0, math.nan):
        cars = [thing("ego", height=height), thing("b", 3, height=height)]
        found = {relation for _, relation, _ in edges(graph_of(frames(cars)))}
        assert found >= {"overlaps", "near_coll"}


# Trailers and riders ------------------------------------------------------------------------------


def pulled(x: float, **more: Any) -> list[Thing]:
    truck = thing("truck", x, kind="truck", length=6, vx=10)
    return [thing("ego", x - 20, vx=10), truck, thing("t", x - 5, kind="trailer", length=5, **more)]


def related(block: Any, a: str, b: str) -> list[set[str]]:
    """Relations between two, frame by frame."""
    graph = graph_of(block)
    names = list(graph.frames.entities.ident)
    return [
        {r for src, r, dst in edges(graph, frame, names=names) if {src, dst} == {a, b}}
        & {*CLOSE, "tows"}
        for frame in range(len(graph))
    ]


def test_a_trailer_that_touches_from_the_first_frame_on_is_pulled() -> None:
    block = Recording().block(*(pulled(x, vx=10) for x in (0, 1, 2)))

    assert related(block, "truck", "t") == [{"tows"}] * 3
    assert ("truck", "tows", "t") in edges(graph_of(block), 2)


def test_what_comes_to_touch_a_trailer_runs_into_it() -> None:
    before, after = pulled(0), pulled(0)
    block = Recording().block([*before, thing("c", -16)], [*after, thing("c", -9)])

    assert related(block, "c", "t")[1] >= {"overlaps", "near_coll"}


def test_a_trailer_that_is_left_behind_is_a_body_again() -> None:
    left = [pulled(0), pulled(0)]
    left[1][1] = thing("truck", 12, kind="truck", length=6, vx=10)
    back = pulled(0)
    block = Recording().block(left[0], left[1], back)

    found = related(block, "truck", "t")
    assert found[0] == {"tows"}
    assert "tows" not in found[1]
    assert found[2] >= {"overlaps"}


def test_a_rider_is_no_body_beside_the_bicycle() -> None:
    def ride(x: float) -> list[Thing]:
        bike = thing("bike", x, kind="bicycle", length=1.8, width=0.6)
        person = thing("p", x, kind="person", length=0.6, width=0.6, z=1.0, height=1.8)
        return [thing("ego", -30), bike, person]

    assert related(Recording().block(ride(0), ride(1)), "bike", "p") == [set(), set()]
    apart = ride(0)
    apart[2] = thing("p", 3, kind="person", length=0.6, width=0.6, z=1.0, height=1.8)
    assert related(Recording().block(apart, ride(0)), "bike", "p")[1] >= {"overlaps"}


def test_blocks_frames_and_steps_agree_on_what_is_carried() -> None:
    drive = [pulled(x, vx=10) for x in (0, 1, 2, 3)]
    whole = graph_of(Recording().block(*drive)).frames.states.carrier.tolist()
    recording, generator = Recording(), SceneGraphGenerator(None, Config())
    parts = [generator.block(recording.block(one)).frames.states.carrier for one in drive]
    online = SceneGraphGenerator(None, Config())
    graphs = [online.step(frame_of(*one, time_ns=n)) for n, one in enumerate(drive)]

    assert np.concatenate(parts).tolist() == whole
    for graph in graphs:
        carriers = {about["ident"]: about.get("carrier") for about in graph.nodes.values()}
        ids = {about["ident"]: node for node, about in graph.nodes.items()}
        assert carriers == {"ego": None, "truck": None, "t": ids["truck"]}


@pytest.mark.parametrize("kind", ["trailer", "car", "vehicle"])
def test_a_trailer_behind_a_drawbar_is_pulled_if_the_recording_says_so(kind: str) -> None:
    for told in ("", "t"):
        frame = Frame(0, "truck")
        size = {"heading": 0.0, "width": 2.5, "height": 3.0}
        frame.add("truck", "truck", 0, 0, 1.5, length=6, trailer=told, **size)
        frame.add("t", kind, -6, 0, 1.5, length=5, **size)
        of = {r for _, r, *_ in SceneGraphGenerator(None, Config()).step(frame).edges}
        assert of & {*CLOSE, "tows"} == ({"tows"} if told else {"super_near"})


def test_derived_relations_know_what_is_carried(tmp_path: Path) -> None:
    store = store_of(tmp_path / "s.sgstore", *(pulled(x, vx=10) for x in (0, 1)))
    near = Config(proximity=Proximity(("near",), (25.0,)))
    derive(tmp_path / "s.sgstore", near, "wide")

    query = "USING ABSTRACTION wide MATCH (a)-[r:near|tows]->(b) RETURN a.ident, type(r), b.ident"
    pairs = {("ego", "truck"), ("truck", "ego"), ("ego", "t"), ("t", "ego")}
    expected = {(a, "near", b) for a, b in pairs} | {("truck", "tows", "t")}
    assert sorted(map(tuple, store.find(query))) == sorted([*expected] * 2)


def test_a_trailer_is_no_pair_with_its_truck_in_a_store(tmp_path: Path) -> None:
    store = store_of(tmp_path / "s.sgstore", *(pulled(x, vx=10) for x in (0, 1)))

    rows = [
        tuple(row)
        for row in store.find(
            "MATCH (a:Truck), (b:Trailer) RETURN gap(a, b), dist(a, b), ttc(b, a)"
        )
    ]
    assert rows == [(None, None, None)] * 2
    (distances,) = zip(
        *store.sql("SELECT distance FROM pairs WHERE src_kind = 'truck' AND dst_kind = 'trailer'"),
        strict=True,
    )
    assert distances == (None, None)
    assert [
        row[0] for row in store.sql("SELECT count(*) FROM nodes WHERE carrier IS NOT NULL")
    ] == [2]


# Recordings ---------------------------------------------------------------------------------------

WITHOUT_CONTACT = (
    "esmini/highway_merge.mcap",
    "esmini/pedestrian.mcap",
    "esmini/swarm_Town04.mcap",
    "esmini/traffic_lights.mcap",
    "omega_prime/alks_cut-in.osi",
    "omega_prime/pedestrian.osi",
    "osi_converter/MovingHostWith3DModel.mcap",
    "osi_converter/MovingHostWithStopLine.mcap",
    "osi_converter/disappearingVehicle.mcap",
    "osi_converter/testBrakeAndIndicatorLights.mcap",
)
"""Recordings in whose simulators nothing touches; in the others boxes do meet (the next law)."""


@pytest.mark.data
@pytest.mark.parametrize("name", WITHOUT_CONTACT)
def test_a_recording_without_a_contact_has_no_overlaps(data: Path, name: str) -> None:
    assert contacts_of(data / "traces" / name) == []


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["carla/Town01.carla.mcap", "esmini/cut-in.mcap", "sumo/Town10HD_sumo_osi.mcap"]
)
def test_what_overlaps_in_a_recording_are_boxes_that_meet(data: Path, name: str) -> None:
    found = contacts_of(data / "traces" / name)

    assert found
    for a, b in found[:: max(len(found) // 300, 1)]:
        assert footprint(a).distance(footprint(b)) <= 2e-4
        assert bodies(a, b)
        assert not {a.kind, b.kind} & set(SIGNALS)
        assert "trailer" not in {a.kind, b.kind}


def contacts_of(path: Path) -> list[tuple[Thing, Thing]]:
    """The pairs that overlap, in each frame."""
    generator = SceneGraphGenerator(None, Config())
    overlaps = [one.name for one in relations()].index("overlaps")
    found: list[tuple[Thing, Thing]] = []
    kinds: list[int] = []
    for block in _blocks(path):
        kinds += block.entities.kind.tolist()
        graph = generator.block(block)
        states, frame_of_state = graph.frames.states, graph.frames.frame_of
        rows = {key: i for i, key in enumerate(zip(frame_of_state, states.node, strict=True))}
        of = graph.edges
        for frame, relation, src, dst in zip(of.frame, of.relation, of.src, of.dst, strict=True):
            if relation == overlaps and {(frame, src), (frame, dst)} <= rows.keys():
                found.append(
                    tuple(_thing(states, rows[frame, n], KINDS[kinds[n]]) for n in (src, dst))  # type: ignore[arg-type]
                )
            elif relation == overlaps:
                found.append((thing("still"), thing("still")))
    return found


def _blocks(path: Path) -> Iterator[FrameBlock]:
    with open_trace(path) as trace:
        yield from trace.blocks()


def _thing(states: Any, row: int, kind: str) -> Thing:
    names = ("x", "y", "heading", "z", "length", "width", "height")
    return Thing(str(states.node[row]), kind, **{n: float(getattr(states, n)[row]) for n in names})


def test_shapely_agrees_that_the_scenes_have_boxes_that_meet() -> None:
    things = scene(1)
    meet = [
        (a.name, b.name)
        for a in things
        for b in things
        if a is not b and bodies(a, b) and shapely.intersects(footprint(a), footprint(b))
    ]
    signals = {t.name for t in things if t.kind in SIGNALS}
    found = edges(graph_of(frames(things)))
    assert {(a, b) for a, b in meet if not {a, b} & signals} == {
        (a, b) for a, relation, b in found if relation == "overlaps"
    }
