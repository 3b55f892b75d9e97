"""Measure of object pairs: earliest possible contact if both accelerate only a little."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

_AXES: Final = (1, 2, 3, 4)

NUMBERS: Final[Mapping[str, PairFunction]] = {
    # A box that accelerates by up to 2 m/s² along and across its axis is, after t, somewhere in its
    # footprint grown by t² on each side. On one axis the shadows of such boxes are apart in at most
    # two intervals of time: before b has come, and after b has passed, until the quadratic growth
    # reaches it. The boxes first meet at the first time outside the intervals of all four axes.
    "ttc_mild": measure(
        "mild-case time to collision: before it their footprints cannot touch, if both keep their heading and"
        " accelerate by at most 2 m/s² along and 2 m/s² across their axes",
        "s",
        "CASE WHEN planar + reach1 + reach2 + rel_speed IS NOT NULL THEN mild4 END",
        "0 where they touch or overlap",
        "Wachenfeld et al., The Worst-Time-To-Collision Metric for Situation Identification, IV 2016 (of boxes,"
        " and of what is comfortable: Kesting, Treiber and Helbing, Enhanced Intelligent Driver Model, 2010)",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    "growth": "1 + co + si",
    **{f"before{i}": f"greatest(-reach{i} - place{i}, 0)" for i in _AXES},
    **{
        f"until{i}": f"2 * before{i} / (rate{i} + sqrt(rate{i} * rate{i} + 4 * growth * before{i}))"
        for i in _AXES
    },
    **{f"caught{i}": f"rate{i} * rate{i} + 4 * growth * (place{i} - reach{i})" for i in _AXES},
    **{f"outrun{i}": f"rate{i} + sqrt(CASE WHEN caught{i} > 0 THEN caught{i} END)" for i in _AXES},
    **{f"past_from{i}": f"2 * (reach{i} - place{i}) / outrun{i}" for i in _AXES},
    **{f"past_to{i}": f"outrun{i} / (2 * growth)" for i in _AXES},
    # Waiting four times until the end of the current interval leaves the intervals of all four
    # axes.
    "mild0": f"greatest({', '.join(f'until{i}' for i in _AXES)})",
    **{
        f"mild{n}": f"greatest(mild{n - 1}, "
        + ", ".join(
            f"CASE WHEN past_from{i} < mild{n - 1} AND mild{n - 1} < past_to{i} THEN past_to{i} END"
            for i in _AXES
        )
        + ")"
        for n in _AXES
    },
}
