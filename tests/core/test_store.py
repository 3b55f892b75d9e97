"""A store's face: what it opens, what it tells, how traces and frames are named."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from graph_blocks import CHANNELS, MAP, RandomTrace, map_stub, publish

from sgstore.errors import StoreError
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import RELATIONS
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(11)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreFile]:
    store = StoreFile.create(tmp_path_factory.mktemp("store") / "s.db")
    roads = map_stub(seed=1)
    for seed, name in enumerate(("drive_1", "drive_2", "night#3", "1234")):
        trace = RandomTrace(seed, frames=130, road_map=roads if seed == 0 else None, path=name)
        publish(store, trace)
    with store.snapshot():
        yield store


def content(path: Path) -> list[tuple[str, int]]:
    """Tables of a database and how many rows each has."""
    store = StoreFile(path)
    names = store.rows("SELECT schema_name || '.' || table_name FROM duckdb_tables() ORDER BY 1")
    return [
        (name, *store.rows(f"SELECT count(*) FROM {name}").values[0]) for (name,) in names.values
    ]


# Opening


def test_an_empty_store_has_no_traces(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")

    assert store.traces() == ()
    assert store.rows("SELECT * FROM nodes").values == []
    assert list(tmp_path.iterdir()) == [tmp_path / "s.db"]


def test_create_opens_what_is_a_store_already(tmp_path: Path) -> None:
    publish(StoreFile.create(tmp_path / "s.db"), RandomTrace(frames=3))

    assert len(StoreFile.create(tmp_path / "s.db").traces()) == 1


def test_what_is_not_there_is_not_opened_nor_made(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="store not found; create it with 'sgstore ingest'"):
        StoreFile(tmp_path / "none.db")

    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make", [StoreFile, StoreFile.create])
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a store"),
        (b"not a database at all" * 1000, "not a store"),
        (b"\x89MCAP0\r\n" + bytes(5000), "not a store"),
    ],
)
def test_other_files_are_refused_and_left_alone(
    tmp_path: Path, make: Any, content: Any, reason: Any
) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)

    with pytest.raises(StoreError, match=f"{path}: {reason}"):
        make(path)

    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("make", [StoreFile, StoreFile.create])
def test_a_folder_is_no_store(tmp_path: Path, make: Any) -> None:
    with pytest.raises(StoreError, match="not a store"):
        make(tmp_path)


def test_a_database_of_someone_else_s_is_refused(tmp_path: Path) -> None:
    with duckdb.connect(str(tmp_path / "other.db")) as connection:
        connection.execute("CREATE TABLE trace AS SELECT 1 AS a")

    with pytest.raises(StoreError, match="a DuckDB database, but not a store"):
        StoreFile.create(tmp_path / "other.db")


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    StoreFile.create(tmp_path / "s.db")
    with duckdb.connect(str(tmp_path / "s.db")) as connection:
        connection.execute("UPDATE inside.store_info SET value = '99' WHERE key = 'schema_version'")

    with pytest.raises(StoreError, match=r"version 99, expected \d+ .*'sgstore rebuild'"):
        StoreFile(tmp_path / "s.db")


def test_a_folder_that_is_not_there_cannot_hold_a_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="does not exist"):
        StoreFile.create(tmp_path / "x" / "s.db")


def test_the_file_can_be_read_by_the_oldest_database_that_is_supported(tmp_path: Path) -> None:
    StoreFile.create(tmp_path / "s.db")

    with duckdb.connect(str(tmp_path / "s.db"), read_only=True) as connection:
        sql = "SELECT tags['storage_version'] FROM duckdb_databases() WHERE NOT internal"
        (version,) = connection.execute(sql).fetchone()

    assert version.startswith("v1.5")


@pytest.mark.parametrize("name", ["it's a store.db", "größe.db", "s [1].db", "a;DROP TABLE.db"])
def test_a_store_may_have_any_name(tmp_path: Path, name: Any) -> None:
    store = StoreFile.create(tmp_path / name)
    publish(store, RandomTrace(frames=3))

    assert len(store.traces()) == 1
    assert list(tmp_path.iterdir()) == [tmp_path / name]


# Asking


def test_rows_have_columns_types_and_values(store: Any) -> None:
    rows = store.rows("SELECT 1 AS a, 'x' AS b, NULL::kind AS k WHERE $yes", {"yes": True})

    assert rows.columns == ("a", "b", "k")
    assert rows.types[:2] == ("INTEGER", "VARCHAR")
    assert rows.types[2].startswith("ENUM('car'")
    assert rows.values == [(1, "x", None)]
    assert rows.dicts() == [{"a": 1, "b": "x", "k": None}]


def test_columns_come_as_arrays(store: Any) -> None:
    columns = store.arrays("SELECT range AS i, nullif(range, 2) AS n FROM range(?)", [4])

    assert columns["i"].tolist() == [0, 1, 2, 3]
    assert np.ma.getmaskarray(columns["n"]).tolist() == [False, False, True, False]


def test_batches_are_all_rows_a_few_at_a_time(store: Any) -> None:
    with store.batches("SELECT range FROM range(25)", size=10) as batches:
        sizes = [len(batch) for batch in batches]

    assert batches.columns == ("range",)
    assert sizes == [10, 10, 5]


def test_questions_may_be_asked_while_a_stream_is_open(store: Any) -> None:
    with store.batches("SELECT trace_id FROM inside.trace ORDER BY name", size=1) as batches:
        names = [store.trace(trace_id).name for batch in batches for (trace_id,) in batch]

    assert names == ["1234", "drive_1", "drive_2", "night#3"]


def test_a_statement_of_ours_that_fails_is_an_error_of_the_store(store: Any) -> None:
    with pytest.raises(StoreError, match="nonesuch"):
        store.rows("SELECT * FROM nonesuch")


def test_traces_tell_what_they_are(store: Any) -> None:
    traces = {trace.name: trace for trace in store.traces()}

    trace = traces["drive_1"]
    assert list(traces) == ["1234", "drive_1", "drive_2", "night#3"]
    assert (trace.frames, trace.map, traces["drive_2"].map) == (130, "stub", "")
    assert (trace.start_ns, trace.end_ns, trace.period_ns) == (1_000, 12_900_001_000, 100_000_000)
    assert trace.answers == ("isIn", "near", "toLeftOf")
    assert trace.report["frames"] == 130
    defaults = json.loads(json.dumps(Config().as_dict()))
    assert trace.settings == {k: v for k, v in defaults.items() if k not in {"noise", "topics"}}
    assert trace.path == Path("drive_1").resolve()


def test_the_catalog_is_what_occurs(store: Any) -> None:
    catalog = store.catalog()

    sql = "SELECT relation, src_kind, dst_kind, count(*) FROM {} GROUP BY ALL"
    assert catalog.edges == {row[:3]: row[3] for row in store.rows(sql.format("edge")).values}
    assert catalog.map_edges == {row[:3]: row[3] for row in store.rows(sql.format("map_edge"))}
    assert catalog.mapped == {"off_road", "lane", "road", "junction"}
    seen = {row[0] for row in store.rows("SELECT DISTINCT kind FROM inside.state")}
    assert seen <= catalog.moving
    assert catalog.moving | catalog.fixed == {
        row[0] for row in store.rows("SELECT DISTINCT kind FROM entities")
    }
    assert (catalog.traces[1].name, catalog.traces[1].ego) == ("drive_1", "0")
    assert catalog.traces[1].answers == {"isIn", "near", "toLeftOf"}


def test_the_map_of_a_trace_is_its_text(store: Any) -> None:
    assert store.road_map_text("drive_1") == ("stub", "<OpenDRIVE seed='1'/>")
    assert store.road_map_text("drive_2") is None


def test_channels_and_context_are_those_of_the_recording(store: Any) -> None:
    assert store.channels("drive_1") == CHANNELS
    context = store.context("drive_1")
    assert context.channel.tolist() == [MAP]
    assert [context.chunk_offset[0], context.offset[0], context.length[0]] == [100, 17, 42]


# Names of traces and frames


@pytest.mark.parametrize("ref", ["drive_1", "night#3", "night", "1234"])
def test_a_trace_is_named_by_name_or_unique_beginning(store: Any, ref: Any) -> None:
    assert store.trace(ref).name.startswith(ref)


def test_a_trace_is_named_by_its_id(store: Any) -> None:
    trace = store.trace("drive_2")

    assert store.trace(trace.trace_id) == store.trace(str(trace.trace_id)) == trace


@pytest.mark.parametrize(
    ("ref", "reason"),
    [
        ("drive", "several traces begin with 'drive': 'drive_1', 'drive_2'"),
        ("driv_1", "no trace 'driv_1'; did you mean 'drive_1'?"),
        ("xyz", "no trace 'xyz'; there are: '1234', 'drive_1', 'drive_2', 'night#3'"),
        ("", "no trace ''; there are"),
    ],
)
def test_a_trace_that_is_not_there_is_told_from_those_that_are(
    store: Any, ref: Any, reason: Any
) -> None:
    with pytest.raises(StoreError, match=reason):
        store.trace(ref)


def test_a_frame_is_named_by_its_id(store: Any) -> None:
    frame = store.frame("drive_1#77")

    assert store.frame(frame.frame_id) == store.frame(str(frame.frame_id)) == frame
    assert (frame.trace, frame.seq, frame.time_ns) == ("drive_1", 77, 7_700_001_000)
    assert frame.trace_id == frame.frame_id >> 24


@pytest.mark.parametrize(
    ("ref", "trace", "seq"),
    [
        ("drive_1#0", "drive_1", 0),
        ("drive_1#129", "drive_1", 129),
        ("night#3#7", "night#3", 7),
        ("night#3@1s", "night#3", 10),
        ("1234#5", "1234", 5),
        ("drive_1@0", "drive_1", 0),
        ("drive_1@0s", "drive_1", 0),
        ("drive_1@6.25s", "drive_1", 62),
        ("drive_1@12.9 s", "drive_1", 129),
    ],
)
def test_a_frame_is_named_by_its_place_or_time_in_its_trace(
    store: Any, ref: Any, trace: Any, seq: Any
) -> None:
    frame = store.frame(ref)

    assert (frame.trace, frame.seq) == (trace, seq)
    assert frame.t == pytest.approx(seq / 10)


@pytest.mark.parametrize(
    ("ref", "reason"),
    [
        ("drive_1#130", "no frame #130 in 'drive_1'; it has frames #0 … #129, 0 s … 12.9 s"),
        ("drive_1@13s", "no frame at 13 s in 'drive_1'; it has frames #0 … #129, 0 s … 12.9 s"),
        ("drive_1@-1s", "no frame at -1 s in 'drive_1'"),
        ("drive_1#x", "'#x'; expected a whole number, as in #12"),
        (f"drive_1@{'9' * 400}s", "no frame at 9{400} s in 'drive_1'"),
        ("drive_1@noon", "'@noon'; expected seconds, as in @12.3s"),
        ("drive_1", "not a frame: 'drive_1'; expected a frame_id, TRACE#SEQ, or TRACE@12.3s"),
        ("driv_1#5", "did you mean 'drive_1'"),
        ("99", "no frame 99 in the store"),
        ("", "not a frame: ''"),
        ("drive_1#99999999999999999999", "expected a whole number"),
        ("99999999999999999999", "not a frame"),
        ("9223372036854775808", "no frame 9223372036854775808"),
    ],
)
def test_a_frame_that_is_not_there_is_told_from_those_that_are(
    store: Any, ref: Any, reason: Any
) -> None:
    with pytest.raises(StoreError, match=reason):
        store.frame(ref)


def test_a_time_that_jumps_back_still_names_the_last_frame_at_or_before(tmp_path: Path) -> None:
    trace = RandomTrace(frames=6)
    trace.blocks[0].frames.time_ns[:] = np.array([0, 1, 2, 1, 2, 3]) * 1_000_000_000
    store = StoreFile.create(tmp_path / "s.db")
    name = publish(store, trace)

    assert [store.frame(f"{name}@{t}s").seq for t in (0, 1, 1.5, 2, 3)] == [0, 3, 3, 4, 5]


# Removing


def test_a_removed_trace_leaves_nothing_behind(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    roads = map_stub()
    publish(store, RandomTrace(1, road_map=roads, path="one"))
    before = content(tmp_path / "s.db")
    publish(
        store, RandomTrace(2, road_map=map_stub(seed=5), path="two"), Config(range=RangeSettings(9))
    )

    (gone,) = store.remove("two")

    assert gone.name == "two"
    assert content(tmp_path / "s.db") == before
    assert [trace.name for trace in store.traces()] == ["one"]


def test_many_traces_are_removed_in_several_transactions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database keeps the deletions of a transaction in memory."""
    store = StoreFile.create(tmp_path / "s.db")
    names = [publish(store, RandomTrace(n, path=f"trace {n}")) for n in range(5)]
    before = store.stamp
    monkeypatch.setattr(sys.modules[StoreFile.__module__], "_AT_ONCE", 2)

    gone = store.remove(*names[:4])

    assert [trace.name for trace in gone] == names[:4]
    assert [trace.name for trace in store.traces()] == names[4:]
    assert store.stamp != before


def test_a_map_stays_while_a_trace_lies_on_it(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    roads = map_stub()
    for seed, name in enumerate(("one", "two")):
        publish(store, RandomTrace(seed, road_map=roads, path=name))

    store.remove("one")

    assert store.road_map_text("two") == (roads.name, roads.text)


def test_a_removed_trace_can_come_again(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    trace = RandomTrace(1, road_map=map_stub())
    name = publish(store, trace)
    before = store.rows("SELECT * FROM edges ORDER BY ALL").values

    store.remove(name)
    publish(store, RandomTrace(1, road_map=map_stub()))

    assert store.rows("SELECT * FROM edges ORDER BY ALL").values == before


def test_what_is_not_there_cannot_be_removed(store: Any) -> None:
    with pytest.raises(StoreError, match="no trace 'nonesuch'"):
        store.remove("nonesuch")


def test_a_compacted_store_gives_the_same_answers(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    roads = map_stub()
    for seed in range(3):
        publish(store, RandomTrace(seed, frames=70, road_map=roads, path=f"d{seed}"))
    views = ("frames", "nodes", "edges", "lane_states", "pairs")

    def everything() -> list[list[tuple[object, ...]]]:
        return [store.rows(f"SELECT * FROM {view} ORDER BY ALL").values for view in views]

    before = everything()
    store.compact()

    assert everything() == before
    relations = [row[0] for row in store.rows("SELECT relation FROM inside.edge ORDER BY rowid")]
    assert relations == sorted(relations, key=RELATIONS.index)
    assert content(tmp_path / "s.db")


def test_an_empty_store_is_small_and_one_written_anew_stays_so(tmp_path: Path) -> None:
    file = StoreFile.create(tmp_path / "s.db")
    publish(file, RandomTrace(1, frames=60))
    for _ in range(2):
        file.close()
        with duckdb.connect(str(file.path), read_only=True) as connection:
            (size,) = connection.execute("SELECT block_size FROM pragma_database_size()").fetchone()
        assert size == 1 << 16
        file.compact()
