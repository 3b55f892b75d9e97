"""Look-ups in a road map: against shapely and exhaustive search, and under motions of the whole map."""

from __future__ import annotations

from math import cos, pi, sin
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    cubic,
    element,
    lane,
    line,
    link,
    mark,
    moved,
    param_poly3,
    section,
    spiral,
    width,
)

from sgstore.base.tables import chained
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import OFF_ROAD, LaneHits, MapNodes, Ribbons, RoadMap, edges_of
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import Edge

TWO_WAY = section(
    lane(2, width(2.0), kind="sidewalk", after=2),
    lane(1, mark("broken"), after=1),
    lane(0, mark("solid")),
    lane(-1, mark("broken"), after=-1),
    lane(-2, width(3.0, 0.01, 0.001), after=-2),
)


def town(turn: float = 0.0, dx: float = 0.0, dy: float = 0.0, dz: float = 0.0) -> RoadMap:
    """Curves of all sorts, a crossing, a bridge over it, a crosswalk; turned about the origin, then moved."""

    def at(x: float, y: float, hdg: float) -> dict[str, float]:
        return {**moved(x, y, turn, dx, dy), "hdg": hdg + turn}

    def level(*records: str) -> str:
        return "".join(records) or cubic("elevation", dz, s=0)

    corners = "".join(
        element("cornerRoad", s=s, t=t) for s, t in ((20, -7), (24, -7), (24, 4), (20, 4))
    )
    crosswalk = element(
        "object", element("outline", corners), id="zebra", s=22, t=0, type="crosswalk"
    )
    sign = element("signal", id="stop", s=38, t=-8, type="206", orientation="+", dynamic="no")
    roads = [
        a_road("1", line(40.0, **at(0, 0, 0)), sections=TWO_WAY, objects=crosswalk, signals=sign,
               elevation=level(), links=link("successor", "road", "2", "start")),
        a_road("2", arc(30.0, 0.08, **at(40, 0, 0)), sections=TWO_WAY, elevation=level()),
        a_road("3", spiral(50.0, 0.0, -0.06, **at(0, 40, -0.5)), sections=TWO_WAY, elevation=level()),
        a_road("4", param_poly3(52.0, (0, 50, 0, 0), (0, 0, 30, -20), **at(-20, -30, 0.4)),
               sections=TWO_WAY, elevation=level()),
        a_road("5", line(30.0, **at(10, -15, pi / 2)), sections=TWO_WAY, junction="9", elevation=level()),
        a_road("6", line(30.0, **at(0, 5, -0.8)), sections=TWO_WAY, junction="9", elevation=level()),
        a_road("7", line(60.0, **at(-10, 10, -0.3)), sections=TWO_WAY,
               elevation=level(cubic("elevation", dz + 6, s=0))),
    ]  # fmt: skip
    return read_map(a_map(*roads, '<junction id="9"/>'), "town")


TOWN = town()


def footprints(seed: int, n: int = 300) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    boxes = np.column_stack(
        (rng.uniform(-25, 75, n), rng.uniform(-45, 50, n), rng.uniform(-4, 4, n), rng.uniform(0.2, 15, n),
         rng.uniform(0.2, 3, n))
    )  # fmt: skip
    return boxes, rng.choice([0.0, 6.0, np.nan], n)


def rectangles(boxes: np.ndarray) -> np.ndarray:
    """Footprints as shapely has them."""
    along, across = np.array([1, -1, -1, 1]), np.array([1, 1, -1, -1])
    u, v = boxes[:, 3:4] / 2 * along, boxes[:, 4:5] / 2 * across
    c, s = np.cos(boxes[:, 2:3]), np.sin(boxes[:, 2:3])
    return shapely.polygons(
        np.stack((boxes[:, :1] + c * u - s * v, boxes[:, 1:2] + s * u + c * v), axis=-1)
    )


def table(hits: LaneHits) -> dict[tuple[int, int], tuple[float, float, float, bool]]:
    keys = zip(hits.row.tolist(), hits.lane.tolist(), strict=True)
    values = zip(
        hits.overlap.tolist(),
        hits.offset.tolist(),
        hits.heading_error.tolist(),
        hits.primary.tolist(),
        strict=True,
    )
    return dict(zip(keys, values, strict=True))


def lane_count(road_map: RoadMap) -> int:
    return len(road_map.ribbons)


def test_lanes_from_one_end_of_the_world_to_the_other_take_a_coarse_grid() -> None:
    """Their cells of 4 m are more than a whole number can count: 6 · 10¹⁴ a lane."""
    n, far = 20_000, np.tile([0.0, 1e8], 20_000)
    y = far + np.repeat(10.0 * np.arange(n), 2)
    offsets, heading = np.arange(n + 1) * 2, np.full(2 * n, np.pi / 4)
    ribbons = Ribbons(offsets, far, y + 4, far, y, np.zeros(2 * n), heading, far, far * 2**0.5)

    found = lanes_alone(ribbons).lanes_of(np.array([[5e7, 5e7 + 32, 0.785, 4, 2]]), np.zeros(1))

    assert found.lane.tolist() == [-2 - 3]


@pytest.mark.parametrize("seed", range(3))
def test_footprints_touch_the_lanes_that_shapely_says_with_the_share_it_says(seed: int) -> None:
    boxes, _ = footprints(seed)
    lanes = TOWN.outlines()[1 : 1 + lane_count(TOWN)]
    shapes = rectangles(boxes)

    found = table(TOWN.lanes_of(boxes, np.full(len(boxes), np.nan)))

    for row, shape in enumerate(shapes):
        for number, polygon in enumerate(lanes):
            hit = found.get((row, -2 - number))
            gap = shape.distance(polygon)
            if hit is None:
                assert gap > 0
                continue
            assert gap <= 2e-3
            share = shape.intersection(polygon).area / shape.area
            assert hit[0] == pytest.approx(share, abs=1e-3)


def test_offsets_and_heading_errors_are_those_of_the_nearest_point_of_the_centre_line() -> None:
    boxes, z = footprints(11, 400)
    boxes[:, 3:] = 0.5
    hits = TOWN.lanes_of(boxes, z)
    fine = TOWN.waypoints(0.01)

    for row, node, offset, error in zip(
        hits.row, hits.lane, hits.offset, hits.heading_error, strict=True
    ):
        mine = fine.lane == -2 - node
        gap = np.hypot(fine.x[mine] - boxes[row, 0], fine.y[mine] - boxes[row, 1])
        best = int(np.argmin(gap))
        if best in {0, int(mine.sum()) - 1}:
            continue  # beyond an end, the offset is from the line's continuation
        assert abs(offset) == pytest.approx(gap[best], abs=2e-3)
        heading = fine.heading[mine][best]
        # Cross sections are square to the road, not to the centre line of a lane that widens.
        widens = TOWN.nodes.lane[-1 - node] == -2
        assert abs(sin(error - (boxes[row, 2] - heading))) < (1e-2 if widens else 2e-3)
        left = cos(heading) * (boxes[row, 1] - fine.y[mine][best]) - sin(heading) * (
            boxes[row, 0] - fine.x[mine][best]
        )
        assert offset * left >= -1e-6


@pytest.mark.parametrize("angle", [0.5, 0.61, 0.6543, 1.0])
def test_beside_a_bend_offset_and_heading_are_those_of_the_circle(angle: float) -> None:
    road_map = read_map(a_map(a_road("1", arc(30.0, 0.1))), "circle")  # the lane's radius is 11.75
    away = 5.0
    box = ((11.75 - away) * sin(angle), 10 - (11.75 - away) * cos(angle), angle + 0.2, 9.0, 9.0)

    hits = road_map.lanes_of(np.array([box]), np.zeros(1))

    assert hits.offset[0] == pytest.approx(away, abs=2e-4)
    assert hits.heading_error[0] == pytest.approx(0.2, abs=2e-4)


def test_every_point_of_a_centre_line_is_in_its_lane() -> None:
    points = TOWN.waypoints(0.37)
    ends = TOWN.ribbons.at(np.arange(lane_count(TOWN)), TOWN.ribbons.lengths)
    for these in (points, ends):
        boxes = np.column_stack((these.x, these.y, these.heading, np.zeros((len(these), 2))))

        found = table(TOWN.lanes_of(boxes, these.z))

        for row, number in enumerate(these.lane.tolist()):
            _, offset, error, _ = found[row, -2 - number]
            assert offset == pytest.approx(0, abs=1e-3)
            assert error == pytest.approx(0, abs=5e-3)


def test_the_left_border_lies_to_the_left_of_the_direction_of_travel() -> None:
    ribbons = TOWN.ribbons
    left_x, left_y = ribbons.left_x - ribbons.right_x, ribbons.left_y - ribbons.right_y

    across = np.cos(ribbons.heading) * left_y - np.sin(ribbons.heading) * left_x

    assert (across > 0.9 * np.hypot(left_x, left_y)).all()


@given(
    turn=st.floats(-pi, pi),
    dx=st.floats(-1e4, 1e4),
    dy=st.floats(-1e4, 1e4),
    dz=st.floats(-100, 100),
    seed=st.integers(0, 100),
)
@example(turn=2.375, dx=0.0, dy=0.0, dz=0.0, seed=76)  # a centre beside a seam of a bend
@settings(max_examples=25, deadline=None)
def test_to_move_and_turn_the_whole_map_moves_all_answers_with_it(
    turn: float, dx: float, dy: float, dz: float, seed: int
) -> None:
    there = town(turn, dx, dy, dz)
    boxes, z = footprints(seed, 40)
    away = boxes.copy()
    away[:, 0] = cos(turn) * boxes[:, 0] - sin(turn) * boxes[:, 1] + dx
    away[:, 1] = sin(turn) * boxes[:, 0] + cos(turn) * boxes[:, 1] + dy
    away[:, 2] += turn

    ours, theirs = table(TOWN.lanes_of(boxes, z)), table(there.lanes_of(away, z + dz))

    sure = {key for key, hit in ours.items() if hit[0] > 1e-6}
    assert sure <= set(theirs)
    assert {key for key, hit in theirs.items() if hit[0] > 1e-6} <= set(ours)
    for key in sure:
        for mine, other in zip(ours[key][:2], theirs[key][:2], strict=True):
            assert mine == pytest.approx(other, abs=1e-5)
        assert abs(sin((ours[key][2] - theirs[key][2]) / 2)) < 1e-6
    assert (TOWN.edges.src == there.edges.src).all()
    assert (TOWN.edges.dst == there.edges.dst).all()
    assert there.nodes.length == pytest.approx(TOWN.nodes.length, abs=1e-6, nan_ok=True)
    here, away_near = (m.near(b[:, 0], b[:, 1], 17.0) for m, b in ((TOWN, boxes), (there, away)))
    assert set(zip(*here, strict=True)) == set(zip(*away_near, strict=True))


def test_storeys_are_kept_apart() -> None:
    boxes = np.array([(5.0, 5.4, 0.0, 4.0, 2.0)])

    names = {
        z: {TOWN.nodes.name[-1 - n][0] for n in TOWN.lanes_of(boxes, np.array([z])).lane}
        for z in (0.0, 2.4, 6.0, 20.0, np.nan)
    }

    assert "7" not in names[0.0] | names[2.4]
    assert names[6.0] == {"7"}
    assert names[20.0] == set()
    assert names[np.nan] == names[0.0] | names[6.0]


@pytest.mark.parametrize(
    "box",
    [
        pytest.param((20.0, -1.75, 0.0, 0.0, 0.0), id="a point"),
        pytest.param((20.0, -1.75, 0.0, np.nan, np.nan), id="a point for want of a size"),
        pytest.param((20.0, -1.75, np.nan, 0.0, 0.0), id="a point without a heading"),
        pytest.param((20.0, -1.75, 0.0, 4.0, 0.0), id="a line"),
        pytest.param((20.0, -1.75, 0.0, -4.0, 2.0), id="a length with the wrong sign"),
    ],
)
def test_what_has_no_area_lies_in_its_lane_wholly(box: tuple[float, ...]) -> None:
    hits = TOWN.lanes_of(np.array([box]), np.zeros(1))
    one = TOWN.nodes.name.index("1/0/-1")

    share = dict(zip((-1 - hits.lane).tolist(), hits.overlap.tolist(), strict=True))

    assert share[one] == pytest.approx(1.0)


def test_what_is_nowhere_touches_nothing() -> None:
    boxes = np.array(
        [(np.nan, 0, 0, 4, 2), (0, np.inf, 0, 4, 2), (1e9, 1e9, 0, 4, 2), (0, 0, 0, np.inf, 2)]
    )

    assert len(TOWN.lanes_of(boxes[:3], np.zeros(3)).row) == 0
    assert len(TOWN.lanes_of(np.zeros((0, 5)), np.zeros(0)).row) == 0
    assert len(TOWN.near(boxes[:1, 0], boxes[:1, 1], 1e6)[0]) == 0


def test_a_footprint_as_large_as_the_map_touches_every_lane() -> None:
    hits = TOWN.lanes_of(np.array([(20.0, 0.0, 0.3, 1000.0, 1000.0)]), np.array([np.nan]))

    assert len(set(hits.lane.tolist())) == lane_count(TOWN)


def test_many_footprints_get_the_answers_that_each_gets_alone() -> None:
    boxes, z = footprints(5, 2000)

    together = table(TOWN.lanes_of(boxes, z))

    for row in range(0, 2000, 50):
        alone = table(TOWN.lanes_of(boxes[row : row + 1], z[row : row + 1]))
        assert {key[1]: value for key, value in alone.items()} == {
            node: value for (at, node), value in together.items() if at == row
        }


def test_hits_come_by_footprint_and_each_has_one_primary_lane() -> None:
    boxes, z = footprints(6, 1000)

    hits = TOWN.lanes_of(boxes, z)

    assert (np.diff(hits.row) >= 0).all()
    assert hits.row[hits.primary].tolist() == np.unique(hits.row).tolist()


@pytest.mark.parametrize(
    ("box", "primary"),
    [
        pytest.param((20, -1.0, 0, 4, 2), "1/0/-1", id="where its centre is"),
        pytest.param((20, 1.0, pi, 4, 2), "1/0/1", id="where its centre is, the other way"),
        pytest.param((20, 1.0, 0, 4, 2), "1/0/1", id="where its centre is, against the traffic"),
        pytest.param((20, 0.0, 0, 4, 2), "1/0/-1", id="on the line: with the traffic"),
        pytest.param((20, 0.0, pi, 4, 2), "1/0/1", id="on the line: with the traffic, the other way"),
        pytest.param((20, -9.0, 0, 4, 4), "1/0/-2", id="beside the road"),
    ],
)  # fmt: skip
def test_the_primary_lane_is_the_one_it_is_in_above_all(
    box: tuple[float, ...], primary: str
) -> None:
    only = read_map(a_map(a_road("1", line(40.0), sections=TWO_WAY)), "road")

    hits = only.lanes_of(np.array([box], float), np.zeros(1))

    assert only.nodes.name[-1 - hits.lane[hits.primary][0]] == primary


def test_in_a_bend_tighter_than_the_lane_is_wide_no_share_is_lost() -> None:
    lanes = section(lane(1, width(4.0)), lane(0), lane(-1))
    road_map = read_map(a_map(a_road("1", arc(3 * pi / 2, 1 / 3), sections=lanes)), "tight")
    boxes = np.array([(0.0, 2.0, 0.0, 1.0, 1.0), (1.0, 2.0, 0.3, 1.0, 1.0)])

    hits = road_map.lanes_of(boxes, np.zeros(2))

    inner = hits.lane == -2
    assert hits.overlap[inner][1] == pytest.approx(1.0, abs=0.01)
    assert shapely.is_valid(road_map.outlines()[1:3]).all()


def test_what_is_near_is_what_lies_within_the_radius() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-60, 120, 50), rng.uniform(-80, 90, 50)
    outlines, nodes = TOWN.outlines(), TOWN.nodes

    found = set(zip(*TOWN.near(x, y, 20.0), strict=True))

    inside: dict[int, list[int]] = {}
    for src, dst, relation in zip(TOWN.edges.src, TOWN.edges.dst, TOWN.edges.relation, strict=True):
        if relation == 0:
            inside.setdefault(int(dst), []).append(int(src))
    for row in range(50):
        point = shapely.Point(x[row], y[row])
        near = {
            -1 - i
            for i, shape in enumerate(outlines)
            if shape is not None and shape.distance(point) <= 20.0
        }
        for _ in range(2):
            near |= {whole for whole, parts in inside.items() if near & set(parts)}
        assert {node for at, node in found if at == row} == near
    assert OFF_ROAD not in {node for _, node in found}
    assert {KINDS[nodes.kind[-1 - n]] for _, n in found} >= {
        "lane",
        "road",
        "junction",
        "crosswalk",
        "stop_sign",
    }


def test_waypoints_stand_at_their_spacing_from_the_start_of_each_lane() -> None:
    points = TOWN.waypoints(2.5)

    for number in range(lane_count(TOWN)):
        mine = points.lane == number
        length = TOWN.ribbons.lengths[number]
        assert points.along[mine].tolist() == pytest.approx(
            np.arange(0, length + 1e-6, 2.5).tolist()
        )
        gaps = np.hypot(np.diff(points.x[mine]), np.diff(points.y[mine]))
        assert (gaps <= 2.5 + 1e-6).all()
        assert (gaps > 2.4).all()
    with pytest.raises(ValueError, match="spacing"):
        TOWN.waypoints(0.0)


def test_places_before_and_beyond_a_lane_are_its_ends() -> None:
    ribbons, lanes = TOWN.ribbons, np.arange(lane_count(TOWN))

    before, start = (
        ribbons.at(lanes, np.full(len(lanes), -5.0)),
        ribbons.at(lanes, np.zeros(len(lanes))),
    )
    beyond, end = ribbons.at(lanes, np.full(len(lanes), 1e6)), ribbons.at(lanes, ribbons.lengths)

    assert (before.x == start.x).all()
    assert beyond.x == pytest.approx(end.x)
    assert ribbons.along_at(lanes, start.s) == pytest.approx(0 * ribbons.lengths)
    assert ribbons.along_at(lanes, end.s) == pytest.approx(ribbons.lengths)


def test_starts_of_lanes_along_others_are_those_that_dijkstra_finds() -> None:
    rng = np.random.default_rng(4)
    n, limit = 60, 200.0
    lengths = rng.uniform(0, 80, n)
    lengths[::7] = 0.0
    src, dst = rng.integers(0, n, 90), rng.integers(0, n, 90)
    peer = nx.DiGraph()  # an edge is as long as the lane that it leaves
    peer.add_nodes_from(range(n))
    peer.add_weighted_edges_from(
        zip(src.tolist(), dst.tolist(), lengths[src].tolist(), strict=True)
    )
    expected = [(lane_, lane_, 0.0) for lane_ in range(n)]
    for lane_, length in enumerate(lengths.tolist()):
        beyond: dict[int, float] = {}
        for first in peer.successors(lane_):
            for other, away in nx.single_source_dijkstra_path_length(peer, first).items():
                beyond[other] = min(away, beyond.get(other, np.inf))
        for other, away in beyond.items():
            if away <= limit:
                expected += [(lane_, other, length + away), (other, lane_, -length - away)]

    lane_, other, start = straight_lanes(lengths, src, dst).reach

    told = zip((-2 - lane_).tolist(), (-2 - other).tolist(), start.tolist(), strict=True)
    np.testing.assert_allclose(sorted(told), sorted(expected), atol=1e-9)
    assert any(away == 0 and one != two for one, two, away in expected)
    assert max(abs(start)) > limit


def straight_lanes(lengths: np.ndarray, src: np.ndarray, dst: np.ndarray) -> RoadMap:
    """Lanes of these lengths, beside one another, and where traffic flows on."""
    n = len(lengths)
    along, y = np.zeros(2 * n), np.repeat(np.arange(n) * 4.0, 2)
    along[1::2] = lengths
    zero = np.zeros(2 * n)
    ribbons = Ribbons(np.arange(n + 1) * 2, along, y + 2, along, y - 2, zero, zero, along, along)
    return lanes_alone(ribbons, ("travelsTo", 1 + src, 1 + dst))


def lanes_alone(ribbons: Ribbons, *edges: Edge) -> RoadMap:
    """A map of nothing but lanes."""
    names = [str(number) for number in range(len(ribbons))]
    none = np.zeros(0, np.int64)
    return RoadMap(
        name="lanes",
        text="",
        nodes=chained([MapNodes.of("off_road", ["off_road"]), MapNodes.of("lane", names)]),
        edges=edges_of([*edges, ("isIn", none, none)]),
        ribbons=ribbons,
        shapes=np.full(1 + len(names), None),
    )


def test_a_map_is_known_by_its_text() -> None:
    one, same, other = town(), town(), town(dz=1.0)

    assert one.digest == same.digest
    assert one.digest != other.digest
    assert len(one.digest) == 64


@pytest.mark.data
def test_real_lanes_hold_their_own_centre_lines_and_primary_hits(data: Path) -> None:
    for name in ("Town01", "fabriksgatan", "multi_intersections", "soderleden"):
        road_map = read_map((data / f"maps/{name}.xodr").read_text(encoding="utf-8"), name)
        points = road_map.waypoints(3.0)
        wide = points.width > 0.01
        boxes = np.column_stack((points.x, points.y, points.heading, np.zeros((len(points), 2))))[
            wide
        ]

        found = table(road_map.lanes_of(boxes, points.z[wide]))

        assert all((row, -2 - n) in found for row, n in enumerate(points.lane[wide].tolist()))


@pytest.mark.data
def test_real_turns_are_those_that_the_editor_wrote_down(data: Path) -> None:
    text = (data / "maps/Town01.xodr").read_text(encoding="utf-8")
    road_map = read_map(text, "Town01")
    nodes = road_map.nodes
    said: dict[str, str] = {}
    for part in text.split("<road ")[1:]:
        road = part.split(' id="')[1].split('"')[0]
        for piece in part.split("<signalReference")[1:]:
            said[road] = piece.split('turnRelation="')[1].split('"')[0].lower()

    turns = {
        nodes.road[row]: nodes.turn[row]
        for row in range(1, 1 + len(road_map.ribbons))
        if nodes.lane_type[row] == "driving" and nodes.road[row] in said
    }

    assert len(turns) > 50
    assert turns == {road: said[road] for road in turns}
