"""A scene graph as nodes and edges, beside the view from above, in the colours of the paper's figures.

Above: entities, where the ego sees them. Below: the lanes that they are in, from left to right as the ego sees
them, then roads, then junctions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.patches import FancyArrowPatch, Rectangle

from sgstore.draw import palette
from sgstore.draw.excerpt import Excerpt, excerpt_of
from sgstore.draw.labels import Placer
from sgstore.draw.layout import ROW, rows, scattered
from sgstore.draw.legend import Entry
from sgstore.draw.view import clean, counted
from sgstore.vocabulary import PROXIMITY

if TYPE_CHECKING:
    from sgstore.draw.excerpt import Line, Tier
    from sgstore.draw.labels import Rect
    from sgstore.draw.links import Relations
    from sgstore.draw.page import Page
    from sgstore.draw.scene import Point, Scene
    from sgstore.world import Floats

_SIZE: Final = 6.6
_PAD: Final = (9.0, 6.0)
"""Room that a node has around its text, in all; points."""
_WORDS: Final = 5.4
_ARCS: Final = 46.0
"""Height of the arcs between lanes."""
_GAP: Final = 16.0
_LINES, _SLIPS, _NODES = 2.0, 3.0, 4.0
_QUIET: Final[dict[str, tuple[str, float, dict[str, Any]]]] = {
    "entity": (palette.ENTITY_EDGE, 0.5, {"alpha": 0.35}),
    "isIn": (palette.DIAGRAM_TINTS["lane"], 0.8, {"alpha": 0.75}),
    "map": (palette.DIAGRAM_TINTS["lane"], 0.7, {}),
    "part": (palette.DIAGRAM_TINTS["road"], 0.7, {"alpha": 0.8}),
}
_RANK: Final = {name: rank for rank, name in enumerate(PROXIMITY)}


def paint_diagram(page: Page, box: Rect, scene: Scene, relations: Relations) -> str:
    """Draw a scene's graph in a window of a page; returns what of it is shown, in words.

    Parameters
    ----------
    page : Page
    box : Rect
        Left, bottom, right and top of the window; points.
    scene : Scene
    relations : {"ego", "all", "none"}
        Which edges among entities are shown.
    """
    left, bottom, right, top = box
    ground = Rectangle(
        (left, bottom), right - left, top - bottom, facecolor=palette.GROUND, linewidth=0
    )
    page.sheet.add_artist(ground)
    excerpt = excerpt_of(scene.graph, frozenset(scene.matched), relations)
    diagram = _Diagram(page, box, scene, excerpt)
    diagram.paint()
    graph, shown = scene.graph, excerpt.edges()
    told = [
        f"shown: {len(excerpt.nodes)} of {counted(len(graph.nodes), 'node')},",
        f"{shown} of {counted(len(graph.edges), 'edge')}",
    ]
    return " ".join(told)


def diagram_entries() -> list[Entry]:
    """Entries of the legend for what occurs in diagrams only."""
    lane, road = palette.DIAGRAM_TINTS["lane"], palette.DIAGRAM_TINTS["road"]
    return [
        Entry("area", "lane, crosswalk", lane),
        Entry("area", "road, junction", road),
        Entry("arrow", "isIn", lane, 0.8),
    ]


class _Diagram:
    """A window with its nodes in their places."""

    def __init__(self, page: Page, box: Rect, scene: Scene, excerpt: Excerpt) -> None:
        self._page = page
        self._scene = scene
        self._lines = excerpt.lines
        self._texts = {node: self._text(node) for node in excerpt.nodes}
        self._sizes = {
            node: np.add(page.text_size(text, _SIZE, "bold"), _PAD)
            for node, text in self._texts.items()
        }
        self._box = box
        self._spots = self._placed(excerpt.nodes)
        self._placer = Placer(box)
        for node in excerpt.nodes:
            left, bottom, right, top = self._rect(node)
            self._placer.block((left - 2, bottom - 2, right + 2, top + 2))

    def paint(self) -> None:
        for line in self._lines:
            self._paint_line(line)
        # What matters most is written first.
        for line in reversed(self._lines):
            self._paint_words(line)
        for node in self._texts:
            self._paint_node(node)

    # Places ---------------------------------------------------------------------------------------

    def _placed(self, tiers: dict[int, Tier]) -> dict[int, Point]:
        """Places from the bottom up: junctions, roads, lanes with their arcs, and entities in the rest."""
        left, bottom, right, top = self._box
        floor = bottom + 6
        spots: dict[int, Point] = {}
        for tier in ("junction", "road", "lane"):
            nodes = [node for node, of in tiers.items() if of == tier]
            if not nodes:
                continue
            if tier == "lane" and any(line.family == "map" for line in self._lines):
                floor += _ARCS - _GAP
            widths = np.array([self._sizes[node][0] for node in nodes])
            order = np.array([self._aside(node) for node in nodes])
            _, count = rows(order, widths, (left, 0, right, 0))
            placed, _ = rows(order, widths, (left, 0, right, floor + count * ROW))
            spots |= {n: (x, y) for n, (x, y) in zip(nodes, placed.tolist(), strict=True)}
            floor += count * ROW + _GAP
        nodes = [node for node, of in tiers.items() if of == "entity"]
        places = np.array([self._scene.place(node) or (math.nan, math.nan) for node in nodes])
        sizes = np.array([self._sizes[node] for node in nodes]).reshape(-1, 2)
        area = (left + 6, floor + 8, right - 6, top - 6)
        found = scattered(places.reshape(-1, 2), sizes, area)
        return spots | {n: (x, y) for n, (x, y) in zip(nodes, found.tolist(), strict=True)}

    def _aside(self, node: int) -> float:
        """How far to the right a part of the map lies: where it is nearest to the ego."""
        ground = self._scene.ground
        if ground is not None:
            near = ground.nearest(node, (0.0, 4.0))
            if near is not None:
                return near[0]
        place = self._scene.place(node)
        return 0.0 if place is None else place[0]

    def _rect(self, node: int) -> Rect:
        (x, y), (width, height) = self._spots[node], self._sizes[node]
        return (x - width / 2, y - height / 2, x + width / 2, y + height / 2)

    def _border(self, node: int, towards: Point) -> Point:
        """Where the line from a node's middle to a point leaves the node."""
        (x, y), half = self._spots[node], self._sizes[node] / 2
        dx, dy = towards[0] - x, towards[1] - y
        steps = [h / abs(d) for h, d in zip(half.tolist(), (dx, dy), strict=True) if abs(d) > 1e-9]
        step = min([1.0, *steps])
        return x + step * dx, y + step * dy

    # Drawing --------------------------------------------------------------------------------------

    def _text(self, node: int) -> str:
        attributes = self._scene.graph.nodes[node]
        light = attributes.get("light_state")
        return self._scene.name(node) + ("" if light is None else f": {clean(light, 12)}")

    def _course(self, line: Line) -> Floats:
        """(3, 2): start, control point and end of a line's curve."""
        a, b = self._spots[line.a], self._spots[line.b]
        if line.family != "map":
            start, end = self._border(line.a, b), self._border(line.b, a)
            return np.array([start, np.add(start, end) / 2, end])
        start = np.array((a[0], a[1] - self._sizes[line.a][1] / 2))
        end = np.array((b[0], b[1] - self._sizes[line.b][1] / 2))
        middle = (start + end) / 2
        depth = min(abs(end[0] - start[0]) * 0.45 + 8.0, 2 * (_ARCS - 10.0))
        return np.array([start, (middle[0], min(start[1], end[1]) - depth), end])

    def _paint_line(self, line: Line) -> None:
        colour, width, look = _pen(line, self._scene)
        start, control, end = self._course(line)
        away = control - (start + end) / 2
        span = end - start
        length = float(np.hypot(*span))
        if length < 1.0:
            return
        # matplotlib bends to the right of the way by a share of its length.
        right = np.array((span[1], -span[0])) / length
        bend = float(away @ right) / length
        arrow = FancyArrowPatch(
            tuple(start),
            tuple(end),
            arrowstyle="<|-|>" if line.back else "-|>",
            connectionstyle=f"arc3,rad={bend:.4f}",
            mutation_scale=5.0 + 0.8 * width,
            shrinkA=0.0,
            shrinkB=0.0,
            color=colour,
            linewidth=width,
            zorder=_LINES + (line.family in {"ego", "matched"}) * 0.5,
            **look,
        )
        arrow.set_gid(f"edge-{line.a}-{line.b}")
        self._page.sheet.add_artist(arrow)

    def _paint_words(self, line: Line) -> None:
        text = line.text
        if not text or line.family == "entity":
            return
        start, control, end = self._course(line)
        size = np.add(self._page.text_size(text, _WORDS), (2.0, 1.5))
        spots: list[Point] = []
        for t in (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74):
            x, y = (1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end
            spots.append((float(x), float(y)))
        spot = self._placer.first_free(spots, (float(size[0]), float(size[1])))
        if spot is None:
            return
        slip = {
            "boxstyle": "round,pad=0.1",
            "facecolor": palette.GROUND,
            "edgecolor": "none",
            "alpha": 0.9,
        }
        look: dict[str, Any] = {
            "fontsize": _WORDS,
            "color": _ink(line),
            "zorder": _SLIPS,
            "bbox": slip,
        }
        look |= {"ha": "center", "va": "center_baseline", "gid": f"words-{line.a}-{line.b}"}
        self._page.text(*spot, text, **look)

    def _paint_node(self, node: int) -> None:
        x, y = self._spots[node]
        attributes = self._scene.graph.nodes[node]
        kind = str(attributes.get("kind"))
        is_ego = node == self._scene.graph.ego
        fill = palette.DIAGRAM_TINTS.get(kind) or palette.entity_tint(kind, ego=is_ego)
        edge, width = palette.PAPER, 0.8
        if kind == "traffic_light":
            state = str(attributes.get("light_state"))
            edge, width = palette.LIGHT_EDGES.get(state, palette.FAINT_INK), 1.8
        if node in self._scene.matched:
            edge, width = palette.MATCH, 2.6
        pad = _PAD[0] / 2 / _SIZE
        box = {
            "boxstyle": f"round,pad={pad:.3f},rounding_size=0.6",
            "facecolor": fill,
            "edgecolor": edge,
            "linewidth": width,
        }
        look: dict[str, Any] = {
            "fontsize": _SIZE,
            "weight": "bold",
            "color": palette.PAPER,
            "bbox": box,
        }
        look |= {"ha": "center", "va": "center_baseline", "zorder": _NODES + is_ego}
        self._page.text(x, y, self._texts[node], gid=f"vertex-{node}", **look)


def _pen(line: Line, scene: Scene) -> tuple[str, float, dict[str, Any]]:
    """Colour, width in points, and what else of its look."""
    if line.family in {"ego", "matched"}:
        close = min((r for r in line.relations if r in _RANK), key=_RANK.__getitem__, default=None)
        colour, width = palette.CLOSENESS[close] if close else (palette.FAR_EDGE, 0.9)
        return colour, 0.7 * width + 0.3, {}
    if line.family == "light":
        state = str(scene.graph.nodes[line.a].get("light_state"))
        return palette.LIGHT_EDGES.get(state, palette.FAINT_INK), 1.1, {"linestyle": (0, (4, 2))}
    return _QUIET[line.family]


def _ink(line: Line) -> str:
    if line.family == "ego":
        return palette.CLOSENESS["near_coll"][0]
    return palette.MATCH_EDGE if line.family == "matched" else palette.DIAGRAM_TINTS["road"]
