"""Selections of collections: bundles tell the cheapest unit of a set of classes; all is as of one store."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from oracle_collection import renamed
from oracle_worlds import random_world
from thorough import some

from sgstore.collection import Collection, pack
from sgstore.errors import ConfigError
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.query import Store
from sgstore.store import StoreFile
from sgstore.testsets.coverage import ChosenFrames, classed, frames_of
from sgstore.testsets.selection import (
    SelectionSpec,
    SelectionUnit,
    Strategy,
    curve,
    listed,
    select,
    split,
    split_table,
    units_of,
)
from sgstore.testsets.selection._bundles import cheapest_units

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.testsets.selection import Selection

pytestmark = pytest.mark.usefixtures("own_cache")

SEEDS = range(8)
TRACES = 6
CHOSEN = ("", "MATCH (a:Car)-[:near]->(b)", "MATCH (a:Truck)")
SPECS = [
    SelectionSpec(Strategy.minimal, unit, 0.3, name, objective=least, seed=seed)
    for seed, (unit, name, least) in enumerate(
        [
            (SelectionUnit.frame, "E", "units"),
            (SelectionUnit.clip, "E", "frames"),
            (SelectionUnit.clip, "EL", "seconds"),
            (SelectionUnit.clip, "RSV", "units"),
            (SelectionUnit.trace, "ER", "frames"),
            (SelectionUnit.trace, "E", "units"),
        ]
    )
]
SPECS.append(SelectionSpec(Strategy.per_class, SelectionUnit.clip, 0.4, "E", objective="frames"))
SPECS.append(replace(SPECS[2], stride_s=SPECS[2].clip_s))


def split_at_random(seed: int, folder: Path) -> tuple[Store, Collection]:
    """A store of a random world, and a collection whose bundles have its traces as chance will."""
    path = folder / f"{seed}.sgstore"
    StoreFile.create(path)
    renamed(random_world(seed, traces=TRACES, frames=5 + seed % 7, path=path).connection, seed)
    size = 1 + seed % 4
    pack(path, folder / f"{seed}-{size}", bundle_traces=size)
    return Store(path), Collection(folder / f"{seed}-{size}")


def told(found: Selection) -> dict[str, Any]:
    """All that is said of a selection."""
    parts = split(found, {"train": 0.6, "test": 0.4})
    drawn = curve(found, 5)
    first = found.units.first[found.picked].tolist()
    return {
        "first": first,
        "last": found.units.last[found.picked].tolist(),
        "times": [t.tolist() for _, t, _ in found.units.cases(found.picked)],
        "result": found.result,
        "said": found.said,
        "listed": listed(found),
        "split": [parts[one] for one in found.picked.tolist()],
        "table": split_table(found, parts, {"train": 0.6, "test": 0.4}),
        "curve": (drawn.table, drawn.needed, drawn.at_random),
    }


@pytest.mark.parametrize("seed", some([*SEEDS], 8))
def test_bundles_tell_enough_for_the_smallest_selection(seed: int, tmp_path: Path) -> None:
    store, whole = split_at_random(seed, tmp_path)
    for number, spec in enumerate(some(SPECS, 2)):
        query = CHOSEN[(number + seed) % len(CHOSEN)]
        frames = frames_of(store, query) if query else None
        expected = select(ChosenFrames("all", store, frames), spec)
        found = select(ChosenFrames("all", whole, frames), spec)
        assert told(found) == told(expected)
        assert found.units.total == len(expected.units) == expected.units.total


@pytest.mark.parametrize("seed", some([*SEEDS], 4))
def test_a_bundle_tells_the_cheapest_unit_of_each_set_of_classes(seed: int, tmp_path: Path) -> None:
    store, whole = split_at_random(seed, tmp_path)
    chosen = ChosenFrames("all", store)
    units, of = units_of(chosen, SelectionUnit.clip, 0.3), classed(chosen, "E")
    cost, rank = units.costs("frames"), units.ranks(3)
    best: dict[tuple[str, frozenset[str]], tuple[float, int, int]] = {}
    for unit, (low, high) in enumerate(zip(units.begin, units.end, strict=True)):
        rows = np.isin(of.frame_id, units.frame_id[low:high]) & of.known
        held = frozenset(of.names[code] for code in of.code[rows].tolist())
        home = whole.snapshot.homes[int(units.frame_id[low]) >> SEQ_BITS]
        one = float(cost[unit]), int(rank[unit]), int(units.frame_id[low])
        if held:
            best[home, held] = min(best.get((home, held), one), one)
    wish = replace(SPECS[1], seed=3).wished
    made, _ = cheapest_units(ChosenFrames("all", whole), whole, wish)
    assert made.first.tolist() == sorted(first for _, _, first in best.values())
    assert made.total == len(units)


def test_what_no_clip_can_be_is_refused_as_of_one_store(tmp_path: Path) -> None:
    store, whole = split_at_random(1, tmp_path)
    for wish in ({"clip_s": 0.0}, {"stride_s": 9.0}):
        spec = replace(SPECS[1], **wish)
        with pytest.raises(ConfigError) as expected:
            select(ChosenFrames("all", store), spec)
        with pytest.raises(ConfigError) as refused:
            select(ChosenFrames("all", whole), spec)
        assert str(refused.value) == str(expected.value)
