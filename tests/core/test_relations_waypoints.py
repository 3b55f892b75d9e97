"""Waypoints: a map with them, what a body is at, and which of them are in a graph."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
import shapely
from builders import Place, frames, thing
from test_sgg_traces import opened, recording

from sgstore.errors import ConfigError
from sgstore.graphs.relations import waypoints_of
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, LaneSettings, RangeSettings, configured
from sgstore.model.vocabulary import KIND_CODE, RELATION_CODE
from sgstore.sgg import SceneGraphGenerator, map_of_graphs

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

PI = math.pi
WIDTH = '<width sOffset="0" a="3" b="0" c="0" d="0"/>'
CENTRE = '<center><lane id="0" type="none"/></center>'
ROAD = f"""<OpenDRIVE><header revMajor="1" revMinor="6"/>
  <road id="7" length="LENGTH" junction="-1">
    <link><successor elementType="road" elementId="8" contactPoint="start"/></link>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="LENGTH"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving">{WIDTH}</lane></left>{CENTRE}
      <right><lane id="-1" type="driving"><link><successor id="-1"/></link>{WIDTH}</lane>
      <lane id="-2" type="sidewalk">{WIDTH}</lane></right>
    </laneSection></lanes></road>
  <road id="8" length="20" junction="-1">
    <link><predecessor elementType="road" elementId="7" contactPoint="end"/></link>
    <planView><geometry s="0" x="LENGTH" y="0" hdg="0" length="20"><arc curvature="0.05"/></geometry>
    </planView><lanes><laneSection s="0">{CENTRE}
      <right><lane id="-1" type="driving"><link><predecessor id="-1"/></link>{WIDTH}</lane></right>
    </laneSection></lanes></road></OpenDRIVE>"""


def road(length: float = 10.5) -> RoadMap:
    return read_map(ROAD.replace("LENGTH", str(length)), "road")


def with_points(spacing: float, **lanes: object) -> Config:
    return Config(lanes=LaneSettings(granularity="waypoint", spacing=spacing, **lanes))


def names(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    of, code = road_map.edges, RELATION_CODE[relation]
    rows = of.relation == code
    pairs = zip(of.src[rows].tolist(), of.dst[rows].tolist(), strict=True)
    return {(road_map.nodes.name[-1 - a], road_map.nodes.name[-1 - b]) for a, b in pairs}


def test_waypoints_stand_along_the_lanes_for_motor_traffic() -> None:
    town = map_of_graphs(road(), with_points(4))

    assert town is not None
    nodes = town.nodes
    points = [i for i, kind in enumerate(nodes.kind) if kind == KIND_CODE["waypoint"]]
    assert [nodes.name[i] for i in points if nodes.road[i] == "7"] == [
        *("7/0/1@0", "7/0/1@4", "7/0/1@8"),
        *("7/0/-1@0", "7/0/-1@4", "7/0/-1@8"),
    ]
    assert nodes.x[points[:3]] == pytest.approx([10.5, 6.5, 2.5])  # against the road
    assert nodes.x[points[3:6]] == pytest.approx([0, 4, 8])
    assert nodes.y[points[:6]] == pytest.approx([1.5] * 3 + [-1.5] * 3)
    assert nodes.heading[points[:6]] % (2 * PI) == pytest.approx([PI] * 3 + [0] * 3)
    assert nodes.length[points[3:6]] == pytest.approx([2, 4, 4.5])


def test_nodes_that_were_there_keep_their_ids_and_it_is_another_map() -> None:
    plain = road()
    town, finer = (map_of_graphs(plain, with_points(spacing)) for spacing in (4, 2))

    assert town is not None
    assert finer is not None
    assert town.nodes.name[: len(plain.nodes)] == plain.nodes.name
    assert len({plain.digest, town.digest, finer.digest}) == 3
    assert town.text == plain.text
    assert map_of_graphs(plain, with_points(4)) is not plain
    assert map_of_graphs(plain, Config()) is plain


def test_waypoints_lead_on_from_lane_to_lane() -> None:
    town = map_of_graphs(road(), with_points(4))

    assert town is not None
    points = {edge for edge in names(town, "travelsTo") if "@" in edge[0] + edge[1]}
    assert points == {
        *(("7/0/1@0", "7/0/1@4"), ("7/0/1@4", "7/0/1@8")),
        *(("7/0/-1@0", "7/0/-1@4"), ("7/0/-1@4", "7/0/-1@8"), ("7/0/-1@8", "8/0/-1@0")),
        *((f"8/0/-1@{a}", f"8/0/-1@{a + 4}") for a in (0, 4, 8, 12, 16)),
    }
    assert {a.partition("@")[0] == b for a, b in names(town, "isIn") if "@" in a} == {True}


def test_a_waypoint_has_the_curvature_of_its_lane() -> None:
    town = map_of_graphs(road(), with_points(4))

    assert town is not None
    points = {
        name: curvature
        for name, curvature in zip(town.nodes.name, town.nodes.curvature, strict=True)
        if not math.isnan(curvature)
    }
    assert points["7/0/-1@4"] == pytest.approx(0)
    assert points["8/0/-1@8"] == pytest.approx(1 / (20 + 1.5), rel=0.02)  # on the outside
    assert all("@" in name for name in points)


def test_lanes_of_types_that_are_not_kept_have_no_waypoints() -> None:
    town = map_of_graphs(road(), with_points(4, types=("sidewalk",)))

    assert town is not None
    assert KIND_CODE["waypoint"] not in town.nodes.kind


def test_more_waypoints_than_a_graph_can_bear_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"lanes\.spacing.*at most 500,000"):
        SceneGraphGenerator(road(90_000), with_points(0.1))


# What a body is at ------------------------------------------------------------------------------


def at(what: object, spacing: float = 2, config: Config | None = None) -> set[str]:
    """Waypoints that the ego is at."""
    from builders import edges, frames, graph_of

    config = config or with_points(spacing)
    plain = road()
    town = map_of_graphs(plain, config)
    of = edges(graph_of(frames([what]), plain, config), 0, town)
    return {dst for src, relation, dst in of if src == "ego" and "@" in dst}


@pytest.mark.parametrize(
    ("what", "where"),
    [
        pytest.param(thing("ego", 5, -1.5, length=1), {4, 6}, id="on a bound: both sides"),
        pytest.param(thing("ego", 4, -1.5, length=1), {4}, id="on one"),
        pytest.param(thing("ego", 4, -1.5, length=4), {2, 4, 6}, id="on three"),
        pytest.param(thing("ego", 4, -1.5, PI / 2, length=4, width=1), {4}, id="across the lane"),
        pytest.param(thing("ego", 4, -1.5, length=math.nan), {4}, id="a point"),
        pytest.param(thing("ego", -1, -1.5, length=3), {0}, id="half before the lane"),
        pytest.param(thing("ego", 10.4, -3, length=0.1), {10}, id="at the end"),
    ],
)
def test_a_body_is_at_the_waypoints_whose_stretches_it_covers(
    what: object, where: set[int]
) -> None:
    assert {n for n in at(what) if n.startswith("7/0/-1")} == {f"7/0/-1@{k}" for k in where}


def test_a_body_astride_is_at_the_waypoints_of_both_lanes() -> None:
    assert at(thing("ego", 4, 0, length=0.8)) == {"7/0/-1@4", "7/0/1@6"}


@pytest.mark.data
def test_on_a_recording_it_is_about_what_boxes_around_waypoints_tell(data: Path) -> None:
    """The textbook's way: each waypoint has a box of the lane's width, as long as the spacing."""
    blocks, plain = opened(recording(data, "esmini/swarm_Town04"))
    assert plain is not None
    lanes = LaneSettings(granularity="waypoint", spacing=2.0)
    config = Config(range=RangeSettings(radius=300), lanes=lanes)
    town = map_of_graphs(plain, config)
    assert town is not None
    nodes = town.nodes
    points = np.flatnonzero(nodes.kind == KIND_CODE["waypoint"])
    half, wide = nodes.length[points] / 2, nodes.width[points] / 2
    generator = SceneGraphGenerator(plain, config)
    graph = [generator.block(block) for block in blocks][-1]
    first = nodes.kind.tolist().index(KIND_CODE["waypoint"])
    states, equal, total = graph.frames.states, 0, 0
    for row in range(0, len(states), 17):
        frame = int(graph.frames.frame_of[row])
        edges = graph.edges
        mine = (edges.frame == frame) & (edges.src == states.node[row])
        found = set((-1 - edges.dst[mine & (edges.dst < -first)]).tolist())
        size = shapely.box(
            *(sign * v / 2 for sign in (-1, 1) for v in (states.length[row], states.width[row]))
        )
        body = Place(states.x[row], states.y[row], states.heading[row]).placed(size)
        near = np.hypot(nodes.x[points] - states.x[row], nodes.y[points] - states.y[row]) < 12
        boxes = {
            int(points[i])
            for i in np.flatnonzero(near)
            if Place(nodes.x[points[i]], nodes.y[points[i]], nodes.heading[points[i]])
            .placed(shapely.box(-half[i], -wide[i], half[i], wide[i]))
            .intersects(body)
            and abs(nodes.z[points[i]] - states.z[row] + states.height[row] / 2) < 2.5
        }
        total += len(found | boxes)
        equal += len(found & boxes)
    assert total > 100
    assert equal > 0.9 * total


@pytest.mark.data
def test_waypoints_in_range_are_present_and_lead_on(data: Path) -> None:
    blocks, plain = opened(recording(data, "esmini/swarm_Town04"))
    config = Config(
        range=RangeSettings(radius=30), lanes=LaneSettings(granularity="waypoint", spacing=1.0)
    )
    town = map_of_graphs(plain, config)
    assert town is not None
    assert plain is not None
    points = waypoints_of(plain, config.lanes)
    assert points is not None
    graph = SceneGraphGenerator(plain, config).block(blocks[0])
    nodes, states = town.nodes, graph.frames.states
    ego = np.flatnonzero(states.node == graph.frames.ego[graph.frames.frame_of])
    for frame in range(0, len(graph), 13):
        there = graph.presence.node[graph.presence.frame == frame]
        present = {
            i for i in (-1 - there[there < 0]).tolist() if nodes.kind[i] == KIND_CODE["waypoint"]
        }
        x, y = states.x[ego[frame]], states.y[ego[frame]]
        waypoint = nodes.kind == KIND_CODE["waypoint"]
        around = np.flatnonzero(waypoint & (np.hypot(nodes.x - x, nodes.y - y) <= 30))
        assert set(around.tolist()) <= present
        assert len(present - set(around.tolist())) < 60  # of bodies that reach beyond


def test_the_preset_carlasgg_keeps_waypoints() -> None:
    block = frames([thing("ego", 5, -1.5)])
    counts = {}
    for granularity in ("lane", "waypoint"):
        config = configured(preset="carlasgg", lanes={"granularity": granularity})
        graph = SceneGraphGenerator(road(), config).block(block)
        nodes = map_of_graphs(road(), config).nodes.kind[-1 - graph.presence.node]
        counts[granularity] = int((nodes == KIND_CODE["waypoint"]).sum())
    assert counts["lane"] == 0
    assert counts["waypoint"] > 20
