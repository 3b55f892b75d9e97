"""Measures of object pairs on the same path: headways, and needed accelerations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._levels import TOUCH
from sgstore.model.pair_numbers._pair_function import measure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.pair_numbers._pair_function import PairFunction

_AHEAD: Final = "NULL where b is not ahead in a's way"
_JANSSON: Final = "Jansson, Collision Avoidance Theory, 2005"
_HILLENBRAND: Final = "Hillenbrand et al., A Multilevel Collision Mitigation Approach, 2006"

NUMBERS: Final[Mapping[str, PairFunction]] = {
    "ttc_accel": measure(
        "time until a's front has come to b's rear along a's axis if both keep their acceleration",
        "s",
        "CASE WHEN lead <= 0 AND slack IS NOT NULL THEN 0 WHEN closing + slack_root > 0"
        " THEN 2 * lead / (closing + slack_root) END",
        f"{_AHEAD} or they do not meet; who brakes is taken to go on so, backwards in the end",
        "Ozbay et al., Derivation and Validation of New Simulation-Based Surrogate Safety Measure, 2008",
        alias="mttc",
    ),
    "pttc": measure(
        "potential time to collision: until a's front has come to b's rear along a's axis if a keeps its speed"
        " and b goes on braking as it does, until it stands",
        "s",
        "CASE WHEN lead <= 0 AND brakes IS NOT NULL AND closing IS NOT NULL THEN 0"
        " WHEN braking <= abs(v2) / abs(brakes) THEN braking"
        " WHEN v1 > 0 THEN (lead - v2 * v2 / (2 * brakes)) / v1 END",
        f"{_AHEAD} or does not brake",
        "Wakabayashi et al., Traffic Conflict Analysis and Modeling, 2003",
    ),
    "ttb": measure(
        "time to brake: how long a may wait before it has to brake by 8 m/s² so that it does not run into b,"
        " which keeps its velocity",
        "s",
        "CASE WHEN closing > 0 THEN lead / closing - closing / 16e0 END",
        f"below 0: too late; {_AHEAD} or they do not close in",
        _HILLENBRAND,
    ),
    "tts": measure(
        "time to steer: how long a may wait before it has to accelerate sideways by 8 m/s² so that it gets past"
        " b, which keeps its velocity",
        "s",
        "CASE WHEN short_by > 0 THEN reached - sqrt(abs(short_by) / 4e0) END",
        f"below 0: too late; {_AHEAD}, they do not close in, or they pass one another anyway",
        _HILLENBRAND,
    ),
    "ttr": measure(
        "time to react: the longer one of ttb and tts",
        "s",
        "CASE WHEN tts IS NOT NULL THEN greatest(ttb, tts) END",
        "NULL where tts is",
        _HILLENBRAND,
    ),
    "drac": measure(
        "deceleration rate to avoid a crash: that a needs so that it is as slow as b along a's axis when it"
        " reaches it",
        "m/s²",
        "CASE WHEN room > 0 THEN CASE WHEN closing > 0 THEN closing * closing / (2 * room)"
        " WHEN closing <= 0 THEN 0 END END",
        f"0 where they do not close in; {_AHEAD} or they touch",
        "Almqvist, Hydén and Risser, Use of Speed Limiters in Cars for Increased Safety, TRR 1318, 1991",
        worse="high",
    ),
    "decel_to_safety_time": measure(
        "deceleration to safety time: that a needs so that it is as slow as b when it is 2 s behind it",
        "m/s²",
        "CASE WHEN closing <= 0 AND room > 0 THEN 0"
        " WHEN room - 2 * v2 > 0 THEN closing * closing / (2 * (room - 2 * v2)) END",
        f"0 where they do not close in; {_AHEAD}, they touch, or the 2 s are lost already",
        "Hupfer, Deceleration to Safety Time (DST), 1997",
        worse="high",
    ),
    "a_long_req": measure(
        "required longitudinal acceleration: the constant one along its axis by which a just does not run into"
        " b, which keeps its own until it stands",
        "m/s²",
        "CASE WHEN required > 0 THEN 0 ELSE required END",
        f"0 or less; 0 where they do not close in; {_AHEAD} or they touch",
        _JANSSON,
    ),
    "a_lat_req": measure(
        "required lateral acceleration: the constant one across its axis by which a just gets past b after"
        " ttc_accel, on the nearer side",
        "m/s²",
        "CASE WHEN lead IS NOT NULL AND slack IS NOT NULL AND ttc_accel IS NULL THEN 0"
        " WHEN abs(aside) >= reach2 THEN 0"
        " WHEN ttc_accel > 0 THEN 2 * (reach2 - abs(aside)) / (ttc_accel * ttc_accel) END",
        f"0 where they do not meet; {_AHEAD} or they touch",
        _JANSSON,
        worse="high",
    ),
    "a_req": measure(
        "required acceleration: a_long_req and a_lat_req as one vector",
        "m/s²",
        "sqrt(a_long_req * a_long_req + a_lat_req * a_lat_req)",
        "0 or more; NULL where one of them is",
        _JANSSON,
        worse="high",
    ),
    "btn": measure(
        "brake threat number: the share of 11.5 m/s² that a_long_req is",
        "ratio",
        "abs(a_long_req) / 11.5e0",
        "from 1 on braking alone does not avoid it",
        _JANSSON,
        worse="high",
    ),
    "stn": measure(
        "steer threat number: the share of 8 m/s² that a_lat_req is",
        "ratio",
        "a_lat_req / 8e0",
        "from 1 on steering alone does not avoid it",
        _JANSSON,
        worse="high",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # Along a's axis: speeds and accelerations of both, and the distance from a's front to b's rear
    # if b is in the strip that a would sweep.
    "v1": "a_vx * ca + a_vy * sa",
    "v2": "b_vx * ca + b_vy * sa",
    "a1": "a_ax * ca + a_ay * sa",
    "a2": "b_ax * ca + b_ay * sa",
    "lead": "CASE WHEN lon > 0 AND out2 < 0 THEN lon_gap END",
    "closing": "v1 - v2",
    "slack": "closing * closing - 2 * lead * (a2 - a1)",
    "slack_root": "CASE WHEN slack >= 0 THEN sqrt(slack) END",
    # b's acceleration if it slows b along a's axis, in both directions of movement
    "brakes": "CASE WHEN v2 * a2 < 0 THEN a2 END",
    "brakes_root": "sqrt(CASE WHEN closing * closing >= 2 * lead * brakes"
    " THEN closing * closing - 2 * lead * brakes END)",
    "braking": "CASE WHEN closing + brakes_root > 0 THEN 2 * lead / (closing + brakes_root) END",
    "reached": "CASE WHEN closing > 0 THEN lead / closing END",
    "short_by": "reach2 - abs(lat + drift2 * reached)",
    # Two entities closer than the rounding of positions touch.
    "room": f"CASE WHEN lead > {TOUCH:.0e} THEN lead END",
    # b comes to a stop, in both directions of movement, before a under the required braking is as
    # slow as b.
    "required": "CASE WHEN room > 0 AND a2 IS NOT NULL THEN CASE WHEN closing <= 0 THEN 0"
    " WHEN v1 > 0 AND (v2 * a2 < 0 OR v2 = 0 AND a2 < 0) AND 2 * room * abs(a2) > abs(v2) * closing"
    " THEN -v1 * v1 / (2 * room - v2 * v2 / a2) ELSE a2 - closing * closing / (2 * room) END END",
    "aside": "lat + drift2 * ttc_accel + (b_ay * ca - b_ax * sa) * ttc_accel * ttc_accel / 2",
}
