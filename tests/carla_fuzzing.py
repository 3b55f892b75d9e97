"""Recordings of CARLA's bridge, spoiled where it hurts: in definitions, messages, their order, the file.

``spoiled(seed)`` is always the same file for the same number, so a number is all that a finding needs.
"""

from __future__ import annotations

import random
import re
import struct
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from carla_recordings import COMPRESSIONS, drive
from mcap.reader import make_reader
from mcap.writer import Writer

from sgstore.errors import TraceError
from sgstore.traces import open_trace

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Said:
    """A message, with all that its channel says of it."""

    topic: str
    schema: str
    encodings: tuple[str, str]
    definition: bytes
    time: int
    data: bytes


@cache
def seeds() -> tuple[Said, ...]:
    """The messages of a short drive that has one of everything."""
    with TemporaryDirectory() as folder:
        path = drive(Path(folder) / "a.mcap", frames=4, everything=True)
        with path.open("rb") as stream:
            return tuple(
                Said(
                    channel.topic,
                    schema.name,
                    (schema.encoding, channel.message_encoding),
                    schema.data,
                    message.log_time,
                    message.data,
                )
                for schema, channel, message in make_reader(stream).iter_messages()
                if schema is not None
            )


def spoiled(seed: int) -> bytes:
    """A file that is wrong in one to four ways."""
    dice = random.Random(seed)
    messages = list(seeds())
    whole = True
    for _ in range(dice.randint(1, 4)):
        how = dice.choice([*WAYS, None])
        if how is None:
            whole = False
        else:
            how(dice, messages)
    data = written(dice, messages)
    return data if whole else _bytes(dice, data, 6)


def written(dice: random.Random, messages: list[Said]) -> bytes:
    """The messages as a file, in one of the ways in which recorders write them."""
    stream = BytesIO()
    writer = Writer(
        stream,
        chunk_size=dice.choice([500, 5000, 1 << 20]),
        compression=dice.choice(list(COMPRESSIONS.values())),
        use_chunking=dice.random() < 0.8,
        enable_crcs=dice.random() < 0.5,
        repeat_schemas=dice.random() < 0.8,
        repeat_channels=dice.random() < 0.8,
    )
    writer.start("ros2", "fuzz")
    channels: dict[tuple[str, str, tuple[str, str], bytes], int] = {}
    for said in messages:
        key = (said.topic, said.schema, said.encodings, said.definition)
        if key not in channels:
            number = writer.register_schema(said.schema, said.encodings[0], said.definition)
            channels[key] = writer.register_channel(said.topic, said.encodings[1], number)
        writer.add_message(channels[key], said.time, said.data, said.time)
    writer.finish()
    return stream.getvalue()


# Ways to spoil ------------------------------------------------------------------------------------


def a_definition(dice: random.Random, messages: list[Said]) -> None:
    """Another definition for all messages of a channel, which stay as they are."""
    chosen = dice.choice(messages)
    lines = chosen.definition.split(b"\n")
    at = dice.randrange(len(lines))
    words = [
        b"int8",
        b"float64",
        b"string",
        b"wstring",
        b"bool",
        b"string<=3",
        b"Object",
        b"Header",
    ]
    match dice.randrange(7):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[dice.randrange(len(lines))])
        case 2:
            lines[at] = re.sub(rb"^\S+", lambda _: dice.choice(words), lines[at])
        case 3:
            sizes = [
                b"[]",
                b"[<=0]",
                b"[<=1]",
                b"[1]",
                b"[3]",
                b"[1000000]",
                b"[0]",
                b"[4294967296]",
            ]
            lines[at] = re.sub(rb"(\[\S*\])?\s", dice.choice(sizes) + b" ", lines[at], count=1)
        case 4:
            other = dice.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        case 5:
            lines[at] = _bytes(dice, lines[at], 2)
        case _:
            lines = lines[:at]
    changed = b"\n".join(lines)
    for i, said in enumerate(messages):
        if said.definition == chosen.definition:
            messages[i] = replace(said, definition=changed)


def a_length(dice: random.Random, messages: list[Said]) -> None:
    """Another number where four bytes are aligned as a length is."""
    i, said = _one(dice, messages)
    places = max((len(said.data) - 4) // 4, 1)
    at = 4 + 4 * dice.randrange(places)
    now = int.from_bytes(said.data[at : at + 4], "little")
    number = dice.choice(
        [0, 1, now + 1, max(now, 1) - 1, now * 2, 100_000, (1 << 31) - 1, (1 << 32) - 1, 1 << 28]
    )
    data = said.data[:at] + struct.pack("<I", number & 0xFFFFFFFF) + said.data[at + 4 :]
    messages[i] = replace(said, data=data)


def a_number(dice: random.Random, messages: list[Said]) -> None:
    """A double that is no number, or none on earth."""
    i, said = _one(dice, messages)
    at = 4 * dice.randrange(1, max(len(said.data) // 4, 2))
    number = dice.choice([float("nan"), float("inf"), -float("inf"), 1e308, 5e-324, -0.0, 1e9])
    data = said.data[:at] + struct.pack("<d", number) + said.data[at + 8 :]
    messages[i] = replace(said, data=data)


def some_bytes(dice: random.Random, messages: list[Said]) -> None:
    """A message with other bytes, fewer or more."""
    i, said = _one(dice, messages)
    messages[i] = replace(said, data=_bytes(dice, said.data, 4))


def an_end(dice: random.Random, messages: list[Said]) -> None:
    """A message that is cut, or goes on."""
    i, said = _one(dice, messages)
    data = said.data[: dice.randrange(len(said.data) + 1)]
    messages[i] = replace(said, data=data if dice.random() < 0.8 else said.data * 3)


def a_swap(dice: random.Random, messages: list[Said]) -> None:
    """The data of a message under the name of another."""
    i, said = _one(dice, messages)
    messages[i] = replace(said, data=_one(dice, messages)[1].data)


def the_order(dice: random.Random, messages: list[Said]) -> None:
    """Messages in another order, some twice, some not at all."""
    match dice.randrange(3):
        case 0:
            dice.shuffle(messages)
        case 1:
            messages.insert(0, dice.choice(messages))
        case _:
            kept = [said for said in messages if dice.random() < 0.7]
            messages[:] = kept or messages[:1]


def a_time(dice: random.Random, messages: list[Said]) -> None:
    """Another log time."""
    i, said = _one(dice, messages)
    time = dice.choice([0, 1, said.time + 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
    messages[i] = replace(said, time=time)


def a_name(dice: random.Random, messages: list[Said]) -> None:
    """Another name of a schema, of a topic, of an encoding."""
    chosen = dice.choice(messages)
    names = ["", "a", "/", "//", "derived_object_msgs/msg/ObjectArray", "x.VehicleLights", "\0"]
    name = dice.choice([*names, _one(dice, messages)[1].schema])
    column = dice.choice(["topic", "schema", "encodings"])
    value = (name, chosen.encodings[1]) if column == "encodings" else name
    for i, said in enumerate(messages):
        if said.topic == chosen.topic:
            messages[i] = replace(said, **{column: value})


WAYS: tuple[Callable[[random.Random, list[Said]], None], ...] = (
    a_definition,
    a_length,
    a_length,
    a_number,
    some_bytes,
    an_end,
    a_swap,
    the_order,
    a_time,
    a_name,
)


def _one(dice: random.Random, messages: list[Said]) -> tuple[int, Said]:
    i = dice.randrange(len(messages))
    return i, messages[i]


def _bytes(dice: random.Random, data: bytes, most: int) -> bytes:
    """Some bytes set, put in, taken out, copied, or made a length."""
    result = bytearray(data)
    for _ in range(dice.randint(1, most)):
        at, count = dice.randrange(len(result) + 1), dice.randint(1, 40)
        match dice.randrange(5):
            case 0:
                result[at : at + 1] = bytes([dice.randrange(256)])
            case 1:
                result[at:at] = bytes([dice.randrange(256)]) * count
            case 2:
                del result[at : at + count]
            case 3:
                other = dice.randrange(len(result) + 1)
                result[at : at + count] = result[other : other + count]
            case _:
                number = max((1 << dice.randrange(64)) - dice.randrange(3), 0)
                result[at : at + 8] = struct.pack("<Q", number)
    return bytes(result)


# What is asked of the reader -----------------------------------------------------------------------


def survives(path: Path, data: bytes) -> str:
    """``frames`` or ``error``: how reading these bytes ends; else what is wrong with the end.

    Whatever else than a ``TraceError`` escapes is a bug.
    """
    path.write_bytes(data)
    try:
        with open_trace(path, digest="x") as trace:
            frames = sum(len(block) for block in trace.blocks(3))
            agreed = frames == trace.report.frames > 0
            return "frames" if agreed else f"{frames} frames, reported as {trace.report.frames}"
    except TraceError as error:
        return "error" if str(path) in str(error) else f"an error that names no file: {error}"


def fuzz(folder: Path, first: int, count: int) -> dict[str, int]:
    """Read ``count`` spoiled files, from number ``first`` on; how often reading ended in what.

    What escapes bears a note with the number of its file.
    """
    ends: Counter[str] = Counter()
    for seed in range(first, first + count):
        try:
            ends[survives(folder / "fuzzed.mcap", spoiled(seed))] += 1
        except Exception as error:
            error.add_note(f"carla_fuzzing.spoiled({seed})")
            raise
    return dict(ends)
