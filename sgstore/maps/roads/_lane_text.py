"""Lane text format of sgstore (JSON), which stores use for road maps that are not OpenDRIVE.

The text is JSON with one lane per line, so that people can read it and tools can compare it::

    {"format": "sgstore lanes", "version": 1, "warnings": [], "lanes": [
    {"name": "1/0/-1", "type": "driving", …, "left": [x, y, x, y, …], "right": […], "z": […], "onto": [1]},
    …
    ], "signals": [{"name": "7", "kind": "traffic_light", "x": 1.5, "y": -3.0, "lanes": [0]}]}

``signals``, ``crosswalks`` and ``objects`` are optional. Lengths are rounded to a tenth of a
millimetre when the text is written. The map is always made from the text; therefore a map that is
read back is equal to the original. The texts come from untrusted files; the reader checks every
value.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.roads._lanes import (
    OBJECT_KINDS,
    PlainCrosswalk,
    PlainLane,
    PlainObject,
    PlainSignal,
    road_map_of,
)
from sgstore.model.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.maps.roads._map import RoadMap
    from sgstore.model.world import Floats

FORMAT: Final = "sgstore lanes"
VERSION: Final = 1

MAX_CHARACTERS: Final = 64 << 20
MAX_LANES: Final = 100_000
MAX_SIGNALS: Final = 100_000
MAX_SECTIONS: Final = 4_000_000
"""Largest number of cross sections of all lanes."""
MAX_COORDINATE: Final = 1e8
"""Largest distance from the origin; m."""
MAX_NAME: Final = 200
MAX_RELATED: Final = 1_000
"""Largest number of lanes that one relation can link to a lane."""
OF_LANES: Final = " (lanes)"
"""Suffix of names of maps in lane text, which contain less than the OpenDRIVE map of the same name."""
DIGITS: Final = 4
"""Number of decimal digits of a length in metres."""

_NAMES: Final = ("name", "type", "road", "junction", "roundabout")
_POSE: Final = ("x", "y", "z", "heading")
_RELATED: Final = ("onto", "left_beside", "right_beside", "against")


def is_lane_text(text: str) -> bool:
    """Return True if a map text begins like a JSON object, and so is probably in the lane text format."""
    return text[:100].lstrip("\ufeff \t\r\n").startswith("{")


def lane_text(
    lanes: Sequence[PlainLane],
    warnings: Iterable[str] = (),
    signals: Sequence[PlainSignal] = (),
    crosswalks: Sequence[PlainCrosswalk] = (),
    objects: Sequence[PlainObject] = (),
) -> str:
    """Write lanes, signals, crosswalks and objects as JSON text (lane text format of sgstore)."""
    head = {"format": FORMAT, "version": VERSION, "warnings": list(warnings)}
    rows = ",\n".join(_dumps(_fields(lane)) for lane in lanes)
    more = ",\n".join(_dumps(_signal_fields(signal)) for signal in signals)
    more = f', "signals": [\n{more}\n]' if more else ""
    walks = ",\n".join(_dumps(_crosswalk_fields(one)) for one in crosswalks)
    more += f', "crosswalks": [\n{walks}\n]' if walks else ""
    things = ",\n".join(_dumps({"kind": o.kind, **_crosswalk_fields(o)}) for o in objects)
    more += f', "objects": [\n{things}\n]' if things else ""
    return f'{_dumps(head)[:-1]}, "lanes": [\n{rows}\n]{more}}}\n'


def read_lane_text(text: str, name: str) -> RoadMap:
    """Parse the lane text format of sgstore (JSON) into a road map.

    Raises
    ------
    MapError
        The text has another format or version, or an invalid value.
    """
    if len(text) > MAX_CHARACTERS:
        raise MapError(f"{len(text):,} characters; a text of lanes may have {MAX_CHARACTERS:,}")
    try:
        document = json.loads(text.lstrip("\ufeff"), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise MapError(f"neither OpenDRIVE nor a text of lanes: {error}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise MapError(f"neither OpenDRIVE nor a text of lanes: no format {FORMAT!r}")
    if document.get("version") != VERSION:
        raise MapError(
            f"a text of lanes of version {document.get('version')!r}; expected {VERSION}"
        )
    rows, warnings = document.get("lanes"), document.get("warnings", [])
    if not isinstance(rows, list) or not rows or len(rows) > MAX_LANES:
        raise MapError(f"expected a list of 1 to {MAX_LANES:,} lanes", element="lanes")
    if not isinstance(warnings, list) or not all(isinstance(w, str) for w in warnings):
        raise MapError("expected a list of texts", element="warnings")
    lanes = [row.lane() for row in _text_rows(document, "lane", MAX_LANES, len(rows))]
    if sum(len(lane.z) for lane in lanes) > MAX_SECTIONS:
        raise MapError(f"more than {MAX_SECTIONS:,} cross sections", element="lanes")
    signals = [row.signal() for row in _text_rows(document, "signal", MAX_SIGNALS, len(lanes))]
    crosswalks = [
        row.crosswalk() for row in _text_rows(document, "crosswalk", MAX_SIGNALS, len(lanes))
    ]
    objects = [row.object() for row in _text_rows(document, "object", MAX_SIGNALS, len(lanes))]
    parts = lanes, signals, crosswalks, objects
    return road_map_of(*parts, name=name, text=text, warnings=warnings)


def _dumps(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number")


def _fields(lane: PlainLane) -> dict[str, Any]:
    """Convert a lane to JSON fields. Leave out empty fields."""
    fields: dict[str, Any] = {key: getattr(lane, key) for key in _NAMES}
    fields |= {"section": lane.section, "number": lane.number}
    fields |= {
        key: np.round(getattr(lane, key), DIGITS).ravel().tolist() for key in ("left", "right", "z")
    }
    fields |= {key: list(getattr(lane, key)) for key in _RELATED}
    fields["changes"] = [
        [to, round(start, DIGITS), round(end, DIGITS)] for to, start, end in lane.changes
    ]
    fields["broad"] = list(lane.broad)
    if math.isfinite(lane.speed_limit):
        fields["speed_limit"] = lane.speed_limit
    return {key: value for key, value in fields.items() if value not in ("", [])}


def _signal_fields(signal: PlainSignal) -> dict[str, Any]:
    """Convert a traffic light or sign to JSON fields. Leave out missing values."""
    places = {key: round(getattr(signal, key), DIGITS) for key in _POSE}
    told: dict[str, Any] = {key: place for key, place in places.items() if math.isfinite(place)}
    told |= {"name": signal.name, "kind": signal.kind, "lanes": list(signal.lanes)}
    if signal.stops:
        told["stops"] = [[lane, round(along, DIGITS)] for lane, along in signal.stops]
    if signal.is_stop_line:
        told["is_stop_line"] = True
    if len(signal.line):
        told["line"] = np.round(signal.line, DIGITS).ravel().tolist()
    if math.isfinite(signal.speed_limit):
        told["speed_limit"] = signal.speed_limit
    return told


def _crosswalk_fields(crosswalk: PlainCrosswalk) -> dict[str, Any]:
    outline = np.round(crosswalk.outline, DIGITS).ravel().tolist()
    return {"name": crosswalk.name, "z": round(crosswalk.z, DIGITS), "outline": outline}


def _text_rows(document: dict[str, Any], what: str, most: int, lanes: int) -> list[_TextRow]:
    rows = document.get(f"{what}s", [])
    if not isinstance(rows, list) or len(rows) > most:
        raise MapError(f"expected a list of at most {most:,} {what}s", element=f"{what}s")
    for number, row in enumerate(rows):
        if not isinstance(row, dict):
            raise MapError(f"{what} {number} is not an object", element=f"{what}s")
    return [_TextRow(row, number, lanes, what) for number, row in enumerate(rows)]


class _TextRow:
    """JSON object of a lane or signal. Its fields are checked when they are read."""

    def __init__(self, fields: dict[str, Any], number: int, lanes: int, what: str) -> None:
        self._fields = fields
        self._what = what
        self._number = number
        self._lanes = lanes

    def lane(self) -> PlainLane:
        left, right = (self._floats(key).reshape(-1, 2) for key in ("left", "right"))
        z = self._floats("z")
        if not len(left) == len(right) == len(z) >= 2:
            raise self._wrong("z", "as many cross sections on both sides, two at least")
        return PlainLane(
            name=self._text("name"),
            type=self._text("type"),
            road=self._text("road"),
            junction=self._text("junction"),
            section=self._whole("section"),
            number=self._whole("number"),
            left=left,
            right=right,
            z=z,
            onto=self._related("onto"),
            left_beside=self._related("left_beside"),
            right_beside=self._related("right_beside"),
            against=self._related("against"),
            changes=self._stretches("changes", 3),
            speed_limit=self._speed(),
            roundabout=self._text("roundabout"),
            broad=self._sides("broad"),
        )

    def signal(self) -> PlainSignal:
        if self._fields.get("kind") not in SIGNALS:
            raise self._wrong("kind", f"one of {', '.join(SIGNALS)}")
        return PlainSignal(
            self._text("name"),
            self._text("kind"),
            lanes=self._related("lanes"),
            stops=tuple((lane, along) for lane, along, _ in self._stretches("stops", 2)),
            is_stop_line=self._fields.get("is_stop_line") is True,
            line=self._points("line", 2) if "line" in self._fields else np.zeros((0, 2)),
            speed_limit=self._speed(),
            **{key: self._place(key) for key in _POSE},
        )

    def crosswalk(self) -> PlainCrosswalk:
        return PlainCrosswalk(self._text("name"), self._points("outline", 3), self._place("z"))

    def object(self) -> PlainObject:
        if self._fields.get("kind") not in OBJECT_KINDS:
            raise self._wrong("kind", f"one of {', '.join(OBJECT_KINDS)}")
        ground = self.crosswalk()
        return PlainObject(ground.name, ground.outline, ground.z, self._text("kind"))

    def _points(self, key: str, least: int) -> Floats:
        points = self._floats(key).reshape(-1, 2)
        if len(points) < least:
            raise self._wrong(key, f"{least} points at least")
        return points

    def _wrong(self, key: str, expected: str) -> MapError:
        reason = f"{self._what} {self._number}: expected {expected}"
        return MapError(reason, element=f"{self._what}s/{key}")

    def _place(self, key: str) -> float:
        value = self._fields.get(key, math.nan)
        if key in self._fields and (
            type(value) not in {int, float} or not abs(value) < MAX_COORDINATE
        ):
            raise self._wrong(key, f"a number below {MAX_COORDINATE:.0e}")
        return float(value)

    def _text(self, key: str) -> str:
        value = self._fields.get(key, "")
        if not isinstance(value, str) or len(value) > MAX_NAME:
            raise self._wrong(key, f"a text of at most {MAX_NAME} characters")
        return value

    def _whole(self, key: str) -> int:
        value = self._fields.get(key, 0)
        if type(value) is not int or abs(value) > 1 << 31:
            raise self._wrong(key, "a whole number")
        return value

    def _floats(self, key: str) -> Floats:
        values = self._fields.get(key)
        expected = "numbers, an even number of them" if key != "z" else "numbers"
        if not isinstance(values, list) or (key != "z" and len(values) % 2):
            raise self._wrong(key, expected)
        if not set(map(type, values)) <= {int, float}:
            raise self._wrong(key, expected)
        try:
            array = np.array(values, np.float64)
        except OverflowError as error:
            raise self._wrong(key, expected) from error
        if not (np.abs(array) < MAX_COORDINATE).all():
            raise self._wrong(key, f"no place farther than {MAX_COORDINATE:.0e} m from the origin")
        return array

    def _related(self, key: str) -> tuple[int, ...]:
        values = self._fields.get(key, [])
        if not isinstance(values, list) or len(values) > MAX_RELATED:
            raise self._wrong(key, f"at most {MAX_RELATED} numbers of lanes")
        if not all(type(v) is int and 0 <= v < self._lanes for v in values):
            raise self._wrong(key, f"numbers of lanes, 0 to {self._lanes - 1}")
        return tuple(values)

    def _sides(self, key: str) -> tuple[str, ...]:
        values = self._fields.get(key, [])
        if values not in ([], ["left"], ["right"], ["left", "right"]):
            raise self._wrong(key, "some of left and right")
        return tuple(values)

    def _stretches(self, key: str, numbers: int) -> tuple[tuple[int, float, float], ...]:
        """Read a JSON list of lane intervals: each has a lane, a start, and optionally an end."""
        values = self._fields.get(key, [])
        shape = "[lane, start, end]" if numbers == 3 else "[lane, along]"
        expected = f"at most {MAX_RELATED} stretches {shape}"
        if not isinstance(values, list) or len(values) > MAX_RELATED:
            raise self._wrong(key, expected)
        found: list[tuple[int, float, float]] = []
        for value in values:
            if not isinstance(value, list) or list(map(type, value))[:1] != [int]:
                raise self._wrong(key, expected)
            if len(value) != numbers or not {*map(type, value)} <= {int, float}:
                raise self._wrong(key, expected)
            lane, start, end = value[0], value[1], value[-1]
            if not (0 <= lane < self._lanes and 0 <= start <= end < MAX_COORDINATE):
                raise self._wrong(key, expected)
            found.append((lane, float(start), float(end)))
        return tuple(found)

    def _speed(self) -> float:
        value = self._fields.get("speed_limit", math.nan)
        if type(value) not in {int, float} or value <= 0 or value > 1000:
            raise self._wrong("speed_limit", "a speed in m/s")
        return float(value)
