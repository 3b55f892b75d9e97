"""Reader of OSI files with one channel (``.osi``, ``.osi.zst``): plain sequences of messages.

A compressed file is decompressed block by block. A zstd block has at most 128 KiB, so memory stays small for
any file. The total decompressed size is limited, too.

Source: zstd compression format (RFC 8878), sections 3.1.1 and 3.1.2.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import zstandard
from mcap.records import Schema

from sgstore.errors import TraceError
from sgstore.mcap import (
    MAX_LOSSES,
    READ_ERRORS,
    RUN_MESSAGES,
    Findings,
    Loss,
    mark_of_open,
    open_regular,
)
from sgstore.readers._file import MessageFile, held_messages
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    GROUND_TRUTH,
    LATEST_NS,
    SENSOR_VIEW,
    TRAFFIC_LIGHT,
    descriptors,
    fields_of,
    lights_of,
    message_class,
    object_class,
    parse,
    part_class,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from sgstore.mcap import Messages


PREFIX: Final = struct.Struct("<I")
"""Size field before each message: the number of bytes that follow."""
MAX_MESSAGE: Final = 64 << 20
"""Maximum size of a message; bytes."""
MAX_RATIO: Final = 2000
"""Maximum compression ratio."""
MAX_WINDOW: Final = 128 << 20
"""Maximum window of a zstd frame (``zstd --long``); bytes."""

ZSTD: Final = b"\x28\xb5\x2f\xfd"
_ALWAYS: Final = 64 << 20
"""Decompressed size that is allowed for every compression ratio; bytes."""
_PIECE: Final = 1 << 20
_FRAME_HEAD: Final = 18
"""Maximum length of the header of a zstd frame; bytes."""
_SKIPPABLE: Final = range(0x184D2A50, 0x184D2A60)
_LITERAL, _REPEATED, _COMPRESSED = 0, 1, 2


def is_compressed(file: BinaryIO) -> bool:
    """Return True if a file starts with the magic number of zstd compression."""
    file.seek(0)
    magic = file.read(4)
    return magic == ZSTD or (len(magic) == 4 and PREFIX.unpack(magic)[0] in _SKIPPABLE)


def pieces(file: BinaryIO, start: int = -1) -> Iterator[tuple[int, bytes]]:
    """Yield the decompressed content of a file in pieces, and the offset of the zstd frame of each.

    Parameters
    ----------
    file : file
    start : int
        Byte offset of the first frame to read; -1: the start of the file.

    Yields
    ------
    place : int
        Byte offset of the zstd frame in the file; -1 for an uncompressed file.
    content : bytes

    Raises
    ------
    TraceError
        The file cannot be decompressed from this point on, or the result is too large.
    """
    if start < 0 and not is_compressed(file):
        file.seek(0)
        while piece := file.read(_PIECE):
            yield -1, piece
        return
    file.seek(max(start, 0))
    total = 0
    while head := file.read(4):
        place = file.tell() - len(head)
        if len(head) == 4 and PREFIX.unpack(head)[0] in _SKIPPABLE:
            length = file.read(4)
            file.seek(PREFIX.unpack(length)[0] if len(length) == 4 else 0, 1)
            continue
        for piece in _frame(file, place):
            total += len(piece)
            if total > max(_ALWAYS, MAX_RATIO * file.tell()):
                reason = f"decompressed to more than {MAX_RATIO} times its size"
                raise TraceError(reason, offset=place)
            yield place, piece


def _frame(file: BinaryIO, place: int) -> Iterator[bytes]:
    """Decompress one zstd frame block by block. A truncated frame yields only its complete blocks."""
    file.seek(place)
    head = file.read(_FRAME_HEAD)
    try:
        parameters = zstandard.get_frame_parameters(head)
        size = zstandard.frame_header_size(head)
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW).decompressobj()
        file.seek(place + size)
        yield decompressor.decompress(head[:size])
        last = False
        while not last:
            block = file.read(3)
            if len(block) < 3:
                return
            bits = int.from_bytes(block, "little")
            last, kind, length = bool(bits & 1), bits >> 1 & 3, bits >> 3
            content = file.read(1 if kind == _REPEATED else length)
            yield decompressor.decompress(block + content)
        if parameters.has_checksum:
            yield decompressor.decompress(file.read(4))
    except READ_ERRORS as error:
        if len(head) < _FRAME_HEAD and not file.read(1):
            return  # The file ends inside the head of a frame.
        raise TraceError(f"cannot be decompressed (zstd): {error}", offset=place) from error


def read_messages(path: Path, places: Iterable[tuple[int, int, int]]) -> Iterator[bytes]:
    """Yield the bytes of messages in an OSI file, given by their positions.

    Parameters
    ----------
    path : Path
    places : iterable of (chunk_offset, offset, length)
        Byte offset of the zstd frame with the start of the message, -1 for an uncompressed file. Byte offset of
        the message's head in the decompressed data from this frame on, or in the file. Bytes of its data.

    Raises
    ------
    TraceError
        The file cannot be opened or decompressed, or the message does not match, because the file was replaced.
    """
    for place in places:
        yield _message_at(path, *place)


def _message_at(path: Path, chunk_offset: int, offset: int, length: int) -> bytes:
    missing = TraceError(
        f"no message of {length} bytes at {offset} there: the file was replaced", path=path
    )
    if not 0 <= length <= MAX_MESSAGE or offset < 0:
        raise missing
    wanted = PREFIX.size + length
    with open_regular(path) as file:
        try:
            if chunk_offset < 0:
                file.seek(offset)
                record = file.read(wanted)
            else:
                record = _cut(pieces(file, chunk_offset), offset, wanted)
        except (TraceError, *READ_ERRORS) as error:
            raise missing from error
    if len(record) != wanted or PREFIX.unpack_from(record)[0] != length:
        raise missing
    return record[PREFIX.size :]


def _cut(content: Iterator[tuple[int, bytes]], offset: int, length: int) -> bytes:
    """Return ``length`` bytes of a file from ``offset`` on. The content is given in pieces."""
    found = bytearray()
    position = 0
    for _, piece in content:
        if position + len(piece) > offset:
            found += piece[max(offset - position, 0) :]
        position += len(piece)
        if len(found) >= length:
            break
    return bytes(found[:length])


# Single-channel OSI files (``.osi``, ``.osi.zst``): a sequence of messages, each after its length. Such a file
# has no channels, schemas or log times. It gets one channel. The type of its messages (ground truth or sensor
# views) is found by decoding the first ones as both. The log time of a message is its own time. An impossible
# length is damage: reading continues at the next message with the same first bytes (the version of OSI), and
# the bytes between are a loss.
#
# Source: open-simulation-interface 3.8.0, trace_file_formats.adoc (single-channel binary trace files).

ENDINGS: Final = (".osi", ".osi.zst")
"""Suffixes of OSI files. The content alone does not identify the format."""
CHANNEL: Final = 1
"""Id of the only channel in such a file."""
RUN_BYTES: Final = 4 << 20
"""Approximate maximum size of a run of messages; bytes."""

_ENOUGH, _TRIED = 8, 1000
"""Numbers of messages that are decoded to find their type: sufficient non-empty ones, and the maximum."""
_VERSION, _TIMESTAMP = 1, 2


class OsiFile(MessageFile):
    """OSI file with one channel that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path, size, mtime_ns
        The file, its size in bytes, its modification time.
    schemas, channels : dict
        The only schema and the only channel, with the topic ``ground_truth`` or ``sensor_view``.
    counts : None
        The number of messages is unknown.

    Raises
    ------
    TraceError
        The file cannot be opened, or its first messages are neither ground truth nor sensor views.
    """

    counts = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._mark = b""
        self._file = open_regular(path)
        try:
            self.size, self.mtime_ns = mark_of_open(self._file)
            name = self._recognise()
        except BaseException:
            self._file.close()
            raise
        topic = "sensor_view" if name == SENSOR_VIEW else "ground_truth"
        schema = Schema(id=CHANNEL, data=descriptors(), encoding="protobuf", name=name)
        self.add_channel(topic, schema, "protobuf")

    def close(self) -> None:
        """Close the OSI file."""
        self._file.close()

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        """Yield all messages of an OSI file in file order.

        Messages are not cached: all are ground truth, which takes longer to decode than to decompress. The
        ``chunk_offset`` of a message is the offset of the zstd frame with its start.
        """
        run = _MessageRun()
        try:
            for place, offset, data in self._messages(report):
                if run.held and run.is_full(place):
                    yield run.messages()
                    run = _MessageRun(run.last_ns)
                if wanted(place):
                    run.add(place, offset, data)
        except OSError as error:
            raise TraceError(f"cannot be read: {error}", path=self.path) from error
        if run.held:
            yield run.messages()

    def _recognise(self) -> str:
        """Return the OSI message type of the file. Also store the first bytes that all messages share."""
        report = Findings()
        likeness = dict.fromkeys((GROUND_TRUTH, SENSOR_VIEW), 0)
        tried = 0
        for _, _, data in islice(self._messages(report), _TRIED):
            tried += 1
            self._mark = self._mark or _beginning(data)
            for name in likeness:
                likeness[name] += _likeness(name, data)
            if tried >= _ENOUGH and max(likeness.values()) > 0:
                break
        best = max(likeness, key=lambda name: likeness[name])
        if likeness[best] > 0:
            return best
        reason = f"its messages are neither {GROUND_TRUTH} nor {SENSOR_VIEW} with content"
        if not tried:
            told = report.losses[0].reason if report.losses else "the file is empty"
            reason = f"not an ASAM OSI message: {told}"
        raise TraceError(reason, path=self.path)

    def _messages(self, report: Findings) -> Iterator[tuple[int, int, bytes]]:
        """Yield messages: offset of the zstd frame, offset within it, and bytes. Report damage as lost."""
        stream = _Stream(self._mark)
        content = pieces(self._file)
        while True:
            try:
                place, piece = next(content)
            except StopIteration:
                break
            except TraceError as error:
                left = self.size - max(error.offset or 0, 0)
                report.losses.append(Loss(error.reason, bytes=left, offset=error.offset or 0))
                break
            stream.append(place, piece)
            yield from stream.take(report, ends=False)
        yield from stream.take(report, ends=True)


@dataclass(slots=True)
class _MessageRun:
    """Consecutive messages of one zstd frame, or of a file without compression."""

    last_ns: int = 0
    place: int = -1
    size: int = 0
    held: dict[int, bytes] = field(default_factory=dict[int, bytes])
    times: list[int] = field(default_factory=list[int])

    def add(self, place: int, offset: int, data: bytes) -> None:
        self.place = place
        self.held[offset] = data
        self.size += len(data)
        time_ns = time_of_bytes(data)
        self.last_ns = self.last_ns if time_ns is None else time_ns
        self.times.append(self.last_ns)

    def is_full(self, place: int) -> bool:
        """Return True if the next message must begin another group of messages."""
        return place != self.place or self.size > RUN_BYTES or len(self.held) >= RUN_MESSAGES

    def messages(self) -> Messages:
        return held_messages(self.held, self.times, channel=CHANNEL, chunk_offset=self.place)


class _Stream:
    """Splitter of the bytes of an OSI file into messages. It continues after damaged parts.

    ``mark`` contains the first bytes common to all messages, if known.
    """

    def __init__(self, mark: bytes) -> None:
        self._mark = mark
        self._buffer = bytearray()
        self._start = 0  # Position of the buffer in the stream.
        self._frames: list[
            tuple[int, int]
        ] = []  # Start of each frame in the stream, and its file offset.

    def append(self, place: int, piece: bytes) -> None:
        """Add the next bytes of the OSI file. They have the offset of their zstd frame."""
        if not self._frames or self._frames[-1][1] != place:
            self._frames.append((self._start + len(self._buffer), place))
        self._buffer += piece

    def take(self, report: Findings, *, ends: bool) -> Iterator[tuple[int, int, bytes]]:
        """Yield the messages that are complete in the bytes added so far.

        ``ends`` is true after the last bytes of the file.
        """
        at = 0
        while (left := len(self._buffer) - at) >= PREFIX.size or (ends and left):
            length = PREFIX.unpack_from(self._buffer, at)[0] if left >= PREFIX.size else 0
            stop = at + PREFIX.size + length
            possible = 0 < length <= MAX_MESSAGE
            if possible and stop <= len(self._buffer) and not self._overruns(at, stop):
                yield *self._place(at), bytes(self._buffer[at + PREFIX.size : stop])
                at = stop
                continue
            if possible and not ends and stop > len(self._buffer):
                break  # The rest of the message has not arrived yet.
            resume = self._resume(at + 1)
            if resume is None and not ends and self._mark:
                # Without a message in the buffer, keep the possible start of one; the rest is lost.
                resume = max(at + 1, len(self._buffer) - PREFIX.size - len(self._mark))
            elif resume is None:
                resume = len(self._buffer)
            _lose(report, self._loss(at, resume, length))
            at = resume
        del self._buffer[:at]
        self._start += at
        while len(self._frames) > 1 and self._frames[1][0] <= self._start:
            del self._frames[0]

    def _overruns(self, at: int, stop: int) -> bool:
        """Return True if a message's length is probably wrong: another message begins inside it."""
        following = self._buffer[stop + PREFIX.size : stop + PREFIX.size + len(self._mark)]
        if self._mark.startswith(following):
            return False
        return self._resume(at + 1, stop) is not None

    def _resume(self, start: int, stop: int | None = None) -> int | None:
        """Return the probable start of the next message after a damaged part; ``None`` if none is found."""
        end = None if stop is None else stop - 1 + PREFIX.size + len(self._mark)
        while self._mark:
            found = self._buffer.find(self._mark, start + PREFIX.size, end)
            if found < 0:
                return None
            start = found - PREFIX.size
            if len(self._mark) <= PREFIX.unpack_from(self._buffer, start)[0] <= MAX_MESSAGE:
                return start
            start += 1
        return None

    def _loss(self, at: int, resume: int, length: int) -> Loss:
        left = resume - at
        cut = resume == len(self._buffer) and (0 < length <= MAX_MESSAGE or left < PREFIX.size)
        reason = (
            f"the file ends inside a message: {left} of {PREFIX.size + length} bytes"
            if cut
            else f"damage: a message of {length} bytes, which cannot be"
        )
        return Loss(reason, 1 if cut else -1, left, offset=self._place(at)[1])

    def _place(self, at: int) -> tuple[int, int]:
        position = self._start + at
        start, place = next(f for f in reversed(self._frames) if f[0] <= position)
        return place, position - start


def _lose(report: Findings, loss: Loss) -> None:
    """Report a damaged part of a file. Adjacent parts with the same damage are reported together."""
    last = report.losses[-1] if report.losses else None
    if last and last.messages == loss.messages == -1 and last.offset + last.bytes == loss.offset:
        report.losses[-1] = replace(last, bytes=last.bytes + loss.bytes)
    elif last is None or len(report.losses) < MAX_LOSSES:
        report.losses.append(loss)
    else:
        reason = "further damage of the same kinds"
        report.losses[-1] = replace(last, reason=reason, messages=-1, bytes=last.bytes + loss.bytes)


def _beginning(data: bytes) -> bytes:
    """Return the first bytes of a message that are equal in all messages; empty without OSI version."""
    try:
        number, wire, _start, stop = next(fields_of(data, 0, len(data)))
    except (ValueError, StopIteration):
        return b""
    return data[: stop + 1] if (number, wire) == (_VERSION, 2) and 4 <= stop <= 32 else b""


def _likeness(name: str, data: bytes) -> int:
    """Return a score for a message's type: number of plausible objects if it has this type; -1 if invalid.

    A ground truth decoded as a sensor view, or the other way round, is malformed or empty.
    """
    message, objects, bulbs = _classes_of(name)
    try:
        _, ground, _ = parse(message, data)
        placed = [objects.FromString(content) for content in ground.moving_object]
        placed += [bulbs.FromString(content) for content in lights_of(ground)] if bulbs else []
        return _things([*placed, *ground.stationary_object], ground.lane)
    except DECODE_ERRORS:
        return -1


@cache
def _classes_of(name: str) -> tuple[type[Any], type[Any], type[Any] | None]:
    schema = Schema(id=1, data=descriptors(), encoding="protobuf", name=name)
    message = message_class(schema)
    return message, object_class(message), part_class(message, TRAFFIC_LIGHT)


def _things(placed: list[Any], lanes: Any) -> int:
    return sum(
        thing.id.HasField("value") and thing.base.HasField("position") for thing in placed
    ) + sum(lane.id.HasField("value") for lane in lanes)


def time_of_bytes(data: bytes) -> int | None:
    """Return the time stamp of a serialised OSI message; ns. ``None`` if it has no valid time."""
    seconds, nanos = 0, 0
    try:
        for number, wire, start, stop in fields_of(data, 0, len(data)):
            if number == _TIMESTAMP and wire == 2:
                for inner, kind, at, end in fields_of(data, start, stop):
                    value = _number(data[at:end]) if kind == 0 else 0
                    seconds = value if inner == 1 else seconds
                    nanos = value if inner == 2 else nanos
                break
            if number > _TIMESTAMP:
                return None
        else:
            return None
    except ValueError:
        return None
    time_ns = seconds * 1_000_000_000 + nanos
    return time_ns if 0 <= time_ns < LATEST_NS else None


def _number(content: bytes) -> int:
    """Decode a protobuf varint as a signed number."""
    value = sum((byte & 0x7F) << 7 * i for i, byte in enumerate(content))
    return value - (1 << 64) if value >> 63 & 1 else value
