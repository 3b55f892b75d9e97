"""Orders of cases: risk by ranks, rounds of classes, APFD, locks with order and reasons."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from graph_blocks import RandomTrace, publish
from recordings import Recorder, car

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import ConfigError
from sgstore.pipeline.importing import import_graphs
from sgstore.query import Store
from sgstore.store import StoreFile
from sgstore.testsets.coverage import ChosenFrames, frames_of, selection_of
from sgstore.testsets.locks import cases_of, read_lock
from sgstore.testsets.selection import (
    Budget,
    Priority,
    PrioritySpec,
    SelectionUnit,
    failed_in_order,
    failure_curve,
    fault_detection,
    locked_order,
    prioritize,
    units_of,
)
from sgstore.testsets.selection._learn import features_of, fitted
from sgstore.testsets.selection._near_pairs import worst_in_frames

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

pytestmark = pytest.mark.seconds(32)

OTHERS = """src_is_ego AND dst_kind NOT IN ('traffic_light', 'stop_sign', 'yield_sign', 'speed_limit', 'sign',
  'building', 'pole', 'barrier', 'vegetation')"""
EVERY = "MATCH (e:Ego) WHERE frame.seq % 5 = 0 RETURN FRAMES"


@pytest.fixture(scope="module")
def some(open_town: Store) -> ChosenFrames:
    return ChosenFrames("town", open_town, frames_of(open_town, EVERY))


def worst_by_hand(some: ChosenFrames, name: str, low: bool = True) -> dict[int, tuple[float, int]]:
    """The worst value of each frame, and with whom: row by row."""
    assert some.frame_id is not None
    frames = {*some.frame_id.tolist()}
    found: dict[int, tuple[float, int]] = {}
    rows = some.store.sql(
        f"SELECT frame_id, dst, {name} FROM world_criticality WHERE {OTHERS} ORDER BY frame_id, dst"
    ).values
    for frame, other, value in rows:
        if value is not None and frame in frames:
            best = found.get(frame, (math.inf if low else -math.inf, -1))[0]
            if value < best if low else value > best:
                found[frame] = value, other
    return found


@pytest.mark.parametrize("seed", range(4))
def test_values_within_bounds_are_those_of_all_pairs(tmp_path: Path, seed: int) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    for trace in range(2):
        publish(store, RandomTrace(10 * seed + trace, frames=70, path=f"{trace}"))
    assert_worst_as_by_hand(ChosenFrames("random", Store(store.path), None))


def test_values_within_bounds_are_those_of_a_town(some: ChosenFrames) -> None:
    assert_worst_as_by_hand(some)


def assert_worst_as_by_hand(chosen: ChosenFrames) -> None:
    units = units_of(chosen, SelectionUnit.frame, 2.0, None)
    names = ("closing_time", "ttc_mild")
    values, others, blind = worst_in_frames(chosen.store.file, units.frame_id, names)

    for name, value, other in zip(names, values, others, strict=True):
        wanted = worst_by_hand(replace(chosen, frame_id=units.frame_id), name)
        known = np.flatnonzero(value < np.inf)
        found = zip(value[known].tolist(), other[known].tolist(), strict=True)
        assert dict(zip(units.frame_id[known].tolist(), found, strict=True)) == wanted
        assert wanted
    among = f"{OTHERS} AND frame_id IN (SELECT unnest(?))"
    sql = f"SELECT count(*) - count(gap) FROM world_criticality WHERE {among}"
    assert blind.sum() == chosen.store.file.rows(sql, [units.frame_id.tolist()]).values[0][0]


def ranks(values: list[float]) -> list[int]:
    """Ranks from the least value on, counted one by one."""
    return [1 + sum(v < one for v in values) for one in values]


def test_risk_is_the_sum_of_the_ranks_of_the_worst_values(some: ChosenFrames) -> None:
    names = ("closing_time", "dce_3s", "a_req")
    found = prioritize(some, PrioritySpec(measures=names))

    assert some.frame_id is not None
    frames = some.frame_id.tolist()
    total = np.zeros(len(frames))
    for worst, name in zip(found.worst, names, strict=True):
        hand = worst_by_hand(some, name, low=name != "a_req")
        sign = -1 if name == "a_req" else 1
        total += ranks([sign * hand[f][0] if f in hand else math.inf for f in frames])
        known = [f in hand for f in frames]
        assert (~np.isnan(worst.value)).tolist() == known
        for unit, frame in enumerate(frames):
            if frame in hand:
                assert (worst.value[unit], worst.other[unit]) == pytest.approx(hand[frame])
    assert sorted(found.picked.tolist()) == list(range(len(frames)))
    assert (np.diff(total[found.picked]) >= 0).all()
    assert (np.diff(found.risk[found.picked]) < 0).all()
    assert len(set(total.tolist())) > 10


def test_an_expression_is_a_measure_whose_least_value_comes_first(some: ChosenFrames) -> None:
    rule = "robustness(ALWAYS[0s, 1s] ego.speed < 8)"
    found = prioritize(some, PrioritySpec(measures=(rule, "ttc")))

    rows = some.store.find(f"MATCH (e:Ego) RETURN frame.id, {rule.replace('ego', 'e')} AS m")
    margins = dict(map(tuple, rows))
    assert some.frame_id is not None
    wanted = [margins[frame] for frame in some.frame_id.tolist()]
    assert found.worst[0].value.tolist() == wanted
    alone = prioritize(some, PrioritySpec(measures=(rule,)))
    assert (np.diff(np.array(wanted)[alone.picked]) >= 0).all()
    assert alone.reasons()[0].startswith(f"{rule} is ")
    with pytest.raises(ConfigError, match="expected a number"):
        prioritize(some, PrioritySpec(measures=("ego.kind",)))


@pytest.mark.parametrize("last", [0.01, 6.0])
def test_required_accelerations_before_a_contact_have_a_note(tmp_path: Path, last: float) -> None:
    """The ego is 9 m/s faster than the car ahead; the last gap decides if it can still brake."""
    with Recorder(tmp_path / "drive.mcap") as recorder:
        for frame in range(4):
            x, gap = float(frame), last + 0.9 * (3 - frame)
            ahead = car(2, x + gap + car(1).base.dimension.length, v=(1, 0))
            recorder.ground_truth(frame / 10, [car(1, x, v=(10, 0)), ahead], host=1)
    store = sgstore.open(tmp_path / "s.sgstore", create=True)
    store.ingest(tmp_path / "drive.mcap")

    found = prioritize(ChosenFrames("s", store), PrioritySpec(measures=("a_long_req", "dce")))

    least = found.worst[0].value.min()
    assert least == pytest.approx(-81 / 2 / last, rel=1e-3)
    notes = [note for note in found.said if "contact follows" in note]
    assert len(notes) == (least < -11.5)
    if notes:  # at gaps of 2.71, 1.81, 0.91 and 0.01 m
        assert notes[0].startswith("4 frames with a_long_req beyond 11.5 m/s²")


def test_the_worst_of_a_clip_is_that_of_its_frames(open_town: Store) -> None:
    first = frames_of(open_town, "MATCH (e:Ego) WHERE frame.seq < 100 RETURN FRAMES")
    beginning = ChosenFrames("town", open_town, first)
    spec = PrioritySpec(unit=SelectionUnit.clip, clip_s=1.0, measures=("closing_time",))
    found = prioritize(beginning, spec)
    hand = worst_by_hand(beginning, "closing_time")

    units = found.units
    for unit in range(len(units)):
        frames = units.frame_id[units.begin[unit] : units.end[unit]].tolist()
        known = [hand[f][0] for f in frames if f in hand]
        assert found.worst[0].value[unit] == pytest.approx(
            min(known, default=math.nan), nan_ok=True
        )
        if known:
            row = int(found.worst[0].row[unit])
            assert hand[int(units.frame_id[row])][0] == min(known)
    assert 1 < len(units) < len(hand)


def test_no_order_has_more_classes_in_its_first_cases_than_the_diverse_one(
    some: ChosenFrames,
) -> None:
    found = prioritize(some, PrioritySpec(Priority.diverse, abstraction="E"))

    codes = found.code[found.picked].tolist()
    classes = len(set(codes))
    for many in range(1, len(codes) + 1):
        assert len(set(codes[:many])) == min(many, classes)
    left, of = defaultdict(int), {c: codes.count(c) for c in codes}
    turns = []
    for code in codes:
        left[code] += 1
        turns.append(left[code])
    assert turns == sorted(turns)
    assert max(of.values()) > 1


def test_risk_and_diversity_together_lie_between_the_two(some: ChosenFrames) -> None:
    kinds = (Priority.risk, Priority.diverse, Priority.both)
    orders = {by: prioritize(some, PrioritySpec(by, abstraction="E")) for by in kinds}
    half = len(orders[Priority.risk].picked) // 4

    def classes(by: Priority) -> int:
        both = orders[Priority.both]
        return len({int(both.code[unit]) for unit in orders[by].picked[:half].tolist()})

    def risk(by: Priority) -> float:
        return float(orders[Priority.risk].risk[orders[by].picked[:half]].mean())

    assert classes(Priority.risk) <= classes(Priority.both) <= classes(Priority.diverse)
    assert risk(Priority.diverse) <= risk(Priority.both) <= risk(Priority.risk)


def test_the_measures_of_an_order_are_those_that_the_help_and_the_page_name(
    some: ChosenFrames, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["prioritize", "--help"]) == 0
    page = (Path(__file__).parents[2] / "docs" / "selection.md").read_text(encoding="utf-8")
    listed = re.search(r"The measures are `(\w+)`.*\n.* and `(\w+)`", page)
    assert listed is not None

    names = tuple(one.name for one in prioritize(some, PrioritySpec()).worst)

    assert f"[default: ({', '.join(names)})]" in re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert listed.groups() == names


def runs(folder: Path, others: Sequence[Mapping[str, object]]) -> ChosenFrames:
    """Frames of an ego that stands, each with one other vehicle; None: it is not told."""
    about = {"kind": "car", "x": 0, "y": 0, "z": 0, "heading": 0, "vx": 0, "vy": 0, "vz": 0}
    about |= {"length": 4.5, "width": 1.8, "height": 1.5}
    lines: list[str] = []
    for number, other in enumerate(others):
        nodes: list[dict[str, object]] = [
            {**about, "id": "ego", "is_ego": True},
            {**about, "id": "v", "x": 20, **other},
        ]
        told = [{name: value for name, value in one.items() if value is not None} for one in nodes]
        graph = {"graph": {"name": f"run {number}"}, "nodes": told, "edges": []}
        lines.append(json.dumps(graph) + "\n")
    (folder / "runs.jsonl").write_text("".join(lines))
    import_graphs(folder / "runs.sgstore", [folder / "runs.jsonl"], "nodelink")
    return selection_of(str(folder / "runs.sgstore"))


def test_it_is_said_how_many_have_no_gap(tmp_path: Path) -> None:
    chosen = runs(tmp_path, [{"x": 30}, {"length": None}, {"x": 25}, {"heading": None}])
    order = prioritize(chosen, PrioritySpec())
    assert order.picked.tolist()[:2] == [2, 0]
    assert "of 2 none of these is known" in order.said[0]
    assert order.said[1].startswith("2 pairs of the ego and others have no gap")
    known = "MATCH (e:Ego) WHERE frame.seq IN [0, 2] RETURN FRAMES"
    failed = {f"run {n}": n == 1 for n in range(4)}
    learned = prioritize(chosen, PrioritySpec(Priority.learned), failed)
    lock = locked_order(learned, payloads=False)
    assert "4 frames, of which 1 failed" in lock.selection["learned"]
    some = ChosenFrames("known", chosen.store, frames_of(chosen.store, known))
    assert len(prioritize(some, PrioritySpec()).said) == 1


@pytest.mark.parametrize("by", ["risk", "diverse", "both"])
def test_it_is_said_that_there_is_no_ego(tmp_path: Path, by: str) -> None:
    nodes = [{"id": f"v{i}", "kind": "car", "x": 9.0 * i, "y": 0, "z": 0} for i in range(2)]
    graphs = [{"graph": {"name": f"run {n}"}, "nodes": nodes, "edges": []} for n in range(3)]
    (tmp_path / "runs.jsonl").write_text("".join(json.dumps(one) + "\n" for one in graphs))
    import_graphs(tmp_path / "runs.sgstore", [tmp_path / "runs.jsonl"], "nodelink")
    chosen = selection_of(str(tmp_path / "runs.sgstore"))

    told = prioritize(chosen, PrioritySpec(Priority(by))).said[1]
    assert told.startswith("3 of 3 frames have no ego")
    by_speed = PrioritySpec(Priority(by), ("MIN {(v:Vehicle) | v.x}",), abstraction="E")
    assert len(prioritize(chosen, by_speed).said) == 1


def test_a_clip_of_which_one_measure_is_known_has_its_situation_from_there(tmp_path: Path) -> None:
    # Nobody closes in, so there is no closing_time: the second frame is the most critical one by ttc_mild.
    chosen = runs(tmp_path, [{"x": 60}, {"x": -9, "heading": 180}, {"x": 70}])
    order = prioritize(chosen, PrioritySpec(Priority.both, unit=SelectionUnit.trace))
    (row,) = order.rows()
    assert row[-1] == (
        "ttc_mild 1.5 s with car 1 at 1.0 s; the only trace with car that comes towards it in its way, behind"
    )


@pytest.mark.filterwarnings("error")
def test_speeds_of_almost_nothing_teach_as_well(tmp_path: Path) -> None:
    chosen = runs(tmp_path, [{"vx": -1e-39 * (1 + n), "x": 20 + n} for n in range(12)])
    outcomes = {f"run {n}": n % 3 == 0 for n in range(12)}
    order = prioritize(chosen, PrioritySpec(Priority.learned), outcomes)
    assert np.isfinite(order.chance).all()


def test_a_budget_ends_the_order(some: ChosenFrames) -> None:
    whole = prioritize(some, PrioritySpec()).picked

    part = prioritize(some, PrioritySpec(budget=Budget(4, "units"))).picked

    assert part.tolist() == whole[:4].tolist()


@pytest.mark.parametrize("measures", [("dist",), ("rss_lon",), ("speed",), ()])
def test_what_has_no_worse_side_is_no_measure_of_risk(measures: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=r"expected some of .*closing_time"):
        PrioritySpec(measures=measures)


def test_a_situation_is_that_of_whom_the_ego_could_meet_soonest(some: ChosenFrames) -> None:
    sql = f"""
      SELECT frame_id, closing_time, dce_3s, dst, dst_kind, abs(rel_heading), lat_gap, lon
      FROM world_criticality WHERE {OTHERS}
    """
    soonest: dict[int, Any] = {}
    for frame, *row in some.store.sql(sql).values:
        key = [math.inf if value is None else value for value in row[:3]]
        soonest[frame] = min(soonest.get(frame, (key, row)), (key, row), key=lambda one: one[0])
    told: dict[int, str] = {}
    for frame, (_, (*_, kind, turned, aside, along)) in soonest.items():
        ways = {45: " of the same direction", 135: " that crosses", 181: " that comes towards it"}
        way = next(words for most, words in ways.items() if turned <= most)
        place = " in its way" if aside <= 0 else " beside its way"
        told[frame] = f"{kind}{way}{place}, {'ahead' if along > 0 else 'behind'}"

    found = prioritize(some, PrioritySpec(Priority.both))

    frames = found.units.frame_id.tolist()
    assert [found.names[code] for code in found.code.tolist()] == [
        told.get(frame, "nobody") for frame in frames
    ]
    assert len(found.names) > 5
    reasons = dict(zip(found.picked.tolist(), found.reasons(), strict=True))
    unit = next(u for u in reasons if np.count_nonzero(found.code == found.code[u]) == 1)
    assert reasons[unit].endswith(f"the only frame with {found.names[found.code[unit]]}")
    assert "situations" in found.said[0]


# How soon failures are found ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_apfd_is_that_of_the_textbook(seed: int) -> None:
    rng = np.random.default_rng(seed)
    failed = rng.random(200) < 0.1
    failed[3] = True

    found = fault_detection(failed)

    places = [place for place, fails in enumerate(failed.tolist(), start=1) if fails]
    n, m = len(failed), len(places)
    assert found.apfd == pytest.approx(1 - sum(places) / (n * m) + 1 / (2 * n))
    # The area under the curve of failures found over cases run, by trapezia.
    curve = np.append(0, np.cumsum(failed)) / m
    assert found.apfd == pytest.approx(np.trapezoid(curve, dx=1 / n))
    assert found.found[0.1] == pytest.approx(curve[20])
    assert found.low <= found.apfd <= found.high
    assert (found.cases, found.failures) == (n, m)


def test_failures_that_come_first_come_soonest() -> None:
    first, last = (fault_detection(np.arange(100) < 5), fault_detection(np.arange(100) >= 95))

    assert first.apfd == pytest.approx(0.975)
    assert last.apfd == pytest.approx(0.025)
    assert first.found == {0.05: 1, 0.1: 1, 0.2: 1}
    with pytest.raises(ConfigError, match="none of 7 cases failed"):
        fault_detection(np.zeros(7, np.bool_))


def test_the_curve_of_failures_counts_them() -> None:
    failed = np.array([True, False, True, False, False, False, True])

    assert failure_curve(failed) == [
        (many, int(failed[:many].sum()), failed[:many].sum() / 3, 3 * many / 7)
        for many in range(1, 8)
    ]
    assert [row[0] for row in failure_curve(failed, 2)] == [4, 7]


# Learning -----------------------------------------------------------------------------------------

LEARNED = Priority.learned


@pytest.fixture(params=["boosted trees", "plain"])
def model(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of each model to learn with; scikit-learn is not there for the plain one."""
    if request.param == "plain":
        monkeypatch.setitem(sys.modules, "sklearn", None)
    else:
        pytest.importorskip("sklearn")
    return request.param


def named_outcomes(some: ChosenFrames, failed: set[int]) -> dict[str, bool]:
    """Outcomes of all frames, of which some failed, by frame ids."""
    assert some.frame_id is not None
    return {str(frame): frame in failed for frame in some.frame_id.tolist()}


def test_what_is_learned_finds_what_fails(some: ChosenFrames, model: str) -> None:
    """Frames fail whose nearest neighbour, whoever it is, is on the left: nothing that risk knows."""
    pairs = f"world_criticality WHERE {OTHERS} GROUP BY frame_id"
    sql = f"SELECT frame_id, arg_min(lat, closing_time) FROM {pairs}"
    left = {frame for frame, lat in some.store.sql(sql).values if lat is not None and lat > 0}
    outcomes = named_outcomes(some, left)

    learned, risky = (
        prioritize(some, PrioritySpec(by), outcomes) for by in (LEARNED, Priority.risk)
    )

    found, beside = (fault_detection(failed_in_order(one, outcomes)) for one in (learned, risky))
    assert found.apfd > max(beside.apfd, 0.5) + 0.05
    assert (np.diff(learned.chance[learned.picked]) <= 0).all()
    assert ((learned.chance >= 0) & (learned.chance <= 1)).all()
    assert learned.said[-1].startswith("learned by ")
    assert f"of which {found.failures:,} failed" in learned.said[-1]
    assert learned.reasons()[0].startswith("fails with probability ")
    assert ("gradient boosting" in learned.said[-1]) == (model != "plain")


def test_no_case_is_judged_by_a_model_that_knows_its_outcome(
    some: ChosenFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert some.frame_id is not None
    monkeypatch.setitem(sys.modules, "sklearn", None)
    frames = some.frame_id.tolist()
    failed = {*frames[::3]}
    before = prioritize(some, PrioritySpec(LEARNED), named_outcomes(some, failed)).chance

    changed = failed ^ {frames[7]}
    after = prioritize(some, PrioritySpec(LEARNED), named_outcomes(some, changed)).chance

    assert after[7] == before[7]
    assert (after != before).any()


def test_what_has_no_outcome_is_judged_by_all_that_have(
    some: ChosenFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert some.frame_id is not None
    monkeypatch.setitem(sys.modules, "sklearn", None)
    half = len(some.frame_id) // 2
    known, asked = (
        ChosenFrames("part", some.store, part)
        for part in (some.frame_id[:half], some.frame_id[half:])
    )
    outcomes = named_outcomes(known, {*some.frame_id[:half:4].tolist()})

    together = prioritize(some, PrioritySpec(LEARNED), outcomes)
    apart = prioritize(asked, PrioritySpec(LEARNED), outcomes, known)

    assert together.chance[half:].tolist() == apart.chance.tolist()
    assert len({*apart.chance.tolist()}) > 3


def test_the_plain_model_is_the_logistic_regression_of_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    linear = pytest.importorskip("sklearn.linear_model")
    rng = np.random.default_rng(5)
    x = rng.normal(size=(300, 4)).astype(np.float32)
    x[rng.random(x.shape) < 0.2] = np.nan
    failed = rng.random(300) < 1 / (1 + np.exp(-2 * np.nan_to_num(x[:, 0]) + x[:, 1] ** 2 % 1))

    def design(row: np.ndarray) -> list[float]:
        told: list[float] = []
        for value, column in zip(row, x.T, strict=True):
            known = column[~np.isnan(column)]
            place = ((known < value).sum() + (known == value).sum() / 2) / len(known) - 0.5
            told += [0 if np.isnan(value) else place, 0.5 - np.isnan(value)]
        return told

    told = np.array([design(row) for row in x])
    theirs = linear.LogisticRegression(C=1.0, tol=1e-10, max_iter=10_000).fit(told, failed)
    monkeypatch.setitem(sys.modules, "sklearn", None)

    ours = fitted(x, failed, x, seed=0)

    assert ours == pytest.approx(theirs.predict_proba(told)[:, 1], abs=1e-5)


@pytest.mark.parametrize("share", [0, 1])
def test_to_learn_takes_failures_and_others(some: ChosenFrames, share: int) -> None:
    assert some.frame_id is not None
    outcomes = named_outcomes(some, {*some.frame_id.tolist()} if share else set())

    with pytest.raises(ConfigError, match="to learn takes failures and others"):
        prioritize(some, PrioritySpec(LEARNED), outcomes)


def test_a_case_is_told_by_its_most_critical_neighbours(some: ChosenFrames) -> None:
    units = units_of(some, SelectionUnit.frame, 2.0, None)
    rows = np.arange(len(units))
    sql = f"""
      SELECT c.frame_id, c.closing_time, c.dce_3s, c.lon, n.width FROM world_criticality c
      JOIN world_nodes n ON n.frame_id = c.frame_id AND n.node_id = c.dst WHERE {OTHERS}
    """
    by_frame: dict[int, list[tuple[float, float, float, float]]] = defaultdict(list)
    for frame, *row in some.store.sql(sql).values:
        time, dce, lon, width = (math.inf if value is None else value for value in row)
        by_frame[frame].append((time, dce, lon, width))

    told = features_of(units, rows)

    for row, frame in zip(told, units.frame_id.tolist(), strict=True):
        others = sorted(by_frame[frame])[:3]
        assert row[-1] == len(by_frame[frame])
        for place, (time, *_, lon, width) in enumerate(others):
            numbers = row[place * 14 : (place + 1) * 14]
            assert np.nan_to_num(numbers[1], nan=math.inf) == pytest.approx(time)
            assert numbers[[8, 13]] == pytest.approx([lon, width], rel=1e-5)
        assert np.isnan(row[len(others) * 14 : 42]).all()
    assert len(by_frame) > 10


# The verb -----------------------------------------------------------------------------------------


def test_the_verb_says_why_and_locks_the_order(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lock, outcomes = tmp_path / "order.lock", tmp_path / "outcomes.csv"
    assert run(["prioritize", str(town_store), EVERY, "--json"]) == 0
    rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    with outcomes.open("w", newline="") as file:
        write = csv.writer(file)
        write.writerow(["frame", "failed"])
        write.writerows([row["unit"], int(row["place"] <= 3)] for row in rows)

    options = ["--budget", "6units", "--outcomes", str(outcomes), "--no-payloads"]
    assert run(["prioritize", str(town_store), EVERY, *options, "-o", str(lock)]) == 0

    said = capsys.readouterr()
    assert [row["place"] for row in rows] == list(range(1, len(rows) + 1))
    assert "closing_time" in rows[0]["reason"]
    assert " s with " in rows[0]["reason"]
    assert "APFD 0.750" in said.err
    assert "of 3 failures in 6 cases" in said.err
    kept = read_lock(lock)
    names = [row["unit"] for row in rows[:6]]
    assert kept.selection["order"] == names
    assert kept.selection["reasons"][names[0]] == rows[0]["reason"]
    assert [case.id for case in kept.ordered] == names


def test_an_order_is_learned_from_another_store(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["prioritize", str(town_store), EVERY, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    lessons, known = tmp_path / "lessons.csv", tmp_path / "known.csv"
    for path, part in ((lessons, rows[::2]), (known, rows[1::2])):
        told = [f"{row['unit']},{int(row['place'] <= 8)}\n" for row in part]
        path.write_text("frame,failed\n" + "".join(told))
    learn = ["--order", "learned", "--learn-outcomes", str(lessons), "--outcomes", str(known)]
    other, picture = ["--learn-from", str(town_store)], tmp_path / "found.svg"

    assert run(["prioritize", str(town_store), EVERY, *learn, "--json"]) == 0
    here = capsys.readouterr()
    assert run(["prioritize", str(town_store), EVERY, *learn, *other, "--json"]) == 0
    there = capsys.readouterr()
    drawn = ["prioritize", str(town_store), EVERY, *learn, "--picture", str(picture)]
    assert run([*drawn, "--no-payloads", "-o", str(tmp_path / "order.lock")]) == 0

    assert "of 4 failures in 75 cases" in here.err
    assert "learned by " in there.err
    first = {row["unit"]: row["probability"] for row in json.loads(here.out)}
    second = {row["unit"]: row["probability"] for row in json.loads(there.out)}
    asked = [row["unit"] for row in rows[1::2]]
    assert [first[unit] for unit in asked] == [second[unit] for unit in asked]
    assert "failures found, of 4" in picture.read_text()
    assert "learned by " in read_lock(tmp_path / "order.lock").selection["learned"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--order", "learned"], "--order learned needs --outcomes or --learn-outcomes"),
        (["--learn-outcomes", "x.csv"], "need --order learned"),
        (["--order", "learned", "--learn-from", "x"], "--learn-from needs --learn-outcomes"),
        (["--picture", "x.svg"], "--picture needs --outcomes"),
    ],
)
def test_options_that_need_others_say_so(
    town_store: Path, capsys: pytest.CaptureFixture[str], options: list[str], told: str
) -> None:
    assert run(["prioritize", str(town_store), *options]) == 2

    assert told in " ".join(capsys.readouterr().err.split())


def test_cases_of_a_lock_come_in_its_order(
    open_town: Store, town_store: Path, tmp_path: Path
) -> None:
    lock = tmp_path / "order.lock"
    order = ["prioritize", str(town_store), EVERY, "--order", "both", "--budget", "5units"]
    assert run([*order, "--no-payloads", "-o", str(lock)]) == 0

    cases = cases_of(lock, open_town)

    assert [name for *_, name in cases] == read_lock(lock).selection["order"]
    assert sorted(name for *_, name in cases) != [name for *_, name in cases]


def test_a_measure_that_is_none_is_refused(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["prioritize", str(town_store), "-m", "danger"]) == 2

    assert "no measure of criticality: 'danger'; expected some of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unit", "status", "told"),
    [
        ("town#0", 0, "all 1 cases with a known outcome passed"),
        ("nowhere#0", 2, "none of the 1 outcomes is about a case of"),
    ],
)
def test_outcomes_without_a_failure_are_told(
    town_store: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    unit: str,
    status: int,
    told: str,
) -> None:
    outcomes = tmp_path / "outcomes.csv"
    outcomes.write_text(f"frame,failed\n{unit},0\n")

    assert run(["prioritize", str(town_store), EVERY, "--outcomes", str(outcomes)]) == status

    assert told in capsys.readouterr().err


def test_limit_prints_the_first_cases(town_store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["prioritize", str(town_store), "--json"]) == 0
    every = json.loads(capsys.readouterr().out)
    assert run(["prioritize", str(town_store), "--json", "--limit", "3"]) == 0

    assert json.loads(capsys.readouterr().out) == every[:3]
