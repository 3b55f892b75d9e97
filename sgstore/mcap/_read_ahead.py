"""Read-ahead: summary, buffers, and chunks that threads decompress.

Memory that is used again once nobody looks at it any more.

Fresh memory for every chunk would have to be handed out by the system page by page, and cleared; and what was
used a moment ago is nearer to the processor.
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
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

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
"""Memory of :class:`Buffers` that is kept to be used again, at most; bytes."""
MOST_BUFFERS: Final = 128
"""Pieces of that memory, at most."""


class Buffers:
    """Memory for the records of chunks. It belongs to one thread, whoever fills it."""

    def __init__(self) -> None:
        self._kept: list[bytearray] = []

    def take(self, size: int) -> memoryview:
        """Memory of ``size`` bytes, whatever is in it; until the last view of it is gone, nobody else's."""
        if not size:
            return memoryview(bytearray())
        for buffer in self._kept:
            if len(buffer) >= size and _is_free(buffer):
                return memoryview(buffer)[:size]
        self._kept = [one for one in self._kept if len(one) >= size or not _is_free(one)]
        grain = max(
            1 << max(size.bit_length() - 3, 0), 4096
        )  # chunks of a file differ a little in size
        buffer = bytearray(-(-size // grain) * grain)
        if len(self._kept) < MOST_BUFFERS and self.kept + len(buffer) <= MOST_BUFFERED:
            self._kept.append(buffer)
        return memoryview(buffer)[:size]

    @property
    def kept(self) -> int:
        """Size of all buffers that are kept; bytes."""
        return sum(map(len, self._kept))

    def clear(self) -> None:
        """Keep nothing. What somebody looks at stays as it is."""
        self._kept.clear()


def _is_free(buffer: bytearray) -> bool:
    """Return whether a buffer has no view: only then can its size be changed."""
    try:
        buffer.append(buffer.pop())
    except BufferError:
        return False
    return True


# The summary at the end of an MCAP file: a help to its reader, never an authority ---------------
# Source: MCAP specification, format version 0 (mcap.dev/spec).

MAGIC: Final = b"\x89MCAP0\r\n"
FOOTER: Final = struct.Struct("<BQQQI8s")
"""Opcode, length, start of the summary, start of its offsets, CRC-32, magic."""
MAX_SUMMARY: Final = 64 << 20
"""Greatest size of a summary that is read; bytes. A larger one is done without."""


@dataclass(slots=True)
class Summary:
    """Contents of the summary of a file; empty where there is none.

    Attributes
    ----------
    schemas, channels : dict
        Records by their id.
    counts : dict or None
        Channel id → number of messages.
    chunk_offsets : (n,) int64
        Where chunks begin, ascending.
    fault : str
        Why it was not used, or the empty string.
    """

    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    counts: dict[int, int] | None = None
    chunk_offsets: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    fault: str = ""


def read_summary(file: BinaryIO, size: int) -> Summary:
    """The summary of a file of ``size`` bytes; one that cannot be trusted says so in its ``fault``."""
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


# Messages that were decompressed once and will be asked for again -------------------------------
# A recording is read twice: who is in it must be known before its first frame can be told. Ground truth is a
# small part of a recording with cameras, but shares its chunks, so that a second reading would decompress all
# of it again. Instead, the first reading leaves here what the second one asks for: where all messages stand,
# and the bytes of those that matter. They are kept in memory up to :data:`IN_MEMORY` and then in a file
# without a name in the system's folder for temporary files; where that is full, or :data:`MOST_SPOOLED` is
# reached, the chunks that follow are decompressed again. What is kept was verified when it was read first.

IN_MEMORY: Final = 32 << 20
"""Bytes that are kept in memory."""
MOST_SPOOLED: Final = 1 << 30
"""Bytes that are kept at all: the ground truth of many hours."""

_COLUMNS: Final = 7


class Spool:
    """The messages of chunks, by file and place."""

    def __init__(self) -> None:
        self._file: SpooledTemporaryFile[bytes] | None = None
        self._places: dict[tuple[Path, int], tuple[int, int, int]] = {}
        self._size = 0
        self._most = MOST_SPOOLED

    def put(self, path: Path, messages: Messages, kept: NDArray[np.bool_]) -> None:
        """Keep where all messages of a chunk stand, and the data of some of them.

        Nothing is kept of a chunk that is known already, or for which there is no room.
        """
        key = (path, messages.chunk_offset)
        parts = [messages.data(row) for row in np.flatnonzero(kept).tolist()]
        lengths = np.where(kept, messages.length, 0)
        size = int(lengths.sum())
        total = 8 * _COLUMNS * len(messages) + size
        if key in self._places or self._size + total > self._most:
            return
        columns = np.stack(
            [
                messages.channel,
                messages.sequence,
                messages.log_time_ns,
                messages.publish_time_ns.view(np.int64),
                messages.offset,
                messages.length,
                np.where(kept, np.cumsum(lengths) - lengths, -1),
            ]
        )
        try:
            if self._file is None:
                self._file = SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115  (see close)
            self._file.seek(self._size)
            self._file.writelines([columns.data, *parts])
        except OSError:  # no room: what is not here is read from the recording
            self._most = 0
            return
        self._places[key] = self._size, len(messages), size
        self._size += total

    def has(self, path: Path, chunk_offset: int) -> bool:
        """Return whether the messages of a chunk are kept."""
        return (path, chunk_offset) in self._places

    def get(self, path: Path, chunk_offset: int, anew: Callable[[], Read]) -> Messages | None:
        """The messages of a chunk; ``None`` if they are not kept, or cannot be read any more.

        Parameters
        ----------
        path : Path
        chunk_offset : int
        anew : function
            Reads the chunk from the recording, for the data of a message that was not kept.
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
        columns: Any = np.frombuffer(told, np.int64).reshape(_COLUMNS, count)
        channel, sequence, log_time, publish_time, offset, length, at = columns
        return Messages(
            chunk_offset=chunk_offset,
            channel=channel,
            sequence=sequence,
            log_time_ns=log_time,
            publish_time_ns=publish_time.view(np.uint64),
            offset=offset,
            length=length,
            read=_reader(
                dict(zip(offset[at >= 0].tolist(), at[at >= 0].tolist(), strict=True)), data, anew
            ),
        )

    def close(self) -> None:
        """Forget everything."""
        self._places.clear()
        self._size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _reader(starts: dict[int, int], data: memoryview, anew: Callable[[], Read]) -> Read:
    """Bytes of messages by their place in the chunk. ``starts``: where each record is there → its data here."""
    whole: list[Read] = []

    def read(position: int, length: int) -> memoryview:
        start = starts.get(position - MESSAGE_HEAD.itemsize)
        if start is not None:
            return data[start : start + length]
        if not whole:
            whole.append(anew())
        return whole[0](position, length)

    return read


# Chunks of a file that are decompressed by threads, before the walk comes to them ---------------
# Decompressing and checksums leave the interpreter to others, so a recording that is mostly pictures can be
# read faster than one thread decompresses it. A thread is given some chunks at a time, for it waits whenever it
# comes back to the interpreter. What is wrong with a chunk is told when its turn comes, in the words that
# reading it in turn would have found.

THREADS: Final = 2
"""As many decompress beside the walk. One processor alone would gain nothing."""
BATCH: Final = 2 << 20
"""A thread is given chunks of about this size together; bytes."""
AHEAD: Final = 8 << 20
"""Chunks of about this size are begun before they are asked for; bytes."""
LARGEST: Final = 16 << 20
"""Chunks that are larger, stored or decompressed, wait for their turn; bytes."""

WORTH: Final = 0.9
"""A chunk waits for its turn that is stored in more than this share of its size: pictures in JPEG."""
LEAST: Final = 64 << 10
"""What a chunk counts however small it is; bytes."""
BETWEEN: Final = 1000
"""Records between two chunks: message indexes, one for each channel, are usual."""
_TRIED: Final = 256  # places of a batch: there need not be a chunk

Found = dict[int, "tuple[ChunkHead, Records | TraceError]"]
"""Byte offset of a chunk → its head, and its records or what is wrong with it."""


def chunks_in(file: BufferedReader) -> Iterator[int]:
    """Byte offsets of the chunks of a file whose summary does not tell, as far as its records lead.

    It ends where a chunk is followed by more than :data:`BETWEEN` records that are none.
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
    """The records of chunks, of which some are begun before they are asked for.

    Parameters
    ----------
    file : file
        Read by the thread that asks, and only while it asks.
    offsets : iterable of int
        Byte offsets of the chunks that will be asked for, ascending. None of them need be true.
    verified : container of int
        Byte offsets of chunks whose checksum need not be looked at.
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
        """The records of a chunk, which may be decompressed already.

        Raises
        ------
        TraceError
            The chunk is too large, cut, not what it declares, or damaged.
        """
        self._asked = head.offset
        self._begin()
        while self._begun and self._begun[0][0] <= head.offset:
            _, size, future = self._begun.popleft()
            self._size -= size
            self._begin()
            self._found = future.result()
        told, found = self._found.pop(head.offset, (None, b""))
        if told != head:  # not begun, or the file was changed meanwhile
            memory = self._buffers.take if _cost(head) <= LARGEST else None
            return read_records(self._file, head, verify=self._verifies(head), memory=memory)
        if isinstance(found, TraceError):
            raise found
        return found

    def close(self) -> None:
        """End the threads."""
        self._offsets = iter(())
        self._begun.clear()
        self._found = {}
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)
            self._threads = None
        self._buffers.clear()

    def _begin(self) -> None:
        """Begin as many chunks as may be ahead."""
        while self._size + BATCH <= AHEAD and (chunks := self._batch()):
            if self._threads is None:
                self._threads = ThreadPoolExecutor(THREADS, "sgstore-chunks")
            size = sum(_cost(chunk.head) for chunk in chunks)
            first = chunks[0].head.offset
            try:
                future = self._threads.submit(_decompressed, chunks)
            except RuntimeError:  # the system gives no more threads: all are read in turn
                self._offsets = iter(())
                return
            self._begun.append((first, size, future))
            self._size += size

    def _batch(self) -> list[_Chunk]:
        """The next chunks, as they are stored."""
        chunks: list[_Chunk] = []
        size = 0
        try:
            for offset in islice(self._offsets, _TRIED):
                if offset < self._asked:
                    continue
                with suppress(TraceError):  # it is told when its turn comes
                    head = read_chunk_head(self._file, offset)
                    if not _is_apt(head):
                        break
                    stored = read_stored(self._file, head, self._buffers.take)
                    into = self._buffers.take(head.size)
                    chunks.append(_Chunk(head, stored, into, self._verifies(head)))
                    size += _cost(head)
                    if size >= BATCH:
                        break
        except (OSError, OverflowError, ValueError):  # likewise, and nothing more is begun
            self._offsets = iter(())
        return chunks

    def _verifies(self, head: ChunkHead) -> bool:
        return head.offset not in self._verified


class _Chunk(NamedTuple):
    """A chunk as it is stored, memory for what it becomes, and whether its checksum is looked at."""

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
    """Return whether it is worth while to decompress a chunk ahead of its turn."""
    compressed = bool(head.compression) and head.data_length < WORTH * head.size
    return compressed and _cost(head) <= LARGEST


def _processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
