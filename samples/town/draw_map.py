"""Draw the little town that the sample recording takes place in, and write it as ``town.xodr``.

    Mill Lane ─────┬───── Park Lane ──zebra──┬───── Park Lane East
                   │ J2                   J3 │
              North Street             School Street
          (parked cars, 30 km/h)
                   │
    Main Street ═══╬═══ Main Street East
                   │ J1, with lights
              South Street

Main Street has two lanes each way, all others one. The map is ours from end to end; run this file to
write it again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from road_model import Arm, Lane, Mark, Piece, Road, Section, Thing, connect
from xodr import Controller, Junction, number, text

DRIVING = 3.5
VERGE = 2.2
SIDEWALK = 2.5
CROSSWALK = (3.0, 7.0)
"""From where to where a crosswalk lies, measured from the end of its road at the junction; m."""
STOP_LINE = 8.0
"""Where vehicles stop at a crosswalk, measured likewise; m."""
NO_PASSING = 36.0
"""Length of the solid line between the lanes of Main Street before the lights; m."""
PARKING = (30.0, 68.0)
"""Where North Street has parking bays on its right; m along the road."""
ZEBRA = (58.0, 62.0)
"""Where the crosswalk without lights lies on Park Lane; m along the road."""

DATE = "2026-01-01T00:00:00"
"""The date in the map's header: a constant, so that the map is the same whenever it is written."""

KERB = Mark("curb", width=0.15)
BROKEN = Mark("broken", "both")
SOLID = Mark("solid", "none")
DOUBLE = Mark("solid solid", "none")
BARE = Mark("none")

Arms = dict[str, Arm]


@dataclass(frozen=True)
class Town:
    """Everything that the map holds."""

    roads: dict[str, Road]
    junctions: tuple[Junction, ...]
    controllers: tuple[Controller, ...]

    @property
    def crosswalks(self) -> list[Thing]:
        """All crosswalks."""
        found = (o for r in self.roads.values() for o in r.objects)
        return [o for o in found if o.attributes["type"] == "crosswalk"]

    @property
    def signals(self) -> list[Thing]:
        """All signals: traffic lights and traffic signs."""
        return [s for r in self.roads.values() for s in r.signals]

    @property
    def lights(self) -> list[Thing]:
        """All traffic lights."""
        return [s for s in self.signals if s.attributes["type"] == "1000001"]

    @property
    def signs(self) -> list[Thing]:
        """All traffic signs."""
        return [s for s in self.signals if s.attributes["type"] != "1000001"]

    def road_named(self, name: str) -> Road:
        """The road of that name."""
        return next(r for r in self.roads.values() if r.name == name)


def street(
    length: float = 0.0,
    *,
    right: str = "none",
    s: float = 0.0,
    clear: tuple[bool, bool] = (False, False),
) -> Section:
    """One lane each way, a strip of grass or parking bays, and sidewalks.

    ``clear`` says whether the middle line stops short of a crosswalk at the section's start and end.
    """
    left = (
        Lane("driving", DRIVING, None, (KERB,)),
        Lane("none", VERGE, None, (KERB,)),
        Lane("sidewalk", SIDEWALK),
    )
    bay = replace(left[1], kind=right)
    beside_bays = Lane("driving", DRIVING, None, (Mark("solid", "decrease"),))
    edge = left[0] if right == "none" else beside_bays
    middle = (BARE, replace(BROKEN, s=STOP_LINE)) if clear[0] else (BROKEN,)
    middle = (*middle, replace(BARE, s=length - STOP_LINE)) if clear[1] else middle
    return Section(s, left, middle, (edge, bay, left[2]))


def avenue(length: float, *, lights_at_end: bool) -> Section:
    """Two lanes each way and sidewalks; lanes are not to be changed close to the lights."""

    def marked(*marks: Mark) -> tuple[Mark, ...]:
        """Marks in order from the lights, turned round if the lights are at the road's end."""
        ends = [*(m.s for m in marks[1:]), length]
        if not lights_at_end:
            return marks
        turned = [replace(m, s=length - end) for m, end in zip(marks, ends, strict=True)]
        return tuple(reversed(turned))

    outer = Lane("driving", DRIVING, None, (KERB,))
    walk = Lane("sidewalk", SIDEWALK)
    towards = Lane("driving", DRIVING, None, marked(
        BARE, replace(SOLID, s=STOP_LINE), replace(BROKEN, s=NO_PASSING)))  # fmt: skip
    away = Lane("driving", DRIVING, None, marked(BARE, replace(BROKEN, s=STOP_LINE)))
    middle = marked(BARE, replace(DOUBLE, s=STOP_LINE))
    left, right = (away, towards) if lights_at_end else (towards, away)
    return Section(0.0, (left, outer, walk), middle, (right, outer, walk))


def main_roads() -> dict[str, Road]:
    """The eight roads outside the junctions."""
    quarter = math.pi / 2
    west, east = (Piece(270.0),), (Piece(70.0), Piece(30.0, 0.0, 0.008), Piece(60.0, 0.008, 0.008))
    parked = (
        street(PARKING[0], clear=(True, False)),
        street(PARKING[1] - PARKING[0], right="parking", s=PARKING[0]),
        street(110.0 - PARKING[1], s=PARKING[1], clear=(False, True)),
    )
    curve = (Piece(20.0, 0.0, -0.015), Piece(50.0, -0.015, -0.015), Piece(20.0, -0.015, 0.0))
    bend = (Piece(30.0), *curve)
    roads = (
        Road("1", "Main Street", (-290.0, 0.0, 0.0), west, (avenue(270.0, lights_at_end=True),)),
        Road("2", "Main Street East", (20.0, 0.0, 0.0), east, (avenue(160.0, lights_at_end=False),)),
        Road("3", "North Street", (0.0, 20.0, quarter), (Piece(110.0),), parked, 30),
        Road("4", "South Street", (0.0, -20.0, -quarter), (Piece(90.0),), (street(90.0, clear=(True, False)),)),
        Road("5", "Park Lane", (16.0, 146.0, 0.0), (Piece(98.0),), (street(),)),
        Road("6", "Mill Lane", (-16.0, 146.0, math.pi), bend, (street(),)),
        Road("7", "Park Lane East", (146.0, 146.0, 0.0), (bend[0], *(
            replace(p, start=-p.start, end=-p.end) for p in curve)), (street(),)),
        Road("8", "School Street", (130.0, 130.0, -quarter), (Piece(80.0),), (street(),), 30),
    )  # fmt: skip
    ends = {"1": ("", "1"), "2": ("1", ""), "3": ("1", "2"), "4": ("1", ""), "5": ("2", "3"),
            "6": ("2", ""), "7": ("3", ""), "8": ("3", "")}  # fmt: skip
    for road in roads:
        before, after = ends[road.id]
        road.before = ("junction", before) if before else ()
        road.after = ("junction", after) if after else ()
    return {road.id: road for road in roads}


def crossing(arms: Arms) -> tuple[Road, ...]:
    """The connecting roads of the junction of Main Street, from the inner lane left, from the outer right."""
    n, e, s, w = (arms[k] for k in "nesw")
    plan = (
        (w, e, [(1, 1), (2, 2)], False), (w, n, [(1, 1)], False), (w, s, [(2, 1)], True),
        (e, w, [(1, 1), (2, 2)], False), (e, s, [(1, 1)], False), (e, n, [(2, 1)], True),
        (n, s, [(1, 1)], False), (n, e, [(1, 1)], False), (n, w, [(1, 2)], True),
        (s, n, [(1, 1)], False), (s, w, [(1, 1)], False), (s, e, [(1, 2)], True),
    )  # fmt: skip
    return tuple(
        connect(str(100 + i), "1", a, b, lanes, kerb=kerb)
        for i, (a, b, lanes, kerb) in enumerate(plan)
    )


def tee(first: int, junction: str, arms: Arms) -> tuple[Road, ...]:
    """The connecting roads of a T-junction whose stem points south."""
    e, s, w = (arms[k] for k in "esw")
    plan = ((w, e, False), (e, w, True), (s, e, True), (s, w, False), (w, s, True), (e, s, False))
    return tuple(
        connect(str(first + i), junction, a, b, [(1, 1)], kerb=kerb)
        for i, (a, b, kerb) in enumerate(plan)
    )


def through_first(roads: tuple[Road, ...]) -> tuple[tuple[str, str], ...]:
    """Which connecting road of a T-junction goes before which: the through traffic before all that meet it."""
    eastward, westward, right, left, _, across = (road.id for road in roads)
    return ((eastward, right), (eastward, left), (eastward, across), (westward, left))


def crosswalk(ident: str, road: Road, span: tuple[float, float], *, by_road: bool = False) -> None:
    """Lay a crosswalk from kerb to kerb, its outline in its own axes or in those of the road."""
    section, share = road.section_at(sum(span) / 2)
    walk = next(n for n in section.numbers if section.lane(n).kind == "sidewalk")
    half = road.borders(section, walk, share)[0]
    middle, depth = sum(span) / 2, span[1] - span[0]
    outline = (
        ((span[0], -half), (span[1], -half), (span[1], half), (span[0], half))
        if by_road
        else ((-depth / 2, -half), (depth / 2, -half), (depth / 2, half), (-depth / 2, half))
    )
    attributes = {
        "id": ident, "name": f"crosswalk of {road.name}", "type": "crosswalk", "subtype": "zebra",
        "dynamic": "no", "orientation": "none", "zOffset": "0", "hdg": "0", "pitch": "0", "roll": "0",
        "length": number(depth), "width": number(2 * half), "height": "0",
    }  # fmt: skip
    road.objects.append(Thing(road.id, middle, 0.0, attributes, outline, by_road=by_road))


def stop_line(ident: str, arm: Arm, distance: float) -> None:
    """Paint a stop line across the lanes into a junction."""
    lanes = [n for n, lane in enumerate(arm.side(incoming=True), 1) if lane.kind == "driving"]
    numbers = tuple(arm.number(n, incoming=True) for n in lanes)
    share = 1.0 if arm.at_end else 0.0
    t = [b for n in numbers for b in arm.road.borders(arm.section, n, share)]
    half = (max(t) - min(t)) / 2
    attributes = {
        "id": ident, "name": f"stop line of {arm.road.name}", "type": "roadMark", "subtype": "signalLines",
        "dynamic": "no", "orientation": "+" if arm.at_end else "-", "zOffset": "0", "hdg": "0",
        "pitch": "0", "roll": "0", "length": "0.4", "width": number(2 * half), "height": "0",
    }  # fmt: skip
    outline = ((-0.2, -half), (0.2, -half), (0.2, half), (-0.2, half))
    s = arm.s - distance if arm.at_end else arm.s + distance
    middle = (max(t) + min(t)) / 2
    arm.road.objects.append(Thing(arm.road.id, s, middle, attributes, outline, numbers))


def light(ident: str, arm: Arm, lane: int) -> None:
    """Hang a traffic light over the n-th lane into a junction, beyond its crosswalk."""
    n = arm.number(lane, incoming=True)
    t = sum(arm.road.borders(arm.section, n, 1.0 if arm.at_end else 0.0)) / 2
    attributes = {
        "id": ident, "name": f"light of {arm.road.name}, lane {lane}", "dynamic": "yes",
        "orientation": "+" if arm.at_end else "-", "zOffset": "4.5", "country": "OpenDRIVE",
        "type": "1000001", "subtype": "-1", "hOffset": "0", "pitch": "0", "roll": "0",
        "height": "0.9", "width": "0.4",
    }  # fmt: skip
    s = arm.s - 1.0 if arm.at_end else arm.s + 1.0
    arm.road.signals.append(Thing(arm.road.id, s, t, attributes, lanes=(n,)))


def sign(ident: str, road: Road, s: float, kind: str, *, forward: bool, value: int = -1) -> None:
    """Put up a German traffic sign at the right kerb, for traffic along the road or against it."""
    section, share = road.section_at(s)
    side = [n for n in section.numbers if (n < 0) == forward]
    driving = [n for n in side if section.lane(n).kind == "driving"]
    edge = max((road.borders(section, n, share)[1] for n in driving), key=abs)
    limit = {"value": str(value), "unit": "km/h"} if value >= 0 else {}
    attributes = {
        "id": ident, "name": SIGN_NAMES[kind], "dynamic": "no", "orientation": "+" if forward else "-",
        "zOffset": "2.1", "country": "DE", "countryRevision": "2017", "type": kind,
        "subtype": str(value) if value >= 0 else "-1", "hOffset": "0", "pitch": "0", "roll": "0",
        "height": "0.6", "width": "0.6", **limit,
    }  # fmt: skip
    t = edge + math.copysign(0.5, edge)
    road.signals.append(Thing(road.id, s, t, attributes, lanes=tuple(driving)))


SIGN_NAMES = {
    "205": "yield", "206": "stop", "274": "speed limit", "306": "priority road", "350": "pedestrian crossing",
}  # fmt: skip
"""Traffic signs of the German road traffic regulations (StVO)."""


def furnish(roads: dict[str, Road], arms: Arms) -> tuple[Controller, ...]:
    """Put crosswalks, stop lines, lights and signs on the roads."""
    ends = (("1", True), ("2", False), ("3", False), ("4", False), ("3", True))
    for i, (road, at_end) in enumerate(ends):
        length = roads[road].length
        span = (length - CROSSWALK[1], length - CROSSWALK[0]) if at_end else CROSSWALK
        crosswalk(str(501 + i), roads[road], span)
    crosswalk("506", roads["5"], ZEBRA, by_road=True)
    for i, key in enumerate("wens"):
        stop_line(str(521 + i), arms[key], STOP_LINE)
    stop_line("525", arms["school"], 1.5)
    for ident, key, lane in (("11", "w", 1), ("12", "w", 2), ("13", "e", 1), ("14", "e", 2),
                             ("15", "n", 1), ("16", "s", 1)):  # fmt: skip
        light(ident, arms[key], lane)
    north, park, mill = roads["3"], roads["5"], roads["6"]
    sign("31", north, north.length - 9.0, "205", forward=True)
    sign("32", roads["8"], 2.5, "206", forward=False)
    sign("33", roads["1"], 20.0, "274", forward=True, value=50)
    sign("34", north, 12.0, "274", forward=True, value=30)
    sign("35", park, 10.0, "274", forward=True, value=50)
    sign("36", mill, 12.0, "306", forward=False)
    sign("37", park, ZEBRA[0] - 1.0, "350", forward=True)
    sign("38", park, ZEBRA[1] + 1.0, "350", forward=False)
    return (
        Controller("1", "Main Street", ("11", "12", "13", "14")),
        Controller("2", "North and South Street", ("15", "16")),
    )


@cache
def town() -> Town:
    """The town."""
    roads = main_roads()
    ends = {
        "w": ("1", True), "e": ("2", False), "n": ("3", False), "s": ("4", False), "stem": ("3", True),
        "park": ("5", False), "mill": ("6", False), "parkend": ("5", True), "school": ("8", False),
        "far": ("7", False),
    }  # fmt: skip
    arms = {key: Arm(roads[road], at_end) for key, (road, at_end) in ends.items()}
    controllers = furnish(roads, arms)
    lights = crossing(arms)
    north = tee(200, "2", {"e": arms["park"], "s": arms["stem"], "w": arms["mill"]})
    school = tee(300, "3", {"e": arms["far"], "s": arms["school"], "w": arms["parkend"]})
    junctions = (
        Junction("1", "Main Street lights", lights, controllers=("1", "2")),
        Junction("2", "North Street tee", north, through_first(north)),
        Junction("3", "School Street tee", school, through_first(school)),
    )
    for junction in junctions:
        roads |= {road.id: road for road in junction.roads}
    return Town(roads, junctions, controllers)


def main() -> None:
    """Write ``town.xodr`` beside this file."""
    drawn = town()
    path = Path(__file__).with_name("town.xodr")
    roads = list(drawn.roads.values())
    path.write_text(text("Town", DATE, roads, drawn.junctions, drawn.controllers), encoding="utf-8")


if __name__ == "__main__":
    main()
