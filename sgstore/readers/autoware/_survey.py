"""First reading of an Autoware recording: find the channels of objects and ego pose, and object classes.

Topics are arbitrary, so only the schemas count. The class of an object may change between messages; the most
frequent one is used.

Source: autoware_msgs (message definitions), Autoware Foundation, Apache-2.0.
"""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.readers._base import Lead, Survey, ref_of
from sgstore.readers._ros2 import (
    ColumnReader,
    decode,
    number,
    parse_definition,
    records,
    ros_name,
    short_name,
    text,
)
from sgstore.readers._stamps import Stamps

if TYPE_CHECKING:
    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import Floats
    from sgstore.readers._base import Ref
    from sgstore.readers._ros2 import Struct

OBJECTS: Final = "objects"
POSE_OF_EGO: Final = "pose"
TRANSFORMS: Final = "transforms"
LIGHTS: Final = "lights"
GEAR: Final = "gear"
INDICATORS: Final = "indicators"
HAZARDS: Final = "hazards"

_PACKAGES: Final = ("autoware_", "autoware_auto_")
"""Regular expression of package names of messages. The second prefix is for releases before 2024."""
_NAMES: Final = {
    "perception_msgs/TrackedObjects": OBJECTS,
    "perception_msgs/PredictedObjects": OBJECTS,
    "perception_msgs/DetectedObjects": OBJECTS,
    "perception_msgs/TrafficLightGroupArray": LIGHTS,
    "perception_msgs/TrafficSignalArray": LIGHTS,
    "localization_msgs/KinematicState": POSE_OF_EGO,
    "vehicle_msgs/GearReport": GEAR,
    "vehicle_msgs/TurnIndicatorsReport": INDICATORS,
    "vehicle_msgs/HazardLightsReport": HAZARDS,
}
CONTENTS: Final = {
    **{package + name: content for package in _PACKAGES for name, content in _NAMES.items()},
    "nav_msgs/Odometry": POSE_OF_EGO,
    "tf2_msgs/TFMessage": TRANSFORMS,
}
"""Schema name → type of content."""
RANK: Final = {"DetectedObjects": 1, "PredictedObjects": 2, "TrackedObjects": 3}
"""List type → priority. The frames come from the non-empty list with the highest priority."""

EGO: Final = "ego"
"""Id of the ego in Autoware recordings."""
STATIC: Final = "tf_static"
"""Last part of the topic of static transforms, which is fixed in ROS."""
MAP: Final = "map"
_MOST_CLASSES: Final = 4
_MOST_OBJECTS: Final = 100_000
"""Largest number of objects whose classes are counted. Later objects keep their first class."""
_MOST_AXES: Final = 1000
"""Largest number of coordinate axes whose parents are stored."""
LABELS: Final = (
    *("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian"),
    *("animal", "hazard", "over_drivable", "under_drivable"),
)
"""Names of the values of ``ObjectClassification.label``, by number."""
_UUID: Final = tuple(f"object_id.uuid[{i}]" for i in range(16))
_CLASSES: Final = tuple(
    f"classification[{i}].{field}"
    for i in range(_MOST_CLASSES)
    for field in ("label", "probability")
)
CLASS_COLUMNS: Final = (*_UUID, *_CLASSES)


@dataclass(slots=True)
class ObjectLead(Lead):
    """Channel of an Autoware recording with lists of objects. It may become the frame channel.

    ``order`` is the priority of its list type, ``objects`` its total number of objects.
    """

    order: int = 0
    objects: int = 0


def content_of(recording: Recording, channel: int) -> str:
    """Return the type of content of an Autoware channel (such as objects); empty if it is not supported."""
    return CONTENTS.get(ros_name(recording, channel), "")


def idents_of(table: Floats) -> list[str]:
    """Return the ids of Autoware objects as hexadecimal digits; empty without an id.

    The columns begin with :data:`CLASS_COLUMNS`.
    """
    uuids = table[:, : len(_UUID)]
    known = np.all(np.isfinite(uuids), axis=1, keepdims=True)[:, 0]
    rows = np.nan_to_num(uuids).astype(np.uint8)
    return [row.tobytes().hex() if there else "" for row, there in zip(rows, known, strict=True)]


def labels_of(table: Floats) -> list[str]:
    """Return the most probable class of each Autoware object.

    The columns of the table are as in :func:`idents_of`.
    """
    classes = table[:, len(_UUID) : len(CLASS_COLUMNS)].reshape(len(table), _MOST_CLASSES, 2)
    likely = np.argmax(np.nan_to_num(classes[:, :, 1], nan=-1.0), axis=1)
    label = np.nan_to_num(classes[np.arange(len(table)), likely, 0]).astype(np.int64)
    return [LABELS[one] if 0 <= one < len(LABELS) else LABELS[0] for one in label.tolist()]


def stamp_at(told: dict[str, Any], path: str) -> int | None:
    """Return the time stamp at a path of a decoded message; ns. ``None`` if missing or out of range."""
    seconds, nanos = (number(told, f"{path}.{part}") for part in ("sec", "nanosec"))
    there = 0 <= seconds < 1 << 32 and 0 <= nanos < 1 << 32
    return int(seconds) * 1_000_000_000 + int(nanos) if there else None


class AutowareSurvey(Survey[ObjectLead]):
    """First reading of an Autoware recording. It collects information that the frames need.

    Attributes
    ----------
    contents : dict
        Channel id → content type of its messages, such as :data:`OBJECTS`.
    structures : dict
        Channel id → structure of its messages.
    pose_channel : int
        Id of the channel with the pose of the ego; -1 without one.
    world, ego_axes : str
        The fixed axes, and the axes that move with the ego.
    """

    def __init__(self, recording: Recording, wanted: str) -> None:
        super().__init__(recording, wanted)
        self.contents: dict[int, str] = {}
        self.structures: dict[int, Struct] = {}
        self.pose_channel = -1
        self.world, self.ego_axes = MAP, "base_link"
        self._tables: dict[int, ColumnReader] = {}
        self._poses: dict[int, tuple[str, str, int]] = {}
        self._parents: dict[str, str] = {}
        self._frames: dict[int, str] = {}
        self._classes: dict[str, Counter[str]] = {}
        self._static: list[Ref] = []
        self._looks = 0

    def rank(self, lead: ObjectLead) -> tuple[int, ...]:
        """Return the sort key of a channel. The channel with the greatest key becomes the frame channel."""
        return lead.objects > 0, lead.order, lead.frames

    def label_of(self, ident: str, first: str) -> str:
        """Return an object's most frequent class in the recording; the first class if it is unknown."""
        counts = self._classes.get(ident)
        return max(counts, key=counts.__getitem__) if counts else first

    def find_ego(self) -> str:
        """Find the channel and coordinate axes of the ego pose. Return the id of the ego."""
        found = [
            (parent != MAP, child != "base_link", -count, self.topic(channel), channel)
            for channel, (parent, child, count) in self._poses.items()
        ]
        frame = self._frames.get(self.leading, "")
        roots = set(self._parents.values()) - set(self._parents)
        if found:
            self.pose_channel = min(found)[-1]
            self.world, child, _ = self._poses[self.pose_channel]
            self.ego_axes = child or self.ego_axes
        elif MAP not in roots:
            self.world = roots.pop() if len(roots) == 1 else frame or MAP
        there = bool(found) or self.ego_axes in self._parents
        if self.wanted and self.wanted != EGO and self.wanted not in self._classes:
            raise TraceError(f"no object has the id {self.wanted!r}; the vehicle itself is {EGO!r}")
        if not there and not self.wanted:
            self.about_ego.append(
                "the ego is missing: no pose of the vehicle and no transform of base_link"
            )
        return self.wanted or (EGO if there else "")

    def role(self, channel: int) -> str:
        """Return the role of a channel: frames, sensor data, or ``lasting`` for static transforms."""
        static = self.contents.get(channel) == TRANSFORMS and self.topic(channel).endswith(STATIC)
        return "lasting" if static else super().role(channel)

    def context(self) -> list[Ref]:
        """Return the file positions of static transforms and calibrations. Later messages need them."""
        return [*self._static, *super().context()]

    def meet(self, channel: int) -> bool:
        """Return True if the messages of a channel are objects, poses or transforms."""
        return self._content(channel) in {OBJECTS, POSE_OF_EGO, TRANSFORMS}

    def keeps(self, channel: int) -> bool:
        """Return True if messages of a channel are needed in the second reading, in which frames are made."""
        return bool(self._content(channel))

    def _content(self, channel: int) -> str:
        if channel not in self.contents:
            self.contents[channel] = content = content_of(self.recording, channel)
            if content:
                try:
                    self._learn(channel, content)
                except TraceError as error:
                    self.contents[channel] = ""
                    self.lost.add(f"channel {self.topic(channel)!r}: {error.reason}", 0)
        return self.contents[channel]

    def _learn(self, channel: int, content: str) -> None:
        record = self.recording.channels[channel]
        schema = self.recording.schemas[record.schema_id]
        found = self.structures[channel] = parse_definition(schema.name, schema.data)
        if content == OBJECTS:
            self._tables[channel] = ColumnReader(found, CLASS_COLUMNS, "objects")
            order = RANK[short_name(schema.name).rpartition("/")[2]]
            stamps = self.shared_stamps(channel, Stamps(explicit=False))
            self.leads[channel] = ObjectLead(order=order, stamps=stamps)

    def look(self, run: Messages, row: int) -> None:
        """Collect information from an Autoware message. Unreadable messages are reported later."""
        channel = int(run.channel[row])
        content = self.contents[channel]
        if content == OBJECTS:
            self.count(run, row, 0)
            self.leads[channel].stamps.next()
        with suppress(TraceError):
            if content == OBJECTS:
                self._take_objects(channel, run, row)
            elif content == POSE_OF_EGO:
                self._take_pose(channel, run.data(row))
            else:
                self._take_transforms(channel, run, row)

    def _take_objects(self, channel: int, run: Messages, row: int) -> None:
        head, table = self._tables[channel].read(run.data(row))
        self.see_stamp(run, row, stamp_at(head, "header.stamp"))
        self._frames.setdefault(channel, text(head, "header.frame_id"))
        self.leads[channel].objects += len(table)
        for ident, label in zip(idents_of(table), labels_of(table), strict=True):
            if ident and (ident in self._classes or len(self._classes) < _MOST_OBJECTS):
                counts = self._classes.setdefault(ident, Counter())
                counts[label] += 1

    def _take_pose(self, channel: int, data: memoryview) -> None:
        parent, child, count = self._poses.get(channel, ("", "", 0))
        if not count:
            told = decode(self.structures[channel], data)
            parent, child = text(told, "header.frame_id"), text(told, "child_frame_id")
        self._poses[channel] = parent, child, count + 1

    def _take_transforms(self, channel: int, run: Messages, row: int) -> None:
        static = self.topic(channel).endswith(STATIC)
        self._looks += not static
        if not static and self._looks > _MOST_AXES:
            return  # Moving axes in fixed axes.
        told: list[dict[str, Any]] = records(
            decode(self.structures[channel], run.data(row)), "transforms"
        )
        for one in told[:_MOST_AXES]:
            if len(self._parents) < _MOST_AXES:
                child = text(one, "child_frame_id")
                self._parents.setdefault(child, text(one, "header.frame_id"))
        if static and len(self._static) < _MOST_AXES:
            self._static.append(ref_of(run, row))
