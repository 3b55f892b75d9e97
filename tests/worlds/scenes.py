"""Small scenes: roads, and actors that drive and walk on them, as traces of a store.

::

    over = path((0, -5.25), (60, -5.25), (90, -1.75), (400, -1.75))
    scene = Scene(street("driving", "driving"), ego(along(-1.75), 15), actor("v", over, 15, start=10))
    store = store_of(tmp_path / "s.sgstore", {"cut_in": [scene]})

Positions are in metres, speeds in m/s, times in seconds, headings in degrees. An actor goes along a route, a
line of points, with a speed that is a number or a list of ``(time, speed)``, straight between them.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from graph_blocks import trace_info
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    element,
    lane,
    line,
    link,
    mark,
    section,
    width,
)

from sgstore.lang.help import looked_up
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import KIND_CODE, LIGHT_STATE_CODE, VEHICLE_LIGHTS
from sgstore.model.world import Entities, FrameBlock, MessageRefs, States, TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.lang.ir import Query
    from sgstore.lang.memory import FrameView
    from sgstore.maps.roads import RoadMap
    from sgstore.store import Sealed

Point = tuple[float, float]
Series = float | list[tuple[float, Any]]

SIZES: Final = {
    "car": (4.5, 1.9, 1.5),
    "van": (5.5, 2.0, 2.2),
    "truck": (10.0, 2.5, 3.5),
    "bus": (12.0, 2.5, 3.2),
    "motorcycle": (2.2, 0.8, 1.4),
    "bicycle": (1.8, 0.6, 1.7),
    "person": (0.5, 0.5, 1.8),
    "prop": (0.5, 0.5, 1.0),
    "traffic_light": (0.3, 0.3, 0.9),
}
"""Length, width and height of what an actor is; m."""

WIDTHS: Final = {"sidewalk": 2.0, "parking": 2.5, "shoulder": 2.5}
LANE: Final = 3.5
NO_MESSAGES: Final = MessageRefs(*(np.zeros(0, np.int64) for _ in range(5)))


# Actors -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Actor:
    """Somebody, or something, with a route and a speed along it."""

    name: str
    kind: str
    route: tuple[Point, ...]
    speed: Series = 0.0
    start: float = 0.0
    heading: float | None = None
    special: str = ""
    subkind: str = ""
    lights: Series | tuple[str, ...] | None = None
    shows: list[tuple[float, str]] | None = None
    steer: float = np.nan
    throttle: float = np.nan
    yaw_rate: float = np.nan
    static: bool = False
    map_ref: str = ""
    since: float = 0.0

    def driven(self, times: Any) -> dict[str, Any]:
        """Its motion as columns, one row a time."""
        points = np.array(self.route, float).reshape(-1, 2)
        steps = np.diff(points, axis=0)
        lengths = np.hypot(*steps.T)
        reached = np.concatenate([[0.0], np.cumsum(lengths)])
        speed = series(self.speed, times)
        gone = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(times))])
        along = np.clip(self.start + gone, 0, reached[-1])
        x, y = (np.interp(along, reached, points[:, i]) for i in range(2))
        leg = np.clip(np.searchsorted(reached, along, "right") - 1, 0, max(len(steps) - 1, 0))
        told = 0.0 if self.heading is None else np.radians(self.heading)
        on_way = (
            np.arctan2(steps[leg, 1], steps[leg, 0]) if len(steps) else np.full(len(times), told)
        )
        heading = on_way if self.heading is None else np.full(len(times), told)
        vx, vy = speed * np.cos(on_way), speed * np.sin(on_way)
        gain = np.gradient(speed, times)
        turned = np.gradient(np.unwrap(heading), times)
        return {
            "x": x,
            "y": y,
            "heading": heading,
            "vx": vx,
            "vy": vy,
            "ax": gain * np.cos(on_way),
            "ay": gain * np.sin(on_way),
            "yaw_rate": turned
            if np.isnan(self.yaw_rate)
            else np.radians(np.full(len(times), self.yaw_rate)),
        }

    def shown(self, times: Any) -> Any:
        """Codes of what a traffic light shows; -1 of others."""
        if self.shows is None:
            return np.full(len(times), -1, np.int8)
        since = np.searchsorted([t for t, _ in self.shows], times, "right") - 1
        return np.array([LIGHT_STATE_CODE[state] for _, state in self.shows], np.int8)[since]

    def lit(self, times: Any) -> Any:
        """Masks of a vehicle's lights; -1: not known."""
        if self.lights is None:
            return np.full(len(times), -1, np.int64)
        told = self.lights if isinstance(self.lights, list) else [(0.0, self.lights)]
        masks = np.array([sum(1 << VEHICLE_LIGHTS.index(n) for n in names) for _, names in told])
        return masks[np.searchsorted([t for t, _ in told], times, "right") - 1]


def actor(name: str, route: Any, speed: Series = 0.0, kind: str = "car", **other: Any) -> Actor:
    """An actor on a route: a point, or a line of points."""
    points = (route,) if isinstance(route[0], int | float) else tuple(route)
    return Actor(name, kind, points, speed, **other)


def ego(route: Any, speed: Series = 0.0, **other: Any) -> Actor:
    return actor("ego", route, speed, **other)


def light(name: str, at: Point, *shows: tuple[float, str]) -> Actor:
    """A traffic light of the map, and what it shows from when on."""
    return Actor(name, "traffic_light", (at,), shows=[*shows], map_ref=name)


def cone(name: str, at: Point, subkind: str = "cone") -> Actor:
    return Actor(name, "prop", (at,), subkind=subkind, static=True, heading=0.0)


def series(told: Series, times: Any) -> Any:
    if not isinstance(told, list):
        return np.full(len(times), float(told))
    return np.interp(times, [t for t, _ in told], [v for _, v in told])


def path(*points: Point) -> tuple[Point, ...]:
    return points


def along(y: float, start: float = 0.0, end: float = 400.0) -> tuple[Point, ...]:
    """Along a street, at a distance from its middle; against it if the start is beyond the end."""
    return ((start, y), (end, y))


def over(x: float, y: float, to: float) -> tuple[Point, ...]:
    """Across a street."""
    return ((x, y), (x, to))


# Roads ------------------------------------------------------------------------------------------------------


@cache
def street(
    *right: str,
    left: tuple[str, ...] = (),
    zebra: float | None = None,
    limit: float | None = None,
    cut: float | None = None,
) -> RoadMap:
    """A straight road from x = -100 to 400; types of its lanes from the middle outwards.

    Lanes to the right lead along x, those to the left against it. One may change between lanes of a side.
    ``limit``: of speed; m/s. ``cut``: x at which each lane goes on as another part of the map.
    """
    limits = () if limit is None else (element("speed", sOffset=0, max=limit, unit="m/s"),)

    def lanes(link: str = "") -> list[str]:
        found = [lane(0, mark("broken"))]
        for side, sign in ((right, -1), (left, 1)):
            for number, kind in enumerate(side, start=1):
                records = (width(WIDTHS.get(kind, LANE)), mark("broken", laneChange="both"))
                links: dict[str, Any] = {link: sign * number} if link else {}
                found.append(lane(sign * number, *records, *limits, kind=kind, **links))
        return found

    objects = crosswalk("zebra", zebra + 100, 0.0, 20.0) if zebra is not None else ""
    sections = section(*lanes())
    if cut is not None:
        sections = section(*lanes("after")) + section(*lanes("before"), s=cut + 100)
    road = a_road("1", line(500.0, x=-100.0), sections=sections, objects=objects)
    return read_map(a_map(road), "street")


def crosswalk(name: str, s: float, t: float, width_m: float) -> str:
    """A crosswalk across a road: 3 m along it."""
    corners = ((-1.5, -width_m / 2), (1.5, -width_m / 2), (1.5, width_m / 2), (-1.5, width_m / 2))
    outline = element("outline", *(element("cornerLocal", u=u, v=v, z=0) for u, v in corners))
    return element("object", outline, id=name, type="crosswalk", s=s, t=t, zOffset=0)


ARMS: Final = {"e": 0, "n": 90, "w": 180, "s": 270}
"""Where the arms of a crossroads lie, seen from its middle; degrees."""
MOUTH, NEAR, FAR = 12.0, 40.0, 140.0
"""Distances from the middle at which arms begin, have their second lane section, and end; m."""


@cache
def crossroads(signs: str = "", lanes: int = 1, inside: str = "") -> RoadMap:
    """Four arms of so many lanes to each side, and all ways through.

    ``signs``: ``light`` or ``stop`` at the end of each lane that leads in, named ``light-s`` and so on.
    ``inside``: they control the ways to these arms instead, as in the towns of CARLA.
    """
    parts, connections = [], []
    for number, (arm, turn) in enumerate(ARMS.items(), start=1):
        parts.append(_arm(arm, number, turn, signs, lanes, bool(inside)))
    for number, (come, go) in enumerate(((a, b) for a in ARMS for b in ARMS if a != b), start=10):
        parts.append(_way(number, come, go, lanes, signs if go in inside else ""))
        links = (element("laneLink", **{"from": i, "to": -i}) for i in range(1, lanes + 1))
        connections.append(
            element(
                "connection",
                *links,
                id=str(number),
                incomingRoad=_number(come),
                connectingRoad=str(number),
                contactPoint="start",
            )
        )
    junction = element("junction", *connections, id="9", name="crossroads")
    return read_map(a_map(*parts, junction), "crossroads")


def _number(arm: str) -> str:
    return str(1 + [*ARMS].index(arm))


def _arm(arm: str, number: int, turn: float, signs: str, lanes: int, inside: bool) -> str:
    def lanes_of(**links: int) -> list[str]:
        made = [lane(0, mark("broken"))]
        for i in range(1, lanes + 1):
            for ident in (i, -i):
                to = dict.fromkeys(links, ident)
                made.append(lane(ident, width(LANE), mark("broken", laneChange="both"), **to))
        return made

    at = np.radians(turn)
    plan = line(FAR - MOUTH, x=MOUTH * np.cos(at), y=MOUTH * np.sin(at), hdg=at)
    code = {"light": "1000001", "stop": "206", "": ""}[signs]
    signal = element(
        "signal",
        element("validity", fromLane=0, toLane=0) if inside else "",
        id=f"{signs}-{arm}",
        s=0.5,
        t=LANE * lanes + 1,
        type=code,
        orientation="-",
        dynamic="yes" if signs == "light" else "no",
        zOffset=3,
    )
    sections = section(*lanes_of(after=1), s=0) + section(*lanes_of(before=1), s=NEAR - MOUTH)
    return a_road(
        str(number),
        plan,
        sections=sections,
        links=link("predecessor", "junction", "9"),
        signals=signal if signs else "",
    )


def _way(number: int, come: str, go: str, lanes: int, signs: str) -> str:
    """The road from an arm to another, its reference line between the lanes of both directions."""
    at, turned = np.radians(ARMS[come]), (ARMS[go] - ARMS[come]) % 360
    pose = {"x": MOUTH * np.cos(at), "y": MOUTH * np.sin(at), "hdg": at + np.pi}
    quarter = MOUTH * np.pi / 2
    plan = {
        180: line(2 * MOUTH, **pose),
        90: arc(quarter, -1 / MOUTH, **pose),
        270: arc(quarter, 1 / MOUTH, **pose),
    }[turned]
    made = [lane(-i, width(LANE), before=i, after=-i) for i in range(1, lanes + 1)]
    links = link("predecessor", "road", _number(come), "start")
    links += link("successor", "road", _number(go), "start")
    sections = section(lane(0), *made)
    signals = element("signalReference", id=f"{signs}-{come}", s=0.5, t=0, orientation="+")
    return a_road(
        str(number),
        plan,
        sections=sections,
        links=links,
        junction="9",
        signals=signals if signs else "",
    )


def through(come: str, go: str, lane_number: int = 1, out: int = 0) -> tuple[Point, ...]:
    """The way of a vehicle over crossroads, 128 m before it and behind it."""
    aside, aside_out = (LANE * (n - 0.5) for n in (lane_number, out or lane_number))
    at, leaving = np.radians(ARMS[come]), np.radians(ARMS[go])

    def place(angle: float, outward: float, left: float) -> Point:
        cos, sin = np.cos(angle), np.sin(angle)
        return (outward * cos - left * sin, outward * sin + left * cos)

    first, last = place(at, MOUTH, aside), place(leaving, MOUTH, -aside_out)
    points = [place(at, FAR, aside), first]
    turned = (ARMS[go] - ARMS[come]) % 360
    if turned != 180:
        # Around the corner between both arms.
        corner = np.add(place(at, MOUTH, 0), place(leaving, MOUTH, 0))
        one, other = np.subtract(first, corner), np.subtract(last, corner)
        for share in np.linspace(0, 1, 9)[1:-1]:
            angle = share * np.pi / 2
            points.append(tuple((corner + one * np.cos(angle) + other * np.sin(angle)).tolist()))
    return (*points, last, place(leaving, FAR, -aside_out))


BEFORE: Final = FAR - MOUTH
"""How far it is along a way to the junction; m."""


# Scenes -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, init=False, eq=False)
class Scene:
    """A road map, actors, and how long they are watched.

    ``drawn``: the times at which it is drawn.
    """

    road: RoadMap
    actors: tuple[Actor, ...]
    seconds: float
    rate: float
    drawn: tuple[float, ...]

    def __init__(
        self,
        road: RoadMap,
        *actors: Actor,
        seconds: float = 8.0,
        rate: float = 5.0,
        drawn: tuple[float, ...] = (0.0,),
    ) -> None:
        for name, value in (
            ("road", road),
            ("actors", actors),
            ("seconds", seconds),
            ("rate", rate),
            ("drawn", drawn),
        ):
            object.__setattr__(self, name, value)

    def with_actor(self, name: str, **other: Any) -> Scene:
        """The same, but for what is told of one actor."""
        actors = (replace(a, **other) if a.name == name else a for a in self.actors)
        return Scene(self.road, *actors, seconds=self.seconds, rate=self.rate, drawn=self.drawn)

    def without(self, *names: str) -> Scene:
        """The same without some actors."""
        actors = (a for a in self.actors if a.name not in names)
        return Scene(self.road, *actors, seconds=self.seconds, rate=self.rate, drawn=self.drawn)

    @property
    def times(self) -> Any:
        """(F,) the times of its frames; s."""
        return np.arange(round(self.seconds * self.rate) + 1) / self.rate

    def block(self, number: int = 0, first: int = 0, seq: int = 0) -> FrameBlock:
        """Its frames, as those of the scene of a number in its trace.

        ``first``: node id of the first actor; the others follow in order. ``seq``: of the first frame.
        """
        times, moving = self.times, [i for i, a in enumerate(self.actors) if not a.static]
        columns = [self._states(i, times) for i in range(len(self.actors))]
        for i, column in enumerate(columns):
            column["node"] = np.full(len(times), first + i)
        here = np.array([times >= self.actors[i].since for i in moving])
        frame, row = np.nonzero(here.T)
        states = {n: np.array([columns[i][n] for i in moving]).T[frame, row] for n in columns[0]}
        standing = [i for i, a in enumerate(self.actors) if a.static]
        scenery = {n: np.array([columns[i][n][0] for i in standing]) for n in columns[0]}
        clock = np.round((times + number * APART) * 1e9).astype(np.int64)
        node = [a.name for a in self.actors].index("ego")
        return FrameBlock(
            seq=seq + np.arange(len(times)),
            time_ns=clock,
            log_time_ns=clock,
            offsets=np.concatenate([[0], np.cumsum(here.sum(axis=0))]).astype(np.int64),
            states=States.of(**_typed(states)),
            ego=np.full(len(times), first + node),
            entities=self._entities(number, first),
            scenery=States.of(**_typed(scenery)),
            messages=NO_MESSAGES,
        )

    def _states(self, index: int, times: Any) -> dict[str, Any]:
        of, count = self.actors[index], len(times)
        length, wide, height = SIZES[of.kind]
        return {
            **of.driven(times),
            "z": np.full(count, height / 2 + (3.0 if of.kind == "traffic_light" else 0.0)),
            "vz": np.zeros(count),
            "length": np.full(count, length),
            "width": np.full(count, wide),
            "height": np.full(count, height),
            "lights": of.lit(times),
            "light_state": of.shown(times),
            "steer": np.full(count, of.steer),
            "throttle": np.full(count, of.throttle),
        }

    def _entities(self, number: int, first: int) -> Entities:
        return Entities(
            first=first,
            ident=tuple(f"{a.name}.{number}" if number else a.name for a in self.actors),
            kind=np.array([KIND_CODE[a.kind] for a in self.actors], np.int8),
            special=tuple(a.special for a in self.actors),
            subkind=tuple(a.subkind for a in self.actors),
            type_name=("",) * len(self.actors),
            static=np.array([a.static for a in self.actors], np.bool_),
            map_ref=tuple(a.map_ref for a in self.actors),
        )


def _typed(columns: dict[str, Any]) -> dict[str, Any]:
    types = {"node": np.int64, "lights": np.int64, "light_state": np.int8}
    return {
        name: np.asarray(values).astype(types.get(name, np.float64))
        for name, values in columns.items()
    }


APART: Final = 1000.0
"""Time between the starts of two scenes of a trace; s."""


def store_of(
    where: Path,
    traces: Mapping[str, Sequence[Scene]],
    configs: Mapping[str, Config] | None = None,
) -> Store:
    """A store, which may be there already, with traces of scenes.

    A trace is of one road; its scenes follow one another, :data:`APART`, so that nothing lasts from one to the
    next. Things that never move stay, as they do in recordings. ``configs``: of traces that have one of their
    own.
    """
    file = StoreFile(where) if where.exists() else StoreFile.create(where)
    with ExitStack() as kept:
        sealed = [
            _sealed(file, number, name, scenes, (configs or {}).get(name, Config()), kept)
            for number, (name, scenes) in enumerate(traces.items())
        ]
        assert file.publish_each(sealed) == [*traces]
    return Store(where)


def seen_by(store: Store, frame: int, query: Query) -> FrameView:
    """The view of a frame that a pattern in memory has; made once for each scope of a store that stays open."""
    assert not looked_up(query), "what only the store knows is of one query"
    at = store, frame, query.world
    if at not in _views:
        _views[at] = store._view(store.file.frame(frame), query)
    return _views[at]


_views: dict[tuple[Store, int, bool], FrameView] = {}


def _sealed(
    file: StoreFile,
    number: int,
    name: str,
    scenes: Sequence[Scene],
    config: Config,
    kept: ExitStack,
) -> Sealed:
    info = trace_info(
        f"/scenes/{name}.mcap",
        digest=f"{number:064x}"[::-1],
        flavour="scene",
        channels=(),
        ego="ego",
        context=NO_MESSAGES,
    )
    road = scenes[0].road
    generator = SceneGraphGenerator(road, config)
    segment = file.segment(info, config, road_map=road, answers=generator.answers)
    kept.enter_context(segment)
    blocks, first, seq = list[FrameBlock](), 0, 0
    for place, scene in enumerate(scenes):
        blocks.append(scene.block(place, first, seq))
        first, seq = first + len(scene.actors), seq + len(blocks[-1])
    for block in generator.recorded(blocks):
        segment.append(generator.block(block))
    return segment.seal(TraceReport(frames=seq), None, (generator.parked, generator.world_parked))
