"""Reader of ROS 1 bags (format 2.0), record by record. Bags may be damaged or lack an index.

Source: ROS wiki, "Bags/Format/2.0".
"""

from __future__ import annotations

import bz2
import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import lz4.frame
import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap import open_regular
from sgstore.readers.rosbags._sqlite import MAX_TOPICS, Topic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from io import BufferedReader
    from pathlib import Path

MAGIC: Final = b"#ROSBAG V2.0\n"
MAX_CHUNK: Final = 512 << 20
"""Maximum size of a decompressed chunk; bytes."""
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_LENGTH: Final = struct.Struct("<I")
_MAX_HEADER: Final = 16 << 20
_FAULTS: Final = (ValueError, OSError, EOFError, RuntimeError, struct.error, MemoryError)


class Ros1Bag:
    """Messages of a ROS 1 bag, in the order of the file.

    Parameters
    ----------
    path : Path
    lose : function
        Called with the reason of each loss.

    Attributes
    ----------
    topics : dict
        Number → topic, from 1.
    channel, times : int64
        Topic and time (ns) of each message.

    Raises
    ------
    TraceError
        The file does not begin like such a bag.
    """

    def __init__(self, path: Path, lose: Callable[[str], None]) -> None:
        self.path = path
        self.topics: dict[int, Topic] = {}
        self._file = open_regular(path)
        self._places: list[tuple[int, int, int]] = []  # Chunk (-1: none), position, and length.
        self._chunk = lru_cache(maxsize=4)(self._read_chunk)
        try:
            told = np.array(self._index(lose), np.int64).reshape(-1, 2)
        except BaseException:
            self._file.close()
            raise
        self.channel, self.times = told[:, 0], told[:, 1]

    def _index(self, lose: Callable[[str], None]) -> list[tuple[int, int]]:
        """Find all topics and messages. Return topic and time of each message."""
        columns: list[tuple[int, int]] = []
        numbers: dict[int, int] = {}
        odd = 0
        if self._file.read(len(MAGIC)) != MAGIC:
            raise TraceError("it does not begin like a bag of ROS 1", path=self.path)
        for chunk, header, place, length in self._records(lose):
            conn = _whole(header.get("conn"))
            if header.get("op") == bytes([_CONNECTION]):
                if conn not in numbers and len(numbers) < MAX_TOPICS:
                    numbers[conn] = number = len(numbers) + 1
                    self.topics[number] = _topic(header, self._bytes(chunk, place, length))
                continue
            time = header.get("time", b"")
            if conn in numbers and len(time) == 8:
                sec, nsec = struct.unpack("<II", time)
                columns.append((numbers[conn], sec * 1_000_000_000 + nsec))
                self._places.append((chunk, place, length))
            else:
                odd += 1
        if odd:
            lose(f"{odd} messages without a connection or a time")
        return columns

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def data(self, number: int) -> bytes:
        """Return the bytes of a message in the encoding of ROS 1."""
        return self._bytes(*self._places[number])

    def _bytes(self, chunk: int, place: int, length: int) -> bytes:
        try:
            if chunk >= 0:
                data = self._chunk(chunk)[place : place + length]
            else:
                self._file.seek(place)
                data = self._file.read(length)
        except _FAULTS as error:
            raise TraceError(f"a chunk cannot be read: {error}"[:200], path=self.path) from error
        return data

    def _records(
        self, lose: Callable[[str], None]
    ) -> Iterator[tuple[int, dict[str, bytes], int, int]]:
        """Yield for each message and connection: chunk, header, position and length of the data."""
        for header, place, length in _records_of(self._file, lose):
            if header.get("op") != bytes([_CHUNK]):
                yield -1, header, place, length
                continue
            at = place - len(header["raw"]) - 8
            try:
                content = self._chunk(at)
            except _FAULTS as error:
                lose(f"a chunk of {length} bytes is damaged: {error}"[:200])
                continue
            for inner, start, size in _records_in(content, lose):
                yield at, inner, start, size
            self._file.seek(place + length)

    def _read_chunk(self, at: int) -> bytes:
        """Return the decompressed content of the chunk at a file position."""
        self._file.seek(at)
        header = _header(self._file)
        (length,) = _LENGTH.unpack(self._file.read(4))
        size = _whole(header.get("size"))
        if length > MAX_CHUNK or size > MAX_CHUNK:
            raise ValueError(f"more than {MAX_CHUNK:,} bytes")
        data = self._file.read(length)
        match header.get("compression"):
            case b"none":
                return data
            case b"bz2":
                return bz2.BZ2Decompressor().decompress(data, size)
            case b"lz4":
                return lz4.frame.LZ4FrameDecompressor().decompress(data, size)
            case other:
                raise ValueError(f"unknown compression {other!r}")


def _records_of(
    file: BufferedReader, lose: Callable[[str], None]
) -> Iterator[tuple[dict[str, bytes], int, int]]:
    """Yield for each record outside chunks: header, position and length."""
    file.seek(0, 2)
    end = file.tell()
    at = len(MAGIC)
    while at < end:
        file.seek(at)
        try:
            header = _header(file)
            (length,) = _LENGTH.unpack(file.read(4))
        except _FAULTS as error:
            lose(f"the file is damaged at byte {at}, and is read up to there: {error}"[:200])
            return
        place = file.tell()
        if place + length > end:
            lose("the file ends inside a record")
            return
        if header.get("op") in {bytes([_MESSAGE]), bytes([_CONNECTION]), bytes([_CHUNK])}:
            yield header, place, length
        at = place + length


def _records_in(
    content: bytes, lose: Callable[[str], None]
) -> Iterator[tuple[dict[str, bytes], int, int]]:
    """Yield for each record in a chunk: header, position and length."""
    at = 0
    while at < len(content):
        try:
            (length,) = _LENGTH.unpack_from(content, at)
            header = _fields(content[at + 4 : at + 4 + length], length)
            (size,) = _LENGTH.unpack_from(content, at + 4 + length)
        except _FAULTS as error:
            lose(f"a chunk is damaged, and is read up to there: {error}"[:200])
            return
        place = at + 8 + length
        if place + size > len(content):
            lose("a chunk ends inside a record")
            return
        if header.get("op") in {bytes([_MESSAGE]), bytes([_CONNECTION])}:
            yield header, place, size
        at = place + size


def _header(file: BufferedReader) -> dict[str, bytes]:
    (length,) = _LENGTH.unpack(file.read(4))
    if length > _MAX_HEADER:
        raise ValueError(f"a header of {length:,} bytes")
    return _fields(file.read(length), length)


def _fields(data: bytes, length: int) -> dict[str, bytes]:
    """Return the fields of a record header by name. Entry ``raw`` is the whole header."""
    if len(data) != length:
        raise ValueError("a header is cut off")
    told, at = {"raw": data}, 0
    while at < length:
        (size,) = _LENGTH.unpack_from(data, at)
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > length:
            raise ValueError("a field of a header is malformed")
        told[name.decode("utf-8", "replace")] = value
        at += 4 + size
    return told


def _whole(value: bytes | None) -> int:
    return int.from_bytes(value, "little") if value is not None and len(value) == 4 else -1


def _topic(header: dict[str, bytes], data: bytes) -> Topic:
    """Return the topic that a connection record describes."""
    try:
        told = _fields(data, len(data))
    except _FAULTS:
        told = {}
    name = told.get("topic") or header.get("topic", b"")
    texts = [
        part.decode("utf-8", "replace")
        for part in (name, told.get("type", b""), told.get("message_definition", b""))
    ]
    return Topic(texts[0], texts[1], "ros1msg" if texts[2] else "", texts[2], is_ros1=True)
