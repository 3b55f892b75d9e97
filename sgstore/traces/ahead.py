"""Chunks of a file that are decompressed by threads, before the walk comes to them.

Decompressing and checksums leave the interpreter to others, so a recording that is mostly pictures can be read
faster than one thread decompresses it. A thread is given some chunks at a time, for it waits whenever it comes
back to the interpreter. What is wrong with a chunk is told when its turn comes, in the words that reading it in
turn would have found.
"""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from mcap.opcode import Opcode

from sgstore.errors import TraceError
from sgstore.traces.buffers import Buffers
from sgstore.traces.chunks import HEAD, read_chunk_head, read_records, read_stored, records_of
from sgstore.traces.summary import MAGIC

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator
    from concurrent.futures import Future
    from io import BufferedReader

    from sgstore.traces.chunks import ChunkHead, Records

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
    """Whether a chunk is worth it."""
    compressed = bool(head.compression) and head.data_length < WORTH * head.size
    return compressed and _cost(head) <= LARGEST


def _processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
