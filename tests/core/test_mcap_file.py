"""The guarded MCAP reader: equal to the official one on whole files, better than it on broken ones."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from typing import TYPE_CHECKING, Any

import lz4.frame
import pytest
import zstandard
from counting import calls
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Header, Message, Schema
from mcap.stream_reader import StreamReader
from recordings import OSI, Recorder, bulb, car, drive, ground_truth, house, person, sign
from thorough import share_of, some

import sgstore.mcap._reader as mcap_reader
from sgstore.errors import TraceError
from sgstore.mcap import McapFile
from sgstore.model.world import TraceReport
from sgstore.readers import open_trace, read_message

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(12)

REAL = [
    *(
        f"esmini/{n}"
        for n in ("cut-in", "highway_merge", "pedestrian", "swarm_Town04", "traffic_lights")
    ),
    "osi_converter/MovingHostWith3DModel",
    "osi_converter/disappearingVehicle",
    "osi_converter/testBrakeAndIndicatorLights",
    "omega_prime/osi_centerline_example",
    "sumo/Town10HD_sumo_osi",
    "carla/Town01.carla",
    "carla/Town01_asrecorded.carla",
]
LAYOUTS = [
    pytest.param({"compression": "zstd"}, id="zstd"),
    pytest.param({"compression": "lz4"}, id="lz4"),
    pytest.param({"compression": ""}, id="stored"),
    pytest.param({"use_chunking": False}, id="without chunks"),
    pytest.param(
        {"compression": "zstd", "summary": False}, id="without definitions in the summary"
    ),
    pytest.param({"compression": "zstd", "enable_crcs": False}, id="without checksums"),
]
Told = tuple[int, int, int, int, bytes]


def told(path: Path, report: TraceReport | None = None) -> list[Told]:
    """Every message that our reader finds: channel, sequence, times, data."""
    with McapFile(path) as recording:
        return [
            (
                int(run.channel[row]),
                int(run.sequence[row]),
                int(run.log_time_ns[row]),
                int(run.publish_time_ns[row]),
                bytes(run.data(row)),
            )
            for run in recording.walk(report or TraceReport())
            for row in range(len(run))
        ]


def officially(path: Path) -> list[Told]:
    """Every message that the official reader finds."""
    with path.open("rb") as stream:
        return [
            (m.channel_id, m.sequence, m.log_time, m.publish_time, m.data)
            for m in StreamReader(stream, validate_crcs=True).records
            if isinstance(m, Message)
        ]


def losses(path: Path) -> list[Any]:
    report = TraceReport()
    told(path, report)
    return report.losses


def places(path: Path) -> Iterator[tuple[int, int, int, bytes]]:
    """Chunk offset, offset, length and data of every message."""
    with McapFile(path) as recording:
        for run in recording.walk(TraceReport()):
            for row in range(len(run)):
                yield (
                    run.chunk_offset,
                    int(run.offset[row]),
                    int(run.length[row]),
                    bytes(run.data(row)),
                )  # type: ignore[misc]


def chunk_index(path: Path) -> list[Any]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def spoil(path: Path, offset: int, count: int = 1) -> None:
    data = bytearray(path.read_bytes())
    data[offset : offset + count] = bytes(byte ^ 0x5A for byte in data[offset : offset + count])
    path.write_bytes(data)


# Whole files --------------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_a_real_recording_is_read_as_the_official_reader_reads_it(data: Path, name: str) -> None:
    path = data / "traces" / f"{name}.mcap"

    report = TraceReport()
    found = told(path, report)

    assert found == officially(path)
    assert report.losses == []


@pytest.mark.parametrize("how", LAYOUTS)
def test_every_layout_is_read_as_the_official_reader_reads_it(
    tmp_path: Path, how: dict[str, Any]
) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000, **how)

    report = TraceReport()
    found = told(path, report)

    assert found == officially(path)
    assert len(found) == 31
    assert report.losses == []


def test_a_file_can_be_walked_again(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.ground_truth(0.0, [car(1)])
        recorder.writer.add_attachment(0, 0, "a", "text/plain", b"a")
        recorder.writer.add_attachment(0, 0, "b", "text/plain", b"b")
    with McapFile(tmp_path / "a.mcap") as recording:
        first = [len(run) for run in recording.walk(TraceReport())]
        second = [len(run) for run in recording.walk(TraceReport())]

        assert first == second
        assert len(recording.metadata) == 0
        assert len(recording.attachments) == 2


@pytest.mark.parametrize("how", LAYOUTS)
def test_a_message_read_back_by_its_place_is_the_message(
    tmp_path: Path, how: dict[str, Any]
) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000, **how)

    read = [
        read_message(path, chunk_offset=chunk, offset=offset, length=length)
        for chunk, offset, length, _ in places(path)
    ]

    assert read == [message[-1] for message in officially(path)]


@pytest.mark.data
def test_messages_of_a_real_recording_are_read_back_by_their_place(data: Path) -> None:
    path = data / "traces/osi_converter/disappearingVehicle.mcap"

    read = [
        read_message(path, chunk_offset=chunk, offset=offset, length=length)
        for chunk, offset, length, _ in places(path)
    ]

    assert read == [message[-1] for message in officially(path)]


def test_a_second_walk_parses_no_chunk_again_for_data_that_the_first_did_not_keep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[int] = []
    real = mcap_reader.parse_records

    def counted(records: Any, offset: int) -> Any:
        parsed.append(offset)
        return real(records, offset)

    monkeypatch.setattr(mcap_reader, "parse_records", counted)
    path, topics = tmp_path / "two.mcap", ("/kept", "/other")
    with Recorder(path, chunk_size=1000) as recorder:
        schema = recorder.writer.register_schema("Plan", "", b"")
        for topic in topics:
            recorder.channels[topic] = recorder.writer.register_channel(topic, "json", schema)
        for i in range(100):
            for topic in topics:
                recorder.write(recorder.channels[topic], i / 10, f'["{topic}", {i}]'.encode())
    with McapFile(path) as file:
        kept = recorder.channels["/kept"]

        def data() -> list[bytes]:
            runs = file.walk(TraceReport(), keep=lambda channel: channel == kept)
            return [bytes(run.data(row)) for run in runs for row in range(len(run))]

        first, chunks = data(), len(parsed)
        assert len(first) == 200
        assert data() == first
    assert chunks > 5
    assert len(parsed) - chunks <= 2  # only chunks with definitions


def test_a_file_that_was_replaced_gives_no_other_message_in_its_place(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", compression="")
    chunk, offset, length, _ = list(places(path))[5]
    drive(path, frames=3, compression="", camera=False)

    for wrong in (
        {"chunk_offset": chunk, "offset": offset, "length": length},
        {"chunk_offset": chunk, "offset": 1 << 40, "length": length},
        {"chunk_offset": 1 << 40, "offset": 0, "length": length},
        {"chunk_offset": -1, "offset": 12, "length": length},
        {"chunk_offset": chunk, "offset": 0, "length": 3},
    ):
        with pytest.raises(TraceError):
            read_message(path, **wrong)


# Files that are none ------------------------------------------------------------------------------


def test_what_is_no_recording_is_named_for_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "text").write_text("hello")
    (tmp_path / "cut").write_bytes(b"\x89MCAP0\r\n\x01")
    os.mkfifo(tmp_path / "pipe")

    for name, words in (
        ("nothing", "file not found"),
        ("empty", "the file is empty"),
        ("text", "not an MCAP file"),
        ("cut", "the header of this MCAP file"),
        ("pipe", "not a regular file"),
        (".", "a folder"),
    ):
        with pytest.raises(TraceError, match=words):
            open_trace(tmp_path / name)


# Cut files ----------------------------------------------------------------------------------------


def whole_messages(path: Path) -> list[tuple[int, bytes]]:
    """For each message of a file that stores its chunks as they are: where it ends in the file."""
    head = 9 + 8 + 8 + 8 + 4 + 4 + 0 + 8  # a chunk record before its records
    return [
        ((offset if chunk < 0 else chunk + head + offset) + 31 + length, data)
        for chunk, offset, length, data in places(path)
    ]


@pytest.mark.parametrize("chunked", [True, False], ids=["in chunks", "without chunks"])
def test_a_file_cut_at_any_byte_keeps_every_whole_message(tmp_path: Path, chunked: bool) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, compression="", chunk_size=200, use_chunking=chunked) as recorder:
        channel = recorder.channel("json", "any", b"{}")
        for i in range(12):
            recorder.write(channel, i * 0.1, bytes([i]) * (i % 4) * 9)
    whole, ends = path.read_bytes(), whole_messages(path)
    cut = tmp_path / "cut.mcap"

    for length in some(range(len(whole)), 2):
        cut.write_bytes(whole[:length])
        kept = [data for end, data in ends if end <= length]
        try:
            assert [message[-1] for message in told(cut)] == kept
        except TraceError:
            assert kept == []


def test_an_osi_recording_cut_at_any_byte_ends_in_frames_or_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, compression="zstd", chunk_size=300) as recorder:
        for i in range(6):
            recorder.ground_truth(i * 0.1, [car(1, i), car(2, 9 * i)], host=1)
    whole = path.read_bytes()
    ends = [index.chunk_start_offset + index.chunk_length for index in chunk_index(path)]
    cut = tmp_path / "cut.mcap"
    frames: list[int] = []

    for length in some([*range(0, ends[0], 97), *range(ends[0], len(whole), 11), len(whole)], 4):
        cut.write_bytes(whole[:length])
        try:
            with open_trace(cut, digest="x") as trace:
                frames.append(sum(len(block) for block in trace.blocks()))
        except TraceError:
            frames.append(0)
        assert frames[-1] >= sum(end <= length for end in ends)

    assert frames[-1] == 6
    assert frames == sorted(frames)


def test_a_cut_file_names_what_was_lost(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", compression="", chunk_size=4000)
    second = chunk_index(path)[1]
    os.truncate(path, second.chunk_start_offset + second.chunk_length // 2)

    (loss,) = losses(path)

    assert "ends inside a chunk" in loss.reason
    assert loss.offset == second.chunk_start_offset
    assert loss.bytes == second.chunk_length // 2
    assert (loss.start_ns, loss.end_ns) == (second.message_start_time, second.message_end_time)


def test_a_file_without_its_end_loses_nothing_and_says_so(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000)
    everything = officially(path)
    os.truncate(path, path.stat().st_size - 20)
    report = TraceReport()

    found = told(path, report)

    assert found == everything
    assert report.losses == []
    assert any("footer" in warning for warning in report.warnings)


# Damaged files ------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_damaged_chunk_is_passed_over_and_named(tmp_path: Path, compression: str) -> None:
    path = drive(tmp_path / "a.mcap", compression=compression, chunk_size=2000)
    everything, bad = officially(path), chunk_index(path)[3]
    spoil(path, bad.chunk_start_offset + bad.chunk_length - 40, 12)
    gone = [m for m in everything if bad.message_start_time <= m[2] <= bad.message_end_time]

    found = told(path)
    (loss,) = losses(path)

    assert found == [m for m in everything if m not in gone]
    assert loss.messages == len(gone) > 0
    assert loss.bytes == bad.chunk_length
    assert (loss.start_ns, loss.end_ns) == (bad.message_start_time, bad.message_end_time)


def test_a_chunk_whose_length_is_damaged_does_not_hide_those_behind_it(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000)
    everything, bad = officially(path), chunk_index(path)[2]

    for place in (1, 3, 7):  # low, middle and high byte of the record's length
        other = tmp_path / f"{place}.mcap"
        other.write_bytes(path.read_bytes())
        spoil(other, bad.chunk_start_offset + place)

        found = told(other)

        assert len(losses(other)) >= 1
        assert found == [
            m for m in everything if not bad.message_start_time <= m[2] <= bad.message_end_time
        ]


def test_an_end_of_data_in_the_midst_is_not_believed(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000)
    everything, bad = officially(path), chunk_index(path)[2]
    data = bytearray(path.read_bytes())
    data[bad.chunk_start_offset] = 0x0F
    path.write_bytes(data)

    assert len(told(path)) == len(everything) - len(
        [m for m in everything if bad.message_start_time <= m[2] <= bad.message_end_time]
    )
    assert len(losses(path)) == 1


def test_a_summary_that_lies_does_no_harm(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=2000, enable_crcs=False)
    everything = officially(path)
    data = bytearray(path.read_bytes())
    summary = struct.unpack("<Q", data[-8 - 20 : -8 - 12])[0]
    for at in range(summary, len(data) - 40, 5):
        data[at] ^= 0x11
    path.write_bytes(data)

    found = told(path)

    assert found == everything


def test_messages_of_a_channel_that_was_never_defined_are_a_loss(tmp_path: Path) -> None:
    records = RecordBuilder()
    Message(7, 5, b"abc", 5, 0).write(records)
    Message(1, 6, b"known", 6, 0).write(records)
    path = crafted(tmp_path, records.end())

    assert [m[-1] for m in told(path)] == [b"known"]
    assert "does not define: [7]" in losses(path)[0].reason


def test_a_time_beyond_the_clock_is_a_loss(tmp_path: Path) -> None:
    records = RecordBuilder()
    Message(1, 1 << 63, b"late", 5, 0).write(records)
    path = crafted(tmp_path, records.end())

    assert told(path) == []
    assert "log time" in losses(path)[0].reason


def test_a_compression_that_nobody_knows_is_a_loss(tmp_path: Path) -> None:
    path = crafted(tmp_path, b"abc", compression="br")

    assert told(path) == []
    assert "'br' is not known" in losses(path)[0].reason


EXPECTED = {  # frames that can be saved of each file, as the folder's README says; messages lost
    "clock_jump": (200, 0),
    "cut_mid_chunk": (99, None),
    "flipped_chunk": (167, 298),
    "flipped_chunk_nocrc": (167, 298),
    "flipped_silent_nocrc": (200, 0),
    "nan_poses": (200, 0),
    "no_footer": (200, 0),
    "unknown_channel": (200, 0),
    "zstd_bomb": (6, None),
    "zstd_bomb_fcs": (6, None),
}


@pytest.mark.data
@pytest.mark.parametrize("name", EXPECTED)
def test_of_a_damaged_recording_is_saved_what_can_be(data: Path, name: str) -> None:
    path = data / f"traces/carla/damaged/{name}.mcap"
    frames, lost = EXPECTED[name]
    report = TraceReport()
    with McapFile(path) as recording:
        objects = 0
        for run in recording.walk(report):
            topics = {c.id: c.topic for c in recording.channels.values()}
            objects += sum(topics[int(number)] == "/carla/objects" for number in run.channel)

    assert objects >= frames
    assert bool(report.losses) is (lost != 0)
    if lost:
        assert [loss.messages for loss in report.losses] == [lost]


# Bombs --------------------------------------------------------------------------------------------


def crafted(
    folder: Path, stored: bytes, *, compression: str = "", size: int | None = None, crc: int = 0
) -> Path:
    """A file with one chunk, between two good messages outside chunks."""
    builder = RecordBuilder()
    builder.write(b"\x89MCAP0\r\n")
    Header("", "tests").write(builder)
    Schema(1, b"", "", "any").write(builder)
    Channel(1, "any", "json", {}, 1).write(builder)
    Chunk(compression, stored, 10, 1, crc, len(stored) if size is None else size).write(builder)
    path = folder / "crafted.mcap"
    path.write_bytes(builder.end())
    return path


def zstd_bomb(size: int, *, declared: bool) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=declared)
    if declared:
        return compressor.compress(bytes(size))
    stream = compressor.compressobj()
    return stream.compress(bytes(size)) + stream.flush()


BOMBS = [
    pytest.param("zstd", 1 << 28, False, 1000, id="zstd, more than the chunk declares"),
    pytest.param(
        "zstd", 1 << 28, True, 1000, id="zstd, more than the chunk declares, honest frame"
    ),
    pytest.param("zstd", 1 << 20, True, 1 << 31, id="zstd, 2 GiB declared"),
    pytest.param("zstd", 1 << 20, False, 1 << 28, id="zstd, less than declared"),
    pytest.param("lz4", 1 << 20, False, 1 << 28, id="lz4, less than declared"),
    pytest.param("lz4", 1 << 26, False, 1000, id="lz4, more than the chunk declares"),
    pytest.param("lz4", 1 << 20, False, 1 << 62, id="lz4, a size beyond all memory"),
]


@pytest.mark.parametrize(("compression", "size", "declared", "claimed"), BOMBS)
def test_a_chunk_that_lies_about_its_size_costs_neither_time_nor_memory(
    tmp_path: Path, compression: str, size: int, declared: bool, claimed: int
) -> None:
    stored = (
        zstd_bomb(size, declared=declared)
        if compression == "zstd"
        else lz4.frame.compress(bytes(size))
    )
    path = crafted(tmp_path, stored, compression=compression, size=claimed)
    report = TraceReport()

    tracemalloc.start()
    with calls() as counted:
        found = told(path, report)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert found == []
    assert len(report.losses) == 1
    assert counted.total() < 2_000
    assert peak <= 64 << 20


@pytest.mark.parametrize("more", [1, 1000])
def test_a_zstd_frame_that_declares_more_than_its_chunk_is_told_with_both_sizes(
    tmp_path: Path, more: int
) -> None:
    stored = zstd_bomb(1000 + more, declared=True)

    (loss,) = losses(crafted(tmp_path, stored, compression="zstd", size=1000))

    assert f"declares 1000 bytes, the zstd frame in it {1000 + more}" in loss.reason


def test_a_frame_that_asks_for_a_huge_window_is_refused(tmp_path: Path) -> None:
    parameters = zstandard.ZstdCompressionParameters(window_log=30, enable_ldm=False)
    stream = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    stored = stream.compress(b"a" * 1000) + stream.flush()

    (loss,) = losses(crafted(tmp_path, stored, compression="zstd", size=1000))

    assert "cannot be decompressed" in loss.reason


def test_a_chunk_of_endless_tiny_records_is_refused_quickly(tmp_path: Path) -> None:
    tiny = struct.pack("<BQ", 0x80, 0) * 2_000_005  # more than are read
    path = crafted(tmp_path, zstandard.compress(tiny), compression="zstd", size=len(tiny))

    with calls() as counted:
        (loss,) = losses(path)

    assert "records" in loss.reason
    assert counted.total() < 4_000_000


def test_zeros_are_no_records(tmp_path: Path) -> None:
    zeros = bytes(64 << 20)
    path = crafted(tmp_path, zstandard.compress(zeros), compression="zstd", size=len(zeros))

    assert "break off at byte 0" in losses(path)[0].reason


def test_a_chunk_may_be_of_several_frames(tmp_path: Path) -> None:
    records = RecordBuilder()
    Message(1, 5, b"abc" * 50, 5, 0).write(records)
    Message(1, 6, b"def" * 50, 6, 0).write(records)
    content = records.end()
    for name, compress in (("zstd", zstandard.compress), ("lz4", lz4.frame.compress)):
        stored = compress(content[:100]) + compress(content[100:])
        path = crafted(
            tmp_path, stored, compression=name, size=len(content), crc=zlib.crc32(content)
        )

        assert [m[-1] for m in told(path)] == [b"abc" * 50, b"def" * 50]


def test_definitions_beyond_measure_are_refused(tmp_path: Path) -> None:
    builder = RecordBuilder()
    builder.write(b"\x89MCAP0\r\n")
    Header("", "tests").write(builder)
    for number in range(1, 7):
        Schema(number, bytes(12 << 20), "", "huge").write(builder)
    path = tmp_path / "a.mcap"
    path.write_bytes(builder.end())

    with pytest.raises(TraceError, match="schemas, channels and metadata"):
        told(path)


def test_very_many_losses_become_one(tmp_path: Path) -> None:
    builder = RecordBuilder()
    builder.write(b"\x89MCAP0\r\n")
    Header("", "tests").write(builder)
    for _ in range(1500):
        Chunk("", b"bad", 1, 1, 0, 99).write(builder)
    path = tmp_path / "a.mcap"
    path.write_bytes(builder.end())

    found = losses(path)

    assert len(found) == 1000
    assert sum(loss.bytes for loss in found) == path.stat().st_size - 8 - (9 + 4 + 4 + 5)


# Fuzzing ------------------------------------------------------------------------------------------

mutations = st.lists(
    st.tuples(
        st.sampled_from(["set", "insert", "delete", "copy", "number"]),
        st.floats(0, 1, exclude_max=True),
        st.integers(0, 255),
        st.integers(1, 40),
    ),
    min_size=1,
    max_size=6,
)


def mutated(data: bytes, changes: list[tuple[str, float, int, int]]) -> bytes:
    result = bytearray(data)
    for how, where, byte, count in changes:
        at = int(where * len(result))
        match how:
            case "set":
                result[at : at + 1] = bytes([byte])
            case "insert":
                result[at:at] = bytes([byte]) * count
            case "delete":
                del result[at : at + count]
            case "copy":
                result[at : at + count] = result[byte : byte + count]
            case _:
                result[at : at + 8] = struct.pack("<Q", max((1 << (byte % 64)) - (count % 3), 0))
    return bytes(result)


def survived(path: Path) -> bool:
    """Whether reading a file ends in frames, or in an error of ours that names the file."""
    try:
        with open_trace(path, digest="x") as trace:
            return sum(len(block) for block in trace.blocks(3)) == trace.report.frames > 0
    except TraceError as error:
        return str(path) in str(error)


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("seeds")
    return [
        drive(
            folder / "a.mcap", frames=4, compression=compression, chunk_size=900, **how
        ).read_bytes()
        for compression, how in (
            ("zstd", {}),
            ("lz4", {}),
            ("", {}),
            ("", {"use_chunking": False}),
            ("", {"enable_crcs": False}),
        )
    ]


@settings(max_examples=share_of(250), deadline=5000, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 4), changes=mutations)
@example(seed=2, changes=[("set", 0.5, 0, 1)])
def test_whatever_is_done_to_a_recording_it_ends_in_frames_or_an_error(
    tmp_path: Path, seeds: list[bytes], seed: int, changes: list[tuple[str, float, int, int]]
) -> None:
    path = tmp_path / "fuzzed.mcap"
    path.write_bytes(mutated(seeds[seed], changes))

    assert survived(path)


@settings(max_examples=share_of(150), deadline=5000, suppress_health_check=list(HealthCheck))
@given(changes=mutations)
def test_whatever_is_done_to_the_descriptors_it_ends_in_frames_or_an_error(
    tmp_path: Path, changes: list[tuple[str, float, int, int]]
) -> None:
    path = tmp_path / "fuzzed.mcap"
    files = OSI.files.SerializeToString()

    class Spoiled:
        def SerializeToString(self) -> bytes:  # noqa: N802 - the name that the builder calls
            return mutated(files, changes)

    with Recorder(path, files=Spoiled()) as recorder:
        recorder.ground_truth(0.0, [car(1, 5.0, v=(1, 2))], host=1)

    assert survived(path)


@settings(max_examples=share_of(200), deadline=5000, suppress_health_check=list(HealthCheck))
@given(changes=mutations, which=st.integers(0, 3))
def test_whatever_is_done_to_the_messages_it_ends_in_frames_or_an_error(
    tmp_path: Path, changes: list[tuple[str, float, int, int]], which: int
) -> None:
    path = tmp_path / "fuzzed.mcap"
    things = {
        "lights": [bulb(8, 2, 3, (1, 2, 3)), bulb(9, 4, 2, ref="5")],
        "signs": [sign(10, 17)],
        "houses": [house(11)],
    }
    with Recorder(path) as recorder:
        channel = recorder.channel("truth", "osi3.GroundTruth")
        for i in range(4):
            moving = [car(1, i, v=(1, 2), name="Ego"), car(2, 9 * i), person(3)]
            data = ground_truth(i * 0.1, moving, host=1, **things).SerializeToString()
            data = mutated(data, changes) if i == which else data
            recorder.write(channel, i * 0.1, data)

    assert survived(path)
