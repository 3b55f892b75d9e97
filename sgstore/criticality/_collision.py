"""TTC*: from each frame on, the time until the recorded footprints first touch.

ttc_recorded(t) (s) = min { t′ − t : t′ ≥ t, the footprints of both at t′ overlap or touch }. Source: Lin and
Althoff, CommonRoad-CriMe, IV 2023, where the road's edge counts, too, which here it does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.criticality._encounter import Encounter
    from sgstore.world import Floats


def ttc_recorded(of: Encounter) -> Floats:
    """(T,): time to the recorded collision, of each frame that has both; s. NaN: none follows."""
    times = of.times
    met = np.where(of.numbers["gap"] <= 0, times, np.inf)
    first = np.minimum.accumulate(met[::-1])[::-1]
    return np.where(np.isfinite(first), first - times, np.nan)
