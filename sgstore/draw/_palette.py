"""Colours of kinds, lane types, lights and relations in pictures, with their captions.

The colour families are those of the paper's figures: roads blue-grey, entities magenta, the ego
orange. Hue is never the only difference: kinds also differ in lightness, shape and caption, traffic
lights by the position of the lit lamp, closeness by line width.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.maps.roads import DrawnOutlines
from sgstore.model.vocabulary import PROXIMITY

if TYPE_CHECKING:
    from collections.abc import Mapping


PAPER: Final = "#ffffff"
GROUND: Final = "#f4f5f1"
INK: Final = "#2b2f36"
FAINT_INK: Final = "#757b86"
RING: Final = "#aab1bd"
RULE: Final = "#d9dce1"
LANE_MARK: Final = "#ffffff"
LANE_ARROW: Final = "#f7f9fb"
CROSSWALK: Final = "#fdfdfb"
JUNCTION: Final = "#a6b8d4"

EGO: Final = "#e8710a"
FAR_EDGE: Final = "#e0bd9a"
EGO_LANE: Final = "#f5d3ae"
MATCH: Final = "#ffd60a"
MATCH_EDGE: Final = "#5c4a00"
MATCH_PAPER: Final = "#fff3b0"

ROAD_EDGE: Final = "#5b7194"
ENTITY_EDGE: Final = "#b06a9d"
MIXED_EDGE: Final = "#8a8fa0"

DIAGRAM_TINTS: Final[Mapping[str, str]] = {
    "lane": "#3f74bd",
    "crosswalk": "#6f97cf",
    "off_road": "#8aa3c4",
    "waypoint": "#6f97cf",
    "road": "#2c5591",
    "junction": "#1d3a66",
    "roundabout": "#1d3a66",
}
"""Colours of the nodes of map parts in diagrams. Entities have other colours."""

TRAVELLED: Final = DrawnOutlines.MOTOR_LANES
"""Lane types for motor traffic, which have markings and arrows along their centre lines."""

LANE_TINTS: Final[Mapping[str, str]] = {
    **dict.fromkeys(TRAVELLED, "#c9d2df"),
    **dict.fromkeys(("bus", "taxi", "HOV", "tram", "rail"), "#d3c6e4"),
    **dict.fromkeys(("sidewalk", "walking"), "#efdfbf"),
    "stop": "#d9cdd4",
    "shoulder": "#cfc8ba",
    "border": "#dedfcb",
    "curb": "#b8b09c",
    "biking": "#b9e0cd",
    "parking": "#bfdcf4",
    "median": "#b9d49c",
    "restricted": "#ebd0c6",
    "none": "#e7eae9",
}
"""Lane type of OpenDRIVE → colour. See :func:`lane_tint` for unknown types.

All tints are light enough for dark text, and any two are distinguishable (tested).
"""

ENTITY_TINTS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("car", "vehicle"), "#c2408f"),
    **dict.fromkeys(("truck", "bus", "trailer"), "#6d2468"),
    **dict.fromkeys(("motorcycle", "bicycle"), "#d873b5"),
    **dict.fromkeys(("person", "animal"), "#e3115f"),
    **dict.fromkeys(("stop_sign", "yield_sign", "speed_limit", "sign"), "#5a6b85"),
    **dict.fromkeys(("prop", "pole", "barrier"), "#a9a39b"),
    "van": "#93307c",
    "train": "#4a1a4c",
    "traffic_light": "#3a4250",
    "building": "#d2cfc9",
    "vegetation": "#c6d4ba",
    "unknown": "#8f8a94",
}

LIGHT_TINTS: Final[Mapping[str, tuple[str, str, str]]] = {
    "red": ("#e5383b", "#5a626f", "#5a626f"),
    "red_yellow": ("#e5383b", "#ffb703", "#5a626f"),
    "yellow": ("#5a626f", "#ffb703", "#5a626f"),
    "green": ("#5a626f", "#5a626f", "#2ec4a0"),
    "flashing": ("#5a626f", "#ffe08a", "#5a626f"),
    "off": ("#5a626f", "#5a626f", "#5a626f"),
    "unknown": ("#8d95a3", "#8d95a3", "#8d95a3"),
}
"""State of a traffic light → colours of its three lamps, from top to bottom."""

SIGNAL_TINTS: Final[Mapping[str, str]] = {
    "traffic_light": INK,
    "stop_sign": "#c1121f",
    "yield_sign": "#e07a00",
    "speed_limit": "#2f6fb0",
    "sign": "#8d95a3",
}
"""Kind of signal → colour of its dot on a map of a whole town, which has no space for its shape."""

LIGHT_EDGES: Final[Mapping[str, str]] = {
    "red": "#e5383b",
    "red_yellow": "#e5383b",
    "yellow": "#d69a00",
    "green": "#1f9d80",
}
"""State of a traffic light → colour of the line to the lane that it controls."""

CLOSENESS: Final[Mapping[str, tuple[str, float]]] = dict(
    zip(
        PROXIMITY,
        (
            ("#9c2f00", 3.4),
            ("#bd4500", 2.8),
            ("#d95f0e", 2.2),
            ("#ea8536", 1.7),
            ("#f2a767", 1.2),
            ("#f3c499", 0.8),
        ),
        strict=True,
    )
)
"""Proximity relation → colour and width (points) of its line. The closest relation is first."""


def lane_tint(lane_type: str) -> str:
    """Return the colour of a lane type; an unknown type has the colour of ``none``."""
    return LANE_TINTS.get(lane_type, LANE_TINTS["none"])


def entity_tint(kind: str, *, ego: bool = False) -> str:
    """Return the colour of an entity by its kind; the ego has its own colour."""
    return EGO if ego else ENTITY_TINTS.get(kind, ENTITY_TINTS["unknown"])
