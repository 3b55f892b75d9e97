"""What messages of sensors carry: pictures as files, and frames of video that a decoder can decode."""

from __future__ import annotations

import base64
import json
import random
import struct
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from io import BytesIO
from typing import TYPE_CHECKING, Any

import av
import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from permuting import Recorded
from recordings import Recorder, car, ns

from sgstore.errors import TraceError
from sgstore.ingest import ingest
from sgstore.model.config import Config, Payloads
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.pipeline.recording_ingest import Progress

JPEG = b"\xff\xd8\xff\xe0" + bytes(range(256)) + b"\xff\xd9"
GROUP = 8
"""Frames from one key frame to the next."""
ENCODERS = {
    "h264": ("libx264", {"preset": "ultrafast", "bf": "0"}),
    "h265": ("libx265", {"preset": "ultrafast", "x265-params": "bframes=0:log-level=none"}),
}

COMPRESSED = "string format\nuint8[] data\n"
VIDEO = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
HEADER = (
    "std_msgs/Header header\n{}\n================\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n"
)


def cdr_text(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)


@dataclass(frozen=True)
class Wrapping:
    """A kind of message that carries pictures: schema, encodings, and how a message is made."""

    schema: str
    schema_encoding: str
    definition: bytes
    encoding: str
    make: Callable[[bytes, str], bytes]


def protobuf_schema(name: str, **fields: tuple[int, int]) -> bytes:
    file = descriptor_pb2.FileDescriptorProto(name="f.proto", package="foxglove", syntax="proto3")
    message = file.message_type.add(name=name)
    for field, (number, kind) in fields.items():
        message.field.add(name=field, number=number, type=kind, label=1)
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def protobuf_field(number: int, data: bytes) -> bytes:
    size, length = len(data), b""
    while True:
        size, low = size >> 7, size & 127
        length += bytes([low | (128 if size else 0)])
        if not size:
            return bytes([number << 3 | 2]) + length + data


WRAPPINGS = {
    "protobuf": Wrapping(
        "foxglove.CompressedVideo",
        "protobuf",
        protobuf_schema("CompressedVideo", frame_id=(2, 9), data=(3, 12), format=(4, 9)),
        "protobuf",
        lambda data, form: (
            protobuf_field(2, b"cam") + protobuf_field(3, data) + protobuf_field(4, form.encode())
        ),
    ),
    "ros": Wrapping(
        "sensor_msgs/msg/CompressedImage",
        "ros2msg",
        HEADER.format(COMPRESSED).encode(),
        "cdr",
        lambda data, form: (
            b"\0\1\0\0"
            + padded(struct.pack("<iI", 1, 2) + cdr_text("cam"))
            + padded(cdr_text(form))
            + struct.pack("<I", len(data))
            + data
        ),
    ),
    "ros video": Wrapping(
        "foxglove_msgs/msg/CompressedVideo",
        "ros2msg",
        VIDEO.encode(),
        "cdr",
        lambda data, form: (
            b"\0\1\0\0"
            + padded(struct.pack("<iI", 1, 2) + cdr_text("cam"))
            + padded(struct.pack("<I", len(data)) + data)
            + cdr_text(form)
        ),
    ),
    "json": Wrapping(
        "foxglove.CompressedImage",
        "jsonschema",
        b"{}",
        "json",
        lambda data, form: json.dumps(
            {"data": base64.b64encode(data).decode(), "format": form}
        ).encode(),
    ),
}


def recorded(
    path: Path, wrapping: Wrapping, frames: Sequence[bytes], form: str, **how: Any
) -> StoreFile:
    """A store of a recording with ground truth every 100 ms and a message on ``/cam`` every 50 ms."""
    with Recorder(path, **how) as recorder:
        schema = recorder.writer.register_schema(
            wrapping.schema, wrapping.schema_encoding, wrapping.definition
        )
        channel = recorder.writer.register_channel("/cam", wrapping.encoding, schema)
        for i, frame in enumerate(frames):
            if i % 2 == 0:
                recorder.ground_truth(i / 20, [car(7, i / 20)], host=7)
            at = ns(i / 20)
            recorder.writer.add_message(channel, at, wrapping.make(frame, form), at, i)
    place = path.with_suffix(".db")
    config = Config(payloads=Payloads(join="latest"))
    (outcome,) = ingest(place, [path], config=config)
    assert outcome.status == "added", outcome
    return StoreFile(place)


@cache
def encoded(codec: str, count: int) -> tuple[bytes, ...]:
    """Pictures of noise that moves, each as the data of one message; a key frame every few."""
    name, options = ENCODERS[codec]
    context: Any = av.CodecContext.create(name, "w")
    context.width, context.height, context.pix_fmt = 128, 96, "yuv420p"
    context.time_base, context.gop_size, context.max_b_frames = Fraction(1, 20), GROUP, 0
    context.options = options | {"tune": "zerolatency"}
    noise = np.random.default_rng(1).integers(0, 255, (96, 128, 3), np.uint8)
    packets: list[bytes] = []
    for i in range(count):
        picture = av.VideoFrame.from_ndarray(np.roll(noise, 3 * i, axis=1), format="rgb24")
        picture.pts = i
        packets += [bytes(packet) for packet in context.encode(picture)]
    return (*packets, *(bytes(packet) for packet in context.encode(None)))


def decoded(codec: str, stream: bytes) -> list[Any]:
    """All pictures of a stream in the format of annex B."""
    with av.open(BytesIO(stream), format={"h264": "h264", "h265": "hevc"}[codec]) as container:
        return [picture.to_ndarray() for picture in container.decode(video=0)]


@cache
def pictures_of(codec: str) -> tuple[tuple[bytes, ...], list[Any]]:
    """Packets of three groups, and what they show."""
    packets = encoded(codec, 3 * GROUP)
    return packets, decoded(codec, b"".join(packets))


# What carries a picture does not know of its codec.
@pytest.mark.parametrize(
    ("codec", "wrapping"), [*(("h264", one) for one in WRAPPINGS), ("h265", "ros video")]
)
def test_a_frame_of_a_video_is_decoded_from_what_is_given(tmp_path, codec, wrapping) -> None:
    packets, whole = pictures_of(codec)
    assert len(whole) == len(packets)
    # Chunks of a few messages: the run goes over several of them.
    how = {"chunk_size": 20_000}
    store = recorded(tmp_path / "d.mcap", WRAPPINGS[wrapping], packets, codec, **how)

    frames = (0, 1, GROUP // 2, GROUP - 1, GROUP, 3 * GROUP // 2 - 1)
    with store.snapshot():
        given = [store.carried(f"d#{frame}", "/cam") for frame in frames]
    for frame, carried in zip(frames, given, strict=True):
        pictures = decoded(codec, carried.data)

        assert (carried.form, carried.messages) == (codec, 2 * frame % GROUP + 1)
        assert len(pictures) == carried.messages
        np.testing.assert_array_equal(pictures[-1], whole[2 * frame])


@pytest.mark.parametrize(
    "how", [{"use_chunking": False}, {"summary": False}, {"compression": "lz4"}]
)
def test_the_run_is_found_in_files_of_any_make(tmp_path, how) -> None:
    packets = encoded("h264", 2 * GROUP)
    store = recorded(tmp_path / "d.mcap", WRAPPINGS["protobuf"], packets, "h264", **how)

    carried = store.carried(f"d#{GROUP - 1}", "/cam")

    assert carried.data == b"".join(packets[GROUP : 2 * GROUP - 1])


@pytest.mark.parametrize("chunking", [True, False])
def test_the_run_is_in_order_of_time_whatever_the_order_in_the_file(tmp_path, chunking) -> None:
    packets = encoded("h264", 2 * GROUP)
    recorded(tmp_path / "d.mcap", WRAPPINGS["protobuf"], packets, "h264")
    whole = Recorded.of(tmp_path / "d.mcap")
    for seed in range(3):
        draw = random.Random(seed)
        path = tmp_path / str(seed) / "d.mcap"
        whole.permuted(draw).write(path, draw, size=20_000, chunking=chunking)
        (outcome,) = ingest(
            path.with_suffix(".db"), [path], config=Config(payloads=Payloads(join="latest"))
        )
        assert outcome.status == "added", outcome
        store = StoreFile(path.with_suffix(".db"))

        for frame in (1, GROUP // 2, GROUP - 1):
            last = 2 * frame
            packet = packets[last // GROUP * GROUP : last + 1]
            assert store.carried(f"d#{frame}", "/cam").data == b"".join(packet)


@pytest.mark.parametrize("how", [{}, {"use_chunking": False}])
def test_the_run_goes_over_the_files_of_a_bag(tmp_path, how) -> None:
    packets = encoded("h264", 2 * GROUP)
    bag, cut = tmp_path / "bag", GROUP + 3
    bag.mkdir()
    for name, numbers in (("a.mcap", range(cut)), ("b.mcap", range(cut, 2 * GROUP))):
        with Recorder(bag / name, **how) as recorder:
            wrapping = WRAPPINGS["ros"]
            if name == "b.mcap":  # other ids in the second file
                recorder.camera(0.0, topic="other")
            schema = recorder.writer.register_schema(
                wrapping.schema, wrapping.schema_encoding, wrapping.definition
            )
            channel = recorder.writer.register_channel("/cam", wrapping.encoding, schema)
            for i in numbers:
                if i % 2 == 0:
                    recorder.ground_truth(i / 20, [car(7, i / 20)], host=7)
                at = ns(i / 20)
                recorder.writer.add_message(channel, at, wrapping.make(packets[i], "h264"), at, i)
    (bag / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  storage_identifier: mcap\n"
        "  relative_file_paths:\n    - a.mcap\n    - b.mcap\n"
    )
    seen: list[Progress] = []
    config = Config(payloads=Payloads(join="latest"))
    (outcome,) = ingest(tmp_path / "s.db", [bag], config=config, on_progress=seen.append)
    assert outcome.status == "added", outcome
    sizes = [(bag / name).stat().st_size for name in ("a.mcap", "b.mcap")]
    assert seen[-1].size == seen[-1].all_size == sum(sizes)
    assert sizes[0] < seen[-1].bytes_done <= sum(sizes)

    carried = StoreFile(tmp_path / "s.db").carried(f"bag#{GROUP - 1}", "/cam")

    assert carried.data == b"".join(packets[GROUP : 2 * GROUP - 1])


def without_sets(packet: bytes) -> bytes:
    """A packet of H.264 without its parameter sets."""
    starts = [i for i in range(len(packet)) if packet[i : i + 3] == b"\0\0\1"]
    units = [packet[a:b] for a, b in zip(starts, [*starts[1:], len(packet)], strict=True)]
    return b"".join(unit for unit in units if unit[3] & 31 not in {7, 8})


def test_parameter_sets_that_came_only_once_are_given_too(tmp_path) -> None:
    packets = encoded("h264", 3 * GROUP)
    whole = decoded("h264", b"".join(packets))
    once = [packets[0], *map(without_sets, packets[1:])]
    store = recorded(tmp_path / "d.mcap", WRAPPINGS["ros"], once, "h264; yuv420p")

    carried = store.carried(f"d#{GROUP + 1}", "/cam")

    assert carried.messages == 3
    np.testing.assert_array_equal(decoded("h264", carried.data)[-1], whole[2 * GROUP + 2])


def test_a_frame_without_key_frame_or_parameter_sets_before_it_is_told(tmp_path) -> None:
    packets = encoded("h264", 2 * GROUP)
    cut = recorded(tmp_path / "cut.mcap", WRAPPINGS["json"], packets[1:], "h264")
    bare = [without_sets(packet) for packet in packets]
    bare_store = recorded(tmp_path / "bare.mcap", WRAPPINGS["json"], bare, "h264")

    with pytest.raises(TraceError, match=r"cut\.mcap.*no key frame \(h264\) before it"):
        cut.carried("cut#1", "/cam")
    with pytest.raises(TraceError, match=r"no parameter sets \(h264, NAL units of type \[7, 8\]\)"):
        bare_store.carried("bare#1", "/cam")


@pytest.mark.parametrize("wrapping", WRAPPINGS)
def test_a_picture_is_given_as_its_file(tmp_path, wrapping) -> None:
    store = recorded(
        tmp_path / "d.mcap", WRAPPINGS[wrapping], [JPEG] * 4, "bgr8; jpeg compressed bgr8"
    )

    carried = store.carried("d#1", "/cam")

    assert (carried.form, carried.data, carried.messages) == ("jpeg", JPEG, 1)


@pytest.mark.parametrize(
    "broken",
    [
        Wrapping("x/msg/Cloud", "ros2msg", b"uint8 a\n", "cdr", lambda data, _: b"\0\1\0\0\7"),
        Wrapping("x/msg/Odd", "ros2msg", b"nothing sensible", "cdr", lambda data, _: data),
        Wrapping("x.Odd", "protobuf", b"\xff\xff", "protobuf", lambda data, _: data),
        Wrapping("x.Odd", "jsonschema", b"", "json", lambda data, _: b"[" * 100_000),
        Wrapping("", "", b"", "opaque", lambda data, _: data),
    ],
)
def test_any_other_message_is_given_as_it_is(tmp_path, broken) -> None:
    store = recorded(tmp_path / "d.mcap", broken, [b"1234"] * 4, "")

    carried = store.carried("d#1", "/cam")

    assert (carried.form, carried.data) == ("message", store.payload("d#1", "/cam"))
