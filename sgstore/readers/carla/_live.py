"""Access to a running CARLA simulator: frames of its world and sensor data, in the axes of sgstore.

::

    live = LiveWorld(connect("localhost", 2000).get_world(), ego="hero")
    generator = SceneGraphGenerator(live.road_map, Config())
    while True:
        live.world.wait_for_tick()      # or live.world.tick(), if this client owns the clock
        graph = generator.step(live.frame())

CARLA's axes are left-handed (y to the right, yaw clockwise, angles in degrees). y, yaw and all dependent values
therefore change their signs. The position of an actor is its origin, which is on the ground below a vehicle; in
sgstore, it is the centre of the box. Poses and velocities come from one snapshot of the world. They belong to
one instant and need no request per actor. Constant properties of an actor are requested once.

Not tested with a server: the tests use the types of the ``carla`` wheel and a simulated world.

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
from sgstore.graphs.online import Frame
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import KIND_CODE, LIGHT_STATE_CODE, VEHICLES, type_meanings
from sgstore.readers.carla._signals import (
    AtOnce,
    Light,
    light_state,
    shared_signals,
    sign_at,
    signals_of,
)
from sgstore.readers.carla._survey import EGO_ROLES, meaning_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.vocabulary import TypeMeaning


ENTITIES: Final = ("vehicle.", "walker.", "traffic.", "static.")
"""Prefixes of actor types that are entities. Others are sensors, controllers and the spectator."""

MOVING: Final = (*VEHICLES, "person", "animal")
"""Kinds of objects that can move. A parked car in the level therefore has a state in every frame."""

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
"""Bit of ``VehicleLightState`` → light of a vehicle."""

TIMEOUT_S: Final = 10.0
"""Time limit for the answer of a server; s."""

TRAFFIC_LIGHT: Final = "traffic.traffic_light"

_NAN: Final = math.nan
_STILL: Final = ("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate")
_NO_BOX: Final = (0.0, 0.0, 0.0, _NAN, _NAN, _NAN, 0.0)


def connect(host: str = "localhost", port: int = 2000, timeout_s: float = TIMEOUT_S) -> Any:
    """Connect to a CARLA server, and return a ``carla.Client``.

    Raises
    ------
    MissingExtraError
        The package ``carla`` is not installed.
    TraceError
        The server does not answer, or has another version than the client.
    """
    try:
        import carla
    except ImportError as error:
        raise MissingExtraError("reading a live CARLA", "carla") from error
    try:
        client = carla.Client(host, port)
        client.set_timeout(timeout_s)
        server, own = str(client.get_server_version()), str(client.get_client_version())
    except RuntimeError as error:  # The client raises this for any fault.
        raise TraceError(f"no CARLA server answers at {host}:{port}: {error}") from error
    if server.split(".")[:2] != own.split(".")[:2]:
        reason = (
            f"the CARLA server at {host}:{port} is version {server}, the installed package {own}"
        )
        raise TraceError(f"{reason}; install the version of the server")
    return client


@dataclass(frozen=True, slots=True)
class _Actor:
    """Properties of a CARLA actor that do not change, such as type and bounding box.

    Attributes
    ----------
    handle : carla.Actor
        For values missing in snapshots: light states, control inputs.
    type_name, role : str
    meaning : TypeMeaning
    box : tuple of float
        Its box in its own CARLA axes: centre, half extents, yaw; NaN without a box.
    map_ref : str
        Its signal in the map.
    """

    handle: Any
    type_name: str
    role: str
    meaning: TypeMeaning
    box: tuple[float, ...]
    map_ref: str


class LiveWorld:
    """Reader of frames from the world of a running CARLA simulator.

    Parameters
    ----------
    world : carla.World
    ego : str
        Id or role name of the ego; empty: a vehicle with the role ``hero`` or ``ego_vehicle``.
    scenery : bool
        True: buildings, poles, vegetation and parked vehicles of the level become entities, too.

    Attributes
    ----------
    world : carla.World
    map_text, map_name : str
        The road map as OpenDRIVE, and its name in the simulator.
    commands : dict
        Commanded control inputs of the ego for the next frames, by name; empty by default. The client sets
        them, because a simulator returns only the applied ones.

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
        self.commands: Mapping[str, float | bool | str] = {}

    @cached_property
    def road_map(self) -> RoadMap:
        """Road map of the CARLA world. It is parsed when first used.

        Raises
        ------
        MapError
            The text is not an OpenDRIVE map.
        """
        return read_map(self.map_text, self.map_name)

    @property
    def warnings(self) -> list[str]:
        """Warnings so far about traffic lights whose map signal may be wrong."""
        if self._at_once is None:
            return []
        return [*shared_signals(self._heads, self.road_map), *self._at_once.warnings]

    def frame(self, snapshot: Any = None) -> Frame:
        """Return the current frame of the CARLA world: all objects with pose and motion.

        Parameters
        ----------
        snapshot : carla.WorldSnapshot, optional
            Result of ``wait_for_tick`` or ``on_tick``. Default: the latest snapshot.

        Returns
        -------
        Frame
            Actors and vehicles of the level. The first frame also contains the scenery.

        Raises
        ------
        TraceError
            The server no longer answers.
        """
        try:
            return self._frame(self.world.get_snapshot() if snapshot is None else snapshot)
        except RuntimeError as error:  # The client raises this for any fault.
            raise TraceError(f"the CARLA server does not answer: {error}") from error

    def find_ego(self) -> Any:
        """Return the ego as a ``carla.Vehicle``, without reading a new frame; ``None`` without an ego."""
        try:
            here = self._here({state.id for state in self.world.get_snapshot()})
        except RuntimeError as error:
            raise TraceError(f"the CARLA server does not answer: {error}") from error
        ego = self._ego_of(here)
        return None if ego is None else here[ego].handle

    def _here(self, present: set[int]) -> dict[int, _Actor]:
        """Return those CARLA actors that are now objects of the scene, by actor id."""
        self._look(present)
        return {i: a for i in sorted(present) if (a := self._actors[i]) is not None}

    def _frame(self, snapshot: Any) -> Frame:
        states = {state.id: state for state in snapshot}
        here = self._here(set(states))
        ego = self._ego_of(here)
        frame = Frame(round(snapshot.timestamp.elapsed_seconds * 1e9), ego)
        lights = self.world.get_vehicles_light_states()
        for ident, actor in here.items():
            inputs = _controls(actor) | _spin(states[ident]) if ident == ego else {}
            if ident == ego and self.commands:
                inputs["control"] = self.commands
            _add_actor(frame, ident, actor, states[ident], lights.get(ident), inputs)
        if self._scenery:
            self._add_scenery(frame)
        self._watch(here)
        return frame

    def _look(self, present: set[int]) -> None:
        """Request the properties of new CARLA actors, and forget actors that have disappeared."""
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
            # An actor in the snapshot but not in the list is being removed.
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
        """Return the map signal of each traffic light and sign: actor id → id of the signal.

        A light may know its signal. Otherwise, it is matched as in a recording
        (:mod:`sgstore.readers.carla._signals`), by position or by the lanes of its stop waypoints.
        """
        found: dict[int, str] = {}
        lights: dict[int, Light] = {}
        for ident, actor in actors.items():
            if not str(actor.type_id).startswith("traffic."):
                continue
            if str(actor.type_id) != TRAFFIC_LIGHT:
                place = actor.get_transform().location
                found[ident] = sign_at(self.road_map, place.x, -place.y)
            elif (told := str(actor.get_opendrive_id())) in self._light_ids:
                self._heads[ident] = told
            else:
                lights[ident] = _light(actor)
        # Known lights keep their signals, which are not assigned to other lights.
        self._heads = signals_of(lights, self.road_map, self._heads) if lights else self._heads
        return found | self._heads

    def _watch(self, here: Mapping[int, _Actor]) -> None:
        """Check whether traffic lights contradict each other: red and green for the same lane."""
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

    def _add_scenery(self, frame: Frame) -> None:
        """Add the objects of the CARLA level to a frame. Static ones are added only once."""
        for ident, kind, place, more in self._level:
            moves = kind in MOVING
            if moves or not self._told:
                frame.add(ident, kind, *place, static=not moves, **more)
        self._told = True

    @cached_property
    def _level(self) -> list[tuple[str, str, tuple[float, float, float], dict[str, Any]]]:
        """Return the objects in the CARLA level with id, kind, position and other properties."""
        found: list[tuple[str, str, tuple[float, float, float], dict[str, Any]]] = []
        for thing in self.world.get_environment_objects():
            label = str(thing.type)
            meaning = type_meanings().get(f"level_{label}".lower())
            if meaning is None:
                continue
            kind, subkind = meaning.kind, meaning.subkind
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
                more["map_ref"] = sign_at(self.road_map, *place[:2])
            if kind in MOVING:
                more |= dict.fromkeys(_STILL, 0.0)
            found.append((f"level:{thing.id}", kind, place, more))
        return found


def _described(handle: Any, map_ref: str) -> _Actor:
    """Request from the server the properties of a CARLA actor that do not change."""
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
    """Return centre, half extents and yaw of a CARLA actor's bounding box; NaN without a box.

    A traffic light or a box of size 0 also gives NaN.
    """
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
    # The box of a light is its trigger volume on the road. The position of a light is that of its mast.
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
    """Return velocity, acceleration and yaw rate of a CARLA actor."""
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


def _spin(state: Any) -> dict[str, float]:
    """Return the angular velocity of a CARLA actor about the map's x and y axes; degrees/s."""
    spin = state.get_angular_velocity()
    return {"ang_vel_x": 0.0 - spin.x, "ang_vel_y": spin.y}


def in_world(point: tuple[float, float, float], transform: Any) -> tuple[float, float, float]:
    """Convert a point from the axes of a ``carla.Transform`` into map axes; m."""
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
    """Return the control inputs (steering, throttle, brake, …) of a CARLA vehicle.

    The sign of the steering is inverted.
    """
    if not actor.type_name.startswith("vehicle."):
        return {}
    control = actor.handle.get_control()
    return {
        "steer": 0.0 - control.steer,
        "throttle": control.throttle,
        "brake": control.brake,
        "gear": control.gear,
        "hand_brake": control.hand_brake,
        "manual_gear": control.manual_gear_shift,
    }


def _shown(light: Any) -> str:
    return light_state(int(light.state))


def _light(actor: Any) -> Light:
    """Return the pose and stop positions of a CARLA traffic light, to find its map signal."""
    transform = actor.get_transform()
    place, heading = transform.location, math.radians(-transform.rotation.yaw)
    stops: list[tuple[float, ...]] = []
    for waypoint in list(actor.get_stop_waypoints()):
        at = waypoint.transform
        turn = math.radians(-at.rotation.yaw)
        stops.append((at.location.x, -at.location.y, at.location.z, turn, 1.0, 1.0))
    return Light(place.x, -place.y, place.z, heading, tuple(stops))


# Sensors on the ego, and their measurements in the axes of sgstore. Measurements arrive on client threads and
# go into a queue of limited length. If the queue is full, the sensor and the stream from the server wait. After
# a time limit, a measurement is dropped and counted.
#
# Source: CARLA 0.9.16, Python API reference, "Sensors reference".

QUEUE: Final = 128
"""Maximum number of queued measurements."""
PATIENCE_S: Final = 5.0
"""Maximum time that a measurement waits for space in the queue; s."""
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
"""Columns of the points of each sensor, in its axes: x ahead, y to the left, z up; m, m/s (radial)."""

_POSE: Final = ("x", "y", "z", "roll", "pitch", "yaw")
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True)
class SensorPicture:
    """Camera picture of a CARLA sensor: (height, width, 3) uint8, RGB.

    ``fov`` is the horizontal field of view; degrees.
    """

    pixels: np.ndarray[Any, np.dtype[np.uint8]]
    fov: float


@dataclass(frozen=True, slots=True)
class SensorCloud:
    """Point cloud of a CARLA lidar or radar: one row per point."""

    points: np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True, slots=True)
class SensorReading:
    """Measurement of a CARLA sensor: name, time and data.

    Attributes
    ----------
    sensor : str
        Name of the sensor.
    time_ns : int
        Simulation time; ns.
    data : SensorPicture, SensorCloud or dict
        A dictionary contains numbers and texts by name, for sensors without pictures or points.
    """

    sensor: str
    time_ns: int
    data: SensorPicture | SensorCloud | dict[str, Any]


@dataclass(frozen=True, slots=True)
class Sensor:
    """Configuration of a CARLA sensor on the ego: type, pose and settings.

    Attributes
    ----------
    name : str
        Name of its channel.
    type : str
        Blueprint: ``sensor.camera.rgb``, ``sensor.lidar.ray_cast``, …
    x, y, z, roll, pitch, yaw : float
        Pose in the ego's axes as in sgstore: x ahead, y to the left, z up, yaw counter-clockwise; from the
        ego's origin, on the ground; m, degrees.
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
    """Read sensor configurations from a TOML file, each in a table ``[[sensor]]``.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or contains an invalid sensor.
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
    """CARLA sensors attached to the ego until they are closed.

    Parameters
    ----------
    world : carla.World
    ego : carla.Actor or None
    sensors : sequence of Sensor

    Attributes
    ----------
    dropped : int
        Number of lost measurements: the queue was full, or the data were invalid.
    reason : str
        Fault of the last invalid measurement; empty without one.

    Raises
    ------
    TraceError
        The ego does not exist, the world lacks the blueprint or attribute, or a sensor cannot be placed.
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
        """Stop the CARLA sensors, and remove them from the world."""
        for actor in self._actors:
            actor.stop()
            actor.destroy()
        self._actors.clear()

    def waiting(self, timeout_s: float = 0.0) -> Iterator[SensorReading]:
        """Yield the sensor measurements that arrived since the last call.

        Parameters
        ----------
        timeout_s : float
            Maximum time to wait for the first one; s.
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
            # Conversion between left-handed and right-handed axes.
            place = carla.Location(sensor.x, -sensor.y, sensor.z)
            turn = carla.Rotation(pitch=-sensor.pitch, yaw=-sensor.yaw, roll=sensor.roll)
            pose = carla.Transform(place, turn)
            actor = world.spawn_actor(blueprint, pose, attach_to=ego)
        except (RuntimeError, IndexError) as error:
            raise TraceError(f"sensor {sensor.name!r} ({sensor.type}): {error}") from error
        self._actors.append(actor)
        actor.listen(partial(self._take, sensor.name))

    def _take(self, name: str, data: Any) -> None:
        """Store a sensor measurement. CARLA calls this on a client thread, which swallows exceptions."""
        try:
            self._queue.put(reading_of(name, data), timeout=PATIENCE_S)
        except queue.Full:
            self.dropped += 1
        except (ValueError, TypeError, AttributeError) as error:
            self.dropped += 1
            self.reason = f"a measurement of {name!r} cannot be read: {error}"


def reading_of(name: str, data: Any) -> SensorReading:
    """Convert a ``carla.SensorData`` of any type into a measurement of sgstore."""
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
    """Convert detections of a CARLA radar (velocity, angles, depth) into points."""
    told = np.frombuffer(data.raw_data, "<f4").reshape(-1, 4).astype(np.float64)
    velocity, altitude, azimuth, depth = told.T
    points = np.zeros(len(told), RADAR)
    points["x"] = depth * np.cos(altitude) * np.cos(azimuth)
    points["y"] = 0.0 - depth * np.cos(altitude) * np.sin(azimuth)
    points["z"] = depth * np.sin(altitude)
    points["velocity"] = velocity
    return points


def _values(data: Any) -> dict[str, Any]:
    """Return the values of an IMU, GNSS or event measurement of CARLA, by name."""
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
    """Convert a vector from CARLA's left-handed axes into right-handed axes: name of the axis → value."""
    if "gyroscope" in name:
        return {"x": 0.0 - value.x, "y": value.y, "z": 0.0 - value.z}
    return {"x": value.x, "y": 0.0 - value.y, "z": value.z}
