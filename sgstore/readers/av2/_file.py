"""Log of Argoverse 2 (a folder), read like an MCAP file: a map message, and a message per sweep.

The annotations are boxes in the axes of the ego, and are converted to those of the city. The ego is annotated
in some logs only. Otherwise, its box is assumed.

Source: argoverse/av2-api, "Sensor Dataset" and "Map API"; Wilson et al., "Argoverse 2", 2021.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MapError, TraceError
from sgstore.mcap import log_files, mark_of
from sgstore.readers._arrow_files import numbers, read_arrow_file, values
from sgstore.readers._boxes import (
    EGO,
    EGO_TYPE,
    NAME,
    NOTE,
    Boxes,
    interpolated,
    joined,
    steps_of,
    turned,
    unit,
)
from sgstore.readers._file import NumberedFile
from sgstore.readers.av2._map import map_text

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.world import Floats

FRAME, MAP = "av2.Frame", "av2.Map"
"""Names of the message schemas of frames and of the map."""
POSES: Final = "city_SE3_egovehicle.feather"
EGO_SIZE: Final = (4.877, 2.0, 1.473)
"""Length, width and height that the reader assumes for the ego; m."""
EGO_CENTRE: Final = (1.4, 0.0, 0.7365)
"""Position of the ego's centre, relative to the ground below its rear axle; m."""
FURTHEST: Final = 500_000_000
"""Largest time between two poses of the ego that are interpolated; ns."""

_ASSUMED: Final = "the log does not contain the box of the ego; a car of 4.877 m by 2 m is assumed"
_TURN: Final = ("qw", "qx", "qy", "qz")
_PLACE: Final = ("tx_m", "ty_m", "tz_m")
_SIZE: Final = ("length_m", "width_m", "height_m")
_COLUMNS: Final = ("timestamp_ns", "track_uuid", "category", *_SIZE, *_TURN, *_PLACE)
_SCHEMA: Final = b'{"type":"object"}'


class Av2File(NumberedFile):
    """Log of Argoverse 2 that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path
        Folder of the log.

    Attributes
    ----------
    path, size, mtime_ns
        The folder; total size of its files, in bytes; their latest modification time.
    schemas, channels : dict
        ``/av2/map`` and ``/av2/annotations``, with their schemas.
    counts : dict
        Number of messages by channel.

    Raises
    ------
    TraceError
        A file of the folder is missing or cannot be read.
    MissingExtraError
        pyarrow is not installed.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size, self.mtime_ns = mark_of(path)
        files = {file.name: file for file in log_files(path) or ()}
        told = sorted(name for name in files if name.startswith("annotations"))
        lost: list[str] = []
        self._ego, self._boxes, self._times = _read_boxes(files[told[-1]], files[POSES], lost)
        self._steps = steps_of(self._times)
        maps = (file for name, file in files.items() if name.startswith("log_map_archive"))
        self._map = next((_read_map(file, lost) for file in maps), b"")
        about = {NAME: path.name} | ({} if self._ego else {NOTE: _ASSUMED})
        named = ({"/av2/map": MAP} if self._map else {}) | {"/av2/annotations": FRAME}
        self.add_channels(named, len(self._steps), about, dict.fromkeys((FRAME, MAP), _SCHEMA))
        self.losses += lost

    def message(self, number: int) -> bytes:
        """Return the bytes of a message, given its number: 0 is the map, the others are annotated frames."""
        if number == 0:
            return self._map
        rows = self._steps[number - 1].tolist()
        return self._boxes.message(self.time_of(number), self._ego or EGO, rows)

    def time_of(self, number: int) -> int:
        """Return the time of a frame, given its number (from 1); ns."""
        return int(self._times[self._steps[number - 1][0]])


def _read_boxes(annotations: Path, poses: Path, lost: list[str]) -> tuple[str, Boxes, Any]:
    """Return the ego's id, all boxes of a log in city axes, and the time of each box; ns.

    A log without the box of the ego has an assumed one at each time. The id is then empty.
    """
    table = read_arrow_file(annotations, _COLUMNS, lost.append)
    times = _times_of(table)
    ident, kind = (list(map(str, values(table, name))) for name in ("track_uuid", "category"))
    told = numbers(table, (*_PLACE, *_TURN, *_SIZE))
    ego_name = next((name for name, what in zip(ident, kind, strict=True) if what == EGO_TYPE), "")
    if not ego_name:
        at = np.unique(times)
        ident, kind = [*ident, *[EGO] * len(at)], [*kind, *[EGO_TYPE] * len(at)]
        times = np.append(times, at)
        own = (*EGO_CENTRE, 1.0, 0.0, 0.0, 0.0, *EGO_SIZE)
        told = np.vstack([told, np.tile(own, (len(at), 1))])
    ego = _poses_at(poses, times, lost)
    with np.errstate(invalid="ignore", over="ignore"):
        turn = unit(told[:, 3:7])
        boxes = Boxes(
            *(ident, kind, ego[:, :3] + turned(ego[:, 3:], told[:, :3])),
            *(joined(ego[:, 3:], turn), told[:, 7:10]),
        )
        usable = np.isfinite(boxes.centre).all(axis=1) & np.isfinite(boxes.turn).all(axis=1)
    return ego_name, *_usable(boxes, times, usable & _first_of_its_frame(times, ident), lost)


def _usable(boxes: Boxes, times: Any, usable: Any, lost: list[str]) -> tuple[Boxes, Any]:
    """Return the boxes and times that a mask selects. Report the other boxes as lost."""
    rows = np.flatnonzero(usable).tolist()
    if len(rows) < len(usable):
        count = len(usable) - len(rows)
        lost.append(f"{count} boxes without a pose, without a pose of the ego, or twice in a sweep")
    ident, kind = [boxes.ident[row] for row in rows], [boxes.type[row] for row in rows]
    kept = Boxes(ident, kind, boxes.centre[rows], boxes.turn[rows], boxes.size[rows])
    return kept, times[rows]


def _first_of_its_frame(times: Any, ident: list[str]) -> Any:
    """Return a mask: True at the first row of each object in each frame."""
    first = dict[tuple[int, str], int]()
    for row, key in enumerate(zip(times.tolist(), ident, strict=True)):
        first.setdefault(key, row)
    mask = np.zeros(len(ident), np.bool_)
    mask[list(first.values())] = True
    return mask


def _poses_at(path: Path, times: Any, lost: list[str]) -> Floats:
    """Return the pose of the ego at each time: position and quaternion. NaN if it is unknown."""
    table = read_arrow_file(path, ("timestamp_ns", *_TURN, *_PLACE), lost.append)
    told, at = numbers(table, (*_PLACE, *_TURN)), _times_of(table)
    told[:, 3:] = unit(told[:, 3:])
    rows = np.flatnonzero(np.isfinite(told).all(axis=1) & (at >= 0))
    rows = rows[np.argsort(at[rows], kind="stable")]
    return interpolated(at[rows], told[rows], times, FURTHEST)


def _times_of(table: Any) -> Any:
    """Return the times of a table as integers; -1 if missing."""
    told = values(table, "timestamp_ns")
    usable = (isinstance(one, int) and 0 <= one < 1 << 62 for one in told)
    return np.array([one if use else -1 for one, use in zip(told, usable, strict=True)], np.int64)


def _read_map(path: Path, lost: list[str]) -> bytes:
    """Return the road map as text in the lane text format. A damaged map is reported as lost."""
    try:
        return map_text(json.loads(path.read_bytes())).encode()
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
        OverflowError,
        MapError,
        TraceError,
    ) as error:
        lost.append(f"{path.name}: the map cannot be read: {error}"[:200])
        return b""
