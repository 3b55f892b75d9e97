"""Which bodies are related, and the numbers of those pairs that the families need."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.geometry import bearings, gap
from sgstore.relations.scene import IS_SIGNAL, Bodies, Pairs, kinds_mask, spread
from sgstore.relations.sweep import parts
from sgstore.vocabulary import KIND_CODE, KINDS, VEHICLES, folded, kinds_labelled

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.config import Config
    from sgstore.config import Pairs as PairSettings
    from sgstore.world import Bools, Floats

    Rows = NDArray[np.intp]
    Halves = tuple[Rows, Rows]

CELLS: Final = 8
"""Strips of the plane to the distance within which bodies are related: more of them cut a little sharper."""

FAR: Final = 1 << 40
"""Strips from the origin beyond which positions share a strip: keys fit into 64 bits whatever a trace holds."""


IS_VEHICLE: Final = kinds_mask(VEHICLES)

NO_PAIRS: Final[Halves] = (np.zeros(0, np.intp), np.zeros(0, np.intp))


def if_related(config: Config, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of relations of pairs: none where the config relates no pairs, so that nothing is known of them."""
    return names if config.pairs.ego or config.pairs.within > 0 else ()


def near_pairs(bodies: Bodies, config: Config) -> Halves:
    """Each unordered pair of bodies that move, signals excepted, and are near enough to one another."""
    return pairs_among(bodies, np.flatnonzero(bodies.moves & ~IS_SIGNAL[bodies.kind]), config)


def pairs_among(bodies: Bodies, rows: Rows, config: Config) -> Halves:
    """Each unordered pair of some rows that share a frame and are near enough to one another."""
    within, between = config.pairs.within, config.proximity.between
    if within <= 0:
        return NO_PAIRS
    return joined_pairs([NO_PAIRS, *_near_pairs(bodies, rows, within, between)])


def related_pairs(bodies: Bodies, ego: Rows, near: Halves, config: Config) -> Pairs:
    """All pairs that the settings relate: the ego with every body, and moving bodies near one another.

    Parameters
    ----------
    bodies : Bodies
    ego : (F,) intp
        Row of the ego of each frame, -1 where there is none.
    near : tuple of intp arrays
        Other pairs: bodies that are near one another.
    config : Config
        Signals and scenery are related to the ego only, unless the settings relate what never moves to its
        like (:mod:`sgstore.relations.still`). What has no position is near nothing; the ego is related to it
        all the same, by numbers that are missing, unless there is a distance for the ego too.
    """
    settings, between = config.pairs, config.proximity.between
    if not settings.ego:
        return _with_mirror_images(bodies, *of_kinds(bodies, ego, near, settings), between)
    mine = ego[bodies.frame]
    others = np.flatnonzero((mine >= 0) & (mine != np.arange(len(bodies))))
    a, b = near
    further = (ego[bodies.frame[a]] != a) & (ego[bodies.frame[b]] != b)
    with_ego = mine[others], others
    if settings.ego_within > 0:
        close = distances(bodies, *with_ego, between) <= settings.ego_within
        with_ego = with_ego[0][close], with_ego[1][close]
    halves = of_kinds(bodies, ego, joined_pairs([with_ego, (a[further], b[further])]), settings)
    return _with_mirror_images(bodies, *halves, between)


def of_kinds(bodies: Bodies, ego: Rows, pairs: Halves, settings: PairSettings) -> Halves:
    """The pairs of the kinds that the settings list, in either order."""
    if not settings.kinds:
        return pairs
    listed = np.zeros((len(KINDS) + 1, len(KINDS) + 1), np.bool_)  # the last one: the ego
    for one, other in settings.kinds:
        listed[np.ix_(_codes(one), _codes(other))] = True
    listed |= listed.T
    a, b = pairs
    of_a, of_b = bodies.kind[a].astype(np.intp), bodies.kind[b].astype(np.intp)
    kept = listed[of_a, of_b]
    kept |= listed[-1, of_b] & (ego[bodies.frame[a]] == a)
    kept |= listed[of_a, -1] & (ego[bodies.frame[b]] == b)
    return a[kept], b[kept]


def _codes(label: str) -> list[int]:
    if folded(label) == "ego":
        return [len(KINDS)]
    return [KIND_CODE[kind] for kind in kinds_labelled(label) or ()]


def joined_pairs(halves: list[Halves]) -> Halves:
    """One list of pairs after another."""
    return np.concatenate([a for a, _ in halves]), np.concatenate([b for _, b in halves])


def _near_pairs(
    bodies: Bodies, rows: Rows, within: float, between: str
) -> Iterator[tuple[Rows, Rows]]:
    """Each unordered pair of these rows that share a frame and are at most so far apart.

    The rows are sorted by frame and by strips across the x axis. The candidates of a row are those after it in
    its own strip and in the few that follow: a range of the sorted rows.
    """
    rows = rows[np.isfinite(bodies.x[rows])]
    reach = within
    if between == "footprints":
        reach += float(np.nan_to_num(np.hypot(bodies.length, bodies.width)[rows]).max(initial=0))
    strip = np.clip(np.floor(bodies.x[rows] * (CELLS / reach)), -FAR, FAR).astype(np.int64)
    key = (bodies.frame[rows] << 43) + strip + FAR
    order = np.argsort(key, kind="stable")
    rows, key = rows[order], key[order]
    start = np.arange(1, len(rows) + 1)
    # One strip more than the distance is wide: the division above may round up.
    count = np.searchsorted(key, key + CELLS + 1, side="right") - start
    for part in parts(count):
        owner, index = spread(start[part], count[part])
        first, second = rows[part][owner], rows[index]
        near = distances(bodies, first, second, between) <= within
        yield first[near], second[near]


def distances(bodies: Bodies, a: Rows, b: Rows, between: str) -> Floats:
    """Distances of pairs of bodies, as :attr:`sgstore.config.Proximity.between` says; m.

    The origin of a vehicle that moves is on the ground, that of anything else in the centre of its box: where
    CARLA has them, as far as a recording tells. A footprint without extent or heading is a point.
    """
    if between == "footprints":
        boxes = bodies.boxes
        boxes[np.isnan(boxes).any(axis=1), 2:] = 0
        return gap(boxes[a], boxes[b])
    z = bodies.z
    if between == "origins":
        on_ground: Bools = bodies.moves & IS_VEHICLE[bodies.kind]
        z = np.where(on_ground, bodies.bottom, z)
    dx, dy, dz = (of[b] - of[a] for of in (bodies.x, bodies.y, z))
    return np.sqrt(dx * dx + dy * dy + dz * dz)


def _with_mirror_images(bodies: Bodies, a: Rows, b: Rows, between: str) -> Pairs:
    distance = distances(bodies, a, b, between)
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    bearing = bearings(bodies.x[b] - bodies.x[a], bodies.y[b] - bodies.y[a], bodies.heading[a])
    return Pairs(a, b, np.concatenate([distance, distance]), bearing)
