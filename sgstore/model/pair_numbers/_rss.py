"""Measures of object pairs: safe distances of Responsibility-Sensitive Safety (RSS)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

_RSS: Final = (
    "Shalev-Shwartz et al., On a Formal Model of Safe and Scalable Self-driving Cars, 2017"
)

_STANDS: Final = "1e-3"
"""Speed up to which crossing traffic counts as standing, because of rounding; m/s."""

NUMBERS: Final[Mapping[str, PairFunction]] = {
    # Response time 1 s with an acceleration of 3.5 m/s² (0.2 sideways). Then braking by at least 4
    # m/s² (0.8 sideways, 3 in one's own lane against oncoming traffic); the vehicle ahead brakes by
    # at most 8. The margin is 0.1 m, as in ad-rss-lib.
    "rss_lon": measure(
        "safe distance of RSS along a's axis: that the one behind, or both who come towards one another, must"
        " keep",
        "m",
        "CASE WHEN toward_a + toward_b IS NULL THEN NULL WHEN meets_head_on > 0 THEN head_on"
        " WHEN chase > 0 THEN chase ELSE 0 END + solid",
        "one that stands ahead is a leader; what is slower than 1 mm/s along a's axis stands",
        _RSS,
        worse="",
    ),
    "rss_lat": measure(
        "safe distance of RSS across a's axis",
        "m",
        "CASE WHEN abeam < 0 THEN 0.1e0 ELSE abeam + 0.1e0 END + solid",
        "",
        _RSS,
        worse="",
    ),
    "rss_margin": measure(
        "how far they are from breaking both safe distances of RSS: the larger one of lon_gap less rss_lon and"
        " lat_gap less rss_lat",
        "m",
        "CASE WHEN reach1 + reach2 IS NOT NULL AND rss_lon + rss_lat IS NOT NULL"
        " THEN greatest(lon_gap - rss_lon, lat_gap - rss_lat) END",
        "below 0: dangerous",
        _RSS,
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # Speeds towards each other, along a's axis and across it. Two diverging entities have no
    # follower. For one that still moves away sideways after the response time, the stopping
    # distance counts with its sign.
    "toward_a": "CASE WHEN lon > 0 THEN v1 WHEN lon <= 0 THEN -v1 END",
    "toward_b": "CASE WHEN lon > 0 THEN -v2 WHEN lon <= 0 THEN v2 END",
    # Definition 2 of the source: b approaches a, and a drives towards b, or stands and faces it.
    # All other pairs have one direction (definition 1), also with a standing leader.
    "meets_head_on": f"CASE WHEN toward_b > {_STANDS} AND (toward_a > {_STANDS}"
    f" OR lon > 0 AND toward_a + {_STANDS} >= 0) THEN 1 ELSE 0 END",
    "faster": "greatest(toward_a, toward_b, 0)",
    "flees": "CASE WHEN toward_a < 0 AND toward_b < 0 THEN greatest(toward_a, toward_b)"
    " ELSE least(toward_a, toward_b) END",
    "chase": "faster + 1.75e0 + (faster + 3.5e0) * (faster + 3.5e0) / 8 - flees * flees / 16",
    "head_on": "toward_a + 1.75e0 + (toward_a + 3.5e0) * (toward_a + 3.5e0) / 6"
    " + toward_b + 1.75e0 + (toward_b + 3.5e0) * (toward_b + 3.5e0) / 8",
    "sideways_a": "CASE WHEN lat < 0 THEN -slip_a WHEN lat >= 0 THEN slip_a END + 0.2e0",
    "sideways_b": "CASE WHEN lat < 0 THEN slip_b WHEN lat >= 0 THEN -slip_b END + 0.2e0",
    "abeam": "sideways_a + sideways_b - 0.2e0"
    " + (sideways_a * abs(sideways_a) + sideways_b * abs(sideways_b)) / 1.6e0",
}
