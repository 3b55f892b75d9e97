"""Selection: few units that keep everything, against exhaustive search; budgets, strata, splits, curves."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from recordings import Recorder, car, person

import sgstore
from sgstore.errors import ConfigError, QueryError
from sgstore.ingest import ingest
from sgstore.model.frame_ids import seq_of, trace_of
from sgstore.pipeline.importing import import_graphs
from sgstore.query import Store
from sgstore.testsets.coverage import ChosenFrames, classed, expected_classes, selection_of
from sgstore.testsets.selection import (
    Budget,
    Cover,
    Measure,
    Selection,
    SelectionSpec,
    SelectionUnit,
    SetFamily,
    Strategy,
    curve,
    listed,
    minimal,
    parse_split,
    select,
    split,
    split_table,
    units_of,
    within,
)
from sgstore.testsets.selection._bounds import bounded
from sgstore.testsets.selection._cover import reduced
from sgstore.testsets.selection._sets import greedy

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(15)

SAMPLE = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
SEEDS = range(36)
SOLVER = find_spec("highspy") is not None
needs_solver = pytest.mark.skipif(not SOLVER, reason="needs the extra [solver]")


def family(seed: int) -> tuple[SetFamily, np.ndarray]:
    """A few random sets, of costs that are one, whole, or any; and which elements each holds."""
    rng = np.random.default_rng(seed)
    sets, elements = int(rng.integers(1, 10)), int(rng.integers(1, 12))
    holds = rng.random((sets, elements)) < rng.uniform(0.1, 0.6)
    cost = (np.ones(sets), rng.integers(1, 6, sets), rng.uniform(0.3, 3, sets))[seed % 3]
    cost = cost.astype(np.float64)
    pairs = np.array(np.nonzero(holds))
    return SetFamily.of(pairs, sets, elements, cost, 1 + (seed % 4 == 0)), holds


def every_choice(sets: int) -> list[list[int]]:
    return [list(some) for many in range(sets + 1) for some in combinations(range(sets), many)]


def met(holds: np.ndarray, need: np.ndarray, some: list[int]) -> int:
    return int(np.minimum(holds[some].sum(axis=0), need).sum())


@pytest.mark.parametrize("seed", SEEDS)
def test_a_small_cover_is_the_cheapest_of_all_and_greedy_is_within_its_factor(seed: int) -> None:
    of, holds = family(seed)
    full = [some for some in every_choice(len(of)) if met(holds, of.need, some) == of.need.sum()]
    best = min(float(of.cost[some].sum()) for some in full)

    found = minimal(of)
    bare = minimal(of, nodes=0)
    factor = sum(1 / i for i in range(1, int(holds.sum(axis=1).max(initial=1)) + 1))

    assert (of.covered(found.chosen) >= of.need).all()
    assert found.bound <= best + 1e-6
    assert bare.bound <= best + 1e-6 <= bare.cost + 2e-6
    assert of.cost[greedy(of)].sum() <= factor * best + 1e-6
    if SOLVER:
        assert found.cost == pytest.approx(best)
        assert found.exact


@pytest.mark.parametrize("seed", SEEDS)
def test_under_a_budget_the_choice_is_within_its_factor_and_below_its_bound(seed: int) -> None:
    of, holds = family(seed)
    budget = float(np.random.default_rng(seed).uniform(0.3, of.cost.sum() + 0.5))
    affordable = [some for some in every_choice(len(of)) if of.cost[some].sum() <= budget]
    best = max(met(holds, of.need, some) for some in affordable)

    found = within(of, budget)

    assert found.cost <= budget + 1e-9
    assert found.met == met(holds, of.need, found.chosen.tolist())
    assert (1 - 1 / np.e) / 2 * best <= found.met <= best <= found.most + 1e-9


def test_the_bound_is_that_of_the_linear_programme_where_that_is_known() -> None:
    # Each two of three sets share an element: two are needed, the relaxation takes a half of each.
    triangle = SetFamily.of(np.array([[0, 0, 1, 1, 2, 2], [0, 1, 1, 2, 2, 0]]), 3, 3)

    low, *_ = bounded(triangle, np.array([0, 1, 2]))

    assert low == pytest.approx(1.5, abs=0.01)
    assert minimal(triangle).cost == minimal(triangle).bound == 2  # whole sets, so 1.5 is 2


@needs_solver
def test_a_search_that_may_not_end_still_gives_a_cover_and_a_bound_below_it(
    capfd: pytest.CaptureFixture[str],
) -> None:
    holds = np.random.default_rng(5).random((100, 100)) < 0.05
    of = SetFamily.of(np.array(np.nonzero(holds)), 100, 100)

    short, long = minimal(of, nodes=0), minimal(of)

    assert (of.covered(short.chosen) >= of.need).all()
    assert short.bound <= long.bound <= long.cost <= short.cost
    assert long.exact
    assert not short.exact  # greedy choice alone does not prove it
    ctypes.CDLL(None).fflush(None)  # the solver writes by the C library, which keeps a buffer
    assert capfd.readouterr() == ("", "")


ENDED = """
import signal
import numpy as np
from sgstore.testsets.selection import SetFamily, _bounds, minimal

_bounds.SECONDS = 3600.0  # the solver does not give up by itself

class EndedError(Exception):
    pass

def end(*_):
    raise EndedError

holds = np.random.default_rng(1).random((1_000, 500)) < 0.03
of = SetFamily.of(np.array(np.nonzero(holds)), 1_000, 500)
signal.signal(signal.SIGALRM, end)
signal.setitimer(signal.ITIMER_REAL, 1.0)
try:
    minimal(of)
except EndedError:
    print("ended")
finally:
    signal.setitimer(signal.ITIMER_REAL, 0)
"""
"""Runs in a process of its own: an alarm that comes late ends no other test."""


@needs_solver
def test_what_a_handler_of_signals_raises_ends_a_search() -> None:
    command = [sys.executable, "-c", ENDED]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout == "ended\n"


@pytest.mark.parametrize("seed", range(12))
def test_where_every_element_is_in_consecutive_sets_reductions_alone_decide(seed: int) -> None:
    # Stabbing of intervals: the fewest points are found by the classical greedy choice of ends.
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 60, 40)
    last = np.minimum(first + rng.integers(0, 9, 40), 59)
    pairs = np.array(
        [(s, e) for e in range(40) for s in range(int(first[e]), int(last[e]) + 1)], np.int64
    ).T
    points: list[int] = []
    for end, begin in sorted(zip(last.tolist(), first.tolist(), strict=True)):
        if not points or points[-1] < begin:
            points.append(end)

    forced, parts = reduced(SetFamily.of(pairs, 60, 40))

    assert parts == []
    assert len(forced) == len(points)


@pytest.mark.parametrize("seed", range(12))
def test_what_is_superfluous_changes_no_optimum_whatever_sets_cost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sets, elements = 10, 14
    holds = rng.random((sets, elements)) < 0.3
    cost = rng.integers(1, 5, sets).astype(np.float64)
    of = SetFamily.of(np.array(np.nonzero(holds)), sets, elements, cost, 1 + seed % 2)
    reachable = of.need.sum()
    every = [list(c) for n in range(sets + 1) for c in combinations(range(sets), n)]
    best = min(
        cost[c].sum() for c in every if np.minimum(holds[c].sum(axis=0), of.need).sum() == reachable
    )

    forced, parts = reduced(of)
    left = sum(minimal(part).cost for part, _ in parts)

    assert cost[forced].sum() + left >= best - 1e-9
    if SOLVER:  # the extra [solver], which finds the optimum of what is left
        assert cost[forced].sum() + left == pytest.approx(best)


def test_ties_are_broken_by_rank_alone() -> None:
    pairs = np.array([[0, 1, 2, 3], [0, 0, 1, 1]])

    chosen = [
        sorted(minimal(SetFamily.of(pairs, 4, 2, rank=np.array(rank))).chosen.tolist())
        for rank in ([0, 1, 2, 3], [3, 2, 1, 0])
    ]

    assert chosen == [[0, 2], [1, 3]]


# Units of a store ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("selection")
    copy = folder / "one.mcap"
    copy.symlink_to(SAMPLE)
    ingest(folder / "s.sgstore", [copy], until=20)
    import_two(folder)
    store = Store(folder / "s.sgstore")
    with store.file.snapshot():
        yield store


def import_two(folder: Path) -> None:
    """A second recording of other scenes: graphs of another tool."""
    rows = ["graph,src,relation,dst"]
    for i in range(30):
        rows.append(f"g{i},ego,isIn,Ego Lane")
        rows += [f"g{i},car_{k},near,ego" for k in range(i % 4)]
    (folder / "two.csv").write_text("\n".join(rows) + "\n")
    import_graphs(folder / "s.sgstore", [folder / "two.csv"], "csv")


def whole(store: Store) -> ChosenFrames:
    return ChosenFrames("s", store)


def classes_in(found: Selection) -> set[int]:
    """Classes in the frames of what was selected, counted frame by frame."""
    of = classed(found.units.chosen, found.spec.abstraction)
    units = found.units
    frames = {
        frame
        for unit in found.picked.tolist()
        for frame in units.frame_id[units.begin[unit] : units.end[unit]].tolist()
    }
    pairs = zip(of.frame_id.tolist(), of.code.tolist(), strict=True)
    return {code for frame, code in pairs if frame in frames}


def test_features_of_frames_on_several_maps_are_those_of_each_frame_alone(store: Store) -> None:
    def of(frame_id: np.ndarray) -> dict[int, dict[tuple[str, ...], int]]:
        found: dict[int, dict[tuple[str, ...], int]] = {}
        for rows, some in store.file.abstracted.features("RSV", frame_id):
            columns = (frame_id[rows[some.frame]], some.feature, some.often)
            for frame, feature, often in zip(*(c.tolist() for c in columns), strict=True):
                found.setdefault(frame, {})[some.names[feature]] = often
        return found

    ids = store.file.abstracted.times()[0][::23]
    alone = [of(ids[i : i + 1]) for i in range(len(ids))]

    assert len(np.unique(trace_of(ids))) == 2
    assert of(ids) == {frame: what for one in alone for frame, what in one.items()}


@pytest.mark.parametrize("piece", list(SelectionUnit))
@pytest.mark.parametrize("least", ["units", "seconds"])
def test_the_minimal_set_keeps_every_class(
    store: Store, piece: SelectionUnit, least: Measure
) -> None:
    wish = SelectionSpec(Strategy.minimal, piece, abstraction="EL", objective=least)

    found = select(whole(store), wish)
    everything = set(classed(whole(store), "EL").code.tolist())

    assert classes_in(found) == everything
    assert found.result["exact"]
    assert found.result["bound"] <= found.result["cost"]
    assert len(found.picked) <= len(found.units)


@pytest.mark.parametrize("installed", [True, False])
def test_a_bound_that_is_not_met_names_the_solver_where_there_is_none(
    store: Store, monkeypatch: pytest.MonkeyPatch, installed: bool
) -> None:
    import sgstore.testsets.selection._choose as room

    def loose(of: SetFamily) -> Cover:
        return replace(minimal(of), bound=1.0)

    monkeypatch.setattr(room, "minimal", loose)
    monkeypatch.setattr(room, "has_solver", lambda: installed)
    found = select(whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip))

    advice = [text for text in found.said if "pip install 'sgstore[solver]'" in text]
    assert len(advice) == (not installed)


def test_of_frames_one_of_each_class_is_enough(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.minimal, abstraction="EL"))

    assert len(found.picked) == len(set(classed(whole(store), "EL").code.tolist()))


def test_each_class_comes_k_times_or_as_often_as_it_is_there(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.per_class, abstraction="EL", each=3))
    of = classed(whole(store), "EL")
    picked = np.isin(of.frame_id, found.units.frame_id[found.picked])

    chosen = np.bincount(of.code[picked], minlength=len(of.names))

    assert (chosen == np.minimum(np.bincount(of.code, minlength=len(of.names)), 3)).all()


def test_pairs_of_features_are_those_that_coverage_counts(store: Store) -> None:
    from sgstore.testsets.coverage import combos

    found = select(
        whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, abstraction="E", combos=2)
    )
    known = combos(classed(whole(store), "E"), "E", 2)
    ids = found.units.frame_id[found.units.rows_of(found.picked)]
    kept = combos(classed(ChosenFrames("kept", store, ids), "E"), "E", 2)

    assert found.holdings is not None
    assert found.holdings.total == len(known.covered.rows) == len(kept.covered.rows)
    assert found.result["kept"] == found.holdings.total


@pytest.mark.parametrize("budget", ["12frames", "3s", "2units", "700kB"])
@pytest.mark.parametrize(
    "way", [Strategy.minimal, Strategy.per_class, Strategy.rarest, Strategy.every]
)
def test_no_budget_is_exceeded(store: Store, budget: str, way: Strategy) -> None:
    most = Budget.parse(budget)

    found = select(whole(store), SelectionSpec(way, SelectionUnit.clip, 0.5, "EL", budget=most))
    cost = found.units.costs(most.measure)[found.picked].sum()

    assert 0 < cost <= most.most + 1e-6
    if "at_most" in found.result:
        assert found.result["met"] <= found.result["at_most"]


@pytest.mark.parametrize(
    ("text", "most", "measure"),
    [
        ("600s", 600, "seconds"),
        ("1.5h", 5400, "seconds"),
        ("10 min", 600, "seconds"),
        ("5GB", 5e9, "bytes"),
        ("2MiB", 2 << 20, "bytes"),
        ("1000frames", 1000, "frames"),
        ("40units", 40, "units"),
    ],
)
def test_budgets_are_read(text: str, most: float, measure: Measure) -> None:
    assert Budget.parse(text) == Budget(most, measure)


@pytest.mark.parametrize("text", ["", "5", "GB", "0s", "-3s", "5 lightyears", "1e9s"])
def test_what_is_no_budget_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not a budget"):
        Budget.parse(text)


def test_clips_are_runs_of_what_was_asked_for_cut_by_time(store: Store) -> None:
    chosen = selection_of(
        f"{store.file.path}:MATCH (e:Ego) WHERE frame.seq >= 13 AND trace.name = 'one'"
    )

    units = units_of(chosen, SelectionUnit.clip, 2.0)
    many = units.sizes.tolist()

    assert seq_of(units.first).tolist()[:3] == [13, 33, 53]
    assert set(many[:-1]) == {20}
    assert many[-1] <= 20
    assert sum(many) == len(chosen.frame_id if chosen.frame_id is not None else ())


def test_the_same_seed_chooses_the_same_and_another_chooses_otherwise(store: Store) -> None:
    def some(seed: int) -> list[int]:
        wish = SelectionSpec(Strategy.every, budget=Budget.parse("20frames"), seed=seed)
        return sorted(select(whole(store), wish).picked.tolist())

    assert some(1) == some(1) != some(2)
    assert len(some(1)) == 20


def test_strata_share_a_budget_as_they_are_or_evenly(store: Store) -> None:
    def strata(temper: float) -> dict[str, tuple[int, int]]:
        budget = Budget.parse("40frames")
        wish = SelectionSpec(
            Strategy.stratify, each=0, by="trace.name", alpha=temper, budget=budget
        )
        return select(whole(store), wish).strata

    own, even = strata(1.0), strata(0.0)
    total = sum(size for size, _ in own.values())

    assert {name: taken for name, (_, taken) in even.items()} == {"one": 20, "two": 20}
    for size, taken in own.values():
        assert abs(taken - 40 * size / total) <= 1


@pytest.mark.parametrize("way", list(Strategy))
def test_of_nothing_nothing_is_selected_and_it_is_said(store: Store, way: Strategy) -> None:
    none = selection_of(f"{store.file.path}:MATCH (e:Ego) WHERE frame.seq > 9999")

    found = select(none, SelectionSpec(way, SelectionUnit.clip, by="trace.name"))

    assert len(found.picked) == 0
    assert found.said[0].endswith("no frame to select from")
    assert listed(found).rows == []
    assert curve(found).table.rows == []


@pytest.mark.parametrize(
    ("text", "at"), [("ego.speeed > 3", "speeed"), ("ego.speed +", ""), ("ego.speed > > 3", ">")]
)
def test_an_expression_that_is_wrong_is_shown_as_it_was_written(
    store: Store, text: str, at: str
) -> None:
    with pytest.raises(QueryError) as caught:
        select(whole(store), SelectionSpec(Strategy.stratify, each=1, by=text))

    assert caught.value.text == text
    assert caught.value.span is not None
    assert at in text[caught.value.span.start : caught.value.span.end]
    assert "frame_of_label" not in str(caught.value)


def test_of_each_stratum_k(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.stratify, each=7, by="trace.name"))

    assert {name: taken for name, (_, taken) in found.strata.items()} == {"one": 7, "two": 7}


def test_parts_share_no_recording_and_what_leaks_is_told(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.every))
    shares = parse_split("train=0.8,test=0.2")

    parts = split(found, shares)
    traces = {
        name: set(trace_of(found.units.first[[u for u in parts if parts[u] == name]]).tolist())
        for name in shares
    }
    rows = split_table(found, parts, shares).dicts()

    assert not traces["train"] & traces["test"]
    assert len(parts) == len(found.picked)
    assert [row["split"] for row in rows] == ["train", "test"]
    assert rows[0]["classes_in_test"] == 0
    assert rows[0]["classes_in_train"] is None


@pytest.mark.parametrize("text", ["train", "a=0.5,b=0.6", "a=0.5,a=0.5", "a=nan,b=1", "a=2"])
def test_what_is_no_split_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--split"):
        parse_split(text)


def test_the_curve_rises_to_all_and_random_order_is_hypergeometric(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL"))
    drawn = curve(found)
    held = found.holdings
    assert held is not None
    kept = [row["kept"] for row in drawn.table.dicts() if row["kept"] is not None]
    rng = np.random.default_rng(0)
    n, often = 7, np.bincount(held.pairs[1])
    tries = []
    for _ in range(4000):
        some = np.isin(held.pairs[0], rng.permutation(len(found.units))[:n])
        tries.append(len(np.unique(held.pairs[1][some])))

    assert kept == sorted(kept)
    assert kept[-1] == held.total
    assert drawn.needed == len(found.picked) <= drawn.at_random
    mean = expected_classes(often, np.array([n]), len(found.units))[0]
    assert mean == pytest.approx(np.mean(tries), rel=0.02)
    assert expected_classes(often, np.array([len(found.units)]), len(found.units))[
        0
    ] == pytest.approx(held.total)


def test_what_was_chosen_is_listed_with_what_it_brings(store: Store) -> None:
    found = select(whole(store), SelectionSpec(Strategy.minimal, SelectionUnit.clip, 1.0, "EL"))
    rows = listed(found).dicts()

    assert sum(row["new"] for row in rows) == found.result["elements"]
    assert all(0 <= row["new"] <= row["holds"] for row in rows)
    assert all(row["unit"].startswith(("one#", "two#")) for row in rows)


SUMO: list[tuple[dict[str, Any], float]] = [
    # What random order needs cannot be halved where every clip has what no other has: the bound says so.
    ({}, 1.0),
    ({"combos": 2, "abstraction": "ER", "of_ego": True}, 0.75),
    ({"combos": 1, "abstraction": "ER"}, 0.5),
    ({"combos": 2, "abstraction": "E"}, 0.5),
]


@pytest.mark.parametrize(("wish", "of_random"), SUMO)
def test_on_a_drive_of_sumo_the_set_of_clips_meets_its_bound_and_is_smaller_than_at_random(
    data: Path, tmp_path_factory: pytest.TempPathFactory, wish: dict[str, Any], of_random: float
) -> None:
    place = tmp_path_factory.getbasetemp() / "sumo.sgstore"
    if not place.exists():
        ingest(place, [data / "traces" / "sumo" / "Town10HD_sumo_osi.mcap"])

    found = select(
        ChosenFrames("sumo", Store(place)),
        SelectionSpec(Strategy.minimal, SelectionUnit.clip, 2.0, **wish),
    )
    drawn = curve(found)

    assert len(found.units) == 30
    assert found.result["cost"] <= 1.05 * found.result["bound"]
    assert found.result["kept"] == found.result["elements"]
    assert drawn.needed <= of_random * drawn.at_random


@pytest.mark.parametrize("unit", ["frame", "clip", "trace"])
@pytest.mark.parametrize("text", ["robustness(ego.speed < 4)", "ego.speed < 4", "4 - ego.speed"])
def test_the_weakest_come_first(open_town: Store, unit: str, text: str) -> None:
    spec = SelectionSpec(Strategy.weakest, SelectionUnit(unit), by=text)
    found = select(whole(open_town), spec)

    sql = "SELECT frame_id, 4 - speed FROM nodes WHERE is_ego"
    margin = dict(tuple(row) for row in open_town.sql(sql))
    units = found.units
    assert found.values is not None
    least = [
        min(margin[frame] for frame in units.frame_id[a:z].tolist())
        for a, z in zip(units.begin, units.end, strict=True)
    ]
    np.testing.assert_allclose(found.values, least, rtol=1e-6)
    assert sorted(found.picked.tolist()) == list(range(len(units)))
    assert (np.diff(found.values[found.picked]) >= 0).all()
    assert listed(found).columns == ("unit", "frames", "least")
    few = select(whole(open_town), replace(spec, budget=Budget.parse("2units")))
    assert few.picked.tolist() == found.picked[:2].tolist()


def test_traces_are_ordered_by_the_margin_of_a_check(open_town: Store) -> None:
    def by(text: str, unit: SelectionUnit = SelectionUnit.trace) -> SelectionSpec:
        return SelectionSpec(Strategy.weakest, unit, by=text)

    check = "CHECK slow: ALWAYS ego.speed < 4 ROBUSTNESS"
    found = select(whole(open_town), by(check))

    margin = {v.trace: v.robustness.value for v in open_town.check(check) if v.robustness}
    rows = [(row[0].partition("#")[0], row[2]) for row in listed(found).rows]
    assert rows == sorted(margin.items(), key=lambda one: one[1])
    once = by("CHECK EVENTUALLY ego.speed < 4 ROBUSTNESS", SelectionUnit.clip)
    with pytest.raises(ConfigError, match="one margin for a whole trace, and these are clips"):
        select(whole(open_town), once)
    for text, said in (
        ("CHECK ALWAYS ego.speed < 4", "write CHECK … ROBUSTNESS"),
        ("CHECK a: ALWAYS ego.speed < 4 ROBUSTNESS; CHECK b: ALWAYS ego.speed < 5", "one of them"),
        ("trace.name", "expected a number, or a condition"),
    ):
        with pytest.raises(ConfigError, match=said):
            select(whole(open_town), by(text))


@pytest.fixture(scope="module")
def meeting(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A car comes near from the 10th frame on; in the 5th somebody is there on foot."""
    folder = tmp_path_factory.mktemp("met")
    with Recorder(folder / "run.mcap") as recorder:
        for number in range(20):
            others = [car(2, 60 - 2 * number, v=(-20, 0))] if number >= 10 else []
            others += [car(3, 100, v=(0, 0))] if number >= 15 else []
            others += [person(4, 50)] if number == 5 else []
            recorder.ground_truth(number / 10, [car(7, 0, v=(5, 0)), *others], host=7)
    ingest(folder / "x.sgstore", [folder / "run.mcap"])
    return Store(folder / "x.sgstore")


def weakest(store: Store, text: str, unit: str = "frame") -> Selection:
    return select(whole(store), SelectionSpec(Strategy.weakest, SelectionUnit(unit), 1.0, by=text))


@pytest.mark.parametrize("form", ["{}", "robustness({})", "CHECK ALWAYS ({}) ROBUSTNESS"])
def test_what_is_broken_comes_first_and_what_is_not_known_last(meeting: Store, form: str) -> None:
    rule = "MIN {(v:Car) | dist(ego, v)} > 30 AND NOT EXISTS {(:Person)}"

    found = weakest(meeting, form.format(rule))

    assert found.values is not None
    assert found.picked[:11].tolist() == [5, *range(19, 9, -1)]
    known = [*(10.0 - 2 * i for i in range(10))]
    np.testing.assert_allclose(found.values[10:], known, rtol=1e-5)
    assert found.values[5] == -np.inf
    assert found.result["unknown"] == np.isnan(found.values).sum() == 9
    assert "not known: 9" in found.said[0]


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [
        ("frame", [*range(19, 9, -1)]),
        ("clip", [1, 0]),
        ("trace", [0]),
    ],
)
def test_units_are_ordered_by_a_check_of_everybody(
    meeting: Store, unit: str, wanted: list[int]
) -> None:
    check = (
        "FORALL (v:Car ABSENT AS TRUE) ALWAYS dist(ego, v) > 30 AND ALWAYS v.speed < 100 ROBUSTNESS"
    )

    found = weakest(meeting, f"CHECK {check}", unit)

    (verdict,) = meeting.check(f"CHECK {check}")
    assert verdict.robustness is not None
    assert found.values is not None
    assert found.values.min() == verdict.robustness.value
    assert found.picked[: len(wanted)].tolist() == wanted
