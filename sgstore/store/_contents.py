"""Digests of the settings and road maps of traces, and file positions of the messages of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from sgstore.model.frame_ids import trace_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.model.world import Ints
    from sgstore.store._file import StoreFile


_MARKS: Final = """
SELECT t.trace_id, c.digest AS config, coalesce(m.digest, '') AS map
FROM trace t JOIN config c ON c.config_id = t.config_id LEFT JOIN map m ON m.map_id = t.map_id
"""

_WANTED: Final = "(SELECT unnest($frames) AS frame_id) w"

_MESSAGES: Final = f"""
SELECT p.frame_id, p.channel, p.log_time_ns, p.chunk_offset, p.message_offset, p.length
FROM payloads p JOIN {_WANTED} ON w.frame_id = p.frame_id
ORDER BY p.chunk_offset, p.message_offset
"""


_LENGTHS: Final = f"""
SELECT min(f.frame_id) AS frame_id, any_value(p.length) AS length
FROM frame f JOIN {_WANTED} ON w.frame_id = f.frame_id JOIN payload p ON p.bucket = f.bucket AND p.bit = f.bit
GROUP BY f.trace_id, p.chunk_offset, p."offset"
"""

TOGETHER: Final = 200_000
"""Approximate number of frames for each query. A query always reads whole traces."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Digests of the settings and the road map from which the graphs of a trace were made.

    Attributes
    ----------
    config, map : str
        Digests of the settings and of the road map text; empty without a map.
    """

    config: str
    map: str

    @staticmethod
    def of_traces(file: StoreFile) -> dict[int, Mark]:
        """Return the settings digest and map digest of every trace of a store: trace id → digests."""
        return {row[0]: Mark(*row[1:]) for row in file.rows(_MARKS).values}


@dataclass(frozen=True, slots=True)
class MessagePlaces:
    """File positions of the recorded messages that belong to frames, sorted by position.

    Attributes
    ----------
    frame_id : (M,) int64
    channel : (M,) object
        Topics.
    log_time_ns, chunk_offset, offset, length : (M,) int64
    """

    frame_id: Ints
    channel: NDArray[np.object_]
    log_time_ns: Ints
    chunk_offset: Ints
    offset: Ints
    length: Ints

    @staticmethod
    def of(file: StoreFile, frame_id: Ints) -> MessagePlaces:
        """Return where the messages of some frames are in the recording, one row per frame and message."""
        found = file.arrays(_MESSAGES, {"frames": frame_id.tolist()})
        frame, channel, *numbers = found.values()
        return MessagePlaces(
            frame.astype(np.int64),
            np.asarray(channel, object),
            *(column.astype(np.int64) for column in numbers),
        )

    @staticmethod
    def lengths(file: FileOfFrames, frame_id: Ints) -> Iterator[tuple[Ints, Ints]]:
        """Yield message sizes of some frames; bytes. A message of several frames counts once."""
        ends = np.append(np.flatnonzero(np.diff(trace_of(frame_id))) + 1, len(frame_id))
        low = 0
        while low < len(frame_id):
            high = int(ends[np.searchsorted(ends, min(low + TOGETHER, len(frame_id)))])
            found = file.arrays(_LENGTHS, {"frames": frame_id[low:high].tolist()})
            yield found["frame_id"].astype(np.int64), found["length"].astype(np.int64)
            low = high


class FileOfFrames(Protocol):
    """Interface of a store of frames: a single store file, or the bundles of a collection."""

    def arrays(self, sql: str, parameters: Any) -> dict[str, NDArray[Any]]: ...
