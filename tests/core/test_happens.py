"""``HAPPENS``: what a recording says has happened, over a store and frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import Bridge, vehicle

import sgstore
from sgstore import Config, Frame, Monitor
from sgstore.errors import QueryError
from sgstore.ingest import ingest
from sgstore.temporal import opened

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

HERO = {
    1: ("vehicle.tesla.model3", "hero"),
    2: ("vehicle.audi.tt", "other"),
    3: ("vehicle.audi.tt", "third"),
}


def drive(path: Path, *, events: bool = True) -> Path:
    """Sixty frames at 10 Hz: a crossed marking in frame 5; collisions in 30 and 31, and with a wall in 50."""
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(60):
            there = [vehicle(1, float(i)), vehicle(2, 40.0), vehicle(3, 80.0)]
            bridge.objects(i / 10, there)
            if not events:
                continue
            if i == 5:
                bridge.lane_invasion(0.52, [2])
            if i in {30, 31}:
                bridge.collision(i / 10 - 0.03, 2, (3, 0, 4))
            if i == 50:
                bridge.collision(5.0, 0, (9, 0, 0))
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("happens")
    told = drive(folder / "told.mcap"), drive(folder / "untold.mcap", events=False)
    outcomes = ingest(folder / "s.sgstore", told)
    assert all(outcome.status == "added" for outcome in outcomes), outcomes
    return folder / "s.sgstore"


@pytest.fixture(scope="module")
def store(place: Path) -> Store:
    return sgstore.open(place)


def frames(store: Store, text: str) -> list[int]:
    return [row.seq for row in store.find(f"{text} RETURN FRAMES")]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("MATCH (e:Ego) WHERE HAPPENS collision(e)", [30, 31, 50]),
        ("MATCH (e:Ego), (v:Vehicle) WHERE HAPPENS collision(e, v)", [30, 31]),
        ("MATCH (e:Ego), (v:Vehicle) WHERE HAPPENS collision(v, e)", [30, 31]),
        ("MATCH (v:Vehicle) WHERE HAPPENS collision(v)", [30, 31, 50]),
        ("MATCH (e:Ego) WHERE happens collision()", [30, 31, 50]),
        ("MATCH (e:Ego) WHERE HAPPENS LaneInvasion(e)", [5]),
        ("MATCH (e:Ego) WHERE HAPPENS collision(e) AND frame.seq > 40", [50]),
        ("MATCH (e:Ego) WHERE HAPPENS collision(e) OR HAPPENS lane_invasion(e)", [5, 30, 31, 50]),
        (
            "MATCH (e:Ego) WHERE frame.seq IN [29, 30] AND NOT HAPPENS collision(e)",
            [29],
        ),
        ("MATCH (e:Ego) WHERE EXISTS {(v:Vehicle) WHERE HAPPENS collision(e, v)}", [30, 31]),
        ("MATCH (v:Vehicle) WHERE HAPPENS collision(ego, v)", [30, 31]),
        (
            "MATCH (e:Ego) WHERE EVENTUALLY[0.1s, 0.3s] HAPPENS collision(e)",
            [27, 28, 29, 30, 47, 48, 49],
        ),
        (
            "MATCH (e:Ego) WHERE HAPPENS lane_invasion(e) THEN MATCH (e) WHERE HAPPENS collision(e)",
            [30],
        ),
    ],
)
def test_what_happens_is_true_in_the_frame_of_the_event(
    store: Store, text: str, expected: list[int]
) -> None:
    assert frames(store, text) == expected


def test_the_time_before_each_collision_is_one_line(store: Store) -> None:
    rows = store.find("MATCH (e:Ego) WHERE HAPPENS collision(e) RETURN CLIPS(-2s, +0s)")

    assert [(row.trace, (row.end_ns - row.start_ns) / 1e9) for row in rows] == [
        ("told", pytest.approx(2.1, abs=0.01)),
        ("told", pytest.approx(2.0, abs=0.01)),
    ]


def test_what_nobody_knows_is_not_found_as_what_does_not_happen(store: Store) -> None:
    # DuckDB's optimizer common_subplan takes who collides and with whom for the same column.
    apart = "MATCH (b:Car) WHERE NOT EXISTS {(a:Car) WHERE HAPPENS collision(b)}"
    found = store.find(f"{apart} RETURN trace.name, frame.seq, b.ident")
    cars = set(store.find("MATCH (b:Car) RETURN trace.name, frame.seq, b.ident"))
    hit = {("told", seq, ident) for seq, ident in ((30, "1"), (30, "2"), (31, "1"), (31, "2"))}
    told = {row for row in cars if row[0] == "told"}

    assert hit <= told
    assert set(found) == told - hit - {("told", 50, "1")}
    assert found.left_out == ("untold",)


def test_a_value_may_be_what_happens(store: Store) -> None:
    rows = store.find(
        "MATCH (e:Ego) WHERE frame.seq IN [29, 30] RETURN trace.name, frame.seq, HAPPENS collision(e)"
    )

    assert sorted(tuple(row) for row in rows)[:2] == [("told", 29, False), ("told", 30, True)]
    assert sorted(tuple(row) for row in rows)[2:] == [("untold", 29, None), ("untold", 30, None)]


EITHER = "ONCE HAPPENS lane_invasion(e) OR NOT HAPPENS collision(e)"
BOTH = "HISTORICALLY NOT HAPPENS lane_invasion(e) AND NOT HAPPENS collision(e)"


@pytest.mark.parametrize(("condition", "times"), [(EITHER, 60), (BOTH, 0)])
def test_a_condition_over_time_is_as_true_in_a_value_as_where_it_selects(
    store: Store, tmp_path: Path, condition: str, times: int
) -> None:
    pattern = "USING UNKNOWN false MATCH (e:Ego)"
    chosen = f"CASE WHEN {condition} THEN 1 ELSE 0 END"
    kept = dict(store.find(f"{pattern} WHERE {condition} RETURN trace.name, COUNT(*)"))
    counted = dict(store.find(f"{pattern} RETURN trace.name, SUM({chosen})"))
    lasting = f"{pattern} RETURN trace.name, MAX({chosen}) OVER match AS most"
    over = dict(store.find(lasting))
    found: list[Any] = []
    path = drive(tmp_path / "untold.mcap", events=False)
    with opened(str(path), Config()) as source:
        queries = f"{lasting.replace('trace.name, ', '')}; {pattern} WHERE {condition}"
        monitor = Monitor(queries, source.road_map, trace="untold", on_event=found.append)
        monitor.run(source.frames)

    assert (kept.get("untold", 0), counted["untold"], over["untold"]) == (times, times, times > 0)
    assert [event.values["most"] for event in found if event.values] == [times > 0]
    assert any(not event.values for event in found) == (times > 0)


def test_a_recording_that_would_not_tell_is_left_out(store: Store) -> None:
    matches = store.find("MATCH (e:Ego) WHERE NOT HAPPENS collision(e)")

    assert {row.trace for row in matches} == {"told"}
    assert matches.reasons == {"untold": "it does not record events of the kind collision"}
    verdicts = store.check("CHECK safe: ALWAYS NOT HAPPENS collision(ego)")
    assert {v.trace: v.verdict for v in verdicts} == {"told": "false", "untold": "unknown"}


def test_of_a_channel_without_events_it_is_known_that_there_are_none(tmp_path: Path) -> None:
    with Bridge(tmp_path / "a.mcap") as bridge:
        bridge.actors(HERO)
        bridge.lane_invasion(0.0, [1])
        bridge.objects(0.0, [vehicle(1)])
        bridge.objects(0.1, [vehicle(1)])
    ingest(tmp_path / "s.sgstore", [tmp_path / "a.mcap"])
    found = sgstore.open(tmp_path / "s.sgstore")

    assert frames(found, "MATCH (e:Ego) WHERE NOT HAPPENS lane_invasion(e)") == [1]
    assert frames(found, "MATCH (e:Ego) WHERE NOT HAPPENS collision(e)") == []


CHECKS = """
CHECK safe: FORALL (v:Vehicle) ALWAYS NOT HAPPENS collision(ego, v) RESET WHEN NOT HAPPENS collision(ego, v);
CHECK straight: ALWAYS (HAPPENS lane_invasion(ego) IMPLIES EVENTUALLY[0s, 1s] HAPPENS collision(ego));
MATCH (e:Ego) WHERE HAPPENS lane_invasion(e) THEN WITHIN 3s MATCH (e), (v) WHERE HAPPENS collision(e, v)
"""


@pytest.mark.parametrize("events", [True, False], ids=["told", "untold"])
def test_a_recording_that_is_watched_has_the_same_answers(
    store: Store, tmp_path: Path, *, events: bool
) -> None:
    path = drive(tmp_path / ("told.mcap" if events else "untold.mcap"), events=events)
    found: list[Any] = []
    with opened(str(path), Config()) as source:
        monitor = Monitor(CHECKS, source.road_map, trace=path.stem, on_event=found.append)
        verdicts = {v.check: v for v in monitor.run(source.frames)}

    checks = ";".join(CHECKS.split(";")[:2])
    stored = {v.check: v for v in store.check(checks) if v.trace == path.stem}
    assert {n: v.verdict for n, v in verdicts.items()} == {n: v.verdict for n, v in stored.items()}
    for name, verdict in stored.items():
        assert [(x.start_seq, x.end_seq) for x in verdicts[name].violations] == [
            (x.start_seq, x.end_seq) for x in verdict.violations
        ]
    sequence = CHECKS.split(";")[2]
    spans = [(i.start_seq, i.end_seq) for i in store.find(sequence).intervals() if events]
    assert [(e.start.seq, e.end.seq) for e in found if e.kind == "found"] == spans


def test_plain_frames_say_what_has_happened() -> None:
    told: list[int] = []
    monitor = Monitor(
        "MATCH (e:Ego), (v:Car) WHERE HAPPENS collision(e, v)",
        on_event=lambda event: told.append(event.start.seq),
    )
    for number in range(4):
        frame = Frame(number * 10**8, ego="me")
        frame.add("me", "car", 0, 0)
        frame.add("you", "car", 3, 0)
        if number == 2:
            frame.happened("collision", "you", "me")
        monitor.step(frame)

    assert told == [2]
    with pytest.raises(ValueError, match="unknown kind of event 'colision'; did you mean"):
        frame.happened("colision", "me")


def test_what_a_table_of_ones_own_says_happens_in_the_same_place(
    store: Store, place: Path, tmp_path: Path
) -> None:
    pair = store.find("MATCH (e:Ego), (v:Vehicle) RETURN e.id AS e, v.id AS v ORDER BY v LIMIT 1")
    ego, other = next(iter(pair))
    rows = f"told,7,{ego},{other}\ntold,7,{other},\nuntold,9,{ego},\n"
    tables = {"outcome.csv": f"trace,seq,node_id,other\n{rows}"}
    tables["by_name.csv"] = "trace,t,ident\ntold,0.8,2\n"
    tables["label.csv"] = "trace,seq,word\ntold,3,a\ntold,3,b\n"
    for name, text in tables.items():
        (tmp_path / name).write_text(text)
    given = {name.removesuffix(".csv"): tmp_path / name for name in tables}
    joined = sgstore.open(place, tables=given)

    def found(text: str) -> list[tuple[str, int]]:
        return [(row.trace, row.seq) for row in joined.find(f"{text} RETURN FRAMES")]

    assert found("MATCH (e:Ego) WHERE HAPPENS outcome(e)") == [("told", 7), ("untold", 9)]
    assert found("MATCH (e:Ego), (v:Vehicle) WHERE HAPPENS outcome(e, v)") == [("told", 7)]
    assert found("MATCH (e:Ego), (v:Vehicle) WHERE HAPPENS outcome(v, e)") == []
    assert found("MATCH (v:Vehicle) WHERE HAPPENS by_name(v)") == [("told", 8)]
    assert found("MATCH (e:Ego) WHERE HAPPENS label()") == [("told", 3)]
    assert len(found("MATCH (e:Ego) WHERE frame.seq < 5 AND NOT HAPPENS label()")) == 9
    assert found("MATCH (e:Ego) WHERE NEXT HAPPENS label()") == [("told", 2)]
    with pytest.raises(
        QueryError, match="label does not name the nodes: it lacks the column node_id or ident"
    ):
        found("MATCH (e:Ego) WHERE HAPPENS label(e)")


def test_why_not_knows_what_has_happened(store: Store) -> None:
    text = "MATCH (e:Ego), (v:Vehicle) WHERE HAPPENS collision(e, v) AND v.speed >= 0"

    assert store.why_not("told#29", text).failed == "HAPPENS collision(e, v)"
    assert not store.why_not("told#30", text).failed
    assert any(
        "HAPPENS collision(e, v)" in lane.part.text for lane in store.parts(text, "told#30").lanes
    )
    assert "HAPPENS collision(e, v)" in store.find(text).explain()
