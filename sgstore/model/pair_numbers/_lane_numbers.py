"""Measures from the lanes of a map: distance along lanes, curvature and slope."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

LANE_DIST: Final = "lane_dist"
"""Distance along the lanes from one entity to another."""
PART_DIST: Final = "part_dist"
"""``lane_dist`` with one part of the map, recognised by the labels of a query."""

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
"""Functions of one entity → the kind of the next map part along the lanes."""

COURSES: Final = ("curvature", "slope")
"""Functions of one entity for the course of its lane: columns of ``map_course``."""

WAYS: Final = frozenset({LANE_DIST, PART_DIST, *NEXT_PARTS, *COURSES})
OF_ONE: Final = (*NEXT_PARTS, *COURSES)
"""Functions of one entity, used for both entities of a pair."""


def as_written(name: str, a: str, b: str) -> str:
    """Return the query text of a measure of two objects, such as ``ttc(a, b)``."""
    if name in OF_ONE:
        return f"{name}({a})"
    return f"{LANE_DIST if name == PART_DIST else name}({a}, {b})"
