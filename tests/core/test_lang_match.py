"""Patterns over one graph in memory, against exhaustive search and against SQL."""

from __future__ import annotations

import math
from collections import Counter
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from matching import Matcher
from oracle import answer
from oracle_patterns import Writer
from oracle_worlds import World, random_world
from recordings import Recorder, car
from test_lang_oracle import QUERIES
from thorough import LONG

from sgstore.apps.demo import QUESTIONS
from sgstore.errors import QueryError
from sgstore.ingest import ingest
from sgstore.lang.catalog import Catalog
from sgstore.lang.help import why_not
from sgstore.lang.memory import FrameView
from sgstore.lang.sql import compile_query
from sgstore.lang.syntax import parse
from sgstore.model.graph import SceneGraph
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

    from oracle_worlds import Frame

    from sgstore.lang.ir import Query
    from sgstore.store import FrameRef

pytestmark = pytest.mark.seconds(8)


def view_of(frame: Frame) -> FrameView:
    graph = frame.graph
    edges = [
        (src, relation, dst, {k: v for k, v in data.items() if k != "relation"})
        for src, dst, relation, data in graph.edges(keys=True, data=True)
    ]
    start = frame.trace.frames[0].time_ns
    nodes = dict(graph.nodes(data=True))
    key = (frame.frame_id, frame.trace.name, frame.seq, frame.time_ns, frame.ego)
    events = {
        kind: [(a, b) for told, a, b in frame.events if told == kind]
        for kind in frame.trace.records
    }
    scene = SceneGraph(*key, nodes, edges, events=events)
    about = {"id": frame.frame_id, "seq": frame.seq, "t": (frame.time_ns - start) / 1e9}
    return FrameView(scene, about, {"name": frame.trace.name, "id": frame.trace.trace_id})


def found(text: str, world: World) -> Counter[tuple[Any, ...]]:
    """Rows of a query, as ``oracle.answer`` gives them."""
    query = compile_query(text, world.catalog)
    matcher = Matcher(query.bound)
    rows: Counter[tuple[Any, ...]] = Counter()
    for frame in world.frames:
        if frame.trace.name in query.left_out or query.query.ego not in {None, frame.trace.hero}:
            continue
        for match in matcher.matches(view_of(frame)):
            named = {k: v for k, v in {**match.nodes, **match.edges}.items() if k != "ego"}
            rows[frame.frame_id, *(value for _, value in sorted(named.items()))] += 1
    return rows


@pytest.mark.parametrize("first", [0, 100] if LONG else [0])
def test_random_patterns_in_memory_equal_exhaustive_search(first: int) -> None:
    tried = matched = 0
    for number in range(first, first + 50):
        if number % 25 == 0:
            world = random_world(number, static=number % 2 == 0)
        text = Writer(number).query()
        try:
            rows = found(text, world)
        except QueryError:
            continue
        wanted, _ = answer(text, world)
        tried += 1
        matched += bool(wanted)
        assert rows == wanted, f"pattern {number}: {text}"

    assert tried > 40
    assert matched > 10


@cache
def small_world() -> World:
    return random_world(2, frames=5, static=True)


@pytest.mark.parametrize("text", QUERIES)
def test_queries_in_memory_equal_exhaustive_search(text: str) -> None:
    world = small_world()

    assert found(text, world) == answer(text, world)[0]


def is_pattern(part: str) -> bool:
    try:
        parse(f"MATCH {part}")
    except QueryError:
        return False
    return True


def asked_again(query: Query, parts: tuple[str, ...], frame: Frame, world: World) -> bool:
    """Whether the parts of a pattern, as they are printed, hold together in a frame."""
    paths = [part for part in parts if is_pattern(part)]
    where = [f"({part})" for part in parts if part not in paths]
    if not paths:
        return True
    text = "" if query.injective else "USING NODES any "
    text += f"MATCH {', '.join(paths)}" + (f" WHERE {' AND '.join(where)}" if where else "")
    again = compile_query(text, world.catalog).bound
    return Matcher(again).holds(view_of(frame))


def test_suggested_text_can_be_pasted() -> None:
    asked = 0
    for number in range(100):
        if number % 25 == 0:
            world = random_world(number, frames=3, static=number % 50 == 0)
        try:
            query = compile_query(Writer(number).query(), world.catalog).bound
        except QueryError:
            continue
        for frame in world.frames:
            answer = why_not(query, view_of(frame))
            for line in str(answer).splitlines():
                told = line[8:]
                assert is_pattern(told) or is_pattern(f"(x) WHERE {told}"), line
                asked += 1
    assert asked > 500


def test_failed_part_is_named_exactly_without_match() -> None:
    failed = held = 0
    for number in range(60):  # what is said is a query again, with what holds and with what fails
        if number % 20 == 0:
            world = random_world(number, frames=4, static=number % 40 == 0)
        try:
            query = compile_query(Writer(number).query(), world.catalog).bound
        except QueryError:
            continue
        matcher = Matcher(query)
        for frame in world.frames:
            answer = why_not(query, view_of(frame))
            assert bool(answer.failed) != matcher.holds(view_of(frame)), (number, answer)
            assert asked_again(query, answer.held, frame, world), (number, answer)
            if answer.failed:
                parts = (*answer.held, answer.failed)
                assert not asked_again(query, parts, frame, world), (number, answer)
            failed += bool(answer.failed)
            held += not answer.failed

    assert min(failed, held) > 20


@pytest.mark.parametrize(
    ("text", "failed", "found"),
    [
        (
            "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(p:Person)",
            "(p)-[:isIn]->(l)",
            "(p), (l) WHERE NOT EXISTS {(p)--(l)}",
        ),
        ("MATCH (e:Ego) WHERE e.speed > 20", "e.speed > 20", "e.speed = 5.697"),
        ("MATCH (e:Ego), (t:Train)", "(t:Train)", "COUNT {(:Car)} = 6 AND COUNT {(:Van)} = 1"),
        (
            "MATCH (e:Ego) WHERE COUNT {(e)-[:near]->(:Person)} > 3",
            "COUNT {(person:Person), (e)-[:near]->(person)} > 3",
            "COUNT {(person:Person), (e)-[:near]->(person)} = 2",
        ),
        ("MATCH (e:Ego)-[:safety_hazard]->(v:Bus)", "(e)-[:safety_hazard]->(v)", "dist(e, v) = "),
    ],
)
def test_first_failed_part_is_shown_with_actual_values(
    town: Store, text: str, failed: str, found: str
) -> None:
    answer = town.why_not("town@20s", text)

    assert answer.failed == failed
    assert found in answer.found
    assert answer.held[0] == "(e:Ego)"


def test_failed_case_is_shown_as_written(town: Store) -> None:
    case = "CASE WHEN e.speed < 1 THEN 'slow' WHEN e.speed < 2 THEN 'walk' ELSE 'fast' END = 'none'"
    answer = town.why_not("town@20s", f"MATCH (e:Ego) WHERE {case}")

    assert answer.failed == case


@pytest.mark.parametrize(
    ("define", "condition", "held", "failed", "found"),
    [
        ("", "e.speed < 99 AND hard_brake(e)", "e.speed < 99", "hard_brake(e)", "e.accel = "),
        ("", "NOT  hard_brake( e )  AND e.speed > 99", "NOT hard_brake( e )", "e.speed > 99", ""),
        (
            "DEFINE PREDICATE both(x) AS x.speed > -1 AND x.speed > 99; ",
            "both(e)",
            "(e:Ego)",
            "both(e)",
            "e.speed = ",
        ),
        (
            "DEFINE PREDICATE fast(x) AS x.speed > 99; ",
            "fast(e) OR hard_brake(e)",
            "(e:Ego)",
            "fast(e) OR hard_brake(e)",
            "e.accel = ",
        ),
    ],
)
def test_predicates_are_shown_as_written(
    town: Store, define: str, condition: str, held: str, failed: str, found: str
) -> None:
    answer = town.why_not("town@20s", f"{define}MATCH (e:Ego) WHERE {condition}")

    assert answer.held[-1] == held
    assert answer.failed == failed
    assert found in answer.found


def test_predicates_of_a_library_pattern_are_shown_as_written(town: Store) -> None:
    first, *_ = town.why_not("town@20s", "MATCH cut_in()").steps

    assert first.held[2:5] == ("next_lane(e, v)", "NOT same_lane(e, v)", "same_heading(e, v)")


def test_notes_show_predicates_as_written(town: Store) -> None:
    define = "DEFINE PREDICATE both(x) AS x.speed > 1 AND x.speed > 99; "

    (note,) = town.find(f"{define}MATCH (e:Ego) WHERE both(e)").notes

    assert note == "no frame of the store has both(e)"


def test_nearest_match_has_smallest_shortfall(town: Store) -> None:
    answer = town.why_not("town@20s", "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 1")
    distances = town.sql(
        "SELECT p.distance, n.name FROM pairs p JOIN frames f USING (frame_id)"
        " JOIN nodes n ON n.frame_id = p.frame_id AND n.node_id = p.dst"
        " WHERE f.seq = 200 AND p.src = f.ego"
        " AND n.kind IN ('car', 'truck', 'van', 'bus', 'motorcycle', 'bicycle')"
    ).values
    least, name = min(distances)

    assert answer.nearest["v"] == name
    assert answer.found == f"dist(e, v) = {least:.4g}"


def test_unanswerable_trace_is_reported(tmp_path: Path) -> None:
    with Recorder(tmp_path / "field.mcap") as recorder:
        recorder.ground_truth(0.0, [car(1, 0, 0), car(2, 9, 0)], host=1)
    assert ingest(tmp_path / "s.sgstore", [tmp_path / "field.mcap"])[0].error is None
    field = Store(tmp_path / "s.sgstore")
    text = "MATCH (e:Ego)-[:isIn]->(l:Lane)"

    assert "isIn" in field.why_not("field#0", text).failed
    assert field.find(text).left_out == ("field",)


@pytest.fixture(scope="module")
def town(open_town: Store) -> Store:
    return open_town


@pytest.fixture(scope="module")
def scenes(town: Store) -> list[tuple[FrameRef, SceneGraph]]:
    """Every sixtieth frame, and its graph."""
    frames = {frame.frame_id: frame for frame in town.find("MATCH (e:Ego)").frames()}
    return [(frame, town.file.graph(frame.frame_id)) for frame in [*frames.values()][::60]]


@pytest.mark.parametrize(
    "text",
    [
        *(pattern for _, _, pattern in QUESTIONS),
        "MATCH (e:Ego), (v:Vehicle) WHERE lead(e, v) AND headway(e, v) < 1.5",
        "MATCH (e:Ego), (v:Vehicle) WHERE ttc(e, v) < 3 AND NOT same_lane(e, v)",
        "MATCH (p:Person)-[r:isIn]->(c:Crosswalk)",
        "MATCH (e:Ego) WHERE in_junction(e) OR red_for(e)",
        "MATCH (a:Car)-[d:near|very_near]->(b:Person) WHERE abs(rel_heading(a, b)) > 60",
    ],
)
def test_stored_graph_in_memory_equals_sql(
    town: Store, scenes: list[tuple[FrameRef, SceneGraph]], text: str
) -> None:
    matches = town.find(text)
    bound = compile_query(text, town.catalog()).bound
    matcher = Matcher(bound)

    for frame, scene in scenes:
        here = [match.nodes for match in matcher.matches(FrameView(scene, {"t": frame.t}))]
        there = [{name: row[name] for name in row} for row in matches.bindings(frame)]
        assert _sorted(here) == _sorted(there), frame


def _sorted(rows: list[Any]) -> list[list[tuple[str, int]]]:
    return sorted(
        sorted(dict(row).items()) for row in {tuple(sorted(r.items())): r for r in rows}.values()
    )


def test_frame_class_is_computed_once_and_only_if_used() -> None:
    asked: list[str] = []

    def classes(name: str) -> str:
        asked.append(name)
        return f"of {name}"

    nodes = {n: {"kind": "car", "is_ego": n == 0} for n in range(4)}
    view = FrameView(SceneGraph(1, "t", 0, 0, 0, nodes, []), classes=classes)

    def count(condition: str, of: FrameView) -> int:
        query = compile_query(f"MATCH (c:Car) WHERE {condition}", Catalog(classed=("E", "RSV")))
        return sum(1 for _ in Matcher(query.bound).matches(of))

    assert count("c.is_ego OR NOT c.is_ego", view) == 4
    assert asked == []
    assert count("frame.class = 'of RSV'", view) == 4
    assert count("frame.class('E') = 'of RSV'", view) == 0
    assert asked == ["RSV", "E"]
    assert count("frame.class IS NULL", FrameView(view.graph)) == 4


@pytest.mark.parametrize("shape", ["1 / ({} + 1)", "7 % ({} + 1)", "sqrt({} + 1)", "pow({}, 1)"])
def test_nested_operators_are_planned_together(town: Store, shape: str) -> None:
    deep, of_nothing = "e.speed", "e.speed * 0 - 1"
    for _ in range(16):
        deep, of_nothing = shape.format(deep), shape.format(of_nothing)

    # Of an operator that named its operand twice the statement would be 65,536 times as long.
    asked = f"MATCH (e:Ego) WHERE frame.seq = 200 RETURN e.speed AS v, {deep} AS deep, {of_nothing} AS n"
    ((speed, found, nothing),) = town.find(asked).rows()

    speed = float(np.float32(speed))  # the result is the shortest text of it
    for _ in range(16):
        speed = eval(shape.format("speed"), {"speed": speed, "sqrt": math.sqrt, "pow": pow})
    assert found == pytest.approx(speed)
    assert (nothing is None) == ("/" in shape or "%" in shape)


def test_matches_have_a_number_indices_and_slices(open_town: Store) -> None:
    matches = open_town.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)")
    rows = matches.rows()

    assert len(matches) == len(rows) > 100
    assert list(matches) == rows
    assert (matches[3], matches[-1], matches[2:9:3]) == (rows[3], rows[-1], rows[2:9:3])
    assert (matches[-4:], matches.head(2), matches[:0]) == (rows[-4:], rows[:2], [])
    with pytest.raises(IndexError):
        matches[len(rows)]
    assert matches
    assert not open_town.find("MATCH (e:Ego) WHERE e.speed > 99")
