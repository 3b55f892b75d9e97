"""Variables of one part of a query: new in each repetition, and different from those of other parts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import sgstore

if TYPE_CHECKING:
    from sgstore.query import Store

CLOSE = "MATCH (e:Ego)-[:near_coll]->({0}:Vehicle) THEN WITHIN 10s MATCH (e)-[:very_near]->({0})"
BUS = "MATCH (v:Bus)"


def rows(text: str, store: Store) -> list[tuple[Any, ...]]:
    return sorted({tuple(row) for row in store.find(text).rows()})


def test_a_variable_of_a_repetition_is_new_in_each(open_town: Store) -> None:
    twice = f"USING NODES any ({CLOSE.format('v')}){{2}} RETURN INTERVALS"
    written = f"USING NODES any {CLOSE.format('v')} THEN {CLOSE.format('w')} RETURN INTERVALS"

    assert rows(twice, open_town)
    assert rows(twice, open_town) == rows(written, open_town)
    own = twice.replace("USING NODES any ", "")  # the rounds can be about one vehicle
    assert rows(own, open_town) == rows(written, open_town)


def test_a_variable_that_occurs_outside_is_the_same_in_each(open_town: Store) -> None:
    group = f"({CLOSE.format('v')}){{2}}"
    written = f"{CLOSE.format('v')} THEN {CLOSE.format('v')}"
    for end in ("RETURN INTERVALS, v.name", "THEN MATCH (v) WHERE v.speed >= 0 RETURN INTERVALS"):
        assert rows(f"{group} {end}", open_town) == rows(f"{written} {end}", open_town)
    assert open_town.find(f"{group} RETURN INTERVALS, v.name").count() == 0


@pytest.mark.parametrize(("ends", "many"), [("", 1), (" THEN MATCH (v:Car)", 0)])
def test_a_monitor_takes_a_new_one_in_each(ends: str, many: int) -> None:
    one = "MATCH (e:Ego), (v:Car) WHERE dist(e, v) < 5 THEN MATCH (e), (v) WHERE dist(e, v) > 8"
    monitor = sgstore.Monitor(f"({one}){{2}}{ends}")
    events = []
    for second, (a, b) in enumerate([(3, 9), (9, 9), (9, 3), (9, 9), (9, 9)]):
        frame = sgstore.Frame(second * 100_000_000, ego="hero")
        frame.add("hero", "truck", 0, 0, vx=1, vy=0)
        frame.add("a", "car", a, 0, vx=1, vy=0)
        frame.add("b", "car", 0, b, vx=1, vy=0)
        events += monitor.step(frame)
    events += monitor.finish()

    assert len(events) == many


@pytest.mark.parametrize(
    ("text", "many"),
    [
        (f"{BUS} OPTIONAL MATCH (w:Bus) RETURN COUNT(w) AS n", 0),
        (f"{BUS} WITH v MATCH (w:Bus) RETURN COUNT(w) AS n", 0),
        (f"{BUS} WITH v AS u OPTIONAL MATCH (w:Bus) RETURN COUNT(w) AS n", 0),
        (f"USING NODES any {BUS} OPTIONAL MATCH (w:Bus) RETURN COUNT(w) AS n", 466),
        (f"{BUS} WITH COUNT(v) AS buses MATCH (w:Bus) RETURN COUNT(w) AS n", 466),
        (f"{BUS} OPTIONAL MATCH (p:Train) MATCH (w:Person) RETURN COUNT(DISTINCT v) AS n", 1),
        ("MATCH (e:Ego) OPTIONAL MATCH (:Ego)-[:isIn]->(l:Lane) RETURN COUNT(DISTINCT e) AS n", 1),
    ],
)
def test_variables_of_all_parts_are_different_things(
    text: str, many: int, open_town: Store
) -> None:
    assert rows(text, open_town) == [(many,)]
