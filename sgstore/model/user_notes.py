"""Tags and notes of users about frames, in a CSV file next to the store.

The store is only a cache, so it does not contain them. Each line is one tag: ``trace,seq,tag,note,who,at``.
Lines are only appended. The removal of a tag appends the same line with ``-`` before the tag. Two users can
therefore write at the same time without loss.
"""

from __future__ import annotations

import csv
import getpass
import io
import os
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from sgstore.errors import StoreError, reason_of

try:
    import fcntl
except ImportError:  # not on Windows, where a line is also written at once, but without a lock
    fcntl = None

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ENDING: Final = ".notes.csv"
"""Suffix of the file, after the name of the store."""

MOST_BYTES: Final = 64 << 20
"""Largest file that can be read; bytes."""

LONGEST: Final = {"tag": 100, "note": 2000}
"""Maximum length of the texts; characters."""


@dataclass(frozen=True, slots=True)
class Note:
    """Tag that a user gave to one frame, with an optional note.

    Attributes
    ----------
    trace : str
    seq : int
    tag, note : str
    who : str
        Name of the account that wrote it.
    at : str
        Time of writing, by the clock of the machine; ISO 8601, UTC.
    """

    trace: str
    seq: int
    tag: str
    note: str = ""
    who: str = ""
    at: str = ""


COLUMNS: Final = tuple(field.name for field in fields(Note))


class NotesFile:
    """CSV file with the tags that users gave to frames of a store.

    Parameters
    ----------
    store : Path
    """

    def __init__(self, store: Path) -> None:
        self.path = store.with_name(store.name + ENDING)

    def stamp(self) -> tuple[int, int]:
        """Return the size (bytes) and modification time (ns) of the tag file; zeros if it is missing."""
        try:
            found = self.path.stat()
        except OSError:
            return 0, 0
        return found.st_size, found.st_mtime_ns

    def add(self, note: Note, last: int, *, gone: bool = False) -> None:
        """Append the tag (or its removal) to the file, one row per frame from the note's frame to ``last``.

        Raises
        ------
        StoreError
            A text is empty or too long, or the file cannot be written.
        """
        for name, most in LONGEST.items():
            text = getattr(note, name)
            if len(text) > most or (name == "tag" and not text.strip()) or text.startswith("-"):
                raise StoreError(
                    f"{name}: expected a text of at most {most} letters that does not begin with '-'"
                )
        told = "-" * gone + note.tag.strip(), note.note, _account(), _now()
        lines = io.StringIO()
        rows = ((note.trace, seq, *told) for seq in range(note.seq, last + 1))
        csv.writer(lines, lineterminator="\n").writerows(rows)
        try:
            self._append(lines.getvalue().encode())
        except OSError as error:
            raise StoreError(f"{self.path}: {reason_of(error)}") from error

    def _append(self, lines: bytes) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        file = os.open(self.path, flags, 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX)
            size = os.fstat(file).st_size
            if size == 0:
                lines = ",".join(COLUMNS).encode() + b"\n" + lines
            left = memoryview(lines)
            try:
                while left:  # a full disk takes a part of the lines first
                    left = left[os.write(file, left) :]
            except OSError:
                os.ftruncate(file, size)
                raise
        finally:
            os.close(file)

    def read(self) -> list[Note]:
        """Return the current tags of all frames, without removed ones. Invalid lines are skipped.

        Raises
        ------
        StoreError
            The file cannot be read, or is larger than :data:`MOST_BYTES`.
        """
        if self.stamp()[0] > MOST_BYTES:
            raise StoreError(f"{self.path}: larger than {MOST_BYTES} bytes")
        try:
            text = self.path.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StoreError(f"{self.path}: {error.strerror}") from error
        found: dict[tuple[str, int, str], Note] = {}
        for note in _notes_in(text):
            key = note.trace, note.seq, note.tag.removeprefix("-")
            if note.tag.startswith("-"):
                found.pop(key, None)
            else:
                found[key] = note
        return list(found.values())


def write_table(notes: list[Note], to: Path) -> None:
    """Write tags of frames as a CSV table for queries: one row per frame, its tags separated by commas."""
    frames: dict[tuple[str, int], list[Note]] = {}
    for note in notes:
        frames.setdefault((note.trace, note.seq), []).append(note)
    with to.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for (trace, seq), some in frames.items():
            texts = (
                ", ".join(filter(None, values))
                for values in zip(*(astuple(n)[2:5] for n in some), strict=True)
            )
            table.writerow((trace, seq, *texts, some[-1].at))


def _notes_in(text: str) -> Iterator[Note]:
    with suppress(csv.Error):
        for row in csv.reader(text.splitlines()):
            if len(row) == len(COLUMNS) and row[1].isdecimal():
                yield Note(row[0], int(row[1]), *row[2:])


def _account() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # an account without a name
        return ""


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
