"""Traffic lights, signs and stop lines of a Lanelet2 map."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from sgstore.maps.lanelet2._document import OsmDocument, OsmElement
from sgstore.maps.lanelet2._lanelets import COUNTRY, SHORTEST, LaneletShape, speed_of
from sgstore.maps.opendrive import kind_of_signal
from sgstore.maps.roads import MAX_NAME, PlainLane, PlainSignal, run_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.model.world import Floats


@dataclass(slots=True)
class Rules:
    """Traffic rules (regulatory elements) of a Lanelet2 map, and the lanelets to which they apply."""

    elements: list[tuple[OsmElement, list[str]]] = field(
        default_factory=list[tuple[OsmElement, list[str]]]
    )
    signs: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Way of a sign → lanelets to which the sign applies."""
    stop_lines: list[str] = field(default_factory=list[str])
    limits: dict[str, float] = field(default_factory=dict[str, float])
    """Lanelet → its speed limit from a regulatory element; m/s."""

    @classmethod
    def of(cls, document: OsmDocument, lanelets: dict[str, LaneletShape]) -> Rules:
        """Collect the regulatory elements (traffic rules) of a Lanelet2 map."""
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
        """Add a traffic rule (regulatory element) and the lanelets that refer to it."""
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
    """Return the kind of a traffic sign, and its code such as ``de274-60``."""
    code = tags.get("subtype", "")
    if element is not None and not code:
        code = element.tags.get("sign_type", "")
    number = COUNTRY.sub("", code, count=1).replace("_", ".")
    for known in (number, number.rpartition("-")[0]):
        if (kind := kind_of_signal(known, dynamic=False)) != "sign":
            return kind, code
    return ("stop_sign" if code == "stop_sign" else "sign"), code


def plain_signals(
    document: OsmDocument, rules: Rules, lanes: Sequence[PlainLane], row_of: dict[str, int]
) -> list[PlainSignal]:
    """Return the traffic lights, signs and stop lines of a Lanelet2 map as signals of the lane text format."""

    def rows(lanelets: Iterable[str]) -> tuple[int, ...]:
        return tuple(sorted({row_of[one] for one in lanelets if one in row_of}))

    lying = PlainLane.painted_across(lanes, [document.lines[way] for way in rules.stop_lines])
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
    """Make a traffic light, sign or stop line from its line on the map. A very short line is extended."""
    x, y, z = map(float, line.mean(axis=0))
    flat = line[:, :2]
    if run_of(line)[-1] < SHORTEST:
        flat = np.array([[x - SHORTEST / 2, y], [x + SHORTEST / 2, y]])
    return PlainSignal(name, kind, x, y, z, line=flat)
