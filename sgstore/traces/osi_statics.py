"""What stands still in an OSI recording: stationary objects and traffic signs, wherever they are told.

Producers tell them once, with the first message, or in every one, or as the ego comes near. What stands, stood
there before it was told: so all of them are gathered before frames are read, and hold for the whole trace.

Source: open-simulation-interface 3.8.0 (osi_object.proto, osi_trafficsign.proto).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

from sgstore.opendrive.objects import kind_of_object
from sgstore.traces.osi_lanes import OWN, LaneSignal
from sgstore.traces.osi_schema import (
    DECODE_ERRORS,
    assigned_lanes,
    enum_name,
    has_field,
    map_ref,
    static_pose,
)
from sgstore.vocabulary import ENTITY_KINDS, SIGNALS, TypeMeaning, type_meanings

if TYPE_CHECKING:
    from sgstore.traces.frames import Roster

_FIELDS: Final = {
    "stationary_object": ("stationary", "unknown"),
    "traffic_sign": ("sign", "sign"),
}
"""Fields of a ground truth → prefix of their types in ``vocabulary.toml``, kind of what that does not map."""
UNTOLD: Final = frozenset({"TYPE_UNKNOWN", "TYPE_OTHER"})
_UNITS: Final = {"UNIT_MILE_PER_HOUR": " mph"}
"""What is said behind the value of a speed limit, by its unit; km/h go without saying."""
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
    """The static things of a recording, in the order in which they were told.

    Attributes
    ----------
    unplaced : dict
        What has no usable pose or cannot be read, in words → log time at which it was told.
    """

    unplaced: dict[str, int] = field(default_factory=dict[str, int])
    _found: dict[tuple[str, int], _Static] = field(default_factory=dict)  # pyright: ignore[reportUnknownVariableType]

    def look(self, ground: Any, fields: tuple[str, ...], log_time_ns: int) -> None:
        """Take note of what a ground truth tells; ``fields``: those that its class has."""
        for name in fields:
            if name not in _FIELDS:
                continue
            for thing in getattr(ground, name):
                key = (name, thing.id.value)
                if key in self._found:
                    continue
                try:
                    self._take(key, thing, log_time_ns)
                except DECODE_ERRORS as error:
                    words = f"{name.replace('_', ' ')} {key[1]} cannot be read ({error})"
                    self.unplaced.setdefault(words, log_time_ns)

    def enter(self, roster: Roster, map_text: str) -> None:
        """Enter them all. Objects of the map whose kind is not told are what the map says that they are."""
        kinds: dict[str, str] | None = None
        for thing in self._found.values():
            meaning = thing.meaning
            if meaning.kind == "unknown" and not meaning.subkind and thing.map_ref:
                kinds = kinds_of_map(map_text) if kinds is None else kinds
                kind = kinds.get(thing.map_ref, "unknown")
                # What only a map has, such as paint on the road, is a thing like any other here.
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
        """The signs that are assigned to lanes."""
        return [
            LaneSignal(thing.map_ref, thing.meaning.kind, thing.pose, thing.lanes)
            for thing in self._found.values()
            if thing.lanes
        ]


def _with_value(meaning: TypeMeaning, classification: Any) -> TypeMeaning:
    """A speed limit whose subkind ends with its value: ``50``, ``zone 30``, ``35 mph``."""
    if not has_field(type(classification), "value.value") or not classification.value.value > 0:
        return meaning
    value = classification.value
    unit = enum_name(value, "value_unit") if has_field(type(value), "value_unit") else ""
    words = [meaning.subkind, f"{value.value:g}{_UNITS.get(unit, '')}"]
    return replace(meaning, subkind=" ".join(word for word in words if word))


@lru_cache(maxsize=1)  # a recording is read twice and more
def kinds_of_map(text: str) -> dict[str, str]:
    """Id of each object in an OpenDRIVE text → its kind."""
    kinds: dict[str, str] = {}
    for match in _MAP_OBJECT.finditer(text):
        told = {name: a or b for name, a, b in _MAP_ATTRIBUTE.findall(match[1])}
        if "id" in told:
            kinds[told["id"]] = kind_of_object(told.get("type", ""), told.get("name", ""))
    return kinds
