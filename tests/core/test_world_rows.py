"""What is known beyond the graphs: the rows of a graph as wide, and nothing else changes."""

from __future__ import annotations

import hashlib
import json
import shutil
from typing import TYPE_CHECKING, Any, Final

import duckdb
import numpy as np
import pytest
from graph_blocks import trace_info
from scenes import NO_MESSAGES, Scene, actor, along, ego, light, path, street
from thorough import LONG

from sgstore.apps.demo import RECORDING
from sgstore.collection import Collection, pack, unpack
from sgstore.errors import ConfigError, StoreError
from sgstore.graphs.online import replayed
from sgstore.ingest import ingest
from sgstore.model.config import Config, RangeSettings, from_dict
from sgstore.model.world import TraceReport
from sgstore.pipeline.rebuild import rebuild
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

WAYS: Final = street("driving", "driving")
SCENE: Final = Scene(
    WAYS,
    ego(along(-1.75), 10),
    actor("near", along(-1.75), 10, start=30),
    actor("far", along(-5.25), 9, start=120),
    actor("leaves", path((20, -5.25), (400, -5.25)), 25),
    actor("beyond", along(-1.75), 0, start=390),
    light("light", (180.0, -7.0), (0, "red"), (2, "green")),
    seconds=6,
)

OF_GRAPHS: Final = (
    *(
        "frames",
        "nodes",
        "edges",
        "lane_states",
        "lane_courses",
        "lane_gaps",
        "pairs",
        "lane_dists",
    ),
    *("classes", "roles", "lanes", "entities", "payloads", "events"),
)
"""Views that do not read what is known beyond graphs."""

RECORDINGS: Final = (
    *("esmini/highway_merge.mcap", "sumo/Town10HD_sumo_osi.mcap", "esmini/swarm_Town04.mcap"),
    *("carla/Town01.carla.mcap", "omega_prime/osi_centerline_example.mcap"),
    *("esmini/cut-in.mcap", "esmini/traffic_lights.mcap", "omega_prime/pedestrian.osi"),
    *("osi_converter/disappearingVehicle.mcap", "osi_converter/MovingHostWithStopLine.mcap"),
)


def ranged(radius: float, world: float, **more: Any) -> Config:
    return from_dict({"range": {"radius": radius, "world": world}, **more})


def of_scene(folder: Path, config: Config) -> Store:
    """A store of it, with the numbers that a recording would have: rounded before graphs are made."""
    return of_scenes(folder, config, {"scene": SCENE})


def of_scenes(folder: Path, config: Config, scenes: dict[str, Scene]) -> Store:
    """A store of scenes on one map, by their names."""
    file = StoreFile.create(folder / "s.sgstore")
    for name, scene in scenes.items():
        generator = SceneGraphGenerator(WAYS, config)
        about = {
            "digest": hashlib.sha256(name.encode()).hexdigest(),
            "flavour": "scene",
            "context": NO_MESSAGES,
        }
        info = trace_info(f"/{name}.mcap", channels=(), ego="ego", **about)
        with file.segment(info, config, road_map=WAYS, answers=generator.answers) as segment:
            for piece in generator.pieces(segment.as_kept(scene.block())):
                segment.append(generator.block(piece))
            parked = generator.parked, generator.world_parked
            file.publish(segment.seal(TraceReport(frames=len(scene.times)), None, parked))
    return Store(file.path)


def of_recording(folder: Path, recording: Path, config: Config) -> Store:
    """The first seconds of it; all of it where tests are long."""
    place = folder / "s.sgstore"
    (report,) = ingest(place, [recording], config=config, until=None if LONG else 4.0)
    assert report.status == "added"
    return Store(place)


@pytest.fixture(scope="module", params=["scene", "bundled", *RECORDINGS[: None if LONG else 2]])
def stores(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Store]:
    """Graphs of 50 m alone, with a world of 200 m, and graphs of 200 m."""
    configs = {"alone": ranged(50, 0), "near": ranged(50, 200), "wide": ranged(200, 0)}
    found: dict[str, Store] = {}
    for name, config in configs.items():
        folder = tmp_path_factory.mktemp(name)
        if request.param == "scene":
            found[name] = of_scene(folder, config)
        else:
            recording = RECORDING
            if request.param != "bundled":
                recording = request.getfixturevalue("data") / "traces" / request.param
            found[name] = of_recording(folder, recording, config)
    return found


def rows(store: Store, sql: str) -> list[tuple[Any, ...]]:
    return store.sql(f"{sql} ORDER BY ALL").values


def columns(store: Store, view: str) -> str:
    return ", ".join(f'"{name}"' for name in store.sql(f"SELECT * FROM {view} LIMIT 0").columns)


@pytest.mark.parametrize("view", OF_GRAPHS)
def test_a_view_of_graphs_has_the_rows_that_it_has_without_a_world(
    stores: dict[str, Store], view: str
) -> None:
    sql = f"SELECT * FROM {view}"
    assert rows(stores["near"], sql) == rows(stores["alone"], sql)


@pytest.mark.parametrize("view", ["nodes", "lane_states", "pairs", "criticality", "lane_dists"])
def test_a_view_of_the_world_has_the_rows_of_a_graph_as_wide(
    stores: dict[str, Store], view: str
) -> None:
    names = columns(stores["wide"], view)
    found = rows(stores["near"], f"SELECT {names} FROM world_{view}")
    assert found == rows(stores["wide"], f"SELECT {names} FROM {view}")


@pytest.mark.parametrize("view", ["nodes", "lane_states"])
def test_a_row_of_the_world_says_whether_it_is_in_the_graph(
    stores: dict[str, Store], view: str
) -> None:
    near, names = stores["near"], columns(stores["near"], view)
    within = rows(near, f"SELECT {names} FROM world_{view} WHERE in_graph")
    assert within == rows(near, f"SELECT {names} FROM {view}")
    count = f"SELECT count(*) FROM world_{view} WHERE NOT in_graph"
    assert near.sql(count).values[0][0] > 0


def test_without_a_world_nothing_is_known_beyond_the_graphs(stores: dict[str, Store]) -> None:
    alone = stores["alone"]
    for view in ("nodes", "lane_states"):
        names = columns(alone, view)
        found = rows(alone, f"SELECT {names}, in_graph FROM world_{view}")
        assert found == rows(alone, f"SELECT {names}, true FROM {view}")


def test_nothing_but_the_recording_bounds_a_world_that_is_infinite(tmp_path: Path) -> None:
    store = of_scene(tmp_path, ranged(50, float("inf")))
    told = "SELECT DISTINCT ident FROM world_nodes WHERE NOT in_graph AND ident IS NOT NULL"
    assert {ident for (ident,) in rows(store, told)} == {"far", "leaves", "beyond", "light"}
    ((count,),) = store.sql("SELECT count(*) FROM world_nodes WHERE ident = 'beyond'").values
    assert count == len(SCENE.times)
    (tmp_path / "near").mkdir()
    near = of_scene(tmp_path / "near", ranged(50, 200))
    assert {ident for (ident,) in rows(near, told)} == {"far", "leaves", "light"}


@pytest.mark.parametrize("world", [-1.0, float("nan"), float("-inf")])
def test_a_world_of_no_length_is_refused(world: float) -> None:
    with pytest.raises(ConfigError, match=r"range\.world.*expected a length of 0 or more"):
        RangeSettings(world=world)


@pytest.mark.parametrize("egos", [("near",), ("near", "far"), ("far", "near", "ego")])
def test_a_world_is_that_of_its_ego_however_many_there_are(
    tmp_path: Path, egos: Sequence[str]
) -> None:
    """The blocks of each ego are those of a generator of its own."""
    config = ranged(50, 100)
    block = SCENE.block()
    named = [block.entities.ident.index(ego) for ego in egos]
    nodes = [block.ego * 0 + node for node in named]
    together = SceneGraphGenerator(WAYS, config).blocks(block, nodes)
    for node, found in zip(nodes, together, strict=True):
        (own,) = SceneGraphGenerator(WAYS, config).blocks(block, [node])
        assert own.world is not None
        assert found.world is not None
        assert len(own.world.frames.states)
        assert repr(found.world) == repr(own.world)


def test_a_generator_step_by_step_knows_the_world_that_a_store_knows(tmp_path: Path) -> None:
    near = of_scene(tmp_path, ranged(50, 200))
    generator = SceneGraphGenerator(WAYS, ranged(50, 200))
    told = "SELECT ident, x, y, z, heading, speed, length FROM world_nodes n JOIN frames f USING (frame_id)"
    names = ("x", "y", "z", "heading", "speed", "length")
    for seq, frame in enumerate(replayed([SCENE.block()])):
        nodes = generator.step(frame).known().nodes.values()
        found = [(a["ident"], *(a.get(n) for n in names)) for a in nodes if "ident" in a]
        wanted = rows(near, f"{told} WHERE f.seq = {seq} AND ident IS NOT NULL")
        # A view tells a size in 64 bits, by its shortest text.
        assert sorted(map(_narrow, found)) == sorted(map(_narrow, wanted))


def _narrow(row: Sequence[Any]) -> list[Any]:
    return [float(np.float32(one)) if isinstance(one, float) else one for one in row]


# Stores that are copied, sorted, made anew -----------------------------------------------------------


def beyond(store: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All rows about what is beyond the graphs."""
    with duckdb.connect(str(store), read_only=True) as connection:
        tables = connection.execute(
            "SELECT table_name FROM duckdb_tables() WHERE table_name LIKE 'world_%'"
        ).fetchall()
        return {
            table: connection.execute(f"SELECT * FROM inside.{table} ORDER BY ALL").fetchall()
            for (table,) in tables
        }


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of four seconds of the bundled recording."""
    place = tmp_path_factory.mktemp("recorded") / "s.sgstore"
    ingest(place, [RECORDING], until=4.0)
    found = beyond(place)
    assert len(found) == 7
    assert all(found[table] for table in ("world_state", "world_node", "world_lane_single"))
    return place


@pytest.fixture
def copied(recorded: Path, tmp_path: Path) -> Path:
    return shutil.copy(recorded, tmp_path / "s.sgstore")


def test_a_collection_keeps_the_rows_beyond_graphs(recorded: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.sgstore"
    ((car, *_), *_) = rows(
        Store(recorded), "SELECT DISTINCT ident FROM nodes WHERE kind = 'bus' AND NOT is_ego"
    )
    ingest(other, [RECORDING], egos=[car], until=4.0)
    pack(recorded, tmp_path / "fleet")
    pack(other, tmp_path / "fleet")
    unpack(tmp_path / "fleet", tmp_path / "all.sgstore")
    together, apart = (beyond(tmp_path / "all.sgstore"), (beyond(recorded), beyond(other)))
    for table in together:
        assert sorted(together[table], key=repr) == sorted(
            (row for one in apart for row in one[table]), key=repr
        )


FAR: Final = {
    "apart": [actor("bus", along(-1.75), 10, "bus", start=90)],
    "together": [
        actor("bus", along(-1.75), 10, "bus", start=90),
        actor("truck", along(-1.75), 10, "truck", start=105),
    ],
    "alone": [],
}
"""Scenes in which only what lies beyond the graphs differs."""

OF_WORLD: Final = (
    "USING SCOPE world MATCH (a:Bus) RETURN trace.name, a.name, a.x",
    "USING SCOPE world MATCH (a:Bus) WHERE EXISTS {(a)-[:follows]->(b:Truck)} RETURN trace.name, a.x",
    "USING SCOPE world MATCH (a:Bus) WHERE NOT EXISTS {(a)-[:follows]->(b:Truck)} RETURN trace.name, COUNT(*)",
    "USING SCOPE world MATCH (a:Bus), (b:Truck) RETURN trace.name, MIN(gap(a, b)), COUNT(*)",
    "MATCH (a:Bus) WHERE EXISTS {(a)-[:follows]->(b:Truck)} RETURN trace.name, COUNT(*)",
)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, Collection]:
    """A store of the scenes, and a collection with each of them in a bundle."""
    folder = tmp_path_factory.mktemp("fleet")
    scenes = {name: Scene(WAYS, ego(along(-1.75), 10), *far) for name, far in FAR.items()}
    store = of_scenes(folder, ranged(50, 200), scenes)
    assert len(pack(store.file.path, folder / "many", bundle_traces=1).bundles) == len(FAR)
    return store, Collection(folder / "many")


@pytest.mark.parametrize("text", OF_WORLD)
def test_a_collection_looks_beyond_graphs_as_a_store_does(
    fleet: tuple[Store, Collection], text: str
) -> None:
    store, whole = fleet
    wanted = store.find(text).rows()
    assert bool(wanted) == text.startswith("USING")
    assert list(map(tuple, whole.find(text).rows())) == list(map(tuple, wanted))


@pytest.mark.parametrize(
    "text",
    [
        "CHECK apart: FORALL (a:Bus) ALWAYS NOT EXISTS {(a)-[:follows]->(b:Truck)}",
        "CHECK free: FORALL (a:Bus) ALWAYS gap(ego, a) > 100",
        "USING SCOPE graph CHECK free: FORALL (a:Bus) ALWAYS gap(ego, a) > 100",
        "USING RANGE 300 CHECK wide: FORALL (a:Bus) ALWAYS gap(ego, a) > 10",
    ],
)
def test_a_collection_checks_beyond_graphs_as_a_store_does(
    fleet: tuple[Store, Collection], text: str
) -> None:
    store, whole = fleet
    wanted = list(store.check(text))
    assert ("false" in {one.verdict for one in wanted}) == text.startswith("CHECK")
    found = list(whole.check(text))
    assert [str(one) for one in found] == [str(one) for one in wanted]
    assert [one.reason for one in found] == [one.reason for one in wanted]
    assert [one.violations for one in found] == [one.violations for one in wanted]
    assert [one.witnesses for one in found] == [one.witnesses for one in wanted]


def test_bundles_that_cannot_answer_beyond_graphs_stay_closed(
    fleet: tuple[Store, Collection],
) -> None:
    _, whole = fleet
    whole.find(OF_WORLD[1]).rows()
    home = {row["name"]: row["bundle"] for row in whole.traces()}
    assert whole.opened == [home["together"]]


def test_a_store_that_is_sorted_keeps_the_rows_beyond_graphs(copied: Path) -> None:
    before = beyond(copied)
    StoreFile(copied).compact()
    assert beyond(copied) == before
    assert not StoreFile(copied).verify().faults


def test_a_trace_goes_with_its_rows_beyond_graphs(copied: Path) -> None:
    (trace,) = StoreFile(copied).traces()
    StoreFile(copied).remove(trace.name)
    assert not any(beyond(copied).values())


def test_a_store_of_version_4_is_refused_and_gets_its_rows_beyond_graphs_from_the_recording(
    copied: Path,
) -> None:
    known = beyond(copied)
    with duckdb.connect(str(copied)) as connection:
        views = connection.execute(
            "SELECT schema_name, view_name FROM duckdb_views() WHERE NOT internal"
            " AND (view_name LIKE 'world%' OR view_name LIKE 'known%')"
        ).fetchall()
        for schema, view in views:
            connection.execute(f"DROP VIEW {schema}.{view}")
        for table in known:
            connection.execute(f"DROP TABLE inside.{table}")
        connection.execute("UPDATE inside.store_info SET value = '4' WHERE key = 'schema_version'")
        settings = connection.execute("SELECT settings FROM inside.config").fetchall()[0][0]
        old = json.loads(settings)
        assert old["range"].pop("world") == 200.0
        connection.execute("UPDATE inside.config SET settings = ?", [json.dumps(old)])
    with pytest.raises(StoreError, match=r"a store of version 4, expected 5 .*'sgstore rebuild'"):
        Store(copied).sql("FROM world_nodes")
    rebuild(copied)
    assert beyond(copied) == known
