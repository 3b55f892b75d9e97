"""Recordings of ASAM OSI: ``osi3.GroundTruth`` and ``osi3.SensorView`` messages in MCAP.

They are recognised by the schema of a channel and by nothing else: topics are free, and most files lack
the metadata that the standard asks for. A frame is one message of the leading channel, in file order.
How a message becomes a frame stands in :mod:`sgstore.readers.osi._frames`; the road map is that of an
``osi3.MapAsamOpenDrive`` message, as omega-prime records it.

Source: open-simulation-interface 3.8.0; omega-prime specification.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from sgstore.errors import TraceError
from sgstore.mcap import read_and_digest
from sgstore.readers._base import Opened, channels_of, refs_of
from sgstore.readers.osi._frames import OsiDecoder
from sgstore.readers.osi._schema import GROUND_TRUTH, ROAD_MAP, SENSOR_VIEW
from sgstore.readers.osi._survey import OsiSurvey, schema_name, survey
from sgstore.world import TraceInfo, TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.mcap import Recording
    from sgstore.world import FrameBlock


class OsiTrace(Opened):
    """A recording of OSI ground truth.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or name (``entity_name`` of a source reference) of the ego; empty: the host vehicle, else what is
        called as egos are.
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
        found, digest = read_and_digest(recording.path, digest, lambda: survey(recording))
        leading = found.leading()
        if leading is None:
            topics = [repr(recording.channels[channel].topic) for channel in found.leads]
            where = ", ".join(topics) or "the channels of its schema"
            reason = f"no ground truth message can be read from {where}"
            raise TraceError(reason, path=recording.path)
        self._survey = found
        self._leading = leading
        self._notes: list[str] = []
        self._ego = found.cast.ego(ego, self._notes)
        self.report = TraceReport()
        self.info = self._info(found, digest)

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Return whether one of the channels carries OSI ground truth."""
        names = {schema_name(recording, channel) for channel in recording.channels}
        return bool(names & {GROUND_TRUTH, SENSOR_VIEW})

    def blocks(self, size: int = 60) -> Iterator[FrameBlock]:
        """The frames of the trace, ``size`` at a time; block i begins at frame ``i * size``.

        Raises
        ------
        TraceError
            The file cannot be read any more.
        """
        report = self.report = TraceReport()
        report.warnings += [*self._survey.notes, *self._notes]
        report.about_ego += self._notes
        decoder = OsiDecoder(self._survey, self._leading, self._ego, report)
        topic = self._recording.channels[self._leading].topic
        yield from self._told(decoder, size, report, topic)

    def _info(self, found: OsiSurvey, digest: str) -> TraceInfo:
        recording = self._recording
        channels = channels_of(recording, self._role)
        return TraceInfo(
            path=recording.path,
            size=recording.size,
            mtime_ns=recording.mtime_ns,
            digest=digest,
            flavour=self.name,
            channels=channels,
            ego="" if self._ego is None else found.cast.idents()[self._ego],
            map_text=found.map_text,
            map_name=found.map_name,
            context=refs_of(found.context(self._leading), channels),
            lost_lanes=tuple(dict.fromkeys(found.lost_lanes)),
        )

    def _role(self, channel: int) -> str:
        if channel == self._leading:
            return "ground_truth"
        return "map" if schema_name(self._recording, channel) == ROAD_MAP else "payload"
