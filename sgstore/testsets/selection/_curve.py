"""Curve of a selection: number of scene classes in the first n test cases, and in n random ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.testsets.coverage import ReportTable, expected_classes
from sgstore.testsets.selection._choose import Selection, holdings_of
from sgstore.testsets.selection._units import kept, units_of

if TYPE_CHECKING:
    from sgstore.model.world import Floats, Ints
    from sgstore.testsets.selection._units import Holdings, Units

POINTS: Final = 60
"""Default number of rows of a curve."""

ORDERS: Final = 1_000
"""Largest number of random orders. Units with many elements get fewer orders."""

_WORK: Final = 30_000_000
"""Largest number of memberships in all random orders together."""


@dataclass(frozen=True)
class Curve:
    """Points of a curve: the number of scene classes (or combinations) in the first n test cases.

    Attributes
    ----------
    table : ReportTable
        ``units``, ``kept`` by the first selected ones, ``share`` of all, and ``at_random``: exact
        mean for as many random units.
    needed : int
        Number of selected units until all elements are kept.
    at_random : float
        Mean number of units in random order that keep as much as the complete selection, over
        ``orders`` orders.
    spread : float
        Standard deviation of this number between orders.
    orders : int
    at_random_s : float
        Mean total time of as many random units, for overlapping clips; s.
    """

    table: ReportTable
    needed: int
    at_random: float
    spread: float
    orders: int
    at_random_s: float = 0.0


def curve(selection: Selection, points: int = POINTS) -> Curve:
    """Return the number of scene classes in the first n selected test cases, and in n random ones.

    Raises
    ------
    ConfigError
        The strategy does not use elements.
    """
    if selection.units.others:  # random orders need all units
        selection = _of_all_units(selection)
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
        raise ConfigError("a curve needs --minimal, --per-class or --rarest")
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


def _of_all_units(selection: Selection) -> Selection:
    """Return the selection with all units. In a collection, at first it has only units worth selecting."""
    spec, some = selection.spec, selection.units
    units = units_of(some.chosen, spec.unit, spec.clip_s, spec.stride_s)
    picked = np.searchsorted(units.first, some.first[selection.picked])
    return replace(selection, units=units, picked=picked, holdings=holdings_of(spec, units))


def _points(most: int, points: int) -> Ints:
    if not most:
        return np.zeros(0, np.int64)
    return np.unique(np.linspace(1, most, min(points, most)).round().astype(np.int64))


def random_need(units: Units, held: Holdings, wanted: int, seed: int) -> tuple[Floats, float]:
    """For several random orders, return how many test cases are needed to contain ``wanted`` classes.

    Returns
    -------
    needed : (K,) float64
        One number for each of K orders.
    seconds : float
        Mean total time, if units overlap; else 0.
    """
    if not wanted:
        return np.zeros(1), 0.0
    pairs, weight = held.pairs, held.weight
    order = np.argsort(pairs[1], kind="stable")
    unit = pairs[0][order]
    starts = np.flatnonzero(np.append(True, np.diff(pairs[1][order]) != 0))
    own = weight[pairs[1][order][starts]]
    orders = int(np.clip(_WORK // max(len(unit), 1), 20, ORDERS))
    period = units.weights("seconds") if units.overlap else None
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
