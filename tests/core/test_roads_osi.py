"""Lanes of OSI ground truth as road maps: by the standard's words, and beside the OpenDRIVE behind them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pytest
import recordings
from mcap.reader import make_reader
from recordings import Recorder, car

import sgstore
import sgstore.maps.roads._lane_lines as lanelines
import sgstore.maps.roads._lane_text as lanetext
from sgstore.draw._stored import map_of
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import RELATION_CODE
from sgstore.readers import open_trace
from sgstore.readers.osi._lanes import OsiLanes

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

TYPES = {
    "Pair": "antecessor_lane_id=1:Identifier successor_lane_id=2:Identifier",
    "LaneClassification": "type=1:LaneType centerline=3:Vector3d* centerline_is_driving_direction=4:bool"
    " left_adjacent_lane_id=5:Identifier* right_adjacent_lane_id=6:Identifier* lane_pairing=7:Pair*"
    " right_lane_boundary_id=8:Identifier* left_lane_boundary_id=9:Identifier* subtype=12:Subtype",
    "Lane": "id=1:Identifier classification=2:LaneClassification source_reference=3:ExternalReference*",
    "BoundaryPoint": "position=1:Vector3d width=2:double",
    "BoundaryClassification": "type=1:BoundaryType",
    "LaneBoundary": "id=1:Identifier boundary_line=2:BoundaryPoint*"
    " classification=3:BoundaryClassification",
    "LogicalPoint": "position=1:Vector3d s_position=2:double t_position=3:double",
    "LogicalLaneBoundary": "id=1:Identifier boundary_line=2:LogicalPoint*"
    " physical_boundary_id=4:Identifier* passing_rule=5:PassingRule",
    "Relation": "other_lane_id=1:Identifier start_s=2:double end_s=3:double",
    "Connection": "other_lane_id=1:Identifier at_begin_of_other_lane=2:bool",
    "PhysicalReference": "physical_lane_id=1:Identifier",
    "LogicalLane": "id=1:Identifier type=2:LogicalType source_reference=3:ExternalReference*"
    " physical_lane_reference=4:PhysicalReference* start_s=6:double end_s=7:double"
    " move_direction=8:MoveDirection right_adjacent_lane=9:Relation* left_adjacent_lane=10:Relation*"
    " right_boundary_id=12:Identifier* left_boundary_id=13:Identifier*"
    " predecessor_lane=14:Connection* successor_lane=15:Connection*",
    "GroundTruth": recordings.TYPES["GroundTruth"] + " lane_boundary=9:LaneBoundary*"
    " logical_lane_boundary=18:LogicalLaneBoundary* logical_lane=19:LogicalLane*",
}  # fmt: skip
ENUMS = {
    "LaneType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_DRIVING=2 TYPE_NONDRIVING=3 TYPE_INTERSECTION=4",
    "Subtype": "SUBTYPE_UNKNOWN=0 SUBTYPE_OTHER=1 SUBTYPE_NORMAL=2 SUBTYPE_BIKING=3"
    " SUBTYPE_SIDEWALK=4 SUBTYPE_PARKING=5 SUBTYPE_ONRAMP=12",
    "BoundaryType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_NO_LINE=2 TYPE_SOLID_LINE=3 TYPE_DASHED_LINE=4",
    "LogicalType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_NORMAL=2 TYPE_SIDEWALK=4 TYPE_MEDIAN=15",
    "MoveDirection": "MOVE_DIRECTION_UNKNOWN=0 MOVE_DIRECTION_OTHER=1 MOVE_DIRECTION_INCREASING_S=2"
    " MOVE_DIRECTION_DECREASING_S=3 MOVE_DIRECTION_BOTH_ALLOWED=4",
    "PassingRule": "PASSING_RULE_UNKNOWN=0 PASSING_RULE_OTHER=1 PASSING_RULE_NONE_ALLOWED=2"
    " PASSING_RULE_INCREASING_T=3 PASSING_RULE_DECREASING_T=4 PASSING_RULE_BOTH_ALLOWED=5",
}  # fmt: skip
with patch.dict(recordings.TYPES, TYPES), patch.dict(recordings.ENUMS, ENUMS):
    OSI = recordings.Osi()

DRIVING, NONDRIVING, INTERSECTION = 2, 3, 4
NO_LINE, SOLID, DASHED = 2, 3, 4
Points = list[tuple[float, float]]


def identify(field: Any, *idents: int) -> None:
    for ident in idents:
        field.add().value = ident


class Truth:
    """A ground truth, lane by lane."""

    def __init__(self) -> None:
        self.ground = OSI.GroundTruth()

    def boundary(self, ident: int, points: Points, kind: int = DASHED) -> Truth:
        boundary = self.ground.lane_boundary.add()
        boundary.id.value = ident
        boundary.classification.type = kind
        for x, y in points:
            boundary.boundary_line.add().position.x = x
            boundary.boundary_line[-1].position.y = y
        return self

    def lane(  # noqa: PLR0917
        self,
        ident: int,
        points: Points,
        kind: int = DRIVING,
        subtype: int = 2,
        along: bool | None = True,
        beside: tuple[tuple[int, ...], tuple[int, ...]] = ((), ()),
        borders: tuple[tuple[int, ...], tuple[int, ...]] = ((), ()),
        pairs: tuple[tuple[int | None, int | None], ...] = (),
        source: tuple[str, ...] = (),
    ) -> Truth:
        lane = self.ground.lane.add()
        lane.id.value = ident
        about = lane.classification
        about.type, about.subtype = kind, subtype
        if along is not None:
            about.centerline_is_driving_direction = along
        for x, y in points:
            about.centerline.add(x=x, y=y, z=1.0)
        identify(about.left_adjacent_lane_id, *beside[0])
        identify(about.right_adjacent_lane_id, *beside[1])
        identify(about.left_lane_boundary_id, *borders[0])
        identify(about.right_lane_boundary_id, *borders[1])
        for before, after in pairs:
            pair = about.lane_pairing.add()
            if before is not None:
                pair.antecessor_lane_id.value = before
            if after is not None:
                pair.successor_lane_id.value = after
        if source:
            lane.source_reference.add(type="net.asam.opendrive", identifier=source)
        return self

    def border(
        self, ident: int, points: list[tuple[float, float, float]], rule: int = 0, *lines: int
    ) -> Truth:
        """A logical boundary, its points with their s."""
        border = self.ground.logical_lane_boundary.add()
        border.id.value, border.passing_rule = ident, rule
        identify(border.physical_boundary_id, *lines)
        for x, y, s in points:
            point = border.boundary_line.add(s_position=s)
            point.position.x, point.position.y, point.position.z = x, y, 2.0
        return self

    def logical(
        self,
        ident: int,
        span: tuple[float, float],
        borders: tuple[tuple[int, ...], tuple[int, ...]],
        **more: Any,
    ) -> Truth:
        lane = self.ground.logical_lane.add()
        lane.id.value, lane.type = ident, more.get("type", 2)
        lane.start_s, lane.end_s = span
        lane.move_direction = more.get("moves", 2)
        identify(lane.left_boundary_id, *borders[0])
        identify(lane.right_boundary_id, *borders[1])
        for other in more.get("left", ()):
            lane.left_adjacent_lane.add().other_lane_id.value = other
        for name in ("predecessor", "successor"):
            for other, at_begin in more.get(name, ()):
                connection = getattr(lane, f"{name}_lane").add(at_begin_of_other_lane=at_begin)
                connection.other_lane_id.value = other
        for physical in more.get("physical", ()):
            lane.physical_lane_reference.add().physical_lane_id.value = physical
        return self


def schema_of(files: Any = None, name: str = "osi3.GroundTruth") -> Any:
    return SimpleNamespace(name=name, data=(files or OSI.files).SerializeToString())


def made(*truths: Truth) -> RoadMap:
    lanes = OsiLanes(schema_of())
    for truth in truths:
        lanes.take(truth.ground.SerializeToString())
    return read_map(lanes.text()[0], "lanes")


def pairs(road_map: RoadMap, relation: str) -> set[tuple[str, str]]:
    edges, names = road_map.edges, road_map.nodes.name
    rows = np.flatnonzero(edges.relation == RELATION_CODE[relation])
    return {(names[-1 - edges.src[r]], names[-1 - edges.dst[r]]) for r in rows}


def two_way() -> Truth:
    """A street with two lanes eastwards, one westwards and a sidewalk; 5 and 6 lead on from the outer two."""
    street = Truth()
    for number, y in enumerate((-5.25, -1.75, 1.75, 5.25, 8.25)):
        street.boundary(10 + number, [(0, y), (100, y)], SOLID if number == 2 else DASHED)
    street.lane(
        1, [(0, -3.5), (100, -3.5)], beside=((2,), ()), borders=((11,), (10,)), pairs=((None, 5),)
    )
    street.lane(2, [(0, 0), (100, 0)], beside=((3,), (1,)), borders=((12,), (11,)))
    street.lane(
        3,
        [(0, 3.5), (100, 3.5)],
        along=False,
        beside=((4,), (2,)),
        borders=((13,), (12,)),
        pairs=((None, 6),),
    )
    street.lane(
        4,
        [(0, 6.75), (100, 6.75)],
        NONDRIVING,
        4,
        along=False,
        beside=((), (3,)),
        borders=((14,), (13,)),
    )
    street.lane(5, [(100, -3.5), (150, -3.5)], pairs=((1, None),))
    street.lane(6, [(100, 3.5), (150, 3.5)], along=False, pairs=((3, None),))
    return street  # fmt: skip


def test_physical_lanes_are_read_in_the_order_of_their_points_and_run_with_their_traffic() -> None:
    road_map = made(two_way())
    nodes = road_map.nodes

    assert nodes.name[1:7] == ("1", "2", "3", "4", "5", "6")
    assert nodes.lane_type[1:5] == ("driving", "driving", "driving", "sidewalk")
    assert np.abs(nodes.heading[1:5]).tolist() == pytest.approx([0, 0, np.pi, np.pi])
    assert nodes.width[1:5].tolist() == pytest.approx([3.5, 3.5, 3.5, 3.0])
    assert nodes.z[1] == pytest.approx(1.0)
    assert pairs(road_map, "travelsTo") == {("1", "5"), ("6", "3")}
    assert pairs(road_map, "opposes") == {("2", "3"), ("3", "2")}
    assert pairs(road_map, "toLeftOf") == {("2", "1"), ("3", "2"), ("2", "3"), ("3", "4")}
    assert pairs(road_map, "toRightOf") == {("1", "2"), ("4", "3")}
    assert pairs(road_map, "laneChange") == {("1", "2"), ("2", "1")}


def test_where_a_line_does_not_say_which_way_traffic_runs_it_runs_along() -> None:
    road_map = made(Truth().lane(1, [(0, 0), (50, 0)], along=None))

    assert road_map.nodes.heading[1] == 0


@pytest.mark.parametrize(
    ("kind", "subtype", "expected"),
    [
        (DRIVING, 2, "driving"),
        (DRIVING, 1, "driving"),
        (DRIVING, 0, "driving"),
        (NONDRIVING, 0, "none"),
        (NONDRIVING, 3, "biking"),
        (NONDRIVING, 5, "parking"),
        (DRIVING, 12, "onRamp"),
        (INTERSECTION, 0, "driving"),
        (1, 1, "none"),
    ],
)
def test_the_type_of_a_lane_is_its_subtype_else_whether_it_is_for_driving(
    kind: int, subtype: int, expected: str
) -> None:
    road_map = made(Truth().lane(1, [(0, 0), (50, 0)], kind, subtype))

    assert road_map.nodes.lane_type[1] == expected


def test_an_intersection_without_lines_is_the_ways_through_it() -> None:
    truth = Truth().lane(1, [(-50, 0), (0, 0)], pairs=((None, 9),))
    truth.lane(2, [(20, 0), (70, 0)], pairs=((9, None),))
    truth.lane(3, [(10, 60), (10, 10)], along=False, pairs=((None, 9),))
    truth.lane(9, [], INTERSECTION, 0, along=None, pairs=((1, 2), (1, 3)))

    road_map = made(truth)

    assert pairs(road_map, "travelsTo") == {
        ("1", "9/0/1"),
        ("9/0/1", "2"),
        ("1", "9/0/2"),
        ("9/0/2", "3"),
    }
    nodes = road_map.nodes
    turns = dict(zip(nodes.name, nodes.turn, strict=True))
    assert (turns["9/0/1"], turns["9/0/2"]) == ("straight", "left")
    assert nodes.junction[nodes.name.index("9/0/1")] == "9"


@pytest.mark.parametrize(
    "source", [("7", "25.0", "-1"), ("road_id:7", "road_s:25", "lane_id:-1")], ids=["OSI", "esmini"]
)
def test_lanes_that_came_from_opendrive_keep_the_names_they_had(source: tuple[str, ...]) -> None:
    first = (source[0], source[1].replace("25.0", "0").replace("25", "0"), source[2])
    truth = Truth().lane(1, [(25, 0), (50, 0)], source=source)
    truth.lane(2, [(0, 0), (25, 0)], source=first)
    truth.lane(3, [(0, 9), (25, 9)], source=("x",))
    truth.lane(4, [(0, 19), (25, 19)], source=("1", "here", "there"))
    truth.lane(5, [(0, 29), (25, 29)], source=("1" * 500, "0", "1"))
    truth.lane(6, [(0, 39), (25, 39)], source=("1", "nan", "1"))

    nodes = made(truth).nodes

    assert nodes.name[1:7] == ("7/1/-1", "7/0/-1", "3", "4", "5", "6")
    assert nodes.road[1:3] == ("7", "7")
    assert (nodes.section[1], nodes.lane[1]) == (1, -1)
    assert nodes.length[nodes.name.index("7")] == pytest.approx(50)


def test_a_lane_is_told_by_the_first_message_that_has_it() -> None:
    first, second = Truth().lane(1, [(0, 0), (50, 0)]), Truth().lane(1, [(0, 9), (50, 9)])
    second.lane(2, [(50, 0), (90, 0)], pairs=((1, None),))

    road_map = made(first, second)

    assert road_map.nodes.y[1] == 0
    assert pairs(road_map, "travelsTo") == {("1", "2")}


# Logical lanes -------------------------------------------------------------------------------------


def logical_street(**changes: Any) -> Truth:
    """Two lanes along a reference line that starts at s = 100, the left one 3 m wide, then 4 m from s = 120."""
    truth = Truth()
    truth.boundary(50, [(0, 0.1), (50, 0.1)], SOLID).boundary(51, [(0, -0.1), (50, -0.1)], DASHED)
    truth.border(21, [(0, -3, 100), (50, -3, 150)])
    truth.border(22, [(0, 0, 100), (50, 0, 150)], changes.get("rule", 0), *changes.get("lines", ()))
    truth.border(23, [(0, 3, 100), (20, 3, 120), (20, 4, 120)])
    truth.border(24, [(20, 4, 120), (50, 4, 150)])
    truth.logical(
        1,
        (100, 150),
        ((22,), (21,)),
        left=(2,),
        successor=((3, False),),
        moves=changes.get("right_moves", 2),
    )
    truth.logical(2, (100, 150), ((23, 24), (22,)), moves=changes.get("left_moves", 2))
    truth.border(31, [(100, -3, 0), (50, -3, 50)]).border(32, [(100, 0, 0), (50, 0, 50)])
    truth.logical(3, (0, 50), ((31,), (32,)), moves=3, type=changes.get("type", 2))
    return truth  # fmt: skip


def test_logical_lanes_lie_between_their_borders_at_every_s() -> None:
    road_map = made(logical_street())
    nodes = road_map.nodes

    assert nodes.name[1:4] == ("1", "2", "3")
    assert nodes.length[1] == pytest.approx(50)
    assert nodes.z[1] == pytest.approx(2.0)
    left = road_map.ribbons.at(np.array([1, 1]), np.array([10.0, 45.0]))
    assert left.width.tolist() == pytest.approx([3.0, 4.0])
    assert nodes.heading[3] == pytest.approx(0.0)  # its reference line runs west, its traffic east
    assert pairs(road_map, "travelsTo") == {("1", "3")}
    assert pairs(road_map, "toLeftOf") == {("2", "1")}


@pytest.mark.parametrize(
    ("rule", "lines", "expected"),
    [
        (2, (), set()),
        (3, (), {("1", "2")}),
        (4, (), {("2", "1")}),
        (5, (), {("1", "2"), ("2", "1")}),
        (0, (51, 50), {("1", "2")}),  # from the right the dashed line comes first
        (0, (50,), set()),
        (1, (51,), {("1", "2"), ("2", "1")}),
        (0, (), set()),  # nothing is known
        (2, (51,), set()),  # the rule holds before the line
    ],
)
def test_lanes_may_be_changed_as_the_rule_says_else_as_the_lines_do(
    rule: int, lines: tuple[int, ...], expected: set[tuple[str, str]]
) -> None:
    assert pairs(made(logical_street(rule=rule, lines=lines)), "laneChange") == expected


def test_lanes_that_contradict_their_boundaries_are_warnings() -> None:
    truth = logical_street()
    truth.logical(4, (100, 190), ((22,), (21,)), moves=2, successor=((77, True),))
    truth.logical(5, (100, 150), ((22, 99), (21,)), moves=2)
    said = "\n".join(made(truth).warnings)

    assert "lane 4: s from 100 to 190 m, but its boundaries from 100 to 150 m" in said
    assert "4 to 77: linked to a missing lane" in said
    assert "boundaries of lanes are missing: logical_lane_boundary 99" in said


def test_traffic_on_logical_lanes_moves_as_they_say() -> None:
    against = made(logical_street(left_moves=3))
    both = made(logical_street(left_moves=4))
    other = made(logical_street(right_moves=1))

    assert abs(against.nodes.heading[2]) == pytest.approx(np.pi)
    assert pairs(against, "opposes") == {("1", "2"), ("2", "1")}
    assert pairs(both, "opposes") == {("1", "2"), ("2", "1")}
    assert other.nodes.heading[1] == 0


def test_physical_lanes_that_logical_lanes_are_made_of_are_not_there_twice() -> None:
    truth = logical_street()
    truth.lane(7, [(0, 0), (50, 0)], INTERSECTION, 0).lane(8, [(0, 50), (50, 50)])
    truth.ground.logical_lane[0].physical_lane_reference.add().physical_lane_id.value = 7

    nodes = made(truth).nodes

    assert set(nodes.name[1:5]) == {"1", "2", "3", "8"}
    assert nodes.junction[1] == "7"


# What is broken ------------------------------------------------------------------------------------


def test_a_broken_lane_is_left_out_and_said_and_the_others_stay() -> None:
    truth = two_way()
    truth.lane(70, [(0, 0), (float("nan"), 0)])
    truth.lane(71, [(0, 0), (1e300, 0)])
    truth.lane(72, [(0, 0)])
    truth.logical(73, (0, 10), ((99,), (98,)))
    truth.border(21, [(0, 0, 0), (10, 0, float("inf"))]).border(22, [(0, 3, 0), (10, 3, 10)])
    truth.logical(74, (0, 10), ((22,), (21,)))
    truth.border(25, [(0, 0, 0), (10, 0, 10)])
    truth.logical(75, (20, 30), ((22,), (25,)))
    truth.logical(76, (float("nan"), 30), ((22,), (25,)))

    road_map = made(truth)

    assert road_map.nodes.name[1:7] == ("1", "2", "3", "4", "5", "6")
    for ident in range(70, 77):
        assert [w for w in road_map.warnings if str(ident) in w], ident


def test_a_message_that_is_none_is_said() -> None:
    lanes = OsiLanes(schema_of())
    lanes.take(b"\xff\xff")
    lanes.take(Truth().lane(1, [(0, 0), (9, 0)]).ground.SerializeToString())

    assert [w for w in read_map(lanes.text()[0], "x").warnings if "cannot be read" in w]


def test_lanes_of_a_schema_that_lacks_what_they_need_are_said() -> None:
    old = recordings.OSI  # lanes there have nothing but a centre line
    ground = old.GroundTruth()
    ground.lane.add().id.value = 1
    lanes = OsiLanes(schema_of(old.files))
    lanes.take(ground.SerializeToString())

    assert lanes.text() == ("", "")
    assert [
        w
        for w in lanes.warnings
        if "lane left out: its schema lacks the field classification.type" in w
    ]


def test_too_many_points_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import sgstore.readers.osi._lanes as osi_lanes
    from sgstore.errors import MapError

    monkeypatch.setattr(osi_lanes, "MAX_POINTS", 5)
    with pytest.raises(MapError, match="more than 5 points"):
        made(two_way())


def test_too_many_cross_sections_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from sgstore.errors import MapError

    monkeypatch.setattr(lanetext, "MAX_SECTIONS", 5)
    with pytest.raises(MapError, match="more than 5 cross sections"):
        made(two_way())


# Recordings ----------------------------------------------------------------------------------------


def record(path: Path, *truths: Truth, road_map: str = "") -> Path:
    with patch.object(recordings, "OSI", OSI), Recorder(path) as recorder:
        if road_map:
            recorder.map(road_map)
        channel = recorder.channel("truth", "osi3.GroundTruth")
        for number, truth in enumerate(truths):
            ground = truth.ground
            ground.timestamp.seconds = number
            ground.host_vehicle_id.value = 80
            ground.moving_object.append(
                OSI.MovingObject.FromString(
                    car(80, x=10.0 + number, y=-3.5, length=4.0, width=2.0).SerializeToString()
                )
            )
            recorder.write(channel, float(number), ground.SerializeToString())
    return path


def test_a_recording_without_a_map_has_the_roads_of_its_lanes_and_a_store_keeps_them(
    tmp_path: Path,
) -> None:
    told = two_way()
    told.ground.map_reference = "C:\\maps\\Harbour.xodr"
    path = record(tmp_path / "drive.mcap", Truth(), told, Truth())

    outcome = ingest(tmp_path / "s.sgstore", [path])[0]

    assert (outcome.status, outcome.error) == ("added", None)
    store = sgstore.open(tmp_path / "s.sgstore")
    kept = map_of(store.file, outcome.name)
    assert kept is not None
    assert kept.name == "Harbour (lanes)"
    with open_trace(path) as trace:
        assert trace.info.map_text == kept.text
    found = store.find("MATCH (e:Ego)-[:isIn]->(l:Lane {lane_type: 'driving'}) RETURN l.name")
    assert [row[-1] for row in found] == ["1"] * 3


def test_opendrive_counts_before_lanes(tmp_path: Path) -> None:
    from opendrive_maps import a_map, a_road, line

    path = record(tmp_path / "d.mcap", two_way(), road_map=a_map(a_road("1", line(9.0))))

    with open_trace(path) as trace:
        assert trace.info.map_text.startswith("<OpenDRIVE")


def test_lanes_that_make_no_map_are_said_and_cost_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lanelines, "MAX_LANES", 2)
    path = record(tmp_path / "d.mcap", two_way())

    with open_trace(path) as trace:
        assert trace.info.map_text == ""
        assert sum(map(len, trace.blocks())) == 1
        assert [w for w in trace.report.warnings if "make no map" in w and "6 lanes" in w]


def both(path: Path) -> tuple[RoadMap, RoadMap]:
    """The maps of a recording: of its OpenDRIVE, and of the lanes in its ground truth."""
    lanes: OsiLanes | None = None
    text = ""
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            if schema is not None and schema.name == "osi3.MapAsamOpenDrive":
                told = OSI.MapAsamOpenDrive.FromString(message.data)
                text = str(told.open_drive_xml_content)
            elif lanes is None and schema is not None:
                lanes = OsiLanes(schema)
                lanes.take(message.data)
    assert lanes is not None
    return read_map(text, "opendrive"), read_map(lanes.text()[0], "lanes")


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["cut-in", "highway_merge", "pedestrian", "traffic_lights", "swarm_Town04"]
)
def test_the_lanes_that_esmini_writes_make_the_map_that_it_made_them_of(
    data: Path, name: str
) -> None:
    theirs, ours = both(data / f"traces/esmini/{name}.mcap")
    lanes = [
        {n: row for row, n in enumerate(m.nodes.name[1 : 1 + len(m.ribbons)])}
        for m in (theirs, ours)
    ]
    shared = set(lanes[0]) & set(lanes[1])
    plain = {n for n in lanes[0] if not theirs.nodes.junction[1 + lanes[0][n]]}
    assert plain <= shared
    for lane in shared:
        one, other = theirs.nodes, ours.nodes
        assert one.lane_type[1 + lanes[0][lane]] == other.lane_type[1 + lanes[1][lane]]

    points = theirs.waypoints(1.0)
    names = [theirs.nodes.name[1 + lane] for lane in points.lane.tolist()]
    wide = points.width > 0.1
    rows = np.flatnonzero(wide & np.array([n in shared for n in names]))
    row = np.array([lanes[1][names[r]] for r in rows])
    boxes = np.column_stack((points.x, points.y, points.heading))[rows]
    hits = ours.lanes_of(np.column_stack((boxes, np.zeros((len(rows), 2)))), points.z[rows])
    own = (-2 - hits.lane) == row[hits.row]
    # Each border strays from its curve by 5 cm at most.
    assert len(set(hits.row[own])) >= 0.997 * len(rows)
    assert np.quantile(np.abs(hits.offset[own]), 0.99) <= 0.08
    assert np.quantile(np.abs(hits.heading_error[own]), 0.99) <= 0.03
    for relation in ("toLeftOf", "toRightOf", "opposes"):
        expected = {p for p in pairs(theirs, relation) if shared.issuperset(p)}
        assert {p for p in pairs(ours, relation) if shared.issuperset(p)} == expected
    if name != "cut-in":  # its marks are broken, and forbid by an attribute that OSI has not
        assert pairs(ours, "laneChange") == {
            p for p in pairs(theirs, "laneChange") if shared.issuperset(p)
        }
    if name != "highway_merge":  # esmini does not tell how its direct junction joins lanes
        expected = {p for p in beyond_junctions(theirs) if shared.issuperset(p)}
        assert beyond_junctions(ours) <= expected
        # Of ways through several sections it tells a wrong end, which the lane there knows nothing of.
        assert len(expected - beyond_junctions(ours)) == (9 if name == "swarm_Town04" else 0)


def beyond_junctions(road_map: RoadMap) -> set[tuple[str, str]]:
    """Driving lanes outside junctions and those that traffic comes to next, through a junction or not."""
    nodes = road_map.nodes
    inside = {n for n, j in zip(nodes.name, nodes.junction, strict=True) if j}
    kind = dict(zip(nodes.name, nodes.lane_type, strict=True))
    onward: dict[str, set[str]] = {}
    for a, b in pairs(road_map, "travelsTo"):
        onward.setdefault(a, set()).add(b)
    found: set[tuple[str, str]] = set()
    for lane, next_ones in onward.items():
        if lane in inside or kind[lane] != "driving":
            continue
        seen: set[str] = set()
        front = [*next_ones]
        while front:
            other = front.pop()
            if other not in inside:
                found |= {(lane, other)} if kind[other] == "driving" else set()
            elif other not in seen:
                seen.add(other)
                front += onward.get(other, ())
    return found


@pytest.mark.data
def test_lanes_of_other_producers_make_maps_that_hold_their_traffic(data: Path) -> None:
    expected = {
        "osi_converter/MovingHostWith3DModel.mcap": (3, "Highway6kmStraight (lanes)"),
        "osi_converter/MovingHostWithStopLine.mcap": (3, "Highway6kmStraight (lanes)"),
        "osi_converter/testBrakeAndIndicatorLights.mcap": (3, "StraightRoad2km (lanes)"),
        "omega_prime/osi_centerline_example.mcap": (675, "osi_centerline_example (lanes)"),
    }
    for name, (number, called) in expected.items():
        with open_trace(data / "traces" / name) as trace:
            road_map = read_map(trace.info.map_text, trace.info.map_name)
            assert (len(road_map.ribbons), road_map.name) == (number, called)
            states = [block.states for block in trace.blocks()]
        x, y, heading = (
            np.concatenate([getattr(s, c) for s in states]) for c in ("x", "y", "heading")
        )
        boxes = np.column_stack((x, y, heading, np.full(len(x), 4.0), np.full(len(x), 1.8)))
        hits = road_map.lanes_of(boxes, np.full(len(x), np.nan))
        assert len(np.unique(hits.row)) >= 0.85 * len(x)
        points = road_map.waypoints(2.0)
        centres = np.column_stack((points.x, points.y, points.heading, np.zeros((len(points), 2))))
        own = road_map.lanes_of(centres, points.z)
        found = set(zip(own.row.tolist(), (-2 - own.lane).tolist(), strict=True))
        assert set(enumerate(points.lane.tolist())) <= found
