"""A folder beside a store for what is on its way into it.

It is called ``STORE.segment-…``, is locked while its process lives and removed with it; what a killed process
leaves is removed by the next one.
"""

from __future__ import annotations

import os
import secrets
import shutil
from contextlib import suppress
from glob import escape
from typing import TYPE_CHECKING, Final, Self

from sgstore.errors import StoreError

try:
    import fcntl
except ImportError:  # not on Windows: there a folder in use cannot be removed anyway
    fcntl = None

if TYPE_CHECKING:
    from pathlib import Path

_NAME: Final = ".segment-"


class Folder:
    """A folder beside a store that is locked for as long as its process lives.

    Parameters
    ----------
    store : Path

    Attributes
    ----------
    path : Path

    Raises
    ------
    StoreError
        Nothing can be written there.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        _remove_dead(store)
        name = f"{store.name}{_NAME}{os.getpid()}"
        try:
            while True:
                self.path = store.with_name(f"{name}-{secrets.token_hex(4)}")
                self.path.mkdir()
                if self._locked():
                    return
        except OSError as error:
            raise StoreError(f"{store.parent}: cannot be written: {error.strerror}") from error

    def _locked(self) -> bool:
        """Lock the folder, unless someone took it for a dead one before it was locked."""
        try:
            self._lock = os.open(self.path, os.O_RDONLY)
        except FileNotFoundError:
            return False
        if fcntl is None:
            return True
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(self.path.stat(), os.fstat(self._lock)):
                return True
        os.close(self._lock)
        return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove it with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        with suppress(OSError):
            os.close(self._lock)
        # A worker may outlive its killed parent for a moment, and write into the folder while it is removed.
        _remove_dead(self._store)


def _remove_dead(store: Path) -> None:
    """Remove the folders of segments whose processes are gone."""
    if fcntl is None:
        return
    for folder in store.parent.glob(f"{escape(store.name)}{_NAME}*"):
        with suppress(OSError):  # its process lives, or someone else removed it
            lock = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
