"""What CARLA's bridge tells beside objects: controls, lights, the road map; and what a clip brings of it."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from carla_recordings import (
    HERO,
    Bridge,
    drive,
    kinds,
    light,
    read,
    reasons,
    states,
    vehicle,
)
from clipping import Source, write_clips
from opendrive_maps import a_map, a_road, element, lane, line, link, section

import sgstore
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import RoadMap
from sgstore.model.vocabulary import LIGHT_STATES, VEHICLE_LIGHTS
from sgstore.model.world import Clip, Event
from sgstore.pipeline.doctor import examine
from sgstore.readers import open_trace
from sgstore.readers.carla._signals import Light, least_sum, signals_of
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store


def kept(path: Path) -> Store:
    """A store of a recording."""
    (outcome,) = ingest(path.with_suffix(".sgstore"), [path])
    assert outcome.error is None
    return sgstore.open(path.with_suffix(".sgstore"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "drive.mcap"


# Controls and lights of vehicles ------------------------------------------------------------------


@pytest.mark.parametrize("first", [True, False], ids=["before", "behind"])
def test_controls_belong_to_the_frame_of_their_instant(path: Path, first: bool) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(7):
            t = i * 0.1
            if first:
                bridge.status(t, steer=0.25, throttle=i / 8, brake=0.5)
            bridge.objects(t, [vehicle(1), vehicle(2)])
            if not first:
                bridge.status(t, steer=0.25, throttle=i / 8, brake=0.5)

    for size in (1, 3, 60):
        frames = states(read(path, size)[1])

        assert [frame["1"]["throttle"] for frame in frames] == [i / 8 for i in range(7)]
        assert {frame["1"]["steer"] for frame in frames} == {-0.25}, "to the right is negative"
        assert {frame["1"]["brake"] for frame in frames} == {0.5}
        assert np.isnan([frame["2"]["throttle"] for frame in frames]).all()


def test_controls_hold_for_half_a_second(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.status(0.0, throttle=0.5)
        for i in range(10):
            bridge.objects(i * 0.1, [vehicle(1)])

    throttles = [frame["1"]["throttle"] for frame in states(read(path)[1])]

    np.testing.assert_equal(throttles, [0.5] * 6 + [math.nan] * 4)


def test_commands_stand_in_for_controls_that_were_not_recorded(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.command(0.0, steer=-0.5, throttle=0.75, brake=0)
        bridge.objects(0.0, [vehicle(1)])

    (frame,) = states(read(path)[1])

    assert (frame["1"]["steer"], frame["1"]["throttle"]) == (0.5, 0.75)


@pytest.mark.parametrize("first", [True, False])
def test_commands_are_kept_beside_the_applied_controls(path: Path, first: bool) -> None:
    spin = {"x": 0.5, "y": -0.25, "z": 0.125}
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i in range(3):
            for now in (first, not first):
                if now:
                    bridge.status(i * 0.1, throttle=0.25, manual_gear_shift=i == 1)
                    bridge.command(i * 0.1, steer=-0.5, throttle=0.75, brake=0, reverse=True)
                else:
                    twist = {"linear": dict.fromkeys("xyz", 0.0), "angular": spin}
                    bridge.objects(i * 0.1, [vehicle(1) | {"twist": twist}, vehicle(2)])

    for size in (1, 60):
        frames = states(read(path, size)[1])
        assert [frame["1"]["throttle"] for frame in frames] == [0.25] * 3
        own = [frame["1"]["own"] for frame in frames]
        assert [(o["control_throttle"], o["control_steer"]) for o in own] == [(0.75, 0.5)] * 3
        assert [o["manual_gear"] for o in own] == [False, True, False]
        assert {(o["control_reverse"], o["control_hand_brake"]) for o in own} == {(True, False)}
        # A mirrored rotation: the bridge has the wrong sign about x and y.
        rates = {(o["ang_vel_x"], o["ang_vel_y"]) for o in own}
        assert rates == {(math.degrees(-0.5), math.degrees(0.25))}
        assert {frame["2"]["own"] for frame in frames} == {None}


def test_a_status_tells_the_gear_that_is_in_and_the_hand_brake(path: Path) -> None:
    told = [
        ({"gear": 1}, (1, 0)),
        ({"gear": 3, "hand_brake": True}, (3, 1)),
        ({"gear": 0, "manual_gear_shift": True}, (0, 0)),
        ({"gear": -1, "reverse": True}, (-1, 0)),
        ({"gear": 1, "reverse": True}, (-1, 0)),
        ({"gear": 1000}, (math.nan, 0)),  # no gearbox has it
    ]
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i, (more, _) in enumerate(told):
            bridge.status(i * 0.1, **more)
            bridge.objects(i * 0.1, [vehicle(1), vehicle(2)])

    store = kept(path)

    rows = store.sql("SELECT gear, hand_brake FROM nodes WHERE is_ego ORDER BY frame_id").values
    np.testing.assert_equal(
        [(math.nan if gear is None else gear, brake) for gear, brake in rows],
        [wanted for _, wanted in told],
    )
    others = store.sql("SELECT DISTINCT gear, hand_brake FROM nodes WHERE NOT is_ego").values
    assert others == [(None, None)]
    assert len(store.find("MATCH (e:Ego) WHERE e.gear < 0").rows()) == 2
    assert len(store.find("MATCH (e:Ego) WHERE e.hand_brake").rows()) == 1
    (fault,) = store.check("CHECK c: ALWAYS NOT (ego.hand_brake AND ego.gear = 3)")
    assert str(fault.verdict) == "false"
    about = [store.graph(f"drive#{i}").nodes[0] for i in range(6)]
    assert [(node.get("gear"), node["hand_brake"]) for node in about] == rows
    assert type(about[0]["gear"]) is int
    assert about[0]["hand_brake"] is False


def test_a_command_tells_a_gear_only_where_gears_are_shifted_by_hand(path: Path) -> None:
    told = [
        ({"gear": 1}, math.nan),
        ({"gear": 1, "reverse": True}, -1),
        ({"gear": 2, "manual_gear_shift": True}, 2),
    ]
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for i, (more, _) in enumerate(told):
            bridge.command(i * 0.1, steer=0, throttle=1, brake=0, hand_brake=i == 2, **more)
            bridge.objects(i * 0.1, [vehicle(1)])

    frames = states(read(path)[1])

    np.testing.assert_equal([f["1"]["gear"] for f in frames], [gear for _, gear in told])
    assert [f["1"]["hand_brake"] for f in frames] == [0, 0, 1]


def test_every_vehicle_has_its_own_controls(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO | {2: ("vehicle.audi.tt", "hero2"), 3: ("vehicle.audi.tt", "")})
        for i in range(3):
            bridge.status(i * 0.1, throttle=0.75, role="hero2")
            bridge.objects(i * 0.1, [vehicle(3), vehicle(2), vehicle(1)])
            bridge.status(i * 0.1, throttle=0.25)
            bridge.command(i * 0.1, steer=1, throttle=1, brake=1)
            bridge.status(i * 0.1, throttle=1, role="stranger")

    for ego in ("hero", "hero2", "3"):
        for frame in states(read(path, 2, ego=ego)[1]):
            throttles = [frame[i]["throttle"] for i in "123"]
            np.testing.assert_equal(throttles, [0.25, 0.75, math.nan])


def test_lights_of_vehicles_have_our_order(path: Path) -> None:
    order = ("position", "low_beam", "high_beam", "brake", "right", "left", "reverse", "fog")
    order += ("interior", "special1", "special2")
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        for bit in range(11):
            bridge.objects(bit * 0.1, [vehicle(1), vehicle(2)])
            bridge.vehicle_lights(bit * 0.1, {1: 1 << bit})

    frames = states(read(path)[1])

    assert [frame["1"]["lights"] for frame in frames] == [
        1 << VEHICLE_LIGHTS.index(f"light_{name}") for name in order
    ]
    assert {frame["2"]["lights"] for frame in frames} == {-1}


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"{}",
        b'{"t": "x", "lights": {}}',
        b'{"t": 1e999, "lights": {}}',
        b"[" * 100_000,
        b'{"t": 0, "lights": {"a": 1}}',
        b'{"t": 0, "lights": {"1": "a"}}',
        b'{"t": 0, "lights": 5}',
        b" " * (2 << 20),
    ],
    ids=range(10),
)
def test_lights_that_cannot_be_read_are_a_loss(path: Path, text: bytes) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(1)])
        bridge.vehicle_lights(0.0, {1: 1})
        bridge.writer.add_message(bridge.channels["/carla/vehicle_lights"], 7, text, 7)

    _, blocks, report = read(path)

    assert "a message of '/carla/vehicle_lights' cannot be read" in reasons(report)
    assert states(blocks)[0]["1"]["lights"] == 1 << VEHICLE_LIGHTS.index("light_position")


# Traffic lights and the map -----------------------------------------------------------------------


def test_a_light_is_unknown_until_it_is_told_and_then_holds(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.light_places([light(80, 25, -4, 1.5), light(81, 5, 4)])
        for i in range(9):
            bridge.objects(i * 0.1, [vehicle(1)])
            if i == 2:
                bridge.light_states({80: 0, 81: 2}, 0.25)
            if i == 5:
                bridge.light_states({80: 3}, 0.55)  # the other stays as it is
            if i == 7:
                bridge.light_states({80: 4, 81: 77}, 0.75)

    for size in (1, 4, 60):
        frames = states(read(path, size)[1])
        shown = [[LIGHT_STATES[frame[i]["light_state"]] for i in ("80", "81")] for frame in frames]

        assert shown == (
            [["unknown"] * 2] * 3
            + [["red", "green"]] * 3
            + [["off", "green"]] * 2
            + [["unknown", "unknown"]]
        )
        assert [frames[0]["80"][c] for c in ("x", "y", "heading")] == pytest.approx([25, -4, 1.5])


def test_places_of_lights_that_are_told_late_hold_from_the_start(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(1)])
        bridge.light_states({80: 0}, 0.05)
        bridge.objects(0.1, [vehicle(1)])
        bridge.light_places([light(80, 25, -4)], time=0.2)

    _, blocks, report = read(path)

    assert [LIGHT_STATES[frame["80"]["light_state"]] for frame in states(blocks)] == [
        "unknown",
        "red",
    ]
    assert report.losses == []


def test_lights_without_a_place_are_listed_and_named(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.light_places([light(80, 25, -4), light(82, math.nan, 0)])
        bridge.light_states({80: 0, 81: 1, 82: 2}, 0.0)
        bridge.objects(0.1, [vehicle(1)])

    _, blocks, report = read(path)

    assert sorted(states(blocks)[0]) == ["1", "80"]
    assert [i for i, k in kinds(blocks).items() if k == "traffic_light"] == ["80", "81", "82"]
    assert any(warning.startswith("of 2 traffic lights") for warning in report.warnings)


@pytest.mark.parametrize("by", ["world", "text"])
def test_the_map_comes_from_the_world_or_from_a_text_that_is_one(path: Path, by: str) -> None:
    with Bridge(path) as bridge:
        bridge.write("/chatter", "std_msgs/String", {"data": "hello"}, 0.0)
        if by == "world":
            bridge.world("<OpenDRIVE/>", "Game\\Carla/Maps/Town05_Opt")
        else:
            bridge.write("/carla/map", "std_msgs/String", {"data": "<?xml?><OpenDRIVE/>"}, 0.0)
        bridge.objects(0.1, [vehicle(1)])

    info, _, _ = read(path)

    assert "<OpenDRIVE/>" in info.map_text
    assert info.map_name == ("Town05_Opt" if by == "world" else "")


def test_of_two_maps_the_first_counts_and_that_is_said(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.world("<OpenDRIVE/>")
        bridge.objects(0.1, [vehicle(1)])
        bridge.world("<OpenDRIVE></OpenDRIVE>")

    info, _, report = read(path)

    assert info.map_text == "<OpenDRIVE/>"
    assert any("more than one road map" in warning for warning in report.warnings)


def crossing() -> RoadMap:
    """Two roads, one after the other along x; a light for each direction stands at their meeting."""
    lanes = section(lane(-1, before=-1, after=-1), lane(0), lane(1, before=1, after=1))

    def lamp(name: str, s: float, t: float, way: str) -> str:
        place = {"id": name, "s": s, "t": t, "orientation": way, "zOffset": 3}
        return element("signal", dynamic="yes", type="1000001", country="OpenDRIVE", **place)

    return read_map(
        a_map(
            a_road(
                "1",
                line(100),
                sections=lanes,
                links=link("successor", "road", "2", "start"),
                signals=lamp("back", 99, 6, "-"),
            ),
            a_road(
                "2",
                line(100, x=100),
                sections=lanes,
                links=link("predecessor", "road", "1", "end"),
                signals=lamp("forth", 1, -6, "+"),
            ),
        ),
        "crossing",
    )


def twins(seed: int) -> tuple[RoadMap, dict[int, Light], dict[int, str]]:
    """A map with twin signals, lights as CARLA places them, and the signal of each light.

    A light is 0.25 m in front of its signal. Those of every twentieth pole are moved sideways.
    """
    rng = np.random.default_rng(seed)
    told: list[tuple[float, float, float, float]] = []
    for pole in range(120):
        side, turn = rng.uniform(-9, 9), rng.normal(0, 0.02)
        moved = 0.0 if pole % 20 else 0.7 * float(rng.choice([-6, -4, 4, 6]))
        for twin in range(int(rng.integers(1, 4))):
            told.append((10.0 + 40 * (pole // 3), side + 0.03 * twin, turn, moved))
            told[-1] = (told[-1][0] + rng.normal(0, 0.02), *told[-1][1:])
    signals = [
        element(
            "signal", id=f"s{i}", s=s, t=t, zOffset=5, hOffset=turn, type="1000001", dynamic="yes"
        )
        for i, (s, t, turn, _) in enumerate(told)
    ]
    road_map = read_map(a_map(a_road("1", line(2000.0), signals="".join(signals))), "twins")
    rows = {name: row for row, name in enumerate(road_map.nodes.name)}
    lights: dict[int, Light] = {}
    truth: dict[int, str] = {}
    for i, ident in enumerate(rng.permutation(len(told)).tolist()):
        row, moved, nodes = rows[f"s{i}"], told[i][3], road_map.nodes
        heading = float(nodes.heading[row])
        x = float(nodes.x[row]) + 0.25 * math.cos(heading) - moved * math.sin(heading)
        y = float(nodes.y[row]) + 0.25 * math.sin(heading) + moved * math.cos(heading)
        lights[ident], truth[ident] = Light(x, y, float(nodes.z[row]), heading), f"s{i}"
    return road_map, lights, truth


@pytest.mark.parametrize("seed", range(3))
def test_twin_lights_have_their_own_signals_also_where_carla_moved_them(seed: int) -> None:
    road_map, lights, truth = twins(seed)
    found = signals_of(lights, road_map)

    wrong = [ident for ident, signal in truth.items() if found.get(ident) != signal]
    assert len(wrong) <= 0.003 * len(truth), len(truth)


def test_a_light_is_the_signal_that_stands_where_it_stands_and_faces_its_way() -> None:
    road_map = crossing()
    nodes = road_map.nodes
    column = nodes.name.index("forth")
    heading = float(nodes.heading[column])
    at = Light(101.3, -6.4, 3.0, heading)

    assert (nodes.x[column], nodes.y[column]) == (101, -6)
    assert signals_of({1: at}, road_map) == {1: "forth"}
    assert signals_of({1: replace(at, heading=heading + 6.5)}, road_map) == {1: "forth"}
    assert signals_of({1: replace(at, heading=heading + 3)}, road_map) == {}
    assert signals_of({1: replace(at, x=103)}, road_map) == {}


@pytest.mark.parametrize(
    ("box", "signal"),
    [
        ((97.0, -1.75, 0.0, 0.0, 3.0, 3.0), "forth"),  # on the lane that leads to the signal's
        ((104.0, -1.75, 0.0, 0.0, 3.0, 3.0), "forth"),  # on the signal's own
        ((97.0, -1.75, 0.0, math.pi / 2, 3.0, 3.0), "forth"),
        ((98.0, 1.75, 0.0, math.pi, 3.0, 3.0), "back"),
        ((97.0, -8.0, 0.0, 0.0, 3.0, 3.0), None),  # beside the road
        ((97.0, -3.6, 0.0, 0.0, 3.0, 2.0), None),  # on the lane's border only
        ((math.nan,) * 6, None),
    ],
)
def test_a_light_that_stands_elsewhere_is_the_signal_of_the_lanes_in_its_box(
    box: tuple[float, ...], signal: str | None
) -> None:
    assert signals_of({1: Light(120, 20, 5, 0, (box,))}, crossing()).get(1) == signal


def test_the_box_of_a_light_lies_in_the_light_s_own_axes(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.world(crossing().text)
        bridge.light_places([light(80, 120, 10, math.pi / 2, centre=(-11.75, 23, -3))])
        bridge.objects(0.0, [vehicle(1)])

    _, blocks, report = read(path)
    entities = blocks[0].entities

    assert dict(zip(entities.ident, entities.map_ref, strict=True)) == {"80": "forth", "1": ""}
    assert not any("signal" in warning for warning in report.warnings)


@pytest.mark.parametrize("text", ["", "<OpenDRIVE/>", "town"])
def test_lights_that_no_signal_tells_the_lanes_of_are_counted(path: Path, text: str) -> None:
    with Bridge(path) as bridge:
        bridge.light_places([light(80, 120, 10), light(81, 500, 500)])
        if text:
            bridge.world(crossing().text if text == "town" else text)
        bridge.objects(0.0, [vehicle(1)])

    assert any(w.startswith("2 traffic lights are no signal") for w in read(path)[2].warnings)


BOX = {"centre": (-11.75, 23, -3)}
"""Of a light at (120, 10) that faces along y: on the lane that leads to the signal ``forth``."""


def without_signals() -> RoadMap:
    return read_map(re.sub(r"<signals>.*?</signals>", "", crossing().text, flags=re.DOTALL), "bare")


@pytest.mark.parametrize("seed", range(30))
def test_no_other_assignment_has_a_smaller_sum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = int(rng.integers(1, 6))
    columns = rows + int(rng.integers(0, 3))
    cost = rng.choice([rng.random((rows, columns)), rng.integers(0, 3, (rows, columns)) * 1.0])

    chosen = least_sum(cost)

    assert len(set(chosen.tolist())) == rows
    best = min(
        sum(cost[row, column] for row, column in enumerate(one))
        for one in itertools.permutations(range(columns), rows)
    )
    assert cost[np.arange(rows), chosen].sum() == pytest.approx(best)


def test_a_light_that_the_map_does_not_have_applies_to_the_lanes_of_its_box() -> None:
    road_map = without_signals()
    lights = {
        1: Light(120, 20, 5, 0, ((97.0, -1.75, 0.0, 0.0, 3.0, 3.0),)),
        2: Light(120, 20, 5, 0, ((97.0, -8.0, 0.0, 0.0, 3.0, 3.0),)),
    }

    found = signals_of(lights, road_map)

    assert found == {1: RoadMap.lanes_ref(["1/0/-1"])}
    (lane,) = road_map.lanes_of_signal(found[1]).tolist()
    assert road_map.nodes.name[-1 - lane] == "1/0/-1"
    assert road_map.lanes_of_signal(RoadMap.lanes_ref(["9/0/-1"])).tolist() == []
    assert road_map.lanes_of_signal("lanes:{").tolist() == []


@pytest.mark.parametrize(
    ("road_map", "lanes"), [(crossing(), {"2/0/-1"}), (without_signals(), {"1/0/-1"})]
)
def test_lights_find_their_lanes_in_a_map_that_is_given(
    path: Path, tmp_path: Path, road_map: RoadMap, lanes: set[str]
) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.light_places([light(80, 120, 10, math.pi / 2, **BOX)])
        bridge.objects(0.0, [vehicle(1, 95.0, -1.75)])
    given = tmp_path / "m.xodr"
    given.write_text(road_map.text)

    (outcome,) = ingest(tmp_path / "s.db", [path], road_map=given)

    assert outcome.status == "added"
    assert not any("for which lanes" in warning for warning in outcome.warnings)
    assert not any(
        "for which lanes" in warning for warning in examine(path, road_map=given).warnings
    )
    found = StoreFile(tmp_path / "s.db").rows(
        "SELECT DISTINCT l.name FROM edges e JOIN entities n ON n.node_id = e.src"
        " JOIN lanes l ON l.node_id = e.dst WHERE e.relation = 'controlsTrafficOf' AND n.ident = '80'"
    )
    assert {name for (name,) in found.values} == lanes


# What a clip needs --------------------------------------------------------------------------------


def test_context_is_what_lasts_each_time_it_says_something_new(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.world("<OpenDRIVE/>")
        bridge.light_places([light(80, 25, -4)])
        for i in range(10):
            bridge.actors(HERO | ({2: ("vehicle.audi.tt", "")} if i > 4 else {}), time=i * 0.1)
            bridge.light_states({80: 0 if i < 7 else 2}, i * 0.1)
            bridge.objects(i * 0.1, [vehicle(1)])

    info, blocks, _ = read(path)
    told = [
        (info.channels[channel].topic, round(time / 1e8))
        for channel, time in zip(info.context.channel, info.context.log_time_ns, strict=True)
    ]

    assert told == [
        ("/carla/world_info", 0),
        ("/carla/traffic_lights/info", 0),
        ("/carla/actor_list", 0),
        ("/carla/traffic_lights/status", 0),
        ("/carla/actor_list", 5),
        ("/carla/traffic_lights/status", 7),
    ]
    roles = {channel.topic: channel.role for channel in info.channels}
    assert roles["/carla/objects"] == "ground_truth"
    assert {role for topic, role in roles.items() if topic != "/carla/objects"} == {"lasting"}
    assert {info.channels[c].topic for c in blocks[0].messages.channel} == {"/carla/objects"}


def test_a_clip_keeps_what_lasts_and_only_its_own_frames(tmp_path: Path, path: Path) -> None:
    with open_trace(drive(path)) as trace:
        info, whole = trace.info, list(trace.blocks())
    start, end = (int(whole[0].log_time_ns[i]) for i in (8, 12))
    source = Source(path, info.digest, info.context)
    (clip,) = write_clips([Clip("drive", start, end)], {"drive": source}, tmp_path / "clips")

    ours, blocks, report = read(clip.file)

    assert report.losses == []
    assert (ours.ego, ours.map_text) == (info.ego, info.map_text)
    assert kinds(blocks) == kinds(whole)
    assert blocks[0].log_time_ns.tolist() == whole[0].log_time_ns[8:13].tolist()
    assert [f["80"]["light_state"] for f in states(blocks)] == [
        f["80"]["light_state"] for f in states(whole)[8:13]
    ]


# Events -------------------------------------------------------------------------------------------


def test_collisions_and_crossed_markings_are_events_of_their_vehicle(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.actors(HERO | {2: ("vehicle.audi.tt", "hero2")})
        bridge.lane_invasion(0.0, [1])
        for i in range(4):
            bridge.objects(0.1 + i * 0.1, [vehicle(1), vehicle(2)])
            if i == 1:
                bridge.collision(0.2, 2, (3, 0, 4))
            if i == 2:
                bridge.lane_invasion(0.3, [2, 1, 2, 10, 0], role="hero2")
                bridge.collision(0.3, 0, (math.nan, 0, 0), role="stranger")

    report = read(path, 2)[2]

    assert report.events == [
        Event("lane_invasion", 0, 5_000_000, -1, "1", detail="broken"),
        Event("collision", 200_000_000, 205_000_000, 1, "1", "2", 5.0),
        Event("lane_invasion", 300_000_000, 305_000_000, 2, "2", detail="solid, broken, other"),
        Event("collision", 300_000_000, 305_000_000, 2, "", "0"),
    ]
    assert (report.losses, report.warnings) == (
        [],
        ["several egos: 'hero' (1), 'hero2' (2); the first is taken unless one is named"],
    )


def test_events_without_end_are_counted(path: Path) -> None:
    with Bridge(path) as bridge:
        bridge.objects(0.0, [vehicle(1)])
        bridge.collision(0.0, 2, (1, 0, 0))
        data = bridge.encode("carla_msgs/CarlaCollisionEvent", {})
        for _ in range(10_004):
            bridge.writer.add_message(bridge.channels["/carla/hero/collision"], 9, data, 9)

    _, blocks, report = read(path)

    assert len(report.events) == 10_000
    assert "of 10005 events the report lists the first 10000" in report.warnings
    assert sum(len(block.events) for block in blocks) == 10_005
