"""Single-channel OSI files: every whole message is had, however the file is packed or hurt."""

from __future__ import annotations

import struct
import tracemalloc
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zstandard
from counting import calls
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from recordings import OSI, Recorder, bulb, car, ground_truth, house, ns, person

from sgstore.errors import TraceError
from sgstore.model.world import FrameBlock, States, TraceInfo, TraceReport
from sgstore.readers import OsiFile, descriptors, open_trace, read_message

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(7)

VERSION = b"\x0a\x06\x08\x03\x10\x05\x18\x01"
"""Field ``version`` of a ground truth: 3.5.1; the tests' own descriptors leave it out."""


def messages(count: int = 12) -> list[bytes]:
    """A car that drives east at 10 m/s, another that stands; a house in the first message."""
    return [
        VERSION
        + ground_truth(
            i * 0.1,
            [car(1, float(i), v=(10, 0)), car(2, 50.0)],
            host=1,
            lights=[bulb(7, 2, 3, (1, 2, 3))],
            houses=[house(50)] if i == 0 else [],
        ).SerializeToString()
        for i in range(count)
    ]


def packed(parts: list[bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def read(path: Path, size: int = 60) -> tuple[TraceInfo, list[FrameBlock], TraceReport]:
    with open_trace(path) as trace:
        return trace.info, list(trace.blocks(size)), trace.report


def column(blocks: list[FrameBlock], name: str) -> np.ndarray[Any, Any]:
    return np.concatenate([getattr(block.states, name) for block in blocks])


def payloads(path: Path, blocks: list[FrameBlock]) -> list[bytes]:
    return [
        read_message(path, chunk_offset=int(chunk), offset=int(offset), length=int(length))
        for block in blocks
        for chunk, offset, length in zip(
            block.messages.chunk_offset, block.messages.offset, block.messages.length, strict=True
        )
    ]


def in_frames(content: bytes, cut: int) -> bytes:
    """Zstd frames of ``cut`` bytes each, so that messages begin in one and end in another."""
    compress = zstandard.ZstdCompressor(write_checksum=True).compress
    frames = [compress(content[i : i + cut]) for i in range(0, len(content), cut)]
    skippable = struct.pack("<II", 0x184D2A53, 5) + b"notes"
    return skippable + skippable.join(frames)


def streamed(content: bytes) -> bytes:
    """As a recorder writes that flushes after every kilobyte: one frame of many blocks, its size not told."""
    writer = zstandard.ZstdCompressor().compressobj()
    pieces = [
        writer.compress(content[i : i + 1000]) + writer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        for i in range(0, len(content), 1000)
    ]
    return b"".join(pieces) + writer.flush()


PACKINGS = {
    "plain": ("a.osi", lambda content: content),
    "zstd": ("a.osi.zst", zstandard.ZstdCompressor().compress),
    "zstd, streamed": ("a.OSI.ZST", streamed),
    "zstd in many frames": ("b.osi.zst", lambda content: in_frames(content, 777)),
    "zstd, but not named so": ("c.osi", zstandard.ZstdCompressor().compress),
}


@pytest.mark.parametrize("packing", PACKINGS)
def test_every_message_is_a_frame_and_its_payload_reads_back(tmp_path: Path, packing: str) -> None:
    name, pack = PACKINGS[packing]
    told = messages()
    path = write(tmp_path / name, pack(packed(told)))
    info, blocks, report = read(path, 5)

    assert (info.flavour, info.ego, report.frames) == ("osi", "1", 12)
    assert report.losses == report.warnings == []
    assert [(c.topic, c.schema, c.role) for c in info.channels] == [
        ("ground_truth", "osi3.GroundTruth", "ground_truth")
    ]
    node = column(blocks, "node")
    driving = blocks[0].entities.ident.index("1")
    assert column(blocks, "x")[node == driving].tolist() == [float(i) for i in range(12)]
    times = np.concatenate([block.log_time_ns for block in blocks])
    assert times.tolist() == [ns(i * 0.1) for i in range(12)]
    assert payloads(path, blocks) == told


def test_what_it_is_packed_in_makes_no_difference(tmp_path: Path) -> None:
    read_all = [
        read(write(tmp_path / f"{i}{name}", pack(packed(messages(40)))))
        for i, (name, pack) in enumerate(PACKINGS.values())
    ]
    _, first, _ = read_all[0]
    for _, blocks, _ in read_all[1:]:
        assert [b.entities.ident for b in blocks] == [b.entities.ident for b in first]
        for name in States.__dataclass_fields__:
            np.testing.assert_array_equal(column(blocks, name), column(first, name))


def test_sensor_views_are_known_by_what_is_in_them(tmp_path: Path) -> None:
    views = []
    for i in range(5):
        view = OSI.SensorView(global_ground_truth=ground_truth(i * 0.1, [car(4, float(i))]))
        view.timestamp.nanos = ns(i * 0.1)
        view.host_vehicle_id.value = 4
        view.host_vehicle_data.vehicle_brake_system.pedal_position_brake = 0.5
        views.append(VERSION + view.SerializeToString())
    info, blocks, report = read(write(tmp_path / "a.osi", packed(views)))

    assert info.channels[0].schema == "osi3.SensorView"
    assert (info.ego, report.frames) == ("4", 5)
    assert column(blocks, "brake").tolist() == [0.5] * 5


@pytest.mark.parametrize("packing", ["plain", "zstd, streamed"])
def test_cut_at_every_byte_it_keeps_every_whole_message(tmp_path: Path, packing: str) -> None:
    _, pack = PACKINGS[packing]
    told = [
        VERSION + ground_truth(i * 0.1, [person(1, i)]).SerializeToString()
        for i, part in enumerate(messages(3))
    ]
    content = pack(packed(told))
    whole = packed(told)
    ends = list(accumulate(4 + len(part) for part in told))
    path = tmp_path / "a.osi"
    for cut in range(len(content) + 1):
        path.write_bytes(content[:cut])
        arrived = cut if packing == "plain" else arrived_of(content[:cut])
        expected = sum(end <= arrived for end in ends)
        if not expected:
            with pytest.raises(TraceError):
                read(path)
            continue
        _, blocks, report = read(path)
        assert report.frames == expected
        assert payloads(path, blocks) == told[:expected]
        partial = arrived not in (0, *ends)
        assert len(report.losses) == partial, (cut, report.losses)
        assert not partial or "the file ends inside a message" in report.losses[0].reason
    assert report.frames == 3
    assert arrived == len(whole)


def arrived_of(content: bytes) -> int:
    """How many bytes the whole blocks of a cut zstd frame become: what its own library gives."""
    return len(zstandard.ZstdDecompressor().decompressobj().decompress(content)) if content else 0


@pytest.mark.parametrize(
    "lie", [0, 3, 40, 2000, 1 << 20, 0xFFFFFFFF], ids=lambda lie: f"a length of {lie}"
)
def test_a_length_that_lies_costs_one_message(tmp_path: Path, lie: int) -> None:
    told = messages(9)
    content = bytearray(packed(told))
    at = sum(4 + len(part) for part in told[:4])
    struct.pack_into("<I", content, at, lie)
    path = write(tmp_path / "a.osi", bytes(content))
    _, blocks, report = read(path)

    x = column(blocks, "x")[column(blocks, "node") == blocks[0].entities.ident.index("1")]
    assert [v for v in x.tolist() if v != 4.0] == [0, 1, 2, 3, 5, 6, 7, 8]
    assert sum(loss.bytes for loss in report.losses) >= len(told[4])
    for loss in report.losses:
        assert at <= loss.offset <= at + len(told[4]) or "cannot be read" in loss.reason


def test_damage_inside_a_message_costs_that_message(tmp_path: Path) -> None:
    told = messages(5)
    told[2] = told[2][:20] + b"\xff" * (len(told[2]) - 20)
    _, _, report = read(write(tmp_path / "a.osi", packed(told)))

    assert report.frames == 4
    (loss,) = report.losses
    assert (loss.messages, loss.bytes) == (1, len(told[2]))


def test_a_version_that_only_the_first_message_tells_is_enough(tmp_path: Path) -> None:
    first, *others = messages(40)
    others = [part.removeprefix(VERSION) for part in others]
    assert not any(VERSION in part for part in others)

    path = write(tmp_path / "a.osi", packed([first, *others]))
    with OsiFile(path) as recording:
        report = TraceReport()
        told = [bytes(run.data(i)) for run in recording.walk(report) for i in range(len(run))]
    assert told == [first, *others]
    assert not report.losses


def test_a_compressed_file_that_is_damaged_keeps_what_comes_before(tmp_path: Path) -> None:
    content = bytearray(in_frames(packed(messages(40)), 5000))
    content[len(content) // 2 : len(content) // 2 + 30] = b"\xa5" * 30
    path = write(tmp_path / "a.osi.zst", bytes(content))
    _, blocks, report = read(path)

    assert 10 < report.frames < 30
    assert any("cannot be decompressed" in loss.reason for loss in report.losses)
    sound = report.frames - 2  # a block that is damaged may give some bytes before it is noticed
    assert payloads(path, blocks)[:sound] == messages(40)[:sound]


@pytest.mark.parametrize(
    "before",
    [
        pytest.param(b"", id="a gigabyte of zeros"),
        pytest.param(packed(messages(3)), id="… behind messages"),
    ],
)
def test_a_bomb_costs_little(tmp_path: Path, before: bytes) -> None:
    zeros = bytes(1 << 20)
    compressor = zstandard.ZstdCompressor().compressobj(len(before) + 1024 * len(zeros))
    parts = [compressor.compress(part) for part in (before, *[zeros] * 1024)]
    path = write(tmp_path / "a.osi.zst", b"".join(parts) + compressor.flush())
    tracemalloc.start()
    with calls() as counted:
        try:
            _, _, report = read(path)
        except TraceError:
            report = TraceReport()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert report.frames == (3 if before else 0)
    assert not before or any("2000 times" in loss.reason for loss in report.losses)
    assert counted.total() < 1_000_000
    assert peak < 200 << 20


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "the file is empty"),
        (b"\x00", "ends inside a message: 1 of 4 bytes"),
        (b"just a text file, no recording at all", "damage: a message of 1953723754 bytes"),
        (packed([b"\x12\x02\x08\x05" * 3] * 4), "neither osi3.GroundTruth nor osi3.SensorView"),
        (zstandard.ZstdCompressor().compress(b""), "the file is empty"),
    ],
)
def test_what_is_no_ground_truth_is_refused(tmp_path: Path, content: bytes, why: str) -> None:
    with pytest.raises(TraceError, match=why):
        open_trace(write(tmp_path / "a.osi", content))


def test_the_container_is_what_the_bytes_say_not_the_name(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.osi") as recorder:
        recorder.ground_truth(0.0, [car(1)], host=1)
        recorder.camera(0.0)
    info, blocks, _ = read(tmp_path / "a.osi")

    assert [channel.topic for channel in info.channels] == ["truth", "camera"]
    assert len(payloads(tmp_path / "a.osi", blocks)) == 2


def test_a_payload_of_a_file_that_was_replaced_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.osi", packed(messages(3)))
    length = len(messages(3)[0])
    for place in ({"offset": 0, "length": length - 1}, {"offset": 9, "length": length}):
        with pytest.raises(TraceError, match="the file was replaced"):
            read_message(path, chunk_offset=-1, **place)
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(path, chunk_offset=5, offset=0, length=length)
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(path, chunk_offset=-1, offset=1 << 40, length=1 << 40)


def test_the_log_time_is_the_time_of_the_message_and_else_the_last_one(tmp_path: Path) -> None:
    stamps = [0.5, None, -3.0, 0.6]
    told = [ground_truth(stamp, [car(1)], host=1).SerializeToString() for stamp in stamps]
    _, blocks, _ = read(write(tmp_path / "a.osi", packed(told)))

    assert blocks[0].log_time_ns.tolist() == [ns(0.5), ns(0.5), ns(0.5), ns(0.6)]


def test_memory_does_not_grow_with_the_length_of_a_file(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        path = write(tmp_path / "a.osi.zst", streamed(packed(messages(count))))
        with OsiFile(path) as recording:
            tracemalloc.start()
            total = sum(len(run) for run in recording.walk(TraceReport()))
            highest = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert total == count
        return highest

    assert peak(12_000) < 1.3 * peak(3_000)


# Real files ----------------------------------------------------------------------------------------


@pytest.mark.data
def test_our_descriptors_say_what_those_of_real_recordings_say(data: Path) -> None:
    ours = types_of(descriptors())
    checked = 0
    for name in ("esmini/swarm_Town04", "osi_converter/disappearingVehicle"):
        with (data / "traces" / f"{name}.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
            assert summary is not None
        for schema in summary.schemas.values():
            theirs = types_of(schema.data)
            for path in ours.keys() & theirs.keys():
                assert ours[path] == theirs[path], path
                checked += 1
    assert checked > 700


def types_of(content: bytes) -> dict[str, Any]:
    """Path of every field and value of an enumeration → its number, type and label."""
    found: dict[str, Any] = {}

    def enter(message: Any, prefix: str) -> None:
        for field in message.field:
            found[f"{prefix}.{field.name}"] = (
                field.number, field.type, field.type_name, field.label
            )  # fmt: skip
        for enum in message.enum_type:
            for value in enum.value:
                found[f"{prefix}.{enum.name}.{value.name}"] = value.number
        for nested in message.nested_type:
            enter(nested, f"{prefix}.{nested.name}")

    for file in descriptor_pb2.FileDescriptorSet.FromString(content).file:
        for message in file.message_type:
            enter(message, message.name)
    return found


@pytest.mark.data
@pytest.mark.parametrize(("name", "frames"), [("alks_cut-in", 305), ("pedestrian", 434)])
def test_the_real_files_are_what_protobuf_reads(data: Path, name: str, frames: int) -> None:
    path = data / "traces/omega_prime" / f"{name}.osi"
    content = path.read_bytes()
    parts, at = [], 0
    while at < len(content):
        (length,) = struct.unpack_from("<I", content, at)
        parts.append(content[at + 4 : at + 4 + length])
        at += 4 + length
    with (data / "traces/esmini/swarm_Town04.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
    (schema,) = (s for s in summary.schemas.values() if s.name == "osi3.GroundTruth")
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    truth = message_factory.GetMessageClass(pool.FindMessageTypeByName("osi3.GroundTruth"))
    grounds = [truth.FromString(part) for part in parts]
    _, blocks, report = read(path)

    moving = column(blocks, "light_state") < 0
    things = [thing.base for ground in grounds for thing in ground.moving_object]
    assert report.frames == len(grounds) == frames
    assert report.losses == []
    for axis in "xyz":
        expected = [getattr(base.position, axis) for base in things]
        assert column(blocks, axis)[moving].tolist() == expected
    assert column(blocks, "vx")[moving].tolist() == [base.velocity.x for base in things]
    assert payloads(path, blocks) == parts


def test_a_world_that_is_empty_at_first_is_known_by_what_comes_later(tmp_path: Path) -> None:
    told = [VERSION + ground_truth(i / 10).SerializeToString() for i in range(40)]
    _, blocks, report = read(write(tmp_path / "a.osi", packed([*told, *messages(2)])))

    assert report.frames == 42
    assert "1" in [ident for block in blocks for ident in block.entities.ident]


@pytest.mark.parametrize("more", [0, 1])
def test_a_file_may_become_as_large_as_the_bound_and_no_larger(tmp_path: Path, more: int) -> None:
    parts = messages(12)
    parts[3:7] = [part + field_of(15 << 20) for part in parts[3:7]]
    parts[7] += field_of((64 << 20) + more - len(packed(parts)) - len(field_of(0)))
    content = packed(parts)
    assert len(content) == (64 << 20) + more
    path = write(tmp_path / "a.osi.zst", zstandard.compress(content))

    _, blocks, report = read(path)

    assert sum(map(len, blocks)) == 12 - more
    lost = [loss.reason for loss in report.losses]
    assert ("decompressed to more than 2000 times its size" in lost) == bool(more)


def field_of(size: int) -> bytes:
    """A field that no descriptor has, with so many zeros."""
    head = [1 << 7 | size >> shift & 127 for shift in (0, 7, 14)]
    return b"\xc2\x3e" + bytes([*head, size >> 21]) + bytes(size)
