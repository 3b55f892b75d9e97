"""Violations of checks: where they begin, and how long the condition is false."""

from __future__ import annotations

import random
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracle_temporal import NAMES, holds, random_formula, random_word
from recordings import Recorder
from recordings import car as recorded
from thorough import LONG

import sgstore
from sgstore.ingest import ingest
from sgstore.temporal._formula import always
from sgstore.temporal._verdicts import Settled

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


@pytest.mark.parametrize("first", range(0, 20_000, 500) if LONG else (0,))
def test_random_conditions_are_false_where_the_textbook_says(first: int) -> None:
    open_ones = 0
    for seed in range(first, first + 500):
        rng = random.Random(seed)
        body, (word, times) = random_formula(rng, 3), random_word(rng)
        columns = {name: np.array([letter[name] for letter in word]) for name in NAMES}
        settled = Settled(always(body), columns, np.array(times, np.int64))

        found = [settled.false_frames(end) for end in ("strong", "bounded", "weak")]

        strong, bounded, weak = (one for one in found if one is not None)
        assert strong.tolist() == [not holds(body, word, times, i) for i in range(len(word))]
        assert not (weak & ~bounded).any()
        for _ in range(3):  # later frames change nothing that is certain
            more, gaps = random_word(rng)
            after = [times[-1] + 1 + time - gaps[0] for time in gaps]
            for i in np.flatnonzero(weak).tolist():
                assert not holds(body, [*word, *more], [*times, *after], i), (seed, i)
        open_ones += int((strong & ~weak).sum())
    assert open_ones > 50
