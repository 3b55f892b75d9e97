"""The messages of the recording: OSI ground truth and map, and Foxglove's camera and lidar types.

OSI's own messages come from the ``osi-python`` package of the ASAM project. The others are built here, from
their public lists of fields: ``osi3.MapAsamOpenDrive`` as omega-prime writes it (it is not part of OSI), and
Foxglove's ``CompressedImage``, ``CameraCalibration`` and ``PointCloud`` as the foxglove-sdk defines them.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

if TYPE_CHECKING:
    from google.protobuf.descriptor import FileDescriptor
    from google.protobuf.message import Message

DOUBLE, STRING, MESSAGE, BYTES, FIXED32, ENUM = 1, 9, 11, 12, 7, 14
"""Numbers of field types in ``descriptor.proto``."""
OPTIONAL, REPEATED = 1, 3

Fields = tuple[tuple[Any, ...], ...]
"""Fields of a message: name, number, type, and for messages and enumerations the name of their type."""

STAMP = ".google.protobuf.Timestamp"
MESSAGES: dict[str, tuple[str, str, Fields]] = {
    "MapAsamOpenDrive": ("osi3", "proto2", (
        ("map_reference", 1, STRING), ("open_drive_xml_content", 2, STRING),
    )),
    "Vector3": ("foxglove", "proto3", (("x", 1, DOUBLE), ("y", 2, DOUBLE), ("z", 3, DOUBLE))),
    "Quaternion": ("foxglove", "proto3", (
        ("x", 1, DOUBLE), ("y", 2, DOUBLE), ("z", 3, DOUBLE), ("w", 4, DOUBLE),
    )),
    "Pose": ("foxglove", "proto3", (
        ("position", 1, MESSAGE, ".foxglove.Vector3"), ("orientation", 2, MESSAGE, ".foxglove.Quaternion"),
    )),
    "PackedElementField": ("foxglove", "proto3", (
        ("name", 1, STRING), ("offset", 2, FIXED32),
        ("type", 3, ENUM, ".foxglove.PackedElementField.NumericType"),
    )),
    "CompressedImage": ("foxglove", "proto3", (
        ("timestamp", 1, MESSAGE, STAMP), ("data", 2, BYTES), ("format", 3, STRING), ("frame_id", 4, STRING),
    )),
    "CameraCalibration": ("foxglove", "proto3", (
        ("timestamp", 1, MESSAGE, STAMP), ("width", 2, FIXED32), ("height", 3, FIXED32),
        ("distortion_model", 4, STRING), ("D", 5, DOUBLE, "*"), ("K", 6, DOUBLE, "*"), ("R", 7, DOUBLE, "*"),
        ("P", 8, DOUBLE, "*"), ("frame_id", 9, STRING),
    )),
    "PointCloud": ("foxglove", "proto3", (
        ("timestamp", 1, MESSAGE, STAMP), ("frame_id", 2, STRING), ("pose", 3, MESSAGE, ".foxglove.Pose"),
        ("point_stride", 4, FIXED32), ("fields", 5, MESSAGE, ".foxglove.PackedElementField", "*"),
        ("data", 6, BYTES),
    )),
}  # fmt: skip
NUMERIC_TYPES = [
    "UNKNOWN",
    "UINT8",
    "INT8",
    "UINT16",
    "INT16",
    "UINT32",
    "INT32",
    "FLOAT32",
    "FLOAT64",
]


def file_of(name: str) -> descriptor_pb2.FileDescriptorProto:
    """The definition of one of :data:`MESSAGES`, in a file of its own, as its makers have it."""
    package, syntax, fields = MESSAGES[name]
    stem = "osi_mapasamopendrive" if package == "osi3" else name
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}/{stem}.proto", package=package)
    if syntax == "proto3":
        file.syntax = syntax
    message = file.message_type.add(name=name)
    for field_name, number, kind, *rest in fields:
        field = message.field.add(name=field_name, number=number, type=kind)
        field.label = REPEATED if "*" in rest else OPTIONAL
        if rest and rest[0] != "*":
            field.type_name = rest[0]
            owner = rest[0].removeprefix(f".{package}.").split(".")[0]
            needed = (
                f"{package}/{owner}.proto" if rest[0] != STAMP else timestamp_pb2.DESCRIPTOR.name
            )
            if owner != name and needed not in file.dependency:
                file.dependency.append(needed)
    if name == "PackedElementField":
        numbers = message.enum_type.add(name="NumericType")
        for i, word in enumerate(NUMERIC_TYPES):
            numbers.value.add(name=word, number=i)
    return file


@cache
def pool() -> descriptor_pool.DescriptorPool:
    """A pool of our own with all of :data:`MESSAGES`; the order there is that of their dependencies."""
    made = descriptor_pool.DescriptorPool()
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    made.Add(stamp)
    for name in MESSAGES:
        made.Add(file_of(name))
    return made


@cache
def kind_of(name: str) -> type[Message]:
    """The class of one of :data:`MESSAGES`."""
    package = MESSAGES[name][0]
    return message_factory.GetMessageClass(pool().FindMessageTypeByName(f"{package}.{name}"))


def schema_of(message: type[Message]) -> bytes:
    """The definition of a message with all it depends on, as MCAP wants it: a FileDescriptorSet."""
    found: dict[str, descriptor_pb2.FileDescriptorProto] = {}

    def add(file: FileDescriptor) -> None:
        for needed in file.dependencies:
            add(needed)
        if file.name not in found:
            found[file.name] = descriptor_pb2.FileDescriptorProto()
            file.CopyToProto(found[file.name])

    add(message.DESCRIPTOR.file)
    files = descriptor_pb2.FileDescriptorSet(file=found.values())
    return files.SerializeToString(deterministic=True)
