"""What a picture is made of: views, links, places of labels, sides of lanes, colours."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from drawing import Crossing, crowd, entity, graph_of, related
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.draw._drawn_links import ego_lane, links_of, seen_from_ego, sentences
from sgstore.draw._ground import GroundView, rings_of
from sgstore.draw._page import MOST_CHANGE, greatest_change, quantized
from sgstore.draw._placement import Placer
from sgstore.draw._view import MapWindow, bodies_of, clean, number, outline, view_of
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import ENTITY_KINDS, LIGHT_STATES, PROXIMITY, SIGNALS

if TYPE_CHECKING:
    from pathlib import Path

NUMBERS = st.floats(-1000, 1000)


@given(NUMBERS, NUMBERS, NUMBERS, st.floats(-7, 7))
def test_a_place_in_a_view_is_a_turn_of_the_complex_plane(
    x: float, y: float, eye: float, up: float
) -> None:
    turned = (complex(x, y) - complex(eye, -eye)) * cmath.exp(1j * (math.pi / 2 - up))
    ((right, ahead),) = MapWindow(eye, -eye, up, 50.0).place(np.array([(x, y)])).tolist()

    assert complex(right, ahead) == pytest.approx(turned, abs=1e-9)


def test_a_view_shows_the_entities_but_is_neither_tiny_nor_vast() -> None:
    ego = entity("car", 0.0, 0.0, is_ego=True)

    reaches = [
        view_of(graph_of({0: ego, 1: entity("car", x, 0.0)}), None).radius for x in (3, 40, 500)
    ]
    assert reaches == [30.0, 44.0, 60.0]


def test_a_view_reaches_out_for_what_was_matched() -> None:
    graph = graph_of({0: entity("car", 0, 0, is_ego=True), 1: entity("car", 90.0, 0.0)})

    assert view_of(graph, None, [1]).radius == pytest.approx(99.0)


@pytest.mark.parametrize("kind", [int, float, np.float32, np.float64, np.int64])
def test_numbers_may_be_of_any_make(kind: Any) -> None:
    assert number({"x": kind(3)}, "x") == 3.0


@pytest.mark.parametrize("value", [None, "3", math.nan, math.inf, [3.0]])
def test_what_is_no_number_is_missing(value: object) -> None:
    assert math.isnan(number({"x": value}, "x"))


def test_a_box_is_as_shapely_makes_it() -> None:
    car = entity("car", 3.0, -2.0, 30.0)
    (body,), _ = bodies_of(graph_of({1: car}), MapWindow(0.0, 0.0, math.pi / 2, 50.0))
    box = shapely.box(-2.3, -0.95, 2.3, 0.95)
    expected = shapely.affinity.translate(shapely.affinity.rotate(box, 30, (0, 0)), 3, -2)

    assert shapely.Polygon(outline(body, 0.1)).symmetric_difference(expected).area < 1e-9


def test_links_of_the_ego_are_its_pairs_with_a_proximity() -> None:
    graph = crowd(Crossing())
    near = {
        frozenset((src, dst))
        for src, relation, dst, _ in graph.edges
        if relation in PROXIMITY and 0 in (src, dst)
    }
    links = [k for k in links_of(graph, frozenset(), "ego") if k.family == "ego"]

    assert {frozenset((k.a, k.b)) for k in links} == near
    assert len(links) == len(near)


def test_every_edge_is_in_one_link_when_all_are_drawn() -> None:
    graph = crowd(Crossing())
    links = links_of(graph, frozenset((3, 4)), "all")
    told = {(k.b, r, k.a) for k in links for r in k.there}
    told |= {(k.a, r, k.b) for k in links for r in k.back}
    edges = {(src, relation, dst) for src, relation, dst, _ in graph.edges}
    both_ways = {(s, r, d) for s, r, d in edges if (d, r, s) in edges}

    assert told <= edges
    assert edges - told <= both_ways
    assert len({frozenset((k.a, k.b)) for k in links}) == len(links)


def test_a_graph_without_proximity_shows_the_other_relations_of_the_ego() -> None:
    nodes = {0: entity("car", 0, 0, is_ego=True), 1: entity("car", 9, 0)}
    (link,) = links_of(
        graph_of(nodes, [(1, "leads", 0, {}), (0, "follows", 1, {})]), frozenset(), "ego"
    )

    assert (link.there, link.back, link.closeness) == (("leads",), ("follows",), None)


def test_a_link_reads_as_sentences() -> None:
    nodes = {4: entity("car", 0, 0), 8: entity("car", 3, 0)}
    edges = [(8, "near", 4, {}), (4, "near", 8, {}), (8, "leads", 4, {}), (4, "follows", 8, {})]
    (link,) = links_of(graph_of(nodes, edges), frozenset((4, 8)), "ego")

    assert sentences(link, {4: "a", 8: "b"}) == ["b near, leads a", "a follows b"]
    assert link.family == "matched"


def test_an_edge_to_a_node_that_is_not_in_the_graph_is_not_drawn() -> None:
    graph = graph_of(
        {0: entity("car", 0, 0, is_ego=True)}, [(7, "near", 0, {}), (0, "near", 0, {})]
    )

    assert links_of(graph, frozenset((0, 7)), "all") == []
    assert seen_from_ego(graph) == {}


def test_the_lane_of_the_ego_is_the_primary_one() -> None:
    lanes = {n: {"kind": "lane", "name": str(n)} for n in (-2, -3, -4)}
    edges = [(0, "isIn", n, {"is_primary": n == -3}) for n in lanes]

    assert ego_lane(graph_of({0: entity("car", 0, 0, is_ego=True), **lanes}, edges)) == -3


@given(
    st.lists(
        st.tuples(st.floats(-90, 90), st.floats(-90, 90), st.floats(5, 60), st.floats(5, 12)),
        max_size=25,
    )
)
def test_texts_cover_neither_each_other_nor_what_is_blocked_nor_leave_the_window(
    wishes: list[tuple[float, float, float, float]],
) -> None:
    placer = Placer((-100, -100, 100, 100))
    taken = [shapely.box(-20, -20, 10, 10)]
    placer.block((-20, -20, 10, 10))

    for x, y, width, height in wishes:
        spot = placer.beside(x, y, (3.0, 3.0), (width, height))
        if spot is None:
            continue
        text = shapely.box(
            spot[0] - width / 2, spot[1] - height / 2, spot[0] + width / 2, spot[1] + height / 2
        )
        assert all(text.intersection(other).area < 1e-6 for other in taken)
        assert text.within(shapely.box(-100.001, -100.001, 100.001, 100.001))
        taken.append(text)


@given(st.text(max_size=200), st.integers(2, 60))
def test_clean_texts_are_short_and_can_be_printed(text: str, length: int) -> None:
    assert clean(text, length).isprintable()
    assert len(clean(text, length)) <= length


@pytest.mark.parametrize(
    ("shape", "rings"),
    [
        (shapely.Point(1, 2), 0),
        (shapely.Polygon(), 0),
        (None, 0),
        (shapely.LineString(((0, 0), (1, 1))), 1),
        (shapely.Point(0, 0).buffer(2).difference(shapely.Point(0, 0).buffer(1)), 2),
        (shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(2, 2, 3, 3)]), 2),
    ],
)
def test_every_kind_of_geometry_has_its_rings(shape: shapely.Geometry | None, rings: int) -> None:
    assert len(rings_of(shape)) == rings


def test_the_sides_of_a_lane_are_left_and_right_of_its_travel() -> None:
    road_map = Crossing()
    ground = GroundView.of(road_map, MapWindow(0.0, 0.0, math.pi / 2, 60.0))

    _left_is_left(ground, 36)


@pytest.mark.data
@pytest.mark.parametrize("name", ["Town01", "Town07", "multi_intersections", "soderleden"])
def test_the_sides_of_real_lanes_are_left_and_right_of_their_travel(data: Path, name: str) -> None:
    text = (data / "maps" / f"{name}.xodr").read_text(encoding="utf-8")
    road_map = read_map(text, name)
    ground = GroundView.of(road_map, MapWindow(0.0, 0.0, math.pi / 2, 2000.0))
    lanes = len(ground.of_kind("lane"))

    _left_is_left(ground, lanes)


def _left_is_left(ground: GroundView, at_least: int) -> None:
    """Of all lanes with sides the left one lies to the left where the map says it is and how it runs."""
    nodes, known = ground.nodes, 0
    for row in ground.of_kind("lane"):
        sides = ground.sides(row)
        if sides is None:
            continue
        known += 1
        at = shapely.Point(nodes.x[row], nodes.y[row])
        aside = [_aside(side, at, float(nodes.heading[row])) for side in sides]
        assert aside[0] >= aside[1] - 1e-6, nodes.name[row]
    assert known >= at_least


def _aside(side: np.ndarray, at: shapely.Point, heading: float) -> float:
    line = shapely.LineString(side)
    nearest = line.interpolate(line.project(at))
    return math.cos(heading) * (nearest.y - at.y) - math.sin(heading) * (nearest.x - at.x)


def test_what_lies_above_is_drawn_above() -> None:
    road_map = Crossing()
    z = np.linspace(-300.0, 300.0, len(road_map.nodes))
    z[5] = math.nan
    road_map.nodes = replace(road_map.nodes, z=z)
    storeys = GroundView.of(road_map, MapWindow(0.0, 0.0, 0.0, 60.0)).storeys()

    assert len(storeys) == 36
    assert storeys.pop(5) == 0
    by_height = [storeys[row] for row in sorted(storeys, key=lambda r: z[r])]
    assert by_height == sorted(by_height)
    assert 5 <= max(by_height) <= 12
    assert layers.LANES + 13 * layers.STOREY <= layers.TINTS


def test_every_kind_and_light_has_its_colours() -> None:
    assert set(ENTITY_KINDS) == set(palette.ENTITY_TINTS)
    assert set(LIGHT_STATES) == set(palette.LIGHT_TINTS)
    assert set(SIGNALS) == set(palette.SIGNAL_TINTS)
    assert set(PROXIMITY) == set(palette.CLOSENESS)


# Severity 1.0 of Machado, Oliveira & Fernandes, "A Physiologically-based Model for Simulation of Color
# Vision Deficiency", IEEE TVCG 15(6), 2009, for linear RGB.
DICHROMACIES = {
    "protanopia": (
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ),
    "deuteranopia": (
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ),
    "tritanopia": (
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ),
}


@pytest.mark.parametrize("eyes", list(DICHROMACIES))
def test_what_must_not_be_confused_differs_for_the_colour_blind(eyes: str) -> None:
    colours = {
        "ego": palette.EGO,
        "car": palette.entity_tint("car"),
        "match": palette.MATCH,
        "lane": palette.lane_tint("driving"),
        "truck": palette.entity_tint("truck"),
    }
    seen = {name: _lab(colour, DICHROMACIES[eyes]) for name, colour in colours.items()}

    # CIE76: a difference of 2.3 is just noticeable.
    assert min(math.dist(seen[a], seen[b]) for a, b in combinations(seen, 2)) > 15


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def test_types_of_lanes_differ_on_a_map_and_bear_dark_texts() -> None:
    tints = {kind: palette.lane_tint(kind) for kind in palette.LANE_TINTS}
    tints |= {"junction": palette.JUNCTION, "ground": palette.GROUND}
    seen = {name: _lab(colour, IDENTITY) for name, colour in tints.items()}
    pairs = [(a, b) for a, b in combinations(seen, 2) if tints[a] != tints[b]]

    assert all(math.dist(seen[a], seen[b]) > 4 for a, b in pairs)
    often = ("driving", "junction", "shoulder", "sidewalk", "median", "parking")
    for eyes in (IDENTITY, *DICHROMACIES.values()):
        known = [_lab(tints[name], eyes) for name in often]
        assert min(math.dist(a, b) for a, b in combinations(known, 2)) > 4.5
    common = [seen[name] for name in often]
    assert min(math.dist(a, b) for a, b in combinations(common, 2)) > 8
    assert min(lab[0] for lab in seen.values()) - _lab(palette.INK, IDENTITY)[0] > 50


def _lab(colour: str, eyes: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    """CIE 1976 L*a*b* of an sRGB colour (IEC 61966-2-1, D65) as these eyes see it."""
    rgb = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(np.array(eyes) @ linear, 0, 1)
    xyz = (
        np.array(((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505)))
        @ linear
        / (0.9505, 1.0, 1.089)
    )
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return 116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])


def test_few_colours_are_kept_as_they_are() -> None:
    few = np.random.default_rng(1).integers(0, 4, (50, 60, 3)).astype(np.uint8) * 80

    made = quantized(Image.fromarray(few))

    assert made.mode == "P"
    assert (np.asarray(made.convert("RGB")) == few).all()


def test_areas_keep_their_colours_and_mixtures_change_little() -> None:
    mixtures = np.random.default_rng(2).integers(0, 70, (100, 100, 3)).astype(np.uint8)
    areas = np.repeat(np.arange(0, 250, 25), 1000).reshape(100, 100, 1) * (1, 0, 0) + (0, 90, 150)
    drawn = np.concatenate((areas.astype(np.uint8), mixtures))

    picture = Image.fromarray(drawn)
    made = quantized(picture)

    change = np.abs(np.asarray(made.convert("RGB")).astype(int) - drawn)
    assert change[:100].max() <= 2
    assert greatest_change(made, picture) <= MOST_CHANGE


def test_too_many_colours_for_a_palette() -> None:
    photograph = Image.fromarray(
        np.random.default_rng(3).integers(0, 256, (300, 300, 3)).astype(np.uint8)
    )

    assert greatest_change(quantized(photograph), photograph) > MOST_CHANGE


def test_a_large_picture_has_the_colours_of_its_parts() -> None:
    """Its palette is chosen from some of its rows."""
    part = np.random.default_rng(2).integers(0, 256, (100, 3))[np.arange(1300) // 13]
    rows = np.repeat(part[None], 40, axis=0)
    rows[10:20] = 255 - rows[10:20]
    picture = Image.fromarray(np.tile(rows, (60, 1, 1)).astype(np.uint8))

    made = quantized(picture)

    assert picture.width * picture.height > layers.LEARNED
    assert made.mode == "P"
    assert greatest_change(made, picture) <= MOST_CHANGE


def test_the_ego_is_not_related_to_itself() -> None:
    nodes = {0: entity("car", 0, 0, is_ego=True), 1: entity("car", 5, 0)}

    assert list(seen_from_ego(graph_of(nodes, related(nodes)))) == [1]
