"""Measures from the lanes of a map: distance along lanes, curvature and slope."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

LANE_DIST: Final = "lane_dist"
"""Name of the function "distance along lanes from one entity to another"."""
PART_DIST: Final = "part_dist"
"""Name of ``lane_dist`` if one argument is a map part, which the labels of a query show."""

NEXT_PARTS: Final[Mapping[str, str]] = {
    "to_junction": "junction",
    "to_roundabout": "roundabout",
    "to_merge_zone": "merge_zone",
    "to_departure_zone": "departure_zone",
    "to_broad_line_left": "broad_line_left",
    "to_broad_line_right": "broad_line_right",
    "to_crosswalk": "crosswalk",
    "to_stop_line": "stop_line",
    "to_traffic_light": "traffic_light",
    "to_stop_sign": "stop_sign",
    "to_yield_sign": "yield_sign",
    "to_speed_limit": "speed_limit",
}
"""Function of one entity → kind of the map part to which it measures the distance along lanes."""

COURSES: Final = ("curvature", "slope")
"""Functions of one entity for the curvature and slope of its lane, which are columns of ``map_course``."""

WAYS: Final = frozenset({LANE_DIST, PART_DIST, *NEXT_PARTS, *COURSES})
OF_ONE: Final = (*NEXT_PARTS, *COURSES)
"""Functions of a single entity. Views have them for both entities of a pair."""


def as_written(name: str, a: str, b: str) -> str:
    """Return the query text of a measure of two objects a and b, such as ``ttc(a, b)``."""
    if name in OF_ONE:
        return f"{name}({a})"
    return f"{LANE_DIST if name == PART_DIST else name}({a}, {b})"
