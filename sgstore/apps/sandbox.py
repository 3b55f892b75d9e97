"""Sandbox: a separate process that runs SQL and pattern queries from untrusted sources.

The process can only read the store: the database is opened read-only without file access, and its
settings are locked. The operating system forbids it to write files and limits its address space. A
query has a deadline, after which the process is killed (stopping a query in the database can take
long). Its result has a limited number of rows and bytes. The process lives on between queries,
because its start takes a third of a second.

The process is a worker of :mod:`sgstore.base.processes`. Other packages can run their own queries in
such a process: the ``worker`` of a sandbox is a module whose ``main`` calls :func:`serve`
with a function for its queries, and :meth:`Sandbox.ask` sends them.
"""

from __future__ import annotations

import errno
import json
import os
import queue
import shutil
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

from sgstore.base.processes import WorkerProcess, requests, send_reply
from sgstore.base.temporary_folders import new_place
from sgstore.errors import (
    QueryError,
    SgstoreError,
    SqlError,
    StoreError,
    error_of,
    plain_error,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from sgstore.query import Store

    Answering = Callable[[Store, dict[str, Any], int], dict[str, Any] | Iterator[dict[str, Any]]]
    """Function from a store, a question and the largest number of rows to one or more replies."""

TIMEOUT_S: Final = 5.0
MEMORY: Final = 512 << 20
MAX_ROWS: Final = 10_000
MAX_BYTES: Final = 64 << 20
"""Largest size of a result that is sent between the processes; bytes."""

MAX_QUESTION: Final = 1 << 20
"""Largest length of a query together with its values; characters."""

START_S: Final = 120.0
"""Time limit for the start of the process; s. It takes one second, or a minute on a very busy machine."""

READ_S: Final = 60.0
"""Additional time for each user table that the sandbox process reads first; s."""

REDUCE: Final = (
    "reduce the query: a label for each node, such as (v:Vehicle), fewer variables, one trace"
)
"""Text of the remedy for a query that needs too much time or memory."""

_TABLE_BYTES: Final = 4 << 30
"""Largest file that the sandbox process may write; bytes. It may only write while it reads user tables."""

_ADDRESS_SPACE: Final = 4 << 30
"""Address space for Python, its libraries and the threads of the database, in addition to the memory for
queries; bytes."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Result rows of a query from a sandbox process, and the traces that cannot answer the query.

    Attributes
    ----------
    columns : tuple of str
    rows : list of tuple
        Numbers, texts, truth values, ``None``, and lists and dicts of these; other values as text.
    truncated : bool
        True if there were more rows than allowed.
    reasons : mapping of str to str
        Traces that cannot answer the pattern, by name, with the reason.
    graphs : bool
        True if each row ends in a graph (``RETURN SUBGRAPHS``).
    notes : tuple of str
        Likely mistakes; see :attr:`sgstore.matches.Matches.notes`.
    """

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]
    truncated: bool
    reasons: Mapping[str, str] = field(default_factory=dict[str, str])
    graphs: bool = False
    notes: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the names of the traces that cannot answer the query."""
        return tuple(self.reasons)


class Sandbox:
    """Separate process that runs untrusted queries on a store, with limits on time and memory.

    Queries of several threads run one after the other. A context manager; otherwise call
    :meth:`close`.

    Parameters
    ----------
    store : str or Path
    timeout_s : float
        Time limit of a query; s.
    memory : int
        Memory limit of a query; bytes.
    max_rows : int
        Greatest number of rows of a result.
    max_bytes : int
        Greatest size of a result; bytes.
    tables : mapping of str to path, optional
        User tables for joins: Parquet, CSV or JSON files. They are also read in that process.
    worker : str
        Module of the process, whose ``main`` calls :func:`serve`.

    Raises
    ------
    StoreError
        The file is missing, is not a store, or has another version; or a table cannot be read.
    """

    may_write: ClassVar[bool] = False
    """True if the process is allowed to write files."""

    def __init__(
        self,
        store: str | Path,
        *,
        timeout_s: float = TIMEOUT_S,
        memory: int = MEMORY,
        max_rows: int = MAX_ROWS,
        max_bytes: int = MAX_BYTES,
        tables: Mapping[str, str | Path] | None = None,
        worker: str = "sgstore.apps.sandbox",
    ) -> None:
        self._store = Path(store)
        self._worker = worker
        self._timeout_s = timeout_s
        self._memory = memory
        self._max_rows = max_rows
        self._max_bytes = max_bytes
        self._tables = {name: str(Path(path).resolve()) for name, path in (tables or {}).items()}
        self._folder: Path | None = None
        self._turn = threading.Lock()
        self._child: WorkerProcess | None = None
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._stopped = False
        with self._turn:
            self._ready()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the sandbox process."""
        with self._turn:
            self._kill()

    @property
    def folder(self) -> Path | None:
        """Return the folder for tables of the sandbox process; ``None`` if no process runs."""
        return self._folder

    def sql(self, text: str) -> Answer:
        """Run one read-only SQL statement in the sandbox, and return its rows.

        Raises
        ------
        SqlError
            The statement is invalid, the database rejects it, or it exceeds the time or memory
            limit.
        QueryError
            A pattern in it is invalid.
        """
        return _answer(self.ask({"sql": text}, SqlError))

    def find(self, text: str, /, **parameters: object) -> Answer:
        """Run a pattern query in the sandbox, and return its rows.

        Raises
        ------
        QueryError
            The text is not a query.
        SqlError
            The query exceeds the time or memory limit.
        """
        return _answer(self.ask({"find": text, "parameters": parameters}))

    def ask(
        self, question: Mapping[str, object], error: type[SgstoreError] = QueryError
    ) -> dict[str, Any]:
        """Send a query to the sandbox process, and return its reply.

        Parameters
        ----------
        question : mapping
            JSON values.
        error : type
            Error class for a query that is too long.

        Raises
        ------
        SgstoreError
            An error of the worker.
        SqlError
            The query exceeds the time or memory limit.
        """
        _check_length(question, error)
        with self._turn:
            return _granted(self._exchange(self._ready(), question, self._timeout_s))

    def replies(self, question: Mapping[str, object]) -> Iterator[dict[str, Any]]:
        """Send a query to the sandbox process, and yield each reply as soon as it arrives.

        The process is stopped if the caller ends the iteration early.

        All replies except the last have ``more``.

        Parameters
        ----------
        question : mapping
            JSON values.

        Raises
        ------
        SgstoreError
            An error of the worker.
        SqlError
            The query exceeds the time or memory limit, or was stopped.
        """
        _check_length(question, QueryError)
        finished, until = False, time.monotonic() + self._timeout_s
        with self._turn:
            try:
                reply = self._exchange(self._ready(), question, self._timeout_s)
                while reply.pop("more", False):
                    yield reply
                    assert self._child is not None  # noqa: S101 - it has just answered
                    reply = self._exchange(self._child, None, until - time.monotonic())
                finished = True
            finally:
                if not finished:
                    self._abandon()
        yield _granted(reply)

    def stop(self) -> None:
        """Stop the current query (of another thread) by killing the sandbox process."""
        child = self._child
        if child is not None:
            self._stopped = True
            child.kill()

    def start(self) -> None:
        """Start the sandbox process in advance, before a query needs it."""
        with self._turn:
            self._ready()

    @property
    def is_ready(self) -> bool:
        """True if the sandbox process runs."""
        child = self._child
        return child is not None and child.is_alive

    def _ready(self) -> WorkerProcess:
        """Return the running sandbox process. Start it if necessary."""
        if self._child is None or not self._child.is_alive:
            self._kill()
            self._stopped = False
            self._lines = queue.SimpleQueue()
            self._child = WorkerProcess(
                self._worker, on_line=self._lines.put, longest=self._max_bytes + 1, quiet=True
            )
            self._folder = new_place("sandbox")
            self._folder.mkdir(mode=0o700)
            settings = {
                "store": str(self._store.absolute()),
                "memory": self._memory,
                "rows": self._max_rows,
                "tables": self._tables,
                "folder": str(self._folder),
                "may_write": self.may_write,
            }
            wait = START_S + READ_S * len(self._tables)
            try:
                reply = self._exchange(self._child, settings, wait)
            except SqlError as error:
                raise SqlError(f"the process that answers did not start: {error}") from None
            if "error" in reply:
                self._kill()
            _granted(reply)
        return self._child

    def _exchange(
        self, child: WorkerProcess, question: Mapping[str, object] | None, timeout_s: float
    ) -> Any:
        """Send a question to the sandbox process (or wait for its start), and return the reply.

        The process is killed after the timeout.

        The caller does not wait for its end, because a process with much memory exits slowly.
        """
        if question is not None:
            # In a thread, because a stuck process does not read a long question.
            threading.Thread(target=child.send, args=(question,), daemon=True).start()
        try:
            line = self._lines.get(timeout=max(timeout_s, 0))
        except queue.Empty:
            self._abandon()
            told = self._timeout_s if question is None else timeout_s  # later parts have less time
            raise SqlError(f"stopped after {told:g} s; {REDUCE}, or raise --timeout") from None
        except BaseException:
            self._kill()
            raise
        if line.endswith(b"\n"):
            return json.loads(line)
        stopped = self._stopped
        self._kill()
        if stopped:
            raise SqlError("stopped")
        if len(line) > self._max_bytes:
            raise SqlError(f"stopped: the answer is longer than {self._max_bytes} bytes")
        raise SqlError(f"stopped: it took more memory than is allowed; {REDUCE}")

    def _abandon(self) -> None:
        """Kill the sandbox process, and remove its folder in the background."""
        child, folder = self._child, self._folder
        self._child = self._folder = None
        if child is not None:
            child.kill()
            threading.Thread(target=_bury, args=(child, folder)).start()

    def _kill(self) -> None:
        child, folder = self._child, self._folder
        self._child = self._folder = None
        if child is not None:
            _bury(child, folder)


def _bury(child: WorkerProcess, folder: Path | None) -> None:
    """Wait for the end of a sandbox process, and remove its folder."""
    child.end()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def _check_length(question: Mapping[str, object], error: type[SgstoreError]) -> None:
    length = len(json.dumps(question))
    if length > MAX_QUESTION:
        raise error(f"the question has {length} characters; {MAX_QUESTION} are allowed")


def _granted(reply: Any) -> dict[str, Any]:
    """Return a reply of the sandbox process. If the reply contains an error, raise it."""
    if "query" in reply or "error" in reply:
        raise error_of(reply)
    return reply


def _answer(reply: dict[str, Any]) -> Answer:
    rows = [tuple(row) for row in reply["rows"]]
    columns, reasons = tuple(reply["columns"]), dict(reply["reasons"])
    graphs, notes = reply.get("graphs", False), tuple(reply.get("notes", ()))
    return Answer(columns, rows, reply["truncated"], reasons, graphs, notes)


class Workshop(Sandbox):
    """Sandbox process for the program's own tasks. They may write files, and can be cancelled at once."""

    may_write: ClassVar[bool] = True


class Errand:
    """Long task in a separate process (:class:`Workshop`). It has the methods of :class:`SandboxPool`.

    Parameters
    ----------
    store : str or Path
    **limits
        As in :class:`Sandbox`.
    """

    def __init__(self, store: str | Path, **limits: Any) -> None:
        self._make = lambda: Workshop(store, **limits)
        self._box: Workshop | None = None
        self._gone = False

    def ask(self, question: Mapping[str, object], _key: str) -> Iterator[dict[str, Any]]:
        """Start the task, and yield its replies as they arrive. A cancelled task has no replies."""
        with self._make() as self._box:
            if not self._gone:
                yield from self._box.replies(question)

    def cancel(self, _key: str = "") -> bool:
        """Stop the task. If it has not started yet, prevent its start."""
        self._gone = True
        if self._box is not None:
            self._box.stop()
        return True


class SandboxPool:
    """Pool of sandbox processes for parallel queries on one store, with a spare process.

    A query that is stopped, or takes too long, loses its process. The spare process takes its
    place, and a new spare one is started in the background. A context manager; otherwise call
    :meth:`close`.

    Parameters
    ----------
    store : str or Path
    size : int
        Number of parallel queries; further ones wait.
    small : collection of str
        Kinds of short queries (``ask`` of a query) that never wait: each has a spare process.
    first : mapping, optional
        Warm-up query of each new process.
    **limits
        As in :class:`Sandbox`.

    Raises
    ------
    StoreError
        As in :class:`Sandbox`.
    """

    def __init__(
        self,
        store: str | Path,
        *,
        size: int = 2,
        small: Collection[str] = (),
        first: Mapping[str, object] | None = None,
        **limits: Any,
    ) -> None:
        self._first = first
        self._changed = threading.Condition()
        self._turns = threading.BoundedSemaphore(size)
        self._small = dict.fromkeys(small, threading.BoundedSemaphore(1))
        self._free = [Sandbox(store, **limits)]
        self._asked: dict[str, Sandbox | None] = {}
        self._closed = False
        self._make = lambda: Sandbox(store, **limits)
        self._starting = [
            threading.Thread(target=self._more, args=(many,), daemon=True, name="sgstore sandbox")
            for many in (*[1] * (size - 1), max(len(small), 1))
        ]
        for thread in self._starting:
            thread.start()

    def __enter__(self) -> SandboxPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop all sandbox processes of the pool, even if a query runs."""
        with self._changed:
            self._closed = True
            boxes = [*self._free, *(box for box in self._asked.values() if box is not None)]
            self._free.clear()
        for box in boxes:
            box.stop()
        for thread in self._starting:
            thread.join(START_S)
        for box in boxes:
            box.close()

    def ask(self, question: Mapping[str, object], key: str) -> Iterator[dict[str, Any]]:
        """Run a query in a free sandbox process, and yield each reply as soon as it arrives.

        Parameters
        ----------
        question : mapping
        key : str
            Key for :meth:`cancel`, unique among running queries.
        """
        with self._changed:
            if key in self._asked:
                raise QueryError(f"a question {key!r} is under way")
            self._asked[key] = None
        try:
            with self._small.get(str(question.get("ask")), self._turns):
                box = self._taken(key)
                try:
                    yield from box.replies(question)
                finally:
                    self._give_back(box)
        finally:
            with self._changed:
                self._asked.pop(key, None)

    def cancel(self, key: str) -> bool:
        """Stop the running query with this key. Return False if no query has this key."""
        with self._changed:
            box = self._asked.pop(key, None)
            known = box is not None or key in self._asked
        if box is not None:
            box.stop()
        return known

    def _taken(self, key: str) -> Sandbox:
        with self._changed:
            self._changed.wait_for(lambda: self._free or self._closed)
            if self._closed or key not in self._asked:
                raise SqlError("stopped")
            box = self._asked[key] = self._free.pop()
        return box

    def _give_back(self, box: Sandbox) -> None:
        if box.is_ready:
            self._put(box)
            return
        again = threading.Thread(target=self._again, args=(box,), daemon=True)
        self._starting = [one for one in self._starting if one.is_alive()] + [again]
        again.start()

    def _more(self, many: int) -> None:
        with suppress(SgstoreError):  # the first one started, so this fault is temporary
            for _ in range(many):
                if self._closed:
                    return
                self._ready(self._make())

    def _again(self, box: Sandbox) -> None:
        with suppress(SgstoreError):
            box.start()
        self._ready(box)

    def _ready(self, box: Sandbox) -> None:
        """Warm up a new sandbox process with a first query, then add the process to the pool."""
        with suppress(SgstoreError):
            if self._first is not None and not self._closed:
                box.ask(self._first)
        self._put(box)

    def _put(self, box: Sandbox) -> None:
        with self._changed:
            closed = self._closed
            if not closed:
                self._free.append(box)
                self._changed.notify()
        if closed:
            box.close()


def serve(answering: Answering) -> None:
    """Answer the queries of the parent process until the parent ends this process.

    Parameters
    ----------
    answering : callable
        Function from a query to its reply (JSON values). Errors of sgstore are sent to the caller.
    """
    asked = requests()
    settings = next(asked)
    tempfile.tempdir = settings["folder"]
    free = settings["may_write"]
    _limit(settings["memory"], files=None if free else _TABLE_BYTES)
    from sgstore.query import Store
    from sgstore.store import UserTables

    path = Path(settings["store"])
    try:
        tables = UserTables(settings["tables"])
        _limit(settings["memory"], files=None if free else 0)
        os.chdir(path.parent)  # so that the database knows only the file name
        store = Store(path.name, memory=settings["memory"], tables=tables)
    except OSError as error:
        send_reply(_refusal(StoreError(f"{path}: {error.strerror}")))
        return
    except SgstoreError as error:
        send_reply(_refusal(error))
        return
    send_reply({"columns": [], "rows": [], "truncated": False, "reasons": {}})
    for question in asked:
        try:
            answer = answering(store, question, settings["rows"])
            for one in [answer] if isinstance(answer, dict) else answer:
                send_reply(one)
        except SgstoreError as error:
            send_reply(_refusal(error))


def rows_found(store: Store, question: dict[str, Any], most: int) -> dict[str, Any]:
    """Run an SQL statement or a pattern query. Return its rows as JSON values, and True if there are more."""
    graphs, notes = False, ()
    if "sql" in question:
        rows = store.sql(question["sql"], max_rows=most)
        values, columns, truncated = rows.values, rows.columns, rows.truncated
        reasons = dict(rows.reasons)
    else:
        matches = store.find(question["find"], **question["parameters"])
        values = list(islice(matches, most + 1))
        truncated = len(values) > most
        values, columns, reasons = values[:most], matches.columns, matches.reasons
        graphs, notes = matches.graphs, matches.notes
    rows = [[plain(value) for value in row] for row in values]
    about = {"truncated": truncated, "reasons": reasons, "graphs": graphs, "notes": notes}
    return {"columns": columns, "rows": rows, **about}


def plain(value: Any) -> Any:
    """Convert a value to JSON values: lists, dictionaries, numbers and texts."""
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, (bytes, bytearray)):
        return value.hex()
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def _refusal(error: SgstoreError) -> dict[str, Any]:
    if not isinstance(error, QueryError) and _spilled(error):
        error = SqlError(f"stopped: it took more memory than is allowed; {REDUCE}")
    return plain_error(error)


def _spilled(error: SgstoreError) -> bool:
    """True if the database failed because the sandbox forbids temporary files."""
    text = str(error)
    return os.strerror(errno.EFBIG) in text and "duckdb_temp" in text


def _limit(memory: int, *, files: int | None) -> None:
    """Limit the memory and the file size of this process permanently, if the operating system supports it.

    ``files``: largest file that it may write; bytes. ``None`` means no limit.
    """
    try:
        import resource
    except (
        ImportError
    ):  # not on Windows: there only the database's own limits and the deadline apply
        return
    for limit, most in (
        (resource.RLIMIT_AS, _ADDRESS_SPACE + 2 * memory),
        (resource.RLIMIT_FSIZE, files),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(limit)
        if most is not None:
            bound = most if hard == resource.RLIM_INFINITY else min(most, hard)
            resource.setrlimit(limit, (bound, bound))


def main() -> None:
    """Answer queries in the sandbox process."""
    serve(rows_found)
