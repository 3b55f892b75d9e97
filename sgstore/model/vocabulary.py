"""Catalogue of names: kinds of objects and map parts, relations, and traffic light states.

A *kind* is the type of an entity or a map element; a *relation* is the name of an edge. Readers, settings,
imports and stores can add kinds of entities, relations and light states (:func:`add_kind`,
:func:`add_relation`, :func:`add_light_state`). The *code* of a name is its index and does not change. The file
``vocabulary.toml`` maps simulator type names to kinds. A type without a mapping becomes ``unknown``.

Names are compared without regard to case and underscores (``TrafficLight`` is ``traffic_light``);
the canonical spelling is stored and printed.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from importlib import resources
from threading import Lock
from typing import TYPE_CHECKING, Final

from sgstore.base import plugins

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

VEHICLES: Final = (
    *("car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer", "train"),
    "vehicle",
)
SIGNALS: Final = ("traffic_light", "stop_sign", "yield_sign", "speed_limit", "sign")

OWN_ENTITY_KINDS: Final = (
    *(*VEHICLES, "person", "animal", *SIGNALS),
    *("prop", "building", "pole", "barrier", "vegetation", "unknown"),
)
"""Built-in kinds of entities, which have a pose and usually a box. ``vehicle``: vehicle of unknown type."""

MAP_KINDS: Final = ("lane", "road", "junction", "crosswalk", "off_road", "waypoint", "roundabout")
"""Kinds of map elements. ``off_road`` is a single node for everything outside driving lanes."""

EVENT_KINDS: Final = {"collision": 2, "lane_invasion": 1, "environment": 0}
"""Kinds of recorded events, with the number of involved entities. Environment means weather and light."""

OWN_KINDS: Final = OWN_ENTITY_KINDS + MAP_KINDS
"""Built-in kinds: entities first, then map elements."""

_entity_kinds: Final[list[str]] = list(OWN_ENTITY_KINDS)
ENTITY_KINDS: Final[Sequence[str]] = _entity_kinds
"""All registered kinds of entities; see :func:`add_kind`."""

_kinds: Final[list[str]] = list(OWN_KINDS)
KINDS: Final[Sequence[str]] = _kinds
"""All registered kinds, built-in kinds first. New kinds are appended."""

SUPER_KINDS: Final[Mapping[str, Sequence[str]]] = {
    "vehicle": VEHICLES,
    "two_wheeler": ("motorcycle", "bicycle"),
    "vru": ("person", "bicycle", "motorcycle"),
    "signal": SIGNALS,
    "entity": ENTITY_KINDS,
}
"""Labels of several kinds. ``vru``: vulnerable road users.

The label ``Vehicle`` means every vehicle; the kind ``vehicle`` means a vehicle of unknown type.
"""

SIDES: Final = ("toLeftOf", "toRightOf")

LABEL_ALIASES: Final[Mapping[str, str]] = {"pedestrian": "person", "walker": "person"}
"""Synonyms of kinds from Scenic, CARLA and nuScenes."""

OWN_RELATIONS: Final = tuple(plugins.RELATIONS.own)
"""Built-in relations."""


def _declared_in(file: str) -> tuple[str, ...]:
    places = plugins.RELATIONS.own.items()
    return tuple(
        name for name, place in places if place.startswith(f"sgstore.graphs.relations.{file}:")
    )


PROXIMITY: Final = _declared_in("_proximity")
"""Usual names of distance relations, from near to far."""

DIRECTIONS: Final = tuple(name for name in _declared_in("_bearing") if name not in SIDES)
"""Usual names of direction relations, from ahead to behind."""

BEYOND: Final = ("isIn", "controlsTrafficOf", "leads", "follows")
"""Relations between entities that are also stored for entities outside the graphs."""

MAP_ONLY: Final = _declared_in("_map")
"""Relations between map elements only. They belong to the map, and settings cannot exclude them."""

_BETWEEN_ENTITIES: Final = (("entity", "entity"),)
_BETWEEN_LANES: Final = (("lane", "lane"),)
RELATION_ENDS: Final[Mapping[str, Sequence[tuple[str, str]]]] = {
    "isIn": (
        ("body", "lane|crosswalk|off_road|waypoint"),
        ("lane", "road"),
        ("road", "junction|roundabout"),
        ("waypoint", "lane"),
    ),
    "travelsTo": (*_BETWEEN_LANES, ("waypoint", "waypoint")),
    **dict.fromkeys(("laneChange", "opposes", "conflictsWith"), _BETWEEN_LANES),
    **dict.fromkeys(SIDES, _BETWEEN_ENTITIES + _BETWEEN_LANES),
    **dict.fromkeys(("controlsTrafficOf", "mayAffect"), (("signal", "lane"),)),
    **dict.fromkeys((*PROXIMITY, *DIRECTIONS, "overlaps", "sees"), _BETWEEN_ENTITIES),
    **dict.fromkeys(("leads", "follows", "tows"), (("vehicle", "vehicle"),)),
}
"""Built-in relation → pairs of source and target. A *body* is an entity that is not a signal.

Only recordings have these ends. Imported graphs may have others.
"""

_relations: Final = list(OWN_RELATIONS)
RELATIONS: Final[Sequence[str]] = _relations
"""All registered relations. New relations are appended; see :func:`add_relation`."""

RELATION_ALIASES: Final[Mapping[str, str]] = {
    "collides": "overlaps",
    "safe_hazard": "safety_hazard",
}
"""Synonyms of relations. CARLASGG's documentation and SceneFlow use ``safe_hazard``."""

LANE_TYPES: Final = (
    *("none", "driving", "stop", "shoulder", "biking", "sidewalk", "walking", "border"),
    *("restricted", "parking", "bidirectional", "median", "special1", "special2", "special3"),
    *("roadWorks", "tram", "rail", "entry", "exit", "offRamp", "onRamp", "connectingRamp"),
    *("slipLane", "bus", "taxi", "HOV", "mwyEntry", "mwyExit", "curb", "shared", "roadMarks"),
)
"""Types of lanes, as in ASAM OpenDRIVE 1.4 to 1.8 (``e_laneType``)."""

DRIVING: Final = frozenset(
    {"driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane"}
    | {"bus", "taxi", "HOV", "mwyEntry", "mwyExit"}
)
"""Types of lanes for motor traffic, as in ASAM OpenDRIVE 1.4 to 1.8."""

NOT_FOR_MOTOR_TRAFFIC: Final = frozenset({"pedestrian", "bicycle"})
"""Subkinds of traffic lights that control no lane for motor traffic, even if a file assigns one to them."""

TRAFFIC: Final = DRIVING | {"biking", "special1", "special2", "special3"}
"""Types of lanes whose direction of travel matters for neighbouring lanes."""

OWN_LIGHT_STATES: Final = ("unknown", "off", "red", "yellow", "green", "red_yellow", "flashing")
"""Built-in traffic light states. ``flashing`` is a flashing lamp of any colour."""

_light_states: Final[list[str]] = list(OWN_LIGHT_STATES)
LIGHT_STATES: Final[Sequence[str]] = _light_states
"""All registered traffic light states; see :func:`add_light_state`."""

SPECIALS: Final = ("emergency", "taxi", "electric", "public_transport", "service")
"""Special roles of an entity: CARLASGG's ``special_type`` and OSI's vehicle roles."""

CONTROL: Final = "control_"
"""Prefix for attributes of commanded control inputs: ``control_steer``. The applied input is ``steer``."""

NOISE_MARKS: Final = ("stands", "unreal_accel", "unreal_yaw_rate")
"""Attributes of bodies only in recordings with noise, in order of their bits after ``derived_yaw_rate``."""

VEHICLE_LIGHTS: Final = (
    *("light_left", "light_right", "light_brake", "light_reverse", "light_position"),
    *("light_low_beam", "light_high_beam", "light_fog", "light_interior"),
    *("light_special1", "light_special2"),
)
"""Lights of a vehicle by their bit in a mask. Hazard lights are the left and the right light together."""

_kind_code: Final = {name: code for code, name in enumerate(KINDS)}
KIND_CODE: Final[Mapping[str, int]] = _kind_code
_relation_code: Final = {name: code for code, name in enumerate(RELATIONS)}
RELATION_CODE: Final[Mapping[str, int]] = _relation_code
_light_state_code: Final = {name: code for code, name in enumerate(LIGHT_STATES)}
LIGHT_STATE_CODE: Final[Mapping[str, int]] = _light_state_code


def normalize_name(name: str) -> str:
    """Return a name in lower case without underscores, for comparison with others."""
    return name.replace("_", "").lower()


_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
_growing: Final = Lock()

MOST_RELATIONS: Final = 63
"""Largest number of relations in a process, because a set of relations is a 64-bit number."""

MOST_KINDS: Final = 127
"""Largest number of kinds, and of light states, in a process, because a code is an 8-bit number."""

_OWN_RELATIONS_FOLDED: Final[Mapping[str, str]] = {
    normalize_name(name): name for name in OWN_RELATIONS
} | {normalize_name(alias): name for alias, name in RELATION_ALIASES.items()}
_OWN_LABELS_FOLDED: Final[Mapping[str, Sequence[str]]] = {
    **{normalize_name(name): (name,) for name in OWN_KINDS},
    **{normalize_name(name): kinds for name, kinds in SUPER_KINDS.items()},
    **{normalize_name(alias): (name,) for alias, name in LABEL_ALIASES.items()},
}
_OWN_FOLDED: Final[Mapping[str, Mapping[str, str]]] = {
    "kind": {normalize_name(name): name for name in OWN_KINDS},
    "relation": _OWN_RELATIONS_FOLDED,
    "light_state": {normalize_name(name): name for name in OWN_LIGHT_STATES},
}

# Codes belong to the process, but names have a scope. A name from a store is valid only for queries on that
# store. Built-in names, and names registered by plugins, settings, readers and imports, are always valid.

NAMES: Final[Mapping[str, Sequence[str]]] = {
    "kind": KINDS,
    "relation": RELATIONS,
    "light_state": LIGHT_STATES,
}
"""Enumerations of a store: type name → registered values in code order."""

_OWN: Final = {
    "kind": OWN_KINDS,
    "relation": OWN_RELATIONS,
    "light_state": OWN_LIGHT_STATES,
}
_CODES: Final = {
    "kind": (_kinds, _kind_code, MOST_KINDS, "kinds"),
    "relation": (_relations, _relation_code, MOST_RELATIONS, "relations"),
    "light_state": (_light_states, _light_state_code, MOST_KINDS, "states of lights"),
}
_made_known: Final[dict[tuple[str, str], None]] = {}
_asked: Final[ContextVar[Mapping[str, Sequence[str]] | None]] = ContextVar("asked", default=None)


def learn(enum: str, name: str) -> int:
    """Register a name (kind, relation or light state) that a store contains, and return its code.

    Parameters
    ----------
    enum : str
        One of :data:`NAMES`.
    name : str

    Raises
    ------
    ValueError
        The name is invalid, equals a built-in name except for case and underscores, or there are too many
        names.
    """
    names, codes, most, what = _CODES[enum]
    with _growing:
        if name not in codes:
            _refuse_like_own(enum, name)
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"{name!r} is not a name: letters, digits and _, a letter first, 40 at most"
                )
            if len(names) >= most:
                raise ValueError(f"there are {most} {what}, and no room for {name!r}")
            if enum == "kind":
                _entity_kinds.append(name)
            names.append(name)
            codes[name] = len(names) - 1
        return codes[name]


def add_relation(name: str) -> int:
    """Register a user-defined relation in this process, and return its code.

    Raises
    ------
    ValueError
        The name is invalid, is a label, or equals a built-in relation except for case and underscores; or there
        are too many names.
    """
    return _made("relation", name)


def add_kind(name: str) -> int:
    """Register a user-defined kind of object in this process, and return its code.

    Parameters
    ----------
    name : str
        Lower-case letters, digits and ``_``. In a pattern, ``wheel_chair`` is written ``WheelChair``.

    Raises
    ------
    ValueError
        The name is invalid, is a relation, or equals a built-in label except for case and underscores; or there
        are too many names.
    """
    return _made("kind", name)


def add_light_state(name: str) -> int:
    """Register a user-defined traffic light state in this process, and return its code.

    Raises
    ------
    ValueError
        The name is invalid, or equals a built-in state except for case and underscores; or there are too many
        names.
    """
    return _made("light_state", name)


def _made(enum: str, name: str) -> int:
    code = learn(enum, name)
    if name not in _OWN[enum]:
        _made_known[enum, name] = None
    return code


def _refuse_like_own(enum: str, name: str) -> None:
    """Raise an error if a new name equals a built-in name, apart from case and underscores."""
    folded, like = normalize_name(name), ""
    if enum == "light_state" and folded in _OWN_FOLDED[enum]:
        like = f"the state {_OWN_FOLDED[enum][folded]!r}"
    elif enum != "light_state" and folded in _OWN_RELATIONS_FOLDED:
        like = f"the relation {_OWN_RELATIONS_FOLDED[folded]!r}"
    elif enum != "light_state" and (folded == "ego" or folded in _OWN_LABELS_FOLDED):
        like = f"the label {name!r}"
    if like:
        raise ValueError(f"{name!r} could be confused with {like}")


@contextmanager
def asking(names: Mapping[str, Sequence[str]] | None) -> Generator[None]:
    """Context manager: only built-in names and the names of one store are valid inside the block.

    Parameters
    ----------
    names : mapping or None
        Enumeration → values that the store adds to the built-in values. ``None`` means the values of all stores
        opened in this process.
    """
    before = _asked.set(names)
    try:
        yield
    finally:
        _asked.reset(before)


def known_names(enum: str) -> tuple[str, ...]:
    """Return all valid names of a sort (kinds, relations or light states), built-in names first."""
    return (*_OWN[enum], *_others(enum))


def _others(enum: str) -> Sequence[str]:
    """Return all valid names that are not built in. Those of the queried store come first."""
    asked = _asked.get()
    if asked is None:
        return NAMES[enum][len(_OWN[enum]) :]
    everybody = (name for what, name in _made_known if what == enum)
    return tuple(dict.fromkeys((*asked.get(enum, ()), *everybody)))


def _meant(enum: str, word: str) -> str | None:
    """Return the valid name for a word in a query, whatever its case and underscores; otherwise ``None``."""
    others, folded = _others(enum), normalize_name(word)
    if word in others:
        return word
    if folded in _OWN_FOLDED[enum]:
        return _OWN_FOLDED[enum][folded]
    alike = [name for name in others if normalize_name(name) == folded]
    return next((name for name in alike if _camel(name) == word), alike[0] if alike else None)


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def entity_kinds() -> frozenset[str]:
    """Return all known kinds of objects (such as car or pedestrian), without map parts."""
    return frozenset(_entity_kinds)


_MAPPED: Final = range(len(OWN_ENTITY_KINDS), len(OWN_KINDS))


def are_entities(codes: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return a mask of the kind codes of objects. Other codes are kinds of map parts."""
    return (codes < _MAPPED.start) | (codes >= _MAPPED.stop)


@cache
def _add_plugins() -> None:
    for name in plugins.RELATIONS.others():
        with suppress(ValueError):  # the relation generator raises the error
            add_relation(name)


def relation_named(name: str) -> str | None:
    """Return the name of a relation for a word in a query; ``None`` if unknown."""
    found = _meant("relation", name)
    if found is None:
        _add_plugins()  # the search takes time
        found = _meant("relation", name)
    return found


def kinds_labelled(label: str) -> tuple[str, ...] | None:
    """Return the kinds that a label (such as ``Vehicle``) covers; ``None`` if the label is unknown.

    ``Ego`` is not a label of kinds.
    """
    own = _OWN_LABELS_FOLDED.get(normalize_name(label))
    if own is not None and label not in _others("kind"):
        return tuple(own)
    kind = _meant("kind", label)
    return None if kind is None else (kind,)


def kind_named(word: str) -> str | None:
    """Return the kind for a word or its synonym; ``None`` if the word is unknown or ambiguous.

    ``vehicle`` means the kind of that name here, although the label covers all vehicle kinds.
    """
    exact = _meant("kind", word)
    if exact is not None:
        return exact
    kinds = kinds_labelled(word) or ()
    return kinds[0] if len(kinds) == 1 else None


def vague_kind(type_name: str) -> str:
    """Return the kind of a type name that has no known meaning: ``vehicle`` or ``unknown``.

    OSI uses ``TYPE_VEHICLE``; names of CARLA and nuScenes begin with ``vehicle.``.
    """
    word = type_name.lower()
    says_vehicle = word == "type_vehicle" or word.partition(".")[0] == "vehicle"
    return "vehicle" if says_vehicle else "unknown"


def labels() -> tuple[str, ...]:
    """Return all node labels for query patterns in CamelCase, ``Ego`` first."""
    names = dict.fromkeys((*known_names("kind"), *SUPER_KINDS, *LABEL_ALIASES))
    return ("Ego", *map(_camel, names))


def natural(name: str) -> tuple[tuple[tuple[int, str], ...], str]:
    """Return a sort key for trace names that puts ``run2`` before ``run10``.

    Digits compare as numbers, letters without case. The characters decide between names that are still equal.
    """
    parts = re.split(r"(\d+)", name)
    told = (p.lstrip("0") if place % 2 else p.casefold() for place, p in enumerate(parts))
    keyed = tuple((len(p) if place % 2 else 0, p) for place, p in enumerate(told))
    return keyed, name


def suggestion(name: str, known: Iterable[str], alike: float = 0.6) -> str | None:
    """Return the known name most similar to a given name; ``None`` if no name is similar.

    ``None`` means no similarity of at least ``alike`` (0 to 1).
    """
    by_folded: dict[str, list[str]] = {}
    for candidate in known:
        by_folded.setdefault(normalize_name(candidate), []).append(candidate)
    close = difflib.get_close_matches(normalize_name(name), by_folded, n=1, cutoff=alike)
    if not close:
        return None
    same = by_folded[close[0]]  # such as cut_in and CutIn
    return max(same, key=lambda one: difflib.SequenceMatcher(None, name, one).ratio())


@dataclass(frozen=True, slots=True)
class TypeMeaning:
    """Meaning of a simulator's type name: kind, subkind and special role of an object.

    Attributes
    ----------
    kind : str
        One of :data:`ENTITY_KINDS`.
    special : str
        One of :data:`SPECIALS`, or the empty string.
    subkind : str
        Subtype of a prop or unknown object (``cone``, ``traffic_warning``), or an empty string.
    """

    kind: str
    special: str = ""
    subkind: str = ""


@cache
def type_meanings() -> Mapping[str, TypeMeaning]:
    """Return the built-in meanings of simulator type names: type name in lower case → meaning."""
    text = resources.files("sgstore.model").joinpath("vocabulary.toml").read_text(encoding="utf-8")
    return {
        name.lower(): TypeMeaning(**meaning)
        for table in tomllib.loads(text).values()
        for name, meaning in table.items()
    }
