"""Units that overlap, where what they share costs once: few, cheap, or as good as a budget allows.

What some clips cost together in frames, seconds or bytes is what their union costs. *Pieces* are the stretches
between one beginning or end of a unit and the next: each unit is a row of pieces, and pieces do not overlap.
So a set of pieces is never worse than the units that they are of, and what is known of covers by pieces
bounds covers by units. Units are chosen greedily, by what they bring for the pieces that no chosen one has.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sgstore.selection.cover import Cover, Fitted, minimal, ordered, within

if TYPE_CHECKING:
    from sgstore.selection.family import Family
    from sgstore.selection.units import Holdings, Measure, Units
    from sgstore.world import Bools, Floats, Ints


@dataclass(frozen=True)
class Spans:
    """Units as rows of pieces.

    Attributes
    ----------
    begin, end : (U,) int64
        Ascending, both.
    cost : (P,) float64
        Of each piece.
    """

    begin: Ints
    end: Ints
    cost: Floats

    def left(self, one: int, taken: Bools) -> float:
        """What a unit costs beyond the pieces that are taken."""
        own = slice(int(self.begin[one]), int(self.end[one]))
        return float(self.cost[own][~taken[own]].sum())

    def beside(self, one: int) -> range:
        """The units that share a piece with a unit, and itself."""
        low = int(np.searchsorted(self.end, self.begin[one], side="right"))
        return range(low, int(np.searchsorted(self.begin, self.end[one])))

    def together(self, picked: Ints) -> float:
        """What units cost together."""
        taken = np.zeros(len(self.cost), np.bool_)
        for one in picked.tolist():
            taken[self.begin[one] : self.end[one]] = True
        return float(self.cost[taken].sum())


def pieces(units: Units, measure: Measure) -> tuple[Units, Spans]:
    """The pieces of units, and the units as rows of them."""
    cuts = np.unique(np.concatenate([units.begin, units.end]))
    parts = replace(units, begin=cuts[:-1], end=cuts[1:])
    cost = parts.summed(units.weights(measure), measure)
    begin, end = np.searchsorted(cuts, units.begin), np.searchsorted(cuts, units.end)
    return parts, Spans(begin.astype(np.int64), end.astype(np.int64), cost)


def cheapest(units: Units, held: Holdings, measure: Measure, rank: Ints) -> Cover:
    """Units that hold everything, and whose union costs little: the greedy choice, or the fewest units.

    The bound is that of the pieces, chosen one by one.
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
    """Units whose union is within a budget, and that hold as much as can be: greedy, or the best one alone.

    The bound is that of the pieces, chosen one by one.
    """
    parts, spans = pieces(units, measure)
    family = held.family(units, units.costs(measure), 1, rank)
    chosen = _greedy(family, spans, budget)
    gain = family.gains(family.need > 0)
    single = np.flatnonzero(family.cost <= budget)
    if len(single):
        best = single[np.lexsort((rank[single], -gain[single]))[:1]]
        if gain[best].sum() > _met(family, chosen):
            chosen = best
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    met = _met(family, chosen)
    return Fitted(chosen, spans.together(chosen), met, max(within(alone, budget).most, met))


def _met(family: Family, chosen: Ints) -> int:
    return int(family.weight[family.covered(chosen) > 0].sum())


def _greedy(family: Family, spans: Spans, budget: float = math.inf) -> Ints:
    """Units, one after another, each the one that brings most for what it costs beyond those before it."""
    starts, of_element = family.by_element()
    open_ = np.ones(len(family.need), np.bool_)
    taken = np.zeros(len(spans.cost), np.bool_)
    gain, cost = family.gains(open_), family.cost.copy()
    rank = family.rank.tolist()
    heap = [(-gain[i] / cost[i], rank[i], i) for i in np.flatnonzero(gain).tolist()]
    heapq.heapify(heap)
    chosen: list[int] = []
    left = budget
    while heap:
        known, own, one = heapq.heappop(heap)
        if not gain[one] or cost[one] > left:
            continue
        value = -gain[one] / cost[one]
        if value > known:
            heapq.heappush(heap, (value, own, one))
            continue
        chosen.append(one)
        left -= cost[one]
        elements = family.elements(one)
        for element in elements[open_[elements]].tolist():
            gain[of_element[starts[element] : starts[element + 1]]] -= family.weight[element]
        open_[elements] = False
        gain[one] = 0
        taken[spans.begin[one] : spans.end[one]] = True
        for other in spans.beside(one):
            # What it shares with this one is paid: it may be worth more now, and fit a budget that it did not.
            cost[other] = max(spans.left(other, taken), 1e-9)
            if gain[other]:
                heapq.heappush(heap, (-gain[other] / cost[other], rank[other], other))
    return np.array(chosen, np.int64)


def _thinned(family: Family, spans: Spans, chosen: Ints) -> Ints:
    """Without the units that the others make superfluous, those first that cost most beyond the others."""
    often = family.covered(chosen)
    times = np.zeros(len(spans.cost) + 1, np.int64)
    np.add.at(times, spans.begin[chosen], 1)
    np.add.at(times, spans.end[chosen], -1)
    alone = np.cumsum(times)[:-1] == 1
    saved = np.array(
        [
            spans.cost[spans.begin[i] : spans.end[i]][alone[spans.begin[i] : spans.end[i]]].sum()
            for i in chosen.tolist()
        ]
    )
    keep = np.ones(len(chosen), np.bool_)
    for place in np.argsort(-saved, kind="stable").tolist():
        elements = family.elements(int(chosen[place]))
        if (often[elements] > 1).all():
            keep[place] = False
            often[elements] -= 1
    return chosen[keep]
