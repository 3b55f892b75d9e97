"""What lanes are to the ego: in queries, in memory and online as in the abstraction RSV."""

from __future__ import annotations

from importlib import resources
from itertools import islice
from typing import Any

import pytest
from matching import Matcher

from sgstore.graphs.online import Replay
from sgstore.lang.sql import compile_query
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

RECORDING = str(resources.files("sgstore") / "apps" / "sample" / "town.mcap")
INSIDE = "MATCH (x:Entity)-[:isIn]->(l:Lane) WHERE l.role IS NOT NULL"
BESIDE = "MATCH (x:Vehicle)-[:isIn]->(l:Lane {role: 'Right 1 of Ego Lane'})"


@pytest.fixture(scope="module")
def store(open_town: Any):
    return open_town


def test_lanes_have_the_roles_that_rsv_calls_them_by(store: Any) -> None:
    found: dict[int, set[tuple[int, str]]] = {}
    asked = f"{INSIDE} RETURN frame.id, x.id, x.is_ego, l.role"
    for frame, node, is_ego, role in store.find(asked):
        found.setdefault(frame, set()).add((-1 if is_ego else node, role))

    for seq in range(0, 750, 25):
        graph = store.graph(f"town#{seq}", abstraction="RSV")
        wanted = {
            (-1 if entity == "ego" else int(entity.rpartition("_")[2]), lane)
            for entity, lane, label in graph.edges(data="label")
            if label == "isIn" and lane not in {"Root Road", "Off Road", "Lane"}
        }
        traffic = {node for node, _ in wanted}
        got = found.get(graph.graph["frame_id"], set())
        assert {(node, role) for node, role in got if node in traffic} == wanted


def test_a_role_is_asked_by_property_by_condition_and_by_return_alike(store: Any) -> None:
    by_property = store.find(BESIDE).rows()
    by_condition = store.find(
        "MATCH (x:Vehicle)-[:isIn]->(l:Lane) WHERE l.role = 'Right 1 of Ego Lane'"
    ).rows()
    in_sql = store.sql(
        "SELECT count(*) FROM edges e JOIN roles r ON r.frame_id = e.frame_id AND r.node_id = e.dst"
        " JOIN nodes n ON n.frame_id = e.frame_id AND n.node_id = e.src"
        " WHERE relation = 'isIn' AND role = 'Right 1 of Ego Lane' AND n.speed IS NOT NULL"
        " AND n.kind IN ('car', 'truck', 'bus', 'van', 'motorcycle', 'bicycle')"
    ).values[0][0]

    assert by_property == by_condition
    assert len(by_property) == in_sql > 0


def test_a_role_counts_in_blocks_and_under_the_abstraction(store: Any) -> None:
    block = "EXISTS {(x:Vehicle)-[:isIn]->(l:Lane {role: 'Right 1 of Ego Lane'})}"
    frames = {frame.frame_id for frame in store.find(BESIDE).frames()}

    assert {f.frame_id for f in store.find(f"MATCH (e:Ego) WHERE {block}").frames()} == frames
    seen = store.find(f"USING ABSTRACTION RSV {BESIDE}").frames()
    assert {frame.frame_id for frame in seen} == frames


def test_roles_in_memory_and_online_are_those_of_the_store(store: Any) -> None:
    query = compile_query(BESIDE, store.catalog(), {}).bound
    matcher = Matcher(query)
    replay, compared, held = Replay(), 0, 0
    with open_trace(RECORDING) as recording:
        road_map = read_map(recording.info.map_text, recording.info.map_name)
        online = SceneGraphGenerator(road_map, Config())
        for block in islice(recording.blocks(), 3):
            for frame in replay.frames(block):
                seq = online.step(frame).seq
                if seq % 10:
                    continue
                ref = store.file.frame(f"town#{seq}")
                assert online.roles_of() == store.file.abstracted.roles_of(ref.frame_id)
                held += matcher.holds(store._view(ref, query))
                compared += 1
    frames = {f.seq for f in store.find(BESIDE).frames() if f.seq % 10 == 0}
    assert compared > 10
    assert held == len({seq for seq in frames if seq < compared * 10})


def test_roles_are_verified_with_the_rest(store: Any) -> None:
    assert not store.file.verify().faults
    (named,) = store.sql(
        "SELECT count(*) FROM inside.manifest WHERE \"table\" = 'lane_role'"
    ).values
    assert named == (1,)
