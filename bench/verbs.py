"""Verbs at 1,007 traces: processor time and memory of each as a new process, beside a start of the program.

::

    python -m bench verbs [--quick]

The store is that of :mod:`bench.real`, and ``SGSTORE_BENCH_REAL=FILE`` keeps it. ``--quick`` makes 38 traces.
Each verb runs on one processor. A verb that uses more than :data:`MOST_S` of processor time is ended, and
printed with the time it had. Verbs that read recordings (``ingest``, ``payload``, ``export``) have their own
benches, because replicas have no recordings.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.measure import Measure
from bench.real import QUICK, TRACES, made
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

LIMIT_S, LIMIT_MB = 5.0, 1000
"""Most processor time and memory of a verb, where :data:`VERBS` gives no other limit."""
START_S = 1.0
"""Most processor time of a start of the program; s."""
MOST_S, QUICK_S = 120, 30


class Verb(NamedTuple):
    """A command line, and the most processor time that it may use; s."""

    line: str
    limit: float = LIMIT_S


CHECK = "check STORE|-e|CHECK FORALL (v:Vehicle) ALWAYS dist(ego, v) > 2"
VERBS = (
    Verb("info STORE"),
    Verb("info STORE --trace TRACE"),
    Verb("verify STORE"),
    Verb("find STORE -p cut_in"),
    Verb("find STORE -p jaywalking"),
    Verb("find STORE|MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v.name, ttc(e, v), INTERVALS"),
    Verb("why-not STORE FRAME -p jaywalking"),
    Verb("like STORE FRAME", 1.0),
    Verb("like STORE FRAME --all", 1.0),
    Verb("sql STORE|SELECT relation, count(*) AS n FROM edges GROUP BY relation ORDER BY n DESC"),
    Verb(
        "sql STORE|SELECT kind, count(*) AS n, avg(speed) AS v FROM nodes GROUP BY kind ORDER BY kind"
    ),
    Verb("sql STORE|SELECT min(ttc), min(abs(lat_gap)) FROM pairs WHERE src_is_ego"),
    Verb("patterns run STORE cut_in"),
    Verb("check STORE -p rss_distance"),
    Verb("check STORE -p phi1 -p phi7"),
    Verb(CHECK),
    Verb(f"{CHECK} ROBUSTNESS"),
    Verb("timeline STORE -p cut_in -o FOLDER/timeline.png"),
    Verb("criticality STORE -m pet", 10.0),
    Verb("criticality STORE -m ttc_recorded", 10.0),
    Verb("select STORE --minimal --unit clip"),
    Verb("select STORE --per-class 1"),
    Verb("select STORE --rarest --budget 600s"),
    Verb("select STORE --minimal --unit trace --no-payloads -o FOLDER/minimal.lock"),
    Verb("prioritize STORE"),
    Verb("prioritize STORE --no-payloads -o FOLDER/order.lock"),
    Verb("prioritize STORE --order diverse"),
    Verb("lock verify FOLDER/minimal.lock STORE"),
    Verb("lock list FOLDER/minimal.lock"),
    Verb("diff STORE STORE"),
    Verb("diff STORE STORE -p cut_in"),
    Verb("coverage classes STORE"),
    Verb("coverage of STORE --by STORE"),
    Verb("coverage novel STORE --by STORE"),
    Verb("coverage venn STORE STORE"),
    Verb("coverage growth STORE"),
    Verb("coverage combos STORE"),
    Verb("coverage sequences STORE"),
    Verb("coverage windows STORE"),
    Verb("coverage explain STORE --by STORE"),
    Verb("show STORE FRAME -o FOLDER/frame.png"),
    Verb("report STORE -p cut_in --no-pictures -o FOLDER/report.html"),
    Verb("collection pack STORE FOLDER/collection", 60.0),
    Verb("find FOLDER/collection -p cut_in"),
    Verb("collection verify FOLDER/collection"),
)


class Ratio(NamedTuple):
    """Two lines of :data:`VERBS`: the most times of the second one that the first one may use."""

    line: str
    base: str
    limit: float


RATIOS = (
    Ratio("prioritize STORE --no-payloads -o FOLDER/order.lock", "prioritize STORE", 1.5),
    Ratio(f"{CHECK} ROBUSTNESS", CHECK, 2.0),
)


class Run(NamedTuple):
    """Processor time (s), greatest memory (MB) and exit code of a process, and the last line of its errors."""

    seconds: float
    memory: float
    code: int
    error: str


def ran(words: list[str], most: int, folder: Path) -> Run:
    """Run the program as a new process.

    Parameters
    ----------
    words : list of str
        Arguments of ``sgstore``.
    most : int
        Processor time at which the system ends it; s.
    folder : Path
        Where the errors are kept.

    Returns
    -------
    Run
    """
    errors = folder / "errors.txt"
    with errors.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "sgstore", *words],
            stdout=subprocess.DEVNULL,
            stderr=file,
        )
        resource.prlimit(process.pid, resource.RLIMIT_CPU, (most, most))
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = errors.read_text(errors="replace").strip().splitlines()
    last = lines[-1][:100] if process.returncode and lines else ""
    return Run(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000, process.returncode, last)


def words_of(line: str, names: dict[str, str]) -> list[str]:
    """Return the arguments of a line: before the first ``|`` words, after it whole texts."""
    start, *texts = line.split("|")
    words = [*start.split(), *texts]
    for name, value in names.items():
        words = [word.replace(name, value) for word in words]
    return words


def run(quick: bool = False) -> Iterator[Measure]:
    """Yield the times of all verbs, each with its memory and its limits."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # verbs inherit it
    most = QUICK_S if quick else MOST_S
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = Path(os.environ.get("SGSTORE_BENCH_REAL") or folder / "real.sgstore")
        if not path.exists():
            yield from made(path, QUICK if quick else TRACES)
        ((trace,),) = (
            Store(path)
            .sql("SELECT trace FROM frames GROUP BY trace ORDER BY count(*) DESC, trace LIMIT 1")
            .values
        )
        names = {"STORE": str(path), "FOLDER": name, "TRACE": trace, "FRAME": f"{trace}@1s"}
        start = ran(["--version"], most, folder)
        above = ["--version"] * (start.seconds > START_S)
        note = "  ".join([f"{start.memory:,.0f} MB: the baseline", *_above(start, START_S)])
        yield Measure("sgstore --version", start.seconds, "s", note)
        runs: dict[str, Run] = {}
        for verb in VERBS:
            took = runs[verb.line] = ran(words_of(verb.line, names), most, folder)
            faults = _above(took, verb.limit)
            if took.code < 0:
                faults.append("ended: did not finish")
            elif took.code not in (0, 3, 4):
                faults.append(f"exit code {took.code}: {took.error}")
            above += [verb.line] * bool(faults)
            note = f"{took.memory:6,.0f} MB  {took.seconds / start.seconds:6.1f} of the baseline"
            yield Measure(
                verb.line.replace("|", " ")[:58], took.seconds, "s", "  ".join([note, *faults])
            )
        for one in RATIOS:
            ratio = runs[one.line].seconds / runs[one.base].seconds
            wrong = ratio > one.limit or runs[one.line].code < 0
            above += [one.line] * wrong
            faults = [f"of: {one.base.replace('|', ' ')[:58]}", *[f"above {one.limit:g}"] * wrong]
            yield Measure(one.line.replace("|", " ")[:58], ratio, "", "  ".join(faults))
        many = 1 + len(VERBS) + len(RATIOS)
        yield Measure("rows above a limit", len(above), "", f"of {many}; limit 0")


def _above(took: Run, most: float) -> list[str]:
    """Return the limits of time and memory that a process exceeded, as texts."""
    faults = [f"above {most:g} s"] * (took.seconds > most)
    return faults + [f"above {LIMIT_MB} MB"] * (took.memory > LIMIT_MB)
