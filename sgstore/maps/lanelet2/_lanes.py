"""Conversion of lanelets, regulatory elements, signs and stop lines to text of plain lanes."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.lanelet2._document import OsmDocument, OsmElement, read_osm
from sgstore.maps.lanelet2._projection import Projection
from sgstore.maps.opendrive import kind_of_signal
from sgstore.maps.roads import (
    END,
    MAX_NAME,
    START,
    Border,
    Joint,
    LaneLine,
    PlainCrosswalk,
    PlainLane,
    PlainObject,
    PlainSignal,
    about_lanes,
    lane_text,
    painted_across,
    plain_lanes,
    run_of,
    sections_between,
    thinned,
    with_junctions,
)
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

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
"""Subtypes of lanelets, of Lanelet2 and Autoware → lane types of OpenDRIVE."""

_OF_PARTICIPANT: Final = (("vehicle", "driving"), ("bicycle", "biking"), ("pedestrian", "sidewalk"))
"""Participant of a lanelet → type of its lane; the first match counts."""
_BOTH_WAYS: Final = frozenset({CROSSWALK, "walkway", "shared_walkway", "stairs", "pedestrian_lane"})
"""Subtypes that are used in both directions by default."""
_YES: Final = frozenset({"yes", "true", "1"})
_PAINTED: Final = frozenset({"line_thin", "line_thick"})
_CROSSED: Final = {
    "dashed": (True, True),
    "dashed_solid": (False, True),
    "solid_dashed": (True, False),
}
"""Subtype of a painted line → permission to change from its right to its left, and back."""
_SPEED: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(km/?h|kmph|mph|m/s|mps)?", re.IGNORECASE)
_UNITS: Final = {"mph": 0.44704, "m/s": 1.0, "mps": 1.0}
_COUNTRY: Final = re.compile(r"^[a-z]{2}(?=[A-Z0-9])")
"""Country prefix of a sign code: ``de205``, ``usR1-1``."""
_MOST_BESIDE: Final = 100
"""Greatest number of lanelets along one way, or at one place."""
_SHORTEST: Final = 0.01
"""Least length of the line of a signal, because an upright signal is a point from above; m."""


class _Lanelet(NamedTuple):
    """Lanelet between two lines, both in its own direction, with their first and last nodes."""

    element: OsmElement
    left: Floats
    right: Floats
    left_turned: bool
    right_turned: bool
    starts: tuple[str, str]
    ends: tuple[str, str]


def lanelet2_text(text: str, projection: Projection | None = None) -> str:
    """Convert a Lanelet2 map to the text of plain lanes (:func:`sgstore.maps.roads.lane_text`).

    Parameters
    ----------
    text : str
        Text of an ``.osm`` file. It is untrusted: its length bounds time and memory.
    projection : Projection, optional
        Projection from latitude and longitude to metres, if some points lack ``local_x`` and
        ``local_y``. The default is UTM.

    Raises
    ------
    MapError
        The text is not XML or not a Lanelet2 map, exceeds a limit, or has no usable lanelet.
    """
    document = read_osm(text, projection or Projection())
    lanelets = _lanelets(document)
    if not lanelets:
        reason = "; ".join(document.warnings[:2]) or "it has none: expected a Lanelet2 map"
        raise MapError(f"OpenStreetMap data without usable lanelets: {reason}")
    rules = _Rules.of(document, lanelets)
    around = _around(document)
    lines = [
        replace(
            _line(
                document, ident, lanelet, _type(lanelet.element), rules.limits.get(ident, np.nan)
            ),
            roundabout=around.get(ident, ""),
        )
        for ident, lanelet in lanelets.items()
        if _type(lanelet.element) != CROSSWALK
    ]
    lines = _joined(document, _beside(document, lines, lanelets), lanelets)
    lanes, warnings = plain_lanes(with_junctions(lines))
    row_of = {lane.name: row for row, lane in enumerate(lanes)}
    signals = _signals(document, rules, lanes, row_of)
    crosswalks = [
        PlainCrosswalk(ident, np.concatenate((one.right, one.left[::-1]))[:, :2], _mean_z(one))
        for ident, one in lanelets.items()
        if _type(one.element) == CROSSWALK
    ]
    objects = _areas(document)
    return lane_text(lanes, [*document.warnings, *warnings], signals, crosswalks, objects)


_AREAS: Final = {"building": "building", "vegetation": "vegetation", "traffic_island": "prop"}
"""Subtype of an area without traffic → kind of an object."""


def _areas(document: OsmDocument) -> list[PlainObject]:
    """Return areas without traffic by their outer borders; other areas are counted in a warning."""
    found: list[PlainObject] = []
    left: Counter[str] = Counter()
    broken: list[str] = []
    for ident, element in document.relations.items():
        if element.tags.get("type") != "multipolygon":
            continue
        subtype = element.tags.get("subtype", "")
        if subtype not in _AREAS:
            left[subtype[:40] or "without a subtype"] += 1
            continue
        ring = _ring(document, element.members_of("outer"))
        if len(ident) > MAX_NAME or len(np.unique(ring[:, :2], axis=0)) < 3:
            broken.append(ident)
        else:
            z = float(ring[:, 2].mean())
            found.append(PlainObject(ident, ring[:, :2], z, _AREAS[subtype]))
    if left:
        told = ", ".join(f"{many} {what}" for what, many in sorted(left.items()))
        document.warnings.append(f"areas are left out: {told}")
    if broken:
        named = ", ".join(broken[:8]) + (f" and {len(broken) - 8} more" if broken[8:] else "")
        document.warnings.append(f"areas {named}: expected an outer border that closes; left out")
    return found


def _ring(document: OsmDocument, ways: Sequence[str]) -> Floats:
    """Return the corners (n, 3) around an area from its consecutive ways; empty for an open area."""
    pieces = [way for way in ways if way in document.lines]
    if not pieces or len(pieces) < len(ways):
        return np.zeros((0, 3))
    first = pieces.pop(0)
    nodes, line = [*document.nodes[first]], [*document.lines[first]]
    while pieces:
        ends = {way: (document.nodes[way][0], document.nodes[way][-1]) for way in pieces}
        found = next((way for way in pieces if nodes[-1] in ends[way]), "")
        if not found:
            return np.zeros((0, 3))
        pieces.remove(found)
        back = document.nodes[found][0] != nodes[-1]
        more, points = document.nodes[found], document.lines[found]
        nodes += (more[::-1] if back else more)[1:]
        line += [*(points[::-1] if back else points)[1:]]
    return np.array(line[:-1]) if nodes[0] == nodes[-1] else np.zeros((0, 3))


# Lanelets --------------------------------------------------------------------------------------------


def _lanelets(document: OsmDocument) -> dict[str, _Lanelet]:
    """Return lanelets by id; a lanelet without two borders is left out with a warning."""
    found: dict[str, _Lanelet] = {}
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
        found[ident] = _Lanelet(element, left, right, *turned, starts, ends)
    if broken:
        what = "expected one way to the left and one to the right, each with a length: left out"
        document.warnings.append(about_lanes(broken, what))
    return found


def _around(document: OsmDocument) -> dict[str, str]:
    """Map each lanelet of a roundabout to Autoware's regulatory element."""
    return {
        lanelet: ident[:MAX_NAME]
        for ident, element in document.relations.items()
        if element.tags.get("type") == "regulatory_element"
        and element.tags.get("subtype") == "roundabout"
        for lanelet in element.members_of("internal", "relation")
    }


def _turned(left: Floats, right: Floats) -> tuple[bool, bool]:
    """Return for each border True if it runs against the lanelet's direction."""
    along = np.hypot(*(left[[0, -1]] - right[[0, -1]])[:, :2].T).sum()
    across = np.hypot(*(left[[0, -1]] - right[[-1, 0]])[:, :2].T).sum()
    apart = bool(along > across)
    ring = np.concatenate((right[::-1] if apart else right, left[::-1]))[:, :2]
    (x, y), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
    clockwise = bool((x * y1 - x1 * y).sum() < 0)
    return clockwise, clockwise != apart


def _type(element: OsmElement) -> str:
    """Return the type of a lane by its subtype, or by its declared participants."""
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


def _line(
    document: OsmDocument, ident: str, lanelet: _Lanelet, kind: str, limit: float
) -> LaneLine:
    element = lanelet.element
    sections = sections_between(lanelet.left, lanelet.right)
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
    """Parse a speed to m/s (default unit km/h); NaN for an invalid speed."""
    found = _SPEED.fullmatch(text.strip())
    speed = float(found[1]) * _UNITS.get((found[2] or "").lower(), 1 / 3.6) if found else 0.0
    return speed if 0 < speed < 1000 else np.nan


def _beside(
    document: OsmDocument, lines: Sequence[LaneLine], lanelets: dict[str, _Lanelet]
) -> list[LaneLine]:
    """Add to each lane its neighbours with a common border."""
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


def _joined(
    document: OsmDocument, lines: Sequence[LaneLine], lanelets: dict[str, _Lanelet]
) -> list[LaneLine]:
    """Add to each lane its predecessors and successors: lanes with the same end points."""
    at: dict[tuple[str, str], list[Joint]] = defaultdict(list)
    for line in lines:
        lanelet = lanelets[line.ident]
        at[lanelet.starts].append(Joint(line.ident, START))
        at[_reversed(lanelet.ends)].append(Joint(line.ident, END))
    for gate, joints in at.items():
        if len(joints) > _MOST_BESIDE:
            what = f"more than {_MOST_BESIDE} lanelets meet between nodes {' and '.join(gate)}"
            document.warnings.append(f"{what}: none of them goes on there")
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


def _mean_z(lanelet: _Lanelet) -> float:
    return float(np.concatenate((lanelet.left[:, 2], lanelet.right[:, 2])).mean())


# Lights, signs and stop lines ------------------------------------------------------------------------


@dataclass(slots=True)
class _Rules:
    """Regulatory elements with their references, and their lanelets by id."""

    elements: list[tuple[OsmElement, list[str]]] = field(
        default_factory=list[tuple[OsmElement, list[str]]]
    )
    signs: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Way of a sign → lanelets that it applies to."""
    stop_lines: list[str] = field(default_factory=list[str])
    limits: dict[str, float] = field(default_factory=dict[str, float])
    """Lanelet → its speed limit from a regulatory element; m/s."""

    @classmethod
    def of(cls, document: OsmDocument, lanelets: dict[str, _Lanelet]) -> _Rules:
        """Collect the regulatory elements of a map."""
        users: dict[str, list[str]] = defaultdict(list)
        for ident, lanelet in lanelets.items():
            for element in lanelet.element.members_of("regulatory_element", "relation"):
                users[element].append(ident)
        rules = cls()
        for ident, element in document.relations.items():
            if element.tags.get("type") == "regulatory_element":
                rules.take(document, element, users.get(ident, []))
        painted = [way for way, tags in document.tags.items() if tags.get("type") == "stop_line"]
        rules.stop_lines = list(dict.fromkeys([*rules.stop_lines, *painted]))
        for way, tags in document.tags.items():
            if tags.get("type") == "traffic_sign":
                rules.signs.setdefault(way, [])
        return rules

    def take(self, document: OsmDocument, element: OsmElement, users: list[str]) -> None:
        """Add an element that these lanelets reference."""
        self.elements.append((element, users))
        refers = [way for way in element.members_of("refers") if way in document.lines]
        self.stop_lines += [way for way in element.members_of("ref_line") if way in document.lines]
        if element.tags.get("subtype") == "traffic_light":
            return
        yielding, first = (
            element.members_of(role, "relation") for role in ("yield", "right_of_way")
        )
        for way in refers:
            kind, code = _sign(document.tags[way], element)
            waits = kind in {"stop_sign", "yield_sign"} or not first
            lanes = (yielding if waits else first) or users
            self.signs.setdefault(way, []).extend(lanes)
            limit = speed_of(code.rpartition("-")[2]) if kind == "speed_limit" else np.nan
            self.limits |= {lane: limit for lane in users if np.isfinite(limit)}
        told = speed_of(element.tags.get("sign_type", ""))
        if element.tags.get("subtype") == "speed_limit" and np.isfinite(told):
            self.limits |= dict.fromkeys(users, told)


def _sign(tags: dict[str, str], element: OsmElement | None = None) -> tuple[str, str]:
    """Return the kind of a sign and its code, such as ``de274-60``."""
    code = tags.get("subtype", "")
    if element is not None and not code:
        code = element.tags.get("sign_type", "")
    number = _COUNTRY.sub("", code, count=1).replace("_", ".")
    for known in (number, number.rpartition("-")[0]):
        if (kind := kind_of_signal(known, dynamic=False)) != "sign":
            return kind, code
    return ("stop_sign" if code == "stop_sign" else "sign"), code


def _signals(
    document: OsmDocument, rules: _Rules, lanes: Sequence[PlainLane], row_of: dict[str, int]
) -> list[PlainSignal]:
    """Return lights by the ids of their elements, then signs and stop lines by their way ids."""

    def rows(lanelets: Iterable[str]) -> tuple[int, ...]:
        return tuple(sorted({row_of[one] for one in lanelets if one in row_of}))

    lying = painted_across(lanes, [document.lines[way] for way in rules.stop_lines])
    stops = dict(zip(rules.stop_lines, lying, strict=True))
    found: list[PlainSignal] = []
    for element, users in rules.elements:
        lights = [way for way in element.members_of("refers") if way in document.lines]
        if element.tags.get("subtype") != "traffic_light" or not lights:
            continue
        lit = rows(users)
        places = [
            (lane, along)
            for way in element.members_of("ref_line")
            for lane, along in stops.get(way, {}).items()
            if lane in lit
        ]
        one = _standing(element.ident, "traffic_light", document.lines[lights[0]])
        found.append(replace(one, lanes=lit, stops=tuple(sorted(places))))
    for way, users in rules.signs.items():
        kind, code = _sign(document.tags[way])
        limit = speed_of(code.rpartition("-")[2]) if kind == "speed_limit" else np.nan
        one = _standing(way, kind, document.lines[way])
        found.append(replace(one, lanes=rows(users), speed_limit=limit))
    for way, places in stops.items():
        one = _standing(way, "sign", document.lines[way])
        at = tuple(sorted(places.items()))
        found.append(replace(one, lanes=tuple(sorted(places)), stops=at, is_stop_line=True))
    return [one for one in found if len(one.name) <= MAX_NAME]


def _standing(name: str, kind: str, line: Floats) -> PlainSignal:
    """Return a signal with this line; a too short line is extended."""
    x, y, z = map(float, line.mean(axis=0))
    flat = line[:, :2]
    if run_of(line)[-1] < _SHORTEST:
        flat = np.array([[x - _SHORTEST / 2, y], [x + _SHORTEST / 2, y]])
    return PlainSignal(name, kind, x, y, z, line=flat)
