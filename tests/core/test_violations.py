"""Violations of checks: where they begin, and how long the condition is false."""

from __future__ import annotations

import json
import random
from itertools import groupby
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pytest
from recordings import Recorder
from recordings import car as recorded
from thorough import LONG

import sgstore
from sgstore.apps.cli import run
from sgstore.ingest import ingest

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.matches import Interval
    from sgstore.query import Store

    Speeds = Sequence[int]

pytestmark = pytest.mark.seconds(30)

FRAMES = 40


def drive(folder: Path, speeds: Sequence[Speeds]) -> Store:
    """A store of cars with these speeds in each frame, at 10 Hz; the first is the ego."""
    with Recorder(folder / "drive.mcap") as recorder:
        for number, now in enumerate(zip(*speeds, strict=True)):
            cars = [recorded(n, 30.0 * n, v=(v, 0)) for n, v in enumerate(now, 1)]
            recorder.ground_truth(number / 10, cars, host=1)
    path = folder / "drive.sgstore"
    ingest(path, [folder / "drive.mcap"])
    return sgstore.open(path)


@pytest.fixture(scope="module")
def applying(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """The ego is fast in frames 5 to 9, another car in frames 8 to 12."""
    speeds = [[8] * 5 + [12] * 5 + [8] * 30, [8] * 8 + [12] * 5 + [8] * 27, [8] * FRAMES]
    return drive(tmp_path_factory.mktemp("applying"), speeds)


def random_speeds(rng: random.Random) -> list[int]:
    return [v for _ in range(FRAMES) for v in [rng.choice((3, 8, 12))] * rng.randint(1, 8)][:FRAMES]


def runs_of(false: Sequence[bool], first: int, last: int) -> list[tuple[int, int, int]]:
    """First frame, last frame and length of each run of false frames."""
    frames = [i for i in range(first, last + 1) if false[i]]
    grouped = groupby(enumerate(frames), lambda pair: pair[1] - pair[0])
    runs = [[frame for _, frame in run] for _, run in grouped]
    return [(run[0], run[-1], len(run)) for run in runs]


def told(runs: Sequence[Interval]) -> list[tuple[int, int, int]]:
    return [(run.start_seq, run.end_seq, run.frames) for run in runs]


def too_fast(v: Speeds, i: int) -> bool:
    return v[i] > 10


def unanswered(v: Speeds, i: int, *, open_fails: bool = False) -> bool:
    known = open_fails or i + 10 < FRAMES
    return v[i] > 10 and known and min(v[i : i + 11]) > 5


def unanswered_at_end(v: Speeds, i: int) -> bool:
    return unanswered(v, i, open_fails=True)


def never_answered(v: Speeds, i: int) -> bool:
    return v[i] > 10 and min(v[i:]) > 5


def too_long(v: Speeds, i: int) -> bool:
    return i >= 3 and min(v[i - 3 : i + 1]) > 10


ANSWER = "ALWAYS (ego.speed > 10 IMPLIES EVENTUALLY[0s, 1s] ego.speed < 5)"
RULES: dict[str, Callable[[Speeds, int], bool]] = {
    "CHECK ALWAYS ego.speed <= 10": too_fast,
    "CHECK ALWAYS ego.speed <= 10 RESET WHEN ego.speed < 5": too_fast,
    "CHECK ALWAYS ego.speed < 20 AND ALWAYS ego.speed <= 10": too_fast,
    f"CHECK {ANSWER}": unanswered,
    f"CHECK {ANSWER} RESET WHEN ego.speed < 5": unanswered,
    f"USING END strong CHECK {ANSWER}": unanswered_at_end,
    "CHECK ALWAYS (ego.speed > 10 IMPLIES EVENTUALLY ego.speed < 5)": never_answered,
    "CHECK ALWAYS NOT HISTORICALLY[0frames, 3frames] ego.speed > 10": lambda v, i: (
        min(v[max(0, i - 3) : i + 1]) > 10
    ),
    "CHECK ALWAYS NOT run_length(ego.speed > 10) >= 4frames": too_long,
}


@pytest.mark.parametrize("seed", range(30) if LONG else (4,))
def test_false_runs_are_the_frames_in_which_the_condition_is_false(
    seed: int, tmp_path: Path
) -> None:
    rng = random.Random(seed)
    speeds = random_speeds(rng)
    store, violated = drive(tmp_path, [speeds]), 0

    for text, is_false in RULES.items():
        (verdict,) = store.check(text)
        false, begin = [is_false(speeds, i) for i in range(FRAMES)], 0
        assert verdict.violated == any(false), text
        for one in verdict.violations:
            assert told(one.false_runs) == runs_of(false, begin, one.end_seq), text
            begin, violated = one.end_seq + 1, violated + 1
    assert violated > len(RULES) / 2


def test_a_violation_names_the_frame_of_its_trigger(tmp_path: Path) -> None:
    store = drive(tmp_path, [[8] * 5 + [12] * 5 + [8] * 30])

    (verdict,) = store.check(f"CHECK {ANSWER}")

    (violation,) = verdict.violations
    assert (violation.start_seq, violation.end_seq) == (16, 39)  # certain 1 s after frame 5
    (run,) = violation.false_runs
    assert (run.start_seq, run.end_seq, run.frames) == (5, 9, 5)
    assert (run.start, run.end) == (pytest.approx(0.5), pytest.approx(0.9))


def test_reports_show_how_long_the_condition_is_false(
    applying: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit, sarif = tmp_path / "junit.xml", tmp_path / "found.sarif"
    line = ["check", str(applying.file.path), f"CHECK {ANSWER}"]

    assert run([*line, "--junit", str(junit), "--sarif", str(sarif)]) == 0
    table = capsys.readouterr().out
    assert run([*line, "--json"]) == 0

    told = "condition false from 0.500 to 0.900 s, in 5 frames"
    assert told in ElementTree.parse(junit).getroot().findtext(".//failure", "")
    (result,) = json.loads(sarif.read_text())["runs"][0]["results"]
    assert result["message"]["text"].endswith(told)
    assert table.splitlines()[-1].split()[-3:] == ["0.5", "0.9", "5"]
    (verdict,) = json.loads(capsys.readouterr().out)
    (one,) = verdict["violations"][0]["false_runs"]
    assert (one["start_seq"], one["end_seq"], one["frames"]) == (5, 9, 5)


def test_rules_without_a_condition_of_each_frame_have_no_false_runs(tmp_path: Path) -> None:
    store = drive(tmp_path, [[8] * FRAMES])

    for text in ("EVENTUALLY ego.speed > 10", "ego.speed > 10", "FORSOME (v:Car) v.speed > 10"):
        (verdict,) = store.check(f"CHECK {text}")
        assert [one.false_runs for one in verdict.violations] == [()], text


def test_violations_of_the_same_frames_unite_the_false_runs_of_all_witnesses(
    tmp_path: Path,
) -> None:
    slow = [8] * FRAMES
    one = [8] * 5 + [12] * 5 + [8] * 30
    other = [8] * 5 + [12] * 3 + [8] * 12 + [12] * 20
    store = drive(tmp_path, [slow, one, other])

    (verdict,) = store.check("CHECK FORALL (v:Car) ALWAYS v.speed <= 10")

    of_each = [told(witness.violations[0].false_runs) for witness in verdict.witnesses]
    assert of_each == [[(5, 9, 5)], [(5, 7, 3), (20, 39, 20)]]
    (whole,) = verdict.violations
    assert told(whole.false_runs) == [(5, 9, 5), (20, 39, 20)]


# Checks that never applied ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rule", "applied", "bindings"),
    [
        ("ALWAYS (ego.speed > 10 IMPLIES ego.speed > 9)", 5, None),
        ("ALWAYS (ego.speed > 90 IMPLIES ego.speed > 95)", 0, None),
        ("ALWAYS (ONCE[0frames, 2frames] ego.speed > 10 IMPLIES ego.speed > 0)", 7, None),
        ("ALWAYS (EVENTUALLY[0frames, 2frames] ego.speed > 10 IMPLIES ego.speed > 0)", 7, None),
        (
            "ALWAYS ((ego.speed > 90 IMPLIES ego.x < 0) AND (ego.speed < 9 IMPLIES ego.x < 99))",
            35,
            None,
        ),
        (
            "ALWAYS (ego.speed > 90 IMPLIES ego.x < 0) AND ALWAYS (ego.speed > 10 IMPLIES ego.x < 99)",
            5,
            None,
        ),
        ("USING GAPS unknown CHECK ALWAYS (ego.speed > 10 IMPLIES ego.speed > 9)", 5, None),
        ("FORALL (v:Car) ALWAYS (v.speed > 10 IMPLIES v.speed < 15)", 8, 3),
        ("FORALL (v:Car) ALWAYS (v.speed > 10 IMPLIES EVENTUALLY v.speed < 15)", 8, 3),
        ("FORALL (v:Car WHERE v.speed > 11) ALWAYS v.speed < 15", 8, 3),
        ("FORALL (v:Car WHERE v.speed > 90) ALWAYS v.speed < 15", 0, 3),
        ("FORALL (v:Car WHERE v.speed > 90) ALWAYS (v.speed > 10 IMPLIES v.speed < 15)", 0, 3),
        ("FORALL (v:Car, w:Vehicle) ALWAYS dist(v, w) > 1", None, 6),
        ("FORALL (v:Car) ALWAYS dist(ego, v) > 1", None, 2),
        ("FORALL (v:Car) ALWAYS (v.speed > 10 IMPLIES dist(ego, v) > 1)", 5, 2),
        ("FORALL (p:Person) ALWAYS gap(ego, p) > 1", None, 0),
        ("FORALL (v:Car, w:Car) ALWAYS (v.speed > 10 IMPLIES dist(v, w) > 1)", 8, 6),
        ("FORALL (v:Car, w:Car WHERE w.speed > 90) ALWAYS (v.speed > 10 IMPLIES v.x < 99)", 0, 6),
        ("ALWAYS ego.speed < 20", None, None),
        ("FORSOME (v:Car) ALWAYS v.speed < 20", None, None),
    ],
)
def test_a_true_verdict_tells_how_often_the_check_applied(
    applying: Store, rule: str, applied: int | None, bindings: int | None
) -> None:
    (verdict,) = applying.check(rule if rule.startswith("USING") else f"CHECK {rule}")

    assert verdict.verdict == "true"
    assert (verdict.applied_frames, verdict.bindings) == (applied, bindings)
    assert bool(verdict.never_applied) == (0 in {applied, bindings})


def test_a_false_verdict_has_no_count(applying: Store) -> None:
    (verdict,) = applying.check("CHECK ALWAYS (ego.speed > 10 IMPLIES ego.speed > 15)")

    assert (verdict.applied_frames, verdict.bindings, verdict.never_applied) == (None, None, "")


def test_check_prints_which_rules_never_applied(
    applying: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "CHECK rare: ALWAYS (ego.speed > 90 IMPLIES ego.speed > 95);"
        "CHECK nobody: FORALL (p:Person) ALWAYS gap(ego, p) > 1;"
        "CHECK often: ALWAYS (ego.speed > 10 IMPLIES ego.speed > 9)"
    )
    junit = tmp_path / "junit.xml"

    assert run(["check", str(applying.file.path), "-e", text, "--junit", str(junit)]) == 0

    out, err = capsys.readouterr()
    _, _, *rows = out.splitlines()
    assert [row.split() for row in rows] == [
        ["rare", "drive", "true", "0"],
        ["nobody", "drive", "true", "0"],
        ["often", "drive", "true", "5"],
    ]
    assert "rare is true of drive: never applied: its premise is true in no frame" in err
    assert "nobody is true of drive: never applied: no entities" in err
    assert "often" not in err
    cases = ElementTree.parse(junit).getroot().findall("*/testcase")
    assert [bool(case.findtext("system-out")) for case in cases] == [True, True, False]
