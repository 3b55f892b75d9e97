"""An MCAP file written record by record, with the ids of schemas and channels that it is told.

The writer of the ``mcap`` package numbers schemas and channels itself; a clip keeps the numbers of its
source, and is the same bytes whenever it is written. Definitions stand at the head of the data, then
metadata and attachments, then chunks with checksums and message indexes; the summary repeats the
definitions and indexes everything.

Source: MCAP specification, format version 0 (mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, BinaryIO, Final

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
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
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

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
