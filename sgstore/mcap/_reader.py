"""Reader of MCAP files that reads every usable message and reports damaged parts.

A file is read record by record in file order, with one chunk in memory at a time. If messages are requested in
order of time, but are not in this order, an index is sorted (:mod:`sgstore.mcap._order`). The summary at the
end of the file is optional and not trusted. It provides the channel definitions early, and the offsets of
chunks. The reader can then continue at the next chunk after a damaged record.

Possible faults and their treatment:

* A chunk is damaged, has a wrong size, or is too large: it is skipped and reported as a
  :class:`~sgstore.mcap.Loss` (bytes, time span, and the number of messages if message indexes contain it).
* The file ends early: every complete record is used, and the complete messages of a truncated chunk.
* The length of a record is wrong: reading continues at the next chunk of the summary.
* The file is not an MCAP file: a :class:`TraceError`.

All other errors of the parsers are converted into one of these.

Source: MCAP specification, format version 0 (mcap.dev/spec).
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Self, cast

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from sgstore.errors import TraceError
from sgstore.mcap._chunks import (
    HEAD,
    IDS,
    LAST_NS,
    MAX_CHUNK,
    MESSAGE_HEAD,
    READ_ERRORS,
    ChunkHead,
    Messages,
    RecordPlace,
    StrictStream,
    data_of,
    decompress_head,
    head_of_cut_chunk,
    loss_of_chunk,
    message_columns,
    name_of,
    parse_records,
    read_chunk_head,
)
from sgstore.mcap._fetch import (
    METADATA,
    BagPart,
    bag_folder,
    mark_of,
    mark_of_open,
    open_regular,
    part_at,
    parts_of,
)
from sgstore.mcap._findings import MAX_LOSSES, Findings, Loss
from sgstore.mcap._order import ChannelRanks, OrderCheck, OutOfOrder, TimeOrder
from sgstore.mcap._read_ahead import MAGIC, ReadAhead, Spool, chunks_in, read_summary

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    Ints = NDArray[np.int64]


CLIP: Final = "sgstore.clip"
"""Name of the metadata record that marks a clip. It has ``start_ns`` and ``end_ns`` of the interval."""
MAX_DEFINITION: Final = 16 << 20
"""Maximum size of a schema, channel or metadata record; bytes."""
MAX_DEFINITIONS: Final = 64 << 20
"""Maximum total size of all schemas, channels and metadata of a file; bytes."""
SMALL: Final = 4 << 20
"""Size up to which a file is read chunk by chunk, without threads; bytes."""
RUN_MESSAGES: Final = 1024
"""Maximum number of messages outside chunks in one group."""
MOST_OPEN: Final = 32
"""Maximum number of files of a bag that are open at once."""

_PIECE: Final = 1 << 20
_HOLDS_CONTENT: Final = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
    }
)


@dataclass(slots=True)
class _FileWalk:
    """State of one reading of an MCAP file: position, and losses so far.

    ``pending`` is a lost chunk. The message indexes after it contain its number of messages.
    """

    report: Findings
    ahead: ReadAhead
    wanted: Callable[[int], bool] | None = None
    keep: Callable[[int], bool] | None = None
    position: int = len(MAGIC)
    run: array[int] = field(default_factory=lambda: array("q"))
    pending: Loss | None = None
    messages: int = 0
    chunks: int = 0
    unverified: int = 0
    closed: bool = False


class McapFile:
    """Reader of an MCAP file, also of a damaged one. The file can be read several times.

    Parameters
    ----------
    path : Path
        The file. The folder of a bag, or its ``metadata.yaml``, opens all files of it as one
        (:class:`McapBag`).
    spool : Spool, optional
        Cache of messages between readings. If several files share it, the caller closes it.

    Attributes
    ----------
    path, size, mtime_ns
        The file, its size in bytes, its modification time.
    profile, library : str
        Values of the header.
    schemas, channels : dict
        Records by id, filled from the summary and during the walk.
    metadata : dict
        Metadata records by position, filled during the walk.
    attachments : list of RecordPlace
        Positions of the attachments, which are not read; filled during the walk.
    counts : dict or None
        Number of messages by channel id, from the statistics of the file.
    compression : str
        Compression of the first chunk; ``zstd`` before the first chunk.
    chunk_offsets : (n,) int64
        Byte offsets of the chunks in the summary, ascending.

    Raises
    ------
    TraceError
        The file cannot be opened or is not an MCAP file.
    """

    has_log_times = True

    def __new__(cls, path: Path, spool: Spool | None = None) -> Self:
        """Return a new reader of an MCAP file, or of all files of a bag."""
        del spool
        if cls is McapFile and bag_folder(path) is not None:
            return object.__new__(cast("type[Self]", McapBag))
        return object.__new__(cls)

    def __init__(self, path: Path, spool: Spool | None = None) -> None:
        self.path = path
        self._begin(spool)
        self.counts: dict[int, int] | None
        self.compression, self._has_met_chunk = "zstd", False
        self._verified: set[int] = set()
        self._aheads: list[ReadAhead] = []
        self._known_channels = np.zeros(IDS, np.bool_)
        self._definition_bytes = 0
        self._file = open_regular(path)
        try:
            self.size, self.mtime_ns = mark_of_open(self._file)
            self.profile, self.library = self._header()
            summary = read_summary(self._file, self.size)
            self.schemas.update(summary.schemas)
            self.channels.update(summary.channels)
            self.counts = summary.counts
            self.chunk_offsets = summary.chunk_offsets
            self._chunk_starts = array("q", summary.chunk_offsets.tobytes())
            self._summary_fault = summary.fault
            self._known_channels[[*self.channels]] = True
        except BaseException:
            self._file.close()
            raise

    def _begin(self, spool: Spool | None) -> None:
        self._spool, self._own_spool = spool or Spool(), spool is None
        self._in_order = self._unordered = False
        self._order: TimeOrder | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[RecordPlace, Metadata] = {}
        self.attachments: list[RecordPlace] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the MCAP file."""
        for ahead in self._aheads:
            ahead.close()
        self._file.close()
        if self._own_spool:
            self._spool.close()

    def reopen(self) -> None:
        """Open the MCAP file again, after it was closed.

        Raises
        ------
        TraceError
            The file can no longer be opened.
        """
        if self._file.closed:
            self._file = open_regular(self.path)

    @property
    def window(self) -> tuple[int, int]:
        """First and last log time of a clip, both included; ns. Other files have no limits.

        A clip also contains earlier or later messages that its own messages depend on.
        """
        window = (0, LAST_NS)
        for place in sorted(self.metadata, key=lambda place: place.offset):
            record = self.metadata[place]
            start, end = record.metadata.get("start_ns", ""), record.metadata.get("end_ns", "")
            if record.name == CLIP and start.isdecimal() and end.isdecimal():
                window = (int(start), int(end))
        return window

    def walk(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
        rank: Callable[[int], int] | None = None,
    ) -> Iterator[Messages]:
        """Yield all messages of the file, in groups, one chunk at a time.

        Unreadable parts are added to ``report``.

        Parameters
        ----------
        report : Findings
        wanted : callable, optional
            True for the offset of a chunk to read; other chunks are skipped.
        keep : callable, optional
            True for the id of a channel whose messages a later walk needs, which saves a second decompression.
            It is called after the messages were returned.
        rank : callable, optional
            Rank of a channel id for messages of equal time. With it, messages come in order of time; without
            it, in file order.

        Raises
        ------
        OutOfOrder
            The messages so far are not in order of time. The next walk sorts them.
        TraceError
            The channel definitions are too large, or the file is no longer readable.
        """
        if rank is None or self._in_order:
            yield from self._in_file_order(report, wanted, keep)
            return
        ranks = ChannelRanks(rank, self.schemas, self.channels)
        if not self._unordered:
            check = OrderCheck(ranks)
            for run in self._in_file_order(report, wanted, keep):
                if not check.follows(run):
                    self._unordered = True
                    raise OutOfOrder
                yield run
            self._in_order = wanted is None
            return
        if self._order is None:
            self._order = self._time_order(ranks, keep)
        yield from self._order.walk(report, wanted)

    def settle_order(self, rank: Callable[[int], int]) -> None:
        """Check once that all messages are sorted by time. If not, later calls of ``walk`` sort them."""
        if not self._in_order and not self._unordered:
            with suppress(OutOfOrder):
                for _ in self.walk(Findings(), rank=rank):
                    pass

    def _time_order(self, ranks: ChannelRanks, keep: Callable[[int], bool] | None) -> TimeOrder:
        """Return a sort index of all messages of the file.

        The reading is repeated if a channel definition came after its messages.
        """
        while True:
            findings, known = Findings(), len(self.channels)
            runs = self._in_file_order(findings, None, keep)
            found = TimeOrder(runs, ranks, keep or _all, self._again, findings)
            if known == len(self.channels):
                return found

    def _again(self, place: int, count: int) -> Messages:
        """Read a group of consecutive messages again, starting at a byte position."""
        runs = self._in_file_order(Findings(), _all, None, place)
        for run in runs:
            runs.close()
            return run.span(0, count)
        raise TraceError("the file was changed while it was read", path=self.path, offset=place)

    def _in_file_order(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None,
        keep: Callable[[int], bool] | None,
        start: int = len(MAGIC),
    ) -> Generator[Messages]:
        """Yield all messages in file order, starting at a byte position."""
        walk = _FileWalk(report, self._read_ahead(wanted), wanted, keep, start)
        self._aheads.append(walk.ahead)
        try:
            while not walk.closed:
                head = self._head(walk.position)
                if head is None:
                    break
                if head[0] == Opcode.MESSAGE_INDEX and self._passes(walk, head[1]):
                    continue
                yield from self._step(walk, *head)
            yield from self._flush(walk)
        except READ_ERRORS as error:
            raise TraceError(f"cannot be read: {error}", path=self.path) from error
        finally:
            self._aheads.remove(walk.ahead)
            walk.ahead.close()
        self._settle(walk)
        self._closing_words(walk)

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """Yield the bytes of a record of the MCAP file in pieces.

        Raises
        ------
        TraceError
            The file has become shorter.
        """
        for start in range(0, place.length, _PIECE):
            yield self._at(place.offset + start, min(_PIECE, place.length - start))

    def _header(self) -> tuple[str, str]:
        start = self._file.read(len(MAGIC))
        if not start:
            raise TraceError("the file is empty; expected an MCAP recording", path=self.path)
        if start != MAGIC:
            reason = f"not an MCAP file: it begins with {start!r}, expected {MAGIC!r}"
            raise TraceError(reason, path=self.path)
        try:
            opcode, length = HEAD.unpack(self._file.read(HEAD.size))
            if opcode != Opcode.HEADER or length > MAX_DEFINITION:
                raise TraceError("expected the header of an MCAP file", path=self.path, offset=8)
            header = Header.read(StrictStream(self._file.read(length)))
        except READ_ERRORS as error:
            reason = "the header of this MCAP file is cut or malformed"
            raise TraceError(reason, path=self.path, offset=len(MAGIC)) from error
        return header.profile, header.library

    def _read_ahead(self, wanted: Callable[[int], bool] | None) -> ReadAhead:
        """If all chunks of a large file will be read, start to decompress them in other threads."""
        if wanted is not None or self.size <= SMALL:
            return ReadAhead(self._file, verified=self._verified)
        offsets = self._chunk_starts or chunks_in(self._file)
        offsets = (at for at in offsets if not self._spool.has(self.path, at))
        return ReadAhead(self._file, offsets, self._verified)

    def _head(self, position: int) -> tuple[int, int] | None:
        """Return the type and length of the record at a byte position; ``None`` if the record is truncated."""
        self._file.seek(position)
        head = self._file.read(HEAD.size)
        return HEAD.unpack(head) if len(head) == HEAD.size else None

    def _passes(self, walk: _FileWalk, length: int) -> bool:
        """Skip a record without useful content. Return False if its length may be wrong."""
        stop = walk.position + HEAD.size + length
        sound = walk.pending is None and stop <= self.size
        sound = sound and self._chunk_behind(walk.position, stop) is None
        if sound:
            walk.position = stop
        return sound

    def _step(self, walk: _FileWalk, opcode: int, length: int) -> Iterator[Messages]:
        """Yield the messages of one record, and move to the next record."""
        start = walk.position
        stop = start + HEAD.size + length
        if opcode != Opcode.MESSAGE_INDEX:
            self._settle(walk)
        astray = self._chunk_behind(start, min(stop, self.size))
        if opcode == 0 or stop > self.size or (astray is not None and opcode != Opcode.CHUNK):
            yield from self._flush(walk)
            yield from self._broken(walk, opcode, length)
            return
        walk.position = stop
        match opcode:
            case Opcode.MESSAGE:
                yield from self._single(walk, start, length)
            case Opcode.CHUNK:
                yield from self._flush(walk)
                yield from self._chunk(walk, RecordPlace(start, stop - start), astray)
            case Opcode.MESSAGE_INDEX:
                self._count(walk, length)
            case Opcode.DATA_END | Opcode.FOOTER:
                yield from self._end(walk, start)
            case _:
                self._define_at(walk, opcode, RecordPlace(start, stop - start))

    def _single(self, walk: _FileWalk, start: int, length: int) -> Iterator[Messages]:
        if length < MESSAGE_HEAD.itemsize - HEAD.size or length > MAX_CHUNK:
            reason = f"a message of {length} bytes"
            walk.report.lose(Loss(reason, 1, length + HEAD.size, offset=start))
            return
        walk.run.append(start)
        if len(walk.run) >= RUN_MESSAGES:
            yield from self._flush(walk)

    def _flush(self, walk: _FileWalk) -> Iterator[Messages]:
        """Yield the messages outside chunks found since the last call. Unreadable ones count as lost."""
        if not walk.run:
            return
        offsets = np.frombuffer(walk.run, np.int64)
        walk.run = array("q")
        walk.messages += len(offsets)
        try:
            messages = self._outside(offsets)
        except TraceError as error:
            loss = Loss(error.reason, len(offsets), offset=int(offsets[0]))
            walk.report.lose(loss)
            return
        yield from self._known(walk, messages)

    def _outside(self, offsets: Ints) -> Messages:
        """Return the messages outside chunks at the given byte offsets."""
        heads = b"".join(self._at(int(at), MESSAGE_HEAD.itemsize) for at in offsets)
        return message_columns(np.frombuffer(heads, MESSAGE_HEAD), offsets, -1, self._at)

    def _end(self, walk: _FileWalk, start: int) -> Iterator[Messages]:
        """Handle the end of the data. If the summary lists later chunks, continue with them."""
        yield from self._flush(walk)
        resume = self._chunk_behind(start, self.size)
        walk.closed = resume is None
        if resume is not None:
            reason = "damage: the data seem to end here, but the summary names chunks behind"
            walk.report.lose(Loss(reason, bytes=resume - start, offset=start))
            walk.position = resume

    def _chunk(self, walk: _FileWalk, place: RecordPlace, astray: int | None) -> Iterator[Messages]:
        """Yield the messages of one chunk (compressed block) of an MCAP file.

        ``astray`` is the offset of another listed chunk that starts inside the chunk, or ``None``.
        """
        if walk.wanted is not None and not walk.wanted(place.offset):
            return
        walk.chunks += 1
        head = None
        try:
            head = read_chunk_head(self._file, place.offset)
            if not self._has_met_chunk:
                self.compression, self._has_met_chunk = head.compression, True
            walk.unverified += head.crc == 0
            messages, definitions = self._records(walk, head)
        except TraceError as error:
            if astray is not None:
                walk.position = astray
                place = RecordPlace(place.offset, astray - place.offset)
            walk.pending = loss_of_chunk(error.reason, place, head)
            return
        walk.messages += len(messages)
        for opcode, content in definitions:
            self._define(walk, opcode, content, place.offset)
        yield from self._known(walk, messages)
        if walk.keep is not None and head.compression and not definitions:
            kept = np.bincount(messages.channel) > 0
            for number in np.flatnonzero(kept).tolist():
                kept[number] = number in self.channels and walk.keep(number)
            self._spool.put(self.path, messages, kept[messages.channel])

    def _records(
        self, walk: _FileWalk, head: ChunkHead
    ) -> tuple[Messages, list[tuple[int, memoryview]]]:
        """Return the messages of a chunk and its schemas and channels, from the cache or the file."""
        kept = self._spool.get(self.path, head.offset, lambda: data_of(walk.ahead.records(head)))
        if kept is not None:
            return kept, []
        found = parse_records(walk.ahead.records(head), head.offset)
        self._verified.add(head.offset)
        return found

    def _known(self, walk: _FileWalk, messages: Messages) -> Iterator[Messages]:
        """Yield the messages of defined channels. Report the others as lost."""
        lost = ~self._known_channels[messages.channel]
        if lost.any():
            unknown: list[int] = np.unique(messages.channel[lost]).tolist()
            times = messages.log_time_ns[lost]
            loss = Loss(
                f"messages of channels that the file does not define: {unknown[:10]}",
                messages=int(lost.sum()),
                bytes=int(messages.length[lost].sum()),
                start_ns=int(times.min()),
                end_ns=int(times.max()),
                offset=max(messages.chunk_offset, -1),
            )
            walk.report.lose(loss)
            messages = messages.take(~lost)
        if len(messages):
            yield messages

    def _chunk_behind(self, start: int, stop: int) -> int | None:
        """Return the offset of the first chunk between two offsets, from the summary; ``None`` without one.

        An offset of the summary counts only if a valid chunk head is at this place.
        """
        starts = self._chunk_starts
        for at in range(bisect_right(starts, start), len(starts)):
            if starts[at] >= stop:
                break
            with suppress(TraceError):
                return read_chunk_head(self._file, starts[at]).offset
        return None

    def _broken(self, walk: _FileWalk, opcode: int, length: int) -> Iterator[Messages]:
        """Handle a record with an impossible length: continue with the next chunk in the summary, or stop."""
        resume = self._chunk_behind(walk.position, self.size)
        start = walk.position
        stop = self.size if resume is None else resume
        walk.position = stop
        name = name_of(opcode)
        if resume is not None:
            reason = (
                f"damage: a record ({name}) of {length} bytes where at most {stop - start} are left"
            )
            walk.report.lose(Loss(reason, bytes=stop - start, offset=start))
        elif opcode == Opcode.CHUNK:
            yield from self._cut_chunk(walk, start)
        elif opcode in _HOLDS_CONTENT:
            reason = f"the file ends inside a record ({name}): {stop - start} of {length + HEAD.size} bytes"
            messages = 1 if opcode == Opcode.MESSAGE else 0
            walk.report.lose(Loss(reason, messages, stop - start, offset=start))
        elif opcode == 0 or opcode > Opcode.DATA_END:
            reason = f"the bytes from here to the end are not MCAP records (opcode {opcode})"
            walk.report.lose(Loss(reason, bytes=stop - start, offset=start))

    def _cut_chunk(self, walk: _FileWalk, start: int) -> Iterator[Messages]:
        """Yield the complete messages of a truncated chunk."""
        head, kept, definitions = self._of_cut(start)
        for opcode, content in definitions:
            self._define(walk, opcode, content, start)
        count = 0 if kept is None else len(kept)
        walk.messages += count
        reason = f"the file ends inside a chunk; its first {count} messages were kept"
        walk.report.lose(loss_of_chunk(reason, RecordPlace(start, self.size - start), head))
        if kept is not None:
            yield from self._known(walk, kept)

    def _of_cut(
        self, start: int
    ) -> tuple[ChunkHead | None, Messages | None, list[tuple[int, memoryview]]]:
        """Return header, complete messages and definitions (schemas, channels) of a truncated chunk."""
        found = head_of_cut_chunk(bytes(self._at(start, min(self.size - start, MAX_CHUNK))), start)
        if found is None:
            return None, None, []
        head, stored = found
        records = decompress_head(stored, head.compression, min(head.size, MAX_CHUNK))
        try:
            return head, *parse_records(records, start, whole=False)
        except TraceError:
            return head, None, []

    def _count(self, walk: _FileWalk, length: int) -> None:
        """Count the entries of an index record as lost messages of a chunk that was lost."""
        if walk.pending is None:
            return
        entries = max(length - 6, 0) // 16
        walk.pending = replace(walk.pending, messages=max(walk.pending.messages, 0) + entries)

    def _settle(self, walk: _FileWalk) -> None:
        """Report a lost chunk. Call this after its index records, because they have the message count."""
        if walk.pending is not None:
            walk.report.lose(walk.pending)
            walk.pending = None

    def _closing_words(self, walk: _FileWalk) -> None:
        """Add warnings about unusual properties of the whole file. No data are lost because of them."""
        warn = walk.report.warnings.append
        left = self.size - walk.position
        if not walk.closed:
            if 0 < left < HEAD.size:
                walk.report.lose(Loss("the file ends inside the head of a record", bytes=left))
            warn("the recording was not closed; its end of data is missing")
        elif self._summary_fault:
            warn(self._summary_fault)
        told = sum(self.counts.values()) if self.counts else 0
        if told > walk.messages and not walk.report.losses and walk.wanted is None:
            reason = f"the file's statistics count {told} messages, {walk.messages} were found"
            walk.report.lose(Loss(reason, told - walk.messages))
        if walk.chunks and walk.unverified == walk.chunks:
            warn("no chunk has a checksum: damage that leaves a chunk readable cannot be noticed")

    def _define_at(self, walk: _FileWalk, opcode: int, place: RecordPlace) -> None:
        if opcode == Opcode.ATTACHMENT:
            known = self.attachments[-1].offset if self.attachments else -1
            if place.offset > known:  # A later walk reads the same record again.
                self.attachments.append(place)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}:
            if place.length > MAX_DEFINITION:
                reason = f"a definition ({name_of(opcode)}) of {place.length} bytes"
                walk.report.lose(Loss(reason, 0, place.length, offset=place.offset))
                return
            content = self._at(place.offset + HEAD.size, place.length - HEAD.size)
            self._define(walk, opcode, content, place.offset, place)

    def _define(
        self,
        walk: _FileWalk,
        opcode: int,
        content: memoryview,
        offset: int,
        place: RecordPlace | None = None,
    ) -> None:
        """Add a schema, channel or metadata record of the file. A malformed record is reported."""
        try:
            odd = self._take_up(opcode, content, place)
        except READ_ERRORS as error:
            reason = f"a definition ({name_of(opcode)}) is malformed: {error!r}"
            walk.report.lose(Loss(reason, 0, len(content), offset=offset))
            return
        if odd and odd not in walk.report.warnings:
            walk.report.warnings.append(odd)

    def _take_up(self, opcode: int, content: memoryview, place: RecordPlace | None = None) -> str:
        """Add a schema, channel or metadata record to the file object. Return a warning, or an empty text."""
        stream = StrictStream(content)
        if opcode == Opcode.METADATA and place is not None:
            if place not in self.metadata:
                self._weigh(len(content))
                self.metadata[place] = Metadata.read(stream)
            return ""
        record = Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream)
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if record.id not in known:
            self._weigh(len(content))
            known[record.id] = record
            if isinstance(record, Channel):
                self._known_channels[record.id] = True
        elif known[record.id] != record:
            return (
                f"{name_of(opcode)} {record.id} is defined twice, differently; the first one counts"
            )
        return ""

    def _weigh(self, length: int) -> None:
        self._definition_bytes += length
        if self._definition_bytes > MAX_DEFINITIONS:
            reason = f"more than {MAX_DEFINITIONS} bytes of schemas, channels and metadata"
            raise TraceError(reason, path=self.path)

    def _at(self, position: int, length: int) -> memoryview:
        """Return bytes of the file at a position.

        Raises
        ------
        TraceError
            The file has become shorter since it was opened.
        """
        self._file.seek(position)
        data = self._file.read(length)
        if len(data) != length:
            raise TraceError("the file became shorter while it was read", path=self.path)
        return memoryview(data)


# Bag: several MCAP files of one recording, split by rosbag2.


class McapBag(McapFile):
    """Reader of a bag (folder of MCAP files) as one recording. Byte positions count through all files.

    Parameters
    ----------
    path : Path
        The folder, or the ``metadata.yaml`` in it.

    Attributes
    ----------
    path, size, mtime_ns
        The folder; the total size of its files, and their latest modification time.
    others
        As in :class:`McapFile`, for all files together. Channels of two files are the same if their topics,
        encodings and definitions are equal. Several such channels of a file have the same order in all files,
        or the same ids. A channel has the id of the first file that contains it, or a new id if that one
        belongs to another channel.

    Raises
    ------
    TraceError
        The metadata are unreadable, or no listed file is an MCAP file.
    """

    def __init__(self, path: Path, spool: Spool | None = None) -> None:
        self._begin(spool)
        self.path = path.parent if path.name == METADATA else path
        self.size, self.mtime_ns = mark_of(self.path)
        self.counts = {}
        self._parts = parts_of(self.path)
        self._files: dict[int, McapFile] = {}
        self._open_files: list[McapFile] = []
        self._faults: list[Loss] = []
        self._schema_ids: dict[tuple[Any, ...], int] = {}
        self._channel_ids: dict[tuple[Any, ...], list[int]] = {}
        self._own: dict[tuple[Path, int], int] = {}
        self._told: dict[Path, tuple[int, int, int]] = {}
        for part in self._parts:
            self._open(part)
        if not self._files:
            raise TraceError(self._faults[0].reason, path=self.path)
        first = next(iter(self._files.values()))
        self.profile, self.library = first.profile, first.library

    def _open(self, part: BagPart) -> None:
        """Read the schemas, channels and summary of one file of the bag.

        The file is open only during the reading.
        """
        name = part.path.name
        if part.size < 0:
            self._faults.append(Loss(f"{name}: {METADATA} lists it, but the file is missing"))
            return
        try:
            file = McapFile(part.path, self._spool)
        except TraceError as error:
            self._faults.append(Loss(f"{name}: {error.reason}", bytes=part.size, offset=part.base))
            return
        file.close()
        self._files[part.base] = file
        self._learn(file)
        if self.counts is None or file.counts is None:
            self.counts = None
            return
        for number in file.counts.keys() & file.channels.keys():
            own = self._own[file.path, number]
            self.counts[own] = self.counts.get(own, 0) + file.counts[number]

    def close(self) -> None:
        """Close all files of the bag."""
        for file in self._files.values():
            file.close()
        if self._own_spool:
            self._spool.close()

    @property
    def compression(self) -> str:
        """Compression name of the bag's first chunk, such as ``lz4``; ``zstd`` before a chunk was read."""
        return next(iter(self._files.values())).compression

    def _in_file_order(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None,
        keep: Callable[[int], bool] | None,
        start: int = 0,
    ) -> Generator[Messages]:
        """Yield all messages of the bag, file by file."""
        del start  # A bag is always read from the start.
        report.losses += self._faults
        for base, file in self._files.items():
            found = Findings()
            here = None if wanted is None else _moved(wanted, base)
            kept = None if keep is None else self._meant(keep, file)
            file.reopen()
            try:
                for run in file.walk(found, here, kept):
                    self._learn(file)
                    yield self._placed(file, run, base)
                self._learn(file)
            finally:
                file.close()
                _take_up(found, report, file.path.name, base)

    def _again(self, place: int, count: int) -> Messages:
        """Read a group of messages of one file of the bag again."""
        part = part_at(self._parts, place)
        if part is None or part.base not in self._files:
            raise TraceError("the bag's files are missing", path=self.path, offset=place)
        file, base = self._files[part.base], part.base
        self._use(file)
        messages = self._placed(file, file._again(place - base, count), base)  # noqa: SLF001  (its own class)

        def read(position: int, length: int) -> memoryview:
            self._use(file)
            return messages.read(position, length)

        return replace(messages, read=read)

    def _use(self, file: McapFile) -> None:
        """Open a file of the bag, and close files that were not used recently."""
        if file in self._open_files:
            self._open_files.remove(file)
        self._open_files.append(file)
        file.reopen()
        for other in self._open_files[:-MOST_OPEN]:
            other.close()
        del self._open_files[:-MOST_OPEN]

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """Yield the bytes of a record of the bag in pieces."""
        part = part_at(self._parts, place.offset)
        if part is None or part.base not in self._files:
            raise TraceError("the bag's files are missing", path=self.path, offset=place.offset)
        file = self._files[part.base]
        file.reopen()
        try:
            yield from file.pieces(RecordPlace(place.offset - part.base, place.length))
        finally:
            file.close()

    def _learn(self, file: McapFile) -> None:
        """Add the new channels, schemas and other records of a file to the bag."""
        told = len(file.channels), len(file.metadata), len(file.attachments)
        if self._told.get(file.path) == told:
            return
        self._told[file.path] = told
        alike: dict[tuple[Any, ...], list[int]] = {}
        for number, channel in sorted(file.channels.items()):
            alike.setdefault(_key_of(channel, file), []).append(number)
        for key, numbers in alike.items():
            for number in numbers:
                if (file.path, number) not in self._own:
                    self._own[file.path, number] = self._take(number, file, key, numbers)
        base = next(base for base, one in self._files.items() if one is file)
        for place, record in file.metadata.items():
            self.metadata.setdefault(RecordPlace(place.offset + base, place.length), record)
        known = set(self.attachments)
        moved = (RecordPlace(place.offset + base, place.length) for place in file.attachments)
        self.attachments += [place for place in moved if place not in known]

    def _take(self, number: int, file: McapFile, key: tuple[Any, ...], alike: list[int]) -> int:
        """Return the channel id in the bag for a channel of one file. Add the channel if it is new.

        ``alike``: the file's channels with this key.
        """
        known = self._channel_ids.setdefault(key, [])
        if {*alike} <= {*known}:
            return number
        taken = {self._own.get((file.path, other)) for other in alike}
        free = [one for one in known if one not in taken]
        if free:
            return free[0]
        channel = file.channels[number]
        number, schema_id = self._free(channel.id, self.channels), 0
        schema = file.schemas.get(channel.schema_id)
        if schema is not None:
            new = self._free(schema.id, self.schemas)
            schema_id = self._schema_ids.setdefault(key[2:], new)
            self.schemas.setdefault(schema_id, replace(schema, id=schema_id))
        self.channels[number] = replace(channel, id=number, schema_id=schema_id)
        known.append(number)
        return number

    def _free(self, number: int, taken: dict[int, Any]) -> int:
        """Return the given channel id if the bag does not use it yet; otherwise the next unused id."""
        free = number if number not in taken else max(taken) + 1
        if free >= IDS:  # The limit applies to all files together.
            raise TraceError(f"more than {IDS} channels or schemas", path=self.path)
        return free

    def _meant(self, keep: Callable[[int], bool], file: McapFile) -> Callable[[int], bool]:
        """Convert a filter of channel ids in the bag to a filter of channel ids in one of its files."""
        return lambda number: keep(self._own[file.path, number])

    def _placed(self, file: McapFile, run: Messages, base: int) -> Messages:
        """Return messages of one file with the channel ids and byte positions of the whole bag."""
        ids, index = np.unique(run.channel, return_inverse=True)
        own = np.array([self._own[file.path, number] for number in ids.tolist()], np.int64)
        if run.chunk_offset >= 0:
            return replace(run, chunk_offset=run.chunk_offset + base, channel=own[index])

        def read(place: int, length: int) -> memoryview:
            return run.read(place - base, length)

        return replace(run, channel=own[index], offset=run.offset + base, read=read)


def _all(_channel: int) -> bool:
    return True


def _key_of(channel: Channel, file: McapFile) -> tuple[Any, ...]:
    """Return the key of a channel. Channels of two files with equal keys become one channel in the bag."""
    schema = file.schemas.get(channel.schema_id)
    definition = (schema.name, schema.encoding, schema.data) if schema else ()
    return channel.topic, channel.message_encoding, *definition


def _moved(wanted: Callable[[int], bool], base: int) -> Callable[[int], bool]:
    return lambda offset: wanted(offset + base)


def _take_up(found: Findings, report: Findings, name: str, base: int) -> None:
    """Add the losses and warnings of one file to the report of the bag."""
    report.warnings += [f"{name}: {warning}" for warning in found.warnings]
    for loss in found.losses[: max(MAX_LOSSES - len(report.losses), 1)]:
        place = loss.offset + base if loss.offset >= 0 else -1
        report.losses.append(replace(loss, reason=f"{name}: {loss.reason}", offset=place))
