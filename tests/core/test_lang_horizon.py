"""How far a check looks around the ego, told from its text."""

from __future__ import annotations

import math

import pytest
from knowledge import car, frame_of

from sgstore.errors import QueryError
from sgstore.lang import ir
from sgstore.lang.bind import Horizon, horizon
from sgstore.lang.catalog import Catalog
from sgstore.lang.sql import compile_checks, compile_query
from sgstore.model.config import Config, RangeSettings
from sgstore.temporal import Monitor


def looked(text: str, speed: float = 30.0) -> Horizon:
    (found,) = compile_checks(text, Catalog())
    return horizon(found.check, speed)


@pytest.mark.parametrize(
    ("formula", "metres"),
    [
        ("ALWAYS NOT dist(ego, v) < 5", 5),
        ("ALWAYS dist(ego, v) >= 7", 7),
        ("ALWAYS 7 <= dist(ego, v)", 7),
        ("ALWAYS (dist(ego, v) > 4 OR dist(ego, v) > 9)", 4),
        ("ALWAYS (dist(ego, v) > 4 AND dist(ego, v) > 9)", 9),
        ("ALWAYS (dist(ego, v) < 20 IMPLIES v.speed < 8)", 20),
        ("ALWAYS NOT (v.speed > 8 AND dist(ego, v) < 12)", 12),
        ("ALWAYS NOT dist(ego, v) < 2 * ego.speed", 60),
        ("ALWAYS NOT dist(ego, v) < max(3, ego.speed / 2 + 1)", 16),
        ("ALWAYS NOT gap(ego, v) <= 0", 10),
        ("ALWAYS NOT ttc(ego, v) < 2", 2 * 2 * 30 + 10),
        ("ALWAYS NOT headway(ego, v) < 1", 30 + 10),
        ("ALWAYS NOT EXISTS {(ego)-[:near]->(v)}", 35),
        ("ALWAYS (lead(ego, v) IMPLIES v.speed > 3)", 110),
        ("ALWAYS (same_lane(ego, v) IMPLIES lon_gap(ego, v) > 3 * ego.speed)", 3 * 30 + 10),
        ("ALWAYS (lon_gap(ego, v) > 3 * ego.speed)", math.inf),
        ("ALWAYS NOT run_length(dist(ego, v) < 6) >= 3frames", 6),
        ("ALWAYS NOT ONCE dist(ego, v) < 6", 6),
        ("ALWAYS NOT HISTORICALLY[0s, 2s] dist(ego, v) < 6", 6),
        ("ALWAYS NOT HISTORICALLY[1s, 2s] dist(ego, v) < 6", math.inf),
        ("ALWAYS EVENTUALLY[1s, 2s] dist(ego, v) > 6", math.inf),
        ("ALWAYS NOT NEXT dist(ego, v) < 6", 6),
        ("ALWAYS NEXT dist(ego, v) > 6", math.inf),
        ("ALWAYS (NEXT v.speed > 3 IMPLIES NEXT dist(ego, v) > 6)", 6),
        ("ALWAYS run_length(dist(ego, v) > 6) >= 3frames", math.inf),
        ("ALWAYS v.speed < 50", math.inf),
        ("ALWAYS NOT same_lane(ego, v)", math.inf),
    ],
)
def test_horizon_of_quantified_entities(formula: str, metres: float) -> None:
    assert looked(f"CHECK FORALL (v:Vehicle) {formula}") == Horizon(metres, 0)


@pytest.mark.parametrize(
    ("text", "true", "false"),
    [
        ("CHECK ALWAYS ego.speed < 20", 0, 0),
        ("CHECK FORSOME (v:Vehicle) EVENTUALLY dist(ego, v) < 5", 0, 5),
        ("CHECK ALWAYS EXISTS {(v:Vehicle) WHERE dist(ego, v) < 30}", 0, 30),
        ("CHECK ALWAYS NOT EXISTS {(v:Vehicle) WHERE dist(ego, v) < 30}", 30, 0),
        (
            "CHECK ALWAYS (stopped(ego) IMPLIES EXISTS {(v:Vehicle) WHERE same_lane(ego, v)})",
            0,
            math.inf,
        ),
        ("CHECK ALWAYS COUNT {(v:Vehicle) WHERE dist(ego, v) < 30} >= 2", 0, 30),
        ("CHECK ALWAYS COUNT {(v:Vehicle) WHERE dist(ego, v) < 30} < 2", 30, 0),
        ("CHECK ALWAYS MIN {(v:Vehicle) WHERE dist(ego, v) < 30 | v.speed} < 2", 30, 30),
        ("CHECK ALWAYS NOT red_for(ego)", 200, 0),
        ("CHECK ALWAYS (stopped(ego) IMPLIES red_for(ego))", 0, 200),
        ("CHECK ALWAYS NOT EXISTS {(l:Lane) WHERE red_ahead(l)}", math.inf, 0),
        ("USING RANGE 80 CHECK FORALL (v:Vehicle) ALWAYS v.speed < 50", 80, 0),
        ("USING RANGE 80 CHECK FORALL (v:Vehicle) ALWAYS dist(ego, v) > 5", 5, 0),
    ],
)
def test_missing_entities_affect_only_one_verdict(text: str, true: float, false: float) -> None:
    assert looked(text) == Horizon(true, false)


def test_safe_distance_grows_with_greatest_speed() -> None:
    text = "CHECK FORALL (v:Vehicle) ALWAYS NOT rss_margin(ego, v) < 0"
    slow, fast = looked(text, 10.0).true, looked(text, 33.0).true
    assert 50 < slow < 133 < fast < 500


@pytest.mark.parametrize(
    ("check", "places", "verdict", "reason"),
    [
        ("FORALL (v:Vehicle) ALWAYS dist(ego, v) > 119.2", (12, 300), "false", ""),
        (
            "FORALL (v:Vehicle) ALWAYS dist(ego, v) > 119.2",
            (300,),
            "unknown",
            "it depends on 120 m around the ego, but the trace covers 50 m",
        ),
        (
            "ALWAYS EXISTS {(v:Vehicle) WHERE v.speed > 70}",
            (300,),
            "unknown",
            "it depends on everything around the ego, but the trace covers 50 m",
        ),
    ],
)
def test_reason_names_needed_and_known_range(
    check: str, places: tuple[float, ...], verdict: str, reason: str
) -> None:
    near = Config(range=RangeSettings(radius=20, world=50))
    monitor = Monitor(f"CHECK {check}", config=near)
    monitor.step(frame_of(0, [car("ego", 0), *(car(f"v{x}", x) for x in places)]))

    (found,) = monitor.finish()

    assert (found.verdict, found.reason) == (verdict, reason)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("USING SCOPE roads MATCH (e:Ego)", "unknown value of SCOPE 'roads'"),
        ("USING RANGE 50 MATCH (e:Ego)", "USING RANGE is allowed only in a CHECK"),
    ],
)
def test_invalid_settings_are_refused(text: str, said: str) -> None:
    with pytest.raises(QueryError, match=said):
        compile_query(text, Catalog())


@pytest.mark.parametrize("said", ["far", "-3"])
def test_range_is_a_distance(said: str) -> None:
    with pytest.raises(QueryError, match="is not a distance"):
        looked(f"USING RANGE '{said}' CHECK ALWAYS ego.speed < 3")


def test_pattern_uses_graph_and_check_uses_world() -> None:
    assert not compile_query("MATCH (e:Ego)", Catalog()).bound.world
    assert compile_query("USING SCOPE world MATCH (e:Ego)", Catalog()).bound.world
    for setting, world in (("", True), ("USING SCOPE world", True), ("USING SCOPE graph", False)):
        (found,) = compile_checks(f"{setting} CHECK ALWAYS ego.speed < 3", Catalog())
        assert found.check.world is world


def test_edges_in_braces_use_all_known_data() -> None:
    text = "MATCH (e:Ego)-[:near]->(v:Car) WHERE EXISTS {(v)-[:isIn]->(:Lane)} AND lead(e, v)"
    scope = compile_query(text, Catalog()).bound.scope
    blocks = [block.scope.edges for one in scope.where for block in ir.blocks_of(one)]
    edges = (*scope.edges, *(edge for found in blocks for edge in found))
    known = {next(iter(edge.relations)): edge.known for edge in edges}
    assert known == {"near": False, "isIn": True, "leads": True}
