"""What one transaction brings: a trace as a whole or nothing of it, and of a replaced one nothing stays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from graph_blocks import PERIOD_NS, RandomTrace, map_stub, publish
from thorough import LONG

import sgstore.store._locking as access
import sgstore.store._publish as publishing
from sgstore.ingest import ingest
from sgstore.model.config import Config, RangeSettings
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(12)

TABLES = "SELECT table_name FROM duckdb_tables() WHERE NOT internal ORDER BY table_name"


def content(store: StoreFile) -> dict[str, list[tuple[Any, ...]]]:
    """Every row of every table, but for when traces came."""
    with store.snapshot():
        tables = [table for (table,) in store.rows(TABLES)]
        return {
            table: store.rows(
                f"SELECT * {'EXCLUDE (ingested_at)' * (table == 'trace')} FROM {table} ORDER BY ALL"
            ).values
            for table in tables
        }


class InterruptedConnection:
    """A connection that is interrupted before one of its writes, by its number."""

    def __init__(self, real: duckdb.DuckDBPyConnection, number: int) -> None:
        self._real, self._left, self.done = real, number, 0

    def execute(self, statement: str, *values: Any) -> Any:
        if any(word in statement for word in ("INSERT", "DELETE", "UPDATE")):
            if self._left == 0:
                self._left = -1
                raise KeyboardInterrupt
            self._left -= 1
            self.done += 1
        return self._real.execute(statement, *values)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Has what publishes in a store be interrupted before its write of a number."""

    def at(number: int) -> None:
        for name in ("_publish", "remove"):
            real = getattr(publishing, name)

            def wrapped(connection: Any, *args: Any, real: Any = real, **how: Any) -> Any:
                return real(InterruptedConnection(connection, number), *args, **how)

            monkeypatch.setattr(publishing, name, wrapped)

    yield at
    monkeypatch.undo()


def sealed(store: StoreFile, trace: RandomTrace, config: Config | None = None) -> Any:
    segment = store.segment(
        trace.info, config or Config(), road_map=trace.road_map, answers=trace.answers
    )
    for graph in trace.blocks:
        segment.append(graph)
    return segment.seal(TraceReport(frames=trace.frames))


@pytest.mark.parametrize("number", [0, 1, 2, 3, 5, 8, 13, 20, 25] if LONG else [0, 2, 8, 20])
def test_an_interrupt_inside_publishing_publishes_nothing(
    tmp_path: Path, interrupted: Any, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=70, road_map=map_stub(), path="first"))
    before = content(store)
    ready = sealed(store, RandomTrace(2, frames=70, road_map=map_stub(seed=5), path="second"))

    interrupted(number)
    with pytest.raises(KeyboardInterrupt):
        store.publish(ready)
    monkeypatch.undo()

    assert content(store) == before
    assert store.verify().faults == []
    assert store.publish(ready) == "second"
    assert store.verify().faults == []


@pytest.mark.parametrize("number", [0, 4, 9, 17, 24] if LONG else [0, 9, 24])
def test_an_interrupt_inside_replacing_leaves_the_old_trace(
    tmp_path: Path, interrupted: Any, number: int
) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=70, road_map=map_stub(), path="first"))
    before = content(store)
    ready = sealed(store, RandomTrace(1, frames=80, path="first"), Config(range=RangeSettings(9)))

    interrupted(number)
    with pytest.raises(KeyboardInterrupt):
        store.publish(ready, replace=True)

    assert content(store) == before


def test_an_interrupt_inside_ingest_is_told_and_the_store_stays_whole(
    town_store: Path, interrupted: Any, tmp_path: Path
) -> None:
    from recordings import drive

    before = content(StoreFile(town_store))
    interrupted(7)
    with pytest.raises(KeyboardInterrupt):
        ingest(town_store, [drive(tmp_path / "b.mcap", frames=11)])

    assert content(StoreFile(town_store)) == before


def fail_after_a_write(connection: duckdb.DuckDBPyConnection, error: type[BaseException]) -> None:
    connection.execute("DELETE FROM store.inside.trace")
    raise error


def test_what_fails_in_a_transaction_is_undone_and_the_store_is_free(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=5, path="first"))
    before = content(store)
    opened = access.Access(store.path, memory=1 << 28, wait_s=5)

    for error in (KeyboardInterrupt, SystemExit, ValueError):
        connection = duckdb.connect()
        with pytest.raises(error), opened.writing(connection):
            fail_after_a_write(connection, error)
        assert content(store) == before


def test_a_replaced_trace_leaves_nothing_behind(tmp_path: Path) -> None:
    """Neither its settings nor its map, nor what was counted of it."""
    store, fresh = (StoreFile.create(tmp_path / f"{name}.db") for name in ("s", "fresh"))
    publish(store, RandomTrace(1, frames=70, road_map=map_stub(), path="first"))
    new = RandomTrace(1, frames=80, road_map=map_stub(seed=5), path="first")
    ready = sealed(store, new, Config(range=RangeSettings(9)))

    assert store.publish(ready, replace=True) == "first"

    again = RandomTrace(1, frames=80, road_map=map_stub(seed=5), path="first")
    publish(fresh, again, Config(range=RangeSettings(9)))
    sizes = {
        name: {table: len(rows) for table, rows in content(one).items()}
        for name, one in (("replaced", store), ("fresh", fresh))
    }
    assert sizes["replaced"] == sizes["fresh"]
    assert store.verify().faults == []


@pytest.mark.parametrize(
    ("steps", "runs"),
    [
        ([1, 1, 1, 1, 1], [(0, 5)]),
        ([1, 0, 1, 1, 1], [(0, 5)]),  # two frames of one time follow one another
        ([1, 1, -1, 1, 1], [(0, 2), (3, 5)]),
        ([1, 2.5, 1, 1, 1], [(0, 5)]),
        ([1, 2.6, 1, 1, 1], [(0, 1), (2, 5)]),
        ([0, 0, 1, 1, 1], [(0, 5)]),
    ],
)
def test_frames_go_on_over_equal_times_and_not_over_gaps_nor_back(
    tmp_path: Path, steps: list[float], runs: list[tuple[int, int]]
) -> None:
    """The same by intervals of a query, by a check, and by the masks of the store."""
    trace = RandomTrace(3, frames=6, path="t")
    times = np.cumsum([0, *steps]) * PERIOD_NS
    trace.blocks[0].frames.time_ns[:] = times.astype(np.int64) + 1_000
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, trace)
    ((_, joined),) = store.rows("SELECT valid, joined FROM inside.bucket").values

    starts = {first for first, _ in runs}
    assert {bit for bit in range(6) if not joined >> bit & 1} == starts
    asked = Store(store.path)
    there: dict[int, list[int]] = {}
    for node, seq in asked.sql("SELECT node_id, seq FROM nodes JOIN frames USING (frame_id)"):
        there.setdefault(node, []).append(seq)
    expected = []
    for seqs in map(sorted, there.values()):
        begins = [seq for seq in seqs if seq in starts or seq - 1 not in seqs]
        ends = [seq for seq in seqs if seq + 1 in starts or seq + 1 not in seqs]
        expected += zip(begins, ends, strict=True)
    found = [(i.start_seq, i.end_seq) for i in asked.find("MATCH (a)").intervals()]
    assert sorted(found) == sorted(expected)
    assert store.verify().faults == []
