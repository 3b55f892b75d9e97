"""What sensors measured → messages of Foxglove's types, which Foxglove, Lichtblick and our own reader show.

Pictures are PNG: a few lines, no package, nothing lost. What is neither a picture nor points is JSON.

Source: foxglove-sdk, schemas (public lists of fields); PNG specification (third edition), chapters 9 to 11.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FIELD: Final = descriptor_pb2.FieldDescriptorProto
_SCALARS: Final = {
    "double": _FIELD.TYPE_DOUBLE,
    "string": _FIELD.TYPE_STRING,
    "bytes": _FIELD.TYPE_BYTES,
    "fixed32": _FIELD.TYPE_FIXED32,
}
_TYPES: Final = {
    "Vector3": "x=1:double y=2:double z=3:double",
    "Quaternion": "x=1:double y=2:double z=3:double w=4:double",
    "Pose": "position=1:Vector3 orientation=2:Quaternion",
    "PackedElementField": "name=1:string offset=2:fixed32 type=3:NumericType",
    "CompressedImage": "timestamp=1:Timestamp data=2:bytes format=3:string frame_id=4:string",
    "CameraCalibration": "timestamp=1:Timestamp width=2:fixed32 height=3:fixed32"
    " distortion_model=4:string D=5:double* K=6:double* R=7:double* P=8:double* frame_id=9:string",
    "PointCloud": "timestamp=1:Timestamp frame_id=2:string pose=3:Pose point_stride=4:fixed32"
    " fields=5:PackedElementField* data=6:bytes",
}
"""Fields of the messages, ``name=number:type``, with * if repeated; each after those that it needs."""
_NUMERIC: Final = (
    "UNKNOWN",
    "UINT8",
    "INT8",
    "UINT16",
    "INT16",
    "UINT32",
    "INT32",
    "FLOAT32",
    "FLOAT64",
)
_NUMERIC_OF: Final = {"f4": 7, "f8": 8, "u4": 5, "i4": 6, "u1": 1}

IMAGE, CALIBRATION, CLOUD = "CompressedImage", "CameraCalibration", "PointCloud"


def schema() -> bytes:
    """The descriptors of all messages, as an MCAP file carries them."""
    return _file().SerializeToString()


@cache
def _file() -> descriptor_pb2.FileDescriptorSet:
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto", package="foxglove", syntax="proto3", dependency=[stamp.name]
    )
    for name, items in _TYPES.items():
        message = file.message_type.add(name=name)
        for item in items.split():
            label, _, rest = item.partition("=")
            number, _, kind = rest.partition(":")
            field = message.field.add(name=label, number=int(number))
            field.label = _FIELD.LABEL_REPEATED if kind.endswith("*") else _FIELD.LABEL_OPTIONAL
            _set_type(field, kind.removesuffix("*"))
    enum = next(m for m in file.message_type if m.name == "PackedElementField").enum_type
    numeric = enum.add(name="NumericType")
    for number, word in enumerate(_NUMERIC):
        numeric.value.add(name=word, number=number)
    return descriptor_pb2.FileDescriptorSet(file=[stamp, file])


def _set_type(field: descriptor_pb2.FieldDescriptorProto, kind: str) -> None:
    if kind in _SCALARS:
        field.type = _SCALARS[kind]
    elif kind == "NumericType":
        field.type, field.type_name = _FIELD.TYPE_ENUM, ".foxglove.PackedElementField.NumericType"
    else:
        package = "google.protobuf" if kind == "Timestamp" else "foxglove"
        field.type, field.type_name = _FIELD.TYPE_MESSAGE, f".{package}.{kind}"


@cache
def message_type(name: str) -> type[Any]:
    """The class of a message."""
    pool = descriptor_pool.DescriptorPool()
    for file in _file().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


def image(pixels: NDArray[np.uint8], time_ns: int, frame_id: str) -> bytes:
    """A picture, (height, width, 3), as ``foxglove.CompressedImage``."""
    out = message_type(IMAGE)(format="png", frame_id=frame_id, data=png(pixels))
    _stamp(out, time_ns)
    return out.SerializeToString()


def calibration(width: int, height: int, fov: float, time_ns: int, frame_id: str) -> bytes:
    """A pinhole camera without distortion, by its field of view across, in degrees."""
    focal = width / (2 * math.tan(math.radians(fov) / 2))
    x, y = width / 2, height / 2
    out = message_type(CALIBRATION)(
        width=width, height=height, frame_id=frame_id, distortion_model="plumb_bob", D=[0.0] * 5
    )
    out.K.extend([focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0])
    out.R.extend([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    out.P.extend([focal, 0.0, x, 0.0, 0.0, focal, y, 0.0, 0.0, 0.0, 1.0, 0.0])
    _stamp(out, time_ns)
    return out.SerializeToString()


def cloud(points: NDArray[Any], time_ns: int, frame_id: str) -> bytes:
    """Points, a structured array, as ``foxglove.PointCloud`` in the sensor's own axes."""
    out = message_type(CLOUD)(frame_id=frame_id, data=points.tobytes())
    out.point_stride = points.dtype.itemsize
    out.pose.orientation.w = 1.0
    for name, (kind, offset, *_) in (points.dtype.fields or {}).items():
        out.fields.add(name=name, offset=offset, type=_NUMERIC_OF[kind.str[1:]])
    _stamp(out, time_ns)
    return out.SerializeToString()


def values(told: dict[str, Any], time_ns: int) -> bytes:
    """Values by name, as JSON with their time."""
    about = {"timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}} | told
    return json.dumps(_plain(about), allow_nan=False).encode()


def _plain(value: Any) -> Any:
    """A value as JSON knows it: what is no number is null."""
    match value:
        case float() if not math.isfinite(value):
            return None
        case dict():
            return {key: _plain(item) for key, item in value.items()}
        case list():
            return [_plain(item) for item in value]
        case _:
            return value


def png(pixels: NDArray[np.uint8]) -> bytes:
    """A picture, (height, width, 3), as a PNG file.

    Each row is written as its difference to the one above (filter 2), which costs little and makes most
    pictures a third smaller.
    """
    height, width, _ = pixels.shape
    rows = pixels.reshape(height, -1)
    lines = np.empty((height, 3 * width + 1), np.uint8)
    lines[:, 0] = 2
    lines[0, 1:] = rows[0]
    lines[1:, 1:] = rows[1:] - rows[:-1]
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))
        for tag, data in parts
    )


def _stamp(message: Any, time_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
