"""Memory that is used again once nobody looks at it any more.

Fresh memory for every chunk would have to be handed out by the system page by page, and cleared; and what was
used a moment ago is nearer to the processor.
"""

from __future__ import annotations

from typing import Final

MOST: Final = 48 << 20
"""Memory that is kept to be used again; bytes."""
MANY: Final = 128
"""Pieces of it."""


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
        if len(self._kept) < MANY and self.kept + len(buffer) <= MOST:
            self._kept.append(buffer)
        return memoryview(buffer)[:size]

    @property
    def kept(self) -> int:
        """How much is kept; bytes."""
        return sum(map(len, self._kept))

    def clear(self) -> None:
        """Keep nothing. What somebody looks at stays as it is."""
        self._kept.clear()


def _is_free(buffer: bytearray) -> bool:
    """Whether there is no view of it: only then can its size be changed."""
    try:
        buffer.append(buffer.pop())
    except BufferError:
        return False
    return True
