"""Camera pictures of recent frames, from a recording or from a running simulator."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

import numpy as np

from sgstore.readers._media import Media, png, read_carried

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from sgstore.model.world import Channel, FrameBlock, Ints
    from sgstore.readers.carla._live import Sensor, SensorPicture, Sensors

KEPT: Final = 3000
"""Number of recent frames whose pictures are available."""

MOST_BYTES: Final = 64 << 20
"""Maximum size of the stored pictures of a running simulator; bytes."""


class Cameras(Protocol):
    """Interface of a source of camera pictures for the latest frames.

    Attributes
    ----------
    topics : tuple of str
        Names of the cameras.
    """

    topics: tuple[str, ...]

    def at(self, seq: int, topic: str) -> Media | None:
        """Return the picture of a camera at a frame; ``None`` if it is missing or no longer stored."""
        ...


class RecordedCameras:
    """Camera pictures of a recording, for the most recently read frames.

    Parameters
    ----------
    path : Path
        Of the recording.
    channels : sequence of Channel
        All of its channels.

    Attributes
    ----------
    topics : tuple of str
        Topics of its picture channels.
    """

    def __init__(self, path: Path, channels: Sequence[Channel]) -> None:
        self._path = path
        self._rows = {c.topic: (row, c.id) for row, c in enumerate(channels) if "Image" in c.schema}
        self.topics = tuple(sorted(self._rows))
        self._known: tuple[int, Ints, Ints] = 0, np.zeros(0, np.int64), np.zeros((5, 0), np.int64)

    def followed(self, blocks: Iterable[FrameBlock]) -> Iterator[FrameBlock]:
        """Yield blocks of frames unchanged. Remember the file positions of camera pictures."""
        mine = [row for row, _ in self._rows.values()]
        for block in blocks:
            _, times, places = self._known
            refs = block.messages
            told = refs.channel, refs.log_time_ns, refs.chunk_offset, refs.offset, refs.length
            new = np.stack(told)[:, np.isin(refs.channel, mine)]
            times = np.append(times, block.log_time_ns)[-KEPT:]
            places = np.hstack([places, new])
            places = places[:, places[1] >= times.min() - _period(times)]
            self._known = int(block.seq[-1]) + 1 - len(times), times, places
            yield block

    def at(self, seq: int, topic: str) -> Media | None:
        """Return the camera picture nearest to a frame by log time, chosen as in a store.

        Raises
        ------
        TraceError
            The recording is no longer readable.
        """
        (first, times, places), (row, channel) = self._known, self._rows[topic]
        mine = places[1:, places[0] == row]
        if not first <= seq < first + len(times) or not mine.size:
            return None
        away = np.abs(mine[0] - times[seq - first])
        nearest = int(away.argmin())
        if away[nearest] > max(_period(times), _period(mine[0])) / 2:
            return None
        chunk, offset, length = mine[1:, nearest].tolist()
        place = {"chunk_offset": chunk, "offset": offset, "length": length}
        return read_carried(self._path, channel=channel, **place)


class LiveCameras:
    """Camera pictures of the ego in a running CARLA simulator.

    Parameters
    ----------
    attached : Sensors
    sensors : sequence of Sensor
        Attached sensors; only cameras are used.
    """

    def __init__(self, attached: Sensors, sensors: Sequence[Sensor]) -> None:
        self.topics = tuple(one.name for one in sensors if one.type.startswith("sensor.camera."))
        self._attached = attached
        self._times: deque[tuple[int, int]] = deque(maxlen=KEPT)
        self._pictures: deque[tuple[str, int, Any]] = deque()
        self._bytes = 0

    def take(self, seq: int, time_ns: int) -> None:
        """Record a frame and the camera pictures that arrived before it."""
        self._times.append((seq, time_ns))
        for reading in self._attached.waiting():
            if reading.sensor in self.topics:
                pixels = cast("SensorPicture", reading.data).pixels
                self._pictures.append((reading.sensor, reading.time_ns, pixels))
                self._bytes += pixels.nbytes
        while self._bytes > MOST_BYTES and len(self._pictures) > 1:
            self._bytes -= self._pictures.popleft()[2].nbytes

    def at(self, seq: int, topic: str) -> Media | None:
        """Return the latest picture of a camera at or before a frame; ``None`` if it has none."""
        time_ns = next((time for number, time in tuple(self._times) if number == seq), None)
        if time_ns is None:
            return None
        seen = (p for p in reversed(tuple(self._pictures)) if p[0] == topic and p[1] <= time_ns)
        found = next(seen, None)
        return None if found is None else Media("png", png(found[2]))


def _period(times: Ints) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0
