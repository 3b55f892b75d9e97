"""How much a selection keeps after each of its units, beside units in random order."""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.coverage.tables import Table
from sgstore.errors import ConfigError
from sgstore.selection.units import kept

if TYPE_CHECKING:
    from sgstore.selection.choose import Selection
    from sgstore.world import Floats, Ints

POINTS: Final = 60
"""Rows of a curve."""

ORDERS: Final = 1_000
"""Random orders that are gone through, fewer where units hold much."""

_WORK: Final = 30_000_000
"""Memberships that random orders may look at, all together."""


@dataclass(frozen=True)
class Curve:
    """What is kept by so many units.

    Attributes
    ----------
    table : Table
        ``units``, ``kept`` by those that were selected first, ``share`` of all, and ``at_random``: how much so
        many units drawn at random keep in the mean, exactly.
    needed : int
        Units that were selected until nothing more is kept.
    at_random : float
        How many units in random order it takes, in the mean, to keep as much as the selection does in the end:
        over ``orders`` orders.
    orders : int
    """

    table: Table
    needed: int
    at_random: float
    orders: int


def curve(selection: Selection, points: int = POINTS) -> Curve:
    """The curve of a selection that keeps classes or combinations.

    Raises
    ------
    ConfigError
        It was not chosen by what it keeps.
    """
    held, units = selection.holdings, selection.units
    if not len(units):
        return Curve(
            Table(("units", "kept", "share", "at_random"), [], list(selection.said)), 0, 0.0, 0
        )
    if held is None:
        raise ConfigError("a curve shows what is kept: say --minimal, --per-class or --rarest")
    elements, total, pairs = held.total, len(units), held.pairs
    so_far = kept(pairs, held.weight, selection.picked, total)
    often = np.bincount(pairs[1], minlength=len(held.weight))
    n = np.unique(np.concatenate([_spread(len(so_far), points), _spread(total, points)]))
    n = n[n <= total]
    random = expected(often, total, n, held.weight)
    rows = [
        (
            many,
            int(so_far[many - 1]) if many <= len(so_far) else None,
            so_far[many - 1] / max(elements, 1) if many <= len(so_far) else None,
            float(at_random),
        )
        for many, at_random in zip(n.tolist(), random.tolist(), strict=True)
    ]
    reached = int(so_far[-1]) if len(so_far) else 0
    needed = int(np.searchsorted(so_far, reached)) + 1 if len(so_far) else 0
    mean, orders = random_need(pairs, held.weight, total, reached, selection.wish.seed)
    said = [
        f"{needed} {units.piece}s keep {reached} of {elements} {held.kind}; in random order that takes"
        f" {mean:.1f} of {total} (mean of {orders} orders)"
    ]
    return Curve(Table(("units", "kept", "share", "at_random"), rows, said), needed, mean, orders)


def _spread(most: int, points: int) -> Ints:
    if not most:
        return np.zeros(0, np.int64)
    return np.unique(np.linspace(1, most, min(points, most)).round().astype(np.int64))


def expected(often: Ints, units: int, drawn: Ints, weight: Ints | None = None) -> Floats:
    """How many elements so many units hold in the mean, drawn without putting them back.

    An element that m of N units hold is missed by n of them in C(N - m, n) of C(N, n) cases (hypergeometric).

    Parameters
    ----------
    often : (E,) int64
        In how many units each element is.
    units : int
        N.
    drawn : (K,) int64
        Numbers of units, at most N.
    weight : (E,) int64, optional
        How many elements each stands for.
    """
    logs = np.array([lgamma(i + 1) for i in range(units + 1)])
    found = np.zeros(len(drawn))
    stands_for = np.bincount(often, weight, units + 1)
    for many in np.flatnonzero(stands_for).tolist():
        rest = units - many - drawn
        missed = logs[units - many] - logs[np.maximum(rest, 0)] - logs[units] + logs[units - drawn]
        found += stands_for[many] * np.where(rest >= 0, 1 - np.exp(np.minimum(missed, 0)), 1.0)
    return found


def random_need(pairs: Ints, weight: Ints, units: int, wanted: int, seed: int) -> tuple[float, int]:
    """How many units in random order it takes to hold so many elements: the mean, and over how many orders."""
    if not wanted:
        return 0.0, 0
    order = np.argsort(pairs[1], kind="stable")
    unit = pairs[0][order]
    starts = np.flatnonzero(np.append(True, np.diff(pairs[1][order]) != 0))
    own = weight[pairs[1][order][starts]]
    orders = int(np.clip(_WORK // max(len(unit), 1), 20, ORDERS))
    rng = np.random.Generator(np.random.PCG64(seed))
    needed = np.empty(orders)
    for number in range(orders):
        place = rng.permutation(units)
        first = np.minimum.reduceat(place[unit], starts)
        in_order = np.argsort(first)
        enough = int(np.searchsorted(np.cumsum(own[in_order]), wanted))
        needed[number] = first[in_order[enough]] + 1
    return float(needed.mean()), orders
