"""Patterns and checks of the library: processor time for a million frames, memory, and growth.

::

    python -m bench library [--quick]

The stores are replicas of recordings (:mod:`bench.replicas`) of 115, 1,007 and 4,009 traces: about 50,000,
437,000 and 1.74 million frames. ``SGSTORE_BENCH_LIBRARY=FOLDER`` keeps them. Each pattern and each check runs
alone, in a new process on one processor. A process is ended when it has used :data:`MOST_S` of processor time;
its pattern is then not run over larger stores. The exponent is the slope of time over frames in the two largest
stores on logarithmic axes; 1 is linear. ``--quick`` has one store of 38 traces.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.measure import Measure
from bench.patterns import REFERENCE, reference
from bench.real import QUICK, recordings
from bench.replicas import replicate, sources
from sgstore.lang.library import patterns
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

TRACES = (115, 1_007, 4_009)
PATTERNS_S, PATTERN_S, CHECKS_S, CHECK_S, PEAK_MB = 150, 5, 400, 20, 1300
"""Limits for a million frames: all patterns, each pattern, all checks, each check; and memory of each."""
REFERENCE_S, EXPONENT = 1, 1.1
"""Limits of the reference for a million frames (s), and of the growth of each entry."""
MOST_S = 300
MILLION = 1_000_000
PROGRAM = (
    "import sys; from bench.library import answered; print(answered(sys.argv[1], sys.argv[2]))"
)


class Answer(NamedTuple):
    """Processor time (s) and greatest memory (MB) of an entry over a store, and the number of its answers.

    The time is infinite where the process was ended, or failed with ``error``.
    """

    seconds: float
    memory: float
    count: int
    error: str = ""


def answered(path: str, name: str) -> str:
    """Return time, memory and number of answers of an entry, or of the reference, as JSON."""
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S))
    return json.dumps(answer(Path(path), name))


def answer(path: Path, name: str) -> Answer:
    """Ask a store for one entry of the library, or for the reference, in this process."""
    store = Store(path)
    with store.file.snapshot():
        if not name:
            return Answer(reference(store), 0, 0)
        entry = patterns()[name]
        before = _spent()
        found = list(store.check(entry.text)) if entry.is_check else store.find(entry.text).rows()
        used = resource.getrusage(resource.RUSAGE_SELF)
        return Answer(_spent() - before, used.ru_maxrss / 1000, len(found))


def _spent() -> float:
    """Return the processor time of this process; s."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def asked(path: Path, name: str) -> Answer:
    """Ask a store for one entry of the library in a new process."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path), name],
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode < 0:
        return Answer(math.inf, 0.0, 0)
    if run.returncode:
        return Answer(math.inf, 0.0, 0, run.stderr.strip().splitlines()[-1][:160])
    return Answer(*json.loads(run.stdout))


def stores(folder: Path, traces: tuple[int, ...]) -> Iterator[tuple[Path, int]]:
    """Yield a store of each size and its number of frames; make those that are missing."""
    paths = [folder / f"real{count}.sgstore" for count in traces]
    if not all(path.exists() for path in paths):
        made = list(sources(recordings()))
        for path, count in zip(paths, traces, strict=True):
            if not path.exists():
                replicate(StoreFile.create(path), made, count)
                StoreFile(path).compact()
    for path in paths:
        ((frames,),) = Store(path).sql("SELECT count(*) FROM frames").values
        yield path, frames


def measured(name: str, sized: list[tuple[Path, int]]) -> Measure:
    """Ask the stores for one entry, from the smallest on; return its line of the table."""
    answers: list[Answer] = []
    for path, _ in sized:
        answers.append(asked(path, name))
        if math.isinf(answers[-1].seconds):
            break
    last = len(answers) - 1
    scaled = answers[last].seconds * MILLION / sized[last][1]
    limit = CHECK_S if patterns()[name].is_check else PATTERN_S
    parts = [f"{max(one.memory for one in answers):6,.0f} MB", f"{answers[last].count:>9,} answers"]
    if last and not math.isinf(scaled):
        (before, now), (small, large) = answers[-2:], (sized[last - 1][1], sized[last][1])
        slope = math.log(now.seconds / before.seconds) / math.log(large / small)
        parts.append(f"exponent {slope:.2f}")
        parts += [f"above {EXPONENT}"] * (slope > EXPONENT)
    parts += [f"above {limit} s"] * (scaled > limit)
    parts += [f"above {PEAK_MB} MB"] * (max(one.memory for one in answers) > PEAK_MB)
    if math.isinf(scaled):
        reason = answers[last].error or f"ended after {MOST_S} s"
        parts.append(f"over {sized[last][1]:,} frames: {reason}")
    return Measure(name, scaled, "s", "  ".join(parts))


def run(quick: bool = False) -> Iterator[Measure]:
    """Yield the reference, each pattern and each check, and the sums for the two largest stores."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # new processes inherit it
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(os.environ.get("SGSTORE_BENCH_LIBRARY") or temporary)
        sized = list(stores(folder, (QUICK,) if quick else TRACES))
        path, frames = sized[-1]
        base = asked(path, "").seconds * MILLION / frames
        note = f"a million frames: {REFERENCE}" + f"  above {REFERENCE_S} s" * (base > REFERENCE_S)
        yield Measure("reference", base, "s", note)
        for checks, most in ((False, PATTERNS_S), (True, CHECKS_S)):
            names = [
                name
                for name, entry in patterns().items()
                if entry.kind != "predicate" and entry.is_check is checks
            ]
            sums = 0.0
            for name in names:
                line = measured(name, sized)
                sums += line.value
                yield line
            kind = "checks" if checks else "patterns"
            note = f"{sums / base:.0f} of the reference, limit {most} s"
            note += f"  above {most} s" * (sums > most)
            yield Measure(f"all {len(names)} {kind}", sums, "s", note)
