"""Recorded headway: time until object a is at the present position of object b.

headway_recorded(t) (s) = min { t′ − t : t′ ≥ t, the footprint of a at t′ touches the one of b at t
}. Source: Jansson, Collision Avoidance Theory, 2005. Here the path is the recorded one, so that it
can bend.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.world import Floats


def headway_recorded(of: Encounter) -> Floats:
    """Return the time until object a reaches b's present position, for each frame, (T,); s. NaN for never."""
    comes = np.full(len(of.b), np.inf)
    for rows_a, rows_b in of.crossings():
        later = of.a.times[rows_a] - of.b.times[rows_b]
        ahead = later >= 0
        np.minimum.at(comes, rows_b[ahead], later[ahead])
    found = comes[of.together[1]]
    return np.where(np.isfinite(found), found, np.nan)
