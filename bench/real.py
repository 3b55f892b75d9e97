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
    from collections.abc import Callable, Iterator

    from duckdb import DuckDBPyConnection

TRACES, QUICK = 1_007, 38
"""Replicas; each of the 19 views of the shared recordings is there equally often."""
SAMPLE = Path(__file__).parents[1] / "samples"
MILLION = 1_000_000
TTC_FRAMES = 140_000
TTC = "SELECT min(ttc), min(abs(lat_gap)) FROM pairs WHERE src_is_ego"
MEDIAN_MS, MOST_MS, PEAK_MB, TTC_MS, BYTES = 100, 350, 430, 80, 520
"""What is aimed at: processor times a million frames, memory, and bytes a frame without maps."""
TIMES = 2

OVER = {
    "few": "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)",
    "many": "MATCH (e:Ego)-[:inDFrontOf]->(v:Vehicle)",
    "by numbers": "MATCH (e:Ego), (v:Vehicle) WHERE lead(e, v) AND headway(e, v) < 2",
    "lasting": "MATCH (e:Ego), (v:Vehicle) WHERE lead(e, v) FOR >= 2s",
    "steps": "MATCH (e:Ego)-[:near]->(v:Vehicle) AS a THEN WITHIN 5s MATCH (e)-[:very_near]->(v) AS b",
}
"""Patterns whose matches values are taken over."""
VALUES = ("MIN(ttc(e, v))", "MAX(v.speed)", "AVG(dist(e, v))", "ARGMIN(gap(e, v))")
WINDOWS = (
    "min_over(dist(e, v), 2s) < 5",
    "max_over(closing_speed(e, v), 1s) > 3",
    "avg_over(dist(e, v), 2s) < 10",
)
"""Conditions on all pairs of the ego."""
NAMED = {
    "floor": f"  {VALUES[0]} of all rows",
    "bare": "  v.speed of rows that are known, the join alone",
}
"""What stands beside values over matches."""
OVER_SHARE, WINDOW_S = 0.3, 1.0
"""What is aimed at: what a value over matches adds to its pattern, and windows over a million frames."""


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
        pairs = spent(lambda: store.sql(TTC))
        over = over_matches(store)
        every = "MATCH (e:Ego), (v:Vehicle) WHERE"
        windows = {
            one: spent(lambda one=one: store.find(f"{every} {one} RETURN COUNT(*)").rows())
            for one in WINDOWS
        }
    return {
        "over": over,
        "windows": windows,
        "base": base,
        "answers": answers,
        "peak": int(peak[1]) if peak else 0,
        "pairs": pairs,
    }


def spent(work: Callable[[], object]) -> float:
    """Processor time, the least of some; s."""
    best = float("inf")
    for _ in range(TIMES):
        before = time.process_time()
        work()
        best = min(best, time.process_time() - before)
    return best


def over_matches(store: Store) -> dict[str, dict[str, float]]:
    """Processor times of intervals, and of the same with a value over each match; s.

    ``floor`` is a value of each row, in one statement: no less can be read for one over matches. ``bare`` is
    what the database takes to read speeds by the ids of frames and nodes, when a table has these already.
    """
    found: dict[str, dict[str, float]] = {}
    for label, pattern in OVER.items():
        asked = {"": f"{pattern} RETURN v.name, INTERVALS"}
        asked |= {value: f"{asked['']}, {value} OVER match AS told" for value in VALUES}
        if " AS b" in pattern:
            parts = {f"{VALUES[0]} OVER {part}": part for part in ("a", "a..b")}
            asked |= {one: f"{asked['']}, {VALUES[0]} OVER {p} AS told" for one, p in parts.items()}
        elif "FOR" not in pattern:
            asked["floor"] = f"{pattern} RETURN {VALUES[0]}"
        found[label] = {
            one: spent(lambda text=text: store.find(text).rows()) for one, text in asked.items()
        }
        if "floor" in asked:
            found[label]["bare"] = bare(store, pattern)
    return found


def bare(store: Store, pattern: str) -> float:
    """Processor time of a join that reads the speeds of the vehicles of all matching rows; s."""
    ids = "frame.id AS frame_id, v.id AS node_id"
    given = store.find(f"{pattern} RETURN {ids}").as_table("found")
    text = "SELECT count(speed) FROM found JOIN state USING (frame_id, node_id)"

    def join(connection: DuckDBPyConnection) -> float:
        return spent(lambda: connection.execute(text).fetchall())

    with store.file.asked(join, given) as took:
        return took


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
    for label, times in found["over"].items():
        base = times.pop("")
        yield Measure(f"matches, {label}", scale * base, "ms", OVER[label])
        for value, took in times.items():
            name = NAMED.get(value, f"  {value} over each")
            note = f"{took / base:.2f} times the pattern, aim {1 + OVER_SHARE:g}"
            yield Measure(name, scale * took, "ms", note)
    for value, took in found["windows"].items():
        yield Measure(value, scale * took / 1e3, "s", f"all pairs of the ego, aim {WINDOW_S:g}")


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
