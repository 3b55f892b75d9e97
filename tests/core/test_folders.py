"""Folders of processes: they go with their owner, however it ends, and never before."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sgstore.base.temporary_folders import HeldFolder, new_place, temporary_folder, working_folder

HOLDER = """
import sys, time
from pathlib import Path
from sgstore.base.temporary_folders import HeldFolder, temporary_folder
held = HeldFolder(Path(sys.argv[1]), "kept-")
(held.path / "data").write_bytes(b"x" * 1000)
print(held.path, temporary_folder(), flush=True)
time.sleep(100)
"""


@pytest.fixture
def holder(tmp_path: Path):
    """Starts processes that hold folders; gives the process, its folder, and its folder for temporary files."""
    started: list[subprocess.Popen[str]] = []

    def start() -> tuple[subprocess.Popen[str], Path, Path]:
        line = [sys.executable, "-c", HOLDER, str(tmp_path / "held")]
        env = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
        process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=env)
        started.append(process)
        assert process.stdout is not None
        held, own = process.stdout.readline().split()
        return process, Path(held), Path(own)

    (tmp_path / "held").mkdir()
    (tmp_path / "tmp").mkdir()
    yield start
    for process in started:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def test_what_a_killed_process_left_is_removed_by_the_next_and_what_lives_stays(
    holder, tmp_path: Path
) -> None:
    killed, held, temporary = holder()
    killed.kill()
    killed.wait()
    assert held.exists()
    assert temporary.exists()

    _, living, living_temporary = holder()
    _, later, _ = holder()

    assert not held.exists()
    assert not temporary.exists()
    assert (living / "data").exists()
    assert living_temporary.exists()
    assert later.exists()
    assert living.stat().st_mode & 0o077 == 0


def test_nothing_else_is_taken_for_left_behind(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").touch()
    (tmp_path / "kept-link").symlink_to(tmp_path / "other", target_is_directory=True)
    (tmp_path / "kept-file").write_text("a file")

    with HeldFolder(tmp_path, "kept-") as held:
        assert held.path.is_dir()
    assert not held.path.exists()
    assert {p.name for p in tmp_path.iterdir()} == {"other", "kept-link", "kept-file"}
    assert (tmp_path / "other" / "mine").exists()


def test_a_process_that_was_forked_leaves_the_folders_of_its_parent_alone(tmp_path: Path) -> None:
    held = HeldFolder(tmp_path, "kept-")
    mine = temporary_folder()
    child = os.fork()
    if not child:
        held.remove()
        os._exit(0 if temporary_folder() != mine and held.path.exists() else 1)
    _, status = os.waitpid(child, 0)

    assert status == 0
    assert held.path.exists()
    assert mine.exists()
    held.remove()
    assert not held.path.exists()


def test_a_folder_for_work_ends_with_it_and_two_places_are_not_the_same() -> None:
    with working_folder("x") as one, working_folder("x") as other:
        assert one.parent == other.parent == temporary_folder()
        (one / "file").touch()
    assert not one.exists()
    assert new_place("x") != new_place("x")


def test_without_a_place_for_temporary_files_a_store_is_read_all_the_same(
    town_store: Path, tmp_path: Path
) -> None:
    line = [sys.executable, "-m", "sgstore", "find", str(town_store), "MATCH (e:Ego)", "--count"]
    nowhere = os.environ | {"TMPDIR": str(tmp_path / "none")}

    assert subprocess.run(line, env=nowhere, capture_output=True, check=True).stdout == b"750\n"


def test_the_next_start_removes_what_a_killed_ingest_and_a_killed_query_left(
    town_store: Path, tmp_path: Path
) -> None:
    from sgstore.apps.demo import RECORDING

    store = tmp_path / "new.sgstore"
    env = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
    (tmp_path / "tmp").mkdir()
    ingest = [sys.executable, "-m", "sgstore", "ingest", str(store), str(RECORDING)]
    process = subprocess.Popen(ingest, env=env, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 300
    while not [*tmp_path.glob("new.sgstore.segment-*/*")] and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert [*tmp_path.glob("new.sgstore.segment-*")]
    store.write_bytes(town_store.read_bytes())

    subprocess.run([sys.executable, "-m", "sgstore", "info", str(store)], env=env, check=True)

    assert {p.name for p in tmp_path.iterdir()} == {"new.sgstore", "tmp"}
    assert not [*(tmp_path / "tmp").iterdir()]
