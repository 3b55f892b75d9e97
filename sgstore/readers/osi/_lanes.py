"""Conversion of lanes in OSI messages to a road map, for recordings without an OpenDRIVE map.

OSI has two kinds of lanes. *Logical* lanes are used if the recording has them. They have a border on each side
with the position along a reference line at every point, the connected lanes at both ends, and rules for
crossing. *Physical* lanes have a centre line, boundaries in pieces, ids of neighbours, and pairs of antecessor
and successor. An intersection is usually one area; its pairs are the ways through it. Left, right, antecessor
and successor refer to the order of a line's points, independent of the traffic direction. A missing centre line
is computed as the middle of the boundaries of both sides. Its direction follows from their sides. Lanes with a
common boundary are neighbours, unless they list their neighbours.

A message may contain static data only once in a recording. The first message with a lane defines the lane.

Source: open-simulation-interface 3.8.0 (osi_lane.proto, osi_logicallane.proto).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from sgstore.errors import MapError
from sgstore.maps.roads import (
    MAX_NAME,
    MAX_POINTS,
    OF_LANES,
    Area,
    Border,
    Joint,
    LaneLine,
    PlainLane,
    PlainSignal,
    Sections,
    about_lanes,
    lane_text,
    middle_between,
    plain_lanes,
    run_of,
    with_shared_borders,
)
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    SENSOR_VIEW,
    enum_name,
    fields_read,
    has_field,
    identifiers,
    message_class,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from mcap.records import Schema

    from sgstore.model.world import Floats


FIELDS: Final = ("lane", "lane_boundary", "logical_lane", "logical_lane_boundary")
"""Fields of a ground truth message from which the map is made."""

OWN: Final = "osi:"
"""Prefix of the map name of a light or sign that has an OSI id, but no map reference."""

_MAY_LACK: Final = {"subtype", "source_reference", "physical_lane_reference"}
"""Fields of a lane that older versions of OSI do not have."""

_TYPES: Final = {
    "NORMAL": "driving",
    "ONRAMP": "onRamp",
    "OFFRAMP": "offRamp",
    "CONNECTINGRAMP": "connectingRamp",
    **{
        word.upper(): word
        for word in (
            *("biking", "sidewalk", "parking", "stop", "restricted", "border", "shoulder"),
            *("exit", "entry", "median", "curb", "rail", "tram"),
        )
    },
}
"""Name in ``Lane.Classification.Subtype`` or ``LogicalLane.Type`` → OpenDRIVE lane type."""

_CROSSED: Final = {"TYPE_NO_LINE", "TYPE_DASHED_LINE", "TYPE_BOTTS_DOTS"}
"""Types of lane boundaries that vehicles may cross."""
_UNKNOWN: Final = {"TYPE_UNKNOWN", "TYPE_OTHER"}
_RULES: Final = {
    "PASSING_RULE_NONE_ALLOWED": (False, False),
    "PASSING_RULE_INCREASING_T": (True, False),
    "PASSING_RULE_DECREASING_T": (False, True),
    "PASSING_RULE_BOTH_ALLOWED": (True, True),
}
"""Passing rule → True if crossing is allowed: from right to left, and from left to right of the boundary."""

_LONGEST: Final = 100
"""Maximum number of characters in a road name."""
_BEYOND: Final = 1.0
"""Length by which a lane may extend beyond its boundaries without a warning; m."""
_JUMP: Final = 1e-3
"""Smallest distance between two points of a border that counts as a jump; m."""
_FAR: Final = 1e8
"""Maximum distance of a point from the origin; m."""


@dataclass(frozen=True, slots=True)
class LaneSignal:
    """Traffic light or sign of an OSI recording, with the lanes to which it applies.

    ``pose``: columns of :data:`sgstore.model.world.POSE`; ``lanes``: ids of physical or logical lanes.
    """

    name: str
    kind: str
    pose: tuple[float, ...]
    lanes: tuple[int, ...]


def _paths(fields: Any) -> Iterator[str]:
    """Yield the dotted path of each field that the reader requires of an OSI lane."""
    for name in fields:
        inner = fields[name] if isinstance(fields, dict) else True
        if name not in _MAY_LACK:
            yield from (name,) if inner is True else (f"{name}.{path}" for path in _paths(inner))


class OsiLanes:
    """Collector of the lanes and lane boundaries in OSI messages.

    Parameters
    ----------
    schema : Schema
        Of the channel: ``osi3.GroundTruth`` or ``osi3.SensorView``.

    Attributes
    ----------
    warnings : list of str
        Oddities without loss of data.
    lost : list of str
        Unusable lanes with the reasons; filled by :meth:`text`.

    Raises
    ------
    TraceError
        The schema is malformed.
    """

    def __init__(self, schema: Schema) -> None:
        fields, in_view = fields_read()["lanes"], schema.name == SENSOR_VIEW
        self._class = message_class(schema, {"global_ground_truth": fields} if in_view else fields)
        prefix = "global_ground_truth." if in_view else ""
        self._lacks = {
            name: [
                path
                for path in _paths(fields[name])
                if not has_field(self._class, f"{prefix}{name}.{path}")
            ]
            for name in FIELDS
        }
        self._told: dict[str, dict[int, Any]] = {name: {} for name in FIELDS}
        self._map = ""
        self._points = 0
        self._broken: dict[str, list[str]] = {}
        self.warnings: list[str] = []
        self.lost: list[str] = []

    def take(self, data: bytes) -> None:
        """Add the lanes and lane boundaries of an OSI message that are new."""
        try:
            message = self._class.FromString(data)
            truth = getattr(message, "global_ground_truth", message)
        except DECODE_ERRORS as error:
            self.warnings.append(f"lanes of a message cannot be read: {error}")
            return
        self._map = self._map or str(getattr(truth, "map_reference", ""))
        for name in FIELDS:
            things = getattr(truth, name, ())
            if self._lacks[name]:
                number = len(things)
                warning = f"{name} left out: its schema lacks the field {self._lacks[name][0]}"
                if number and warning not in self.warnings:
                    self.warnings.append(warning)
                continue
            for thing in things:
                self._told[name].setdefault(int(thing.id.value), thing)

    def text(self, signals: Iterable[LaneSignal] = ()) -> tuple[str, str]:
        """Return the road map made from the lanes as text, and its name; empty without lanes.

        ``signals``: lights and signs of the lanes. Of signals with the same name, the first one counts.

        Raises
        ------
        MapError
            There are too many points.
        """
        lanes, logical = self._told["lane"], self._told["logical_lane"]
        if not lanes and not logical:
            return "", ""
        borders = _LaneBoundaries(self._told, self._place)
        lines: list[LaneLine] = []
        areas: list[Area] = []
        for ident, lane in logical.items():
            lines += self._guarded(_logical_line, ident, lane, borders)
        covered = {ident for lane in logical.values() for ident in _physical(lane)}
        for ident, lane in lanes.items():
            if ident in covered:
                continue
            if not _is_area(lane):
                lines += self._guarded(_physical_line, ident, lane, borders)
            elif (way := _only_way(lane, borders)) is not None:
                lines.append(way)
            else:
                areas += self._guarded(_area, ident, lane, borders)
        lines = with_shared_borders(_sections_numbered(lines))
        plain, warnings = plain_lanes(lines, areas)
        self.lost = [about_lanes(which, what) for what, which in self._broken.items()]
        if not plain:
            self.warnings += warnings
            return "", ""
        rows = self._rows(lines, plain)
        signals = [*signals]
        warnings += self._missing(signals, borders)
        named = {
            one.name: _plain_signal(one, [row for lane in one.lanes for row in rows.get(lane, ())])
            for one in reversed(signals)
        }
        found = [one for one in reversed(named.values()) if one.lanes and len(one.name) <= MAX_NAME]
        return lane_text(plain, [*self.warnings, *self.lost, *warnings], found), self._name()

    def _missing(self, signals: Iterable[LaneSignal], borders: _LaneBoundaries) -> Iterator[str]:
        """Yield warnings: lanes that do not fit their boundaries, and missing lanes and boundaries."""
        yield from borders.notes
        if borders.missing:
            yield f"boundaries of lanes are missing: {', '.join(borders.missing)}"
        lanes = self._told["lane"].keys() | self._told["logical_lane"].keys()
        for signal in {one.name: one for one in signals}.values():
            absent = [str(lane) for lane in signal.lanes if lane not in lanes]
            if absent:
                yield f"{signal.kind} {signal.name}: its lanes {', '.join(absent)} are missing"

    def _rows(self, lines: Sequence[LaneLine], plain: Sequence[PlainLane]) -> dict[int, list[int]]:
        """Return the lanes of the road map that were made from each OSI lane: OSI lane id → row numbers."""
        row_of = {lane.name: row for row, lane in enumerate(plain)}
        rows: dict[int, list[int]] = {}
        for line in lines:
            name = line.name or line.ident
            row = row_of.get(name, row_of.get(f"{name}#{line.ident}"))
            if row is None:
                continue
            ident = int(line.ident)
            logical = self._told["logical_lane"].get(ident)
            for lane in {ident, *(_physical(logical) if logical is not None else ())}:
                rows.setdefault(lane, []).append(row)
        return rows

    def _guarded(
        self,
        read: Callable[[Any, _LaneBoundaries], Any],
        ident: int,
        lane: Any,
        borders: _LaneBoundaries,
    ) -> list[Any]:
        try:
            return [read(lane, borders)]
        except DECODE_ERRORS as error:
            self._broken.setdefault(f"left out: {error}", []).append(str(ident))
            return []

    def _name(self) -> str:
        # Producers write a local file path; its last part is the name of the map.
        name = PurePosixPath(self._map.replace("\\", "/")).name
        name = name.removesuffix(".xodr")
        plain = name.isprintable() and 0 < len(name) <= 64 and not name.startswith("+proj")
        return f"{name}{OF_LANES}" if plain else ""

    def _place(self, points: Iterable[Any]) -> Floats:
        """Return the points of an OSI line, (n, 3); m. Too many points in all lines raise an error."""
        line = np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)
        self._points += len(line)
        if self._points > MAX_POINTS:
            raise MapError(f"lanes of more than {MAX_POINTS:,} points", element="lane")
        if not (np.abs(line) < _FAR).all():
            raise ValueError("a point of it is not a position")
        return line


def _plain_signal(signal: LaneSignal, lanes: Iterable[int]) -> PlainSignal:
    x, y, z, heading = signal.pose[:4]
    return PlainSignal(signal.name, signal.kind, x, y, z, heading, tuple(sorted(set(lanes))))


class _LaneBoundaries:
    """OSI lane boundaries by id. Each is decoded once."""

    def __init__(
        self, told: dict[str, dict[int, Any]], place: Callable[[Iterable[Any]], Floats]
    ) -> None:
        self.told = told
        self.place = place
        self.missing: dict[str, None] = {}
        self.notes: list[str] = []
        self._lines: dict[int, Floats] = {}
        self._logical: dict[int, tuple[Floats, Floats]] = {}

    def physical(self, idents: Iterable[Any]) -> tuple[Border, ...]:
        """Return the lane borders for ids of physical OSI boundaries. Record the missing boundaries."""
        found: list[Border] = []
        for ident in map(_number, idents):
            boundary = self.told["lane_boundary"].get(ident)
            if boundary is None:
                self.missing[f"lane_boundary {ident}"] = None
                continue
            if ident not in self._lines:
                self._lines[ident] = self.place(p.position for p in boundary.boundary_line)
            allowed = self.crossed(ident)
            found.append(Border(self._lines[ident], allowed, allowed, str(ident)))
        return tuple(found)

    def crossed(self, ident: int) -> bool | None:
        """Return True if vehicles may cross a lane boundary; ``None`` if unknown."""
        boundary = self.told["lane_boundary"].get(ident)
        if boundary is None or not boundary.HasField("classification"):
            return None
        kind = enum_name(boundary.classification, "type")
        return None if kind in _UNKNOWN else kind in _CROSSED

    def logical(self, idents: Iterable[Any]) -> tuple[Floats, Floats, tuple[Border, ...]]:
        """Return points, their ``s`` coordinates, and borders, for a chain of logical OSI lane boundaries."""
        lines: list[Floats] = [np.zeros((0, 3))]
        places: list[Floats] = [np.zeros(0)]
        borders: list[Border] = []
        for ident in map(_number, idents):
            boundary = self.told["logical_lane_boundary"].get(ident)
            if boundary is None:
                self.missing[f"logical_lane_boundary {ident}"] = None
                continue
            if ident not in self._logical:
                line = self.place(p.position for p in boundary.boundary_line)
                s = np.array([p.s_position for p in boundary.boundary_line], np.float64)
                if not (np.abs(s) < _FAR).all():
                    raise ValueError("the s of a point of its boundary is not a number")
                self._logical[ident] = line, s
            line, s = self._logical[ident]
            lines.append(line)
            places.append(s)
            borders.append(Border(line, *self._rule(boundary), f"logical {ident}"))
        points, s = np.concatenate(lines), np.concatenate(places)
        order = np.argsort(s, kind="stable")
        return points[order], s[order], tuple(borders)

    def _rule(self, boundary: Any) -> tuple[bool | None, bool | None]:
        """Return two permissions for a lane boundary: to cross it to the left, and to the right.

        Without a rule, the type of the physical line counts.
        """
        rule = _RULES.get(enum_name(boundary, "passing_rule"))
        if rule is not None:
            return rule
        # The order is from right to left along the reference line: traffic from the right reaches the first
        # one.
        physical = [_number(ident) for ident in boundary.physical_boundary_id]
        if not physical:
            return None, None
        return self.crossed(physical[0]), self.crossed(physical[-1])


def _number(ident: Any) -> int:
    return int(ident.value)


def _idents(idents: Iterable[Any]) -> tuple[str, ...]:
    return tuple(str(ident.value) for ident in idents)


def _is_area(lane: Any) -> bool:
    about = lane.classification
    return enum_name(about, "type") == "TYPE_INTERSECTION" and not len(about.centerline)


def _area(lane: Any, _borders: _LaneBoundaries) -> Area:
    """Convert an OSI intersection to a junction area of the map: the pairs of lanes that it connects."""
    return Area(
        str(lane.id.value),
        tuple(
            (str(pair.antecessor_lane_id.value), str(pair.successor_lane_id.value))
            for pair in lane.classification.lane_pairing
            if pair.HasField("antecessor_lane_id") and pair.HasField("successor_lane_id")
        ),
    )


def _only_way(lane: Any, borders: _LaneBoundaries) -> LaneLine | None:
    """Convert an OSI intersection to a lane; ``None`` if its boundaries do not form a single lane."""
    about = lane.classification
    if len(about.lane_pairing) > 1 or not about.left_lane_boundary_id:
        return None
    try:
        return _physical_line(lane, borders)
    except ValueError:
        return None


def _physical_line(lane: Any, borders: _LaneBoundaries) -> LaneLine:
    about = lane.classification
    pairs = about.lane_pairing
    before = [pair.antecessor_lane_id for pair in pairs if pair.HasField("antecessor_lane_id")]
    after = [pair.successor_lane_id for pair in pairs if pair.HasField("successor_lane_id")]
    kind = enum_name(about, "type")
    told = about.HasField("centerline_is_driving_direction")
    lefts = borders.physical(about.left_lane_boundary_id)
    rights = borders.physical(about.right_lane_boundary_id)
    centre = borders.place(about.centerline)
    if len(centre) < 2 or run_of(centre)[-1] < _JUMP:
        centre = middle_between(*([border.line for border in side] for side in (lefts, rights)))
    return LaneLine(
        ident=str(lane.id.value),
        type=_type_of(kind, _word(about, "subtype")),
        centre=centre,
        forward=bool(about.centerline_is_driving_direction) or not told,
        lefts=lefts,
        rights=rights,
        before=tuple(Joint(name) for name in dict.fromkeys(_idents(before))),
        after=tuple(Joint(name) for name in dict.fromkeys(_idents(after))),
        left_beside=_idents(about.left_adjacent_lane_id),
        right_beside=_idents(about.right_adjacent_lane_id),
        junction=None if kind == "TYPE_INTERSECTION" else "",
        **_source(lane),
    )


def _word(message: Any, field: str) -> str:
    """Return the name of an OSI enumeration value without ``TYPE_``; empty if the field is missing."""
    known = field in message.DESCRIPTOR.fields_by_name
    return enum_name(message, field).partition("_")[2] if known else ""


def _type_of(kind: str, word: str) -> str:
    """Return the lane type for the subtype of an OSI lane, or else ``driving`` or ``none``."""
    if word in _TYPES:
        return _TYPES[word]
    return "driving" if kind in {"TYPE_DRIVING", "TYPE_INTERSECTION"} else "none"


def _logical_line(lane: Any, borders: _LaneBoundaries) -> LaneLine:
    left, left_s, lefts = borders.logical(lane.left_boundary_id)
    right, right_s, rights = borders.logical(lane.right_boundary_id)
    if len(left) < 2 or len(right) < 2:
        raise ValueError("it has no boundary with points on each side")
    # A lane exists only where both borders exist.
    start, end = max(left_s[0], right_s[0]), min(left_s[-1], right_s[-1])
    if (lane.HasField("start_s") and lane.start_s < start - _BEYOND) or (
        lane.HasField("end_s") and lane.end_s > end + _BEYOND
    ):
        what = f"s from {lane.start_s:g} to {lane.end_s:g} m, but its boundaries from {start:g} to {end:g} m"
        borders.notes.append(f"lane {lane.id.value}: {what}")
    start = max(start, lane.start_s) if lane.HasField("start_s") else start
    end = min(end, lane.end_s) if lane.HasField("end_s") else end
    if not abs(lane.start_s) + abs(lane.end_s) < _FAR or not end > start:
        raise ValueError("its boundaries on the two sides share no value of s")
    cuts = np.concatenate(([start], left_s, right_s, [end]))
    cuts = np.unique(cuts[(cuts >= start) & (cuts <= end)])
    before, after = (
        [_at(line, s, cuts, side) for line, s in ((left, left_s), (right, right_s))]
        for side in ("left", "right")
    )
    jumps = np.abs(np.hstack(after) - np.hstack(before)).max(axis=1) > _JUMP
    # At a jump of a border, there are two cross sections, but none outside the lane.
    early, late = np.ones(len(cuts), np.bool_), jumps.copy()
    early[0], late[-1] = not jumps[0], False
    one, other = (
        np.stack((b, a), axis=1).reshape(-1, 3)[np.stack((early, late), axis=1).ravel()]
        for b, a in zip(before, after, strict=True)
    )
    ways = enum_name(lane, "move_direction")
    physical = _physical(lane)
    crossing = [
        ident
        for ident in sorted(physical)
        if ident in borders.told["lane"]
        and enum_name(borders.told["lane"][ident].classification, "type") == "TYPE_INTERSECTION"
    ]
    return LaneLine(
        ident=str(lane.id.value),
        type=_TYPES.get(_word(lane, "type"), "none"),
        centre=(one + other) / 2,
        forward=ways != "MOVE_DIRECTION_DECREASING_S",
        both=ways == "MOVE_DIRECTION_BOTH_ALLOWED",
        lefts=lefts,
        rights=rights,
        sections=Sections(one[:, :2], other[:, :2], (one[:, 2] + other[:, 2]) / 2),
        before=_connections(lane.predecessor_lane),
        after=_connections(lane.successor_lane),
        left_beside=_idents(part.other_lane_id for part in lane.left_adjacent_lane),
        right_beside=_idents(part.other_lane_id for part in lane.right_adjacent_lane),
        junction=str(crossing[0]) if crossing else "",
        **_source(lane),
    )


def _at(line: Floats, s: Floats, cuts: Floats, side: Literal["left", "right"]) -> Floats:
    """Return the points (n, 3) of a polyline at given lengths s along it.

    ``side`` selects the value at a jump of the line.
    """
    at = np.searchsorted(s, cuts, side)
    at = np.minimum(at, len(s) - 1) if side == "left" else np.maximum(at - 1, 0)
    between = np.column_stack([np.interp(cuts, s, column) for column in line.T])
    return np.where((s[at] == cuts)[:, None], line[at], between)


def _physical(lane: Any) -> set[int]:
    """Return the ids of the physical OSI lanes to which a logical OSI lane refers."""
    return {_number(part.physical_lane_id) for part in getattr(lane, "physical_lane_reference", ())}


def _connections(connections: Iterable[Any]) -> tuple[Joint, ...]:
    return tuple(
        Joint(str(c.other_lane_id.value), Joint.START if c.at_begin_of_other_lane else Joint.END)
        for c in connections
    )


def _source(lane: Any) -> dict[str, Any]:
    """Return road, section and number of the OpenDRIVE lane from which an OSI lane was made.

    The identifiers are the road, the section's s and the lane, in this order; esmini writes ``road_id:1``.
    """
    values = [
        value.rpartition(":")[2]
        for source, value in identifiers(lane)
        if source == "net.asam.opendrive"
    ]
    if len(values) < 3 or len(values[0]) > _LONGEST:
        return {}
    try:
        start, number = float(values[1]), int(values[2])
    except ValueError:
        return {}
    usable = abs(start) < _FAR and abs(number) < _FAR
    return {"road": values[0], "section": start, "number": number} if usable else {}


def _sections_numbered(lines: Sequence[LaneLine]) -> list[LaneLine]:
    """Return the lanes with road names. Sections are numbered from 0 in each road."""
    starts: dict[str, set[float]] = {}
    for line in lines:
        if line.road:
            starts.setdefault(line.road, set()).add(line.section)
    number = {road: {s: i for i, s in enumerate(sorted(found))} for road, found in starts.items()}
    numbered: list[LaneLine] = []
    for line in lines:
        if line.road:
            section = number[line.road][line.section]
            name = f"{line.road}/{section}/{line.number}"
            numbered.append(replace(line, section=section, name=name))
        else:
            numbered.append(line)
    return numbered
