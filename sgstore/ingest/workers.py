"""Recordings read in several processes; what they built comes back in the order in which it was asked for.

Processes are told apart from one another by nothing: whoever is free takes the next recording. One that dies
(out of memory, say) costs the recording that it was reading, and another takes its place.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Self

from sgstore.errors import TraceError
from sgstore.ingest.outcomes import TraceOutcome
from sgstore.ingest.reading import View

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.ingest.jobs import Job

    Event = tuple["_Worker", dict[str, Any] | None]

_AHEAD: Final = 2
"""Recordings that a process has been told of: the one that it reads, and the next."""

_WAITING: Final = 64
"""Recordings for each process that may be read before the first of them is published."""


@dataclass(eq=False)
class _Worker:
    """A process, and the numbers of the recordings that it was told to read."""

    process: subprocess.Popen[str]
    tasks: deque[int] = field(default_factory=deque[int])
    listener: threading.Thread | None = None

    def tell(self, values: dict[str, Any]) -> None:
        stdin = self.process.stdin
        if stdin is not None:
            try:
                stdin.write(f"{json.dumps(values)}\n")
                stdin.flush()
            except OSError:  # it has died: that is told where its stdout ends
                return

    def end(self) -> int:
        """End the process if it still runs; its exit code."""
        self.process.kill()
        code = self.process.wait()
        if self.listener is not None:
            self.listener.join()
        for pipe in (self.process.stdin, self.process.stdout):
            with suppress(OSError):  # what was not written is for nobody
                if pipe is not None:
                    pipe.close()
        return code


class Workers:
    """Processes that read recordings.

    Parameters
    ----------
    job : Job
    count : int
        How many.
    on_block : function
        Called with the number of a recording, the frames done of it, about how many bytes, and its size.

    Notes
    -----
    Use it as a context manager: the processes end with it, and with this process, however that ends.
    """

    def __init__(
        self, job: Job, count: int, on_block: Callable[[int, int, int, int], None]
    ) -> None:
        self._job = job
        self._count = count
        self._on_block = on_block
        self._workers: list[_Worker] = []
        self._events: SimpleQueue[Event] = SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.end()

    def read(self, paths: list[Path], folder: Path) -> Iterator[list[View]]:
        """What became of each recording, in order; segments are built in folders below the one given."""
        waiting, done, given = deque(range(len(paths))), dict[int, list[View]](), 0
        while given < len(paths):
            self._hire(min(self._count, len(waiting) + len(self._workers)))
            self._assign(waiting, paths, folder, given + _WAITING * self._count)
            worker, event = self._events.get()
            if event is None:
                self._replace(worker, waiting, paths, done)
            elif "done" in event:
                worker.tasks.remove(event["index"])
                done[event["index"]] = [_view(values) for values in event["done"]]
                self._assign(waiting, paths, folder, given + _WAITING * self._count)
            else:
                self._on_block(event["index"], event["frames"], event["bytes"], event["size"])
            while given in done:
                yield done.pop(given)
                given += 1

    def _hire(self, count: int) -> None:
        # The same modules as here, and none that happen to lie in the folder where this was called.
        modules = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        while len(self._workers) < count:
            separate: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "sgstore.ingest.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                encoding="utf-8",
                env=os.environ | {"PYTHONPATH": modules},
                **separate,  # Ctrl-C is for us to deal with
            )
            worker = _Worker(process)
            self._workers.append(worker)
            worker.listener = threading.Thread(target=self._listen, args=(worker,), daemon=True)
            worker.listener.start()
            worker.tell(self._job.as_dict())

    def _listen(self, worker: _Worker) -> None:
        for line in worker.process.stdout or ():
            self._events.put((worker, json.loads(line)))
        self._events.put((worker, None))

    def _assign(self, waiting: deque[int], paths: list[Path], folder: Path, end: int) -> None:
        """Give the next recordings to those who have the fewest."""
        while waiting and waiting[0] < end:
            worker = min(self._workers, key=lambda one: len(one.tasks), default=None)
            if worker is None or len(worker.tasks) >= _AHEAD:
                return
            index = waiting.popleft()
            worker.tasks.append(index)
            place = folder / str(index)
            worker.tell({"index": index, "path": str(paths[index]), "folder": str(place)})

    def _replace(
        self, worker: _Worker, waiting: deque[int], paths: list[Path], done: dict[int, list[View]]
    ) -> None:
        """A process has died: what it was reading has failed, what it should have read next is still to do."""
        self._workers.remove(worker)
        code = worker.end()
        if worker.tasks:
            index = worker.tasks.popleft()
            how = f"was killed by signal {-code}; is there too little memory?"
            how = how if code < 0 else f"ended with code {code}; what it said of that is on stderr"
            error = TraceError(f"the process that read it {how}", path=paths[index])
            done[index] = [View(TraceOutcome(paths[index], error=error))]
        waiting.extendleft(reversed(worker.tasks))


def _view(values: dict[str, Any]) -> View:
    sealed = values["sealed"]
    return View(TraceOutcome.from_dict(values["outcome"]), Path(sealed) if sealed else None)
