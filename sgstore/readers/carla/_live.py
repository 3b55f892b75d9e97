"""A live CARLA: frames of a ``carla.World``, and its sensors, in our axes, for the online mode and recording.

::

    live = LiveWorld(connect("localhost", 2000).get_world(), ego="hero")
    generator = SceneGraphGenerator(live.road_map, Config())
    while True:
        live.world.wait_for_tick()      # or live.world.tick(), if this client owns the clock
        graph = generator.step(live.frame())

CARLA's axes are left-handed (y to the right, yaw clockwise, angles in degrees): y and yaw change their
signs, and so does all that turns with them. An actor's own place is its origin, on the ground under a vehicle;
ours is the centre of its box. Poses and velocities come from one snapshot of the world, so that they belong to
one instant and cost no round trip for each actor; what an actor is, is asked once.

Not run against a server: exercised with the wheel's own types and a world that stands in for one.

Source: CARLA 0.9.16, Python API reference; LibCarla ``geom/Rotation.h`` and ``geom/Transform.h`` for the order
of rotations; ros-bridge for the signs.
"""

from __future__ import annotations

import math
import queue
import re
import tomllib
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError, MissingExtraError, TraceError
from sgstore.opendrive import read_map
from sgstore.readers.carla._signals import AtOnce, Light, light_state, shared_signals, signals_of
from sgstore.readers.carla._survey import EGO_ROLES, meaning_of
from sgstore.step import Frame
from sgstore.vocabulary import KIND_CODE, LIGHT_STATE_CODE, SIGNALS, VEHICLES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.roads import RoadMap
    from sgstore.vocabulary import TypeMeaning


ENTITIES: Final = ("vehicle.", "walker.", "traffic.", "static.")
"""How the types of actors begin that are entities; others are sensors, controllers and the spectator."""

SCENERY: Final[Mapping[str, tuple[str, str]]] = {
    "Buildings": ("building", ""),
    "Bridge": ("building", "bridge"),
    "Fences": ("barrier", "fence"),
    "Walls": ("barrier", "wall"),
    "GuardRail": ("barrier", "guard_rail"),
    "Poles": ("pole", ""),
    "Vegetation": ("vegetation", ""),
    "TrafficSigns": ("sign", ""),
    "Static": ("prop", ""),
    "Dynamic": ("prop", ""),
    "Other": ("prop", ""),
    "Car": ("car", ""),
    "Truck": ("truck", ""),
    "Bus": ("bus", ""),
    "Train": ("train", ""),
    "Vehicles": ("vehicle", ""),
    "Motorcycle": ("motorcycle", ""),
    "Bicycle": ("bicycle", ""),
    "Pedestrians": ("person", ""),
}
"""``CityObjectLabel`` of an environment object → kind and subkind. What is not named is ground, sky, water and
marks upon the road, or a traffic light, which is an actor too."""

MOVING: Final = (*VEHICLES, "person", "animal")
"""Kinds that move, if only they wanted to: a parked car of the level has a state in every frame."""

LIGHTS: Final = (
    (0x20, "light_left"),
    (0x10, "light_right"),
    (0x8, "light_brake"),
    (0x40, "light_reverse"),
    (0x1, "light_position"),
    (0x2, "light_low_beam"),
    (0x4, "light_high_beam"),
    (0x80, "light_fog"),
    (0x100, "light_interior"),
    (0x200, "light_special1"),
    (0x400, "light_special2"),
)
"""Bits of ``VehicleLightState`` → lights of a vehicle."""

SAME_PLACE: Final = 1.0
"""How far a sign may stand from the signal of the map that it is; m."""

TIMEOUT_S: Final = 10.0
"""How long to wait for a server."""

TRAFFIC_LIGHT: Final = "traffic.traffic_light"

_NAN: Final = math.nan
_STILL: Final = ("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate")
_NO_BOX: Final = (0.0, 0.0, 0.0, _NAN, _NAN, _NAN, 0.0)


def connect(host: str = "localhost", port: int = 2000, timeout_s: float = TIMEOUT_S) -> Any:
    """A ``carla.Client`` that is connected to a server.

    Raises
    ------
    MissingExtraError
        The package ``carla`` is not installed.
    TraceError
        No server answers there, or it is not of the client's version.
    """
    try:
        import carla
    except ImportError as error:
        raise MissingExtraError("reading a live CARLA", "carla") from error
    try:
        client = carla.Client(host, port)
        client.set_timeout(timeout_s)
        server, own = str(client.get_server_version()), str(client.get_client_version())
    except RuntimeError as error:  # what the client raises, whatever went wrong
        raise TraceError(f"no CARLA server answers at {host}:{port}: {error}") from error
    if server.split(".")[:2] != own.split(".")[:2]:
        reason = (
            f"the CARLA server at {host}:{port} is version {server}, the installed package {own}"
        )
        raise TraceError(f"{reason}; install the one that belongs to the server")
    return client


@dataclass(frozen=True, slots=True)
class _Actor:
    """Properties of an actor that do not change.

    Attributes
    ----------
    handle : carla.Actor
        For what no snapshot tells: what a light shows, the inputs of the ego.
    type_name, role : str
    meaning : TypeMeaning
    box : tuple of float
        Its box in its own axes, as CARLA has them: centre, half extents, yaw; NaN where it has none.
    map_ref : str
        Signal of the map that it is.
    """

    handle: Any
    type_name: str
    role: str
    meaning: TypeMeaning
    box: tuple[float, ...]
    map_ref: str


class LiveWorld:
    """A world of CARLA, read frame by frame.

    Parameters
    ----------
    world : carla.World
    ego : str
        Id or role name of the ego; empty: a vehicle with the role ``hero`` or ``ego_vehicle``.
    scenery : bool
        Whether buildings, poles, vegetation and parked vehicles of the level are entities, too.

    Attributes
    ----------
    world : carla.World
    map_text, map_name : str
        The road map as OpenDRIVE, and what the simulator calls it.

    Raises
    ------
    TraceError
        The world has no road map.
    """

    def __init__(self, world: Any, ego: str = "", *, scenery: bool = True) -> None:
        self.world = world
        carla_map = world.get_map()
        self.map_text = str(carla_map.to_opendrive())
        self.map_name = str(carla_map.name).rpartition("/")[2]
        if not self.map_text.strip():
            raise TraceError("the world of the CARLA server has no road map")
        self._wanted = ego
        self._actors: dict[int, _Actor | None] = {}
        self._heads: dict[int, str] = {}
        self._at_once: AtOnce | None = None
        self._scenery = scenery
        self._told = False

    @cached_property
    def road_map(self) -> RoadMap:
        """The road map; read when it is first asked for.

        Raises
        ------
        MapError
            It is no OpenDRIVE map.
        """
        return read_map(self.map_text, self.map_name)

    @property
    def warnings(self) -> list[str]:
        """Oddities up to now: traffic lights that cannot be what they were taken for."""
        if self._at_once is None:
            return []
        return [*shared_signals(self._heads, self.road_map), *self._at_once.warnings]

    def frame(self, snapshot: Any = None) -> Frame:
        """Frame of the world as it is now.

        Parameters
        ----------
        snapshot : carla.WorldSnapshot, optional
            As ``wait_for_tick`` and ``on_tick`` give it; by default the latest one.

        Returns
        -------
        Frame
            Actors and vehicles of the level; the first frame has the scenery, too.

        Raises
        ------
        TraceError
            The server does not answer any more.
        """
        try:
            return self._frame(self.world.get_snapshot() if snapshot is None else snapshot)
        except RuntimeError as error:  # what the client raises, whatever went wrong
            raise TraceError(f"the CARLA server does not answer: {error}") from error

    def find_ego(self) -> Any:
        """The ego as a ``carla.Vehicle``, without making a frame; ``None`` if there is none."""
        try:
            here = self._here({state.id for state in self.world.get_snapshot()})
        except RuntimeError as error:
            raise TraceError(f"the CARLA server does not answer: {error}") from error
        ego = self._ego_of(here)
        return None if ego is None else here[ego].handle

    def _here(self, present: set[int]) -> dict[int, _Actor]:
        """The actors that are entities."""
        self._look(present)
        return {i: a for i in sorted(present) if (a := self._actors[i]) is not None}

    def _frame(self, snapshot: Any) -> Frame:
        states = {state.id: state for state in snapshot}
        here = self._here(set(states))
        ego = self._ego_of(here)
        frame = Frame(round(snapshot.timestamp.elapsed_seconds * 1e9), ego)
        lights = self.world.get_vehicles_light_states()
        for ident, actor in here.items():
            inputs = _controls(actor) if ident == ego else {}
            _add_actor(frame, ident, actor, states[ident], lights.get(ident), inputs)
        if self._scenery:
            self._add_scenery(frame)
        self._watch(here)
        return frame

    def _look(self, present: set[int]) -> None:
        """Ask about the actors that are new, and forget those that are gone."""
        for ident in self._actors.keys() - present:
            del self._actors[ident]
            self._heads.pop(ident, None)
        if present <= self._actors.keys():
            return
        new = {a.id: a for a in self.world.get_actors() if a.id not in self._actors}
        told = {ident: a for ident, a in new.items() if str(a.type_id).startswith(ENTITIES)}
        signals = self._signals(told)
        for ident in present - self._actors.keys():
            handle = told.get(ident)
            # One that is in the snapshot but not in the list is on its way out.
            self._actors[ident] = (
                None if handle is None else _described(handle, signals.get(ident, ""))
            )

    def _ego_of(self, actors: dict[int, _Actor]) -> int | None:
        if self._wanted.isdecimal() and int(self._wanted) in actors:
            return int(self._wanted)
        for role in (self._wanted,) if self._wanted else EGO_ROLES:
            found = [ident for ident, actor in actors.items() if actor.role == role]
            if found:
                return min(found)
        return None

    def _signals(self, actors: Mapping[int, Any]) -> dict[int, str]:
        """Ids of the signals of the map that lights and signs are.

        A light knows its own. One that does not is found as in a recording
        (:mod:`sgstore.readers.carla._signals`), by the lanes of its stop waypoints where its place does not
        tell.
        """
        found: dict[int, str] = {}
        lights: dict[int, Light] = {}
        for ident, actor in actors.items():
            if not str(actor.type_id).startswith("traffic."):
                continue
            if str(actor.type_id) != TRAFFIC_LIGHT:
                place = actor.get_transform().location
                found[ident] = self._sign_at(place.x, -place.y)
            elif (told := str(actor.get_opendrive_id())) in self._light_ids:
                self._heads[ident] = told
            else:
                lights[ident] = _light(actor)
        # Those that were met before keep what they are, and no other light is that.
        self._heads = signals_of(lights, self.road_map, self._heads) if lights else self._heads
        return found | self._heads

    def _watch(self, here: Mapping[int, _Actor]) -> None:
        """Take note of what the lights show."""
        heads = [ident for ident, actor in here.items() if actor.type_name == TRAFFIC_LIGHT]
        if not heads:
            return
        if self._at_once is None or self._at_once.idents != heads:
            self._at_once = AtOnce(self._heads, self.road_map, heads, self._at_once)
        shown = (LIGHT_STATE_CODE[_shown(here[ident].handle)] for ident in heads)
        self._at_once.see(np.fromiter(shown, np.int64, len(heads)))

    @cached_property
    def _light_ids(self) -> frozenset[str]:
        nodes = self.road_map.nodes
        rows = np.flatnonzero(nodes.kind == KIND_CODE["traffic_light"]).tolist()
        return frozenset(nodes.name[row] for row in rows)

    @cached_property
    def _sign_rows(self) -> NDArray[np.intp]:
        codes = [KIND_CODE[kind] for kind in SIGNALS if kind != "traffic_light"]
        return np.flatnonzero(np.isin(self.road_map.nodes.kind, codes))

    def _sign_at(self, x: float, y: float) -> str:
        """The sign of the map that stands at a place; empty if none does."""
        nodes, rows = self.road_map.nodes, self._sign_rows
        if not len(rows):
            return ""
        apart = np.hypot(nodes.x[rows] - x, nodes.y[rows] - y)
        nearest = int(np.argmin(apart))
        return nodes.name[rows[nearest]] if apart[nearest] <= SAME_PLACE else ""

    def _add_scenery(self, frame: Frame) -> None:
        """The objects of the level: those that stand, once; vehicles and people that are part of it, always."""
        for ident, kind, place, more in self._level:
            moves = kind in MOVING
            if moves or not self._told:
                frame.add(ident, kind, *place, static=not moves, **more)
        self._told = True

    @cached_property
    def _level(self) -> list[tuple[str, str, tuple[float, float, float], dict[str, Any]]]:
        """Id, kind, place and what else there is of the objects of the level; boxes are in the world's axes."""
        found: list[tuple[str, str, tuple[float, float, float], dict[str, Any]]] = []
        for thing in self.world.get_environment_objects():
            label = str(thing.type)
            if label not in SCENERY:
                continue
            kind, subkind = SCENERY[label]
            box, half = thing.bounding_box, thing.bounding_box.extent
            place = (box.location.x, 0.0 - box.location.y, box.location.z)
            more: dict[str, Any] = {
                "heading": 0.0 - box.rotation.yaw,
                "length": 2 * half.x,
                "width": 2 * half.y,
                "height": 2 * half.z,
                "subkind": subkind,
                "type_name": label,
            }
            if kind == "sign":
                more["map_ref"] = self._sign_at(*place[:2])
            if kind in MOVING:
                more |= dict.fromkeys(_STILL, 0.0)
            found.append((f"level:{thing.id}", kind, place, more))
        return found


def _described(handle: Any, map_ref: str) -> _Actor:
    """Ask an actor for its properties that do not change."""
    type_name = str(handle.type_id)
    return _Actor(
        handle=handle,
        type_name=type_name,
        role=str(handle.attributes.get("role_name", "")),
        meaning=meaning_of(type_name),
        box=_box(getattr(handle, "bounding_box", None)),
        map_ref=map_ref,
    )


def _box(box: Any) -> tuple[float, ...]:
    """Centre, half extents and yaw of an actor's box; a light has none, and one of no size at all is none."""
    if box is None or not (box.extent.x or box.extent.y or box.extent.z):
        return _NO_BOX
    place, half = box.location, box.extent
    return (place.x, place.y, place.z, half.x, half.y, half.z, box.rotation.yaw)


def _add_actor(
    frame: Frame, ident: int, actor: _Actor, state: Any, lights: Any, inputs: dict[str, Any]
) -> None:
    transform, turn = state.get_transform(), state.get_transform().rotation
    is_light = actor.type_name == TRAFFIC_LIGHT
    static = not is_light and actor.type_name.startswith(("traffic.", "static."))
    # The box of a light is the volume that triggers it, on the road: a light stands where its mast stands.
    x, y, z, length, width, height, yaw = _NO_BOX if is_light else actor.box
    frame.add(
        *(ident, actor.meaning.kind, *in_world((x, y, z), transform)),
        heading=0.0 - (turn.yaw + yaw),
        pitch=0.0 - turn.pitch,
        roll=turn.roll,
        length=2 * length,
        width=2 * width,
        height=2 * height,
        lights=None if lights is None else [name for bit, name in LIGHTS if int(lights) & bit],
        light_state=_shown(actor.handle) if is_light else None,
        special=actor.meaning.special,
        subkind=actor.meaning.subkind,
        type_name=actor.type_name,
        static=static,
        map_ref=actor.map_ref,
        **({} if is_light or static else _motion(state)),
        **inputs,
    )


def _motion(state: Any) -> dict[str, Any]:
    """Velocity, acceleration and yaw rate of an actor."""
    velocity, acceleration = state.get_velocity(), state.get_acceleration()
    return {
        "vx": velocity.x,
        "vy": 0.0 - velocity.y,
        "vz": velocity.z,
        "ax": acceleration.x,
        "ay": 0.0 - acceleration.y,
        "az": acceleration.z,
        "yaw_rate": 0.0 - state.get_angular_velocity().z,
    }


def in_world(point: tuple[float, float, float], transform: Any) -> tuple[float, float, float]:
    """A point in the axes of a ``carla.Transform`` as one of the map, in our axes; m."""
    x, y, z = point
    turn, place = transform.rotation, transform.location
    sin_p, cos_p = math.sin(math.radians(turn.pitch)), math.cos(math.radians(turn.pitch))
    sin_y, cos_y = math.sin(math.radians(turn.yaw)), math.cos(math.radians(turn.yaw))
    sin_r, cos_r = math.sin(math.radians(turn.roll)), math.cos(math.radians(turn.roll))
    return (
        place.x
        + x * cos_p * cos_y
        + y * (cos_y * sin_p * sin_r - sin_y * cos_r)
        - z * (cos_y * sin_p * cos_r + sin_y * sin_r),
        0.0
        - (
            place.y
            + x * cos_p * sin_y
            + y * (sin_y * sin_p * sin_r + cos_y * cos_r)
            - z * (sin_y * sin_p * cos_r - cos_y * sin_r)
        ),
        place.z + x * sin_p - y * cos_p * sin_r + z * cos_p * cos_r,
    )


def _controls(actor: _Actor) -> dict[str, Any]:
    """Inputs of a vehicle; CARLA steers to the right."""
    if not actor.type_name.startswith("vehicle."):
        return {}
    control = actor.handle.get_control()
    return {
        "steer": 0.0 - control.steer,
        "throttle": control.throttle,
        "brake": control.brake,
        "gear": control.gear,
        "hand_brake": control.hand_brake,
    }


def _shown(light: Any) -> str:
    return light_state(int(light.state))


def _light(actor: Any) -> Light:
    """A light as the search for its signal wants it: where it stands, and each place where it stops traffic."""
    transform = actor.get_transform()
    place, heading = transform.location, math.radians(-transform.rotation.yaw)
    stops: list[tuple[float, ...]] = []
    for waypoint in list(actor.get_stop_waypoints()):
        at = waypoint.transform
        turn = math.radians(-at.rotation.yaw)
        stops.append((at.location.x, -at.location.y, at.location.z, turn, 1.0, 1.0))
    return Light(place.x, -place.y, place.z, heading, tuple(stops))


# Sensors, attached to the ego, and what they measure, in our axes ----------------------------------
# What a sensor measures comes from threads of the client's own, so it goes into a queue of a bounded length.
# If that is full the sensor waits, and with it the stream from the server; what cannot wait is dropped and
# counted.
#
# Source: CARLA 0.9.16, Python API reference, "Sensors reference".

QUEUE: Final = 128
"""Measurements that may wait to be written."""
PATIENCE_S: Final = 5.0
"""How long a measurement waits for room in the queue; s."""
MAX_CONFIG_BYTES: Final = 1 << 20

LIDAR: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
SEMANTIC_LIDAR: Final = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("cos_angle", "<f4"),
        ("object", "<u4"),
        ("tag", "<u4"),
    ]
)
RADAR: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("velocity", "<f4")])
"""Points of the sensors, in the sensor's own axes: x ahead, y to the left, z up; m, m/s (away)."""

_POSE: Final = ("x", "y", "z", "roll", "pitch", "yaw")
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True)
class SensorPicture:
    """Picture of a camera: (height, width, 3) uint8, red green blue; ``fov``: across, degrees."""

    pixels: np.ndarray[Any, np.dtype[np.uint8]]
    fov: float


@dataclass(frozen=True, slots=True)
class SensorCloud:
    """Points: rows of :data:`LIDAR`, :data:`SEMANTIC_LIDAR` or :data:`RADAR`."""

    points: np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True, slots=True)
class SensorReading:
    """One measurement.

    Attributes
    ----------
    sensor : str
        Name of the sensor.
    time_ns : int
        Simulation time; ns.
    data : SensorPicture, SensorCloud or dict
        A dictionary: numbers and texts by name, for whatever is neither picture nor points.
    """

    sensor: str
    time_ns: int
    data: SensorPicture | SensorCloud | dict[str, Any]


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor to be attached to the ego.

    Attributes
    ----------
    name : str
        What its channel is called after.
    type : str
        Blueprint: ``sensor.camera.rgb``, ``sensor.lidar.ray_cast``, …
    x, y, z, roll, pitch, yaw : float
        Where it sits in the ego's axes, which are ours: x ahead, y to the left, z up, yaw counter-clockwise;
        from the ego's origin, on the ground; m, degrees.
    attributes : dict
        Attributes of the blueprint: ``image_size_x``, ``fov``, ``sensor_tick`` (seconds between
        measurements), …
    """

    name: str
    type: str
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    attributes: dict[str, str] = field(default_factory=dict[str, str])


def load_sensors(path: Path) -> list[Sensor]:
    """The sensors that a TOML file lists, each in a table ``[[sensor]]``.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or lists something that is no sensor.
    """
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise ConfigError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes, which no config is")
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    listed = tables.get("sensor")
    if set(tables) != {"sensor"} or not isinstance(listed, list):
        raise ConfigError(f"{path}: expected tables [[sensor]] and nothing else")
    sensors = [_sensor(f"{path}: sensor {i}", table) for i, table in enumerate(listed, start=1)]
    names = [sensor.name for sensor in sensors]
    if len(set(names)) < len(names):
        raise ConfigError(f"{path}: two sensors have the same name; each needs one of its own")
    return sensors


def _sensor(where: str, table: Any) -> Sensor:
    known = {"name", "type", "attributes", *_POSE}
    if not isinstance(table, dict) or not set(table) <= known:
        raise ConfigError(f"{where}: expected a table of {', '.join(sorted(known))}")
    name, kind = table.get("name"), table.get("type")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(f"{where}: 'name' is {name!r}; expected letters, digits and -._")
    if not isinstance(kind, str) or not kind.startswith("sensor."):
        raise ConfigError(
            f"{where}: 'type' is {kind!r}; expected a blueprint: sensor.camera.rgb, …"
        )
    pose = {part: table.get(part, 0.0) for part in _POSE}
    for part, value in pose.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise ConfigError(f"{where}: {part!r} is {value!r}; expected a number")
    attributes = table.get("attributes", {})
    if not isinstance(attributes, dict):
        raise ConfigError(f"{where}: 'attributes' is {attributes!r}; expected a table")
    return Sensor(
        name=name,
        type=kind,
        attributes={str(key): str(value) for key, value in attributes.items()},
        **{part: float(value) for part, value in pose.items()},
    )


class Sensors:
    """Sensors that are attached to an ego, until they are closed.

    Parameters
    ----------
    world : carla.World
    ego : carla.Actor or None
    sensors : sequence of Sensor

    Attributes
    ----------
    dropped : int
        Measurements that were lost: there was no room in time, or they are not what was expected.
    reason : str
        Why the last one was not what was expected; empty if all were.

    Raises
    ------
    TraceError
        There is no ego, the world has no such blueprint or attribute, or no room for a sensor.
    """

    def __init__(self, world: Any, ego: Any, sensors: list[Sensor]) -> None:
        self.dropped = 0
        self.reason = ""
        self._queue: queue.Queue[SensorReading] = queue.Queue(QUEUE)
        self._actors: list[Any] = []
        if ego is None:
            raise TraceError(
                "no vehicle is the ego, so none can carry sensors; name one by its id or role"
            )
        try:
            for sensor in sensors:
                self._attach(world, ego, sensor)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Sensors:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the sensors and take them out of the world."""
        for actor in self._actors:
            actor.stop()
            actor.destroy()
        self._actors.clear()

    def waiting(self, timeout_s: float = 0.0) -> Iterator[SensorReading]:
        """Take the readings that have been measured and not been taken yet.

        Parameters
        ----------
        timeout_s : float
            How long to wait for the first; s.
        """
        try:
            yield self._queue.get(timeout=timeout_s) if timeout_s else self._queue.get_nowait()
            while True:
                yield self._queue.get_nowait()
        except queue.Empty:
            return

    def _attach(self, world: Any, ego: Any, sensor: Sensor) -> None:
        import carla

        try:
            blueprint = world.get_blueprint_library().find(sensor.type)
            for name, value in sensor.attributes.items():
                if not blueprint.has_attribute(name):
                    raise TraceError(
                        f"sensor {sensor.name!r}: {sensor.type} has no attribute {name!r}"
                    )
                blueprint.set_attribute(name, value)
            # The other hand: y, and what turns about x's neighbours.
            place = carla.Location(sensor.x, -sensor.y, sensor.z)
            turn = carla.Rotation(pitch=-sensor.pitch, yaw=-sensor.yaw, roll=sensor.roll)
            pose = carla.Transform(place, turn)
            actor = world.spawn_actor(blueprint, pose, attach_to=ego)
        except (RuntimeError, IndexError) as error:
            raise TraceError(f"sensor {sensor.name!r} ({sensor.type}): {error}") from error
        self._actors.append(actor)
        actor.listen(partial(self._take, sensor.name))

    def _take(self, name: str, data: Any) -> None:
        """Called by threads of the client's: what is raised here is seen by nobody."""
        try:
            self._queue.put(reading_of(name, data), timeout=PATIENCE_S)
        except queue.Full:
            self.dropped += 1
        except (ValueError, TypeError, AttributeError) as error:
            self.dropped += 1
            self.reason = f"a measurement of {name!r} cannot be read: {error}"


def reading_of(name: str, data: Any) -> SensorReading:
    """Reading of a ``carla.SensorData`` of any kind."""
    time_ns = round(data.timestamp * 1e9)
    kind = type(data).__name__
    if hasattr(data, "fov") and hasattr(data, "raw_data"):
        raw = np.frombuffer(data.raw_data, np.uint8).reshape(data.height, data.width, -1)
        return SensorReading(
            name, time_ns, SensorPicture(np.ascontiguousarray(raw[:, :, 2::-1]), data.fov)
        )
    if "Lidar" in kind:
        layout = SEMANTIC_LIDAR if "Semantic" in kind else LIDAR
        points = np.frombuffer(data.raw_data, layout).copy()
        points["y"] = 0.0 - points["y"]
        return SensorReading(name, time_ns, SensorCloud(points))
    if "Radar" in kind:
        return SensorReading(name, time_ns, SensorCloud(_radar(data)))
    return SensorReading(name, time_ns, _values(data))


def _radar(data: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """Detections, which are velocity, altitude, azimuth (clockwise; rad) and depth, as points."""
    told = np.frombuffer(data.raw_data, "<f4").reshape(-1, 4).astype(np.float64)
    velocity, altitude, azimuth, depth = told.T
    points = np.zeros(len(told), RADAR)
    points["x"] = depth * np.cos(altitude) * np.cos(azimuth)
    points["y"] = 0.0 - depth * np.cos(altitude) * np.sin(azimuth)
    points["z"] = depth * np.sin(altitude)
    points["velocity"] = velocity
    return points


def _values(data: Any) -> dict[str, Any]:
    """Public values, by name, of the data of an inertial unit, a receiver of satellites, or an event."""
    found: dict[str, Any] = {"type": type(data).__name__}
    for name in dir(data):
        if name.startswith("_") or name in {"transform", "frame_number", "raw_data", "timestamp"}:
            continue
        value = getattr(data, name)
        if isinstance(value, (bool, int, float, str)):
            found[name] = value
        elif hasattr(value, "x") and hasattr(value, "y") and hasattr(value, "z"):
            found[name] = _vector(name, value)
        elif hasattr(value, "type_id"):
            found[name] = {"id": value.id, "type": str(value.type_id)}
        elif isinstance(value, list):
            found[name] = [str(getattr(item, "type", item)) for item in value]
    return found


def _vector(name: str, value: Any) -> dict[str, float]:
    """A vector in our axes; turning about x and z changes its sign, a push along y does."""
    if "gyroscope" in name:
        return {"x": 0.0 - value.x, "y": value.y, "z": 0.0 - value.z}
    return {"x": value.x, "y": 0.0 - value.y, "z": value.z}
