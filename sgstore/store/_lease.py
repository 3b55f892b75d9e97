"""Store files that stay open between queries and close if a writer process waits.

Opening a file takes a hundred times as long as a small query. So the database instance of a file stays open for
a while after a query. It closes

* at once, if a writer waits. A writer of another process closes the *gate* file next to the store
  (see :mod:`sgstore.store._locking`). A thread of this process checks it every :data:`LOOK_S` seconds
  while an instance is idle;
* :data:`LEASE_S` seconds after the last query, so that other programs can open the file. A bundle of a
  collection (:class:`AttachedFile`) stays open, because it never changes;
* with the last object that uses the file, at process exit, and before a fork.

Results are never outdated: an instance is reused only if the file is unchanged.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal, quoted

try:
    import fcntl
except (
    ImportError
):  # not on Windows: a writer cannot request an open file there, so files close at once
    fcntl = None

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    Stamp = tuple[tuple[int, ...], ...]


LEASE_S: Final = 1.0
"""Time that a file stays open after a query; s."""

LOOK_S: Final = 0.05
"""Interval of the check for waiting writers of an idle open file; s."""


def stamp_of(path: Path) -> Stamp:
    """Return identity, size and times of a store file and its log. The value changes at every write."""
    found: list[tuple[int, ...]] = []
    for file in (path, _beside(path, ".wal")):
        with suppress(OSError):
            of = file.stat()
            found.append((of.st_dev, of.st_ino, of.st_size, of.st_mtime_ns, of.st_ctime_ns))
    return tuple(found)


def gate_of(path: Path) -> Path:
    """Return the path of the lock file that a writer process holds while it waits or writes."""
    return _beside(path, ".gate")


@lru_cache(maxsize=256)
def _beside(path: Path, ending: str) -> Path:
    return path.with_name(f"{path.name}{ending}")


def _wanted(path: Path) -> bool:
    """Return True if a writer process holds the lock file of a store."""
    if fcntl is None:
        return True
    try:
        gate = os.open(gate_of(path), os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(gate, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(gate)
    return False  # left by a killed process


class AttachedFile:
    """Read-only store file in a DuckDB instance that all stores of its folder share.

    Parameters
    ----------
    path : Path
    connect : function
        Function that creates the instance for a readable folder.
    settings : tuple
        Settings of the instance. Different settings need different instances.

    Attributes
    ----------
    name : str
        Name of the file in the instance.
    """

    def __init__(
        self,
        path: Path,
        connect: Callable[[Path], DuckDBPyConnection],
        settings: tuple[object, ...],
    ) -> None:
        place = path.resolve()
        self._instance = shared_instance((place.parent, *settings), lambda: connect(place.parent))
        self.name = f"file {place.name}"
        told = f"ATTACH {literal(str(place))} AS {quoted(self.name)} (READ_ONLY)"
        self._instance.cursor().execute(told)

    def cursor(self, schema: str = "") -> DuckDBPyConnection:
        """Return a connection to the store file. Names without a schema belong to the given schema."""
        connection = self._instance.cursor()
        if schema:
            connection.execute(f"USE {quoted(self.name)}.{schema}")
        return connection

    def close(self) -> None:
        """Detach the store file from the shared DuckDB instance."""
        self._instance.cursor().execute(f"DETACH {quoted(self.name)}")


_instances: Final[dict[tuple[object, ...], DuckDBPyConnection]] = {}
"""Shared database instances by key. They exist until the process ends."""

_instances_lock = threading.Lock()


def shared_instance(
    key: tuple[object, ...], make: Callable[[], DuckDBPyConnection]
) -> DuckDBPyConnection:
    """Return the DuckDB instance for a key, created at the first call. Callers must use cursors of it."""
    with _instances_lock:
        if key not in _instances:
            _instances[key] = make()
        return _instances[key]


@dataclass(slots=True, eq=False)
class OpenFile:
    """Store file in this process: the DuckDB instance, the readers and the locks of the file.

    Changes require the lock ``changed``.

    Attributes
    ----------
    instance : DuckDBPyConnection, AttachedFile or None
        Database instance shared by all readers.
    opened : Stamp
        Stamp of the file when it was opened.
    settings : tuple
        Settings of the open instance.
    folder : Path or None
        The only other readable folder: the folder of user tables.
    checked : bool
        True if the instance has passed the schema check.
    good : Stamp
        Stamp of the last file that passed the check.
    spoiled : bool
        True after a failed query. The instance is then closed.
    readers, writing, waiting
        Number of current readings, True while a thread writes, number of waiting writers.
    careful : bool
        True if suspect DuckDB features are disabled.
    cursors : list
        Connections of the readings.
    used : float
        End of the last reading; :func:`time.monotonic`.
    holders : set
        Tokens of the objects that read or write the file.
    """

    path: Path
    changed: threading.Condition = field(default_factory=threading.Condition)
    instance: DuckDBPyConnection | AttachedFile | None = None
    opened: Stamp = ()
    settings: tuple[object, ...] = ()
    folder: Path | None = None
    checked: bool = False
    good: Stamp = ()
    spoiled: bool = False
    readers: int = 0
    writing: bool = False
    waiting: int = 0
    careful: bool = False
    cursors: list[DuckDBPyConnection] = field(default_factory=list["DuckDBPyConnection"])
    used: float = 0.0
    holders: set[object] = field(default_factory=set[object])
    held: threading.local = field(default_factory=threading.local)

    @property
    def mine(self) -> int:
        """Number of open read connections of the current thread."""
        return getattr(self.held, "count", 0)

    @mine.setter
    def mine(self, count: int) -> None:
        self.held.count = max(count, 0)  # a reading may end in another thread

    def close(self) -> None:
        """Close the DuckDB instance of the store file if it has no readers."""
        if not self.readers and self.instance is not None:
            instance, self.instance = self.instance, None  # cleared even if close() is interrupted
            self.spoiled = False
            instance.close()

    def rest(self) -> None:
        """Keep the DuckDB instance open for the next query, unless another process needs the file."""
        if self.readers:
            return
        self.changed.notify_all()
        if self.instance is None:
            return
        self.used = time.monotonic()
        given_up = self.spoiled or self.waiting or not self.holders or _wanted(self.path)
        if given_up or not _watch.over(self):
            self.close()

    def refresh(self, settings: tuple[object, ...], folder: Path | None) -> None:
        """Close the idle database of a store file if the file or the settings have changed."""
        if self.instance is None or self.readers:
            return
        other = self.settings != settings or folder not in {None, self.folder}
        if other or self.opened != stamp_of(self.path):
            self.close()

    def let_go(self, token: object) -> None:
        """Unregister an object that uses the store file. Close the file if no other object uses it."""
        self.holders.discard(token)
        # An object may be deleted at any time and in any thread, so this code must not wait. The watcher also
        # checks.
        if not self.holders and self.changed.acquire(blocking=False):
            try:
                self.close()
            finally:
                self.changed.release()


class _Watch:
    """Thread that closes idle store files, with the list of these files."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget all idle files and the thread that closes them."""
        self.kept: set[OpenFile] = set()
        self.running = False
        self._lock = threading.Lock()

    def over(self, file: OpenFile) -> bool:
        """Add a file to the list of idle files. Return False if the closing thread cannot start."""
        if file in self.kept:
            return True
        with self._lock:
            if not self.running:
                thread = threading.Thread(target=self._run, name="sgstore-lease", daemon=True)
                self.running = True
                try:
                    thread.start()
                except RuntimeError:  # no further thread can start
                    self.running = False
                    return False
            self.kept.add(file)
        return True

    def _run(self) -> None:
        while self.running:
            time.sleep(LOOK_S)
            for file in tuple(self.kept):
                self._look(file)
            with self._lock:
                self.running = bool(self.kept)

    def _look(self, file: OpenFile) -> None:
        """Close an idle store file if a writer waits or the timeout has passed."""
        if not file.changed.acquire(blocking=False):
            return  # a reading starts or ends right now
        try:
            bundle = isinstance(file.instance, AttachedFile)
            late = not bundle and time.monotonic() - file.used > LEASE_S
            if late or not file.holders or (not bundle and _wanted(file.path)):
                file.close()
            if file.instance is None:
                self.kept.discard(file)
        finally:
            file.changed.release()


_watch = _Watch()

files: Final[dict[Path, OpenFile]] = {}
"""Store files used by this process, by path."""


def give_back(patience_s: float = 0.0) -> None:
    """Close all open store files of this process that have no readers."""
    for file in tuple(_watch.kept):
        if file.changed.acquire(timeout=patience_s):
            try:
                file.close()
            finally:
                file.changed.release()


# At process exit, the thread must not be inside the database.
@atexit.register
def _end() -> None:
    give_back(5.0)
    while _instances:
        _instances.popitem()[1].close()


_of_parents: Final[list[object]] = []
"""Objects that a forked process inherits. They stay alive, as DuckDB objects cannot be closed there."""


def _begin_anew() -> None:
    """Forget the inherited open store files after a fork of the process."""
    _watch.begin()
    _of_parents.extend(_instances.values())
    _instances.clear()
    for file in files.values():
        _of_parents.extend((file.instance, *file.cursors))
        file.changed, file.held = threading.Condition(), threading.local()
        file.instance, file.cursors, file.spoiled = None, [], False
        file.readers, file.writing, file.waiting = 0, False, 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=give_back, after_in_child=_begin_anew)
