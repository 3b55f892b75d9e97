"""Segments: a trace comes into a store as a whole, once, and nothing is left beside it."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from children import FOLDERS
from graph_blocks import RandomTrace, map_stub, publish, trace_info

import sgstore.store._staging as staging
import sgstore.store._table_stream as table_stream
from sgstore.errors import StoreError
from sgstore.model.config import Config, RangeSettings
from sgstore.model.world import TraceReport
from sgstore.store import Identity, StoreFile
from sgstore.store._columns import REPEATED

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(13)

TABLES = (
    "trace",
    "recording",
    "channel",
    "context",
    "entity",
    "bucket",
    "frame",
    "state",
    "node",
    "edge",
)
TABLES += (
    "event",
    *REPEATED,
    *REPEATED.values(),
    "lane_state",
    "lane_gap",
    "payload",
    "map",
    "map_node",
    "map_edge",
    "config",
)


def content(store: StoreFile) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of all tables, but for when they came."""
    without = {"trace": "EXCLUDE (ingested_at)"}
    with store.snapshot():
        return {
            table: store.rows(f"SELECT * {without.get(table, '')} FROM {table} ORDER BY ALL").values
            for table in TABLES
        }


@pytest.fixture
def store(tmp_path: Path) -> StoreFile:
    return StoreFile.create(tmp_path / "s.db")


def beside(store: StoreFile) -> list[str]:
    return sorted(p.name for p in store.path.parent.iterdir() if p != store.path)


def test_a_trace_of_more_frames_than_their_ids_have_room_for_is_refused(
    store: StoreFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sgstore.store._write.MAX_FRAMES", 100)
    trace = RandomTrace(frames=130)

    with store.segment(trace.info, Config()) as segment:
        segment.append(trace.blocks[0])
        with pytest.raises(StoreError, match="more than 100 frames in one trace"):
            segment.append(trace.blocks[1])

    assert store.traces() == ()
    assert beside(store) == []


def test_a_trace_is_not_in_the_store_before_it_is_published(store: Any) -> None:
    trace = RandomTrace(frames=130)
    with store.segment(trace.info, Config()) as segment:
        for graph in trace.blocks:
            segment.append(graph)
            assert store.traces() == ()
        store.publish(segment.seal(TraceReport()))

    assert len(store.traces()) == 1
    assert beside(store) == []


def test_what_is_not_published_is_forgotten(store: Any) -> None:
    trace = RandomTrace(frames=130)
    with store.segment(trace.info, Config()) as segment:
        segment.append(trace.blocks[0])
        assert beside(store) != []

    assert store.traces() == ()
    assert beside(store) == []


@pytest.mark.parametrize("size", [1, 61])
def test_blocks_of_any_size_give_the_same_store(tmp_path: Path, size: Any) -> None:
    stores = [StoreFile.create(tmp_path / name) for name in ("whole.db", "cut.db")]
    roads = map_stub()
    whole = RandomTrace(5, frames=75, size=75, road_map=roads)
    publish(stores[0], whole)
    cut = RandomTrace(5, frames=75, size=75, road_map=roads)
    cut.blocks = [piece for block in cut.blocks for piece in pieces(block, size)]
    publish(stores[1], cut)

    assert content(stores[0]) == content(stores[1])


@pytest.mark.parametrize("name", ["s.db", "it's [1]*.db"])
def test_parts_that_wait_in_files_are_published_like_those_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: Any
) -> None:
    found = []
    for rows, place in ((10**9, "memory.db"), (1, name)):
        monkeypatch.setattr(staging, "PART_ROWS", rows)
        store = StoreFile.create(tmp_path / place)
        publish(store, RandomTrace(5, frames=200, road_map=map_stub()))
        found.append(content(store))
        assert beside(store) == [] or len(found) > 1

    assert found[0] == found[1]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["memory.db", name])


def test_a_trace_with_more_entities_than_are_sampled_comes_in(store: Any) -> None:
    publish(store, RandomTrace(frames=2, moving=2500))

    sql = "SELECT count(*), count(special), count(map_ref) FROM entities"
    assert store.rows(sql).values == [
        (2500 + standing(store), (2500 + standing(store) + 1) // 3, 0)
    ]


def standing(store: StoreFile) -> int:
    return store.rows("SELECT count(*) FROM entities WHERE is_static").values[0][0]


def pieces(graph: Any, size: int) -> list[Any]:
    """A block cut into smaller ones."""
    found = []
    for first in range(0, len(graph), size):
        end = min(first + size, len(graph))
        frames = graph.frames
        rows = slice(*frames.offsets[[first, end]].tolist())
        entities, scenery = frames.entities, frames.scenery
        if first:
            none = entities.kind[:0]
            entities = type(entities)(len(entities), (), none, (), (), (), entities.static[:0], ())
            scenery = scenery.take(np.zeros(0, np.intp))
        found.append(
            type(graph)(
                frames=replace(
                    frames,
                    **{
                        name: getattr(frames, name)[first:end]
                        for name in ("seq", "time_ns", "log_time_ns", "ego")
                    },
                    offsets=frames.offsets[first : end + 1] - frames.offsets[first],
                    states=frames.states.take(np.arange(rows.start, rows.stop)),
                    entities=entities,
                    scenery=scenery,
                ),
                presence=_cut(graph.presence, first, end),
                edges=_cut(graph.edges, first, end),
                lanes=_cut(graph.lanes, first, end),
                gaps=_cut(graph.gaps, first, end),
            )
        )
    return found


def _cut(part: Any, first: int, end: int) -> Any:
    here = (part.frame >= first) & (part.frame < end)
    columns = {name: getattr(part, name)[here] for name in type(part).__dataclass_fields__}
    return type(part)(**columns | {"frame": columns["frame"] - first})


def test_the_same_trace_is_told_to_be_there(store: Any) -> None:
    trace = RandomTrace(frames=3, path="drive")
    assert store.stored(trace.info, Config(), None) is None

    publish(store, trace)

    assert store.stored(trace.info, Config(), None) == "drive"


def test_traces_that_cannot_come_in_cost_no_other_of_those_that_come_with_them(
    store: Any, tmp_path: Path
) -> None:
    seeds = {"a": 0, "b": 1, "c": 2, "d": 4}
    traces = [RandomTrace(seeds[name], frames=70, path=name) for name in "abcad"]
    with ExitStack() as stack:
        sealed: list[Any] = []
        for trace in traces:
            segment = stack.enter_context(
                store.segment(trace.info, Config(), road_map=trace.road_map, answers=trace.answers)
            )
            for graph in trace.blocks:
                segment.append(graph)
            sealed.append(segment.seal(TraceReport(frames=70)))
        (sealed[2].folder / table_stream.FILE).unlink()

        told = store.publish_each(sealed)

    assert [str(one) for one in told[:2]] == ["a", "b"]
    assert "what waits beside it cannot be opened" in str(told[2])
    assert "came into the store meanwhile, as 'a'" in str(told[3])
    assert told[4] == "d"
    alone = StoreFile.create(tmp_path / "alone.db")
    for name in "abd":
        publish(alone, RandomTrace(seeds[name], frames=70, path=name))
    assert content(store) == content(alone)
    assert store.verify().faults == []


def test_a_trace_that_comes_twice_at_once_comes_once(store: Any) -> None:
    first, second = RandomTrace(frames=3, path="drive"), RandomTrace(frames=3, path="drive")
    with store.segment(second.info, Config()) as late:
        late.append(second.blocks[0])
        publish(store, first)
        before = content(store)

        with pytest.raises(StoreError, match="came into the store meanwhile, as 'drive'"):
            store.publish(late.seal(TraceReport()))

    assert content(store) == before


@pytest.mark.parametrize(
    ("config", "roads", "what"),
    [
        (Config(range=RangeSettings(9.0)), None, "with other settings"),
        (Config(), map_stub(seed=9), "with another road map"),
    ],
)
def test_the_same_trace_read_otherwise_is_refused(
    store: Any, config: Any, roads: Any, what: Any
) -> None:
    trace = RandomTrace(frames=3, path="drive")
    publish(store, trace)

    with pytest.raises(
        StoreError, match=f"already in the store as 'drive', read {what}; remove it"
    ):
        store.stored(trace.info, config, roads)


def test_another_ego_is_another_trace(store: Any) -> None:
    publish(store, RandomTrace(frames=3, path="drive"))
    publish(store, RandomTrace(frames=3, path="drive", ego="17"))

    assert [(t.name, t.ego) for t in store.traces()] == [("drive", "0"), ("drive~2", "17")]


def test_traces_of_one_name_are_numbered(store: Any) -> None:
    names = [publish(store, RandomTrace(seed, frames=3, path="drive")) for seed in range(3)]

    assert names == ["drive", "drive~2", "drive~3"]


def test_maps_of_one_name_are_numbered_and_equal_maps_are_one(store: Any) -> None:
    for seed, roads in enumerate((map_stub(1), map_stub(2), map_stub(1))):
        publish(store, RandomTrace(seed, frames=3, road_map=roads, path=f"d{seed}"))

    assert [t.map for t in store.traces()] == ["stub", "stub~2", "stub"]
    assert store.rows("SELECT count(*) FROM inside.map_node").values == [
        (2 * len(map_stub(1).nodes),)
    ]


def test_recordings_maps_and_settings_have_the_same_numbers_in_every_store(tmp_path: Path) -> None:
    """The first 60 bits of their digests, whatever came before them; and so have frames that refer to them."""
    traces = [
        RandomTrace(seed, frames=3, road_map=map_stub(seed), path=f"d{seed}") for seed in (1, 2, 3)
    ]
    settings = [Config(), Config(range=RangeSettings(20.0)), Config(range=RangeSettings(30.0))]
    told = {
        "recording": "recording_id, digest, uri",
        "config": "config_id, digest, settings",
        "map": "map_id, digest",
        "map_node": "*",
        "frame": "*",
        "bucket": "*",
    }
    found: list[Any] = []
    for name, order in (("one", (0, 1, 2)), ("other", (2, 0, 1))):
        store = StoreFile.create(tmp_path / f"{name}.db")
        for number in order:
            publish(store, traces[number], settings[number])
        found.append(
            {
                table: store.rows(f"SELECT {columns} FROM {table} ORDER BY ALL").values
                for table, columns in told.items()
            }
        )

    assert found[0] == found[1]
    for table in ("recording", "config", "map"):
        assert len(found[0][table]) == 3
        assert all(number == int(digest[:15], 16) for number, digest, *_ in found[0][table])
    assert {row[0] for row in found[0]["map"]} == {row[0] for row in found[0]["map_node"]}


@pytest.mark.parametrize("what", ["recording", "set of settings", "road map"])
def test_two_of_one_number_are_not_mixed(store: Any, what: str) -> None:
    """Of a digest the first 60 bits count: one that has them, and is another, is refused by name."""
    publish(store, RandomTrace(1, frames=3, road_map=map_stub(1), path="first"))
    table = {"set of settings": "config", "road map": "map"}.get(what, what)
    (digest,) = store.rows(f"SELECT digest FROM {table}").values[0]
    other = digest[:15] + "".join("0" if digit != "0" else "1" for digit in digest[15:])
    change = f"UPDATE inside.{table} SET digest = '{other}'"
    import duckdb

    store.close()
    with duckdb.connect(str(store.path)) as connection:
        connection.execute(change)
    before = store.path.read_bytes()

    second = RandomTrace(1 if what == "recording" else 2, frames=3, road_map=map_stub(1), path="b")
    second.info = replace(second.info, ego="7")
    with pytest.raises(StoreError, match=f"(?s)b: its {what} .*{other}.*by chance"):
        publish(store, second)
    assert store.path.read_bytes() == before


def test_two_traces_with_one_id_are_not_mixed(store: Any) -> None:
    trace = RandomTrace(frames=3, path="drive")
    publish(store, trace)
    writer = store  # an id is 39 bits of a digest: one that collides is made up
    other = trace_info(path="other", digest="e" * 64)
    import duckdb

    store.close()
    with duckdb.connect(str(store.path)) as connection:
        taken = Identity.id_of(other.digest, other.ego)
        connection.execute(f"UPDATE inside.trace SET trace_id = {taken}")

    with pytest.raises(StoreError, match="is taken by another trace, 'drive', by chance"):
        writer.stored(other, Config(), None)


def test_the_id_of_a_trace_is_39_bits_of_a_digest_of_recording_and_ego() -> None:
    import hashlib

    number = int(hashlib.sha256(b"abc\x0042").hexdigest(), 16)

    assert Identity.id_of("abc", "42") == number >> (256 - 39)


def test_frames_out_of_order_are_a_defect_of_the_caller(store: Any) -> None:
    trace = RandomTrace(frames=130)
    with (
        store.segment(trace.info, Config()) as segment,
        pytest.raises(ValueError, match="expected frames 0"),
    ):
        segment.append(trace.blocks[1])


def test_a_trace_without_frames_is_a_defect_of_the_caller(store: Any) -> None:
    with (
        store.segment(trace_info(), Config()) as segment,
        pytest.raises(ValueError, match="a trace without frames"),
    ):
        store.publish(segment.seal(TraceReport()))


def test_texts_that_are_no_unicode_are_kept_as_far_as_they_are(store: Any) -> None:
    trace = RandomTrace(frames=3, path="/r/drive\udcff.mcap", ego="\udcff")
    entities = trace.blocks[0].frames.entities
    odd = ("\ud800", "nul\0", "'; DROP TABLE inside.trace; --", *entities.ident[3:])
    trace.blocks[0] = replace(
        trace.blocks[0],
        frames=replace(
            trace.blocks[0].frames, entities=replace(entities, ident=odd[: len(entities)])
        ),
    )
    with store.segment(trace.info, Config()) as segment:
        for graph in trace.blocks:
            segment.append(graph)
        store.publish(segment.seal(TraceReport(warnings=["odd: \ud800"])))

    found = store.rows("SELECT ident FROM entities ORDER BY node_id LIMIT 2").values
    assert found == [("?",), ("nul\0",)]
    (stored,) = store.traces()
    assert (stored.name, stored.ego) == ("drive?", "?")
    assert stored.report["warnings"] == ["odd: ?"]


def test_a_trace_without_anything_in_it_is_still_its_frames(store: Any) -> None:
    trace = RandomTrace(frames=70)
    for graph in trace.blocks:
        for column in (graph.frames.states.x, graph.frames.states.y, graph.frames.scenery.x):
            column[:] = np.nan
    publish(store, trace)

    assert store.rows("SELECT count(*), count(x) FROM nodes").values[0][1] == 0
    assert store.rows("SELECT count(*) FROM frames").values == [(70,)]


def test_bits_of_a_bucket_are_its_frames(store: Any) -> None:
    publish(store, RandomTrace(frames=65))

    assert store.rows("SELECT valid FROM inside.bucket ORDER BY bucket").values == [
        ((1 << 60) - 1,),
        (0b11111,),
    ]


# Killed, and full


KILLED = """
import os, sys, signal
sys.path[:0] = {path!r}
from graph_blocks import RandomTrace, publish
import sgstore.store._staging as staging
from sgstore.store import StoreFile
store = StoreFile({store!r})
publish(store, RandomTrace(1, frames=130, path="first"))
lines = 0
def line(frame, event, argument):
    global lines
    if "sgstore/store" not in frame.f_code.co_filename:
        return None
    if event == "line":
        lines += 1
        if lines == {at}:
            os.kill(os.getpid(), signal.SIGKILL)
    return line
sys.settrace(line)
publish(store, RandomTrace(2, frames=130, path="second"))
sys.settrace(None)
print(lines)
"""
"""Between any two lines of the store a process may die."""


def killed_at(store: StoreFile, at: int) -> subprocess.CompletedProcess[str]:
    code = textwrap.dedent(KILLED).format(path=FOLDERS, store=str(store.path), at=at)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_a_killed_run_leaves_a_whole_store(tmp_path: Path) -> None:
    whole = StoreFile.create(tmp_path / "whole.db")
    lines = int(killed_at(whole, 10**9).stdout)
    after = content(whole)
    whole.remove("second")
    before = content(whole)
    seen = set()
    # Most of the lines make the segment; the last hundred or so are the transaction and what comes after it.
    for at in (lines // 3, lines - 30, lines - 20):
        store = StoreFile.create(tmp_path / f"{at}.db")

        run = killed_at(store, at)

        assert run.returncode == -signal.SIGKILL, run.stderr
        names = [trace.name for trace in store.traces()]
        assert content(store) == (after if "second" in names else before)
        seen.add("second" in names)
        publish(store, RandomTrace(2 if "second" not in names else 3, frames=130, path="second"))
        assert "second" in names or content(store) == after
        assert [p.name for p in tmp_path.iterdir() if p.name.startswith(f"{at}.db.")] == []
    assert seen == {True, False}


def test_what_a_dead_process_left_is_removed_and_what_a_living_one_has_is_not(store: Any) -> None:
    dead = store.path.with_name(f"{store.path.name}.segment-1-dead")
    (dead / "spill").mkdir(parents=True)
    trace = RandomTrace(frames=3, path="a")
    with store.segment(trace.info, Config()) as living:
        publish(store, RandomTrace(9, frames=3, path="b"))

        assert not dead.exists()
        assert len(beside(store)) == 1
        living.append(trace.blocks[0])
        store.publish(living.seal(TraceReport()))

    assert {t.name for t in store.traces()} == {"a", "b"}
    assert beside(store) == []


FULL = """
import resource, signal, sys
sys.path[:0] = {path!r}
from pathlib import Path
from graph_blocks import RandomTrace, publish
from sgstore.errors import StoreError
import sgstore.store._staging as staging
from sgstore.store import StoreFile
store = StoreFile({store!r})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
most = {most}
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
try:
    publish(store, RandomTrace(2, frames=130, path="second"))
except StoreError as error:
    print(error)
"""


def test_a_store_that_is_compacted_is_replaced_in_one_step(store: Any) -> None:
    publish(store, RandomTrace(1, frames=70, path="a"))
    publish(store, RandomTrace(2, frames=70, path="b"))
    store.remove("a")
    before, size = content(store), store.path.stat().st_size

    store.compact()

    assert content(store) == before
    assert store.path.stat().st_size <= size
    assert beside(store) == []


@pytest.mark.parametrize(
    ("room", "is_in"),
    [
        pytest.param(-(1 << 30), False, id="full when the trace should come in"),
        pytest.param(100_000, True, id="full when it is in and should be moved to its place"),
    ],
)
def test_a_disk_that_is_full_leaves_a_whole_store(store: Any, room: Any, is_in: Any) -> None:
    publish(store, RandomTrace(1, frames=130, path="first"))
    before = content(store)
    most = max(store.path.stat().st_size + room, 20_000)
    code = FULL.format(path=FOLDERS, store=str(store.path), most=most)

    run = subprocess.run(
        [sys.executable, "-B", "-c", code], capture_output=True, text=True, check=False
    )

    assert (f"{store.path}: " in run.stdout) != is_in, run.stderr
    assert len(store.traces()) == 1 + is_in
    assert is_in or content(store) == before
    assert [name for name in beside(store) if "segment" in name] == []
    publish(store, RandomTrace(3, frames=130, path="third"))
    assert len(store.traces()) == 2 + is_in
    assert beside(store) == []
