"""Recorder of a simulator run as one MCAP file: frames (as OSI, and exactly), road map and sensor data.

Log times are simulation times; they join sensors and frames to the nanosecond. The file has a
temporary name until it is finished; memory does not grow with its length.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from mcap.writer import Writer

import sgstore.exporters._foxglove as foxglove
from sgstore.errors import ExportError, reason_of
from sgstore.exporters._clips import tool
from sgstore.exporters._osi_messages import (
    ROAD_MAP,
    SENSOR_VIEW,
    VERSION,
    OsiFrames,
    map_message,
    types,
)
from sgstore.readers import SensorCloud, SensorPicture

if TYPE_CHECKING:
    from sgstore.graphs.online import Frame
    from sgstore.readers import SensorReading


TRUTH: Final = "ground_truth"
MAP_TOPIC: Final = "ground_truth_map"
"""Names of the topics for the frames and the road map, as other producers use them."""

FRAMES, FRAMES_SCHEMA = "sgstore/frames", "sgstore.Frame"
"""Topic and message schema of the exact frames, which contain values that OSI lacks."""

PROTOBUF: Final = "protobuf"
_JSON_SCHEMA: Final = b'{"type": "object", "properties": {"timestamp": {"type": "object"}}}'


@dataclass(frozen=True, slots=True)
class Written:
    """Description of a finished recording: file, numbers of frames and messages, and times.

    Attributes
    ----------
    path : Path
    frames : int
    messages : dict
        Topic → number of messages.
    start_ns, end_ns : int
        Simulation time of the first and of the last frame; ns. 0 without frames.
    """

    path: Path
    frames: int
    messages: dict[str, int]
    start_ns: int
    end_ns: int


class Recorder:
    """Recorder of a live simulator run into an MCAP file; a context manager.

    Parameters
    ----------
    to : str or Path
        ``….mcap``; existing files are not overwritten.
    map_text, map_name : str
        The road map as OpenDRIVE; empty for no map.
    sensors : mapping
        Name of each sensor → its blueprint, for the file's description.

    Raises
    ------
    ExportError
        The file exists, or cannot be written.

    Notes
    -----
    An aborted run, by an interrupt or an error, keeps the recorded frames. Without frames there is
    no file.
    """

    def __init__(
        self,
        to: str | Path,
        *,
        map_text: str = "",
        map_name: str = "",
        sensors: dict[str, str] | None = None,
    ) -> None:
        to = Path(to)
        if to.suffix.lower() != ".mcap":
            raise ExportError(f"cannot record into {to.name!r}: end the name in .mcap")
        if to.exists():
            raise ExportError(f"{to}: the file exists and is not overwritten; choose another name")
        self._to = to
        self._aside = to.with_name(f"{to.name}.part")
        try:
            self._stream = self._aside.open("xb")
        except FileExistsError as error:
            reason = "another recording is being written there, or was left behind"
            raise ExportError(f"{self._aside}: {reason}") from error
        except OSError as error:
            raise ExportError(f"{self._aside}: {reason_of(error)}") from error
        self._writer = Writer(self._stream, enable_data_crcs=True)
        self._writer.start("", tool())
        self._describe(sensors or {})
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._osi = OsiFrames()
        self._map = (map_text, map_name)
        self._times: tuple[int, int] | None = None
        self._frames = 0
        self.written: Written | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def frame(self, frame: Frame) -> None:
        """Write a frame of the live run to the recording.

        Raises
        ------
        ExportError
            Its time is negative, which MCAP cannot store, or the disk is full.
        """
        time_ns = frame.time_ns
        if time_ns < 0:
            raise ExportError(f"a frame at {time_ns} ns: a recording begins at 0 or later")
        if self._times is None:
            text, name = self._map
            if text:
                data = map_message(text, name)
                schema = (ROAD_MAP, PROTOBUF, types()[3])
                self._write(MAP_TOPIC, schema, time_ns, data)
        schema = (SENSOR_VIEW, PROTOBUF, types()[2])
        self._write(TRUTH, schema, time_ns, self._osi.message(frame))
        exact = json.dumps(frame.as_dict(), allow_nan=False, separators=(",", ":")).encode()
        self._write(FRAMES, (FRAMES_SCHEMA, "jsonschema", _JSON_SCHEMA), time_ns, exact, "json")
        self._times = (self._times[0] if self._times else time_ns, time_ns)
        self._frames += 1

    def reading(self, reading: SensorReading) -> None:
        """Write a sensor reading of the live run to the recording.

        Raises
        ------
        ExportError
            The disk is full.
        """
        data, time_ns, name = reading.data, max(reading.time_ns, 0), reading.sensor
        topic = f"/ego/{name}"
        if isinstance(data, SensorPicture):
            height, width, _ = data.pixels.shape
            if f"{topic}/calibration" not in self._channels:
                about = foxglove.calibration(width, height, data.fov, time_ns, name)
                self._write_foxglove(f"{topic}/calibration", foxglove.CALIBRATION, time_ns, about)
            content = foxglove.image(data.pixels, time_ns, name)
            self._write_foxglove(f"{topic}/image", foxglove.IMAGE, time_ns, content)
        elif isinstance(data, SensorCloud):
            content = foxglove.cloud(data.points, time_ns, name)
            self._write_foxglove(f"{topic}/points", foxglove.CLOUD, time_ns, content)
        else:
            schema = ("sgstore.Values", "jsonschema", _JSON_SCHEMA)
            self._write(topic, schema, time_ns, foxglove.values(data, time_ns), "json")

    def close(self) -> None:
        """Finish the recording, and rename the file to its final name."""
        if self._stream.closed:
            return
        try:
            self._writer.finish()
            self._stream.close()
            if self._frames:
                self._aside.replace(self._to)
            else:
                self._aside.unlink()
        except OSError as error:
            raise ExportError(f"{self._aside}: {reason_of(error)}") from error
        start, end = self._times or (0, 0)
        self.written = Written(self._to, self._frames, dict(self._counts), start, end)

    def _describe(self, sensors: dict[str, str]) -> None:
        version = ".".join(map(str, VERSION))
        names = ("version", "min_osi_version", "max_osi_version")
        self._writer.add_metadata("net.asam.osi.trace", dict.fromkeys(names, version))
        self._writer.add_metadata("sgstore.record", {f"sensor.{k}": v for k, v in sensors.items()})

    def _write_foxglove(self, topic: str, name: str, time_ns: int, data: bytes) -> None:
        self._write(topic, (f"foxglove.{name}", PROTOBUF, foxglove.schema(name)), time_ns, data)

    def _write(
        self,
        topic: str,
        schema: tuple[str, str, bytes],
        time_ns: int,
        data: bytes,
        encoding: str = PROTOBUF,
    ) -> None:
        try:
            number = self._channels.get(topic)
            if number is None:
                number = self._define(topic, schema, encoding)
            self._writer.add_message(number, time_ns, data, time_ns, self._counts[topic])
            self._counts[topic] += 1
        except OSError as error:
            raise ExportError(f"{self._aside}: {reason_of(error)}") from error

    def _define(self, topic: str, schema: tuple[str, str, bytes], encoding: str) -> int:
        name, schema_encoding, data = schema
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, schema_encoding, data)
        about: dict[str, str] = {}
        if name.startswith("osi3."):
            version = ".".join(map(str, VERSION))
            about = {"net.asam.osi.trace.channel.osi_version": version}
        number = self._writer.register_channel(topic, encoding, self._schemas[name], about)
        self._channels[topic] = number
        return number
