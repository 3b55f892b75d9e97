"""Plain lanes as text: what is written is what is read, and nothing in a text is trusted."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opendrive_maps import a_map, a_road, line
from thorough import share_of

from sgstore.errors import MapError
from sgstore.maps.opendrive import parse_map, read_map
from sgstore.maps.roads import PlainLane, RoadMap, lane_text
from sgstore.model.vocabulary import KINDS, RELATION_CODE


def strip(x: float = 0.0, y: float = 0.0, n: int = 3, **more: Any) -> PlainLane:
    """A lane along x, 3 m wide, 10 m from cross section to cross section."""
    along = x + 10.0 * np.arange(n)
    left, right = (np.column_stack((along, np.full(n, y + side))) for side in (1.5, -1.5))
    names = {"name": "a", "type": "driving", "road": "1", "junction": "", "section": 0, "number": 0}
    return PlainLane(**(names | {"left": left, "right": right, "z": np.zeros(n)} | more))


def pairs(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE[relation])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


TWO = [
    strip(name="a", onto=(1,), left_beside=(2,), against=(2,), changes=((1, 2.0, 7.5),)),
    strip(20.0, name="b", road="2", junction="j", speed_limit=13.5),
    strip(0.0, 3.0, name="c"),
]


def test_a_text_of_lanes_becomes_the_map_that_the_lanes_make() -> None:
    road_map = read_map(lane_text(TWO, ["lane d: left out"]), "two")
    nodes = road_map.nodes

    assert nodes.name == ("off_road", "a", "b", "c", "1", "2", "j")
    assert [KINDS[code] for code in nodes.kind] == [
        "off_road", "lane", "lane", "lane", "road", "road", "junction"
    ]  # fmt: skip
    assert nodes.length[1:6].tolist() == pytest.approx([20.0] * 5)
    assert nodes.width[1:4].tolist() == pytest.approx([3.0] * 3)
    assert nodes.speed_limit[2] == 13.5
    assert nodes.turn[1:4] == ("", "straight", "")
    assert pairs(road_map, "travelsTo") == {("a", "b")}
    assert pairs(road_map, "toLeftOf") == {("c", "a")}
    assert pairs(road_map, "opposes") == {("c", "a"), ("a", "c")}
    assert pairs(road_map, "isIn") == {("a", "1"), ("b", "2"), ("c", "1"), ("2", "j")}
    changes = road_map.lane_changes
    assert (changes.lane[0], changes.to[0]) == (0, 1)
    assert (changes.start[0], changes.end[0]) == (2.0, 7.5)
    assert road_map.warnings == ("lane d: left out",)
    assert road_map.name == "two"


coordinates = st.floats(-1e6, 1e6)


@given(
    corners=st.lists(st.tuples(*[coordinates] * 5), min_size=2, max_size=6),
    name=st.text(max_size=20),
    onto=st.lists(st.integers(0, 1), max_size=3),
)
@settings(max_examples=share_of(50), deadline=None)
def test_what_is_read_back_from_a_text_is_what_was_there_to_the_last_bit(
    corners: list[tuple[float, ...]], name: str, onto: list[int]
) -> None:
    table = np.array(corners)
    lane = strip(left=table[:, :2], right=table[:, 2:4], z=table[:, 4], name=name, onto=tuple(onto))
    text = lane_text([lane, strip()])

    one = parse_map(text, "one")

    assert parse_map(one.text, "one").digest == one.digest
    assert one.nodes.name[1] == name
    ribbons = one.ribbons
    columns = (ribbons.left_x, ribbons.left_y, ribbons.right_x, ribbons.right_y, ribbons.z)
    read = np.column_stack(columns)[: len(table)]
    assert np.abs(read - table).max() <= 0.5001e-4
    again = strip(left=read[:, :2], right=read[:, 2:4], z=read[:, 4], name=name, onto=tuple(onto))
    assert lane_text([again, strip()]) == text


def test_a_map_that_was_read_is_known_by_its_content() -> None:
    lanes, roads = lane_text(TWO), a_map(a_road("1", line(30.0)))

    for text in (lanes, roads):
        assert read_map(text, "known") is read_map("".join(list(text)), "known")
        assert parse_map(text, "known") is not read_map(text, "known")
        assert read_map(text, "known") is not read_map(text, "other")
    assert read_map(lanes, "").name == read_map(lanes, "known").digest[:12]


def changed(**fields: Any) -> str:
    """The text with other fields in its first lane; ``None`` takes one out."""
    document = json.loads(lane_text(TWO))
    lane = document["lanes"][0] | fields
    document["lanes"][0] = {key: value for key, value in lane.items() if value is not None}
    return json.dumps(document)


def head(**fields: Any) -> str:
    return json.dumps(json.loads(lane_text(TWO)) | fields)


BROKEN = {
    "no JSON": ("{", "neither OpenDRIVE nor"),
    "another JSON": ("{}", "no format"),
    "a million levels": ('{"lanes": ' + "[" * 1_000_000, "neither OpenDRIVE nor"),
    "a number of a million digits": (
        '{"format": ' + "9" * 1_000_000 + "}",
        "neither OpenDRIVE nor",
    ),
    "NaN": (lane_text(TWO).replace("1.5", "NaN"), "NaN is not a number"),
    "infinity": (lane_text(TWO).replace("1.5", "-Infinity"), "Infinity is not a number"),
    "another version": (head(version=2), "version 2; expected 1"),
    "no lanes": (head(lanes=[]), "1 to 100,000 lanes"),
    "lanes of another kind": (head(lanes={}), "1 to 100,000 lanes"),
    "a lane that is none": (head(lanes=[1]), "lane 0 is not an object"),
    "warnings that are none": (head(warnings=[1]), "list of texts"),
    "a name that is none": (changed(name=7), "lane 0: expected a text"),
    "a name as long as a book": (changed(name="x" * 1000), "at most 200 characters"),
    "half a section": (changed(section=1.5), "a whole number"),
    "true for a number": (changed(number=True), "a whole number"),
    "no left side": (changed(left=None), "numbers, an even number of them"),
    "half a point": (changed(left=[1, 2, 3]), "an even number"),
    "words for places": (changed(left=["a", "b", "c", "d"]), "numbers"),
    "a place beyond all": (changed(left=[1e300] * 6), "farther than"),
    "a number too large for one": (changed(z=[10**400] * 3), "numbers"),
    "sides of different lengths": (changed(z=[0, 0]), "as many cross sections"),
    "one cross section": (changed(left=[0, 1], right=[0, 0], z=[0]), "two at least"),
    "a lane that is not there": (changed(onto=[3]), "0 to 2"),
    "a lane before the first": (changed(against=[-1]), "0 to 2"),
    "words for lanes": (changed(onto="012"), "numbers of lanes"),
    "too many lanes": (changed(left_beside=[1] * 2000), "at most 1000"),
    "a change to nowhere": (changed(changes=[[9, 0, 1]]), "stretches"),
    "a change that ends before it starts": (changed(changes=[[1, 5, 1]]), "stretches"),
    "a change of words": (changed(changes=[["1", 0, 1]]), "stretches"),
    "half a change": (changed(changes=[[1, 0]]), "stretches"),
    "a speed of light": (changed(speed_limit=3e8), "a speed"),
}


@pytest.mark.parametrize(("text", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_text_of_lanes_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        read_map(text, "broken")


def test_the_length_of_a_text_of_lanes_is_bounded() -> None:
    text = lane_text(TWO) + " " * (128 << 20)

    with pytest.raises(MapError, match="a text of lanes may have 67,108,864"):
        parse_map(text, "long")
