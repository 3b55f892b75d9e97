"""Log of 123D (a folder of Arrow files), read like an MCAP file: a map, and a message per frame.

A frame is a row of ``box_detections_se3.arrow``, or of ``ego_state_se3.arrow`` if there are no boxes. The state
of the ego is interpolated. The schema of each file has metadata in MessagePack. The road map is ``map.arrow``
of the log, or the map of the location in the folder ``maps`` of the data.

Source: kesai-labs/py123d 0.7.0, ``api/scene/arrow`` and ``api/map/arrow`` (the format only).
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MapError, TraceError
from sgstore.mcap import log_files, mark_of
from sgstore.readers._arrow_files import read_arrow_file, values
from sgstore.readers._boxes import (
    EGO,
    EGO_TYPE,
    NAME,
    Boxes,
    interpolated,
    joined,
    steps_of,
    turned,
    unit,
)
from sgstore.readers._file import NumberedFile
from sgstore.readers.py123d._map import Lanes, read_lanes
from sgstore.readers.py123d._msgpack import unpacked

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.world import Floats

FRAME, MAP = "py123d.Frame", "py123d.Map"
"""Names of the message schemas of frames and of the map."""
FURTHEST: Final = 1_000_000_000
"""Largest time between two interpolated states of the ego, and largest age of a light state; ns."""

_BOX_KEY, _EGO_KEY, _LIGHT_KEY = "box_detections_se3", "ego_state_se3", "traffic_light_detections"
_STATES: Final = ("green", "yellow", "red", "off", "unknown")
_SCHEMA: Final = b'{"type":"object"}'
_FAULTS: Final = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    OverflowError,
    MapError,
    TraceError,
)


class Py123dFile(NumberedFile):
    """Log of 123D that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path
        Folder of the log, with ``sync.arrow``.

    Attributes
    ----------
    path, size, mtime_ns
        The folder; total size of its files, in bytes; their latest modification time.
    schemas, channels : dict
        ``/py123d/map`` and ``/py123d/DATASET``, with their schemas.
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
        files = {file.stem.partition(".")[0]: file for file in log_files(path) or ()}
        lost: list[str] = []
        about = _metadata(read_arrow_file(files["sync"], (), lost.append), lost)
        self._lights = _Lights(files.get(_LIGHT_KEY), lost)
        self._boxes, self._times = _read_boxes(files, lost)
        self._steps = steps_of(self._times)
        self._map = _map_of(path, files, about, lost)
        dataset = str(about.get("dataset") or "unknown")
        named = {"/py123d/map": MAP} if self._map.text else {}
        named[f"/py123d/{dataset}"] = FRAME
        told = {NAME: str(about.get("log_name") or path.name), "dataset": dataset}
        self.add_channels(named, len(self._steps), told, dict.fromkeys((FRAME, MAP), _SCHEMA))
        self.losses += lost

    def message(self, number: int) -> bytes:
        """Return the bytes of a message, given its number: 0 is the map, the others are frames."""
        if number == 0:
            return self._map.text
        time = self.time_of(number)
        shown = self._lights.at(time)
        lights = [
            {"id": lane, **dict(zip("xyz", self._map.starts[lane], strict=True)), "state": state}
            for lane, state in shown.items()
            if lane in self._map.starts
        ]
        more = {"lights": lights} if lights else {}
        return self._boxes.message(time, EGO, self._steps[number - 1].tolist(), **more)

    def time_of(self, number: int) -> int:
        """Return the time of a frame, given its number (from 1); ns."""
        return int(self._times[self._steps[number - 1][0]])


def _metadata(table: Any, lost: list[str]) -> dict[str, Any]:
    """Return the metadata in the schema of a file. Damaged metadata are empty, and reported as lost."""
    try:
        told = unpacked((table.schema.metadata or {})[b"metadata"])
        if isinstance(told, dict):
            return told
        raise ValueError("no table")
    except (ValueError, LookupError) as error:
        lost.append(f"metadata of a file cannot be read: {error}"[:200])
        return {}


def _column(table: Any, key: str, name: str) -> list[Any]:
    return values(table, f"{key}.{name}")


def _times_of(table: Any, key: str) -> Any:
    """Return the times in a table; ns. A missing time is -1."""
    told = _column(table, key, "timestamp_us")
    return np.array([one * 1000 if _is_time(one) else -1 for one in told], np.int64)


def _is_time(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value < 1 << 52


def _read_boxes(files: dict[str, Path], lost: list[str]) -> tuple[Boxes, Any]:
    """Return all boxes of a log, with the ego, and the time of each box; ns. Report damage as lost."""
    ident: list[str] = []
    kind: list[str] = []
    times: list[int] = []
    rows: list[list[float]] = []
    frames: Any = np.zeros(0, np.int64)
    if _BOX_KEY in files:
        names = ("timestamp_us", "bounding_box_se3", "track_token", "label", "velocity_3d")
        table = read_arrow_file(
            files[_BOX_KEY], [f"{_BOX_KEY}.{name}" for name in names], lost.append
        )
        labels = _labels(_metadata(table, lost))
        frames = _times_of(table, _BOX_KEY)
        columns = [_column(table, _BOX_KEY, name) or [] for name in names[1:]]
        for time, *told in zip(frames.tolist(), *columns, strict=True):
            boxes, tracks, codes, velocities = (one or [] for one in told)
            if time < 0 or len({len(boxes), len(tracks), len(codes)}) > 1:
                lost.append("a frame of boxes has no time, or columns of different lengths")
                continue
            velocities = velocities if len(velocities) == len(boxes) else [None] * len(boxes)
            for track, code, box, velocity in zip(tracks, codes, boxes, velocities, strict=True):
                ident.append(str(track))
                kind.append(labels.get(code, f"LABEL_{code}"))
                times.append(time)
                rows.append([*_numbers(box, 10), *_numbers(velocity, 3), *[np.nan] * 4])
    if _EGO_KEY in files:
        own = _ego_states(files[_EGO_KEY], frames[frames >= 0], lost)
        ident += [EGO] * len(own[0])
        kind += [EGO_TYPE] * len(own[0])
        times += own[0].tolist()
        rows += own[1].tolist()
    told = np.array(rows, np.float64).reshape(-1, 17)
    turn = unit(told[:, 3:7])
    seen: set[tuple[int, str]] = set()
    usable = [
        row
        for row, is_known in enumerate(
            (np.isfinite(told[:, :3]).all(axis=1) & np.isfinite(turn[:, 0])).tolist()
        )
        if is_known
        and (times[row], ident[row]) not in seen
        and not seen.add((times[row], ident[row]))
    ]
    if len(usable) < len(rows):
        lost.append(f"{len(rows) - len(usable)} boxes without a pose, or twice in a frame")
    boxes = Boxes(
        *([ident[row] for row in usable], [kind[row] for row in usable]),
        *(told[usable, :3], turn[usable], told[usable, 7:10], told[usable, 10:]),
    )
    return boxes, np.array(times, np.int64)[usable]


def _numbers(told: Any, count: int) -> list[float]:
    """Return a list of numbers with a given length. It is all NaN if missing or malformed."""
    if not isinstance(told, list) or len(told) != count:
        return [np.nan] * count
    return [np.nan if one is None else float(one) for one in told]


def _ego_states(path: Path, frames: Any, lost: list[str]) -> tuple[Any, Floats]:
    """Return the frame times, and the ego's box, velocity, acceleration and yaw rate at each.

    Without times of boxes, the frames are those of the ego.
    """
    columns = [f"{_EGO_KEY}.{name}" for name in ("timestamp_us", "imu_se3", "dynamic_state_se3")]
    table = read_arrow_file(path, columns, lost.append)
    about, times = _metadata(table, lost), _times_of(table, _EGO_KEY)
    poses = np.array(
        [_numbers(one, 7) for one in _column(table, _EGO_KEY, "imu_se3")], np.float64
    ).reshape(-1, 7)
    motion = np.full((len(poses), 9), np.nan)
    if table.schema.get_field_index(columns[2]) >= 0:
        told = _column(table, _EGO_KEY, "dynamic_state_se3")
        motion = np.array([_numbers(one, 9) for one in told], np.float64).reshape(-1, 9)
    poses[:, 3:] = unit(poses[:, 3:])
    kept = np.flatnonzero((times >= 0) & np.isfinite(poses).all(axis=1))
    kept = kept[np.argsort(times[kept], kind="stable")]
    times, poses, motion = times[kept], poses[kept], motion[kept]
    at = np.unique(frames) if len(frames) else np.unique(times)
    imu = interpolated(times, poses, at, FURTHEST)
    states = np.full((len(at), 9), np.nan)
    for column in range(9 if len(times) else 0):
        states[:, column] = np.interp(at, times, motion[:, column])
    centre = np.tile(_numbers(about.get("center_to_imu_se3"), 7), (len(at), 1))
    if not np.isfinite(centre).all():
        centre[:] = (0, 0, 0, 1, 0, 0, 0)
        lost.append("the place of the ego's box is unknown; its sensor is taken as the centre")
    turn = joined(imu[:, 3:], centre[:, 3:])
    size = [_number(about.get(name)) for name in ("length", "width", "height")]
    moving = [turned(imu[:, 3:], states[:, i : i + 3]) for i in (0, 3)]
    place = imu[:, :3] + turned(imu[:, 3:], centre[:, :3])
    columns = [place, turn, np.tile(size, (len(at), 1)), *moving, states[:, 8:9]]
    return at, np.hstack(columns)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else np.nan


class _Lights:
    """States of traffic lights by lane over time. Each state is valid for one second."""

    def __init__(self, path: Path | None, lost: list[str]) -> None:
        self._times: Any = np.zeros(0, np.int64)
        self._shown: list[dict[str, str]] = []
        if path is None:
            return
        names = [f"{_LIGHT_KEY}.{name}" for name in ("timestamp_us", "lane_id", "status")]
        try:
            table = read_arrow_file(path, names, lost.append)
            times = _times_of(table, _LIGHT_KEY)
            lanes, states = (_column(table, _LIGHT_KEY, name) for name in ("lane_id", "status"))
        except TraceError as error:
            lost.append(f"states of traffic lights: {error.reason}")
            return
        for told, codes in zip(lanes, states, strict=True):
            pairs = zip(told or [], codes or [], strict=False)
            self._shown.append(
                {str(lane): _STATES[code] for lane, code in pairs if code is not None and code < 5}
            )
        order = np.argsort(times, kind="stable")
        self._times, self._shown = times[order], [self._shown[row] for row in order.tolist()]

    def at(self, time_ns: int) -> dict[str, str]:
        """Return the states of lights at a time: lane → state."""
        row = int(np.searchsorted(self._times, time_ns, side="right")) - 1
        if row < 0 or not 0 <= time_ns - self._times[row] <= FURTHEST:
            return {}
        return self._shown[row]


@cache
def _label_sets() -> dict[str, list[str]]:
    text = resources.files("sgstore.readers").joinpath("py123d_labels.toml").read_text("utf-8")
    return tomllib.loads(text)


def _labels(about: dict[str, Any]) -> dict[int, str]:
    """Return the names of box labels: number → name; empty if the metadata name an unknown set of labels."""
    name = str(about.get("box_detection_label_class", "")).rpartition(".")[2]
    return dict(enumerate(_label_sets().get(name, [])))


def _map_of(path: Path, files: dict[str, Path], about: dict[str, Any], lost: list[str]) -> Lanes:
    """Return the road map of a log; empty if it has none. A damaged map is reported as lost."""
    file = files.get("map")
    dataset, location = (str(about.get(key) or "") for key in ("dataset", "location"))
    if file is None and dataset and location and "/" not in dataset + location:
        for folder in path.resolve().parents[:4]:
            beside = folder / "maps" / dataset / f"{dataset}_{location}.arrow"
            file = beside if file is None and beside.is_file() else file
    if file is None:
        return Lanes(b"", {})
    try:
        return read_lanes(
            read_arrow_file(file, ("object_id", "map_layer", "features"), lost.append), lost
        )
    except _FAULTS as error:
        lost.append(f"{file.name}: the map cannot be read: {error}"[:200])
        return Lanes(b"", {})
