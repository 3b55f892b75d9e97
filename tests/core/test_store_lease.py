"""A file that stays open between questions: in nobody's way, and never one of before."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from children import process
from graph_blocks import RandomTrace, publish

import sgstore
import sgstore.store._lease as lease
from sgstore.errors import StoreError
from sgstore.store import StoreFile
from sgstore.store._locking import Access
from sgstore.store._staging import scratch

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TRACES = "SELECT count(*) FROM inside.trace"


@pytest.fixture
def store(tmp_path: Path) -> StoreFile:
    store = StoreFile.create(tmp_path / "s.db")
    publish(store, RandomTrace(1, frames=5, path="first"))
    return store


@pytest.fixture
def for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is given back because of time."""
    monkeypatch.setattr(lease, "LEASE_S", 3600.0)


def instance(store: StoreFile) -> duckdb.DuckDBPyConnection | None:
    """The instance of the database that this process keeps."""
    return lease.files[store.path.resolve()].instance


def until(true: Callable[[], bool]) -> None:
    """Wait until something is true, for ten minutes at most."""
    end = time.monotonic() + 600
    while not true():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.005)


def written_elsewhere(store: StoreFile, statement: str = "DELETE FROM inside.bits") -> None:
    """Let another process write, by means of its own."""
    code = f"import duckdb; duckdb.connect({str(store.path)!r}).execute({statement!r})"
    subprocess.run([sys.executable, "-c", code], check=True)


PUBLISHES = """
import sys
sys.path[:0] = {path!r}
from graph_blocks import RandomTrace, publish
from sgstore.store import StoreFile
store = StoreFile({store!r})
publish(store, RandomTrace({seed}, frames=5, path="t{seed}"))
print("published", flush=True)
"""

WRITES = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from sgstore.store._locking import Access
from sgstore.store._staging import scratch
store = Path({store!r})
with scratch(store.parent / "other") as connection, Access(store).attached(connection):
    print("writing", flush=True)
    sys.stdin.read()
"""

HOLDS = """
import sys
sys.path[:0] = {path!r}
import sgstore.store._lease as lease
from sgstore.store import StoreFile
lease.LEASE_S = 3600.0
store = StoreFile({store!r})
traces = len(store.traces())
print("holding", flush=True)
sys.stdin.read()
assert len(store.traces()) == traces + {more}
"""

ASKS_ON = """
import sys, threading, time
sys.path[:0] = {path!r}
from sgstore.store import StoreFile
store = StoreFile({store!r})
told = threading.Thread(target=sys.stdin.read)
told.start()
print("asking", flush=True)
while told.is_alive():
    store.rows("SELECT count(*) FROM inside.state")
"""


# It is kept


def test_the_file_stays_open_between_questions(store: Any, for_ever: None) -> None:
    store.traces()
    kept = instance(store)

    assert kept is not None
    store.rows(TRACES)
    sgstore.open(store.path).sql("SELECT 1")
    assert instance(store) is kept


def test_a_file_that_is_kept_may_be_read_by_other_processes(store: Any, for_ever: None) -> None:
    store.traces()
    with process(HOLDS, store=str(store.path), more=0):
        assert instance(store) is not None


def test_a_gate_that_a_killed_writer_left_closes_nothing(store: Any, for_ever: None) -> None:
    lease.gate_of(store.path).touch()
    store.traces()
    time.sleep(4 * lease.LOOK_S)

    assert instance(store) is not None


@pytest.mark.usefixtures("for_ever")
def test_each_store_has_the_memory_that_it_asks_for(store: Any) -> None:
    asked = "SELECT current_setting('memory_limit')"
    small, large = (StoreFile(store.path, memory=mib << 20) for mib in (300, 600))

    for _ in range(2):
        assert small.rows(asked).values == [("300.0 MiB",)]
        assert large.rows(asked).values == [("600.0 MiB",)]


# It is given back


def test_who_keeps_a_file_and_asks_nothing_lets_a_writer_in_at_once(
    store: Any, for_ever: None
) -> None:
    about = {"store": str(store.path), "more": 0}
    with (
        process(HOLDS, **about),
        process(HOLDS, **about),
        scratch(store.path.parent / "spill") as connection,
        Access(store.path).attached(connection),
    ):
        pass  # the others would keep it for an hour; the writer would give up after a minute


def test_readers_who_ask_without_pause_let_a_writer_in(store: Any) -> None:
    about = {"store": str(store.path)}
    with process(ASKS_ON, **about), process(ASKS_ON, **about):
        for _ in range(5):
            with (
                scratch(store.path.parent / "spill") as connection,
                Access(store.path).attached(connection),
            ):
                pass
            time.sleep(0.1)


def test_a_file_is_closed_some_time_after_the_last_question(
    store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A thread of its own: collections of other tests keep their bundles open, and the thread with them.
    others = {*threading.enumerate()}
    monkeypatch.setattr(lease, "_watch", lease._Watch())
    monkeypatch.setattr(lease, "LEASE_S", 0.2)
    store.traces()

    until(lambda: instance(store) is None)
    written_elsewhere(store)
    assert store.rows("FROM inside.bits").values == []
    until(lambda: "sgstore-lease" not in {one.name for one in {*threading.enumerate()} - others})


@pytest.mark.usefixtures("for_ever")
@pytest.mark.parametrize("how", ["closed", "a block", "forgotten"])
def test_a_store_that_is_not_used_any_more_gives_the_file_back_at_once(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "s.db"
    StoreFile.create(path)
    if how == "a block":
        with sgstore.open(path) as opened:
            opened.traces()
    else:
        opened = sgstore.open(path)
        opened.traces()
    if how == "closed":
        opened.close()
    if how == "forgotten":
        del opened

    with duckdb.connect(str(path)) as connection:
        connection.execute("DELETE FROM inside.bits")


@pytest.mark.usefixtures("for_ever")
def test_a_question_that_failed_leaves_nothing_open(store: Any) -> None:
    class OddError(Exception):
        pass

    with pytest.raises(OddError), store.snapshot():
        raise OddError
    assert instance(store) is None
    with pytest.raises(StoreError):
        store.rows("SELECT nothing")
    assert instance(store) is None
    with store.batches("SELECT unnest(range(10))", size=1) as batches:
        next(iter(batches))
    assert instance(store) is not None


def test_who_waits_behind_a_writer_closes_the_gate_again(store: Any) -> None:
    gate = lease.gate_of(store.path)
    found: list[bool] = []

    def write() -> None:
        with (
            scratch(store.path.parent / "spill") as connection,
            Access(store.path).attached(connection),
        ):
            found.append(gate.exists())

    second = threading.Thread(target=write)
    with process(WRITES, store=str(store.path)) as first:
        second.start()
        until(gate.exists)  # it waits
        assert first.stdin is not None
        first.stdin.close()
        first.stdin = None
        second.join()

    assert found == [True]
    assert not gate.exists()


# It is never one of before


def test_the_next_question_sees_what_another_process_has_written(
    store: Any, for_ever: None
) -> None:
    for seed in range(2, 5):
        assert store.rows(TRACES).values == [(seed - 1,)]
        with process(PUBLISHES, store=str(store.path), seed=seed):
            pass
        assert store.rows(TRACES).values == [(seed,)]


@pytest.mark.usefixtures("for_ever")
def test_the_next_question_sees_a_file_that_was_put_in_its_place(
    store: Any, tmp_path: Path
) -> None:
    other = StoreFile.create(tmp_path / "other.db")
    other.close()
    assert len(store.traces()) == 1
    other.path.replace(store.path)
    assert store.traces() == ()
    store.path.unlink()
    with pytest.raises(StoreError, match="store not found"):
        store.traces()


@pytest.mark.usefixtures("for_ever")
def test_a_lock_that_was_lost_leaves_nobody_with_an_old_file(store: Any) -> None:
    """POSIX forgets the locks of a process on a file when the process closes it, however it had opened it."""
    assert len(store.traces()) == 1
    store.path.read_bytes()
    written_elsewhere(store, "DELETE FROM inside.trace")

    assert store.traces() == ()


def test_a_file_that_was_altered_while_it_was_kept_is_refused(store: Any, for_ever: None) -> None:
    assert len(store.traces()) == 1
    store.path.read_bytes()
    written_elsewhere(store, "CREATE OR REPLACE VIEW lanes AS SELECT 1 AS x")

    with pytest.raises(StoreError, match="view 'lanes' differs"):
        store.traces()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing is forked off here")
@pytest.mark.parametrize("within", [False, True])
def test_a_process_that_was_forked_off_opens_the_file_itself(store: Any, within: bool) -> None:
    code = """
    import os, sys
    import sgstore.store._lease as lease
    from contextlib import nullcontext
    from sgstore.store import StoreFile
    lease.LEASE_S = 3600.0
    store = StoreFile({store!r})
    assert len(store.traces()) == 1
    with store.snapshot() if {within} else nullcontext():
        child = os.fork()
        if not child:
            ours = lease.files[store.path.resolve()]
            os._exit(0 if ours.instance is None and not ours.readers else 3)
        assert os.waitpid(child, 0)[1] == 0
    if not {within}:
        child = os.fork()
        if not child:
            os._exit(0 if len(StoreFile({store!r}).traces()) == len(store.traces()) == 1 else 4)
        assert os.waitpid(child, 0)[1] == 0
    assert len(store.traces()) == 1
    print("done", flush=True)
    """
    store.close()
    with process(code, store=str(store.path), within=within):
        pass


def test_threads_ask_while_the_file_comes_and_goes(
    store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lease, "LEASE_S", 0.0)
    monkeypatch.setattr(lease, "LOOK_S", 0.001)
    failures: list[BaseException] = []

    def ask() -> None:
        try:
            for number in range(30):
                assert store.rows("SELECT ?", [number]).values == [(number,)]
                time.sleep(0.002)
        except BaseException as error:  # noqa: BLE001 (told below)
            failures.append(error)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in range(20):
        store.close()
        time.sleep(0.005)
    for thread in threads:
        thread.join()

    assert failures == []
