"""Conversion of a map of 123D (lanes, lane groups, crosswalks) into a road map."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.roads import (
    MAX_POINTS,
    Border,
    Joint,
    LaneLine,
    PlainCrosswalk,
    Sections,
    lane_text,
    plain_lanes,
    run_of,
)
from sgstore.readers._arrow_files import values
from sgstore.readers.py123d._msgpack import unpacked

_LANE, _GROUP, _CROSSWALK = 0, 1, 3
_TYPES: Final = {3: "biking", 4: "bus"}


class Lanes(NamedTuple):
    """Road map in the lane text format, and the start position of each lane by name; m."""

    text: bytes
    starts: dict[str, tuple[float, float, float]]


def read_lanes(table: Any, lost: list[str]) -> Lanes:
    """Return the road map made from a table of map objects. Report damaged objects as lost.

    Raises
    ------
    TraceError
        A column is missing.
    MapError
        There are too many lanes or points.
    """
    layers: dict[int, dict[str, dict[str, Any]]] = {_LANE: {}, _GROUP: {}, _CROSSWALK: {}}
    columns = (values(table, name) for name in ("object_id", "map_layer", "features"))
    for ident, layer, features in zip(*columns, strict=True):
        if layer in layers:
            try:
                layers[layer][str(ident)] = dict(unpacked(features))
            except (ValueError, TypeError) as error:
                lost.append(f"map object {ident} is damaged: {error}"[:200])
    crossings = {name: group.get("intersection_id") for name, group in layers[_GROUP].items()}
    lines: list[LaneLine] = []
    walks: list[PlainCrosswalk] = []
    points = 0
    for name, lane in layers[_LANE].items():
        try:
            lines.append(_line(name, lane, layers[_LANE], crossings))
            points += len(lane["left_boundary"]) + len(lane["right_boundary"])
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            lost.append(f"lane {name} cannot be used: {error}"[:200])
    if points > MAX_POINTS:
        raise MapError(f"more than {MAX_POINTS:,} points")
    for name, walk in layers[_CROSSWALK].items():
        outline = _points(walk.get("outline"))
        if len(outline) > 2:
            walks.append(PlainCrosswalk(name, outline[:, :2], float(outline[:, 2].mean())))
    plain, warnings = plain_lanes(lines)
    if not plain:
        return Lanes(b"", {})
    starts = {line.ident: tuple(line.centre[0].tolist()) for line in lines}
    return Lanes(lane_text(plain, warnings, crosswalks=walks).encode(), starts)


def _points(told: Any) -> Any:
    """Return the points of a line, (n, 3), without repeated ones. An invalid line raises an error."""
    line = np.asarray(told, np.float64)
    if line.ndim != 2 or line.shape[1] != 3 or not (np.abs(line) < 1e8).all():
        raise ValueError("a line has an impossible point")
    apart = np.hypot(*np.diff(line[:, :2], axis=0).T) > 1e-3
    return line[np.concatenate([[True], apart])[: len(line)]]


def _line(
    name: str, lane: dict[str, Any], lanes: dict[str, Any], crossings: dict[str, Any]
) -> LaneLine:
    left, right = _points(lane["left_boundary"]), _points(lane["right_boundary"])
    if min(len(left), len(right)) < 2 or min(run_of(left)[-1], run_of(right)[-1]) < 1e-3:
        raise ValueError("it has no length")
    sections = Sections.between(left, right)
    known = {
        key: [str(one) for one in lane.get(key) or [] if str(one) in lanes]
        for key in ("predecessor_ids", "successor_ids")
    }
    beside = [str(lane.get(f"{side}_lane_id")) for side in ("left", "right")]
    crossing = crossings.get(str(lane.get("lane_group_id")))
    limit = lane.get("speed_limit_mps")
    return LaneLine(
        name,
        _TYPES.get(lane.get("lane_type", 0), "driving"),
        np.column_stack([sections.middle, sections.z]),
        lefts=(Border(left),),
        rights=(Border(right),),
        sections=sections,
        before=tuple(Joint(one, Joint.END) for one in known["predecessor_ids"]),
        after=tuple(Joint(one, Joint.START) for one in known["successor_ids"]),
        left_beside=tuple(one for one in beside[:1] if one in lanes),
        right_beside=tuple(one for one in beside[1:] if one in lanes),
        junction="" if crossing is None else str(crossing),
        speed_limit=float(limit) if isinstance(limit, (int, float)) and limit > 0 else np.nan,
    )
