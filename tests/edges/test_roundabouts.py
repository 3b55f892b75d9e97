"""Roundabouts: which lanes are in them, in each format, and how far it is to them, wherever it is asked."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from builders import Recording, thing
from graph_blocks import trace_info
from roundabouts import MIDDLE, circling, driven, lanelets, opendrive, roundabout, sumo_net
from scenes import Scene, actor, ego, store_of
from test_lane_dist import driven as by_dijkstra
from test_lane_dist import lane_ways
from thorough import LONG, some

from sgstore.graphs.online import Frame
from sgstore.lang.memory import FrameView
from sgstore.maps.lanelet2 import lanelet2_text
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import read_lane_text
from sgstore.maps.sumo_net import sumo_net_text
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import KIND_CODE, RELATION_CODE
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.temporal import MonitorEvent

WIDE = Config(range=RangeSettings(500))


def around(road_map: RoadMap) -> dict[str, set[str]]:
    """Roundabouts by name, and the lanes that are in their roads."""
    nodes, edges = road_map.nodes, road_map.edges
    inside = edges.relation == RELATION_CODE["isIn"]
    pairs = [
        *zip((-1 - edges.src[inside]).tolist(), (-1 - edges.dst[inside]).tolist(), strict=True)
    ]
    return {
        nodes.name[column]: {
            nodes.name[lane]
            for road, at in pairs
            if at == column
            for lane, of in pairs
            if of == road
        }
        for column in np.flatnonzero(nodes.kind == KIND_CODE["roundabout"]).tolist()
    }


CIRCLE = {"1/0/-1", "2/0/-1", *(f"{number}{i}/0/-1" for number in (1, 2) for i in range(3))}
"""Halves of the circle, and the ways through both junctions."""


def test_in_opendrive_a_group_of_junctions_is_one_with_the_roads_between_them() -> None:
    assert around(roundabout()) == {"7": CIRCLE}
    assert around(roundabout("unknown")) == {}
    assert around(read_map(opendrive().replace('type="roundabout"', ""), "none")) == {}


def test_in_a_network_of_sumo_its_edges_and_nodes_are_told() -> None:
    told = '<roundabout nodes="S N" edges="east west"/>'
    lanes = around(read_lane_text(sumo_net_text(sumo_net(told)), "net"))
    assert lanes == {"S": {"east_0", "west_0", ":S_0_0", ":S_1_0", ":N_0_0", ":N_1_0"}}
    assert around(read_lane_text(sumo_net_text(sumo_net()), "net")) == {}


def test_in_a_lanelet2_map_it_is_a_regulatory_element_of_autoware() -> None:
    text, inside = lanelets()
    assert [*around(read_lane_text(lanelet2_text(text), "map")).values()] == [inside]
    assert around(read_lane_text(lanelet2_text(lanelets("right_of_way")[0]), "map")) == {}


@pytest.mark.data
def test_maps_without_any_have_none(data: Path) -> None:
    for path in sorted((data / "maps").glob("fab*.xodr")):
        assert around(read_map(path.read_text(), path.stem)) == {}


# How far it is, and who is in it ---------------------------------------------------------------------


def traffic(rng: np.random.Generator, cars: int, frames: int) -> list[list[Any]]:
    """Cars anywhere on the lanes."""
    ribbons = roundabout().ribbons
    found: list[list[Any]] = []
    for _ in range(frames):
        lane = rng.integers(0, len(ribbons), cars)
        points = ribbons.at(lane, rng.uniform(0, 1, cars) * ribbons.lengths[lane])
        places = enumerate(zip(points.x, points.y, points.heading, strict=True))
        found.append(
            [
                thing("ego" if n == 0 else f"c{n}", x, y, h, z=0.75, kind="car")
                for n, (x, y, h) in places
            ]
        )
    return found


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[list[Any]], Store]:
    cars, frames = (50, 110) if LONG else (10, 5)
    of_frames = traffic(np.random.default_rng(3), cars, frames)
    file = StoreFile.create(tmp_path_factory.mktemp("store") / "s.db")
    answers = ("isIn", "travelsTo")
    with file.segment(trace_info(), WIDE, road_map=roundabout(), answers=answers) as segment:
        kept = segment.as_kept(Recording().block(*of_frames))
        segment.append(SceneGraphGenerator(roundabout(), WIDE).block(kept))
        file.publish(segment.seal(TraceReport(frames=frames)))
    return of_frames, Store(file.path)


def test_the_language_the_graph_and_dijkstra_agree(world: tuple[list[list[Any]], Store]) -> None:
    of_frames, store = world
    text = (
        "MATCH (v:Car), (r:Roundabout) RETURN frame.id AS f, v.id AS v, to_roundabout(v) AS next,"
        " lane_dist(v, r) AS far, r.id AS r, in_roundabout(v) AS inside, EXISTS {(v)-[:isIn*3]->(r)} AS path"
    )
    rows = store.find(text).rows()
    assert len(rows) == sum(map(len, of_frames))
    road_map = roundabout()
    ways, names = lane_ways(road_map), road_map.nodes.name
    ring = [names.index(name) - 1 for name in CIRCLE]
    lengths = road_map.ribbons.lengths
    graphs = {frame: store.file.graph(frame) for frame in {row.f for row in rows}}
    views = {frame: FrameView(graph) for frame, graph in graphs.items()}
    told = 0
    for row in rows:
        graph, view = graphs[row.f], views[row.f]
        places = [(-2 - lane, along) for lane, along in graph.places()[row.v]]
        inside = any(lane in ring for lane, _ in places)
        ahead = [by_dijkstra(ways, one, (lane, 0.0)) for one in places for lane in ring]
        back = [by_dijkstra(ways, (lane, lengths[lane]), one) for one in places for lane in ring]
        wanted = 0.0 if inside else min(ahead)
        assert row.next == (pytest.approx(wanted, abs=1e-4) if wanted <= 200 else None)
        assert (
            row.next
            == graph.to_next(row.v, "roundabout")
            == view.pair("to_roundabout", row.v, row.v)
        )
        if not inside:
            wanted = min(ahead) if min(ahead) <= min(back) else -min(back)
        assert row.far == (pytest.approx(wanted, abs=1e-4) if abs(wanted) <= 200 else None)
        assert row.far == graph.lane_dist(row.v, row.r) == view.pair("part_dist", row.v, row.r)
        touched = {
            dst for src, relation, dst, _ in graph.edges if src == row.v and relation == "isIn"
        }
        assert row.inside == row.path == any(-2 - lane in ring for lane in touched)
        told += row.far is not None
    assert told > len(rows) / 2


DRIVE = Scene(
    roundabout(),
    ego(driven(1.0), [(0, 9), (6, 6), (40, 6)], start=30),
    actor("w", circling(-180, 3.0), 7),
    seconds=30,
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = store_of(tmp_path_factory.mktemp("drive") / "s.db", {"drive": [DRIVE]})
    with store.file.snapshot():
        yield store


def test_who_drives_in_and_out_again_is_in_it_in_between(drive: Store) -> None:
    rows = drive.find(
        "MATCH (e:Ego) RETURN frame.t AS t, e.x AS x, e.y AS y, to_roundabout(e) AS far,"
        " in_roundabout(e) AS inside"
    ).rows()

    times = [row.t for row in rows if row.inside]
    assert [row.t for row in rows if times[0] <= row.t <= times[-1]] == times
    for row in rows:
        radius = math.hypot(row.x, row.y)
        assert row.inside == (radius < 42.3) or abs(radius - 42.3) < 0.3  # by half a car's length
        if row.y < -41:
            assert row.far == pytest.approx(-40 - row.y, abs=0.05)
        elif row.y > 41 and row.t > times[-1]:
            assert row.far is None
    entered = drive.find(
        "MATCH (e:Ego) WHERE NOT in_roundabout(e) AND EXISTS {(w:Vehicle) WHERE in_roundabout(w)} AS out"
        " THEN IMMEDIATELY MATCH (e) WHERE in_roundabout(e) AS inside RETURN t(inside) AS t"
    ).rows()
    assert [row.t for row in entered] == times[:1]


def test_a_monitor_tells_what_a_store_answers(drive: Store) -> None:
    text = (
        "MATCH (e:Ego), (v:Vehicle) WHERE to_roundabout(e) < 60 AND in_roundabout(v) AND dist(v, e) < 30"
        " RETURN MIN(to_roundabout(e)) OVER match AS nearest"
    )
    events: list[MonitorEvent] = []
    monitor = Monitor(text, DRIVE.road, Config(), on_event=events.append)
    for frame in drive.find("MATCH (e:Ego)").frames():
        graph = drive.file.graph(frame.frame_id)
        made = Frame(graph.time_ns, graph.ego)
        for node, about in graph.nodes.items():
            if about["kind"] == "car":
                names = ("length", "width", "height", "heading", "vx", "vy")
                told = {name: about[name] for name in names}
                made.add(node, "car", about["x"], about["y"], about["z"], **told)
        monitor.step(made)
    monitor.finish()
    rows = drive.find(f"{text}, v.id, INTERVALS").rows()

    # Online, a match ends in frames whose driven lane is unsure, and begins again.
    nearest = {round(row.nearest, 3) for row in rows}
    assert {round(event.values["nearest"], 3) for event in events} == nearest
    assert len(events) >= len(rows) > 0


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("MATCH (e:Ego), (r:Roundabout) WHERE at(e, r)", 100),
        ("MATCH (v:Car)-[:isIn*3]->(r:Roundabout) WHERE v.is_ego AND known(curvature(v))", 100),
        ("MATCH (e:Ego) WHERE in_roundabout(e) AND NOT in_junction(e)", 50),
        ("MATCH (j:Junction)<-[:isIn]-(:Road)-[:isIn]->(r:Roundabout), (e:Ego)-[:isIn*3]->(j)", 10),
    ],
)
def test_it_stands_in_patterns_as_a_junction_does(drive: Store, text: str, frames: int) -> None:
    found = {frame.frame_id for frame in drive.find(text).frames()}
    assert len(found) > frames

    for frame in some([*drive.find("MATCH (:Ego)").frames()], 7):
        assert (drive.why_not(frame.frame_id, text).as_dict()["failed"] is None) == (
            frame.frame_id in found
        )


def test_the_lane_around_has_the_radius_that_was_drawn(drive: Store) -> None:
    rows = drive.find(
        "MATCH (v:Car) WHERE in_roundabout(v) AND NOT in_junction(v) RETURN curvature(v) AS c, slope(v) AS s"
    ).rows()
    bends = [row.c for row in rows]
    assert np.median(bends) == pytest.approx(1 / MIDDLE, rel=1e-3)
    assert {row.s for row in rows} == {None}
