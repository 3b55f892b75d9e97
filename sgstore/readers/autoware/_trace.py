"""Reader of Autoware recordings (``autoware_perception_msgs`` and related messages).

They are recorded with ``ros2 bag record -s mcap``. A frame is one list of objects: tracked objects if present,
else predicted, else detected ones. Its time is the stamp of the list.

* Objects may be given in moving axes. They are converted into fixed axes by the interpolated pose of the ego
  and the tree of transforms; messages logged before the next list count. After the last pose, the motion of the
  ego is extrapolated for at most half a second.
* Velocities and accelerations of objects are in their own axes, those of the ego in its own. If the sign of an
  object's heading is unknown, its front points in the direction of motion.
* The origin of the vehicle is the middle of its rear axle on the ground. A recording does not contain the size
  of the vehicle. It comes from a mapping, or equals that of Autoware's sample vehicle.
* Detected objects have no ids. A detection continues the nearest one of the same class in the previous list, by
  position and velocity, if it is close enough.
* The position of a traffic light group is that of the regulatory element with its id in the road map.

Source: autoware_msgs (message definitions) and sample_vehicle_description (vehicle_info.param.yaml), Autoware
Foundation, Apache-2.0.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.model.vocabulary import LIGHT_STATE_CODE, VEHICLE_LIGHTS, TypeMeaning, type_meanings
from sgstore.model.world import POSE
from sgstore.readers._base import SurveyedDecoder, SurveyedTrace, light_places
from sgstore.readers._blocks import FAR, NAN, FrameRows
from sgstore.readers._ros2 import ColumnReader, decode, ident_of, number, records, text
from sgstore.readers._stamps import NO_TIME
from sgstore.readers.autoware._survey import (
    CLASS_COLUMNS,
    EGO,
    GEAR,
    HAZARDS,
    INDICATORS,
    LIGHTS,
    OBJECTS,
    TRANSFORMS,
    AutowareSurvey,
    content_of,
    idents_of,
    labels_of,
    stamp_at,
)
from sgstore.readers.foxglove._mapping import Ego, mapping_for
from sgstore.readers.foxglove._messages import Axes, Pose, normed, product, rotated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import Bools, Floats, Ints, TraceReport
    from sgstore.readers._blocks import Called

SAMPLE_VEHICLE: Final = Ego(
    type="sample_vehicle", length=4.89, width=1.896, height=2.5, offset=(1.345, 0.0, 1.25)
)
"""Wheel base 2.79; overhangs 1.0 (front), 1.1 (rear), 0.128 (sides); tread 1.64; height 2.5; m."""

_VECTOR: Final = ("x", "y", "z")
_TOLD: Final = ("kinematics.pose_with_covariance", "kinematics.initial_pose_with_covariance")
_TURNED: Final = ("twist_with_covariance", "initial_twist_with_covariance")
_PUSHED: Final = ("acceleration_with_covariance", "initial_acceleration_with_covariance")
_BOX_BEGINS: Final = len(CLASS_COLUMNS)

_HOLDS_NS: Final = 500_000_000
"""Longest time over which the ego's motion is extrapolated; ns."""
_LIT_NS: Final = 2_000_000_000
"""Time for which a light state or vehicle report stays valid; ns."""
_MOST_KEPT: Final = 4096
_REMEMBERED_NS: Final = 20_000_000_000
"""Time for which poses are stored; ns."""
_POLYGON: Final = 2
_NO_HEADING, _NO_SIGN = 0, 1
_NEAR: Final = 2.0
"""Maximum distance of a detection from the previous one, or from its extrapolated position; m."""

_COLOURS: Final = {1: "red", 2: "yellow", 3: "green"}
_CIRCLE, _OFF, _FLASHING = 1, 1, 3


def _columns(predicted: bool) -> tuple[str, ...]:  # noqa: FBT001 (one of two definitions)
    """Return the paths of the numeric fields that the reader needs from an Autoware object."""
    pose = f"{_TOLD[predicted]}.pose"
    twist = f"kinematics.{_TURNED[predicted]}.twist"
    pushed = f"kinematics.{_PUSHED[predicted]}.accel.linear"
    return (
        *CLASS_COLUMNS,
        *(f"{pose}.position.{axis}" for axis in _VECTOR),
        *(f"{pose}.orientation.{part}" for part in (*_VECTOR, "w")),
        *(f"{twist}.linear.{axis}" for axis in _VECTOR),
        f"{twist}.angular.z",
        *(f"{pushed}.{axis}" for axis in _VECTOR),
        *(f"shape.dimensions.{axis}" for axis in _VECTOR),
        "shape.type",
        "kinematics.orientation_availability",
        "kinematics.has_twist",
        "existence_probability",
        *(f"{_TOLD[predicted]}.covariance[{place}]" for place in _COVARIANCES.values()),
    )


_COVARIANCES: Final = {
    "covariance_x": 0,
    "covariance_xy": 1,
    "covariance_y": 7,
    "covariance_heading": 35,
}
"""Attribute → index in the covariance matrix of the pose, in the axes of the objects; m², rad²."""


def _perceived(objects: Floats) -> list[dict[str, float]]:
    """Return existence probability and covariances of each object. A zero means unknown."""
    names = ("existence_probability", *_COVARIANCES)
    rows = objects[:, -len(names) :].tolist()
    return [{name: value for name, value in zip(names, row, strict=True) if value} for row in rows]


@dataclass(slots=True)
class AutowareRawFrame:
    """Frame of an Autoware recording before conversion. Its objects have their original coordinate axes.

    Attributes
    ----------
    time_ns, log_time_ns : int
    node : (n,) int64
    objects : (n, 25) float64
        Columns of the objects after their classes.
    axes : str
        Axes of the objects.
    lights : dict
        Node id of each traffic light group → code of its state.
    signals, gear
        Lights and gear of the ego; -1 and NaN mean unknown.
    base, ego : Pose or None
        Poses of ``axes`` and of the ego in the world, once they are known.
    motion : (7,) float64
        Velocity, yaw rate and acceleration of the ego in its own axes.
    kinds : dict
        As in :class:`~sgstore.readers._blocks.FrameRows`.
    """

    time_ns: int
    log_time_ns: int
    node: Ints
    objects: Floats
    axes: str
    lights: dict[int, int]
    signals: int = -1
    gear: float = NAN
    base: Pose | None = None
    ego: Pose | None = None
    motion: Floats = field(default_factory=lambda: np.full(7, np.nan))
    kinds: dict[int, Called] = field(default_factory=dict[int, "Called"])


@dataclass(slots=True)
class _Detection:
    """Object of the previous detection message. Detections have no ids, so ``ident`` is assigned."""

    ident: str
    label: str
    place: Floats
    velocity: Floats


class AutowareDecoder(SurveyedDecoder[AutowareRawFrame, AutowareSurvey]):
    """Decoder of Autoware messages into frames.

    The class of an object is a guess of the perception. The most frequent class is used.

    Parameters
    ----------
    survey : AutowareSurvey
    ego : Ego
        Size of the ego.
    types : mapping
        Classes of objects with a meaning from the user.
    places : mapping
        Traffic light id in the road map → position.
    report : TraceReport
        Receives losses and warnings.
    """

    sure_kinds: ClassVar[bool] = False
    measures: ClassVar[bool] = True

    def __init__(
        self,
        survey: AutowareSurvey,
        ego: Ego,
        types: Mapping[str, TypeMeaning],
        places: Mapping[str, tuple[float, float, float]],
        report: TraceReport,
    ) -> None:
        super().__init__(survey, report)
        self._box, self._types, self._places = ego, types, places
        structure = survey.structures[survey.leading]
        self._table = ColumnReader(structure, _columns("Predicted" in structure.name), "objects")
        self._take = self._takers()
        self.channels = self._leading | {*self._take}
        self._axes = Axes()
        self._motions: tuple[list[int], list[Floats]] = ([], [])
        self._nodes: dict[str, int] = {}
        self._shown: dict[int, tuple[int, int]] = {}
        self._unplaced: set[str] = set()
        self._reports: dict[str, tuple[int, int]] = {}
        self._open: AutowareRawFrame | None = None
        self._seen: tuple[int, list[_Detection]] = (0, [])
        self._followed = 0

    def decode(self, run: Messages, row: int) -> AutowareRawFrame | None:
        """Return the frame in an Autoware message, before conversion; ``None`` if no frame, or unreadable."""
        channel, log_time = int(run.channel[row]), int(run.log_time_ns[row])
        if channel in self._leading:
            self._stamps.next()
        try:
            take = self._take.get(channel)
            if take is not None:
                take(channel, log_time, run.data(row))
            elif self.is_inside(log_time):
                self._settle_open()
                self._open = self._raw(log_time, run.data(row))
                return self._open
        except TraceError as error:
            topic = self._survey.topic(channel)
            self.lose(f"a message of {topic!r} cannot be read: {error.reason}", run, row)
        return None

    def complete(self, frames: list[AutowareRawFrame]) -> list[FrameRows]:
        """Convert Autoware frames: compute poses and speeds in fixed map axes."""
        if frames and frames[-1] is self._open:  # The last frame.
            self._settle_open()
        return [self._rows(frame) for frame in frames]

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        super().settle()
        warn = self._report.warnings.append
        if self._unplaced:
            warn(
                f"{len(self._unplaced)} traffic light groups are no traffic lights of the road map: what they"
                " show is in no graph"
            )
        if self._followed:
            warn("detected objects have no ids; they were tracked by position and class")

    def _takers(self) -> dict[int, Callable[[int, int, memoryview], None]]:
        """Return the function that processes the messages of each channel, except the frame channel."""
        takers = {
            TRANSFORMS: self._take_transforms,
            LIGHTS: self._take_lights,
            **dict.fromkeys((GEAR, INDICATORS, HAZARDS), self._take_report),
        }
        found = {
            channel: takers[content]
            for channel, content in self._survey.contents.items()
            if content in takers
        }
        if self._survey.pose_channel >= 0:
            alike = self._survey.alike(self._survey.pose_channel)
            found |= dict.fromkeys(alike, self._take_pose)
        return found

    def _decoded(self, channel: int, data: memoryview) -> dict[str, Any]:
        return decode(self._survey.structures[channel], data)

    def _stamp(self, told: dict[str, Any], path: str, log_time: int) -> int:
        """Return the simulation time of a message that is not in the frame channel; ns."""
        return self._stamps.beside(log_time, stamp_at(told, path))

    def _take_transforms(self, channel: int, log_time: int, data: memoryview) -> None:
        for told in records(self._decoded(channel, data), "transforms"):
            child = text(told, "child_frame_id")
            if self._survey.pose_channel >= 0 and child == self._survey.ego_axes:
                continue
            pose = _pose_at(told, "transform.translation", "transform.rotation")
            if pose is not None:
                parent = text(told, "header.frame_id")
                self._axes.tell(child, parent, self._stamp(told, "header.stamp", log_time), pose)

    def _take_pose(self, channel: int, log_time: int, data: memoryview) -> None:
        told = self._decoded(channel, data)
        name = "pose" if "pose" in told else "pose_with_covariance"
        pose = _pose_at(told, f"{name}.pose.position", f"{name}.pose.orientation")
        if pose is None:
            raise TraceError("its pose is invalid")
        stamp = self._stamp(told, "header.stamp", log_time)
        self._axes.tell(self._survey.ego_axes, self._survey.world, stamp, pose)
        twist = f"{name.replace('pose', 'twist')}.twist"
        paths = [f"{twist}.linear.{axis}" for axis in _VECTOR]
        paths += [f"{twist}.angular.z"]
        paths += [f"accel_with_covariance.accel.linear.{axis}" for axis in _VECTOR]
        times, motions = self._motions
        if not times or stamp > times[-1]:
            times.append(stamp)
            motions.append(np.array([number(told, path) for path in paths]))
        if len(times) > _MOST_KEPT:
            del times[: _MOST_KEPT // 2], motions[: _MOST_KEPT // 2]

    def _take_lights(self, channel: int, log_time: int, data: memoryview) -> None:
        told = self._decoded(channel, data)
        stamp = self._stamp(told, "stamp", log_time)
        for group in (*records(told, "traffic_light_groups"), *records(told, "signals")):
            ident = ident_of(group, "traffic_light_group_id")
            ident = ident_of(group, "traffic_signal_id") if ident is None else ident
            if ident is None:
                continue
            name = str(ident)
            if name not in self._places:
                self._unplaced.add(name)
                continue
            if name not in self._nodes:
                meaning = TypeMeaning("traffic_light")
                self._nodes[name] = self.roster.enter(name, meaning, "traffic_light_group", name)
            state = LIGHT_STATE_CODE[_state_of(records(group, "elements"))]
            self._shown[self._nodes[name]] = stamp, state

    def _take_report(self, channel: int, log_time: int, data: memoryview) -> None:
        told = self._decoded(channel, data)
        value = number(told, "report")
        if np.isfinite(value):
            stamp = self._stamp(told, "stamp", log_time)
            self._reports[self._survey.contents[channel]] = stamp, int(value)

    def _raw(self, log_time: int, data: memoryview) -> AutowareRawFrame:
        head, table = self._table.read(data)
        if (table[:, _BOX_BEGINS + 17] == _POLYGON).any():
            self._measure(table, data)
        stamp = self._stamps.time(log_time, stamp_at(head, "header.stamp"))
        if stamp is None:
            raise TraceError(NO_TIME)
        labels = labels_of(table)
        idents = idents_of(table)
        if not all(idents):
            idents = self._follow(stamp, labels, table, idents)
        survey = self._survey
        first: dict[str, int] = {}
        for row, ident in enumerate(idents):
            if ident in first:
                self._unusable.add(f"object {ident} comes more than once in a list", log_time)
            first.setdefault(ident, row)
        nodes = [
            self._enter(ident, survey.label_of(ident, labels[row])) for ident, row in first.items()
        ]
        kinds: dict[int, Called] = {}
        for node, row in zip(nodes, first.values(), strict=True):
            if labels[row] != self.roster.entered(node).type_name:
                kinds[node] = self._meaning(labels[row]), labels[row]
        if EGO not in self._nodes and self._has_ego():
            meaning = self._types.get(self._box.type.lower(), TypeMeaning("car"))
            self._nodes[EGO] = self.roster.enter(EGO, meaning, self._box.type)
        self._axes.forget(stamp - _REMEMBERED_NS)
        return AutowareRawFrame(
            stamp,
            log_time,
            np.array(nodes, np.int64),
            table[list(first.values()), _BOX_BEGINS:],
            text(head, "header.frame_id") or survey.world,
            {node: self._state_now(node, stamp) for node in self._shown},
            *self._reported(stamp),
            kinds=kinds,
        )

    def _has_ego(self) -> bool:
        survey = self._survey
        return survey.pose_channel >= 0 or survey.ego_axes in self._axes.parents

    def _enter(self, ident: str, label: str) -> int:
        if ident not in self._nodes:
            self._nodes[ident] = self.roster.enter(ident, self._meaning(label), label)
        return self._nodes[ident]

    def _meaning(self, label: str) -> TypeMeaning:
        known = self._types.get(label) or type_meanings().get(f"autoware_{label}")
        return known or TypeMeaning("unknown")

    def _state_now(self, node: int, stamp: int) -> int:
        told, state = self._shown[node]
        return state if abs(stamp - told) <= _LIT_NS else LIGHT_STATE_CODE["unknown"]

    def _reported(self, stamp: int) -> tuple[int, float]:
        """Return the ego's lights (mask) and gear at a time, from recent vehicle messages."""
        now = {
            what: value
            for what, (told, value) in self._reports.items()
            if abs(stamp - told) <= _LIT_NS
        }
        mask = -1
        if INDICATORS in now or HAZARDS in now:
            both = now.get(HAZARDS) == 2
            left, right = both or now.get(INDICATORS) == 2, both or now.get(INDICATORS) == 3
            mask = left << VEHICLE_LIGHTS.index("light_left")
            mask |= right << VEHICLE_LIGHTS.index("light_right")
        return mask, _gear_of(now.get(GEAR, 0))

    def _follow(self, stamp: int, labels: list[str], table: Floats, told: list[str]) -> list[str]:
        """Return ids for detected objects without id: that of the nearest previous object, or a new one."""
        before_ns, before = self._seen
        lapse = min(max(stamp - before_ns, 0), _LIT_NS) / 1e9
        places = table[:, _BOX_BEGINS : _BOX_BEGINS + 2]
        turns = table[:, _BOX_BEGINS + 3 : _BOX_BEGINS + 7]
        twist = np.nan_to_num(table[:, _BOX_BEGINS + 7 : _BOX_BEGINS + 10])
        velocity = (_rotations(turns)[0] @ twist[:, :, None])[:, :2, 0]
        velocity = np.nan_to_num(velocity)
        pairs: list[tuple[float, int, int]] = []
        for row, place in enumerate(places):
            for number_, one in enumerate(before):
                if one.label == labels[row]:
                    ahead = float(np.hypot(*(place - one.place - lapse * one.velocity)))
                    away = min(ahead, float(np.hypot(*(place - one.place))))
                    if away <= _NEAR:
                        pairs.append((away, row, number_))
        idents = list(told)
        taken: set[int] = set()
        for _, row, number_ in sorted(pairs):
            if not idents[row] and number_ not in taken:
                idents[row] = before[number_].ident
                taken.add(number_)
        for row, ident in enumerate(idents):
            if not ident:
                self._followed += 1
                idents[row] = f"detection {self._followed}"
        rows = zip(idents, labels, places, velocity, strict=True)
        self._seen = stamp, [_Detection(*row) for row in rows]
        return idents

    def _measure(self, table: Floats, data: memoryview) -> None:
        """For objects with a polygon as shape, compute length, width and centre from the corners."""
        told = records(self._decoded(self._survey.leading, data), "objects")
        for row, one in enumerate(told[: len(table)]):
            corners = records(one, "shape.footprint.points")
            if table[row, _BOX_BEGINS + 17] != _POLYGON or len(corners) < 3:
                continue
            points = np.array([[number(p, "x"), number(p, "y")] for p in corners])
            low, high = points.min(axis=0), points.max(axis=0)
            size = slice(_BOX_BEGINS + 14, _BOX_BEGINS + 16)
            table[row, size] = high - low
            middle = np.append((low + high) / 2, 0.0)
            turn = _rotations(table[row, None, _BOX_BEGINS + 3 : _BOX_BEGINS + 7])[0][0]
            table[row, _BOX_BEGINS : _BOX_BEGINS + 3] += np.nan_to_num(turn @ middle)

    def _settle_open(self) -> None:
        """Compute pose and motion of the ego in the last frame, from all messages read so far."""
        frame, self._open = self._open, None
        if frame is None:
            return
        frame.motion = self._motion_at(frame.time_ns)
        frame.ego = self._ego_at(frame.time_ns, frame.motion)
        frame.base = self._base_at(frame)

    def _motion_at(self, time_ns: int) -> Floats:
        times, motions = self._motions
        if not times:
            return np.full(7, np.nan)
        behind = min(bisect_left(times, time_ns), len(times) - 1)
        if behind == 0 or times[behind] <= time_ns:
            return motions[behind]
        share = (time_ns - times[behind - 1]) / (times[behind] - times[behind - 1])
        return motions[behind - 1] + share * (motions[behind] - motions[behind - 1])

    def _ego_at(self, time_ns: int, motion: Floats) -> Pose | None:
        survey, times = self._survey, self._motions[0]
        pose = self._axes.pose(survey.ego_axes, survey.world, time_ns)
        late = time_ns - times[-1] if times else 0
        if pose is None or late <= 0 or not np.isfinite(motion[:4]).all():
            return pose
        if late > _HOLDS_NS:
            return None
        place, turn = pose
        half = motion[3] * late / 1e9 / 2
        further = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
        return place + rotated(turn, motion[:3]) * (late / 1e9), product(turn, further)

    def _base_at(self, frame: AutowareRawFrame) -> Pose | None:
        """Return the pose in map axes of the axes that a frame's objects use; ``None`` if unknown."""
        survey = self._survey
        if frame.axes == survey.world:
            return np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        own = self._axes.pose(frame.axes, survey.ego_axes, frame.time_ns)
        if own is None:
            return self._axes.pose(frame.axes, survey.world, frame.time_ns)
        if frame.ego is None:
            return None
        place, turn = frame.ego
        return place + rotated(turn, own[0]), product(turn, own[1])

    def _rows(self, frame: AutowareRawFrame) -> FrameRows:
        values, usable = _numbers(frame.objects, frame.base)
        if not usable.all():
            reason = "an object has no usable pose"
            if frame.base is None:
                reason = f"where {frame.axes!r} is in {self._survey.world!r} is not known"
            for _ in range(int((~usable).sum())):
                self._unusable.add(reason, frame.log_time_ns)
        node, values = frame.node[usable], values[usable]
        lights = np.full(len(node), -1, np.int64)
        ego = self._nodes.get(EGO, -1)
        if ego >= 0 and frame.ego is not None:
            node, lights = np.append(node, ego), np.append(lights, frame.signals)
            values = np.vstack([values, self._ego_values(frame.ego, frame.motion)])
        wanted = self._nodes.get(self._survey.wanted or EGO, -1)
        controls = (NAN, NAN, NAN, frame.gear, NAN)
        driven = {} if wanted == ego else {ego: controls}
        rows = FrameRows(
            frame.time_ns,
            frame.log_time_ns,
            wanted if (node == wanted).any() else -1,
            node,
            values,
            lights,
            np.full(len(node), -1, np.int64),
            controls=controls if wanted == ego else (NAN,) * 5,
            driven=driven if (node == ego).any() else {},
            own=dict(zip(node.tolist(), _perceived(frame.objects[usable]), strict=False)),
            kinds=frame.kinds,
        )
        return rows.with_heads(self._heads(frame.lights))

    def _heads(self, shown: dict[int, int]) -> tuple[Ints, Floats, Ints]:
        name_of = {self._nodes[name]: name for name in self._places if name in self._nodes}
        values = np.full((len(shown), len(POSE)), np.nan)
        values[:, :3] = [self._places[name_of[node]] for node in shown] or np.zeros((0, 3))
        values[:, 6:13] = 0.0
        return np.array([*shown], np.int64), values, np.array([*shown.values()], np.int64)

    def _ego_values(self, pose: Pose, motion: Floats) -> Floats:
        values = np.full(len(POSE), np.nan)
        place, turn = pose
        box = self._box
        values[:3] = place + rotated(turn, np.array(box.offset))
        _, values[3:6] = (part[0] for part in _rotations(turn[None]))
        values[6:9], values[9:12] = rotated(turn, motion[:3]), rotated(turn, motion[4:7])
        values[12], values[13:16] = motion[3], (box.length, box.width, box.height)
        return values


def _numbers(objects: Floats, base: Pose | None) -> tuple[Floats, Bools]:
    """Return the poses (n, 16) of Autoware objects, and a mask of the usable ones.

    The columns are :data:`sgstore.model.world.POSE`. ``objects``: columns of the objects after their classes;
    ``base``: the pose of their axes.
    """
    values = np.full((len(objects), len(POSE)), np.nan)
    if base is None:
        return values, np.zeros(len(objects), np.bool_)
    place, turn = base
    outer = _rotations(turn[None])[0][0]
    available = objects[:, 18]
    told, _ = _rotations(objects[:, 3:7])
    plain = (available == _NO_HEADING) | ~np.isfinite(told).all(axis=(1, 2))
    told[plain] = np.eye(3)
    turns = outer @ told
    values[:, 3:6] = _angles(turns)
    backwards = (available == _NO_SIGN) & (objects[:, 7] < 0)
    values[backwards, 3] = np.remainder(values[backwards, 3] + 2 * np.pi, 2 * np.pi) - np.pi
    values[plain, 3:6] = np.nan
    moving = ~(objects[:, 19] == 0)  # A flag marks detections without a twist.
    values[moving, 12] = objects[moving, 10]
    sizes = objects[:, 14:17]
    values[:, 13:16] = np.where((sizes != 0) & np.isfinite(sizes), sizes, np.nan)
    with np.errstate(invalid="ignore", over="ignore"):  # Damaged numbers may be infinite.
        values[:, :3] = place + objects[:, :3] @ outer.T
        values[moving, 6:9] = (turns @ objects[:, 7:10, None])[moving, :, 0]
        values[:, 9:12] = (turns @ objects[:, 11:14, None])[:, :, 0]
        near: Bools = np.abs(values[:, :3]) < FAR
    return values, np.all(near, axis=1, keepdims=True)[:, 0]


def _rotations(turns: Floats) -> tuple[Floats, Floats]:
    """Convert quaternions (n, 4) to rotation matrices (n, 3, 3) and angles (n, 3); NaN if invalid."""
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt((turns * turns).sum(axis=1))
        norm[~((norm > 0.5) & (norm < 2))] = np.nan
        x, y, z, w = (turns / norm[:, None]).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrices = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return matrices, _angles(matrices)


def _angles(matrices: Floats) -> Floats:
    """Convert rotation matrices to heading, pitch (positive with the nose down) and roll (n, 3); rad."""
    heading = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    pitch = np.arcsin(np.clip(-matrices[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(matrices[:, 2, 1], matrices[:, 2, 2])
    return np.stack([heading, pitch, roll], axis=1)


def _pose_at(told: dict[str, Any], place: str, turn: str) -> Pose | None:
    at = np.array([number(told, f"{place}.{axis}") for axis in _VECTOR])
    way = np.array([number(told, f"{turn}.{part}") for part in (*_VECTOR, "w")])
    usable = np.isfinite(way).all() and (np.abs(at) < FAR).all()
    return (at, normed(way)) if usable else None


def _state_of(elements: Iterable[dict[str, Any]]) -> str:
    """Return the state of a group of traffic lights: that of its round lights, or else of its arrows."""
    told = [{key: number(one, key) for key in ("color", "shape", "status")} for one in elements]
    told = [one for one in told if one["shape"] == _CIRCLE] or told
    if any(one["status"] == _FLASHING for one in told):
        return "flashing"
    lit = {_COLOURS.get(int(one["color"]), "") for one in told if one["status"] != _OFF}
    if lit >= {"red", "yellow"}:
        return "red_yellow"
    found = next((colour for colour in ("red", "yellow", "green") if colour in lit), "")
    dark = bool(told) and all(one["status"] == _OFF for one in told)
    return found or ("off" if dark else "unknown")


def _gear_of(report: int) -> float:
    """Return the gear of a ``GearReport``: 1, 2, … forward, 0 neutral or parked, -1, -2 reverse."""
    if 2 <= report <= 19:
        return float(report - 1)
    return {1: 0.0, 20: -1.0, 21: -2.0, 22: 0.0, 23: 1.0, 24: 2.0}.get(report, NAN)


class AutowareTrace(SurveyedTrace[AutowareSurvey]):
    """Open Autoware recording, which yields frames.

    Parameters
    ----------
    recording : Recording
    ego : str
        ``ego``, or the id of an object; empty: ``ego``, the vehicle itself.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.
    mapping : str or Path
        A TOML file with the size of the vehicle in ``[ego]``, and the meanings of classes in ``[types]``.

    Attributes
    ----------
    info : TraceInfo
    report : TraceReport
        Filled during the reading of blocks.

    Raises
    ------
    TraceError
        The definition of the objects is malformed, no frame can be read, or the given ego does not exist.
    """

    name: ClassVar[str] = "autoware"

    def __init__(
        self, recording: Recording, *, ego: str = "", digest: str = "", mapping: str | Path = ""
    ) -> None:
        told = mapping_for(mapping, ()) if mapping else None
        sized = told is not None and np.isfinite(told.ego.length)
        self._box = told.ego if told is not None and sized else SAMPLE_VEHICLE
        self._types = told.types if told is not None else {}
        self._places: dict[str, tuple[float, float, float]] = {}
        known_by = sha256(repr(told).encode("utf-8", "replace")).hexdigest() if told else ""
        super().__init__(lambda: AutowareSurvey(recording, ego), digest, mapping=known_by)

    @staticmethod
    def has_frames(recording: Recording, channel: int) -> bool:
        """Return True if an Autoware channel contains lists of objects."""
        return content_of(recording, channel) == OBJECTS

    def on_map(self, road_map: RoadMap | None) -> None:
        """Find the positions of the traffic lights in the road map."""
        if road_map is not None:
            self._places = light_places(road_map)

    def _decoder(self, report: TraceReport) -> AutowareDecoder:
        if self._box is SAMPLE_VEHICLE and self.info.ego == EGO:
            report.warnings.append(
                "how large the vehicle is, is not recorded: that of Autoware's sample vehicle is taken unless a"
                " mapping tells it ([ego] length, width, height, offset)"
            )
        return AutowareDecoder(self._survey, self._box, self._types, self._places, report)
