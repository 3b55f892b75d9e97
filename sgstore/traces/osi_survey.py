"""The first reading of an OSI recording: what must be known before its frames can be read.

The map may stand behind the frames, static data may come once and never again, and the ego is known by
an id that has to name something. So every ground truth message is looked at once when a recording is
opened: which channel leads, which messages later ones depend on, who and what is in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MapError, TraceError
from sgstore.roads.lanetext import OF_LANES
from sgstore.traces.frames import Roster
from sgstore.traces.osi_cast import Cast
from sgstore.traces.osi_lanes import FIELDS as LANE_FIELDS
from sgstore.traces.osi_lanes import LaneSignal, OsiLanes
from sgstore.traces.osi_lights import TrafficLights
from sgstore.traces.osi_schema import (
    DECODE_ERRORS,
    GROUND_TRUTH,
    HOST_DATA,
    ROAD_MAP,
    SENSOR_VIEW,
    ground_truth_of,
    has_field,
    light_class,
    lights_of,
    message_class,
    object_class,
    parse,
)
from sgstore.traces.osi_statics import Statics
from sgstore.traces.references import Ref, ref_of
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from sgstore.traces.chunks import Messages
    from sgstore.traces.recording import Recording

STATIC_FIELDS: Final = (
    "stationary_object",
    "traffic_sign",
    "road_marking",
    "lane_boundary",
    "lane",
    "reference_line",
    "logical_lane_boundary",
    "logical_lane",
)
"""Fields of a ground truth whose objects do not change, so that a producer may write them only once."""

BEGINNING: Final = 1_000_000_000
"""How long after the first frame a message still comes with it; ns of log time."""


@dataclass(slots=True)
class _Latch:
    """Which messages of a channel later ones depend on, because they do not repeat what these tell.

    A static object is told by the first message that has it; if every later one has it too, none
    depends on the first. A light's state is told by the last message before one that lacks the light.
    """

    fields: tuple[str, ...]
    bulb: type[Any] | None = None
    words: dict[bytes, int | None] = field(default_factory=dict[bytes, "int | None"])
    told_by: dict[tuple[str, int], Ref] = field(default_factory=dict[tuple[str, int], Ref])
    repeated: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])
    lights: set[int] = field(default_factory=set[int])
    last: Ref | None = None
    refs: dict[Ref, None] = field(default_factory=dict[Ref, None])

    def look(self, ground: Any, ref: Ref) -> bool:
        """Take note of a message; whether it tells of a lane or boundary that none before it told of."""
        items = {(name, item.id.value) for name in self.fields for item in getattr(ground, name)}
        gone = self.repeated - items
        for item in gone:
            self.refs[self.told_by[item]] = None
        new = {item for item in items if item not in self.told_by}
        self.repeated = (self.repeated - gone) | new
        self.told_by.update(dict.fromkeys(new, ref))
        lights = self._lit(ground)
        if self.last is not None and self.lights - lights:
            self.refs[self.last] = None
        self.lights, self.last = lights, ref
        return any(name in LANE_FIELDS for name, _ in new)

    def _lit(self, ground: Any) -> set[int]:
        """Ids of the lights in a message; those that stand in it as in the last one are not read again."""
        words = lights_of(ground)
        if words != [*self.words]:
            known = self.words
            self.words = {word: known.get(word) or self._ident(word) for word in words}
        return {ident for ident in self.words.values() if ident is not None}

    def _ident(self, word: bytes) -> int | None:
        try:
            return None if self.bulb is None else int(self.bulb.FromString(word).id.value)
        except DECODE_ERRORS:  # said when the frames are read
            return None


@dataclass(slots=True)
class Lead:
    """A channel that may lead: its message class, its messages that could be read, what they depend on.

    ``objects``: class of its moving objects. ``driven``: how many of its frames have some. ``first_ns``: least
    log time of its frames. ``lanes``: what they tell of roads; ``None`` if that cannot
    be read.
    """

    schema: str
    message: type[Any]
    objects: type[Any]
    latch: _Latch
    lanes: OsiLanes | None
    frames: int = 0
    driven: int = 0
    first_ns: int = (1 << 63) - 1


@dataclass(slots=True)
class Survey:
    """What is known of a recording after the first reading.

    Attributes
    ----------
    leads : dict
        Channel id → :class:`Lead`, of the channels with ground truth.
    hosts : dict
        Channel id → class of the messages, of the channels with data of the host vehicle.
    cast : Cast
        The moving objects.
    statics : Statics
        What stands still.
    map_text, map_name : str
        OpenDRIVE; in a recording that carries none, the lanes of its ground truth.
    map_refs : list of Ref
    others : dict
        Channel id → number of messages and the first of them, of all other channels.
    notes : list of str
        What is odd but lost nothing.
    window : tuple of int
        Log times, both included, between which messages are frames.
    signals : dict
        First bulb of each traffic light that is assigned to lanes → the signal of the map of its lanes.
    lights : dict
        Channel id → all traffic lights, as messages of that channel are to be read.
    """

    leads: dict[int, Lead] = field(default_factory=dict[int, Lead])
    hosts: dict[int, type[Any]] = field(default_factory=dict[int, type[Any]])
    cast: Cast = field(default_factory=Cast)
    statics: Statics = field(default_factory=Statics)
    map_text: str = ""
    map_name: str = ""
    map_refs: list[Ref] = field(default_factory=list[Ref])
    others: dict[int, tuple[int, Ref]] = field(default_factory=dict[int, tuple[int, Ref]])
    notes: list[str] = field(default_factory=list[str])
    window: tuple[int, int] = (0, 0)
    signals: dict[int, LaneSignal] = field(default_factory=dict[int, LaneSignal])
    lights: dict[int, TrafficLights] = field(default_factory=dict[int, TrafficLights])

    def leading(self) -> int | None:
        """The channel with most frames, a ground truth before a sensor view; ``None`` if none has any.

        Frames with moving objects count first: of split channels the one that moves leads.
        """
        ranked = [
            (lead.driven, lead.frames, lead.schema == GROUND_TRUTH, -channel)
            for channel, lead in self.leads.items()
            if lead.frames
        ]
        return -max(ranked)[3] if ranked else None

    def context(self, leading: int) -> set[Ref]:
        """Messages that later ones depend on.

        The only message of a channel is one of them if it comes with the first frame: what is told once
        and at the beginning, such as the calibration of a camera, is told for all that follows. Of a channel
        beside the leading one it is whatever tells of static things for the first time.
        """
        lead = self.leads[leading]
        once = [
            ref
            for count, ref in self.others.values()
            if count == 1 and ref[1] <= lead.first_ns + BEGINNING
        ]
        refs = {*self.map_refs, *once}
        for channel, other in self.leads.items():
            refs.update(other.latch.refs)
            if channel != leading:
                refs.update(other.latch.told_by.values())
        return refs


def survey(recording: Recording) -> Survey:
    """Read a recording once, from end to end.

    Raises
    ------
    TraceError
        Descriptors are malformed, or the file cannot be read.
    """
    result = Survey()
    maps: dict[int, type[Any]] = {}
    for run in recording.walk(
        TraceReport(), keep=lambda channel: channel in result.leads or channel in result.hosts
    ):
        for channel, row, count in zip(
            *np.unique(run.channel, return_index=True, return_counts=True), strict=True
        ):
            if not _meet(recording, int(channel), result, maps):
                before, ref = result.others.get(int(channel), (0, ref_of(run, int(row))))
                result.others[int(channel)] = (before + int(count), ref)
        result.window = recording.window
        known = np.isin(run.channel, [*result.leads, *maps])
        for row in np.flatnonzero(known):
            channel = int(run.channel[row])
            if channel in maps:
                _look_at_map(result, maps[channel], run, int(row))
            else:
                _look_at_frame(result, channel, run, int(row))
    if not result.map_text:
        leading = result.leading()
        lights = result.lights.get(leading) if leading is not None else None
        result.signals = {} if lights is None else lights.signals()
        _make_map_of_lanes(result, recording.path.stem)
    return result


def _make_map_of_lanes(result: Survey, name: str) -> None:
    """The map that the lanes make, those of the leading channel before those of others."""
    leading = result.leading()
    for _, lead in sorted(result.leads.items(), key=lambda item: item[0] != leading):
        if lead.lanes is None:
            continue
        try:
            result.map_text, told = lead.lanes.text(
                [*result.signals.values(), *result.statics.signals()]
            )
        except MapError as error:
            lead.lanes.warnings.append(str(error))
        else:
            if result.map_text:
                result.map_name = told or f"{name}{OF_LANES}"
                return
        result.notes += [f"its lanes make no road map: {what}" for what in lead.lanes.warnings]


def schema_name(recording: Recording, channel: int) -> str:
    """Name of a channel's schema if its messages are protobuf, else the empty string."""
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    protobuf = schema is not None and "protobuf" in {schema.encoding, record.message_encoding}
    return schema.name if schema is not None and protobuf else ""


def _meet(recording: Recording, channel: int, result: Survey, maps: dict[int, type[Any]]) -> bool:
    """Whether a channel may lead or carries maps; makes ready for it when it is met for the first time."""
    if channel in result.leads or channel in maps:
        return True
    name = schema_name(recording, channel)
    if name not in {GROUND_TRUTH, SENSOR_VIEW, ROAD_MAP, HOST_DATA} or channel in result.hosts:
        return False
    message = message_class(recording.schemas[recording.channels[channel].schema_id])
    if name == HOST_DATA:
        result.hosts[channel] = message  # a message of its own, too, that belongs to a frame
        return False
    if name == ROAD_MAP:
        maps[channel] = message
        return True
    prefix = "global_ground_truth." if name == SENSOR_VIEW else ""
    present = tuple(field for field in STATIC_FIELDS if has_field(message, prefix + field))
    try:
        lanes = OsiLanes(recording.schemas[recording.channels[channel].schema_id])
    except TraceError as error:
        lanes = None
        result.notes.append(f"its lanes cannot be read: {error.reason}")
    result.lights[channel] = TrafficLights(Roster(TraceReport()), light_class(message))
    result.leads[channel] = Lead(
        name, message, object_class(message), _Latch(present, light_class(message)), lanes
    )
    return True


def _look_at_map(result: Survey, message: type[Any], run: Messages, row: int) -> None:
    result.map_refs.append(ref_of(run, row))
    try:
        told = message.FromString(bytes(run.data(row)))
        text, name = str(told.open_drive_xml_content), str(told.map_reference)
    except DECODE_ERRORS as error:
        result.notes.append(f"a message of schema {ROAD_MAP} cannot be read: {error}")
        return
    if not text:
        return
    if result.map_text and text != result.map_text:
        result.notes.append("the recording carries more than one road map; the first one counts")
    elif not result.map_text:
        result.map_text = text
        # Producers write the path of the file on their own machine: its last part is the map's name.
        result.map_name = PurePosixPath(name.replace("\\", "/")).name


def _look_at_frame(result: Survey, channel: int, run: Messages, row: int) -> None:
    lead = result.leads[channel]
    log_time = int(run.log_time_ns[row])
    try:
        data = bytes(run.data(row))
        message = parse(lead.message, data)
        ground = ground_truth_of(message)
        if lead.latch.look(ground, ref_of(run, row)) and lead.lanes is not None:
            lead.lanes.take(data)
        for lights in result.lights.values():
            lights.update(ground)
        result.statics.look(ground, lead.latch.fields, log_time)
        result.cast.look(message, lead.objects)
    except DECODE_ERRORS:  # counted as a loss when the frames are read
        return
    if result.window[0] <= log_time <= result.window[1]:
        lead.frames += 1
        lead.driven += len(ground.moving_object) > 0
        lead.first_ns = min(lead.first_ns, log_time)
