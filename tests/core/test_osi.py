"""OSI recordings, held against what protobuf itself reads and against drives whose numbers are known."""

from __future__ import annotations

import math
import tracemalloc
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counting import calls
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from recordings import OSI, Osi, Recorder, bulb, car, drive, ground_truth, house, ns, person, sign
from thorough import share_of

import sgstore
import sgstore.readers._blocks as frames
from sgstore.errors import TraceError
from sgstore.ingest import ingest
from sgstore.model.vocabulary import KINDS, LIGHT_STATES, VEHICLE_LIGHTS
from sgstore.model.world import FASTEST, POSE, FrameBlock, States, TraceInfo, TraceReport
from sgstore.readers import message_class, open_trace
from sgstore.readers._blocks import derive
from sgstore.readers.osi._objects import MovingObjects, light_bits, lit, shown
from sgstore.readers.osi._schema import fields_of

pytestmark = pytest.mark.seconds(13)

REAL = [
    *(
        f"esmini/{n}"
        for n in ("cut-in", "highway_merge", "pedestrian", "swarm_Town04", "traffic_lights")
    ),
    "osi_converter/MovingHostWith3DModel",
    "osi_converter/MovingHostWithStopLine",
    "osi_converter/disappearingVehicle",
    "osi_converter/testBrakeAndIndicatorLights",
    "omega_prime/osi_centerline_example",
    "sumo/Town10HD_sumo_osi",
]


@cache
def read(
    path: Path, size: int = 60, ego: str = ""
) -> tuple[TraceInfo, list[FrameBlock], TraceReport]:
    with open_trace(path, ego=ego) as trace:
        blocks = list(trace.blocks(size))
        return trace.info, blocks, trace.report


def idents(blocks: list[FrameBlock]) -> list[str]:
    return [ident for block in blocks for ident in block.entities.ident]


def column(blocks: list[FrameBlock], name: str) -> np.ndarray[Any, Any]:
    return np.concatenate([getattr(block.states, name) for block in blocks])


def of(blocks: list[FrameBlock], ident: str) -> States:
    """The states of one entity."""
    node = idents(blocks).index(ident)
    rows = column(blocks, "node") == node
    columns = {name: column(blocks, name)[rows] for name in States.__dataclass_fields__}
    return States(**columns)


def kind(blocks: list[FrameBlock], ident: str) -> str:
    codes = np.concatenate([block.entities.kind for block in blocks])
    return KINDS[codes[idents(blocks).index(ident)]]


def entity(blocks: list[FrameBlock], ident: str, name: str) -> Any:
    return [v for block in blocks for v in getattr(block.entities, name)][
        idents(blocks).index(ident)
    ]


# What protobuf reads ---------------------------------------------------------------------------------


def truths(path: Path) -> list[tuple[int, Any]]:
    """Log time and ground truth of every message, by the official reader and protobuf."""
    classes: dict[int, Any] = {}
    found: list[tuple[int, Any]] = []
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            if "Map" in schema.name:
                continue
            if schema.id not in classes:
                pool = descriptor_pool.DescriptorPool()
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
                found_type = pool.FindMessageTypeByName(schema.name)
                classes[schema.id] = message_factory.GetMessageClass(found_type)
            parsed = classes[schema.id].FromString(message.data)
            parsed = parsed.global_ground_truth if "View" in schema.name else parsed
            found.append((message.log_time, parsed))
    return found


def name_of(thing: Any) -> str:
    """What the scenario calls it: in all real recordings the identifier behind ``Vehicle`` or a key."""
    told = [text for reference in thing.source_reference for text in reference.identifier]
    keyed = [text.partition(":")[2] for text in told if text.startswith("entity_name:")]
    return (keyed or told[1:2] or [""])[0]


def expected_row(thing: Any) -> dict[str, float]:
    base = thing.base
    row = {
        "x": base.position.x,
        "y": base.position.y,
        "z": base.position.z,
        "heading": math.remainder(base.orientation.yaw, 2 * math.pi),
        "pitch": base.orientation.pitch,
        "roll": base.orientation.roll,
        "length": base.dimension.length,
        "width": base.dimension.width,
        "height": base.dimension.height,
    }
    if base.HasField("velocity"):
        row |= {f"v{axis}": getattr(base.velocity, axis) for axis in "xyz"}
    if base.HasField("acceleration"):
        row |= {f"a{axis}": getattr(base.acceleration, axis) for axis in "xyz"}
    if base.HasField("orientation_rate"):
        row["yaw_rate"] = base.orientation_rate.yaw
    return row


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_every_value_of_a_real_recording_is_what_protobuf_reads(data: Path, name: str) -> None:
    path = data / "traces" / f"{name}.mcap"
    _, blocks, report = read(path)
    names = idents(blocks)
    moving = column(blocks, "light_state") < 0
    offsets = np.cumsum([0, *(n for block in blocks for n in np.diff(block.offsets))])

    messages = truths(path)

    assert report.losses == []
    assert report.frames == len(messages)
    assert np.concatenate([b.log_time_ns for b in blocks]).tolist() == [t for t, _ in messages]
    assert np.concatenate([b.time_ns for b in blocks]).tolist() == [
        g.timestamp.seconds * 10**9 + g.timestamp.nanos for _, g in messages
    ]
    wanted = [thing for _, ground in messages for thing in ground.moving_object]
    called = {o.id.value: name_of(o) or str(o.id.value) for o in wanted}
    assert len(set(called.values())) == len(called)
    assert [names[n] for n in column(blocks, "node")[moving]] == [
        called[o.id.value] for o in wanted
    ]
    per_frame = [int(moving[a:b].sum()) for a, b in pairwise(offsets)]
    assert per_frame == [len(ground.moving_object) for _, ground in messages]
    rows = [expected_row(thing) for thing in wanted]
    for attribute in POSE:
        known = np.array([attribute in row for row in rows])
        expected = np.array([row.get(attribute, math.nan) for row in rows])
        found = column(blocks, attribute)[moving]
        assert np.abs(found[known] - expected[known]).max(initial=0) <= 1e-9
        bit = {"vx": 1, "vy": 1, "vz": 1, "ax": 2, "ay": 2, "az": 2, "yaw_rate": 4}.get(
            attribute, 0
        )
        if not known.all():  # what the recording lacks is derived and says so, or is missing
            derived = (column(blocks, "derived")[moving] & bit) != 0
            assert (derived | np.isnan(found))[~known].all()
            assert not derived[known].any()


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_static_things_of_a_real_recording_are_all_there(data: Path, name: str) -> None:
    path = data / "traces" / f"{name}.mcap"
    _, blocks, _ = read(path)
    static = np.concatenate([block.entities.static for block in blocks])
    found = {ident for ident, still in zip(idents(blocks), static, strict=True) if still}

    things = {
        str(thing.id.value): thing
        for _, ground in truths(path)
        for thing in (*ground.stationary_object, *ground.traffic_sign)
    }

    assert found == set(things)
    for block in blocks:
        for row, node in enumerate(block.scenery.node):
            base = things[idents(blocks)[node]].base
            assert block.scenery.x[row] == base.position.x
            assert block.scenery.length[row] == base.dimension.length


@pytest.mark.data
def test_the_lights_of_esmini_become_three_heads_that_change(data: Path) -> None:
    info, blocks, _ = read(data / "traces/esmini/traffic_lights.mcap")
    heads = [i for i in idents(blocks) if kind(blocks, i) == "traffic_light"]
    states = {h: of(blocks, h).light_state for h in heads}
    time = np.concatenate([block.time_ns for block in blocks]) / 1e9

    def sequence(head: str) -> list[tuple[str, float]]:
        at = [0, *(np.flatnonzero(np.diff(states[head])) + 1)]
        return [(LIGHT_STATES[states[head][i]], round(float(time[i]), 1)) for i in at]

    assert heads == ["32", "36", "39"]
    assert [entity(blocks, h, "map_ref") for h in heads] == ["1", "2", "3"]
    assert [entity(blocks, h, "subkind") for h in heads] == ["", "pedestrian", "pedestrian"]
    assert sequence("32") == [("green", 0.0), ("yellow", 3.6), ("red", 6.6), ("green", 16.6)]
    assert sequence("36") == sequence("39")
    assert sequence("36")[:2] == [("red", 0.0), ("green", 9.6)]
    assert all(len(state) == 602 for state in states.values())
    # three bulbs of 0.267 m each, the middle one at 3.8 m
    assert of(blocks, "32").z[0] == pytest.approx(3.8)
    assert of(blocks, "32").height[0] == pytest.approx(0.8)
    assert info.ego == "Ego"


@pytest.mark.data
def test_maps_and_hosts_of_real_recordings_are_found(data: Path) -> None:
    found = {}
    for name in REAL:
        info, blocks, _ = read(data / "traces" / f"{name}.mcap")
        here = sum(int((block.ego >= 0).sum()) for block in blocks)
        recorded = "" if info.map_name.endswith("(lanes)") else info.map_name
        found[name.partition("/")[2]] = (info.ego, recorded, here)

    assert found == {
        "cut-in": ("Ego", "e6mini.xodr", 441),
        "highway_merge": ("Ego", "soderleden.xodr", 286),
        "pedestrian": ("Ego", "fabriksgatan.xodr", 287),
        "swarm_Town04": ("Ego", "Town04.xodr", 602),
        "traffic_lights": ("Ego", "fabriksgatan_traffic_lights.xodr", 602),
        "MovingHostWith3DModel": ("Ego", "", 702),
        "MovingHostWithStopLine": ("Ego", "", 152),
        "disappearingVehicle": ("1", "", 364),
        "testBrakeAndIndicatorLights": ("Ego", "", 502),
        "osi_centerline_example": ("225", "", 91),
        "Town10HD_sumo_osi": ("1", "Town10HD.xodr", 600),
    }


@pytest.mark.data
def test_indicators_and_brake_lights_of_a_real_recording_are_read(data: Path) -> None:
    path = data / "traces/osi_converter/testBrakeAndIndicatorLights.mcap"
    _, blocks, _ = read(path)
    moving = column(blocks, "light_state") < 0

    expected = []
    for _, ground in truths(path):
        for thing in ground.moving_object:
            state = thing.vehicle_classification.light_state
            left, right = state.indicator_state in {3, 5}, state.indicator_state in {4, 5}
            expected.append(left | right << 1 | (state.brake_light_state in {3, 4}) << 2)

    assert column(blocks, "lights")[moving].tolist() == expected
    assert {0, 1, 4, 5} <= set(expected)


# Moving objects --------------------------------------------------------------------------------------


def record(path: Path, frames: list[dict[str, Any]]) -> Path:
    """A recording with a frame each 0.1 s, each as the words of ``ground_truth``."""
    with Recorder(path) as recorder:
        for i, words in enumerate(frames):
            recorder.ground_truth(i * 0.1, **words)
    return path


def test_a_sub_message_that_is_missing_is_missing_and_one_that_is_empty_is_zero(
    tmp_path: Path,
) -> None:
    bare, empty = car(1), car(2)
    bare.base.ClearField("orientation")
    bare.base.ClearField("dimension")
    for name in ("orientation", "velocity", "acceleration", "orientation_rate", "dimension"):
        getattr(empty.base, name).Clear()
        getattr(empty.base, name).SetInParent()
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": [bare, empty]}]))

    for name in POSE[3:]:
        assert np.isnan(getattr(of(blocks, "1"), name)[0])
        assert getattr(of(blocks, "2"), name)[0] == 0


def test_a_velocity_that_is_missing_is_the_slope_of_the_positions(tmp_path: Path) -> None:
    # x = t², y = 3t: the central difference of a parabola is its slope exactly.
    time = np.arange(12) * 0.1
    frames = [{"moving": [car(1, t * t, 3 * t), car(2, v=(9, 0), a=(1, 0))]} for t in time]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames), 5)
    states = of(blocks, "1")

    assert states.vx[1:-1] == pytest.approx(2 * time[1:-1])
    assert states.vy == pytest.approx(3)
    assert states.vx[[0, -1]] == pytest.approx([0.1, 2.1])  # one side only
    assert states.ax[1:-1] == pytest.approx(2)
    assert np.isnan(states.ax[[0, -1]]).all()
    assert states.derived.tolist() == [5, *[7] * 10, 5]  # the heading stands still: rate 0, derived
    assert of(blocks, "2").vx.tolist() == [9.0] * 12
    assert (of(blocks, "2").derived & 3 == 0).all()


def test_an_acceleration_that_is_missing_is_the_slope_of_velocities_that_were_read(
    tmp_path: Path,
) -> None:
    frames = [{"moving": [car(1, 0.0, v=(i * i, 0))]} for i in range(6)]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames), 2)
    states = of(blocks, "1")

    assert states.ax[1:-1] == pytest.approx([20, 40, 60, 80])
    assert states.ax[[0, -1]] == pytest.approx([10, 90])
    assert (states.derived & 1 == 0).all()


def test_a_yaw_rate_crosses_the_seam_of_the_circle(tmp_path: Path) -> None:
    frames = [{"moving": [car(1, yaw=math.pi - 0.15 + 0.1 * i)]} for i in range(4)]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames))

    assert of(blocks, "1").yaw_rate == pytest.approx(1.0)
    assert (np.abs(of(blocks, "1").heading) <= math.pi).all()


def test_an_object_that_was_away_is_not_differed_across_the_gap(tmp_path: Path) -> None:
    frames = [{"moving": [car(1, float(i))] if i not in {3, 4} else []} for i in range(8)]
    frames[6]["moving"] = []
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames), 3)
    states = of(blocks, "1")

    assert states.vx[:3] == pytest.approx(10)
    assert np.isnan(states.vx[3:]).all()  # the frames 5 and 7 have no neighbour
    assert states.derived.tolist() == [5, 7, 5, 0, 0]


def test_time_that_stands_still_gives_no_slope(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i, stamp in enumerate([0.0, 0.1, 0.1, 0.2, 0.1]):
            recorder.ground_truth(i * 0.1, [car(1, float(i))], stamp=stamp)
    _, blocks, report = read(path)

    assert of(blocks, "1").vx == pytest.approx([10, 10, 10, 10, np.nan], nan_ok=True)
    assert report.warnings[:2] == [
        "simulation time runs backwards 1 time",
        "simulation time stands still 1 time",
    ]


@pytest.mark.parametrize("broken", [math.nan, math.inf, 1e300])
@pytest.mark.parametrize("part", ["position.x", "position.z", "orientation.yaw"])
def test_a_pose_that_is_no_pose_is_left_out_and_its_entity_named(
    tmp_path: Path, part: str, broken: float
) -> None:
    bad = car(5, 7.0)
    group, name = part.split(".")
    setattr(getattr(bad.base, group), name, broken)
    frames = [{"moving": [car(4), bad if i in {2, 3} else car(5)]} for i in range(5)]
    _, blocks, report = read(record(tmp_path / "a.mcap", frames), 2)

    (loss,) = report.losses
    assert loss.reason == "moving object 5 has no usable pose: 2 states left out"
    assert (loss.start_ns, loss.end_ns) == (ns(0.2), ns(0.3))
    assert len(of(blocks, "5")) == 3
    assert len(of(blocks, "4")) == 5
    assert report.frames == 5


def test_an_object_without_position_is_left_out(tmp_path: Path) -> None:
    bad = OSI.MovingObject(type=2)
    bad.id.value = 5
    _, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": [car(4), bad]}]))

    assert len(column(blocks, "x")) == 1
    assert "moving object 5" in report.losses[0].reason


def test_an_id_that_comes_twice_in_a_frame_names_its_first_object(tmp_path: Path) -> None:
    frames = [{"moving": [car(1, 5.0), car(2), car(1, 9.0)]}]
    _, blocks, report = read(record(tmp_path / "a.mcap", frames))

    assert of(blocks, "1").x.tolist() == [5.0]
    assert "moving object 1 comes more than once in a frame" in report.losses[0].reason


def test_kinds_roles_and_types_that_nobody_knows(tmp_path: Path) -> None:
    ambulance, odd, other = car(1, type=6, role=3), car(2, type=0), car(3)
    other.type = 1
    raw = car(4).SerializeToString().replace(b"\x18\x02", b"\x18\x63", 1)  # type 99
    alien = OSI.MovingObject.FromString(raw)
    wheels = [car(10 + i, type=t) for i, t in enumerate((7, 10, 11, 12, 13))]
    things = [ambulance, odd, other, alien, person(5), *wheels]
    _, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": things}]))

    assert [kind(blocks, str(i)) for i in (1, 2, 3, 4, 5)] == [
        "van",
        "vehicle",
        "unknown",
        "unknown",
        "person",
    ]
    assert [kind(blocks, str(10 + i)) for i in range(5)] == [
        "truck",
        "motorcycle",
        "bicycle",
        "bus",
        "train",
    ]
    assert entity(blocks, "1", "special") == "emergency"
    assert report.unknown_types == {"TYPE_VEHICLE": 1, "TYPE_OTHER": 1, "TYPE_99": 1}
    assert len(column(blocks, "x")) == 10


def test_a_type_that_has_two_names_is_called_by_the_first() -> None:
    """``TYPE_MEDIUM_CAR`` was added to OSI later, as another name of the number of ``TYPE_CAR``."""
    sample = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
    with open_trace(sample) as trace:
        names = {name for block in trace.blocks(60) for name in block.entities.type_name}
    assert "TYPE_CAR" in names
    assert "TYPE_MEDIUM_CAR" not in names


def test_lights_of_vehicles_are_bits_and_unknown_where_there_are_none(tmp_path: Path) -> None:
    def lamps(ident: int, **states: int) -> Any:
        thing = car(ident)
        light = thing.vehicle_classification.light_state
        light.SetInParent()
        for name, value in states.items():
            setattr(light, name, value)
        return thing

    things = {
        1: lamps(1, indicator_state=3),
        2: lamps(2, indicator_state=4, brake_light_state=4),
        3: lamps(3, indicator_state=5),
        4: lamps(4, indicator_state=2, brake_light_state=2),
        5: lamps(5, reversing_light=3, head_light=3, high_beam=3),
        6: lamps(6, rear_fog_light=3, front_fog_light=2),
        7: lamps(7, emergency_vehicle_illumination=4, service_vehicle_illumination=6),
        8: lamps(8),
        9: car(9),
    }
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": list(things.values())}]))

    def lit_of(ident: int) -> set[str]:
        bits = int(of(blocks, str(ident)).lights[0])
        return {name for bit, name in enumerate(VEHICLE_LIGHTS) if bits >> bit & 1}

    assert lit_of(1) == {"light_left"}
    assert lit_of(2) == {"light_right", "light_brake"}
    assert lit_of(3) == {"light_left", "light_right"}
    assert lit_of(4) == set()
    assert lit_of(5) == {"light_reverse", "light_low_beam", "light_high_beam"}
    assert lit_of(6) == {"light_fog"}
    assert lit_of(7) == {"light_special1", "light_special2"}
    assert of(blocks, "8").lights[0] == of(blocks, "9").lights[0] == -1
    assert of(blocks, "4").lights[0] == 0


def test_pedals_of_a_sensor_view_are_the_egos_and_nobody_elses(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.sensor_view(0.0, [car(0), car(2)], host=0, throttle=0.25)
        recorder.sensor_view(0.1, [car(0), car(2)], host=0)
    _, blocks, _ = read(path)

    assert of(blocks, "0").throttle == pytest.approx([0.25, np.nan], nan_ok=True)
    assert of(blocks, "0").brake == pytest.approx([0.75, np.nan], nan_ok=True)
    assert np.isnan(of(blocks, "0").steer).all()
    assert np.isnan(of(blocks, "2").throttle).all()


numbers = st.floats(-1e6, 1e6)
parts_of_a_base = {
    part: st.fixed_dictionaries(
        {}, optional=dict.fromkeys(("x", "y", "z", "yaw", "roll", "length"), numbers)
    )
    for part in (
        "position",
        "orientation",
        "velocity",
        "acceleration",
        "orientation_rate",
        "dimension",
        "base_polygon",
    )
}
lamps = st.fixed_dictionaries(
    {},
    optional={
        "indicator_state": st.integers(0, 5),
        "brake_light_state": st.integers(0, 4),
        "rear_fog_light": st.integers(0, 4),
        "head_light": st.integers(0, 4),
    },
)


@st.composite
def moving_objects(draw: Any) -> Any:
    thing = OSI.MovingObject()
    if draw(st.booleans()):
        thing.id.value = draw(st.integers(0, (1 << 64) - 1))
    for part, values in draw(st.fixed_dictionaries({}, optional=parts_of_a_base)).items():
        inner = (
            thing.base.base_polygon.add() if part == "base_polygon" else getattr(thing.base, part)
        )
        inner.SetInParent()
        for name, value in values.items():
            if name in inner.DESCRIPTOR.fields_by_name:
                setattr(inner, name, value)
    if draw(st.booleans()):
        vehicle = thing.vehicle_classification
        vehicle.type = draw(st.integers(0, 2))
        for name, value in draw(lamps).items():
            setattr(vehicle.light_state, name, value)
    return thing


def assert_read_as_attributes(contents: list[bytes]) -> None:
    """That objects read in bulk are what protobuf reads of them one by one."""
    values, usable, lights, _ = MovingObjects(OSI.MovingObject).read(contents)

    sources = {
        **{name: ("position", name) for name in "xyz"},
        "heading": ("orientation", "yaw"),
        "pitch": ("orientation", "pitch"),
        "roll": ("orientation", "roll"),
        **{f"v{axis}": ("velocity", axis) for axis in "xyz"},
        **{f"a{axis}": ("acceleration", axis) for axis in "xyz"},
        "yaw_rate": ("orientation_rate", "yaw"),
        **{name: ("dimension", name) for name in ("length", "width", "height")},
    }
    for row, content in enumerate(contents):
        try:
            thing = OSI.MovingObject.FromString(content)
        except DecodeError:
            continue  # what is hurt elsewhere may have a pose all the same
        base = thing.base
        near = [abs(v) < 1e9 for v in (base.position.x, base.position.y, base.position.z)]
        assert usable[row] == (
            base.HasField("position") and all(near) and abs(base.orientation.yaw) < 1e9
        )
        assert lights[row] == light_bits(thing)
        for place, name in enumerate(POSE):
            part, inner = sources[name]
            expected = getattr(getattr(base, part), inner) if base.HasField(part) else math.nan
            assert values[row, place] == pytest.approx(expected, nan_ok=True, abs=0, rel=0)


@settings(max_examples=share_of(80), deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(moving_objects(), max_size=12))
def test_objects_read_in_bulk_are_what_their_attributes_say(things: list[Any]) -> None:
    assert_read_as_attributes([thing.SerializeToString() for thing in things])


@settings(max_examples=share_of(60), deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(moving_objects(), min_size=1, max_size=5), st.data())
def test_objects_that_are_hurt_or_oddly_written_are_what_protobuf_says(
    things: list[Any], draw: Any
) -> None:
    contents = []
    for thing in things:
        content = thing.SerializeToString()
        match draw.draw(st.sampled_from(["twice", "cut", "flip", "group", "as it is"])):
            case "twice":  # protobuf merges what comes twice
                content += draw.draw(st.sampled_from(things)).SerializeToString()
            case "cut":
                content = content[: draw.draw(st.integers(0, len(content)))]
            case "flip" if content:
                at = draw.draw(st.integers(0, len(content) - 1))
                hurt = content[at] ^ draw.draw(st.integers(1, 255))
                content = content[:at] + bytes([hurt]) + content[at + 1 :]
            case "group":
                content = b"\x7b" + content + b"\x7c"
            case _:
                pass
        contents += [content, content]
    assert_read_as_attributes(contents)


def test_layouts_without_end_are_read_all_the_same() -> None:
    things = []
    for i in range(400):
        thing = car(1 + i % 90)
        thing.source_reference.add(type="t" * (i % 90), identifier=["x"] * (1 + i // 90))
        thing.base.base_polygon.add().x = float(i)
        things.append(thing.SerializeToString())
    odd = [OSI.MovingObject(type=2).SerializeToString() + thing for thing in things[:90]]
    assert_read_as_attributes(things + odd)


@settings(max_examples=share_of(60), deadline=None)
@given(
    st.lists(st.sets(st.integers(0, 4)), min_size=1, max_size=7),
    st.lists(st.integers(-1, 3), min_size=7, max_size=7),
    st.data(),
)
def test_derived_velocities_are_those_of_the_textbook(
    present: list[set[int]], steps: list[int], draw: Any
) -> None:
    time = np.cumsum([0, *steps])[: len(present)] * 10**8
    node, frame, x = [], [], []
    for f, nodes in enumerate(present):
        for n in sorted(nodes, reverse=True):
            node.append(n)
            frame.append(f)
            x.append(draw.draw(st.floats(-5, 5)))
    values = np.full((len(node), len(POSE)), np.nan)
    values[:, :4] = np.array(x, float).reshape(-1, 1)
    at = {(f, n): v for f, n, v in zip(frame, node, x, strict=True)}

    seconds = np.diff(time, prepend=0) / 1e9
    found, derived, _ = derive(
        np.array(node, np.int64),
        np.array(frame, np.int64),
        np.where(seconds > 0, seconds, np.nan),
        values,
        np.zeros(len(node), np.bool_),
        slice(0, len(node)),
    )

    for row, (f, n) in enumerate(zip(frame, node, strict=True)):
        known = [
            (time[g], at[g, n])
            for g in (f - 1, f, f + 1)
            if (g, n) in at
            and (g == f or (time[g] - time[f]) * (g - f) > 0)
            # all three coordinates are x
            and abs(at[g, n] - at[f, n]) * 3**0.5 <= FASTEST * abs(time[g] - time[f]) / 1e9
        ]
        if len(known) == 1:
            assert np.isnan(found[row, 6])
            assert derived[row] & 1 == 0
        else:
            (t0, x0), (t1, x1) = known[0], known[-1]
            assert found[row, 6] == pytest.approx((x1 - x0) / ((t1 - t0) / 1e9), abs=1e-9)
            assert derived[row] & 1


# Lights and static things ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bulbs", "state"),
    [
        pytest.param([(2, 3), (3, 2), (4, 2)], "red", id="red"),
        pytest.param([(2, 2), (3, 3), (4, 2)], "yellow", id="yellow"),
        pytest.param([(2, 2), (3, 2), (4, 3)], "green", id="green"),
        pytest.param([(2, 3), (3, 3), (4, 2)], "red_yellow", id="red with yellow"),
        pytest.param([(2, 2), (3, 4), (4, 2)], "flashing", id="yellow flashing"),
        pytest.param([(2, 2), (3, 2), (4, 2)], "off", id="nothing lit"),
        pytest.param([(2, 3), (4, 3)], "red", id="red with a green arrow"),
        pytest.param([(6, 3)], "unknown", id="white"),
        pytest.param([(2, 0)], "unknown", id="mode unknown"),
        pytest.param([(4, 5)], "green", id="green counting down"),
    ],
)
def test_a_head_shows_what_its_lit_bulbs_show(bulbs: list[tuple[int, int]], state: str) -> None:
    assert LIGHT_STATES[shown(lit(mode, colour) for colour, mode in bulbs)] == state


def test_bulbs_one_above_another_are_one_head_and_others_are_not(tmp_path: Path) -> None:
    column_of_three = [bulb(i, i, 3 if i == 2 else 2, (5.004, 1, 4.5 - 0.3 * i)) for i in (2, 3, 4)]
    nudged = bulb(5, 4, 2, (5.011, 1, 3.0))
    aside = bulb(6, 2, 3, (5.5, 1, 3.9))
    turned = bulb(7, 4, 3, (5.004, 1, 3.9))
    turned.base.orientation.yaw = 2.5
    lights = [*column_of_three, nudged, aside, turned]
    frames = [{"moving": [car(1)], "lights": lights, "host": 1}]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames))

    heads = [i for i in idents(blocks) if kind(blocks, i) == "traffic_light"]
    assert heads == ["2", "6", "7"]
    assert [LIGHT_STATES[of(blocks, h).light_state[0]] for h in heads] == ["red", "red", "green"]
    assert of(blocks, "2").z[0] == pytest.approx((3.9 + 0.15 + 3.0 - 0.15) / 2)
    assert of(blocks, "2").height[0] == pytest.approx(1.2)


def test_bulbs_of_one_signal_are_one_head_wherever_they_stand(tmp_path: Path) -> None:
    lights = [bulb(2, 2, 2, (5, 1, 4), ref="s1"), bulb(3, 4, 3, (6, 1, 4), ref="s1")]
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": [car(1)], "lights": lights}]))

    assert kind(blocks, "2") == "traffic_light"
    assert entity(blocks, "2", "map_ref") == "s1"
    assert LIGHT_STATES[of(blocks, "2").light_state[0]] == "green"
    assert not entity(blocks, "2", "static")


def test_a_head_goes_on_showing_what_it_showed_while_frames_are_silent(tmp_path: Path) -> None:
    red = [bulb(2, 2, 3, (5, 1, 4)), bulb(4, 4, 2, (5, 1, 3.7))]
    only_green = [bulb(4, 4, 3, (5, 1, 3.7))]
    no_red = [bulb(2, 2, 2, (5, 1, 4))]
    frames = [{"moving": [car(1)], "lights": x} for x in (red, [], only_green, [], no_red, [])]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames), 2)

    states = [LIGHT_STATES[s] for s in of(blocks, "2").light_state]
    assert states == ["red", "red", "red", "red", "green", "green"]  # red with green is red


def test_a_bulb_out_of_service_is_off(tmp_path: Path) -> None:
    dark = bulb(2, 2, 3, (5, 1, 4))
    dark.classification.is_out_of_service = True
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": [car(1)], "lights": [dark]}]))

    assert LIGHT_STATES[of(blocks, "2").light_state[0]] == "off"


def test_a_light_without_place_is_an_entity_without_states_and_said_to_be(tmp_path: Path) -> None:
    lights = [bulb(2, 2, 3), bulb(3, 2, 3, ref="9")]
    frames = [{"moving": [car(1)], "lights": lights, "host": 1}]
    _, blocks, report = read(record(tmp_path / "a.mcap", frames))

    assert len(of(blocks, "2")) == 0
    assert len(of(blocks, "3")) == 1
    assert np.isnan(of(blocks, "3").x[0])
    assert "1 traffic lights have neither a position" in report.warnings[0]


def test_static_things_stand_from_the_first_frame_on_whenever_they_are_told(tmp_path: Path) -> None:
    statics = {"houses": [house(50, 30.0), house(51, 5.0, 4)], "signs": [sign(60, 17, 20.0)]}
    frames = [{"moving": [car(1)], **(statics if i in {1, 3} else {})} for i in range(5)]
    frames[4] |= {"signs": [sign(61, 16)]}
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames), 2)

    assert [block.entities.ident for block in blocks] == [("1", "50", "51", "60", "61"), (), ()]
    assert blocks[0].scenery.node.tolist() == [1, 2, 3, 4]
    assert blocks[0].scenery.x.tolist() == [30.0, 5.0, 20.0, 0.0]
    assert blocks[0].scenery.heading.tolist() == [0.25, 0.25, 0.5, 0.5]
    assert set(column(blocks, "node")) == {0}
    assert entity(blocks, "50", "map_ref") == "50"


def test_signs_are_what_their_type_says_and_unknown_ones_survive(tmp_path: Path) -> None:
    raw = sign(5, 17).SerializeToString().replace(b"\x10\x11", b"\x10\x7b", 1)  # type 123
    signs = [
        sign(1, 17),
        sign(2, 16),
        sign(3, 52),
        sign(4, 29),
        OSI.TrafficSign.FromString(raw),
        sign(6, 0),
        sign(7, 140),
    ]
    _, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": [car(9)], "signs": signs}]))

    assert [kind(blocks, str(i)) for i in range(1, 8)] == [
        "stop_sign",
        "yield_sign",
        "speed_limit",
        "sign",
        "sign",
        "sign",
        "prop",
    ]
    assert entity(blocks, "5", "type_name") == "TYPE_123"
    assert report.unknown_types == {"TYPE_123": 1, "TYPE_UNKNOWN": 1}


def test_a_static_thing_without_a_place_is_a_loss_once(tmp_path: Path) -> None:
    lost = house(50)
    lost.base.position.x = math.nan
    frames = [{"moving": [car(1)], "houses": [lost]}] * 3
    _, blocks, report = read(record(tmp_path / "a.mcap", frames))

    assert idents(blocks) == ["1"]
    assert report.losses[0].reason.startswith("stationary object 50 has no usable pose")


def test_ids_that_two_things_share_are_told_apart(tmp_path: Path) -> None:
    frames = [{"moving": [car(5)], "houses": [house(5)], "signs": [sign(5, 17)]}]
    _, blocks, _ = read(record(tmp_path / "a.mcap", frames))

    assert idents(blocks) == ["5", "5:building", "5:stop_sign"]


# The ego, the map, what later messages depend on -----------------------------------------------------


def test_the_host_vehicle_is_the_ego_and_zero_is_an_id(tmp_path: Path) -> None:
    frames = [{"moving": [car(3), car(0)] if i else [car(3)], "host": 0} for i in range(3)]
    info, blocks, _ = read(record(tmp_path / "a.mcap", frames))

    assert info.ego == "0"
    assert blocks[0].ego.tolist() == [-1, 1, 1]


@pytest.mark.parametrize("host", [None, 77])
def test_a_host_that_is_not_there_means_no_ego_and_is_said(
    tmp_path: Path, host: int | None
) -> None:
    info, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": [car(3)], "host": host}]))

    assert info.ego == ""
    assert blocks[0].ego.tolist() == [-1]
    assert any("no host vehicle" in warning for warning in report.warnings)


def test_ingest_without_ego_lists_vehicles_that_are_in_all_frames(tmp_path: Path) -> None:
    always = [car(number) for number in range(2, 9)]
    frames = [{"moving": always + [car(1)] * (i != 40), "host": None} for i in range(80)]
    (many,) = ingest(tmp_path / "a.sgstore", [record(tmp_path / "a.mcap", frames)])
    frames = [{"moving": [car(i // 10)], "host": None} for i in range(80)]
    (none,) = ingest(tmp_path / "b.sgstore", [record(tmp_path / "b.mcap", frames)])
    (named,) = ingest(tmp_path / "c.sgstore", [tmp_path / "a.mcap"], egos=["3"])

    listed = ", ".join(f"{number} (car)" for number in range(2, 7))
    hint = "name the ego with --ego ID; "
    assert f"{hint}in all frames: {listed}, … (7 in all)" in many.warnings
    assert f"{hint}no vehicle is in all frames" in none.warnings
    assert not any("--ego" in warning for warning in named.warnings)


def test_the_host_of_a_sensor_view_comes_before_that_of_the_truth_in_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        view = OSI.SensorView()
        view.host_vehicle_id.value = 2
        view.global_ground_truth.CopyFrom(ground_truth(0.0, [car(1), car(2)], host=1))
        recorder.write(recorder.channel("v", "osi3.SensorView"), 0.0, view.SerializeToString())

    assert read(path)[0].ego == "2"


def test_the_ego_can_be_named_by_id_or_name(tmp_path: Path) -> None:
    frames = [
        {"moving": [car(3, name="Rival"), car(7)] if i == 2 else [car(7)], "host": 7}
        for i in range(4)
    ]
    path = record(tmp_path / "a.mcap", frames)

    assert read(path, 60, "3")[0].ego == read(path, 60, "Rival")[0].ego == "Rival"
    assert read(path, 60, "Rival")[1][0].ego.tolist() == [-1, -1, 1, -1]


def test_an_ego_that_nothing_bears_is_answered_with_what_there_is(tmp_path: Path) -> None:
    frames = [{"moving": [car(3, name="Rival"), car(7)]}]
    path = record(tmp_path / "a.mcap", frames)

    with pytest.raises(TraceError, match=r"'hero'; there are: 3 \(Rival\), 7"):
        open_trace(path, ego="hero")


def test_a_name_that_two_objects_bear_names_neither(tmp_path: Path) -> None:
    frames = [{"moving": [car(3, name="Car"), car(7, name="Car")]}]
    path = record(tmp_path / "a.mcap", frames)

    with pytest.raises(TraceError, match="several objects are named 'Car': ids 3, 7"):
        open_trace(path, ego="Car")


def test_a_map_is_found_wherever_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, chunk_size=300) as recorder:
        for i in range(9):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
        recorder.map("<OpenDRIVE late='yes'/>", 0.9, "C:\\maps\\town.xodr")
    info, _, report = read(path)

    assert info.map_text == "<OpenDRIVE late='yes'/>"
    assert info.map_name == "town.xodr"
    assert [channel.role for channel in info.channels] == ["ground_truth", "map"]
    assert report.warnings == []


def test_of_two_maps_the_first_counts_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.map("<OpenDRIVE n='1'/>")
        recorder.map("<OpenDRIVE n='2'/>")
        recorder.ground_truth(0.0, [car(1)], host=1)
    info, _, report = read(path)

    assert info.map_text == "<OpenDRIVE n='1'/>"
    assert report.warnings == ["the recording carries more than one road map; the first one counts"]


def context_times(path: Path) -> list[float]:
    return [time / 1e9 for time in read(path)[0].context.log_time_ns.tolist()]


def test_static_data_that_is_told_once_is_context(tmp_path: Path) -> None:
    frames: list[dict[str, Any]] = [{"moving": [car(1)]} for _ in range(8)]
    frames[0] |= {"lanes": [1, 2], "houses": [house(50)]}
    frames[2] |= {"lanes": [1, 2]}  # nothing new
    frames[5] |= {"houses": [house(51)]}

    assert context_times(record(tmp_path / "a.mcap", frames)) == [0.0, 0.5]


def test_static_data_that_every_message_repeats_is_no_context(tmp_path: Path) -> None:
    frames = [
        {"moving": [car(1)], "lanes": [1, 2], "houses": [house(50)] if i > 3 else []}
        for i in range(8)
    ]

    assert context_times(record(tmp_path / "a.mcap", frames)) == []


def test_lights_that_are_told_only_when_they_change_are_context(tmp_path: Path) -> None:
    told = [bulb(2, 2, 3, (5, 1, 4))]
    frames = [{"moving": [car(1)], "lights": told if i in {0, 4, 7} else []} for i in range(8)]

    assert context_times(record(tmp_path / "a.mcap", frames)) == [0.0, 0.4]


def test_what_a_channel_tells_once_and_at_the_beginning_is_context(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.camera(0.0, topic="calibration")
        for i in range(30):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
            recorder.camera(i * 0.1)
        recorder.camera(2.5, topic="collision")

    info, blocks, _ = read(path)
    (topic,) = [info.channels[channel].topic for channel in info.context.channel]
    assert topic == "calibration"
    assert sum(len(block.messages) for block in blocks) == 62


def test_the_channel_with_most_frames_leads_and_a_truth_before_a_view(tmp_path: Path) -> None:
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with Recorder(path) as recorder:
        recorder.ground_truth(0.0, [car(1)])
        for i in range(3):
            recorder.sensor_view(i * 0.1, [car(1), car(2)])
    with Recorder(other) as recorder:
        for i in range(3):
            recorder.sensor_view(i * 0.1, [car(1), car(2)])
            recorder.ground_truth(i * 0.1, [car(1)])

    roles = {channel.topic: channel.role for channel in read(path)[0].channels}
    assert roles == {"truth": "payload", "view": "ground_truth"}
    roles = {channel.topic: channel.role for channel in read(other)[0].channels}
    assert roles == {"view": "payload", "truth": "ground_truth"}


def test_messages_outside_the_interval_of_a_clip_are_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.writer.add_metadata(
            "sgstore.clip", {"start_ns": str(ns(0.3)), "end_ns": str(ns(0.5))}
        )
        for i in range(8):
            statics = (
                {"houses": [house(50)], "lights": [bulb(2, 2, 3, (1, 1, 1))]} if i == 0 else {}
            )
            recorder.ground_truth(
                i * 0.1, [car(1), *([car(9)] if i == 1 else [])], host=1, **statics
            )
            recorder.camera(i * 0.1)
    _, blocks, report = read(path)

    assert blocks[0].log_time_ns.tolist() == [ns(0.3), ns(0.4), ns(0.5)]
    assert report.frames == 3
    assert idents(blocks) == ["2", "1", "50"]
    assert LIGHT_STATES[of(blocks, "2").light_state[0]] == "red"
    assert len(blocks[0].messages) == 6


# Recordings that cannot be read ----------------------------------------------------------------------


def test_a_recording_without_ground_truth_is_answered_with_its_channels(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.camera(0.0)
        recorder.map("<OpenDRIVE/>")

    with pytest.raises(TraceError, match=r"'camera' \(pictures.Image\), 'map'"):
        open_trace(path)


@pytest.mark.parametrize("summary", [True, False])
def test_a_recording_without_messages_is_refused(tmp_path: Path, summary: bool) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, summary=summary) as recorder:
        recorder.channel("truth", "osi3.GroundTruth")

    with pytest.raises(TraceError, match=r"no ground truth message|no channel has any message"):
        open_trace(path)


def test_messages_that_cannot_be_read_are_losses_and_the_others_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(5):
            recorder.ground_truth(i * 0.1, [car(1, i)], host=1)
            if i == 2:
                recorder.write(recorder.channels["truth"], 0.25, b"\xff\xff\xff")
    _, _, report = read(path)

    assert report.frames == 5
    (loss,) = report.losses
    assert (loss.messages, loss.bytes, loss.start_ns) == (1, 3, ns(0.25))
    assert "cannot be read" in loss.reason


def test_a_message_of_countless_objects_is_a_loss_and_costs_little(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.ground_truth(0.0, [car(1)], host=1)
        recorder.write(recorder.channels["truth"], 0.1, b"\x2a\x00" * 3_000_000)
        recorder.sensor_view(0.2, [])

    tracemalloc.start()
    with calls() as counted:
        _, _, report = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert report.frames == 1
    assert "more than 100000 objects" in report.losses[0].reason
    assert counted.total() < 1_000_000
    assert peak < 64 << 20


def test_what_nobody_reads_is_not_parsed() -> None:
    schema = Schema(1, OSI.files.SerializeToString(), "protobuf", "osi3.GroundTruth")
    ground = ground_truth(0.0, [car(1)], lanes=[4])
    ground.lane[0].classification.centerline.add().x = 5.0

    read_back = message_class(schema).FromString(ground.SerializeToString())

    assert [name.name for name, _ in read_back.lane[0].ListFields()] == ["id"]
    assert read_back.SerializeToString() == ground.SerializeToString()  # kept, as bytes


def test_a_schema_that_lacks_what_all_versions_have_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, files=Osi({"BaseMoving.position"}).files) as recorder:
        recorder.ground_truth(0.0, [car(1)])

    with pytest.raises(TraceError, match=r"no field base\.position"):
        open_trace(path)


def test_an_older_schema_without_what_came_later_is_read(tmp_path: Path) -> None:
    later = {
        "BaseMoving.orientation_rate",
        "VehicleClassification.light_state",
        "VehicleClassification.role",
        "MovingObject.source_reference",
        "TrafficLight.source_reference",
        "BulbClassification.is_out_of_service",
        "GroundTruth.stationary_object",
        "GroundTruth.lane",
        "GroundTruth.host_vehicle_id",
    }
    path = tmp_path / "a.mcap"
    with Recorder(path, files=Osi(later).files) as recorder:
        recorder.ground_truth(0.0, [car(1, 3.0)], lights=[bulb(2, 2, 3, (1, 1, 1))], host=1)
    info, blocks, report = read(path)

    assert info.ego == ""
    assert of(blocks, "1").x.tolist() == [3.0]
    assert kind(blocks, "2") == "traffic_light"
    assert report.losses == []


def test_a_frame_without_time_takes_its_log_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.ground_truth(0.5, [car(1)], host=1, stamp=None)
    _, blocks, report = read(path)

    assert blocks[0].time_ns.tolist() == [ns(0.5)]
    assert "1 frame without a time" in report.warnings[0]


def test_memory_does_not_grow_with_the_length_of_a_recording(tmp_path: Path) -> None:
    def peak(frames: int) -> int:
        path = drive(tmp_path / f"{frames}.mcap", frames, camera=False, chunk_size=1 << 16)
        with open_trace(path) as trace:
            tracemalloc.start()
            for _ in trace.blocks():
                pass
            highest = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        return highest

    assert peak(3000) < 1.3 * peak(600)


# Who is who, and what is split ------------------------------------------------------------------------


def test_an_object_is_called_as_the_scenario_calls_it_if_nothing_else_is(tmp_path: Path) -> None:
    bare = car(4)
    bare.source_reference.add(identifier=["Vehicle", "Truck7", "MilkTruck"])
    things = [car(1, name="Ego"), car(2, name="Twin"), car(3, name="Twin"), bare, car(5, name="1")]
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": things, "host": 1}]))

    assert idents(blocks) == ["Ego", "2", "3", "Truck7", "5"]


@pytest.mark.parametrize(
    ("host", "names", "ego", "word"),
    [
        (0, {0: "", 1: "Ego"}, "0", ""),
        (None, {0: "Other", 1: "Ego"}, "Ego", "host vehicle in the file: none"),
        (77, {0: "Other", 1: "hero"}, "hero", "host vehicle 77: no moving object"),
        (77, {0: "Other", 1: "Rival"}, "", "the moving objects contain no host vehicle"),
        (None, {0: "Ego", 1: "Hero"}, "", "the moving objects contain no host vehicle"),
        ((1 << 64) - 1, {(1 << 64) - 1: "", 1: "Ego"}, str((1 << 64) - 1), ""),
    ],
)
def test_odd_host_ids(
    tmp_path: Path, host: int | None, names: dict[int, str], ego: str, word: str
) -> None:
    things = [car(ident, name=name) for ident, name in names.items()]
    info, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": things, "host": host}]))

    assert info.ego == ego
    assert (blocks[0].ego[0] >= 0) == bool(ego)
    assert any(word in warning for warning in report.warnings) if word else not report.warnings


def test_the_ego_follows_a_host_that_changes(tmp_path: Path) -> None:
    hosts = [1, 1, None, 2, 2, 77, 1]
    frames = [{"moving": [car(1), car(2)], "host": host} for host in hosts]
    path = record(tmp_path / "a.mcap", frames)
    info, blocks, report = read(path)

    def egos(blocks: list[FrameBlock]) -> list[str]:
        idents = [ident for block in blocks for ident in block.entities.ident]
        return [idents[node] for block in blocks for node in block.ego.tolist()]

    assert info.ego == "1"
    assert egos(blocks) == ["1", "1", "1", "2", "2", "2", "1"]
    assert report.warnings == ["several host vehicles (ids 1, 2); the ego is that of each message"]
    with open_trace(path, ego="2") as trace:
        assert egos(list(trace.blocks())) == ["2"] * 7


def test_a_truth_split_over_messages_of_one_time_is_one_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(7):
            recorder.ground_truth(i * 0.1, [car(1, float(i))], host=1)
            recorder.ground_truth(i * 0.1 + 0.01, [person(2, float(-i))], stamp=i * 0.1)
            recorder.ground_truth(
                i * 0.1 + 0.02, [], stamp=i * 0.1, lights=[bulb(9, 2, 3, (1, 1, 1))]
            )
    for size in (1, 2, 60):
        _, blocks, report = read(path, size)
        assert report.frames == 7
        assert report.warnings == report.losses == []
        assert of(blocks, "1").x.tolist() == [float(i) for i in range(7)]
        assert of(blocks, "2").x.tolist() == [float(-i) for i in range(7)]
        assert len(of(blocks, "9")) == 7
        assert sum(len(block.messages) for block in blocks) == 21


@pytest.mark.parametrize("later", [0.0, 0.03, -0.03])
def test_a_truth_split_over_channels_is_one_frame(tmp_path: Path, later: float) -> None:
    path = tmp_path / "a.mcap"
    told: list[tuple[float, dict[str, Any]]] = []
    for i in range(8):
        told.append((i * 0.1 + 0.05, {"moving": [car(1, float(i)), car(3)], "host": 1}))
        if i % 2 == 0:
            told.append(
                (i * 0.1 + 0.05 + later, {"moving": [person(2, float(i))], "topic": "walkers"})
            )
    with Recorder(path) as recorder:
        recorder.ground_truth(0.0, [], houses=[house(50)], signs=[sign(60, 17)], topic="scenery")
        for at, words in sorted(told, key=lambda pair: pair[0]):
            stamp = round(at, 1) if "host" not in words else at - 0.05
            recorder.ground_truth(at, stamp=round(stamp, 1) if later else at - 0.05, **words)
    info, blocks, report = read(path, 3)

    assert report.frames == 8
    assert report.losses == []
    assert of(blocks, "2").x.tolist() == [0.0, 2.0, 4.0, 6.0]
    assert of(blocks, "1").x.tolist() == [float(i) for i in range(8)]
    assert {kind(blocks, "50"), kind(blocks, "60")} == {"building", "stop_sign"}
    assert [channel.role for channel in info.channels].count("ground_truth") == 1
    topics = {info.channels[channel].topic for channel in info.context.channel.tolist()}
    assert "scenery" in topics


def test_what_another_channel_tells_between_frames_is_not_lost_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(6):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
            if i % 2:
                recorder.ground_truth(i * 0.1 + 0.05, [car(1), person(2)], topic="other")
    _, blocks, report = read(path)

    assert idents(blocks) == ["1"]
    (loss,) = report.losses
    assert "moving object 2 appears only between the frames" in loss.reason


def test_the_gear_is_that_of_the_egos_gearbox_and_osi_has_no_hand_brake(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i, gear in enumerate((0, 1, None, -1, 6)):
            data = OSI.HostVehicleData()
            data.vehicle_brake_system.pedal_position_brake = 0.5
            if gear is not None:
                data.vehicle_powertrain.gear_transmission = gear
            channel = recorder.channel("host", "osi3.HostVehicleData")
            recorder.write(channel, i * 0.1, data.SerializeToString())
            recorder.ground_truth(i * 0.1, [car(0), car(1)], host=0)
    _, blocks, _ = read(path)

    assert of(blocks, "0").gear == pytest.approx([0, 1, np.nan, -1, 6], nan_ok=True)
    assert np.isnan(of(blocks, "0").hand_brake).all()
    assert np.isnan(of(blocks, "1").gear).all()


def test_pedals_on_a_channel_of_their_own_are_the_egos(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(4):
            data = OSI.HostVehicleData()
            data.vehicle_powertrain.pedal_position_acceleration = i / 10
            channel = recorder.channel("host", "osi3.HostVehicleData")
            recorder.write(channel, i * 0.1, data.SerializeToString())
            recorder.ground_truth(i * 0.1, [car(0), car(1)], host=0)
    _, blocks, _ = read(path)

    assert of(blocks, "0").throttle.tolist() == [0.0, 0.1, 0.2, 0.3]
    assert np.isnan(of(blocks, "1").throttle).all()
    assert np.isnan(of(blocks, "0").brake).all()


def test_what_the_map_knows_of_an_object_is_its_kind_where_the_recording_does_not(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.map(
            "<OpenDRIVE><object id='50' type=\"pole\"/><object id='51' type='tree'/></OpenDRIVE>"
        )
        things = [house(50, kind=0), house(51, kind=3), house(52, kind=0)]
        recorder.ground_truth(0.0, [car(1)], houses=things, host=1)
    _, blocks, report = read(path)

    assert [kind(blocks, ident) for ident in ("50", "51", "52")] == ["pole", "building", "unknown"]
    assert report.unknown_types == {"TYPE_UNKNOWN": 1}


def test_a_speed_limit_says_how_fast(tmp_path: Path) -> None:
    limits = []
    for ident, (value, unit) in enumerate([(50, 3), (35, 4), (0, 3)]):
        limit = sign(ident, 52)
        limit.main_sign.classification.value.value = value
        limit.main_sign.classification.value.value_unit = unit
        limits.append(limit)
    _, blocks, _ = read(record(tmp_path / "a.mcap", [{"moving": [car(9)], "signs": limits}]))

    assert [kind(blocks, str(i)) for i in range(3)] == ["speed_limit"] * 3
    assert [entity(blocks, str(i), "subkind") for i in range(3)] == ["50", "35 mph", ""]


def test_one_malformed_object_does_not_cost_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(3):
            good = car(1, float(i)).SerializeToString()
            bad = b"\x0a\x02\x08" if i == 1 else car(2).SerializeToString()
            parts = [b"\x2a" + bytes([len(part)]) + part for part in (bad, good)]
            stamp = ground_truth(i * 0.1, host=1).SerializeToString()
            channel = recorder.channel("truth", "osi3.GroundTruth")
            recorder.write(channel, i * 0.1, stamp + b"".join(parts))
    _, blocks, report = read(path)

    assert of(blocks, "1").x.tolist() == [0.0, 1.0, 2.0]
    assert len(of(blocks, "2")) == 2
    (loss,) = report.losses
    assert "a moving object cannot be read" in loss.reason


def test_numbers_that_nothing_on_earth_has_are_missing_and_counted(tmp_path: Path) -> None:
    fast = car(1, v=(1e300, math.inf), a=(1e9, 3.0))
    large = house(50)
    large.base.dimension.length = 1e200
    _, blocks, report = read(record(tmp_path / "a.mcap", [{"moving": [fast], "houses": [large]}]))

    assert np.isnan(of(blocks, "1").vx).all()
    assert of(blocks, "1").ay.tolist() == [3.0]
    assert np.isnan(blocks[0].scenery.length).all()
    assert "4 numbers of 1e+09 and more are taken as missing" in report.warnings


@pytest.mark.parametrize("size", [1, 60])
def test_of_messages_without_end_between_two_frames_those_near_them_are_referred_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(frames, "NEAR_REFS", 20)
    path = tmp_path / "a.mcap"
    with Recorder(path, chunk_size=500) as recorder:
        for i in range(300):
            recorder.camera(i / 10)
            if i in {100, 101, 290}:
                recorder.ground_truth(i / 10 + 0.01, [car(1)], host=1)
    with open_trace(path) as trace:
        blocks = list(trace.blocks(size))
        warnings = trace.report.warnings

    times = np.concatenate([block.messages.log_time_ns for block in blocks])
    assert len(times) < 200
    assert (np.diff(times) > 0).all()
    for near in (*range(85, 116), *range(275, 300)):
        assert ns(near / 10) in times
    assert ns(20.0) not in times
    dropped = 303 - len(times)
    assert f"{dropped} sensor messages are far from all frames and were not linked" in warnings


def test_weather_and_light_are_events_when_they_begin_and_change(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(8):
            ground = ground_truth(i / 10, [car(1)], host=1)
            told = ground.environmental_conditions
            if i not in {2, 3}:  # what is not told goes on
                told.precipitation, told.ambient_illumination = (2, 6) if i < 5 else (4, 6)
                told.time_of_day.seconds_since_midnight = 46_700 + i
                told.temperature = 290.15
            if i == 7:
                told.fog = 6
            channel = recorder.channel("truth", "osi3.GroundTruth")
            recorder.write(channel, i / 10, ground.SerializeToString())
    _, _, report = read(path, 3)

    assert [(event.kind, event.seq, event.time_ns, event.detail) for event in report.events] == [
        ("environment", 0, 0,
         "precipitation=none, illumination=level5, time_of_day=12:58:20, temperature=290.1 K"),
        ("environment", 5, ns(0.5),
         "precipitation=light, illumination=level5, time_of_day=12:58:25, temperature=290.1 K"),
        ("environment", 7, ns(0.7),
         "precipitation=light, fog=mist, illumination=level5, time_of_day=12:58:27, temperature=290.1 K"),
    ]  # fmt: skip


def test_conditions_that_are_malformed_cost_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        data = ground_truth(0.0, [car(1)], host=1).SerializeToString() + b"\x62\x02\x12\x7f"
        recorder.write(recorder.channel("truth", "osi3.GroundTruth"), 0.0, data)
    _, _, report = read(path)

    assert (report.frames, report.events, report.losses) == (1, [], [])
    assert report.warnings == ["weather and light cannot be read where they changed 1 time"]


def test_an_id_with_much_behind_it_is_an_id(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(3):
            rest = car(7, float(i)).SerializeToString()[4:]
            ident = b"\x08\x07\x7a\xc8\x01" + b"n" * 200  # field 15 of the identifier: 200 bytes
            thing = b"\x0a" + bytes([len(ident) & 0x7F | 0x80, len(ident) >> 7]) + ident + rest
            size = bytes([len(thing) & 0x7F | 0x80, len(thing) >> 7])
            data = ground_truth(i / 10, host=7).SerializeToString() + b"\x2a" + size + thing
            recorder.write(recorder.channel("truth", "osi3.GroundTruth"), i / 10, data)
    _, blocks, report = read(path)

    assert of(blocks, "7").x.tolist() == [0.0, 1.0, 2.0]
    assert report.losses == []


def lengthy(number: int, content: bytes) -> bytes:
    """A field of protobuf with a content of some megabytes."""
    size, n = bytearray(), len(content)
    while n > 0x7F:
        size.append(n & 0x7F | 0x80)
        n >>= 7
    return bytes([number << 3 | 2, *size, n]) + content


@pytest.mark.parametrize(
    ("field", "reference", "count"),
    [
        (4, 5, 9 << 20),
        (6, 4, 9 << 20),
        (7, 5, 9 << 20),
        (5, 10, 3 << 20),
        (4, 5, 2 << 20),
        (5, 10, 1 << 17),
    ],
)
def test_countless_references_are_a_loss_and_cost_little(
    tmp_path: Path, field: int, reference: int, count: int
) -> None:
    path = tmp_path / "a.mcap"
    ident = b"\x0a\x02\x08\x09\x12\x02\x12\x00"  # id 9, a base with a position
    with Recorder(path) as recorder:
        recorder.ground_truth(0.0, [car(1)], host=1)
        hostile = lengthy(field, ident + bytes([reference << 3 | 2, 0]) * count)
        ground = ground_truth(0.1, [car(1)]).SerializeToString()
        recorder.write(recorder.channels["truth"], 0.1, ground + hostile)
        recorder.ground_truth(0.2, [car(1)], host=1)
    with calls() as counted:
        _, blocks, report = read(path)

    assert len(of(blocks, "1")) >= 2
    assert len(report.losses) == (field != 5 or count > 2 << 20)  # else known by its number
    assert counted.total() < 4_000_000


def test_channels_may_be_numbered_from_nought(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, use_chunking=False, summary=False, enable_crcs=False) as recorder:
        for t in (0.0, 0.1, 0.2):
            recorder.ground_truth(t, [car(1, t)], host=1)
    data, at = bytearray(path.read_bytes()), 8
    while (
        at < len(data) - 8
    ):  # opcode, length, content; of channels and messages the number is first
        if data[at] in {0x04, 0x05}:
            data[at + 9] -= 1
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    path.write_bytes(data)

    with path.open("rb") as stream:
        assert [channel.id for _, channel, _ in make_reader(stream).iter_messages()] == [0, 0, 0]
    assert sum(map(len, read(path)[1])) == 3


@pytest.mark.parametrize("size", [0, 1, 127, 128, 129, 255, 256, 16383, 16384])
def test_fields_of_any_length_end_where_protobuf_says(size: int) -> None:
    file = descriptor_pb2.FileDescriptorProto(name=size * "n", package="p")
    data = file.SerializeToString()

    found = [data[start:stop] for _, _, start, stop in fields_of(data, 0, len(data))]

    assert found == [size * b"n", b"p"]
