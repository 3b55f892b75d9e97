"""Lanelet2 maps: lanelets as lanes, and what applies to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from lanelet2_maps import LaneletMap, two_lanes
from oracle_lanelet2 import EXAMPLE, ORIGIN, as_told, differences, golden

from sgstore.errors import MapError
from sgstore.maps.lanelet2 import Projection, lanelet2_text, read_projector_info
from sgstore.maps.map_files import Maps, read_map_file
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import KINDS, RELATIONS

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap


def a_map(made: LaneletMap, projection: Projection | None = None) -> RoadMap:
    return read_map(lanelet2_text(made.text(), projection), "test.osm")


def edges(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    names, table = road_map.nodes.name, road_map.edges
    rows = np.flatnonzero(table.relation == RELATIONS.index(relation)).tolist()
    return {(names[-1 - table.src[row]], names[-1 - table.dst[row]]) for row in rows}


def row_of(road_map: RoadMap, name: str, kind: str) -> int:
    kinds = [KINDS[code] for code in road_map.nodes.kind.tolist()]
    return [*zip(road_map.nodes.name, kinds, strict=True)].index((name, kind))


def test_lanelets_are_lanes_that_follow_and_lie_beside_one_another() -> None:
    made, named = two_lanes()

    road_map = a_map(made)

    left, right, back, onward = (named[name] for name in ("left", "right", "back", "onward"))
    assert edges(road_map, "travelsTo") == {(left, onward)}
    assert edges(road_map, "toLeftOf") == {(left, right)}
    assert edges(road_map, "toRightOf") == {(right, left), (right, back), (back, right)}
    assert edges(road_map, "opposes") == {(right, back), (back, right)}
    assert edges(road_map, "laneChange") == {(left, right)}
    assert road_map.warnings == ()


def test_a_lane_has_the_outline_and_the_speed_limit_of_its_lanelet() -> None:
    made, named = two_lanes()

    road_map = a_map(made)

    nodes, row = road_map.nodes, row_of(road_map, named["back"], "lane")
    assert road_map.outlines()[row].bounds == (0.0, -3.5, 100.0, 0.0)
    assert abs(nodes.heading[row]) == pytest.approx(np.pi)
    assert nodes.speed_limit[row] == pytest.approx(30 * 0.44704)
    signed = row_of(road_map, named["right"], "lane")
    assert nodes.speed_limit[signed] == pytest.approx(60 / 3.6)


def test_crosswalks_lights_signs_and_stop_lines_are_parts_of_the_map() -> None:
    made, named = two_lanes()

    road_map = a_map(made)

    crossing = row_of(road_map, named["crossing"], "crosswalk")
    assert road_map.outlines()[crossing].bounds == (101.0, -5.0, 104.0, 8.0)
    light = row_of(road_map, named["light"], "traffic_light")
    assert (road_map.nodes.x[light], road_map.nodes.z[light]) == (104.25, 5.0)
    sign = row_of(road_map, named["sign"], "speed_limit")
    assert road_map.nodes.speed_limit[sign] == pytest.approx(60 / 3.6)
    assert edges(road_map, "controlsTrafficOf") == {
        (named["light"], named["left"]),
        (named["sign"], named["right"]),
        (named["stop"], named["left"]),
    }
    lane = -1 - row_of(road_map, named["left"], "lane")
    places = [place[1:] for place in road_map.places.rows() if place[2] == lane]
    assert ("stop_line", lane, 99.0, 99.0) in places
    assert ("traffic_light", lane, 99.0, 99.0) in places


def test_areas_stand_beside_the_lanes_or_are_counted() -> None:
    made, _ = two_lanes()
    half = made.way([(10, 20), (14, 20), (14, 22)])
    rest = made.way([(10, 20), (10, 22), (14, 22)])  # the other way round
    open_way = made.way([(20, 20), (24, 20), (24, 22)])
    area = {"type": "multipolygon"}
    house = made.relation(
        [("way", half, "outer"), ("way", rest, "outer")], {**area, "subtype": "building"}
    )
    made.relation([("way", open_way, "outer")], {**area, "subtype": "vegetation"})
    made.relation([("way", half, "outer")], {**area, "subtype": "parking"})
    road_map = a_map(made)

    at = row_of(road_map, str(house), "building")
    nodes = road_map.nodes
    assert (nodes.x[at], nodes.y[at]) == (12, 21)
    assert (nodes.length[at], nodes.width[at]) == (4, 2)
    assert abs(np.sin(nodes.heading[at])) < 1e-9
    assert road_map.outlines()[at].area == 8
    assert any("areas left out: 1 parking" in text for text in road_map.warnings)
    assert any("an outer border that closes" in text for text in road_map.warnings)


def test_lanelets_that_cross_or_part_lie_in_a_junction_unless_one_is_a_bridge() -> None:
    def crossing(height: float) -> RoadMap:
        made = LaneletMap()
        for y in (0, 40):  # only the first is crossed
            ways = [made.way([(-30, y + d), (30, y + d)]) for d in (2, -2)]
            made.lanelet(ways[0], ways[1], one_way="yes")
        ways = [made.way([(d, -30), (d, 25)], height) for d in (-2, 2)]
        made.lanelet(ways[0], ways[1], one_way="yes")
        return a_map(made)

    level, over = crossing(0.0), crossing(6.0)

    crossed, _, crosses = level.nodes.name[1:4]
    assert edges(level, "conflictsWith") == {(crossed, crosses), (crosses, crossed)}
    assert sum(KINDS[code] == "junction" for code in level.nodes.kind.tolist()) == 1
    assert edges(over, "conflictsWith") == set()
    assert not any(over.nodes.junction)


def test_who_may_use_a_lanelet_and_how_it_is_tagged_decide_the_type_of_its_lane() -> None:
    made = LaneletMap()

    def lanelet(subtype: str, **tags: str) -> str:
        y = 10.0 * made.last
        left, right = (made.way([(0, y + d), (9, y + d)]) for d in (3, 0))
        return made.lanelet(left, right, subtype, **tags)

    told = {
        lanelet("road"): "driving",
        lanelet("road", **{"participant:bicycle": "yes"}): "biking",
        lanelet("road", **{"participant:vehicle:bus": "yes"}): "driving",
        lanelet("walkway"): "sidewalk",
        lanelet("bus_lane"): "bus",
        lanelet("moat"): "none",
    }
    road_map = a_map(made)

    rows = {name: row_of(road_map, name, "lane") for name in told}
    assert {name: road_map.nodes.lane_type[row] for name, row in rows.items()} == told


def test_what_cannot_be_used_is_named_and_a_map_without_lanelets_refused() -> None:
    made, named = two_lanes()
    made.lanelet(999_999, 888_888)
    made.way([(float("nan"), 0), (1, 1)])

    road_map = a_map(made)

    assert named["left"] in road_map.nodes.name
    assert sum("left out" in warning for warning in road_map.warnings) == 2
    for text, reason in (
        ("<osm/>", "without usable lanelets"),
        ("<osm><node id='1'", "not XML"),
        ("<gpx/>", "expected <osm>"),
        ("<!DOCTYPE osm [<!ENTITY a 'b'>]><osm/>", "document type declaration"),
    ):
        with pytest.raises(MapError, match=reason):
            lanelet2_text(text)


def test_many_lanelets_in_one_place_are_no_neighbours_of_one_another() -> None:
    made = LaneletMap()
    left, right = (made.way([(0, y), (9, y)]) for y in (3, 0))
    for _ in range(101):
        made.lanelet(left, right)

    road_map = a_map(made)

    assert edges(road_map, "toLeftOf") == edges(road_map, "travelsTo") == set()
    for what in ("it bounds more than 100 lanelets", "more than 100 lanelets meet between nodes"):
        assert any(what in warning for warning in road_map.warnings)


# Places on Earth -------------------------------------------------------------------------------------

# Figures from PROJ 9.5, with which UTM in five zones and the tangent plane agree to 10 nm.


@pytest.mark.parametrize(
    ("projection", "corner"),
    [
        pytest.param(Projection("LocalCartesianUTM", (49.0, 8.4)), (0.0, 0.0), id="from an origin"),
        pytest.param(
            Projection("TransverseMercator", (49.0, 8.4), scale=1.0), (0, 0), id="own meridian"
        ),
        pytest.param(Projection("LocalCartesian", (49.0, 8.4)), (0.0, 0.0), id="tangent plane"),
    ],
)
def test_projections_agree_with_the_lengths_of_arcs_on_the_ellipsoid(
    projection: Projection, corner: tuple[float, float]
) -> None:
    # A degree of the meridian at 49° is 111,219 m long, one of the parallel 73,174 m (WGS 84).
    step = 0.01
    places = projection.project(
        np.array([49.0, 49.0 + step, 49.0]), np.array([8.4, 8.4, 8.4 + step]), np.zeros(3)
    )

    north, east = (np.hypot(*(places[row] - places[0])[:2]) for row in (1, 2))
    assert places[0, :2] == pytest.approx(corner, abs=1e-6)
    assert north == pytest.approx(1112.2, rel=6e-4)
    assert east == pytest.approx(731.7, rel=6e-4)


def test_the_square_of_a_grid_is_the_place_from_which_mgrs_counts() -> None:
    whole = Projection("UTM").project(np.array([35.68]), np.array([139.69]), np.zeros(1))
    named = Projection("MGRS", grid="54SUE").project(
        np.array([35.68]), np.array([139.69]), np.zeros(1)
    )
    plain = Projection("MGRS").project(np.array([35.68]), np.array([139.69]), np.zeros(1))

    assert np.round(whole[0, :2]).tolist() == pytest.approx([381_454, 3_949_247], abs=1)
    assert named[0, :2] == pytest.approx(whole[0, :2] % 100_000)
    assert plain[0, :2] == pytest.approx(named[0, :2])


def test_the_projector_info_beside_a_map_says_how_it_is_projected(tmp_path: Path) -> None:
    made = LaneletMap(degrees=True)
    left, right = (made.way([(8.4, lat), (8.401, lat)]) for lat in (49.00003, 49.0))
    ident = made.lanelet(left, right, one_way="yes")
    file = tmp_path / "lanelet2_map.osm"
    file.write_text(made.text(), encoding="utf-8")

    far = read_map_file(file)
    info = "projector_type: LocalCartesianUTM\nmap_origin:\n  latitude: 49.0\n  longitude: 8.4\n"
    (tmp_path / "map_projector_info.yaml").write_text(info, encoding="utf-8")
    near = Maps(tmp_path)._given

    row = row_of(far, ident, "lane")
    assert far.nodes.x[row] > 450_000
    assert near is not None
    assert near.nodes.x[row] == pytest.approx(36.6, abs=0.1)
    assert near.nodes.length[row] == pytest.approx(far.nodes.length[row], abs=1e-3)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("vertical_datum: WGS84", "no projector_type"),
        ("projector_type: Mercator", "known: UTM"),
        ("projector_type: LocalCartesian", "without an origin"),
        ("projector_type: MGRS\nmgrs_grid: 5400", "expected a zone and a square"),
        ("projector_type: UTM\nmap_origin:\n latitude: x\n longitude: 1", "not a number"),
    ],
)
def test_a_projector_info_that_tells_no_projection_is_refused(text: str, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        read_projector_info(text)


@pytest.mark.data
def test_the_example_map_is_what_the_package_lanelet2_makes_of_it(data: Path) -> None:
    text = lanelet2_text(
        (data / EXAMPLE).read_text(encoding="utf-8"), Projection("LocalCartesianUTM", ORIGIN)
    )

    assert differences(as_told(read_map(text, "example")), golden()) == []
