"""Settings of the scene graph generator: defaults, comments and validation.

Every setting has a comment. ``sgstore config`` and ``docs/parameters.md`` print it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping  # noqa: TC003 (type hints are evaluated)
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base import plugins
from sgstore.errors import ConfigError
from sgstore.model.config._values import check, one_of, unknown_setting, value_of
from sgstore.model.vocabulary import (
    DIRECTIONS,
    ENTITY_KINDS,
    LANE_TYPES,
    MAP_ONLY,
    OWN_RELATIONS,
    PROXIMITY,
    RELATIONS,
    SIGNALS,
    TypeMeaning,
    add_kind,
    add_relation,
    kinds_labelled,
    labels,
    normalize_name,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

SHAPES: Final = ("radius", "rectangle", "polygon", "corridor")
EXTENTS: Final = ("footprint", "centre")
GRANULARITIES: Final = ("none", "lane", "waypoint")
MEASURES: Final = ("centres", "origins", "footprints")
SIDES: Final = ("open", "closed", "none")
TIES: Final = ("ahead", "both", "carlasgg")
JOINS: Final = ("nearest", "latest")
ORIENTATIONS: Final = ("asam", "carla")
ALL_EGOS: Final = "all"

MOST_CORNERS: Final = 64
MOST_LENGTH: Final = 100_000.0
"""Largest length in a range of settings; m. No map is larger, and numbers stay exact."""

_WORD: Final = re.compile(r"[a-z0-9][a-z0-9_]{0,39}|")


@dataclass(frozen=True, slots=True)
class RangeSettings:
    """Settings of the area around the ego that the graph covers.

    Attributes
    ----------
    radius : float
        shape 'radius': how far from the ego's centre; m
    shape : str
        'radius': a circle around the ego's centre; 'rectangle' and 'polygon': in the ego's axes;
        'corridor': along the lanes ahead of the ego (straight ahead where it is in no driving lane)
    front : float
        shape 'rectangle': how far ahead of the ego's centre; m
    rear : float
        shape 'rectangle': how far behind it; m
    side : float
        shape 'rectangle': how far to each side; m
    polygon : tuple of tuple of float
        shape 'polygon': its corners, [ahead, to the left] of the ego's centre; m
    width : float
        shape 'corridor': from side to side, across the lane's centre; m
    length : float
        shape 'corridor': how far along the lanes, through forks; m
    by : str
        part of an entity that must be in range: 'footprint': any part of it; 'centre': its centre
    static_by : str
        likewise for entities that never move; parts of a map count by their shape
    height : tuple of float
        [lowest, highest]: how far below or above the ground under the ego the ground under an
        entity, and the road, may be (storeys); signals may hang up to 6 m above it; m. Empty: at
        any height
    grade : float
        with height: entities that rise or fall by less than this per metre of distance also count
    height_of_entities : bool
        whether height holds for entities, too, or only for parts of the map
    world : float
        how far from the ego's centre entities are known beyond its graph: states and places in
        lanes, no edges; m. 0: the graph alone; inf: all of the recording
    """

    radius: float = 50.0
    shape: str = "radius"
    front: float = 50.0
    rear: float = 25.0
    side: float = 25.0
    polygon: tuple[tuple[float, ...], ...] = ()
    width: float = 10.0
    length: float = 100.0
    by: str = "footprint"
    static_by: str = "footprint"
    height: tuple[float, ...] = ()
    grade: float = 0.0
    height_of_entities: bool = True
    world: float = 200.0

    def __post_init__(self) -> None:
        check(self.shape in SHAPES, "range.shape", self.shape, one_of(SHAPES))
        for name in ("radius", "width", "length"):
            value = getattr(self, name)
            _check_length(value > 0, f"range.{name}", value, "a length above 0, in metres")
        check(
            self.world >= 0, "range.world", self.world, "a length of 0 or more, in metres, or inf"
        )
        object.__setattr__(self, "world", min(self.world, MOST_LENGTH))  # no data beyond it
        for name in ("front", "rear", "side"):
            value = getattr(self, name)
            _check_length(value >= 0, f"range.{name}", value, "a length of 0 or more, in metres")
        if self.shape == "rectangle":
            area = (self.front + self.rear) * self.side
            check(area > 0, "range", (self.front, self.rear, self.side), "a rectangle with an area")
        check(self.by in EXTENTS, "range.by", self.by, one_of(EXTENTS))
        check(self.static_by in EXTENTS, "range.static_by", self.static_by, one_of(EXTENTS))
        check(0 <= self.grade < math.inf, "range.grade", self.grade, "0 or more")
        band = not self.height or (len(self.height) == 2 and self.height[0] <= self.height[1])
        finite = all(map(math.isfinite, self.height))
        check(band and finite, "range.height", self.height, "nothing, or [lowest, highest]")
        if self.polygon or self.shape == "polygon":
            check_polygon("range.polygon", self.polygon)

    def beyond(self) -> RangeSettings | None:
        """Return the circle around the ego in which the store has known objects outside the graphs.

        ``None`` means no such objects.
        """
        return replace(self, shape="radius", radius=self.world) if self.world else None

    @property
    def boundless(self) -> bool:
        """True if the store has all objects of the recording, at any distance from the ego."""
        return self.world >= MOST_LENGTH


@dataclass(frozen=True, slots=True)
class LaneSettings:
    """Settings of the map elements in a graph, and of the relations between lanes.

    Attributes
    ----------
    ahead : float
        how far along the lanes the next one ahead is looked for ('leads'), and how far upstream of
        a signal lanes may be affected by it ('mayAffect'); m. 0: neither, so that nothing is known
        of them
    granularity : str
        'none': no lanes, roads, junctions, crosswalks; 'lane': these; 'waypoint': points of lanes,
        too
    spacing : float
        granularity 'waypoint': from point to point along a lane; m
    types : tuple of str
        types of lanes that are kept, as OpenDRIVE has them ('driving', 'sidewalk', …); empty: all
    sections : bool
        whether each section of a road has lanes of its own ('12/0/-1'); otherwise the lanes of a
        number are one node ('12_-1'), as CARLASGG has it
    """

    ahead: float = 100.0
    granularity: str = "lane"
    spacing: float = 1.0
    types: tuple[str, ...] = ()
    sections: bool = True

    def __post_init__(self) -> None:
        known = 0 <= self.ahead <= MOST_LENGTH
        check(known, "lanes.ahead", self.ahead, "a length of 0 or more, in metres")
        right = self.granularity in GRANULARITIES
        check(right, "lanes.granularity", self.granularity, one_of(GRANULARITIES))
        for name in self.types:
            if name.lower() not in {known.lower() for known in LANE_TYPES}:
                _check_name("lanes.types", name, LANE_TYPES)
        right = 0.1 <= self.spacing <= MOST_LENGTH
        check(right, "lanes.spacing", self.spacing, "a length of 0.1 or more, in metres")


@dataclass(frozen=True, slots=True)
class Proximity:
    """Distance relations and their upper bounds. The first relation whose bound is not exceeded holds.

    Attributes
    ----------
    names : tuple of str
        relations from the nearest to the farthest, by these names or others; empty: none
    upper : tuple of float
        their upper bounds, included; m. Each begins where that before it ends
    between : str
        'centres' of the boxes, in space; 'origins': what CARLA takes for the place of an entity (a
        vehicle's is on the ground); 'footprints': the gap between them, in the plane. [pairs] has
        the same distance
    kinds : tuple of tuple of str
        only related pairs of these labels, in either order: [['Ego', 'Vehicle']]; empty: all
    """

    names: tuple[str, ...] = PROXIMITY
    upper: tuple[float, ...] = (2.0, 4.0, 7.0, 10.0, 16.0, 25.0)
    between: str = "centres"
    kinds: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        check_pairs("proximity.kinds", self.kinds)
        check_steps("proximity", self.names, self.upper, PROXIMITY, len(self.names))
        check(self.between in MEASURES, "proximity.between", self.between, one_of(MEASURES))


@dataclass(frozen=True, slots=True)
class Direction:
    """Direction relations between entities, such as ``inFrontOf``.

    The first one with an upper bound at or above the absolute bearing holds; else the last.

    Attributes
    ----------
    names : tuple of str
        relations from ahead to behind, by these names or others; empty: none
    upper : tuple of float
        upper bounds of all but the last, included; degrees
    ties : str
        what holds exactly on a bound: 'ahead': the relation nearer to dead ahead; 'both'
        (RoadScene2Vec); 'carlasgg': its order: 45° and 90° to the left nearer ahead, 135° and 90°
        to the right nearer behind
    sides : str
        toLeftOf and toRightOf: 'open': what is dead ahead or dead behind is neither; 'closed': it
        is to the left (CARLASGG); 'none': no such relations among entities
    within : float
        up to this distance, as [proximity] measures it; m. 0: as far as pairs are related
    kinds : tuple of tuple of str
        only related pairs of these labels, in either order: [['Ego', 'Vehicle']]; empty: all
    """

    names: tuple[str, ...] = DIRECTIONS
    upper: tuple[float, ...] = (45.0, 90.0, 135.0)
    ties: str = "ahead"
    sides: str = "open"
    within: float = 0.0
    kinds: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        check_pairs("direction.kinds", self.kinds)
        _check_length(self.within >= 0, "direction.within", self.within, "a length of 0 or more")
        check_steps("direction", self.names, self.upper, DIRECTIONS, max(len(self.names) - 1, 0))
        within = all(bound < 180 for bound in self.upper)
        check(within, "direction.upper", self.upper, "bounds below 180, in degrees")
        check(self.ties in TIES, "direction.ties", self.ties, one_of(TIES))
        check(self.sides in SIDES, "direction.sides", self.sides, one_of(SIDES))


@dataclass(frozen=True, slots=True)
class PairSettings:
    """Settings that define which pairs of entities can have relations.

    Attributes
    ----------
    within : float
        all entities that move, up to this distance from one another; m. 0: none
    ego : bool
        the ego with everything in range
    static : bool
        entities that never move with one another too, up to the same distance
    ego_within : float
        maximum distance from the ego; m. 0: no limit
    kinds : tuple of tuple of str
        only pairs of these labels, in either order: [['Ego', 'Vehicle'], ['Person', 'Car']]; empty:
        all
    """

    within: float = 25.0
    ego: bool = True
    static: bool = False
    ego_within: float = 0.0
    kinds: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        for name in ("within", "ego_within"):
            value = getattr(self, name)
            _check_length(value >= 0, f"pairs.{name}", value, "a length of 0 or more, in metres")
        check_pairs("pairs.kinds", self.kinds)


@dataclass(frozen=True, slots=True)
class Payloads:
    """Settings that define which sensor messages belong to a frame.

    Attributes
    ----------
    join : str
        'nearest' in log time, or 'latest' at or before the frame
    tolerance : float
        greatest difference of log times; s. 0: half the median period of the channel, or of the
        frames if that is longer ('nearest'), the whole of it ('latest')
    """

    join: str = "nearest"
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        check(self.join in JOINS, "payloads.join", self.join, one_of(JOINS))
        waits = 0 <= self.tolerance < math.inf
        check(waits, "payloads.tolerance", self.tolerance, "0 or more seconds")


@dataclass(frozen=True, slots=True)
class Signs:
    """Settings for reading the signals (signs and lights) of a road map.

    Attributes
    ----------
    kinds : tuple of (str, str)
        Signal type codes in lower case, with their configured kinds.
    orientation : str
        One of :data:`ORIENTATIONS`: meaning of the orientation of a signal without validity.
    """

    kinds: tuple[tuple[str, str], ...] = ()
    orientation: str = "asam"


@dataclass(frozen=True, slots=True, repr=False)
class Config:
    """All settings of a scene graph generator.

    Equal configs give equal graphs. The comment of each field, ``docs/parameters.md`` and ``sgstore config``
    explain the settings.

    Attributes
    ----------
    ego : str
        the simulator's id, role or name of the ego; empty: that of the trace
    mapping : str
        mapping of the boxes of a Foxglove scene to kinds: a shipped mapping ('nuscenes2mcap') or
        the path of a TOML file; empty: the shipped one that fits. For logs of CARLA's recorder:
        'carla_origins' (positions are origins of actors). Other recordings need none
    sees : bool
        whether visibility from the ego is computed; if not, it is unknown
    egos : tuple of str
        several egos, each with graphs of its own: their ids, roles or names; ['all']: every vehicle
    rate : float
        frames kept for each second of the trace's clock: the first frame at or after each step of
        1/rate. 0: all frames
    noise : float
        standard deviation of recorded positions; m. Missing velocities, accelerations and yaw rates
        of noisy positions are smoothed. 0: exact positions, as of a simulator; -1: estimated from
        the first frames, above all from what stands
    kinds : tuple of str
        labels of what is kept: entities ('Vehicle', 'Person', 'Signal') and parts of the map
        ('Lane'); the ego always is. What is not kept is as if it were not there. Empty: everything
    exclude_ids : tuple of str
        entities that are left out, as if they were not there: the simulator's ids, or roles or
        names of vehicles as for ego; an ego never is
    without : tuple of str
        relations that are not computed and stay unknown: ['overlaps', 'follows']
    topics : tuple of str
        channels of the recording whose messages are stored as columns, beside the graphs:
        ['/planner', '/imu']
    orientation : str
        whom a signal of an OpenDRIVE map applies to that has no <validity>: 'asam': traffic in the
        direction of its orientation along the road, as the standard says; 'carla': the lanes to the
        left of the road's line where it is '+', to the right where it is '-'. Where the place of
        signals contradicts, that is said
    new_kinds : tuple of str
        kinds of your own, for types to name: ['scooter']
    types : mapping of str to TypeMeaning
        type names of the simulator, and type codes of the map's signals ('206'), without regard to
        case -> what they mean: kind, special kind and subkind, before what sgstore knows of them:

        "vehicle.acme.patrol" = { kind = "car", special = "emergency" }
    relations : mapping of str to mapping
        settings of relations of other packages, a table for each:

        [relations.besides]

        reach = 3.0

    Examples
    --------
    >>> config = sgstore.Config(ego="hero", rate=5.0)
    >>> config
    Config(ego='hero', rate=5.0)
    >>> config.range.radius
    50.0
    """

    range: RangeSettings = field(default_factory=RangeSettings)
    proximity: Proximity = field(default_factory=Proximity)
    direction: Direction = field(default_factory=Direction)
    pairs: PairSettings = field(default_factory=PairSettings)
    lanes: LaneSettings = field(default_factory=LaneSettings)
    payloads: Payloads = field(default_factory=Payloads)
    ego: str = ""
    mapping: str = ""
    sees: bool = True
    egos: tuple[str, ...] = ()
    rate: float = 0.0
    noise: float = -1.0
    kinds: tuple[str, ...] = ()
    exclude_ids: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    orientation: str = "asam"
    new_kinds: tuple[str, ...] = ()
    types: Mapping[str, TypeMeaning] = field(default_factory=dict)
    relations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(not (self.ego and self.egos), "egos", self.egos, "either ego or egos, not both")
        check(len(set(self.egos)) == len(self.egos), "egos", self.egos, "each ego once")
        check(all(self.egos), "egos", self.egos, "ids, roles or names")
        alone = ALL_EGOS not in self.egos or len(self.egos) == 1
        check(alone, "egos", self.egos, f"'{ALL_EGOS}' alone, or a list of egos")
        for kind in self.new_kinds:
            _make_known("new_kinds", add_kind, kind)
        check(all(self.exclude_ids), "exclude_ids", self.exclude_ids, "ids, roles or names")
        check(0 <= self.rate <= 1e6, "rate", self.rate, "0 or more frames per second")
        right = "a length from 0 to 10 m, or -1 for an estimate"
        check(0 <= self.noise <= 10 or self.noise == -1, "noise", self.noise, right)
        check_labels("kinds", self.kinds, ego=False)
        once = all(self.topics) and len(set(self.topics)) == len(self.topics)
        check(once, "topics", self.topics, "names of channels, each once")
        both = set(self.proximity.names) & set(self.direction.names)
        check(not both, "direction.names", self.direction.names, "other names than proximity.names")
        for name in self.without:
            relation_named(name)  # looks for plugins of other packages
            _check_name("without", name, [r for r in RELATIONS if r not in MAP_ONLY])
        right = one_of(ORIENTATIONS)
        check(self.orientation in ORIENTATIONS, "orientation", self.orientation, right)
        object.__setattr__(self, "types", _checked_types(self.types))
        object.__setattr__(self, "relations", _checked_relations(self.relations))

    def __hash__(self) -> int:
        return hash(repr(self))

    @property
    def signs(self) -> Signs:
        """Settings for :func:`sgstore.maps.opendrive.read_map`: how to read the signals of a road map.

        Examples
        --------
        >>> from sgstore.model.config import from_dict
        >>> from_dict({"types": {"board": {"kind": "sign"}}}).signs
        Signs(kinds=(('board', 'sign'),), orientation='asam')
        """
        kinds = tuple((name, of.kind) for name, of in self.types.items() if of.kind in SIGNALS)
        return Signs(kinds, self.orientation)

    @property
    def notes(self) -> list[str]:
        """Return a hint for each new relation name that is similar to a built-in name, perhaps by mistake.

        Examples
        --------
        >>> from sgstore.model.config import from_dict
        >>> from_dict({"proximity": {"names": ["nearr"], "upper": [10.0]}}).notes
        ["setting 'proximity.names': 'nearr' would be a new relation; did you mean 'near'?"]
        """
        return [
            f"setting '{table}.names': {name!r} would be a new relation; did you mean {like!r}?"
            for table, known in (("proximity", PROXIMITY), ("direction", DIRECTIONS))
            for name in getattr(self, table).names
            if name not in known and (like := suggestion(name, known, alike=0.8))
        ]

    def unknown_of(self, types: Mapping[str, int]) -> dict[str, int]:
        """Return the type names for which the settings define no kind, each with its number of occurrences.

        Examples
        --------
        >>> from sgstore.model.config import from_dict
        >>> config = from_dict({"types": {"vehicle.rickshaw": {"kind": "bicycle"}}})
        >>> config.unknown_of({"vehicle.rickshaw": 3, "vehicle.tuktuk": 2})
        {'vehicle.tuktuk': 2}
        """
        return {name: n for name, n in types.items() if name.lower() not in self.types}

    def as_stored(self) -> dict[str, Any]:
        """Return the settings as a store keeps them. Settings of newer versions are omitted at their default.

        Examples
        --------
        >>> "noise" in sgstore.Config().as_stored(), sgstore.Config(noise=0.1).as_stored()["noise"]
        (False, 0.1)
        """
        found = self.as_dict()
        if self.noise < 0:
            del found["noise"]
        if not self.topics:
            del found["topics"]
        return found

    def __repr__(self) -> str:
        """Return as text the settings that differ from the defaults: ``Config(range.radius=30.0)``."""
        told = list[str]()
        for name, default in Config().as_dict().items():
            value = self.as_dict()[name]
            if not isinstance(default, dict) or not default:
                told += [f"{name}={value!r}"] * (value != default)
            else:
                told += [f"{name}.{k}={value[k]!r}" for k in default if value[k] != default[k]]
        return f"Config({', '.join(told)})"

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as a dict of plain values, as in TOML and JSON.

        Examples
        --------
        >>> sgstore.Config().as_dict()["range"]["radius"]
        50.0
        """
        return asdict(self)


def _make_known(name: str, add: Callable[[str], int], new: str) -> None:
    try:
        add(new)
    except ValueError as error:
        raise ConfigError(f"setting '{name}': {error}") from None


def check_steps(
    name: str, names: tuple[str, ...], upper: tuple[float, ...], known: tuple[str, ...], bounds: int
) -> None:
    """Raise an error for reserved or repeated relation names, or for bounds that do not ascend.

    New names are registered in this process.
    """
    for relation in names:
        free = relation in known or relation not in OWN_RELATIONS
        check(free, f"{name}.names", relation, f"one of {', '.join(known)}, or a new name")
        _make_known(f"{name}.names", add_relation, relation)
    check(len(set(names)) == len(names), f"{name}.names", names, "each name once")
    check(len(upper) == bounds, f"{name}.upper", upper, f"{bounds} bounds for {len(names)} names")
    rising = all(a < b < math.inf for a, b in zip((0.0, *upper), upper, strict=False))
    check(rising, f"{name}.upper", upper, "ascending bounds above 0")


def check_labels(name: str, given: Iterable[str], *, ego: bool) -> None:
    """Raise an error for labels (such as ``Car``) that no kind of object has.

    ``Ego`` is valid if ``ego`` is true.
    """
    known = [label for label in labels() if ego or label != "Ego"]
    for label in given:
        if not (kinds_labelled(label) or (ego and normalize_name(label) == "ego")):
            _check_name(name, label, known)


def check_pairs(name: str, pairs: tuple[tuple[str, ...], ...]) -> None:
    """Raise an error if a setting is not a list of pairs of valid labels."""
    for i, pair in enumerate(pairs):
        check(len(pair) == 2, f"{name}[{i}]", pair, "two labels")
        check_labels(f"{name}[{i}]", pair, ego=True)


def check_polygon(name: str, corners: tuple[tuple[float, ...], ...]) -> None:
    """Raise an error if corner points do not form a simple polygon."""
    pairs = all(len(corner) == 2 and all(map(math.isfinite, corner)) for corner in corners)
    right = f"3 to {MOST_CORNERS} corners [ahead, to the left], in metres"
    check(pairs and 3 <= len(corners) <= MOST_CORNERS, name, corners, right)
    near = all(abs(number) <= MOST_LENGTH for corner in corners for number in corner)
    check(near, name, corners, f"corners up to {MOST_LENGTH:.0f} m away")
    from sgstore.base.geometry import is_simple  # imports numpy, which most configs do not need

    right = "sides that meet at the corners only, one after another"
    check(is_simple(corners), name, corners, right)


def _check_length(holds: bool, name: str, value: float, right: str) -> None:  # noqa: FBT001
    check(holds and value <= MOST_LENGTH, name, value, right)


def _check_name(setting: str, name: str, known: Iterable[str], more: str = "") -> None:
    """Raise an error for an unknown name, and suggest the most similar known name."""
    known = list(known)
    if name not in known:
        alias = relation_named(name)
        like = alias if alias in known else suggestion(name, known)
        right = f"'{like}', perhaps" if like else f"one of {', '.join(known)}"
        check(False, setting, name, right + more)  # noqa: FBT003


def _checked_types(types: Mapping[str, TypeMeaning]) -> dict[str, TypeMeaning]:
    checked: dict[str, TypeMeaning] = {}
    for name, meaning in sorted(types.items(), key=lambda item: item[0].lower()):
        where = f'types."{name}"'
        check(bool(name.strip()), where, name, "the type name of a simulator")
        more = "; new_kinds names those of your own"
        _check_name(f"{where}.kind", meaning.kind, ENTITY_KINDS, more)
        for part in ("special", "subkind"):
            word = getattr(meaning, part)
            check(bool(_WORD.fullmatch(word)), f"{where}.{part}", word, "a word of a-z, 0-9 and _")
        check(name.lower() not in checked, where, name, "each type name once")
        checked[name.lower()] = meaning
    return checked


def _checked_relations(given: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the parameters of relations from the settings, with defaults for missing values."""
    registry, checked = plugins.RELATIONS, dict[str, dict[str, Any]]()
    others = registry.others() if given else {}
    for name, values in sorted(given.items()):
        own = registry.load(name) if name in registry.own else None
        if not getattr(own, "parameters", {}):
            check(bool(others), "relations", name, "no table")
            _check_name("relations", name, others)
        relation = own or registry.load_other(others[name], ConfigError)
        known: Mapping[str, Any] = getattr(relation, "parameters", {})
        for key in values:
            if key not in known:
                raise unknown_setting(f"relations.{name}.", key, {*known})
        where = f"relations.{name}."
        chosen = {key: value_of(type(known[key]), v, where + key) for key, v in values.items()}
        checked[name] = {**known, **chosen}
    return checked
