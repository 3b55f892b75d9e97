"""Types of lanes and the words for their turns: what they mean, whatever a map was read from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Floats

DRIVING: Final = frozenset(
    {"driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane"}
    | {"bus", "taxi", "HOV", "mwyEntry", "mwyExit"}
)
"""Types of lanes that are made for motor traffic. (ASAM OpenDRIVE 1.4 to 1.8, lane types.)"""
TRAFFIC: Final = DRIVING | {"biking", "special1", "special2", "special3"}
"""Types of lanes that have a direction of travel which matters to their neighbours."""

STRAIGHT: Final = np.radians(30.0)
"""A lane through a junction that turns by less goes straight on; rad."""


def turn_words(turn: Floats) -> list[str]:
    """``left``, ``right`` or ``straight`` for lanes that turn by so much, positive to the left; rad."""
    words = np.where(turn > STRAIGHT, "left", np.where(turn < -STRAIGHT, "right", "straight"))
    return list(map(str, words))
