"""Decoder of OSI moving objects, stationary objects and traffic lights into columns.

``osi3.MovingObject`` messages of many frames are decoded directly from their bytes.

Almost all numbers of an object are doubles, and the objects of a frame usually have the same fields. The same
bytes are then at the same positions, and the numbers between them are columns of a matrix. The layout of one
object is therefore learned byte by byte. All objects with the same non-number bytes are read at once. The
remaining objects define the next layout. Reading the same numbers as attributes takes six times as long.

A ground truth is parsed with its objects as bytes (:data:`sgstore.readers.osi._schema.OPAQUE`), so an object
may be malformed inside a valid message. Objects with an unusual layout (a repeated field, a group) or a unique
layout are decoded by protobuf itself.

Source: protobuf encoding (protobuf.dev/programming-guides/encoding); osi_object.proto.
"""

from __future__ import annotations

import json
import math
import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.maps.opendrive import kind_of_object
from sgstore.model.vocabulary import (
    ENTITY_KINDS,
    LIGHT_STATE_CODE,
    SIGNALS,
    TypeMeaning,
    type_meanings,
)
from sgstore.model.world import ATTRIBUTE, LONGEST_TEXT, POSE
from sgstore.readers._blocks import FAR, NAN
from sgstore.readers.osi._lanes import OWN, LaneSignal
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    assigned_lanes,
    enum_name,
    fields_of,
    has_field,
    identifiers,
    map_ref,
    static_pose,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.readers._blocks import EntityTable

    Bytes = NDArray[np.uint8]


BASE: Final = {
    "position": {axis: axis for axis in "xyz"},
    "orientation": {"yaw": "heading", "pitch": "pitch", "roll": "roll"},
    "velocity": {axis: f"v{axis}" for axis in "xyz"},
    "acceleration": {axis: f"a{axis}" for axis in "xyz"},
    "orientation_rate": {"yaw": "yaw_rate"},
    "dimension": {name: name for name in ("length", "width", "height")},
}
"""Part of ``BaseMoving`` → used field → column of a pose."""
_INDICATORS: Final = {3: 0b01, 4: 0b10, 5: 0b11}
"""Name of an ``IndicatorState`` → bits of ``light_left`` and ``light_right``."""
_LIT: Final = 3
"""Smallest value of ``BrakeLightState`` and ``GenericLightState`` that means an active light."""
_LIGHTS: Final = {
    "indicator_state": 0,
    "brake_light_state": 2,
    "reversing_light": 3,
    "head_light": 5,
    "high_beam": 6,
    "front_fog_light": 7,
    "rear_fog_light": 7,
    "emergency_vehicle_illumination": 9,
    "service_vehicle_illumination": 10,
}
"""Field of ``LightState`` → bit in :data:`sgstore.model.vocabulary.VEHICLE_LIGHTS`."""
_STATES: Final = 64
"""Number of light states that are looked up. The OSI version of the recording has no higher values."""

_DOUBLE: Final = 9
"""Size of a double with its field tag; bytes. The tag has one byte for fields up to 15."""
_VARINT, _FIXED64, _BYTES, _GROUP, _GROUP_END = 0, 1, 2, 3, 4
_ROUNDS: Final = 64
"""Largest number of layouts tried for objects of one length. The others are decoded one by one."""
_MOST_LAYOUTS: Final = 256
"""Maximum number of cached layouts for objects of one length. After that, the cache is emptied."""

Tree = dict[int, "Tree | int | str | NDArray[np.int64]"]
"""Fields by number: nested fields, column of a double, light states, or the word ``type`` or ``vehicle``."""
TYPES: Final = 1 << 10
"""Number of vehicle types. The code of an object is its type times this number, plus its vehicle type."""


@dataclass(slots=True)
class _ObjectLayout:
    """Byte positions of the fields in serialised OSI objects that have the same structure.

    ``compared``, ``mask``, ``expected``: positions of all bytes outside numbers, their relevant bits, and the
    values. ``runs``: first column, position and number of adjacent doubles. ``zero``: columns of present
    sub-messages without the number. ``lights``: positions of light states, and their meanings. ``types``:
    positions of types, and their factors in the code of an object. ``parts``: sub-messages present in the base.
    """

    compared: Ints
    mask: Bytes
    expected: Bytes
    runs: list[tuple[int, int, int]]
    zero: Ints
    lights: list[tuple[int, int, NDArray[np.int64]]]
    types: list[tuple[int, int, int]]
    parts: set[str]

    def agree(self, objects: Bytes) -> Bools:
        """Return a mask of the serialised objects whose fields have these byte positions."""
        return ((objects[:, self.compared] & self.mask) == self.expected).all(axis=1)


@dataclass(slots=True)
class _Learned:
    """Byte positions of a serialised object's fields that were found so far."""

    mask: Bytes
    doubles: dict[int, int] = field(default_factory=dict[int, int])
    zero: list[int] = field(default_factory=list[int])
    lights: list[tuple[int, int, NDArray[np.int64]]] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]
    types: list[tuple[int, int, int]] = field(default_factory=list[tuple[int, int, int]])
    parts: set[int] = field(default_factory=set[int])


class MovingObjects:
    """Fast decoder of serialised OSI moving objects (vehicles, pedestrians). It returns columns.

    Parameters
    ----------
    message : type
        Class of ``osi3.MovingObject``, in the recording's version of OSI.
    """

    def __init__(self, message: type[Any]) -> None:
        self._message = message
        self._parts: dict[int, str] = {}
        self._base, self._tree = self._trees(message.DESCRIPTOR)
        self._layouts: dict[int, list[_ObjectLayout]] = {}

    def read(self, objects: list[bytes]) -> tuple[Floats, Bools, Ints, Ints]:
        """Decode serialised moving objects into columns: poses, mask of usable objects, lights and types.

        Returns
        -------
        values : (n, 16) float64
            Columns :data:`sgstore.model.world.POSE`; NaN if the sub-message is missing, 0 if only the number is
            missing.
        usable : (n,) bool
            True with a valid position, and a valid orientation or none. False for a malformed object.
        lights : (n,) int64
            Mask of :data:`sgstore.model.vocabulary.VEHICLE_LIGHTS`; -1 if the object does not contain light
            states.
        codes : (n,) int64
            Type code of each object, as in :func:`code_of`.
        """
        values = np.full((len(objects), len(POSE)), np.nan)
        usable = np.zeros(len(objects), np.bool_)
        lights, codes = np.full(len(objects), -1, np.int64), np.zeros(len(objects), np.int64)
        columns = values, usable, lights, codes
        lengths = np.fromiter(map(len, objects), np.int64, len(objects))
        order = np.argsort(lengths, kind="stable")
        cuts = np.flatnonzero(np.diff(lengths[order])) + 1
        for rows in np.split(order, cuts) if len(order) else ():
            joined = b"".join([objects[row] for row in rows.tolist()])
            content = np.frombuffer(joined, np.uint8).reshape(len(rows), -1)
            for row in self._read_alike(rows, content, columns):
                values[row], usable[row], lights[row], codes[row] = self._read_one(objects[row])
        return columns

    def _read_alike(
        self, rows: NDArray[np.intp], content: Bytes, columns: tuple[Floats, Bools, Ints, Ints]
    ) -> list[int]:
        """Decode objects with the same length and layout. Return the rows with another layout."""
        values, usable, lights, codes = columns
        odd: list[int] = []
        for _ in range(_ROUNDS):
            if not len(rows):
                break
            layout = self._layout_of(content[0])
            agree = None if layout is None else layout.agree(content)
            if layout is None or agree is None:
                odd.append(int(rows[0]))
                rows, content = rows[1:], content[1:]
                continue
            alike = agree.all()
            here, found = (rows, content) if alike else (rows[agree], content[agree])
            values[here], usable[here] = _numbers(layout, found)
            lights[here], codes[here] = _lights(layout, found), _codes(layout, found)
            if alike:
                return odd
            rows, content = rows[~agree], content[~agree]
        return [*odd, *rows.tolist()]

    def _trees(self, found: Any) -> tuple[dict[str, Any], Tree]:
        """Return the protobuf descriptors of the parts of an OSI object, and the fields to read."""
        base = found.fields_by_name["base"]
        parts: dict[str, Any] = {}
        inner: Tree = {}
        column = {name: i for i, name in enumerate(POSE)}
        for part, targets in BASE.items():
            told = base.message_type.fields_by_name.get(part)
            if told is None or told.message_type is None:
                continue
            parts[part] = told
            self._parts[told.number] = part
            within = told.message_type.fields_by_name
            inner[told.number] = {
                within[name].number: column[target]
                for name, target in targets.items()
                if name in within
            }
        tree: Tree = {base.number: inner}
        tree[found.fields_by_name["type"].number] = "type"
        vehicle = found.fields_by_name.get("vehicle_classification")
        within = vehicle.message_type.fields_by_name if vehicle else {}
        inside: Tree = {}
        if "type" in within:
            inside[within["type"].number] = "vehicle"
        state = within.get("light_state")
        if state is not None and state.message_type is not None:
            lamps: Tree = {
                told.number: _meanings(told, bit)
                for name, bit in _LIGHTS.items()
                if (told := state.message_type.fields_by_name.get(name)) is not None
            }
            inside[state.number] = lamps
        if inside:
            tree[vehicle.number] = inside
        self._base_number = int(base.number)
        return parts, tree

    def _layout_of(self, content: Bytes) -> _ObjectLayout | None:
        """Return the byte positions of an object's fields. They are determined at the first such object.

        ``None`` means that the object has no fixed layout.
        """
        layouts = self._layouts.setdefault(len(content), [])
        for layout in layouts:
            if layout.agree(content[None])[0]:
                return layout
        if len(layouts) >= _MOST_LAYOUTS:
            layouts.clear()
        try:
            layouts.append(self._learn(content.tobytes()))
        except ValueError:
            return None
        return layouts[-1]

    def _learn(self, content: bytes) -> _ObjectLayout:
        found = _Learned(np.full(len(content), 0xFF, np.uint8))
        self._walk(content, 0, len(content), self._tree, found, ())
        compared = np.flatnonzero(found.mask)
        mask = found.mask[compared]
        return _ObjectLayout(
            compared=compared,
            mask=mask,
            expected=np.frombuffer(content, np.uint8)[compared] & mask,
            runs=_runs(found.doubles),
            zero=np.array([c for c in found.zero if c not in found.doubles], np.int64),
            lights=found.lights,
            types=found.types,
            parts={self._parts[number] for number in found.parts},
        )

    def _walk(
        self,
        content: bytes,
        start: int,
        stop: int,
        tree: Tree,
        found: _Learned,
        path: tuple[int, ...],
    ) -> None:
        seen: set[int] = set()
        for number, wire, at, end in fields_of(content, start, stop):
            known = tree.get(number)
            if (
                number == 0
                or wire in {_GROUP, _GROUP_END}
                or (known is not None and number in seen)
            ):
                raise ValueError(f"field {number} of wire type {wire}: no layout that others share")
            seen.add(number)
            # For a varint, compare only the bit that marks the last byte.
            found.mask[at:end] = 0x80 if wire == _VARINT else 0
            if isinstance(known, dict) and wire == _BYTES:
                found.mask[at:end] = 0xFF
                if path == (self._base_number,):
                    found.parts.add(number)
                    found.zero += [column for column in known.values() if isinstance(column, int)]
                self._walk(content, at, end, known, found, (*path, number))
            elif isinstance(known, int) and wire == _FIXED64:
                found.doubles[known] = at
            elif isinstance(known, np.ndarray) and wire == _VARINT:
                found.lights.append((at, end, known))
            elif isinstance(known, str) and wire == _VARINT:
                found.types.append((at, end, TYPES if known == "type" else 1))

    def _read_one(self, content: bytes) -> tuple[Floats, bool, int, int]:
        """Decode one serialised OSI object with protobuf. It is unusable if malformed."""
        values = np.full(len(POSE), np.nan)
        try:
            thing = self._message.FromString(content)
        except DECODE_ERRORS:
            return values, False, -1, 0
        for part, targets in BASE.items():
            if part in self._base and thing.base.HasField(part):
                told = getattr(thing.base, part)
                for name, target in targets.items():
                    values[POSE.index(target)] = getattr(told, name, 0.0)
        oriented = thing.base.HasField("orientation")
        near = thing.base.HasField("position") and bool(_near(values[None], oriented=oriented)[0])
        return values, near, light_bits(thing), code_of(thing)


def own_attributes(content: bytes, message: type[Any], *, is_ego: bool) -> dict[str, Any]:
    """Return those attributes of a serialised OSI moving object that have no column.

    They are references of the type ``net.sgstore`` (``attribute:control_steer=0.2``), as a recording of a live
    run has them, and the ego's angular velocity about the map's x and y axes.
    """
    found: dict[str, Any] = {}
    marked = ATTRIBUTE.encode() in content
    if not (marked or is_ego):
        return found
    with suppress(*DECODE_ERRORS):
        thing = message.FromString(content)
        if is_ego and any(thing.base.orientation_rate.HasField(name) for name in ("roll", "pitch")):
            turn, rate = thing.base.orientation, thing.base.orientation_rate
            sin, cos, roll = (
                math.sin(turn.yaw),
                math.cos(turn.yaw),
                rate.roll * math.cos(turn.pitch),
            )
            found["ang_vel_x"] = math.degrees(cos * roll - sin * rate.pitch)
            found["ang_vel_y"] = math.degrees(sin * roll + cos * rate.pitch)
        for source, text in identifiers(thing) if marked else ():
            name, _, value = text.removeprefix(ATTRIBUTE).partition("=")
            if (
                source == "net.sgstore"
                and text.startswith(ATTRIBUTE)
                and len(value) <= LONGEST_TEXT
            ):
                found[name] = json.loads(value)
    return found


def _meanings(told: Any, bit: int) -> NDArray[np.int64]:
    """Return a lookup table: OSI state of a vehicle light → bits of the light mask; -1 for unknown states."""
    table = np.full(_STATES, -1, np.int64)
    for state in told.enum_type.values_by_number if told.enum_type is not None else ():
        if 0 <= state < _STATES:
            table[state] = _INDICATORS.get(state, 0) if bit == 0 else (state >= _LIT) << bit
    return table


def _numbers(layout: _ObjectLayout, content: Bytes) -> tuple[Floats, Bools]:
    values = np.full((len(content), len(POSE)), np.nan)
    values[:, layout.zero] = 0.0
    size = content.shape[1]
    for column, place, count in layout.runs:
        doubles = np.ndarray((len(content), count), "<f8", content.data, place, (size, _DOUBLE))
        values[:, column : column + count] = doubles
    if "position" not in layout.parts:
        return values, np.zeros(len(content), np.bool_)
    return values, _near(values, oriented="orientation" in layout.parts)


def _runs(doubles: dict[int, int]) -> list[tuple[int, int, int]]:
    """Group 8-byte numbers that are adjacent. Return first column, byte position and count of each group."""
    runs: list[tuple[int, int, int]] = []
    for column, place in sorted(doubles.items()):
        if runs and (column, place) == (sum(runs[-1][::2]), runs[-1][1] + _DOUBLE * runs[-1][2]):
            runs[-1] = (*runs[-1][:2], runs[-1][2] + 1)
        else:
            runs.append((column, place, 1))
    return runs


def _near(values: Floats, *, oriented: bool) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.all(np.abs(values[:, : 4 if oriented else 3]) < FAR, axis=1)


def _lights(layout: _ObjectLayout, content: Bytes) -> Ints:
    bits = np.full(len(content), -1, np.int64)
    for start, stop, table in layout.lights:
        state = np.minimum(_whole(content, start, stop), np.uint64(_STATES - 1))
        told = table[state.astype(np.int64)]
        bits = np.where(told < 0, bits, np.maximum(bits, 0) | told)
    return bits


def _codes(layout: _ObjectLayout, content: Bytes) -> Ints:
    codes = np.zeros(len(content), np.int64)
    for start, stop, weight in layout.types:
        told = np.minimum(_whole(content, start, stop), np.uint64(TYPES - 1))
        codes += weight * told.astype(np.int64)
    return codes


def _whole(content: Bytes, start: int, stop: int) -> NDArray[np.uint64]:
    """Decode the protobuf varint in each row of a byte array."""
    found = np.zeros(len(content), np.uint64)
    for place in range(stop - 1, start - 1, -1):
        found = found << np.uint64(7) | (content[:, place] & 0x7F).astype(np.uint64)
    return found


def code_of(thing: Any) -> int:
    """Return a single code number for the type and vehicle type of an OSI moving object."""
    vehicle = getattr(getattr(thing, "vehicle_classification", None), "type", 0)
    told = (part if 0 <= part < TYPES else TYPES - 1 for part in (thing.type, vehicle))
    return next(told) * TYPES + next(told)


def light_bits(thing: Any) -> int:
    """Return the light mask of an OSI vehicle (indicators, brake lights, …); -1 if it has no light states."""
    state = getattr(getattr(thing, "vehicle_classification", None), "light_state", None)
    if state is None or not state.ListFields():
        return -1
    bits = _INDICATORS.get(getattr(state, "indicator_state", 0), 0)
    for name, bit in _LIGHTS.items():
        bits |= (bit > 0 and getattr(state, name, 0) >= _LIT) << bit
    return bits


# Static objects of an OSI recording: stationary objects and traffic signs. Producers write them in the first
# message, in every message, or when the ego comes near. A static object exists also before its first message.
# All static objects are therefore collected before the frames, and are valid for the whole trace.
#
# Source: open-simulation-interface 3.8.0 (osi_object.proto, osi_trafficsign.proto).

_FIELDS: Final = {
    "stationary_object": ("stationary", "unknown"),
    "traffic_sign": ("sign", "sign"),
}
"""Field of a ground truth → prefix of its types in ``vocabulary.toml``, and kind for other types."""
UNTOLD: Final = frozenset({"TYPE_UNKNOWN", "TYPE_OTHER"})
_UNITS: Final = {"UNIT_MILE_PER_HOUR": " mph"}
"""Unit of a speed limit → text after its value. It is empty for km/h."""
_MAP_OBJECT: Final = re.compile(r"<object\s([^<>]*)>")
_MAP_ATTRIBUTE: Final = re.compile(r"""(\w+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")


@dataclass(frozen=True, slots=True)
class _Static:
    ident: str
    meaning: TypeMeaning
    type_name: str
    map_ref: str
    pose: tuple[float, ...]
    unmapped: bool
    lanes: tuple[int, ...] = ()


@dataclass(slots=True)
class Statics:
    """Static objects (such as signs and buildings) of an OSI recording, in the order in which they appear.

    Attributes
    ----------
    unplaced : dict
        Description of each unreadable object or object without a usable pose → its log time.
    """

    unplaced: dict[str, int] = field(default_factory=dict[str, int])
    _found: dict[tuple[str, int], _Static] = field(default_factory=dict)  # pyright: ignore[reportUnknownVariableType]

    def look(self, told: Mapping[str, Any], log_time_ns: int) -> None:
        """Add the static objects of an OSI ground truth message."""
        for name in _FIELDS:
            for thing in told.get(name, ()):
                key = (name, thing.id.value)
                if key in self._found:
                    continue
                try:
                    self._take(key, thing, log_time_ns)
                except DECODE_ERRORS as error:
                    words = f"{name.replace('_', ' ')} {key[1]} cannot be read ({error})"
                    self.unplaced.setdefault(words, log_time_ns)

    def enter(self, roster: EntityTable, map_text: str) -> None:
        """Add all static objects to the object table. If a kind is unknown, use the kind in the map."""
        kinds: dict[str, str] | None = None
        for thing in self._found.values():
            meaning = thing.meaning
            if meaning.kind == "unknown" and not meaning.subkind and thing.map_ref:
                kinds = kinds_of_map(map_text) if kinds is None else kinds
                kind = kinds.get(thing.map_ref, "unknown")
                # A kind that exists only in maps, such as paint on the road, becomes a prop.
                entity = kind in ENTITY_KINDS
                meaning = TypeMeaning(kind) if entity else TypeMeaning("prop", subkind=kind)
            roster.enter(thing.ident, meaning, thing.type_name, thing.map_ref, thing.pose)
            if thing.unmapped:
                roster.count_unknown(thing.type_name)

    def _take(self, key: tuple[str, int], thing: Any, log_time_ns: int) -> None:
        name, number = key
        words = f"{name.replace('_', ' ')} {number} has no usable pose"
        told = thing.main_sign if name == "traffic_sign" else thing
        pose = static_pose(told.base)
        if pose is None:
            self.unplaced.setdefault(words, log_time_ns)
            return
        self.unplaced.pop(words, None)
        type_name = enum_name(told.classification, "type")
        prefix, otherwise = _FIELDS[name]
        meaning = type_meanings().get(f"{prefix}_{type_name}".lower(), TypeMeaning(otherwise))
        if meaning.kind == "speed_limit":
            meaning = _with_value(meaning, told.classification)
        lanes = assigned_lanes(told.classification) if meaning.kind in SIGNALS else []
        self._found[key] = _Static(
            ident=str(number),
            meaning=meaning,
            type_name=type_name,
            map_ref=map_ref(thing) or (f"{OWN}{number}" if lanes else ""),
            pose=pose,
            unmapped=meaning.kind == "sign" and (type_name in UNTOLD or type_name[-1].isdigit()),
            lanes=tuple(lanes),
        )

    def signals(self) -> list[LaneSignal]:
        """Return the traffic signs that are assigned to lanes."""
        return [
            LaneSignal(thing.map_ref, thing.meaning.kind, thing.pose, thing.lanes)
            for thing in self._found.values()
            if thing.lanes
        ]


def _with_value(meaning: TypeMeaning, classification: Any) -> TypeMeaning:
    """Return the meaning of a speed limit sign, with its value as in ``50`` or ``35 mph``."""
    if not has_field(type(classification), "value.value") or not classification.value.value > 0:
        return meaning
    value = classification.value
    unit = enum_name(value, "value_unit") if has_field(type(value), "value_unit") else ""
    words = [meaning.subkind, f"{value.value:g}{_UNITS.get(unit, '')}"]
    return replace(meaning, subkind=" ".join(word for word in words if word))


@lru_cache(maxsize=1)  # A recording is read at least twice.
def kinds_of_map(text: str) -> dict[str, str]:
    """Return the kinds of the objects in an OpenDRIVE map: object id → kind."""
    kinds: dict[str, str] = {}
    for match in _MAP_OBJECT.finditer(text):
        told = {name: a or b for name, a, b in _MAP_ATTRIBUTE.findall(match[1])}
        if "id" in told:
            kinds[told["id"]] = kind_of_object(told.get("type", ""), told.get("name", ""))
    return kinds


# Traffic lights of OSI: bulbs, grouped into heads. OSI has one ``TrafficLight`` message per bulb. Bulbs belong
# to one head if they refer to the same OpenDRIVE signal. Without a reference, they belong to one head if they
# are above each other: the same direction and position in the plane, to a centimetre. The state of a head is
# that of its lit bulbs. Without new messages, it keeps its state.
#
# Source: open-simulation-interface 3.8.0, osi_trafficlight.proto (the numbers of colours and modes).

SAME_PLACE: Final = 0.01
"""Maximum distance in each axis, and maximum rotation, between bulbs of the same traffic light; m, rad."""

_RED, _YELLOW, _GREEN, _FLASHING, _OTHER = 1, 2, 4, 8, 16
_COLOUR: Final = {2: _RED, 3: _YELLOW, 4: _GREEN}
_MODE_OFF, _MODE_CONSTANT, _MODE_FLASHING, _MODE_COUNTING = 2, 3, 4, 5
_SHOWN: Final = (
    (_FLASHING, "flashing"),
    (_RED | _YELLOW, "red_yellow"),
    (_RED, "red"),
    (_YELLOW, "yellow"),
    (_GREEN, "green"),
    (_OTHER, "unknown"),
)
_SUBKINDS: Final = {
    "ICON_WALK": "pedestrian",
    "ICON_DONT_WALK": "pedestrian",
    "ICON_PEDESTRIAN": "pedestrian",
    "ICON_PEDESTRIAN_AND_BICYCLE": "pedestrian",
    "ICON_BICYCLE": "bicycle",
    "ICON_TRAM": "public_transport",
    "ICON_BUS": "public_transport",
    "ICON_BUS_AND_TRAM": "public_transport",
}


def lit(mode: int, colour: int) -> int:
    """Return one bit for the state of a traffic light bulb, from its mode and colour; 0 if it is off."""
    if mode == _MODE_OFF:
        return 0
    if mode == _MODE_FLASHING:
        return _FLASHING
    return _COLOUR.get(colour, _OTHER) if mode in {_MODE_CONSTANT, _MODE_COUNTING} else _OTHER


def shown(bulbs: Iterable[int]) -> int:
    """Combine the states of a traffic light's bulbs into one state, as a code.

    The codes are those of :data:`sgstore.model.vocabulary.LIGHT_STATES`. Flashing has priority. Red with yellow
    is ``red_yellow``. For other combinations, the most restrictive colour counts (a red light with a green
    arrow is red). Without a lit bulb, the state is ``off``.
    """
    together = 0
    for bulb in bulbs:
        together |= bulb
    for bits, name in _SHOWN:
        if together & bits == bits:
            return LIGHT_STATE_CODE[name]
    return LIGHT_STATE_CODE["off"]


@dataclass(slots=True)
class _Head:
    node: int
    map_ref: str
    pose: tuple[float, ...]
    first: int
    lanes: set[int] = field(default_factory=set[int])
    bulbs: dict[int, int] = field(default_factory=dict[int, int])
    bottom: float = math.inf
    top: float = -math.inf

    def join(self, pose: tuple[float, ...]) -> None:
        """Extend this traffic light, so that its position and size include another bulb."""
        _x, _y, z, *rest = pose
        if math.isnan(z):
            return
        x, y = (pose if math.isnan(self.pose[0]) else self.pose)[:2]
        height = 0.0 if math.isnan(rest[-1]) else rest[-1]
        self.bottom = min(self.bottom, z - height / 2)
        self.top = max(self.top, z + height / 2)
        sizes = [max(a, b) for a, b in zip(rest[-3:-1], self.pose[-3:-1], strict=True)]
        whole = (self.top - self.bottom) if not math.isnan(rest[-1]) else NAN
        self.pose = (x, y, (self.bottom + self.top) / 2, *rest[:-3], *sizes, whole)


class TrafficLights:
    """Traffic lights of an OSI trace. Each is made from the single bulbs at one place, as OSI has only bulbs.

    Parameters
    ----------
    roster : EntityTable
        Receives each head as an entity of kind ``traffic_light``; its ident is the id of its first bulb.
    message : type or None
        Class of the bulbs. ``None`` means that the recording's OSI version has no readable class.
    names : mapping, optional
        First bulb of a head without a map reference → name of its signal in the map of the lanes.

    Attributes
    ----------
    unreadable : int
        Number of malformed bulbs.
    """

    def __init__(
        self,
        roster: EntityTable,
        message: type[Any] | None,
        names: Mapping[int, str] | None = None,
    ) -> None:
        self._roster = roster
        self._class = message
        self._names = names or {}
        self._has_service = message is not None and has_field(
            message, "classification.is_out_of_service"
        )
        self.unreadable = 0
        self._heads: list[_Head] = []
        self._head_of: dict[int, _Head] = {}
        self._words: list[bytes] = []
        self._by_ref: dict[str, _Head] = {}
        self._by_cell: dict[tuple[int, int], list[_Head]] = {}
        self._fill()

    @property
    def unplaced(self) -> int:
        """Number of traffic lights without position and without map reference."""
        return len(self._heads) - len(self._rows[0])

    def update(self, words: list[bytes]) -> None:
        """Update bulb states from an OSI message. Bulbs that it does not contain keep their states."""
        if words == self._words or self._class is None:
            return
        news = set(words).difference(self._words)
        self._words = words
        for word in words if news else ():
            if word in news:
                self._take(word, self._class)
        self._fill()

    def _take(self, word: bytes, message: type[Any]) -> None:
        try:
            bulb = message.FromString(word)
            head = self._head_of.get(bulb.id.value) or self._enter(bulb)
        except DECODE_ERRORS:  # The rest of the message is still read.
            self.unreadable += 1
            return
        classification = bulb.classification
        out = self._has_service and classification.is_out_of_service
        head.bulbs[bulb.id.value] = 0 if out else lit(classification.mode, classification.color)

    def signals(self) -> dict[int, LaneSignal]:
        """Return the traffic lights to which lanes are assigned: id of the first bulb → light."""
        return {
            head.first: LaneSignal(
                head.map_ref or f"{OWN}{head.first}",
                "traffic_light",
                head.pose,
                tuple(sorted(head.lanes)),
            )
            for head in self._heads
            if head.lanes
        }

    def rows(self) -> tuple[Ints, Floats, Ints]:
        """Return a row for each traffic light with a position: node ids, pose columns, states."""
        return self._rows

    def _fill(self) -> None:
        placed = [head for head in self._heads if head.map_ref or not math.isnan(head.pose[0])]
        self._rows = (
            np.array([head.node for head in placed], np.int64),
            np.array([head.pose for head in placed], np.float64).reshape(-1, len(POSE)),
            np.array([shown(head.bulbs.values()) for head in placed], np.int64),
        )

    def _enter(self, bulb: Any) -> _Head:
        """Return the traffic light of a bulb. If the bulb belongs to none, add a new traffic light."""
        ident = bulb.id.value
        pose = static_pose(bulb.base) or (NAN,) * 16
        ref, lanes = map_ref(bulb), assigned_lanes(bulb.classification)
        head = self._by_ref.get(ref) if ref else self._beside(pose)
        if head is None:
            icon = enum_name(bulb.classification, "icon")
            meaning = TypeMeaning("traffic_light", subkind=_SUBKINDS.get(icon, ""))
            name = ref or self._names.get(ident, "")
            head = _Head(self._roster.enter(str(ident), meaning, icon, name), ref, pose, ident)
            self._heads.append(head)
            if ref:
                self._by_ref[ref] = head
            elif not math.isnan(pose[0]):
                self._by_cell.setdefault(_cell(pose), []).append(head)
        head.join(pose)
        head.lanes.update(lanes)
        self._head_of[ident] = head
        return head

    def _beside(self, pose: tuple[float, ...]) -> _Head | None:
        """Return the traffic light at the position of a bulb; ``None`` if the position has none yet."""
        if math.isnan(pose[0]):
            return None
        column, line = _cell(pose)
        for i in (column - 1, column, column + 1):
            for j in (line - 1, line, line + 1):
                for head in self._by_cell.get((i, j), ()):
                    if _same_place(head.pose, pose):
                        return head
        return None


def _cell(pose: tuple[float, ...]) -> tuple[int, int]:
    return math.floor(pose[0] / SAME_PLACE), math.floor(pose[1] / SAME_PLACE)


def _same_place(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    turn = math.remainder(a[3] - b[3], 2 * math.pi) if abs(a[3] - b[3]) < FAR else 0.0
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(turn)) <= SAME_PLACE
