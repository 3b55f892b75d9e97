"""Shared access of readers and writers to a store file, within one process and among processes.

DuckDB lets one process write a file, or many read it, and rejects other processes at once. Here, a process
waits for a limited time instead. The file is open during reading and publication, and for a short time after
a reading, unless a writer waits (see :mod:`sgstore.store._lease`).

* *Among processes* DuckDB's own lock decides. A writer that waits for readers holds a second lock, the
  *gate* (``STORE.gate``), that new readers pass first, so that a stream of them cannot keep it out for ever.
* *Within a process* that lock is not enough, because POSIX forgets all locks of a process on a file when any
  descriptor of it is closed. All readers of a file share one instance of the database, a writer has it
  alone, and **nothing in this process may open a store's file by other means while it is written**.
"""

from __future__ import annotations

import os
import threading
from contextlib import contextmanager, suppress
from functools import partial
from glob import escape
from typing import TYPE_CHECKING, Any, Final
from weakref import finalize

import duckdb

import sgstore.store._schema as shape
from sgstore.base.logs import logger
from sgstore.base.quoting import literal
from sgstore.base.temporary_folders import new_place
from sgstore.errors import StoreError
from sgstore.store._engine_errors import BusyError, translated
from sgstore.store._gate import Deadline, closed_gate, pass_gate
from sgstore.store._joins import tables_folder
from sgstore.store._lease import AttachedFile, OpenFile, files, stamp_of
from sgstore.store._schema import INSIDE
from sgstore.store._store_paths import refuse_odd_name, refuse_special, remove_left_behind

_log = logger("store")

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._joins import UserTables
    from sgstore.store._lease import Stamp


def shut_in(connection: DuckDBPyConnection, path: Path, folders: tuple[Path, ...]) -> None:
    """Restrict a database connection permanently to the store file and the given folders."""
    if not connection.execute("SELECT current_setting('enable_external_access')").fetchall()[0][0]:
        return
    whole = str(path.absolute())
    endings = ("", ".wal", ".wal.checkpoint", ".wal.recovery")
    ((spill,),) = connection.execute("SELECT current_setting('temp_directory')").fetchall()
    names = [str(folder.absolute()) for folder in folders]
    places = [*names, *map(escape, names), spill]  # reading one needs a pattern
    connection.execute("SET allowed_paths = $1", [[whole + ending for ending in endings]])
    connection.execute("SET allowed_directories = $1", [places])
    connection.execute("SET autoload_known_extensions = false")
    connection.execute("SET autoinstall_known_extensions = false")
    connection.execute("SET python_enable_replacements = false")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")


STORAGE_VERSION: Final = "v1.5.0"
"""File format version: the newest one that every supported DuckDB can read."""

BLOCK_SIZE: Final = 1 << 16
"""Block size of a new file; bytes. Each of about thirty tables uses whole blocks, even for few rows."""

WAIT_S: Final = 60.0
"""Longest wait for other readers or writers; s."""

_SURPRISES: Final = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, StopIteration),
    *(TypeError, ValueError),
)
"""Exceptions that invalid rows of a store can cause in Python."""


def without_faults(connection: DuckDBPyConnection) -> None:
    """Disable DuckDB features that are faulty in some versions of DuckDB.

    * From 1.5.1 on its optimizer *common_subplan* merges two branches of a union that read
      different columns of the same joins. Rows are wrong, without an error (duckdb/duckdb#25819; 2.0, too).
    * Before 2.0 its optimizer *compressed_materialization* loses a column of some joins of grouped relations
      ("Failed to bind column reference").
    * In 2.0 operators that collect small chunks confuse the dictionaries of row groups
      ("dict-surviving cache"), in stores of some hundred traces. Patterns are equally fast without this cache.
    """
    old = duckdb.__version__.startswith("1.")
    off = ("common_subplan", "compressed_materialization")[: 1 + old]
    connection.execute(f"SET disabled_optimizers = {literal(','.join(off))}")
    if old:
        return
    with suppress(duckdb.CatalogException):  # a later version may lack this setting
        # GLOBAL is necessary, because every reading has its own session.
        connection.execute("SET GLOBAL enable_caching_operators = false")


_CAREFUL: Final = (
    *("common_aggregate", "common_subplan", "compressed_materialization", "duplicate_groups"),
    *("join_filter_pushdown", "late_materialization", "statistics_propagation", "top_n"),
)
"""DuckDB optimizers that are disabled for the next attempt after an internal error."""


def _be_careful(connection: DuckDBPyConnection) -> None:
    known = {row[0] for row in connection.execute("FROM duckdb_optimizers()").fetchall()}
    off = ",".join(name for name in _CAREFUL if name in known)
    connection.execute(f"SET disabled_optimizers = {literal(off)}")


def default_memory() -> int:
    """Return a quarter of the machine's memory, between 256 MiB and 1 GiB; bytes."""
    try:
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        machine = 1 << 32
    return max(min(machine // 4, 1 << 30), 1 << 28)


SPILL: Final = 10 * 10**9
"""Default limit of temporary files for reading; bytes."""


def memory_setting(memory: int) -> str:
    """Format a number of bytes as a DuckDB memory setting."""
    return f"{memory // 1024}KiB"


_files_lock = threading.Lock()


def _file_at(path: Path) -> OpenFile:
    """Return the shared state of a store file. The first call removes leftovers of killed processes."""
    place = path.resolve()
    with _files_lock:
        known = files.get(place)
        file = known or files.setdefault(place, OpenFile(place))
    if known is None:  # only at the first access in a process
        remove_left_behind(path)
    return file


def trust(path: Path, made: os.stat_result) -> None:
    """Record that this process has just created a store file, so its schema needs no check."""
    stamp = stamp_of(path)
    if len(stamp) != 1:
        return  # another process has left a log
    if stamp[0][:4] == (made.st_dev, made.st_ino, made.st_size, made.st_mtime_ns):
        _file_at(path).good = stamp


class Access:
    """Access to a store file, which stays open for a short time after each query.

    Parameters
    ----------
    path : Path
    memory : int
        Memory limit of readings; bytes. 0: :func:`default_memory`. Beyond it, DuckDB writes temporary files.
    spill : int
        Limit of the temporary files; bytes. 0: :data:`SPILL`.
    wait_s : float
        Longest wait for other processes; s.
    tables : UserTables, optional
        User tables, visible to readers.
    checked : bool
        True to reject files that do not match ``schema.sql``. Only a diagnosis of damaged stores sets False.
    diagnose : callable, optional
        Function that returns the damage of the store, or an empty string. Called after an internal error on
        stored data.

    Attributes
    ----------
    together : bool
        True if the file shares a database instance with all files of its folder. Opening is then four times
        faster. Only for trusted statements: a user's statement could read the other files.
    root : str, Path or None
        New folder of the recordings; see :func:`sgstore.store._traces.located`.
    topic_fields : dict
        Topic → fields with database types that topics of other stores of a collection have.
    """

    def __init__(
        self,
        path: Path,
        *,
        memory: int = 0,
        wait_s: float = WAIT_S,
        tables: UserTables | None = None,
        checked: bool = True,
        spill: int = 0,
        diagnose: Callable[[DuckDBPyConnection, Path], str] | None = None,
    ) -> None:
        self.path = path
        self.together = False
        self.root: str | Path | None = None
        self.topic_fields: dict[str, Mapping[str, str]] = {}
        self._checked = checked
        self._diagnose = diagnose
        self._tables = tables
        self._memory = memory or default_memory()
        self._spill = spill or SPILL
        self._wait_s = wait_s
        refuse_odd_name(path)
        self._file = file = _file_at(path)
        token = object()
        file.holders.add(token)
        finalize(self, file.let_go, token).atexit = False

    @contextmanager
    def reading(self, *, public: bool = False, idle: bool = False) -> Generator[DuckDBPyConnection]:
        """Yield a read-only database connection. Nested and overlapping uses see the same state of the store.

        Parameters
        ----------
        public : bool
            True to resolve names as public views, not as internal tables.
        idle : bool
            True if the connection only keeps the file open.

        Raises
        ------
        StoreError
            The file does not exist, is not a database, or a writer process used it for too long.
        """
        deadline = Deadline(self._wait_s)
        connection = self._enter(deadline, public=public, idle=idle)
        failed = True
        try:
            if self._tables is not None:
                self._tables.show(connection)
            with translated(self.path):
                yield connection
            failed = False
        except GeneratorExit:  # the caller stopped reading
            failed = False
            raise
        except _SURPRISES as error:
            if self._checked and (reason := self._damage(connection, error)):
                raise StoreError(
                    f"{self.path}: differs from its published state: {reason}; 'sgstore verify' lists faults,"
                    " 'sgstore rebuild' makes it again from its recordings"
                ) from error
            raise
        finally:
            try:
                connection.close()
            finally:
                self._leave(connection, failed=failed)

    def close(self) -> None:
        """Close the store file if it has no readers. The next query opens it again."""
        with self._file.changed:
            self._file.close()

    def _damage(self, connection: DuckDBPyConnection, error: Exception) -> str:
        """If damage of the store caused an internal DuckDB error, return its description; otherwise empty."""
        if self._diagnose is None:
            return ""
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        where = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__", ""))
        if where == __name__ or not where.startswith(("sgstore.", "json", "numpy")):
            return ""  # an error of the caller
        instance = self._file.instance
        if isinstance(instance, AttachedFile):
            return self._diagnose(instance.cursor(INSIDE), self.path)
        connection.execute(f"USE {INSIDE}")  # it may have been opened with public names
        return self._diagnose(connection, self.path)

    def restart(self) -> bool:
        """Close the file after an internal DuckDB error. It reopens with suspect optimizers disabled.

        Returns
        -------
        bool
            True if the query can run again. False if other threads read the file, or if these features were
            already disabled.
        """
        file = self._file
        with file.changed:
            if file.readers != file.mine:
                return False
            for connection in (*file.cursors, file.instance):
                if connection is not None:
                    connection.close()
            file.instance = None
            _log.info("%s: the database failed by a fault of its own", self.path)
            again, file.careful = not file.careful, True
        return again

    def _enter(self, deadline: Deadline, *, public: bool, idle: bool) -> DuckDBPyConnection:
        file = self._file
        if (
            not file.mine
        ):  # a nested reading must not wait for a writer that waits for the outer one
            pass_gate(self.path, deadline)
        with file.changed:
            free = file.changed.wait_for(
                lambda: not file.writing and (file.mine or not file.waiting) and self._is_fit(file),
                deadline.left(),
            )
            if not free:
                raise StoreError(f"{self.path}: another thread has been using it for too long")
            settings = self._memory, self._spill, file.careful, self.together
            file.refresh(settings, None if self._tables is None else tables_folder())
            try:
                instance = file.instance
                if instance is None:
                    file.folder, file.settings = tables_folder(), settings
                    instance = self._open(deadline)
                if self._checked and not file.checked:
                    if isinstance(instance, AttachedFile):
                        self._check(instance.cursor("main"), instance.name, file.opened)
                    else:
                        self._check(instance, "", file.opened)
                    file.checked = True
                inside = self._checked and not public
                if idle or not isinstance(instance, AttachedFile):
                    connection = instance.cursor()
                    if inside and not idle:
                        connection.execute(f"USE {INSIDE}")  # a cursor does not inherit the setting
                else:
                    connection = instance.cursor(INSIDE if inside else "main")
            except BaseException:
                file.close()
                raise
            file.cursors.append(connection)
            file.readers += 1
            file.mine += 1
            return connection

    def _is_fit(self, file: OpenFile) -> bool:
        return not file.readers or self.together == isinstance(file.instance, AttachedFile)

    def _leave(self, connection: DuckDBPyConnection, *, failed: bool) -> None:
        file = self._file
        with file.changed:
            file.spoiled |= failed
            if connection in file.cursors:  # not in a process forked meanwhile
                file.cursors.remove(connection)
                file.mine -= 1
                file.readers -= 1
                file.rest()

    def _check(self, connection: DuckDBPyConnection, database: str, stamp: Stamp) -> None:
        """Raise an error if a file is not a valid store. Files checked before are skipped."""
        if stamp and stamp == self._file.good:
            return
        with translated(self.path):
            shape.check(connection, database or shape.database_of(connection), self.path)
        self._file.good = stamp

    def _open(self, deadline: Deadline) -> DuckDBPyConnection | AttachedFile:
        """Open the store file for all readers of this process, and return the database instance."""
        file = self._file
        while True:
            stamp = stamp_of(self.path)
            instance = self._opened(deadline)
            if stamp == stamp_of(self.path):
                break
            instance.close()  # the file was replaced meanwhile, so this may be either file
        file.instance, file.opened, file.checked = instance, stamp, False
        _log.debug("%s: opened to read", self.path)
        return instance

    def _opened(self, deadline: Deadline) -> DuckDBPyConnection | AttachedFile:
        # All readers have one configuration, because they share the instance, also for user statements.
        config: dict[str, str | bool | int | float | list[str]] = {
            "memory_limit": memory_setting(self._memory),
            "temp_directory": str(spill_folder()),
            "max_temp_directory_size": memory_setting(self._spill),
            "autoload_known_extensions": False,
            "autoinstall_known_extensions": False,
            "python_enable_replacements": False,
        }
        while True:
            try:
                refuse_special(self.path)
                with translated(self.path):
                    if self.together:
                        connect = partial(self._shut_in, config, ":memory:", read_only=False)
                        settings = self._file.folder, *self._file.settings
                        return AttachedFile(self.path, connect, settings)
                    return self._shut_in(config, str(self.path.absolute()))
            except BusyError as busy:
                deadline.pause(busy)

    def _shut_in(
        self, config: dict[str, Any], place: str, *folders: Path, read_only: bool = True
    ) -> DuckDBPyConnection:
        """Open a database that can read only its own file, user tables and the given folders."""
        connection = duckdb.connect(place, read_only=read_only, config=config)
        # If these were in the config above, DuckDB might apply them before the folder and reject it.
        seen = [str(folder) for folder in (self._file.folder, *folders)]
        connection.execute("SET allowed_directories = $1", [seen])
        without_faults(connection)
        if self._file.careful:
            _be_careful(connection)
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
        return connection

    @contextmanager
    def writing(self, connection: DuckDBPyConnection, *folders: Path) -> Generator[None]:
        """Context manager of one write transaction on the store. An exception rolls it back.

        Raises
        ------
        StoreError
            The file does not exist, is not writable, or another process used it for too long.
        """
        with self.attached(connection, *folders), transaction(connection):
            yield

    @contextmanager
    def attached(self, connection: DuckDBPyConnection, *folders: Path) -> Generator[None]:
        """Attach the store to the caller's connection under the name ``store``, with exclusive access.

        From then on, the connection can access only the store and the named folders, and its settings are
        locked.
        """
        with self._alone() as deadline, closed_gate(self.path, deadline):
            with translated(self.path):
                shut_in(connection, self.path, folders)
            self._attach(connection, deadline)
            checked = False
            try:
                if self._checked:
                    self._check(connection, "store", stamp_of(self.path))
                    checked = True
                    with translated(self.path):
                        shape.add_trace(connection, "store")
                with translated(self.path):
                    yield
            finally:
                # The error was already raised, and the caller closes the connection anyway.
                with suppress(duckdb.Error):
                    connection.execute("DETACH store")
                    if checked:  # the new content is from this process
                        self._file.good = stamp_of(self.path)

    @contextmanager
    def _alone(self) -> Generator[Deadline]:
        """Context manager that excludes all other threads of this process from the store file."""
        file, deadline = self._file, Deadline(self._wait_s)
        if file.mine:
            raise StoreError(f"{self.path}: cannot be written while the same thread reads it")
        with file.changed:
            file.waiting += 1
            try:
                free = file.changed.wait_for(
                    lambda: not file.writing and not file.readers, deadline.left()
                )
                if not free:
                    raise StoreError(f"{self.path}: another thread has been using it for too long")
                file.close()  # it may still be open
                file.writing = True
            finally:
                file.waiting -= 1
        try:
            yield deadline
        finally:
            with file.changed:
                file.writing = False
                file.changed.notify_all()

    def _attach(self, connection: DuckDBPyConnection, deadline: Deadline) -> None:
        while True:
            refuse_special(self.path)  # ATTACH would create a missing file
            try:
                with translated(self.path):
                    connection.execute(
                        f"ATTACH {literal(str(self.path.absolute()))} AS store"
                        f" (STORAGE_VERSION '{STORAGE_VERSION}')"
                    )
                return
            except BusyError as busy:
                deadline.pause(busy)


@contextmanager
def transaction(connection: DuckDBPyConnection) -> Generator[None]:
    """Context manager of one transaction on the attached store. An exception rolls it back."""
    connection.execute("BEGIN TRANSACTION")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(duckdb.Error):  # a failed transaction is already rolled back
            connection.execute("ROLLBACK")
        raise
    # The checkpoint removes the write-ahead log. If it fails, the log stays, and its data are safe.
    with suppress(duckdb.Error):
        connection.execute("CHECKPOINT store")


def spill_folder() -> Path:
    """Return an unused folder path. DuckDB creates the folder when memory is full, and removes it."""
    return new_place("spill")
