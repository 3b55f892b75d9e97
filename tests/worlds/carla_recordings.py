"""Small recordings of CARLA's ROS bridge, encoded by ``mcap-ros2-support``, in the words of the domain.

::

    with Bridge(path) as bridge:
        bridge.actors({1: ("vehicle.tesla.model3", "hero")})
        bridge.objects(0.0, [vehicle(1), walker(9, x=10)])

The definitions have the fields and their order of ros-carla-msgs, astuff_sensor_msgs and ROS 2 Humble.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from mcap.writer import Writer as PlainWriter
from mcap_ros2._dynamic import serialize_dynamic
from opendrive_maps import a_map, a_road, element, line
from recordings import COMPRESSIONS

from sgstore.model.vocabulary import KINDS
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from sgstore.model.world import FrameBlock, TraceInfo, TraceReport

DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/String": "string data",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "Vector3  linear\nVector3  angular",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Accel": "Vector3  linear\nVector3  angular",
    "geometry_msgs/Polygon": "Point32[] points",
    "shape_msgs/SolidPrimitive": "uint8 BOX=1\nuint8 SPHERE=2\nuint8 type\n"
    "float64[<=3] dimensions  # At no point will dimensions have a length > 3.\n"
    "uint8 BOX_X=0\ngeometry_msgs/Polygon polygon",
    "derived_object_msgs/Object": "# The object\nstd_msgs/Header header\nuint32 id\n"
    "uint8 detection_level\nuint8 OBJECT_DETECTED=0\nbool object_classified\n"
    "geometry_msgs/Pose pose\ngeometry_msgs/Twist twist\ngeometry_msgs/Accel accel\n"
    "geometry_msgs/Polygon polygon\nshape_msgs/SolidPrimitive shape\nuint8 classification\n"
    "uint8 CLASSIFICATION_CAR=6\nuint8 classification_certainty\nuint32 classification_age",
    "derived_object_msgs/ObjectArray": "std_msgs/Header header\n"
    "derived_object_msgs/Object[] objects",
    "carla_msgs/CarlaActorInfo": "uint32 id\nuint32 parent_id\nstring type\nstring rolename",
    "carla_msgs/CarlaActorList": "CarlaActorInfo[] actors",
    "carla_msgs/CarlaBoundingBox": "geometry_msgs/Vector3 center\ngeometry_msgs/Vector3 size",
    "carla_msgs/CarlaTrafficLightInfo": "uint32 id\ngeometry_msgs/Pose transform\n"
    "CarlaBoundingBox trigger_volume # relative to transform",
    "carla_msgs/CarlaTrafficLightInfoList": "CarlaTrafficLightInfo[] traffic_lights",
    "carla_msgs/CarlaTrafficLightStatus": "uint32 id\nuint8 RED=0\nuint8 state",
    "carla_msgs/CarlaTrafficLightStatusList": "CarlaTrafficLightStatus[] traffic_lights",
    "carla_msgs/CarlaWorldInfo": "string map_name\nstring opendrive",
    "carla_msgs/CarlaEgoVehicleControl": "std_msgs/Header header\nfloat32 throttle\n"
    "float32 steer\nfloat32 brake\nbool hand_brake\nbool reverse\nint32 gear\n"
    "bool manual_gear_shift",
    "carla_msgs/CarlaEgoVehicleStatus": "std_msgs/Header header\nfloat32 velocity\n"
    "geometry_msgs/Accel acceleration\ngeometry_msgs/Quaternion orientation\n"
    "CarlaEgoVehicleControl control",
    "carla_msgs/CarlaEgoVehicleInfo": "uint32 id\nstring type\nstring rolename",
    "carla_msgs/CarlaCollisionEvent": "std_msgs/Header header\nuint32 other_actor_id\n"
    "geometry_msgs/Vector3 normal_impulse",
    "carla_msgs/CarlaLaneInvasionEvent": "int32 LANE_MARKING_OTHER=0\nint32 LANE_MARKING_BROKEN=1\n"
    "std_msgs/Header header\nint32[] crossed_lane_markings",
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
}
"""Type → its definition."""

BEFORE_HUMBLE = {
    "shape_msgs/SolidPrimitive": "uint8 BOX=1\nuint8 type\nfloat64[<=3] dimensions\nuint8 BOX_X=0"
}
"""Definitions as Foxy and Galactic have them."""

RULE = "=" * 80


def definition(name: str, other: Mapping[str, str] | None = None) -> str:
    """The text of a schema: the definition of a type and of all that it is made of, as a recorder writes it."""
    known = DEFINITIONS | dict(other or {})
    wanted, text = [name], ""
    for part in wanted:
        package = part.split("/")[0]
        text += f"{RULE}\nMSG: {part}\n" if text else ""
        text += known[part] + "\n"
        for told in known[part].splitlines():
            word = told.split()[0].split("[")[0]
            full = word if "/" in word else f"{package}/{word}"
            if full in known and full not in wanted:
                wanted.append(full)
    return text


def xyz(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def turned(heading: float, pitch: float = 0.0, roll: float = 0.0) -> dict[str, float]:
    """The quaternion of angles about z, then y, then x."""
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(angle / 2), math.sin(angle / 2)) for angle in (heading, pitch, roll)
    )
    return {
        "x": sr * cp * cy - cr * sp * sy,
        "y": cr * sp * cy + sr * cp * sy,
        "z": cr * cp * sy - sr * sp * cy,
        "w": cr * cp * cy + sr * sp * sy,
    }


def header(time: float, frame: str = "map") -> dict[str, Any]:
    sec, nanosec = divmod(ns(time), 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def thing(ident: int, x: float = 0.0, y: float = 0.0, **more: Any) -> dict[str, Any]:
    """An object; ``v``: velocity, ``a``: acceleration, ``turn``: a quaternion instead of angles."""
    turn = more.get("turn") or turned(
        more.get("heading", 0.0), more.get("pitch", 0.0), more.get("roll", 0.0)
    )
    return {
        "header": header(more.get("time", 0.0), more.get("frame", "map")),
        "id": ident,
        "detection_level": 0,
        "object_classified": True,
        "pose": {"position": xyz(x, y, more.get("z", 0.0)), "orientation": turn},
        "twist": {
            "linear": xyz(*more.get("v", ())),
            "angular": xyz(0, 0, more.get("yaw_rate", 0.0)),
        },
        "accel": {"linear": xyz(*more.get("a", ())), "angular": xyz()},
        "polygon": {"points": more.get("polygon", [])},
        "shape": {
            "type": more.get("shape", 1),
            "dimensions": more.get("size", [4.5, 1.9, 1.5]),
            "polygon": {"points": []},
        },
        "classification": more.get("classification", 6),
        "classification_certainty": 255,
        "classification_age": 1,
    }


def vehicle(ident: int, x: float = 0.0, y: float = 0.0, **more: Any) -> dict[str, Any]:
    return thing(ident, x, y, **more)


def walker(ident: int, x: float = 0.0, y: float = 0.0, **more: Any) -> dict[str, Any]:
    defaults = {"classification": 4, "size": [0.4, 0.4, 1.8], "z": 0.9}
    return thing(ident, x, y, **(defaults | more))


def light(ident: int, x: float, y: float, heading: float = 0.0, **more: Any) -> dict[str, Any]:
    """Where a light stands. ``centre``, ``size``: of its trigger volume, in its own axes."""
    return {
        "id": ident,
        "transform": {"position": xyz(x, y, more.get("z", 0.0)), "orientation": turned(heading)},
        "trigger_volume": {
            "center": xyz(*more.get("centre", ())),
            "size": xyz(*more.get("size", (3, 3, 2))),
        },
    }


@dataclass
class Bridge:
    """Writes an MCAP file as the bridge and a recorder do; a channel is made when it is first written to."""

    path: Path
    compression: str = "zstd"
    chunk_size: int = 768 << 10
    use_chunking: bool = True
    summary: bool = True
    enable_crcs: bool = True
    other: Mapping[str, str] = field(default_factory=dict)
    """Definitions that differ."""
    channels: dict[str, int] = field(default_factory=dict)
    encoders: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> Self:
        self.stream = self.path.open("wb")
        self.writer = PlainWriter(
            self.stream,
            chunk_size=self.chunk_size,
            compression=COMPRESSIONS[self.compression],
            use_chunking=self.use_chunking,
            repeat_channels=self.summary,
            repeat_schemas=self.summary,
            use_statistics=self.summary,
            enable_crcs=self.enable_crcs,
        )
        self.writer.start("ros2", "tests")
        return self

    def __exit__(self, *_exception: object) -> None:
        self.writer.finish()
        self.stream.close()

    def write(
        self, topic: str, name: str, message: Any, time: float, text: str | None = None
    ) -> None:
        """A message of type ``package/Type``; bytes are written as they are."""
        package, _, kind = name.partition("/")
        if topic not in self.channels:
            content = definition(name, self.other) if text is None else text
            number = self.writer.register_schema(
                f"{package}/msg/{kind}", "ros2msg", content.encode()
            )
            self.channels[topic] = self.writer.register_channel(topic, "cdr", number)
        if not isinstance(message, bytes):
            message = self.encode(name, message)
        self.writer.add_message(self.channels[topic], ns(time), message, ns(time))

    def encode(self, name: str, message: Any) -> bytes:
        package, _, kind = name.partition("/")
        full = f"{package}/msg/{kind}"
        if name not in self.encoders:
            self.encoders[name] = serialize_dynamic(full, definition(name, self.other))[full]
        return bytes(self.encoders[name](message))

    def world(self, opendrive: str, name: str = "Carla/Maps/Town01", time: float = 0.0) -> None:
        told = {"map_name": name, "opendrive": opendrive}
        self.write("/carla/world_info", "carla_msgs/CarlaWorldInfo", told, time)

    def actors(self, actors: Mapping[int, tuple[str, str]], time: float = 0.0) -> None:
        """Id → blueprint, role."""
        told = [
            {"id": ident, "parent_id": 0, "type": kind, "rolename": role}
            for ident, (kind, role) in actors.items()
        ]
        self.write("/carla/actor_list", "carla_msgs/CarlaActorList", {"actors": told}, time)

    def objects(
        self,
        time: float,
        things: Iterable[dict[str, Any]],
        *,
        topic: str = "/carla/objects",
        log_time: float | None = None,
    ) -> None:
        told = {"header": header(time), "objects": list(things)}
        at = time + 0.002 if log_time is None else log_time
        self.write(topic, "derived_object_msgs/ObjectArray", told, at)

    def light_places(self, lights: Iterable[dict[str, Any]], time: float = 0.0) -> None:
        name = "carla_msgs/CarlaTrafficLightInfoList"
        self.write("/carla/traffic_lights/info", name, {"traffic_lights": list(lights)}, time)

    def light_states(self, states: Mapping[int, int], time: float) -> None:
        """Id → 0 red, 1 yellow, 2 green, 3 off, 4 unknown."""
        told = [{"id": ident, "state": state} for ident, state in states.items()]
        name = "carla_msgs/CarlaTrafficLightStatusList"
        self.write("/carla/traffic_lights/status", name, {"traffic_lights": told}, time)

    def status(
        self,
        time: float,
        *,
        steer: float = 0.0,
        throttle: float = 0.0,
        brake: float = 0.0,
        role: str = "hero",
        **more: Any,
    ) -> None:
        """``more``: other fields of the control."""
        told = {
            "header": header(time),
            "velocity": 0.0,
            "acceleration": {"linear": xyz(), "angular": xyz()},
            "orientation": turned(0),
            "control": control(steer, throttle, brake) | more,
        }
        topic = f"/carla/{role}/vehicle_status"
        self.write(topic, "carla_msgs/CarlaEgoVehicleStatus", told, time + 0.003)

    def command(
        self, time: float, *, steer: float, throttle: float, brake: float, **more: Any
    ) -> None:
        told = control(steer, throttle, brake) | {"header": header(time)} | more
        topic = "/carla/hero/vehicle_control_cmd"
        self.write(topic, "carla_msgs/CarlaEgoVehicleControl", told, time)

    def vehicle(self, ident: int, role: str, time: float = 0.0) -> None:
        told = {"id": ident, "type": "vehicle.audi.tt", "rolename": role}
        topic = f"/carla/{role}/vehicle_info"
        self.write(topic, "carla_msgs/CarlaEgoVehicleInfo", told, time)

    def odometry(self, time: float, x: float, y: float, *, role: str = "hero", **more: Any) -> None:
        """``v``: in the axes of the vehicle."""
        told = {
            "header": header(time),
            "child_frame_id": role,
            "pose": {
                "pose": {
                    "position": xyz(x, y, more.get("z", 0.0)),
                    "orientation": turned(more.get("heading", 0.0)),
                },
                "covariance": [0.0] * 36,
            },
            "twist": {
                "twist": {
                    "linear": xyz(*more.get("v", ())),
                    "angular": xyz(0, 0, more.get("yaw_rate", 0.0)),
                },
                "covariance": [0.0] * 36,
            },
        }
        at = time + more.get("delay", 0.004)
        self.write(f"/carla/{role}/odometry", "nav_msgs/Odometry", told, at)

    def collision(
        self, time: float, other: int, impulse: tuple[float, ...], role: str = "hero"
    ) -> None:
        told = {"header": header(time), "other_actor_id": other, "normal_impulse": xyz(*impulse)}
        self.write(f"/carla/{role}/collision", "carla_msgs/CarlaCollisionEvent", told, time + 0.005)

    def lane_invasion(self, time: float, markings: list[int], role: str = "hero") -> None:
        told = {"header": header(time), "crossed_lane_markings": markings}
        topic = f"/carla/{role}/lane_invasion"
        self.write(topic, "carla_msgs/CarlaLaneInvasionEvent", told, time + 0.005)

    def vehicle_lights(self, time: float, lights: Mapping[int, int]) -> None:
        topic = "/carla/vehicle_lights"
        if topic not in self.channels:
            number = self.writer.register_schema("tests.VehicleLights", "jsonschema", b"{}")
            self.channels[topic] = self.writer.register_channel(topic, "json", number)
        told = json.dumps({"t": time, "lights": {str(k): v for k, v in lights.items()}})
        at = ns(time + 0.006)
        self.writer.add_message(self.channels[topic], at, told.encode(), at)

    def camera(self, time: float, size: int = 400) -> None:
        data = bytes((7 * i * i + ns(time) // 1000) % 251 for i in range(size))
        told = {"header": header(time, "hero/rgb_front"), "format": "jpeg", "data": data}
        topic = "/carla/hero/rgb_front/image/compressed"
        self.write(topic, "sensor_msgs/CompressedImage", told, time + 0.007)


def control(steer: float, throttle: float, brake: float) -> dict[str, Any]:
    return {
        "header": header(0, ""),
        "throttle": throttle,
        "steer": steer,
        "brake": brake,
        "hand_brake": False,
        "reverse": False,
        "gear": 1,
        "manual_gear_shift": False,
    }


HERO = {1: ("vehicle.tesla.model3", "hero")}
SIGNAL = element(
    "signal",
    id="s80",
    s=25,
    t=-4,
    orientation="+",
    dynamic="yes",
    type="1000001",
    country="OpenDRIVE",
)
TOWN = a_map(a_road("1", line(100), signals=SIGNAL))
"""A road along x with one lane, and a traffic light beside it."""
ACTORS = {
    7: ("vehicle.tesla.model3", "hero"),
    3: ("vehicle.mitsubishi.fusorosa", "autopilot"),
    9: ("walker.pedestrian.0001", "pedestrian"),
    80: ("traffic.traffic_light", "None"),
    99: ("sensor.camera.rgb", "rgb_front"),
}


def drive(
    path: Path, frames: int = 20, *, everything: bool = False, period: float = 0.1, **how: Any
) -> Path:
    """A drive of a car and a bus, past a walker and a light. ``everything``: messages of every kind."""
    with Bridge(path, **how) as bridge:
        bridge.world(TOWN)
        bridge.actors(ACTORS)
        bridge.light_places([light(80, 25, -4)])
        if everything:
            bridge.vehicle(7, "hero")
        for i in range(frames):
            t = i * period
            if i % 5 == 0:
                bridge.light_states({80: i // 5 % 3}, t + 0.001)
            bridge.objects(
                t,
                [
                    vehicle(7, 10 * t, v=(10, 0, 0), time=t),
                    vehicle(3, 40 - 5 * t, 3.5, heading=3.0, v=(-5, 0, 0), size=[10, 2.5, 3]),
                    walker(9, 20, -6 + t, v=(0, 1, 0)),
                ],
            )
            bridge.status(t, steer=0.1, throttle=i / 100)
            bridge.odometry(t, 10 * t, 0, v=(10, 0, 0))
            if i % 2 == 0:
                bridge.camera(t)
            if everything:
                bridge.command(t, steer=0, throttle=1, brake=0)
                bridge.vehicle_lights(t, {7: 3, 3: 16})
                bridge.objects(t, [vehicle(3)], topic="/carla/hero/objects")
                bridge.odometry(t, 5, 5, role="stranger")
                bridge.collision(t, 3, (1, 2, 3))
                bridge.lane_invasion(t, [1, 10])
                bridge.write("/carla/map", "std_msgs/String", {"data": TOWN}, t)
    return path


def read(path: Path, size: int = 60, **how: Any) -> tuple[TraceInfo, list[FrameBlock], TraceReport]:
    """What a recording gives, without hashing it."""
    with open_trace(path, digest="0" * 64, **how) as trace:
        return trace.info, list(trace.blocks(size)), trace.report


def idents(blocks: list[FrameBlock]) -> list[str]:
    return [ident for block in blocks for ident in block.entities.ident]


def states(blocks: list[FrameBlock]) -> list[dict[str, Any]]:
    """States by frame, each a mapping from the entity's id to its columns."""
    names = idents(blocks)
    frames = []
    for block in blocks:
        for start, stop in zip(block.offsets, block.offsets[1:], strict=False):
            found = {}
            for row in range(start, stop):
                state = {n: getattr(block.states, n)[row] for n in block.states.__slots__}
                found[names[state["node"]]] = state
            frames.append(found)
    return frames


def kinds(blocks: list[FrameBlock]) -> dict[str, str]:
    codes = [code for block in blocks for code in block.entities.kind]
    return {ident: KINDS[code] for ident, code in zip(idents(blocks), codes, strict=True)}


def reasons(report: Any) -> str:
    return "; ".join(loss.reason for loss in report.losses)
