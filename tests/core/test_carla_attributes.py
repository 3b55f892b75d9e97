"""Attributes without a column that CARLASGG has: markings of lanes, and text, unit and size of signs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from opendrive_maps import a_map, a_road, arc, element, lane, line, mark, section
from recordings import Recorder, car

import sgstore
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.config import configured
from sgstore.sgg import SceneGraphGenerator, map_of_graphs

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

SIGN = element(
    "signal",
    id="9",
    name="limit",
    s=60,
    t=-6,
    zOffset=2,
    orientation="+",
    dynamic="no",
    type="274",
    subtype="50",
    country="DE",
    value=50,
    unit="km/h",
    text="school",
    height=0.75,
    width=0.5,
)
TOWN = a_map(
    a_road(
        "1",
        line(100.0),
        sections=section(
            lane(1, mark("solid", color="yellow", width=0.2)),
            lane(0, mark("broken", s=30, laneChange="both"), mark("solid", laneChange="none")),
            lane(-1, mark("broken", color="white", width=0.12, laneChange="increase")),
            lane(-2),
        ),
        signals=SIGN,
    )
)
ASKED = ("type", "color", "width", "change")


@pytest.fixture(scope="module", params=[None, "carlasgg"])
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("marked")
    with Recorder(folder / "drive.mcap") as recorder:
        recorder.map(TOWN)
        for row in range(3):
            recorder.ground_truth(row / 10, [car(1, 40 + row, -1.75)], host=1)
    preset = {"preset": request.param} if request.param else {}
    (outcome,) = ingest(folder / "s.sgstore", [folder / "drive.mcap"], config=configured(**preset))
    assert outcome.error is None
    return sgstore.open(folder / "s.sgstore")


def marking(store: Store, number: int, side: str) -> tuple[object, ...]:
    items = ", ".join(f"l.{side}_marking_{name}" for name in ASKED)
    (row,) = store.find(f"MATCH (l:Lane) WHERE l.lane = {number} RETURN DISTINCT {items}").rows()
    return tuple(row)


def test_markings_of_each_side_are_those_of_its_traffic(store: Store) -> None:
    # The longest marking of a border counts; left and right are those of the traffic on the lane.
    assert marking(store, -1, "left") == ("broken", "standard", None, True)
    assert marking(store, -1, "right") == ("broken", "white", 0.12, False)
    assert marking(store, -2, "left") == ("broken", "white", 0.12, True)
    assert marking(store, -2, "right") == (None, None, None, None)
    assert marking(store, 1, "left") == ("broken", "standard", None, True)
    assert marking(store, 1, "right") == ("solid", "yellow", 0.2, False)


def test_waypoints_have_the_markings_beside_them(tmp_path: Path) -> None:
    with Recorder(tmp_path / "drive.mcap") as recorder:
        recorder.map(TOWN)
        recorder.ground_truth(0.0, [car(1, 40, -1.75)], host=1)
    config = configured(lanes={"granularity": "waypoint", "spacing": 10.0})
    ingest(tmp_path / "s.sgstore", [tmp_path / "drive.mcap"], config=config)
    marked = sgstore.open(tmp_path / "s.sgstore")

    def markings(side: str) -> dict[tuple[int, float], tuple[object, ...]]:
        items = ", ".join(f"w.{side}_marking_{name}" for name in ASKED)
        rows = marked.find(f"MATCH (w:Waypoint) RETURN DISTINCT w.x, w.y, {items}").rows()
        lanes = {1.75: 1, -1.75: -1, -5.25: -2}
        return {(lanes[round(y, 3)], round(x, 3)): tuple(of) for x, y, *of in rows}

    left, right = markings("left"), markings("right")
    # The middle line is solid up to 30 m, and broken from there.
    solid, broken = ("solid", "standard", None, False), ("broken", "standard", None, True)
    for number in (-1, 1):
        own = {x: of for (lane, x), of in left.items() if lane == number}
        assert own.items() >= {(x, solid if x < 30 else broken) for x in range(0, 90, 10)}
    white = ("broken", "white", 0.12)
    assert {of for (lane, _), of in right.items() if lane == -1} == {(*white, False)}
    assert {of for (lane, _), of in left.items() if lane == -2} == {(*white, True)}
    assert {of for (lane, _), of in right.items() if lane == -2} == {(None,) * 4}
    graph = marked.file.graph("drive#0")
    frame = sgstore.Frame(0, ego="1")
    frame.add("1", "car", 40, -1.75, heading=0, length=4, width=2)
    online = SceneGraphGenerator(read_map(TOWN, "town.xodr"), config).step(frame)
    for one in (graph, online):
        told = [a for a in one.nodes.values() if a["kind"] == "waypoint" and "@30" in a["name"]]
        assert len(told) == 3
        assert sum("left_marking_type" in about for about in told) == 3


def test_signs_have_text_unit_and_size(store: Store) -> None:
    query = (
        "MATCH (s:SpeedLimit) WHERE s.landmark_text = 'school' RETURN DISTINCT s.landmark_value,"
        " s.landmark_unit, s.landmark_height, s.landmark_width, s.landmark_type"
    )
    (row,) = store.find(query).rows()
    assert tuple(row) == (50.0, "km/h", 0.75, 0.5, "274")


def test_graphs_of_a_store_and_online_have_the_same_attributes(store: Store) -> None:
    config = configured(
        **({"preset": "carlasgg"} if not store.traces()[0].settings["sees"] else {})
    )
    frame = sgstore.Frame(0, ego="1")
    frame.add("1", "car", 40, -1.75, heading=0, length=4, width=2)
    road_map = read_map(TOWN, "town.xodr")
    online = SceneGraphGenerator(road_map, config).step(frame)
    stored = store.file.graph("drive#0")
    assert map_of_graphs(road_map, config) is not None
    told = [
        {
            about["name"]: {n: v for n, v in about.items() if "marking" in n or "landmark" in n}
            for node, about in graph.nodes.items()
            if node < 0
        }
        for graph in (online, stored)
    ]
    assert told[0] == told[1]
    assert sum(map(bool, told[0].values())) == 4
    assert store.file.verify().faults == []


# Abstractions of CARLASGG --------------------------------------------------------------------------

BEND = a_map(
    a_road(
        "1",
        line(50.0),
        arc(50.0, -0.06, s=50.0, x=50.0),
        sections=section(lane(1), lane(0), lane(-1), lane(-2)),
    )
)


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("bent")
    with Recorder(folder / "drive.mcap") as recorder:
        recorder.map(BEND)
        for row, (x, y) in enumerate([(20, -1.75), (40, -1.75), (55, -2.5)]):
            moving = [car(1, x, y), car(2, x + 8, -5.25), car(3, x - 18, 1.75)]
            recorder.ground_truth(row / 10, moving[: 3 if row == 0 else 1], host=1)
    config = configured(pairs={"within": 10.0, "ego_within": 10.0})
    (outcome,) = ingest(folder / "s.sgstore", [folder / "drive.mcap"], config=config)
    assert outcome.error is None
    return sgstore.open(folder / "s.sgstore")


def test_objects_without_a_relation_to_the_ego_can_be_left_out(bent: Store) -> None:
    every = {*bent.graph("drive#0", abstraction="RSV").nodes}
    related = {*bent.graph("drive#0", abstraction="RSV_related").nodes}
    # The far car has no relation; its lane is then empty.
    assert every - related == {"car_2", "Opposing Lane 0"}
    assert related == {"ego", "car_1", "Ego Lane", "Right 1 of Ego Lane", "Root Road"}
    alone = {*bent.graph("drive#1", abstraction="RSV_related").nodes}
    assert alone == {"ego", "Ego Lane", "Root Road"}


def test_the_name_of_the_egos_lane_has_its_curvature(bent: Store) -> None:
    names = [
        next(
            name
            for name in bent.graph(f"drive#{row}", abstraction="RSV_curvature")
            if name.startswith("Ego")
        )
        for row in range(3)
    ]
    # The inner lane turns by 7.7 degrees over 2 m to the right: four of five thresholds.
    assert names == ["Ego Lane@0", "Ego Lane@0", "Ego Lane@-4"]
