"""Set cover: few sets, or cheap ones, that together hold every element as often as is asked.

What must be taken is taken, what is the same is merged, what is left falls into parts that have nothing to do
with one another. Each part is covered greedily and bounded from below (:mod:`sgstore.selection.bounds`); a part
whose bound is not met is searched, up to a number of steps. So the answer is exact where that is cheap, and
beside it stands how far from the best it can be at most.

Sources. Greedy and its factor H(n): Chvátal, "A greedy heuristic for the set-covering problem", Mathematics of
Operations Research 4 (1979). Reductions: Garfinkel and Nemhauser, "Integer Programming" (1972), ch. 8. Under a
budget: Khuller, Moss, Naor, "The budgeted maximum coverage problem", Information Processing Letters 70 (1999).
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.selection.bounds import bounded, searched

if TYPE_CHECKING:
    from sgstore.world import Bools, Floats, Ints

STEPS: Final = 60_000
"""Steps of searching, in all parts together; one with many elements counts as several. They are counted, not
timed, so that the answer is the same everywhere."""

ROUNDING: Final = 1e-7
"""How much of a cost is due to rounding."""


@dataclass(frozen=True)
class Family:
    """Sets of elements.

    Attributes
    ----------
    starts : (S + 1,) int64
        Where the elements of each set begin in ``members``.
    members : (M,) int64
        Elements, 0 … E - 1, each once in a set.
    cost : (S,) float64
        Above zero.
    need : (E,) int64
        In how many sets of the answer each element must be; of one that is in fewer sets, in all of these.
    rank : (S,) int64
        Of sets that are equally good the one of the lowest rank is taken.
    weight : (E,) int64
        How much an element counts where not all can be had.
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
    ) -> Family:
        """A family of pairs (2, M) of a set and an element, in any order; a pair may come twice."""
        key = pairs[0].astype(np.int64) * max(elements, 1) + pairs[1]
        if (np.diff(key) <= 0).any():
            key = np.unique(key)
        of_set, members = np.divmod(key, max(elements, 1))
        starts = np.searchsorted(of_set, np.arange(sets + 1))
        often = np.bincount(members, minlength=elements)
        return cls(
            starts.astype(np.int64),
            members,
            np.ones(sets) if cost is None else cost,
            np.minimum(often, need).astype(np.int64),
            np.arange(sets) if rank is None else rank,
            np.ones(elements, np.int64),
        )

    def __len__(self) -> int:
        return len(self.cost)

    @property
    def set_of(self) -> Ints:
        """(M,): the set of each of ``members``."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def elements(self, one: int) -> Ints:
        """The elements of a set."""
        return self.members[self.starts[one] : self.starts[one + 1]]

    def by_element(self) -> tuple[Ints, Ints]:
        """Where the sets of each element begin, and these sets."""
        order = np.argsort(self.members, kind="stable")
        starts = np.searchsorted(self.members[order], np.arange(len(self.need) + 1))
        return starts, self.set_of[order]

    def gains(self, open_: Bools) -> Floats:
        """(S,): the weight of those elements of each set that are open."""
        rows = open_[self.members]
        weight = self.weight[self.members[rows]].astype(np.float64)
        return np.bincount(self.set_of[rows], weight, len(self)).astype(np.float64)

    def covered(self, chosen: Ints) -> Ints:
        """(E,): how many of some sets hold each element."""
        taken = np.zeros(len(self), np.bool_)
        taken[chosen] = True
        return np.bincount(self.members[taken[self.set_of]], minlength=len(self.need))

    def part(self, sets: Ints, wanted: Bools, need: Ints) -> Family:
        """Only some sets, and of them only the elements that are wanted; these are numbered anew."""
        kept = np.zeros(len(self), np.bool_)
        kept[sets] = True
        rows = kept[self.set_of] & wanted[self.members]
        number = np.cumsum(wanted) - 1
        place = np.full(len(self), -1)
        place[sets] = np.arange(len(sets))
        pairs = np.stack([place[self.set_of[rows]], number[self.members[rows]]])
        found = Family.of(
            pairs, len(sets), int(wanted.sum()), self.cost[sets], rank=self.rank[sets]
        )
        return replace(found, need=need[wanted])


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
    forced, rest = _reduced(family)
    chosen, bound = [forced], float(family.cost[forced].sum())
    plain = bound
    whole = bool((family.cost == np.round(family.cost)).all())
    for part, sets in rest:
        own = greedy(part)
        plain += float(part.cost[own].sum())
        own = thinned(part, own)
        low, better = bounded(part, own)
        if part.cost[better].sum() < part.cost[own].sum():
            own = better
        low = math.ceil(low - ROUNDING) if whole else low
        if steps and part.cost[own].sum() > low + ROUNDING and part.need.max() == 1:
            own, found, used = searched(part, own, steps, whole=whole)
            steps -= used
            low = max(low, found)
        chosen.append(sets[own])
        bound += min(low, float(part.cost[own].sum()))
    all_chosen = np.concatenate(chosen)
    cost = float(family.cost[all_chosen].sum())
    return Cover(ordered(family, all_chosen), cost, min(bound, cost), plain)


def greedy(family: Family, budget: float = math.inf) -> Ints:
    """Sets, one after another, each the one that brings most new elements for its cost.

    Parameters
    ----------
    family : Family
    budget : float
        What all may cost together; sets that do not fit are passed over.

    Returns
    -------
    int64
        In the order in which they were taken.
    """
    starts, of_element = family.by_element()
    need = family.need.copy()
    gain = family.gains(need > 0)
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
        gain[one] = 0
        need[elements] -= 1
        for element in elements[need[elements] == 0].tolist():
            gain[of_element[starts[element] : starts[element + 1]]] -= family.weight[element]
        gain[one] = 0
    return np.array(chosen, np.int64)


def thinned(family: Family, chosen: Ints) -> Ints:
    """Without the sets that the others make superfluous, the dearest and latest first."""
    spare = family.covered(chosen) - family.need
    keep = np.ones(len(chosen), np.bool_)
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
    chosen = greedy(family, budget)
    gain = family.gains(family.need > 0)
    affordable = np.flatnonzero(family.cost <= budget)
    if len(affordable):
        best = affordable[np.lexsort((family.rank[affordable], -gain[affordable]))[:1]]
        if _met(family, best) > _met(family, chosen):
            chosen = best
    at = np.unique(np.linspace(0, len(chosen), 16).astype(np.int64)).tolist()
    most = min(_at_most(family, chosen[:many], budget) for many in at)
    met = _met(family, chosen)
    return Fitted(chosen, float(family.cost[chosen].sum()), met, max(most, met))


def _met(family: Family, chosen: Ints) -> int:
    return int((np.minimum(family.covered(chosen), family.need) * family.weight).sum())


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
    return _met(family, chosen) + min(more, float((left * family.weight).sum()))


# Reductions -----------------------------------------------------------------------------------------------


def _reduced(family: Family) -> tuple[Ints, list[tuple[Family, Ints]]]:
    """Sets that every answer may be taken to hold; and what is left, in parts, with their sets."""
    need, alive = family.need.copy(), np.ones(len(family), np.bool_)
    forced = np.zeros(len(family), np.bool_)
    wanted = need > 0
    size = -1
    while size != (size := int(alive.sum()) + int(wanted.sum())):
        _force(family, need, alive, forced)
        wanted &= need > 0
        _drop_same_elements(family, need, alive, wanted)
        if need[wanted].max(initial=0) == 1:
            _drop_same_sets(family, alive, wanted)
        alive &= np.bincount(family.set_of[wanted[family.members]], minlength=len(family)) > 0
    return np.flatnonzero(forced), _parts(family, need, alive, wanted)


def _force(family: Family, need: Ints, alive: Bools, forced: Bools) -> None:
    """Take all sets of elements that are in no more sets than they need."""
    while True:
        rows = alive[family.set_of]
        often = np.bincount(family.members[rows], minlength=len(need))
        tight = (need > 0) & (often <= need)
        taken = np.unique(family.set_of[rows & tight[family.members]])
        if not len(taken):
            return
        forced[taken], alive[taken] = True, False
        held = np.zeros(len(family), np.bool_)
        held[taken] = True
        need -= np.bincount(family.members[held[family.set_of]], minlength=len(need))
        np.maximum(need, 0, out=need)


def _drop_same_elements(family: Family, need: Ints, alive: Bools, wanted: Bools) -> None:
    """Of elements that are in the same sets only the one that needs most counts."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.members[rows], family.set_of[rows], len(need), len(family))
    elements = np.flatnonzero(wanted)
    order = elements[np.lexsort((elements, -need[elements], key[1][elements], key[0][elements]))]
    wanted[order[_repeated(key[0][order], key[1][order])]] = False


def _drop_same_sets(family: Family, alive: Bools, wanted: Bools) -> None:
    """Of sets that hold the same only the cheapest counts."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.set_of[rows], family.members[rows], len(family), len(wanted))
    sets = np.flatnonzero(alive)
    order = sets[np.lexsort((family.rank[sets], family.cost[sets], key[1][sets], key[0][sets]))]
    alive[order[_repeated(key[0][order], key[1][order])]] = False


def _keys(of: Ints, what: Ints, size: int, things: int) -> tuple[Ints, Ints]:
    """Two numbers for each set of things, 106 bits together: equal where the sets are."""
    words = np.random.Generator(np.random.PCG64(20_24)).integers(1 << 31, size=(2, 2, things))
    found: list[Ints] = []
    for low, high in words:
        # Sums of numbers below 2³¹ are exact in floating point, if there are below 2²² of them.
        first = np.bincount(of, low[what], size).astype(np.int64)
        second = np.bincount(of, high[what], size).astype(np.int64)
        found.append(first * (1 << 31) ^ second)
    return found[0], found[1]


def _repeated(*keys: Ints) -> Bools:
    same = np.zeros(len(keys[0]), np.bool_)
    same[1:] = np.logical_and.reduce([key[1:] == key[:-1] for key in keys])
    return same


def _parts(family: Family, need: Ints, alive: Bools, wanted: Bools) -> list[tuple[Family, Ints]]:
    """What is left, as families that share no element, the one with the first set first."""
    rows = alive[family.set_of] & wanted[family.members]
    sets, members = family.set_of[rows], family.members[rows]
    parent = list(range(len(family)))

    def root(one: int) -> int:
        while parent[one] != one:
            parent[one] = parent[parent[one]]
            one = parent[one]
        return one

    holder: dict[int, int] = {}
    for one, element in zip(sets.tolist(), members.tolist(), strict=True):
        mine, other = root(one), root(holder.setdefault(element, one))
        parent[max(mine, other)] = min(mine, other)
    group = np.array([root(one) for one in sets.tolist()], np.int64)
    order = np.argsort(group, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(group[order]) != 0, True)) + 1 if len(order) else ()
    found: list[tuple[Family, Ints]] = []
    first = 0
    for end in map(int, ends):
        own = order[first:end]
        first = end
        inside, place = np.unique(sets[own], return_inverse=True)
        element, number = np.unique(members[own], return_inverse=True)
        pairs = np.stack([place, number])
        part = Family.of(
            pairs, len(inside), len(element), family.cost[inside], 1, family.rank[inside]
        )
        found.append((replace(part, need=need[element]), inside))
    return found
