"""Traffic lights of OSI: bulbs, which are what OSI has, gathered into heads, which are what people see.

OSI writes one ``TrafficLight`` message for each bulb. Bulbs belong to one head if they refer to the
same OpenDRIVE signal, or else stand one above another: the same place in the plane and the same
direction, to a centimetre. A head shows what its lit bulbs show, and goes on showing it while frames
say nothing of it.

Source: open-simulation-interface 3.8.0, osi_trafficlight.proto (the numbers of colours and modes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.readers._base import FAR, NAN
from sgstore.readers.osi._lanes import OWN, LaneSignal
from sgstore.readers.osi._schema import (
    DECODE_ERRORS,
    assigned_lanes,
    enum_name,
    has_field,
    lights_of,
    map_ref,
    static_pose,
)
from sgstore.vocabulary import LIGHT_STATE_CODE, TypeMeaning
from sgstore.world import POSE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.readers._base import EntityTable
    from sgstore.world import Floats, Ints


SAME_PLACE: Final = 0.01
"""Greatest distance, in each axis, and greatest turn between the bulbs of one head; m, rad."""

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
    """State of a bulb as a bit, by the numbers of its mode and colour; 0 if it is off."""
    if mode == _MODE_OFF:
        return 0
    if mode == _MODE_FLASHING:
        return _FLASHING
    return _COLOUR.get(colour, _OTHER) if mode in {_MODE_CONSTANT, _MODE_COUNTING} else _OTHER


def shown(bulbs: Iterable[int]) -> int:
    """Code of :data:`sgstore.vocabulary.LIGHT_STATES` that lit bulbs make together.

    Flashing wins over all; red with yellow is ``red_yellow``; of other colours that are lit together the
    most restrictive one counts (a red light with a green arrow is red). Nothing lit is ``off``.
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
        """Grow to hold another bulb."""
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
    """The traffic lights of a trace.

    Parameters
    ----------
    roster : EntityTable
        Takes up each head as an entity of kind ``traffic_light``; its ident is the id of its first bulb.
    message : type or None
        Class of the bulbs; ``None``: the recording's version of OSI has none that could be read.
    names : mapping, optional
        First bulb of a head that refers to no map → name of the signal that it is in the map of the lanes.

    Attributes
    ----------
    unreadable : int
        Bulbs that are malformed.
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
        """Heads that have neither a position nor a reference to the map."""
        return len(self._heads) - len(self._rows[0])

    def update(self, ground: Any) -> None:
        """Take up what a ground truth says of bulbs; of the others the last word stands."""
        words = lights_of(ground)
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
        except DECODE_ERRORS:  # whatever else is in the message is read all the same
            self.unreadable += 1
            return
        head.bulbs[bulb.id.value] = self._lit(bulb.classification)

    def signals(self) -> dict[int, LaneSignal]:
        """First bulb of each head that is assigned to lanes → the signal that it is."""
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
        """Rows of the heads that have a place: node ids, columns :data:`POSE`, states."""
        return self._rows

    def _fill(self) -> None:
        placed = [head for head in self._heads if head.map_ref or not math.isnan(head.pose[0])]
        self._rows = (
            np.array([head.node for head in placed], np.int64),
            np.array([head.pose for head in placed], np.float64).reshape(-1, len(POSE)),
            np.array([shown(head.bulbs.values()) for head in placed], np.int64),
        )

    def _lit(self, classification: Any) -> int:
        out = self._has_service and classification.is_out_of_service
        return 0 if out else lit(classification.mode, classification.color)

    def _enter(self, bulb: Any) -> _Head:
        """The head that a bulb belongs to, which may be a new one."""
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
        """The head at the place of a pose, if there is one."""
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
