"""Clocks that jump back, and frames of equal time: nothing that looks along time bridges a jump."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import recordings as osi

from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.model.world import JUMP_NS
from sgstore.query import Store
from sgstore.temporal import Monitor
from sgstore.testsets.coverage import ChosenFrames, happenings, sequences_in

if TYPE_CHECKING:
    from pathlib import Path

PASSES = [[0.0, 0.1, 0.2, 0.3, 0.4, 0.5], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]]
"""Times of a drive that is recorded twice in a row, with one stamp a frame."""


def recorded(path: Path, passes: list[list[float]]) -> Path:
    """The ego drives 10 m/s from 0, in each pass anew; log times go on."""
    logged = 100.0
    with osi.Recorder(path) as recorder:
        for times in passes:
            for place, time in enumerate(times):
                things = [osi.car(7, float(place)), osi.car(3, 40.0 - place)]
                recorder.ground_truth(logged, things, stamp=time, host=7)
                logged += 0.1
    return path


def stored(path: Path, passes: list[list[float]]) -> Store:
    ingest(path / "s.sgstore", [recorded(path / "a.mcap", passes)])
    return Store(path / "s.sgstore")


@pytest.fixture(scope="module")
def looped(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return stored(tmp_path_factory.mktemp("looped"), PASSES)


def intervals(store: Store, text: str) -> list[tuple[int, int]]:
    return [(one.start_seq, one.end_seq) for one in store.find(text).intervals()]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("MATCH (e:Ego) WHERE e.x > 3 THEN MATCH (e) WHERE e.x < 1", []),
        ("MATCH (e:Ego) WHERE e.x > 3 THEN WITHIN 5s MATCH (e) WHERE e.x < 1", []),
        ("MATCH (e:Ego) WHERE e.x > 3 THEN AFTER 1s MATCH (e) WHERE e.x < 1", []),
        ("MATCH (e:Ego) WHERE e.x > 3 THEN IMMEDIATELY MATCH (e) WHERE e.x < 1", []),
        ("MATCH (e:Ego) WHERE e.x > 3 UNTIL MATCH (e) WHERE e.x < 1", []),
        ("MATCH (e:Ego) WHERE e.x < 1 THEN MATCH (e) WHERE e.x > 3", [(0, 4), (6, 10)]),
        ("MATCH (e:Ego) WHERE e.x > 0.5 FOR >= 0.4s AS a WHILE MATCH (e)", [(1, 1), (7, 7)]),
        ("MATCH (e:Ego) WHERE e.x > 0.5 FOR >= 0.5s AS a WHILE MATCH (e)", []),
    ],
)
def test_no_sequence_and_no_run_leads_across_a_jump(
    looped: Store, text: str, found: list[tuple[int, int]]
) -> None:
    for gaps in ("", "USING GAPS bridge "):
        assert intervals(looped, f"{gaps}{text} RETURN INTERVALS") == found, gaps


def test_intervals_of_a_pattern_end_where_the_clock_jumps(looped: Store) -> None:
    assert intervals(looped, "MATCH (e:Ego) WHERE e.x >= 0 RETURN INTERVALS") == [(0, 5), (6, 11)]


@pytest.mark.parametrize(
    ("value", "behind"),
    [
        ("prev(e.x)", [None, 0.0]),
        ("delta(e.x, 100ms)", [None, 1.0]),
        ("max_over(e.x, 300ms)", [0.0, 1.0]),
        ("run_length(e.x >= 0)", [1, 2]),
    ],
)
def test_no_value_over_time_bridges_a_jump(
    looped: Store, value: str, behind: list[float | None]
) -> None:
    for gaps in ("", "USING GAPS bridge "):
        text = f"{gaps}MATCH (e:Ego) RETURN frame.seq, {value} AS v"
        rows = dict(tuple(row) for row in looped.find(text))
        assert [rows[0], rows[1]] == pytest.approx(behind)
        assert [rows[6], rows[7]] == pytest.approx(behind)


def test_no_speed_is_derived_across_a_jump_and_one_entity_goes_on(looped: Store) -> None:
    rows = looped.sql("SELECT speed, node_id FROM nodes WHERE is_ego ORDER BY frame_id").values
    assert [speed for speed, _ in rows] == pytest.approx([10.0] * 12)
    assert len({node for _, node in rows}) == 1


def test_a_jump_is_counted(tmp_path: Path) -> None:
    (outcome,) = ingest(tmp_path / "s.sgstore", [recorded(tmp_path / "a.mcap", PASSES)])
    assert (outcome.clock_jumps, outcome.gaps) == (1, 0)


def test_frames_of_equal_time_follow_one_another(tmp_path: Path) -> None:
    store = stored(tmp_path, [[0.0, 0.1, 0.1, 0.2, 0.3]])

    assert intervals(store, "MATCH (e:Ego) WHERE e.x >= 0 RETURN INTERVALS") == [(0, 4)]
    rows = [tuple(row) for row in store.find("MATCH (e:Ego) RETURN frame.seq, prev(e.x) AS p")]
    assert rows == [(0, None), (1, 0.0), (2, 1.0), (3, 2.0), (4, 3.0)]
    speeds = [row[0] for row in store.sql("SELECT speed FROM nodes WHERE is_ego ORDER BY frame_id")]
    assert speeds == pytest.approx([10.0] * 5)


def test_a_monitor_ends_what_it_follows_where_the_clock_jumps() -> None:
    monitor = Monitor(
        "MATCH (e:Ego) WHERE e.x > 3 THEN MATCH (e) WHERE e.x < 1 AS late;"
        " MATCH (e:Ego) WHERE e.x < 1 THEN MATCH (e) WHERE e.x > 3 AS early;"
        " CHECK short: ALWAYS NOT run_length(ego.x >= 0) > 0.55s;"
        " CHECK steady: ALWAYS NOT delta(ego.x, 100ms) < 0"
    )
    found: list[Any] = []
    for times in PASSES:
        for place, time in enumerate(times):
            frame = Frame(round(time * 1e9), ego="7")
            frame.add("7", "car", float(place), 0.0, vx=10.0, vy=0.0)
            found += monitor.step(frame)
    verdicts = monitor.finish()

    assert [(one.start.seq, one.end.seq, one.end.t) for one in found if one.kind == "found"] == [
        (0, 4, 0.4),
        (6, 10, 0.4),
    ]
    assert {one.check: one.verdict for one in verdicts} == {"short": "true", "steady": "true"}


def test_sequences_of_manoeuvres_do_not_lead_across_a_jump(looped: Store) -> None:
    told = {
        "far": "MATCH (e:Ego) WHERE e.x > 4.5 RETURN e, INTERVALS",
        "near": "MATCH (e:Ego) WHERE e.x < 0.5 RETURN e, INTERVALS",
    }
    happened = happenings(ChosenFrames("all", looped), told)
    assert len(happened.names) == 2
    within = JUMP_NS // 2
    found = sequences_in(happened.code, happened.time_ns, 2, 2, within)
    names = {(happened.names[n // 2][:4], happened.names[n % 2][:4]) for n in found}
    assert names == {("near", "far(")}
