"""Orders of cases beside known outcomes of simulator runs: APFD, and seconds for a million frames.

::

    python -m bench prioritize [--quick]

DeepScenario (Simula-COMPLEX/DeepScenario) tells of each run where everybody is every half second, and whether
the ego collided. Each run is a case, told by its first way-point alone; the runs of a strategy are the frames
of one imported file. The data are those of ``SGSTORE_DATA``, by default ``../shared/data``; ``--quick`` takes a
tenth of the runs. The baseline is chance: an APFD of one half.
"""

from __future__ import annotations

import json
import lzma
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.measure import Measure
from sgstore.pipeline.importing import import_graphs
from sgstore.testsets.coverage import selection_of
from sgstore.testsets.selection import (
    MEASURES,
    Priority,
    PrioritySpec,
    failed_in_order,
    fault_detection,
    prioritize,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.selection import FaultDetection

Size = tuple[str, float | None, float | None]
STRATEGIES: Final = {"random": "random strategy", "rl_based": "reinforcement learning"}
SIZES: Final = {
    "Ego": ("car", 4.7, 1.9),
    "Sedan": ("car", 4.7, 1.9),
    "SchoolBus": ("bus", 10.5, 2.6),
    "BoxTruck": ("truck", 7.5, 2.5),
    "SUV": ("car", 4.8, 2.0),
    "Jeep": ("car", 4.4, 1.9),
    "Hatchback": ("car", 4.2, 1.8),
}
"""Kind, length and width of each model, which the data do not tell; m."""
ONE_SIZE: Final = {model: (kind, 4.5, 1.8) for model, (kind, *_) in SIZES.items()}
"""The same, if all vehicles were cars of one size."""

SPLITS: Final = 10
TIES: Final = 20
PERSON: Final = ("person", 0.5, 0.5)
UNKNOWN: Final = ("vehicle", None, None)
"""A model that is not known: its size is not, either, and the order says of how many pairs there is no gap."""
BESIDE: Final = {"closing_time": ("closing_time",), "dce_3s": ("dce_3s",), "wttc": ("wttc",)}


def graph_of(number: int, run: dict[str, Any], sizes: Mapping[str, Size] = SIZES) -> dict[str, Any]:
    """The first way-point of a run as a node-link graph; Unity's axes, y up, turned clockwise from z."""
    nodes: list[dict[str, Any]] = []
    for name, (model, role) in run["o"].items():
        _, vx, vz, vy, x, z, y, turned = run["t"][name][0]
        ego = role == "Ego"
        of_others = PERSON if role == "Pedestrian" else sizes.get(model, UNKNOWN)
        kind, length, width = sizes["Ego"] if ego else of_others
        about = {"id": "ego" if ego else f"{number} {name}", "kind": kind, "is_ego": ego}
        about |= {"x": x, "y": y, "z": z, "heading": 90 - turned, "vx": vx, "vy": vy, "vz": vz}
        about |= {"length": length, "width": width, "height": 1.7}
        nodes.append({name: one for name, one in about.items() if one is not None})
    return {"graph": {"name": f"run {number}"}, "nodes": nodes, "edges": []}


def written(
    data: Path, strategy: str, folder: Path, every: int, sizes: Mapping[str, Size] = SIZES
) -> tuple[Path, dict[str, bool]]:
    """A file of graphs, one for each run, and which of them failed."""
    graphs, failed = folder / f"{strategy}.jsonl", {}
    with lzma.open(data / f"{strategy}.jsonl.xz", "rt") as lines, graphs.open("w") as file:
        for number, line in enumerate(lines):
            if number % every:
                continue
            run = json.loads(line)
            file.write(json.dumps(graph_of(number, run, sizes)) + "\n")
            failed[f"run {number}"] = run["lab"][0] == "True"
    return graphs, failed


def run(quick: bool = False) -> Iterator[Measure]:
    """Import, put in order, and compare with the outcomes."""
    data = Path(os.environ.get("SGSTORE_DATA", "../shared/data")) / "deepscenario"
    if not data.is_dir():
        yield Measure("no data", 0, "", f"{data} is not there")
        return
    with tempfile.TemporaryDirectory() as name:
        runs: dict[str, tuple[ChosenFrames, dict[str, bool]]] = {}
        for strategy in STRATEGIES:
            graphs, failed = written(data, strategy, Path(name), 10 if quick else 1)
            store = Path(name) / f"{strategy}.sgstore"
            import_graphs(store, [graphs], "nodelink")
            runs[strategy] = selection_of(str(store)), failed
        for strategy, title in STRATEGIES.items():
            yield from by_risk(title, *runs[strategy])
            yield from diverse(title, *runs[strategy])
            (other,) = runs.keys() - {strategy}
            yield from learned(title, runs[strategy], runs[other])


def _note(found: FaultDetection) -> str:
    shares = ", ".join(
        f"{part:.0%} in the first {share:.0%}" for share, part in found.found.items()
    )
    interval = f"{found.low:.3f} to {found.high:.3f}; chance is 0.5"
    of = f"of {found.failures:,} failures in {found.cases:,} cases"
    return f"APFD {found.apfd:.3f} ({interval}): {of} {shares}"


def by_risk(title: str, chosen: ChosenFrames, failed: dict[str, bool]) -> Iterator[Measure]:
    """Orders that nobody taught, and a random one."""
    for label, measures in {"risk": MEASURES, **BESIDE}.items():
        begun = time.perf_counter()
        order = prioritize(chosen, PrioritySpec(measures=measures))
        took = time.perf_counter() - begun
        found = fault_detection(failed_in_order(order, failed))
        told = "; ".join([_note(found), *order.said[1:]])
        yield Measure(f"{title}, {label}", found.apfd, "APFD", told)
        yield Measure("  for a million frames", took / len(order.units) * 1e6, "s")
    rng = np.random.default_rng(0)
    chance = fault_detection(rng.permutation(np.array(list(failed.values()))))
    yield Measure(f"{title}, in random order", chance.apfd, "APFD", _note(chance))


_KINDS: Final = """
  SELECT frame_id, min(ROW(gap, dst, dst_kind::VARCHAR
    || CASE WHEN abs(rel_heading) < 135 AND abs(rel_heading) > 45 THEN ' across' ELSE '' END
    || CASE WHEN abs(rel_heading) >= 135 THEN ' oncoming' WHEN lat_gap <= 0 THEN ' in lane' ELSE ' beside' END
    || CASE WHEN lon > 0 THEN ' ahead' ELSE ' behind' END))[3] AS kind
  FROM criticality WHERE src_is_ego GROUP BY frame_id ORDER BY frame_id
"""
"""The kind of whoever is nearest, its direction, whether it is in the ego's lane, beside or oncoming."""


def kinds_found(chosen: ChosenFrames, failed: dict[str, bool], by: Priority, ties: int) -> float:
    """Kinds of failures in the first tenth of an order, the mean of so many orders of what is equal."""
    rows = chosen.store.file.arrays(_KINDS)
    kinds = dict(zip(rows["frame_id"].tolist(), rows["kind"].tolist(), strict=True))
    found: list[int] = []
    for seed in range(ties):
        order = prioritize(chosen, PrioritySpec(by, seed=seed))
        first = order.units.first[order.picked][: len(order.picked) // 10].tolist()
        hit = failed_in_order(order, failed)[: len(first)].tolist()
        found.append(len({kinds.get(one) for one, wrong in zip(first, hit, strict=True) if wrong}))
    return float(np.mean(found))


def diverse(
    title: str, chosen: ChosenFrames, failed: dict[str, bool], ties: int = TIES
) -> Iterator[Measure]:
    """Kinds of failures that orders by risk, by diversity and by both find early."""
    for by in (Priority.risk, Priority.diverse, Priority.both):
        many = kinds_found(chosen, failed, by, ties)
        yield Measure(
            f"{title}, by {by}: kinds in the first tenth", many, "kinds", f"mean of {ties}"
        )


def learned(
    title: str,
    runs: tuple[ChosenFrames, dict[str, bool]],
    others: tuple[ChosenFrames, dict[str, bool]],
) -> Iterator[Measure]:
    """Orders learned from the other strategy, and from halves of the same one."""
    chosen, failed = runs
    spec = PrioritySpec(Priority.learned)
    begun = time.perf_counter()
    order = prioritize(chosen, spec, others[1], others[0])
    took = time.perf_counter() - begun
    found = fault_detection(failed_in_order(order, failed))
    yield Measure(f"{title}, learned from the other", found.apfd, "APFD", _note(found))
    yield Measure("  for both", took, "s")
    halves: list[float] = []
    for seed in range(SPLITS):
        names = np.random.default_rng(seed).permutation(list(failed))
        known = {name: failed[name] for name in names[: len(names) // 2].tolist()}
        rest = {name: one for name, one in failed.items() if name not in known}
        order = prioritize(chosen, PrioritySpec(Priority.learned, seed=seed), known)
        halves.append(fault_detection(failed_in_order(order, rest)).apfd)
    told = f"the least {min(halves):.3f}, the most {max(halves):.3f}"
    yield Measure(
        f"{title}, learned from a half, mean of {SPLITS}", float(np.mean(halves)), "APFD", told
    )
