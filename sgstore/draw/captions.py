"""What is written in a window: names of nodes, and relations on the lines between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.draw import layers, palette
from sgstore.draw.bodies import half_extents, velocity_arrow
from sgstore.draw.labels import Placer
from sgstore.draw.links import sentences
from sgstore.draw.view import SCENERY
from sgstore.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.draw.labels import Rect
    from sgstore.draw.links import Link
    from sgstore.draw.page import Stage
    from sgstore.draw.scene import Scene
    from sgstore.draw.view import Body

LABELLED_LINKS: Final = 10
"""How many of the ego's lines bear their relations, the nearest first: the panel has the others."""
_LEADER: Final = 9.0
"""A name further away than this from what it names is tied to it by a line; points."""
_PEN: Final = 4.5


def paint_texts(stage: Stage, scene: Scene, reserved: Iterable[Rect], *, every: bool) -> int:
    """Names of what was matched, then the ego's, then relations on the lines, then all other names.

    Parameters
    ----------
    stage : Stage
    scene : Scene
    reserved : iterable of Rect
        Room that is taken already.
    every : bool
        Otherwise only the matched and the ego are named.

    Returns
    -------
    int
        Names that found no room.
    """
    placer = Placer(stage.rect(*stage.half, (0.0, 0.0)))
    for rect in (*reserved, *(r for b in scene.bodies.values() for r in _room(stage, b))):
        placer.block(rect)
    first = scene.named_first()
    for node in first:
        _paint_name(stage, scene, placer, node)
    for link in scene.links:
        if link.family == "matched":
            _paint_relations(stage, scene, placer, link, sentences(link, scene.matched))
    if not every:
        return 0
    near = scene.near_first()
    order = {body.node: rank for rank, body in enumerate(near)}
    close = [k for k in scene.links if k.family == "ego" and k.b in order]
    for link in sorted(close, key=lambda k: order[k.b])[:LABELLED_LINKS]:
        _paint_relations(stage, scene, placer, link, [", ".join(link.there[:2])])
    others = [b for b in near if b.node not in first and _is_named(b) and stage.shows(b.x, b.y)]
    return sum(not _paint_name(stage, scene, placer, body.node) for body in others)


def _paint_name(stage: Stage, scene: Scene, placer: Placer, node: int) -> bool:
    matched = node in scene.matched
    bold = matched or node == scene.graph.ego
    text, size, weight = scene.name(node), 7.5 if bold else 6.3, "bold" if bold else "normal"
    width, height = stage.page.text_size(text, size, weight)
    anchor = tuple(x * stage.points for x in scene.anchor(node))
    body = scene.bodies.get(node)
    reach = (4.0, 4.0) if body is None else half_extents(stage, body)
    reach = (reach[0] + _PEN * matched, reach[1] + _PEN * matched)
    spot = placer.beside(anchor[0], anchor[1], reach, (width + 4, height + 3))
    if spot is None:
        return False
    gaps = [abs(s - a) - r for s, a, r in zip(spot, anchor, reach, strict=True)]
    if max(gaps[0] - width / 2, gaps[1] - height / 2) > _LEADER:
        leader = np.array((anchor, spot)) * stage.metre
        stage.lines([leader], palette.FAINT_INK, z=layers.ARROWS - 0.1, width=0.5)
    box = _tag() if matched else _slip(0.72)
    look = {"fontsize": size, "weight": weight, "zorder": layers.CAPTIONS + bold, "bbox": box}
    _write(stage, spot, text, gid=f"label-{node}", **look)
    return True


def _paint_relations(
    stage: Stage, scene: Scene, placer: Placer, link: Link, lines: list[str]
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
    """A slip of paper under a text, so that it can be read on any ground."""
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


def _is_named(body: Body) -> bool:
    return body.kind not in SCENERY and body.kind not in SIGNALS


def _room(stage: Stage, body: Body) -> list[Rect]:
    """Room that a body takes, and its arrow, in small squares."""
    half_x, half_y = half_extents(stage, body)
    taken = [stage.rect(half_x * stage.metre, half_y * stage.metre, (body.x, body.y))]
    way = velocity_arrow(body)
    if way is not None:
        half = 2.5 * stage.metre
        along = np.linspace(1.0, 0.0, max(2, int(np.hypot(*way) / half)), endpoint=False)
        spots = np.array((body.x, body.y)) + along[:, None] * way
        taken += [stage.rect(half, half, (x, y)) for x, y in spots.tolist()]
    return taken
