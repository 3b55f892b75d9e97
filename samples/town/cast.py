"""Who is in the recording, and the stage directions: what must happen at which second.

Vehicles are SUMO's: it drives them along their routes by its own car-following, lane-changing and junction
rules, with the lights' program below. A *cue* takes over where a story needs an actor to do a certain thing.
"""

from __future__ import annotations

from dataclasses import dataclass

from tracks import Model

DURATION = 75.0
"""Length of the recording; s."""
WARM_UP = 2.0
"""Seconds that SUMO runs before the recording, so that every vehicle has settled at its speed."""

SIZES = {
    "car": ("TYPE_CAR", 4.5, 1.85, 1.5), "small": ("TYPE_SMALL_CAR", 3.7, 1.7, 1.5),
    "limousine": ("TYPE_LUXURY_CAR", 4.9, 1.9, 1.45), "van": ("TYPE_DELIVERY_VAN", 5.6, 2.0, 2.4),
    "truck": ("TYPE_HEAVY_TRUCK", 8.6, 2.45, 3.4), "bus": ("TYPE_BUS", 12.0, 2.55, 3.1),
    "bicycle": ("TYPE_BICYCLE", 1.8, 0.65, 1.75), "motorcycle": ("TYPE_MOTORBIKE", 2.2, 0.8, 1.5),
}  # fmt: skip
"""Kinds of vehicles: OSI type, length, width, height."""

WHITE, BLACK, SILVER, RED = (235, 235, 232), (38, 40, 46), (165, 170, 176), (178, 34, 34)
BLUE, GREEN, YELLOW, ORANGE = (40, 78, 150), (52, 105, 72), (226, 178, 40), (206, 98, 32)
TEAL, BROWN = (32, 120, 128), (112, 84, 60)

LIGHTS = (
    ("main", 17.0), ("main ends", 3.0), ("none", 1.5), ("side", 8.0), ("side ends", 3.0), ("none", 1.5),
    ("main", 29.0), ("main ends", 3.0), ("none", 1.5), ("side", 10.0), ("side ends", 3.0),
)  # fmt: skip
"""Phases of the lights and their seconds: who has green, whose green ends (yellow), or nobody."""


@dataclass(frozen=True)
class Vehicle:
    """A vehicle: its kind, way and start. Edges are SUMO's: road id, with ``-`` for travel along the road."""

    name: str
    kind: str
    way: tuple[str, str]
    at: float
    lane: int = 0
    speed: float = 12.0
    depart: float = 0.0
    colour: tuple[int, int, int] = SILVER
    role: str = "ROLE_CIVIL"
    top: float = 14.0

    @property
    def model(self) -> Model:
        """Its looks."""
        osi_type, length, width, height = SIZES[self.kind]
        return Model(self.kind, osi_type, length, width, height, self.colour, self.role)


EGO = "ego"

VEHICLES = (
    Vehicle(EGO, "car", ("-1", "-7"), 30.0, 1, 12.0, colour=WHITE, top=12.2),
    # on Main Street, with the ego
    Vehicle("ahead", "car", ("-1", "-2"), 51.0, 1, 12.0, colour=BLACK, top=12.5),
    Vehicle("cutter", "limousine", ("-1", "-2"), 33.0, 0, 11.0, colour=RED, top=11.5),
    Vehicle("bus", "bus", ("-1", "-2"), 88.0, 0, 9.0, 0.0, YELLOW, "ROLE_PUBLIC_TRANSPORT", 9.0),
    Vehicle("follower", "car", ("-1", "-2"), 6.0, 1, 12.0, colour=BLUE, top=12.5),
    Vehicle("courier", "van", ("-1", "-2"), 8.0, 0, 11.0, 1.5, WHITE, top=11.0),
    Vehicle("late", "small", ("-1", "-4"), 6.0, 0, 12.0, 7.0, GREEN),
    Vehicle("far", "van", ("-1", "-4"), 170.0, 0, 12.5, colour=TEAL),
    # coming towards it
    Vehicle("west1", "car", ("2", "1"), 120.0, 0, 12.0, colour=SILVER),
    Vehicle("west2", "truck", ("2", "1"), 90.0, 0, 11.0, colour=GREEN),
    Vehicle("west3", "small", ("2", "1"), 100.0, 1, 12.0, colour=YELLOW),
    Vehicle("west4", "car", ("1", "1"), 60.0, 1, 12.5, colour=BLUE),
    Vehicle("west5", "motorcycle", ("1", "1"), 20.0, 0, 12.5, colour=BLACK),
    Vehicle("oncoming", "car", ("2", "1"), 30.0, 1, 11.0, 12.0, BLUE),
    Vehicle("oncoming2", "van", ("2", "1"), 30.0, 0, 11.0, 12.5, WHITE),
    # from the side streets
    Vehicle("cyclist", "bicycle", ("4", "-6"), 52.0, 0, 4.0, 18.0, ORANGE),
    Vehicle("south1", "car", ("4", "-6"), 50.0, 0, 0.0, 7.0, TEAL),
    Vehicle("north1", "small", ("3#2", "-4"), 5.0, 0, 8.0, 7.0, RED),
    Vehicle("north2", "car", ("3#2", "1"), 2.0, 0, 8.0, 11.0, SILVER),
    Vehicle("north3", "van", ("5", "-4"), 5.0, 0, 8.0, 36.0, BROWN),
    # around the T-junctions
    Vehicle("mill1", "car", ("6", "-7"), 4.0, 0, 11.0, 45.0, ORANGE, top=12.0),
    Vehicle("park1", "car", ("7", "-6"), 5.0, 0, 11.0, 28.0, BLUE),
    Vehicle("park2", "truck", ("7", "-6"), 5.0, 0, 10.0, 53.0, TEAL),
    Vehicle("school1", "small", ("8", "-7"), 10.0, 0, 8.0, 58.0, YELLOW),
    Vehicle("park3", "limousine", ("7", "-8"), 5.0, 0, 11.0, 62.0, SILVER),
)


PARKED = (
    Vehicle("parked1", "car", ("", ""), 53.6, colour=SILVER),
    Vehicle("parked2", "small", ("", ""), 59.8, colour=RED),
    Vehicle("parked3", "van", ("", ""), 66.8, colour=BLUE),
    Vehicle("parked4", "limousine", ("", ""), 83.5, colour=GREEN),
)
"""Vehicles that stand in the bays of North Street; ``at`` is the northing of their middle."""


@dataclass(frozen=True)
class Cue:
    """At ``time`` seconds a vehicle is told to ``change`` to a lane, to ``slow`` to a speed (m/s) within
    ``over`` seconds, to hold a ``speed``, or to go on as it likes (``free``)."""

    time: float
    vehicle: str
    what: str
    value: float = 0.0
    over: float = 0.0


CUES = (
    Cue(3.5, "ahead", "slow", 4.5, 1.2),
    Cue(5.0, "ahead", "free"),
    Cue(8.4, "cutter", "change", 1),
    Cue(9.5, "bus", "speed", 7.0),
    Cue(30.0, "bus", "free"),
)


@dataclass(frozen=True)
class Walk:
    """A person's way: from a place, over crosswalks (with a time where it is scripted), to a place."""

    name: str
    start: tuple[float, float]
    crosswalks: tuple[tuple[str, float | None], ...]
    end: tuple[float, float]
    speed: float = 1.35
    aside: float = 0.0
    child: bool = False
    colour: tuple[int, int, int] = (60, 80, 140)


NAVY, WINE, MOSS, SAND, PLUM, SKY = (
    (44, 62, 110), (150, 40, 56), (70, 104, 60), (196, 160, 110), (116, 70, 120), (90, 140, 190),
)  # fmt: skip

WALKS = (
    # over Main Street, before the ego that waits at the red light
    Walk("crossing1", (-40.0, -8.25), (("501", 22.0),), (-110.0, 8.25), 1.4, 0.9, colour=WINE),
    Walk("crossing2", (-36.0, 8.25), (("501", 22.6),), (-120.0, -8.25), 1.35, 0.0, colour=MOSS),
    # along Main Street
    Walk("stroller1", (-190.0, 8.25), (), (-85.0, 8.25), 1.3, 0.85, colour=NAVY),
    Walk("stroller2", (-189.0, 8.25), (), (-84.0, 8.25), 1.3, 0.25, colour=SAND),
    Walk("stroller3", (-100.0, -8.25), (), (-210.0, -8.25), 1.35, 0.4, colour=PLUM),
    Walk("stroller4", (-150.0, -8.25), (), (-50.0, -8.25), 1.25, 0.95, colour=SKY),
    Walk("parent", (-60.0, 8.25), (), (-140.0, 8.25), 1.0, 0.95, colour=WINE),
    Walk("child", (-60.6, 8.25), (), (-140.6, 8.25), 1.0, 0.4, child=True, colour=YELLOW),
    Walk("waiting1", (-75.0, -8.25), (), (-74.0, -8.25), 0.3, -0.9, colour=NAVY),
    Walk("waiting2", (-77.5, -8.25), (), (-76.9, -8.25), 0.3, -0.9, colour=MOSS),
    # over the other arms of the junction
    Walk("walker1", (35.0, 8.25), (("502", 68.0),), (80.0, -8.25), 1.35, 0.5, colour=SAND),
    Walk("walker2", (45.0, -8.25), (("502", 68.4),), (90.0, 8.25), 1.3, 0.5, colour=NAVY),
    Walk("walker3", (-6.95, 45.0), (("503", 56.0),), (6.95, 95.0), 1.35, 0.5, colour=PLUM),
    Walk("walker4", (6.95, 34.0), (("503", 56.5),), (-60.0, 8.25), 1.3, 0.5, colour=WINE),
    Walk("walker5", (-6.95, -50.0), (("504", None),), (6.95, -85.0), 1.4, 0.5, colour=SKY),
    Walk("walker6", (6.95, -40.0), (("504", None),), (-90.0, -8.25), 1.3, 0.5, colour=MOSS),
    # along North Street
    Walk("shopper1", (6.95, 122.0), (), (6.95, 30.0), 1.3, 0.6, colour=SAND),
    Walk("shopper2", (-6.95, 30.0), (), (-6.95, 125.0), 1.35, 0.5, colour=NAVY),
    Walk("shopper3", (-6.95, 118.0), (), (-6.95, 35.0), 1.2, 0.6, colour=PLUM),
    # over and along Park Lane
    Walk("zebra1", (6.95, 113.0), (("506", 66.8),), (110.0, 152.95), 1.35, 0.5, colour=WINE),
    Walk("zebra2", (-2.0, 152.95), (("506", 67.4),), (110.0, 139.05), 1.35, 0.5, colour=MOSS),
    Walk("walker7", (118.0, 152.95), (), (30.0, 152.95), 1.25, 0.5, colour=SKY),
    Walk("walker8", (105.0, 139.05), (), (20.0, 139.05), 1.2, 0.5, colour=SAND),
    Walk("pupil", (123.05, 75.0), (), (100.0, 139.05), 1.2, 0.5, child=True, colour=YELLOW),
    Walk("walker9", (-60.0, 152.95), (), (20.0, 152.95), 1.3, -0.4, colour=NAVY),
)


@dataclass(frozen=True)
class Dash:
    """Someone who crosses North Street away from any crosswalk, at northing ``y``, from right to left."""

    name: str
    y: float
    opens: float
    start: float
    speed: float


DASH = Dash("jaywalker", 76.0, 49.0, 20.0, 1.6)
