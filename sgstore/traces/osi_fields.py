"""Which fields of OSI are read; what is not read is not parsed.

A ground truth is mostly lanes and boundaries, and a sensor view may carry whole pictures. Fields that
nobody here reads are taken out of the descriptors, so that protobuf keeps their bytes as they are: it
parses a static-heavy message several times faster, and a message made of a hundred million empty points
costs no more than its own size. What is read is bounded by number before it is parsed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from google.protobuf import descriptor_pb2

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
    "vehicle_powertrain": {"pedal_position_acceleration": None},
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
