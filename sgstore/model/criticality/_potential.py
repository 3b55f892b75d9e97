"""Crash potential index (CPI): probability that braking alone is not enough to avoid a crash.

CPI = mean over frames of P(MADR < −a_long_req). The maximum available deceleration MADR has a
normal distribution around 8.45 m/s² with a deviation of 1.40 m/s², between 4.23 and 12.68 m/s².
Source: Cunto and Saccomanno, Microlevel Traffic Simulation Method for Assessing Crash Potential at
Intersections, TRB 2007.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.pair_numbers import PairNumbers
    from sgstore.model.world import Floats

_MEAN: Final = 8.45
_DEVIATION: Final = 1.40
_LEAST: Final = 4.23
_MOST: Final = 12.68


def _below(deceleration: float) -> float:
    """Return the probability that the greatest possible braking of a vehicle is below a value in m/s²."""
    return (1 + math.erf((deceleration - _MEAN) / _DEVIATION / math.sqrt(2))) / 2


def crash_probability(deceleration: Floats) -> Floats:
    """Return the probability that a vehicle cannot brake at a needed deceleration (m/s²), (n,). NaN for NaN."""
    low, high = _below(_LEAST), _below(_MOST)
    found = np.where(deceleration >= _MOST, 1.0, 0.0)
    for row in np.flatnonzero((deceleration > _LEAST) & (deceleration < _MOST)).tolist():
        found[row] = (_below(float(deceleration[row])) - low) / (high - low)
    return np.where(np.isnan(deceleration), np.nan, found)


def cpi(of: Encounter) -> float:
    """Return the crash potential index of an encounter of two objects, from 0 to 1.

    Frames without b ahead in a's path count as 0, frames with contact and without separation as 1;
    frames with an unknown required deceleration do not count. NaN if no frame counts.
    """
    chance = crash_chances(of.numbers)
    return float(np.nanmean(chance)) if (~np.isnan(chance)).any() else math.nan


def crash_chances(numbers: PairNumbers) -> Floats:
    """Return the probability that braking is not enough, (K,), for each frame with known values."""
    needed = -numbers["a_long_req"]
    placed = ~np.isnan(numbers["lon"] + numbers["reach1"] + numbers["reach2"])
    lost = (numbers["lead"] == 0) & (numbers["closing"] > 0)
    free = placed & np.isnan(numbers["lead"])
    return np.where(lost, 1.0, np.where(free, 0.0, crash_probability(needed)))
