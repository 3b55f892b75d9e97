"""Record the sample: run SUMO on our town and write ``sgstore/apps/sample/town.mcap``.

Run it in an environment with the extra ``sample``; ``make sample`` makes one. The same versions of SUMO,
Pillow and zstandard give the same bytes again.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import camera
import draw_map
import lidar
from cast import DURATION, EGO
from mcap.writer import CompressionType, Writer
from messages import kind_of, schema_of
from osi3.osi_groundtruth_pb2 import GroundTruth
from tracks import STEP
from traffic import STEPS, Recording, simulate
from truth import Truth, interface_version
from view import CENTRE, FOCAL, HEIGHT, WIDTH

if TYPE_CHECKING:
    from collections.abc import Iterator

    from google.protobuf.message import Message

HERE = Path(__file__).parent
TARGET = HERE.parents[1] / "sgstore" / "apps" / "sample" / "town.mcap"

CHUNK = 256 * 1024
PICTURES, CLOUDS = (0.2, 0.037), (0.5, 0.083)
"""Period and first time of the sensors; s. Neither falls on a frame of the ground truth, as in reality."""
PROTOBUF = "7.36.2"
"""Version of protobuf that the file names: a constant, so that the bytes do not depend on the machine."""


@dataclass(frozen=True)
class Channel:
    """A channel: topic, schema, class of its messages."""

    topic: str
    schema: str
    kind: type[Message]


CHANNELS = {
    "truth": Channel("ground_truth", "osi3.GroundTruth", GroundTruth),
    "map": Channel("ground_truth_map", "osi3.MapAsamOpenDrive", kind_of("MapAsamOpenDrive")),
    "image": Channel(
        "/ego/camera/front/image", "foxglove.CompressedImage", kind_of("CompressedImage")
    ),
    "calibration": Channel(
        "/ego/camera/front/calibration", "foxglove.CameraCalibration", kind_of("CameraCalibration")
    ),
    "cloud": Channel("/ego/lidar/points", "foxglove.PointCloud", kind_of("PointCloud")),
}


def calibration() -> Message:
    """What the camera is like: a pinhole without distortion."""
    out = kind_of("CameraCalibration")(
        width=WIDTH,
        height=HEIGHT,
        frame_id="ego/camera/front",
        distortion_model="plumb_bob",
        D=[0.0] * 5,
    )
    out.K.extend([FOCAL, 0.0, CENTRE[0], 0.0, FOCAL, CENTRE[1], 0.0, 0.0, 1.0])
    out.R.extend([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    out.P.extend([FOCAL, 0.0, CENTRE[0], 0.0, 0.0, FOCAL, CENTRE[1], 0.0, 0.0, 0.0, 1.0, 0.0])
    return out


def image(recording: Recording, time: float) -> Message:
    """The camera's picture at a time."""
    ego = recording.track(EGO)
    out = kind_of("CompressedImage")(format="jpeg", frame_id="ego/camera/front")
    stamp_of(out, time)
    out.data = camera.picture(recording, ego, time)
    return out


def cloud(recording: Recording, time: float, seed: int) -> Message:
    """The lidar's points at a time."""
    points = lidar.cloud(recording, recording.track(EGO), time, seed)
    out = kind_of("PointCloud")(frame_id="ego/lidar", data=points.tobytes())
    out.point_stride = points.itemsize
    stamp_of(out, time)
    out.pose.orientation.w = 1.0
    for name, (kind, offset, *_) in (lidar.DTYPE.fields or {}).items():
        out.fields.add(name=name, offset=offset, type=7 if kind.kind == "f" else 1)
    return out


def stamp_of(message: Message, time: float) -> None:
    """Fill a Foxglove timestamp."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(round(time * 1e9), 1_000_000_000)


def messages(recording: Recording, xodr: str) -> Iterator[tuple[int, str, Message]]:
    """Log time (ns), channel and message, in the order of time."""
    kind = kind_of("MapAsamOpenDrive")
    yield 0, "map", kind(map_reference="town.xodr", open_drive_xml_content=xodr)
    yield 0, "calibration", calibration()
    truth = Truth(recording)
    due = [(step * STEP, "truth", step) for step in range(STEPS)]
    for channel, (period, first) in (("image", PICTURES), ("cloud", CLOUDS)):
        shots = math.ceil((DURATION - first) / period)
        due += [(first + i * period, channel, i) for i in range(shots)]
    for time, channel, number in sorted(due):
        match channel:
            case "truth":
                made = truth.message(number)
            case "image":
                made = image(recording, time)
            case _:
                made = cloud(recording, time, number)
        yield round(time * 1e9), channel, made


def write(path: Path, recording: Recording, xodr: str) -> None:
    """Write the recording."""
    version = interface_version()
    osi = f"{version.version_major}.{version.version_minor}.{version.version_patch}"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        writer.start(profile="", library="sgstore samples/town")
        writer.add_metadata("net.asam.osi.trace", {
            "version": osi, "min_osi_version": osi, "max_osi_version": osi, "min_protobuf_version": PROTOBUF,
            "max_protobuf_version": PROTOBUF, "description": "SUMO traffic in a small town, drawn for sgstore",
            "authors": "sgstore", "data_sources": "Eclipse SUMO; people, camera and lidar: samples/town",
        })  # fmt: skip
        ids = {}
        for name, channel in CHANNELS.items():
            schema = writer.register_schema(channel.schema, "protobuf", schema_of(channel.kind))
            about = {
                "net.asam.osi.trace.channel.osi_version": osi,
                "net.asam.osi.trace.channel.protobuf_version": PROTOBUF,
            } if channel.schema.startswith("osi3.") else {}  # fmt: skip
            ids[name] = writer.register_channel(channel.topic, "protobuf", schema, about)
        for number, (time_ns, name, message) in enumerate(messages(recording, xodr)):
            data = message.SerializeToString(deterministic=True)
            writer.add_message(ids[name], time_ns, data, time_ns, number)
        writer.finish()


def main() -> None:
    """Draw the map, simulate, write."""
    draw_map.main()
    xodr = HERE / "town.xodr"
    with tempfile.TemporaryDirectory() as folder:
        recording = simulate(xodr, Path(folder))
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_suffix(".part")
    write(unfinished, recording, xodr.read_text(encoding="utf-8"))
    unfinished.replace(target)
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
