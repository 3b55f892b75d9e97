"""A budget that is spent unit by unit; what units share is paid once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sgstore.selection.units import Measure

if TYPE_CHECKING:
    from sgstore.selection.units import Units
    from sgstore.world import Bools, Floats, Ints

ROUNDING = 1 + 1e-12
"""Sums of costs may be a hair above a budget that they meet."""


@dataclass
class Purse:
    """What is left of a budget, and what was bought.

    Attributes
    ----------
    units : Units
    cost : (U,) float64
        What each unit costs alone.
    weights : (N,) float64 or None
        What each frame costs, where units share frames.
    bought : (N,) bool
    spent : float
    left : float
    """

    units: Units
    cost: Floats
    weights: Floats | None
    bought: Bools
    spent: float
    left: float

    @classmethod
    def of(cls, units: Units, measure: Measure, most: float = np.inf) -> Purse:
        """A full purse."""
        shared = units.overlap and measure is not Measure.units
        weights = units.weights(measure) if shared else None
        nothing = np.zeros(len(units.frame_id), np.bool_)
        return cls(units, units.costs(measure), weights, nothing, 0.0, most * ROUNDING)

    def prices(self, some: Ints) -> Floats:
        """What each of some units would cost now; 0: all of it was bought with others."""
        if self.weights is None:
            return self.cost[some]
        begin, end = self.units.begin[some].tolist(), self.units.end[some].tolist()
        rows = (slice(low, high) for low, high in zip(begin, end, strict=True))
        return np.array([self.weights[own][~self.bought[own]].sum() for own in rows])

    def buy(self, one: int, price: float) -> None:
        """Take a unit."""
        self.bought[self.units.begin[one] : self.units.end[one]] = True
        self.spent += price
        self.left -= price

    def fitting(self, order: Ints, most: float = np.inf) -> Ints:
        """Buy units in order, up to so much; what does not fit any more, or brings no frame, is passed over."""
        found: list[int] = []
        end = max(self.left - most * ROUNDING, 0.0)
        cost = self.cost[order]
        smallest = np.minimum.accumulate(cost[::-1])[::-1] if self.weights is None else None
        for place, (one, alone) in enumerate(zip(order.tolist(), cost.tolist(), strict=True)):
            room = self.left - end
            if room <= 0 or (smallest is not None and smallest[place] > room):
                break
            price = (
                alone if self.weights is None else float(self.prices(order[place : place + 1])[0])
            )
            if 0 < price <= room:
                found.append(one)
                self.buy(one, price)
        return np.array(found, np.int64)
