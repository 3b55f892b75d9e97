"""What is in range: every shape against shapely, frame by frame, and the rules that hold for all of them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from builders import Thing, edges, frames, graph_of, present, thing
from conftest import REPOSITORY
from opendrive_maps import a_map, a_road, arc, cubic, lane, line, link, section

from sgstore.graphs.relations import EgoPoses, Extent
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, LaneSettings, PairSettings, RangeSettings, configured
from sgstore.model.vocabulary import (
    DRIVING,
    KIND_CODE,
    KINDS,
    RELATION_CODE,
    RELATIONS,
    TypeMeaning,
)
from sgstore.sgg import SceneGraphGenerator, map_of_graphs

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock

ARROW = ((40.0, 0.0), (-10.0, 18.0), (0.0, 0.0), (-10.0, -18.0))
SHAPES = {
    "radius": RangeSettings(35.0),
    "rectangle": RangeSettings(shape="rectangle", front=50, rear=2, side=25),
    "polygon": RangeSettings(shape="polygon", polygon=ARROW),
    "corridor": RangeSettings(shape="corridor", width=9, length=70),
}
shapes = pytest.mark.parametrize("of", SHAPES.values(), ids=SHAPES)


@cache
def town() -> RoadMap:
    path = REPOSITORY / "samples/town/town.xodr"
    return read_map(path.read_text(encoding="utf-8"), "town")


@cache
def outlines() -> Any:
    return town().outlines()


def places(seed: int, count: int = 40) -> EgoPoses:
    """Egos on lanes, roughly in their direction or against it, some off the roads, some without a number."""
    rng = np.random.default_rng(seed)
    points = town().waypoints(1.0)
    at = rng.integers(len(points), size=count)
    x, y = points.x[at] + rng.normal(0, 1, count), points.y[at] + rng.normal(0, 1, count)
    heading = points.heading[at] + rng.normal(0, 0.3, count) + np.pi * (rng.random(count) < 0.2)
    x[::9] += 30
    x[3], y[4], heading[5] = np.nan, np.nan, np.nan
    return EgoPoses(x, y, heading, points.z[at])


def boxes_around(egos: EgoPoses, seed: int, each: int = 30) -> tuple[Any, Any]:
    """Frames and footprints of things around egos; some of them points, some without a position."""
    rng = np.random.default_rng(seed)
    frame = np.repeat(np.arange(len(egos)), each)
    count = len(frame)
    box = np.column_stack(
        [
            egos.x[frame] + rng.uniform(-70, 70, count),
            egos.y[frame] + rng.uniform(-70, 70, count),
            rng.uniform(-9, 9, count),
            rng.choice([0.5, 4.5, 12.0, 60.0], count),
            rng.choice([0.5, 2.0], count),
        ]
    )
    box[::7, 3:] = np.nan
    box[::11, 2] = np.nan
    box[::13, 0] = np.nan
    return frame, box


def turned(shape: Any, x: float, y: float, heading: float) -> Any:
    shape = shapely.affinity.rotate(shape, heading, (0, 0), use_radians=True)
    return shapely.affinity.translate(shape, x, y)


def footprint(box: Any, by: str = "footprint") -> Any:
    x, y, heading, length, width = box
    if by == "centre" or np.isnan(box).any():
        return shapely.Point(x, y)
    return turned(shapely.box(-length / 2, -width / 2, length / 2, width / 2), x, y, heading)


def area(of: RangeSettings, egos: EgoPoses, i: int) -> Any:
    """The area of a frame as a shapely shape; None where there is no range."""
    x, y, heading = (float(column[i]) for column in (egos.x, egos.y, egos.heading))
    if math.isnan(x + y) or (math.isnan(heading) and of.shape != "radius"):
        return None
    if of.shape == "radius":
        return shapely.Point(x, y)
    if of.shape == "rectangle":
        return turned(shapely.box(-of.rear, -of.side, of.front, of.side), x, y, heading)
    if of.shape == "polygon":
        return turned(shapely.Polygon(of.polygon), x, y, heading)
    return shapely.MultiLineString(corridor(of.length, x, y, heading))


def reach(of: RangeSettings) -> float:
    return {"radius": of.radius, "corridor": of.width / 2}.get(of.shape, 0.0)


def corridor(length: float, x: float, y: float, heading: float) -> list[Any]:
    """Lines of a corridor: down every branch of the lanes, one after another."""
    road_map, point = town(), shapely.Point(x, y)
    ribbons, found = town().ribbons, []
    flow = road_map.edges.relation == RELATION_CODE["travelsTo"]
    onward: dict[int, list[int]] = {}
    for src, dst in zip(road_map.edges.src[flow], road_map.edges.dst[flow], strict=True):
        onward.setdefault(-2 - int(src), []).append(-2 - int(dst))

    def follow(number: int, start: float, left: float) -> None:
        found.append(cut(number, start, start + left))
        rest = left - (float(ribbons.lengths[number]) - start)
        for other in onward.get(number, []) if rest > 0 else []:
            follow(other, 0.0, rest)

    for number in range(len(ribbons)):
        if road_map.nodes.lane_type[1 + number] not in DRIVING:
            continue
        if not shapely.dwithin(outlines()[1 + number], point, 1e-3):
            continue
        start, direction = beside(number, point)
        if math.cos(direction - heading) > 0:
            follow(number, start, length)
    ahead = (x + length * math.cos(heading), y + length * math.sin(heading))
    return [one for one in found if one.length > 0] or [shapely.LineString([(x, y), ahead])]


def centre_line(number: int) -> tuple[Any, Any]:
    of = town().ribbons
    rows = slice(of.offsets[number], of.offsets[number + 1])
    x, y = (of.left_x + of.right_x)[rows] / 2, (of.left_y + of.right_y)[rows] / 2
    return np.column_stack([x, y]), of.along[rows]


def beside(number: int, point: Any) -> tuple[float, float]:
    """How far along a lane a point is, and the direction there."""
    line, along = centre_line(number)
    steps = np.append(0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    place = shapely.line_locate_point(shapely.LineString(line), point)
    i = int(np.clip(np.searchsorted(steps, place) - 1, 0, len(line) - 2))
    run = line[i + 1] - line[i]
    return float(np.interp(place, steps, along)), math.atan2(run[1], run[0])


def cut(number: int, begin: float, end: float) -> Any:
    line, along = centre_line(number)
    end = min(end, float(along[-1]))
    inner = (along > begin) & (along < end)
    ends = [[np.interp(at, along, line[:, k]) for k in (0, 1)] for at in (begin, end)]
    return shapely.LineString([ends[0], *line[inner], ends[1]])


# Shapes -----------------------------------------------------------------------------------------


@shapes
@pytest.mark.parametrize("by", ["footprint", "centre"])
@pytest.mark.parametrize("seed", range(3))
def test_entities_in_range_are_those_that_shapely_finds(
    of: RangeSettings, by: str, seed: int
) -> None:
    egos = places(seed)
    frame, boxes = boxes_around(egos, seed)
    areas = Extent(replace(of, by=by), town()).areas(egos)
    expected = []
    for i, box in zip(frame.tolist(), boxes, strict=True):
        around = area(of, egos, i)
        there = not np.isnan(box[:2]).any()
        meets = there and shapely.dwithin(around, footprint(box, by), reach(of) + 1e-9)
        expected.append(around is None or bool(meets))

    held = areas.hold(frame, boxes, np.zeros(len(frame)))

    assert held.tolist() == expected
    assert 0.05 < np.mean(held) < 0.95


@shapes
@pytest.mark.parametrize("seed", range(2))
def test_parts_of_a_map_in_range_are_those_that_shapely_finds(of: RangeSettings, seed: int) -> None:
    egos, nodes = places(seed), town().nodes
    inside = town().edges.relation == RELATION_CODE["isIn"]
    within = list(zip(town().edges.src[inside], town().edges.dst[inside], strict=True))

    parts = Extent(of, town()).areas(egos).parts(town())

    for i in range(len(egos)):
        around = area(of, egos, i)
        if around is None:
            assert parts[i].all()
            continue
        shaped = ~shapely.is_missing(outlines())
        near = {
            -1 - k for k in np.flatnonzero(shaped & shapely.dwithin(outlines(), around, reach(of)))
        }
        for kind in ("lane", "road"):
            near |= {d for s, d in within if s in near and KINDS[nodes.kind[-1 - s]] == kind}
        assert {-1 - k for k in np.flatnonzero(parts[i])} == near


@shapes
def test_the_circle_around_an_area_holds_whatever_is_in_it(of: RangeSettings) -> None:
    egos = places(7)
    frame, boxes = boxes_around(egos, 7)
    areas = Extent(of, town()).areas(egos)
    x, y, extent = boxes[:, 0], boxes[:, 1], np.hypot(boxes[:, 3], boxes[:, 4]) / 2

    held = areas.hold(frame, boxes, np.zeros(len(frame)))
    near = set(zip(*(column.tolist() for column in areas.near(x, y, extent)), strict=True))

    assert {(f, row) for row, f in enumerate(frame.tolist()) if held[row]} <= near


@shapes
def test_a_block_of_one_frame_has_the_same_range(of: RangeSettings) -> None:
    egos = places(1, 12)
    frame, boxes = boxes_around(egos, 1)
    whole = Extent(of, town()).areas(egos)
    held = whole.hold(frame, boxes, np.zeros(len(frame)))
    for i in range(len(egos)):
        one = EgoPoses(
            *(column[i : i + 1] for column in (egos.x, egos.y, egos.heading, egos.ground))
        )
        areas = Extent(of, town()).areas(one)
        mine = frame == i
        alone = areas.hold(np.zeros(mine.sum(), int), boxes[mine], np.zeros(mine.sum()))

        assert alone.tolist() == held[mine].tolist()
        assert (areas.parts(town())[0] == whole.parts(town())[i]).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("of", [of for of in SHAPES.values() if of.shape != "corridor"])
def test_a_range_stays_when_the_world_is_moved_and_turned(of: RangeSettings, seed: int) -> None:
    rng = np.random.default_rng(seed)
    egos = places(seed)
    frame, boxes = boxes_around(egos, seed)
    held = Extent(of, None).areas(egos).hold(frame, boxes, np.zeros(len(frame)))
    (dx, dy), turn = rng.uniform(-3000, 3000, 2), rng.uniform(-9, 9)

    def moved(x: Any, y: Any) -> tuple[Any, Any]:
        cos, sin = math.cos(turn), math.sin(turn)
        return dx + x * cos - y * sin, dy + x * sin + y * cos

    there = EgoPoses(*moved(egos.x, egos.y), egos.heading + turn, egos.ground)
    boxes[:, 0], boxes[:, 1] = moved(boxes[:, 0], boxes[:, 1])
    boxes[:, 2] += turn

    again = Extent(of, None).areas(there).hold(frame, boxes, np.zeros(len(frame)))

    assert again.tolist() == held.tolist()


@shapes
@pytest.mark.parametrize("far", [1e12, 1e200, 1e308, -1.7e308])
def test_absurd_positions_are_far_from_everything_else(of: RangeSettings, far: float) -> None:
    egos = EgoPoses(*(np.array([value]) for value in (far, 0.0, 1.0, 0.0)))
    with np.errstate(over="ignore", invalid="ignore"):  # as the generator has it
        areas = Extent(of, town()).areas(egos)
        held = areas.hold(np.array([0]), np.array([[0.0, 0, 0, 4, 2]]), np.zeros(1))

        assert not held.any()
        assert not areas.parts(town()).any()


def test_a_corridor_without_a_map_runs_straight_ahead() -> None:
    config = configured(range={"shape": "corridor", "width": 4, "length": 30})
    things = [thing("ego"), thing("ahead", 31), thing("behind", -6), thing("aside", 10, 3.1)]

    assert entities(graph_of(frames(things), None, config)) == ["ego", "ahead"]


# Entities of either sort, and the ego ---------------------------------------------------------------


def entities(graph: GraphBlock, frame: int = 0) -> list[str]:
    of = graph.frames
    moving = of.states.node[of.offsets[frame] : of.offsets[frame + 1]].tolist()
    still = sorted(node for node in present(graph, frame) if node >= 0)
    return [of.entities.ident[node] for node in [*moving, *still]]


@pytest.mark.parametrize(
    ("x", "y", "inside"),
    [
        (52.0, 0.0, True),
        (52.001, 0.0, False),
        (-4.0, 0.0, True),
        (-4.001, 0.0, False),
        (0.0, 26.0, True),
        (0.0, -26.001, False),
        (52.0, 26.0, True),
    ],
)
def test_what_touches_the_edge_of_a_rectangle_is_in(x: float, y: float, inside: bool) -> None:
    config = Config(range=SHAPES["rectangle"])

    graph = graph_of(frames([thing("ego"), thing("c", x, y)]), None, config)

    assert ("c" in entities(graph)) == inside


def test_a_rectangle_turns_with_the_ego() -> None:
    config = Config(range=SHAPES["rectangle"])
    north = [thing("ego", heading=math.pi / 2), thing("ahead", 0, 50), thing("behind", 0, -8)]

    assert entities(graph_of(frames(north), None, config)) == ["ego", "ahead"]


def test_what_moves_and_what_stands_are_told_in_range_as_the_settings_say() -> None:
    of = replace(SHAPES["rectangle"], by="centre", static_by="footprint")
    things = [thing("ego"), thing("moving", 51), thing("still", 51, 5, static=True)]

    assert entities(graph_of(frames(things), None, Config(range=of))) == ["ego", "still"]
    other = replace(of, by="footprint", static_by="centre")
    assert entities(graph_of(frames(things), None, Config(range=other))) == ["ego", "moving"]


def test_the_ego_is_in_its_graph_wherever_its_range_lies() -> None:
    of = RangeSettings(
        shape="polygon", polygon=((20.0, -5.0), (40.0, -5.0), (40.0, 5.0), (20.0, 5.0))
    )
    things = [thing("ego"), thing("near", 6), thing("there", 30)]

    assert entities(graph_of(frames(things), None, Config(range=of))) == ["ego", "there"]


def test_a_corridor_in_a_ring_goes_round_to_its_own_lane_again() -> None:
    around, radius = 100.0, 50 / math.pi
    links = link("predecessor", "road", "ring", "end") + link("successor", "road", "ring", "start")
    ring = a_road(
        "ring",
        arc(around, 1 / radius),
        links=links,
        sections=section(lane(0), lane(-1, before=-1, after=-1)),
    )

    def at(name: str, share: float, size: float = 1.0) -> Thing:
        angle, away = 2 * math.pi * share, radius + 1.75
        x, y = away * math.sin(angle), radius - away * math.cos(angle)
        return thing(name, x, y, heading=angle, length=size, width=size)

    of = RangeSettings(shape="corridor", width=4, length=0.5 * 2 * math.pi * (radius + 1.75))
    things = [at("ego", 0.8), at("ahead", 0.9), at("round", 0.1), at("far", 0.5), at("behind", 0.7)]

    graph = graph_of(frames(things), read_map(a_map(ring), "ring"), Config(range=of))

    assert entities(graph) == ["ego", "ahead", "round"]


# Storeys ----------------------------------------------------------------------------------------

LEVELS = (
    a_road("low", line(200, x=-100, y=0, hdg=0)),
    a_road("high", line(200, x=0, y=-100, hdg=math.pi / 2), elevation=cubic("elevation", 6, s=0)),
    a_road("ramp", line(200, x=-100, y=10, hdg=0), elevation=cubic("elevation", 0, 0.05, s=0)),
)
BRIDGE = a_map(*LEVELS)


def roads(graph: GraphBlock, road_map: RoadMap) -> set[str]:
    parts = [-1 - node for node in present(graph) if node < 0]
    return {road_map.nodes.name[k] for k in parts if road_map.nodes.kind[k] == KIND_CODE["road"]}


@pytest.mark.parametrize(
    ("of", "names", "passed"),
    [
        (RangeSettings(), ["ego", "above", "below", "unknown"], {"low", "high", "ramp"}),
        (RangeSettings(height=(-2.0, 2.0)), ["ego", "unknown"], {"low", "ramp"}),
        (RangeSettings(height=(-2.0, 9.0)), ["ego", "above", "unknown"], {"low", "high", "ramp"}),
        (
            RangeSettings(height=(-2.0, 2.0), grade=0.5),
            ["ego", "below", "unknown"],
            {"low", "high", "ramp"},
        ),
        (
            RangeSettings(height=(-2.0, 2.0), height_of_entities=False),
            ["ego", "above", "below", "unknown"],
            {"low", "ramp"},
        ),
    ],
    ids=["any height", "one storey", "upwards", "by grade", "the map alone"],
)
def test_other_storeys_are_out_of_range(
    of: RangeSettings, names: list[str], passed: set[str]
) -> None:
    road_map = read_map(BRIDGE, "bridge")
    things = [
        thing("ego", -90, -1.75),
        thing("above", -88, 3, z=6.75),
        thing("below", -60, 0, z=-5.25),
        thing("unknown", -80, 3, z=math.nan),
    ]
    of = replace(of, radius=100.0)

    graph = graph_of(frames(things), road_map, Config(range=of))

    assert entities(graph) == names
    assert roads(graph, road_map) == passed


def test_a_light_hangs_over_the_road_of_its_storey() -> None:
    config = Config(range=RangeSettings(50, height=(-2.0, 2.0)))
    lights = [
        thing(f"{z}", 9, 3, z=z, kind="traffic_light", static=static, length=0.4, width=0.4)
        for static in (False, True)
        for z in (5.5 + static / 4, 9.5 + static / 4, -3.5 - static / 4)
    ]
    pole = thing("pole", 9, 3, z=5.5, kind="pole")

    graph = graph_of(frames([thing("ego"), *lights, pole]), None, config)

    assert entities(graph) == ["ego", "5.5", "5.75"]


@pytest.mark.parametrize(
    ("ground", "ramp"), [(0.0, False), (5.0, True), (10.0, False), (2.0, False), (3.0, True)]
)
@pytest.mark.parametrize("at", [2, 0], ids=["last", "first"])
def test_a_lane_is_on_the_storey_when_a_point_of_it_in_reach_is(
    at: int, ground: float, ramp: bool
) -> None:
    others = LEVELS[:2]
    road_map = read_map(a_map(*others[:at], LEVELS[2], *others[at:]), "bridge")
    egos = EgoPoses(*np.array([[0.0], [9.0], [0.0], [ground]]))
    points, of = road_map.waypoints(2.0), RangeSettings(30.0, height=(-1.0, 1.0))
    expected: list[bool] = []
    for i in range(3):
        mine = points.lane == i
        away = np.hypot(points.x[mine], points.y[mine] - 9)
        level = np.abs(points.z[mine] - ground) <= 1
        expected.append(bool((level & ((away <= 30) | (away == away.min()))).any()))

    parts = Extent(of, road_map).areas(egos).parts(road_map)

    assert parts[0, 1:4].tolist() == expected
    assert expected[at] == ramp


# What is kept ------------------------------------------------------------------------------------

STREET = a_map(
    a_road(
        "street",
        line(200, x=-100, y=0, hdg=0),
        sections=section(lane(0), lane(-1), lane(-2, kind="sidewalk")),
    ),
    a_road(
        "path", line(200, x=-100, y=9, hdg=0), sections=section(lane(0), lane(-1, kind="biking"))
    ),
)


def kinds_of(config: Config) -> tuple[set[str], set[str]]:
    """Names of the nodes in a graph with everything, and the relations that it has."""
    road_map = read_map(STREET, "street")
    things = [
        thing("ego", 0, -1.75),
        thing("car", 9, -1.75),
        thing("walker", 5, -5, kind="person", length=0.5, width=0.5),
        thing("house", 0, 30, kind="building", static=True),
    ]
    graph = graph_of(frames(things), road_map, config)
    parts = {road_map.nodes.name[-1 - node] for node in present(graph) if node < 0}
    names = {relation for _, relation, _ in edges(graph, 0, road_map)}
    for lane_of in graph.lanes.lane.tolist():
        assert road_map.nodes.name[-1 - lane_of] in parts
    return {*entities(graph), *parts}, names


def test_everything_is_kept_unless_the_client_says_what() -> None:
    nodes, _ = kinds_of(Config())

    lanes = {"street/0/-1", "street/0/-2", "path/0/-1"}
    assert nodes == {"ego", "car", "walker", "house", "off_road", "street", "path"} | lanes


def test_only_the_kinds_that_are_wanted_are_nodes_but_the_ego_always_is() -> None:
    nodes, names = kinds_of(Config(kinds=("Person", "Lane")))

    assert nodes == {"ego", "walker", "street/0/-1", "street/0/-2", "path/0/-1"}
    assert "isIn" in names


def test_lanes_of_other_types_go_with_their_roads() -> None:
    nodes, _ = kinds_of(Config(lanes=LaneSettings(types=("Driving",))))

    assert nodes == {"ego", "car", "walker", "house", "off_road", "street", "street/0/-1"}


def test_without_road_granularity_nothing_of_the_roads_is_known() -> None:
    config = Config(lanes=LaneSettings(granularity="none"))

    nodes, names = kinds_of(config)
    answers = SceneGraphGenerator(read_map(STREET, "street"), config).answers

    assert nodes == {"ego", "car", "walker", "house"}
    assert "isIn" not in names | set(answers)
    assert {"near", "toLeftOf"} <= set(answers)


def test_relations_that_are_not_wanted_are_neither_computed_nor_answered() -> None:
    config = Config(without=("isIn", "very_near"))

    nodes, names = kinds_of(config)
    answers = SceneGraphGenerator(read_map(STREET, "street"), config).answers

    assert "street/0/-1" in nodes
    assert not {"isIn", "very_near"} & names
    assert "very_near" not in answers
    assert "inDFrontOf" in names


def test_what_the_map_alone_says_stays_known() -> None:
    road_map, config = read_map(SECTIONS, "m"), Config(without=("toLeftOf", "isIn"))

    answers = SceneGraphGenerator(road_map, config).answers
    alone = SceneGraphGenerator(None, config).answers

    assert {"toLeftOf", "isIn", "travelsTo"} <= set(answers)
    assert not {"toLeftOf", "isIn"} & set(alone)
    no_lanes = SceneGraphGenerator(road_map, Config(kinds=("Vehicle", "Road"))).answers
    assert "isIn" in no_lanes
    assert not {"travelsTo", "controlsTrafficOf"} & set(no_lanes)


def test_types_are_what_the_client_says_they_are() -> None:
    block = frames([thing("ego"), thing("odd", 9, kind="unknown"), thing("other", 5)])
    told = replace(block.entities, type_name=("a.car", "Acme.Cart", ""))
    config = Config(types={"acme.CART": TypeMeaning("bicycle", "service", "cart")})

    of = graph_of(replace(block, entities=told), None, config).frames.entities

    assert [KINDS[kind] for kind in of.kind] == ["car", "bicycle", "car"]
    assert (of.special, of.subkind) == (("", "service", ""), ("", "cart", ""))


# Pairs ------------------------------------------------------------------------------------------


def near_ones(things: list[Thing], **settings: Any) -> set[tuple[str, str]]:
    config = configured(proximity={"names": ["visible"], "upper": [25]}, **settings)
    graph = graph_of(frames(things), None, config)
    return {(s, d) for s, r, d in edges(graph) if r == "visible" and s < d}


CROWD = [
    thing("ego"),
    thing("a", 10),
    thing("b", 20, kind="person"),
    thing("c", -20, kind="truck", length=12.0),
]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, {("a", "ego"), ("b", "ego"), ("c", "ego"), ("a", "b")}),
        ({"pairs": PairSettings(0)}, {("a", "ego"), ("b", "ego"), ("c", "ego")}),
        ({"pairs": PairSettings(0, ego_within=15)}, {("a", "ego")}),
        ({"pairs": {"kinds": [["Ego", "Person"]]}}, {("b", "ego")}),
        ({"pairs": {"kinds": [["person", "CAR"]]}}, {("a", "b"), ("b", "ego")}),
        ({"pairs": {"kinds": [["Vehicle", "Vehicle"]]}}, {("a", "ego"), ("c", "ego")}),
        ({"pairs": PairSettings(ego=False, within=12)}, {("a", "b"), ("a", "ego")}),
    ],
    ids=["all", "ego", "ego within", "ego and people", "either order", "super-kinds", "no ego"],
)
def test_pairs_are_those_that_are_listed(
    settings: dict[str, Any], expected: set[tuple[str, str]]
) -> None:
    assert near_ones(CROWD, **settings) == expected


def test_distances_are_between_what_the_settings_say() -> None:
    def bucket(between: str, *things: Thing) -> set[str]:
        config = configured(proximity={"between": between}, direction={"sides": "none"})
        of = edges(graph_of(frames([thing("ego"), *things]), None, config))
        return {r for s, r, d in of if d == "ego" and r in config.proximity.names}

    lorry = thing("lorry", 10.5, 0, kind="truck", length=12.0, z=2.0, height=4.0)
    assert bucket("centres", lorry) == {"near"}
    assert bucket("footprints", lorry) == {"near_coll"}  # 10.5 - 6 - 2
    tall = thing("tall", 2.0, 0, kind="truck", z=3.75, height=7.5)
    assert bucket("centres", tall) == {"near_coll"}  # up by 3
    assert bucket("origins", tall) == {"safety_hazard"}  # both on the ground
    walker = thing("walker", 2.0, 0, kind="person", z=0.93, height=1.86)
    assert bucket("origins", walker) == {"near_coll"}  # its origin is in its middle


# Ties -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degrees", "ahead", "both", "carlasgg"),
    [
        (0, "DF", "DF", "DF"),
        (45, "DF", "DF SF", "DF"),
        (-45, "DF", "DF SF", "DF"),
        (90, "SF", "SF SR", "SF"),
        (-90, "SF", "SF SR", "SR"),
        (135, "SR", "SR DR", "DR"),
        (-135, "SR", "SR DR", "DR"),
        (180, "DR", "DR", "DR"),
        (60, "SF", "SF", "SF"),
        (-120, "SR", "SR", "SR"),
    ],
)
def test_ties_of_directions_belong_where_the_settings_say(
    degrees: float, ahead: str, both: str, carlasgg: str
) -> None:
    short = {"inDFrontOf": "DF", "inSFrontOf": "SF", "atSRearOf": "SR", "atDRearOf": "DR"}
    at = math.radians(degrees)
    things = [thing("ego"), thing("c", 10 * math.cos(at), 10 * math.sin(at))]
    found = {}
    for ties in ("ahead", "both", "carlasgg"):
        of = edges(graph_of(frames(things), None, configured(direction={"ties": ties})))
        found[ties] = {short[r] for s, r, d in of if (s, d) == ("c", "ego") and r in short}

    assert found == {"ahead": {ahead}, "both": set(both.split()), "carlasgg": {carlasgg}}


@pytest.mark.parametrize(
    ("x", "y", "sides"),
    [(9, 0, {"open": "", "closed": "toLeftOf"}), (-9, 0, {"open": "", "closed": "toLeftOf"})]
    + [
        (9, y, dict.fromkeys(("open", "closed"), s))
        for y, s in ((1, "toLeftOf"), (-1, "toRightOf"))
    ],
)
def test_what_is_dead_ahead_is_left_only_where_sides_are_closed(
    x: float, y: float, sides: dict[str, str]
) -> None:
    for name, expected in {**sides, "none": ""}.items():
        config = configured(direction={"sides": name})
        of = edges(graph_of(frames([thing("ego"), thing("c", x, y)]), None, config))

        found = {r for s, r, d in of if (s, d) == ("c", "ego")} & {"toLeftOf", "toRightOf"}
        assert found == ({expected} if expected else set())
        answers = SceneGraphGenerator(None, config).answers
        assert ("toLeftOf" in answers) == (name != "none")


# Sections ---------------------------------------------------------------------------------------

SECTIONS = a_map(
    a_road(
        "one",
        line(60, x=0, y=0, hdg=0),
        sections=section(lane(0), lane(-1, after=-1))
        + section(lane(0), lane(-1, before=-1, after=-1), lane(-2), s=20)
        + section(lane(0), lane(-1, before=-1, after=-1), s=40),
        links=link("successor", "road", "two", "start"),
    ),
    a_road(
        "two",
        line(60, x=60, y=0, hdg=0),
        sections=section(lane(0), lane(-1, before=-1)),
        links=link("predecessor", "road", "one", "end"),
    ),
)


def test_lanes_of_a_number_are_one_node_where_sections_do_not_count() -> None:
    road_map, config = read_map(SECTIONS, "m"), Config(lanes=LaneSettings(sections=False))
    shown = map_of_graphs(road_map, config)
    assert shown is not None
    things = [thing("ego", 19, -1.75), thing("wide", 42, -3.5, width=5.0), thing("c", 70, -1.75)]

    graph, plain = (graph_of(frames(things), road_map, of) for of in (config, Config()))

    def without(name: str) -> str:
        road, slash, number = name.partition("/")
        return f"{road}_{number.rpartition('/')[2]}" if slash else name

    merged = {(without(s), r, without(d)) for s, r, d in edges(plain, 0, road_map)}
    assert edges(graph, 0, shown) == sorted(merged)
    names = {shown.nodes.name[-1 - node] for node in present(graph) if node < 0}
    assert names == {"one", "two", "one_-1", "one_-2", "two_-1"}
    static = {
        (shown.nodes.name[-1 - s], RELATIONS[r], shown.nodes.name[-1 - d])
        for r, s, d in zip(shown.edges.relation, shown.edges.src, shown.edges.dst, strict=True)
    }
    assert ("one_-1", "travelsTo", "two_-1") in static
    assert {d for s, r, d in static if r == "travelsTo"} == {"two_-1"}
    assert shown.digest != road_map.digest


def test_of_sections_that_are_one_lane_the_shares_add_up_and_one_is_primary() -> None:
    road_map, config = read_map(SECTIONS, "m"), Config(lanes=LaneSettings(sections=False))
    things = [thing("ego", 20.5, -1.75), thing("c", 40, -3.5)]

    lanes = graph_of(frames(things), road_map, config).lanes
    plain = graph_of(frames(things), road_map).lanes

    ego = lanes.node == 0
    assert lanes.overlap[ego].tolist() == pytest.approx([1.0])
    assert lanes.primary[ego].tolist() == [True]
    assert len(lanes) == 3 < len(plain)
    assert lanes.overlap.sum() == pytest.approx(plain.overlap.sum())
    assert [int(lanes.primary[lanes.node == node].sum()) for node in (0, 1)] == [1, 1]
