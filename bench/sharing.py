"""A store that stays open: small questions, and how long a writer waits for those who ask them.

::

    python -m bench sharing [--quick]

The store is that of the bundled recording. The baseline is DuckDB itself on the same file: by a connection that
stays open, and by one that is opened for each question.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import duckdb

import sgstore
from bench.measure import Measure
from sgstore.apps.sandbox import Sandbox
from sgstore.store._locking import Access
from sgstore.store._staging import scratch

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

PATTERN = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5"
SMALL = "SELECT count(*) FROM nodes WHERE kind = 'car'"
AIM_MS = {"SELECT 1": 0.5, "pattern": 6.0, "wait": 200.0}

READER = """
import sys, threading
import sgstore
store = sgstore.open(sys.argv[1])
told = threading.Thread(target=sys.stdin.read, daemon=True)
told.start()
store.sql(sys.argv[2])
print("ready", flush=True)
while told.is_alive():
    if sys.argv[3] == "idle":
        store.sql(sys.argv[2])
        told.join(0.5)
    else:
        store.sql(sys.argv[2])
"""


def milliseconds(ask: Callable[[], object], times: int) -> tuple[float, float]:
    """The median time of a question, and its processor time in the mean."""
    ask()
    took: list[float] = []
    worked = time.process_time()
    for _ in range(times):
        start = time.perf_counter()
        ask()
        took.append(time.perf_counter() - start)
    return 1e3 * median(took), 1e3 * (time.process_time() - worked) / times


@contextmanager
def readers(path: Path, number: int, how: str) -> Generator[None]:
    """Processes that ask small questions: without pause, or twice a second."""
    pipe, command = subprocess.PIPE, [sys.executable, "-c", READER, str(path), SMALL, how]
    running = [subprocess.Popen(command, stdin=pipe, stdout=pipe) for _ in range(number)]
    for one in running:
        if one.stdout is not None:
            one.stdout.readline()
    yield
    for one in running:
        one.communicate()


def waits(path: Path, times: int) -> tuple[float, float]:
    """How long a writer waits until it has the file: the median and the longest; ms."""
    took: list[float] = []
    for number in range(times):
        with scratch(path.parent / f"spill-{number}") as connection:
            start = time.perf_counter()
            with Access(path).attached(connection):
                took.append(1e3 * (time.perf_counter() - start))
        time.sleep(0.25)
    return median(took), max(took)


def small_questions(path: Path, times: int) -> Iterator[Measure]:
    """SELECT 1 and a pattern, through a store that stays open, beside DuckDB alone."""
    with duckdb.connect(str(path), read_only=True) as connection:
        bare, worked = milliseconds(lambda: connection.execute("SELECT 1").fetchall(), times)
    yield Measure("SELECT 1 by DuckDB, kept open", bare, "ms", f"{worked:.2f} ms of processor time")

    def anew() -> None:
        with duckdb.connect(str(path), read_only=True) as connection:
            connection.execute("SELECT 1").fetchall()

    took, worked = milliseconds(anew, max(times // 20, 5))
    yield Measure(
        "SELECT 1 by DuckDB, opened for it", took, "ms", f"{worked:.2f} ms of processor time"
    )
    with sgstore.open(path) as store:
        took, worked = milliseconds(lambda: store.sql("SELECT 1").values, times)
        note = f"aim {AIM_MS['SELECT 1']}; {worked:.2f} ms of processor time; {took / bare:.1f} times DuckDB"
        yield Measure("SELECT 1 through Store", took, "ms", note)
        took, worked = milliseconds(lambda: list(store.find(PATTERN)), max(times // 10, 10))
        note = f"aim {AIM_MS['pattern']:g}; {worked:.2f} ms of processor time"
        yield Measure("a simple pattern on the sample", took, "ms", note)
    with Sandbox(path) as box:
        took, _ = milliseconds(lambda: box.sql(SMALL), times)
        yield Measure("small questions to a Sandbox", 1e3 / took, "a second", "aim 100")


def run(quick: bool = False) -> list[Measure]:
    """Small questions, and writers beside readers."""
    times = 5 if quick else 20
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "town.sgstore"
        with sgstore.open(path, create=True) as store:
            store.ingest(Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap")
        table = list(small_questions(path, 20 * times))
        for number, how, label in (
            (0, "", "a writer alone has the file after"),
            (2, "idle", "… beside 2 open stores of other processes"),
            (2, "busy", "… beside 2 that ask without pause"),
        ):
            with readers(path, number, how):
                usual, longest = waits(path, times)
            aim = f"aim {AIM_MS['wait']:g}; " * (number > 0)
            table.append(Measure(label, usual, "ms", f"{aim}longest {longest:.0f} ms of {times}"))
    return table
