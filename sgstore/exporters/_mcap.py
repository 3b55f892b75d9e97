"""Export format ``mcap``: the recorded messages of each clip, with the messages needed for its context.

A clip has the schemas, channels, metadata and attachments of its source, and its messages with
their bytes, times and sequence numbers; ids of schemas and channels are renumbered. Messages that
later ones depend on (the map, static data that is sent once) are copied from before its start. The
metadata record ``sgstore.clip`` has the interval of the clip, so that a reader treats them as
context and not as frames. With ``rebase_context`` their log times are a nanosecond outside the
interval, so that players do not show the gap. The same clip of the same source gives the same
bytes.

A recording is read once completely, to index it, and then once for each of its clips, only in the
range of the clip. At most one chunk or attachment is in memory.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Final

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from sgstore.base.temporary_folders import working_folder
from sgstore.errors import ExportError
from sgstore.exporters._clips import ChannelCount, WrittenClip, clip_name, tool
from sgstore.exporters._mcap_graphs import Added, is_added
from sgstore.exporters._viewer_layout import LAYOUT, layout
from sgstore.mcap import CLIP, HEAD, READ_ERRORS, Loss, OutOfOrder, digest_of, near
from sgstore.model.world import Clip, TraceReport, tolerance_ns
from sgstore.readers import channel_rank, open_recording

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator
    from pathlib import Path

    from mcap.records import Channel
    from numpy.typing import NDArray

    from sgstore.exporters._clip_frames import Export
    from sgstore.exporters._mcap_graphs import ClipMessage
    from sgstore.mcap import Messages
    from sgstore.model.world import MessageRefs
    from sgstore.readers import RecordingFile
    from sgstore.store import StoredTrace


_COMPRESSION: Final = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "": CompressionType.NONE,
}
_FIXED: Final = 8 + 8 + 4 + 4 + 8 + 4
"""Size of an attachment record without its texts and its data; bytes."""
_MALFORMED: Final = "an attachment is malformed and was left out"
_DAMAGED: Final = "the checksum of an attachment does not match"


def write(export: Export, folder: Path) -> list[WrittenClip]:
    """Write each clip of an export as an MCAP file, cut from its recording.

    With ``with_graph`` or labels, every clip has additional channels: see
    :mod:`sgstore.exporters._mcap_graphs`. With graphs there is also a viewer layout.
    """
    if export.mounts and not export.with_graph:
        raise ExportError("--mount needs clips with graphs; add --with-graph")
    added = Added(export) if export.with_graph or export.labels is not None else None
    written: dict[int, WrittenClip] = {}
    ego = ""
    for name in dict.fromkeys(clip.trace for clip in export.clips):
        trace = export.trace(name)
        with _near(trace.path), open_recording(trace.path) as recording:
            source = _survey(recording, trace, export.store.file.context(name))
            owns = export.own_numbers()
            for number, clip in enumerate(export.clips, 1):
                if clip.trace == name:
                    cutting = _Cutting(
                        recording,
                        source,
                        clip,
                        dict(export.provenance),
                        added,
                        rebased=export.rebase_context,
                    )
                    file = folder / clip_name(name, owns[number - 1], ".mcap")
                    written[number] = cutting.write(file, number)
                    export.tell(len(written), len(export.clips))
        ego = ego or (added.transforms.ego if added is not None else "")
    if export.with_graph:
        channels = [one for number in sorted(written) for one in written[number].messages]
        text = layout(channels, ego)
        (folder / LAYOUT).write_text(text, encoding="utf-8", errors="backslashreplace")
    return [written[number] for number in sorted(written)]


@contextmanager
def _near(path: Path) -> Generator[None]:
    """Context manager with a local copy of a remote recording, because it is read several times."""
    with working_folder("recording") as held, near(path, held):
        yield


@dataclass(slots=True)
class _Surveyed:
    """Index of a recording: its digest, and the time ranges of its chunks.

    ``context``: messages that later ones depend on. ``spans``: offset of each chunk → least and
    greatest log time. ``losses``: unreadable parts.
    """

    trace: StoredTrace
    context: MessageRefs
    digest: str
    spans: dict[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]])
    losses: list[Loss] = field(default_factory=list[Loss])


def _survey(recording: RecordingFile, trace: StoredTrace, context: MessageRefs) -> _Surveyed:
    digest = digest_of(trace.path)
    if trace.digest and digest != trace.digest:
        raise ExportError(f"{trace.path}: the file has changed since it was ingested")
    found = _Surveyed(trace, context, digest)
    for rank in (
        channel_rank(recording),
        None,
    ):  # the second condition covers messages out of time order
        report = TraceReport()
        found.spans.clear()
        with suppress(OutOfOrder):
            for run in recording.walk(report, rank=rank):
                first, last = int(run.log_time_ns.min()), int(run.log_time_ns.max())
                known = found.spans.get(run.chunk_offset, (first, last))
                found.spans[run.chunk_offset] = (min(first, known[0]), max(last, known[1]))
            found.losses = report.losses
            break
    return found


def _context_of(
    refs: MessageRefs, reach: Clip
) -> tuple[dict[int, list[int]], set[tuple[int, int]]]:
    """Return messages outside a clip that the clip's frames need, such as the road map.

    Context from before the start is included. If the context of a channel begins only after the
    end, as for a map that is recorded last, its first message is included, unless the clip has
    other messages of the channel.

    Returns
    -------
    context : dict
        Chunk → offsets of the messages in it.
    late : set
        Chunk and offset of the messages after the interval.
    """
    carried = refs.log_time_ns < reach.start_ns
    late: set[tuple[int, int]] = set()
    for channel in np.unique(refs.channel):
        rows = np.flatnonzero(refs.channel == channel)
        if (refs.log_time_ns[rows] > reach.end_ns).all():
            carried[rows[0]] = True
            late.add((int(refs.chunk_offset[rows[0]]), int(refs.offset[rows[0]])))
    context: dict[int, list[int]] = {}
    for row in np.flatnonzero(carried):
        context.setdefault(int(refs.chunk_offset[row]), []).append(int(refs.offset[row]))
    return context, late


class _Cutting:
    """Writer of one clip as an MCAP file.

    The official writer numbers schemas and channels from 1 in order of registration. ``_numbers``
    maps the numbers of the source to them.
    """

    def __init__(
        self,
        recording: RecordingFile,
        source: _Surveyed,
        clip: Clip,
        told: dict[str, str],
        added: Added | None,
        *,
        rebased: bool = False,
    ) -> None:
        self._rebased = rebased
        self._recording = recording
        self._source = source
        self._clip = clip
        self._told = told
        self._added = added
        # All channels of the source, except those that this clip writes anew.
        self._kept = {
            number: channel
            for number, channel in sorted(recording.channels.items())
            if added is None or not is_added(channel)
        }
        self._schemas = {0: 0}
        self._numbers: dict[int, int] = {}
        self._counts: dict[int, int] = {}
        self._carried = 0
        self._first: int | None = None

    def write(self, file: Path, number: int) -> WrittenClip:
        """Write the clip to a file, verify the file, and return its description."""
        clip, source, recording = self._clip, self._source, self._recording
        losses = [
            loss
            for loss in source.losses
            if loss.start_ns < 0 or (loss.start_ns <= clip.end_ns and loss.end_ns >= clip.start_ns)
        ]
        with file.open("xb") as stream:
            compression = _COMPRESSION[recording.compression]
            self._writer = Writer(stream, compression=compression, enable_data_crcs=True)
            self._writer.start(recording.profile, tool())
            reach = clip.widened(tolerance_ns(source.trace.period_ns))
            losses += self._write_head(reach)
            self._write_messages(reach, number)
            self._writer.finish()
        if sum(self._counts[channel] for channel in self._kept) == self._carried:
            spans = source.spans.values()
            start, end = (
                min((s[0] for s in spans), default=0),
                max((s[1] for s in spans), default=0),
            )
            raise ExportError(
                f"{source.trace.path}: no message between {clip.start_ns} and {clip.end_ns} ns;"
                f" the recording has them from {start} to {end} ns"
            )
        _validate(file, Counter({self._numbers[n]: k for n, k in self._counts.items() if k}))
        more = () if self._added is None else self._added.channels()
        return WrittenClip(
            file=file,
            sha256=digest_of(file),
            trace=clip.trace,
            source=source.trace.path.name,
            source_sha256=source.digest,
            start_ns=clip.start_ns,
            end_ns=clip.end_ns,
            messages=tuple(
                ChannelCount(number, topic, schema, self._counts[number])
                for number, topic, schema in (*self._own_channels(), *more)
            ),
            context=self._carried,
            first_ns=clip.start_ns if self._first is None else self._first,
            losses=tuple(losses),
            provenance=self._told,
        )

    def _own_channels(self) -> Iterator[tuple[int, str, str]]:
        """Yield the number, topic and schema name of each channel of the recording."""
        for number, channel in self._kept.items():
            schema = self._recording.schemas.get(channel.schema_id)
            yield number, channel.topic, schema.name if schema else ""

    def _write_head(self, reach: Clip) -> list[Loss]:
        """Write the schemas, channels, metadata and attachments of the recording. Return the losses.

        ``reach`` is the interval with a time tolerance at its ends, as readers of the clip need it.
        """
        losses: list[Loss] = []
        recording = self._recording
        for _, schema in sorted(recording.schemas.items()):
            self._define(schema)
        for channel in self._kept.values():
            self._define(channel)
        if self._added is not None:
            for record in self._added.definitions(recording.schemas, recording.channels):
                self._define(record)
        for place in sorted(recording.metadata, key=lambda place: place.offset):
            record = recording.metadata[place]
            if record.name != CLIP:  # the clip record of a source clip is replaced
                self._writer.add_metadata(record.name, record.metadata)
        own = {
            "trace": self._clip.trace,
            "start_ns": str(reach.start_ns),
            "end_ns": str(reach.end_ns),
            "source": self._source.trace.path.name,
            "source_sha256": self._source.digest,
            "context": "messages outside start_ns..end_ns, such as the map, are no frames of the clip",
        }
        self._writer.add_metadata(CLIP, {**self._told, **own})
        for place in recording.attachments:
            reason = self._write_attachment(recording.pieces(place))
            if reason:
                losses.append(Loss(reason, 0, place.length, offset=place.offset))
        return losses

    def _define(self, record: Schema | Channel) -> None:
        """Write the definition of a schema or a channel into the MCAP file."""
        if isinstance(record, Schema):
            number = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = number
            return
        schema = self._schemas.get(record.schema_id, 0)
        self._numbers[record.id] = self._writer.register_channel(
            record.topic, record.message_encoding, schema, record.metadata
        )
        self._counts[record.id] = 0

    def _write_attachment(self, pieces: Iterable[memoryview]) -> str:
        """Copy an attachment of the recording. Return its fault as text; empty if it has none.

        Returns
        -------
        str
            Its defect, or empty. A malformed attachment is not written.
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
        del stream  # free one copy of a large attachment before it is written
        self._writer.add_attachment(
            one.create_time, one.log_time, one.name, one.media_type, one.data
        )
        return _DAMAGED if damaged else ""

    def _write_messages(self, reach: Clip, number: int) -> None:
        """Write the recorded messages of the clip, and the added messages, in order of log time."""
        added = () if self._added is None else self._added.messages(number)
        every = heapq.merge(self._messages(reach), added, key=lambda message: message[2])
        for channel, sequence, log_time, publish_time, data in every:
            own = self._numbers[channel]
            self._first = log_time if self._first is None else self._first
            self._writer.add_message(own, log_time, bytes(data), publish_time, sequence)
            self._counts[channel] += 1

    def _messages(self, reach: Clip) -> Iterator[ClipMessage]:
        """Yield the recorded messages of the clip in order of time. Also count the context messages.

        A source without log times keeps the order of its file: while its clock runs backwards, log
        times stay constant.
        """
        context, late = _context_of(self._source.context, reach)
        chunks = set(context) | {
            chunk
            for chunk, (first, last) in self._source.spans.items()
            if first <= reach.end_ns and last >= reach.start_ns
        }
        rank, latest = channel_rank(self._recording), -1
        for run in self._recording.walk(TraceReport(), chunks.__contains__, rank=rank):
            time = run.log_time_ns
            inside = (time >= reach.start_ns) & (time <= reach.end_ns)
            carried = _among(run, context) & ~inside
            for row in np.flatnonzero(inside | carried).tolist():
                channel = int(run.channel[row])
                behind = (run.chunk_of(row), int(run.offset[row])) in late
                if channel not in self._kept or (behind and self._counts[channel]):
                    continue
                self._carried += bool(carried[row])
                log_time = int(time[row])
                if carried[row] and self._rebased:
                    # A nanosecond outside the clip: readers still treat it as context.
                    log_time = reach.end_ns + 1 if behind else reach.start_ns - 1
                elif inside[row]:
                    log_time = latest = max(log_time, latest)
                times = log_time, int(run.publish_time_ns[row])
                yield (channel, int(run.sequence[row]), *times, run.data(row))


def _among(run: Messages, places: dict[int, list[int]]) -> NDArray[np.bool_]:
    """True for each message whose position is in ``places`` (chunk offset → message offsets)."""
    chunks, found = run.chunks, np.zeros(len(run), np.bool_)
    for chunk in np.unique(chunks).tolist():
        found |= (chunks == chunk) & np.isin(run.offset, places.get(chunk, ()))
    return found


def _validate(file: Path, expected: Counter[int]) -> None:
    """Read a written clip with the official MCAP reader, or raise an error for a wrong message count.

    Parameters
    ----------
    file : Path
    expected : Counter
        Channel id in the file → number of written messages, without empty channels.

    Raises
    ------
    ExportError
        The content differs from the written messages.
    """
    try:
        with file.open("rb") as stream:
            records = StreamReader(stream, validate_crcs=True).records
            in_order = Counter(one.channel_id for one in records if isinstance(one, Message))
            stream.seek(0)
            found = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
            by_index = Counter(channel.id for _, channel, _ in found)
    except (McapError, struct.error, ValueError, LookupError, RuntimeError) as error:
        reason = f"{file.name}: the written file cannot be read back: {error!r}"
        raise ExportError(reason) from error
    if not in_order == by_index == expected:
        raise ExportError(
            f"{file.name}: {expected.total()} messages were written,"
            f" {in_order.total()} and {by_index.total()} are read back"
        )
