"""Files of recordings: opened with care, hashed, and asked for one message by its place."""

from __future__ import annotations

import hashlib
import stat
from typing import TYPE_CHECKING

from mcap.opcode import Opcode

from sgstore.errors import TraceError
from sgstore.traces.chunks import (
    HEAD,
    MAX_CHUNK,
    MESSAGE_HEAD,
    READ_ERRORS,
    read_chunk_head,
    read_records,
)
from sgstore.traces.parts import bag_folder, part_at, parts_of

if TYPE_CHECKING:
    from io import BufferedReader
    from pathlib import Path


def read_message(path: Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """The data of one message, by its place; see :class:`sgstore.world.MessageRefs`.

    In a bag, places count from the beginning of its first file.

    Raises
    ------
    TraceError
        The file cannot be opened, the chunk is damaged, or there is no message of that length: the file
        was replaced.
    """
    record = b""
    path, base = _file_at(path, offset if chunk_offset < 0 else chunk_offset)
    chunk_offset, offset = (
        (-1, offset - base) if chunk_offset < 0 else (chunk_offset - base, offset)
    )
    with open_regular(path) as file:
        try:
            if chunk_offset < 0:
                file.seek(offset)
                record = file.read(min(MESSAGE_HEAD.itemsize + length, MAX_CHUNK))
            else:
                records = read_records(file, read_chunk_head(file, chunk_offset))
                record = bytes(records[offset : offset + MESSAGE_HEAD.itemsize + length])
            opcode, found = HEAD.unpack_from(record)
        except TraceError as error:
            raise TraceError(error.reason, path=path, offset=chunk_offset) from error
        except READ_ERRORS:  # an offset outside the file or the chunk
            opcode, found = 0, 0
    fields = MESSAGE_HEAD.itemsize - HEAD.size
    if (opcode, found, len(record)) != (
        Opcode.MESSAGE,
        fields + length,
        HEAD.size + fields + length,
    ):
        reason = f"no message of {length} bytes at {offset} there: the file was replaced"
        raise TraceError(reason, path=path, offset=max(chunk_offset, 0))
    return record[MESSAGE_HEAD.itemsize :]


def digest_of(path: Path) -> str:
    """SHA-256 of a whole file, or of the files of a bag one after another, in hexadecimal digits.

    Raises
    ------
    TraceError
        A file cannot be read.
    """
    folder = bag_folder(path)
    files = [path] if folder is None else [p.path for p in parts_of(folder) if p.size >= 0]
    digest = hashlib.sha256()
    for one in files:
        with open_regular(one) as file:
            try:
                hashlib.file_digest(file, lambda: digest)
            except OSError as error:
                raise TraceError(f"cannot be read: {error.strerror}", path=one) from error
    return digest.hexdigest()


def mark_of(path: Path) -> tuple[int, int]:
    """Size and time of change of a recording, which tell whether it was replaced; bytes, ns.

    Of a bag: the size of its files together, and the latest time of change among them.

    Raises
    ------
    OSError
        There is no such file.
    TraceError
        The metadata of the bag cannot be read, or none of its files is there.
    """
    folder = bag_folder(path)
    if folder is None:
        status = path.stat()
        return status.st_size, status.st_mtime_ns
    files = [part for part in parts_of(folder) if part.size >= 0]
    return sum(part.size for part in files), max(part.path.stat().st_mtime_ns for part in files)


def _file_at(path: Path, place: int) -> tuple[Path, int]:
    """The file in which a place of a recording lies, and the place at which that file begins."""
    folder = bag_folder(path)
    if folder is None:
        return path, 0
    part = part_at(parts_of(folder), place)
    if part is None:
        raise TraceError("no file of the bag is there: it was replaced", path=path, offset=place)
    return part.path, part.base


def open_regular(path: Path) -> BufferedReader:
    """A regular file, opened for reading. Pipes and devices, which one would wait for, are refused.

    Raises
    ------
    TraceError
        There is no such file, it is a folder or a device, or it may not be read.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise TraceError("a folder; expected an MCAP recording", path=path)
        if not stat.S_ISREG(mode):
            raise TraceError("not a regular file; expected an MCAP recording", path=path)
        return path.open("rb")
    except FileNotFoundError as error:
        raise TraceError("no such file", path=path) from error
    except (OSError, ValueError) as error:
        raise TraceError(f"cannot be opened: {error}", path=path) from error
