"""Picture of a complete road map, with a side panel for lengths and the legend.

The right side of the page: camera picture, matches, and the ego's surroundings as text.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.collections import EllipseCollection

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.base.display import number_of
from sgstore.draw._ground import GroundView, paint_compass, paint_ground, paint_scale, rings_of
from sgstore.draw._legend import Entry, ground_entries
from sgstore.draw._panel import Panel, paint_legend
from sgstore.draw._placement import Placer
from sgstore.draw._view import MapWindow, clean
from sgstore.errors import ExportError
from sgstore.model.vocabulary import ENTITY_KINDS, KINDS, MAP_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.draw._page import Page, Rect, Stage
    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import Floats


_BORDER: Final = 1.05
"""Factor between the size of the window and the extent of the map, which leaves a margin."""
_NAMED_ROADS: Final = 150
_SIGNAL: Final = 3.4

_TOLD: Final = 11
"""Largest number of kinds of map parts in one line."""


def paint_atlas(page: Page, road_map: RoadMap, window: Rect, side: Rect) -> str:
    """Draw a road map in a window, with a panel for lengths and legend; return a one-line summary.

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
    """Return a view that shows the complete road map, north up."""
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
    """Draw a dot for each signal of the road map; return the kinds of signals that occur."""
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
    """Write the ids of junctions, and of roads if they are few, at their lanes."""
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
    """For each road or junction, return the mean position of its lanes, in picture coordinates."""
    grouped: dict[str, list[int]] = {}
    for row in rows:
        grouped.setdefault(names[row], []).append(row)
    nodes = ground.nodes
    return {
        name: ground.view.place(np.array([(nodes.x[of].mean(), nodes.y[of].mean())]))[0]
        for name, of in grouped.items()
    }


def _paint_figures(panel: Panel, ground: GroundView) -> None:
    """Write the total length of each lane type into the side panel of a map picture."""
    nodes = ground.nodes
    lanes = [row for row in ground.rows if KINDS[nodes.kind[row]] == "lane"]
    panel.head("Lanes by type")
    by_type = Counter(nodes.lane_type[row] for row in lanes)
    for lane_type, count in by_type.most_common(14):
        length = sum(float(nodes.length[r]) for r in lanes if nodes.lane_type[r] == lane_type)
        name = clean(lane_type, 20) or "(none given)"
        panel.row((0.0, name), (90.0, number_of(count, "lane")), (150.0, f"{length / 1000:.2f} km"))


def _summary(ground: GroundView) -> str:
    kinds = Counter(KINDS[code] for code in ground.nodes.kind)
    low_high = [ring for outline in ground.outlines for ring in rings_of(outline)]
    extent = np.ptp(np.concatenate(low_high), axis=0) if low_high else np.zeros(2)
    order = [kind for kind in (*MAP_KINDS, *ENTITY_KINDS) if kinds[kind] and kind != "off_road"]
    told = [
        number_of(kinds[kind], kind.replace("_", " "), "" if kind == "vegetation" else "s")
        for kind in order
    ]
    more = [f"and {len(told) - _TOLD} kinds more"] if len(told) > _TOLD else []
    return "  ·  ".join([f"{extent[0]:.0f} m by {extent[1]:.0f} m", *told[:_TOLD], *more])
