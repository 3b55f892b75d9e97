"""Logs of 123D: boxes, the ego's centre and motion, lights of lanes, maps, label sets, damage."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pytest
from py123d_logs import EGO, START_US, as_mcap, drive, packed

from sgstore.errors import TraceError
from sgstore.ingest import recordings
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import KINDS, LIGHT_STATES, type_meanings
from sgstore.readers import open_trace, read_message
from sgstore.readers.py123d._file import _label_sets
from sgstore.readers.py123d._msgpack import unpacked

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)


def read(path: Path) -> tuple[Any, list[Any], Any]:
    with open_trace(path) as trace:
        return trace.info, list(trace.blocks()), trace.report


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return drive(tmp_path / "log", 8)


def test_boxes_and_the_ego_have_poses_and_motion(log: Path) -> None:
    info, (block,), report = read(log)

    assert (info.flavour, info.ego, info.map_name) == ("py123d", "ego", "drive (lanes)")
    assert info.channels[1].topic == "/py123d/nuplan"
    assert (report.frames, report.losses, report.warnings) == (8, [], [])
    assert block.entities.ident == ("v1", "c1", "ego", "light 12")
    kinds = ["vehicle", "prop", "car", "traffic_light"]
    assert [KINDS[kind] for kind in block.entities.kind] == kinds
    ego = np.flatnonzero(block.states.node == 2)[3]
    names = ("x", "y", "z", "heading", "length", "vy", "ay", "yaw_rate")
    at = [getattr(block.states, name)[ego] for name in names]
    assert at == pytest.approx([100, 54.5, 10.8, math.pi / 2, 5.2, 10, 0.5, 0.1])
    assert block.states.vy[block.states.node == 0] == pytest.approx([10] * 8)
    assert block.time_ns[3] == START_US * 1000 + 300_000_000
    lamp = block.states.light_state[block.states.node == 3]
    assert [LIGHT_STATES[code] for code in lamp] == ["red"] * 5 + ["green"] * 3


def test_the_map_is_read(log: Path) -> None:
    info, _, _ = read(log)
    road_map = read_map(info.map_text, info.map_name)
    kinds = [KINDS[kind] for kind in road_map.nodes.kind]
    assert (kinds.count("lane"), kinds.count("junction"), kinds.count("crosswalk")) == (2, 1, 1)
    told = {row["name"]: row for row in json.loads(info.map_text)["lanes"]}
    assert told["11"]["onto"] == [1]
    assert told["12"]["junction"]
    assert told["11"]["speed_limit"] == pytest.approx(13.4)


def test_a_map_of_a_location_is_found_beside_the_logs(tmp_path: Path) -> None:
    log = drive(tmp_path / "logs/nuplan_val/drive", 8)
    (tmp_path / "maps/nuplan").mkdir(parents=True)
    (log / "map.arrow").rename(tmp_path / "maps/nuplan/nuplan_boston.arrow")
    assert read(log)[0].map_text
    assert recordings([tmp_path]) == [log]


def test_clips_and_messages_are_equal(log: Path, tmp_path: Path) -> None:
    _, (block,), _ = read(log)
    info, (other,), _ = read(as_mcap(tmp_path / "clip.mcap", log))
    assert (info.flavour, info.map_name) == ("py123d", "drive (lanes)")
    assert other.states.x.tolist() == block.states.x.tolist()
    length = int(block.messages.length[4])
    assert json.loads(read_message(log, chunk_offset=-1, offset=5, length=length))["boxes"]
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(log, chunk_offset=-1, offset=99, length=length)


def test_numbers_equal_an_independent_decoder(log: Path) -> None:
    """The same by pyarrow alone, and matrices instead of quaternions."""
    table = pa.ipc.open_file(log / f"{EGO}.arrow").read_all()
    want = []
    for x, y, z, qw, qx, qy, qz in table.column(f"{EGO}.imu_se3").to_pylist():
        skew = np.array([[0, -qz, qy], [qz, 0, -qx], [-qy, qx, 0]])
        turn = np.eye(3) + 2 * qw * skew + 2 * skew @ skew
        want.append([x, y, z] + turn @ [1.5, 0.0, 0.8])
    _, (block,), _ = read(log)
    ego = block.states.node == 2
    got = np.stack([getattr(block.states, axis)[ego] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_without_boxes_or_ego_the_rest_is_read(log: Path) -> None:
    (log / "box_detections_se3.arrow").unlink()
    _, (block,), report = read(log)
    assert (report.frames, block.entities.ident) == (8, ("ego", "light 12"))


def test_every_label_has_a_kind() -> None:
    assert len(_label_sets()) == 11
    for labels in _label_sets().values():
        for label in labels:
            known = [f"{table}_{label}".lower() in type_meanings() for table in ("py123d", "av2")]
            assert any(known) or label == "EGO", label


def test_messagepack_is_read_and_damage_is_refused() -> None:
    value = {"a": [1, -2, 2.5, None, True, "é"], "b": {"c": b"x"}}
    assert unpacked(packed(value)) == value
    assert unpacked(b"\x82\xa1a\x93\x01\xff\xc0\xa1b\xcd\x01\x00") == {"a": [1, -1, None], "b": 256}
    np.testing.assert_array_equal(unpacked(packed(np.eye(3))), np.eye(3))
    for data in (
        b"",
        b"\xc1",
        b"\xdb\x00\x00\x00\x09x",
        b"\x91" * 40,
        b"\x01\x01",
        b"\x81\x90\x01",
    ):
        with pytest.raises(ValueError, match="MessagePack"):
            unpacked(data)


def test_a_damaged_file_loses_only_itself(log: Path) -> None:
    (log / "map.arrow").write_bytes(b"ARROW1")
    (log / "traffic_light_detections.arrow").write_bytes(b"")
    info, _, report = read(log)
    assert (info.map_text, report.frames) == ("", 8)
    assert len(report.losses) == 2


def test_absurd_positions_and_empty_rotations_are_missing_without_a_warning(log: Path) -> None:
    file = log / f"{EGO}.arrow"
    table = pa.ipc.open_file(file).read_all()
    poses = table.column(f"{EGO}.imu_se3").to_pylist()
    poses[3][:2] = 1e200, 1e200
    poses[5][3:] = 0.0, 0.0, 0.0, 0.0
    column = table.schema.get_field_index(f"{EGO}.imu_se3")
    changed = pa.array(poses, table.schema.field(column).type)
    table = table.set_column(column, table.schema.field(column), changed)
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    _, (block,), report = read(log)

    ego = block.states.node == 2
    assert report.frames == 8
    assert np.isnan(block.states.x[ego]).tolist() == [i == 3 for i in range(8)]
    assert block.states.heading[ego] == pytest.approx([math.pi / 2] * 8)
