"""Media in sensor messages: pictures and video.

What a message of a sensor carries: a picture as a file, a frame of a video with all that it needs.

Messages wrap pictures: ``sensor_msgs/CompressedImage``, ``foxglove.CompressedImage``,
``foxglove.CompressedVideo`` and their like have a field ``data`` and one that names its format. They are read
by the schema in the file, whatever their name. All other messages are given as they are.

A frame of H.264 or H.265 cannot be decoded alone: it needs the key frame before it, the frames between, and
the parameter sets, which mostly stand with the key frame. They are told from one another by the types of their
NAL units, so that no decoder is needed.

Source: ITU-T H.264 (08/2021), table 7-1 and annex B; ITU-T H.265 (08/2021), table 7-1 and annex B; Foxglove
schema ``CompressedVideo``.
"""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap import (
    McapFile,
    bag_folder,
    message_at,
    open_regular,
    parse_records,
    parts_of,
    read_chunk_head,
    read_records,
    read_summary,
)
from sgstore.readers._registry import open_recording, read_message
from sgstore.readers._ros2 import decode, parse_definition
from sgstore.readers.osi._camera import camera_of
from sgstore.readers.osi._schema import DECODE_ERRORS, SENSOR_VIEW, message_class
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.mcap import Recording


MAX_RUN: Final = 10_000
"""Most messages that are looked through for a key frame: minutes of video."""
MAX_RUN_BYTES: Final = 256 << 20
"""Most bytes of a run of video."""

_PICTURES: Final = {
    "jpeg": rb"\xff\xd8\xff",
    "png": rb"\x89PNG\r\n\x1a\n",
    "webp": rb"RIFF....WEBP",
    "tiff": rb"II\*\x00|MM\x00\*",
    "bmp": rb"BM",
}
"""How files of pictures begin."""


@dataclass(frozen=True, slots=True)
class _Codec:
    """A way to code video: what its NAL units are, by their types."""

    name: str
    named: re.Pattern[str]
    type_of: Callable[[int], int]
    key: frozenset[int]
    parameters: frozenset[int]


_CODECS: Final = (
    _Codec("h264", re.compile("264|avc"), lambda b: b & 31, frozenset({5}), frozenset({7, 8})),
    _Codec(
        "h265",
        re.compile("265|hevc"),
        lambda b: b >> 1 & 63,
        frozenset(range(16, 24)),
        frozenset({32, 33, 34}),
    ),
)
"""Key frames: IDR of H.264; BLA, IDR and CRA of H.265. Parameter sets: SPS and PPS, and VPS of H.265."""

_END: Final = 1 << 62
"""A place behind all messages of a file."""

_UNIT: Final = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
"""A start code of annex B and the first byte of the unit behind it; no unit has one inside."""


@dataclass(frozen=True, slots=True)
class Media:
    """What a message carries.

    Attributes
    ----------
    form : str
        ``jpeg``, ``png``, ``webp``, ``tiff``, ``bmp``: the file of a picture; ``h264``, ``h265``: a video in
        the format of annex B, whose last picture is that of the message; ``message``: the message as it is.
    data : bytes
    messages : int
        How many messages it was made of: of a video, those from the key frame on.
    """

    form: str
    data: bytes
    messages: int = 1


@dataclass(frozen=True, slots=True)
class _MessagePlace:
    """Where a message stands; as :class:`~sgstore.world.MessageRefs` has it."""

    path: Path
    channel: int
    chunk_offset: int
    offset: int


def read_carried(path: Path, *, channel: int, chunk_offset: int, offset: int, length: int) -> Media:
    """What one message of a recording carries, by its channel's id and its place.

    Raises
    ------
    TraceError
        As :func:`~sgstore.mcap._fetch.message_at`; or it is a frame of a video that cannot be decoded,
        because the recording has no key frame or no parameter sets before it, or is damaged between.
    """
    message = read_message(path, chunk_offset=chunk_offset, offset=offset, length=length)
    with open_recording(path) as recording:
        unwrap = _unwrapping(recording, channel)
    data, form = unwrap(message)
    for name, start in _PICTURES.items():
        if re.match(start, data, re.DOTALL):
            return Media(name, data)
    codec = next((codec for codec in _CODECS if codec.named.search(form.lower())), None)
    if codec is None or not data:
        return Media("message", message)
    places = _places(_MessagePlace(path, channel, chunk_offset, offset))
    before = map(unwrap, chain.from_iterable(map(_before, places)))
    try:
        run, sets = _decodable(codec, data, before)
    except TraceError as error:
        raise TraceError(error.reason, path=path, offset=max(chunk_offset, 0)) from error
    return Media(codec.name, b"".join([*sets, *run]), len(run))


# What is in a message -------------------------------------------------------------------------------------


def _unwrapping(recording: Recording, channel: int) -> Callable[[bytes], tuple[bytes, str]]:
    """A function that gives the data in messages of a channel, and what they call its format; empty: none."""
    if channel not in recording.channels:
        for _ in recording.walk(TraceReport()):  # no summary: channels come with their messages
            if channel in recording.channels:
                break
    record = recording.channels.get(channel)
    schema = recording.schemas.get(record.schema_id) if record else None
    encoding = record.message_encoding if record else ""
    try:
        if encoding == "cdr" and schema and schema.encoding == "ros2msg":
            kind = parse_definition(schema.name, schema.data)
            return lambda message: _of_record(decode(kind, message))
        if encoding == "protobuf" and schema and schema.name == SENSOR_VIEW:
            return camera_of(schema)
        if encoding == "protobuf" and schema:
            made = message_class(schema)
            return lambda message: _of_protobuf(made, message)
    except TraceError:
        pass  # a schema that cannot be read: then its messages are given as they are
    return _of_json if encoding == "json" else lambda _message: (b"", "")


def _of_record(record: dict[str, Any]) -> tuple[bytes, str]:
    data, form = record.get("data"), record.get("format", record.get("encoding"))
    if not isinstance(data, np.ndarray) or data.dtype.itemsize != 1 or not isinstance(form, str):
        return b"", ""
    return data.tobytes(), form


def _of_protobuf(made: type[Any], message: bytes) -> tuple[bytes, str]:
    try:
        parsed = made.FromString(message)
        data, form = parsed.data, parsed.format
    except DECODE_ERRORS:  # another kind of message: it has no such fields
        return b"", ""
    return (data, form) if isinstance(data, bytes) and isinstance(form, str) else (b"", "")


def _of_json(message: bytes) -> tuple[bytes, str]:
    try:
        values = json.loads(message)
        return base64.b64decode(values["data"], validate=True), str(values["format"])
    except (ValueError, TypeError, LookupError, RecursionError):  # another kind of message
        return b"", ""


# Video ----------------------------------------------------------------------------------------------------


def _decodable(
    codec: _Codec, last: bytes, before: Iterator[tuple[bytes, str]]
) -> tuple[list[bytes], list[bytes]]:
    """The frames from the key frame to the last one, and parameter sets that stand before all of them.

    Parameters
    ----------
    codec : _Codec
    last : bytes
        The frame that is wanted.
    before : iterator of (bytes, str)
        Those before it, latest first.
    """
    run, size = [last], len(last)
    while not _is_key(codec, run[-1]):
        frame, _ = next(before, (None, ""))
        if frame is None:
            raise TraceError(f"no key frame ({codec.name}) before it: it cannot be decoded")
        run.append(frame)
        size += len(frame)
        if len(run) > MAX_RUN or size > MAX_RUN_BYTES:
            raise TraceError(f"no key frame ({codec.name}) in {len(run)} messages before it")
    missing = codec.parameters - _parameters(codec, run[-1]).keys()
    sets: dict[int, bytes] = {}
    for frame, _ in islice(before if missing else (), MAX_RUN):
        sets = {k: v for k, v in _parameters(codec, frame).items() if k in missing} | sets
        if len(sets) == len(missing):
            break
    if len(sets) < len(missing):
        kinds = sorted(missing - sets.keys())
        reason = f"no parameter sets ({codec.name}, NAL units of type {kinds}) before its key frame"
        raise TraceError(f"{reason}: it cannot be decoded")
    return run[::-1], [sets[kind] for kind in sorted(sets)]  # VPS, SPS, PPS: in either codec


def _is_key(codec: _Codec, data: bytes) -> bool:
    return any(codec.type_of(unit[1][0]) in codec.key for unit in _UNIT.finditer(data))


def _parameters(codec: _Codec, data: bytes) -> dict[int, bytes]:
    """The parameter sets in the data of a frame, by type, each with its start code."""
    units = list(_UNIT.finditer(data))
    ends = [unit.start() for unit in units[1:]] + [len(data)]
    found: dict[int, bytes] = {}
    for unit, end in zip(units, ends, strict=True):
        kind = codec.type_of(unit[1][0])
        if kind in codec.parameters:
            found[kind] = found.get(kind, b"") + data[unit.start() : end]
    return found


def _places(place: _MessagePlace) -> Iterator[_MessagePlace]:
    """The place of a message in its file; of a bag then the ends of the files before it, the latest first."""
    folder = bag_folder(place.path)
    if folder is None:
        yield place
        return
    chunked = place.chunk_offset >= 0
    at = place.chunk_offset if chunked else place.offset
    with McapFile(folder) as bag:
        wanted = bag.channels[place.channel]
    for part in reversed(parts_of(folder)):
        if part.base > at or part.size < 0:
            continue
        with McapFile(part.path) as file:
            own = [n for n, c in file.channels.items() if c.topic == wanted.topic]
        here = at < part.base + part.size
        offsets = (at - part.base, place.offset) if chunked else (-1, at - part.base)
        if not here:
            offsets = (_END, _END) if chunked else (-1, _END)
        for number in own:
            yield _MessagePlace(part.path, number, *offsets)


def _before(place: _MessagePlace) -> Iterator[bytes]:
    """The messages of a channel before one of them, the latest first, as they stand in the file."""
    if place.chunk_offset < 0:
        yield from _before_outside_chunks(place)
        return
    with open_regular(place.path) as file:
        for start in reversed(_chunks(place)):
            records = read_records(file, read_chunk_head(file, start))
            messages, _ = parse_records(records, start)
            mine = messages.channel == place.channel
            if start == place.chunk_offset:
                mine &= messages.offset < place.offset
            for row in np.flatnonzero(mine)[::-1].tolist():
                yield bytes(messages.data(row))


def _chunks(place: _MessagePlace) -> list[int]:
    """Where the chunks of a file begin, up to that of a message."""
    with open_regular(place.path) as file:
        size = file.seek(0, 2)
        found: list[int] = read_summary(file, size).chunk_offsets.tolist()
    if place.chunk_offset not in found and not (found and place.chunk_offset == _END):

        def note(start: int) -> bool:
            found.append(start)
            return False

        found = []
        with McapFile(place.path) as recording:
            for _ in recording.walk(TraceReport(), note):
                pass
    return [start for start in found if start <= place.chunk_offset]


def _before_outside_chunks(place: _MessagePlace) -> Iterator[bytes]:
    offsets: list[tuple[int, int]] = []
    with McapFile(place.path) as recording:
        for run in recording.walk(TraceReport(), lambda _: False):
            mine = (run.channel == place.channel) & (run.offset < place.offset)
            offsets += zip(run.offset[mine].tolist(), run.length[mine].tolist(), strict=True)
    for offset, length in reversed(offsets):
        yield message_at(place.path, chunk_offset=-1, offset=offset, length=length)
