"""A trace that knows nothing of what a question speaks of cannot answer it, and says why."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from oracle_over_time import worlds
from recordings import Recorder, car

from sgstore.apps.cli import run as run_verb
from sgstore.errors import QueryError
from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.lang.bind import MOTION
from sgstore.lang.catalog import NODE_ATTRIBUTES, Type
from sgstore.model.vocabulary import VEHICLE_LIGHTS, natural, normalize_name
from sgstore.query import Store
from sgstore.temporal import Monitor
from sgstore.testsets.diff import matches

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.temporal import Verdict


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """One drive with an ego and one without."""
    folder = tmp_path_factory.mktemp("drives")
    for name, host in (("with", 7), ("without", None)):
        with Recorder(folder / f"{name}.mcap") as recorder:
            for i in range(5):
                recorder.ground_truth(i * 0.1, [car(7, i, v=(10, 0)), car(8, 20)], host=host)
    ingest(folder / "drives.sgstore", [folder / "with.mcap", folder / "without.mcap"])
    store = Store(folder / "drives.sgstore")
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def silent(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A random world of three traces, the second of which tells nothing that is measured."""
    _, store = worlds(5, tmp_path_factory.mktemp("silent"))
    columns = ["speed", "vx", "vy", "vz", "ax", "ay", "az", "yaw_rate", "heading", "pitch", "roll"]
    columns += ["length", "width", "height", "steer", "throttle", "brake", "lights", "light_state"]
    store.close()
    with duckdb.connect(str(store.file.path)) as connection:
        for table, some in (("state", columns), ("entity", ["parked", "heading", *columns[11:14]])):
            trace = "frame_id >> 24" if table == "state" else "trace_id"
            cleared = ", ".join(f"{column} = NULL" for column in some)
            connection.execute(f"UPDATE inside.{table} SET {cleared} WHERE {trace} = 2")
        connection.execute("UPDATE inside.map_node SET speed_limit = 10, curvature = 0")
    store = Store(store.file.path)
    with store.file.snapshot():
        yield store


OF_ENTITIES = sorted(
    {
        *(*MOTION, *VEHICLE_LIGHTS, "heading", "pitch", "roll", "length", "width", "height"),
        *("steer", "throttle", "brake", "gear", "hand_brake", "parked"),
    }
)
CARS = {
    *VEHICLE_LIGHTS,
    "parked",
    "steer",
    "throttle",
    "brake",
    "heading",
    "speed",
    "vx",
    "vy",
    "vz",
}
"""What not every entity lacks there: what stands for ever has speed 0."""


def condition(name: str, node: str) -> str:
    boolean = NODE_ATTRIBUTES[normalize_name(name)].type is Type.boolean
    return f"{node}.{name}" if boolean else f"{node}.{name} > 0.5"


@pytest.mark.parametrize("name", OF_ENTITIES)
def test_what_is_never_known_is_neither_kept_nor_violated(silent: Store, name: str) -> None:
    kind = "Car" if name in CARS else "Entity"
    test = condition(name, "v")
    for formula in (f"ALWAYS NOT {test}", f"ALWAYS {test}", f"EVENTUALLY (v.z > 99 OR {test})"):
        verdicts = list(silent.check(f"CHECK c: FORALL (v:{kind} WHERE NOT v.is_static) {formula}"))
        told = {one.trace: (one.verdict, one.reason) for one in verdicts}

        assert told["trace2"] == ("unknown", f"{name} of v never has a value"), formula

    found = silent.find(f"MATCH (v:{kind} WHERE NOT v.is_static) WHERE ALWAYS NOT {test}")
    assert "trace2" in found.left_out
    assert {row[1] for row in found}.isdisjoint(found.left_out)
    assert "trace2" in silent.find(f"MATCH (v:{kind}) WHERE NOT v.is_static AND {test}").left_out


def test_one_of_two_conditions_is_enough_to_find_something(silent: Store) -> None:
    either = silent.find("MATCH (v:Entity) WHERE v.x > -1e9 OR v.speed > 3")

    assert either.left_out == ()
    assert "trace2" in {row[1] for row in either}


@pytest.mark.parametrize(
    "formula",
    [
        "ALWAYS known(v.speed)",
        "ALWAYS NOT v.speed IS NULL",
        "ALWAYS coalesce(v.speed, 0) < 1e9",
        "ALWAYS NOT v.special = 'taxi'",
        "ALWAYS NOT EXISTS {(w:Car)-[:near]->(v)}",
    ],
)
def test_what_says_something_itself_is_not_unknown(silent: Store, formula: str) -> None:
    verdicts = silent.check(f"USING NODES any CHECK c: FORALL (v:Car) {formula}")
    relations = {trace.name for trace in silent.info() if "near" not in trace.answers}

    assert {v.trace for v in verdicts if v.verdict == "unknown"} <= (
        relations if "near" in formula else set()
    )


@pytest.mark.parametrize(
    ("function", "missing"),
    [("gap", "length"), ("ttc", "vx"), ("rel_speed", "vx"), ("bearing", "heading")],
)
def test_numbers_of_two_need_what_they_are_made_of(
    silent: Store, function: str, missing: str
) -> None:
    text = f"CHECK c: FORALL (a:Car, b:Car) ALWAYS NOT {function}(a, b) < 1"
    (told,) = (one for one in silent.check(text) if one.trace == "trace2")

    assert told.verdict == "unknown"
    assert f"{missing} of a never has a value" in told.reason


WITHOUT_EGO = {
    "ALWAYS ego.speed < 20": "it has no ego",
    "ALWAYS NOT EXISTS {(ego)-[:collides]-(:Vehicle)}": "it has no ego",
    "ALWAYS NOT EXISTS {(:Ego)-[:collides]-(:Vehicle)}": "it has no ego",
    "FORALL (v:Vehicle) ALWAYS NOT EXISTS {(e:Ego)-[:collides]-(v)}": "it has no ego",
    "ALWAYS NOT EXISTS {(e:Ego) WHERE e.speed > 99}": "it has no ego",
    "ALWAYS NOT EXISTS {(e:Ego)} OR EXISTS {(:Ego)}": "",
    "FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 1": "it has no ego",
    "FORALL (v:Vehicle) ALWAYS v.speed < 20": "",
    "FORALL (p:Person) ALWAYS p.speed < 3": "",
    "FORALL (v:Vehicle) ALWAYS v.throttle < 1": "throttle of v never has a value",
    "ALWAYS NOT env.fog = 'dense'": "env.fog never has a value",
}


@pytest.mark.parametrize("formula", WITHOUT_EGO)
def test_a_trace_without_ego_cannot_tell_of_it(drives: Store, formula: str) -> None:
    told = {one.trace: one for one in drives.check(f"CHECK c: {formula}")}

    assert told["without"].reason == WITHOUT_EGO[formula]
    assert told["without"].verdict == ("unknown" if WITHOUT_EGO[formula] else "true")
    assert told["without"].violations == ()
    assert told["with"].reason == WITHOUT_EGO[formula].replace("it has no ego", "")


@pytest.mark.parametrize("ego", [True, False])
@pytest.mark.parametrize("formula", WITHOUT_EGO)
def test_a_monitor_tells_of_no_violation_that_nobody_knows(
    drives: Store, formula: str, *, ego: bool
) -> None:
    events, verdict = watched(f"CHECK c: {formula}", ego=ego)
    (stored,) = (
        one
        for one in drives.check(f"CHECK c: {formula}")
        if one.trace == ("with" if ego else "without")
    )

    assert events == []
    assert (verdict.verdict, verdict.reason) == (stored.verdict, stored.reason)


def watched(text: str, *, ego: bool, late: int = 0) -> tuple[list[Any], Verdict]:
    """What a monitor tells of the drive; the ego comes some frames late."""
    monitor = Monitor(text)
    events: list[Any] = []
    for i in range(5):
        frame = Frame(time_ns=i * 100_000_000, ego="7" if ego and i >= late else "")
        size = {"heading": 0.0, "length": 4.0, "width": 2.0}
        if i >= late:
            frame.add("7", "car", float(i), 0.0, 0.0, **size, vx=10.0, vy=0.0)
        frame.add("8", "car", 20.0, 0.0, 0.0, **size, vx=0.0, vy=0.0)
        events += monitor.step(frame)
    (verdict,) = monitor.finish()
    return events, verdict


def test_a_violation_is_told_once_what_it_needs_is_known() -> None:
    events, verdict = watched("CHECK c: ALWAYS NOT ego.speed > 5", ego=True, late=2)

    # An ego that is absent at first violates nothing.
    assert [(e.kind, e.start.seq, e.told.seq) for e in events] == [("violated", 2, 2)]
    assert verdict.verdict == "false"


def test_the_reason_is_told_wherever_a_verdict_is(
    drives: Store, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path, junit = str(drives.file.path), tmp_path / "junit.xml"
    asked = ["check", path, "-e", "CHECK slow: ALWAYS ego.speed < 20", "--require"]
    assert run_verb([*asked, "--junit", str(junit)]) == 0
    shown = capsys.readouterr()
    assert run_verb([*asked, "--json"]) == 0
    documents = json.loads(capsys.readouterr().out)

    assert "slow is unknown of without: it has no ego" in shown.err
    assert "1 true, 0 false, 1 unknown" in shown.err
    assert 'skipped message="it has no ego"' in junit.read_text()
    assert {d["trace"]: d["reason"] for d in documents} == {
        "with": None,
        "without": "it has no ego",
    }
    assert run_verb(["find", path, "MATCH (e:Ego) WHERE e.speed > 1"]) == 0
    assert "(it has no ego): without" in capsys.readouterr().err


def test_a_diff_answers_for_the_traces_that_can(drives: Store) -> None:
    query = "MATCH (v:Vehicle) WHERE ALWAYS NOT dist(ego, v) < 1"
    table = matches(drives, drives, query, {})

    assert [row[:2] for row in table.rows] == [("same", "with")]
    assert "without cannot answer in A, and is not compared: it has no ego" in table.said


def test_traces_come_as_people_count() -> None:
    names = ["run10", "run2", "Run1", "run02b", "a", "run2a"]

    assert sorted(names, key=natural) == ["a", "Run1", "run2", "run2a", "run02b", "run10"]


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("CHECK c: ALWAYS ego.speed < 20", {"without": "it has no ego"}),
        (
            "CHECK c: FORALL (v:Vehicle) ALWAYS v.brake < 0.5",
            dict.fromkeys(("with", "without"), "brake of v never has a value"),
        ),
        (
            "CHECK c: EVENTUALLY lane_dist(ego, ego) < 3 OR EXISTS {(ego)-[:isIn]->(:Lane)}",
            {
                "with": "it does not contain isIn; it has no map of lanes",
                "without": "it does not contain isIn; it has no map of lanes; it has no ego",
            },
        ),
    ],
)
def test_whatever_tells_verdicts_says_why_they_are_unknown(
    text: str,
    unknown: dict[str, str],
    drives: Store,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, picture = str(drives.file.path), tmp_path / "when.svg"

    def told(*line: str) -> tuple[str, str]:
        assert run_verb([*line]) == 0
        out, err = capsys.readouterr()
        return out, " ".join(err.split())

    checked = json.loads(told("check", store, "-e", text, "--json")[0])
    assert {one["trace"]: one["reason"] for one in checked if one["reason"]} == unknown
    compared = json.loads(told("diff", store, store, "-q", text, "--json")[0])
    for one in compared:
        assert one["reason_a"] == one["reason_b"] == unknown.get(one["trace"])
        assert (one["a"] == "unknown") == (one["trace"] in unknown)
    people, said = told("diff", store, store, "-q", text)
    assert "unknown" in people
    assert "reason" not in people
    drawn = told("timeline", store, text, "-o", str(picture))[1]
    lanes, lines = told("timeline", store, text)
    for trace, reason in unknown.items():
        traces = ", ".join(name for name, why in unknown.items() if why == reason)
        assert f"c is unknown in A of {traces}: {reason}" in said
        assert f"c is unknown in B of {traces}: {reason}" in said
        assert f"c is unknown of {traces}: {reason}" in lines
        assert f"c is unknown of {traces}: {reason}" in drawn
        assert re.search(rf"^{trace}  0 … .*\n  c  ·+  unknown$", lanes, re.MULTILINE)
        assert f"unknown: {reason}" in picture.read_text(encoding="utf-8")


def test_swim_lanes_tell_what_a_trace_cannot_answer_from_what_is_not_found(
    drives: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    store = str(drives.file.path)

    assert run_verb(["timeline", store, "MATCH (e:Ego) WHERE e.speed > 90"]) == 0
    out, err = capsys.readouterr()

    assert "match is unknown of without: it has no ego" in err
    assert re.search(r"^with  0 .*\n  nothing$", out, re.MULTILINE)
    assert re.search(r"^without  0 .*\n  match  ·+  unknown$", out, re.MULTILINE)


@pytest.mark.parametrize(
    "word", ["EXISTS {{{}-[:near]->(v:Vehicle)}}", "COUNT {{{}-[:near]->(v:Car)}} > 1"]
)
@pytest.mark.parametrize(
    "start", ["ALWAYS", "ALWAYS NOT", "FORALL (w:Car) ALWAYS dist(ego, w) > 9 OR"]
)
def test_the_label_of_the_ego_in_braces_of_a_check_is_the_ego(
    word: str, start: str, open_town: Store
) -> None:
    named, bare, ego = (
        [
            (one.trace, one.verdict, one.violations, one.witnesses, one.reason)
            for one in open_town.check(f"CHECK c: {start} {word.format(node)}")
        ]
        for node in ("(e:Ego)", "(:Ego)", "(ego)")
    )

    assert named == bare == ego
    assert ego[0][1] != "unknown"


def test_other_spellings_of_the_ego_are_answered_with_it(open_town: Store) -> None:
    with pytest.raises(QueryError, match=r"\(EGO\) matches any node") as caught:
        open_town.find("MATCH (EGO)-[:near]->(v:Vehicle)")

    assert caught.value.hint == "write the ego as (ego), or as a label: (e:Ego)"
