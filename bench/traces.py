"""How fast recordings are read, beside the plain ``mcap`` reader with the general decoders.

::

    python -m bench traces [--quick]

The recordings are made up. Objects: 60 a frame, in CARLA's messages and in OSI's. Skimming: the same objects in
a file that is mostly camera and lidar, stored and in zstd. Files are read from the page cache, and seconds are
those of one processor. Hashing is left out, because it has a processor of its own.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from bench.measure import Measure
from sgstore.traces import open_trace
from sgstore.traces.chunks import read_chunk_head
from sgstore.traces.mcap_file import McapFile
from sgstore.world import TraceReport

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import carla_recordings
from recordings import Recorder, car

if TYPE_CHECKING:
    from collections.abc import Callable

OBJECTS = 60
PICTURE, CLOUD = 250_000, 400_000
"""Bytes of the messages of the sensors, which do not compress."""
ROUNDS = 3


def carla(path: Path, frames: int, *, sensors: bool = False, **how: Any) -> Path:
    """A drive as CARLA's bridge tells it; its list of actors comes with every frame."""
    dice = random.Random(1)
    actors = {i: ("vehicle.tesla.model3", "" if i else "hero") for i in range(OBJECTS)}
    with carla_recordings.Bridge(path, chunk_size=1 << 20, **how) as bridge:
        for i in range(frames):
            t = i / 10
            bridge.actors(actors, time=t)
            bridge.objects(t, [carla_recordings.vehicle(k, k + t, k) for k in range(OBJECTS)])
            bridge.status(t, throttle=0.5)
            if sensors:
                for topic, size in (("/camera", PICTURE), ("/lidar", CLOUD)):
                    name = "sensor_msgs/CompressedImage"  # any message; it is not looked at
                    bridge.write(topic, name, dice.randbytes(size), t + 0.005)
    return path


def osi(path: Path, frames: int) -> Path:
    with Recorder(path) as recorder:
        for i in range(frames):
            t = i / 10
            things = [car(k, k + t, k, v=(1, 0), a=(0, 0)) for k in range(OBJECTS)]
            recorder.ground_truth(t, things, host=0)
    return path


# Readers ------------------------------------------------------------------------------------------


def ours(path: Path) -> int:
    """Everything that ingest reads: who the actors are, and then every frame."""
    with open_trace(path, digest="0" * 64) as trace:
        return sum(len(block.states) for block in trace.blocks(120))


def ours_again(path: Path) -> Callable[[], int]:
    """The frames alone, of a recording that is open."""
    trace = open_trace(path, digest="0" * 64)
    return lambda: sum(len(block.states) for block in trace.blocks(120))


def official_carla(path: Path) -> int:
    """The official reader and decoder, and the numbers of each object as a tuple."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = 0
        for *_, told in reader.iter_decoded_messages(["/carla/objects"]):
            for one in told.objects:
                p, q, v, a = (
                    one.pose.position,
                    one.pose.orientation,
                    one.twist.linear,
                    one.accel.linear,
                )
                row = (p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, a.x, a.y, a.z)
                rows += bool((one.id, *row, *one.shape.dimensions))
        return rows


def official_osi(path: Path) -> int:
    with path.open("rb") as stream:
        reader, kind, rows = make_reader(stream), None, 0
        for schema, _, message in reader.iter_messages(["truth"]):
            kind = kind or _message(schema.data)
            for one in kind.FromString(message.data).moving_object:
                b = one.base
                p, o, v, a, d = (
                    b.position,
                    b.orientation,
                    b.velocity,
                    b.acceleration,
                    b.dimension,
                )
                row = (p.x, p.y, p.z, o.yaw, o.pitch, o.roll, v.x, v.y, v.z, a.x, a.y, a.z)
                rows += bool((one.id.value, *row, d.length, d.width, d.height))
        return rows


def _message(descriptors: bytes) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("osi3.GroundTruth"))


def decompressed(path: Path) -> int:
    """All chunks, read and decompressed, and nothing else."""
    total = 0
    with McapFile(path) as recording, path.open("rb") as file:
        for offset in recording.chunk_offsets.tolist():
            head = read_chunk_head(file, offset)
            file.seek(head.data_offset)
            stored = file.read(head.data_length)
            if head.compression:
                stored = zstandard.ZstdDecompressor().decompress(stored)
            total += len(stored)
    return total


def walked(path: Path) -> int:
    """Every message found, checksums verified, and nothing decoded."""
    with McapFile(path) as recording:
        return sum(len(run) for run in recording.walk(TraceReport()))


# Tables -------------------------------------------------------------------------------------------


def best(work: Callable[[], int]) -> tuple[float, int]:
    """Least time of a processor in some rounds, and what came out; s."""
    times: list[float] = []
    result = 0
    for _ in range(ROUNDS):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times), result


def decoding(folder: Path, frames: int) -> list[Measure]:
    table: list[Measure] = []
    for name, path, official in (
        ("CARLA", carla(folder / "carla.mcap", frames), official_carla),
        ("OSI", osi(folder / "osi.mcap", frames), official_osi),
    ):
        theirs, rows = best(lambda: official(path))  # noqa: B023 (called at once)
        frames_alone, same = best(ours_again(path))
        whole, _ = best(lambda: ours(path))  # noqa: B023
        if same != rows:
            raise RuntimeError(f"{name}: {same} objects read, {rows} written")
        table += [
            Measure(f"{name}: mcap with the general decoder", rows / theirs, "objects/s"),
            Measure(
                f"{name}: frames of an open recording",
                rows / frames_alone,
                "objects/s",
                f"{theirs / frames_alone:.1f} times",
            ),
            Measure(
                f"{name}: opened and read, blocks of states",
                rows / whole,
                "objects/s",
                f"{theirs / whole:.1f} times",
            ),
        ]
    return table


def skimming(folder: Path, frames: int) -> list[Measure]:
    table: list[Measure] = []
    for compression in ("", "zstd"):
        path = carla(folder / "big.mcap", frames, sensors=True, compression=compression)
        size = path.stat().st_size / 1e6
        name = f"{size:,.0f} MB with camera and lidar, {compression or 'stored'}"
        bare, _ = best(lambda: decompressed(path))  # noqa: B023
        theirs, _ = best(lambda: official_carla(path))  # noqa: B023
        found, _ = best(lambda: walked(path))  # noqa: B023
        whole, _ = best(lambda: ours(path))  # noqa: B023
        table += [
            Measure(f"{name}: bare chunks", size / bare, "MB/s", "read and decompressed"),
            Measure("  mcap with the general decoder", size / theirs, "MB/s"),
            Measure(
                "  every message found, checksums verified",
                size / found,
                "MB/s",
                f"{bare / found:.2f} of the bare chunks",
            ),
            Measure(
                "  opened and read, blocks of states",
                size / whole,
                "MB/s",
                f"{theirs / whole:.1f} times",
            ),
        ]
        path.unlink()
    return table


def run(quick: bool = False) -> list[Measure]:
    """Objects decoded, and the ground truth of a large recording skimmed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return decoding(folder, 100 if quick else 800) + skimming(folder, 100 if quick else 800)
