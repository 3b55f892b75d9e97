"""Encroachment: times at which two objects are in their conflict area (area that both cross).

The conflict area of two tracks is the area that both footprints cover, at any time. An entity is in
it while its footprint overlaps any footprint of the other entity, at any time. It enters with the
first such frame, and leaves with the first frame after the last one.

* PET (s) = entry of the second entity − exit of the first entity. Source: Allen, Shin and Cooper,
  Analysis of Traffic Conflicts and Collisions, 1978.
* ET (s) = exit − entry of one entity. Source: the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter, Track
    from sgstore.model.world import Bools


@dataclass(frozen=True)
class Encroachment:
    """Entry and exit times of two objects in their conflict area; s. NaN means unknown, or no such area.

    Attributes
    ----------
    enters_a, leaves_a, enters_b, leaves_b : float
    """

    enters_a: float
    leaves_a: float
    enters_b: float
    leaves_b: float


def encroachment(of: Encounter) -> Encroachment:
    """Return entry and exit times of two objects in their conflict area (area that both cross).

    An entry is unknown if the first frame is in the area, and an exit if the last frame is.
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
    """Return the post-encroachment time: from the first object's exit to the second's entry; s.

    NaN without a conflict area, if both were in it at once, or if the recording begins or ends in
    it.
    """
    when = encroachment(of)
    if when.leaves_a <= when.enters_b:
        return when.enters_b - when.leaves_a
    if when.leaves_b <= when.enters_a:
        return when.enters_a - when.leaves_b
    return math.nan


def et_recorded(of: Encounter) -> float:
    """Return the encroachment time: how long object a is in the conflict area; s. NaN if unknown."""
    when = encroachment(of)
    return when.leaves_a - when.enters_a
