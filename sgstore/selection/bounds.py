"""Bounds of set covers from below, and the search for the cheapest.

A price for each element: if no set costs less than the prices of its elements, no cover costs less than all
prices together (the dual of the linear programme). Any prices at all give a bound too, if what sets cost less
than their elements is taken off (Lagrange). Prices are found by steps along subgradients; they also suggest
covers. The search branches over the sets that hold the element which is in the fewest.

Sources. Held, Wolfe, Crowder, "Validation of subgradient optimization", Mathematical Programming 6 (1974);
Beasley, "A Lagrangian heuristic for set-covering problems", Naval Research Logistics 37 (1990); Caprara,
Fischetti, Toth, "A heuristic method for the set covering problem", Operations Research 47 (1999).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.selection.greedy import thinned

if TYPE_CHECKING:
    from sgstore.selection.family import Family
    from sgstore.world import Floats, Ints

ROUNDS: Final = 400
"""Steps along subgradients at most."""

PATIENCE: Final = 20
"""Steps without a better bound after which they become half as long."""

TRIES: Final = 10
"""Every so many steps the prices suggest a cover."""

_WORK: Final = 200_000_000
"""Memberships that all steps may look at together: fewer steps where there are very many."""

ROUNDING: Final = 1e-7
"""How much of a cost is due to rounding."""


def bounded(family: Family, cover: Ints) -> tuple[float, Ints, Floats]:
    """A bound from below, and a cover at most as dear as a given one.

    Parameters
    ----------
    family : Family
        Each element needs at least one set, and is in as many as it needs.
    cover : int64

    Returns
    -------
    low : float
    cover : int64
    prices : (E,) float64
        Those of the elements that give the bound.
    """
    set_of, need, cost = family.set_of, family.need, family.cost
    often = np.diff(family.starts)
    share = cost / np.maximum(often, 1)
    prices = np.full(len(need), np.inf)
    np.minimum.at(prices, family.members, share[set_of])
    upper = float(cost[cover].sum())
    best, kept, low = cover, prices, -math.inf
    scale, idle = 2.0, 0
    rounds = int(np.clip(_WORK // max(len(set_of), 1), TRIES, ROUNDS))
    for step in range(rounds):
        left = cost - np.bincount(set_of, prices[family.members], len(cost))
        taken = left < 0
        bound = float((need * prices).sum() + left[taken].sum())
        if bound > low + 1e-9:
            low, kept, idle = bound, prices, 0
        else:
            idle += 1
            if idle == PATIENCE:
                scale, idle, prices = scale / 2, 0, kept
                continue
        if step % TRIES == 0:
            found = _suggested(family, left)
            if cost[found].sum() < upper - ROUNDING:
                best, upper = found, float(cost[found].sum())
        lacking = need - np.bincount(family.members[taken[set_of]], minlength=len(need))
        lacking[(prices == 0) & (lacking < 0)] = 0
        length = float((lacking.astype(np.float64) ** 2).sum())
        if not length or upper - low < ROUNDING or scale < 1e-3:
            break
        prices = np.maximum(prices + scale * (1.02 * upper - bound) / length * lacking, 0.0)
    return max(low, 0.0), best, kept


def _suggested(family: Family, left: Floats) -> Ints:
    """A cover of the sets that cost least beyond the prices of their elements."""
    order = np.lexsort((family.rank, left / np.maximum(np.diff(family.starts), 1)))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    of_element = np.lexsort((place[family.set_of], family.members))
    starts, _ = family.by_element()
    # Of each element the sets that come first in this order, as many as it needs.
    within = np.arange(len(of_element)) - starts[family.members[of_element]]
    first = within < family.need[family.members[of_element]]
    chosen = np.unique(family.set_of[of_element[first]])
    return thinned(family, chosen[np.argsort(place[chosen])])


def feasible(family: Family, prices: Floats) -> Floats:
    """Prices made so low that no set costs less than its elements, then as high as that allows, one by one."""
    set_of = family.set_of
    asked = np.bincount(set_of, prices[family.members], len(family))
    over = np.maximum(asked / family.cost, 1.0)
    factor = np.ones(len(prices))
    np.maximum.at(factor, family.members, over[set_of])
    prices = prices / factor
    left = family.cost - np.bincount(set_of, prices[family.members], len(family))
    starts, sets = family.by_element()
    order = np.argsort(np.diff(starts), kind="stable")
    for element in order.tolist():
        own = sets[starts[element] : starts[element + 1]]
        room = max(float(left[own].min()), 0.0)
        prices[element] += room
        left[own] -= room
    return prices


def searched(
    family: Family, cover: Ints, prices: Floats, steps: int, *, whole: bool
) -> tuple[Ints, float, int]:
    """The cheapest cover by branch and bound, or the best one after so many steps.

    Parameters
    ----------
    family : Family
        Each element needs one set.
    cover : int64
        One that is known.
    prices : (E,) float64
        Of the elements: :func:`bounded`.
    steps : int
    whole : bool
        Whether all costs are whole numbers.

    Returns
    -------
    cover : int64
    bound : float
        Its cost, if the search came to its end; else 0.
    used : int
        Steps that it took.
    """
    search = _Search(family, cover, feasible(family, prices), steps, whole=whole)
    ended = search.run()
    return search.best, (search.upper if ended else 0.0), search.used


class _Search:
    """Depth first, without recursion: sets of elements and of sets are the bits of whole numbers."""

    def __init__(
        self, family: Family, cover: Ints, prices: Floats, steps: int, *, whole: bool
    ) -> None:
        self._cost = family.cost.tolist()
        self._prices = prices.tolist()
        self._members = [_bits(family.elements(i)) for i in range(len(family))]
        starts, sets = family.by_element()
        self._sets = [_bits(sets[starts[e] : starts[e + 1]]) for e in range(len(starts) - 1)]
        self._step = 1.0 if whole else 0.0
        self._steps = steps
        self._weight = 1 + len(self._sets) // 100
        self.used = 0
        self.best, self.upper = cover, float(family.cost[cover].sum())

    def run(self) -> bool:
        """Search; whether all was searched."""
        every = (1 << len(self._sets)) - 1
        stack: list[tuple[int, int, float, tuple[int, ...]]] = [
            (every, (1 << len(self._members)) - 1, 0.0, ())
        ]
        while stack:
            if self.used >= self._steps:
                return False
            self.used += self._weight
            open_, allowed, cost, chosen = stack.pop()
            if not open_:
                if cost < self.upper - ROUNDING:
                    self.upper, self.best = cost, np.array(sorted(chosen), np.int64)
                continue
            # Of whole costs only what is cheaper by one is of interest.
            least = cost + self._least(open_)
            if least > self.upper - max(self._step, ROUNDING) + ROUNDING:
                continue
            stack += self._branches(open_, allowed, cost, chosen)
        return True

    def _least(self, open_: int) -> float:
        """What covering elements costs at least."""
        prices = self._prices
        return sum(prices[i] for i in _places(open_))

    def _branches(
        self, open_: int, allowed: int, cost: float, chosen: tuple[int, ...]
    ) -> list[tuple[int, int, float, tuple[int, ...]]]:
        """One for each set that holds the element which is in the fewest; the most promising last."""
        fewest = min(
            (self._sets[i] & allowed for i in _places(open_)), key=lambda sets: sets.bit_count()
        )
        found: list[tuple[int, int, float, tuple[int, ...]]] = []
        options = sorted(
            _places(fewest),
            key=lambda i: self._cost[i] / max((self._members[i] & open_).bit_count(), 1),
        )
        for one in options:
            allowed &= ~(1 << one)  # the branches that follow are those without it
            rest = open_ & ~self._members[one]
            found.append((rest, allowed, cost + self._cost[one], (*chosen, one)))
        return found[::-1]


def _bits(numbers: Ints) -> int:
    found = 0
    for number in numbers.tolist():
        found |= 1 << number
    return found


def _places(bits: int) -> list[int]:
    found: list[int] = []
    while bits:
        low = bits & -bits
        found.append(low.bit_length() - 1)
        bits ^= low
    return found
