"""Message classes and fields of ASAM OSI.

Which fields of OSI are read; what is not read is not parsed.

A ground truth is mostly lanes and boundaries, and a sensor view may carry whole pictures. Fields that
nobody here reads are taken out of the descriptors, so that protobuf keeps their bytes as they are: it
parses a static-heavy message several times faster, and a message made of a hundred million empty points
costs no more than its own size. What is read is bounded by number before it is parsed.
"""

from __future__ import annotations

import math
import tomllib
from functools import cache, lru_cache
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, unknown_fields
from google.protobuf.message import DecodeError

from sgstore.errors import TraceError
from sgstore.readers._blocks import FAR, NAN

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping

    from google.protobuf.descriptor import Descriptor
    from mcap.records import Schema


MAX_GROUND_TRUTH: Final = 32 << 20
"""Greatest size of a ground truth; bytes. One with all lanes of a town takes 1.4 MB."""
MAX_OBJECTS: Final = 100_000
"""Greatest number of objects (vehicles, lights, lanes, …) of a ground truth."""
MAX_STATICS: Final = 16 << 20
"""Greatest size of the stationary objects, signs and lights of a ground truth together; bytes. What is read of
them is parsed to the last part, and a part may be two bytes long."""
MAX_OBJECT: Final = 4 << 20
"""Greatest size of a moving object; bytes."""
MAX_REFERENCES: Final = 1000
"""Greatest number of source references of an object, and of identifiers in one."""
SMALL: Final = 64 << 10
"""A message up to this size cannot hold so many that it mattered; bytes."""

OPAQUE: Final = "opaque"
"""Mark of a field of messages that is read as bytes, one for each message."""

_VECTOR: Final = dict.fromkeys(("x", "y", "z"))
_ANGLES: Final = dict.fromkeys(("roll", "pitch", "yaw"))
_EXTENTS: Final = dict.fromkeys(("length", "width", "height"))
_ID: Final = {"id": {"value": None}}
_ASSIGNED: Final = {
    "assigned_lane_id": {"value": None},
    "logical_lane_assignment": {"assigned_lane_id": {"value": None}},
}
_REFERENCES: Final = {"source_reference": {"type": None, "identifier": None}}
_STATIC_BASE: Final = {"dimension": _EXTENTS, "position": _VECTOR, "orientation": _ANGLES}
_LIGHT_STATE: Final = dict.fromkeys(
    (
        "indicator_state",
        "front_fog_light",
        "rear_fog_light",
        "head_light",
        "high_beam",
        "reversing_light",
        "brake_light_state",
        "emergency_vehicle_illumination",
        "service_vehicle_illumination",
    )
)
_TIME: Final = {"seconds": None, "nanos": None}

MOVING_OBJECT_FIELDS: Final[dict[str, Any]] = {
    **_ID,
    "base": {
        **_STATIC_BASE,
        "velocity": _VECTOR,
        "acceleration": _VECTOR,
        "orientation_rate": _ANGLES,
    },
    "type": None,
    "vehicle_classification": {"type": None, "light_state": _LIGHT_STATE, "role": None},
    **_REFERENCES,
}
"""Fields of ``osi3.MovingObject`` that are read."""

TRAFFIC_LIGHT_FIELDS: Final[dict[str, Any]] = {
    **_ID,
    "base": _STATIC_BASE,
    "classification": {
        **dict.fromkeys(("color", "icon", "mode", "is_out_of_service")),
        **_ASSIGNED,
    },
    **_REFERENCES,
}
"""Fields of ``osi3.TrafficLight`` that are read."""

GROUND_TRUTH_FIELDS: Final[dict[str, Any]] = {
    "timestamp": _TIME,
    "host_vehicle_id": {"value": None},
    "moving_object": OPAQUE,
    "stationary_object": {
        **_ID,
        "base": _STATIC_BASE,
        "classification": {"type": None},
        **_REFERENCES,
    },
    "traffic_sign": {
        **_ID,
        "main_sign": {
            "base": _STATIC_BASE,
            "classification": {
                "type": None,
                "value": {"value": None, "value_unit": None},
                **_ASSIGNED,
            },
        },
        **_REFERENCES,
    },
    "traffic_light": OPAQUE,
    "environmental_conditions": OPAQUE,
    "road_marking": _ID,
    "lane_boundary": _ID,
    "lane": _ID,
    "reference_line": _ID,
    "logical_lane_boundary": _ID,
    "logical_lane": _ID,
}
"""Fields of ``osi3.GroundTruth`` that are read, and theirs; ``None``: as it is; :data:`OPAQUE`: as bytes."""

HOST_DATA_FIELDS: Final[dict[str, Any]] = {
    "host_vehicle_id": {"value": None},
    "vehicle_powertrain": {"pedal_position_acceleration": None, "gear_transmission": None},
    "vehicle_brake_system": {"pedal_position_brake": None},
}

SENSOR_VIEW_FIELDS: Final[dict[str, Any]] = {
    "timestamp": _TIME,
    "host_vehicle_id": {"value": None},
    "host_vehicle_data": HOST_DATA_FIELDS,
    "global_ground_truth": GROUND_TRUTH_FIELDS,
}


def prune(
    files: list[descriptor_pb2.FileDescriptorProto], roots: dict[str, dict[str, Any]]
) -> None:
    """Take the fields that are not read out of the descriptors of message types.

    Parameters
    ----------
    files : list of FileDescriptorProto
        Changed.
    roots : dict
        Full names of types → the fields to be read → those of their messages. Of a type that is met in
        several places all are kept that one of them reads.
    """
    types = {
        name: message
        for file in files
        for name, message in _named(file.message_type, f"{file.package}." if file.package else "")
    }
    kept: dict[str, set[str]] = {}
    waiting = list(roots.items())
    while waiting:
        name, wanted = waiting.pop()
        kept.setdefault(name, set()).update(wanted)
        for field in types[name].field if name in types else ():
            inner = wanted.get(field.name)
            if not field.type_name or field.type != field.TYPE_MESSAGE or inner is None:
                continue
            if inner == OPAQUE:
                field.type = field.TYPE_BYTES
                field.ClearField("type_name")
            else:
                waiting.append((field.type_name.removeprefix("."), inner))
    for name, names in kept.items():
        message = types.get(name)
        if message is not None and not message.oneof_decl:
            fields_left = [field for field in message.field if field.name in names]
            del message.field[:]
            message.field.extend(fields_left)


def _named(messages: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Message types with their full names, those within others too."""
    for message in messages:
        name = prefix + message.name
        yield name, message
        yield from _named(message.nested_type, f"{name}.")


def check_size(data: bytes, truth: int) -> None:
    """Refuse a message whose ground truth is too large, or of too many parts, to be parsed.

    Parameters
    ----------
    data : bytes
        The message.
    truth : int
        Number of the field that is the ground truth; 0: the message is it.

    Raises
    ------
    ValueError
        It is too large, or malformed.
    """
    if len(data) <= SMALL:
        return
    spans = [(0, len(data))]
    if truth:
        spans = [(a, b) for number, _, a, b in fields_of(data, 0, len(data)) if number == truth]
    size = sum(stop - start for start, stop in spans)
    if size > MAX_GROUND_TRUTH:
        raise ValueError(f"a ground truth of {size} bytes; at most {MAX_GROUND_TRUTH} are read")
    _check_objects(field for start, stop in spans for field in fields_of(data, start, stop))


def _check_objects(fields: Iterator[tuple[int, int, int, int]]) -> None:
    statics = 0
    for count, (number, _, start, stop) in enumerate(fields):
        if count > MAX_OBJECTS:
            raise ValueError(f"more than {MAX_OBJECTS} objects in a ground truth")
        if number == _MOVING and stop - start > MAX_OBJECT:
            raise ValueError(
                f"a moving object of {stop - start} bytes; at most {MAX_OBJECT} are read"
            )
        statics += (stop - start) * (number in _STATICS)
    if statics > MAX_STATICS:
        raise ValueError(f"{statics} bytes of static things; at most {MAX_STATICS} are read")


_MOVING: Final = 5
_STATICS: Final = frozenset({4, 6, 7})
"""Numbers of ``stationary_object``, ``traffic_sign``, ``traffic_light``, in every version of OSI."""


def fields_of(data: bytes, position: int, stop: int) -> Iterator[tuple[int, int, int, int]]:
    """Fields of a protobuf message: number, wire type, where the content begins, where it ends.

    Raises
    ------
    ValueError
        The message is malformed.

    Notes
    -----
    Source: protobuf encoding (protobuf.dev/programming-guides/encoding).
    """
    while position < stop:
        tag, start = data[position], position + 1
        if tag >= 0x80:
            tag, start = _varint(data, position, stop)
        wire = tag & 7
        if wire == 2:
            length = data[start] if start < stop else 0x80
            start += 1
            if length >= 0x80:
                length, start = _varint(data, start - 1, stop)
        elif wire == 0:
            length = _varint(data, start, stop)[1] - start
        elif wire in _WIDTHS:
            length = _WIDTHS[wire]
        else:
            raise ValueError(f"wire type {wire}")
        position = start + length
        if position > stop:
            raise ValueError("a field does not fit")
        yield tag >> 3, wire, start, position


_WIDTHS: Final = {1: 8, 3: 0, 4: 0, 5: 4}
"""Bytes of a content by its wire type; those of a group are fields of their own."""


def _varint(data: bytes, position: int, stop: int) -> tuple[int, int]:
    """A number of variable length, and where it ends.

    Raises
    ------
    ValueError
        It does not end.
    """
    value, shift = 0, 0
    while position < stop and shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError("a number that does not end")


# Descriptors of ASAM OSI's message types, for recordings that bring none of their own -----------
# An MCAP file carries the descriptors of its messages, and those count. A single-channel file (``.osi``)
# carries none: its messages are read by what ``osi_types.toml`` says. Numbers of fields never change
# between versions of OSI, so files of every version can be read by them.

_FIELD: Final = descriptor_pb2.FieldDescriptorProto
_SCALARS: Final = {
    "double": _FIELD.TYPE_DOUBLE,
    "int64": _FIELD.TYPE_INT64,
    "uint64": _FIELD.TYPE_UINT64,
    "int32": _FIELD.TYPE_INT32,
    "uint32": _FIELD.TYPE_UINT32,
    "bool": _FIELD.TYPE_BOOL,
    "string": _FIELD.TYPE_STRING,
    "bytes": _FIELD.TYPE_BYTES,
    "fixed32": _FIELD.TYPE_FIXED32,
}


@cache
def descriptors() -> bytes:
    """A serialised ``FileDescriptorSet`` with ``osi3.GroundTruth``, ``osi3.SensorView`` and what they need."""
    text = resources.files("sgstore.readers").joinpath("osi_types.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    file = descriptor_pb2.FileDescriptorProto(name="osi3.proto", package="osi3", syntax="proto2")
    types: dict[str, descriptor_pb2.DescriptorProto] = {}
    for name in sorted(tables["messages"]):  # an outer type comes before those within it
        outer, _, last = name.rpartition(".")
        siblings = types[outer].nested_type if outer else file.message_type
        types[name] = siblings.add(name=last)
    for name, values in tables["enums"].items():
        outer, _, last = name.rpartition(".")
        enum = types[outer].enum_type.add(name=last)
        enum.options.allow_alias = True
        for item in values.split():
            label, _, number = item.partition("=")
            enum.value.add(name=label, number=int(number))
        if len({value.number for value in enum.value}) == len(enum.value):
            enum.ClearField("options")  # protobuf refuses leave for aliases where there are none
    for name, items in tables["messages"].items():
        add_fields(types[name], items, tables["enums"], "osi3")
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def add_fields(
    message: descriptor_pb2.DescriptorProto,
    fields: str,
    enums: Container[str],
    package: str,
    elsewhere: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Give a message type its fields.

    Parameters
    ----------
    message : DescriptorProto
    fields : str
        ``name=number:type`` for each, with * if it is repeated.
    enums : container of str
        Which types are enumerations.
    package : str
        Where types are defined, unless ``elsewhere`` names another package for them.
    """
    for item in fields.split():
        label, _, rest = item.partition("=")
        number, _, kind = rest.partition(":")
        field = message.field.add(name=label, number=int(number))
        field.label = _FIELD.LABEL_REPEATED if kind.endswith("*") else _FIELD.LABEL_OPTIONAL
        kind = kind.removesuffix("*")
        if kind in _SCALARS:
            field.type = _SCALARS[kind]
        else:
            field.type = _FIELD.TYPE_ENUM if kind in enums else _FIELD.TYPE_MESSAGE
            field.type_name = f".{elsewhere.get(kind, package)}.{kind}"


# Message classes of ASAM OSI, made from the descriptors that a recording carries ----------------
# Each recording has a pool of its own: what one file defines is never seen by another. The classes are
# those of the file's own version of OSI; what every version has is asked for once, when a file is opened,
# and what only some have is looked up with a default.
#
# Source: open-simulation-interface 3.8.0 (osi_groundtruth.proto, osi_object.proto, osi_common.proto).

GROUND_TRUTH: Final = "osi3.GroundTruth"
SENSOR_VIEW: Final = "osi3.SensorView"
HOST_DATA: Final = "osi3.HostVehicleData"
MOVING_OBJECT: Final = "osi3.MovingObject"
TRAFFIC_LIGHT: Final = "osi3.TrafficLight"
ROAD_MAP: Final = "osi3.MapAsamOpenDrive"

MAX_DESCRIPTORS: Final = 4 << 20
"""Greatest size of the descriptors of a message type; bytes. Those of OSI 3.8 take 60 kB."""

DECODE_ERRORS: Final = (
    DecodeError,
    AttributeError,  # a descriptor that lacks a field, or has another thing in its place
    TypeError,
    ValueError,
    LookupError,
    OverflowError,
    RecursionError,
    MemoryError,
)
"""What reading a message raises if it, or the descriptors it came with, are not what they seem."""

NO_VECTOR: Final = (NAN, NAN, NAN)
LATEST_NS: Final = 1 << 62
"""Bound of times that are believed; ns."""
_GROUND_TRUTH_NEEDS: Final = ("timestamp.seconds", "moving_object")
_MOVING_OBJECT_NEEDS: Final = (
    "id.value",
    "type",
    "vehicle_classification.type",
    *(f"base.dimension.{name}" for name in ("length", "width", "height")),
    *(f"base.orientation.{name}" for name in ("roll", "pitch", "yaw")),
    *(
        f"base.{vector}.{name}"
        for vector in ("position", "velocity", "acceleration")
        for name in ("x", "y", "z")
    ),
)
_TRAFFIC_LIGHT_NEEDS: Final = (
    "id.value",
    *(f"classification.{name}" for name in ("color", "icon", "mode")),
    *(f"base.dimension.{name}" for name in ("length", "width", "height")),
    *(f"base.orientation.{name}" for name in ("roll", "pitch", "yaw")),
    *(f"base.position.{name}" for name in ("x", "y", "z")),
)
_FIELDS: Final = {
    GROUND_TRUTH: GROUND_TRUTH_FIELDS,
    SENSOR_VIEW: SENSOR_VIEW_FIELDS,
    HOST_DATA: HOST_DATA_FIELDS,
}
_NEEDS: Final = {
    GROUND_TRUTH: _GROUND_TRUTH_NEEDS,
    SENSOR_VIEW: tuple(f"global_ground_truth.{path}" for path in _GROUND_TRUTH_NEEDS),
    ROAD_MAP: ("map_reference", "open_drive_xml_content"),
}


def message_class(schema: Schema, fields: dict[str, Any] | None = None) -> type[Any]:
    """The class of the messages of a schema.

    Parameters
    ----------
    schema : Schema
    fields : dict, optional
        Which fields to read instead of those of frames, as :func:`~sgstore.readers.osi._schema.prune` has them;
        any of them may be missing.

    Raises
    ------
    TraceError
        The schema's descriptors are malformed, lack their type, or lack a field that every version of
        OSI has.
    """
    if len(schema.data) > MAX_DESCRIPTORS:
        reason = f"schema {schema.name}: {len(schema.data)} bytes of descriptors"
        raise TraceError(f"{reason}; at most {MAX_DESCRIPTORS} are read")
    try:
        files = list(descriptor_pb2.FileDescriptorSet.FromString(schema.data).file)
        wanted = _FIELDS.get(schema.name) if fields is None else fields
        if wanted is not None:
            parts = {MOVING_OBJECT: MOVING_OBJECT_FIELDS, TRAFFIC_LIGHT: TRAFFIC_LIGHT_FIELDS}
            prune(files, parts | {schema.name: wanted})
        pool = descriptor_pool.DescriptorPool()
        _add(pool, {file.name: file for file in files})
        found = pool.FindMessageTypeByName(schema.name)
        _require(found, _NEEDS.get(schema.name, ()) if fields is None else ())
        return message_factory.GetMessageClass(found)
    except DECODE_ERRORS as error:
        reason = f"schema {schema.name}: its protobuf descriptors are malformed: {error}"
        raise TraceError(reason) from error


def _add(
    pool: descriptor_pool.DescriptorPool, files: dict[str, descriptor_pb2.FileDescriptorProto]
) -> None:
    """Add files to a pool, each after those that it imports; a file set may have them in any order."""
    own = descriptor_pb2.DESCRIPTOR
    if own.name not in files:
        files[own.name] = descriptor_pb2.FileDescriptorProto.FromString(own.serialized_pb)
    done: set[str] = set()
    waiting = list(files.values())
    while waiting:
        ready = [f for f in waiting if all(d in done or d not in files for d in f.dependency)]
        if not ready:
            raise ValueError(f"files import each other: {sorted(f.name for f in waiting)[:5]}")
        for file in ready:
            pool.AddSerializedFile(file.SerializeToString())
            done.add(file.name)
        waiting = [f for f in waiting if f.name not in done]


def _require(found: Descriptor, paths: tuple[str, ...]) -> None:
    for path in paths:
        inner = found
        for name in path.split("."):
            if inner is None or name not in inner.fields_by_name:
                raise KeyError(f"no field {path}")
            inner = inner.fields_by_name[name].message_type


def object_class(message: type[Any]) -> type[Any]:
    """The class of the moving objects in the messages of a class, which has them as bytes.

    Raises
    ------
    TraceError
        The descriptors lack the type, or a field that every version of OSI has.
    """
    try:
        found = message.DESCRIPTOR.file.pool.FindMessageTypeByName(MOVING_OBJECT)
        _require(found, _MOVING_OBJECT_NEEDS)
        return message_factory.GetMessageClass(found)
    except DECODE_ERRORS as error:
        raise TraceError(
            f"schema {MOVING_OBJECT}: its protobuf descriptors are malformed: {error}"
        ) from error


def light_class(message: type[Any]) -> type[Any] | None:
    """The class of the traffic lights in the messages of a class, which has them as bytes.

    ``None`` where it has none that could be read.
    """
    try:
        found = message.DESCRIPTOR.file.pool.FindMessageTypeByName(TRAFFIC_LIGHT)
        _require(found, _TRAFFIC_LIGHT_NEEDS)
        return message_factory.GetMessageClass(found)
    except DECODE_ERRORS:
        return None


def lights_of(ground: Any) -> list[bytes]:
    """The traffic lights of a ground truth, serialised."""
    return list(getattr(ground, "traffic_light", ()))


def has_field(message: type[Any], path: str) -> bool:
    """Return whether a message class has a field, given as a path of names with dots between."""
    try:
        _require(message.DESCRIPTOR, (path,))
    except KeyError:
        return False
    return True


def parse(message: type[Any], data: bytes) -> tuple[Any, Any, list[bytes]]:
    """A message of the leading channel, its ground truth, and the moving objects of that.

    Raises
    ------
    Exception
        One of :data:`DECODE_ERRORS`. Of objects there are not too many to be looked at.
    """
    truth = _truth_in(message)
    check_size(data, truth)
    parsed = message.FromString(data)
    ground = parsed.global_ground_truth if truth else parsed
    objects: list[bytes] = list(ground.moving_object)
    if len(objects) > MAX_OBJECTS:
        raise ValueError(f"{len(objects)} moving objects; at most {MAX_OBJECTS} are read")
    return parsed, ground, objects


def time_of(message: Any, ground: Any) -> int | None:
    """The time that a message says it is of, in ns; ``None`` if it says none that can be."""
    for part in (ground, message):
        if part.HasField("timestamp"):
            time_ns = part.timestamp.seconds * 1_000_000_000 + part.timestamp.nanos
            if abs(time_ns) < LATEST_NS:
                return int(time_ns)
    return None


@lru_cache(maxsize=64)
def _truth_in(message: type[Any]) -> int:
    """Number of the field that is the ground truth in messages of a class; 0: they are it."""
    truth = message.DESCRIPTOR.fields_by_name.get("global_ground_truth")
    return truth.number if truth is not None else 0


def ground_truth_of(message: Any) -> Any:
    """The ground truth in a message, which may be one itself."""
    return message.global_ground_truth if hasattr(message, "global_ground_truth") else message


def enum_name(message: Any, field: str) -> str:
    """The name of an enumeration's value in a message: ``TYPE_CAR``.

    A value that the file's own version of OSI does not know is kept by its number: ``TYPE_213``.
    """
    number = getattr(message, field)
    names, place = _values_of(type(message), field)
    if not message.HasField(field):
        for unknown in unknown_fields.UnknownFieldSet(message):
            if unknown.field_number == place and isinstance(unknown.data, int):
                number = unknown.data
    if number in names:
        return names[number]
    return f"{names[0].split('_')[0] if 0 in names else field.upper()}_{number}"


@lru_cache(maxsize=256)
def _values_of(message: type[Any], field: str) -> tuple[dict[int, str], int]:
    """Names of the values that a field of a message class may have, by number; and the field's own number."""
    descriptor = message.DESCRIPTOR.fields_by_name[field]
    names = descriptor.enum_type.values_by_number
    # Asked one by one: of several names of a number it is the first that counts.
    return {number: str(names[number].name) for number in names}, descriptor.number


def identifiers(thing: Any) -> list[tuple[str, str]]:
    """Source references of an object: (type of the source, identifier), in the order they stand.

    Raises
    ------
    ValueError
        There are more than any object has.
    """
    references = getattr(thing, "source_reference", ())
    most = max([len(references), *(len(one.identifier) for one in references[:MAX_REFERENCES])])
    if most > MAX_REFERENCES:
        raise ValueError(f"an object with {most} references; at most {MAX_REFERENCES} are read")
    return [
        (reference.type, identifier)
        for reference in references
        for identifier in reference.identifier
    ]


def map_ref(thing: Any) -> str:
    """Id of the OpenDRIVE signal or object that an object refers to, or the empty string.

    esmini writes ``traffic_light_id:3``, ``traffic_sign_id:3`` and ``object_id:3``; a bare identifier is
    taken as it is.
    """
    for source, identifier in identifiers(thing):
        key, colon, value = identifier.partition(":")
        if source == "net.asam.opendrive" and (not colon or key.endswith("_id")):
            return value if colon else identifier
    return ""


def assigned_lanes(classification: Any) -> list[int]:
    """Ids of the physical and logical lanes that a light or sign is told to apply to.

    Raises
    ------
    ValueError
        There are more than any has.
    """
    physical = getattr(classification, "assigned_lane_id", ())
    logical = getattr(classification, "logical_lane_assignment", ())
    if len(physical) + len(logical) > MAX_REFERENCES:
        reason = (
            f"assigned to {len(physical) + len(logical)} lanes; at most {MAX_REFERENCES} are read"
        )
        raise ValueError(reason)
    idents = [*physical, *(one.assigned_lane_id for one in logical)]
    return list(dict.fromkeys(int(ident.value) for ident in idents))


def static_pose(base: Any) -> tuple[float, ...] | None:
    """Pose and size of what does not move: the columns of :data:`sgstore.world.POSE`.

    Without an orientation or dimension those are NaN. ``None`` if there is no usable position.
    """
    place, turn, size = base.position, base.orientation, base.dimension
    position = (place.x, place.y, place.z)
    angles = (turn.yaw, turn.pitch, turn.roll)
    if not base.HasField("position") or not all(abs(v) < FAR for v in (*position, *angles)):
        return None
    angles = (math.remainder(angles[0], 2 * math.pi), *angles[1:])
    extents = (size.length, size.width, size.height)
    return (
        *position,
        *(angles if base.HasField("orientation") else NO_VECTOR),
        *(NAN,) * 7,
        *(extents if base.HasField("dimension") else NO_VECTOR),
    )
