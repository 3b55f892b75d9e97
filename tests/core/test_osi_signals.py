"""Lights and signs that OSI assigns to lanes apply to these lanes of the map that the lanes make."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import pytest
import recordings
import test_roads_osi as roads
from mcap.reader import make_reader
from mcap.writer import Writer
from opendrive_maps import a_map, a_road, line
from recordings import Recorder, car
from test_roads_text import strip

import sgstore
from sgstore.errors import MapError
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import PlainSignal, lane_text
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

TYPES = roads.TYPES | {
    "Assignment": "assigned_lane_id=1:Identifier s_position=2:double",
    "BulbClassification": recordings.TYPES["BulbClassification"]
    + " assigned_lane_id=5:Identifier* logical_lane_assignment=7:Assignment*",
    "SignClassification": recordings.TYPES["SignClassification"]
    + " assigned_lane_id=5:Identifier* logical_lane_assignment=12:Assignment*",
}
with patch.dict(recordings.TYPES, TYPES), patch.dict(recordings.ENUMS, roads.ENUMS):
    OSI = recordings.Osi()

STOP, CONE = 17, 140


def bulb(ident: int, at: tuple[float, float, float], lanes: tuple[int, ...], ref: str = "") -> Any:
    with patch.object(recordings, "OSI", OSI):
        light = recordings.bulb(ident, 2, 3, at, ref)
    roads.identify(light.classification.assigned_lane_id, *lanes)
    return light


def sign(ident: int, kind: int, lanes: tuple[int, ...]) -> Any:
    with patch.object(recordings, "OSI", OSI):
        thing = recordings.sign(ident, kind, 90.0)
    roads.identify(thing.main_sign.classification.assigned_lane_id, *lanes)
    return thing


def record(path: Path, truth: roads.Truth, things: list[Any], road_map: str = "") -> Path:
    """Three frames of an ego on lane 1, the lanes of the truth in the first, lights and signs in all."""
    with patch.object(recordings, "OSI", OSI), Recorder(path) as recorder:
        if road_map:
            recorder.map(road_map)
        channel = recorder.channel("truth", "osi3.GroundTruth")
        for number in range(3):
            ground = OSI.GroundTruth()
            if number == 0:
                ground.MergeFromString(truth.ground.SerializeToString())
            ground.timestamp.seconds = number
            ground.host_vehicle_id.value = 80
            ground.moving_object.append(car(80, x=80.0 + number, y=-3.5, length=4.0, width=2.0))
            for thing in things:
                kind = (
                    "traffic_light" if thing.DESCRIPTOR.name == "TrafficLight" else "traffic_sign"
                )
                getattr(ground, kind).append(thing)
            recorder.write(channel, float(number), ground.SerializeToString())
    return path


def applies(path: Path, road_map: RoadMap | None = None) -> dict[str, list[str]]:
    """Ident of each light or sign → names of the lanes that it applies to."""
    found: dict[str, list[str]] = {}
    with open_trace(path) as trace:
        shown = road_map or read_map(trace.info.map_text, "m")
        for block in trace.blocks():
            for ident, ref in zip(block.entities.ident, block.entities.map_ref, strict=True):
                lanes = shown.lanes_of_signal(ref).tolist() if ref else []
                found[ident] = [shown.nodes.name[-1 - lane] for lane in lanes]
    return found


def test_bulbs_of_a_head_and_signs_apply_to_the_lanes_that_they_are_assigned_to(
    tmp_path: Path,
) -> None:
    things = [
        bulb(200, (99, -6, 5), (1,)),
        bulb(201, (99, -6, 4.7), (2,)),
        bulb(202, (99, 6, 5), (3,), ref="s3"),
        bulb(203, (50, 6, 5), ()),
        sign(300, STOP, (2, 4)),
        sign(301, CONE, (2,)),
    ]
    path = record(tmp_path / "a.mcap", roads.two_way(), things)

    assert applies(path) == {
        "80": [],
        "200": ["1", "2"],
        "202": ["3"],
        "203": [],
        "300": ["2"],  # lane 4 is a sidewalk
        "301": [],
    }


def test_logical_lanes_are_found_by_their_own_ids_and_by_those_of_their_physical_lanes(
    tmp_path: Path,
) -> None:
    street = roads.logical_street()
    logical = [lane.id.value for lane in street.ground.logical_lane]
    physical = 900
    street.ground.logical_lane[0].physical_lane_reference.add().physical_lane_id.value = physical
    by_logical = bulb(200, (5, 5, 5), ())
    assigned = by_logical.classification.logical_lane_assignment.add()
    assigned.assigned_lane_id.value = logical[1]
    path = record(tmp_path / "a.mcap", street, [by_logical, bulb(201, (9, 9, 5), (physical,))])

    with open_trace(path) as trace:
        names = read_map(trace.info.map_text, "m").nodes.name
    assert {str(logical[0]), str(logical[1])} <= set(names)
    found = applies(path)
    assert (found["200"], found["201"]) == ([str(logical[1])], [str(logical[0])])


def test_a_store_knows_which_light_controls_the_lane_of_the_ego(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", roads.two_way(), [bulb(200, (99, -6, 5), (1,))])

    (outcome,) = ingest(tmp_path / "s.db", [path])

    assert outcome.status == "added"
    pattern = (
        "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:controlsTrafficOf]-(s:TrafficLight) RETURN s.ident"
    )
    found = sgstore.open(tmp_path / "s.db").find(pattern)
    assert [row[-1] for row in found] == ["200"] * 3


def test_lights_for_pedestrians_control_no_lane_for_motor_traffic(tmp_path: Path) -> None:
    lights = [bulb(200, (99, -6, 5), (1,)), bulb(201, (99, 6, 5), (1,))]
    lights[1].classification.icon = 17  # ICON_DONT_WALK
    ingest(tmp_path / "s.db", [record(tmp_path / "a.mcap", roads.two_way(), lights)])

    store = sgstore.open(tmp_path / "s.db")
    for relation in ("controlsTrafficOf", "mayAffect"):
        found = store.find(f"MATCH (s:TrafficLight)-[:{relation}]->(:Lane) RETURN s.ident")
        assert {row[-1] for row in found} == {"200"}


def test_opendrive_counts_before_what_lights_are_assigned_to(tmp_path: Path) -> None:
    things = [bulb(200, (99, -6, 5), (1,))]
    road_map = a_map(a_road("1", line(9.0)))
    path = record(tmp_path / "a.mcap", roads.two_way(), things, road_map)

    assert applies(path)["200"] == []


def test_assignments_without_end_cost_only_their_light(tmp_path: Path) -> None:
    things = [bulb(200, (99, -6, 5), (1,) * 2000), bulb(201, (50, -6, 5), (2,))]
    path = record(tmp_path / "a.mcap", roads.two_way(), things)

    assert applies(path) == {"80": [], "201": ["2"]}
    with open_trace(path) as trace:
        assert sum(map(len, trace.blocks())) == 3
        assert "traffic lights cannot be read where they changed 1 time" in trace.report.warnings


@pytest.mark.data
def test_the_lanes_that_esmini_assigns_are_those_of_the_signals_of_its_map(
    data: Path, tmp_path: Path
) -> None:
    whole, bare = data / "traces/esmini/traffic_lights.mcap", tmp_path / "bare.mcap"
    with whole.open("rb") as source, bare.open("wb") as target:
        writer, channels = Writer(target), {}
        writer.start()
        for schema, channel, message in make_reader(source).iter_messages():
            if schema is None or schema.name != "osi3.GroundTruth":
                continue
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel("truth", "protobuf", known)
            writer.add_message(channels[channel.id], message.log_time, message.data, 0)
        writer.finish()

    theirs, ours = applies(whole), applies(bare)

    # A light and a sign have lanes in the map. Two lights for pedestrians have none there.
    controlled = {ident: set(lanes) for ident, lanes in theirs.items() if lanes}
    assert len(controlled) == 2
    assert {ident: set(ours[ident]) for ident in controlled} == controlled


# The text of a map --------------------------------------------------------------------------------

LANES = [strip(name="a", onto=(1,)), strip(20.0, name="b", type="sidewalk")]


def test_signals_in_a_text_of_lanes_are_nodes_of_the_map() -> None:
    signals = [
        PlainSignal("s", "traffic_light", 1.00004, -2.0, 3.0, 0.5, (0, 1)),
        PlainSignal("t", "stop_sign"),
    ]
    road_map = read_map(lane_text(LANES, signals=signals), "m")

    assert road_map.nodes.name[-2:] == ("s", "t")
    assert road_map.nodes.x[-2:].tolist() == pytest.approx([1.0, float("nan")], nan_ok=True)
    assert [road_map.lanes_of_signal(name).tolist() for name in "st"] == [[-2], []]
    assert '"signals"' not in lane_text(LANES)


@pytest.mark.parametrize(
    ("signals", "element"),
    [
        ({}, "signals"),
        (["s"], "signals"),
        ([{"kind": "car"}], "signals/kind"),
        ([{"kind": "sign", "name": 3}], "signals/name"),
        ([{"kind": "sign", "x": "1"}], "signals/x"),
        ([{"kind": "sign", "heading": 1e9}], "signals/heading"),
        ([{"kind": "sign", "lanes": [2]}], "signals/lanes"),
    ],
)
def test_signals_that_are_none_are_refused(signals: Any, element: str) -> None:
    import json

    text = json.loads(lane_text(LANES)) | {"signals": signals}

    with pytest.raises(MapError) as caught:
        read_map(json.dumps(text), "m")
    assert caught.value.element == element
