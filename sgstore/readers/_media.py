"""Pictures and video frames in sensor messages.

Messages contain pictures in a field ``data``, with another field for the format:
``sensor_msgs/CompressedImage``, ``foxglove.CompressedImage``, ``foxglove.CompressedVideo`` and similar types.
They are read by the schema in the file, for any type name. All other messages are returned unchanged.

A frame of H.264 or H.265 cannot be decoded alone. It needs the key frame before it, the frames between, and the
parameter sets, which are usually stored with the key frame. The types of the NAL units distinguish them without
a decoder.

Source: ITU-T H.264 (08/2021), table 7-1 and annex B; ITU-T H.265 (08/2021), table 7-1 and annex B; Foxglove
schema ``CompressedVideo``.
"""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, TraceError
from sgstore.mcap import (
    Findings,
    McapFile,
    bag_folder,
    messages_at,
    open_regular,
    parse_records,
    parts_of,
    read_chunk_head,
    read_records,
    read_summary,
)
from sgstore.readers._registry import open_recording, read_message
from sgstore.readers._ros2 import decode, parse_definition
from sgstore.readers.osi._schema import DECODE_ERRORS, SENSOR_VIEW, fields_read, message_class

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.mcap import Messages, Recording


MAX_RUN: Final = 10_000
"""Largest number of messages that are searched for a key frame: minutes of video."""
MAX_RUN_BYTES: Final = 256 << 20
"""Largest size of the video data from a key frame on; bytes."""

_PICTURES: Final = {
    "jpeg": rb"\xff\xd8\xff",
    "png": rb"\x89PNG\r\n\x1a\n",
    "webp": rb"RIFF....WEBP",
    "tiff": rb"II\*\x00|MM\x00\*",
    "bmp": rb"BM",
}
"""First bytes of picture files → format."""


@dataclass(frozen=True, slots=True)
class _Codec:
    """Video codec (such as H.264) and the meaning of its NAL unit types."""

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
"""Codecs with key frames (IDR of H.264; BLA, IDR, CRA of H.265) and parameter sets (SPS and PPS; and VPS)."""

_UNIT: Final = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
"""Regular expression: start code (annex B) and first byte of a unit. Start codes never occur inside units."""


@dataclass(frozen=True, slots=True)
class Media:
    """Picture, video frame or raw bytes of a sensor message, and the format.

    Attributes
    ----------
    form : str
        ``jpeg``, ``png``, ``webp``, ``tiff``, ``bmp``: a picture file; ``h264``, ``h265``: a video in the
        format of annex B, which ends with the picture of the message; ``message``: the unchanged message.
    data : bytes
    messages : int
        Number of messages in the content. For a video: the messages from the key frame on.
    """

    form: str
    data: bytes
    messages: int = 1


def read_carried(path: Path, *, channel: int, chunk_offset: int, offset: int, length: int) -> Media:
    """Return the picture or video in one message, from its channel id and file position.

    Raises
    ------
    TraceError
        As :func:`~sgstore.mcap._fetch.message_at`; or a video frame cannot be decoded, because the recording
        lacks an earlier key frame or parameter sets, or is damaged between.
    """
    message = read_message(path, chunk_offset=chunk_offset, offset=offset, length=length)
    with open_recording(path) as recording:
        unwrap = _unwrapping(recording, channel)
    data, form = unwrap(message)
    picture = picture_form(data)
    if picture:
        return Media(picture, data)
    codec = next((codec for codec in _CODECS if codec.named.search(form.lower())), None)
    if codec is None or not data:
        return Media("message", message)
    before = map(unwrap, _before(path, channel, chunk_offset, offset))
    try:
        run, sets = _decodable(codec, data, before)
    except TraceError as error:
        raise TraceError(error.reason, path=path, offset=max(chunk_offset, 0)) from error
    return Media(codec.name, b"".join([*sets, *run]), len(run))


def picture_form(data: bytes) -> str:
    """Return the format of a picture file (such as PNG) from its first bytes; empty if unknown."""
    return next((name for name, start in _PICTURES.items() if re.match(start, data, re.DOTALL)), "")


def record_reader(
    channel: Channel, schema: Schema | None
) -> Callable[[bytes], Mapping[str, Any] | None]:
    """Return a function that decodes a channel's message into a record of its fields.

    The field ``data`` contains bytes or an array of them; the function returns ``None`` without such a field.
    For an OSI sensor view, ``data`` is the picture file of its first camera, with an empty ``format``.

    The function raises ``TraceError`` for a malformed message.
    """
    encoding = channel.message_encoding
    try:
        if encoding == "cdr" and schema and schema.encoding == "ros2msg":
            kind = parse_definition(schema.name, schema.data)
            return lambda message: decode(kind, message)
        if encoding == "protobuf" and schema:
            view = schema.name == SENSOR_VIEW
            made = message_class(schema, fields_read()["cameras"] if view else None)
            return partial(_of_sensor_view if view else _of_protobuf, made)
    except TraceError:  # The schema is unreadable, so its messages are unknown.
        return lambda _message: None
    return _of_json if encoding == "json" else lambda _message: None


def _of_protobuf(made: type[Any], message: bytes) -> Mapping[str, Any] | None:
    names = {field.name for field in made.DESCRIPTOR.fields}
    if "data" not in names:
        return None
    try:
        parsed = made.FromString(message)
        found = {name: getattr(parsed, name) for name in names}
    except DECODE_ERRORS as error:
        raise TraceError(f"malformed message: {error}") from error
    if "fields" in found:
        found["fields"] = [
            {name: getattr(one, name, None) for name in ("name", "offset", "type")}
            for one in found["fields"]
        ]
    return found


def _of_json(message: bytes) -> Mapping[str, Any] | None:
    try:
        found = json.loads(message)
        if not isinstance(found, dict) or not isinstance(found.get("data"), str):
            return None
        return found | {"data": base64.b64decode(found["data"], validate=True)}
    except (ValueError, RecursionError):
        return None


def _unwrapping(recording: Recording, channel: int) -> Callable[[bytes], tuple[bytes, str]]:
    """Return a function that returns picture data and format of a message; empty without a picture."""
    if channel not in recording.channels:
        # Without a summary, channels are known only after a walk.
        for _ in recording.walk(Findings()):
            if channel in recording.channels:
                break
    about = recording.channels.get(channel)
    if about is None:
        return lambda _message: (b"", "")
    read = record_reader(about, recording.schemas.get(about.schema_id))

    def unwrap(message: bytes) -> tuple[bytes, str]:
        try:
            record = read(message) or {}
        except TraceError:
            if about.message_encoding == "cdr":
                raise
            record = {}  # A message of another type.
        data, form = record.get("data"), record.get("format", record.get("encoding"))
        if isinstance(data, np.ndarray) and data.dtype.itemsize == 1:
            data = data.tobytes()
        if isinstance(data, bytes) and isinstance(form, str):
            return data, form
        return b"", ""

    return unwrap


# Pictures in OSI sensor views are raw pixels. A configuration contains their number, type and order. Formats
# that PNG can store without loss (grey and RGB, 8 and 16 bits) are converted to PNG. For others, the message is
# returned unchanged.
#
# Source: open-simulation-interface 3.8.0 (osi_sensorview.proto, osi_sensorviewconfiguration.proto).

_PIXELS: Final = {
    "CHANNEL_FORMAT_MONO_U8_LIN": (1, "u1"),
    "CHANNEL_FORMAT_MONO_U16_LIN": (1, "<u2"),
    "CHANNEL_FORMAT_RGB_U8_LIN": (3, "u1"),
    "CHANNEL_FORMAT_RGB_U16_LIN": (3, "<u2"),
}
"""Pixel format of OSI → numbers per pixel, and type of the numbers."""
_RIGHT_TO_LEFT, _BOTTOM_TO_TOP = 2, 3
MAX_SIDE: Final = 1 << 16
"""Largest width or height of a picture; pixels. No camera exceeds it."""


def _of_sensor_view(made: type[Any], message: bytes) -> Mapping[str, Any] | None:
    """Return picture data and format of the first camera with a picture in an OSI message."""
    try:
        cameras = getattr(made.FromString(message), "camera_sensor_view", ())
        seen = next((camera for camera in cameras if camera.image_data), None)
        data = b"" if seen is None else _camera_picture(seen)
    except DECODE_ERRORS:
        return None
    return {"data": data, "format": ""} if data else None


def _camera_picture(camera: Any) -> bytes:
    """Return the picture of an OSI camera message: its embedded file, or a file made of its pixels."""
    data, told = bytes(camera.image_data), camera.view_configuration
    if picture_form(data) in {"jpeg", "png"}:
        return data
    names = told.DESCRIPTOR.fields_by_name["channel_format"].enum_type.values_by_number
    formats = [names[number].name for number in told.channel_format if number in names]
    width, height = told.number_of_pixels_horizontal, told.number_of_pixels_vertical
    if len(formats) != 1 or formats[0] not in _PIXELS:
        return b""
    channels, kind = _PIXELS[formats[0]]
    size = width * height * channels * np.dtype(kind).itemsize
    if size != len(data) or not size or max(width, height) > MAX_SIDE:
        return b""
    pixels = np.frombuffer(data, kind).reshape(height, width, channels)
    if told.pixel_order == _RIGHT_TO_LEFT:
        pixels = pixels[:, ::-1]
    elif told.pixel_order == _BOTTOM_TO_TOP:
        pixels = pixels[::-1]
    return png(pixels)


_COLOURS: Final = {1: 0, 2: 4, 3: 2, 4: 6}
"""Numbers per pixel → PNG colour type: grey, grey and alpha, RGB, RGB and alpha."""


def png(pixels: NDArray[Any]) -> bytes:
    """Encode pixels as the bytes of a PNG file.

    Each row is stored as its difference from the row above (filter 2). This is fast, and most files become a
    third smaller.

    Parameters
    ----------
    pixels : (height, width) or (height, width, 1 … 4), uint8 or uint16
        Grey; grey and alpha; red, green, blue; red, green, blue, alpha.

    Raises
    ------
    ExportError
        The array has another shape or type, or is empty.
    """
    channels = 1 if pixels.ndim == 2 else pixels.shape[-1]
    if pixels.ndim not in {2, 3} or channels not in _COLOURS or not pixels.size:
        raise ExportError(f"no picture: an array of shape {pixels.shape}")
    if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
        raise ExportError(f"no picture: numbers of {pixels.dtype}; expected uint8 or uint16")
    height, width = pixels.shape[:2]
    bytes_of = pixels.dtype.itemsize
    big = np.ascontiguousarray(pixels.astype(f">u{bytes_of}")).view(np.uint8)
    rows = big.reshape(height, -1)
    lines = np.empty((height, rows.shape[1] + 1), np.uint8)
    lines[:, 0] = 2
    lines[0, 1:] = rows[0]
    lines[1:, 1:] = rows[1:] - rows[:-1]
    head = struct.pack(">IIBBBBB", width, height, 8 * bytes_of, _COLOURS[channels], 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))
        for tag, data in parts
    )


def _decodable(
    codec: _Codec, last: bytes, before: Iterator[tuple[bytes, str]]
) -> tuple[list[bytes], list[bytes]]:
    """Return the video frames since the last key frame, with the codec parameters that a decoder needs.

    Parameters
    ----------
    codec : _Codec
    last : bytes
        The requested frame.
    before : iterator of (bytes, str)
        Earlier frames, latest first.
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
    # The order is VPS, SPS, PPS in both codecs.
    return run[::-1], [sets[kind] for kind in sorted(sets)]


def _is_key(codec: _Codec, data: bytes) -> bool:
    return any(codec.type_of(unit[1][0]) in codec.key for unit in _UNIT.finditer(data))


def _parameters(codec: _Codec, data: bytes) -> dict[int, bytes]:
    """Return the codec parameters in a video frame: NAL unit type → bytes with start code."""
    units = list(_UNIT.finditer(data))
    ends = [unit.start() for unit in units[1:]] + [len(data)]
    found: dict[int, bytes] = {}
    for unit, end in zip(units, ends, strict=True):
        kind = codec.type_of(unit[1][0])
        if kind in codec.parameters:
            found[kind] = found.get(kind, b"") + data[unit.start() : end]
    return found


# Search for the earlier messages of a channel. Chunks with later ends are read first. If messages are in order,
# these are the chunk of the message and the chunks directly before it.

_Row = tuple[int, int, int, "Callable[[], bytes]"]
"""Log time; offset of the chunk or message; offset; function for the data. Sorted by the first three."""


def _rows(path: Path, base: int, channel: int, chunk: int) -> list[_Row]:
    """Return time and position of the video messages in a chunk of the file; -1 means outside all chunks.

    ``base`` is the position of the file in its bag.
    """
    if chunk < 0:
        return _outside_chunks(path, channel, base)
    with open_regular(path) as file:
        records = read_records(file, read_chunk_head(file, chunk))
    messages, _ = parse_records(records, chunk)
    columns = messages.log_time_ns.tolist(), messages.offset.tolist()
    return [
        (columns[0][row], base + chunk, columns[1][row], partial(_copied, messages, row))
        for row in np.flatnonzero(messages.channel == channel).tolist()
    ]


def _before(path: Path, channel: int, chunk_offset: int, offset: int) -> Iterator[bytes]:
    """Yield the messages of a video channel that come before a given message, the latest first."""
    chunked = chunk_offset >= 0
    at = chunk_offset if chunked else offset
    parts = [*_parts(path, channel)]
    own, base, number = next(one for one in reversed(parts) if one[1] <= at)
    rows = _rows(own, base, number, chunk_offset - base if chunked else -1)
    wanted = at, offset if chunked else offset - base
    last = next((row[:3] for row in rows if row[1:3] == wanted), None)
    if last is None:
        raise TraceError("the recording has changed", path=path, offset=at)
    sources: list[tuple[int, int, Callable[[], list[_Row]]]] = []
    for own, base, number in parts:
        spans = _chunks(own) if chunked else [(-1, 0, last[0])]
        sources += [
            (min(end, last[0]), base + chunk, partial(_rows, own, base, number, chunk))
            for chunk, start, end in spans
            if start <= last[0]
        ]
    sources.sort(key=itemgetter(0, 1))
    waiting: list[_Row] = []
    while sources or waiting:
        while sources and (not waiting or waiting[-1][0] <= sources[-1][0]):
            _, _, read = sources.pop()
            waiting += (row for row in read() if row[:3] < last)
            waiting.sort(key=itemgetter(0, 1, 2))
        if waiting:
            yield waiting.pop()[3]()


def _copied(messages: Messages, row: int) -> bytes:
    return bytes(messages.data(row))


def _parts(path: Path, channel: int) -> Iterator[tuple[Path, int, int]]:
    """Yield each file of a recording with its start in the recording, and the channel's id in this file."""
    folder = bag_folder(path)
    if folder is None:
        yield path, 0, channel
        return
    with McapFile(folder) as bag:
        topic = bag.channels[channel].topic
    for part in parts_of(folder):
        if part.size >= 0:
            with McapFile(part.path) as file:
                own = [number for number, one in file.channels.items() if one.topic == topic]
            yield from ((part.path, part.base, number) for number in own)


def _chunks(path: Path) -> list[tuple[int, int, int]]:
    """Return byte offset, first log time and last log time of each chunk in an MCAP file."""
    with open_regular(path) as file:
        offsets: list[int] = read_summary(file, file.seek(0, 2)).chunk_offsets.tolist()
    if not offsets:

        def note(start: int) -> bool:
            offsets.append(start)
            return False

        with McapFile(path) as recording:
            for _ in recording.walk(Findings(), note):
                pass
    found: list[tuple[int, int, int]] = []
    with open_regular(path) as file:
        for offset in offsets:
            _, start, end = found[-1] if found else (0, 0, 0)
            with suppress(TraceError):  # the error is raised if the chunk is needed
                head = read_chunk_head(file, offset)
                start, end = head.start_ns, head.end_ns
            found.append((offset, start, end))
    return found


def _outside_chunks(path: Path, channel: int, base: int) -> list[_Row]:
    rows: list[_Row] = []
    with McapFile(path) as recording:
        for run in recording.walk(Findings(), lambda _: False):
            mine = np.flatnonzero(run.channel == channel)
            columns = run.log_time_ns[mine], run.offset[mine], run.length[mine]
            for time, offset, length in zip(*(one.tolist() for one in columns), strict=True):
                rows.append((time, base + offset, offset, partial(_message, path, offset, length)))
    return rows


def _message(path: Path, offset: int, length: int) -> bytes:
    (data,) = messages_at(path, [(-1, offset, length)])
    return bytes(data)
