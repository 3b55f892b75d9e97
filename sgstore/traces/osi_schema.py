"""Message classes of ASAM OSI, made from the descriptors that a recording carries.

Each recording has a pool of its own: what one file defines is never seen by another. The classes are
those of the file's own version of OSI; what every version has is asked for once, when a file is opened,
and what only some have is looked up with a default.

Source: open-simulation-interface 3.8.0 (osi_groundtruth.proto, osi_object.proto, osi_common.proto).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, unknown_fields
from google.protobuf.message import DecodeError

from sgstore.errors import TraceError
from sgstore.traces.frames import FAR, NAN
from sgstore.traces.osi_fields import (
    GROUND_TRUTH_FIELDS,
    HOST_DATA_FIELDS,
    MAX_OBJECTS,
    MAX_REFERENCES,
    MOVING_OBJECT_FIELDS,
    SENSOR_VIEW_FIELDS,
    TRAFFIC_LIGHT_FIELDS,
    check_size,
    prune,
)

if TYPE_CHECKING:
    from google.protobuf.descriptor import Descriptor
    from mcap.records import Schema

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

_NO_VECTOR: Final = (NAN, NAN, NAN)
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
        Which fields to read instead of those of frames, as :func:`~sgstore.traces.osi_fields.prune` has them;
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
    """Whether a message class has a field, given as a path of names with dots between."""
    try:
        _require(message.DESCRIPTOR, (path,))
    except KeyError:
        return False
    return True


def parse(message: type[Any], data: bytes) -> Any:
    """A message of the leading channel, whose objects are not too many to be looked at.

    Raises
    ------
    Exception
        One of :data:`DECODE_ERRORS`.
    """
    truth = message.DESCRIPTOR.fields_by_name.get("global_ground_truth")
    check_size(data, truth.number if truth is not None else 0)
    parsed = message.FromString(data)
    count = len(ground_truth_of(parsed).moving_object)
    if count > MAX_OBJECTS:
        raise ValueError(f"{count} moving objects; at most {MAX_OBJECTS} are read")
    return parsed


def ground_truth_of(message: Any) -> Any:
    """The ground truth in a message, which may be one itself."""
    return message.global_ground_truth if hasattr(message, "global_ground_truth") else message


def enum_name(message: Any, field: str) -> str:
    """The name of an enumeration's value in a message: ``TYPE_CAR``.

    A value that the file's own version of OSI does not know is kept by its number: ``TYPE_213``.
    """
    descriptor = message.DESCRIPTOR.fields_by_name[field]
    names = descriptor.enum_type.values_by_number
    number = getattr(message, field)
    if not message.HasField(field):
        for unknown in unknown_fields.UnknownFieldSet(message):
            if unknown.field_number == descriptor.number and isinstance(unknown.data, int):
                number = unknown.data
    if number in names:
        return str(names[number].name)
    return f"{names[0].name.split('_')[0] if 0 in names else field.upper()}_{number}"


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
        *(angles if base.HasField("orientation") else _NO_VECTOR),
        *(NAN,) * 7,
        *(extents if base.HasField("dimension") else _NO_VECTOR),
    )
