"""A frame seen from above, before anything is drawn: places, boxes and links in picture axes.

Picture axes are metres from the middle of the picture, x to the right and y up. The ego stands in the
middle and heads upwards, unless north is wanted up. Pure functions; no drawing package is met here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.vocabulary import ENTITY_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.graph import SceneGraph
    from sgstore.world import Floats


SCENERY: Final = frozenset({"building", "pole", "barrier", "vegetation", "prop"})
"""Kinds that are drawn quietly and are not named: what stands about."""

SMALLEST_RADIUS: Final = 30.0
GREATEST_RADIUS: Final = 60.0
SIGHT: Final = 150.0
ARROW_SECONDS: Final = 1.0
"""A velocity is drawn as the way that it makes in this time; s."""

TEXT_LENGTH: Final = 48
"""Longest text, in characters, that is taken over from a trace; the rest is cut."""


@dataclass(frozen=True, slots=True)
class MapWindow:
    """A square window on the map.

    Attributes
    ----------
    x, y : float
        Its middle, in map axes; m.
    up : float
        The direction of the map that points up in the picture; rad.
    radius : float
        Half its side; m.
    """

    x: float
    y: float
    up: float
    radius: float

    def place(self, points: Floats) -> Floats:
        """(N, 2) picture coordinates of (N, 2) points of the map.

        >>> MapWindow(10.0, 0.0, 0.0, 50.0).place(np.array([[13.0, 1.0]]))  # 3 m ahead, 1 m to the left
        array([[-1.,  3.]])
        """
        forward = np.array((math.cos(self.up), math.sin(self.up)))
        right = np.array((forward[1], -forward[0]))
        away = np.asarray(points, dtype=np.float64).reshape(-1, 2) - (self.x, self.y)
        return np.column_stack((away @ right, away @ forward))

    def angle(self, heading: float) -> float:
        """Direction in the picture, counter-clockwise from its right, of a heading of the map; rad."""
        return heading - self.up + math.pi / 2


@dataclass(frozen=True, slots=True)
class Body:
    """An entity as it is drawn: picture axes, metres and radians; NaN where the graph does not say.

    Attributes
    ----------
    node : int
        Node id.
    kind, caption, light : str
        Its kind, what is written beside it, and what it shows if it is a traffic light.
    is_ego : bool
    x, y, angle, length, width : float
        Its box; ``angle`` counter-clockwise from the picture's right.
    vx, vy : float
        Velocity; m/s.
    below : float
        How far it lies below the road that is drawn over it; m, 0 if there is none.
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
    r"""A text from a trace as it can be shown: one line, nothing that cannot be printed, not too long.

    >>> clean("a\nb\x00c")
    'a·b·c'
    >>> clean("abcdef", 4)
    'abc…'
    """
    shown = "".join(c if c.isprintable() else "·" for c in str(text)[: length + 1])
    return shown if len(shown) <= length else shown[: length - 1] + "…"


def counted(number: int, thing: str) -> str:
    """A number of things, in words.

    >>> counted(1, "lane"), counted(2000, "lane"), counted(2, "vegetation")
    ('1 lane', '2,000 lanes', '2 vegetation')
    """
    return f"{number:,} {thing}{'' if number == 1 or thing == 'vegetation' else 's'}"


def caption(node: int, attributes: Mapping[str, Any]) -> str:
    """Name of a node in a picture: ``car 17``, ``lane 12/0/-1``, ``ego (car 0)``."""
    kind = clean(attributes.get("kind", "node"), 16)
    name = clean(attributes.get("name", ""), 24)
    if node < 0 and name == kind:
        return kind
    if node < 0 and name:
        return f"{kind} {name}"
    return f"ego ({kind} {node})" if attributes.get("is_ego") else f"{kind} {node}"


def number(attributes: Mapping[str, Any], name: str) -> float:
    """A number of a node; NaN where it is missing, infinite or no number."""
    value = attributes.get(name)
    if not isinstance(value, Real) or not math.isfinite(value):
        return math.nan
    return float(value)


def place_of(attributes: Mapping[str, Any]) -> tuple[float, float] | None:
    """Map coordinates of a node, or ``None``."""
    x, y = number(attributes, "x"), number(attributes, "y")
    return None if math.isnan(x + y) else (x, y)


def view_of(
    graph: SceneGraph,
    radius: float | None,
    matched: Iterable[int] = (),
    *,
    north_up: bool = False,
) -> MapWindow:
    """The view of a frame: the ego in the middle, heading up.

    Without an ego, or where its place is not known, the middle is that of the entities (else of the
    parts of the map) and north is up. Without a radius it is the smallest that shows the entities,
    but within :data:`SMALLEST_RADIUS` and :data:`GREATEST_RADIUS`; for the matched up to :data:`SIGHT`.
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
    """The entities that can be drawn, and how many cannot because the graph has no place for them.

    What stands about in the map is part of the ground, not an entity here; its signals are.
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
    """(5, 2) corners of a body's box from its front left on, closed; picture axes, m.

    Parameters
    ----------
    body : Body
        A missing or absurd extent is that of a point; a missing angle is up.
    smallest : float
        Least width; the least length is half as much again. What is smaller would not be seen; m.
    """
    greatest = 60.0 * smallest + 100.0
    half_l = min(max(_or(body.length, 0.0), 1.5 * smallest), greatest) / 2
    half_w = min(max(_or(body.width, 0.0), smallest), greatest) / 2
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)]) * (half_l, half_w)
    return turned(corners, body)


def turned(points: Floats, body: Body) -> Floats:
    """(N, 2) picture coordinates of points in a body's own axes (forward, left)."""
    angle = _or(body.angle, math.pi / 2)
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array(((cos, sin), (-sin, cos))) + (body.x, body.y)


def distance(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    """Distance between the centres of two nodes, in space where both heights are known; m, or NaN."""
    dz = number(a, "z") - number(b, "z")
    return math.hypot(
        number(a, "x") - number(b, "x"), number(a, "y") - number(b, "y"), _or(dz, 0.0)
    )


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
