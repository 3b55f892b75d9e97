"""Drawing of a frame seen from above: its visible content, and the names in the picture.

The texts in a window are names of nodes, and relations on the lines between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.path import Path as Outline

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.draw._drawn_links import ego_lane, links_of, sentences
from sgstore.draw._ground import (
    STOREY_HEIGHT,
    GroundView,
    paint_compass,
    paint_ground,
    paint_rings,
    paint_scale,
    tint,
)
from sgstore.draw._placement import Placer
from sgstore.draw._symbols import half_extents, halo, paint_body, velocity_arrow
from sgstore.draw._view import SCENERY, bodies_of, caption, clean, number, place_of
from sgstore.model.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.draw._drawn_links import DrawnLink, Family, Relations
    from sgstore.draw._page import Rect, Stage
    from sgstore.draw._view import Body, MapWindow
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph


LABELLED_LINKS: Final = 10
"""Number of the ego's lines that have their relations as text, nearest first. The panel lists the others."""
_LEADER: Final = 9.0
"""Distance between a name and its object above which a line connects them; points."""
_PEN: Final = 4.5
_CLEAR: Final = 15.0
"""Smallest distance between all entities and a line between map parts; m."""


def paint_texts(stage: Stage, scene: DrawnFrame, reserved: Iterable[Rect]) -> int:
    """Write names of nodes and relations into a picture, important ones first. Return how many did not fit.

    Parameters
    ----------
    stage : Stage
    scene : DrawnFrame
    reserved : iterable of Rect
        Space that is already taken.

    Returns
    -------
    int
        Number of names without room.
    """
    placer = Placer(stage.rect(*stage.half, (0.0, 0.0)))
    for rect in (*reserved, *(r for b in scene.bodies.values() for r in _room(stage, b))):
        placer.block(rect)
    for body in scene.bodies.values():
        if body.kind not in SCENERY:
            placer.stand(*_extent(stage, scene, body))
    first = scene.named_first()
    for node in first:
        _paint_name(stage, scene, placer, node)
    for link in scene.links:
        if link.family == "matched":
            _paint_relations(stage, scene, placer, link, sentences(link, scene.matched))
    near = scene.near_first()
    order = {body.node: rank for rank, body in enumerate(near)}
    close = [k for k in scene.links if k.family == "ego" and k.b in order]
    for link in sorted(close, key=lambda k: order[k.b])[:LABELLED_LINKS]:
        _paint_relations(stage, scene, placer, link, [", ".join(link.there[:2])])
    others = [b for b in near if b.node not in first and _is_named(b) and stage.shows(b.x, b.y)]
    return sum(not _paint_name(stage, scene, placer, body.node) for body in others)


def _paint_name(stage: Stage, scene: DrawnFrame, placer: Placer, node: int) -> bool:
    matched = node in scene.matched
    bold = matched or node == scene.graph.ego
    text, size, weight = scene.name(node), 7.5 if bold else 6.3, "bold" if bold else "normal"
    width, height = stage.page.text_size(text, size, weight)
    body = scene.bodies.get(node)
    if body is None:
        x, y = (value * stage.points for value in scene.anchor(node))
        pen = _PEN * matched
        reach = (4.0 + pen, 4.0 + pen)
    else:
        x, y, reach = _extent(stage, scene, body)
    found = placer.named(x, y, reach, (width + 4, height + 3))
    if found is None:
        return False
    spot, clear = found
    anchor = (x, y)
    gaps = [abs(s - a) - r for s, a, r in zip(spot, anchor, reach, strict=True)]
    if not clear or max(gaps[0] - width / 2, gaps[1] - height / 2) > _LEADER:
        leader = np.array((anchor, spot)) * stage.metre
        stage.lines([leader], palette.FAINT_INK, z=layers.ARROWS - 0.1, width=0.5)
    box = _tag() if matched else _slip(0.72)
    look = {"fontsize": size, "weight": weight, "zorder": layers.CAPTIONS + bold, "bbox": box}
    _write(stage, spot, text, gid=f"label-{node}", **look)
    return True


def _paint_relations(
    stage: Stage, scene: DrawnFrame, placer: Placer, link: DrawnLink, lines: list[str]
) -> None:
    ends = scene.ends(link)
    if ends is None or not any(lines):
        return
    size = 6.3 if link.family == "matched" else 5.6
    width = max(stage.page.text_size(line, size)[0] for line in lines)
    height = size * 1.3 * len(lines)
    a, b = ((x * stage.points, y * stage.points) for x, y in ends)
    spot = placer.along(a, b, (width + 3, height + 2))
    if spot is None and link.family == "matched":
        middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
        spot = placer.beside(*middle, (4.0, 4.0), (width + 3, height + 2))
        if spot is not None:
            leader = np.array((middle, spot)) * stage.metre
            stage.lines([leader], palette.FAINT_INK, z=layers.ARROWS - 0.1, width=0.5)
    if spot is None:
        return
    colour = palette.CLOSENESS["near_coll"][0] if link.family == "ego" else palette.MATCH_EDGE
    look = {"fontsize": size, "color": colour, "zorder": layers.LINK_TEXTS, "bbox": _slip(0.85)}
    for row, line in enumerate(lines):
        up = (len(lines) - 1 - 2 * row) * size * 0.65
        _write(stage, (spot[0], spot[1] + up), line, gid=f"link-{link.a}-{link.b}-{row}", **look)


def _write(stage: Stage, spot: tuple[float, float], text: str, **look: Any) -> None:
    x, y = (value * stage.metre for value in spot)
    stage.text(x, y, text, ha="center", va="center_baseline", **look)


def _slip(alpha: float) -> dict[str, Any]:
    """Return the style of a text background that keeps the text readable on any colour."""
    return {
        "boxstyle": "round,pad=0.15",
        "facecolor": palette.PAPER,
        "edgecolor": "none",
        "alpha": alpha,
    }


def _tag() -> dict[str, Any]:
    return {
        "boxstyle": "round,pad=0.22",
        "facecolor": palette.MATCH_PAPER,
        "edgecolor": palette.MATCH_EDGE,
        "linewidth": 0.5,
    }


def _extent(
    stage: Stage, scene: DrawnFrame, body: Body
) -> tuple[float, float, tuple[float, float]]:
    """Return the middle of an entity's symbol in a picture, and half its width and height, in points."""
    half_x, half_y = half_extents(stage, body)
    pen = _PEN * (body.node in scene.matched)
    return body.x * stage.points, body.y * stage.points, (half_x + pen, half_y + pen)


def _is_named(body: Body) -> bool:
    return body.kind not in SCENERY and body.kind not in SIGNALS


def _room(stage: Stage, body: Body) -> list[Rect]:
    """Return rectangles that cover the symbol and the arrow of an entity, so that no text hides them."""
    half_x, half_y = half_extents(stage, body)
    taken = [stage.rect(half_x * stage.metre, half_y * stage.metre, (body.x, body.y))]
    way = velocity_arrow(body)
    if way is not None:
        half = 2.5 * stage.metre
        along = np.linspace(1.0, 0.0, max(2, int(np.hypot(*way) / half)), endpoint=False)
        spots = np.array((body.x, body.y)) + along[:, None] * way
        taken += [stage.rect(half, half, (x, y)) for x, y in spots.tolist()]
    return taken


Point = tuple[float, float]

_SLOPE: Final = 0.1
"""Largest usual slope of roads: height per distance."""

_QUIET: Final[dict[Family, str]] = {
    "entity": palette.ENTITY_EDGE,
    "road": palette.ROAD_EDGE,
    "mixed": palette.MIXED_EDGE,
}


@dataclass(frozen=True, slots=True)
class DrawnFrame:
    """Content of a frame that a picture shows: entities, relations, ground and matched nodes.

    Attributes
    ----------
    graph : SceneGraph
    matched : dict
        Node id → name of its variable, or empty.
    view : MapWindow
    bodies : dict
        Node id → body, for drawable entities.
    lost : int
        Number of entities without a position.
    links : list of DrawnLink
    ground : GroundView or None
    """

    graph: SceneGraph
    matched: dict[int, str]
    view: MapWindow
    bodies: dict[int, Body]
    lost: int
    links: list[DrawnLink]
    ground: GroundView | None

    @classmethod
    def of(
        cls,
        graph: SceneGraph,
        road_map: RoadMap | None,
        matched: dict[int, str],
        view: MapWindow,
        relations: Relations,
    ) -> DrawnFrame:
        """Return the content of a frame that is visible in a window."""
        bodies, lost = bodies_of(graph, view)
        ground = None if road_map is None else GroundView.of(road_map, view)
        bodies = _with_storeys(graph, bodies, ground)
        links = links_of(graph, frozenset(matched), relations)
        return cls(graph, matched, view, {b.node: b for b in bodies}, lost, links, ground)

    def place(self, node: int) -> Point | None:
        """Return the position of a node in the picture; ``None`` if it is unknown."""
        if node in self.bodies:
            return self.bodies[node].x, self.bodies[node].y
        place = place_of(self.graph.nodes.get(node, {}))
        if place is None:
            return None
        ((x, y),) = self.view.place(np.array([place])).tolist()
        return x, y

    def anchor(self, node: int) -> Point:
        """Return the point at which the name of a node is written. For a lane, this point is visible."""
        spot = self.ground.spot(node) if self.ground is not None and node < 0 else None
        return spot or self.place(node) or (0.0, 0.0)

    def ends(self, link: DrawnLink) -> tuple[Point, Point] | None:
        """Return both ends of the line between two nodes; ``None`` if the position of a node is unknown.

        Between an entity and a lane it is the shortest line. Between matched map parts it is away
        from entities, to avoid confusion with their lines.
        """
        apart = self._beside_one_another(link) if link.family == "matched" else None
        if apart is not None:
            return apart
        a, b = self.place(link.a), self.place(link.b)
        if self.ground is not None and b is not None and link.a not in self.bodies:
            a = (self.ground.nearest(link.a, b) if link.b in self.bodies else None) or a
        if self.ground is not None and a is not None and link.b not in self.bodies:
            b = (self.ground.nearest(link.b, a) if link.a in self.bodies else None) or b
        return None if a is None or b is None else (a, b)

    def _beside_one_another(self, link: DrawnLink) -> tuple[Point, Point] | None:
        """Return both ends of a line between two map parts, away from entities; ``None`` if impossible."""
        ground = self.ground
        if ground is None or link.a in self.bodies or link.b in self.bodies:
            return None
        points = ground.middles(link.a)
        points = points[np.abs(points).max(axis=1, initial=0.0) <= 0.8 * self.view.radius]
        if not len(points):
            return None
        bodies = np.array([(b.x, b.y) for b in self.bodies.values() if b.kind not in SCENERY])
        away = points[:, None] - bodies.reshape(-1, 2)
        free = np.hypot(away[..., 0], away[..., 1]).min(axis=1, initial=_CLEAR)
        x, y = points[np.argmin(0.05 * np.hypot(*points.T) - free)].tolist()
        other = ground.nearest(link.b, (x, y))
        # A lane and its road can be at one place.
        return None if other is None or math.dist((x, y), other) < 0.5 else ((x, y), other)

    def name(self, node: int) -> str:
        """Return the name of a node, with the variable of a matched node, such as ``p = person 12``."""
        text = caption(node, self.graph.nodes.get(node, {}))
        if node in self.bodies and self.bodies[node].below:
            text += f", {self.bodies[node].below:.0f} m below"
        variable = clean(self.matched.get(node, ""), 16)
        return f"{variable} = {text}" if variable else text

    def near_first(self) -> list[Body]:
        """Return the entities sorted by distance from the middle of the picture."""
        return sorted(self.bodies.values(), key=lambda b: (math.hypot(b.x, b.y), b.node))

    def named_first(self) -> list[int]:
        """Return the nodes whose names are always written: matched nodes, and the ego."""
        ego = self.graph.ego
        also = [ego] if ego in self.bodies and ego not in self.matched else []
        return [node for node in self.matched if self.is_shown(node)] + also

    def is_shown(self, node: int) -> bool:
        """True if the position of a node is visible in the picture."""
        place = (
            self.ground.spot(node) if self.has_outline(node) and self.ground else self.place(node)
        )
        return place is not None and max(map(abs, place)) <= self.view.radius

    def has_outline(self, node: int) -> bool:
        """True if a node is a map part with a visible outline."""
        return node < 0 and self.ground is not None and bool(self.ground.parts(node))


def _with_storeys(graph: SceneGraph, bodies: list[Body], ground: GroundView | None) -> list[Body]:
    """Return the entities. If a road is drawn above an entity, add the entity's depth below the road; m.

    Without a map the reference is the ego: a body a storey deeper than the ego, beyond a slope.
    """
    nodes = [graph.nodes[body.node] for body in bodies]
    z = np.array([number(node, "z") for node in nodes], np.float64)
    places = np.array([place_of(node) or (0.0, 0.0) for node in nodes]).reshape(-1, 2)
    if ground is not None:
        heights = np.nan_to_num([number(node, "height") for node in nodes])
        above = ground.cover(places, z - heights / 2)
    else:
        ego = graph.nodes.get(graph.ego, {}) if graph.ego is not None else {}
        above = number(ego, "z") - z
        away = np.hypot(*(places - (place_of(ego) or (np.nan, np.nan))).T)
        above[~(above > _SLOPE * away)] = 0.0
    return [
        replace(body, below=float(height)) if height >= STOREY_HEIGHT else body
        for body, height in zip(bodies, above.tolist(), strict=True)
    ]


def paint_scene(stage: Stage, scene: DrawnFrame) -> int:
    """Draw a frame in its window. Return the number of names that did not fit."""
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
    return paint_texts(stage, scene, reserved)


def _paint_map(stage: Stage, scene: DrawnFrame, ground: GroundView) -> None:
    paint_ground(stage, ground)
    lane = ego_lane(scene.graph)
    if lane is not None and lane not in scene.matched:
        tint(stage, ground, lane, palette.EGO_LANE, 0.65)
    for node in scene.matched:
        if node not in scene.bodies:
            tint(stage, ground, node, palette.MATCH, 0.5)


def _paint_link(stage: Stage, scene: DrawnFrame, link: DrawnLink) -> None:
    ends = scene.ends(link)
    if ends is None:
        return
    colour, width, look = _pen(scene, link)
    if link.family == "matched":
        stage.lines(
            [np.array(ends)], palette.MATCH, z=layers.LINKS, width=width + 3.0, capstyle="round"
        )
    stage.lines([np.array(ends)], colour, z=layers.LINKS + 0.1, width=width, **look)


def _pen(scene: DrawnFrame, link: DrawnLink) -> tuple[str, float, dict[str, Any]]:
    """Return the colour, the width in points and other attributes of a line between two nodes."""
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


def _paint_halo(stage: Stage, scene: DrawnFrame, node: int) -> None:
    """Draw a yellow mark around a matched node. Map parts with an outline are coloured instead."""
    place = scene.place(node)
    if place is None or (node not in scene.bodies and scene.has_outline(node)):
        return
    shape, width = halo(stage, scene.bodies.get(node), place)
    path = Outline(shape, closed=True)
    edge = {"joinstyle": "round", "edgecolor": palette.MATCH_EDGE, "linewidth": width + 1.4}
    stage.fill(path, "none", z=layers.HALOS, gid=None, **edge)
    pen = edge | {"edgecolor": palette.MATCH, "linewidth": width}
    stage.fill(path, "none", z=layers.HALOS + 0.1, gid=f"halo-{node}", **pen)
