"""Collisions and crossed lane markings, as the sensors of CARLA's bridge tell them.

Source: ros-carla-msgs, CarlaCollisionEvent and CarlaLaneInvasionEvent.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from sgstore.traces.carla_channels import COLLISION, LANE_INVASION, ident_of
from sgstore.traces.cdr import number
from sgstore.world import Event

EVENTS: Final = frozenset({COLLISION, LANE_INVASION})
"""Contents of the channels that tell events."""
_MARKINGS: Final = {0: "other", 1: "broken", 2: "solid"}


def event_of(
    content: str, message: dict[str, Any], place: tuple[int, int, int], ident: str
) -> Event:
    """The event that a message tells.

    ``place``: simulation time, log time, number of the frame before it; ``ident``: id of the vehicle.
    """
    if content == COLLISION:
        other = ident_of(message, "other_actor_id")
        impulse = math.hypot(*(number(message, f"normal_impulse.{axis}") for axis in "xyz"))
        return Event(
            "collision",
            *place,
            ident,
            "" if other is None else str(other),
            impulse if math.isfinite(impulse) else None,
        )
    told = message.get("crossed_lane_markings")
    crossed = told.tolist() if isinstance(told, np.ndarray) else []
    names = dict.fromkeys(_MARKINGS.get(marking, "other") for marking in crossed)
    return Event("lane_invasion", *place, ident, detail=", ".join(names))
