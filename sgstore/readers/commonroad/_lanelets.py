"""Conversion of the lanelets, signs and lights of a CommonRoad scenario into a road map.

A lanelet is a lane. Its borders have the same number of points, which are its cross sections. Adjacent lanelets
form one road. Lanelets of an intersection belong to that junction. A traffic sign applies to the lanelets that
refer to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.roads import (
    MAX_POINTS,
    Border,
    Joint,
    LaneLine,
    PlainCrosswalk,
    PlainLane,
    PlainSignal,
    Sections,
    about_lanes,
    lane_text,
    plain_lanes,
    run_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.model.world import Floats
    from sgstore.readers.commonroad._document import (
        Lanelet,
        Place,
        ScenarioLight,
        ScenarioSign,
        TrafficScenario,
    )

_TYPES: Final = {
    "busLane": "bus",
    "bicycleLane": "biking",
    "sidewalk": "sidewalk",
    "exitRamp": "offRamp",
    "accessRamp": "onRamp",
    "shoulder": "shoulder",
    "parking": "parking",
    "border": "border",
    "restricted": "restricted",
    "busStop": "stop",
}
"""Name in ``laneletType`` → OpenDRIVE lane type. Other names mean ``driving``."""

_CROSSWALK: Final = "crosswalk"
_ON_FOOT: Final = {"pedestrian"}
_CYCLING: Final = {"bicycle", *_ON_FOOT}
_CROSSED: Final = {
    **dict.fromkeys(("dashed", "broad_dashed", "no_marking"), True),
    **dict.fromkeys(("solid", "broad_solid", "curb", "lowered_curb"), False),
}
"""Marking of a lane border → True if vehicles may cross it."""

_BROAD: Final = {"broad_dashed", "broad_solid"}

_MPH: Final = 0.44704
_KMH: Final = 1 / 3.6
_ZONE: Final = "274.1"
_CODES: Final = {
    # Code of a sign → kind. Each country has its own codes, which never conflict.
    # Source: CommonRoad: XML format documentation, and commonroad-io 2024.3, traffic_sign.
    **dict.fromkeys(("206", "R1-1", "r2"), "stop_sign"),
    **dict.fromkeys(("205", "R1-2", "r1"), "yield_sign"),
    **dict.fromkeys(("274", _ZONE, "R2-1", "R15", "r301"), "speed_limit"),
    **dict.fromkeys(
        ("B14", "B31", "C43", "3.24", "\N{GREEK CAPITAL LETTER RHO}-32"), "speed_limit"
    ),
}


@dataclass(frozen=True, slots=True)
class SignMeaning:
    """Meaning of a traffic sign: its kind, a short text, and the limit of a speed limit sign (m/s)."""

    kind: str
    subkind: str
    limit: float = math.nan


def meaning_of(sign: ScenarioSign) -> SignMeaning:
    """Return the meaning of a traffic sign: that of its first known plate, or else a text with its codes."""
    for code, value in sign.plates:
        kind = _CODES.get(code)
        if kind == "speed_limit" and 0 < value < 200:
            miles = code.startswith("R2")
            number = value / (_MPH if miles else _KMH)
            zone = "zone " if code == _ZONE else ""
            return SignMeaning(kind, f"{zone}{number:.0f}{' mph' if miles else ''}", value)
        if kind is not None and kind != "speed_limit":
            return SignMeaning(kind, "")
    return SignMeaning("sign", "+".join(code for code, _ in sign.plates)[:100])


def light_place(scenario: TrafficScenario, light: ScenarioLight) -> Place | None:
    """Return the position of a traffic light. By default, it is the right end of its first lanelet."""
    if light.place is not None:
        return light.place
    lanes = (one for one in scenario.lanelets.values() if light.ident in one.lights)
    return next((lane.right[-1] for lane in lanes), None)


def map_text(scenario: TrafficScenario) -> str:
    """Convert the lanelets of a scenario to a road map, and return its text; empty without lanelets.

    Raises
    ------
    MapError
        There are too many lanelets or points.
    """
    uneven: list[str] = []
    short: list[str] = []
    points = 0
    lines: list[LaneLine] = []
    crosswalks: list[PlainCrosswalk] = []
    for lanelet in scenario.lanelets.values():
        points += len(lanelet.left) + len(lanelet.right)
        if points > MAX_POINTS:
            short.append(lanelet.ident)
            continue
        left, right = np.array(lanelet.left), np.array(lanelet.right)
        if len(left) != len(right):
            uneven.append(lanelet.ident)
            left, right = _evened(left, right)
        if run_of((left + right) / 2)[-1] < 1e-3:
            short.append(lanelet.ident)
            continue
        if _CROSSWALK in lanelet.types:
            outline, z = np.concatenate((right, left[::-1])), np.concatenate((right, left))[:, 2]
            crosswalks.append(PlainCrosswalk(lanelet.ident, outline[:, :2], float(z.mean())))
            continue
        lines.append(_line(scenario, lanelet, left, right))
    plain, warnings = plain_lanes(lines)
    if not plain:
        return ""
    notes = [
        about_lanes(which, what)
        for which, what in (
            (uneven, "its borders have different numbers of points: cut at even shares"),
            (short, "left out: without a length, or too many points"),
        )
        if which
    ]
    notes += _contradictions(scenario)
    signals = [*_signals(scenario, plain, notes)]
    return lane_text(plain, [*notes, *warnings], signals, crosswalks)


def _contradictions(scenario: TrafficScenario) -> Iterator[str]:
    """Yield warnings about references to missing parts, and neighbours with a wrong direction."""
    used: set[str] = set()
    for lanelet in scenario.lanelets.values():
        used |= {*lanelet.lights}
        absent = [f"traffic sign {one}" for one in lanelet.signs if one not in scenario.signs]
        absent += [f"traffic light {one}" for one in lanelet.lights if one not in scenario.lights]
        yield from (f"lane {lanelet.ident}: its {what} is missing" for what in absent)
        yield from _turned_neighbours(scenario, lanelet)
        if lanelet.speed_limit <= 0:
            yield f"lane {lanelet.ident}: its speed limit is {lanelet.speed_limit:g} m/s: left out"
    yield from (
        f"traffic light {name}: no lane refers to it"
        for name in scenario.lights
        if name not in used
    )
    refs = [*scenario.incoming, *((place, name) for name, place in scenario.junction_of.items())]
    for intersection, name in dict.fromkeys(refs):
        if name not in scenario.lanelets:
            yield f"intersection {intersection}: its lane {name} is missing"


def _turned_neighbours(scenario: TrafficScenario, lanelet: Lanelet) -> Iterator[str]:
    for name, declared in zip(lanelet.beside, lanelet.directions, strict=True):
        other = scenario.lanelets.get(name)
        if other is not None and declared in {"same", "opposite"}:
            same = float(_way(lanelet) @ _way(other)) > 0
            if same != (declared == "same"):
                what = f"its neighbour {name} does not run in the {declared} direction"
                yield f"lane {lanelet.ident}: {what}, as declared"


def _way(lanelet: Lanelet) -> Floats:
    """Return the vector from the start to the end of a lanelet."""
    end, start = (np.add(lanelet.left[at], lanelet.right[at]) for at in (-1, 0))
    return end - start


def _evened(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return both borders of a lanelet with points at equal distances, and equally many of them."""
    count = max(len(left), len(right))
    shares = np.linspace(0.0, 1.0, count)

    def cut(line: Floats) -> Floats:
        run = run_of(line)
        return np.column_stack([np.interp(shares * run[-1], run, column) for column in line.T])

    return cut(left), cut(right)


def _line(scenario: TrafficScenario, lanelet: Lanelet, left: Floats, right: Floats) -> LaneLine:
    kind = _lane_type(lanelet)
    crossed = [_CROSSED.get(marking) for marking in lanelet.markings]
    broad = [marking in _BROAD for marking in lanelet.markings]
    junction = scenario.junction_of.get(lanelet.ident, "")
    unnamed = not junction and "intersection" in lanelet.types
    return LaneLine(
        lanelet.ident,
        kind,
        (left + right) / 2,
        both=bool({"vehicle", "car"} & {*lanelet.both_ways}),
        lefts=(Border(left, crossed[0], crossed[0], broad=broad[0]),),
        rights=(Border(right, crossed[1], crossed[1], broad=broad[1]),),
        sections=Sections(left[:, :2], right[:, :2], (left[:, 2] + right[:, 2]) / 2),
        before=tuple(Joint(name, Joint.END) for name in lanelet.before),
        after=tuple(Joint(name, Joint.START) for name in lanelet.after),
        left_beside=(lanelet.beside[0],) if lanelet.beside[0] else (),
        right_beside=(lanelet.beside[1],) if lanelet.beside[1] else (),
        junction=None if unnamed else junction,
        speed_limit=_limit(scenario, lanelet),
    )


def _lane_type(lanelet: Lanelet) -> str:
    """Return the lane type of a lanelet, from its own types or else from its permitted users."""
    for word in lanelet.types:
        if word in _TYPES:
            return _TYPES[word]
    users = {*lanelet.one_way, *lanelet.both_ways}
    if users and users <= _ON_FOOT:
        return "sidewalk"
    return "biking" if users and users <= _CYCLING else "driving"


def _limit(scenario: TrafficScenario, lanelet: Lanelet) -> float:
    """Return the lowest speed limit of a lanelet; m/s. NaN without a limit."""
    signs = (scenario.signs[name] for name in lanelet.signs if name in scenario.signs)
    limits = [lanelet.speed_limit, *(meaning_of(sign).limit for sign in signs)]
    return min((one for one in limits if 0 < one < 1000), default=math.nan)


def _signals(
    scenario: TrafficScenario, lanes: Sequence[PlainLane], notes: list[str]
) -> Iterator[PlainSignal]:
    """Yield the signs and lights to which lanes refer, and the stop lines."""
    row_of = {lane.name: row for row, lane in enumerate(lanes)}
    stops = _stops(scenario, lanes, row_of, notes)
    users: dict[str, list[int]] = {}
    for lanelet in scenario.lanelets.values():
        if lanelet.ident in row_of:
            for name in (*lanelet.signs, *lanelet.lights):
                users.setdefault(name, []).append(row_of[lanelet.ident])
    for sign in scenario.signs.values():
        rows = tuple(sorted({*users.get(sign.ident, ())}))
        if rows:
            told = meaning_of(sign)
            limit = told.limit if told.kind == "speed_limit" else math.nan
            pose = _pose(sign.place)
            yield PlainSignal(sign.ident, told.kind, *pose, lanes=rows, speed_limit=limit)
    for light in scenario.lights.values():
        rows = tuple(sorted({*users.get(light.ident, ())}))
        if rows:
            at = tuple((row, stops[row]) for row in rows if row in stops)
            pose = _pose(light_place(scenario, light))
            yield PlainSignal(light.ident, "traffic_light", *pose, lanes=rows, stops=at)
    for row, along in stops.items():
        name = f"stop line of {lanes[row].name}"
        yield PlainSignal(name, "sign", lanes=(row,), stops=((row, along),), is_stop_line=True)


def _stops(
    scenario: TrafficScenario,
    lanes: Sequence[PlainLane],
    row_of: dict[str, int],
    notes: list[str],
) -> dict[int, float]:
    """Return the position of the stop line along each lane that has one; m. Warn if it is not on its lane."""
    found: dict[int, float] = {}
    told: dict[int, Floats] = {}
    for lanelet in scenario.lanelets.values():
        if lanelet.stop_line is None or lanelet.ident not in row_of:
            continue
        row = row_of[lanelet.ident]
        found[row] = float(run_of((lanes[row].left + lanes[row].right) / 2)[-1])
        if len(lanelet.stop_line) > 1:
            told[row] = np.array(lanelet.stop_line)
    for row, places in zip(told, PlainLane.painted_across(lanes, [*told.values()]), strict=True):
        if row not in places:
            notes.append(f"lane {lanes[row].name}: its stop line is not on it; its end counts")
        found[row] = places.get(row, found[row])
    return found


def _pose(place: Place | None) -> Place:
    return place or (math.nan, math.nan, math.nan)
