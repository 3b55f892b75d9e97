"""Compiled queries against exhaustive search over networkx graphs, on random worlds and patterns."""

from __future__ import annotations

import pytest
from oracle import disagreement, disagreement_of_results, tried, try_many
from oracle_worlds import World, random_world
from thorough import LONG

pytestmark = pytest.mark.seconds(8)


@pytest.mark.parametrize("first", [0, 100, 200] if LONG else [0])
def test_random_patterns_equal_exhaustive_search(first: int) -> None:
    seen = try_many(first, 100)

    assert seen["tried"] > 80
    assert seen["matched"] > 20


def test_several_processes_try_the_same_patterns(capsys: pytest.CaptureFixture[str]) -> None:
    count = 60 if LONG else 30
    seen = tried(0, count, jobs=2)

    assert seen["tried"] + seen["refused"] == count
    assert seen == tried(0, count, jobs=1)
    assert capsys.readouterr().out.count(f"{count}/{count}") == 2


@pytest.fixture(scope="module", params=[1, 2], ids=["moving only", "static too"])
def world(request: pytest.FixtureRequest) -> World:
    return random_world(request.param, frames=20, static=request.param == 2)


FOUND: dict[str, int] = {}
QUERIES = [
    pytest.param("MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v)", id="two in one lane"),
    pytest.param("MATCH (a:Vehicle)-[:near]->(b)-[:near]->(c)", id="three that differ"),
    pytest.param(
        "USING NODES any MATCH (a:Vehicle)-[:near]->(b)-[:near]->(c)", id="that may coincide"
    ),
    pytest.param("MATCH (a)-[:near|visible]-(b:Person)", id="either way"),
    pytest.param("MATCH (a)-[d]->(b:Lane)", id="any relation"),
    pytest.param("MATCH (a)-[:isIn*1..3]->(b)", id="one to three edges"),
    pytest.param("MATCH (a:Lane)-[:travelsTo*3]->(b:Lane)", id="three edges, no node twice"),
    pytest.param(
        "USING NODES any MATCH (a:Lane)-[:travelsTo*3]->(b:Lane)", id="three edges of a circle"
    ),
    pytest.param(
        "MATCH (s)-[:controlsTrafficOf]->(l:Lane)<-[:isIn]-(v)", id="signals that move or stand"
    ),
    pytest.param("MATCH (a:Car) WHERE NOT EXISTS {(a)-[:near]->()}", id="no such edge"),
    pytest.param("MATCH (a:Car) WHERE NOT EXISTS {(b:Person)}", id="no such node at all"),
    pytest.param("MATCH (e:Ego) WHERE COUNT {(e)-[:isIn]->(:Lane)} > 1", id="counted"),
    pytest.param(
        "MATCH (a:Lane) WHERE COUNT {(a)<-[:isIn]-(b)} = COUNT {(a)-[:opposes]-(b)}",
        id="two counts",
    ),
    pytest.param(
        "MATCH (a) WHERE EXISTS {(a)-[:near]->(b) WHERE NOT EXISTS {(b)-[:near]->(c) WHERE c.x > a.x}}",
        id="a block in a block speaks of the outermost node",
    ),
    pytest.param("MATCH (a:Car) WHERE a.speed > 1 OR NOT a.length < 3", id="unknown or not"),
    pytest.param(
        "MATCH (a)-[:near]->(b) WHERE a.speed > b.speed XOR a.width = b.width", id="unknown xor"
    ),
    pytest.param("MATCH (e:Ego), (v) WHERE dist(e, v) < 6", id="near by distance"),
    pytest.param(
        "MATCH (a), (b:Car) WHERE lon(a, b) > 3 AND abs(lat(a, b)) < 4", id="ahead by offsets"
    ),
    pytest.param(
        "MATCH (v)-[r:isIn {primary: TRUE}]->(l) WHERE r.overlap >= 0.5 OR r.offset > 0", id="lanes"
    ),
    pytest.param("MATCH (a)-[r:follows]->(b) WHERE r.gap < 5", id="who follows closely"),
    pytest.param("MATCH (a)-[r:leads {gap: 3.0}]->(b:Car)", id="who leads at a distance"),
    pytest.param(
        "MATCH (a:Car)<-[r:leads]-(b)-[q:follows]->(c) WHERE r.gap + q.gap < dist(a, c)",
        id="gaps and distances",
    ),
    pytest.param(
        "MATCH (a), (b:Car) WHERE cos(radians(a.heading)) * pow(b.x - a.x, 2) > 3 * log(a.y)"
        " AND b.speed IS KNOWN",
        id="functions of numbers",
    ),
    pytest.param(
        "MATCH (a), (b:Car) WHERE degrees(atan2(b.y - a.y, b.x - a.x)) > 30 AND sign(tan(a.y)) < exp(-b.x)",
        id="angles of directions",
    ),
    pytest.param("MATCH (a)-[:leads]-(b) WHERE a.speed > 1", id="who leads or is led"),
    pytest.param("MATCH (a:Car) WHERE MIN {(a)-[:near]->(b) | b.x} < a.x", id="least of a block"),
    pytest.param("MATCH (a) WHERE SUM {(a)-[:near]-(b) | b.speed} >= 10", id="sum of a block"),
    pytest.param("MATCH (v:Vehicle) WHERE v.light_left OR v.light_right", id="lights"),
    pytest.param("MATCH (t:TrafficLight {light_state: 'RED'})", id="in any case"),
    pytest.param(
        "MATCH (n) WHERE n.special IN ['taxi', 'Emergency']", id="words of a vocabulary in a list"
    ),
    pytest.param("MATCH (a:Car), (b:Lane) WHERE ego.id <> a.id", id="the ego without a pattern"),
    pytest.param("MATCH (:Car)-[:near]->(:Person)", id="no names at all"),
    pytest.param("MATCH (a), (A:Car) WHERE a.x = A.x", id="names that differ in case"),
    pytest.param(
        "MATCH (mask:Car)-[:near]->(bucket) WHERE mask.x < bucket.x", id="names of columns"
    ),
    pytest.param("USING UNKNOWN false MATCH (a:Lane)-[:travelsTo]->(b)", id="unknown is false"),
    pytest.param("USING EGO 'hero2' MATCH (e:Ego)-[:near]->(v)", id="one of two egos"),
    pytest.param(
        "USING EGO 'hero1' MATCH (e:Ego) WHERE COUNT {(e)-[:near|visible]-(b)} >= 1",
        id="counted around one of two egos",
    ),
    pytest.param(
        "USING EGO 'hero2' MATCH (l:Lane) WHERE COUNT {(b:Car)} >= 2", id="counted of one's frames"
    ),
    pytest.param(
        "USING EGO 'hero1' MATCH (a:Car) WHERE COUNT {(b:Vehicle) WHERE b.x > a.x} = 0",
        id="counted by values in the frames of one of two egos",
    ),
    pytest.param(
        "USING EGO 'hero1' MATCH (a) WHERE NOT EXISTS {(b:Person)} AND COUNT {(c:Car)} < 2",
        id="few in the frames of one of two egos",
    ),
]


@pytest.mark.parametrize("text", QUERIES)
def test_queries_equal_exhaustive_search(text: str, world: World) -> None:
    problem, frames = disagreement(text, world)

    assert problem == ""
    FOUND[text] = FOUND.get(text, 0) + frames


@pytest.mark.parametrize("returned", ["ego.x", "COUNT(ego.speed), MAX(ego.x)", "ego.id, COUNT(*)"])
@pytest.mark.parametrize(
    "text",
    [
        "MATCH (:Ego)-[:near|visible]->()",
        "MATCH ()<-[:near]-(:Ego&Vehicle)",
        "MATCH (:Lane), (:Ego)",
        "MATCH (e:Ego)-[:near]-(), (e)-[:isIn]->()",
        "MATCH (e:Ego)-[:near]->(), (e)",
        "MATCH ()-[:near]->(:Entity)",
        "MATCH (a:Car) WHERE EXISTS {(:Ego)-[:near]-(a)}",
        "MATCH (a:Car) WHERE NOT EXISTS {(:Lane)<-[:isIn]-(a), (ego)}",
    ],
)
def test_ego_after_return_is_the_labelled_node(text: str, returned: str, world: World) -> None:
    problem, rows = disagreement_of_results(f"{text} RETURN {returned}", world)

    assert problem == ""
    assert rows


def test_most_queries_have_matches() -> None:
    assert sum(frames > 0 for frames in FOUND.values()) >= len(FOUND) - 2
