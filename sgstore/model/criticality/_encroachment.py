"""Encroachment: times at which two objects enter and leave their conflict area (area that both cross).

The conflict area of two tracks is the area that both footprints cover, at any time. An entity is in
it while its footprint overlaps any footprint of the other entity, at any time. It enters with the
first such frame, and leaves with the first frame after the last one.

* PET (s) = entry of the second entity − exit of the first entity. Source: Allen, Shin and Cooper,
  Analysis of Traffic Conflicts and Collisions, 1978.
* ET (s) = exit − entry of one entity. Source: the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.model.criticality._footprints import FOOTPRINT, Footprints

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.world import Floats


@dataclass(frozen=True)
class Encroachment:
    """Times at which two objects enter and leave their conflict area; s. NaN if unknown or no such area.

    Attributes
    ----------
    enters_a, leaves_a, enters_b, leaves_b : float
    """

    enters_a: float
    leaves_a: float
    enters_b: float
    leaves_b: float


def encroachment(of: Encounter) -> Encroachment:
    """Return when two objects enter and leave their conflict area (area that both cross); s.

    An entry is unknown if the first frame is in the area, and an exit if the last frame is.
    """
    return Encroachment(*_when(of)[0].tolist())


def _when(of: Encounter) -> Floats:
    """Return when two objects enter and leave their conflict area as an array, (1, 4); s."""
    objects = np.repeat([0, 1], [len(of.a), len(of.b)])
    states = np.concatenate([of.a.states, of.b.states])
    footprints = Footprints(objects, states[:, FOOTPRINT].T)
    times = np.concatenate([of.a.times, of.b.times, [np.nan]])  # -1 is the last one
    if len(footprints.objects) < 2:  # one has no states
        return np.full((1, 4), np.nan)
    return times[footprints.crossed(np.array([0]), np.array([1]))]


def _pet(when: Floats) -> Floats:
    enters_a, leaves_a, enters_b, leaves_b = when.T
    second_a = np.where(leaves_b <= enters_a, enters_a - leaves_b, np.nan)
    return np.where(leaves_a <= enters_b, enters_b - leaves_a, second_a)


def _et(when: Floats) -> Floats:
    return when[:, 1] - when[:, 0]


OF_AREAS: Final[dict[str, Callable[[Floats], Floats]]] = {"pet": _pet, "et_recorded": _et}
"""Name of a measure → function from the entry and exit times of both objects, (P, 4), to its values, (P,)."""


def pet(of: Encounter) -> float:
    """Return the post-encroachment time: from the first object's exit to the second's entry; s.

    NaN without a conflict area, if both were in it at once, or if the recording begins or ends in
    it.
    """
    return float(_pet(_when(of))[0])


def et_recorded(of: Encounter) -> float:
    """Return the encroachment time: how long object a stays in the conflict area; s. NaN if unknown."""
    return float(_et(_when(of))[0])
