"""Clips by the official MCAP writer, addressed by the ids of their source.

The official writer numbers schemas and channels from 1 on, in the order in which they are registered. A clip's
source has numbers of its own, by which its messages name their channels; they are translated here.
"""

from __future__ import annotations

import zlib
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Schema
from mcap.writer import CompressionType, Writer

from sgstore.mcap import HEAD, READ_ERRORS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcap.records import Channel


_COMPRESSION: Final = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "": CompressionType.NONE,
}
_FIXED: Final = 8 + 8 + 4 + 4 + 8 + 4
"""Bytes of an attachment besides its texts and its data."""
_MALFORMED: Final = "an attachment is malformed and was left out"
_DAMAGED: Final = "an attachment has another checksum than it says"


class ClipWriter:
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
        Channel id in the source → messages written.
    numbers : dict
        Channel id in the source → channel id in the file.
    """

    def __init__(self, stream: BinaryIO, profile: str, library: str, compression: str) -> None:
        self.counts: dict[int, int] = {}
        self.numbers: dict[int, int] = {}
        self._schemas = {0: 0}
        self._writer = Writer(stream, compression=_COMPRESSION[compression], enable_data_crcs=True)
        self._writer.start(profile, library)

    def define(self, record: Schema | Channel) -> None:
        """Register a schema, or a channel whose schema is registered."""
        if isinstance(record, Schema):
            self._schemas[record.id] = self._writer.register_schema(
                record.name, record.encoding, record.data
            )
            return
        self.numbers[record.id] = self._writer.register_channel(
            record.topic,
            record.message_encoding,
            self._schemas.get(record.schema_id, 0),
            record.metadata,
        )
        self.counts[record.id] = 0

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, values)

    def attachment(self, pieces: Iterable[memoryview]) -> str:
        """Write an attachment that another file has.

        Parameters
        ----------
        pieces : iterable of memoryview
            Its record, with its head.

        Returns
        -------
        str
            What is wrong with it; empty: nothing. One that is malformed is not written.
        """
        stream = BytesIO(b"".join(pieces))
        stream.seek(HEAD.size)
        try:
            one = Attachment.read(ReadDataStream(stream))
        except READ_ERRORS:
            return _MALFORMED
        with stream.getbuffer() as whole:
            record = whole[HEAD.size :]
            length, crc = len(record), int.from_bytes(record[-4:], "little")
            damaged = crc and crc != zlib.crc32(record[:-4])
            record.release()
        if length != _FIXED + len(one.data) + len((one.name + one.media_type).encode()):
            return _MALFORMED
        del stream  # one copy of a large attachment less while it is written
        self._writer.add_attachment(
            one.create_time, one.log_time, one.name, one.media_type, one.data
        )
        return _DAMAGED if damaged else ""

    def message(
        self,
        channel: int,
        sequence: int,
        log_time: int,
        publish_time: int,
        data: bytes | memoryview,
    ) -> None:
        """Write a message; times in ns."""
        number = self.numbers[channel]
        self._writer.add_message(number, log_time, bytes(data), publish_time, sequence)
        self.counts[channel] += 1

    def finish(self) -> None:
        """Write the last chunk, the summary and the end of the file."""
        self._writer.finish()
