"""A scene for each pattern of the library that it holds in, and for many of them one that it does not.

Of a property, the first is a scene that violates it and the second one that keeps it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from scenes import (
    BEFORE,
    Scene,
    actor,
    along,
    cone,
    crossroads,
    ego,
    light,
    over,
    path,
    street,
    through,
)

from sgstore.lang.library import patterns

WAYS: Final = street("driving", "driving")
"""Two lanes of one direction: y = -1.75 and -5.25."""
TWO_WAY: Final = street("driving", left=("driving",))
"""A lane for each direction: y = -1.75 and 1.75."""
ENTRY: Final = street("driving", "driving", "entry")
EXIT: Final = street("driving", "driving", "exit")
TOWN: Final = street("driving", "parking", "sidewalk", left=("driving", "sidewalk"), zebra=60.0)
"""Lanes at y = -1.75 and 1.75, parking at -4.75, sidewalks at -7 and 4.5, a crosswalk at x = 60."""
PLAIN: Final = crossroads()
LIGHTS: Final = crossroads("light")
STOPS: Final = crossroads("stop")
WIDE: Final = crossroads(lanes=2)
LIMITED: Final = street("driving", "driving", limit=13.9)
BROAD: Final = street("driving", "driving", "driving")
ROADS: Final = (WAYS, TWO_WAY, ENTRY, EXIT, TOWN, PLAIN, LIGHTS, STOPS, WIDE, LIMITED, BROAD)

RIGHT, LEFT = -1.75, -5.25
MOUTH_OF: Final = {"s": (5.0, -12.5), "n": (-5.0, 12.5), "w": (-12.5, -5.0), "e": (12.5, 5.0)}
OFF: Final[tuple[str, ...]] = ()
SPECIAL: Final = {"special": "emergency", "lights": ("light_special1",)}


def lamp(arm: str, *shows: tuple[float, str]):
    return light(f"light-{arm}", MOUTH_OF[arm], *shows)


def aside(x: float, y: float, to: float, by: float = 25.0):
    """Along a street from x = 0, and over to another lane from some x on."""
    return path((0, y), (x, y), (x + by, to), (400, to))


def past(y: float, by: float, out: float, back: float):
    """Along a street, aside from one x on and back from another."""
    return path((0, y), (out, y), (out + 15, by), (back, by), (back + 20, y), (400, y))


def braking(speed: float, since: float, decel: float):
    return [(0, speed), (since, speed), (since + speed / decel, 0)]


# Scenes that several patterns are about ---------------------------------------------------------------------

CUT_IN = Scene(
    WAYS,
    ego(along(RIGHT), 15),
    actor("v", aside(40, LEFT, RIGHT), 15, start=12),
    drawn=(0.0, 4.0),
)
CUT_OUT = Scene(
    WAYS,
    ego(along(RIGHT), 15),
    actor("v", aside(70, RIGHT, LEFT, 15), 15, start=15),
    actor("o", (97, RIGHT)),
    seconds=5.5,
    drawn=(3.2, 5.0),
)
HARD = Scene(
    WAYS,
    ego(along(RIGHT), braking(15, 2.5, 6)),
    actor("v", along(RIGHT), braking(15, 2, 6), start=25),
    seconds=6,
    drawn=(0.0, 5.0),
)
GENTLE = Scene(
    WAYS,
    ego(along(RIGHT), braking(15, 2.5, 2)),
    actor("v", along(RIGHT), braking(15, 2, 2), start=25),
    seconds=10,
)
WALKER = Scene(
    TOWN, ego(along(RIGHT), 4), actor("p", over(40, -8, 6), 1.5, "person"), drawn=(0.0, 4.0)
)
ON_ZEBRA = WALKER.with_actor("p", route=over(60, -8, 6))
HIDDEN = Scene(
    TOWN,
    ego(along(RIGHT), 6),
    actor("o", (30, -4.75), heading=0.0),
    actor("p", over(32.8, -5.6, 4), [(0, 0), (2, 0), (2.3, 1.6)], "person", heading=90.0),
    seconds=5,
    drawn=(0.0, 3.6),
)
TURN_LEFT = Scene(
    LIGHTS,
    ego(through("s", "w"), 6, start=105),
    actor("v", through("n", "s"), 8, start=85),
    lamp("s", (0, "green")),
    lamp("n", (0, "green")),
    drawn=(0.0, 5.0),
)
TURN_RIGHT = Scene(
    LIGHTS,
    ego(through("s", "e"), 5, start=112),
    actor("v", through("w", "e"), 8, start=80),
    lamp("s", (0, "green")),
    drawn=(0.0, 4.0),
)
PHASES = Scene(
    LIGHTS,
    ego(through("s", "n"), braking(8, 1, 2), start=100),
    lamp("s", (0, "green"), (2, "yellow"), (4, "red")),
    seconds=9,
    drawn=(8.0,),
)
RED = Scene(
    LIGHTS,
    ego(through("s", "n"), 8, start=100),
    lamp("s", (0, "red")),
    seconds=6,
    drawn=(2.0, 4.5),
)
CROSSING = Scene(
    PLAIN,
    ego(through("s", "n"), 6, start=110),
    actor("v", through("w", "e"), 6, start=109),
    drawn=(0.0, 3.5),
)
IN_JUNCTION = Scene(
    PLAIN, ego(through("s", "n"), [(0, 8), (3, 8), (4.5, 0)], start=110), seconds=12, drawn=(12.0,)
)
OVERTAKING = Scene(
    TWO_WAY,
    ego(past(RIGHT, 1.75, 20, 105), 12),
    actor("v", along(RIGHT), 5, start=30),
    seconds=13,
    drawn=(0.0, 6.0, 12.0),
)
BESIDE_BICYCLE = Scene(
    TWO_WAY,
    ego(along(-1.55), 10),
    actor("b", along(-3.1), 4, "bicycle", start=22),
    drawn=(0.0, 3.6, 7.0),
)
NEAR = Scene(
    WAYS,
    ego(along(RIGHT), braking(12, 3.6, 9)),
    actor("v", (58.5, RIGHT)),
    seconds=6,
    drawn=(3.6, 6.0),
)
RUN_OVER = Scene(
    WAYS, ego(along(RIGHT), braking(12, 4, 9)), actor("v", (55, RIGHT)), seconds=6, drawn=(5.0,)
)
THROUGH_STOP = Scene(STOPS, ego(through("s", "n"), 8, start=92), seconds=8, drawn=(2.0, 6.0))
AT_STOP = THROUGH_STOP.with_actor("ego", speed=[(0, 8), (3, 8), (5, 0), (6, 0), (8, 8)])
STANDING = Scene(
    WAYS, ego(along(RIGHT), 8, start=20), actor("o", (60, RIGHT)), seconds=4, drawn=(2.0,)
)
FLOW = Scene(
    PLAIN,
    ego(through("s", "e"), 6, start=118),
    actor("v1", through("w", "e"), 10, start=155),
    actor("v2", through("w", "e"), 10, start=143),
    drawn=(1.5, 5.0),
)
OUT_OF_BAY = Scene(
    TOWN,
    ego(along(RIGHT), 6),
    actor(
        "v",
        path((40, -4.75), (46, -4.2), (56, -1.75), (400, -1.75)),
        [(0, 0), (2, 0), (4, 6)],
        heading=None,
    ),
    seconds=7,
    drawn=(0.0, 6.0),
)
TAILED = Scene(
    WAYS,
    ego(along(RIGHT), 12, start=20),
    actor("t", along(RIGHT), 12, "truck", start=8),
    drawn=(0.0,),
)
AFTER_TURN = Scene(
    PLAIN,
    ego(through("s", "e"), 5, start=112),
    actor("b", over(24, -14, 8), 2, "bicycle"),
    drawn=(0.0, 6.0),
)
BICYCLES = Scene(
    WAYS,
    ego(along(RIGHT), 5),
    actor("b1", along(-3.0), 3, "bicycle", start=25),
    actor("b2", along(-3.0), 3, "bicycle", start=32),
    seconds=5,
    drawn=(0.0,),
)
BLUE = Scene(
    TWO_WAY,
    ego(along(RIGHT), 8, start=40),
    actor("v", along(RIGHT), 13, **SPECIAL),
    seconds=6,
    drawn=(0.0,),
)


def on(scene: Scene, road) -> Scene:
    """The same actors elsewhere."""
    return Scene(road, *scene.actors, seconds=scene.seconds, rate=scene.rate, drawn=scene.drawn)


def cones(road) -> Scene:
    return Scene(
        road,
        ego(along(RIGHT), 8, start=20),
        *(cone(f"c{i}", (50 + 4 * i, RIGHT)) for i in range(3)),
        cone("w", (46, RIGHT), "traffic_warning"),
        seconds=3,
        drawn=(0.0,),
    )


def accident(road) -> Scene:
    return Scene(
        road,
        ego(along(RIGHT), 8, start=25),
        actor("p", (60, RIGHT), special="emergency", lights=("light_special1",)),
        actor("a", (68, RIGHT)),
        seconds=3,
        drawn=(0.0,),
    )


def flow_of(road, speed: float, y: float, to: float) -> Scene:
    """The ego comes from a slip road, beside others in a lane."""
    return Scene(
        road,
        ego(aside(60, y, to, 30), 15),
        actor("v1", along(to), speed, start=10),
        actor("v2", along(to), speed, start=30),
        drawn=(0.0, 7.0),
    )


# Concepts ---------------------------------------------------------------------------------------------------

SCENES: dict[str, tuple[Scene, Scene | None]] = {
    "cut_in": (CUT_IN, CUT_IN.with_actor("v", route=along(LEFT))),
    "cut_out": (
        CUT_OUT,
        CUT_OUT.with_actor("o", route=((0, RIGHT), (400, RIGHT)), speed=15.0, start=45.0),
    ),
    "hard_braking": (HARD, GENTLE),
    "lead_hard_braking": (HARD, GENTLE),
    "jaywalking": (WALKER, ON_ZEBRA),
    "crossing_pedestrian": (WALKER, WALKER.with_actor("p", route=((10, -7.0), (60, -7.0)))),
    "unprotected_left_turn": (
        TURN_LEFT,
        TURN_LEFT.with_actor("v", speed=0.0, start=BEFORE - 4).with_actor(
            "light-n", shows=[(0, "red")]
        ),
    ),
    "following_too_close": (
        HARD.with_actor("v", speed=15.0, start=12.0).with_actor("ego", speed=15.0),
        HARD.with_actor("v", speed=15.0, start=40.0).with_actor("ego", speed=15.0),
    ),
    "low_ttc": (
        Scene(WAYS, ego(along(RIGHT), 15), actor("v", (60, RIGHT)), seconds=3.4, drawn=(3.0,)),
        Scene(TWO_WAY, ego(along(RIGHT), 15), actor("v", along(1.75, 100, -100), 15), seconds=6),
    ),
    "red_phase": (PHASES, PHASES.with_actor("light-s", shows=[(0, "green"), (2, "yellow")])),
    "waiting_at_red": (PHASES, PHASES.with_actor("light-s", shows=[(0, "green")])),
    "red_light_running": (
        PHASES.with_actor("ego", speed=8.0).with_actor(
            "light-s", shows=[(0, "yellow"), (2, "red")]
        ),
        RED.with_actor("light-s", shows=[(0, "green")]),
    ),
    "oncoming_in_lane": (
        Scene(
            TWO_WAY,
            ego(along(RIGHT), 8),
            actor("v", along(RIGHT, 80, -100), 6),
            seconds=5,
            drawn=(2.0,),
        ),
        Scene(TWO_WAY, ego(along(RIGHT), 8), actor("v", along(1.75, 80, -100), 6), seconds=5),
    ),
    "occlusion": (HIDDEN, HIDDEN.without("o")),
    "emergency_vehicle_near": (BLUE, BLUE.with_actor("v", lights=OFF)),
    "stopped_in_junction": (IN_JUNCTION, IN_JUNCTION.with_actor("ego", speed=6.0)),
    "close_pass_of_bicycle": (
        BESIDE_BICYCLE,
        BESIDE_BICYCLE.with_actor("ego", route=((0, 0.2), (400, 0.2))),
    ),
    "overtaking_in_oncoming_lane": (
        OVERTAKING,
        on(OVERTAKING.with_actor("ego", route=past(RIGHT, LEFT, 20, 105)), WAYS),
    ),
    "near_miss": (NEAR, NEAR.with_actor("ego", speed=12.0)),
    "collision": (RUN_OVER, NEAR),
    "lane_change_without_indicator": (
        Scene(WAYS, ego(aside(40, RIGHT, LEFT), 12, lights=OFF), drawn=(0.0, 5.0)),
        Scene(WAYS, ego(aside(40, RIGHT, LEFT), 12, lights=("light_right",))),
    ),
    "tailgated_by_truck": (TAILED, TAILED.with_actor("ego", start=60.0)),
    "merge_conflict": (
        Scene(
            PLAIN,
            ego(through("s", "w"), 6, start=BEFORE - 5),
            actor("v", through("n", "w"), 6, start=BEFORE - 10.5),
            seconds=6,
            drawn=(0.0, 3.0),
        ),
        Scene(
            PLAIN,
            ego(through("s", "w"), 6, start=BEFORE - 5),
            actor("v", through("n", "w"), 0, start=BEFORE - 10.5),
            seconds=6,
        ),
    ),
    "parked_row": (
        Scene(
            TOWN,
            ego(along(-1.95), 8),
            *(actor(f"v{i}", (20 + 7 * i, -4.75)) for i in range(4)),
            seconds=5,
            drawn=(3.0,),
        ),
        Scene(
            TOWN,
            ego(along(-1.3), 8),
            *(actor(f"v{i}", (20 + 7 * i, -4.75)) for i in range(4)),
            seconds=5,
        ),
    ),
    "stop_sign_ignored": (THROUGH_STOP, AT_STOP),
}

# Scenarios of CARLA -----------------------------------------------------------------------------------------

SCENES |= {
    name: (scene, None)
    for name, scene in {
        "Accident": accident(WAYS),
        "AccidentTwoWays": accident(TWO_WAY),
        "BlockedIntersection": Scene(
            PLAIN,
            ego(through("s", "e"), [(0, 6), (3, 6), (6, 1)], start=115),
            actor("o", (22, RIGHT)),
            seconds=6,
            drawn=(0.0, 5.0),
        ),
        "ConstructionObstacle": cones(WAYS),
        "ConstructionObstacleTwoWays": cones(TWO_WAY),
        "ControlLoss": Scene(
            WAYS, ego(along(RIGHT), 10, yaw_rate=25.0, steer=0.0), seconds=2, drawn=(0.0,)
        ),
        "CrossingBicycleFlow": Scene(
            PLAIN,
            ego(through("s", "n"), 4, start=122),
            actor("b1", through("w", "e"), 4, "bicycle", start=127),
            actor("b2", through("w", "e"), 4, "bicycle", start=131),
            drawn=(1.5,),
        ),
        "DynamicObjectCrossing": HIDDEN,
        "EnterActorFlow": FLOW,
        "EnterActorFlowV2": flow_of(ENTRY, 15, -8.75, -5.25),
        "HardBreakRoute": HARD,
        "HazardAtSideLane": BICYCLES,
        "HazardAtSideLaneTwoWays": on(BICYCLES, TWO_WAY),
        "HighwayCutIn": Scene(
            ENTRY,
            ego(along(LEFT), 20),
            actor("v", aside(70, -8.75, LEFT, 30), 20, start=25),
            drawn=(0.0, 5.0),
        ),
        "HighwayExit": Scene(
            EXIT,
            ego(
                path((0, RIGHT), (40, RIGHT), (65, LEFT), (90, LEFT), (115, -8.75), (400, -8.75)),
                15,
            ),
            actor("v", along(LEFT), 10, start=12),
            seconds=10,
            drawn=(0.0, 4.5, 9.0),
        ),
        "InterurbanActorFlow": Scene(
            PLAIN,
            ego(through("s", "w"), 5, start=115),
            actor("v1", through("n", "s"), 10, start=75),
            actor("v2", through("n", "s"), 10, start=92),
            drawn=(3.5,),
        ),
        "InterurbanAdvancedActorFlow": Scene(
            PLAIN,
            ego(through("s", "w"), 5, start=120),
            actor("v1", through("w", "e"), 10, start=105),
            actor("v2", through("e", "w"), 10, start=105),
            drawn=(1.5, 5.0),
        ),
        "InvadingTurn": Scene(
            TWO_WAY,
            ego(along(RIGHT), 8),
            actor("v", along(0.6, 60, -100), 6),
            seconds=4,
            drawn=(2.0,),
        ),
        "MergerIntoSlowTraffic": Scene(
            PLAIN,
            ego(through("s", "e"), 6, start=118),
            actor("v1", through("w", "e"), 3, start=166),
            actor("v2", through("w", "e"), 3, start=158),
            drawn=(1.5,),
        ),
        "MergerIntoSlowTrafficV2": flow_of(ENTRY, 4, -8.75, LEFT),
        "NonSignalizedJunctionLeftTurn": on(TURN_LEFT.without("light-s", "light-n"), PLAIN),
        "NonSignalizedJunctionRightTurn": on(TURN_RIGHT.without("light-s"), PLAIN),
        "SignalizedJunctionLeftTurn": TURN_LEFT,
        "SignalizedJunctionRightTurn": TURN_RIGHT,
        "OppositeVehicleRunningRedLight": Scene(
            LIGHTS,
            *CROSSING.actors,
            lamp("w", (0, "red")),
            lamp("s", (0, "green")),
            drawn=(0.0, 3.5),
        ),
        "OppositeVehicleTakingPriority": CROSSING,
        "ParkedObstacle": STANDING,
        "ParkedObstacleTwoWays": on(STANDING, TWO_WAY),
        "ParkingCrossingPedestrian": HIDDEN,
        "ParkingCutIn": OUT_OF_BAY,
        "StaticCutIn": Scene(
            WAYS,
            ego(along(RIGHT), 8),
            actor(
                "v",
                path((40, LEFT), (45, LEFT), (58, RIGHT), (400, RIGHT)),
                [(0, 0), (1, 0), (3, 6)],
            ),
            seconds=6,
            drawn=(0.0, 5.0),
        ),
        "ParkingExit": Scene(
            TOWN,
            ego(path((40, -4.75), (46, -4.2), (56, RIGHT), (400, RIGHT)), [(0, 0), (2, 0), (4, 6)]),
            seconds=7,
            drawn=(0.0, 6.0),
        ),
        "PedestrianCrossing": Scene(
            TOWN,
            ego(along(RIGHT), 4, start=25),
            actor("p1", over(59.5, -8, 6), 1.5, "person"),
            actor("p2", over(60.5, 6, -8), 1.5, "person"),
            seconds=6,
            drawn=(4.0,),
        ),
        "PriorityAtJunction": Scene(
            LIGHTS,
            ego(through("s", "n"), 8, start=105),
            lamp("s", (0, "green")),
            lamp("w", (0, "red")),
            actor("v", through("w", "e"), 0, start=BEFORE - 4),
            seconds=6,
            drawn=(0.0, 4.0),
        ),
        "VehicleOpensDoorTwoWays": Scene(
            TOWN, ego(along(-1.95), 8), actor("v", (30, -4.75)), seconds=3, drawn=(1.0,)
        ),
        "VehicleTurningRoute": AFTER_TURN,
        "VehicleTurningRoutePedestrian": AFTER_TURN.with_actor("b", kind="person"),
        "YieldToEmergencyVehicle": BLUE,
        "CutIn": CUT_IN,
        "ChangeLane": Scene(
            WAYS,
            ego(aside(25, RIGHT, LEFT), 12),
            actor("v", along(RIGHT), 5, start=30),
            seconds=6,
            drawn=(0.0, 5.0),
        ),
        "FollowLeadingVehicle": Scene(
            WAYS,
            ego(along(RIGHT), braking(8, 6.5, 3)),
            actor("v", along(RIGHT), braking(8, 6, 4), start=20),
            seconds=10,
            drawn=(0.0, 9.0),
        ),
        "FollowLeadingVehicleWithObstacle": Scene(
            WAYS,
            ego(along(RIGHT), 5),
            actor("v", along(RIGHT), 5, start=15),
            cone("o", (45, RIGHT)),
            seconds=4,
            drawn=(2.5,),
        ),
        "ManeuverOppositeDirection": Scene(
            TWO_WAY,
            ego(past(RIGHT, 1.75, 35, 75), 10),
            actor("o", (60, RIGHT)),
            seconds=10,
            drawn=(2.5, 6.0),
        ),
        "NoSignalJunctionCrossing": CROSSING,
        "OtherLeadingVehicle": Scene(
            WAYS, *HARD.actors, actor("u", along(LEFT), 14, start=3), seconds=4, drawn=(2.5,)
        ),
        "StationaryObjectCrossing": Scene(
            WAYS,
            ego(along(RIGHT), 5, start=15),
            actor("b", (45, RIGHT), kind="bicycle", heading=90.0),
            seconds=3,
        ),
        "VehicleTurningRight": AFTER_TURN,
        "VehicleTurningLeft": Scene(
            PLAIN,
            ego(through("s", "w"), 5, start=112),
            actor("b", over(-26, 14, -8), 2, "bicycle"),
            drawn=(0.0, 7.0),
        ),
    }.items()
}

# Scenarios of nuPlan ----------------------------------------------------------------------------------------

QUEUE = Scene(
    WAYS,
    ego(along(RIGHT), start=20),
    actor("v1", along(RIGHT), start=27),
    actor("v2", along(RIGHT), start=13),
    actor("v3", along(LEFT), start=19),
    seconds=4,
)
AT_ZEBRA = Scene(
    TOWN,
    ego(along(RIGHT), [(0, 0), (5, 0), (6, 5)], start=54),
    actor("p", over(60, -4, 6), 1.4, "person"),
    drawn=(2.0, 7.5),
)
CREEPING = Scene(WAYS, ego(along(RIGHT), 0.8), seconds=4)
BEHIND_TRUCK = Scene(
    WAYS, ego(along(RIGHT), 8), actor("v", along(RIGHT), 8, "truck", start=14), seconds=4
)

SCENES |= {
    "starting_left_turn": (TURN_LEFT, TURN_RIGHT),
    "starting_right_turn": (TURN_RIGHT, TURN_LEFT),
    "starting_straight_traffic_light_intersection_traversal": (
        SCENES["PriorityAtJunction"][0],
        TURN_LEFT,
    ),
    "stopping_with_lead": (SCENES["FollowLeadingVehicle"][0], CREEPING),
    "high_lateral_acceleration": (TURN_RIGHT, CREEPING),
    "high_magnitude_speed": (CUT_IN, CREEPING),
    "low_magnitude_speed": (CREEPING, CUT_IN),
    "waiting_for_pedestrian_to_cross": (AT_ZEBRA, AT_ZEBRA.without("p")),
    "behind_long_vehicle": (BEHIND_TRUCK, BEHIND_TRUCK.with_actor("v", kind="car")),
    "stationary_in_traffic": (QUEUE, QUEUE.without("v3")),
    "near_multiple_vehicles": (
        Scene(WAYS, *(replace(a, speed=8.0) for a in QUEUE.actors), seconds=3),
        QUEUE,
    ),
    "changing_lane": (SCENES["lane_change_without_indicator"][0], CREEPING),
    "following_lane_with_lead": (BEHIND_TRUCK, BEHIND_TRUCK.with_actor("v", start=40.0)),
}

# Rules of SGSM and SceneFlow: violated, kept ----------------------------------------------------------------

CLOSE = Scene(
    WAYS, ego(along(RIGHT), 18), actor("b", along(RIGHT), 18, "motorcycle", start=3.6), seconds=4
)
APPROACH = Scene(
    WAYS,
    ego(along(RIGHT), 3, throttle=0.5),
    actor("b", (10, RIGHT), kind="bicycle"),
    seconds=2.2,
    drawn=(2.0,),
)
STOPPING = Scene(WAYS, ego(along(RIGHT), braking(8, 1, 4)), seconds=5, drawn=(5.0,))
STRAIGHT = Scene(WAYS, ego(along(RIGHT), 10), seconds=9)
ASTRIDE = STRAIGHT.with_actor("ego", route=along(-3.5))
RIGHTWARDS = on(STRAIGHT.with_actor("ego", steer=-0.2), TWO_WAY)
ACROSS = Scene(TWO_WAY, ego(past(RIGHT, 1.75, 35, 75), 10), seconds=9, drawn=(5.0,))
OFF_ROAD = STRAIGHT.with_actor("ego", route=path((0, RIGHT), (30, RIGHT), (60, -12), (400, -12)))

RULES = {
    "phi1": (ACROSS, on(STRAIGHT, TWO_WAY)),
    "phi2": (OFF_ROAD, STRAIGHT),
    "phi3": (RIGHTWARDS, RIGHTWARDS.with_actor("ego", steer=0.1)),
    "phi4": (CLOSE, CLOSE.with_actor("ego", speed=4.0).with_actor("b", speed=4.0)),
    "phi5": (APPROACH, APPROACH.with_actor("ego", throttle=0.0)),
    "phi6": (STOPPING, STRAIGHT),
    "phi7": (ASTRIDE, STRAIGHT),
    "phi8": (IN_JUNCTION, STRAIGHT),
    "phi9": (THROUGH_STOP, AT_STOP),
}
SCENES |= RULES
SCENES |= {f"{name}_as_coded": scenes for name, scenes in RULES.items()}

FIRST_COME = Scene(
    STOPS,
    ego(through("s", "n"), 4, start=118),
    actor("v", through("w", "e"), 4, start=108),
    seconds=11,
    drawn=(1.0, 6.0),
)
AT_ONCE = Scene(
    STOPS,
    ego(through("s", "n"), 4, start=118),
    actor("v", through("e", "w"), 4, start=118),
    seconds=11,
    drawn=(1.0, 4.0),
)
WAITING = [(0, 4), (2, 4), (2.8, 0), (10.5, 0), (11, 1)]
SIREN = Scene(
    WAYS,
    ego(along(RIGHT), 8, start=40),
    actor("u", along(RIGHT), 9, start=10, **SPECIAL),
    seconds=9,
)
PASSING = Scene(
    TWO_WAY,
    *OVERTAKING.actors,
    actor("w", along(1.75, 130, -100), 6),
    seconds=8,
    drawn=(1.0, 4.0),
)
BEHIND_BLUE = Scene(
    TWO_WAY, ego(along(RIGHT), 8), actor("u", along(RIGHT), 8, start=15, **SPECIAL), seconds=4
)
TAIL = Scene(WAYS, ego(along(RIGHT), 5), actor("v", along(RIGHT), 5, start=6.5), seconds=4)

SCENES |= {
    "yield_821": (
        FIRST_COME,
        FIRST_COME.with_actor("v", speed=[(0, 4), (4.1, 4), (4.9, 0), (10.5, 0), (11, 1)]),
    ),
    "yield_right_820": (AT_ONCE, AT_ONCE.with_actor("ego", speed=WAITING)),
    "yield_emergency_829": (SIREN, SIREN.with_actor("ego", route=aside(45, RIGHT, LEFT, 15))),
    "turn_lanes_846": (
        Scene(WIDE, ego(through("s", "e", 2, out=1), 6, start=115), seconds=8, drawn=(0.0, 6.0)),
        Scene(WIDE, ego(through("s", "e", 2, out=2), 6, start=115), seconds=8),
    ),
    "bicycle_839": (BESIDE_BICYCLE, BESIDE_BICYCLE.with_actor("ego", route=((0, 0.2), (400, 0.2)))),
    "pass_843": (PASSING, PASSING.without("w")),
    "follow_emergency_921": (BEHIND_BLUE, BEHIND_BLUE.with_actor("u", lights=OFF)),
    "tailgating_816": (TAIL, TAIL.with_actor("v", start=20.0)),
}


# Rules of regulations and of the literature: violated, kept; ISO 34502: found, not found ----------------------

FOLLOWING = Scene(
    WAYS,
    ego(along(RIGHT), 8),
    actor("v", along(RIGHT), 8, start=15),
    seconds=3,
    drawn=(0.0,),
)
SLOWLY = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("v", along(RIGHT), 10, start=10),
    seconds=8,
    drawn=(0.0, 8.0),
)
CUT_OFF = Scene(
    WAYS,
    ego(along(RIGHT), 15),
    actor("v", aside(48, LEFT, RIGHT, 10), 5, start=46),
    seconds=7,
    drawn=(0.0, 5.5),
)
RUN_INTO = HARD.with_actor("ego", speed=15.0)
BRAKING_LEAD = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("v", along(RIGHT), braking(10, 2, 4), start=40),
    seconds=5,
    drawn=(0.0, 4.0),
)
ABRUPT = Scene(WAYS, ego(along(RIGHT), braking(15, 2, 6)), seconds=5, drawn=(2.0, 5.0))
WAITS_AT_STOP = [(0, 8), (3, 8), (5, 0), (8.5, 0), (10.5, 8)]
UNDERTAKING = Scene(
    WAYS,
    ego(along(LEFT), 20),
    actor("v", along(RIGHT), 15, start=15),
    seconds=5,
    drawn=(0.0, 4.0),
)
REVEALED = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("v", aside(85, RIGHT, LEFT, 12), 10, start=20),
    actor("o", (110, RIGHT)),
    seconds=11,
    drawn=(6.4, 8.0, 10.4),
)
WALKED_INTO = Scene(
    TOWN,
    ego(along(RIGHT), 7),
    actor("p", over(40, -8, 6), 1.2, "person"),
    seconds=7,
    drawn=(0.0, 5.6),
)
MERGED_BEFORE = Scene(
    WAYS,
    ego(aside(60, RIGHT, LEFT, 20), 10, start=40),
    actor("v", along(LEFT), 18),
    seconds=5,
    drawn=(0.0, 3.0),
)
SLOW = Scene(WAYS, ego(along(RIGHT), 12), seconds=3)
JAM = Scene(
    BROAD,
    ego(along(RIGHT), 2),
    *(actor(f"v{i}", along(RIGHT), 2, start=15 + 10 * i) for i in range(3)),
    seconds=4,
)
JOINING = Scene(
    ENTRY,
    ego(aside(30, RIGHT, LEFT), 15),
    actor("v", aside(50, -8.75, LEFT), 15, start=20),
    seconds=5,
    drawn=(0.0, 4.0),
)
FASTER_BEHIND = Scene(
    WAYS,
    ego(along(RIGHT), 10, start=60),
    actor("v", along(RIGHT), [(0, 10), (1, 10), (4, 19)], start=10),
    seconds=4,
    drawn=(0.0, 4.0),
)
BOTH_CHANGE = Scene(
    WAYS,
    ego(aside(30, RIGHT, LEFT, 40), 15),
    actor("v", aside(42, LEFT, RIGHT, 40), 15, start=12),
    seconds=6,
    drawn=(0.0, 3.4, 6.0),
)
BOTH_LEAVE = Scene(
    WAYS,
    ego(aside(20, RIGHT, LEFT, 60), 6),
    actor("v", aside(20, RIGHT, LEFT, 60), [(0, 6), (3, 6), (6, 1)], start=22),
    seconds=7,
    drawn=(0.0, 7.0),
)
PULLED_OUT = Scene(
    WAYS,
    ego(aside(70, RIGHT, LEFT), 10, start=60),
    actor("v", along(LEFT), [(0, 10), (4, 22)], start=15),
    seconds=5,
    drawn=(0.0, 4.0),
)
SWERVED = Scene(
    WAYS,
    ego(aside(10, RIGHT, LEFT, 120), 6),
    actor("v", along(RIGHT), [(0, 6), (6, 6), (8.5, 1)], start=22),
    seconds=9,
    drawn=(0.0, 8.0),
)
SCENES |= {
    "r157_cut_out": (REVEALED, REVEALED.with_actor("ego", speed=braking(10, 8, 3))),
    "r157_pedestrian": (WALKED_INTO, WALKED_INTO.with_actor("ego", speed=braking(7, 2, 2.5))),
    "r157_emergency_braking": (HARD, NEAR),
    "no_collision": (RUN_OVER, NEAR),
    "r157_lane_change": (
        MERGED_BEFORE,
        MERGED_BEFORE.with_actor("ego", route=aside(120, RIGHT, LEFT, 20), start=100.0),
    ),
    "r_g3_speed_limit": (
        Scene(LIMITED, ego(along(RIGHT), 15), seconds=3),
        Scene(LIMITED, ego(along(RIGHT), 13), seconds=3),
    ),
    "r_g4_traffic_flow": (
        SLOW,
        Scene(WAYS, *SLOW.actors, actor("v", along(RIGHT), 10, start=30), seconds=3),
    ),
    "r_i4_emergency_lane": (JAM, JAM.with_actor("ego", route=along(-1.1))),
    "r_i5_merging": (JOINING, JOINING.with_actor("ego", route=along(RIGHT))),
    "iso_cut_out": (
        CUT_OUT,
        CUT_OUT.with_actor("v", route=along(RIGHT), speed=braking(15, 2, 6)),
    ),
    "iso_rear_accelerates": (FASTER_BEHIND, FASTER_BEHIND.with_actor("v", speed=10.0)),
    "iso_change_cut_in": (BOTH_CHANGE, BOTH_CHANGE.with_actor("v", route=along(LEFT))),
    "iso_change_cut_out": (BOTH_LEAVE, BOTH_LEAVE.with_actor("v", speed=15.0)),
    "iso_change_rear_accelerates": (PULLED_OUT, PULLED_OUT.with_actor("ego", route=along(RIGHT))),
    "iso_change_lead_brakes": (SWERVED, SWERVED.with_actor("ego", route=along(RIGHT))),
    "rss_distance": (FOLLOWING, FOLLOWING.with_actor("v", start=40.0)),
    "r157_following": (SLOWLY, SLOWLY.with_actor("v", start=25.0)),
    "r157_cut_in": (CUT_OFF, CUT_OFF.with_actor("ego", speed=[(0, 15), (2, 15), (4, 5), (7, 5)])),
    "r157_braking_lead": (RUN_INTO, HARD),
    "r_g1_safe_distance": (
        FOLLOWING.with_actor("v", start=6.5),
        FOLLOWING.with_actor("v", route=aside(8, LEFT, RIGHT, 12), start=6.5),
    ),
    "r_g2_abrupt_braking": (
        ABRUPT,
        HARD.with_actor("ego", speed=braking(15, 2, 6)),
    ),
    "r_i1_stopping": (STOPPING, Scene(WAYS, *STOPPING.actors, actor("o", (60, RIGHT)), seconds=5)),
    "r_i2_passing_on_the_right": (
        UNDERTAKING,
        UNDERTAKING.with_actor("ego", route=along(RIGHT)).with_actor("v", route=along(LEFT)),
    ),
    "r_i3_turning_back": (
        Scene(WAYS, ego(along(RIGHT, 100, 0), 3, heading=0.0), seconds=3, drawn=(0.0, 3.0)),
        STRAIGHT,
    ),
    "r_in1_stop_sign": (
        AT_STOP,
        Scene(STOPS, ego(through("s", "n"), WAITS_AT_STOP, start=92), seconds=11),
    ),
    "r_in2_red_light": (RED, RED.with_actor("light-s", shows=[(0, "green")])),
    "iso_cut_in": (CUT_IN, CUT_IN.with_actor("v", route=along(LEFT))),
    "iso_lead_brakes": (
        BRAKING_LEAD,
        BRAKING_LEAD.with_actor("v", speed=10.0),
    ),
}


# Manoeuvres -------------------------------------------------------------------------------------------------

TO_THE_LEFT = Scene(WAYS, ego(aside(40, LEFT, RIGHT), 12), drawn=(0.0, 7.0))
TO_THE_RIGHT = Scene(WAYS, ego(aside(40, RIGHT, LEFT), 12), drawn=(0.0, 7.0))
SCENES |= {
    "stops": (STOPPING, STRAIGHT),
    "starts": (AT_STOP, THROUGH_STOP),
    "brakes_hard": (HARD, GENTLE),
    "changes_lane_left": (TO_THE_LEFT, TO_THE_RIGHT),
    "changes_lane_right": (TO_THE_RIGHT, TO_THE_LEFT),
    "turns_left": (TURN_LEFT, TURN_RIGHT),
    "turns_right": (TURN_RIGHT, TURN_LEFT),
    "walks_onto_road": (WALKER, WALKER.with_actor("p", route=((10, -7.0), (60, -7.0)))),
}


# All of them as traces --------------------------------------------------------------------------------------


def is_of_the_ego(name: str) -> bool:
    """Whether it is a rule about the ego, with one verdict for a trace; others tell who breaks them."""
    one = patterns()[name]
    return one.is_check and "FORALL" not in one.query


def traces() -> tuple[dict[str, list[Scene]], dict[str, tuple[tuple[str, int], ...]]]:
    """Scenes by the name of their trace, and of each pattern where its scenes are: (trace, number in it).

    Those of one road follow one another in one trace, unless things in them never move. The scenes of a rule
    about the ego are traces of their own: its verdict is one for the whole trace.
    """
    found: dict[str, list[Scene]] = {}
    places: dict[Scene, tuple[str, int]] = {}
    alone: dict[Scene, tuple[str, int]] = {}
    of: dict[str, tuple[tuple[str, int], ...]] = {}
    for name, scenes in SCENES.items():
        own = is_of_the_ego(name)
        known = alone if own else places
        for number, scene in enumerate(filter(None, scenes)):
            if scene in known:
                continue
            still = any(a.static for a in scene.actors)
            trace = f"{'not-' * number}{name}" if own or still else f"road-{_road_number(scene)}"
            known[scene] = (trace, len(found.setdefault(trace, [])))
            found[trace].append(scene)
        of[name] = tuple(known[scene] for scene in filter(None, scenes))
    return found, of


def _road_number(scene: Scene) -> int:
    return [id(road) for road in ROADS].index(id(scene.road))
