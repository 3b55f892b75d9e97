"""Monitors: what is told frame by frame is what a store answers of the whole recording."""

from __future__ import annotations

import gc
import random
import re
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from oracle_monitor import try_states
from oracle_over_time import edge_questions
from oracle_watched import CHECKS, MARGINS, SEQUENCES, VALUES, Drive, library_checks
from thorough import LONG

from sgstore.apps.demo import RECORDING
from sgstore.errors import QueryError
from sgstore.graphs.online import Frame
from sgstore.model.graph import SceneGraph
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.temporal import MonitorEvent

pytestmark = pytest.mark.seconds(25)


def thinned(recording: Path, folder: Path, every: int) -> Drive:
    """A recording with one of so many of its frames; ``make oracle`` compares all of them."""
    path = folder / recording.name
    with recording.open("rb") as source, path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        numbers: dict[str, int] = {}
        count = 0
        for schema, channel, message in make_reader(source).iter_messages(
            topics=["ground_truth", "ground_truth_map"]
        ):
            count += channel.topic == "ground_truth"
            if channel.topic == "ground_truth" and count % every != 1:
                continue
            if schema and channel.topic not in numbers:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(
                numbers[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return Drive.of(path, folder)


@pytest.fixture(scope="module")
def town(
    tmp_path_factory: pytest.TempPathFactory, kept_open: Callable[[Path | str], None]
) -> Drive:
    """The bundled recording, of two frames in a second."""
    drive = thinned(RECORDING, tmp_path_factory.mktemp("town"), 5)
    kept_open(drive.store.file.path)
    return drive


@pytest.mark.parametrize("text", [CHECKS, library_checks(4)], ids=["made", "library"])
def test_a_recording_watched_has_the_verdicts_that_it_has_in_a_store(
    text: str, town: Drive
) -> None:
    assert town.compare_checks(text) >= 2


def test_a_recording_watched_meets_checks_by_as_much_as_in_a_store(town: Drive) -> None:
    assert town.compare_margins(MARGINS) >= 6


def test_values_over_matches_are_those_that_they_have_in_a_store(town: Drive) -> None:
    assert town.compare_values(VALUES) > 20


def test_what_is_kept_of_an_open_match_does_not_grow_with_time() -> None:
    monitor = Monitor(
        "MATCH (v:Vehicle) WHERE v.speed > 5 AS a THEN MATCH (v) WHERE v.speed < 1 AS b"
        " RETURN MIN(v.speed) OVER match AS low, AVG(v.speed) OVER a AS mean, ARGMAX(v.speed) OVER match AS at"
    )
    speeds = [*(6 + i % 7 / 8 for i in range(100)), *([2.0] * 100), 0.5]
    found: list[MonitorEvent] = []
    for i, speed in enumerate(speeds):
        found += monitor.step(moving(i / 10, speed))
        ((_, pattern, _),) = monitor._follows
        courses = pattern._values._courses.values()
        kept = [len(folds) for one in courses for _, folds in one._known.held.values()]
        assert max(kept) <= 8

    (event,) = found
    assert event.values["low"] == 0.5
    assert event.values["mean"] == pytest.approx(sum(speeds[:100]) / 100)
    assert event.values["at"] == 0.6


def test_by_how_much_a_check_is_met_so_far_is_known_at_any_time() -> None:
    monitor = Monitor(
        "CHECK slow: FORALL (v:Vehicle) ALWAYS v.speed < 5 ROBUSTNESS;"
        " CHECK fast: EVENTUALLY ego.speed > 5 ROBUSTNESS; CHECK plain: ALWAYS ego.speed < 5"
    )
    assert monitor.robustness == {}
    told = []
    for t, speed in enumerate([1, 3, 2, 6]):
        monitor.step(moving(t / 10, speed))
        told.append({name: (one.value, *one.names) for name, one in monitor.robustness.items()})

    assert [one["slow"] for one in told] == [(4, "v"), (2, "v"), (2, "v"), (-1, "v")]
    assert [one["fast"] for one in told] == [(-5,), (-5,), (-5,), (-5,)]
    assert "plain" not in told[0]


def moving(t: float, speed: float) -> Frame:
    frame = car(t, 0)
    frame.add("v", "car", 9.0, 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=speed, vy=0.0)
    return frame


def test_what_sgsm_would_report_is_told_in_the_frames_with_which_the_trace_may_not_end(
    town: Drive,
) -> None:
    assert town.compare_checks(CHECKS, sgsm_compat=True) > 5
    _, events, monitor = town.watched(CHECKS, sgsm_compat=True)

    assert any(event.kind == "kept again" for event in events)
    assert monitor.status["due"] == "presumably_false"


@pytest.mark.data
@pytest.mark.parametrize("name", ["esmini/cut-in.mcap"])
def test_recordings_of_others_watched_answer_as_their_stores_do(
    name: str, data: Path, tmp_path: Path
) -> None:
    drive = thinned(data / "traces" / name, tmp_path, 5)

    assert drive.compare_checks(CHECKS) > 0
    assert sum(drive.compare_matches(SEQUENCES)) > 0


def test_sequences_are_found_when_they_complete_as_a_store_finds_them(town: Drive) -> None:
    often = town.compare_matches(SEQUENCES)

    assert sum(often) > 20
    assert all("UNTIL" in text for text, many in zip(SEQUENCES, often, strict=True) if not many)


@pytest.mark.parametrize("share", range(16) if LONG else [0])
def test_edges_watched_go_over_time_as_in_a_store(share: int, town: Drive) -> None:
    # Every attribute and every operator, each with some of the others.
    made: dict[str, list[str]] = {}
    for number, (pattern, _, asked) in enumerate(edge_questions(random.Random(4))):
        conditions = [one.removeprefix("ONCE[0frames, 0frames] ") for one in asked]
        conditions = [one for one in conditions if one.startswith("(")]
        # Online, the lane in a junction may be unknown.
        conditions = [one for one in conditions if "r.primary" not in one and "r.is_own" not in one]
        made.setdefault(pattern, []).extend(conditions[(number + share) % 16 :: 16])
    changes = ["delta(r.offset, 1s) > 0.5", "prev(r.heading_error) < r.heading_error"]
    made["(v:Vehicle)-[r:isIn]->(e:Lane)"] = [*changes, "ALWAYS[0s, 1s] r.overlap > 0.5"]

    assert town.compare_edges(list(made.items())) > 100


def test_what_sgsm_reports_is_violated_as_long_as_the_trace_may_not_end() -> None:
    text = "CHECK slow: ALWAYS (ego.speed > 1 IMPLIES EVENTUALLY[0s, 3s] ego.speed < 1)"
    monitor = Monitor(text, sgsm_compat=True)
    told = [monitor.step(car(t / 10, v)) for t, v in enumerate([0, 2, 2, 0, 0, 2])]
    spans = [(e.kind, e.start.seq, e.end.seq, e.told.seq) for some in told for e in some]

    assert spans == [("violated", 1, 1, 1), ("kept again", 1, 2, 3), ("violated", 5, 5, 5)]
    assert monitor.status == {"slow": "presumably_false"}
    (verdict,) = monitor.finish()
    assert verdict.verdict == "false"
    assert [(i.start_seq, i.end_seq) for i in verdict.violations] == [(1, 2), (5, 5)]


def test_random_formulas_are_violated_when_columns_say_so() -> None:
    tried, violations = try_states(0, 800)

    assert tried > 400
    assert violations > 200


def car(t: float, speed: float, *others: tuple[str, float]) -> Frame:
    frame = Frame(time_ns=round(t * 1e9), ego="ego")
    frame.add("ego", "car", 0.0, 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=speed, vy=0.0)
    for ident, x in others:
        frame.add(ident, "car", x, 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=0.0, vy=0.0)
    return frame


def test_a_violation_is_told_in_the_frame_that_makes_it_certain() -> None:
    monitor = Monitor(
        "CHECK brake: ALWAYS (ego.speed > 10 IMPLIES EVENTUALLY[0s, 1s] ego.speed < 5)"
    )
    events = [monitor.step(car(t / 10, 12 if t >= 5 else 0)) for t in range(30)]

    (only,) = [event for some in events for event in some]
    assert (only.kind, only.told.seq, only.start.seq) == ("violated", 16, 16)
    assert monitor.status == {"brake": "false"}


def test_what_is_reset_is_kept_again_and_can_be_violated_again() -> None:
    monitor = Monitor("CHECK slow: ALWAYS ego.speed < 5 RESET WHEN ego.speed < 3")
    speeds = [0, 6, 6, 2, 0, 6, 6]
    kinds = [[e.kind for e in monitor.step(car(t / 10, v))] for t, v in enumerate(speeds)]

    assert kinds == [[], ["violated"], [], ["kept again"], [], ["violated"], []]
    (verdict,) = monitor.finish()
    assert [(i.start_seq, i.end_seq) for i in verdict.violations] == [(1, 3), (5, 6)]


def test_who_comes_later_is_held_to_what_strangers_owe() -> None:
    monitor = Monitor("CHECK seen: FORALL (v:Vehicle) ALWAYS exists_now(v)")
    early = [monitor.step(car(t / 10, 0)) for t in range(3)]
    late = monitor.step(car(0.3, 0, ("late", 30.0)))

    assert early == [(), (), ()]
    assert [(e.kind, e.start.seq, e.told.seq) for e in late] == [("violated", 0, 3)]


def test_statuses_say_what_the_verdict_would_be_now() -> None:
    monitor = Monitor("CHECK moves: EVENTUALLY ego.speed > 1; CHECK slow: ALWAYS ego.speed < 5")
    statuses = []
    for t, speed in enumerate([0, 2, 6]):
        monitor.step(car(t / 10, speed))
        statuses.append(monitor.status)

    assert statuses == [
        {"moves": "presumably_false", "slow": "presumably_true"},
        {"moves": "true", "slow": "presumably_true"},
        {"moves": "true", "slow": "false"},
    ]


def test_what_the_graphs_cannot_have_is_unknown() -> None:
    monitor = Monitor("CHECK lane: ALWAYS NOT off_road(ego); CHECK slow: ALWAYS ego.speed < 5")
    monitor.step(car(0.0, 0))

    assert {v.check: v.verdict for v in monitor.finish()} == {"slow": "true", "lane": "unknown"}


def test_memory_does_not_grow_with_time() -> None:
    text = """CHECK near: FORALL (v:Vehicle)
      ALWAYS (dist(ego, v) < 6 IMPLIES EVENTUALLY[0s, 1s] dist(ego, v) > 6) RESET WHEN dist(ego, v) > 6;
    MATCH (v:Vehicle) WHERE dist(ego, v) < 6 THEN WITHIN 1s MATCH (v) WHERE dist(ego, v) > 6"""
    monitor = Monitor(text)
    (_, watch, *_), *_ = monitor._watches
    (_, follow, *_), *_ = monitor._follows
    sizes = []
    for t in range(400):
        monitor.step(car(t / 10, 0, (f"v{t // 20}", 4.0 + t % 20)))
        sizes.append((len(watch._known.held), sum(len(h) for h in follow._held)))

    assert max(sizes[200:]) <= max(sizes[:200])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("CHECK a: ALWAYS ego.speed < 5 RESET WHEN NEXT ego.speed < 3", "looks ahead"),
        ("USING GAPS unknown CHECK a: ALWAYS ego.speed < 5", "needs a complete recording"),
        ("CHECK a: ALWAYS ego.sped < 5", "sped"),
        ("DEFINE PREDICATE slow(x) AS x.speed < 5", "the text contains no CHECK"),
    ],
)
def test_what_cannot_be_watched_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(QueryError, match=reason):
        Monitor(text)


def test_a_parameter_that_no_statement_has_is_refused() -> None:
    with pytest.raises(QueryError, match="no parameter 'least'"):
        Monitor("CHECK a: ALWAYS ego.speed < $most", parameters={"most": 5, "least": 1})


def test_the_same_question_of_two_checks_is_asked_once() -> None:
    monitor = Monitor(
        "CHECK a: ALWAYS NOT EXISTS {(ego)-[:near]->(:Car)};"
        " CHECK b: EVENTUALLY NOT EXISTS {(ego)-[:near]->(:Car)}"
    )

    # Whether there is such an edge, and whether that is unknown.
    assert len(monitor._questions[0]._all) == 2


def programs() -> list[str]:
    page = (Path(__file__).parents[2] / "docs" / "online.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_the_first_program_of_the_page_runs_as_it_stands() -> None:
    names: dict[str, Any] = {}
    exec(compile(programs()[0], "online.md", "exec"), names)

    idents = {about["ident"] for about in names["graph"].nodes.values()}
    assert idents == {"hero", "p7", "tl3", "house"}
    assert {relation for _, relation, *_ in names["graph"].edges} >= {"toRightOf"}


def test_the_program_of_the_page_runs() -> None:
    (program,) = [block for block in programs() if "RULES" in block]
    frames = [car(t / 10, 15 if t > 5 else 0, ("v", 30.0 - t)) for t in range(40)]
    told: list[tuple[Any, ...]] = []
    names: dict[str, Any] = {
        "frames": frames,
        "road_map": None,
        "print": lambda *values: told.append(values),
    }
    exec(compile(program, "online.md", "exec"), names)

    kinds = [(kind, name) for _, kind, name, _ in told]
    assert ("violated", "brakes") in kinds
    assert ("violated", "apart") in kinds
    assert {v.check: v.verdict for v in names["verdicts"]} == {"apart": "false", "brakes": "false"}


def test_a_step_leaves_nothing_for_the_garbage_collector() -> None:
    monitor = Monitor(
        "CHECK apart: FORALL (v:Vehicle) ALWAYS (dist(ego, v) < 6 IMPLIES EVENTUALLY[0s, 2s] v.speed < 1);"
        " CHECK alone: ALWAYS NOT EXISTS {(ego)-[:near]->(:Car)};"
        " CHECK stops: ALWAYS (ego.speed > 3 IMPLIES EVENTUALLY[0s, 2s] ego.speed <= 3)"
    )
    frames = [car(t / 10, 3 + t // 5 % 2, ("v", 5.0), ("w", 20.0 - t / 10)) for t in range(90)]
    for frame in frames[:30]:  # what is imported and remembered then is no part of it
        monitor.step(frame)
    gc.collect()
    gc.disable()
    try:
        for frame in frames[30:]:
            monitor.step(frame)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_a_guard_that_holds_late_counts_as_one_that_holds_at_once() -> None:
    text = "CHECK close: FORALL (v:Vehicle WHERE v.speed > 3) ALWAYS dist(ego, v) < 10"
    monitor = Monitor(text)
    for t in range(8):
        frame = car(t / 10, 0)
        frame.add("v", "car", 50.0, 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=t, vy=0.0)
        monitor.step(frame)

    (verdict,) = monitor.finish()
    assert verdict.verdict == "false"


def test_what_is_owed_in_every_frame_is_owed_once() -> None:
    slow = "ALWAYS (ego.speed > 1 IMPLIES EVENTUALLY[0s, 90s] ego.speed < 1)"
    monitor = Monitor(f"CHECK slow: EVENTUALLY ego.speed > 99 OR {slow}")
    sizes: list[int] = []
    tracemalloc.start()
    for t in range(120):
        monitor.step(car(t / 10, 2))
        if t % 40 == 39:
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()

    assert sizes[2] - sizes[1] < 20_000


def test_what_looks_ahead_has_no_value_at_once() -> None:
    with pytest.raises(QueryError, match="looks ahead"):
        Monitor("CHECK a: ALWAYS (EVENTUALLY[0s, 1s] ego.speed > 3) = TRUE")


def test_types_of_the_simulator_are_known_while_it_drives() -> None:
    monitor = Monitor("MATCH (v:Car) WHERE v.type = 'a.taxi'; MATCH (v {type_name: 'a.bench'})")
    told: list[tuple[str, str]] = []
    for number in range(2):
        frame = Frame(time_ns=number * 10**8, ego="hero")
        frame.add("hero", "car", 0.0, 0.0)
        frame.add("t", "car", 9.0, 0.0, type_name="a.taxi")
        if number == 0:
            frame.add("b", "prop", 5.0, 5.0, static=True, type_name="a.bench")
        told += [(event.name, event.names["v"]) for event in monitor.step(frame)]

    assert told == [("pattern 1", "car 1"), ("pattern 2", "prop 2")]


@pytest.mark.parametrize(
    "text", ["MATCH (a:OffRoad)", "MATCH (a)", "USING UNKNOWN false MATCH (:Car)-[:isIn]->(a)"]
)
def test_a_frame_without_an_ego_has_off_road_too(text: str) -> None:
    nodes = {-1: {"kind": "off_road"}, 3: {"kind": "car"}}
    scene = SceneGraph(1, "town", 0, 0, None, nodes, [(3, "isIn", -1, {})])
    found = {event.nodes["a"] for event in Monitor(text).look([scene])}
    assert found == ({-1, 3} if text == "MATCH (a)" else {-1})


@pytest.mark.parametrize(
    ("clause", "words"),
    [
        ("ORDER BY v.name LIMIT 3", "ORDER BY, LIMIT"),
        ("SAMPLE 2 PER v.kind SKIP 1", "SAMPLE, SKIP"),
        ("LIMIT 2 PER v.kind", "LIMIT … PER"),
    ],
)
def test_a_monitor_notes_clauses_without_effect(clause: str, words: str) -> None:
    watched = Monitor(f"MATCH (v:Vehicle) RETURN v.name, v.kind {clause}", called="cars")

    assert watched.notes == (f"cars: a monitor reports each match; {words} have no effect",)
    assert Monitor("MATCH (v:Vehicle) RETURN v.name; CHECK ALWAYS ego.speed < 3").notes == ()
    assert Monitor("MATCH (v:Vehicle) RETURN COUNT(*)").notes[0].count("COUNT(*)") == 1
