"""Relations that end at some distance, of entities beyond the graphs: the same as in graphs as wide."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import pytest
from scenes import Scene, actor, along, cone, ego, seen_by, store_of, street
from thorough import some

from sgstore.graphs.online import replayed
from sgstore.lang.memory import Binding, ScopeSearch
from sgstore.lang.sql import compile_query
from sgstore.model.config import Config, PairSettings, Proximity, RangeSettings
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(30)

WAYS: Final = street("driving", "driving")
RIGHT, LEFT = -1.75, -5.25

CROWD: Final = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("n", along(LEFT), 12, start=20),
    actor("a", along(RIGHT), 8, start=48),
    actor("b", along(LEFT), 12, start=40),
    actor("c", along(LEFT), 9, "truck", start=85),
    actor("d", along(RIGHT), 16, start=80),
    actor("p", (92, -3.0), kind="person"),
    actor("q", (92.3, -3.1), kind="person"),
    cone("cone", (100, -3.5)),
    cone("near cone", (45, -3.5)),
    seconds=4,
    rate=4,
)
TRACES: Final = ("footprints", "long", "narrow", "origins", "usual")


@cache
def settings() -> dict[str, Config]:
    """Settings of each trace. The names of their rungs are known to the process from now on."""
    return {
        "usual": Config(),
        "narrow": Config(
            proximity=Proximity(names=("tight", "wide"), upper=(3.0, 12.5)),
            pairs=PairSettings(within=10.0),
        ),
        "footprints": Config(
            proximity=Proximity(
                names=("tight", "wide"),
                upper=(1.0, 20.0),
                between="footprints",
                kinds=(("Car", "Person"),),
            ),
            pairs=PairSettings(within=15.0, static=True, ego_within=60.0),
        ),
        "origins": Config(
            proximity=Proximity(names=("tight", "wide"), upper=(4.0, 30.0), between="origins"),
            pairs=PairSettings(within=30.0, kinds=(("Vehicle", "Person"),)),
        ),
        "long": Config(
            proximity=Proximity(names=("tight", "wide"), upper=(30.0, 90.0)),
            pairs=PairSettings(within=0.0),
        ),
    }


RUNGS: Final = {"usual": ("near_coll|super_near", "near|visible")}
ASKED: Final = (
    "(v:Entity) WHERE EXISTS {(v)-[:FIRST]-(w:Entity)}",
    "(v:Entity), (w:Entity) WHERE EXISTS {(v)-[:SECOND]->(w)}",
    "(v:Entity) WHERE NOT EXISTS {(v)-[:FIRST|SECOND]-(w:Vehicle) WHERE w.speed > 9}",
    "(v:Entity) WHERE COUNT {(v)-[:SECOND]-(w:Entity)} > 1",
    "(v:Entity) WHERE COUNT {(v)-[:FIRST]->(w)-[:SECOND]->(u:Entity)} = 1",
    "(v:Entity) WHERE MAX {(v)-[:FIRST|SECOND]->(w:Vehicle) | w.speed} < 11",
    "(v:Entity) WHERE MIN {(v)-[:FIRST|SECOND]->(w:Vehicle) | w.speed} < 9",
    "(v:Entity) WHERE EXISTS {(ego)-[:SECOND]-(v)}",
    "(v:Entity), (w:Entity) WHERE EXISTS {(v)-[:overlaps]-(w)}",
    "(v:Entity), (w:Entity) WHERE EXISTS {(v)-[:overlaps|SECOND]-(w)}",
    "(v:Prop) WHERE EXISTS {(v)-[:SECOND]-(w:Vehicle)}",
)


def ranged(config: Config, radius: float, world: float) -> Config:
    return replace(config, range=RangeSettings(radius=radius, world=world))


def stored(folder: Path, radius: float, world: float) -> Store:
    configs = {name: ranged(config, radius, world) for name, config in settings().items()}
    return store_of(folder / "s.sgstore", {name: [CROWD] for name in TRACES}, configs)


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = stored(tmp_path_factory.mktemp("near"), 50, 200)
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = stored(tmp_path_factory.mktemp("wide"), 200, 0)
    with store.file.snapshot():
        yield store


def named(asked: str, trace: str) -> str:
    first, second = RUNGS.get(trace, ("tight", "wide"))
    return asked.replace("FIRST", first).replace("SECOND", second)


def among(asked: str, trace: str) -> str:
    """The question of a trace and of all whose rungs have the same names."""
    same = [one for one in TRACES if (one in RUNGS) == (trace in RUNGS)]
    return f"MATCH {named(asked, trace)} AND trace.name IN {same}"


@cache
def rows(store: Store, text: str) -> list[tuple[Any, ...]]:
    return sorted(map(tuple, store.find(text)), key=repr)


@pytest.mark.parametrize(
    ("asked", "trace"), some([(asked, trace) for asked in ASKED for trace in TRACES], 2)
)
def test_distance_relations_beyond_graph_equal_wider_graph(
    near: Store, wide: Store, asked: str, trace: str
) -> None:
    text = f"MATCH {named(asked, trace)} AND trace.name = '{trace}' RETURN v.name, FRAMES"
    found = rows(near, f"USING SCOPE world {text}")
    assert found == rows(wide, text)


@pytest.mark.parametrize("trace", some(TRACES, 4))
def test_memory_search_equals_sql_beyond_graph(near: Store, trace: str) -> None:
    sql = f"SELECT frame_id FROM frames WHERE trace = '{trace}' AND seq % 8 = 2"
    frames = [frame for (frame,) in near.sql(sql).values]
    found, seen = dict[str, int](), dict[str, int]()
    for asked in ASKED:
        text = f"USING SCOPE world {among(asked, trace)}"
        found[asked] = sum(row[0] in frames for row in rows(near, text))
        query = compile_query(text, near.catalog()).bound
        views = (seen_by(near, frame, query) for frame in frames)
        seen[asked] = sum(
            1 for view in views for _ in ScopeSearch(query.scope, injective=True).run(Binding(view))
        )
    assert seen == found


def test_distance_relations_exist_beyond_graph(near: Store) -> None:
    for asked in ASKED[:5]:
        text = f"MATCH {named(asked, 'usual')} AND trace.name = 'usual'"
        assert rows(near, f"USING SCOPE world {text}") != rows(near, text)


@pytest.mark.parametrize("trace", some(TRACES, 4))
def test_check_of_distance_relations_equals_wider_graph(
    near: Store, wide: Store, trace: str
) -> None:
    text = named(
        """
        CHECK apart: ALWAYS NOT EXISTS {(v:Vehicle)-[:FIRST]-(w:Vehicle)};
        CHECK touch: ALWAYS NOT EXISTS {(v:Entity)-[:overlaps]-(w:Entity)};
        CHECK meets: FORSOME (v:Truck, w:Car) EVENTUALLY EXISTS {(v)-[:SECOND]-(w)};
        CHECK held: FORALL (v:Vehicle) ALWAYS COUNT {(v)-[:FIRST|SECOND]-(w:Vehicle)} < 3;
        CHECK cones: FORALL (v:Prop) ALWAYS NOT EXISTS {(v)-[:SECOND]-(w:Vehicle)}
        """,
        trace,
    )
    monitor = Monitor(text, CROWD.road, ranged(settings()[trace], 50, 200), trace=trace)
    for frame in replayed([CROWD.block()]):
        monitor.step(frame)
    told = {one.check: one for one in monitor.finish()}
    name = "near|visible" if trace == "usual" else "wide"
    ours, theirs = (
        {one.check: one for one in store.check(text) if one.trace == trace}
        for store in (near, wide)
    )
    assert ours.keys() == theirs.keys() == told.keys()
    assert name in text
    for check, one in ours.items():
        assert one.verdict == theirs[check].verdict == told[check].verdict, check
        assert one.first_violation == theirs[check].first_violation, check


PEOPLE: Final = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("v", along(LEFT), 12, start=20),
    actor("p", (30, -3.0), kind="person"),
    seconds=1,
)


@pytest.fixture(scope="module")
def excluding(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Config], Store]:
    """A store of these people for each configuration."""

    @cache
    def stored_with(config: Config) -> Store:
        folder = tmp_path_factory.mktemp("people")
        return store_of(folder / "s.sgstore", {"road": [PEOPLE]}, {"road": config})

    return stored_with


@pytest.mark.parametrize(
    ("check", "expected"),
    [
        ("FORALL (p:Person) ALWAYS p.speed < 1", "unknown"),
        ("FORALL (p:Entity) ALWAYS p.speed < 20", "unknown"),
        ("FORALL (p:Entity) ALWAYS p.speed < 11", "false"),
        ("FORSOME (p:Entity) EVENTUALLY p.speed > 11", "true"),
        ("FORSOME (p:Person) ALWAYS p.speed < 1", "unknown"),
        ("ALWAYS NOT EXISTS {(p:Person) WHERE dist(ego, p) < 5}", "unknown"),
        ("ALWAYS COUNT {(p:Vehicle)} < 5", "true"),
        ("ALWAYS COUNT {(p:Entity)} < 5", "unknown"),
        ("ALWAYS COUNT {(p:Entity)} < 1", "false"),
        ("FORALL (v:Vehicle) ALWAYS v.speed < 20", "true"),
        ("ALWAYS ego.speed < 11", "true"),
    ],
)
@pytest.mark.parametrize(
    "config", [Config(kinds=("Vehicle", "Lane", "Road")), Config(exclude_ids=("p",))]
)
def test_check_of_excluded_entities_is_unknown(
    excluding: Callable[[Config], Store], check: str, expected: str, config: Config
) -> None:
    store = excluding(config)
    text = f"CHECK c: {check}"
    monitor = Monitor(text, PEOPLE.road, config)
    for frame in replayed([PEOPLE.block()]):
        monitor.step(frame)
    (found,), (watched,) = store.check(text), monitor.finish()
    assert (found.verdict, found.reason) == (watched.verdict, watched.reason)
    assert found.verdict == expected
    assert ("which the settings of the trace exclude" in found.reason) is (expected == "unknown")
    (inside,) = store.check(f"USING SCOPE graph {text}")
    assert inside.verdict != "unknown"


PASSING: Final = Scene(
    WAYS,
    ego(along(RIGHT), 10),
    actor("v", along(LEFT), 30, start=48),
    actor("t", along(RIGHT), 14, "truck", start=70),
    actor("w", along(LEFT), 18, start=120),
    cone("cone", (102, -3.5)),
    seconds=4,
)
LOOKING: Final = """
USING RANGE 80 CHECK slow: FORALL (v:Vehicle) ALWAYS v.speed < 16;
USING RANGE 80 CHECK slower: FORALL (v:Vehicle) ALWAYS v.speed < 12;
USING RANGE 80 CHECK fast: FORSOME (v:Vehicle) EVENTUALLY v.speed > 16;
USING RANGE 80 CHECK leaves: FORALL (v:Vehicle) ALWAYS[0s, 2s] (v.speed > 25 IMPLIES dist(ego, v) < 78);
USING RANGE 80 CHECK few: ALWAYS COUNT {(v:Vehicle)} < 3;
USING RANGE 80 CHECK cones: ALWAYS EXISTS {(c:Prop)};
USING RANGE 80 CHECK none: EVENTUALLY EXISTS {(c:Prop)};
USING RANGE 80 CHECK two: ALWAYS NOT EXISTS {(v:Truck), (w:Car) WHERE dist(v, w) < 12};
USING RANGE 80 CHECK ahead: FORALL (v:Truck, w:Car) ALWAYS (v.speed > w.speed OR NOT next_lane(v, w));
USING RANGE 80 CHECK change: FORALL (v:Vehicle) ALWAYS abs(delta(v.speed, 1s)) < 1;
USING RANGE 80 CHECK least: ALWAYS MIN {(v:Vehicle) | v.speed} < 15;
USING RANGE 80 CHECK names: FORALL (v:Vehicle WHERE v.speed > 16) ALWAYS v.length > 10
"""


def test_check_ignores_entities_beyond_its_range(tmp_path: Path) -> None:
    settings = {"cut": (50, 80), "world": (50, 200), "wide": (200, 0), "all": (50, float("inf"))}
    told: dict[str, dict[str, tuple[Any, ...]]] = {}
    for name, (radius, world) in settings.items():
        config = ranged(Config(), radius, world)
        store = store_of(tmp_path / f"{name}.sgstore", {"road": [PASSING]}, {"road": config})
        told[name] = {
            one.check: (one.verdict, one.first_violation, len(one.witnesses))
            for one in store.check(LOOKING)
        }
        monitor = Monitor(LOOKING, PASSING.road, config, trace="road")
        for frame in replayed([PASSING.block()]):
            monitor.step(frame)
        for one in monitor.finish():
            assert one.verdict == told[name][one.check][0], (name, one.check)
            assert one.first_violation == told[name][one.check][1], (name, one.check)
    assert told["cut"] == told["world"] == told["wide"] == told["all"]
    verdicts = {verdict for verdict, _, _ in told["cut"].values()}
    assert {"true", "false"} <= verdicts
