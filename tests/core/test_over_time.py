"""Sequences, operators of time and checks over a store, against their definitions and as people use them."""

from __future__ import annotations

import itertools
import json
import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from formulas import OnlineFormula, formula_of, prefix_verdicts
from oracle_constructs import ASKED
from oracle_over_time import (
    COURSES,
    MARGINS,
    PAIR_COURSES,
    compare_check,
    compare_condition,
    compare_edges,
    compare_over_check,
    compare_over_pattern,
    compare_over_sequence,
    compare_sequence,
    edge_questions,
    random_check,
    random_sequence,
    worlds,
)
from oracle_temporal import holds, random_formula, random_word
from recordings import Recorder
from recordings import car as recorded
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.errors import QueryError
from sgstore.ingest import ingest
from sgstore.lang.ir import BoundHold, Length
from sgstore.lang.library import pattern_named
from sgstore.query import Store
from sgstore.temporal import _joint_bindings, _offline, _runs, _sequences, evaluate
from sgstore.temporal._decision_frames import known
from sgstore.temporal._formula import And
from sgstore.temporal._sequences import BindingLine, Leg, matches_of
from sgstore.temporal._signal_values import Clock
from sgstore.temporal._signals import PropositionTable
from sgstore.temporal._verdicts import STATUS, Settled, within_bounds

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from oracle_worlds import World

pytestmark = pytest.mark.seconds(17)

PAIR = "MATCH (e:Ego)-[:near|visible]-(v:Entity)"


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[World, Store]]:
    world, store = worlds(7, tmp_path_factory.mktemp("worlds"))
    with store.file.snapshot():
        yield world, store


@pytest.fixture
def store(asked: tuple[World, Store]) -> Store:
    return asked[1]


# Against the definitions


def test_sequences_are_what_their_definition_says(asked: tuple[World, Store]) -> None:
    rng = random.Random(1)
    policies = itertools.cycle(("all", "first", "longest"))

    found = [compare_sequence(*asked, random_sequence(rng), next(policies)) for _ in range(12)]

    assert sum(found) > 3


def test_conditions_over_time_are_what_their_definition_says(asked: tuple[World, Store]) -> None:
    rng = random.Random(2)

    found = [compare_condition(*asked, rng) for _ in range(12)]

    assert sum(found) > 10


def test_values_over_matches_are_what_their_definition_says(asked: tuple[World, Store]) -> None:
    """Of sequences, of patterns and of violations; over a store, frame by frame, and as they are defined."""
    rng = random.Random(11)

    found = [
        [
            compare(*asked, rng)
            for compare in (compare_over_sequence, compare_over_pattern, compare_over_check)
        ]
        for _ in range(2)
    ]

    assert all(sum(one) > 3 for one in zip(*found, strict=True)), found


@pytest.mark.parametrize("construct", ASKED)
def test_random_values_and_checks_are_what_their_definition_says(
    asked: tuple[World, Store], construct: str
) -> None:
    rng = random.Random(6)

    assert sum(ASKED[construct](*asked, rng) for _ in range(20 if LONG else 2)) > 0


LOOSE = "MATCH (a), (b), (c) AS s0 THEN MATCH (b), (a), (c) AS s1 RETURN trace.name, a, b, c"


@pytest.fixture
def little_memory(store: Store, monkeypatch: pytest.MonkeyPatch) -> Store:
    """The store as on a machine that may hold 40,000 rows, 6,000 matches and 100,000 bindings."""
    monkeypatch.setattr(_offline, "ROW_BYTES", (64 << 20) // 40_000)
    monkeypatch.setattr(_offline, "MOST_BINDINGS", 100_000)
    monkeypatch.setattr(_sequences, "MOST_MATCHES", 6_000)
    return Store(store.file.path, memory=64 << 20)


def test_traces_that_hold_too_much_together_are_asked_one_by_one(
    store: Store, little_memory: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = little_memory.find(LOOSE).rows()

    assert len(found) > 10_000
    monkeypatch.undo()
    assert found == store.find(LOOSE).rows()


def test_a_sequence_is_joined_once_for_all_traces(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def counted(*given: Any) -> Any:
        calls.append(1)
        return matches_of(*given)

    monkeypatch.setattr(_sequences, "matches_of", counted)
    text = "USING UNKNOWN false MATCH (a) WHERE a.speed > 3 THEN MATCH (a) WHERE a.speed <= 3"

    traces = {interval.trace for interval in store.find(text).intervals()}

    assert len(traces) > 1
    assert len(calls) == 1


def test_sequences_joined_in_parts_are_those_joined_at_once(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = f"USING UNKNOWN false {PAIR} THEN WITHIN 1s MATCH (e), (v) WHERE e.speed > v.speed"
    at_once = store.find(text).rows()
    monkeypatch.setattr(_joint_bindings, "ROWS", 3)

    assert store.find(text).rows() == at_once
    assert len(at_once) > 10


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            LOOSE.replace("(c) AS", "(c), (d) AS"),
            r"step 1 holds for more than 40,\d+ combinations of nodes and frames of trace1, more",
        ),
        (
            "MATCH (a:Ego) AS s0 THEN MATCH (b), (c), (d), (a), (f), (g) WHERE prev(b.speed) > 0",
            r"step 2 holds for more than \d+,\d+ combinations of nodes and frames of trace1",
        ),
        (
            "MATCH (a), (b) AS s0 THEN MATCH (x), (y) AS s1",
            r"trace1 has more than 6,000 matches, more than memory may take",
        ),
        (
            "MATCH (a), (b), (c) AS s0 THEN MATCH (x), (y) AS s1",
            r"the steps together hold for too much: \d+,\d+ combinations of nodes in one trace",
        ),
        (
            "USING NODES any CHECK FORALL (a:Entity, b:Entity, c:Entity, d:Entity, f:Entity,"
            " g:Entity, h:Entity, i:Entity) ALWAYS a.speed < 9",
            r"FORALL a, b, .* is about too much: \d+,\d+ combinations of nodes in one trace",
        ),
    ],
)
def test_what_holds_for_too_much_of_one_trace_is_refused(
    little_memory: Store, text: str, told: str
) -> None:
    with pytest.raises(QueryError, match=told) as refused:
        list(little_memory.check(text) if "CHECK" in text else little_memory.find(text))
    assert "a label, an edge between them" in (refused.value.hint or "")


def test_a_step_is_asked_for_no_more_nodes_than_the_others_leave(store: Store) -> None:
    many = "MATCH (a), (b), (c), (d), (f), (g), (h) WHERE a.speed < b.speed"

    found = store.find(f"MATCH (a:Ego) WHERE a.speed > 9999 THEN {many} RETURN a").rows()

    assert found == []


@pytest.mark.parametrize("where", [*COURSES, *PAIR_COURSES, *MARGINS])
def test_each_value_over_time_is_what_its_definition_says(
    asked: tuple[World, Store], where: str
) -> None:
    assert compare_condition(*asked, random.Random(4), where) > 0


def test_edges_over_time_are_what_their_definition_says(asked: tuple[World, Store]) -> None:
    found = [compare_edges(*asked, *one) for one in edge_questions(random.Random(7))]

    assert sum(found) > 50


def test_values_over_a_match_are_the_same_however_many_traces_are_read_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, store = worlds(8, tmp_path, traces=5)
    values = "MIN(dist(v, w)) OVER match AS least, LAST(v.kind) OVER match AS last"
    text = f"MATCH (v:Entity), (w:Entity) RETURN v, w, INTERVALS, {values}"
    at_once = store.find(text).rows()

    monkeypatch.setattr(_runs, "TOGETHER", 20)
    in_halves = store.find(text).rows()
    monkeypatch.setattr(_runs, "FIRST_WINDOW", 1)
    one_by_one = store.find(text).rows()

    assert len({row.trace for row in at_once}) == 5
    assert in_halves == one_by_one == at_once


def test_an_edge_without_a_number_has_an_unknown_one(tmp_path: Path) -> None:
    _, store = worlds(8, tmp_path)  # with gaps that are not known, and have no row
    pattern = "USING UNKNOWN false MATCH (v:Entity)-[r:follows]->(w:Entity)"
    every, known = (list(store.find(f"{pattern} {w}")) for w in ("", "WHERE known(r.gap)"))

    unknown = list(store.find(f"{pattern} WHERE r.gap IS NULL"))

    assert len(unknown) > 0
    assert len(unknown) == len(every) - len(known)


def test_checks_are_what_their_definition_says(asked: tuple[World, Store]) -> None:
    rng = random.Random(3)

    violated = [compare_check(*asked, random_check(rng)) for _ in range(12)]

    assert 0 < sum(violated) < 36


@pytest.mark.parametrize("seed", range(1200, 1500) if LONG else (1217, 1218))
def test_random_checks_of_other_worlds_are_what_their_definition_says(
    tmp_path: Path, seed: int
) -> None:
    """With ``CASE`` over time, and with margins within checks."""
    rng = random.Random(seed)
    asked = worlds(seed, tmp_path)
    checks = [random_check(rng) for _ in range(48 if LONG else 60)]
    if not LONG:
        checks = [one for one in checks if "CASE" in one or "robustness(" in one][:8]

    violated = compare_check(*asked, *checks)

    assert violated > 0


MARGINS_OF_OTHER_FRAMES = (
    "robustness(ALWAYS dist(ego, v) < 6) > -5",
    "robustness(EVENTUALLY[0s, 0.3s] dist(ego, v) > 6) < 5",
    "robustness(ONCE v.speed > 2) >= robustness(NEXT v.speed > 1)",
    "ALWAYS (robustness(dist(ego, v) < 8 UNTIL v.speed < 1) = 0.5 OR exists_now(v))",
    "EVENTUALLY robustness(NOT PREVIOUS dist(ego, v) < 3) <> 1",
    "NOT EVENTUALLY robustness(WEAKNEXT dist(ego, v) < 6) < -2",
    "ALWAYS CASE WHEN NOT EVENTUALLY v.speed > 2 THEN 0 ELSE dist(ego, v) END < 9",
    "ALWAYS CASE WHEN NEXT robustness(dist(ego, v) < 6) > 0 THEN 1 END = 1",
)
"""A monitor does not know these."""


WORDS = ("FORALL", "FORSOME")


@pytest.mark.parametrize(
    ("word", "formula"),
    [
        (word, formula)
        for number, formula in enumerate(MARGINS_OF_OTHER_FRAMES)
        for word in (WORDS if LONG else [WORDS[number % 2]])
    ],
)
def test_a_margin_over_time_within_a_check_knows_what_is_absent(
    asked: tuple[World, Store], word: str, formula: str
) -> None:
    compare_check(*asked, f"CHECK c: {word} (v:Entity) {formula}", online=False)


def test_all_and_some_range_over_entities_of_the_trace_and_signs_of_the_map(
    asked: tuple[World, Store],
) -> None:
    kinds = {one["kind"] for trace in asked[0].traces for one in trace.map_nodes.values()}
    kinds |= {one["kind"] for trace in asked[0].traces for one in trace.entities.values()}
    told = [f"v.kind {sign} '{kind}'" for sign in ("=", "<>") for kind in sorted(kinds)]

    violated = [
        compare_check(*asked, f"CHECK c: {word} (v:Entity) EVENTUALLY ({one})")
        for word in ("FORALL", "FORSOME")
        for one in told
    ]

    assert len(kinds & {"stop_sign", "traffic_light", "lane"}) >= 2
    assert 0 < sum(violated) < 3 * len(violated)


def test_the_matches_of_random_columns_are_the_earliest_of_all_tuples() -> None:
    rng = random.Random(5)
    found = 0
    for _ in range(300):
        found += compare_columns(rng)

    assert found > 200


def compare_columns(rng: random.Random) -> int:
    """Random columns of a random sequence, with every tuple of frames tried; how many matches there are."""
    frames = rng.randint(1, 9)
    times = np.cumsum([rng.choice((1, 1, 1, 5)) for _ in range(frames)])
    clock = Clock.of(times, np.arange(frames), 1, 2.5)
    line = BindingLine(clock)
    bindings = rng.randint(1, 3)
    steps = [random_places(rng, line, bindings) for _ in range(rng.randint(2, 4))]
    links = [random_leg(rng, line, bindings, places) for places in steps[1:]]
    policy = rng.choice(("all", "first", "longest"))

    told = matches_of(line, steps[0], links, policy)

    expected: list[list[int]] = []
    for binding in range(bindings):
        base = binding * line.stride
        own = [[int(p - base) for p in places if base <= p < base + frames] for places in steps]
        runs = itertools.groupby(own[0], key=lambda i: (int(clock.runs[i]), i - own[0].index(i)))
        for _, run in runs:
            tuples = [t for i in run for t in tuples_of([i], own, links, base, clock)]
            if not tuples:
                continue
            best = min(tuples)
            if policy == "longest":
                best = max(t for t in tuples if t[0] == best[0])
            expected.append([base + i for i in best])
            if policy == "first":
                break
    assert told.tolist() == expected
    return len(expected)


def random_places(rng: random.Random, line: BindingLine, bindings: int) -> Any:
    chosen = [
        b * line.stride + i
        for b in range(bindings)
        for i in range(line.frames)
        if rng.random() < 0.5
    ]
    return np.array(chosen, np.int64)


def random_leg(rng: random.Random, line: BindingLine, bindings: int, places: Any) -> Leg:
    kind = rng.choice(("then", "then", "then", "immediately", "until", "while"))
    if kind != "then":
        return Leg(kind, None, None, None, places)
    after = Length(rng.randint(0, 2), frames=rng.random() < 0.5) if rng.random() < 0.4 else None
    within = Length(rng.randint(2, 6), frames=after.frames if after else rng.random() < 0.5)
    absent = random_places(rng, line, bindings)[::3] if rng.random() < 0.3 else None
    return Leg(kind, after, within if rng.random() < 0.6 else None, absent, places)


def tuples_of(
    so_far: list[int], own: list[list[int]], legs: list[Leg], base: int, clock: Clock
) -> list[list[int]]:
    number = len(so_far)
    if number == len(own):
        return [so_far]
    i, leg = so_far[-1], legs[number - 1]
    between = [] if leg.absent is None else [int(p - base) for p in leg.absent]
    return [
        whole
        for j in own[number]
        if follows(leg, i, j, own[number - 1], clock) and not any(i < k < j for k in between)
        for whole in tuples_of([*so_far, j], own, legs, base, clock)
    ]


def follows(leg: Leg, i: int, j: int, before: list[int], clock: Clock) -> bool:
    if leg.kind == "while":
        return i == j
    together = j > i and clock.runs[i] == clock.runs[j]
    if leg.kind == "immediately":
        return bool(together) and j == i + 1
    if leg.kind == "until":
        return bool(together) and all(k in before for k in range(i, j))

    def apart(length: Length) -> int:
        return j - i if length.frames else int(clock.times[j] - clock.times[i])

    early = leg.after is not None and apart(leg.after) < leg.after.amount
    late = leg.within is not None and apart(leg.within) > leg.within.amount
    return j > i and not early and not late


@pytest.mark.parametrize("comparison", [">=", ">", "<", "<=", "="])
def test_a_run_lasts_from_its_first_frame_to_its_last(comparison: str) -> None:
    clock = Clock.of(np.array([0, 1, 2, 9, 10, 12]), np.arange(6), 1, 2.5)
    line = BindingLine(clock)
    places = np.array([0, 1, 2, 3, 4, 5])

    held = line.held(places, BoundHold(comparison, Length(2, frames=False), inclusive=False))

    runs = {(0, 1, 2): 2, (3, 4, 5): 3}
    fits = {">=": [2, 3], ">": [3], "<": [], "<=": [2], "=": [2]}[comparison]
    assert held.tolist() == [i for run, length in runs.items() if length in fits for i in run]


# Verdicts


def test_statuses_and_traps_are_those_of_the_engine_that_reads_frame_by_frame() -> None:
    rng = random.Random(11)
    certain = 0
    for _ in range(400):
        formula = random_formula(rng, 3)
        frames = rng.randint(1, 12)
        times = np.cumsum([rng.choice((1, 2, 7)) for _ in range(frames)])
        columns = {name: np.array([rng.random() < 0.6 for _ in range(frames)]) for name in "abc"}
        engine = OnlineFormula(formula)
        told: list[int] = []
        for i in range(frames):
            engine.step({name: bool(column[i]) for name, column in columns.items()}, int(times[i]))
            told.append(
                (3 if engine.verdict else 0) if engine.certain else 1 + bool(engine.verdict)
            )

        settled = Settled(formula, columns, times)

        status = settled.statuses()
        verdicts = prefix_verdicts(formula, columns, times)
        assert (status >= 2).tolist() == verdicts.tolist()
        assert status.tolist() == told
        assert settled.trap(0) == (told.index(0) if 0 in told else None)
        certain += 0 in told

    assert certain > 50
    assert STATUS[0] == "false"


def test_what_is_known_no_other_future_changes() -> None:
    tried = 0
    for seed in range(300):
        rng = random.Random(seed)
        formula, (word, times) = random_formula(rng, rng.randint(1, 4)), random_word(rng)
        columns = {name: np.array([letter[name] for letter in word]) for name in "abc"}
        told = known(formula, PropositionTable(columns, np.array(times, np.int64)))
        for i in range(len(word)):
            for at, value in ((int(told[0][i]), True), (int(told[1][i]), False)):
                if at == len(word):
                    continue
                more, later = random_word(rng)
                moved = times[at] - later[0] + rng.choice((1, 7, 60))
                longer = word[: at + 1] + more, times[: at + 1] + [t + moved for t in later]
                assert holds(formula, *longer, i) == value, (seed, i)
                tried += 1

    assert tried > 1000


def test_what_was_before_a_reset_is_seen_by_operators_of_the_past_that_look_ahead() -> None:
    formula = formula_of("ALWAYS (late IMPLIES ONCE NEXT early)")
    columns = {
        "early": np.array([0, 1, 0, 0, 0, 0], np.bool_),
        "late": np.array([1, 0, 0, 0, 1, 0], np.bool_),
    }
    assert Settled(formula, columns, np.arange(6)).violations(None) == []
    twice = And((formula, formula_of("ALWAYS NOT bad")))
    columns["bad"] = np.array([0, 0, 1, 0, 0, 0], np.bool_)

    (violation,) = Settled(twice, columns, np.arange(6)).violations(columns["bad"])
    assert violation == (2, 2, False)


def test_a_violation_lasts_to_its_reset_and_the_formula_is_asked_anew() -> None:
    bad = np.array([0, 1, 0, 0, 1, 1, 0, 1], np.bool_)
    fine = np.array([0, 0, 1, 0, 0, 0, 1, 0], np.bool_)
    settled = Settled(formula_of("ALWAYS NOT bad"), {"bad": bad}, np.arange(8))

    assert [v[:2] for v in settled.violations(fine)] == [(1, 2), (4, 6), (7, 7)]
    assert [v[:2] for v in settled.violations(None)] == [(1, 7)]


def test_what_only_the_end_refutes_is_violated_in_the_last_frame_or_forgiven() -> None:
    never = np.zeros(5, np.bool_)
    settled = Settled(formula_of("EVENTUALLY p"), {"p": never}, np.arange(5))

    (violation,) = settled.violations(None)

    assert violation == (4, 4, True)
    assert settled.violations(None, weak=True) == []


def test_what_depends_on_a_gap_is_not_known() -> None:
    times, gaps = np.array([0, 10, 90, 100]), np.array([0, 0, 1, 0], np.bool_)
    columns = {"p": np.array([[1, 1, 1, 1], [1, 1, 1, 0], [0, 1, 1, 1]], np.bool_)}

    least, most = within_bounds(formula_of("ALWAYS p"), columns, times, gaps, 3)
    some = within_bounds(formula_of("EVENTUALLY p"), columns, times, gaps, 3)
    bounded = within_bounds(formula_of("ALWAYS[0s, 10s] NOT p"), columns, times, gaps, 3)

    assert (least.tolist(), most.tolist()) == ([False] * 3, [True, False, False])
    assert some[0].all()
    assert some[1].all()
    assert not bounded[1].any()


def test_the_bounds_of_a_verdict_hold_whatever_happened_in_the_gap() -> None:
    rng = random.Random(17)
    for _ in range(300):
        formula = random_formula(rng, 3)
        frames = rng.randint(2, 7)
        times = np.cumsum([rng.choice((2, 4, 20)) for _ in range(frames)])
        gaps = np.concatenate(([False], np.diff(times) == 20))
        columns = {name: np.array([[rng.random() < 0.6 for _ in range(frames)]]) for name in "abc"}
        least, most = within_bounds(formula, columns, times, gaps, 1)
        at = np.flatnonzero(gaps)
        longer = np.insert(times, at, times[at - 1] + (times[at] - times[at - 1]) // 2)
        for _ in range(4):
            filled = {
                name: np.insert(column[0], at, [rng.random() < 0.5 for _ in at])
                for name, column in columns.items()
            }
            value = evaluate(formula, filled, longer)[0]

            assert least[0] <= value <= most[0]


# As people use them


def test_all_ways_to_ask_speak_of_the_same_matches(store: Store) -> None:
    text = f"USING UNKNOWN false {PAIR} THEN WITHIN 1s MATCH (e) WHERE e.speed > 0.5"

    matches = store.find(text)

    rows = matches.rows()
    assert rows
    assert matches.columns[:5] == ("frame_id", "trace", "seq", "time_ns", "t")
    assert matches.count() == len(list(matches.frames())) == len({row[0] for row in rows})
    assert len(list(matches.intervals())) == len(rows)
    assert list(matches.clips(1, 1))
    frame = next(matches.frames())
    assert {"e", "v"} <= set(matches.bindings(frame)[0])
    assert len(matches.numpy()["frame_id"]) == len(rows)


def test_limits_orders_and_samples_hold_for_sequences(store: Store) -> None:
    text = (
        f"USING UNKNOWN false {PAIR} AS s THEN MATCH (e) WHERE e.speed > 0.5 RETURN v, t(s) AS at"
    )

    rows = store.find(f"{text} ORDER BY at DESC, v LIMIT 3").rows()

    every = store.find(text).rows()
    assert rows == sorted(every, key=lambda row: (-row[1], row[0]))[:3]
    entities = store.find(f"{text}, trace.name").rows()
    sampled = store.find(f"{text} SAMPLE 1 PER v").rows()
    assert len(sampled) == len({(row[0], row[2]) for row in entities})


def test_a_scenario_is_the_sequence_that_it_stands_for(store: Store) -> None:
    steps = f"{PAIR} THEN WITHIN {{}} MATCH (e) WHERE e.speed > 0.5"
    define = f"DEFINE SCENARIO meet(within = 4s) AS {steps.format('$within')};"

    assert store.find(f"{define} MATCH meet()").rows() == store.find(steps.format("4s")).rows()
    given = store.find(f"{define} MATCH meet(within = $w)", w=0.2).rows()
    assert given == store.find(steps.format("200ms")).rows()


def test_patterns_of_the_library_are_steps_by_their_names(store: Store) -> None:
    text = pattern_named("hard_braking").written(decel=0.1, hold=0)

    rows = store.find("MATCH hard_braking(decel = 0.1, hold = 0s) THEN MATCH (e)").rows()

    assert rows == store.find(f"{text} THEN MATCH (e)").rows()
    with pytest.raises(
        QueryError, match="unknown parameter or variable of hard_braking 'hardness'"
    ) as refused:
        store.find("MATCH hard_braking(hardness = 1)")
    assert refused.value.span is not None


def test_edges_with_names_are_told_with_what_they_are(store: Store) -> None:
    text = (
        "USING UNKNOWN false MATCH (e:Ego)-[r:isIn]->(:Lane) THEN MATCH (e)-[d:near|visible]->(v)"
    )

    rows = store.find(f"{text} RETURN type(d) AS d, r.overlap AS o, v").rows()
    alone = store.find(
        "MATCH (e:Ego)-[r:isIn]->(:Lane) WHERE ONCE e.speed > 0.5 RETURN r.overlap AS o"
    )

    assert rows
    assert {row[0] for row in rows} <= {"near", "visible"}
    assert any(row[0] is not None for row in alone.rows())
    assert list(store.find(f"{text} RETURN SUBGRAPHS").subgraphs())


def test_explain_tells_steps_and_atoms(store: Store) -> None:
    text = store.explain(
        f"{PAIR} THEN WITHIN 1s MATCH (e) WHERE EVENTUALLY e.speed > 0.5 FOR >= 1s"
    )

    assert "step 1(e, v)" in text
    assert "then within 1s" in text
    assert "atom a1(e) = (e.speed > 0.5)" in text
    assert "for >= 1s" in text


@pytest.mark.parametrize(
    ("formula", "first"),
    [
        ("ALWAYS frame.seq < 60", "min(seq) FILTER (seq >= 60)"),
        ("ALWAYS (frame.t < 1 OR trace.name = 'elsewhere')", "min(seq) FILTER (t >= 1)"),
        ("EVENTUALLY frame.t >= 0", "NULL"),
        ("NOT TRUE", "min(seq)"),
    ],
)
def test_a_check_may_speak_of_frames_and_traces_alone(
    store: Store, formula: str, first: str
) -> None:
    wanted = dict(store.sql(f"SELECT trace, {first} FROM frames GROUP BY trace").values)

    violations = {v.trace: v.first_violation for v in store.check(f"CHECK {formula}")}

    assert {trace: v and v.start_seq for trace, v in violations.items()} == wanted


def test_texts_that_differ_in_a_number_are_different_questions(store: Store) -> None:
    check = "CHECK FORALL (v:Entity) NOT (EVENTUALLY v.ident = 'a#1' OR EVENTUALLY v.ident = 'a#2')"

    explained = store.check(check).explain()

    assert explained.count("\natom ") == 2


def test_a_check_tells_who_violates_it_and_when(store: Store) -> None:
    check = "FORALL (v:Entity) ALWAYS NOT v.speed > 0.5 RESET WHEN NOT v.speed > 0.5"
    text = f"USING UNKNOWN false CHECK slow: {check}"

    verdicts = list(store.check(text, status=True))

    assert {verdict.check for verdict in verdicts} == {"slow"}
    violated = [verdict for verdict in verdicts if verdict.violated]
    assert violated
    for verdict in violated:
        first = verdict.first_violation
        assert first is not None
        assert first.start == min(i.start for w in verdict.witnesses for i in w.violations)
        assert verdict.statuses[-1] == "false"
        at = verdict.statuses.index("false")
        assert verdict.statuses[at - 1] == "presumably_true" or at == 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            "MATCH (e:Ego) WHERE EXISTS {(e)-[:near]->(v) WHERE EVENTUALLY v.speed > 1}",
            "in braces",
        ),
        ("MATCH (e:Ego) WHERE e.speed > 10frames", "a number of frames is compared"),
        ("MATCH (e:Ego) THEN NOT MATCH (e) WHERE e.speed > 1", "needs a duration"),
        ("NOT MATCH (e:Ego) THEN MATCH (e)", "a sequence cannot begin with NOT MATCH"),
        ("MATCH (e:Ego) THEN AFTER 4s WITHIN 2s MATCH (e)", "the bound is before its start"),
        ("MATCH (e:Ego) WHERE EVENTUALLY[2s, 1s] e.speed > 1", "the bound is before its start"),
        ("MATCH (e:Ego) RETURN t(e)", "takes the name of a step"),
        ("MATCH (e:Ego) WHERE run_length(NEXT e.speed > 1) > 2frames", "looks ahead"),
        ("MATCH nothing()", "unknown scenario"),
        ("DEFINE SCENARIO f(w) AS MATCH (e:Ego) FOR >= $w; MATCH f()", "needs a value of w"),
        ("DEFINE SCENARIO f() AS MATCH f(); MATCH f()", "defined by itself"),
        ("CHECK ALWAYS ego.speed > 1", "a CHECK has a verdict"),
        ("USING END weak MATCH (e:Ego)", "USING END is allowed only in a CHECK"),
    ],
)
def test_what_has_no_meaning_is_refused_with_its_place(
    store: Store, text: str, complaint: str
) -> None:
    with pytest.raises(QueryError, match=complaint) as refused:
        store.find(text).rows()

    assert refused.value.span is not None


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("MATCH (e:Ego)", "a MATCH has matches"),
        ("DEFINE PREDICATE p(x) AS x.speed > 1", "the text contains no CHECK"),
        (
            "CHECK a: ALWAYS ego.speed > 1; CHECK a: ALWAYS ego.speed > 2",
            "two checks have the name",
        ),
        ("CHECK FORALL (ego:Car, v:Car) ALWAYS v.sped > 1", "unknown attribute"),
        ("USING MATCHES first CHECK ALWAYS ego.speed > 1", "allowed only in sequences"),
    ],
)
def test_what_is_no_check_is_refused(store: Store, text: str, complaint: str) -> None:
    with pytest.raises(QueryError, match=complaint):
        store.check(text)


def test_why_not_speaks_of_each_step_of_a_sequence(store: Store) -> None:
    frame = next(store.find("MATCH (e:Ego)").frames())
    step = "MATCH (e) WHERE e.speed > 1000"

    answer = store.why_not(frame, f"MATCH (e:Ego) FOR >= 1s THEN WITHIN 4s {step}").as_dict()

    assert [one["matches"] for one in answer["steps"]] == [True, False]
    alone = store.why_not(frame, "MATCH (e:Ego)").as_dict()
    egos = sum(one.trace == frame.trace for one in store.find("MATCH (e:Ego)").frames())
    assert answer["steps"][0] == {"step": "MATCH (e:Ego) FOR >= 1s", "frames": egos} | alone
    assert answer["steps"][1]["frames"] == 0
    assert answer["steps"][1]["failed"] == "e.speed > 1000"
    assert answer["steps"][1]["step"] == step


def test_the_verb_ends_with_4_only_if_something_is_violated(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(store.file.path)

    broken = run_verb(
        ["check", path, "-e", "CHECK c: ALWAYS ego.speed > 100", "--require", "--json"]
    )
    rows = json.loads(capsys.readouterr().out)
    kept = run_verb(["check", path, "-e", "CHECK c: ALWAYS NOT ego.speed > 100", "--require"])

    assert (broken, kept) == (4, 0)
    assert {row["verdict"] for row in rows} == {"false"}
    assert all(
        row["first_violation"]["start_seq"] == row["violations"][0]["start_seq"] for row in rows
    )


@pytest.mark.parametrize(
    ("premise", "applied"), [("v.speed > 10", 8), ("v.speed > 7 OR w.speed > 7", None)]
)
def test_a_premise_refuses_no_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, premise: str, applied: int | None
) -> None:
    """Another car than the ego is fast in frames 5 to 12."""
    with Recorder(tmp_path / "drive.mcap") as recorder:
        for frame in range(20):
            speeds = (8, 12 if 5 <= frame <= 12 else 8, 8)
            cars = [recorded(n, 30.0 * n, v=(v, 0)) for n, v in enumerate(speeds, 1)]
            recorder.ground_truth(frame / 10, cars, host=1)
    ingest(tmp_path / "drive.sgstore", [tmp_path / "drive.mcap"])
    monkeypatch.setattr(_offline, "MOST_BINDINGS", 4)

    (verdict,) = Store(tmp_path / "drive.sgstore").check(
        f"CHECK FORALL (v:Car, w:Car) ALWAYS ({premise} IMPLIES dist(v, w) > 1)"
    )

    assert (verdict.verdict, verdict.applied_frames, verdict.bindings) == ("true", applied, 6)
