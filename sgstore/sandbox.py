"""Questions of strangers: SQL and patterns that nobody has looked at, answered in a process of their own.

The process reads the store and nothing else: the database is opened read-only without access to files, its
settings are locked, and the operating system allows it no file to be written and a bounded address space. A
question has a deadline, after which the process is killed (a database that is asked to stop may take its time),
and its answer a bounded number of rows and bytes. The process lives on between questions, because starting
it takes a third of a second.

Parent and child speak JSON, a line a message. Other rooms have questions of their own answered in such a
process: a module that calls :func:`serve` with what answers them is the ``worker`` of a sandbox, and
:meth:`Sandbox.ask` asks.
"""

from __future__ import annotations

import errno
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar, Final, Self

from sgstore.errors import (
    QueryError,
    SgstoreError,
    SqlError,
    StoreError,
    error_of,
    plain_error,
)
from sgstore.files import new_place
from sgstore.processes import command

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from sgstore.query import Store

    Answering = Callable[[Store, dict[str, Any], int], dict[str, Any] | Iterator[dict[str, Any]]]
    """Reply to a question, or replies: of the store, the question, and the most rows; see :func:`plain`."""

TIMEOUT_S: Final = 5.0
MEMORY: Final = 512 << 20
MAX_ROWS: Final = 10_000
MAX_BYTES: Final = 64 << 20
"""Longest answer, as it is sent."""

MAX_QUESTION: Final = 1 << 20
"""Longest question with its values; characters."""

START_S: Final = 120.0
"""How long the process may take to start; s. It needs one, of which a very busy machine makes a minute."""

READ_S: Final = 60.0
"""How much longer for each table that it reads first; s."""

_TABLE_BYTES: Final = 4 << 30
"""The largest file that it may write, and that only while it reads tables, into a folder of its own."""

_ADDRESS_SPACE: Final = 4 << 30
"""What Python, its libraries and the database's threads reserve beside the memory for answers; bytes."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Result of a question.

    Attributes
    ----------
    columns : tuple of str
    rows : list of tuple
        Numbers, texts, truth values, ``None``, and lists and dicts of these; anything else as text.
    truncated : bool
        Whether there were more rows than allowed.
    reasons : mapping of str to str
        Why traces are left out that cannot answer the pattern, by name.
    graphs : bool
        Whether each row ends in a graph, as ``RETURN SUBGRAPHS`` asks.
    notes : tuple of str
        What may be a mistake; see :attr:`sgstore.matches.Matches.notes`.
    """

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]
    truncated: bool
    reasons: Mapping[str, str] = field(default_factory=dict[str, str])
    graphs: bool = False
    notes: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Traces that cannot answer the pattern."""
        return tuple(self.reasons)


class Sandbox:
    """A process that answers questions about a store.

    Questions of several threads are answered one after the other. To be used with ``with``, or closed.

    Parameters
    ----------
    store : str or Path
    timeout_s : float
        Longest time for a question; s.
    memory : int
        Most memory that a question may take; bytes.
    max_rows : int
        Longest answer; rows.
    max_bytes : int
        Longest answer; bytes.
    tables : mapping of str to path, optional
        Tables of one's own that can be joined: Parquet, CSV or JSON files. They are read in that process too.
    worker : str
        Module that the process runs, which calls :func:`serve`.

    Raises
    ------
    StoreError
        There is no such file, it is no store, or one of another version; or a table cannot be read.
    """

    may_write: ClassVar[bool] = False
    """Whether the process may write files."""

    def __init__(
        self,
        store: str | Path,
        *,
        timeout_s: float = TIMEOUT_S,
        memory: int = MEMORY,
        max_rows: int = MAX_ROWS,
        max_bytes: int = MAX_BYTES,
        tables: Mapping[str, str | Path] | None = None,
        worker: str = "sgstore.sandbox",
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
        self._child: subprocess.Popen[bytes] | None = None
        self._stopped = False
        with self._turn:
            self._ready()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        with self._turn:
            self._kill()

    @property
    def folder(self) -> Path | None:
        """Folder of the tables that the process has read; ``None`` while there is no process."""
        return self._folder

    def sql(self, text: str) -> Answer:
        """The rows of one statement that only reads.

        Raises
        ------
        SqlError
            It is none, the database refuses it, or it takes too much time or memory.
        QueryError
            A pattern in it is none.
        """
        return _answer(self.ask({"sql": text}, SqlError))

    def find(self, text: str, /, **parameters: object) -> Answer:
        """The rows of a pattern.

        Raises
        ------
        QueryError
            The text is no query.
        SqlError
            It takes too much time or memory.
        """
        return _answer(self.ask({"find": text, "parameters": parameters}))

    def ask(
        self, question: Mapping[str, object], error: type[SgstoreError] = QueryError
    ) -> dict[str, Any]:
        """The reply of the process to a question that its worker knows.

        Parameters
        ----------
        question : mapping
            What JSON can hold.
        error : type
            What is raised of a question that is too long.

        Raises
        ------
        SgstoreError
            What the worker raised.
        SqlError
            It takes too much time or memory.
        """
        line = _line(question, error)
        with self._turn:
            return _granted(self._exchange(self._ready(), line, self._timeout_s))

    def replies(self, question: Mapping[str, object]) -> Iterator[dict[str, Any]]:
        """Replies to a question, as they come; who stops reading stops the process.

        All but the last have ``more``, which says so.

        Parameters
        ----------
        question : mapping
            What JSON can hold.

        Raises
        ------
        SgstoreError
            What the worker raised.
        SqlError
            It takes too much time or memory, or it was stopped.
        """
        line, finished = _line(question, QueryError), False
        until = time.monotonic() + self._timeout_s
        with self._turn:
            try:
                reply = self._exchange(self._ready(), line, self._timeout_s)
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
        """Stop what is asked now, by another thread: the process is killed."""
        child = self._child
        if child is not None:
            self._stopped = True
            child.kill()

    def start(self) -> None:
        """Have the process ready for the next question."""
        with self._turn:
            self._ready()

    @property
    def is_ready(self) -> bool:
        """Return whether there is a process that can answer at once."""
        child = self._child
        return child is not None and child.poll() is None

    def _ready(self) -> subprocess.Popen[bytes]:
        """The process, started if there is none."""
        if self._child is None or self._child.poll() is not None:
            self._kill()
            self._stopped = False
            self._child = subprocess.Popen(  # noqa: S603  a module of ours
                command(self._worker),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
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
                reply = self._exchange(self._child, json.dumps(settings), wait)
            except SqlError as error:
                raise SqlError(f"the process that answers did not start: {error}") from None
            if "error" in reply:
                self._kill()
            _granted(reply)
        return self._child

    def _exchange(self, child: subprocess.Popen[bytes], line: str | None, timeout_s: float) -> Any:
        """Send a line, if there is one, and wait for one; the process does not outlive the deadline.

        Nobody waits for its end then: a process with much memory takes its time to go.
        """
        replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        talk = threading.Thread(
            target=_sent_and_read,
            args=(child, None if line is None else line.encode(), replies, self._max_bytes),
            daemon=True,
        )
        talk.start()
        try:
            reply = replies.get(timeout=max(timeout_s, 0))
        except queue.Empty:
            self._abandon()
            told = self._timeout_s if line is None else timeout_s  # a later part has less left
            raise SqlError(f"stopped after {told:g} s") from None
        except BaseException:
            self._kill()
            raise
        if reply.endswith(b"\n"):
            return json.loads(reply)
        stopped = self._stopped
        self._kill()
        if stopped:
            raise SqlError("stopped")
        if len(reply) > self._max_bytes:
            raise SqlError(f"stopped: the answer is longer than {self._max_bytes} bytes")
        raise SqlError("stopped: it took more memory than is allowed")

    def _abandon(self) -> None:
        """Kill the process; what it leaves is cleared away beside what comes next."""
        child, folder = self._child, self._folder
        self._child = self._folder = None
        if child is not None:
            child.kill()
            threading.Thread(target=_bury, args=(child, folder)).start()

    def _kill(self) -> None:
        child, folder = self._child, self._folder
        self._child = self._folder = None
        if child is not None:
            child.kill()
            _bury(child, folder)


def _bury(child: subprocess.Popen[bytes], folder: Path | None) -> None:
    """Wait for the end of a process, and clear away what it leaves."""
    with child:  # which closes the pipes, too
        pass
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def _sent_and_read(
    child: subprocess.Popen[bytes],
    line: bytes | None,
    replies: queue.SimpleQueue[bytes],
    most: int,
) -> None:
    """Put the line that a process answers with; one without an end if it died or says too much."""
    reply = b""
    # Whoever kills the process may close its pipes while they are used here.
    with suppress(OSError, ValueError):
        if child.stdin is not None and child.stdout is not None:
            if line is not None:
                child.stdin.write(line + b"\n")
                child.stdin.flush()
            reply = child.stdout.readline(most + 1)
    replies.put(reply)


def _line(question: Mapping[str, object], error: type[SgstoreError]) -> str:
    line = json.dumps(question)
    if len(line) > MAX_QUESTION:
        raise error(f"the question has {len(line)} characters; {MAX_QUESTION} are allowed")
    return line


def _granted(reply: Any) -> dict[str, Any]:
    """A reply that is no refusal; that is raised."""
    if "query" in reply or "error" in reply:
        raise error_of(reply)
    return reply


def _answer(reply: dict[str, Any]) -> Answer:
    rows = [tuple(row) for row in reply["rows"]]
    columns, reasons = tuple(reply["columns"]), dict(reply["reasons"])
    graphs, notes = reply.get("graphs", False), tuple(reply.get("notes", ()))
    return Answer(columns, rows, reply["truncated"], reasons, graphs, notes)


class Workshop(Sandbox):
    """The same for work of our own that writes files, and ends at once when somebody says so."""

    may_write: ClassVar[bool] = True


class Errand:
    """A longer piece of work in a :class:`Workshop` of its own; asked and cancelled as a :class:`SandboxPool`.

    Parameters
    ----------
    store : str or Path
    **limits
        As :class:`Sandbox` takes them.
    """

    def __init__(self, store: str | Path, **limits: Any) -> None:
        self._make = lambda: Workshop(store, **limits)
        self._box: Workshop | None = None
        self._gone = False

    def ask(self, question: Mapping[str, object], _key: str) -> Iterator[dict[str, Any]]:
        """Replies, as they come; none where it was cancelled before."""
        with self._make() as self._box:
            if not self._gone:
                yield from self._box.replies(question)

    def cancel(self, _key: str = "") -> bool:
        """Stop it."""
        self._gone = True
        if self._box is not None:
            self._box.stop()
        return True


class SandboxPool:
    """Sandboxes of one store, which answer several questions at a time; one more stands ready.

    A question that is stopped, or takes too long, loses its process; the spare one takes its place, and a new
    spare one is started beside. To be used with ``with``, or closed.

    Parameters
    ----------
    store : str or Path
    size : int
        How many questions are answered at a time; the others wait.
    small : collection of str
        What is asked (``ask`` of a question) that waits for none of the others: the spare one answers it.
    first : mapping, optional
        A question that each process is asked before it stands ready, so that it knows what others will need.
    **limits
        As :class:`Sandbox` takes them.

    Raises
    ------
    StoreError
        As :class:`Sandbox`.
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
            threading.Thread(target=self._more, daemon=True, name="sgstore sandbox")
            for _ in range(size)
        ]
        for thread in self._starting:
            thread.start()

    def __enter__(self) -> SandboxPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes; what is asked is stopped."""
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
        """Replies to a question, as :meth:`Sandbox.replies` gives them.

        Parameters
        ----------
        question : mapping
        key : str
            What :meth:`cancel` calls it; no other that is under way has it.
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
        """Stop a question; false if there is none of that key under way."""
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

    def _more(self) -> None:
        with suppress(SgstoreError):  # the first one was made, so that this is of passing nature
            self._ready(self._make())

    def _again(self, box: Sandbox) -> None:
        with suppress(SgstoreError):
            box.start()
        self._ready(box)

    def _ready(self, box: Sandbox) -> None:
        """Put a process to the others that has just begun."""
        with suppress(SgstoreError):
            if self._first is not None:
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


# The process ------------------------------------------------------------------------------------------------


def serve(answering: Answering) -> None:
    """Answer the questions that come on stdin, until it ends, and end the process.

    Parameters
    ----------
    answering : callable
        Gives the reply to a question: what JSON can hold. Whatever of sgstore's errors it raises is told to who
        asked.
    """
    with suppress(KeyboardInterrupt, BrokenPipeError):
        _serve(answering)
    os._exit(0)


def _serve(answering: Answering) -> None:
    lines, replies = sys.stdin.buffer, sys.stdout.buffer
    settings = json.loads(lines.readline())
    tempfile.tempdir = settings["folder"]
    free = settings["may_write"]
    _limit(settings["memory"], files=None if free else _TABLE_BYTES)
    from sgstore.query import Store
    from sgstore.store import UserTables

    path = Path(settings["store"])
    try:
        tables = UserTables(settings["tables"])
        _limit(settings["memory"], files=None if free else 0)
        os.chdir(path.parent)  # so that the database knows no more of where it is than its name
        store = Store(path.name, memory=settings["memory"], tables=tables)
    except OSError as error:
        _send(replies, _refusal(StoreError(f"{path}: {error.strerror}")))
        return
    except SgstoreError as error:
        _send(replies, _refusal(error))
        return
    _send(replies, {"columns": [], "rows": [], "truncated": False, "reasons": {}})
    for line in lines:
        question = json.loads(line)
        try:
            reply = answering(store, question, settings["rows"])
            for one in [reply] if isinstance(reply, dict) else reply:
                _send(replies, one)
        except SgstoreError as error:
            _send(replies, _refusal(error))


def tell(reply: Mapping[str, Any]) -> None:
    """Send a reply, before the others, while an answer is on its way: in the process that answers."""
    _send(sys.stdout.buffer, {**reply, "more": True})


def rows_found(store: Store, question: dict[str, Any], most: int) -> dict[str, Any]:
    """Rows of a statement, ``sql``, or of a pattern, ``find`` with its ``parameters``."""
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
    """A value as JSON can hold it."""
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, (bytes, bytearray)):
        return value.hex()
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def _refusal(error: SgstoreError) -> dict[str, Any]:
    if not isinstance(error, QueryError) and _spilled(error):
        error = SqlError("stopped: it took more memory than is allowed")
    return plain_error(error)


def _spilled(error: SgstoreError) -> bool:
    """Return whether an error is due to temporary files: :func:`_limit` lets the database write none."""
    text = str(error)
    return os.strerror(errno.EFBIG) in text and "duckdb_temp" in text


def _send(to: IO[bytes], reply: object) -> None:
    to.write(json.dumps(reply).encode() + b"\n")
    to.flush()


def _limit(memory: int, *, files: int | None) -> None:
    """Limit the resources of this process, where the system can; the limits cannot be widened again.

    ``files``: the largest file that it may write; bytes. ``None``: any.
    """
    try:
        import resource
    except ImportError:  # not on Windows: there the database's own limits and the deadline hold
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


if __name__ == "__main__":
    serve(rows_found)
