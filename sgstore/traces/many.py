"""Many messages of a recording by their places, each chunk decompressed once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcap.opcode import Opcode

from sgstore.errors import TraceError
from sgstore.traces import read_message
from sgstore.traces.chunks import (
    HEAD,
    MESSAGE_HEAD,
    READ_ERRORS,
    read_chunk_head,
    read_records,
)
from sgstore.traces.fetch import open_regular
from sgstore.traces.parts import bag_folder, part_at, parts_of
from sgstore.traces.summary import MAGIC

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from sgstore.traces.chunks import Records


def read_messages(
    path: Path, places: Iterable[tuple[int, int, int]]
) -> Iterator[bytes | memoryview]:
    """The data of messages, in the order in which they are asked for.

    Parameters
    ----------
    path : Path
        A recording: a file, or the folder of a bag.
    places : iterable of (chunk_offset, offset, length)
        As :class:`sgstore.world.MessageRefs` has them. Those of one chunk should come together: the last one
        alone is kept.

    Raises
    ------
    TraceError
        As :func:`sgstore.traces.read_message`.
    """
    folder = bag_folder(path)
    parts = None if folder is None else parts_of(folder)
    known, records = -1, memoryview(b"")
    for chunk_offset, offset, length in places:
        if chunk_offset < 0 or (parts is None and not _is_mcap(path)):
            yield read_message(path, chunk_offset=chunk_offset, offset=offset, length=length)
            continue
        if chunk_offset != known:
            part = None if parts is None else part_at(parts, chunk_offset)
            if parts is not None and part is None:
                reason = "no file of the bag is there: it was replaced"
                raise TraceError(reason, path=path, offset=chunk_offset)
            file, base = (path, 0) if part is None else (part.path, part.base)
            records, known = memoryview(_chunk(file, chunk_offset - base)), chunk_offset
        yield _message(path, chunk_offset, records, offset, length)


def _chunk(path: Path, offset: int) -> Records:
    with open_regular(path) as file:
        try:
            return read_records(file, read_chunk_head(file, offset))
        except TraceError as error:
            raise TraceError(error.reason, path=path, offset=offset) from error
        except READ_ERRORS as error:
            reason = "no chunk there: the file was replaced"
            raise TraceError(reason, path=path, offset=offset) from error


def _message(
    path: Path, chunk_offset: int, records: memoryview, offset: int, length: int
) -> memoryview:
    size = MESSAGE_HEAD.itemsize + length
    record = records[max(offset, 0) : max(offset, 0) + size]
    if len(record) == size and HEAD.unpack_from(record) == (Opcode.MESSAGE, size - HEAD.size):
        return record[MESSAGE_HEAD.itemsize :]
    reason = f"no message of {length} bytes at {offset} there: the file was replaced"
    raise TraceError(reason, path=path, offset=chunk_offset)


def _is_mcap(path: Path) -> bool:
    with open_regular(path) as file:
        return file.read(len(MAGIC)) == MAGIC
