"""Actors, channels and events of CARLA recordings.

Actors of CARLA: what a blueprint means, and which of them is the ego.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.readers._ros2 import number, parse_definition, short_name
from sgstore.vocabulary import TypeMeaning, type_meanings, vague_kind
from sgstore.world import Event

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mcap.records import Channel, Schema

    from sgstore.mcap import Recording
    from sgstore.readers._ros2 import Struct
    from sgstore.world import Floats


EGO_ROLES: Final = ("hero", "ego_vehicle", *(f"hero{i}" for i in range(10)))
"""Role names by which the bridge knows a vehicle under test, in the order in which they are asked."""

LISTED: Final = 20
"""Actors that an error lists by name."""

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
"""``derived_object_msgs/Object.classification`` → kind."""


@dataclass(frozen=True, slots=True)
class Actor:
    """An actor as the list of actors has it.

    Attributes
    ----------
    type_name : str
        Id of its blueprint: ``vehicle.tesla.model3``.
    role : str
        ``hero``, ``autopilot``, …; empty: none.
    """

    type_name: str
    role: str


def meaning_of(type_name: str) -> TypeMeaning:
    """Meaning of a blueprint: that of its id, else of the longest beginning of it that ends before a dot.

    Of a vehicle that nothing maps it is only known that it is one.
    """
    meanings = type_meanings()
    name = type_name.lower()
    while name:
        if name in meanings:
            return meanings[name]
        name = name.rpartition(".")[0]
    return TypeMeaning(vague_kind(type_name))


def meaning_of_object(actor: Actor | None, classification: float) -> TypeMeaning:
    """Meaning of an object: by its blueprint, else by the class that the bridge gives it.

    The bridge says "car" whenever it does not know better, so of a blueprint that nothing maps this word is
    not believed.
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
    """Choice of the ego: a vehicle with one of the bridge's role names, or the one that the user names.

    Attributes
    ----------
    wanted : str
        Id or role name that the user gave; empty: as the recording says.
    actors : dict
        Actor id → :class:`Actor`.
    by_role : dict
        Role name → actor id, as other messages than the list of actors tell it.
    seen : set of int
        Ids of objects that were seen.
    """

    wanted: str
    actors: dict[int, Actor] = field(default_factory=dict[int, Actor])
    by_role: dict[str, int] = field(default_factory=dict[str, int])
    seen: set[int] = field(default_factory=set[int])

    def id_of(self, role: str) -> int | None:
        """The vehicle with a role name, if there is one."""
        ids = self._with(role)
        return ids[0] if ids else self.by_role.get(role)

    def settle(self, driven: Iterable[str]) -> tuple[int | None, list[str]]:
        """The ego's id, and what is odd about the choice.

        Parameters
        ----------
        driven : iterable of str
            Role names of the vehicles that channels of their own tell of.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave, or several actors do.
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
            return None, ["no vehicle has the role of an ego: there is none unless one is named"]
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
    """Actors that could have been meant."""
    things = [
        f"{ident} ({actor.role or actor.type_name})"
        for ident, actor in _vehicles(egos.actors).items()
    ] or [str(ident) for ident in sorted(egos.seen)]
    more = f" and {len(things) - LISTED} more" if len(things) > LISTED else ""
    return f"there are: {', '.join(things[:LISTED]) or 'none'}{more}"


def _vehicles(actors: Mapping[int, Actor]) -> dict[int, Actor]:
    """The actors that move, those with a role of their own first."""
    moving = {
        ident: actor
        for ident, actor in actors.items()
        if actor.type_name.startswith(("vehicle.", "walker."))
    }
    return dict(sorted(moving.items(), key=lambda item: (item[1].role == "autopilot", item[0])))


# What the channels of a recording of CARLA's ROS bridge carry, by their schemas -----------------
# Topics are free and tell nothing, with one exception: a message of a vehicle's own sensors does not say whose
# it is, but the bridge puts them under the vehicle's role name, ``/carla/<role>/vehicle_status``.
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
"""Schema → what its messages are."""

LASTING: Final = frozenset({ACTORS, LIGHT_PLACES, LIGHT_STATES, WORLD, VEHICLE})
"""What holds until it is told anew, so that no single frame owns the message."""

FOR_FRAMES: Final = frozenset(
    {
        OBJECTS,
        LIGHT_STATES,
        STATUS,
        COMMANDS,
        ODOMETRY,
        COLLISION,
        LANE_INVASION,
        VEHICLE_LIGHTS,
    }
)
"""What is read with the frames, after what lasts is known."""

OF_ONE_VEHICLE: Final = frozenset({STATUS, COMMANDS, VEHICLE, ODOMETRY, COLLISION, LANE_INVASION})
"""What the bridge publishes under the role name of a vehicle."""

NEVER: Final = -(1 << 62)
"""Time of what bears none; ns."""
MAX_IDENT: Final = 1 << 53
"""Ids are below it, as far as a double is exact."""
_MAX_SECONDS: Final = 1 << 32


def content_of(recording: Recording, channel: int) -> str:
    """Kind of content that the messages of a channel have; empty where the reader does not know them.

    Lights of vehicles are no part of the bridge: they are read from JSON messages ``{"t": s, "lights": {id:
    carla.VehicleLightState}}`` of a schema whose name ends in ``VehicleLights``.
    """
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    if schema is None:
        return ""
    if record.message_encoding == "json" and schema.name.endswith("VehicleLights"):
        return VEHICLE_LIGHTS
    return CONTENTS.get(short_name(schema.name), "") if _is_ros(record, schema) else ""


def structure(recording: Recording, channel: int) -> Struct | None:
    """The structure of a channel's messages, as the recording itself defines it; ``None``: no ROS messages.

    Raises
    ------
    TraceError
        The definition is missing or malformed.
    """
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    if schema is None or not _is_ros(record, schema):
        return None
    return parse_definition(schema.name, schema.data)


def _is_ros(channel: Channel, schema: Schema) -> bool:
    return channel.message_encoding == "cdr" and schema.encoding == "ros2msg"


def role_in(topic: str) -> str:
    """The role name of the vehicle that a topic is of: ``hero`` in ``/carla/hero/vehicle_status``."""
    parts = topic.split("/")
    return parts[-2] if len(parts) > 2 else ""


def ident_of(message: dict[str, Any], path: str) -> int | None:
    """The id at a path of a message; ``None`` if there is none."""
    value = number(message, path)
    return int(value) if abs(value) < MAX_IDENT else None


def stamp_of(message: dict[str, Any]) -> int:
    """Time in a message's header; ns. :data:`NEVER` if it has none, or one beyond all clocks."""
    return stamp_from([number(message, f"header.stamp.{part}") for part in ("sec", "nanosec")])


def stamp_from(told: Floats | list[float]) -> int:
    """Time of seconds and nanoseconds, likewise."""
    seconds, nanos = told
    there = abs(seconds) < _MAX_SECONDS and abs(nanos) < _MAX_SECONDS
    return int(seconds) * 1_000_000_000 + int(nanos) if there else NEVER


# Collisions and crossed lane markings, as the sensors of CARLA's bridge tell them ---------------
# Source: ros-carla-msgs, CarlaCollisionEvent and CarlaLaneInvasionEvent.

EVENTS: Final = frozenset({COLLISION, LANE_INVASION})
"""Contents of the channels that tell events."""
_MARKINGS: Final = {0: "other", 1: "broken", 2: "solid"}


def event_of(
    content: str, message: dict[str, Any], place: tuple[int, int, int], ident: str
) -> Event:
    """The event that a message tells.

    ``place``: simulation time, log time, number of the frame before it; ``ident``: id of the vehicle.
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
