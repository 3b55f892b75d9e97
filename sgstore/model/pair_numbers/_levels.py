"""Heights of the lower and upper side of objects, to separate storeys (bridges) and find flat objects.

Signals hang over the road and belong to no storey: they have no such heights. An upright kind never
has height 0: there 0 means an unrecorded height, as in recordings without heights.

Two bodies with separate heights can still be on one road that climbs between them. They are on
different storeys only if their lower sides differ by more than a road climbs over the distance of
their centres: by a grade of :data:`GRADE`, up to a storey, or by the pitch of one of them, if it is
recorded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Bools = NDArray[np.bool_]

HUNG: Final = ("traffic_light", "stop_sign", "yield_sign", "speed_limit", "sign")
"""Kinds of entities that belong to no storey, such as traffic lights."""

UPRIGHT: Final = (
    *("car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer", "train", "vehicle"),
    *("person", "animal", "building", "pole", "barrier", "vegetation"),
)
"""Kinds of entities that always have a height, even if it is not recorded, such as vehicles."""

OPTIONAL: Final = ("low", "high", "node_id", "carrier", "pitch")
"""Columns of an entity that may be unknown. A pair number has a value without them.

Heights of its lower and upper side (m), node id, node id of its carrier, and its pitch (rad).
"""

TOUCH: Final = 1e-4
"""Distance below which two bodies count as touching, because positions far from the origin are rounded; m."""

STOREY: Final = 2.5
"""Smallest difference between the lower sides of objects on different storeys, if a height is unknown; m."""


GRADE: Final = 0.1
"""Largest grade of a road for objects without a known pitch."""

STEEPEST: Final = 0.25
"""Largest grade of a road that is derived from the pitch of an object."""


UNEVEN: Final = {"flat": 1, "storeys": 2, "carried": 4, "near_flat": 8, "near_storeys": 16}
"""Bits for the special pairs in a trace. ``near_…``: only among moving entities and static road users."""


def all_level(low: Floats, high: Floats, frame: NDArray[np.int64] | None = None) -> bool:
    """Return True if all compared objects are on the same storey (no bridge between them).

    Parameters
    ----------
    low, high : (N,) float64
    frame : (N,) int64, optional
        Only bodies of one frame are compared.
    """
    if not len(low):
        return True
    frame = np.zeros(len(low), np.int64) if frame is None else frame
    solid, known = high > low, ~np.isnan(low)
    count = int(frame.max()) + 1

    def extremes(rows: Bools, least: Floats) -> Floats:
        highest, lowest = np.full(count, -np.inf), np.full(count, np.inf)
        np.maximum.at(highest, frame[rows], low[rows])
        np.minimum.at(lowest, frame[rows], least[rows])
        return highest - lowest

    if (extremes(solid, high) > TOUCH).any():
        return False
    return bool((solid == known).all() or (extremes(known, low) <= STOREY).all())


def climb(distance: Floats, pitch_a: Floats, pitch_b: Floats) -> Floats:
    """Return by how much a road can rise between two objects, from their distance and pitch; m.

    Parameters
    ----------
    distance : (K,) float64
        Plane distance of their centres; m.
    pitch_a, pitch_b : (K,) float64
        NaN means unknown; rad.

    Returns
    -------
    (K,) float64
    """
    pitch = np.fmax(np.nan_to_num(np.abs(np.sin(pitch_a))), np.nan_to_num(np.abs(np.sin(pitch_b))))
    return np.fmax(np.fmin(GRADE * distance, STOREY), np.fmin(pitch, STEEPEST) * distance)


def low_and_high(z: Floats, height: Floats, hung: Bools, upright: Bools) -> tuple[Floats, Floats]:
    """Return the heights of the lower and the upper side of objects; m.

    Parameters
    ----------
    z, height : (N,) float64
        Height of the centre of the box, and its extent; m.
    hung, upright : (N,) bool
        Masks of the kinds in :data:`HUNG`, and in :data:`UPRIGHT`.

    Returns
    -------
    low, high : (N,) float64
        Metres; NaN for signals and unknown positions; ``high`` also for unknown heights.
    """
    half = np.where(upright & (height == 0), np.nan, height / 2)
    low = np.where(hung, np.nan, z - np.where(np.isnan(half), 0.0, half))
    return low, np.where(hung, np.nan, z + half)


def low_and_high_sql(column: Callable[[str], str], *, upright: bool = False) -> dict[str, str]:
    """Return SQL expressions for the heights of the lower and the upper side of an object.

    ``upright``: all bodies are known to be upright and not signals.
    """
    z, height, kind = (column(name) for name in ("z", "height", "kind"))
    if upright:
        return {"low": f"{z} - coalesce({height}, 0) / 2", "high": f"{z} + nullif({height}, 0) / 2"}
    hung, standing = (", ".join(f"'{kind}'" for kind in kinds) for kinds in (HUNG, UPRIGHT))
    flat = f"{height} = 0 AND {kind} IN ({standing})"
    half = f"CASE WHEN {flat} THEN NULL ELSE {height} / 2 END"
    return {
        "low": f"CASE WHEN {kind} IN ({hung}) THEN NULL ELSE {z} - coalesce({half}, 0) END",
        "high": f"CASE WHEN {kind} IN ({hung}) THEN NULL ELSE {z} + {half} END",
    }
