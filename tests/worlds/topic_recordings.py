"""A recording with topics beside its frames: ROS 2, protobuf and JSON messages, and an unknown encoding."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from recordings import Recorder, car
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from pathlib import Path

LINE = "=" * 80
IMU = f"""std_msgs/Header header
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
{LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{LINE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
STATUS = f"""uint8 OK=0
bool ready
int64 count
uint64 large
float32 load
string name
uint8[] raw
float32[] ranges
int16[3] fixed
string[] words
test_msgs/Part[] parts
{LINE}
MSG: test_msgs/Part
string key
float64 value
"""


@cache
def ros() -> Any:
    """Types of the rosbags package, with those of the tests."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    texts = {"test_msgs/msg/Imu": IMU, "test_msgs/msg/Status": STATUS}
    for name, text in texts.items():
        head, *others = text.split(f"{LINE}\nMSG: ")
        for one in others:
            inner, _, rest = one.partition("\n")
            if inner.startswith("test_msgs/"):
                store.register(get_types_from_msg(rest, inner.replace("/", "/msg/")))
        store.register(get_types_from_msg(head, name))
    return store


@cache
def control() -> tuple[bytes, type[Any]]:
    """Descriptors of a protobuf message, and its class."""
    file = descriptor_pb2.FileDescriptorProto(name="control.proto", package="test", syntax="proto3")
    gear = file.enum_type.add(name="Gear")
    for number, name in enumerate(("PARK", "DRIVE")):
        gear.value.add(name=name, number=number)
    kinds = descriptor_pb2.FieldDescriptorProto
    point = file.message_type.add(name="Point")
    for number, name in enumerate("xy", 1):
        point.field.add(name=name, number=number, type=kinds.TYPE_DOUBLE, label=1)
    message = file.message_type.add(name="Control")
    message.oneof_decl.add(name="_limit")
    for number, (name, kind, label, of) in enumerate(
        (
            ("gear", kinds.TYPE_ENUM, 1, ".test.Gear"),
            ("steer", kinds.TYPE_FLOAT, 1, ""),
            ("target", kinds.TYPE_MESSAGE, 1, ".test.Point"),
            ("limit", kinds.TYPE_DOUBLE, 1, ""),
            ("path", kinds.TYPE_MESSAGE, 3, ".test.Point"),
            ("gears", kinds.TYPE_ENUM, 3, ".test.Gear"),
            ("times", kinds.TYPE_INT64, 3, ""),
            ("raw", kinds.TYPE_BYTES, 1, ""),
            ("child", kinds.TYPE_MESSAGE, 1, ".test.Control"),
            ("id", kinds.TYPE_UINT64, 1, ""),
            ("on", kinds.TYPE_BOOL, 1, ""),
        ),
        1,
    ):
        field = message.field.add(
            name=name, number=number, type=kind, label=label, type_name=of or None
        )
        if name == "limit":
            field.proto3_optional, field.oneof_index = True, 0
    files = descriptor_pb2.FileDescriptorSet(file=[file])
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return files.SerializeToString(), message_factory.GetMessageClass(
        pool.FindMessageTypeByName("test.Control")
    )


def imu(t: float, rng: Any) -> Any:
    kind = ros().types
    stamp = kind["builtin_interfaces/msg/Time"](sec=int(t), nanosec=round(t % 1 * 1e9))
    header = kind["std_msgs/msg/Header"](stamp=stamp, frame_id="imu" if t < 1.5 else "imu_2")
    turn, push = (kind["geometry_msgs/msg/Vector3"](*rng.normal(size=3)) for _ in range(2))
    return kind["test_msgs/msg/Imu"](header, turn, rng.normal(size=9), push)


def status(number: int) -> Any:
    kind = ros().types
    parts = [kind["test_msgs/msg/Part"](key=f"k{i}", value=i / 3) for i in range(number % 3)]
    return kind["test_msgs/msg/Status"](
        ready=number % 2 == 0,
        count=-(2**53) - number,
        large=2**64 - 1 - number,
        load=0.1 * number,
        name="ä" * number,
        raw=np.arange(number, dtype=np.uint8),
        ranges=np.arange(number, dtype=np.float32) / 3,
        fixed=np.array([number, -1, 2], np.int16),
        words=["a", 'b"'] * (number % 2),
        parts=parts,
    )


def controlled(number: int) -> Any:
    made = control()[1](steer=0.1 * number, gear=number % 2, id=2**63 + number, raw=b"\0x" * number)
    if number % 2:
        made.target.x, made.limit, made.on = 1.5, 0.0, True
        made.path.add(x=1, y=2)
        made.child.steer = 3
    made.gears.extend([0, 1, 7][: number % 4])
    made.times.extend(range(number % 3))
    return made


def planned(number: int) -> dict[str, Any]:
    plan: dict[str, Any] = {"speed": number if number < 5 else number + 0.5, "steps": [1, 2.5]}
    if number > 3:
        plan["why"] = {"text": "lead", "ids": ["a", "b"]}
    state = "STOP" if 6 <= number < 12 else "GO"
    return {"state": state, "plan": plan, "State": number, "t": number / 2, "none": None}


def topic_recording(path: Path, frames: int = 20) -> Path:
    """Frames at 10 Hz of two cars, with messages between them."""
    rng = np.random.default_rng(1)
    with Recorder(path) as recorder:
        writer = recorder.writer
        for topic, encoding, form, name, data in (
            ("/imu", "cdr", "ros2msg", "test_msgs/msg/Imu", IMU.encode()),
            ("/status", "cdr", "ros2msg", "test_msgs/msg/Status", STATUS.encode()),
            ("/control", "protobuf", "protobuf", "test.Control", control()[0]),
            ("/planner", "json", "", "Plan", b""),
            ("/odd", "cbor", "", "Odd", b""),
        ):
            schema = writer.register_schema(name, form, data)
            recorder.channels[topic] = writer.register_channel(topic, encoding, schema)
        say = recorder.channels
        for i in range(frames):
            t = i / 10
            recorder.ground_truth(t, [car(7, 10 * t, name="Ego"), car(3, 40 - 5 * t, 3.5)], host=7)
            for k in range(5):
                at = t + 0.01 + k / 50
                data = ros().serialize_cdr(imu(at, rng), "test_msgs/msg/Imu")
                recorder.write(say["/imu"], at, bytes(data))
            data = ros().serialize_cdr(status(i), "test_msgs/msg/Status")
            recorder.write(say["/status"], t + 0.02, bytes(data))
            recorder.write(say["/control"], t + 0.03, controlled(i).SerializeToString())
            recorder.write(say["/planner"], t + 0.05, json.dumps(planned(i)).encode())
            recorder.write(say["/odd"], t + 0.06, b"\xa0")
    return path
