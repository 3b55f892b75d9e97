"""CARLA's bridge as it may be met: drives whose numbers are known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from carla_recordings import (
    BEFORE_HUMBLE,
    HERO,
    Bridge,
    header,
    idents,
    kinds,
    read,
    reasons,
    states,
    thing,
    vehicle,
    walker,
)

from sgstore.errors import TraceError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "drive.mcap"


# Objects ------------------------------------------------------------------------------------------


def test_a_vehicle_is_lifted_to_its_middle_and_a_walker_is_not(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO | {9: ("walker.pedestrian.0001", "pedestrian")})
        bridge.objects(0.0, [vehicle(1, 5, 6, z=2, size=[4, 2, 1.5]), walker(9, z=2.9)])

    (frame,) = states(read(path)[1])

    assert [frame["1"][c] for c in "xyz"] == [5, 6, 2.75]
    assert frame["9"]["z"] == 2.9


def test_a_vehicle_on_a_slope_is_lifted_along_its_own_upright_axis(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.objects(0.0, [vehicle(1, heading=math.pi / 2, pitch=-0.3, size=[4, 2, 1.5])])

    (frame,) = states(read(path)[1])

    assert [frame["1"][c] for c in "xyz"] == pytest.approx(
        [0, -0.75 * math.sin(0.3), 0.75 * math.cos(0.3)], abs=1e-12
    )
    assert [frame["1"][c] for c in ("heading", "pitch", "roll")] == pytest.approx(
        [math.pi / 2, -0.3, 0], abs=1e-12
    )


def test_definitions_before_humble_are_read_by_their_own_layout(path: Path) -> None:
    things = [vehicle(1, 5, 6), vehicle(2, 7, 8, classification=7), walker(3, polygon=[{}])]
    found = []
    for other in ({}, BEFORE_HUMBLE):
        with Bridge(path, other=other) as bridge:
            bridge.objects(0.0, things)
        found.append(states(read(path)[1]))

    np.testing.assert_equal(found[0], found[1])
    assert [found[0][0][i]["x"] for i in "123"] == [5, 7, 0]


@pytest.mark.parametrize("frame", ["", "m", "map", "some/other/axes"])
def test_names_of_any_length_leave_the_numbers_as_they_are(path: Path, frame: str) -> None:
    things = [vehicle(i, i / 3, frame=frame * (1 + i % 3)) for i in range(40)]
    with Bridge(path) as bridge:
        bridge.objects(0.0, things)

    (found,) = states(read(path)[1])

    assert [found[str(i)]["x"] for i in range(40)] == [i / 3 for i in range(40)]


def test_round_shapes_are_boxed(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(
            0.0,
            [
                thing(1, shape=2, size=[1.0]),
                thing(2, shape=3, size=[3.0, 0.5]),
                thing(3, shape=1, size=[]),
                thing(4, shape=1, size=[-1.0, math.inf, 2.0]),
            ],
        )

    (frame,) = states(read(path)[1])
    boxes = [[frame[i][c] for c in ("length", "width", "height")] for i in "1234"]

    np.testing.assert_equal(
        boxes, [[2, 2, 2], [1, 1, 3], [math.nan] * 3, [math.nan, math.nan, 2.0]]
    )


@pytest.mark.parametrize(
    "broken",
    [
        {"x": math.nan},
        {"z": math.inf},
        {"x": 1e300},
        {"turn": {"x": 0, "y": 0, "z": 0, "w": 0}},
        {"turn": {"x": 0, "y": 0, "z": math.nan, "w": 1}},
        {"turn": {"x": 0, "y": 0, "z": 0, "w": 1e200}},
    ],
    ids=str,
)
def test_an_object_without_a_usable_pose_is_left_out_and_named(path: Path, broken: Any) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(3):
            bridge.objects(i * 0.1, [vehicle(1), vehicle(2, **(broken if i == 1 else {}))])

    _, blocks, report = read(path)

    assert [sorted(frame) for frame in states(blocks)] == [["1", "2"], ["1"], ["1", "2"]]
    assert "object 2 has no usable pose: 1 state left out" in reasons(report)
    assert report.losses[0].start_ns == 102_000_000


def test_a_number_that_is_missing_beside_the_pose_is_missing(path: Path) -> None:
    with Bridge(path) as bridge:
        for i in range(3):
            bridge.objects(i * 0.1, [vehicle(1, 3 * i * i, v=(math.nan, 0, 0), a=(math.inf, 0, 0))])

    _, blocks, report = read(path)
    middle = states(blocks)[1]["1"]

    assert report.losses == []
    assert (middle["vx"], middle["derived"] & 1) == (pytest.approx(60), 1)


def test_an_object_that_comes_twice_in_a_frame_counts_once(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(4, 1), vehicle(4, 2), vehicle(5)])

    _, blocks, report = read(path)
    (frame,) = states(blocks)

    assert [(i, s["x"]) for i, s in frame.items()] == [("4", 1), ("5", 0)]
    assert "object 4 comes more than once in a frame" in reasons(report)


def test_a_frame_without_objects_is_a_frame(path: Path) -> None:
    with Bridge(path) as bridge:
        for i in range(3):
            bridge.objects(i * 0.1, [] if i == 1 else [vehicle(1)])

    _, blocks, report = read(path)

    assert [len(frame) for frame in states(blocks)] == [1, 0, 1]
    assert report.frames == 3


# What actors are ----------------------------------------------------------------------------------


def test_what_an_object_is_may_be_told_late(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(2)])
        bridge.objects(0.1, [vehicle(2)])
        bridge.actors({2: ("vehicle.mitsubishi.fusorosa", "autopilot")}, time=0.15)

    assert kinds(read(path)[1]) == {"2": "bus"}


def test_a_blueprint_that_nothing_maps_is_what_the_bridge_says_unless_that_is_a_car(
    path: Path,
) -> None:
    with Bridge(path) as bridge:
        bridge.actors({i: (f"vehicle.my.own{i}", "") for i in range(1, 5)})
        bridge.objects(0.0, [vehicle(i, classification=5 + i) for i in range(1, 5)])

    _, blocks, report = read(path)

    assert kinds(blocks) == {"1": "vehicle", "2": "truck", "3": "motorcycle", "4": "vehicle"}
    assert report.unknown_types == {"vehicle.my.own1": 1, "vehicle.my.own4": 1}


def test_without_a_list_of_actors_the_bridge_is_believed_and_that_is_said(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(
            0.0, [vehicle(1), walker(2), vehicle(3, classification=5), thing(4, classification=0)]
        )

    _, blocks, report = read(path)

    assert kinds(blocks) == {"1": "car", "2": "person", "3": "bicycle", "4": "unknown"}
    assert any("no list of actors" in warning for warning in report.warnings)
    assert report.unknown_types == {"class 0": 1}


def test_an_actor_that_changes_its_name_keeps_the_first_and_that_is_said(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.objects(0.0, [vehicle(1)])
        bridge.actors({1: ("vehicle.mitsubishi.fusorosa", "hero")}, time=0.05)

    _, blocks, report = read(path)

    assert kinds(blocks) == {"1": "car"}
    assert any("the first name counts" in warning for warning in report.warnings)


def test_blueprints_are_known_by_the_beginning_of_their_ids(path: Path) -> None:
    meanings = [
        ("vehicle.carlamotors.firetruck", "truck", "emergency"),
        ("vehicle.Ford.Ambulance", "van", "emergency"),
        ("vehicle.ford.crown", "car", "taxi"),
        ("walker.pedestrian.0049", "person", ""),
        ("traffic.speed_limit.30", "speed_limit", ""),
        ("static.prop.trafficcone01", "prop", ""),
        ("vehicle.nissan.new_in_2027", "car", ""),
        ("sensor.camera.rgb", "unknown", ""),
        ("", "unknown", ""),
    ]
    with Bridge(path) as bridge:
        bridge.actors({i: (blueprint, "") for i, (blueprint, _, _) in enumerate(meanings)})
        bridge.objects(0.0, [vehicle(i, 9 * i, classification=0) for i in range(len(meanings))])

    _, blocks, _ = read(path)

    expected = {str(i): kind for i, (_, kind, _) in enumerate(meanings)}
    assert kinds(blocks) == expected
    assert list(blocks[0].entities.special) == [special for _, _, special in meanings]


# The ego ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", ["hero", "ego_vehicle", "hero3", "my_own"])
def test_the_ego_is_known_by_its_role(path: Path, role: str) -> None:
    with Bridge(path) as bridge:
        bridge.actors({5: ("vehicle.audi.tt", "autopilot"), 6: ("vehicle.audi.tt", role)})
        bridge.objects(0.0, [vehicle(5), vehicle(6)])
        bridge.status(0.0, role=role)

    info, blocks, report = read(path)

    assert info.ego == "6"
    assert idents(blocks)[blocks[0].ego[0]] == "6"
    assert report.warnings == []


def test_of_several_egos_the_first_role_is_taken_and_the_others_are_named(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors({5: ("vehicle.audi.tt", "ego_vehicle"), 6: ("vehicle.audi.tt", "hero")})
        bridge.objects(0.0, [vehicle(5), vehicle(6)])

    info, _, report = read(path)

    assert info.ego == "6"
    assert any("'hero' (6), 'ego_vehicle' (5)" in warning for warning in report.warnings)
    assert read(path, ego="ego_vehicle")[0].ego == "5"


@pytest.mark.parametrize("named", ["5", "scout"])
def test_any_actor_can_be_named_as_the_ego(path: Path, named: str) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO | {5: ("vehicle.audi.tt", "scout")})
        bridge.objects(0.0, [vehicle(1), vehicle(5)])
        bridge.status(0.0, throttle=0.5, role="scout")

    info, blocks, _ = read(path, ego=named)
    (frame,) = states(blocks)

    assert info.ego == "5"
    assert frame["5"]["throttle"] == 0.5


def test_a_name_that_nobody_bears_is_refused_with_those_that_there_are(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(
            HERO | {5: ("vehicle.audi.tt", "autopilot"), 8: ("vehicle.audi.tt", "autopilot")}
        )
        bridge.objects(0.0, [vehicle(1), vehicle(5)])

    with pytest.raises(TraceError, match=r"no actor has the id or role 'nobody'.*1 \(hero\)"):
        read(path, ego="nobody")
    with pytest.raises(TraceError, match=r"several actors have the role 'autopilot': ids 5, 8"):
        read(path, ego="autopilot")


def test_without_a_list_of_actors_an_id_can_be_named(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(1)])
        bridge.objects(0.1, [vehicle(1), vehicle(5)])

    assert read(path, ego="5")[0].ego == "5"
    with pytest.raises(TraceError, match="no actor has the id or role '6'; there are: 1, 5"):
        read(path, ego="6")


def test_without_an_ego_it_is_said_that_there_is_none(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors({5: ("vehicle.audi.tt", "autopilot")})
        bridge.objects(0.0, [vehicle(5)])

    info, blocks, report = read(path)

    assert info.ego == ""
    assert blocks[0].ego.tolist() == [-1]
    assert any("name one as the ego" in warning for warning in report.warnings)


@pytest.mark.parametrize("delay", [-0.001, 0.004], ids=["before", "behind"])
def test_without_a_list_of_actors_the_ego_is_the_object_where_its_odometry_is(
    path: Path, delay: float
) -> None:
    with Bridge(path) as bridge:
        for i in range(4):
            t = i * 0.1
            if delay < 0:
                bridge.odometry(t, 10 * t, 3, delay=delay + 0.002)
            bridge.objects(t, [vehicle(4, 10 * t, 0), vehicle(6, 10 * t, 3)])
            if delay > 0:
                bridge.odometry(t, 10 * t, 3, delay=delay)

    info, blocks, _ = read(path)

    assert info.ego == "6"
    assert all(idents(blocks)[node] == "6" for node in blocks[0].ego)


@pytest.mark.parametrize("delay", [0.001, 0.004], ids=["before", "behind"])
def test_an_ego_that_its_own_list_leaves_out_stands_where_its_odometry_is(
    path: Path, delay: float
) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(5):
            t = i * 0.1
            if delay < 0.002:
                bridge.odometry(t, 2 * t, 1, heading=math.pi / 2, v=(3, 0, 0), delay=delay)
            bridge.objects(t, [vehicle(5)], topic="/carla/hero/objects")
            if delay > 0.002:
                bridge.odometry(t, 2 * t, 1, heading=math.pi / 2, v=(3, 0, 0), delay=delay)

    info, blocks, _ = read(path, 2)
    frames = states(blocks)

    assert info.ego == "1"
    assert [frame["1"]["x"] for frame in frames] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
    assert [frame["1"]["heading"] for frame in frames] == pytest.approx([math.pi / 2] * 5)
    assert [(f["1"]["vx"], f["1"]["vy"]) for f in frames] == [pytest.approx((0, 3))] * 5
    assert kinds(blocks)["1"] == "car"


# Other things that are met ------------------------------------------------------------------------


def test_of_several_lists_of_objects_the_fullest_leads(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(4):
            bridge.objects(i * 0.1, [vehicle(5)], topic="/carla/hero/objects")
            bridge.objects(i * 0.1, [vehicle(1), vehicle(5)], topic="/carla/objects")

    info, blocks, _ = read(path)

    assert {c.topic: c.role for c in info.channels}["/carla/objects"] == "ground_truth"
    assert [len(frame) for frame in states(blocks)] == [2] * 4


def test_topics_tell_nothing(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(1)], topic="/anything")

    assert read(path)[0].flavour == "carla"


def test_a_message_that_cannot_be_read_is_a_loss_and_the_others_are_kept(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(6):
            bridge.objects(i * 0.1, [vehicle(1)])
            bridge.status(i * 0.1, throttle=0.5)
        for topic in ("/carla/objects", "/carla/hero/vehicle_status", "/carla/actor_list"):
            bridge.writer.add_message(bridge.channels[topic], 10**9, b"\0\1\0\0\1", 10**9)

    _, blocks, report = read(path)

    assert report.frames == 6
    assert {loss.messages for loss in report.losses} == {1}
    for topic in ("/carla/objects", "/carla/hero/vehicle_status", "/carla/actor_list"):
        assert f"{topic!r} cannot be read" in reasons(report)
    assert states(blocks)[0]["1"]["throttle"] == 0.5


def test_what_cannot_be_read_is_counted_once(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [])
        bridge.writer.add_message(bridge.channels["/carla/objects"], 5, b"\0\1\0\0\1", 5)
        bridge.light_states({}, 0.0)
        topic = "/carla/traffic_lights/status"
        bridge.writer.add_message(bridge.channels[topic], 6, b"\0\1\0\0\1", 6)
        bridge.objects(0.1, [vehicle(1)])

    losses = read(path)[2].losses

    assert [(loss.messages, loss.start_ns) for loss in losses] == [(1, 5), (1, 6)]


@pytest.mark.parametrize("text", ["", "std_msgs/Header header\nObject[] objects", "int32 objects"])
def test_objects_that_no_definition_explains_are_an_error(path: Path, text: str) -> None:
    with Bridge(path) as bridge:
        told = {"header": header(0), "objects": []}
        bridge.write("/carla/objects", "derived_object_msgs/ObjectArray", told, 0.0, text)

    with pytest.raises(TraceError, match="derived_object_msgs"):
        read(path)


def test_a_definition_that_is_malformed_elsewhere_loses_that_channel_only(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.write("/carla/actor_list", "carla_msgs/CarlaActorList", b"abc", 0.0, "Nonsense[] a")
        bridge.write("/blob", "vendor/Blob", b"abc", 0.0, "???")
        bridge.objects(0.0, [vehicle(1)])

    _, blocks, report = read(path)

    assert kinds(blocks) == {"1": "car"}
    assert ["/carla/actor_list" in loss.reason for loss in report.losses] == [True]
    assert any("channel '/blob'" in warning for warning in report.warnings)
