"""Collisions and crossed lane markings, as the sensors of CARLA's bridge tell them.

Source: ros-carla-msgs, CarlaCollisionEvent and CarlaLaneInvasionEvent.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.traces.carla_channels import COLLISION, LANE_INVASION, ident_of
from sgstore.traces.cdr import number
from sgstore.world import Event

if TYPE_CHECKING:
    from sgstore.world import TraceReport

EVENTS: Final = frozenset({COLLISION, LANE_INVASION})
"""Contents of the channels that tell events."""
MOST_EVENTS: Final = 10_000
"""Events that a report lists; a vehicle that leans on a wall collides in every frame."""

_MARKINGS: Final = {0: "other", 1: "broken", 2: "solid"}


class Events:
    """The events of a trace.

    Parameters
    ----------
    report : TraceReport
        Takes them up.
    """

    def __init__(self, report: TraceReport) -> None:
        self._report = report
        self._more = 0

    def take(
        self, content: str, message: dict[str, Any], place: tuple[int, int, int], ident: str
    ) -> None:
        """Take up a message. ``place``: simulation time, log time, frame; ``ident``: id of the vehicle."""
        if len(self._report.events) >= MOST_EVENTS:
            self._more += 1
            return
        time_ns, log_time_ns, seq = place
        if content == COLLISION:
            other = ident_of(message, "other_actor_id")
            impulse = math.hypot(*(number(message, f"normal_impulse.{axis}") for axis in "xyz"))
            event = Event(
                "collision",
                time_ns,
                log_time_ns,
                seq,
                ident,
                "" if other is None else str(other),
                impulse if math.isfinite(impulse) else None,
            )
        else:
            told = message.get("crossed_lane_markings")
            crossed = told.tolist() if isinstance(told, np.ndarray) else []
            names = dict.fromkeys(_MARKINGS.get(marking, "other") for marking in crossed)
            event = Event(
                "lane_invasion", time_ns, log_time_ns, seq, ident, detail=", ".join(names)
            )
        self._report.events.append(event)

    def settle(self) -> None:
        """Say how many events were not listed."""
        if self._more:
            self._report.warnings.append(
                f"{self._more} more events than the {MOST_EVENTS} that are listed"
            )
