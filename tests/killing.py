"""Ingest that is killed at random moments and begun again: the store ends as one that was not disturbed.

::

    python tests/killing.py 200        # how many kills

Each round is a process that reads four recordings into a store; it is killed after a while at random (and its
workers with it), and begun again until it has come through.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from recordings import Recorder, car, drive

from sgstore.store import StoreFile

CODE = """
import sys
from sgstore.ingest import ingest
from sgstore.ingest import running
running.BLOCK_FRAMES = 60
store, jobs, *paths = sys.argv[1:]
print("begun", flush=True)
outcomes = ingest(store, paths, jobs=int(jobs))
assert all(outcome.error is None for outcome in outcomes), outcomes
"""

NOT_COMPARED = {"trace": "EXCLUDE (ingested_at)"}


def content(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of a store, but for the times at which traces came."""
    store = StoreFile(path)
    sql = "SELECT table_name FROM duckdb_tables() WHERE NOT internal ORDER BY ALL"
    with store.snapshot():
        tables = [table for (table,) in store.rows(sql)]
        return {
            table: store.rows(
                f"SELECT * {NOT_COMPARED.get(table, '')} FROM {table} ORDER BY ALL"
            ).values
            for table in tables
        }


def made(folder: Path, frames: int = 130) -> list[Path]:
    """Four recordings, two of which are of one name and two the same."""
    (folder / "other").mkdir()
    paths = [drive(folder / "a.mcap", frames=frames), drive(folder / "b.mcap", frames=frames // 2)]
    with Recorder(folder / "other" / "a.mcap") as recorder:
        for i in range(frames):
            recorder.ground_truth(i / 10, [car(1, i / 10), car(2, 20.0)], host=1)
            recorder.camera(i / 10 + 0.01)
    again = folder / "again.mcap"
    again.write_bytes(paths[1].read_bytes())
    return [*paths, folder / "other" / "a.mcap", again]


def undisturbed(folder: Path, paths: list[Path]) -> tuple[dict[str, list[tuple[Any, ...]]], float]:
    """What a store holds after a run that nobody disturbs, and how long that takes; s."""
    start = time.perf_counter()
    run = begun(folder / "whole.db", paths, jobs=1)
    assert run.wait() == 0
    return content(folder / "whole.db"), time.perf_counter() - start


def begun(store: Path, paths: list[Path], jobs: int) -> subprocess.Popen[str]:
    """A process that has begun to read recordings into a store."""
    run = subprocess.Popen(
        [sys.executable, "-c", CODE, str(store), str(jobs), *map(str, paths)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    run.stdout.readline()
    run.stdout.close()
    return run


def killed_and_resumed(
    folder: Path, kills: int, seed: int = 0, frames: int = 130
) -> dict[str, int]:
    """Kill ingest of recordings of so many frames again and again.

    Returns
    -------
    dict
        ``kills`` that met a process at work, ``rounds`` that came through.

    Raises
    ------
    AssertionError
        A store was torn, something was left beside it, or it is not as one that was not disturbed.
    """
    paths = made(folder, frames)
    expected, duration = undisturbed(folder, paths)
    chance = random.Random(seed)
    done = {"kills": 0, "rounds": 0}
    while done["kills"] < kills:
        place = folder / f"round{done['rounds']}"
        place.mkdir()
        jobs, left = chance.choice((1, 1, 2)), 4
        while True:
            run = begun(place / "s.db", paths, jobs)
            if left and done["kills"] < kills:
                # Not of the whole length: whatever was published before need not be read again.
                left -= 1
                try:
                    run.wait(chance.uniform(0, duration))
                except subprocess.TimeoutExpired:
                    run.send_signal(signal.SIGKILL)
                    run.wait()
                    done["kills"] += 1
                    whole(place / "s.db")
                    continue
            assert run.wait() == 0
            break
        found = content(place / "s.db")
        others = [table for table in expected if found[table] != expected[table]]
        assert others == [], f"round {done['rounds']}: other rows in {others}"
        assert StoreFile(place / "s.db").verify().faults == []
        beside = sorted(path.name for path in place.rglob("*"))
        assert beside == ["s.db"], f"round {done['rounds']}, {jobs} jobs: {beside}"
        done["rounds"] += 1
    return done


def whole(path: Path) -> None:
    """Assert that what is in a store now is whole traces."""
    if path.exists():
        faults = StoreFile(path).verify().faults
        assert faults == [], faults


def main() -> None:
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(os.environ.get("SEED", "0"))
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        done = killed_and_resumed(Path(folder), kills, seed)
        seconds = time.perf_counter() - start
    print(
        f"{done['kills']} kills in {done['rounds']} rounds, {seconds:.0f} s: every store whole and equal"
    )


if __name__ == "__main__":
    main()
