"""Masks and columns against sets and loops."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from graph_blocks import RandomTrace, map_stub
from hypothesis import given
from hypothesis import strategies as st

from sgstore.model.frame_ids import frame_ids
from sgstore.model.vocabulary import MOST_RELATIONS
from sgstore.model.world import BUCKET_FRAMES, Origin, origin_of
from sgstore.store._columns import marked, parted
from sgstore.store._packing import NodeKinds, edge_columns, masks_of, node_columns, state_columns

if TYPE_CHECKING:
    from collections.abc import Iterable

SMALL = st.integers(-3, 3)
FAR = st.integers(-(1 << 31), 1 << 31)


@given(st.lists(st.tuples(SMALL, SMALL, SMALL, st.integers(0, 59)), max_size=60))
def test_a_mask_holds_the_bits_of_all_rows_with_its_key(rows) -> None:
    expected: dict[tuple[int, ...], set[int]] = defaultdict(set)
    for *key, bit in rows:
        expected[tuple(key)].add(bit)
    table = np.array(rows, np.int64).reshape(-1, 4)

    first, mask = masks_of(table[:, :3].T, table[:, 3])

    found = {
        tuple(table[row, :3].tolist()): {bit for bit in range(60) if value >> bit & 1}
        for row, value in zip(first, mask.tolist(), strict=True)
    }
    assert found == expected
    assert list(found) == sorted(found)


@given(st.lists(st.tuples(FAR, FAR, FAR), min_size=1, max_size=20))
def test_keys_that_are_far_apart_are_told_apart(rows) -> None:
    table = np.array(rows, np.int64)

    first, mask = masks_of(table.T, np.zeros(len(rows), np.int64))

    assert [tuple(row) for row in table[first].tolist()] == sorted(set(rows))
    assert set(mask.tolist()) == {1}


def test_an_edge_that_holds_in_many_frames_is_one_row_a_bucket() -> None:
    trace = RandomTrace(seed=3, frames=130, size=120, road_map=map_stub())
    kinds = NodeKinds(np.zeros(0, np.int8), trace.road_map.nodes.kind)
    kinds.learn(trace.blocks[0].frames.entities)
    expected: dict[tuple[object, ...], int] = defaultdict(int)
    frames, edges = trace.blocks[0].frames, trace.blocks[0].edges
    for frame, relation, src, dst in zip(
        *(a.tolist() for a in (edges.frame, edges.relation, edges.src, edges.dst)), strict=True
    ):
        ego = frames.ego[frame]
        marks = (bool(src == ego), bool(dst == ego and ego >= 0))
        expected[(relation, *marks, src, dst, frame // BUCKET_FRAMES)] |= 1 << frame % BUCKET_FRAMES

    pieces = list(edge_columns(trace.blocks[0], 5, kinds))
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    found = {
        (r, a, b, s, d, bucket - (5 << 18)): mask
        for r, a, b, s, d, bucket, mask in zip(
            *(
                columns[name].tolist()
                for name in ["relation", "src_is_ego", "dst_is_ego", "src", "dst", "bucket", "mask"]
            ),
            strict=True,
        )
    }
    assert found == expected
    assert len(found) == len(columns["mask"])


def test_off_road_is_not_the_ego_of_a_frame_without_one() -> None:
    trace = RandomTrace(seed=4, frames=60, road_map=map_stub())
    block = trace.blocks[0]
    block.frames.ego[:] = -1
    kinds = NodeKinds(np.zeros(0, np.int8), trace.road_map.nodes.kind)
    kinds.learn(block.frames.entities)

    assert (block.edges.dst == -1).any()
    assert not any(piece["dst_is_ego"].any() for piece in edge_columns(block, 0, kinds))


def test_ids_of_frames_are_what_the_schema_says() -> None:
    trace_id, seq = (1 << 39) - 1, np.array([0, 59, 60, 61, BUCKET_FRAMES * (1 << 18) - 1])

    ids = frame_ids(trace_id, seq)

    assert (ids >> 24 == trace_id).all()
    assert ((ids >> 6) == (trace_id << 18) + seq // 60).all()
    assert (ids & 63 == seq % 60).all()
    assert ids[-1] == (1 << 63) - 1 - 4  # the last id there can be: bit 59 of the last bucket


def test_headings_are_cut_to_a_turn_also_as_short_floats() -> None:
    trace = RandomTrace(seed=5, frames=60)
    heading = trace.blocks[0].frames.states.heading
    heading[:4] = [np.pi, -np.pi, 3 * np.pi, np.nextafter(np.pi, 4)]
    kinds = NodeKinds(np.zeros(0, np.int8), np.zeros(0, np.int8))
    kinds.learn(trace.blocks[0].frames.entities)

    stored = state_columns(trace.blocks[0], 0, kinds, Origin(0, 0, 0))["heading"]

    assert stored.dtype == np.float32
    assert np.nanmax(np.abs(stored.astype(float))) <= np.pi
    assert np.degrees(stored[:3].astype(float)) == pytest.approx([180, 180, 180])


def test_positions_are_about_the_middle_of_the_first_frame_in_whole_metres() -> None:
    block = RandomTrace(seed=6, frames=60).blocks[0]
    states = block.frames.states
    first = slice(0, int(block.frames.offsets[1]))

    origin = origin_of(block.frames)

    assert origin == Origin(
        *(float(np.round(np.median(getattr(states, axis)[first]))) for axis in ("x", "y", "z"))
    )


def test_a_block_without_positions_has_no_origin() -> None:
    block = RandomTrace(seed=7, frames=60).blocks[0]
    block.frames.states.x[:] = np.nan
    block.frames.scenery.y[:] = np.inf

    assert origin_of(block.frames) is None


def test_relations_fit_their_codes() -> None:
    assert MOST_RELATIONS < 1 << 7


def test_rows_that_follow_one_another_and_are_the_same_become_one() -> None:
    rng = np.random.default_rng(4)
    seq = np.arange(200)
    node = np.repeat([3, 5], 200)
    gap = rng.integers(0, 3, 400).astype(np.float32)
    gap[rng.random(400) < 0.2] = np.nan
    seq = np.tile(seq, 2)
    order = np.lexsort((seq, node, seq // 60))
    rows = {"bucket": seq // 60, "bit": (seq % 60).astype(np.int32), "src": node, "gap": gap}
    rows = {name: values[order] for name, values in rows.items()}

    single, repeated = parted(rows)

    def told(of: dict[str, Any], bits: Iterable[Iterable[int]]) -> list[tuple[Any, ...]]:
        keys = zip(of["bucket"], of["src"], map(str, of["gap"]), bits, strict=True)
        return [(b, s, g, int(bit)) for b, s, g, some in keys for bit in some]

    masks = [[bit for bit in range(60) if mask >> bit & 1] for mask in repeated["mask"].tolist()]
    alone = [[bit] for bit in single["bit"].tolist()]
    assert sorted(told(single, alone) + told(repeated, masks)) == sorted(
        told(rows, [[bit] for bit in rows["bit"].tolist()])
    )
    assert all(len(bits) > 1 for bits in masks)
    assert 0 < len(single["bit"]) < 400


def test_states_that_repeat_lie_together_behind_the_others() -> None:
    rows: dict[str, Any] = {
        "is_ego": np.array([1, 1, 1, 0, 0, 0, 0]),
        "frame_id": np.array([0, 1, 2, 0, 1, 2, 64]),
        "x": np.array([1.0, 2.0, 2.0, 7.0, 7.0, 8.0, 8.0], np.float32),
    }

    found = marked(rows)

    assert found["repeated"].tolist() == [False, True, True, False, False, True, True]
    assert found["is_ego"].tolist() == [1, 1, 1, 0, 0, 0, 0]
    assert found["frame_id"].tolist() == [0, 1, 2, 2, 64, 0, 1]


@pytest.mark.parametrize("size", [7, 50])
def test_blocks_that_begin_off_an_edge_of_a_bucket_and_cross_one_have_the_right_rows(
    size: int,
) -> None:
    trace = RandomTrace(seed=4, frames=130, size=size, road_map=map_stub())
    kinds = NodeKinds(np.zeros(0, np.int8), trace.road_map.nodes.kind)
    kinds.learn(trace.blocks[0].frames.entities)
    crossing = 0
    for block in trace.blocks:
        seq = block.frames.seq.tolist()
        crossing += seq[0] % BUCKET_FRAMES > seq[-1] % BUCKET_FRAMES > 0
        expected: dict[str, dict[tuple[int, ...], int]] = {
            name: defaultdict(int) for name in ("edge", "node")
        }
        edges, presence = block.edges, block.presence
        for row, frame in enumerate(edges.frame.tolist()):
            bucket, bit = divmod(seq[frame], BUCKET_FRAMES)
            key = int(edges.relation[row]), int(edges.src[row]), int(edges.dst[row]), bucket
            expected["edge"][key] |= 1 << bit
        for frame, node in zip(presence.frame.tolist(), presence.node.tolist(), strict=True):
            bucket, bit = divmod(seq[frame], BUCKET_FRAMES)
            expected["node"][node, bucket] |= 1 << bit

        found: dict[str, dict[tuple[int, ...], int]] = {
            name: defaultdict(int) for name in ("edge", "node")
        }
        for columns in edge_columns(block, 5, kinds):
            for *key, bucket, mask in _rows(columns, "relation", "src", "dst", "bucket", "mask"):
                found["edge"][*key, bucket - (5 << 18)] |= mask
        for node, bucket, mask in _rows(node_columns(block, 5, kinds), "node_id", "bucket", "mask"):
            found["node"][node, bucket - (5 << 18)] |= mask
        assert found == expected
    assert crossing == 2


def _rows(columns: dict[str, Any], *names: str) -> Iterable[tuple[int, ...]]:
    return zip(*(columns[name].tolist() for name in names), strict=True)
