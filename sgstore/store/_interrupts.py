"""Calls of DuckDB that end at once after a signal such as Ctrl+C.

Python runs signal handlers only in the main thread, between bytecodes. DuckDB allows this only between its
tasks, and a task may take minutes. So another thread runs the call, and the main thread waits. A signal
interrupts this wait at once. The main thread then interrupts the database, which also stops within a task.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from duckdb import DuckDBPyConnection


T = TypeVar("T")

_LOOK_S: Final = 0.5
"""Interval of signal checks if signals do not interrupt waiting (on Windows); s."""
_AGAIN_S: Final = 0.01
"""Interval of repeated interrupts, because DuckDB ignores an interrupt before the statement begins; s."""


def interruptible(connection: DuckDBPyConnection, step: Callable[[], T]) -> T:
    """Run a database call. An exception from a signal handler, such as Ctrl+C, interrupts the call.

    Parameters
    ----------
    connection : DuckDBPyConnection
        Connection of the call. No other thread may use it meanwhile.
    step : callable
        Database call. If the caller is the main thread, it runs in another thread.

    Returns
    -------
    Result of the call.

    Raises
    ------
    BaseException
        Exception of the call; or, after its end, the exception of a signal handler: ``KeyboardInterrupt`` after
        Ctrl-C.
    """
    if threading.current_thread() is not threading.main_thread():
        return step()
    task = _Task(step)
    try:
        began = _step_thread.begin(task)
        while began and not task.ended.wait(_LOOK_S):
            pass
    except BaseException:
        while not task.is_over():
            with suppress(BaseException):  # a second interrupt must not leave a running statement
                task.ended.wait(_AGAIN_S)
                interrupt(connection)
        task.forget()
        raise
    return task.result() if began else step()


interrupted: Final[set[int]] = set()
"""Ids of the interrupted connections. Functions in Python check this set, because DuckDB cannot stop them."""


def interrupt(connection: DuckDBPyConnection) -> None:
    """Interrupt the running SQL statement of a connection."""
    interrupted.add(id(connection))
    connection.interrupt()


class _Task(Generic[T]):
    """Database call that another thread runs, with its result or error."""

    def __init__(self, step: Callable[[], T]) -> None:
        self.ended = threading.Event()
        self._step = step
        # One token: the running thread takes it, or the thread that cancels the task.
        self._turns = [None]
        self._found: list[T] = []
        self._error: BaseException | None = None

    def take(self) -> bool:
        """Return True if the caller may run the task; False if the task is already taken."""
        try:
            self._turns.pop()
        except IndexError:
            return False
        return True

    def is_over(self) -> bool:
        """Return True if the task has ended, or can no longer start."""
        if self.take():
            self.ended.set()
        return self.ended.is_set()

    def result(self) -> T:
        """Return the result of the database call, or raise its exception."""
        try:
            if self._error is not None:
                raise self._error
            return self._found.pop()
        finally:
            self.forget()

    def forget(self) -> None:
        """Delete the stored result and error. The traceback of the error would keep the connection alive."""
        self._error = None
        self._found.clear()

    def run(self) -> None:
        """Run the database call, unless it was cancelled."""
        if not self.take():
            return
        try:
            self._found.append(self._step())
        except BaseException as error:  # noqa: BLE001  (raised again where it is waited for)
            self._error = error
        finally:
            self.ended.set()


class _StepThread:
    """Thread that runs the database calls of the main thread, one after another.

    The thread is reused, because a thread start takes longer than a short query.
    """

    def __init__(self) -> None:
        self._tasks: SimpleQueue[_Task[Any]] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def begin(self, task: _Task[Any]) -> bool:
        """Queue a database call for the thread. Return False if the thread cannot start."""
        # A forked process lacks this thread, and its queue may be locked forever.
        if self._thread is None or not self._thread.is_alive():
            self._tasks = SimpleQueue()
            thread = threading.Thread(target=_do_all, args=(self._tasks,), daemon=True)
            try:
                thread.start()
            except RuntimeError:  # no further thread can start
                return not task.take()
            self._thread = thread
        self._tasks.put(task)
        return True


def _do_all(tasks: SimpleQueue[_Task[Any]]) -> None:
    while True:
        tasks.get().run()  # no variable: it would keep the connection alive until the next task


_step_thread: Final = _StepThread()
