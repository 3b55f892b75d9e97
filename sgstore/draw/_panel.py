"""Side panel of a picture: camera picture, matches, surroundings of the ego, and legend."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from matplotlib.lines import Line2D
from matplotlib.patches import Circle

import sgstore.draw._palette as palette
from sgstore.draw._drawn_links import seen_from_ego, sentences
from sgstore.draw._legend import Entry, paint_swatch
from sgstore.draw._view import SCENERY, caption, clean, distance, gap_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.draw._page import Page, Rect
    from sgstore.draw._scene import DrawnFrame

ROW: Final = 10.5

HEAD: Final = 20.0

_SMALL: Final = 6.6

_SWATCH: Final = 20.0

_NEIGHBOURS: Final = 18
"""Largest number of rows for the surroundings of the ego."""

_LEFT_OUT: Final = "… and {} more"


@dataclass(slots=True)
class Panel:
    """Column next to a picture. Text fills it from the top down.

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
        """Height of the free part of the panel; points."""
        return self.y - self.bottom

    def head(self, text: str) -> None:
        """Write a small heading with a line below it into the panel."""
        self.y -= HEAD - 3
        self.page.text(self.left, self.y + 4, text, fontsize=7.5, weight="bold")
        rule = Line2D((self.left, self.right), (self.y, self.y), color=palette.RULE, linewidth=0.7)
        self.page.add(self.page.sheet, rule)
        self.y -= 3

    def row(self, *cells: tuple[float, str], **look: Any) -> None:
        """Write several texts in one row of the panel, each at a given offset. Long texts are cut."""
        self.y -= ROW
        ends = [x for x, _ in cells[1:]] + [self.right - self.left + 4]
        style = {"fontsize": _SMALL, **look}
        for (x, text), end in zip(cells, ends, strict=True):
            self.page.text(self.left + x, self.y + 2, self._cut(text, end - x - 4), **style)

    def _cut(self, text: str, width: float) -> str:
        """Return a text cut to a width in points. Names of traces, for example, can be too long."""
        if self.page.text_size(text, _SMALL)[0] <= width:
            return text
        while len(text) > 1 and self.page.text_size(text + "…", _SMALL)[0] > width:
            text = text[:-1]
        return text + "…"


def paint_picture(panel: Panel, picture: bytes) -> None:
    """Draw a camera picture in the width of the panel, at most three fifths of the panel high."""
    width = panel.right - panel.left
    panel.y -= panel.page.picture(picture, panel.left, panel.y, width, 0.6 * width)


def paint_matches(panel: Panel, scene: DrawnFrame) -> None:
    """Write the matched nodes with their variables, and the relations between them, into the panel."""
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
    """Write the neighbours of the ego into the panel, nearest first, until the panel is full."""
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
    gaps = {node: gap_of(ego, graph.nodes[node]) for node in seen}
    far = {
        node: distance(ego, graph.nodes[node]) if math.isnan(gap) else gap
        for node, gap in gaps.items()
    }
    near = sorted(seen, key=lambda n: (math.inf if math.isnan(far[n]) else far[n], n))
    rows = min(rows, _NEIGHBOURS)
    shown = near if len(near) <= rows else near[: rows - 1]
    centres = any(math.isnan(gaps[node]) and not math.isnan(far[node]) for node in shown)
    note = " (c: of the centres)" if centres else ""
    panel.head(f"Around the ego: what, gap{note}, which relations to it")
    for node in shown:
        metres = "" if math.isnan(far[node]) else f"{far[node]:.1f} m"
        metres = f"c {metres}" if metres and math.isnan(gaps[node]) else metres
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
    """Return the height of a legend in the side panel, in points."""
    short = sum(not e.is_long for e in entries)
    return HEAD + ROW * (math.ceil(short / 2) + len(entries) - short)


def paint_legend(panel: Panel, entries: Sequence[Entry]) -> None:
    """Draw a legend into the side panel: short entries in two columns, long entries below."""
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
    """Return the height of a legend below a picture for a number of entries; points."""
    return ROW * math.ceil(entries / _KEY_COLUMNS)


def paint_key(page: Page, entries: Sequence[Entry], box: Rect) -> None:
    """Draw a legend below a picture: entries in columns, without a heading."""
    left, _, right, top = box
    step, down = (right - left) / _KEY_COLUMNS, math.ceil(len(entries) / _KEY_COLUMNS)
    panel = Panel(page, left, right, 0.0, top)
    for index, entry in enumerate(entries):
        _paint_entry(panel, entry, left + step * (index // down), top - ROW * (index % down + 1))


def _paint_entry(panel: Panel, entry: Entry, x: float, y: float) -> None:
    paint_swatch(panel.page, entry, (x + _SWATCH / 2 - 2, y + 4.2))
    panel.page.text(x + _SWATCH, y + 2, entry.text, fontsize=_SMALL)
