"""Messages are read in order of time: the order in the file changes no row."""

from __future__ import annotations

import os
import random
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import autoware_recordings
import carla_recordings
import numpy as np
import pytest
import recordings
from foxglove_scenes import SceneRecorder, cube
from mcap.records import Channel
from permuting import Recorded, block_rows, first_difference, permutations, view_rows
from test_export_mcap import cut
from test_flavours import EXAMPLES
from thorough import LONG

import sgstore.mcap._order as order
from sgstore.cli import run
from sgstore.demo import RECORDING
from sgstore.mcap import Findings, McapFile, Messages
from sgstore.readers import channel_rank, open_trace

if TYPE_CHECKING:
    from collections.abc import Iterator

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data").resolve()
SHARED = [
    path
    for part in ("traces", "real", "cases")
    for path in sorted((DATA / part).rglob("*.mcap"))
    if "damaged" not in path.parts
]
COUNT = int(os.environ.get("SGSTORE_PERMUTATIONS", "200" if LONG else "2"))


def rich_osi(path: Path) -> Path:
    """Truth over two channels of one topic and a third, with host data, lights and a map at one time."""
    with recordings.Recorder(path, chunk_size=2000) as recorder:
        first = recorder.channel("truth", "osi3.GroundTruth")
        del recorder.channels["truth"]
        second = recorder.channel("truth", "osi3.GroundTruth")
        host = recorder.channel("host", "osi3.HostVehicleData")
        for i in range(20):
            t = i / 10
            lamp = recordings.bulb(900, 2 + i % 3, 3, (50.0, 5.0, 4.0))
            parts = (
                (first, [recordings.car(1, x=i), recordings.car(2, x=30 + i)], [lamp]),
                (second, [recordings.car(3, x=60 + i)] * (i % 5 > 0), []),
            )
            for channel, moving, lights in parts:
                told = recordings.ground_truth(t, moving, host=1, lights=lights)
                recorder.write(channel, t, told.SerializeToString())
            recorder.ground_truth(t, [recordings.person(4, x=i)], topic="others")
            data = recordings.OSI.HostVehicleData()
            data.vehicle_powertrain.pedal_position_acceleration = i / 20
            recorder.write(host, t, data.SerializeToString())
    return path


def rich_autoware(path: Path) -> Path:
    """Lists in axes that move, with poses, transforms and reports, all logged at one time or nearly so."""
    with autoware_recordings.Stack(path, chunk_size=2000) as stack:
        stack.transform(0.0, "base_link", "sensor", (1.0, 0.0, 1.0))
        for i in range(20):
            t = i / 10
            thing = autoware_recordings.thing("car", 20 + i, 1)
            stack.objects(t, [thing], axes="sensor", delay=0.0)
            stack.pose(t, 10 * t, 0.1 * i, 0.05 * i, v=(10, 0, 0))
            stack.report(t, "Gear", 2 + i // 10)
            stack.report(t, "TurnIndicators", 1 + i % 3)
    return path


def rich_foxglove(path: Path) -> Path:
    """Two scenes at one time, entities with lifetimes, deletions, and a chain of transforms."""
    with SceneRecorder.of(path, "protobuf", chunk_size=2000) as recorder:
        for i in range(20):
            t = i / 10
            recorder.transform(t, "map", "odom", (i, 0, 0), yaw=i / 50)
            recorder.transform(t, "odom", "base_link", (0, i / 10, 0))
            recorder.scene(t, [cube("walker", (i, 5, 0), type="pedestrian")], topic="people")
            seen = [cube("a", (i, 0, 0), axes="base_link", type="car")]
            if i % 4 == 0:
                seen.append(cube("b", (9, i, 0), type="car", lifetime=0.25))
            recorder.scene(t, seen, deleted=["a"] if i % 7 == 6 else [], topic="cars")
    return path


RICH = {
    "osi split": rich_osi,
    "carla with everything": lambda path: carla_recordings.drive(
        path, 20, everything=True, chunk_size=2000
    ),
    "autoware in moving axes": rich_autoware,
    "foxglove with two scenes": rich_foxglove,
}
MANY = EXAMPLES | RICH


@pytest.mark.parametrize("name", MANY)
def test_order_in_the_file_changes_no_frame(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    rows = block_rows(path)

    for other in permutations(path, tmp_path / "permuted", 3 * COUNT):
        assert not first_difference(rows, block_rows(other)), other


@pytest.mark.parametrize("name", [name for name in MANY if name != "foxglove json"])
def test_order_in_the_file_changes_no_row_of_any_view(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    rows = view_rows(path, tmp_path / "a.sgstore")

    assert len(rows["nodes"]) > 20
    for number, other in enumerate(permutations(path, tmp_path / "permuted", 1, seed=1)):
        assert not first_difference(rows, view_rows(other, tmp_path / f"{number}.sgstore"))


def test_order_in_the_file_changes_no_frame_of_the_sample(tmp_path: Path) -> None:
    rows = block_rows(RECORDING)

    for other in permutations(RECORDING, tmp_path / "permuted", COUNT):
        assert not first_difference(rows, block_rows(other))


@pytest.mark.skipif(not LONG, reason="make oracle")
def test_order_in_the_file_changes_no_row_of_the_sample(tmp_path: Path) -> None:
    rows = view_rows(RECORDING, tmp_path / "a.sgstore")

    for number, other in enumerate(permutations(RECORDING, tmp_path / "permuted", 2)):
        assert not first_difference(rows, view_rows(other, tmp_path / f"{number}.sgstore"))


@pytest.mark.parametrize("name", [name for name in MANY if name != "osi split"])
def test_messages_of_a_bag_may_lie_in_any_of_its_files(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")  # a bag takes channels of one topic for one
    whole = Recorded.of(path)
    rows = block_rows(path)

    for number in range(COUNT):
        draw = random.Random(number)
        bag = whole.permuted(draw).bag(tmp_path / f"bag{number}" / path.stem, draw)
        found = block_rows(bag)
        assert dict(found)["frames"] == dict(rows)["frames"]
        assert not first_difference(rows, found)


@pytest.mark.parametrize("rebased", [False, True])
@pytest.mark.parametrize("name", MANY)
def test_clips_of_any_order_are_one_clip(name: str, rebased: bool, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    times = [message.log_time / 1e9 for message in Recorded.of(path).messages]
    span = (min(times) + 0.9, max(times) - 0.4)
    (clip,) = cut(path, tmp_path / "a", span, rebased=rebased)
    rows = block_rows(clip)

    for number, other in enumerate(permutations(path, tmp_path / "permuted", COUNT)):
        (again,) = cut(other, tmp_path / f"b{number}", span, rebased=rebased)
        assert not first_difference(rows, block_rows(again))


@pytest.mark.skipif(not LONG, reason="make oracle")
@pytest.mark.parametrize("path", SHARED, ids=lambda path: path.stem)
def test_order_in_the_file_changes_no_frame_of_a_shared_recording(
    path: Path, tmp_path: Path
) -> None:
    rows = block_rows(path)

    for other in permutations(path, tmp_path, COUNT):
        assert not first_difference(rows, block_rows(other)), other
        other.unlink()


def test_of_a_damaged_file_in_any_order_every_whole_message_is_read(tmp_path: Path) -> None:
    path = recordings.drive(tmp_path / "a.mcap", frames=40, chunk_size=2000)
    whole = Recorded.of(path)
    draw = random.Random(3)
    whole.messages = whole.permuted(draw).messages
    draw.shuffle(whole.messages)
    mixed = whole.write(tmp_path / "mixed.mcap", draw, size=2000, chunking=True)
    with McapFile(mixed) as recording:
        chunks = recording.chunk_offsets.tolist()
    data = bytearray(mixed.read_bytes())
    data[chunks[2] + 70] ^= 255  # within its records
    cut = chunks[-1] + 400
    (tmp_path / "hurt.mcap").write_bytes(data[:cut])

    with McapFile(tmp_path / "hurt.mcap") as recording:
        report = Findings()
        runs = [*recording.walk(report)]
        logs = [time for run in runs for time in run.log_time_ns.tolist()]
        messages = sorted(bytes(run.data(row)) for run in runs for row in range(len(run)))
        recording.settle_order(channel_rank(recording))
        again = Findings()
        sorted_runs = [*recording.walk(again, rank=channel_rank(recording))]
        times = [time for run in sorted_runs for time in run.log_time_ns.tolist()]
        found = sorted(bytes(run.data(row)) for run in sorted_runs for row in range(len(run)))

    assert len(report.losses) == 2
    assert again.losses == report.losses
    assert times == sorted(logs) != logs
    assert found == messages


def test_a_file_in_order_is_not_indexed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(McapFile, "_time_order", None)
    path = recordings.drive(tmp_path / "a.mcap", frames=20, chunk_size=2000)

    with open_trace(path) as trace:
        assert sum(map(len, trace.blocks())) == 20


def test_parts_of_a_file_that_are_read_often_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recordings.drive(tmp_path / "a.mcap", frames=40)
    whole = Recorded.of(path)
    whole.messages = whole.messages[::2] + whole.messages[1::2]
    mixed = whole.write(tmp_path / "b.mcap", random.Random(0), size=1500, chunking=True)
    monkeypatch.setattr(order, "BATCH_MESSAGES", 2)
    monkeypatch.setattr(order, "CACHED", 0)

    with open_trace(mixed) as trace:
        assert sum(map(len, trace.blocks())) == 40
    assert any("were read more than 2 times" in warning for warning in trace.report.warnings)


def test_a_clip_of_a_file_without_log_times_keeps_its_order(tmp_path: Path) -> None:
    path = tmp_path / "looped.osi"
    stamps = [0.0, 0.1, 0.2, 0.3, 0.0, 0.1, 0.2, 0.3]
    messages = [
        recordings.ground_truth(stamp, [recordings.car(1, x=i)], host=1).SerializeToString()
        for i, stamp in enumerate(stamps)
    ]
    path.write_bytes(b"".join(len(one).to_bytes(4, "little") + one for one in messages))
    (clip,) = cut(path, tmp_path / "a", (0.1, 0.3))

    with open_trace(clip) as trace:
        (block,) = trace.blocks()

    assert (block.time_ns / 1e9).tolist() == [0.1, 0.2, 0.3, 0.1, 0.2, 0.3]
    assert block.states.x.tolist() == [1, 2, 3, 5, 6, 7]


@pytest.mark.parametrize("part", [{"since": 0.7, "until": 1.6}, {"rate": 4.0}])
@pytest.mark.parametrize("name", ["osi", "carla with everything", "foxglove protobuf"])
def test_order_in_the_file_changes_no_row_of_a_part(
    name: str, part: dict[str, float], tmp_path: Path
) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    rows = view_rows(path, tmp_path / "a.sgstore", **part)

    assert rows["frames"]
    for number, other in enumerate(permutations(path, tmp_path / "permuted", 2, seed=2)):
        assert not first_difference(rows, view_rows(other, tmp_path / f"{number}.sgstore", **part))


@pytest.mark.parametrize("name", ["osi split", "carla with everything", "foxglove with two scenes"])
def test_order_in_the_file_changes_nothing_that_a_monitor_tells(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    asked = ("-e", "CHECK FORALL (v:Vehicle) ALWAYS v.x < 15", "-e", "MATCH (v:Car) WHERE v.x > 9")

    def told(file: Path) -> str:
        run(["monitor", str(file), *asked, "--json"])
        return capsys.readouterr().out

    first = told(path)
    assert '"violation"' in first or "violat" in first
    for other in permutations(path, tmp_path / "permuted", 2, seed=3):
        assert told(other) == first


@pytest.mark.parametrize("name", [name for name in MANY if name != "osi split"])
def test_a_topic_may_be_split_over_two_channels(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    split = Recorded.of(path).split()
    told = {"x", "y", "time_ns", "node", "light_state", "throttle", "ident", "frames"}
    rows = [row for row in block_rows(path) if row[0] in told]
    found: list[Any] = []

    for number in range(COUNT):
        draw = random.Random(number)
        file = split.permuted(draw).write(tmp_path / str(number) / path.name, draw)
        found.append(block_rows(file))

    assert not first_difference(rows, [row for row in found[0] if row[0] in told])
    assert not any(first_difference(found[0], other) for other in found)


def test_an_index_takes_few_bytes_a_message() -> None:
    count, each = 200_000, 2000
    draw = np.random.default_rng(0)
    channels = {i: Channel(i, str(i), "", {}, 0) for i in (1, 2)}
    ranks = order.ChannelRanks(lambda _: 0, {}, channels)

    def runs() -> Iterator[Messages]:
        for start in range(0, count, each):
            times = draw.integers(0, count, each) * 1000
            zeros = np.zeros(each, np.int64)
            columns = draw.integers(1, 3, each), zeros, times, times.astype(np.uint64), zeros
            yield Messages(start, *columns, np.full(each, 20), lambda _at, _length: memoryview(b""))

    tracemalloc.start()
    try:
        index = order.TimeOrder(runs(), ranks, lambda _: True, lambda _a, _b: None, Findings())
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert index.findings.losses == []
    assert held < 24 * count
    assert peak < 48 * count
