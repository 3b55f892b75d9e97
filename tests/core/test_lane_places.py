"""Junctions, crosswalks, lights and signs along the lanes: where they lie, and how far it is to them."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from builders import Recording, thing
from graph_blocks import trace_info
from test_lane_dist import driven, lane_ways
from thorough import LONG

from sgstore.errors import QueryError
from sgstore.lang.memory import FrameView
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.graph import LaneDistances
from sgstore.model.vocabulary import KINDS, RELATION_CODE, SIGNALS
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from test_lane_dist import Ways

    from sgstore.maps.roads import RoadMap

    Stretches = list[tuple[int, float, float]]

pytestmark = pytest.mark.seconds(10)

SORTS = ("junction", "crosswalk", "stop_line", "traffic_light", "stop_sign", "yield_sign")
FARTHEST = 200.0


def town(data: Path, name: str) -> RoadMap:
    return read_map((data / f"maps/{name}.xodr").read_text(), name)


def stretches(road_map: RoadMap) -> dict[int, Stretches]:
    """By column of the part."""
    found: dict[int, Stretches] = {}
    places = road_map.places
    columns = (places.part, places.lane, places.start, places.end)
    for part, *stretch in zip(*(column.tolist() for column in columns), strict=True):
        found.setdefault(part, []).append((stretch[0], stretch[1], stretch[2]))
    return found


# Where they lie --------------------------------------------------------------------------------


def test_a_crosswalk_lies_where_points_of_the_centre_line_are_in_it(data: Path) -> None:
    road_map = town(data, "Town07")
    shapes, found = road_map.outlines(), stretches(road_map)
    columns = [c for c, kind in enumerate(road_map.nodes.kind) if KINDS[kind] == "crosswalk"]
    met = 0
    for lane, length in enumerate(road_map.ribbons.lengths.tolist()):
        along = np.arange(0, length, 0.02 if LONG else 0.1)
        points = road_map.ribbons.at(np.full(len(along), lane), along)
        for column in columns:
            inside = along[shapely.contains_xy(shapes[column], points.x, points.y)]
            told = [one[1:] for one in found.get(column, []) if one[0] == lane]
            if len(inside):
                met += 1
                (place,) = told
                assert place == pytest.approx((inside.min(), inside.max()), abs=0.11)
            else:
                assert all(end - start < 0.11 for start, end in told)
    assert met > 30


def test_a_junction_lies_on_all_of_its_lanes(data: Path) -> None:
    road_map = town(data, "Town01")
    nodes, lengths, found = road_map.nodes, road_map.ribbons.lengths, stretches(road_map)
    for column, kind in enumerate(nodes.kind):
        if KINDS[kind] == "junction":
            lanes = [i for i in range(len(lengths)) if nodes.junction[1 + i] == nodes.name[column]]
            assert found.get(column, []) == [(lane, 0, lengths[lane]) for lane in lanes]


def test_a_stop_line_lies_where_the_file_has_it_on_lanes_that_run_there(data: Path) -> None:
    path = data / "maps/multi_intersections.xodr"
    road_map = town(data, "multi_intersections")
    places, nodes = road_map.places, road_map.nodes
    signs = {
        (signal.get("id", ""), road.get("id"), round(float(signal.get("s", "")), 6))
        for road in ET.parse(path).getroot().iter("road")
        for signal in road.iter("signal")
        if signal.get("type") == "294"
    }
    rows = [row for row, what in enumerate(places.what) if what == "stop_line"]
    on = road_map.ribbons.at(places.lane[rows], places.start[rows])
    assert signs == {
        (nodes.name[places.part[row]], nodes.road[1 + places.lane[row]], round(s, 6))
        for row, s in zip(rows, on.s.tolist(), strict=True)
    }
    assert np.array_equal(places.start[rows], places.end[rows])


@pytest.mark.parametrize("name", ["Town01", "Town07", "fabriksgatan_traffic_lights"])
def test_a_light_lies_once_or_more_on_each_lane_that_it_controls_and_in_junctions_at_their_start(
    data: Path, name: str
) -> None:
    road_map = town(data, name)
    places, edges, nodes = road_map.places, road_map.edges, road_map.nodes
    controlled = {
        (-1 - src, -2 - dst)
        for src, dst, relation in zip(edges.src, edges.dst, edges.relation, strict=True)
        if KINDS[int(nodes.kind[-1 - src])] in SIGNALS
        and relation == RELATION_CODE["controlsTrafficOf"]
    }
    rows = [row for row, what in enumerate(places.what) if what in {*SIGNALS, "stop_line"}]
    assert {(places.part[row], places.lane[row]) for row in rows} == controlled
    for row in rows:
        if nodes.junction[1 + places.lane[row]]:
            assert places.start[row] == places.end[row] == 0


def test_lanes_without_sections_have_no_places(data: Path) -> None:
    places = town(data, "Town02").without_sections.places
    assert all(what.startswith("{") for what in places.what)  # attributes


# How far it is: against Dijkstra ---------------------------------------------------------------


def searched(ways: Ways, one: Stretches, other: Stretches) -> float | None:
    """The distance by its definition, every way tried."""
    ahead, behind = math.inf, math.inf
    for lane, first, last in one:
        for to, start, end in other:
            if lane == to and first <= end and start <= last:
                return 0.0
            ahead = min(ahead, driven(ways, (lane, last), (to, start)))
            behind = min(behind, driven(ways, (to, end), (lane, first)))
    nearest = ahead if ahead <= behind else -behind
    return nearest if abs(nearest) <= FARTHEST else None


def at_the_limit(far: float | None) -> bool:
    return far is not None and abs(abs(far) - FARTHEST) < 1e-6


@pytest.mark.parametrize("name", ["Town01", "Town07", "fabriksgatan", "multi_intersections"])
def test_from_any_place_it_is_as_far_as_dijkstra_finds(data: Path, name: str) -> None:
    road_map = town(data, name)
    ways, found = lane_ways(road_map), stretches(road_map)
    reach = LaneDistances(*road_map.reach, road_map.places.rows())
    rng = np.random.default_rng(2)
    lengths = road_map.ribbons.lengths
    nodes = sorted(found)
    by_sort = {
        sort: [
            (lane, start, end)
            for what, lane, start, end in zip(
                road_map.places.what, *columns_of(road_map), strict=True
            )
            if what == sort
        ]
        for sort in SORTS
    }
    told = 0
    for _ in range(2000 if LONG else 30):
        lane = int(rng.integers(len(lengths)))
        along = float(rng.uniform(0, lengths[lane]))
        here, at = [(-2 - lane, along, along)], [(lane, along, along)]
        for part in rng.choice(nodes, 3).tolist():
            expected = searched(ways, at, found[part])
            if not at_the_limit(expected):
                known = reach.between(here, reach.stretches(-1 - part))
                assert known == pytest.approx(expected, abs=1e-9)
                back = reach.between(reach.stretches(-1 - part), here)
                assert (known is None) == (back is None)
                told += known is not None
        sort = SORTS[int(rng.integers(len(SORTS)))]
        ahead = [driven(ways, (lane, along), (to, start)) for to, start, _ in by_sort[sort]]
        on = any(to == lane and s <= along <= e for to, s, e in by_sort[sort])
        nearest = 0.0 if on else min(ahead, default=math.inf)
        if not at_the_limit(nearest):
            expected = nearest if nearest <= FARTHEST else None
            assert reach.next(here, sort) == pytest.approx(expected, abs=1e-9)
            told += expected is not None
    assert told > 5


def columns_of(road_map: RoadMap) -> list[list[Any]]:
    places = road_map.places
    return [column.tolist() for column in (places.lane, places.start, places.end)]


# In a store, in memory and in networkx the same ------------------------------------------------


def traffic(road_map: RoadMap, seed: int) -> list[list[Any]]:
    """Cars on lanes of a part of a map, some lights of it, and the frames in which they move on."""
    rng = np.random.default_rng(seed)
    nodes, lengths = road_map.nodes, road_map.ribbons.lengths
    driving = [i for i in range(len(lengths)) if nodes.lane_type[1 + i] == "driving"]
    lights = [c for c, kind in enumerate(nodes.kind) if KINDS[kind] == "traffic_light"]
    centre = int(rng.choice(lights)) if lights else 1 + int(rng.choice(driving))
    x, y = nodes.x[centre], nodes.y[centre]
    near = [i for i in driving if math.hypot(nodes.x[1 + i] - x, nodes.y[1 + i] - y) < 70]
    frames: list[list[Any]] = []
    for number in range(4):
        lane = np.array([near[i % len(near)] for i in range(9)])
        points = road_map.ribbons.at(lane, rng.uniform(0, 1, 9) * lengths[lane])
        places = zip(points.x, points.y, points.z, points.heading, strict=True)
        cars = [
            thing("ego" if n == 0 else f"c{n}", x, y, heading, z=z + 0.75, kind="car")
            for n, (x, y, z, heading) in enumerate(places)
        ]
        poles = [
            thing(
                f"light {c}",
                nodes.x[c],
                nodes.y[c],
                z=nodes.z[c],
                kind="traffic_light",
                map_ref=nodes.name[c],
                static=True,
            )
            for c in lights[:40]
        ]
        frames.append([*cars[: 9 - number], *poles])
    return frames


@pytest.fixture(scope="module", params=["Town07", "multi_intersections"])
def store(
    request: pytest.FixtureRequest, data: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Store]:
    path = tmp_path_factory.mktemp("store") / "s.db"
    file, road_map = StoreFile.create(path), town(data, request.param)
    generator = SceneGraphGenerator(road_map, Config())
    block = Recording().block(*traffic(road_map, 3))
    answers = ("isIn", "controlsTrafficOf", "travelsTo")
    with file.segment(trace_info(), Config(), road_map=road_map, answers=answers) as segment:
        segment.append(generator.block(block))
        file.publish(segment.seal(TraceReport(frames=4)))
    store = Store(path)
    with store.file.snapshot():
        yield store


PARTS = ("Lane", "Road", "Junction", "Crosswalk", "TrafficLight", "StopSign", "Sign", "YieldSign")


@pytest.mark.parametrize("label", PARTS)
def test_a_store_says_of_a_part_what_its_graphs_say(store: Store, label: str) -> None:
    query = (
        f"MATCH (e:Car), (p:{label}) RETURN frame.id, e.id, p.id, lane_dist(e, p), lane_dist(p, e)"
    )
    rows = [row[-5:] for row in store.find(query).rows()]

    told = 0
    for frame in sorted({row[0] for row in rows}):
        graph = store.file.graph(frame)
        view = FrameView(graph)
        name = (
            "lane_dist"
            if label in {"TrafficLight", "StopSign", "Sign", "YieldSign"}
            else "part_dist"
        )
        for _, e, p, far, back in (row for row in rows if row[0] == frame):
            assert graph.lane_dist(e, p) == far == view.pair(name, e, p)
            assert graph.lane_dist(p, e) == back == view.pair(name, p, e)
            told += far is not None
    assert told > 5 or not rows or label == "Sign"


def test_a_store_says_of_the_next_part_what_its_graphs_say(store: Store) -> None:
    functions = ", ".join(f"to_{sort}(v)" for sort in SORTS)
    rows = [
        row[-8:] for row in store.find(f"MATCH (v:Car) RETURN frame.id, v.id, {functions}").rows()
    ]

    known = dict.fromkeys(SORTS, 0)
    for frame, node, *values in rows:
        graph = store.file.graph(frame)
        view = FrameView(graph)
        for sort, far in zip(SORTS, values, strict=True):
            assert graph.to_next(node, sort) == far == view.pair(f"to_{sort}", node, node)
            known[sort] += far is not None
    assert known["junction"] > 2
    assert sum(known.values()) > 10


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (e:Ego), (j:Junction) WHERE lane_dist(e, j) > 0 AND lane_dist(e, j) < 60",
        "MATCH (v:Car), (t:TrafficLight) WHERE lane_dist(v, t) >= 0 AND lane_dist(v, t) < 40",
        "MATCH (v:Car) WHERE to_junction(v) < 30 AND NOT to_junction(v) = 0",
        "MATCH (v:Car) WHERE NOT EXISTS {(s:StopSign) WHERE abs(lane_dist(v, s)) < 80}",
        "MATCH (v:Car), (w:Car) WHERE to_junction(v) < to_junction(w)",
        "MATCH (v:Car) WHERE MIN {(j:Junction) WHERE lane_dist(v, j) > 0 | lane_dist(v, j)} < 100",
        "MATCH (v:Car)-[:isIn]->(l:Lane), (m:Lane) WHERE lane_dist(l, m) > 0 AND lane_dist(v, m) < 20",
    ],
)
def test_conditions_are_met_by_the_same_matches_in_sql_and_in_memory(
    store: Store, text: str
) -> None:
    frames = [frame.frame_id for frame in store.find("MATCH (:Ego)").frames()]
    found = {frame.frame_id for frame in store.find(text).frames()}

    for frame in frames:
        # Why-not searches the graph of the frame in memory.
        assert (store.why_not(frame, text).as_dict()["failed"] is None) == (frame in found)


def test_it_changes_over_time_and_stands_in_checks(store: Store) -> None:
    rows = store.find("MATCH (v:Car) WHERE v.id = 1 RETURN frame.seq, to_junction(v)").rows()
    far = {row[-2]: row[-1] for row in rows}
    before = store.find(
        "MATCH (v:Car) WHERE v.id = 1 RETURN frame.seq, prev(to_junction(v)), min_over(to_junction(v), 2frames)"
    ).rows()

    for seq, prev, least in (row[-3:] for row in before):
        assert prev == far.get(seq - 1)
        known = [one for one in (far.get(seq - 1), far[seq]) if one is not None]
        assert least == (min(known) if known else None)
    (verdict,) = store.check(
        "CHECK c: ALWAYS (to_junction(ego) >= 0 OR NOT known(to_junction(ego)))"
    )
    assert verdict.verdict == "true"


def test_a_variable_that_may_be_an_entity_is_no_part_of_the_map(store: Store) -> None:
    rows = store.find("MATCH (e:Ego), (x) WHERE lane_dist(e, x) < 1000 RETURN x.id, x.kind").rows()

    assert {row[-1] for row in rows} <= {"car", *SIGNALS}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("MATCH (e:Ego) WHERE to_junction(e, e) < 3", "to_junction() takes 1 argument, found 2"),
        (
            "MATCH (l:Lane) WHERE to_junction(l) < 3",
            "to_junction() takes an entity, but this is a lane",
        ),
        ("MATCH (e:Ego) WHERE lane_dist(e, junction) < 3", "the next one write to_junction(e)"),
        ("MATCH (e:Ego), (w:Waypoint) WHERE lane_dist(e, w) < 3", "but this is a waypoint"),
        ("MATCH (e:Ego), (l:Lane) WHERE gap(e, l) < 3", "gap() takes two entities"),
    ],
)
def test_mistakes_are_told(store: Store, text: str, reason: str) -> None:
    with pytest.raises(QueryError) as refused:
        store.find(text)
    assert reason in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (v:Car), (w:Car) WHERE lane_dist(v, w) > 0 AND v.length > 1",
        "MATCH (w:Car), (v:Car) WHERE lane_dist(w, v) > 0 AND v.length > 1",
        "MATCH (v:Car) WHERE to_junction(v) < 90 AND v.length > 1",
        "MATCH (v:Car), (t:TrafficLight) WHERE abs(lane_dist(v, t)) < 90 AND v.length > 1",
        "MATCH (v:Car), (j:Junction) WHERE abs(lane_dist(v, j)) < 90 AND v.length > 1",
        "MATCH (v:Car)-[:isIn]->(l:Lane) WHERE l.role = 'Ego Lane' AND v.length > 1",
    ],
)
def test_what_a_variable_is_called_changes_nothing(store: Store, text: str) -> None:
    query = f"{text} RETURN frame.seq AS t, COUNT(*) AS n, SUM(v.id) AS i"
    rows = store.find(query).rows()

    for name in [*"abcfgmoprs", "ways"] if LONG else "abfrs":
        assert store.find(re.sub(r"\bv\b", name, query)).rows() == rows
    assert rows or store.find("MATCH (:Ego) WHERE trace.map <> 'Town07'").count()
