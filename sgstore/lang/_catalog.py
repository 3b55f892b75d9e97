"""Catalog of a store for the compiler: its attributes and its contents.

The attributes are fixed by the schema and are the same for every store. A :class:`Catalog` says what one
store holds: which kinds of nodes live where, which triples (relation, kind, kind) occur and how often, and
what its traces can answer. It is a value; the compiler asks nothing of a database.

A node lives in one of three places: an entity that moves or changes has a row in ``state`` for each frame and
its constants in ``entity``; a static entity has everything in ``entity``, a part of the road map in
``map_node``, and both have their presence in ``node``.
"""

from __future__ import annotations

import math
from dataclasses import field, replace
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from sgstore.criticality import RECORDED
from sgstore.pair_numbers import PAIR_FUNCTIONS, UNEVEN
from sgstore.records import dataclass
from sgstore.vocabulary import (
    KINDS,
    LIGHT_STATES,
    MAP_KINDS,
    OWN_ENTITY_KINDS,
    OWN_KINDS,
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
    """Table that holds the values of an attribute."""

    state = "state"
    """Of entities that move or change, frame by frame: table ``state``."""
    entity = "entity"
    """Constants of every entity, moving or static: table ``entity``."""
    scenery = "scenery"
    """Pose and size of static entities: also in table ``entity``."""
    map = "map"
    """Parts of the road map: table ``map_node``."""


class DisplayUnit(StrEnum):
    """Conversion of a value in the database to the value that people see."""

    plain = "plain"
    degrees = "degrees"
    east = "east"
    """A coordinate about the trace's origin; in ``map_node`` it is absolute already."""
    north = "north"
    up = "up"
    light = "light"
    """A bit of the mask of a vehicle's lights."""
    derived = "derived"
    """A bit that says which numbers were computed by differences."""
    along = "along"
    """Length of (ax, ay) along the heading."""
    given = "given"
    """True where there is a value."""
    velocity = "velocity"
    """m/s; what stands for ever has velocity 0."""
    standing = "standing"
    """Parts of the map never move."""
    binding = "binding"
    """The node id itself, in no table."""
    owner = "owner"
    """Whose number the node id is: the trace's of an entity, the map's of a part of it; in no table."""
    whole = "whole"
    """A whole number."""
    label = "label"
    """What people call the node: of a part of the map its name, of an entity its kind and id."""
    seconds = "seconds"
    """A time in nanoseconds; seen as seconds since the trace began."""
    classed = "classed"
    """The class of a frame's graph in an abstraction; the column is the name of that."""
    weather = "weather"
    """What the last event of weather and light up to the frame says; the column is its word."""
    clock = "clock"
    """The time of day that such an event says, and what has passed since; hours."""
    counted = "counted"
    """How many frames of the store are of the class of the frame, in an abstraction; the column is its name."""
    seen = "seen"
    """Whether the class of the frame, in an abstraction, is that of a frame of a dataset."""
    inside = "inside"
    """Whether a node is in the graph of the frame; of what moves, its state says so."""
    role = "role"
    """What a lane is to the ego, frame by frame: in the view ``roles``."""
    own = "own"
    """An attribute of a client's own, frame by frame: in the view ``attributes``."""
    span = "span"
    """A length of time in nanoseconds; seen in seconds."""
    recording = "recording"
    """What stands in the table of recordings; the column is there."""


class Type(StrEnum):
    """Types of values in expressions."""

    number = "number"
    whole = (
        "whole number"  # of an attribute of a client's own, in a catalog: a number in expressions
    )
    text = "text"
    boolean = "boolean"
    node = "node"
    edge = "edge"
    list = "list"
    null = "NULL"


DERIVED: Final = ("velocity", "acceleration", "yaw_rate")
"""What may have been computed by differences; the index is the bit in ``state.derived``."""

_ENTITIES: Final = frozenset(OWN_ENTITY_KINDS)
_LANES: Final = frozenset({"lane"})
_EVERY: Final = frozenset(OWN_KINDS)
_ON_ROADS: Final = frozenset({"lane", "junction", "road", "crosswalk", *SIGNALS})


@dataclass(frozen=True, slots=True, eq=False)
class Attribute:
    """An attribute of nodes, edges, frames or traces; each is there once.

    Attributes
    ----------
    name : str
        Canonical spelling; compared without regard to case and underscores.
    type : Type
    columns : mapping of Home to str
        Column in each home that has it.
    unit : DisplayUnit
        How the column becomes the value.
    own_kinds : frozenset of str
        Kinds of the vocabulary whose nodes may have it; :attr:`kinds` are all of them.
    values : sequence of str
        All values that it can have, if they are a closed list.
    enum : str
        The enumeration of the vocabulary that its values are of; empty for all others.
    given : str
        The table that tells it where a store is part of a collection: see :attr:`Catalog.part`.
    precision : str
        Of a value that ``WITH`` passes on: how it is rounded before it is compared.
    stored : bool
        Whether such a value is a number of 32 bits as the store keeps it.
    meaning : str
        For the documentation; with unit.
    table : str
        The user's own table that it is a column of, or whose frames it is about; empty for all others.
    traces : tuple of int
        Ids of the traces that it is about.
    whole : bool
        Whether all its values are whole numbers, some of which no float is equal to.
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
        """All kinds that have it: what all entities have, those that were added have, too."""
        every = self.own_kinds >= _ENTITIES
        return self.own_kinds | entity_kinds() if every else self.own_kinds

    @property
    def of_store(self) -> bool:
        """Tell whether it is told by what the store holds beside the graph of the frame."""
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
    """A constant of entities that their states repeat."""
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
"""Of queries made here alone: who writes one has the scope."""

COMPUTED: Final = Attribute(
    "computed", Type.boolean, {}, "whether its relations were computed here, and not imported"
)
"""Of a trace, in queries made here alone; its settings say it."""

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
        _of_map("speed_limit", Type.number, "m/s", _LANES | {"road"}),
        _of_map(
            "curvature",
            Type.number,
            "of a waypoint's lane there, positive to the left; 1/m",
            frozenset({"waypoint"}),
        ),
    )
)
"""Attributes of nodes by folded name, in the order of the documentation."""


@cache
def own_attribute(name: str, kind: Type) -> Attribute:
    """Return an attribute of a client's own, which nodes of any kind, or edges of any relation, may have."""
    whole = kind is Type.whole
    kind = Type.number if whole else kind
    return Attribute(name, kind, {}, "of a client's own", DisplayUnit.own, whole=whole)


def own_type(types: Collection[Type]) -> Type:
    """Return the type of an attribute of a client's own, by its types in each of several traces.

    What is a number in one trace is a number everywhere. A text of another trace is then no value.
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
"""Attributes of edges: of ``isIn`` from entities to lanes (table ``lane_state``); ``gap`` (``lane_gap``)."""

FOLLOWING: Final = ("leads", "follows")
"""Relations whose edges have the attribute ``gap``."""

EDGE_ALIASES: Final = {"offset": "laneoffset", "primary": "isprimary"}
"""Shorter words for them, folded."""


def class_attribute(abstraction: str, name: str = "") -> Attribute:
    """The class of a frame in an abstraction; NULL where it is not in the store."""
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
"""Attributes of ``frame`` by folded name (table ``frame``)."""

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
"""Attributes of ``env``, weather and light, by folded name (view ``events``); their words are those of OSI."""

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
"""Attributes of ``trace`` by folded name (table ``trace``)."""


PAIR_NAMES: Final[Mapping[str, str]] = {
    normalize_name(word): name
    for name, one in PAIR_FUNCTIONS.items()
    for word in (name, one.column, one.alias)
    if word
} | {normalize_name(name): name for name in RECORDED}
"""The functions of two entities by folded name, aliases included, and measures of what was recorded."""


@dataclass(frozen=True, slots=True)
class RelationScope:
    """Pairs of entities for which relations are computed, as in :class:`sgstore.config.Pairs`.

    Attributes
    ----------
    within, ego_within : float
    ego, static : bool
    kinds : tuple of pairs of str
    between : str
        What distances are measured between: :attr:`sgstore.config.Proximity.between`.
    rungs : tuple of (str, float)
        Relations of distance, from the nearest on, and their upper bounds; m.
    near_kinds : tuple of pairs of str
        Those that they are among; empty: all.
    radius : float
        A circle around the ego that is in its graph; m.
    farthest : float
        How far from the ego an entity is at most of which something is known; m.
    without : frozenset of str
        Relations that are not computed of entities, though a map may have them among its parts.
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
        """As the settings of a trace have it; ``None`` where they do not say it."""
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
    """Return the kinds of which settings leave out some nodes, or all.

    Parameters
    ----------
    labels : iterable of str
        Of what is kept: :attr:`sgstore.config.Config.kinds`; none: everything.
    counted : iterable of str
        Kinds of what was left out.
    """
    kept = [frozenset(kinds_labelled(label) or ()) for label in labels]
    every = frozenset(OWN_KINDS) | entity_kinds()
    return (every.difference(*kept) if kept else frozenset()) | frozenset(counted)


@dataclass(frozen=True, slots=True)
class TraceFacts:
    """Facts about a trace that the compiler needs.

    Attributes
    ----------
    trace_id : int
    name : str
    ego : str
        The simulator's id of the ego; empty without one.
    answers : frozenset of str
        Relations that it can answer; of the others nothing is known.
    reach : RelationScope or None
        Which pairs of entities are related in it; ``None`` where that is not known.
    period_ns : int
        Median time between two frames.
    extent : (int, int)
        Its first bucket, and how many follow from there on.
    known : float
        How far around the ego all is known that was recorded; m. Infinite where nothing was left out.
    uneven : int
        What there is that is no pair of bodies: bits of :data:`sgstore.pair_numbers.UNEVEN`.
    excluded : frozenset of str
        Kinds of which settings leave out some nodes, or all.
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


@dataclass(frozen=True, slots=True)
class TableFacts:
    """Facts about a user's own table that the compiler needs.

    Attributes
    ----------
    name : str
    columns : mapping of str to Type
    refused : str or None
        Why its columns are not attributes of frames; ``None`` if they are: it has one row a frame.
    traces : frozenset of int or None
        If its rows are of whole traces: their ids.
    joins : bool
        Whether its rows belong to frames.
    """

    name: str
    columns: Mapping[str, Type]
    refused: str | None = None
    traces: frozenset[int] | None = None
    joins: bool = True

    def attribute(self, column: str) -> Attribute | None:
        """The attribute of frames that a column is, whatever the case of letters; ``None``: no such column."""
        name = next((one for one in self.columns if one.lower() == column.lower()), None)
        if name is None:
            return None
        home = {Home.state: name}
        return Attribute(f"{self.name}.{name}", self.columns[name], home, "", table=self.name)


@dataclass(frozen=True, slots=True)
class Catalog:
    """Contents of a store, as far as the compiler needs them.

    Attributes
    ----------
    edges : mapping of Triple to int
        Rows of table ``edge`` for each triple that occurs.
    map_edges : mapping of Triple to int
        Rows of table ``map_edge`` for each triple that occurs.
    moving, fixed, mapped : frozenset of str
        Kinds that occur in table ``state``, among the static ones of ``entity``, and in ``map_node``.
    traces : tuple of TraceFacts
    classed : tuple of str
        Abstractions in which the classes of frames are in the store.
    name : str
        Of the abstraction that this is the catalog of; empty: of the store.
    relations : frozenset of str or None
        Those that the abstraction has; ``None``: all.
    shadows : tuple of (str, str)
        Tables that are others under the abstraction, and what they are there.
    beyond : tuple of (str, str)
        Tables that are others in scope ``world``, and what they are there; none where nothing is known beyond
        the graphs.
    beyond_edges : mapping of Triple to int
        Rows of table ``world_edge``, as ``edges``.
    world : bool
        Whether this is the catalog in scope ``world``, of a store that knows something beyond the graphs.
    around : bool
        Whether it is asked in scope ``world``, whatever the store knows.
    only : frozenset of int or None
        The traces that are asked; ``None``: all.
    tables : mapping of str to TableFacts
        Tables of users' own that are joined.
    sets : mapping of str to function
        The abstractions that a query can name: what makes the catalog of each from this one.
    own : mapping of str to Type
        Attributes of a client's own that nodes have, by their names.
    own_edges : mapping of str to Type
        The same of edges.
    names : mapping or None
        Kinds, relations and states of lights that the store has beside those of this package; ``None``: those
        of all stores that the process has met.
    unknowing : frozenset of int
        Traces that do not know what a query needs (:mod:`sgstore.lang._needs`): it leaves them out.
    lacks : dict
        Which traces lack what, as far as it was asked; it is remembered with the catalog.
    part : bool
        Whether the store is a part of a collection. Then a dataset, an ego or a derived set that it has not is
        one that other parts have, and what is counted over all parts is given as a table.
    online : bool
        Whether frames come one by one, so that nothing later is known.
    """

    edges: Mapping[Triple, int] = field(default_factory=dict[Triple, int])
    map_edges: Mapping[Triple, int] = field(default_factory=dict[Triple, int])
    moving: frozenset[str] = field(default_factory=entity_kinds)
    fixed: frozenset[str] = frozenset()
    mapped: frozenset[str] = frozenset(MAP_KINDS)
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
    part: bool = False
    online: bool = False

    def under(self, abstraction: str) -> Catalog | None:
        """Return the catalog under an abstraction, in any spelling; ``None`` if there is none of that name."""
        wanted = normalize_name(abstraction)
        found = [made for name, made in self.sets.items() if normalize_name(name) == wanted]
        if not found and self.part:
            return replace(self, name=abstraction, only=frozenset())
        return found[-1](self) if found else None

    def in_world(self) -> Catalog:
        """Return the catalog in scope ``world``; the same where nothing is known beyond the graphs."""
        if self.world or not (self.beyond or self.beyond_edges):
            return replace(self, around=True)
        edges = dict(self.edges)
        for triple, many in self.beyond_edges.items():
            edges[triple] = edges.get(triple, 0) + many
        shadows = (*(dict(self.shadows) | dict(self.beyond)).items(),)
        return replace(self, shadows=shadows, edges=edges, world=True, around=True)


def attributes_of(catalog: Catalog) -> dict[str, list[Attribute]]:
    """All attributes that a query can ask for, by what has them; a client's own among those of nodes."""
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
