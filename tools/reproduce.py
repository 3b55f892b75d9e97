"""Tables of the literature and of this project, made anew: ``make reproduce`` writes ``docs/reproduction.md``.

::

    SGSTORE_DATA=FOLDER SGSTORE_LONG=1 PYTHONPATH=. python tools/reproduce.py [PAGE]

S3C's coverage of Town02, SGSM's verdicts, the order of DeepScenario's runs, and the measures of
CommonRoad-CriMe. Every table says what was published, or what chance would be, beside what comes out here; the
page ends with versions and digests of all files that were read.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import test_crime
from test_coverage import PRECONDITIONS
from test_temporal import files_of, property_named
from thorough import LONG

from bench.prioritize import ONE_SIZE, SIZES, STRATEGIES, TIES, kinds_found, written
from sgstore.draw import draw_curve
from sgstore.pipeline.importing import import_graphs
from sgstore.temporal._verdicts import PRESUMABLY_TRUE, Settled
from sgstore.testsets.coverage import (
    Specification,
    classed,
    classes,
    selection_of,
    slot_coverage,
    specification,
)
from sgstore.testsets.selection import (
    Priority,
    PrioritySpec,
    failed_in_order,
    failure_curve,
    fault_detection,
    prioritize,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from sgstore.testsets.coverage import ChosenFrames

ROOT: Final = Path(__file__).parents[1]
DATA: Final = Path(os.environ.get("SGSTORE_DATA", ROOT.parent / "shared" / "data"))
READ: Final = ("s3c/carla_max_vehicle_v3_Town02.csv.xz", "sgsm/*", "deepscenario/*", "commonroad/*")
PUBLISHED: Final = {"1": (5, 242), "2": (0, 31), "3": (0, 24), "4": (4, 22), "5": (3, 426)}
"""Cells that are covered, and all, of each precondition. (Woodlief et al., ICSE 2024, table 2.)"""
OWN, SAME = "size of the model", "one size"
SIZED: Final = {OWN: SIZES, SAME: ONE_SIZE}
CALM: Final = """
  MATCH (e:Ego) WHERE NOT EXISTS {(v:Entity&!Ego) WHERE gap(e, v) <= 0.5 OR closing_time(e, v) <= 1}
  RETURN FRAMES
"""
"""Runs that are not critical from the start."""
VEHICLES: Final = "MATCH (v:(Car|Truck)&!Ego)-[:isIn]->(l:Lane) RETURN v.kind, l.name"


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """A table of the page."""
    head = [*head]
    return [*(f"| {' | '.join(map(str, row))} |" for row in (head, ["---"] * len(head), *rows)), ""]


def s3c(folder: Path) -> Iterator[str]:
    """What Town02 covers of the preconditions of S3C."""
    store = folder / "s3c.sgstore"
    import_graphs(store, [DATA / READ[0]], "s3c")
    chosen = selection_of(str(store))
    found: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for name, part, of, *_ in slot_coverage(chosen, Specification.read(PRECONDITIONS))[0].rows[:-1]:
        found[name[0]] = found[name[0]][0] + part, found[name[0]][1] + of
    found["4"] = specification(chosen, VEHICLES, 22)[0].rows[0][1:3]
    many = len(classes(classed(chosen)).rows)
    yield (
        f"Scene graphs of Town02 with most vehicles: {many:,} classes; S3C published 1,254 graphs that differ"
        " pairwise.\n"
    )
    rows = ((n, "{} of {}".format(*PUBLISHED[n]), "{} of {}".format(*found[n])) for n in PUBLISHED)
    yield from table(("precondition", "published", "here"), rows)


def sgsm() -> Iterator[str]:
    """Verdicts of SGSM at every frame."""
    told: dict[str, Counter[str]] = defaultdict(Counter)
    for _, system, name, columns, wanted in files_of(
        DATA / "sgsm" / "extending_sgsm_results.tar.xz"
    ):
        here = (
            Settled(property_named(name), columns, np.arange(len(wanted))).statuses()
            >= PRESUMABLY_TRUE
        )
        told[name] += Counter(
            {system: 1, "verdicts": len(wanted), "equal": int((here == wanted).sum())}
        )
        told[name] += Counter({f"{system} violated": int(not wanted.all())})
    every = sum(told.values(), Counter[str]())
    names = ("verdicts", "equal", "LAV violated", "TCP violated")
    rows = [(name, *(f"{told[name][n]:,}" for n in names)) for name in sorted(told)]
    yield from table(
        ("property", "verdicts", "equal here", "drives of LAV that violate it", "of TCP"),
        [*rows, ("all", *(f"{every[n]:,}" for n in names))],
    )


def deepscenario(folder: Path) -> Iterator[str]:
    """How soon orders of the runs of DeepScenario find the failures."""
    runs: dict[str, tuple[ChosenFrames, dict[str, bool]]] = {}
    calm: dict[str, dict[str, ChosenFrames]] = defaultdict(dict)
    for (title, sizes), strategy in product(SIZED.items(), STRATEGIES):
        graphs, failed = written(DATA / "deepscenario", strategy, folder, 1, sizes)
        store = folder / f"{strategy} {title}.sgstore"
        import_graphs(store, [graphs], "nodelink")
        runs.setdefault(strategy, (selection_of(str(store)), failed))
        calm[strategy][title] = selection_of(f"{store}:{CALM}")
    rows: list[tuple[object, ...]] = []
    kinds: list[tuple[object, ...]] = []
    started: list[tuple[object, ...]] = []
    for strategy, title in STRATEGIES.items():
        chosen, failed = runs[strategy]
        (other,) = runs.keys() - {strategy}
        orders = {
            "risk": prioritize(chosen, PrioritySpec()),
            "risk and diversity": prioritize(chosen, PrioritySpec(Priority.both)),
            "learned from the other strategy": prioritize(
                chosen, PrioritySpec(Priority.learned), runs[other][1], runs[other][0]
            ),
        }
        chance = np.random.default_rng(0).permutation(np.array(list(failed.values())))
        hits_of = {"random order": chance}
        hits_of |= {by: failed_in_order(order, failed) for by, order in orders.items()}
        for by, hits in hits_of.items():
            one = fault_detection(hits)
            early = ", ".join(f"{one.found[s]:.0%}" for s in sorted(one.found))
            rows.append((title, by, f"{one.apfd:.3f} ({one.low:.3f} to {one.high:.3f})", early))
        hits = failed_in_order(orders["risk"], failed)
        picture = ROOT / "docs" / "pictures" / f"reproduction-{strategy}.png"
        draw_curve(
            failure_curve(hits),
            int(hits.sum()),
            picture,
            unit="case",
            title=f"DeepScenario, {title}: by risk",
            below=f"APFD {rows[-3][2]}",
            words=("failures found", "in order"),
        )
        started += without_the_critical(title, calm[strategy], runs[strategy], runs[other])
        kinds.append(
            (
                title,
                *(
                    f"{kinds_found(chosen, failed, by, TIES):.1f}"
                    for by in (Priority.risk, Priority.diverse, Priority.both)
                ),
            )
        )
    yield from table(
        ("runs", "order", "APFD (95 %, bootstrap)", "failures in the first 5, 10, 20 %"), rows
    )
    yield (
        "Without the runs that are critical from the start (a gap of at most 0.5 m or a `closing_time` of at"
        " most 1 s). Which runs these are depends on the sizes, which the data do not tell: each model has its"
        " own, as above, or all vehicles are 4.5 m long and 1.8 m wide:\n"
    )
    head = ("runs", "without the critical ones by", "left", "failures", "sizes in the order")
    yield from table((*head, "APFD by risk", "learned from the other strategy"), started)
    yield "![Failures of the random strategy, by risk](pictures/reproduction-random.png)\n"
    yield "![Failures of reinforcement learning, by risk](pictures/reproduction-rl_based.png)\n"
    yield (
        "Kinds of failures in the first tenth (of whoever is nearest: kind and direction, in the lane, beside"
        f" or oncoming), mean of {TIES} orders of what is equal:\n"
    )
    yield from table(("runs", "by risk", "by diversity", "by both"), kinds)


def without_the_critical(
    title: str,
    calm: dict[str, ChosenFrames],
    runs: tuple[ChosenFrames, dict[str, bool]],
    others: tuple[ChosenFrames, dict[str, bool]],
) -> Iterator[tuple[object, ...]]:
    """Rows of how soon failures are found among the runs that are not critical from the start."""
    frames = {by: one.frame_id for by, one in calm.items() if one.frame_id is not None}
    first = {
        by: one.store.sql("SELECT min(frame_id) FROM frames").values[0][0]
        for by, one in calm.items()
    }
    for by, in_order in ((OWN, OWN), (SAME, OWN), (SAME, SAME)):
        chosen = replace(calm[in_order], frame_id=frames[by] - first[by] + first[in_order])
        told = [prioritize(chosen, PrioritySpec())]
        told.append(prioritize(chosen, PrioritySpec(Priority.learned), others[1], others[0]))
        risk, learned = (fault_detection(failed_in_order(one, runs[1])) for one in told)
        yield (
            *(title, by, f"{risk.cases:,}", risk.failures, in_order),
            *(f"{one.apfd:.3f} ({one.low:.3f} to {one.high:.3f})" for one in (risk, learned)),
        )


def crime() -> Iterator[str]:
    """Measures beside those of CommonRoad-CriMe."""
    yield (
        "Where its number is another one, it is made here again from the same states: by our function, given"
        " what theirs takes (`as taken`), or by its own definition and these causes,"
        " which tests/edges/test_crime.py explains. 0 where there is nothing to avoid is NULL here."
        " No value is left over.\n"
    )
    rows: list[tuple[object, ...]] = []
    for measure, (ours, judge) in test_crime.COMPARED.items():
        counts = Counter(map(judge, test_crime.cases(measure)))
        told = [counts.pop("equal", 0)]
        same = [cause for cause in counts if cause.startswith(("as taken", "last step"))]
        told += [sum(counts.pop(cause) for cause in same)]
        told += [counts.pop("NULL here", 0)]
        rest = ", ".join(f"{cause} {many}" for cause, many in counts.most_common())
        rows.append(
            (measure, f"`{ours}`", f"{counts.total() + sum(told):,}", *told, rest or "none")
        )
    head = ("there", "here", "finite values", "equal to 0.01", "equal as taken", "NULL here")
    yield from table((*head, "the others, by cause"), rows)


def digests() -> Iterator[str]:
    """Versions and digests."""
    names = ("sgstore", "duckdb", "numpy", "scikit-learn", "shapely")
    rows = [("Python", platform.python_version()), *((name, version(name)) for name in names)]
    yield from table(("program", "version"), rows)
    files = sorted(path for pattern in READ for path in DATA.glob(pattern) if path.is_file())
    hashes = (
        (f.relative_to(DATA), f"`{hashlib.sha256(f.read_bytes()).hexdigest()}`") for f in files
    )
    yield from table(("file", "SHA-256"), hashes)


HEAD: Final = (
    "`SGSTORE_DATA=FOLDER make reproduce` made this page from public data, which do not come along;"
    " [their files and digests](#versions-and-data)."
)


def main(page: Path) -> None:
    if not LONG:
        sys.exit("SGSTORE_LONG=1 is not set: only a part of the data would be read")
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        parts = {
            "S3C: coverage of Town02": s3c(Path(name)),
            "SGSM: verdicts at every frame": sgsm(),
            "DeepScenario: failures first": deepscenario(Path(name)),
            "CommonRoad-CriMe: measures": crime(),
            "Versions and data": digests(),
        }
        lines = [
            "# Reproduction",
            "",
            HEAD,
            "",
        ]
        for title, part in parts.items():
            lines += [f"## {title}", "", *part]
            print(title, f"{time.perf_counter() - begun:.0f} s", flush=True)
    page.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "docs" / "reproduction.md")
