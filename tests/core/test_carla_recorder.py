"""Logs of CARLA's recorder: packets, boxes, lights, collisions, hidden actors, damage, and a metric."""

from __future__ import annotations

import csv
import json
import math
import struct
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import recorder_logs
from recorder_logs import begin, packet, rows

import sgstore
from sgstore.errors import TraceError
from sgstore.ingest import ingest, recordings
from sgstore.model.vocabulary import KINDS, LIGHT_STATES
from sgstore.readers import open_trace, read_message

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)

HIDDEN = "actor 9 is hidden below the road in some frames, and is left out of them"


def read(path: Path, **how: Any) -> tuple[Any, list[Any], Any]:
    with open_trace(path, **how) as trace:
        return trace.info, list(trace.blocks()), trace.report


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return recorder_logs.drive(tmp_path / "drive.log", 8)


def test_a_frame_has_boxes_motion_lights_and_controls(log: Path) -> None:
    info, (block,), report = read(log)

    assert (info.flavour, info.ego, info.map_name) == ("carla_recorder", "7", "Town01")
    assert (report.frames, report.losses, report.warnings) == (8, [], [HIDDEN])
    assert block.entities.ident == ("21", "7", "8", "20", "9")
    assert [KINDS[kind] for kind in block.entities.kind] == [
        *("prop", "car", "bicycle", "traffic_light", "person")
    ]
    states, turn = block.states, math.radians(-10)
    hero = int(np.flatnonzero(states.node == 1)[4])
    at = [getattr(states, name)[hero] for name in ("x", "y", "z", "heading", "length", "width")]
    want = [4 + 0.1 * math.cos(turn), 0.1 * math.sin(turn), 0.7, turn, 4.8, 2.0]
    assert at == pytest.approx(want, abs=1e-6)
    assert states.vy[hero] == pytest.approx(-1.7)
    assert math.degrees(states.yaw_rate[hero]) == pytest.approx(-5)
    told = [getattr(states, name)[hero] for name in ("steer", "throttle", "gear", "hand_brake")]
    assert told == [-0.25, 0.5, 2, 0]
    lamp = states.light_state[states.node == 3]
    assert [LIGHT_STATES[code] for code in lamp] == ["red"] * 4 + ["green"] * 4
    assert np.count_nonzero(states.node == 4) == 5  # Hidden in three frames.


def test_a_collision_is_an_event_and_a_clip_is_equal(log: Path, tmp_path: Path) -> None:
    _, (block,), _ = read(log)
    (event,) = block.events
    assert (event.kind, event.ident, event.other) == ("collision", "7", "8")
    assert event.time_ns == 500_000_000

    clip = recorder_logs.as_mcap(tmp_path / "clip.mcap", log)
    info, (other,), _ = read(clip)
    assert info.flavour == "carla_recorder"
    np.testing.assert_equal(asdict(other.states), asdict(block.states))


def test_messages_are_read_back_by_their_place(log: Path) -> None:
    _, (block,), _ = read(log)
    refs = block.messages
    for row in (3, 1, 7):
        place = int(refs.offset[row]), int(refs.length[row])
        data = read_message(log, chunk_offset=-1, offset=place[0], length=place[1])
        assert json.loads(data)["frame"] == row + 1
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(log, chunk_offset=-1, offset=place[0] + 1, length=place[1])


def test_the_ego_is_named_by_role_or_id(log: Path) -> None:
    assert read(log, ego="8")[0].ego == "8"
    assert read(log, ego="hero")[0].ego == "7"
    with pytest.raises(TraceError, match="no vehicle or walker has the id or role 'x'"):
        open_trace(log, ego="x")


def test_positions_can_be_origins(log: Path) -> None:
    _, (block,), _ = read(log, mapping="carla_origins")
    _, (boxes,), _ = read(log)
    hero = np.flatnonzero(block.states.node == 1)[4]
    states = block.states
    assert [states.x[hero], states.y[hero], states.z[hero]] == pytest.approx([4, 0, 0])
    own = {"origin_x": 4.0, "origin_y": 0.0, "origin_z": 0.0}
    assert states.own[hero] == boxes.states.own[hero] == own


def test_a_folder_needs_no_option_and_other_logs_are_left(log: Path) -> None:
    (log.parent / "server.log").write_text("started\n")
    assert recordings([log.parent]) == [log]


PARENTS, WALKS = packet(4, b"\0\0"), rows(9, "If", [(9, 0.1)])
WOUNDS = {
    "a cut": (lambda data: data[:-40], 7, "ends inside a packet"),
    "a length": (lambda data: data.replace(PARENTS, b"\4" + b"\xff" * 6, 1), 7, "damaged"),
    "bytes": (lambda data: data[:2500] + b"\xaa" * 300 + data[2500:], 7, "damaged"),
    "a packet": (lambda data: data.replace(WALKS, packet(9, b"\7\0")), 8, "packet 9 is malformed"),
    "no positions": (lambda data: data + begin(9, 0.8) + packet(1), 8, "without positions"),
}


@pytest.mark.parametrize("wound", WOUNDS)
def test_damage_loses_only_what_it_hits(log: Path, wound: str) -> None:
    hurt, least, reason = WOUNDS[wound]
    log.write_bytes(hurt(log.read_bytes()))
    _, _, report = read(log)
    assert report.frames >= least
    assert any(reason in loss.reason for loss in report.losses)


REAL = "real/carla_recorder/DistanceBetweenVehicles"


def decoded(data: bytes) -> list[dict[int, tuple[float, ...]]]:
    """Independent decoder: the boxes' centres by actor (m, CARLA's axes), frame by frame."""
    at, frames, boxes = 2 + 16 + 8, [], {}
    at += 2 + struct.unpack_from("<H", data, at)[0]
    while at < len(data):
        kind, size = struct.unpack_from("<BI", data, at)
        told = [
            struct.unpack_from("<I6f", data, i) for i in range(at + 7, at + 5 + size, 28)
        ] if kind in (6, 13) else []  # fmt: skip
        if kind == 6:
            frames.append({row[0]: row[1:] for row in told})
        boxes |= {row[0]: row[1:4] for row in told if kind == 13}
        at += 5 + size
    centres = []
    for poses in frames:
        centres.append({})
        for ident in {174, 175} & poses.keys():
            x, y, z, roll, pitch, yaw = poses[ident]
            r, p, w = np.radians([roll, pitch, yaw])
            about_z = [[np.cos(w), -np.sin(w), 0], [np.sin(w), np.cos(w), 0], [0, 0, 1]]
            about_y = [[np.cos(p), 0, -np.sin(p)], [0, 1, 0], [np.sin(p), 0, np.cos(p)]]
            about_x = [[1, 0, 0], [0, np.cos(r), np.sin(r)], [0, -np.sin(r), np.cos(r)]]
            turn = np.array(about_z) @ np.array(about_y) @ np.array(about_x)
            centres[-1][ident] = (np.array([x, y, z]) + turn @ np.array(boxes[ident])) / 100
    return centres


def test_boxes_of_a_real_log_equal_an_independent_decoder(data: Path) -> None:
    path = data / f"{REAL}.log"
    want = decoded(path.read_bytes())
    _, blocks, report = read(path)
    assert (report.frames, report.losses) == (len(want), []) == (847, [])
    got: dict[tuple[int, str], list[float]] = {}
    idents = [ident for block in blocks for ident in block.entities.ident]
    for block in blocks:
        frame = np.repeat(block.seq, np.diff(block.offsets)).tolist()
        columns = (getattr(block.states, axis).tolist() for axis in "xyz")
        for seq, node, *place in zip(frame, block.states.node.tolist(), *columns, strict=True):
            got[seq, idents[node]] = place
    shown = [key for key in got if key[1] in {"174", "175"}]
    assert len(shown) > 1500
    centres = np.array([want[seq][int(ident)] for seq, ident in shown]) * [1, -1, 1]
    np.testing.assert_allclose([got[key] for key in shown], centres, atol=1e-4)


def test_the_distances_of_scenario_runner(data: Path, tmp_path: Path) -> None:
    path = data / f"{REAL}.log"
    with (data / f"{REAL}.metric.csv").open() as file:
        told = [row for row in csv.DictReader(file) if row["in_metric"] == "1"]
    want = {int(row["frame"]) - 1: float(row["distance_m"]) for row in told}
    store = tmp_path / "a.sgstore"
    (outcome,) = ingest(store, [path])
    assert outcome.status == "added"
    apart = "+".join(f"pow(a.origin_{axis} - b.origin_{axis}, 2)" for axis in "xyz")
    query = (
        f"MATCH (a:Car {{ident: '174'}}), (b:Car {{ident: '175'}}) RETURN frame.seq, sqrt({apart})"
    )
    rows = sgstore.open(store).find(f"USING SCOPE world {query}")
    found = {row[0]: row[1] for row in rows}
    assert len(want) == 752
    assert want == pytest.approx({seq: found.get(seq) for seq in want}, abs=1e-4)
