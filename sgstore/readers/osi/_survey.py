"""The first pass over an OSI recording: actors, ego and map.

Who is in an OSI recording: the moving objects by id and by name, and which of them is the ego.

An object's own id is a number that the simulator chose, and often another one in the next run. The scenario's
name of it, where a recording tells it, is what people know it by: it becomes the entity's ident if no other
object of the recording bears it, and the number otherwise.

Names stand in ``source_reference``: ``entity_name:cutter`` as esmini and others write, or bare, behind the word
that says what the entity is to OpenSCENARIO (``Vehicle``, ``cutter``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MapError, TraceError
from sgstore.readers._base import EntityTable, Ref, ref_of
from sgstore.readers.osi._lanes import FIELDS as LANE_FIELDS
from sgstore.readers.osi._lanes import LaneSignal, OsiLanes
from sgstore.readers.osi._lights import TrafficLights
from sgstore.readers.osi._objects import Statics
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    GROUND_TRUTH,
    HOST_DATA,
    ROAD_MAP,
    SENSOR_VIEW,
    ground_truth_of,
    has_field,
    identifiers,
    light_class,
    lights_of,
    message_class,
    object_class,
    parse,
)
from sgstore.roads import OF_LANES
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.mcap import Messages, Recording


LISTED: Final = 20
"""Objects that an error lists by name."""

EGO_NAMES: Final = frozenset({"ego", "hero", "host", "ego_vehicle", "host_vehicle"})
"""What the ego is called where no host vehicle is told, in lower case."""

_SORTS: Final = frozenset({"Vehicle", "Pedestrian", "MiscObject", "ExternalObjectReference"})
"""Sorts of entities in OpenSCENARIO, which are no names (ASAM OpenSCENARIO XML 1.3, ``EntityObject``)."""
_MOST_HOSTS: Final = 100


def names_of(moving_object: Any) -> list[str]:
    """Names of a moving object, the proper one first: ``X`` of ``entity_name:X``, then bare identifiers."""
    parts = [text.partition(":") for _, text in identifiers(moving_object)]
    named = [value for key, _, value in parts if key == "entity_name" and value]
    bare = [key for key, colon, _ in parts if key and not colon and key not in _SORTS]
    return [*named, *bare]


def _names_or_none(moving_object: Any) -> list[str]:
    try:
        return names_of(moving_object)
    except ValueError:  # references without end: then it is known by its number
        return []


def hosts_of(message: Any) -> list[int]:
    """Ids that a message gives to the host vehicle, the most telling first; 0 is one too."""
    told = [message, ground_truth_of(message), getattr(message, "host_vehicle_data", None)]
    hosts = [
        part.host_vehicle_id.value
        for part in told
        if part is not None
        and "host_vehicle_id" in part.DESCRIPTOR.fields_by_name
        and part.HasField("host_vehicle_id")
    ]
    return list(dict.fromkeys(hosts))


def keys_of(objects: Sequence[bytes]) -> list[bytes]:
    """The beginning of each serialised object, up to where its id ends if it begins with it."""
    try:
        return [content[: content[1] + 2] for content in objects]
    except IndexError:  # one that is shorter than that
        return [content[: content[1] + 2] if len(content) > 1 else content for content in objects]


def is_key(key: bytes, thing: Any) -> bool:
    """Return whether the beginning of a serialised object is its id and nothing else."""
    ident = thing.id.SerializeToString()
    return len(ident) < 0x80 and key == b"\x0a" + bytes([len(ident)]) + ident


@dataclass(slots=True)
class Cast:
    """The moving objects of a recording.

    Attributes
    ----------
    names : dict
        Id → names, the name proper first.
    hosts : dict
        Ids that were given to the host vehicle, in order.
    """

    names: dict[int, list[str]] = field(default_factory=dict[int, list[str]])
    hosts: dict[int, None] = field(default_factory=dict[int, None])
    _keys: set[bytes] = field(default_factory=set[bytes])

    def look(self, message: Any, objects: type[Any]) -> None:
        """Take note of the objects in a message. ``objects``: the class of its moving objects."""
        if len(self.hosts) < _MOST_HOSTS:
            self.hosts.update(dict.fromkeys(hosts_of(message)))
        contents: Sequence[bytes] = list(ground_truth_of(message).moving_object)
        keys = keys_of(contents)
        if self._keys.issuperset(keys):
            return
        for key, content in zip(keys, contents, strict=True):
            if key in self._keys:
                continue
            try:
                thing = objects.FromString(content)
            except DECODE_ERRORS:  # counted as a loss when the frames are read
                continue
            if thing.id.value not in self.names:
                self.names[thing.id.value] = _names_or_none(thing)
            if is_key(key, thing):
                self._keys.add(key)

    def idents(self) -> dict[int, str]:
        """Id → ident: the name proper where nothing else bears it, else the number."""
        numbers = {str(number) for number in self.names}
        bearers: dict[str, int] = {}
        for names in self.names.values():
            for name in names[:1]:
                bearers[name] = bearers.get(name, 0) + 1
        return {
            number: names[0]
            if names and bearers[names[0]] == 1 and names[0] not in numbers
            else str(number)
            for number, names in self.names.items()
        }

    def ego(self, wanted: str, notes: list[str]) -> int | None:
        """The id of the ego, or ``None``.

        Parameters
        ----------
        wanted : str
            Id or name that the user gave; empty: the host vehicle, else what is called as egos are.
        notes : list of str
            Takes up what is odd.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave, or several things do.
        """
        if wanted:
            return self._named(wanted)
        hosts = [host for host in self.hosts if host in self.names]
        if len(hosts) > 1:
            told = ", ".join(str(host) for host in hosts[:LISTED])
            notes.append(f"several host vehicles are told (ids {told}); the first one is the ego")
        if hosts:
            return hosts[0]
        named = [
            number for number, names in self.names.items() if {n.lower() for n in names} & EGO_NAMES
        ]
        if len(named) != 1:
            return None
        called = self.idents()[named[0]]
        told = (
            f"host vehicle {next(iter(self.hosts))} is no moving object" if self.hosts else "none"
        )
        notes.append(f"the ego is {called!r}, by its name (host vehicle told: {told})")
        return named[0]

    def _named(self, wanted: str) -> int:
        for number in self.names:
            if wanted == str(number):
                return number
        named = [number for number, names in self.names.items() if wanted in names]
        if len(named) > 1:
            told = ", ".join(str(number) for number in named)
            raise TraceError(f"several objects are named {wanted!r}: ids {told}")
        if named:
            return named[0]
        things = [
            f"{number} ({', '.join(names)})" if names else str(number)
            for number, names in list(self.names.items())[:LISTED]
        ]
        more = f" and {len(self.names) - LISTED} more" if len(self.names) > LISTED else ""
        raise TraceError(
            f"no moving object has the id or name {wanted!r}; there are: "
            f"{', '.join(things) or 'none'}{more}"
        )


# The first reading of an OSI recording: what must be known before its frames can be read --------
# The map may stand behind the frames, static data may come once and never again, and the ego is known by
# an id that has to name something. So every ground truth message is looked at once when a recording is
# opened: which channel leads, which messages later ones depend on, who and what is in it.

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
    """Messages of a channel on which later ones depend, because they do not repeat their contents.

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
class OsiLead:
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
class OsiSurvey:
    """Findings of the first reading of a recording.

    Attributes
    ----------
    leads : dict
        Channel id → :class:`OsiLead`, of the channels with ground truth.
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
    lost_lanes : list of str
        Lanes that make no part of the map of its lanes, and why.
    window : tuple of int
        Log times, both included, between which messages are frames.
    signals : dict
        First bulb of each traffic light that is assigned to lanes → the signal of the map of its lanes.
    lights : dict
        Channel id → all traffic lights, as messages of that channel are to be read.
    """

    leads: dict[int, OsiLead] = field(default_factory=dict[int, OsiLead])
    hosts: dict[int, type[Any]] = field(default_factory=dict[int, type[Any]])
    cast: Cast = field(default_factory=Cast)
    statics: Statics = field(default_factory=Statics)
    map_text: str = ""
    map_name: str = ""
    map_refs: list[Ref] = field(default_factory=list[Ref])
    others: dict[int, tuple[int, Ref]] = field(default_factory=dict[int, tuple[int, Ref]])
    notes: list[str] = field(default_factory=list[str])
    lost_lanes: list[str] = field(default_factory=list[str])
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


def survey(recording: Recording) -> OsiSurvey:
    """Read a recording once, from end to end.

    Raises
    ------
    TraceError
        Descriptors are malformed, or the file cannot be read.
    """
    result = OsiSurvey()
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


def _make_map_of_lanes(result: OsiSurvey, name: str) -> None:
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
            result.lost_lanes += lead.lanes.lost
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


def _meet(
    recording: Recording, channel: int, result: OsiSurvey, maps: dict[int, type[Any]]
) -> bool:
    """Return whether a channel may lead or carries maps; make ready for one that is met for the first time."""
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
    result.lights[channel] = TrafficLights(EntityTable(TraceReport()), light_class(message))
    result.leads[channel] = OsiLead(
        name, message, object_class(message), _Latch(present, light_class(message)), lanes
    )
    return True


def _look_at_map(result: OsiSurvey, message: type[Any], run: Messages, row: int) -> None:
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


def _look_at_frame(result: OsiSurvey, channel: int, run: Messages, row: int) -> None:
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
