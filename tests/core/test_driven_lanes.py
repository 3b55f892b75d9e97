"""Primary lanes in junctions: the lane on the way from entry to exit."""

from __future__ import annotations

import gc
import math
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from weakref import ref

import numpy as np
import oracle_turned
import pytest
import shapely
from builders import Recording, Thing, frame_of, thing
from oracle_watched import LANE_RULES, Drive, worldwide
from scenes import Scene, actor, crossroads, ego, store_of, through

from sgstore.graphs.online import replayed
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.maps.roads import PlainLane, RoadMap, lane_text, read_lane_text
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import RELATION_CODE
from sgstore.pipeline.derive import derive
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.model.graph import GraphBlock, SceneGraph
    from sgstore.model.world import FrameBlock
    from sgstore.temporal import MonitorEvent

WIDE = Config(range=RangeSettings(400))
TURNS = (math.pi / 4, 2.5)


def arc(x: float, y: float, radius: float, start: float, end: float) -> np.ndarray[Any, Any]:
    angle = np.linspace(start, end, 20)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def line(*points: tuple[float, float]) -> np.ndarray[Any, Any]:
    return np.concatenate([np.linspace(a, b, 12) for a, b in pairwise(points)])


HALF = math.pi / 2
LANES = {
    "in": line((-60, 0), (0, 0)),
    "left": arc(0, 20, 20, -HALF, 0),
    "straight": line((0, 0), (30, 0)),
    "right": arc(0, -12, 12, HALF, 0),
    "crossing": line((20, -40), (20, 20)),
    "north": line((20, 20), (20, 80)),
    "east": line((30, 0), (90, 0)),
    "south": line((12, -12), (12, -80)),
}
WAYS = {
    "left": ("in", "left", "north"),
    "straight": ("in", "straight", "east"),
    "right": ("in", "right", "south"),
}
ONTO = {"in": ("left", "straight", "right"), "left": ("north",), "crossing": ("north",)}
ONTO |= {"straight": ("east",), "right": ("south",)}


def placed(points: np.ndarray[Any, Any], turn: float, mirrored: bool) -> np.ndarray[Any, Any]:
    x, y = points[:, 0], -points[:, 1] if mirrored else points[:, 1]
    cos, sin = math.cos(turn), math.sin(turn)
    return np.stack([x * cos - y * sin, x * sin + y * cos], axis=1)


@cache
def town(turn: float = 0.0, mirrored: bool = False) -> RoadMap:
    """A junction with three ways from one lane, and a lane that crosses them."""
    names = [*LANES]
    lanes = []
    for name, points in LANES.items():
        step = np.gradient(points, axis=0)
        aside = 1.75 * np.stack([-step[:, 1], step[:, 0]], axis=1)
        aside /= np.hypot(step[:, 0], step[:, 1])[:, None]
        borders = [placed(points + aside, turn, mirrored), placed(points - aside, turn, mirrored)]
        left, right = borders[::-1] if mirrored else borders
        inside = name in {*WAYS, "crossing"}
        onto = tuple(names.index(to) for to in ONTO.get(name, ()))
        about = (name, "driving", name, "j" if inside else "", 0, -1)
        lanes.append(PlainLane(*about, left, right, np.zeros(len(points)), onto=onto))
    return read_lane_text(lane_text(lanes), "cross")


def drive(way: str, turn: float = 0.0, mirrored: bool = False, step: float = 1.0) -> list[Thing]:
    """The ego on its way, a frame every ``step`` metres."""
    points = placed(np.concatenate([LANES[name] for name in WAYS[way]]), turn, mirrored)
    points = points[np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-6)]
    run = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    at = np.arange(40.0, 125.0, step)
    x, y = (np.interp(at, run, points[:, axis]) for axis in (0, 1))
    ahead_x, ahead_y = (np.interp(at + 0.1, run, points[:, axis]) for axis in (0, 1))
    return [
        thing("ego", *place)
        for place in zip(x, y, np.arctan2(ahead_y - y, ahead_x - x), strict=True)
    ]


def blocks_of(things: list[Thing], size: int, *others: Thing) -> Iterator[FrameBlock]:
    recording = Recording()
    for first in range(0, len(things), size):
        yield recording.block(*([one, *others] for one in things[first : first + size]))


def recorded(road_map: RoadMap, blocks: Iterator[FrameBlock]) -> Iterator[GraphBlock]:
    generator = SceneGraphGenerator(road_map, WIDE)
    for block in generator.recorded(blocks):
        yield generator.block(block)


def primary(road_map: RoadMap, graphs: Iterator[GraphBlock], *, own: bool = False) -> list[str]:
    """The primary lane (or the own lanes) of the ego in each frame."""
    found = []
    for graph in graphs:
        of = graph.lanes
        for frame in range(len(graph)):
            kept = (of.frame == frame) & (of.node == 0) & (of.own if own else of.primary)
            found.append("+".join(road_map.nodes.name[-1 - lane] for lane in of.lane[kept]))
    return found


def lanes_of(way: str, size: int = 20, turn: float = 0.0, mirrored: bool = False) -> list[str]:
    road_map = town(turn, mirrored)
    return primary(road_map, recorded(road_map, blocks_of(drive(way, turn, mirrored), size)))


def runs(names: list[str]) -> list[str]:
    return [name for i, name in enumerate(names) if not i or names[i - 1] != name]


@pytest.mark.parametrize("way", WAYS)
def test_the_primary_lane_in_a_junction_is_on_the_way_from_entry_to_exit(way: str) -> None:
    assert runs(lanes_of(way)) == [*WAYS[way]]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("way", WAYS)
def test_primary_lanes_stay_when_the_world_is_turned_and_mirrored(way: str, mirrored: bool) -> None:
    wanted = lanes_of(way)

    for turn in TURNS:
        assert lanes_of(way, turn=turn, mirrored=mirrored) == wanted


@pytest.mark.data
def test_a_passage_begins_in_the_same_frame_in_a_turned_world(data: Path) -> None:
    # One vehicle of Town10HD changed its lane two frames later where squares on fixed axes bound passages.
    road_map, blocks = oracle_turned.recorded(data / "traces/sumo/Town10HD_sumo_osi.mcap")
    blocks = [block for block in blocks if block.seq[0] <= 330]

    (differences,) = oracle_turned.compare(
        road_map, blocks, [oracle_turned.World(math.atan2(4, 3), mirrored=True)]
    ).values()

    assert differences == []


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn", TURNS)
def test_points_are_near_a_surface_by_their_distance(turn: float, mirrored: bool) -> None:
    lanes = np.array([1, 2, 3, 4])
    points = np.random.default_rng(7).uniform(-50, 60, (4000, 2))
    shape = shapely.union_all(town().outlines()[1 + lanes])
    distance = np.array([shape.distance(shapely.Point(point)) for point in points])

    for far in (0.5, 3.0, 20.0):
        surface = town(turn, mirrored).surface_of(lanes, far)
        near = surface.near(*placed(points, turn, mirrored).T)
        sure = abs(distance - far) > 1e-9
        assert (near[sure] == (distance <= far)[sure]).all()
        assert 0 < near.sum() < len(near)


def test_points_without_a_finite_place_are_near_no_surface() -> None:
    x, y = np.array([np.nan, np.inf, 1e300, 10.0]), np.array([0.0, 0.0, 1e300, 0.0])

    assert town().surface_of(np.array([2]), 3.0).near(x, y).tolist() == [False] * 3 + [True]
    assert not town().surface_of(np.zeros(0, np.int64), 3.0).near(x, y).any()


def test_the_traces_of_a_map_share_its_junctions(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[float] = []
    compute = RoadMap.surface_of

    def surface_of(road_map: RoadMap, lanes: Any, distance: float) -> Any:
        computed.append(distance)
        return compute(road_map, lanes, distance)

    wanted = lanes_of("left")
    monkeypatch.setattr(RoadMap, "surface_of", surface_of)
    road_map = town.__wrapped__()
    lanes = [primary(road_map, recorded(road_map, blocks_of(drive("left"), 20))) for _ in range(2)]

    assert lanes == [wanted] * 2
    assert len(computed) == 1
    kept = ref(road_map)
    del road_map
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize("size", [7, 50])
def test_primary_lanes_do_not_depend_on_where_blocks_end(size: int) -> None:
    assert lanes_of("left", size) == lanes_of("left")


def test_only_the_driven_lane_is_an_own_lane_in_a_recording() -> None:
    road_map, blocks = town(), blocks_of(drive("left"), 20)

    assert runs(primary(road_map, recorded(road_map, blocks), own=True)) == [*WAYS["left"]]


def test_only_a_vehicle_on_the_driven_way_leads() -> None:
    others = (thing("a", 28, 0), thing("b", 20, 40, math.pi / 2))
    graphs = recorded(town(), blocks_of(drive("left"), 20, *others))
    inside = set[int]()
    leads = set[tuple[int, int]]()
    start = 0
    for graph in graphs:
        of, lanes = graph.edges, graph.lanes
        left = lanes.primary & (lanes.node == 0) & (lanes.lane == -3)
        inside |= {start + frame for frame in lanes.frame[left].tolist()}
        rows = (of.relation == RELATION_CODE["leads"]) & (of.dst == 0)
        leads |= {*zip((start + of.frame[rows]).tolist(), of.src[rows].tolist(), strict=True)}
        start += len(graph)

    assert inside
    assert {src for frame, src in leads if frame in inside} == {2}


def test_blocks_wait_only_for_passages_and_long_ones_are_decided_in_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    way = drive("left")
    waiting = [*way[:35], *(way[35] for _ in range(120)), *way[35:]]
    read = 0

    def reading() -> Iterator[FrameBlock]:
        nonlocal read
        for block in blocks_of(waiting, 5):
            read += 1
            yield block

    def held() -> int:
        nonlocal read
        read, most = 0, 0
        generator = SceneGraphGenerator(town(), WIDE)
        for given, _ in enumerate(generator.recorded(reading())):
            most = max(most, read - given)
        return most

    assert held() >= 24
    monkeypatch.setattr("sgstore.graphs.relations._driven_lanes.MOST_STATES", 30)
    assert held() <= 8
    graphs = [primary(town(), recorded(town(), blocks_of(waiting, n))) for n in (7, 500)]
    assert graphs[0] == graphs[1]


def places(graph: SceneGraph) -> dict[str, bool | None]:
    """``is_primary`` of the ego's lanes; ``None`` is unknown."""
    names = {node: about.get("name", "") for node, about in graph.nodes.items()}
    lanes = [(b, about) for a, r, b, about in graph.edges if r == "isIn" and a == 0 and about]
    return {names[lane]: about.get("is_primary") for lane, about in lanes}


def test_online_the_primary_lane_is_unknown_while_ambiguous_and_then_stays() -> None:
    generator = SceneGraphGenerator(town(), WIDE)
    steps = [places(generator.step(frame_of(one))) for one in drive("left")]

    known = ["+".join(name for name, is_it in step.items() if is_it) for step in steps]
    assert runs(known) == ["in", "", "left", "north"]
    unknown = next(step for step, name in zip(steps, known, strict=True) if not name)
    assert unknown["left"] is unknown["straight"] is None


CROSS = crossroads()
MEETING = {
    way: Scene(
        CROSS,
        ego(through("s", way), 8, start=90),
        actor("v", through("s", way), 8, start=105),
        actor("w", through("s", {"n": "e", "e": "w", "w": "n"}[way]), 8, start=118),
        seconds=8,
        rate=5,
    )
    for way in "new"
}


@pytest.mark.seconds(10)
def test_a_monitor_never_contradicts_a_store_about_lanes_in_junctions(tmp_path: Path) -> None:
    role = "CHECK role: ALWAYS NOT EXISTS {(ego)-[:isIn]->(l:Lane) WHERE l.role <> 'Ego Lane'}"
    checks = f"{worldwide(LANE_RULES)};{role}"
    config = Config(range=RangeSettings(60, world=150))
    store = store_of(
        tmp_path / "s.sgstore",
        {way: [scene] for way, scene in MEETING.items()},
        dict.fromkeys(MEETING, config),
    )
    stored = {(one.check, one.trace): one.verdict for one in store.check(checks)}
    known = set[str]()
    for way, scene in MEETING.items():
        monitor = Monitor(checks, scene.road, config, trace=way, period_s=0.2)
        for frame in replayed([scene.block()]):
            monitor.step(frame)
        for one in monitor.finish():
            assert one.verdict in {stored[one.check, way], "unknown"}, (one.check, way)
            known |= {one.check} if one.verdict == stored[one.check, way] else set()
    assert {"led", "some_led", "ways", "left", "same", "one_lane", "followed"} <= known


def test_rules_of_r157_use_the_driven_lane_in_junctions(tmp_path: Path) -> None:
    turning = Scene(
        CROSS,
        ego(through("s", "n"), 6, start=108),
        actor("v", through("s", "w"), 6, start=118),
        seconds=6,
    )
    store = store_of(tmp_path / "s.sgstore", {"turning": [turning]})

    def frames(condition: str) -> set[int]:
        return {f.seq for f in store.find(f"MATCH (e:Ego), (v:Vehicle) WHERE {condition}").frames()}

    assert frames("same_lane(e, v) AND only_in_junction(v)")
    assert not frames("drives_same_lane(e, v) AND only_in_junction(v)")
    out = "NOT in_junction(e) AND NOT in_junction(v)"
    assert frames(f"drives_same_lane(e, v) AND {out}") == frames(f"same_lane(e, v) AND {out}")
    text = patterns()["r157_cut_in"].text
    assert "drives_same_lane" in text


@pytest.mark.parametrize(
    "pattern",
    [
        "(e:Ego), (v:Vehicle) WHERE lead(e, v)",
        "(e:Ego), (v:Vehicle) WHERE NOT lead(e, v) AND dist(e, v) < 30",
        "(e:Ego) WHERE COUNT {(v:Vehicle)-[:leads]->(e)} = 0",
        "(e:Ego) WHERE NOT turning_left(e) AND in_junction(e)",
        "(e:Ego) WHERE to_junction(e) IS NULL",
        "(e:Ego)-[at:isIn]->(l:Lane) WHERE NOT at.is_primary",
        "(e:Ego)-[at:isIn]->(l:Lane)<-[on:isIn]-(v:Vehicle) WHERE at.is_own AND on.is_own",
    ],
)
def test_a_monitored_pattern_has_no_match_by_a_guessed_lane(pattern: str, tmp_path: Path) -> None:
    text = f"MATCH {pattern}"
    store = store_of(tmp_path / "s.sgstore", {way: [scene] for way, scene in MEETING.items()})
    found = {(one.trace, one.seq) for one in store.find(text).frames()}
    for way, scene in MEETING.items():
        seen = set[tuple[str, int]]()
        events: list[MonitorEvent] = []
        monitor = Monitor(text, scene.road, trace=way, period_s=0.2, on_event=events.append)
        for frame in replayed([scene.block()]):
            monitor.step(frame)
        monitor.finish()
        seen.update((way, seq) for one in events for seq in range(one.start.seq, one.end.seq + 1))
        assert seen <= found


@pytest.mark.parametrize("length", [4.5, np.nan])
def test_a_leader_is_certain_if_another_vehicle_is_unsure(length: float) -> None:
    scene = Scene(
        CROSS,
        ego(through("s", "w"), 8, start=90),
        actor("v", through("n", "s"), 0.5, start=102),
        actor("w", through("n", "s"), 0.5, start=112),
        seconds=8,
        rate=5,
    )
    block = scene.block()
    lengths = np.where(block.states.node == 0, block.states.length, length)
    block = replace(block, states=replace(block.states, length=lengths))
    online, compared = SceneGraphGenerator(scene.road, Config()), 0
    for frame in replayed([block]):
        graph = online.step(frame)
        if graph.unsure_lane:
            assert graph.unsure_lane == graph.unsure_lead == {graph.ego}
            assert [(a, b) for a, relation, b, _ in graph.edges if relation == "leads"] == [(2, 1)]
            compared += 1
    assert compared > 5


@pytest.mark.parametrize("way", MEETING)
def test_results_of_driven_lanes_stay_in_a_turned_and_mirrored_world(way: str) -> None:
    scene = MEETING[way]

    for world, apart in oracle_turned.compare(
        scene.road, [scene.block()], oracle_turned.WORLDS[2:4]
    ).items():
        assert apart == [], world


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        *("carla/Town01.carla", "esmini/swarm_Town04", "esmini/traffic_lights"),
        "sumo/Town10HD_sumo_osi",
    ],
)
@pytest.mark.parametrize("until", [5.0, pytest.param(None, marks=pytest.mark.long)])
def test_a_monitor_never_contradicts_a_store_of_a_recording(
    data: Path, tmp_path: Path, name: str, until: float | None
) -> None:
    drive = Drive.of(data / "traces" / f"{name}.mcap", tmp_path, until)
    found = drive.compare_lanes(LANE_RULES)

    assert found["false", "false"] > (2 if until else 5)


@pytest.mark.data
@pytest.mark.seconds(5)
def test_derived_relations_use_the_same_lanes_as_the_ingest(data: Path, tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    ingest(path, [data / "traces/carla/Town01.carla.mcap"], jobs=1)
    derive(path, Config(), "again")
    same = (
        "SELECT count(*) FROM (SELECT {0} FROM inside.edge EXCEPT ALL SELECT {0} FROM inside.derived_edge)",
        "SELECT count(*) FROM (SELECT {0} FROM inside.derived_edge EXCEPT ALL SELECT {0} FROM inside.edge)",
    )
    columns = "relation, bucket, src, dst, mask"
    store = Store(path).file
    for sql in same:
        assert store.rows(sql.format(columns)).values == [(0,)]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "right"),
    [
        ("carla/Town01.carla", 0.99),
        pytest.param("esmini/swarm_Town04", 0.99, marks=pytest.mark.long),
        pytest.param("sumo/Town10HD_sumo_osi", 0.99, marks=pytest.mark.long),
    ],
)
@pytest.mark.seconds(20)
def test_the_driven_lane_is_right_in_recordings(
    data: Path, tmp_path: Path, name: str, right: float
) -> None:
    import oracle_driven_lanes as oracle

    path = data / "traces" / f"{name}.mcap"
    passages, road_map = oracle.passages_of(path)
    (outcome,) = ingest(tmp_path / "s.sgstore", [path], config=oracle.WIDE, jobs=1)
    found = oracle.measured(Store(tmp_path / "s.sgstore"), outcome.name, passages, road_map)

    assert found.frames > 400
    assert found.share >= right, found
    assert min(found.precision, found.recall) >= 0.98, found
