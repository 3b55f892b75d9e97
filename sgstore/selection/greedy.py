"""Sets that are chosen one after another, and what of a choice is superfluous.

Source. Greedy and its factor H(n): Chvátal, "A greedy heuristic for the set-covering problem", Mathematics of
Operations Research 4 (1979).
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.selection.family import Family
    from sgstore.world import Ints


def greedy(
    family: Family,
    budget: float = math.inf,
    cheapened: Callable[[int], Iterable[tuple[int, float]]] | None = None,
) -> Ints:
    """Sets, one after another, each the one that brings most new elements for its cost.

    Parameters
    ----------
    family : Family
    budget : float
        What all may cost together; sets that do not fit are passed over.
    cheapened : callable, optional
        Called with each set that is taken → sets that cost less from then on, and what they cost now.

    Returns
    -------
    int64
        In the order in which they were taken.
    """
    need = family.need.copy()
    gain = family.gains(need > 0)
    often = np.bincount(family.members, minlength=len(need))
    if cheapened is None and (often <= need).all() and family.cost.sum() <= budget:
        # Each is taken, and none makes another one worth less.
        order = np.lexsort((family.rank, -gain / family.cost))
        return order[: np.count_nonzero(gain)]
    starts, of_element = family.by_element()
    cost, rank = family.cost.tolist(), family.rank.tolist()
    heap = [(-gain[i] / cost[i], rank[i], i) for i in np.flatnonzero(gain).tolist()]
    heapq.heapify(heap)
    chosen: list[int] = []
    left = budget
    while heap:
        known, own, one = heapq.heappop(heap)
        value = -gain[one] / cost[one]
        if not gain[one] or cost[one] > left:
            continue
        if value > known:
            heapq.heappush(heap, (value, own, one))
            continue
        chosen.append(one)
        left -= cost[one]
        elements = family.elements(one)
        elements = elements[need[elements] > 0]
        need[elements] -= 1
        for element in elements[need[elements] == 0].tolist():
            gain[of_element[starts[element] : starts[element + 1]]] -= family.weight[element]
        gain[one] = 0
        for other, price in cheapened(one) if cheapened else ():
            cost[other] = price
            if gain[other]:  # it may be worth more now, and fit a budget that it did not
                heapq.heappush(heap, (-gain[other] / price, rank[other], other))
    return np.array(chosen, np.int64)


def thinned(family: Family, chosen: Ints, order: Ints | None = None) -> Ints:
    """Without the sets that the others make superfluous.

    Parameters
    ----------
    family : Family
    chosen : int64
    order : int64, optional
        Places in ``chosen``, those first that are to go. By default the dearest, and of these the latest.
    """
    spare = family.covered(chosen) - family.need
    keep = np.ones(len(chosen), np.bool_)
    if order is None:
        order = np.lexsort((-np.arange(len(chosen)), -family.cost[chosen]))
    for place in order.tolist():
        elements = family.elements(int(chosen[place]))
        if (spare[elements] > 0).all():
            keep[place] = False
            spare[elements] -= 1
    return chosen[keep]


def ordered(family: Family, chosen: Ints) -> Ints:
    """Chosen sets in the order in which they bring most for what they cost; then those that bring nothing."""
    chosen = np.sort(chosen)
    wanted = np.ones(len(family.need), np.bool_)
    need = np.minimum(family.need, family.covered(chosen))
    first = greedy(family.part(chosen, wanted, need))
    rest = np.setdiff1d(np.arange(len(chosen)), first)
    return chosen[np.concatenate([first, rest])]


def met(family: Family, chosen: Ints) -> int:
    """How much of all needs some sets meet: of each element no more than it needs, times its weight."""
    return int((np.minimum(family.covered(chosen), family.need) * family.weight).sum())


def or_alone(family: Family, chosen: Ints, budget: float) -> Ints:
    """Chosen sets; or the best one that a budget allows, if that meets more alone."""
    gain = family.gains(family.need > 0)
    single = np.flatnonzero(family.cost <= budget)
    best = single[np.lexsort((family.rank[single], -gain[single]))[:1]]
    return best if met(family, best) > met(family, chosen) else chosen
