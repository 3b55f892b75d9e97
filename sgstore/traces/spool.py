"""Messages that were decompressed once and will be asked for again.

A recording is read twice: who is in it must be known before its first frame can be told. Ground truth is a
small part of a recording with cameras, but shares its chunks, so that a second reading would decompress all of
it again. Instead, the first reading leaves here what the second one asks for: where all messages stand, and
the bytes of those that matter. They are kept in memory up to :data:`IN_MEMORY` and then in a file without a
name in the system's folder for temporary files; where that is full, or :data:`MOST` is reached, the chunks that
follow are decompressed again. What is kept was verified when it was read first.
"""

from __future__ import annotations

from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.traces.chunks import MESSAGE_HEAD, Messages

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.world import Bools

    Read = Callable[[int, int], memoryview]

IN_MEMORY: Final = 32 << 20
"""Bytes that are kept in memory."""
MOST: Final = 1 << 30
"""Bytes that are kept at all: the ground truth of many hours."""

_COLUMNS: Final = 7


class Spool:
    """The messages of chunks, by file and place."""

    def __init__(self) -> None:
        self._file: SpooledTemporaryFile[bytes] | None = None
        self._places: dict[tuple[Path, int], tuple[int, int, int]] = {}
        self._size = 0
        self._most = MOST

    def put(self, path: Path, messages: Messages, kept: Bools) -> None:
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
        """Whether the messages of a chunk are kept."""
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
