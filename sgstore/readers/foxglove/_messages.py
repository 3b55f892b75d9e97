"""Decoder of Foxglove messages in protobuf and JSON, and the tree of coordinate axes (transforms).

The tree of ``foxglove.FrameTransform`` contains axes that move in other axes. It returns the pose of any axes
at any time. Between two transforms, a pose is interpolated: positions linearly, rotations along the shorter
arc. Before the first and after the last transform, the nearest one is used.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.readers._blocks import FAR, UPRIGHT
from sgstore.readers.osi._schema import DECODE_ERRORS, check_size, message_class

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcap.records import Schema

    from sgstore.mcap import Recording
    from sgstore.model.world import Floats


MAX_AXES: Final = 10_000
"""Maximum number of coordinate axes in a recording. Further axes are ignored."""
MAX_DEPTH: Final = 64
"""Maximum number of transforms between any coordinate axes and the fixed axes."""
MAX_KEPT: Final = 4096
"""Maximum number of stored transforms between two coordinate axes."""

Pose = tuple["Floats", "Floats"]
"""Position (3,) and rotation (4,). The rotation is a quaternion x, y, z, w of length 1."""

STILL: Final = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN: Final = np.zeros(3)


@dataclass(slots=True)
class _Track:
    """Poses of coordinate axes relative to their parent axes, sorted by time."""

    parent: str
    times: list[int] = field(default_factory=list[int])
    poses: list[Pose] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]

    def at(self, time_ns: int) -> Pose:
        behind = bisect_left(self.times, time_ns)
        if behind == len(self.times):
            return self.poses[-1]
        if behind == 0 or self.times[behind] == time_ns:
            return self.poses[behind]
        start, stop = self.times[behind - 1], self.times[behind]
        share = (time_ns - start) / (stop - start)
        (p0, q0), (p1, q1) = self.poses[behind - 1], self.poses[behind]
        q1 = -q1 if float(q0 @ q1) < 0 else q1
        return p0 + share * (p1 - p0), normed(q0 + share * (q1 - q0))


@dataclass(slots=True)
class Axes:
    """Tree of the coordinate axes of a recording, with their poses over time.

    Attributes
    ----------
    parents : dict
        Axes → their parent axes, from the first transform.
    """

    parents: dict[str, str] = field(default_factory=dict[str, str])
    _tracks: dict[str, _Track] = field(default_factory=dict[str, _Track])

    def tell(self, child: str, parent: str, time_ns: int, pose: Pose) -> bool:
        """Add the pose of coordinate axes relative to their parent. Return False if the pose is rejected."""
        track = self._tracks.get(child)
        if track is None:
            if len(self._tracks) >= MAX_AXES or child == parent:
                return False
            track = self._tracks[child] = _Track(parent)
            self.parents[child] = parent
        if track.parent != parent:
            return False
        at = bisect_left(track.times, time_ns)
        if at < len(track.times) and track.times[at] == time_ns:
            track.poses[at] = pose
        else:
            track.times.insert(at, time_ns)
            track.poses.insert(at, pose)
        if len(track.times) > MAX_KEPT:
            del track.times[: MAX_KEPT // 2], track.poses[: MAX_KEPT // 2]
        return True

    def pose(self, axes: str, root: str, time_ns: int) -> Pose | None:
        """Return the pose of coordinate axes relative to others at a time; ``None`` if not connected."""
        place, turn = ORIGIN, STILL
        for _ in range(MAX_DEPTH):
            if axes == root:
                return place, turn
            track = self._tracks.get(axes)
            if track is None:
                return None
            outer_place, outer_turn = track.at(time_ns)
            place = outer_place + rotated(outer_turn, place)
            turn = product(outer_turn, turn)
            axes = track.parent
        return None

    def root(self) -> str:
        """Return the coordinate axes without parent, if only one has none; otherwise an empty text."""
        roots = set(self.parents.values()) - set(self.parents)
        return roots.pop() if len(roots) == 1 else ""

    def forget(self, before_ns: int) -> None:
        """Delete old poses that are not needed for times from ``before_ns`` on."""
        for track in self._tracks.values():
            keep = bisect_right(track.times, before_ns) - 1
            if keep > 0:
                del track.times[:keep], track.poses[:keep]


def normed(turn: Floats) -> Floats:
    """Scale a quaternion to length 1. A quaternion of length 0 becomes the identity rotation."""
    largest = float(np.abs(turn).max())
    if not 0 < largest < np.inf:
        return STILL
    scaled = turn / largest  # The squares of very small numbers are 0.
    return scaled / np.sqrt(scaled @ scaled)


def product(a: Floats, b: Floats) -> Floats:
    """Multiply two quaternions. The result is rotation b followed by rotation a."""
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def rotated(turn: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (3,) or (n, 3) by a quaternion. An infinite vector becomes NaN."""
    x, y, z, w = turn.tolist()
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    with np.errstate(invalid="ignore", over="ignore"):
        return vectors @ matrix.T


def angles(turn: Floats) -> tuple[float, float, float]:
    """Convert a quaternion to heading, pitch and roll; rad. Pitch is positive with the nose down.

    At a pitch of ±90°, heading and roll have the same axis; the roll is then 0.
    """
    x, y, z, w = turn.tolist()
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    if abs(sine) > UPRIGHT:
        return float(np.arctan2(2 * w * z, w * w - z * z)), float(np.arcsin(sine)), 0.0
    return (
        float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
        float(np.arcsin(sine)),
        float(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
    )


# Conversion of ``foxglove.SceneUpdate`` and ``FrameTransform`` (protobuf or JSON) into the same plain values.
# Source: foxglove-sdk, schemas (SceneUpdate, SceneEntity, SceneEntityDeletion, CubePrimitive, FrameTransform).

SCENE: Final = "foxglove.SceneUpdate"
TRANSFORM: Final = "foxglove.FrameTransform"
TRANSFORMS: Final = "foxglove.FrameTransforms"
READ: Final = frozenset({SCENE, TRANSFORM, TRANSFORMS})

MAX_BYTES: Final = 16 << 20
"""Maximum size of a protobuf message; bytes."""
MAX_JSON: Final = 8 << 20
"""Maximum size of a JSON message; bytes. In memory, it becomes up to thirty times larger."""
MAX_ENTITIES: Final = 100_000
"""Maximum number of entities in a message."""
MAX_PARTS: Final = 10_000
"""Maximum number of cubes, or of other parts, in an entity."""
_PLACE: Final = dict.fromkeys(("x", "y", "z"))
_TURN: Final = dict.fromkeys(("x", "y", "z", "w"))
_SOLID: Final = {"pose": {"position": _PLACE, "orientation": _TURN}, "size": _PLACE}
_SCENE_FIELDS: Final[dict[str, Any]] = {
    "deletions": dict.fromkeys(("timestamp", "type", "id")),
    "entities": {
        **dict.fromkeys(("timestamp", "frame_id", "id", "lifetime", "frame_locked")),
        "metadata": dict.fromkeys(("key", "value")),
        **dict.fromkeys(("cubes", "cylinders", "spheres", "models"), _SOLID),
    },
}
"""Fields of a scene message that are decoded. Lines, triangles and texts remain bytes."""
ERRORS: Final = (*DECODE_ERRORS, RecursionError)
"""Exceptions for a malformed message."""
_DELETE_ALL: Final = 1


@dataclass(frozen=True, slots=True)
class Box:
    """Object of a Foxglove scene with a body: its id, pose, size and metadata.

    Attributes
    ----------
    id, axes : str
        Its id, and the axes (``frame_id``) of its pose.
    time_ns : int or None
        Time of the state; ns. ``None`` means unknown.
    lifetime_ns : int
        Lifetime; ns. 0: until it is replaced.
    locked : bool
        True if it moves with its axes.
    metadata : dict
    pose : (place, turn), or None
        ``None`` means unusable.
    size : tuple of float
        Length, width, height; m. NaN without a size.
    """

    id: str
    axes: str
    time_ns: int | None
    lifetime_ns: int
    locked: bool
    metadata: dict[str, str]
    pose: Pose | None
    size: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Deletion:
    """Deletion in a Foxglove message: of one object or all, if older than a time.

    ``time_ns`` is ``None`` for a deletion without a time, which applies to any age.
    """

    id: str | None
    time_ns: int | None


@dataclass(frozen=True, slots=True)
class SceneUpdate:
    """Foxglove message that adds objects to a scene and deletes others.

    ``bodiless``: number of entities with only lines, texts or arrows.
    """

    boxes: list[Box]
    deletions: list[Deletion]
    bodiless: int


@dataclass(frozen=True, slots=True)
class Transform:
    """Pose of coordinate axes relative to their parent, from a Foxglove message."""

    parent: str
    child: str
    time_ns: int | None
    pose: Pose | None


DERIVED: Final = {"sgstore": "derived"}
"""Metadata that mark channels which an export of sgstore has added, such as drawn scene graphs."""


def encoding_of(recording: Recording, channel: int) -> str:
    """Return ``protobuf`` or ``json`` for a channel with Foxglove messages, otherwise an empty text."""
    record = recording.channels[channel]
    if DERIVED.items() <= record.metadata.items():
        return ""
    schema = recording.schemas.get(record.schema_id)
    if schema is None or schema.name not in READ:
        return ""
    return record.message_encoding if record.message_encoding in {"protobuf", "json"} else ""


class ChannelReader:
    """Decoder of the Foxglove messages of a channel.

    Parameters
    ----------
    schema : Schema
    encoding : str
        ``protobuf`` or ``json``.

    Raises
    ------
    TraceError
        The protobuf descriptors are malformed.
    """

    def __init__(self, schema: Schema, encoding: str) -> None:
        self.name = schema.name
        fields = _SCENE_FIELDS if schema.name == SCENE else None
        self._class = message_class(schema, fields) if encoding == "protobuf" else None

    def scene(self, data: bytes) -> SceneUpdate:
        """Decode a Foxglove message that adds and deletes objects of a scene.

        Raises
        ------
        Exception
            One of :data:`ERRORS`.
        """
        told = self._parsed(data)
        entities = _list(told, "entities", MAX_ENTITIES)
        deletions = _list(told, "deletions", MAX_ENTITIES)
        found = [_box(entity) for entity in entities]
        boxes = [box for box in found if box is not None]
        return SceneUpdate(
            boxes=boxes,
            deletions=[_deletion(gone) for gone in deletions],
            bodiless=len(found) - len(boxes),
        )

    def transforms(self, data: bytes) -> list[Transform]:
        """Decode a Foxglove message with one or more poses of coordinate axes.

        Raises
        ------
        Exception
            One of :data:`ERRORS`.
        """
        told = self._parsed(data)
        one_of_many = self.name == TRANSFORMS
        several = _list(told, "transforms", MAX_ENTITIES) if one_of_many else [told]
        return [
            Transform(
                parent=str(_get(one, "parent_frame_id", "")),
                child=str(_get(one, "child_frame_id", "")),
                time_ns=_time(_get(one, "timestamp", None)),
                pose=_pose(_get(one, "translation", None), _get(one, "rotation", None)),
            )
            for one in several
        ]

    def _parsed(self, data: bytes) -> Any:
        most = MAX_JSON if self._class is None else MAX_BYTES
        if len(data) > most:
            raise ValueError(f"a message of {len(data)} bytes; at most {most} are read")
        if self._class is not None:
            check_size(data, 0)
            return self._class.FromString(data)
        told = json.loads(data)
        if not isinstance(told, dict):
            raise TypeError(f"expected a JSON object, not {type(told).__name__}")
        return told


def _get(part: Any, name: str, otherwise: Any) -> Any:
    """Return a field of a protobuf message or JSON object, or ``default`` if the field is missing."""
    if isinstance(part, dict):
        return part.get(name, otherwise)
    if part is None:
        return otherwise
    known = part.DESCRIPTOR.fields_by_name.get(name)
    if known is None or (known.has_presence and not part.HasField(name)):
        return otherwise
    return getattr(part, name)


def _list(part: Any, name: str, most: int = MAX_PARTS) -> list[Any]:
    told = _get(part, name, None)
    if told is None:
        return []
    if isinstance(told, (str, bytes, dict)):
        raise TypeError(f"{name} is no list")
    if len(told) > most:
        raise ValueError(f"{len(told)} {name}; at most {most} are read")
    return list(told)


def _box(entity: Any) -> Box | None:
    body = _body(entity)
    if body is None:
        return None
    pairs = _list(entity, "metadata")
    pose, size = body
    return Box(
        id=str(_get(entity, "id", "")),
        axes=str(_get(entity, "frame_id", "")),
        time_ns=_time(_get(entity, "timestamp", None)),
        lifetime_ns=_time(_get(entity, "lifetime", None)) or 0,
        locked=bool(_get(entity, "frame_locked", 0)),
        metadata={str(_get(pair, "key", "")): str(_get(pair, "value", "")) for pair in pairs},
        pose=pose,
        size=size,
    )


def _body(entity: Any) -> tuple[Pose | None, tuple[float, float, float]] | None:
    """Return pose and size of a scene object: those of its largest box, or else of another solid or model."""
    for name in ("cubes", "cylinders", "spheres"):
        solids = _list(entity, name)
        if solids:
            sizes = [_numbers(_get(solid, "size", None), "xyz") for solid in solids]
            largest = max(range(len(solids)), key=lambda i: _volume(sizes[i]))
            length, width, height = sizes[largest]
            return _pose_of(solids[largest]), (length, width, height)
    models = _list(entity, "models")
    return (_pose_of(models[0]), (math.nan, math.nan, math.nan)) if models else None


def _volume(size: list[float]) -> float:
    volume = math.prod(size)
    return volume if math.isfinite(volume) else -1.0


def _pose_of(solid: Any) -> Pose | None:
    pose = _get(solid, "pose", None)
    return _pose(_get(pose, "position", None), _get(pose, "orientation", None))


def _pose(place: Any, turn: Any) -> Pose | None:
    at = np.array(_numbers(place, "xyz"))
    quaternion = np.array(_numbers(turn, "xyzw"))
    if not (np.abs(at) < FAR).all() or not np.isfinite(quaternion).all():
        return None
    return at, normed(quaternion)


def _numbers(part: Any, names: Iterable[str]) -> list[float]:
    return [float(_get(part, name, 0.0)) for name in names]


def _deletion(gone: Any) -> Deletion:
    every = int(_get(gone, "type", 0)) == _DELETE_ALL
    time_ns = _time(_get(gone, "timestamp", None))
    return Deletion(None if every else str(_get(gone, "id", "")), time_ns)


def _time(part: Any) -> int | None:
    """Return a timestamp or duration of a Foxglove message; ns. ``None`` if it is missing.

    Protobuf has ``seconds`` and ``nanos``, JSON ``sec`` and ``nsec``.
    """
    if part is None:
        return None
    seconds = _get(part, "seconds", None)
    if seconds is None:
        seconds, nanos = _get(part, "sec", 0), _get(part, "nsec", 0)
    else:
        nanos = _get(part, "nanos", 0)
    return int(seconds) * 1_000_000_000 + int(nanos)
