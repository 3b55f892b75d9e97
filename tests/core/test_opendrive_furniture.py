"""Signals, crosswalks and objects: what they are, where they stand, which lanes they apply to."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from opendrive_maps import a_map, a_road, arc, cubic, element, lane, line, section

from sgstore.maps.opendrive import kind_of_object, read_map
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

LANES = section(
    lane(2, kind="sidewalk"), lane(1), lane(0), lane(-1), lane(-2), lane(-3, kind="shoulder")
)


def signal(ident: str, /, *inner: str, **values: Any) -> str:
    standard = {"s": 10, "t": -9, "type": "206", "orientation": "+", "dynamic": "no", "zOffset": 2}
    return element("signal", *inner, id=ident, **(standard | values))


def valid(first: int, last: int) -> str:
    return element("validity", fromLane=first, toLane=last)


def thing(ident: str, /, *inner: str, **values: Any) -> str:
    return element("object", *inner, id=ident, **({"s": 10, "t": 5, "zOffset": 0} | values))


def road_with(signals: str = "", objects: str = "", **road: Any) -> str:
    plan = road.pop("plan", line(40.0))
    return a_road("1", plan, sections=LANES, signals=signals, objects=objects, **road)


def lanes_of(road_map: RoadMap, name: str) -> set[str]:
    return {road_map.nodes.name[-1 - node] for node in road_map.lanes_of_signal(name)}


def row_of(road_map: RoadMap, name: str) -> int:
    return road_map.nodes.name.index(name)


@pytest.mark.parametrize(
    ("orientation", "lanes"),
    [
        ("+", {"1/0/-1", "1/0/-2"}),
        ("-", {"1/0/1"}),
        ("none", {"1/0/1", "1/0/-1", "1/0/-2"}),
    ],
)
def test_a_signal_applies_to_the_driving_lanes_in_its_direction(
    orientation: str, lanes: set[str]
) -> None:
    road_map = read_map(a_map(road_with(signal("s", orientation=orientation))), "map")

    assert lanes_of(road_map, "s") == lanes


def test_a_validity_says_which_lanes_a_signal_applies_to() -> None:
    signals = (
        signal("one", valid(-2, -2)) + signal("two", valid(-1, 1)) + signal("none", valid(0, 0))
    )
    road_map = read_map(a_map(road_with(signals)), "map")

    assert lanes_of(road_map, "one") == {"1/0/-2"}
    assert lanes_of(road_map, "two") == {"1/0/-1", "1/0/1"}
    assert lanes_of(road_map, "none") == set()
    assert lanes_of(road_map, "no such signal") == set()


def test_a_reference_makes_a_signal_apply_to_lanes_of_another_road() -> None:
    other = a_road(
        "2",
        line(40.0, y=30.0),
        sections=LANES,
        signals=element("signalReference", valid(-1, -1), id="s", s=5, t=0, orientation="+"),
    )
    road_map = read_map(a_map(road_with(signal("s", valid(0, 0))), other), "map")

    assert lanes_of(road_map, "s") == {"2/0/-1"}


def test_a_signal_applies_in_the_section_that_it_stands_in() -> None:
    sections = section(lane(0), lane(-1)) + section(lane(0), lane(-1), lane(-2), s=20)
    signals = signal("before", s=19.9) + signal("after", s=20)
    road_map = read_map(a_map(a_road("1", line(40.0), sections=sections, signals=signals)), "map")

    assert lanes_of(road_map, "before") == {"1/0/-1"}
    assert lanes_of(road_map, "after") == {"1/1/-1", "1/1/-2"}


def test_a_signal_stands_where_the_file_says() -> None:
    road = road_with(
        signal("s", t=-3, hOffset=0.5),
        plan=arc(40.0, 0.1, x=1, y=2),
        elevation=cubic("elevation", 5.0, 0.1, s=0),
    )
    road_map = read_map(a_map(road), "map")
    row, nodes = row_of(road_map, "s"), road_map.nodes

    # The circle's centre is (1, 12); at s = 10 the road has turned by one radian.
    assert nodes.x[row] == pytest.approx(1 + 13 * np.sin(1.0))
    assert nodes.y[row] == pytest.approx(12 - 13 * np.cos(1.0))
    assert nodes.z[row] == pytest.approx(5 + 1 + 2)
    assert nodes.heading[row] == pytest.approx(1.5)
    assert road_map.outlines()[row].distance(road_map.outlines()[row].centroid) == 0


@pytest.mark.parametrize(
    ("code", "dynamic", "name", "kind"),
    [
        ("1000001", True, "", "traffic_light"),
        ("1000002", True, "", "traffic_light"),
        ("1000013", True, "", "traffic_light"),
        ("1000003", False, "zebra", "sign"),
        ("206", False, "", "stop_sign"),
        ("R1-1", False, "", "stop_sign"),
        ("205", False, "", "yield_sign"),
        ("274", False, "", "speed_limit"),
        ("306", False, "", "sign"),
        ("-1", True, "TrafficLight_3", "traffic_light"),
        ("-1", False, "Streetlight", "sign"),
    ],
)
def test_the_kind_of_a_signal_is_told_by_its_code(
    code: str, dynamic: bool, name: str, kind: str
) -> None:
    told = signal("s", type=code, dynamic="yes" if dynamic else "no", name=name)
    road_map = read_map(a_map(road_with(told)), "map")

    assert KINDS[road_map.nodes.kind[row_of(road_map, "s")]] == kind


@pytest.mark.parametrize(
    ("values", "speed"),
    [
        ({"value": 50}, 50 / 3.6),
        ({"value": 50, "unit": "km/h"}, 50 / 3.6),
        ({"value": 30, "unit": "mph"}, 30 * 0.44704),
        ({"value": 30, "type": "R2-1"}, 30 * 0.44704),
        ({"value": 13, "unit": "m/s"}, 13.0),
        ({"value": "fast"}, np.nan),
    ],
)
def test_the_speed_on_a_sign_is_known_in_metres_per_second(
    values: dict[str, Any], speed: float
) -> None:
    road_map = read_map(a_map(road_with(signal("s", **({"type": "274"} | values)))), "map")

    assert road_map.nodes.speed_limit[row_of(road_map, "s")] == pytest.approx(speed, nan_ok=True)


def test_the_speed_of_a_lane_is_its_own_else_that_of_its_road() -> None:
    own = element("speed", sOffset=0, max=10, unit="m/s")
    lanes = section(lane(0), lane(-1, own), lane(-2))
    kinds = element("type", element("speed", max=50, unit="km/h"), s=0, type="town")
    kinds += element("type", element("speed", max="no limit"), s=30, type="motorway")
    road_map = read_map(a_map(a_road("1", line(40.0), sections=lanes, type=kinds)), "map")

    assert road_map.nodes.speed_limit[1:3].tolist() == pytest.approx([10.0, 50 / 3.6])
    assert road_map.road_types == {"1": ((0.0, "town"), (30.0, "motorway"))}


def test_speed_limits_that_are_objects_are_signals_for_the_lanes_of_their_side() -> None:
    objects = thing("o1", name="Speed_30", orientation="-") + thing(
        "o2", name="Stencil_STOP", orientation="+"
    )
    road_map = read_map(a_map(road_with(objects=objects)), "map")
    nodes = road_map.nodes

    assert KINDS[nodes.kind[row_of(road_map, "o1")]] == "speed_limit"
    assert nodes.speed_limit[row_of(road_map, "o1")] == pytest.approx(30 / 3.6)
    assert KINDS[nodes.kind[row_of(road_map, "o2")]] == "stop_sign"
    assert lanes_of(road_map, "o1") == {"1/0/-1", "1/0/-2"}
    assert lanes_of(road_map, "o2") == {"1/0/1"}


def test_controllers_say_which_signals_switch_together() -> None:
    controls = [element("control", signalId=name, type="0") for name in ("a", "b", "a")]
    controller = element("controller", *controls, id="c")

    assert read_map(a_map(road_with(), controller), "map").controllers == {"c": ("a", "b")}


def corners(tag: str, *points: tuple[float, float]) -> str:
    first, second = ("u", "v") if tag == "cornerLocal" else ("s", "t")
    return "".join(element(tag, **{first: a, second: b}) for a, b in points)


SQUARE = ((-1.0, -2.0), (1.0, -2.0), (1.0, 2.0), (-1.0, 2.0))


def test_an_outline_stands_in_the_axes_of_its_object() -> None:
    wedge = ((0, 0), (3, 0), (3, 1))
    outline = element("outlines", element("outline", corners("cornerLocal", *wedge)))
    road_map = read_map(
        a_map(road_with(objects=thing("o", outline, hdg=pi / 2, type="building"))), "map"
    )

    shape = road_map.outlines()[row_of(road_map, "o")]

    assert shape.equals_exact(shapely.Polygon([(10, 5), (10, 8), (9, 8)]), 1e-9)
    assert KINDS[road_map.nodes.kind[row_of(road_map, "o")]] == "building"


def test_an_outline_may_follow_the_road() -> None:
    outline = element("outline", corners("cornerRoad", (5, 1), (5, 3), (9, 3), (9, 1)))
    road = road_with(objects=thing("o", outline), plan=line(40.0, x=100, y=50, hdg=pi / 2))

    road_map = read_map(a_map(road), "map")

    assert road_map.outlines()[row_of(road_map, "o")].bounds == pytest.approx((97, 55, 99, 59))


@pytest.mark.parametrize(
    ("values", "shape", "area"),
    [
        ({"length": 4, "width": 2}, "Polygon", 8.0),
        ({"radius": 1}, "Polygon", pi),
        ({}, "Point", 0.0),
        ({"length": 4}, "Point", 0.0),
    ],
)
def test_an_object_without_outline_has_the_shape_of_its_size(
    values: dict[str, float], shape: str, area: float
) -> None:
    road_map = read_map(a_map(road_with(objects=thing("o", **values))), "map")

    outline = road_map.outlines()[row_of(road_map, "o")]

    assert outline.geom_type == shape
    assert outline.area == pytest.approx(area, rel=0.03)


def repeat(**values: Any) -> str:
    standard = {
        "s": 0,
        "length": 20,
        "distance": 5,
        "tStart": 4,
        "tEnd": 6,
        "zOffsetStart": 0,
        "zOffsetEnd": 1,
    }
    return element("repeat", **(standard | values))


def test_an_object_is_repeated_at_distances() -> None:
    road_map = read_map(
        a_map(road_with(objects=thing("p", repeat(), type="pole", radius=0.1))), "map"
    )
    nodes = road_map.nodes
    rows = [row_of(road_map, f"p#{i}") for i in range(5)]

    assert nodes.x[rows].tolist() == pytest.approx([0, 5, 10, 15, 20])
    assert nodes.y[rows].tolist() == pytest.approx([4, 4.5, 5, 5.5, 6])
    assert nodes.z[rows].tolist() == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert "p" not in nodes.name
    assert "p#5" not in nodes.name


def test_an_object_that_is_repeated_without_distance_is_a_strip_along_the_road() -> None:
    wall = thing("w", repeat(distance=0, widthStart=1, widthEnd=1, tEnd=4), type="barrier")
    wire = thing("x", repeat(distance=0, s=3), type="railing")
    road_map = read_map(a_map(road_with(objects=wall + wire, plan=arc(40.0, -0.05))), "map")
    outlines = road_map.outlines()

    assert outlines[row_of(road_map, "w")].area == pytest.approx(20 * (20 + 4) / 20, rel=1e-3)
    assert outlines[row_of(road_map, "x")].geom_type == "LineString"
    assert road_map.nodes.length[row_of(road_map, "w")] == 20


def test_what_is_repeated_without_end_is_left_out_and_said() -> None:
    objects = thing("p", repeat(distance=1e-9, length=20)) + thing("q")

    road_map = read_map(a_map(road_with(objects=objects)), "map")

    assert [w for w in road_map.warnings if "'p'" in w]
    assert "q" in road_map.nodes.name


@pytest.mark.parametrize(
    ("type_name", "name", "kind"),
    [
        ("tree", "", "vegetation"),
        ("soundBarrier", "", "barrier"),
        ("streetLamp", "", "pole"),
        ("crosswalk", "", "crosswalk"),
        ("-1", "SimpleCrosswalk", "crosswalk"),
        ("-1", "SignPost_10ft", "pole"),
        ("rail-pole", "x", "pole"),
        ("railing", "x", "barrier"),
        ("guide-post", "x", "pole"),
        ("parkingSpace", "", "parking"),
        ("parkingSpace", "beside the tree", "parking"),
        ("-1", "ParkingSpace_12", "parking"),
        ("-1", "StopLine", "paint"),
        ("-1", "Stencil_ArrowType4R", "paint"),
        ("-1", "SolidSingleWhite", "paint"),
        ("roadMark", "stop line of Main Street", "paint"),
        ("none", "Main Street", "prop"),
        ("none", "Postal box", "prop"),
        ("none", "Trailer park", "prop"),
        ("none", "Greenhouse", "prop"),
        ("none", "Main Street trees", "vegetation"),
        ("none", "TREE_07", "vegetation"),
        ("none", "Row of bushes", "vegetation"),
        ("none", "garden fences", "barrier"),
        ("none", "treehouse", "prop"),
        ("-1", "StopSign", "prop"),
        ("obstacle", "tree", "prop"),
        ("Tree", "", "vegetation"),
        ("car", "", "car"),
        ("none", "Mystery", "prop"),
    ],
)
def test_the_kind_of_an_object_is_told_by_its_type_else_its_name(
    type_name: str, name: str, kind: str
) -> None:
    assert kind_of_object(type_name, name) == kind


def test_footprints_touch_crosswalks_on_their_storey() -> None:
    outline = element("outline", corners("cornerLocal", *SQUARE))
    objects = thing("z", outline, type="crosswalk", t=0)
    road_map = read_map(a_map(road_with(objects=objects)), "map")
    boxes = np.array(
        [
            (10, 0, 0, 0.5, 0.5),  # on it
            (8.0, 0, 0, 2.2, 0.5),  # its front just over it
            (8.0, 0, pi / 2, 2.2, 0.5),  # turned away
            (10, 0, 0, 0.5, 0.5),  # above it
            (10, 0, 0, np.nan, np.nan),  # a point on it
            (np.nan, 0, 0, 1, 1),  # nowhere
        ]
    )

    rows, nodes = road_map.crosswalks_of(boxes, np.array([0, 0, 0, 5.0, np.nan, 0]))

    assert rows.tolist() == [0, 1, 4]
    assert {road_map.nodes.name[-1 - n] for n in nodes} == {"z"}


def test_a_light_for_pedestrians_controls_no_lane_even_if_its_validity_names_lanes() -> None:
    validity = element("validity", fromLane=-1, toLane=1)
    lights = [
        element("signal", validity, id=name, s=5, t=0, type=code, dynamic="yes", orientation="+")
        for name, code in (("car", "1000001"), ("walk", "1000002"))
    ]
    road_map = read_map(a_map(road_with("".join(lights))), "map")

    assert {"car", "walk"} <= set(road_map.nodes.name)
    assert len(road_map.lanes_of_signal("car")) > 0
    assert len(road_map.lanes_of_signal("walk")) == 0


def test_nodes_come_in_their_order_and_their_ids_run_down_from_minus_one() -> None:
    outline = element("outline", corners("cornerLocal", *SQUARE))
    objects = thing("tree", type="tree") + thing("zebra", outline, type="crosswalk")
    text = a_map(road_with(signal("light", type="1000001"), objects), '<junction id="9"/>')

    kinds = [KINDS[code] for code in read_map(text, "map").nodes.kind]

    assert list(dict.fromkeys(kinds)) == [
        "off_road", "lane", "road", "junction", "crosswalk", "traffic_light", "vegetation"
    ]  # fmt: skip


def test_a_parking_space_is_a_lane_lengthwise() -> None:
    space = thing("p", type="parkingSpace", length=5, width=2.5, t=8, hdg=pi / 2)
    road_map = read_map(a_map(road_with(objects=space)), "map")
    nodes, row = road_map.nodes, row_of(road_map, "p")

    assert KINDS[nodes.kind[row]] == "lane"
    assert (nodes.lane_type[row], nodes.road[row]) == ("parking", "1")
    assert (nodes.length[row], nodes.width[row]) == (pytest.approx(5), pytest.approx(2.5))
    assert (nodes.x[row], nodes.y[row]) == (pytest.approx(10), pytest.approx(8))
    assert nodes.heading[row] == pytest.approx(pi / 2)
    assert road_map.outlines()[row].area == pytest.approx(12.5)
    parked = np.array([(10.1, 8.2, pi / 2, 4.0, 1.8)])
    hits = road_map.lanes_of(parked, np.zeros(1))
    share = dict(zip((-1 - hits.lane).tolist(), hits.overlap.tolist(), strict=True))
    assert share[row] == pytest.approx(1.0)
    assert (-1 - row) in road_map.near(np.array([10.0]), np.array([8.0]), 1.0)[1]
    assert "1" in {
        nodes.name[-1 - n] for n in road_map.near(np.array([10.0]), np.array([11.0]), 1.0)[1]
    }


def test_parking_spaces_are_as_many_as_are_repeated_and_each_has_its_own_outline() -> None:
    corner = ((3.5, 0.0), (-1.8, 5.3), (-3.5, 3.5), (0.0, 0.0))
    outline = element("outlines", element("outline", corners("cornerLocal", *corner)))
    slanted = thing("s", outline, repeat(distance=4, tStart=5, tEnd=5), type="parkingSpace")

    road_map = read_map(a_map(road_with(objects=slanted)), "map")

    nodes = road_map.nodes
    rows = [row for row in range(len(nodes)) if nodes.lane_type[row] == "parking"]
    assert [nodes.name[row] for row in rows] == [f"s#{i}" for i in range(6)]
    shape = shapely.Polygon(corner)
    for i, row in enumerate(rows):
        there = shapely.transform(shape, lambda p, i=i: np.add(p, (4.0 * i, 5.0)))
        assert road_map.outlines()[row].symmetric_difference(there).area < 1e-9
    assert nodes.length[rows[0]] > nodes.width[rows[0]] > 2


def test_a_parking_space_of_odd_shape_is_the_rectangle_around_it_and_one_without_area_is_said() -> (
    None
):
    corner = ((0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (3.0, 2.5), (0.0, 2.0))
    odd = thing("odd", element("outline", corners("cornerLocal", *corner)), type="parkingSpace")
    flat = thing("flat", type="parkingSpace")

    road_map = read_map(a_map(road_with(objects=odd + flat)), "map")

    assert road_map.outlines()[row_of(road_map, "odd")].area == pytest.approx(15.0)
    assert "flat" not in road_map.nodes.name
    assert [w for w in road_map.warnings if "'flat'" in w and "no extent" in w]


def test_what_is_painted_on_the_road_makes_no_node() -> None:
    line = element("outline", corners("cornerLocal", *SQUARE))
    objects = thing("line", line, type="roadMark", name="stop line of Main Street") + thing("tree")

    road_map = read_map(a_map(road_with(objects=objects)), "map")

    assert "line" not in road_map.nodes.name
    assert "tree" in road_map.nodes.name
    assert road_map.warnings == ()


@pytest.mark.data
def test_real_maps_have_what_their_files_count(data: Path) -> None:
    counts = {
        "Town01": {"traffic_light": 36, "speed_limit": 22, "junction": 12},
        "Town07": {"traffic_light": 17, "stop_sign": 19, "yield_sign": 20, "crosswalk": 7},
        "fabriksgatan_traffic_lights": {"traffic_light": 3, "pole": 2},
        "parking_demo": {"crosswalk": 3, "vegetation": 12, "prop": 0},
    }
    for name, expected in counts.items():
        text = (data / f"maps/{name}.xodr").read_text(encoding="utf-8")
        road_map = read_map(text, name)
        kinds = [KINDS[code] for code in road_map.nodes.kind]
        assert {kind: kinds.count(kind) for kind in expected} == expected
        # Three lane links of Town07 contradict others.
        assert len(road_map.warnings) == (3 if name == "Town07" else 0)
