"""Verdicts of checks: what counts where an entity is absent, where too little is known, and at the end."""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import pytest
from knowledge import Car, Checks, Known, car, frame_of, random_scene, reduced, road
from oracle_over_time import compare_unknown, unknown_check, worlds
from recordings import Recorder
from recordings import car as recorded
from thorough import LONG

import sgstore
from sgstore.apps.cli import run
from sgstore.ingest import ingest
from sgstore.model.config import Config, RangeSettings
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.temporal import Verdict

pytestmark = pytest.mark.seconds(30)

NO_TOUCH = "CHECK no_touch: FORALL (v:Vehicle) ALWAYS gap(ego, v) > 0"


def judged(text: str, scene: Sequence[Sequence[Car]]) -> Verdict:
    monitor = Monitor(text, period_s=0.1, trace="drive")
    for number, cars in enumerate(scene):
        monitor.step(frame_of(number, cars))
    (verdict,) = monitor.finish()
    return verdict


def following(frames: int, change: Callable[[int, Car], Car | None]) -> list[list[Car]]:
    """The ego and a car 12 m ahead of it, as it is changed; ``None``: it is absent."""
    scene: list[list[Car]] = []
    for number in range(frames):
        other = change(number, car("v", number + 12.0))
        scene.append([car("ego", float(number)), *([other] if other else [])])
    return scene


# Random checks of random worlds against definitions ----------------------------------------------------


@pytest.mark.parametrize("seed", range(100, 400) if LONG else (13, 108))
def test_verdicts_are_what_their_definition_says(tmp_path: Path, seed: int) -> None:
    rng, (world, store) = random.Random(seed), worlds(seed, tmp_path)
    found = Counter[str]()
    for _ in range(12):
        found += compare_unknown(world, store, unknown_check(rng))

    assert sum(found.values()) > 12
    assert {"true", "false"} <= set(found)


# Absent -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", [0.0, 200.0])
def test_who_is_absent_for_a_while_touches_nobody(data: Path, tmp_path: Path, world: float) -> None:
    path = tmp_path / "merge.sgstore"
    config = Config(range=RangeSettings(world=world))
    ingest(path, [data / "traces/esmini/highway_merge.mcap"], config=config)
    store = sgstore.open(path)

    (verdict,) = store.check(f"{NO_TOUCH} ROBUSTNESS")
    (old,) = store.check(NO_TOUCH.replace("Vehicle", "Vehicle ABSENT AS FALSE"))

    assert verdict.verdict == "true"
    assert verdict.absent_frames == (0 if world else 257)
    assert verdict.robustness is not None
    least = store.find("MATCH (e:Ego), (v:Vehicle) RETURN MIN(gap(e, v)) AS m").rows()[0][0]
    assert verdict.robustness.value == pytest.approx(least)
    assert list(store.shrink(NO_TOUCH)) == []
    assert old.verdict == ("true" if world else "false")


def gone_in_between(number: int, other: Car) -> Car | None:
    return None if 3 <= number < 6 else other


@pytest.mark.parametrize(
    ("check", "verdict"),
    [
        ("FORALL (v:Car) ALWAYS gap(ego, v) > 5", "true"),
        ("FORALL (v:Car) ALWAYS NOT gap(ego, v) <= 5", "true"),
        ("FORALL (v:Car) ALWAYS gap(ego, v) > 9", "false"),
        ("FORALL (v:Car) ALWAYS NOT gap(ego, v) <= 9", "false"),
        ("FORALL (v:Car ABSENT AS TRUE) ALWAYS gap(ego, v) > 5", "true"),
        ("FORALL (v:Car ABSENT AS FALSE) ALWAYS gap(ego, v) > 5", "false"),
        ("FORALL (v:Car ABSENT AS FALSE) ALWAYS NOT gap(ego, v) <= 5", "true"),
        ("FORSOME (v:Car) ALWAYS gap(ego, v) > 5", "false"),
        ("FORSOME (v:Car) ALWAYS NOT gap(ego, v) <= 5", "false"),
        ("FORSOME (v:Car) EVENTUALLY gap(ego, v) > 5", "true"),
        ("FORSOME (v:Car) EVENTUALLY gap(ego, v) > 9", "false"),
        ("FORALL (v:Car) ALWAYS exists_now(v)", "false"),
        ("FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) > 5) > 3frames", "false"),
        ("FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) > 5) > 4frames", "true"),
        ("ALWAYS abs(delta(ego.speed, 0.2s)) < 1", "true"),
        ("ALWAYS prev(ego.speed) > 5", "true"),
        ("ALWAYS prev(ego.speed) > 15", "false"),
        ("ALWAYS sum_over(ego.speed, 3frames) > 25", "true"),
        ("ALWAYS sum_over(ego.speed, 3frames) > 35", "false"),
        ("FORALL (v:Car) ALWAYS delta(v.x, 1frames) > 0.5", "true"),
        ("FORALL (v:Car) ALWAYS coalesce(prev(v.speed), 99) < 50", "false"),
    ],
)
def test_an_absent_entity_neither_violates_nor_fulfils(check: str, verdict: str) -> None:
    found = judged(f"CHECK c: {check}", following(10, gone_in_between))

    assert found.verdict == verdict
    assert found.absent_frames == (3 if verdict == "true" and "v:Car" in check else 0)


def test_absence_is_never_an_infinite_fault() -> None:
    scene = following(10, gone_in_between)

    near = judged("CHECK c: FORALL (v:Car) ALWAYS gap(ego, v) > 5 ROBUSTNESS", scene)
    lately = judged("CHECK c: ALWAYS delta(ego.x, 0.2s) > 1 ROBUSTNESS", scene)

    assert near.robustness is not None
    assert lately.robustness is not None
    assert near.robustness.value == pytest.approx(3.0)
    assert near.robustness.upper is None
    assert lately.robustness.value == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("ALWAYS gap(ego, v) > 5", 0.0),
        ("ALWAYS gap(ego, v) > 9", -1.0),
        ("ALWAYS NOT gap(ego, v) <= 9", -1.0),
        ("ALWAYS (gap(ego, v) > 5 AND dist(ego, v) > 13)", -1.0),
        ("EVENTUALLY gap(ego, v) > 9", -1.0),
        ("EVENTUALLY gap(ego, v) > 5", 3.0),
    ],
)
def test_who_is_asked_for_and_absent_is_no_infinite_fault(formula: str, value: float) -> None:
    text = f"CHECK c: FORSOME (v:Car) {formula} ROBUSTNESS"

    found = judged(text, following(10, gone_in_between)).robustness

    assert found is not None
    assert found.value == pytest.approx(value)


# Unknown ----------------------------------------------------------------------------------------------


def without_size(number: int, other: Car) -> Car:
    return {**other, "length": float("nan")} if number == 4 else other


@pytest.mark.parametrize(
    ("check", "verdict"),
    [
        ("FORALL (v:Car) ALWAYS gap(ego, v) > 5", "unknown"),
        ("FORALL (v:Car) ALWAYS NOT gap(ego, v) <= 5", "unknown"),
        ("FORALL (v:Car) ALWAYS gap(ego, v) > 9", "false"),
        ("FORALL (v:Car) ALWAYS (dist(ego, v) > 5 OR gap(ego, v) > 5)", "true"),
        ("FORALL (v:Car) ALWAYS (dist(ego, v) > 50 AND gap(ego, v) > 5)", "false"),
        ("FORALL (v:Car) EVENTUALLY gap(ego, v) > 5", "true"),
        ("FORSOME (v:Car) ALWAYS gap(ego, v) > 5", "unknown"),
        ("FORSOME (v:Car) ALWAYS gap(ego, v) > 9", "false"),
        ("ALWAYS NOT EXISTS {(v:Car) WHERE gap(ego, v) < 1}", "unknown"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9} >= 1", "unknown"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9} >= 0", "true"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9} < 2", "true"),
        ("ALWAYS 2 > COUNT {(v:Car) WHERE gap(ego, v) < 9}", "true"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 1} < 1", "unknown"),
        ("ALWAYS NOT COUNT {(v:Car) WHERE gap(ego, v) < 1} >= 1", "unknown"),
        ("ALWAYS NOT COUNT {(v:Car) WHERE gap(ego, v) < 1} >= 2", "true"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9 OR dist(ego, v) > 5} = 1", "true"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9 OR dist(ego, v) > 5} <> 1", "false"),
        ("EVENTUALLY COUNT {(v:Car) WHERE gap(ego, v) < 1} = 1", "unknown"),
        ("EVENTUALLY COUNT {(v:Car) WHERE gap(ego, v) < 1} = 2", "false"),
        ("ALWAYS COUNT {(v:Car) WHERE gap(ego, v) < 9} <> 2", "true"),
        ("ALWAYS EXISTS {(v:Car) WHERE gap(ego, v) > 5 OR dist(ego, v) > 5}", "true"),
        ("FORALL (v:Car) ALWAYS max_over(v.length, 3frames) < 5", "unknown"),
        ("FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) > 5) >= 20frames", "true"),
        ("FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) > 5) >= 8frames", "unknown"),
        ("FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) > 5) >= 4frames", "false"),
        ("FORALL (v:Car) ALWAYS v.length IS NOT NULL", "false"),
        ("FORALL (v:Car) ALWAYS robustness(gap(ego, v) > 5) > 1", "unknown"),
        ("FORALL (v:Car) ALWAYS robustness(gap(ego, v) > 5) < 4", "unknown"),
        ("FORALL (v:Car) ALWAYS NOT robustness(gap(ego, v) > 5) <= 1", "unknown"),
        ("FORALL (v:Car) ALWAYS robustness(gap(ego, v) > 5) > 4", "false"),
        ("FORALL (v:Car) ALWAYS robustness(gap(ego, v) > 5 OR dist(ego, v) > 11) > 0", "true"),
        ("FORSOME (v:Car) ALWAYS robustness(gap(ego, v) > 5) > 1", "unknown"),
        ("FORSOME (v:Car) EVENTUALLY robustness(gap(ego, v) > 5) > 4", "unknown"),
        ("FORALL (v:Car) ALWAYS robustness(run_length(gap(ego, v) > 5) < 20frames) > 5", "true"),
    ],
)
def test_what_is_unknown_decides_nothing(check: str, verdict: str) -> None:
    found = judged(f"CHECK c: {check}", following(10, without_size))

    assert found.verdict == verdict


@pytest.mark.parametrize(
    ("check", "lost", "verdict"),
    [
        ("NOT EXISTS {(ego)-[:inDFrontOf]->(v)}", ("heading",), "unknown"),
        ("NOT EXISTS {(v)-[:overlaps]-(ego)}", ("length",), "unknown"),
        ("NOT EXISTS {(v)-[:near|very_near]->(ego)}", ("length", "heading"), "false"),
        ("NOT EXISTS {(v)-[:isIn]->(l:Lane)}", ("width",), "false"),
        ("NOT same_lane(ego, v)", ("heading",), "false"),
        ("NOT next_lane(ego, v)", ("heading",), "unknown"),
        ("off_road(v)", ("width",), "false"),
    ],
)
def test_a_relation_of_what_is_not_measured_is_unknown(
    check: str, lost: Sequence[str], verdict: str
) -> None:
    cars = [car("ego", 0.0, -1.75), car("v", 12.0, -1.75) | dict.fromkeys(lost, float("nan"))]
    rule = f"FORALL (v:Car) ALWAYS {check}"

    assert Known([cars] * 3, road("street")).judged([rule])[rule].verdict == verdict


def test_beside_the_road_is_not_known_of_what_has_no_size() -> None:
    rule = "FORALL (v:Car) ALWAYS (dist(ego, v) > 5 AND off_road(v))"
    cars = [car("ego", 0.0), car("v", 9.0, -7.5)]
    less = [cars[0], cars[1] | {"width": float("nan")}]

    assert Known([cars], road("street")).judged([rule])[rule].verdict == "false"
    assert Known([less], road("street")).judged([rule])[rule].verdict == "unknown"


def test_a_match_that_leans_on_what_is_unknown_is_not_certain() -> None:
    rule = "ALWAYS EXISTS {(w:Car) WHERE dist(ego, w) < 80 AND NOT EXISTS {(ego)-[:sees]->(w)}}"
    near = Config(range=RangeSettings(radius=20, world=100))
    scene = Known([[car("ego", 0.0), car("w", 60.0)]] * 3)

    assert scene.judged([rule])[rule].verdict == "false"
    assert replace(scene, config=near).judged([rule])[rule].verdict == "unknown"


@pytest.mark.parametrize(
    "asked",
    ["lane_dist(ego, v) < 5", "in_junction(v)", "to_crosswalk(v) < 5", "off_road(v)"],
)
@pytest.mark.parametrize(
    "settings", [{"without": ("isIn",)}, {"lanes": replace(Config().lanes, granularity="none")}]
)
def test_without_places_in_lanes_nothing_is_known_of_them(
    asked: str, settings: dict[str, Any]
) -> None:
    rule = f"FORALL (v:Car) ALWAYS NOT {asked}"
    scene = Known([[car("ego", 0.0, -1.75), car("v", 12.0, -1.75)]] * 3, road("street"))
    less = replace(scene, config=replace(Config(), **settings)).judged([rule])[rule]

    assert scene.judged([rule])[rule].verdict in {"true", "false"}
    assert less.verdict == "unknown"
    assert "isIn" in less.reason


def test_an_unknown_verdict_names_condition_entity_and_frame() -> None:
    found = judged("CHECK c: FORALL (v:Car) ALWAYS gap(ego, v) > 5", following(10, without_size))

    assert "gap(ego, v)" in found.reason
    assert "car 1" in found.reason
    assert found.reason.endswith("in drive#4")
    assert not found.violated


def test_an_unknown_value_bounds_robustness() -> None:
    text = "CHECK c: FORALL (v:Car) ALWAYS (gap(ego, v) > 5 OR dist(ego, v) > 11) ROBUSTNESS"

    found = judged(text, following(10, without_size)).robustness

    assert found is not None
    assert found.value == pytest.approx(1.0)
    assert found.upper == pytest.approx(3.0)


@pytest.mark.parametrize("also", ["", " AND dist(ego, v) > 2"])
def test_an_unknown_value_counts_against_robustness_only(also: str) -> None:
    text = f"CHECK c: FORALL (v:Car) ALWAYS (gap(ego, v) > 5{also}) ROBUSTNESS"

    found = judged(text, following(10, without_size))

    assert found.verdict == "unknown"
    assert found.robustness is not None
    assert found.robustness.value == -math.inf
    assert found.robustness.upper == pytest.approx(3.0)


def test_a_number_that_does_not_exist_is_not_unknown() -> None:
    scene = following(10, lambda _, other: {**other, "vx": 20.0})

    for text in ("NOT ttc(ego, v) < 2", "ttc(ego, v) >= 2"):
        assert judged(f"CHECK c: FORALL (v:Car) ALWAYS {text}", scene).verdict == "true"


@pytest.mark.parametrize(
    ("check", "verdict", "value"),
    [
        ("FORALL (v:Car) ALWAYS robustness(ttc(ego, v) >= 2) > 0", "true", math.inf),
        ("FORALL (v:Car) ALWAYS robustness(ttc(ego, v) >= 2) < 0", "true", math.inf),
        ("FORALL (v:Car) ALWAYS NOT robustness(NOT ttc(ego, v) < 2) < 0", "true", math.inf),
        ("FORALL (v:Car) ALWAYS robustness(ttc(ego, v) > 2 AND dist(ego, v) > 9) > 1", "true", 2.0),
        (
            "FORALL (v:Car) ALWAYS robustness(ttc(ego, v) > 2 AND dist(ego, v) > 9) > 4",
            "false",
            -1.0,
        ),
        ("FORSOME (v:Car) EVENTUALLY robustness(ttc(ego, v) > 2) > -1", "false", 0.0),
        ("FORSOME (v:Car) EVENTUALLY robustness(ttc(ego, v) > 2) < 5", "false", 0.0),
    ],
)
def test_a_margin_of_a_number_that_does_not_exist_decides_nothing(
    check: str, verdict: str, value: float
) -> None:
    scene = following(10, lambda _, other: {**other, "vx": 20.0})

    found = judged(f"CHECK c: {check} ROBUSTNESS", scene)

    assert found.verdict == verdict
    assert found.robustness is not None
    assert found.robustness.value == pytest.approx(value)


# Still due --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("check", "frames", "verdict"),
    [
        ("EVENTUALLY[0s, 5s] ego.speed > 30", 50, "pending"),
        ("EVENTUALLY[0s, 5s] ego.speed > 30", 51, "false"),
        ("EVENTUALLY[0s, 5s] ego.speed > 5", 2, "true"),
        ("EVENTUALLY ego.speed > 30", 20, "false"),
        ("ALWAYS (ego.speed > 5 IMPLIES EVENTUALLY[0s, 1s] ego.speed > 30)", 8, "pending"),
        ("ALWAYS (ego.speed > 5 IMPLIES EVENTUALLY[0s, 1s] ego.speed > 30)", 30, "false"),
        ("ALWAYS[0s, 5s] ego.speed > 5", 20, "true"),
        ("ALWAYS NEXT ego.speed > 5", 20, "pending"),
        ("ALWAYS WEAKNEXT ego.speed > 5", 20, "true"),
        ("ego.speed > 5 UNTIL[0frames, 30frames] ego.speed > 30", 20, "pending"),
        ("ego.speed > 30 UNTIL[0frames, 30frames] ego.speed > 40", 20, "false"),
        ("FORALL (v:Car) EVENTUALLY[0s, 5s] gap(ego, v) > 9", 20, "pending"),
        ("ALWAYS EVENTUALLY[0s, 1s] (ego.speed > 5 UNTIL ego.speed > 30)", 8, "pending"),
        ("ALWAYS NOT ALWAYS[0.2s, 0.5s] ego.speed > 5", 5, "pending"),
        ("ALWAYS NOT ALWAYS[0.2s, 0.5s] ego.speed > 5", 6, "false"),
        ("EVENTUALLY ALWAYS NEXT ego.speed > 5", 20, "pending"),
    ],
)
def test_what_is_not_over_at_the_end_is_pending(check: str, frames: int, verdict: str) -> None:
    scene = following(frames, lambda _, other: other)

    assert judged(f"CHECK c: {check}", scene).verdict == verdict
    if verdict == "pending":
        assert judged(f"USING END strong CHECK c: {check}", scene).verdict == "false"
        assert judged(f"USING END weak CHECK c: {check}", scene).verdict == "true"


@pytest.mark.parametrize(
    ("check", "verdict"),
    [
        ("FORSOME (p:Person) EVENTUALLY[0s, 5s] gap(ego, p) < 4", "pending"),
        ("FORSOME (p:Person) EVENTUALLY[0s, 0.5s] gap(ego, p) < 4", "false"),
        ("FORSOME (p:Person) EVENTUALLY gap(ego, p) < 4", "false"),
        ("FORSOME (p:Person) ALWAYS gap(ego, p) < 4", "false"),
        ("FORSOME (p:Person) ALWAYS ego.speed < 30", "false"),
        ("USING END pending CHECK FORSOME (p:Person) EVENTUALLY gap(ego, p) < 4", "pending"),
        ("USING END pending CHECK FORSOME (p:Person) ALWAYS gap(ego, p) < 4", "false"),
        ("USING END pending CHECK FORSOME (p:Person) ALWAYS ego.speed < 30", "pending"),
        ("USING END pending CHECK FORALL (v:Car) FORSOME (p:Person) ALWAYS v.x > -9", "pending"),
        ("USING END strong CHECK FORSOME (p:Person) EVENTUALLY[0s, 5s] gap(ego, p) < 4", "false"),
    ],
)
def test_some_who_come_later_are_still_due(check: str, verdict: str) -> None:
    scene = Known(following(20, lambda _, other: other))

    assert scene.judged([check])[check].verdict == verdict


def test_all_that_is_due_may_be_pending() -> None:
    scene = following(20, lambda _, other: other)

    asked = {"EVENTUALLY ego.speed > 30": "pending", "ALWAYS ego.speed > 5": "true"}
    for check, verdict in asked.items():
        assert judged(f"USING END pending CHECK c: {check}", scene).verdict == verdict


def test_build_servers_skip_what_is_not_decided(tmp_path: Path) -> None:
    scene = following(10, gone_in_between)
    with Recorder(tmp_path / "drive.mcap") as recorder:
        for number, cars in enumerate(scene):
            told = [recorded(int(c["ident"] == "ego"), c["x"], v=(10, 0)) for c in cars]
            recorder.ground_truth(number / 10, told, host=1)
    ingest(tmp_path / "drive.sgstore", [tmp_path / "drive.mcap"])
    texts = ["EVENTUALLY[0s, 5s] ego.speed > 30", "FORALL (v:Car) ALWAYS gap(ego, v) > 5"]
    rules = ";".join(f"CHECK c{n}: {text}" for n, text in enumerate(texts))

    junit = str(tmp_path / "junit.xml")
    assert run(["check", str(tmp_path / "drive.sgstore"), "-e", rules, "--junit", junit]) == 0

    pending, kept = ElementTree.parse(tmp_path / "junit.xml").getroot().findall("*/testcase")
    (skipped,) = pending
    assert (skipped.tag, skipped.get("message")) == (
        "skipped",
        "pending at the end of the recording",
    )
    assert [(one.tag, one.text) for one in kept] == [
        ("system-out", "an entity is absent in 3 frames")
    ]


# Laws: less knowledge, and an earlier end, contradict nothing --------------------------------------

RULES = (
    "FORALL (v:Car) ALWAYS gap(ego, v) > 3",
    "FORALL (v:Car) ALWAYS NOT ttc(ego, v) < 2",
    "FORALL (v:Car) ALWAYS (v.speed > 8 IMPLIES EVENTUALLY[0s, 0.3s] dist(ego, v) > 8)",
    "FORALL (v:Car) ALWAYS (abs(delta(v.speed, 0.2s)) < 3 OR prev(gap(ego, v)) > 5)",
    "FORALL (v:Car) ALWAYS NOT run_length(gap(ego, v) < 6) >= 3frames",
    "FORALL (v:Car) ALWAYS (max_over(v.speed, 0.2s) < 12 XOR v.length > 4.2)",
    "FORSOME (v:Car) EVENTUALLY (gap(ego, v) < 4 AND v.speed < ego.speed)",
    "FORSOME (v:Car) ALWAYS NOT headway(ego, v) < 0.5",
    "FORALL (a:Car) FORSOME (b:Car) EVENTUALLY gap(a, b) < 5",
    "ALWAYS NOT EXISTS {(v:Car) WHERE gap(ego, v) < 2 AND v.speed < ego.speed}",
    "ALWAYS (COUNT {(v:Car) WHERE v.speed > 9} < 2)",
    "ALWAYS NOT MIN {(v:Car) | gap(ego, v)} < 2",
)
BOUNDED = tuple(
    rule for rule in RULES if "EVENTUALLY (" not in rule and "EVENTUALLY gap" not in rule
)
"""Those whose operators are over at some time: others fail at the end."""

EACH = 500 if LONG else 20
"""Scenes that a test looks at."""


def firsts(scenes: int) -> range:
    """The numbers of the first scenes of each test."""
    return range(0, scenes if LONG else 1, EACH)


@pytest.mark.parametrize("first", firsts(10_000))
def test_less_knowledge_contradicts_no_verdict(first: int) -> None:
    known: Counter[str] = Counter()
    for seed in range(first, first + EACH):
        rng = random.Random(seed)
        scene = random_scene(rng)
        less, taken = reduced(scene, rng)
        rules = [rng.choice(RULES), *Checks(rng, scene).some(3)]
        whole = scene.judged(rules)
        for rule, verdict in less.judged(rules).items():
            known[verdict.verdict] += 1
            # Who has no size hides nobody, and without a heading drives between no others.
            between = "measured" in taken and any(word in rule for word in (":sees", "lead"))
            if verdict.verdict in {"true", "false"} and not between:
                assert whole[rule].verdict == verdict.verdict, (seed, taken, rule)

    assert min(known["true"], known["false"], known["unknown"]) > 10


@pytest.mark.parametrize("first", firsts(2_000))
def test_an_earlier_end_violates_nothing_more(first: int) -> None:
    ended: Counter[str] = Counter()
    for seed in range(first, first + EACH):
        rng = random.Random(seed)
        scene = random_scene(rng)
        rules = [rng.choice(BOUNDED), *Checks(rng, scene, ended=True).some(3)]
        cut = scene.until(rng.randint(1, len(scene.frames) - 1))
        whole = scene.judged(rules)
        for rule, verdict in cut.judged(rules).items():
            ended[verdict.verdict] += 1
            # The wait for an entity that comes later is unbounded: FORSOME is false without it.
            newcomer = rule.startswith("FORSOME") and whole[rule].absent_frames
            if verdict.verdict == "false" and not newcomer:
                assert whole[rule].verdict == "false", (seed, rule)

    assert min(ended["true"], ended["false"], ended["pending"]) > 3


def test_rules_about_values_that_no_trace_has_are_unknown(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:  # without controls
        for i in range(4):
            recorder.ground_truth(i / 10, [recorded(1, x=i)], host=1)
    ingest(tmp_path / "a.sgstore", [recorder.path])

    for name in ("phi3", "phi5"):
        (verdict,) = sgstore.open(tmp_path / "a.sgstore").check(name)
        assert verdict.verdict == "unknown"
        assert "never has a value" in verdict.reason
