"""Picture of the graph of an abstraction: its nodes in a ring around the ego, its edges, and their labels.

Abstractions have names and classes, but no positions. The ring has equal classes side by side.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any, Final

from matplotlib.lines import Line2D

import sgstore.draw._palette as palette
from sgstore.base.display import number_of
from sgstore.draw._page import Page
from sgstore.draw._view import clean
from sgstore.model.vocabulary import natural

if TYPE_CHECKING:
    import networkx as nx

_SIDE: Final = 560.0
"""Width and height of the ring with its names; points."""
_RING: Final = 195.0
"""Radius of the ring; points."""
_LIST: Final = 300.0
"""Width of the list of edges; points."""
_MARGIN: Final = 16.0
_TITLE: Final = 44.0
_ROW: Final = 11.0
_NAME: Final = 7.5
_EGO: Final = frozenset({"ego", "ego_car"})


def graph_page(graph: nx.MultiDiGraph[Any], title: str, subtitle: str) -> Page:
    """Return a page with the graph of an abstraction; see :func:`sgstore.draw.draw_graph`."""
    page = Page(3 * _MARGIN + _SIDE + _LIST, 2 * _MARGIN + _SIDE + _TITLE)
    page.text(_MARGIN, page.height - _MARGIN - 14, clean(title), fontsize=13, weight="bold")
    page.text(_MARGIN, page.height - _MARGIN - 30, subtitle, fontsize=8, color=palette.FAINT_INK)
    spots = _spots(graph)
    labels = _labels(graph)
    egos = {node for node in graph if _class(graph, node) in _EGO}
    for ends in sorted({tuple(sorted(pair, key=str)) for pair in labels}, key=str):
        of_ego = not egos.isdisjoint(ends)
        color, alpha = (palette.EGO, 0.9) if of_ego else (palette.FAINT_INK, 0.35)
        (x, y), (u, v) = (spots[end] for end in ends)
        line = Line2D([x, u], [y, v], linewidth=0.8, zorder=1, color=color, alpha=alpha)
        page.add(page.sheet, line)
    for node, (x, y) in spots.items():
        _paint_node(page, graph, node, (x, y), is_ego=node in egos)
    _paint_list(page, graph, labels, egos)
    return page


def _class(graph: nx.MultiDiGraph[Any], node: Any) -> str:
    return str(graph.nodes[node].get("base_class", node))


def _name(graph: nx.MultiDiGraph[Any], node: Any) -> str:
    return clean(graph.nodes[node].get("name", node), 20)


def _spots(graph: nx.MultiDiGraph[Any]) -> dict[Any, tuple[float, float]]:
    """Return the position of each node on the page: the ego in the middle, the others in a ring."""
    middle = _MARGIN + _SIDE / 2
    egos = [node for node in graph if _class(graph, node) in _EGO]
    others = [node for node in graph if node not in egos[:1]]
    others.sort(key=lambda node: (_class(graph, node), natural(str(node))))
    spots = dict.fromkeys(egos[:1], (middle, middle))
    places = len(others) | 1  # odd: no line between two nodes of the ring passes the ego
    for number, node in enumerate(others):
        angle = math.pi / 2 - 2 * math.pi * number / places
        spots[node] = (middle + _RING * math.cos(angle), middle + _RING * math.sin(angle))
    return spots


def _labels(graph: nx.MultiDiGraph[Any]) -> dict[tuple[Any, Any], list[str]]:
    """Return the sorted labels of the edges between two nodes: (source, destination) → labels."""
    found: dict[tuple[Any, Any], list[str]] = defaultdict(list)
    for src, dst, label in graph.edges(data="label"):
        found[src, dst].append(clean(label, 24))
    return {ends: sorted(labels) for ends, labels in found.items()}


def _paint_node(
    page: Page, graph: nx.MultiDiGraph[Any], node: Any, spot: tuple[float, float], *, is_ego: bool
) -> None:
    """Draw a node as a dot. Its name is written outwards from the ring, so that names do not overlap."""
    kind = _class(graph, node)
    x, y = spot
    tint = palette.EGO if is_ego else palette.entity_tint(kind)
    dot = Line2D([x], [y], marker="o", markersize=7, color=tint, markeredgecolor=palette.PAPER)
    dot.set_zorder(2)
    page.add(page.sheet, dot)
    dx, dy = x - _MARGIN - _SIDE / 2, y - _MARGIN - _SIDE / 2
    if is_ego and not (dx or dy):
        page.text(x + 7, y + 5, _name(graph, node), fontsize=9, weight="bold", zorder=3)
        return
    turn = math.degrees(math.atan2(dy, dx))
    left = abs(turn) > 90
    page.text(
        x + 8 * math.cos(math.radians(turn)),
        y + 8 * math.sin(math.radians(turn)),
        _name(graph, node),
        fontsize=_NAME,
        ha="right" if left else "left",
        va="center",
        rotation=turn - math.copysign(180, turn) if left else turn,
        rotation_mode="anchor",
    )


def _paint_list(
    page: Page,
    graph: nx.MultiDiGraph[Any],
    labels: dict[tuple[Any, Any], list[str]],
    egos: set[Any],
) -> None:
    """Write the edges into the list, those of the ego first, until it is full."""
    left, y = 2 * _MARGIN + _SIDE, _MARGIN + _SIDE - 8
    ordered = sorted(labels, key=lambda ends: (egos.isdisjoint(ends), natural(str(ends))))
    page.text(left, y, "Edges", fontsize=9, weight="bold")
    rows = int((y - _MARGIN) // _ROW) - 1
    shown = ordered if len(ordered) <= rows else ordered[: rows - 1]
    for ends in shown:
        y -= _ROW
        src, dst = (_name(graph, end) for end in ends)
        text = clean(f"{src}  {', '.join(labels[ends])}  {dst}", 70)
        ink = palette.INK if not egos.isdisjoint(ends) else palette.FAINT_INK
        page.text(left, y, text, fontsize=_NAME, color=ink)
    rest = sum(len(labels[ends]) for ends in ordered[len(shown) :])
    if rest:
        page.text(
            left,
            y - _ROW,
            f"and {number_of(rest, 'more edge')}",
            fontsize=_NAME,
            color=palette.FAINT_INK,
        )
