"""Geometry of a frame seen from above: map coordinates → picture coordinates, and boxes of entities.

Picture axes are metres from the middle of the picture, x to the right and y up. The ego is in the
middle with its heading up, unless north is up. The functions are pure and need no drawing package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from sgstore.model.pair_numbers import gap
from sgstore.model.vocabulary import ENTITY_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.model.graph import SceneGraph
    from sgstore.model.world import Floats


SCENERY: Final = frozenset({"building", "pole", "barrier", "vegetation", "prop"})
"""Kinds of scenery, drawn faintly and without names."""

SMALLEST_RADIUS: Final = 30.0
GREATEST_RADIUS: Final = 60.0
SIGHT: Final = 150.0
ARROW_SECONDS: Final = 1.0
"""Time for the length of a velocity arrow: the entity moves by this length in this time; s."""

TEXT_LENGTH: Final = 48
"""Largest length of a text from a trace; characters. The rest is cut."""


@dataclass(frozen=True, slots=True)
class MapWindow:
    """Square part of the road map that a picture shows: centre, rotation and radius.

    Attributes
    ----------
    x, y : float
        Its middle, in map axes; m.
    up : float
        Map direction that points up in the picture; rad.
    radius : float
        Half its side; m.
    """

    x: float
    y: float
    up: float
    radius: float

    def place(self, points: Floats) -> Floats:
        """Convert map coordinates (N, 2) to picture coordinates (N, 2).

        >>> MapWindow(10.0, 0.0, 0.0, 50.0).place(np.array([[13.0, 1.0]]))  # 3 m ahead, 1 m to the left
        array([[-1.,  3.]])
        """
        forward = np.array((math.cos(self.up), math.sin(self.up)))
        right = np.array((forward[1], -forward[0]))
        away = np.asarray(points, dtype=np.float64).reshape(-1, 2) - (self.x, self.y)
        return np.column_stack((away @ right, away @ forward))

    def angle(self, heading: float) -> float:
        """Convert a map heading to an angle in the picture, in radians counter-clockwise from the right."""
        return heading - self.up + math.pi / 2


@dataclass(frozen=True, slots=True)
class Body:
    """Entity to draw: position, size, heading and speed in picture coordinates. NaN means unknown.

    Attributes
    ----------
    node : int
        Node id.
    kind, caption, light : str
        Its kind, its label, and its state if it is a traffic light.
    is_ego : bool
    x, y, angle, length, width : float
        Its box; ``angle`` counter-clockwise from the picture's right.
    vx, vy : float
        Velocity; m/s.
    below : float
        Depth below the road that is drawn over it; m, 0 without such a road.
    """

    node: int
    kind: str
    caption: str
    light: str
    is_ego: bool
    x: float
    y: float
    angle: float
    length: float
    width: float
    vx: float
    vy: float
    below: float = 0.0


def clean(text: object, length: int = TEXT_LENGTH) -> str:
    r"""Return a text of a recording as one line of printable characters with a limited length.

    >>> clean("a\nb\x00c")
    'a·b·c'
    >>> clean("abcdef", 4)
    'abc…'
    """
    shown = "".join(c if c.isprintable() else "·" for c in str(text)[: length + 1])
    return shown if len(shown) <= length else shown[: length - 1] + "…"


CALLED: Final = "called"
"""Name of the node attribute with the label, in a graph to be drawn."""

Names = Literal["number", "ident", "type"]
"""Choice of labels of entities in pictures: ``car 17``, the simulator's id, or the simulator's type name."""


def called(graph: SceneGraph, names: Names) -> SceneGraph:
    """Return a scene graph in which entities are labelled by number, by recorded id or by type."""
    if names == "number":
        return graph
    key = {"ident": "ident", "type": "type_name"}[names]
    nodes = {
        node: {CALLED: f"{about[key]}{_lifetime(about, names)}", **about}
        if about.get(key)
        else about
        for node, about in graph.nodes.items()
    }
    return replace(graph, nodes=nodes)


def _lifetime(about: Mapping[str, Any], names: Names) -> str:
    """Return a suffix such as ``#2`` that distinguishes entities with the same recorded id."""
    return f"#{about['lifetime']}" if names == "ident" and about.get("lifetime", 1) > 1 else ""


def caption(node: int, attributes: Mapping[str, Any]) -> str:
    """Return the caption of a node, such as ``car 17``, ``lane 12/0/-1`` or ``ego (car 0)``."""
    told = clean(attributes.get(CALLED, ""), 32)
    if told:
        return f"ego ({told})" if attributes.get("is_ego") and told != "ego" else told
    kind = clean(attributes.get("kind", "node"), 16)
    name = clean(attributes.get("name", ""), 24)
    if node < 0 and name == kind:
        return kind
    if node < 0 and name:
        return f"{kind} {name}"
    return f"ego ({kind} {node})" if attributes.get("is_ego") else f"{kind} {node}"


def number(attributes: Mapping[str, Any], name: str) -> float:
    """Return a numeric attribute of a node; NaN if it is missing or infinite."""
    value = attributes.get(name)
    if not isinstance(value, Real) or not math.isfinite(value):
        return math.nan
    return float(value)


def place_of(attributes: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the map coordinates (x, y) of a node; ``None`` if they are unknown."""
    x, y = number(attributes, "x"), number(attributes, "y")
    return None if math.isnan(x + y) else (x, y)


def view_of(
    graph: SceneGraph,
    radius: float | None,
    matched: Iterable[int] = (),
    *,
    north_up: bool = False,
) -> MapWindow:
    """Return the visible part of the map for a frame: the ego is in the middle and faces up.

    Without an ego or its position, the middle is that of the entities (else of the map parts) and
    north is up. Without a radius it is the smallest one that shows the entities, within
    :data:`SMALLEST_RADIUS` and :data:`GREATEST_RADIUS`; for matched nodes up to :data:`SIGHT`.
    """
    ego = graph.nodes.get(graph.ego, {}) if graph.ego is not None else {}
    middle = place_of(ego)
    heading = number(ego, "heading")
    up = math.pi / 2 if north_up or middle is None or math.isnan(heading) else math.radians(heading)
    places = _places(graph, entities=True)
    if not len(places):
        places = _places(graph, entities=False)
    x, y = middle or (tuple(np.median(places, axis=0)) if len(places) else (0.0, 0.0))
    if radius is None:
        upright = MapWindow(float(x), float(y), up, 1.0)
        found = [place_of(graph.nodes.get(node, {})) for node in matched if node >= 0]
        sought = np.array([place for place in found if place is not None])
        reach = np.abs(upright.place(places)).max(initial=0.0) + 4.0
        needed = 1.1 * np.abs(upright.place(sought)).max(initial=0.0)
        reach = max(min(reach, GREATEST_RADIUS), min(needed, SIGHT))
        radius = max(float(reach), SMALLEST_RADIUS)
    return MapWindow(float(x), float(y), up, radius)


def bodies_of(graph: SceneGraph, view: MapWindow) -> tuple[list[Body], int]:
    """Return the entities to draw, and the number of entities without a position.

    Scenery of the map is part of the ground, but its signals are entities.
    """
    bodies: list[Body] = []
    lost = 0
    for node, attributes in graph.nodes.items():
        kind = attributes.get("kind")
        if kind not in ENTITY_KINDS or (node < 0 and kind not in SIGNALS):
            continue
        place = place_of(attributes)
        if place is None:
            lost += 1
        else:
            bodies.append(_body(node, attributes, place, view))
    return bodies, lost


def outline(body: Body, smallest: float) -> Floats:
    """Return the closed outline (5, 2) of an entity's box in picture coordinates, from the front left.

    Parameters
    ----------
    body : Body
        A missing or absurd extent becomes a point; a missing angle becomes up.
    smallest : float
        Least width; the least length is 1.5 times as much. Smaller boxes would be invisible; m.
    """
    greatest = 60.0 * smallest + 100.0
    half_l = min(max(_or(body.length, 0.0), 1.5 * smallest), greatest) / 2
    half_w = min(max(_or(body.width, 0.0), smallest), greatest) / 2
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)]) * (half_l, half_w)
    return turned(corners, body)


def turned(points: Floats, body: Body) -> Floats:
    """Convert points in the axes of an entity (forward, left) to picture coordinates (N, 2)."""
    angle = _or(body.angle, math.pi / 2)
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array(((cos, sin), (-sin, cos))) + (body.x, body.y)


def distance(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the distance between the centres of two nodes in metres, in 3D if both heights are known.

    NaN means an unknown position.
    """
    dz = number(a, "z") - number(b, "z")
    return math.hypot(
        number(a, "x") - number(b, "x"), number(a, "y") - number(b, "y"), _or(dz, 0.0)
    )


def gap_of(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Return the gap between the footprints of two nodes in metres: 0 if they touch, NaN if unknown."""
    footprint = ("x", "y", "heading", "length", "width")
    boxes = [np.array([[number(one, name) for name in footprint]]) for one in (a, b)]
    for box in boxes:
        box[:, 2] = np.radians(box[:, 2])
    return float(gap(*boxes)[0])


def _body(
    node: int, attributes: Mapping[str, Any], place: tuple[float, float], view: MapWindow
) -> Body:
    heading = math.radians(number(attributes, "heading"))
    ((x, y),) = view.place(np.array([place])).tolist()
    vx, vy = number(attributes, "vx"), number(attributes, "vy")
    if math.isnan(vx + vy):
        speed = number(attributes, "speed")
        vx, vy = speed * math.cos(heading), speed * math.sin(heading)
    ((right, up),) = view.place(np.array([(view.x + vx, view.y + vy)])).tolist()
    return Body(
        node=node,
        kind=str(attributes["kind"]),
        caption=caption(node, attributes),
        light=str(attributes.get("light_state", "unknown")),
        is_ego=bool(attributes.get("is_ego")),
        x=x,
        y=y,
        angle=view.angle(heading),
        length=number(attributes, "length"),
        width=number(attributes, "width"),
        vx=right,
        vy=up,
    )


def _places(graph: SceneGraph, *, entities: bool) -> Floats:
    chosen: Iterable[Mapping[str, Any]] = (
        a for a in graph.nodes.values() if (a.get("kind") in ENTITY_KINDS) == entities
    )
    found = [place for a in chosen if (place := place_of(a)) is not None]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _or(value: float, other: float) -> float:
    return other if math.isnan(value) else value
