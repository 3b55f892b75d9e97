"""Clips as MCAP files: the messages of an interval as they were recorded, and what they depend on.

A clip has the schemas, channels, metadata and attachments of its source, and its messages with their
bytes, times and sequence numbers; ids of schemas and channels are numbered anew. Messages that later ones
depend on (the map, static data that was told only once) are carried in from before its start. The metadata
record ``sgstore.clip`` says which interval the clip is, so that a reader takes them for context and not for
frames. The same clip of the same source is the same bytes.

A recording is read once as a whole, to see where everything is, and then once for each of its clips,
only where that clip is; no more than one chunk, or one attachment, of it is in memory.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from sgstore.errors import ExportError
from sgstore.exporters._clips import (
    ChannelCount,
    ClipSource,
    WrittenClip,
    clip_name,
    export_folder,
    provenance_of,
    tool,
    write_manifest,
)
from sgstore.exporters._mcap_graphs import Added, Waiting, is_added
from sgstore.exporters._mcap_writer import ClipWriter
from sgstore.mcap import CLIP, Loss, McapFile, digest_of
from sgstore.readers import open_recording
from sgstore.world import Clip, TraceReport

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from mcap.records import Channel

    from sgstore.exporters._labels import Export
    from sgstore.mcap import Messages
    from sgstore.readers import OsiFile
    from sgstore.world import Bools, Ints


def write(export: Export, folder: Path) -> list[WrittenClip]:
    """Cut the clips of an export out of their recordings; see :func:`write_clips`.

    With ``with_graph`` or labels, every clip has channels more: see :mod:`sgstore.exporters._mcap_graphs`.
    """
    added = Added(export) if export.with_graph or export.labels is not None else None
    return _write_into(
        folder, export.clips, export.sources(), dict(export.provenance), added, export.tell
    )


def write_clips(
    clips: Sequence[Clip],
    sources: Mapping[str, ClipSource],
    to: Path,
    *,
    provenance: Mapping[str, str] | None = None,
) -> list[WrittenClip]:
    """Cut clips out of recordings and write them, with a ``manifest.json``, into a folder.

    Parameters
    ----------
    clips : sequence of Clip
        Log times, both ends included; intervals may overlap.
    sources : mapping
        Name of a trace → its recording.
    to : Path
        Made if it does not exist. Nothing in it is overwritten.
    provenance : mapping, optional
        What is to be known of the clips: ``query``, and whatever else the caller has.

    Returns
    -------
    list of WrittenClip
        In the order of ``clips``.

    Raises
    ------
    ExportError
        A clip is of no source, of one that has changed, or has no message; a file is in the way; the folder
        cannot be written; or what was written does not stand the test of the official reader. Then nothing
        is left behind.
    TraceError
        A recording cannot be read.
    """
    told = provenance_of(dict(provenance or {}))
    for clip in clips:
        if clip.trace not in sources:
            known = ", ".join(sorted(sources)) or "none"
            raise ExportError(f"no recording is known for the trace {clip.trace!r}; known: {known}")
        if clip.start_ns > clip.end_ns:
            raise ExportError(
                f"a clip of {clip.trace!r} ends at {clip.end_ns} ns, before its start"
            )
    with export_folder(to, _names(clips)) as folder:
        result = _write_into(folder, clips, sources, told)
        write_manifest(folder, result)
    return [_moved(clip, to) for clip in result]


def _names(clips: Sequence[Clip]) -> list[str]:
    return [clip_name(clip.trace, number, ".mcap") for number, clip in enumerate(clips, 1)]


def _write_into(
    folder: Path,
    clips: Sequence[Clip],
    sources: Mapping[str, ClipSource],
    told: dict[str, str],
    added: Added | None = None,
    tell: Callable[[int, int], None] | None = None,
) -> list[WrittenClip]:
    """Clips in the order in which they were asked for, written recording by recording."""
    names = _names(clips)
    written: dict[int, WrittenClip] = {}
    for trace in dict.fromkeys(clip.trace for clip in clips):
        with open_recording(sources[trace].path) as recording:
            source = _survey(recording, sources[trace])
            for number, clip in enumerate(clips):
                if clip.trace != trace:
                    continue
                cutting = _Cutting(recording, source, clip, told, added, number + 1)
                written[number] = cutting.write(folder / names[number])
                if tell is not None:
                    tell(len(written), len(clips))
    return [written[number] for number in range(len(clips))]


@dataclass(slots=True)
class _Surveyed:
    """A recording that was read once: its digest, and where which times are.

    ``spans``: offset of each chunk → least and greatest log time in it. ``losses``: what could not be read.
    """

    source: ClipSource
    digest: str
    spans: dict[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]])
    losses: list[Loss] = field(default_factory=list[Loss])
    start_ns: int = 0
    end_ns: int = 0

    def losses_within(self, clip: Clip) -> list[Loss]:
        """Losses that lie in an interval, or may lie in it."""
        return [
            loss
            for loss in self.losses
            if loss.start_ns < 0 or (loss.start_ns <= clip.end_ns and loss.end_ns >= clip.start_ns)
        ]


def _survey(recording: McapFile | OsiFile, source: ClipSource) -> _Surveyed:
    digest = digest_of(source.path)
    if source.digest and digest != source.digest:
        raise ExportError(f"{source.path}: the file has changed since it was ingested")
    found = _Surveyed(source, digest)
    report = TraceReport()
    for run in recording.walk(report):
        first, last = int(run.log_time_ns.min()), int(run.log_time_ns.max())
        known = found.spans.get(run.chunk_offset, (first, last))
        found.spans[run.chunk_offset] = (min(first, known[0]), max(last, known[1]))
    found.losses = report.losses
    if found.spans:
        found.start_ns = min(span[0] for span in found.spans.values())
        found.end_ns = max(span[1] for span in found.spans.values())
    return found


@dataclass(slots=True)
class _Cut:
    """Messages of a recording that belong to a clip.

    ``context``: chunk → offsets of the messages in it that are carried in from outside the interval;
    ``late``: those of them that come behind it, and are needed only if nothing else of their channel is
    there; ``chunks``: where to look for messages at all.
    """

    clip: Clip
    context: dict[int, list[int]]
    late: set[tuple[int, int]]
    chunks: set[int]

    @classmethod
    def of(cls, clip: Clip, found: _Surveyed) -> _Cut:
        """The cut of a clip.

        Context from before the start belongs to it. Where a channel's context begins only after the end, as
        a map that was recorded last, its first message does.
        """
        refs = found.source.context
        carried = refs.log_time_ns < clip.start_ns
        late: set[tuple[int, int]] = set()
        for channel in np.unique(refs.channel):
            rows = np.flatnonzero(refs.channel == channel)
            if (refs.log_time_ns[rows] > clip.end_ns).all():
                carried[rows[0]] = True
                late.add((int(refs.chunk_offset[rows[0]]), int(refs.offset[rows[0]])))
        context: dict[int, list[int]] = {}
        for row in np.flatnonzero(carried):
            context.setdefault(int(refs.chunk_offset[row]), []).append(int(refs.offset[row]))
        within = {
            chunk
            for chunk, (first, last) in found.spans.items()
            if first <= clip.end_ns and last >= clip.start_ns
        }
        return cls(clip, context, late, within | set(context))

    def rows(self, run: Messages) -> tuple[Ints, Bools]:
        """Rows of some messages that belong to the clip, and which of these are context."""
        time = run.log_time_ns
        inside = (time >= self.clip.start_ns) & (time <= self.clip.end_ns)
        context = np.isin(run.offset, self.context.get(run.chunk_offset, ())) & ~inside
        rows = np.flatnonzero(inside | context)
        return rows, context[rows]


@dataclass(slots=True)
class _Cutting:
    """One clip on its way into a file. ``number``: of the clip in its export, counted from 1."""

    recording: McapFile | OsiFile
    found: _Surveyed
    clip: Clip
    told: dict[str, str]
    added: Added | None
    number: int

    def write(self, file: Path) -> WrittenClip:
        """Write it, test it, and tell of it."""
        losses = self.found.losses_within(self.clip)
        with file.open("xb") as stream:
            recording = self.recording
            writer = ClipWriter(stream, recording.profile, tool(), recording.compression)
            reach = self.clip.widened(self.found.source.tolerance_ns)
            losses += self._write_head(writer, reach)
            context = self._write_messages(writer, _Cut.of(reach, self.found))
            writer.finish()
        own = {n: k for n, k in writer.counts.items() if n in recording.channels}
        if sum(own.values()) == context:
            raise ExportError(
                f"{self.found.source.path}: no message between {self.clip.start_ns} and {self.clip.end_ns} ns;"
                f" the recording has them from {self.found.start_ns} to {self.found.end_ns} ns"
            )
        _validate(file, {writer.numbers[n]: k for n, k in writer.counts.items() if k})
        return WrittenClip(
            file=file,
            sha256=digest_of(file),
            trace=self.clip.trace,
            source=self.found.source.path.name,
            source_sha256=self.found.digest,
            start_ns=self.clip.start_ns,
            end_ns=self.clip.end_ns,
            messages=(
                *_counts(recording, self._kept(), writer.counts),
                *self._counts_added(writer.counts),
            ),
            context=context,
            losses=tuple(losses),
            provenance=self.told,
        )

    def _write_head(self, writer: ClipWriter, reach: Clip) -> list[Loss]:
        """Definitions, metadata and attachments of the source, and what makes the file a clip of it.

        ``reach`` is the interval with the tolerance of times at its ends, as whoever reads the clip wants it.
        """
        losses: list[Loss] = []
        recording = self.recording
        for _, schema in sorted(recording.schemas.items()):
            writer.define(schema)
        for _, channel in sorted(self._kept().items()):
            writer.define(channel)
        if self.added is not None:
            for record in self.added.definitions(recording.schemas, recording.channels):
                writer.define(record)
        for place in sorted(recording.metadata, key=lambda place: place.offset):
            record = recording.metadata[place]
            if record.name != CLIP:  # of a source that is a clip itself: this one takes its place
                writer.metadata(record.name, record.metadata)
        own = {
            "trace": self.clip.trace,
            "start_ns": str(reach.start_ns),
            "end_ns": str(reach.end_ns),
            "source": self.found.source.path.name,
            "source_sha256": self.found.digest,
        }
        writer.metadata(CLIP, {**self.told, **own})
        for place in recording.attachments:
            reason = writer.attachment(recording.pieces(place))
            if reason:
                losses.append(Loss(reason, 0, place.length, offset=place.offset))
        return losses

    def _kept(self) -> dict[int, Channel]:
        """Channels of the source: all, but for those that this clip brings anew."""
        channels = dict(self.recording.channels)
        if self.added is None:
            return channels
        return {number: channel for number, channel in channels.items() if not is_added(channel)}

    def _counts_added(self, counts: dict[int, int]) -> list[ChannelCount]:
        if self.added is None:
            return []
        return [
            ChannelCount(n, topic, schema, counts[n]) for n, topic, schema in self.added.channels()
        ]

    def _write_messages(self, writer: ClipWriter, cut: _Cut) -> int:
        """The messages of a clip, and what is added to them; returns how many of them are context."""
        carried, kept = 0, self._kept()
        more = () if self.added is None else self.added.messages(self.number)
        waiting = Waiting(writer, more)
        for run in self.recording.walk(TraceReport(), cut.chunks.__contains__):
            for row, context in zip(*cut.rows(run), strict=True):
                channel = int(run.channel[row])
                late = (run.chunk_offset, int(run.offset[row])) in cut.late
                if channel not in kept or (late and writer.counts[channel]):
                    continue
                carried += bool(context)
                log_time = int(run.log_time_ns[row])
                waiting.write_before(log_time)
                writer.message(
                    channel,
                    int(run.sequence[row]),
                    log_time,
                    int(run.publish_time_ns[row]),
                    run.data(int(row)),
                )
        waiting.write_rest()
        return carried


def _counts(
    recording: McapFile | OsiFile, channels: Mapping[int, Channel], counts: dict[int, int]
) -> tuple[ChannelCount, ...]:
    result: list[ChannelCount] = []
    for number, channel in sorted(channels.items()):
        schema = recording.schemas.get(channel.schema_id)
        name = schema.name if schema else ""
        result.append(ChannelCount(number, channel.topic, name, counts[number]))
    return tuple(result)


def _moved(clip: WrittenClip, to: Path) -> WrittenClip:
    return replace(clip, file=to / clip.file.name)


def _validate(file: Path, expected: dict[int, int]) -> None:
    """Read a clip with the official reader, in order and by its indexes.

    Parameters
    ----------
    file : Path
    expected : dict
        Channel id in the file → messages that were written, if any were.

    Raises
    ------
    ExportError
        It is not what was to be written.
    """
    try:
        with file.open("rb") as stream:
            in_order = _count_in_order(stream)
            stream.seek(0)
            by_index = _count_by_index(stream)
    except (McapError, struct.error, ValueError, LookupError, RuntimeError) as error:
        reason = f"{file.name}: what was written cannot be read back: {error!r}"
        raise ExportError(reason) from error
    if not in_order == by_index == expected:
        raise ExportError(
            f"{file.name}: {sum(expected.values())} messages were written,"
            f" {sum(in_order.values())} and {sum(by_index.values())} are read back"
        )


def _count_in_order(stream: BinaryIO) -> dict[int, int]:
    counts: dict[int, int] = {}
    for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Message):
            counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
    return counts


def _count_by_index(stream: BinaryIO) -> dict[int, int]:
    counts: dict[int, int] = {}
    reader = make_reader(stream, validate_crcs=True)
    for _schema, channel, _message in reader.iter_messages(log_time_order=False):
        counts[channel.id] = counts.get(channel.id, 0) + 1
    return counts
