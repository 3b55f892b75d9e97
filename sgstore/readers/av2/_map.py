"""Conversion of a vector map of Argoverse 2 (``log_map_archive_….json``) into a road map.

A lane segment is a lane between two borders. Segments of intersections are in junctions without names.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.roads import (
    MAX_POINTS,
    Border,
    Joint,
    LaneLine,
    PlainCrosswalk,
    Sections,
    about_lanes,
    lane_text,
    plain_lanes,
    run_of,
)

_TYPES: Final = {"VEHICLE": "driving", "BIKE": "biking", "BUS": "bus"}
_UNKNOWN: Final = {"", "UNKNOWN"}


def map_text(told: dict[str, Any]) -> str:
    """Return the road map of a log as text in the lane text format; empty without lanes.

    Raises
    ------
    MapError
        There are too many lanes or points.
    """
    segments = {str(one["id"]): one for one in told["lane_segments"].values()}
    short: list[str] = []
    lines: list[LaneLine] = []
    points = 0
    for ident, one in segments.items():
        left, right = (_polyline(one[f"{side}_lane_boundary"]) for side in ("left", "right"))
        points += len(left) + len(right)
        if points > MAX_POINTS:
            raise MapError(f"more than {MAX_POINTS:,} points")
        if min(len(left), len(right)) < 2 or min(run_of(left)[-1], run_of(right)[-1]) < 1e-3:
            short.append(ident)
        else:
            lines.append(_line(segments, one, left, right))
    plain, warnings = plain_lanes(lines)
    if not plain:
        return ""
    notes = [about_lanes(short, "left out: without a length")] if short else []
    walks = [_crosswalk(one) for one in told.get("pedestrian_crossings", {}).values()]
    return lane_text(plain, [*notes, *warnings], crosswalks=walks)


def _polyline(told: list[dict[str, float]]) -> Any:
    """Return the points of a border (n, 3). Repeated points are removed."""
    line = np.array([[one["x"], one["y"], one["z"]] for one in told], np.float64).reshape(-1, 3)
    if not (np.abs(line) < 1e8).all():
        raise MapError("a border has an impossible point")
    apart = np.hypot(*np.diff(line[:, :2], axis=0).T) > 1e-3
    return line[np.concatenate([[True], apart])[: len(line)]]


def _line(segments: dict[str, Any], one: dict[str, Any], left: Any, right: Any) -> LaneLine:
    sections = Sections.between(left, right)
    marks = [str(one.get(f"{side}_lane_mark_type") or "") for side in ("left", "right")]
    before, after = (_known(segments, one.get(key)) for key in ("predecessors", "successors"))
    beside = [_known(segments, [one.get(f"{side}_neighbor_id")]) for side in ("left", "right")]
    return LaneLine(
        str(one["id"]),
        _TYPES.get(one["lane_type"], "none"),
        np.column_stack([sections.middle, sections.z]),
        lefts=(Border(left, *_crossed(marks[0])),),
        rights=(Border(right, *_crossed(marks[1])),),
        sections=sections,
        before=tuple(Joint(name, Joint.END) for name in before),
        after=tuple(Joint(name, Joint.START) for name in after),
        left_beside=tuple(beside[0]),
        right_beside=tuple(beside[1]),
        junction=None if one.get("is_intersection") else "",
    )


def _known(segments: dict[str, Any], idents: Any) -> list[str]:
    """Return those ids that exist in this map. A map covers only the surroundings of its log."""
    return [str(ident) for ident in idents or () if str(ident) in segments]


def _crossed(mark: str) -> tuple[bool | None, bool | None]:
    """Return two permissions for a marking: to cross it to the left, and to the right.

    ``DASHED_SOLID``: the line at the left is dashed, that at the right is solid.
    """
    if mark in _UNKNOWN:
        return None, None
    solid = [
        word != "NONE" and not word.startswith("DASH")
        for word in mark.split("_")
        if word != "DOUBLE"
    ]
    mixed = "SOLID" in mark and "DASH" in mark
    return not solid[1 if mixed else 0], not solid[0]


def _crosswalk(one: dict[str, Any]) -> PlainCrosswalk:
    """Return a crosswalk made from its two edges. Their directions may be opposite."""
    first, last = _polyline(one["edge1"]), _polyline(one["edge2"])
    if np.dot(first[-1, :2] - first[0, :2], last[-1, :2] - last[0, :2]) > 0:
        last = last[::-1]
    outline = np.vstack([first, last])
    return PlainCrosswalk(str(one["id"]), outline[:, :2], float(outline[:, 2].mean()))
