"""Recordings of Autoware: what went in comes out, in the axes of the map."""

from __future__ import annotations

import cmath
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from autoware_recordings import AUTOWARE, Stack, drive, hex_of, thing
from carla_recordings import idents, kinds, read, reasons, states
from lanelet2_maps import two_lanes
from test_carla_bags import METADATA, split

import sgstore
from sgstore.errors import TraceError
from sgstore.maps.lanelet2 import lanelet2_text
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import LIGHT_STATES, VEHICLE_LIGHTS
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

NUMBERS = ("x", "y", "heading", "vx", "vy", "ax", "yaw_rate")
LEADER, WALKER = hex_of("leader"), hex_of("pedestrian")


def told(frame: dict[str, Any], ident: str, *names: str) -> tuple[float, ...]:
    return tuple(round(float(frame[ident][name]), 6) for name in names)


@pytest.fixture
def stack(tmp_path: Path) -> Stack:
    """A recording in the making, which the test ends."""
    return Stack(tmp_path / "drive.mcap").__enter__()


def test_what_is_told_in_the_map_stands_there_with_its_motion(tmp_path: Path) -> None:
    info, blocks, report = read(drive(tmp_path / "drive.mcap", 10))

    frames = states(blocks)
    assert (info.flavour, info.ego, len(frames), report.losses) == ("autoware", "ego", 10, [])
    assert kinds(blocks) == {LEADER: "car", WALKER: "person", "ego": "car"}
    assert told(frames[4], LEADER, "x", "y", "vx", "vy") == (8 * 1.4 + 20, 0.8, 8.0, 2.0)
    assert told(frames[4], WALKER, "x", "y", "length") == (40.0, -4.6, 0.5)
    # The middle of the sample vehicle is 1.345 m before its rear axle.
    assert told(frames[4], "ego", "x", "y", "vx", "length") == (8 * 1.4 + 1.345, 0, 8, 4.89)
    assert blocks[0].time_ns[:2].tolist() == [1_000_000_000, 1_100_000_000]


def test_existence_and_covariance_are_attributes(stack: Stack, tmp_path: Path) -> None:
    covariance = [0.0] * 36
    covariance[0], covariance[1], covariance[7], covariance[35] = 0.25, -0.125, 0.5, 0.0625
    stack.transform(1.0, "map", "base_link", (0, 0, 0), 0.0)
    for t in (1.0, 1.5):
        sure = thing("car", 20, 1, name="sure", existence=0.75, covariance=covariance)
        stack.objects(t, [sure, thing("car", 30, 5, name="plain")], "Tracked")
    stack.end()
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        store.ingest(stack.path)
        rows = store.find(
            "MATCH (v:Car) WHERE v.existence_probability > 0.5 RETURN v.ident AS i, v.covariance_x AS x,"
            " v.covariance_xy AS xy, v.covariance_y AS y, v.covariance_heading AS h,"
            " v.existence_probability AS p"
        ).rows()
    assert {tuple(row) for row in rows} == {(hex_of("sure"), 0.25, -0.125, 0.5, 0.0625, 0.75)}


def test_what_is_detected_by_a_sensor_is_carried_into_the_map_and_followed(stack: Stack) -> None:
    def ego_at(t: float) -> tuple[complex, complex]:
        """Place, and the way ahead, on a circle."""
        ahead = cmath.exp(1j * (0.3 + 0.2 * t))
        return 100 + 50j + 30 * ahead, ahead

    mounted, turned = 1.5 + 0.25j, cmath.exp(0.5j)
    stack.transform(0.0, "base_link", "lidar", (1.5, 0.25, 1.8), 0.5)
    seen = {0.0: (10 + 2j, -8 + 0j), 0.1: (10.5 + 2j, -8.2 + 0j), 0.2: (11 + 2j, -8.4 + 0j)}
    for i in range(-1, 9):  # transforms come at other times than detections
        place, ahead = ego_at(0.05 + i / 20)
        stack.transform(
            1.05 + i / 20, "map", "base_link", (place.real, place.imag, 0), cmath.phase(ahead)
        )
    for t, places in seen.items():
        things = [thing("car", p.real, p.imag, z=0.5, v=(3.0, 0, 0)) for p in places]
        stack.objects(1 + t, things if t != 0.1 else things[::-1], "Detected", axes="lidar")
    stack.end()

    info, blocks, report = read(stack.path)

    frames = states(blocks)
    assert (info.ego, len(frames), report.losses) == ("ego", 3, [])
    assert sorted(kinds(blocks)) == ["detection 1", "detection 2", "ego"]
    for frame, (t, places) in zip(frames, seen.items(), strict=True):
        origin, ahead = ego_at(t)
        for ident, place in zip(("detection 1", "detection 2"), places, strict=True):
            there = origin + ahead * (mounted + turned * place)
            way = ahead * turned * 3.0
            wanted = (there.real, there.imag, 2.3, way.real, way.imag)
            assert told(frame, ident, "x", "y", "z", "vx", "vy") == pytest.approx(wanted, abs=2e-3)
    assert any("no ids" in warning for warning in report.warnings)


def test_tracked_objects_lead_and_predicted_ones_where_none_is_tracked(tmp_path: Path) -> None:
    def recorded(name: str, tracked: list[dict[str, Any]]) -> Any:
        path = tmp_path / f"{name}.mcap"
        with Stack(path) as stack:
            for i in range(4):
                stack.pose(i / 10, i, 0.0, old=True, v=(10, 0, 0))
                ahead = thing("truck", 30.0 + i, 1.0, "ahead", v=(10, 0, 0), paths=2)
                stack.objects(i / 10, [ahead, thing("bus", 9, 9)], "Predicted")
                stack.objects(i / 10, tracked, "Tracked")
        return read(path)

    both = recorded("both", [thing("car", 20, 0, "other")])
    empty = recorded("empty", [])

    assert kinds(both[1]) == {hex_of("other"): "car", "ego": "car"}
    assert kinds(empty[1]) == {hex_of("ahead"): "truck", hex_of("bus"): "bus", "ego": "car"}
    assert told(states(empty[1])[2], hex_of("ahead"), "x", "vx") == (32.0, 10.0)
    assert told(states(empty[1])[2], "ego", "x", "vx") == (3.345, 10.0)
    topics = {c.topic.split("/")[3]: c.role for c in both[0].channels if "object" in c.topic}
    assert topics == {"predicted": "payload", "tracked": "ground_truth"}


def test_a_bag_that_was_split_gives_what_the_whole_gives(tmp_path: Path) -> None:
    whole = drive(tmp_path / "whole.mcap", 24)
    bag = split(whole, tmp_path / "bag", 2)
    names = sorted(path.name for path in bag.glob("*.mcap"))
    files = "\n".join(f"    - {name}" for name in names)
    (bag / "metadata.yaml").write_text(METADATA.format(files=files), encoding="utf-8")

    _, wanted, _ = read(whole)
    _, found, report = read(bag)

    assert (len(names), report.losses, idents(found)) == (2, [], idents(wanted))
    for one, other in zip(states(found), states(wanted), strict=True):
        for ident in one:
            assert told(one, ident, *NUMBERS) == told(other, ident, *NUMBERS)


def test_light_groups_stand_where_the_map_has_them_and_control_its_lanes(
    tmp_path: Path, stack: Stack
) -> None:
    made, named = two_lanes()
    town = tmp_path / "lanelet2_map.osm"
    town.write_text(made.text(), encoding="utf-8")
    red, green, arrow, flashing = (1, 1, 2), (3, 1, 2), (3, 2, 2), (2, 1, 3)
    shown = [[red, arrow], [red, (2, 1, 2)], [green], [flashing], [(0, 1, 1)], []]
    for i, elements in enumerate(shown):
        stack.lights(i / 10, {int(named["light"]): elements, 999_999: [red]})
        stack.pose(i / 10, 80.0 + i, 5.25, v=(10, 0, 0))
        stack.objects(i / 10, [thing("car", 90 + i, 5.25, "leader", v=(10, 0, 0))])
    stack.end()

    with open_trace(stack.path) as trace:
        trace.on_map(read_map(lanelet2_text(made.text()), "town"))  # type: ignore[attr-defined]
        blocks = list(trace.blocks())
    store = sgstore.open(tmp_path / "drives.sgstore", create=True)
    store.ingest(stack.path, road_map=town)
    lit = store.find(
        "MATCH (l:TrafficLight)-[:controlsTrafficOf]->(n:Lane)<-[:isIn]-(e:Ego)"
        " RETURN l.light_state AS state, n.name AS lane, l.x AS x"
    )

    lights = [LIGHT_STATES[frame[named["light"]]["light_state"]] for frame in states(blocks)]
    assert lights == ["red", "red_yellow", "green", "flashing", "off", "unknown"]
    assert kinds(blocks)[named["light"]] == "traffic_light"
    assert any("1 traffic light groups are no" in w for w in trace.report.warnings)
    rows = [(row.state, row.lane, row.x) for row in lit]
    assert rows == [(state, named["left"], 104.25) for state in lights]


def test_an_object_is_what_it_is_called_most_often(stack: Stack) -> None:
    for i, label in enumerate(("unknown", "truck", "car", "car", "truck", "car")):
        stack.pose(i / 10, 0, 0)
        stack.objects(i / 10, [thing(label, 9, 9, "one")])
    stack.end()

    assert kinds(read(stack.path)[1])[hex_of("one")] == "car"


def test_polygons_headings_without_a_sign_and_reports_of_the_vehicle_are_understood(
    stack: Stack,
) -> None:
    corners = [(-1, 0), (3, 0), (3, 1), (-1, 1)]
    stack.report(0.0, "Gear", 20)
    stack.report(0.0, "TurnIndicators", 2)
    stack.pose(0.0, 0, 0, v=(1, 0, 0), a=(0.5, 0, 0))
    backed = thing("car", 9, 0, "backed", v=(-2.0, 0, 0), available=1)
    unknown = thing("unknown", 0, 9, "blob", available=0, corners=corners, size=(0, 0, 1))
    stack.objects(0.0, [backed, unknown, backed])
    stack.end()

    _, blocks, report = read(stack.path)

    (frame,) = states(blocks)
    assert told(frame, hex_of("backed"), "heading", "vx") == (round(-np.pi, 6), -2.0)
    assert told(frame, hex_of("blob"), "x", "y", "length", "width") == (1.0, 9.5, 4.0, 1.0)
    assert np.isnan(frame[hex_of("blob")]["heading"])
    assert told(frame, "ego", "ax", "gear") == (0.5, -1.0)
    assert frame["ego"]["lights"] == 1 << VEHICLE_LIGHTS.index("light_left")
    assert "more than once" in reasons(report)


def test_objects_in_axes_that_nobody_places_are_left_out_and_named(stack: Stack) -> None:
    stack.pose(0.0, 0, 0)
    stack.objects(0.0, [thing("car", 1, 2)], axes="radar")
    stack.objects(0.1, [thing("car", 1, 2, "there")])
    stack.end()

    _, blocks, report = read(stack.path)

    assert [sorted(frame) for frame in states(blocks)] == [
        ["ego"],
        sorted([hex_of("there"), "ego"]),
    ]
    assert "where 'radar' is in 'map' is not known" in reasons(report)


def test_the_ego_goes_on_as_it_did_for_half_a_second(stack: Stack) -> None:
    stack.pose(1.0, 0, 0, v=(10, 0, 0))
    for t in (1.2, 1.8):
        stack.objects(t, [thing("car", 50, 0)])
    stack.end()

    first, last = states(read(stack.path)[1])

    assert told(first, "ego", "x") == (3.345,)
    assert "ego" not in last


def test_a_mapping_says_how_large_the_vehicle_is_and_what_classes_mean(
    tmp_path: Path,
) -> None:
    mapping = tmp_path / "vehicle.toml"
    mapping.write_text(
        '[ego]\ntype = "shuttle"\nlength = 6.0\nwidth = 2.2\nheight = 2.8\noffset = [1.0, 0, 1.4]\n'
        '[types]\npedestrian = "animal"\nshuttle = "bus"\n'
    )

    _, blocks, report = read(drive(tmp_path / "drive.mcap", 3), mapping=mapping)

    assert kinds(blocks) == {LEADER: "car", WALKER: "animal", "ego": "bus"}
    assert told(states(blocks)[0], "ego", "x", "length") == (9.0, 6.0)
    assert not [w for w in report.warnings if "how large" in w]


def test_an_ego_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", 3)

    assert read(path, ego=LEADER)[0].ego == LEADER
    with pytest.raises(TraceError, match="no object has the id 'nobody'"):
        read(path, ego="nobody")


def test_what_is_not_read_says_what_it_looks_like_and_what_tells_objects(stack: Stack) -> None:
    stack.report(0.0, "Gear", 2)
    stack.send(
        "/perception/markers", "visualization_msgs/MarkerArray", b"\x00\x01\x00\x00\x00", 0.0
    )
    stack.end()

    with pytest.raises(TraceError) as refused:
        open_trace(stack.path)

    reason = refused.value.reason
    assert reason.startswith("Autoware recording: no ground truth of a flavour known")
    assert reason.index("MarkerArray") < reason.index("GearReport")
    assert "docs/flavours.md" in reason


@pytest.mark.data
def test_the_definitions_that_are_tested_with_are_those_of_autoware(data: Path) -> None:
    def fields(text: str) -> list[tuple[str, str]]:
        lines = (re.sub(r"#.*", "", line).split() for line in text.splitlines())
        return [
            (line[0].rpartition("/")[2], line[1])
            for line in lines
            if len(line) == 2 and "=" not in line[1]
        ]

    checked = 0
    for path in (data / "ros_msgs").rglob("*.msg"):
        name = f"{path.parts[-3]}/{path.stem}"
        if name in AUTOWARE:
            checked += 1
            assert fields(AUTOWARE[name]) == fields(path.read_text(encoding="utf-8")), name

    assert checked == sum(name.startswith("autoware_") for name in AUTOWARE)


def test_infinite_numbers_of_a_damaged_message_are_missing_without_a_warning_of_numpy(
    tmp_path: Path,
) -> None:
    with Stack(tmp_path / "a.mcap") as stack:
        for t in (0.0, 0.1):
            stack.pose(t, 0.0, 0.0, v=(np.inf, 0.0, 0.0), a=(np.inf, 0.0, 0.0))
            stack.objects(t, [thing("car", 20.0, 1.0, a=(np.inf, 0.0), v=(np.inf, 0.0))])
    with open_trace(tmp_path / "a.mcap") as trace:
        (block,) = trace.blocks()

    assert np.isfinite(block.states.x).all()
    assert not np.isinf(block.states.ax).any()
