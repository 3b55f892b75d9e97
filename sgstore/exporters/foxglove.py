"""What sensors measured → messages of Foxglove's types, which Foxglove, Lichtblick and our own reader show.

Pictures are PNG. What is neither a picture nor points is JSON.

Source: foxglove-sdk, schemas (public lists of fields).
"""

from __future__ import annotations

import json
import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
    timestamp_pb2,
)

from sgstore.exporters.pictures import png

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

_FIELD: Final = descriptor_pb2.FieldDescriptorProto
_SCALARS: Final = {
    "double": _FIELD.TYPE_DOUBLE,
    "string": _FIELD.TYPE_STRING,
    "bytes": _FIELD.TYPE_BYTES,
    "fixed32": _FIELD.TYPE_FIXED32,
    "bool": _FIELD.TYPE_BOOL,
}
_GOOGLE: Final = {"Timestamp": timestamp_pb2.DESCRIPTOR, "Duration": duration_pb2.DESCRIPTOR}
_TYPES: Final = {
    "Vector3": "x=1:double y=2:double z=3:double",
    "Quaternion": "x=1:double y=2:double z=3:double w=4:double",
    "Pose": "position=1:Vector3 orientation=2:Quaternion",
    "PackedElementField": "name=1:string offset=2:fixed32 type=3:PackedElementField.NumericType",
    "CompressedImage": "timestamp=1:Timestamp data=2:bytes format=3:string frame_id=4:string",
    "CameraCalibration": "timestamp=1:Timestamp width=2:fixed32 height=3:fixed32"
    " distortion_model=4:string D=5:double* K=6:double* R=7:double* P=8:double* frame_id=9:string",
    "PointCloud": "timestamp=1:Timestamp frame_id=2:string pose=3:Pose point_stride=4:fixed32"
    " fields=5:PackedElementField* data=6:bytes",
}
"""Fields of the messages, ``name=number:type``, with * if repeated; each after those that it needs."""
_ENUMS: Final = {
    "PackedElementField.NumericType": "UNKNOWN UINT8 INT8 UINT16 INT16 UINT32 INT32 FLOAT32 FLOAT64",
}
"""Their enumerations, by owner and name, numbered from 0."""
_NUMERIC_OF: Final = {"f4": 7, "f8": 8, "u4": 5, "i4": 6, "u1": 1}

IMAGE, CALIBRATION, CLOUD = "CompressedImage", "CameraCalibration", "PointCloud"


def schema() -> bytes:
    """The descriptors of all messages, as an MCAP file carries them."""
    return _file().SerializeToString()


@cache
def _file() -> descriptor_pb2.FileDescriptorSet:
    return descriptors(_TYPES, _ENUMS)


def descriptors(
    types: Mapping[str, str], enums: Mapping[str, str]
) -> descriptor_pb2.FileDescriptorSet:
    """Descriptors of messages of Foxglove's, and of what of Google's they need.

    Parameters
    ----------
    types : mapping
        Name → fields, ``name=number:type``, with * if repeated; each after those that it needs.
    enums : mapping
        ``Owner.Name`` → words, numbered from 0.
    """
    needed = " ".join(types.values())
    used = [file for name, file in _GOOGLE.items() if f":{name}" in needed]
    google = [descriptor_pb2.FileDescriptorProto.FromString(file.serialized_pb) for file in used]
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto",
        package="foxglove",
        syntax="proto3",
        dependency=[file.name for file in google],
    )
    for name, items in types.items():
        message = file.message_type.add(name=name)
        for item in items.split():
            label, _, rest = item.partition("=")
            number, _, kind = rest.partition(":")
            field = message.field.add(name=label, number=int(number))
            field.label = _FIELD.LABEL_REPEATED if kind.endswith("*") else _FIELD.LABEL_OPTIONAL
            _set_type(field, kind.removesuffix("*"), enums)
        for name_of, words in enums.items():
            owner, _, own = name_of.partition(".")
            if owner == name:
                enum = message.enum_type.add(name=own)
                for number, word in enumerate(words.split()):
                    enum.value.add(name=word, number=number)
    return descriptor_pb2.FileDescriptorSet(file=[*google, file])


def _set_type(
    field: descriptor_pb2.FieldDescriptorProto, kind: str, enums: Mapping[str, str]
) -> None:
    if kind in _SCALARS:
        field.type = _SCALARS[kind]
    elif kind in enums:
        field.type, field.type_name = _FIELD.TYPE_ENUM, f".foxglove.{kind}"
    else:
        package = "google.protobuf" if kind in _GOOGLE else "foxglove"
        field.type, field.type_name = _FIELD.TYPE_MESSAGE, f".{package}.{kind}"


@cache
def message_type(name: str) -> type[Any]:
    """The class of a message."""
    return class_of(_file(), name)


def class_of(files: descriptor_pb2.FileDescriptorSet, name: str) -> type[Any]:
    """The class of a message that descriptors describe."""
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


def image(pixels: NDArray[np.uint8], time_ns: int, frame_id: str) -> bytes:
    """A picture, (height, width, 3), as ``foxglove.CompressedImage``."""
    out = message_type(IMAGE)(format="png", frame_id=frame_id, data=png(pixels))
    stamp(out, time_ns)
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
    stamp(out, time_ns)
    return out.SerializeToString()


def cloud(points: NDArray[Any], time_ns: int, frame_id: str) -> bytes:
    """Points, a structured array, as ``foxglove.PointCloud`` in the sensor's own axes."""
    out = message_type(CLOUD)(frame_id=frame_id, data=points.tobytes())
    out.point_stride = points.dtype.itemsize
    out.pose.orientation.w = 1.0
    for name, (kind, offset, *_) in (points.dtype.fields or {}).items():
        out.fields.add(name=name, offset=offset, type=_NUMERIC_OF[kind.str[1:]])
    stamp(out, time_ns)
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


def stamp(message: Any, time_ns: int) -> None:
    """Set the field ``timestamp`` of a message."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
