"""What viewers need beside the messages: transforms, against the ground truth and the lidar; and a layout."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

import sgstore
from sgstore.errors import ExportError
from sgstore.exporters import Export, Mount, parse_mounts, write_export
from sgstore.model.world import Clip

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

S = 1_000_000_000
TRANSFORMS, TRUTH, POINTS = "/sgstore/tf", "ground_truth", "/ego/lidar/points"
MOUNTS = ("ego/lidar=0,0,1.75", "ego/camera/front=0.45,0,1.42,-90,0,-90")
"""As samples/town/lidar.py and camera.py have them."""


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[sgstore.Store]:
    with sgstore.open(town_store) as store:
        yield store


@pytest.fixture(scope="module")
def clip(store: sgstore.Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds in which the ego turns, with graphs."""
    clips = (Clip("town", 36 * S, 46 * S),)
    export = Export(store, clips, with_graph=True, mounts=parse_mounts(MOUNTS))
    (written,) = write_export(export, tmp_path_factory.mktemp("viewers") / "out")
    return written.file


def decoded(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Times and messages of a channel, by the descriptors in the file."""
    found, kind = [], None
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages([topic]):
            if kind is None:
                pool = descriptor_pool.DescriptorPool()
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found.append((message.log_time, kind.FromString(message.data)))
    return found


def turned(rotation: Any) -> np.ndarray[Any, Any]:
    """The matrix of a quaternion, column by column: v + 2 u × (u × v + w v)."""
    u, w = np.array([rotation.x, rotation.y, rotation.z]), rotation.w
    assert abs(u @ u + w * w - 1) < 1e-12
    columns = [v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)]
    return np.column_stack(columns)


def poses(path: Path, child: str) -> dict[int, tuple[str, Any, Any]]:
    """Parent, place and matrix of axes at each time."""
    found = {}
    for time, message in decoded(path, TRANSFORMS):
        for one in message.transforms:
            if one.child_frame_id == child:
                assert one.timestamp.seconds * S + one.timestamp.nanos == time
                place = np.array([one.translation.x, one.translation.y, one.translation.z])
                found[time] = one.parent_frame_id, place, turned(one.rotation)
    return found


def heading_of(matrix: np.ndarray[Any, Any]) -> float:
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))


# Transforms, and what they are of --------------------------------------------------------------------


def test_the_ego_is_where_the_ground_truth_has_it(clip: Path) -> None:
    ego = poses(clip, "ego")
    frames = [one for one in decoded(clip, TRUTH) if one[0] >= 36 * S]  # before it: what stands

    assert [time for time, _ in frames] == list(ego)
    assert len(frames) >= 100
    for time, frame in frames:
        host = next(o for o in frame.moving_object if o.id.value == frame.host_vehicle_id.value)
        base, (parent, place, matrix) = host.base, ego[time]
        centre = place + matrix @ [0, 0, base.dimension.height / 2]
        told = [base.position.x, base.position.y, base.position.z]
        assert parent == "map"
        assert np.abs(centre - told).max() < 0.001
        assert np.cos(heading_of(matrix) - base.orientation.yaw) > 1 - 1e-9


def test_points_of_the_lidar_lie_on_boxes_and_on_the_ground(clip: Path) -> None:
    """A viewer joins ``map`` → ``ego`` → ``ego/lidar`` at the time of the cloud, between two frames."""
    ego, frames = poses(clip, "ego"), decoded(clip, TRUTH)
    ((parent, mount, seat), *_) = poses(clip, "ego/lidar").values()
    faces: dict[tuple[int, int, float], list[float]] = {}
    ground: list[float] = []
    for time, cloud in decoded(clip, POINTS):
        rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)[:, :12]
        points = np.ascontiguousarray(rows).view("<f4").astype(float) @ seat.T + mount
        before = max((t for t in ego if t <= time), default=0)
        after = min((t for t in ego if t > time), default=0)
        if not before or not after:
            continue
        share = (time - before) / (after - before)
        (_, p0, m0), (_, p1, m1) = ego[before], ego[after]
        turn = heading_of(m0) + share * heading_of(m0.T @ m1)
        in_map = points @ about_z(turn).T + (1 - share) * p0 + share * p1
        boxes = boxes_between(dict(frames)[before], dict(frames)[after], share)
        ground += in_map[np.abs(in_map[:, 2]) < 0.05, 2].tolist()
        for ident, (centre, yaw, size) in boxes.items():
            local = (in_map - centre) @ about_z(yaw)
            beyond = np.abs(local) - size / 2
            near = np.flatnonzero(
                (np.abs(beyond.max(axis=1)) < 0.06) & (local[:, 2] > -size[2] / 2 + 0.2)
            )
            for row in near:
                axis = int(beyond[row].argmax())
                side = float(np.sign(local[row, axis]))
                faces.setdefault((ident, axis, side), []).append(float(beyond[row, axis]))

    assert parent == "ego"
    seen = {face: found for face, found in faces.items() if len(found) >= 40}
    assert len(seen) >= 5
    # The lidar has noise of 12 mm and steps of 16 mm; of many points the middle is exact.
    assert {face: m for face, found in seen.items() if abs(m := np.median(found)) > 0.01} == {}
    assert len(ground) > 1000
    assert abs(np.median(ground)) < 0.01


def about_z(angle: float) -> np.ndarray[Any, Any]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def boxes_between(before: Any, after: Any, share: float) -> dict[int, tuple[Any, float, Any]]:
    """Centre, heading and size of each vehicle but the ego, between two frames."""
    found = {}
    of = {o.id.value: o.base for o in after.moving_object}
    for o in before.moving_object:
        b, a = o.base, of.get(o.id.value)
        if a is None or o.id.value == before.host_vehicle_id.value or o.type != 2:
            continue
        p0, p1 = (np.array([x.position.x, x.position.y, x.position.z]) for x in (b, a))
        turn = (a.orientation.yaw - b.orientation.yaw + np.pi) % (2 * np.pi) - np.pi
        size = np.array([b.dimension.length, b.dimension.width, b.dimension.height])
        found[o.id.value] = p0 + share * (p1 - p0), b.orientation.yaw + share * turn, size
    return found


def test_optical_axes_look_ahead(clip: Path) -> None:
    _, place, matrix = next(iter(poses(clip, "ego/camera/front").values()))

    assert place.tolist() == [0.45, 0, 1.42]
    assert np.allclose(matrix @ [0, 0, 1], [1, 0, 0])  # its z, into the picture, is ahead
    assert np.allclose(matrix @ [1, 0, 0], [0, -1, 0])  # its x, to the right of the picture
    assert np.allclose(matrix @ [0, 1, 0], [0, 0, -1])


def test_the_world_of_osi_is_the_same_as_the_map(clip: Path) -> None:
    for parent, place, matrix in poses(clip, "global").values():
        assert parent == "map"
        assert np.array_equal(place, np.zeros(3))
        assert np.array_equal(matrix, np.eye(3))


def test_turns_are_about_z_then_y_then_x() -> None:
    from sgstore.exporters._foxglove import quaternion
    from sgstore.exporters._transforms import matrix

    def about(axis: int, angle: float) -> np.ndarray[Any, Any]:
        c, s, out = np.cos(angle), np.sin(angle), np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        out[i, i], out[j, j], out[i, j], out[j, i] = c, c, -s, s
        return out

    rng = np.random.default_rng(4)
    for yaw, pitch, roll in rng.uniform(-4, 4, (50, 3)):
        expected = about(2, yaw) @ about(1, pitch) @ about(0, roll)
        x, y, z, w = quaternion(yaw, pitch, roll)
        told = type("Quaternion", (), {"x": x, "y": y, "z": z, "w": w})
        assert np.allclose(matrix(yaw, pitch, roll), expected)
        assert np.allclose(turned(told), expected)


def test_a_recording_with_transforms_of_its_own_keeps_its_axes() -> None:
    from sgstore.exporters._transforms import FrameTransforms

    graph: Any = type("Graph", (), {"ego": 7, "nodes": {7: {"x": 1.0, "y": 2.0, "heading": 90.0}}})
    lidar = Mount("lidar", (1.0, 0.0, 2.0))
    own = list(FrameTransforms({"tf2_msgs/msg/TFMessage"}, [lidar]).of(graph))
    osi = list(FrameTransforms({"osi3.SensorView"}, [lidar]).of(graph))
    without: Any = type("Graph", (), {"ego": None, "nodes": {}})

    assert [(one.parent, one.child) for one in own] == [
        ("map", "sgstore/ego"),
        ("sgstore/ego", "lidar"),
    ]
    assert own[0].place == (1.0, 2.0, 0.0)
    assert [one.child for one in osi] == ["ego", "lidar", "global"]
    assert [one.child for one in FrameTransforms((), [lidar]).of(without)] == ["lidar"]


# What is said of sensors -----------------------------------------------------------------------------


def test_mounts_are_read() -> None:
    assert parse_mounts(["lidar=1,2,3", "base:cam=-0.5,0,1e0,90", "a:b=0,0,0,1,2,3"]) == (
        Mount("lidar", (1, 2, 3)),
        Mount("cam", (-0.5, 0, 1), 90, parent="base"),
        Mount("b", (0, 0, 0), 1, 2, 3, parent="a"),
    )


@pytest.mark.parametrize(
    "texts",
    [
        ["lidar"],
        ["lidar=1,2"],
        ["lidar=1,2,3,4,5"],
        ["=1,2,3"],
        [":a=1,2,3"],
        ["lidar=1,2,nan"],
        ["lidar=1,2,x"],
        ["a=0,0,0", "a=1,0,0"],
        ["ego=0,0,0"],
        ["map=0,0,0"],
        ["a:a=0,0,0"],
        ["a:b=0,0,0", "b:a=0,0,0"],
        ["b:c=0,0,0", "a:b=0,0,0", "c:a=0,0,0"],
    ],
)
def test_what_is_no_mount_is_refused(texts: list[str]) -> None:
    with pytest.raises(ExportError, match=r"expected|have a place already"):
        parse_mounts(texts)


def test_mounts_want_graphs(store: sgstore.Store, tmp_path: Path) -> None:
    export = Export(store, (Clip("town", 0, S),), mounts=parse_mounts(MOUNTS))

    with pytest.raises(ExportError, match="add --with-graph"):
        write_export(export, tmp_path / "out")
    with pytest.raises(ExportError, match="--mount cannot be used with the format 'parquet'"):
        write_export(replace(export, mounts=export.mounts), tmp_path / "out", "parquet")


# The layout ------------------------------------------------------------------------------------------


def test_the_layout_names_what_the_clip_holds(clip: Path) -> None:
    told = json.loads((clip.parent / "layout.json").read_text())
    manifest = json.loads((clip.parent / "manifest.json").read_text())
    with clip.open("rb") as stream:
        topics = {one.topic for one in make_reader(stream).get_summary().channels.values()}
    above = told["configById"]["3D!scene"]
    camera = told["configById"]["Image!camera"]["imageMode"]

    def panels(part: Any) -> set[str]:
        return {part} if isinstance(part, str) else panels(part["first"]) | panels(part["second"])

    assert set(above["topics"]) == {"/sgstore/scene", POINTS}
    assert above["followTf"] == "ego"
    assert camera == {
        "imageTopic": "/ego/camera/front/image",
        "calibrationTopic": "/ego/camera/front/calibration",
    }
    assert {*above["topics"], *camera.values(), "/sgstore/graph"} <= topics
    assert panels(told["layout"]) == set(told["configById"])
    assert [one["file"] for one in manifest["files"]] == ["layout.json"]


def test_the_official_definition_reads_the_transforms(clip: Path) -> None:
    official = pytest.importorskip("foxglove_schemas_protobuf.FrameTransforms_pb2")
    with clip.open("rb") as stream:
        data = [m.data for _, _, m in make_reader(stream).iter_messages([TRANSFORMS])]

    ours = [message for _, message in decoded(clip, TRANSFORMS)]
    theirs = [official.FrameTransforms.FromString(one) for one in data]
    assert [str(one) for one in ours] == [str(one) for one in theirs]
