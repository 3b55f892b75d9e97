"""Small recordings of Autoware, encoded by ``mcap-ros2-support``, in the words of the domain.

::

    with Stack(path) as stack:
        stack.pose(0.0, 10, 0)
        stack.objects(0.0, [thing("car", 20, 0)])

The definitions have the fields and their order of autoware_msgs and ROS 2 Humble; a test compares them with
the originals.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

from carla_recordings import DEFINITIONS, Bridge, definition, header, ns, turned, xyz

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

PERCEPTION, VEHICLE = "autoware_perception_msgs", "autoware_vehicle_msgs"
_POSE = "geometry_msgs/PoseWithCovariance"
_TWIST = "geometry_msgs/TwistWithCovariance"
_ACCEL = "geometry_msgs/AccelWithCovariance"


def _objects(name: str) -> str:
    return f"std_msgs/Header header\n{name}[] objects"


AUTOWARE = {
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "geometry_msgs/AccelWithCovariance": "Accel accel\nfloat64[36] covariance",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    f"{PERCEPTION}/TrackedObjects": _objects("TrackedObject"),
    f"{PERCEPTION}/PredictedObjects": _objects("PredictedObject"),
    f"{PERCEPTION}/DetectedObjects": _objects("DetectedObject"),
    f"{PERCEPTION}/TrackedObject": "unique_identifier_msgs/UUID object_id\n"
    "float32 existence_probability\nObjectClassification[] classification\n"
    "TrackedObjectKinematics kinematics\nShape shape",
    f"{PERCEPTION}/PredictedObject": "unique_identifier_msgs/UUID object_id\n"
    "float32 existence_probability\nObjectClassification[] classification\n"
    "PredictedObjectKinematics kinematics\nShape shape",
    f"{PERCEPTION}/DetectedObject": "float32 existence_probability\n"
    "ObjectClassification[] classification\nDetectedObjectKinematics kinematics\nShape shape",
    f"{PERCEPTION}/TrackedObjectKinematics": "uint8 AVAILABLE=2\n"
    f"{_POSE} pose_with_covariance\n{_TWIST} twist_with_covariance\n"
    f"{_ACCEL} acceleration_with_covariance\nuint8 orientation_availability\nbool is_stationary",
    f"{PERCEPTION}/DetectedObjectKinematics": f"{_POSE} pose_with_covariance\n"
    "bool has_position_covariance\nuint8 orientation_availability\n"
    f"{_TWIST} twist_with_covariance\nbool has_twist\nbool has_twist_covariance",
    f"{PERCEPTION}/PredictedObjectKinematics": f"{_POSE} initial_pose_with_covariance\n"
    f"{_TWIST} initial_twist_with_covariance\n{_ACCEL} initial_acceleration_with_covariance\n"
    "PredictedPath[] predicted_paths",
    f"{PERCEPTION}/PredictedPath": "geometry_msgs/Pose[] path\n"
    "builtin_interfaces/Duration time_step\nfloat32 confidence",
    f"{PERCEPTION}/ObjectClassification": "uint8 CAR = 1\nuint8 label\nfloat32 probability",
    f"{PERCEPTION}/Shape": "uint8 BOUNDING_BOX=0\nuint8 type\n"
    "geometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions",
    f"{PERCEPTION}/TrafficLightGroupArray": "builtin_interfaces/Time stamp\n"
    f"{PERCEPTION}/TrafficLightGroup[] traffic_light_groups",
    f"{PERCEPTION}/TrafficLightGroup": "int64 traffic_light_group_id\n"
    f"{PERCEPTION}/TrafficLightElement[] elements\n"
    f"{PERCEPTION}/PredictedTrafficLightState[] predictions",
    f"{PERCEPTION}/TrafficLightElement": "uint8 RED = 1\nuint8 color\nuint8 shape\nuint8 status\n"
    "float32 confidence",
    f"{PERCEPTION}/PredictedTrafficLightState": 'string INFORMATION_SOURCE_V2N="V2N"\n'
    "builtin_interfaces/Time predicted_stamp\n"
    f"{PERCEPTION}/TrafficLightElement[] simultaneous_elements\nfloat32 reliability\n"
    "string information_source",
    "autoware_localization_msgs/KinematicState": "std_msgs/Header header\nstring child_frame_id\n"
    f"{_POSE} pose_with_covariance\n{_TWIST} twist_with_covariance\n{_ACCEL} accel_with_covariance",
    "visualization_msgs/MarkerArray": "uint8[] markers",
    f"{VEHICLE}/GearReport": "uint8 DRIVE = 2\nbuiltin_interfaces/Time stamp\nuint8 report",
    f"{VEHICLE}/TurnIndicatorsReport": "uint8 DISABLE = 1\nbuiltin_interfaces/Time stamp\n"
    "uint8 report",
    f"{VEHICLE}/HazardLightsReport": "uint8 DISABLE = 1\nbuiltin_interfaces/Time stamp\n"
    "uint8 report",
}
LABELS = ("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian")
_NOTHING = [0.0] * 36


def uuid_of(name: str) -> list[int]:
    return [*hashlib.md5(name.encode(), usedforsecurity=False).digest()]


def hex_of(name: str) -> str:
    return bytes(uuid_of(name)).hex()


def thing(label: str, x: float, y: float, name: str = "", **more: Any) -> dict[str, Any]:
    """An object; ``v``: twist and ``a``: acceleration in its own axes."""
    return {"label": label, "x": x, "y": y, "name": name or label, **more}


def _told(one: dict[str, Any], sort: str) -> dict[str, Any]:
    pose = {
        "pose": {
            "position": xyz(one["x"], one["y"], one.get("z", 0.75)),
            "orientation": turned(one.get("heading", 0.0)),
        },
        "covariance": one.get("covariance", _NOTHING),
    }
    spin = xyz(0, 0, one.get("yaw_rate", 0.0))
    twist = {"twist": {"linear": xyz(*one.get("v", ())), "angular": spin}, "covariance": _NOTHING}
    accel = {"accel": {"linear": xyz(*one.get("a", ())), "angular": xyz()}, "covariance": _NOTHING}
    classes = [{"label": LABELS.index(one["label"]), "probability": 0.9}]
    classes.insert(0, {"label": 0, "probability": 0.1})
    corners = [xyz(*corner) for corner in one.get("corners", ())]
    size = one.get("size", (4.5, 1.9, 1.5))
    told = {
        "existence_probability": one.get("existence", 0.0),
        "classification": classes,
        "shape": {
            "type": one.get("shape", 2 if corners else 0),
            "footprint": {"points": corners},
            "dimensions": xyz(*size),
        },
    }
    available = one.get("available", 2)
    if sort == "Predicted":
        path = {
            "path": [pose["pose"]] * 3,
            "time_step": {"sec": 0, "nanosec": 500_000_000},
            "confidence": 1.0,
        }
        told["kinematics"] = {
            "initial_pose_with_covariance": pose,
            "initial_twist_with_covariance": twist,
            "initial_acceleration_with_covariance": accel,
            "predicted_paths": [path] * one.get("paths", 1),
        }
    elif sort == "Tracked":
        told["kinematics"] = {
            "pose_with_covariance": pose,
            "twist_with_covariance": twist,
            "acceleration_with_covariance": accel,
            "orientation_availability": available,
            "is_stationary": False,
        }
    else:
        told["kinematics"] = {
            "pose_with_covariance": pose,
            "has_position_covariance": False,
            "orientation_availability": available,
            "twist_with_covariance": twist,
            "has_twist": "v" in one,
            "has_twist_covariance": False,
        }
    return told if sort == "Detected" else {"object_id": {"uuid": uuid_of(one["name"])}, **told}


class Stack(Bridge):
    """Writes an MCAP file as Autoware and a recorder do."""

    def end(self) -> None:
        """End the file."""
        self.__exit__()

    def send(self, topic: str, name: str, message: Any, time: float) -> None:
        known = {**DEFINITIONS, **AUTOWARE, **self.other}
        self.other = known
        self.write(topic, name, message, time, definition(name, known))

    def objects(
        self,
        time: float,
        things: Iterable[dict[str, Any]],
        sort: str = "Tracked",
        *,
        axes: str = "map",
        delay: float = 0.1,
    ) -> None:
        """A list of objects, which comes some time after the instant that it is of."""
        told = {"header": header(time, axes), "objects": [_told(one, sort) for one in things]}
        topic = f"/perception/object_recognition/{sort.lower()}/objects"
        self.send(topic, f"{PERCEPTION}/{sort}Objects", told, time + delay)

    def pose(
        self,
        time: float,
        x: float,
        y: float,
        heading: float = 0.0,
        *,
        old: bool = False,
        **more: Any,
    ) -> None:
        """Where the rear axle is. ``v``: in the axes of the vehicle; ``old``: as ``nav_msgs/Odometry``."""
        pose = {
            "pose": {"position": xyz(x, y, 0.0), "orientation": turned(heading)},
            "covariance": _NOTHING,
        }
        spin = xyz(0, 0, more.get("yaw_rate", 0.0))
        linear = xyz(*more.get("v", ()))
        twist = {"twist": {"linear": linear, "angular": spin}, "covariance": _NOTHING}
        head = {"header": header(time, "map"), "child_frame_id": "base_link"}
        if old:
            told = {**head, "pose": pose, "twist": twist}
            self.send("/localization/kinematic_state", "nav_msgs/Odometry", told, time + 0.004)
            return
        push = {
            "accel": {"linear": xyz(*more.get("a", ())), "angular": xyz()},
            "covariance": _NOTHING,
        }
        told = {
            **head,
            "pose_with_covariance": pose,
            "twist_with_covariance": twist,
            "accel_with_covariance": push,
        }
        name = "autoware_localization_msgs/KinematicState"
        self.send("/localization/kinematic_state", name, told, time + 0.004)

    def transform(
        self, time: float, parent: str, child: str, place: tuple[float, ...], heading: float = 0.0
    ) -> None:
        """A transform; those of ``base_link`` move, others hold for ever."""
        one = {
            "header": header(time, parent),
            "child_frame_id": child,
            "transform": {"translation": xyz(*place), "rotation": turned(heading)},
        }
        topic = "/tf" if child == "base_link" else "/tf_static"
        self.send(topic, "tf2_msgs/TFMessage", {"transforms": [one]}, time + 0.002)

    def lights(self, time: float, groups: Mapping[int, list[tuple[int, int, int]]]) -> None:
        """Id of a group → colour, shape and status of its elements."""
        told = [
            {
                "traffic_light_group_id": ident,
                "elements": [
                    {"color": c, "shape": s, "status": t, "confidence": 1.0} for c, s, t in elements
                ],
                "predictions": [],
            }
            for ident, elements in groups.items()
        ]
        message = {"stamp": header(time)["stamp"], "traffic_light_groups": told}
        topic = "/perception/traffic_light_recognition/traffic_signals"
        self.send(topic, f"{PERCEPTION}/TrafficLightGroupArray", message, time + 0.001)

    def report(self, time: float, what: str, value: int) -> None:
        """``what``: Gear, TurnIndicators or HazardLights."""
        message = {"stamp": header(time)["stamp"], "report": value}
        self.send(f"/vehicle/status/{what.lower()}", f"{VEHICLE}/{what}Report", message, time)


def drive(path: Any, frames: int = 25, **how: Any) -> Any:
    """A drive behind a car, past a pedestrian, told in the map."""
    with Stack(path, **how) as stack:
        stack.transform(0.0, "base_link", "camera", (1.5, 0.0, 1.4))
        for i in range(frames):
            t = 1.0 + i / 10
            stack.pose(t, 8 * t, 0.0, v=(8.0, 0.0, 0.0))
            things = [
                thing("car", 8 * t + 20, 0.2 * i, "leader", v=(8.0, 2.0, 0.0)),
                thing("pedestrian", 40.0, -6 + t, size=(0.5, 0.5, 1.7), heading=1.57, v=(1.0,)),
            ]
            stack.objects(t, things)
            stack.camera(t + 0.05)
    return path


__all__ = ["AUTOWARE", "Stack", "drive", "hex_of", "ns", "thing", "uuid_of"]
