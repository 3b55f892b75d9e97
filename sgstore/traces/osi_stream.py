"""The bytes of a single-channel OSI file, as they are or out of zstd, and where in the file they stand.

A compressed file is decompressed block by block, and a block of zstd never becomes more than 128 KiB:
so whatever a file claims, no more than that comes at once. What a whole file may become is bounded too.

Source: zstd compression format (RFC 8878), sections 3.1.1 and 3.1.2.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import zstandard

from sgstore.errors import TraceError
from sgstore.traces.chunks import READ_ERRORS
from sgstore.traces.fetch import open_regular

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import BinaryIO

PREFIX: Final = struct.Struct("<I")
"""Head of every message: how many bytes follow."""
MAX_MESSAGE: Final = 64 << 20
"""Greatest size of a message; bytes."""
MAX_RATIO: Final = 2000
"""How many times larger a file may become that is decompressed."""
MAX_WINDOW: Final = 128 << 20
"""Greatest window of a zstd frame (``zstd --long``); bytes."""

ZSTD: Final = b"\x28\xb5\x2f\xfd"
_ALWAYS: Final = 64 << 20
"""What a file may become whatever its size; bytes."""
_PIECE: Final = 1 << 20
_FRAME_HEAD: Final = 18
"""Greatest length of the head of a zstd frame; bytes."""
_SKIPPABLE: Final = range(0x184D2A50, 0x184D2A60)
_LITERAL, _REPEATED, _COMPRESSED = 0, 1, 2


def is_compressed(file: BinaryIO) -> bool:
    """Whether a file begins as zstd does."""
    file.seek(0)
    magic = file.read(4)
    return magic == ZSTD or (len(magic) == 4 and PREFIX.unpack(magic)[0] in _SKIPPABLE)


def pieces(file: BinaryIO, start: int = -1) -> Iterator[tuple[int, bytes]]:
    """The content of a file, piece by piece; each with the place of the zstd frame that it is of.

    Parameters
    ----------
    file : file
    start : int
        Where to begin: at the frame at this offset; -1: at the beginning.

    Yields
    ------
    place : int
        Byte offset of the zstd frame in the file; -1 where the file is not compressed.
    content : bytes

    Raises
    ------
    TraceError
        From here on the file cannot be decompressed, or it becomes too much.
    """
    if start < 0 and not is_compressed(file):
        file.seek(0)
        while piece := file.read(_PIECE):
            yield -1, piece
        return
    file.seek(max(start, 0))
    total = 0
    while head := file.read(4):
        place = file.tell() - len(head)
        if len(head) == 4 and PREFIX.unpack(head)[0] in _SKIPPABLE:
            length = file.read(4)
            file.seek(PREFIX.unpack(length)[0] if len(length) == 4 else 0, 1)
            continue
        for piece in _frame(file, place):
            total += len(piece)
            if total > max(_ALWAYS, MAX_RATIO * file.tell()):
                reason = f"decompressed to more than {MAX_RATIO} times its size"
                raise TraceError(reason, offset=place)
            yield place, piece


def _frame(file: BinaryIO, place: int) -> Iterator[bytes]:
    """The blocks of a zstd frame; of one whose end is missing, those that are whole."""
    file.seek(place)
    head = file.read(_FRAME_HEAD)
    try:
        parameters = zstandard.get_frame_parameters(head)
        size = zstandard.frame_header_size(head)
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW).decompressobj()
        file.seek(place + size)
        yield decompressor.decompress(head[:size])
        last = False
        while not last:
            block = file.read(3)
            if len(block) < 3:
                return
            bits = int.from_bytes(block, "little")
            last, kind, length = bool(bits & 1), bits >> 1 & 3, bits >> 3
            content = file.read(1 if kind == _REPEATED else length)
            yield decompressor.decompress(block + content)
        if parameters.has_checksum:
            yield decompressor.decompress(file.read(4))
    except READ_ERRORS as error:
        if len(head) < _FRAME_HEAD and not file.read(1):
            return  # the file ends inside the head of a frame
        raise TraceError(f"cannot be decompressed (zstd): {error}", offset=place) from error


def read_message(path: Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """The data of one message, by its place.

    Parameters
    ----------
    path : Path
    chunk_offset : int
        Byte offset of the zstd frame that the message begins in, -1 where the file is not compressed.
    offset : int
        Byte offset of the message's head in what that frame and the following become, or in the file.
    length : int
        Bytes of its data.

    Raises
    ------
    TraceError
        The file cannot be opened or decompressed, or there is no message of that length there: the file was
        replaced.
    """
    missing = TraceError(
        f"no message of {length} bytes at {offset} there: the file was replaced", path=path
    )
    if not 0 <= length <= MAX_MESSAGE or offset < 0:
        raise missing
    wanted = PREFIX.size + length
    with open_regular(path) as file:
        try:
            if chunk_offset < 0:
                file.seek(offset)
                record = file.read(wanted)
            else:
                record = _cut(pieces(file, chunk_offset), offset, wanted)
        except (TraceError, *READ_ERRORS) as error:
            raise missing from error
    if len(record) != wanted or PREFIX.unpack_from(record)[0] != length:
        raise missing
    return record[PREFIX.size :]


def _cut(content: Iterator[tuple[int, bytes]], offset: int, length: int) -> bytes:
    """``length`` bytes of a content from ``offset`` on."""
    found = bytearray()
    position = 0
    for _, piece in content:
        if position + len(piece) > offset:
            found += piece[max(offset - position, 0) :]
        position += len(piece)
        if len(found) >= length:
            break
    return bytes(found[:length])
