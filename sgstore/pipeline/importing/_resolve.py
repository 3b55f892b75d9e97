"""Conversion of the labels, relations and attributes of imported graphs to those of sgstore.

Graphs before the resolution: names, labels and rows as in the file.
"""

from __future__ import annotations

import math
import re
from array import array
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError, TraceError
from sgstore.model.vocabulary import (
    ENTITY_KINDS,
    KINDS,
    LANE_TYPES,
    LIGHT_STATE_CODE,
    MAP_KINDS,
    RELATION_CODE,
    RELATIONS,
    VEHICLE_LIGHTS,
    add_kind,
    add_light_state,
    add_relation,
    kind_named,
    kinds_labelled,
    labels,
    normalize_name,
    relation_named,
    suggestion,
    type_meanings,
    vague_kind,
)
from sgstore.model.world import HIGHEST_GEAR, INPUTS, POSE, is_plausible, without_implausible

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray


MAX_NODES: Final = 200_000
MAX_EDGES: Final = 1_000_000
MAX_NAMES: Final = 32 << 20
"""Maximum number of nodes, edges and characters of names in a graph, to limit the memory."""

LONGEST: Final = 1_000
"""Maximum length of a name; characters."""

NO_ATTRIBUTES: Final[Mapping[str, Any]] = MappingProxyType({})


@dataclass(slots=True)
class GivenNode:
    """Node of an imported graph, with its label and attributes as in the file.

    Attributes
    ----------
    name : str
        Unique in its graph. In another graph of the file, the same name is the same object.
    label : str
        Label in the file; empty if the name contains it (``car_3``, ``Ego Lane``).
    where : str
        Place in the file, for messages: ``row 17, column node1``.
    attributes : dict
    static : bool
        True if the node never moves; its pose is then read once.
    """

    name: str
    label: str
    where: str
    attributes: dict[str, Any] = field(default_factory=dict[str, Any])
    static: bool = False


@dataclass(slots=True)
class GivenEdge:
    """Edge of an imported graph between two named nodes, as in the file.

    To save memory, its place is stored as a number and a text that similar edges share.
    """

    src: str
    relation: str
    dst: str
    place: str
    number: int
    attributes: Mapping[str, Any]

    @property
    def where(self) -> str:
        """Place of an edge in its file, as text for error messages."""
        return self.place.replace("{}", str(self.number), 1)


@dataclass(slots=True)
class GivenGraph:
    """Imported graph of a file: name, time, nodes and edges. It will be one frame of a trace.

    Attributes
    ----------
    name : str
        Name in the file: an image, a number. Unique in its file.
    place : int
        Number of its first row or line, from 1.
    nodes : dict
        By name.
    edges : list of GivenEdge
    time_ns : int or None
        Time of the graph; ns. ``None`` means that the file has no time for it.
    images : int
        Number of source frames that it represents: S3C stores one graph for each class.
    lost : dict
        Number of losses by description.
    characters : int
        Total number of characters in its names.
    """

    name: str
    place: int
    nodes: dict[str, GivenNode] = field(default_factory=dict[str, GivenNode])
    edges: list[GivenEdge] = field(default_factory=list[GivenEdge])
    time_ns: int | None = None
    images: int = 1
    lost: dict[str, int] = field(default_factory=dict[str, int])
    characters: int = 0


def check_size(path: Path, where: str, graph: GivenGraph) -> None:
    """Raise an error if an imported graph has too many nodes or edges, or too long names.

    Raises
    ------
    TraceError
        The graph has too many nodes, edges or characters of names.
    """
    for number, most, what in (
        (len(graph.nodes), MAX_NODES, "nodes"),
        (len(graph.edges), MAX_EDGES, "edges"),
        (graph.characters, MAX_NAMES, "characters of names"),
    ):
        if number > most:
            raise wrong(path, where, f"more than {most:,} {what} in graph {graph.name!r}")


def wrong(path: Path, where: str, reason: str) -> TraceError:
    """Return an error with a reason, and with the place in the imported file."""
    return TraceError(f"{where}: {reason}" if where else reason, path=path)


# Labels and relations of other tools, mapped to the vocabulary.

EGOS: Final = frozenset({"ego", "egocar", "egovehicle", "hero"})
"""Labels of the ego in S3C, RoadScene2Vec and CARLA, normalised. By default, the ego is a car."""

_PARTS: Final = (
    ("off_road", re.compile(r"off[ _]?road", re.IGNORECASE)),
    (
        "lane",
        re.compile(
            r"ego lane|(left|right) \d+ of ego lane|opposing lane( \d+)?|(left|middle|right) lane"
            r"|lane_(left|middle|right)|lane( .+)?",
            re.IGNORECASE,
        ),
    ),
    ("road", re.compile(r"(root )?road( .+)?", re.IGNORECASE)),
    ("roundabout", re.compile(r"roundabout( .+)?", re.IGNORECASE)),
    ("junction", re.compile(r"(junction|intersection)( .+)?", re.IGNORECASE)),
    ("crosswalk", re.compile(r"crosswalk( .+)?", re.IGNORECASE)),
)
"""Kind of a map part, and regular expression of its names in S3C, CARLASGG and RoadScene2Vec."""

_SHORT: Final = {
    "moto": "motorcycle",
    "motorbike": "motorcycle",
    "bike": "bicycle",
    "cyclist": "bicycle",
    "ped": "person",
    "light": "traffic_light",
    "trafficsignal": "traffic_light",
    "stopsign": "stop_sign",
    "tree": "vegetation",
}
"""Names of kinds in RoadScene2Vec and Scenic → kind of sgstore."""

_NUMBERED: Final = re.compile(r"(.+?)[_ ](\d+)")
"""Regular expression of a label with a number, such as ``car_3`` or ``car 3``."""

OTHER: Final = "other"
"""Value of the option ``unknown_as`` that turns unknown labels into the kind ``unknown``."""

OWN: Final = "own"
"""Value of the option ``unknown_as`` that turns unknown labels and relations into new kinds and relations."""


@dataclass(frozen=True, slots=True)
class LabelMeaning:
    """Meaning of a node label in an imported file: kind, subkind and other properties of the node.

    Attributes
    ----------
    kind : str
    is_ego : bool
    type_name : str
        The file's own label, if it is more specific than the kind.
    special, subkind : str
    """

    kind: str
    is_ego: bool = False
    type_name: str = ""
    special: str = ""
    subkind: str = ""


@dataclass(frozen=True)
class Words:
    """Mapping from the labels and relation names of imported files to kinds and relations of sgstore.

    Parameters
    ----------
    kinds : mapping
        Label → kind. It takes precedence over all other rules.
    relations : mapping
        Relation of the file → relation of the vocabulary.
    unknown_as : str
        Kind for unknown labels: any kind of an entity, or ``other``, which is ``unknown``. Unknown relations
        are then dropped and counted. ``own``: unknown labels become new kinds, and unknown names new relations,
        up to the limit of a process; the rest is treated as ``other``. Empty: unknown labels and relations are
        errors.
    new_kinds : sequence of str
        Additional kinds of entities, which ``kinds`` may contain.

    Raises
    ------
    ConfigError
        A given kind or relation does not exist.
    """

    kinds: Mapping[str, str] = field(default_factory=dict[str, str])
    relations: Mapping[str, str] = field(default_factory=dict[str, str])
    unknown_as: str = ""
    new_kinds: Sequence[str] = ()

    def __post_init__(self) -> None:
        for kind in self.new_kinds:
            try:
                add_kind(kind)
            except ValueError as error:
                raise ConfigError(f"--new-kind {kind}: {error}") from None
        for label, kind in self.kinds.items():
            if not _kind(kind):
                raise ConfigError(_no_kind(f"--kind {label}={kind}", kind))
        for name, relation in self.relations.items():
            if relation_named(relation) is None:
                like = suggestion(relation, RELATIONS)
                hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(RELATIONS)}"
                raise ConfigError(f"--relation {name}={relation}: unknown relation; {hint}")
        if self.unknown_as and self._fallback not in ENTITY_KINDS:
            raise ConfigError(_no_kind(f"--unknown-as {self.unknown_as}", self.unknown_as))

    @property
    def _fallback(self) -> str:
        known = "unknown" if self.unknown_as in {OTHER, OWN} else _kind(self.unknown_as)
        return known or ""

    def meaning(self, name: str, label: str) -> LabelMeaning | None:
        """Return sgstore's node kind for a node label in a file; ``None`` if the label is unknown."""
        for text in dict.fromkeys((label, name) if label else (name, _plain(name))):
            found = self._meant(text)
            if found is not None:
                return found
        if not self.unknown_as:
            return None
        own = label or _plain(name)
        if self.unknown_as == OWN and (kind := _own_kind(own)):
            return LabelMeaning(kind, type_name=own)
        return LabelMeaning(self._fallback, type_name=own, subkind=own)

    def _meant(self, text: str) -> LabelMeaning | None:
        given = {normalize_name(label): kind for label, kind in self.kinds.items()}
        if normalize_name(text) in given:
            return LabelMeaning(_kind(given[normalize_name(text)]), type_name=text)
        if normalize_name(text) in EGOS:
            return LabelMeaning("car", is_ego=True)
        for kind, form in _PARTS:
            if form.fullmatch(text):
                return LabelMeaning(kind)
        if kind := _kind(text):
            return LabelMeaning(kind)
        return _simulators(text)

    def relation(self, name: str) -> str | None:
        """Return sgstore's relation for a relation name in a file; ``None`` if the name is unknown."""
        given = {normalize_name(own): relation for own, relation in self.relations.items()}
        known = relation_named(given.get(normalize_name(name), name))
        return _own_relation(name) if known is None and self.unknown_as == OWN else known

    def why_not_kind(self, name: str, label: str) -> str:
        """Return the error text for an unknown node label in a file, with the remedies."""
        text = label or _plain(name)
        several = kinds_labelled(text)
        known = [*labels(), *_SHORT]
        like = suggestion(text, known)
        hint = f" (did you mean {like!r}?)" if like else ""
        if several:
            hint = f" (it can be any of {', '.join(several)})"
        return (
            f"{text!r} is an unknown kind{hint}; map it with --kind {text!r}=KIND,"
            " --unknown-as own if its name is a kind of its own, or --unknown-as other for all such"
        )

    def why_not_relation(self, name: str) -> str:
        """Return the error text for an unknown relation name in a file, with the remedies."""
        like = suggestion(name, RELATIONS)
        hint = f" (did you mean {like!r}?)" if like else ""
        return (
            f"{name!r} is an unknown relation{hint}; map it with --relation {name!r}=RELATION,"
            " --unknown-as own to keep its name, or --unknown-as other to leave such edges out"
        )

    def as_dict(self) -> dict[str, object]:
        """Return the mapping of labels and relation names as JSON values, in a fixed order."""
        return {
            "kinds": dict(sorted(self.kinds.items())),
            "relations": dict(sorted(self.relations.items())),
            "unknown_as": self.unknown_as,
            **({"new_kinds": sorted(self.new_kinds)} if self.new_kinds else {}),
        }


def _plain(name: str) -> str:
    """Return a node name without the number at its end, such as ``car`` for ``car_12``."""
    numbered = _NUMBERED.fullmatch(name)
    return numbered[1] if numbered else name


_NO_NAME: Final = re.compile(r"[^A-Za-z0-9]+")


def _own_kind(text: str) -> str:
    """Register a node label as a new kind, and return the kind; empty if the label is not a valid name."""
    name = _NO_NAME.sub("_", text).strip("_").lower()
    known = kind_named(name)
    with suppress(ValueError):
        return known or KINDS[add_kind(name)]
    return ""


def _own_relation(text: str) -> str | None:
    """Register a name as a new relation, and return the relation; ``None`` if the name is not valid."""
    name = _NO_NAME.sub("_", text).strip("_")
    known = relation_named(name)
    with suppress(ValueError):
        return known or RELATIONS[add_relation(name)]
    return None


def _kind(text: str) -> str:
    """Return the kind with a given name; empty if the name is unknown or ambiguous."""
    return kind_named(_SHORT.get(normalize_name(text), text)) or ""


def _simulators(text: str) -> LabelMeaning | None:
    """Return kind and other properties for a simulator's type name, such as ``vehicle.audi.tt``.

    The longest known part before a dot counts. ``None`` means unknown.
    """
    meanings = type_meanings()
    name = text.lower()
    while name:
        if name in meanings:
            found = meanings[name]
            return LabelMeaning(
                found.kind, type_name=text, special=found.special, subkind=found.subkind
            )
        name = name.rpartition(".")[0]
    kind = vague_kind(text)
    return None if kind == "unknown" else LabelMeaning(kind, type_name=text)


def _no_kind(what: str, kind: str) -> str:
    like = suggestion(kind, KINDS)
    hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(KINDS)}"
    return f"{what}: unknown kind; {hint}; --new-kind {kind} adds it as a kind"


# Attributes of nodes and edges in files, converted into columns with internal units.

_RADIANS: Final = frozenset({"heading", "pitch", "roll", "yaw_rate", "heading_error"})
"""Attributes that are in degrees in files, but in radians in columns."""

STATE_NUMBERS: Final = (*POSE, *INPUTS[:3])
_SHIFTED: Final = {"gear": range(-HIGHEST_GEAR, HIGHEST_GEAR + 1), "hand_brake": (False, True)}
"""Columns → valid values. Other values, such as ``"D"``, become user-defined attributes."""
PART_NUMBERS: Final = ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature")
PART_TEXTS: Final = ("lane_type", "road", "junction", "turn")
PART_WHOLE: Final = ("section", "lane")
LANE_NUMBERS: Final = {
    "overlap": "overlap",
    "lane_offset": "offset",
    "offset": "offset",
    "heading_error": "heading_error",
    "along": "along",
}
"""Attributes of an ``isIn`` edge → columns of :class:`sgstore.model.graph.LaneStates`."""

_SAID: Final = frozenset(
    {"kind", "base_class", "label", "name", "ident", "is_ego", "is_static", "id"}
)
"""Names of attributes that are read elsewhere, or that repeat other data."""

_FIXED: Final = frozenset({"speed", "vx", "vy", "vz"})
"""Attributes of static signs and lights in exported graphs that are always zero."""

_FOLLOWING: Final = frozenset({"accel", "node_id"})
"""Names of attributes that follow from other attributes."""

_BITS: Final = {
    "lights": VEHICLE_LIGHTS,
    "derived": ("derived_velocity", "derived_acceleration", "derived_yaw_rate"),
}
"""Columns of bits → the attribute of each bit."""
_TEXTS: Final = frozenset({"special", "subkind", "type_name", "type", "map_ref"})


Own = dict[str, Any]
"""User-defined attributes (without a column) by name."""


def state_of(
    path: Path, where: str, attributes: Mapping[str, Any], lost: dict[str, int], *, any_state: bool
) -> tuple[dict[str, float], Own]:
    """Return an imported entity's state in a frame, and its attributes without a column in the store.

    The columns are those of :class:`sgstore.model.world.States`. With ``any_state``, traffic lights may have
    states outside the vocabulary.

    Raises
    ------
    TraceError
        An attribute has an invalid value.
    """
    found: dict[str, float] = {}
    own: Own = {}
    for name, value in attributes.items():
        if value is None or name in _SAID or name in _FOLLOWING or name in _TEXTS:
            continue
        if name in STATE_NUMBERS:
            found[name] = _number(path, where, name, value)
        elif name in _SHIFTED and value in _SHIFTED[name]:
            found[name] = float(value)
        elif name == "light_state":
            found[name] = _light_state(path, where, value, any_state=any_state)
        elif column := next((c for c, bits in _BITS.items() if name in bits), ""):
            bit = int(bool(value)) << _BITS[column].index(name)
            found[column] = int(found.get(column, 0)) | bit
        elif name == "speed":
            _number(path, where, name, value)
        else:
            own[name] = value
    _speed(attributes, found, lost)
    _drop_implausible(found, lost)
    return found, own


def _drop_implausible(found: dict[str, float], lost: dict[str, int]) -> None:
    """Remove implausible sizes and velocities from the state of an entity, and count them as losses."""
    row = [found.get(name, math.nan) for name in POSE]
    if is_plausible(*row[6:9], *row[13:]):
        return
    kept, faults = without_implausible(np.array([row]))
    for name, value in zip(POSE, kept[0].tolist(), strict=True):
        if math.isnan(value):
            found.pop(name, None)
    for _, words in faults:
        what = f"{words}: it"
        lost[what] = lost.get(what, 0) + 1


def _speed(attributes: Mapping[str, Any], found: dict[str, float], lost: dict[str, int]) -> None:
    """Set a missing velocity of an entity from its speed and heading."""
    speed = attributes.get("speed")
    if speed is None or "vx" in found:
        return
    if "heading" not in found:
        lost["attribute speed (no heading)"] = lost.get("attribute speed (no heading)", 0) + 1
        return
    found["vx"] = float(speed) * math.cos(found["heading"])
    found["vy"] = float(speed) * math.sin(found["heading"])


def part_of(path: Path, where: str, attributes: Mapping[str, Any]) -> tuple[dict[str, Any], Own]:
    """Return the attributes of an imported map part, in two groups: store columns, and all others.

    The columns are those of :class:`sgstore.maps.roads.MapNodes`.

    Raises
    ------
    TraceError
        An attribute has an invalid value.
    """
    found: dict[str, Any] = {}
    own: Own = {}
    for name, value in attributes.items():
        if value is None or name in _SAID or name in _FOLLOWING or name in _FIXED:
            continue
        if name in PART_NUMBERS:
            found[name] = _number(path, where, name, value)
        elif name in PART_WHOLE:
            found[name] = int(_number(path, where, name, value))
        elif name in PART_TEXTS:
            found[name] = str(value)[:200]
        else:
            own[name] = value
    kinds = {normalize_name(kind): kind for kind in LANE_TYPES}
    if "lane_type" in found:
        if normalize_name(found["lane_type"]) not in kinds:
            raise wrong(path, where, f"no type of lanes: {found['lane_type']!r}")
        found["lane_type"] = kinds[normalize_name(found["lane_type"])]
    return found, own


def lane_state_of(
    path: Path, where: str, attributes: Mapping[str, Any]
) -> tuple[dict[str, float], Own]:
    """Split the attributes of an edge: the position of an entity in a lane, and all others.

    ``primary`` is 1 or 0; it is absent if the file does not contain it.
    """
    found: dict[str, float] = {}
    own: Own = {}
    for name, value in attributes.items():
        if value is None:
            continue
        if name in LANE_NUMBERS:
            found[LANE_NUMBERS[name]] = _number(path, where, name, value)
        elif name in {"is_primary", "primary"}:
            found["primary"] = float(bool(value))
        else:
            own[name] = value
    return found, own


def gap_of(path: Path, where: str, attributes: Mapping[str, Any]) -> tuple[float, Own]:
    """Split the attributes of a ``leads`` or ``follows`` edge: the gap, and all others.

    NaN means an unknown gap.
    """
    value = attributes.get("gap")
    gap = float("nan") if value is None else _number(path, where, "gap", value)
    return gap, {name: value for name, value in attributes.items() if name != "gap"}


def columns_of(rows: list[dict[str, float]]) -> dict[str, NDArray[Any]]:
    """Return rows of entity states as columns. Missing values become NaN or the code for unknown."""
    empty = {"lights": -1, "light_state": -1, "derived": 0}
    types = {"lights": np.int64, "light_state": np.int8, "derived": np.int64}
    names = {name for row in rows for name in row}
    return {
        name: np.array(
            [row.get(name, empty.get(name, math.nan)) for row in rows], types.get(name, np.float64)
        )
        for name in sorted(names)
    }


def _number(path: Path, where: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        if isinstance(value, float) and math.isnan(value):
            return value
        raise wrong(path, where, f"expected a number as {name!r}, found {str(value)[:80]!r}")
    return math.radians(value) if name in _RADIANS else float(value)


def _light_state(path: Path, where: str, value: Any, *, any_state: bool) -> int:
    code = LIGHT_STATE_CODE.get(str(value).lower())
    if code is None and any_state:
        with suppress(ValueError):
            return add_light_state(_NO_NAME.sub("_", str(value)).strip("_").lower())
    if code is None:
        known = ", ".join(LIGHT_STATE_CODE)
        raise wrong(path, where, f"no state of a light: {str(value)[:80]!r}; there are: {known}")
    return code


# Resolved graphs of a file: entities, map parts, relations, and their common results.

OFF_ROAD: Final = ("off_road", "off_road")
"""Map part that contains the entities outside all lanes: kind and name."""

MAX_PARTS: Final = 500_000
MAX_ENTITIES: Final = 500_000
"""Maximum number of map parts in a file, and of entities."""

_REMEMBERED: Final = 1 << 16
"""Maximum number of names whose meaning is cached."""

Part = tuple[str, str]
"""Reference to a map part: its kind and name."""


@dataclass(slots=True)
class Meant:
    """Imported graph after its labels and relation names were replaced by those of sgstore.

    Attributes
    ----------
    graph : GivenGraph
    entities : dict
        Name → node and its resolved label.
    parts : dict
        Name → map part.
    ego : str
        Name of the ego; empty without one.
    edges : list of (GivenEdge, int)
        With the codes of their relations.
    """

    graph: GivenGraph
    entities: dict[str, tuple[GivenNode, LabelMeaning]]
    parts: dict[str, Part]
    ego: str
    edges: list[tuple[GivenEdge, int]]


class Understanding:
    """Converter from the node labels and relation names of a file to those of sgstore."""

    def __init__(self, path: Path, words: Words) -> None:
        self._path = path
        self._words = words
        self._known = lru_cache(_REMEMBERED)(words.meaning)
        self._relations = lru_cache(_REMEMBERED)(words.relation)

    def of(self, graph: GivenGraph) -> Meant:
        """Return an imported graph with the kinds and relations of sgstore.

        Unknown labels are dropped and counted, or raise an error.

        Raises
        ------
        TraceError
            A node or a relation is unknown, there are two egos, or the ego is not an entity.
        """
        meant = Meant(graph, {}, {}, "", [])
        taken: dict[Part, str] = {}
        for node in graph.nodes.values():
            meaning = self._meaning(node)
            told = node.attributes.get("is_ego")
            is_ego = meaning.is_ego if told is None else bool(told)
            if meaning.kind not in MAP_KINDS:
                meant.entities[node.name] = (node, meaning)
                if is_ego:
                    self._check_ego(meant, node)
                    meant.ego = node.name
                continue
            if is_ego:
                raise wrong(self._path, node.where, f"the ego cannot be a {meaning.kind}")
            part = _part(node, meaning)
            if part in taken:
                both = f"{taken[part]!r} and {node.name!r}"
                raise wrong(self._path, node.where, f"{both} are the same {part[0]} {part[1]!r}")
            taken[part] = node.name
            meant.parts[node.name] = part
        for edge in graph.edges:
            relation = self._relation(edge)
            if relation is not None:
                meant.edges.append((edge, RELATION_CODE[relation]))
            else:
                what = f"relation {edge.relation}"
                graph.lost[what] = graph.lost.get(what, 0) + 1
        return meant

    def _check_ego(self, meant: Meant, node: GivenNode) -> None:
        if meant.ego:
            reason = (
                f"{meant.ego!r} and {node.name!r} are both the ego of graph {meant.graph.name!r}"
            )
            raise wrong(self._path, node.where, f"{reason}; expected one")

    def _meaning(self, node: GivenNode) -> LabelMeaning:
        meaning = self._known(node.name, node.label)
        if meaning is None:
            raise wrong(self._path, node.where, self._words.why_not_kind(node.name, node.label))
        return meaning

    def _relation(self, edge: GivenEdge) -> str | None:
        relation = self._relations(edge.relation)
        if relation is None and not self._words.unknown_as:
            raise wrong(self._path, edge.where, self._words.why_not_relation(edge.relation))
        return relation


@dataclass(slots=True)
class FileMeaning:
    """Result of a first reading of an imported file: number of graphs, map parts, relations and ego.

    Attributes
    ----------
    graphs : int
    parts : dict
        Map parts, each with the attributes of its first occurrence; ``off_road`` is the first.
    relations : set of int
        Codes of the relations that occur.
    ego : str
        Name of the ego, if all graphs with an ego have the same one.
    timed : int
        Number of graphs with a time.
    """

    graphs: int = 0
    parts: dict[Part, dict[str, Any]] = field(default_factory=lambda: {OFF_ROAD: {}})
    relations: set[int] = field(default_factory=set[int])
    ego: str = ""
    timed: int = 0


def survey(path: Path, graphs: Iterable[GivenGraph], words: Words) -> FileMeaning:
    """Read all graphs of a file once. Return its graph count, map parts, relations and ego.

    Raises
    ------
    TraceError
        As in :meth:`Understanding.of`; or only some graphs have a time; or there are too many parts.
    """
    found, understanding = FileMeaning(), Understanding(path, words)
    egos: set[str] = set()
    entities: set[int] = set()
    digests, places = array("Q"), array("q")
    for graph in graphs:
        name = graph.name.encode("utf-8", "surrogatepass")
        digests.append(int.from_bytes(blake2b(name, digest_size=8).digest(), "little"))
        places.append(graph.place)
        meant = understanding.of(graph)
        found.graphs += 1
        found.timed += graph.time_ns is not None
        if found.timed not in {0, found.graphs}:
            reason = (
                f"graph {graph.name!r} and those before it do not agree on whether there are times"
            )
            raise wrong(path, f"row {graph.place}", f"{reason}; expected all or none")
        for name, part in meant.parts.items():
            if part not in found.parts:
                node = graph.nodes[name]
                found.parts[part], _ = part_of(path, node.where, node.attributes)
        if len(found.parts) > MAX_PARTS:
            raise wrong(path, f"row {graph.place}", f"more than {MAX_PARTS:,} parts of the road")
        entities.update(hash((name, meaning.kind)) for name, (_, meaning) in meant.entities.items())
        if len(entities) > MAX_ENTITIES:
            raise wrong(path, f"row {graph.place}", f"more than {MAX_ENTITIES:,} entities")
        found.relations.update(relation for _, relation in meant.edges)
        if meant.ego and len(egos) < 2:
            egos.add(meant.ego)
    _check_names(path, digests, places)
    found.ego = egos.pop() if len(egos) == 1 else ""
    return found


def _check_names(path: Path, digests: array[int], places: array[int]) -> None:
    """Raise an error if two graphs of a file have the same name, compared by 8-byte hashes."""
    names = np.frombuffer(digests, np.uint64)
    order = np.argsort(names, kind="stable")
    again = np.flatnonzero(names[order[1:]] == names[order[:-1]])
    if len(again):
        first, second = (places[int(order[i])] for i in (again[0], again[0] + 1))
        reason = f"a graph of the same name begins at {first} already; expected names that differ,"
        raise wrong(path, f"row {second}", f"{reason} and the rows of a graph together")


def _part(node: GivenNode, meaning: LabelMeaning) -> Part:
    if meaning.kind == "off_road":
        return OFF_ROAD
    told = node.attributes.get("name")
    return meaning.kind, told if isinstance(told, str) and told else node.name
