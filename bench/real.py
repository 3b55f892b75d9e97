"""Real traffic: many replicas of recordings of simulators, sized by table and asked on one processor.

::

    python -m bench real [--quick]

Each replica of a recording is moved and turned as a whole (:mod:`bench.replicas`), so that nothing is small
because it repeats. Without the shared recordings the bundled sample is replicated. ``--quick`` makes 38 traces
instead of 1,007. ``SGSTORE_BENCH_REAL=FILE`` keeps the store, and takes it if it is there. Beside the bytes of
a table stands its floor (:mod:`bench.least_bytes`). Processor times are of one processor, scaled to a million
frames, and stand beside that of a fixed statement of the same process.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.least_bytes import bytes_of
from bench.measure import Measure
from bench.patterns import QUESTIONS, REFERENCE, asked, reference
from bench.replicas import given, replicate, sources
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

TRACES, QUICK = 1_007, 38
"""Replicas; each of the 19 views of the shared recordings is there equally often."""
SAMPLE = Path(__file__).parents[1] / "samples"
MILLION = 1_000_000
TTC_FRAMES = 140_000
TTC = "SELECT min(ttc), min(abs(lat_gap)) FROM pairs WHERE src_is_ego"
MEDIAN_MS, MOST_MS, PEAK_MB, TTC_MS, BYTES = 100, 350, 430, 80, 520
"""What is aimed at: processor times a million frames, memory, and bytes a frame without maps."""
TIMES = 2


def recordings() -> list[Path]:
    """The shared recordings, else those that are bundled."""
    return given() or sorted(SAMPLE.glob("*.mcap"))


def made(path: Path, traces: int) -> Iterator[Measure]:
    """Make the store; how fast that was, and how much of it is reading and graphs."""
    start = time.process_time()
    of = list(sources(recordings()))
    read = time.process_time() - start
    yield Measure(
        "graphs of the originals",
        sum(source.frames for source in of) / read,
        "frames/s",
        f"{len(of)} of {len(recordings())} recordings",
    )
    start = time.process_time()
    frames = replicate(StoreFile.create(path), of, traces)
    spent = time.process_time() - start
    yield Measure("brought into the store", frames / spent, "frames/s", f"{traces:,} traces")
    StoreFile(path).compact()


def questions(path: str) -> dict[str, Any]:
    """Processor times of all questions, on one processor and with the store kept open; s."""
    store = Store(path)
    with store.file.snapshot():
        base = reference(store)
        answers = {question.label: asked(store, question, TIMES) for question in QUESTIONS}
        peak = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
        pairs = float("inf")
        for _ in range(TIMES):
            before = time.process_time()
            store.sql(TTC)
            pairs = min(pairs, time.process_time() - before)
    return {
        "base": base,
        "answers": answers,
        "peak": int(peak[1]) if peak else 0,
        "pairs": pairs,
    }


def times_of(path: Path, frames: int) -> Iterator[Measure]:
    """The questions in a process of their own, that may use one processor."""
    one = min(os.sched_getaffinity(0))
    program = "import json, sys; from bench.real import questions; print(json.dumps(questions(sys.argv[1])))"
    run = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {one}),
    )
    found = json.loads(run.stdout)
    scale = 1e3 * MILLION / frames
    yield Measure("reference", scale * found["base"], "ms", f"a million frames: {REFERENCE}")
    spent = []
    for label, (wall, worked, answer) in found["answers"].items():
        spent.append(scale * worked)
        note = f"{answer:>9,}  {worked / found['base']:.2f} of the reference, wall {scale * wall:.0f} ms"
        yield Measure(label, spent[-1], "ms", note)
    spent.sort()
    yield Measure("median", spent[len(spent) // 2], "ms", f"aim {MEDIAN_MS}")
    yield Measure("longest", spent[-1], "ms", f"aim {MOST_MS}")
    yield Measure("peak memory, all questions", found["peak"] / 1000, "MB", f"aim {PEAK_MB}")
    pairs = 1e3 * found["pairs"] * TTC_FRAMES / frames
    yield Measure(
        "ego: least ttc and lateral gap", pairs, "ms", f"{TTC_FRAMES:,} frames, aim {TTC_MS}"
    )


def run(quick: bool = False) -> Iterator[Measure]:
    """Make, size, ask."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = Path(os.environ.get("SGSTORE_BENCH_REAL") or folder / "real.sgstore")
        if not path.exists():
            yield from made(path, QUICK if quick else TRACES)
        ((frames, traces),) = (
            Store(path).sql("SELECT count(*), count(DISTINCT trace_id) FROM frames").values
        )
        yield Measure("frames", frames, "", f"{traces:,} traces")
        yield from bytes_of(path, frames, folder, BYTES)
        yield from times_of(path, frames)
