"""Signals: what they are, where they stand, and which lanes they apply to.

A signal stands in one place and applies to lanes of the roads that name it: by its own validity, and by each
``signalReference`` with its own. Without a validity it applies to whatever travels in the direction of its
orientation. (ASAM OpenDRIVE 1.8, 14.) The maps of CARLA keep speed limits and painted stop signs as
*objects* named ``Speed_30`` and ``Stencil_STOP``, which LibCarla reads as signals of type 274 and 206 (and
loses the painted ones on the way to its landmarks); their orientation is the sign of the lanes that they
apply to.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.opendrive.nodes import FIRST_LANE, speed
from sgstore.opendrive.places import node_columns, standing
from sgstore.roads import MapNodes
from sgstore.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.opendrive.document import Document
    from sgstore.opendrive.links import Network
    from sgstore.opendrive.planview import PlanView
    from sgstore.roads.lanes import Edge

KIND_OF_TYPE: Final = {
    "206": "stop_sign",
    "R1-1": "stop_sign",
    "205": "yield_sign",
    "R1-2": "yield_sign",
    "274": "speed_limit",
    "274.1": "speed_limit",
    "R2-1": "speed_limit",
}
"""Codes of traffic signs → kinds: StVO (Germany), which CARLA and esmini use, and MUTCD (United States)."""

_LIGHT: Final = re.compile(r"10000(0[1-9]|1\d|2\d)$")
"""Codes of traffic lights in the catalogue that OpenDRIVE's country ``OpenDRIVE`` means."""
_NOT_LIGHTS: Final = {"1000003", "1000004"}
"""Crossings for people and bicycles, painted on the road."""
_SPEED_OBJECT: Final = re.compile(r"speed_(\d+(?:\.\d+)?)", re.IGNORECASE)
_STOP_STENCIL: Final = "stencil_stop"


@dataclass(frozen=True, slots=True)
class Signals:
    """Signals and the lanes that they apply to.

    Attributes
    ----------
    nodes : MapNodes
    lanes : list of frozenset of int
        Lanes, counted from 0, that each applies to.
    told : str
        Which kinds are what the client says that they are; empty: none.
    """

    nodes: MapNodes
    lanes: list[frozenset[int]]
    told: str = ""

    def edges(self, first: int) -> Edge:
        """``controlsTrafficOf``; ``first`` is the row of the first signal among the nodes."""
        pairs = [(first + row, lane) for row, lanes in enumerate(self.lanes) for lane in lanes]
        signal, lane = np.array(pairs, np.int64).reshape(-1, 2).T
        return ("controlsTrafficOf", signal, FIRST_LANE + lane)


def read_signals(
    document: Document, plan: PlanView, network: Network, signs: Mapping[str, str]
) -> Signals:
    """The signals of a map; one whose place is broken is left out with a warning.

    ``signs``: type codes in lower case, and the kinds that the client says they are.
    """
    reach = _Reach(document, network)
    parts = (_elements(document, plan, reach, signs), _signal_objects(document, plan, reach))
    return Signals(
        MapNodes.joined([part.nodes for part in parts]),
        [s for p in parts for s in p.lanes],
        parts[0].told,
    )


def read_controllers(document: Document) -> dict[str, tuple[str, ...]]:
    """Id of each controller → ids of the signals that switch together."""
    table = document["controller/control"]
    names = document["controller"].texts("id")
    members: dict[str, list[str]] = {}
    for row, signal in zip(table.parent, table.texts("signalId"), strict=True):
        members.setdefault(names[row], []).append(signal)
    return {name: tuple(dict.fromkeys(signals)) for name, signals in members.items()}


def is_signal_object(name: str) -> bool:
    """Whether an object of this name is a signal in truth."""
    return bool(_SPEED_OBJECT.match(name)) or _STOP_STENCIL in name.lower()


def kind_of_signal(code: str, *, dynamic: bool, name: str = "") -> str:
    """The kind of a signal with this type code; ``sign`` for whatever is none of the others."""
    if _LIGHT.match(code) and code not in _NOT_LIGHTS:
        return "traffic_light"
    if code in KIND_OF_TYPE:
        return KIND_OF_TYPE[code]
    if dynamic and "light" in name.lower():
        return "traffic_light"
    return "sign"


class _Reach:
    """Which driving lanes lie at a place of a road, by their ids or their direction."""

    def __init__(self, document: Document, network: Network) -> None:
        self.warnings = network.warnings
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
        # Many signals apply to the same lanes: what was found once is found again.
        self._known: dict[tuple[int, object], frozenset[int]] = {}

    def valid(
        self, kind: str, row: int, place: tuple[int, float], orientation: str
    ) -> frozenset[int]:
        """The driving lanes at a place (road, s) that an element is valid for."""
        ranges = self._ranges[kind].get(row)
        section = self._network.section_at(*place)
        key = (section, orientation if ranges is None else tuple(ranges))
        if key not in self._known:
            lanes = self._driving.get(section, [])
            self._known[key] = frozenset(
                lane
                for lane, ident in lanes
                if (
                    self._runs(lane, orientation)
                    if ranges is None
                    else any(low <= ident <= high for low, high in ranges)
                )
            )
        return self._known[key]

    def on_side(self, place: tuple[int, float], *, left: bool) -> frozenset[int]:
        """The driving lanes at a place (road, s) to the left or to the right of the centre lane."""
        lanes = self._driving.get(self._network.section_at(*place), [])
        return frozenset(lane for lane, ident in lanes if (ident > 0) == left)

    def _runs(self, lane: int, orientation: str) -> bool:
        """Whether traffic in a lane runs in the direction of an orientation."""
        lanes = self._network.lanes
        either = orientation not in {"+", "-"} or lanes.both[lane]
        return bool(either or lanes.forward[lane] == (orientation == "+"))


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
    referred = _referred(document, reach)
    lanes = [
        reach.valid(kind, row, (int(road[row]), float(s[row])), a.get("orientation", ""))
        | referred.get(name, frozenset())
        for row, name, a in zip(rows.tolist(), ids, attributes, strict=True)
    ]
    columns = node_columns(document, plan, kind, rows)
    nodes = MapNodes.of(kinds, ids, speed_limit=np.array(limits), **columns)
    return Signals(nodes, lanes, repr(told) if told else "")


def _referred(document: Document, reach: _Reach) -> dict[str, frozenset[int]]:
    """Id of a signal → lanes that references to it, anywhere in the map, make it apply to."""
    kind = "road/signalReference"
    table = document[kind]
    s = document.rough_numbers(kind, "s")
    found: dict[str, set[frozenset[int]]] = {}
    for row in np.flatnonzero(np.isfinite(s)).tolist():
        attributes = table.attributes[row]
        place = (int(table.road[row]), float(s[row]))
        lanes = reach.valid(kind, row, place, attributes.get("orientation", ""))
        found.setdefault(attributes.get("id", ""), set()).add(lanes)
    return {name: frozenset[int]().union(*parts) for name, parts in found.items()}


def _limit(attributes: dict[str, str]) -> float:
    """Speed limit of a sign; without a unit, km/h, or mph for the United States' own codes."""
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
    lanes: list[frozenset[int]] = []
    s = document.rough_numbers(kind, "s")
    for row in rows.tolist():
        attributes = table.attributes[row]
        limit = _SPEED_OBJECT.match(attributes.get("name", ""))
        kinds.append("speed_limit" if limit else "stop_sign")
        limits.append(speed(limit[1], "km/h") if limit else np.nan)
        left = attributes.get("orientation", "") == "+"
        place = (int(table.road[row]), float(s[row]))
        lanes.append(reach.on_side(place, left=left))
    ids = [table.attributes[row].get("id", "") for row in rows.tolist()]
    columns = node_columns(document, plan, kind, rows)
    return Signals(MapNodes.of(kinds, ids, speed_limit=np.array(limits), **columns), lanes)
