"""What the orientation of signals without validity means, and what is said where their place contradicts."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from opendrive_maps import a_map, a_road, element, lane, line, link, section
from test_cli_ingest import in_json, sgstore
from test_opendrive_furniture import lanes_of, road_with, signal, valid

from sgstore.maps.opendrive import read_map
from sgstore.model.config import Signs
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

CARLA = Signs(orientation="carla")
LIGHT = {"type": "1000001", "dynamic": "yes"}
JUNCTION = '<junction id="9"/>'


def doubts(road_map: RoadMap) -> list[str]:
    return [warning for warning in road_map.warnings if "<validity>" in warning]


def controls(road_map: RoadMap) -> set[tuple[str, str]]:
    names, edges = road_map.nodes.name, road_map.edges
    rows = np.flatnonzero(edges.relation == RELATION_CODE["controlsTrafficOf"])
    return {(names[-1 - edges.src[row]], names[-1 - edges.dst[row]]) for row in rows}


@pytest.mark.parametrize(
    ("orientation", "lanes"),
    [
        ("+", {"1/0/1"}),
        ("-", {"1/0/-1", "1/0/-2"}),
        ("none", {"1/0/1", "1/0/-1", "1/0/-2"}),
    ],
)
def test_as_carla_reads_it_an_orientation_is_a_side_of_the_road(
    orientation: str, lanes: set[str]
) -> None:
    text = a_map(road_with(signal("s", orientation=orientation) + signal("v", valid(1, 1))))
    road_map = read_map(text, "map", CARLA)

    assert lanes_of(road_map, "s") == lanes
    assert lanes_of(road_map, "v") == {"1/0/1"}
    # A map for which the reading matters is another map.
    same = orientation == "none"
    assert (road_map.digest == read_map(text, "map").digest) == same


def before_junction(end: str, s: float, *, one_way: bool = False, **values: Any) -> str:
    """A map whose road of 200 m touches a junction at one end, with a signal "s" at ``s``."""
    links = link("predecessor" if end == "start" else "successor", "junction", "9")
    lanes = section(lane(0), lane(-1)) if one_way else section(lane(1), lane(0), lane(-1))
    road = a_road("1", line(200.0), sections=lanes, links=links, signals=signal("s", s=s, **values))
    return a_map(road, JUNCTION)


@pytest.mark.parametrize("one_way", [False, True])
@pytest.mark.parametrize("orientation", ["+", "-"])
@pytest.mark.parametrize("end", ["start", "end"])
@pytest.mark.parametrize("reading", ["asam", "carla"])
def test_a_light_before_a_junction_is_for_those_who_come_to_it(
    reading: str, end: str, orientation: str, *, one_way: bool
) -> None:
    s = 5.0 if end == "start" else 195.0
    text = before_junction(end, s, one_way=one_way, orientation=orientation, **LIGHT)
    road_map = read_map(text, "map", Signs(orientation=reading))

    forward = (orientation == "+") == (reading == "asam")  # towards the end of the road
    nobody = one_way and not forward
    astray = not one_way and forward != (end == "end")
    assert len(doubts(road_map)) == (nobody or astray)
    for warning in doubts(road_map):
        other = {"asam": "carla", "carla": "asam"}[reading]
        assert f'1 of 1 would fit with the setting orientation = "{other}"' in warning
        assert "'s'" in warning
        assert not doubts(read_map(text, "map", Signs(orientation=other)))


SILENT: dict[str, dict[str, Any]] = {
    "in the middle of the road": {"s": 100.0} | LIGHT,
    "at the other end": {"s": 195.0} | LIGHT,
    "a speed limit": {"s": 5.0, "type": "274"},
    "for both ways": {"s": 5.0, "orientation": "none"} | LIGHT,
}


@pytest.mark.parametrize("why", SILENT)
def test_where_the_place_tells_nothing_nothing_is_said(why: str) -> None:
    values = {"orientation": "+"} | SILENT[why]
    assert not doubts(read_map(before_junction("start", **values), "map"))


def test_a_validity_is_believed_whatever_the_orientation() -> None:
    text = before_junction("start", 5.0, orientation="+", **LIGHT)
    told = text.replace("></signal>", f">{valid(-1, -1)}</signal>")

    assert doubts(read_map(text, "map"))
    assert told != text
    assert not doubts(read_map(told, "map"))


def test_a_reference_is_looked_at_as_a_signal_is() -> None:
    here = element("signalReference", id="s", s=5, t=0, orientation="+")
    links = link("predecessor", "junction", "9")
    lanes = section(lane(1), lane(0), lane(-1))
    roads = (
        a_road("1", line(200.0), sections=lanes, links=links, signals=here),
        a_road("2", line(50.0, y=50), signals=signal("s", valid(0, 0), **LIGHT)),
    )

    assert doubts(read_map(a_map(*roads, JUNCTION), "map"))


@pytest.mark.data
def test_maps_of_the_standard_are_believed_and_those_of_the_other_reading_are_told_of(
    data: Path,
) -> None:
    texts = {path.stem: path.read_text("utf-8") for path in sorted(data.glob("maps/*.xodr"))}
    assert not [name for name, text in texts.items() if doubts(read_map(text, name))]
    text = texts["multi_intersections"]
    swap = {"+": "-", "-": "+"}
    turned = re.sub(
        r'(<signal(?:Reference)?\b[^>]*\borientation=")([+-])',
        lambda found: found[1] + swap[found[2]],
        text,
    )

    (warning,) = doubts(read_map(turned, "m"))
    # 40 lights for vehicles; the 11 for pedestrians control no driving lane
    assert "40 of 40 would fit" in warning
    asked = read_map(turned, "m", CARLA)
    assert not doubts(asked)
    assert controls(asked) == controls(read_map(text, "m"))


def test_the_setting_holds_from_the_config_file_to_the_lanes_of_a_store(tmp_path: Path) -> None:
    from test_roads_osi import record, two_way

    text = before_junction("start", 5.0, orientation="+", **LIGHT)
    path = record(tmp_path / "d.mcap", two_way(), road_map=text)
    assert "<validity>" in sgstore("map", path).stderr.decode()
    found: dict[str, bool] = {}
    for reading in ("asam", "carla"):
        (tmp_path / "c.toml").write_text(f'orientation = "{reading}"\n')
        store = tmp_path / f"{reading}.sgstore"
        run = sgstore("ingest", store, path, "--config", tmp_path / "c.toml")
        found[reading] = "<validity>" in run.stderr.decode()
        rows = in_json(
            "find", store, "MATCH (s:TrafficLight)-[:controlsTrafficOf]->(l:Lane) RETURN l.name"
        )
        assert {row["l.name"] for row in rows} == {"1/0/-1" if reading == "asam" else "1/0/1"}
    assert found == {"asam": True, "carla": False}
