"""Conversion of Lanelet2 lanelets to lanes: centre lines, borders, successors and neighbours."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.maps.roads import (
    MAX_NAME,
    Border,
    Joint,
    LaneLine,
    Sections,
    about_lanes,
    run_of,
    thinned,
)
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.maps.lanelet2._document import OsmDocument, OsmElement
    from sgstore.model.world import Floats

CROSSWALK: Final = "crosswalk"

_TYPES: Final = {
    **dict.fromkeys(("road", "highway", "play_street", "exit", "rural_road"), "driving"),
    "bus_lane": "bus",
    "emergency_lane": "restricted",
    "bicycle_lane": "biking",
    **dict.fromkeys(("walkway", "shared_walkway", "pedestrian_lane", "stairs"), "sidewalk"),
    "road_shoulder": "shoulder",
    "parking": "parking",
    "rail": "rail",
    CROSSWALK: CROSSWALK,
}
"""Subtype of a lanelet in Lanelet2 or Autoware → OpenDRIVE lane type."""

_OF_PARTICIPANT: Final = (("vehicle", "driving"), ("bicycle", "biking"), ("pedestrian", "sidewalk"))
"""Participant that may use a lanelet → lane type. The first match counts."""

_BOTH_WAYS: Final = frozenset({CROSSWALK, "walkway", "shared_walkway", "stairs", "pedestrian_lane"})
"""Subtypes of lanelets that by default are used in both directions."""

_YES: Final = frozenset({"yes", "true", "1"})

_PAINTED: Final = frozenset({"line_thin", "line_thick"})

_CROSSED: Final = {
    "dashed": (True, True),
    "dashed_solid": (False, True),
    "solid_dashed": (True, False),
}
"""Subtype of a painted line → True if a change is permitted from its right to its left, and back."""

_SPEED: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(km/?h|kmph|mph|m/s|mps)?", re.IGNORECASE)

_UNITS: Final = {"mph": 0.44704, "m/s": 1.0, "mps": 1.0}

COUNTRY: Final = re.compile(r"^[a-z]{2}(?=[A-Z0-9])")
"""Country prefix of a sign code: ``de205``, ``usR1-1``."""

_MOST_BESIDE: Final = 100
"""Largest number of lanelets that share one way or one place."""

SHORTEST: Final = 0.01
"""Smallest length of the line of a signal; m. An upright signal would be a point when seen from above."""


class LaneletShape(NamedTuple):
    """Lanelet with its left and right border, both in driving direction."""

    element: OsmElement
    left: Floats
    right: Floats
    left_turned: bool
    right_turned: bool
    starts: tuple[str, str]
    ends: tuple[str, str]


def read_lanelets(document: OsmDocument) -> dict[str, LaneletShape]:
    """Return the lanelets of a map by id. A lanelet without two borders is skipped with a warning."""
    found: dict[str, LaneletShape] = {}
    broken: list[str] = []
    for ident, element in document.relations.items():
        if element.tags.get("type") != "lanelet":
            continue
        ways = [element.members_of(role) for role in ("left", "right")]
        pieces = [[document.lines[way] for way in side if way in document.lines] for side in ways]
        thin = [thinned(side[0]) if len(side) == 1 else np.zeros((0, 3)) for side in pieces]
        if len(ident) > MAX_NAME or any(len(line) < 2 or run_of(line)[-1] <= 0 for line in thin):
            broken.append(ident)
            continue
        turned = _turned(thin[0], thin[1])
        left, right = (
            line[::-1] if back else line for line, back in zip(thin, turned, strict=True)
        )
        nodes = [
            document.nodes[side[0]][:: -1 if back else 1]
            for side, back in zip(ways, turned, strict=True)
        ]
        starts, ends = ((nodes[0][at], nodes[1][at]) for at in (0, -1))
        found[ident] = LaneletShape(element, left, right, *turned, starts, ends)
    if broken:
        what = "expected one way to the left and one to the right, each with a length: left out"
        document.warnings.append(about_lanes(broken, what))
    return found


def roundabout_names(document: OsmDocument) -> dict[str, str]:
    """Return the roundabout of each lanelet that belongs to one: lanelet id → roundabout id."""
    return {
        lanelet: ident[:MAX_NAME]
        for ident, element in document.relations.items()
        if element.tags.get("type") == "regulatory_element"
        and element.tags.get("subtype") == "roundabout"
        for lanelet in element.members_of("internal", "relation")
    }


def _turned(left: Floats, right: Floats) -> tuple[bool, bool]:
    """Return two flags, for the left and right border: its points run against the lanelet's direction."""
    along = np.hypot(*(left[[0, -1]] - right[[0, -1]])[:, :2].T).sum()
    across = np.hypot(*(left[[0, -1]] - right[[-1, 0]])[:, :2].T).sum()
    apart = bool(along > across)
    ring = np.concatenate((right[::-1] if apart else right, left[::-1]))[:, :2]
    (x, y), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
    clockwise = bool((x * y1 - x1 * y).sum() < 0)
    return clockwise, clockwise != apart


def type_of(element: OsmElement) -> str:
    """Return the lane type of a lanelet, from its subtype or else from its permitted participants."""
    subtype = element.tags.get("subtype", "")
    told = {
        key.removeprefix("participant:").partition(":")[0]
        for key, value in element.tags.items()
        if key.startswith("participant:") and value.lower() in _YES
    }
    by_subtype = _TYPES.get(subtype, "")
    if not told or by_subtype == CROSSWALK:
        return by_subtype or "none"
    by_user = next((lane for user, lane in _OF_PARTICIPANT if user in told), "restricted")
    same = by_subtype in DRIVING if by_user == "driving" else by_subtype == by_user
    return by_subtype if same else by_user


def line_of(
    document: OsmDocument, ident: str, lanelet: LaneletShape, kind: str, limit: float
) -> LaneLine:
    element = lanelet.element
    sections = Sections.between(lanelet.left, lanelet.right)
    one_way = element.tags.get("one_way", "").lower()
    both = one_way not in _YES if one_way else element.tags.get("subtype", "") in _BOTH_WAYS
    own = speed_of(element.tags.get("speed_limit", ""))
    left, right = element.members_of("left")[0], element.members_of("right")[0]
    turning = "turn_direction" in element.tags
    return LaneLine(
        ident,
        kind,
        np.column_stack((sections.middle, sections.z)),
        both=both,
        lefts=(_border(document, left, lanelet.left, turned=lanelet.left_turned),),
        rights=(_border(document, right, lanelet.right, turned=lanelet.right_turned),),
        sections=sections,
        junction=None if turning else "",
        speed_limit=own if np.isfinite(own) else limit,
    )


def _border(document: OsmDocument, way: str, line: Floats, *, turned: bool) -> Border:
    tags = document.tags[way]
    crossed = (False, False)
    if tags.get("type") in _PAINTED:
        crossed = _CROSSED.get(tags.get("subtype", ""), crossed)
    sides = [tags.get(f"lane_change{side}", "").lower() for side in ("", ":left", ":right")]
    if sides[0]:
        crossed = (sides[0] in _YES, sides[0] in _YES)
    elif any(sides):
        crossed = (sides[1] in _YES, sides[2] in _YES)
    to_left, to_right = crossed[::-1] if turned else crossed
    return Border(line, to_left, to_right, way, broad=tags.get("type") == "line_thick")


def speed_of(text: str) -> float:
    """Parse a speed text to m/s (default unit km/h); NaN for an invalid text."""
    found = _SPEED.fullmatch(text.strip())
    speed = float(found[1]) * _UNITS.get((found[2] or "").lower(), 1 / 3.6) if found else 0.0
    return speed if 0 < speed < 1000 else np.nan


def with_neighbours(
    document: OsmDocument, lines: Sequence[LaneLine], lanelets: dict[str, LaneletShape]
) -> list[LaneLine]:
    """Return the lanes with left and right neighbours added, for lanelets that share a border."""
    users: dict[str, list[tuple[str, bool]]] = defaultdict(list)  # lane, to the left of the way
    for line in lines:
        lanelet = lanelets[line.ident]
        users[line.lefts[0].ident].append((line.ident, lanelet.left_turned))
        users[line.rights[0].ident].append((line.ident, not lanelet.right_turned))
    crowded = [way for way, lanes in users.items() if len(lanes) > _MOST_BESIDE]
    for way in crowded:
        what = f"way {way}: it bounds more than {_MOST_BESIDE} lanelets: none lie beside"
        document.warnings.append(what)
        users[way] = []

    def others(line: LaneLine, way: str, *, on_left: bool) -> tuple[str, ...]:
        return tuple(one for one, left in users[way] if left != on_left and one != line.ident)

    return [
        replace(
            line,
            left_beside=others(line, line.lefts[0].ident, on_left=lanelets[line.ident].left_turned),
            right_beside=others(
                line, line.rights[0].ident, on_left=not lanelets[line.ident].right_turned
            ),
        )
        for line in lines
    ]


def with_joints(
    document: OsmDocument, lines: Sequence[LaneLine], lanelets: dict[str, LaneletShape]
) -> list[LaneLine]:
    """Return the lanes with predecessors and successors added, for lanelets with common end points."""
    at: dict[tuple[str, str], list[Joint]] = defaultdict(list)
    for line in lines:
        lanelet = lanelets[line.ident]
        at[lanelet.starts].append(Joint(line.ident, Joint.START))
        at[_reversed(lanelet.ends)].append(Joint(line.ident, Joint.END))
    for gate, joints in at.items():
        if len(joints) > _MOST_BESIDE:
            what = f"more than {_MOST_BESIDE} lanelets meet between nodes {' and '.join(gate)}"
            document.warnings.append(f"{what}: no lanelet continues there")
            joints.clear()

    def touching(line: LaneLine, gate: tuple[str, str]) -> tuple[Joint, ...]:
        return tuple(joint for joint in at.get(gate, ()) if joint.lane != line.ident)

    return [
        replace(
            line,
            before=touching(line, _reversed(lanelets[line.ident].starts)),
            after=touching(line, lanelets[line.ident].ends),
        )
        for line in lines
    ]


def _reversed(gate: tuple[str, str]) -> tuple[str, str]:
    return gate[1], gate[0]


def mean_z(lanelet: LaneletShape) -> float:
    return float(np.concatenate((lanelet.left[:, 2], lanelet.right[:, 2])).mean())
