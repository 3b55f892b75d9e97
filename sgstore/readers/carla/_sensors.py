"""Sensors of a live CARLA: attached to the ego, and what they measure, in our axes.

What a sensor measures comes from threads of the client's own, so it goes into a queue of a bounded length. If
that is full the sensor waits, and with it the stream from the server; what cannot wait is dropped and counted.

Source: CARLA 0.9.16, Python API reference, "Sensors reference".
"""

from __future__ import annotations

import math
import queue
import re
import tomllib
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError, TraceError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


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
            found[name] = _turned(name, value)
        elif hasattr(value, "type_id"):
            found[name] = {"id": value.id, "type": str(value.type_id)}
        elif isinstance(value, list):
            found[name] = [str(getattr(item, "type", item)) for item in value]
    return found


def _turned(name: str, value: Any) -> dict[str, float]:
    """A vector in our axes; turning about x and z changes its sign, a push along y does."""
    if "gyroscope" in name:
        return {"x": 0.0 - value.x, "y": value.y, "z": 0.0 - value.z}
    return {"x": value.x, "y": 0.0 - value.y, "z": value.z}
