"""Start of the command line: ``find`` and ``--help``, as multiples of bare imports in the same run.

::

    python -m bench startup [--quick]

The baseline imports numpy, duckdb, typer, lark and rich in a new process. All figures are medians of
the processor time of whole processes, including children, so that other work on the machine counts
little. A multiple above :data:`AIM` is reported; it fails no build.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import sgstore
from bench.measure import Measure

if TYPE_CHECKING:
    from collections.abc import Iterator

AIM = 2.5
"""Greatest multiple of the bare imports."""

IMPORTS = ("-c", "import numpy, duckdb, typer, lark, rich")
PATTERN = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5"


def seconds(*arguments: str) -> float:
    """Return the processor time of a new Python process."""
    environment = {
        **os.environ,
        "PYTHONDONTWRITEBYTECODE": "",
    }  # keep compiled files, as an installed package does
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, env=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run(quick: bool) -> Iterator[Measure]:
    """Yield the multiples, and the time of the baseline."""
    rounds = 3 if quick else 5
    with tempfile.TemporaryDirectory() as folder:
        place = str(Path(folder) / "drives.sgstore")
        with sgstore.open(place, create=True) as store:
            store.ingest(Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap")
        lines = {
            "bare imports": IMPORTS,
            "find": ("-m", "sgstore", "find", place, PATTERN, "--count"),
            "--help": ("-m", "sgstore", "--help"),
        }
        for line in lines.values():  # compile and cache files
            seconds(*line)
        times: dict[str, list[float]] = {name: [] for name in lines}
        for _ in range(rounds):
            for name, line in lines.items():
                times[name].append(seconds(*line))
    bare = median(times.pop("bare imports"))
    yield Measure("import numpy, duckdb, typer, lark, rich", bare * 1000, "ms", "processor time")
    for name, taken in times.items():
        multiple = median(taken) / bare
        verdict = f"above {AIM:g}: too slow" if multiple > AIM else f"at most {AIM:g}"
        yield Measure(f"sgstore {name}", multiple, "x imports", verdict)
