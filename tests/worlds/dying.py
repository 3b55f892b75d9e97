"""A collection that engines ask, and answers that take a while, so that who gives one can be killed."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

from oracle_worlds import random_world

from sgstore.collection import Collection, pack
from sgstore.collection import _worker as worker
from sgstore.store import StoreFile

QUESTIONS = [
    "MATCH (a:Car)-[e:near|visible]->(b) RETURN type(e), b ORDER BY a.speed DESC, b.kind LIMIT 9",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind AS k, COUNT(*) AS n, COUNT(DISTINCT b) ORDER BY n, k",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b",
]


def fleet(folder: Path) -> Path:
    """A collection of six bundles."""
    StoreFile.create(folder / "one.sgstore")
    random_world(7, traces=6, frames=30, path=folder / "one.sgstore").connection.close()
    assert len(pack(folder / "one.sgstore", folder / "fleet", bundle_traces=1).bundles) == 6
    return folder / "fleet"


def agree(here: Collection, there: Collection) -> None:
    """Questions and checks have the same answers."""
    for text in QUESTIONS:
        assert there.find(text).rows() == here.find(text).rows() != []
    check = "CHECK calm: FORALL (a:Car) ALWAYS a.speed < 8"
    assert list(map(str, there.check(check))) == list(map(str, here.check(check)))


def hurt_bundle(place: Path, to: Path) -> str:
    """A copy of a collection in which a byte of a bundle is another one; the bundle."""
    shutil.copytree(place, to)
    bundle = min((to / "bundles").iterdir())
    bundle.write_bytes(bundle.read_bytes()[:-1] + b"?")
    return bundle.stem


FOLDER = "SGSTORE_TEST_MARKS"
"""Variable of the environment: where each task leaves a file, called by its number and the process."""

SECONDS = 0.3
answer = worker.answer


def answer_late(task: dict[str, Any]) -> dict[str, Any]:
    folder = Path(os.environ[FOLDER])
    (folder / f"{time.time_ns()}-{os.getpid()}").touch()
    time.sleep(SECONDS / 2)
    found = answer(task)
    time.sleep(SECONDS / 2)
    return found


class Killer(threading.Thread):
    """Kills whoever has begun the n-th task, some seconds after he did."""

    def __init__(self, folder: Path, number: int, after: float) -> None:
        super().__init__(daemon=True)
        self.folder, self.number, self.after = folder, number, after
        self.killed = 0

    def run(self) -> None:
        until = time.monotonic() + 300  # engines may start slowly
        while time.monotonic() < until:
            marks = sorted(self.folder.iterdir())
            if len(marks) > self.number:
                time.sleep(self.after)
                self.killed = int(marks[self.number].name.partition("-")[2])
                os.kill(self.killed, signal.SIGKILL)
                return
            time.sleep(0.005)
