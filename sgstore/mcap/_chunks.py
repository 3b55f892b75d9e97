"""Chunks (compressed blocks of messages) of MCAP files: reading and decompression, with limits."""

from __future__ import annotations

import struct
from array import array
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BytesIO
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, Self

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from sgstore.errors import TraceError
from sgstore.mcap._findings import Loss

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from io import BufferedReader
    from pathlib import Path

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.mcap._findings import Findings

    Ints = NDArray[np.int64]
    Memory = Callable[[int], memoryview]

# Protocol of message containers for the readers: channels, and a walk over messages.


class Recording(Protocol):
    """Interface of an open log of messages: an MCAP file, or a file of another format.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    mtime_ns : int
        Modification time; ns.
    has_log_times : bool
        True if messages have log times, in addition to the times in their data.
    """

    path: Path
    size: int
    mtime_ns: int
    has_log_times: bool

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Message schemas of the recording: schema id → schema."""
        ...

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Channels of the recording: channel id → channel."""
        ...

    @property
    def counts(self) -> Mapping[int, int] | None:
        """Number of messages by channel id, as declared in the recording."""
        ...

    @property
    def window(self) -> tuple[int, int]:
        """First and last log time of the messages that can become frames, both included; ns."""
        ...

    def walk(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
        rank: Callable[[int], int] | None = None,
    ) -> Iterator[Messages]:
        """Yield all messages of the recording, in groups of consecutive messages.

        Unreadable parts are added to ``report``.

        ``wanted``: true for the offset of a chunk to read. ``keep``: true for a channel whose messages a later
        walk needs again. ``rank``: order number of a channel. With it, messages come in order of time; messages
        of equal time come in the order of the ranks. Without it, they come in file order. A file without log
        times has its own order.

        Raises
        ------
        OutOfOrder
            With ``rank``: the messages so far are not in order. The next walk sorts them.
        """
        ...

    def settle_order(self, rank: Callable[[int], int]) -> None:
        """Check once that all messages are sorted by time. If not, later calls of ``walk`` sort them."""
        ...

    def close(self) -> None:
        """Close the file of the recording."""
        ...


LAST_NS: Final = (1 << 63) - 1
"""Largest time in signed 64 bits, in the year 2262; ns."""


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """Position of a record in an MCAP file: byte offset and length."""

    offset: int
    length: int


def loss_of_chunk(reason: str, place: RecordPlace, head: ChunkHead | None) -> Loss:
    """Return a report entry for an unreadable chunk of an MCAP file, with its time span if known."""
    known = head is not None and head.start_ns <= head.end_ns <= LAST_NS
    return Loss(
        reason,
        bytes=place.length,
        start_ns=head.start_ns if head and known else -1,
        end_ns=head.end_ns if head and known else -1,
        offset=place.offset,
    )


def name_of(opcode: int) -> str:
    """Return the readable name of an MCAP record type."""
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return f"opcode {opcode}"


# Chunks of an MCAP file, decompressed with limits, and their messages as columns.
# A chunk is untrusted input. Both sizes in its header may be wrong, and 65 kB can become 2 GB. Therefore, the
# declared sizes are checked against a limit before the decompression, the result is checked against the
# declared size, a dictionary window larger than necessary is rejected, and the last record must end at the end
# of the chunk. A chunk that fails is rejected as a whole with a :class:`TraceError` that contains the offset.
# The walk over the file (:mod:`sgstore.mcap._reader`) reports it as a loss and continues.
#
# Source: MCAP specification, format version 0 (mcap.dev/spec).

try:
    from isal.isal_zlib import crc32
except ImportError:  # The extra [fast] computes the same checksums ten times faster.
    from zlib import crc32


MAX_CHUNK: Final = 256 << 20
"""Maximum size of a chunk (compressed or not), and of a message outside chunks; bytes."""

MAX_RECORDS: Final = 2_000_000
"""Maximum number of records in a chunk. It equals more than 60 MB of the smallest messages."""

IDS: Final = 1 << 16
"""Maximum number of channel ids, and of schema ids, in a file; an id has 16 bits."""

MIN_WINDOW: Final = 32 << 20
"""Window size up to which a zstd frame is always accepted; bytes. A larger window must not exceed the chunk."""

READ_ERRORS: Final = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # raised by lz4.frame
    ValueError,  # includes UnicodeDecodeError
    KeyError,
    IndexError,
    OverflowError,
    EOFError,
    MemoryError,
    OSError,
)
"""Exceptions that parsers and decompressors raise for malformed bytes."""

Records = bytes | bytearray | memoryview
"""Decompressed bytes of all records in a chunk."""

HEAD: Final = struct.Struct("<BQ")
"""Header of every record: opcode and length of the content."""

MESSAGE_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""Header of a message record: 31 bytes, followed by the data."""

CHUNK_FIELDS: Final = struct.Struct("<QQQI")
_PIECE: Final = 1 << 20
_LZ4_PIECE: Final = 16 << 20  # The decompressor copies the remaining input for every piece.
_MESSAGE: Final = int(Opcode.MESSAGE)
MESSAGE_FIELDS: Final = MESSAGE_HEAD.itemsize - HEAD.size
"""Number of bytes in a message record between the record header and the data."""
_DEFINITIONS: Final = frozenset({int(Opcode.SCHEMA), int(Opcode.CHANNEL)})


class StrictStream(ReadDataStream):
    """Stream for the MCAP parser that raises an error for a truncated text or number."""

    def __init__(self, record: bytes | memoryview) -> None:
        super().__init__(BytesIO(record))

    def read(self, length: int) -> bytes:
        """Return exactly ``length`` bytes. Raise an error if fewer are available."""
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


@dataclass(frozen=True, slots=True)
class Messages:
    """Consecutive messages of an MCAP file as columns, either of one chunk or outside chunks.

    Attributes
    ----------
    chunk_offset : int
        Byte offset of the chunk record in the file, -1 outside chunks.
    channel, sequence : int64
        Channel id in the file; sequence number.
    log_time_ns : int64
    publish_time_ns : uint64
    offset : int64
        Byte offset of the record in the uncompressed chunk, or in the file.
    length : int64
        Bytes of the message's data.
    read : callable
        ``read(position, length)``: bytes of one message, at a position that counts like ``offset``.
    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        "channel",
        "sequence",
        "log_time_ns",
        "publish_time_ns",
        "offset",
        "length",
    )

    chunk_offset: int
    channel: Ints
    sequence: Ints
    log_time_ns: Ints
    publish_time_ns: np.ndarray[tuple[int], np.dtype[np.uint64]]
    offset: Ints
    length: Ints
    read: Callable[[int, int], memoryview]

    def __len__(self) -> int:
        return len(self.channel)

    @property
    def chunks(self) -> Ints:
        """Byte offset of the chunk of each message; -1 outside chunks."""
        return np.full(len(self), self.chunk_offset)

    def chunk_of(self, row: int) -> int:
        """Return the byte offset of the chunk of one message; -1 outside chunks."""
        del row
        return self.chunk_offset

    def data(self, row: int) -> memoryview:
        """Return the bytes of one message of the group."""
        return self.read(int(self.offset[row]) + MESSAGE_HEAD.itemsize, int(self.length[row]))

    def stacked(self) -> Ints:
        """Return the columns named in :attr:`COLUMNS`, as the rows of one array."""
        return np.stack([getattr(self, name).view(np.int64) for name in Messages.COLUMNS])

    @staticmethod
    def unstacked(columns: Ints) -> dict[str, Any]:
        """Convert an array of :meth:`stacked` back to the columns of messages, by name."""
        named: dict[str, Any] = dict(zip(Messages.COLUMNS, columns, strict=True))
        return named | {"publish_time_ns": named["publish_time_ns"].view(np.uint64)}

    def span(self, start: int, stop: int) -> Self:
        """Return the messages from row ``start`` up to row ``stop``, exclusive."""
        return self.take(slice(start, stop))

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the messages with the given row numbers."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.COLUMNS})


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Header fields of a chunk (compressed block of messages) in an MCAP file.

    Attributes
    ----------
    offset : int
        Byte offset of the record in the file.
    start_ns, end_ns : int
        Minimum and maximum log time of its messages.
    size, crc : int
        Size and CRC-32 of the uncompressed records; a CRC of 0 means no checksum.
    compression : str
        ``zstd``, ``lz4``, or empty.
    data_offset, data_length : int
        Byte offset of the stored records in the file, and their number of bytes.
    """

    offset: int
    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int
    data_length: int


def read_chunk_head(file: BufferedReader, offset: int) -> ChunkHead:
    """Read the header of the chunk at a byte offset of an MCAP file.

    Raises
    ------
    TraceError
        The record is not a chunk, or its head contradicts itself.
    """
    file.seek(offset)
    try:
        opcode, length = HEAD.unpack(file.read(HEAD.size))
        start, end, size, crc = CHUNK_FIELDS.unpack(file.read(CHUNK_FIELDS.size))
        (name_length,) = struct.unpack("<I", file.read(4))
        if opcode != Opcode.CHUNK or name_length > 64:
            raise TraceError("expected a chunk record", offset=offset)
        compression = file.read(name_length).decode()
        (data_length,) = struct.unpack("<Q", file.read(8))
    except (struct.error, UnicodeDecodeError) as error:
        raise TraceError("the head of this chunk is cut or malformed", offset=offset) from error
    head_length = CHUNK_FIELDS.size + 4 + name_length + 8
    if head_length + data_length != length:
        reason = f"the chunk record is {length} bytes long but its parts take {head_length + data_length}"
        raise TraceError(reason, offset=offset)
    data_offset = offset + HEAD.size + head_length
    return ChunkHead(offset, start, end, size, crc, compression, data_offset, data_length)


def head_of_cut_chunk(rest: bytes, offset: int) -> tuple[ChunkHead, bytes] | None:
    """Return the header of a truncated chunk, and the available part of its compressed data.

    ``rest``: the bytes from the offset on. ``None`` means that the head itself is truncated.
    """
    try:
        begin, end, size, crc = CHUNK_FIELDS.unpack_from(rest, HEAD.size)
        at = HEAD.size + CHUNK_FIELDS.size
        (length,) = struct.unpack_from("<I", rest, at)
        compression = rest[at + 4 : at + 4 + length].decode()
        at += 4 + length + 8
    except (struct.error, UnicodeDecodeError):
        return None
    return ChunkHead(offset, begin, end, size, crc, compression, offset + at, 0), rest[at:]


def read_records(
    file: BufferedReader, head: ChunkHead, *, verify: bool = True, memory: Memory | None = None
) -> Records:
    """Read and decompress a chunk of an MCAP file, and verify its checksum.

    Parameters
    ----------
    file : file
    head : ChunkHead
    verify : bool
        False skips the checksum.
    memory : callable, optional
        Returns memory of a given size, for the stored and the decompressed bytes.

    Raises
    ------
    TraceError
        The chunk is too large, truncated or damaged, or does not match its head.
    """
    stored = read_stored(file, head, memory)
    into = memory(head.size) if memory and head.compression else None
    return records_of(stored, head, verify=verify, into=into)


def read_stored(file: BufferedReader, head: ChunkHead, memory: Memory | None = None) -> Records:
    """Read the compressed bytes of a chunk from an MCAP file.

    Raises
    ------
    TraceError
        The chunk is too large or truncated.
    """
    if head.size > MAX_CHUNK or head.data_length > MAX_CHUNK:
        largest = max(head.size, head.data_length)
        reason = f"the chunk declares {largest} bytes; at most {MAX_CHUNK} are read"
        raise TraceError(reason, offset=head.offset)
    file.seek(head.data_offset)
    if memory is None:
        stored = file.read(head.data_length)
    else:
        whole = memory(head.data_length)
        stored = whole[: file.readinto(whole)]
    if len(stored) != head.data_length:
        raise TraceError("the file ends inside this chunk", offset=head.offset)
    return stored


def records_of(
    stored: Records, head: ChunkHead, *, verify: bool = True, into: memoryview | None = None
) -> Records:
    """Decompress the bytes of a chunk, and verify the checksum.

    ``into``: optional memory of the chunk's size for the result.

    Raises
    ------
    TraceError
        The chunk is damaged or does not match its head.
    """
    try:
        records = decompress(stored, head.compression, head.size, into)
    except TraceError as error:
        raise TraceError(error.reason, offset=head.offset) from error
    if verify and head.crc and crc32(records) != head.crc:
        reason = "the chunk does not match its checksum"
        raise TraceError(reason, offset=head.offset)
    return records


def decompress(
    stored: Records, compression: str, size: int, into: memoryview | None = None
) -> Records:
    """Decompress a chunk into exactly ``size`` bytes. Memory use never exceeds ``size``.

    ``into``: optional memory of that size for the result.

    Raises
    ------
    TraceError
        The result has another size, the data are damaged, or the compression is unknown.
    """
    if compression not in _DECOMPRESS:
        raise TraceError(f"the compression {compression!r} is not known; known: zstd, lz4, none")
    try:
        records = _DECOMPRESS[compression](stored, size, into)
    except READ_ERRORS as error:
        reason = f"the chunk cannot be decompressed ({compression}): {error}"
        raise TraceError(reason) from error
    if len(records) != size:
        many = "more" if len(records) > size else f"only {len(records)}"
        raise TraceError(f"the chunk declares {size} bytes but holds {many}")
    return records


def decompress_head(stored: bytes, compression: str, size: int) -> bytes:
    """Decompress the beginning of a truncated chunk, at most ``size`` bytes; empty if impossible."""
    pieces: list[bytes] = []
    left = size
    with suppress(*READ_ERRORS):  # The error at the missing end; the earlier bytes are valid.
        if compression == "zstd":
            reader = _zstd(size).stream_reader(stored, read_across_frames=True)
            while left > 0 and (piece := reader.read(min(left, 1 << 16))):
                pieces.append(piece)
                left -= len(piece)
        elif compression == "lz4":
            decompressor = lz4.frame.LZ4FrameDecompressor()
            for start in range(0, len(stored), 1 << 12):
                piece = decompressor.decompress(stored[start : start + (1 << 12)], max_length=left)
                pieces.append(piece)
                left -= len(piece)
        elif not compression:
            pieces.append(stored)
    return b"".join(pieces)[:size]


def _zstd(size: int) -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor(max_window_size=max(size, MIN_WINDOW))


def _from_zstd(stored: Records, size: int, into: memoryview | None) -> Records:
    declared = zstandard.get_frame_parameters(stored).content_size
    if declared == size and into is not None:
        with _zstd(size).stream_reader(stored) as reader:
            return into[: reader.readinto(into)]
    if declared == size:
        return _zstd(size).decompress(stored)
    if declared != zstandard.CONTENTSIZE_UNKNOWN and declared > size:
        # A one-shot decompressor would first allocate the declared size.
        raise TraceError(f"the chunk declares {size} bytes, the zstd frame in it {declared}")
    records = bytearray()
    with _zstd(size).stream_reader(stored, read_across_frames=True) as reader:
        while piece := reader.read(min(_PIECE, size + 1 - len(records))):
            records += piece
    return records


def _from_lz4(stored: Records, size: int, _into: memoryview | None) -> Records:
    records = bytearray()
    while stored and len(records) <= size:
        decompressor = lz4.frame.LZ4FrameDecompressor()
        piece = decompressor.decompress(stored, max_length=_lz4_piece(records, size))
        while piece:
            records += piece
            if decompressor.eof or len(records) > size:
                break
            piece = decompressor.decompress(b"", max_length=_lz4_piece(records, size))
        if not decompressor.eof:
            break  # The output is too long, or the input is truncated.
        stored = bytes(decompressor.unused_data or b"")
    return records


def _lz4_piece(records: bytearray, size: int) -> int:
    return min(_LZ4_PIECE, size + 1 - len(records))


_DECOMPRESS: Final[dict[str, Callable[[Records, int, memoryview | None], Records]]] = {
    "zstd": _from_zstd,
    "lz4": _from_lz4,
    "": lambda stored, _size, _into: stored,
}


def parse_records(
    records: Records, chunk_offset: int, *, whole: bool = True
) -> tuple[Messages, list[tuple[int, memoryview]]]:
    """Parse a decompressed chunk. Return its messages as columns, and its schemas and channels.

    Parameters
    ----------
    records : bytes-like
    chunk_offset : int
        Byte offset of the chunk in the file.
    whole : bool
        True if the last record must be complete. Otherwise, an incomplete last record is skipped.

    Returns
    -------
    messages : Messages
    definitions : list of tuple
        Opcode and content of every schema and channel record, in order.

    Raises
    ------
    TraceError
        A record does not fit, or there are too many.
    """
    offsets, definitions, end = _frame_records(records)
    if whole and end != len(records):
        reason = (
            f"the records of this chunk break off at byte {end} of {len(records)},"
            f" or are more than {MAX_RECORDS}"
        )
        raise TraceError(reason, offset=chunk_offset)
    view = memoryview(records)
    messages = message_columns(_message_heads(view, offsets), offsets, chunk_offset, data_of(view))
    return messages, [(opcode, view[start:stop]) for opcode, start, stop in definitions]


def data_of(records: Records) -> Callable[[int, int], memoryview]:
    """Return the function that reads the bytes of a decompressed chunk, for :class:`Messages`."""
    view = memoryview(records)
    return lambda at, length: view[at : at + length]


def message_columns(
    heads: NDArray[np.void],
    offsets: Ints,
    chunk_offset: int,
    read: Callable[[int, int], memoryview],
) -> Messages:
    """Return message records of an MCAP file as columns: channel, log time, position and so on.

    Parameters
    ----------
    heads : (n,) of :data:`MESSAGE_HEAD`
    offsets : (n,) int64
        Byte offset of each record.
    chunk_offset, read
        As in :class:`Messages`.

    Raises
    ------
    TraceError
        A log time exceeds signed 64 bits (year 2262).
    """
    if len(heads) and int(heads["log_time"].max()) > LAST_NS:
        latest = int(heads["log_time"].max())
        reason = f"a message has a log time after the year 2262 ({latest} ns)"
        raise TraceError(reason, offset=max(chunk_offset, 0))
    return Messages(
        chunk_offset=chunk_offset,
        channel=heads["channel"].astype(np.int64),
        sequence=heads["sequence"].astype(np.int64),
        log_time_ns=heads["log_time"].astype(np.int64),
        publish_time_ns=heads["publish_time"].astype(np.uint64),
        offset=offsets,
        length=heads["length"].astype(np.int64) - MESSAGE_FIELDS,
        read=read,
    )


def _frame_records(records: Records) -> tuple[Ints, list[tuple[int, int, int]], int]:
    """Return the offsets of messages in a chunk, the spans of definitions, and the end of the last record."""
    offsets = array("q")
    definitions: list[tuple[int, int, int]] = []
    position, total, head_at = 0, len(records), HEAD.unpack_from
    for _ in range(MAX_RECORDS):
        start = position + HEAD.size
        if start > total:
            break
        opcode, length = head_at(records, position)
        stop = start + length
        if opcode == _MESSAGE and length >= MESSAGE_FIELDS and stop <= total:
            offsets.append(position)
        elif opcode in {0, _MESSAGE} or stop > total:
            break
        elif opcode in _DEFINITIONS:
            definitions.append((opcode, start, stop))
        position = stop
    return np.frombuffer(offsets, np.int64), definitions, position


def _message_heads(view: memoryview, offsets: Ints) -> NDArray[np.void]:
    if not len(offsets):
        return np.empty(0, MESSAGE_HEAD)
    rows = np.frombuffer(view, np.uint8)[offsets[:, None] + np.arange(MESSAGE_HEAD.itemsize)]
    return np.ascontiguousarray(rows).view(MESSAGE_HEAD)[:, 0]
