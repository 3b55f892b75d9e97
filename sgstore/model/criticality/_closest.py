"""Smallest distance and first contact of two objects in the recording, from each frame on.

dce_recorded(t) (m) = min { gap(t′) : t′ ≥ t }, ttce_recorded(t) (s) = the first such t′ minus t.
Source: Eggert, Predictive Risk Estimation for Intelligent ADAS Functions, 2014.

ttc_recorded(t) (s) = min { t′ − t : t′ ≥ t, the footprints of both at t′ overlap or touch }.
Source: Lin and Althoff, CommonRoad-CriMe, IV 2023. There the road's edge counts too; here it does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.world import Floats


def dce_recorded(of: Encounter) -> Floats:
    """Return the smallest gap between two objects from each frame to the end, (T,); m. NaN if unknown."""
    gap = of.numbers["gap"]
    least = np.minimum.accumulate(np.where(np.isnan(gap), np.inf, gap)[::-1])[::-1]
    return np.where(np.isfinite(least), least, np.nan)


def ttce_recorded(of: Encounter) -> Floats:
    """Return the time from each frame until two objects have their smallest gap, (T,); s."""
    gap, times, least = of.numbers["gap"], of.times, dce_recorded(of)
    found = np.full(len(times), np.nan)
    when = np.nan
    for row in range(len(times) - 1, -1, -1):
        if gap[row] == least[row]:
            when = times[row]
        found[row] = when - times[row]
    return found


def ttc_recorded(of: Encounter) -> Floats:
    """Return the time from each frame until two objects touch in the recording, (T,); s. NaN for never."""
    times = of.times
    met = np.where(of.numbers["gap"] <= 0, times, np.inf)
    first = np.minimum.accumulate(met[::-1])[::-1]
    return np.where(np.isfinite(first), first - times, np.nan)
