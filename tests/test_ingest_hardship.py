"""Killed, interrupted, without room, and with readers all the while: the store stays whole."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from killing import begun, content, killed_and_resumed, made
from recordings import drive
from soaking import soak

from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.store import StoreFile


def test_a_killed_run_goes_on_and_ends_with_the_same_store(tmp_path) -> None:
    done = killed_and_resumed(tmp_path, kills=5, seed=5, frames=70)

    assert done["kills"] >= 5


def test_readers_and_a_writer_meet_no_lock_and_no_half_trace(tmp_path) -> None:
    soaked = soak(tmp_path, seconds=4)

    assert soaked.written > 0


def children(pid: int) -> set[int]:
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    return {int(child) for child in found.split()}


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are told by Linux")
def test_workers_end_with_the_run_that_is_killed(tmp_path) -> None:
    paths = [drive(tmp_path / f"d{i}.mcap", frames=400 + i) for i in range(4)]
    run = begun(tmp_path / "s.db", paths, jobs=2)
    end = time.monotonic() + 30
    while len(workers := children(run.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.02)
    run.kill()
    run.wait()

    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < end:
        time.sleep(0.02)

    assert len(workers) == 2
    assert [pid for pid in workers if Path(f"/proc/{pid}").exists()] == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_a_whole_store_and_nothing_beside_it(tmp_path, jobs) -> None:
    paths = [drive(tmp_path / f"d{i}.mcap", frames=30 if i == 0 else 1200) for i in range(3)]
    store = tmp_path / "out" / "s.db"
    store.parent.mkdir()
    command = [sys.executable, "-m", "sgstore", "ingest", store, *paths, "--jobs", str(jobs)]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    end = time.monotonic() + 60
    while not store.exists() and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=30)

    assert run.returncode == 130, errors
    assert "interrupted; what was finished is in the store" in errors
    assert [p.name for p in store.parent.iterdir()] == ["s.db"]
    names = [trace.name for trace in StoreFile(store).traces()]
    assert names == ["d0", "d1", "d2"][: len(names)]
    assert StoreFile(store).verify().faults == []


FULL = """
import resource, signal, sys
from sgstore.ingest import ingest
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
for outcome in ingest(sys.argv[1], sys.argv[2:]):
    print(outcome.status, outcome.error)
"""
"""No file may grow beyond a size: the nearest to a disk that is full which needs no rights."""


@pytest.mark.parametrize("room", [2_000, 30_000])
def test_a_disk_that_is_full_leaves_the_old_store(tmp_path, room) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    paths = made(folder)
    store = tmp_path / "out" / "s.db"
    store.parent.mkdir()
    ingest(store, paths[:1])
    before = content(store)

    run = subprocess.run(
        [sys.executable, "-c", FULL.format(most=room), store, *paths[1:]],
        capture_output=True,
        text=True,
        check=False,
    )

    assert "failed" in run.stdout, run.stderr
    assert "Traceback" not in run.stderr
    assert StoreFile(store).verify().faults == []
    after = content(store)
    assert before["trace"][0] in after["trace"]
    # A log may be left that could not be worked into the store; what is in it is safe.
    assert {p.name for p in store.parent.iterdir()} <= {"s.db", "s.db.wal"}
    ingest(store, paths)
    assert [p.name for p in store.parent.iterdir()] == ["s.db"]
    assert {t.name for t in StoreFile(store).traces()} == {"a", "b", "a~2"}


@pytest.mark.parametrize(
    "place", ["none/s.db", "file/s.db", pytest.param("/proc/s.db", id="where nobody can write")]
)
def test_a_place_that_cannot_be_written_is_told_before_anything_is_read(tmp_path, place) -> None:
    (tmp_path / "file").write_text("a file")
    path = drive(tmp_path / "d.mcap", frames=3)

    with pytest.raises(StoreError, match="cannot be written"):
        ingest(tmp_path / place, [path])

    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.mcap", "file"]


def test_what_a_killed_writer_left_is_worked_in_by_the_next_run(tmp_path: Path) -> None:
    recording = drive(tmp_path / "a.mcap", frames=20)
    store = tmp_path / "s.db"
    assert ingest(store, [recording])[0].status == "added"
    code = (
        "import duckdb, os, sys\n"
        "c = duckdb.connect(sys.argv[1], config={'wal_autocheckpoint': '1TB'})\n"
        "c.execute('PRAGMA disable_checkpoint_on_shutdown')\n"
        "c.execute(\"INSERT INTO store_info VALUES ('test', 'kept')\")\n"
        "os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(store)], check=False)
    (tmp_path / "s.db.gate").touch()
    assert (tmp_path / "s.db.wal").exists()

    assert ingest(store, [recording])[0].status == "present"

    assert sorted(path.name for path in tmp_path.glob("s.db*")) == ["s.db"]
    assert ("test", "kept") in StoreFile(store).rows("SELECT * FROM store_info").values
