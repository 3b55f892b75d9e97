"""Relations can be made again from what a store holds: the same edges, to the last one."""

from __future__ import annotations

from dataclasses import fields
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from graph_blocks import RandomTrace
from hypothesis import given, settings
from hypothesis import strategies as st
from thorough import share_of

from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import KIND_CODE, RELATIONS
from sgstore.model.world import (
    BUCKET_FRAMES,
    Entities,
    FrameBlock,
    MessageRefs,
    Origin,
    States,
    number,
    origin_of,
    quantize,
)
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from sgstore.model.graph import GraphBlock

SAMPLE = Path(str(files("sgstore"))) / "apps" / "sample" / "town.mcap"
MORE_DATA = ("esmini/traffic_lights.mcap", "esmini/highway_merge.mcap")
FLOATS = [
    f.name
    for f in fields(States)
    if f.name not in {"node", "lights", "light_state", "derived", "lane"}
]
DRIVEN = """
SELECT frame_id, node_id,
       any_value(lane) FILTER (is_primary) * if(count(*) FILTER (is_own) = 1, 1, -1) AS lane
FROM inside.lane_state GROUP BY ALL"""
"""The primary lane of each state; positive if it is not the only own lane."""


def states_of(columns: dict[str, Any], origin: dict[str, float]) -> States:
    """States as the tables hold them."""
    known = {
        name: np.ma.filled(np.ma.asarray(columns[name], np.float64), np.nan)
        for name in FLOATS
        if name in columns
    }
    for axis in ("x", "y", "z"):
        known[axis] = known[axis] + origin[axis]
    lane = np.ma.filled(columns.get("lane", np.zeros(len(columns["node_id"]), np.int64)), 0)
    return States.of(node=columns["node_id"].astype(np.int64), lane=lane.astype(np.int64), **known)


def read_back(store: StoreFile) -> list[FrameBlock]:
    """The frames of the only trace of a store, as blocks of a bucket each."""
    (place,) = store.rows(
        "SELECT origin_x AS x, origin_y AS y, origin_z AS z FROM inside.trace"
    ).dicts()
    frames = store.arrays(
        "SELECT seq, time_ns, log_time_ns, coalesce(ego, -1) AS ego FROM inside.frame ORDER BY seq"
    )
    state = store.arrays(
        "SELECT * EXCLUDE (kind, light_state) FROM inside.state"
        f" LEFT JOIN ({DRIVEN}) USING (frame_id, node_id) ORDER BY frame_id, node_id"
    )
    entity = store.arrays(
        "SELECT * REPLACE (kind::VARCHAR AS kind, coalesce(map_ref, '') AS map_ref)"
        " FROM inside.entity ORDER BY node_id"
    )
    seq = (state["frame_id"] >> 6) % (1 << 18) * BUCKET_FRAMES + state["frame_id"] % 64
    rows = states_of(state, place)
    blocks = []
    for first in range(0, len(frames["seq"]), BUCKET_FRAMES):
        here = slice(first, first + BUCKET_FRAMES)
        at = np.searchsorted(seq, [*frames["seq"][here], frames["seq"][here][-1] + 1])
        static = entity["is_static"].astype(bool)
        scenery = states_of({k: v[static] for k, v in entity.items()}, place)
        new = (
            _entities(entity)
            if first == 0
            else _entities({k: v[:0] for k, v in entity.items()}, len(static))
        )
        blocks.append(
            FrameBlock(
                **{k: v[here].astype(np.int64) for k, v in frames.items()},
                offsets=(at - at[0]).astype(np.int64),
                states=rows.take(np.arange(at[0], at[-1])),
                entities=new,
                scenery=scenery if first == 0 else scenery.take(np.zeros(0, np.intp)),
                messages=MessageRefs(*(np.zeros(0, np.int64) for _ in range(5))),
            )
        )
    return blocks


def _entities(columns: dict[str, Any], first: int = 0) -> Entities:
    nothing = ("",) * len(columns["node_id"])
    return Entities(
        first=first,
        ident=nothing,
        kind=np.array([KIND_CODE[kind] for kind in columns["kind"]], np.int8),
        special=nothing,
        subkind=nothing,
        type_name=nothing,
        static=columns["is_static"].astype(bool),
        map_ref=tuple(columns["map_ref"]),
    )


def edges_of(block: FrameBlock, graph: GraphBlock) -> set[tuple[int, str, int, int]]:
    edges = graph.edges
    columns = (block.seq[edges.frame], edges.relation, edges.src, edges.dst)
    return {
        (q, RELATIONS[r], s, d) for q, r, s, d in zip(*(c.tolist() for c in columns), strict=True)
    }


def stored_edges(store: StoreFile) -> set[tuple[int, str, int, int]]:
    sql = """
      SELECT f.seq, e.relation::VARCHAR, e.src, e.dst
      FROM inside.edge e JOIN inside.frame f ON f.bucket = e.bucket AND e.mask & (1::BIGINT << f.bit) <> 0
    """
    return set(store.rows(sql).values)


def generator(store: StoreFile) -> SceneGraphGenerator:
    (trace,) = store.traces()
    text = store.road_map_text(trace.name)
    return SceneGraphGenerator(read_map(text[1], text[0]) if text else None, Config())


def remade(store: StoreFile) -> tuple[set[tuple[int, str, int, int]], set[tuple[Any, ...]]]:
    """Edges, and lane states as the store would keep them, made from what is in it."""
    edges: set[tuple[int, str, int, int]] = set()
    lanes: set[tuple[Any, ...]] = set()
    again = generator(store)
    for block in read_back(store):
        graph = again.block(block)
        edges |= edges_of(block, graph)
        hits = graph.lanes
        columns = [block.seq[hits.frame], hits.node, hits.lane]
        columns += [
            number(hits.overlap),
            number(hits.offset),
            number(hits.heading_error),
            hits.primary,
        ]
        lanes |= set(zip(*(c.tolist() for c in columns), strict=True))
    return edges, lanes


def same_again(store: StoreFile) -> None:
    edges, lanes = remade(store)
    sql = """
      SELECT f.seq, l.node_id, l.lane, l.overlap, l.lane_offset, l.heading_error, l.is_primary
      FROM inside.lane_state l JOIN inside.frame f ON f.frame_id = l.frame_id
    """

    assert edges == stored_edges(store)
    assert lanes == set(store.rows(sql).values)


def test_relations_of_the_sample_are_made_again_from_its_store(town_store: Any) -> None:
    same_again(StoreFile(town_store))


@pytest.mark.data
@pytest.mark.parametrize("name", MORE_DATA)
def test_relations_of_recordings_are_made_again_from_their_stores(
    tmp_path: Path, data: Any, name: Any
) -> None:
    ingest(tmp_path / "s.db", [data / "traces" / name])

    same_again(StoreFile(tmp_path / "s.db"))


FAR_ORIGINS = st.floats(-1e7, 1e7).map(round)
NEAR = st.one_of(
    st.floats(-1e3, 1e3, width=64), st.floats(-1e-3, 1e-3, width=64), st.just(float("nan"))
)


@given(st.lists(NEAR, min_size=1, max_size=20), FAR_ORIGINS)
@settings(max_examples=share_of(200), deadline=None)
def test_what_is_kept_is_what_comes_back(offsets: Any, zero: Any) -> None:
    block = RandomTrace(frames=1).blocks[0].frames
    x = zero + np.array(offsets)
    states = States.of(node=np.arange(len(x)), x=x, y=-x, z=x / 2, heading=np.array(offsets), vx=x)
    origin = Origin(float(zero), -float(zero), float(round(zero / 2)))
    whole = type(block)(
        seq=block.seq,
        time_ns=block.time_ns,
        log_time_ns=block.log_time_ns,
        offsets=np.array([0, len(x)]),
        states=states,
        ego=block.ego,
        entities=block.entities,
        scenery=block.scenery,
        messages=block.messages,
    )

    kept = quantize(whole, origin)

    for axis in ("x", "y", "z"):
        value, start = getattr(kept.states, axis), getattr(origin, axis)
        came_back = start + number(value - start).astype(np.float64)
        np.testing.assert_array_equal(came_back, value)
        np.testing.assert_allclose(value, getattr(states, axis), rtol=0, atol=1e-4)
    twice = quantize(kept, origin)
    for column in fields(States):
        np.testing.assert_array_equal(
            getattr(twice.states, column.name), getattr(kept.states, column.name)
        )


def test_the_origin_does_not_depend_on_where_blocks_end() -> None:
    long = RandomTrace(seed=3, frames=60, size=60).blocks[0].frames
    long.states.x[: int(long.offsets[5])] = np.nan

    origin = origin_of(long)

    first = slice(int(long.offsets[5]), int(long.offsets[6]))
    assert origin is not None
    assert origin.x == round(float(np.median(long.states.x[first])))
    assert origin.y == round(float(np.median(long.states.y[first])))
