"""Logs of annotated boxes: quaternions, JSON messages of frames, and the base class of the readers.

A message has a time, the id of the ego, and boxes with the arguments of :meth:`sgstore.Frame.add`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from sgstore.graphs.online import Frame
from sgstore.maps.roads import OF_LANES
from sgstore.model.vocabulary import TypeMeaning, type_meanings
from sgstore.readers._base import FramesTrace, TraceMessage
from sgstore.readers._blocks import UPRIGHT

if TYPE_CHECKING:
    from sgstore.mcap import Recording
    from sgstore.model.world import Floats

EGO: Final = "ego"
"""Id of the ego in logs that have no id for it."""
EGO_TYPE: Final = "EGO_VEHICLE"
"""Type name of the ego in logs of Argoverse 2 and 123D."""
NAME, NOTE, ORIGIN = "name", "note", "dataset"
"""Metadata keys of a channel: name of the log, remark, and name of the data set."""

_NUMBERS: Final = (
    *("x", "y", "z", "heading", "pitch", "roll", "length", "width", "height"),
    *("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"),
)


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes of one or more frames as columns, in the axes of the map.

    Attributes
    ----------
    ident, type : list of str
    centre : (n, 3) float64
        Centres; m.
    turn : (n, 4) float64
        Quaternions, scalar first.
    size : (n, 3) float64
        Length, width and height; m.
    motion : (n, 7) float64 or None
        Velocity, acceleration (m/s, m/s²) and yaw rate (rad/s).
    """

    ident: list[str]
    type: list[str]
    centre: Floats
    turn: Floats
    size: Floats
    motion: Floats | None = None

    def message(self, time_ns: int, ego: str, rows: list[int], **more: Any) -> bytes:
        """Return the boxes in some rows as one frame, as JSON text. Unknown numbers are left out."""
        values = np.hstack(
            [self.centre[rows], np.degrees(angles_of(self.turn[rows])), self.size[rows]]
        )
        if self.motion is not None:
            motion = self.motion[rows].copy()
            motion[:, 6] = np.degrees(motion[:, 6])
            values = np.hstack([values, motion])
        known = np.isfinite(values).tolist()
        boxes = [
            {"id": self.ident[row], "type": self.type[row]}
            | {n: v for n, v, k in zip(_NUMBERS, told, is_known, strict=False) if k}
            for row, told, is_known in zip(rows, values.tolist(), known, strict=True)
        ]
        told = {"time_ns": time_ns, "ego": ego, "boxes": boxes, **more}
        return json.dumps(told, allow_nan=False, separators=(",", ":")).encode()


def turned(turn: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (n, 3) by quaternions (n, 4), scalar first."""
    w, axis = turn[:, :1], turn[:, 1:]
    across = 2 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)


def joined(first: Floats, then: Floats) -> Floats:
    """Multiply quaternions (n, 4), scalar first: rotation ``first``, then ``then`` in the rotated axes."""
    w = first[:, :1] * then[:, :1] - (first[:, 1:] * then[:, 1:]).sum(axis=1, keepdims=True)
    axis = first[:, :1] * then[:, 1:] + then[:, :1] * first[:, 1:]
    return np.hstack([w, axis + np.cross(first[:, 1:], then[:, 1:])])


def unit(turn: Floats) -> Floats:
    """Scale quaternions (n, 4) to length 1; NaN if the length is far from 1."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        length = np.sqrt((turn * turn).sum(axis=1, keepdims=True))
        return np.where((length > 0.5) & (length < 2), turn / length, np.nan)


def angles_of(turn: Floats) -> Floats:
    """Convert quaternions (n, 4), scalar first, to heading, pitch and roll (n, 3); rad."""
    w, x, y, z = turn.T
    with np.errstate(invalid="ignore"):
        sine = np.clip(2 * (w * y - z * x), -1, 1)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        upright = np.abs(sine) > UPRIGHT
        heading = np.where(upright, np.arctan2(2 * w * z, w * w - z * z), heading)
    return np.stack([heading, np.arcsin(sine), np.where(upright, 0.0, roll)], axis=1)


def interpolated(times: Any, poses: Floats, at: Any, furthest: float) -> Floats:
    """Interpolate poses (n, 7: position and quaternion) at given times.

    The result is NaN outside the times, and between poses more than ``furthest`` apart.
    """
    if not len(times):
        return np.full((len(at), 7), np.nan)
    after = np.searchsorted(times, at)
    low, high = np.maximum(after - 1, 0), np.minimum(after, len(times) - 1)
    low = np.where(times[high] == at, high, low)
    gap = (times[high] - times[low]).astype(np.float64)
    share = np.where(gap > 0, (at - times[low]) / np.where(gap > 0, gap, 1), 0.0)[:, None]
    first, last = poses[low], poses[high].copy()
    last[:, 3:] *= np.where((first[:, 3:] * last[:, 3:]).sum(axis=1, keepdims=True) < 0, -1, 1)
    mixed = np.where(share == 0, first, first + share * (last - first))
    mixed[:, 3:] = unit(mixed[:, 3:])
    outside = (at < times[0]) | (at > times[-1]) | (gap > furthest)
    mixed[outside] = np.nan
    return mixed


def steps_of(times: Any) -> list[Any]:
    """Return the rows of each time, in ascending order of times. Rows with a time below 0 are left out."""
    order = np.argsort(times, kind="stable")
    order = order[times[order] >= 0]
    return np.split(order, np.flatnonzero(np.diff(times[order])) + 1) if len(order) else []


class BoxesTrace(FramesTrace):
    """Base class of readers for logs with annotated boxes. Channel metadata contain the name of the log.

    Attributes
    ----------
    tables : tuple of str
        Prefixes of type names in the vocabulary, in the order of their priority.
    """

    tables: ClassVar[tuple[str, ...]] = ()

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        super().__init__(recording, ego=ego, digest=digest)
        if self.info.map_text:
            names = (channel.metadata.get(NAME, "") for channel in recording.channels.values())
            name = next(filter(None, names), recording.path.stem)
            self.info = replace(self.info, map_name=f"{name}{OF_LANES}")

    def decoder(self, report: Any) -> Any:
        """Return a new decoder of frames. Add the note of the log to a report."""
        note = next((c.metadata.get(NOTE, "") for c in self.recording.channels.values()), "")
        report.warnings += [note] if note else []
        return super().decoder(report)

    def frame(self, message: TraceMessage) -> Frame:
        """Convert a message of the log (JSON with boxes) to a frame."""
        told = json.loads(message.data)
        here = {one["id"] for one in told["boxes"]}
        frame = Frame(told["time_ns"], told["ego"] if told["ego"] in here else None)
        for one in told["boxes"]:
            meaning = self._meaning(one["type"])
            about = {"special": meaning.special, "subkind": meaning.subkind}
            values = {name: one[name] for name in _NUMBERS if name in one}
            frame.add(one["id"], meaning.kind, **about, type_name=one["type"], **values)
        self.add_lights(frame, told)
        return frame

    def _meaning(self, type_name: str) -> TypeMeaning:
        known = (type_meanings().get(f"{table}_{type_name}".lower()) for table in self.tables)
        return next(filter(None, known), TypeMeaning("unknown"))

    def add_lights(self, frame: Frame, told: dict[str, Any]) -> None:
        """Add the traffic lights of a message to a frame. This base class adds none."""
