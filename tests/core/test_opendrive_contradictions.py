"""Incomplete and contradictory OpenDRIVE maps: each record counts, or is a warning."""

from __future__ import annotations

import random
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from opendrive_maps import a_map, a_road, border, element, lane, line, link, section, spiral, width

from sgstore.maps.map_files import read_map_file
from sgstore.maps.opendrive import parse_map
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

LINKS = re.compile(
    r"<(predecessor|successor|laneLink)\b[^>]*?(/>|></\1>)|<connection\b.*?</connection>", re.DOTALL
)
"""Elements that tell one direction of a link."""


def travels(road_map: RoadMap) -> set[tuple[str, str]]:
    """Names of the lanes between which traffic flows."""
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE["travelsTo"])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


def read(*parts: str) -> RoadMap:
    return parse_map(a_map(*parts), "m")


def chain(
    first: str = "", second: str = "", *, x: float = 50.0, plan: str = "", kept: int = -1
) -> tuple[str, str]:
    """Two roads of one lane behind one another, with the given links of both."""
    one = section(lane(0), lane(-1, after=kept if first else None))
    other = section(lane(0), lane(-1, before=-1 if second else None))
    return (
        a_road("1", line(50.0), sections=one, links=first),
        a_road("2", plan or line(50.0, x=x), sections=other, links=second),
    )


AHEAD, BACK = link("successor", "road", "2", "start"), link("predecessor", "road", "1", "end")
JOINED = {("1/0/-1", "2/0/-1")}


@pytest.mark.parametrize(
    "links",
    [
        (AHEAD, ""),
        ("", BACK),
        (link("successor", "road", "2"), ""),
        (link("successor", "road", "2", "end"), ""),
        ("", link("predecessor", "road", "1", "start")),
    ],
)
def test_a_link_of_one_lane_or_to_the_far_end_counts_where_lanes_touch(
    links: tuple[str, str],
) -> None:
    road_map = read(*chain(*links))

    assert travels(road_map) == JOINED
    far = 'contactPoint="end"' in links[0] or 'contactPoint="start"' in links[1]
    assert len(road_map.warnings) == far


@pytest.mark.parametrize(
    ("links", "said"),
    [
        (("", BACK), "lane 1/0/-1 to lane 2/0/-1: linked by the second lane only"),
        ((AHEAD, BACK), "lane 1/0/-1 and lane 2/0/-1 are linked, but 20.0 m apart"),
    ],
)
def test_links_of_lanes_that_do_not_touch_are_warnings(links: tuple[str, str], said: str) -> None:
    assert said in "\n".join(read(*chain(*links, x=70.0)).warnings)


def merge(*, back: int = -2, joined: int = -2) -> RoadMap:
    """Lane -3 tapers and is linked to lane -2 of the next section, whose link names lane ``back``."""
    before = section(
        lane(0),
        lane(-1, after=-1),
        lane(-2, after=-2),
        lane(-3, width(3.5, -0.07), after=joined),
    )
    return read(
        a_road(
            "1",
            line(90.0),
            sections=before
            + section(lane(0), lane(-1, before=-1), lane(-2, before=back), lane(-3), s=50),
        )
    )


def test_a_link_to_a_lane_that_is_linked_elsewhere_is_a_warning() -> None:
    road_map = merge()

    said = "lane 1/0/-3 is linked to lane 1/1/-2, which is linked to lane 1/0/-2 instead"
    assert [w for w in road_map.warnings if said in w]
    assert ("1/0/-3", "1/1/-2") in travels(road_map)
    for agreed in (merge(back=-3), merge(joined=-3)):
        assert not [w for w in agreed.warnings if "1/0/-3 is linked to" in w]


@pytest.mark.data
def test_the_tapering_lane_of_soderleden_is_a_warning(data: Path) -> None:
    text = (data / "maps/soderleden.xodr").read_text(encoding="utf-8")

    (warning,) = parse_map(text, "soderleden").warnings
    assert warning.startswith("lane 0/0/-3 is linked to lane 0/1/-2, which is linked to")


def test_a_road_link_without_lane_links_joins_touching_lanes_and_is_else_a_warning() -> None:
    plain = section(lane(0), lane(-1))

    def warned(x: float) -> tuple[set[tuple[str, str]], int]:
        roads = a_road("1", line(50.0), sections=plain, links=AHEAD), a_road("2", line(50.0, x=x))
        road_map = read(*roads)
        return travels(road_map), len(road_map.warnings)

    assert warned(50.0) == (JOINED, 0)
    assert warned(58.0) == (set(), 1)


def test_a_road_link_that_contradicts_the_other_road_is_a_warning() -> None:
    third = a_road("3", line(50.0, x=50.0, y=40.0))
    road_map = read(*chain(link("successor", "road", "3", "start"), BACK), third)

    assert travels(road_map) >= JOINED
    assert [w for w in road_map.warnings if "road '1' leads to road '3', but road '2'" in w]


@pytest.mark.parametrize("after", [None, -1])
@pytest.mark.parametrize("wide", [3.5, 3.0, 9.0])
def test_links_that_miss_between_sections_follow_from_touching_lanes(
    after: int | None, wide: float
) -> None:
    sections = section(lane(1), lane(0), lane(-1, after=after)) + section(
        lane(1), lane(0), lane(-1, width(wide)), s=20
    )
    road_map = read(a_road("1", line(40.0), sections=sections))

    known = {("1/0/-1", "1/1/-1")} if after or wide < 4 else set()
    assert travels(road_map) == {*known, ("1/1/1", "1/0/1")}
    assert ("1/0/-1 leads nowhere" in str(road_map.warnings)) == (not known)


def junction(
    *links: str, lanes: str = '<laneLink from="-1" to="-1"/>', incoming: str = "1", **values: str
) -> str:
    """Road 1 leads through road 3 of junction 9 into road 2; ``links``: those of roads 1, 3 and 2."""
    first, through, last = links or (
        link("successor", "junction", "9"),
        link("predecessor", "road", "1", "end") + link("successor", "road", "2", "start"),
        link("predecessor", "junction", "9"),
    )
    attributes = {"incomingRoad": incoming, "connectingRoad": "3", "contactPoint": "start"} | values
    told = {key: value for key, value in attributes.items() if value}
    return a_map(
        a_road("1", line(50.0), links=first),
        a_road(
            "3",
            line(20.0, x=50.0),
            sections=section(lane(0), lane(-1, before=-1, after=-1)),
            links=through,
            junction="9",
        ),
        a_road("2", line(50.0, x=70.0), links=last),
        element("junction", element("connection", lanes, id="0", **told), id="9"),
    )


THROUGH = {("1/0/-1", "3/0/-1"), ("3/0/-1", "2/0/-1")}


@pytest.mark.parametrize(
    "text",
    [
        junction(),
        junction(lanes=""),
        junction("", "", ""),
        junction("", "", link("predecessor", "junction", "9")),
        junction(link("successor", "junction", "9"), "", link("predecessor", "junction", "9")),
        junction(contactPoint="end"),
        junction().replace('<successor id="-1"></successor>', ""),
    ],
    ids=["whole", "no lane links", "junction only", "one end", "no roads", "contact", "no exit"],
)
def test_a_junction_with_incomplete_links_leads_through_or_is_a_warning(text: str) -> None:
    road_map = parse_map(text, "m")

    lost = THROUGH - travels(road_map)
    assert not travels(road_map) - THROUGH
    assert not lost or any(name in str(road_map.warnings) for pair in lost for name in pair)
    if 'contactPoint="end"' in text.split("<connection")[1]:
        assert "linked to the end of road '3'" in str(road_map.warnings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (junction(incoming=""), "comes from a missing road ''"),
        (junction(incoming="77"), "comes from a missing road '77'"),
        (junction(connectingRoad="77"), "leads to a missing road '77'"),
        (junction(connectingRoad=""), "leads to a missing road ''"),
        (junction(incoming="2"), "linked by the second lane, but not connected by the junction"),
        (junction(lanes='<laneLink from="-5" to="-1"/>'), "missing lane -5"),
        (junction(lanes='<laneLink from="-1" to="-5"/>'), "missing lane -5"),
        (junction().replace('junction="9"', 'junction="8"'), "part of a missing junction '8'"),
        (
            junction().replace('"junction" elementId="9"', '"junction" elementId="8"'),
            "'8'",
        ),
    ],
)
def test_connections_that_lead_nowhere_are_warnings(text: str, said: str) -> None:
    assert said in str(parse_map(text.replace("'", '"'), "m").warnings)


def straight(**inner: str) -> RoadMap:
    return read(a_road("1", line(100.0), **inner))


@pytest.mark.parametrize("last", [50.0, float("nan")])
def test_a_bad_spiral_is_a_curve_to_the_next_geometry_and_keeps_its_road(last: float) -> None:
    radius = 40 / np.pi
    bad = spiral(20.0, 0.0, last, s=50, x=50).replace('"nan"', '"wide"')
    after = line(30.0, s=70, x=50 + radius, y=radius, hdg=np.pi / 2)
    road_map = read(a_road("1", line(50.0), bad, after))

    (warning,) = road_map.warnings
    assert "road '1': the spiral at s = 50 m has no usable curvature" in warning
    place = road_map.ribbons.at(np.array([0]), np.array([0.0]))
    assert (place.x[0], place.y[0]) == pytest.approx((0.0, -1.75))
    s, x, y = (getattr(road_map.ribbons, name) for name in ("s", "left_x", "left_y"))
    middle = np.interp(60.0, s, x), np.interp(60.0, s, y)
    arc = 50 + radius * np.sin(np.pi / 4), radius * (1 - np.cos(np.pi / 4))
    assert middle == pytest.approx(arc, abs=0.2)


def test_a_comment_before_the_declaration_is_no_fault(tmp_path: Path) -> None:
    file = tmp_path / "m.xodr"
    head = '<!-- by hand -->\n<?xml version="1.0" encoding="iso-8859-1"?>'
    file.write_text(head + a_map(a_road("\u00df", line(9.0))), encoding="iso-8859-1")

    assert "\u00df" in read_map_file(file).nodes.name


def placed(tag: str, s: float, **values: str) -> str:
    return element(tag, s=s, t=0, id="x", orientation="+", type="1000001", dynamic="yes", **values)


@pytest.mark.parametrize("s", [250.0, -3.0])
def test_positions_beyond_their_road_are_warnings(s: float) -> None:
    reference = placed("signal", 5) + placed("signalReference", s)
    for inner in (
        {"signals": placed("signal", s)},
        {"signals": reference},
        {"objects": element("object", s=s, t=9, id="o", type="pole", radius=0.1)},
        {"elevation": element("elevation", s=s, a=0, b=0, c=0, d=0)},
        {"offset": element("laneOffset", s=s, a=0, b=0, c=0, d=0)},
        {"type": element("type", s=s, type="town")},
    ):
        (warning,) = straight(**inner).warnings
        assert f"s = {s:g} m is beyond the road" in warning


def test_a_validity_that_names_missing_lanes_is_a_warning() -> None:
    def said(start: int, end: int) -> tuple[str, ...]:
        valid = element("validity", fromLane=start, toLane=end)
        one = element("signal", valid, id="x", s=5, t=0, type="1000001", orientation="+")
        return straight(signals=one).warnings

    assert said(-1, -1) == said(-2, -1) == said(0, 0) == ()
    (warning,) = said(7, 5)
    assert "<signal> 'x': its validity names missing lanes 5 to 7" in warning


def test_references_to_missing_parts_and_ids_that_occur_twice_are_warnings() -> None:
    twice = placed("signal", 5) + placed("signal", 9)
    road_map = read(
        a_road("1", line(9.0), signals=twice + element("signalReference", s=1, t=0, id="gone")),
        element("controller", element("control", signalId="lost"), id="c"),
        element("junction", id="9", type="virtual"),
        element("junction", id="9", type="virtual"),
        element("junctionGroup", element("junctionReference", junction="7"), id="g"),
    )

    said = "\n".join(road_map.warnings)
    for what in ("missing signal 'gone'", "missing signal 'lost'", "missing junction '7'"):
        assert what in said
    assert "signal 'x': there are 2 of this id" in said
    assert "junction '9': there are 2 of this id" in said


def test_a_negative_width_counts_as_0_and_is_a_warning() -> None:
    lanes = lane(0), lane(-1), lane(-2, width(1.0, -0.04)), lane(-3)
    road_map = straight(sections=section(*lanes))

    (warning,) = road_map.warnings
    assert warning == "lane 1/0/-2: its width is negative (-3 m), which counts as 0"
    row = road_map.nodes.name.index("1/0/-3") - 1
    ribbons, whole = road_map.ribbons, road_map.ribbons.lane == row
    across = np.interp([0.0, 25.0, 80.0], ribbons.s[whole], ribbons.left_y[whole])
    assert across == pytest.approx([-4.5, -3.5, -3.5], abs=1e-6)


@pytest.mark.parametrize(
    ("lanes", "said"),
    [
        ((lane(-1, border(-3.5)), lane(-2, border(-1.0))), "border is on the wrong side"),
        ((lane(-1, width(3.5, s=20)),), "no width before sOffset = 20 m"),
        ((lane(-1, width(3.5), width(3.0, s=200)),), "at sOffset = 200 m begins beyond it"),
        ((lane(-1, width(-1.0)),), "its width is negative (-1 m)"),
    ],
)
def test_widths_that_contradict_are_warnings(lanes: tuple[str, ...], said: str) -> None:
    assert said in "\n".join(straight(sections=section(lane(0), *lanes)).warnings)


@pytest.mark.parametrize(
    ("road", "said"),
    [
        (a_road("1", line(100.0), length=60), "length is 60 m, but its planView has 100 m"),
        (a_road("1", line(100.0), length=160), "length is 160 m, but its planView has 100 m"),
        (a_road("1", line(50.0), line(50.0, s=60, x=50), length=110), "begins at s = 60 m"),
        (a_road("1", line(50.0), line(50.0, s=50, x=55)), "jumps by 5.00 m at s = 50 m"),
        (a_road("1", line(50.0), sections=section(lane(0), lane(-1), s=9)), "no lanes before it"),
        (
            a_road("1", line(50.0), sections=section(lane(-1)) + section(lane(-1), s=70)),
            "the laneSection at s = 70 m begins beyond its road",
        ),
    ],
)
def test_lengths_that_contradict_are_warnings(road: str, said: str) -> None:
    assert said in "\n".join(read(road).warnings)


@pytest.mark.data
@pytest.mark.parametrize("name", ["fabriksgatan", "multi_intersections"])
def test_without_one_direction_of_a_link_a_map_has_the_same_lane_graph_or_a_warning(
    data: Path, name: str
) -> None:
    text = (data / f"maps/{name}.xodr").read_text(encoding="utf-8")
    whole = parse_map(text, name)
    places = [found.span() for found in LINKS.finditer(text)]
    for start, end in random.Random(1).sample(places, 12):
        road_map = parse_map(text[:start] + text[end:], name)
        told = {*road_map.warnings} - {*whole.warnings}
        assert travels(road_map) == travels(whole) or told, text[start:end]
