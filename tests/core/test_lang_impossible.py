"""Patterns and conditions that no recording can have, and scenes that a store does not contain."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from query_mutants import measured

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import QueryError
from sgstore.lang.catalog import TraceFacts
from sgstore.lang.sql import compile_checks, compile_query
from sgstore.model.vocabulary import OWN_RELATIONS, RELATION_ENDS, RELATIONS

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

IMPOSSIBLE = {
    "(e:Ego)-[:isIn]->(:Junction)": "write (e:Ego)-[:isIn*3]->(:Junction)",
    "(l:Lane)-[:isIn]->(v:Vehicle)": "write (l:Lane)<-[:isIn]-(v:Vehicle)",
    "(l:Lane)-[:controlsTrafficOf]->(:TrafficLight)": "<-[:controlsTrafficOf]-",
    "(l:Lane)-[:sees]->(ego)": "entity to entity",
    "(v:Vehicle)-[:near]->(l:Lane)": "-[:isIn]->",
    "(v)-[:near]->(x)-[:isIn]->(:Road)": "write (x)-[:isIn*2]->(:Road)",
    "(p:Person)-[:leads]->(v:Car)": "vehicle to vehicle",
    "(v:Car)-[:near|isIn|visible]-(:Junction)": "no relation joins",
    "(a:Car)-[:near]->(a)": "two variables",
    "(v:Vehicle WHERE v.heading > 200)": "write -160",
    "(v:Vehicle WHERE v.kind = 'person')": "write (x:Person)",
    "(v:Vehicle WHERE v.brake > 50)": "write 0.5 for 50 %",
    "(v:Vehicle WHERE env.temperature < 20)": "write 293.15 for 20 °C",
    "(v:Vehicle WHERE v.speed < -1)": "at least 0",
    "(v:Vehicle WHERE v.speed IN [-1, -2])": "at least 0",
    "(v:Vehicle WHERE 300 < abs(bearing(ego, v)))": "between 0 and 180",
}
FAULTLESS = (
    "(e:Ego)-[:isIn*3]->(:Junction)",
    "(a:Vehicle)-[:near*1..3]->(b)",
    "(l:Lane)-[:travelsTo*1..3]->(m:Lane)",
    "(v:Vehicle WHERE v.speed < 0 OR v.brake > 1)",
    "(l:Lane)-[:toLeftOf]->(m), (v)-[:toLeftOf]->(w:Car)",
)


@pytest.mark.parametrize("pattern", IMPOSSIBLE)
def test_every_way_rejects_what_no_recording_has(pattern: str, open_town: Store) -> None:
    texts = (
        f"MATCH {pattern}",
        f"MATCH (f:Person) WHERE NOT EXISTS {{{pattern}}}",
        f"MATCH (f:Person) THEN WITHIN 2s MATCH {pattern}",
    )
    check = f"CHECK FORALL (z:Person) ALWAYS NOT EXISTS {{{pattern}}}"
    frame = next(open_town.find("MATCH (e:Ego)").frames())
    ways = [lambda text=text: open_town.find(text) for text in texts]
    ways += [
        lambda: open_town.check(check),
        lambda: sgstore.Monitor(check),
        lambda: sgstore.Monitor(texts[0]),
        lambda: open_town.why_not(frame, texts[0]),
    ]
    for way in ways:
        with pytest.raises(QueryError) as raised:
            way()
        assert IMPOSSIBLE[pattern] in (raised.value.hint or "")


@pytest.mark.parametrize("pattern", FAULTLESS)
def test_what_a_recording_can_have_stays(pattern: str, open_town: Store) -> None:
    open_town.find(f"MATCH {pattern}")
    sgstore.Monitor(f"MATCH {pattern}")


def test_graphs_of_other_tools_get_a_note(open_town: Store) -> None:
    catalog = open_town.catalog()
    imported = TraceFacts(1, "graphs", "", frozenset(RELATIONS))
    named = {"kind": (), "relation": ("watches",), "light_state": ()}
    for other in (replace(catalog, traces=(imported,)), replace(catalog, names=named)):
        for pattern, hint in IMPOSSIBLE.items():
            (doubt, *_) = compile_query(f"MATCH {pattern}", other).bound.doubts
            assert hint in doubt
            (one,) = compile_checks(f"CHECK ALWAYS NOT EXISTS {{{pattern}}}", other)
            assert one.check.doubts
    with pytest.raises(QueryError):
        compile_query("MATCH (e:Ego)-[:isIn]->(:Junction)", catalog)


def test_a_condition_that_always_holds_gets_a_note(open_town: Store) -> None:
    for text in ("e.heading < 200", "e.brake < 50", "e.kind <> 'lane'"):
        (note,) = open_town.find(f"MATCH (e:Ego) WHERE {text}").notes
        assert note.startswith(f"{text} always holds")
    assert open_town.find("MATCH (e:Ego) WHERE e.speed >= 0").notes == ()


def test_a_predicate_for_many_kinds_stays(open_town: Store) -> None:
    text = "DEFINE PREDICATE held(x) AS EXISTS {(x)-[:isIn]->(:Lane)} OR x.kind = 'lane';"
    assert open_town.find(f"{text} MATCH (v:Ego) WHERE held(v)").notes
    assert open_town.find("MATCH (e:Ego) WHERE in_junction(e)").notes == ()


def test_a_scene_that_the_store_never_contains_gets_a_note(
    open_town: Store, town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = {
        "MATCH (e:Ego)-[:near]->(v:Train)": "no frame of the store has (v:Train)",
        "MATCH (e:Ego) WHERE e.speed > 90": "no frame of the store has e.speed > 90",
        "MATCH (e:Ego) THEN MATCH (v:Vehicle WHERE v.length > 400)": "no frame of the store has v.length > 400",
    }
    for text, note in notes.items():
        for read in (list, lambda matches: matches.count(), lambda matches: None):
            matches = open_town.find(text)
            read(matches)
            assert matches.notes == (note,)
        assert run(["find", str(town_store), text]) == 0
        assert f"note: {note}" in capsys.readouterr().err
    assert open_town.find("MATCH (e:Ego) WHERE e.speed > 1").notes == ()


NEAREST = {
    "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE e.speed > 60": (
        "SELECT MAX(n.speed) FROM nodes n WHERE n.is_ego AND n.frame_id IN"
        " (SELECT frame_id FROM edges WHERE relation = 'near' AND src_is_ego AND dst_kind IN"
        " ('car', 'van', 'truck', 'bus', 'bicycle', 'motorcycle', 'trailer', 'vehicle'))",
        "e.speed",
    ),
    "USING NODES any MATCH (p:Person) WHERE -0.5 > p.speed - 2 AND 90 < p.speed": (
        "SELECT MAX(speed) FROM nodes WHERE kind = 'person' AND speed < 1.5",
        "p.speed",
    ),
    "MATCH (e:Ego) THEN MATCH (e:Ego) WHERE e.speed < 3 AND e.speed > 4": (
        "SELECT MAX(speed) FROM nodes WHERE is_ego AND speed < 3",
        "e.speed",
    ),
}


@pytest.mark.parametrize("text", NEAREST)
def test_nearest_frame_of_a_pattern_without_matches(open_town: Store, text: str) -> None:
    """The values of all frames in SQL have the same extreme, in the frame of the answer."""
    sql, value = NEAREST[text]
    near = open_town.find(text).nearest()
    (extreme,) = open_town.sql(sql).values[0]

    assert near["found"] == f"{value} = {extreme:.4g}"
    shown = open_town.why_not(f"{near['trace']}#{near['seq']}", text)
    assert near["failed"] in str(shown)


def test_the_nearest_frame_has_the_settings_of_the_query(open_town: Store) -> None:
    fast = "MATCH (v:Vehicle) WHERE v.speed > 99"
    world = open_town.find(f"USING SCOPE world {fast}").nearest()
    listed = open_town.find(f"USING NODES any, SCOPE $scope {fast}", scope="world")

    assert listed.nearest() == world != open_town.find(fast).nearest()
    quoted = open_town.find(f"{fast} AND v.name <> 'USING SCOPE world'")
    assert quoted.nearest() == open_town.find(fast).nearest()


def test_a_part_that_occurs_alone_is_told_with_the_others(open_town: Store) -> None:
    text = (
        "MATCH (:Person)-[:near]->(:Ego) WHERE EXISTS {(:Truck)-[:near_coll]->(:Ego)} RETURN FRAMES"
    )
    near = open_town.find(text).nearest()
    assert near["failed"] == "EXISTS {(truck:Truck), (any2:Ego), (truck)-[:near_coll]->(any2)}"
    assert near["others"] == ["(person:Person)-[:near]->(any:Ego)"]
    frame = f"frame.seq = {near['seq']} AND trace.name = '{near['trace']}'"
    assert open_town.find(f"MATCH (:Person)-[:near]->(:Ego) WHERE {frame}").count() == 1
    assert open_town.find("MATCH (:Truck)-[:near_coll]->(:Ego)").count() > 0


def test_the_part_is_told_as_it_is_written(open_town: Store) -> None:
    """The nearest frame is that of the first false part of the definition."""
    define = "DEFINE meets(a, c) AS a.speed > 3 AND dist(a, c) < 0.5;"
    near = open_town.find(f"{define} MATCH (e:Ego), (v:Vehicle) WHERE meets(e, v)").nearest()
    plain = "MATCH (e:Ego), (v:Vehicle) WHERE e.speed > 3 AND dist(e, v) < 0.5"

    assert near.pop("failed") == "meets(e, v)"
    other = open_town.find(plain).nearest()
    assert (near["seq"], near["found"]) == (other["seq"], other["found"])


def test_parts_without_a_value_have_no_nearest_frame(open_town: Store) -> None:
    train = open_town.find("MATCH (e:Ego)-[:near]->(v:Train)").nearest()
    assert train == {"failed": "(v:Train)"}
    assert open_town.find("MATCH (e:Ego) WHERE e.speed > 1").nearest() == {}
    union = "MATCH (v:Train) UNION MATCH (v:Vehicle) WHERE v.speed > 99"
    assert open_town.find(union).nearest() == {"failed": "(v:Train)"}


def test_every_stored_edge_has_known_ends(open_town: Store) -> None:
    for relation, src, dst in {**open_town.catalog().edges, **open_town.catalog().map_edges}:
        kinds = f"a.kind = '{src}' AND b.kind = '{dst}'"
        compile_query(f"MATCH (a)-[:{relation}]->(b) WHERE {kinds}", open_town.catalog())
    assert set(RELATION_ENDS) == set(OWN_RELATIONS)


def test_mutants_of_correct_queries_are_reported(open_town: Store) -> None:
    figures = measured([open_town], 40, 40, 3)

    assert figures.reported.total() >= 0.95 * (figures.reported.total() + len(figures.silent))
    assert not figures.noted
