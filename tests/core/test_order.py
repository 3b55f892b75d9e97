"""Messages are read in order of time: the order in the file changes no row."""

from __future__ import annotations

import os
import random
import tracemalloc
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
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
from thorough import LONG, some

import sgstore.mcap._order as order
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.mcap import Findings, McapFile, Messages
from sgstore.pipeline.doctor import examine
from sgstore.readers import channel_rank, open_trace

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(24)

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[3] / "shared/data").resolve()
SHARED = [
    path
    for part in ("traces", "real", "cases")
    for path in sorted((DATA / part).rglob("*.mcap"))
    if "damaged" not in path.parts
]
COUNT = int(os.environ.get("SGSTORE_PERMUTATIONS", "200" if LONG else "1"))


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
STORED = [name for name in MANY if name != "foxglove json"]
"""What is stored as well: frames are compared for all of them, rows of a store come from these."""


@pytest.mark.parametrize("name", MANY)
def test_order_in_the_file_changes_no_frame(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    rows = block_rows(path)

    for other in permutations(path, tmp_path / "permuted", 3 * COUNT):
        assert not first_difference(rows, block_rows(other)), other


@pytest.mark.parametrize("name", STORED if LONG else [*RICH])
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


@pytest.mark.parametrize("name", MANY)
def test_messages_of_a_bag_may_lie_in_any_of_its_files(name: str, tmp_path: Path) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    whole = Recorded.of(path)
    rows = block_rows(path)

    for number in range(COUNT):
        draw = random.Random(number)
        bag = whole.permuted(draw).bag(tmp_path / f"bag{number}" / path.stem, draw)
        found = block_rows(bag)
        assert dict(found)["frames"] == dict(rows)["frames"]
        assert not first_difference(rows, found)


@pytest.mark.parametrize(
    ("name", "rebased"),
    [
        (name, rebased)
        for number, name in enumerate(MANY)
        for rebased in (False, True)
        if LONG or rebased == number % 2
    ],
)
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


@pytest.mark.parametrize(
    ("name", "part"),
    some(
        [
            (name, part)
            for name in ("osi", "carla with everything", "foxglove protobuf")
            for part in ({"since": 0.7, "until": 1.6}, {"rate": 4.0})
        ],
        3,
    ),
)
def test_order_in_the_file_changes_no_row_of_a_part(
    name: str, part: dict[str, float], tmp_path: Path
) -> None:
    path = MANY[name](tmp_path / f"{name}.mcap")
    rows = view_rows(path, tmp_path / "a.sgstore", **part)

    assert rows["frames"]
    for number, other in enumerate(permutations(path, tmp_path / "permuted", COUNT // 2, seed=2)):
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

    for number in range(max(COUNT, 2)):
        draw = random.Random(number)
        file = split.permuted(draw).write(tmp_path / str(number) / path.name, draw)
        found.append(block_rows(file))

    assert not first_difference(rows, [row for row in found[0] if row[0] in told])
    assert not any(first_difference(found[0], other) for other in found)


Draw = Callable[[np.random.Generator, int, int], np.ndarray[Any, Any]]
LOG_TIMES: dict[str, Draw] = {
    "random": lambda draw, _start, count: draw.integers(0, 1 << 40, count),
    "nearly in order": lambda draw, start, count: start + draw.integers(0, 9000, count),
    "backwards": lambda _draw, start, count: (1 << 40) - np.arange(start, start + count),
    "equal": lambda _draw, _start, count: np.zeros(count, np.int64),
    "half of them equal": lambda draw, _start, count: draw.integers(-9000, 9000, count).clip(0),
}
RANKS = order.ChannelRanks(
    lambda number: -number % 3 + 1, {}, {i: Channel(i, str(i), "", {}, 0) for i in (1, 2)}
)


def many_messages(count: int, times: Draw, place: int | None = None) -> Iterator[Messages]:
    """Messages of two channels, without data; of runs outside chunks if ``place`` is -1."""
    draw, each = np.random.default_rng(0), 2000
    for start in range(0, count, each):
        log = times(draw, start, min(each, count - start)).astype(np.int64)
        publish = (log + draw.integers(0, 3, len(log))).astype(np.uint64)
        channel, zeros = draw.integers(1, 3, len(log)), np.zeros(len(log), np.int64)
        offset = 31 * np.arange(start, start + len(log))
        at = 31 * start if place is None else place
        columns = channel, zeros, log, publish, offset, zeros + 20
        yield Messages(at, *columns, lambda _at, _length: memoryview(b""))


def index_of(runs: Iterator[Messages]) -> order.TimeOrder:
    return order.TimeOrder(runs, RANKS, lambda _: True, lambda _a, _b: None, Findings())


def peak_of(work: Callable[[], object]) -> int:
    """Greatest memory that some work takes beside what there was before; bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "place"), some([(name, place) for name in LOG_TIMES for place in (None, -1)], 5)
)
def test_an_index_takes_at_most_24_bytes_a_message(name: str, place: int | None) -> None:
    count = 1_500_000
    index_of(many_messages(100_000, LOG_TIMES[name]))  # modules that load late are no part of it

    assert peak_of(lambda: index_of(many_messages(count, LOG_TIMES[name], place))) <= 24 * count


@pytest.mark.parametrize("name", LOG_TIMES)
@pytest.mark.parametrize("count", [1, 3000, 200_000])
def test_an_index_that_is_sorted_part_by_part_is_in_order(name: str, count: int) -> None:
    runs = [*many_messages(count, LOG_TIMES[name])]
    chunks = {run.chunk_offset: run for run in runs}
    index = order.TimeOrder(runs, RANKS, lambda _: True, lambda at, _: chunks[at], Findings())
    log, publish, channel, offset = (
        np.concatenate([getattr(run, column) for run in runs])
        for column in ("log_time_ns", "publish_time_ns", "channel", "offset")
    )
    keys = RANKS.of(channel), order.published(log, publish, channel), log

    found = np.concatenate([run.offset for run in index.walk(Findings())])

    assert found.tolist() == offset[np.lexsort(keys)].tolist()


def test_publish_times_do_not_run_back_within_a_channel_and_a_log_time() -> None:
    draw = np.random.default_rng(0)
    log, channel = draw.integers(0, 9, 500), draw.integers(0, 3, 500)
    publish = draw.integers(0, 99, 500).astype(np.uint64)
    latest: dict[tuple[int, int], int] = {}
    expected: list[int] = []
    for key, time in zip(zip(log, channel, strict=True), publish.tolist(), strict=True):
        latest[key] = max(time, latest.get(key, 0))
        expected.append(latest[key])

    assert order.published(log, publish, channel).tolist() == expected


@pytest.mark.parametrize("mixed", [False, True])
def test_sorting_takes_at_most_64_mb_of_data(mixed: bool, tmp_path: Path) -> None:
    draw = random.Random(0)
    pictures = [draw.randbytes(1 << 18) for _ in range(4)]
    times = [*range(600)]  # 150 MB
    if mixed:
        draw.shuffle(times)
    with recordings.Recorder(tmp_path / "a.mcap", chunk_size=1 << 20) as recorder:
        channel = recorder.channel("camera", "osi3.SensorView")
        for time in times:
            recorder.write(channel, time / 10, pictures[time % 4])

    def read(rank: Callable[[int], int] | None) -> None:
        with McapFile(tmp_path / "a.mcap") as recording:
            if rank is not None:
                recording.settle_order(rank)
            count = sum(
                len(run.data(row)) > 0
                for run in recording.walk(Findings(), rank=rank)
                for row in range(len(run))
            )
        assert count == 600

    assert peak_of(lambda: read(lambda _: 1)) <= peak_of(lambda: read(None)) + (64 << 20)


def passes(path: Path, starts: list[float], *, frames: int = 30, v: float = 10) -> Findings:
    """Write passes of a drive one after another, each with its own log times, and read the file."""
    with recordings.Recorder(path, chunk_size=2000) as recorder:
        for number, start in enumerate(starts):
            for i in range(frames):
                t = start + i / 10
                recorder.ground_truth(t, [recordings.car(1, x=v * t + 90 * number)], host=1)
    return read(path)


def read(path: Path) -> Findings:
    """Read a file in order of time. The first attempt finds that it is not in order."""
    report = Findings()
    with McapFile(path) as file:
        with pytest.raises(order.OutOfOrder):
            list(file.walk(Findings(), rank=lambda _: 0))
        logged = np.concatenate([run.log_time_ns for run in file.walk(report, rank=lambda _: 0)])
    assert (np.diff(logged) >= 0).all()
    return report


def test_mixed_passes_are_reported_with_their_place(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    path = tmp_path / "d/two.mcap"
    report = passes(path, [0, 1])
    assert report.passes is not None
    assert (report.passes.count, report.passes.number) == (2, 31)
    assert (report.passes.start_ns, report.passes.end_ns) == (10**9, 2_900_000_000)
    found = examine(path)
    assert [one["kind"] for one in found.implausible] == ["mixed passes"]
    reason = "the log clock steps back by 1.9 s before message 31 of truth: 2 passes"
    assert found.implausible[0]["value"].startswith(reason)
    assert found.implausible[0]["frame"] == 10
    assert "two files" in found.implausible[0]["remedy"]
    assert not any("new entity" in one for one in found.warnings)


def test_parts_that_do_not_overlap_are_merely_unsorted(tmp_path: Path) -> None:
    report = passes(tmp_path / "swapped.mcap", [3, 0])
    assert report.passes is None
    assert "log times run back in the file by up to 5.9 s" in report.warnings[0]
    path = tmp_path / "late.mcap"
    with recordings.Recorder(path) as recorder:
        for t in (9.0, *(i / 10 for i in range(80))):  # one message is written too early
            recorder.ground_truth(t, [recordings.car(1, x=t)], host=1)
    assert read(path).passes is None


def test_doctor_measures_rates(tmp_path: Path) -> None:
    """Frames every 0.1 s with a gap of 1 s; a camera at half their rate; a map with one message."""
    path = tmp_path / "rates.mcap"
    with recordings.Recorder(path) as recorder:
        recorder.map("<OpenDRIVE/>")
        for i in range(21):
            t = i / 10 + (0.9 if i > 10 else 0)
            recorder.ground_truth(t, [recordings.car(1, x=t)], host=1)
            if i % 2 == 0:
                recorder.camera(t)
    found = examine(path)
    names = ("rate", "period", "largest_gap")
    frames = [found.as_dict()[name] for name in names]
    assert frames == pytest.approx([20 / 2.9, 0.1, 1.0])
    of = {one["topic"]: [one[name] for name in names] for one in found.channels}
    assert of["truth"] == pytest.approx(frames)
    assert of["camera"] == pytest.approx([10 / 2.9, 0.2, 1.1])
    assert [None] * 3 in of.values()
    text = StringIO()
    with redirect_stdout(text):
        run(["doctor", str(path)])
    assert text.getvalue().count("6.897 Hz, median period 0.1 s, largest gap 1 s") == 2
