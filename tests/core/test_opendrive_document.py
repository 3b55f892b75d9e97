"""Hostile and broken maps: a clear error, in bounded time and memory, or a map without the broken road."""

from __future__ import annotations

import contextlib
import re
import tracemalloc
from typing import TYPE_CHECKING

import numpy as np
import pytest
from counting import calls
from opendrive_maps import (
    a_map,
    a_road,
    arc,
    cubic,
    element,
    geometry,
    lane,
    line,
    link,
    param_poly3,
    section,
    spiral,
    width,
)

import sgstore.graphs.relations._extent as extent
import sgstore.maps.opendrive._document as document
import sgstore.maps.opendrive._lanes as lanes
from sgstore.base import markup
from sgstore.errors import MapError
from sgstore.graphs.relations._extent import LaneHeights
from sgstore.maps.opendrive import read_map

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

GOOD = a_road("good", line(100.0))

NO_MAPS = {
    "nothing": ("", "not XML"),
    "no XML": ("hello", "not XML"),
    "another XML": ("<svg/>", "expected <OpenDRIVE>"),
    "cut off": (a_map(GOOD)[:-30], "not XML"),
    "two roots": (a_map(GOOD) + a_map(GOOD), "not XML"),
    "a tag that closes another": ("<OpenDRIVE><road></OpenDRIVE>", "not XML"),
    "an attribute twice": ('<OpenDRIVE><road id="1" id="2"/></OpenDRIVE>', "not XML"),
    "a NUL character": (a_map(GOOD).replace("test", "te\0st"), "not XML"),
    "a lone surrogate": (a_map(GOOD).replace("test", "\ud800"), "surrogate"),
    "an undefined entity": ("<OpenDRIVE>&xxe;</OpenDRIVE>", "not XML"),
    "a document type": ("<!DOCTYPE OpenDRIVE><OpenDRIVE/>", "document type"),
    "entities that multiply": (
        '<!DOCTYPE z [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]><OpenDRIVE>&b;</OpenDRIVE>',
        "document type",
    ),
    "an entity from outside": (
        '<!DOCTYPE z [<!ENTITY x SYSTEM "file:///etc/passwd">]><OpenDRIVE>&x;</OpenDRIVE>',
        "document type",
    ),
    "a million levels": ("<OpenDRIVE>" + "<a>" * 1_000_000, "64 levels"),
    "many attributes": (
        "<OpenDRIVE><road " + " ".join(f'a{i}="1"' for i in range(5000)) + "/></OpenDRIVE>",
        "5000 attributes",
    ),
    "no road": (a_map(), "has no road"),
}


@pytest.mark.parametrize(("text", "reason"), NO_MAPS.values(), ids=NO_MAPS)
def test_what_is_no_map_is_refused_with_the_reason(text: str, reason: str) -> None:
    with calls() as counted, pytest.raises(MapError, match=reason):
        read_map(text, "broken")

    assert counted.total() < 5_000


BROKEN_ROADS = {
    "no planView": (a_road("bad", length=10.0), "no geometry", "road"),
    "no lane section": (a_road("bad", line(9.0), sections=" "), "no laneSection", "road"),
    "a negative length": (a_road("bad", line(9.0), length=-1.0), "negative", "road"),
    "no length": (
        a_road("bad", line(9.0)).replace('length="9.0" junction', "junction"),
        "missing",
        "road",
    ),
    "a length of words": (
        a_road("bad", line(9.0)).replace('length="9.0"><line', 'length="nine"><line'),
        "'length'",
        "geometry",
    ),
    "NaN for a place": (
        a_road("bad", line(9.0, x=float("nan"))),
        "'x' is not a finite",
        "geometry",
    ),
    "infinity for a heading": (a_road("bad", line(9.0, hdg=float("inf"))), "'hdg'", "geometry"),
    "an unknown curve": (
        a_road("bad", geometry(9.0, "<bezier/>")),
        "line, arc, spiral",
        "geometry",
    ),
    "an arc around an atom": (a_road("bad", arc(1e6, 1e6)), "points", "road"),
    "a road to the moon": (a_road("bad", line(3.8e8)), "points", "road"),
    "a road on the moon": (a_road("bad", line(9.0, x=3.8e8)), "farther", "road"),
    "an arc without curvature": (
        a_road("bad", geometry(9.0, "<arc/>")),
        "'curvature' is missing",
        "arc",
    ),
    "half a paramPoly3": (
        a_road("bad", geometry(9.0, '<paramPoly3 aU="0"/>')),
        "missing",
        "paramPoly3",
    ),
    "a huge polynomial": (
        a_road("bad", param_poly3(9.0, (0, 1e11, 0, 0), (0, 0, 0, 1e11))),
        "farther|points",
        "road",
    ),
    "a lane as wide as a sea": (
        a_road("bad", line(9.0), sections=section(lane(0), lane(-1, width(1e9)))),
        "farther",
        "road",
    ),
    "a wild width": (
        a_road("bad", line(900.0), sections=section(lane(0), lane(-1, width(0, 0, 0, 1e11)))),
        "farther|points",
        "road",
    ),
    "a lane without an id": (
        a_road("bad", line(9.0), sections=section(lane(-1).replace('id="-1"', ""))),
        "'id'",
        "lane",
    ),
    "a lane with half an id": (
        a_road("bad", line(9.0), sections=section(lane(-1).replace('id="-1"', 'id="-1.5"'))),
        "whole",
        "lane",
    ),
    "two lanes of one id": (
        a_road("bad", line(9.0), sections=section(lane(-1), lane(-1))),
        "two lanes",
        "lane",
    ),
    "a section that starts nowhere": (
        a_road("bad", line(9.0), sections=section(lane(-1)).replace('s="0"', "")),
        "'s' is missing",
        "laneSection",
    ),
}


@pytest.mark.parametrize(("road", "reason", "tag"), BROKEN_ROADS.values(), ids=BROKEN_ROADS)
def test_a_broken_road_is_refused_by_name(road: str, reason: str, tag: str) -> None:
    with pytest.raises(MapError, match=reason) as caught:
        read_map(a_map(road), "broken")

    assert caught.value.road == "bad"
    assert (caught.value.element or "").split("/")[-1] == tag


@pytest.mark.parametrize(("road", "reason", "tag"), BROKEN_ROADS.values(), ids=BROKEN_ROADS)
def test_a_map_is_used_without_its_broken_road_and_says_so(
    road: str, reason: str, tag: str
) -> None:
    road_map = read_map(a_map(GOOD, road, a_road("other", line(50.0, y=20.0))), "mixed")

    assert {road for road in road_map.nodes.road if road} == {"good", "other"}
    assert len(road_map.warnings) == 1
    assert "road 'bad'" in road_map.warnings[0]


def test_several_defects_of_several_kinds_cost_only_their_roads() -> None:
    roads = [
        road.replace('"bad"', f'"bad{i}"') for i, (road, _, _) in enumerate(BROKEN_ROADS.values())
    ]

    road_map = read_map(a_map(*roads, GOOD), "mixed")

    assert road_map.nodes.name[1:3] == ("good/0/-1", "good")
    assert len(road_map.warnings) == len(roads)


HURT = {
    "NaN": "nan",
    "Windows' NaN": "-1.#IND",
    "infinity": "inf",
    "a word": "wide",
    "nothing": "",
    "beyond all": "1e300",
}


@pytest.mark.parametrize("number", HURT.values(), ids=HURT)
@pytest.mark.parametrize("attribute", ["a", "b", "c", "d", "s"])
@pytest.mark.parametrize("kind", ["width", "border", "elevation", "laneOffset"])
def test_a_broken_record_costs_itself_and_the_one_before_it_holds_on(
    kind: str, attribute: str, number: str
) -> None:
    def road(name: str, *records: str) -> str:
        of_lanes = records if kind in {"width", "border"} else (width(3.5),)
        around = {kind.replace("laneOffset", "offset"): "".join(records)}
        return a_road(
            name,
            line(30.0),
            sections=section(lane(0), lane(-1, "".join(of_lanes)), lane(-2, width(2.0))),
            **(around if kind in {"elevation", "laneOffset"} else {}),
        )

    key = "s" if kind in {"elevation", "laneOffset"} else "sOffset"
    whole = cubic(kind, 3.0 if kind == "width" else -3.0, 0.01, **{key: 0})
    attribute = key if attribute == "s" else attribute
    hurt = cubic(kind, -4.0, **{key: 12}).replace(f'{attribute}="', f'{attribute}="{number}" x="')

    plain = read_map(a_map(GOOD, road("other", whole)), "whole")
    found = read_map(
        a_map(GOOD, road("other", whole, hurt), BROKEN_ROADS["no planView"][0]), "hurt"
    )

    assert found.nodes.name == plain.nodes.name
    for column in ("x", "y", "z", "width", "length"):
        expected = pytest.approx(getattr(plain.nodes, column), nan_ok=True)
        assert getattr(found.nodes, column) == expected, column
    told = [warning for warning in found.warnings if "'other'" in warning]
    assert len(told) == 1, found.warnings
    assert kind in told[0]
    assert "left out" in told[0]
    assert len(found.warnings) == 2


def test_a_lane_whose_only_width_is_broken_costs_no_road_and_records_are_counted() -> None:
    lanes = lane(0), lane(-1, width(float("nan")) + width(float("inf"), s=3)), lane(-2)

    road_map = read_map(a_map(a_road("1", line(9.0), sections=section(*lanes))), "m")

    assert {"1/0/-2", "1"} <= {*road_map.nodes.name}
    assert "it and 1 more are left out" in road_map.warnings[0]
    assert road_map.warnings[1:] == ("lane 1/0/-1: no width, which counts as 0",)


@pytest.mark.data
def test_one_width_that_is_not_finite_costs_a_town_nothing_else(data: Path) -> None:
    text = (data / "maps/Town01.xodr").read_text("utf-8")
    plain = read_map(text, "town")
    widths = [m.start() for m in re.finditer(r'<width sOffset="[^0]', text)]
    at = widths[len(widths) // 2]
    hurt = text[:at] + text[at:].replace(' a="', ' a="-nan(ind)" was="', 1)

    found = read_map(hurt, "town")

    assert found.nodes.name == plain.nodes.name
    assert len(found.warnings) == len(plain.warnings) + 1
    assert "width>: attribute 'a' is not a finite number" in " ".join(found.warnings)


def test_links_that_lead_nowhere_cost_no_road_and_are_said() -> None:
    onward = section(lane(0), lane(-1, after=-7)) + section(lane(0), lane(-1, after=-1), s=5)
    links = link("successor", "road", "gone", "start") + link("predecessor", "junction", "none")

    road_map = read_map(a_map(a_road("1", line(9.0), sections=onward, links=links)), "loose ends")

    assert "1/0/-1" in road_map.nodes.name
    assert [w for w in road_map.warnings if "missing lane -7" in w]
    assert [w for w in road_map.warnings if "missing road 'gone'" in w]
    assert [w for w in road_map.warnings if "missing junction 'none'" in w]
    assert [w for w in road_map.warnings if "lane 1/1/-1 leads nowhere" in w] == []
    assert len(road_map.warnings) == 3


def test_sections_for_one_side_are_said() -> None:
    sections = section(lane(1), lane(0), lane(-1)).replace(
        "<laneSection", '<laneSection singleSide="true"'
    )

    road_map = read_map(a_map(a_road("1", line(9.0), sections=sections)), "one-sided")

    assert "one side" in road_map.warnings[0]


def test_a_broken_signal_or_object_costs_neither_road_nor_the_others() -> None:
    signal = element("signal", id="s1", s="here", t="0", type="206", orientation="+", dynamic="no")
    good = element("signal", id="s2", s="5", t="-4", type="206", orientation="+", dynamic="no")
    thing = element("object", id="o1", s="5", t="inf", type="tree")

    road_map = read_map(
        a_map(a_road("1", line(9.0), signals=signal + good, objects=thing)), "furniture"
    )

    assert "s2" in road_map.nodes.name
    assert "s1" not in road_map.nodes.name
    assert sorted("s1" in w or "o1" in w for w in road_map.warnings) == [True, True]


def test_the_number_of_elements_and_characters_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(document, "MAX_MAP_ELEMENTS", 10)
    with pytest.raises(MapError, match="more than 10 elements"):
        read_map(a_map(GOOD), "long")

    monkeypatch.setattr(markup, "MAX_CHARACTERS", 100)
    with pytest.raises(MapError, match="may have 100"):
        read_map(a_map(GOOD), "long")


def test_what_encoding_a_text_once_had_does_not_matter() -> None:
    text = '<?xml version="1.0" encoding="ISO-8859-1"?>' + a_map(a_road("Straße", line(9.0)))

    assert read_map(text, "").nodes.name[1] == "Straße/0/-1"


def test_a_map_without_a_name_has_the_name_in_its_header_or_its_digest() -> None:
    named, nameless = a_map(GOOD), a_map(GOOD).replace("test", "")

    assert read_map(named, "").name == "test"
    assert read_map(named, "mine").name == "mine"
    road_map = read_map(nameless, "")
    assert road_map.digest.startswith(road_map.name)
    assert len(road_map.name) == 12


@pytest.mark.data
def test_a_real_map_cut_anywhere_is_refused_and_never_breaks(data: Path) -> None:
    text = (data / "maps/fabriksgatan_traffic_lights.xodr").read_text(encoding="utf-8")

    for end in range(0, len(text) - 20, len(text) // 40):
        with pytest.raises(MapError):
            read_map(text[:end], "cut")


@pytest.mark.data
def test_a_real_map_with_any_number_made_nonsense_is_still_read_or_refused(data: Path) -> None:
    text = (data / "maps/soderleden.xodr").read_text(encoding="utf-8")
    quotes = [i for i, c in enumerate(text) if c == '"'][::2][12::37]

    for start in quotes:
        end = text.index('"', start + 1)
        for nonsense in ("", "nan", "-1e308", "x"):
            with contextlib.suppress(MapError):
                read_map(text[: start + 1] + nonsense + text[end:], "nonsense")


def things(number: int) -> str:
    strip = element(
        "repeat", s=0, length=50, distance=0, tStart=3, tEnd=3, zOffsetStart=0, zOffsetEnd=0
    )
    return "".join(element("object", strip, id=f"o{i}", s=0, t=0) for i in range(number))


def ring_of_atoms(number: int) -> str:
    """Very short roads, each leading to the next and the last to the first."""
    through = section(lane(0), lane(-1, before=-1, after=-1))
    return a_map(
        *(
            a_road(
                str(i),
                line(1e-4),
                sections=through,
                links=link("successor", "road", str((i + 1) % number), "start"),
            )
            for i in range(number)
        )
    )


def many_lanes(number: int, *records: str) -> str:
    return section(*(lane(-i, width(0.1), *records) for i in range(1, number + 1)))


HEAVY = {
    "strips on every road": lambda: a_map(
        *(a_road(str(i), line(100.0, y=10 * i), objects=things(4)) for i in range(500))
    ),
    "a junction in which everything crosses": lambda: a_map(
        *(a_road(str(i), line(100.0), junction="9") for i in range(2500)), '<junction id="9"/>'
    ),
    "a section of ten thousand lanes": lambda: a_map(
        GOOD, a_road("bad", line(9.0), sections=many_lanes(10_000))
    ),
    "records that cut a thousand lanes to pieces": lambda: a_map(
        GOOD,
        a_road(
            "bad",
            line(90.0),
            sections=many_lanes(900),
            elevation="".join(cubic("elevation", 0.0, s=i / 50) for i in range(4000)),
        ),
    ),
    "an outline of many corners, often": lambda: a_map(
        a_road(
            "1",
            line(9.0),
            objects=element(
                "object",
                element("outline", *(element("cornerLocal", u=i, v=i * i % 7) for i in range(9000))),
                element("repeat", s=0, length=50, distance=0.1),
                id="o", s=0, t=0,
            ),
        )
    ),
    "references from many lanes": lambda: a_map(
        a_road(
            "1",
            line(9.0),
            sections=many_lanes(900),
            signals=element("signalReference", id="s", s=1, t=0, orientation="none") * 5000,
        )
    ),
    "junctions full of connections": lambda: a_map(
        *(a_road(str(i), line(9.0), links=link("successor", "junction", "9")) for i in range(100)),
        element(
            "junction",
            *(
                element(
                    "connection",
                    element("laneLink", **{"from": -1, "to": -1}),
                    incomingRoad=i % 100,
                    connectingRoad=i // 100,
                    contactPoint="start",
                )
                for i in range(10_000)
            ),
            id="9",
        ),
    ),
    "elements that mean nothing": lambda: f"<OpenDRIVE>{'<a/>' * 300_000}{GOOD}</OpenDRIVE>",
}  # fmt: skip


@pytest.mark.parametrize("text", HEAVY.values(), ids=HEAVY)
def test_heavy_maps_take_bounded_work(text: Callable[[], str]) -> None:
    heavy = text()
    tracemalloc.start()

    with calls() as counted, contextlib.suppress(MapError):
        read_map(heavy, "heavy")

    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert counted.total() < 10_000_000
    assert peak < 48 << 20


def one_lane(*widths: float) -> str:
    return section(lane(0), lane(-1, width(*widths)))


ONE_WRONG_NUMBER = {
    "a border that runs away": (one_lane(2.5, 0, 0, 50), 120.0),
    "one as wide as a village": (one_lane(30.0), 1.2e6),
    "a road around the world": (one_lane(3.5), 4e7),
}


@pytest.mark.parametrize(("lanes", "length"), ONE_WRONG_NUMBER.values(), ids=ONE_WRONG_NUMBER)
def test_one_wrong_number_takes_bounded_memory(lanes: str, length: float) -> None:
    """A look-up of lanes took up to 2.4 kB a cross section, of which one road could have a million."""
    text = a_map(GOOD, a_road("wrong", line(length, y=50.0), sections=lanes))
    tracemalloc.start()

    road_map = read_map(text, "wrong")
    hits = road_map.lanes_of(np.array([[50.0, -1.5, 0.0, 4.0, 2.0]]), np.zeros(1))

    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 300 << 20
    assert hits.lane.tolist() == [-2]
    assert not road_map.warnings or "road 'wrong', <road>: so bent" in road_map.warnings[0]


def test_heights_of_endless_lanes_are_looked_at_farther_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    far = read_map(a_map(GOOD, a_road("far", line(100_000.0, y=50.0))), "far")
    assert len(LaneHeights.of(far).points) == 51 + 50_001
    monkeypatch.setattr(extent, "MOST_POINTS", 1000)

    found = LaneHeights.of(far)

    assert 1000 <= len(found.points) <= 1002
    assert np.diff(found.first).tolist() == [1, 1000]


def test_a_longer_text_may_tell_more(monkeypatch: pytest.MonkeyPatch) -> None:
    roads = [a_road(str(i), line(100.0, y=9 * i)) for i in range(20)]  # 22 cross sections each
    monkeypatch.setattr(lanes, "MAX_OF_SMALL", 400)

    assert not read_map(a_map(*roads), "long").warnings
    monkeypatch.setattr(lanes, "CHARACTERS", 50)
    with pytest.raises(MapError, match="over 400 points"):
        read_map(a_map(*roads), "short")


def test_lanes_that_lead_in_circles_have_an_end() -> None:
    road_map = read_map(ring_of_atoms(300), "ring")

    with calls() as counted:
        lane_, *_ = road_map.downstream(1.0)

    assert counted.total() < 100_000
    assert len(lane_) == 300 * 300


def test_a_map_of_too_many_points_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "MAX_TOTAL", 100)

    with pytest.raises(MapError, match="over 100 points"):
        read_map(a_map(*(a_road(str(i), line(100.0)) for i in range(20))), "large")


def test_a_road_whose_bend_is_no_number_is_refused_by_name() -> None:
    bad = a_road("bad", line(100), spiral(1e-300, 0.015, 0, s=100, x=100), length=120)

    road_map = read_map(a_map(GOOD, bad), "bent")

    assert "road 'bad', <road>: so bent" in road_map.warnings[0]


def test_a_crowd_of_lanes_and_a_crowd_of_crossings_are_refused_by_name() -> None:
    crowd = a_map(GOOD, a_road("bad", line(9.0), sections=many_lanes(1100)))
    knot = HEAVY["a junction in which everything crosses"]()

    assert "more than 1,000 lanes" in read_map(crowd, "crowd").warnings[0]
    with pytest.raises(MapError, match="pairs of lanes in junctions"):
        read_map(knot, "knot")


def test_two_roads_of_one_id_are_both_there_and_said() -> None:
    road_map = read_map(a_map(GOOD, a_road("good", line(10.0, y=20.0))), "twins")

    assert road_map.nodes.name.count("good/0/-1") == 2
    assert "two of this id" in road_map.warnings[0]
