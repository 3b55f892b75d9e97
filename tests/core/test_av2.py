"""Logs of Argoverse 2: boxes in the axes of the city, the assumed ego, maps, damage; a prompt and its truth."""

from __future__ import annotations

import csv
import json
import math
from typing import TYPE_CHECKING, Any

import av2_logs
import numpy as np
import pytest

import sgstore
from sgstore.errors import MissingExtraError, TraceError
from sgstore.ingest import ingest, recordings
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import KINDS
from sgstore.readers import open_trace, read_message

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)


def read(path: Path, **how: Any) -> tuple[Any, list[Any], Any]:
    with open_trace(path, **how) as trace:
        return trace.info, list(trace.blocks()), trace.report


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return av2_logs.drive(tmp_path / "log", 8)


def test_boxes_are_in_the_axes_of_the_city(log: Path) -> None:
    info, (block,), report = read(log)

    assert (info.flavour, info.ego, info.map_name) == ("av2", "me", "log (lanes)")
    assert (report.frames, report.losses, report.warnings) == (8, [], [])
    assert block.entities.ident == ("me", "bike", "cone")
    assert [KINDS[kind] for kind in block.entities.kind] == ["car", "bicycle", "prop"]
    # The ego drives north from (100, 50); the bicycle is 10 m ahead of it and 2 m to its left.
    bike = np.flatnonzero(block.states.node == 1)[3]
    at = [getattr(block.states, name)[bike] for name in ("x", "y", "z", "heading", "length")]
    assert at == pytest.approx([98, 63, 10.5, math.pi / 2, 1.8], abs=1e-9)
    assert block.states.vy[bike] == pytest.approx(10, rel=1e-3)
    assert block.time_ns[3] == av2_logs.START + 300_000_000


def test_an_ego_without_a_box_is_assumed_and_reported(tmp_path: Path) -> None:
    log = av2_logs.drive(tmp_path / "log", 8, ego=False)
    info, (block,), report = read(log)

    assert info.ego == "ego"
    assert ["a car of 4.877 m" in warning for warning in report.warnings] == [True]
    ego = np.flatnonzero(block.states.node == block.ego[0])[0]
    at = [getattr(block.states, name)[ego] for name in ("x", "y", "z", "length")]
    assert at == pytest.approx([100, 51.4, 10.7365, 4.877], abs=1e-9)


def test_the_map_has_lanes_neighbours_and_crosswalks(log: Path) -> None:
    info, _, _ = read(log)
    road_map = read_map(info.map_text, info.map_name)
    kinds = [KINDS[kind] for kind in road_map.nodes.kind]
    assert (kinds.count("lane"), kinds.count("crosswalk")) == (3, 1)
    told = {row["name"]: row for row in json.loads(info.map_text)["lanes"]}
    assert [told[name]["type"] for name in "123"] == ["driving", "bus", "driving"]
    assert told["1"]["onto"] == [2]
    assert told["1"]["right_beside"] == [1]
    assert [to for to, *_ in told["1"]["changes"]] == [1]


def test_clips_and_messages_are_equal(log: Path, tmp_path: Path) -> None:
    _, (block,), _ = read(log)
    clip = av2_logs.as_mcap(tmp_path / "clip.mcap", log)
    info, (other,), _ = read(clip)
    assert (info.flavour, info.map_name) == ("av2", "log (lanes)")
    assert other.states.x.tolist() == block.states.x.tolist()
    length = int(block.messages.length[4])
    data = read_message(log, chunk_offset=-1, offset=5, length=length)
    assert json.loads(data)["time_ns"] == block.time_ns[4]
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(log, chunk_offset=-1, offset=99, length=length)


def test_a_folder_needs_no_option(log: Path) -> None:
    assert recordings([log.parent]) == recordings([log]) == [log]


def test_a_missing_package_is_named(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(
        MissingExtraError, match=r"Argoverse 2, 123D\): pip install 'sgstore\[arrow\]'"
    ):
        open_trace(log)


def test_a_damaged_map_or_pose_loses_only_itself(log: Path) -> None:
    (archive,) = (log / "map").glob("log_map*")
    archive.write_text('{"lane_segments": {"1": {}}}')
    av2_logs.write_boxes(log, 8, bad=True)
    info, _, report = read(log)
    assert info.map_text == ""
    assert report.frames == 8
    assert sorted(loss.reason[:20] for loss in report.losses) == [
        "1 boxes without a po",
        "log_map_archive_log.",
    ]
    (log / av2_logs.POSES).write_bytes(b"ARROW1")
    with pytest.raises(TraceError, match="cannot be read as an Arrow file"):
        open_trace(log)


# Real logs ------------------------------------------------------------------------------------------

LOG = "real/av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6"


def decoded(log: Path) -> dict[tuple[int, str], list[float]]:
    """Independent decoder: place and heading of each box in the city, by time and track, by matrices."""
    feather = pytest.importorskip("pyarrow.feather")
    poses = feather.read_table(log / "city_SE3_egovehicle.feather").to_pylist()
    ego = {row["timestamp_ns"]: matrix(row) for row in poses}
    found = {}
    for row in feather.read_table(next(log.glob("annotations*"))).to_pylist():
        pose = ego[row["timestamp_ns"]] @ matrix(row)
        place = [*pose[:3, 3], math.atan2(pose[1, 0], pose[0, 0])]
        found[row["timestamp_ns"], row["track_uuid"]] = place
    return found


def matrix(row: dict[str, float]) -> Any:
    w, x, y, z = (row[f"q{axis}"] for axis in "wxyz")
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = np.eye(4)
    pose[:3, :3] += 2 * w * skew + 2 * skew @ skew
    pose[:3, 3] = [row[f"t{axis}_m"] for axis in "xyz"]
    return pose


@pytest.mark.parametrize("log", [LOG, "real/av2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"])
def test_real_boxes_equal_an_independent_decoder(data: Path, log: str) -> None:
    want = decoded(data / log)
    _, blocks, report = read(data / log)
    assert report.losses == []
    got: dict[tuple[int, str], list[float]] = {}
    idents = [ident for block in blocks for ident in block.entities.ident]
    for block in blocks:
        time = np.repeat(block.time_ns, np.diff(block.offsets)).tolist()
        columns = [getattr(block.states, name).tolist() for name in ("x", "y", "z", "heading")]
        for at, node, *place in zip(time, block.states.node.tolist(), *columns, strict=True):
            got[at, idents[node]] = place
    assert {key for key in got if key[1] != "ego"} == want.keys()
    keys = list(want)
    apart = np.array([got[key] for key in keys]) - np.array([want[key] for key in keys])
    apart[:, 3] = np.sin(apart[:, 3])
    assert np.abs(apart).max() < 1e-6


def test_vehicles_with_a_bicycle_to_their_right(data: Path, tmp_path: Path) -> None:
    """F1 of a prompt of Argoverse 2's scenario mining, on default settings."""
    with (data / f"{LOG}.referred.csv").open() as file:
        want = {(int(row["timestamp_ns"]), row["track_uuid"]) for row in csv.DictReader(file)}
    truth = json.loads((data / f"{LOG}.ground_truth.json").read_text())
    times = {frame["timestamp_ns"] for frame in truth["frames"]}
    store = tmp_path / "a.sgstore"
    ingest(store, [data / LOG])
    where = "lat(v,b) < -0.5*v.width AND abs(lon(v,b)) < 0.5*v.length AND gap(v,b) <= 5"
    query = f"MATCH (v:Vehicle), (b:Bicycle) WHERE {where} RETURN DISTINCT frame.time_ns, v.ident"
    rows = sgstore.open(store).find(f"USING SCOPE world {query}")
    found = {(row[0], row[1]) for row in rows if row[0] in times}
    both = len(found & want)
    assert 2 * both / (len(found) + len(want)) >= 0.98
