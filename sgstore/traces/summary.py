"""The summary at the end of an MCAP file: a help to its reader, never an authority.

Source: MCAP specification, format version 0 (mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from sgstore.errors import TraceError
from sgstore.traces.chunks import HEAD, READ_ERRORS, StrictStream

if TYPE_CHECKING:
    from sgstore.world import Ints

MAGIC: Final = b"\x89MCAP0\r\n"
FOOTER: Final = struct.Struct("<BQQQI8s")
"""Opcode, length, start of the summary, start of its offsets, CRC-32, magic."""
MAX_SUMMARY: Final = 64 << 20
"""Greatest size of a summary that is read; bytes. A larger one is done without."""


@dataclass(slots=True)
class Summary:
    """What the summary of a file tells; empty where there is none.

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
