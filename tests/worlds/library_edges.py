"""Scenes at the edge of each rule of the library: one that barely breaks it, one that barely keeps it.

An edge changes one thing of a scene by a hair: 1 cm, 0.01 m/s, 0.2 s, which is a frame. Of the disturbances of
ISO 34502, which are found and not violated, the first is barely found and the second barely not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from library_scenes import (
    ABRUPT,
    APPROACH,
    ASTRIDE,
    AT_ONCE,
    AT_STOP,
    BEHIND_BLUE,
    BESIDE_BICYCLE,
    BOTH_CHANGE,
    BOTH_LEAVE,
    BROAD,
    CLOSE,
    FIRST_COME,
    FOLLOWING,
    IN_JUNCTION,
    JAM,
    JOINING,
    LEFT,
    LIMITED,
    MERGED_BEFORE,
    PASSING,
    PULLED_OUT,
    RED,
    REVEALED,
    RIGHT,
    RIGHTWARDS,
    SIREN,
    STOPPING,
    STOPS,
    STRAIGHT,
    SWERVED,
    TAIL,
    TOWN,
    TWO_WAY,
    WALKED_INTO,
    WAYS,
    WIDE,
    aside,
    braking,
    on,
)
from scenes import Scene, actor, along, ego, path, through

from sgstore.lang.library import patterns

if TYPE_CHECKING:
    from collections.abc import Callable

    from scenes import Point

RULES: Final = tuple(
    name
    for name, one in patterns().items()
    if one.kind == "property" or (one.library == "rules" and one.kind == "scenario")
)
"""All rules of the library, and the disturbances of ISO 34502."""


@dataclass(frozen=True)
class Edge:
    """Two scenes between which a rule changes its verdict.

    ``hair``: what the robustness of both is at most; of some rules none of the numbers that change decides.
    """

    breaks: Scene
    keeps: Scene
    hair: float | None = 0.02


def edge(make: Callable[[Any], Scene], breaks: Any, keeps: Any, hair: float | None = 0.02) -> Edge:
    """The scenes of two values."""
    return Edge(make(breaks), make(keeps), hair)


def change(scene: Scene, name: str, attribute: str) -> Callable[[Any], Scene]:
    """A scene with another value of an attribute of an actor."""
    return lambda value: scene.with_actor(name, **{attribute: value})


def lasting(scene: Scene) -> Callable[[float], Scene]:
    """A scene that is watched for so many seconds."""
    return lambda seconds: Scene(scene.road, *scene.actors, seconds=seconds, rate=scene.rate)


# Scenes as functions of what is changed ---------------------------------------------------------------------


def behind(speed: float) -> Callable[[float], Scene]:
    """The ego follows at a constant speed, at some distance of the centres."""
    return lambda distance: Scene(
        WAYS,
        ego(along(RIGHT), speed),
        actor("v", along(RIGHT), speed, start=distance),
        seconds=8,
    )


def intruder(shift: float) -> Scene:
    """A slow vehicle comes over, farther on; the ego runs into it."""
    way = path((shift, LEFT), (62 + shift, LEFT), (72 + shift, RIGHT), (600, RIGHT))
    v = actor("v", way, 5, start=60)
    return Scene(WAYS, ego(along(RIGHT), 15), v, seconds=7)


def comes_in_front(speed: float) -> Scene:
    """A vehicle comes over closely before the ego; it touches the ego's lane from 1.2 s on."""
    v = actor("v", aside(14, LEFT, RIGHT, 12), 8, start=6.5)
    return Scene(WAYS, ego(along(RIGHT), speed), v, seconds=8)


def draws_away(distance: float) -> Scene:
    """The ego follows too closely at 8 m/s, and the lead gains 1 m in a second."""
    v = actor("v", along(RIGHT), 9, start=distance)
    return Scene(WAYS, ego(along(RIGHT), 8), v, seconds=8)


def drawing_away(speed: Any) -> Scene:
    """A faster vehicle comes over 2 m before the ego."""
    over = aside(30, LEFT, RIGHT, 30)
    return Scene(WAYS, ego(along(RIGHT), 15), actor("v", over, speed, start=8), seconds=8)


def stands_ahead(x: float, speed: Any = None) -> Scene:
    """A vehicle stands in the ego's lane, and the ego brakes so that its front comes to x = 32.25."""
    return Scene(
        WAYS, ego(along(RIGHT), speed or braking(10, 2, 5)), actor("v", (x, RIGHT)), seconds=6
    )


def person_aside(distance: float) -> Scene:
    """The ego passes a person who stands."""
    p = actor("p", (30, RIGHT + distance), kind="person", heading=90.0)
    return Scene(TOWN, ego(along(RIGHT), 7), p, seconds=6)


def brakes_with(decel: float) -> Scene:
    """The ego brakes by 6 m/s², and who drives far ahead by another value."""
    v = actor("v", along(RIGHT), braking(15, 2, decel), start=45)
    return Scene(WAYS, ego(along(RIGHT), braking(15, 2, 6)), v, seconds=6)


def jam_at(speed: float, own: float = 0.0, y: float = RIGHT) -> Scene:
    """Three vehicles ahead of the ego, the farthest at some speed."""
    ahead = (actor(f"v{i}", along(y), 2.5, start=10 + 10 * i) for i in range(2))
    return Scene(
        WAYS, ego(along(y), own), *ahead, actor("v2", along(y), speed, start=30), seconds=2
    )


def in_jam(y: float, road: Any, lane: float) -> Scene:
    """The ego at some place across the road, behind three that are slow in the middle of its lane."""
    ahead = (actor(f"v{i}", along(lane), 2, start=15 + 10 * i) for i in range(3))
    return Scene(road, ego(along(y), 2), *ahead, seconds=2)


def beside(speed: float, others: float = 15.0, count: int = 1) -> Scene:
    """The ego is to the right of others, the first of which is beside it."""
    left = (actor(f"v{i}", along(RIGHT), others, start=2 + 8 * i) for i in range(count))
    return Scene(WAYS, ego(along(LEFT), speed), *left, seconds=0.6)


def stands_for(seconds: float) -> Scene:
    """The ego stands at the stop line for a while."""
    speed = [(0, 8), (3, 8), (5, 0), (5 + seconds, 0), (7 + seconds, 8)]
    return Scene(STOPS, ego(through("s", "n"), speed, start=92), seconds=11)


def waits_second(until: float) -> Scene:
    """Who comes second waits at the junction until some time."""
    first, second = FIRST_COME.actors
    speed = [(0, 4), (4.1, 4), (4.9, 0), (until, 0), (until + 1, 4)]
    return Scene(STOPS, first, replace(second, speed=speed), seconds=14)


def waits_left(until: float) -> Scene:
    """Of two that come at once, the left one waits in the mouth of the junction until some time."""
    left, right = AT_ONCE.actors
    speed = [(0, 4), (2, 4), (2.8, 0), (until, 0), (until + 1, 4)]
    return Scene(STOPS, replace(left, speed=speed), right, seconds=14)


def turns_right_into(share: float) -> Scene:
    """The ego turns right between the left lane (0) and the right one (1) of the road that it comes to."""
    ways = zip(through("s", "e", 2, out=1), through("s", "e", 2, out=2), strict=True)
    way = tuple((a + (c - a) * share, b + (d - b) * share) for (a, b), (c, d) in ways)
    return Scene(WIDE, ego(way, 6, start=115), seconds=8)


def comes_over(shift: float) -> Scene:
    """A vehicle comes over into the ego's lane at the ego's speed, farther on."""
    way = path((shift, LEFT), (30 + shift, LEFT), (55 + shift, RIGHT), (600, RIGHT))
    return Scene(WAYS, ego(along(RIGHT), 8), actor("v", way, 8, start=20), seconds=8)


def leaves_before(x: float) -> Scene:
    """The lead leaves the lane, and who is before it is slower."""
    v = actor("v", aside(40, RIGHT, LEFT, 15), 8, start=12)
    o = actor("o", along(RIGHT), 6, start=x)
    return Scene(WAYS, ego(along(RIGHT), 8), v, o, seconds=6)


def comes_from_behind(speed: float) -> Scene:
    """A vehicle behind the ego accelerates to some speed."""
    v = actor("v", along(RIGHT), [(0, 10), (1, 10), (4, speed)], start=10)
    return Scene(WAYS, ego(along(RIGHT), 10, start=60), v, seconds=4)


def pulled_out_before(speed: float) -> Scene:
    """The ego changes to before a vehicle that accelerates to some speed."""
    return PULLED_OUT.with_actor("v", speed=[(0, 10), (4, speed)])


def lead_brakes(decel: float) -> Scene:
    v = actor("v", along(RIGHT), braking(10, 2, decel), start=40)
    return Scene(WAYS, ego(along(RIGHT), 10), v, seconds=5)


def comes_to(speed: Any) -> Scene:
    """The ego comes to a vehicle that stands, or soon does."""
    v = actor("v", along(RIGHT), speed, start=49)
    return Scene(WAYS, ego(along(RIGHT), 10), v, seconds=5.5)


def at_stop(speed: float) -> Scene:
    """The ego is as slow as that once, at the stop sign."""
    return AT_STOP.with_actor("ego", speed=[(0, 8), (3, 8), (5, speed), (6, speed), (8, 8)])


def across(scene: Scene, name: str = "ego") -> Callable[[float], Scene]:
    """A scene with an actor at another place across the road."""

    def placed(y: float) -> Scene:
        route: tuple[Point, ...] = along(y)
        return scene.with_actor(name, route=route)

    return placed


def both_at(scene: Scene, *names: str) -> Callable[[float], Scene]:
    """A scene in which several have one speed."""

    def driven(speed: float) -> Scene:
        found = scene
        for name in names:
            found = found.with_actor(name, speed=speed)
        return found

    return driven


def slow_to(speed: float) -> Scene:
    return STOPPING.with_actor("ego", speed=[(0, 8), (3, speed)])


def alone(speed: float, road: Any = WAYS, **other: Any) -> Scene:
    return Scene(road, ego(along(RIGHT), speed, **other), seconds=2)


def backwards(speed: float) -> Scene:
    return Scene(WAYS, ego(along(RIGHT, 100, 0), speed, heading=0.0), seconds=2)


def slow_ahead(speed: float) -> Scene:
    v = actor("v", along(RIGHT), speed, start=20)
    return Scene(WAYS, ego(along(RIGHT), 12), v, seconds=2)


# The table --------------------------------------------------------------------------------------------------

STREET: Final = on(STRAIGHT, TWO_WAY)

EDGES: Final[dict[str, tuple[Edge, ...]]] = {
    # 8 + 1.75 + 11.5²/8 - 8²/16 = 22.28 m, and a length of 4.5 m
    "rss_distance": (edge(change(FOLLOWING, "v", "start"), 26.78, 26.79),),
    # The table of the regulation at 60, 36, 8.64, 7.2 and 3.6 km/h: 26.5, 13.6, 2.52, 2 and 2 m
    "r157_following": (
        edge(behind(16.6), 31.01, 31.03),
        edge(behind(10), 18.09, 18.11),
        edge(behind(2.4), 7.01, 7.03),
        edge(behind(2), 6.49, 6.51),
        edge(behind(1), 6.49, 6.51),
        edge(draws_away, 9.79, 9.81),  # 8 · 1.288 = 10.30 m after 5 s
    ),
    # 10 · (10/12 + 0.35) = 11.83 m when it comes in: nearer it may be hit. One that draws away may not.
    "r157_cut_in": (
        edge(intruder, -37.42, -37.43),
        edge(drawing_away, [(0, 25), (1.4, 25), (3.4, 0)], 25.0, None),
    ),
    # It just touches, or not; it comes to light 21.09 m ahead, or nearer.
    "r157_cut_out": (
        edge(lambda x: REVEALED.with_actor("o", route=((x, RIGHT),)), 114.49, 114.51),
        edge(lambda x: REVEALED.with_actor("o", route=((x, RIGHT),)), 95.59, 95.58),
    ),
    "r157_pedestrian": (
        edge(person_aside, 1.19, 1.21),
        edge(both_at(WALKED_INTO.with_actor("ego", speed=8.0), "p"), 1.38, 1.40, None),
    ),
    # Their boxes meet where they are 0 m apart: 0.9 m and half of the width of the person
    "no_collision": (edge(person_aside, 1.19, 1.21, None),),
    "r157_emergency_braking": (
        edge(lambda decel: ABRUPT.with_actor("ego", speed=braking(15, 2, decel)), 5.01, 4.99),
        edge(lambda x: stands_ahead(x, braking(15, 2, 6)), 54.27, 54.26, None),
    ),
    # 8 · (0.4 + 8/6) + 10 = 23.87 m
    "r157_lane_change": (edge(change(MERGED_BEFORE, "v", "start"), -7.11, -7.12),),
    "r157_braking_lead": (
        edge(stands_ahead, 34.49, 34.51),
        edge(lasting(comes_in_front(9)), 4.2, 4.0, None),
    ),
    # 2.4 + 3.2 - 3.05 = 2.55 m
    "r_g1_safe_distance": (
        edge(change(FOLLOWING, "v", "start"), 7.05, 7.06),
        edge(lasting(comes_in_front(8)), 4.4, 4.2, None),
    ),
    "r_g2_abrupt_braking": (
        edge(lambda decel: ABRUPT.with_actor("ego", speed=braking(15, 2, decel)), 2.01, 1.99),
        edge(brakes_with, 3.99, 4.01, None),
    ),
    "r_g3_speed_limit": (
        edge(lambda speed: alone(speed, LIMITED), 13.91, 13.89),
        edge(alone, 43.01, 42.99),
        edge(lambda speed: alone(speed, kind="truck"), 22.23, 22.21),
    ),
    "r_g4_traffic_flow": (edge(alone, 21.10, 21.12), edge(slow_ahead, 21.12, 21.10, None)),
    "r_i1_stopping": (edge(alone, 0.09, 0.11), edge(jam_at, 2.79, 2.77, None)),
    "r_i2_passing_on_the_right": (
        edge(beside, 15.01, 14.99),
        edge(lambda speed: beside(speed, 5.0, 4), 10.56, 10.54),
    ),
    "r_i3_turning_back": (
        edge(backwards, 0.11, 0.09),
        edge(lambda heading: alone(0.3, heading=heading), 90.01, 89.99),
    ),
    # Lanes of 3.5 m: 7 m in all are not broad, 10.5 m are.
    "r_i4_emergency_lane": (
        edge(lambda y: in_jam(y, BROAD, RIGHT), -1.16, -1.14),
        edge(lambda y: in_jam(y, BROAD, -8.75), -9.34, -9.36),
        edge(lambda y: in_jam(y, WAYS, LEFT), -5.84, -5.86),
        edge(change(JAM, "v2", "speed"), 8.32, 8.34, None),
        edge(lambda road: in_jam(-1.1, road, RIGHT), WAYS, BROAD, None),
    ),
    "r_i5_merging": (
        edge(change(JOINING, "v", "start"), -0.97, -0.99),
        edge(
            lambda y: JOINING.with_actor("ego", route=aside(30, RIGHT, y, 30)), -2.50, -2.48, None
        ),
    ),
    "r_in1_stop_sign": (edge(stands_for, 2.8, 3.0, 0.21),),
    # The ego is in the junction from 3.4 s on.
    "r_in2_red_light": (
        edge(lambda t: RED.with_actor("light-s", shows=[(0, "red"), (t, "green")]), 3.3, 3.1),
    ),
    "iso_cut_in": (edge(comes_over, 7.15, 7.18),),
    "iso_cut_out": (edge(leaves_before, 39.32, 39.34),),
    "iso_rear_accelerates": (edge(comes_from_behind, 13.63, 13.62),),
    "iso_lead_brakes": (
        edge(lead_brakes, 1.345, 1.330),
        edge(comes_to, braking(10, 1, 6), 0.0, None),  # it stands before that is dangerous
    ),
    "iso_change_cut_in": (edge(change(BOTH_CHANGE, "v", "start"), 30.73, 30.75),),
    "iso_change_cut_out": (edge(change(BOTH_LEAVE, "v", "start"), 23.09, 23.11),),
    "iso_change_rear_accelerates": (edge(pulled_out_before, 11.72, 11.70),),
    "iso_change_lead_brakes": (edge(change(SWERVED, "v", "start"), 29.25, 29.27),),
    # SGSM
    "phi1": (edge(across(STREET), -0.945, -0.955),),
    "phi1_as_coded": (edge(across(STREET), -0.945, -0.955),),
    "phi2": (edge(across(STRAIGHT), -7.96, -7.94),),
    "phi2_as_coded": (edge(across(STRAIGHT), -7.96, -7.94),),
    "phi3": (edge(change(RIGHTWARDS, "ego", "steer"), -0.01, 0.0),),
    "phi3_as_coded": (edge(change(RIGHTWARDS, "ego", "steer"), 0.0, 0.01),),
    "phi4": (edge(both_at(CLOSE, "ego", "b"), 5.01, 4.99),),
    "phi4_as_coded": (edge(both_at(CLOSE, "ego", "b"), 15.01, 14.99),),
    "phi5": (edge(change(APPROACH, "ego", "throttle"), 0.051, 0.049),),
    "phi5_as_coded": (edge(change(APPROACH, "ego", "throttle"), 0.051, 0.049),),
    "phi6": (edge(slow_to, 0.09, 0.11),),
    "phi6_as_coded": (edge(slow_to, 0.0, 0.01),),
    "phi7": (edge(lasting(ASTRIDE), 5.0, 4.8, 0.21),),
    "phi7_as_coded": (edge(lasting(ASTRIDE), 1.8, 1.6, 1),),
    # It is in the junction alone from 2.6 s on.
    "phi8": (edge(lasting(IN_JUNCTION), 7.6, 7.4, 0.21),),
    "phi8_as_coded": (edge(lasting(IN_JUNCTION), 4.4, 4.2, 1),),
    "phi9": (edge(at_stop, 0.11, 0.09),),
    "phi9_as_coded": (edge(at_stop, 0.01, 0.0),),
    # SceneFlow
    "yield_821": (edge(waits_second, 7.40, 7.45),),
    "yield_right_820": (edge(waits_left, 7.80, 7.85, None),),
    "yield_emergency_829": (
        edge(
            lambda x: SIREN.with_actor("ego", route=aside(x, RIGHT, LEFT, 15)), 65.98, 65.96, None
        ),
    ),
    "turn_lanes_846": (edge(turns_right_into, 0.42, 0.43),),
    # From side to side 0.90 m and 0.92 m
    "bicycle_839": (edge(across(BESIDE_BICYCLE), -0.95, -0.93),),
    "pass_843": (
        edge(lambda x: PASSING.with_actor("w", route=along(1.75, x, -200)), 203.59, 203.60, None),
    ),
    "follow_emergency_921": (edge(change(BEHIND_BLUE, "u", "start"), 24.99, 25.01, None),),
    "tailgating_816": (edge(change(TAIL, "v", "start"), 6.99, 7.01, None),),
}

# Rules about contact: scenes in which the ego runs into the other ever deeper --------------------------------

COLLISIONS: Final[dict[str, tuple[Scene, ...]]] = {
    "r157_cut_in": tuple(
        drawing_away([(0, 25), (1.4, 25), (3, 8), (t, 8), (t + 0.4, 15), (9, 15)])
        for t in (5.64, 5.68, 5.74)
    ),
    "r157_cut_out": tuple(
        REVEALED.with_actor("o", route=((x, RIGHT),)) for x in (114.3, 114, 113.5)
    ),
    "r157_pedestrian": tuple(person_aside(y) for y in (1.1, 0.9, 0.6)),
    "r157_braking_lead": tuple(stands_ahead(x) for x in (34.4, 34, 33.5)),
}
