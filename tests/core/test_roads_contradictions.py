"""Incomplete and contradictory maps of lanes as lines: each record counts, or is a warning."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from commonroad_scenarios import HEAD, lanelet
from lanelet2_maps import LaneletMap
from sumo_recordings import NET

from sgstore.maps.lanelet2 import lanelet2_text
from sgstore.maps.opendrive import parse_map
from sgstore.maps.roads import Joint, LaneLine, Sections, plain_lanes
from sgstore.maps.sumo_net import sumo_net_text
from sgstore.model.vocabulary import RELATION_CODE
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap


def travels(road_map: RoadMap) -> set[tuple[str, str]]:
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE["travelsTo"])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


def sumo(text: str) -> RoadMap:
    return parse_map(sumo_net_text(text), "net")


SUMO = {
    ' to="C" fromLane="1" toLane="0" via=":J_0_0"': (
        ' to="X" fromLane="1" toLane="0" via=":J_0_0"',
        "connections from A_1 to X_0",
    ),
    'fromLane="1" toLane="0" via=":J_0_0"': (
        'fromLane="1" toLane="0" via=":gone"',
        "connections from A_1 to C_0: a lane of it is missing",
    ),
    '<lane id="D_0"': ('<lane id="C_0"', "C_0: there are two of this id"),
    'length="90"': ('length="30"', "lane D_0: length is 30 m, but its shape has 90 m"),
    'id="B_0" index="0"': ('id="B_0" index="0" width="-3"', "B_0: left out, because its width"),
    'tl="J" linkIndex="1"': ('tl="K" linkIndex="1"', "traffic light 'K' is missing"),
    'linkIndex="1"': ('linkIndex="7"', "link '7' of traffic light 'J' is missing"),
    "</net>": ('<roundabout nodes="J" edges="A Q"/></net>', "its edge 'Q' is missing"),
}


@pytest.mark.parametrize("old", SUMO)
def test_records_of_sumo_that_contradict_are_warnings(old: str) -> None:
    new, said = SUMO[old]

    assert said in "\n".join(sumo(NET.replace(old, new, 1)).warnings)


def test_without_a_connection_of_sumo_the_lanes_are_joined_or_a_warning_follows() -> None:
    whole = sumo(NET)
    for line in [one for one in NET.splitlines() if "<connection" in one]:
        road_map = sumo(NET.replace(line, ""))
        assert travels(road_map) == travels(whole) or road_map.warnings, line


def line(ident: str, *points: tuple[float, float], **more: object) -> LaneLine:
    centre = np.array([(*point, 0.0) for point in points])
    sections = more.pop("sections", None) or Sections.across(centre, [], [], 1.75)[0]
    return LaneLine(ident, "driving", centre, sections=sections, **more)


def said_of(*lines: LaneLine) -> tuple[dict[str, set[str]], str]:
    lanes, warnings = plain_lanes(lines)
    return {lane.name: {lanes[row].name for row in lane.onto} for lane in lanes}, "\n".join(
        warnings
    )


@pytest.mark.parametrize("first", [(), (Joint("b", Joint.START),)])
@pytest.mark.parametrize("second", [(), (Joint("a", Joint.END),)])
def test_one_direction_of_a_link_of_lines_is_enough(first: tuple, second: tuple) -> None:
    onto, said = said_of(
        line("a", (0, 0), (30, 0), after=first), line("b", (30, 0), (60, 0), before=second)
    )

    assert onto["a"] == ({"b"} if first or second else set())
    assert said == ""


def test_a_link_of_a_line_to_the_far_end_counts_for_the_end_that_touches() -> None:
    onto, said = said_of(
        line("a", (0, 0), (30, 0), after=(Joint("b", Joint.END),)), line("b", (30, 0), (60, 0))
    )

    assert onto["a"] == {"b"}
    assert "a to b: linked to the far end" in said


def test_lines_that_contradict_are_warnings() -> None:
    swapped = Sections(np.array([(0, 9), (9, 9)]), np.array([(0, 12), (9, 12)]), np.zeros(2))
    _, said = said_of(
        line("a", (0, 0), (30, 0), after=(Joint("b"), Joint("gone")), left_beside=("lost",)),
        line("b", (60, 0), (30, 0), left_beside=("c",), right_beside=("c",)),
        line("c", (0, 5), (30, 5)),
        line("d", (0, 10), (9, 10), sections=swapped),
    )

    for what in (
        "lanes a to gone, a to lost: linked to a missing lane",
        "lane a and b: linked, but their traffic meets head on",
        "lane b and c: neighbours on both sides",
        "lane d: its left border is on the right",
    ):
        assert what in said


def commonroad(path: Path, *lanelets: str, more: str = "") -> str:
    text = HEAD.format(name="m", version="2020a") + "".join(lanelets) + more + "</commonRoad>"
    path.write_text(text, encoding="utf-8")
    with open_trace(path) as trace:
        return "\n".join(parse_map(trace.info.map_text, "m").warnings)


def test_references_of_commonroad_that_contradict_are_warnings(tmp_path: Path) -> None:
    beside = '<adjacentLeft ref="2" drivingDir="opposite"/><successor ref="77"/>'
    refs = '<trafficSignRef ref="8"/><trafficLightRef ref="9"/><speedLimit>-5</speedLimit>'
    said = commonroad(
        tmp_path / "m.xml",
        lanelet(1, [(0, 3), (30, 3)], [(0, 0), (30, 0)], beside + refs),
        lanelet(2, [(0, 6), (30, 6)], [(0, 3), (30, 3)]),
        more='<intersection id="5"><incoming id="6"><incomingLanelet ref="70"/>'
        '<successorsLeft ref="71"/></incoming></intersection><trafficLight id="4"/>',
    )

    for what in (
        "lane 1 to 77: linked to a missing lane",
        "lane 1: its traffic sign 8 is missing",
        "lane 1: its traffic light 9 is missing",
        "lane 1: its neighbour 2 does not run in the opposite direction",
        "lane 1: its speed limit is -5 m/s",
        "traffic light 4: no lane refers to it",
        "intersection 5: its lane 70 is missing",
        "intersection 5: its lane 71 is missing",
    ):
        assert what in said


def test_members_of_lanelet2_that_are_missing_are_warnings_and_nodes_in_one_place_are_one() -> None:
    lanelets = LaneletMap()
    ways = [lanelets.way([(x, y), (x + 30, y)]) for x in (0, 30.001) for y in (3, 0)]
    one, other = lanelets.lanelet(*ways[:2]), lanelets.lanelet(*ways[2:])
    lanelets.element("traffic_light", ("way", 999, "refers"), ("relation", one, "yield"))
    road_map = parse_map(lanelet2_text(lanelets.text()), "m")

    assert travels(road_map) == {(str(one), str(other))}
    assert "its way 999 (refers) is missing" in "\n".join(road_map.warnings)
