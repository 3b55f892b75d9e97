"""How readers and writers share one DuckDB file: within a process, and among processes.

DuckDB lets one process write a file, or many read it, and refuses everyone else at once. Here nobody is
refused: whoever comes waits, for a bounded time, and the file is held only while it is read or published to.

* *Among processes* DuckDB's own lock decides. A writer that waits for readers holds a second lock, the
  *gate* (``STORE.gate``), that new readers pass first, so that a stream of them cannot keep it out for ever.
* *Within a process* that lock is not enough, because POSIX forgets all locks of a process on a file when any
  descriptor of it is closed. All readers of a file share one instance of the database, a writer has it
  alone, and **nothing in this process may open a store's file by other means while it is written**.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import duckdb

from sgstore.errors import StoreError
from sgstore.quoting import literal
from sgstore.store.joining import tables_folder

try:
    import fcntl
except ImportError:  # not on Windows: there writers and readers take their turns as they come
    fcntl = None

if TYPE_CHECKING:
    from collections.abc import Generator

    from duckdb import DuckDBPyConnection

    from sgstore.store.joining import UserTables

STORAGE_VERSION: Final = "v1.5.0"
"""Format of the file: the newest that every supported DuckDB can read."""

_BUSY: Final = (
    "Could not set lock on file",
    "Conflicting lock is held",
    "Unique file handle conflict",
    "different configuration than existing connections",
)
"""What DuckDB says when others have the file."""

_PAUSE: Final = 0.005, 0.1
"""First and longest pause between two attempts; s."""


def without_faults(connection: DuckDBPyConnection) -> None:
    """Turn off what this version of DuckDB does wrong.

    Before 2.0 its optimizer *compressed_materialization* loses a column of some joins of grouped relations, and
    ends in an internal error ("Failed to bind column reference").
    """
    if duckdb.__version__.startswith("1."):
        connection.execute("SET disabled_optimizers = 'compressed_materialization'")


def default_memory() -> int:
    """A quarter of the machine's memory, 1 GiB at most; bytes."""
    try:
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        machine = 1 << 32
    return max(min(machine // 4, 1 << 30), 1 << 28)


def memory_setting(memory: int) -> str:
    """An amount of memory as DuckDB reads it."""
    return f"{memory // 1024}KiB"


@dataclass(slots=True)
class _Door:
    """The state of one file in this process."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    instance: DuckDBPyConnection | None = None
    readers: int = 0
    writing: bool = False
    waiting: int = 0
    held: threading.local = field(default_factory=threading.local)

    @property
    def mine(self) -> int:
        """How many readings this thread has under way."""
        return getattr(self.held, "count", 0)

    @mine.setter
    def mine(self, count: int) -> None:
        self.held.count = max(count, 0)  # a reading may end in another thread than it began in


_doors: dict[Path, _Door] = {}
_doors_lock = threading.Lock()


class Access:
    """A DuckDB file that is opened only while it is used.

    Parameters
    ----------
    path : Path
    memory : int
        Most memory that reading may take; bytes. Beyond it DuckDB spills to temporary files.
    wait_s : float
        How long to wait for others; s.
    tables : UserTables, optional
        Tables of users' own that readers see too.
    """

    def __init__(
        self, path: Path, *, memory: int, wait_s: float, tables: UserTables | None = None
    ) -> None:
        self.path = path
        self._tables = tables
        self._memory = memory
        self._wait_s = wait_s
        with _doors_lock:
            self._door = _doors.setdefault(path.resolve(), _Door())

    @contextmanager
    def reading(self) -> Generator[DuckDBPyConnection]:
        """A read-only connection. Readings may be nested; all that overlap see the same state.

        Raises
        ------
        StoreError
            There is no such file, it is no database, or a writer kept it for too long.
        """
        deadline = _Deadline(self._wait_s)
        connection = self._enter(deadline)
        try:
            if self._tables is not None:
                self._tables.show(connection)
            yield connection
        finally:
            connection.close()
            self._leave()

    def _enter(self, deadline: _Deadline) -> DuckDBPyConnection:
        door = self._door
        if (
            not door.mine
        ):  # a reading within a reading must not wait for a writer who waits for the outer one
            _pass_gate(self.path, deadline)
        with door.changed:
            free = door.changed.wait_for(
                lambda: not door.writing and (door.mine or not door.waiting), deadline.left()
            )
            if not free:
                raise StoreError(f"{self.path}: another thread has been writing for too long")
            if door.instance is None:
                door.instance = self._opened(deadline)
            connection = door.instance.cursor()
            door.readers += 1
            door.mine += 1
            return connection

    def _leave(self) -> None:
        door = self._door
        with door.changed:
            door.mine -= 1
            door.readers -= 1
            if not door.readers and door.instance is not None:
                door.instance.close()
                door.instance = None
                door.changed.notify_all()

    def _opened(self, deadline: _Deadline) -> DuckDBPyConnection:
        # One configuration for all readers: they share the instance, users' statements among them.
        config: dict[str, str | bool | int | float | list[str]] = {
            "memory_limit": memory_setting(self._memory),
            "temp_directory": str(spill_folder()),
            "autoload_known_extensions": False,
            "autoinstall_known_extensions": False,
            "python_enable_replacements": False,
        }
        while True:
            try:
                with translated(self.path):
                    connection = duckdb.connect(str(self.path), read_only=True, config=config)
                    # Among the settings above DuckDB might take these before the folder, and refuse that.
                    connection.execute("SET allowed_directories = [?]", [str(tables_folder())])
                    without_faults(connection)
                    connection.execute("SET enable_external_access = false")
                    connection.execute("SET lock_configuration = true")
                    return connection
            except BusyError as busy:
                deadline.pause(busy)

    @contextmanager
    def writing(self, connection: DuckDBPyConnection) -> Generator[None]:
        """One transaction on the file, attached as ``store`` to a connection of the caller's.

        Nobody else has the file meanwhile. The transaction is undone if the block raises.

        Raises
        ------
        StoreError
            There is no such file, it cannot be written, or others kept it for too long.
        """
        with self.attached(connection), _transaction(connection):
            yield

    @contextmanager
    def attached(self, connection: DuckDBPyConnection) -> Generator[None]:
        """The file attached as ``store`` to a connection of the caller's; nobody else has it meanwhile."""
        with self._alone() as deadline, _closed_gate(self.path, deadline):
            self._attach(connection, deadline)
            try:
                with translated(self.path):
                    yield
            finally:
                # What failed has been raised already; the caller closes the connection anyway.
                with suppress(duckdb.Error):
                    connection.execute("DETACH store")

    @contextmanager
    def _alone(self) -> Generator[_Deadline]:
        """No other thread of this process has the file."""
        door, deadline = self._door, _Deadline(self._wait_s)
        if door.mine:
            raise StoreError(f"{self.path}: cannot be written while the same thread reads it")
        with door.changed:
            door.waiting += 1
            try:
                free = door.changed.wait_for(
                    lambda: not door.writing and not door.readers, deadline.left()
                )
                if not free:
                    raise StoreError(f"{self.path}: another thread has been using it for too long")
                door.writing = True
            finally:
                door.waiting -= 1
        try:
            yield deadline
        finally:
            with door.changed:
                door.writing = False
                door.changed.notify_all()

    def _attach(self, connection: DuckDBPyConnection, deadline: _Deadline) -> None:
        while True:
            if not self.path.exists():  # ATTACH would make an empty one
                raise StoreError(f"{self.path}: no such store; 'sgstore ingest' makes one")
            try:
                with translated(self.path):
                    connection.execute(
                        f"ATTACH {literal(str(self.path))} AS store"
                        f" (STORAGE_VERSION '{STORAGE_VERSION}')"
                    )
                return
            except BusyError as busy:
                deadline.pause(busy)


@contextmanager
def _transaction(connection: DuckDBPyConnection) -> Generator[None]:
    connection.execute("BEGIN TRANSACTION")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(duckdb.Error):  # a transaction that broke has been undone already
            connection.execute("ROLLBACK")
        raise
    # So that no write-ahead log is left at rest. If it fails, it is left, and what is in it is safe.
    with suppress(duckdb.Error):
        connection.execute("CHECKPOINT store")


class BusyError(StoreError):
    """Others have the file."""


@contextmanager
def translated(path: Path) -> Generator[None]:
    """Errors of DuckDB as errors of the store at ``path``, and an interruption as what it is.

    DuckDB turns Ctrl-C into errors of its own: into a RuntimeError while a statement runs, and into one that
    quotes the KeyboardInterrupt while it looks at our arrays.
    """
    try:
        yield
    except RuntimeError as error:
        if "Query interrupted" in str(error):
            raise KeyboardInterrupt from error
        raise
    except duckdb.Error as error:
        message = str(error).strip()
        if "KeyboardInterrupt" in message:
            raise KeyboardInterrupt from error
        if any(phrase in message for phrase in _BUSY):
            raise BusyError(f"{path}: in use by another process for too long") from error
        raise StoreError(f"{path}: {_reason(message)}") from error


def _reason(message: str) -> str:
    # A name that ends in .csv or the like makes DuckDB think of a table that it could read.
    phrases = (
        "not a valid DuckDB database file",
        "Is a directory",
        "in-memory database in read-only",
    )
    if any(phrase in message for phrase in phrases):
        return "not a store; expected a file that 'sgstore ingest' made"
    if "database does not exist" in message:
        return "no such store; 'sgstore ingest' makes one"
    if "database file with version number" in message:
        return "made by a newer DuckDB than is installed here; upgrade the package duckdb"
    return message


class _Deadline:
    """A bounded wait with growing pauses."""

    def __init__(self, wait_s: float) -> None:
        self._end = time.monotonic() + wait_s
        self._next, self._longest = _PAUSE

    def left(self) -> float:
        return max(self._end - time.monotonic(), 0)

    def pause(self, error: StoreError) -> None:
        """Sleep a little, or raise the error if there is no time left."""
        if not self.left():
            raise error
        time.sleep(min(self._next, self.left()))
        self._next = min(self._next * 1.5, self._longest)


def _gate(path: Path) -> Path:
    return path.with_name(f"{path.name}.gate")


def _pass_gate(path: Path, deadline: _Deadline) -> None:
    """Wait while a writer waits for readers to go. A courtesy: DuckDB's lock decides."""
    if fcntl is None:
        return
    try:
        gate = os.open(_gate(path), os.O_RDONLY)
    except OSError:
        return
    try:
        _lock(gate, fcntl.LOCK_SH, path, deadline)
    finally:
        os.close(gate)


@contextmanager
def _closed_gate(path: Path, deadline: _Deadline) -> Generator[None]:
    """Keep new readers of other processes out."""
    if fcntl is None:
        yield
        return
    try:
        gate = os.open(_gate(path), os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        _lock(gate, fcntl.LOCK_EX, path, deadline)
        try:
            yield
        finally:
            # Whoever waits has it open and does not mind that it has no name any more.
            with suppress(OSError):
                _gate(path).unlink()
    finally:
        os.close(gate)


def _lock(gate: int, how: int, path: Path, deadline: _Deadline) -> None:
    if fcntl is None:
        return
    while True:
        try:
            fcntl.flock(gate, how | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            deadline.pause(StoreError(f"{path}: another process has been writing for too long"))


def spill_folder() -> Path:
    """A folder that does not exist yet; DuckDB makes it when memory runs out, and removes it."""
    return Path(tempfile.gettempdir()) / f"sgstore-{os.getpid()}-{time.monotonic_ns():x}"
