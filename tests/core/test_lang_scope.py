"""``USING SCOPE``: what is known of the world beyond the graphs, in patterns, checks and rules."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import pytest
from scenes import (
    Scene,
    actor,
    along,
    crossroads,
    ego,
    light,
    path,
    seen_by,
    store_of,
    street,
    through,
)
from thorough import LONG
from thorough import some as some_of

from sgstore.apps.demo import RECORDING
from sgstore.graphs.online import replayed
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.lang.memory import Binding, ScopeSearch
from sgstore.lang.sql import compile_query
from sgstore.model.config import Config, RangeSettings
from sgstore.query import Store
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

pytestmark = pytest.mark.seconds(60)

WAYS: Final = street("driving", "driving")
"""Two lanes of one direction: y = -1.75 and -5.25."""
RIGHT, LEFT = -1.75, -5.25

FAST: Final = Scene(
    WAYS, ego(along(RIGHT), 33), actor("v", along(RIGHT), 33, start=64.5), seconds=4
)
BLOCKED: Final = Scene(
    WAYS, ego(along(RIGHT), 33), actor("v", (64.5, RIGHT), heading=0.0), seconds=0.4
)
STANDING: Final = Scene(
    WAYS,
    ego(along(RIGHT), [(0, 8), (2, 0), (8, 0)]),
    actor("v", (70, RIGHT), heading=0.0),
    actor("w", along(LEFT), 12, start=30),
)
SIGNALS: Final = Scene(
    crossroads("light"),
    ego(through("s", "n"), 8, start=20),
    actor("v", through("w", "e"), 8, start=70),
    actor("w", through("n", "s"), 8, start=90),
    light("light-s", (5.0, 12.5), (0, "red")),
    light("light-w", (12.5, 5.0), (0, "green")),
    seconds=10,
)
BENT: Final = Scene(
    WAYS,
    ego(along(RIGHT), 12),
    actor("v", path((0, LEFT), (90, LEFT), (130, RIGHT), (400, RIGHT)), 14, start=40),
    actor("w", along(RIGHT), 9, start=150),
    actor("u", along(LEFT), 20),
    seconds=10,
)
SCENES: Final = {
    "fast": [FAST],
    "blocked": [BLOCKED],
    "standing": [STANDING],
    "signals": [SIGNALS],
    "bent": [BENT],
}


def ranged(radius: float, world: float) -> Config:
    return Config(range=RangeSettings(radius=radius, world=world))


def stored(path: Path, radius: float, world: float) -> Store:
    config = ranged(radius, world)
    return store_of(path, SCENES, dict.fromkeys(SCENES, config))


def kept(store: Store) -> Iterator[Store]:
    """The store, open as long as it is asked: to open one takes longer than many an answer."""
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Graphs of 50 m, and the world out to 200 m."""
    yield from kept(stored(tmp_path_factory.mktemp("near") / "s.sgstore", 50, 200))


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Graphs of 50 m, and nothing else."""
    yield from kept(stored(tmp_path_factory.mktemp("alone") / "s.sgstore", 50, 0))


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Graphs of 200 m."""
    yield from kept(stored(tmp_path_factory.mktemp("wide") / "s.sgstore", 200, 0))


@cache
def verdicts(store: Store, text: str) -> dict[Any, Any]:
    """Verdict, first violation and witnesses of each trace; asked once of each store."""
    found: dict[Any, Any] = {}
    for one in store.check(text):
        first = one.first_violation
        witnesses = sorted(
            (tuple(w.nodes.items()), w.holds, tuple((i.start_seq, i.end_seq) for i in w.violations))
            for w in one.witnesses
        )
        found[one.check, one.trace] = (
            one.verdict,
            first and (first.start_seq, first.end_seq),
            witnesses,
        )
    return found


def verdict(store: Store, trace: str, text: str) -> str:
    name = text.partition("CHECK ")[2].partition(":")[0]
    return verdicts(store, text)[name, trace][0]


def in_graphs(rule: str) -> str:
    """A rule about graphs alone."""
    if rule.startswith("USING "):
        return rule.replace("USING ", "USING SCOPE graph, ", 1)
    return f"USING SCOPE graph {rule}"


@pytest.mark.parametrize(
    ("name", "trace"),
    [
        ("rss_distance", "fast"),
        ("rss_distance", "blocked"),
        ("r_g1_safe_distance", "blocked"),
    ],
)
def test_safe_distance_is_violated_60_m_ahead(near: Store, name: str, trace: str) -> None:
    (found,) = (one for one in near.check(patterns()[name].text) if one.trace == trace)
    assert found.verdict == "false"
    assert found.first_violation is not None
    assert found.first_violation.start_seq == 0
    graph = in_graphs(patterns()[name].text)
    (found,) = (one for one in near.check(graph) if one.trace == trace)
    assert found.first_violation is None or found.first_violation.start_seq > 0


def test_stop_behind_car_60_m_ahead_is_allowed(near: Store) -> None:
    text = patterns()["r_i1_stopping"].text
    assert verdict(near, "standing", text) == "true"
    graph = in_graphs(text)
    assert verdict(near, "standing", graph) == "false"


CHECKS: Final = sorted(one.name for one in patterns().values() if one.is_check)


@pytest.mark.parametrize("name", some_of(CHECKS, 5))
def test_rules_in_world_equal_wider_graph(near: Store, wide: Store, name: str) -> None:
    text = patterns()[name].text
    assert verdicts(near, text) == verdicts(wide, text)


ASKED: Final = (
    "(v:Vehicle) WHERE dist(ego, v) > 55",
    "(e:Ego), (v:Vehicle) WHERE lead(e, v)",
    "(e:Ego), (v:Vehicle) WHERE same_lane(e, v)",
    "(v:Vehicle), (w:Vehicle) WHERE lead(v, w) AND gap(v, w) > 10",
    "(e:Ego), (v:Vehicle) WHERE NOT same_lane(e, v)",
    "(v:Vehicle), (w:Vehicle) WHERE next_lane(v, w)",
    "(v:Vehicle) WHERE in_junction(v)",
    "(v:Vehicle) WHERE red_for(v)",
    "(v:Vehicle) WHERE off_road(v) OR right_most(v)",
    "(v:Vehicle) WHERE COUNT {(v)-[:isIn]->(:Lane)<-[:isIn]-(w:Vehicle)} >= 1",
    "(v:Vehicle) WHERE MAX {(v)-[at:isIn]->(l:Lane) | at.along} > 100",
    "(v:Vehicle) WHERE EXISTS {(v)-[:isIn*3]->(:Junction)}",
    "(v:Vehicle) WHERE EXISTS {(v)-[:isIn]->(:Lane)-[:travelsTo*1..3]->(:Lane)}",
    "(v:Vehicle), (w:Vehicle), (j:Junction) WHERE at(v, j) AND at(w, j)",
    "(v:Car), (w:Vehicle), (j:Junction) WHERE at(v, j) AND at(w, j) AND NOT at(w, j)",
    "(v:Car), (w:Vehicle) WHERE same_junction(v, w) AND in_junction(v) AND in_junction(w)",
    "(v:Vehicle), (w:Vehicle) WHERE lane_dist(v, w) > 30",
    "(e:Ego), (v:Vehicle) WHERE ttc(e, v) < 9 OR rss_margin(e, v) < 0",
    "(v:Vehicle) WHERE to_junction(v) < 60 AND curvature(v) IS KNOWN",
    "(s:TrafficLight) WHERE s.light_state = 'red'",
    "(e:Ego), (s:TrafficLight) WHERE lane_dist(e, s) > 0 AND s.light_state IS KNOWN",
    "(l:Lane) WHERE l.width > 3",
    "(v:Vehicle) WHERE NOT v.parked",
    "(e:Ego), (v:Vehicle) WHERE lead(e, v) AND prev(gap(e, v)) > 40",
)
SHOWN: Final = {"v": "v.name", "w": "w.name", "s": "s.name", "l": "l.name"}


def rows(store: Store, text: str) -> list[tuple[Any, ...]]:
    return sorted(map(tuple, store.find(text)), key=repr)


@pytest.mark.parametrize("asked", ASKED)
def test_pattern_in_world_equals_wider_graph(near: Store, wide: Store, asked: str) -> None:
    bound = re.findall(r"\((\w):", asked.partition(" WHERE ")[0])
    named = ", ".join(SHOWN[one] for one in bound if one in SHOWN)
    found = rows(near, f"USING SCOPE world MATCH {asked} RETURN {named}, FRAMES")
    assert found == rows(wide, f"MATCH {asked} RETURN {named}, FRAMES")


def test_patterns_match_beyond_the_graph(near: Store) -> None:
    for asked in ASKED[:3]:
        assert rows(near, f"USING SCOPE world MATCH {asked}") != rows(near, f"MATCH {asked}")


@pytest.mark.parametrize("asked", ASKED)
def test_default_scope_of_pattern_is_the_graph(near: Store, alone: Store, asked: str) -> None:
    text = f"MATCH {asked}"
    assert rows(near, text) == rows(alone, text) == rows(near, f"USING SCOPE graph {text}")


def test_graph_scope_gives_the_same_sql_without_world(near: Store, alone: Store) -> None:
    for asked in ASKED[:-1]:
        text = f"MATCH {asked}"
        emitted = (store.explain(text).partition("---- emit")[2] for store in (near, alone))
        assert len(set(emitted)) == 1
    world = f"USING SCOPE world MATCH {ASKED[1]}"
    assert "known_edge" in near.explain(world)
    assert "known_" not in alone.explain(world)


@pytest.mark.parametrize(
    "edges",
    [
        "(e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v:Vehicle)",
        "(v:Vehicle)-[:isIn]->(l:Lane)",
        "(l:Lane)-[:toLeftOf|toRightOf]-(m:Lane)",
        "(v:Vehicle)-[:leads]->(w:Vehicle)",
        "(v:Vehicle)-[:isIn*1..3]->(x)",
        "(l:Lane)-[:travelsTo*1..2]->(m:Lane)",
        "(v:Vehicle)-[:isIn]->(l:Lane)-[:travelsTo]->(m:Lane)",
    ],
)
def test_pattern_edge_is_in_the_graph_in_both_scopes(near: Store, edges: str) -> None:
    text = f"MATCH {edges}"
    assert rows(near, text)
    assert rows(near, f"USING SCOPE world {text}") == rows(near, text)


def test_quantified_entity_may_be_beyond_the_graph(near: Store) -> None:
    text = "CHECK c: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) > 60"
    assert verdict(near, "fast", text) == "false"
    assert verdict(near, "fast", f"USING SCOPE graph {text}") == "true"


def test_relations_with_limited_range_are_false_beyond_the_graph(near: Store) -> None:
    text = (
        "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) > 55 AND NOT EXISTS {(v)-[:near|overlaps]-(e)}"
    )
    assert rows(near, f"USING SCOPE world {text}")


def test_abstraction_has_world_scope(near: Store, wide: Store) -> None:
    asked = "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) > 55 RETURN v.name, FRAMES"
    text = f"USING SCOPE world, ABSTRACTION ER {asked}"
    found = rows(near, text)
    assert found
    assert found == rows(wide, text)


TWO_FAR: Final = Scene(
    WAYS,
    ego(along(RIGHT), 20),
    actor("v", along(RIGHT), 20, start=80),
    actor("w", along(LEFT), 20, start=82),
    seconds=1,
)


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, float], str]:
    """The verdict of a store and of a monitor on two vehicles 80 m ahead of the ego."""
    frames = list(replayed([TWO_FAR.block()]))

    @cache
    def far(limit: float) -> Store:
        folder = tmp_path_factory.mktemp("far")
        return store_of(folder / "s.sgstore", {"road": [TWO_FAR]}, {"road": ranged(limit, 200)})

    def verdict(text: str, limit: float) -> str:
        monitor = Monitor(text, TWO_FAR.road, ranged(limit, 200))
        for frame in frames:
            monitor.step(frame)
        (watched,), (found,) = monitor.finish(), far(limit).check(text)
        assert found.verdict == watched.verdict
        return found.verdict

    return verdict


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ("NOT EXISTS {(ego)-[:sees]->(v)}", "unknown"),
        ("EXISTS {(ego)-[:sees]->(v)}", "unknown"),
        ("EXISTS {(v)-[:sees]->(w:Vehicle)}", "unknown"),
        ("NOT EXISTS {(v)-[:inDFrontOf]->(ego)}", "unknown"),
        ("NOT EXISTS {(v)-[:toLeftOf|toRightOf]-(ego)}", "unknown"),
        ("COUNT {(ego)-[:sees]->(w:Vehicle)} < 1", "unknown"),
        ("NOT EXISTS {(v)-[:near|overlaps]-(ego)}", "true"),
        ("EXISTS {(v)-[:near|overlaps]-(ego)}", "false"),
        ("(dist(ego, v) > 50 OR EXISTS {(ego)-[:sees]->(v)})", "true"),
    ],
)
def test_uncomputed_relation_beyond_the_graph_is_unknown(
    judged: Callable[[str, float], str], asked: str, expected: str
) -> None:
    text = f"CHECK c: FORALL (v:Vehicle) ALWAYS {asked}"
    assert judged(text, 50) == expected


def test_check_of_uncomputed_relation_is_unknown_in_world(
    judged: Callable[[str, float], str],
) -> None:
    text = "CHECK c: FORALL (v:Vehicle) ALWAYS NOT EXISTS {(v)-[:sees]->(ego)}"
    assert judged(text, 50) == "unknown"
    assert judged(f"USING SCOPE graph {text}", 50) == "true"


@pytest.mark.parametrize(("limit", "expected"), [(50, "false"), (200, "false")])
def test_two_entities_beyond_the_graph_can_be_near(
    judged: Callable[[str, float], str], limit: float, expected: str
) -> None:
    rungs = "near|very_near|super_near|near_coll"
    text = f"CHECK c: ALWAYS NOT EXISTS {{(v:Vehicle)-[:{rungs}]->(w:Vehicle)}}"
    assert judged(text, limit) == expected


RATE: Final = 0.0 if LONG else 1.0
"""Frames in a second of the recordings; ``make oracle`` has all of them."""
EVERY: Final = 10 if LONG else 30
"""One of so many frames is searched in memory."""


def _same_rules(recording: Path, folder: Path, names: Sequence[str]) -> int:
    """How many verdicts of rules are the same with 50 m and a world of 200 m as with graphs of 200 m."""
    told: list[Store] = []
    for radius, world in ((50, 200), (200, 0)):
        where = folder / f"{recording.stem}-{radius}.sgstore"
        (found,) = ingest(where, [recording], config=ranged(radius, world), rate=RATE)
        assert found.error is None
        told.append(Store(where))
    with told[0].file.snapshot(), told[1].file.snapshot():
        for name in names:
            near, wide = (verdicts(store, patterns()[name].text) for store in told)
            assert near == wide, name
    return len(names)


SEEN: Final = {name for name in CHECKS if "[:sees]" in patterns()[name].query}
"""Rules about what the ego sees, which is computed within graphs alone."""


def test_rules_agree_on_the_bundled_recording(tmp_path: Path) -> None:
    names = some_of(sorted({*CHECKS} - SEEN), 4)
    assert _same_rules(RECORDING, tmp_path, names) == len(names) > 10


RECORDINGS: Final = (
    *("sumo/Town10HD_sumo_osi", "esmini/swarm_Town04", "esmini/highway_merge", "esmini/cut-in"),
    *("esmini/pedestrian", "esmini/traffic_lights", "omega_prime/osi_centerline_example"),
    *("carla/Town01.carla", "osi_converter/disappearingVehicle"),
)


@pytest.mark.parametrize("name", RECORDINGS if LONG else RECORDINGS[:1])
def test_rules_agree_on_shared_recordings(data: Path, tmp_path: Path, name: str) -> None:
    names = sorted({*CHECKS} - SEEN)
    names = names if LONG else ["yield_821", "turn_lanes_846", "rss_distance", "r_i1_stopping"]
    assert _same_rules(data / "traces" / f"{name}.mcap", tmp_path, names)


@pytest.fixture(scope="module")
def some(near: Store) -> list[int]:
    return [f for (f,) in near.sql(f"SELECT frame_id FROM frames WHERE seq % {EVERY} = 0").values]


@pytest.mark.parametrize("asked", ASKED[:-1])
def test_memory_search_equals_database(near: Store, some: list[int], asked: str) -> None:
    for scope in ("graph", "world"):
        matches = near.find(f"USING SCOPE {scope} MATCH {asked}")
        query = compile_query(f"USING SCOPE {scope} MATCH {asked}", near.catalog()).bound
        names = [n.key for n in query.scope.nodes.values() if n.role == "named"]
        places = [0, *(matches.columns.index(name) for name in names)]
        found = {tuple(row[place] for place in places) for row in matches if row[0] in some}
        seen = set[tuple[int, ...]]()
        for frame in some:
            at = Binding(seen_by(near, frame, query))
            for _ in ScopeSearch(query.scope, injective=True).run(at):
                seen.add((frame, *(at.nodes[name] for name in names)))
        assert seen == found


MONITORED: Final = """
CHECK far: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) > 60;
CHECK lane: FORALL (v:Vehicle) ALWAYS (same_lane(ego, v) IMPLIES dist(ego, v) < 80);
CHECK led: FORALL (v:Vehicle) ALWAYS NOT lead(ego, v);
CHECK leads: FORALL (v:Vehicle, w:Vehicle) ALWAYS (lead(v, w) IMPLIES gap(v, w) < 30);
CHECK red: FORALL (v:Vehicle) ALWAYS NOT red_for(v);
CHECK counted: ALWAYS COUNT {(v:Vehicle) WHERE moving(v)} < 3;
CHECK ways: FORALL (v:Vehicle) ALWAYS NOT lane_dist(ego, v) > 70;
USING SCOPE graph CHECK graph: FORALL (v:Vehicle) ALWAYS NOT lead(ego, v)
"""


@pytest.mark.parametrize("trace", sorted(SCENES))
def test_monitor_in_world_equals_store(near: Store, trace: str) -> None:
    (scene,) = SCENES[trace]
    # Each rule is watched in every third scene, in ``make oracle`` in all of them.
    names = CHECKS if LONG else CHECKS[sorted(SCENES).index(trace) % 3 :: 3]
    texts = [MONITORED, *(patterns()[name].text for name in names)]
    monitor = Monitor(
        ";".join(texts), scene.road, ranged(50, 200), trace=trace, period_s=1 / scene.rate
    )
    for frame in replayed([scene.block()]):
        monitor.step(frame)
    told = {one.check: one for one in monitor.finish()}
    stored_ = {key: one for text in texts for key, one in verdicts(near, text).items()}
    assert {name for name, where in stored_ if where == trace} == told.keys()
    for (name, where), (verdict_, first, _) in stored_.items():
        if where != trace:
            continue
        found = told[name].first_violation
        if trace == "signals" and told[name].verdict == "unknown":
            # In a junction, later frames decide the lane that a vehicle drives.
            assert name not in {"far", "lane", "red", "counted"}, name
            continue
        assert told[name].verdict == verdict_, name
        if trace != "signals":
            assert (found and (found.start_seq, found.end_seq)) == first, name


def test_known_graph_equals_wider_graph(
    near: Store, alone: Store, wide: Store, some: list[int]
) -> None:
    for frame in some:
        graph = near.file.graph(frame)
        assert graph == alone.file.graph(frame)
        known, far = graph.known(), wide.file.graph(frame)
        assert graph.nodes.keys() < known.nodes.keys()
        others = {n for n in known.nodes.keys() ^ far.nodes.keys() if n >= 0}
        assert not others
        for name in ("isIn", "leads", "follows", "controlsTrafficOf"):
            ours, theirs = (
                {
                    (a, b, tuple(sorted(about.items())))
                    for a, r, b, about in of.edges
                    if r == name and a >= 0
                }
                for of in (known, far)
            )
            assert ours == theirs, name
        assert alone.file.graph(frame).known().nodes.keys() == alone.file.graph(frame).nodes.keys()


LONG_ROAD: Final = Scene(
    WAYS, ego(along(RIGHT), 20), actor("v", along(LEFT), 30, start=390), seconds=1
)
APART: Final = "CHECK apart: FORALL (v:Vehicle) ALWAYS dist(ego, v) > 60"
SLOW: Final = "CHECK slow: FORALL (v:Vehicle) ALWAYS v.speed < 25"


@pytest.mark.parametrize(
    ("radius", "world", "apart", "slow"),
    [
        (50, 0, "unknown", "unknown"),
        (50, 100, "true", "unknown"),
        (50, 200, "true", "unknown"),
        (50, 400, "true", "false"),
        (400, 0, "true", "false"),
    ],
)
def test_verdict_is_unknown_beyond_known_range(
    tmp_path: Path, radius: float, world: float, apart: str, slow: str
) -> None:
    config = ranged(radius, world)
    store = store_of(tmp_path / "s.sgstore", {"road": [LONG_ROAD]}, {"road": config})
    monitor = Monitor(f"{APART}; {SLOW}", LONG_ROAD.road, config)
    for frame in replayed([LONG_ROAD.block()]):
        monitor.step(frame)
    watched = {one.check: one for one in monitor.finish()}
    for text, expected in ((APART, apart), (SLOW, slow)):
        (found,) = store.check(text)
        assert found.verdict == watched[found.check].verdict == expected
        assert ("around the ego, but the trace covers" in found.reason) is (expected == "unknown")
        assert found.reason == watched[found.check].reason
        (found,) = store.check(f"USING SCOPE graph {text}")
        assert found.verdict == ("false" if radius > 300 and text is SLOW else "true")


def test_left_out_entities_are_counted(tmp_path: Path) -> None:
    scene = Scene(
        WAYS,
        ego(along(RIGHT), 20),
        actor("near", along(LEFT), 20, start=30),
        actor("far", along(LEFT), 20, start=100),
        actor("p", along(LEFT), 20, "person", start=20),
        actor("gone", along(LEFT), 20, start=390),
        seconds=1,
    )
    config = replace(ranged(50, 200), kinds=("Vehicle",))
    store = store_of(tmp_path / "s.sgstore", {"road": [scene]}, {"road": config})
    (trace,) = store.traces()
    frames = trace.frames
    assert trace.report["scope"] == {
        "radius": 50.0,
        "world": 200.0,
        "states": 5 * frames,
        "beyond_radius": 2 * frames,
        "beyond_world": frames,
        "excluded": {"person": frames},
        "rate": 0.0,
    }
