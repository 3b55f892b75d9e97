"""Scenarios that a simulator played, found by the names of the library."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from test_docs_queries import queries_of

from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.matches import Interval

pytestmark = pytest.mark.data

RECORDINGS = ("cut-in", "highway_merge", "pedestrian", "traffic_lights")


@pytest.fixture(scope="module")
def store(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A store of what esmini played."""
    path = tmp_path_factory.mktemp("esmini") / "esmini.sgstore"
    ingest(path, [data / "traces" / "esmini" / f"{name}.mcap" for name in RECORDINGS])
    store = Store(path)
    with store.file.snapshot():
        yield store


def found(store: Store, name: str) -> list[Interval]:
    return list(store.find(patterns()[name].text).intervals())


def who(interval: Interval, variable: str) -> str:
    return interval.values[f"{variable}.name"]


def test_people_who_cross_are_found_by_name(store: Store) -> None:
    crossings = found(store, "crossing_pedestrian")

    assert {(c.trace, who(c, "p")) for c in crossings} == {
        ("pedestrian", "person 1"),
        ("traffic_lights", "person 1"),
        ("traffic_lights", "person 2"),
    }
    assert {c.trace for c in found(store, "PedestrianCrossing")} == {"traffic_lights"}


def test_red_phases_are_those_of_the_lights(store: Store) -> None:
    rows = store.sql(
        "SELECT DISTINCT n.name, f.seq FROM nodes n JOIN frames f USING (frame_id) "
        "JOIN edges e ON e.frame_id = n.frame_id AND e.src = n.node_id "
        "WHERE n.light_state = 'red' AND e.relation = 'controlsTrafficOf'"
    )
    phases = found(store, "red_phase")
    told = {(who(p, "t"), seq) for p in phases for seq in range(p.start_seq, p.end_seq + 1)}

    assert {p.trace for p in phases} == {"traffic_lights"}
    assert {who(p, "t") for p in phases} == {"traffic_light 5"}  # 6 and 7 are for pedestrians
    assert told == {tuple(row) for row in rows.values}


def test_cut_ins_are_found_by_name_where_somebody_cuts_in(store: Store) -> None:
    cut_ins = found(store, "cut_in")
    (first,) = (c for c in cut_ins if c.trace == "cut-in")

    assert (who(first, "e"), who(first, "v")) == ("car 0", "car 1")
    assert 7 < first.start < 8 < first.end < 9  # it is half in the ego's lane at 7.9 s
    # In highway_merge the ego changes lane, and the others keep theirs.
    assert {c.trace for c in cut_ins} == {"cut-in"}
    assert {(c.trace, who(c, "v")) for c in found(store, "CutIn")} >= {("cut-in", "car 1")}


def test_the_cut_in_of_the_readme_is_found_where_lines_are_solid(store: Store) -> None:
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (text,) = (text for text in queries_of(readme) if "THEN" in text)

    assert "AS cutter" in text
    assert ("cut-in", "car 1") in {
        (c.trace, c.values["cutter"]) for c in store.find(text).intervals()
    }


def test_who_cuts_in_and_brakes_is_found_by_name(store: Store) -> None:
    assert {(b.trace, who(b, "v")) for b in found(store, "lead_hard_braking")} == {
        ("cut-in", "car 1")
    }


def test_the_ego_waits_at_red_where_there_are_lights(store: Store) -> None:
    (waiting,) = found(store, "waiting_at_red")

    assert waiting.trace == "traffic_lights"


def test_red_lights_for_pedestrians_do_not_hold_the_ego(store: Store) -> None:
    assert found(store, "red_light_running") == []
    verdicts = store.check(patterns()["r_in2_red_light"].text)
    assert {v.trace: v.verdict for v in verdicts}["traffic_lights"] == "true"


def test_red_lights_of_lanes_in_a_junction_hold_vehicles_before_it(
    data: Path, tmp_path: Path
) -> None:
    """Light 33 (signal 367 of road 6, referred to by roads 93 and 108) is red until 12 s."""
    ingest(tmp_path / "a.sgstore", [data / "traces" / "carla" / "Town01.carla.mcap"])
    town = Store(tmp_path / "a.sgstore")

    runs = {(who(r, "x"), who(r, "t"), r.start) for r in found(town, "red_light_running")}
    # From the poses of the messages: when each front passes the end of its lane (CARLA, lights 955 and 957).
    assert runs == {
        ("motorcycle 47", "traffic_light 33", 1.3),
        ("car 36", "traffic_light 33", 4.1),
        ("car 52", "traffic_light 33", 6.4),
        ("car 53", "traffic_light 33", 9.4),
        ("car 49", "traffic_light 35", 5.2),
        ("car 39", "traffic_light 35", 8.9),
    }
    (verdict,) = town.check(patterns()["r_in2_red_light"].text)
    assert verdict.verdict == "false"


def test_people_who_walk_on_the_road_are_found_by_name(store: Store) -> None:
    walkers = {(w.trace, who(w, "p")) for w in found(store, "jaywalking")}

    assert ("pedestrian", "person 1") in walkers
    assert {trace for trace, _ in walkers} == {"pedestrian", "traffic_lights"}
