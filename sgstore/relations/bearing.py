"""Where a related body is, seen from another: ahead, behind, to the left, to the right.

An edge goes from what is seen to who sees: *b is in direct front of a* is b → a, by the bearing of b's
centre in a's axes. Where a's heading is missing there is no edge.

Bounds and noise. A bound belongs to the sector nearer to dead ahead (45° is still direct front), and dead
ahead and dead behind are neither left nor right. Headings come through quaternions, degrees and the rotation
of axes, so what is exactly on a bound in the world arrives some 1e-16 to 1e-12 rad beside it: a bearing
within :data:`NOISE` of a bound counts as on it. Otherwise what is dead ahead would flicker between left and
right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.relations.pairs import if_related
from sgstore.relations.scene import Family, Scene, edges_between
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges

NOISE: Final = 1e-9
"""Differences of bearing that mean nothing: a micrometre at a kilometre; rad."""

SIDES: Final = ("toLeftOf", "toRightOf")


def _direction_names(config: Config) -> tuple[str, ...]:
    return if_related(config, config.direction.names)


def _direction_edges(scene: Scene) -> Edges:
    settings, pairs = scene.config.direction, scene.pairs
    seen = np.flatnonzero(~np.isnan(pairs.bearing) & bool(settings.names))
    bounds = np.radians(settings.upper) + NOISE
    sector = np.searchsorted(bounds, np.abs(pairs.bearing[seen]))
    codes = np.array([RELATION_CODE[name] for name in settings.names], np.int8)
    return edges_between(scene, codes[sector], pairs.b[seen], pairs.a[seen])


def _side_names(config: Config) -> tuple[str, ...]:
    return if_related(config, SIDES)


def _side_edges(scene: Scene) -> Edges:
    pairs = scene.pairs
    off_axis = np.abs(np.abs(pairs.bearing) - np.pi / 2) < np.pi / 2 - NOISE
    aside = np.flatnonzero(off_axis)
    left, right = (RELATION_CODE[name] for name in SIDES)
    codes = np.where(pairs.bearing[aside] > 0, left, right).astype(np.int8)
    return edges_between(scene, codes, pairs.b[aside], pairs.a[aside])


DIRECTION = Family(_direction_names, needs_map=False, edges=_direction_edges)
SIDE = Family(_side_names, needs_map=False, edges=_side_edges)
