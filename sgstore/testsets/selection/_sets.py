"""Families of sets (for set covers) as integer arrays, and a greedy selection of sets.

A family has sets of elements, stored as columns.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.model.world import Bools, Floats, Ints


def distinct(values: Ints) -> Ints:
    """Return the distinct integers of an array, ascending."""
    if (np.diff(values) <= 0).any():
        values = np.sort(values, kind="stable")
        values = values[np.append(True, np.diff(values) != 0)]
    return values


def spread(begin: Ints, end: Ints) -> tuple[Ints, Ints]:
    """Return all integers in some ranges, each with the index of its range."""
    many = end - begin
    unit = np.repeat(np.arange(len(many)), many)
    return unit, np.arange(len(unit)) + np.repeat(begin - (np.cumsum(many) - many), many)


@dataclass(frozen=True)
class SetFamily:
    """Sets for a set cover: elements and cost of each set, and how many sets each element needs.

    Attributes
    ----------
    starts : (S + 1,) int64
        Start of the elements of each set in ``members``.
    members : (M,) int64
        Elements, 0 … E - 1, each once in a set.
    cost : (S,) float64
        Positive cost of each set.
    need : (E,) int64
        Number of sets that each element needs in a cover; an element with fewer sets needs all of
        them.
    rank : (S,) int64
        Tie-breaker: of equally good sets the lowest rank is taken.
    weight : (E,) int64
        Weight of an element if not all can be covered.
    """

    starts: Ints
    members: Ints
    cost: Floats
    need: Ints
    rank: Ints
    weight: Ints

    @classmethod
    def of(
        cls,
        pairs: Ints,
        sets: int,
        elements: int,
        cost: Floats | None = None,
        need: int = 1,
        rank: Ints | None = None,
    ) -> SetFamily:
        """Make a family of sets from pairs (2, M): set number, element number. Duplicates are allowed."""
        key = distinct(pairs[0].astype(np.int64) * max(elements, 1) + pairs[1])
        of_set, members = np.divmod(key, max(elements, 1))
        starts = np.searchsorted(of_set, np.arange(sets + 1))
        often = np.bincount(members, minlength=elements)
        return cls(
            starts.astype(np.int64),
            members,
            np.ones(sets) if cost is None else cost,
            np.minimum(often, min(need, sets)).astype(np.int64),
            np.arange(sets) if rank is None else rank,
            np.ones(elements, np.int64),
        )

    def __len__(self) -> int:
        return len(self.cost)

    @property
    def whole(self) -> bool:
        """True if the costs of all sets are integers."""
        return bool((self.cost == np.round(self.cost)).all())

    @property
    def set_of(self) -> Ints:
        """For each entry of ``members``, return the number of its set, (M,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def elements(self, one: int) -> Ints:
        """Return the elements of one set of the family."""
        return self.members[self.starts[one] : self.starts[one + 1]]

    def by_element(self) -> tuple[Ints, Ints]:
        """For each element, return the sets that contain it: an array of starts, and an array of sets."""
        order = np.argsort(self.members, kind="stable")
        starts = np.searchsorted(self.members[order], np.arange(len(self.need) + 1))
        return starts, self.set_of[order]

    def gains(self, open_: Bools) -> Floats:
        """For each set, return the total weight of those elements that are not covered enough yet, (S,)."""
        rows = open_[self.members]
        weight = self.weight[self.members[rows]].astype(np.float64)
        return np.bincount(self.set_of[rows], weight, len(self)).astype(np.float64)

    def covered(self, chosen: Ints) -> Ints:
        """For each element, return the number of selected sets that contain it, (E,)."""
        taken = np.zeros(len(self), np.bool_)
        taken[chosen] = True
        return np.bincount(self.members[taken[self.set_of]], minlength=len(self.need))

    def part(self, sets: Ints, wanted: Bools, need: Ints) -> SetFamily:
        """Return a smaller family with some of the sets and elements. Elements get new numbers."""
        kept = np.zeros(len(self), np.bool_)
        kept[sets] = True
        rows = kept[self.set_of] & wanted[self.members]
        number = np.cumsum(wanted) - 1
        place = np.full(len(self), -1)
        place[sets] = np.arange(len(sets))
        pairs = np.stack([place[self.set_of[rows]], number[self.members[rows]]])
        found = SetFamily.of(
            pairs, len(sets), int(wanted.sum()), self.cost[sets], rank=self.rank[sets]
        )
        return replace(found, need=need[wanted])


# Source of the greedy choice and its factor H(n): Chvátal, "A greedy heuristic for the set-covering
# problem", Mathematics of Operations Research 4 (1979).


def greedy(
    family: SetFamily,
    budget: float = math.inf,
    cheapened: Callable[[int], Iterable[tuple[int, float]]] | None = None,
) -> Ints:
    """Select sets one by one, each time the set with the most new elements per cost.

    Parameters
    ----------
    family : SetFamily
    budget : float
        Limit for the total cost; sets that do not fit are skipped.
    cheapened : callable, optional
        Function from a taken set to sets that become cheaper, with their new costs.

    Returns
    -------
    int64
        In the order of choice.
    """
    need = family.need.copy()
    gain = family.gains(need > 0)
    often = np.bincount(family.members, minlength=len(need))
    if cheapened is None and (often <= need).all() and family.cost.sum() <= budget:
        # All sets are taken, and none reduces the gain of another.
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
            if gain[other]:  # its gain may have grown, and it may fit the budget now
                heapq.heappush(heap, (-gain[other] / price, rank[other], other))
    return np.array(chosen, np.int64)


def thinned(family: SetFamily, chosen: Ints, order: Ints | None = None) -> Ints:
    """Remove a selected set if the other selected sets cover all its elements. Return the remaining sets.

    Parameters
    ----------
    family : SetFamily
    chosen : int64
    order : int64, optional
        Indices into ``chosen``, first candidates first. By default the most expensive, and of these
        the latest.
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


def ordered(family: SetFamily, chosen: Ints) -> Ints:
    """Sort the selected sets by new elements per cost. Sets without new elements come last."""
    chosen = np.sort(chosen)
    wanted = np.ones(len(family.need), np.bool_)
    need = np.minimum(family.need, family.covered(chosen))
    first = greedy(family.part(chosen, wanted, need))
    rest = np.setdiff1d(np.arange(len(chosen)), first)
    return chosen[np.concatenate([first, rest])]


def met(family: SetFamily, chosen: Ints) -> int:
    """Return the total weight of covered elements. If an element needs several sets, each of them counts."""
    return int((np.minimum(family.covered(chosen), family.need) * family.weight).sum())


def or_alone(family: SetFamily, chosen: Ints, budget: float) -> Ints:
    """Return the selected sets; or a single set within the budget, if this set covers more."""
    gain = family.gains(family.need > 0)
    single = np.flatnonzero(family.cost <= budget)
    best = single[np.lexsort((family.rank[single], -gain[single]))[:1]]
    return best if met(family, best) > met(family, chosen) else chosen
