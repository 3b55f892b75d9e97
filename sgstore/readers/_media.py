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
from sgstore.readers.osi._schema import DECODE_ERRORS, SENSOR_VIEW, message_class

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.mcap import Messages, Recording


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

_UNIT: Final = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
"""A start code of annex B and the first byte of the unit behind it; no unit has one inside."""


@dataclass(frozen=True, slots=True)
class Media:
    """Content that a message carries.

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


def read_carried(path: Path, *, channel: int, chunk_offset: int, offset: int, length: int) -> Media:
    """Content of one message of a recording, by its channel's id and its place.

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


# What is in a message -------------------------------------------------------------------------------------


def picture_form(data: bytes) -> str:
    """Format of a picture by how its file begins; empty if it is none that is known."""
    return next((name for name, start in _PICTURES.items() if re.match(start, data, re.DOTALL)), "")


def record_reader(
    channel: Channel, schema: Schema | None
) -> Callable[[bytes], Mapping[str, Any] | None]:
    """A function that reads a message of a channel as a record of its fields.

    Its field ``data`` has bytes, or an array of them; ``None`` where there is no such field. A sensor view of
    OSI has the picture of its first camera as ``data``, the content of a file whose ``format`` is empty.

    It raises ``TraceError`` where a message is malformed.
    """
    encoding = channel.message_encoding
    try:
        if encoding == "cdr" and schema and schema.encoding == "ros2msg":
            kind = parse_definition(schema.name, schema.data)
            return lambda message: decode(kind, message)
        if encoding == "protobuf" and schema:
            view = schema.name == SENSOR_VIEW
            made = message_class(schema, _CAMERA_FIELDS if view else None)
            return partial(_of_sensor_view if view else _of_protobuf, made)
    except TraceError:  # a schema that cannot be read: nothing is known of its messages
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
    """A function that gives the data in messages of a channel, and what they call its format; empty: none."""
    if channel not in recording.channels:
        for _ in recording.walk(Findings()):  # no summary: channels come with their messages
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
            record = {}  # another kind of message
        data, form = record.get("data"), record.get("format", record.get("encoding"))
        if isinstance(data, np.ndarray) and data.dtype.itemsize == 1:
            data = data.tobytes()
        if isinstance(data, bytes) and isinstance(form, str):
            return data, form
        return b"", ""

    return unwrap


# Pictures of OSI's sensor views are bare pixels; how many, of what and in which order a configuration says.
# What a PNG can hold without loss (grey and red-green-blue, of 8 and 16 bits) becomes one; of any other the
# message is all there is.
#
# Source: open-simulation-interface 3.8.0 (osi_sensorview.proto, osi_sensorviewconfiguration.proto).

_CAMERA_FIELDS: Final[dict[str, Any]] = {
    "camera_sensor_view": {
        "view_configuration": dict.fromkeys(
            (
                "number_of_pixels_horizontal",
                "number_of_pixels_vertical",
                "channel_format",
                "pixel_order",
            )
        ),
        "image_data": None,
    }
}
_PIXELS: Final = {
    "CHANNEL_FORMAT_MONO_U8_LIN": (1, "u1"),
    "CHANNEL_FORMAT_MONO_U16_LIN": (1, "<u2"),
    "CHANNEL_FORMAT_RGB_U8_LIN": (3, "u1"),
    "CHANNEL_FORMAT_RGB_U16_LIN": (3, "<u2"),
}
"""Formats of channels → how many there are, and the type of their numbers."""
_RIGHT_TO_LEFT, _BOTTOM_TO_TOP = 2, 3
MAX_SIDE: Final = 1 << 16
"""Most pixels of a picture from side to side; more than any camera has."""


def _of_sensor_view(made: type[Any], message: bytes) -> Mapping[str, Any] | None:
    """The picture of the first camera that has one, as a file."""
    try:
        cameras = getattr(made.FromString(message), "camera_sensor_view", ())
        seen = next((camera for camera in cameras if camera.image_data), None)
        data = b"" if seen is None else _camera_picture(seen)
    except DECODE_ERRORS:
        return None
    return {"data": data, "format": ""} if data else None


def _camera_picture(camera: Any) -> bytes:
    """The picture of a ``CameraSensorView``: a file in the place of pixels, or the one that they make."""
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
"""Numbers of a pixel → the colour type: grey, grey and alpha, red green blue, these and alpha."""


def png(pixels: NDArray[Any]) -> bytes:
    """A picture as a PNG file.

    Each row is written as its difference to the one above (filter 2), which costs little and makes most
    pictures a third smaller.

    Parameters
    ----------
    pixels : (height, width) or (height, width, 1 … 4), uint8 or uint16
        Grey; grey and alpha; red, green, blue; these and alpha.

    Raises
    ------
    ExportError
        They are no picture of that kind, or it is empty.
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


# The messages of a channel before one of them in time. Chunks that end later are read first: where messages are
# in order, these are the chunk of the message and those just before it.

_Row = tuple[int, int, int, "Callable[[], bytes]"]
"""Log time; place of the chunk, outside chunks of the message; offset; data. The first three give the order."""


@dataclass(frozen=True, slots=True)
class _FilmSource:
    """A chunk of a file with messages of a channel, or all messages outside chunks.

    ``base``: where the file begins in its bag. ``chunk``: byte offset, -1 outside chunks. ``end_ns``: latest
    log time of the messages.
    """

    path: Path
    base: int
    channel: int
    chunk: int
    end_ns: int

    def rows(self) -> list[_Row]:
        """The messages of the channel."""
        if self.chunk < 0:
            return _outside_chunks(self.path, self.channel, self.base)
        with open_regular(self.path) as file:
            records = read_records(file, read_chunk_head(file, self.chunk))
        messages, _ = parse_records(records, self.chunk)
        return [
            (
                int(messages.log_time_ns[row]),
                self.base + self.chunk,
                int(messages.offset[row]),
                partial(_copied, messages, row),
            )
            for row in np.flatnonzero(messages.channel == self.channel).tolist()
        ]


def _before(path: Path, channel: int, chunk_offset: int, offset: int) -> Iterator[bytes]:
    """The messages of a channel before one of them in time, the latest first."""
    chunked = chunk_offset >= 0
    at = chunk_offset if chunked else offset
    parts = [*_parts(path, channel)]
    own, base, number = next(one for one in reversed(parts) if one[1] <= at)
    rows = _FilmSource(own, base, number, chunk_offset - base if chunked else -1, 0).rows()
    wanted = at, offset if chunked else offset - base
    last = next((row[:3] for row in rows if row[1:3] == wanted), None)
    if last is None:
        raise TraceError("the recording has changed", path=path, offset=at)
    sources: list[_FilmSource] = []
    for own, base, number in parts:
        spans = _chunks(own) if chunked else [(-1, 0, last[0])]
        sources += [
            _FilmSource(own, base, number, chunk, min(end, last[0]))
            for chunk, start, end in spans
            if start <= last[0]
        ]
    sources.sort(key=lambda source: (source.end_ns, source.base + source.chunk))
    waiting: list[_Row] = []
    while sources or waiting:
        while sources and (not waiting or waiting[-1][0] <= sources[-1].end_ns):
            waiting += (row for row in sources.pop().rows() if row[:3] < last)
            waiting.sort(key=itemgetter(0, 1, 2))
        if waiting:
            yield waiting.pop()[3]()


def _copied(messages: Messages, row: int) -> bytes:
    return bytes(messages.data(row))


def _parts(path: Path, channel: int) -> Iterator[tuple[Path, int, int]]:
    """The files of a recording, where each begins, and the id of a channel of the recording in it."""
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
    """Byte offset, first and last log time of the chunks of a file."""
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
