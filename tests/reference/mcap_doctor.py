"""The rules that ``mcap doctor`` holds files to, checked by reading a file record by record.

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
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader

if TYPE_CHECKING:
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
