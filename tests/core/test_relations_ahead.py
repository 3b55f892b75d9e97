"""Along the lanes: who leads whom, which lanes a signal may affect, and where on a lane a place is."""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from builders import PaperMap, Patch, Recording, Thing, edges, frames, graph_of, thing
from test_sgg_traces import graphs, opened, recording, recordings

from sgstore.graphs.relations._lane_net import Centrelines, LaneNet
from sgstore.model.config import Config, LaneSettings, RangeSettings
from sgstore.model.vocabulary import KIND_CODE, RELATION_CODE, VEHICLES

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock

PI = math.pi
FORK = PaperMap(
    Patch("in", -100, -4, 0, 0, to=("straight", "left")),
    Patch("straight", 0, -4, 20, 0, junction="j", road="r1", to=("out",), controlled_by="s1"),
    Patch("left", 0, -4, 15, 3, junction="j", road="r2", to=("north",)),
    Patch("out", 20, -4, 100, 0, to=("far",)),
    Patch("far", 100, -4, 300, 0),
    Patch("north", 30, 40, 90, 44, to=("far",)),
    Patch("contrary", -100, 0, 100, 4),
    Patch("kerb", -100, -6, 100, -4, lane_type="parking"),
    objects=(("s1", "traffic_light"),),
)
WIDE = Config(range=RangeSettings(400))

Pair = tuple[str, str]


def followed(
    things: list[Thing], config: Config = WIDE, town: PaperMap = FORK
) -> dict[Pair, float]:
    """Who follows whom, and the gap."""
    recording = Recording()
    graph = graph_of(recording.block(things), town, config)
    return gaps(graph, 0, recording.names)


def gaps(graph: GraphBlock, frame: int, names: list[str]) -> dict[Pair, float]:
    """Who follows whom in a frame, and the gap; the edges both ways must agree."""
    of, here = graph.gaps, graph.gaps.frame == frame
    columns = (column[here].tolist() for column in (of.src, of.dst, of.gap))
    found = {(names[src], names[dst]): gap for src, dst, gap in zip(*columns, strict=True)}
    assert len(found) == here.sum()
    pairs = {
        relation: {
            (names[src], names[dst])
            for _, src, dst in edge_ends(graph, RELATION_CODE[relation], frame)
        }
        for relation in ("leads", "follows")
    }
    assert pairs["follows"] == found.keys()
    assert pairs["leads"] == {(b, a) for a, b in found}
    return found


# Who leads --------------------------------------------------------------------------------------


def test_the_next_one_ahead_leads_and_no_other() -> None:
    things = [thing("ego", -80, -2), thing("a", -60, -2), thing("b", -30, -2)]

    assert followed(things) == pytest.approx({("ego", "a"): 16, ("a", "b"): 26})
    of = edges(graph_of(frames(things), FORK, WIDE), 0, FORK)
    assert {e for e in of if e[1] in {"leads", "follows"}} == {
        ("a", "leads", "ego"),
        ("ego", "follows", "a"),
        ("b", "leads", "a"),
        ("a", "follows", "b"),
    }


@pytest.mark.parametrize(
    ("other", "gap"),
    [
        pytest.param(thing("b", -50, -2), 26, id="on the same lane"),
        pytest.param(thing("b", -50, -3.5), 26, id="wherever across it"),
        pytest.param(thing("b", -50, -2, length=10), 23, id="from bumper to bumper"),
        pytest.param(thing("b", -79, -2), 0, id="overlapping"),
        pytest.param(thing("b", 60, -2), None, id="too far along the lanes"),
        pytest.param(thing("b", 18, -2), 94, id="on a lane that follows"),
        pytest.param(thing("b", 36, 42), None, id="at the end of a way that is too long"),
        pytest.param(thing("b", -50, -2, heading=PI), None, id="coming towards it"),
        pytest.param(thing("b", -50, -2, heading=1.5), 26, id="turned, but not against the lane"),
        pytest.param(thing("b", -50, -2, heading=math.nan), None, id="of unknown heading"),
        pytest.param(thing("b", -50, 2, heading=PI), None, id="on the lane beside"),
        pytest.param(thing("b", -50, -5.5), None, id="parked beside the lane"),
        pytest.param(thing("b", -50, -2, static=True), 26, id="parked on it"),
        pytest.param(thing("b", -50, -2, kind="person"), None, id="a person"),
        pytest.param(thing("b", -50, -2, kind="bicycle"), 26, id="a bicycle"),
        pytest.param(thing("b", -50, -2, z=7), None, id="on a bridge"),
        pytest.param(thing("b", -50, 30), None, id="off the road"),
        pytest.param(thing("b", math.nan, -2), None, id="nowhere"),
    ],
)
def test_who_leads_the_ego(other: Thing, gap: float | None) -> None:
    found = followed([thing("ego", -80, -2), other])

    assert found.get(("ego", "b")) == (None if gap is None else pytest.approx(gap))


def test_a_gap_from_a_vehicle_of_unknown_length_is_missing() -> None:
    (gap,) = followed([thing("ego", -80, -2), thing("b", -50, -2, length=math.nan)]).values()

    assert math.isnan(gap)


def test_where_the_way_forks_the_next_on_each_branch_leads() -> None:
    things = [thing("ego", -30, -2), thing("l", 12, 2), thing("s", 40, -2), thing("n", 35, 42)]

    found = followed(things)

    assert {b for a, b in found if a == "ego"} == {"l", "s"}
    assert found["ego", "s"] == pytest.approx(66)
    assert found["ego", "l"] == pytest.approx(38)
    assert found["l", "n"] == pytest.approx(3 + 5 - 4)


def test_where_ways_join_both_follow_the_same_one_by_the_shortest_way() -> None:
    things = [thing("ego", 80, -2), thing("n", 85, 42), thing("f", 110, -2)]

    assert followed(things) == pytest.approx({("ego", "f"): 26, ("n", "f"): 5 + 10 - 4})


def test_at_the_mouth_of_a_junction_a_vehicle_is_on_all_its_ways() -> None:
    mouth, beyond = thing("ego", 3, -2), thing("n", 35, 42)

    assert ("ego", "n") in followed([mouth, beyond])
    assert ("ego", "n") not in followed([thing("ego", 18, -2), beyond])  # beyond where "left" ends
    assert ("ego", "n") not in followed([thing("ego", 3, -2, heading=-1), beyond])


def test_who_stands_for_ever_leads_but_does_not_follow() -> None:
    things = [thing("ego", -80, -2), thing("p", -60, -2, static=True), thing("q", -40, -2)]

    assert followed(things).keys() == {("ego", "p")}


def test_round_a_ring_two_may_lead_one_another_and_nobody_leads_itself() -> None:
    ring = PaperMap(
        Patch("a", 0, 0, 20, 4, to=("b",)),
        Patch("b", 0, 10, 20, 14, to=("c",)),
        Patch("c", 0, 20, 20, 24, to=("a",)),
    )

    assert followed([thing("ego", 10, 2)], town=ring) == {}
    two = followed([thing("ego", 10, 2), thing("x", 5, 12)], town=ring)
    assert two == pytest.approx({("ego", "x"): 10 + 5 - 4, ("x", "ego"): 15 + 20 + 10 - 4})
    behind = followed([thing("ego", 10, 2), thing("x", 5, 2)], town=ring)
    assert behind == pytest.approx({("x", "ego"): 1, ("ego", "x"): 10 + 40 + 5 - 4})


def test_how_far_ahead_is_looked_is_set() -> None:
    things = [thing("ego", -80, -2), thing("b", -50, -2)]

    assert followed(things, Config(lanes=LaneSettings(ahead=30)))
    assert not followed(things, Config(lanes=LaneSettings(ahead=29.9)))


def test_where_nothing_is_looked_for_nothing_is_known() -> None:
    blind = Config(lanes=LaneSettings(ahead=0))
    of = edges(graph_of(frames([thing("ego", -80, -2), thing("b", -50, -2)]), FORK, blind), 0, FORK)

    assert not {relation for _, relation, _ in of} & {"leads", "follows", "mayAffect"}


# … by trying every way --------------------------------------------------------------------------


Own = dict[int, list[tuple[int, float]]]


def by_trying(
    own: Own, onward: dict[int, list[int]], lengths: list[float], limit: float
) -> dict[tuple[int, int], float]:
    """Who follows whom: distance of the centres. ``own``: lanes and places of each vehicle."""
    found: dict[tuple[int, int], float] = {}

    def drive(a: int, lane: int, way: tuple[int, ...], distance: float, start: float) -> None:
        """On along a lane, from a place on it, at which the distance is given."""
        if distance > limit or lane in way:
            return
        ahead = first(own, lane, a, start)
        if ahead is None:
            for other in onward.get(lane, []):
                passed = (*way, lane) if start < 0 else ()  # one may come back to where one began
                drive(a, other, passed, distance + lengths[lane] - max(start, 0), -1)
        elif distance + ahead[0] - max(start, 0) <= limit:
            pair = a, ahead[1]
            apart = distance + ahead[0] - max(start, 0)
            found[pair] = min(apart, found.get(pair, math.inf))

    for a, places in own.items():
        for lane, along in places:
            drive(a, lane, (), 0, along)
    return found


def first(own: Own, lane: int, a: int, start: float) -> tuple[float, int] | None:
    """Place and name of the first one beyond a place on a lane, but for ``a``."""
    places = [(along, b) for b, on in own.items() if b != a for at, along in on if at == lane]
    return min((place for place in places if place > (start, a)), default=None)


def own_places(graph: GraphBlock, frame: int, kinds: list[int], road_map: RoadMap) -> Own:
    """The own lanes of the vehicles of a frame, and their places along them, as they are documented."""
    nodes, of = road_map.nodes, graph.lanes
    rows = np.flatnonzero(of.frame == frame).tolist()
    primary = {int(of.node[row]): int(of.lane[row]) for row in rows if of.primary[row]}
    boxes = positions(graph, frame)
    own: Own = {}
    for row in rows:
        node, lane = int(of.node[row]), int(of.lane[row])
        column, error = -1 - lane, abs(of.heading_error[row])
        junction = nodes.junction[-1 - primary[node]]
        mine = lane == primary[node] and error < PI / 2
        mine |= (
            bool(junction)
            and nodes.junction[column] == junction
            and error <= PI / 4
            and abs(of.offset[row]) <= nodes.width[column] / 2
        )
        traffic = nodes.lane_type[column] in TRAFFIC
        if mine and traffic and kinds[node] in VEHICLE_CODES and not math.isnan(boxes[node][2]):
            along = project(road_map, -2 - lane, *boxes[node][:2])
            own.setdefault(node, []).append((-2 - lane, along))
    return own


VEHICLE_CODES = {KIND_CODE[kind] for kind in VEHICLES}
TRAFFIC = {"driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp"}
TRAFFIC |= {"slipLane", "bus", "taxi", "HOV", "mwyEntry", "mwyExit", "biking"}
TRAFFIC |= {"special1", "special2", "special3"}


def positions(graph: GraphBlock, frame: int) -> dict[int, tuple[float, float, float]]:
    of = graph.frames
    rows = range(of.offsets[frame], of.offsets[frame + 1])
    states = of.states
    return {
        int(states.node[row]): (states.x[row], states.y[row], states.heading[row]) for row in rows
    }


def project(road_map: RoadMap, lane: int, x: float, y: float) -> float:
    """Place along a lane, by shapely: on the straight lines between cross sections."""
    of = road_map.ribbons
    rows = slice(of.offsets[lane], of.offsets[lane + 1])
    middle = np.column_stack([of.left_x + of.right_x, of.left_y + of.right_y])[rows] / 2
    steps = np.hypot(*np.diff(middle, axis=0).T)
    at = shapely.LineString(middle).project(shapely.Point(x, y))
    return float(np.interp(at, np.concatenate([[0], np.cumsum(steps)]), of.along[rows]))


def ways(road_map: RoadMap) -> dict[int, list[int]]:
    of, onward = road_map.edges, dict[int, list[int]]()
    flow = of.relation == RELATION_CODE["travelsTo"]
    for src, dst in zip((-2 - of.src[flow]).tolist(), (-2 - of.dst[flow]).tolist(), strict=True):
        onward.setdefault(src, []).append(dst)
    return onward


def random_net(rng: np.random.Generator, count: int) -> PaperMap:
    """Lanes in rows, some of them on one another in a junction, that lead anywhere."""
    names = [f"l{i}" for i in range(count)]
    patches = [
        Patch(
            names[i],
            0,
            6 * (i // 2 if i < 6 else i),
            float(rng.integers(5, 40)),
            6 * (i // 2 if i < 6 else i) + 4,
            junction="j" if i < 6 else "",
            road=f"r{i}",
            to=tuple(rng.choice(names, rng.integers(0, 3), replace=False).tolist()),
        )
        for i in range(count)
    ]
    return PaperMap(*patches)


@pytest.mark.parametrize("seed", range(40))
def test_on_random_nets_it_is_as_trying_every_way_tells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    town = random_net(rng, 12)
    scenes = [
        [
            thing(
                f"c{i}",
                rng.uniform(0, 30),
                6 * rng.integers(0, 12) + rng.uniform(1, 3),
                rng.choice([0, 0, 0, 0.5, PI]) + rng.normal(0, 0.1),
            )
            for i in range(rng.integers(1, 12))
        ]
        for _ in range(5)
    ]
    recording = Recording("c0")
    graph = graph_of(recording.block(*scenes), town, WIDE)
    kinds = [KIND_CODE["car"]] * len(recording.names)
    lengths = town.ribbons.lengths.tolist()

    for frame in range(len(scenes)):
        expected = by_trying(own_places(graph, frame, kinds, town), ways(town), lengths, 100)
        found = gaps(graph, frame, [str(i) for i in range(len(kinds))])
        assert found == pytest.approx(
            {(str(a), str(b)): max(d - 4, 0) for (a, b), d in expected.items()}
        )


@pytest.mark.data
@recordings
def test_on_recordings_it_is_as_trying_every_way_tells(data: Path, name: str) -> None:
    path = recording(data, name)
    blocks, road_map = opened(path)
    if road_map is None:
        assert all(len(graph.gaps) == 0 for graph in graphs(path))
        return
    kinds = [kind for block in blocks for kind in block.entities.kind.tolist()]
    names = [str(node) for node in range(len(kinds))]
    onward, lengths = ways(road_map), road_map.ribbons.lengths.tolist()
    pairs = 0
    for graph in graphs(path):
        sizes = dict(zip(graph.frames.states.node, graph.frames.states.length, strict=True))
        carriers = dict(zip(graph.frames.states.node, graph.frames.states.carrier, strict=True))
        for frame in range(0, len(graph), 20):
            own = own_places(graph, frame, kinds, road_map)
            own = {node: places for node, places in own.items() if node in sizes}
            expected = {
                (str(a), str(b)): max(d - (sizes[a] + sizes[b]) / 2, 0)
                for (a, b), d in by_trying(own, onward, lengths, 100).items()
                if carriers.get(a) != b
            }
            assert gaps(graph, frame, names) == pytest.approx(expected, abs=1e-6, nan_ok=True)
            pairs += len(expected)
    assert pairs or name not in {"esmini/swarm_Town04", "sumo/Town10HD_sumo_osi"}


# Places along lanes -----------------------------------------------------------------------------


@pytest.mark.data
def test_places_along_the_lanes_of_a_town_are_those_of_shapely(data: Path) -> None:
    road_map = opened(recording(data, "esmini/swarm_Town04"))[1]
    assert road_map is not None
    rng, count = np.random.default_rng(1), 3000
    lane = rng.integers(0, len(road_map.ribbons), count)
    points = road_map.ribbons.at(lane, rng.uniform(0, 1, count) * road_map.ribbons.lengths[lane])
    x, y = points.x + rng.normal(0, 2, count), points.y + rng.normal(0, 2, count)

    along = Centrelines(road_map.ribbons).along(lane, x, y)
    along = np.clip(along, 0, road_map.ribbons.lengths[lane])  # beyond the ends shapely stays there

    expected = [project(road_map, *of) for of in zip(lane.tolist(), x, y, strict=True)]
    assert np.abs(along - expected).max() < 1e-6


# Signals ----------------------------------------------------------------------------------------


def affected(things: list[Thing], config: Config, town: PaperMap = FORK) -> set[tuple[str, str]]:
    of = edges(graph_of(frames(things), town, config), 0, town)
    return {(src, dst) for src, relation, dst in of if relation == "mayAffect"}


def test_a_signal_may_affect_its_lanes_and_those_from_which_it_lies_ahead() -> None:
    ego = thing("ego", -30, -2)
    light = thing("light", 0, -5, kind="traffic_light", map_ref="s1")

    assert affected([ego], WIDE) == {("s1", "straight"), ("s1", "in")}
    assert affected([ego, light], WIDE) == {("light", "straight"), ("light", "in")}


def test_a_light_that_the_map_lacks_may_affect_what_leads_to_its_lanes() -> None:
    town = PaperMap(
        *FORK.patches
    )  # its lanes are told, as by a trigger box, and no signal is there
    ego, light = thing("ego", -30, -2), thing("light", 0, -5, kind="traffic_light", map_ref="s1")
    other = thing("light", 0, -5, kind="traffic_light", map_ref="s2")
    none = Config(range=RangeSettings(400), lanes=LaneSettings(ahead=0))

    assert affected([ego, light], WIDE, town) == {("light", "straight"), ("light", "in")}
    assert affected([ego, light], none, town) == set()
    assert affected([ego, other], WIDE, town) == set()


def test_how_far_a_signal_is_ahead_counts_from_the_end_of_the_lane() -> None:
    FORK.nodes.x[-1 - FORK.ids["s1"]] = 12
    try:
        near, far = (
            Config(range=RangeSettings(400), lanes=LaneSettings(ahead=d)) for d in (12, 11.9)
        )
        assert affected([thing("ego", -30, -2)], near) == {("s1", "straight"), ("s1", "in")}
        assert affected([thing("ego", -30, -2)], far) == {("s1", "straight")}
    finally:
        FORK.nodes.x[-1 - FORK.ids["s1"]] = 0


def test_only_lanes_in_range_are_affected() -> None:
    narrow = Config(range=RangeSettings(10))

    assert affected([thing("ego", -30, -2)], narrow) == {("s1", "in")}


@pytest.mark.data
@pytest.mark.parametrize("limit", [0.5, 30, 200])
def test_lanes_upstream_in_a_town_are_those_that_lead_there(data: Path, limit: float) -> None:
    road_map = opened(recording(data, "esmini/swarm_Town04"))[1]
    assert road_map is not None
    net, onward, lengths = LaneNet(road_map), ways(road_map), road_map.ribbons.lengths
    for lane in np.random.default_rng(0).integers(0, len(lengths), 20).tolist():
        along = float(lengths[lane]) / 3

        expected = {lane} | {
            start
            for start in range(len(lengths))
            if driven(onward, lengths, start, lane) + along <= limit
        }

        assert set(net.upstream(lane, along, limit).tolist()) == expected


def driven(onward: dict[int, list[int]], lengths: Any, start: int, goal: int) -> float:
    """Distance from the end of a lane to the start of another."""
    queue, done = [(0.0, other) for other in onward.get(start, [])], set[int]()
    while queue:
        distance, lane = heapq.heappop(queue)
        if lane == goal:
            return distance
        if lane not in done and distance < 300:
            done.add(lane)
            for other in onward.get(lane, []):
                heapq.heappush(queue, (distance + float(lengths[lane]), other))
    return math.inf


@pytest.mark.data
def test_the_lights_of_a_town_may_affect_the_lanes_that_they_control(data: Path) -> None:
    controls, affects = (RELATION_CODE[name] for name in ("controlsTrafficOf", "mayAffect"))
    seen = 0
    for graph in graphs(recording(data, "esmini/traffic_lights")):
        both = [edge_ends(graph, code) for code in (controls, affects)]
        assert both[0] <= both[1]
        seen += len(both[1])
    assert seen


def edge_ends(graph: GraphBlock, code: int, frame: int | None = None) -> set[tuple[int, int, int]]:
    of = graph.edges
    rows = (of.relation == code) & ((of.frame == frame) | (frame is None))
    return set(zip(of.frame[rows], of.src[rows], of.dst[rows], strict=True))
