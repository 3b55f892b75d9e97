"""Base classes of all readers of recordings: the first reading of the messages, and the open recording.

A flavour (a format of recordings) has three classes. Its :class:`Survey` reads a recording once and collects
the facts that are needed before the first frame. Its :class:`~sgstore.readers._blocks.MessageDecoder` converts
messages into frames. Its :class:`MessageTrace` stores the facts and returns blocks of frames.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, Self, TypeVar

import numpy as np

from sgstore.base.display import first_of
from sgstore.errors import TraceError
from sgstore.graphs.online import Frame, check_entities
from sgstore.mcap import IDS, Findings, Loss, OutOfOrder, digest_of, read_and_digest
from sgstore.model.noise import ESTIMATED, Noise
from sgstore.model.vocabulary import KINDS, TypeMeaning
from sgstore.model.world import POSE, Channel, Event, MessageRefs, TraceInfo, TraceReport
from sgstore.readers._blocks import (
    FIRST_STEPS,
    FrameRows,
    LossTally,
    MessageDecoder,
    Raw,
    assemble,
    counted,
    first_noise,
    lacks_velocity,
)
from sgstore.readers._roles import channel_rank
from sgstore.readers._stamps import Stamps, late_reason

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.graphs.online import Entity
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import FrameBlock


Key = TypeVar("Key")

LISTED: Final = 20
"""Largest number of names that an error message lists."""

Ref = tuple[int, int, int, int, int]
"""Position of a message: channel id, log time, chunk offset, offset and length."""


def ref_of(run: Messages, row: int) -> Ref:
    """Return the file position of a message: channel id, log time, chunk offset, offset and length."""
    return (
        int(run.channel[row]),
        int(run.log_time_ns[row]),
        run.chunk_of(row),
        int(run.offset[row]),
        int(run.length[row]),
    )


def refs_of(refs: Iterable[Ref], channels: tuple[Channel, ...]) -> MessageRefs:
    """Return file positions of messages as columns, in file order, without duplicates."""
    index = {channel.id: i for i, channel in enumerate(channels)}
    ordered = sorted(set(refs), key=lambda ref: (ref[2] if ref[2] >= 0 else ref[3], ref[3]))
    columns = np.array(ordered, np.int64).reshape(-1, 5).T
    channel = np.array([index[int(number)] for number in columns[0]], np.int64)
    return MessageRefs(channel, columns[1], columns[2], columns[3], columns[4])


def channels_of(recording: Recording, role: Callable[[int], str]) -> tuple[Channel, ...]:
    """Return the channels of a recording with their roles, sorted by channel id."""
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
                role=role(number),
            )
        )
    return tuple(channels)


def frame_refs(
    channels: tuple[Channel, ...], window: tuple[int, int]
) -> Callable[[Messages], MessageRefs]:
    """Return a function that returns the file positions of those messages that belong to frames.

    Parameters
    ----------
    channels : tuple of Channel
        Only messages of channels with the role ``ground_truth`` or ``payload`` belong to frames.
    window : tuple of int
        First and last log time, both included. A clip may contain messages outside; they belong to no frame.
    """
    start, end = window
    index = np.full(IDS, -1, np.int64)
    for i, channel in enumerate(channels):
        if channel.role in {"ground_truth", "payload"}:
            index[channel.id] = i

    def refs(run: Messages) -> MessageRefs:
        channel = index[run.channel]
        kept = (channel >= 0) & (run.log_time_ns >= start) & (run.log_time_ns <= end)
        log_time, chunk = run.log_time_ns[kept], run.chunks[kept]
        return MessageRefs(channel[kept], log_time, chunk, run.offset[kept], run.length[kept])

    return refs


def light_places(road_map: RoadMap) -> dict[str, tuple[float, float, float]]:
    """Return the positions of the traffic lights of a map, by their names."""
    nodes = road_map.nodes
    places = zip(nodes.x.tolist(), nodes.y.tolist(), nodes.z.tolist(), strict=True)
    return {
        name: place
        for name, place, kind in zip(nodes.name, places, nodes.kind.tolist(), strict=True)
        if KINDS[kind] == "traffic_light"
    }


# First reading.

FIRST_NOISE: Final = 3
"""Number of first frames in which the reader looks for recorded velocities."""

BEGINNING: Final = 1_000_000_000
"""Time after the first frame within which a message belongs to the start of the recording; ns of log time."""


def count_ref(told: dict[Key, tuple[int, Ref]], key: Key, ref: Ref, times: int = 1) -> int:
    """Count an item with a given key, and store the position of the key's first item. Return the old count."""
    before, first = told.get(key, (0, ref))
    told[key] = before + times, first
    return before


def listing(things: Sequence[str]) -> str:
    """Return a text that lists possible egos of a recording, for an error message."""
    return f"there are: {first_of(things, LISTED) or 'none'}"


@dataclass(slots=True)
class Lead:
    """Channel that may contain the frames of a trace. It has counts of its content.

    Attributes
    ----------
    frames : int
        Number of its messages that are frames.
    weight : int
        Amount of its content; the unit depends on the flavour.
    first_ns : int
        Minimum log time of its frames.
    stamps : Stamps
        Times in its messages.
    """

    frames: int = 0
    weight: int = 0
    first_ns: int = (1 << 63) - 1
    stamps: Stamps = field(default_factory=Stamps)


AnyLead = TypeVar("AnyLead", bound=Lead)


class Survey(Generic[AnyLead]):
    """First reading of all messages of a recording. It collects information that the frames need.

    Unreadable messages are reported later, during the reading of the frames.

    Parameters
    ----------
    recording : Recording
    wanted : str
        Id or name of the ego from the user; empty: the ego of the recording.

    Attributes
    ----------
    recording : Recording
    wanted : str
    leads : dict
        Channel id → :class:`Lead`, for each candidate of the leading channel.
    leading : int
        Id of the leading channel, whose messages are the frames. -1 means not known yet.
    map_text, map_name : str
        The road map and its name in the recording; empty without a map.
    lost_lanes : list of str
        Lanes missing in the map, with the reasons.
    notes, about_ego : list of str
        Oddities without loss of data: of the recording, and of the choice of the ego.
    lost : LossTally
        Unusable parts.
    """

    def __init__(self, recording: Recording, wanted: str) -> None:
        self.recording = recording
        self.wanted = wanted
        self.leads: dict[int, AnyLead] = {}
        self.leading = -1
        self.map_text = self.map_name = ""
        self.lost_lanes: list[str] = []
        self.notes: list[str] = []
        self.about_ego: list[str] = []
        self.lost = LossTally()
        self._others: dict[int, tuple[int, Ref]] = {}
        self._met: dict[int, bool] = {}
        self._window = recording.window

    def meet(self, channel: int) -> bool:
        """Return True if a channel contains frames, or data for later frames, such as actor lists.

        It is called once per channel, before its first message is examined.
        """
        raise NotImplementedError

    def watches(self, channel: int, *, met: bool) -> bool:
        """Return True if the first reading of the recording must examine the messages of a channel.

        ``met`` is the result of :meth:`meet`. The method is called for each run of messages. A result of
        ``False`` is final.
        """
        del channel
        return met

    def keeps(self, channel: int) -> bool:
        """Return True if messages of a channel are needed in the second reading, in which frames are made."""
        raise NotImplementedError

    def look(self, run: Messages, row: int) -> None:
        """Collect information from a message, in the first reading of a recording."""
        raise NotImplementedError

    def rank(self, lead: AnyLead) -> tuple[int, ...]:
        """Return the sort key of a channel. The channel with the greatest key becomes the frame channel."""
        return lead.weight, lead.frames

    def read(self) -> Self:
        """Read all messages of the recording once and collect information. Return this object.

        Raises
        ------
        OutOfOrder
            The messages are not in order of time. A new survey reads them sorted.
        TraceError
            The file cannot be read, or a schema is malformed.
        """
        rank = channel_rank(self.recording)
        for run in self.recording.walk(Findings(), keep=self.keeps, rank=rank):
            self._window = self.recording.window
            found = np.unique(run.channel, return_index=True, return_counts=True)
            watched = np.zeros(IDS, np.bool_)
            firsts: list[tuple[int, int]] = []
            for channel, row in zip(found[0].tolist(), found[1].tolist(), strict=True):
                if channel in self._met:
                    watched[channel] = self.watches(channel, met=self._met[channel])
                else:
                    firsts.append((row, channel))
            self._look_through(run, watched, sorted(firsts))
            for channel, row, count in zip(*(column.tolist() for column in found), strict=True):
                if not self._met[channel]:
                    count_ref(self._others, channel, ref_of(run, row), count)
        return self

    def _look_through(
        self, run: Messages, watched: NDArray[np.bool_], firsts: list[tuple[int, int]]
    ) -> None:
        """Collect information from a group of messages. A channel is classified at its first message."""
        start = 0
        for stop, channel in [*firsts, (len(run), -1)]:
            for row in np.flatnonzero(watched[run.channel[start:stop]]).tolist():
                self.look(run, start + row)
            start = stop
            if channel >= 0:
                self._met[channel] = met = self.meet(channel)
                watched[channel] = self.watches(channel, met=met)

    def see_stamp(self, run: Messages, row: int, stamp_ns: int | None) -> None:
        """Record the time stamp of a possible frame, if its log time is in the time window."""
        log_time, (start, end) = int(run.log_time_ns[row]), self._window
        if start <= log_time <= end:
            self.leads[int(run.channel[row])].stamps.see(log_time, stamp_ns)

    def count(self, run: Messages, row: int, weight: int) -> None:
        """Count a message as a frame of its channel, if its log time is in the time window."""
        log_time, (start, end) = int(run.log_time_ns[row]), self._window
        if start <= log_time <= end:
            lead = self.leads[int(run.channel[row])]
            lead.frames += 1
            lead.weight += weight
            lead.first_ns = min(lead.first_ns, log_time)

    def first_lead(self) -> int:
        """Return the id of the channel whose messages become the frames; -1 without such a channel."""
        ranked = [
            ([-number for number in self.rank(lead)], self.topic(channel), channel)
            for channel, lead in self.leads.items()
            if lead.frames
        ]
        return min(ranked)[-1] if ranked else -1

    def alike(self, channel: int) -> list[int]:
        """Return the ids of all channels with the topic and schema of the given channel."""
        channels = self.recording.channels
        return [number for number in sorted(channels) if self._key(number) == self._key(channel)]

    def _key(self, channel: int) -> tuple[str, ...]:
        record = self.recording.channels[channel]
        schema = self.recording.schemas.get(record.schema_id)
        named = (schema.name, schema.encoding, schema.data.hex()) if schema else ()
        return record.topic, record.message_encoding, *named

    def shared_stamps(self, channel: int, stamps: Stamps) -> Stamps:
        """If an earlier channel has the same topic and schema, return its time stamps; otherwise ``stamps``."""
        leads = self.leads
        return next((leads[one].stamps for one in self.alike(channel) if one in leads), stamps)

    def no_frames(self) -> str:
        """Return the text that explains why a recording has no frames."""
        lost = self.lost.losses()
        return lost[0].reason if lost else "no list of objects can be read"

    def ego_named(self, name: str) -> str | None:
        """Return the id of the ego with a name; ``None`` if the recording must be read again to find the ego.

        Raises
        ------
        TraceError
            The name does not exist, or is ambiguous.
        """
        asked = copy(self)  # The copy shares the collected facts; the current ego stays.
        asked.wanted, asked.about_ego = name, []
        return asked.find_ego()

    def find_ego(self) -> str:
        """Return the id of the ego vehicle; empty without an ego.

        Raises
        ------
        TraceError
            The given name does not exist, or is ambiguous.
        """
        raise NotImplementedError

    def role(self, channel: int) -> str:
        """Return the role of a channel: ``ground_truth`` (frames) or ``payload`` (sensor data)."""
        return "ground_truth" if channel in self.alike(self.leading) else "payload"

    def context(self) -> Iterable[Ref]:
        """Return the file positions of the messages that later messages need."""
        return self.once(self.leads[self.leading].first_ns)

    def tell(self, report: TraceReport) -> None:
        """Add the warnings and losses of the first reading to a report."""
        report.warnings += [*self.notes, *self.about_ego]
        report.about_ego += self.about_ego
        report.losses += self.lost.losses()

    def once(self, first_ns: int) -> list[Ref]:
        """Return the messages of channels with a single message, if they are near the first frame.

        Such a message, for example a camera calibration, is valid for the whole recording.
        """
        latest = first_ns + BEGINNING
        return [ref for count, ref in self._others.values() if count == 1 and ref[1] <= latest]

    def topic(self, channel: int) -> str:
        """Return the topic name of a channel."""
        return self.recording.channels[channel].topic


# Open recording.


class MessageTrace:
    """Open recording, which yields blocks of frames. It is a context manager that closes the file.

    Parameters
    ----------
    recording : Recording
    digest : str
        SHA-256 of the file.
    channels : tuple of Channel
        Channels of the recording, with their roles.
    ego : str
        Id of the ego; empty without an ego.
    context : iterable of Ref
        Messages that later messages depend on.
    **more
        Other attributes of :class:`~sgstore.model.world.TraceInfo`.

    Attributes
    ----------
    recording : Recording
    info : TraceInfo
    report : TraceReport
        Filled during the reading of blocks.
    noise : float
        Standard deviation of the positions; m. 0: exact; below 0: estimated from the first frames.
    causal : bool
        True: motion from noisy positions does not depend on later frames.
    """

    name: ClassVar[str] = ""
    noise: float = -1.0
    causal: bool = False

    def __init__(
        self,
        recording: Recording,
        digest: str,
        channels: tuple[Channel, ...],
        *,
        ego: str,
        context: Iterable[Ref] = (),
        map_text: str = "",
        map_name: str = "",
        **more: Any,
    ) -> None:
        self.recording = recording
        self.report = TraceReport()
        self._rank = channel_rank(recording, {channel.id: channel.role for channel in channels})
        recording.settle_order(self._rank)
        self.info = TraceInfo(
            path=recording.path,
            size=recording.size,
            mtime_ns=recording.mtime_ns,
            digest=digest,
            flavour=self.name,
            channels=channels,
            ego=ego,
            map_text=map_text,
            map_name=map_name,
            context=refs_of(context, channels),
            **more,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file of the recording."""
        self.recording.close()

    def ego_named(self, name: str) -> str | None:
        """Return the id of the ego vehicle with a name; ``None`` if the recording must be read again.

        Raises
        ------
        TraceError
            The name does not exist, or is ambiguous.
        """
        del name
        return None

    def decoder(self, report: TraceReport) -> MessageDecoder[Any]:
        """Return a new decoder of messages, and add the known warnings to its report."""
        raise NotImplementedError

    def blocks(self, size: int = 60) -> Iterator[FrameBlock]:
        """Yield the frames of the recording in blocks of consecutive frames.

        Block i begins at frame ``i * size``. The last block may be shorter.

        Raises
        ------
        TraceError
            The file is no longer readable, has no frame, or the requested ego is in no frame.
        """
        first_steps, noise = self._steps_and_noise()
        report = self.report = TraceReport()
        decoder = self.decoder(report)
        refs = frame_refs(self.info.channels, self.recording.window)
        runs = self.recording.walk(report, rank=self._rank)
        blocks = assemble(runs, size, decoder, refs, first_steps, noise, causal=self.causal)
        yield from counted(blocks, report)
        decoder.settle()
        if not report.frames:
            topic = next(c.topic for c in self.info.channels if c.role == "ground_truth")
            reason = report.losses[0].reason if report.losses else "it contains no messages"
            raise TraceError(f"no frame: {reason}", path=self.info.path, channel=topic)

    def _steps_and_noise(self) -> tuple[list[int], Noise]:
        """Return the time steps (ns) between the first frames, and the noise of the positions.

        The noise is that of the setting, or of the first frames.
        """
        decoder = self.decoder(TraceReport())
        raw, steps = self._raw(decoder), self._surveyed_steps()
        frames = [] if steps else [*islice(raw, FIRST_STEPS + 1)]
        steps = steps or np.diff([frame.time_ns for frame in frames]).tolist()
        if self.noise >= 0:
            return steps, Noise(self.noise, self.noise)
        frames = frames or [*islice(raw, FIRST_NOISE)]
        if not (decoder.measures or lacks_velocity(decoder, frames[:FIRST_NOISE])):
            return steps, Noise()
        return steps, first_noise(decoder, [*frames, *islice(raw, ESTIMATED - len(frames))])

    def _surveyed_steps(self) -> list[int]:
        """Return the time steps between the first frames, if they are known after the first reading; ns."""
        return []

    def _raw(self, decoder: MessageDecoder[Any]) -> Iterator[Any]:
        """Yield the frames of the recording in order, before conversion."""
        for run in self.recording.walk(TraceReport(), rank=self._rank):
            for row in np.flatnonzero(np.isin(run.channel, [*decoder.channels])).tolist():
                frame = decoder.decode(run, row)
                if frame is not None:
                    yield frame


AnySurvey = TypeVar("AnySurvey", bound=Survey[Any])


class SurveyedTrace(MessageTrace, Generic[AnySurvey]):
    """Open recording after its first reading, which collected information for the frames.

    Parameters
    ----------
    make : callable
        Makes a new :class:`Survey`. It is called again if messages are not in order of time.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.
    **more
        Other attributes of :class:`~sgstore.model.world.TraceInfo`.

    Raises
    ------
    TraceError
        A schema is malformed, no frame can be read, or the name of the ego does not exist.
    """

    def __init__(self, make: Callable[[], AnySurvey], digest: str, **more: Any) -> None:
        first = make()
        recording = first.recording

        def read() -> AnySurvey:
            try:
                return first.read()
            except OutOfOrder:
                return make().read()

        survey, digest = read_and_digest(recording.path, digest, read)
        self._survey = survey
        survey.leading = survey.first_lead()
        if survey.leading < 0:
            raise TraceError(survey.no_frames(), path=recording.path)
        super().__init__(
            recording,
            digest,
            ego=survey.find_ego(),
            channels=channels_of(recording, survey.role),
            context=survey.context(),
            map_text=survey.map_text,
            map_name=survey.map_name,
            lost_lanes=tuple(dict.fromkeys(survey.lost_lanes)),
            **more,
        )

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Return True if this reader can read a channel of the recording as frames."""
        return any(cls.has_frames(recording, channel) for channel in recording.channels)

    @staticmethod
    def has_frames(recording: Recording, channel: int) -> bool:
        """Return True if this reader can read messages with the channel's schema as frames."""
        raise NotImplementedError

    def decoder(self, report: TraceReport) -> MessageDecoder[Any]:
        """Return a new decoder of messages. Add the warnings of the first reading to its report."""
        self._survey.tell(report)
        return self._decoder(report)

    def _decoder(self, report: TraceReport) -> MessageDecoder[Any]:
        raise NotImplementedError

    def _surveyed_steps(self) -> list[int]:
        return self._survey.leads[self._survey.leading].stamps.steps[:FIRST_STEPS]

    def ego_named(self, name: str) -> str | None:
        """Return the id of the ego vehicle with a name, as found by the first reading."""
        return self._survey.ego_named(name)


class SurveyedDecoder(MessageDecoder[Raw], Generic[Raw, AnySurvey]):
    """Decoder of messages into frames. It uses information from a first reading of the recording.

    Parameters
    ----------
    survey : Survey
        Result of the first reading.
    report : TraceReport
        Receives losses and warnings.
    """

    def __init__(self, survey: AnySurvey, report: TraceReport) -> None:
        self._survey = survey
        self._leading = frozenset(survey.alike(survey.leading))
        self._stamps = survey.leads[survey.leading].stamps.reading()
        super().__init__(self._leading, survey.recording.window, report)

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        self._untimed = self._stamps.untimed
        super().settle()
        for channel in sorted(self._leading):
            late = self._survey.leads[channel].stamps.late
            if late is not None:
                self._report.losses.append(Loss(late_reason(*late), 0, 0))


# Readers with complete frames in messages: messages → frames → blocks of frames.

_LATEST: Final = 1 << 62
"""Limit of the absolute value of simulation times; ns."""
_MOTION: Final = slice(POSE.index("vx"), POSE.index("yaw_rate") + 1)
_LONGEST_REASON: Final = 200
_NO_EGO: Final = "no frame has an ego"


class TraceMessage(NamedTuple):
    """Message of a recording: channel, log time and raw bytes.

    Attributes
    ----------
    channel : Channel
        Its topic, schema and encoding.
    log_time_ns : int
        Log time in the file; ns.
    data : bytes
    """

    channel: Channel
    log_time_ns: int
    data: bytes


class FramesTrace(MessageTrace):
    """Base class of a reader for recordings in which each message is a complete frame.

    A subclass defines ``name``, :meth:`role` (the channels to read) and :meth:`frame` (the conversion of a
    message). It is then a reader for an entry point of the group ``sgstore.readers``.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id of the ego in all frames; empty: the ego of each frame.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.

    Attributes
    ----------
    info : TraceInfo
    report : TraceReport
        Filled during the reading of blocks.

    Raises
    ------
    TraceError
        The file cannot be read.

    Notes
    -----
    Frames have the same meaning as for :meth:`sgstore.sgg.SceneGraphGenerator.step`, with two differences. A
    missing velocity, acceleration or yaw rate is derived from the frames before and after. A static entity that
    first appears after the first frame counts as a moving one at rest.
    """

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self.recording = recording
        channels = _channels(self, recording)
        self._channels = {channel.id: channel for channel in channels}
        self._rank = channel_rank(recording, {channel.id: channel.role for channel in channels})
        recording.settle_order(self._rank)
        self._map_losses = LossTally()
        self._ego = ""
        first, refs, map_text = self._beginning()
        self._ego = ego if ego != first else ""  # Frames with other egos keep them.
        super().__init__(
            recording,
            digest or digest_of(recording.path),
            channels,
            ego=ego or first,
            context=refs,
            map_text=map_text,
            map_name="map" if map_text else "",
        )

    def ego_named(self, name: str) -> str:
        """Return the given name as the id of the ego: such frames have no other names."""
        return name

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel, such as ``ground_truth`` (frames), ``map`` or ``payload``.

        Parameters
        ----------
        channel : Channel
            Its topic, schema and encoding; its role is not set yet.

        Returns
        -------
        str
            ``ground_truth``: its messages are frames. ``map``: its first message is the road map. ``payload``:
            all others; frames refer to its messages.
        """
        raise NotImplementedError

    def frame(self, message: TraceMessage) -> Frame | None:
        """Convert a message into a frame; ``None`` if the message is not a frame.

        Parameters
        ----------
        message : TraceMessage
            Of a channel with the role ``ground_truth``. Messages come in order of their log times.

        Returns
        -------
        Frame or None
            ``None`` means that the message alone is not a frame.

        Notes
        -----
        If it raises any exception, the message becomes a loss with channel, time and reason.
        """
        raise NotImplementedError

    def start(self) -> None:
        """Reset the reader. It is called before the messages are read again from the first one.

        Only readers that combine several messages need it.
        """

    def map_text(self, message: TraceMessage) -> str:
        """Return the OpenDRIVE text (road map) in a message. The channel has the role ``map``."""
        return message.data.decode("utf-8")

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Return True if this reader can read a channel of the recording as frames."""
        return any(channel.role == "ground_truth" for channel in _channels(cls, recording))

    def decoder(self, report: TraceReport) -> _FramesDecoder:
        """Return a new decoder of messages into frames. Add the losses of the road map to the report."""
        self.start()
        report.losses += self._map_losses.losses()
        return _FramesDecoder(self, self._channels, self._ego, self.recording.window, report)

    def _beginning(self) -> tuple[str, list[Ref], str]:
        """Return the ego of the first frame, the messages that later ones need, and the road map.

        The recording is read only as far as necessary.
        """
        decoder = self.decoder(TraceReport())
        maps = {c.id for c in self._channels.values() if c.role == "map" and c.messages}
        refs: list[Ref] = []
        text = ""
        wanted = [*maps, *decoder.channels]
        for run in self.recording.walk(TraceReport(), rank=self._rank):
            for row in np.flatnonzero(np.isin(run.channel, wanted)).tolist():
                channel = int(run.channel[row])
                if channel in maps and not text:
                    text = self._read_map(run, row)
                    refs += [ref_of(run, row)] if text else []
                elif channel in decoder.channels and decoder.first is None:
                    decoder.decode(run, row)
                    refs += [ref_of(run, row)] if decoder.has_static else []
            if decoder.first is not None and (text or not maps):
                break
        return decoder.first or "", refs, text

    def _read_map(self, run: Messages, row: int) -> str:
        try:
            return self.map_text(_message(self._channels, run, row))
        except Exception as error:  # noqa: BLE001  a reader of another package can raise anything
            _lose(self._map_losses, self._channels, run, row, error)
            return ""


class _FramesDecoder(MessageDecoder[FrameRows]):
    """Decoder for messages that are complete frames. It also checks each frame.

    Attributes
    ----------
    first : str or None
        The ego of the first frame. ``None`` means no frame yet.
    has_static : bool
        True if an entity is static.
    """

    def __init__(
        self,
        trace: FramesTrace,
        channels: Mapping[int, Channel],
        ego: str,
        window: tuple[int, int],
        report: TraceReport,
    ) -> None:
        leading = {c.id for c in channels.values() if c.role == "ground_truth"}
        super().__init__(leading, window, report)
        self.first: str | None = None
        self.has_static = False
        self._trace, self._named, self._ego = trace, channels, ego
        self._known: dict[str, tuple[int, Entity]] = {}
        self._late: dict[int, Entity] = {}  # Static entities that appeared after the first block.
        self._begun = self._has_ego = False
        self._seq = -1

    def decode(self, run: Messages, row: int) -> FrameRows | None:
        """Return the frame in a message. Unreadable and contradictory frames count as lost."""
        try:
            frame = self._trace.frame(_message(self._named, run, row))
            if frame is None:
                return None
            self._check(frame)
        except Exception as error:  # noqa: BLE001  a reader of another package can raise anything
            _lose(self._unreadable, self._named, run, row, error)
            return None
        self.first = frame.ego if self.first is None else self.first
        for ident, words in frame.losses:
            self.roster.faults.add(ident, words)
        for entity in frame.entities:
            placed = np.isfinite(entity.numbers[:2]).all()  # Frame.losses has the others.
            if entity.static and placed and entity.ident not in self._known:
                self._stand(entity)
        log_time = int(run.log_time_ns[row])
        if not self.is_inside(log_time):  # A clip contains it for its static entities.
            return None
        self._begun = True
        self._seq += 1
        for kind, ident, other in frame.events:
            self.roster.happen(Event(kind, frame.time_ns, log_time, self._seq, ident, other))
        return self._rows(frame, log_time)

    def complete(self, frames: list[FrameRows]) -> list[FrameRows]:
        """Return the frames as they are: each message is a complete frame."""
        return frames

    def settle(self) -> None:
        """Add unreadable messages and a missing ego to the report, after all frames are read."""
        super().settle()
        if self._has_ego or not self._report.frames:
            return
        if self._ego:
            raise TraceError(f"no entity that moves has the id {self._ego!r}")
        self._warn_of_egos(_NO_EGO)

    def _check(self, frame: object) -> None:
        """Raise an error if a frame does not fit earlier frames of the recording.

        The state of the decoder does not change.
        """
        if not isinstance(frame, Frame):
            raise TypeError(f"{type(frame).__name__} is not a Frame")
        if abs(frame.time_ns) >= _LATEST:
            raise ValueError(f"no time: {frame.time_ns} ns")
        check_entities(frame, self._is_static)

    def _is_static(self, ident: str) -> bool | None:
        return self._known[ident][1].static if ident in self._known else None

    def _stand(self, entity: Entity) -> None:
        """Add a static object of a frame to the table of objects.

        Scenery is valid in all frames of its block. A static entity after the first frame therefore gets a row
        in each frame instead. Otherwise, the result would depend on the start of a block.
        """
        self.has_static = True
        if not self._begun:
            self._enter(entity, entity.numbers[: len(POSE)])
            return
        self._late[self._enter(entity)] = entity

    def _enter(self, entity: Entity, pose: tuple[float, ...] | None = None) -> int:
        if entity.ident not in self._known:
            meaning = _meaning(entity)
            node = self.roster.enter(entity.ident, meaning, entity.type_name, entity.map_ref, pose)
            self._known[entity.ident] = node, entity
        return self._known[entity.ident][0]

    def _rows(self, frame: Frame, log_time: int) -> FrameRows:
        moving = {self._enter(e): e for e in frame.entities if not e.static}
        ego, _ = self._known.get(self._ego or frame.ego, (-1, None))
        self._has_ego |= ego in moving
        rows = [*moving.values(), *self._late.values()]
        values = np.array([e.numbers[: len(POSE)] for e in rows], np.float64)
        values = values.reshape(len(rows), len(POSE))
        values[len(moving) :, _MOTION] = np.nan_to_num(values[len(moving) :, _MOTION])
        return FrameRows(
            frame.time_ns,
            log_time,
            ego if ego in moving else -1,
            np.array([*moving, *self._late], np.int64),
            values,
            np.array([e.whole[0] for e in rows], np.int64),
            np.array([e.whole[1] for e in rows], np.int64),
            driven=_driven(moving),
            own={node: dict(entity.own) for node, entity in moving.items() if entity.own},
            kinds={
                node: (_meaning(entity), entity.type_name)
                for node, entity in moving.items()
                if entity.kind != self._known[entity.ident][1].kind
            },
        )


def _meaning(entity: Entity) -> TypeMeaning:
    return TypeMeaning(KINDS[entity.kind], entity.special, entity.subkind)


def _driven(moving: dict[int, Entity]) -> dict[int, tuple[float, ...]]:
    """Return the known control inputs (steering, throttle, brake, …) of the objects: node id → values."""
    told = ((node, entity.numbers[len(POSE) :]) for node, entity in moving.items())
    return {node: inputs for node, inputs in told if not np.isnan(inputs).all()}


def _channels(
    flavour: FramesTrace | type[FramesTrace], recording: Recording
) -> tuple[Channel, ...]:
    found = channels_of(recording, lambda _: "payload")
    return tuple(replace(channel, role=flavour.role(channel)) for channel in found)


def _message(channels: Mapping[int, Channel], run: Messages, row: int) -> TraceMessage:
    channel = channels[int(run.channel[row])]
    return TraceMessage(channel, int(run.log_time_ns[row]), bytes(run.data(row)))


def _lose(
    losses: LossTally,
    channels: Mapping[int, Channel],
    run: Messages,
    row: int,
    error: Exception,
) -> None:
    topic = channels[int(run.channel[row])].topic
    reason = f"{topic!r}: {error!r}"[:_LONGEST_REASON]
    losses.add(reason, int(run.log_time_ns[row]), int(run.length[row]))
