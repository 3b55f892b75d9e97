"""DuckDB errors without a cause in the query (full disk, busy file, internal errors), and their messages."""

from __future__ import annotations

import errno
import os
import shlex
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import duckdb

from sgstore.errors import FULL, SqlError, StoreError, reason_of

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path


def engine_fault(error: duckdb.Error) -> str | None:
    """Return one line about an internal DuckDB error, or ``None`` for another error."""
    if not isinstance(error, duckdb.InternalException | duckdb.FatalException):
        return None
    reason = str(error).strip().partition("\n")[0].removeprefix("INTERNAL Error: ")
    return f"a fault of DuckDB {duckdb.__version__} itself, not of the question: {reason}"


def spill_fault(message: str) -> str | None:
    """Return the message for a query beyond its memory and disk limits, or ``None`` for another error."""
    if not message.startswith("Out of Memory Error"):
        return None
    return (
        "stopped: it needs more memory, and disk beside it, than it may take; allow it more (--max-spill 50GB;"
        " memory and max_spill of Store), or ask for less: a label for each node, such as (v:Vehicle), fewer"
        " variables, a narrower WHERE, no ORDER BY"
    )


_BUSY: Final = ("Could not set lock on file", "Conflicting lock is held")
"""Words in the DuckDB error if another process uses the file."""

_HELD_HERE: Final = (
    "Unique file handle conflict",
    "different configuration than existing connections",
)
"""Words in the DuckDB error if another connection of this process uses the file."""


class BusyError(StoreError):
    """Error: another process or connection uses the store file."""


class EngineError(StoreError):
    """Error: DuckDB failed with an internal error."""


class DiskFullError(StoreError):
    """Error: the disk is full, or a limit of the file size or of the user is reached."""


class HeldHereError(BusyError):
    """Error: a DuckDB connection of this process, not made by sgstore, uses the store file."""


@contextmanager
def translated(path: Path) -> Generator[None]:
    """Convert DuckDB errors to store errors, and an interrupted statement to ``KeyboardInterrupt``.

    DuckDB converts Ctrl-C: to a RuntimeError while a statement runs, and to an error that quotes
    KeyboardInterrupt while it scans Python arrays.
    """
    try:
        yield
    except RuntimeError as error:
        if "Query interrupted" in str(error):
            raise KeyboardInterrupt from error
        raise
    except duckdb.Error as error:
        message = str(error).strip()
        if isinstance(error, duckdb.InterruptException) or "KeyboardInterrupt" in message:
            raise KeyboardInterrupt from error
        if (fault := engine_fault(error)) is not None:
            raise EngineError(f"{path}: {fault}") from error
        if any(phrase in message for phrase in _HELD_HERE):
            raise HeldHereError(
                f"{path}: open in this process already, by a connection of duckdb's own (duckdb.connect);"
                " close that first, or ask by sgstore.open(…).sql"
            ) from error
        if any(phrase in message for phrase in _BUSY):
            raise BusyError(f"{path}: in use by another process for too long") from error
        if (spilled := spill_fault(message)) is not None:
            raise SqlError(spilled) from error
        if (full := _without_room(message)) is not None:
            raise DiskFullError(f"{path}: {full}") from error
        raise StoreError(f"{path}: {_reason(message, path)}") from error


def _without_room(message: str) -> str | None:
    """Return the message for a DuckDB error about missing disk space at a write; ``None`` for other errors."""
    if os.strerror(errno.EFBIG) in message and "duckdb_temp" in message:
        return None  # temporary data of a sandbox: its memory is too small, not the disk
    found = (words for code, words in FULL.items() if os.strerror(code) in message)
    return next(found, None)


def move(path: Path, to: Path, fault: str) -> Path:
    """Move a file to a path, replace an existing file there, and return the new path.

    Raises
    ------
    StoreError
        The file cannot be moved; the message begins with ``fault``.
    """
    try:
        return path.replace(to)
    except OSError as error:
        raise os_fault(fault, error) from error


def os_fault(message: str, error: OSError) -> StoreError:
    """Return a store error for an operating system error; :class:`DiskFullError` if the disk is full."""
    kind = DiskFullError if error.errno in FULL else StoreError
    return kind(f"{message}: {reason_of(error)}")


def _reason(message: str, path: Path) -> str:
    # DuckDB may treat a name that ends in .csv as a table file.
    phrases = (
        "not a valid DuckDB database file",
        "Is a directory",
        "in-memory database in read-only",
    )
    if any(phrase in message for phrase in phrases):
        hint = "not a store; expected a file that 'sgstore ingest' made"
        doctor = shlex.join(["sgstore", "doctor", str(path)])
        return hint if path.is_dir() else f"{hint}; for a recording: {doctor}"
    if "database does not exist" in message:
        return "store not found; create it with 'sgstore ingest'"
    if "database file with version number" in message:
        return "made by a newer DuckDB than is installed here; upgrade the package duckdb"
    return message
