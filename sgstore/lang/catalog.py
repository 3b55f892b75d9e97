"""Catalog for the query compiler: the known attributes, and the contents of a store.

The attributes are fixed by the schema and are the same for every store. A :class:`Catalog` describes one
store: the kinds of nodes in each table, the triples (relation, kind, kind) with their numbers of rows, and
the relations that its traces know. The catalog is a plain value, so the compiler needs no database.

A node is stored in one of three ways. An entity that moves or changes has a row in ``state`` for each frame,
and its constants in ``entity``. A static entity has all its values in ``entity``. A part of the road map has
them in ``map_node``. For the last two, table ``node`` holds the frames in which they are present.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Final

from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import PAIR_FUNCTIONS, UNEVEN
from sgstore.model.vocabulary import (
    CONTROL,
    KINDS,
    LIGHT_STATES,
    MAP_KINDS,
    NOISE_MARKS,
    OWN_ENTITY_KINDS,
    OWN_KINDS,
    RELATIONS,
    SIGNALS,
    SPECIALS,
    VEHICLE_LIGHTS,
    VEHICLES,
    entity_kinds,
    kinds_labelled,
    normalize_name,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from typing import Self


Triple = tuple[str, str, str]
"""Relation, kind of the source, kind of the destination."""


class Home(StrEnum):
    """Table of the store in which the values of an attribute are."""

    state = "state"
    """Values of entities that move or change, frame by frame: table ``state``."""
    entity = "entity"
    """Constants of every entity, moving or static: table ``entity``."""
    scenery = "scenery"
    """Pose and size of static entities: also in table ``entity``."""
    map = "map"
    """Tables for values of parts of the road map: table ``map_node``."""


class DisplayUnit(StrEnum):
    """Conversion of a stored value to the value that users see, such as degrees or a word."""

    plain = "plain"
    degrees = "degrees"
    east = "east"
    """Coordinate relative to the origin of the trace; absolute in ``map_node``."""
    north = "north"
    up = "up"
    light = "light"
    """Bit of the light mask of a vehicle."""
    derived = "derived"
    """Bit of the mask of values computed by differences."""
    along = "along"
    """Length of (ax, ay) along the heading."""
    given = "given"
    """True if the table has a value in this column."""
    velocity = "velocity"
    """Velocity in m/s; 0 for static nodes."""
    standing = "standing"
    """True if the node never moves, as parts of the map."""
    binding = "binding"
    """The node id itself, from no table."""
    owner = "owner"
    """Owner of the node id: the trace of an entity, or the map of a map part; from no table."""
    whole = "whole"
    """Integer."""
    label = "label"
    """Display name of the node: the name of a map part, or the kind and id of an entity."""
    seconds = "seconds"
    """Time in nanoseconds, shown as seconds since the start of the trace."""
    classed = "classed"
    """Class of the frame's graph in an abstraction. The column is the name of the abstraction."""
    weather = "weather"
    """Word of the last weather event up to the frame. The column is the name of the word."""
    clock = "clock"
    """Time of day from the last weather event, plus the elapsed time; hours."""
    counted = "counted"
    """Number of frames in the store with the class of this frame. The column is the name of the abstraction."""
    seen = "seen"
    """True if a frame of a dataset has the class of this frame in an abstraction."""
    inside = "inside"
    """True if a node is in the graph of the frame. For a moving entity, its state holds this flag."""
    role = "role"
    """Role of a lane relative to the ego, frame by frame: view ``roles``."""
    chain = "chain"
    """Chain of lanes that a lane belongs to. The store computes it from the edges of the map."""
    own = "own"
    """User-defined attribute, frame by frame: view ``attributes``."""
    span = "span"
    """Duration in nanoseconds, shown in seconds."""
    recording = "recording"
    """Column of the table of recordings."""


class Type(StrEnum):
    """Types of values in query expressions, such as number or text."""

    number = "number"
    whole = "whole number"  # type of a user-defined attribute in a catalog; in expressions it is a number
    text = "text"
    boolean = "boolean"
    open = "value of any type"  # of a topic that is not known before the frames arrive
    node = "node"
    edge = "edge"
    list = "list"
    null = "NULL"


DERIVED: Final = ("velocity", "acceleration", "yaw_rate")
"""Quantities that may have been computed by differences. The index is the bit in ``state.derived``."""

_OF_NOISE: Final = (
    "whether it stands, in a recording with noise: it hardly moves for a second",
    "whether its acceleration is impossible, in a recording with noise: above 12 m/s²",
    "whether its yaw rate is impossible, in a recording with noise",
)

_ENTITIES: Final = frozenset(OWN_ENTITY_KINDS)
_LANES: Final = frozenset({"lane"})
_EVERY: Final = frozenset(OWN_KINDS)
_ON_ROADS: Final = frozenset({"lane", "junction", "road", "crosswalk", *SIGNALS})


@dataclass(frozen=True, slots=True, eq=False)
class Attribute:
    """Attribute of a node, an edge, a frame or a trace that queries can use.

    Attributes
    ----------
    name : str
        Canonical spelling; compared ignoring case and underscores.
    type : Type
    columns : mapping of Home to str
        Column in each home that stores the attribute.
    unit : DisplayUnit
        Conversion from the column to the value.
    own_kinds : frozenset of str
        Built-in kinds of nodes that may have the attribute; :attr:`kinds` also has added kinds.
    values : sequence of str
        All possible values, if the list is closed.
    enum : str
        Enumeration of the vocabulary that contains the values; empty for other attributes.
    given : str
        Table with the values if the store is part of a collection: see :attr:`Catalog.part`.
    precision : str
        For a value that ``WITH`` passes on: the rounding before comparisons.
    stored : bool
        True if such a value is a 32-bit number from the store.
    meaning : str
        Meaning for the documentation; with unit.
    table : str
        User table that has the column, or whose frames the attribute is about; empty for others.
    traces : tuple of int
        Ids of the traces that the attribute is about.
    whole : bool
        True if all values are integers, which may be too large for an exact float.
    """

    name: str
    type: Type
    columns: Mapping[Home, str]
    meaning: str
    unit: DisplayUnit = DisplayUnit.plain
    own_kinds: frozenset[str] = _EVERY
    values: Sequence[str] = ()
    table: str = ""
    traces: tuple[int, ...] = ()
    enum: str = ""
    given: str = ""
    whole: bool = False
    precision: str = ""
    stored: bool = False

    @property
    def kinds(self) -> frozenset[str]:
        """All kinds of node that may have the attribute.

        If all entities have it, this includes kinds added by users.
        """
        every = self.own_kinds >= _ENTITIES
        return self.own_kinds | entity_kinds() if every else self.own_kinds

    @property
    def topic(self) -> TopicValue | None:
        """Topic that contains the value; None if it is not the value of a topic."""
        return TopicValue.of(self.table) if self.table else None

    @property
    def of_store(self) -> bool:
        """True if the value of the attribute is in another table than the scene graph of the frame."""
        other = {DisplayUnit.seen, DisplayUnit.counted, DisplayUnit.weather, DisplayUnit.clock}
        return bool(self.table) or self.unit in other


def _state(name: str, meaning: str, unit: DisplayUnit = DisplayUnit.plain) -> Attribute:
    still = {Home.scenery: "is_static", Home.map: "kind"} if unit is DisplayUnit.velocity else {}
    return Attribute(name, Type.number, {Home.state: name} | still, meaning, unit, _ENTITIES)


def _everywhere(name: str, meaning: str, unit: DisplayUnit) -> Attribute:
    homes = {Home.state: name, Home.scenery: name, Home.map: name}
    return Attribute(name, Type.number, homes, meaning, unit)


def _constant(name: str, column: str, meaning: str, values: Sequence[str] = ()) -> Attribute:
    return Attribute(
        name, Type.text, {Home.entity: column}, meaning, own_kinds=_ENTITIES, values=values
    )


def _repeated(name: str, meaning: str, values: Sequence[str] = ()) -> Attribute:
    """Return an attribute of entities: a text that is constant, but stored again in each state."""
    homes = {Home.state: name, Home.entity: name}
    return Attribute(name, Type.text, homes, meaning, own_kinds=_ENTITIES, values=values)


def _control(name: str, meaning: str, unit: DisplayUnit = DisplayUnit.plain) -> Attribute:
    return Attribute(name, Type.number, {Home.state: name}, meaning, unit, frozenset(VEHICLES))


def _of_map(
    name: str,
    kind: Type,
    meaning: str,
    kinds: frozenset[str],
    unit: DisplayUnit = DisplayUnit.plain,
) -> Attribute:
    return Attribute(name, kind, {Home.map: name}, meaning, unit, kinds)


def _named(attributes: Iterable[Attribute]) -> Mapping[str, Attribute]:
    return {normalize_name(attribute.name): attribute for attribute in attributes}


IN_GRAPH: Final = Attribute(
    "in_graph",
    Type.boolean,
    {Home.state: "in_graph"},
    "whether it is in the graph of the frame, in scope ``world``",
    DisplayUnit.inside,
    _ENTITIES,
)
"""Attribute "is in the scene graph of the frame". Only generated queries use it; user queries set a scope."""

UNSURE_LANE: Final = Attribute(
    "unsure_lane", Type.boolean, {}, "whether later frames decide the lane that it drives"
)
"""Attribute "later frames decide the lane" of a vehicle, an ``isIn`` edge or a frame. Online mode only."""

UNSURE_LEAD: Final = Attribute(
    "unsure_lead", Type.boolean, {}, "whether a vehicle ahead of it depends on an unsure lane"
)
"""Attribute "the lane of a vehicle ahead is undecided", for generated conditions of the online mode."""

COMPUTED: Final = Attribute(
    "computed", Type.boolean, {}, "whether its relations were computed here, and not imported"
)
"""Attribute "relations were computed by sgstore, not imported" of a trace, for generated queries."""

NODE_ATTRIBUTES: Final = _named(
    (
        Attribute("id", Type.number, {}, "node id, unique in its trace", DisplayUnit.binding),
        Attribute(
            "name", Type.text, {}, "name of a part of the map; kind and id", DisplayUnit.label
        ),
        Attribute(
            "kind",
            Type.text,
            {Home.entity: "kind", Home.map: "kind"},
            "what it is",
            values=KINDS,
            enum="kind",
        ),
        Attribute("is_ego", Type.boolean, {Home.state: "is_ego"}, "whether it is the ego"),
        Attribute(
            "type",
            Type.text,
            {Home.entity: "type_name", Home.map: "lane_type"},
            "the simulator's type name; of a lane, its type in OpenDRIVE",
            own_kinds=_ENTITIES | _LANES,
        ),
        _constant("ident", "ident", "the simulator's own id"),
        _constant("type_name", "type_name", "the simulator's type name"),
        Attribute(
            "lifetime",
            Type.number,
            {Home.entity: "lifetime"},
            "1, 2, …: which of the entities with this id",
            DisplayUnit.whole,
            own_kinds=_ENTITIES,
        ),
        Attribute(
            "parked",
            Type.boolean,
            {Home.entity: "parked"},
            "whether a vehicle does not move in the whole trace, off the driving lanes",
            own_kinds=frozenset(VEHICLES),
        ),
        _repeated("special", "special kind", SPECIALS),
        _repeated("subkind", "what a prop or an unknown is"),
        Attribute(
            "is_static",
            Type.boolean,
            {Home.entity: "is_static", Home.map: "node_id"},
            "whether it never moves",
            DisplayUnit.standing,
        ),
        _everywhere("x", "east; m", DisplayUnit.east),
        _everywhere("y", "north; m", DisplayUnit.north),
        _everywhere("z", "up; m", DisplayUnit.up),
        _everywhere("heading", "counter-clockwise from east; degrees", DisplayUnit.degrees),
        _state("pitch", "degrees", DisplayUnit.degrees),
        _state("roll", "degrees", DisplayUnit.degrees),
        _state("speed", "m/s", DisplayUnit.velocity),
        _state("vx", "velocity to the east; m/s", DisplayUnit.velocity),
        _state("vy", "velocity to the north; m/s", DisplayUnit.velocity),
        _state("vz", "velocity upwards; m/s", DisplayUnit.velocity),
        _state("ax", "acceleration to the east; m/s²"),
        _state("ay", "acceleration to the north; m/s²"),
        _state("az", "acceleration upwards; m/s²"),
        Attribute(
            "accel",
            Type.number,
            {Home.state: "ax"},
            "acceleration along the heading, braking is negative; m/s²",
            DisplayUnit.along,
            _ENTITIES,
        ),
        _state("yaw_rate", "degrees/s, positive to the left", DisplayUnit.degrees),
        _everywhere("length", "of the box, or of the lane; m", DisplayUnit.plain),
        _everywhere("width", "of the box, or the lane's mean; m", DisplayUnit.plain),
        Attribute(
            "height",
            Type.number,
            {Home.state: "height", Home.scenery: "height"},
            "of the box; m",
            own_kinds=_ENTITIES,
        ),
        *(
            Attribute(
                f"derived_{what}",
                Type.boolean,
                {Home.state: "derived"},
                f"whether its {what} was computed by differences",
                DisplayUnit.derived,
                _ENTITIES,
            )
            for what in DERIVED
        ),
        *(
            Attribute(
                name, Type.boolean, {Home.state: "derived"}, doc, DisplayUnit.derived, _ENTITIES
            )
            for name, doc in zip(NOISE_MARKS, _OF_NOISE, strict=True)
        ),
        *(
            Attribute(
                name,
                Type.boolean,
                {Home.state: "lights"},
                "whether that light of the vehicle is on",
                DisplayUnit.light,
                frozenset(VEHICLES),
            )
            for name in VEHICLE_LIGHTS
        ),
        Attribute(
            "light_state",
            Type.text,
            {Home.state: "light_state"},
            "what a traffic light shows",
            own_kinds=frozenset({"traffic_light"}),
            values=LIGHT_STATES,
            enum="light_state",
        ),
        _control("steer", "steering input, -1 … 1, positive to the left"),
        _control("throttle", "0 … 1"),
        _control("brake", "0 … 1"),
        _control("gear", "1, 2, …; 0: neutral; below 0: backwards", DisplayUnit.whole),
        Attribute(
            "hand_brake",
            Type.boolean,
            {Home.state: "hand_brake"},
            "whether it is on",
            own_kinds=frozenset(VEHICLES),
        ),
        _of_map("lane_type", Type.text, "type of a lane in OpenDRIVE", _LANES),
        _of_map("road", Type.text, "id of the road", _ON_ROADS),
        _of_map(
            "section",
            Type.number,
            "number of the lane section in its road",
            _LANES,
            DisplayUnit.whole,
        ),
        _of_map("lane", Type.number, "number of the lane in its road", _LANES, DisplayUnit.whole),
        _of_map("junction", Type.text, "id of the junction that it belongs to", _ON_ROADS),
        Attribute(
            "in_junction",
            Type.boolean,
            {Home.map: "junction"},
            "whether it belongs to a junction",
            DisplayUnit.given,
            _ON_ROADS,
        ),
        Attribute(
            "turn",
            Type.text,
            {Home.map: "turn"},
            "where a lane in a junction leads",
            own_kinds=_LANES,
            values=("left", "right", "straight"),
        ),
        Attribute(
            "role",
            Type.text,
            {},
            "what a lane is to the ego: 'Ego Lane', 'Left 1 of Ego Lane', 'Opposing Lane 0'",
            DisplayUnit.role,
            _LANES,
        ),
        _of_map(
            "chain",
            Type.number,
            "of a lane: the same number in all parts of the map that are one lane",
            _LANES,
            DisplayUnit.chain,
        ),
        _of_map("speed_limit", Type.number, "m/s", _LANES | {"road"}),
        _of_map(
            "curvature",
            Type.number,
            "of a waypoint's lane there, positive to the left; 1/m",
            frozenset({"waypoint"}),
        ),
    )
)
"""Attributes of nodes by name in lower case, in the order of the documentation."""


@cache
def own_attribute(name: str, kind: Type) -> Attribute:
    """Return the definition of a user-defined attribute.

    Nodes of any kind and edges of any relation may have it.
    """
    whole = kind is Type.whole
    kind = Type.number if whole else kind
    return Attribute(name, kind, {}, "of a client's own", DisplayUnit.own, whole=whole)


_OF_SIGN: Final = {
    **dict.fromkeys(("text", "unit", "country", "type", "subtype"), Type.text),
    **dict.fromkeys(("value", "width", "height"), Type.number),
}
_OF_MARKING: Final = {
    **dict.fromkeys(("type", "color"), Type.text),
    "width": Type.number,
    "change": Type.boolean,
}
MAP_OWN: Final[Mapping[str, Type]] = {
    **{f"landmark_{name}": kind for name, kind in _OF_SIGN.items()},
    **{f"{side}_marking_{n}": k for side in ("left", "right") for n, k in _OF_MARKING.items()},
}
"""User-defined attributes of traffic signs and lanes in a map: name → type. No table has columns for them."""

RECORDED_OWN: Final[Mapping[str, Type]] = {
    **dict.fromkeys(("ang_vel_x", "ang_vel_y"), Type.number),
    **dict.fromkeys(
        (f"{CONTROL}{name}" for name in ("steer", "throttle", "brake", "gear")), Type.number
    ),
    **dict.fromkeys((f"{CONTROL}{name}" for name in ("hand_brake", "reverse")), Type.boolean),
    **dict.fromkeys(("manual_gear", f"{CONTROL}manual_gear"), Type.boolean),
    **MAP_OWN,
}
"""User-defined attributes that recordings usually have: name → type. They are valid in every store."""


def own_type(types: Collection[Type]) -> Type:
    """Return the type of a user-defined attribute that has different types in different traces.

    A number in one trace makes the attribute a number. Texts in other traces then count as missing values.
    """
    for kind in (Type.number, Type.whole):
        if kind in types:
            return kind
    return Type.boolean if set(types) == {Type.boolean} else Type.text


def _of_lane(name: str, kind: Type, column: str, meaning: str, unit: DisplayUnit) -> Attribute:
    return Attribute(name, kind, {Home.state: column}, meaning, unit)


EDGE_ATTRIBUTES: Final = _named(
    (
        _of_lane(
            "overlap",
            Type.number,
            "overlap",
            "share of the footprint in the lane",
            DisplayUnit.plain,
        ),
        _of_lane(
            "lane_offset",
            Type.number,
            "lane_offset",
            "of the centre, to the left of the lane's centre line; m",
            DisplayUnit.plain,
        ),
        _of_lane(
            "heading_error",
            Type.number,
            "heading_error",
            "heading less the lane's direction; degrees",
            DisplayUnit.degrees,
        ),
        _of_lane(
            "is_primary",
            Type.boolean,
            "is_primary",
            "the one lane that it is in above all",
            DisplayUnit.plain,
        ),
        _of_lane(
            "along",
            Type.number,
            "along",
            "of the centre along the lane, from its start; m",
            DisplayUnit.plain,
        ),
        _of_lane(
            "is_own",
            Type.boolean,
            "is_own",
            "one of the lanes by which lane_dist is told",
            DisplayUnit.plain,
        ),
        _of_lane(
            "gap",
            Type.number,
            "gap",
            "of leads and follows: from bumper to bumper along the lanes; m",
            DisplayUnit.plain,
        ),
    )
)
"""Attributes of edges, by lower-case name: of ``isIn`` (table ``lane_state``), and ``gap`` (``lane_gap``)."""

FOLLOWING: Final = ("leads", "follows")
"""Relations whose edges have the attribute ``gap``."""

EDGE_ALIASES: Final = {"offset": "laneoffset", "primary": "isprimary"}
"""Short aliases of edge attributes, in lower case."""


def class_attribute(abstraction: str, name: str = "") -> Attribute:
    """Return the attribute for the class of a frame's graph in an abstraction.

    Frames without a stored class have NULL.
    """
    return Attribute(
        name or f"class_{abstraction}",
        Type.text,
        {Home.state: abstraction},
        "class of the frame's graph in RSV; frame.class('E'): in another abstraction",
        DisplayUnit.classed,
    )


def _plain(name: str, kind: Type, column: str, meaning: str) -> Attribute:
    return Attribute(name, kind, {Home.state: column}, meaning)


FRAME_ATTRIBUTES: Final = _named(
    (
        _plain("id", Type.number, "frame_id", "frame_id, unique in every store"),
        _plain("seq", Type.number, "seq", "number in its trace, from 0"),
        _plain("time_ns", Type.number, "time_ns", "simulation time; ns"),
        _plain("log_time_ns", Type.number, "log_time_ns", "log time of the leading message; ns"),
        Attribute(
            "t",
            Type.number,
            {Home.state: "time_ns"},
            "since the trace began; s",
            DisplayUnit.seconds,
        ),
        class_attribute("RSV", "class"),
    )
)
"""Attributes of ``frame`` by name in lower case (table ``frame``)."""

_RAIN: Final = (
    "none",
    "very_light",
    "light",
    "moderate",
    "heavy",
    "very_heavy",
    "extreme",
    "other",
)
_FOG: Final = (
    *("none", "excellent_visibility", "good_visibility", "moderate_visibility", "poor_visibility"),
    *("mist", "light", "thick", "dense", "other"),
)
_LIGHT: Final = (*(f"level{number}" for number in range(1, 10)), "other")
_OKTAS: Final = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight")
_CLOUDS: Final = (*(f"{number}_oktas" for number in _OKTAS), "sky_obscured", "other")


def _weather(name: str, meaning: str, values: Sequence[str] = ()) -> Attribute:
    kind = Type.text if values else Type.number
    unit = DisplayUnit.clock if name == "time_of_day" else DisplayUnit.weather
    return Attribute(f"env.{name}", kind, {Home.state: name}, meaning, unit, values=values)


ENV_ATTRIBUTES: Final = {
    normalize_name(attribute.name.removeprefix("env.")): attribute
    for attribute in (
        _weather("precipitation", "how hard it rains", _RAIN),
        _weather("fog", "how far one sees", _FOG),
        _weather("illumination", "how bright it is: level1 is night, level9 full sun", _LIGHT),
        _weather("clouds", "how much of the sky they cover", _CLOUDS),
        _weather("temperature", "K"),
        _weather("time_of_day", "hours since midnight"),
    )
}
"""Attributes of ``env``, by lower-case name: weather and light (view ``events``), in words of OSI."""

TRACE_ATTRIBUTES: Final = _named(
    (
        _plain("id", Type.number, "trace_id", "unique in every store"),
        _plain("name", Type.text, "name", "the file's name without its ending"),
        Attribute(
            "uri",
            Type.text,
            {Home.state: "uri"},
            "path of the file when it was ingested",
            DisplayUnit.recording,
        ),
        _plain("flavour", Type.text, "flavour", "the reader: osi"),
        _plain("ego", Type.text, "ego", "the simulator's id of the ego"),
        _plain("frames", Type.number, "frames", "number of frames"),
        Attribute("duration", Type.number, {Home.state: "end_ns"}, "s", DisplayUnit.seconds),
        Attribute(
            "period",
            Type.number,
            {Home.state: "period_ns"},
            "median, between frames; s",
            DisplayUnit.span,
        ),
        Attribute("map", Type.text, {Home.map: "name"}, "name of the road map"),
    )
)
"""Attributes of ``trace`` by name in lower case (table ``trace``)."""


PAIR_NAMES: Final[Mapping[str, str]] = {
    normalize_name(word): name
    for name, one in PAIR_FUNCTIONS.items()
    for word in (name, one.column, one.alias)
    if word
} | {normalize_name(name): name for name in RECORDED}
"""Functions of two entities by name in lower case, with aliases, and recorded measures."""


@dataclass(frozen=True, slots=True)
class RelationScope:
    """Settings that select which pairs of entities have relations; see :class:`sgstore.model.config.Pairs`.

    Attributes
    ----------
    within, ego_within : float
    ego, static : bool
    kinds : tuple of pairs of str
    between : str
        Points between which distances are measured: :attr:`sgstore.model.config.Proximity.between`.
    rungs : tuple of (str, float)
        Distance relations, nearest first, and their upper bounds; m.
    near_kinds : tuple of pairs of str
        Pairs of kinds with distance relations; empty means all.
    radius : float
        Radius around the ego within which entities are in its graph; m.
    farthest : float
        Largest distance from the ego of a known entity; m.
    without : frozenset of str
        Relations that are not computed for entities. A map may still have them between its parts.
    """

    within: float = 25.0
    ego: bool = True
    static: bool = False
    ego_within: float = 0.0
    kinds: tuple[tuple[str, ...], ...] = ()
    between: str = "centres"
    rungs: tuple[tuple[str, float], ...] = ()
    near_kinds: tuple[tuple[str, ...], ...] = ()
    radius: float = 0.0
    farthest: float = math.inf
    without: frozenset[str] = frozenset()

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Self | None:
        """Return the settings that select entity pairs from the settings of a trace.

        ``None`` means that the settings have no pairs.
        """
        pairs = settings.get("pairs")
        if pairs is None:
            return None
        near, around = settings["proximity"], settings["range"]
        names = ("within", "ego", "static", "ego_within")
        without = set(settings.get("without", ()))
        if settings.get("lanes", {}).get("granularity") == "none":
            without.add("isIn")
        return cls(
            **{name: pairs[name] for name in names},
            kinds=_pairs_of(pairs["kinds"]),
            between=near["between"],
            rungs=tuple(zip(near["names"], near["upper"], strict=False)),
            near_kinds=_pairs_of(near["kinds"]),
            radius=around["radius"] if around["shape"] == "radius" else 0.0,
            farthest=max(
                around["radius"] if around["shape"] == "radius" else math.inf,
                around.get("world", 0.0),
            ),
            without=frozenset(without),
        )


def _pairs_of(labels: Iterable[Iterable[str]]) -> tuple[tuple[str, ...], ...]:
    return tuple(map(tuple, labels))


def excluded_kinds(labels: Iterable[str], counted: Iterable[str]) -> frozenset[str]:
    """Return the kinds of node that settings remove from scene graphs, all nodes of a kind or some.

    Parameters
    ----------
    labels : iterable of str
        Labels of kept nodes: :attr:`sgstore.model.config.Config.kinds`; empty means all.
    counted : iterable of str
        Kinds of the nodes that were left out.
    """
    kept = [frozenset(kinds_labelled(label) or ()) for label in labels]
    every = frozenset(OWN_KINDS) | entity_kinds()
    return (every.difference(*kept) if kept else frozenset()) | frozenset(counted)


@dataclass(frozen=True, slots=True)
class TraceFacts:
    """Facts about a trace that the query compiler needs.

    Attributes
    ----------
    trace_id : int
    name : str
    ego : str
        Simulator id of the ego; empty without an ego.
    answers : frozenset of str
        Relations that are known in the trace.
    reach : RelationScope or None
        Pairs of entities with relations; ``None`` if unknown.
    period_ns : int
        Median time between two frames.
    extent : (int, int)
        First bucket, and number of buckets.
    known : float
        Radius around the ego within which all recorded entities are known; m. Infinite if nothing was left out.
    uneven : int
        Objects other than ordinary bodies that occur: bits of :data:`sgstore.model.pair_numbers.UNEVEN`.
    excluded : frozenset of str
        Kinds whose nodes the settings leave out, all or some of them.
    """

    trace_id: int
    name: str
    ego: str
    answers: frozenset[str]
    reach: RelationScope | None = None
    period_ns: int = 0
    extent: tuple[int, int] = (0, 0)
    known: float = math.inf
    uneven: int = sum(UNEVEN.values())
    excluded: frozenset[str] = frozenset()


LANE_CHAINS: Final = ":lane chains"
"""Name of the temporary table with the lanes that continue as one lane."""

TOPIC: Final = ":topic-value "
"""Start of the names of relations with the values of a topic at frames."""

TOLERANCE_NS: Final = 1_000_000_000
"""Largest time between a message of a topic and a frame, without ``USING TOLERANCE``; ns."""

_PART: Final = re.compile(r"\[\d+\]|[^.\[]+|\[")


@dataclass(frozen=True, slots=True)
class TopicValue:
    """Reference to a topic field in a query, and the rule that selects the message of each frame.

    Attributes
    ----------
    topic, field : str
    rule : str
        ``last``, ``nearest`` or ``linear``.
    tolerance_ns : int or None
        Largest time between message and frame; ``None`` means unlimited.
    """

    topic: str
    field: str
    rule: str = "last"
    tolerance_ns: int | None = TOLERANCE_NS

    @property
    def written(self) -> str:
        """Query text of the value, such as ``topic('/imu', nearest, 0.1s).angular_velocity.z``."""
        topic = self.topic.replace("\\", "\\\\").replace("'", "\\'")
        parts = [f"'{topic}'", *([self.rule] if self.rule != "last" else [])]
        if self.tolerance_ns is None:
            parts.append("INF")
        elif self.tolerance_ns != TOLERANCE_NS:
            parts.append(f"{self.tolerance_ns / 1e9:.9g}s")
        path = (
            part if part.endswith("]") else f".{part if part.isidentifier() else f'`{part}`'}"
            for part in _PART.findall(self.field)
        )
        return f"topic({', '.join(parts)}){''.join(path)}"

    @property
    def relation(self) -> str:
        """Name of the SQL table that has the value of each frame."""
        parts = [self.topic, self.field, self.rule, self.tolerance_ns]
        return TOPIC + json.dumps(parts, ensure_ascii=False)

    @classmethod
    def of(cls, relation: str) -> Self | None:
        """If an SQL table has a topic value, return this value; otherwise None."""
        told = relation.removeprefix(TOPIC)
        return None if told == relation else cls(*json.loads(told))


@lru_cache(4096)
def topic_attribute(value: TopicValue, kind: Type) -> Attribute:
    """Return the frame attribute for a value of a topic."""
    home = {Home.state: "value"}
    return Attribute(value.written, kind, home, "field of a topic", table=value.relation)


@dataclass(frozen=True, slots=True)
class TableFacts:
    """Facts about a user table that the query compiler needs.

    Attributes
    ----------
    name : str
    columns : mapping of str to Type
    refused : str or None
        Reason why its columns cannot be attributes of frames. ``None`` if they can: the table has one row for
        each frame.
    traces : frozenset of int or None
        Ids of the traces, if each row belongs to a whole trace.
    joins : bool
        True if the rows belong to frames.
    """

    name: str
    columns: Mapping[str, Type]
    refused: str | None = None
    traces: frozenset[int] | None = None
    joins: bool = True

    def attribute(self, column: str) -> Attribute | None:
        """Return the attribute for a column of a user table. Upper and lower case are equal.

        ``None`` means an unknown column.
        """
        name = next((one for one in self.columns if one.lower() == column.lower()), None)
        if name is None:
            return None
        home = {Home.state: name}
        return Attribute(f"{self.name}.{name}", self.columns[name], home, "", table=self.name)


_NUMBERS_OF_TOPICS: Final = re.compile(r"U?(TINY|SMALL|BIG|HUGE)?INT(EGER)?|FLOAT|DOUBLE")


@dataclass(frozen=True, slots=True)
class TopicField:
    """Field of the messages of a topic.

    Attributes
    ----------
    name : str
        ``linear_acceleration.z``
    declared : str
        Database type: ``DOUBLE``, ``VARCHAR``, ``DOUBLE[]``, ``JSON``.
    """

    name: str
    declared: str

    @property
    def type(self) -> Type:
        """Type of the field in query expressions. A list or JSON field has the type ``list``."""
        if self.declared.endswith("]") or self.declared in {"JSON", "BLOB"}:
            return Type.list
        if _NUMBERS_OF_TOPICS.fullmatch(self.declared):
            return Type.number
        return Type.boolean if self.declared == "BOOLEAN" else Type.text


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """Facts about a topic of a store that the query compiler needs.

    Attributes
    ----------
    name : str
    traces : frozenset of int
        Ids of the traces that have the topic.
    stored : bool
        True if the store has its messages as columns. Otherwise, recordings are read.
    refused : str
        Reason if its messages cannot be decoded; else empty.
    source : function
        Returns its fields, by name. It can open a recording. Use :func:`sgstore.lang.topics.fields_of`.
    """

    name: str
    traces: frozenset[int]
    stored: bool
    refused: str
    source: Callable[[], Mapping[str, TopicField]]


@dataclass(frozen=True, slots=True)
class Catalog:
    """Description of a store for the query compiler: traces, tables, relations and attributes.

    Attributes
    ----------
    edges : mapping of Triple to int
        Rows of table ``edge`` for each triple that occurs.
    map_edges : mapping of Triple to int
        Rows of table ``map_edge`` for each triple that occurs.
    moving, fixed, mapped : frozenset of str
        Kinds in table ``state``, kinds of static entities in ``entity``, and kinds in ``map_node``.
    ego_signals : frozenset of str
        Kinds of lights and signs that are an ego; empty in nearly every store.
    lacking : mapping of str to frozenset of str
        For attributes such as ``heading``: the kinds of nodes that have no value in some frame. Attributes
        that are not listed may be missing everywhere.
    traces : tuple of TraceFacts
    classed : tuple of str
        Abstractions whose frame classes are in the store.
    name : str
        Abstraction that the catalog describes; empty for the store itself.
    relations : frozenset of str or None
        Relations of the abstraction; ``None`` means all.
    shadows : tuple of (str, str)
        Replaced tables of the abstraction, with the tables that replace them.
    beyond : tuple of (str, str)
        Replaced tables in scope ``world``, with the tables that replace them. Empty if the store has no data
        beyond the graphs.
    beyond_edges : mapping of Triple to int
        Rows of table ``world_edge`` for each triple.
    world : bool
        True for the catalog in scope ``world`` of a store with data beyond the graphs.
    around : bool
        True if the query has scope ``world``, with or without data beyond the graphs.
    only : frozenset of int or None
        Traces to search; ``None`` means all.
    tables : mapping of str to TableFacts
        User tables.
    sets : mapping of str to function
        For each abstraction that a query can name: the function that derives its catalog.
    own : mapping of str to Type
        User-defined attributes of nodes, by name.
    own_edges : mapping of str to Type
        User-defined attributes of edges, by name.
    names : mapping or None
        Added kinds, relations and light states of the store. ``None`` means those of all stores opened by the
        process.
    unknowing : frozenset of int
        Traces that do not meet the needs of a query (:mod:`sgstore.lang.bind._needed_values`) and are left out.
    lacks : dict
        Cache of the traces that do not meet each need.
    topics : mapping of str to TopicFacts
        Topics of the recordings of the store, by name.
    part : bool
        True if the store is a part of a collection. Then a missing dataset, ego or derived set belongs to
        other parts, and counts over all parts come from a table.
    online : bool
        True if frames arrive one by one, so that later frames are unknown.
    """

    edges: Mapping[Triple, int] = field(default_factory=dict[Triple, int])
    map_edges: Mapping[Triple, int] = field(default_factory=dict[Triple, int])
    moving: frozenset[str] = field(default_factory=entity_kinds)
    fixed: frozenset[str] = frozenset()
    mapped: frozenset[str] = frozenset(MAP_KINDS)
    ego_signals: frozenset[str] = frozenset(SIGNALS)
    lacking: Mapping[str, frozenset[str]] = field(default_factory=dict[str, frozenset[str]])
    traces: tuple[TraceFacts, ...] = ()
    classed: tuple[str, ...] = ()
    name: str = ""
    relations: frozenset[str] | None = None
    shadows: tuple[tuple[str, str], ...] = ()
    beyond: tuple[tuple[str, str], ...] = ()
    beyond_edges: Mapping[Triple, int] = field(default_factory=dict[Triple, int])
    world: bool = False
    around: bool = False
    only: frozenset[int] | None = None
    tables: Mapping[str, TableFacts] = field(default_factory=dict[str, TableFacts])
    sets: Mapping[str, Callable[[Catalog], Catalog]] = field(
        default_factory=dict[str, "Callable[[Catalog], Catalog]"]
    )
    own: Mapping[str, Type] = field(default_factory=dict[str, Type])
    own_edges: Mapping[str, Type] = field(default_factory=dict[str, Type])
    names: Mapping[str, Sequence[str]] | None = None
    unknowing: frozenset[int] = frozenset()
    lacks: dict[Any, frozenset[int]] = field(
        default_factory=dict[Any, frozenset[int]], compare=False, repr=False
    )
    topics: Mapping[str, TopicFacts] = field(default_factory=dict[str, TopicFacts])
    part: bool = False
    online: bool = False

    def under(self, abstraction: str) -> Catalog | None:
        """Return the catalog (names that a query can use) of an abstraction; None if it does not exist."""
        wanted = normalize_name(abstraction)
        found = [made for name, made in self.sets.items() if normalize_name(name) == wanted]
        if not found and self.part:
            return replace(self, name=abstraction, only=frozenset())
        return found[-1](self) if found else None

    def in_world(self) -> Catalog:
        """Return the catalog for ``USING SCOPE world``, which includes entities outside the scene graphs.

        If the store has no such data, only ``around`` changes.
        """
        if self.world or not (self.beyond or self.beyond_edges):
            return replace(self, around=True)
        edges = dict(self.edges)
        for triple, many in self.beyond_edges.items():
            edges[triple] = edges.get(triple, 0) + many
        shadows = (*(dict(self.shadows) | dict(self.beyond)).items(),)
        return replace(self, shadows=shadows, edges=edges, world=True, around=True)


def attributes_of(catalog: Catalog) -> dict[str, list[Attribute]]:
    """Return all attributes that a query can use, grouped by owner: node, edge, frame, env, trace."""
    own = [
        replace(own_attribute(name, kind), meaning="of your own")
        for name, kind in catalog.own.items()
    ]
    return {
        "node": [*NODE_ATTRIBUTES.values(), *own],
        "edge": [*EDGE_ATTRIBUTES.values()],
        "frame": [*FRAME_ATTRIBUTES.values()],
        "env": [*ENV_ATTRIBUTES.values()],
        "trace": [*TRACE_ATTRIBUTES.values()],
    }


def relations_of_set(
    answered: frozenset[str], known: frozenset[str], *, mapped: bool
) -> frozenset[str]:
    """Return the relations for which a set of edges is complete: a missing edge means false, not unknown.

    Parameters
    ----------
    answered : frozenset of str
        Relations that its traces answer in the set.
    known : frozenset of str
        Relations that its traces answer in the store.
    mapped : bool
        True if one of its traces has a road map.
    """
    return answered if mapped else frozenset(RELATIONS) - (known - answered)
