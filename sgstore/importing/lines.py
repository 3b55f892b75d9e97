"""Text files of strangers, line by line, within bounds; ``.xz``, ``.gz`` and ``.bz2`` are unpacked."""

from __future__ import annotations

import bz2
import gzip
import lzma
import stat
import zlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TraceError
from sgstore.importing.given import wrong

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path

MAX_LINE: Final = 64 << 20
"""Longest line; bytes. A graph of 100,000 nodes and their attributes is a quarter of it."""

MAX_TEXT: Final = 1 << 36
"""Most bytes of a file, unpacked: 64 GiB."""

MAX_RATIO: Final = 2_000
"""Most bytes, unpacked, for each byte of a file beyond the first GiB: text is never packed so well."""

_FREE: Final = 1 << 30
_PACKED: Final = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}


def stem_of(path: Path) -> str:
    """The name of a file without what says how it is written: ``graphs.csv.xz`` is ``graphs``."""
    name = path.name
    for ending in (*_PACKED, ".csv", ".json", ".ndjson", ".jsonl"):
        if name.lower().endswith(ending) and len(name) > len(ending):
            name = name[: -len(ending)]
    return name


@contextmanager
def lines_of(path: Path) -> Generator[Iterator[str]]:
    """The lines of a file, with their ends.

    Raises
    ------
    TraceError
        It cannot be opened, is no regular file, is no UTF-8, or exceeds a bound; it says in which line.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TraceError("no regular file", path=path)
        opened = _PACKED.get(path.suffix.lower())
        file = opened(path, "rb") if opened else path.open("rb")
    except OSError as error:
        raise TraceError(f"cannot be read: {error.strerror or error}", path=path) from error
    with file:
        yield _lines(path, file, status.st_size)


def _lines(path: Path, file: Any, size: int) -> Iterator[str]:
    number = total = 0
    while True:
        number += 1
        try:
            line = file.readline(MAX_LINE + 1)
        except (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error) as error:
            raise wrong(path, f"line {number}", f"cannot be read: {error}") from error
        if not line:
            return
        if len(line) > MAX_LINE:
            raise wrong(path, f"line {number}", f"longer than {MAX_LINE >> 20} MiB")
        total += len(line)
        if total > MAX_TEXT or total > _FREE + MAX_RATIO * size:
            raise wrong(
                path, f"line {number}", f"{total:,} bytes unpacked, from a file of {size:,}"
            )
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError as error:
            raise wrong(
                path, f"line {number}", f"no UTF-8 at byte {error.start} of the line"
            ) from error
