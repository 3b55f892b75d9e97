"""Bags of ROS other than MCAP: SQLite and ROS 1 give what MCAP gives; definitions, order and damage."""

from __future__ import annotations

import sqlite3
import struct
from typing import TYPE_CHECKING, Any

import autoware_recordings
import carla_recordings
import numpy as np
import pytest
import rosbag_files
import zstandard

import sgstore
from sgstore.errors import TraceError
from sgstore.ingest import recordings
from sgstore.mcap import McapFile
from sgstore.model.world import States, TraceReport
from sgstore.readers import (
    decode,
    open_recording,
    open_trace,
    parse_definition,
    read_message,
)
from sgstore.readers.rosbags._file import RosbagFile
from sgstore.readers.rosbags._sqlite import SqliteBag
from sgstore.store import StoreFile
from sgstore.temporal import Monitor, opened

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(10)

DRIVES = {"autoware": autoware_recordings.drive, "carla": carla_recordings.drive}
CONTAINERS = {
    "sqlite": lambda path, mcap: rosbag_files.as_db3(path / "a.db3", mcap),
    "folder": lambda path, mcap: rosbag_files.as_bag(path / "bag", mcap),
    "packed": lambda path, mcap: rosbag_files.as_bag(path / "bag", mcap, packed=True),
    "ros1": lambda path, mcap: rosbag_files.as_ros1(path / "a.bag", mcap),
    "ros1 lz4": lambda path, mcap: rosbag_files.as_ros1(path / "a.bag", mcap, compress=True),
}


def read(path: Path) -> tuple[Any, list[Any], Any]:
    with open_trace(path) as trace:
        return trace.info, list(trace.blocks()), trace.report


@pytest.fixture(params=DRIVES)
def mcap(tmp_path: Path, request: Any) -> Path:
    return DRIVES[request.param](tmp_path / "a.mcap", 8)


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_bag_gives_the_frames_of_the_mcap_file(
    mcap: Path, tmp_path: Path, container: str
) -> None:
    bag = CONTAINERS[container](tmp_path, mcap)
    info, blocks, report = read(bag)
    other, wanted, told = read(mcap)

    assert (info.flavour, info.ego, info.map_text) == (other.flavour, other.ego, other.map_text)
    assert (report.frames, report.losses, report.warnings) == (8, told.losses, told.warnings)
    assert [block.entities.ident for block in blocks] == [block.entities.ident for block in wanted]
    for block, want in zip(blocks, wanted, strict=True):
        for name in States.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(block.states, name), getattr(want.states, name))


@pytest.mark.parametrize("container", ["sqlite", "ros1"])
def test_messages_are_read_back_by_their_place(mcap: Path, tmp_path: Path, container: str) -> None:
    bag = CONTAINERS[container](tmp_path, mcap)
    _, (block,), _ = read(bag)
    refs = block.messages
    sent = {message.log_time: message.data for _, _, message in rosbag_files.messages(mcap)}
    for row in (0, len(refs) - 1):
        place = {"offset": int(refs.offset[row]), "length": int(refs.length[row])}
        data = read_message(bag, chunk_offset=-1, **place)
        assert len(data) == place["length"]
        assert container == "ros1" or data in sent.values()
    with pytest.raises(TraceError, match="the bag was replaced"):
        read_message(bag, chunk_offset=-1, offset=10**6, length=5)


def test_a_folder_gives_each_bag_once(mcap: Path, tmp_path: Path) -> None:
    bag = CONTAINERS["folder"](tmp_path, mcap)
    ros1 = CONTAINERS["ros1"](tmp_path, mcap)
    assert set(recordings([tmp_path])) == {bag, mcap, ros1}


def test_a_file_that_is_compressed_as_a_whole_is_read(mcap: Path, tmp_path: Path) -> None:
    bag = CONTAINERS["folder"](tmp_path, mcap)
    file = bag / "bag_0.db3"
    (bag / "bag_0.db3.zstd").write_bytes(zstandard.compress(file.read_bytes()))
    file.unlink()
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag_0.db3", "bag_0.db3.zstd"))
    assert read(bag)[2].frames == 8


def test_definitions_that_a_bag_lacks_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mcap = DRIVES["autoware"](tmp_path / "a.mcap", 8)
    bag = rosbag_files.as_db3(tmp_path / "a.db3", mcap, defined=False)
    with open_recording(bag) as recording:
        texts = {schema.name: schema.data for schema in recording.schemas.values()}
    assert texts["tf2_msgs/msg/TFMessage"]
    with pytest.raises(TraceError, match="no ground truth"):
        open_trace(bag)

    known = {**carla_recordings.DEFINITIONS, **autoware_recordings.AUTOWARE}
    for name, text in known.items():
        package, _, short = name.partition("/")
        folder = tmp_path / "ros/share" / package / "msg"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{short}.msg").write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros"))
    info, blocks, report = read(bag)
    assert (info.flavour, report.frames) == ("autoware", 8)
    np.testing.assert_array_equal(blocks[0].states.x, read(mcap)[1][0].states.x)


def test_damage_loses_only_what_it_hits(tmp_path: Path) -> None:
    mcap = DRIVES["carla"](tmp_path / "a.mcap", 8)
    bag = rosbag_files.as_ros1(tmp_path / "a.bag", mcap)
    bag.write_bytes(bag.read_bytes()[:-3000])  # Without an index, and cut.
    _, _, report = read(bag)
    assert report.frames >= 4
    assert any("ends inside a record" in loss.reason for loss in report.losses)

    file = rosbag_files.as_db3(tmp_path / "a.db3", mcap)
    connection = sqlite3.connect(file)
    connection.execute("UPDATE messages SET data = 'text' WHERE id = 20")
    connection.execute("UPDATE messages SET topic_id = 77 WHERE id = 21")
    connection.commit()
    connection.close()
    _, _, report = read(file)
    assert report.frames >= 7
    reasons = {loss.reason for loss in report.losses}
    assert reasons == {"a message has no data", "a.db3: 1 messages without a topic or a time"}
    file.write_bytes(b"SQLite format 3\0" + bytes(500))
    with pytest.raises(TraceError, match=r"a\.db3 cannot be read"):
        open_trace(file)


@pytest.mark.parametrize("cut", [False, True])
def test_a_damaged_page_loses_only_its_messages(tmp_path: Path, cut: bool) -> None:
    file = rosbag_files.as_db3(tmp_path / "a.db3", DRIVES["carla"](tmp_path / "a.mcap", 8))
    connection = sqlite3.connect(file)
    rows = [(1, 10**8 * i, bytes(300)) for i in range(500)]
    connection.execute("DELETE FROM messages")
    connection.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    connection.commit()
    connection.close()
    content, size = bytearray(file.read_bytes()), 4096
    if cut:
        del content[len(content) // 2 // size * size :]
    else:
        middle = len(content) // 2 // size * size
        content[middle : middle + size] = b"\xff" * size
    file.write_bytes(content)
    lost: list[str] = []
    bag = SqliteBag(tmp_path, [file], lost.append)
    assert 200 < len(bag.times) < 500
    assert np.all(np.diff(bag.times) > 0)
    assert any("damaged parts cannot be read" in words for words in lost)
    bag.close()


def test_headers_of_ros_1_have_a_number(tmp_path: Path) -> None:
    """Definitions as ROS 1 writes them: ``uint32 seq`` and ``time stamp``."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    kinds, name = store.types, "geometry_msgs/msg/PointStamped"
    head = kinds["std_msgs/msg/Header"](7, kinds["builtin_interfaces/msg/Time"](5, 6), "map")
    message = kinds[name](head, kinds["geometry_msgs/msg/Point"](1.5, 2.5, 3.5))
    with pytest.importorskip("rosbags.rosbag1").Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/at", name, typestore=store)
        writer.write(connection, 9, store.serialize_ros1(message, name))
    with open_recording(tmp_path / "a.bag") as recording:
        (run,) = recording.walk(TraceReport())
        schema = recording.schemas[1]
        told = decode(parse_definition(schema.name, schema.data), run.data(0))
    assert told["header"] == {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "map"}
    assert told["point"] == {"x": 1.5, "y": 2.5, "z": 3.5}


def test_an_absurd_number_of_elements_is_a_loss(tmp_path: Path) -> None:
    """A message claims 16 million poses, and ends after its header: each has no length of its own."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    name = "geometry_msgs/msg/PoseArray"
    with pytest.importorskip("rosbags.rosbag1").Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/at", name, typestore=store)
        writer.write(connection, 9, struct.pack("<4I", 7, 5, 6, 0) + struct.pack("<I", 1 << 24))
    report = TraceReport()
    with open_recording(tmp_path / "a.bag") as recording:
        assert [*recording.walk(report)] == []
    assert "Invalid sequence length" in report.losses[0].reason


def decoded(bag: Path) -> list[tuple[float, ...]]:
    """Independent decoder of a bag of ROS 1: places in the messages of ``nav_msgs/Odometry``."""
    data, at, found, wanted = bag.read_bytes(), 13, [], b""
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        (length,) = struct.unpack_from("<I", data, at + 4 + size)
        head, body = data[at + 4 : at + 4 + size], at + 8 + size
        op = head[head.index(b"op=") + 3]
        if op == 7 and b"nav_msgs/Odometry" in data[body : body + length]:
            wanted = head[head.index(b"conn=") :][5:9]
        if op == 2 and head[head.index(b"conn=") :][5:9] == wanted:
            # seq, stamp, frame_id, child_frame_id
            place = body + 12
            for _ in range(2):
                place += 4 + struct.unpack_from("<I", data, place)[0]
            found.append(struct.unpack_from("<3d", data, place))
        at = body if op == 5 else body + length  # The records of a chunk follow its header.
    return found


def test_a_bag_of_ros_1_equals_an_independent_decoder(tmp_path: Path) -> None:
    """The poses of Autoware's older odometry are the ego's rear axle, 1.4 m behind its centre."""
    mcap = tmp_path / "a.mcap"
    with autoware_recordings.Stack(mcap) as stack:
        for i in range(6):
            stack.pose(1 + i / 10, 8.5 * i, 2.0, old=True)
            stack.objects(1 + i / 10, [autoware_recordings.thing("car", 30, 0)])
    bag = rosbag_files.as_ros1(tmp_path / "a.bag", mcap)
    want = decoded(bag)
    _, (block,), _ = read(bag)
    ego = block.states.node == block.ego[0]
    assert len(want) == 6
    apart = block.states.x[ego] - [x for x, _, _ in want]
    assert apart == pytest.approx(apart[0])
    assert block.states.y[ego] == pytest.approx([y for _, y, _ in want])


FIX = """builtin_interfaces/Time timestamp
string frame_id
float64 latitude
float64[9] position_covariance
uint8 position_covariance_type
"""
"""``foxglove_msgs/LocationFix``, in part."""


def located(path: Path) -> Path:
    """A drive with a topic of foxglove_msgs, whose messages lie between the frames."""
    with autoware_recordings.Stack(path) as stack:
        stack.other = {**stack.other, "foxglove_msgs/LocationFix": FIX}
        for i in range(8):
            t = 1 + i / 10
            stack.pose(t, 8 * t, 0.0, v=(8.0, 0.0, 0.0))
            stack.objects(t, [autoware_recordings.thing("car", 8 * t + 20, 0)])
            told = {
                "timestamp": {"sec": 10**9, "nanosec": i},  # of another clock
                "frame_id": "gps",
                "latitude": 48 + i / 8,
                "position_covariance": [i / 3] * 9,
                "position_covariance_type": 2,
            }
            stack.send("/gps", "foxglove_msgs/LocationFix", told, t + 0.11)
    return path


@pytest.mark.parametrize("container", ["mcap", "sqlite", "packed", "ros1"])
def test_topics_of_bags_have_the_values_of_their_messages(tmp_path: Path, container: str) -> None:
    mcap = located(tmp_path / "a.mcap")
    path = mcap if container == "mcap" else CONTAINERS[container](tmp_path, mcap)
    listed = 'latitude, position_covariance[9], frame_id, "timestamp.nanosec", log_time_ns'
    sql = f"SELECT {listed} FROM topic('/gps') ORDER BY log_time_ns"
    times = [1_000_000_000 + i * 100_000_000 + 110_000_000 for i in range(8)]
    want = [(48 + i / 8, i / 3, "gps", i, time) for i, time in enumerate(times)]
    assert StoreFile.recording_sql(path, sql).rows().values == want
    for topics in ((), ("/gps",)):
        with sgstore.open(tmp_path / f"{len(topics)}.sgstore", create=True) as store:
            store.ingest(path, topics=topics)
            assert store.sql(sql).values == want
            rows = store.find("MATCH (e:Ego) RETURN frame.seq AS s, topic('/gps').latitude AS l")
            assert [tuple(row) for row in rows.rows()][2:5] == [
                (2, 48.125),
                (3, 48.25),
                (4, 48.375),
            ]


@pytest.mark.parametrize("container", ["mcap", "sqlite", "ros1"])
def test_a_monitor_opens_a_recording_with_topics_once(
    tmp_path: Path, container: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mcap = autoware_recordings.drive(tmp_path / "a.mcap", 8)
    path = mcap if container == "mcap" else CONTAINERS[container](tmp_path, mcap)
    kind = McapFile if container == "mcap" else RosbagFile
    opens, walks = [], []
    make, walk = kind.__init__, kind.walk
    monkeypatch.setattr(kind, "__init__", lambda *a, **k: (opens.append(1), make(*a, **k))[1])
    monkeypatch.setattr(kind, "walk", lambda *a, **k: (walks.append(1), walk(*a, **k))[1])
    counts = []
    pose = "topic('/localization/kinematic_state').pose_with_covariance.pose.position.x < 1000"
    seen = "topic('/perception/object_recognition/tracked/objects').header.stamp.sec < 1000"
    for text in ("ego.speed < 100", pose, f"{pose} AND {seen}"):
        opens.clear()
        walks.clear()
        with opened(str(path), sgstore.Config()) as source:
            monitor = Monitor(f"CHECK a: ALWAYS {text}", source.road_map, topics=source.topics)
            for frame in source.frames:
                monitor.step(frame)
            assert [one.verdict for one in monitor.finish()] == ["true"]
        counts.append((len(opens), len(walks)))
    assert [number for number, _ in counts] == [counts[0][0]] * 3
    assert counts[1] == counts[2]
