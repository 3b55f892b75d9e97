"""Symbols of entities in pictures: vehicles as boxes with a windscreen, people as dots, traffic lights."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.patches import Circle, FancyBboxPatch
from matplotlib.path import Path as Outline

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.draw._view import ARROW_SECONDS, SCENERY, outline, turned
from sgstore.model.vocabulary import SIGNALS

if TYPE_CHECKING:
    from sgstore.draw._page import Stage
    from sgstore.draw._view import Body
    from sgstore.model.world import Floats

SMALLEST: Final = 3.6
"""Smallest width of an entity's box; points."""

LAMP: Final = (5.0, 11.5)
"""Width and height of the symbol of a traffic light; points."""

BELOW: Final = 0.3
"""Opacity of objects that are below a drawn road."""

ROUND_KINDS: Final = frozenset({"person", "animal"})

_DOT: Final = 3.3

_SIGN: Final = 4.0


def paint_body(stage: Stage, body: Body) -> None:
    """Draw the symbol of an entity. In an SVG file, its group has the id ``node-17``."""
    colour = palette.entity_tint(body.kind, ego=body.is_ego)
    edge: dict[str, Any] = {
        "edgecolor": palette.PAPER,
        "linewidth": 0.7,
        "gid": f"node-{body.node}",
    }
    if body.below and body.kind not in SIGNALS and body.kind not in SCENERY:
        edge |= {"edgecolor": colour, "linestyle": (0, (2, 1.5)), "alpha": BELOW}
        small = 0.5 * SMALLEST if body.kind in ROUND_KINDS else SMALLEST
        box = Outline(outline(body, small * stage.metre))
        stage.fill(box, colour, z=layers.SCENERY, **edge)
    elif body.kind == "traffic_light":
        _paint_lamp(stage, body)
    elif body.kind in SIGNALS:
        stage.fill(_sign(stage, body), colour, z=layers.LAMPS, **edge)
    elif body.kind in SCENERY:
        box = Outline(outline(body, 0.7 * SMALLEST * stage.metre))
        edge["linewidth"] = 0.3
        stage.fill(box, colour, z=layers.SCENERY, **edge)
    elif body.kind in ROUND_KINDS:
        _paint_dot(stage, body, colour, edge)
    else:
        _paint_velocity(stage, body, colour)
        box = Outline(outline(body, SMALLEST * stage.metre))
        stage.fill(box, colour, z=layers.BODIES, **edge)
        if not math.isnan(body.angle):
            stage.fill(_windscreen(stage, body), palette.PAPER, z=layers.BODIES + 0.1, alpha=0.85)


def halo(stage: Stage, body: Body | None, place: tuple[float, float]) -> tuple[Floats, float]:
    """Return the outline of the mark around a matched node, and the line width in points.

    Parameters
    ----------
    stage : Stage
    body : Body or None
        ``None`` for a node without a symbol: a circle marks its place.
    place : (float, float)
        Picture coordinates.
    """
    if body is not None and body.kind not in SIGNALS and body.kind not in ROUND_KINDS:
        return outline(body, SMALLEST * stage.metre), 7.5
    reach = (9.5 if body is not None and body.kind in SIGNALS else 6.5) * stage.metre
    angles = np.linspace(0.0, 2 * math.pi, 49)
    return np.column_stack((np.cos(angles), np.sin(angles))) * reach + place, 4.0


def velocity_arrow(body: Body) -> Floats | None:
    """Return the vector from an entity's centre to the tip of its velocity arrow, (2,) in metres.

    ``None`` means an entity without an arrow.
    """
    way = np.array((body.vx, body.vy)) * ARROW_SECONDS
    # Very slow and implausibly fast bodies have no arrow.
    return way if 0.5 <= float(np.hypot(*way)) <= 150.0 else None


def half_extents(stage: Stage, body: Body) -> tuple[float, float]:
    """Return half the width and half the height of an entity's symbol on the page, in points."""
    if body.kind in SIGNALS:
        return LAMP[0] / 2, LAMP[1] / 2
    corners = outline(body, SMALLEST * stage.metre) - (body.x, body.y)
    half_x, half_y = (np.abs(corners).max(axis=0) * stage.points).tolist()
    return half_x, half_y


def lamps(
    x: float, y: float, light: str, metre: float, gid: str | None
) -> list[Circle | FancyBboxPatch]:
    """Return the shapes of a traffic light symbol, which is always upright.

    ``metre``: units of the window per point of the page.
    """
    width, height = (size * metre for size in LAMP)
    case = FancyBboxPatch(
        (x - width / 2, y - height / 2),
        width,
        height,
        boxstyle=f"round,pad=0,rounding_size={width / 3}",
        facecolor=palette.entity_tint("traffic_light"),
        edgecolor=palette.PAPER,
        linewidth=0.6,
        zorder=layers.LAMPS,
    )
    case.set_gid(gid)
    shown = palette.LIGHT_TINTS.get(light, palette.LIGHT_TINTS["unknown"])
    spots = [
        Circle(
            (x, y + offset * height),
            width * 0.3,
            facecolor=colour,
            linewidth=0.0,
            zorder=layers.LAMPS + 0.1,
        )
        for colour, offset in zip(shown, (0.31, 0.0, -0.31), strict=True)
    ]
    return [case, *spots]


def _paint_lamp(stage: Stage, body: Body) -> None:
    for patch in lamps(body.x, body.y, body.light, stage.metre, f"node-{body.node}"):
        stage.page.add(stage.axes, patch)


def _paint_dot(stage: Stage, body: Body, colour: str, edge: dict[str, Any]) -> None:
    _paint_velocity(stage, body, colour)
    reach = max(0.3, _DOT * stage.metre)
    angles = np.linspace(0.0, 2 * math.pi, 33)
    dot = np.column_stack((np.cos(angles), np.sin(angles))) * reach + (body.x, body.y)
    stage.fill(Outline(dot, closed=True), colour, z=layers.BODIES, **edge)
    if not math.isnan(body.angle):
        nose = turned(np.array(((0.0, 0.0), (reach, 0.0))), body)
        stage.lines([nose], palette.PAPER, z=layers.BODIES + 0.1, width=0.9)


def _paint_velocity(stage: Stage, body: Body, colour: str) -> None:
    way = velocity_arrow(body)
    if way is None:
        return
    length = float(np.hypot(*way))
    tip = np.array((body.x, body.y)) + way
    head = min(3.2 * stage.metre, length / 2)
    ahead = way / length
    aside = np.array((-ahead[1], ahead[0]))
    barbs = np.array((tip - head * (ahead - 0.6 * aside), tip, tip - head * (ahead + 0.6 * aside)))
    shaft = np.array(((body.x, body.y), tip))
    look = {"capstyle": "round", "joinstyle": "round"}
    stage.lines([shaft, barbs], palette.PAPER, z=layers.ARROWS, width=2.4, alpha=0.7, **look)
    stage.lines([shaft, barbs], colour, z=layers.ARROWS + 0.1, width=1.1, alpha=0.85, **look)


def _windscreen(stage: Stage, body: Body) -> Outline:
    """Return the outline of a vehicle's windscreen: a wedge near the front that shows the heading."""
    corners = outline(body, SMALLEST * stage.metre)
    front, rear = corners[:2].mean(axis=0), corners[2:4].mean(axis=0)
    aside = (corners[0] - corners[1]) * 0.34
    length = max(float(np.hypot(*(rear - front))), 1e-9)
    tip = front + 0.10 * (rear - front)
    back = tip + min(0.32, 1.6 / length) * (rear - front)
    return Outline(np.array((tip, back + aside, back - aside, tip)))


def _sign(stage: Stage, body: Body) -> Outline:
    sides = {"stop_sign": 8, "yield_sign": 3, "speed_limit": 24}.get(body.kind, 4)
    turn = {8: math.pi / 8, 3: -math.pi / 2}.get(sides, math.pi / 4)
    angles = turn + np.linspace(0.0, 2 * math.pi, sides + 1)
    shape = np.column_stack((np.cos(angles), np.sin(angles))) * _SIGN * stage.metre
    return Outline(shape + np.array((body.x, body.y)), closed=True)
