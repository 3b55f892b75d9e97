"""Set cover: few sets, or cheap ones, that together hold every element as often as is asked.

What must be taken is taken, what is superfluous is dropped (:mod:`sgstore.selection.reduce`), what is left
falls into parts that have nothing to do with one another. Each part is covered greedily and bounded from below
(:mod:`sgstore.selection.bounds`); a part whose bound is not met is searched, up to a number of steps. So the
answer is exact where that is cheap, and beside it stands how far from the best it can be at most.

Source. Under a budget: Khuller, Moss, Naor, "The budgeted maximum coverage problem", Information Processing
Letters 70 (1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.selection.bounds import ROUNDING, bounded, searched
from sgstore.selection.greedy import greedy, met, or_alone, ordered, thinned
from sgstore.selection.reduce import reduced

if TYPE_CHECKING:
    from sgstore.selection.family import Family
    from sgstore.world import Ints

STEPS: Final = 60_000
"""Steps of searching, in all parts together; one with many elements counts as several. They are counted, not
timed, so that the answer is the same everywhere."""

SEARCHED: Final = 1_000_000
"""Memberships of a part that is searched at most: in larger ones so few steps find nothing."""


@dataclass(frozen=True)
class Cover:
    """Sets that were chosen.

    Attributes
    ----------
    chosen : int64
        In the order in which they bring most for what they cost.
    cost : float
        Of all of them.
    bound : float
        No sets that do the same cost less.
    greedy : float
        What the greedy choice would cost, once all that must be taken is taken.
    """

    chosen: Ints
    cost: float
    bound: float
    greedy: float

    @property
    def exact(self) -> bool:
        """Whether there is nothing cheaper."""
        return self.cost <= self.bound + ROUNDING * max(self.cost, 1)


def minimal(family: Family, steps: int = STEPS) -> Cover:
    """The cheapest sets that hold each element as often as it needs; or cheap ones, and a bound.

    Parameters
    ----------
    family : Family
    steps : int
        Of searching at most; 0: greedy choice and bound alone.
    """
    forced, rest = reduced(family)
    chosen, bound = [forced], float(family.cost[forced].sum())
    plain = bound
    whole = bool((family.cost == np.round(family.cost)).all())
    for part, sets in rest:
        own = greedy(part)
        plain += float(part.cost[own].sum())
        own = thinned(part, own)
        low, better, prices = bounded(part, own)
        if part.cost[better].sum() < part.cost[own].sum():
            own = better
        low = math.ceil(low - ROUNDING) if whole else low
        small = len(part.members) <= SEARCHED and part.need.max() == 1
        if steps and small and part.cost[own].sum() > low + ROUNDING:
            own, found, used = searched(part, own, prices, steps, whole=whole)
            steps -= used
            low = max(low, found)
        chosen.append(sets[own])
        bound += min(low, float(part.cost[own].sum()))
    all_chosen = np.concatenate(chosen)
    cost = float(family.cost[all_chosen].sum())
    return Cover(ordered(family, all_chosen), cost, min(bound, cost), plain)


@dataclass(frozen=True)
class Fitted:
    """Sets that were chosen under a budget.

    Attributes
    ----------
    chosen : int64
        In order.
    cost : float
    met : int
        How much of all needs they meet: of each element as many sets as it needs at most, times its weight.
    most : float
        No sets within the budget meet more.
    """

    chosen: Ints
    cost: float
    met: int
    most: float


def within(family: Family, budget: float) -> Fitted:
    """Sets within a budget that meet as much as can be: greedy, or the best set alone.

    The bound is that of submodular functions: whatever has been chosen, the best choice meets no more than that
    and the largest gains of single sets that fit the budget together, the last one in part.
    """
    chosen = or_alone(family, greedy(family, budget), budget)
    at = np.unique(np.linspace(0, len(chosen), 16).astype(np.int64)).tolist()
    most = min(_at_most(family, chosen[:many], budget) for many in at)
    reached = met(family, chosen)
    return Fitted(chosen, float(family.cost[chosen].sum()), reached, max(most, reached))


def _at_most(family: Family, chosen: Ints, budget: float) -> float:
    left = family.need - np.minimum(family.covered(chosen), family.need)
    gain = family.gains(left > 0)
    gain[chosen] = 0
    gain[family.cost > budget] = 0
    order = np.argsort(-gain / family.cost, kind="stable")
    cost = np.cumsum(family.cost[order])
    fits = int(np.searchsorted(cost, budget * (1 + 1e-12), side="right"))
    more = float(gain[order[:fits]].sum())
    if fits < len(order):
        room = budget - (float(cost[fits - 1]) if fits else 0.0)
        more += float(gain[order[fits]]) * room / float(family.cost[order[fits]])
    return met(family, chosen) + min(more, float((left * family.weight).sum()))
