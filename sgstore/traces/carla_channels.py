"""What the channels of a recording of CARLA's ROS bridge carry, by their schemas.

Topics are free and tell nothing, with one exception: a message of a vehicle's own sensors does not say whose
it is, but the bridge puts them under the vehicle's role name, ``/carla/<role>/vehicle_status``.

Source: carla-simulator/ros-bridge, ros-carla-msgs, astuff_sensor_msgs (message definitions).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.traces.cdr import number
from sgstore.traces.ros2msg import parse_definition, short_name

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

    from sgstore.traces.recording import Recording
    from sgstore.traces.ros2msg import Struct
    from sgstore.world import Floats

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
    """What the messages of a channel are; empty where the reader knows nothing of them.

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
