"""Where traffic can flow on, change lanes, and come into conflict: small maps in which one can see it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from opendrive_maps import a_map, a_road, arc, element, lane, line, link, mark, section

from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

TWO_WAY = section(lane(1), lane(0), lane(-1))


def pairs(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    """Names of both ends of all edges of a relation."""
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE[relation])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


def test_traffic_flows_on_from_section_to_section_each_way() -> None:
    sections = section(lane(1, after=1), lane(0), lane(-1, after=-2)) + section(
        lane(1, before=1), lane(0), lane(-1), lane(-2, before=-1), s=20
    )

    road_map = read_map(a_map(a_road("1", line(40.0), sections=sections)), "road")

    assert pairs(road_map, "travelsTo") == {("1/0/-1", "1/1/-2"), ("1/1/1", "1/0/1")}


def test_traffic_flows_on_from_road_to_road_at_the_point_of_contact() -> None:
    crossed = section(lane(1, after=-1), lane(0), lane(-1, after=1))
    plans = {"1": line(40.0), "2": line(40.0, x=80.0, hdg=np.pi)}
    roads = [
        a_road(name, plan, sections=crossed, links=link("successor", "road", other, "end"))
        for (name, plan), other in zip(plans.items(), "21", strict=True)
    ]

    road_map = read_map(a_map(*roads), "head on")

    assert pairs(road_map, "travelsTo") == {("1/0/-1", "2/0/1"), ("2/0/-1", "1/0/1")}


def test_a_link_to_the_wrong_lane_is_a_warning_and_the_touching_lane_counts() -> None:
    kept = section(lane(1, after=1), lane(0), lane(-1, after=-1))
    plans = {"1": line(40.0), "2": line(40.0, x=80.0, hdg=np.pi)}
    roads = [
        a_road(name, plan, sections=kept, links=link("successor", "road", other, "end"))
        for (name, plan), other in zip(plans.items(), "21", strict=True)
    ]

    road_map = read_map(a_map(*roads), "head on")

    assert pairs(road_map, "travelsTo") == {("1/0/-1", "2/0/1"), ("2/0/-1", "1/0/1")}
    assert len([w for w in road_map.warnings if "meets head on" in w]) == 2


def crossing(*connections: str, kind: str = "default") -> str:
    """A T of one-way ways through junction 9: road 1 leads in, 10 and 11 through, 2 and 3 out."""
    into = a_road("1", line(40.0), sections=TWO_WAY, links=link("successor", "junction", "9"))
    through = [
        a_road(
            name,
            plan,
            sections=section(lane(0), lane(-1, before=-1, after=-1)),
            links=link("predecessor", "road", "1", "end") + link("successor", "road", out, "start"),
            junction="9",
        )
        for name, plan, out in (
            ("10", line(20.0, x=40.0), "2"),
            ("11", arc(15.0, 0.1, x=40.0), "3"),
        )
    ]
    out = [
        a_road(name, line(30.0, x=x, y=y), links=link("predecessor", "junction", "9"))
        for name, x, y in (("2", 60.0, 0.0), ("3", 55.0, 20.0))
    ]
    return a_map(into, *through, *out, element("junction", *connections, id="9", type=kind))


def connection(incoming: str, onward: str, *lanes: tuple[int, int], contact: str = "start") -> str:
    links = (element("laneLink", **{"from": a, "to": b}) for a, b in lanes)
    return element(
        "connection",
        *links,
        id="0",
        incomingRoad=incoming,
        connectingRoad=onward,
        contactPoint=contact,
    )


def test_traffic_flows_through_a_junction_along_its_connections() -> None:
    text = crossing(connection("1", "10", (-1, -1)), connection("1", "11", (-1, -1)))

    road_map = read_map(text, "junction")

    assert pairs(road_map, "travelsTo") == {
        ("1/0/-1", "10/0/-1"),
        ("1/0/-1", "11/0/-1"),
        ("10/0/-1", "2/0/-1"),
        ("11/0/-1", "3/0/-1"),
    }


def test_a_junction_does_not_let_in_traffic_that_it_does_not_connect() -> None:
    road_map = read_map(crossing(connection("1", "10", (-1, -1))), "junction")

    assert ("1/0/-1", "11/0/-1") not in pairs(road_map, "travelsTo")


def test_a_link_from_tail_to_tail_is_no_way_for_traffic() -> None:
    road_map = read_map(crossing(connection("1", "10", (-1, -1), (1, -1))), "junction")

    assert not [pair for pair in pairs(road_map, "travelsTo") if pair[0] == "1/0/1"]


def test_connections_to_missing_roads_are_told_and_passed_over() -> None:
    road_map = read_map(
        crossing(connection("1", "10", (-1, -1)), connection("1", "99", (-1, -1))), "j"
    )

    assert [w for w in road_map.warnings if "'99'" in w]


def test_a_direct_junction_joins_roads_both_ways() -> None:
    main = a_road("1", line(40.0), sections=TWO_WAY, links=link("successor", "junction", "9"))
    onward = a_road(
        "2", line(40.0, x=40.0), sections=TWO_WAY, links=link("predecessor", "junction", "9")
    )
    joint = connection("1", "2", (1, 1), (-1, -1)).replace("connectingRoad", "linkedRoad")

    road_map = read_map(
        a_map(main, onward, element("junction", joint, id="9", type="direct")), "direct"
    )

    assert pairs(road_map, "travelsTo") == {("1/0/-1", "2/0/-1"), ("2/0/1", "1/0/1")}


def test_a_virtual_junction_branches_off_and_leads_back_in_the_middle_of_its_main_road() -> None:
    main = a_road(
        "1",
        line(100.0),
        sections=section(lane(0), lane(-1, after=-1)) + section(lane(0), lane(-1), s=50),
    )
    branch = a_road(
        "2",
        arc(20.0, -0.05, x=30.0),
        sections=section(lane(0), lane(-1, before=-1, after=-1)),
        links=link("predecessor", "road", "1", elementS=30, elementDir="+")
        + link("successor", "road", "1", elementS=70, elementDir="+"),
        junction="9",
    )
    junction = element(
        "junction",
        connection("1", "2", (-1, -1)),
        id="9",
        type="virtual",
        mainRoad="1",
        sStart=30,
        sEnd=70,
        orientation="+",
    )

    road_map = read_map(a_map(main, branch, junction), "virtual")

    assert pairs(road_map, "travelsTo") == {
        ("1/0/-1", "1/1/-1"),
        ("1/0/-1", "2/0/-1"),
        ("2/0/-1", "1/1/-1"),
    }


def test_traffic_both_ways_flows_on_both_ways_and_opposes_its_neighbours() -> None:
    sections = section(
        lane(1), lane(0), lane(-1, kind="bidirectional", after=-1), lane(-2, after=-2)
    ) + section(lane(0), lane(-1, kind="bidirectional", before=-1), lane(-2, before=-2), s=20)

    road_map = read_map(a_map(a_road("1", line(40.0), sections=sections)), "both ways")

    flow = pairs(road_map, "travelsTo")
    assert {("1/0/-1", "1/1/-1"), ("1/1/-1", "1/0/-1"), ("1/0/-2", "1/1/-2")} == flow
    assert ("1/0/-2", "1/0/-1") in pairs(road_map, "opposes")


def test_left_hand_traffic_is_right_hand_traffic_turned_round() -> None:
    sections = section(lane(1, after=1), lane(0), lane(-1, after=-1)) + section(
        lane(1, before=1), lane(0), lane(-1, before=-1), s=20
    )

    left = read_map(a_map(a_road("1", line(40.0), sections=sections, rule="LHT")), "left")
    right = read_map(a_map(a_road("1", line(40.0), sections=sections)), "right")

    assert pairs(left, "travelsTo") == {("1/0/1", "1/1/1"), ("1/1/-1", "1/0/-1")}
    assert pairs(left, "travelsTo") == {(b, a) for a, b in pairs(right, "travelsTo")}
    assert (
        pairs(left, "toRightOf")
        == pairs(right, "toLeftOf")
        == {(f"1/{i}/{a}", f"1/{i}/{b}") for i in (0, 1) for a, b in ((1, -1), (-1, 1))}
    )


def test_left_and_right_are_as_traffic_in_the_lane_sees_them() -> None:
    lanes = section(lane(1), lane(0), lane(-1), lane(-2), lane(-3, kind="sidewalk"))
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "road")

    assert pairs(road_map, "toLeftOf") == {
        ("1/0/-1", "1/0/1"),
        ("1/0/1", "1/0/-1"),
        ("1/0/-1", "1/0/-2"),
        ("1/0/-2", "1/0/-3"),
    }
    assert pairs(road_map, "toRightOf") == {("1/0/-2", "1/0/-1"), ("1/0/-3", "1/0/-2")}
    assert pairs(road_map, "opposes") == {("1/0/-1", "1/0/1"), ("1/0/1", "1/0/-1")}


def test_lanes_across_a_median_are_neighbours_and_oppose_one_another() -> None:
    lanes = section(lane(2), lane(1, kind="median"), lane(0), lane(-1))
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "road")

    assert pairs(road_map, "opposes") == {("1/0/2", "1/0/-1"), ("1/0/-1", "1/0/2")}
    assert {("1/0/2", "1/0/-1"), ("1/0/1", "1/0/-1")} <= pairs(road_map, "toLeftOf")


@pytest.mark.parametrize(
    ("kind", "attribute", "owner", "expected"),
    [
        ("broken", "", -1, (True, True)),
        ("solid", "", -1, (False, False)),
        ("solid", "both", -1, (True, True)),
        ("broken", "none", -1, (False, False)),
        ("solid", "increase", -1, (True, False)),
        ("solid", "decrease", 1, (False, True)),
        ("none", "", -1, (True, True)),
        ("curb", "", -1, (False, False)),
        ("solid solid", "", 0, (False, False)),
        # Right of the centre the inner line is the left one, and traffic beside the broken one may cross.
        ("solid broken", "", -1, (True, False)),
        ("broken solid", "", -1, (False, True)),
        ("solid broken", "", 1, (False, True)),
        ("broken solid", "", 1, (True, False)),
        ("solid broken", "", 0, (True, False)),
    ],
)  # fmt: skip
def test_a_mark_permits_what_its_attribute_says_else_what_its_type_does(
    kind: str, attribute: str, owner: int, expected: tuple[bool, bool]
) -> None:
    line_of = mark(kind, laneChange=attribute)
    both = {"kind": "bidirectional"}  # else no change across the centre
    lanes = {
        -1: section(lane(0), lane(-1, line_of), lane(-2)),
        0: section(lane(1, **both), lane(0, line_of), lane(-1, **both)),
        1: section(lane(2), lane(1, line_of), lane(0)),
    }[owner]
    higher, lower = {-1: (-1, -2), 0: (1, -1), 1: (2, 1)}[owner]

    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "road")

    changes, names = road_map.lane_changes, road_map.nodes.name[1:]
    ways = {(names[a], names[b]) for a, b in zip(changes.lane, changes.to, strict=True)}
    up, down = (f"1/0/{lower}", f"1/0/{higher}"), (f"1/0/{higher}", f"1/0/{lower}")
    assert (up in ways, down in ways) == expected
    assert ways <= {up, down}


def test_lanes_may_be_changed_where_the_mark_between_them_permits_it() -> None:
    marked = lane(
        -1, mark("solid"), mark("broken", s=10), mark("solid", s=30, laneChange="decrease")
    )
    sections = section(
        lane(1), lane(0, mark("broken")), marked, lane(-2), lane(-3, kind="shoulder")
    )

    road_map = read_map(a_map(a_road("1", line(40.0), sections=sections)), "road")

    assert pairs(road_map, "laneChange") == {("1/0/-1", "1/0/-2"), ("1/0/-2", "1/0/-1")}
    changes = road_map.lane_changes
    inner = road_map.nodes.name.index("1/0/-1") - 1
    table = dict(
        zip(changes.lane.tolist(), zip(changes.start, changes.end, strict=True), strict=True)
    )
    assert table[inner] == (pytest.approx(10), pytest.approx(40))
    assert table[inner + 1] == (pytest.approx(10), pytest.approx(30))


def test_on_lanes_that_run_against_the_road_stretches_are_measured_from_their_start() -> None:
    marked = lane(1, mark("solid"), mark("broken", s=30))
    sections = section(lane(2), marked, lane(0))

    changes = read_map(a_map(a_road("1", line(40.0), sections=sections)), "road").lane_changes

    assert changes.start.tolist() == pytest.approx([0, 0])
    assert changes.end.tolist() == pytest.approx([10, 10])


def plain_crossing(level: float = 0.0) -> str:
    """Two roads that cross, one that merges into the first, one that runs beside it, all in junction 9."""
    height = element("elevation", s=0, a=level, b=0, c=0, d=0)
    out = link("successor", "road", "out", "start")
    onward = section(lane(0), lane(-1, after=-1))
    return a_map(
        a_road("a", line(40.0), junction="9", sections=onward, links=out),
        a_road("b", line(40.0, x=20.0, y=-20.0, hdg=np.pi / 2), junction="9", elevation=height),
        a_road(
            "c",
            arc(31.4, -0.05, x=20.0, y=-20.0, hdg=np.pi / 2),
            junction="9",
            sections=onward,
            links=out,
        ),
        a_road("d", line(40.0, y=10.0), junction="9"),
        a_road("out", line(40.0, x=40.0), sections=section(lane(0), lane(-1, before=-1))),
        '<junction id="9"/>',
    )


def test_lanes_of_a_junction_conflict_where_they_cross_or_merge() -> None:
    found = pairs(read_map(plain_crossing(), "crossing"), "conflictsWith")

    # b and c part from one place, and d crosses b alone.
    expected = {("a", "b"), ("a", "c"), ("b", "d")}
    assert {tuple(name[0] for name in pair) for pair in found} == expected | {
        (y, x) for x, y in expected
    }


def test_lanes_that_flow_into_one_lane_merge_wherever_they_end() -> None:
    out = link("successor", "road", "out", "start")
    onward = section(lane(0), lane(-1, after=-1))
    text = a_map(
        a_road("a", line(40.0), junction="9", sections=onward, links=out),
        a_road("b", line(38.0, y=3.5), junction="9", sections=onward, links=out),
        a_road("c", line(38.0, y=7.0), junction="9"),
        a_road("out", line(40.0, x=40.0), sections=section(lane(0), lane(-1, before=-1))),
        '<junction id="9"/>',
    )

    found = pairs(read_map(text, "merging"), "conflictsWith")

    assert found == {("a/0/-1", "b/0/-1"), ("b/0/-1", "a/0/-1")}


def test_lanes_that_part_from_one_place_do_not_conflict_even_if_they_cross_again() -> None:
    away = arc(10.0, -0.03), arc(30.0, 0.08, s=10.0, x=9.851, y=-1.489, hdg=-0.3)
    text = a_map(
        a_road("a", line(40.0), junction="9"),
        a_road("b", *away, junction="9"),
        a_road("c", *(part.replace('x="', 'x="1') for part in away), junction="9"),
        '<junction id="9"/>',
    )

    found = pairs(read_map(text, "parting"), "conflictsWith")

    assert ("a/0/-1", "b/0/-1") not in found
    assert ("a/0/-1", "c/0/-1") in found  # the same from another place


def test_lanes_on_different_storeys_do_not_conflict() -> None:
    found = pairs(read_map(plain_crossing(level=6.0), "bridge"), "conflictsWith")

    assert {frozenset(name[0] for name in pair) for pair in found} == {frozenset("ac")}


@pytest.mark.data
def test_the_direct_junction_of_soderleden_joins_what_the_standard_says(data: Path) -> None:
    text = (data / "maps/soderleden.xodr").read_text(encoding="utf-8")

    flow = pairs(read_map(text, "soderleden"), "travelsTo")

    at_junction = {(a, b) for a, b in flow if {a.split("/")[0], b.split("/")[0]} & {"0"}}
    assert {
        ("2/1/-1", "0/0/-1"),
        ("2/1/-2", "0/0/-2"),
        ("0/0/1", "2/1/1"),
        ("0/0/2", "2/1/2"),
        ("5/0/-1", "0/0/-3"),
        ("5/0/-2", "0/0/-4"),
        ("5/0/-3", "0/0/-5"),
    } <= at_junction
    assert ("0/0/-1", "2/1/-1") not in flow
