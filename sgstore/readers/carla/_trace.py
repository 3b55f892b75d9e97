"""Reader of recordings of CARLA's ROS bridge. It decodes the messages into frames.

They are recorded with ``ros2 bag record -s mcap``, and recognised only by the schema of a channel. A frame is
one list of objects, in file order; its time is the simulation time. The road map is the OpenDRIVE text of
``CarlaWorldInfo`` or of a string message. The bridge contains positions only of vehicles and walkers. Signs and
props in the list of actors have no position and are ignored; signs come from the road map.

* Axes and units of ROS equal those of sgstore: x ahead, y to the left, z up, metres, radians. The bridge has
  already mirrored CARLA's y and yaw. Velocities and accelerations of objects are in map axes.
* The bridge mirrors an angular velocity like a velocity. A mirrored rotation has the other sign about the axes
  in the mirror's plane, so the angular velocities about x and y are negated.
* The origin of a vehicle is on the ground below its centre, that of a walker in the centre of its body. In
  sgstore, the position is the centre of the box, so a vehicle is lifted by half its height along its own
  upright axis. (The bridge drops the small offset of some blueprints between origin and box.)
* The type of an object comes from the list of actors (:mod:`sgstore.readers.carla._survey`).
* Controls, vehicle lights and odometry are separate messages, before or after the objects of the same instant.
  They belong together if their stamps differ by at most 1 ms. Less frequent controls are valid for half a
  second.
* CARLA's steering is positive to the right, that of sgstore to the left.

Source: carla-simulator/ros-bridge (carla_common/transforms.py, carla_ros_bridge/traffic_participant.py,
ego_vehicle.py); carla.VehicleLightState.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from sgstore.base.display import number_of
from sgstore.errors import MapError, TraceError
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import CONTROL, KINDS
from sgstore.model.world import LARGEST, POSE
from sgstore.readers._base import SurveyedDecoder, SurveyedTrace
from sgstore.readers._blocks import FAR, NAN, NO_INPUTS, UPRIGHT, FrameRows
from sgstore.readers._ros2 import MAX_IDENT, ColumnReader, decode
from sgstore.readers._stamps import NO_TIME
from sgstore.readers.carla._signals import Lights, signals_of
from sgstore.readers.carla._survey import (
    COMMANDS,
    EVENTS,
    LIGHT_STATES,
    NEVER,
    OBJECTS,
    ODOMETRY,
    SAME_TICK,
    STATUS,
    VEHICLE_LIGHTS,
    CarlaSurvey,
    content_of,
    event_of,
    meaning_of_object,
    stamp_from,
    stamp_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import Bools, Floats, Ints, TraceReport
    from sgstore.readers._blocks import Called


COLUMNS: Final = (
    "id",
    "classification",
    "shape.type",
    *(f"pose.position.{axis}" for axis in "xyz"),
    *(f"pose.orientation.{part}" for part in "xyzw"),
    *(f"twist.linear.{axis}" for axis in "xyz"),
    *(f"accel.linear.{axis}" for axis in "xyz"),
    "twist.angular.z",
    *(f"shape.dimensions[{i}]" for i in range(3)),
    *(f"twist.angular.{axis}" for axis in "xy"),
)
"""Fields of ``derived_object_msgs/Object`` with the numbers that the reader uses."""
STAMP: Final = ("header.stamp.sec", "header.stamp.nanosec")
CONTROLS: Final = (
    *("steer", "throttle", "brake", "gear", "hand_brake", "reverse", "manual_gear_shift"),
)
ODOMETRY_COLUMNS: Final = (
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{part}" for part in "xyzw"),
    *(f"twist.twist.linear.{axis}" for axis in "xyz"),
    *(f"twist.twist.angular.{axis}" for axis in "zxy"),
)
"""Fields of ``nav_msgs/Odometry`` that the reader uses. The velocity is in the axes of the vehicle."""

HOLDS: Final = 500_000_000
"""Time for which controls are valid after their message; ns."""
MAX_JSON: Final = 1 << 20
"""Maximum size of a JSON message; bytes."""

_ID, _CLASS, _SHAPE, _POSITION, _TURN, _MOTION, _SIZE, _SPIN = 0, 1, 2, 3, 6, 10, 17, 20
_SPHERE, _CYLINDER, _CONE = 2, 3, 4
_CARLA_LIGHTS: Final = (5, 4, 3, 6, 0, 1, 2, 7, 8, 9, 10)
"""Bit in ``VEHICLE_LIGHTS`` → bit of ``carla.VehicleLightState``: position 0, low beam 1, high beam 2, brake 3,
right 4, left 5, reverse 6, fog 7, interior 8, special 9 and 10."""
Controls = tuple[float, ...]
"""Control inputs of a vehicle in the order of :data:`sgstore.model.world.INPUTS`. NaN means unknown."""


@dataclass(slots=True)
class CarlaRawFrame:
    """Frame of a CARLA recording before conversion, with its original numbers.

    Attributes
    ----------
    time_ns, log_time_ns : int
    objects : (n, 22) float64
        Columns :data:`COLUMNS`.
    nodes : (n,) int64
        Node id of each object.
    light_states : (m,) int64
        Of the traffic lights.
    controls : dict
        Actor id → :data:`sgstore.model.world.INPUTS`.
    vehicle_lights : mapping
        Actor id → mask of :data:`sgstore.model.vocabulary.VEHICLE_LIGHTS`.
    own : dict
        Actor id → attributes without a column: commanded controls and the mode of the gear.
    odometry : (13,) float64 or None
        Columns :data:`ODOMETRY_COLUMNS` of the ego, if it is not among the objects.
    kinds : dict
        As in :class:`~sgstore.readers._blocks.FrameRows`.
    """

    time_ns: int
    log_time_ns: int
    objects: Floats
    nodes: Ints
    light_states: Ints
    controls: dict[int, Controls] = field(default_factory=dict[int, "Controls"])
    vehicle_lights: Mapping[int, int] = field(default_factory=dict[int, int])
    own: dict[int, dict[str, Any]] = field(default_factory=dict[int, "dict[str, Any]"])
    odometry: Floats | None = None
    kinds: dict[int, Called] = field(default_factory=dict[int, "Called"])


class CarlaDecoder(SurveyedDecoder[CarlaRawFrame, CarlaSurvey]):
    """Decoder of CARLA ROS bridge messages into frames.

    Parameters
    ----------
    survey : CarlaSurvey
    signals : mapping
        Traffic light → id of its signal in the road map.
    road_map : RoadMap or None
        That map.
    report : TraceReport
        Receives losses and warnings.
    """

    def __init__(
        self,
        survey: CarlaSurvey,
        signals: Mapping[int, str],
        road_map: RoadMap | None,
        report: TraceReport,
    ) -> None:
        super().__init__(survey, report)
        self._ego = survey.ego
        self._table = ColumnReader(survey.structures[survey.leading], COLUMNS, "objects")
        self._nodes: dict[int, int] = {}
        self._idents: dict[int, int] = {}
        self._people: set[int] = set()
        self._classes: dict[int, float] = {}
        self._seq = -1
        self._frame: CarlaRawFrame | None = None
        self._controls: dict[int, tuple[int, Controls]] = {}
        self._own: dict[tuple[int, bool], tuple[int, dict[str, Any]]] = {}
        self._vehicle_lights: tuple[int, Mapping[int, int]] = NEVER, {}
        self._odometry: tuple[int, Floats | None] = NEVER, None
        self._fields: dict[int, ColumnReader] = {}
        self._driven = survey.driven
        self._drivers: dict[int, int] = {}
        self._with_status: set[int] = set()
        self._take = self._takers()
        self.channels = self._leading | {*self._take}
        self._lights = Lights(survey.lights, signals, road_map, self.roster)
        self._lights_at: int | None = None
        self._unread_ns = -1
        self._losses = self._without_lights = 0

    def decode(self, run: Messages, row: int) -> CarlaRawFrame | None:
        """Return the frame in a CARLA message, before conversion; ``None`` if not a frame, or unreadable."""
        channel, log_time = int(run.channel[row]), int(run.log_time_ns[row])
        if channel in self._leading:
            self._stamps.next()
        try:
            take = self._take.get(channel)
            if take is not None:
                take(channel, log_time, run.data(row))
            elif self.is_inside(log_time):
                return self._raw(log_time, run.data(row))
        except TraceError as error:
            what = "frame" if channel in self._leading else "message"
            topic = self._survey.topic(channel)
            self.lose(f"a {what} of {topic!r} cannot be read: {error.reason}", run, row)
        return None

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        warn = self._report.warnings.append
        if self._lights.unplaced:
            warn(
                f"of {self._lights.unplaced} traffic lights the recording does not say where they stand:"
                " they are listed as entities, but are in no graph"
            )
        if self._lights.aimless:
            warn(
                f"{self._lights.aimless} traffic lights are no signal of the road map, and their boxes are on"
                " none of its lanes: for which lanes they are is not known"
            )
        if self._without_lights:
            warn(
                f"the states of traffic lights are unknown in {number_of(self._without_lights, 'frame')}:"
                " an unreadable part of the file may contain them"
            )
        self._report.warnings += self._lights.warnings
        super().settle()
        if not self._survey.egos.actors:
            warn("no list of actors; kinds of vehicles are guesses of the bridge, mostly car")

    def _raw(self, log_time: int, data: memoryview) -> CarlaRawFrame:
        head, objects = self._table.read(data)
        known = np.abs(objects[:, _ID]) < MAX_IDENT
        if not known.all():
            self._unusable.add("an object has no id", log_time)
            objects = objects[known]
        time_ns = self._stamps.time(log_time, stamp_of(head))
        if time_ns is None:
            raise TraceError(NO_TIME)
        idents = objects[:, _ID].astype(np.int64).tolist()
        nodes, kinds = self._nodes, dict[int, "Called"]()
        for ident, classification in zip(idents, objects[:, _CLASS].tolist(), strict=True):
            if ident not in nodes:
                self._enter(ident, classification)
            elif classification != self._classes[ident]:
                kinds |= self._other(ident, classification)
        if self._may_lack_light_states():
            self._lights.forget()
            self._without_lights += 1
        frame = CarlaRawFrame(
            time_ns,
            log_time,
            objects,
            np.array([nodes[ident] for ident in idents], np.int64),
            self._lights.of_frame(),
            kinds=kinds,
        )
        self._add_controls(frame)
        stamp, lights = self._vehicle_lights
        if abs(time_ns - stamp) <= SAME_TICK:
            frame.vehicle_lights = lights
        self._frame = frame
        self._seq += 1
        self._see_odometry()
        return frame

    def _add_controls(self, frame: CarlaRawFrame) -> None:
        """Add the latest controls of vehicles to a frame, if they are recent enough."""
        for ident, (stamp, controls) in self._controls.items():
            if -SAME_TICK <= frame.time_ns - stamp <= HOLDS:
                frame.controls[ident] = controls
        for (ident, _), (stamp, own) in self._own.items():
            if -SAME_TICK <= frame.time_ns - stamp <= HOLDS:
                frame.own.setdefault(ident, {}).update(own)

    def _enter(self, ident: int, classification: float) -> None:
        """Add a new object of a CARLA message to the object table."""
        actor = self._survey.egos.actors.get(ident)
        meaning = meaning_of_object(actor, classification)
        type_name = actor.type_name if actor else f"class {classification:.0f}"
        if meaning.kind == "vehicle":
            self.roster.count_unknown(type_name)
        node = self.roster.enter(str(ident), meaning, type_name)
        self._nodes[ident] = node
        self._classes[ident] = classification
        self._idents[node] = ident
        if meaning.kind == "person":
            self._people.add(node)

    def _other(self, ident: int, classification: float) -> dict[int, Called]:
        """If the class of an object differs from its first one, return node id → present kind; else empty."""
        node = self._nodes[ident]
        if np.isnan(self._classes[ident]):
            self._classes[ident] = classification
        if np.isnan(classification) or classification == self._classes[ident]:
            return {}
        first = KINDS[self.roster.entered(node).kind]
        meaning, type_name = meaning_of_object(None, classification), f"class {classification:.0f}"
        for actor in self._survey.egos.later.get(ident, ()):
            other = meaning_of_object(actor, classification)
            if (other.kind == "person") == (meaning.kind == "person"):
                meaning, type_name = other, actor.type_name
        vague = meaning.kind in {"unknown", "vehicle"}
        return {} if vague or meaning.kind == first else {node: (meaning, type_name)}

    def complete(self, frames: list[CarlaRawFrame]) -> list[FrameRows]:
        """Convert CARLA frames: compute poses, speeds and sizes of many frames at once."""
        if not frames:
            return []
        nodes = np.concatenate([frame.nodes for frame in frames])
        people = np.isin(nodes, list(self._people))
        start = 0
        for frame in frames:
            for node, (meaning, _) in frame.kinds.items():
                people[start + np.flatnonzero(frame.nodes == node)] = meaning.kind == "person"
            start += len(frame.nodes)
        values, usable = _numbers(np.concatenate([frame.objects for frame in frames]), ~people)
        done: list[FrameRows] = []
        start = 0
        for frame in frames:
            stop = start + len(frame.nodes)
            done.append(self._rows(frame, values[start:stop], usable[start:stop]))
            start = stop
        return done

    def _rows(self, frame: CarlaRawFrame, values: Floats, usable: Bools) -> FrameRows:
        """Convert a CARLA frame to the columns of a decoded frame. Drop unusable rows."""
        node = frame.nodes
        if not usable.all():
            for row in np.flatnonzero(~usable).tolist():
                self._unuse("object {} has no usable pose", int(node[row]), frame)
            node, values = node[usable], values[usable]
        if len(set(node.tolist())) < len(node):
            first = np.unique(node, return_index=True)[1]
            for row in np.setdiff1d(np.arange(len(node)), first).tolist():
                self._unuse("object {} comes more than once in a frame", int(node[row]), frame)
            first.sort()
            node, values = node[first], values[first]
        if frame.odometry is not None:
            own = self._nodes[self._ego if self._ego is not None else -1]
            node = np.append(node, own)
            values = np.vstack([values, _pose_of(frame.odometry)])
        ego = self._nodes.get(-1 if self._ego is None else self._ego, -1)
        driven = {self._nodes.get(one, -1): told for one, told in frame.controls.items()}
        rows = FrameRows(
            time_ns=frame.time_ns,
            log_time_ns=frame.log_time_ns,
            ego=ego if (node == ego).any() else -1,
            node=node,
            values=values,
            lights=self._lights_of(frame, node),
            light_state=np.full(len(node), -1, np.int64),
            controls=driven.pop(ego, NO_INPUTS),
            driven=driven,
            own=self._own_of(frame, ego),
            kinds=frame.kinds,
        )
        return rows.with_heads((self._lights.nodes, self._lights.values, frame.light_states))

    def _own_of(self, frame: CarlaRawFrame, ego: int) -> dict[int, dict[str, Any]]:
        """Return attributes without a column, for the ego and vehicles with controls: node id → attributes."""
        found = {self._nodes.get(ident, -1): own for ident, own in frame.own.items()}
        for node in {ego, *found} - {-1}:
            rows = np.flatnonzero(frame.nodes == node)
            if len(rows):
                spin = frame.objects[rows[0], _SPIN:]
            elif node == ego and frame.odometry is not None:
                spin = frame.odometry[-2:]
            else:
                continue
            x, y = (0.0 - np.degrees(spin)).tolist()
            found[node] = found.get(node, {}) | {"ang_vel_x": x, "ang_vel_y": y}
        return found

    def _lights_of(self, frame: CarlaRawFrame, node: Ints) -> Ints:
        lights = frame.vehicle_lights
        if not lights:
            return np.full(len(node), -1)
        return np.array([lights.get(self._idents[one], -1) for one in node.tolist()], np.int64)

    def _unuse(self, reason: str, node: int, frame: CarlaRawFrame) -> None:
        self._unusable.add(reason.format(self._idents[node]), frame.log_time_ns)

    def _takers(self) -> dict[int, Callable[[int, int, memoryview], None]]:
        """Return the function that processes the messages of each channel, except the frame channel."""
        found = self._survey
        takers: dict[int, Callable[[int, int, memoryview], None]] = {}
        own = {
            channel: (found.contents[channel], ident)
            for channel, role in self._driven.items()
            if (ident := found.egos.id_of(role)) is not None
        }
        self._with_status = {ident for content, ident in own.values() if content == STATUS}
        for channel, (content, ident) in own.items():
            # A status contains the applied controls, a command only the requested ones.
            if content in {STATUS, COMMANDS}:
                inside = "control." if content == STATUS else ""
                columns = tuple(inside + name for name in CONTROLS)
                self._fields[channel] = ColumnReader(found.structures[channel], (*STAMP, *columns))
                self._drivers[channel] = ident
                takers[channel] = self._take_controls
            elif (content, ident) == (ODOMETRY, self._ego):
                columns = (*STAMP, *ODOMETRY_COLUMNS)
                self._fields[channel] = ColumnReader(found.structures[channel], columns)
                takers[channel] = self._take_odometry
        for channel, content in found.contents.items():
            if content == LIGHT_STATES:
                takers[channel] = self._take_light_states
            elif content == VEHICLE_LIGHTS:
                takers[channel] = self._take_vehicle_lights
            elif content in EVENTS:
                takers[channel] = self._take_event
        return takers

    def _take_light_states(self, channel: int, log_time: int, data: memoryview) -> None:
        self._lights.update(decode(self._survey.structures[channel], data))
        self._lights_at = log_time

    def _may_lack_light_states(self) -> bool:
        """True if an unreadable part of the file may contain later light states than the latest message."""
        losses = self._report.losses
        if len(losses) > self._losses:
            self._unread_ns = max(self._unread_ns, *(one.end_ns for one in losses[self._losses :]))
            self._losses = len(losses)
        return self._lights_at is not None and self._lights_at <= self._unread_ns

    def _take_controls(self, channel: int, log_time: int, data: memoryview) -> None:
        told = self._fields[channel].read(data)[1][0]
        ident = self._drivers[channel]
        stamp = self._stamps.beside(log_time, stamp_from(told[:2]))
        controls = np.where(np.isfinite(told[2:]), told[2:], NAN).tolist()
        applied = self._survey.contents[channel] == STATUS
        here = self._frame is not None and abs(self._frame.time_ns - stamp) <= SAME_TICK
        own = _own_inputs(controls, applied=applied)
        self._own[ident, applied] = stamp, own
        if self._frame is not None and here:
            self._frame.own.setdefault(ident, {}).update(own)
        if not applied and ident in self._with_status:
            return
        self._controls[ident] = stamp, _inputs(controls, applied=applied)
        if self._frame is not None and here:
            self._frame.controls[ident] = self._controls[ident][1]

    def _take_event(self, channel: int, log_time: int, data: memoryview) -> None:
        if not self.is_inside(log_time):
            return
        found = self._survey
        message = decode(found.structures[channel], data)
        ident = found.egos.id_of(self._driven[channel])
        place = self._stamps.beside(log_time, stamp_of(message)), log_time, self._seq
        named = "" if ident is None else str(ident)
        self.roster.happen(event_of(found.contents[channel], message, place, named))

    def _take_vehicle_lights(self, _channel: int, log_time: int, data: memoryview) -> None:
        told, lights = _vehicle_lights(data)
        stamp = self._stamps.beside(log_time, told)
        self._vehicle_lights = stamp, lights
        if self._frame is not None and abs(self._frame.time_ns - stamp) <= SAME_TICK:
            self._frame.vehicle_lights = lights

    def _take_odometry(self, channel: int, log_time: int, data: memoryview) -> None:
        if self._frame is not None and self._ego in self._nodes and self._odometry[1] is None:
            return  # The ego is among the objects.
        told = self._fields[channel].read(data)[1][0]
        self._odometry = self._stamps.beside(log_time, stamp_from(told[:2])), told[2:]
        self._see_odometry()

    def _see_odometry(self) -> None:
        """If the ego is not among the objects of a frame, add it from its odometry."""
        frame, (stamp, numbers), ego = self._frame, self._odometry, self._ego
        if frame is None or numbers is None or ego is None:
            return
        if abs(frame.time_ns - stamp) > SAME_TICK or not np.abs(numbers).max() < FAR:
            return
        if ego not in self._nodes:
            self._enter(ego, NAN)
        if not (frame.nodes == self._nodes[ego]).any():
            frame.odometry = numbers


def _numbers(objects: Floats, lifted: Bools) -> tuple[Floats, Bools]:
    """Return the poses (n, 16) of CARLA objects, and a mask of the usable ones.

    Parameters
    ----------
    objects : (n, 22) float64
        Columns :data:`COLUMNS`.
    lifted : (n,) bool
        True if the origin is at the bottom of the box.

    Returns
    -------
    values : (n, 16) float64
        Columns :data:`sgstore.model.world.POSE`.
    usable : (n,) bool
        True with a valid position and a valid quaternion.
    """
    values = np.full((len(objects), len(POSE)), np.nan)
    angles, up = _turned(objects[:, _TURN : _TURN + 4])
    values[:, :3] = objects[:, _POSITION : _POSITION + 3]
    values[:, 3:6] = angles
    values[:, 6:13] = objects[:, _MOTION : _MOTION + 7]
    values[:, 13:16] = _boxes(objects[:, _SHAPE], objects[:, _SIZE : _SIZE + 3])
    is_tall = lifted & (values[:, 15] > 0) & (values[:, 15] <= LARGEST)
    half = np.where(is_tall, values[:, 15] / 2, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        values[:, :3] += half[:, None] * up
        near = np.abs(values[:, :4]) < FAR
    return values, np.all(near, axis=1, keepdims=True)[:, 0]


def _turned(quaternions: Floats) -> tuple[Floats, Floats]:
    """Convert quaternions (x, y, z, w) to heading, pitch and roll, and to vertical axes. NaN if invalid.

    The length of a quaternion may differ slightly from 1. At a pitch of ±90°, heading and roll have the same
    axis; the roll is then 0.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt((quaternions * quaternions).sum(axis=1))
        norm[~((norm > 0.5) & (norm < 2))] = np.nan
        x, y, z, w = (quaternions / norm[:, None]).T
        up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        sine = np.clip(2 * (w * y - z * x), -1, 1)
        pitch, roll = np.arcsin(sine), np.arctan2(2 * (w * x + y * z), up[:, 2])
        upright = np.abs(sine) > UPRIGHT
    heading[upright] = np.arctan2(2 * w * z, w * w - z * z)[upright]
    roll[upright] = 0
    return np.stack([heading, pitch, roll], axis=1), up


def _boxes(shape: Floats, size: Floats) -> Floats:
    """Return length, width and height of objects from their shapes. Round shapes have a radius instead."""
    boxes = size.copy()
    sphere = shape == _SPHERE
    boxes[sphere] = 2 * size[sphere, :1]
    upright = (shape == _CYLINDER) | (shape == _CONE)  # height, radius
    boxes[upright] = np.column_stack([2 * size[upright, 1], 2 * size[upright, 1], size[upright, 0]])
    return boxes


def _pose_of(odometry: Floats) -> Floats:
    """Return pose columns from odometry. The position is the origin of the vehicle, not its centre."""
    values = np.full(len(POSE), np.nan)
    angles, _ = _turned(odometry[None, 3:7])
    values[:3], values[3:6] = odometry[:3], angles[0]
    # Rotation of a vector from vehicle axes into map axes.
    quaternion = odometry[3:7]
    vector = odometry[7:10]
    axis, w = quaternion[:3], quaternion[3]
    across = 2 * np.cross(axis, vector)
    values[6:9] = vector + w * across + np.cross(axis, across)
    values[12] = odometry[10]
    return values


def _vehicle_lights(data: memoryview) -> tuple[int, dict[int, int]]:
    """Return the time stamp of a JSON message, and the states of vehicle lights by vehicle id.

    Raises
    ------
    TraceError
        The message is too large or has another format.
    """
    if len(data) > MAX_JSON:
        raise TraceError(f"{len(data)} bytes of JSON; at most {MAX_JSON} are read")
    try:
        message = json.loads(bytes(data))
        lights = {int(ident): _our_lights(int(bits)) for ident, bits in message["lights"].items()}
        return round(float(message["t"]) * 1e9), lights
    except (
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        reason = f"expected {{'t': s, 'lights': {{id: bits}}}}: {type(error).__name__}: {error}"
        raise TraceError(reason) from error


@lru_cache(maxsize=4096)  # Vehicles keep the same lights for a long time.
def _our_lights(bits: int) -> int:
    """Convert CARLA's bit mask of vehicle lights into the light mask of sgstore."""
    return sum((bits >> theirs & 1) << ours for ours, theirs in enumerate(_CARLA_LIGHTS))


class CarlaTrace(SurveyedTrace[CarlaSurvey]):
    """Open recording of CARLA's ROS bridge, which yields frames.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or role name of the ego; empty: the vehicle with the role ``hero`` or ``ego_vehicle``, or with its
        own channels.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.

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

    name: ClassVar[str] = "carla"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        super().__init__(lambda: CarlaSurvey(recording, ego), digest)
        self._signals: dict[int, str] = {}
        self._road_map: RoadMap | None = None
        self.on_map(self._own_map())

    @staticmethod
    def has_frames(recording: Recording, channel: int) -> bool:
        """Return True if a CARLA channel contains lists of objects."""
        return content_of(recording, channel) == OBJECTS

    def _decoder(self, report: TraceReport) -> CarlaDecoder:
        return CarlaDecoder(self._survey, self._signals, self._road_map, report)

    def on_map(self, road_map: RoadMap | None) -> None:
        """Find the map signals or lanes of the traffic lights in the road map."""
        if self._survey.lights and road_map is not None:
            self._road_map = road_map
            self._signals = signals_of(self._survey.lights, road_map)

    def _own_map(self) -> RoadMap | None:
        """Return the road map in the recording if traffic lights need it; otherwise ``None``."""
        if not (self._survey.lights and self._survey.map_text):
            return None
        try:
            return read_map(self._survey.map_text, self._survey.map_name)
        except MapError:  # The reading of the map for its lanes reports the error.
            return None


def _own_inputs(told: Sequence[float], *, applied: bool) -> dict[str, Any]:
    """Return custom attributes from CARLA's vehicle controls, such as the gear.

    Of an applied control, only the mode of the gear has no column. A requested control has none at all.
    """
    values: dict[str, Any] = dict(zip(CONTROLS, told, strict=True))
    values["steer"] = 0.0 - values["steer"]
    values["manual_gear"] = values.pop("manual_gear_shift")
    for name in ("hand_brake", "reverse", "manual_gear"):
        values[name] = None if math.isnan(values[name]) else bool(values[name])
    if applied:
        return {"manual_gear": values["manual_gear"]}
    values["gear"] = NAN if math.isnan(values["gear"]) else int(values["gear"])
    return {f"{CONTROL}{name}": value for name, value in values.items()}


def _inputs(told: Sequence[float], *, applied: bool) -> Controls:
    """Convert CARLA's vehicle controls into the control inputs of sgstore.

    An applied control contains the actual gear. A requested control contains a gear only for manual shifting.
    Otherwise, the simulator chooses the gear, and only the reverse direction is known.
    """
    steer, throttle, brake, gear, hand_brake, reverse, manual = told
    if not applied and manual != 1:
        gear = NAN
    if reverse == 1 and not gear < 0:
        gear = -1.0
    return 0.0 - steer, throttle, brake, gear, hand_brake
