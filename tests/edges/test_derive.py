"""Deriving other relations from a store: the same edges as ingesting with those settings."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from thorough import LONG, some

import sgstore
from sgstore.errors import AbstractionError, ConfigError
from sgstore.ingest import ingest
from sgstore.model.config import configured
from sgstore.pipeline.derive import derive

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(16)

SAMPLE = resources.files("sgstore") / "apps" / "sample" / "town.mcap"

OTHERS = {
    "thresholds": configured(
        proximity={"names": ["near_coll", "near"], "upper": [6.5, 31.0], "between": "footprints"},
        direction={"upper": [30.0, 60.0, 150.0], "ties": "both", "sides": "closed"},
        pairs={"within": 40.0},
        lanes={"ahead": 35.0},
    ),
    "smaller": configured(range={"radius": 20.0, "by": "centre"}, pairs={"within": 10.0}),
    "rectangle": configured(
        range={"shape": "rectangle", "front": 40, "rear": 5, "side": 10}, without=["overlaps"]
    ),
    "wider": configured(range={"radius": 120.0}),
    "wide_rectangle": configured(range={"shape": "rectangle", "front": 150, "side": 60}),
    "vehicles": configured(kinds=["Vehicle", "Lane"], sees=False, pairs={"ego": False}),
}

EDGES = """
SELECT (e.bucket << 6) + b.bit, e.src, e.relation::VARCHAR, e.dst FROM inside.edge e
JOIN inside.bits b ON (e.mask & b.m) <> 0
"""
DERIVED = """
SELECT (e.bucket << 6) + b.bit, e.src, e.relation::VARCHAR, e.dst FROM inside.derived_edge e
JOIN inside.bits b ON (e.mask & b.m) <> 0 WHERE e.set_name = '{0}'
"""
NODES = "SELECT frame_id, node_id, kind::VARCHAR FROM nodes"
DERIVED_NODES = """
SELECT (n.bucket << 6) + b.bit, n.node_id, n.kind::VARCHAR FROM inside.derived_node n
JOIN inside.bits b ON (n.mask & b.m) <> 0 WHERE n.set_name = '{0}'
"""


SECONDS = 15.0 if LONG else 5.0
"""How much of the sample is derived with all settings."""


def stored(path: Any, trace: Any, config: Any = None, until: float = 15.0):
    (outcome,) = ingest(path, [str(trace)], config=config, until=until)
    assert outcome.error is None
    return sgstore.open(path)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory):
    return stored(tmp_path_factory.mktemp("derive") / "town.sgstore", SAMPLE, until=11)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory):
    return stored(tmp_path_factory.mktemp("short") / "town.sgstore", SAMPLE, until=SECONDS)


def same(derived: Any, name: Any, ingested: Any) -> None:
    """Whether a set has the nodes and edges of a store that was made with its settings."""
    made = set(derived.sql(DERIVED.format(name)).values)
    assert made == set(ingested.sql(EDGES).values)
    assert made
    assert set(derived.sql(DERIVED_NODES.format(name)).values) == set(ingested.sql(NODES).values)
    gaps = "SELECT bucket, bit, src, dst, gap FROM inside."
    kept = derived.sql(f"{gaps}derived_gap WHERE set_name = '{name}'").values
    assert set(kept) == set(ingested.sql(f"{gaps}lane_gap").values)
    (one,) = [s for s in derived.file.deriving.sets() if s.name == name]
    assert one.answers == ingested.info()[0].answers


@pytest.mark.parametrize("name", OTHERS)
def test_a_derived_set_is_what_ingesting_with_its_settings_gives(
    short: Any, name: Any, tmp_path: Path
) -> None:
    (result,) = derive(short.file.path, OTHERS[name], name)
    ingested = stored(tmp_path / "other.sgstore", SAMPLE, OTHERS[name], SECONDS)

    assert (result.status, result.frames) == ("derived", short.info()[0].frames)
    same(short, name, ingested)
    assert not short.file.verify().faults


REAL = (
    *("carla/Town01.carla.mcap", "esmini/traffic_lights.mcap"),
    *("esmini/swarm_Town04.mcap", "osi_converter"),
)


@pytest.mark.parametrize(
    ("path", "name"), some([(path, name) for name in ("thresholds", "wider") for path in REAL], 3)
)
def test_real_traces_derive_to_what_ingesting_gives(
    data: Any, tmp_path: Path, path: Any, name: str
) -> None:
    found = data / "traces" / path
    trace = found if found.is_file() else min(found.glob("*.mcap"))
    config = OTHERS[name]
    store = stored(tmp_path / "a.sgstore", trace)
    derive(store.file.path, config, "other")

    same(store, "other", stored(tmp_path / "b.sgstore", trace, config))


def test_who_follows_farther_off_under_other_settings_has_a_gap_too(
    data: Any, tmp_path: Path
) -> None:
    trace = data / "traces/esmini/highway_merge.mcap"
    near, far = ({"lanes": {"ahead": ahead}} for ahead in (15.0, 90.0))
    store = stored(tmp_path / "near.sgstore", trace, configured(**near))
    derive(store.file.path, configured(**far), "far")
    ingested = stored(tmp_path / "far.sgstore", trace, configured(**far))
    pattern = "MATCH (a)-[f:follows]->(b) RETURN frame.id, a.id, b.id, f.gap"

    gaps = set(ingested.find(pattern).rows())

    assert set(store.find(f"USING ABSTRACTION far {pattern}").rows()) == gaps
    assert len(gaps) > len(store.find(pattern).rows())
    (frame, *_, gap) = max(gaps, key=lambda row: row[-1])[-4:]
    graph = store.graph(frame, abstraction="far")
    assert np.float32(gap) in {about.get("gap") for *_, about in graph.edges(data=True)}


def test_a_wider_set_is_asked_and_drawn_like_a_store_of_its_range(
    data: Any, tmp_path: Path
) -> None:
    trace = data / "traces/esmini/swarm_Town04.mcap"
    store = stored(tmp_path / "near.sgstore", trace)
    derive(store.file.path, OTHERS["wider"], "wider")
    ingested = stored(tmp_path / "far.sgstore", trace, OTHERS["wider"])
    pattern = (
        "MATCH (e:Ego), (v:Vehicle)-[i:isIn]->(l:Lane) WHERE dist(e, v) > 60"
        " RETURN frame.id, v.id, l.id, v.speed, i.offset"
    )

    rows = set(ingested.find(pattern).rows())

    assert len(rows) > 100
    assert set(store.find(f"USING ABSTRACTION wider {pattern}").rows()) == rows
    assert store.find(pattern).rows() == []
    frame = min(rows)[-5]
    derived, drawn = store.graph(frame, abstraction="wider"), ingested.graph(frame)
    assert dict(derived.nodes(data=True)) == dict(drawn.nodes(data=True))
    assert sorted(derived.edges(keys=True)) == sorted(drawn.edges(keys=True))


def test_deriving_needs_no_recording_and_goes_on_where_it_was(tmp_path: Path) -> None:
    copy, store = tmp_path / "drive.mcap", tmp_path / "s.sgstore"
    copy.write_bytes(SAMPLE.read_bytes())
    ingest(store, [str(copy)], until=3.0)
    copy.unlink()

    first = derive(store, OTHERS["smaller"], "mine")
    again = derive(store, OTHERS["smaller"], "Mine")

    assert [r.status for r in first + again] == ["derived", "present"]


def test_a_name_that_is_taken_is_replaced_on_demand_only(town: Any) -> None:
    derive(town.file.path, OTHERS["smaller"], "once")
    with pytest.raises(AbstractionError, match="already, with other settings; add --force"):
        derive(town.file.path, OTHERS["vehicles"], "once")
    derive(town.file.path, OTHERS["vehicles"], "once", replace_old=True)
    relations = town.sql(
        "SELECT DISTINCT relation FROM inside.derived_edge WHERE set_name = 'once'"
    )

    assert ("sees",) not in relations.values
    assert town.file.deriving.remove("once") == ("town",)
    assert not town.sql("SELECT 1 FROM inside.derived_edge WHERE set_name = 'once'").values
    assert not town.file.verify().faults
    with pytest.raises(AbstractionError, match="no derived set"):
        town.file.deriving.remove("once")


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"range": {"radius": 200.1}}, "range"),
        ({"range": {"shape": "rectangle", "front": 190, "rear": 25, "side": 70}}, "range"),
        ({"range": {"shape": "corridor", "length": 250}}, "range"),
        ({"lanes": {"granularity": "waypoint"}}, "lanes.granularity"),
        ({"lanes": {"sections": False}}, "lanes.sections"),
        ({"types": {"vehicle.x": {"kind": "car"}}}, "types"),
    ],
)
def test_what_the_states_do_not_suffice_for_is_refused_with_its_setting(
    town: Any, settings: Any, named: Any
) -> None:
    with pytest.raises(ConfigError, match=f"'{named}' is .* was ingested with"):
        derive(town.file.path, configured(**settings), "larger")


@pytest.mark.parametrize("name", ["RSV", "junction", "a b", "", "'; DROP"])
def test_names_of_abstractions_and_no_names_are_refused(town: Any, name: Any) -> None:
    with pytest.raises(AbstractionError):
        derive(town.file.path, OTHERS["smaller"], name)


def test_a_graph_of_a_set_has_its_nodes_and_edges_and_what_is_known_of_them(town: Any) -> None:
    derive(town.file.path, OTHERS["smaller"], "smaller")
    whole, part = town.graph("town#100"), town.graph("town#100", abstraction="smaller")

    assert set(part.nodes) < set(whole.nodes)
    assert part.nodes[0] == whole.nodes[0]
    frame = part.graph["frame_id"]
    wanted = town.sql(DERIVED.format("smaller") + f" AND (e.bucket << 6) + b.bit = {frame}")
    found = {(a, k, b) for a, b, k in part.edges(keys=True)}
    own = {row[1:] for row in wanted.values}
    of_map = {e for e in found - own if e[0] < 0 and e[2] < 0}
    assert found == own | of_map
    assert {k for _, k, _ in of_map} >= {"opposes", "isIn"}
    assert "mayAffect" not in {k for _, k, _ in of_map}


def test_a_trace_that_is_removed_takes_its_sets_with_it(tmp_path: Path) -> None:
    store = stored(tmp_path / "s.sgstore", SAMPLE, until=3.0)
    derive(store.file.path, OTHERS["smaller"], "gone")
    store.file.remove("town")

    assert store.file.deriving.sets() == ()
    for table in (
        "derived_node",
        "derived_edge",
        "derived_gap",
        "later_class",
        "frame_class",
        "manifest",
    ):
        assert not store.file.rows(f"SELECT 1 FROM {table} LIMIT 1").values
