"""Worker processes: child Python processes that run a module of sgstore and answer JSON requests.

A worker is an isolated Python process with the packages of this process. Requests and replies are JSON
objects, one per line, on its stdin and stdout. All replies to a request except the last have ``more``. The
worker exits at once when its stdin ends, thus also if this process dies.

Notes
-----
A normal child process imports modules from the current folder and from ``PYTHONPATH``. It would run a
``duckdb.py`` next to the recordings. These workers are isolated (``python -I``) and get the package folders of
this process. ``multiprocessing`` would run the main module of the user again, and would load replies by pickle.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import IO, TYPE_CHECKING, Any, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

NEEDED: Final = (
    *("sgstore", "duckdb", "numpy", "mcap", "google/protobuf", "zstandard", "lz4", "isal"),
    *("shapely", "lark", "networkx", "typer"),
)
"""Packages that a child process must import, as folders."""

_START: Final = (
    "import importlib, json, sys\n"
    "sys.path[:0] = [p for p in json.loads(sys.argv.pop(1)) if p not in sys.path]\n"
    "importlib.import_module(sys.argv.pop(1)).main()\n"
)


class WorkerProcess:
    """Child Python process that runs a module of sgstore and answers requests.

    It calls ``main`` of the module, which iterates over :func:`requests`.

    Parameters
    ----------
    module : str
        Dotted name.
    *arguments : str
        Arguments of its command line.
    on_line : function
        Called in a thread with each line of the process: a reply, or at the end a line without a line break.
    longest : int, optional
        Greatest length of a line with its break; a longer line ends the reading. Bytes.
    quiet : bool
        Drop the stderr of the process.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        on_line: Callable[[bytes], object],
        longest: int = -1,
        quiet: bool = False,
    ) -> None:
        # Ctrl-C reaches only this process, which ends its workers.
        separate: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
        self._process = subprocess.Popen(  # noqa: S603  a module of ours
            [sys.executable, "-I", "-c", _START, json.dumps(folders()), module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if quiet else None,
            **separate,
        )
        assert self._process.stdin is not None  # noqa: S101 - both are pipes
        assert self._process.stdout is not None  # noqa: S101
        self._stdin = self._process.stdin
        listening = self._process.stdout, longest, on_line
        self._listener = threading.Thread(target=_listen, args=listening, daemon=True)
        self._listener.start()

    @property
    def is_alive(self) -> bool:
        """True if the process has not exited."""
        return self._process.poll() is None

    def send(self, request: Mapping[str, Any]) -> None:
        """Send a request. Errors are ignored, because :meth:`WorkerPool.get` reports a dead process."""
        with suppress(OSError, ValueError):
            self._stdin.write(json.dumps(request).encode() + b"\n")
            self._stdin.flush()

    def kill(self) -> None:
        """Kill the process without waiting for its end."""
        self._process.kill()

    def end(self) -> int:
        """Kill the process if it still runs. Return its exit code."""
        self._process.kill()
        code = self._process.wait()
        self._listener.join()
        # Unflushed requests can be dropped.
        with suppress(OSError), self._process:
            pass
        return code


def _listen(lines: IO[bytes], longest: int, on_line: Callable[[bytes], object]) -> None:
    line = b"\n"
    while line.endswith(b"\n"):
        line = lines.readline(longest)
        on_line(line)


class WorkerPool:
    """Pool of worker processes that share requests. At the end of a ``with`` block, it ends the workers.

    A dead worker is replaced. Requests that it has not begun go to the other workers.

    Parameters
    ----------
    count : int
        Greatest number of workers; they start with the requests.
    module : str
    *arguments : str
        As in :class:`WorkerProcess`.
    first : mapping, optional
        First request of each worker, without a reply.
    ahead : int
        Requests per worker at once: the current one and those after it.
    """

    def __init__(
        self,
        count: int,
        module: str,
        *arguments: str,
        first: Mapping[str, Any] | None = None,
        ahead: int = 1,
    ) -> None:
        self._count, self._command = count, (module, *arguments)
        self._first, self._ahead = first, ahead
        self._started = 0
        self._workers: dict[int, WorkerProcess] = {}
        self._given: dict[int, deque[tuple[int, Mapping[str, Any]]]] = {}
        self._lines: SimpleQueue[tuple[int, bytes]] = SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers.values():
            worker.kill()
        for worker in self._workers.values():
            worker.end()

    @property
    def has_room(self) -> bool:
        """True if a worker process can receive another request."""
        least = min(map(len, self._given.values()), default=0)
        return len(self._workers) < self._count or least < self._ahead

    def put(self, key: int, request: Mapping[str, Any]) -> None:
        """Send a request to the least busy worker process. :meth:`get` returns the key with the reply."""
        number = min(self._given, key=lambda one: len(self._given[one]), default=0)
        if len(self._workers) < self._count and self._given.get(number, True):
            number = self._start()
        self._given[number].append((key, request))
        self._workers[number].send(request)

    def get(self) -> tuple[int, dict[str, Any] | int]:
        """Return the key of a request, and its reply. If the worker died, return its exit code as the reply."""
        while True:
            number, line = self._lines.get()
            given = self._given[number]
            if line.endswith(b"\n"):
                reply: dict[str, Any] = json.loads(line)
                return (given[0] if "more" in reply else given.popleft())[0], reply
            code = self._workers.pop(number).end()
            del self._given[number]
            for other in list(given)[1:]:
                self.put(*other)
            if given:
                return given[0][0], code

    def _start(self) -> int:
        number = self._started = self._started + 1

        def on_line(line: bytes) -> None:
            self._lines.put((number, line))

        self._workers[number] = WorkerProcess(*self._command, on_line=on_line)
        self._given[number] = deque()
        if self._first is not None:
            self._workers[number].send(self._first)
        return number


def requests() -> Iterator[dict[str, Any]]:
    """Yield the requests that the parent process sends to this worker process.

    The worker exits at once when its parent process ends it or dies.
    """
    _replies()
    lines: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    while True:
        yield json.loads(lines.get())


def _read(lines: SimpleQueue[bytes]) -> None:
    # A file of its own: at exit, the interpreter closes stdin and would abort if a thread reads it.
    with os.fdopen(os.dup(0), "rb") as stdin:
        for line in stdin:
            lines.put(line)
    os._exit(0)


def send_reply(values: Mapping[str, Any]) -> None:
    """Send a reply from this worker process to its parent process.

    With ``more`` in the reply, other replies follow.
    """
    with suppress(BrokenPipeError):  # the parent process is dead, and this process about to exit
        _replies().write(json.dumps(values).encode() + b"\n")
        _replies().flush()


@cache
def _replies() -> IO[bytes]:
    """Return the pipe to the parent process. Printed text goes to stderr, so that it does not mix with replies.

    Libraries print without Python: DuckDB shows the progress of a query after two seconds.
    """
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return pipe


def folders() -> list[str]:
    """Return the folders of the Python packages that a child process needs.

    The current folder is included only if a package was imported from it.
    """
    here = Path.cwd()
    found = [folder for package in NEEDED if (folder := _imported_from(package)) is not None]
    searched = [Path(entry) for entry in sys.path if entry and Path(entry).is_absolute()]
    for package in NEEDED:
        if _imported_from(package) is None:
            held = (f for f in searched if f.resolve() != here and (f / package).is_dir())
            found += [first for first in [next(held, None)] if first is not None]
    ranks = {folder.resolve(): rank for rank, folder in reversed(list(enumerate(searched)))}
    once = dict.fromkeys(folder.resolve() for folder in found)
    return [str(folder) for folder in sorted(once, key=lambda one: ranks.get(one, -1))]


def _imported_from(package: str) -> Path | None:
    module = sys.modules.get(package.replace("/", "."))
    file = getattr(module, "__file__", None)
    return Path(file).absolute().parents[package.count("/") + 1] if file else None
