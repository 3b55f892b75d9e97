"""``foxglove.SceneUpdate`` and ``FrameTransform`` in protobuf and in JSON → the same plain values.

Source: foxglove-sdk, schemas (SceneUpdate, SceneEntity, SceneEntityDeletion, CubePrimitive, FrameTransform).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.traces.foxglove_axes import normed
from sgstore.traces.frames import FAR
from sgstore.traces.osi_fields import check_size
from sgstore.traces.osi_schema import DECODE_ERRORS, message_class

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcap.records import Schema

    from sgstore.traces.foxglove_axes import Pose
    from sgstore.traces.recording import Recording

SCENE: Final = "foxglove.SceneUpdate"
TRANSFORM: Final = "foxglove.FrameTransform"
TRANSFORMS: Final = "foxglove.FrameTransforms"
READ: Final = frozenset({SCENE, TRANSFORM, TRANSFORMS})

MAX_BYTES: Final = 16 << 20
"""Greatest size of a protobuf message that is read."""
MAX_JSON: Final = 8 << 20
"""Greatest size of a JSON message that is read; in memory it becomes up to thirty times as large."""
MAX_ENTITIES: Final = 100_000
"""Greatest number of entities of a message."""
MAX_PARTS: Final = 10_000
"""Greatest number of cubes, or of anything else, of an entity."""
_PLACE: Final = dict.fromkeys(("x", "y", "z"))
_TURN: Final = dict.fromkeys(("x", "y", "z", "w"))
_SOLID: Final = {"pose": {"position": _PLACE, "orientation": _TURN}, "size": _PLACE}
_SCENE_FIELDS: Final[dict[str, Any]] = {
    "deletions": dict.fromkeys(("type", "id")),
    "entities": {
        **dict.fromkeys(("timestamp", "frame_id", "id", "lifetime", "frame_locked")),
        "metadata": dict.fromkeys(("key", "value")),
        **dict.fromkeys(("cubes", "cylinders", "spheres", "models"), _SOLID),
    },
}
"""Fields that are read of a scene; lines, triangles and texts stay bytes."""
ERRORS: Final = (*DECODE_ERRORS, RecursionError)
"""What reading a message raises if it is not what it seems."""
_LATEST: Final = 1 << 62
_DELETE_ALL: Final = 1


@dataclass(frozen=True, slots=True)
class Box:
    """An entity of a scene, as far as it has a body.

    Attributes
    ----------
    id, axes : str
        Its id, and the axes (``frame_id``) that its pose is given in.
    time_ns, lifetime_ns : int
        When it was so, and how long it stays; 0: not told, until it is replaced.
    locked : bool
        Whether it moves with its axes.
    metadata : dict
    pose : (place, turn), or None
        ``None`` if that is unusable.
    size : tuple of float
        Length, width, height; m. NaN if it has no size.
    """

    id: str
    axes: str
    time_ns: int
    lifetime_ns: int
    locked: bool
    metadata: dict[str, str]
    pose: Pose | None
    size: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """A ``SceneUpdate``: what is there, and what is there no more.

    ``deleted``: ids; ``cleared``: whether all that was there before is deleted. ``bodiless``: entities that are
    lines, texts or arrows only.
    """

    boxes: list[Box]
    deleted: list[str]
    cleared: bool
    bodiless: int


@dataclass(frozen=True, slots=True)
class Transform:
    """Where axes (``child``) are in others (``parent``)."""

    parent: str
    child: str
    time_ns: int
    pose: Pose | None


DERIVED: Final = {"sgstore": "derived"}
"""Metadata of channels that an export made of a recording, scene graphs to be drawn among them."""


def encoding_of(recording: Recording, channel: int) -> str:
    """``protobuf`` or ``json`` for a channel whose messages are read here, else the empty string."""
    record = recording.channels[channel]
    if DERIVED.items() <= record.metadata.items():
        return ""
    schema = recording.schemas.get(record.schema_id)
    if schema is None or schema.name not in READ:
        return ""
    return record.message_encoding if record.message_encoding in {"protobuf", "json"} else ""


class Reader:
    """Reads the messages of a channel.

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

    def scene(self, data: bytes) -> Scene:
        """A ``SceneUpdate``.

        Raises
        ------
        Exception
            One of :data:`ERRORS`.
        """
        told = self._parsed(data)
        entities = _list(told, "entities", MAX_ENTITIES)
        deletions = _list(told, "deletions", MAX_ENTITIES)
        kinds = [(int(_get(gone, "type", 0)), str(_get(gone, "id", ""))) for gone in deletions]
        found = [_box(entity) for entity in entities]
        boxes = [box for box in found if box is not None]
        return Scene(
            boxes=boxes,
            deleted=[ident for kind, ident in kinds if kind != _DELETE_ALL],
            cleared=any(kind == _DELETE_ALL for kind, _ in kinds),
            bodiless=len(found) - len(boxes),
        )

    def transforms(self, data: bytes) -> list[Transform]:
        """A ``FrameTransform``, or several in one message.

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
    """A field of a message or of a JSON object; a sub-message that is missing is ``otherwise``."""
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
        lifetime_ns=_time(_get(entity, "lifetime", None)),
        locked=bool(_get(entity, "frame_locked", 0)),
        metadata={str(_get(pair, "key", "")): str(_get(pair, "value", "")) for pair in pairs},
        pose=pose,
        size=size,
    )


def _body(entity: Any) -> tuple[Pose | None, tuple[float, float, float]] | None:
    """Pose and size of what an entity is: of its largest box, else of another solid, else of a model."""
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


def _time(part: Any) -> int:
    """A timestamp or duration; ns. Protobuf has ``seconds`` and ``nanos``, JSON ``sec`` and ``nsec``."""
    if part is None:
        return 0
    seconds = _get(part, "seconds", None)
    if seconds is None:
        seconds, nanos = _get(part, "sec", 0), _get(part, "nsec", 0)
    else:
        nanos = _get(part, "nanos", 0)
    time_ns = int(seconds) * 1_000_000_000 + int(nanos)
    return time_ns if abs(time_ns) < _LATEST else 0
