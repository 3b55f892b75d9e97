"""Conversion of frames to ASAM OSI messages: ``osi3.SensorView`` with the ground truth."""

from __future__ import annotations

import json
import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from sgstore.graphs.online import NUMBERS
from sgstore.model.vocabulary import KINDS, LIGHT_STATES, VEHICLE_LIGHTS, VEHICLES
from sgstore.model.world import ATTRIBUTE
from sgstore.readers import add_fields, descriptors

if TYPE_CHECKING:
    from sgstore.graphs.online import Entity, Frame

# The format is a sensor view, not a plain ground truth, because only a sensor view has the pedals
# of the host vehicle. Values without an OSI field are not written: the steering input, the hand
# brake, taxis and electric vehicles as special kinds, custom subkinds. Attributes without a column
# are references of sgstore's own type. Static objects are written
# once, on first appearance, as several producers do. A traffic light is three bulbs, each on or
# off, linked to the map's signal by its id. OSI's ids are numbers: a numeric id is kept, another id
# gets a new number and is written as the object's name. Source: open-simulation-interface 3.8.0;
# omega-prime specification (``MapAsamOpenDrive``).

VERSION: Final = (3, 8, 0)

SENSOR_VIEW: Final = "osi3.SensorView"

ROAD_MAP: Final = "osi3.MapAsamOpenDrive"

OPENDRIVE: Final = "net.asam.opendrive"
"""Value of the type field in a reference to the road map."""

FIRST_NUMBER: Final = 1 << 40
"""First number for entities without a numeric id. Simulators use smaller numbers."""

_VEHICLE_TYPES: Final = {
    "car": "TYPE_CAR",
    "truck": "TYPE_HEAVY_TRUCK",
    "van": "TYPE_DELIVERY_VAN",
    "bus": "TYPE_BUS",
    "motorcycle": "TYPE_MOTORBIKE",
    "bicycle": "TYPE_BICYCLE",
    "trailer": "TYPE_TRAILER",
    "train": "TYPE_TRAIN",
    "vehicle": "TYPE_OTHER",
}

_ROLES: Final = {
    "emergency": "ROLE_POLICE",
    "public_transport": "ROLE_PUBLIC_TRANSPORT",
    "service": "ROLE_ROAD_ASSISTANCE",
}

_MOVING_TYPES: Final = {"person": "TYPE_PEDESTRIAN", "animal": "TYPE_ANIMAL"}

_SIGN_TYPES: Final = {
    "stop_sign": "TYPE_STOP",
    "yield_sign": "TYPE_GIVE_WAY",
    "speed_limit": "TYPE_SPEED_LIMIT_BEGIN",
}

_STATIONARY_TYPES: Final = {
    "building": "TYPE_BUILDING",
    "pole": "TYPE_POLE",
    "barrier": "TYPE_BARRIER",
    "vegetation": "TYPE_VEGETATION",
    "prop": "TYPE_OTHER",
    "building bridge": "TYPE_BRIDGE",
    "barrier wall": "TYPE_WALL",
    "barrier curb": "TYPE_CURBSTONE",
    "vegetation tree": "TYPE_TREE",
    "prop cone": "TYPE_PYLON",
    "prop speed_bump": "TYPE_SPEED_BUMP",
    "prop construction": "TYPE_CONSTRUCTION_SITE_ELEMENT",
}
"""Kind, or kind and subkind, of static objects → OSI type."""

_BULBS: Final = (("red", "COLOR_RED"), ("yellow", "COLOR_YELLOW"), ("green", "COLOR_GREEN"))

_LIT: Final = {
    "red": {"red"},
    "yellow": {"yellow"},
    "green": {"green"},
    "red_yellow": {"red", "yellow"},
}

_LAMPS: Final = {
    "light_reverse": "reversing_light",
    "light_low_beam": "head_light",
    "light_high_beam": "high_beam",
    "light_fog": "front_fog_light",
    "light_special1": "emergency_vehicle_illumination",
    "light_special2": "service_vehicle_illumination",
}

_INDICATORS: Final = ("OFF", "LEFT", "RIGHT", "WARNING")


@cache
def types() -> tuple[type[Any], type[Any], bytes, bytes]:
    """Return the OSI message classes of a sensor view and a road map, and their descriptors for MCAP."""
    view_schema = descriptors()
    file = descriptor_pb2.FileDescriptorProto(
        name="osi3/osi_mapasamopendrive.proto", package="osi3", syntax="proto2"
    )
    message = file.message_type.add(name=ROAD_MAP.partition(".")[2])
    add_fields(message, "map_reference=1:string open_drive_xml_content=2:string", (), "osi3")
    map_schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    pool = descriptor_pool.DescriptorPool()
    for schema in (view_schema, map_schema):
        for each in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
            pool.Add(each)
    view, road_map = (
        message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
        for name in (SENSOR_VIEW, ROAD_MAP)
    )
    return view, road_map, view_schema, map_schema


def map_message(text: str, name: str) -> bytes:
    """Return an OSI message with the text of a road map, as bytes."""
    message = types()[1](map_reference=name, open_drive_xml_content=text)
    return message.SerializeToString()


class OsiFrames:
    """Converter of the frames of one run to ``osi3.SensorView`` messages."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._given = FIRST_NUMBER
        self._bulbs: dict[str, tuple[int, ...]] = {}
        self._standing: set[str] = set()

    def message(self, frame: Frame) -> bytes:
        """Return the next frame as an OSI message, in bytes."""
        out = types()[0]()
        ground = out.global_ground_truth
        for part in (out, ground):
            part.version.version_major, part.version.version_minor, part.version.version_patch = (
                VERSION
            )
            part.timestamp.seconds, part.timestamp.nanos = divmod(frame.time_ns, 1_000_000_000)
        for entity in frame.entities:
            self._write(ground, entity)
            if entity.ident == frame.ego and not entity.static:
                number = self._number(entity.ident)
                out.host_vehicle_id.value = ground.host_vehicle_id.value = number
                _write_pedals(out.host_vehicle_data, _values(entity))
        return out.SerializeToString()

    def _write(self, ground: Any, entity: Entity) -> None:
        kind = KINDS[entity.kind]
        if kind == "traffic_light":
            self._write_light(ground, entity)
        elif not entity.static:
            self._write_moving(ground.moving_object.add(), entity, kind)
        elif entity.ident not in self._standing:
            self._standing.add(entity.ident)
            if kind.endswith("sign") or kind == "speed_limit":
                self._write_sign(ground.traffic_sign.add(), entity, kind)
            else:
                self._write_standing(ground.stationary_object.add(), entity, kind)

    def _number(self, ident: str) -> int:
        """Return the OSI number of an entity: its recorded id if it is a number, otherwise a new number."""
        number = self._numbers.get(ident)
        if number is None:
            plain = ident.isascii() and ident.isdecimal() and str(int(ident)) == ident
            number = int(ident) if plain and int(ident) < FIRST_NUMBER else self._fresh()
            self._numbers[ident] = number
        return number

    def _fresh(self) -> int:
        self._given += 1
        return self._given

    def _name(self, thing: Any, entity: Entity) -> None:
        """Write the number, the recorded id and the map reference of an entity into an OSI object."""
        number = self._number(entity.ident)
        thing.id.value = number
        if str(number) != entity.ident:
            own = thing.source_reference.add(type="net.sgstore")
            own.identifier.append(f"entity_name:{entity.ident}")
        for name, value in (entity.own or {}).items():
            own = thing.source_reference.add(type="net.sgstore")
            own.identifier.append(f"{ATTRIBUTE}{name}={json.dumps(value)}")
        if entity.map_ref:
            key = "traffic_sign_id" if hasattr(thing, "main_sign") else "object_id"
            thing.source_reference.add(type=OPENDRIVE).identifier.append(f"{key}:{entity.map_ref}")

    def _write_moving(self, out: Any, entity: Entity, kind: str) -> None:
        values = _values(entity)
        self._name(out, entity)
        out.model_reference = entity.type_name
        _write_base(out.base, values)
        for part, names in _MOTION.items():
            _write_vector(getattr(out.base, part), names, values)
        out.type = _number_of(out, "type", _MOVING_TYPES.get(kind, "TYPE_OTHER"))
        if kind in VEHICLES:
            out.type = _number_of(out, "type", "TYPE_VEHICLE")
            vehicle = out.vehicle_classification
            vehicle.type = _number_of(vehicle, "type", _VEHICLE_TYPES[kind])
            vehicle.role = _number_of(vehicle, "role", _ROLES.get(entity.special, "ROLE_CIVIL"))
            if entity.whole[0] >= 0:
                _write_lamps(vehicle.light_state, entity.whole[0])

    def _write_standing(self, out: Any, entity: Entity, kind: str) -> None:
        self._name(out, entity)
        out.model_reference = entity.type_name
        _write_base(out.base, _values(entity))
        word = _STATIONARY_TYPES.get(f"{kind} {entity.subkind}") or _STATIONARY_TYPES.get(kind)
        out.classification.type = _number_of(out.classification, "type", word or "TYPE_UNKNOWN")

    def _write_sign(self, out: Any, entity: Entity, kind: str) -> None:
        self._name(out, entity)
        out.main_sign.model_reference = entity.type_name
        _write_base(out.main_sign.base, _values(entity))
        about = out.main_sign.classification
        about.type = _number_of(about, "type", _SIGN_TYPES.get(kind, "TYPE_OTHER"))

    def _write_light(self, ground: Any, entity: Entity) -> None:
        """Write a traffic light as three OSI bulbs, one above the other, which fill its box."""
        numbers = self._bulbs.get(entity.ident)
        if numbers is None:
            numbers = (self._number(entity.ident), self._fresh(), self._fresh())
            self._bulbs[entity.ident] = numbers
        values, code = _values(entity), entity.whole[1]
        state = LIGHT_STATES[code] if code >= 0 else "unknown"
        third = values["height"] / 3
        for place, (number, (word, colour)) in enumerate(zip(numbers, _BULBS, strict=True)):
            up = 0.0 if math.isnan(third) else (1 - place) * third
            bulb = ground.traffic_light.add()
            bulb.id.value = number
            _write_base(bulb.base, values | {"z": values["z"] + up, "height": third})
            about = bulb.classification
            about.color = _number_of(about, "color", colour)
            about.icon = _number_of(about, "icon", "ICON_NONE")
            about.mode = _number_of(about, "mode", _mode(state, word))
            if entity.map_ref:
                reference = bulb.source_reference.add(type=OPENDRIVE)
                reference.identifier.append(f"traffic_light_id:{entity.map_ref}")


_MOTION: Final = {
    "velocity": {"x": "vx", "y": "vy", "z": "vz"},
    "acceleration": {"x": "ax", "y": "ay", "z": "az"},
    "orientation_rate": {"yaw": "yaw_rate"},
}

_PLACE: Final = {name: name for name in ("x", "y", "z")}

_TURN: Final = {"yaw": "heading", "pitch": "pitch", "roll": "roll"}

_SIZE: Final = {name: name for name in ("length", "width", "height")}


def _values(entity: Entity) -> dict[str, float]:
    return dict(zip(NUMBERS, entity.numbers, strict=True))


def _write_base(base: Any, values: dict[str, float]) -> None:
    for part, names in (("position", _PLACE), ("orientation", _TURN), ("dimension", _SIZE)):
        _write_vector(getattr(base, part), names, values)


def _write_vector(out: Any, names: dict[str, str], values: dict[str, float]) -> None:
    """Write a vector into an OSI message; unknown components become 0. If the first is unknown, skip it.

    In OSI a missing number of a vector is 0, and a missing vector is unknown.
    """
    if math.isnan(values[next(iter(names.values()))]):
        return
    for name, column in names.items():
        setattr(out, name, 0.0 if math.isnan(values[column]) else values[column])


def _write_pedals(data: Any, values: dict[str, float]) -> None:
    if not math.isnan(values["throttle"]):
        data.vehicle_powertrain.pedal_position_acceleration = values["throttle"]
    if not math.isnan(values["brake"]):
        data.vehicle_brake_system.pedal_position_brake = values["brake"]
    if not math.isnan(values["gear"]):
        data.vehicle_powertrain.gear_transmission = round(values["gear"])


def _write_lamps(out: Any, mask: int) -> None:
    on = {name for bit, name in enumerate(VEHICLE_LIGHTS) if mask >> bit & 1}
    turning = _INDICATORS[("light_left" in on) + 2 * ("light_right" in on)]
    out.indicator_state = _number_of(out, "indicator_state", f"INDICATOR_STATE_{turning}")
    brake = "NORMAL" if "light_brake" in on else "OFF"
    out.brake_light_state = _number_of(out, "brake_light_state", f"BRAKE_LIGHT_STATE_{brake}")
    for name, field in _LAMPS.items():
        word = "ON" if name in on else "OFF"
        setattr(out, field, _number_of(out, field, f"GENERIC_LIGHT_STATE_{word}"))


def _mode(state: str, bulb: str) -> str:
    """Return the OSI mode of one bulb of a traffic light, for the state of the light."""
    if state == "flashing":
        return "MODE_FLASHING" if bulb == "yellow" else "MODE_OFF"
    if state == "unknown":
        return "MODE_UNKNOWN"
    return "MODE_CONSTANT" if bulb in _LIT.get(state, set()) else "MODE_OFF"


def _number_of(message: Any, field: str, name: str) -> int:
    return message.DESCRIPTOR.fields_by_name[field].enum_type.values_by_name[name].number
