"""SUMO drives the vehicles: netconvert makes its network from our map, libsumo runs it step by step.

Facts about SUMO that matter here: x and y are OpenDRIVE's plus the network's ``netOffset``, which is read from
the network; a vehicle's position is the middle of its front bumper; its angle is in degrees, clockwise from
north. It drives bicycles in the middle of a lane; they are moved to the right of it here.
"""

from __future__ import annotations

import math
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import libsumo
import numpy as np
import sumo
from cast import CUES, DASH, DURATION, LIGHTS, PARKED, SIZES, VEHICLES, WALKS, WARM_UP, Cue
from draw_map import DRIVING, STOP_LINE, Town, town
from people import ADULT, CHILD, Gate, Walker, distances, project, stretch, walk
from tracks import STEP, Track, box

if TYPE_CHECKING:
    from collections.abc import Iterable

STEPS = round(DURATION / STEP)
BICYCLE_ASIDE = 0.8
"""How far right of the lane's middle bicycles ride; m."""
HARD = 7.5
"""How hard a vehicle may brake on its cue; m/s²."""
LOOK_AHEAD = 40.0
"""How far ahead of a vehicle its way is known; m."""
GIVE_WAY = 3.0
"""How hard vehicles brake for people; m/s²."""

STOP_OFFSETS = {**dict.fromkeys(("-1", "2", "3#0", "4", "-3#2"), STOP_LINE), "8": 1.5}
"""How far before the ends of SUMO's edges the map has its stop lines; m."""

NO_PARKING = """<types>
 <type id="parking" priority="0" speed="1.39" width="2.2" disallow="all" discard="true"/>
</types>
"""
"""SUMO would drive in parking bays; they are no lanes to it here."""


def build_network(xodr: Path, folder: Path) -> Path:
    """SUMO's network of the map, with stop lines where the map has them (SUMO's are at the ends of lanes)."""
    net, types = folder / "town.net.xml", folder / "parking.typ.xml"
    types.write_text(NO_PARKING, encoding="utf-8")
    home = Path(sumo.SUMO_HOME)
    shipped = home / "data" / "typemap" / "opendriveNetconvert.typ.xml"
    subprocess.run(
        [str(home / "bin" / "netconvert"), "--opendrive-files", str(xodr), "-o", str(net),
         "--type-files", f"{shipped},{types}", "--opendrive.internal-shapes", "--precision", "4",
         "--opendrive.curve-resolution", "1", "--no-turnarounds", "true"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    tree = ET.parse(net)
    for edge in tree.getroot().findall("edge"):
        offset = STOP_OFFSETS.get(edge.get("id", ""))
        if offset is not None:
            edge.insert(0, ET.Element("stopOffset", value=f"{offset:.1f}", vClasses="all"))
    tree.write(net)
    return net


@dataclass
class Recording:
    """What the simulation yields: tracks, and the colour of every light (``r``, ``y``, ``g``) at every step."""

    tracks: list[Track]
    lights: list[dict[str, str]]

    def track(self, name: str) -> Track:
        """The track of that name."""
        return next(t for t in self.tracks if t.name == name)


@dataclass
class Play:
    """One run of the simulation. Times are seconds of the recording; SUMO's clock is ``WARM_UP`` ahead."""

    drawn: Town
    offset: tuple[float, float] = (0.0, 0.0)
    tracks: dict[str, Track] = field(default_factory=dict)
    walkers: list[Walker] = field(default_factory=list)
    lights: list[dict[str, str]] = field(default_factory=list)
    cued: set[str] = field(default_factory=set)
    giving_way: set[str] = field(default_factory=set)
    shapes: dict[str, np.ndarray] = field(default_factory=dict)

    def run(self, net: Path) -> Recording:
        """Run it to the end."""
        libsumo.start(
            ["sumo", "-n", str(net), "--step-length", str(STEP), "--step-method.ballistic", "--seed", "7",
             "--lanechange.duration", "2.5", "--time-to-teleport", "-1", "--no-step-log", "--no-warnings",
             "--collision.check-junctions", "--collision.action", "warn", "--default.speeddev", "0"]
        )  # fmt: skip
        self.offset = net_offset(net)
        self.set_lights()
        self.add_vehicles()
        self.walkers = list(people_of(self.drawn))
        for step in range(-round(WARM_UP / STEP), STEPS + 2):
            self.step(step)
        libsumo.close()
        driven = [t for t in self.tracks.values() if t.rows]
        tracks = driven + parked(len(self.lights)) + [w.track for w in self.walkers]
        for track in tracks:
            track.finish()
        return Recording(tracks, self.lights)

    def step(self, step: int) -> None:
        """Cues, people, SUMO, and what is to be kept of it all."""
        time = step * STEP
        for cue in CUES:
            if abs(cue.time - time) < STEP / 2:
                self.follow(cue)
        self.give_way()
        libsumo.simulationStep()
        boxes = self.note_vehicles(step)
        for walker in self.walkers:
            ahead = self.ahead_of(walker)
            blocked = walker.on_road and any(inside(b, ahead) for b in boxes)
            walker.advance(lambda gate, w=walker: self.may_enter(gate, w, time), blocked)
            if step >= 0:
                walker.track.rows.append((*walker.position, walker.heading))
                walker.track.lights.append("")
        if step >= 0:
            self.note_lights()

    def follow(self, cue: Cue) -> None:
        """Tell a vehicle what its cue says."""
        name = cue.vehicle
        match cue.what:
            case "change":
                libsumo.vehicle.setLaneChangeMode(name, 0)
                libsumo.vehicle.changeLane(name, int(cue.value), 60.0)
            case "slow":
                libsumo.vehicle.setDecel(name, HARD)
                libsumo.vehicle.slowDown(name, cue.value, cue.over)
                self.cued.add(name)
            case "speed":
                libsumo.vehicle.setSpeed(name, cue.value)
                self.cued.add(name)
            case _:
                libsumo.vehicle.setSpeed(name, -1)
                self.cued.discard(name)

    def add_vehicles(self) -> None:
        """Announce the cast to SUMO."""
        for kind, (_, length, width, height) in SIZES.items():
            libsumo.vehicletype.copy("DEFAULT_VEHTYPE", kind)
            libsumo.vehicletype.setVehicleClass(kind, SUMO_CLASSES[kind])
            for name, value in (("Length", length), ("Width", width), ("Height", height), ("Imperfection", 0.0),
                                ("SpeedDeviation", 0.0), ("SpeedFactor", 1.0), ("MinGap", 2.2)):  # fmt: skip
                getattr(libsumo.vehicletype, f"set{name}")(kind, value)
            accel, decel, top = DYNAMICS[kind]
            libsumo.vehicletype.setAccel(kind, accel)
            libsumo.vehicletype.setDecel(kind, decel)
            libsumo.vehicletype.setEmergencyDecel(kind, 9.0)
            libsumo.vehicletype.setMaxSpeed(kind, top)
        for v in VEHICLES:
            edges = libsumo.simulation.findRoute(*v.way).edges
            libsumo.route.add(v.name, edges)
            depart = f"{v.depart + WARM_UP:.1f}" if v.depart > 0 else "0"
            libsumo.vehicle.add(
                v.name, v.name, typeID=v.kind, depart=depart, departLane=str(v.lane),
                departPos=f"{v.at:.2f}", departSpeed=f"{min(v.speed, v.top):.2f}",
            )  # fmt: skip
            libsumo.vehicle.setLaneChangeMode(v.name, 512)
            libsumo.vehicle.setMaxSpeed(v.name, min(v.top, DYNAMICS[v.kind][2]))
            self.tracks[v.name] = Track(v.name, v.model)

    def set_lights(self) -> None:
        """Give the junction its program: SUMO's own link states, in the order and for the times of the cast."""
        signals = [libsumo.lane.getParameter(link[0][2], "signalID") for link in self.links()]
        phases = libsumo.trafficlight.getAllProgramLogics("1")[0].phases
        own = [p.state for p in phases if "G" in p.state]
        main = next(s for s in own if s[signals.index("11")] == "G")
        side = next(s for s in own if s[signals.index("15")] == "G")
        states = {
            "main": main, "main ends": "".join("y" if c in "gG" else c for c in main),
            "side": side, "side ends": "".join("y" if c in "gG" else c for c in side), "none": "r" * len(main),
        }  # fmt: skip
        phases = [
            libsumo.trafficlight.Phase(seconds + (WARM_UP if i == 0 else 0), states[who])
            for i, (who, seconds) in enumerate(LIGHTS)
        ]
        libsumo.trafficlight.setProgramLogic("1", libsumo.trafficlight.Logic("town", 0, 0, phases))

    @staticmethod
    def links() -> list[list[tuple[str, str, str]]]:
        """The movements that the lights control: lane from, lane to, lane between."""
        return list(libsumo.trafficlight.getControlledLinks("1"))

    def note_lights(self) -> None:
        """Keep the colour of each light: that of the links whose lanes carry its id, as netconvert noted it."""
        state = libsumo.trafficlight.getRedYellowGreenState("1")
        colours: dict[str, str] = {}
        for link, letter in zip(self.links(), state, strict=True):
            signal = libsumo.lane.getParameter(link[0][2], "signalID")
            colours[signal] = letter.lower()
        self.lights.append(colours)

    def note_vehicles(self, step: int) -> list[np.ndarray]:
        """Keep where the vehicles are; returns their footprints."""
        boxes = []
        for name in libsumo.vehicle.getIDList():
            track = self.tracks[name]
            x, y = libsumo.vehicle.getPosition(name)
            heading = math.radians(90 - libsumo.vehicle.getAngle(name))
            back = track.model.length / 2
            aside = -BICYCLE_ASIDE if track.model.name == "bicycle" else 0.0
            x = x - self.offset[0] - back * math.cos(heading) - aside * math.sin(heading)
            y = y - self.offset[1] - back * math.sin(heading) + aside * math.cos(heading)
            boxes.append(box((x, y, heading), track.model.length + 1.0, track.model.width + 0.8))
            if step >= 0:
                if not track.rows:
                    track.first = step
                signals = libsumo.vehicle.getSignals(name)
                track.rows.append((x, y, heading))
                track.lights.append("".join(c for c, bit in SIGNALS if signals & bit))
        return boxes

    def ahead_of(self, walker: Walker) -> tuple[float, float]:
        """A point a step before a person."""
        x, y = walker.position
        return x + 0.9 * math.cos(walker.heading), y + 0.9 * math.sin(walker.heading)

    def may_enter(self, gate: Gate, walker: Walker, time: float) -> bool:
        """Whether a person may step onto the road at a gate now."""
        if gate.opens is not None:
            return time >= gate.opens
        needed = (gate.end - gate.start) / walker.speed + 1.0
        if gate.crosswalk in ("501", "502", "503", "504"):
            street = "main" if gate.crosswalk in ("501", "502") else "side"
            return red_for(street, time) > needed
        thing = next(c for c in self.drawn.crosswalks if c.attributes["id"] == gate.crosswalk)
        place = self.drawn.roads[thing.road].point(thing.s, 0.0)
        return not any(self.approaches(name, place) for name in libsumo.vehicle.getIDList())

    def approaches(self, name: str, place: tuple[float, float]) -> bool:
        """Whether a vehicle will come to a place within seconds."""
        speed = libsumo.vehicle.getSpeed(name)
        along, aside = project(self.way_ahead(name), place)
        return aside < 4.0 and 0.1 < along < max(speed * 4.5, 4.0) and speed > 0.5

    def way_ahead(self, name: str) -> np.ndarray:
        """The lanes that a vehicle will follow, from its front bumper on, in map axes."""
        lane = libsumo.vehicle.getLaneID(name)
        at = libsumo.vehicle.getLanePosition(name)
        shape = self.shape_of(lane)
        points = [*stretch(shape, at, float(distances(shape)[-1]))]
        for link in libsumo.vehicle.getNextLinks(name)[:2]:
            via, following = link[4], link[0]
            while via:
                points += [*self.shape_of(via)]
                via = next((x[4] for x in libsumo.lane.getLinks(via)), "")
            points += [*self.shape_of(following)]
            if distances(np.array(points))[-1] > LOOK_AHEAD:
                break
        return np.array(points)

    def shape_of(self, lane: str) -> np.ndarray:
        """A lane's middle line in map axes."""
        if lane not in self.shapes:
            self.shapes[lane] = np.array(libsumo.lane.getShape(lane)) - self.offset
        return self.shapes[lane]

    def give_way(self) -> None:
        """Have vehicles brake for people on the road before them."""
        present = [w for w in self.walkers if w.on_road]
        for name in libsumo.vehicle.getIDList():
            if name in self.cued:
                continue
            room = min((self.room_before(name, w) for w in present), default=math.inf)
            wanted = math.sqrt(2 * GIVE_WAY * max(room, 0.0))
            if wanted < libsumo.vehicle.getSpeed(name) + 0.5:
                libsumo.vehicle.setSpeed(name, wanted)
                self.giving_way.add(name)
            elif name in self.giving_way:
                libsumo.vehicle.setSpeed(name, -1)
                self.giving_way.discard(name)

    def room_before(self, name: str, walker: Walker) -> float:
        """Metres that a vehicle has before a person who is in its way or about to be; infinite otherwise."""
        x, y = walker.position
        vx, vy = libsumo.vehicle.getPosition(name)
        if math.dist((x, y), (vx - self.offset[0], vy - self.offset[1])) > LOOK_AHEAD:
            return math.inf
        way = self.way_ahead(name)
        along, aside = project(way, (x, y))
        ahead = (x + 1.0 * math.cos(walker.heading), y + 1.0 * math.sin(walker.heading))
        nearer = project(way, ahead)[1] < aside
        reach = 4.5 if nearer and walker.pace > 0.2 else 1.7
        return along - 2.5 if aside < reach and along > 0.05 else math.inf


SIGNALS = (("r", 1), ("l", 2), ("b", 8))
"""Bits of SUMO's vehicle signals: indicators and brake lights."""
SUMO_CLASSES = {
    "car": "passenger", "small": "passenger", "limousine": "passenger", "van": "delivery", "truck": "truck",
    "bus": "bus", "bicycle": "bicycle", "motorcycle": "motorcycle",
}  # fmt: skip
DYNAMICS = {
    "car": (2.4, 3.2, 50.0), "small": (2.2, 3.2, 45.0), "limousine": (2.6, 3.2, 60.0), "van": (1.9, 3.2, 40.0),
    "truck": (1.3, 3.0, 25.0), "bus": (1.2, 3.0, 25.0), "bicycle": (1.2, 3.0, 4.4),
    "motorcycle": (3.5, 5.0, 50.0),
}  # fmt: skip
"""Acceleration and braking in m/s², and top speed in m/s."""


def net_offset(net: Path) -> tuple[float, float]:
    """What SUMO added to the map's x and y."""
    location = ET.parse(net).getroot().find("location")
    if location is None:
        raise ValueError(f"{net}: no location element")
    x, y = location.get("netOffset", "").split(",")
    return float(x), float(y)


def inside(corners: np.ndarray, point: tuple[float, float]) -> bool:
    """Whether a point lies in a convex footprint whose corners run clockwise."""
    d = np.roll(corners, -1, axis=0) - corners
    r = np.asarray(point) - corners
    return bool((d[:, 0] * r[:, 1] - d[:, 1] * r[:, 0] <= 0).all())


def red_for(street: str, time: float) -> float:
    """Seconds from ``time`` on for which a street's lights stay red; 0 if they are not."""
    start, found = 0.0, 0.0
    for who, seconds in LIGHTS:
        start += seconds
        if start > time:
            if who.startswith(street):
                return found
            found = start - time
    return math.inf if found else 0.0


def parked(steps: int) -> list[Track]:
    """The vehicles in the parking bays."""
    x = DRIVING + 1.15
    return [
        Track(v.name, v.model, 0, [(x, v.at, math.pi / 2)] * steps, [""] * steps) for v in PARKED
    ]


def people_of(drawn: Town) -> Iterable[Walker]:
    """Everyone on foot."""
    for w in WALKS:
        model = CHILD if w.child else ADULT
        line, gates = walk(w.start, w.crosswalks, w.end, w.aside)
        looks = type(model)(**{**vars(model), "colour": w.colour})
        yield Walker(Track(w.name, looks), line, w.speed, gates)
    street = drawn.road_named("North Street")
    walk_x = DRIVING + 2.2 + 1.25
    here, there = (walk_x - 0.7, DASH.start), (-walk_x, DASH.y + 14.0)
    line = np.array([here, (walk_x - 0.7, DASH.y), (-walk_x, DASH.y), there])
    if not street.start[1] < DASH.y < street.start[1] + street.length:
        raise ValueError("the jaywalker is not on North Street")
    along = DASH.y - DASH.start
    gate = Gate(along + walk_x - 0.7 - DRIVING, along + walk_x - 0.7 + DRIVING, "", DASH.opens)
    looks = type(ADULT)(**{**vars(ADULT), "colour": (220, 140, 30)})
    yield Walker(Track(DASH.name, looks), line, DASH.speed, [gate])


def simulate(xodr: Path, folder: Path) -> Recording:
    """Run the play on the map; ``folder`` is where SUMO's network goes."""
    return Play(town()).run(build_network(xodr, folder))
