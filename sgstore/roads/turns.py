"""The words for the turns of lanes, whatever a map was read from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Floats

STRAIGHT: Final = np.radians(30.0)
"""A lane through a junction that turns by less goes straight on; rad."""


def turn_words(turn: Floats) -> list[str]:
    """``left``, ``right`` or ``straight`` for lanes that turn by so much, positive to the left; rad."""
    words = np.where(turn > STRAIGHT, "left", np.where(turn < -STRAIGHT, "right", "straight"))
    return list(map(str, words))
