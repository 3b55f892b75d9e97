"""Recordings of ASAM OSI: ``osi3.GroundTruth`` and ``osi3.SensorView`` messages in MCAP.

They are recognised by the schema of a channel and by nothing else: topics are free, and most files lack
the metadata that the standard asks for. A frame is one message of the leading channel, in file order.
How a message becomes a frame stands in :mod:`sgstore.traces.osi_frames`; the road map is that of an
``osi3.MapAsamOpenDrive`` message, as omega-prime records it.

Source: open-simulation-interface 3.8.0; omega-prime specification.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sgstore.errors import TraceError
from sgstore.traces.fetch import digest_of
from sgstore.traces.frames import assemble, counted
from sgstore.traces.osi_frames import FrameDecoder
from sgstore.traces.osi_schema import GROUND_TRUTH, ROAD_MAP, SENSOR_VIEW
from sgstore.traces.osi_survey import Survey, refs_of, schema_name, survey
from sgstore.world import Channel, MessageRefs, TraceInfo, TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.traces.chunks import Messages
    from sgstore.traces.recording import Recording
    from sgstore.world import FrameBlock, Ints


class OsiTrace:
    """A recording of OSI ground truth.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or name (``entity_name`` of a source reference) of the ego; empty: the host vehicle.
    digest : str
        SHA-256 of the file, if it is known; else the file is hashed.

    Attributes
    ----------
    info : TraceInfo
    report : TraceReport
        Filled while blocks are read.

    Raises
    ------
    TraceError
        The schema is malformed, no frame can be read, or nothing bears the name given for the ego.
    """

    name: ClassVar[str] = "osi"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self._recording = recording
        # The file is hashed beside the first reading, so that it comes from the disk once.
        with ThreadPoolExecutor(1) as beside:
            hashing = None if digest else beside.submit(digest_of, recording.path)
            found = survey(recording, ego)
            digest = hashing.result() if hashing else digest
        leading = found.leading()
        if leading is None:
            topics = [repr(recording.channels[channel].topic) for channel in found.leads]
            where = ", ".join(topics) or "the channels of its schema"
            reason = f"no ground truth message can be read from {where}"
            raise TraceError(reason, path=recording.path)
        self._survey = found
        self._leading = leading
        self.report = TraceReport()
        self.info = self._info(found, digest)

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Whether one of the channels carries OSI ground truth."""
        names = {schema_name(recording, channel) for channel in recording.channels}
        return bool(names & {GROUND_TRUTH, SENSOR_VIEW})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._recording.close()

    def blocks(self, size: int = 60) -> Iterator[FrameBlock]:
        """The frames of the trace, ``size`` at a time; block i begins at frame ``i * size``.

        Raises
        ------
        TraceError
            The file cannot be read any more.
        """
        report = self.report = TraceReport()
        report.warnings += self._survey.notes
        window = self._recording.window
        message = self._survey.leads[self._leading].message
        decoder = FrameDecoder(message, self.info.ego, window, report)
        runs = self._recording.walk(report)
        refs = _Refs(self._index(), window)
        blocks = assemble(runs, size, {self._leading}, decoder, refs)
        yield from counted(blocks, report)
        decoder.settle()
        if not report.frames:
            reason = report.losses[0].reason if report.losses else "it has no messages"
            topic = self._recording.channels[self._leading].topic
            raise TraceError(f"no frame: {reason}", path=self.info.path, channel=topic)

    def _info(self, found: Survey, digest: str) -> TraceInfo:
        recording = self._recording
        counts = recording.counts or {}
        channels: list[Channel] = []
        for number, record in sorted(recording.channels.items()):
            schema = recording.schemas.get(record.schema_id)
            channels.append(
                Channel(
                    id=number,
                    topic=record.topic,
                    schema=schema.name if schema else "",
                    schema_encoding=schema.encoding if schema else "",
                    message_encoding=record.message_encoding,
                    messages=counts.get(number, 0 if counts else -1),
                    role=self._role(number),
                )
            )
        index = {channel.id: i for i, channel in enumerate(channels)}
        return TraceInfo(
            path=recording.path,
            size=recording.size,
            mtime_ns=recording.mtime_ns,
            digest=digest,
            flavour=self.name,
            channels=tuple(channels),
            ego=found.leads[self._leading].ego.settle(),
            map_text=found.map_text,
            map_name=found.map_name,
            context=refs_of(found.context(self._leading), index),
        )

    def _role(self, channel: int) -> str:
        if channel == self._leading:
            return "ground_truth"
        return "map" if schema_name(self._recording, channel) == ROAD_MAP else "payload"

    def _index(self) -> Ints:
        """Channel id → index into the channels of the trace; -1 for those that no frame refers to."""
        index = np.full(1 << 16, -1, np.int64)
        for i, channel in enumerate(self.info.channels):
            index[channel.id] = -1 if channel.role == "map" else i
        return index


class _Refs:
    """References of the messages that belong to frames: not of maps, nor from outside a clip."""

    def __init__(self, index: Ints, window: tuple[int, int]) -> None:
        self._index = index
        self._window = window

    def __call__(self, run: Messages) -> MessageRefs:
        start, end = self._window
        channel = self._index[run.channel]
        kept = (channel >= 0) & (run.log_time_ns >= start) & (run.log_time_ns <= end)
        chunk = np.full(int(kept.sum()), run.chunk_offset, np.int64)
        return MessageRefs(
            channel[kept], run.log_time_ns[kept], chunk, run.offset[kept], run.length[kept]
        )
