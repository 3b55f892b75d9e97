"""Pairs of objects that touch or overlap, such as collisions in a simulator.

Footprints touch if their gap is 0. Boxes must also touch in height: a car under a bridge touches
nothing. If a height is missing, both must be on one storey (:data:`sgstore.model.pair_numbers.STOREY`).
If the vertical position is missing, only the footprints count. A body without a footprint or with
height 0 (paint on the road) touches nothing. A carried body does not touch its carrier. At least
one of the two must move, and neither may be a signal, because the boxes of signals hang over the
road.

The greatest distance of related pairs has no effect here; the setting for pairs without an ego has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.geometry import offsets
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    Relation,
    edges_between,
    heights_meet,
    meeting,
    relates_pairs,
    solid_pairs,
)
from sgstore.model.pair_numbers import TOUCH, gap

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.graphs.relations._scene import BlockScene, Bodies
    from sgstore.model.graph import Edges
    from sgstore.model.world import Bools, Floats

    Rows = NDArray[np.intp]


SURE: Final = 1e-4
"""Difference from the limit above which the quick test of a separation is certain; m."""

PLAIN: Final = 1e8
"""Limit of positions (m) and headings (rad) up to which the quick test of distance is exact enough."""


def contacts(bodies: Bodies, unwanted: Bools) -> Iterator[tuple[Rows, Rows]]:
    """Yield each pair of objects that touch in a frame.

    Parameters
    ----------
    bodies : Bodies
    unwanted : (F,) bool
        Frames to skip; the caller may change it between chunks.

    Yields
    ------
    a, b : intp
        Rows, in chunks.
    """
    rows = np.flatnonzero(~IS_SIGNAL[bodies.kind])
    length, width = bodies.length[rows] / 2, bodies.width[rows] / 2
    cos, sin = np.abs(np.cos(bodies.heading[rows])), np.abs(np.sin(bodies.heading[rows]))
    x, y = bodies.x[rows], bodies.y[rows]
    reach_x, reach_y = cos * length + sin * width + TOUCH, sin * length + cos * width + TOUCH
    frame = bodies.frame[rows]
    for a, b in meeting(frame, x - reach_x, x + reach_x):
        if unwanted[frame[a]].all():
            continue
        close = np.abs(y[b] - y[a]) <= reach_y[a] + reach_y[b]
        yield _touching(bodies, rows[a[close]], rows[b[close]])


def contacts_of(bodies: Bodies, ego: Rows, frames: Bools) -> tuple[Rows, Rows]:
    """Return pairs (ego, object) that touch or overlap, in the given frames."""
    mine = ego[bodies.frame]
    near = frames[bodies.frame] & (mine >= 0) & (mine != np.arange(len(bodies)))
    others = np.flatnonzero(near & ~IS_SIGNAL[bodies.kind])
    return _touching(bodies, mine[others], others)


def _touching(bodies: Bodies, a: Rows, b: Rows) -> tuple[Rows, Rows]:
    """Return the pairs of objects that touch or overlap, also in height if it is known."""
    close = bodies.moves[a] | bodies.moves[b]
    a, b = a[close], b[close]
    level = solid_pairs(bodies, a, b) & heights_meet(bodies, a, b)
    a, b = a[level], b[level]
    apart = _separation(bodies, a, b)
    touch = apart < -SURE
    near = np.flatnonzero(~(touch | (apart > TOUCH + SURE)))
    touch[near] = gap(bodies.take(a[near]).boxes, bodies.take(b[near]).boxes) <= TOUCH
    return a[touch], b[touch]


def _separation(bodies: Bodies, a: Rows, b: Rows) -> Floats:
    """Return the separation of two footprints (ground rectangles); m. Negative if they overlap.

    The gap is at least as large. NaN if rounding or a missing size requires the exact gap.
    """
    dx, dy = bodies.x[b] - bodies.x[a], bodies.y[b] - bodies.y[a]
    heading, length, width = bodies.heading, bodies.length / 2, bodies.width / 2
    cos, sin = np.cos(heading[b] - heading[a]), np.sin(heading[b] - heading[a])
    cos, sin = np.abs(cos), np.abs(sin)
    apart = np.full(len(a), -np.inf)
    for one, other in ((a, b), (b, a)):
        ahead, left = offsets(dx, dy, heading[one])
        apart = np.maximum(
            apart, np.abs(ahead) - length[one] - cos * length[other] - sin * width[other]
        )
        apart = np.maximum(
            apart, np.abs(left) - width[one] - sin * length[other] - cos * width[other]
        )
    plain = np.abs(bodies.x) + np.abs(bodies.y) + np.abs(heading) < PLAIN
    plain &= (length >= 0) & (width >= 0)
    return np.where(plain[a] & plain[b], apart, np.nan)


def _edges(scene: BlockScene) -> Edges:
    settings, (a, b) = scene.config.pairs, scene.contacts
    if not settings.within > 0:
        mine = scene.ego[scene.bodies.frame[a]]
        kept = ((mine == a) | (mine == b)) & settings.ego
        a, b = a[kept], b[kept]
    return edges_between(scene, "overlaps", np.concatenate([a, b]), np.concatenate([b, a]))


OVERLAPS = Relation(
    name="overlaps",
    doc="entity ↔ entity: their boxes meet, in the plane and in height: a collision, in a simulator;"
    " of nothing flat, and of no trailer or rider with its vehicle",
    edges=_edges,
    symmetric=True,
    settings=relates_pairs,
    legend="footprints touch",
)
