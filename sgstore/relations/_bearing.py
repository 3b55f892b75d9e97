"""Direction of a related body as another sees it: ahead, behind, to the left, to the right.

An edge goes from what is seen to who sees: *b is in direct front of a* is b → a, by the bearing of b's
centre in a's axes. Where a's heading is missing there is no edge.

Bounds and noise. A bound belongs to the sector nearer to dead ahead (45° is still direct front), and dead
ahead and dead behind are neither left nor right, unless the settings say otherwise. Poses come through
quaternions, degrees and the rotation of axes, and are kept as float32, so what is exactly on a bound in the
world arrives up to some 1e-7 rad and a tenth of a millimetre beside it. Otherwise what is dead ahead would
flicker between left and right: a bearing within :data:`NOISE` of a bound counts as on it, and what is less than
:data:`BESIDE` off the axis as on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.relations._pairs import are_of_kinds
from sgstore.relations._scene import BlockScene, Relation, edges_between
from sgstore.vocabulary import DIRECTIONS, RELATION_CODE, SIDES

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges
    from sgstore.world import Bools, Floats


NOISE: Final = 1e-6
"""Differences of bearing that mean nothing: a millimetre at a kilometre; rad."""

BESIDE: Final = 1e-3
"""What is not farther off the axis is neither left nor right; m."""


def _seen(scene: BlockScene) -> Bools:
    """Mask of the pairs that the settings tell directions of, and whose bearing is known."""
    settings, pairs = scene.config.direction, scene.pairs
    seen = ~np.isnan(pairs.bearing)
    if settings.within > 0:
        seen &= pairs.distance <= settings.within
    if settings.kinds:
        seen &= are_of_kinds(scene.bodies, scene.ego, (pairs.a, pairs.b), settings.kinds)
    return seen


def _direction_edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.direction, scene.pairs
    seen = np.flatnonzero(_seen(scene) & bool(settings.names))
    bounds = np.radians(settings.upper) + NOISE
    bearing = pairs.bearing[seen]
    sector = np.searchsorted(bounds, np.abs(bearing))
    tie = np.abs(bearing) >= np.append(bounds, np.inf)[sector] - 2 * NOISE
    if settings.ties == "carlasgg":
        sector += tie & _behind(bearing)
    elif settings.ties == "both":
        seen = np.concatenate([seen, seen[tie]])
        sector = np.concatenate([sector, sector[tie] + 1])
    codes = np.array([RELATION_CODE[name] for name in settings.names], np.int8)
    return edges_between(scene, codes[sector], pairs.b[seen], pairs.a[seen])


def _behind(bearing: Floats) -> Bools:
    """Mask of bearings that CARLASGG, at a bound, takes for the sector behind: from abeam right backwards.

    It looks through its sectors in the order direct front, side front, direct rear, side rear, all of which
    hold both their bounds. Abeam to the left is 180° in its count; abeam to the right is 360°, not 0°.
    """
    aside = np.abs(bearing) - np.pi / 2
    return (aside > NOISE) | ((aside >= -NOISE) & (bearing < 0))


def _side_edges(scene: BlockScene) -> Edges:
    if scene.config.direction.sides == "none":
        none = np.zeros(0, np.intp)
        return edges_between(scene, SIDES[0], none, none)
    bodies, pairs = scene.bodies, scene.pairs
    dx, dy = bodies.x[pairs.b] - bodies.x[pairs.a], bodies.y[pairs.b] - bodies.y[pairs.a]
    off_axis = np.sqrt(dx * dx + dy * dy) * np.abs(np.sin(pairs.bearing))
    if scene.config.direction.sides == "closed":  # to the last bit, as CARLASGG has it
        aside = np.flatnonzero(_seen(scene))
    else:
        aside = np.flatnonzero(_seen(scene) & (off_axis > BESIDE))
    left, right = (RELATION_CODE[name] for name in SIDES)
    codes = np.where(pairs.bearing[aside] >= 0, left, right).astype(np.int8)
    return edges_between(scene, codes, pairs.b[aside], pairs.a[aside])


def sector(name: str, legend: str = "") -> Relation:
    """The relation of a sector, by its name."""

    def asked(config: Config) -> bool:
        return name in config.direction.names

    doc = "b → a: the bearing of b, seen from a, lies in this sector of `[direction]`"
    return Relation(
        name=name, doc=doc, edges=_direction_edges, of_pairs=True, settings=asked, legend=legend
    )


IN_DIRECT_FRONT_OF, IN_SIDE_FRONT_OF, AT_SIDE_REAR_OF, AT_DIRECT_REAR_OF = map(
    sector, DIRECTIONS, ("ahead", "ahead, to the side", "behind, to the side", "behind")
)


def _side(name: str, side: str) -> Relation:
    return Relation(
        name=name,
        doc=f"b → a: b is to the {side} of a; lane → lane: its neighbour to the {side}",
        edges=_side_edges,
        of_map=True,
        of_pairs=True,
        settings=lambda config: config.direction.sides != "none",
    )


TO_LEFT_OF, TO_RIGHT_OF = map(_side, SIDES, ("left", "right"))
