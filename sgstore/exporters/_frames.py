"""Export of sensor messages as files: pictures, point clouds, videos.

Each clip has a folder with one subfolder per sensor: ``CLIP/SENSOR/000123.jpg`` is the message of
frame 123 (the first such frame: several frames can share a message). Picture files are copied; raw
pixels become PNG; clouds become ``.pcd``, ``.npy`` or ``.bin``. A video is one file,
``CLIP/SENSOR.h264``, from the key frame before its first picture to its last picture, as recorded.

``files.csv`` lists the file of each frame and sensor, ``frames.csv`` the frames and their labels,
and ``channels.csv`` all sensor channels with counts. Messages other than pictures and clouds are
not exported.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from sgstore.errors import ExportError, StoreError, TraceError
from sgstore.exporters._clips import WrittenFile, clip_name, safe_name
from sgstore.mcap import Loss
from sgstore.model.vocabulary import natural, suggestion
from sgstore.model.world import TraceReport
from sgstore.readers import open_recording, picture_form, png, record_reader

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.exporters._labels import ClipFrames, Export
    from sgstore.mcap import Messages, Recording
    from sgstore.store import StoredTrace, StoreFile


WINDOW: Final = 2400
"""Frames whose messages are searched in one pass over a recording."""

ENDINGS: Final = {"jpeg": "jpg", "tiff": "tif"}
"""Forms whose file ending differs from their name."""

FILE_COLUMNS: Final = (
    *("clip", "frame_id", "trace", "seq", "channel", "log_time_ns", "file", "holds", "form"),
    *("picture", "sha256"),
)
"""``picture``: index in the file of a video, from 0."""
CHANNEL_COLUMNS: Final = ("trace", "channel", "schema", "holds", "frames", "files", "lost")

_PAYLOADS: Final = """
SELECT frame_id, channel, log_time_ns, chunk_offset, message_offset FROM payloads
WHERE frame_id >= $first AND frame_id <= $last
ORDER BY frame_id, channel, log_time_ns, chunk_offset, message_offset
"""

Place = tuple[int, int]
"""Place of a message: offset of its chunk, and offset in the chunk."""


@dataclass(slots=True)
class _FrameMessage:
    """Reference to a recorded message of a frame."""

    frame_id: int
    seq: int
    channel: str
    log_time_ns: int
    place: Place


File = tuple[str, str, str, str, str]
"""A written file, as the last columns of :data:`FILE_COLUMNS`: name, holds, form, picture, hash."""
Found = dict[tuple[str, Place], File | None]
"""Files of messages, by channel and place; ``None`` means neither picture nor cloud."""


@dataclass(slots=True)
class _Film:
    """File of a video, the place of its latest picture in the recording, and the picture count."""

    path: Path
    form: str
    last: Place
    count: int

    def as_file(self) -> File:
        """Return the table columns of the latest picture."""
        name = f"{self.path.parent.name}/{self.path.name}"
        return name, "video", self.form, str(self.count - 1), ""


@dataclass(slots=True)
class _Count:
    """Counts of the messages of a channel."""

    schema: str
    holds: str = ""
    frames: int = 0
    files: int = 0
    lost: int = 0


@dataclass(slots=True)
class _Tables:
    """Tables of an export, and counts."""

    files: Any
    frames: Any
    channels: dict[tuple[str, str], _Count] = field(default_factory=dict[tuple[str, str], _Count])
    lost: dict[tuple[str, str], tuple[str, int]] = field(
        default_factory=dict[tuple[str, str], tuple[str, int]]
    )
    rows: int = 0
    frame_rows: int = 0

    def losses(self) -> list[Loss]:
        """Return the losses of each channel: the first reason, and their number."""
        return [
            Loss(
                f"{trace}, {topic!r}: {count} messages are not there; the first: {reason}", count, 0
            )
            for (trace, topic), (reason, count) in self.lost.items()
        ]


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write files and tables; pictures are checked with Pillow if it is installed."""
    _check_channels(export)
    names = list(export.labels.texts) if export.labels is not None else []
    places: list[Path] = []
    with ExitStack() as stack:

        def table(name: str) -> Any:
            file = folder / f"{name}.csv"
            stream = stack.enter_context(file.open("x", encoding="utf-8", newline=""))
            return csv.writer(stream, lineterminator="\n")

        tables = _Tables(table("files"), table("frames"))
        tables.files.writerow(FILE_COLUMNS)
        tables.frames.writerow(
            ("clip", "frame_id", "trace", "seq", "time_ns", "log_time_ns", "t", *names)
        )
        for frames in export.frames():
            place = folder / clip_name(frames.clip.trace, frames.number, "")
            place.mkdir()
            places.append(place)
            _write_frames(export, frames, tables)
            with _recording(export, frames) as (trace, recording):
                _Writing(export, trace, recording, frames, place, tables).write()
            export.tell(frames.number, len(export.clips))
    _write_channels(folder / "channels.csv", tables)
    counts = {"files": tables.rows, "frames": tables.frame_rows, "channels": len(tables.channels)}
    written = [
        WrittenFile.of(
            folder / f"{name}.csv", name, count, tables.losses() if name == "files" else ()
        )
        for name, count in counts.items()
    ]
    return [
        *(WrittenFile.of(p, "files", sum(1 for f in p.rglob("*") if f.is_file())) for p in places),
        *written,
    ]


def _check_channels(export: Export) -> None:
    known = {c.topic for clip in export.clips for c in export.store.file.channels(clip.trace)}
    for topic in export.channels:
        if topic not in known:
            like = suggestion(topic, known)
            hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(sorted(known))}"
            raise ExportError(f"no channel {topic!r} in these traces; {hint}")


@contextmanager
def _recording(export: Export, frames: ClipFrames) -> Generator[tuple[StoredTrace, Recording]]:
    """Open the recording of a clip; reject a file that has changed since ingest."""
    trace = export.trace(frames.clip.trace)
    with open_recording(trace.path) as recording:
        if (recording.size, recording.mtime_ns) != (trace.size, trace.mtime_ns):
            from sgstore.mcap import digest_of

            if digest_of(trace.path) != trace.digest:
                raise ExportError(f"{trace.path}: the file has changed since it was ingested")
        yield trace, recording


def _write_frames(export: Export, frames: ClipFrames, tables: _Tables) -> None:
    of = (frames.frame_id, frames.seq, frames.time_ns, frames.log_time_ns, frames.t)
    rows = zip(*(column.tolist() for column in of), strict=True)
    for (frame_id, *rest), labels in zip(rows, export.label_cells(frames.frame_id), strict=True):
        tables.frames.writerow((frames.number, frame_id, frames.clip.trace, *rest, *labels))
    tables.frame_rows += len(frames)


def _by_trace(of: dict[tuple[str, str], _Count]) -> list[tuple[tuple[str, str], _Count]]:
    return sorted(of.items(), key=lambda one: (natural(one[0][0]), one[0][1]))


def _write_channels(file: Path, tables: _Tables) -> None:
    with file.open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(CHANNEL_COLUMNS)
        for (trace, topic), of in _by_trace(tables.channels):
            writer.writerow(
                (trace, topic, of.schema, of.holds or "message", of.frames, of.files, of.lost)
            )


@dataclass(slots=True)
class _Writing:
    """Writer of one clip into its folder."""

    export: Export
    trace: StoredTrace
    recording: Recording
    frames: ClipFrames
    folder: Path
    tables: _Tables
    _known: dict[str, Callable[[bytes], Sensed | None]] = field(
        default_factory=dict[str, "Callable[[bytes], Sensed | None]"]
    )
    _names: dict[str, str] = field(default_factory=dict[str, str])
    _films: dict[str, _Film] = field(default_factory=dict[str, _Film])

    def write(self) -> None:
        """Write the files of all frames, some frames at a time."""
        before: Found = {}
        for start in range(0, len(self.frames), WINDOW):
            rows = list(self._rows(self.frames.take(slice(start, start + WINDOW))))
            wanted: dict[tuple[str, Place], _FrameMessage] = {}
            for row in rows:
                wanted.setdefault((row.channel, row.place), row)
            # A message shared by frames of two windows is already written.
            found = {key: before[key] for key in wanted if key in before}
            self._fetch({k: row for k, row in wanted.items() if k not in found}, found)
            for row in rows:
                self._tell(row, found.get((row.channel, row.place)))
            before = found
        for film in self._films.values():
            if not film.path.stat().st_size:
                raise ExportError(f"{film.path.name}: is empty")

    def _rows(self, frames: ClipFrames) -> Iterator[_FrameMessage]:
        seq = dict(zip(frames.frame_id.tolist(), frames.seq.tolist(), strict=True))
        topics = set(self.export.channels)
        for frame_id, channel, log_time_ns, chunk, offset in self.export.store.file.rows(
            _PAYLOADS, frames.bounds
        ):
            if frame_id in seq and (not topics or channel in topics):
                yield _FrameMessage(frame_id, seq[frame_id], channel, log_time_ns, (chunk, offset))

    def _fetch(
        self,
        wanted: dict[tuple[str, Place], _FrameMessage],
        found: Found,
    ) -> None:
        """Write the messages at these places to files; ``None`` means neither picture nor cloud."""
        chunks = {place[0] for _, place in wanted}
        if not chunks:
            return
        low, high = min(chunks), max(chunks)
        if self._films:  # all pictures between two wanted ones are needed to decode the later one
            low = min(low, *(film.last[0] for film in self._films.values()))
        ends: dict[str, Place] = {}
        for topic, place in wanted:
            ends[topic] = max(place, ends.get(topic, place))

        def needed(chunk: int) -> bool:
            return chunk in chunks or (bool(self._films) and low <= chunk <= high)

        report = TraceReport()
        for run in self.recording.walk(report, needed):
            for row in range(len(run)):
                self._take(run, row, wanted, found, ends)
        for key, row in wanted.items():
            if key not in found:
                self._lose(row, "the recording cannot be read there")
                found[key] = None

    def _take(
        self,
        run: Messages,
        at: int,
        wanted: dict[tuple[str, Place], _FrameMessage],
        found: Found,
        ends: dict[str, Place],
    ) -> None:
        """Write a message if it is wanted, or if a video needs it for a later picture."""
        channel = self.recording.channels.get(int(run.channel[at]))
        if channel is None:
            return
        place = (run.chunk_offset, int(run.offset[at]))
        film = self._films.get(channel.topic)
        row = wanted.get((channel.topic, place))
        if film is not None:
            if not film.last < place <= ends.get(channel.topic, film.last):
                return
            sensed = self._sensed(int(run.channel[at]), bytes(run.data(at)), row)
            if sensed is not None and sensed.holds == "video":
                with film.path.open("ab") as stream:
                    stream.write(sensed.data)
                film.last = place
                film.count += 1
            if row is not None:
                found[channel.topic, place] = film.as_file()
        elif row is not None:
            sensed = self._sensed(int(run.channel[at]), bytes(run.data(at)), row)
            found[channel.topic, place] = self._file(row, sensed)

    def _sensed(self, number: int, message: bytes, row: _FrameMessage | None) -> Sensed | None:
        channel = self.recording.channels[number]
        if channel.topic not in self._known:
            schema = self.recording.schemas.get(channel.schema_id)
            self._known[channel.topic] = sensor_of(channel, schema)
        try:
            return self._known[channel.topic](message)
        except (TraceError, ExportError) as error:
            if row is not None:
                self._lose(row, str(error))
            return None

    def _file(self, row: _FrameMessage, sensed: Sensed | None) -> File | None:
        if sensed is None:
            return None
        if sensed.holds == "video":
            return self._begin(row, sensed)
        if sensed.holds == "cloud":
            form = self.export.clouds
            return self._store(row, "cloud", form, cloud_file(sensed.data, form))
        return self._store(row, "picture", sensed.form, sensed.data)

    def _store(self, row: _FrameMessage, holds: str, form: str, data: bytes) -> File:
        name = f"{self._name(row.channel)}/{row.seq:06d}.{ENDINGS.get(form, form)}"
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        with path.open("xb") as stream:
            stream.write(data)
        if holds == "picture" and form != "npy":
            _test_picture(path, data)
        if form == "npy":
            np.load(io.BytesIO(data), allow_pickle=False)
        self._count(row).files += 1
        digest = hashlib.sha256(data).hexdigest()
        return f"{self.folder.name}/{name}", holds, form, "", digest

    def _begin(self, row: _FrameMessage, video: Sensed) -> File | None:
        """Start a video file with the key frame before a picture, and all pictures between."""
        try:
            carried = self.export.store.file.carried(row.frame_id, row.channel)
        except (TraceError, StoreError) as error:
            self._lose(row, str(error))
            return None
        form = carried.form if carried.form in {"h264", "h265"} else ""
        if not form:
            self._lose(
                row, f"{row.channel!r}: a video in a format that is not known: {video.form!r}"
            )
            return None
        path = self.folder / f"{self._name(row.channel)}.{form}"
        with path.open("xb") as stream:
            stream.write(carried.data)
        film = _Film(path, form, row.place, carried.messages)
        self._films[row.channel] = film
        self._count(row).files += 1
        return film.as_file()

    def _tell(self, row: _FrameMessage, file: File | None) -> None:
        """Write a row of the table of files."""
        count = self._count(row)
        count.frames += 1
        if file is None:
            return
        count.holds = file[1]
        self.tables.rows += 1
        self.tables.files.writerow(
            (
                *(self.frames.number, row.frame_id, self.frames.clip.trace, row.seq, row.channel),
                row.log_time_ns,
                *file,
            )
        )

    def _count(self, row: _FrameMessage) -> _Count:
        key = (self.frames.clip.trace, row.channel)
        if key not in self.tables.channels:
            channels = self.recording.channels.values()
            record = next((c for c in channels if c.topic == row.channel), None)
            schema = self.recording.schemas.get(record.schema_id) if record else None
            self.tables.channels[key] = _Count(schema.name if schema else "")
        return self.tables.channels[key]

    def _lose(self, row: _FrameMessage, reason: str) -> None:
        self._count(row).lost += 1
        key = (self.frames.clip.trace, row.channel)
        first, count = self.tables.lost.get(key, (reason, 0))
        self.tables.lost[key] = first, count + 1

    def _name(self, topic: str) -> str:
        """Return a unique, portable folder name for a sensor."""
        if topic not in self._names:
            name, number = safe_name(topic, "sensor"), 1
            taken = {other.lower() for other in self._names.values()}
            while (name if number == 1 else f"{name}_{number}").lower() in taken:
                number += 1
            self._names[topic] = name if number == 1 else f"{name}_{number}"
        return self._names[topic]


def _test_picture(path: Path, data: bytes) -> None:
    """Open a written picture with Pillow, if it is installed.

    Raises
    ------
    ExportError
        It cannot be opened.
    """
    try:
        image: Any = import_module("PIL.Image")
    except ImportError:
        return
    if path.stat().st_size != len(data):
        raise ExportError(f"{path.name}: {len(data)} bytes were written, another number is there")
    if path.suffix == ".png":
        try:
            with image.open(path) as picture:
                picture.verify()
        except (OSError, SyntaxError, ValueError) as error:
            raise ExportError(f"{path.name}: cannot be opened again: {error}") from error


# Content of a sensor message: a picture or a point cloud, by the schema in the file. Messages with
# the file of a picture (``data`` and ``format``) give that file. Messages with pixels (``width``,
# ``height``, ``encoding``, ``data``) give a PNG, or an array if PNG cannot hold them. Messages with
# points (``fields`` and their offsets in ``data``) give columns. Other messages are not supported.
# Source: ROS 2, ``sensor_msgs`` (``Image``, ``PointCloud2``; ``image_encodings.hpp``); Foxglove's
# schemas ``RawImage``, ``CompressedImage``, ``PointCloud``, ``PackedElementField``.

VIDEO: Final = re.compile("26[45]|avc|hevc|av1|vp9", re.IGNORECASE)
"""Names of video formats."""

MAX_POINTS: Final = 20_000_000
"""Greatest number of points of a cloud."""

_ROS: Final = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), 1))
_FOXGLOVE: Final = dict(enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), 1))
_FOXGLOVE_WORDS: Final = (
    *("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"),
)
"""Number types of points."""

_LAYOUTS: Final = {
    **dict.fromkeys(("mono8", "8uc1"), ("u1", 1, "")),
    **dict.fromkeys(("mono16", "16uc1"), ("u2", 1, "")),
    **dict.fromkeys(("rgb8", "8uc3"), ("u1", 3, "")),
    "rgb16": ("u2", 3, ""),
    "bgr8": ("u1", 3, "bgr"),
    "bgr16": ("u2", 3, "bgr"),
    **dict.fromkeys(("rgba8", "8uc4"), ("u1", 4, "")),
    "bgra8": ("u1", 4, "bgr"),
    "rgba16": ("u2", 4, ""),
    "bgra16": ("u2", 4, "bgr"),
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), ("u1", 2, "array")),
}
"""Encodings of pixels: type and number of their values; and the order reversed, or no PNG possible."""
_BAYER: Final = re.compile(r"bayer_[a-z]{4}(8|16)")
_OPENCV: Final = re.compile(r"(8|16|32|64)([usf])c(\d)")


class Sensed(NamedTuple):
    """Content of a sensor message.

    Attributes
    ----------
    holds : str
        ``picture``: content of a file; ``video``: one of its pictures; ``cloud``: points.
    form : str
        For a picture ``jpeg``, ``png``, ``webp``, ``tiff``, ``bmp`` or ``npy``; for a video the
        name in the message.
    data : bytes or structured array
        Points are little endian, without gaps.
    """

    holds: Literal["picture", "video", "cloud"]
    form: str
    data: Any


Record = Mapping[str, Any]


def sensor_of(channel: Channel, schema: Schema | None) -> Callable[[bytes], Sensed | None]:
    """Return a function from messages of a channel to their content; it returns ``None`` for other data.

    It raises ``TraceError`` for an inconsistent picture or cloud.
    """
    read = record_reader(channel, schema)

    def sensed(message: bytes) -> Sensed | None:
        record = read(message)
        return None if record is None else _of_record(record)

    return sensed


def cloud_of(file: StoreFile, frame: int | str, channel: str) -> NDArray[Any]:
    """Return the points in a channel's message of a frame.

    Returns
    -------
    (N,) structured array
        One field per number of a point, with its name in the message; little endian.

    Raises
    ------
    StoreError
        The frame or channel is missing, or the frame has no message of the channel.
    TraceError
        The recording is missing, was replaced, or is damaged at this place.
    ExportError
        The message has no points.
    """
    known, schema, data = file.recorded(frame, channel)
    found = sensor_of(known, schema)(data)
    if found is None or found.holds != "cloud":
        held = "" if found is None else f", but a {found.holds}"
        raise ExportError(f"{channel}: the message holds no points{held}")
    return found.data


def _of_record(record: Record) -> Sensed | None:
    data = record.get("data")
    if isinstance(data, np.ndarray) and data.dtype.itemsize == 1:
        data = data.tobytes()
    if not isinstance(data, bytes):
        return None
    if isinstance(record.get("format"), str):
        return _of_file(data, record["format"])
    try:
        if isinstance(record.get("encoding"), str) and "width" in record and "height" in record:
            return _of_pixels(data, record)
        if "fields" in record and ("point_step" in record or "point_stride" in record):
            return Sensed("cloud", "", _points(data, record))
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise TraceError(f"not what it says: {error}") from error
    return None


def _of_file(data: bytes, form: str) -> Sensed | None:
    picture = picture_form(data)
    if picture:
        return Sensed("picture", picture, data)
    return Sensed("video", form, data) if VIDEO.search(form) else None


# Pixels ---------------------------------------------------------------------------------------------------


def _of_pixels(data: bytes, record: Record) -> Sensed:
    width, height = int(record["width"]), int(record["height"])
    encoding = str(record["encoding"]).lower()
    dtype, channels, how = _layout(encoding)
    big = bool(record.get("is_bigendian", False))
    kind = np.dtype(f"{'>' if big else '<'}{dtype}")
    across = width * channels * kind.itemsize
    step = int(record.get("step") or across)
    if width <= 0 or height <= 0 or step < across or step * height > len(data) + step - across:
        raise TraceError(
            f"a picture of {width} x {height} pixels ({encoding}) in {len(data)} bytes, {step} a row"
        )
    rows = np.frombuffer(data, np.uint8, step * (height - 1) + across)
    rows = np.lib.stride_tricks.as_strided(rows, (height, across), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    if how == "array":
        return Sensed("picture", "npy", _npy(pixels.astype(kind.newbyteorder("<"))))
    if how == "bgr":
        pixels = pixels[..., [2, 1, 0, *range(3, channels)]]
    return Sensed("picture", "png", png(pixels.astype(kind.newbyteorder("="))))


def _layout(encoding: str) -> tuple[str, int, str]:
    if encoding in _LAYOUTS:
        return _LAYOUTS[encoding]
    bayer = _BAYER.fullmatch(encoding)
    if bayer is not None:  # stored as grey, like the sensor's values
        return f"u{int(bayer[1]) // 8}", 1, ""
    opencv = _OPENCV.fullmatch(encoding)
    if opencv is not None:
        kind = {"u": "u", "s": "i", "f": "f"}[opencv[2]]
        return f"{kind}{int(opencv[1]) // 8}", int(opencv[3]), "array"
    raise TraceError(f"pixels in an encoding that is not known: {encoding!r}")


def _npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()


# Points ---------------------------------------------------------------------------------------------------


def _points(data: bytes, record: Record) -> NDArray[Any]:
    ros = "point_step" in record
    step = int(record["point_step" if ros else "point_stride"])
    order = ">" if ros and record.get("is_bigendian") else "<"
    fields = [_field(one, order, ros=ros) for one in record["fields"]]
    names = [name for name, *_ in fields]
    kind = np.dtype(
        {
            "names": names,
            "formats": [form for _, form, _ in fields],
            "offsets": [offset for *_, offset in fields],
            "itemsize": step,
        }
    )
    if ros:
        width, height = int(record["width"]), int(record["height"])
        row = int(record.get("row_step") or width * step)
        if min(width, height) < 0 or row < width * step or row * height > len(data):
            raise TraceError(f"{width} x {height} points of {step} bytes in {len(data)} bytes")
        count, flat = width * height, row == width * step
    else:
        count, flat, width, height, row = len(data) // step if step else 0, True, 0, 0, 0
    if count > MAX_POINTS:
        raise TraceError(f"{count} points; at most {MAX_POINTS} are read")
    if flat:
        found = np.frombuffer(data, kind, count)
    else:
        rows = [np.frombuffer(data, kind, width, i * row) for i in range(height)]
        found = np.concatenate(rows) if rows else np.zeros(0, kind)
    packed = np.empty(count, [(name, kind[name].newbyteorder("<")) for name in names])
    for name in names:
        packed[name] = found[name]
    return packed


def _field(told: Any, order: str, *, ros: bool) -> tuple[str, Any, int]:
    """Return name, type and offset of a field of point cloud points."""
    number = told["datatype"] if ros else told["type"]
    if isinstance(number, str):
        number = _FOXGLOVE_WORDS.index(number)
    form = (_ROS if ros else _FOXGLOVE).get(int(number))
    if form is None:
        raise TraceError(f"points with numbers of a type that is not known: {number}")
    count = int(told.get("count") or 1) if ros else 1
    if not 1 <= count <= 4096:
        raise TraceError(f"points with {count} numbers in one field")
    kind = f"{order}{form}"
    return str(told["name"]), kind if count == 1 else (kind, (count,)), int(told["offset"])


def cloud_file(points: NDArray[Any], form: str) -> bytes:
    """Return points as the content of a file.

    Parameters
    ----------
    points : structured array
    form : str
        ``pcd``: the Point Cloud Library's format 0.7, binary. ``npy``: numpy's, structured.
        ``bin``: as in KITTI, x, y, z and intensity in float32, 0 for missing ones.
    """
    if form == "npy":
        return _npy(points)
    if form == "bin":
        columns = [
            points[name] if name in (points.dtype.names or ()) else np.zeros(len(points))
            for name in ("x", "y", "z", "intensity")
        ]
        return np.stack(columns, axis=1).astype("<f4").tobytes()
    return _pcd(points)


def _pcd(points: NDArray[Any]) -> bytes:
    """Return points in the format PCD 0.7 (Point Cloud Library, "The PCD file format")."""
    names = points.dtype.names or ()
    kinds = [points.dtype[name] for name in names]
    letters = {"f": "F", "i": "I", "u": "U"}
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(re.sub(r"\W", "_", name) or "_" for name in names),
        "SIZE " + " ".join(str(kind.base.itemsize) for kind in kinds),
        "TYPE " + " ".join(letters[kind.base.kind] for kind in kinds),
        "COUNT " + " ".join(str(int(np.prod(kind.shape, dtype=int))) for kind in kinds),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "replace") + points.tobytes()
