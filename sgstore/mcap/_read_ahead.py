"""Read MCAP chunks in advance: file summary, reused memory buffers, and decompression in threads.

Buffers are reused after their last view is gone. Fresh memory for every chunk would be slower: the system must
map and clear each page, and recently used memory is in the processor cache.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from sgstore.errors import TraceError
from sgstore.mcap._chunks import (
    HEAD,
    MESSAGE_HEAD,
    READ_ERRORS,
    Messages,
    StrictStream,
    read_chunk_head,
    read_records,
    read_stored,
    records_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator
    from concurrent.futures import Future
    from io import BufferedReader
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.mcap._chunks import ChunkHead, Records

    Ints = NDArray[np.int64]
    Read = Callable[[int, int], memoryview]


MOST_BUFFERED: Final = 48 << 20
"""Maximum total size of the buffers that are kept for reuse; bytes."""
MOST_BUFFERS: Final = 128
"""Maximum number of buffers that are kept for reuse."""


class Buffers:
    """Memory buffers for decompressed chunks. Later chunks reuse them.

    One thread owns the buffers; other threads may fill them.
    """

    def __init__(self) -> None:
        self._kept: list[bytearray] = []

    def take(self, size: int) -> memoryview:
        """Return memory of ``size`` bytes with undefined content. It is reused when no view of it is left."""
        if not size:
            return memoryview(bytearray())
        for buffer in self._kept:
            if len(buffer) >= size and _is_free(buffer):
                return memoryview(buffer)[:size]
        self._kept = [one for one in self._kept if len(one) >= size or not _is_free(one)]
        # Chunks of a file differ slightly in size.
        grain = max(1 << max(size.bit_length() - 3, 0), 4096)
        buffer = bytearray(-(-size // grain) * grain)
        if len(self._kept) < MOST_BUFFERS and self.kept + len(buffer) <= MOST_BUFFERED:
            self._kept.append(buffer)
        return memoryview(buffer)[:size]

    @property
    def kept(self) -> int:
        """Total size of all memory buffers; bytes."""
        return sum(map(len, self._kept))

    def clear(self) -> None:
        """Drop all memory buffers. Memory with existing views stays valid."""
        self._kept.clear()


def _is_free(buffer: bytearray) -> bool:
    """Return True if no view of a memory buffer exists. Only then can its size change."""
    try:
        buffer.append(buffer.pop())
    except BufferError:
        return False
    return True


# Summary at the end of an MCAP file: optional and not trusted.
# Source: MCAP specification, format version 0 (mcap.dev/spec).

MAGIC: Final = b"\x89MCAP0\r\n"
FOOTER: Final = struct.Struct("<BQQQI8s")
"""Format of the end of a file: opcode, length, start of the summary, start of its offsets, CRC-32, magic."""
MAX_SUMMARY: Final = 64 << 20
"""Maximum size of a summary; bytes. A larger summary is ignored."""


@dataclass(slots=True)
class Summary:
    """Summary section of an MCAP file: schemas, channels, and a list of chunks. Empty without a summary.

    Attributes
    ----------
    schemas, channels : dict
        Records by their id.
    counts : dict or None
        Number of messages by channel id.
    chunk_offsets : (n,) int64
        Byte offsets of the chunks, ascending.
    fault : str
        Reason why it was not used; empty if it was.
    """

    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    counts: dict[int, int] | None = None
    chunk_offsets: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    fault: str = ""


def read_summary(file: BinaryIO, size: int) -> Summary:
    """Read the summary section of an MCAP file. An invalid summary has the attribute ``fault``."""
    try:
        return _parsed(_content(file, size))
    except READ_ERRORS as error:
        return Summary(fault=f"the summary at the end of the file is malformed: {error!r}")
    except TraceError as error:
        return Summary(fault=f"the summary at the end of the file was not used: {error.reason}")


def _content(file: BinaryIO, size: int) -> bytes:
    stop = size - FOOTER.size
    if stop <= len(MAGIC):
        raise TraceError("the file does not end with a footer")
    file.seek(stop)
    tail = file.read(FOOTER.size)
    opcode, length, start, _offsets, crc, magic = FOOTER.unpack(tail)
    if magic != MAGIC or opcode != Opcode.FOOTER or length != FOOTER.size - HEAD.size - len(MAGIC):
        raise TraceError("the file does not end with a footer")
    if start == 0:
        return b""
    if not len(MAGIC) < start <= stop or stop - start > MAX_SUMMARY:
        raise TraceError(f"it claims the bytes from {start} to {stop} of {size}")
    file.seek(start)
    content = file.read(stop - start)
    if crc and zlib.crc32(tail[: HEAD.size + 16], zlib.crc32(content)) != crc:
        raise TraceError("it does not match its checksum")
    return content


def _parsed(content: bytes) -> Summary:
    summary = Summary()
    chunks = array("q")
    position = 0
    while position + HEAD.size <= len(content):
        opcode, length = HEAD.unpack_from(content, position)
        start, stop = position + HEAD.size, position + HEAD.size + length
        if stop > len(content):
            raise TraceError("a record in it does not fit")
        match opcode:
            case Opcode.SCHEMA:
                schema = Schema.read(StrictStream(content[start:stop]))
                summary.schemas.setdefault(schema.id, schema)
            case Opcode.CHANNEL:
                channel = Channel.read(StrictStream(content[start:stop]))
                summary.channels.setdefault(channel.id, channel)
            case Opcode.STATISTICS:
                statistics = Statistics.read(StrictStream(content[start:stop]))
                summary.counts = dict(statistics.channel_message_counts)
            case Opcode.CHUNK_INDEX:
                chunks.append(struct.unpack_from("<Q", content, start + 16)[0])
            case _:
                pass
        position = stop
    summary.chunk_offsets = np.unique(np.frombuffer(chunks, np.int64))
    return summary


# Cache of decompressed messages for a second reading. A recording is read twice, because its entities must be
# known before the first frame. Ground truth is a small part of a recording with cameras, but it shares its
# chunks. Without a cache, the second reading would decompress everything again. The first reading therefore
# caches the positions of all messages, and the bytes of the needed ones. The cache uses memory up to
# :data:`IN_MEMORY`, and then an unnamed temporary file. When the disk is full or :data:`MOST_SPOOLED` is
# reached, later chunks are decompressed again. Cached data were verified by the first reading.

IN_MEMORY: Final = 32 << 20
"""Maximum size of the cache in memory; bytes. A larger cache is on disk."""
MOST_SPOOLED: Final = 1 << 30
"""Maximum size of the cache; bytes. It is enough for the ground truth of many hours."""

_COLUMNS: Final = 7


class Spool:
    """Cache on disk for the messages of MCAP chunks. The key is the file and the chunk's offset."""

    def __init__(self) -> None:
        self._file: SpooledTemporaryFile[bytes] | None = None
        self._places: dict[tuple[Path, int], tuple[int, int, int]] = {}
        self._size = 0
        self._most = MOST_SPOOLED

    def put(self, path: Path, messages: Messages, kept: NDArray[np.bool_]) -> None:
        """Add the messages of a chunk to the cache: the positions of all of them, and the data of some.

        A chunk that is already cached is skipped, as is any chunk when the cache is full.
        """
        key = (path, messages.chunk_offset)
        parts = [messages.data(row) for row in np.flatnonzero(kept).tolist()]
        lengths = np.where(kept, messages.length, 0)
        size = int(lengths.sum())
        total = 8 * _COLUMNS * len(messages) + size
        if key in self._places or self._size + total > self._most:
            return
        starts = np.where(kept, np.cumsum(lengths) - lengths, -1)
        columns = np.vstack([messages.stacked(), starts])
        try:
            if self._file is None:
                self._file = SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115  (see close)
            self._file.seek(self._size)
            self._file.writelines([columns.data, *parts])
        except OSError:  # The disk is full; the data are read from the recording again.
            self._most = 0
            return
        self._places[key] = self._size, len(messages), size
        self._size += total

    def has(self, path: Path, chunk_offset: int) -> bool:
        """Return True if the messages of a chunk are in the cache of messages."""
        return (path, chunk_offset) in self._places

    def get(self, path: Path, chunk_offset: int, anew: Callable[[], Read]) -> Messages | None:
        """Return the messages of a chunk from the cache; ``None`` if they are not there, or unreadable.

        Parameters
        ----------
        path : Path
        chunk_offset : int
        anew : function
            Reads the chunk from the recording, for messages whose data are not cached.
        """
        place = self._places.get((path, chunk_offset))
        if place is None or self._file is None:
            return None
        start, count, size = place
        try:
            self._file.seek(start)
            told = self._file.read(8 * _COLUMNS * count)
            data = memoryview(self._file.read(size))
        except OSError:
            return None
        if len(told) != 8 * _COLUMNS * count or len(data) != size:
            return None
        stacked = np.frombuffer(told, np.int64).reshape(_COLUMNS, count)
        columns, at = Messages.unstacked(stacked[:-1]), stacked[-1]
        held = at >= 0
        starts = dict(zip(columns["offset"][held].tolist(), at[held].tolist(), strict=True))
        return Messages(chunk_offset=chunk_offset, read=_reader(starts, data, anew), **columns)

    def close(self) -> None:
        """Clear the cache of messages, and delete its file."""
        self._places.clear()
        self._size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _reader(starts: dict[int, int], data: memoryview, anew: Callable[[], Read]) -> Read:
    """Return a function that reads the data of a cached message at a byte position.

    ``starts`` maps record offsets to offsets in ``data``.
    """
    whole: list[Read] = []

    def read(position: int, length: int) -> memoryview:
        start = starts.get(position - MESSAGE_HEAD.itemsize)
        if start is not None:
            return data[start : start + length]
        if not whole:
            whole.append(anew())
        return whole[0](position, length)

    return read


# Decompression of chunks by threads, before the walk needs them.
# Decompression and checksums release the interpreter lock. Threads therefore speed up recordings with many
# pictures. A thread gets several chunks at a time, because it waits for the lock after each call. A fault of a
# chunk is reported at its turn, with the same message as without threads.

THREADS: Final = 2
"""Number of threads for decompression. Threads have no advantage on a single processor."""
BATCH: Final = 2 << 20
"""Approximate size of the chunks that one task decompresses together; bytes."""
AHEAD: Final = 8 << 20
"""Approximate size of the chunks that are decompressed in advance; bytes."""
LARGEST: Final = 16 << 20
"""Maximum size of a chunk (compressed or not) that is decompressed in advance; bytes."""

WORTH: Final = 0.9
"""Largest ratio of compressed to original size for read-ahead. JPEG pictures exceed it."""
LEAST: Final = 64 << 10
"""Smallest size that a chunk counts for in these limits; bytes."""
BETWEEN: Final = 1000
"""Maximum number of records between two chunks. Usually, there is one message index for each channel."""
_TRIED: Final = 256  # offsets tested per batch; some may not be chunks

Found = dict[int, "tuple[ChunkHead, Records | TraceError]"]
"""Byte offset of a chunk → its header, and its records or the error."""


def chunks_in(file: BufferedReader) -> Iterator[int]:
    """Yield the byte offset of each chunk of an MCAP file without a usable summary section.

    The search stops after more than :data:`BETWEEN` other records in a row.
    """
    position, others = len(MAGIC), 0
    while others <= BETWEEN:
        file.seek(position)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack(head)
        if opcode == Opcode.CHUNK:
            yield position
        others = 0 if opcode == Opcode.CHUNK else others + 1
        position += HEAD.size + length


class ReadAhead:
    """Reader of MCAP chunks. While one chunk is used, other threads decompress the next ones.

    Parameters
    ----------
    file : file
        Read only during calls, on the thread of the caller.
    offsets : iterable of int
        Expected byte offsets of the next chunks, ascending. They may be wrong.
    verified : container of int
        Byte offsets of chunks with a verified checksum.
    """

    def __init__(
        self, file: BufferedReader, offsets: Iterable[int] = (), verified: Container[int] = ()
    ) -> None:
        self._file = file
        self._offsets = iter(offsets if _processors() > 1 else ())
        self._verified = verified
        self._buffers = Buffers()
        self._threads: ThreadPoolExecutor | None = None
        self._begun: deque[tuple[int, int, Future[Found]]] = deque()  # first offset, size
        self._size = self._asked = 0
        self._found: Found = {}

    def records(self, head: ChunkHead) -> Records:
        """Return the decompressed records of a chunk.

        Raises
        ------
        TraceError
            The chunk is too large, truncated or damaged, or does not match its head.
        """
        self._asked = head.offset
        self._begin()
        while self._begun and self._begun[0][0] <= head.offset:
            _, size, future = self._begun.popleft()
            self._size -= size
            self._begin()
            self._found = future.result()
        told, found = self._found.pop(head.offset, (None, b""))
        if told != head:  # Not started, or the file has changed.
            memory = self._buffers.take if _cost(head) <= LARGEST else None
            return read_records(self._file, head, verify=self._verifies(head), memory=memory)
        if isinstance(found, TraceError):
            raise found
        return found

    def close(self) -> None:
        """Stop the threads, and free the memory buffers."""
        self._offsets = iter(())
        self._begun.clear()
        self._found = {}
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)
            self._threads = None
        self._buffers.clear()

    def _begin(self) -> None:
        """Start to decompress the next chunks in other threads, up to a size limit."""
        while self._size + BATCH <= AHEAD and (chunks := self._batch()):
            if self._threads is None:
                self._threads = ThreadPoolExecutor(THREADS, "sgstore-chunks")
            size = sum(_cost(chunk.head) for chunk in chunks)
            first = chunks[0].head.offset
            try:
                future = self._threads.submit(_decompressed, chunks)
            except RuntimeError:  # No thread is available; chunks are read at their turn.
                self._offsets = iter(())
                return
            self._begun.append((first, size, future))
            self._size += size

    def _batch(self) -> list[_Chunk]:
        """Return the next chunks of the file that are worth a thread, still compressed."""
        chunks: list[_Chunk] = []
        size = 0
        try:
            for offset in islice(self._offsets, _TRIED):
                if offset < self._asked:
                    continue
                with suppress(TraceError):  # The error is reported at its turn.
                    head = read_chunk_head(self._file, offset)
                    if not _is_apt(head):
                        break
                    stored = read_stored(self._file, head, self._buffers.take)
                    into = self._buffers.take(head.size)
                    chunks.append(_Chunk(head, stored, into, self._verifies(head)))
                    size += _cost(head)
                    if size >= BATCH:
                        break
        except (OSError, OverflowError, ValueError):  # The same; the read-ahead stops.
            self._offsets = iter(())
        return chunks

    def _verifies(self, head: ChunkHead) -> bool:
        return head.offset not in self._verified


class _Chunk(NamedTuple):
    """Compressed chunk of a file, and the memory into which it is decompressed."""

    head: ChunkHead
    stored: Records
    into: memoryview
    verify: bool

    def records(self) -> Records | TraceError:
        try:
            return records_of(self.stored, self.head, verify=self.verify, into=self.into)
        except TraceError as error:
            return error


def _decompressed(chunks: list[_Chunk]) -> Found:
    return {chunk.head.offset: (chunk.head, chunk.records()) for chunk in chunks}


def _cost(head: ChunkHead) -> int:
    return max(head.size, head.data_length, LEAST)


def _is_apt(head: ChunkHead) -> bool:
    """Return True if it saves time to decompress a chunk in another thread."""
    compressed = bool(head.compression) and head.data_length < WORTH * head.size
    return compressed and _cost(head) <= LARGEST


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
