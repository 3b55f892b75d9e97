"""Whether a store is as it was published: every kind of change is found, and nothing else."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from graph_blocks import RandomTrace, map_stub, publish
from recordings import drive
from thorough import some

import sgstore.store._verify as verifying
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.store import StoreFile
from sgstore.store._checksums import Checksum
from sgstore.store._columns import REPEATED

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.store._verify import Fault

pytestmark = pytest.mark.seconds(16)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    store = StoreFile.create(tmp_path_factory.mktemp("published") / "s.db")
    roads = map_stub()
    publish(store, RandomTrace(1, frames=130, road_map=roads, path="one"))
    publish(store, RandomTrace(2, frames=70, path="two"))
    return store.path.read_bytes()


@pytest.fixture
def store(published: Any, tmp_path: Path) -> StoreFile:
    (tmp_path / "s.db").write_bytes(published)
    return StoreFile(tmp_path / "s.db")


def faults(store: StoreFile) -> list[Fault]:
    return store.verify().faults


def change(store: StoreFile, *statements: str) -> None:
    store.close()
    with duckdb.connect(str(store.path)) as connection:
        for statement in statements:
            connection.execute(statement)


def test_what_was_published_is_without_fault(store: Any) -> None:
    found = store.verify()

    assert found.faults == []
    assert found.traces == 2
    tables = ("trace", "channel", "context", "entity", "bucket", "frame", "state", "node", "edge")
    tables += (
        *REPEATED,
        *REPEATED.values(),
        "payload",
        "map",
        "map_node",
        "map_edge",
        "map_reach",
        "map_place",
        "map_course",
    )
    tables += ("frame_class", "lane_role", "recording", "config")
    count = sum(store.rows(f"SELECT count(*) FROM {table}").values[0][0] for table in tables)
    assert found.rows == count


def test_what_was_compacted_is_without_fault(store: Any) -> None:
    store.remove("two")
    publish(store, RandomTrace(3, frames=70, road_map=map_stub(5), path="three"))
    store.compact()

    assert faults(store) == []


CHANGES = {
    "a value": (
        "UPDATE inside.state SET x = x + 0.001 WHERE frame_id = (SELECT max(frame_id) FROM inside.state)",
        "rows",
    ),
    "a value that goes missing": (
        "UPDATE inside.state SET vy = NULL WHERE frame_id = (SELECT min(frame_id) FROM inside.state)",
        "rows",
    ),
    "a text": ("UPDATE inside.entity SET ident = 'other' WHERE node_id = 0", "rows"),
    "a row too few": (
        "DELETE FROM inside.edge WHERE src = (SELECT max(src) FROM inside.edge)",
        "rows",
    ),
    "a row too many": (
        "INSERT INTO inside.frame SELECT * REPLACE (frame_id + 1 AS frame_id) FROM inside.frame"
        " WHERE frame_id = (SELECT max(frame_id) FROM inside.frame)",
        "frames",
    ),
    "states behind the last frame": (
        "INSERT INTO inside.state SELECT * REPLACE (frame_id + 640 AS frame_id) FROM inside.state"
        " WHERE frame_id = (SELECT max(frame_id) FROM inside.state)",
        "references",
    ),
    "a frame twice": (
        "INSERT INTO inside.frame SELECT * FROM inside.frame WHERE seq = 3",
        "frames",
    ),
    "an empty mask": (
        "UPDATE inside.edge SET mask = 0 WHERE src = (SELECT min(src) FROM inside.edge)",
        "masks",
    ),
    "a mask beyond the frames": ("UPDATE inside.edge SET mask = mask | (1::BIGINT << 59)", "masks"),
    "a mask of nodes beyond the frames": (
        "UPDATE inside.node SET mask = mask | (1::BIGINT << 59)",
        "masks",
    ),
    "a bucket": ("UPDATE inside.bucket SET valid = 1", "masks"),
    "an edge from nobody": ("UPDATE inside.edge SET src = 9999 WHERE src >= 0", "references"),
    "an edge to another kind": ("UPDATE inside.edge SET dst_kind = 'animal'", "references"),
    "a lane that is not in the map": ("UPDATE inside.lane_single SET lane = -9999", "references"),
    "a repeated row beyond the frames": (
        "INSERT INTO inside.lane_repeated BY NAME SELECT kind, max(bucket) OVER () AS bucket,"
        " 1::BIGINT << 59 AS mask, node_id, lane, is_primary, is_own, is_ego FROM inside.lane_single LIMIT 1",
        "masks",
    ),
    "a repeated row of no frame": (
        "INSERT INTO inside.gap_repeated BY NAME SELECT bucket, 0 AS mask, src, dst FROM inside.edge LIMIT 1",
        "masks",
    ),
    "a state beyond the graph that is in it": (
        "INSERT INTO inside.world_state SELECT * FROM inside.state WHERE NOT is_ego LIMIT 1",
        "references",
    ),
    "a node beyond the graph beyond the frames": (
        "INSERT INTO inside.world_node SELECT * REPLACE (mask | (1::BIGINT << 59) AS mask) FROM inside.node",
        "masks",
    ),
    "an edge beyond the graph to another kind": (
        "INSERT INTO inside.world_edge SELECT * REPLACE ('animal' AS dst_kind) FROM inside.edge LIMIT 1",
        "references",
    ),
    "an ego that is nobody": ("UPDATE inside.frame SET ego = 9999", "references"),
    "settings that are gone": ("DELETE FROM inside.config", None),
    "a recording that is gone": ("DELETE FROM inside.recording", None),
    "another place of a recording": ("UPDATE inside.recording SET uri = '/other.mcap'", "rows"),
    "another number of a map": ("UPDATE inside.map SET map_id = map_id + 1", "references"),
    "a digest that is not of the number": (
        "UPDATE inside.config SET digest = '1' || digest",
        "references",
    ),
    "a channel that is gone": (
        "INSERT INTO inside.payload SELECT bucket, bit, trace_id, 99, 0, 0, 0, 1 FROM inside.frame",
        "references",
    ),
    "a map that is changed": ("UPDATE inside.map SET text = text || ' '", "map"),
    "a lane of a map": ("UPDATE inside.map_node SET x = x + 1 WHERE node_id = -2", "map"),
    "an edge of a map to nowhere": ("UPDATE inside.map_edge SET dst = -9999", "map"),
    "a way along lanes to nowhere": ("UPDATE inside.map_reach SET dst = -9999", "map"),
    "a manifest that is gone": ("DELETE FROM inside.manifest WHERE owner = 'trace'", "rows"),
    "a trace that says otherwise": ("UPDATE inside.trace SET frames = 7", "frames"),
}


@pytest.mark.parametrize("what", some([*CHANGES], 5))
def test_a_change_is_found_and_named(store: Any, what: Any) -> None:
    statement, check = CHANGES[what]

    change(store, statement)

    found = faults(store)
    assert store.rows("SELECT count(*) FROM inside.trace").values == [(2,)]
    if check is None:  # without its settings no trace is listed any more
        assert {fault.check for fault in found} == {"references"}
    else:
        assert check in {fault.check for fault in found}
    assert all(fault.detail for fault in found)


def test_a_random_number_that_changes_is_found(store: StoreFile) -> None:
    numbers = "column_name, table_name FROM duckdb_columns() WHERE schema_name = 'inside'"
    listed = store.rows(
        f"SELECT {numbers} AND data_type IN ('FLOAT', 'DOUBLE', 'INTEGER', 'BIGINT')"
        " AND table_name <> 'manifest' AND table_name IN"
        " (SELECT table_name FROM duckdb_tables() WHERE estimated_size > 0)"
    ).values
    column, table = random.choice(listed)
    rows = store.rows(f"SELECT rowid FROM inside.{table}").values
    (row,) = random.choice(rows)

    change(
        store,
        f'UPDATE inside.{table} SET "{column}" = coalesce("{column}", 0) + 1 WHERE rowid = {row}',
    )

    assert faults(store), (table, column, row)


def test_a_fault_is_told_of_the_trace_that_has_it(store: Any) -> None:
    trace_id = store.trace("two").trace_id
    change(store, f"UPDATE inside.state SET speed = 99 WHERE frame_id >> 24 = {trace_id}")

    assert [(f.trace, f.check, f.detail) for f in faults(store)] == [
        ("two", "rows", "table state holds other values than were published")
    ]


@pytest.mark.parametrize("rows", [1, 30])
def test_it_does_not_matter_in_what_pieces_a_store_is_read(
    store: Any, monkeypatch: pytest.MonkeyPatch, rows: Any
) -> None:
    monkeypatch.setattr(verifying, "_ROWS_TOGETHER", rows)

    assert faults(store) == []


def test_a_file_that_is_damaged_is_told(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=600, path="one", moving=20))
    content = bytearray(store.path.read_bytes())
    rng = np.random.default_rng(0)
    told, named = 0, set[str]()
    for at in rng.integers(len(content) // 4, len(content), 12).tolist():
        hurt = bytearray(content)
        hurt[at] ^= 0x55
        (tmp_path / "hurt.db").write_bytes(hurt)
        try:
            faults = StoreFile(tmp_path / "hurt.db").verify().faults
            told += bool(faults)
            named |= {fault.trace for fault in faults if "Corrupt" in fault.detail}
            assert {fault.remedy for fault in faults} <= {"run 'sgstore rebuild'"}
        except StoreError:
            told += 1
    # Some bytes of a file belong to nothing.
    assert told >= 6
    assert "one" in named, named


def test_recordings_are_hashed_again_where_that_is_asked_for(tmp_path: Path) -> None:
    paths = [
        drive(tmp_path / f"{name}.mcap", frames=n) for name, n in (("a", 4), ("b", 5), ("c", 6))
    ]
    ingest(tmp_path / "s.db", paths)
    store = StoreFile(tmp_path / "s.db")
    assert store.verify(recordings=True).faults == []

    content = bytearray(paths[0].read_bytes())
    content[len(content) // 2] ^= 1
    paths[0].write_bytes(content)
    paths[1].unlink()

    found = store.verify(recordings=True)
    assert store.verify().faults == []
    assert found.recordings == 3
    assert [(f.trace, f.check) for f in found.faults] == [("a", "payloads"), ("b", "payloads")]
    assert "not the file that was ingested" in found.faults[0].detail
    assert "file not found" in found.faults[1].detail


# Checksums


def checksum(**columns: object) -> Checksum:
    found = Checksum()
    found.add({name: np.ma.asarray(values) for name, values in columns.items()})
    return found


def test_a_checksum_is_of_rows_in_any_order_and_in_any_pieces() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 9, 50), rng.random(50).astype(np.float32)
    whole = checksum(a=a, b=b)

    order = rng.permutation(50)
    pieces = Checksum()
    pieces.add({"b": b[:20], "a": a[:20]})
    pieces.add({"a": a[20:], "b": b[20:]})

    assert checksum(a=a[order], b=b[order]) == whole == pieces
    assert checksum(a=a[order], b=b) != whole


def test_values_that_differ_have_other_checksums() -> None:
    values = [0, 1, -1, 2**40, 0.0, 1.5, np.float32(1.5), True]
    masked = np.ma.array([0], mask=[True])
    found = [checksum(a=[value]).value for value in values] + [checksum(a=masked).value]

    # What is 0 or 1 is so in any type.
    assert len(set(found)) == len(found) - 2
    assert checksum(a=[1, 2], b=[2, 1]) != checksum(a=[2, 1], b=[2, 1])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_there_is_one_zero_since_not_every_database_keeps_its_sign(kind: Any) -> None:
    zeros, other = np.array([0.0, -0.0], kind), np.array([-0.0, 0.0], kind)

    assert checksum(a=zeros, b=[1, 2]) == checksum(a=other, b=[1, 2])
    assert checksum(a=zeros[:1]) == checksum(a=other[:1])


def test_checksums_are_those_of_the_text_book() -> None:
    mask = (1 << 64) - 1

    def mixed(word: int) -> int:  # SplitMix64, from its paper
        word = ((word ^ word >> 30) * 0xBF58476D1CE4E5B9) & mask
        word = ((word ^ word >> 27) * 0x94D049BB133111EB) & mask
        return word ^ word >> 31

    rows = [(3, -5), (7, 2**40)]
    steps = [(n + 1) * 0x9E3779B97F4A7C15 & mask for n in range(2)]
    total = 0
    for row in rows:
        word = 0
        for value, step in zip(row, steps, strict=True):
            word = mixed((word + ((value & mask) ^ step)) & mask)
        total += word

    a, b = (np.array(column) for column in zip(*rows, strict=True))
    assert checksum(a=a, b=b) == Checksum(2, total & ((1 << 63) - 1))


def test_removing_takes_everything_of_a_trace_and_its_checksums(store: Any, tmp_path: Path) -> None:
    (gone,) = store.remove("one")

    low, high = gone.trace_id << 24, (gone.trace_id + 1) << 24
    for table in ("state", "lane_state"):
        sql = f"SELECT count(*) FROM {table} WHERE frame_id BETWEEN {low} AND {high}"
        assert store.rows(sql).values == [(0,)]
    assert store.rows("SELECT DISTINCT id FROM inside.manifest WHERE owner = 'trace'").values == [
        (store.trace("two").trace_id,)
    ]
    assert faults(store) == []


def test_of_traces_to_remove_all_go_or_none(store: StoreFile, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no trace 'three'"):
        store.remove("one", "three")

    assert [trace.name for trace in store.traces()] == ["one", "two"]
    assert [trace.name for trace in store.remove("one", "two", "one")] == ["one", "two"]
    assert store.traces() == ()
    assert faults(store) == []
