"""Lanes told as lines and links: their surface against their own formulas, and what touches what."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgstore.errors import MapError
from sgstore.maps.opendrive import parse_map
from sgstore.maps.roads import (
    Area,
    Border,
    Joint,
    LaneLine,
    RoadMap,
    lane_text,
    plain_lanes,
)
from sgstore.model.vocabulary import RELATION_CODE


def path(*points: tuple[float, ...]) -> np.ndarray:
    """A line of points (x, y) or (x, y, z)."""
    return np.array([(*point, 0.0)[:3] for point in points])


def a_line(ident: str, y: float = 0.0, x: float = 0.0, **more: Any) -> LaneLine:
    """A lane of 100 m along x, and borders 1.75 m beside it."""
    lane = {
        "type": "driving",
        "centre": path((x, y), (x + 100, y)),
        "lefts": (Border(path((x, y + 1.75), (x + 100, y + 1.75))),),
        "rights": (Border(path((x, y - 1.75), (x + 100, y - 1.75))),),
    }
    return LaneLine(ident, **(lane | more))


def made(*lines: LaneLine, areas: tuple[Area, ...] = ()) -> RoadMap:
    lanes, warnings = plain_lanes(lines, areas)
    return parse_map(lane_text(lanes, warnings), "lines")


def pairs(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE[relation])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


def test_a_lane_lies_between_its_borders() -> None:
    nodes = made(a_line("1", 5.0)).nodes

    assert (nodes.length[1], nodes.width[1]) == (pytest.approx(100), pytest.approx(3.5))
    assert (nodes.x[1], nodes.y[1], nodes.heading[1]) == (pytest.approx(50), pytest.approx(5), 0)


def test_a_lane_whose_traffic_runs_against_its_line_is_turned_round() -> None:
    lane = a_line("1", rights=(Border(path((0, -1), (100, -1))),), forward=False)
    road_map = made(lane)

    ribbons = road_map.ribbons
    assert abs(ribbons.heading[0]) == pytest.approx(pi)
    assert (ribbons.left_y[0], ribbons.right_y[0]) == (-1, 1.75)
    assert ribbons.at(np.zeros(1, int), np.zeros(1)).x[0] == pytest.approx(100)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_bend_told_in_points_of_its_own_for_each_line_is_a_part_of_a_circle(sign: int) -> None:
    def ring(radius: float, n: int) -> np.ndarray:
        angle = np.linspace(0, pi / 2, n)
        return np.column_stack(
            (radius * np.sin(angle), sign * (30 - radius * np.cos(angle)), np.zeros(n))
        )

    inner, outer = Border(ring(28.0, 17)), Border(ring(32.0, 29))
    sides = (inner, outer)[::sign]
    road_map = made(a_line("1", centre=ring(30.0, 23), lefts=sides[:1], rights=sides[1:]))

    points = road_map.waypoints(0.5)
    away = np.hypot(points.x, points.y - sign * 30)
    # Lines of 17 points stray from the circle by 28 (1 - cos(π / 64)) = 3.4 cm.
    assert np.abs(away - 30).max() < 0.04
    assert np.abs(points.width - 4).max() < 0.08
    turn = np.arctan2(points.x, 30 - sign * points.y)
    assert np.abs(np.sin(points.heading - sign * turn)).max() < 0.05
    assert points.heading[-1] - points.heading[0] == pytest.approx(sign * pi / 2, abs=0.1)
    assert road_map.nodes.length[1] == pytest.approx(15 * pi, rel=2e-3)


def test_borders_in_pieces_with_a_gap_keep_the_width_beside_the_gap() -> None:
    pieces = path((0, 2), (40, 2)), path((60, 2), (100, 2))
    road_map = made(
        a_line("1", lefts=tuple(map(Border, pieces)), centre=path(*((x, 0) for x in range(101))))
    )

    assert road_map.waypoints(1.0).width == pytest.approx(np.full(101, 3.75), abs=1e-3)


def test_a_lane_with_a_border_on_one_side_is_as_wide_on_the_other() -> None:
    for side in ("lefts", "rights"):
        road_map = made(a_line("1", **{side: ()}))
        assert road_map.nodes.width[1] == pytest.approx(3.5)
        assert road_map.nodes.y[1] == pytest.approx(0)
        assert road_map.warnings == ()


def test_lanes_without_borders_are_as_wide_as_they_are_apart_and_it_is_said() -> None:
    bare = {"lefts": (), "rights": ()}
    road_map = made(
        a_line("1", **bare, left_beside=("2",)),
        a_line("2", 3.0, **bare, right_beside=("1",)),
        a_line("3", 50.0, **bare),
        a_line("4", 70.0, **bare, left_beside=("3",)),
    )

    assert road_map.nodes.width[1:5].tolist() == pytest.approx([3.0, 3.0, 3.5, 3.5])
    assert [w for w in road_map.warnings if "1, 2, 3, 4" in w and "no boundary" in w]


def test_heights_are_those_of_the_centre_line() -> None:
    road_map = made(a_line("1", centre=path((0, 0, 2), (50, 0, 4), (100, 0, 4))))

    points = road_map.waypoints(25.0)

    assert points.z.tolist() == pytest.approx([2, 3, 4, 4, 4])


# Links ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("told", ["by both", "by the first", "by the second"])
@pytest.mark.parametrize("turned", [False, True], ids=["along", "against its line"])
def test_traffic_flows_on_to_the_lane_that_touches_the_end(told: str, turned: bool) -> None:
    """The second lane's line may run towards the first; its traffic runs away from it."""
    after = (Joint("2"),) * (told != "by the second")
    back = (Joint("1"),) * (told != "by the first")
    second = path((200, 0), (100, 0)) if turned else path((100, 0), (200, 0))
    links = {"after": back} if turned else {"before": back}
    road_map = made(
        a_line("1", after=after),
        a_line("2", x=100, centre=second, forward=not turned, lefts=(), **links),
    )

    assert pairs(road_map, "travelsTo") == {("1", "2")}


def test_traffic_does_not_flow_into_the_end_of_a_lane_unless_it_runs_both_ways() -> None:
    one, other = a_line("1", after=(Joint("2"),)), {"x": 100.0, "before": (Joint("1"),)}

    against = made(one, a_line("2", **other, forward=False))
    both = made(one, a_line("2", **other, both=True))

    assert pairs(against, "travelsTo") == set()
    assert pairs(both, "travelsTo") == {("1", "2")}


def test_what_is_told_to_touch_far_away_does_not_and_it_is_said() -> None:
    road_map = made(a_line("1", after=(Joint("2"), Joint("9"))), a_line("2", x=110))

    assert pairs(road_map, "travelsTo") == set()
    assert [w for w in road_map.warnings if "1 to 2" in w and "5.0 m apart" in w]


def test_a_small_gap_before_the_next_lane_is_closed() -> None:
    road_map = made(a_line("1", after=(Joint("2"),)), a_line("2", x=100.5, y=0.1))

    assert road_map.nodes.length[1:3].tolist() == pytest.approx([100.51, 100], abs=1e-3)
    between = road_map.lanes_of(np.array([(100.25, 0.0, 0.0, 0.0, 0.0)]), np.zeros(1))
    assert {road_map.nodes.name[-1 - n] for n in between.lane} == {"1"}


def test_a_ring_of_two_lanes_knows_which_end_is_which() -> None:
    angle = np.linspace(0, pi, 30)
    half = np.column_stack((20 * np.cos(angle), 20 * np.sin(angle), 0 * angle))
    bare = {"lefts": (), "rights": ()}
    links = {"before": (Joint("2"),), "after": (Joint("2"),)}
    back = {"before": (Joint("1"),), "after": (Joint("1"),)}

    road_map = made(
        a_line("1", centre=half, **bare, **links), a_line("2", centre=-half, **bare, **back)
    )

    assert pairs(road_map, "travelsTo") == {("1", "2"), ("2", "1")}


def crossing() -> tuple[list[LaneLine], Area]:
    """An area 20 m wide, from the west in, to the east and the north out."""
    lines = [
        a_line("west", x=-100, after=(Joint("area"),)),
        a_line("east", x=20, before=(Joint("area"),), type="driving"),
        a_line(
            "north",
            centre=path((10, 110), (10, 10)),
            lefts=(Border(path((12, 110), (12, 10))),),
            rights=(Border(path((8, 110), (8, 10))),),
            forward=False,
            after=(Joint("area"),),
        ),
    ]
    return lines, Area("area", (("west", "east"), ("west", "north"), ("west", "gone")))


def test_the_ways_through_an_area_are_lanes() -> None:
    lines, area = crossing()
    road_map = made(*lines, areas=(area,))
    nodes = road_map.nodes

    ways = [row for row in range(len(nodes)) if nodes.junction[row] == "area"]
    assert [nodes.name[row] for row in ways] == ["area/0/1", "area/0/2", "area", "area"]
    assert [nodes.turn[row] for row in ways[:2]] == ["straight", "left"]
    assert pairs(road_map, "travelsTo") == {
        ("west", "area/0/1"),
        ("area/0/1", "east"),
        ("west", "area/0/2"),
        ("area/0/2", "north"),
    }
    assert [w for w in road_map.warnings if "area" in w and "missing lane" in w]
    points = road_map.waypoints(0.5)
    straight, left = (points.lane == row - 1 for row in ways[:2])
    assert np.abs(points.y[straight]).max() < 1e-3
    # A quarter of a circle around (0, 10), as a cubic has it; from 3.5 m wide to 4 m.
    assert np.abs(np.hypot(points.x[left], points.y[left] - 10) - 10).max() < 0.01
    assert points.width[left][[0, -1]].tolist() == pytest.approx([3.5, 4.0], abs=0.05)
    assert ("area/0/1", "area/0/2") not in pairs(road_map, "conflictsWith")


def test_a_way_that_the_lanes_at_its_ends_do_not_know_is_none_and_it_is_said() -> None:
    lines, _ = crossing()
    lines.append(a_line("far", x=900, before=(Joint("other"),)))
    lines.append(a_line("silent", x=20, y=3.5))

    road_map = made(*lines, areas=(Area("area", (("west", "far"), ("west", "silent"))),))

    assert pairs(road_map, "travelsTo") == {("west", "area/0/1"), ("area/0/1", "silent")}
    assert [w for w in road_map.warnings if "area from west to far" in w]


def test_lanes_that_lie_in_a_junction_without_a_name_are_grouped_by_where_they_are() -> None:
    def way(ident: str, *points: tuple[float, float]) -> LaneLine:
        return LaneLine(ident, "driving", path(*points), junction=None)

    road_map = made(
        way("1", (0, 0), (40, 0)),
        way("2", (20, -20), (20, 20)),
        way("3", (500, 0), (540, 0)),
        a_line("4", y=300),
    )

    assert road_map.nodes.junction[1:5] == ("1", "1", "3", "")
    assert pairs(road_map, "conflictsWith") == {("1", "2"), ("2", "1")}


# Side by side --------------------------------------------------------------------------------------


@pytest.mark.parametrize("told", ["by both", "by the left", "by the right"])
def test_neighbours_are_neighbours_whoever_tells_it(told: str) -> None:
    right = ("1",) * (told != "by the right")
    left = ("2",) * (told != "by the left")

    road_map = made(a_line("1", left_beside=left), a_line("2", 3.5, right_beside=right))

    assert pairs(road_map, "toLeftOf") == {("2", "1")}
    assert pairs(road_map, "toRightOf") == {("1", "2")}
    assert pairs(road_map, "opposes") == set()


@pytest.mark.parametrize("line_turned", [False, True], ids=["one direction", "lines turned round"])
def test_oncoming_lanes_are_to_the_left_of_one_another_and_oppose(line_turned: bool) -> None:
    oncoming = a_line("2", 3.5, forward=False, right_beside=("1",))
    if line_turned:
        borders = (Border(path((100, 1.75), (0, 1.75))),), (Border(path((100, 5.25), (0, 5.25))),)
        centre = path((100, 3.5), (0, 3.5))
        oncoming = LaneLine(
            "2", "driving", centre, lefts=borders[0], rights=borders[1], left_beside=("1",)
        )

    road_map = made(a_line("1"), oncoming)

    assert pairs(road_map, "toLeftOf") == {("1", "2"), ("2", "1")}
    assert pairs(road_map, "toRightOf") == set()
    assert pairs(road_map, "opposes") == {("1", "2"), ("2", "1")}


def test_lanes_of_traffic_are_neighbours_across_lanes_without() -> None:
    road_map = made(
        a_line("1", left_beside=("m",)),
        a_line("m", 3.5, type="median", left_beside=("n",)),
        a_line("n", 7.0, type="median", forward=False, left_beside=("2",)),
        a_line("2", 10.5, forward=False),
    )

    assert ("1", "2") in pairs(road_map, "opposes")
    assert {("2", "1"), ("1", "2"), ("m", "1")} <= pairs(road_map, "toLeftOf")
    assert ("m", "2") not in pairs(road_map, "opposes")


def test_lanes_may_be_changed_along_borders_that_may_be_crossed() -> None:
    dashed = Border(path((0, 1.75), (60, 1.75)), to_left=True, to_right=True)
    solid = Border(path((60, 1.75), (100, 1.75)), to_left=False, to_right=False)
    road_map = made(
        a_line("1", lefts=(dashed, solid), left_beside=("2",)),
        a_line("2", 3.5, rights=(dashed, solid)),
        a_line("3", 7.0, rights=(Border(path((0, 5.25), (100, 5.25))),), right_beside=("2",)),
    )

    changes = road_map.lane_changes
    found = zip(changes.lane.tolist(), changes.to.tolist(), changes.start, changes.end, strict=True)
    assert set(found) == {(0, 1, 0.0, 60.0), (1, 0, 0.0, 60.0)}
    assert pairs(road_map, "laneChange") == {("1", "2"), ("2", "1")}


def test_where_traffic_runs_against_the_line_changes_are_measured_from_its_start() -> None:
    dashed = Border(path((0, 1.75), (60, 1.75)), to_left=True, to_right=True)
    road_map = made(
        a_line("1", lefts=(dashed,), left_beside=("2",), forward=False),
        a_line("2", 3.5, rights=(dashed,), forward=False),
    )

    changes = road_map.lane_changes
    assert changes.start.tolist() == [40.0, 40.0]
    assert changes.end.tolist() == [100.0, 100.0]


def test_of_two_lines_side_by_side_the_nearer_one_counts() -> None:
    def marks(y: float, allowed: bool) -> Border:
        return Border(path((0, y), (100, y)), to_left=allowed, to_right=allowed)

    double = marks(1.65, allowed=False), marks(1.85, allowed=True)
    road_map = made(
        a_line("1", lefts=double, left_beside=("2",)),
        a_line("2", 3.5, rights=double, right_beside=("1",)),
    )

    assert pairs(road_map, "laneChange") == {("2", "1")}


def test_oncoming_lanes_and_lanes_that_are_not_for_driving_are_not_changed_to() -> None:
    dashed = Border(path((0, 1.75), (100, 1.75)), to_left=True, to_right=True)
    for other in ({"forward": False}, {"type": "sidewalk"}):
        road_map = made(
            a_line("1", lefts=(dashed,), left_beside=("2",)),
            a_line("2", 3.5, rights=(dashed,), **other),
        )
        assert pairs(road_map, "laneChange") == set()


def test_lanes_side_by_side_are_a_road_unless_they_name_one() -> None:
    nodes = made(
        a_line("1", left_beside=("2",)),
        a_line("2", 3.5),
        a_line("3", 50.0),
        a_line("4", 70.0, road="R", section=2, number=-1, name="R/2/-1"),
        a_line("5", 90.0, road="R", section=2, number=-1, name="R/2/-1"),
    ).nodes

    assert nodes.road[1:6] == ("1", "1", "3", "R", "R")
    assert nodes.name[1:6] == ("1", "2", "3", "R/2/-1#4", "R/2/-1#5")
    assert nodes.section[4] == 2
    assert nodes.name[6:] == ("1", "3", "R")


def test_what_is_no_lane_is_left_out_and_said() -> None:
    road_map = made(
        a_line("1"),
        a_line("1", 50.0),
        a_line("point", centre=path((0, 0))),
        a_line("none", centre=np.zeros((0, 3))),
        a_line("still", centre=path((5, 5), (5, 5), (5, 5))),
        *(a_line(f"more{i}", centre=path((0, 0))) for i in range(20)),
    )

    assert road_map.nodes.name == ("off_road", "1", "1")
    assert [w for w in road_map.warnings if "lane 1: there are two" in w]
    assert [w for w in road_map.warnings if "point, none, still" in w and "more19: no" in w]


def test_the_numbers_of_lanes_neighbours_and_ways_are_bounded() -> None:
    line = a_line("1")
    beside = [a_line(str(i), left_beside=("1",) * 100) for i in range(5_001)]
    area = Area("a", (("1", "2"),) * 20_001)
    for lines, areas, reason in (
        ([line], [area], "20,001 ways through intersections; a map may have 20,000"),
        (beside, [], "500,100 neighbours of lanes; a map may have 500,000"),
        ([line] * 30_001, [], "30,001 lanes; a map may have 30,000"),
    ):
        with pytest.raises(MapError, match=reason):
            plain_lanes(lines, areas)


def town(turn: float = 0.0, dx: float = 0.0, dy: float = 0.0) -> list[LaneLine]:
    """The crossing with a neighbour, turned and moved."""

    def there(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        return np.column_stack(
            (cos(turn) * x - sin(turn) * y + dx, sin(turn) * x + cos(turn) * y + dy, z)
        )

    lines, _ = crossing()
    lines.append(a_line("beside", 3.5, x=-100, right_beside=("west",), forward=False))
    return [
        LaneLine(
            line.ident,
            line.type,
            there(line.centre),
            forward=line.forward,
            lefts=tuple(Border(there(b.line), True, True) for b in line.lefts),
            rights=tuple(Border(there(b.line), True, True) for b in line.rights),
            before=line.before,
            after=line.after,
            right_beside=line.right_beside,
        )
        for line in lines
    ]


@given(turn=st.floats(-pi, pi), dx=st.floats(-1e4, 1e4), dy=st.floats(-1e4, 1e4))
@settings(max_examples=20, deadline=None)
def test_to_move_and_turn_all_lines_moves_the_map_with_them(
    turn: float, dx: float, dy: float
) -> None:
    area = crossing()[1]
    here, there = (made(*lines, areas=(area,)) for lines in (town(), town(turn, dx, dy)))

    assert here.nodes.name == there.nodes.name
    for relation in ("travelsTo", "toLeftOf", "toRightOf", "opposes", "laneChange"):
        assert pairs(here, relation) == pairs(there, relation)
    assert there.nodes.length == pytest.approx(here.nodes.length, abs=2e-3, nan_ok=True)
    assert there.nodes.width == pytest.approx(here.nodes.width, abs=2e-3, nan_ok=True)
    x, y = here.nodes.x[1:7], here.nodes.y[1:7]
    assert there.nodes.x[1:7] == pytest.approx(cos(turn) * x - sin(turn) * y + dx, abs=2e-3)
    assert there.nodes.y[1:7] == pytest.approx(sin(turn) * x + cos(turn) * y + dy, abs=2e-3)


def test_every_point_of_a_centre_line_is_in_its_lane() -> None:
    road_map = made(*town(0.3), areas=(crossing()[1],))
    points = road_map.waypoints(0.3)
    boxes = np.column_stack((points.x, points.y, points.heading, np.zeros((len(points), 2))))

    hits = road_map.lanes_of(boxes, points.z)

    found = set(zip(hits.row.tolist(), (-2 - hits.lane).tolist(), strict=True))
    assert set(enumerate(points.lane.tolist())) <= found


def test_a_joint_may_say_which_end_it_touches() -> None:
    road_map = made(
        a_line("1", after=(Joint("2", Joint.START), Joint("3", Joint.END))),
        a_line("2", x=100),
        a_line("3", x=100, centre=path((200, 0), (100, 0)), forward=False, lefts=(), rights=()),
    )

    assert pairs(road_map, "travelsTo") == {("1", "2"), ("1", "3")}
