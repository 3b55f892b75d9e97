"""Flavours that tell plain frames: messages → :class:`sgstore.step.Frame` → blocks of frames."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap import digest_of
from sgstore.readers._base import MessageTrace, channels_of, ref_of
from sgstore.readers._blocks import FrameRows, LossTally, MessageDecoder
from sgstore.step import Frame, check_entities
from sgstore.vocabulary import KINDS, TypeMeaning
from sgstore.world import POSE, Channel, TraceReport

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.mcap import Messages, Recording
    from sgstore.readers._base import Ref
    from sgstore.step import Entity

_LATEST: Final = 1 << 62
"""Simulation times lie between this and its negative; ns."""
_MOTION: Final = slice(POSE.index("vx"), POSE.index("yaw_rate") + 1)
_LONGEST_REASON: Final = 200
_NO_EGO: Final = "no frame has an ego"


class TraceMessage(NamedTuple):
    """One message of a recording.

    Attributes
    ----------
    channel : Channel
        Its topic, schema and encoding.
    log_time_ns : int
        As the file has it.
    data : bytes
    """

    channel: Channel
    log_time_ns: int
    data: bytes


class FramesTrace(MessageTrace):
    """Base class of a flavour whose messages tell plain frames.

    A subclass has a ``name``, and says with :meth:`role` which channels it reads and with :meth:`frame` what
    a message tells. It is then a reader, for an entry point of the group ``sgstore.readers``.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id of the ego in all frames; empty: as each frame says.
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
        The file cannot be read.

    Notes
    -----
    Frames mean what they mean to :meth:`sgstore.sgg.SceneGraphGenerator.step`, with two differences. A
    velocity, acceleration or yaw rate that is not told is derived by differences from the frames around it. A
    static entity that is told only after the first frame is kept as one that does not move from then on.
    """

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self.recording = recording
        channels = _channels(self, recording)
        self._channels = {channel.id: channel for channel in channels}
        self._map_losses = LossTally()
        self._ego = ""
        first, refs, map_text = self._beginning()
        self._ego = ego if ego != first else ""  # frames that name others may still do so
        super().__init__(
            recording,
            digest or digest_of(recording.path),
            channels,
            ego=ego or first,
            context=refs,
            map_text=map_text,
            map_name="map" if map_text else "",
        )

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel.

        Parameters
        ----------
        channel : Channel
            Its topic, schema and encoding; its own role is not known yet.

        Returns
        -------
        str
            ``ground_truth``: its messages tell frames. ``map``: its first message is the road map. ``payload``:
            neither; a frame refers to its messages.
        """
        raise NotImplementedError

    def frame(self, message: TraceMessage) -> Frame | None:
        """Return the frame that a message tells.

        Parameters
        ----------
        message : TraceMessage
            Of a channel whose role is ``ground_truth``; they come in the order of the file.

        Returns
        -------
        Frame or None
            ``None``: the message alone is no frame.

        Notes
        -----
        Whatever it raises makes the message a loss, with the channel, the time and the reason.
        """
        raise NotImplementedError

    def start(self) -> None:
        """Forget earlier messages: :meth:`frame` is given them from the first one on.

        Only a flavour that puts several messages together needs it.
        """

    def map_text(self, message: TraceMessage) -> str:
        """Return the OpenDRIVE text that a message of a channel with the role ``map`` holds."""
        return message.data.decode("utf-8")

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """True if a channel of a recording tells frames of this flavour."""
        return any(channel.role == "ground_truth" for channel in _channels(cls, recording))

    def decoder(self, report: TraceReport) -> _FramesDecoder:
        """A decoder that has read nothing yet."""
        self.start()
        report.losses += self._map_losses.losses()
        return _FramesDecoder(self, self._channels, self._ego, self.recording.window, report)

    def _beginning(self) -> tuple[str, list[Ref], str]:
        """The ego of the first frame, the messages that later ones depend on, and the road map.

        Reads the recording as far as it takes to find them.
        """
        decoder = self.decoder(TraceReport())
        maps = {c.id for c in self._channels.values() if c.role == "map" and c.messages}
        refs: list[Ref] = []
        text = ""
        wanted = [*maps, *decoder.channels]
        for run in self.recording.walk(TraceReport()):
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
        except Exception as error:  # noqa: BLE001  whatever a flavour of another package does
            _lose(self._map_losses, self._channels, run, row, error)
            return ""


class _FramesDecoder(MessageDecoder[FrameRows]):
    """Messages → frames, which are whole as they come.

    Attributes
    ----------
    first : str or None
        The ego of the first frame; ``None``: there was no frame yet.
    has_static : bool
        Whether anything is static.
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
        self._late: dict[int, Entity] = {}  # static, but told when frames had been handed out
        self._begun = self._has_ego = False

    def decode(self, run: Messages, row: int) -> FrameRows | None:
        """The frame that a message is; one that cannot be read, or contradicts others, is a loss."""
        try:
            frame = self._trace.frame(_message(self._named, run, row))
            if frame is None:
                return None
            self._check(frame)
        except Exception as error:  # noqa: BLE001  whatever a flavour of another package does
            _lose(self._unreadable, self._named, run, row, error)
            return None
        self.first = frame.ego if self.first is None else self.first
        for entity in frame.entities:
            if entity.static and entity.ident not in self._known:
                self._stand(entity)
        log_time = int(run.log_time_ns[row])
        if not self.is_inside(log_time):  # a clip brings it for what stands
            return None
        self._begun = True
        return self._rows(frame, log_time)

    def complete(self, frames: list[FrameRows]) -> list[FrameRows]:
        """The same frames: a message tells all of one."""
        return frames

    def settle(self) -> None:
        """Report what could not be read, and the lack of an ego."""
        super().settle()
        if self._has_ego or not self._report.frames:
            return
        if self._ego:
            raise TraceError(f"no entity that moves has the id {self._ego!r}")
        self._warn_of_egos(_NO_EGO)

    def _check(self, frame: object) -> None:
        """Raise if a frame cannot follow those before it; nothing of it is remembered then."""
        if not isinstance(frame, Frame):
            raise TypeError(f"{type(frame).__name__} is no Frame")
        if abs(frame.time_ns) >= _LATEST:
            raise ValueError(f"no time: {frame.time_ns} ns")
        check_entities(frame, self._told)

    def _told(self, ident: str) -> tuple[bool, str] | None:
        if ident not in self._known:
            return None
        entity = self._known[ident][1]
        return entity.static, KINDS[entity.kind]

    def _stand(self, entity: Entity) -> None:
        """Enter what never moves.

        Scenery stands in all frames of its block. So what comes later than the first frame gets a row in each
        frame instead: else it would depend on where a block begins.
        """
        self.has_static = True
        if not self._begun:
            self._enter(entity, entity.numbers[: len(POSE)])
            return
        self._late[self._enter(entity)] = entity

    def _enter(self, entity: Entity, pose: tuple[float, ...] | None = None) -> int:
        if entity.ident not in self._known:
            meaning = TypeMeaning(KINDS[entity.kind], entity.special, entity.subkind)
            node = self.roster.enter(entity.ident, meaning, entity.type_name, entity.map_ref, pose)
            self._known[entity.ident] = node, entity
        return self._known[entity.ident][0]

    def _rows(self, frame: Frame, log_time: int) -> FrameRows:
        moving = {self._enter(e): e for e in frame.entities if not e.static}
        ego, _ = self._known.get(self._ego or frame.ego, (-1, None))
        self._has_ego |= ego in moving
        rows = [*moving.values(), *self._late.values()]
        numbers = np.array([e.numbers for e in rows], np.float64).reshape(len(rows), -1)
        values = numbers[:, : len(POSE)].copy() if rows else np.zeros((0, len(POSE)))
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
        )


def _driven(moving: dict[int, Entity]) -> dict[int, tuple[float, float, float]]:
    """Node id → steer, throttle, brake, of those that have any."""
    driven: dict[int, tuple[float, float, float]] = {}
    for node, entity in moving.items():
        steer, throttle, brake = entity.numbers[len(POSE) :]
        if not np.isnan([steer, throttle, brake]).all():
            driven[node] = steer, throttle, brake
    return driven


def _channels(
    flavour: FramesTrace | type[FramesTrace], recording: Recording
) -> tuple[Channel, ...]:
    """The channels of a recording, each with the role that a flavour gives it."""
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
    """Count a message that could not be read."""
    topic = channels[int(run.channel[row])].topic
    reason = f"{topic!r}: {error!r}"[:_LONGEST_REASON]
    losses.add(reason, int(run.log_time_ns[row]), int(run.length[row]))
