"""Measures of object pairs from positions, velocities and boxes: gaps, angles and contact times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._lane_numbers import LANE_DIST
from sgstore.model.pair_numbers._levels import GRADE, STEEPEST, STOREY, TOUCH
from sgstore.model.pair_numbers._pair_function import PairFunction

if TYPE_CHECKING:
    from collections.abc import Mapping

# Not within a branch of a CASE, because DuckDB would compute all parts again.
GAP: Final = "coalesce(sqrt(least(square1, square2, square3, square4)), 0) + 0 * (out1 + out2)"
"""SQL for the distance of b's centre from an octagon around a. NULL if a position or size is unknown."""

BEYOND: Final = {
    "out1": "abs(lon) - reach1",
    "out2": "abs(lat) - reach2",
    "out3": "abs(back) - reach3",
    "out4": "abs(side) - reach4",
    "past1": "abs(CASE WHEN lon < 0 THEN -lat ELSE lat END - hand * (lb * si - wb * co)) - wa",
    "past2": "abs(CASE WHEN lat < 0 THEN -lon ELSE lon END - hand * (lb * co - wb * si)) - la",
    "past3": "abs(CASE WHEN back < 0 THEN -side ELSE side END + hand * (la * si - wa * co)) - wb",
    "past4": "abs(CASE WHEN side < 0 THEN -back ELSE back END + hand * (la * co - wa * si)) - lb",
    **{
        f"square{i}": f"CASE WHEN out{i} > 0"
        f" THEN out{i} * out{i} + greatest(past{i}, 0) * greatest(past{i}, 0) END"
        for i in (1, 2, 3, 4)
    },
}
"""SQL for the distances of b's centre beyond the edges of the octagon and beyond their ends, and for squared
distances from the edges."""


_MEETS: Final = "meets1, meets2, meets3, meets4"
_PARTS: Final = "parts1, parts2, parts3, parts4"


def _turned(angle: str) -> str:
    return f"{angle} - 360 * ceil(({angle} - 180) / 360)"


_SPREAD: Final = "sqrt((b_x - a_x) * (b_x - a_x) + (b_y - a_y) * (b_y - a_y))"
_TILT: Final = "greatest(abs(sin(coalesce(a_pitch, 0))), abs(sin(coalesce(b_pitch, 0))))"
# Written into the branch that needs it: most pairs share a height.
_CLIMB: Final = (
    f"greatest(least({GRADE}e0 * {_SPREAD}, {STOREY}e0), {_SPREAD} * least({STEEPEST}e0, {_TILT}))"
)
"""SQL for the height difference that a road can have between two bodies."""

NUMBERS: Final[Mapping[str, PairFunction]] = {
    "dist": PairFunction(
        "distance between the centres, in space",
        "m",
        "span + level",
        note="in the plane where a height is not known",
        column="distance",
    ),
    # The distance of b's centre from the Minkowski sum of both boxes: an octagon around a's centre
    # with the edges of both. Boxes are symmetric about their centres. Of two opposite edges only
    # the one on the side of b's centre can be the nearest; therefore four remain, two in a's axes
    # and two in b's.
    "gap": PairFunction(
        "shortest distance between the footprints",
        "m",
        GAP,
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
    # Two boxes meet if their shadows meet on each axis of both (separating axes: Gottschalk, Lin
    # and Manocha, OBBTree, SIGGRAPH 1996). On one axis the shadows of moving boxes meet in one
    # interval of time. The boxes meet in the intersection of all four intervals.
    "ttc": PairFunction(
        "time until the footprints first touch if both keep their velocity and do not turn",
        "s",
        "CASE WHEN meets1 <= parts2 AND meets2 <= parts1 AND parts1 >= 0 AND parts2 >= 0"
        f" THEN CASE WHEN greatest({_MEETS}, 0) <= least({_PARTS})"
        f" AND (rel_speed >= 1e-6 OR greatest({_MEETS}) <= 0) THEN greatest({_MEETS}, 0) END END",
        note="0 where they overlap, NULL where they never touch or their velocities differ by less than"
        " 1e-6 m/s",
        dear=True,
        worse="low",
    ),
    "headway": PairFunction(
        "time until a, at its speed along its axis, has come as far as b is now: lon_gap over that speed",
        "s",
        "CASE WHEN lon > 0 AND v1 > 0.1 THEN lon_gap / v1 END",
        note="NULL where b is not ahead, or a stands or drives backwards",
        alias="thw",
        worse="low",
    ),
    "rel_speed": PairFunction(
        "length of the difference of the velocities", "m/s", "sqrt(dvx * dvx + dvy * dvy)"
    ),
    # Not with greatest(), which ignores NULL.
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
        "CASE WHEN approach >= 1e-6 THEN gap / approach END",
        note="NULL where the centres approach by less than 1e-6 m/s",
        dear=True,
        worse="low",
    ),
    LANE_DIST: PairFunction(
        "from a to b along the lanes, negative where b is behind, 0 within a part of the map",
        "m",
        "",
        note="NULL beyond 200 m",
    ),
}

PARTS: Final[Mapping[str, str]] = {
    # NULL for pairs on different storeys and for an entity with its carrier, else 0.
    "apart": "CASE WHEN a_high > a_low AND b_high > b_low"
    f" AND greatest(b_low - a_high, a_low - b_high) <= {TOUCH:.0e} THEN 0"
    f" WHEN a_high > a_low AND b_high > b_low OR abs(b_low - a_low) > {STOREY}e0"
    f" THEN abs(b_low - a_low) - {_CLIMB} ELSE 0 * (b_low - a_low) END",
    "level": "CASE WHEN apart > 0 OR a_carrier = b_node_id OR b_carrier = a_node_id OR a_carrier = b_carrier"
    " THEN NULL ELSE 0 END",
    # NULL for flat entities, else 0.
    "solid": "CASE WHEN a_high <= a_low OR b_high <= b_low THEN NULL ELSE 0 END",
    **{f"d{axis}": f"b_{axis} - a_{axis} + level" for axis in ("x", "y", "vx", "vy")},
    "dz": "coalesce(b_z - a_z, 0)",
    "span": "sqrt((b_x - a_x) * (b_x - a_x) + (b_y - a_y) * (b_y - a_y) + dz * dz)",
    **{f"l{one}": f"{one}_length / 2 + solid" for one in "ab"},
    **{f"w{one}": f"{one}_width / 2" for one in "ab"},
    **{f"c{one}": f"cos({one}_heading)" for one in "ab"},
    **{f"s{one}": f"sin({one}_heading)" for one in "ab"},
    "planar": "sqrt(dx * dx + dy * dy)",
    "pace": "sqrt(a_vx * a_vx + a_vy * a_vy)",
    # The difference of two angles is exact for typical headings (0, π/2, π), but the angle of
    # turned components is not: the cosine of the double nearest to π/2 is 6e-17.
    "course": "CASE WHEN dx = 0 AND dy = 0 THEN 0 * a_heading ELSE degrees(atan2(dy, dx) - a_heading) END",
    "turned": "degrees(b_heading - a_heading) + level",
    "sighted": "degrees(b_heading - atan2(dy, dx))",
    # a's centre in b's axes, with the opposite sign
    "back": "dx * cb + dy * sb",
    "side": "dy * cb - dx * sb",
    # Angle between the headings; for parallel boxes two corners reach equally far, and each box
    # uses the corner of the other.
    "cosine": "ca * cb + sa * sb",
    "sine": "ca * sb - sa * cb",
    "co": "abs(cosine)",
    "si": "abs(sine)",
    "hand": "CASE WHEN cosine * sine < 0 THEN -1 ELSE 1 END",
    # Edges of the octagon, along and across a's axis and b's: their distance from a's centre, the
    # distance of b's centre beyond them, and beyond their ends
    "reach1": "la + lb * co + wb * si",
    "reach2": "wa + lb * si + wb * co",
    "reach3": "lb + la * co + wa * si",
    "reach4": "wb + la * si + wa * co",
    **BEYOND,
    # On each of the four axes, turned so that b moves along it: b's position and speed, and start
    # and end of the overlap. A speed of 0 is replaced: two boxes at rest on an axis meet in the far
    # future, or have met for ages.
    "drift1": "dvx * ca + dvy * sa",
    "drift2": "dvy * ca - dvx * sa",
    "drift3": "dvx * cb + dvy * sb",
    "drift4": "dvy * cb - dvx * sb",
    **{
        f"place{i}": f"{at} * sign(drift{i} + 1e-200)"
        for i, at in enumerate(("lon", "lat", "back", "side"), 1)
    },
    **{f"rate{i}": f"abs(drift{i}) + 1e-200" for i in (1, 2, 3, 4)},
    **{f"meets{i}": f"(-reach{i} - place{i}) / rate{i}" for i in (1, 2, 3, 4)},
    **{f"parts{i}": f"(reach{i} - place{i}) / rate{i}" for i in (1, 2, 3, 4)},
    # Cheap bounds: two boxes are never nearer than their circumscribed circles (a micrometre covers
    # rounding), and the distance of two in straight motion shrinks by at most this in a second.
    "at_least": "planar - sqrt(la * la + wa * wa) - sqrt(lb * lb + wb * wb) - 1e-6",
    "approach": "greatest(coalesce(closing_speed, 0), 0)",
}
