"""Which bodies are related, and the numbers of those pairs that the families need."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.geometry import bearings
from sgstore.relations.scene import IS_SIGNAL, Bodies, Pairs, spread
from sgstore.relations.sweep import parts

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.config import Config
    from sgstore.config import Pairs as PairSettings

    Rows = NDArray[np.intp]
    Halves = tuple[Rows, Rows]

CELLS: Final = 8
"""Strips of the plane to the distance within which bodies are related: more of them cut a little sharper."""

FAR: Final = 1 << 40
"""Strips from the origin beyond which positions share a strip: keys fit into 64 bits whatever a trace holds."""


NO_PAIRS: Final[Halves] = (np.zeros(0, np.intp), np.zeros(0, np.intp))


def if_related(config: Config, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of relations of pairs: none where the config relates no pairs, so that nothing is known of them."""
    return names if config.pairs.ego or config.pairs.within > 0 else ()


def near_pairs(bodies: Bodies, within: float) -> Halves:
    """Each unordered pair of bodies that move, signals excepted, and are at most so far apart; m."""
    if within <= 0:
        return NO_PAIRS
    movers = np.flatnonzero(bodies.moves & ~IS_SIGNAL[bodies.kind])
    return _joined([NO_PAIRS, *_near_pairs(bodies, movers, within)])


def related_pairs(bodies: Bodies, ego: Rows, near: Halves, settings: PairSettings) -> Pairs:
    """All pairs that the settings relate: the ego with every body, and moving bodies near one another.

    Parameters
    ----------
    bodies : Bodies
    ego : (F,) intp
        Row of the ego of each frame, -1 where there is none.
    near : tuple of intp arrays
        Pairs of bodies that are near one another.
    settings : Pairs
        Signals and scenery are related to the ego only. What has no position is near nothing; the ego is
        related to it all the same, by numbers that are missing.
    """
    if not settings.ego:
        return _with_mirror_images(bodies, *near)
    mine = ego[bodies.frame]
    others = np.flatnonzero((mine >= 0) & (mine != np.arange(len(bodies))))
    a, b = near
    further = (ego[bodies.frame[a]] != a) & (ego[bodies.frame[b]] != b)
    first, second = _joined([(mine[others], others), (a[further], b[further])])
    return _with_mirror_images(bodies, first, second)


def _joined(halves: list[Halves]) -> Halves:
    return np.concatenate([a for a, _ in halves]), np.concatenate([b for _, b in halves])


def _near_pairs(bodies: Bodies, rows: Rows, within: float) -> Iterator[tuple[Rows, Rows]]:
    """Each unordered pair of these rows that share a frame and whose centres are at most so far apart.

    The rows are sorted by frame and by strips across the x axis. The candidates of a row are those after it in
    its own strip and in the few that follow: a range of the sorted rows.
    """
    rows = rows[np.isfinite(bodies.x[rows])]
    strip = np.clip(np.floor(bodies.x[rows] * (CELLS / within)), -FAR, FAR).astype(np.int64)
    key = (bodies.frame[rows] << 43) + strip + FAR
    order = np.argsort(key, kind="stable")
    rows, key = rows[order], key[order]
    start = np.arange(1, len(rows) + 1)
    # One strip more than the distance is wide: the division above may round up.
    count = np.searchsorted(key, key + CELLS + 1, side="right") - start
    for part in parts(count):
        owner, index = spread(start[part], count[part])
        first, second = rows[part][owner], rows[index]
        near = _distance(bodies, first, second) <= within
        yield first[near], second[near]


def _distance(bodies: Bodies, a: Rows, b: Rows) -> NDArray[np.float64]:
    dx, dy, dz = (of[b] - of[a] for of in (bodies.x, bodies.y, bodies.z))
    return np.sqrt(dx * dx + dy * dy + dz * dz)


def _with_mirror_images(bodies: Bodies, a: Rows, b: Rows) -> Pairs:
    distance = _distance(bodies, a, b)
    a, b = np.concatenate([a, b]), np.concatenate([b, a])
    bearing = bearings(bodies.x[b] - bodies.x[a], bodies.y[b] - bodies.y[a], bodies.heading[a])
    return Pairs(a, b, np.concatenate([distance, distance]), bearing)
