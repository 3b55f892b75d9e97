"""Checks of store paths, and the folders of unpublished traces next to a store, ``STORE.segment-…``."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING, Final

from sgstore.base.temporary_folders import HeldFolder, sweep
from sgstore.errors import StoreError, one_store_needed, url_named
from sgstore.store._engine_errors import os_fault

if TYPE_CHECKING:
    from pathlib import Path


_KINDS: Final = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}

_NO_NAME: Final = frozenset("?\\")
"""Characters in file names that DuckDB treats as the end of a path, or as a slash."""


def refuse_special(path: Path) -> None:
    """Raise an error for pipes and devices, which would block when opened.

    Raises
    ------
    StoreError
    """
    if url_named(path) is not None:
        raise one_store_needed(path)
    Folder.refuse_name(path)
    for file in (path.with_name(f"{path.name}.wal"), path):
        try:
            mode = file.stat().st_mode
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a name of a file"
            raise StoreError(f"{path}: cannot be read: {reason}") from error
        if (path / "COLLECTION.json").is_file():
            raise one_store_needed(path)
        if not stat.S_ISREG(mode):
            what = _KINDS.get(stat.S_IFMT(mode), "no file")
            whose = "" if file == path else f"{file.name} beside it is "
            raise StoreError(
                f"{path}: {whose}{what}: not a store; expected a file written by 'sgstore ingest'"
            )
    if not path.exists():
        raise StoreError(f"{path}: store not found; create it with 'sgstore ingest'")


_NAME: Final = ".segment-"


class Folder(HeldFolder):
    """Folder of unpublished data next to a store. A lock shows that its process still runs.

    Parameters
    ----------
    store : Path

    Attributes
    ----------
    path : Path

    Raises
    ------
    StoreError
        The folder is not writable, or the store name is invalid.
    """

    def __init__(self, store: Path) -> None:
        refuse_odd_name(store)
        try:
            super().__init__(store.parent, f"{store.name}{_NAME}")
        except OSError as error:
            raise os_fault(f"{store.parent}: cannot be written", error) from error

    @staticmethod
    def refuse_name(path: Path) -> None:
        """Raise an error for a path with characters that DuckDB misinterprets.

        Raises
        ------
        StoreError
        """
        found = sorted(_NO_NAME & set(str(path.absolute())))
        if found and os.name == "posix" and url_named(path) is None:
            raise StoreError(
                f"{path}: DuckDB cannot open a path with {found[0]!r}; rename the store, or its folder"
            )


def remove_left_behind(store: Path) -> None:
    """Remove the folders that killed writer processes left next to a store."""
    sweep(store.parent, f"{store.name}{_NAME}")


def refuse_odd_name(store: Path) -> None:
    """Raise an error for a path that is not valid UTF-8 or contains a null character.

    Raises
    ------
    StoreError
        The path is not UTF-8, or contains a null character.
    """
    try:
        if b"\0" not in str(store).encode():
            return
    except UnicodeEncodeError:
        pass
    shown = str(store).encode(errors="backslashreplace").decode().replace("\0", "\\x00")
    raise StoreError(f"{shown}: the names of a store and its folders must be UTF-8; rename them")
