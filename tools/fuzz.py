"""Recordings, texts and stores, hurt where it hurts: looking at them ends in a result or an error of sgstore's.

::

    python tools/fuzz.py [--runs 100000] [--seed 0] [--keep FOLDER] [FLAVOUR …]

Recordings: a case is a sample of a flavour with one to four mutations that know what they hurt: fields of
protobuf messages, values of JSON, numbers and lengths of CDR, descriptors and definitions, times and order of
messages, records and chunks of the file. It is made from its seed alone, so a seed that fails can be run again;
its file is kept. In every second case threads decompress chunks ahead, as they do in large files; and one of
sixteen goes the whole way: into a store, which is verified and asked. Texts and stores: see ``fuzz_texts.py``.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import re
import resource
import shutil
import struct
import sys
import tempfile
import threading
import time
import traceback
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import autoware_recordings
import av2_logs
import carla_recordings
import commonroad_scenarios
import fuzz_texts
import numpy as np
import py123d_logs
import recorder_logs
import recordings
import rosbag_files
import sumo_recordings
import zstandard
from foxglove_scenes import SceneRecorder, cube
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recordings import bulb, car, ground_truth, house, sign
from topic_recordings import topic_recording

import sgstore
import sgstore.mcap._reader as mcap_file
from sgstore.base.quoting import literal
from sgstore.errors import TraceError
from sgstore.exporters import Recorder
from sgstore.ingest import ingest
from sgstore.lang.topics import TopicError
from sgstore.model.world import States
from sgstore.readers import open_trace
from sgstore.readers.osi._schema import fields_of
from sgstore.store import StoreFile
from sgstore.store._topic_views import converted, topics_in
from sgstore.store._topics import FrameClock

if TYPE_CHECKING:
    from collections.abc import Callable

SECONDS = 10.0
"""Longest that a case may take, of the process's own time."""
MEGABYTES = 600
"""By how much the cases of a flavour may raise the peak of the process's memory."""
FRAMES = 6
WHOLE_WAY = 16
"""One of so many recordings goes the whole way."""


@dataclass
class Message:
    channel: int
    time: int
    data: bytes


@dataclass
class Channel:
    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes


@dataclass
class Sample:
    """A recording that can be hurt: its channels, its messages, and the ending of its file."""

    channels: list[Channel]
    messages: list[Message]
    ending: str = ".mcap"


# Samples ------------------------------------------------------------------------------------------------


def osi(path: Path) -> None:
    recordings.drive(path, FRAMES)


def osi_views(path: Path) -> None:
    with recordings.Recorder(path) as recorder:
        for i in range(FRAMES):
            things = [car(0, float(i), v=(1, 0), name="Ego"), car(5, 9.0)]
            recorder.sensor_view(
                i / 10, things, host=0, throttle=0.5, lights=[bulb(2, 2, 3, (1, 1, 1))]
            )
            recorder.ground_truth(i / 10, [car(7, 3.0)], houses=[house(50)], signs=[sign(60, 52)])


def foxglove(path: Path, encoding: str) -> None:
    with SceneRecorder.of(path, encoding) as recorder:
        recorder.transform(0.0, "base_link", "lidar", (1, 0, 1))
        for i in range(FRAMES):
            t = i / 10
            recorder.transform(t, "map", "base_link", (i, 0, 0), i / 9)
            boxes = [cube("a", (i, 2, 0), type="car", speed=3.0, lifetime=0.15)]
            boxes += [
                cube("b", axes="lidar", locked=False, shape="spheres"),
                cube("ego", type="bus"),
            ]
            recorder.scene(t, boxes, deleted=["a"] if i == 3 else [], clear=i == 4)
            recorder.camera(t, 30)


def commonroad(path: Path) -> None:
    source = path.with_suffix(".xml")
    source.write_text(commonroad_scenarios.scenario(frames=FRAMES + 9))
    commonroad_scenarios.as_mcap(path, source)


@cache
def sample(flavour: str) -> Sample:
    """The sample of a flavour, as it is."""
    if flavour == ".xml":
        text = commonroad_scenarios.scenario(frames=FRAMES + 9).encode()
        return Sample([Channel("", "xml", "", "", b"")], [Message(0, 0, text)], flavour)
    if flavour in BAGS:
        with tempfile.TemporaryDirectory() as folder:
            mcap = carla_recordings.drive(Path(folder) / "a.mcap", FRAMES, everything=True)
            data = BAGS[flavour](Path(folder) / f"a{flavour}", mcap).read_bytes()
        return Sample([Channel("", "", "", "", b"")], [Message(0, 0, data)], flavour)
    if flavour in FOLDERS:
        with tempfile.TemporaryDirectory() as folder:
            path = FOLDERS[flavour](Path(folder) / "log", FRAMES)
            found = Sample([], [], flavour)
            for number, file in enumerate(sorted(one for one in path.rglob("*") if one.is_file())):
                encoding = "json" if file.suffix == ".json" else ""
                found.channels.append(Channel(str(file.relative_to(path)), encoding, "", "", b""))
                found.messages.append(Message(number, 0, file.read_bytes()))
        return found
    if flavour == ".log":
        packets = [Message(0, 0, data) for data in recorder_logs.packets(FRAMES)]
        return Sample([Channel("", "packet", "", "", b"")], packets, flavour)
    if flavour.startswith(".osi"):
        version = b"\x0a\x04\x08\x03\x10\x05"
        messages = [
            Message(0, 0, version + ground_truth(i / 10, [car(1, float(i)), car(2)], host=1,
                    houses=[house(50)]).SerializeToString())
            for i in range(FRAMES)
        ]  # fmt: skip
        return Sample([Channel("", "protobuf", "", "", b"")], messages, flavour)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        WRITERS[flavour](path)
        channels: dict[int, int] = {}
        found = Sample([], [])
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
                assert schema is not None
                if channel.id not in channels:
                    channels[channel.id] = len(found.channels)
                    found.channels.append(
                        Channel(
                            channel.topic,
                            channel.message_encoding,
                            schema.name,
                            schema.encoding,
                            schema.data,
                        )
                    )
                found.messages.append(Message(channels[channel.id], message.log_time, message.data))
    return found


def exact(path: Path) -> None:
    """Frames as the recorder writes them, with inputs and an event."""
    with Recorder(path) as recorder:
        for i in range(FRAMES):
            frame = sgstore.Frame(i * 10**8, ego="hero")
            frame.add("hero", "car", i / 3, 0.1, 0.7, length=4.5, width=1.9, height=1.5, steer=0.1)
            frame.add("can", "prop", 9.0 - i, 2.0, 0.2, subkind="barrel")
            if i == 2:
                frame.happened("collision", "hero", "can")
            recorder.frame(frame)


WRITERS: dict[str, Callable[[Path], Any]] = {
    "sgstore": exact,
    "osi": osi,
    "osi views": osi_views,
    "foxglove protobuf": lambda path: foxglove(path, "protobuf"),
    "foxglove json": lambda path: foxglove(path, "json"),
    "carla": lambda path: carla_recordings.drive(path, FRAMES, everything=True),
    "autoware": lambda path: autoware_recordings.drive(path, FRAMES),
    "commonroad": commonroad,
    "sumo": lambda path: sumo_recordings.as_mcap(path, sumo_recordings.drive(FRAMES)),
    "av2": lambda path: av2_logs.as_mcap(path, av2_logs.drive(path.with_suffix(".d"), FRAMES)),
    "py123d": lambda path: py123d_logs.as_mcap(
        path, py123d_logs.drive(path.with_suffix(".d"), FRAMES)
    ),
    "carla_recorder": lambda path: recorder_logs.as_mcap(
        path, recorder_logs.drive(path.with_suffix(".log"), FRAMES)
    ),
    "topics": lambda path: topic_recording(path, FRAMES),
}
FOLDERS: dict[str, Callable[[Path, int], Path]] = {
    ".av2": av2_logs.drive,
    ".123d": py123d_logs.drive,
}
"""Recordings that are folders: their files are hurt."""
BAGS: dict[str, Callable[[Path, Path], Path]] = {
    ".db3": rosbag_files.as_db3,
    ".bag": rosbag_files.as_ros1,
}
"""Containers of ROS messages."""
FLAVOURS = [*WRITERS, *FOLDERS, *BAGS, ".osi", ".osi.zst", ".xml", ".log"]
"""Flavours of recordings."""
KINDS = [*FLAVOURS, *fuzz_texts.LAWS]
"""All that is hurt."""


# Mutations of messages ------------------------------------------------------------------------------------

ODD_DOUBLES = [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e9, 1e12, 0.0, -0.0, 2.0**63]
ODD_NUMBERS = [
    0,
    1,
    2,
    99,
    127,
    128,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    (1 << 63) - 1,
    (1 << 64) - 1,
]
ODD_VALUES: list[Any] = [
    None, True, -1, 0, 1e400, math.nan, "", "x", "NaN", [], {}, [[]], [None], {"x": []}, 10**30, -(10**400),
    "\ud800", "é" * 50, {"sec": -1, "nsec": 10**12}, [{}] * 50,
]  # fmt: skip


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def fields(data: bytes) -> list[tuple[int, int, bytes]]:
    """Fields of a protobuf message: number, wire type, content; none if it is no message."""
    try:
        found = [(number, wire, data[a:b]) for number, wire, a, b in fields_of(data, 0, len(data))]
    except ValueError:
        return []
    return found if all(number and wire in {0, 1, 2, 5} for number, wire, _ in found) else []


def packed(parts: list[tuple[int, int, bytes]]) -> bytes:
    return b"".join(
        varint(number << 3 | wire) + (varint(len(content)) if wire == 2 else b"") + content
        for number, wire, content in parts
    )


def hurt_protobuf(data: bytes, draw: random.Random) -> bytes:  # noqa: C901, PLR0912  (a case a wound)
    """Hurt one field, at any depth."""
    parts = fields(data)
    if not parts or draw.random() < 0.05:
        return hurt_bytes(data, draw)
    at = draw.randrange(len(parts))
    number, wire, content = parts[at]
    if wire == 2 and content and draw.random() < 0.75:
        parts[at] = number, wire, hurt_protobuf(content, draw)
        return packed(parts)
    match draw.randrange(11):
        case 0:
            del parts[at]
        case 1:
            parts.insert(draw.randrange(len(parts) + 1), parts[at])
        case 2:
            draw.shuffle(parts)
        case 3:
            parts[at] = number, 1, struct.pack("<d", draw.choice(ODD_DOUBLES))
        case 4:
            parts[at] = number, 0, varint(draw.choice(ODD_NUMBERS))
        case 5:
            parts[at] = draw.choice([1, 2, 3, 5, 7, 10, 18, 500, (1 << 29) - 1]), wire, content
        case 6:
            return (
                packed(parts[:at])
                + varint(number << 3 | 2)
                + varint(draw.choice(ODD_NUMBERS))
                + content
            )
        case 7:
            group = (
                varint(number << 3 | 3)
                + content
                + (varint(number << 3 | 4) if draw.random() < 0.7 else b"")
            )
            return packed(parts[:at]) + group + packed(parts[at:])
        case 8:
            nested = content
            for _ in range(draw.choice([3, 60, 150])):
                nested = varint(number << 3 | 2) + varint(len(nested)) + nested
            parts[at] = number, 2, nested
        case 9:
            parts[at : at + 1] = [parts[at]] * draw.choice([3, 40, 400])
        case _:
            parts[at] = (
                number,
                draw.choice([0, 1, 2, 5]),
                draw.randbytes(draw.choice([0, 1, 4, 8, 9, 30])),
            )
    return packed(parts)


def hurt_json(data: bytes, draw: random.Random) -> bytes:
    try:
        told = json.loads(data)
    except (ValueError, RecursionError):
        return hurt_bytes(data, draw)
    if draw.random() < 0.1:
        return draw.choice(
            [data[: draw.randrange(len(data) + 1)], b"[" * 5000, data * 2, b"\xff" + data]
        )

    def walk(value: Any) -> Any:
        if isinstance(value, dict) and value and draw.random() < 0.8:
            key = draw.choice(sorted(value))
            if draw.random() < 0.1:
                return {k: v for k, v in value.items() if k != key}
            return value | {key: walk(value[key])}
        if isinstance(value, list) and value and draw.random() < 0.8:
            at = draw.randrange(len(value))
            return [
                *value[:at],
                walk(value[at]),
                *value[at + 1 :],
                *([value[at]] * draw.choice([0, 0, 1, 60])),
            ]
        return draw.choice(ODD_VALUES)

    return json.dumps(walk(told), default=str).encode("utf-8", "surrogatepass")


def hurt_cdr(data: bytes, draw: random.Random) -> bytes:
    out = bytearray(data)
    if len(out) < 8:
        return hurt_bytes(data, draw)
    at = draw.randrange(4, len(out))
    match draw.randrange(5):
        case 0:
            at -= at % 4
            out[at : at + 4] = struct.pack("<I", draw.choice(ODD_NUMBERS) & 0xFFFFFFFF)
        case 1:
            at -= (at - 4) % 8
            out[at : at + 8] = struct.pack("<d", draw.choice(ODD_DOUBLES))
        case 2:
            out[:4] = draw.randbytes(4)
        case 3:
            del out[at : at + draw.choice([1, 4, 8, 100])]
        case _:
            return hurt_bytes(data, draw)
    return bytes(out)


ODD_TYPES = [b"int8", b"float64", b"string", b"wstring", b"bool", b"string<=3", b"Object", b"Time"]
ODD_SIZES = [b"", b"[]", b"[<=0]", b"[<=1]", b"[1]", b"[3]", b"[0]", b"[1000000]", b"[99999999999]"]


def hurt_ros2msg(definition: bytes, draw: random.Random) -> bytes:
    """Another definition for messages that stay as they are."""
    lines = definition.split(b"\n")
    at, other = draw.randrange(len(lines)), draw.randrange(len(lines))
    match draw.randrange(7):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[other])
        case 2:
            lines[at] = re.sub(rb"^\S+", lambda _: draw.choice(ODD_TYPES), lines[at])
        case 3:
            lines[at] = re.sub(rb"(\[\S*\])?\s", draw.choice(ODD_SIZES) + b" ", lines[at], count=1)
        case 4:
            lines[at], lines[other] = lines[other], lines[at]
        case 5:
            lines[at] = hurt_bytes(lines[at], draw)
        case _:
            del lines[at:]
    return b"\n".join(lines)


def hurt_bytes(data: bytes, draw: random.Random) -> bytes:
    out = bytearray(data)
    at = draw.randrange(len(out) + 1)
    match draw.randrange(4):
        case 0:
            out = out[:at]
        case 1 if out:
            out[at % len(out)] ^= draw.randrange(1, 256)
        case 2:
            out[at:at] = draw.randbytes(draw.choice([1, 2, 8, 64]))
        case _:
            out[at : at + 16] = bytes(16)
    return bytes(out)


ODD_WORDS = [
    b"",
    b"nan",
    b"inf",
    b"-1",
    b"1e308",
    b"1e-308",
    b"9999999999",
    b"0",
    b"2",
    b"x",
    b"<x/>",
]
ELEMENT = re.compile(rb"<(\w+)[^<>]*>[^<>]*</\1>")
"""An element without others in it."""


def hurt_xml(data: bytes, draw: random.Random) -> bytes:
    """Hurt a text, an attribute or an element."""
    found = [*ELEMENT.finditer(data)]
    if not found or draw.random() < 0.1:
        return hurt_bytes(data, draw)
    one, other = draw.choice(found), draw.choice(found)
    match draw.randrange(6):
        case 0 | 1:
            word = draw.choice(ODD_WORDS)
            new = re.sub(rb">[^<>]*<", lambda _: b">" + word + b"<", one[0])
        case 2:
            new = other[0]
        case 3:
            new = one[0] * draw.choice([0, 2, 40])
        case 4:
            new = one[0].replace(one[1], draw.choice([other[1], b"y", b"point", b"circle"]))
        case _:
            at = draw.choice([*re.finditer(rb'="[^"]*"', data)])
            word = b'="' + draw.choice(ODD_WORDS[:-1]) + b'"'
            return data[: at.start()] + word + data[at.end() :]
    return data[: one.start()] + new + data[one.end() :]


HURT_DEFINITION = {"protobuf": hurt_protobuf, "ros2msg": hurt_ros2msg}
HURT = {"protobuf": hurt_protobuf, "json": hurt_json, "cdr": hurt_cdr, "xml": hurt_xml}


# Mutations of recordings ----------------------------------------------------------------------------------


def mutate(whole: Sample, draw: random.Random) -> Sample:  # noqa: C901, PLR0912  (a case a wound)
    """One mutation."""
    messages, channels = [replace(m) for m in whole.messages], [replace(c) for c in whole.channels]
    at = draw.randrange(len(messages)) if messages else 0
    kind = draw.choices(
        ["message", "definition", "channel", "time", "order", "twice", "gone"],
        [60, 10, 4, 8, 5, 5, 3],
    )[0]
    if not messages or (kind in {"definition", "channel"} and whole.ending != ".mcap"):
        kind = "message" if messages else "none"
    match kind:
        case "message":
            message = messages[at]
            hurt = HURT.get(channels[message.channel].encoding, hurt_bytes)
            message.data = hurt(message.data, draw)
        case "definition":
            channel = draw.choice(channels)
            hurt = HURT_DEFINITION.get(channel.schema_encoding, hurt_bytes)
            channel.definition = hurt(channel.definition, draw)
        case "channel":
            channel, other = draw.choice(channels), draw.choice(channels)
            match draw.randrange(4):
                case 0:
                    channel.schema = other.schema
                case 1:
                    channel.encoding = draw.choice(["protobuf", "json", "cdr", "", "x"])
                case 2:
                    channel.schema_encoding = draw.choice(
                        ["protobuf", "ros2msg", "jsonschema", "", "x"]
                    )
                case _:
                    channel.definition = other.definition
        case "time":
            messages[at].time = draw.choice(
                [0, 1, (1 << 63) - 1, (1 << 64) - 1, messages[-1].time + 10**18]
            )
        case "order":
            draw.shuffle(messages)
        case "twice":
            messages[at:at] = [replace(messages[at]) for _ in range(draw.choice([1, 2, 30]))]
        case "gone":
            del messages[at : at + draw.choice([1, 5])]
        case _:
            pass
    return Sample(channels, messages, whole.ending)


def write(hurt: Sample, path: Path, draw: random.Random) -> None:
    """The file of a recording, which may be hurt itself."""
    if hurt.ending in FOLDERS:
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir()
        for message in hurt.messages:
            file = path / hurt.channels[message.channel].topic
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(message.data)
        return
    if hurt.ending == ".mcap":
        with path.open("wb") as stream:
            writer = Writer(
                stream,
                chunk_size=draw.choice([300, 2000, 1 << 20]),
                compression=draw.choice(
                    [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4]
                ),
                use_chunking=draw.random() < 0.85,
                enable_crcs=draw.random() < 0.6,
                use_statistics=draw.random() < 0.8,
                repeat_schemas=draw.random() < 0.8,
                repeat_channels=draw.random() < 0.8,
            )
            writer.start("", "fuzz")
            ids: list[int] = []
            for channel in hurt.channels:
                schema = writer.register_schema(
                    channel.schema, channel.schema_encoding, channel.definition
                )
                ids.append(writer.register_channel(channel.topic, channel.encoding, schema))
            for message in hurt.messages:
                at = min(message.time, (1 << 64) - 1)
                writer.add_message(ids[message.channel], at, message.data, at)
            writer.finish()
    else:
        heads = hurt.ending.startswith(".osi")
        content = b"".join(
            (struct.pack("<I", len(m.data)) if heads else b"") + m.data for m in hurt.messages
        )
        if hurt.ending == ".osi.zst":
            cut = draw.choice([500, 1 << 20])
            compress = zstandard.ZstdCompressor(write_checksum=draw.random() < 0.5).compress
            content = b"".join(compress(content[i : i + cut]) for i in range(0, len(content), cut))
        path.write_bytes(content)
    if draw.random() < 0.3:
        content = path.read_bytes()
        for _ in range(draw.choice([1, 1, 3])):
            content = hurt_bytes(content, draw)
        path.write_bytes(content)


def case(flavour: str, seed: int, path: Path) -> None:
    """Write the case of a seed."""
    draw = random.Random(f"{flavour} {seed}")
    hurt = sample(flavour)
    for _ in range(draw.choice([1, 1, 1, 2, 4])):
        hurt = mutate(hurt, draw)
    write(hurt, path, draw)


# The law --------------------------------------------------------------------------------------------------


def check(path: Path) -> str:
    """Read a recording; how it ended. Fails if it ends in anything but a result that is whole or an error."""
    start = time.process_time()
    try:
        with open_trace(path) as trace:
            ending = read_whole(trace)
    except TraceError as error:
        ending = "error" if error.reason else "an error without words"
    assert ending in {"whole", "loss", "error"}, ending
    cost = time.process_time() - start
    assert cost < SECONDS, f"took {cost:.1f} s"
    left = [one.name for one in threading.enumerate() if one.name.startswith("sgstore-chunks")]
    assert not left, left
    return ending


def whole_way(path: Path) -> None:
    """Bring a recording into a store: what is in the store then is whole, and can be asked."""
    place = path.with_name("whole.sgstore")
    for left in path.parent.glob("whole.sgstore*"):
        left.unlink()
    (outcome,) = ingest(place, [path])
    assert outcome.error is None or str(outcome.error)
    assert (outcome.error is None) == place.exists(), "a store without a trace, or none with one"
    if outcome.error is None:
        store = sgstore.open(place)
        found = store.file.verify()
        assert found.faults == [], found.faults
        (trace,) = store.info()
        assert trace.frames == outcome.frames
        for _ in store.find(fuzz_texts.QUERIES[0]):
            pass
    beside = [one.name for one in path.parent.glob("whole.sgstore?*")]
    assert beside == [], beside


def read_topics(path: Path) -> None:
    """Read all topics of a recording as columns: each has as many messages as it says, or an error."""
    folder = path.with_name("columns")
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(TraceError):
        for name in topics_in(path):
            clock = FrameClock(*np.zeros((3, 1), np.int64))
            try:
                file = converted(path, name, folder, clock)
            except (TopicError, TraceError):
                continue
            asked = StoreFile.recording_sql(path, f"SELECT * FROM topic({literal(name)})")
            assert len(asked.rows().values) == file.messages


def read_whole(trace: Any) -> str:
    frames = known = 0
    for block in trace.blocks(4):
        assert block.entities.first == known, "entities do not follow one another"
        known += len(block.entities)
        assert block.seq.tolist() == list(range(frames, frames + len(block)))
        frames += len(block)
        states = block.states
        assert len(states) == 0 or (states.node.min() >= 0 and states.node.max() < known)
        for name in ("x", "y", "z", "heading", "vx", "ax", "length", "steer"):
            assert not np.isinf(getattr(states, name)).any(), f"{name} is infinite"
        for first, last in zip(block.offsets, block.offsets[1:], strict=False):
            nodes = states.node[first:last]
            assert len(np.unique(nodes)) == len(nodes), "a node comes twice in a frame"
        assert (block.ego < known).all()
        assert np.isfinite(block.scenery.x).all()
        assert len(States.take(states, np.zeros(0, np.intp))) == 0
        assert (block.messages.channel < len(trace.info.channels)).all()
    assert trace.report.frames == frames
    if trace.report.losses:
        assert all(loss.reason for loss in trace.report.losses)
        return "loss"
    return "whole"


def run(flavours: list[str], runs: int, seed: int, keep: Path) -> dict[str, dict[str, int]]:
    """Try cases of each flavour; a file that fails is kept."""
    endings: dict[str, dict[str, int]] = {}
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        for flavour in flavours:
            counts = endings.setdefault(flavour, {})
            path = Path(folder) / f"case{ending_of(flavour)}"
            bar = peak() + MEGABYTES
            for number in range(seed, seed + runs):
                try:
                    ending = one_case(flavour, number, path)
                    assert peak() < bar, f"memory: {peak()} MB, {bar} are too much"
                except Exception:  # noqa: BLE001  (whatever it is, it is what was sought)
                    ending, bar = "FAILED", max(bar, peak() + MEGABYTES)
                    keep.mkdir(parents=True, exist_ok=True)
                    kept = keep / f"{flavour.replace(' ', '_').strip('.')}_{number}{path.name[4:]}"
                    shutil.copytree(path, kept) if path.is_dir() else shutil.copy(path, kept)
                    print(f"{flavour}, seed {number}: kept as {kept}", file=sys.stderr)
                    traceback.print_exc()
                counts[ending] = counts.get(ending, 0) + 1
    return endings


def peak() -> int:
    """Most memory that the process has had; MB."""
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size >> (20 if sys.platform == "darwin" else 10)


def ending_of(kind: str) -> str:
    """The ending of the name of a case's file."""
    law = fuzz_texts.LAWS.get(kind)
    return sample(kind).ending if law is None else law.ending


def share_of(kind: str) -> float:
    """How many cases of a kind there are for each of another."""
    law = fuzz_texts.LAWS.get(kind)
    return 1.0 if law is None else law.share


def one_case(kind: str, number: int, path: Path) -> str:
    """Make a case and look at it; how it ended."""
    if kind in fuzz_texts.LAWS:
        return fuzz_texts.look(kind, number, path)
    case(kind, number, path)
    with mock.patch.object(mcap_file, "SMALL", number % 2 * mcap_file.SMALL):
        ending = check(path)
        if kind == "topics" or number % WHOLE_WAY == 1:
            read_topics(path)
        if number % WHOLE_WAY == 0:
            whole_way(path)
    return ending


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("flavours", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--runs", type=int, default=100_000, help="cases in all")
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), metavar="FOLDER")
    options = parser.parse_args()
    flavours = options.flavours or KINDS
    start, failed = time.monotonic(), 0
    for flavour in flavours:
        runs = math.ceil(options.runs * share_of(flavour) / sum(map(share_of, flavours)))
        counts = run([flavour], runs, options.seed, options.keep)[flavour]
        told = ", ".join(f"{count} {ending}" for ending, count in sorted(counts.items()))
        print(f"{flavour:20} {told}", flush=True)
        failed += counts.get("FAILED", 0)
    print(f"{time.monotonic() - start:.0f} s, at most {peak()} MB")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
