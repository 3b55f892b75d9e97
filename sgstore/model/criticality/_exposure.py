"""Exposure measures (TET, TIT): for how long the time to collision of an encounter is short.

TET (s) = Σ Δt over frames with ttc ≤ τ, TIT (s²) = Σ (τ − ttc) Δt over the same frames; Δt is the
time to the next frame. Source: Minderhoud and Bovy, Extended Time-to-Collision Measures for Road
Traffic Safety Assessment, AAP 33, 2001.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter

TAU: Final = 2.0
"""Limit of the time to collision at or below which an entity counts as exposed; s."""


def tet(of: Encounter, tau: float = TAU) -> float:
    """Return the time exposed time to collision (TET): total time with a TTC of at most ``tau``; s."""
    return _summed(of, tau, 0)


def tit(of: Encounter, tau: float = TAU) -> float:
    """Return the time integrated time to collision (TIT): integral of ``tau - TTC`` where TTC < ``tau``; s²."""
    return _summed(of, tau, 1)


def _summed(of: Encounter, tau: float, power: int) -> float:
    times, ttc = of.times, of.numbers["ttc"]
    exposed = np.flatnonzero(ttc[:-1] <= tau)
    return float(((tau - ttc[exposed]) ** power * np.diff(times)[exposed]).sum())
