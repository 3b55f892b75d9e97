"""Small parts of a million frames that keep every class, beside a random order and the bound from below.

::

    python -m bench selection [--quick]

The store is made up as for ``coverage``: a million frames, scene after scene, how often a scene comes
falling with its rank. ``--quick`` takes a fiftieth. The baseline is units in random order: how many it takes
to keep as much.
``SGSTORE_BENCH_SELECTION=FOLDER`` keeps the store, and takes it if it is there; ``SGSTORE_BENCH_STORE=FILE``
takes another store instead.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.coverage import PARTS, Library, made
from bench.measure import Measure
from sgstore.errors import ConfigError
from sgstore.pipeline.importing._run import parts_map
from sgstore.testsets.coverage import selection_of
from sgstore.testsets.selection import Budget, SelectionSpec, SelectionUnit, Strategy, curve, select

if TYPE_CHECKING:
    from collections.abc import Iterator

FRAMES = 1_000_000
WISHES = {
    "frames": SelectionSpec(Strategy.minimal),
    "clips of 2 s": SelectionSpec(Strategy.minimal, SelectionUnit.clip, 2.0),
    "clips of 2 s within 1 h": SelectionSpec(
        Strategy.minimal, SelectionUnit.clip, 2.0, budget=Budget.parse("1h")
    ),
    "clips of 2 s every 0.5 s": SelectionSpec(
        Strategy.minimal, SelectionUnit.clip, 2.0, stride_s=0.5
    ),
    "clips of 2 s, pairs of features": SelectionSpec(
        Strategy.minimal, SelectionUnit.clip, 2.0, "ER", combos=2
    ),
    "frames within 100 MB": SelectionSpec(Strategy.minimal, budget=Budget.parse("100MB")),
}


def run(quick: bool = False) -> Iterator[Measure]:
    """Build, select, and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(os.environ.get("SGSTORE_BENCH_SELECTION") or name)
        made_up = folder / f"selection{'-quick' if quick else ''}.sgstore"
        store = Path(os.environ.get("SGSTORE_BENCH_STORE") or made_up)
        if not store.exists():
            road_map = parts_map("bench", '{"format": "bench"}', PARTS)
            frames = FRAMES // (50 if quick else 1)
            library = Library(np.random.default_rng(0), road_map)
            seconds = made(store, frames, 1, library, road_map)
            yield Measure("store made", frames / seconds, "frames/s", f"{frames:,} frames")
        for label, wish in WISHES.items():
            yield from _selected(str(store), label, wish)


def _selected(store: str, label: str, wish: SelectionSpec) -> Iterator[Measure]:
    start = time.perf_counter()
    try:
        found = select(selection_of(store), wish)
    except (
        ConfigError
    ) as error:  # another store may have more combinations than can be gone through
        yield Measure(f"minimal set of {label}", time.perf_counter() - start, "s", str(error))
        return
    seconds = time.perf_counter() - start
    result = found.result
    note = "; ".join(found.said[:1]) + "; wanted: 10 s"
    yield Measure(f"minimal set of {label}", seconds, "s", note)
    if "bound" in result:
        above = result["cost"] / max(result["bound"], 1)
        note = f"{result['cost']:,.0f}, lower bound {result['bound']:,}, greedy {result['greedy']:,.0f}"
        yield Measure("    times its lower bound", above, "", note)
        start = time.perf_counter()
        drawn = curve(found)
        seconds = time.perf_counter() - start
        note = f"{drawn.at_random:,.0f} in random order, mean of {drawn.orders} orders"
        yield Measure("    of what random order needs", drawn.needed / drawn.at_random, "", note)
        yield Measure("    its curve", seconds, "s")
