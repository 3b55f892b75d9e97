"""Frames per second of ingest and of its parts, and whether memory grows with the length of a recording.

::

    python -m bench ingest [--quick]

The recordings are made up: 40 cars in a town, one of them the ego, ground truth at 10 Hz, a picture at 5 Hz,
the map in the file. Beside them stands real traffic, esmini's swarm on Town04, where the shared recordings are.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.measure import Measure
from bench.replicas import DATA
from bench.sgg import town
from sgstore.ingest import BLOCK_FRAMES, ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))
from recordings import Recorder, car

if TYPE_CHECKING:
    from collections.abc import Iterator

CARS = 40
MINUTE = 600
"""Frames of a minute."""
SWARM = DATA / "traces/esmini/swarm_Town04.mcap"


def recording(path: Path, frames: int) -> Path:
    """A made-up drive: all cars stay within 50 m of the ego, half of them stand."""
    with Recorder(path) as recorder:
        recorder.map(town())
        for i in range(frames):
            t = i / 10
            recorder.ground_truth(t, [placed(k, t) for k in range(CARS)], host=CARS // 2)
            if i % 2 == 0:
                recorder.camera(t + 0.02, 4000)
    return path


def placed(k: int, t: float) -> object:
    """Car k at a time, on one of two streets that cross: of each two the first goes to and fro."""
    street, place = k % 2, 6.0 * (k // 2 - CARS // 4)
    moves = k // 2 % 2 == 0
    along = place + (3 * math.sin(t / 5 + k) if moves else 0.0)
    speed = 0.6 * math.cos(t / 5 + k) if moves else 0.0
    x, y = (along, -1.75) if street else (1.75, along)
    v = (speed, 0.0) if street else (0.0, speed)
    return car(k + 1, x, y, yaw=0.0 if street else math.pi / 2, v=v)


@dataclass
class Parts:
    """Seconds of processor time that the parts of ingest take: other work on the machine does not count."""

    seconds: dict[str, float] = field(default_factory=dict)

    def timed(self, name: str, since: float) -> float:
        now = time.process_time()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - since
        return now


def in_parts(path: Path, store: StoreFile) -> tuple[dict[str, float], int]:
    """The steps of ingest one by one; seconds by name, and the number of frames."""
    parts = Parts()
    at = time.process_time()
    with open_trace(path) as trace:
        at = parts.timed("open and hash", at)
        road_map = read_map(trace.info.map_text, trace.info.map_name)
        at = parts.timed("map", at)
        generator = SceneGraphGenerator(road_map, Config())
        with store.segment(
            trace.info, Config(), road_map=road_map, answers=generator.answers
        ) as segment:
            at = parts.timed("segment", at)
            for block in trace.blocks(BLOCK_FRAMES):
                at = parts.timed("read", at)
                graph = generator.block(segment.as_kept(block))
                at = parts.timed("graph", at)
                segment.append(graph)
                at = parts.timed("pack and insert", at)
            at = parts.timed("read", at)
            store.publish(segment.seal(trace.report))
            parts.timed("publish", at)
        return parts.seconds, trace.report.frames


PEAK = """
import re, sys
from pathlib import Path
from sgstore.ingest import ingest
(outcome,) = ingest(sys.argv[2], [sys.argv[1]])
assert outcome.status == "added", outcome
print(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
"""


def peak_mb(path: Path, store: Path) -> float:
    """Peak memory of a process that ingests a recording; MB."""
    run = subprocess.run(
        [sys.executable, "-c", PEAK, str(path), str(store)],
        capture_output=True,
        text=True,
        check=True,
    )
    return int(run.stdout) / 1000


def peaks(folder: Path, short: Path, long: Path, times: int) -> Iterator[Measure]:
    if not Path("/proc/self/status").exists():  # Linux tells peaks there
        return
    first = peak_mb(short, folder / "short.db")
    second = peak_mb(long, folder / "long.db")
    yield Measure("peak memory, 60 s", first, "MB", "of the whole process")
    yield Measure(f"peak memory, {60 * times} s", second, "MB", f"{second / first:.2f} times")


def of_swarm(folder: Path, times: int = 3) -> Iterator[Measure]:
    """A short recording of real traffic into stores of its own, the best of some."""
    for on in ("a map never seen", "a known map") if SWARM.exists() else ():
        spent, frames = math.inf, 0
        for number in range(times):
            if on == "a map never seen":
                read_map.cache_clear()
            start = time.process_time()
            (outcome,) = ingest(folder / f"{on} {number}.db", [SWARM])
            spent, frames = min(spent, time.process_time() - start), outcome.frames
        yield Measure(f"esmini's swarm, {on}", frames / spent, "frames/s", f"{frames} frames")


def run(quick: bool = False) -> list[Measure]:
    """A minute in parts, and one beside ten minutes."""
    times = 3 if quick else 10
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        short = recording(folder / "short.mcap", MINUTE)
        long = recording(folder / "long.mcap", times * MINUTE)
        ingest(folder / "warm.db", [short])
        store = StoreFile.create(folder / "parts.db")
        seconds, frames = in_parts(long, store)
        whole = sum(seconds.values())
        table = [
            Measure(
                "ingest, whole",
                frames / whole,
                "frames/s",
                f"{CARS} cars, one core, processor time",
            )
        ]
        table += [
            Measure(f"  {part}", 1e6 * spent / frames, "µs/frame", f"{100 * spent / whole:.0f} %")
            for part, spent in seconds.items()
        ]
        start = time.process_time()
        outcomes = ingest(folder / "parts.db", [long])
        again = time.process_time() - start
        table.append(Measure("the same again", again, "s", outcomes[0].status))
        table += [*of_swarm(folder), *peaks(folder, short, long, times)]
    return table
