"""The first reading of an OSI recording: what must be known before its frames can be read.

The map may stand behind the frames, static data may come once and never again, and the ego is known by
an id that has to name something. So every ground truth message is looked at once when a recording is
opened: which channel leads, which messages later ones depend on, who the ego is.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.traces.osi_schema import (
    DECODE_ERRORS,
    GROUND_TRUTH,
    ROAD_MAP,
    SENSOR_VIEW,
    ground_truth_of,
    has_field,
    identifiers,
    message_class,
    parse,
)
from sgstore.world import MessageRefs, TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterable

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

LISTED: Final = 20
"""Objects that an error lists by name."""

Ref = tuple[int, int, int, int, int]
"""Channel id, log time, chunk offset, offset, length."""


def host_of(message: Any) -> list[str]:
    """Ids that a message gives to the host vehicle, the most telling first; 0 is one too."""
    hosts = [
        str(part.host_vehicle_id.value)
        for part in (message, ground_truth_of(message))
        if "host_vehicle_id" in part.DESCRIPTOR.fields_by_name and part.HasField("host_vehicle_id")
    ]
    return list(dict.fromkeys(hosts))


def names_of(moving_object: Any) -> list[str]:
    """What a moving object is called: ``X`` of an identifier ``entity_name:X``, bare identifiers."""
    return [
        value if key == "entity_name" else key
        for key, colon, value in (text.partition(":") for _, text in identifiers(moving_object))
        if key == "entity_name" or not colon
    ]


@dataclass(slots=True)
class EgoSearch:
    """Who the ego is: the host vehicle, or what the user names.

    Parameters
    ----------
    wanted : str
        Id or name that the user gave; empty: the host vehicle.
    """

    wanted: str
    found: str = ""
    hosts: list[str] = field(default_factory=list[str])
    seen: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def look(self, message: Any) -> None:
        """Look for the ego among the moving objects of a message, until it is found."""
        if self.found:
            return
        objects = ground_truth_of(message).moving_object
        if self.wanted:
            self._look_by_name(objects)
            return
        self.hosts = host_of(message) or self.hosts
        ids = {str(thing.id.value) for thing in objects}
        self.found = next((host for host in self.hosts if host in ids), "")

    def _look_by_name(self, objects: Iterable[Any]) -> None:
        for thing in objects:
            ident = str(thing.id.value)
            if ident not in self.seen:
                self.seen[ident] = names_of(thing)
        if self.wanted in self.seen:
            self.found = self.wanted
            return
        named = [ident for ident, names in self.seen.items() if self.wanted in names]
        if len(named) > 1:
            raise TraceError(f"several objects are named {self.wanted!r}: ids {', '.join(named)}")
        self.found = named[0] if named else ""

    def settle(self) -> str:
        """The ego's id, or the empty string.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave.
        """
        if self.wanted and not self.found:
            things = [
                f"{ident} ({', '.join(names)})" if names else ident
                for ident, names in list(self.seen.items())[:LISTED]
            ]
            more = f" and {len(self.seen) - LISTED} more" if len(self.seen) > LISTED else ""
            raise TraceError(
                f"no moving object has the id or name {self.wanted!r}; there are: "
                f"{', '.join(things) or 'none'}{more}"
            )
        return self.found


@dataclass(slots=True)
class _Latch:
    """Which messages of a channel later ones depend on, because they do not repeat what these tell.

    A static object is told by the first message that has it; if every later one has it too, none
    depends on the first. A light's state is told by the last message before one that lacks the light.
    """

    fields: tuple[str, ...]
    told_by: dict[tuple[str, int], Ref] = field(default_factory=dict[tuple[str, int], Ref])
    repeated: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])
    lights: set[int] = field(default_factory=set[int])
    last: Ref | None = None
    refs: dict[Ref, None] = field(default_factory=dict[Ref, None])

    def look(self, ground: Any, ref: Ref) -> None:
        items = {(name, item.id.value) for name in self.fields for item in getattr(ground, name)}
        gone = self.repeated - items
        for item in gone:
            self.refs[self.told_by[item]] = None
        new = {item for item in items if item not in self.told_by}
        self.repeated = (self.repeated - gone) | new
        self.told_by.update(dict.fromkeys(new, ref))
        lights = {bulb.id.value for bulb in ground.traffic_light}
        if self.last is not None and self.lights - lights:
            self.refs[self.last] = None
        self.lights, self.last = lights, ref


@dataclass(slots=True)
class Lead:
    """A channel that may lead: its message class, its messages that could be read, what they depend on.

    ``first_ns``: least log time of its frames.
    """

    schema: str
    message: type[Any]
    ego: EgoSearch
    latch: _Latch
    frames: int = 0
    first_ns: int = (1 << 63) - 1


@dataclass(slots=True)
class Survey:
    """What is known of a recording after the first reading.

    Attributes
    ----------
    leads : dict
        Channel id → :class:`Lead`, of the channels with ground truth.
    map_text, map_name : str
    map_refs : list of Ref
    others : dict
        Channel id → number of messages and the first of them, of all other channels.
    notes : list of str
        What is odd but lost nothing.
    """

    leads: dict[int, Lead] = field(default_factory=dict[int, Lead])
    map_text: str = ""
    map_name: str = ""
    map_refs: list[Ref] = field(default_factory=list[Ref])
    others: dict[int, tuple[int, Ref]] = field(default_factory=dict[int, tuple[int, Ref]])
    notes: list[str] = field(default_factory=list[str])

    def leading(self) -> int | None:
        """The channel with most frames, a ground truth before a sensor view; ``None`` if none has any."""
        ranked = [
            (lead.frames, lead.schema == GROUND_TRUTH, -channel)
            for channel, lead in self.leads.items()
            if lead.frames
        ]
        return -max(ranked)[2] if ranked else None

    def context(self, leading: int) -> list[Ref]:
        """Messages that later ones depend on, in file order.

        The only message of a channel is one of them if it comes with the first frame: what is told once
        and at the beginning, such as the calibration of a camera, is told for all that follows.
        """
        lead = self.leads[leading]
        once = [
            ref
            for count, ref in self.others.values()
            if count == 1 and ref[1] <= lead.first_ns + BEGINNING
        ]
        refs = {*self.map_refs, *lead.latch.refs, *once}
        return sorted(refs, key=lambda ref: (ref[2] if ref[2] >= 0 else ref[3], ref[3]))


def survey(recording: Recording, ego: str) -> Survey:
    """Read a recording once, from end to end.

    Raises
    ------
    TraceError
        Descriptors are malformed, or the file cannot be read.
    """
    result = Survey()
    maps: dict[int, type[Any]] = {}
    for run in recording.walk(TraceReport()):
        for channel, row, count in zip(
            *np.unique(run.channel, return_index=True, return_counts=True), strict=True
        ):
            if not _meet(recording, int(channel), ego, result, maps):
                before, ref = result.others.get(int(channel), (0, _ref(run, int(row))))
                result.others[int(channel)] = (before + int(count), ref)
        window = recording.window
        known = np.isin(run.channel, [*result.leads, *maps])
        for row in np.flatnonzero(known):
            channel = int(run.channel[row])
            if channel in maps:
                _look_at_map(result, maps[channel], run, int(row))
            else:
                _look_at_frame(result.leads[channel], run, int(row), window)
    return result


def schema_name(recording: Recording, channel: int) -> str:
    """Name of a channel's schema if its messages are protobuf, else the empty string."""
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    protobuf = schema is not None and "protobuf" in {schema.encoding, record.message_encoding}
    return schema.name if schema is not None and protobuf else ""


def _meet(
    recording: Recording, channel: int, ego: str, result: Survey, maps: dict[int, type[Any]]
) -> bool:
    """Whether a channel may lead or carries maps; makes ready for it when it is met for the first time."""
    if channel in result.leads or channel in maps:
        return True
    name = schema_name(recording, channel)
    if name not in {GROUND_TRUTH, SENSOR_VIEW, ROAD_MAP}:
        return False
    message = message_class(recording.schemas[recording.channels[channel].schema_id])
    if name == ROAD_MAP:
        maps[channel] = message
        return True
    prefix = "global_ground_truth." if name == SENSOR_VIEW else ""
    present = tuple(field for field in STATIC_FIELDS if has_field(message, prefix + field))
    result.leads[channel] = Lead(name, message, EgoSearch(ego), _Latch(present))
    return True


def _ref(run: Messages, row: int) -> Ref:
    return (
        int(run.channel[row]),
        int(run.log_time_ns[row]),
        run.chunk_offset,
        int(run.offset[row]),
        int(run.length[row]),
    )


def _look_at_map(result: Survey, message: type[Any], run: Messages, row: int) -> None:
    result.map_refs.append(_ref(run, row))
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


def _look_at_frame(lead: Lead, run: Messages, row: int, window: tuple[int, int]) -> None:
    try:
        message = parse(lead.message, bytes(run.data(row)))
        lead.latch.look(ground_truth_of(message), _ref(run, row))
        lead.ego.look(message)
    except DECODE_ERRORS:  # counted as a loss when the frames are read
        return
    log_time = int(run.log_time_ns[row])
    if window[0] <= log_time <= window[1]:
        lead.frames += 1
        lead.first_ns = min(lead.first_ns, log_time)


def refs_of(refs: list[Ref], index: dict[int, int]) -> MessageRefs:
    """References as columns. ``index``: channel id → index into the channels of the trace."""
    columns = np.array(refs, np.int64).reshape(-1, 5).T
    channel = np.array([index[int(number)] for number in columns[0]], np.int64)
    return MessageRefs(channel, columns[1], columns[2], columns[3], columns[4])
