"""Expressions of steps: one of several, and again; over columns, frame by frame, and by definition."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import Bridge, vehicle
from oracle_over_time import expressions
from oracle_steps import try_streams
from thorough import LONG

import sgstore
from sgstore import Config, Monitor
from sgstore.ingest import ingest
from sgstore.temporal import opened

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

SPEEDS = (0, 6, 0, 2, 0, 6, 6, 0, 0, 9)
"""Of the ego, a frame each."""
FAST = "MATCH (e:Ego) WHERE e.speed > 5"
SLOW = "MATCH (e:Ego) WHERE e.speed < 1"
SOME = "MATCH (e:Ego) WHERE e.speed > 1 AND e.speed < 5"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("steps")
    with Bridge(folder / "a.mcap") as bridge:
        bridge.actors({1: ("vehicle.tesla.model3", "hero")})
        for i, speed in enumerate(SPEEDS):
            bridge.objects(i / 10, [vehicle(1, float(i), v=(float(speed), 0, 0))])
    return folder / "a.mcap"


@pytest.fixture(scope="module")
def store(place: Path) -> Store:
    ingest(place.parent / "s.sgstore", [place])
    return sgstore.open(place.parent / "s.sgstore")


def watched(place: Path, text: str) -> list[Any]:
    """The events of a monitor, frame by frame."""
    events: list[Any] = []
    with opened(str(place), Config()) as source:
        Monitor(text, source.road_map, on_event=events.append).run(source.frames)
    return events


CASES: list[tuple[str, list[tuple[int, int]]]] = [
    (f"{FAST} THEN ({SLOW} | {SOME})", [(1, 2), (5, 7)]),
    (f"{FAST} THEN ({SOME} | {FAST} THEN {SLOW})", [(1, 3), (5, 7)]),
    (f"{SLOW} THEN IMMEDIATELY ({FAST} | {SOME})", [(0, 1), (2, 3), (4, 5), (8, 9)]),
    (f"({FAST} THEN {SLOW}){{2}}", [(1, 7)]),
    (f"({FAST} THEN {SLOW}){{2,3}}", [(1, 7)]),
    (f"({SLOW} THEN {FAST}){{2,3}}", [(0, 5), (2, 9), (4, 9)]),
    (f"({SLOW} THEN IMMEDIATELY {FAST}){{2}}", [(0, 5), (4, 9)]),
    (f"({SOME} | {FAST}) THEN {SLOW}", [(1, 2), (3, 4), (5, 7)]),
    (f"({FAST}){{2}}", [(1, 5), (5, 6)]),
    (f"{FAST} THEN ({SOME} THEN {FAST} | {SLOW} THEN {SLOW} THEN {SLOW})", [(1, 7)]),
]


@pytest.mark.parametrize(("text", "expected"), CASES)
def test_expressions_stand_for_their_sequences(
    store: Store, place: Path, text: str, expected: list[tuple[int, int]]
) -> None:
    assert [(i.start_seq, i.end_seq) for i in store.find(text).intervals()] == expected
    events = watched(place, text)
    assert sorted((e.start.seq, e.end.seq) for e in events) == expected


def test_the_longest_match_goes_on(store: Store) -> None:
    text = f"USING MATCHES longest ({SLOW} THEN IMMEDIATELY {FAST}){{1,3}}"

    spans = [(i.start_seq, i.end_seq) for i in store.find(text).intervals()]

    assert spans == [(0, 9), (4, 9), (8, 9)]


def test_a_step_that_another_was_taken_for_has_no_time(store: Store) -> None:
    text = f"{FAST} AS fast THEN ({SLOW} AS slow | {SOME} AS some)"
    rows = store.find(
        f"{text} RETURN t(fast), t(slow), t(some), MAX(e.speed) OVER fast..slow AS most,"
        " LAST(e.speed) OVER some AS last"
    )

    assert [tuple(row) for row in rows] == [
        (pytest.approx(0.1), pytest.approx(0.2), None, 6, None),
        (pytest.approx(0.5), pytest.approx(0.7), None, 6, None),
    ]


def test_of_two_ways_with_the_same_frames_the_one_that_is_written_first_counts(
    store: Store, place: Path
) -> None:
    # That the ego goes on being slow is known a frame later than that it is slow.
    lasting = f"{SLOW} FOR >= 0.2s INCLUSIVE AS lasting | {SLOW} AS short"
    text = f"{FAST} THEN ({lasting}) RETURN t(lasting), t(short)"
    expected = [(None, pytest.approx(0.2)), (pytest.approx(0.7), None)]

    assert [tuple(row) for row in store.find(text)] == expected
    events = watched(place, text)
    assert [tuple(e.values.values()) for e in events] == expected


def test_a_way_that_ends_with_what_is_absent_counts_if_it_is_written_first(
    store: Store, place: Path
) -> None:
    absent = f"{FAST} AS alone THEN WITHIN 0.3s NOT {SOME}"
    for ways, expected in (
        (f"{absent} | {FAST}", [None, 0.5, 0.5, 0.9]),
        (f"{FAST} | {absent}", [None] * 4),
    ):
        text = f"{SLOW} THEN ({ways}) RETURN t(alone)"
        assert [row[0] for row in store.find(text)] == pytest.approx(expected)
        events = watched(place, text)
        assert [e.values["t(alone)"] for e in events] == pytest.approx(expected)


def test_a_scenario_is_a_step_of_an_expression(store: Store) -> None:
    text = (
        f"DEFINE SCENARIO stops(top) AS MATCH (e:Ego) WHERE e.speed > $top THEN {SLOW};"
        f" DEFINE SCENARIO either() AS ({SOME} | {FAST});"
        f" (MATCH stops(top = 5)){{2}} THEN MATCH either()"
    )

    assert [(i.start_seq, i.end_seq) for i in store.find(text).intervals()] == [(1, 9)]


def test_the_plan_tells_the_sequences(store: Store) -> None:
    text = store.find(f"{FAST} THEN ({SLOW} | {SOME}){{1,2}}").explain()

    assert "sequence step 1 then step 2\n" in text
    assert "sequence step 1 then step 3 then step 2\n" in text


@pytest.mark.parametrize("first", [0, 100])
def test_random_expressions_have_the_matches_of_their_definition(first: int) -> None:
    assert try_streams(first, 2_000 if LONG else 40) > 5


def test_random_expressions_of_a_store_do(tmp_path: Path) -> None:
    assert expressions(range(20 if LONG else 1), 20 if LONG else 2, tmp_path) >= 0
