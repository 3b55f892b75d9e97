"""Curve of a selection: elements kept after each of its units, beside units in random order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.coverage import ReportTable, expected_classes
from sgstore.errors import ConfigError
from sgstore.selection._units import Measure, kept

if TYPE_CHECKING:
    from sgstore.selection._choose import Selection
    from sgstore.selection._units import Holdings, Units
    from sgstore.world import Floats, Ints


POINTS: Final = 60
"""Rows of a curve."""

ORDERS: Final = 1_000
"""Random orders that are gone through, fewer where units hold much."""

_WORK: Final = 30_000_000
"""Memberships that random orders may look at, all together."""


@dataclass(frozen=True)
class Curve:
    """Elements that so many units keep.

    Attributes
    ----------
    table : ReportTable
        ``units``, ``kept`` by those that were selected first, ``share`` of all, and ``at_random``: how much so
        many units drawn at random keep in the mean, exactly.
    needed : int
        Units that were selected until nothing more is kept.
    at_random : float
        How many units in random order it takes, in the mean, to keep as much as the selection does in the end:
        over ``orders`` orders.
    spread : float
        Their standard deviation from one order to the next.
    orders : int
    at_random_s : float
        What as many cost together, where clips overlap: s, in the mean.
    """

    table: ReportTable
    needed: int
    at_random: float
    spread: float
    orders: int
    at_random_s: float = 0.0


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
            ReportTable(("units", "kept", "share", "at_random"), [], list(selection.said)),
            0,
            0.0,
            0.0,
            0,
        )
    if held is None:
        raise ConfigError("a curve shows what is kept: say --minimal, --per-class or --rarest")
    elements, total, pairs = held.total, len(units), held.pairs
    so_far = kept(pairs, held.weight, selection.picked, total)
    often = np.bincount(pairs[1], minlength=len(held.weight))
    n = np.unique(np.concatenate([_points(len(so_far), points), _points(total, points)]))
    n = n[n <= total]
    random = expected_classes(often, n, total, held.weight)
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
    need, seconds = random_need(units, held, reached, selection.spec.seed)
    own = selection.result.get("seconds", 0.0)
    said = [
        f"{needed} {units.unit}s{f' ({own:.1f} s)' if own else ''} keep {reached} of {elements} {held.kind};"
        f" in random order that takes {need.mean():.1f} ± {need.std():.1f} of {total}"
        f"{f' ({seconds:.1f} s)' if seconds else ''} (mean and standard deviation of {len(need)} orders)"
    ]
    table = ReportTable(("units", "kept", "share", "at_random"), rows, said)
    return Curve(table, needed, float(need.mean()), float(need.std()), len(need), seconds)


def _points(most: int, points: int) -> Ints:
    if not most:
        return np.zeros(0, np.int64)
    return np.unique(np.linspace(1, most, min(points, most)).round().astype(np.int64))


def random_need(units: Units, held: Holdings, wanted: int, seed: int) -> tuple[Floats, float]:
    """Number of units in random order that it takes to hold so many elements.

    Returns
    -------
    needed : (K,) float64
        Of K orders.
    seconds : float
        How long these are together in the mean, if units overlap; else 0.
    """
    if not wanted:
        return np.zeros(1), 0.0
    pairs, weight = held.pairs, held.weight
    order = np.argsort(pairs[1], kind="stable")
    unit = pairs[0][order]
    starts = np.flatnonzero(np.append(True, np.diff(pairs[1][order]) != 0))
    own = weight[pairs[1][order][starts]]
    orders = int(np.clip(_WORK // max(len(unit), 1), 20, ORDERS))
    period = units.weights(Measure.seconds) if units.overlap else None
    rows = np.arange(len(units.frame_id))
    holding = [
        np.searchsorted(units.end, rows, side="right"),
        np.searchsorted(units.begin, rows, side="right"),
    ]
    ranges = np.stack(holding, axis=1).ravel()
    rng = np.random.Generator(np.random.PCG64(seed))
    needed, seconds = np.empty(orders), 0.0
    for number in range(orders):
        place = rng.permutation(len(units))
        first = np.minimum.reduceat(place[unit], starts)
        in_order = np.argsort(first)
        enough = int(np.searchsorted(np.cumsum(own[in_order]), wanted))
        needed[number] = first[in_order[enough]] + 1
        if period is not None:
            there = np.minimum.reduceat(np.append(place, 0), ranges)[::2] < needed[number]
            seconds += float(period[there].sum())
    return needed, seconds / orders
