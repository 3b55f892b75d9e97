"""Gate of a store: a lock file that gives a waiting writer precedence over new readers."""

from __future__ import annotations

import atexit
import gc
import os
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from sgstore.errors import StoreError
from sgstore.store._engine_errors import HeldHereError, os_fault
from sgstore.store._lease import gate_of

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path


try:
    import fcntl
except ImportError:  # not on Windows: without a gate, access is first come, first served
    fcntl = None


_HELD_HERE_S: Final = 0.25
"""Longest wait for another connection of this process, which may be closing; s."""

_PAUSE: Final = 0.005, 0.1
"""First and longest pause between two attempts; s."""


class Deadline:
    """Timer for retries, with growing pauses and an overall time limit."""

    def __init__(self, wait_s: float) -> None:
        self._start = time.monotonic()
        self._end = self._start + wait_s
        self._next, self._longest = _PAUSE

    def left(self) -> float:
        return max(self._end - time.monotonic(), 0)

    def pause(self, error: StoreError) -> None:
        """Sleep until the next attempt. Raise the given error if no time is left."""
        if isinstance(error, HeldHereError):
            if time.monotonic() - self._start > _HELD_HERE_S:
                raise error
            gc.collect()  # the connection may be unreferenced garbage
        if not self.left():
            raise error
        time.sleep(min(self._next, self.left()))
        self._next = min(self._next * 1.5, self._longest)


def pass_gate(path: Path, deadline: Deadline) -> None:
    """Wait while a writer process holds the lock file. DuckDB's own lock still protects the store."""
    if fcntl is None:
        return
    try:
        gate = os.open(gate_of(path), os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return
    try:
        _lock(gate, fcntl.LOCK_SH, path, deadline)
    finally:
        os.close(gate)


@contextmanager
def closed_gate(path: Path, deadline: Deadline) -> Generator[None]:
    """Context manager that holds the lock file of a store, so that new readers in other processes wait."""
    if fcntl is None:
        yield
        return
    gate = _Gate(path)
    atexit.register(gate.remove)  # in case of an interrupt before the finally block
    try:
        gate.close(deadline)
        yield
    finally:
        gate.remove()
        atexit.unregister(gate.remove)


class _Gate:
    """Lock file of a store, held by this process so that new readers wait."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = -1
        self._begun = False

    def close(self, deadline: Deadline) -> None:
        """Wait until no other process holds the lock file of the store, and take it."""
        self._begun = True
        while True:
            try:
                self._lock = os.open(gate_of(self._path), os.O_RDWR | os.O_CREAT, 0o666)
                if fcntl is not None:
                    _lock(self._lock, fcntl.LOCK_EX, self._path, deadline)
                if self._is_there():
                    return
            except OSError as error:
                raise os_fault(f"{self._path}: cannot be written", error) from error
            # The previous owner has deleted the file, so other processes would not see this lock.
            os.close(self._lock)
            self._lock = -1

    def _is_there(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._lock), gate_of(self._path).stat())
        except FileNotFoundError:
            return False

    def remove(self) -> None:
        """Delete the lock file of the store, unless another process holds it now."""
        if fcntl is None or not self._begun:
            return
        with suppress(OSError):
            if self._lock < 0:  # an interrupt came before the assignment
                self._lock = os.open(gate_of(self._path), os.O_RDWR)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if self._is_there():
                gate_of(self._path).unlink()
        with suppress(OSError):
            os.close(self._lock)
        self._lock, self._begun = -1, False


def _lock(gate: int, how: int, path: Path, deadline: Deadline) -> None:
    if fcntl is None:
        return
    while True:
        try:
            fcntl.flock(gate, how | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            deadline.pause(StoreError(f"{path}: another process has been writing for too long"))
        except OSError as error:
            if how == fcntl.LOCK_SH:
                return  # a file system without locks: DuckDB decides alone
            raise os_fault(f"{path}: cannot be locked for writing", error) from error
