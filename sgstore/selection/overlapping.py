"""Units that overlap, where what they share costs once: few, cheap, or as good as a budget allows.

What some clips cost together in frames, seconds or bytes is what their union costs. *Pieces* are the stretches
between one beginning or end of a unit and the next: each unit is a row of pieces, and pieces do not overlap.
So a set of pieces is never worse than the units that they are of, and what is known of covers by pieces
bounds covers by units. Units are chosen greedily, by what they bring for the pieces that no chosen one has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sgstore.selection.cover import Cover, Fitted, minimal, within
from sgstore.selection.greedy import greedy, met, or_alone, ordered, thinned

if TYPE_CHECKING:
    from collections.abc import Iterator

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
    chosen = or_alone(family, _greedy(family, spans, budget), budget)
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    reached = met(family, chosen)
    most = max(within(alone, budget).most, reached)
    return Fitted(chosen, spans.together(chosen), reached, most)


def _greedy(family: Family, spans: Spans, budget: float = math.inf) -> Ints:
    """Units, one after another, each the one that brings most for what it costs beyond those before it."""
    taken = np.zeros(len(spans.cost), np.bool_)

    def cheapened(one: int) -> Iterator[tuple[int, float]]:
        """What others share with this one is paid."""
        taken[spans.begin[one] : spans.end[one]] = True
        for other in spans.beside(one):
            yield other, max(spans.left(other, taken), 1e-9)

    return greedy(family, budget, cheapened)


def _thinned(family: Family, spans: Spans, chosen: Ints) -> Ints:
    """Without the units that the others make superfluous, those first that cost most beyond the others."""
    times = np.zeros(len(spans.cost) + 1, np.int64)
    np.add.at(times, spans.begin[chosen], 1)
    np.add.at(times, spans.end[chosen], -1)
    shared = np.cumsum(times)[:-1] > 1
    saved = np.array([spans.left(one, shared) for one in chosen.tolist()])
    return thinned(family, chosen, np.argsort(-saved, kind="stable"))
