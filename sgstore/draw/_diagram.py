"""Diagram of a scene graph as nodes and edges: choice of the content, layout and drawing.

The first part selects the nodes and edges of a diagram, and the edges that share a line.

A frame of forty entities has thousands of edges; people can read a diagram of a few dozen. The
diagram shows the ego with its neighbours, their lanes, the roads and junctions of these, and the
signals that control them. The functions are pure and need no drawing package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from matplotlib.patches import FancyArrowPatch, Rectangle

import sgstore.draw._palette as palette
from sgstore.base.display import number_of
from sgstore.draw._drawn_links import ALONG, RANK, ego_lane, linked
from sgstore.draw._legend import Entry
from sgstore.draw._placement import Placer
from sgstore.draw._view import SCENERY, clean, distance
from sgstore.model.vocabulary import ENTITY_KINDS, PROXIMITY, SIGNALS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.draw._drawn_links import Relations
    from sgstore.draw._page import Page, Rect
    from sgstore.draw._scene import DrawnFrame, Point
    from sgstore.model.graph import SceneGraph
    from sgstore.model.world import Floats


Tier = Literal["entity", "lane", "road", "junction"]
Family = Literal["ego", "matched", "entity", "light", "isIn", "map", "part"]

NEIGHBOURS: Final = 12
"""Largest number of entities around the ego, nearest first."""
MOST: Final = 60
"""Largest number of entities if ``relations="all"``."""

MOST_WORDS: Final = 2
"""Largest number of relation names on a line for each direction. The most informative ones are selected."""

_TIERS: Final[dict[str, Tier]] = {"road": "road", "junction": "junction", "roundabout": "junction"}


@dataclass(frozen=True, slots=True)
class DiagramLine:
    """Line of a diagram: all edges between two nodes ``a`` and ``b``. An arrow points from ``a`` to ``b``.

    Attributes
    ----------
    a, b : int
        Node ids.
    relations, back : tuple of str
        Relations from a to b, and those from b to a in the same line.
    family : str
        ``ego``: an entity relative to the ego; ``matched``: among matched nodes; ``entity``: other
        entities; ``light``: a signal and a lane; ``isIn``: an entity in a lane; ``map``: lane to
        lane; ``part``: a lane in its road, a road in its junction or roundabout.
    """

    a: int
    b: int
    relations: tuple[str, ...]
    family: Family
    back: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Return the text on a line of a diagram; empty if the style of the line is enough."""
        if self.family in {"isIn", "part", "light"}:
            return ""
        there, back = (", ".join(words[:MOST_WORDS]) for words in (self.relations, self.back))
        return there if back in {"", there} else f"{there} ⇄ {back}"


def excerpt_of(
    graph: SceneGraph, matched: frozenset[int], relations: Relations
) -> tuple[dict[int, Tier], list[DiagramLine]]:
    """Select the nodes and lines of a scene graph that a diagram shows.

    Parameters
    ----------
    graph : SceneGraph
    matched : frozenset of int
        Matched nodes, which are always shown.
    relations : {"ego", "all", "none"}
        ``ego``: only entities with a proximity relation to the ego, and their relations to it;
        ``all``: all entities and relations; ``none``: no relations among entities.

    Returns
    -------
    nodes : dict
        Node id → tier; the ego first, then the nearest.
    lines : list of DiagramLine
        Most important last.
    """
    entities = _entities(graph, matched, relations)
    lanes, inside = _lanes(graph, entities, matched)
    lights = _lights(graph, lanes, matched)
    parts = _parts(graph, [*lanes, *(n for n in matched if n < 0)])
    shown = [*entities, *lights, *lanes, *inside, *parts, *sorted(matched)]
    tiers: dict[int, Tier] = {n: tier_of(graph, n) for n in shown if n in graph.nodes}
    return tiers, _lines(graph, tiers, matched, relations)


def tier_of(graph: SceneGraph, node: int) -> Tier:
    """Return the tier of a node in a diagram: entities, lanes, roads or junctions."""
    kind = str(graph.nodes[node].get("kind"))
    return "entity" if kind in ENTITY_KINDS else _TIERS.get(kind, "lane")


def _entities(graph: SceneGraph, matched: frozenset[int], relations: Relations) -> list[int]:
    """Return the entities that a diagram shows: the ego, matched entities, and the nearest others."""
    ego = graph.ego if graph.ego in graph.nodes else None
    first = [n for n in ([] if ego is None else [ego]) + sorted(matched) if n in graph.nodes]
    first = [n for n in dict.fromkeys(first) if tier_of(graph, n) == "entity"]
    close = _close(graph) if ego is not None and relations != "all" else None
    others = [
        node
        for node, attributes in graph.nodes.items()
        if node >= 0
        and node not in first
        and attributes.get("kind") in ENTITY_KINDS
        and attributes.get("kind") not in (SCENERY | set(SIGNALS) if close is not None else SCENERY)
        and (close is None or node in close)
    ]
    middle = graph.nodes.get(first[0] if first else -1, {})
    far = {node: distance(middle, graph.nodes[node]) for node in others}
    others.sort(key=lambda n: (math.inf if math.isnan(far[n]) else far[n], n))
    room = MOST if relations == "all" else NEIGHBOURS
    return first + others[: max(room - len(first), 0)]


def _close(graph: SceneGraph) -> set[int]:
    """Return the entities that are near the ego according to a relation of the scene graph.

    In a graph without proximity relations, any relation counts.
    """
    near: set[int] = set()
    any_way: set[int] = set()
    for src, relation, dst, _ in graph.edges:
        if dst == graph.ego and src >= 0:
            any_way.add(src)
            if relation in PROXIMITY or relation in ALONG:
                near.add(src)
    return near or any_way


def _lanes(
    graph: SceneGraph, entities: list[int], matched: frozenset[int]
) -> tuple[list[int], list[int]]:
    """Return the lanes of entities and of matches, and the crosswalks and off-road areas of entities."""
    within: dict[int, list[tuple[bool, int]]] = {}
    other: list[int] = []
    wanted = set(entities)
    for src, relation, dst, attributes in graph.edges:
        if relation != "isIn" or src not in wanted or dst not in graph.nodes:
            continue
        if graph.nodes[dst].get("kind") == "lane":
            within.setdefault(src, []).append((not attributes.get("is_primary", False), dst))
        elif graph.nodes[dst].get("kind") in {"crosswalk", "off_road"}:
            other.append(dst)
    lanes = [min(within[node])[1] for node in entities if node in within]
    lanes += [
        n for n in sorted(matched) if n in graph.nodes and graph.nodes[n].get("kind") == "lane"
    ]
    return list(dict.fromkeys(lanes)), list(dict.fromkeys(other))


def _lights(graph: SceneGraph, lanes: list[int], matched: frozenset[int]) -> list[int]:
    """Return the signals that control the lane of the ego or a matched lane."""
    asked = {n for n in lanes if n in matched} | {ego_lane(graph)}
    return sorted(
        {
            src
            for src, relation, dst, _ in graph.edges
            if relation == "controlsTrafficOf" and dst in asked and src in graph.nodes
        }
    )


def _parts(graph: SceneGraph, lanes: list[int]) -> list[int]:
    """Return the roads and junctions that contain the given lanes."""
    inside: dict[int, list[int]] = {}
    for src, relation, dst, _ in graph.edges:
        if relation == "isIn" and src < 0 and dst in graph.nodes:
            inside.setdefault(src, []).append(dst)
    roads = [road for lane in lanes for road in inside.get(lane, [])]
    return list(dict.fromkeys([*roads, *(j for road in roads for j in inside.get(road, []))]))


def _lines(
    graph: SceneGraph, tiers: dict[int, Tier], matched: frozenset[int], relations: Relations
) -> list[DiagramLine]:
    lines: dict[Family, list[DiagramLine]] = {
        f: [] for f in ("part", "map", "isIn", "entity", "light", "ego", "matched")
    }
    for (a, b), (there, back) in linked(graph).items():
        if a not in tiers or b not in tiers:
            continue
        both = _together(tiers[a], tiers[b], a in matched and b in matched)
        if there and back and both is not None:
            rest = tuple(name for name in back if name not in there) or back
            lines[both].append(DiagramLine(b, a, there, both, rest))
            continue
        for src, dst, names in ((b, a, there), (a, b, back)):
            family = _family(graph, tiers, src, dst, matched)
            if names and family is not None and _is_asked(family, src, dst, graph, relations):
                lines[family].append(DiagramLine(src, dst, names, family))
    return [line for family in lines.values() for line in family]


def _together(a: Tier, b: Tier, matched: bool) -> Family | None:  # noqa: FBT001
    """Return ``map`` or ``matched`` if one line shows the edges of both directions between two nodes.

    ``None`` means that each direction has its own line.
    """
    if a == b == "lane":
        return "map"
    return "matched" if a == b == "entity" and matched else None


def _family(
    graph: SceneGraph, tiers: dict[int, Tier], src: int, dst: int, matched: frozenset[int]
) -> Family | None:
    ends = (tiers[src], tiers[dst])
    if ends == ("entity", "entity"):
        if src in matched and dst in matched:
            return "matched"
        return "ego" if graph.ego in {src, dst} else "entity"
    if ends[0] == "entity":
        return "light" if graph.nodes[src].get("kind") in SIGNALS else "isIn"
    return "map" if ends == ("lane", "lane") else "part"


def _is_asked(family: Family, src: int, dst: int, graph: SceneGraph, relations: Relations) -> bool:
    if family == "ego":
        return relations != "none" and (dst == graph.ego or relations == "all")
    return relations == "all" if family == "entity" else True


# Layout of a diagram: entities in the upper part, relative to the ego; map parts in rows below. The
# same graph gives the same layout, and a small change of the scene a small change of the layout:
# positions depend only on geometry. Distances are compressed, so that near nodes have room and far
# nodes stay visible. Then overlapping nodes push each other apart. All measures are points.

GAP: Final = (26.0, 11.0)
"""Smallest gap between two nodes (horizontal, vertical), so that lines between them stay visible; points."""
ROUNDS: Final = 200
ROW: Final = 17.0
"""Height of a row of map parts; points."""
_PULL: Final = 0.06
"""Share of the way back to its desired place by which a node moves in each round."""


def scattered(places: Floats, sizes: Floats, box: Rect, *, pinned: int = 1) -> Floats:
    """Return positions for the nodes of a diagram, near their real positions and without overlaps.

    Parameters
    ----------
    places : (N, 2) float64
        Positions in any unit, relative to the first one; a node with NaN is placed at the border.
    sizes : (N, 2) float64
        Width and height of the nodes.
    box : Rect
        Bounds of all nodes.
    pinned : int
        Number of leading nodes with fixed places.

    Returns
    -------
    (N, 2) float64
    """
    if not len(places):
        return np.zeros((0, 2))
    low, high = np.array(box[:2]), np.array(box[2:])
    half = (high - low) / 2
    away = np.nan_to_num(places - places[0])
    nowhere = np.isnan(places).any(axis=1)
    away[nowhere, 1] = np.nanmax(np.abs(away), initial=1.0)
    # Roads are longer than wide: a narrow layout is stretched, up to a half.
    reach = np.maximum(np.abs(away).max(axis=0), np.abs(away).max() / 2)
    away /= np.maximum(reach, 1e-9)
    # The root compresses: a quarter of the distance becomes a half.
    share = np.abs(away).max(axis=1)
    scale = np.divide(1.0, np.sqrt(share), out=np.zeros_like(share), where=share > 0)
    room = half - sizes.max(axis=0) / 2
    wanted = (low + high) / 2 + away * scale[:, None] * room
    return _freed(_apart(wanted, sizes, box, pinned), sizes, box, pinned)


def _apart(wanted: Floats, sizes: Floats, box: Rect, pinned: int) -> Floats:
    """Push overlapping nodes apart, but keep them near their real positions; return the new positions."""
    count = len(wanted)
    low = np.array(box[:2]) + sizes / 2
    high = np.array(box[2:]) - sizes / 2
    # Nodes at one place fan out, because otherwise the push has no direction.
    number = np.arange(count)
    loose = number >= pinned
    spots = wanted + 0.01 * np.stack([np.cos(number), np.sin(number)], axis=1) * loose[:, None]
    needed = (sizes[:, None] + sizes[None]) / 2 + GAP
    for turn in range(ROUNDS):
        way = spots[:, None] - spots[None]
        lacking = needed - np.abs(way)
        meet = (lacking[:, :, 0] > 0) & (lacking[:, :, 1] > 0) & ~np.eye(count, dtype=np.bool_)
        if not meet.any() and turn > ROUNDS // 2:
            break
        across = lacking[:, :, 0] / needed[:, :, 0] < lacking[:, :, 1] / needed[:, :, 1]
        sign = np.where(way >= 0, 1.0, -1.0)
        sign = np.where((way == 0) & (number < number[:, None])[..., None], -1, sign)
        push = np.where(np.stack([across, ~across], axis=2), lacking * sign, 0.0)
        push[~meet] = 0.0
        calm = 1.0 if turn < ROUNDS // 2 else 0.0
        step = 0.3 * push.sum(axis=1) + calm * _PULL * (wanted - spots)
        spots[loose] += step[loose]
        spots = np.clip(spots, low, high)
    return spots


def _freed(spots: Floats, sizes: Floats, box: Rect, pinned: int) -> Floats:
    """Move each node that still overlaps to the nearest free position, if any; return the new positions."""
    low, high = np.array(box[:2]), np.array(box[2:])
    spots = spots.copy()
    for node in range(pinned, len(spots)):
        needed = (sizes[:node] + sizes[node]) / 2 + 1.0
        if not (np.abs(spots[:node] - spots[node]) < needed).all(axis=1).any():
            continue
        half = sizes[node] / 2
        steps = (
            np.arange(low[i] + half[i], high[i] - half[i] + 1e-6, half[i] / (2 - i)) for i in (0, 1)
        )
        places = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        taken = (np.abs(places[:, None] - spots[:node]) < needed).all(axis=2).any(axis=1)
        if not taken.all():
            far = np.hypot(*(places - spots[node]).T)
            spots[node] = places[np.argmin(np.where(taken, np.inf, far))]
    return spots


def rows(order: Floats, widths: Floats, box: Rect) -> tuple[Floats, int]:
    """Arrange nodes in rows, from left to right; return their positions and the number of rows.

    Parameters
    ----------
    order : (N,) float64
        Smaller values are further left.
    widths : (N,) float64
    box : Rect
        Left and right bound the rows; the first row is at the top.

    Returns
    -------
    spots : (N, 2) float64
    count : int
        Number of rows.
    """
    left, _, right, top = box
    placed = np.zeros((len(order), 2))
    if not len(order):
        return placed, 0
    sequence = np.argsort(order, kind="stable")
    count = _rows_needed(widths, right - left)
    for row in range(
        count
    ):  # distributed, so that neighbours are in different rows with room for arrows
        inside = sequence[row::count]
        free = (right - left - widths[inside].sum()) / (len(inside) + 1)
        ends = np.cumsum(widths[inside] + free)
        placed[inside, 0] = left + ends - widths[inside] / 2
        placed[inside, 1] = top - ROW * row - ROW / 2
    return placed, count


def _rows_needed(widths: NDArray[np.float64], room: float) -> int:
    count = 1
    while True:
        fullest = max(
            widths[row::count].sum() + GAP[0] / 2 * len(widths[row::count]) for row in range(count)
        )
        if fullest <= room or count >= len(widths):
            return count
        count += 1


# A scene graph as nodes and edges, next to the view from above, in the colours of the paper's
# figures. Top: entities, relative to the ego. Below: their lanes, from left to right relative to
# the ego, then roads, then junctions.

_SIZE: Final = 6.6
_PAD: Final = (9.0, 6.0)
"""Margin on both sides of a node's text together; points."""
_WORDS: Final = 5.4
_ARCS: Final = 46.0
"""Height of the arcs between lanes; points."""
_GAP: Final = 16.0
_LINES, _SLIPS, _NODES = 2.0, 3.0, 4.0
_SPOTS: Final = 0.5 + 0.03 * np.array([step * sign for step in range(13) for sign in (-1, 1)][1:])
"""Possible places of a text on a line, as shares of its length. The middle is tried first."""
_WHOLE: Final = np.linspace(0.0, 1.0, 41)
_QUIET: Final[dict[str, tuple[str, float, dict[str, Any]]]] = {
    "entity": (palette.ENTITY_EDGE, 0.5, {"alpha": 0.35}),
    "isIn": (palette.DIAGRAM_TINTS["lane"], 0.8, {"alpha": 0.75}),
    "map": (palette.DIAGRAM_TINTS["lane"], 0.7, {}),
    "part": (palette.DIAGRAM_TINTS["road"], 0.7, {"alpha": 0.8}),
}


def paint_diagram(page: Page, box: Rect, scene: DrawnFrame, relations: Relations) -> str:
    """Draw the diagram of a scene graph in a window; return a summary of the shown nodes.

    Parameters
    ----------
    page : Page
    box : Rect
        Left, bottom, right and top of the window; points.
    scene : DrawnFrame
    relations : {"ego", "all", "none"}
        Edges among entities to show.
    """
    left, bottom, right, top = box
    ground = Rectangle(
        (left, bottom), right - left, top - bottom, facecolor=palette.GROUND, linewidth=0
    )
    page.add(page.sheet, ground)
    graph = scene.graph
    nodes, lines = excerpt_of(graph, frozenset(scene.matched), relations)
    unwritten = _Diagram(page, box, scene, nodes, lines).paint()
    edges = sum(len(line.relations) + len(line.back) for line in lines)
    return (
        f"shown: {len(nodes)} of {number_of(len(graph.nodes), 'node')},"
        f" {edges} of {number_of(len(graph.edges), 'edge')}"
        + (f" ({unwritten} without words)" if unwritten else "")
    )


def diagram_entries() -> list[Entry]:
    """Return the legend entries of scene graph diagrams."""
    lane, road = palette.DIAGRAM_TINTS["lane"], palette.DIAGRAM_TINTS["road"]
    return [
        Entry("area", "lane, crosswalk", lane),
        Entry("area", "road, junction", road),
        Entry("arrow", "isIn", lane, 0.8),
    ]


class _Diagram:
    """Diagram of a scene graph in a window. It computes a position for each node."""

    def __init__(
        self,
        page: Page,
        box: Rect,
        scene: DrawnFrame,
        nodes: dict[int, Tier],
        lines: list[DiagramLine],
    ) -> None:
        self._page = page
        self._scene = scene
        self._lines = lines
        self._texts = {node: self._text(node) for node in nodes}
        self._sizes = {
            node: np.add(page.text_size(text, _SIZE, "bold"), _PAD)
            for node, text in self._texts.items()
        }
        self._box = box
        self._spots = self._placed(nodes)
        self._placer = Placer(box)
        for node in nodes:
            left, bottom, right, top = self._rect(node)
            self._placer.block((left - 2, bottom - 2, right + 2, top + 2))

    def paint(self) -> int:
        """Draw the nodes, lines and texts. Return the number of lines whose text did not fit."""
        for line in self._lines:
            self._paint_line(line)
        # The most important line is written first.
        written = [self._paint_words(line) for line in reversed(self._lines)]
        for node in self._texts:
            self._paint_node(node)
        return written.count(False)

    def _placed(self, tiers: dict[int, Tier]) -> dict[int, Point]:
        """Return the positions of all nodes. From the bottom up: junctions, roads, lanes, entities."""
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
        """Return how far a map part lies to the right of the ego, at a point of the part near the ego; m."""
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
        """Return the point where a line from a node to another point crosses the border of the node."""
        (x, y), half = self._spots[node], self._sizes[node] / 2
        dx, dy = towards[0] - x, towards[1] - y
        steps = [h / abs(d) for h, d in zip(half.tolist(), (dx, dy), strict=True) if abs(d) > 1e-9]
        step = min([1.0, *steps])
        return x + step * dx, y + step * dy

    def _text(self, node: int) -> str:
        attributes = self._scene.graph.nodes[node]
        light = attributes.get("light_state")
        return self._scene.name(node) + ("" if light is None else f": {clean(light, 12)}")

    def _course(self, line: DiagramLine) -> Floats:
        """Return the start, control point and end of a curved line between two nodes, (3, 2)."""
        a, b = self._spots[line.a], self._spots[line.b]
        if line.family != "map":
            start, end = self._border(line.a, b), self._border(line.b, a)
            return np.array([start, np.add(start, end) / 2, end])
        start = np.array((a[0], a[1] - self._sizes[line.a][1] / 2))
        end = np.array((b[0], b[1] - self._sizes[line.b][1] / 2))
        middle = (start + end) / 2
        depth = min(abs(end[0] - start[0]) * 0.45 + 8.0, 2 * (_ARCS - 10.0))
        return np.array([start, (middle[0], min(start[1], end[1]) - depth), end])

    def _paint_line(self, line: DiagramLine) -> None:
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
        self._page.add(self._page.sheet, arrow)

    def _along(self, line: DiagramLine, shares: Floats) -> Floats:
        """Return points on a curved line between two nodes, (N, 2)."""
        start, control, end = self._course(line)
        t = shares[:, None]
        return (1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end

    def _paint_words(self, line: DiagramLine) -> bool:
        """Write the text of a line where few other lines are. Return False if the text does not fit."""
        text = line.text
        if not text or line.family == "entity":
            return True
        size = np.add(self._page.text_size(text, _WORDS), (3.0, 3.0))
        spots = self._along(line, _SPOTS)
        others = [self._along(one, _WHOLE) for one in self._lines if one is not line]
        away = np.abs(spots[:, None] - np.concatenate([np.zeros((0, 2)), *others]))
        inside = (away < size / 2 + 1.0).all(axis=2).sum(axis=1)
        order = np.argsort(inside, kind="stable")
        spot = self._placer.first_free(
            [(float(x), float(y)) for x, y in spots[order]], (float(size[0]), float(size[1]))
        )
        if spot is None:
            return False
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
        return True

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


def _pen(line: DiagramLine, scene: DrawnFrame) -> tuple[str, float, dict[str, Any]]:
    """Return the colour, the width in points and other attributes of a line in a diagram."""
    if line.family in {"ego", "matched"}:
        close = min((r for r in line.relations if r in RANK), key=RANK.__getitem__, default=None)
        colour, width = palette.CLOSENESS[close] if close else (palette.FAR_EDGE, 0.9)
        return colour, 0.7 * width + 0.3, {}
    if line.family == "light":
        state = str(scene.graph.nodes[line.a].get("light_state"))
        return palette.LIGHT_EDGES.get(state, palette.FAINT_INK), 1.1, {"linestyle": (0, (4, 2))}
    return _QUIET[line.family]


def _ink(line: DiagramLine) -> str:
    if line.family == "ego":
        return palette.CLOSENESS["near_coll"][0]
    return palette.MATCH_EDGE if line.family == "matched" else palette.DIAGRAM_TINTS["road"]
