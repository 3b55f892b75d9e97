"""Conversion of sensor data and scene graphs to Foxglove messages (Protobuf).

Foxglove, Lichtblick and the reader of this package display them. Pictures are PNG; other
measurements than pictures and points are JSON. In a scene graph, entities are boxes with names, map
parts are dots, and edges are lines between centres. All edges of one relation are one scene entity,
so that a viewer can show and hide them. Each message replaces the previous one. Places are those of
the scene graph: metres, in the axes of the road map.

Source: foxglove-sdk, schemas (public lists of fields).
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
    timestamp_pb2,
)

from sgstore.base.json_text import finite
from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY
from sgstore.readers import add_fields, png

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from sgstore.model.graph import SceneGraph


_GOOGLE: Final = {"Timestamp": timestamp_pb2.DESCRIPTOR, "Duration": duration_pb2.DESCRIPTOR}
_TABLES: Final = tomllib.loads(
    resources.files("sgstore.exporters").joinpath("foxglove.toml").read_text(encoding="utf-8")
)
_TYPES: Final[dict[str, str]] = _TABLES["types"]
_ENUMS: Final[dict[str, str]] = _TABLES["enums"]
_NUMERIC_OF: Final = {"f4": 7, "f8": 8, "u4": 5, "i4": 6, "u1": 1}

IMAGE, CALIBRATION, CLOUD = "CompressedImage", "CameraCalibration", "PointCloud"
SCENE, TRANSFORMS = "SceneUpdate", "FrameTransforms"


def schema(name: str) -> bytes:
    """Return the Protobuf descriptors of a Foxglove message type as bytes, for an MCAP file."""
    return _descriptors(name).SerializeToString()


@cache
def _descriptors(name: str) -> descriptor_pb2.FileDescriptorSet:
    """Return the Protobuf descriptors of a Foxglove message type, and of all types that it uses."""
    kinds = {one: set(re.findall(r":(\w+)", fields)) for one, fields in _TYPES.items()}
    needed, found = set[str](), {name}
    while found:
        needed |= found
        found = set[str]().union(*(kinds.get(one, ()) for one in found)) - needed
    google = [
        descriptor_pb2.FileDescriptorProto.FromString(file.serialized_pb)
        for one, file in _GOOGLE.items()
        if one in needed
    ]
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove.proto",
        package="foxglove",
        syntax="proto3",
        dependency=[file.name for file in google],
    )
    for one in _TYPES:
        if one in needed:
            _add_message(file.message_type.add(name=one))
    return descriptor_pb2.FileDescriptorSet(file=[*google, file])


def _add_message(message: descriptor_pb2.DescriptorProto) -> None:
    """Add the fields and enumerations of a Foxglove message type to its Protobuf descriptor."""
    google = dict.fromkeys(_GOOGLE, "google.protobuf")
    add_fields(message, _TYPES[message.name], _ENUMS, "foxglove", google)
    for name_of, words in _ENUMS.items():
        owner, _, own = name_of.partition(".")
        if owner == message.name:
            enum = message.enum_type.add(name=own)
            for number, word in enumerate(words.split()):
                enum.value.add(name=word, number=number)


@cache
def message_type(name: str) -> type[Any]:
    """Return the Python class for a Foxglove message type."""
    pool = descriptor_pool.DescriptorPool()
    for file in _descriptors(name).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


def image(pixels: NDArray[np.uint8], time_ns: int, frame_id: str) -> bytes:
    """Return a picture (height, width, 3) as a ``foxglove.CompressedImage`` message."""
    out = message_type(IMAGE)(format="png", frame_id=frame_id, data=png(pixels))
    stamp(out, time_ns)
    return out.SerializeToString()


def calibration(width: int, height: int, fov: float, time_ns: int, frame_id: str) -> bytes:
    """Return a camera calibration message for a pinhole camera, from its field of view in degrees."""
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
    """Return points (a structured array) as a ``foxglove.PointCloud`` message, in the axes of the sensor."""
    out = message_type(CLOUD)(frame_id=frame_id, data=points.tobytes())
    out.point_stride = points.dtype.itemsize
    out.pose.orientation.w = 1.0
    for name, (kind, offset, *_) in (points.dtype.fields or {}).items():
        out.fields.add(name=name, offset=offset, type=_NUMERIC_OF[kind.str[1:]])
    stamp(out, time_ns)
    return out.SerializeToString()


def values(told: dict[str, Any], time_ns: int) -> bytes:
    """Return named values as a JSON message with a timestamp."""
    about = {"timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}} | told
    return json.dumps(finite(about), allow_nan=False).encode()


def stamp(message: Any, time_ns: int) -> None:
    """Set the field ``timestamp`` of a Foxglove message from a time in ns."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)


AXES: Final = "map"
"""Name of the coordinate axes of all scene graphs, as in CARLA's bridge and most ROS systems."""

_ALL, _LINE_LIST = 1, 2

Colour = tuple[float, float, float, float]

# Viewers have a white or a black background. Each colour has a contrast of at least 3 to both;
# faint edges 1.5, texts 4.5. (WCAG 2.2, relative luminance and contrast ratio, 1.4.3 and 1.4.11.)
EGO_COLOUR: Final[Colour] = (0.1, 0.45, 0.95, 1.0)
TEXT_COLOUR: Final[Colour] = (0.46, 0.46, 0.46, 1.0)
COLOURS: Final[dict[str, Colour]] = {
    **dict.fromkeys(("person", "animal"), (0.9, 0.42, 0.08, 1.0)),
    **dict.fromkeys(("bicycle", "motorcycle"), (0.7, 0.5, 0.05, 1.0)),
    **dict.fromkeys(
        ("car", "truck", "van", "bus", "trailer", "train", "vehicle"), (0.45, 0.5, 0.55, 1.0)
    ),
    **dict.fromkeys(("lane", "road", "junction", "roundabout", "crosswalk"), (0.5, 0.5, 0.5, 1.0)),
}
LIGHTS: Final[dict[str, Colour]] = {
    "red": (0.9, 0.1, 0.1, 1.0),
    "yellow": (0.74, 0.54, 0.0, 1.0),
    "red_yellow": (0.88, 0.42, 0.05, 1.0),
    "green": (0.08, 0.62, 0.18, 1.0),
}
OTHERS: Final[Colour] = (0.52, 0.52, 0.48, 1.0)
RELATION_COLOURS: Final[dict[str, Colour]] = {
    **dict.fromkeys(DIRECTIONS, (0.3, 0.5, 0.9, 0.45)),
    **{
        name: (0.9 - 0.04 * i, 0.15 + 0.07 * i, 0.1, 0.95 - 0.1 * i)
        for i, name in enumerate(PROXIMITY)
    },
    **dict.fromkeys(("toLeftOf", "toRightOf"), (0.5, 0.4, 0.8, 0.5)),
    **dict.fromkeys(("leads", "follows"), (0.08, 0.55, 0.52, 1.0)),
    **dict.fromkeys(("controlsTrafficOf", "mayAffect"), (0.8, 0.2, 0.6, 1.0)),
    "overlaps": (1.0, 0.0, 0.0, 1.0),
    "sees": (0.2, 0.62, 0.2, 0.5),
}
OTHER_RELATIONS: Final[Colour] = (0.55, 0.55, 0.55, 0.5)

DOT: Final = 0.5
"""Diameter of the symbol of nodes without a size; m."""
LINE: Final = 2.0
"""Width of the lines of edges; pixels."""
TEXT: Final = 12.0
"""Size of the text of names; pixels."""


def message(graph: SceneGraph, log_time_ns: int) -> bytes:
    """Return a scene graph as a Foxglove 3D scene message. Nodes without a position are left out."""
    update = message_type(SCENE)()
    gone = update.deletions.add(type=_ALL)
    stamp(gone, log_time_ns)
    places = {node: place_of(about) for node, about in graph.nodes.items()}
    for node, about in graph.nodes.items():
        place = places[node]
        if place is not None:
            _add_node(_entity(update, about["name"], log_time_ns), node, about, place)
    lines: dict[str, Any] = {}
    for src, relation, dst, _ in graph.edges:
        ends = places.get(src), places.get(dst)
        if None in ends:
            continue
        if relation not in lines:
            entity = _entity(update, f"edges {relation}", log_time_ns)
            lines[relation] = entity.lines.add(
                type=_LINE_LIST, thickness=LINE, scale_invariant=True
            )
            lines[relation].pose.orientation.w = 1.0
            _paint(lines[relation].color, RELATION_COLOURS.get(relation, OTHER_RELATIONS))
        for end in ends:
            x, y, z = end or (0.0, 0.0, 0.0)
            lines[relation].points.add(x=x, y=y, z=z)
    return update.SerializeToString(deterministic=True)


def _entity(update: Any, name: str, log_time_ns: int) -> Any:
    entity = update.entities.add(frame_id=AXES, id=name)
    stamp(entity, log_time_ns)
    return entity


def _add_node(
    entity: Any, node: int, about: dict[str, Any], place: tuple[float, float, float]
) -> None:
    entity.metadata.add(key="node_id", value=str(node))
    for key in ("kind", "ident", "type_name", "special", "speed", "light_state"):
        if key in about:
            entity.metadata.add(key=key, value=str(about[key]))
    solid = is_solid(node, about)
    body = entity.cubes.add() if solid else entity.spheres.add()
    body.pose.position.x, body.pose.position.y, body.pose.position.z = place
    _turn(body.pose.orientation, quaternion(*turn_of(about)))
    size = (about["length"], about["width"], about["height"]) if solid else (DOT, DOT, DOT)
    body.size.x, body.size.y, body.size.z = size
    _paint(body.color, colour_of(about))
    if node >= 0 and not about.get("is_static"):
        name = entity.texts.add(
            text=about["name"], billboard=True, font_size=TEXT, scale_invariant=True
        )
        name.pose.position.x, name.pose.position.y = place[:2]
        name.pose.position.z = place[2] + about.get("height", 0.0) / 2 + DOT
        name.pose.orientation.w = 1.0
        _paint(name.color, TEXT_COLOUR)


def is_solid(node: int, about: Mapping[str, Any]) -> bool:
    """True if a node is an entity with a known size."""
    return node >= 0 and all(about.get(side) for side in ("length", "width", "height"))


def colour_of(about: Mapping[str, Any]) -> Colour:
    """Return the colour of a node in a 3D scene, by its kind and light state."""
    if about.get("is_ego"):
        return EGO_COLOUR
    return LIGHTS.get(about.get("light_state", ""), COLOURS.get(about["kind"], OTHERS))


@dataclass(frozen=True, slots=True)
class AxesTransform:
    """Position and rotation of coordinate axes relative to their parent axes.

    Attributes
    ----------
    parent, child : str
        Names of the axes.
    place : tuple of float
        x, y, z of the child's origin in the parent; m.
    turn : tuple of float
        Quaternion x, y, z, w.
    """

    parent: str
    child: str
    place: tuple[float, float, float]
    turn: tuple[float, float, float, float]


def transforms(told: Iterable[AxesTransform], log_time_ns: int) -> bytes:
    """Return positions and rotations of axes at a time as a ``foxglove.FrameTransforms`` message."""
    out = message_type(TRANSFORMS)()
    for one in told:
        found = out.transforms.add(parent_frame_id=one.parent, child_frame_id=one.child)
        stamp(found, log_time_ns)
        found.translation.x, found.translation.y, found.translation.z = one.place
        _turn(found.rotation, one.turn)
    return out.SerializeToString(deterministic=True)


def turn_of(about: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return heading, pitch and roll of a node in radians. Unknown angles are 0."""
    heading, pitch, roll = (
        math.radians(about.get(angle, 0.0)) for angle in ("heading", "pitch", "roll")
    )
    return heading, pitch, roll


def quaternion(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of the rotations yaw, pitch and roll, given in radians."""
    cy, cp, cr = (math.cos(angle / 2) for angle in (yaw, pitch, roll))
    sy, sp, sr = (math.sin(angle / 2) for angle in (yaw, pitch, roll))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _turn(orientation: Any, turn: tuple[float, float, float, float]) -> None:
    orientation.x, orientation.y, orientation.z, orientation.w = turn


def place_of(about: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Return the position (x, y, z) of a node in metres; ``None`` if it is unknown."""
    if "x" not in about or "y" not in about:
        return None
    return about["x"], about["y"], about.get("z", 0.0)


def _paint(color: Any, colour: Colour) -> None:
    color.r, color.g, color.b, color.a = colour
