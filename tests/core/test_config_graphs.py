"""Whatever the settings are, graphs are whole: every edge ends at nodes that are there, and is there once."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import REPOSITORY
from test_online import columns, shown

from sgstore.apps.demo import RECORDING
from sgstore.graphs.online import Replay
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, configured
from sgstore.model.vocabulary import (
    DIRECTIONS,
    PROXIMITY,
    RELATION_CODE,
    RELATIONS,
    SIDES,
    TypeMeaning,
    kinds_labelled,
)
from sgstore.model.vocabulary import KINDS as ALL_KINDS
from sgstore.query import Store
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator, map_of_graphs
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import FrameBlock

CHOICES: dict[str, dict[str, list[Any]]] = {
    "range": {
        "shape": ["radius", "rectangle", "polygon", "corridor"],
        "polygon": [[[40, 0], [-10, 18], [-10, -18]]],
        "height": [[], [-1, 1]],
        "by": ["footprint", "centre"],
    },
    "lanes": {
        "granularity": ["none", "lane", "waypoint"],
        "sections": [True, False],
        "types": [[], ["driving"]],
        "ahead": [0, 60],
    },
    "proximity": {"between": ["centres", "origins", "footprints"]},
    "direction": {"ties": ["ahead", "both", "carlasgg"], "sides": ["open", "closed", "none"]},
    "pairs": {
        "ego": [True, False],
        "within": [0, 25],
        "static": [False, True],
        "kinds": [[], [["Vehicle", "Person"], ["Ego", "Entity"]]],
    },
}
KINDS: list[list[str]] = [[], ["Vehicle", "Lane", "Waypoint"], ["Entity"], ["Person", "Road"]]


def any_config(seed: int) -> Config:
    rng = np.random.default_rng(seed)

    def one_of(choices: list[Any]) -> Any:
        return choices[int(rng.integers(len(choices)))]

    tables = {
        name: {key: one_of(values) for key, values in table.items()}
        for name, table in CHOICES.items()
    }
    without = [name for name in ("sees", "near", "isIn", "overlaps") if rng.random() < 0.2]
    return configured(**tables, kinds=one_of(KINDS), without=without)


@cache
def sample() -> tuple[list[FrameBlock], RoadMap]:
    with open_trace(REPOSITORY / "sgstore/apps/sample/town.mcap") as trace:
        return list(islice(trace.blocks(30), 2)), read_map(trace.info.map_text, "town")


def nodes_of(graph: GraphBlock) -> set[tuple[int, int]]:
    """Frames and nodes that are in a graph."""
    moving = zip(graph.frames.frame_of.tolist(), graph.frames.states.node.tolist(), strict=True)
    still = zip(graph.presence.frame.tolist(), graph.presence.node.tolist(), strict=True)
    return {*moving, *still}


@pytest.mark.parametrize("seed", range(24))
def test_every_edge_ends_at_nodes_and_is_there_once(seed: int) -> None:
    config, (blocks, road_map) = any_config(seed), sample()
    config = replace(
        config,
        proximity=replace(config.proximity, kinds=(("Vehicle", "Person"),) * (seed % 2)),
        direction=replace(config.direction, within=12.0 * (seed % 3), kinds=(("Ego", "Entity"),)),
    )
    generator, shown = SceneGraphGenerator(road_map, config), map_of_graphs(road_map, config)
    assert shown is not None
    for block in blocks:
        graph = generator.block(block)
        nodes, edges = nodes_of(graph), graph.edges
        table = np.column_stack([edges.frame, edges.relation, edges.src, edges.dst])

        assert len(np.unique(table, axis=0)) == len(table)
        of = graph.lanes
        ends = ((edges.frame, edges.src), (edges.frame, edges.dst), (of.frame, of.lane))
        for frame, end in (*ends, (of.frame, of.node)):
            assert set(zip(frame.tolist(), end.tolist(), strict=True)) <= nodes
        assert min((node for _, node in nodes), default=0) >= -len(shown.nodes)
        assert {RELATIONS[code] for code in edges.relation.tolist()} <= set(generator.answers)
        in_lanes = table[edges.relation == RELATION_CODE["isIn"]][:, [0, 2, 3]].tolist()
        states = zip(of.frame.tolist(), of.node.tolist(), of.lane.tolist(), strict=True)
        assert {*states} <= set(map(tuple, in_lanes))


@pytest.mark.parametrize("seed", range(6))
def test_frames_one_by_one_give_the_same_whatever_the_settings(seed: int) -> None:
    config, (blocks, road_map) = any_config(100 + seed), sample()
    with open_trace(REPOSITORY / "sgstore/apps/sample/town.mcap") as trace:
        few = list(islice(trace.blocks(7), 4))

    def edges_of(parts: list[FrameBlock]) -> list[tuple[int, ...]]:
        generator, found = SceneGraphGenerator(road_map, config), []
        for part in parts:
            of = generator.block(part).edges
            seq = part.seq[of.frame]
            columns = (column.tolist() for column in (seq, of.relation, of.src, of.dst))
            found += list(zip(*columns, strict=True))
        return sorted(found)

    last = few[-1].seq[-1]
    assert edges_of(few) == [edge for edge in edges_of(blocks[:1]) if edge[0] <= last]


@pytest.mark.parametrize("seed", range(8))
def test_steps_give_what_blocks_give_whatever_the_settings(seed: int) -> None:
    types = {"TYPE_PEDESTRIAN": TypeMeaning("animal", "service", "dog")}
    config, (blocks, road_map) = replace(any_config(200 + seed), types=types), sample()
    offline, online = (SceneGraphGenerator(road_map, config) for _ in range(2))
    replay, idents = Replay(), list(blocks[0].entities.ident)

    graph = offline.block(blocks[0])
    steps = [online.step(frame) for frame in replay.frames(blocks[0])]

    for row, step in enumerate(steps):
        assert shown(step) == columns(graph, row, idents)
    kinds = {attributes["kind"] for step in steps for attributes in step.nodes.values()}
    assert "person" not in kinds


def rows(graph: GraphBlock, names: tuple[str, ...]) -> set[tuple[int, str, int, int]]:
    """The edges of some relations, as frame, relation, source and destination."""
    of = graph.edges
    columns = (of.frame, of.relation, of.src, of.dst)
    found = (
        (f, RELATIONS[r], s, d) for f, r, s, d in zip(*map(np.ndarray.tolist, columns), strict=True)
    )
    return {row for row in found if row[1] in names}


def test_each_ladder_has_pairs_and_a_reach_of_its_own() -> None:
    blocks, road_map = sample()
    block, bearings = blocks[0], (*DIRECTIONS, *SIDES)
    narrow = configured(
        proximity={"kinds": [["Person", "Ego"], ["Car", "Car"]]},
        direction={"kinds": [["Ego", "Vehicle"]], "within": 12},
    )
    every, some = (SceneGraphGenerator(road_map, one).block(block) for one in (Config(), narrow))
    kinds, states, frame = block.entities.kind, block.states, block.frame_of
    place = {
        (f, n): (x, y, z)
        for f, n, x, y, z in zip(
            frame.tolist(), states.node.tolist(), states.x, states.y, states.z, strict=True
        )
    }
    ego = dict(enumerate(block.ego.tolist()))

    def labelled(f: int, node: int, label: str) -> bool:
        return (
            node == ego[f]
            if label == "Ego"
            else ALL_KINDS[kinds[node]] in (kinds_labelled(label) or ())
        )

    def listed(f: int, a: int, b: int, pairs: tuple[tuple[str, ...], ...]) -> bool:
        return any(
            (labelled(f, a, one) and labelled(f, b, other))
            or (labelled(f, b, one) and labelled(f, a, other))
            for one, other in pairs
        )

    near = {r for r in rows(every, PROXIMITY) if listed(r[0], r[2], r[3], narrow.proximity.kinds)}
    seen = {
        r
        for r in rows(every, bearings)
        if listed(r[0], r[2], r[3], narrow.direction.kinds)
        and {r[:1] + r[2:3], r[:1] + r[3:]} <= place.keys()
        and math.dist(place[r[0], r[2]], place[r[0], r[3]]) <= 12
    }
    assert rows(some, PROXIMITY) == near
    assert {
        r for r in rows(some, bearings) if {r[:1] + r[2:3], r[:1] + r[3:]} <= place.keys()
    } == seen
    assert 0 < len(near) < len(rows(every, PROXIMITY))
    assert 0 < len(seen) < len(rows(every, bearings))


def test_entities_are_left_out_by_their_ids() -> None:
    blocks, road_map = sample()
    block, still = blocks[0], ("leads", "follows", "sees")  # others come in their places
    idents, ego = block.entities.ident, int(block.ego[0])
    gone = {n for n in range(len(idents)) if n % 5 == 1 and n != ego}
    config = Config(exclude_ids=(*(idents[n] for n in gone), idents[ego], "nobody"))
    every, some = (SceneGraphGenerator(road_map, one).block(block) for one in (Config(), config))

    assert nodes_of(some) == {(f, n) for f, n in nodes_of(every) if n not in gone}
    others = tuple(name for name in RELATIONS if name not in still)
    assert rows(some, others) == {r for r in rows(every, others) if not gone & {*r[2:]}}
    assert len(nodes_of(some)) < len(nodes_of(every))


def test_entities_are_left_out_of_a_store_through_ingest(tmp_path: Path) -> None:
    StoreFile.create(tmp_path / "s.db")
    (first,) = ingest(tmp_path / "s.db", [RECORDING], until=1.0)
    store = Store(tmp_path / "s.db")
    ((ident,),) = store.sql(
        "SELECT ident FROM entities WHERE kind = 'car' AND node_id <> 0 LIMIT 1"
    ).values
    config = Config(exclude_ids=(str(ident),))
    (second,) = ingest(tmp_path / "s.db", [RECORDING], until=1.0, config=config, force=True)

    assert first.error is None
    assert second.error is None
    there = (
        f"SELECT count(*) FROM nodes JOIN entities USING (node_id) WHERE nodes.ident = '{ident}'"
    )
    assert Store(tmp_path / "s.db").sql(there).values == [(0,)]


@pytest.mark.usefixtures("own_names")
def test_a_name_that_is_all_but_a_built_in_one_is_noted(tmp_path: Path) -> None:
    StoreFile.create(tmp_path / "s.db")
    slip = configured(proximity={"names": ["near_col", "yonder"], "upper": [4, 50]})
    (outcome,) = ingest(tmp_path / "s.db", [RECORDING], until=1.0, config=slip)

    assert outcome.error is None
    assert [note for note in outcome.warnings if "proximity" in note] == [
        "setting 'proximity.names': 'near_col' would be a new relation; did you mean 'near_coll'?"
    ]
    assert Config().notes == []
