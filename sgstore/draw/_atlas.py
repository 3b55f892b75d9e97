"""Page with a road map and a side panel.

The right side of the page: camera picture, matches, and the ego's surroundings as text.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.draw._ground import GroundView, paint_compass, paint_ground, paint_scale, rings_of
from sgstore.draw._legend import Entry, ground_entries, paint_swatch
from sgstore.draw._page import Placer
from sgstore.draw._view import (
    SCENERY,
    MapWindow,
    caption,
    clean,
    counted,
    distance,
    seen_from_ego,
    sentences,
)
from sgstore.errors import ExportError
from sgstore.model.vocabulary import ENTITY_KINDS, KINDS, MAP_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.draw._page import Page, Rect, Stage
    from sgstore.draw._scene import DrawnFrame
    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import Floats


ROW: Final = 10.5
HEAD: Final = 20.0
_SMALL: Final = 6.6
_SWATCH: Final = 20.0
_NEIGHBOURS: Final = 18
"""Greatest number of rows for the ego's surroundings."""
_LEFT_OUT: Final = "… and {} more"


@dataclass(slots=True)
class Panel:
    """Column of the page that is filled from its top; points.

    Attributes
    ----------
    page : Page
    left, right, bottom : float
        Its borders on the page.
    y : float
        Upper end of the free part.
    """

    page: Page
    left: float
    right: float
    bottom: float
    y: float

    def room(self) -> float:
        """Return the height of the free part."""
        return self.y - self.bottom

    def head(self, text: str) -> None:
        """Write a small heading with a rule under it."""
        self.y -= HEAD - 3
        self.page.text(self.left, self.y + 4, text, fontsize=7.5, weight="bold")
        rule = Line2D((self.left, self.right), (self.y, self.y), color=palette.RULE, linewidth=0.7)
        self.page.add(self.page.sheet, rule)
        self.y -= 3

    def row(self, *cells: tuple[float, str], **look: Any) -> None:
        """Write a line of cells, each at its distance from the left border, cut at the next one."""
        self.y -= ROW
        ends = [x for x, _ in cells[1:]] + [self.right - self.left + 4]
        style = {"fontsize": _SMALL, **look}
        for (x, text), end in zip(cells, ends, strict=True):
            self.page.text(self.left + x, self.y + 2, self._cut(text, end - x - 4), **style)

    def _cut(self, text: str, width: float) -> str:
        """Shorten a text to a width, because names of traces can be long."""
        if self.page.text_size(text, _SMALL)[0] <= width:
            return text
        while len(text) > 1 and self.page.text_size(text + "…", _SMALL)[0] > width:
            text = text[:-1]
        return text + "…"


def paint_picture(panel: Panel, picture: bytes) -> None:
    """Paint the camera picture over the panel's width, at most three fifths of it high."""
    width = panel.right - panel.left
    panel.y -= panel.page.picture(picture, panel.left, panel.y, width, 0.6 * width)


def paint_matches(panel: Panel, scene: DrawnFrame) -> None:
    """Write the bindings of variables, and the relations among matched nodes."""
    panel.head("Matched" if any(scene.matched.values()) else "Highlighted")
    for node in list(scene.matched)[:8]:
        known = node in scene.graph.nodes
        where = "  (not in the picture)" if known else "  (not in this frame)"
        panel.row((0.0, scene.name(node) + ("" if scene.is_shown(node) else where)))
    if len(scene.matched) > 8:
        panel.row((0.0, _LEFT_OUT.format(len(scene.matched) - 8)), color=palette.FAINT_INK)
    said = [s for k in scene.links if k.family == "matched" for s in sentences(k, scene.matched)]
    for sentence in said[:8]:
        panel.row((8.0, sentence), color=palette.MATCH_EDGE)
    if len(said) > 8:
        panel.row((8.0, _LEFT_OUT.format(len(said) - 8)), color=palette.FAINT_INK)


def paint_surroundings(panel: Panel, scene: DrawnFrame, bottom: float) -> None:
    """Write the ego's neighbours, nearest first, down to ``bottom``."""
    graph = scene.graph
    if graph.ego is None or graph.ego not in graph.nodes:
        return
    ego = graph.nodes[graph.ego]
    seen = {
        node: there
        for node, there in seen_from_ego(graph).items()
        if graph.nodes[node].get("kind") not in SCENERY
    }
    rows = int((panel.y - bottom - HEAD) // ROW)
    if not seen or rows < 2:
        return
    far = {node: distance(ego, graph.nodes[node]) for node in seen}
    near = sorted(seen, key=lambda n: (math.inf if math.isnan(far[n]) else far[n], n))
    rows = min(rows, _NEIGHBOURS)
    shown = near if len(near) <= rows else near[: rows - 1]
    panel.head("Around the ego: what, how far, which relations to it")
    for node in shown:
        metres = "" if math.isnan(far[node]) else f"{far[node]:.1f} m"
        name = caption(node, graph.nodes[node])
        light = graph.nodes[node].get("light_state")
        words = seen[node] if light is None else (f"is {clean(light, 12)}", *seen[node])
        body = scene.bodies.get(node)
        if body is not None and body.below:
            words = (f"{body.below:.0f} m below", *words)
        panel.row((9.0, name), (76.0, metres), (106.0, ", ".join(words)))
        tint = palette.entity_tint(str(graph.nodes[node].get("kind")))
        dot = Circle((panel.left + 3, panel.y + 4.2), 2.4, facecolor=tint, linewidth=0.0)
        panel.page.add(panel.page.sheet, dot)
    if len(near) > len(shown):
        panel.row((0.0, _LEFT_OUT.format(len(near) - len(shown))), color=palette.FAINT_INK)


def legend_height(entries: Sequence[Entry]) -> float:
    """Return the height of a legend with these entries; points."""
    return HEAD + ROW * _legend_rows(entries)


def paint_legend(panel: Panel, entries: Sequence[Entry]) -> None:
    """Draw the legend: short entries in two columns, long ones below."""
    panel.head("What is what")
    top, half = panel.y, (panel.right - panel.left) / 2
    short = [e for e in entries if not e.is_long]
    rows = math.ceil(len(short) / 2)
    for index, entry in enumerate(short):
        x = panel.left + half * (index // rows)
        _paint_entry(panel, entry, x, top - ROW * (index % rows + 1))
    panel.y = top - ROW * rows
    for entry in entries:
        if entry.is_long:
            panel.y -= ROW
            _paint_entry(panel, entry, panel.left, panel.y)


_KEY_COLUMNS: Final = 9


def key_height(entries: int) -> float:
    """Return the height of a legend under a picture; points."""
    return ROW * math.ceil(entries / _KEY_COLUMNS)


def paint_key(page: Page, entries: Sequence[Entry], box: Rect) -> None:
    """Paint a legend under a picture: entries in columns, without a heading."""
    left, _, right, top = box
    step, down = (right - left) / _KEY_COLUMNS, math.ceil(len(entries) / _KEY_COLUMNS)
    panel = Panel(page, left, right, 0.0, top)
    for index, entry in enumerate(entries):
        _paint_entry(panel, entry, left + step * (index // down), top - ROW * (index % down + 1))


def _paint_entry(panel: Panel, entry: Entry, x: float, y: float) -> None:
    paint_swatch(panel.page, entry, (x + _SWATCH / 2 - 2, y + 4.2))
    panel.page.text(x + _SWATCH, y + 2, entry.text, fontsize=_SMALL)


def _legend_rows(entries: Sequence[Entry]) -> int:
    short = sum(not e.is_long for e in entries)
    return math.ceil(short / 2) + len(entries) - short


# A whole map on a page, north up ----------------------------------------------------------------

_BORDER: Final = 1.05
"""Side of the window, as a share of the map's extent."""
_NAMED_ROADS: Final = 150
_SIGNAL: Final = 3.4


_TOLD: Final = 11
"""Greatest number of kinds of map parts in one line."""


def paint_atlas(page: Page, road_map: RoadMap, window: Rect, side: Rect) -> str:
    """Draw a map in a window with its figures and legend; return a one-line summary.

    Raises
    ------
    ExportError
        The map has no outlines.
    """
    ground = _whole(road_map)
    stage = page.stage(window, ground.view)
    in_junctions = [row for row in _travelled(ground) if ground.nodes.junction[row]]
    paint_ground(stage, ground, arrows=False)
    stage.fill_all(ground.outlines_of(in_junctions), palette.JUNCTION, z=layers.TINTS)
    signals = _paint_signals(stage, ground)
    _paint_names(stage, ground, (paint_scale(stage), paint_compass(stage)))
    panel = Panel(page, side[0], side[2], side[1], side[3])
    _paint_figures(panel, ground)
    entries = ground_entries(ground)
    if in_junctions:
        entries.append(Entry("area", "lane in a junction", palette.JUNCTION))
    entries += [Entry("dot", k.replace("_", " "), palette.SIGNAL_TINTS[k]) for k in signals]
    paint_legend(panel, entries)
    return _summary(ground)


def _whole(road_map: RoadMap) -> GroundView:
    """Return a view of the complete map."""
    outlines = list(road_map.outlines())
    bounds = [o.bounds for o in outlines if o is not None and not o.is_empty]
    if not bounds:
        raise ExportError(
            f"the map {clean(road_map.name)!r} has no lane, crosswalk or object to draw"
        )
    low = np.array(bounds)[:, :2].min(axis=0)
    high = np.array(bounds)[:, 2:].max(axis=0)
    x, y = ((low + high) / 2).tolist()
    radius = max(5.0, float((high - low).max()) / 2 * _BORDER)
    return GroundView(
        road_map, MapWindow(x, y, math.pi / 2, radius), outlines, list(range(len(outlines)))
    )


def _travelled(ground: GroundView) -> list[int]:
    types = ground.nodes.lane_type
    return [row for row in ground.of_kind("lane") if types[row] in palette.TRAVELLED]


def _paint_signals(stage: Stage, ground: GroundView) -> list[str]:
    """Paint a dot for each signal of the map; return the kinds that occur."""
    nodes = ground.nodes
    found: list[str] = []
    for kind in SIGNALS:
        rows = [row for row in ground.rows if KINDS[nodes.kind[row]] == kind]
        places = ground.view.place(np.column_stack((nodes.x[rows], nodes.y[rows])))
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            continue
        found.append(kind)
        size = np.full(len(places), _SIGNAL * stage.metre)
        dots = EllipseCollection(
            size,
            size,
            np.zeros(len(places)),
            units="xy",
            offsets=places,
            offset_transform=stage.axes.transData,
            facecolors=[palette.SIGNAL_TINTS[kind]],
            edgecolors=[palette.PAPER],
            linewidths=[0.3],
            zorder=layers.LAMPS,
        )
        stage.page.add(stage.axes, dots)
    return found


def _paint_names(stage: Stage, ground: GroundView, reserved: Iterable[Rect]) -> None:
    """Paint ids of junctions, and of roads if they are few, at their lanes."""
    placer = Placer(stage.rect(*stage.half, (0.0, 0.0)))
    for rect in reserved:
        placer.block(rect)
    nodes, lanes = ground.nodes, _travelled(ground)
    junctions = _middles(ground, [r for r in lanes if nodes.junction[r]], nodes.junction)
    roads = _middles(ground, [r for r in lanes if not nodes.junction[r]], nodes.road)
    names = [(f"junction {clean(name, 10)}", at, "bold") for name, at in junctions.items()]
    if len(roads) <= _NAMED_ROADS:
        names += [(f"road {clean(name, 10)}", at, "normal") for name, at in roads.items()]
    for text, (x, y), weight in names:
        width, height = stage.page.text_size(text, 5.6, weight)
        at = (x * stage.points, y * stage.points)
        size = (width + 2, height + 2)
        spot = placer.along(at, at, size) or placer.beside(*at, (1.0, 1.0), size)
        if spot is not None:
            look = {"fontsize": 5.6, "weight": weight, "ha": "center", "va": "center_baseline"}
            x_m, y_m = (value * stage.metre for value in spot)
            stage.text(x_m, y_m, text, color=palette.INK, zorder=layers.CAPTIONS, **look)


def _middles(ground: GroundView, rows: list[int], names: tuple[str, ...]) -> dict[str, Floats]:
    """Return for each road or junction the mean position of its lanes; picture axes."""
    grouped: dict[str, list[int]] = {}
    for row in rows:
        grouped.setdefault(names[row], []).append(row)
    nodes = ground.nodes
    return {
        name: ground.view.place(np.array([(nodes.x[of].mean(), nodes.y[of].mean())]))[0]
        for name, of in grouped.items()
    }


def _paint_figures(panel: Panel, ground: GroundView) -> None:
    """Write the length of each lane type."""
    nodes = ground.nodes
    lanes = [row for row in ground.rows if KINDS[nodes.kind[row]] == "lane"]
    panel.head("Lanes by type")
    by_type = Counter(nodes.lane_type[row] for row in lanes)
    for lane_type, count in by_type.most_common(14):
        length = sum(float(nodes.length[r]) for r in lanes if nodes.lane_type[r] == lane_type)
        name = clean(lane_type, 20) or "(none given)"
        panel.row((0.0, name), (90.0, counted(count, "lane")), (150.0, f"{length / 1000:.2f} km"))


def _summary(ground: GroundView) -> str:
    kinds = Counter(KINDS[code] for code in ground.nodes.kind)
    low_high = [ring for outline in ground.outlines for ring in rings_of(outline)]
    extent = np.ptp(np.concatenate(low_high), axis=0) if low_high else np.zeros(2)
    order = [kind for kind in (*MAP_KINDS, *ENTITY_KINDS) if kinds[kind] and kind != "off_road"]
    told = [counted(kinds[kind], kind.replace("_", " ")) for kind in order]
    more = [f"and {len(told) - _TOLD} kinds more"] if len(told) > _TOLD else []
    return "  ·  ".join([f"{extent[0]:.0f} m by {extent[1]:.0f} m", *told[:_TOLD], *more])
