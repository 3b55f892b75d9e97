"""Reader of ASAM OSI recordings. It decodes ground truth messages into frames.

A recording is recognised only by the schemas of its channels: topics are arbitrary, and most files lack the
standard metadata. A frame is one message of the leading channel, in file order. The road map is that of an
``osi3.MapAsamOpenDrive`` message, as recorded by omega-prime, or is made of the lanes.

Weather and light in the ground truth become events of the report, at the start and at every change.

Source: open-simulation-interface 3.8.0 (osi_environment.proto); omega-prime specification.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from sgstore.base.display import number_of
from sgstore.mcap import Loss
from sgstore.model.vocabulary import KINDS, TypeMeaning, type_meanings
from sgstore.model.world import POSE, Event
from sgstore.readers._base import SurveyedDecoder, SurveyedTrace
from sgstore.readers._blocks import NAN, NO_INPUTS, FrameRows, LossTally
from sgstore.readers._stamps import NO_TIME
from sgstore.readers.osi._objects import (
    UNTOLD,
    MovingObjects,
    TrafficLights,
    code_of,
    own_attributes,
)
from sgstore.readers.osi._schema import (
    CONDITIONS,
    DECODE_ERRORS,
    GROUND_TRUTH,
    SENSOR_VIEW,
    TRAFFIC_LIGHT,
    enum_name,
    has_field,
    lights_of,
    parse,
    part_class,
    time_of,
)
from sgstore.readers.osi._survey import OsiSurvey, hosts_of, is_key, keys_of, schema_name

if TYPE_CHECKING:
    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import Bools, Floats, Ints, TraceReport
    from sgstore.readers._blocks import Called, EntityTable


TYPE: Final = "osi3.EnvironmentalConditions"
_CLASSES: Final = (
    ("precipitation", "precipitation"),
    ("fog", "fog"),
    ("illumination", "ambient_illumination"),
)
"""Pairs: name in an event, and OSI field with its class."""


class Environment:
    """Weather and light of an OSI trace. Each change becomes an event.

    Parameters
    ----------
    message : type
        Class of the messages of the leading channel, which contain the conditions as bytes.
    roster : EntityTable
        Receives an event of kind ``environment`` at every change of a class of conditions. Its ``detail`` is,
        for example, ``precipitation=light, fog=mist, illumination=level5, clouds=six_oktas,
        time_of_day=13:05:00``.
    """

    def __init__(self, message: type[Any], roster: EntityTable) -> None:
        self._roster = roster
        self._told = b""
        self._state = ""
        self._unread = 0
        self._class = part_class(message, CONDITIONS)

    def look(self, ground: Any, time_ns: int, log_time_ns: int, seq: int) -> None:
        """Read weather and light from an OSI message. Add an event for each change.

        Missing conditions keep their values.
        """
        told = getattr(ground, "environmental_conditions", b"")
        if not told or told == self._told or self._class is None:
            return
        self._told = told
        try:
            conditions: Any = self._class.FromString(told)
            state, more = classes_of(conditions), numbers_of(conditions)
        except DECODE_ERRORS:  # The rest of the message is still read.
            self._unread += 1
            return
        if state == self._state or not state:
            return
        self._state = state
        detail = ", ".join([state, *more])
        self._roster.happen(Event("environment", time_ns, log_time_ns, seq, detail=detail))

    def settle(self) -> None:
        """Add a warning to the report if weather and light could not be read."""
        if self._unread:
            words = f"weather and light cannot be read where they changed {number_of(self._unread, 'time')}"
            self._roster.report.warnings.append(words)


def classes_of(conditions: Any) -> str:
    """Return classes of weather and light as text, such as ``precipitation=light, fog=mist``."""
    told = [(word, _class(conditions, field)) for word, field in _CLASSES]
    if "clouds" in conditions.DESCRIPTOR.fields_by_name and conditions.HasField("clouds"):
        told.append(("clouds", _class(conditions.clouds, "fractional_cloud_cover")))
    return ", ".join(f"{word}={value}" for word, value in told if value)


def numbers_of(conditions: Any) -> list[str]:
    """Return the known ones of time of day and temperature in an OSI message, as texts."""
    told: list[str] = []
    if conditions.HasField("time_of_day"):
        minutes, seconds = divmod(conditions.time_of_day.seconds_since_midnight % 86_400, 60)
        told.append(f"time_of_day={minutes // 60:02}:{minutes % 60:02}:{seconds:02}")
    if conditions.HasField("temperature"):
        told.append(f"temperature={conditions.temperature:.1f} K")
    return told


def _class(message: Any, field: str) -> str:
    """Return an OSI enumeration value in lower case without the prefix of its type; empty if unknown."""
    told = message.DESCRIPTOR.fields_by_name.get(field)
    if told is None or told.enum_type is None or not message.HasField(field):
        return ""
    names = told.enum_type.values_by_number
    number = getattr(message, field)
    if 0 not in names or number not in names or number == 0:
        return ""
    prefix = names[0].name.removesuffix("UNKNOWN")
    return str(names[number].name).removeprefix(prefix).lower()


# OSI messages → frames: moving objects as rows, static objects as entities, lights with their last state.
# * A moving object becomes a row. OSI's position is the centre of the box; its axes and units equal those of
#   sgstore. A missing sub-message (velocity, acceleration, …) means unknown. A missing number in a sub-message
#   is 0, because producers omit zeros.
# * Static objects are added with the first frame, for any position in the file.
# * Traffic lights become one entity per head, with a row in every frame.
# * A ground truth may be split over messages of one time on one channel, or over channels. Messages of other
#   channels with the time of a frame belong to this frame.
#
# Source: open-simulation-interface 3.8.0 (osi_object.proto, osi_hostvehicledata.proto).

NO_EGO: Final = "the moving objects contain no host vehicle; name one as the ego"
"""Warning for a report on a trace without an ego."""

_VEHICLE: Final = 2
"""Number of the type vehicle. Then ``vehicle_classification.type`` contains the vehicle type."""
_UNSET: Final = "TYPE_UNKNOWN"
_HEADING: Final = POSE.index("heading")
_UNKNOWN: Final = -2
_MOST_AHEAD: Final = 16
"""Largest number of time stamps for which objects of other channels wait until their frame is read."""


@dataclass(slots=True)
class OsiRawFrame:
    """Frame of an OSI recording before conversion. Its objects are still serialised.

    Attributes
    ----------
    time_ns, log_time_ns : int
    heads : tuple of arrays
        Rows of the traffic lights: node ids, columns, states.
    controls : tuple of float
        As in :class:`~sgstore.readers._blocks.FrameRows`.
    own : tuple of float
        Controls in its own messages.
    nodes : list of int
        Node id of each moving object, without duplicates.
    objects : list of bytes
        The moving objects.
    host : int or None
        Id of the host vehicle in its messages.
    """

    time_ns: int
    log_time_ns: int
    heads: tuple[Ints, Floats, Ints]
    controls: tuple[float, ...] = NO_INPUTS
    own: tuple[float, ...] = NO_INPUTS
    nodes: list[int] = field(default_factory=list[int])
    objects: list[bytes] = field(default_factory=list[bytes])
    host: int | None = None


class OsiDecoder(SurveyedDecoder[OsiRawFrame, OsiSurvey]):
    """Decoder of OSI ground truth messages into frames.

    Parameters
    ----------
    survey : OsiSurvey
        Result of the first reading.
    report : TraceReport
        Receives losses and warnings.
    """

    def __init__(self, survey: OsiSurvey, report: TraceReport) -> None:
        super().__init__(survey, report)
        self.channels = frozenset({*survey.leads, *survey.hosts})
        self._ego = survey.ego
        self._idents = survey.cast.idents()
        self._nodes: dict[int, int] = {}
        self._keys: dict[bytes, int] = {}
        self._last_keys: list[bytes] = []
        self._last_nodes: list[int] = []
        self._open: OsiRawFrame | None = None
        self._told_by = -1
        self._ahead: dict[int, list[bytes]] = {}
        self._aside: dict[int, int] = {}
        self._controls = NO_INPUTS
        lead = survey.leads[survey.leading]
        self._class = lead.objects  # Field numbers are the same in every version.
        self._objects = MovingObjects(self._class)
        self._codes: dict[int, int] = {}
        self._kinds: dict[int, str] = {}
        names = {bulb: one.name for bulb, one in survey.signals.items()}
        self._lights = TrafficLights(self.roster, part_class(lead.message, TRAFFIC_LIGHT), names)
        self._environment = Environment(lead.message, self.roster)
        self._has_controls = any(
            has_field(one.message, "host_vehicle_data") for one in survey.leads.values()
        )
        self._frames = 0

    def decode(self, run: Messages, row: int) -> OsiRawFrame | None:
        """Return the frame that an OSI message starts, before conversion; ``None`` for other messages.

        Other contents of the message are stored.
        """
        channel, log_time = int(run.channel[row]), int(run.log_time_ns[row])
        if channel in self._leading:
            self._stamps.next()
        try:
            data = bytes(run.data(row))
            if channel in self._survey.hosts:
                self._take_controls(self._survey.hosts[channel].FromString(data), log_time)
                return None
            told = parse(self._survey.leads[channel].message, data)
            message, ground, _ = told
            if not self.is_inside(log_time):
                self._lights.update(lights_of(ground))
                return None
            stamp = time_of(message, ground)
            if channel not in self._leading:
                self._take_aside(told, self._stamps.beside(log_time, stamp))
                return None
            time_ns = self._stamps.time(log_time, stamp)
            if time_ns is not None:
                return self._frame(told, time_ns, log_time, channel)
            self.lose(NO_TIME, run, row)
        except DECODE_ERRORS as error:
            what = "a ground truth message cannot be read"
            self.lose(f"{what}: {type(error).__name__}: {error}", run, row)
        return None

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        self._environment.settle()
        warn = self._report.warnings.append
        if self._lights.unplaced:
            warn(
                f"{self._lights.unplaced} traffic lights have neither a position nor a reference to the"
                " map: they are listed as entities, but are in no graph"
            )
        if self._lights.unreadable:
            warn(
                f"traffic lights cannot be read where they changed {number_of(self._lights.unreadable, 'time')}"
            )
        super().settle()
        never = {ident: count for ident, count in self._aside.items() if ident not in self._nodes}
        for ident, count in list(never.items())[: LossTally.MOST]:
            reason = f"moving object {ident} appears only between the frames of the leading channel"
            self._report.losses.append(
                Loss(f"{reason}: {number_of(count, 'state')} left out", 0, 0)
            )
        if self._ego is None:
            self._warn_of_egos(NO_EGO)

    def complete(self, frames: list[OsiRawFrame]) -> list[FrameRows]:
        """Convert OSI frames: compute poses, speeds and sizes of many frames at once."""
        objects = [content for frame in frames for content in frame.objects]
        values, usable, lights, codes = self._objects.read(objects)
        turned = usable & (np.abs(values[:, _HEADING]) > math.pi)
        values[turned, _HEADING] = np.remainder(values[turned, _HEADING] + np.pi, 2 * np.pi) - np.pi
        node = np.array([node for frame in frames for node in frame.nodes], np.int64)
        stands = np.full(len(node), -1, np.int64)
        whole = bool(usable.all())
        kinds = self._other_kinds(frames, node, np.where(usable, codes, -1), objects)
        done: list[FrameRows] = []
        start = 0
        for frame in frames:
            rows = slice(start, start + len(frame.objects))
            self._ego = self._ego if frame.host is None else frame.host
            ego = -1 if self._ego is None else self._nodes.get(self._ego, -1)
            one = FrameRows(
                time_ns=frame.time_ns,
                log_time_ns=frame.log_time_ns,
                ego=ego if ego in frame.nodes else -1,
                node=node[rows],
                values=values[rows],
                lights=lights[rows],
                light_state=stands[rows],
                controls=frame.controls,
                own={
                    one: told
                    for one, content in zip(frame.nodes, frame.objects, strict=True)
                    if (told := own_attributes(content, self._class, is_ego=one == ego))
                },
                kinds=kinds.get(len(done), {}),
            )
            one = one if whole else self._usable(one, usable[rows], ego)
            done.append(one.with_heads(frame.heads))
            start = rows.stop
        return done

    def _other_kinds(
        self, frames: list[OsiRawFrame], node: Ints, codes: Ints, objects: list[bytes]
    ) -> dict[int, dict[int, Called]]:
        """Return the objects whose kind has changed since their first frame: frame → node id → present kind."""
        entered = np.full(self.roster.size, -1, np.int64)
        entered[[*self._codes]] = [*self._codes.values()]
        rows = np.flatnonzero((codes >= 0) & (codes != entered[node]))
        ends = np.cumsum([len(frame.objects) for frame in frames])
        found: dict[int, dict[int, Called]] = {}
        for row in rows.tolist():
            number, code = int(node[row]), int(codes[row])
            kind = KINDS[self.roster.entered(number).kind]
            if self._kinds.get(code) == kind:
                continue
            called = self._called(self._class.FromString(objects[row]))
            self._kinds[code] = called[0].kind
            if called[0].kind != kind:
                frame = int(np.searchsorted(ends, row, side="right"))
                found.setdefault(frame, {})[number] = called
        return found

    def _frame(
        self, told: tuple[Any, Any, list[bytes]], time_ns: int, log_time: int, channel: int
    ) -> OsiRawFrame | None:
        """Return a new frame for a message; ``None`` if the message continues the frame before."""
        message, ground, contents = told
        nodes, objects = self._met(contents, log_time)
        last, before, self._told_by = self._open, self._told_by, channel
        same_time = last is not None and time_ns == last.time_ns
        if last and same_time and (before != channel or not set(nodes) & set(last.nodes)):
            self._lights.update(lights_of(ground))
            self._join(last, message, nodes, objects)
            return None
        if last is None:
            self._enter_statics()
        self._lights.update(lights_of(ground))
        frame = OsiRawFrame(time_ns, log_time, self._lights.rows())
        self._open = frame
        self._environment.look(ground, frame.time_ns, log_time, self._frames)
        self._frames += 1
        self._join(frame, message, nodes, objects)
        for ahead in [time for time in self._ahead if time <= frame.time_ns]:
            contents = self._ahead.pop(ahead)
            if ahead == frame.time_ns:
                self._join(frame, None, *self._met(contents, log_time))
            else:
                self._leave_aside(contents)
        return frame

    def _join(
        self, frame: OsiRawFrame, message: Any, nodes: list[int], objects: list[bytes]
    ) -> None:
        """Add objects and vehicle controls of a message to a frame, unless the frame already has them."""
        if not frame.nodes:
            frame.nodes, frame.objects = nodes, objects
        else:
            there = set(frame.nodes)
            for node, content in zip(nodes, objects, strict=True):
                if node not in there:
                    frame.nodes.append(node)
                    frame.objects.append(content)
        frame.heads = self._lights.rows()
        if self._survey.follows and frame.host is None and message is not None:
            known = self._survey.cast.names
            frame.host = next((host for host in hosts_of(message) if host in known), None)
        if self._controls is NO_INPUTS and not self._has_controls:
            return
        data = getattr(message, "host_vehicle_data", None)
        own = controls_of(data)
        frame.own = own if frame.own is NO_INPUTS else _first_told(frame.own, own)
        carried = frame.controls is NO_INPUTS and self._controls is NO_INPUTS
        frame.controls = (
            frame.own if carried else _first_told(frame.own, frame.controls, self._controls)
        )

    def _take_controls(self, data: Any, log_time: int) -> None:
        """Remember the vehicle controls of the ego. Add them to the last frame if it has the same log time."""
        self._controls = told = controls_of(data)
        last = self._open
        if last is not None and log_time == last.log_time_ns:
            last.controls = _first_told(last.own, told)

    def _take_aside(self, told: tuple[Any, Any, list[bytes]], time_ns: int) -> None:
        """Add objects of another channel to the frame of the same time, or keep them for a later frame."""
        message, ground, contents = told
        last = self._open
        self._lights.update(lights_of(ground))
        controls = controls_of(getattr(message, "host_vehicle_data", None))
        if not all(math.isnan(value) for value in controls):
            self._controls = controls
        if last is not None and time_ns == last.time_ns:
            self._join(last, message, *self._met(contents, last.log_time_ns))
        elif last is None or time_ns > last.time_ns:
            self._ahead.setdefault(time_ns, []).extend(contents)
            if len(self._ahead) > _MOST_AHEAD:
                self._leave_aside(self._ahead.pop(next(iter(self._ahead))))
        else:
            self._leave_aside(contents)

    def _leave_aside(self, contents: list[bytes]) -> None:
        """Count the objects of a message if no frame has the same time."""
        for content in contents:
            with suppress(*DECODE_ERRORS):
                ident = int(self._class.FromString(content).id.value)
                self._aside[ident] = self._aside.get(ident, 0) + 1

    def _met(self, objects: list[bytes], log_time: int) -> tuple[list[int], list[bytes]]:
        """Return node ids and bytes of serialised objects. Unreadable ones and duplicates count as lost."""
        keys = keys_of(objects, self._last_keys)
        if keys is self._last_keys:  # The same objects as in the last frame, in the same order.
            return self._last_nodes.copy(), objects
        nodes = [self._keys.get(key, _UNKNOWN) for key in keys]
        known = _UNKNOWN not in nodes
        if not known:
            for row, node in enumerate(nodes):
                if node == _UNKNOWN:
                    nodes[row] = self._node_of(objects[row], keys[row], log_time)
        if len(set(nodes)) == len(nodes) and -1 not in nodes:
            if known or all(map(self._keys.__contains__, keys)):
                self._last_keys, self._last_nodes = keys, nodes.copy()
            return nodes, objects
        rows: dict[int, int] = {}
        for row, node in enumerate(nodes):
            if node >= 0 and rows.setdefault(node, row) != row:
                reason = "moving object {} comes more than once in a frame"
                self._unusable.add(reason.format(self._number(node)), log_time)
        return list(rows), [objects[row] for row in rows.values()]

    def _node_of(self, content: bytes, key: bytes, log_time: int) -> int:
        """Decode the id of a new object, and return its node id; -1 if it is malformed.

        A new object is added.
        """
        try:
            thing = self._class.FromString(content)
        except DECODE_ERRORS as error:
            self._unusable.add(f"a moving object cannot be read ({error})", log_time)
            return -1
        ident = thing.id.value
        node = self._nodes.get(ident)
        if node is None:
            node = self._nodes[ident] = self._enter(thing)
        if is_key(key, thing):
            self._keys[key] = node
        return node

    def _enter(self, thing: Any) -> int:
        """Add a new OSI moving object to the object table, and return its node id."""
        meaning, type_name = self._called(thing)
        if meaning.kind == "vehicle" and not meaning.subkind:
            self.roster.count_unknown(type_name)
        ident = self._idents.get(thing.id.value, str(thing.id.value))
        node = self.roster.enter(ident, meaning, type_name, trailer=self._trailer(thing))
        self._codes[node] = code_of(thing)
        return node

    def _trailer(self, thing: Any) -> str:
        """Return the id of the trailer that a vehicle pulls; empty if it pulls none."""
        vehicle = getattr(thing, "vehicle_classification", None)
        if vehicle is None or not has_field(type(vehicle), "trailer_id"):
            return ""
        if not vehicle.HasField("trailer_id"):
            return ""
        number = vehicle.trailer_id.value
        return self._idents.get(number, str(number))

    def _called(self, thing: Any) -> Called:
        """Return the kind and the type name of an OSI moving object.

        Its vehicle type counts if the object is a vehicle or has no type.
        """
        meanings = type_meanings()
        type_name = enum_name(thing, "type")
        vehicle = getattr(thing, "vehicle_classification", None)
        told = _UNSET if vehicle is None else enum_name(vehicle, "type")
        is_vehicle = thing.type == _VEHICLE or (type_name == _UNSET and told != _UNSET)
        special = ""
        if is_vehicle:
            type_name = type_name if told in UNTOLD else told
            role = enum_name(vehicle, "role") if has_field(type(vehicle), "role") else ""
            special = meanings[role.lower()].special if role.lower() in meanings else ""
        vague = TypeMeaning("vehicle" if is_vehicle else "unknown")
        meaning = meanings.get(type_name.lower(), vague)
        if special:
            meaning = replace(meaning, special=special)
        return meaning, type_name

    def _enter_statics(self) -> None:
        statics = self._survey.statics
        statics.enter(self.roster, self._survey.map_text)
        for words, log_time in statics.unplaced.items():
            self._unusable.add(words, log_time)

    def _number(self, node: int) -> int:
        """Return the id that a moving object has in the OSI recording, for a node id."""
        return next(ident for ident, known in self._nodes.items() if known == node)

    def _usable(self, frame: FrameRows, usable: Bools, ego: int) -> FrameRows:
        """Return a frame without the objects that have no usable pose. Count these as unusable."""
        for node in frame.node[~usable].tolist():
            words = f"moving object {self._number(node)} has no usable pose"
            self._unusable.add(words, frame.log_time_ns)
        node = frame.node[usable]
        return replace(
            frame,
            ego=ego if (node == ego).any() else -1,
            node=node,
            values=frame.values[usable],
            lights=frame.lights[usable],
            light_state=frame.light_state[usable],
        )


def controls_of(data: Any) -> tuple[float, ...]:
    """Return the vehicle controls in an OSI message about the host vehicle. Missing ones are NaN.

    The columns are :data:`sgstore.model.world.INPUTS`. Steering is always NaN, because the angle of the
    steering wheel is not normalised and its range is unknown. The hand brake is always NaN, because OSI has
    none.
    """
    return (
        NAN,
        _number(data, "vehicle_powertrain", "pedal_position_acceleration"),
        _number(data, "vehicle_brake_system", "pedal_position_brake"),
        _number(data, "vehicle_powertrain", "gear_transmission"),
        NAN,
    )


def _first_told(*controls: tuple[float, ...]) -> tuple[float, ...]:
    """For each vehicle control (steering, throttle, …), return the first known value."""
    return tuple(
        next((value for value in values if not math.isnan(value)), NAN)
        for values in zip(*controls, strict=True)
    )


def _number(message: Any, part: str, name: str) -> float:
    inner = getattr(message, part, None)
    told = inner is not None and name in inner.DESCRIPTOR.fields_by_name and inner.HasField(name)
    return float(getattr(inner, name)) if told else NAN


class OsiTrace(SurveyedTrace[OsiSurvey]):
    """Open OSI recording, which yields frames.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or name (``entity_name`` of a source reference) of the ego; empty: the host vehicle, else an object
        with a usual name of egos.
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
        The schema is malformed, no frame can be read, or the given ego does not exist.
    """

    name: ClassVar[str] = "osi"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        super().__init__(lambda: OsiSurvey(recording, ego), digest)

    @staticmethod
    def has_frames(recording: Recording, channel: int) -> bool:
        """Return True if a channel contains OSI ground truth."""
        return schema_name(recording, channel) in {GROUND_TRUTH, SENSOR_VIEW}

    def _decoder(self, report: TraceReport) -> OsiDecoder:
        return OsiDecoder(self._survey, report)
