"""Pictures: what is drawn stands where it is, is named as it is, and nothing in a trace can spoil it."""

from __future__ import annotations

import io
import math
import subprocess
import sys
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import matplotlib as mpl
import networkx as nx
import numpy as np
import pytest
import shapely
from drawing import Crossing, crowd, entity, graph_of, related
from PIL import Image

import sgstore.draw._palette as palette
from sgstore.draw import draw_frame, draw_map
from sgstore.draw._abstraction import _spots
from sgstore.draw._page import MOST_CHANGE
from sgstore.draw._picture import title_of
from sgstore.draw._scene import DrawnFrame
from sgstore.draw._view import view_of
from sgstore.errors import ExportError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.model.graph import SceneGraph

SVG = "{http://www.w3.org/2000/svg}"
WINDOW = (14.0, 40.0, 534.0, 560.0)
"""Left, top, right, bottom of the window in an SVG of a frame; points."""
EGO = entity("car", 100.0, 50.0, 90.0, is_ego=True, speed=8.0)


def svg(path: Path) -> ET.Element:
    return ET.fromstring(path.read_text(encoding="utf-8"))


def group(root: ET.Element, gid: str) -> ET.Element | None:
    return next((g for g in root.iter(f"{SVG}g") if g.get("id") == gid), None)


def points(element: ET.Element | None) -> np.ndarray[Any, Any]:
    """Corners of the first path in a group, in points from the middle of the window, y up."""
    assert element is not None
    words = next(element.iter(f"{SVG}path")).attrib["d"].split()
    numbers = [float(word) for word in words if word not in "MLzQC"]
    middle = np.array((WINDOW[0] + WINDOW[2], WINDOW[1] + WINDOW[3])) / 2
    return (np.array(numbers).reshape(-1, 2) - middle) * (1, -1)


def middle(element: ET.Element | None) -> np.ndarray[Any, Any]:
    corners = points(element)
    return (corners.min(axis=0) + corners.max(axis=0)) / 2


def texts(root: ET.Element) -> list[str]:
    return ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]


def pixels(path: Path) -> np.ndarray[Any, Any]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def two(**more: Any) -> SceneGraph:
    nodes = {0: EGO, 17: entity("person", 108.0, 60.0, **more)}
    return graph_of(nodes, related(nodes))


@pytest.mark.parametrize(
    ("name", "start"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), ("a.PNG", b"\x89PNG")]
)
def test_the_ending_says_the_format(tmp_path: Path, name: str, start: bytes) -> None:
    draw_frame(two(), None, tmp_path / name)

    assert (tmp_path / name).read_bytes().startswith(start)


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.svg.txt"])
def test_another_ending_is_refused_with_what_would_be_right(tmp_path: Path, name: str) -> None:
    with pytest.raises(ExportError, match=r"\.png or \.svg"):
        draw_frame(two(), None, tmp_path / name)

    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_missing_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="No such file or directory"):
        draw_frame(two(), None, tmp_path / "missing" / "a.png")


@pytest.mark.parametrize("ending", ["png", "svg"])
def test_the_same_frame_gives_the_same_bytes_whatever_the_user_has_configured(
    tmp_path: Path, ending: str
) -> None:
    first, second = tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    road_map = Crossing()
    draw_frame(crowd(road_map), road_map, first)
    configured = {"lines.linewidth": 9.0, "font.size": 30.0, "path.sketch": (4, 90, 2)}

    with mpl.rc_context(configured):
        draw_frame(crowd(road_map), road_map, second)
        assert mpl.rcParams["lines.linewidth"] == 9.0

    assert first.read_bytes() == second.read_bytes()


def test_the_ego_stands_in_the_middle_and_heads_up(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg", radius=50.0)
    corners = points(group(svg(tmp_path / "a.svg"), "node-0"))
    width, height = np.ptp(corners, axis=0)

    assert middle(group(svg(tmp_path / "a.svg"), "node-0")) == pytest.approx((0, 0), abs=0.01)
    assert height / width == pytest.approx(4.6 / 1.9, rel=1e-3)
    assert height == pytest.approx(4.6 * 520 / 100, rel=1e-3)


@pytest.mark.parametrize("heading", [0.0, 37.0, 90.0, 180.0, -100.0])
@pytest.mark.parametrize(("forward", "left"), [(20.0, 0.0), (0.0, 15.0), (-12.0, -7.0)])
def test_an_entity_stands_where_the_ego_sees_it(
    tmp_path: Path, heading: float, forward: float, left: float
) -> None:
    there = complex(-40.0, 900.0) + complex(forward, left) * np.exp(1j * math.radians(heading))
    ego = entity("car", -40.0, 900.0, heading, is_ego=True)
    other = entity("car", there.real, there.imag, heading + 10)

    draw_frame(graph_of({3: ego, 17: other}), None, tmp_path / "a.svg", radius=26.0)

    drawn = middle(group(svg(tmp_path / "a.svg"), "node-17")) / 10.0
    assert drawn == pytest.approx((-left, forward), abs=0.01)


def test_north_is_up_where_it_is_wanted_and_where_there_is_no_ego(tmp_path: Path) -> None:
    north = {1: entity("car", 0.0, 0.0, is_ego=True), 17: entity("car", 0.0, 10.0)}
    draw_frame(graph_of(north), None, tmp_path / "a.svg", radius=26.0, north_up=True)
    alone = {17: entity("car", 0.0, 10.0), 18: entity("car", 0.0, -10.0)}
    draw_frame(graph_of(alone), None, tmp_path / "b.svg", radius=26.0)

    for name in ("a", "b"):
        drawn = middle(group(svg(tmp_path / f"{name}.svg"), "node-17"))
        assert drawn == pytest.approx((0.0, 100.0), abs=0.1)
    assert any("no ego in this frame" in text for text in texts(svg(tmp_path / "b.svg")))


def test_a_highlight_changes_the_picture_about_its_node_and_not_elsewhere(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.png", radius=50.0, relations="none")
    draw_frame(two(), None, tmp_path / "b.png", radius=50.0, relations="none", highlight={"p": 17})
    difference = np.abs(pixels(tmp_path / "a.png") - pixels(tmp_path / "b.png")).max(axis=2)
    changed = np.argwhere(difference > 2 * MOST_CHANGE)
    scale = 130 / 72
    window = changed[changed[:, 1] < WINDOW[2] * scale]
    node = np.array((300.0 - 52.0, 274.0 + 41.6)) * scale

    assert len(window) > 100
    assert np.abs(window - node).max(axis=0).max() < 110 * scale


def test_a_matched_node_is_named_with_its_variable_and_told_beside(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg", highlight={"e": 0, "p": 17})
    root = svg(tmp_path / "a.svg")
    label = group(root, "label-17")

    assert label is not None
    assert texts(label) == ["p = person 17"]
    assert group(root, "halo-17") is not None
    assert "p near, inDFrontOf, toRightOf e" in texts(root)


@pytest.mark.parametrize(
    ("size", "head", "metres"),
    [
        (
            {"length": 4.0, "width": 2.0},
            "Around the ego: what, gap, which relations to it",
            "3.0 m",
        ),
        (
            {"length": 14.0, "width": 2.0},
            "Around the ego: what, gap, which relations to it",
            "0.0 m",
        ),
        (
            {"length": None},
            "Around the ego: what, gap (c: of the centres), which relations to it",
            "c 7.0 m",
        ),
    ],
)
def test_the_panel_has_the_gap_as_rules_have_and_labels_the_distance_of_centres(
    tmp_path: Path, size: dict[str, Any], head: str, metres: str
) -> None:
    own = {"length": 4.0, "width": 2.0, "heading": 90.0}
    nodes = {
        0: {**entity("car", 5.0, 5.0, is_ego=True), **own},
        1: {**entity("car", 5.0, 12.0), **own, **size},
    }
    draw_frame(graph_of(nodes, related(nodes)), None, tmp_path / "a.svg")

    assert {head, metres} <= set(texts(svg(tmp_path / "a.svg")))


def test_two_variables_of_one_node_are_both_named(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg", highlight={"a": 17, "b": 17})

    assert "a, b = person 17" in texts(svg(tmp_path / "a.svg"))


def test_a_matched_lane_is_tinted(tmp_path: Path) -> None:
    road_map = Crossing()
    lane = road_map.node("3/0/1")
    draw_frame(crowd(road_map), road_map, tmp_path / "a.svg", highlight={"l": lane})
    root = svg(tmp_path / "a.svg")

    assert np.ptp(points(group(root, f"node-{lane}")), axis=0)[0] > 10
    assert "l = lane 3/0/1" in texts(root)


def test_a_node_that_is_not_there_is_said_not_to_be(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg", highlight={"x": 99, "l": -5})

    assert "x = node 99  (not in this frame)" in texts(svg(tmp_path / "a.svg"))


def test_hostile_texts_are_shown_as_they_stand_and_cut(tmp_path: Path) -> None:
    hostile = "$\\frac{1}{0}$ <script>&\x00\x1b[31m\u202e中文" + "x" * 10_000
    graph = two()
    graph.nodes[-3] = {"kind": "lane", "name": hostile, "x": 100.0, "y": 55.0}
    graph.nodes[5] = entity("car", 105.0, 45.0) | {"kind": hostile}
    named = graph_of(graph.nodes, graph.edges, trace=hostile)

    for name in ("a.svg", "a.png"):
        draw_frame(named, None, tmp_path / name, highlight={hostile: 17, "l": -3})

    told = texts(svg(tmp_path / "a.svg"))
    assert any(text.startswith("$\\frac{1}{0}$ <script>&··[31m·□□xxx") for text in told)
    assert max(map(len, told)) < 150


def test_svg_texts_are_texts(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg")

    assert {"ego (car 0)", "person 17", "near, inDFrontOf"} <= set(texts(svg(tmp_path / "a.svg")))


def test_the_legend_tells_what_occurs_and_nothing_else(tmp_path: Path) -> None:
    draw_frame(two(), None, tmp_path / "a.svg")
    told = set(texts(svg(tmp_path / "a.svg")))

    assert {"ego", "person", "near", "way in 1 s", "inDFrontOf: ahead"} <= told
    assert not {"car", "truck", "driving lane", "crosswalk", "matched", "safety_hazard"} & told


@pytest.mark.parametrize(("mode", "lines"), [("none", 0), ("ego", 1), ("all", 2)])
def test_no_more_relations_are_drawn_than_were_wanted(
    tmp_path: Path, mode: Any, lines: int
) -> None:
    nodes = {0: EGO, 1: entity("car", 100.0, 62.0), 2: entity("car", 100.0, 80.0)}
    draw_frame(graph_of(nodes, related(nodes)), None, tmp_path / "a.svg", relations=mode)
    told = texts(svg(tmp_path / "a.svg"))

    assert ("near" in told) + ("between entities" in told) == lines


def test_what_has_no_place_is_counted_not_drawn(tmp_path: Path) -> None:
    lost = entity("car", math.nan, 3.0)
    draw_frame(graph_of({0: EGO, 17: lost}), None, tmp_path / "a.svg")
    root = svg(tmp_path / "a.svg")

    assert group(root, "node-17") is None
    assert any("without a place, not drawn: 1 node" in text for text in texts(root))


@pytest.mark.parametrize(
    "strange",
    [
        {"length": 1e12, "width": 1e12},
        {"length": math.inf, "vx": math.inf, "vy": 1.0},
        {"heading": math.nan, "length": -3.0, "width": math.nan},
        {"x": 1e300, "y": -1e300},
        {"x": "10", "light_state": 7},
        {"kind": "traffic_light", "light_state": "purple"},
    ],
)
def test_absurd_values_do_not_spoil_the_picture(tmp_path: Path, strange: dict[str, Any]) -> None:
    graph = graph_of({0: EGO, 17: entity("car", 105.0, 50.0) | strange}, [(0, "near", 17, {})])
    draw_frame(graph, None, tmp_path / "a.svg", highlight=[17])

    ego = points(group(svg(tmp_path / "a.svg"), "node-0"))
    assert np.ptp(ego, axis=0).min() > 3.0


def test_an_empty_graph_is_an_empty_picture(tmp_path: Path) -> None:
    draw_frame(graph_of({}), Crossing(), tmp_path / "a.png")

    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, math.inf])
def test_an_absurd_radius_is_refused(tmp_path: Path, radius: float) -> None:
    with pytest.raises(ExportError, match="expected 1 to 10,000 m"):
        draw_frame(two(), None, tmp_path / "a.png", radius=radius)


def camera(form: str, size: tuple[int, int] = (320, 180)) -> bytes:
    """A picture that is green above and blue below."""
    written = io.BytesIO()
    image = Image.new("RGB", size, (10, 200, 30))
    image.paste((20, 40, 220), (0, size[1] // 2, *size))
    image.save(written, form)
    return written.getvalue()


@pytest.mark.parametrize("form", ["JPEG", "PNG"])
def test_the_camera_picture_stands_beside(tmp_path: Path, form: str) -> None:
    draw_frame(two(), None, tmp_path / "a.png", picture=camera(form))
    drawn = pixels(tmp_path / "a.png")
    green, blue = (
        np.argwhere((np.abs(drawn - colour) < 8).all(axis=2))
        for colour in ((10, 200, 30), (20, 40, 220))
    )

    assert min(green[:, 1].min(), blue[:, 1].min()) > WINDOW[2] * 130 / 72
    assert green[:, 0].max() < blue[:, 0].min()
    assert len(green) == pytest.approx(len(blue), rel=0.1)
    assert np.ptp(green[:, 1]) / np.ptp(green[:, 0]) == pytest.approx(320 / 90, rel=0.05)


@pytest.mark.parametrize(
    "picture",
    [
        pytest.param(lambda: b"", id="empty"),
        pytest.param(lambda: b"GIF89a" + bytes(100), id="another format"),
        pytest.param(lambda: camera("PNG")[:100], id="cut short"),
        pytest.param(lambda: camera("JPEG")[:300] + bytes(50), id="damaged"),
        pytest.param(lambda: camera("PNG", (9000, 9000)), id="too many pixels"),
    ],
)
def test_a_bad_camera_picture_is_refused(tmp_path: Path, picture: Callable[[], bytes]) -> None:
    with pytest.raises(ExportError, match="camera picture"):
        draw_frame(two(), None, tmp_path / "a.png", picture=picture())


def test_the_title_has_trace_frame_and_time_also_where_it_is_a_date() -> None:
    assert title_of(graph_of({})) == "town   frame 7   0.350 s"
    recorded = graph_of({}, time_ns=1_753_000_000_250_000_000)
    assert title_of(recorded).endswith("frame 7   2025-07-20 08:26:40.250 UTC")
    told = title_of(recorded, recorded.time_ns - 30_000_000_000)
    assert told.endswith("frame 7   30.000 s   2025-07-20 08:26:40.250 UTC")
    assert title_of(graph_of({}), 100_000_000) == "town   frame 7   0.250 s"


def test_a_map_shows_its_lanes_by_type_and_its_parts(tmp_path: Path) -> None:
    draw_map(Crossing(), tmp_path / "m.svg")
    told = texts(svg(tmp_path / "m.svg"))

    assert {"map crossing", "driving", "28 lanes", "8 lanes", "junction 9", "road 2"} <= set(told)
    assert any("160 m by 160 m" in text and "4 crosswalks" in text for text in told)


def test_a_map_without_anything_is_refused(tmp_path: Path) -> None:
    class Empty(Crossing):
        def outlines(self) -> Any:
            return np.full(len(self.nodes), None)

    with pytest.raises(ExportError, match="no lane, crosswalk or object"):
        draw_map(Empty(), tmp_path / "m.svg")


@pytest.mark.parametrize("package", ["matplotlib", "PIL"])
def test_a_missing_package_is_told_with_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)

    with pytest.raises(MissingExtraError, match=r"is needed for drawing: .*sgstore\[viz\]"):
        draw_frame(two(), None, tmp_path / "a.png")


def test_importing_is_cheap_and_drawing_leaves_no_global_state(tmp_path: Path) -> None:
    program = """
import sys
import sgstore.draw as d
from sgstore.model.graph import SceneGraph
assert 'matplotlib' not in sys.modules
from pathlib import Path
d.draw_frame(SceneGraph(1, 't', 0, 0, None, {}, []), None, Path(sys.argv[1]))
assert 'matplotlib.pyplot' not in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(tmp_path / "a.png")],
        capture_output=True,
        text=True,
        check=False,
    )

    assert (done.returncode, done.stderr) == (0, "")


def test_a_line_of_the_map_is_a_line_and_no_area(tmp_path: Path) -> None:
    road_map = Crossing()
    bend = shapely.LineString(((-60.0, -60.0), (-60.0, 60.0), (60.0, 60.0)))
    road_map.add_scenery("barrier", bend)
    draw_map(road_map, tmp_path / "m.png")
    barrier = [int(palette.ENTITY_TINTS["barrier"][i : i + 2], 16) for i in (1, 3, 5)]
    drawn = (np.abs(pixels(tmp_path / "m.png") - barrier) < 20).all(axis=2)

    assert 500 < drawn.sum() < 5000


# Names beside what they name ---------------------------------------------------------------------------


def boxes_of(root: ET.Element, word: str) -> dict[int, tuple[float, float, float, float]]:
    """Left, bottom, right and top of the groups ``word-17``, by node; metres of the picture."""
    found: dict[int, tuple[float, float, float, float]] = {}
    for one in root.iter():
        ident = one.get("id", "")
        if ident.startswith(f"{word}-"):
            corners = points(one)
            low, high = corners.min(axis=0), corners.max(axis=0)
            found[int(ident.removeprefix(f"{word}-"))] = (*low.tolist(), *high.tolist())
    return found


def gap(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    aside = max(one[0] - other[2], other[0] - one[2], 0.0)
    return math.hypot(aside, max(one[1] - other[3], other[1] - one[3], 0.0))


@pytest.mark.parametrize("north_up", [True, False])
@pytest.mark.parametrize("heading", [0.0, 45.0, 90.0])
@pytest.mark.parametrize("apart", [6.5, 9.0, 9.5, 10.0])
def test_a_name_in_a_queue_is_nearest_to_what_it_names(
    tmp_path: Path, apart: float, heading: float, *, north_up: bool
) -> None:
    ahead = math.cos(math.radians(heading)), math.sin(math.radians(heading))
    queue = {
        n: entity("car", apart * n * ahead[0], apart * n * ahead[1], heading, is_ego=n == 0)
        for n in range(-2, 4)
    }
    nodes = {n if n >= 0 else 10 - n: a for n, a in queue.items()}
    draw_frame(graph_of(nodes), None, tmp_path / "a.svg", radius=45.0, north_up=north_up)
    root = svg(tmp_path / "a.svg")

    labels, things = boxes_of(root, "label"), boxes_of(root, "node")
    assert len(labels) >= 5
    for node, label in labels.items():
        away = {other: gap(label, thing) for other, thing in things.items()}
        nearest_other = min(value for other, value in away.items() if other != node)
        own = things[node]
        over = own[0] < (label[0] + label[2]) / 2 < own[2]
        assert away[node] + (0.0 if over else 3.0) < nearest_other, (node, away)


# Storeys ---------------------------------------------------------------------------------------------


def dashed(root: ET.Element, node: int) -> bool:
    element = group(root, f"node-{node}")
    assert element is not None
    return "stroke-dasharray" in next(element.iter(f"{SVG}path")).attrib["style"]


def under_and_over() -> tuple[dict[int, dict[str, Any]], set[int]]:
    """An ego on a bridge, 10 m above a street; and who of the others is below the bridge."""
    high, low = 10.8, 0.8
    nodes = {
        0: entity("car", 0, -15, 90.0, is_ego=True, z=high),
        1: entity("car", 0, 3, 90.0, z=high),
        2: entity("car", 1.0, 0, 0.0, z=low, height=1.6),
        3: entity("person", -1.0, 1.0, 0.0, z=low, height=1.6),
        4: entity("car", 25, 0, 0.0, z=low),
        5: entity("car", -25, 0, 0.0, z=low),
        6: entity("car", 0.5, 12, 90.0, z=float("nan")),
    }
    return nodes, {2, 3}


@pytest.mark.parametrize("north_up", [True, False])
def test_what_is_below_the_egos_road_is_not_drawn_as_if_on_it(
    tmp_path: Path, *, north_up: bool
) -> None:
    from opendrive_maps import a_map, a_road, cubic, lane, line, section

    from sgstore.maps.opendrive import read_map

    lanes = section(lane(1), lane(0), lane(-1))
    bridge = a_road(
        "bridge",
        line(80.0, x=0, y=-40, hdg=math.pi / 2),
        sections=lanes,
        elevation=cubic("elevation", 10.0, s=0),
    )
    road_map = read_map(a_map(bridge, a_road("street", line(80.0, x=-40), sections=lanes)), "two")
    nodes, below = under_and_over()
    draw_frame(graph_of(nodes), road_map, tmp_path / "a.svg", radius=40.0, north_up=north_up)
    root = svg(tmp_path / "a.svg")

    assert {node for node in nodes if dashed(root, node)} == below
    assert {"car 2, 10 m below", "person 3, 10 m below", "a storey below"} <= set(texts(root))
    assert "car 4" in texts(root)


def test_without_a_map_the_ego_tells_what_is_a_storey_deeper(tmp_path: Path) -> None:
    nodes, _ = under_and_over()
    nodes[7] = entity("car", 0, 80, 90.0, z=4.0)  # down a slope, on the ego's own road
    draw_frame(graph_of(nodes), None, tmp_path / "a.svg", radius=90.0)
    root = svg(tmp_path / "a.svg")

    assert {node for node in nodes if dashed(root, node)} == {2, 3, 4, 5}
    assert any("m below" in text for text in texts(root))
    assert "a storey below" in texts(root)


def test_a_line_between_matched_lanes_lies_where_no_entity_is_near(tmp_path: Path) -> None:
    road_map = Crossing()
    lanes = {name: road_map.node(f"0/0/{name}") for name in (-1, -2)}
    nodes: dict[int, Any] = {0: entity("car", 30.0, -1.75, 0.0, is_ego=True)}
    nodes |= {1: entity("car", 45.0, -1.75), 2: entity("car", 47.0, -5.25)}
    for node in lanes.values():
        row = -1 - node
        place = {"x": float(road_map.nodes.x[row]), "y": float(road_map.nodes.y[row])}
        nodes[node] = {"kind": "lane", "name": road_map.nodes.name[row], **place}
    graph = graph_of(nodes, [(lanes[-1], "toLeftOf", lanes[-2], {})])
    matched = {lanes[-1]: "a", lanes[-2]: "b"}
    scene = DrawnFrame.of(graph, road_map, matched, view_of(graph, 40.0), "ego")
    (link,) = scene.links
    ends = scene.ends(link)

    assert ends is not None
    assert math.dist(*ends) == pytest.approx(3.5, abs=0.1)  # from middle to middle
    for body in scene.bodies.values():
        assert min(math.dist((body.x, body.y), end) for end in ends) >= 12.0


@pytest.mark.parametrize("others", [1, 2, 8, 9])
def test_no_line_of_the_ring_passes_the_ego(others: int) -> None:
    graph = nx.MultiDiGraph()
    graph.add_node("ego", name="ego", base_class="ego")
    graph.add_nodes_from((f"car_{i}", {"base_class": "car"}) for i in range(others))
    spots = _spots(graph)
    x, y = spots.pop("ego")

    for a, b in ((a, b) for a in spots.values() for b in spots.values() if a < b):
        cross = (a[0] - x) * (b[1] - y) - (a[1] - y) * (b[0] - x)
        assert abs(cross) > 1.0
