"""First reading of an OSI recording: find moving objects, ego and road map.

The id of an object is a number from the simulator, which often changes between runs. Users know an object by
its name in the scenario. If the recording contains a unique name, it becomes the entity's ident; otherwise, the
number does.

Names are in ``source_reference``: ``entity_name:cutter`` as written by esmini and others, or a plain name after
the OpenSCENARIO type of the entity (``Vehicle``, ``cutter``).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Self

from sgstore.errors import MapError, TraceError
from sgstore.maps.roads import OF_LANES
from sgstore.model.world import TraceReport
from sgstore.readers._base import LISTED, Lead, Ref, Survey, listing, ref_of
from sgstore.readers._blocks import EntityTable
from sgstore.readers._stamps import Stamps
from sgstore.readers.osi._lanes import FIELDS as LANE_FIELDS
from sgstore.readers.osi._lanes import LaneSignal, OsiLanes
from sgstore.readers.osi._objects import Statics, TrafficLights
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    GROUND_TRUTH,
    HOST_DATA,
    ROAD_MAP,
    SENSOR_VIEW,
    TRAFFIC_LIGHT,
    has_field,
    identifiers,
    lights_of,
    message_class,
    object_class,
    parse,
    part_class,
    time_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mcap.records import Schema

    from sgstore.mcap import Messages, Recording


EGO_NAMES: Final = frozenset({"ego", "hero", "host", "ego_vehicle", "host_vehicle"})
"""Usual names of the ego in lower case, for recordings without a host vehicle id."""

_SORTS: Final = frozenset({"Vehicle", "Pedestrian", "MiscObject", "ExternalObjectReference"})
"""Entity types of OpenSCENARIO, not names of entities (ASAM OpenSCENARIO XML 1.3, ``EntityObject``)."""
_MOST_HOSTS: Final = 100


def names_of(moving_object: Any) -> list[str]:
    """Return possible names of an OSI moving object, the best first. They come from its source references."""
    parts = [text.partition(":") for _, text in identifiers(moving_object)]
    named = [value for key, _, value in parts if key == "entity_name" and value]
    bare = [key for key, colon, _ in parts if key and not colon and key not in _SORTS]
    return [*named, *bare]


def _names_or_none(moving_object: Any) -> list[str]:
    try:
        return names_of(moving_object)
    except ValueError:  # It has too many references; its number becomes the name.
        return []


def hosts_of(message: Any) -> list[int]:
    """Return possible ids of the host vehicle (ego) in an OSI message, the best first. 0 is a valid id."""
    names = ("global_ground_truth", "host_vehicle_data")
    inner: list[Any] = [getattr(message, name, None) for name in names]
    parts = [message, *(part for part in inner if hasattr(part, "DESCRIPTOR"))]
    told = [part for part in parts if "host_vehicle_id" in part.DESCRIPTOR.fields_by_name]
    return [part.host_vehicle_id.value for part in told if part.HasField("host_vehicle_id")]


def keys_of(objects: list[bytes], last: list[bytes]) -> list[bytes]:
    """For each serialised OSI object, return its first bytes, which contain its id.

    If the objects match ``last``, an earlier result of this function, the same list is returned.
    """
    if len(objects) == len(last) and all(map(bytes.startswith, objects, last)):
        return last
    try:
        return [content[: content[1] + 2] for content in objects]
    except IndexError:  # An object is too short.
        return [content[: content[1] + 2] if len(content) > 1 else content for content in objects]


def is_key(key: bytes, thing: Any) -> bool:
    """Return True if the first bytes of a serialised OSI object contain only its id."""
    ident = thing.id.SerializeToString()
    return len(ident) < 0x80 and key == b"\x0a" + bytes([len(ident)]) + ident


@dataclass(slots=True)
class Cast:
    """Moving objects of an OSI recording, their names, and possible egos.

    Attributes
    ----------
    names : dict
        Id → names, the proper name first.
    hosts : dict
        Host vehicle ids, in order.
    """

    names: dict[int, list[str]] = field(default_factory=dict[int, list[str]])
    hosts: dict[int, None] = field(default_factory=dict[int, None])
    _keys: set[bytes] = field(default_factory=set[bytes])
    _last: list[bytes] = field(default_factory=list[bytes])

    def look(self, message: Any, contents: list[bytes], objects: type[Any]) -> None:
        """Add the moving objects of an OSI message.

        Parameters
        ----------
        message : Message
        contents : list of bytes
            Its moving objects.
        objects : type
            Class of these.
        """
        if len(self.hosts) < _MOST_HOSTS:
            self.hosts.update(dict.fromkeys(hosts_of(message)))
        keys = keys_of(contents, self._last)
        if keys is self._last:
            return
        if self._keys.issuperset(keys):
            self._last = keys
            return
        for key, content in zip(keys, contents, strict=True):
            if key in self._keys:
                continue
            try:
                thing = objects.FromString(content)
            except DECODE_ERRORS:  # Counted as a loss during the reading of the frames.
                continue
            if thing.id.value not in self.names:
                self.names[thing.id.value] = _names_or_none(thing)
            if is_key(key, thing):
                self._keys.add(key)

    def idents(self) -> dict[int, str]:
        """Return the name of each moving object; its number if the name is not unique."""
        numbers = {str(number) for number in self.names}
        bearers = Counter(names[0] for names in self.names.values() if names)
        return {
            number: names[0]
            if names and bearers[names[0]] == 1 and names[0] not in numbers
            else str(number)
            for number, names in self.names.items()
        }

    def ego(self, wanted: str, notes: list[str]) -> int | None:
        """Return the OSI id of the ego vehicle; ``None`` if no ego is known.

        Parameters
        ----------
        wanted : str
            Id or name from the user; empty: the host vehicle, else an object with a usual name of egos.
        notes : list of str
            Receives warnings.

        Raises
        ------
        TraceError
            The given name does not exist, or is ambiguous.
        """
        if wanted:
            return self._named(wanted)
        hosts = [host for host in self.hosts if host in self.names]
        if len(hosts) > 1:
            told = ", ".join(str(host) for host in hosts[:LISTED])
            notes.append(f"several host vehicles (ids {told}); the ego is that of each message")
        if hosts:
            return hosts[0]
        named = [
            number for number, names in self.names.items() if {n.lower() for n in names} & EGO_NAMES
        ]
        if len(named) != 1:
            return None
        called = self.idents()[named[0]]
        told = f"host vehicle {next(iter(self.hosts))}: no moving object" if self.hosts else "none"
        notes.append(f"the ego is {called!r}, chosen by name (host vehicle in the file: {told})")
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
            for number, names in self.names.items()
        ]
        raise TraceError(f"no moving object has the id or name {wanted!r}; {listing(things)}")


# First reading of an OSI recording, which collects the facts needed for its frames. The map may come after the
# frames, static data may occur only once, and the ego id must belong to an object. Every ground truth message
# is therefore examined once at the opening of a recording. The results are the leading channel, the messages
# that later ones depend on, and the objects.

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
"""Fields of a ground truth with constant objects, which a producer may write only once."""


@dataclass(slots=True)
class _Latch:
    """Collector of messages with static objects or lights on which later messages depend.

    A static object is defined by the first message that contains it. If all later messages contain it, too,
    none depends on the first. A light's state is defined by the last message before one without the light.
    """

    fields: tuple[str, ...]
    bulb: type[Any] | None = None
    words: dict[bytes, int | None] = field(default_factory=dict[bytes, "int | None"])
    spoken: list[bytes] = field(default_factory=list[bytes])
    told_by: dict[tuple[str, int], Ref] = field(default_factory=dict[tuple[str, int], Ref])
    repeated: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])
    lights: set[int] = field(default_factory=set[int])
    last: Ref | None = None
    refs: dict[Ref, None] = field(default_factory=dict[Ref, None])

    def look(self, told: Mapping[str, Any], words: list[bytes], ref: Ref) -> bool:
        """Examine the static objects and lights of a message. Return True if a lane or lane boundary is new.

        Parameters
        ----------
        told : mapping
            Its static objects by field.
        words : list of bytes
            Its traffic lights.
        ref : Ref
        """
        new: set[tuple[str, int]] = set()
        if told or self.repeated:
            items = {(name, item.id.value) for name, things in told.items() for item in things}
            gone = self.repeated - items
            for item in gone:
                self.refs[self.told_by[item]] = None
            new = {item for item in items if item not in self.told_by}
            self.repeated = (self.repeated - gone) | new
            self.told_by.update(dict.fromkeys(new, ref))
        # Ids of the lights in a message; unchanged lights are not read again.
        if words != self.spoken:
            known = self.words
            self.words = {word: known.get(word) or self._ident(word) for word in words}
            lights = {ident for ident in self.words.values() if ident is not None}
            if self.last is not None and self.lights - lights:
                self.refs[self.last] = None
            self.spoken, self.lights = words, lights
        self.last = ref
        return any(name in LANE_FIELDS for name, _ in new)

    def _ident(self, word: bytes) -> int | None:
        try:
            return None if self.bulb is None else int(self.bulb.FromString(word).id.value)
        except DECODE_ERRORS:  # Reported during the reading of the frames.
            return None


@dataclass(slots=True, kw_only=True)
class OsiLead(Lead):
    """Channel of an OSI recording. It may become the frame channel.

    ``objects``: class of its moving objects. ``latch``: its messages that others depend on. ``lanes``: its
    lanes; ``None`` if they are unreadable. The weight of a frame is 1 if it has moving objects.
    """

    schema: str
    message: type[Any]
    objects: type[Any]
    latch: _Latch
    lanes: OsiLanes | None


def schema_name(recording: Recording, channel: int) -> str:
    """Return the schema name of a channel with protobuf messages, otherwise an empty text."""
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    protobuf = schema is not None and "protobuf" in {schema.encoding, record.message_encoding}
    return schema.name if schema is not None and protobuf else ""


class OsiSurvey(Survey[OsiLead]):
    """First reading of an OSI recording. It collects information that the frames need.

    The map is OpenDRIVE if the recording contains it. Otherwise, it is made of the lanes in the ground truth.

    Attributes
    ----------
    hosts : dict
        Channel id → message class, for channels with data of the host vehicle.
    cast : Cast
        The moving objects.
    statics : Statics
        The static objects.
    ego : int or None
        Id of the first ego.
    follows : bool
        True if the host vehicle of each message is the ego.
    signals : dict
        First bulb of each traffic light with assigned lanes → its signal in the map of the lanes.
    """

    def __init__(self, recording: Recording, wanted: str) -> None:
        super().__init__(recording, wanted)
        self.hosts: dict[int, type[Any]] = {}
        self.cast = Cast()
        self.statics = Statics()
        self.ego: int | None = None
        self.follows = False
        self.signals: dict[int, LaneSignal] = {}
        self._maps: dict[int, type[Any]] = {}
        self._map_refs: list[Ref] = []
        self._lights: dict[int, TrafficLights] = {}  # By channel.

    def rank(self, lead: OsiLead) -> tuple[int, ...]:
        """Return the sort key of a channel for the choice of the frame channel. Frames with objects win."""
        return lead.weight, lead.frames, lead.schema == GROUND_TRUTH

    def read(self) -> Self:
        """Read all messages once and collect information. If the road map is missing, make one from lanes."""
        super().read()
        if not self.map_text:
            leading = self.first_lead()
            self.signals = {} if leading < 0 else self._lights[leading].signals()
            self._make_map_of_lanes(leading)
        return self

    def no_frames(self) -> str:
        """Return the text that explains why an OSI recording has no frames."""
        topics = [repr(self.topic(channel)) for channel in self.leads]
        where = ", ".join(topics) or "the channels of its schema"
        return f"no ground truth message can be read from {where}"

    def find_ego(self) -> str:
        """Find the ego among the moving objects. Return its id as text."""
        self.ego = self.cast.ego(self.wanted, self.about_ego)
        self.follows = not self.wanted and self.ego in self.cast.hosts
        return "" if self.ego is None else self.cast.idents()[self.ego]

    def role(self, channel: int) -> str:
        """Return the role of a channel, for example ``map`` for OpenDRIVE messages."""
        is_map = channel != self.leading and schema_name(self.recording, channel) == ROAD_MAP
        return "map" if is_map else super().role(channel)

    def context(self) -> set[Ref]:
        """Return the file positions of the messages that later messages need.

        For other channels than the leading one, these are the first messages with each static object.
        """
        refs = {*self._map_refs, *super().context()}
        for channel, other in self.leads.items():
            refs.update(other.latch.refs)
            if channel != self.leading:
                refs.update(other.latch.told_by.values())
        return refs

    def keeps(self, channel: int) -> bool:
        """Return True if messages of a channel are needed in the second reading, in which frames are made."""
        return schema_name(self.recording, channel) in {GROUND_TRUTH, SENSOR_VIEW, HOST_DATA}

    def meet(self, channel: int) -> bool:
        """Return True if a channel contains frames or maps. If so, prepare a decoder for it."""
        if channel in self.leads or channel in self._maps:
            return True
        name = schema_name(self.recording, channel)
        if name not in {GROUND_TRUTH, SENSOR_VIEW, ROAD_MAP, HOST_DATA} or channel in self.hosts:
            return False
        schema = self.recording.schemas[self.recording.channels[channel].schema_id]
        message = message_class(schema)
        if name == HOST_DATA:
            self.hosts[channel] = message  # A separate message that belongs to a frame.
        elif name == ROAD_MAP:
            self._maps[channel] = message
        else:
            self._meet_lead(channel, schema, message)
        return name != HOST_DATA

    def _meet_lead(self, channel: int, schema: Schema, message: type[Any]) -> None:
        prefix = "global_ground_truth." if schema.name == SENSOR_VIEW else ""
        present = tuple(field for field in STATIC_FIELDS if has_field(message, prefix + field))
        try:
            lanes = OsiLanes(schema)
        except TraceError as error:
            lanes = None
            self.notes.append(f"its lanes cannot be read: {error.reason}")
        bulbs = part_class(message, TRAFFIC_LIGHT)
        self._lights[channel] = TrafficLights(EntityTable(TraceReport()), bulbs)
        self.leads[channel] = OsiLead(
            schema=schema.name,
            message=message,
            objects=object_class(message),
            latch=_Latch(present, bulbs),
            lanes=lanes,
            stamps=self.shared_stamps(channel, Stamps(logged=self.recording.has_log_times)),
        )

    def look(self, run: Messages, row: int) -> None:
        """Collect information from an OSI message: a road map or a frame."""
        channel = int(run.channel[row])
        if channel in self._maps:
            self._look_at_map(self._maps[channel], run, row)
        else:
            self._look_at_frame(self.leads[channel], run, row)

    def _look_at_map(self, message: type[Any], run: Messages, row: int) -> None:
        self._map_refs.append(ref_of(run, row))
        try:
            told = message.FromString(bytes(run.data(row)))
            text, name = str(told.open_drive_xml_content), str(told.map_reference)
        except DECODE_ERRORS as error:
            self.notes.append(f"a message of schema {ROAD_MAP} cannot be read: {error}")
            return
        if self.map_text and text and text != self.map_text:
            self.notes.append("the recording carries more than one road map; the first one counts")
        elif text and not self.map_text:
            self.map_text = text
            # Producers write a local file path; its last part is the name of the map.
            self.map_name = PurePosixPath(name.replace("\\", "/")).name

    def _look_at_frame(self, lead: OsiLead, run: Messages, row: int) -> None:
        lead.stamps.next()
        try:
            data = bytes(run.data(row))
            message, ground, objects = parse(lead.message, data)
            self.see_stamp(run, row, time_of(message, ground))
            told = {name: some for name in lead.latch.fields if (some := getattr(ground, name))}
            words = lights_of(ground)
            if lead.latch.look(told, words, ref_of(run, row)) and lead.lanes is not None:
                lead.lanes.take(data)
            for lights in self._lights.values():
                lights.update(words)
            if told:
                self.statics.look(told, int(run.log_time_ns[row]))
            self.cast.look(message, objects, lead.objects)
        except DECODE_ERRORS:  # Counted as a loss during the reading of the frames.
            return
        self.count(run, row, len(objects) > 0)

    def _make_map_of_lanes(self, leading: int) -> None:
        """Make a road map from OSI lanes. Prefer the lanes in the frame channel."""
        for _, lead in sorted(self.leads.items(), key=lambda item: item[0] != leading):
            if lead.lanes is None:
                continue
            try:
                signals = [*self.signals.values(), *self.statics.signals()]
                self.map_text, told = lead.lanes.text(signals)
            except MapError as error:
                lead.lanes.warnings.append(str(error))
            else:
                self.lost_lanes += lead.lanes.lost
                if self.map_text:
                    self.map_name = told or f"{self.recording.path.stem}{OF_LANES}"
                    return
            self.notes += [f"its lanes make no map: {what}" for what in lead.lanes.warnings]
