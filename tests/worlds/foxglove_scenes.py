"""Small recordings of Foxglove scenes, in protobuf and in JSON, in the words of the domain.

::

    with SceneRecorder(path, "json") as recorder:
        recorder.transform(0.0, "map", "base_link", (1, 2, 0))
        recorder.scene(0.0, [cube("a", (5, 0, 1), kind="car")])

The descriptors are written from Foxglove's schemas, with their names and numbers.
"""

from __future__ import annotations

import json
import math
from functools import cache
from typing import TYPE_CHECKING, Any

from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
    timestamp_pb2,
)
from recordings import Recorder, ns

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

TYPES = {
    "Vector3": "x=1:double y=2:double z=3:double",
    "Quaternion": "x=1:double y=2:double z=3:double w=4:double",
    "Pose": "position=1:Vector3 orientation=2:Quaternion",
    "Color": "r=1:double g=2:double b=3:double a=4:double",
    "KeyValuePair": "key=1:string value=2:string",
    "CubePrimitive": "pose=1:Pose size=2:Vector3 color=3:Color",
    "SpherePrimitive": "pose=1:Pose size=2:Vector3 color=3:Color",
    "CylinderPrimitive": "pose=1:Pose size=2:Vector3 bottom_scale=3:double top_scale=4:double color=5:Color",
    "LinePrimitive": "type=1:int32 pose=2:Pose thickness=3:double",
    "TextPrimitive": "pose=1:Pose billboard=2:bool font_size=3:double text=6:string",
    "ModelPrimitive": "pose=1:Pose scale=2:Vector3 url=5:string",
    "SceneEntityDeletion": "timestamp=1:Timestamp type=2:int32 id=3:string",
    "SceneEntity": "timestamp=1:Timestamp frame_id=2:string id=3:string lifetime=4:Duration"
    " frame_locked=5:bool metadata=6:KeyValuePair* cubes=8:CubePrimitive* spheres=9:SpherePrimitive*"
    " cylinders=10:CylinderPrimitive* lines=11:LinePrimitive* texts=13:TextPrimitive*"
    " models=14:ModelPrimitive*",
    "SceneUpdate": "deletions=1:SceneEntityDeletion* entities=2:SceneEntity*",
    "FrameTransform": "timestamp=1:Timestamp parent_frame_id=2:string child_frame_id=3:string"
    " translation=4:Vector3 rotation=5:Quaternion",
    "FrameTransforms": "transforms=1:FrameTransform*",
    "CompressedImage": "timestamp=1:Timestamp data=2:bytes format=3:string frame_id=4:string",
}
_FIELD = descriptor_pb2.FieldDescriptorProto
_GOOGLE = {"Timestamp", "Duration"}


@cache
def files() -> descriptor_pb2.FileDescriptorSet:
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"],
    )
    for name, items in TYPES.items():
        message = file.message_type.add(name=name)
        for item in items.split():
            label, _, rest = item.partition("=")
            number, _, kind = rest.partition(":")
            field = message.field.add(name=label, number=int(number))
            field.label = _FIELD.LABEL_REPEATED if kind.endswith("*") else _FIELD.LABEL_OPTIONAL
            kind = kind.rstrip("*")
            scalar = getattr(_FIELD, f"TYPE_{kind.upper()}", None)
            if scalar is not None:
                field.type = scalar
            else:
                field.type = _FIELD.TYPE_MESSAGE
                package = "google.protobuf" if kind in _GOOGLE else "foxglove"
                field.type_name = f".{package}.{kind}"
    google = [
        descriptor_pb2.FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)
        for module in (timestamp_pb2, duration_pb2)
    ]
    return descriptor_pb2.FileDescriptorSet(file=[file, *google])


@cache
def class_of(name: str) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in reversed(files().file):
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


def turn(yaw: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def at(place: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, place), strict=True))


def cube(
    ident: str,
    place: tuple[float, float, float] = (0, 0, 0),
    *,
    yaw: float = 0.0,
    size: tuple[float, float, float] = (4.5, 1.9, 1.5),
    axes: str = "map",
    shape: str = "cubes",
    **metadata: Any,
) -> dict[str, Any]:
    """An entity with one solid; words that are left over are metadata."""
    lifetime = metadata.pop("lifetime", None)
    locked = metadata.pop("locked", True)
    stamp = metadata.pop("stamp", None)
    solid = {"pose": {"position": at(place), "orientation": turn(yaw)}}
    if shape in {"cubes", "spheres", "cylinders"}:
        solid["size"] = at(size)
    return {
        "id": ident,
        "frame_id": axes,
        "frame_locked": locked,
        "metadata": [{"key": key, "value": str(value)} for key, value in metadata.items()],
        shape: [solid],
        **({"lifetime": lifetime} if lifetime else {}),
        **({"timestamp": stamp} if stamp is not None else {}),
    }


class SceneRecorder(Recorder):
    """Writes scenes; ``encoding``: ``protobuf`` or ``json``."""

    encoding: str = "protobuf"

    @classmethod
    def of(cls, path: Path, encoding: str, **how: Any) -> SceneRecorder:
        recorder = cls(path, **how)
        recorder.encoding = encoding
        recorder.files = files()
        return recorder

    def told(self, topic: str, name: str, time: float, message: dict[str, Any]) -> None:
        if self.encoding == "json":
            channel = self.channel(topic, f"foxglove.{name}", b'{"type": "object"}')
            self.write(channel, time, json.dumps(message).encode())
            return
        channel = self.channel(topic, f"foxglove.{name}")
        filled = fill(class_of(name)(), _plain(message))
        self.write(channel, time, filled.SerializeToString())

    def scene(
        self,
        time: float,
        entities: Iterable[dict[str, Any]] = (),
        *,
        deleted: Iterable[str] = (),
        clear: bool = False,
        topic: str = "scene",
        stamped: bool = True,
    ) -> None:
        """A ``SceneUpdate``. ``stamped``: its entities bear its time."""
        told = [
            ({"timestamp": stamp(time)} if stamped else {})
            | entity
            | ({"timestamp": stamp(entity["timestamp"])} if "timestamp" in entity else {})
            | ({"lifetime": stamp(entity["lifetime"])} if "lifetime" in entity else {})
            for entity in entities
        ]
        gone = [{"timestamp": stamp(time), "type": 0, "id": ident} for ident in deleted]
        gone += [{"timestamp": stamp(time), "type": 1, "id": ""}] if clear else []
        self.told(topic, "SceneUpdate", time, {"deletions": gone, "entities": told})

    def transform(
        self,
        time: float,
        parent: str,
        child: str,
        place: tuple[float, float, float] = (0, 0, 0),
        yaw: float = 0.0,
        topic: str = "/tf",
    ) -> None:
        one = {
            "timestamp": stamp(time),
            "parent_frame_id": parent,
            "child_frame_id": child,
            "translation": at(place),
            "rotation": turn(yaw),
        }
        if topic == "/tfs":
            self.told(topic, "FrameTransforms", time, {"transforms": [one]})
        else:
            self.told(topic, "FrameTransform", time, one)


def stamp(time: float) -> dict[str, int]:
    seconds, nanos = divmod(ns(time), 1_000_000_000)
    return {"sec": seconds, "nsec": nanos}


def _plain(value: Any) -> Any:
    """The same with times as protobuf has them."""
    if isinstance(value, dict):
        if set(value) == {"sec", "nsec"}:
            return {"seconds": value["sec"], "nanos": value["nsec"]}
        return {key: _plain(v) for key, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list) else value


def fill(message: Any, told: dict[str, Any]) -> Any:
    """Fill a message from plain values."""
    for name, value in told.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value).SetInParent()
        elif isinstance(value, list):
            for item in value:
                fill(getattr(message, name).add(), item)
        else:
            setattr(message, name, value)
    return message
