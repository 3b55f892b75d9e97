"""Recordings of CARLA's ROS bridge: ``ros2 bag record -s mcap`` of ``derived_object_msgs`` and ``carla_msgs``.

They are recognised by the schema of a channel and by nothing else. A frame is one list of objects, in file
order; its time is the simulation's. How messages become frames stands in :mod:`sgstore.readers.carla._frames`.
The road map is the OpenDRIVE text of ``CarlaWorldInfo``, or of a string message that holds one.

The bridge tells where vehicles and walkers are, and nothing else that has a body: signs and props stand in the
list of actors without a place, and are left out; signs come from the road map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from sgstore.errors import MapError, TraceError
from sgstore.mcap import read_and_digest
from sgstore.opendrive import read_map
from sgstore.readers._base import Opened, channels_of, refs_of
from sgstore.readers.carla._actors import LASTING, OBJECTS, content_of
from sgstore.readers.carla._frames import CarlaDecoder
from sgstore.readers.carla._signals import signals_of
from sgstore.readers.carla._survey import CarlaSurvey
from sgstore.world import TraceInfo, TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.mcap import Recording
    from sgstore.roads import RoadMap
    from sgstore.world import FrameBlock


class CarlaTrace(Opened):
    """A recording of CARLA's ROS bridge.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or role name of the ego; empty: the vehicle whose role is ``hero`` or ``ego_vehicle``, or that has
        channels of its own.
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
        The definition of the objects is malformed, no frame can be read, or nothing bears the name given for
        the ego.
    """

    name: ClassVar[str] = "carla"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self._recording = recording
        found, digest = read_and_digest(recording.path, digest, lambda: CarlaSurvey(recording, ego))
        leading = found.leading
        if leading is None:
            lost = found.lost.losses()
            reason = lost[0].reason if lost else "no list of objects can be read"
            raise TraceError(reason, path=recording.path)
        self._survey = found
        self._leading = leading
        self._ego, self._notes = found.egos.settle(found.driven.values())
        self._signals: dict[int, str] = {}
        self._road_map: RoadMap | None = None
        self.on_map(self._own_map())
        self.report = TraceReport()
        channels = channels_of(recording, self._role)
        self.info = TraceInfo(
            path=recording.path,
            size=recording.size,
            mtime_ns=recording.mtime_ns,
            digest=digest,
            flavour=self.name,
            channels=channels,
            ego="" if self._ego is None else str(self._ego),
            map_text=found.map_text,
            map_name=found.map_name,
            context=refs_of(found.context(leading), channels),
        )

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Return whether one of the channels carries lists of objects."""
        return any(content_of(recording, channel) == OBJECTS for channel in recording.channels)

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
        report.losses += self._survey.lost.losses()
        window = self._recording.window
        decoder = CarlaDecoder(
            self._survey,
            self._leading,
            ego=self._ego,
            signals=self._signals,
            road_map=self._road_map,
            window=window,
            report=report,
        )
        topic = self._survey.topic(self._leading)
        yield from self._told(decoder, size, report, topic)

    def on_map(self, road_map: RoadMap | None) -> None:
        """Find the lanes of traffic lights in the road map that the recording is read with."""
        if self._survey.lights and road_map is not None:
            self._road_map = road_map
            self._signals = signals_of(self._survey.lights, road_map)

    def _own_map(self) -> RoadMap | None:
        """The recording's own map, where it has lights to be found in it."""
        if not (self._survey.lights and self._survey.map_text):
            return None
        try:
            return read_map(self._survey.map_text, self._survey.map_name)
        except MapError:  # whoever reads the map for its lanes says so
            return None

    def _role(self, channel: int) -> str:
        if channel == self._leading:
            return "ground_truth"
        return "lasting" if self._survey.contents.get(channel) in LASTING else "payload"
