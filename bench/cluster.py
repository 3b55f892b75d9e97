"""Questions to a collection, beside the same questions to one store: processor time, bytes, opened bundles.

::

    python -m bench cluster [--quick]

The whole of it takes most of ten minutes, half of which make the store; ``--quick`` one minute.

Replicas of the shared recordings, 1,000 traces in one compacted store (``--quick``: 60, where what a bundle
takes anyway weighs more; ``SGSTORE_BENCH_STORE=FILE``: those of a store that is there), packed into bundles
of a quarter and of a tenth of them. 12 patterns, 2 sequences, 3 checks; processor time, of which a loaded
machine changes the ratios least. Each question is asked of all three, three times in turn.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import duckdb
import numpy as np

from bench.ingest import recording
from bench.measure import Measure
from bench.replicas import given, replicate, sources
from sgstore.collection import Collection, pack
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

PATTERNS = (
    "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN INTERVALS, v",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE e.speed > 5 RETURN trace.name, COUNT(*) AS n",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN v.kind AS kind, COUNT(*) AS n, AVG(v.speed) AS mean",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 5 RETURN COUNT(*)",
    "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v:Vehicle) RETURN INTERVALS, v",
    "MATCH (e:Ego)-[:near]->(v:Vehicle)-[:near]->(w:Vehicle) RETURN COUNT(DISTINCT w)",
    "MATCH (v:Vehicle) RETURN v, v.speed ORDER BY v.speed DESC LIMIT 20",
    "MATCH (e:Ego) WHERE e.accel < -3 RETURN CLIPS(-1s, +1s)",
    "MATCH (e:Ego)-[:near]->(p:Person) RETURN FRAMES",
    "MATCH (e:Ego) WHERE NOT EXISTS {(e)-[:near]->(:Vehicle)} RETURN INTERVALS",
    "MATCH (v:Truck)-[:near]-(w:Car) RETURN INTERVALS, v, w",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN DISTINCT v.kind",
)
SEQUENCES = (
    "MATCH (e:Ego)-[:near]->(v:Vehicle) THEN WITHIN 2s MATCH (e)-[:near_coll]->(v) RETURN INTERVALS, v",
    "MATCH (e:Ego) WHERE e.speed > 5 FOR >= 1s THEN WITHIN 3s MATCH (e) WHERE e.speed < 1",
)
CHECKS = (
    "CHECK calm: ALWAYS ego.speed < 30",
    "CHECK stops: ALWAYS (ego.speed > 10 IMPLIES EVENTUALLY[0s, 20s] ego.speed < 10)",
    "CHECK apart: FORALL (v:Vehicle) ALWAYS dist(ego, v) > 1",
)
NOTHING = "MATCH (e:Ego) WHERE e.speed > 1e6"
AIMS = {4: 1.25, 10: 1.6}
"""Bundles → at most so many times the processor time of one store."""
RECORDINGS = 16
"""Recordings that are read in two shares."""
EMPTY_MS, ATTACH_MS, TASK_MS, BYTES, SHARES = 25.0, 10.0, 5.0, 1.10, 1.10


def rows_of(asked: Store | Collection, text: str) -> object:
    return asked.find(text).rows()


def verdicts_of(asked: Store | Collection, text: str) -> object:
    return list(asked.check(text))


def questions(asked: Store | Collection) -> list[Callable[[], object]]:
    finds = [partial(rows_of, asked, text) for text in PATTERNS + SEQUENCES]
    return [*finds, *(partial(verdicts_of, asked, text) for text in CHECKS)]


def seconds(ask: Callable[[], object]) -> float:
    """Seconds of processor that a question takes."""
    start = time.process_time()
    ask()
    return time.process_time() - start


def side_by_side(asked: Mapping[int, Store | Collection]) -> dict[int, float]:
    """Seconds of processor that all questions take of each: of three, in turn, the least.

    What is read of a file at first stays in memory, and load makes it no less.
    """
    spent_on = dict.fromkeys(asked, 0.0)
    for asks in zip(*map(questions, asked.values()), strict=True):
        rounds = [[*map(seconds, asks)] for _ in range(3)]
        for number, took in zip(asked, map(min, zip(*rounds, strict=True)), strict=True):
            spent_on[number] += took
    return spent_on


def run(quick: bool) -> Iterator[Measure]:
    with tempfile.TemporaryDirectory() as name:
        os.environ["SGSTORE_CACHE"] = str(Path(name) / "cache")
        yield from measures(Path(name), 60 if quick else 1_000, frames=120 if quick else None)


def measures(folder: Path, traces: int, frames: int | None) -> Iterator[Measure]:
    path = folder / "one.sgstore"
    if made := os.environ.get("SGSTORE_BENCH_STORE"):
        shutil.copy(made, path)
        known = StoreFile(path).traces()
        traces, written = len(known), sum(one.frames for one in known)
    else:
        read = list(sources(given(), frames=frames))
        written = replicate(StoreFile.create(path), read, traces)
    StoreFile(path).compact()
    yield Measure("one store", written, "frames", f"{traces} traces")
    places = {bundles: folder / f"of-{bundles}" for bundles in AIMS}
    for bundles, place in places.items():
        pack(path, place, bundle_traces=-(-traces // bundles))
    wholes = {bundles: Collection(place) for bundles, place in places.items()}
    for whole in wholes.values():
        list(whole.find(NOTHING))  # each is looked at once whether it is what it was
    with Store(path) as store, store.file.snapshot():
        spent_on = side_by_side({1: store, **wholes})
    yield Measure("17 questions of one store", spent_on[1], "s", "processor time; the baseline")
    for bundles, whole in wholes.items():
        took, files = spent_on[bundles], sorted((places[bundles] / "bundles").iterdir())
        told = f"{took:.3g} s; aim ≤ {AIMS[bundles]}"
        yield Measure(f"the same of {bundles} bundles", took / spent_on[1], "times", told)
        ratio = sum(one.stat().st_size for one in files) / path.stat().st_size
        aim_told = f"aim ≤ {BYTES}" if bundles == 4 else ""
        yield Measure(f"bytes of {bundles} bundles", ratio, "times", aim_told)
        nothing = partial(rows_of, whole, NOTHING)
        empty = median(seconds(nothing) for _ in range(5)) / bundles
        yield Measure("a bundle that finds nothing", empty * 1e3, "ms", f"aim ≤ {EMPTY_MS:g}")
        once = median(map(attached, files))
        yield Measure("attach a bundle, ask it once", once * 1e3, "ms", f"aim ≤ {ATTACH_MS:g}")
    yield from model(spent_on, written, len(PATTERNS + SEQUENCES + CHECKS))
    yield from of_ray(folder / "of-10")
    yield from of_shares(folder, 300 if frames else 1_500)


def attached(bundle: Path) -> float:
    """Seconds of processor until a connection that is open has an answer of a bundle, which it leaves again."""
    with duckdb.connect() as connection:
        connection.execute("SELECT 1").fetchall()
        start = time.process_time()
        connection.execute(f"ATTACH '{bundle}' AS bundle (READ_ONLY)")
        near = "SELECT count(*) FROM bundle.inside.edge WHERE relation = 'near'"
        connection.execute(near).fetchall()
        connection.execute("DETACH bundle")
        return time.process_time() - start


def model(spent_on: Mapping[int, float], frames: int, asked: int) -> Iterator[Measure]:
    """The straight line through what was taken of so many bundles, by least squares."""
    slope, rest = np.polyfit([*spent_on], [*spent_on.values()], 1)
    told = "a straight line through 1, 4 and 10 files"
    yield Measure("model: a bundle and question", slope / asked * 1e3, "ms", told)
    yield Measure("model: a frame and question", rest / asked / frames * 1e6, "µs", told)


def of_shares(folder: Path, frames: int) -> Iterator[Measure]:
    """What it costs to read recordings in two shares: each is a process, which starts. The least of three."""
    paths = [str(recording(folder / f"{n}.mcap", frames + n)) for n in range(RECORDINGS)]
    landed(folder / "before", paths[:1], 1)  # loops are compiled once for a machine
    took: dict[int, list[float]] = {1: [], 2: []}
    for again in range(3):
        for shares, some in took.items():
            some.append(landed(folder / f"in-{shares}-{again}", paths, shares))
    one, two = min(took[1]), min(took[2])
    told = f"{two:.3g} s, processor time; {frames} frames each; aim ≤ {SHARES}"
    yield Measure(f"{RECORDINGS} recordings in 2 shares, beside 1", two / one, "times", told)


def landed(place: Path, paths: list[str], shares: int) -> float:
    """Seconds of processor until recordings have landed, share by share."""
    before = spent()
    for share in range(1, shares + 1):
        words = [sys.executable, "-m", "sgstore", "ingest", str(place), *paths]
        words += ["--shard", f"{share}/{shares}"]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    return spent() - before


def spent() -> float:
    """Seconds of processor that processes have taken which were begun here and are over."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def of_ray(place: Path) -> Iterator[Measure]:
    """What Ray adds to a task, where it is installed: one worker of it beside this process, best of 50."""
    if find_spec("ray") is None:
        return
    ray = import_module("ray")
    ray.init(num_cpus=1, log_to_driver=False, logging_level="ERROR")
    times: dict[str, float] = {}
    for engine in ("local", "ray"):
        whole = Collection(place, engine=engine)
        took: list[float] = []
        for _ in range(50):
            start = time.perf_counter()
            list(whole.find(NOTHING))
            took.append(time.perf_counter() - start)
        times[engine] = min(took) / len(whole.bundles())
    ray.shutdown()
    more = (times["ray"] - times["local"]) * 1e3
    yield Measure("a task of Ray, beside one here", more, "ms", f"wall time; aim ≤ {TASK_MS:g}")
