"""OSI messages → frames: moving objects as rows, static things as entities, lights carried forward.

* A moving object becomes a row. OSI's position is the centre of the box, its axes and units are ours. A
  sub-message that is missing (velocity, acceleration, …) is missing; a number that is missing in a
  sub-message is 0, because producers leave zeros out.
* A stationary object or traffic sign is entered when it is first seen, and stays: several producers
  write them only into the first message.
* Traffic lights become one entity for each head, with a row in every frame.

Source: open-simulation-interface 3.8.0 (osi_object.proto, osi_trafficsign.proto, osi_hostvehicledata.proto).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.traces.frames import NAN, POSE, FrameRows, Roster
from sgstore.traces.osi_bases import Bases
from sgstore.traces.osi_lights import TrafficLights
from sgstore.traces.osi_schema import (
    DECODE_ERRORS,
    enum_name,
    field_type,
    ground_truth_of,
    has_field,
    map_ref,
    parse,
    static_pose,
)
from sgstore.vocabulary import TypeMeaning, type_meanings
from sgstore.world import Loss

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.traces.chunks import Messages
    from sgstore.world import Bools, Floats, Ints, TraceReport

_VEHICLE: Final = 2
"""``MovingObject.TYPE_VEHICLE``: what it is stands in ``vehicle_classification.type``."""
_INDICATORS: Final = {3: 0b01, 4: 0b10, 5: 0b11}
"""``IndicatorState`` LEFT, RIGHT, WARNING → bits ``light_left`` and ``light_right``."""
_LIT: Final = 3
"""Least value of ``BrakeLightState`` and ``GenericLightState`` that means that a light is on."""
_LIGHTS: Final = (
    ("brake_light_state", 2),
    ("reversing_light", 3),
    ("head_light", 5),
    ("high_beam", 6),
    ("front_fog_light", 7),
    ("rear_fog_light", 7),
    ("emergency_vehicle_illumination", 9),
    ("service_vehicle_illumination", 10),
)
"""Fields of ``LightState`` → bit in :data:`sgstore.vocabulary.VEHICLE_LIGHTS`."""
_NO_VECTOR: Final = (NAN, NAN, NAN)
_HEADING: Final = POSE.index("heading")
_LATEST: Final = 1 << 62
_REMEMBERED: Final = 1 << 12
_UNTOLD: Final = {"TYPE_UNKNOWN", "TYPE_OTHER"}


@dataclass(slots=True)
class RawFrame:
    """A frame whose objects' numbers are still bytes.

    Attributes
    ----------
    time_ns, log_time_ns : int
    heads : tuple of arrays
        Rows of the traffic lights: node ids, columns, states.
    controls : tuple of float
        As :class:`~sgstore.traces.frames.FrameRows` has them.
    nodes, lights : list of int
        Node id and lights of each moving object.
    bases : list of bytes
        Its ``BaseMoving``.
    """

    time_ns: int
    log_time_ns: int
    heads: tuple[Ints, Floats, Ints]
    controls: tuple[float, float, float]
    nodes: list[int] = field(default_factory=list[int])
    lights: list[int] = field(default_factory=list[int])
    bases: list[bytes] = field(default_factory=list[bytes])


class FrameDecoder:
    """Messages of the leading channel → frames, with what must be remembered from one to the next.

    Parameters
    ----------
    message : type
        Class of the messages: a ground truth, or a sensor view with one in it.
    ego : str
        Id of the ego, or the empty string.
    window : tuple of int
        Log times, both included, between which messages are frames; others only tell what lasts.
    report : TraceReport
        Takes up what cannot be used.

    Attributes
    ----------
    roster : Roster
        The entities that were met.
    """

    def __init__(
        self, message: type[Any], ego: str, window: tuple[int, int], report: TraceReport
    ) -> None:
        truth = "global_ground_truth." if has_field(message, "global_ground_truth") else ""
        moving = f"{truth}moving_object."
        self.roster = Roster(report)
        self._message = message
        self._ego = int(ego) if ego else -1
        self._window = window
        self._report = report
        self._nodes: dict[int, int] = {}
        self._idents: dict[int, int] = {}
        self._statics: set[tuple[str, int]] = set()
        self._unusable = _Tally()
        self._unreadable = _Tally()
        self._untimed = 0
        self._light_bits: dict[bytes, int] = {}
        self._bases = Bases(field_type(message, f"{moving}base"))
        self._has_lights = has_field(message, f"{moving}vehicle_classification.light_state")
        self._static_fields = tuple(
            name for name in _STATIC_OBJECTS if has_field(message, f"{truth}{name}")
        )
        self._lights = TrafficLights(message, truth, self.roster)

    def decode(self, run: Messages, row: int) -> RawFrame | None:
        """The frame that a message is; ``None`` if it cannot be read, or lies outside the window."""
        log_time = int(run.log_time_ns[row])
        try:
            message = parse(self._message, bytes(run.data(row)))
            ground = ground_truth_of(message)
            inside = self._window[0] <= log_time <= self._window[1]
            frame = self._raw(message, ground, log_time) if inside else None
            for name in self._static_fields:
                self._look_at_statics(name, getattr(ground, name), log_time)
            self._lights.update(ground)
            if frame is not None:
                frame.heads = self._lights.rows()
            return frame
        except DECODE_ERRORS as error:
            reason = f"a ground truth message cannot be read: {type(error).__name__}: {error}"
            self._unreadable.add(reason, log_time, int(run.length[row]))
            return None

    def settle(self) -> None:
        """Report what could not be used, once all frames are read."""
        losses, warn = self._report.losses, self._report.warnings.append
        losses += self._unreadable.losses()
        for loss in self._unusable.losses():
            reason = f"{loss.reason}: {loss.messages} states were left out"
            losses.append(replace(loss, reason=reason, messages=0, bytes=0))
        if self._lights.unplaced:
            warn(
                f"{self._lights.unplaced} traffic lights have neither a position nor a reference to the"
                " map: they are listed as entities, but are in no graph"
            )
        if self._untimed:
            warn(f"{self._untimed} frames bear no time of their own: their log time is taken")
        if self._ego < 0:
            warn("no host vehicle is among the moving objects: there is no ego unless one is named")

    def complete(self, frames: list[RawFrame]) -> list[FrameRows]:
        """Frames with their numbers, read for all of them at once."""
        values, usable = self._bases.read([base for frame in frames for base in frame.bases])
        turned = usable & (np.abs(values[:, _HEADING]) > math.pi)
        values[turned, _HEADING] = np.remainder(values[turned, _HEADING] + np.pi, 2 * np.pi) - np.pi
        done: list[FrameRows] = []
        start = 0
        for frame in frames:
            stop = start + len(frame.bases)
            done.append(self._rows(frame, values[start:stop], usable[start:stop]))
            start = stop
        return done

    def _raw(self, message: Any, ground: Any, log_time: int) -> RawFrame:
        time_ns = self._time_of(message, ground, log_time)
        frame = RawFrame(time_ns, log_time, self._lights.rows(), pedals(message))
        add_node, add_base, add_lights = (
            frame.nodes.append,
            frame.bases.append,
            frame.lights.append,
        )
        nodes, lights_of, told = self._nodes, self._light_bits, self._has_lights
        for thing in ground.moving_object:
            ident = thing.id.value
            node = nodes.get(ident)
            if node is None:
                node = nodes[ident] = self._enter(thing)
            add_node(node)
            add_base(thing.base.SerializeToString())
            if told:
                vehicle = thing.vehicle_classification
                key = vehicle.SerializeToString()
                lights = lights_of.get(key)
                add_lights(self._remember_lights(key, vehicle) if lights is None else lights)
            else:
                add_lights(-1)
        return frame

    def _rows(self, frame: RawFrame, values: Floats, usable: Bools) -> FrameRows:
        """A frame with its numbers, without the rows that cannot be used."""
        node = np.array(frame.nodes, np.int64)
        lights = np.array(frame.lights, np.int64)
        if not usable.all():
            for row in np.flatnonzero(~usable):
                self._unuse("moving object {} has no usable pose", int(node[row]), frame)
            node, values, lights = node[usable], values[usable], lights[usable]
        first = np.unique(node, return_index=True)[1]
        if len(first) < len(node):
            for row in np.setdiff1d(np.arange(len(node)), first):
                reason = "moving object {} comes more than once in a frame"
                self._unuse(reason, int(node[row]), frame)
            first.sort()
            node, values, lights = node[first], values[first], lights[first]
        light_node, light_values, light_state = frame.heads
        ego = self._nodes.get(self._ego, -1)
        return FrameRows(
            time_ns=frame.time_ns,
            log_time_ns=frame.log_time_ns,
            ego=ego if (node == ego).any() else -1,
            node=np.concatenate([node, light_node]),
            values=np.concatenate([values, light_values]),
            lights=np.concatenate([lights, np.full(len(light_node), -1, np.int64)]),
            light_state=np.concatenate([np.full(len(node), -1, np.int64), light_state]),
            controls=frame.controls,
        )

    def _unuse(self, reason: str, node: int, frame: RawFrame) -> None:
        self._unusable.add(reason.format(self._idents[node]), frame.log_time_ns)

    def _remember_lights(self, key: bytes, vehicle: Any) -> int:
        """Lights of a vehicle, from now on known by the bytes of its classification."""
        if len(self._light_bits) >= _REMEMBERED:
            self._light_bits.clear()
        told = vehicle.HasField("light_state")
        bits = self._light_bits[key] = light_bits(vehicle.light_state) if told else -1
        return bits

    def _enter(self, thing: Any) -> int:
        """Enter a moving object that is seen for the first time."""
        meanings = type_meanings()
        type_name = enum_name(thing, "type")
        special = ""
        if thing.type == _VEHICLE:
            vehicle = thing.vehicle_classification
            told = enum_name(vehicle, "type")
            type_name = type_name if told in _UNTOLD else told
            role = enum_name(vehicle, "role") if has_field(type(vehicle), "role") else ""
            special = meanings[role.lower()].special if role.lower() in meanings else ""
        meaning = meanings.get(type_name.lower(), TypeMeaning("unknown"))
        meaning = replace(meaning, special=special or meaning.special)
        node = self.roster.enter(str(thing.id.value), meaning, type_name)
        self._idents[node] = thing.id.value
        return node

    def _look_at_statics(self, name: str, things: Iterable[Any], log_time: int) -> None:
        """Enter the static things that were not seen before."""
        for thing in things:
            key = (name, thing.id.value)
            if key in self._statics:
                continue
            self._statics.add(key)
            told = thing.main_sign if name == "traffic_sign" else thing
            pose = static_pose(told.base)
            if pose is None:
                words = name.replace("_", " ")
                self._unusable.add(f"{words} {key[1]} has no usable pose", log_time)
                continue
            type_name = enum_name(told.classification, "type")
            prefix, otherwise = _STATIC_OBJECTS[name]
            meaning = type_meanings().get(f"{prefix}_{type_name}".lower(), TypeMeaning(otherwise))
            self.roster.enter(str(key[1]), meaning, type_name, map_ref(thing), pose)
            if meaning.kind == "sign" and (type_name in _UNTOLD or type_name[-1].isdigit()):
                self.roster.count_unknown(type_name)

    def _time_of(self, message: Any, ground: Any, log_time: int) -> int:
        for part in (ground, message):
            if part.HasField("timestamp"):
                time_ns = part.timestamp.seconds * 1_000_000_000 + part.timestamp.nanos
                if abs(time_ns) < _LATEST:
                    return time_ns
        self._untimed += 1
        return log_time


_STATIC_OBJECTS: Final = {
    "stationary_object": ("stationary", "unknown"),
    "traffic_sign": ("sign", "sign"),
}
"""Fields of a ground truth → prefix of their types in ``vocabulary.toml``, kind of what that does not map."""


def light_bits(state: Any) -> int:
    """Mask of :data:`sgstore.vocabulary.VEHICLE_LIGHTS` for a ``LightState``; -1 if it tells nothing."""
    if not state.ListFields():
        return -1
    bits = _INDICATORS.get(state.indicator_state, 0)
    for name, bit in _LIGHTS:
        bits |= (getattr(state, name, 0) >= _LIT) << bit
    return bits


def pedals(message: Any) -> tuple[float, float, float]:
    """Steer, throttle and brake of the host vehicle as a sensor view tells them; NaN what it does not.

    The angle of a steering wheel is no normalised steer: that is always NaN.
    """
    if "host_vehicle_data" not in message.DESCRIPTOR.fields_by_name:
        return _NO_VECTOR
    data = message.host_vehicle_data
    return (
        NAN,
        _number(data, "vehicle_powertrain", "pedal_position_acceleration"),
        _number(data, "vehicle_brake_system", "pedal_position_brake"),
    )


def _number(message: Any, part: str, name: str) -> float:
    inner = getattr(message, part, None)
    return float(getattr(inner, name)) if inner is not None and inner.HasField(name) else NAN


class _Tally:
    """What happened how often, and when; so that a thousand losses of one kind are one line."""

    MOST: Final = 1000

    def __init__(self) -> None:
        self._found: dict[str, Loss] = {}

    def add(self, reason: str, log_time: int, size: int = 0) -> None:
        """Count one more."""
        if reason not in self._found and len(self._found) >= self.MOST:
            reason = "and more of the same kinds"
        last = self._found.get(reason) or Loss(reason, 0, 0, log_time, log_time)
        self._found[reason] = Loss(
            reason,
            last.messages + 1,
            last.bytes + size,
            min(last.start_ns, log_time),
            max(last.end_ns, log_time),
        )

    def losses(self) -> list[Loss]:
        """One loss for each reason; ``messages`` is how often."""
        return list(self._found.values())
