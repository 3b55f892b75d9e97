"""OpenDRIVE signals (traffic lights, signs): type, position and controlled lanes.

This module finds signals whose place contradicts the lanes of their orientation.

Only signals without validity are checked. The place contradicts if no lane has the named direction
although there is traffic. The place of a light, stop or yield sign before a junction also
contradicts if all named lanes come out of the junction while other lanes lead into it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import first_of
from sgstore.base.tables import chained
from sgstore.maps.opendrive._network import END, START, junction_ends
from sgstore.maps.opendrive._nodes import FIRST_LANE, speed
from sgstore.maps.opendrive._positions import node_columns, standing
from sgstore.maps.roads import MapNodes
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.maps.opendrive._document import Document
    from sgstore.maps.opendrive._network import Network
    from sgstore.maps.opendrive._plan_view import PlanView
    from sgstore.maps.roads import Edge
    from sgstore.model.config import Signs
    from sgstore.model.world import Floats, Ints


NEAR: Final = 50.0
"""Largest distance between a signal and a junction for which the signal is before it; m along the road."""
LISTED: Final = 8
"""Largest number of signals that a warning lists."""
_BEFORE_JUNCTIONS: Final = frozenset({"traffic_light", "stop_sign", "yield_sign"})
_READERS: Final = {"asam": "as ASAM OpenDRIVE reads it", "carla": "as CARLA reads it"}


@dataclass(slots=True)
class Doubts:
    """Check for signals of an OpenDRIVE map that are oriented against the direction of their lanes.

    Parameters
    ----------
    document : Document
    network : Network
    reading : str
        ``asam`` or ``carla``: interpretation of orientations.

    Attributes
    ----------
    kinds : dict
        Signal -> its kind.
    asked : int
        Number of elements with an orientation and without validity.
    """

    document: Document
    network: Network
    reading: str
    kinds: dict[str, str] = field(default_factory=dict[str, str])
    asked: int = 0
    _odd: dict[str, bool] = field(default_factory=dict[str, bool])
    _lengths: list[float] = field(default_factory=list[float])
    _junctions: dict[str, frozenset[int]] = field(default_factory=dict[str, frozenset[int]])

    def ask(
        self,
        signal: str,
        place: tuple[int, float],
        there: frozenset[int],
        readings: tuple[frozenset[int], frozenset[int]],
    ) -> None:
        """Check whether the orientation of a signal fits the lanes at its road position.

        ``there``: the driving lanes at this place; ``readings``: the lanes of its orientation in
        the chosen and in the other interpretation.
        """
        self.asked += 1
        ours, theirs = (self._fits(self.kinds.get(signal, ""), place, there, r) for r in readings)
        if not ours:
            self._odd[signal] = self._odd.get(signal, True) and theirs

    def warnings(self) -> list[str]:
        """Return a warning about signals with a doubtful orientation, or an empty list."""
        if not self._odd:
            return []
        names = first_of([*map(repr, self._odd)], LISTED)
        other = "carla" if self.reading == "asam" else "asam"
        better = sum(self._odd.values())
        help_ = f'; {better} of {len(self._odd)} would fit with the setting orientation = "{other}"'
        return [
            f"signals without <validity> {names}: their orientation, {_READERS[self.reading]}, names no"
            f" traffic, or what comes out of the junction before which they stand{help_ if better else ''}"
        ]

    def _fits(
        self, kind: str, place: tuple[int, float], there: frozenset[int], named: frozenset[int]
    ) -> bool:
        if not there:
            return True
        if not named:
            return False
        end = self._before(*place) if kind in _BEFORE_JUNCTIONS else ""
        if not end:
            return True
        towards = {lane for lane in there if self._leads_to(lane, end)}
        return not towards or not named.isdisjoint(towards)

    def _leads_to(self, lane: int, end: str) -> bool:
        lanes = self.network.lanes
        return bool(lanes.both[lane] or lanes.forward[lane] == (end == END))

    def _before(self, road: int, s: float) -> str:
        """Return the end (``start`` or ``end``) of a road with a junction near a position, or an empty text."""
        if not self._junctions:
            self._lengths = self.document.rough_numbers("road", "length").tolist()
            ends = [(road, at) for road, at, _ in junction_ends(self.document)]
            self._junctions = {
                end: frozenset(road for road, at in ends if at == end) for end in (START, END)
            }
        length = self._lengths[road]
        end, away = (START, s) if s < length / 2 else (END, length - s)
        return end if away <= NEAR and road in self._junctions[end] else ""


# A signal has one place. It applies to lanes of the roads that name it: by its own validity, and by
# each ``signalReference`` with its validity. Without a validity it applies to all traffic in the
# direction of its orientation. (ASAM OpenDRIVE 1.8, 14.) LibCarla uses the lanes of a *side*
# instead: for ``+`` the lanes left of the road's line. On a road for right-hand traffic the two
# interpretations are opposite, and maps exist for both; therefore a contradictory place causes a
# warning (:mod:`sgstore.maps.opendrive._signals`). The maps of CARLA contain speed limits and painted
# stop signs as *objects* named ``Speed_30`` and ``Stencil_STOP``. LibCarla reads them as signals of
# type 274 and 206 (and loses the painted ones among its landmarks); their orientation is the sign
# of the lanes that they apply to.

KIND_OF_TYPE: Final = {
    "206": "stop_sign",
    "R1-1": "stop_sign",
    "205": "yield_sign",
    "R1-2": "yield_sign",
    "274": "speed_limit",
    "274.1": "speed_limit",
    "R2-1": "speed_limit",
}
"""Codes of traffic signs → kinds: StVO (Germany), used by CARLA and esmini, and MUTCD (United States)."""

_LIGHT: Final = re.compile(r"10000(0[1-9]|1\d|2\d)$")
"""Type codes of traffic lights for the country ``OpenDRIVE``."""
_NOT_LIGHTS: Final = {"1000003", "1000004"}
"""Type codes of painted crossings for people and bicycles, which are not traffic lights."""
_PEDESTRIAN_LIGHT: Final = "1000002"
"""Type code of a light for pedestrians. Its validity names the lanes that they cross, and it controls none."""
_STOP_LINE: Final = "294"
"""Type code of a stop line in StVO (Germany), which maps of other countries also use."""
_SPEED_OBJECT: Final = re.compile(r"speed_(\d+(?:\.\d+)?)", re.IGNORECASE)
_STOP_STENCIL: Final = "stencil_stop"

Stops = frozenset[tuple[int, float]]
"""Lanes (counted from 0) and positions ``s`` on their roads at which a signal applies; m."""


@dataclass(frozen=True, slots=True)
class Signals:
    """Traffic lights and signs of an OpenDRIVE map, with the lanes to which they apply.

    Attributes
    ----------
    nodes : MapNodes
    lanes : list of Stops
        Lanes that each signal applies to, and the places.
    codes : list of str
        The type of each in the file.
    told : str
        Configured kinds, and the interpretation of orientations if it differs from the standard and
        matters; empty if neither applies.
    about : list of dict
        Text, value, unit, type and size of each signal in the file, as attributes.
    """

    nodes: MapNodes
    lanes: list[Stops]
    codes: list[str]
    told: str = ""
    about: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])

    def edges(self, first: int) -> Edge:
        """Return the map edges ``controlsTrafficOf`` from signals to lanes."""
        found = {(first + row, lane) for row, lanes in enumerate(self.lanes) for lane, _ in lanes}
        pairs = sorted(found)
        signal, lane = np.array(pairs, np.int64).reshape(-1, 2).T
        return ("controlsTrafficOf", signal, FIRST_LANE + lane)

    def places(self, first: int) -> tuple[Ints, Ints, Floats]:
        """Return three columns: signals, their lanes, and the road positions ``s`` where they apply."""
        rows = [(row, *one) for row, lanes in enumerate(self.lanes) for one in sorted(lanes)]
        row, lane = np.array([one[:2] for one in rows], np.int64).reshape(-1, 2).T
        return first + row, lane, np.array([s for *_, s in rows], np.float64)

    def stop_lines(self, first: int) -> Ints:
        """Return the node rows of those signals that are painted stop lines."""
        return first + np.array([r for r, c in enumerate(self.codes) if c == _STOP_LINE], np.int64)


def read_signals(document: Document, plan: PlanView, network: Network, signs: Signs) -> Signals:
    """Read the signals of an OpenDRIVE map. Signals with an invalid position are skipped with a warning."""
    reach = _Reach(document, network, signs.orientation)
    kinds = dict(signs.kinds)
    parts = (_elements(document, plan, reach, kinds), _signal_objects(document, plan, reach))
    network.warnings.extend(reach.doubts.warnings())
    other = "" if signs.orientation == "asam" or not reach.doubts.asked else signs.orientation
    return Signals(
        chained([part.nodes for part in parts]),
        [s for p in parts for s in p.lanes],
        [code for p in parts for code in p.codes],
        " ".join(filter(None, (parts[0].told, other))),
        [about for part in parts for about in part.about],
    )


def read_controllers(document: Document) -> dict[str, tuple[str, ...]]:
    """Return the signals that switch together: controller id → signal ids."""
    table = document["controller/control"]
    names = document["controller"].texts("id")
    members: dict[str, list[str]] = {}
    for row, signal in zip(table.parent, table.texts("signalId"), strict=True):
        members.setdefault(names[row], []).append(signal)
    return {name: tuple(dict.fromkeys(signals)) for name, signals in members.items()}


def is_signal_object(name: str) -> bool:
    """Return True if the name of a map object shows that it is a traffic signal."""
    return bool(_SPEED_OBJECT.match(name)) or _STOP_STENCIL in name.lower()


def kind_of_signal(code: str, *, dynamic: bool, name: str = "") -> str:
    """Return the kind of an OpenDRIVE signal from its type code; by default ``sign``."""
    if _LIGHT.match(code) and code not in _NOT_LIGHTS:
        return "traffic_light"
    if code in KIND_OF_TYPE:
        return KIND_OF_TYPE[code]
    if dynamic and "light" in name.lower():
        return "traffic_light"
    return "sign"


class _Reach:
    """Look-up of the driving lanes at a road position to which a signal applies."""

    def __init__(self, document: Document, network: Network, orientation: str) -> None:
        self.warnings = network.warnings
        self.doubts = Doubts(document, network, orientation)
        self._reading = orientation
        self._network = network
        lanes = network.lanes
        self._driving: dict[int, list[tuple[int, int]]] = {}
        for lane, (kind, section, ident) in enumerate(
            zip(lanes.type, lanes.section.tolist(), lanes.ident.tolist(), strict=True)
        ):
            if kind in DRIVING:
                self._driving.setdefault(section, []).append((lane, ident))
        self._ranges = {
            kind: _validities(document, kind) for kind in ("road/signal", "road/signalReference")
        }
        self._tables = {kind: document[kind] for kind in self._ranges}
        # Many signals apply to the same lanes: results are cached.
        self._known: dict[tuple[int, object], frozenset[int]] = {}

    def valid(self, element: tuple[str, int, str], place: tuple[int, float]) -> frozenset[int]:
        """Return the driving lanes at a road position that a signal's validity or orientation selects."""
        kind, row, signal = element
        ranges = self._ranges[kind].get(row)
        orientation = self._tables[kind].attributes[row].get("orientation", "")
        section = self._network.section_at(*place)
        key = (section, orientation if ranges is None else tuple(ranges))
        lanes = self._driving.get(section, [])
        if key not in self._known:
            self._known[key] = (
                self._oriented(lanes, orientation, self._reading)
                if ranges is None
                else frozenset(
                    lane
                    for lane, ident in lanes
                    if any(low <= ident <= high for low, high in ranges)
                )
            )
        if ranges is None and orientation in {"+", "-"}:
            there = frozenset(lane for lane, _ in lanes)
            other = "carla" if self._reading == "asam" else "asam"
            readings = self._known[key], self._oriented(lanes, orientation, other)
            self.doubts.ask(signal, place, there, readings)
        return self._known[key]

    def on_side(self, place: tuple[int, float], *, left: bool) -> frozenset[int]:
        """Return the driving lanes at a road position on one side of the centre lane: left or right."""
        lanes = self._driving.get(self._network.section_at(*place), [])
        return frozenset(lane for lane, ident in lanes if (ident > 0) == left)

    def _oriented(
        self, lanes: list[tuple[int, int]], orientation: str, reading: str
    ) -> frozenset[int]:
        """Return the lanes that a signal's orientation selects, by their direction or by side of the road."""
        if orientation not in {"+", "-"}:
            return frozenset(lane for lane, _ in lanes)
        plus, about = orientation == "+", self._network.lanes
        if reading == "carla":
            return frozenset(lane for lane, ident in lanes if (ident > 0) == plus)
        return frozenset(
            lane for lane, _ in lanes if about.both[lane] or about.forward[lane] == plus
        )


def _validities(document: Document, kind: str) -> dict[int, list[tuple[float, float]]]:
    kind = f"{kind}/validity"
    ends = (document.rough_numbers(kind, name).tolist() for name in ("fromLane", "toLane"))
    ranges: dict[int, list[tuple[float, float]]] = {}
    for row, one, other in zip(document[kind].parent, *ends, strict=True):
        ranges.setdefault(row, []).append((min(one, other), max(one, other)))
    return ranges


def _elements(
    document: Document, plan: PlanView, reach: _Reach, signs: Mapping[str, str]
) -> Signals:
    kind = "road/signal"
    rows = standing(document, kind, np.arange(len(document[kind])), reach.warnings)
    attributes = [document[kind].attributes[row] for row in rows.tolist()]
    ids = [a.get("id", "") for a in attributes]
    codes = [a.get("type", "") for a in attributes]
    told = {code: signs[code.lower()] for code in sorted(set(codes)) if code.lower() in signs}
    kinds = [
        told.get(code)
        or kind_of_signal(code, dynamic=a.get("dynamic") == "yes", name=a.get("name", ""))
        for code, a in zip(codes, attributes, strict=True)
    ]
    limits = [
        _limit(a) if kind == "speed_limit" else np.nan
        for kind, a in zip(kinds, attributes, strict=True)
    ]
    road, s = document[kind].road, document.rough_numbers(kind, "s")
    reach.doubts.kinds = dict(zip(ids, kinds, strict=True))
    referred = _referred(document, reach)
    lanes: list[Stops] = []
    for row, name, code in zip(rows.tolist(), ids, codes, strict=True):
        if code == _PEDESTRIAN_LIGHT:
            lanes.append(frozenset())
            continue
        place = int(road[row]), float(s[row])
        own = _stops(reach.valid((kind, row, name), place), place)
        lanes.append(own | referred.get(name, frozenset()))
    columns = node_columns(document, plan, kind, rows)
    nodes = MapNodes.of(kinds, ids, speed_limit=np.array(limits), **columns)
    about: list[dict[str, Any]] = [
        {
            f"landmark_{name}": a[name].strip()[:_LONGEST]
            for name in _TOLD
            if a.get(name, "").strip()
        }
        for a in attributes
    ]
    for name in ("value", "width", "height"):
        numbers = document.rough_numbers(kind, name, math.nan)[rows]
        for row in np.flatnonzero(np.isfinite(numbers)).tolist():
            about[row][f"landmark_{name}"] = float(numbers[row])
    return Signals(nodes, lanes, codes, repr(told) if told else "", about)


_TOLD: Final = ("text", "unit", "country", "type", "subtype")
_LONGEST: Final = 200
"""Largest length of a text of a signal; characters."""


def _stops(lanes: frozenset[int], place: tuple[int, float]) -> Stops:
    return frozenset((lane, place[1]) for lane in lanes)


def _referred(document: Document, reach: _Reach) -> dict[str, Stops]:
    """Return the lanes and positions of OpenDRIVE signal references: signal id → its lanes and positions."""
    kind = "road/signalReference"
    table = document[kind]
    s = document.rough_numbers(kind, "s")
    found: dict[str, Stops] = {}
    for row in np.flatnonzero(np.isfinite(s)).tolist():
        attributes = table.attributes[row]
        place = (int(table.road[row]), float(s[row]))
        name = attributes.get("id", "")
        lanes = _stops(reach.valid((kind, row, name), place), place)
        found[name] = found.get(name, frozenset()) | lanes
    return found


def _limit(attributes: dict[str, str]) -> float:
    """Return the speed limit on a sign. Without a unit it is in km/h, or mph for codes of the United States."""
    american = attributes.get("type", "").startswith("R") or attributes.get("country") == "US"
    unit = attributes.get("unit") or ("mph" if american else "km/h")
    return speed(attributes.get("value", ""), unit)


def _signal_objects(document: Document, plan: PlanView, reach: _Reach) -> Signals:
    kind = "road/object"
    table = document[kind]
    named = np.array([is_signal_object(name) for name in table.texts("name")], bool)
    rows = standing(document, kind, np.flatnonzero(named), reach.warnings)
    kinds: list[str] = []
    limits: list[float] = []
    lanes: list[Stops] = []
    about: list[dict[str, Any]] = []
    s = document.rough_numbers(kind, "s")
    for row in rows.tolist():
        attributes = table.attributes[row]
        limit = _SPEED_OBJECT.match(attributes.get("name", ""))
        kinds.append("speed_limit" if limit else "stop_sign")
        limits.append(speed(limit[1], "km/h") if limit else np.nan)
        about.append({"landmark_type": "274" if limit else "206"})
        if limit:
            about[-1] |= {"landmark_text": limit[1], "landmark_value": float(limit[1])}
        left = attributes.get("orientation", "") == "+"
        place = (int(table.road[row]), float(s[row]))
        lanes.append(_stops(reach.on_side(place, left=left), place))
    ids = [table.attributes[row].get("id", "") for row in rows.tolist()]
    columns = node_columns(document, plan, kind, rows)
    nodes = MapNodes.of(kinds, ids, speed_limit=np.array(limits), **columns)
    return Signals(nodes, lanes, [""] * len(ids), about=about)
