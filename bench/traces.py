"""How fast recordings are read, beside the plain ``mcap`` reader with the general decoders.

::

    python -m bench traces [--quick]

The recordings are made up. Objects: 60 a frame, in CARLA's messages and in OSI's. Skimming: the same objects in
a file that is mostly camera and lidar: stored; in zstd, which finds nothing in a JPEG; in zstd of raw pictures
and points, which it halves, of small ones and of those of CARLA's bridge as it comes. Bytes are counted as they
are without compression. Files are read from the page cache.

Objects are decoded in seconds of a processor. A file is skimmed in seconds of the clock, because two threads
decompress: the machine should have nothing else to do. What is compared takes turns, and the least of each
counts. Hashing is left out, because it has a processor of its own.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from bench.measure import Measure
from sgstore.mcap import McapFile, read_chunk_head
from sgstore.model.world import TraceReport
from sgstore.readers import open_trace

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))
import carla_recordings
from recordings import Recorder, car

if TYPE_CHECKING:
    from collections.abc import Callable

OBJECTS = 60
SMALL = 250_000, 400_000
"""Bytes of a picture and of a cloud."""
BRIDGE = 800 * 600 * 4, 16_000 * 16
"""The same of CARLA's bridge as it comes: BGRA, and 320,000 points a second, twenty times a second
(carla_spawn_objects/config/objects.json)."""
ROUNDS = 3

Sensors = tuple[list[bytes], list[bytes]]
"""Some pictures and some clouds, which come by turns."""


def noise() -> Sensors:
    """Messages in which nothing can be compressed, as JPEG and H.264 are."""
    dice = random.Random(2)
    picture, cloud = SMALL
    return [dice.randbytes(picture) for _ in range(20)], [dice.randbytes(cloud) for _ in range(20)]


def raw(picture: int, cloud: int) -> Sensors:
    """Grey pictures with noise in two bits of a pixel, and points of a spinning lidar to the millimetre."""
    dice = np.random.default_rng(2)
    pictures: list[bytes] = []
    clouds: list[bytes] = []
    for i in range(20):
        slope = np.linspace(i, 150 + i, picture)
        pictures.append((slope + dice.integers(0, 4, picture)).astype(np.uint8).tobytes())
        turn = np.linspace(0, 2 * np.pi, cloud // 16)
        far = 20 + 5 * np.sin(3 * turn + i) + dice.normal(0, 0.02, len(turn))
        points = np.stack(
            [far * np.cos(turn), far * np.sin(turn), -1.8 + 0 * far, 0.1 + 0 * far], 1
        )
        clouds.append(points.round(3).astype("<f4").tobytes())
    return pictures, clouds


def carla(path: Path, frames: int, sensors: Sensors | None = None, **how: Any) -> Path:
    """A drive as CARLA's bridge tells it; its list of actors comes with every frame."""
    actors = {i: ("vehicle.tesla.model3", "" if i else "hero") for i in range(OBJECTS)}
    with carla_recordings.Bridge(path, chunk_size=1 << 20, **how) as bridge:
        for i in range(frames):
            t = i / 10
            bridge.actors(actors, time=t)
            bridge.objects(t, [carla_recordings.vehicle(k, k + t, k) for k in range(OBJECTS)])
            bridge.status(t, throttle=0.5)
            for topic, contents in zip(("/camera", "/lidar"), sensors or (), strict=False):
                name = "sensor_msgs/CompressedImage"  # any message; it is not looked at
                bridge.write(topic, name, contents[i % len(contents)], t + 0.005)
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


def by_turns(
    works: dict[str, Callable[[], int]], rounds: int = ROUNDS
) -> dict[str, tuple[float, float, int]]:
    """Least time by the clock and of processors in some rounds, and what came out; s."""
    least: dict[str, tuple[float, float, int]] = {}
    for _ in range(rounds):
        for name, work in works.items():
            clock, processors = time.perf_counter(), time.process_time()
            result = work()
            spent = time.perf_counter() - clock, time.process_time() - processors
            before = least.get(name, (np.inf, np.inf, 0))
            least[name] = min(before[0], spent[0]), min(before[1], spent[1]), result
    return least


def skimming(folder: Path, frames: int) -> list[Measure]:
    table: list[Measure] = []
    small = sum(SMALL)
    for sensors, each, compression, told in (
        (noise(), small, "", "stored"),
        (noise(), small, "zstd", "zstd of JPEG"),
        (raw(*SMALL), small, "zstd", "zstd of raw data"),
        (raw(*BRIDGE), sum(BRIDGE), "zstd", "zstd of raw data, pictures of 800 x 600"),
    ):
        path = carla(folder / "big.mcap", frames * small // each, sensors, compression=compression)
        table += skimmed(path, told)
        path.unlink()
    return table


def skimmed(path: Path, told: str) -> list[Measure]:
    """What a recording that is mostly camera and lidar costs."""
    least = by_turns(
        {
            "bare": lambda: decompressed(path),
            "found": lambda: walked(path),
            "whole": lambda: ours(path),
        }
    )
    least |= by_turns({"theirs": lambda: official_carla(path)}, rounds=1)  # which takes long
    bare, total = least["bare"][0], least["bare"][2]
    size = total / 1e6

    def row(name: str, key: str) -> Measure:
        clock, processors, _ = least[key]
        of_bare = f"{bare / clock:.2f} of the bare chunks"
        if key == "whole":
            of_bare = f"{least['theirs'][0] / clock:.1f} times, {of_bare}"
        if key != "theirs":
            of_bare += f"; {least['bare'][1] / processors:.2f} by the work of processors"
        return Measure(name, size / clock, "MB/s", of_bare)

    name = f"{size:,.0f} MB with camera and lidar, {told}"
    return [
        Measure(name, path.stat().st_size / total, "of it", "in the file"),
        Measure("  bare chunks, read and decompressed", size / bare, "MB/s"),
        row("  mcap with the general decoder", "theirs"),
        row("  every message found, checksums verified", "found"),
        row("  opened and read, blocks of states", "whole"),
    ]


def run(quick: bool = False) -> list[Measure]:
    """Objects decoded, and the ground truth of a large recording skimmed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return decoding(folder, 100 if quick else 800) + skimming(folder, 100 if quick else 800)
