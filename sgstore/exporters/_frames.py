"""Export format ``frames``: sensor messages as files (pictures, point clouds, videos), with tables.

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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, StoreError, TraceError
from sgstore.exporters._clips import WrittenFile, clip_name, safe_name
from sgstore.exporters._sensor_data import Sensed, cloud_file, sensor_of
from sgstore.mcap import Loss
from sgstore.model.vocabulary import natural, suggestion
from sgstore.model.world import TraceReport
from sgstore.readers import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from pathlib import Path

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.mcap import Messages, Recording
    from sgstore.store import StoredTrace


WINDOW: Final = 2400
"""Number of frames whose messages are searched in one pass over a recording."""

ENDINGS: Final = {"jpeg": "jpg", "tiff": "tif"}
"""Form of a file → file suffix, if it differs from the name of the form."""

FILE_COLUMNS: Final = (
    *("clip", "frame_id", "trace", "seq", "channel", "log_time_ns", "file", "holds", "form"),
    *("picture", "sha256"),
)
"""Columns of the table of files. ``picture`` is the index of the picture in a video file, from 0."""
CHANNEL_COLUMNS: Final = ("trace", "channel", "schema", "holds", "frames", "files", "lost")

_PAYLOADS: Final = """
SELECT frame_id, channel, log_time_ns, chunk_offset, message_offset FROM payloads
WHERE frame_id >= $first AND frame_id <= $last
ORDER BY frame_id, channel, log_time_ns, chunk_offset, message_offset
"""

Place = tuple[int, int]
"""Position of a message: offset of its chunk, and offset within the chunk."""


@dataclass(slots=True)
class _FrameMessage:
    """Recorded sensor message of a frame: its channel, log time and position in the recording."""

    frame_id: int
    seq: int
    channel: str
    log_time_ns: int
    place: Place


File = tuple[str, str, str, str, str]
"""Written file, in the order of the last columns of :data:`FILE_COLUMNS`: name, holds, form, picture, hash."""
Found = dict[tuple[str, Place], File | None]
"""Channel and position of a message → its file. ``None`` means neither a picture nor a point cloud."""


@dataclass(slots=True)
class _Film:
    """Video file while it is written: format, number of pictures, position of the last recorded message."""

    path: Path
    form: str
    last: Place
    count: int

    def as_file(self) -> File:
        """Return the row of the file table for the last picture of the video."""
        name = f"{self.path.parent.name}/{self.path.name}"
        return name, "video", self.form, str(self.count - 1), ""


@dataclass(slots=True)
class _Count:
    """Numbers of written and lost messages of a channel."""

    schema: str
    holds: str = ""
    frames: int = 0
    files: int = 0
    lost: int = 0


@dataclass(slots=True)
class _Tables:
    """Tables that an export writes together with the sensor files, and counts of the messages."""

    files: Any
    frames: Any
    channels: dict[tuple[str, str], _Count] = field(default_factory=dict[tuple[str, str], _Count])
    lost: dict[tuple[str, str], tuple[str, int]] = field(
        default_factory=dict[tuple[str, str], tuple[str, int]]
    )
    rows: int = 0
    frame_rows: int = 0

    def losses(self) -> list[Loss]:
        """Return the lost messages of each channel: their number, and the first reason."""
        return [
            Loss(
                f"{trace}, {topic!r}: {count} messages are not there; the first: {reason}", count, 0
            )
            for (trace, topic), (reason, count) in self.lost.items()
        ]


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the sensor messages of the clips as files, with tables. If Pillow is installed, check pictures."""
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
            place = folder / clip_name(frames.clip.trace, frames.own, "")
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
    """Open the recording of a clip, or raise an error if the file has changed since ingest."""
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
    """Writer of the sensor messages of one clip into a folder."""

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
        """Write the files of all frames of the clip, in groups of frames."""
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
        """Write the wanted messages of the recording to files. Add the file of each message to ``found``.

        ``None`` means that a message is neither a picture nor a point cloud.
        """
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
        """Write a message to a file if a frame uses it, or if a video needs it for a later picture."""
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
        """Start a video file. Write all pictures from the last key frame up to the given picture."""
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
        """Write a row into the table of files."""
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
        """Return a unique folder name for a sensor, valid on all systems."""
        if topic not in self._names:
            name, number = safe_name(topic, "sensor"), 1
            taken = {other.lower() for other in self._names.values()}
            while (name if number == 1 else f"{name}_{number}").lower() in taken:
                number += 1
            self._names[topic] = name if number == 1 else f"{name}_{number}"
        return self._names[topic]


def _test_picture(path: Path, data: bytes) -> None:
    """Raise an error if a written picture cannot be opened. Do nothing if Pillow is not installed.

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
