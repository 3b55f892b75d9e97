"""MCAP output: a writer with fixed ids, and the checks of ``mcap doctor``.

The rules that ``mcap doctor`` holds files to, looked after by reading a file record by record.

An *error* is what makes the doctor fail, a *warning* what it only says. Errors: a magic, a ``DataEnd`` or a
``Footer`` that is missing, or a record that cannot be read; a schema with id 0, or with data and no encoding;
two schemas or channels of one id that differ, one in the summary that is not in the data, a channel of an
unknown schema; a chunk in an unknown compression, of another size, checksum, or first or last log time than it
says, or with records other than schemas, channels and messages; a message of an unknown channel, or, outside
chunks, one that is earlier than the one before it; a message index that is behind no chunk, or has another time
than its message; two indexes of one chunk, an index that points elsewhere or differs from its chunk, an indexed
chunk whose channels and schemas are not in the summary; several statistics, or counts and times that differ
from what is there. Warnings: a header without a library or with an unknown profile, a schema that is empty,
definitions that come twice, messages that are not in order of time, without an index, or outside chunks beside
indexes.

Source: ``mcap doctor`` of the MCAP command line (foxglove/mcap, ``go/cli/mcap/cmd/doctor.go`` at 06890370),
whose rules these are; MCAP specification, format version 0 (mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO, Final, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path


MOST: Final = 1000
"""Errors and warnings that are told: one for each message would be more than anybody reads."""
PROFILES: Final = frozenset({"", "ros1", "ros2"})
_RECORD_HEAD: Final = struct.Struct("<BQ")
_UNREADABLE: Final = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,
    ValueError,
    LookupError,
    OverflowError,
    EOFError,
)


_Definition = TypeVar("_Definition", Schema, Channel)


@dataclass(slots=True)
class Diagnosis:
    """What is wrong with a file.

    Attributes
    ----------
    errors, warnings : list of str
        As the doctor sorts them; the first :data:`MOST` of each.
    of_definitions : list of str
        Those errors that are about schemas and channels alone, which a clip has from its source as they are.
    """

    errors: list[str] = field(default_factory=list[str])
    of_definitions: list[str] = field(default_factory=list[str])
    warnings: list[str] = field(default_factory=list[str])


@dataclass(slots=True)
class _Seen:
    """What a file has been found to hold so far."""

    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    repeated: set[tuple[type, int]] = field(default_factory=set[tuple[type, int]])
    chunks: dict[int, tuple[Chunk, int]] = field(default_factory=dict[int, tuple[Chunk, int]])
    used: dict[int, set[int]] = field(default_factory=dict[int, set[int]])
    indexes: list[ChunkIndex] = field(default_factory=list[ChunkIndex])
    statistics: list[Statistics] = field(default_factory=list[Statistics])
    counts: dict[int, int] = field(default_factory=dict[int, int])
    first: int | None = None
    last: int = 0
    outside: int = -1
    in_summary: bool = False
    ends: set[type] = field(default_factory=set[type])


def examine(path: Path) -> Diagnosis:
    """Look whether a file keeps to the rules.

    Parameters
    ----------
    path : Path
        An MCAP file of ours: its chunks are decompressed whole, so it is not for files of strangers.

    Returns
    -------
    Diagnosis
    """
    doctor = _Doctor()
    try:
        with path.open("rb") as stream:
            doctor.read(stream)
    except _UNREADABLE as error:
        doctor.found.errors.append(f"cannot be read: {error!r}")
    return doctor.found


class _Doctor:
    """Reads a file once, and notes what is wrong."""

    def __init__(self) -> None:
        self.found = Diagnosis()
        self._seen = _Seen()
        self._chunk: tuple[int, Chunk] | None = None
        self._of_chunk: dict[int, dict[int, int]] = {}

    def read(self, stream: BinaryIO) -> None:
        """Read all records, and compare what the summary says of them."""
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=True)
        for record in reader.records:
            if not isinstance(record, MessageIndex):
                self._close_chunk()
            if isinstance(record, Chunk):
                self._chunk = stream.tell() - _length(record), record
            elif not self._of_data(record):
                self._of_summary(record)
        self._close_chunk()
        self.found.errors += [
            f"there is no {kind.__name__} record"
            for kind in (DataEnd, Footer)
            if kind not in self._seen.ends
        ]
        self._compare()

    def _of_data(self, record: McapRecord) -> bool:
        """Look at a definition, a message, or an index of messages; whether it was one."""
        match record:
            case Header():
                self._header(record)
            case Schema():
                self._schema(record)
            case Channel():
                self._channel(record)
            case Message():
                self._outside(record)
            case MessageIndex():
                self._index(record)
            case _:
                return False
        return True

    def _of_summary(self, record: McapRecord) -> None:
        match record:
            case ChunkIndex():
                self._seen.indexes.append(record)
            case Statistics():
                self._seen.statistics.append(record)
            case DataEnd() | Footer():
                self._seen.ends.add(type(record))
                self._seen.in_summary = True
            case _:
                pass

    def _error(self, text: str) -> None:
        if len(self.found.errors) < MOST:
            self.found.errors.append(text)

    def _error_of_definition(self, text: str) -> None:
        self._error(text)
        if len(self.found.of_definitions) < MOST:
            self.found.of_definitions.append(text)

    def _warn(self, text: str) -> None:
        if len(self.found.warnings) < MOST:
            self.found.warnings.append(text)

    def _header(self, record: Header) -> None:
        if not record.library:
            self._warn("the header names no library")
        if record.profile not in PROFILES:
            self._warn(f"the header has a profile that is not well known: {record.profile!r}")

    def _schema(self, record: Schema) -> None:
        if record.id == 0:
            self._error_of_definition("a schema has the id 0, which means none")
        if not record.encoding and record.data:
            self._error_of_definition(f"schema {record.id} has data and no encoding")
        if not record.encoding and not record.data:
            self._warn(f"schema {record.id} ({record.name!r}) is empty")
        self._define(record, self._seen.schemas)

    def _channel(self, record: Channel) -> None:
        self._define(record, self._seen.channels)
        if record.schema_id and record.schema_id not in self._seen.schemas:
            self._error_of_definition(
                f"channel {record.id} has a schema that is not known: {record.schema_id}"
            )

    def _define(self, record: _Definition, known: dict[int, _Definition]) -> None:
        name = type(record).__name__.lower()
        previous = known.get(record.id)
        if previous is not None and previous != record:
            self._error(f"two {name} records of the id {record.id} differ")
        if self._seen.in_summary:
            self._seen.repeated.add((type(record), record.id))
            if previous is None:
                self._error(f"{name} {record.id} is in the summary and not in the data")
        else:
            if previous is not None:
                self._warn(f"{name} {record.id} is defined twice in the data")
            known[record.id] = record

    def _outside(self, record: Message) -> None:
        self._message(record.channel_id, record.log_time)
        if record.log_time < self._seen.outside:
            self._error(
                f"a message outside chunks is at {record.log_time}, before the one before it"
            )
        self._seen.outside = record.log_time

    def _message(self, channel: int, log_time: int) -> None:
        seen = self._seen
        if channel not in seen.channels:
            self._error(f"a message comes before its channel: {channel}")
        seen.counts[channel] = seen.counts.get(channel, 0) + 1
        seen.first = log_time if seen.first is None else min(seen.first, log_time)
        seen.last = max(seen.last, log_time)

    def _index(self, record: MessageIndex) -> None:
        if self._seen.outside >= 0:
            self._warn("there are messages outside chunks, which the indexes miss")
        if self._chunk is None:
            self._error("a message index is behind no chunk")
        elif record.channel_id in self._of_chunk:
            self._warn(f"two message indexes of channel {record.channel_id} for one chunk")
        else:
            self._of_chunk[record.channel_id] = {offset: time for time, offset in record.records}

    def _close_chunk(self) -> None:
        if self._chunk is not None:
            (start, chunk), self._chunk = self._chunk, None
            self._examine_chunk(start, chunk)
            self._of_chunk = {}

    def _examine_chunk(self, start: int, chunk: Chunk) -> None:
        records = _decompressed(chunk)
        if records is None:
            self._error(f"the chunk at {start} is in an unknown compression: {chunk.compression!r}")
            return
        if len(records) != chunk.uncompressed_size:
            self._error(
                f"the chunk at {start} is {len(records)} bytes, not {chunk.uncompressed_size}"
            )
        if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
            self._error(f"the chunk at {start} has another checksum")
        times: list[int] = []
        used: set[int] = set()
        at = 0
        while at < len(records):
            opcode, length = _RECORD_HEAD.unpack_from(records, at)
            content = ReadDataStream(
                BytesIO(records[at + _RECORD_HEAD.size : at + _RECORD_HEAD.size + length])
            )
            if opcode == Opcode.SCHEMA:
                self._schema(Schema.read(content))
            elif opcode == Opcode.CHANNEL:
                self._channel(Channel.read(content))
            elif opcode == Opcode.MESSAGE:
                message = Message.read(content, length)
                self._in_chunk(message, at)
                times.append(message.log_time)
                used.add(message.channel_id)
            else:
                self._error(f"the chunk at {start} has a record of the opcode {opcode}")
            at += _RECORD_HEAD.size + length
        if times and (min(times), max(times)) != (chunk.message_start_time, chunk.message_end_time):
            self._error(f"the chunk at {start} has messages of other times than it says")
        self._seen.used[start] = used
        self._seen.chunks[start] = replace(chunk, data=b""), len(chunk.data)

    def _in_chunk(self, message: Message, at: int) -> None:
        if message.log_time < self._seen.last:
            self._warn(f"a message at {message.log_time} comes after one at {self._seen.last}")
        self._message(message.channel_id, message.log_time)
        index = self._of_chunk.get(message.channel_id)
        if index is None:
            self._warn(f"channel {message.channel_id} has no message index for a chunk")
            return
        time = index.get(at)
        if time is None:
            self._warn(f"a message of channel {message.channel_id} at {at} is not in its index")
        elif time != message.log_time:
            self._error(f"the index says {time} of a message at {message.log_time}")

    def _compare(self) -> None:
        """What the summary says, and what is there."""
        seen = self._seen
        starts = [index.chunk_start_offset for index in seen.indexes]
        self.found.errors += [
            f"there are several indexes of the chunk at {start}"
            for start in sorted({one for one in starts if starts.count(one) > 1})
        ]
        for index in seen.indexes:
            self._compare_index(index)
        if len(seen.statistics) > 1:
            self._error("there are several statistics")
        for told in seen.statistics[:1]:
            total = sum(seen.counts.values())
            if told.message_count != total:
                self._error(f"the statistics say {told.message_count} messages; there are {total}")
            for channel, count in seen.counts.items():
                said = told.channel_message_counts.get(channel, 0)
                if said != count:
                    self._error(
                        f"the statistics say {said} messages of channel {channel}, not {count}"
                    )
            times = told.message_start_time, told.message_end_time
            if total and times != (seen.first, seen.last):
                self._error(
                    f"the statistics say {times}; the times are {seen.first} and {seen.last}"
                )

    def _compare_index(self, index: ChunkIndex) -> None:
        seen, start = self._seen, index.chunk_start_offset
        if start not in seen.chunks:
            self._error(f"an index points to {start}, where no chunk begins")
            return
        chunk, size = seen.chunks[start]
        pairs = {
            "first time": (index.message_start_time, chunk.message_start_time),
            "last time": (index.message_end_time, chunk.message_end_time),
            "compression": (index.compression, chunk.compression),
            "stored size": (index.compressed_size, size),
            "size": (index.uncompressed_size, chunk.uncompressed_size),
            "length": (index.chunk_length, _length(chunk) + size),
        }
        for name, (said, found) in pairs.items():
            if said != found:
                self._error(f"the index of the chunk at {start}: {name} {said}, not {found}")
        for number in seen.used[start]:
            channel = seen.channels.get(number)
            if (Channel, number) not in seen.repeated:
                self._error(f"channel {number} of an indexed chunk is not in the summary")
            if channel and channel.schema_id and (Schema, channel.schema_id) not in seen.repeated:
                self._error(f"schema {channel.schema_id} of an indexed chunk is not in the summary")


def _length(chunk: Chunk) -> int:
    """Length of a chunk record, with its head."""
    return (
        _RECORD_HEAD.size
        + 8
        + 8
        + 8
        + 4
        + 4
        + len(chunk.compression.encode())
        + 8
        + len(chunk.data)
    )


def _decompressed(chunk: Chunk) -> bytes | None:
    match chunk.compression:
        case "":
            return chunk.data
        case "zstd":
            return zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
        case "lz4":
            return bytes(lz4.frame.decompress(chunk.data))
        case _:
            return None


# An MCAP file written record by record, with the ids of schemas and channels that it is told ----
# The writer of the ``mcap`` package numbers schemas and channels itself; a clip keeps the numbers of its
# source, and is the same bytes whenever it is written. Definitions stand at the head of the data, then
# metadata and attachments, then chunks with checksums and message indexes; the summary repeats the
# definitions and indexes everything.
#
# Source: MCAP specification, format version 0 (mcap.dev/spec).

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_SIZE: Final = 1 << 20
"""Size that a chunk's records reach before it is closed; bytes."""
_HEAD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_ATTACHMENT: Final = struct.Struct("<QQ")

_COMPRESS: Final[dict[str, Callable[[bytes], bytes]]] = {
    "zstd": lambda records: zstandard.ZstdCompressor().compress(records),
    "lz4": lz4.frame.compress,
    "": lambda records: records,
}


class McapWriter:
    """Writes an MCAP file from its beginning to its end.

    Parameters
    ----------
    stream : BinaryIO
        Open for writing, empty.
    profile, library : str
        For the header.
    compression : str
        Of the chunks: ``zstd``, ``lz4``, or empty.

    Attributes
    ----------
    counts : dict
        Channel id → messages written.
    """

    def __init__(self, stream: BinaryIO, profile: str, library: str, compression: str) -> None:
        self.counts: dict[int, int] = {}
        self._stream = stream
        self._compression = compression
        self._position = 0
        self._crc = 0
        self._definitions: dict[Opcode, list[McapRecord]] = {Opcode.SCHEMA: [], Opcode.CHANNEL: []}
        self._chunks: list[McapRecord] = []
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []
        self._records = bytearray()
        self._indexes: dict[int, MessageIndex] = {}
        self._span = (0, 0)
        self._chunk_span: tuple[int, int] | None = None
        self._write(MAGIC)
        self._write_record(Header(profile, library))

    def define(self, record: Schema | Channel) -> None:
        """Write a schema or a channel, with its id as it is."""
        opcode = Opcode.SCHEMA if isinstance(record, Schema) else Opcode.CHANNEL
        self._definitions[opcode].append(record)
        if isinstance(record, Channel):
            self.counts[record.id] = 0
        self._write_record(record)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        start = self._position
        self._write_record(Metadata(name=name, metadata=values))
        self._metadata.append(MetadataIndex(start, self._position - start, name))

    def attachment(self, pieces: Iterable[memoryview]) -> None:
        """Write an attachment record that another file has, byte for byte.

        Raises
        ------
        struct.error, UnicodeDecodeError
            It is malformed; then nothing was written.
        """
        start = self._position
        index: AttachmentIndex | None = None
        for piece in pieces:
            index = index or _attachment_index(bytes(piece[: 1 << 16]), start)
            self._write(piece)
        if index is not None:
            index.length = self._position - start
            self._attachments.append(index)

    def message(
        self, channel: int, sequence: int, log_time: int, publish_time: int, data: memoryview
    ) -> None:
        """Write a message; times in ns."""
        index = self._indexes.setdefault(channel, MessageIndex(channel, []))
        index.records.append((log_time, len(self._records)))
        length = _MESSAGE.size - _HEAD.size + len(data)
        self._records += _MESSAGE.pack(
            Opcode.MESSAGE, length, channel, sequence, log_time, publish_time
        )
        self._records += data
        start, end = self._chunk_span or (log_time, log_time)
        self._chunk_span = (min(start, log_time), max(end, log_time))
        self.counts[channel] += 1
        if len(self._records) >= CHUNK_SIZE:
            self._close_chunk()

    def finish(self) -> None:
        """Write the last chunk, the summary and the end of the file."""
        self._close_chunk()
        self._write_record(DataEnd(self._crc))
        start = self._position
        builder = RecordBuilder()
        offsets: list[McapRecord] = []
        groups = (
            (Opcode.SCHEMA, self._definitions[Opcode.SCHEMA]),
            (Opcode.CHANNEL, self._definitions[Opcode.CHANNEL]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        for opcode, records in groups:
            first = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, start + first, builder.count - first))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = builder.end()
        tail = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        self._write(summary)
        self._write_record(Footer(start, offset_start, zlib.crc32(tail, zlib.crc32(summary))))
        self._write(MAGIC)

    def _close_chunk(self) -> None:
        if self._chunk_span is None:
            return
        records = bytes(self._records)
        stored = _COMPRESS[self._compression](records)
        first, last = self._chunk_span
        start = self._position
        self._write_record(
            Chunk(
                compression=self._compression,
                data=stored,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(records),
                uncompressed_size=len(records),
            )
        )
        index_start = self._position
        places: dict[int, int] = {}
        for channel, index in sorted(self._indexes.items()):
            places[channel] = self._position
            self._write_record(index)
        self._chunks.append(
            ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression=self._compression,
                compressed_size=len(stored),
                message_end_time=last,
                message_index_length=self._position - index_start,
                message_index_offsets=places,
                message_start_time=first,
                uncompressed_size=len(records),
            )
        )
        self._span = (
            (min(self._span[0], first), max(self._span[1], last))
            if len(self._chunks) > 1
            else (first, last)
        )
        self._records.clear()
        self._indexes, self._chunk_span = {}, None

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._definitions[Opcode.CHANNEL]),
            channel_message_counts={c: n for c, n in self.counts.items() if n},
            chunk_count=len(self._chunks),
            message_count=sum(self.counts.values()),
            message_end_time=self._span[1],
            message_start_time=self._span[0],
            metadata_count=len(self._metadata),
            schema_count=len(self._definitions[Opcode.SCHEMA]),
        )

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, data: bytes | memoryview) -> None:
        self._stream.write(data)
        self._position += len(data)
        self._crc = zlib.crc32(data, self._crc)


def _attachment_index(head: bytes, start: int) -> AttachmentIndex:
    """The index of an attachment record, from its first bytes; its length is still to come."""
    log_time, create_time = _ATTACHMENT.unpack_from(head, _HEAD.size)
    position = _HEAD.size + _ATTACHMENT.size
    texts: list[str] = []
    for _ in range(2):
        (size,) = struct.unpack_from("<I", head, position)
        texts.append(head[position + 4 : position + 4 + size].decode())
        position += 4 + size
    (data_size,) = struct.unpack_from("<Q", head, position)
    return AttachmentIndex(start, 0, log_time, create_time, data_size, texts[0], texts[1])
