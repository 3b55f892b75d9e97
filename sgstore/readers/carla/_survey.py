"""First reading of a CARLA recording: find actors, channels, egos, traffic lights and the map.

The list of actors contains the type of each object. It may occur only once and late, like the positions of
lights and the map. All of them are collected at the opening of a recording.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.model.vocabulary import TypeMeaning, type_meanings, vague_kind
from sgstore.model.world import Event
from sgstore.readers._base import LISTED, Lead, Survey, listing, ref_of
from sgstore.readers._ros2 import (
    MAX_IDENT,
    ColumnReader,
    decode,
    ident_of,
    number,
    parse_definition,
    records,
    ros_name,
    ros_schema,
    text,
)
from sgstore.readers._stamps import Stamps
from sgstore.readers.carla._signals import read_places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import Floats
    from sgstore.readers._base import Ref
    from sgstore.readers._ros2 import Struct
    from sgstore.readers.carla._signals import Light


EGO_ROLES: Final = ("hero", "ego_vehicle", *(f"hero{i}" for i in range(10)))
"""Role names that CARLA's ROS bridge gives to a vehicle under test, highest priority first."""

_CLASSES: Final = {
    4: "person",
    5: "bicycle",
    6: "car",
    7: "truck",
    8: "motorcycle",
    9: "vehicle",
    10: "barrier",
    11: "sign",
}
"""Number in ``derived_object_msgs/Object.classification`` → kind."""


@dataclass(frozen=True, slots=True)
class Actor:
    """Actor (vehicle, walker, sensor, …) in CARLA's list of actors.

    Attributes
    ----------
    type_name : str
        Id of its blueprint: ``vehicle.tesla.model3``.
    role : str
        ``hero``, ``autopilot``, …; empty without a role.
    """

    type_name: str
    role: str


def meaning_of(type_name: str) -> TypeMeaning:
    """Return kind and subkind for the name of a CARLA blueprint, such as ``vehicle.audi.tt``.

    An unmapped vehicle has the general kind ``vehicle``.
    """
    meanings = type_meanings()
    name = type_name.lower()
    while name:
        if name in meanings:
            return meanings[name]
        name = name.rpartition(".")[0]
    return TypeMeaning(vague_kind(type_name))


def meaning_of_object(actor: Actor | None, classification: float) -> TypeMeaning:
    """Return kind and subkind of a CARLA object from its blueprint, or else from its class number.

    The class ``car`` is the bridge's default, so it is ignored for an unmapped blueprint.
    """
    number = int(classification) if math.isfinite(classification) else 0
    kind = _CLASSES.get(number, "unknown")
    if actor is None:
        return TypeMeaning(kind)
    meaning = meaning_of(actor.type_name)
    unmapped = meaning.kind == vague_kind(actor.type_name) and not meaning.subkind
    return TypeMeaning(kind) if unmapped and kind not in {"car", "unknown"} else meaning


@dataclass(slots=True)
class Egos:
    """Choice of the ego in a CARLA recording: the vehicle that the user names, or one with a usual role name.

    Attributes
    ----------
    wanted : str
        Id or role name from the user; empty: the ego of the recording.
    actors : dict
        Actor id → :class:`Actor`.
    by_role : dict
        Role name → actor id, from other messages than the list of actors.
    seen : set of int
        Ids of the objects so far.
    later : dict
        Actor id → a different blueprint in later lists.
    """

    wanted: str
    actors: dict[int, Actor] = field(default_factory=dict[int, Actor])
    by_role: dict[str, int] = field(default_factory=dict[str, int])
    seen: set[int] = field(default_factory=set[int])
    later: dict[int, list[Actor]] = field(default_factory=dict[int, list[Actor]])

    def id_of(self, role: str) -> int | None:
        """Return the id of the vehicle with a role name (such as ``hero``); ``None`` if unknown."""
        ids = self._with(role)
        return ids[0] if ids else self.by_role.get(role)

    def settle(self, driven: Iterable[str]) -> tuple[int | None, list[str]]:
        """Choose the ego of a CARLA recording. Return its id, and warnings about the choice.

        Parameters
        ----------
        driven : iterable of str
            Role names of the vehicles with their own channels.

        Raises
        ------
        TraceError
            The given name does not exist, or is ambiguous.
        """
        if self.wanted:
            return self._named(), []
        candidates = {
            role: ident
            for role in (*EGO_ROLES, *sorted(driven))
            if (ident := self.id_of(role)) is not None
        }
        found = list(dict.fromkeys(candidates.values()))
        if not found:
            return None, ["no vehicle has the role of an ego; name one as the ego"]
        if len(found) == 1:
            return found[0], []
        names = ", ".join(f"{role!r} ({ident})" for role, ident in candidates.items())
        return found[0], [f"several egos: {names}; the first is taken unless one is named"]

    def _with(self, role: str) -> list[int]:
        return [ident for ident, actor in self.actors.items() if role and actor.role == role]

    def _named(self) -> int:
        if self.wanted.isdecimal() and int(self.wanted) in self.actors.keys() | self.seen:
            return int(self.wanted)
        ids = self._with(self.wanted)
        if len(ids) > 1:
            listed = ", ".join(map(str, ids[:LISTED]))
            raise TraceError(f"several actors have the role {self.wanted!r}: ids {listed}")
        if ids:
            return ids[0]
        if self.wanted in self.by_role:
            return self.by_role[self.wanted]
        raise TraceError(f"no actor has the id or role {self.wanted!r}; {_listing(self)}")


def _listing(egos: Egos) -> str:
    """Return a text with the vehicles and pedestrians that can be the ego, for an error message."""
    actors = sorted(egos.actors.items(), key=lambda item: (item[1].role == "autopilot", item[0]))
    things = [
        f"{ident} ({actor.role or actor.type_name})"
        for ident, actor in actors
        if actor.type_name.startswith(("vehicle.", "walker."))
    ]
    return listing(things or [str(ident) for ident in sorted(egos.seen)])


# Contents of the channels of CARLA's ROS bridge, by their schemas. Topics are arbitrary, with one exception: a
# message of a vehicle's own sensors lacks the vehicle, but its topic contains the role name of the vehicle,
# ``/carla/<role>/vehicle_status``.
#
# Source: carla-simulator/ros-bridge, ros-carla-msgs, astuff_sensor_msgs (message definitions).

OBJECTS: Final = "objects"
ACTORS: Final = "actors"
LIGHT_PLACES: Final = "light places"
LIGHT_STATES: Final = "light states"
WORLD: Final = "world"
TEXT: Final = "text"
STATUS: Final = "status"
COMMANDS: Final = "commands"
VEHICLE: Final = "vehicle"
ODOMETRY: Final = "odometry"
COLLISION: Final = "collision"
LANE_INVASION: Final = "lane invasion"
VEHICLE_LIGHTS: Final = "vehicle lights"

CONTENTS: Final = {
    "derived_object_msgs/ObjectArray": OBJECTS,
    "carla_msgs/CarlaActorList": ACTORS,
    "carla_msgs/CarlaTrafficLightInfoList": LIGHT_PLACES,
    "carla_msgs/CarlaTrafficLightStatusList": LIGHT_STATES,
    "carla_msgs/CarlaWorldInfo": WORLD,
    "std_msgs/String": TEXT,
    "carla_msgs/CarlaEgoVehicleStatus": STATUS,
    "carla_msgs/CarlaEgoVehicleControl": COMMANDS,
    "carla_msgs/CarlaEgoVehicleInfo": VEHICLE,
    "nav_msgs/Odometry": ODOMETRY,
    "carla_msgs/CarlaCollisionEvent": COLLISION,
    "carla_msgs/CarlaLaneInvasionEvent": LANE_INVASION,
}
"""Schema → content type of its messages."""

LASTING: Final = frozenset({ACTORS, LIGHT_PLACES, LIGHT_STATES, WORLD, VEHICLE})
"""Content types whose facts stay valid until the next message of the type."""

OF_ONE_VEHICLE: Final = frozenset({STATUS, COMMANDS, VEHICLE, ODOMETRY, COLLISION, LANE_INVASION})
"""Content types whose topics contain the role name of a vehicle."""

FOR_FRAMES: Final = (OF_ONE_VEHICLE - {VEHICLE}) | {OBJECTS, LIGHT_STATES, VEHICLE_LIGHTS}
"""Content types that the second pass reads together with the frames."""

NEVER: Final = -(1 << 62)
"""Time that stands for a missing message; ns."""
_MAX_SECONDS: Final = 1 << 32


def content_of(recording: Recording, channel: int) -> str:
    """Return the type of content of a CARLA channel (such as objects); empty if it is not supported.

    The bridge has no messages for vehicle lights. They are read from JSON messages ``{"t": s, "lights": {id:
    carla.VehicleLightState}}`` of a schema whose name ends in ``VehicleLights``.
    """
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    if schema and record.message_encoding == "json" and schema.name.endswith("VehicleLights"):
        return VEHICLE_LIGHTS
    return CONTENTS.get(ros_name(recording, channel), "")


def structure(recording: Recording, channel: int) -> Struct | None:
    """Return the ROS structure of a channel's messages; ``None`` if they have another format.

    Raises
    ------
    TraceError
        The definition is missing or malformed.
    """
    schema = ros_schema(recording, channel)
    return None if schema is None else parse_definition(schema.name, schema.data)


def role_in(topic: str) -> str:
    """Return the role name in a CARLA topic: ``hero`` in ``/carla/hero/vehicle_status``; empty without one."""
    parts = topic.split("/")
    return parts[-2] if len(parts) > 2 else ""


def stamp_of(message: dict[str, Any]) -> int | None:
    """Return the time stamp in a message header; ns. ``None`` if missing or out of range."""
    return stamp_from([number(message, f"header.stamp.{part}") for part in ("sec", "nanosec")])


def stamp_from(told: Floats | list[float]) -> int | None:
    """Convert seconds and nanoseconds to a time stamp; ns. ``None`` if missing or out of range."""
    seconds, nanos = told
    there = abs(seconds) < _MAX_SECONDS and abs(nanos) < _MAX_SECONDS
    return int(seconds) * 1_000_000_000 + int(nanos) if there else None


# Collisions and crossed lane markings, from the sensors of CARLA's bridge.
# Source: ros-carla-msgs, CarlaCollisionEvent and CarlaLaneInvasionEvent.

EVENTS: Final = frozenset({COLLISION, LANE_INVASION})
"""Content types of messages that describe events."""
_MARKINGS: Final = {0: "other", 1: "broken", 2: "solid"}


def event_of(
    content: str, message: dict[str, Any], place: tuple[int, int, int], ident: str
) -> Event:
    """Return the event (collision or lane invasion) that a CARLA message reports.

    ``place``: simulation time, log time, number of the previous frame; ``ident``: id of the vehicle.
    """
    if content == COLLISION:
        other = ident_of(message, "other_actor_id")
        impulse = math.hypot(*(number(message, f"normal_impulse.{axis}") for axis in "xyz"))
        return Event(
            "collision",
            *place,
            ident,
            "" if other is None else str(other),
            impulse if math.isfinite(impulse) else None,
        )
    told = message.get("crossed_lane_markings")
    crossed = told.tolist() if isinstance(told, np.ndarray) else []
    names = dict.fromkeys(_MARKINGS.get(marking, "other") for marking in crossed)
    return Event("lane_invasion", *place, ident, detail=", ".join(names))


# First reading.

SAME_TICK: Final = 1_000_000
"""Largest difference between two stamps of the same instant, because the bridge rounds them differently; ns."""
SAME_PLACE: Final = 0.01
"""Largest distance between an object and the odometry position of its vehicle; m."""

_PLACES: Final = ("id", "pose.position.x", "pose.position.y", "pose.position.z")
_ODOMETRY: Final = tuple(f"pose.{path}" for path in _PLACES[1:])
_MAP_BEGINS: Final = 4096
_MOST_TRIES: Final = 200
_MOST_NOTES: Final = 100


class CarlaSurvey(Survey[Lead]):
    """First reading of a CARLA recording. It collects information that the frames need.

    Attributes
    ----------
    contents : dict
        Channel id → content type of its messages, such as :data:`OBJECTS`.
    structures : dict
        Channel id → structure of its messages.
    egos : Egos
        With the actors of the recording.
    lights : dict
        Id → :class:`~sgstore.readers.carla._signals.Light`.
    ego : int or None
        Id of the ego.
    """

    def __init__(self, recording: Recording, wanted: str) -> None:
        super().__init__(recording, wanted)
        self.contents: dict[int, str] = {}
        self.structures: dict[int, Struct] = {}
        self.egos = Egos(wanted)
        self.ego: int | None = None
        self.lights: dict[int, Light] = {}
        self._tables: dict[int, ColumnReader] = {}
        # Positions of the vehicles with a role, to find them among objects without a list of actors: their
        # odometry by role; stamp, ids and positions of the objects in the last frame.
        self._odometry: dict[str, tuple[int | None, Floats]] = {}
        self._objects: tuple[int | None, Floats] = (None, np.zeros((0, 4)))
        self._tries = 0
        self._last: dict[int, bytes] = {}
        self._lasting: list[Ref] = []

    def rank(self, lead: Lead) -> tuple[int, ...]:
        """Return the sort key of a channel for the choice of the frame channel: frames, then bytes."""
        return lead.frames, lead.weight

    @property
    def driven(self) -> dict[int, str]:
        """Role name (such as ``hero``) of the vehicle of each channel that is about one vehicle."""
        return {
            channel: role_in(self.topic(channel))
            for channel, content in self.contents.items()
            if content in OF_ONE_VEHICLE
        }

    def ego_named(self, name: str) -> str | None:
        """Return the id of the ego with a name; ``None`` if only another reading can find the ego."""
        egos = self.egos
        if name.isdecimal() and int(name) not in egos.actors.keys() | egos.seen:
            return None
        found, _ = replace(egos, wanted=name).settle(())
        return str(found)

    def find_ego(self) -> str:
        """Find the vehicle that has the role name of the ego, and return its id."""
        self.ego, self.about_ego = self.egos.settle(self.driven.values())
        return "" if self.ego is None else str(self.ego)

    def role(self, channel: int) -> str:
        """Return the role of a channel: frames, sensor data, or ``lasting`` for data such as actor lists."""
        lasts = channel != self.leading and self.contents.get(channel) in LASTING
        return "lasting" if lasts else super().role(channel)

    def context(self) -> list[Ref]:
        """Return the file positions of maps, actor lists and calibrations. Later messages need them."""
        return [*self._lasting, *super().context()]

    def meet(self, channel: int) -> bool:
        """Return True if the messages of a channel are frames, or contain data for later frames."""
        return self._content(channel) in LASTING | {OBJECTS}

    def watches(self, channel: int, *, met: bool) -> bool:
        """Return True if the first reading must examine the messages of a channel."""
        content = self.contents[channel]
        if content == TEXT:
            return channel not in self._last  # A text other than a map is examined only once.
        return met or (content == ODOMETRY and self._is_lost(channel))

    def keeps(self, channel: int) -> bool:
        """Return True if messages of a channel are needed in the second reading, in which frames are made."""
        return self._content(channel) in FOR_FRAMES

    def _content(self, channel: int) -> str:
        """Return the type of content of a CARLA channel, such as objects; empty if it is not needed."""
        if channel not in self.contents:
            self.contents[channel] = content = content_of(self.recording, channel)
            try:
                self._learn(channel, content)
            except TraceError as error:
                self.contents[channel] = ""
                reason = f"channel {self.topic(channel)!r}: {error.reason}"
                if content:
                    self.lost.add(reason, 0)
                else:
                    self._note(f"{reason}; its messages can only be handed on as they are")
        return self.contents[channel]

    def _learn(self, channel: int, content: str) -> None:
        """Parse the ROS structure of a channel's messages."""
        found = structure(self.recording, channel)
        if found is None:
            return
        self.structures[channel] = found
        if content == OBJECTS:
            self._tables[channel] = ColumnReader(found, _PLACES, "objects")
            stamps = self.shared_stamps(channel, Stamps(explicit=False))
            self.leads[channel] = Lead(stamps=stamps)

    def look(self, run: Messages, row: int) -> None:
        """Collect information from a CARLA message. Unreadable messages are counted."""
        channel = int(run.channel[row])
        if self.contents[channel] in {TEXT, ODOMETRY} and not self.watches(channel, met=False):
            return
        if self.contents[channel] == OBJECTS:
            self.count(run, row, int(run.length[row]))
            self.leads[channel].stamps.next()
            with suppress(TraceError):  # Reported during the reading of the frames.
                head = self._tables[channel].head(run.data(row))
                self.see_stamp(run, row, stamp_of(head))
                self._look_for_egos(run.data(row), channel)
            return
        try:
            data = bytes(run.data(row))
            content = self.contents[channel]
            if content == ODOMETRY:
                message = decode(self.structures[channel], data)
                place = np.array([number(message, path) for path in _ODOMETRY])
                role = role_in(self.topic(channel))
                self._odometry[role] = (stamp_of(message), place)
                self._find_egos()
            elif self._last.get(channel) != data:  # The bridge repeats many messages.
                news = content == LIGHT_STATES  # Light states are read with the frames.
                news = news or self._take[content](decode(self.structures[channel], data))
                self._last[channel] = data
                if news and content in LASTING:
                    self._lasting.append(ref_of(run, row))
        except TraceError as error:
            reason = f"a message of {self.topic(channel)!r} cannot be read: {error.reason}"
            self.lost.add(reason, int(run.log_time_ns[row]), int(run.length[row]))

    @property
    def _take(self) -> dict[str, Callable[[dict[str, Any]], bool]]:
        """Functions that collect information from messages, by content type. True means new information."""
        return {
            ACTORS: self._take_actors,
            LIGHT_PLACES: self._take_lights,
            WORLD: lambda told: self._take_map(text(told, "opendrive"), text(told, "map_name")),
            TEXT: self._take_text,
            VEHICLE: self._take_vehicle,
        }

    def _take_lights(self, message: dict[str, Any]) -> bool:
        self.lights = read_places(message) | self.lights
        return True

    def _take_vehicle(self, message: dict[str, Any]) -> bool:
        ident = ident_of(message, "id")
        if ident is not None:
            self.egos.by_role.setdefault(text(message, "rolename"), ident)
        return True

    def _take_text(self, message: dict[str, Any]) -> bool:
        told = text(message, "data")
        return "<OpenDRIVE" in told[:_MAP_BEGINS] and self._take_map(told, "")

    def _take_actors(self, message: dict[str, Any]) -> bool:
        """Add the actors in a CARLA message to the known ones. Return True if one is new."""
        actors = self.egos.actors
        known = len(actors)
        for told in records(message, "actors"):
            ident, role = ident_of(told, "id"), text(told, "rolename")
            if ident is None:
                continue
            actor = Actor(text(told, "type"), "" if role == "None" else role)
            before = actors.setdefault(ident, actor)
            if before.type_name != actor.type_name:
                later = self.egos.later.setdefault(ident, [])
                if actor not in later and len(later) < _MOST_NOTES:
                    later.append(actor)
                note = (
                    f"actor {ident} is called {before.type_name!r} and {actor.type_name!r};"
                    " the first name counts while its objects have the class of the first"
                )
                self._note(note)
        return len(actors) > known

    def _take_map(self, content: str, name: str) -> bool:
        if not self.map_text:
            self.map_text = content
            self.map_name = PurePosixPath(name).name
        elif content and content != self.map_text:
            self._note("the recording carries more than one road map; the first one counts")
        return True

    def _note(self, note: str) -> None:
        """Add a warning to the report once. The number of warnings is limited."""
        if note not in self.notes and len(self.notes) <= _MOST_NOTES:
            more = "and more that is as odd"
            self.notes.append(note if len(self.notes) < _MOST_NOTES else more)

    def _is_lost(self, channel: int) -> bool:
        """Return True if a channel has the odometry of a vehicle that is not known yet."""
        role = role_in(self.topic(channel))
        tried = self._tries >= _MOST_TRIES
        return bool(role) and not tried and self.egos.id_of(role) is None

    def _look_for_egos(self, data: memoryview, channel: int) -> None:
        egos, wanted = self.egos, self.egos.wanted
        named = wanted.isdecimal() and int(wanted) not in egos.actors.keys() | egos.seen
        lost = any(egos.id_of(role) is None for role in self._odometry)
        if not egos.seen or named or (lost and self._tries < _MOST_TRIES):
            head, table = self._tables[channel].read(data)
            table = table[(np.abs(table) < MAX_IDENT).all(axis=1)]
            egos.seen.update(table[:, 0].astype(np.int64).tolist())
            self._objects = stamp_of(head), table
            self._find_egos()

    def _find_egos(self) -> None:
        """Find the vehicle of each role name: the only object at the position in its odometry."""
        stamp, table = self._objects
        self._tries += 1
        for role, (when, place) in self._odometry.items():
            if when is None or stamp is None:
                continue
            near = np.abs(table[:, 1:] - place).max(axis=1, initial=0) <= SAME_PLACE
            if abs(when - stamp) <= SAME_TICK and near.sum() == 1:
                self.egos.by_role.setdefault(role, int(table[near, 0][0]))
