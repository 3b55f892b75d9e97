"""Clips that overlap: what is a clip, few of them, what they share counts once; against exhaustive search."""

from __future__ import annotations

from collections import Counter
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import ConfigError
from sgstore.ingest import ingest
from sgstore.model.frame_ids import seq_of
from sgstore.query import Store
from sgstore.testsets.coverage import ChosenFrames, classed
from sgstore.testsets.locks import frames_of_lock, intersect, read_lock, union, verify
from sgstore.testsets.selection import (
    Budget,
    Selection,
    SelectionSpec,
    SelectionUnit,
    Strategy,
    curve,
    locked_selection,
    parse_split,
    select,
    split,
    split_table,
    units_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

SAMPLE = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("overlapping")
    (folder / "one.mcap").symlink_to(SAMPLE)
    ingest(folder / "s.sgstore", [folder / "one.mcap"], until=20)
    store = Store(folder / "s.sgstore")
    with store.file.snapshot():
        yield store


def whole(store: Store) -> ChosenFrames:
    return ChosenFrames("s", store)


def some(store: Store, *ranges: tuple[int, int]) -> ChosenFrames:
    """Frames by number, the last one of each range not included."""
    frame_id = store.file.abstracted.times()[0]
    numbers = np.concatenate([np.arange(*one) for one in ranges])
    return ChosenFrames("some", store, frame_id[np.isin(seq_of(frame_id), numbers)])


def frames_of(found: Selection) -> set[int]:
    """Frames of all chosen units, unit by unit."""
    units = found.units
    return {
        frame
        for unit in found.picked.tolist()
        for frame in units.frame_id[units.begin[unit] : units.end[unit]].tolist()
    }


# What a clip is ---------------------------------------------------------------------------------------------


def test_clips_begin_a_stride_after_one_another_until_one_reaches_the_end(store: Store) -> None:
    units = units_of(some(store, (0, 33)), SelectionUnit.clip, 1.0, 0.5)

    spans = list(zip(seq_of(units.first).tolist(), seq_of(units.last).tolist(), strict=True))

    assert spans == [(0, 9), (5, 14), (10, 19), (15, 24), (20, 29), (25, 32)]
    assert units.overlap


def test_clips_that_begin_with_every_frame_are_as_many_as_fit(store: Store) -> None:
    units = units_of(whole(store), SelectionUnit.clip, 2.0, 0.1)

    assert len(units) == 201 - 20 + 1
    assert (units.sizes == 20).all()
    assert (np.diff(units.begin) == 1).all()


def test_a_stride_as_long_as_a_clip_is_no_stride(store: Store) -> None:
    plain, told = (
        units_of(some(store, (0, 95)), SelectionUnit.clip, 2.0, stride) for stride in (None, 2.0)
    )

    assert not plain.overlap
    assert plain.begin.tolist() == told.begin.tolist() == [0, 20, 40, 60, 80]
    assert plain.end.tolist() == told.end.tolist() == [20, 40, 60, 80, 95]


def test_no_clip_reaches_over_a_gap(store: Store) -> None:
    chosen = some(store, (0, 12), (20, 47))

    units = units_of(chosen, SelectionUnit.clip, 1.0, 0.3)
    first, last = seq_of(units.first), seq_of(units.last)

    assert first.tolist() == [0, 3, 20, 23, 26, 29, 32, 35, 38]
    assert last.tolist() == [9, 11, 29, 32, 35, 38, 41, 44, 46]


def test_a_stride_below_the_period_begins_a_clip_with_every_frame_once(store: Store) -> None:
    fine, each = (units_of(whole(store), SelectionUnit.clip, 1.0, stride) for stride in (1e-6, 0.1))

    assert fine.begin.tolist() == each.begin.tolist()


@pytest.mark.parametrize("stride", [0.0, -1.0, 2.5, float("nan"), float("inf")])
def test_a_stride_that_would_leave_frames_out_is_refused(store: Store, stride: float) -> None:
    with pytest.raises(ConfigError, match="every frame is in one"):
        units_of(whole(store), SelectionUnit.clip, 2.0, stride)


# Few of them ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stride", [0.1, 0.3, 0.5])
def test_clips_that_may_begin_anywhere_keep_every_class_with_no_more_than_a_grid(
    store: Store, stride: float
) -> None:
    grid = select(whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL"))
    found = select(
        whole(store),
        SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL", stride_s=stride),
    )
    of = classed(whole(store), "EL")
    kept = {
        c
        for f, c in zip(of.frame_id.tolist(), of.code.tolist(), strict=True)
        if f in frames_of(found)
    }

    assert kept == set(of.code.tolist())
    assert found.result["bound"] <= found.result["cost"]
    if stride == 0.5:  # every clip of the grid is one of these
        assert found.result["cost"] <= grid.result["cost"]
    assert found.result["frames"] == len(frames_of(found))
    assert found.result["seconds"] == pytest.approx(len(frames_of(found)) * 0.1)


# What they share counts once ----------------------------------------------------------------------------------


def unions(found: Selection) -> list[tuple[int, set[int]]]:
    """Of every choice of units: frames of its union, and what it holds."""
    units, held = found.units, found.holdings
    assert held is not None
    rows = [set(range(b, e)) for b, e in zip(units.begin.tolist(), units.end.tolist(), strict=True)]
    has = [set(held.pairs[1][held.pairs[0] == unit].tolist()) for unit in range(len(units))]
    choices = [c for n in range(len(units) + 1) for c in combinations(range(len(units)), n)]
    return [
        (len(set().union(*(rows[u] for u in c))), set().union(*(has[u] for u in c)))
        for c in choices
    ]


@pytest.mark.parametrize("low", [0, 90, 150])
@pytest.mark.parametrize("stride", [0.1, 0.2])
def test_the_cheapest_union_lies_between_bound_and_cost(
    store: Store, low: int, stride: float
) -> None:
    chosen = some(store, (low, low + (13 if stride < 0.2 else 23)))
    wish = SelectionSpec(
        Strategy.minimal, SelectionUnit.clip, 0.4, "RSV", objective="frames", stride_s=stride
    )
    found = select(chosen, wish)
    assert found.holdings is not None
    everything = set(range(len(found.holdings.weight)))
    best = min(frames for frames, has in unions(found) if has == everything)

    assert found.result["bound"] <= best <= found.result["cost"] == len(frames_of(found))
    assert found.result["cost"] <= found.result["greedy"]
    assert found.result["kept"] == found.holdings.total


@pytest.mark.parametrize("budget", [4, 6, 9])
@pytest.mark.parametrize("low", [0, 60, 120])
def test_within_a_budget_of_frames_what_is_kept_lies_below_the_best_and_its_bound(
    store: Store, budget: int, low: int
) -> None:
    chosen = some(store, (low, low + 13))
    most = Budget.parse(f"{budget}frames")
    found = select(
        chosen,
        SelectionSpec(Strategy.minimal, SelectionUnit.clip, 0.4, "RSV", budget=most, stride_s=0.1),
    )
    best = max(len(has) for frames, has in unions(found) if frames <= budget)

    assert len(frames_of(found)) <= budget
    assert found.result["kept"] <= best
    assert best <= found.result.get("at_most", best)
    assert found.result["kept"] >= best / 2


@pytest.mark.parametrize("budget", ["12frames", "3s", "700kB"])
@pytest.mark.parametrize(
    "way", [Strategy.minimal, Strategy.rarest, Strategy.every, Strategy.stratify]
)
def test_no_budget_is_exceeded_by_the_union(store: Store, budget: str, way: Strategy) -> None:
    most = Budget.parse(budget)
    wish = SelectionSpec(
        way, SelectionUnit.clip, 0.5, "EL", budget=most, stride_s=0.1, by="ego.speed > 3"
    )

    found = select(whole(store), wish)

    assert 0 < found.units.together(found.picked, most.measure) <= most.most + 1e-6
    if most.measure == "frames":
        assert len(frames_of(found)) <= most.most
    if most.measure == "seconds":
        assert found.result["seconds"] <= most.most + 1e-6


def test_at_random_no_clip_is_taken_that_others_hold_already(store: Store) -> None:
    wish = SelectionSpec(
        Strategy.every, SelectionUnit.clip, 1.0, budget=Budget.parse("6s"), stride_s=0.1
    )

    found = select(whole(store), wish)
    before: set[int] = set()
    new: list[int] = []
    for unit in found.picked.tolist():
        own = set(range(int(found.units.begin[unit]), int(found.units.end[unit])))
        new.append(len(own - before))
        before |= own

    assert min(new) > 0
    assert sum(new) == 60


def test_each_class_several_times_is_not_for_clips_that_overlap() -> None:
    with pytest.raises(ConfigError, match="leave out --stride"):
        SelectionSpec(Strategy.per_class, SelectionUnit.clip, 2.0, each=2, stride_s=0.5)


# Locks, parts, curves -----------------------------------------------------------------------------------------


def test_a_lock_has_each_clip_as_a_case_and_what_they_share_once(
    store: Store, tmp_path: Path
) -> None:
    wish = SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "RSV", stride_s=0.3)
    found = select(whole(store), wish)
    lock = locked_selection(found, payloads=False)
    lock.write(tmp_path / "some.lock")
    read = read_lock(tmp_path / "some.lock")

    assert len(read.cases) == len(found.picked) == len({case.id for case in read.cases})
    assert any(a.last >= b.first for a, b in pairwise(read.cases))
    assert set(frames_of_lock(read, store).tolist()) == frames_of(found)
    assert list(verify(read, store, payloads=False)) == []
    assert union(read, read).cases == intersect(read, read).cases == read.cases
    assert read.selection["stride_s"] == 0.3


def test_each_case_of_a_lock_is_exported_as_a_clip_of_its_own(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = select(
        whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL", stride_s=0.3)
    )
    lock = locked_selection(found, payloads=False)
    lock.write(tmp_path / "some.lock")
    asked = ["export", str(store.file.path), "--lock", str(tmp_path / "some.lock")]

    code = run([*asked, "--to", str(tmp_path / "out"), "--as", "parquet", "--json"])
    frames = pq.read_table(tmp_path / "out" / "frames.parquet").to_pylist()
    of_clips = Counter(row["clip"] for row in frames)

    assert code == 0
    assert sorted(of_clips.values()) == sorted(case.frames for case in lock.cases)
    assert {row["frame_id"] for row in frames} == frames_of(found)
    assert run([*asked, "MATCH (e:Ego)", "--to", str(tmp_path / "more")]) == 2
    assert "expected one of" in capsys.readouterr().err


def test_parts_count_frames_once_and_share_no_recording(store: Store) -> None:
    found = select(
        whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "RSV", stride_s=0.3)
    )
    shares = parse_split("train=0.7,test=0.3")

    rows = split_table(found, split(found, shares), shares).dicts()

    assert [row["frames"] for row in rows] == [len(frames_of(found)), 0]
    assert [row["units"] for row in rows] == [len(found.picked), 0]


def test_the_curve_is_beside_the_same_clips_in_random_order(store: Store) -> None:
    found = select(
        whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL", stride_s=0.1)
    )
    drawn = curve(found)
    held, units = found.holdings, found.units
    assert held is not None
    rng = np.random.default_rng(3)
    needed: list[int] = []
    seconds: list[float] = []
    for _ in range(200):
        order, has = rng.permutation(len(units)), set[int]()
        for many, unit in enumerate(order.tolist(), start=1):
            has |= set(held.pairs[1][held.pairs[0] == unit].tolist())
            if len(has) == held.total:
                needed.append(many)
                seconds.append(len(units.rows_of(order[:many])) * 0.1)
                break

    assert drawn.needed == len(found.picked) < drawn.at_random
    assert drawn.at_random == pytest.approx(np.mean(needed), rel=0.1)
    assert drawn.spread == pytest.approx(np.std(needed), rel=0.25)
    assert drawn.at_random_s == pytest.approx(np.mean(seconds), rel=0.02)


SUMO = [(0.5, {}), (0.1, {}), (0.5, {"combos": 2, "abstraction": "ER"})]


@pytest.mark.parametrize(("stride", "wish"), SUMO)
def test_of_a_drive_of_sumo_less_than_half_of_what_random_order_needs_and_none_too_many(
    data: Path, tmp_path_factory: pytest.TempPathFactory, stride: float, wish: dict[str, Any]
) -> None:
    place = tmp_path_factory.getbasetemp() / "sumo.sgstore"
    if not place.exists():
        ingest(place, [data / "traces" / "sumo" / "Town10HD_sumo_osi.mcap"])
    chosen = ChosenFrames("sumo", Store(place))

    found = select(
        chosen, SelectionSpec(Strategy.minimal, SelectionUnit.clip, 2.0, **wish, stride_s=stride)
    )
    drawn = curve(found)

    assert found.result["cost"] <= 1.05 * found.result["bound"]
    assert found.result["kept"] == found.result["elements"]
    assert drawn.needed < 0.5 * drawn.at_random
