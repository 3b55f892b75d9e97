"""A roundabout with two arms, drawn in OpenDRIVE, as a network of SUMO and as a Lanelet2 map of Autoware.

Traffic runs round the middle, 22 m away from it, against the clock; arms lead to the south and to the north.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np
from lanelet2_maps import LaneletMap
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    element,
    lane,
    line,
    link,
    param_poly3,
    section,
    width,
)

from sgstore.maps.opendrive import read_map

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap

Point = tuple[float, float]

INNER: Final = 20.0
"""Radius of the inner border; m."""
MIDDLE: Final = 22.0
"""Radius of the middle of the lane around; m."""
OPEN: Final = 25.0
"""How far to both sides of an arm its junction reaches; degrees."""
FAR, MOUTH = 120.0, 40.0
"""Distances from the middle at which arms begin and end; m."""


def at(radius: float, degrees: float) -> Point:
    angle = np.radians(degrees)
    return float(radius * np.cos(angle)), float(radius * np.sin(angle))


def cubic_between(
    one: tuple[Point, float], other: tuple[Point, float]
) -> tuple[np.ndarray, np.ndarray]:
    """The cubic from a place and a direction (degrees) to others: coefficients of x and y."""
    (p0, h0), (p1, h1) = one, other
    far = np.hypot(*np.subtract(p1, p0))
    t0, t1 = (far * np.array(at(1.0, h)) for h in (h0, h1))
    a, b = np.array(p0), t0
    way = np.subtract(p1, p0)
    c, d = 3 * way - 2 * t0 - t1, t0 + t1 - 2 * way
    return np.array([a[0], b[0], c[0], d[0]]), np.array([a[1], b[1], c[1], d[1]])


ENTRY: Final = cubic_between(((2.0, -MOUTH), 90.0), (at(MIDDLE, -90 + OPEN), OPEN))
LEAVE: Final = cubic_between((at(MIDDLE, 90 - OPEN), 180 - OPEN), ((2.0, MOUTH), 90.0))
"""The middle of the ways in and out, as they are driven."""


def points_of(x: np.ndarray, y: np.ndarray, count: int) -> np.ndarray:
    p = np.vander(np.linspace(0, 1, count), 4, increasing=True)
    return np.column_stack([p @ x, p @ y])


def _way(one: tuple[Point, float], other: tuple[Point, float]) -> str:
    """A road's line from one place to another."""
    x, y = cubic_between(one, other)
    fine = points_of(x, y, 20_001)
    length = float(np.hypot(*np.diff(fine, axis=0).T).sum())
    x[0] = y[0] = 0.0
    return param_poly3(length, tuple(x.tolist()), tuple(y.tolist()), x=one[0][0], y=one[0][1])


@cache
def roundabout(kind: str = "roundabout") -> RoadMap:
    """As OpenDRIVE has it: two junctions, in a group of that type."""
    return read_map(opendrive(kind), "roundabout")


def opendrive(kind: str = "roundabout") -> str:
    parts: list[str] = []
    turn = np.radians(2 * (90 - OPEN))
    for number, (mine, next_one, south) in enumerate(
        (("91", "92", -90.0), ("92", "91", 90.0)), start=1
    ):
        begin = south + OPEN
        links = link("predecessor", "junction", mine) + link("successor", "junction", next_one)
        x, y = at(INNER, begin)
        circle = arc(INNER * turn, 1 / INNER, x=x, y=y, hdg=np.radians(begin + 90))
        parts.append(
            a_road(
                str(number), circle, sections=section(lane(0), lane(-1, width(4.0))), links=links
            )
        )
        before = str(3 - number)  # the other half of the circle leads here
        x, y = at(FAR, south)
        arm = line(FAR - MOUTH, x=x, y=y, hdg=np.radians(south + 180))
        both = section(lane(1, width(4.0)), lane(0), lane(-1, width(4.0)))
        arm_name = str(number + 2)
        parts.append(
            a_road(arm_name, arm, sections=both, links=link("successor", "junction", mine))
        )
        x, y = at(INNER, south - OPEN)
        past = arc(
            INNER * np.radians(2 * OPEN), 1 / INNER, x=x, y=y, hdg=np.radians(south - OPEN + 90)
        )
        around, into, out = (f"{number}{i}" for i in range(3))
        ways = {
            around: (past, before, "end", str(number), "start"),
            into: (
                _way((at(MOUTH, south), south + 180), (at(INNER, begin), begin + 90)),
                *(arm_name, "end", str(number), "start"),
            ),
            out: (
                _way((at(INNER, south - OPEN), south - OPEN + 90), (at(MOUTH, south), south)),
                *(before, "end", arm_name, "end"),
            ),
        }
        connections: list[str] = []
        for name, (plan, source, left, target, reached) in ways.items():
            to = 1 if name == out else -1
            own = section(lane(0), lane(-1, width(4.0), before=-1, after=to))
            links = link("predecessor", "road", source, left) + link(
                "successor", "road", target, reached
            )
            parts.append(a_road(name, plan, sections=own, links=links, junction=mine))
            lane_link = element("laneLink", **{"from": -1, "to": -1})
            more = {
                "id": name,
                "incomingRoad": source,
                "connectingRoad": name,
                "contactPoint": "start",
            }
            connections.append(element("connection", lane_link, **more))
        parts.append(element("junction", *connections, id=mine, name=mine))
    members = (element("junctionReference", junction=name) for name in ("91", "92"))
    return a_map(*parts, element("junctionGroup", *members, id="7", name="ring", type=kind))


def line_around(begin: float, end: float, radius: float = MIDDLE, count: int = 25) -> list[Point]:
    return [at(radius, degrees) for degrees in np.linspace(begin, end, count)]


def driven(turns: float = 0.0) -> tuple[Point, ...]:
    """From the arm in the south to that in the north, after so many times round, in the middle of the lanes."""
    round_about = line_around(-90 + OPEN, 90 - OPEN + 360 * turns, count=25 + round(50 * turns))
    ways = [map(tuple, points_of(*one, 12).tolist()) for one in (ENTRY, LEAVE)]
    return ((2.0, -FAR), *ways[0], *round_about[1:-1], *ways[1], (2.0, FAR))


def circling(begin: float, turns: float) -> tuple[Point, ...]:
    """Round the middle, from an angle (degrees) on."""
    return tuple(line_around(begin, begin + 360 * turns, count=2 + round(60 * turns)))


def sumo_net(more: str = "") -> str:
    """The same for SUMO: junctions S and N, the circle's edges ``east`` and ``west``, and arms."""
    ways = {
        "east": ("S", "N", line_around(-90 + OPEN, 90 - OPEN)),
        "west": ("N", "S", line_around(90 + OPEN, 270 - OPEN)),
        "in": ("far", "S", [(2.0, -FAR), (2.0, -MOUTH)]),
        "out": ("N", "beyond", [(2.0, MOUTH), (2.0, FAR)]),
    }
    entry, leave = (points_of(*one, 9).tolist() for one in (ENTRY, LEAVE))
    inner = {
        ":S_0": ("west", "east", line_around(-90 - OPEN, -90 + OPEN)),
        ":S_1": ("in", "east", entry),
        ":N_0": ("east", "west", line_around(90 - OPEN, 90 + OPEN)),
        ":N_1": ("east", "out", leave),
    }
    text = '<net version="1.20">\n  <location netOffset="0,0" convBoundary="0,0,1,1"/>\n'
    for name, (source, target, points) in ways.items():
        text += edge(name, points, f'from="{source}" to="{target}"')
    for name, (_, _, points) in inner.items():
        text += edge(name, points, 'function="internal"')
    for name in "SN":
        text += f'<junction id="{name}" type="priority" x="0" y="0"/>\n'
    for via, (source, target, _) in inner.items():
        for one, more_of in ((source, f'via="{via}_0"'), (via, "")):
            text += f'<connection from="{one}" to="{target}" fromLane="0" toLane="0" {more_of}/>\n'
    return f"{text}{more}</net>\n"


def edge(name: str, points: list[Point], about: str) -> str:
    shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    lane = f'<lane id="{name}_0" index="0" speed="8" shape="{shape}"/>'
    return f'<edge id="{name}" {about}>{lane}</edge>\n'


def lanelets(subtype: str = "roundabout") -> tuple[str, set[str]]:
    """The same for Autoware, and its two lanelets around."""
    made = LaneletMap()
    inside = []
    for begin in (-90.0, 90.0):
        sides = (made.way(line_around(begin, begin + 180, radius)) for radius in (INNER, 24.0))
        inside.append(made.lanelet(*sides))
    entry = made.lanelet(
        made.way([(0.0, -FAR), at(INNER, -90)]), made.way([(4.0, -FAR), at(24.0, -90)])
    )
    members = [("relation", int(one), "internal") for one in inside]
    made.element(subtype, *members, ("relation", int(entry), "entry"))
    return made.text(), set(inside)
