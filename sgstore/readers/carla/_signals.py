"""Assignment of CARLA's traffic lights to signals of the road map, by position.

A light has at most one signal, and a signal at most one light. The steps are:

1. *by position*: CARLA places a light :data:`FORWARD` in front of its map position, in the signal's own axes.
   If all lights of a world have another common offset, it is learned: the median over lights and signals
   without other candidates. The offset with the most matches is used first;
2. *by sideways offset*: CARLA moves lights on the road sideways until they are off the road;
3. *by remaining signals*: a light within :data:`SAME_PLACE` of a free signal;
4. *by lanes*: the signal of the lanes in the light's trigger boxes, or of their successors.

The sum of squared distances over all lights is minimised. A common shift adds the same amount to every
assignment, so twin lights a few centimetres apart keep their order for any shift.

Source: LibCarla ``road/MapBuilder.cpp`` (0.25 m forward, then sideways by steps of a fifth of the lane's width,
ten at most), CarlaUE4 ``Traffic/TrafficLightManager.cpp`` (actors are turned by 90° against their signals).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from sgstore.base.display import first_of, number_of
from sgstore.base.tables import components
from sgstore.maps.roads import RoadMap
from sgstore.model.vocabulary import (
    KIND_CODE,
    LIGHT_STATE_CODE,
    RELATION_CODE,
    SIGNALS,
    TypeMeaning,
)
from sgstore.model.world import POSE
from sgstore.readers._blocks import FAR, NAN
from sgstore.readers._ros2 import ident_of, number, records

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.readers._blocks import EntityTable

    Rows = NDArray[np.intp]


FORWARD: Final = 0.25
"""Distance between a CARLA light and its map signal, measured ahead of the signal; m."""
SAME_SPOT: Final = 0.1
"""Tolerance for a light at the expected position in front of its signal; m."""
SAME_PLACE: Final = 1.0
"""Largest distance between a light or sign and an unassigned signal; m."""
ASIDE: Final = 10.0
"""Largest sideways offset of a light in CARLA: ten times a fifth of a lane of 5 m; m."""
SAME_WAY: Final = math.pi / 4
"""Largest angle between the headings of a light and its signal; rad."""
TURNS: Final = (0.0, -math.pi / 2)
"""Possible rotations of a light relative to its signal, for landmarks and for CARLA actors; rad."""
LEARNT_FROM: Final = 3
"""Smallest number of lights from which a usual offset from the signals is computed."""
LEARNT_WITHIN: Final = 5.0
"""Largest distance of a light from its signal, for the light to be used for a usual offset; m."""

MOST_NAMED: Final = 5
"""Largest number of lights or lanes that a warning names."""

_MOST_TOGETHER: Final = 300
"""Largest group of lights with an optimal assignment. In a larger group, each light gets the nearest signal."""
_AT_ONCE: Final = 1 << 20
"""Largest product of lights and signals that are compared at once."""
_OF_HEIGHT: Final = 1e-3
"""Weight of a height difference, relative to a horizontal one. It separates signals at the same position."""
_DRIVING: Final = "driving"
_RED, _GREEN = LIGHT_STATE_CODE["red"], LIGHT_STATE_CODE["green"]


@dataclass(frozen=True, slots=True)
class Light:
    """CARLA traffic light: its pose, and its trigger boxes (areas where vehicles obey it).

    Attributes
    ----------
    x, y, z, heading : float
        Pose; NaN means unknown.
    boxes : tuple of tuple of float
        Known trigger boxes, each with its centre ``x, y, z``, heading, length, width.
    """

    x: float
    y: float
    z: float
    heading: float
    boxes: tuple[tuple[float, ...], ...] = ()


def signals_of(
    lights: Mapping[int, Light], road_map: RoadMap, told: Mapping[int, str] | None = None
) -> dict[int, str]:
    """Return the map signal of each traffic light by id; or for a light without signal, the names of its lanes.

    Parameters
    ----------
    lights : mapping
        Lights by id, in any order.
    road_map : RoadMap
    told : mapping, optional
        Known signals of lights, which are not assigned to other lights.

    Returns
    -------
    dict
        The known signals and the new ones. A light without a signal and without a lane in its boxes is absent.
    """
    found = dict(told or {})
    nodes = road_map.nodes
    taken = set(found.values())
    columns = np.flatnonzero(nodes.kind == KIND_CODE["traffic_light"])
    free = np.array([c for c in columns.tolist() if nodes.name[c] not in taken], np.intp)
    idents = sorted(lights.keys() - found.keys())
    places = [(of.x, of.y, of.z, of.heading) for of in (lights[ident] for ident in idents)]
    signals = np.stack([nodes.x, nodes.y, nodes.z, nodes.heading], axis=1)[free]
    matched = _matched(np.array(places, np.float64).reshape(-1, 4), signals)
    for row, signal in matched.items():
        found[idents[row]] = nodes.name[free[signal]]
    left = np.delete(free, list(matched.values()))
    others = {ident: lights[ident] for ident in idents if ident not in found}
    return found | _by_boxes(others, road_map, left.tolist())


def sign_at(road_map: RoadMap, x: float, y: float) -> str:
    """Return the name of the traffic sign that the map has at a position; empty without a sign."""
    nodes = road_map.nodes
    codes = [KIND_CODE[kind] for kind in SIGNALS if kind != "traffic_light"]
    rows = np.flatnonzero(np.isin(nodes.kind, codes))
    if not len(rows):
        return ""
    apart = np.hypot(nodes.x[rows] - x, nodes.y[rows] - y)
    nearest = int(np.argmin(apart))
    return nodes.name[rows[nearest]] if apart[nearest] <= SAME_PLACE else ""


class _Rule(NamedTuple):
    """Usual pose of a traffic light relative to its map signal: rotation, and offset ahead and left."""

    turn: float
    ahead: float
    left: float


class _Near(NamedTuple):
    """Pairs of a traffic light and a map signal that may belong together, and their distances.

    ``ahead``, ``left``: in the signal's axes, minus the offset of the rule; ``up``: minus the usual height; m.
    """

    light: Rows
    signal: Rows
    ahead: Floats
    left: Floats
    up: Floats

    def take(self, kept: Bools) -> _Near:
        return _Near(
            *(self.light[kept], self.signal[kept]),
            *(self.ahead[kept], self.left[kept]),
            self.up[kept],
        )


def _matched(lights: Floats, signals: Floats) -> dict[int, int]:
    """Assign traffic lights to map signals by position: row of the light → row of its signal.

    The columns are ``x, y, z, heading``.
    """
    found: dict[int, int] = {}
    best = _Rule(TURNS[0], FORWARD, 0.0)
    first = True
    while True:
        rules = [_Rule(turn, FORWARD, 0.0) for turn in TURNS]
        rules += [rule for turn in TURNS if (rule := _learnt(lights, signals, turn, found))]
        ranked = [
            (_assigned(_near(lights, signals, rule, SAME_SPOT, found)), rule) for rule in rules
        ]
        matches, rule = max(ranked, key=lambda one: len(one[0]))  # Of equal ones, the first.
        if not matches:
            break
        best, first = (rule if first else best), False
        found |= matches
    rules = [best] if not first else [best, best._replace(turn=TURNS[1])]
    for rule in rules:
        aside = _near(lights, signals, rule, ASIDE, found)
        found |= _assigned(aside.take(np.abs(aside.ahead) <= SAME_SPOT))
    left = [_assigned(_near(lights, signals, rule, SAME_PLACE, found)) for rule in rules]
    found |= max(left, key=len)
    return found


def _near(
    lights: Floats, signals: Floats, rule: _Rule, reach: float, found: Mapping[int, int]
) -> _Near:
    """Return pairs of unassigned traffic lights and map signals that are near and have similar headings."""
    light = np.setdiff1d(np.arange(len(lights)), list(found))
    signal = np.setdiff1d(np.arange(len(signals)), list(found.values()))
    rows, columns = [light[:0]], [signal[:0]]
    size = max(_AT_ONCE // max(len(signal), 1), 1)
    for begin in range(0, len(light), size):
        part = light[begin : begin + size]
        apart = (lights[part, None, :2] - signals[None, signal, :2]).transpose(2, 0, 1)
        row, column = np.nonzero(np.hypot(*apart) <= reach + math.hypot(rule.ahead, rule.left))
        rows.append(part[row])
        columns.append(signal[column])
    one, other = np.concatenate(rows), np.concatenate(columns)
    dx, dy, dz, turn = (lights[one] - signals[other]).T
    heading = np.nan_to_num(signals[other, 3])
    cos, sin = np.cos(heading), np.sin(heading)
    ahead, left = dx * cos + dy * sin - rule.ahead, dy * cos - dx * sin - rule.left
    away = np.abs(np.arctan2(np.sin(turn - rule.turn), np.cos(turn - rule.turn))) > SAME_WAY
    near = _Near(one, other, ahead, left, np.nan_to_num(dz))
    # A light without a heading matches any heading.
    near = near.take((np.hypot(ahead, left) <= reach) & ~away)
    usual = float(np.median(near.up)) if len(near.up) else 0.0
    return near._replace(up=near.up - usual)


def _learnt(lights: Floats, signals: Floats, turn: float, found: Mapping[int, int]) -> _Rule | None:
    """Return the usual offset from map signals to traffic lights; ``None`` if the lights disagree."""
    near = _near(lights, signals, _Rule(turn, 0.0, 0.0), LEARNT_WITHIN, found)
    sure = near.take(_only(near.light) & _only(near.signal))
    if len(sure.light) < LEARNT_FROM:
        return None
    ahead, left = float(np.median(sure.ahead)), float(np.median(sure.left))
    agree = np.hypot(sure.ahead - ahead, sure.left - left) <= SAME_SPOT
    return _Rule(turn, ahead, left) if agree.mean() >= 0.5 else None


def _only(rows: Rows) -> Bools:
    """Return a mask of the values that occur exactly once."""
    return np.bincount(rows)[rows] == 1 if len(rows) else np.zeros(0, np.bool_)


def _assigned(near: _Near) -> dict[int, int]:
    """Assign the largest possible number of traffic lights to map signals, with the least squared distances."""
    cost = near.ahead**2 + near.left**2 + (_OF_HEIGHT * near.up) ** 2
    found: dict[int, int] = {}
    for rows in _heaps(near):
        light, at_light = np.unique(near.light[rows], return_inverse=True)
        signal, at_signal = np.unique(near.signal[rows], return_inverse=True)
        if len(light) > _MOST_TOGETHER:
            found |= _nearest_in_turn(near, rows[np.argsort(cost[rows], kind="stable")])
            continue
        # With more lights than signals, some lights have none, at the highest price.
        none = float(cost[rows].sum()) + 1.0
        table = np.full((len(light), len(signal) + len(light)), none)
        table[:, : len(signal)] = 2 * none
        table[at_light, at_signal] = cost[rows]
        chosen = least_sum(table)
        real = [
            (row, column)
            for row, column in enumerate(chosen.tolist())
            if column < len(signal) and table[row, column] < none
        ]
        found |= {int(light[row]): int(signal[column]) for row, column in real}
    return found


def _heaps(near: _Near) -> Iterator[Rows]:
    """Yield groups of candidate pairs. No light or signal occurs in two groups."""
    if not len(near.light):
        return
    lights = int(near.light.max()) + 1
    heap = components(lights + int(near.signal.max()) + 1, near.light, lights + near.signal)[
        near.light
    ]
    order = np.argsort(heap, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(heap[order])) + 1)


def _nearest_in_turn(near: _Near, rows: Rows) -> dict[int, int]:
    found: dict[int, int] = {}
    taken: set[int] = set()
    for light, signal in zip(near.light[rows].tolist(), near.signal[rows].tolist(), strict=True):
        if light not in found and signal not in taken:
            found[light] = signal
            taken.add(signal)
    return found


def least_sum(cost: Floats) -> Rows:
    """Assign a different column to each row of a cost matrix, so that the total cost is as low as possible.

    Parameters
    ----------
    cost : (n, m) float64
        Finite, with m ≥ n.

    Returns
    -------
    (n,) intp

    Notes
    -----
    The rows are added one by one along the shortest path of exchanges. Prices keep all costs positive. The
    number of steps is n² m; the m steps are vectorised.

    Source: R. Jonker, A. Volgenant, "A shortest augmenting path algorithm for dense and sparse linear
    assignment problems", Computing 38 (1987).
    """
    rows, columns = cost.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    owner = np.full(columns, -1)
    for row in range(rows):
        length, came_from = np.full(columns, np.inf), np.full(columns, -1)
        done = np.zeros(columns, np.bool_)
        here, at, so_far = row, -1, 0.0
        while True:
            step = so_far + cost[here] - row_price[here] - column_price
            shorter = ~done & (step < length)
            length[shorter], came_from[shorter] = step[shorter], at
            at = int(np.argmin(np.where(done, np.inf, length)))
            so_far, done[at] = float(length[at]), True
            if owner[at] < 0:
                break
            here = int(owner[at])
        row_price[row] += so_far
        passed = np.flatnonzero(done & (owner >= 0))
        row_price[owner[passed]] += so_far - length[passed]
        column_price[passed] -= so_far - length[passed]
        while at >= 0:  # Shift all assignments along the path by one.
            before = int(came_from[at])
            owner[at] = row if before < 0 else owner[before]
            at = before
    found = np.full(rows, -1)
    taken = np.flatnonzero(owner >= 0)
    found[owner[taken]] = taken
    return found


def _by_boxes(
    lights: Mapping[int, Light], road_map: RoadMap, columns: Iterable[int]
) -> dict[int, str]:
    """Assign unused map signals to traffic lights with trigger boxes on the lanes of the signal.

    Of several signals, the one with the most of these lanes is used, then the nearest. Without a free signal,
    the lanes of the boxes are returned by name.
    """
    nodes = road_map.nodes
    own = _lanes_of_boxes(lights, road_map)
    after = _lanes_after(road_map)
    applying: dict[int, list[int]] = {}
    for column in columns:
        for lane in road_map.lanes_of_signal(nodes.name[column]).tolist():
            applying.setdefault(lane, []).append(column)
    ranked: list[tuple[int, float, str, int]] = []
    for ident, lanes in own.items():
        reached = lanes.union(*(after.get(lane, ()) for lane in lanes))
        shared = Counter(column for lane in reached for column in applying.get(lane, ()))
        for column, count in shared.items():
            apart = math.hypot(nodes.x[column] - lights[ident].x, nodes.y[column] - lights[ident].y)
            far = math.inf if math.isnan(apart) else apart
            ranked.append((-count, far, nodes.name[column], ident))
    found: dict[int, str] = {}
    taken: set[str] = set()
    for _, _, name, ident in sorted(ranked):
        if ident not in found and name not in taken:
            found[ident] = name
            taken.add(name)
    named = {
        ident: RoadMap.lanes_ref(nodes.name[-1 - lane] for lane in sorted(lanes, reverse=True))
        for ident, lanes in own.items()
        if lanes
    }
    return named | found


def _lanes_after(road_map: RoadMap) -> dict[int, set[int]]:
    edges = road_map.edges
    flow = edges.relation == RELATION_CODE["travelsTo"]
    after: dict[int, set[int]] = {}
    for lane, following in zip(edges.src[flow].tolist(), edges.dst[flow].tolist(), strict=True):
        after.setdefault(lane, set()).add(following)
    return after


def _lanes_of_boxes(lights: Mapping[int, Light], road_map: RoadMap) -> dict[int, set[int]]:
    """Return the driving lanes in the trigger boxes of each traffic light: light id → node ids."""
    told = [(ident, box) for ident, light in lights.items() for box in light.boxes]
    boxes = np.array([box for _, box in told], np.float64).reshape(-1, 6)
    hits = road_map.lanes_of(boxes[:, [0, 1, 3, 4, 5]], np.full(len(boxes), np.nan))
    lane_type = road_map.nodes.lane_type
    found: dict[int, set[int]] = {ident: set() for ident in lights}
    for hit in np.flatnonzero(_through(hits, boxes)).tolist():
        lane = int(hits.lane[hit])
        if lane_type[-1 - lane] == _DRIVING:
            found[told[int(hits.row[hit])][0]].add(lane)
    return found


def _through(hits: Any, boxes: Floats) -> Bools:
    """Return a mask of the lanes whose centre line crosses a trigger box."""
    error, box = hits.heading_error, boxes[hits.row]
    reach = (np.abs(np.sin(error)) * box[:, 4] + np.abs(np.cos(error)) * box[:, 5]) / 2
    return np.abs(hits.offset) <= reach


def shared_signals(signals: Mapping[int, str], road_map: RoadMap) -> list[str]:
    """Return a warning for each map signal to which several traffic lights are assigned."""
    if len(set(signals.values())) == len(signals):
        return []
    known = set(road_map.nodes.name)
    by_name: dict[str, list[int]] = {}
    for ident, name in signals.items():
        if name in known:  # Several lights of one lane name are valid.
            by_name.setdefault(name, []).append(ident)
    return [
        f"traffic lights {_listed(sorted(idents))} are one signal of the road map: {name!r}"
        for name, idents in by_name.items()
        if len(idents) > 1
    ]


class AtOnce:
    """Detector of wrongly assigned traffic lights: a lane has a red and a green light at the same time.

    Parameters
    ----------
    signals : mapping
        Signal of the road map by light.
    road_map : RoadMap or None
    idents : iterable of int
        Lights, in the order of their states.
    before : AtOnce, optional
        Earlier detector, whose counts are continued after a change of the lights.

    Attributes
    ----------
    idents : list of int
    who : dict
        Lane name → the red and the green light.
    frames : dict
        Lane name → number of frames with the contradiction.
    """

    def __init__(
        self,
        signals: Mapping[int, str],
        road_map: RoadMap | None,
        idents: Iterable[int],
        before: AtOnce | None = None,
    ) -> None:
        self.idents = list(idents)
        named: list[tuple[str, int]] = []
        if road_map is not None:
            for row, ident in enumerate(self.idents):
                lanes = road_map.lanes_of_signal(signals.get(ident, ""))
                named += [(road_map.nodes.name[-1 - lane], row) for lane in lanes.tolist()]
        self._lanes = sorted({lane for lane, _ in named})
        place = {lane: i for i, lane in enumerate(self._lanes)}
        self._lane: Ints = np.array([place[lane] for lane, _ in named], np.int64)
        self._light: Ints = np.array([row for _, row in named], np.int64)
        self._last: Ints | None = None
        self._bad: list[str] = []
        self.who: dict[str, tuple[int, int]] = {} if before is None else before.who
        self.frames: dict[str, int] = {} if before is None else before.frames

    def see(self, states: Ints) -> None:
        """Check whether the traffic lights of a frame contradict each other."""
        if states is not self._last:
            self._last = states
            self._bad = self._contradicting(states)
        for lane in self._bad:
            self.frames[lane] = self.frames.get(lane, 0) + 1

    def _contradicting(self, states: Ints) -> list[str]:
        count, shown = len(self._lanes), states[self._light]
        red, green = (
            np.bincount(self._lane[shown == code], minlength=count) > 0 for code in (_RED, _GREEN)
        )
        bad = np.flatnonzero(red & green).tolist()
        for lane in bad:
            here = self._light[self._lane == lane]
            one, other = (int(here[states[here] == code][0]) for code in (_RED, _GREEN))
            self.who.setdefault(self._lanes[lane], (self.idents[one], self.idents[other]))
        return [self._lanes[lane] for lane in bad]

    @property
    def warnings(self) -> list[str]:
        """Warnings about lanes with contradicting lights: one for each pair of a red and a green light."""
        by_lights: dict[tuple[int, int], list[str]] = {}
        for lane, who in sorted(self.who.items()):
            by_lights.setdefault(who, []).append(lane)
        told = [self._about(one, other, lanes) for (one, other), lanes in by_lights.items()]
        more = len(told) - MOST_NAMED
        if more > 0:
            told[MOST_NAMED:] = [f"{more} more pairs of traffic lights contradict one another"]
        return told

    def _about(self, one: int, other: int, lanes: list[str]) -> str:
        what = f"{'lanes' if len(lanes) > 1 else 'lane'} {_listed(lanes)}"
        frames = max(self.frames[lane] for lane in lanes)
        lights = f"red by traffic light '{one}' and green by '{other}'"
        return f"{what}: {lights} at once, in {number_of(frames, 'frame')}"


def _listed(names: list[Any]) -> str:
    return first_of([repr(str(name)) for name in names], MOST_NAMED)


# Traffic lights of CARLA's bridge: positions and states. The bridge contains the position of a light and its
# trigger box on the road, but no lane. The lanes are those of its map signal
# (:mod:`sgstore.readers.carla._signals`). A light without a map signal applies to the lanes in its box.

TYPE_NAME: Final = "traffic.traffic_light"
_STATES: Final = ("red", "yellow", "green", "off", "unknown")


def light_state(number: int) -> str:
    """Return the name of a traffic light state (such as ``red``) for CARLA's state number."""
    return _STATES[number] if 0 <= number < len(_STATES) else "unknown"


def read_places(message: dict[str, Any]) -> dict[int, Light]:
    """Return the traffic lights in a CARLA message by id. Drop lights without a valid position."""
    lights: dict[int, Light] = {}
    for told in records(message, "traffic_lights"):
        x, y, z = (number(told, f"transform.position.{axis}") for axis in "xyz")
        turn = [number(told, f"transform.orientation.{part}") for part in "xyzw"]
        heading = heading_of(*turn)
        ident = ident_of(told, "id")
        if ident is None or not all(abs(value) < FAR for value in (x, y, z, heading)):
            continue
        dx, dy, dz = (number(told, f"trigger_volume.center.{axis}") for axis in "xyz")
        length, width = (number(told, f"trigger_volume.size.{axis}") for axis in "xy")
        cos, sin = math.cos(heading), math.sin(heading)
        centre = (x + dx * cos - dy * sin, y + dx * sin + dy * cos, z + dz)
        box = (*centre, heading, abs(length), abs(width))
        known = all(abs(value) < FAR for value in box)
        lights[ident] = Light(x, y, z, heading, (box,) if known else ())
    return lights


def heading_of(x: float, y: float, z: float, w: float) -> float:
    """Return the heading of a rotation quaternion of any length; rad. NaN if it is invalid."""
    norm = x * x + y * y + z * z + w * w
    if not 0.25 < norm < 4:
        return NAN
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


class Lights:
    """Traffic lights of a CARLA trace and their latest states.

    Parameters
    ----------
    places : mapping
        Lights by id.
    signals : mapping
        Signal id in the road map by light id.
    road_map : RoadMap or None
        That map.
    roster : EntityTable
        Receives each light as an entity.
    """

    def __init__(
        self,
        places: Mapping[int, Light],
        signals: Mapping[int, str],
        road_map: RoadMap | None,
        roster: EntityTable,
    ) -> None:
        self._roster = roster
        self._row = {ident: row for row, ident in enumerate(sorted(places))}
        self._signals = signals
        self._unplaced: set[int] = set()
        self.nodes: Ints = np.array([self._enter(ident) for ident in self._row], np.int64)
        self.values: Floats = np.full((len(self._row), len(POSE)), np.nan)
        for row, ident in enumerate(self._row):
            light = places[ident]
            self.values[row, :4] = light.x, light.y, light.z, light.heading
        self._states: Ints = np.full(len(self._row), LIGHT_STATE_CODE["unknown"], np.int64)
        self._at_once = AtOnce(signals, road_map, self._row)
        self._shared = [] if road_map is None else shared_signals(signals, road_map)

    @property
    def unplaced(self) -> int:
        """Number of traffic lights that have a state, but no position."""
        return len(self._unplaced)

    @property
    def aimless(self) -> int:
        """Number of traffic lights whose lanes are unknown."""
        return len(self._row.keys() - self._signals.keys())

    @property
    def warnings(self) -> list[str]:
        """Warnings so far about traffic lights whose map signal may be wrong."""
        return [*self._shared, *self._at_once.warnings]

    def of_frame(self) -> Ints:
        """Return the states of all traffic lights in the next frame, as state codes.

        Frames share this array; do not change it.
        """
        self._at_once.see(self._states)
        return self._states

    def update(self, message: dict[str, Any]) -> None:
        """Update light states from a CARLA message. Lights that it does not contain keep their state."""
        states = self._states.copy()  # Frames share the old array.
        for told in records(message, "traffic_lights"):
            ident, state = ident_of(told, "id"), ident_of(told, "state")
            if ident is None or state is None:
                continue
            row = self._row.get(ident)
            if row is not None:
                states[row] = LIGHT_STATE_CODE[light_state(state)]
            elif ident not in self._unplaced:
                self._unplaced.add(ident)
                self._enter(ident)
        if (states != self._states).any():
            self._states = states

    def forget(self) -> None:
        """Set the states of all traffic lights to unknown, until the next message with states."""
        self._states = np.full_like(self._states, LIGHT_STATE_CODE["unknown"])

    def _enter(self, ident: int) -> int:
        meaning = TypeMeaning("traffic_light")
        return self._roster.enter(str(ident), meaning, TYPE_NAME, self._signals.get(ident, ""))
