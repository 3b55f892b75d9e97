"""Measures of object pairs on crossing paths: arrival times at the conflict area, impact severity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

_WESTHOFEN: Final = "Westhofen et al., Criticality Metrics for Automated Driving, 2023"
_ALLEN: Final = "Allen, Shin and Cooper, Analysis of Traffic Conflicts and Collisions, 1978"

NUMBERS: Final[Mapping[str, PairFunction]] = {
    # The conflict area of two straight crossing paths is the intersection of the strips that both
    # footprints sweep.
    "pret": measure(
        "predicted post-encroachment time: from when one has left the area where their straight paths cross to"
        " when the other one enters it, if both keep their velocity",
        "s",
        "CASE WHEN between > 0 THEN CASE WHEN second >= 0 THEN between END"
        " WHEN least(cross_a + stay_a, cross_b + stay_b) >= 0 THEN 0 END",
        "0 where both will be in it at once; NULL where directions differ by less than 1°, one stands, or the"
        " other one is in it already",
        "Laureshyn, Svensson and Hydén, Evaluation of Traffic Safety, Based on Micro-level Behavioural Data,"
        " AAP 42, 2010 (time advantage)",
        alias="time_advantage",
    ),
    "spret": measure(
        "scaled predictive encroachment time: how far the squares are apart of the times at which their centres"
        " come to where their straight paths cross",
        "s²",
        "CASE WHEN cross_a >= 0 AND cross_b >= 0 THEN abs(cross_a * cross_a - cross_b * cross_b) + solid END",
        "NULL where directions differ by less than 1°, one stands, or one is past it",
        _WESTHOFEN,
    ),
    "et": measure(
        "encroachment time: how long a's footprint will be, in all, on the straight path of b",
        "s",
        "CASE WHEN cross_a + stay_a >= 0 THEN 2 * stay_a END",
        "NULL where directions differ by less than 1°, one stands, or a has left it",
        _ALLEN,
        worse="high",
    ),
    "psd": measure(
        "proportion of stopping distance: how far a still is from b's straight path, in its way of stopping"
        " by 11.5 m/s²",
        "ratio",
        "CASE WHEN cross_a + stay_a >= 0 AND pace > 0.1e0 THEN greatest(cross_a - stay_a, 0) * 23e0 / pace END",
        "below 1 it cannot stop before it; NULL where directions differ by less than 1°, one stands, or a has"
        " left it",
        _ALLEN,
    ),
    "delta_v": measure(
        "change of velocity of each in a collision now, both of one mass, after which they stay together",
        "m/s",
        "rel_speed / 2 + solid",
        "",
        "Shelby, Delta-V as a Measure of Traffic Conflict Severity, TRB 2011",
        worse="high",
    ),
    "ci": measure(
        "conflict index: energy that a collision would take from two of 1,500 kg which stay together, over"
        " exp(pret)",
        "J",
        "CASE WHEN pret <= 5 THEN 375 * rel_speed * rel_speed / exp(pret) WHEN pret > 5 THEN 0 END",
        "0 where pret is above 5 s, NULL where it is",
        "Alhajyaseen, The Integration of Conflict Probability and Severity for the Safety Assessment of"
        " Intersections, AJSE 40, 2015",
        worse="high",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # Straight crossing paths: the time when each centre is there, and the time before and after in
    # which its box is on the strip of the other. Speeds of both along and across both axes.
    "slip_a": "a_vy * ca - a_vx * sa",
    "slip_b": "b_vy * ca - b_vx * sa",
    "along_a": "a_vx * cb + a_vy * sb",
    "along_b": "b_vx * cb + b_vy * sb",
    "across_a": "a_vy * cb - a_vx * sb",
    "across_b": "b_vy * cb - b_vx * sb",
    "pace_b": "sqrt(b_vx * b_vx + b_vy * b_vy)",
    "spin": "a_vx * b_vy - a_vy * b_vx",
    "crosses": "CASE WHEN abs(spin) > 0.017452406437283512e0 * pace * pace_b THEN spin END",
    "cross_a": "(dx * b_vy - dy * b_vx) / crosses",
    "cross_b": "(dx * a_vy - dy * a_vx) / crosses",
    "stay_a": "(la * abs(slip_b) + wa * abs(v2) + lb * abs(across_b) + wb * abs(along_b)) / abs(crosses)",
    "stay_b": "(la * abs(slip_a) + wa * abs(v1) + lb * abs(across_a) + wb * abs(along_a)) / abs(crosses)",
    "between": "abs(cross_a - cross_b) - stay_a - stay_b",
    "second": "CASE WHEN cross_a <= cross_b THEN cross_b - stay_b ELSE cross_a - stay_a END",
}
