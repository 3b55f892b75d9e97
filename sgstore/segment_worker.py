"""A process that reads recordings for another: ``python -m sgstore.segment_worker``.

It is told what to do on stdin, a line of JSON each: the job first, then recordings. It answers on stdout, a
line of JSON each: how far it has come, and what became of a recording. It ends when stdin does, whatever it is
doing: nobody would publish what it builds.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from sgstore.segments import Job, SegmentReader


def main() -> None:
    """Do what stdin says until it ends."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    sys.stdout = sys.stderr  # what anything prints is no answer
    told: SimpleQueue[dict[str, Any]] = SimpleQueue()
    threading.Thread(target=_listen, args=(told,), daemon=True).start()

    def answer(values: dict[str, Any]) -> None:
        answers.write(f"{json.dumps(values)}\n")
        answers.flush()

    def on_block(frames: int, reached: int, size: int) -> None:
        answer({"index": index, "frames": frames, "bytes": reached, "size": size})

    index = -1
    reading = SegmentReader(Job.from_dict(told.get()), on_block)
    while True:
        task = told.get()
        index = task["index"]
        views = reading.read(Path(task["path"]), Path(task["folder"]))
        done = [
            {"outcome": view.outcome.as_dict(), "sealed": view.sealed and str(view.sealed)}
            for view in views
        ]
        answer({"index": index, "done": done})


def _listen(told: SimpleQueue[dict[str, Any]]) -> None:
    for line in sys.stdin:
        told.put(json.loads(line))
    os._exit(0)


if __name__ == "__main__":
    main()
