"""Topics: a million messages of an IMU, stored at ingest and filtered, each beside a baseline.

::

    python -m bench topics [--quick]

The recording has 1,000 messages a second beside frames at 10 Hz. The baseline of the ingest is that without
the topic, that of the filters an official reader of MCAP that decodes nothing. ``--quick`` records 20,000
messages. All figures are processor times.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.reader import make_reader

from bench.measure import Measure
from sgstore.ingest import ingest
from sgstore.query import Store
from sgstore.store import StoreFile

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))
from recordings import Recorder, car
from topic_recordings import IMU, imu, ros

if TYPE_CHECKING:
    from collections.abc import Callable

SECONDS, QUICK = 1_000, 20
RATE = 1_000
"""Messages of the IMU a second."""
FILTER = """SELECT count(*) FROM topic('/imu') WHERE "linear_acceleration.z" > 2"""
STORE_S, MCAP_S = 0.6, 6.0
"""What is aimed at: filters of a million messages."""


def recording(path: Path, seconds: int) -> Path:
    """Two cars, and an IMU whose messages are of 500 kinds."""
    rng, kind = np.random.default_rng(1), "test_msgs/msg/Imu"
    said = [bytes(ros().serialize_cdr(imu(1.0, rng), kind)) for _ in range(500)]
    with Recorder(path) as recorder:
        schema = recorder.writer.register_schema(kind, "ros2msg", IMU.encode())
        channel = recorder.writer.register_channel("/imu", "cdr", schema)
        for i in range(10 * seconds):
            t = i / 10
            cars = [car(7, 10 * t % 500, name="Ego"), car(3, 40 - 5 * t % 300, 3.5)]
            recorder.ground_truth(t, cars, host=7)
            for k in range(RATE // 10):
                recorder.write(channel, t + k / RATE, said[(7 * i + k) % len(said)])
    return path


def spent(work: Callable[[], object]) -> float:
    """Processor time; s."""
    start = time.process_time()
    work()
    return time.process_time() - start


def skimmed(path: Path) -> int:
    """Count the messages with the official reader."""
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages("/imu", log_time_order=False))


def run(quick: bool = False) -> list[Measure]:
    """Record, ingest, filter."""
    seconds = QUICK if quick else SECONDS
    count = f"{seconds * RATE:,} messages"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = recording(folder / "imu.mcap", seconds)
        ingest(folder / "warm.db", [recording(folder / "warm.mcap", 1)], topics=["/imu"])
        bare = spent(lambda: ingest(folder / "bare.db", [path]))
        whole = spent(lambda: ingest(folder / "whole.db", [path], topics=["/imu"]))
        store = Store(folder / "whole.db")
        stored = spent(lambda: store.sql(FILTER))
        read = spent(lambda: StoreFile.recording_sql(path, FILTER).rows())
        floor = spent(lambda: skimmed(path))
    return [
        Measure("ingest without the topic", bare, "s", f"{10 * seconds:,} frames"),
        Measure("ingest with the topic", whole, "s", f"{count}, {whole / bare:.1f} times"),
        Measure("the official reader, no decoding", floor, "s", count),
        Measure("filter from the store", stored, "s", f"aim {STORE_S} for a million"),
        Measure("filter from the MCAP", read, "s", f"aim {MCAP_S:g} for a million"),
    ]
