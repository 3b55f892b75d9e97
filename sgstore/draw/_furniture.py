"""Aids to read a picture of the ground: rings about the ego, a scale, a compass."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.patches import Circle
from matplotlib.path import Path as Outline

import sgstore.draw._page as layers
import sgstore.draw._palette as palette

if TYPE_CHECKING:
    from sgstore.draw._labels import Rect
    from sgstore.draw._page import Stage


_LENGTHS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000)
_SMALL: Final = {"fontsize": 6.5, "ha": "center"}


def paint_rings(stage: Stage) -> list[Rect]:
    """Faint circles about the middle, for the eye to measure by; returns the room of their figures."""
    taken: list[Rect] = []
    for metres in (10, 25, 50, 100, 200):
        if metres > stage.view.radius * 1.05:
            break
        ring = Circle(
            (0, 0),
            metres,
            fill=False,
            edgecolor=palette.RING,
            linewidth=0.5,
            linestyle=(0, (2, 4)),
            zorder=layers.RINGS,
        )
        stage.axes.add_artist(ring)
        at = metres * math.sqrt(0.5)
        look = _SMALL | {"fontsize": 5.5, "color": palette.FAINT_INK, "va": "center"}
        stage.text(at, -at, f"{metres} m", zorder=layers.RINGS, **look)
        taken.append(stage.rect(9 * stage.metre, 4 * stage.metre, (at, -at)))
    return taken


def paint_scale(stage: Stage) -> Rect:
    """A bar of a round length in the lower left corner; returns the room it takes."""
    half_x, half_y = stage.half
    metres = max(m for m in _LENGTHS if m <= max(1.0, min(half_x, half_y) / 2.2))
    margin, tick = 12 * stage.metre, 3 * stage.metre
    left, bottom, right = -half_x + margin, -half_y + margin, -half_x + margin + metres
    bar = ((left, bottom + tick), (left, bottom), (right, bottom), (right, bottom + tick))
    stage.lines([np.array(bar)], palette.INK, z=layers.FURNITURE, width=1.1)
    stage.text((left + right) / 2, bottom + tick, f"{metres} m", zorder=layers.FURNITURE, **_SMALL)
    return stage.rect(metres / 2, 8 * stage.metre, ((left + right) / 2, bottom))


def paint_compass(stage: Stage) -> Rect:
    """A needle to the north in the upper right corner; returns the room it takes."""
    reach = min(11 * stage.metre, 0.05 * min(stage.half))
    middle = np.array(stage.half) - 1.8 * reach
    angle = stage.view.angle(math.pi / 2)
    north = np.array((math.cos(angle), math.sin(angle))) * reach
    aside = np.array((-north[1], north[0]))
    x, y = middle.tolist()
    dial = Circle(
        (x, y), 1.55 * reach, facecolor=palette.PAPER, alpha=0.75, zorder=layers.FURNITURE
    )
    stage.axes.add_artist(dial)
    for colour, wing in ((palette.INK, 0.45 * aside), (palette.FAINT_INK, -0.45 * aside)):
        half = np.array((0.75 * north, -north + wing, -0.65 * north))
        stage.fill(Outline(middle + half), colour, z=layers.FURNITURE + 0.1)
    x_n, y_n = (middle + 1.12 * north).tolist()
    look = {"fontsize": 0.6 * reach * stage.points, "ha": "center", "va": "center"}
    stage.text(x_n, y_n, "N", zorder=layers.FURNITURE + 0.2, weight="bold", **look)
    return stage.rect(1.6 * reach, 1.6 * reach, (x, y))
