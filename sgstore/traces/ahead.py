"""The next chunk of a file, decompressed while the one before it is looked at.

Decompressing and checksums leave the interpreter to others, so a thread does them beside the walk: a recording
that is mostly pictures is then read about as fast as it can be decompressed. One chunk is ahead at a time, and
none that is large.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Final

from sgstore.errors import TraceError
from sgstore.traces.chunks import read_records, read_stored, records_of

if TYPE_CHECKING:
    from concurrent.futures import Future

    from sgstore.traces.chunks import ChunkHead

LARGEST: Final = 32 << 20
"""Chunks that are larger, stored or decompressed, wait for their turn; bytes."""


class ReadAhead:
    """The records of chunks, of which at most one is begun before it is asked for."""

    def __init__(self) -> None:
        self._threads: ThreadPoolExecutor | None = None
        self._begun: tuple[ChunkHead, bool, Future[bytes | bytearray]] | None = None

    def begin(self, file: BinaryIO, head: ChunkHead, *, verify: bool) -> None:
        """Begin with a chunk, instead of any other. What is wrong with it is told when it is asked for."""
        self._drop()
        if not head.compression or max(head.size, head.data_length) > LARGEST:
            return  # what is stored as it is costs no less beside the walk
        if self._threads is None:
            self._threads = ThreadPoolExecutor(1, "sgstore-chunks")
        with suppress(TraceError):
            stored = read_stored(file, head)
            future = self._threads.submit(records_of, stored, head, verify=verify)
            self._begun = head, verify, future

    def records(self, file: BinaryIO, head: ChunkHead, *, verify: bool) -> bytes | bytearray:
        """The records of a chunk: :func:`~sgstore.traces.chunks.read_records`, which may be done already.

        Raises
        ------
        TraceError
            The chunk is too large, cut, not what it declares, or damaged.
        """
        if self._begun is None or self._begun[:2] != (head, verify):
            return read_records(file, head, verify=verify)
        (_, _, future), self._begun = self._begun, None
        return future.result()

    def close(self) -> None:
        """End the thread."""
        self._drop()
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun[2].cancel()
            self._begun = None
