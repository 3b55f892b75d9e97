"""Relations that end at some distance, of entities beyond the graphs: the same as in graphs as wide."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import pytest
from scenes import Scene, actor, along, cone, ego, store_of, street

from sgstore.config import Config, PairSettings, Proximity, RangeSettings
from sgstore.lang import Binding, ScopeSearch, compile_query
from sgstore.step import replayed
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

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
SETTINGS: Final = {
    "usual": Config(),
    "narrow": Config(
        proximity=Proximity(names=("close", "wide"), upper=(3.0, 12.5)),
        pairs=PairSettings(within=10.0),
    ),
    "footprints": Config(
        proximity=Proximity(
            names=("close", "wide"),
            upper=(1.0, 20.0),
            between="footprints",
            kinds=(("Car", "Person"),),
        ),
        pairs=PairSettings(within=15.0, static=True, ego_within=60.0),
    ),
    "origins": Config(
        proximity=Proximity(names=("close", "wide"), upper=(4.0, 30.0), between="origins"),
        pairs=PairSettings(within=30.0, kinds=(("Vehicle", "Person"),)),
    ),
    "long": Config(
        proximity=Proximity(names=("close", "wide"), upper=(30.0, 90.0)),
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
    configs = {name: ranged(config, radius, world) for name, config in SETTINGS.items()}
    return store_of(folder / "s.sgstore", {name: [CROWD] for name in SETTINGS}, configs)


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return stored(tmp_path_factory.mktemp("near"), 50, 200)


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return stored(tmp_path_factory.mktemp("wide"), 200, 0)


def named(asked: str, trace: str) -> str:
    first, second = RUNGS.get(trace, ("close", "wide"))
    return asked.replace("FIRST", first).replace("SECOND", second)


def rows(store: Store, text: str) -> list[tuple[Any, ...]]:
    return sorted(map(tuple, store.find(text)), key=repr)


@pytest.mark.parametrize("trace", sorted(SETTINGS))
@pytest.mark.parametrize("asked", ASKED)
def test_nearness_beyond_graphs_is_that_of_graphs_as_wide(
    near: Store, wide: Store, asked: str, trace: str
) -> None:
    text = f"MATCH {named(asked, trace)} AND trace.name = '{trace}' RETURN v.name, FRAMES"
    found = rows(near, f"USING SCOPE world {text}")
    assert found == rows(wide, text)


@pytest.mark.parametrize("trace", sorted(SETTINGS))
def test_a_search_in_memory_finds_the_same_beyond_graphs(near: Store, trace: str) -> None:
    sql = f"SELECT frame_id FROM frames WHERE trace = '{trace}' AND seq % 8 = 2"
    frames = [frame for (frame,) in near.sql(sql).values]
    found, seen = dict[str, int](), dict[str, int]()
    for asked in ASKED:
        text = f"USING SCOPE world MATCH {named(asked, trace)} AND trace.name = '{trace}'"
        found[asked] = sum(row[0] in frames for row in rows(near, text))
        query = compile_query(text, near.catalog()).bound
        views = (
            near._view(near.file.frame(frame), query)  # pyright: ignore[reportPrivateUsage]
            for frame in frames
        )
        seen[asked] = sum(
            1 for view in views for _ in ScopeSearch(query.scope, injective=True).run(Binding(view))
        )
    assert seen == found


def test_some_are_near_beyond_graphs(near: Store) -> None:
    for asked in ASKED[:5]:
        text = f"MATCH {named(asked, 'usual')} AND trace.name = 'usual'"
        assert rows(near, f"USING SCOPE world {text}") != rows(near, text)


@pytest.mark.parametrize("trace", sorted(SETTINGS))
def test_a_check_of_nearness_is_that_of_graphs_as_wide(
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
    monitor = Monitor(text, CROWD.road, ranged(SETTINGS[trace], 50, 200), trace=trace)
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
