"""Foxglove scenes: boxes carried through axes that move, and mappings that say what they are."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tracemalloc
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from counting import calls
from foxglove_scenes import SceneRecorder, cube, turn
from hypothesis import example, given, settings
from hypothesis import strategies as st
from recordings import ns
from thorough import share_of

from sgstore.errors import TraceError
from sgstore.model.vocabulary import KINDS, LIGHT_STATES
from sgstore.model.world import FrameBlock, States, TraceInfo, TraceReport
from sgstore.readers import open_trace
from sgstore.readers.foxglove._mapping import mapping_for, shipped
from sgstore.readers.foxglove._messages import Axes, angles, normed, product, rotated

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(10)

ENCODINGS = ["protobuf", "json"]
both = pytest.mark.parametrize("encoding", ENCODINGS)


def read(path: Path, size: int = 60, **how: Any) -> tuple[TraceInfo, list[FrameBlock], TraceReport]:
    with open_trace(path, **how) as trace:
        return trace.info, list(trace.blocks(size)), trace.report


def idents(blocks: list[FrameBlock]) -> list[str]:
    return [ident for block in blocks for ident in block.entities.ident]


def of(blocks: list[FrameBlock], ident: str) -> States:
    node = idents(blocks).index(ident)
    columns = {
        name: np.concatenate([getattr(block.states, name) for block in blocks])
        for name in States.__dataclass_fields__
    }
    rows = columns["node"] == node
    return States(**{name: values[rows] for name, values in columns.items()})


def kinds(blocks: list[FrameBlock]) -> dict[str, str]:
    codes = [KINDS[code] for block in blocks for code in block.entities.kind]
    return dict(zip(idents(blocks), codes, strict=True))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "a.mcap"


# nuScenes -----------------------------------------------------------------------------------------------


def nuscenes(path: Path, encoding: str) -> Path:
    """As nuscenes2mcap writes it: annotations at 2 Hz, transforms between them too, other scenes and lines."""
    with SceneRecorder.of(path, encoding) as recorder:
        lines = {"id": "0", "frame_id": "map", "lines": [{"type": 0, "thickness": 0.1}]}
        recorder.scene(100.0, [lines], topic="/semantic_map")
        for i in range(6):
            t = 100 + i / 2
            recorder.transform(t, "map", "base_link", (400 + 4 * i, 1000.0, 0.0), 0.0)
            recorder.transform(t, "base_link", "cam_front", (1.7, 0.0, 1.5), 0.0)
            boxes = [
                cube("ab12", (430 + 3 * i, 1003.5, 1), yaw=math.pi / 2, category="vehicle.car"),
                cube(
                    "09fe", (410, 990, 1), category="human.pedestrian.adult", size=(0.6, 0.7, 1.8)
                ),
                cube("77aa", (415, 990, 1), category="movable_object.trafficcone"),
                cube("5e5e", (415, 980, 1), category="vehicle.hovercraft"),
            ]
            recorder.scene(t, boxes[: 4 if i < 4 else 2], topic="/markers/annotations")
            model = cube("car", (1, 0, 0), axes="base_link", shape="models")
            recorder.scene(t, [model], topic="/markers/car")
            recorder.camera(t + 0.01, topic="/cam_front/image_rect_compressed")
            recorder.transform(t + 0.25, "map", "base_link", (402 + 4 * i, 1000.0, 0.0), 0.0)
    return path


@both
def test_nuscenes_is_understood_by_the_mapping_that_is_shipped(file: Path, encoding: str) -> None:
    info, blocks, report = read(nuscenes(file, encoding))

    assert (info.flavour, info.ego, report.frames) == ("foxglove", "base_link", 6)
    assert kinds(blocks) == {
        "ab12": "car",
        "09fe": "person",
        "77aa": "prop",
        "5e5e": "vehicle",
        "base_link": "car",
    }
    assert report.unknown_types == {"vehicle.hovercraft": 1}
    assert report.losses == report.warnings == []
    leader, ego = of(blocks, "ab12"), of(blocks, "base_link")
    assert leader.x.tolist() == [430.0 + 3 * i for i in range(6)]
    assert leader.heading == pytest.approx(math.pi / 2)
    assert leader.vx == pytest.approx(6.0)
    assert (leader.derived & 1 == 1).all()
    assert ego.x == pytest.approx([401.385 + 4 * i for i in range(6)])
    assert (ego.length[0], ego.width[0], ego.z[0]) == (4.084, 1.73, 0.781)
    assert ego.vx == pytest.approx(8.0)
    assert len(of(blocks, "77aa")) == 4  # a message tells all that there is
    assert all((block.ego >= 0).all() for block in blocks)
    roles = {channel.topic: channel.role for channel in info.channels}
    assert roles.pop("/markers/annotations") == "ground_truth"
    assert set(roles.values()) == {"payload"}
    assert "/semantic_map" in {info.channels[c].topic for c in info.context.channel.tolist()}


def test_both_encodings_give_the_same(tmp_path: Path) -> None:
    _, first, _ = read(nuscenes(tmp_path / "p.mcap", "protobuf"))
    _, second, _ = read(nuscenes(tmp_path / "j.mcap", "json"))

    for name in States.__dataclass_fields__:
        np.testing.assert_array_equal(
            getattr(first[0].states, name), getattr(second[0].states, name)
        )


# Scenes -------------------------------------------------------------------------------------------------


@both
def test_an_entity_stays_until_it_is_replaced_deleted_or_its_lifetime_ends(
    file: Path, encoding: str
) -> None:
    with SceneRecorder.of(file, encoding) as recorder:
        recorder.scene(1.0, [cube("stays"), cube("brief", lifetime=2.5), cube("gone"), cube("all")])
        recorder.scene(2.0, [cube("moves", (1, 0, 0))])
        recorder.scene(3.0, [cube("moves", (2, 0, 0))], deleted=["gone"])
        recorder.scene(4.0, [cube("moves", (3, 0, 0))])
        recorder.scene(5.0, [cube("moves", (4, 0, 0))], clear=True)
    _, blocks, report = read(file, 2)

    counts = {ident: len(of(blocks, ident)) for ident in idents(blocks)}
    assert counts == {"stays": 4, "brief": 3, "gone": 2, "all": 4, "moves": 4}
    assert report.frames == 5


@both
def test_poses_are_carried_through_axes_that_move(file: Path, encoding: str) -> None:
    with SceneRecorder.of(file, encoding) as recorder:
        recorder.transform(0.0, "truck", "lidar", (2, 0, 3), math.pi / 2, topic="/tfs")
        for i in range(5):
            t = i / 10
            recorder.transform(t, "world", "truck", (10 * i, 5, 0), math.pi / 2)
            recorder.scene(t, [cube("seen", (4, 1, -2), axes="lidar", vx=1, vy=2, vz=3)])
    mapping = file.with_suffix(".toml")
    mapping.write_text('[entity]\nvelocity = ["metadata.vx", "metadata.vy", "metadata.vz"]\n')
    info, blocks, report = read(file, 2, mapping=mapping, ego="truck")

    # lidar → truck: (4, 1) turned left is (-1, 4), so (1, 4, 1); truck → world: turned left once more.
    seen = of(blocks, "seen")
    assert seen.x == pytest.approx([10 * i - 4 for i in range(5)])
    assert seen.y == pytest.approx(5 + 1)
    assert seen.z == pytest.approx(1)
    assert np.abs(seen.heading) == pytest.approx(math.pi)
    assert [seen.vx[0], seen.vy[0], seen.vz[0]] == pytest.approx([-1, -2, 3])
    assert info.ego == "truck"
    assert of(blocks, "truck").x == pytest.approx([10.0 * i for i in range(5)])
    assert report.losses == []


def test_between_transforms_poses_are_interpolated(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.transform(0.0, "map", "base_link", (0, 0, 0), 3.0)
        for i in range(5):
            recorder.scene(i / 4, [cube("a")])
        recorder.transform(1.0, "map", "base_link", (8, 4, 0), -3.0)
    _, blocks, _ = read(file)

    ego = of(blocks, "base_link")
    assert ego.x == pytest.approx([0, 2, 4, 6, 8])
    assert ego.y == pytest.approx([0, 1, 2, 3, 4])
    assert abs(ego.heading[2]) == pytest.approx(math.pi)  # the shorter way round


def test_what_is_not_locked_to_its_axes_stays_where_it_was_put(file: Path) -> None:
    with SceneRecorder.of(file, "protobuf") as recorder:
        for i in range(4):
            t = 1 + i / 10
            recorder.transform(t, "map", "base_link", (10 * i, 0, 0))
            told = [cube("rides", (1, 0, 0), axes="base_link")]
            told += [cube("lies", (1, 0, 0), axes="base_link", locked=False)] if i == 1 else []
            recorder.scene(t, told)
    _, blocks, _ = read(file)

    assert of(blocks, "rides").x.tolist() == [1, 11, 21, 31]
    assert of(blocks, "lies").x.tolist() == [11, 11, 11]


def test_axes_that_lead_nowhere_are_named_and_cost_only_what_is_in_them(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.transform(0.0, "map", "base_link")
        for i in range(3):
            recorder.scene(i / 10, [cube("here"), cube("lost", axes="mars")])
    _, blocks, report = read(file)

    assert len(of(blocks, "here")) == 3
    (loss,) = report.losses
    assert "entity lost has no usable pose (axes 'mars' are not tied to 'map')" in loss.reason


@both
@pytest.mark.parametrize("shape", ["cubes", "spheres", "cylinders", "models"])
def test_solids_are_bodies(file: Path, encoding: str, shape: str) -> None:
    with SceneRecorder.of(file, encoding) as recorder:
        recorder.scene(1.0, [cube("a", (1, 2, 3), size=(4, 3, 2), shape=shape)])
        recorder.scene(1.1, [{"id": "t", "frame_id": "map", "texts": [{"text": "car 7"}]}])
    _, blocks, report = read(file)

    told = of(blocks, "a")
    size = [told.length[0], told.width[0], told.height[0]]
    assert (told.x[0], told.y[0], told.z[0]) == (1, 2, 3)
    assert np.isnan(size).all() if shape == "models" else size == [4, 3, 2]
    assert idents(blocks) == ["a"]
    assert any(
        "1 entities left out: they have only lines, texts or arrows" in w for w in report.warnings
    )


def test_of_several_boxes_the_largest_is_the_body(file: Path) -> None:
    several = cube("a", (1, 0, 0))
    several["cubes"] += cube("", (9, 0, 0), size=(1, 1, 1))["cubes"]
    with SceneRecorder.of(file, "json") as recorder:
        recorder.scene(1.0, [several])
    _, blocks, _ = read(file)

    assert of(blocks, "a").x.tolist() == [1.0]


def test_several_scenes_make_one_world(file: Path) -> None:
    with SceneRecorder.of(file, "protobuf") as recorder:
        recorder.scene(1.0, [cube("sign", type="stop_sign")], topic="signs")
        for i in range(4):
            recorder.scene(1 + i / 10, [cube("car", (i, 0, 0), type="car")], topic="cars")
    info, blocks, _ = read(file)

    assert kinds(blocks) == {"sign": "stop_sign", "car": "car"}
    assert len(of(blocks, "sign")) == 4
    assert "signs" in {info.channels[c].topic for c in info.context.channel.tolist()}


def test_entities_without_time_take_the_log_time(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        for i in range(3):
            recorder.scene(5 + i / 10, [cube("a", (float(i), 0, 0))], stamped=False)
    _, blocks, report = read(file)

    assert blocks[0].time_ns.tolist() == [ns(5.0), ns(5.1), ns(5.2)]
    assert any("3 frames without a time" in warning for warning in report.warnings)


@pytest.mark.parametrize(
    "hurt",
    [
        b"{",
        b"[]",
        b'{"entities": 7}',
        b'{"entities": [{"cubes": [{"pose": {"position": {"x": "far"}}}]}]}',
        b'{"entities": [7]}',
        b'{"entities": {"a": 1}}',
        b"[" * 100_000,
        b'{"deletions": [{"type": "x"}]}',
        b'{"entities": [{"timestamp": {"sec": 1e400}, "cubes": [{}]}]}',
    ],
)
def test_a_malformed_message_is_a_loss_and_the_others_frames(file: Path, hurt: bytes) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.scene(1.0, [cube("a")])
        recorder.write(recorder.channels["scene"], 1.1, hurt)
        recorder.scene(1.2, [cube("a")])
    _, blocks, report = read(file)

    assert len(of(blocks, "a")) == 2
    (loss,) = report.losses
    assert (loss.messages, loss.bytes) == (1, len(hurt))
    assert "cannot be read" in loss.reason


def test_a_box_without_a_number_in_its_place_is_named(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.scene(1.0, [cube("a"), cube("b", (math.nan, 0, 0)), cube("c", (1e300, 0, 0))])
    _, blocks, report = read(file)

    assert len(of(blocks, "a")) == 1
    assert sorted(loss.reason for loss in report.losses) == [
        "entity b has no usable pose",
        "entity c has no usable pose",
    ]


def test_an_id_that_comes_twice_in_a_message_names_its_first_box(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.scene(1.0, [cube("a", (1, 0, 0)), cube("a", (2, 0, 0))])
    _, blocks, report = read(file)

    assert of(blocks, "a").x.tolist() == [1.0]
    assert "entity a comes more than once" in report.losses[0].reason


# Who is the ego -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("toml", "ego", "expected"),
    [
        ("", "", "Hero"),
        ("", "other", "other"),
        ("", "base_link", "base_link"),
        ('[ego]\naxes = "base_link"\nlength = 5.0\nwidth = 2.0', "", "base_link"),
        ('[ego]\nentity = "other"', "", "other"),
        ('[ego]\nentity = "bus"', "", "other"),
        ('[ego]\nentity = "nobody"', "", "base_link"),
    ],
)
def test_the_ego_is_who_is_named_or_who_the_mapping_names(
    file: Path, toml: str, ego: str, expected: str
) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.transform(1.0, "map", "base_link")
        recorder.scene(1.0, [cube("Hero", type="car"), cube("other", type="bus")])
    mapping = file.with_suffix(".toml")
    mapping.write_text(toml)
    info, blocks, _ = read(file, mapping=mapping, ego=ego)

    assert info.ego == expected
    assert idents(blocks)[blocks[0].ego[0]] == expected


def test_an_entity_without_an_id_is_not_the_ego_whose_axes_are_told(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.transform(1.0, "map", "base_link", (5, 0, 0))
        recorder.scene(1.0, [cube("", (1, 0, 0), type="car")])
    _, blocks, _ = read(file)

    assert blocks[0].states.node.tolist() == [0, 1]
    assert (blocks[0].ego.tolist(), blocks[0].states.x.tolist()) == ([1], [1.0, 5.0])


def test_an_ego_that_is_not_there_is_answered_with_who_is(file: Path) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.transform(1.0, "map", "tractor")
        recorder.scene(1.0, [cube("a"), cube("b")])

    with pytest.raises(TraceError, match="called 'c'; entities: a, b; axes: tractor"):
        open_trace(file, ego="c")
    _, blocks, report = read(file)
    assert blocks[0].ego.tolist() == [-1]
    assert any("no entity is the ego" in warning for warning in report.warnings)


# Mappings -------------------------------------------------------------------------------------------------


def test_a_mapping_says_where_everything_stands(file: Path) -> None:
    with SceneRecorder.of(file, "protobuf") as recorder:
        for i in range(3):
            told = {"uid": "left" if i % 2 else "right", "what": "Sedan", "v": "12.5"}
            lamp = cube("x", what="Lamp", uid="lamp", shows="RED_YELLOW")
            recorder.scene(1 + i / 10, [cube("0", (0, 0, 0), yaw=math.pi / 2, **told), lamp])
    mapping = file.with_suffix(".toml")
    mapping.write_text(
        """
        [scene]
        snapshot = true
        [entity]
        id = "metadata.uid"
        type = "metadata.what"
        speed = "metadata.v"
        light_state = "metadata.shows"
        [types]
        sedan = "car"
        lamp = { kind = "traffic_light", subkind = "lamp" }
        """
    )
    _, blocks, _ = read(file, mapping=str(mapping))

    assert kinds(blocks) == {"right": "car", "lamp": "traffic_light", "left": "car"}
    assert len(of(blocks, "right")) == 2
    assert of(blocks, "right").vy.tolist() == pytest.approx([12.5, 12.5])
    assert (of(blocks, "right").derived & 1).tolist() == [0, 0]
    assert {LIGHT_STATES[code] for code in of(blocks, "lamp").light_state} == {"red_yellow"}


def test_a_state_of_lights_that_a_process_makes_known_is_read(file: Path) -> None:
    with SceneRecorder.of(file, "protobuf") as recorder:
        recorder.scene(1, [cube("x", what="traffic_light", shows="White_Bar")])
    mapping = file.with_suffix(".toml")
    mapping.write_text('[entity]\ntype = "metadata.what"\nlight_state = "metadata.shows"')
    script = """
import sys
from sgstore.readers import open_trace
from sgstore.model.vocabulary import LIGHT_STATES, add_light_state
open_trace(sys.argv[1], mapping=sys.argv[2]).close()  # what was read before changes nothing
add_light_state("white_bar")
with open_trace(sys.argv[1], mapping=sys.argv[2]) as trace:
    print([LIGHT_STATES[code] for block in trace.blocks() for code in block.states.light_state])
"""
    told = subprocess.run(
        [sys.executable, "-c", script, str(file), str(mapping)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout

    assert told == "['white_bar']\n"


@pytest.mark.parametrize(
    ("toml", "reason"),
    [
        ("[scene", "mapping"),
        ("[scen]", "'scen' is not known; did you mean 'scene'"),
        ('[entity]\nspeeed = "x"', "did you mean 'entity.speed'"),
        ("[scene]\nsnapshot = 1", "'scene.snapshot' is 1; expected true or false"),
        ('[entity]\nvelocity = ["a", "b"]', "has 2 parts; expected 3"),
        ("[ego]\nlength = inf", "expected a number"),
        ("[ego]\noffset = [1, 2]", "expected three numbers"),
        ('[types]\nx = { kind = "cart" }', "did you mean 'car'"),
        ('[types]\nx = { kind = "car", special = "taxy" }', "did you mean 'taxi'"),
        ("[types]\nx = 3", "expected { kind"),
        ("types = 3", "is not a table"),
        ("scene = 3", r"expected a table \[scene\]"),
        ("[types]\nx = { colour = 'red' }", "types.x.colour"),
    ],
)
def test_a_mistake_in_a_mapping_is_answered_with_what_would_be_right(
    file: Path, toml: str, reason: str
) -> None:
    with SceneRecorder.of(file, "json") as recorder:
        recorder.scene(1.0, [cube("a")])
    mapping = file.with_suffix(".toml")
    mapping.write_text(toml)

    with pytest.raises(TraceError, match=reason):
        open_trace(file, mapping=mapping)


def test_a_mapping_that_is_nowhere_is_answered_with_those_that_are_shipped(file: Path) -> None:
    with pytest.raises(TraceError, match="expected a readable file or one of: nuscenes2mcap"):
        mapping_for("nuscenes", ())
    assert mapping_for("", ["/markers/annotations", "/tf"]) is shipped()["nuscenes2mcap"]
    assert mapping_for("nuscenes2mcap", ()) is shipped()["nuscenes2mcap"]
    assert mapping_for("", ["/tf"]).recognise.topics == ()


# Axes -----------------------------------------------------------------------------------------------------

unit = st.floats(-1, 1)
turns = st.tuples(unit, unit, unit, unit).map(lambda q: normed(np.array(q)))
places = st.tuples(*[st.floats(-100, 100)] * 3).map(np.array)


def matrix(q: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Turns the axes one by one, by the sandwich q v q* of the textbook."""
    conjugate = q * np.array([-1, -1, -1, 1])
    return np.array(
        [product(product(q, np.append(axis, 0.0)), conjugate)[:3] for axis in np.eye(3)]
    ).T


@settings(max_examples=share_of(60), deadline=None)
@given(turns, turns, places)
@example(normed(np.array([1.0, 0.0, 1.0, 0.0])), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
@example(normed(np.array([0.3, -0.7, -0.3, -0.7])), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
def test_turns_are_those_of_the_textbook(
    a: np.ndarray[Any, Any], b: np.ndarray[Any, Any], v: np.ndarray[Any, Any]
) -> None:
    assert matrix(a) @ v == pytest.approx(rotated(a, v), abs=1e-9)
    assert rotated(product(a, b), v) == pytest.approx(rotated(a, rotated(b, v)), abs=1e-9)
    yaw, pitch, roll = angles(a)
    cy, sy, cp, sp, cr, sr = (f(x) for x in (yaw, pitch, roll) for f in (math.cos, math.sin))
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    assert z @ y @ x == pytest.approx(matrix(a), abs=1e-6)


def test_axes_that_move_in_one_another_have_no_end_but_an_answer() -> None:
    axes = Axes()
    pose = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    assert axes.tell("a", "b", 0, pose)
    assert axes.tell("b", "a", 0, pose)
    assert not axes.tell("a", "a", 0, pose)
    assert not axes.tell("a", "c", 0, pose)
    assert axes.pose("a", "map", 0) is None
    assert axes.root() == ""


def test_transforms_in_any_order_are_the_same_track() -> None:
    told = [(t, (np.array([float(t), 0, 0]), np.array(list(turn(0.0).values())))) for t in range(9)]
    forth, back = Axes(), Axes()
    for t, pose in told:
        forth.tell("a", "map", t, pose)
    for t, pose in reversed(told):
        back.tell("a", "map", t, pose)
    for axes in (forth, back):
        assert [axes.pose("a", "map", t)[0][0] for t in range(-1, 10)] == [0, *range(9), 8]  # pyright: ignore[reportOptionalSubscript]
    forth.forget(5)
    assert forth.pose("a", "map", 5)[0][0] == 5  # pyright: ignore[reportOptionalSubscript]


def test_the_shipped_mappings_name_kinds_of_everything_they_know() -> None:
    for mapping in shipped().values():
        assert mapping.recognise.topics
        assert "unknown" not in {meaning.kind for meaning in mapping.types.values()}
    assert json.dumps(sorted(shipped())) == '["nuscenes2mcap"]'


def test_memory_does_not_grow_with_the_length_of_a_recording(tmp_path: Path) -> None:
    def peak(frames: int) -> int:
        path = tmp_path / f"{frames}.mcap"
        with SceneRecorder.of(path, "json", chunk_size=1 << 15) as recorder:
            for i in range(frames):
                recorder.transform(i / 10, "map", "base_link", (i, 0, 0))
                recorder.scene(i / 10, [cube("a", (i, 0, 0)), cube("b")])
        with open_trace(path) as trace:
            tracemalloc.start()
            for _ in trace.blocks():
                pass
            highest = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        return highest

    assert peak(2000) < 1.3 * peak(500)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("protobuf", b"\x12\x82\x80\x80\x04" + b"\x42\x00" * (4 << 20) + b"\x42\x00"),
        ("protobuf", b"\x12\x00" * (4 << 20)),
        ("protobuf", b"\x0a\x00" * (1 << 24)),
        ("json", b'{"entities":[' + b"{}," * (2 << 20) + b"{}]}"),
        ("json", b'{"entities":[{"cubes":[' + b"{}," * (1 << 20) + b"{}]}]}"),
        ("json", b'{"entities":[{"id":"' + b"x" * (1 << 25) + b'"}]}'),
    ],
    ids=["cubes", "entities", "deletions", "JSON entities", "JSON cubes", "a JSON id"],
)
def test_a_message_of_countless_parts_is_a_loss_and_costs_little(
    file: Path, encoding: str, data: bytes
) -> None:
    with SceneRecorder.of(file, encoding) as recorder:
        recorder.scene(1.0, [cube("a")])
        recorder.write(recorder.channels["scene"], 1.1, data)
    with calls() as counted:
        _, blocks, report = read(file)

    assert len(of(blocks, "a")) == 1
    (loss,) = report.losses
    assert "at most" in loss.reason or "more than" in loss.reason
    assert counted.total() < 1_000_000
