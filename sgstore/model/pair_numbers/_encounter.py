"""Measures of object pairs: time of the smallest distance (closest encounter), and worst-case contact time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._boxes import BEYOND, GAP
from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

_EGGERT: Final = "Eggert, Predictive Risk Estimation for Intelligent ADAS Functions, 2014"
_MOVED: Final = re.compile(r"\b(lon|lat|back|side|(?:out|past|square)[1-4])\b")
_HALVES: Final = ((1, "la", 1, 2), (2, "wa", 2, 1), (3, "lb", 3, 4), (4, "wb", 4, 3))
"""Half extents of both boxes in SQL, each with the axis along it and the axis across it."""


def _after_3s(text: str) -> str:
    """In an SQL expression, replace the position of object b by its position 3 s later."""
    return _MOVED.sub(r"\1_3s", text)


NUMBERS: Final[Mapping[str, PairFunction]] = {
    # The distance of two moving boxes is a convex function of time. If they do not meet, b's line
    # past a is nearest to their Minkowski sum at a corner, or at an edge.
    "dce": measure(
        "distance of closest encounter: the least that the gap will be if both keep their velocity and do not"
        " turn",
        "m",
        "CASE WHEN ttc IS NOT NULL THEN 0 WHEN rel_speed >= 1e-6 AND abreast_until >= 0 THEN"
        " CASE WHEN clears < 0 THEN 0 ELSE clears END WHEN rel_speed IS NOT NULL THEN gap END",
        "0 where they will meet",
        _EGGERT,
    ),
    "ttce": measure(
        "time of closest encounter: when the gap will first be the least",
        "s",
        "CASE WHEN ttc IS NOT NULL THEN ttc WHEN rel_speed >= 1e-6 AND abreast_until >= 0 THEN"
        " CASE WHEN abreast < 0 THEN 0 ELSE abreast END"
        " WHEN rel_speed IS NOT NULL AND gap IS NOT NULL THEN 0 END",
        "0 where they are nearest now",
        _EGGERT,
        worse="",
    ),
    "dce_3s": measure(
        "the least that the gap will be within 3 s if both keep their velocity and do not turn",
        "m",
        "CASE WHEN ttce <= 3 THEN dce ELSE gap_3s END",
        "0 where they will meet by then",
        _EGGERT,
    ),
    "wttc": measure(
        "worst-case time to collision: before it they cannot meet, however both steer, brake and accelerate by"
        " up to 11.5 m/s², being discs around their footprints",
        "s",
        "CASE WHEN planar <= discs AND worst_p IS NOT NULL THEN 0"
        " WHEN worst_p IS NOT NULL AND worst_q IS NOT NULL AND worst_s IS NOT NULL THEN worst_t END",
        "0 where the discs overlap",
        "Wachenfeld et al., The Worst-Time-To-Collision Metric for Situation Identification, IV 2016",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # b relative to a: the clearance between its line and the Minkowski sum of both boxes, and the
    # time when its centre is level with the nearest corner, or with a parallel edge.
    "dotted": "dx * dvx + dy * dvy",
    "beyond": "dy * dvx - dx * dvy",
    "swath": "la * abs(drift2) + wa * abs(drift1) + lb * abs(drift4) + wb * abs(drift3)",
    "clears": "(abs(beyond) - swath) / rel_speed",
    **{
        f"edge{i}": f"CASE WHEN abs(drift{over}) <= 1e-9 * rel_speed THEN {half} * abs(drift{on}) ELSE 0 END"
        for i, half, on, over in _HALVES
    },
    **{
        f"corner{i}": f"CASE WHEN abs(drift{over}) <= 1e-9 * rel_speed THEN 0"
        f" WHEN drift{over} * {on - over} > 0 THEN {half} * drift{on} ELSE -{half} * drift{on} END"
        for i, half, on, over in _HALVES
    },
    **{
        f"{name}_3s": f"{name} + 3 * drift{i}"
        for i, name in enumerate(("lon", "lat", "back", "side"), 1)
    },
    **{_after_3s(name): _after_3s(text) for name, text in BEYOND.items()},
    "gap_3s": _after_3s(GAP),
    "edges": "edge1 + edge2 + edge3 + edge4",
    "corners": "corner1 + corner2 + corner3 + corner4",
    "nearest": "CASE WHEN beyond < 0 THEN -corners ELSE corners END - dotted",
    "abreast": "(nearest - edges) / nullif(rel_speed * rel_speed, 0)",
    "abreast_until": "(nearest + edges) / nullif(rel_speed * rel_speed, 0)",
    # The first time at which discs that grow by 11.5 t²/2 each touch: the least positive root of t⁴
    # + pt² + qt + s, where s < 0, by Ferrari: a root z of the resolvent cubic splits it into two
    # quadratics. Two Newton steps remove the rounding error. The values in abs() are not negative
    # where they are used.
    "discs": "sqrt(la * la + wa * wa) + sqrt(lb * lb + wb * wb)",
    "worst_p": "(23e0 * discs - rel_speed * rel_speed) / 132.25e0",
    "worst_q": "-2 * dotted / 132.25e0",
    "worst_s": "(discs * discs - planar * planar) / 132.25e0",
    "cubic_c": "(-worst_p * worst_p / 3 - 4 * worst_s) / 3",
    "cubic_d": "worst_p * (4 * worst_s - worst_p * worst_p / 9) / 3 - worst_q * worst_q / 2",
    "cubic_e": "cubic_d * cubic_d + cubic_c * cubic_c * cubic_c",
    "cubic_f": "greatest(cbrt(abs(cubic_d) + sqrt(abs(cubic_e))), 1e-200)",
    "cubic_y": "CASE WHEN cubic_e >= 0 THEN CASE WHEN cubic_d > 0 THEN cubic_c / cubic_f - cubic_f"
    " ELSE cubic_f - cubic_c / cubic_f END ELSE 2 * sqrt(abs(cubic_c)) * cos(acos(greatest(-1, least(1,"
    " -cubic_d / nullif(sqrt(abs(cubic_c * cubic_c * cubic_c)), 0)))) / 3) END",
    "ferrari_z": "greatest(cubic_y - 2 * worst_p / 3, 0)",
    "ferrari_g": "worst_p + ferrari_z",
    "ferrari_h": "(abs(ferrari_g) + sqrt(abs(ferrari_g * ferrari_g - 4 * worst_s))) / 2",
    "ferrari_l": "CASE WHEN ferrari_g >= 0 THEN worst_s / nullif(ferrari_h, 0) ELSE -ferrari_h END",
    "ferrari_m": "CASE WHEN ferrari_g >= 0 THEN ferrari_h ELSE -worst_s / nullif(ferrari_h, 0) END",
    "worst_r": "CASE WHEN worst_q < 0 THEN (sqrt(ferrari_z) + sqrt(abs(ferrari_z - 4 * ferrari_l))) / 2"
    " ELSE least(-2 * ferrari_l / nullif(sqrt(ferrari_z) + sqrt(abs(ferrari_z - 4 * ferrari_l)), 0),"
    " CASE WHEN ferrari_z >= 4 * ferrari_m"
    " THEN 2 * ferrari_m / nullif(sqrt(ferrari_z) + sqrt(abs(ferrari_z - 4 * ferrari_m)), 0) END) END",
    **{
        name: f"{t} - coalesce(((({t} * {t} + worst_p) * {t} + worst_q) * {t} + worst_s)"
        f" / nullif((4 * {t} * {t} + 2 * worst_p) * {t} + worst_q, 0), 0)"
        for name, t in (("worst_n", "worst_r"), ("worst_t", "worst_n"))
    },
}
