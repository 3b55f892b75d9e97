"""Direction relations: an object is ahead of, behind, left or right of another one.

An edge leads from the seen body to the viewer: *b is in direct front of a* is b → a, by the bearing
of b's centre in a's axes. Without a heading of a there is no edge.

Bounds and noise. A bound belongs to the sector nearer to straight ahead (45° is still direct
front). Straight ahead and straight behind are neither left nor right, unless the settings differ.
Poses pass through quaternions, degrees and rotated axes, and are stored as float32. Therefore a
body exactly on a bound arrives up to 1e-7 rad and a tenth of a millimetre off, and would flicker
between left and right. So a bearing within :data:`NOISE` of a bound counts as on it, and an offset
below :data:`BESIDE` counts as on the axis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.graphs.relations._pairs import are_of_kinds
from sgstore.graphs.relations._scene import (
    BlockScene,
    Relation,
    edges_between,
    edges_of_pairs,
    even_parts,
    span_up_to,
)
from sgstore.model.graph import Edges
from sgstore.model.vocabulary import DIRECTIONS, RELATION_CODE, SIDES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.graphs.relations._scene import BodyPairs, Columns
    from sgstore.model.config import Config, Direction
    from sgstore.model.world import Bools, Codes, Floats

    Rows = NDArray[np.intp]


NOISE: Final = 1e-6
"""Largest difference of bearings that count as equal: a millimetre at a kilometre; rad."""

BESIDE: Final = 1e-3
"""Distance from the lengthwise axis below which an object is neither left nor right; m."""


TINY: Final = np.float32(1e-30)
"""Distance below which 32-bit numbers underflow; m."""

DOUBT: Final = 4e-6
"""Distance from the limit of a sector within which the exact angle decides; greater than :data:`NOISE`; rad."""


# Vector products decide sectors and sides quickly. If a product is within rounding of a bound, or a
# value is missing, the bearing itself decides.


def _wanted(scene: BlockScene) -> Bools | None:
    """Return a mask of the object pairs that can have direction relations; ``None`` if all can."""
    settings, pairs = scene.config.direction, scene.pairs
    wanted: Bools | None = None
    if settings.within > 0:
        near = pairs.span <= span_up_to(settings.within, scene.config.proximity.between)
        wanted = np.concatenate([near, near])
    if settings.kinds:
        listed = are_of_kinds(scene.bodies, scene.ego, (pairs.a, pairs.b), settings.kinds)
        wanted = listed if wanted is None else wanted & listed
    return wanted


def _direction_edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.direction, scene.pairs
    if not settings.names:
        return Edges.chained([])
    names = np.array([RELATION_CODE[name] for name in settings.names], np.int8)
    bounds = np.radians(settings.upper) + NOISE
    bounds = np.sin(bounds), np.cos(bounds)
    if _in_loops(scene):
        from sgstore.graphs.relations import _loops

        columns, unsure = scene.room.rest(len(pairs)), np.empty(len(pairs), np.intp)
        many, doubtful = _loops.sectors(pairs.for_loops, bounds, names, DOUBT, columns, unsure)
        doubtful = unsure[:doubtful]
    else:
        columns, many, doubtful = _sectors(scene, bounds, names)
    rows, sectors = _by_bearing(settings, pairs, doubtful)
    return scene.room.filled(columns, many, _looking(scene, rows, names[sectors]))


def _in_loops(scene: BlockScene) -> bool:
    """Return True if compiled loops can compute the direction relations: no limit by distance or kind."""
    settings = scene.config.direction
    return scene.pairs.in_loops and not settings.kinds and not settings.within > 0


def _looking(scene: BlockScene, rows: Rows, codes: Codes) -> Edges:
    """Return edges b → a for some pairs (a, b). The relation of an edge is the direction of b, seen from a."""
    a, b = scene.pairs.some(rows)
    return edges_between(scene, codes, b, a)


def _sectors(
    scene: BlockScene, bounds: tuple[Floats, Floats], names: Codes
) -> tuple[Columns, int, Rows]:
    """Return the direction edges of all pairs, and those pairs near a limit that need an exact angle."""
    pairs = scene.pairs
    codes, holds = np.empty(len(pairs), np.int8), np.empty(len(pairs), np.bool_)
    ahead, left = pairs.offsets
    sines, cosines = (of.astype(np.float32) for of in bounds)
    for part in even_parts(len(pairs)):
        onward, aside = ahead[part], np.abs(left[part])
        sector, least = np.zeros(len(aside), np.int8), np.abs(onward) + aside
        reach = least * np.float32(DOUBT)
        for sin, cos in zip(sines, cosines, strict=True):
            # The distance times the sine of the angle up to the bound.
            short_of = sin * onward - cos * aside
            sector += short_of < 0
            least = np.minimum(least, np.abs(short_of))
        codes[part] = names[sector]
        holds[part] = least > reach + TINY
    wanted = _wanted(scene)
    doubtful = np.flatnonzero(~holds if wanted is None else ~holds & wanted)
    if wanted is not None:
        holds &= wanted
    return *edges_of_pairs(scene, codes, holds, seen_by_a=True), doubtful


def _by_bearing(settings: Direction, pairs: BodyPairs, rows: Rows) -> tuple[Rows, Rows]:
    """Return the direction relations of pairs by exact angle. A pair exactly on a limit can have two."""
    bearing = pairs.bearings(rows)
    known = ~np.isnan(bearing)
    rows, bearing = rows[known], bearing[known]
    bounds = np.radians(settings.upper) + NOISE
    sector = np.searchsorted(bounds, np.abs(bearing))
    tie = np.abs(bearing) >= np.append(bounds, np.inf)[sector] - 2 * NOISE
    if settings.ties == "carlasgg":
        sector += tie & _behind(bearing)
    elif settings.ties == "both":
        rows = np.concatenate([rows, rows[tie]])
        sector = np.concatenate([sector, sector[tie] + 1])
    return rows, sector


def _behind(bearing: Floats) -> Bools:
    """Return a mask of the angles that count as behind. Of ±90°, only the right side counts, as in CARLASGG.

    CARLASGG tests its sectors in the order direct front, side front, direct rear, side rear; all of
    them include both bounds. Straight left is 180° in its count; straight right is 360°, not 0°.
    """
    aside = np.abs(bearing) - np.pi / 2
    return (aside > NOISE) | ((aside >= -NOISE) & (bearing < 0))


def _side_edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.direction, scene.pairs
    if settings.sides == "none":
        return Edges.chained([])
    names = np.array([RELATION_CODE[name] for name in SIDES], np.int8)
    is_open = settings.sides == "open"
    if _in_loops(scene):
        from sgstore.graphs.relations import _loops

        columns, unsure = scene.room.rest(len(pairs)), np.empty(len(pairs), np.intp)
        beside = BESIDE if is_open else -1.0
        many, doubtful = _loops.sides(pairs.for_loops, beside, names, DOUBT, columns, unsure)
        doubtful = unsure[:doubtful]
    else:
        columns, many, doubtful = _sides(scene, names, is_open=is_open)
    bearing = pairs.bearings(doubtful)
    a, b = pairs.some(doubtful)
    dx, dy = (of[b] - of[a] for of in (scene.bodies.x, scene.bodies.y))
    off_axis = np.sqrt(dx * dx + dy * dy) * np.abs(np.sin(bearing))
    # Closed bounds, exact to the last bit, as in CARLASGG.
    holds = off_axis > BESIDE if is_open else ~np.isnan(bearing)
    codes = names[np.where(bearing[holds] >= 0, 0, 1)]
    return scene.room.filled(columns, many, _looking(scene, doubtful[holds], codes))


def _sides(scene: BlockScene, names: Codes, *, is_open: bool) -> tuple[Columns, int, Rows]:
    """Return the left and right edges of all pairs, and the pairs that need an exact angle."""
    pairs = scene.pairs
    ahead, left = pairs.offsets
    codes, beside = np.empty(len(pairs), np.int8), np.float32(BESIDE)
    holds, doubtful = np.empty((2, len(pairs)), np.bool_)
    for part in even_parts(len(pairs)):
        aside = np.abs(left[part])
        reach = (np.abs(ahead[part]) + aside) * np.float32(DOUBT) + TINY
        codes[part] = names[(left[part] < 0).view(np.int8)]
        doubtful[part] = ~((np.abs(aside - beside) if is_open else aside) > reach)
        holds[part] = ~doubtful[part] & (aside > beside) if is_open else ~doubtful[part]
    wanted = _wanted(scene)
    if wanted is not None:
        doubtful &= wanted
        holds &= wanted
    return *edges_of_pairs(scene, codes, holds, seen_by_a=True), np.flatnonzero(doubtful)


def sector(name: str, legend: str = "") -> Relation:
    """Return the direction relation with the given name, such as ``inFrontOf``."""

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
