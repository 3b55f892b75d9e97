"""Scene graphs → ``foxglove.SceneUpdate``: what Foxglove, Lichtblick and Rerun draw in their views of space.

Entities are boxes with their names, parts of the map are dots, edges are lines from centre to centre, those of
one relation one thing to be drawn, so that a viewer can show and hide them. Each message takes the place of
the one before it. Places are those of the scene graph: metres, in the axes of the road map.

Source: foxglove-sdk, schemas ``SceneUpdate``, ``SceneEntity`` and what they are made of.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from sgstore.exporters import foxglove
from sgstore.vocabulary import DIRECTIONS, PROXIMITY

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    from sgstore.graph import SceneGraph

NAME: Final = "foxglove.SceneUpdate"
AXES: Final = "map"
"""What the axes of all scene graphs are called: as CARLA's bridge and most ROS systems call the world."""

_TYPES: Final = {
    "Vector3": "x=1:double y=2:double z=3:double",
    "Quaternion": "x=1:double y=2:double z=3:double w=4:double",
    "Point3": "x=1:double y=2:double z=3:double",
    "Pose": "position=1:Vector3 orientation=2:Quaternion",
    "Color": "r=1:double g=2:double b=3:double a=4:double",
    "KeyValuePair": "key=1:string value=2:string",
    "ArrowPrimitive": "pose=1:Pose shaft_length=2:double shaft_diameter=3:double head_length=4:double"
    " head_diameter=5:double color=6:Color",
    "CubePrimitive": "pose=1:Pose size=2:Vector3 color=3:Color",
    "SpherePrimitive": "pose=1:Pose size=2:Vector3 color=3:Color",
    "CylinderPrimitive": "pose=1:Pose size=2:Vector3 bottom_scale=3:double top_scale=4:double color=5:Color",
    "LinePrimitive": "type=1:LinePrimitive.Type pose=2:Pose thickness=3:double scale_invariant=4:bool"
    " points=5:Point3* color=6:Color colors=7:Color* indices=8:fixed32*",
    "TriangleListPrimitive": "pose=1:Pose points=2:Point3* color=3:Color colors=4:Color* indices=5:fixed32*",
    "TextPrimitive": "pose=1:Pose billboard=2:bool font_size=3:double scale_invariant=4:bool color=5:Color"
    " text=6:string",
    "ModelPrimitive": "pose=1:Pose scale=2:Vector3 color=3:Color override_color=4:bool url=5:string"
    " media_type=6:string data=7:bytes",
    "SceneEntityDeletion": "timestamp=1:Timestamp type=2:SceneEntityDeletion.Type id=3:string",
    "SceneEntity": "timestamp=1:Timestamp frame_id=2:string id=3:string lifetime=4:Duration"
    " frame_locked=5:bool metadata=6:KeyValuePair* arrows=7:ArrowPrimitive* cubes=8:CubePrimitive*"
    " spheres=9:SpherePrimitive* cylinders=10:CylinderPrimitive* lines=11:LinePrimitive*"
    " triangles=12:TriangleListPrimitive* texts=13:TextPrimitive* models=14:ModelPrimitive*",
    "SceneUpdate": "deletions=1:SceneEntityDeletion* entities=2:SceneEntity*",
}
_ENUMS: Final = {
    "LinePrimitive.Type": "LINE_STRIP LINE_LOOP LINE_LIST",
    "SceneEntityDeletion.Type": "MATCHING_ID ALL",
}
_ALL, _LINE_LIST = 1, 2

Colour = tuple[float, float, float, float]

EGO_COLOUR: Final[Colour] = (0.1, 0.45, 0.95, 0.9)
COLOURS: Final[dict[str, Colour]] = {
    **dict.fromkeys(("person", "animal"), (0.95, 0.45, 0.1, 0.9)),
    **dict.fromkeys(("bicycle", "motorcycle"), (0.95, 0.75, 0.1, 0.9)),
    **dict.fromkeys(("car", "truck", "van", "bus", "trailer", "train"), (0.45, 0.5, 0.55, 0.9)),
    **dict.fromkeys(("lane", "road", "junction", "crosswalk"), (0.6, 0.6, 0.6, 0.6)),
}
LIGHTS: Final[dict[str, Colour]] = {
    "red": (0.9, 0.1, 0.1, 1.0),
    "yellow": (0.95, 0.8, 0.1, 1.0),
    "red_yellow": (0.95, 0.5, 0.1, 1.0),
    "green": (0.1, 0.7, 0.2, 1.0),
}
OTHERS: Final[Colour] = (0.7, 0.7, 0.65, 0.5)
RELATION_COLOURS: Final[dict[str, Colour]] = {
    **dict.fromkeys(DIRECTIONS, (0.3, 0.5, 0.9, 0.35)),
    **{name: (0.9, 0.15 + 0.13 * i, 0.1, 0.9 - 0.12 * i) for i, name in enumerate(PROXIMITY)},
    **dict.fromkeys(("toLeftOf", "toRightOf"), (0.5, 0.4, 0.8, 0.35)),
    **dict.fromkeys(("leads", "follows"), (0.1, 0.65, 0.6, 0.9)),
    **dict.fromkeys(("controlsTrafficOf", "mayAffect"), (0.8, 0.2, 0.6, 0.8)),
    "overlaps": (1.0, 0.0, 0.0, 1.0),
    "sees": (0.2, 0.7, 0.2, 0.4),
}
OTHER_RELATIONS: Final[Colour] = (0.55, 0.55, 0.55, 0.5)

DOT: Final = 0.5
"""Diameter of what has no size; m."""
LINE: Final = 2.0
"""Width of edges; pixels."""
TEXT: Final = 12.0
"""Size of names; pixels."""


def schema() -> bytes:
    """The descriptors of the message, as an MCAP file carries them."""
    return _files().SerializeToString()


@cache
def _files() -> FileDescriptorSet:
    return foxglove.descriptors(_TYPES, _ENUMS)


@cache
def _scene_update() -> type[Any]:
    return foxglove.class_of(_files(), "SceneUpdate")


def message(graph: SceneGraph, log_time_ns: int) -> bytes:
    """A scene graph as a message; a node without a place is not drawn, nor are its edges."""
    update = _scene_update()()
    gone = update.deletions.add(type=_ALL)
    foxglove.stamp(gone, log_time_ns)
    places = {node: _place(about) for node, about in graph.nodes.items()}
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
    foxglove.stamp(entity, log_time_ns)
    return entity


def _add_node(
    entity: Any, node: int, about: dict[str, Any], place: tuple[float, float, float]
) -> None:
    entity.metadata.add(key="node_id", value=str(node))
    for key in ("kind", "special", "speed", "light_state"):
        if key in about:
            entity.metadata.add(key=key, value=str(about[key]))
    solid = node >= 0 and all(about.get(side) for side in ("length", "width", "height"))
    body = entity.cubes.add() if solid else entity.spheres.add()
    body.pose.position.x, body.pose.position.y, body.pose.position.z = place
    half = math.radians(about.get("heading", 0.0)) / 2
    body.pose.orientation.z, body.pose.orientation.w = math.sin(half), math.cos(half)
    size = (about["length"], about["width"], about["height"]) if solid else (DOT, DOT, DOT)
    body.size.x, body.size.y, body.size.z = size
    colour = LIGHTS.get(about.get("light_state", ""), COLOURS.get(about["kind"], OTHERS))
    _paint(body.color, EGO_COLOUR if about.get("is_ego") else colour)
    if node >= 0 and not about.get("is_static"):
        name = entity.texts.add(
            text=about["name"], billboard=True, font_size=TEXT, scale_invariant=True
        )
        name.pose.position.x, name.pose.position.y = place[:2]
        name.pose.position.z = place[2] + about.get("height", 0.0) / 2 + DOT
        name.pose.orientation.w = 1.0
        _paint(name.color, (1.0, 1.0, 1.0, 1.0))


def _place(about: dict[str, Any]) -> tuple[float, float, float] | None:
    if "x" not in about or "y" not in about:
        return None
    return about["x"], about["y"], about.get("z", 0.0)


def _paint(color: Any, colour: Colour) -> None:
    color.r, color.g, color.b, color.a = colour
