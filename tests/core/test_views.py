"""The public views against the blocks that were stored, and against one another."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from graph_blocks import RandomTrace, map_stub, publish

from sgstore.model.pair_numbers import COLUMNS, PAIR_FUNCTIONS, PairNumbers
from sgstore.model.vocabulary import KINDS, LIGHT_STATES, RELATIONS
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(6)

ROADS = map_stub(seed=1)
TRACES = {
    "town": RandomTrace(seed=1, frames=150, road_map=ROADS, path="/r/town.mcap"),
    "again": RandomTrace(seed=2, frames=61, size=61, road_map=ROADS, path="/r/again.mcap"),
    "field": RandomTrace(seed=3, frames=80, size=7, path="/r/field.mcap"),
}
"""One on a map; one on the same map, in one block; one without a map, in blocks that split buckets."""

Edge = tuple[int, int, str, int]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreFile]:
    store = StoreFile.create(tmp_path_factory.mktemp("store") / "s.db")
    for name, trace in TRACES.items():
        assert publish(store, trace) == name
    with store.snapshot():
        yield store


def frame_id(store: StoreFile, name: str, seq: int) -> int:
    return store.frame(f"{name}#{seq}").frame_id


def rows_by_frame(store: StoreFile, sql: str) -> dict[int, Counter[tuple[Any, ...]]]:
    found: dict[int, Counter[tuple[Any, ...]]] = defaultdict(Counter)
    for frame, *row in store.rows(sql):
        found[frame][tuple(row)] += 1
    return found


def all_frames(store: StoreFile) -> Iterator[tuple[int, RandomTrace, Any, int]]:
    """Every frame: its id, its trace, its block, and its number in the block."""
    for name, trace in TRACES.items():
        start = frame_id(store, name, 0)
        for graph in trace.blocks:
            for i, seq in enumerate(graph.frames.seq.tolist()):
                yield start + seq // BUCKET_FRAMES * 64 + seq % BUCKET_FRAMES, trace, graph, i


def test_frames_are_those_that_were_appended(store: Any) -> None:
    expected = [
        (frame, trace.info.path.stem, seq, time_ns, log_ns, None if ego < 0 else ego)
        for frame, trace, graph, i in all_frames(store)
        for seq, time_ns, log_ns, ego in [
            (
                int(graph.frames.seq[i]),
                int(graph.frames.time_ns[i]),
                int(graph.frames.log_time_ns[i]),
                int(graph.frames.ego[i]),
            )
        ]
    ]
    sql = "SELECT frame_id, trace, seq, time_ns, log_time_ns, ego FROM frames ORDER BY frame_id"

    assert store.rows(sql).values == sorted(expected)


def test_seconds_count_from_the_first_frame(store: Any) -> None:
    rows = store.rows("SELECT seq, t FROM frames WHERE trace = 'town' ORDER BY seq").values

    assert [t for _, t in rows] == pytest.approx([seq / 10 for seq, _ in rows])


def test_frames_name_their_map(store: Any) -> None:
    rows = store.rows("SELECT DISTINCT trace, map FROM frames ORDER BY trace").values

    assert rows == [("again", "stub"), ("field", None), ("town", "stub")]


def kind_of(trace: RandomTrace, node: int) -> str:
    return KINDS[trace.kinds[node] if node >= 0 else trace.road_map.nodes.kind[-1 - node]]


def test_nodes_are_states_and_what_is_present(store: Any) -> None:
    sql = "SELECT frame_id, node_id, kind, is_ego, is_static FROM nodes"
    found = rows_by_frame(store, sql)

    for frame, trace, graph, i in all_frames(store):
        states, present = graph.frames.states, graph.presence
        ego = graph.frames.ego[i]
        moving = states.node[graph.frames.offsets[i] : graph.frames.offsets[i + 1]].tolist()
        standing = present.node[present.frame == i].tolist()
        expected = [(n, kind_of(trace, n), n == ego, False) for n in moving]
        expected += [(n, kind_of(trace, n), False, True) for n in standing]
        assert found[frame] == Counter(expected)


def test_states_are_kept_to_the_last_bit_of_a_short_float(store: Any) -> None:
    names = ("vx", "vy", "ax", "ay", "length", "width", "height")
    sql = f"SELECT {', '.join(names)} FROM nodes WHERE frame_id = ? AND NOT is_static ORDER BY node_id"

    for frame, _, graph, i in list(all_frames(store))[::17]:
        rows = slice(*graph.frames.offsets[i : i + 2].tolist())
        expected = [
            [None if np.isnan(v) else float(np.float32(v)) for v in column]
            for column in zip(*(getattr(graph.frames.states, n)[rows] for n in names), strict=True)
        ]
        assert [list(row) for row in store.rows(sql, [frame])] == expected


def near(value: float) -> Any:
    """The value, as well as a short float can hold it; nothing for NaN."""
    return None if np.isnan(value) else pytest.approx(value, abs=1e-4, rel=1e-5)


def test_attributes_come_out_in_the_units_of_people(store: Any) -> None:
    sql = "SELECT * FROM nodes WHERE frame_id = ? AND NOT is_static ORDER BY node_id"
    for frame, trace, graph, i in list(all_frames(store))[::23]:
        states = graph.frames.states
        for row, found in zip(
            range(*graph.frames.offsets[i : i + 2].tolist()),
            store.rows(sql, [frame]).dicts(),
            strict=True,
        ):
            heading, node = states.heading[row], int(states.node[row])
            assert found["x"] == pytest.approx(states.x[row], abs=1e-4)
            assert found["y"] == pytest.approx(states.y[row], abs=1e-4)
            assert found["z"] == pytest.approx(states.z[row], abs=1e-4)
            assert found["name"] == f"{kind_of(trace, node)} {node}"
            assert found["special"] == ("taxi" if node % 3 == 1 else None)
            assert found["yaw_rate"] == near(np.degrees(states.yaw_rate[row]))
            assert found["heading"] == near((np.degrees(heading) + 180) % 360 - 180)
            assert found["speed"] == near(np.hypot(states.vx[row], states.vy[row]))
            along = states.ax[row] * np.cos(heading) + states.ay[row] * np.sin(heading)
            assert found["accel"] == near(along)
            state = states.light_state[row]
            assert found["light_state"] == (LIGHT_STATES[state] if state >= 0 else None)
            lights = int(states.lights[row])
            assert found["light_brake"] == (None if lights < 0 else bool(lights & 4))
            assert found["derived_velocity"] == bool(states.derived[row] & 1)
            assert found["steer"] is None


def static_edges(trace: RandomTrace, present: set[int]) -> Iterator[tuple[int, str, int]]:
    if trace.road_map is not None:
        edges = trace.road_map.edges
        for relation, src, dst in zip(
            *(a.tolist() for a in (edges.relation, edges.src, edges.dst)), strict=True
        ):
            if src in present and dst in present:
                yield src, RELATIONS[relation], dst


def edges_of(trace: RandomTrace, graph: Any, i: int) -> set[tuple[int, str, int]]:
    """The edges of a frame, the static ones too."""
    edges = graph.edges
    here = edges.frame == i
    columns = (edges.src[here].tolist(), edges.relation[here].tolist(), edges.dst[here].tolist())
    found = {(s, RELATIONS[r], d) for s, r, d in zip(*columns, strict=True)}
    present = set(graph.presence.node[graph.presence.frame == i].tolist())
    return found | set(static_edges(trace, present))


def test_edges_are_those_of_the_blocks_and_of_the_map_where_both_ends_are_present(
    store: Any,
) -> None:
    found = rows_by_frame(store, "SELECT frame_id, src, relation, dst FROM edges")

    for frame, trace, graph, i in all_frames(store):
        assert found[frame] == Counter(edges_of(trace, graph, i))


def test_edges_know_the_kinds_of_their_ends_and_whether_they_are_the_ego(store: Any) -> None:
    sql = "SELECT frame_id, src, dst, src_kind, dst_kind, src_is_ego, dst_is_ego FROM edges"
    found = rows_by_frame(store, sql)

    for frame, trace, graph, i in all_frames(store):
        ego = int(graph.frames.ego[i])
        for src, dst, src_kind, dst_kind, src_is_ego, dst_is_ego in found[frame]:
            assert (src_kind, dst_kind) == (kind_of(trace, src), kind_of(trace, dst))
            assert (src_is_ego, dst_is_ego) == (0 <= ego == src, 0 <= ego == dst)


def test_lane_states_are_those_of_the_blocks_in_degrees(store: Any) -> None:
    found = rows_by_frame(store, "SELECT frame_id, src, dst, overlap, is_primary FROM lane_states")
    angles = store.rows("SELECT heading_error FROM lane_states").values

    for frame, _, graph, i in all_frames(store):
        lanes = graph.lanes
        here = lanes.frame == i
        columns = (lanes.node, lanes.lane, lanes.overlap.astype(np.float32), lanes.primary)
        assert found[frame] == Counter(zip(*(c[here].tolist() for c in columns), strict=True))
    assert 30 < max(abs(angle) for (angle,) in angles) <= np.degrees(1)


def test_each_lane_state_belongs_to_an_edge(store: Any) -> None:
    sql = "SELECT count(*) FROM lane_states JOIN edges USING (frame_id, src, dst) WHERE relation = 'isIn'"

    assert store.rows(sql).values == store.rows("SELECT count(*) FROM lane_states").values


def test_two_edges_joined_in_plain_sql_are_two_edges_of_one_frame(store: Any) -> None:
    sql = """
      SELECT a.frame_id, a.src, a.dst, b.dst
      FROM edges a JOIN edges b ON b.frame_id = a.frame_id AND b.src = a.dst
      WHERE a.relation = 'near' AND b.relation = 'toLeftOf'
    """
    expected: Counter[tuple[int, ...]] = Counter()
    for frame, trace, graph, i in all_frames(store):
        edges = edges_of(trace, graph, i)
        near = [(s, d) for s, r, d in edges if r == "near"]
        left = [(s, d) for s, r, d in edges if r == "toLeftOf"]
        expected.update((frame, a, b, c) for a, b in near for m, c in left if m == b)

    assert Counter(store.rows(sql).values) == expected
    assert expected


NUMBERS = {one.column or name: name for name, one in PAIR_FUNCTIONS.items() if one.sql}
"""Columns of the view ``criticality`` that are numbers, and what they are called elsewhere."""


def boxes(store: StoreFile, frame: int) -> tuple[list[int], Any]:
    """Nodes that move and the numbers of their states as they are stored, in radians."""
    columns = ", ".join(f"{name}::DOUBLE" for name in COLUMNS)
    sql = f"SELECT node_id, {columns} FROM inside.state WHERE frame_id = ? ORDER BY node_id"
    rows = store.rows(sql, [frame]).values
    states = np.array([row[1:] for row in rows], float)
    return [row[0] for row in rows], states.reshape(-1, len(COLUMNS))


@pytest.mark.parametrize("name", TRACES)
def test_numbers_of_pairs_are_those_of_the_geometry(store: Any, name: Any) -> None:
    for seq in range(0, TRACES[name].frames, 11):
        frame = frame_id(store, name, seq)
        nodes, states = boxes(store, frame)
        a, b = np.nonzero(~np.eye(len(nodes), dtype=bool))
        expected = PairNumbers(states[a], states[b])
        sql = (
            f"SELECT src, dst, {', '.join(NUMBERS)} FROM criticality WHERE frame_id = ?"
            " ORDER BY src, dst"
        )
        found = store.rows(sql, [frame]).values

        assert [row[:2] for row in found] == [
            (nodes[i], nodes[j]) for i, j in zip(a, b, strict=True)
        ]
        for column, number in enumerate(NUMBERS.values(), 2):
            wanted = expected[number]
            value = np.array([row[column] for row in found], float)
            assert (np.isnan(value) == np.isnan(wanted)).all(), number
            apart = value - wanted
            if PAIR_FUNCTIONS[number].unit == "degrees":
                apart = (apart + 180) % 360 - 180
            assert np.nanmax(np.abs(apart), initial=0) <= 1e-4, number


@pytest.mark.parametrize(
    ("other", "bearing", "rel_heading"),
    [
        pytest.param((10.0, 0.0, 0.0), 0, 0, id="ahead"),
        pytest.param((0.0, 5.0, np.pi), 90, 180, id="left, oncoming"),
        pytest.param((-5.0, 0.0, -np.pi / 2), 180, -90, id="dead behind"),
        pytest.param((0.0, 0.0, 0.5), 0, np.degrees(0.5), id="in one place"),
        pytest.param((-0.0, -0.0, 0.0), 0, 0, id="in one place, signed"),
    ],
)
def test_bearings_are_to_the_left_and_the_half_turn_is_positive(
    tmp_path: Path, other: Any, bearing: Any, rel_heading: Any
) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    trace = RandomTrace(seed=11, frames=1)
    states = trace.blocks[0].frames.states
    assert states.node[:2].tolist() == [0, 1]
    for axis, here, there in zip(("x", "y", "heading"), (0.0, 0.0, 0.0), other, strict=True):
        getattr(states, axis)[:2] = [here, there]
    publish(store, trace)

    sql = "SELECT bearing, rel_heading FROM pairs WHERE src = 0 AND dst = 1"

    assert store.rows(sql).values[0] == pytest.approx((bearing, rel_heading), abs=1e-4)


def test_lanes_are_those_of_the_map_once(store: Any) -> None:
    rows = store.rows("SELECT map, node_id, name, road, lane, length FROM lanes").values

    is_lane = [i for i, kind in enumerate(ROADS.nodes.kind.tolist()) if KINDS[kind] == "lane"]
    assert sorted(rows) == sorted(
        ("stub", -1 - i, ROADS.nodes.name[i], "7", -1, 80.0) for i in is_lane
    )


def test_entities_are_what_the_readers_said_once_a_trace(store: Any) -> None:
    rows = store.rows("SELECT node_id, ident, kind, subkind, is_static FROM entities").values

    assert Counter(rows) == Counter(
        (i, f"id{i}", KINDS[kind], "cone" if i % 4 == 2 else None, i >= trace.moving)
        for trace in TRACES.values()
        for i, kind in enumerate(trace.kinds)
    )


def test_static_entities_have_their_pose_in_every_frame_that_they_are_in(store: Any) -> None:
    for name, trace in TRACES.items():
        scenery = trace.blocks[0].frames.scenery
        sql = """
          SELECT DISTINCT n.node_id, n.x, n.y FROM nodes n JOIN frames USING (frame_id)
          WHERE n.trace = ? AND n.is_static AND n.node_id >= 0 ORDER BY n.node_id
        """
        found = store.rows(sql, [name]).values
        assert np.array(found).reshape(-1, 3) == pytest.approx(
            np.column_stack([scenery.node, scenery.x, scenery.y]), abs=1e-3
        )


@pytest.mark.parametrize("name", TRACES)
def test_a_graph_is_all_that_the_views_show_of_its_frame(store: Any, name: Any) -> None:
    for seq in range(0, TRACES[name].frames, 13):
        frame = frame_id(store, name, seq)
        graph = store.graph(frame)
        nodes = {
            row.pop("node_id"): {k: v for k, v in row.items() if v is not None and k != "frame_id"}
            for row in store.rows(
                "SELECT * EXCLUDE (trace) FROM nodes WHERE frame_id = ?", [frame]
            ).dicts()
        }
        edges = store.rows(
            "SELECT src, relation, dst FROM edges WHERE frame_id = ?", [frame]
        ).values
        lanes = store.rows("SELECT * FROM lane_states WHERE frame_id = ?", [frame]).dicts()

        assert graph.nodes == nodes
        assert Counter((s, r, d) for s, r, d, _ in graph.edges) == Counter(edges)
        kept = ("overlap", "lane_offset", "heading_error", "is_primary", "along", "is_own")
        known = {("isIn", row["src"], row["dst"]): {k: row[k] for k in kept} for row in lanes}
        gaps = store.rows("SELECT src, dst, gap FROM lane_gaps WHERE frame_id = ?", [frame]).values
        known |= {("follows", a, b): {"gap": gap} for a, b, gap in gaps if gap is not None}
        known |= {("leads", b, a): {"gap": gap} for a, b, gap in gaps if gap is not None}
        assert {(r, s, d): a for s, r, d, a in graph.edges if a} == {
            edge: about for edge, about in known.items() if (edge[1], edge[0], edge[2]) in edges
        }
        assert (graph.trace, graph.seq, graph.frame_id) == (name, seq, frame)
        ego = TRACES[name].blocks[seq // len(TRACES[name].blocks[0])].frames.ego
        assert graph.ego == (None if ego[seq % len(TRACES[name].blocks[0])] < 0 else 0)


def test_a_mask_is_one_row_even_where_blocks_split_buckets(store: Any) -> None:
    for table, key in (
        ("edge", "relation, src, dst, src_is_ego, dst_is_ego, bucket"),
        ("node", "node_id, bucket"),
    ):
        sql = f"SELECT count(*) - count(DISTINCT ({key})) FROM {table}"
        assert store.rows(sql).values == [(0,)]


# What the optimizer must do, lest the views become slow: filters reach the scans.


def scans(store: StoreFile, sql: str) -> list[tuple[str, str]]:
    """Table and filters of every scan in the plan of a statement."""
    (plan,) = json.loads(store.rows(f"EXPLAIN (FORMAT json) {sql}").values[0][1])
    found, todo = [], [plan]
    while todo:
        step = todo.pop()
        todo += step["children"]
        about = step.get("extra_info", {})
        if "Table" in about:
            found.append((about["Table"].split(".")[-1], str(about.get("Filters", ""))))
    return found


@pytest.mark.parametrize(
    ("sql", "table", "filtered"),
    [
        ("SELECT frame_id FROM edges WHERE relation = 'near' AND dst_kind = '{kind}'", "edge", "near"),
        ("SELECT frame_id FROM edges WHERE relation = 'near' AND dst_kind = '{kind}'", "edge", "{kind}"),
        ("SELECT * FROM edges WHERE frame_id = {frame}", "frame", "{frame}"),
        ("SELECT frame_id FROM nodes WHERE kind = '{kind}' AND speed > 3", "state", "{kind}"),
        ("SELECT * FROM nodes WHERE frame_id = {frame}", "state", "{frame}"),
        ("SELECT frame_id FROM pairs WHERE src_kind = '{kind}' AND distance < 6", "state", "{kind}"),
        ("SELECT * FROM pairs WHERE frame_id = {frame}", "state", "{frame}"),
        ("SELECT * FROM lane_states WHERE frame_id = {frame}", "frame", "{frame}"),
        ("SELECT frame_id FROM lane_states WHERE src_kind = '{kind}'", "lane_single", "{kind}"),
        ("SELECT * FROM payloads WHERE frame_id = {frame}", "frame", "{frame}"),
    ],
)  # fmt: skip
def test_filters_on_views_reach_the_scans(store: Any, sql: Any, table: Any, filtered: Any) -> None:
    about = {"frame": frame_id(store, "town", 71), "kind": KINDS[TRACES["town"].kinds[1]]}

    found = scans(store, sql.format(**about))

    assert any(t == table and filtered.format(**about) in f for t, f in found), found


@pytest.mark.parametrize(
    ("view", "table", "times"),
    # Of pairs both sides. Lanes are met by the bucket of the frame.
    [("pairs", "state", 2), ("lane_dists", "frame", 1)],
)
def test_the_filter_on_the_frame_of_a_pair_reaches_both_sides(
    store: Any, view: Any, table: Any, times: int
) -> None:
    frame = frame_id(store, "town", 71)

    found = scans(store, f"SELECT * FROM {view} WHERE frame_id = {frame}")

    assert [str(frame) in filters for t, filters in found if t == table] == [True] * times


def test_ways_of_the_ego_look_at_the_lanes_of_the_ego_only(store: Any) -> None:
    found = scans(store, "SELECT src, dst, lane_dist FROM lane_dists WHERE src_is_ego")

    assert sum("is_ego" in filters for table, filters in found if table == "lane_single") == 1


def test_numbers_of_pairs_look_at_no_lanes(store: Any) -> None:
    found = scans(store, "SELECT * FROM pairs WHERE src_is_ego")

    assert [table for table, _ in found] == ["trace", "state", "state"]
