"""The laws of every flavour of recording, and that one more is one file."""

from __future__ import annotations

import json
import math
import re
import sys
import tomllib
from dataclasses import asdict
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import autoware_recordings
import av2_logs
import carla_recordings
import commonroad_scenarios
import numpy as np
import py123d_logs
import pytest
import recorder_logs
import recordings
import sumo_recordings
from foxglove_scenes import SceneRecorder, cube
from mcap.reader import make_reader
from opendrive_maps import a_map, a_road, line
from test_export_mcap import cut
from test_online import agree

import sgstore
from sgstore import Frame, SceneGraphGenerator
from sgstore.base import plugins
from sgstore.errors import TraceError
from sgstore.exporters import Recorder
from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import ENTITY_KINDS, KINDS
from sgstore.model.world import Channel, FrameBlock, States, TraceInfo, TraceReport
from sgstore.readers import (
    READERS,
    FramesTrace,
    TraceMessage,
    open_recording,
    open_trace,
    read_message,
)
from sgstore.readers.foxglove._mapping import Ego, EntityMapping, SceneMapping, shipped

pytestmark = pytest.mark.seconds(12)


@cache
def read(path: Path, size: int = 60) -> tuple[TraceInfo, list[FrameBlock], TraceReport]:
    with open_trace(path) as trace:
        return trace.info, list(trace.blocks(size)), trace.report


def idents(blocks: list[FrameBlock]) -> list[str]:
    return [ident for block in blocks for ident in block.entities.ident]


def column(blocks: list[FrameBlock], name: str) -> np.ndarray[Any, Any]:
    return np.concatenate([getattr(block.states, name) for block in blocks])


def scene(path: Path, encoding: str, frames: int = 25) -> Path:
    """A car that turns left, the ego behind it as axes, a light, and a person who is deleted."""
    with SceneRecorder.of(path, encoding, chunk_size=3000) as recorder:
        for i in range(frames):
            t = 10 + i * 0.1
            recorder.transform(t, "map", "base_link", (8 * t, 0, 0))
            things = [
                cube("leader", (8 * t + 20, i * i / 50, 0.75), yaw=i / 25, type="car", speed=8.0),
                cube("lamp", (300, 5, 4), type="traffic_light", stamp=t),
            ]
            if i < 10:
                things.append(cube("walker", (200, -i, 0.9), type="pedestrian", locked=False))
            recorder.scene(t, things, deleted=["walker"] if i == 10 else [])
            recorder.camera(t + 0.02)
    return path


def steps(path: Path) -> Path:
    """The messages of a CommonRoad scenario, which itself is no MCAP file: :mod:`test_commonroad`."""
    source = path.with_suffix(".xml")
    source.write_text(commonroad_scenarios.scenario())
    return commonroad_scenarios.as_mcap(path, source)


def recorded(path: Path, frames: int = 25) -> Path:
    """A car behind a prop that moves, with inputs and an event, as the recorder of a live run writes them."""
    still = dict.fromkeys(("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"), 0.0)
    with Recorder(path, map_text=a_map(a_road("1", line(100))), map_name="town.xodr") as recorder:
        for i in range(frames):
            frame = Frame(i * 10**8, ego="hero")
            about = {"length": 4.5, "width": 1.9, "height": 1.5, "special": "taxi"}
            inputs = {"steer": 0.1, "hand_brake": False, "lights": ["light_fog", "light_interior"]}
            frame.add("hero", "car", i / 3, 0.1, 0.7, heading=i / 7, **about, **inputs)
            frame.add("can", "prop", 9.0 - i, 2.0, 0.2, subkind="barrel", type_name="static.prop.x")
            frame.add("rail", "barrier", 30.0, 5.0, 0.5, subkind="rail", static=True)
            frame.add("lamp", "traffic_light", 40.0, 5.0, 3.0, light_state="flashing", **still)
            if i == 7:
                frame.happened("collision", "hero", "can")
            recorder.frame(frame)
    return path


EXAMPLES = {
    "sgstore": recorded,
    "osi": lambda path: recordings.drive(path, frames=25, chunk_size=3000),
    "carla": lambda path: carla_recordings.drive(path, frames=25, chunk_size=3000),
    "autoware": lambda path: autoware_recordings.drive(path, frames=25, chunk_size=3000),
    "foxglove protobuf": lambda path: scene(path, "protobuf"),
    "foxglove json": lambda path: scene(path, "json"),
    "commonroad": steps,
    "sumo": lambda path: sumo_recordings.as_mcap(path, sumo_recordings.drive(25)),
    "av2": lambda path: av2_logs.as_mcap(path, av2_logs.drive(path.with_suffix(""))),
    "py123d": lambda path: py123d_logs.as_mcap(path, py123d_logs.drive(path.with_suffix(""))),
    "carla_recorder": lambda path: recorder_logs.as_mcap(
        path, recorder_logs.drive(path.with_suffix(".log"), hidden=0)
    ),
}
NO_EGO = {"commonroad", "sumo"}
"""Flavours that tell nobody to be the ego."""


@pytest.fixture(params=EXAMPLES)
def example(tmp_path: Path, request: Any) -> Path:
    return EXAMPLES[request.param](tmp_path / f"{request.param}.mcap")


def test_every_reader_has_an_example() -> None:
    assert {name.split()[0] for name in EXAMPLES} == {reader.name for reader in READERS}


def test_a_reader_is_found_by_the_schemas(example: Path) -> None:
    info, _, report = read(example)

    assert info.flavour in example.stem
    assert report.frames == 25
    assert report.losses == []
    sizes = re.compile("a box without a size|how large the vehicle is|has no size")
    odd = [w for w in report.warnings if not sizes.search(w)]
    assert odd == (["no frame has an ego"] if info.flavour in NO_EGO else [])


def test_frames_are_numbered_and_times_increase(example: Path) -> None:
    _, blocks, _ = read(example, 7)

    assert [block.seq[0] for block in blocks] == [0, 7, 14, 21]
    assert np.concatenate([block.seq for block in blocks]).tolist() == list(range(25))
    assert (np.diff(np.concatenate([block.time_ns for block in blocks])) > 0).all()
    assert (np.diff(np.concatenate([block.log_time_ns for block in blocks])) > 0).all()


def test_ids_are_unique_and_entities_come_in_order_before_their_states(example: Path) -> None:
    _, blocks, _ = read(example, 4)
    known = 0
    for block in blocks:
        assert block.entities.first == known
        known += len(block.entities)
        assert block.states.node.max() < known
        for frame in range(len(block)):
            nodes = block.states.node[block.offsets[frame] : block.offsets[frame + 1]]
            assert len(set(nodes)) == len(nodes)

    assert len(set(idents(blocks))) == len(idents(blocks)) == known


def test_numbers_are_plausible_in_si_units(example: Path) -> None:
    info, blocks, _ = read(example)

    assert np.nanmax(np.abs(column(blocks, "heading"))) <= math.pi
    assert np.nanmax(np.abs(column(blocks, "vx"))) < 100
    assert np.nanmin(column(blocks, "length")) >= 0
    assert info.flavour in NO_EGO or all((block.ego >= 0).all() for block in blocks)


@pytest.mark.parametrize("size", [1, 2, 5, 24, 25, 26])
def test_nothing_depends_on_where_a_block_ends(example: Path, size: int) -> None:
    _, whole, _ = read(example)
    _, blocks, _ = read(example, size)

    assert idents(blocks) == idents(whole)
    for name in States.__dataclass_fields__:
        np.testing.assert_array_equal(column(blocks, name), column(whole, name))
    assert sum(len(block.messages) for block in blocks) == sum(len(b.messages) for b in whole)


def test_every_message_of_a_block_is_read_back_by_its_place(example: Path) -> None:
    info, blocks, _ = read(example, 7)
    with example.open("rb") as stream:
        official = {
            (channel.topic, message.log_time): message.data
            for _, channel, message in make_reader(stream).iter_messages()
        }
    found = {}
    for block in [*blocks]:
        refs = block.messages
        for row in range(len(refs)):
            channel = info.channels[refs.channel[row]]
            found[channel.topic, int(refs.log_time_ns[row])] = read_message(
                example,
                chunk_offset=int(refs.chunk_offset[row]),
                offset=int(refs.offset[row]),
                length=int(refs.length[row]),
            )

    owned = {c.topic for c in info.channels if c.role in {"ground_truth", "payload"}}
    assert found == {key: data for key, data in official.items() if key[0] in owned}


def test_reading_again_gives_the_same(example: Path) -> None:
    with open_trace(example) as trace:
        first, second = list(trace.blocks()), list(trace.blocks())

        assert trace.report.frames == 25
        assert trace.info.digest == read(example)[0].digest
    for name in States.__dataclass_fields__:
        np.testing.assert_array_equal(column(first, name), column(second, name))


def test_a_recorder_gives_its_input_unchanged(tmp_path: Path) -> None:
    """Every kind and every value, to the last bit."""
    rng, frames = np.random.default_rng(3), []
    names = [*"xyz", "heading", "pitch", "roll", *("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate")]
    for step in range(4):
        frame = Frame(step * 10**8, ego="car 0")
        for number, kind in enumerate(ENTITY_KINDS):
            numbers = dict(zip(names, rng.normal(0, 3, len(names)).tolist(), strict=True))
            more: dict[str, Any] = {"subkind": "own", "type_name": f"x.{kind}", "map_ref": "m7"}
            more |= {"special": "electric", "lights": ["light_special1"], "gear": -1, "brake": 0.3}
            more |= {"light_state": "red_yellow"} if kind == "traffic_light" else {}
            frame.add(f"{kind} {number}", kind, **numbers, **more, length=2.0, hand_brake=True)
            frame.add(f"{kind} point", kind, step, 0.0)
        frame.add("house", "building", 3.0, 4.0, static=True, subkind="church")
        frame.happened("collision", "car 0", "prop point")
        frames.append(frame)
    with Recorder(tmp_path / "a.mcap") as recorder:
        for frame in frames:
            recorder.frame(frame)

    with open_trace(tmp_path / "a.mcap") as trace:
        assert trace.info.flavour == "sgstore"
        made = [trace.frame(message) for message in messages_of(tmp_path / "a.mcap", trace)]
        (block,) = trace.blocks()
    assert repr([one.as_dict() for one in made]) == repr([one.as_dict() for one in frames])
    assert all(one.events == frame.events for one, frame in zip(made, frames, strict=True))
    kinds = dict(
        zip(block.entities.ident, (KINDS[code] for code in block.entities.kind), strict=True)
    )
    assert kinds == {entity.ident: KINDS[entity.kind] for entity in frames[0].entities}
    x = [one.numbers[0] for one in frames[0].entities if not one.static]
    assert block.states.x[: block.offsets[1]].tolist() == x
    assert len(block.events) == 4


def messages_of(path: Path, trace: Any) -> list[TraceMessage]:
    (channel,) = (one for one in trace.info.channels if one.schema == "sgstore.Frame")
    with path.open("rb") as stream:
        found = make_reader(stream).iter_messages(topics=[channel.topic])
        return [TraceMessage(channel, message.log_time, message.data) for _, _, message in found]


# One more flavour is one file -----------------------------------------------------------------------------

PAGE = Path(__file__).parents[2] / "docs/flavours.md"


def toybox(path: Path, frames: int = 30) -> Path:
    """The ego overtakes a car that stands; one message is broken."""
    with recordings.Recorder(path) as recorder:
        channel = recorder.channel("world", "toybox.World", b'{"type": "object"}')
        for i in range(frames):
            cars = [{"id": "a", "x": i, "y": 0, "yaw": 0}, {"id": "b", "x": 15, "y": 3, "yaw": 0}]
            world = {"t": i / 10, "ego": "a", "cars": cars}
            recorder.write(channel, i / 10, json.dumps(world).encode())
            recorder.camera(i / 10)
        recorder.write(channel, frames / 10, b'{"t": 3, "cars": [{}]}')
    return path


def way(name: str) -> str:
    """A program of the page: the flavour as plain frames, or in columns."""
    page = PAGE.read_text(encoding="utf-8")
    programs = re.findall(r'```python\n("""Recordings of Toybox.*?)```', page, re.DOTALL)
    assert len(programs) == len(WAYS)
    return programs[WAYS.index(name)]


WAYS = ["frames", "columns"]
LOST = {"frames": "'world': KeyError('ego')", "columns": "not a world"}


def install(site: Path, program: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A flavour as a package that is installed beside sgstore, with the entry point of the page."""
    page = PAGE.read_text(encoding="utf-8")
    (entry,) = re.findall(r'\[project.entry-points."sgstore.readers"\]\ntoybox = "(.*)"', page)
    about = site / "toybox-1.0.dist-info"
    about.mkdir(parents=True)
    (site / "toybox.py").write_text(program, encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toybox\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[sgstore.readers]\ntoybox = {entry}\n")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.delitem(sys.modules, "toybox", raising=False)
    return site


@pytest.fixture(params=WAYS)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: Any) -> Path:
    """A flavour of the page."""
    return install(tmp_path / "site", way(request.param), monkeypatch)


def test_a_flavour_of_one_file_is_ingested_and_queried(
    tmp_path: Path, installed: Path, request: pytest.FixtureRequest
) -> None:
    lost = LOST[request.node.callspec.params["installed"]]
    path = toybox(tmp_path / "toys.mcap")
    store_path = tmp_path / "toys.sgstore"
    (outcome,) = ingest(store_path, [path])

    assert read(path)[0].flavour == "toybox"
    assert outcome.status == "added", outcome.error
    assert outcome.frames == 30
    (loss,) = outcome.losses
    assert lost in loss.reason
    assert (loss.messages, loss.bytes, loss.start_ns, loss.end_ns) == (1, 22, 3 * 10**9, 3 * 10**9)
    store = sgstore.open(store_path)
    matches = list(
        store.find("MATCH (e:Ego)-[:near_coll]->(c:Car {ident: 'b'}) RETURN e.x, e.speed")
    )
    # 3 m apart across: within 4 m for |x - 15| <= 2.6, and always beyond 2 m.
    assert [row[-2] for row in matches] == [13.0, 14.0, 15.0, 16.0, 17.0]
    assert {round(row[-1], 6) for row in matches} == {10.0}
    assert len(store.payload("toys#7", "camera")) == 200


def test_a_flavour_of_one_file_keeps_the_laws(tmp_path: Path, installed: Path) -> None:
    path = toybox(tmp_path / "toys.mcap")
    _, whole, _ = read(path)
    for size in (1, 7, 29, 30, 31):
        _, blocks, report = read(path, size)
        assert idents(blocks) == idents(whole) == ["a", "b"]
        assert (report.frames, len(report.losses)) == (30, 1)
        for name in States.__dataclass_fields__:
            np.testing.assert_array_equal(column(blocks, name), column(whole, name))


def test_a_flavour_of_frames_is_short_and_gives_the_same_as_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = toybox(tmp_path / "toys.mcap")
    assert len(way("frames").splitlines()) <= 30
    told = []
    for name in WAYS:
        read.cache_clear()
        install(tmp_path / name, way(name), monkeypatch)
        told.append(read(path, 7))
    (info, frames, report), (other, columns, _) = told

    assert (info.channels, info.digest) == (other.channels, other.digest)
    assert (report.frames, report.states) == (30, 60)
    for ours, theirs in zip(frames, columns, strict=True):
        np.testing.assert_equal(asdict(ours), asdict(theirs))


class PlainTrace(FramesTrace):
    """Plain frames as JSON, with a map: the arguments of ``Frame`` and of its ``add``."""

    name = "plain"

    @staticmethod
    def role(channel: Channel) -> str:
        return {"plain.Frame": "ground_truth", "plain.Map": "map"}.get(channel.schema, "payload")

    def frame(self, message: TraceMessage) -> Frame | None:
        told = json.loads(message.data)
        return plain_frame(told) if told else None


def plain_frame(told: dict[str, Any]) -> Frame:
    frame = Frame(told["time_ns"], told.get("ego"))
    for entity in told["entities"]:
        frame.add(**entity)
    return frame


def plain_world(i: int) -> dict[str, Any]:
    """A car follows another on a town's road, past a pole and a light; a person comes late and goes."""
    still = {"vx": 0.0, "vy": 0.0, "ax": 0.0, "ay": 0.0, "vz": 0.0, "az": 0.0, "yaw_rate": 0.0}
    body = {"length": 4.5, "width": 1.9, "height": 1.5}
    drives = still | body | {"kind": "car", "vx": 10.0, "heading": 5.0, "y": 0.0, "z": 0.75}
    entities = [
        drives
        | {"ident": "ego", "x": i, "lights": ["light_brake"], "throttle": i / 100}
        | {"gear": i % 4 - 1, "hand_brake": i < 3},
        drives | {"ident": "lead", "x": i + 9.5, "yaw_rate": 1.5, "special": "taxi", "brake": 0.5},
        still
        | {"ident": "lamp", "kind": "traffic_light", "x": 30.0, "y": 5.0, "light_state": "red"},
    ]
    if 10 <= i < 20:
        entities.insert(0, still | {"ident": "late", "kind": "person", "x": 25.0, "y": 3.0})
    if i % 10 == 0:
        entities.append({"ident": "pole", "kind": "pole", "x": 20, "y": 4, "z": 2, "static": True})
    return {"time_ns": i * 10**8 + 5, "ego": "ego" if i != 7 else None, "entities": entities}


STREET = a_map(a_road("1", line(200, x=-20)))


def plain(path: Path, worlds: list[Any], *, map_text: str = "", before: int = 0) -> Path:
    """A recording of plain frames; the map, if there is one, comes before one of these."""
    with recordings.Recorder(path, chunk_size=3000) as recorder:
        channel = recorder.channel("/frames", "plain.Frame", b"{}")
        for i, world in enumerate(worlds):
            if map_text and i == before:
                map_channel = recorder.channel("map", "plain.Map", b"{}")
                recorder.write(map_channel, i / 10, map_text.encode())
            data = world if isinstance(world, bytes) else json.dumps(world).encode()
            recorder.write(channel, i / 10, data)
            recorder.camera(i / 10 + 0.02)
    return path


@pytest.fixture
def plain_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = SimpleNamespace(name="plain", value="here:PlainTrace", load=lambda: PlainTrace)
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [entry] if group == plugins.READERS.group else []
    )
    read.cache_clear()


@pytest.mark.parametrize("text", ["", STREET], ids=["no map", "map"])
def test_plain_frames_have_the_graphs_of_the_online_mode(
    tmp_path: Path, plain_reader: None, text: str
) -> None:
    worlds = [plain_world(i) for i in range(70)]
    path = plain(tmp_path / "plain.mcap", worlds, map_text=text)
    (outcome,) = ingest(tmp_path / "plain.sgstore", [path])
    assert (outcome.status, outcome.losses, outcome.ego) == ("added", [], "ego"), outcome.error

    store = sgstore.open(tmp_path / "plain.sgstore")
    idents = dict(store.sql("SELECT node_id, ident FROM entities").values)
    online = SceneGraphGenerator(read_map(text, "map") if text else None, Config())
    relations: set[str] = set()
    with store.file.snapshot():
        for i, world in enumerate(worlds):
            graph = online.step(plain_frame(world))
            if i % 3 == 0:  # it takes longer to read a graph than to make it
                agree(graph, store.file.graph(f"plain#{i}"), idents)
            relations |= {relation for _, relation, _, _ in graph.edges}
    assert {"inDFrontOf", "near"} <= relations
    assert ("isIn" in relations) == bool(text)


def test_a_map_that_is_told_late_is_the_map_of_all_frames(
    tmp_path: Path, plain_reader: None
) -> None:
    worlds = [plain_world(i) for i in range(40)]
    path = plain(tmp_path / "plain.mcap", worlds, map_text=STREET, before=30)

    with open_trace(path) as trace:
        assert trace.info.map_text == STREET
        assert trace.info.ego == "ego"


def test_a_frame_that_contradicts_others_is_a_loss_and_changes_nothing(
    tmp_path: Path, plain_reader: None
) -> None:
    worlds: list[Any] = [plain_world(i) for i in range(20)]
    person = {"kind": "person", "x": 0.0, "y": 0.0}
    doubtful = [
        b"not JSON",
        b"\xff",
        b"[" * 100_000,
        {"time_ns": 1 << 70, "entities": []},
        {"time_ns": 1, "entities": [person | {"ident": "new"}, person | {"ident": "new"}]},
        {"time_ns": 1, "entities": [person | {"ident": "pole"}]},
        {"time_ns": 1, "entities": [person | {"ident": "lamp", "static": True}]},
        {"time_ns": 1, "entities": [person | {"ident": "new", "kind": "prson"}]},
    ]
    mixed = [*worlds[:10], *doubtful, b"null", *worlds[10:]]
    _, whole, _ = read(plain(tmp_path / "whole.mcap", worlds))
    for size in (7, 60):
        _, blocks, report = read(plain(tmp_path / "mixed.mcap", mixed), size)

        assert idents(blocks) == idents(whole) == ["pole", "ego", "lead", "lamp", "late"]
        for name in States.__dataclass_fields__:
            np.testing.assert_array_equal(column(blocks, name), column(whole, name))
        assert sum(len(block.messages) for block in blocks) == 2 * len(mixed)
        assert report.frames == 20
        assert [loss.messages for loss in report.losses] == [1] * len(doubtful)
        assert [loss.start_ns for loss in report.losses] == [
            (10 + i) * 10**8 for i in range(len(doubtful))
        ]
        reasons = [loss.reason for loss in report.losses]
        assert all(reason.startswith("'/frames': ") for reason in reasons)
        told = [
            "JSONDecodeError",
            "UnicodeDecodeError",
            "Recursion",
            "no time",
        ]
        told += ["two entities have the id 'new'", "'pole' was static", "'lamp' moved"]
        for reason, part in zip(reasons, [*told, "unknown kind 'prson'"], strict=True):
            assert part in reason


def test_the_ego_is_that_of_each_frame_unless_another_is_named(
    tmp_path: Path, plain_reader: None
) -> None:
    path = plain(tmp_path / "plain.mcap", [plain_world(i) for i in range(10)])
    _, (block,), report = read(path)
    assert block.ego.tolist() == [1] * 7 + [-1] + [1] * 2  # one frame names none
    assert report.warnings == []
    with open_trace(path, ego="lead") as trace:
        (block,) = trace.blocks()
        assert trace.info.ego == "lead"
        assert block.ego.tolist() == [2] * 10
    with open_trace(path, ego="nobody") as trace, pytest.raises(TraceError, match="'nobody'"):
        list(trace.blocks())


def test_what_stands_and_is_told_late_is_there_from_then_on(
    tmp_path: Path, plain_reader: None
) -> None:
    worlds = [plain_world(i) for i in range(30)]
    worlds[12]["entities"].append(
        {"ident": "tree", "kind": "vegetation", "x": 15, "y": 4, "static": True}
    )
    path = plain(tmp_path / "plain.mcap", worlds)
    _, whole, _ = read(path)
    for size in (1, 5, 12, 13):
        _, blocks, _ = read(path, size)
        assert idents(blocks) == idents(whole)
        tree = idents(blocks).index("tree")
        for name in States.__dataclass_fields__:
            np.testing.assert_array_equal(column(blocks, name), column(whole, name))
        frame = np.concatenate([block.seq[block.frame_of] for block in blocks])
        there = column(blocks, "node") == tree
        assert frame[there].tolist() == [*range(12, 30)]
        assert not column(blocks, "vx")[there].any()


def test_an_entity_without_a_position_is_a_loss(tmp_path: Path, plain_reader: None) -> None:
    worlds = [plain_world(i) for i in range(3)]
    nowhere = {"kind": "vegetation", "x": float("nan"), "y": 4.0}
    worlds[0]["entities"].append(nowhere | {"ident": "tree", "static": True})
    worlds[1]["entities"].append(nowhere | {"ident": "leaf"})
    _, blocks, report = read(plain(tmp_path / "plain.mcap", worlds))

    assert "tree" not in idents(blocks)
    assert [loss.reason for loss in report.losses] == [
        "position of entity 'tree' is unknown: missing in 1 state",
        "position of entity 'leaf' is unknown: missing in 1 state",
    ]


class HalvesTrace(PlainTrace):
    """Every second message has the entities of the time that the one before it tells."""

    def start(self) -> None:
        self.time: int | None = None

    def frame(self, message: TraceMessage) -> Frame | None:
        told = json.loads(message.data)
        if self.time is None:
            self.time = told["time_ns"]
            return None
        time, self.time = self.time, None
        return plain_frame({"time_ns": time, **told})


def test_a_flavour_of_frames_may_put_messages_together(tmp_path: Path) -> None:
    worlds = [plain_world(i) for i in range(9)]
    halves = [{"time_ns": world.pop("time_ns")} for world in worlds]
    both = [half for pair in zip(halves, worlds, strict=True) for half in pair]
    path = plain(tmp_path / "halves.mcap", both)
    with HalvesTrace(open_recording(path)) as trace:
        for size in (2, 60, 60):
            blocks = list(trace.blocks(size))
            times = np.concatenate([block.time_ns for block in blocks])
            assert times.tolist() == [half["time_ns"] for half in halves]
            assert sum(len(block.messages) for block in blocks) == 2 * len(both)  # and pictures
            assert trace.report.losses == []


def test_a_clip_of_plain_frames_brings_what_stands_and_the_map(
    tmp_path: Path, plain_reader: None
) -> None:
    path = plain(tmp_path / "plain.mcap", [plain_world(i) for i in range(40)], map_text=STREET)
    (clip,) = cut(path, tmp_path / "clips", (1.5, 2.5))
    info, blocks, report = read(clip)

    assert info.map_text == STREET
    assert idents(blocks) == ["pole", "late", "ego", "lead", "lamp"]
    assert sum(len(block.scenery) for block in blocks) == 1
    assert report.frames == 11
    assert report.losses == []


def test_a_flavour_that_cannot_be_loaded_is_named_only_where_it_is_needed(
    tmp_path: Path, installed: Path
) -> None:
    (installed / "toybox.py").write_text("raise RuntimeError('no toys')")

    assert read(recordings.drive(tmp_path / "drive.mcap", 3))[2].frames == 3
    with pytest.raises(TraceError, match=r"flavour 'toybox' \(toybox:ToyboxTrace\).*no toys"):
        open_trace(toybox(tmp_path / "toys.mcap"))


def test_what_nobody_reads_is_answered_with_the_flavours_there_are(tmp_path: Path) -> None:
    with pytest.raises(
        TraceError,
        match=r"flavour known \(sgstore, osi, carla, autoware, foxglove, .*\).*'world' \(toybox",
    ):
        open_trace(toybox(tmp_path / "toys.mcap"))


def test_the_page_of_flavours_names_them_all() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for reader in READERS:
        assert f"`{reader.name}`" in page
    page = PAGE.with_name("source_foxglove.md").read_text(encoding="utf-8")
    for mapping in shipped():
        assert f"`{mapping}`" in page
    (example,) = re.findall(r"```toml\n(\[scene\].*?)```", page, re.DOTALL)
    told = tomllib.loads(example)
    for section, cls in (("scene", SceneMapping), ("entity", EntityMapping), ("ego", Ego)):
        assert set(told[section]) == set(cls.__dataclass_fields__)
