"""Measure TTC*: time until two recorded objects first touch, from each frame on.

ttc_recorded(t) (s) = min { t′ − t : t′ ≥ t, the footprints of both at t′ overlap or touch }.
Source: Lin and Althoff, CommonRoad-CriMe, IV 2023. There the road's edge counts too; here it does
not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.world import Floats


def ttc_recorded(of: Encounter) -> Floats:
    """Return the time until two objects touch in the recording, for each frame, (T,); s. NaN for never."""
    times = of.times
    met = np.where(of.numbers["gap"] <= 0, times, np.inf)
    first = np.minimum.accumulate(met[::-1])[::-1]
    return np.where(np.isfinite(first), first - times, np.nan)
