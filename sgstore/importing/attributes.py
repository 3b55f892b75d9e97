"""What files say of nodes and edges, in the units that people read, as the columns of the house."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.importing.given import wrong
from sgstore.vocabulary import LANE_TYPES, LIGHT_STATE_CODE, VEHICLE_LIGHTS, folded

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_RADIANS: Final = frozenset({"heading", "pitch", "roll", "yaw_rate", "heading_error"})
"""Numbers that are degrees outside."""

STATE_NUMBERS: Final = (
    *("x", "y", "z", "heading", "pitch", "roll", "vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"),
    *("length", "width", "height", "steer", "throttle", "brake"),
)
PART_NUMBERS: Final = ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature")
PART_TEXTS: Final = ("lane_type", "road", "junction", "turn")
PART_WHOLE: Final = ("section", "lane")
LANE_NUMBERS: Final = {
    "overlap": "overlap",
    "lane_offset": "offset",
    "offset": "offset",
    "heading_error": "heading_error",
    "along": "along",
}
"""Numbers of an edge ``isIn`` → columns of :class:`sgstore.graph.LaneStates`."""

_SAID: Final = frozenset(
    {"kind", "base_class", "label", "name", "ident", "is_ego", "is_static", "id"}
)
"""Attributes that are read elsewhere, or say again what a graph says."""

_FOLLOWING: Final = frozenset({"accel", "node_id"})
"""Attributes that follow from others."""

_DERIVED: Final = ("derived_velocity", "derived_acceleration", "derived_yaw_rate")
_TEXTS: Final = frozenset({"special", "subkind", "type_name", "type"})


def state_of(
    path: Path, where: str, attributes: Mapping[str, Any], lost: dict[str, int]
) -> dict[str, float]:
    """What is known of an entity in a frame: columns of :class:`sgstore.world.States`; all else is lost.

    Raises
    ------
    TraceError
        A value is not what its attribute takes.
    """
    found: dict[str, float] = {}
    lights = 0
    for name, value in attributes.items():
        if value is None or name in _SAID or name in _FOLLOWING or name in _TEXTS:
            continue
        if name in STATE_NUMBERS:
            found[name] = _number(path, where, name, value)
        elif name == "light_state":
            found[name] = _light_state(path, where, value)
        elif name in VEHICLE_LIGHTS or name in _DERIVED:
            lights |= int(bool(value)) << (
                VEHICLE_LIGHTS.index(name) if name in VEHICLE_LIGHTS else 0
            )
            if name in VEHICLE_LIGHTS:
                found["lights"] = lights
            else:
                found["derived"] = int(found.get("derived", 0)) | int(
                    bool(value)
                ) << _DERIVED.index(name)
        elif name == "speed":
            _number(path, where, name, value)
        else:
            lost[f"attribute {name}"] = lost.get(f"attribute {name}", 0) + 1
    _speed(attributes, found, lost)
    return found


def _speed(attributes: Mapping[str, Any], found: dict[str, float], lost: dict[str, int]) -> None:
    """A speed without a velocity: along the heading, if that is known."""
    speed = attributes.get("speed")
    if speed is None or "vx" in found:
        return
    if "heading" not in found:
        lost["attribute speed (no heading)"] = lost.get("attribute speed (no heading)", 0) + 1
        return
    found["vx"] = float(speed) * math.cos(found["heading"])
    found["vy"] = float(speed) * math.sin(found["heading"])


def part_of(
    path: Path, where: str, attributes: Mapping[str, Any], lost: dict[str, int]
) -> dict[str, Any]:
    """What is known of a part of the road: columns of :class:`sgstore.roads.MapNodes`; all else is lost.

    Raises
    ------
    TraceError
        A value is not what its attribute takes.
    """
    found: dict[str, Any] = {}
    for name, value in attributes.items():
        if value is None or name in _SAID or name in _FOLLOWING:
            continue
        if name in PART_NUMBERS:
            found[name] = _number(path, where, name, value)
        elif name in PART_WHOLE:
            found[name] = int(_number(path, where, name, value))
        elif name in PART_TEXTS:
            found[name] = str(value)[:200]
        else:
            lost[f"attribute {name}"] = lost.get(f"attribute {name}", 0) + 1
    kinds = {folded(kind): kind for kind in LANE_TYPES}
    if "lane_type" in found:
        if folded(found["lane_type"]) not in kinds:
            raise wrong(path, where, f"no type of lanes: {found['lane_type']!r}")
        found["lane_type"] = kinds[folded(found["lane_type"])]
    return found


def lane_state_of(
    path: Path, where: str, attributes: Mapping[str, Any], lost: dict[str, int]
) -> dict[str, float]:
    """What is known of how an entity lies in a lane; ``primary`` is 1 or 0 where the file says it."""
    found: dict[str, float] = {}
    for name, value in attributes.items():
        if value is None:
            continue
        if name in LANE_NUMBERS:
            found[LANE_NUMBERS[name]] = _number(path, where, name, value)
        elif name in {"is_primary", "primary"}:
            found["primary"] = float(bool(value))
        else:
            lost[f"attribute {name} of edges"] = lost.get(f"attribute {name} of edges", 0) + 1
    return found


def gap_of(path: Path, where: str, attributes: Mapping[str, Any], lost: dict[str, int]) -> float:
    """The gap of an edge ``leads`` or ``follows``; NaN where it is not known."""
    others_lost(attributes, lost, ("gap",))
    value = attributes.get("gap")
    return float("nan") if value is None else _number(path, where, "gap", value)


def others_lost(
    attributes: Mapping[str, Any], lost: dict[str, int], kept: tuple[str, ...] = ()
) -> None:
    """Count the attributes of an edge that cannot be kept."""
    for name, value in attributes.items():
        if value is not None and name not in kept:
            lost[f"attribute {name} of edges"] = lost.get(f"attribute {name} of edges", 0) + 1


def columns_of(rows: list[dict[str, float]]) -> dict[str, NDArray[Any]]:
    """Rows as columns, NaN, or what stands for nothing, where one says nothing."""
    empty = {"lights": -1, "light_state": -1, "derived": 0}
    types = {"lights": np.int64, "light_state": np.int8, "derived": np.int64}
    names = {name for row in rows for name in row}
    return {
        name: np.array(
            [row.get(name, empty.get(name, math.nan)) for row in rows], types.get(name, np.float64)
        )
        for name in sorted(names)
    }


def _number(path: Path, where: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        if isinstance(value, float) and math.isnan(value):
            return value
        raise wrong(path, where, f"expected a number as {name!r}, found {str(value)[:80]!r}")
    return math.radians(value) if name in _RADIANS else float(value)


def _light_state(path: Path, where: str, value: Any) -> int:
    code = LIGHT_STATE_CODE.get(str(value).lower())
    if code is None:
        known = ", ".join(LIGHT_STATE_CODE)
        raise wrong(path, where, f"no state of a light: {str(value)[:80]!r}; there are: {known}")
    return code
