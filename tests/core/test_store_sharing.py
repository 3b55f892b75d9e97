"""One writer, many readers, threads and processes: everyone waits for the others, nobody for ever."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from children import process
from graph_blocks import RandomTrace, publish

from sgstore.errors import StoreError
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(9)

TORN = """
  SELECT (SELECT coalesce(sum(frames), 0) FROM inside.trace) = (SELECT count(*) FROM inside.frame)
     AND (SELECT count(*) FROM inside.trace) = (SELECT count(DISTINCT trace_id) FROM inside.bucket)
"""
"""True of a store that holds whole traces only."""


@pytest.fixture
def store(tmp_path: Path) -> StoreFile:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=5, path="first"))
    return store


@contextmanager
def let_go_later(child: subprocess.Popen[str]) -> Iterator[threading.Event]:
    """Lets a process go on after a while; the event is set before."""
    going = threading.Event()

    def let_go() -> None:
        going.set()
        assert child.stdin is not None
        child.stdin.close()

    timer = threading.Timer(0.4, let_go)
    timer.start()
    yield going
    timer.join()
    child.stdin = None


READS = """
import sys
sys.path[:0] = {path!r}
from sgstore.store import StoreFile
store = StoreFile({store!r})
with store.snapshot():
    print("reading", flush=True)
    sys.stdin.read()
    assert len(store.traces()) == 1
"""

WRITES = """
import duckdb, sys
connection = duckdb.connect({store!r})
print("writing", flush=True)
sys.stdin.read()
connection.close()
"""


def test_a_writer_waits_until_a_reader_is_done(store: Any) -> None:
    with process(READS, store=str(store.path)) as reader, let_go_later(reader) as going:
        publish(store, RandomTrace(2, frames=5, path="second"))
        assert going.is_set()

    assert len(store.traces()) == 2


def test_a_reader_waits_until_a_writer_is_done(store: Any) -> None:
    with process(WRITES, store=str(store.path)) as writer, let_go_later(writer) as going:
        assert len(store.traces()) == 1
        assert going.is_set()


def test_a_reader_does_not_wait_for_ever(store: Any) -> None:
    with process(WRITES, store=str(store.path)):
        start = time.perf_counter()
        with pytest.raises(StoreError, match="in use by another process for too long"):
            StoreFile(store.path, wait_s=0.3)
        assert time.perf_counter() - start > 0.25


def test_a_writer_does_not_wait_for_ever_and_changes_nothing(store: Any) -> None:
    hasty = StoreFile(store.path, wait_s=0.3)
    with (
        process(READS, store=str(store.path)),
        pytest.raises(StoreError, match="in use by another process for too long"),
    ):
        publish(hasty, RandomTrace(2, frames=5, path="second"))

    assert len(store.traces()) == 1
    assert [p.name for p in store.path.parent.iterdir()] == [store.path.name]


def test_readers_of_many_processes_read_at_once(store: Any) -> None:
    with process(READS, store=str(store.path)):
        assert len(StoreFile(store.path, wait_s=0.3).traces()) == 1


READS_ON = """
import sys, threading, time
sys.path[:0] = {path!r}
from sgstore.store import StoreFile
store = StoreFile({store!r})
told = threading.Thread(target=sys.stdin.read)
told.start()
print("reading", flush=True)
while told.is_alive():
    assert store.rows({torn!r}).values == [(True,)]
    with store.snapshot():
        time.sleep(0.02)
"""


def test_a_stream_of_readers_does_not_keep_a_writer_out(store: Any) -> None:
    about = {"store": str(store.path), "torn": TORN}
    with process(READS_ON, **about), process(READS_ON, **about), process(READS_ON, **about):
        for seed in range(2, 5):
            publish(store, RandomTrace(seed, frames=5, path=f"t{seed}"))

    assert len(store.traces()) == 4


ASKS = """
import sys
sys.path[:0] = {path!r}
from sgstore.store import StoreFile
print("asking", flush=True)
traces = StoreFile({store!r}).traces()
sys.stdin.read()
assert len(traces) == 2, "it came before the writer who waited longer"
"""


def test_who_comes_while_a_writer_waits_comes_after_it(store: Any) -> None:
    about = {"store": str(store.path)}
    writer = threading.Thread(target=publish, args=(store, RandomTrace(2, frames=5, path="b")))
    with process(READS, **about) as reader:
        writer.start()
        gate = store.path.with_name(f"{store.path.name}.gate")
        while not gate.exists():
            time.sleep(0.01)
        time.sleep(0.2)
        with process(ASKS, **about):
            time.sleep(0.7)  # it would have read by now, beside the reader
            assert reader.stdin is not None
            reader.stdin.close()
            reader.stdin = None
            writer.join()


def test_an_interrupt_just_after_the_gate_was_made_leaves_no_gate(
    store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, gate = os.open, f"{store.path}.gate"

    def interrupted(path: Any, *more: Any, **named: Any) -> int:
        number = opened(path, *more, **named)
        if str(path) == gate:
            monkeypatch.undo()
            raise KeyboardInterrupt
        return number

    monkeypatch.setattr(os, "open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        publish(store, RandomTrace(2, frames=5, path="b"))

    assert not Path(gate).exists()
    publish(store, RandomTrace(2, frames=5, path="b"))
    assert len(store.traces()) == 2


def test_threads_read_while_one_writes_and_see_whole_traces(store: Any) -> None:
    stop, failures, reads = threading.Event(), [], []

    def read() -> None:
        try:
            while not stop.is_set():
                assert store.rows(TORN).values == [(True,)]
                reads.append(len(store.traces()))
        except BaseException as error:  # noqa: BLE001 (told below)
            failures.append(error)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for seed in range(2, 6):
        publish(store, RandomTrace(seed, frames=5, path=f"t{seed}"))
    stop.set()
    for thread in threads:
        thread.join()

    assert failures == []
    assert len(set(reads)) > 1
    assert len(store.traces()) == 5


def test_a_snapshot_stays_as_it_is_while_others_publish(store: Any) -> None:
    with store.snapshot():
        writer = threading.Thread(target=publish, args=(store, RandomTrace(2, frames=5, path="b")))
        writer.start()
        time.sleep(0.3)
        seen = [len(store.traces()) for _ in range(3)]  # would wait for the writer who waits for us
    writer.join()

    assert seen == [1, 1, 1]
    assert len(store.traces()) == 2


def test_who_reads_cannot_write_at_once_and_is_told(store: Any) -> None:
    with (
        store.snapshot(),
        pytest.raises(StoreError, match="cannot be written while the same thread reads it"),
    ):
        publish(store, RandomTrace(2, frames=5, path="b"))


def test_two_writers_take_turns(store: Any) -> None:
    threads = [
        threading.Thread(target=publish, args=(store, RandomTrace(seed, frames=5, path=f"t{seed}")))
        for seed in range(2, 6)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(store.traces()) == 5
    assert store.rows(TORN).values == [(True,)]


def test_the_lock_of_a_writer_holds_while_its_process_looks_elsewhere(
    store: Any, tmp_path: Path
) -> None:
    other = StoreFile.create(tmp_path / "other.db")
    connection = duckdb.connect()
    with StoreFile(store.path).access.writing(connection):
        other.traces()  # closes another file of this process
        code = f"import duckdb; duckdb.connect({str(store.path)!r}, read_only=True)"
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False
        )

    assert "Could not set lock" in run.stderr


def test_no_write_ahead_log_is_left_at_rest(store: Any) -> None:
    publish(store, RandomTrace(2, frames=5, path="b"))

    assert [p.name for p in store.path.parent.iterdir()] == [store.path.name]


def test_the_file_is_free_between_questions(store: Any) -> None:
    store.traces()
    publish(store, RandomTrace(2, frames=5, path="b"))
    code = f"import duckdb; duckdb.connect({str(store.path)!r}).execute('DELETE FROM inside.bits')"

    subprocess.run([sys.executable, "-c", code], check=True)

    assert store.rows("SELECT * FROM inside.bits").values == []
