"""Queries in several parts: ``OPTIONAL MATCH``, ``WITH``, and what all that asks does with them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from oracle_parts import disagreement_of_matches, disagreement_of_parts, try_many_parts
from oracle_worlds import World, random_world
from recordings import Recorder, car
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.query import Store
from sgstore.store import StoreFile
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.mark.parametrize("first", range(0, 600, 50) if LONG else [50])
def test_random_queries_equal_their_definition(first: int) -> None:
    seen = try_many_parts(first, 50 if LONG else 25)

    assert seen["tried"] > 15
    assert seen["with rows"] > 5


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(3, traces=3, frames=6)


WIDE = "{(c:Ego) WHERE v.x > 101 OR EXISTS {(d) WHERE c.width IS KNOWN OR w.x > 1}}"
"""Of a block that is in another one, asked beside what was passed on, or a path."""


@pytest.mark.parametrize(
    "text",
    [
        "OPTIONAL MATCH (v)-[:near]->(w:Car) WITH v, w WHERE w IS NULL RETURN v, v.name",
        "OPTIONAL MATCH (v)-[d:near|visible]->(w) RETURN v, type(d), w.speed, w.is_ego",
        "WITH v.kind AS k, COUNT(*) AS n WHERE n > 1 RETURN k, n",
        "WITH DISTINCT v.kind AS k WITH COUNT(*) AS n RETURN n, COUNT(*)",
        "WITH v AS w OPTIONAL MATCH (w)-[:isIn]->(l:Lane) RETURN w, l",
        "WITH v, COUNT {(v)-[:near]->()} AS n MATCH (w:Entity) WHERE w.id > n RETURN v, w",
        "WITH * WHERE v.x > 101 RETURN COUNT(v)",
        "OPTIONAL MATCH (v)-[d]->(w) WITH v, w RETURN v, w, COUNT(*)",
        "OPTIONAL MATCH p = (v)-[:near*1..2]->(w) WHERE length(p) > 1 RETURN v, p, length(p)",
        f"WITH v, 2 AS n MATCH (w) WHERE COUNT {WIDE} < n RETURN v, w",
        f"MATCH p = (v)-[:near*1..2]-(w) WHERE EXISTS {WIDE} OR length(p) = 1 RETURN v, w",
    ],
)
def test_stages_equal_their_definition(text: str, world: World) -> None:
    problem, rows = disagreement_of_parts(f"MATCH (v:Entity) {text}", world)

    assert problem == ""
    assert rows
    assert (
        disagreement_of_matches(f"MATCH (v:Entity) {text.partition(' RETURN')[0]}", world)[0] == ""
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Four cars that drive behind one another at 10 m/s; from the tenth frame on the last one is gone."""
    folder = tmp_path_factory.mktemp("parts")
    with Recorder(folder / "run.mcap") as recorder:
        for number in range(20):
            places = (0, 12, 25, 40)[: 3 if number >= 10 else 4]
            cars = [car(7 + i, x + number, v=(10, 0)) for i, x in enumerate(places)]
            recorder.ground_truth(number / 10, cars, host=7)
    ingest(folder / "x.sgstore", [folder / "run.mcap"])
    with Store(folder / "x.sgstore") as opened:
        yield opened


def test_absent_node_is_null_in_every_form(store: Store, tmp_path: Path) -> None:
    text = "MATCH (e:Ego) OPTIONAL MATCH (v:Car) WHERE v.x - e.x > 30"
    matches = store.find(text)

    assert matches.count() == len(matches.rows()) == 20
    assert [row.v for row in matches] == [3] * 10 + [None] * 10
    assert [row.v_name for row in matches][9:11] == ["car 3", None]
    assert matches.numpy()["v"].mask.tolist() == [False] * 10 + [True] * 10
    assert [(one.frames, one.values["v"]) for one in matches.intervals()] == [(10, 3), (10, None)]
    assert matches.bindings(store.file.frame("run#12")) == [{"e": 0}]
    assert [sorted(graph.nodes) for graph in matches.subgraphs()][9:11] == [[0, 3], [0]]
    assert matches.csv(tmp_path / "x.csv") == matches.parquet(tmp_path / "x.parquet") == 20
    assert [lane.part.text for lane in matches.parts(store.file.frame("run#2")).lanes] == [
        "(e:Ego)"
    ]
    assert (
        store.find(f"{text} RETURN v.name AS v, INTERVALS HAVING frames > 5").rows()[1][-1] is None
    )
    assert store.find(f"{text} RETURN DISTINCT v").rows() == [(3,), (None,)]


def test_matches_are_listed_once_after_with(world: World) -> None:
    for text in (
        "USING NODES any MATCH p = (a)-[:near*1..2]->(b) WITH b, a",
        "MATCH (v:Entity) WITH v.kind AS k, v.id AS i, COUNT(*) AS n WITH k",
    ):
        assert disagreement_of_matches(text, world)[0] == ""


def test_with_counts_and_filters_in_each_frame(store: Store) -> None:
    counted = "MATCH (e:Ego), (v:Car) WITH e, COUNT(v) AS many WHERE many > 2"
    nearest = "MATCH (e:Ego), (v:Car) WITH e, v ORDER BY dist(e, v) DESC LIMIT 1"

    assert [(row.seq, row.many) for row in store.find(counted)] == [(i, 3) for i in range(10)]
    assert [one.frames for one in store.find(f"{counted} RETURN INTERVALS").intervals()] == [10]
    found = store.find(f"{nearest} RETURN v.name AS last, COUNT(*) AS frames").rows()
    assert found == [("car 2", 10), ("car 3", 10)]
    listed = store.find("MATCH (v:Car) WITH collect(v.name) AS names RETURN DISTINCT names").rows()
    assert [len(row.names) for row in listed] == [3, 4]


def test_shell_prints_absent_nodes(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    text = "MATCH (e:Ego) WHERE frame.seq IN [9, 10] OPTIONAL MATCH (v:Car) WHERE v.x > 45 RETURN v.name AS v"

    assert run_verb(["find", str(store.file.path), text, "--json"]) == 0

    assert json.loads(capsys.readouterr().out) == [{"v": "car 3"}, {"v": None}]


def test_paths_are_lists_of_nodes_in_every_form(store: Store, tmp_path: Path) -> None:
    text = "MATCH p = (a:Car)-[:near*1..3]->(b:Car) WHERE a.x < b.x AND frame.seq = 3"
    found = store.find(f"{text} RETURN nodes(p) AS p, length(p) AS n ORDER BY n, a.id")

    assert [(row.p, row.n) for row in found][-1] == ([0, 1, 2, 3], 3)
    assert [row.n for row in found] == [1, 1, 1, 2, 2, 3]
    assert store.find(text).rows()[0].p in ([0, 1], [1, 2], [2, 3])
    assert store.find(f"{text} AND length(p) > 1").count() == 1
    assert len(found.arrow().to_pydict()["p"]) == found.csv(tmp_path / "x.csv") == 6
    assert json.loads(json.dumps([list(row) for row in found]))[-1] == [[0, 1, 2, 3], 3]


def test_why_not_and_explain_name_the_stages(store: Store) -> None:
    text = (
        "MATCH (e:Ego) WHERE e.speed > 20 OPTIONAL MATCH (v:Car) WITH e, COUNT(v) AS n WHERE n > 1"
    )

    assert "e.speed > 20" in str(store.why_not("run#3", text))
    explained = store.find(text).explain()
    assert "optional match" in explained
    assert "with each e, count(v) AS n\n  where (n > 1)" in explained


def test_why_not_tests_the_steps_of_a_sequence_in_all_frames(store: Store) -> None:
    """The ego drives along the x axis."""
    places = [row[0] for row in store.find("MATCH (e:Ego) RETURN e.x ORDER BY frame.t").rows()]
    late, early, never = places[-2], places[1], places[-1] + 1
    text = (
        f"MATCH (e:Ego) WHERE e.x >= {late} THEN WITHIN 9s MATCH (e:Ego) WHERE e.x <= {early}"
        f" THEN MATCH (e:Ego) WHERE e.x > {never}"
    )

    why: Any = store.why_not("run#3", text)

    assert (why.trace, why.frames, why.apart) == ("run", (2, 2, 0), ((2, "THEN WITHIN 9s"),))
    lines = str(why).splitlines()[-4:]
    assert lines == [
        "step 1 holds in 2 frames of run",
        "step 2 holds in 2 frames of run",
        "step 3 holds in no frame of run",
        "step 2 never follows step 1 in run: THEN WITHIN 9s",
    ]
    assert why.as_dict()["apart"] == [{"step": 2, "link": "THEN WITHIN 9s"}]
    turned = f"MATCH (e:Ego) WHERE e.x <= {early} THEN MATCH (e) WHERE e.x >= {late}"
    assert store.why_not("run#3", turned).as_dict()["apart"] == []


def test_monitor_reports_start_of_staged_matches() -> None:
    """Three cars stand behind one another; in the third frame one is gone, and one id returns far away."""
    monitor = Monitor(
        "MATCH (e:Ego) OPTIONAL MATCH (v:Car) WHERE v.x - e.x > 20;"
        "MATCH (e:Ego), (v:Car) WITH e, COUNT(v) AS many WHERE many > 1;"
        "MATCH p = (e:Ego)-[:super_near*1..2]->(v:Car) RETURN length(p) AS edges, nodes(p) AS ids;"
        "MATCH (e:Ego)-[:super_near]->(v:Car) WITH v AS e"
    )
    told = list[tuple[int, str, dict[str, str], dict[str, object]]]()
    for number, places in enumerate(((0, 7, 14), (0, 7, 14), (0, 50))):
        frame = Frame(time_ns=number * 100_000_000, ego="c0")
        for who, x in enumerate(places):
            frame.add(f"c{who}", "car", float(x), 0.0, 0.0, heading=0.0, length=4.5, vx=1.0)
        for event in monitor.step(frame):
            told.append((number, event.name[-1], dict(event.names), dict(event.values)))

    assert told == [
        (0, "1", {"e": "car 0"}, {}),
        (0, "2", {"e": "car 0"}, {"many": 2}),
        (0, "3", {"e": "car 0", "v": "car 1"}, {"edges": 1, "ids": [0, 1]}),
        (0, "3", {"e": "car 0", "v": "car 2"}, {"edges": 2, "ids": [0, 1, 2]}),
        (0, "4", {"e": "car 1"}, {}),
        (2, "1", {"e": "car 0", "v": "car 3"}, {}),
    ]


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (v:Vehicle)-[:near]->(w:Vehicle) WHERE v.x > 5",
        "MATCH (v:Vehicle), (w:Vehicle) WHERE delta(v.x, 0.5s) > 1 THEN MATCH (v) WHERE v.x > 20",
        "MATCH (v:Vehicle), (w:Vehicle), (u:Vehicle) WHERE u.x > v.x",
    ],
)
def test_truth_lanes_of_many_matches_equal_those_of_each_and_ask_once(
    text: str, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    matches, calls = store.find(text), list[str]()
    pairs = [{"v": 1, "w": 2}, {"v": 2, "w": 1}, {"v": 0, "w": 1}]
    each = [matches.parts(store.file.frame("run#0"), pair).as_dict() for pair in pairs]
    arrays = StoreFile.arrays

    def counted(file: StoreFile, sql: str, *given: Any, **more: Any) -> Any:
        calls.append(sql)
        return arrays(file, sql, *given, **more)

    monkeypatch.setattr(StoreFile, "arrays", counted)
    together = [lanes.as_dict() for lanes in matches.parts_each([("run", 0, p) for p in pairs])]
    many = len(calls)
    calls.clear()
    matches.parts_each([("run", 0, pairs[0])])

    assert together == each
    assert any(lanes["lanes"][0]["spans"] for lanes in each)
    assert many == len(calls) * (3 if "(u:" in text else 1)  # u must differ from v and w


def test_places_in_lanes_are_read_only_for_the_kinds_of_their_entity(town_store: Path) -> None:
    text = "MATCH (e:Ego)-[i:isIn {primary: TRUE}]->(l:Lane) WHERE l.turn = 'left'"

    with Store(town_store) as store:
        plan = store.find(f"{text} AND i.along > l.length / 2").explain()

    assert '"g"."node_id" = "l"."node_id"' in plan  # g: the egos of a bucket
    assert plan.count('"n"."turn" = \'left\'') == 2  # of single and of repeated places
