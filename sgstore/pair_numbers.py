"""Numbers of a pair of entities (a, b): each declared once, for views, the language and arrays.

A number is an expression of SQL over others of the same pair, down to the columns of both entities (``a_x``: x
of a; conventions of axes and units in :mod:`sgstore.geometry`). The view and the compiler write it into
statements, layer by layer, because DuckDB shares named columns and not repeated expressions;
:class:`PairNumbers` computes the same expression with arrays, where NaN is NULL. What a number needs of an
entity follows from its columns.

One more number is one more entry of :data:`PAIR_FUNCTIONS`. Measures of criticality are among them; those
here look ahead from one moment: at constant velocity, at constant acceleration or at the worst that bounded
accelerations can do. Names of the usual symbols of that literature (``v1``, ``a2``) are parts.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from functools import cache, reduce
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from sgstore.arrays import np
from sgstore.records import dataclass

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"


@dataclass(frozen=True, slots=True)
class PairFunction:
    """Declaration of a number of two entities a and b.

    Attributes
    ----------
    doc : str
        Meaning, in terms of a and b.
    unit : str
    sql : str
        Expression over columns of both entities, parts (:data:`_PARTS`) and other numbers; empty: it is looked
        up elsewhere, and is no column of the view.
    note : str
        Special values.
    source : str
        Where the literature defines it.
    view : str
        The first view that has it as a column: ``pairs``, or ``criticality``, which has all.
    column : str
        Name in the views, where it differs.
    alias : str
        Second name in the language.
    worse : str
        Which values are the more critical ones: ``low`` or ``high``; empty: neither.
    dear : bool
        Whether a condition on it is tested after those on the others, and a bound on the distance before.
    """

    doc: str
    unit: str
    sql: str
    note: str = ""
    source: str = ""
    view: str = "pairs"
    column: str = ""
    alias: str = ""
    worse: str = ""
    dear: bool = False

    @property
    def meaning(self) -> str:
        """The documentation in one line."""
        return f"{self.doc}; {self.unit}" + (f"; {self.note}" if self.note else "")


def _turned(angle: str) -> str:
    """An angle in degrees, brought into (-180, 180]."""
    return f"{angle} - 360 * ceil(({angle} - 180) / 360)"


def _measure(
    doc: str, unit: str, sql: str, note: str, source: str, alias: str = "", worse: str = "low"
) -> PairFunction:
    """A measure of criticality."""
    return PairFunction(doc, unit, sql, note, source, "criticality", alias=alias, worse=worse)


_AHEAD: Final = "NULL where b is not ahead in a's way"
_WESTHOFEN: Final = "Westhofen et al., Criticality Metrics for Automated Driving, 2023"
_JANSSON: Final = "Jansson, Collision Avoidance Theory, 2005"
_HILLENBRAND: Final = "Hillenbrand et al., A Multilevel Collision Mitigation Approach, 2006"
_EGGERT: Final = "Eggert, Predictive Risk Estimation for Intelligent ADAS Functions, 2014"
_ALLEN: Final = "Allen, Shin and Cooper, Analysis of Traffic Conflicts and Collisions, 1978"
_RSS: Final = (
    "Shalev-Shwartz et al., On a Formal Model of Safe and Scalable Self-driving Cars, 2017"
)

_GAP: Final = (
    "CASE WHEN reach1 + reach2 IS NULL THEN NULL WHEN greatest(out1, out2, out3, out4) <= 0 THEN 0"
    " ELSE sqrt(least("
    + ", ".join(
        f"CASE WHEN out{i} > 0 THEN out{i} * out{i} + greatest(past{i}, 0) * greatest(past{i}, 0) END"
        for i in (1, 2, 3, 4)
    )
    + ")) END"
)
_MOVED: Final = re.compile(r"\b(lon|lat|back|side|(?:out|past)[1-4])\b")


def _after_3s(text: str) -> str:
    """An expression of where b is, of where it will be after 3 s."""
    return _MOVED.sub(r"\1_3s", text)


LANE_DIST: Final = "lane_dist"
"""The number that is no expression: it is looked up, by lanes and ways between them."""

PAIR_FUNCTIONS: Final[Mapping[str, PairFunction]] = {
    "dist": PairFunction(
        "distance between the centres, in space",
        "m",
        "sqrt(dx * dx + dy * dy + dz * dz)",
        column="distance",
    ),
    # The distance of b's centre from the Minkowski sum of both boxes, an octagon around a's centre whose edges
    # are those of both. Boxes are symmetric about their centres: of two opposite edges only the one on the side
    # of b's centre can be the nearest, so four remain, two in a's axes and two in b's.
    "gap": PairFunction(
        "shortest distance between the footprints",
        "m",
        _GAP,
        note="0 where they touch or overlap",
        dear=True,
        worse="low",
    ),
    "bearing": PairFunction(
        "direction of b's centre in a's axes, positive to the left", "degrees", _turned("course")
    ),
    "rel_heading": PairFunction("b's heading less a's", "degrees", _turned("turned")),
    "lon": PairFunction(
        "how far b's centre lies ahead of a's, in a's axes", "m", "dx * ca + dy * sa"
    ),
    "lat": PairFunction(
        "how far b's centre lies to the left of a's, in a's axes", "m", "dy * ca - dx * sa"
    ),
    "closing_speed": PairFunction(
        "how fast the centres approach one another",
        "m/s",
        "-(dx * dvx + dy * dvy) / nullif(planar, 0)",
        worse="high",
    ),
    # Two boxes meet where their shadows meet on each axis of both (separating axes: Gottschalk, Lin and
    # Manocha, OBBTree, SIGGRAPH 1996). On one axis the shadows of boxes that move meet in one interval of time;
    # what all four intervals have in common is when the boxes do.
    "ttc": PairFunction(
        "time until the footprints first touch if both keep their velocity and do not turn",
        "s",
        "CASE WHEN meets <= parts AND parts >= 0 AND (rel_speed >= 1e-6 OR meets <= 0)"
        " AND reach1 + reach2 IS NOT NULL THEN greatest(meets, 0) END",
        note="0 where they overlap, NULL where they never touch or their velocities differ by less than"
        " 1e-6 m/s",
        dear=True,
        worse="low",
    ),
    "headway": PairFunction(
        "time until a, at its speed, has come as far as b is now, from bumper to bumper",
        "s",
        "CASE WHEN lon > 0 AND pace > 0.1 AND la + lb IS NOT NULL THEN greatest(lon - la - lb, 0) / pace END",
        note="NULL where b is not ahead or a stands",
        alias="thw",
        worse="low",
    ),
    "rel_speed": PairFunction(
        "length of the difference of the velocities", "m/s", "sqrt(dvx * dvx + dvy * dvy)"
    ),
    # Not by greatest(), which passes over NULL.
    "lon_gap": PairFunction(
        "how far the footprints are apart along a's axis",
        "m",
        "CASE WHEN out1 < 0 THEN 0 ELSE out1 END",
        note="0 where they overlap in it",
    ),
    "lat_gap": PairFunction(
        "how far the footprints are apart across a's axis",
        "m",
        "CASE WHEN out2 < 0 THEN 0 ELSE out2 END",
        note="0 where they overlap in it",
    ),
    # Scenic's apparent heading of b from a: Fremont et al., PLDI 2019, table 2.
    "apparent_heading": PairFunction(
        "b's heading less the direction from a to b: 0 is a tail, 180 a front",
        "degrees",
        f"CASE WHEN planar > 0 THEN {_turned('sighted')} END",
    ),
    "closing_time": PairFunction(
        "the gap at the closing speed, whether or not the ways meet",
        "s",
        "CASE WHEN closing_speed > 0 THEN gap / closing_speed END",
        note="NULL where the centres do not approach",
        dear=True,
        worse="low",
    ),
    LANE_DIST: PairFunction(
        "from centre to centre along the lanes, negative where b is behind",
        "m",
        "",
        note="NULL beyond 200 m",
    ),
    # Measures of criticality -----------------------------------------------------------------------
    # The distance of two boxes that move is a convex function of time. If they do not meet, the line that b
    # draws past a is nearest to their Minkowski sum where a corner of that is abreast, or an edge.
    "dce": _measure(
        "distance of closest encounter: the least that the gap will be if both keep their velocity and do not"
        " turn",
        "m",
        "CASE WHEN ttc IS NOT NULL THEN 0 WHEN rel_speed >= 1e-6 AND abreast_until >= 0 THEN"
        " CASE WHEN clears < 0 THEN 0 ELSE clears END WHEN rel_speed IS NOT NULL THEN gap END",
        "0 where they will meet",
        _EGGERT,
    ),
    "ttce": _measure(
        "time of closest encounter: when the gap will first be the least",
        "s",
        "CASE WHEN ttc IS NOT NULL THEN ttc WHEN rel_speed >= 1e-6 AND abreast_until >= 0 THEN"
        " CASE WHEN abreast < 0 THEN 0 ELSE abreast END"
        " WHEN rel_speed IS NOT NULL AND gap IS NOT NULL THEN 0 END",
        "0 where they are nearest now",
        _EGGERT,
        worse="",
    ),
    "dce_3s": _measure(
        "the least that the gap will be within 3 s if both keep their velocity and do not turn",
        "m",
        "CASE WHEN ttce <= 3 THEN dce ELSE gap_3s END",
        "0 where they will meet by then",
        _EGGERT,
    ),
    "wttc": _measure(
        "worst-case time to collision: before it they cannot meet, however both steer, brake and accelerate by"
        " up to 11.5 m/s², being discs around their footprints",
        "s",
        "CASE WHEN planar <= discs AND worst_p IS NOT NULL THEN 0"
        " WHEN worst_p IS NOT NULL AND worst_q IS NOT NULL AND worst_s IS NOT NULL THEN worst_t END",
        "0 where the discs overlap",
        "Wachenfeld et al., The Worst-Time-To-Collision Metric for Situation Identification, IV 2016",
    ),
    "ttc_accel": _measure(
        "time until a's front has come to b's rear along a's axis if both keep their acceleration",
        "s",
        "CASE WHEN lead <= 0 AND slack IS NOT NULL THEN 0 WHEN closing + slack_root > 0"
        " THEN 2 * lead / (closing + slack_root) END",
        f"{_AHEAD} or they do not meet; who brakes is taken to go on so, backwards in the end",
        "Ozbay et al., Derivation and Validation of New Simulation-Based Surrogate Safety Measure, 2008",
        alias="mttc",
    ),
    "pttc": _measure(
        "potential time to collision: until a's front has come to b's rear along a's axis if a keeps its speed"
        " and b goes on braking as it does, until it stands",
        "s",
        "CASE WHEN lead <= 0 AND brakes IS NOT NULL AND closing IS NOT NULL THEN 0"
        " WHEN v2 > 0 AND braking > v2 / brakes"
        " THEN CASE WHEN v1 > 0 THEN (lead + v2 * v2 / (2 * brakes)) / v1 END ELSE braking END",
        f"{_AHEAD} or does not brake",
        "Wakabayashi et al., Traffic Conflict Analysis and Modeling, 2003",
    ),
    "ttb": _measure(
        "time to brake: how long a may wait before it has to brake by 8 m/s² so that it does not run into b,"
        " which keeps its velocity",
        "s",
        "CASE WHEN closing > 0 THEN lead / closing - closing / 16e0 END",
        f"below 0: too late; {_AHEAD} or they do not close in",
        _HILLENBRAND,
    ),
    "tts": _measure(
        "time to steer: how long a may wait before it has to accelerate sideways by 8 m/s² so that it gets past"
        " b, which keeps its velocity",
        "s",
        "CASE WHEN short_by > 0 THEN reached - sqrt(abs(short_by) / 4e0) END",
        f"below 0: too late; {_AHEAD}, they do not close in, or they pass one another anyway",
        _HILLENBRAND,
    ),
    "ttr": _measure(
        "time to react: the longer one of ttb and tts",
        "s",
        "CASE WHEN tts IS NOT NULL THEN greatest(ttb, tts) END",
        "NULL where tts is",
        _HILLENBRAND,
    ),
    "drac": _measure(
        "deceleration rate to avoid a crash: that a needs so that it is as slow as b along a's axis when it"
        " reaches it",
        "m/s²",
        "CASE WHEN closing <= 0 AND lead IS NOT NULL THEN 0"
        " WHEN lead > 0 THEN closing * closing / (2 * lead) END",
        f"0 where they do not close in; {_AHEAD} or they touch",
        "Almqvist, Hydén and Risser, Use of Speed Limiters in Cars for Increased Safety, TRR 1318, 1991",
        worse="high",
    ),
    "decel_to_safety_time": _measure(
        "deceleration to safety time: that a needs so that it is as slow as b when it is 2 s behind it",
        "m/s²",
        "CASE WHEN closing <= 0 AND lead IS NOT NULL THEN 0"
        " WHEN lead - 2 * v2 > 0 THEN closing * closing / (2 * (lead - 2 * v2)) END",
        f"0 where they do not close in; {_AHEAD} or the 2 s are lost already",
        "Hupfer, Deceleration to Safety Time (DST), 1997",
        worse="high",
    ),
    "a_long_req": _measure(
        "required longitudinal acceleration: the constant one along its axis by which a just does not run into"
        " b, which keeps its own until it stands",
        "m/s²",
        "CASE WHEN required > 0 THEN 0 ELSE required END",
        f"0 or less; 0 where they do not close in; {_AHEAD} or they touch",
        _JANSSON,
    ),
    "a_lat_req": _measure(
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
    "a_req": _measure(
        "required acceleration: a_long_req and a_lat_req as one vector",
        "m/s²",
        "sqrt(a_long_req * a_long_req + a_lat_req * a_lat_req)",
        "0 or more; NULL where one of them is",
        _JANSSON,
        worse="high",
    ),
    "btn": _measure(
        "brake threat number: the share of 11.5 m/s² that a_long_req is",
        "ratio",
        "abs(a_long_req) / 11.5e0",
        "from 1 on braking alone does not avoid it",
        _JANSSON,
        worse="high",
    ),
    "stn": _measure(
        "steer threat number: the share of 8 m/s² that a_lat_req is",
        "ratio",
        "a_lat_req / 8e0",
        "from 1 on steering alone does not avoid it",
        _JANSSON,
        worse="high",
    ),
    # Of two straight paths that cross, the conflict area is where the strips that both footprints sweep meet.
    "pret": _measure(
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
    "spret": _measure(
        "scaled predictive encroachment time: how far the squares are apart of the times at which their centres"
        " come to where their straight paths cross",
        "s²",
        "CASE WHEN cross_a >= 0 AND cross_b >= 0 THEN abs(cross_a * cross_a - cross_b * cross_b) END",
        "NULL where directions differ by less than 1°, one stands, or one is past it",
        _WESTHOFEN,
    ),
    "et": _measure(
        "encroachment time: how long a's footprint will be, in all, on the straight path of b",
        "s",
        "CASE WHEN cross_a + stay_a >= 0 THEN 2 * stay_a END",
        "NULL where directions differ by less than 1°, one stands, or a has left it",
        _ALLEN,
        worse="high",
    ),
    "psd": _measure(
        "proportion of stopping distance: how far a still is from b's straight path, in its way of stopping"
        " by 11.5 m/s²",
        "ratio",
        "CASE WHEN cross_a + stay_a >= 0 AND pace > 0.1e0 THEN greatest(cross_a - stay_a, 0) * 23e0 / pace END",
        "below 1 it cannot stop before it; NULL where directions differ by less than 1°, one stands, or a has"
        " left it",
        _ALLEN,
    ),
    "delta_v": _measure(
        "change of velocity of each in a collision now, both of one mass, after which they stay together",
        "m/s",
        "rel_speed / 2",
        "",
        "Shelby, Delta-V as a Measure of Traffic Conflict Severity, TRB 2011",
        worse="high",
    ),
    "ci": _measure(
        "conflict index: energy that a collision would take from two of 1,500 kg which stay together, over"
        " exp(pret)",
        "J",
        "CASE WHEN pret <= 5 THEN 375 * rel_speed * rel_speed / exp(pret) WHEN pret > 5 THEN 0 END",
        "0 where pret is above 5 s, NULL where it is",
        "Alhajyaseen, The Integration of Conflict Probability and Severity for the Safety Assessment of"
        " Intersections, AJSE 40, 2015",
        worse="high",
    ),
    # Response 1 s, in it accelerating by 3.5 m/s² (0.2 sideways), then braking by at least 4 m/s² (0.8 aside, 3
    # in one's own lane against who comes), who is ahead by at most 8; 0.1 m between: as in ad-rss-lib.
    "rss_lon": _measure(
        "safe distance of RSS along a's axis: that the one behind, or both who come towards one another, must"
        " keep",
        "m",
        "CASE WHEN toward_a + toward_b IS NULL THEN NULL WHEN least(toward_a, toward_b) >= 0 THEN head_on"
        " WHEN chase > 0 THEN chase ELSE 0 END",
        "",
        _RSS,
        worse="",
    ),
    "rss_lat": _measure(
        "safe distance of RSS across a's axis",
        "m",
        "CASE WHEN abeam < 0 THEN 0.1e0 ELSE abeam + 0.1e0 END",
        "",
        _RSS,
        worse="",
    ),
    "rss_margin": _measure(
        "how far they are from breaking both safe distances of RSS: the larger one of lon_gap less rss_lon and"
        " lat_gap less rss_lat",
        "m",
        "CASE WHEN reach1 + reach2 IS NOT NULL AND rss_lon + rss_lat IS NOT NULL"
        " THEN greatest(lon_gap - rss_lon, lat_gap - rss_lat) END",
        "below 0: dangerous",
        _RSS,
    ),
}
"""Numbers of two entities by name, in the order of the views; NULL where what they need is not known."""

_HALVES: Final = ((1, "la", 1, 2), (2, "wa", 2, 1), (3, "lb", 3, 4), (4, "wb", 4, 3))
"""Half extents of both boxes, each with the axis that it lies on and the one across."""

_BEYOND: Final = {
    "out1": "abs(lon) - reach1",
    "out2": "abs(lat) - reach2",
    "out3": "abs(back) - reach3",
    "out4": "abs(side) - reach4",
    "past1": "abs(CASE WHEN lon < 0 THEN -lat ELSE lat END - hand * (lb * si - wb * co)) - wa",
    "past2": "abs(CASE WHEN lat < 0 THEN -lon ELSE lon END - hand * (lb * co - wb * si)) - la",
    "past3": "abs(CASE WHEN back < 0 THEN -side ELSE side END + hand * (la * si - wa * co)) - wb",
    "past4": "abs(CASE WHEN side < 0 THEN -back ELSE back END + hand * (la * co - wa * si)) - lb",
}
"""How far b's centre lies beyond edges of the octagon, and past their ends."""

_PARTS: Final[Mapping[str, str]] = {
    **{f"d{axis}": f"b_{axis} - a_{axis}" for axis in ("x", "y", "z", "vx", "vy")},
    **{f"l{one}": f"{one}_length / 2" for one in "ab"},
    **{f"w{one}": f"{one}_width / 2" for one in "ab"},
    **{f"c{one}": f"cos({one}_heading)" for one in "ab"},
    **{f"s{one}": f"sin({one}_heading)" for one in "ab"},
    "planar": "sqrt(dx * dx + dy * dy)",
    "pace": "sqrt(a_vx * a_vx + a_vy * a_vy)",
    # The difference of two angles is exact for the headings that people write (0, π/2, π), where the angle of
    # turned components is not: the cosine of the double nearest to π/2 is 6e-17.
    "course": "CASE WHEN dx = 0 AND dy = 0 THEN 0 * a_heading ELSE degrees(atan2(dy, dx) - a_heading) END",
    "turned": "degrees(b_heading - a_heading)",
    "sighted": "degrees(b_heading - atan2(dy, dx))",
    # a's centre in b's axes, with the other sign
    "back": "dx * cb + dy * sb",
    "side": "dy * cb - dx * sb",
    # Between the headings; of parallel boxes two corners reach equally far, and each box takes the other one.
    "cosine": "ca * cb + sa * sb",
    "sine": "ca * sb - sa * cb",
    "co": "abs(cosine)",
    "si": "abs(sine)",
    "hand": "CASE WHEN cosine * sine < 0 THEN -1 ELSE 1 END",
    # Edges of the octagon, along and across a's axis and b's: their distance from a's centre, how far b's
    # centre lies beyond, and how far past their ends
    "reach1": "la + lb * co + wb * si",
    "reach2": "wa + lb * si + wb * co",
    "reach3": "lb + la * co + wa * si",
    "reach4": "wb + la * si + wa * co",
    **_BEYOND,
    # On each of the four axes, turned so that b moves along it: b's place and speed, and from when to when the
    # boxes overlap. No speed is 0: two that stand on an axis meet there in ages, or have met for ages.
    "drift1": "dvx * ca + dvy * sa",
    "drift2": "dvy * ca - dvx * sa",
    "drift3": "dvx * cb + dvy * sb",
    "drift4": "dvy * cb - dvx * sb",
    **{
        f"place{i}": f"CASE WHEN drift{i} < 0 THEN -{at} ELSE {at} END"
        for i, at in enumerate(("lon", "lat", "back", "side"), 1)
    },
    **{f"rate{i}": f"abs(drift{i}) + 1e-200" for i in (1, 2, 3, 4)},
    "meets": f"greatest({', '.join(f'(-reach{i} - place{i}) / rate{i}' for i in (1, 2, 3, 4))})",
    "parts": f"least({', '.join(f'(reach{i} - place{i}) / rate{i}' for i in (1, 2, 3, 4))})",
    # Bounds that are cheap: no two boxes are nearer than their circumscribed circles (a micrometre makes up for
    # rounding), and of two that move straight on the distance shrinks by no more than this in a second.
    "at_least": "planar - sqrt(la * la + wa * wa) - sqrt(lb * lb + wb * wb) - 1e-6",
    "approach": "greatest(coalesce(closing_speed, 0), 0)",
    # b as a sees it move: how far its line clears the Minkowski sum of both boxes, and from when to when its
    # centre is abreast of the corner of that which is nearest to the line, or of the edge, if one runs with it.
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
    **{_after_3s(name): _after_3s(text) for name, text in _BEYOND.items()},
    "gap_3s": _after_3s(_GAP),
    "edges": "edge1 + edge2 + edge3 + edge4",
    "corners": "corner1 + corner2 + corner3 + corner4",
    "nearest": "CASE WHEN beyond < 0 THEN -corners ELSE corners END - dotted",
    "abreast": "(nearest - edges) / nullif(rel_speed * rel_speed, 0)",
    "abreast_until": "(nearest + edges) / nullif(rel_speed * rel_speed, 0)",
    # The first time at which discs that grow by 11.5 t²/2 each touch: the least positive root of
    # t⁴ + pt² + qt + s, where s < 0, by Ferrari: a root z of the resolvent cubic makes two quadratics of it.
    # Two steps of Newton's take the rounding away. What stands in abs() is not negative where it is used.
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
    # Along a's axis: speeds and accelerations of both, and how far b's rear is from a's front where b stands in
    # the strip that a would sweep.
    "v1": "a_vx * ca + a_vy * sa",
    "v2": "b_vx * ca + b_vy * sa",
    "a1": "a_ax * ca + a_ay * sa",
    "a2": "b_ax * ca + b_ay * sa",
    "lead": "CASE WHEN lon > 0 AND out2 < 0 THEN lon_gap END",
    "closing": "v1 - v2",
    "slack": "closing * closing - 2 * lead * (a2 - a1)",
    "slack_root": "CASE WHEN slack >= 0 THEN sqrt(slack) END",
    "brakes": "CASE WHEN a2 < 0 THEN -a2 END",
    "braking": "2 * lead / nullif(closing + sqrt(closing * closing + 2 * lead * brakes), 0)",
    "reached": "CASE WHEN closing > 0 THEN lead / closing END",
    "short_by": "reach2 - abs(lat + drift2 * reached)",
    "required": "CASE WHEN closing <= 0 AND lead IS NOT NULL AND a2 IS NOT NULL THEN 0 WHEN lead > 0 THEN"
    " CASE WHEN v2 > 0 AND 2 * lead * brakes > v2 * closing"
    " THEN -v1 * v1 / (2 * lead + v2 * v2 / brakes) ELSE a2 - closing * closing / (2 * lead) END END",
    "aside": "lat + drift2 * ttc_accel + (b_ay * ca - b_ax * sa) * ttc_accel * ttc_accel / 2",
    # Where straight paths cross: when each centre is there, and for how long before and after its box is on the
    # strip that the other one sweeps. Speeds of both along and across both axes.
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
    # Speeds towards one another, along a's axis and across it. Of two that go apart nobody chases; of one that
    # goes away sideways even after the response, the way of stopping counts with its sign.
    "toward_a": "CASE WHEN lon > 0 THEN v1 WHEN lon <= 0 THEN -v1 END",
    "toward_b": "CASE WHEN lon > 0 THEN -v2 WHEN lon <= 0 THEN v2 END",
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
"""Expressions that numbers share."""

_EXPRESSIONS: Final[Mapping[str, str]] = {
    **_PARTS,
    **{name: one.sql for name, one in PAIR_FUNCTIONS.items() if one.sql},
}
_NAME: Final = re.compile(r"\b[a-z]\w*\b(?!\()")
"""A part: words of SQL are in capitals, functions have a bracket behind them."""


@cache
def parts_of(name: str) -> tuple[str, ...]:
    """The numbers, parts and columns that a number of a pair is made of."""
    return tuple(sorted({*_NAME.findall(_EXPRESSIONS[name])}))


@cache
def stage_of(name: str) -> int:
    """Return the number of layers before a number of a pair; 0 for a column of an entity."""
    return 1 + max(stage_of(part) for part in parts_of(name)) if name in _EXPRESSIONS else 0


@cache
def needed_for(name: str) -> frozenset[str]:
    """A number of a pair with all that it is made of; nothing for one that is looked up."""
    if name == LANE_DIST:
        return frozenset()
    if name not in _EXPRESSIONS:
        return frozenset({name})
    return frozenset({name}).union(*(needed_for(part) for part in parts_of(name)))


def columns_needed(name: str) -> tuple[frozenset[str], frozenset[str]]:
    """The columns of a and those of b that a number of a pair is made of."""
    raw = [part for part in needed_for(name) if part not in _EXPRESSIONS]
    a, b = (frozenset(part[2:] for part in raw if part[0] == one) for one in "ab")
    return a, b


# SQL ----------------------------------------------------------------------------------------------


def pair_sql(name: str, column: Callable[[str], str]) -> str:
    """A number of a pair as SQL, given the columns of what it is made of."""
    return _NAME.sub(lambda found: column(found[0]), _EXPRESSIONS[name])


_KEPT: Final = ("frame_id", "src", "dst", "src_kind", "dst_kind", "src_is_ego", "dst_is_ego")
_BEFORE_KINDS: Final = 10
"""Numbers before the kinds in the views, which keep the order of their columns; new ones come behind."""


def pairs_view(view: str = "pairs") -> tuple[str, str]:
    """Return the statement of a view of pairs, without its head, and the documentation of what is first in it.

    Parameters
    ----------
    view : str
        ``pairs``, or ``criticality``: its numbers and the measures of criticality.
    """
    listed = [
        (one.column or name, name)
        for name, one in PAIR_FUNCTIONS.items()
        if one.sql and one.view in {view, "pairs"}
    ]
    wanted = frozenset[str]().union(*(needed_for(name) for _, name in listed))
    inputs = sorted(name for name in wanted if not stage_of(name))
    columns = ["b.frame_id", "a.node_id AS src", "b.node_id AS dst"]
    columns += ["a.kind AS src_kind", "b.kind AS dst_kind"]
    columns += ["a.is_ego AS src_is_ego", "b.is_ego AS dst_is_ego"]
    columns += [f"{name[0]}.{name[2:]}::DOUBLE AS {name}" for name in inputs]
    join = (
        "inside.state a JOIN inside.state b ON b.frame_id = a.frame_id AND b.node_id <> a.node_id"
    )
    text = f"SELECT {', '.join(columns)} FROM {join}"  # noqa: S608
    for stage in range(1, 1 + max(map(stage_of, wanted))):
        layer = [f"{pair_sql(n, str)} AS {n}" for n in sorted(wanted) if stage_of(n) == stage]
        text = f"SELECT *, {', '.join(layer)} FROM ({text})"  # noqa: S608
    numbers = [name if column == name else f"{name} AS {column}" for column, name in listed]
    shown = [*_KEPT[:3], *numbers[:_BEFORE_KINDS], *_KEPT[3:], *numbers[_BEFORE_KINDS:]]
    first = [(column, PAIR_FUNCTIONS[name]) for column, name in listed]
    told = [f"{column}: {one.meaning}" for column, one in first if one.view == view]
    return f"SELECT {', '.join(shown)} FROM ({text})", ". ".join(told)  # noqa: S608


# Arrays -------------------------------------------------------------------------------------------

Formula = Callable[[Mapping[str, Any]], Any]

COLUMNS: Final = ("x", "y", "z", "heading", "length", "width", "vx", "vy", "ax", "ay")
"""Columns of an entity that numbers of pairs are made of."""


class PairNumbers(dict[str, "Floats"]):
    """Numbers of many ordered pairs by name, each computed when it is first asked for; (K,) float64.

    Parameters
    ----------
    a, b : (K, 10) float64
        ``x, y, z, heading, length, width, vx, vy, ax, ay`` of the two entities of pair k; m, m, m, rad, m, m,
        m/s, m/s, m/s², m/s². NaN where one is missing. Accelerations may be left out: (K, 8).
    """

    def __init__(self, a: Floats, b: Floats) -> None:
        super().__init__()
        for one, states in (("a", a), ("b", b)):
            told = dict(zip(COLUMNS, states.T, strict=False))
            unknown = np.broadcast_to(np.nan, len(states))
            self.update({f"{one}_{name}": told.get(name, unknown) for name in COLUMNS})

    def __missing__(self, name: str) -> Floats:
        with np.errstate(all="ignore"):
            found = self[name] = _compiled(name)(self)
        return found


def gap(a: Floats, b: Floats) -> Floats:
    """Shortest distance between the boxes of each pair; 0 where they touch or overlap.

    Parameters
    ----------
    a, b : (K, 5) float64
        ``x, y, heading, length, width`` of the two boxes of pair k; m, m, rad, m, m. A box without extent
        is a point or a line.

    Returns
    -------
    (K,) float64
        Metres; NaN where a number is missing.
    """
    found = np.empty(len(a))
    for start in range(0, len(a), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        boxes = [np.full((len(box[part]), len(COLUMNS)), np.nan) for box in (a, b)]
        for whole, box in zip(boxes, (a, b), strict=True):
            whole[:, _FOOTPRINT] = box[part]
        found[part] = PairNumbers(*boxes)["gap"]
    return found


_TOGETHER: Final = 1 << 14
"""Pairs whose parts are in memory at once: few enough for the caches of a processor."""

_FOOTPRINT: Final = [COLUMNS.index(name) for name in ("x", "y", "heading", "length", "width")]

# An expression is parsed as one of Python, which it is but for these words.
_AS_PYTHON: Final = tuple(
    (re.compile(pattern), text)
    for pattern, text in (
        (r"\bCASE WHEN\b", "case("),
        (r"\b(WHEN|THEN|ELSE)\b", ","),
        (r"\bEND\b", ")"),
        (r"\bIS NOT NULL\b", "is not None"),
        (r"\bIS NULL\b", "is None"),
        (r"\bNULL\b", "None"),
        (r"\bAND\b", "and"),
        (r"\bOR\b", "or"),
        (r"(?<![<>])=", "=="),
    )
)


def _case(*parts: Any) -> Any:
    """The first value whose condition is true, else the last, or NaN."""
    pairs, found = len(parts) // 2, parts[-1] if len(parts) % 2 else np.nan
    for i in reversed(range(pairs)):
        found = np.where(parts[2 * i], parts[2 * i + 1], found)
    return found


def _coalesced(value: Any, other: Any) -> Any:
    return np.where(np.isnan(value), other, value)


def _null_if(value: Any, other: Any) -> Any:
    return np.where(value == other, np.nan, value)


def _is_null(value: Any, _: Any) -> Any:
    return np.isnan(value)


def _is_known(value: Any, _: Any) -> Any:
    return ~np.isnan(value)


@cache
def _functions() -> Mapping[str, Callable[..., Any]]:
    """Functions of expressions by their names."""
    return {
        "case": _case,
        **{
            name: getattr(np, name)
            for name in ("abs", "sqrt", "cbrt", "exp", "sin", "cos", "degrees", "ceil")
        },
        "acos": np.arccos,
        "atan2": np.arctan2,
        # They pass over what is missing.
        "greatest": lambda *values: reduce(np.fmax, values),
        "least": lambda *values: reduce(np.fmin, values),
        "coalesce": _coalesced,
        "nullif": _null_if,
    }


@cache
def _operators() -> Mapping[type[ast.AST], Callable[..., Any]]:
    return {
        ast.Add: np.add,
        ast.Sub: np.subtract,
        ast.Mult: np.multiply,
        ast.Div: np.divide,
        ast.USub: np.negative,
        ast.Lt: np.less,
        ast.LtE: np.less_equal,
        ast.Gt: np.greater,
        ast.GtE: np.greater_equal,
        ast.Eq: np.equal,
        ast.Is: _is_null,
        ast.IsNot: _is_known,
        ast.And: np.logical_and,
        ast.Or: np.logical_or,
    }


@cache
def _compiled(name: str) -> Formula:
    """The function of the values of a number of pairs, given those of what it is made of.

    What is unknown in a condition is false, which is as good: no condition is negated.
    """
    text = _EXPRESSIONS[name]
    for pattern, python in _AS_PYTHON:
        text = pattern.sub(python, text)
    return _formula(ast.parse(text, mode="eval").body)


def _formula(node: ast.expr) -> Formula:  # noqa: PLR0911 - a case each
    match node:
        case ast.Constant(value=value):
            constant: Any = np.nan if value is None else value
            return lambda _: constant
        case ast.Name(id=name):
            return lambda at: at[name]
        case ast.Call(func=ast.Name(id=word), args=parts):
            return _applied(_functions()[word], parts)
        case ast.UnaryOp(op=op, operand=operand):
            return _applied(_operators()[type(op)], [operand])
        case ast.BinOp(op=op, left=left, right=right):
            return _applied(_operators()[type(op)], [left, right])
        case ast.Compare(ops=[op], left=left, comparators=[right]):
            return _applied(_operators()[type(op)], [left, right])
        case ast.BoolOp(op=op, values=parts):
            combine = _operators()[type(op)]
            return _applied(lambda *values: reduce(combine, values), parts)
        case _:
            raise TypeError(ast.unparse(node))


def _applied(function: Callable[..., Any], operands: list[ast.expr]) -> Formula:
    first, *others = parts = [_formula(operand) for operand in operands]
    if not others:
        return lambda at: function(first(at))
    if len(others) == 1:
        (second,) = others
        return lambda at: function(first(at), second(at))
    return lambda at: function(*(part(at) for part in parts))
