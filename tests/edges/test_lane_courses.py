"""Curvature and slope of lanes: against formulas, LibCarla and the lines of a file; the same wherever asked."""

from __future__ import annotations

import itertools
import math
import tracemalloc
import xml.etree.ElementTree as ET
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from builders import Recording, frame_of, thing
from graph_blocks import trace_info
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    cubic,
    lane,
    line,
    param_poly3,
    section,
    spiral,
    width,
)
from test_roads_carla import lanes_by_name, name_of
from thorough import LONG

from sgstore.lang.memory import FrameView
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import PlainLane, lane_text, read_lane_text
from sgstore.model.config import Config, RangeSettings
from sgstore.model.graph import LaneDistances
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.temporal import MonitorEvent


WIDE = Config(range=RangeSettings(2000))
"""All cars of a town are in the graph of a frame."""


def told(road_map: RoadMap, lane: int, along: float) -> tuple[float | None, float | None]:
    """Curvature and slope of a lane at a place."""
    return LaneDistances(*road_map.reach, courses=road_map.courses.rows()).course(-2 - lane, along)


def by_its_points(road_map: RoadMap, lane: int, along: float) -> tuple[float, float]:
    """The same by definition: the lane is cut into metres, and looked at from point to point."""
    ribbons = road_map.ribbons
    rows = range(ribbons.offsets[lane], ribbons.offsets[lane + 1])
    x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
    length = float(ribbons.along[rows[-1]])
    pieces = max(round(length), 1)
    piece = min(max(math.floor(along * pieces / length), 0), pieces - 1)
    ends = piece * length / pieces, (piece + 1) * length / pieces
    turn, headings, heights = 0.0, [0.0, 0.0], [float(ribbons.z[rows[0]])] * 2
    for one, two in itertools.pairwise(rows):
        first, last = float(ribbons.along[one]), float(ribbons.along[two])
        way = math.atan2(y[two] - y[one], x[two] - x[one])
        aside = [math.remainder(ribbons.heading[row] - way, math.tau) for row in (one, two)]
        bend = math.remainder(ribbons.heading[two] - ribbons.heading[one], math.tau)
        bend = bend if max(map(abs, aside)) < 1 else 0.0
        for number, end in enumerate(ends):
            share = (
                min(max((end - first) / (last - first), 0.0), 1.0) if last > first else end >= last
            )
            if end >= first:
                headings[number] = turn + share * bend
                heights[number] = ribbons.z[one] + share * (ribbons.z[two] - ribbons.z[one])
        turn += bend
    run = ends[1] - ends[0]
    return (headings[1] - headings[0]) / run, (heights[1] - heights[0]) / run


# Against formulas ---------------------------------------------------------------------------------


def road(*plan: str, lanes: tuple[str, ...], **more: str) -> RoadMap:
    return read_map(a_map(a_road("1", *plan, sections=section(*lanes), **more)), "road")


LANES = (lane(1, width(4.0)), lane(0), lane(-1, width(3.0)), lane(-2, width(5.0)))


def named(road_map: RoadMap, number: int) -> int:
    return road_map.nodes.name.index(f"1/0/{number}") - 1


@pytest.mark.parametrize("curvature", [0.02, -0.05, 1 / 300])
@pytest.mark.parametrize(("number", "left"), [(-1, -1.5), (-2, -5.5), (1, 2.0)])
def test_a_lane_on_an_arc_has_the_radius_of_its_own_circle(
    curvature: float, number: int, left: float
) -> None:
    road_map = road(arc(40.0, curvature), lanes=LANES)
    own = 1 / (1 / curvature - left)
    row = named(road_map, number)

    for along in np.linspace(-2, road_map.ribbons.lengths[row] + 2, 30):
        assert told(road_map, row, along)[0] == pytest.approx(
            math.copysign(own, -number * own), rel=1e-4
        )


def test_on_a_spiral_curvature_grows_with_the_way_and_on_a_line_there_is_none() -> None:
    plan = spiral(50.0, 0.0, 0.05), line(30.0, s=50.0)
    road_map = road(plan[0], lanes=(lane(0), lane(-1, width(0.002))))
    row = named(road_map, -1)
    for metre in range(50):
        assert told(road_map, row, metre + 0.5)[0] == pytest.approx((metre + 0.5) * 0.001, abs=1e-4)
    straight = road(line(30.0), lanes=LANES)
    assert told(straight, named(straight, -1), 7.0) == (0.0, None)


def test_on_a_cubic_it_is_the_turn_of_its_tangent_over_a_metre() -> None:
    p = np.linspace(0.0, 1.0, 200_001)
    run = np.append(0.0, np.cumsum(np.hypot(np.diff(50 * p), np.diff(30 * p**2 - 20 * p**3))))
    tangent = np.arctan2(60 * p - 60 * p**2, 50)
    plan = param_poly3(float(run[-1]), (0, 50, 0, 0), (0, 0, 30, -20))
    road_map = road(plan, lanes=(lane(0), lane(-1, width(0.002))))
    row = named(road_map, -1)
    metres = round(float(run[-1]))
    for metre in range(metres):
        ends = np.array([metre, metre + 1]) * run[-1] / metres
        first, last = np.interp(ends, run, tangent)
        wanted = (last - first) / (ends[1] - ends[0])
        assert told(road_map, row, ends.mean())[0] == pytest.approx(wanted, abs=2e-4)


def test_slope_is_rise_over_run_in_the_direction_of_each_lane() -> None:
    def height(s: float) -> float:
        return 1.0 + 0.05 * s - 0.0005 * s**2

    profile = cubic("elevation", 1.0, 0.05, -0.0005, s=0)
    road_map = road(line(60.0), lanes=LANES, elevation=profile)
    for s in range(60):
        rise = height(s + 1) - height(s)
        assert told(road_map, named(road_map, -1), s + 0.5)[1] == pytest.approx(rise, abs=1e-4)
        assert told(road_map, named(road_map, 1), 59.5 - s)[1] == pytest.approx(-rise, abs=1e-4)


def test_a_map_without_heights_has_curvature_and_no_slope(data: Path) -> None:
    level = road(line(60.0), lanes=LANES, elevation=cubic("elevation", 4.0, s=0))
    assert told(level, named(level, -1), 7.0) == (0.0, 0.0)
    for name, known in [("fabriksgatan", False), ("Town01", True)]:
        road_map = read_map((data / f"maps/{name}.xodr").read_text(), name)
        assert np.isfinite(road_map.courses.slope).all() == known
        assert np.isfinite(road_map.courses.curvature).all()
    assert not len(level.without_sections.courses)


# Against the lines of a file, and LibCarla ---------------------------------------------------------


def drawn(rng: np.random.Generator, heights: float) -> RoadMap:
    """Lanes whose borders bend at random points, some of them with steps aside."""
    lanes: list[PlainLane] = []
    for number in range(6):
        steps = rng.uniform(0.3, 12, int(rng.integers(1, 12)))
        way = np.cumsum(rng.normal(0, 0.3, len(steps)))
        middle = np.cumsum(
            np.vstack(
                [[0, 40 * number], np.column_stack([np.cos(way), np.sin(way)]) * steps[:, None]]
            ),
            axis=0,
        )
        if len(middle) > 5 and number % 2:
            middle[3:] += np.array([-np.sin(way[2]), np.cos(way[2])]) * 3
        ahead = np.append(way, way[-1])
        aside = np.column_stack([-np.sin(ahead), np.cos(ahead)]) * 1.75
        z = np.cumsum(rng.normal(0, heights, len(middle)))
        lanes.append(
            PlainLane(
                str(number), "driving", str(number), "", 0, 1, middle + aside, middle - aside, z
            )
        )
    return read_lane_text(lane_text(lanes), "drawn")


@pytest.mark.parametrize("heights", [0.0, 0.3])
def test_plain_lanes_turn_and_rise_as_their_points_say(heights: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(40 if LONG else 6):
        road_map = drawn(rng, heights)
        for row, length in enumerate(road_map.ribbons.lengths.tolist()):
            for along in rng.uniform(-1, length + 1, 8):
                curvature, slope = told(road_map, row, along)
                wanted = by_its_points(road_map, row, along)
                assert curvature == pytest.approx(wanted[0], abs=1e-6)
                assert slope == (pytest.approx(wanted[1], abs=1e-6) if heights else None)


@pytest.mark.parametrize("town", ["Town01", "Town02", "Town07"])
def test_they_are_those_of_the_waypoints_of_carla(data: Path, town: str) -> None:
    carla = pytest.importorskip("carla", reason="the carla wheel is not installed")
    text = (data / f"maps/{town}.xodr").read_text(encoding="utf-8")
    road_map, peer = read_map(text, town), carla.Map(town, text)
    rows, ribbons = lanes_by_name(road_map), road_map.ribbons
    reach = LaneDistances(*road_map.reach, courses=road_map.courses.rows())
    curved: list[tuple[float, float]] = []
    rises: list[tuple[float, float]] = []
    for one in peer.generate_waypoints(1.0 if LONG else 4.0):
        row = rows[name_of(one)]
        at, length = (
            float(ribbons.along_at(np.array([row]), np.array([one.s]))[0]),
            ribbons.lengths[row],
        )
        pieces = max(round(length), 1)
        ends = (
            np.array([np.floor(at / length * pieces), np.floor(at / length * pieces) + 1])
            * length
            / pieces
        )
        if ends[1] > length:
            continue
        s = ribbons.at(np.array([row, row]), ends).s
        both = [peer.get_waypoint_xodr(one.road_id, one.lane_id, float(place)) for place in s]
        if None in both or any(name_of(w) != name_of(one) for w in both):
            continue
        yaw, pitch = (
            [getattr(w.transform.rotation, name) for w in both] for name in ("yaw", "pitch")
        )
        run = ends[1] - ends[0]
        turn = -math.radians(math.remainder(yaw[1] - yaw[0], 360)) / run
        curvature, slope = reach.course(-2 - row, float(ends.mean()))
        curved.append((curvature or 0.0, turn))
        # Its pitch is that of the road, which is longer or shorter than the lane where it bends.
        rises.append(
            ((slope or 0.0) * run / abs(s[1] - s[0]), math.tan(math.radians(sum(pitch) / 2)))
        )
    ours, theirs = np.array(curved).T
    assert np.quantile(np.abs(ours - theirs), 0.99) < 3e-3
    assert np.quantile(np.abs(ours - theirs), 0.9) < 2e-4
    assert (np.abs(theirs) > 0.05).sum() > 20
    up, steep = np.array(rises).T
    assert np.quantile(np.abs(up - steep), 0.99) < 5e-3
    assert (np.abs(steep) > 0.02).any() == (town == "Town07")


# In SQL, in memory, online and by definition the same ------------------------------------------------


def traffic(road_map: RoadMap, rng: np.random.Generator, cars: int, frames: int) -> list[list[Any]]:
    """Cars anywhere on lanes of any sort, some of them beside every lane."""
    ribbons = road_map.ribbons
    long = np.flatnonzero(ribbons.lengths > 0.5)
    steep = np.unique(road_map.courses.lane[np.abs(road_map.courses.curvature) > 0.01])
    found: list[list[Any]] = []
    for number in range(frames):
        lane = rng.choice(steep if number % 2 else long, cars)
        points = ribbons.at(lane, rng.uniform(0, 1, cars) * ribbons.lengths[lane])
        aside = np.where(rng.random(cars) < 0.1, 400, rng.uniform(-1, 1, cars))
        places = zip(points.x, points.y + aside, points.z, points.heading, strict=True)
        found.append(
            [
                thing("ego" if n == 0 else f"c{n}", x, y, heading, z=z + 0.75, kind="car")
                for n, (x, y, z, heading) in enumerate(places)
            ]
        )
    return found


@pytest.fixture(scope="module", params=["Town07", "soderleden", "drawn"])
def world(
    request: pytest.FixtureRequest, data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[RoadMap, list[list[Any]], Store]:
    """A map, traffic on it, and a store of it."""
    rng, name = np.random.default_rng(6), request.param
    road_map = (
        drawn(rng, 0.2)
        if name == "drawn"
        else read_map((data / f"maps/{name}.xodr").read_text(), name)
    )
    cars, frames = (60, 40) if LONG else (12, 4)
    of_frames = traffic(road_map, rng, cars, frames)
    file = StoreFile.create(tmp_path_factory.mktemp("store") / "s.db")
    generator = SceneGraphGenerator(road_map, WIDE)
    with file.segment(trace_info(), WIDE, road_map=road_map, answers=("isIn",)) as segment:
        kept = segment.as_kept(Recording().block(*of_frames))
        segment.append(generator.block(kept))
        file.publish(segment.seal(TraceReport(frames=frames)))
    return road_map, of_frames, Store(file.path)


def by_elevation(data: Path, road_map: RoadMap, lane: int, along: float) -> float | None:
    """The slope by the heights that the file has at both ends of a metre; ``None``: it has none."""
    length = float(road_map.ribbons.lengths[lane])
    pieces = max(round(length), 1)
    piece = min(max(math.floor(along * pieces / length), 0), pieces - 1)
    ends = np.array([piece, piece + 1]) * length / pieces
    s = road_map.ribbons.at(np.full(2, lane), ends).s.tolist()
    profile = elevations(data / f"maps/{road_map.name}.xodr")
    if not any(profile.values()):
        return None
    heights: list[float] = []
    for place in s:
        here = [one for one in profile[road_map.nodes.road[1 + lane]] if one[0] <= place]
        start, a, b, c, d = here[-1]
        by = place - start
        heights.append(a + b * by + c * by**2 + d * by**3)
    return (heights[1] - heights[0]) / float(ends[1] - ends[0])


@cache
def elevations(path: Path) -> dict[str, list[list[float]]]:
    """Of each road of a file: s, a, b, c and d of the polynomials of its height."""
    return {
        road.get("id", ""): [
            [float(one.get(k, "")) for k in "sabcd"] for one in road.iter("elevation")
        ]
        for road in ET.parse(path).getroot().iter("road")
    }


def test_the_view_the_language_the_graph_and_the_definition_agree(
    data: Path,
    world: tuple[RoadMap, list[list[Any]], Store],
) -> None:
    road_map, of_frames, store = world
    text = "MATCH (v:Car) RETURN frame.id AS f, v.id AS v, curvature(v) AS c, slope(v) AS s"
    asked = {row[:2]: row[2:] for row in store.find(text).rows()}
    viewed = {
        row[:2]: row[2:]
        for row in store.sql("SELECT frame_id, node_id, curvature, slope FROM lane_courses").values
    }
    places = {
        row[:2]: row[2:]
        for row in store.sql(
            "SELECT frame_id, src, dst, along FROM lane_states WHERE is_primary"
        ).values
    }
    assert len(asked) == sum(map(len, of_frames))
    known = 0
    for frame in sorted({frame for frame, _ in asked}):
        graph = store.file.graph(frame)
        view = FrameView(graph)
        for node in [node for at, node in asked if at == frame]:
            told = asked[frame, node]
            assert told == (graph.curvature(node), graph.slope(node))
            assert told == tuple(view.pair(name, node, node) for name in ("curvature", "slope"))
            assert told == viewed.get((frame, node), (None, None))
            if (frame, node) not in places:
                assert told == (None, None)
                continue
            lane, along = places[frame, node]
            wanted = by_its_points(road_map, -2 - lane, along)
            assert told[0] == pytest.approx(wanted[0], abs=1e-6)
            slope = (
                wanted[1]
                if road_map.name == "drawn"
                else by_elevation(data, road_map, -2 - lane, along)
            )
            assert told[1] == (None if slope is None else pytest.approx(slope, abs=1e-6))
            known += 1
    assert known > len(asked) / 2


def test_a_monitor_tells_what_a_store_answers(
    world: tuple[RoadMap, list[list[Any]], Store],
) -> None:
    road_map, of_frames, store = world
    text = (
        # Online, the lane in a junction may be unknown.
        "MATCH (v:Car) WHERE NOT in_junction(v) AND abs(curvature(v)) > 0.01"
        " AND (slope(v) > -0.02 OR slope(v) IS NULL)"
        " RETURN MAX(abs(curvature(v))) OVER match AS sharpest, FIRST(slope(v)) OVER match AS slope"
    )
    events: list[MonitorEvent] = []
    monitor = Monitor(text, road_map, WIDE, on_event=events.append)
    for number, things in enumerate(of_frames):
        # Things jump from frame to frame: slowly enough to stay the same ones.
        monitor.step(frame_of(*things, time_ns=number * 1_000_000_000_000))
    monitor.finish()
    told = sorted((e.values["sharpest"], e.values["slope"] or 0) for e in events)
    rows = store.find(f"{text}, v.id, INTERVALS").rows()

    assert told == sorted((row.sharpest, row.slope or 0) for row in rows)
    assert rows


def test_a_lane_of_any_length_takes_little_memory() -> None:
    right = np.array([[(-9e5, 9e5)[i % 2], 10.0 * i] for i in range(10)])
    left = right + np.array([0.0, 3.5])
    lane = PlainLane("far", "driving", "1", "", 0, 1, left, right, np.zeros(10))
    text = lane_text([lane])

    tracemalloc.start()
    road_map = read_lane_text(text, "far")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert told(road_map, 0, 5e5)[0] == 0
    assert peak < 50_000_000
