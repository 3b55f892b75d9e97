"""Plain lanes → ``RoadMap`` or text, and their cross sections from lines.

A plain lane is its cross sections in the direction of travel and the lanes that it is related to. All else
that a :class:`~sgstore.roads.RoadMap` holds follows: roads, junctions, turns, conflicts, lengths and widths.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.columns import chained
from sgstore.errors import MapError
from sgstore.roads._map import STOREY, LaneChanges, MapEdges, MapNodes, RoadMap, turn_words
from sgstore.roads._ribbons import Ribbons, conflicts, mean_widths, turned, wrapped
from sgstore.vocabulary import DRIVING, RELATION_CODE, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.world import Bools, Floats, Ints


_SIDEWAYS: Final = 0.9
"""A step of which a larger share than this goes across the lane is a jump."""
_FIRST_LANE: Final = 1
"""Row of the first lane among the nodes: ``off_road`` comes before it."""


@dataclass(frozen=True, slots=True)
class PlainLane:
    """A lane. Other lanes are named by their number in the list that this one stands in.

    Attributes
    ----------
    name, type, road, junction : str
        As :class:`~sgstore.roads.MapNodes` has them.
    section, number : int
        Section and lane number in the road; 0 where there is none.
    left, right : (n, 2) float64
        Ends of the cross sections, in the direction of travel; m. Two at least.
    z : (n,) float64
        Heights of the cross sections; m.
    onto : tuple of int
        Lanes that traffic flows on to.
    left_beside, right_beside : tuple of int
        Lanes that lie beside it, as its own traffic sees them.
    against : tuple of int
        Those of them whose traffic comes the other way.
    changes : tuple of (int, float, float)
        Lanes that traffic may change to, from where to where along this one; m.
    speed_limit : float
        m/s; NaN where there is none.
    """

    name: str
    type: str
    road: str
    junction: str
    section: int
    number: int
    left: Floats
    right: Floats
    z: Floats
    onto: tuple[int, ...] = ()
    left_beside: tuple[int, ...] = ()
    right_beside: tuple[int, ...] = ()
    against: tuple[int, ...] = ()
    changes: tuple[tuple[int, float, float], ...] = ()
    speed_limit: float = np.nan


@dataclass(frozen=True, slots=True)
class PlainSignal:
    """A traffic light or sign.

    Attributes
    ----------
    name, kind : str
        Its id, and one of :data:`sgstore.vocabulary.SIGNALS`.
    x, y, z, heading : float
        Where it stands and faces; m, rad. NaN: not known.
    lanes : tuple of int
        Lanes that it applies to, by their number.
    """

    name: str
    kind: str
    x: float = np.nan
    y: float = np.nan
    z: float = np.nan
    heading: float = np.nan
    lanes: tuple[int, ...] = ()


def road_map_of(
    lanes: Sequence[PlainLane],
    signals: Sequence[PlainSignal] = (),
    *,
    name: str,
    text: str,
    warnings: Iterable[str] = (),
) -> RoadMap:
    """The road map that plain lanes and signals make; ``text`` is what they were read from.

    Raises
    ------
    MapError
        A junction has more lanes than can be looked at in pairs.
    """
    ribbons = ribbons_of(lanes)
    surfaces = plain_nodes(lanes, ribbons)
    roads, junctions = _road_nodes(lanes, ribbons), _junction_nodes(lanes)
    off_road = MapNodes.of("off_road", ["off_road"])
    nodes = chained([off_road, surfaces, roads, junctions, _signal_nodes(signals)])
    return RoadMap(
        name=name,
        text=text,
        nodes=nodes,
        edges=_edges(lanes, ribbons, roads, junctions, signals),
        ribbons=ribbons,
        shapes=np.full(len(nodes), None, object),
        lane_changes=_lane_changes(lanes),
        warnings=warnings,
    )


def ribbons_of(lanes: Sequence[PlainLane]) -> Ribbons:
    """The surface of plain lanes."""
    counts = np.array([len(lane.z) for lane in lanes], np.int64)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    left = np.concatenate([np.zeros((0, 2)), *(lane.left for lane in lanes)])
    right = np.concatenate([np.zeros((0, 2)), *(lane.right for lane in lanes)])
    x, y = ((left + right) / 2).T
    first = np.zeros(len(x), np.bool_)
    first[offsets[:-1]] = True
    run_x, run_y = np.diff(x, prepend=0.0), np.diff(y, prepend=0.0)
    step = np.where(first, 0.0, np.hypot(run_x, run_y))
    run = np.cumsum(step)
    along = run - np.repeat(run[offsets[:-1]], counts)
    # Where a lane jumps to the side, no traffic goes that way.
    across_x, across_y = (left - right).T
    aside = np.abs(run_x * across_x + run_y * across_y)
    width = np.hypot(across_x, across_y)
    jumps = (width > 0) & (aside > _SIDEWAYS * step * width)
    square = np.arctan2(-across_x, across_y)
    return Ribbons(
        offsets=offsets,
        left_x=left[:, 0],
        left_y=left[:, 1],
        right_x=right[:, 0],
        right_y=right[:, 1],
        z=np.concatenate([np.zeros(0), *(lane.z for lane in lanes)]),
        heading=headings(x, y, first | jumps, square),
        s=along,
        along=along,
    )


def headings(x: Floats, y: Floats, first: Bools, alone: Floats | None = None) -> Floats:
    """Headings of polylines at their points: (N,), not wrapped; ``first`` marks where each line begins.

    A line of one point has that of ``alone``. Within a line it is the mean of the two pieces' directions,
    weighted by their lengths, so that the cubic through points and headings strays from neither far; at an end
    it is what the nearest piece would have if it were part of a circle.
    """
    if not len(x):
        return np.zeros(0)
    inner = ~first[1:]
    length = np.where(inner, np.hypot(np.diff(x), np.diff(y)), 0.0)
    direction = np.arctan2(np.diff(y), np.diff(x))
    before, after = np.append(0.0, length), np.append(length, 0.0)
    into, out = np.append(0.0, direction), np.append(direction, 0.0)
    turn = wrapped(out - into)
    total = before + after
    both = (before > 0) & (after > 0)
    share = after / np.where(total > 0, total, 1.0)
    heading = np.where(both, into + turn * share, np.where(after > 0, out, into))
    if alone is not None:
        heading = np.where(total > 0, heading, alone)
    # A line's ends: as far beyond the piece's direction as its other end is before it.
    starts, ends = np.flatnonzero(~both & (after > 0)), np.flatnonzero(~both & (before > 0))
    for rows, others, pieces in ((starts, starts + 1, out), (ends, ends - 1, into)):
        bend = wrapped(heading[others] - pieces[rows])
        curved = both[others] & (np.abs(bend) < np.pi / 4)
        heading[rows] = pieces[rows] - np.where(curved, bend, 0.0)
    return heading


def plain_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """The nodes of plain lanes with these surfaces."""
    every, length = np.arange(len(ribbons)), ribbons.lengths
    middle = ribbons.at(every, length / 2)
    turns = turn_words(turned(ribbons))
    return MapNodes.of(
        "lane",
        [lane.name for lane in lanes],
        x=middle.x,
        y=middle.y,
        z=middle.z,
        heading=middle.heading,
        lane_type=tuple(lane.type for lane in lanes),
        road=tuple(lane.road for lane in lanes),
        junction=tuple(lane.junction for lane in lanes),
        turn=tuple(word if lane.junction else "" for word, lane in zip(turns, lanes, strict=True)),
        section=np.array([lane.section for lane in lanes], np.int64),
        lane=np.array([lane.number for lane in lanes], np.int64),
        length=length,
        width=mean_widths(ribbons),
        speed_limit=np.array([lane.speed_limit for lane in lanes], np.float64),
    )


def _road_nodes(lanes: Sequence[PlainLane], ribbons: Ribbons) -> MapNodes:
    """Roads in the order of their first lanes; a road is as long as the longest lanes of its sections."""
    junction: dict[str, str] = {}
    longest: dict[str, dict[int, float]] = {}
    for lane, length in zip(lanes, ribbons.lengths.tolist(), strict=True):
        junction.setdefault(lane.road, lane.junction)
        sections = longest.setdefault(lane.road, {})
        sections[lane.section] = max(sections.get(lane.section, 0.0), length)
    names = tuple(junction)
    return MapNodes.of(
        "road",
        names,
        length=np.array([sum(longest[name].values()) for name in names], np.float64),
        road=names,
        junction=tuple(junction.values()),
    )


def _junction_nodes(lanes: Sequence[PlainLane]) -> MapNodes:
    names = tuple(dict.fromkeys(lane.junction for lane in lanes if lane.junction))
    return MapNodes.of("junction", names, junction=names)


def _signal_nodes(signals: Sequence[PlainSignal]) -> MapNodes:
    columns = {
        name: np.array([getattr(signal, name) for signal in signals], np.float64)
        for name in ("x", "y", "z", "heading")
    }
    kinds = [signal.kind for signal in signals]
    return MapNodes.of(kinds, [signal.name for signal in signals], **columns)


def _edges(
    lanes: Sequence[PlainLane],
    ribbons: Ribbons,
    roads: MapNodes,
    junctions: MapNodes,
    signals: Sequence[PlainSignal],
) -> MapEdges:
    first_road = _FIRST_LANE + len(lanes)
    first_junction = first_road + len(roads)
    road = {name: first_road + row for row, name in enumerate(roads.name)}
    junction = {name: first_junction + row for row, name in enumerate(junctions.name)}
    within = [(_FIRST_LANE + row, road[lane.road]) for row, lane in enumerate(lanes)]
    within += [(road[r], junction[j]) for r, j in zip(roads.name, roads.junction, strict=True) if j]
    flow = _spread([lane.onto for lane in lanes])
    crossing = [row for row, lane in enumerate(lanes) if lane.junction and lane.type in DRIVING]
    one, other = conflicts(
        ribbons,
        np.array(crossing, np.int64),
        [lane.junction for lane in lanes],
        (flow[:, 0], flow[:, 1]),
        STOREY,
    )
    against = _spread([lane.against for lane in lanes])
    change = np.array(
        [(row, to) for row, lane in enumerate(lanes) for to, _, _ in lane.changes], np.int64
    ).reshape(-1, 2)
    among_lanes = {
        "travelsTo": flow,
        "laneChange": change,
        "toLeftOf": _spread([lane.left_beside for lane in lanes])[:, ::-1],
        "toRightOf": _spread([lane.right_beside for lane in lanes])[:, ::-1],
        "opposes": np.concatenate((against, against[:, ::-1])),
        "conflictsWith": np.column_stack((np.append(one, other), np.append(other, one))),
    }
    parts = {"isIn": np.array(within, np.int64).reshape(-1, 2)}
    parts |= {relation: _FIRST_LANE + pairs for relation, pairs in among_lanes.items()}
    first_signal = first_junction + len(junctions)
    controls = [
        (first_signal + row, _FIRST_LANE + lane)
        for row, signal in enumerate(signals)
        for lane in signal.lanes
        if lanes[lane].type in DRIVING
    ]
    parts["controlsTrafficOf"] = np.array(controls, np.int64).reshape(-1, 2)
    return edges_of([(relation, pairs[:, 0], pairs[:, 1]) for relation, pairs in parts.items()])


Edge = tuple[str, "Ints", "Ints"]
"""A relation, and the rows of its sources and destinations among the nodes."""


def edges_of(parts: Sequence[Edge]) -> MapEdges:
    """Edges among rows of nodes as edges among node ids, each once, ordered."""
    code = np.concatenate([np.full(len(src), RELATION_CODE[name]) for name, src, _ in parts])
    src = np.concatenate([s for _, s, _ in parts])
    dst = np.concatenate([d for _, _, d in parts])
    table = np.unique(np.column_stack((code, src, dst)), axis=0).reshape(-1, 3)
    return MapEdges(table[:, 0].astype(np.int8), -1 - table[:, 1], -1 - table[:, 2])


def _spread(groups: Sequence[tuple[int, ...]]) -> Ints:
    """(n, 2): each row's number with each of its group."""
    row = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return np.column_stack((row, np.array([*chain(*groups)], np.int64)))


def _lane_changes(lanes: Sequence[PlainLane]) -> LaneChanges:
    rows = [(row, *change) for row, lane in enumerate(lanes) for change in lane.changes]
    if not rows:
        return LaneChanges.none()
    lane, to, start, end = zip(*sorted(rows), strict=True)
    return LaneChanges(
        np.array(lane, np.int64), np.array(to, np.int64), np.array(start), np.array(end)
    )


# Plain lanes as text, and back: what a store keeps of a map that is no OpenDRIVE ----------------
# The text is JSON, one lane a line, so that people can read it and tools can compare it::
#
#     {"format": "sgstore lanes", "version": 1, "warnings": [], "lanes": [
#     {"name": "1/0/-1", "type": "driving", …, "left": [x, y, x, y, …], "right": […], "z": […], "onto": [1]},
#     …
#     ], "signals": [{"name": "7", "kind": "traffic_light", "x": 1.5, "y": -3.0, "lanes": [0]}]}
#
# ``signals`` is left out where there are none. Lengths are rounded to a tenth of a millimetre when the text is
# written, and the map is always made from the text: what is read back is what was there before. Texts come from
# files, so nothing in them is trusted.

FORMAT: Final = "sgstore lanes"
VERSION: Final = 1

MAX_CHARACTERS: Final = 128 << 20
MAX_LANES: Final = 100_000
MAX_SIGNALS: Final = 100_000
MAX_SECTIONS: Final = 4_000_000
"""Greatest number of cross sections of all lanes."""
MAX_COORDINATE: Final = 1e8
"""Greatest distance from the origin; m."""
MAX_NAME: Final = 200
MAX_RELATED: Final = 1_000
"""Greatest number of lanes that a lane can be related to in one way."""
OF_LANES: Final = " (lanes)"
"""What the names of such maps end in: they are less than the OpenDRIVE of the same name."""
DIGITS: Final = 4
"""Digits that are kept of a length in metres."""

_NAMES: Final = ("name", "type", "road", "junction")
_POSE: Final = ("x", "y", "z", "heading")
_RELATED: Final = ("onto", "left_beside", "right_beside", "against")


def is_lane_text(text: str) -> bool:
    """Return whether a text can be a map of plain lanes, and no OpenDRIVE: it begins as a JSON object."""
    return text[:100].lstrip("\ufeff \t\r\n").startswith("{")


def lane_text(
    lanes: Sequence[PlainLane],
    warnings: Iterable[str] = (),
    signals: Sequence[PlainSignal] = (),
) -> str:
    """The text of plain lanes and signals; ``warnings`` are kept in it."""
    head = {"format": FORMAT, "version": VERSION, "warnings": list(warnings)}
    rows = ",\n".join(_dumps(_fields(lane)) for lane in lanes)
    more = ",\n".join(_dumps(_signal_fields(signal)) for signal in signals)
    more = f', "signals": [\n{more}\n]' if more else ""
    return f'{_dumps(head)[:-1]}, "lanes": [\n{rows}\n]{more}}}\n'


def read_lane_text(text: str, name: str) -> RoadMap:
    """The road map that a text of plain lanes describes.

    Raises
    ------
    MapError
        It is no such text, is of another version, or something in it is not what it must be.
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
    lanes = [_lane(row, number, len(rows)) for number, row in enumerate(rows)]
    if sum(len(lane.z) for lane in lanes) > MAX_SECTIONS:
        raise MapError(f"more than {MAX_SECTIONS:,} cross sections", element="lanes")
    return road_map_of(
        lanes, _read_signals(document, len(lanes)), name=name, text=text, warnings=warnings
    )


def _dumps(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is no number")


def _fields(lane: PlainLane) -> dict[str, Any]:
    """A lane as JSON has it; what is missing or empty is left out."""
    fields: dict[str, Any] = {key: getattr(lane, key) for key in _NAMES}
    fields |= {"section": lane.section, "number": lane.number}
    fields |= {
        key: np.round(getattr(lane, key), DIGITS).ravel().tolist() for key in ("left", "right", "z")
    }
    fields |= {key: list(getattr(lane, key)) for key in _RELATED}
    fields["changes"] = [
        [to, round(start, DIGITS), round(end, DIGITS)] for to, start, end in lane.changes
    ]
    if math.isfinite(lane.speed_limit):
        fields["speed_limit"] = lane.speed_limit
    return {key: value for key, value in fields.items() if value not in ("", [])}


def _signal_fields(signal: PlainSignal) -> dict[str, Any]:
    """A signal as JSON has it; what is missing is left out."""
    places = {key: round(getattr(signal, key), DIGITS) for key in _POSE}
    told = {key: place for key, place in places.items() if math.isfinite(place)}
    return {"name": signal.name, "kind": signal.kind, **told, "lanes": list(signal.lanes)}


def _read_signals(document: dict[str, Any], lanes: int) -> list[PlainSignal]:
    rows = document.get("signals", [])
    if not isinstance(rows, list) or len(rows) > MAX_SIGNALS:
        raise MapError(f"expected a list of at most {MAX_SIGNALS:,} signals", element="signals")
    found: list[PlainSignal] = []
    for number, row in enumerate(rows):
        if not isinstance(row, dict):
            raise MapError(f"signal {number} is no object", element="signals")
        fields: dict[str, Any] = row
        found.append(_TextRow(fields, number, lanes, "signal").signal())
    return found


def _lane(row: Any, number: int, lanes: int) -> PlainLane:
    if not isinstance(row, dict):
        raise MapError(f"lane {number} is no object", element="lanes")
    fields: dict[str, Any] = row
    return _TextRow(fields, number, lanes).lane()


class _TextRow:
    """A lane or signal; whatever is asked of it is what it must be, or a :class:`MapError` says what is not."""

    def __init__(self, fields: dict[str, Any], number: int, lanes: int, what: str = "lane") -> None:
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
            changes=self._changes(),
            speed_limit=self._speed(),
        )

    def signal(self) -> PlainSignal:
        if self._fields.get("kind") not in SIGNALS:
            raise self._wrong("kind", f"one of {', '.join(SIGNALS)}")
        return PlainSignal(
            self._text("name"),
            self._text("kind"),
            lanes=self._related("lanes"),
            **{key: self._place(key) for key in _POSE},
        )

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

    def _changes(self) -> tuple[tuple[int, float, float], ...]:
        values = self._fields.get("changes", [])
        expected = f"at most {MAX_RELATED} stretches [lane, start, end]"
        if not isinstance(values, list) or len(values) > MAX_RELATED:
            raise self._wrong("changes", expected)
        changes: list[tuple[int, float, float]] = []
        for value in values:
            if not isinstance(value, list) or list(map(type, value))[:1] != [int]:
                raise self._wrong("changes", expected)
            if len(value) != 3 or not {*map(type, value)} <= {int, float}:
                raise self._wrong("changes", expected)
            to, start, end = value
            if not (0 <= to < self._lanes and 0 <= start <= end < MAX_COORDINATE):
                raise self._wrong("changes", expected)
            changes.append((to, float(start), float(end)))
        return tuple(changes)

    def _speed(self) -> float:
        value = self._fields.get("speed_limit", math.nan)
        if type(value) not in {int, float} or value <= 0 or value > 1000:
            raise self._wrong("speed_limit", "a speed in m/s")
        return float(value)


# Cross sections of lanes that are told as lines: a centre line and its borders --------------------

APART: Final = 0.05
"""Least distance between points of a line that are kept, and between cross sections; m."""
WIDE: Final = 3.5
"""Width of a lane of which nothing tells how wide it is; m."""
NEIGHBOURS: Final = (2.0, 6.0)
"""Distances of centre lines between which lanes side by side tell how wide they are; m."""
_LOOKS: Final = 9
"""Places along a lane at which the distance of those beside it is looked at."""
_STEP: Final = 1.0
"""Distance of the cross sections of a way through an area; m."""
_FEW: Final = 20_000
"""Pairs of a place and a piece of a line up to which looking at all of them takes less than a tree."""
_AHEAD: Final = 0.2, 0.1, 0.5
"""How far ahead or behind a cross section the end of a border may be that is taken for it: so many metres, and
this share of its distance to the side; at the ends of a lane, which need not be square, this share of it."""


@dataclass(frozen=True, slots=True)
class Sections:
    """Cross sections along a line, in its own direction; shape (n, 2) and (n,)."""

    left: Floats
    right: Floats
    z: Floats
    middle: Floats = field(init=False)
    """(n, 2): the centre line."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "middle", (self.left + self.right) / 2)

    def turned_round(self) -> Sections:
        """The same against the line's direction."""
        return Sections(self.right[::-1], self.left[::-1], self.z[::-1])

    def up_to(self, left: Floats, right: Floats, z: float) -> Sections:
        """The same with one more cross section at the end of the line."""
        return Sections(
            np.vstack((self.left, left)), np.vstack((self.right, right)), np.append(self.z, z)
        )


def thinned(line: Floats) -> Floats:
    """A line (n, 3) without points that are closer than :data:`APART` to the one before; its end stays."""
    if len(line) < 2:
        return line
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    if (step >= APART).all():
        return line
    kept, run = [0], 0.0
    for number, length in enumerate(step.tolist(), 1):
        run += length
        if run >= APART:
            kept.append(number)
            run = 0.0
    if kept[-1] != len(line) - 1 and len(kept) > 1:
        kept[-1] = len(line) - 1
    return line[kept]


def run_of(line: Floats) -> Floats:
    """(n,): length of a line (n, 2 or 3) up to each of its points, as seen from above; m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))))


@dataclass(frozen=True, slots=True)
class Feet:
    """The points of lines that are nearest to some places; shape (n,) and (n, 2).

    ``along``: length of the line up to there, lines laid end to end. ``is_end``: it is the end of a line.
    """

    at: Floats
    along: Floats
    is_end: Bools


def feet(places: Floats, lines: Sequence[Floats]) -> Feet:
    """Nearest points on lines to places (n, 2); each line has two different points at least."""
    start = np.concatenate([line[:-1, :2] for line in lines])
    way = np.concatenate([line[1:, :2] for line in lines]) - start
    x, y = places.T
    squared = np.maximum(way[:, 0] ** 2 + way[:, 1] ** 2, 1e-18)
    if len(places) * len(start) <= _FEW:
        away_x, away_y = x[:, None] - start[:, 0], y[:, None] - start[:, 1]
        shares = (away_x * way[:, 0] + away_y * way[:, 1]) / squared
        shares = np.minimum(np.maximum(shares, 0.0), 1.0)
        away_x -= shares * way[:, 0]
        away_y -= shares * way[:, 1]
        piece = np.argmin(away_x * away_x + away_y * away_y, axis=1)
    else:
        pieces: Any = shapely.linestrings(np.stack((start, start + way), axis=1))
        points: Any = shapely.points(places)
        _, piece = shapely.STRtree(pieces).query_nearest(points, all_matches=False)
    begin, step = start[piece], way[piece]
    share = ((x - begin[:, 0]) * step[:, 0] + (y - begin[:, 1]) * step[:, 1]) / squared[piece]
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    length = np.sqrt(squared)
    before = np.cumsum(length) - length
    first = np.zeros(len(start) + 1, np.bool_)
    first[np.cumsum([0, *(len(line) - 1 for line in lines)])] = True
    is_end = ((share <= 0) & first[piece]) | ((share >= 1) & first[piece + 1])
    return Feet(begin + share[:, None] * step, before[piece] + share * length[piece], is_end)


def along_line(line: Floats, places: Floats) -> Floats:
    """(n,): lengths of a line up to its points nearest to places (n, 2); m."""
    return feet(places, [line]).along


def cross_sections(
    centre: Floats, lefts: Sequence[Floats], rights: Sequence[Floats], half: float
) -> tuple[Sections, bool]:
    """Cross sections of a lane, and whether its borders say how wide it is.

    Parameters
    ----------
    centre : (n, 3) float64
        Centre line, thinned; two points at least.
    lefts, rights : sequence of (k, 3) float64
        Borders to its left and right, thinned, as many pieces as there are, in any order. Where only one
        side has any, the other lies as far away; where none has, both lie ``half`` away.
    half : float
        m.
    """
    run = run_of(centre)
    at = _cuts(run, [along_line(centre, line[:, :2]) for line in (*lefts, *rights)])
    x, y, z = (np.interp(at, run, column) for column in centre.T)
    first = np.zeros(len(at), np.bool_)
    first[0] = True
    heading = headings(x, y, first)
    ahead = np.column_stack((np.cos(heading), np.sin(heading)))
    to_left = np.column_stack((-ahead[:, 1], ahead[:, 0]))
    places = np.column_stack((x, y))
    sides = [
        _side(places, ahead, sign * to_left, borders)
        for sign, borders in ((1.0, lefts), (-1.0, rights))
    ]
    told = any(side is not None for side in sides)
    one, other = sides if told else (None, None)
    plain = np.full(len(at), half)
    left_away = one.away if one else other.away if other else plain
    right_away = other.away if other else left_away
    left = one.points if one else places + to_left * left_away[:, None]
    right = other.points if other else places - to_left * right_away[:, None]
    return Sections(left, right, z), told


def _cuts(run: Floats, more: Sequence[Floats]) -> Floats:
    """Places along a line where it is cut: at its own points, and at others that are not too close to one."""
    inner = np.concatenate([run[1:-1], *more])
    own = np.arange(len(inner)) < len(run) - 2
    inside = (inner > APART) & (inner < run[-1] - APART)
    inner, own = inner[inside], own[inside]
    order = np.lexsort((~own, inner))
    inner = inner[order]
    if len(inner):
        kept = [float(inner[0])]
        for place in inner[1:].tolist():
            if place - kept[-1] >= APART:
                kept.append(place)
        inner = np.array(kept)
    return np.concatenate(([0.0], inner, [run[-1]]))


@dataclass(frozen=True, slots=True)
class _Side:
    points: Floats
    away: Floats


def _side(places: Floats, ahead: Floats, aside: Floats, borders: Sequence[Floats]) -> _Side | None:
    """Ends of the cross sections through places on one side; ``None`` if no border is beside any of them."""
    if not borders:
        return None
    found = feet(places, borders)
    nearest = found.at
    way = nearest - places
    away, beyond = (way * aside).sum(axis=1), (way * ahead).sum(axis=1)
    share = np.full(len(away), _AHEAD[1])
    share[[0, -1]] = _AHEAD[2]
    beside: Bools = ~found.is_end | (np.abs(beyond) <= _AHEAD[0] + share * np.abs(away))
    if not beside.any():
        return None
    rows: Ints = np.flatnonzero(beside)
    # Where a border is missing the lane stays as wide as it is beside the next piece of it.
    away = np.where(beside, away, np.interp(np.arange(len(away)), rows, away[rows]))
    points = np.where(beside[:, None], nearest, places + aside * away[:, None])
    return _Side(points, away)


def half_width(centre: Floats, others: Sequence[Floats]) -> float:
    """Half the width of a lane without borders, from the centre lines of the lanes beside it; m."""
    run = run_of(centre)
    places = np.linspace(0.0, run[-1], _LOOKS)
    middle = np.column_stack([np.interp(places, run, column) for column in centre[:, :2].T])
    gaps: list[float] = []
    for other in others:
        found = feet(middle, [other])
        length = run_of(other)[-1]
        beside = (found.along > 0) & (found.along < length)
        if beside.any():
            gap = float(np.median(np.hypot(*(found.at - middle)[beside].T)))
            gaps += [gap] * (NEIGHBOURS[0] <= gap <= NEIGHBOURS[1])
    return min(gaps, default=WIDE) / 2


def way_between(
    start: tuple[Floats, float, float, float], end: tuple[Floats, float, float, float]
) -> Sections:
    """A lane from one place to another: place (2,), heading, width and height at both ends.

    The cubic whose tangents are as long as they would be on a part of a circle of that turn.
    """
    (p0, heading0, width0, z0), (p1, heading1, width1, z1) = start, end
    chord = float(np.hypot(*(p1 - p0)))
    turn = abs(float(np.remainder(heading1 - heading0 + np.pi, 2 * np.pi) - np.pi))
    tangent = chord / np.cos(turn / 4) ** 2
    t0 = tangent * np.array((np.cos(heading0), np.sin(heading0)))
    t1 = tangent * np.array((np.cos(heading1), np.sin(heading1)))
    n = int(np.clip(chord / _STEP, 8, 64)) + 1
    t = np.linspace(0.0, 1.0, n)[:, None]
    place = (
        (1 + 2 * t) * (1 - t) ** 2 * p0
        + t * (1 - t) ** 2 * t0
        + t * t * (3 - 2 * t) * p1
        - t * t * (1 - t) * t1
    )
    slope = 6 * t * (t - 1) * (p0 - p1) + (1 - t) * (1 - 3 * t) * t0 + t * (3 * t - 2) * t1
    slope /= np.maximum(np.hypot(*slope.T), 1e-9)[:, None]
    share = t[:, 0]
    half = (width0 + share * (width1 - width0))[:, None] / 2
    to_left = np.column_stack((-slope[:, 1], slope[:, 0]))
    return Sections(place + to_left * half, place - to_left * half, z0 + share * (z1 - z0))
