"""A frame with what of it is shown, and how it is drawn in a window."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.path import Path as Outline

from sgstore.draw import layers, palette
from sgstore.draw.bodies import halo, paint_body
from sgstore.draw.captions import paint_texts
from sgstore.draw.furniture import paint_compass, paint_rings, paint_scale
from sgstore.draw.ground import Ground, paint_ground, tint
from sgstore.draw.links import ego_lane, links_of
from sgstore.draw.view import bodies_of, caption, clean, place_of

if TYPE_CHECKING:
    from sgstore.draw.links import Family, Link, Relations
    from sgstore.draw.page import Stage
    from sgstore.draw.view import Body, View
    from sgstore.graph import SceneGraph
    from sgstore.roads import RoadMap

Point = tuple[float, float]

_QUIET: Final[dict[Family, str]] = {
    "entity": palette.ENTITY_EDGE,
    "road": palette.ROAD_EDGE,
    "mixed": palette.MIXED_EDGE,
}


@dataclass(frozen=True, slots=True)
class Scene:
    """A frame, ready to be drawn.

    Attributes
    ----------
    graph : SceneGraph
    matched : dict
        Node id → name of the variable that it is bound to, or the empty string.
    view : View
    bodies : dict
        Node id → body, for what can be drawn.
    lost : int
        Entities that the graph has no place for.
    links : list of Link
    ground : Ground or None
    """

    graph: SceneGraph
    matched: dict[int, str]
    view: View
    bodies: dict[int, Body]
    lost: int
    links: list[Link]
    ground: Ground | None

    @classmethod
    def of(
        cls,
        graph: SceneGraph,
        road_map: RoadMap | None,
        matched: dict[int, str],
        view: View,
        relations: Relations,
    ) -> Scene:
        """Choose what of a frame is shown in a view."""
        bodies, lost = bodies_of(graph, view)
        ground = None if road_map is None else Ground.of(road_map, view)
        links = links_of(graph, frozenset(matched), relations)
        return cls(graph, matched, view, {b.node: b for b in bodies}, lost, links, ground)

    def place(self, node: int) -> Point | None:
        """Where a node is in the picture, or ``None`` where the graph has no place for it."""
        if node in self.bodies:
            return self.bodies[node].x, self.bodies[node].y
        place = place_of(self.graph.nodes.get(node, {}))
        if place is None:
            return None
        ((x, y),) = self.view.place(np.array([place])).tolist()
        return x, y

    def anchor(self, node: int) -> Point:
        """Where a node's name belongs. A lane's: what of it is in sight and near."""
        spot = self.ground.spot(node) if self.ground is not None and node < 0 else None
        return spot or self.place(node) or (0.0, 0.0)

    def ends(self, link: Link) -> tuple[Point, Point] | None:
        """Where a link begins and ends, or ``None`` where one of its nodes has no place.

        Between an entity and a lane it is the shortest way.
        """
        a, b = self.place(link.a), self.place(link.b)
        if self.ground is not None and b is not None and link.a not in self.bodies:
            a = (self.ground.nearest(link.a, b) if link.b in self.bodies else None) or a
        if self.ground is not None and a is not None and link.b not in self.bodies:
            b = (self.ground.nearest(link.b, a) if link.a in self.bodies else None) or b
        return None if a is None or b is None else (a, b)

    def name(self, node: int) -> str:
        """What a node is called, with its variable where it was matched: ``p = person 12``."""
        text = caption(node, self.graph.nodes.get(node, {}))
        variable = clean(self.matched.get(node, ""), 16)
        return f"{variable} = {text}" if variable else text

    def near_first(self) -> list[Body]:
        """The bodies, those nearest to the middle first."""
        return sorted(self.bodies.values(), key=lambda b: (math.hypot(b.x, b.y), b.node))

    def named_first(self) -> list[int]:
        """What is named whatever else is: the matched nodes, and the ego."""
        ego = self.graph.ego
        also = [ego] if ego in self.bodies and ego not in self.matched else []
        return [node for node in self.matched if self.is_shown(node)] + also

    def is_shown(self, node: int) -> bool:
        """Whether a node can be pointed at in the picture."""
        place = (
            self.ground.spot(node) if self.has_outline(node) and self.ground else self.place(node)
        )
        return place is not None and max(map(abs, place)) <= self.view.radius

    def has_outline(self, node: int) -> bool:
        """Whether a node is a part of the map that has an outline in view."""
        return node < 0 and self.ground is not None and bool(self.ground.parts(node))


def paint_scene(stage: Stage, scene: Scene, *, every_name: bool = True) -> int:
    """Draw a frame in its window; returns the number of names that found no room.

    Without ``every_name`` only the ego and what was matched are named.
    """
    if scene.ground is not None:
        _paint_map(stage, scene, scene.ground)
    rings = paint_rings(stage) if scene.graph.ego in scene.bodies else []
    for link in scene.links:
        _paint_link(stage, scene, link)
    for node in scene.matched:
        _paint_halo(stage, scene, node)
    for body in scene.near_first():
        paint_body(stage, body)
    reserved = (*rings, paint_scale(stage), paint_compass(stage))
    return paint_texts(stage, scene, reserved, every=every_name)


def _paint_map(stage: Stage, scene: Scene, ground: Ground) -> None:
    paint_ground(stage, ground)
    lane = ego_lane(scene.graph)
    if lane is not None and lane not in scene.matched:
        tint(stage, ground, lane, palette.EGO_LANE, 0.65)
    for node in scene.matched:
        if node not in scene.bodies:
            tint(stage, ground, node, palette.MATCH, 0.5)


def _paint_link(stage: Stage, scene: Scene, link: Link) -> None:
    ends = scene.ends(link)
    if ends is None:
        return
    colour, width, look = _pen(scene, link)
    if link.family == "matched":
        stage.lines(
            [np.array(ends)], palette.MATCH, z=layers.LINKS, width=width + 3.0, capstyle="round"
        )
    stage.lines([np.array(ends)], colour, z=layers.LINKS + 0.1, width=width, **look)


def _pen(scene: Scene, link: Link) -> tuple[str, float, dict[str, Any]]:
    """Colour, width in points, and what else of its look."""
    if link.family in _QUIET:
        return _QUIET[link.family], 0.5, {"alpha": 0.45}
    if "controlsTrafficOf" in link.there + link.back:
        lights = [scene.graph.nodes[node].get("light_state") for node in (link.a, link.b)]
        known = [palette.LIGHT_EDGES[str(s)] for s in lights if str(s) in palette.LIGHT_EDGES]
        return (known or [palette.FAINT_INK])[0], 1.1, {"linestyle": (0, (4, 2))}
    if link.closeness is None:
        return (palette.MATCH_EDGE if link.family == "matched" else palette.FAR_EDGE), 0.9, {}
    colour, width = palette.CLOSENESS[link.closeness]
    return colour, width, {}


def _paint_halo(stage: Stage, scene: Scene, node: int) -> None:
    """A mark as of a yellow pen; what has an outline on the ground is tinted instead."""
    place = scene.place(node)
    if place is None or (node not in scene.bodies and scene.has_outline(node)):
        return
    shape, width = halo(stage, scene.bodies.get(node), place)
    path = Outline(shape, closed=True)
    edge = {"joinstyle": "round", "edgecolor": palette.MATCH_EDGE, "linewidth": width + 1.4}
    stage.fill(path, "none", z=layers.HALOS, gid=None, **edge)
    pen = edge | {"edgecolor": palette.MATCH, "linewidth": width}
    stage.fill(path, "none", z=layers.HALOS + 0.1, gid=f"halo-{node}", **pen)
