"""Answers that take a while, and say who gives them, so that a test can kill him on the way."""

from __future__ import annotations

import os
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
