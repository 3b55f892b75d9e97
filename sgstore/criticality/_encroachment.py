"""Encroachment: who was where both drove, and when the other one came.

The conflict area of two tracks is what the footprints of both cover, each at some time. Somebody is in it
while its footprint overlaps one of the other one's, whenever that was there. It comes in with the first frame
in which it does, and has left with the first frame after the last one.

* PET (s) = entry of the second one − exit of the first one. Source: Allen, Shin and Cooper, Analysis of
  Traffic Conflicts and Collisions, 1978.
* ET (s) = exit − entry of one. Source: the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.criticality._encounter import Encounter, Track
    from sgstore.world import Bools


@dataclass(frozen=True)
class Encroachment:
    """When both were in their conflict area; s. NaN: there is none, or the recording does not say it.

    Attributes
    ----------
    enters_a, leaves_a, enters_b, leaves_b : float
    """

    enters_a: float
    leaves_a: float
    enters_b: float
    leaves_b: float


def encroachment(of: Encounter) -> Encroachment:
    """When both were in the area that the footprints of both cover.

    Unknown are the entry of who is in it in its first frame, and the exit of who is in it in its last one.
    """
    inside = [np.zeros(len(one), np.bool_) for one in (of.a, of.b)]
    for rows in of.crossings():
        for on, found in zip(inside, rows, strict=True):
            on[found] = True
    enters_a, leaves_a = _span(of.a, inside[0])
    enters_b, leaves_b = _span(of.b, inside[1])
    return Encroachment(enters_a, leaves_a, enters_b, leaves_b)


def _span(track: Track, inside: Bools) -> tuple[float, float]:
    rows = np.flatnonzero(inside)
    if not len(rows):
        return math.nan, math.nan
    first, last = int(rows[0]), int(rows[-1])
    enters = float(track.times[first]) if first > 0 else math.nan
    return enters, float(track.times[last + 1]) if last + 1 < len(track) else math.nan


def pet(of: Encounter) -> float:
    """Post-encroachment time; s.

    NaN where there is no conflict area, both were in it at once, or the recording begins or ends within.
    """
    when = encroachment(of)
    if when.leaves_a <= when.enters_b:
        return when.enters_b - when.leaves_a
    if when.leaves_b <= when.enters_a:
        return when.enters_a - when.leaves_b
    return math.nan


def et_recorded(of: Encounter) -> float:
    """Encroachment time: how long a was in the area; s. NaN where its entry or its exit is not known."""
    when = encroachment(of)
    return when.leaves_a - when.enters_a
