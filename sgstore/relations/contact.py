"""Which bodies touch or overlap: a collision, in a simulator.

Footprints meet where their gap is 0, and boxes meet where they do so in height too: a car under a bridge
touches nothing. Where a height is missing, what counts is the storey (:data:`sgstore.roads.STOREY`), and where
the place in height is missing, nothing but the footprints. What has no footprint touches nothing. One of the
two moves at least, and neither is a signal: signals hang over the road as boxes that mean no body.

It does not depend on how far apart related pairs may be, only on whether pairs that are no ego's are related
at all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.geometry import gap
from sgstore.relations.pairs import if_related
from sgstore.relations.scene import IS_SIGNAL, Family, edges_between
from sgstore.relations.sweep import meeting
from sgstore.roads import STOREY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.config import Config
    from sgstore.graph import Edges
    from sgstore.relations.scene import Bodies, Scene
    from sgstore.world import Bools, Floats

    Rows = NDArray[np.intp]

TOUCH: Final = 1e-4
"""Gap that means nothing: rounding of positions far from the origin; m."""


def contacts(bodies: Bodies) -> tuple[Rows, Rows]:
    """Each unordered pair of bodies of a frame that touch."""
    rows = np.flatnonzero(~IS_SIGNAL[bodies.kind])
    length, width = bodies.length[rows] / 2, bodies.width[rows] / 2
    cos, sin = np.abs(np.cos(bodies.heading[rows])), np.abs(np.sin(bodies.heading[rows]))
    x, y = bodies.x[rows], bodies.y[rows]
    reach_x, reach_y = cos * length + sin * width + TOUCH, sin * length + cos * width + TOUCH
    found: list[tuple[Rows, Rows]] = [(rows[:0], rows[:0])]
    for a, b in meeting(bodies.frame[rows], x - reach_x, x + reach_x):
        close = bodies.moves[rows[a]] | bodies.moves[rows[b]]
        close &= np.abs(y[b] - y[a]) <= reach_y[a] + reach_y[b]
        first, second = rows[a[close]], rows[b[close]]
        first, second = (end[_same_height(bodies, first, second)] for end in (first, second))
        touch = gap(_boxes(bodies, first), _boxes(bodies, second)) <= TOUCH
        found.append((first[touch], second[touch]))
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


def _boxes(bodies: Bodies, rows: Rows) -> Floats:
    columns = (bodies.x, bodies.y, bodies.heading, bodies.length, bodies.width)
    return np.stack([column[rows] for column in columns], axis=1)


def _same_height(bodies: Bodies, a: Rows, b: Rows) -> Bools:
    """Whether boxes meet in height, as far as it is known."""
    apart = np.abs(bodies.z[b] - bodies.z[a])
    reach = (bodies.height[a] + bodies.height[b]) / 2 + TOUCH
    bottoms = np.abs(bodies.bottom[b] - bodies.bottom[a])
    return ~np.where(np.isnan(reach), bottoms > STOREY, apart > reach)


def _names(config: Config) -> tuple[str, ...]:
    return if_related(config, ("overlaps",))


def _edges(scene: Scene) -> Edges:
    settings, (a, b) = scene.config.pairs, scene.contacts
    if not settings.within > 0:
        mine = scene.ego[scene.bodies.frame[a]]
        kept = ((mine == a) | (mine == b)) & settings.ego
        a, b = a[kept], b[kept]
    return edges_between(scene, "overlaps", np.concatenate([a, b]), np.concatenate([b, a]))


CONTACT = Family(_names, needs_map=False, edges=_edges)
