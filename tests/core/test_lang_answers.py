"""What a trace can answer, and what of a pair: no edge where one was looked for, and where none was."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from scenes import Scene, actor, along, cone, ego, light, store_of, street

from sgstore.graphs.online import Replay
from sgstore.lang.catalog import Catalog, RelationScope, TraceFacts, Type
from sgstore.lang.ir import Value
from sgstore.lang.sql import compile_query
from sgstore.model.config import Config, PairSettings, Proximity
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store

ROAD = street("driving", "driving", left=("driving",))
PEOPLE = (
    ego(along(-1.75), 10),
    actor("near", along(-5.25, 4), 9),
    actor("far", along(1.75, 38), 3, kind="truck"),
    actor("walker", along(6, 12), 1, kind="person"),
    actor("parked", ((20.0, 9.0),), 0, kind="van"),
    light("light", (25, 8), (0.0, "red")),
    cone("cone", (22, 8)),
    cone("other cone", (23, 8)),
)


def scene(road: Any = ROAD) -> Scene:
    return Scene(road, *PEOPLE, seconds=1.0)


@pytest.fixture(scope="module")
def lanes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    path = tmp_path_factory.mktemp("lanes") / "lanes.sgstore"
    bare = Scene(None, *PEOPLE[:2], seconds=1.0)  # type: ignore[arg-type]
    store = store_of(path, {"street": [scene(street("driving"))], "nowhere": [bare]})
    with store.file.snapshot():
        yield store


@pytest.mark.parametrize("relation", ["laneChange", "conflictsWith", "controlsTrafficOf"])
def test_edge_absent_from_map_is_false(lanes: Store, relation: str) -> None:
    some = lanes.find(f"MATCH (:Lane|Signal)-[:{relation}]-(:Lane)")
    none = lanes.find(
        f"MATCH (e:Ego) WHERE NOT EXISTS {{(:Lane|Signal)-[:{relation}]-(:Lane)}} RETURN FRAMES"
    )

    assert some.count() == 0
    assert none.count() == 6
    assert {row[1] for row in none.rows()} == {"street"}
    assert some.left_out == none.left_out == ("nowhere",)


PAIRS = {
    "default": PairSettings(),
    "nobody but the ego": PairSettings(within=0),
    "nobody": PairSettings(within=0, ego=False),
    "without the ego": PairSettings(ego=False, within=12),
    "not far from the ego": PairSettings(within=9, ego_within=15),
    "what stands": PairSettings(static=True, within=8),
    "listed": PairSettings(kinds=(("Ego", "Person"), ("Vehicle", "Truck"))),
}
EVERYTHING = Proximity(("visible",), (100_000.0,))
"""A relation that holds for every pair that is related."""
MEASURES = ("centres", "origins", "footprints")
CONFIGS = {
    f"{name}, {between}": Config(pairs=pairs, proximity=replace(EVERYTHING, between=between))
    for number, (name, pairs) in enumerate(PAIRS.items())
    for between in (MEASURES if name == "default" else [MEASURES[number % 3]])
}


@pytest.fixture(scope="module")
def related(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    path = tmp_path_factory.mktemp("related") / "related.sgstore"
    store = store_of(path, {name: [scene()] for name in CONFIGS}, CONFIGS)
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def stated(related: Store) -> set[tuple[Any, ...]]:
    """Pairs that some relation holds of."""
    text = "USING UNKNOWN false MATCH (a)-[:visible]->(b) RETURN trace.name, frame.seq, a.id, b.id"
    return set(related.find(text).rows())


@pytest.fixture(scope="module")
def said(related: Store) -> dict[tuple[Any, ...], bool]:
    """What is said of each pair."""
    text = "MATCH (a:Entity), (b:Entity) RETURN trace.name, frame.seq, a.id, b.id, in_range(a, b)"
    return {row[:-1]: row[-1] for row in related.find(text).rows()}


@pytest.mark.parametrize("name", CONFIGS)
def test_in_range_pairs_are_the_related_pairs(
    name: str, stated: set[tuple[Any, ...]], said: dict[tuple[Any, ...], bool]
) -> None:
    of_it = {pair: found for pair, found in said.items() if pair[0] == name}

    assert of_it == {pair: pair in stated for pair in of_it}
    assert any(of_it.values()) == (not name.startswith("nobody,"))
    assert not all(of_it.values())


def test_missing_edge_in_range_is_false(related: Store) -> None:
    text = "MATCH (a:Car&!Ego), (b:Truck) WHERE trace.name = $name AND NOT EXISTS {(a)-[:visible]->(b)}"
    given = "default, centres"

    assert related.find(f"{text} RETURN FRAMES", name=given).count() > 0
    assert related.find(f"{text} AND in_range(a, b) RETURN FRAMES", name=given).count() == 0


def test_map_parts_are_not_in_range_pairs(related: Store) -> None:
    assert related.find("MATCH (e:Ego), (x) WHERE in_range(e, x) AND x.lane = 1").count() == 0


def test_in_range_is_unknown_for_unknown_settings() -> None:
    assert RelationScope.of({}) is None
    catalog = Catalog(traces=(TraceFacts(1, "imported", "", frozenset()),))
    query = compile_query("MATCH (a:Car), (b:Car) RETURN in_range(a, b)", catalog)
    (column,) = query.bound.result.columns
    assert column.value == Value(None, Type.boolean)


@pytest.mark.parametrize("name", [name for name in CONFIGS if not name.startswith("nobody,")])
def test_in_range_agrees_with_relations_online(name: str) -> None:
    pairs = "(a:Entity), (b:Entity) WHERE in_range(a, b)"
    checks = f"""
        CHECK said: ALWAYS NOT EXISTS {{{pairs} AND NOT EXISTS {{(a)-[:visible]->(b)}}}};
        CHECK stated: ALWAYS NOT EXISTS {{(a:Entity)-[:visible]->(b:Entity) WHERE NOT in_range(a, b)}};
        CHECK some: EVENTUALLY EXISTS {{{pairs}}}
    """
    monitor = Monitor(checks, ROAD, CONFIGS[name])
    for frame in Replay().frames(scene().block()):
        monitor.step(frame)

    found = {verdict.check: verdict.verdict for verdict in monitor.finish()}
    assert found == dict.fromkeys(("said", "stated", "some"), "true")
