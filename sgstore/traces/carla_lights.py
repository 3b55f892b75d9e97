"""Traffic lights of CARLA: where they stand, what they show, and which signal of the road map each one is.

The bridge tells the place of a light and the box on the road that triggers it, but no lane. The lanes are
those of the signal of the map that it is: the one that stands where it stands, or else the one that applies
to the lanes of its box, or to those that they lead to. A light that the map does not have at all applies to the
lanes of its box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.roads import lanes_ref
from sgstore.traces.carla_channels import ident_of
from sgstore.traces.cdr import number, records
from sgstore.traces.frames import FAR, NAN
from sgstore.vocabulary import KIND_CODE, LIGHT_STATE_CODE, RELATION_CODE, TypeMeaning
from sgstore.world import POSE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.roads import RoadMap
    from sgstore.traces.frames import Roster
    from sgstore.world import Floats, Ints

SAME_PLACE: Final = 1.0
"""How far a light may stand from the signal of the map that it is; m."""
SAME_WAY: Final = math.pi / 4
"""By how much it may face another way; rad."""

TYPE_NAME: Final = "traffic.traffic_light"
STATES: Final = ("red", "yellow", "green", "off", "unknown")
"""``CarlaTrafficLightStatus.state`` → name in :data:`sgstore.vocabulary.LIGHT_STATES`."""

_DRIVING: Final = "driving"


@dataclass(frozen=True, slots=True)
class Light:
    """A traffic light.

    Attributes
    ----------
    x, y, z, heading : float
        Where it stands and faces; NaN: not known.
    box : tuple of float
        What triggers it: centre ``x, y, z``, heading, length, width; NaN: not known.
    """

    x: float
    y: float
    z: float
    heading: float
    box: tuple[float, ...] = (NAN,) * 6


def read_places(message: dict[str, Any]) -> dict[int, Light]:
    """Lights by id, as a ``CarlaTrafficLightInfoList`` tells them, without those that have no usable place."""
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
        lights[ident] = Light(x, y, z, heading, box if known else (NAN,) * 6)
    return lights


def heading_of(x: float, y: float, z: float, w: float) -> float:
    """Heading of a quaternion of any length; rad. NaN for one that is none."""
    norm = x * x + y * y + z * z + w * w
    if not 0.25 < norm < 4:
        return NAN
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def signals_of(lights: Mapping[int, Light], road_map: RoadMap) -> dict[int, str]:
    """Id of the signal of a road map that each light is, or else the lanes that it applies to by name.

    Lights that are no signal and whose box is on no lane are left out.
    """
    nodes = road_map.nodes
    columns = np.flatnonzero(nodes.kind == KIND_CODE["traffic_light"])
    found: dict[int, str] = {}
    for ident, light in lights.items() if len(columns) else ():
        apart = np.hypot(nodes.x[columns] - light.x, nodes.y[columns] - light.y)
        turn = nodes.heading[columns] - light.heading
        turn = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
        here = (apart <= SAME_PLACE) & ~(turn > SAME_WAY)
        if here.any():
            column = columns[here][np.argmin(apart[here])]
            found[ident] = nodes.name[column]
    others = {ident: light for ident, light in lights.items() if ident not in found}
    return found | _by_boxes(others, road_map, columns)


def _by_boxes(
    lights: Mapping[int, Light], road_map: RoadMap, columns: Iterable[int]
) -> dict[int, str]:
    """The signals that apply to the lanes of the boxes of lights, or to those that they lead to.

    Of several signals it is the one that has most of these lanes, then the nearest; without any, the lanes of
    the box are named.
    """
    nodes, edges = road_map.nodes, road_map.edges
    boxes = np.array([light.box for light in lights.values()], np.float64).reshape(-1, 6)
    hits = road_map.lanes_of(boxes[:, [0, 1, 3, 4, 5]], np.full(len(boxes), np.nan))
    flow = edges.relation == RELATION_CODE["travelsTo"]
    after: dict[int, set[int]] = {}
    for lane, following in zip(edges.src[flow].tolist(), edges.dst[flow].tolist(), strict=True):
        after.setdefault(lane, set()).add(following)
    names = [nodes.name[column] for column in columns]
    applies = {name: set(road_map.lanes_of_signal(name).tolist()) for name in names}
    place = dict(zip(names, columns, strict=True))
    found: dict[int, str] = {}
    for row, (ident, light) in enumerate(lights.items()):
        lanes = {
            lane
            for lane in hits.lane[_through(hits, row, boxes[row])].tolist()
            if nodes.lane_type[-1 - lane] == _DRIVING
        }
        own = sorted(lanes, reverse=True)
        lanes = lanes.union(*(after.get(lane, ()) for lane in lanes))
        ranked = [
            (-len(lanes & theirs), _apart(nodes.x[place[name]], nodes.y[place[name]], light), name)
            for name, theirs in applies.items()
            if lanes & theirs
        ]
        if ranked:
            found[ident] = min(ranked)[2]
        elif own:
            found[ident] = lanes_ref(nodes.name[-1 - lane] for lane in own)
    return found


def _through(hits: Any, row: int, box: Floats) -> Any:
    """Rows of the lanes whose centre line runs through a box, not only its border."""
    error = hits.heading_error
    reach = (np.abs(np.sin(error)) * box[4] + np.abs(np.cos(error)) * box[5]) / 2
    return (hits.row == row) & (np.abs(hits.offset) <= reach)


def _apart(x: float, y: float, light: Light) -> float:
    return math.hypot(x - light.x, y - light.y)


class Lights:
    """The traffic lights of a trace, with a row in every frame.

    Parameters
    ----------
    places : mapping
        Lights by id.
    signals : mapping
        Ids of the signals of the road map that they are.
    roster : Roster
        Takes each of them up as an entity.
    """

    def __init__(
        self, places: Mapping[int, Light], signals: Mapping[int, str], roster: Roster
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

    @property
    def unplaced(self) -> int:
        """Lights that have a state but no place."""
        return len(self._unplaced)

    @property
    def aimless(self) -> int:
        """Lights of which it is not known for which lanes they are."""
        return len(self._row.keys() - self._signals.keys())

    @property
    def states(self) -> Ints:
        """What they show now: codes of :data:`sgstore.vocabulary.LIGHT_STATES`. Not to be written to."""
        return self._states

    def update(self, message: dict[str, Any]) -> None:
        """Take up a ``CarlaTrafficLightStatusList``; lights that it does not name stay as they are."""
        states = self._states.copy()  # frames keep the array that they were given
        for told in records(message, "traffic_lights"):
            ident, state = ident_of(told, "id"), ident_of(told, "state")
            if ident is None or state is None:
                continue
            row = self._row.get(ident)
            if row is not None:
                states[row] = LIGHT_STATE_CODE[
                    STATES[state] if 0 <= state < len(STATES) else "unknown"
                ]
            elif ident not in self._unplaced:
                self._unplaced.add(ident)
                self._enter(ident)
        self._states = states

    def _enter(self, ident: int) -> int:
        meaning = TypeMeaning("traffic_light")
        return self._roster.enter(str(ident), meaning, TYPE_NAME, self._signals.get(ident, ""))
