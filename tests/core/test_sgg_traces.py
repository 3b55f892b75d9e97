"""The generator on recordings as they really are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import pytest
from thorough import some

from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import OFF_ROAD
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import KIND_CODE, PROXIMITY, RELATION_CODE, VEHICLES
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import FrameBlock

RECORDINGS = [
    "carla/Town01.carla",
    "esmini/cut-in",
    "esmini/highway_merge",
    "esmini/pedestrian",
    "esmini/swarm_Town04",
    "esmini/traffic_lights",
    "omega_prime/osi_centerline_example",
    "sumo/Town10HD_sumo_osi",
]
recordings = pytest.mark.parametrize("name", RECORDINGS)
pytestmark = [pytest.mark.data, pytest.mark.seconds(8)]


@cache
def opened(path: Path) -> tuple[list[FrameBlock], RoadMap | None]:
    with open_trace(path) as trace:
        text = trace.info.map_text
        return list(islice(trace.blocks(), 4)), read_map(text, "map") if text else None


@cache
def graphs(path: Path) -> list[GraphBlock]:
    blocks, road_map = opened(path)
    generator = SceneGraphGenerator(road_map, Config())
    return [generator.block(block) for block in blocks]


def recording(data: Path, name: str) -> Path:
    return data / "traces" / f"{name}.mcap"


def rows(graph: GraphBlock, frame: int) -> dict[str, set[tuple[object, ...]]]:
    """What is in the graph of a frame."""
    of, lanes, there, gaps = graph.edges, graph.lanes, graph.presence, graph.gaps
    edge, lane, gap = of.frame == frame, lanes.frame == frame, gaps.frame == frame
    state = slice(graph.frames.offsets[frame], graph.frames.offsets[frame + 1])
    return {
        "states": set(graph.frames.states.node[state].tolist()),
        "presence": set(there.node[there.frame == frame].tolist()),
        "edges": set(zip(of.src[edge], of.relation[edge], of.dst[edge], strict=True)),
        "gaps": set(zip(gaps.src[gap], gaps.dst[gap], gaps.gap[gap], strict=True)),
        "lanes": {
            tuple(map(float, row))
            for row in zip(
                *(lanes.node[lane], lanes.lane[lane], lanes.overlap[lane]),
                *(lanes.offset[lane], lanes.heading_error[lane], lanes.primary[lane]),
                strict=True,
            )
        },
    }


def alone(block: FrameBlock, frame: int) -> FrameBlock:
    """One frame of a block; the first brings what the block introduces."""
    none = replace(block.entities, ident=(), map_ref=(), kind=np.zeros(0, np.int8))
    state = np.arange(block.offsets[frame], block.offsets[frame + 1])
    one = slice(frame, frame + 1)
    return replace(
        block,
        seq=block.seq[one],
        time_ns=block.time_ns[one],
        log_time_ns=block.log_time_ns[one],
        offsets=np.array([0, len(state)]),
        states=block.states.take(state),
        ego=block.ego[one],
        entities=none if frame else block.entities,
        scenery=block.scenery.take(np.arange(0)) if frame else block.scenery,
    )


@recordings
def test_frame_by_frame_gives_the_same_graphs(data: Path, name: str) -> None:
    path = recording(data, name)
    blocks, road_map = opened(path)
    online = SceneGraphGenerator(road_map, Config())

    for block, graph in zip(blocks, graphs(path), strict=True):
        for frame in some(range(len(block)), 7):  # two of them are neighbours where a block ends
            assert rows(online.block(alone(block, frame)), 0) == rows(graph, frame)


@recordings
def test_every_end_of_every_edge_is_a_node_of_the_frame(data: Path, name: str) -> None:
    for graph in graphs(recording(data, name)):
        for frame in range(len(graph)):
            of = rows(graph, frame)
            ends = {end for src, _, dst in of["edges"] for end in (src, dst)}
            assert ends <= of["states"] | of["presence"]


@recordings
def test_each_pair_is_in_one_distance_relation_at_most(data: Path, name: str) -> None:
    ladder = [RELATION_CODE[relation] for relation in PROXIMITY]

    for graph in graphs(recording(data, name)):
        of = graph.edges
        near = np.isin(of.relation, ladder)
        pairs = np.stack([of.frame[near], of.src[near], of.dst[near]])
        assert len(np.unique(pairs, axis=1).T) == near.sum()


@recordings
def test_lane_states_belong_to_edges_and_one_of_each_entity_is_primary(
    data: Path, name: str
) -> None:
    for graph in graphs(recording(data, name)):
        edges, lanes = graph.edges, graph.lanes
        within = (edges.relation == RELATION_CODE["isIn"]) & (edges.dst < OFF_ROAD)
        of_edges = set(zip(edges.frame[within], edges.src[within], edges.dst[within], strict=True))
        of_lanes = set(zip(lanes.frame, lanes.node, lanes.lane, strict=True))
        primary = list(zip(lanes.frame[lanes.primary], lanes.node[lanes.primary], strict=True))

        assert of_lanes <= of_edges
        assert len(primary) == len(set(primary))
        assert set(primary) == set(zip(lanes.frame, lanes.node, strict=True))


@recordings
def test_gaps_belong_to_edges_that_lead_and_follow(data: Path, name: str) -> None:
    for graph in graphs(recording(data, name)):
        of, gaps = graph.edges, graph.gaps
        leads, follows = (
            set(zip(of.frame[rows], of.src[rows], of.dst[rows], strict=True))
            for rows in (of.relation == RELATION_CODE[r] for r in ("leads", "follows"))
        )
        assert set(zip(gaps.frame, gaps.src, gaps.dst, strict=True)) == follows
        assert len(gaps) == len(follows)
        assert {(frame, b, a) for frame, a, b in follows} == leads


@recordings
def test_the_ego_sees_what_is_there_and_never_itself(data: Path, name: str) -> None:
    for graph in graphs(recording(data, name)):
        of, frames = graph.edges, graph.frames
        seen = of.relation == RELATION_CODE["sees"]
        assert (of.src[seen] == frames.ego[of.frame[seen]]).all()
        assert (of.src[seen] != of.dst[seen]).all()
        ends = np.stack([of.frame[seen], of.dst[seen]])
        assert len(np.unique(ends, axis=1).T) == seen.sum()


def test_vehicles_of_the_swarm_drive_in_driving_lanes(data: Path) -> None:
    path = recording(data, "esmini/swarm_Town04")
    generator = SceneGraphGenerator(opened(path)[1], Config(range=RangeSettings(1000)))
    vehicles, kinds = [KIND_CODE[kind] for kind in VEHICLES], np.zeros(0, np.int8)
    samples = off = 0
    with open_trace(path) as trace:
        for block in trace.blocks():
            kinds = np.append(kinds, block.entities.kind)
            graph = generator.block(block)
            samples += np.isin(kinds[graph.frames.states.node], vehicles).sum()
            stray = graph.edges.src[graph.edges.dst == OFF_ROAD]
            off += np.isin(kinds[stray], vehicles).sum()

    assert samples > 10_000
    assert off <= 0.03 * samples
