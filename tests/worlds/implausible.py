"""One drive in seven flavours, and what can be wrong with it: each fault is well-formed and impossible.

A :class:`Drive` is a table of bodies by frame. A fault changes the table; a writer turns it into a recording.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import autoware_recordings
import carla_recordings
import commonroad_scenarios
import foxglove_scenes
import numpy as np
import recordings
import sumo_recordings

from sgstore.graphs.online import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

FRAMES, PERIOD = 45, 0.1
KINDS = {1: "car", 2: "car", 3: "truck", 4: "car", 5: "person"}
SIZES = {
    1: (4.5, 1.9, 1.5),
    2: (4.2, 1.8, 1.4),
    3: (9.0, 2.5, 3.4),
    4: (4.8, 1.95, 1.6),
    5: (0.5, 0.6, 1.8),
}


@dataclass
class Body:
    """A body in one frame: angles in rad, velocity and acceleration in the axes of the map."""

    x: float
    y: float
    heading: float
    vx: float
    vy: float
    ax: float = 0.0
    ay: float = 0.0
    az: float = 0.0
    yaw_rate: float = 0.0
    z: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    size: tuple[float, float, float] = (4.5, 1.9, 1.5)


@dataclass
class Moment:
    """A frame of a drive: log time and stamp (s), bodies by id, the state of its light, the controls."""

    time: float
    stamp: float
    bodies: dict[int, Body]
    ego: int | None = 1
    light: str = "red"
    throttle: float = 0.3
    kinds: dict[int, str] = field(default_factory=lambda: dict(KINDS))


Drive = list[Moment]


def drive() -> Drive:
    """Cars and a truck on circles of different sizes, faster and faster, and a person on a straight way."""
    return [
        Moment(
            time=i * PERIOD,
            stamp=i * PERIOD,
            bodies={ident: _body(ident, i * PERIOD) for ident in KINDS},
            light=("red", "green", "yellow")[i // 15 % 3],
        )
        for i in range(FRAMES)
    ]


def _body(ident: int, t: float) -> Body:
    size = SIZES[ident]
    if ident == 5:
        return Body(5 + 1.4 * t, -20.0, 0.0, 1.4, 0.0, z=size[2] / 2, size=size)
    radius, start, gain = 20.0 + 10 * ident, 1.1 * ident, 1.0
    speed, way = 9.0 + gain * t, 9.0 * t + gain * t * t / 2
    angle, rate = start + way / radius, speed / radius
    heading = angle + math.pi / 2
    cos, sin = math.cos(heading), math.sin(heading)
    return Body(
        x=radius * math.cos(angle),
        y=radius * math.sin(angle),
        heading=math.remainder(heading, 2 * math.pi),
        vx=speed * cos,
        vy=speed * sin,
        ax=gain * cos - speed * rate * sin,
        ay=gain * sin + speed * rate * cos,
        yaw_rate=rate,
        z=size[2] / 2,
        size=size,
    )


def each(of: Drive, first: int = 0) -> Iterator[Body]:
    """All bodies of a drive from a frame on."""
    return (body for moment in of[first:] for body in moment.bodies.values())


def changed(change: Callable[[Body], None], only: tuple[int, ...] = ()) -> Callable[[Drive], None]:
    """Return a fault that changes each body, or those of some ids."""

    def fault(of: Drive) -> None:
        for moment in of:
            for ident, body in moment.bodies.items():
                if not only or ident in only:
                    change(body)

    return fault


def scaled(**factors: float) -> Callable[[Body], None]:
    def change(body: Body) -> None:
        for name, factor in factors.items():
            value = getattr(body, name)
            new = tuple(factor * v for v in value) if name == "size" else factor * value
            setattr(body, name, new)

    return change


def put(**values: Any) -> Callable[[Body], None]:
    """Return a change that sets fields: values, or functions of the body."""

    def change(body: Body) -> None:
        new = {name: v(body) if callable(v) else v for name, v in values.items()}
        for name, value in new.items():
            setattr(body, name, value)

    return change


def teleported(of: Drive) -> None:
    for moment in of[len(of) // 2 :]:
        moment.bodies[2].x += 6.0


def frozen(of: Drive) -> None:
    still = of[len(of) // 2].bodies[2]
    for moment in of[len(of) // 2 :]:
        body = moment.bodies[2]
        body.x, body.y, body.heading = still.x, still.y, still.heading


def swapped(of: Drive) -> None:
    for moment in of[len(of) // 2 :]:
        bodies = moment.bodies
        bodies[2], bodies[4] = bodies[4], bodies[2]


def reused(of: Drive) -> None:
    for moment in of[len(of) // 3 : len(of) * 2 // 3]:
        del moment.bodies[2]
    for moment in of[len(of) * 2 // 3 :]:
        moment.bodies[2].x += 120.0


def grown(of: Drive) -> None:
    for moment in of[len(of) // 2 :]:
        moment.bodies[2].size = tuple(2 * v for v in SIZES[2])


def doubled_stamps(of: Drive) -> None:
    for before, moment in zip(of[::2], of[1::2], strict=False):
        moment.stamp = before.stamp


def unsorted_stamps(of: Drive) -> None:
    one, other = of[len(of) // 2 : len(of) // 2 + 2]
    one.stamp, other.stamp = other.stamp, one.stamp


def timed(factor: float) -> Callable[[Drive], None]:
    def fault(of: Drive) -> None:
        for moment in of:
            moment.stamp *= factor

    return fault


def without_ego(of: Drive) -> None:
    for moment in of[len(of) // 3 : len(of) // 2]:
        del moment.bodies[1]
        moment.ego = None


def two_of_one(of: Drive) -> None:
    for moment in of:
        moment.kinds[6] = "car"
        moment.bodies[6] = copy.copy(moment.bodies[1])


def lit(*states: str, frames: int = 10) -> Callable[[Drive], None]:
    def fault(of: Drive) -> None:
        for number, moment in enumerate(of):
            moment.light = states[number // frames % len(states)]

    return fault


def pedal(of: Drive) -> None:
    for moment in of:
        moment.throttle = 30.0


MOTION = {"autoware", "carla", "foxglove", "online", "osi"}
"""Flavours with velocities as vectors."""
ALL = {*MOTION, "commonroad", "sumo"}


def _ego_vector(body: Body) -> tuple[float, float, float]:
    cos, sin = math.cos(body.heading), math.sin(body.heading)
    return body.vx * cos + body.vy * sin, body.vy * cos - body.vx * sin, 0.0


def _osi(of: Drive, path: Path) -> Path:
    with recordings.Recorder(path) as recorder:
        for moment in of:
            things = []
            for ident, body in moment.bodies.items():
                kind = moment.kinds[ident]
                thing = recordings.car(
                    ident, body.x, body.y, yaw=body.heading, v=(body.vx, body.vy), z=body.z
                )
                if kind == "person":
                    thing.type = recordings.PEDESTRIAN
                    thing.ClearField("vehicle_classification")
                elif kind == "truck":
                    thing.vehicle_classification.type = 7
                base = thing.base
                base.acceleration.x, base.acceleration.y = body.ax, body.ay
                base.acceleration.z = body.az
                base.orientation.pitch, base.orientation.roll = body.pitch, body.roll
                base.orientation_rate.yaw = body.yaw_rate
                size = base.dimension
                size.length, size.width, size.height = body.size
                things.append(thing)
            color = {"red": 2, "yellow": 3, "green": 4, "red_yellow": 2}[moment.light]
            lights = [
                recordings.bulb(
                    80 + c,
                    c,
                    3 if c == color or (c == 3 and moment.light == "red_yellow") else 2,
                    (25, -4, 3 - 0.3 * c),
                )
                for c in (2, 3, 4)
            ]
            recorder.ground_truth(
                moment.time, things, stamp=moment.stamp, host=moment.ego, lights=lights
            )
    return path


def _foxglove(of: Drive, path: Path) -> Path:
    with foxglove_scenes.SceneRecorder.of(path, "json") as recorder:
        for moment in of:
            cubes = [
                foxglove_scenes.cube(
                    "ego" if ident == 1 else str(ident),
                    (body.x, body.y, body.z),
                    yaw=body.heading,
                    size=body.size,
                    type=moment.kinds[ident],
                )
                for ident, body in moment.bodies.items()
            ]
            recorder.scene(moment.stamp, cubes, clear=True)
    return path


def _autoware(of: Drive, path: Path) -> Path:
    with autoware_recordings.Stack(path) as stack:
        for moment in of:
            ego = moment.bodies.get(1)
            if ego is not None:
                stack.pose(
                    1 + moment.stamp,
                    ego.x,
                    ego.y,
                    ego.heading,
                    v=_ego_vector(ego),
                    yaw_rate=ego.yaw_rate,
                )
            things = [
                autoware_recordings.thing(
                    "pedestrian" if moment.kinds[ident] == "person" else moment.kinds[ident],
                    body.x,
                    body.y,
                    str(ident),
                    z=body.z,
                    heading=body.heading,
                    v=_ego_vector(body),
                    yaw_rate=body.yaw_rate,
                    size=body.size,
                )
                for ident, body in moment.bodies.items()
                if ident != 1
            ]
            stack.objects(1 + moment.stamp, things)
    return path


def _carla(of: Drive, path: Path) -> Path:
    blueprints = {"truck": "vehicle.carlamotors.carlacola", "person": "walker.pedestrian.0001"}
    with carla_recordings.Bridge(path) as bridge:
        known = {**KINDS, 6: "car"}
        bridge.actors(
            {
                ident: (
                    blueprints.get(kind, "vehicle.tesla.model3"),
                    "hero" if ident == 1 else "autopilot",
                )
                for ident, kind in known.items()
            }
        )
        bridge.light_places([carla_recordings.light(80, 25, -4)])
        for moment in of:
            state = {"red": 0, "yellow": 1, "green": 2, "red_yellow": 4}[moment.light]
            bridge.light_states({80: state}, moment.stamp + 0.001)
            things = [
                carla_recordings.thing(
                    ident,
                    body.x,
                    body.y,
                    z=body.z,
                    heading=body.heading,
                    pitch=body.pitch,
                    roll=body.roll,
                    v=(body.vx, body.vy, 0.0),
                    a=(body.ax, body.ay, body.az),
                    yaw_rate=body.yaw_rate,
                    size=list(body.size),
                    classification=4 if moment.kinds[ident] == "person" else 6,
                    time=moment.stamp,
                )
                for ident, body in moment.bodies.items()
            ]
            bridge.objects(moment.stamp, things, log_time=moment.time + 0.002)
            bridge.status(moment.stamp, throttle=moment.throttle)
    return path


def _commonroad(of: Drive, path: Path) -> Path:
    ways: dict[int, list[str]] = {}
    for step, moment in enumerate(of):
        for ident, body in moment.bodies.items():
            speed, _, _ = _ego_vector(body)
            more = f"<yawRate><exact>{body.yaw_rate}</exact></yawRate>"
            ways.setdefault(ident, []).append(
                commonroad_scenarios.state(step, body.x, body.y, body.heading, speed, more)
            )
    kinds = {"person": "pedestrian"}
    bodies = "".join(
        commonroad_scenarios.dynamic(
            100 + ident,
            kinds.get(KINDS.get(ident, "car"), KINDS.get(ident, "car")),
            "<rectangle><length>{}</length><width>{}</width></rectangle>".format(*size[:2]),
            states,
        )
        for ident, states in ways.items()
        for size in [next(m.bodies[ident].size for m in of if ident in m.bodies)]
    )
    head = commonroad_scenarios.HEAD.format(name="ZAM_Test-1_1_T-1", version="2020a")
    path = path.with_suffix(".xml")
    path.write_text(f"{head}{commonroad_scenarios.lanes()}{bodies}</commonRoad>")
    return path


def _sumo(of: Drive, path: Path) -> Path:
    steps = []
    for moment in of:
        things = []
        for ident, body in moment.bodies.items():
            cos, sin = math.cos(body.heading), math.sin(body.heading)
            half = body.size[0] / 2
            person = moment.kinds[ident] == "person"
            things.append(
                sumo_recordings.vehicle(
                    str(ident),
                    body.x + half * cos,
                    body.y + half * sin,
                    90 - math.degrees(body.heading),
                    speed=_ego_vector(body)[0],
                    tag="person" if person else "vehicle",
                    type="truck_trailer" if moment.kinds[ident] == "truck" else "DEFAULT_VEHTYPE",
                    length=body.size[0],
                    width=body.size[1],
                    height=body.size[2],
                )
            )
        steps.append(sumo_recordings.step(moment.stamp, *things))
    path = path.with_suffix(".xml")
    path.write_text(sumo_recordings.export(*steps))
    return path


WRITERS: dict[str, Callable[[Drive, Path], Path]] = {
    "osi": _osi,
    "foxglove": _foxglove,
    "autoware": _autoware,
    "carla": _carla,
    "commonroad": _commonroad,
    "sumo": _sumo,
}


def frames(of: Drive) -> Iterator[Frame]:
    """Frames of a client."""
    for moment in of:
        frame = Frame(round(moment.stamp * 1e9), ego=moment.ego or None)
        for ident, body in moment.bodies.items():
            length, width, height = body.size
            frame.add(
                ident,
                moment.kinds[ident],
                body.x,
                body.y,
                body.z,
                heading=math.degrees(body.heading),
                pitch=math.degrees(body.pitch),
                roll=math.degrees(body.roll),
                length=length,
                width=width,
                height=height,
                vx=body.vx,
                vy=body.vy,
                ax=body.ax,
                ay=body.ay,
                az=body.az,
                yaw_rate=math.degrees(body.yaw_rate),
                throttle=moment.throttle if ident == moment.ego else math.nan,
            )
        frame.add("light", "traffic_light", 25, -4, 3, light_state=moment.light)
        yield frame


def _halved(body: Body) -> None:
    length, width, height = body.size
    body.size = (length / 2, width / 2, height / 2)


def _squared(body: Body) -> None:
    body.size = (1.0, 1.0, 1.0)


def _across(body: Body) -> None:
    length, width, height = body.size
    body.size = (width, length, height)


def _degrees(body: Body) -> None:
    body.heading = math.degrees(body.heading)


def _own_axes(body: Body) -> None:
    body.vx, body.vy, _ = _ego_vector(body)


def _mirrored(body: Body) -> None:
    body.y *= -1


def _turned(degrees: float) -> Callable[[Body], None]:
    def change(body: Body) -> None:
        body.heading += math.radians(degrees)

    return change


def _flat(body: Body) -> None:
    body.z *= -1


def _float32(body: Body) -> None:
    body.x, body.y = (float(np.float32(v + 4_500_000)) for v in (body.x, body.y))


POSES = ALL
FAULTS: dict[str, tuple[Callable[[Drive], None], set[str], set[str]]] = {
    # name → fault, flavours that can express it, kinds of which one must be found
    "velocity x100": (
        changed(scaled(vx=100, vy=100)),
        MOTION - {"foxglove"},
        {"impossible speed", "velocity unit"},
    ),
    "velocity of one body x10": (
        changed(scaled(vx=10, vy=10), (2,)),
        ALL - {"foxglove"},
        {"velocity unit"},
    ),
    "velocity in km/h": (changed(scaled(vx=3.6, vy=3.6)), ALL - {"foxglove"}, {"velocity unit"}),
    "velocity in mph": (changed(scaled(vx=2.237, vy=2.237)), ALL - {"foxglove"}, {"velocity unit"}),
    "velocity always 0": (changed(scaled(vx=0, vy=0)), ALL - {"foxglove"}, {"velocity missing"}),
    "velocity in axes of the body": (
        changed(_own_axes),
        {"osi", "carla", "online"},
        {"velocity axes"},
    ),
    "velocity with y mirrored": (
        changed(scaled(vy=-1)),
        {"osi", "carla", "online"},
        {"velocity axes"},
    ),
    "centimetres": (changed(scaled(x=100, y=100)), ALL, {"velocity unit", "teleport"}),
    "frozen": (frozen, ALL - {"foxglove"}, {"frozen"}),
    "degrees for radians": (changed(_degrees), {"osi", "online"}, {"angle unit"}),
    "heading off by 90": (changed(_turned(90)), ALL, {"heading", "velocity axes"}),
    "heading off by 180": (changed(_turned(180)), ALL, {"backwards", "velocity axes"}),
    "heading always 0": (changed(put(heading=0.0)), ALL, {"heading", "velocity axes"}),
    "y mirrored": (changed(_mirrored), ALL, {"heading", "velocity axes"}),
    "x and y swapped": (
        changed(put(x=lambda b: b.y, y=lambda b: b.x)),
        {"osi", "foxglove", "carla", "online"},
        {"heading", "velocity axes"},
    ),
    "yaw rate in degrees": (
        changed(scaled(yaw_rate=57.3)),
        {"osi", "carla", "online", "commonroad"},
        {"yaw rate unit"},
    ),
    "yaw rate clockwise": (
        changed(scaled(yaw_rate=-1)),
        {"osi", "carla", "online", "commonroad"},
        {"yaw rate sign"},
    ),
    "acceleration in g": (
        changed(scaled(ax=1 / 9.81, ay=1 / 9.81)),
        {"osi", "carla", "online"},
        {"acceleration unit"},
    ),
    "acceleration x100": (
        changed(scaled(ax=100, ay=100)),
        {"osi", "carla", "online"},
        {"acceleration unit"},
    ),
    "gravity": (changed(put(az=9.81)), {"osi", "online"}, {"gravity"}),
    "upside down": (changed(put(roll=math.pi)), {"osi", "carla", "online"}, {"upside down"}),
    "z down": (changed(_flat), {"osi", "foxglove", "online"}, {"z down"}),
    "teleport": (teleported, ALL, {"teleport"}),
    "swapped ids": (swapped, ALL, {"swapped ids"}),
    "reused id": (reused, ALL - {"commonroad"}, {"reused id"}),
    "size jump": (grown, ALL - {"commonroad"}, {"size jump"}),
    "sizes in centimetres": (changed(scaled(size=100)), ALL, {"impossible size"}),
    "sizes of 0": (changed(put(size=(0.0, 0.0, 0.0))), {"osi", "online"}, {"impossible size"}),
    "sizes of 1": (changed(_squared), ALL, {"placeholder size"}),
    "half sizes": (changed(_halved), ALL, {"half sizes"}),
    "length and width swapped": (changed(_across), ALL, {"width and length swapped"}),
    "doubled body": (two_of_one, ALL - {"autoware"}, {"doubled body"}),
    "rounded positions": (changed(_float32), {"osi", "foxglove", "online"}, {"rounded positions"}),
    "doubled stamps": (doubled_stamps, {"osi", "online", "carla"}, {"doubled stamps"}),
    "unsorted stamps": (unsorted_stamps, {"osi", "online", "carla"}, {"unsorted stamps"}),
    "clock at twice the speed": (timed(0.5), ALL - {"foxglove", "commonroad"}, {"velocity unit"}),
    "clock at half the speed": (timed(2.0), ALL - {"foxglove", "commonroad"}, {"velocity unit"}),
    "milliseconds for nanoseconds": (timed(1e-6), {"osi", "online"}, {"time unit"}),
    "ego missing": (without_ego, {"osi", "foxglove", "carla", "online"}, {"ego missing"}),
    "light in reverse order": (
        lit("green", "red", "yellow"),
        {"osi", "carla", "online"},
        {"light order"},
    ),
    "light flickers": (
        lit("red", "green", frames=1),
        {"osi", "carla", "online"},
        {"light flickers"},
    ),
    "throttle in percent": (pedal, {"carla", "online"}, {"control range"}),
}


def noisy(of: Drive, size: float, seed: int) -> Drive:
    """Return a drive with the noise of measured data; ``size``: standard deviation of positions, m."""
    random = np.random.default_rng(seed)
    measured = copy.deepcopy(of)
    for body in each(measured):
        for name, share in (("x", 1), ("y", 1), ("heading", 0.4), ("vx", 3), ("vy", 3), ("ax", 9)):
            setattr(body, name, getattr(body, name) + random.normal(0, share * size))
        body.size = tuple(max(0.3, v * (1 + random.normal(0, size / 2))) for v in body.size)
    return measured
