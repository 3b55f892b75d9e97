"""Reference lines against their own formulas, and lanes stacked on them."""

from __future__ import annotations

from math import cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np
import pytest
import shapely
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    border,
    cubic,
    element,
    lane,
    line,
    param_poly3,
    poly3,
    section,
    spiral,
    width,
)

from sgstore.maps.opendrive import read_map

if TYPE_CHECKING:
    from sgstore.maps.roads import LanePoints, RoadMap

HAIR = 1e-6
"""What two exact ways to the same place may differ by; m."""


def centre(road_map: RoadMap, name: str, along: list[float] | np.ndarray) -> LanePoints:
    """Points of a lane's centre line."""
    row = road_map.nodes.name.index(name) - 1
    along = np.asarray(along, np.float64)
    return road_map.ribbons.at(np.full(len(along), row), along)


def reference(plan: str, at: np.ndarray, **road: str) -> LanePoints:
    """Points of a reference line: the left border of a lane is what it is, so a lane of no width lies on it."""
    lanes = section(lane(0), lane(-1, width(0.0)), lane(-2))
    road_map = read_map(a_map(a_road("1", plan, sections=lanes, **road)), "line")
    row = road_map.nodes.name.index("1/0/-1") - 1
    ribbons = road_map.ribbons
    return ribbons.at(np.full(len(at), row), ribbons.along_at(np.full(len(at), row), at))


AT = np.linspace(0.0, 40.0, 81)


def test_a_line_is_straight() -> None:
    points = reference(line(40.0, x=3.0, y=4.0, hdg=0.7), AT)

    assert np.abs(points.x - (3 + AT * cos(0.7))).max() < HAIR
    assert np.abs(points.y - (4 + AT * sin(0.7))).max() < HAIR
    assert np.abs(points.heading - 0.7).max() < HAIR


@pytest.mark.parametrize("curvature", [0.05, -0.05, 1e-9])
def test_an_arc_is_a_part_of_a_circle(curvature: float) -> None:
    points = reference(arc(40.0, curvature, x=1.0, hdg=0.3), AT)

    turned = curvature * AT
    assert np.abs(np.sin(points.heading - 0.3 - turned)).max() < 1e-4
    radius = 1 / curvature
    centre_x, centre_y = 1 - radius * sin(0.3), radius * cos(0.3)
    if abs(curvature) > 1e-6:
        apart = np.hypot(points.x - centre_x, points.y - centre_y) - abs(radius)
        assert np.abs(apart).max() < 1e-4
        assert np.abs(points.curvature - curvature).max() < 1e-4
    else:
        assert np.abs(points.x - (1 + AT * cos(0.3))).max() < 1e-4


def by_small_steps(curvature: np.ndarray, step: float) -> tuple[float, float, float]:
    """Where a car with these curvatures, one a step, gets to: the textbook's definition of a path."""
    heading = np.concatenate(([0.0], np.cumsum(curvature * step)))
    middle = (heading[1:] + heading[:-1]) / 2
    return (
        float(np.cos(middle).sum() * step),
        float(np.sin(middle).sum() * step),
        float(heading[-1]),
    )


@pytest.mark.parametrize(
    ("length", "first", "last"),
    [(40.0, 0.0, 0.05), (40.0, 0.1, -0.1), (25.0, -0.02, -0.2), (60.0, 0.3, 0.3)],
)
def test_a_spiral_bends_in_proportion_to_its_length(
    length: float, first: float, last: float
) -> None:
    points = reference(spiral(length, first, last), np.array([length / 2, length]))
    steps = 200_000
    s = (np.arange(steps) + 0.5) * length / steps
    curvature = first + (last - first) * s / length

    x, y, heading = by_small_steps(curvature, length / steps)

    assert (points.x[1], points.y[1]) == (pytest.approx(x, abs=1e-5), pytest.approx(y, abs=1e-5))
    assert sin(points.heading[1] - heading) == pytest.approx(0.0, abs=1e-5)
    x, y, _ = by_small_steps(curvature[: steps // 2], length / steps)
    assert hypot(points.x[0] - x, points.y[0] - y) < 2e-4


def arc_length(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(u), np.diff(v)))))


def test_a_poly3_is_a_cubic_over_its_axis_and_s_its_arc_length() -> None:
    a, b, c, d = 0.5, 0.1, 0.02, -0.0004
    u = np.linspace(0.0, 45.0, 400_000)
    v = a + u * (b + u * (c + u * d))
    run = arc_length(u, v)
    x, y = np.interp(AT, run, u), np.interp(AT, run, v)

    points = reference(poly3(40.0, a, b, c, d), AT)

    assert np.hypot(points.x - x, points.y - y).max() < 5e-4


@pytest.mark.parametrize("p_range", ["normalized", "arcLength"])
def test_a_param_poly3_runs_over_its_arc_length(p_range: str) -> None:
    span = 1.0 if p_range == "normalized" else 40.0
    u = (0.0, 30.0 / span, 14.0 / span**2, -6.0 / span**3)
    v = (0.0, 2.0 / span, 9.0 / span**2, 4.0 / span**3)
    p = np.linspace(0.0, span, 400_000)
    along, across = (c[0] + p * (c[1] + p * (c[2] + p * c[3])) for c in (u, v))
    run = arc_length(along, across)
    length = float(run[-1])
    at = np.linspace(0.0, length, 81)
    turn = 0.4

    if p_range == "arcLength":  # the parameter is meant to be arc length: its end is the end
        plan = param_poly3(40.0, u, v, p_range, hdg=turn)
        points = reference(plan, np.array([0.0, 40.0]))
        x, y = along[[0, -1]], across[[0, -1]]
    else:
        points = reference(param_poly3(length, u, v, hdg=turn), at)
        x, y = np.interp(at, run, along), np.interp(at, run, across)

    assert np.abs(points.x - (cos(turn) * x - sin(turn) * y)).max() < 5e-4
    assert np.abs(points.y - (sin(turn) * x + cos(turn) * y)).max() < 5e-4


QUARTER = 20 * 1.6568  # the tangent's length of a cubic that is nearly a quarter of a circle


@pytest.mark.parametrize(
    "plan",
    [
        pytest.param(arc(31.4, 0.05), id="arc"),
        pytest.param(arc(31.4, -0.05), id="arc to the right"),
        pytest.param(spiral(31.4, 0.0, 0.1), id="spiral"),
        pytest.param(
            param_poly3(
                31.4,
                (0, QUARTER, 60 - 2 * QUARTER, QUARTER - 40),
                (0, 0, 60 - QUARTER, QUARTER - 40),
            ),
            id="cubic",
        ),
        pytest.param(poly3(31.4, 0, 0, 0.03, -0.0007), id="cubic over its axis"),
    ],
)
def test_borders_stay_within_two_millimetres_of_the_curve(plan: str) -> None:
    lanes = section(lane(0), lane(-1, width(4.0)))
    road_map = read_map(a_map(a_road("1", plan, sections=lanes)), "bend")
    fine = reference(plan, np.linspace(0.0, 31.4, 4000))
    edge = road_map.outlines()[1].exterior

    for aside in (0.0, -4.0):
        x = fine.x - aside * np.sin(fine.heading)
        y = fine.y + aside * np.cos(fine.heading)
        assert shapely.distance(shapely.points(x, y), edge).max() < 2.5e-3


def test_records_follow_one_another_without_a_gap() -> None:
    first = spiral(30.0, 0.0, 0.05)
    x, y, heading = by_small_steps(np.linspace(0.0, 0.05, 100_001)[:-1] + 0.25e-6, 30.0 / 100_000)
    road = a_road("1", first, arc(20.0, 0.05, s=30.0, x=x, y=y, hdg=heading))

    points = centre(read_map(a_map(road), "road"), "1/0/-1", np.linspace(0.0, 50.0, 2001))

    steps = np.hypot(np.diff(points.x), np.diff(points.y))
    assert steps.max() < 0.03


def test_heights_follow_the_elevation() -> None:
    elevation = cubic("elevation", 1.0, 0.1, s=0) + cubic(
        "elevation", 2.0, 0.1, -0.01, 0.0002, s=10
    )

    points = reference(line(40.0), AT, elevation=elevation)

    ds = AT - 10
    later = 2 + ds * (0.1 + ds * (-0.01 + ds * 0.0002))
    assert np.abs(points.z - np.where(AT < 10, 1 + 0.1 * AT, later)).max() < 0.02


def test_lanes_lie_side_by_side_from_the_centre_out() -> None:
    lanes = section(lane(2, width(2.0)), lane(1, width(3.0)), lane(0), lane(-1, width(4.0)))
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "road")

    for name, y, heading in (("1/0/2", 4.0, pi), ("1/0/1", 1.5, pi), ("1/0/-1", -2.0, 0.0)):
        points = centre(road_map, name, [10.0])
        assert points.y[0] == pytest.approx(y)
        assert abs(points.heading[0]) == pytest.approx(heading)
    assert centre(road_map, "1/0/2", [10.0]).x[0] == pytest.approx(30.0)
    assert road_map.nodes.width[1:4].tolist() == pytest.approx([2.0, 3.0, 4.0])


def test_widths_and_offsets_are_cubics_from_where_they_start() -> None:
    lanes = section(lane(0), lane(-1, width(3.0, 0.02), width(3.4, 0, 0.001, s=20)))
    offset = cubic("laneOffset", 1.0, 0.05, s=0) + cubic("laneOffset", 2.0, s=20)
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes, offset=offset)), "road")
    row = np.zeros(len(AT), np.int64)

    points = road_map.ribbons.at(row, road_map.ribbons.along_at(row, AT))

    wide = np.where(AT < 20, 3 + 0.02 * AT, 3.4 + 0.001 * (AT - 20) ** 2)
    aside = np.where(AT < 20, 1 + 0.05 * AT, 2.0)
    assert np.abs(points.width - wide).max() < 2e-3
    assert np.abs(points.y - (aside - wide / 2)).max() < 1e-3
    slope = np.where(AT < 20, 0.05 - 0.01, -0.001 * (AT - 20))
    steady = np.abs(AT - 20) > 2
    assert np.abs(points.heading - np.arctan(slope))[steady].max() < 2e-3


def test_an_offset_may_jump_between_sections_and_each_side_keeps_its_own() -> None:
    lanes = section(lane(0), lane(-1)) + section(lane(0), lane(-1), s=20)
    offset = cubic("laneOffset", 0.0, s=0) + cubic("laneOffset", 5.0, s=20)
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes, offset=offset)), "road")

    assert centre(road_map, "1/0/-1", [20.0]).y[0] == pytest.approx(-1.75)
    assert centre(road_map, "1/1/-1", [0.0]).y[0] == pytest.approx(3.25)


def test_a_jump_within_a_section_is_a_step_and_not_a_slope() -> None:
    offset = cubic("laneOffset", 0.0, s=0) + cubic("laneOffset", 1.0, s=20)
    road_map = read_map(a_map(a_road("1", line(40.0), offset=offset)), "road")

    boxes = np.array([(19.9, -3.4, 0, 0, 0), (20.1, -3.4, 0, 0, 0), (20.1, 0.9, 0, 0, 0)], float)
    hits = road_map.lanes_of(boxes, np.zeros(3))

    assert hits.row.tolist() == [0, 2]


def test_borders_say_where_lanes_end_whatever_lies_inside() -> None:
    by_border = section(
        lane(0),
        lane(-1, border(-3.0, -0.01), border(-3.4, s=20)),
        lane(-2, border(-7.0)),
        lane(1, border(4.0, 0.02)),
    )
    road_map = read_map(a_map(a_road("1", line(40.0), sections=by_border)), "borders")

    ribbons = road_map.ribbons
    for name, inner, outer in (
        ("1/0/-1", lambda s: 0 * s, lambda s: np.where(s < 20, 3 + 0.01 * s, 3.4)),
        ("1/0/-2", lambda s: np.where(s < 20, 3 + 0.01 * s, 3.4), lambda s: 7 + 0 * s),
        ("1/0/1", lambda s: 0 * s, lambda s: 4 + 0.02 * s),
    ):
        row = np.full(len(AT), road_map.nodes.name.index(name) - 1)
        points = ribbons.at(row, ribbons.along_at(row, AT))
        away = AT != 20
        assert np.abs(points.width - (outer(AT) - inner(AT)))[away].max() < 2e-3
        assert np.abs(np.abs(points.y) - (outer(AT) + inner(AT)) / 2)[away].max() < 2e-3


def test_a_border_is_measured_from_the_reference_line_and_a_width_from_the_lane_inside() -> None:
    lanes = section(lane(0), lane(-1, width(3.0)), lane(-2, border(-5.0)), lane(-3, width(1.0)))
    offset = cubic("laneOffset", 0.5, s=0)
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes, offset=offset)), "borders")

    assert road_map.nodes.width[1:4].tolist() == pytest.approx([3.0, 2.5, 1.0])
    assert road_map.nodes.y[1:4].tolist() == pytest.approx([-1.0, -3.75, -5.5])


def test_where_a_lane_has_both_the_width_holds() -> None:
    lanes = section(lane(0), lane(-1, width(3.0), border(-5.0)))

    nodes = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "both").nodes

    assert nodes.width[1] == pytest.approx(3.0)


def test_in_left_hand_traffic_lanes_on_the_left_run_along_the_road() -> None:
    lanes = section(lane(1), lane(0), lane(-1))
    left = read_map(a_map(a_road("1", line(40.0), sections=lanes, rule="LHT")), "left").nodes
    right = read_map(a_map(a_road("1", line(40.0), sections=lanes, rule="RHT")), "right").nodes

    assert np.abs(left.heading[1:3]).tolist() == pytest.approx([0.0, pi])
    assert np.abs(right.heading[1:3]).tolist() == pytest.approx([pi, 0.0])


@pytest.mark.parametrize("ident", [1, -1])
def test_a_lane_may_say_that_it_runs_the_other_way(ident: int) -> None:
    lanes = section(lane(0), lane(ident, direction="reversed"))

    heading = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "odd").nodes.heading[1]

    assert abs(heading) == pytest.approx(0.0 if ident > 0 else pi)


def test_lanes_on_a_bend_are_as_long_as_their_own_radius_says() -> None:
    lanes = section(lane(1), lane(0), lane(-1))
    road = a_road("1", arc(20 * pi, 1 / 20), sections=lanes)

    lengths = read_map(a_map(road), "bend").nodes.length[1:3]

    assert lengths.tolist() == pytest.approx([pi * (20 - 1.75), pi * (20 + 1.75)], rel=2e-4)


def test_lanes_of_no_width_and_sections_of_no_length_are_there_and_touch_nothing() -> None:
    lanes = (
        section(lane(0), lane(-1), lane(-2, width(0.0)), lane(-3), s=0)
        + section(lane(0), lane(-1), s=20)
        + section(lane(0), lane(-1), s=20)
    )
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes)), "thin")
    nodes = road_map.nodes

    hits = road_map.lanes_of(
        np.array([(10.0, -3.5, 0, 4.0, 2.0), (30.0, -1.0, 0, 4.0, 2.0)]), np.zeros(2)
    )

    assert {nodes.name[-1 - n] for n in hits.lane} == {"1/0/-1", "1/0/-3", "1/2/-1"}
    assert nodes.length[nodes.name.index("1/1/-1")] == 0.0
    assert nodes.width[nodes.name.index("1/0/-2")] == 0.0


def test_the_record_that_holds_is_the_last_that_starts_at_or_before() -> None:
    rng = np.random.default_rng(3)
    lanes = "".join(section(lane(0), lane(-1), s=s) for s in range(0, 24, 2))
    starts = {str(road): rng.integers(2, 22, road * 3).tolist() for road in range(5)}
    roads = []
    for road, records in starts.items():
        speeds = (element("speed", max=i + 1, unit="m/s") for i in range(len(records)))
        types = (element("type", speed, s=s) for speed, s in zip(speeds, records, strict=True))
        roads.append(a_road(road, line(24.0), sections=lanes, type="".join(types)))

    nodes = read_map(a_map(*roads), "speeds").nodes

    for road, records in starts.items():
        for number in range(12):
            speed = nodes.speed_limit[nodes.name.index(f"{road}/{number}/-1")]
            begun = [(s, i) for i, s in enumerate(records) if s <= 2 * number + 1]
            if begun:
                assert speed == max(begun)[1] + 1  # of two that start at once the later one
            elif records:
                assert speed == records.index(min(records)) + 1
            else:
                assert np.isnan(speed)


def test_the_turn_of_a_lane_through_a_junction_is_that_of_its_own_traffic() -> None:
    lanes = section(lane(1), lane(0), lane(-1))
    plans = {"a": arc(10.0, 0.15), "b": arc(10.0, -0.15), "c": arc(10.0, 0.02)}
    roads = [a_road(name, plan, sections=lanes, junction="9") for name, plan in plans.items()]
    nodes = read_map(a_map(*roads, '<junction id="9"/>'), "turns").nodes

    turn = dict(zip(nodes.name, nodes.turn, strict=True))
    assert (turn["a/0/-1"], turn["a/0/1"]) == ("left", "right")
    assert (turn["b/0/-1"], turn["b/0/1"]) == ("right", "left")
    assert (turn["c/0/-1"], turn["c/0/1"]) == ("straight", "straight")
