"""Temporal formulas: both engines against the textbook, and against the published verdicts of SGSM."""

from __future__ import annotations

import csv
import io
import random
import tarfile
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from formulas import OnlineFormula, formula_of, prefix_verdicts
from oracle_temporal import NAMES, holds, random_formula, random_word, try_formulas
from thorough import LONG

from sgstore.errors import QueryError
from sgstore.temporal import evaluate
from sgstore.temporal._formula import And, Next, Not, always, eventually
from sgstore.temporal._quantifiers import number_of_bindings
from sgstore.temporal._verdicts import PRESUMABLY_TRUE, Settled

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.temporal import Formula

pytestmark = pytest.mark.seconds(6)

SECOND = 1_000_000_000


@pytest.mark.parametrize("first", range(0, 2000 if LONG else 1000, 500))
def test_random_formulas_are_true_where_the_textbook_says(first: int) -> None:
    assert 500 < try_formulas(first, 500) < 5000


def at(text: str, *, clock: list[float] | None = None, **columns: str) -> str:
    """Where a formula is true: columns and answer as ``"0110"``."""
    arrays = {name: np.array([c == "1" for c in flags]) for name, flags in columns.items()}
    frames = len(next(iter(columns.values())))
    times = np.array([round(t * SECOND) for t in clock or range(frames)], np.int64)
    return "".join("01"[value] for value in evaluate(formula_of(text), arrays, times).astype(int))


@pytest.mark.parametrize(
    ("text", "a", "b", "answer"),
    [
        ("NEXT a", "0110", "0000", "1100"),
        ("WEAKNEXT a", "0110", "0000", "1101"),
        ("PREVIOUS a", "0110", "0000", "0011"),
        ("ALWAYS a", "0111", "0000", "0111"),
        ("EVENTUALLY[1s, 2s] a", "0001", "0000", "0110"),
        ("a UNTIL b", "1101", "0010", "1110"),
        ("a UNTIL[2frames, 3frames] b", "1111", "0110", "1000"),
        ("a RELEASE b", "0010", "1111", "1111"),
        ("a SINCE b", "0111", "1000", "1111"),
        ("HISTORICALLY[0s, 1s] a", "1011", "0000", "1001"),
        ("ONCE WITHIN 1s a", "1000", "0000", "1100"),
        ("ALWAYS (a IMPLIES NEXT b)", "0100", "0010", "1111"),
        ("a XOR b", "0011", "0101", "0110"),
        ("NOT a AND NOT b", "0011", "0101", "1000"),
    ],
)
def test_words_mean_what_the_documentation_says(text: str, a: str, b: str, answer: str) -> None:
    assert at(text, a=a, b=b) == answer


def test_bounds_compare_times_not_frames() -> None:
    assert at("EVENTUALLY[0s, 1s] a", clock=[0, 0.4, 3.0, 3.5], a="0001") == "0011"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("ALWAYS (a AND)", "expected"),
        ("a.speed > 3", "expected propositions, logic and time only"),
        ("NEXT[0s, 1s] a", "NEXT has no bound"),
        ("EVENTUALLY[2s, 1s] a", "the bound is before its start"),
        ("EVENTUALLY[2frames, 3s] a", "in time or in frames, not both"),
        ("EVENTUALLY[0s, $d] a", "has no parameters"),
        ("a; b", "expected"),
    ],
)
def test_what_is_no_formula_is_refused_where_it_stands(text: str, reason: str) -> None:
    with pytest.raises(QueryError, match=reason) as caught:
        formula_of(text)

    assert caught.value.text == text


def test_columns_that_do_not_fit_are_refused() -> None:
    formula, times = formula_of("a UNTIL b"), np.arange(3)
    good = np.zeros(3, np.bool_)

    with pytest.raises(ValueError, match="no column for the proposition 'b'"):
        evaluate(formula, {"a": good}, times)
    with pytest.raises(ValueError, match=r"b has shape \(2,\), expected \(3,\)"):
        evaluate(formula, {"a": good, "b": good[:2]}, times)
    with pytest.raises(ValueError, match="must ascend"):
        evaluate(formula, {"a": good, "b": good}, times[::-1])
    engine = OnlineFormula(formula)
    engine.step({"a": True, "b": False}, 5)
    with pytest.raises(ValueError, match="must ascend"):
        engine.step({"a": True, "b": False}, 5)


def test_an_empty_trace_has_no_values() -> None:
    empty = {"a": np.zeros(0, np.bool_)}

    assert evaluate(formula_of("ALWAYS a"), empty, np.zeros(0, np.int64)).shape == (0,)
    assert prefix_verdicts(formula_of("ALWAYS a"), empty, np.zeros(0, np.int64)).shape == (0,)


def test_online_a_value_is_known_when_its_look_ahead_is_over() -> None:
    engine = OnlineFormula(formula_of("EVENTUALLY[0s, 2s] a"))
    told = [engine.step({"a": t == 9}, t * SECOND) for t in range(12)]

    assert told[:3] == [[], [], []]
    assert told[3] == [(0, False)]
    assert told[9] == [(6, False), (7, True), (8, True), (9, True)]
    assert engine.finish() == [(10, False), (11, False)]


def test_online_memory_does_not_grow_with_the_trace() -> None:
    engine = OnlineFormula(
        formula_of("ALWAYS (a IMPLIES EVENTUALLY[0s, 5s] b) AND ONCE[0s, 5s] (a SINCE b)")
    )
    sizes = []
    for t in range(3000):
        engine.step({"a": t % 3 == 0, "b": t % 4 == 0}, t * SECOND)
        sizes.append(len(engine.terms._known))

    assert max(sizes[1500:]) <= max(sizes[:1500])


# What SGSM published ----------------------------------------------------------------------------------------

IN_VIEW = "are_entities_within_7m OR are_red_traffic_lights_for_ego OR are_stop_signs_for_ego"
FORMULAS = {
    "Phi1": "ALWAYS NOT ego_is_in_opposing_lane",
    "Phi2": "ALWAYS NOT ego_is_out_of_road",
    "Phi3": "ALWAYS (is_in_right_most_lane AND NOT is_in_junction IMPLIES is_not_steering_right)",
    "Phi5": "ALWAYS (are_entities_super_near AND NOT are_entities_near_coll AND NEXT are_entities_near_coll"
    " IMPLIES NEXT is_throttle_not_positive)",
    "Phi6": f"ALWAYS (NOT is_stopped AND NOT ({IN_VIEW}) AND NEXT (NOT ({IN_VIEW}))"
    " IMPLIES NEXT NOT is_stopped)",
    "Phi9": "ALWAYS (NOT are_stop_signs_for_ego AND NEXT are_stop_signs_for_ego IMPLIES NEXT"
    " (are_stop_signs_for_ego UNTIL (is_stopped OR ALWAYS are_stop_signs_for_ego)))",
}
FORMULAS |= {
    f"Phi4_S_{s}": "ALWAYS (are_entities_near_coll IMPLIES NOT ego_is_faster_than_s)"
    for s in (5, 10, 15)
}
PROPERTIES = 15
"""Files of a route: one for each property."""
VIOLATED = {"LAV": 64, "TCP": 51}
"""Files with a prefix that is not accepted, of each system's 150."""


def never(condition: Formula, frames: int) -> Formula:
    """That a condition does not hold at so many frames in a row: ``~ $[N][condition]``."""
    row = condition
    for _ in range(frames - 1):
        row = And((condition, Next(row)))
    return Not(eventually(row))


FORMULAS_OF_TIME = {
    f"{name}_T_{seconds}": never(condition, 2 * seconds)
    for seconds in (5, 10, 15)
    for name, condition in (
        ("Phi7", formula_of("is_in_multiple_lanes AND NOT is_in_juntion")),
        ("Phi8", formula_of("is_only_in_junction")),
    )
}


def property_named(name: str) -> Formula:
    return FORMULAS_OF_TIME[name] if name in FORMULAS_OF_TIME else formula_of(FORMULAS[name])


Published = tuple[int, str, str, dict[str, np.ndarray], np.ndarray]
"""Number of a file, system, property, propositions and verdicts."""


@pytest.fixture(scope="module")
def published(data: Path) -> list[Published]:
    """Files of each property of every fifth route; of all in a long run."""
    return list(files_of(data / "sgsm" / "extending_sgsm_results.tar.xz"))


def files_of(path: Path) -> Iterator[Published]:
    with tarfile.open(path) as archive:
        files = (member for member in archive if member.name.endswith(".csv"))
        for number, member in enumerate(files):
            if not LONG and number // PROPERTIES % 5:
                continue
            stream = archive.extractfile(member)
            assert stream is not None
            header, *rows = csv.reader(io.TextIOWrapper(stream, encoding="utf-8"))
            flags = np.array(rows)[:, 1:] == "True"
            columns = dict(zip(header[1:], flags.T, strict=True))
            verdicts = columns.pop("prop_eval")
            system = next(part for part in member.name.split("/") if "_results" in part)
            yield number, system.split("_")[0], Path(member.name).stem, columns, verdicts


@pytest.mark.data
def test_every_verdict_that_sgsm_published_is_met_online(published: list[Published]) -> None:
    violated, verdicts, files = {"LAV": 0, "TCP": 0}, 0, 0
    for _, system, name, columns, published_verdicts in published:
        engine, told = OnlineFormula(property_named(name)), []
        letters = zip(*(flags.tolist() for flags in columns.values()), strict=True)
        for t, letter in enumerate(letters):
            engine.step(dict(zip(columns, letter, strict=True)), t)
            told.append(engine.verdict)
        assert told == published_verdicts.tolist(), (system, name)
        violated[system] += not all(told)
        verdicts += len(told)
        files += 1

    if LONG:
        assert (files, verdicts, violated) == (300, 336_911, VIOLATED)
    assert files >= 60
    assert all(violated.values())


@pytest.mark.data
def test_verdicts_that_sgsm_published_are_met_by_columns(published: list[Published]) -> None:
    every = 1 if LONG else 15  # of two routes every other property, and the others; all in a minute
    frames = None if LONG else 600  # verdicts of prefixes: those of the first frames stand alone
    verdicts = 0
    for number, system, name, columns, published_verdicts in published:
        route, property_of_route = divmod(number, PROPERTIES)
        if route % every or (every > 1 and (route + property_of_route) % 2):
            continue
        wanted = published_verdicts[:frames]
        first = {one: flags[:frames] for one, flags in columns.items()}
        told = prefix_verdicts(property_named(name), first, np.arange(len(wanted)))
        assert np.array_equal(told, wanted), (system, name)
        verdicts += len(told)

    assert verdicts == (336_911 if every == 1 else 9_000)


@pytest.mark.data
def test_every_verdict_that_sgsm_published_is_a_status(published: list[Published]) -> None:
    verdicts = 0
    for _, system, name, columns, published_verdicts in published:
        times = np.arange(len(published_verdicts))
        statuses = Settled(property_named(name), columns, times).statuses()
        assert np.array_equal(statuses >= PRESUMABLY_TRUE, published_verdicts), (system, name)
        verdicts += len(statuses)

    assert verdicts == 336_911 if LONG else verdicts > 60_000


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


@pytest.mark.parametrize("seed", range(200 if LONG else 20))
def test_combinations_of_entities_are_counted_as_they_are_listed(seed: int) -> None:
    rng = random.Random(seed)
    domains = [{n for n in range(5) if rng.random() < 0.6} for _ in range(rng.randint(1, 4))]
    every = [*product(*domains)]

    assert number_of_bindings(domains, injective=False) == len(every)
    apart = [one for one in every if len({*one}) == len(one)]
    assert number_of_bindings(domains, injective=True) == len(apart)
