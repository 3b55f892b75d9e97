"""How far it is along the lanes from entity to entity: against Dijkstra, and the same wherever it is asked."""

from __future__ import annotations

import cmath
import math
import re
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
import pytest
from builders import PaperMap, Patch, Recording, graph_of, thing
from graph_blocks import RandomTrace, map_stub, publish
from thorough import LONG

from sgstore.errors import QueryError
from sgstore.graphs.online import Frame
from sgstore.lang.memory import FrameView
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, RangeSettings
from sgstore.model.graph import LaneDistances
from sgstore.model.vocabulary import RELATION_CODE, SIGNALS
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile
from sgstore.temporal import Monitor, MonitorEvent

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.roads import RoadMap

    Ways = nx.DiGraph[tuple[int, str]]

pytestmark = pytest.mark.seconds(10)

FARTHEST = 200.0
"""Beyond it ``lane_dist`` is NULL, as the page of the language says; m."""

ROADS = map_stub(seed=4)
DRIVE = RandomTrace(seed=4, frames=70, road_map=ROADS, path="/r/drive.mcap")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    path = tmp_path_factory.mktemp("store") / "s.db"
    file = StoreFile.create(path)
    publish(file, DRIVE)
    publish(file, RandomTrace(seed=5, frames=20, path="/r/field.mcap"))
    store = Store(path)
    with store.file.snapshot():
        yield store


def lane_ways(road_map: RoadMap) -> Ways:
    """The lanes as roads from their starts to their ends, which are joined where traffic flows on."""
    ways: Ways = nx.DiGraph()
    for lane, length in enumerate(road_map.ribbons.lengths.tolist()):
        ways.add_edge((lane, "start"), (lane, "end"), weight=length)
    edges, lanes = road_map.edges, len(road_map.ribbons)
    for code, src, dst in zip(edges.relation, edges.src, edges.dst, strict=True):
        if code == RELATION_CODE["travelsTo"] and -1 - lanes <= src:
            ways.add_edge((int(-2 - src), "end"), (int(-2 - dst), "start"), weight=0.0)
    return ways


def driven(ways: Ways, one: tuple[int, float], other: tuple[int, float]) -> float:
    """How far one drives from a place to another, by Dijkstra; infinite where there is no way."""
    (lane, along), (to, at) = one, other
    if lane == to and at >= along:
        return at - along
    rest = ways.edges[(lane, "start"), (lane, "end")]["weight"] - along
    try:
        between = nx.dijkstra_path_length(ways, (lane, "end"), (to, "start"))
    except nx.NetworkXNoPath:
        return math.inf
    return rest + between + at


@pytest.mark.parametrize("town", ["Town01", "Town02", "Town07", "fabriksgatan", "soderleden"])
def test_between_any_two_places_it_is_the_shorter_way_that_dijkstra_finds(
    data: Path, town: str
) -> None:
    path = data / f"maps/{town}.xodr"
    road_map = read_map(path.read_text(), town)
    ways, reach = lane_ways(road_map), LaneDistances(*road_map.reach)
    rng = np.random.default_rng(1)
    lengths = road_map.ribbons.lengths
    near = np.stack([-2 - nodes for nodes in road_map.reach[:2]], axis=1)
    pairs = near[rng.integers(0, len(near), 500)].tolist()
    pairs += rng.integers(0, len(lengths), (400, 2)).tolist()
    pairs += [(lane, lane) for lane in rng.integers(0, len(lengths), 100).tolist()]
    found = 0
    for lane, other in pairs:
        one, two = ((n, float(rng.uniform(0, lengths[n]))) for n in (lane, other))
        ahead, back = driven(ways, one, two), driven(ways, two, one)
        expected = ahead if ahead <= back else -back
        known = reach.distance([(-2 - one[0], one[1])], [(-2 - two[0], two[1])])
        if abs(abs(expected) - FARTHEST) < 1e-6:
            continue
        if abs(expected) > FARTHEST:
            assert known is None
        else:
            found += 1
            assert known == pytest.approx(expected, abs=1e-9)
    assert found > 200


def test_the_view_the_language_the_graph_and_networkx_say_the_same_to_the_last_bit(
    store: Store,
) -> None:
    query = "MATCH (a:Entity), (b:Entity) RETURN frame.id, a.id, b.id, lane_dist(a, b)"
    asked = {row[-4:-1]: row[-1] for row in store.find(query).rows()}
    sql = "SELECT frame_id, src, dst, lane_dist FROM pairs LEFT JOIN lane_dists USING (frame_id, src, dst)"
    told = {row[:3]: row[3] for row in store.sql(sql).values}
    known = 0
    for frame in sorted({frame for frame, *_ in told}):
        graph = store.file.graph(frame)
        view, places = FrameView(graph), graph.places()
        drawn = graph.to_networkx()
        for a in graph.nodes:
            for b in graph.nodes:
                if a < 0 or b < 0 or a == b:
                    continue
                far = graph.lane_dist(a, b)
                assert view.pair("lane_dist", a, b) == far
                assert asked[frame, a, b] == far
                signals = {graph.nodes[a]["kind"], graph.nodes[b]["kind"]} & {*SIGNALS}
                if (frame, a, b) in told and not signals:  # the view has what moves
                    assert told[frame, a, b] == far
                known += far is not None
                assert far is None or signals or (a in places and b in places)
                for edge in (drawn.get_edge_data(a, b) or {}).values():
                    assert edge.get("lane_dist") == far
    assert known > 40


def test_the_time_to_collision_along_the_lanes_is_that_of_its_definition(open_town: Store) -> None:
    states = {row[:2]: row[2:] for row in open_town.sql(LANE_STATES).values}
    query = (
        f"MATCH (a:Entity), (b:Entity) WHERE frame.seq % {EVERY} = 0"
        " RETURN frame.id, a.id, b.id, lane_dist(a, b), ttc_lane(a, b)"
    )
    asked = {row[:3]: row[3:] for row in open_town.find(query).rows()}
    known = {frame for (frame, *_), (*_, found) in asked.items() if found is not None}
    assert len(known) > 100
    of_frame = defaultdict[int, list[tuple[int, int, Any, Any]]](list)
    for (at, *pair), values in asked.items():
        of_frame[at].append((*pair, *values))
    for frame in sorted(known)[:: (20 if LONG else 60) // EVERY]:
        events: list[MonitorEvent] = []
        online = "MATCH (a:Entity), (b:Entity) RETURN FIRST(ttc_lane(a, b)) OVER match"
        monitor = Monitor(online, period_s=0.1, on_event=events.append)
        monitor.look([open_town.file.graph(frame)])
        monitor.finish()
        told = {(e.nodes["a"], e.nodes["b"]): next(iter(e.values.values())) for e in events}
        for a, b, far, found in of_frame[frame]:
            one, other = states.get((frame, a)), states.get((frame, b))
            expected = None
            if far is not None and far > 0 and one is not None and other is not None:
                faster = _speed_along(*one) - _speed_along(*other)
                between = far - _half_along(*one) - _half_along(*other)
                if abs(faster) < 0.01:  # the headings of the view have 32 bits
                    continue
                expected = max(between, 0) / faster if faster > 0 else None
            assert (found is None) == (expected is None) == (told[a, b] is None)
            if found is not None and expected is not None:
                assert found == pytest.approx(expected, rel=1e-3)
                assert told[a, b] == pytest.approx(found)
    (written,) = re.findall(r"```sql\n(WITH moving.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    egos = {
        row[0] for row in open_town.sql("SELECT DISTINCT src FROM pairs WHERE src_is_ego").values
    }
    looked = {
        row[0]
        for row in open_town.sql(f"SELECT frame_id FROM frames WHERE seq % {EVERY} = 0").values
    }
    at_page = open_town.sql(written).values
    times = {row[:2]: row[2] for row in at_page if row[0] in looked and (row[2] or 1e9) < 100}
    own = {(at, b): t for (at, a, b), (_, t) in asked.items() if a in egos and (t or 1e9) < 100}
    assert times == pytest.approx(own, rel=1e-3)


LANE_STATES = """SELECT l.frame_id, l.src, n.vx::DOUBLE, n.vy::DOUBLE, n.heading, n.length::DOUBLE,
    n.width::DOUBLE, heading_error
  FROM lane_states l JOIN nodes n ON n.node_id = l.src AND n.frame_id = l.frame_id WHERE is_primary"""
PAGE = Path(__file__).parents[2] / "docs" / "criticality.md"
EVERY = 1 if LONG else 5
"""One of so many frames of the bundled recording is asked for."""


STRAIGHT = PaperMap(Patch("on", -100, -4, 300, 0))


def _speed_along(
    vx: float, vy: float, heading: float, _length: float, _width: float, error: float
) -> float:
    return (complex(vx, vy) * cmath.exp(-1j * math.radians(heading - error))).real


def _half_along(*state: float) -> float:
    *_, length, width, error = state
    corners = [
        complex(u * length, v * width) / 2 * cmath.exp(1j * math.radians(error))
        for u in (1, -1)
        for v in (1, -1)
    ]
    return max(corner.real for corner in corners)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        pytest.param((30.0, 5.0, 0.0, 4.0, 2.0), 26 / 5, id="drives ahead"),
        pytest.param((30.0, -5.0, 0.0, 4.0, 2.0), 26 / 15, id="reverses towards a"),
        pytest.param((30.0, -15.0, 180.0, 4.0, 2.0), 26 / 25, id="drives against the lane"),
        pytest.param((30.0, 0.0, 90.0, 4.0, 2.0), 27 / 10, id="stands across the lane"),
        pytest.param((30.0, 15.0, 0.0, 4.0, 2.0), None, id="is faster"),
    ],
)
def test_a_time_along_the_lanes_goes_by_the_speeds_along_them(
    other: tuple[float, ...], expected: float | None
) -> None:
    x, vx, heading, length, width = other
    frame = Frame(0, ego="a")
    frame.add("a", "car", 0, -2, heading=0, vx=10, vy=0, length=4, width=2)
    frame.add("b", "car", x, -2, heading=heading, vx=vx, vy=0, length=length, width=width)
    events: list[MonitorEvent] = []
    online = "MATCH (a:Ego), (b:Car {is_ego: FALSE}) RETURN FIRST(ttc_lane(a, b)) OVER match"
    monitor = Monitor(online, period_s=0.1, on_event=events.append)
    monitor.look([SceneGraphGenerator(STRAIGHT, Config()).step(frame)])
    monitor.finish()

    assert [next(iter(e.values.values())) for e in events] == [pytest.approx(expected)]


def test_a_time_along_the_lanes_is_of_two_entities(store: Store) -> None:
    with pytest.raises(QueryError, match=r"ttc_lane\(\) takes two entities, but this is a lane"):
        store.find("MATCH (e:Car), (l:Lane) WHERE ttc_lane(e, l) < 3").rows()


TOWN = PaperMap(
    Patch("in", -100, -4, 0, 0, to=("straight", "left")),
    Patch("straight", 0, -4, 20, 0, junction="j", road="r1", to=("out",)),
    Patch("left", 0, -4, 15, 3, junction="j", road="r2", to=("north",)),
    Patch("out", 20, -4, 300, 0),
    Patch("north", 30, 40, 90, 44),
    Patch("contrary", -100, 0, 100, 4),
)


def test_whoever_is_ahead_and_whatever_it_is_has_a_distance_and_opposite_lanes_have_none() -> None:
    things = [
        thing("ego", -50, -2),
        thing("behind", -90, -2),
        thing("turning", 5, -2),
        thing("walker", 10, -2, kind="person", heading=math.pi / 2, length=0.5, width=0.5),
        thing("gone", 30, -2),
        thing("far", 160, -2),
        thing("oncoming", -20, 2, heading=math.pi),
    ]
    recording = Recording()
    generator = SceneGraphGenerator(TOWN, Config(range=RangeSettings(400)))
    lanes = generator.block(recording.block(things)).lanes
    places: dict[str, list[tuple[int, float]]] = {}
    for node, lane, along, own in zip(lanes.node, lanes.lane, lanes.along, lanes.own, strict=True):
        if own:
            places.setdefault(recording.names[node], []).append((int(lane), float(along)))
    reach = LaneDistances(*TOWN.reach)

    def far(one: str, other: str) -> float | None:
        return reach.distance(places[one], places[other])

    assert far("ego", "behind") == pytest.approx(-40)
    assert far("behind", "ego") == pytest.approx(40)
    assert len(places["turning"]) == len(places["walker"]) == 2, "on both ways of the junction"
    assert far("ego", "turning") == pytest.approx(55)
    assert far("turning", "gone") == pytest.approx(25), "by the way straight on"
    assert far("gone", "walker") == pytest.approx(-20)
    assert far("ego", "far") is None, "farther than it is looked"
    assert far("turning", "far") == pytest.approx(155)
    assert far("ego", "oncoming") is None
    assert far("ego", "ego") == 0


def test_the_gap_between_who_follows_and_who_leads_is_the_lane_distance_less_half_of_both() -> None:
    rng = np.random.default_rng(3)
    recording = Recording()
    # One whose centre is beyond the end of its lane is taken to be at the end by who follows it.
    x = [x for x in rng.uniform(-99, 150, 40).tolist() if not 15 <= x <= 21]
    things = [thing(f"c{i}", at, -2, length=float(rng.uniform(3, 6))) for i, at in enumerate(x)]
    graph = graph_of(recording.block(things), TOWN, Config(range=RangeSettings(400)))
    lanes, gaps, reach = graph.lanes, graph.gaps, LaneDistances(*TOWN.reach)
    places: dict[int, list[tuple[int, float]]] = {}
    for node, lane, along, own in zip(lanes.node, lanes.lane, lanes.along, lanes.own, strict=True):
        if own:
            places.setdefault(int(node), []).append((int(lane), float(along)))
    lengths = {recording.names.index(t.name): t.length for t in things}
    assert len(gaps) > 20
    for src, dst, gap in zip(gaps.src.tolist(), gaps.dst.tolist(), gaps.gap, strict=True):
        far = reach.distance(places[src], places[dst])
        assert far is not None
        assert max(far - (lengths[src] + lengths[dst]) / 2, 0) == pytest.approx(gap, abs=1e-9)


def test_lanes_without_sections_have_no_places_so_that_nothing_is_known(data: Path) -> None:
    path = data / "maps/Town02.xodr"
    road_map = read_map(path.read_text(), "Town02")
    assert len(road_map.reach[0]) > len(road_map.ribbons)
    assert not len(road_map.without_sections.reach[0])


def test_it_stands_in_conditions_blocks_orders_and_counts_and_under_an_abstraction(
    store: Store,
) -> None:
    rows = "SELECT frame_id, src, dst FROM lane_dists WHERE lane_dist BETWEEN 0 AND 60"
    expected = {row[:3] for row in store.sql(rows).values}
    near = "lane_dist(a, b) >= 0 AND lane_dist(a, b) <= 60"
    told = "RETURN frame.id, a.id, b.id"
    moving = {
        row[0]
        for row in store.sql(
            "SELECT DISTINCT node_id, kind FROM nodes JOIN frames USING (frame_id)"
            " WHERE speed > -1 AND nodes.trace = 'drive'"
        ).values
        if row[1] not in SIGNALS
    }

    def found(query: str) -> list[tuple[int, ...]]:
        found = [tuple(row[-3:]) for row in store.find(query).rows()]
        return [row for row in found if {row[1], row[2]} <= moving]

    everyone = found(f"MATCH (a:Entity), (b:Entity) WHERE {near} {told}")
    assert set(everyone) == {row for row in expected if {row[1], row[2]} <= moving}
    assert len(everyone) > 10
    ordered = found(f"MATCH (a:Entity), (b:Entity) WHERE {near} {told} ORDER BY lane_dist(a, b)")
    assert sorted(ordered) == sorted(everyone)
    # E has no scenery, and kinds are drawn at random here.
    some = set(found(f"USING ABSTRACTION E MATCH (a:Entity), (b:Entity) WHERE {near} {told}"))
    assert some
    assert some < set(everyone)
    block = f"MATCH (a:Entity) WHERE EXISTS {{(b:Entity) WHERE {near}}} RETURN frame.id, a.id"
    assert {tuple(row[-2:]) for row in store.find(block).rows()} >= {row[:2] for row in everyone}
    count = store.find(f"MATCH (a:Entity), (b:Entity) WHERE {near} RETURN COUNT(*) AS n").rows()
    assert count[0][-1] >= len(everyone)
