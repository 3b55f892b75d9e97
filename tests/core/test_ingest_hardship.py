"""Killed, interrupted, without room, and with readers all the while: the store stays whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from killing import begun, content, killed_and_resumed, made
from opendrive_maps import a_map, a_road
from opendrive_maps import line as straight
from recordings import drive
from soaking import soak
from thorough import LONG

from sgstore.apps.cli import run as sgstore
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.store import StoreFile

pytestmark = pytest.mark.seconds(33)


def test_a_killed_run_goes_on_and_ends_as_where_nobody_killed_it(tmp_path: Path) -> None:
    # All of them take minutes: ``make kill``.
    verbs = ["derive", "export clips", "lock union"] if LONG else ["export clips"]
    kills = 12 if LONG else 3

    done = killed_and_resumed(tmp_path, kills, seed=5, frames=20, verbs=verbs)

    assert all(one.kills.total() >= 1 for one in done.values())


DYING = """
import os, signal, sys
from pathlib import Path
import sgstore.pipeline.rebuild
from sgstore.apps.cli import run
moment, *line = sys.argv[1:]
def dying(of, name):
    old = getattr(of, name)
    def new(*args, **named):
        if name != "ingest":
            old(*args, **named)
        if name != "ingest" or named["road_map"]:
            os.kill(os.getpid(), signal.SIGKILL)
        return old(*args, **named)
    setattr(of, name, new)
of, name = moment.split(".")
dying({"Path": Path, "rebuilding": sgstore.pipeline.rebuild}[of], name)
run(line)
"""
"""A command line in a process that dies right after a call, or before it reads on a map."""


def dies(folder: Path, moment: str, *line: object) -> Path:
    """Run a command line until it dies; gives the folder that it has for what is temporary."""
    temporary = folder / "tmp"
    temporary.mkdir()
    run = subprocess.run(
        [sys.executable, "-c", DYING, moment, *map(str, line)],
        env=os.environ | {"TMPDIR": str(temporary)},
        check=False,
    )
    assert run.returncode == -signal.SIGKILL
    return temporary


def again(temporary: Path, *line: object) -> None:
    """Run a command line as others do."""
    command = [sys.executable, "-m", "sgstore", *map(str, line)]
    env = os.environ | {"TMPDIR": str(temporary)}
    subprocess.run(command, env=env, check=True, capture_output=True)


def test_an_export_that_was_killed_while_its_files_were_moved_is_made_again(tmp_path: Path) -> None:
    store, to = tmp_path / "s.db", tmp_path / "clips"
    ingest(store, [drive(tmp_path / "d.mcap", frames=30)])
    line = ("export", store, "MATCH (e:Ego) WHERE e.x < 1 OR e.x > 20 RETURN CLIPS(0s, 0s)")
    to.mkdir()
    (to / "notes.txt").write_text("mine")
    temporary = dies(tmp_path, "Path.hardlink_to", *line, "--to", to)
    assert len(list(to.glob("*.mcap"))) == 1
    assert not (to / "manifest.json").exists()

    again(temporary, *line, "--to", to)
    assert sgstore([*map(str, line), "--to", str(tmp_path / "other")]) == 0

    found = {path.name: path.read_bytes() for path in to.iterdir()}
    assert found.pop("notes.txt") == b"mine"
    assert found == {path.name: path.read_bytes() for path in (tmp_path / "other").iterdir()}
    assert len(found) == 3


def test_folders_that_a_killed_export_had_moved_are_taken_back_too(tmp_path: Path) -> None:
    store, to = tmp_path / "s.db", tmp_path / "frames"
    ingest(store, [drive(tmp_path / "d.mcap", frames=12)])
    line = ("export", store, "MATCH (e:Ego) WHERE e.x < 5", "--as", "frames", "--to", to)
    temporary = dies(tmp_path, "Path.replace", *line)
    assert [path for path in to.iterdir() if path.is_dir() and not path.name.startswith(".")]

    again(temporary, *line)

    assert (to / "manifest.json").exists()
    assert not list(to.glob(".export-*"))


def test_the_map_of_a_rebuild_that_was_killed_is_not_left(tmp_path: Path) -> None:
    store, road = tmp_path / "s.db", tmp_path / "street.xodr"
    road.write_text(a_map(a_road("1", straight(200.0, x=-20.0, y=2.0))))
    bare = drive(tmp_path / "d.mcap", frames=9)
    ingest(store, [bare], road_map=road)
    temporary = dies(tmp_path, "rebuilding.ingest", "rebuild", store)
    assert list(temporary.iterdir())

    again(temporary, "rebuild", store)

    assert not list(temporary.iterdir())
    names = {"s.db", "street.xodr", "d.mcap", "tmp"}
    assert {path.name for path in tmp_path.iterdir()} == names


LOGGED = (
    "import duckdb, os, sys\n"
    "c = duckdb.connect(sys.argv[1], config={'wal_autocheckpoint': '1TB'})\n"
    "c.execute('PRAGMA disable_checkpoint_on_shutdown')\n"
    "c.execute(\"INSERT INTO inside.store_info VALUES ('test', 'kept')\")\n"
    "os.kill(os.getpid(), 9)\n"
)
"""A writer that is killed before its log is worked into the store."""


def test_a_log_is_never_left_beside_a_store_that_was_written_anew(tmp_path: Path) -> None:
    store = tmp_path / "s.db"
    ingest(store, [drive(tmp_path / "d.mcap", frames=20)])
    subprocess.run([sys.executable, "-c", LOGGED, str(store)], check=False)
    assert (tmp_path / "s.db.wal").exists()

    dies(tmp_path, "Path.replace", "remove", store, "--compact")

    assert not (tmp_path / "s.db.wal").exists()
    assert StoreFile(store).verify().faults == []
    assert ("test", "kept") in StoreFile(store).rows("SELECT * FROM inside.store_info").values


@pytest.mark.parametrize("verb", ["derive", "import"])
def test_a_verb_that_finds_all_there_works_in_what_a_killed_one_left(
    tmp_path: Path, verb: str
) -> None:
    store = tmp_path / "s.db"
    ingest(store, [drive(tmp_path / "d.mcap", frames=20)])
    (tmp_path / "g.csv").write_text("graph,src,relation,dst\ng,ego,near,car_1\n")
    (tmp_path / "c.toml").write_text("[range]\nradius = 20.0\n")
    line = {
        "derive": ["derive", store, "--name", "x", "--config", tmp_path / "c.toml", "--trace", "d"],
        "import": ["import", store, tmp_path / "g.csv", "--as", "csv"],
    }[verb]
    assert sgstore(list(map(str, line))) == 0
    subprocess.run([sys.executable, "-c", LOGGED, str(store)], check=False)
    (tmp_path / "s.db.gate").touch()

    assert sgstore(list(map(str, line))) == 0

    assert sorted(path.name for path in tmp_path.glob("s.db*")) == ["s.db"]
    assert ("test", "kept") in StoreFile(store).rows("SELECT * FROM inside.store_info").values


def test_readers_and_a_writer_meet_no_lock_and_no_half_trace(tmp_path: Path) -> None:
    soaked = soak(tmp_path, *((10, 8) if LONG else (0.8, 2)))

    assert soaked.written > 0


def children(pid: int) -> set[int]:
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    return {int(child) for child in found.split()}


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are told by Linux")
def test_workers_end_with_the_run_that_is_killed(tmp_path: Path) -> None:
    paths = [drive(tmp_path / f"d{i}.mcap", frames=400 + i) for i in range(4)]
    run = begun(tmp_path / "s.db", paths, jobs=2)
    end = time.monotonic() + 300
    while len(workers := children(run.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.02)
    run.kill()
    run.wait()

    while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < end:
        time.sleep(0.02)

    assert len(workers) == 2
    assert [pid for pid in workers if Path(f"/proc/{pid}").exists()] == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_a_whole_store_and_nothing_beside_it(tmp_path: Path, jobs: int) -> None:
    paths = [drive(tmp_path / f"d{i}.mcap", frames=30 if i == 0 else 1200) for i in range(3)]
    store = tmp_path / "out" / "s.db"
    store.parent.mkdir()
    command = [sys.executable, "-m", "sgstore", "ingest", store, *paths, "--jobs", str(jobs)]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    end = time.monotonic() + 300
    while not store.exists() and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=300)

    assert run.returncode == 130, errors
    assert "interrupted; the store has all finished work" in errors
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
def test_a_disk_that_is_full_leaves_the_old_store(tmp_path: Path, room: int) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    paths = made(folder)
    store = tmp_path / "out" / "s.db"
    store.parent.mkdir()
    ingest(store, paths[:1])
    before = content(store)

    run = subprocess.run(
        [sys.executable, "-B", "-c", FULL.format(most=room), store, *paths[1:]],
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
def test_a_place_that_cannot_be_written_is_told_before_anything_is_read(
    tmp_path: Path, place: str
) -> None:
    (tmp_path / "file").write_text("a file")
    path = drive(tmp_path / "d.mcap", frames=3)

    with pytest.raises(StoreError, match="cannot be written"):
        ingest(tmp_path / place, [path])

    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.mcap", "file"]


def test_what_a_killed_writer_left_is_worked_in_by_the_next_run(tmp_path: Path) -> None:
    recording = drive(tmp_path / "a.mcap", frames=20)
    store = tmp_path / "s.db"
    assert ingest(store, [recording])[0].status == "added"
    subprocess.run([sys.executable, "-c", LOGGED, str(store)], check=False)
    (tmp_path / "s.db.gate").touch()
    assert (tmp_path / "s.db.wal").exists()

    assert ingest(store, [recording])[0].status == "present"

    assert sorted(path.name for path in tmp_path.glob("s.db*")) == ["s.db"]
    assert ("test", "kept") in StoreFile(store).rows("SELECT * FROM inside.store_info").values
