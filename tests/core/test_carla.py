"""Recordings of CARLA's ROS bridge, held against the official decoder and against what CARLASGG was told."""

from __future__ import annotations

import gzip
import json
import math
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from carla_recordings import Bridge, idents, read, states, thing
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from thorough import LONG

from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import KINDS, LIGHT_STATES
from sgstore.readers import read_message
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)

TOWN = "traces/carla/Town01.carla.mcap"
AS_RECORDED = "traces/carla/Town01_asrecorded.carla.mcap"


def officially(path: Path, *topics: str) -> list[Any]:
    """Messages of some topics as the official decoder reads them, in file order."""
    factory = DecoderFactory()
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[factory])
        return [told for _, _, _, told in reader.iter_decoded_messages(topics=list(topics))]


def matrix(heading: float, pitch: float, roll: float) -> np.ndarray[Any, Any]:
    """Turn about z, then the turned y, then the turned x."""
    (ch, sh), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (heading, pitch, roll))
    return (
        np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )


def matrix_of(q: Any) -> np.ndarray[Any, Any]:
    """The textbook matrix of a quaternion."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


# What others read ---------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize(("name", "step"), [(TOWN, 1 if LONG else 7), (AS_RECORDED, 10)])
def test_objects_are_what_the_official_decoder_reads(data: Path, name: str, step: int) -> None:
    info, blocks, report = read(data / name)
    told = officially(data / name, "/carla/objects")
    frames = states(blocks)

    assert (info.flavour, report.frames, report.losses) == ("carla", 200, [])
    assert len(told) == len(frames) == 200
    for frame, message in list(zip(frames, told, strict=True))[::step]:
        ours = {ident: state for ident, state in frame.items() if state["light_state"] < 0}
        assert list(ours) == [str(thing.id) for thing in message.objects]
        for one in message.objects:
            state, p = ours[str(one.id)], one.pose.position
            turn = matrix_of(one.pose.orientation)
            lift = one.shape.dimensions[2] / 2 if one.classification != 4 else 0.0
            centre = np.array([p.x, p.y, p.z]) + turn @ [0, 0, lift]
            np.testing.assert_allclose([state[c] for c in "xyz"], centre, rtol=0, atol=1e-6)
            angles = (state["heading"], state["pitch"], state["roll"])
            np.testing.assert_allclose(matrix(*angles), turn, rtol=0, atol=1e-6)
            v, a = one.twist.linear, one.accel.linear
            for columns, vector in ((("vx", "vy", "vz"), v), (("ax", "ay", "az"), a)):
                assert [state[c] for c in columns] == [vector.x, vector.y, vector.z]
            assert state["yaw_rate"] == one.twist.angular.z
            size = [state[c] for c in ("length", "width", "height")]
            assert size == list(one.shape.dimensions)
            assert state["derived"] == 0


@pytest.mark.data
def test_lights_show_what_the_last_message_before_the_frame_said(data: Path) -> None:
    path = data / TOWN
    _, blocks, _ = read(path)
    shown: dict[str, str] = {}
    expected = []
    names = ("red", "yellow", "green", "off", "unknown")
    for message in officially(path, "/carla/objects", "/carla/traffic_lights/status"):
        if hasattr(message, "objects"):
            expected.append(dict(shown))
        else:
            shown |= {str(one.id): names[one.state] for one in message.traffic_lights}

    found = [
        {i: LIGHT_STATES[s["light_state"]] for i, s in frame.items() if s["light_state"] >= 0}
        for frame in states(blocks)
    ]

    assert found == expected
    assert len({tuple(sorted(frame.items())) for frame in found}) == 3
    assert len(found[0]) == 36


@cache
def oracle(data: Path) -> list[Any]:
    with gzip.open(data / "oracle/Town01/junction_rsv.jsonl.gz") as lines:
        return [json.loads(line) for line in lines]


@pytest.mark.data
def test_places_are_those_that_carlasgg_was_told_mirrored(data: Path) -> None:
    _, blocks, _ = read(data / TOWN)
    compared = set()
    for frame, told in zip(states(blocks), oracle(data), strict=True):
        for node in told["nodes"]:
            attr, kind = node["attr"], node["base_class"]
            state = frame.get(str(attr.get("entity_id") or attr.get("carla_id")))
            if state is None:
                continue
            x, y, z = attr["vertex"]
            assert math.hypot(state["x"] - x, state["y"] + y) <= 1e-3
            if kind not in {"person", "traffic_light"}:
                assert state["z"] - state["height"] / 2 == pytest.approx(z, abs=1e-3)
            ahead = (math.cos(state["heading"]), -math.sin(state["heading"]))
            assert attr["forward"][:2] == pytest.approx(ahead, abs=1e-4)
            compared.add(kind)

    assert compared == {"ego", "car", "truck", "van", "motorcycle", "person", "traffic_light"}


@pytest.mark.data
def test_the_ego_moves_and_is_steered_as_carlasgg_was_told(data: Path) -> None:
    info, blocks, _ = read(data / TOWN)
    throttles = set()
    for frame, told in zip(states(blocks), oracle(data), strict=True):
        (attr,) = (node["attr"] for node in told["nodes"] if node["base_class"] == "ego")
        ego = frame[info.ego]
        assert (ego["vx"], -ego["vy"]) == (attr["carla_vel_x"], attr["carla_vel_y"])
        assert (ego["throttle"], ego["brake"]) == (attr["carla_throttle"], attr["carla_brake"])
        assert -ego["steer"] == attr["carla_steer"]
        throttles.add(ego["throttle"])
        assert np.isnan([s["throttle"] for i, s in frame.items() if i != info.ego]).all()

    assert info.ego == "100"
    assert len(throttles) > 3


@pytest.mark.data
def test_lights_apply_to_the_lanes_that_carlasgg_found_them_to_affect(data: Path) -> None:
    info, blocks, _ = read(data / TOWN)
    nodes = read_map(info.map_text, info.map_name)
    refs = dict(zip(idents(blocks), blocks[0].entities.map_ref, strict=True))
    named = {
        light: {
            f"Lane {nodes.nodes.road[-1 - lane]}_{nodes.nodes.lane[-1 - lane]:+d}"
            for lane in nodes.lanes_of_signal(ref).tolist()
        }
        for light, ref in refs.items()
        if ref
    }
    affected: dict[str, set[str]] = {}
    for told in oracle(data):
        things = {node["i"]: node for node in told["nodes"]}
        for src, dst, relation in told["edges"]:
            light = things[src]["attr"].get("carla_id")
            if relation == "controlsTrafficOf" and str(light) in named:
                affected.setdefault(str(light), set()).add(things[dst]["name"])

    assert len(named) == len(set(refs.values()) - {""}) == 36
    assert len(affected) == 3
    assert all(lanes <= named[light] for light, lanes in affected.items())


@pytest.mark.data
def test_actors_are_what_their_blueprints_are(data: Path) -> None:
    _, blocks, report = read(data / TOWN)
    entities = blocks[0].entities
    kinds: dict[str, tuple[str, str]] = {}
    for name, kind, special in zip(
        entities.type_name, entities.kind, entities.special, strict=True
    ):
        kinds[name.removeprefix("vehicle.")] = (KINDS[kind], special)

    assert kinds | {f"walker.pedestrian.{i:04d}": ("person", "") for i in range(1, 11)} == kinds
    assert kinds["traffic.traffic_light"] == ("traffic_light", "")
    assert {k: v for k, v in kinds.items() if not k.startswith(("walker", "traffic"))} == {
        "tesla.model3": ("car", "electric"),
        "lincoln.mkz_2020": ("car", ""),
        "yamaha.yzf": ("motorcycle", ""),
        "carlamotors.carlacola": ("truck", ""),
        "dodge.charger_police": ("car", "emergency"),
        "nissan.patrol_2021": ("car", ""),
        "mitsubishi.fusorosa": ("bus", ""),
        "mercedes.sprinter": ("van", ""),
        "audi.tt": ("car", ""),
        "bh.crossbike": ("bicycle", ""),
    }
    assert report.unknown_types == {}


@pytest.mark.data
def test_a_file_as_a_recorder_leaves_it_gives_the_same_graphs(data: Path) -> None:
    graphs = []
    for name in (TOWN, AS_RECORDED):
        info, blocks, report = read(data / name)
        generator = SceneGraphGenerator(read_map(info.map_text, info.map_name), Config())
        names = idents(blocks)
        found = set()
        for block in blocks:
            edges = generator.block(block).edges
            for row in range(len(edges)):
                ends = (int(getattr(edges, end)[row]) for end in ("src", "dst"))
                frame = int(block.seq[edges.frame[row]])
                named = (names[end] if end >= 0 else end for end in ends)
                found.add((frame, int(edges.relation[row]), *named))
        graphs.append(found)
        unchecked = [warning for warning in report.warnings if "checksum" in warning]
        assert len(unchecked) == (name == AS_RECORDED)

    assert graphs[0] == graphs[1]
    assert len(graphs[0]) > 10_000


@pytest.mark.data
def test_a_picture_is_read_back_by_its_place(data: Path) -> None:
    path = data / TOWN
    info, blocks, _ = read(path)
    topic = "/carla/hero/rgb_front/image/compressed"
    with path.open("rb") as stream:
        pictures = {m.log_time: m.data for _, _, m in make_reader(stream).iter_messages([topic])}
    found = {}
    for block in blocks:
        refs = block.messages
        for row in np.flatnonzero([info.channels[c].topic == topic for c in refs.channel])[::20]:
            found[int(refs.log_time_ns[row])] = read_message(
                path,
                chunk_offset=int(refs.chunk_offset[row]),
                offset=int(refs.offset[row]),
                length=int(refs.length[row]),
            )

    assert len(pictures) == 200
    assert len(found) == 10
    assert all(pictures[time] == data for time, data in found.items())
    assert all(b"\xff\xd8\xff" in data for data in found.values())


def test_angles_turn_as_the_quaternion_does_straight_up_and_down_too(tmp_path: Path) -> None:
    upright = [[1, 0, 1, 0], [0, 1, 0, 1], [0.3, -0.7, -0.3, -0.7], [0.7, 0.3, -0.7, 0.3]]
    quaternions = np.concatenate([upright, np.random.default_rng(4).normal(size=(200, 4))])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    turns = [dict(zip("xyzw", q.tolist(), strict=True)) for q in quaternions]
    with Bridge(tmp_path / "turns.mcap") as bridge:
        bridge.actors(dict.fromkeys(range(len(turns)), ("vehicle.audi.tt", "")))
        objects = [thing(i, turn=turn, size=[4, 2, 1]) for i, turn in enumerate(turns)]
        bridge.objects(0.0, objects)

    (frame,) = states(read(tmp_path / "turns.mcap")[1])

    for i, turn in enumerate(turns):
        expected, state = matrix_of(SimpleNamespace(**turn)), frame[str(i)]
        angles = matrix(state["heading"], state["pitch"], state["roll"])
        np.testing.assert_allclose(angles, expected, rtol=0, atol=2e-6)
        middle = [state[axis] for axis in "xyz"]  # lifted by half the height
        np.testing.assert_allclose(middle, expected[:, 2] / 2, rtol=0, atol=1e-12)
