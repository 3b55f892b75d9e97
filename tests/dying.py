"""Answers that take a while, and say who gives them, so that a test can kill him on the way."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

from sgstore.collection import _worker as worker

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
        until = time.monotonic() + 60
        while time.monotonic() < until:
            marks = sorted(self.folder.iterdir())
            if len(marks) > self.number:
                time.sleep(self.after)
                self.killed = int(marks[self.number].name.partition("-")[2])
                os.kill(self.killed, signal.SIGKILL)
                return
            time.sleep(0.005)
