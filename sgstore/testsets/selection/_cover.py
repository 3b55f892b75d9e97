"""Cheap set covers: clips that together contain all scene classes, with lower bounds for the cost.

Reduction removes clear decisions: required sets, and redundant elements and sets. It also splits
the problem into independent parts.

An element is redundant if all sets of another element contain it. A set is redundant if another set
contains all its elements and does not cost more. A step can enable others; therefore the steps
repeat until nothing changes. For clips at any places on a time axis almost nothing remains: an
occurrence is in consecutive clips, and these steps solve such covers completely (the matrix has
consecutive ones).

Source. Garfinkel and Nemhauser, "Integer Programming" (1972), ch. 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.testsets.selection._bounds import NODES, ROUNDING, bounded, improved
from sgstore.testsets.selection._sets import (
    SetFamily,
    greedy,
    met,
    or_alone,
    ordered,
    spread,
    thinned,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.selection._units import Holdings, Measure, Units

_COMPARISONS: Final = 100_000_000
"""Largest number of comparison steps for the search of redundant items."""

_BATCH: Final = 2_000_000
"""Number of pairs that are compared at once."""

_TABLE: Final = 1 << 26
"""Largest size of a look-up table of memberships."""


def reduced(family: SetFamily) -> tuple[Ints, list[tuple[SetFamily, Ints]]]:
    """Return the sets that every cover needs, and the remaining problem divided into independent parts."""
    need, alive = family.need.copy(), np.ones(len(family), np.bool_)
    forced = np.zeros(len(family), np.bool_)
    wanted = need > 0
    work, size = _COMPARISONS, -1
    if (
        need.max(initial=0) <= 1
    ):  # first, because bundles of a collection have already left out as much
        alive &= cheapest_alike(family)
    while size != (size := int(alive.sum()) + int(wanted.sum())):
        _force(family, need, alive, forced)
        wanted &= need > 0
        _drop_same_elements(family, need, alive, wanted)
        work -= _drop_larger_elements(family, need, alive, wanted, work)
        if need[wanted].max(initial=0) == 1:
            _drop_same_sets(family, alive, wanted)
            work -= _drop_smaller_sets(family, alive, wanted, work)
        alive &= np.bincount(family.set_of[wanted[family.members]], minlength=len(family)) > 0
    return np.flatnonzero(forced), _parts(family, need, alive, wanted)


def cheapest_alike(family: SetFamily) -> Bools:
    """Return a mask of sets, (S,): only the cheapest of the sets with the same elements is kept."""
    alive = np.ones(len(family), np.bool_)
    _drop_same_sets(family, alive, np.ones(len(family.need), np.bool_))
    return alive & (np.diff(family.starts) > 0)


def _force(family: SetFamily, need: Ints, alive: Bools, forced: Bools) -> None:
    """Select all sets that contain an element, if their number does not exceed the need of the element."""
    while True:
        rows = alive[family.set_of]
        often = np.bincount(family.members[rows], minlength=len(need))
        tight = (need > 0) & (often <= need)
        taken = np.zeros(len(family), np.bool_)
        taken[family.set_of[rows & tight[family.members]]] = True
        if not taken.any():
            return
        forced[taken], alive[taken] = True, False
        need -= np.bincount(family.members[taken[family.set_of]], minlength=len(need))
        np.maximum(need, 0, out=need)


def _drop_same_elements(family: SetFamily, need: Ints, alive: Bools, wanted: Bools) -> None:
    """If exactly the same sets contain several elements, keep the one that must be covered most often."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.members[rows], family.set_of[rows], len(need), len(family))
    elements = np.flatnonzero(wanted)
    order = elements[np.lexsort((elements, -need[elements], key[1][elements], key[0][elements]))]
    wanted[order[_repeated(key[0][order], key[1][order])]] = False


def _drop_same_sets(family: SetFamily, alive: Bools, wanted: Bools) -> None:
    """If several sets have the same elements, keep only the cheapest."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.set_of[rows], family.members[rows], len(family), len(wanted))
    sets = np.flatnonzero(alive)
    order = sets[np.lexsort((family.rank[sets], family.cost[sets], key[1][sets], key[0][sets]))]
    alive[order[_repeated(key[0][order], key[1][order])]] = False


def _keys(of: Ints, what: Ints, size: int, things: int) -> tuple[Ints, Ints]:
    """Return a 106-bit hash of the elements of each set, as two numbers. Equal sets have equal hashes."""
    words = np.random.Generator(np.random.PCG64(20_24)).integers(1 << 31, size=(2, 2, things))
    found: list[Ints] = []
    for low, high in words:
        # Sums of numbers below 2³¹ are exact in floating point for fewer than 2²² of them.
        first = np.bincount(of, low[what], size).astype(np.int64)
        second = np.bincount(of, high[what], size).astype(np.int64)
        found.append(first * (1 << 31) ^ second)
    return found[0], found[1]


def _repeated(*keys: Ints) -> Bools:
    same = np.zeros(len(keys[0]), np.bool_)
    same[1:] = np.logical_and.reduce([key[1:] == key[:-1] for key in keys])
    return same


def _drop_larger_elements(
    family: SetFamily, need: Ints, alive: Bools, wanted: Bools, most: int
) -> int:
    """Remove each element that any cover of another element also covers. Return the number of steps."""
    rows = alive[family.set_of] & wanted[family.members]

    def superfluous(small: Ints, large: Ints) -> Ints:
        return large[need[large] <= need[small]]

    gone, work = _contained(
        family.members[rows], family.set_of[rows], len(need), len(family), superfluous, most
    )
    wanted[gone] = False
    return work


def _drop_smaller_sets(family: SetFamily, alive: Bools, wanted: Bools, most: int) -> int:
    """Remove each set whose elements are all in another set that costs no more. Return the number of steps."""
    rows = alive[family.set_of] & wanted[family.members]

    def superfluous(small: Ints, large: Ints) -> Ints:
        return small[family.cost[large] <= family.cost[small]]

    gone, work = _contained(
        family.set_of[rows], family.members[rows], len(family), len(wanted), superfluous, most
    )
    alive[gone] = False
    return work


def _contained(
    one: Ints,
    other: Ints,
    ones: int,
    others: int,
    superfluous: Callable[[Ints, Ints], Ints],
    most: int,
) -> tuple[Bools, int]:
    """Test which items (sets or elements) contain others. Return a mask of redundant items, and the step count.

    Parameters
    ----------
    one, other : (M,) int64
        Items, and their components; without duplicates.
    ones, others : int
        Numbers of possible items and components.
    superfluous : callable
        Function from pairs of a contained and a containing item to the redundant items.
    most : int
        Greatest number of comparison steps.

    Returns
    -------
    gone : (ones,) bool
    work : int
        Number of steps.
    """
    gone, done = np.zeros(ones, np.bool_), np.zeros(ones, np.bool_)
    # Rare components distinguish items best: they are compared first.
    common = np.bincount(other, minlength=others)
    rare = np.empty(others, np.int64)
    rare[np.argsort(common, kind="stable")] = np.arange(others)
    other = rare[other]
    work, batch = 0, _BATCH // 16
    while work < most:
        rows = ~gone[one]
        key = np.sort(one[rows] * others + other[rows])
        one, other = np.divmod(key, others)
        things, pairs = _compared(one, other, (ones, others), done, batch)
        if not len(things):
            break
        done[things] = True
        small, large, used = _holding(key, (ones, others), pairs, most - work)
        work += used
        gone[superfluous(small, large)] = True
        batch = _BATCH
    return gone, work


def _compared(
    one: Ints, other: Ints, sizes: tuple[int, int], done: Bools, batch: int
) -> tuple[Ints, tuple[Ints, Ints]]:
    """Return the next items (sets or elements) to compare, smallest first, and possible containers of them.

    A containing item has all components of the item, also its first, which is the rarest.
    """
    many = np.bincount(one, minlength=sizes[0])
    common = np.bincount(other, minlength=sizes[1])
    first = np.flatnonzero(np.append(True, np.diff(one) != 0)) if len(one) else one
    first = first[~done[one[first]]]
    first = first[np.argsort(many[one[first]], kind="stable")]
    fits = max(int(np.searchsorted(np.cumsum(common[other[first]]), batch)), 1)
    first = first[:fits]
    by_other = np.argsort(other, kind="stable")
    starts = np.searchsorted(other[by_other], np.arange(sizes[1] + 1))
    begin = starts[other[first]]
    which, place = spread(begin, begin + common[other[first]])
    small, large = one[first][which], one[by_other[place]]
    kept = (many[large] >= many[small]) & (large != small)
    return one[first], (small[kept], large[kept])


def _holding(
    key: Ints, sizes: tuple[int, int], pairs: tuple[Ints, Ints], most: int
) -> tuple[Ints, Ints, int]:
    """Return the pairs of items (sets or elements) in which the second contains the first; the step count.

    All pairs share the first component. Pairs that are undecided within the limit are excluded.
    """
    small, large = pairs
    starts = np.searchsorted(key, np.arange(sizes[0] + 1) * sizes[1])
    # A table is used if there is room for it.
    table = np.zeros(sizes[0] * sizes[1] if sizes[0] * sizes[1] <= _TABLE else 0, np.bool_)
    if len(table):
        table[key] = True
    held: list[tuple[Ints, Ints]] = [(small[:0], large[:0])]
    place, work = 1, len(small)
    while len(small) and work < most:
        ended = starts[small] + place >= starts[small + 1]
        held.append((small[ended], large[ended]))
        small, large = small[~ended], large[~ended]
        wanted = large * sizes[1] + key[starts[small] + place] % sizes[1]
        if len(table):
            kept = table[wanted]
        else:
            kept = key[np.minimum(np.searchsorted(key, wanted), len(key) - 1)] == wanted
        work += len(small)
        small, large = small[kept], large[kept]
        place += 1
    found = np.concatenate([np.stack(some) for some in held], axis=1)
    return found[0], found[1], work


def _parts(
    family: SetFamily, need: Ints, alive: Bools, wanted: Bools
) -> list[tuple[SetFamily, Ints]]:
    """Divide the remaining sets into independent problems. Two problems have no common elements."""
    rows = alive[family.set_of] & wanted[family.members]
    sets, members = family.set_of[rows], family.members[rows]
    group = _joined(sets, members, len(family), len(need))[sets]
    order = np.argsort(group, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(group[order]) != 0, True)) + 1 if len(order) else ()
    found: list[tuple[SetFamily, Ints]] = []
    first = 0
    for end in map(int, ends):
        own = order[first:end]
        first = end
        inside, place = np.unique(sets[own], return_inverse=True)
        element, number = np.unique(members[own], return_inverse=True)
        pairs = np.stack([place, number])
        part = SetFamily.of(
            pairs, len(inside), len(element), family.cost[inside], 1, family.rank[inside]
        )
        found.append((replace(part, need=need[element]), inside))
    return found


def _joined(sets: Ints, members: Ints, many: int, elements: int) -> Ints:
    """Number the groups of connected sets. Sets with common elements are connected."""
    first = np.arange(many)
    while True:
        # Propagate the least set number through elements and sets.
        least = np.full(elements, many)
        np.minimum.at(least, members, first[sets])
        found = first.copy()
        np.minimum.at(found, first[sets], least[members])
        while (found[found] != found).any():
            found = found[found]
        if (found == first).all():
            return first
        first = found


# Set cover: few or cheap sets that together hold every element as often as needed. Required sets
# are taken, redundant ones are dropped, and the rest splits into independent parts. Each part is
# covered greedily and bounded from below. A part whose cover exceeds its bound is given to HiGHS,
# if that is installed. So the result is exact if that is cheap, and otherwise has a bound for its
# distance from the optimum. Source, with a budget: Khuller, Moss, Naor, "The budgeted maximum
# coverage problem", Information Processing Letters 70 (1999).


@dataclass(frozen=True)
class Cover:
    """Set cover: indices of the selected sets, their cost, and a lower bound for the cost of any cover.

    Attributes
    ----------
    chosen : int64
        Ordered by gain per cost.
    cost : float
        Total cost.
    bound : float
        Lower bound for the cost of any cover.
    greedy : float
        Cost of the greedy choice, after the required sets.
    """

    chosen: Ints
    cost: float
    bound: float
    greedy: float

    @property
    def exact(self) -> bool:
        """True if no cheaper set cover exists."""
        return self.cost <= self.bound + ROUNDING * max(self.cost, 1)


def minimal(family: SetFamily, nodes: int = NODES) -> Cover:
    """Return a cheap set cover, with a lower bound for the cost of any cover.

    Parameters
    ----------
    family : SetFamily
    nodes : int
        Greatest number of solver nodes, in all parts together; 0 for greedy choice and bound only.
    """
    forced, rest = reduced(family)
    chosen, bound = [forced], float(family.cost[forced].sum())
    plain = bound
    for part, sets in rest:
        own = greedy(part)
        plain += float(part.cost[own].sum())
        low, own, _ = bounded(part, thinned(part, own))
        low = math.ceil(low - ROUNDING) if part.whole else low
        if part.cost[own].sum() > low + ROUNDING:
            own, proven, used = improved(part, own, nodes)
            low, nodes = max(low, proven), nodes - used
        chosen.append(sets[own])
        bound += min(low, float(part.cost[own].sum()))
    all_chosen = np.concatenate(chosen)
    cost = float(family.cost[all_chosen].sum())
    return Cover(ordered(family, all_chosen), cost, min(bound, cost), plain)


@dataclass(frozen=True)
class Fitted:
    """Sets selected within a budget, and the weight of the elements that they cover.

    Attributes
    ----------
    chosen : int64
        In order of choice.
    cost : float
    met : int
        Amount of met needs: for each element at most its need, times its weight.
    most : float
        Upper bound for any sets within the budget.
    """

    chosen: Ints
    cost: float
    met: int
    most: float


def within(family: SetFamily, budget: float) -> Fitted:
    """Select sets within a budget that cover many elements: a greedy choice, or the best single set.

    The bound is that of submodular functions: for any current choice, the optimum meets at most its
    needs plus the largest gains of single sets that fit the budget together, the last one in part.
    """
    chosen = or_alone(family, greedy(family, budget), budget)
    at = np.unique(np.linspace(0, len(chosen), 16).astype(np.int64)).tolist()
    most = min(_at_most(family, chosen[:many], budget) for many in at)
    reached = met(family, chosen)
    return Fitted(chosen, float(family.cost[chosen].sum()), reached, max(most, reached))


def _at_most(family: SetFamily, chosen: Ints, budget: float) -> float:
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


# Overlapping units, whose shared frames cost once: few, cheap, or best within a budget. The cost of
# clips in frames, seconds or bytes is the cost of their union. *Pieces* are the stretches between
# consecutive beginnings and ends of units: each unit is a range of pieces, and pieces do not
# overlap. A set of pieces is never worse than its units; therefore bounds for covers by pieces also
# hold for covers by units. Units are chosen greedily, by gain per cost of their uncovered pieces.


@dataclass(frozen=True)
class UnitPieces:
    """Clips, divided into pieces at every start and end. The cost of a piece in several clips counts once.

    Attributes
    ----------
    begin, end : (U,) int64
        Both ascending.
    cost : (P,) float64
        Cost of each piece.
    """

    begin: Ints
    end: Ints
    cost: Floats

    def left(self, one: int, taken: Bools) -> float:
        """For a clip, return the cost of its pieces that are not selected yet."""
        own = slice(int(self.begin[one]), int(self.end[one]))
        return float(self.cost[own][~taken[own]].sum())

    def beside(self, one: int) -> range:
        """Return the range of clips that overlap with a clip, including this clip."""
        low = int(np.searchsorted(self.end, self.begin[one], side="right"))
        return range(low, int(np.searchsorted(self.begin, self.end[one])))

    def together(self, picked: Ints) -> float:
        """Return the total cost of some clips; shared frames cost once."""
        taken = np.zeros(len(self.cost), np.bool_)
        for one in picked.tolist():
            taken[self.begin[one] : self.end[one]] = True
        return float(self.cost[taken].sum())


def pieces(units: Units, measure: Measure) -> tuple[Units, UnitPieces]:
    """Cut all clips where any clip starts or ends. Return the pieces, and the range of pieces of each clip."""
    cuts = np.unique(np.concatenate([units.begin, units.end]))
    parts = replace(units, begin=cuts[:-1], end=cuts[1:])
    cost = parts.summed(units.weights(measure), measure)
    begin, end = np.searchsorted(cuts, units.begin), np.searchsorted(cuts, units.end)
    return parts, UnitPieces(begin.astype(np.int64), end.astype(np.int64), cost)


def cheapest(units: Units, held: Holdings, measure: Measure, rank: Ints) -> Cover:
    """Return clips (or frames or traces) that contain all scene classes at a low total cost.

    The bound comes from single pieces.
    """
    parts, spans = pieces(units, measure)
    family = held.family(units, units.costs(measure), 1, rank)
    own = _thinned(family, spans, _greedy(family, spans))
    cost = greedy = spans.together(own)
    few = minimal(replace(family, cost=np.ones(len(units)))).chosen
    if spans.together(few) < cost:
        own, cost = few, spans.together(few)
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    return Cover(ordered(family, own), cost, min(minimal(alone).bound, cost), greedy)


def affordable(units: Units, held: Holdings, measure: Measure, rank: Ints, budget: float) -> Fitted:
    """Return clips (or frames or traces) within a budget that contain many scene classes.

    The bound comes from single pieces.
    """
    parts, spans = pieces(units, measure)
    family = held.family(units, units.costs(measure), 1, rank)
    chosen = or_alone(family, _greedy(family, spans, budget), budget)
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    reached = met(family, chosen)
    most = max(within(alone, budget).most, reached)
    return Fitted(chosen, spans.together(chosen), reached, most)


def _greedy(family: SetFamily, spans: UnitPieces, budget: float = math.inf) -> Ints:
    """Select clips one by one, each time the clip with the most new elements per additional cost."""
    taken = np.zeros(len(spans.cost), np.bool_)

    def cheapened(one: int) -> Iterator[tuple[int, float]]:
        """Mark a clip as selected. Yield the clips that overlap with it, each with its lower price."""
        taken[spans.begin[one] : spans.end[one]] = True
        for other in spans.beside(one):
            yield other, max(spans.left(other, taken), 1e-9)

    return greedy(family, budget, cheapened)


def _thinned(family: SetFamily, spans: UnitPieces, chosen: Ints) -> Ints:
    """Return the selected clips without redundant ones. The most expensive redundant clip is removed first."""
    times = np.zeros(len(spans.cost) + 1, np.int64)
    np.add.at(times, spans.begin[chosen], 1)
    np.add.at(times, spans.end[chosen], -1)
    shared = np.cumsum(times)[:-1] > 1
    saved = np.array([spans.left(one, shared) for one in chosen.tolist()])
    return thinned(family, chosen, np.argsort(-saved, kind="stable"))
