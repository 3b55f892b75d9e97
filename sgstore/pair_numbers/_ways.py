"""What is told by lanes, and is no expression but looked up: distances along them, and how they run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

LANE_DIST: Final = "lane_dist"
"""From one entity to another."""
PART_DIST: Final = "part_dist"
"""``lane_dist`` where one of the two is a part of the map, which is told by the labels of a query."""

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
"""Functions of one entity → the sort of the part of the map that comes next along the lanes."""

COURSES: Final = ("curvature", "slope")
"""Functions of one entity that tell how the lane runs where it is: columns of ``map_course``."""

WAYS: Final = frozenset({LANE_DIST, PART_DIST, *NEXT_PARTS, *COURSES})
OF_ONE: Final = (*NEXT_PARTS, *COURSES)
"""Those of one entity, which stands for both of a pair."""


def as_written(name: str, a: str, b: str) -> str:
    """A number of a pair as the language has it, given the names of both entities."""
    if name in OF_ONE:
        return f"{name}({a})"
    return f"{LANE_DIST if name == PART_DIST else name}({a}, {b})"
