"""Protobuf message classes of ASAM OSI with only the fields that the reader needs.

A ground truth consists mostly of lanes and boundaries, and a sensor view may contain whole pictures. Unused
fields are removed from the descriptors, so that protobuf does not parse their bytes. Messages with much static
data are then parsed several times faster, and a message of a hundred million empty points needs no more memory
than its own size. The number of parts to parse is limited before the parsing.
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
"""Maximum size of a ground truth; bytes. One with all lanes of a town has 1.4 MB."""
MAX_OBJECTS: Final = 100_000
"""Maximum number of objects (vehicles, lights, lanes, …) in a ground truth."""
MAX_STATICS: Final = 16 << 20
"""Maximum total size of stationary objects, signs and lights in a ground truth; bytes."""
MAX_OBJECT: Final = 4 << 20
"""Maximum size of a moving object; bytes."""
MAX_REFERENCES: Final = 1000
"""Maximum number of source references of an object, and of identifiers in a reference."""
SMALL: Final = 64 << 10
"""Size up to which a message is parsed without a check of its number of objects; bytes."""

OPAQUE: Final = "opaque"
"""Value that marks a message field which is read as bytes, one item for each message."""


@cache
def fields_read() -> dict[str, Any]:
    """Return the content of ``osi_fields.toml``: the fields that the reader uses of each message type."""
    text = resources.files("sgstore.readers").joinpath("osi_fields.toml").read_text("utf-8")
    return tomllib.loads(text)


def prune(files: list[descriptor_pb2.FileDescriptorProto], roots: dict[str, Any]) -> None:
    """Remove unused fields from protobuf descriptors, so that parsing is faster.

    Parameters
    ----------
    files : list of FileDescriptorProto
        Modified in place.
    roots : dict
        Full names of types → the fields to read, as in :func:`fields_read`. A type that is used in several
        places keeps the fields of all of them.
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
        wanted = fields_read()[wanted] if isinstance(wanted, str) else wanted
        kept.setdefault(name, set()).update(wanted)
        for field in types[name].field if name in types else ():
            inner = wanted.get(field.name) if isinstance(wanted, dict) else None
            if not field.type_name or field.type != field.TYPE_MESSAGE or inner in (None, True):
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
    """Yield protobuf message types with their full names, including nested types."""
    for message in messages:
        name = prefix + message.name
        yield name, message
        yield from _named(message.nested_type, f"{name}.")


def check_size(data: bytes, truth: int) -> None:
    """Raise an error if an OSI message is too large, or has too many parts to parse.

    Parameters
    ----------
    data : bytes
        The message.
    truth : int
        Field number of the ground truth; 0: the message itself is the ground truth.

    Raises
    ------
    ValueError
        The ground truth is too large or malformed.
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
"""Field numbers of ``stationary_object``, ``traffic_sign`` and ``traffic_light`` in every OSI version."""


def fields_of(data: bytes, position: int, stop: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield for each field in a protobuf message: number, wire type, start and end of its content.

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
"""Wire type → size of the content; bytes. The parts of a group are separate fields."""


def _varint(data: bytes, position: int, stop: int) -> tuple[int, int]:
    """Decode a protobuf varint. Return its value and the position after it.

    Raises
    ------
    ValueError
        The number does not end.
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


# Descriptors of ASAM OSI's message types, for recordings without descriptors. An MCAP file contains the
# descriptors of its messages, which have priority. A single-channel file (``.osi``) has none; its messages are
# read with ``osi_types.toml``. Field numbers never change between versions of OSI, so this works for files of
# every version.

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
    """Return serialised protobuf descriptors of ``osi3.GroundTruth`` and ``osi3.SensorView``."""
    text = resources.files("sgstore.readers").joinpath("osi_types.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    file = descriptor_pb2.FileDescriptorProto(name="osi3.proto", package="osi3", syntax="proto2")
    types: dict[str, descriptor_pb2.DescriptorProto] = {}
    for name in sorted(tables["messages"]):  # An outer type comes before its nested types.
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
            enum.ClearField("options")  # Protobuf rejects the option allow_alias without aliases.
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
    """Add fields to the descriptor of a protobuf message type.

    Parameters
    ----------
    message : DescriptorProto
    fields : str
        ``name=number:type`` for each, with * if it is repeated.
    enums : container of str
        Names of the enumeration types.
    package : str
        Package of the types, unless ``elsewhere`` contains another one for a type.
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


# Message classes of ASAM OSI, built from the descriptors in a recording. Each recording has its own pool, so
# definitions never mix between files. The classes belong to the file's version of OSI. Fields that every
# version has are checked once, at the opening of a file. Fields that only some versions have are read with a
# default.
#
# Source: open-simulation-interface 3.8.0 (osi_groundtruth.proto, osi_object.proto, osi_common.proto).

GROUND_TRUTH: Final = "osi3.GroundTruth"
SENSOR_VIEW: Final = "osi3.SensorView"
HOST_DATA: Final = "osi3.HostVehicleData"
MOVING_OBJECT: Final = "osi3.MovingObject"
TRAFFIC_LIGHT: Final = "osi3.TrafficLight"
CONDITIONS: Final = "osi3.EnvironmentalConditions"
ROAD_MAP: Final = "osi3.MapAsamOpenDrive"

MAX_DESCRIPTORS: Final = 4 << 20
"""Maximum size of the descriptors of a message type; bytes. The descriptors of OSI 3.8 have 60 kB."""

DECODE_ERRORS: Final = (
    DecodeError,
    AttributeError,  # A descriptor lacks a field, or has another type in its place.
    TypeError,
    ValueError,
    LookupError,
    OverflowError,
    RecursionError,
    MemoryError,
)
"""Exceptions for malformed messages or descriptors."""

NO_VECTOR: Final = (NAN, NAN, NAN)
LATEST_NS: Final = 1 << 62
"""Limit of valid time stamps; ns."""
_GROUND_TRUTH_NEEDS: Final = ("timestamp.seconds", "moving_object")
_STATIC_NEEDS: Final = (
    "id.value",
    *(f"base.dimension.{name}" for name in ("length", "width", "height")),
    *(f"base.position.{name}" for name in "xyz"),
    *(f"base.orientation.{name}" for name in ("roll", "pitch", "yaw")),
)
_MOVING_OBJECT_NEEDS: Final = (
    *_STATIC_NEEDS,
    *("type", "vehicle_classification.type"),
    *(f"base.{vector}.{name}" for vector in ("velocity", "acceleration") for name in "xyz"),
)
_PART_NEEDS: Final = {
    TRAFFIC_LIGHT: (
        *_STATIC_NEEDS,
        *(f"classification.{name}" for name in ("color", "icon", "mode")),
    ),
    CONDITIONS: (),
}
_NEEDS: Final = {
    GROUND_TRUTH: _GROUND_TRUTH_NEEDS,
    SENSOR_VIEW: tuple(f"global_ground_truth.{path}" for path in _GROUND_TRUTH_NEEDS),
    ROAD_MAP: ("map_reference", "open_drive_xml_content"),
}


def message_class(
    schema: Schema, fields: dict[str, Any] | None = None, *, whole: bool = False
) -> type[Any]:
    """Return the protobuf message class for the schema of an MCAP channel.

    Parameters
    ----------
    schema : Schema
    fields : dict, optional
        Fields to read instead of those of frames, as in :func:`~sgstore.readers.osi._schema.prune`; each of
        them may be missing.
    whole : bool
        True for a class with all fields of any schema.

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
        wanted = fields_read().get(schema.name) if fields is None else fields
        if wanted is not None and not whole:
            parts = {name: fields_read()[name] for name in (MOVING_OBJECT, TRAFFIC_LIGHT)}
            prune(files, parts | {schema.name: wanted})
        pool = descriptor_pool.DescriptorPool()
        _add(pool, {file.name: file for file in files})
        found = pool.FindMessageTypeByName(schema.name)
        _require(found, _NEEDS.get(schema.name, ()) if fields is None and not whole else ())
        return message_factory.GetMessageClass(found)
    except DECODE_ERRORS as error:
        reason = f"schema {schema.name}: its protobuf descriptors are malformed: {error}"
        raise TraceError(reason) from error


def _add(
    pool: descriptor_pool.DescriptorPool, files: dict[str, descriptor_pb2.FileDescriptorProto]
) -> None:
    """Add protobuf files to a descriptor pool in the order of their imports."""
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
    """Return the protobuf class of moving objects that an OSI message class uses.

    Messages contain these objects as bytes.

    Raises
    ------
    TraceError
        The descriptors lack the type, or a field that every version of OSI has.
    """
    try:
        return _class_beside(message, MOVING_OBJECT, _MOVING_OBJECT_NEEDS)
    except DECODE_ERRORS as error:
        raise TraceError(
            f"schema {MOVING_OBJECT}: its protobuf descriptors are malformed: {error}"
        ) from error


def part_class(message: type[Any], name: str) -> type[Any] | None:
    """Return the protobuf class of a type that an OSI message class uses; ``None`` if it is unreadable.

    Messages contain these parts as bytes: traffic lights, and the conditions of the environment.
    """
    try:
        return _class_beside(message, name, _PART_NEEDS[name])
    except DECODE_ERRORS:
        return None


def _class_beside(message: type[Any], name: str, needs: tuple[str, ...]) -> type[Any]:
    found = message.DESCRIPTOR.file.pool.FindMessageTypeByName(name)
    _require(found, needs)
    return message_factory.GetMessageClass(found)


def lights_of(ground: Any) -> list[bytes]:
    """Return the traffic lights in an OSI ground truth message, in serialised form."""
    return list(getattr(ground, "traffic_light", ()))


def has_field(message: type[Any], path: str) -> bool:
    """Return True if a protobuf message class has the field at a dotted path."""
    try:
        _require(message.DESCRIPTOR, (path,))
    except KeyError:
        return False
    return True


def parse(message: type[Any], data: bytes) -> tuple[Any, Any, list[bytes]]:
    """Parse an OSI message. Return it, its ground truth part, and its moving objects in serialised form.

    Raises
    ------
    Exception
        One of :data:`DECODE_ERRORS`; also for too many objects.
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
    """Return the time stamp of an OSI message; ns. ``None`` if it has none.

    A stamp out of the valid range is returned only without a valid one.
    """
    late: int | None = None
    for part in (ground, message):
        if part.HasField("timestamp"):
            time_ns = int(part.timestamp.seconds * 1_000_000_000 + part.timestamp.nanos)
            if abs(time_ns) < LATEST_NS:
                return time_ns
            late = time_ns if late is None else late
    return late


@lru_cache(maxsize=64)
def _truth_in(message: type[Any]) -> int:
    """Return the field number of the ground truth in an OSI message class; 0 if it is the class itself."""
    truth = message.DESCRIPTOR.fields_by_name.get("global_ground_truth")
    return truth.number if truth is not None else 0


def enum_name(message: Any, field: str) -> str:
    """Return the name of an enumeration value in a protobuf message, such as ``TYPE_CAR``.

    A value unknown to the file's version of OSI keeps its number: ``TYPE_213``.
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
    """Return the value names of a protobuf enumeration field (number → name), and the field's number."""
    descriptor = message.DESCRIPTOR.fields_by_name[field]
    names = descriptor.enum_type.values_by_number
    # Read one by one: if a number has several names, the first one counts.
    return {number: str(names[number].name) for number in names}, descriptor.number


def identifiers(thing: Any) -> list[tuple[str, str]]:
    """Return the source references of an OSI object in order, as pairs (type of source, identifier).

    Raises
    ------
    ValueError
        There are too many references.
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
    """Return the id of the OpenDRIVE signal or object to which an OSI object refers; empty if none.

    esmini writes ``traffic_light_id:3``, ``traffic_sign_id:3`` and ``object_id:3``. A plain identifier is
    returned unchanged.
    """
    for source, identifier in identifiers(thing):
        key, colon, value = identifier.partition(":")
        if source == "net.asam.opendrive" and (not colon or key.endswith("_id")):
            return value if colon else identifier
    return ""


def assigned_lanes(classification: Any) -> list[int]:
    """Return the ids of all OSI lanes to which a traffic light or sign applies.

    Raises
    ------
    ValueError
        There are too many lanes.
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
    """Return the pose and size of a static OSI object; ``None`` if it has no usable position.

    The columns are those of :data:`sgstore.model.world.POSE`. A missing orientation or dimension is NaN.
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
