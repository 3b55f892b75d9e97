"""Temporary folders that are removed when their process ends.

Each folder is locked while its process lives, and is removed at exit. The next process that needs a folder in
the same place removes the folders of killed processes. It removes a folder only if its lock is free. A folder
without a lock has a mark; no other process removes it.
"""

from __future__ import annotations

import atexit
import os
import secrets
import shutil
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Generator


try:
    import fcntl
except ImportError:  # not on Windows: a folder in use cannot be removed there
    fcntl = None


PREFIX: Final = "sgstore-held-"
"""Prefix of the names of process folders in the folder for temporary files."""

_UNLOCKED: Final = ".unlocked"
"""Name of a file that marks a folder whose process could not lock it."""

_FLAGS: Final = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_NOFOLLOW", 0)


class HeldFolder:
    """New temporary folder with a lock that its process holds until exit.

    Parameters
    ----------
    parent : Path
    prefix : str
        Prefix of the folder name. Folders with this prefix are removed if their process has exited.
    undo : callable, optional
        Called with each such folder before its removal.

    Attributes
    ----------
    path : Path

    Raises
    ------
    OSError
        The place is not writable.
    """

    def __init__(
        self, parent: Path, prefix: str, undo: Callable[[Path], None] | None = None
    ) -> None:
        sweep(parent, prefix, undo)
        self._parent, self._prefix = parent, prefix
        self._owner = os.getpid()
        self._lock: int | None = None
        self.path = parent / f"{prefix}{self._owner}"
        # An interrupt may come before the caller can remove the folder.
        atexit.register(self.remove)
        try:
            while True:
                self.path = parent / f"{prefix}{self._owner}-{secrets.token_hex(4)}"
                self.path.mkdir(mode=0o700)
                if self._locked():
                    return
        except OSError:
            atexit.unregister(self.remove)
            raise

    def _locked(self) -> bool:
        """Lock the folder. Return False if another process has already removed it."""
        if fcntl is None:
            return True
        try:
            lock = os.open(self.path, _FLAGS)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:  # a file system without locks, or without free ones
            os.close(lock)
            return self._marked()
        with suppress(FileNotFoundError):
            if os.path.samestat(self.path.stat(), os.fstat(lock)):
                self._lock = lock
                return True
        os.close(lock)
        return False

    def _marked(self) -> bool:
        """Mark the folder, so that no process removes it. Return False if another process has removed it."""
        try:
            (self.path / _UNLOCKED).touch()
        except FileNotFoundError:
            return False
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the temporary folder and its content. A forked child process does nothing."""
        if os.getpid() != self._owner:
            return
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            with suppress(OSError):  # closed by a removal that was interrupted
                os.close(self._lock)
            self._lock = None
        # A child process may outlive this process briefly, and write into the folder during its removal.
        sweep(self._parent, self._prefix)
        atexit.unregister(self.remove)


def sweep(parent: Path, prefix: str, undo: Callable[[Path], None] | None = None) -> None:
    """Remove the temporary folders of ended processes. Before each removal, call ``undo``."""
    if fcntl is None:
        return
    names: list[str] = []
    with suppress(OSError), os.scandir(parent) as entries:
        names = [entry.name for entry in entries if entry.name.startswith(prefix)]
    for name in names:
        with suppress(OSError):  # it is in use, belongs to another user, or is already removed
            _remove_dead(parent / name, undo)


def _remove_dead(folder: Path, undo: Callable[[Path], None] | None) -> None:
    lock = os.open(folder, _FLAGS)
    try:
        if fcntl is not None and os.fstat(lock).st_uid == os.geteuid():
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if (folder / _UNLOCKED).exists():
                return  # its process may still run
            if undo is not None:
                undo(folder)
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def sweep_temporary() -> None:
    """Remove the temporary folders of processes that have ended."""
    sweep(_root(), PREFIX)


_mine: dict[tuple[int, Path], Path] = {}
"""Folders that exist for this process: (process id, folder for temporary files) → path."""


def temporary_folder() -> Path:
    """Return this process's folder for data that do not fit into memory. At exit, the folder is removed.

    If the creation fails, the folder does not exist, and later writes raise an error.
    """
    root = _root()
    key = os.getpid(), root
    if key not in _mine:
        try:
            held = HeldFolder(root, PREFIX)
        except OSError:
            _mine[key] = root / f"{PREFIX}{os.getpid()}-{secrets.token_hex(8)}"
        else:
            _mine[key] = held.path
    return _mine[key]


def new_place(name: str) -> Path:
    """Return an unused path in the temporary folder of this process."""
    return temporary_folder() / f"{name}-{secrets.token_hex(4)}"


@contextmanager
def working_folder(name: str) -> Generator[Path]:
    """Context manager that creates a temporary folder, and removes it at the end.

    Raises
    ------
    OSError
        The folder cannot be created.
    """
    folder = new_place(name)
    folder.mkdir(mode=0o700, parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _root() -> Path:
    try:
        return Path(tempfile.gettempdir()).resolve()
    except FileNotFoundError:  # no usual place is writable, or the disks are full
        return Path(os.environ.get("TMPDIR") or "/tmp").resolve()  # noqa: S108  only names it
