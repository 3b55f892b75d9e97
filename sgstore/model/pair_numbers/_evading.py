"""Measures of object pairs: time or distance that remains to evade by acceleration or braking."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

NUMBERS: Final[Mapping[str, PairFunction]] = {
    "ttk": measure(
        "time to kick down: how long a may wait before it has to accelerate by 8 m/s² so that it has left the"
        " area where their straight paths cross before b enters it, or so that b behind it does not run into"
        " it; b keeps its velocity",
        "s",
        "CASE WHEN trail IS NOT NULL THEN CASE WHEN closing < 0 THEN closing / 16e0 - trail / closing END"
        " WHEN between <= 0 AND enters_b > 0 AND cross_a + stay_a >= 0"
        " THEN enters_b - sqrt(abs(pace * (cross_a + stay_a - enters_b)) / 4e0) END",
        "below 0: too late; NULL where b is behind and does not close in, and else where pret is not 0 or b is"
        " in the area already",
        "Tamke, Dang and Breuel, A Flexible Method for Criticality Assessment in Driver Assistance Systems,"
        " IV 2011",
    ),
    "msd": measure(
        "minimum stopping distance: how far a still goes if it brakes by 11.5 m/s²",
        "m",
        "CASE WHEN lon IS NOT NULL THEN pace * pace / 23e0 + solid END",
        "whoever b is",
        "Allen, Shin and Cooper, Analysis of Traffic Conflicts and Collisions, 1978",
        worse="high",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # Time when b reaches the area where straight paths cross, and b's distance behind in the strip
    # of a's path.
    "enters_b": "cross_b - stay_b",
    "trail": "CASE WHEN lon < 0 AND out2 < 0 THEN lon_gap END",
}
