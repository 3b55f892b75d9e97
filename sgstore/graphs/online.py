"""Online generation of scene graphs, frame by frame, for example from a running simulator.

Frames are built from plain values by a client, or from a recording.
"""

from __future__ import annotations

import gc
import math
from collections import OrderedDict
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from sgstore.base.geometry import wrapped
from sgstore.base.tables import chained
from sgstore.model.graph import Edges, LaneDistances, StaticPresence
from sgstore.model.online_noise import ClientNoise
from sgstore.model.scene_columns import MapRecords, SceneColumns, edge_attributes
from sgstore.model.vocabulary import (
    CONTROL,
    ENTITY_KINDS,
    EVENT_KINDS,
    KIND_CODE,
    KINDS,
    LIGHT_STATE_CODE,
    LIGHT_STATES,
    MAP_KINDS,
    NOISE_MARKS,
    SPECIALS,
    VEHICLE_LIGHTS,
    kind_named,
    suggestion,
)
from sgstore.model.world import (
    INPUTS,
    POSE,
    SMOOTHED,
    Entities,
    FaultTally,
    FrameBlock,
    Life,
    Lives,
    MessageRefs,
    Origin,
    Sight,
    States,
    is_plausible,
    nearest_frames,
    number,
    origin_of,
    own_column,
    quantize,
    valid_attributes,
    without_implausible,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.graphs.relations import DrivenLanes
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock, LaneGaps, LaneStates, SceneGraph, Whole, WorldBlock
    from sgstore.model.vocabulary import TypeMeaning
    from sgstore.model.world import Codes, Event, Floats, Ints

    Attributes = dict[str, Any]

__all__ = ["REMEMBERED", "Entity", "Frame", "Replay", "Stepper", "check_entities", "replayed"]

_NAN: Final = math.nan
_LIGHT: Final = 1
NUMBERS: Final = (*POSE, *INPUTS)
_TEXTS: Final = ("ident", "special", "subkind", "type_name", "map_ref", "trailer")
WHOLE: Final = ("lights", "light_state", "derived")
"""Names of the integer values of an entity, as in ``States``."""
_ANGLES: Final = {"heading", "pitch", "roll", "yaw_rate"}


class Entity(NamedTuple):
    """Object in a frame with id, kind, pose, size and motion; angles in radians.

    ``node`` is its node id in a store, if a reader has assigned one; -1: none.
    """

    ident: str
    kind: int
    special: str
    subkind: str
    type_name: str
    static: bool
    map_ref: str
    numbers: tuple[float, ...]
    whole: tuple[int, ...]
    trailer: str = ""
    own: Mapping[str, Any] | None = None
    node: int = -1

    @property
    def constants(self) -> tuple[int, str, str]:
        """Attributes that must not change while the object exists: kind, special role and subkind."""
        return self.kind, self.special, self.subkind

    def meant(self, told: TypeMeaning | None) -> Entity:
        """Return the object with the kind that the type mapping has for it; unchanged without a mapping."""
        if told is None:
            return self
        kind = KIND_CODE[told.kind]
        return self._replace(kind=kind, special=told.special, subkind=told.subkind)


class Frame:
    """Frame of a scene that the caller builds: time, objects, lights and events.

    Parameters
    ----------
    time_ns : int
        Simulation time; ns. Any number: no result depends on it.
    ego : str or int, optional
        Id of the ego, which must be one of the added entities. ``None`` means a frame without an ego.

    Attributes
    ----------
    time_ns : int
    ego : str
        Id of the ego; empty without an ego.
    entities : list of Entity
        In the order in which they were added.
    events : list of (str, str, str)
        Kind of the event, and the ids of its first and second entity. An empty id means no entity or an unknown
        one.
    recorded : frozenset of str
        Kinds of events that the frame records. Events of other kinds are unknown.
    topics : dict of str to message
        Messages of other topics at this time: ``{"/planner": {"state": "STOP"}}``. A pattern uses their fields
        as ``topic('/planner').state``. A topic that is absent keeps its last message.
    noise : float
        Noise of the positions of entities that a reader has smoothed; m.
    losses : list of (str, str)
        Id and fault of each implausible number, which is treated as missing: ``("7", "length is -4.5 m")``;
        and of each entity without a position.

    Examples
    --------
    >>> frame = sgstore.Frame(0, ego="hero")
    >>> frame.add("hero", "car", 0, 0, heading=0, length=4.5, width=1.9)
    >>> len(frame), frame.ego
    (1, 'hero')
    """

    __slots__ = ("ego", "entities", "events", "losses", "noise", "recorded", "time_ns", "topics")

    def __init__(self, time_ns: int, ego: str | int | None = None) -> None:
        self.time_ns = int(time_ns)
        self.ego = "" if ego is None else str(ego)
        self.entities: list[Entity] = []
        self.events: list[tuple[str, str, str]] = []
        self.recorded = frozenset(EVENT_KINDS)
        self.topics: dict[str, Any] = {}
        self.noise = 0.0
        self.losses: list[tuple[str, str]] = []

    def __len__(self) -> int:
        return len(self.entities)

    def meant(self, types: Mapping[str, TypeMeaning]) -> Frame:
        """Return the frame with the kinds that the settings define for the type names of its objects.

        Examples
        --------
        >>> from sgstore.model.config import from_dict
        >>> config = from_dict({"types": {"trafficcone": {"kind": "prop", "subkind": "cone"}}})
        >>> frame = sgstore.Frame(0)
        >>> frame.add("c1", "unknown", 0, 0, type_name="trafficcone")
        >>> frame.meant(config.types).entities[0].subkind
        'cone'
        """
        if not types:
            return self
        frame = Frame(self.time_ns, self.ego)
        frame.events, frame.recorded, frame.losses = self.events, self.recorded, self.losses
        frame.topics, frame.noise = self.topics, self.noise
        frame.entities = [
            entity.meant(types.get(entity.type_name.lower())) for entity in self.entities
        ]
        return frame

    def __repr__(self) -> str:
        return f"Frame({self.time_ns}, ego={self.ego!r}, {len(self)} entities)"

    def happened(self, kind: str, ident: str | int = "", other: str | int = "") -> None:
        """Add an event to the frame. The query ``HAPPENS kind(a, b)`` then matches this frame.

        Parameters
        ----------
        kind : str
            ``collision``, ``lane_invasion`` or ``environment``.
        ident, other : str or int
            Ids of the first and second entity of the event. Empty: no entity, or an unknown one.

        Raises
        ------
        ValueError
            The kind of event is unknown.

        Examples
        --------
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.happened("collision", "hero", "p7")
        >>> frame.events
        [('collision', 'hero', 'p7')]
        """
        self.events.append(
            (_one_of("kind of event", kind, tuple(EVENT_KINDS)), str(ident), str(other))
        )

    def add(  # noqa: PLR0913  one argument per property
        self,
        ident: str | int,
        kind: str,
        x: float,
        y: float,
        z: float = _NAN,
        *,
        heading: float = _NAN,
        pitch: float = _NAN,
        roll: float = _NAN,
        length: float = _NAN,
        width: float = _NAN,
        height: float = _NAN,
        vx: float = _NAN,
        vy: float = _NAN,
        vz: float = _NAN,
        ax: float = _NAN,
        ay: float = _NAN,
        az: float = _NAN,
        yaw_rate: float = _NAN,
        light_state: str | None = None,
        lights: Iterable[str] | None = None,
        steer: float = _NAN,
        throttle: float = _NAN,
        brake: float = _NAN,
        gear: float | None = None,
        hand_brake: bool | None = None,
        manual_gear: bool | None = None,
        ang_vel_x: float = _NAN,
        ang_vel_y: float = _NAN,
        control: Mapping[str, float | bool | str] | None = None,
        special: str = "",
        subkind: str = "",
        type_name: str = "",
        static: bool = False,
        map_ref: str = "",
        trailer: str | int = "",
    ) -> None:
        """Add an object (such as a vehicle) to the frame.

        Parameters
        ----------
        ident : str or int
            The client's own id, unique in the frame and the same in all frames.
        kind : str
            One of :data:`sgstore.model.vocabulary.ENTITY_KINDS`, or another label of one: ``Pedestrian``.
        x, y, z : float
            Centre of its box, in the map's axes (x east, y north, z up); m.
        heading, pitch, roll : float
            Orientation, counter-clockwise from the x axis; degrees.
        length, width, height : float
            Full extents of its box; m.
        vx, vy, vz, ax, ay, az : float
            Velocity and acceleration, in the map's axes; m/s, m/s².
        yaw_rate : float
            degrees/s.
        light_state : str, optional
            State of a traffic light: one of :data:`sgstore.model.vocabulary.LIGHT_STATES`.
        lights : iterable of str, optional
            Active lights of a vehicle, of :data:`sgstore.model.vocabulary.VEHICLE_LIGHTS`. ``None`` means
            unknown.
        steer, throttle, brake : float
            Control inputs; -1 … 1 (positive to the left), 0 … 1, 0 … 1.
        gear : int, optional
            1, 2, …; 0: neutral; below 0: backwards.
        hand_brake : bool, optional
            True if the hand brake is on.
        manual_gear : bool, optional
            True if the driver, not the vehicle, chooses the gear.
        ang_vel_x, ang_vel_y : float
            Angular velocity about the map's x and y axes; degrees/s. The one about z is ``yaw_rate``.
        control : mapping, optional
            Commanded control inputs by name, beside the applied ones: ``{"steer": 0.2, "target_speed": 8}``.
            A query uses them as ``control_steer`` and ``control_target_speed``.
        special, subkind, type_name : str
            Special kind, subkind, the simulator's own type name; see :class:`sgstore.model.world.Entities`.
        static : bool
            True if the entity never moves. Add it once, in any frame; it stays for all later frames.
        map_ref : str
            Id of its signal or object in the OpenDRIVE map. For a traffic light, it determines the controlled
            lanes.
        trailer : str or int
            Id of the trailer that it pulls when it is first added. Empty: no trailer, or an unknown one.

        Raises
        ------
        ValueError
            The kind, a light or a light state is unknown. The message lists the known ones.

        Notes
        -----
        A missing or infinite number is unknown, not 0. An entity without a size is a point. An entity without a
        heading has no front. Sizes below 0 or above 1 km and speeds above 150 m/s are unknown, too.
        An entity without a position is in no graph. :attr:`losses` lists both.

        Examples
        --------
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 10, 4, heading=90, length=4.6, width=1.9, vy=8)
        >>> frame.add("tl3", "traffic_light", 12, 30, light_state="red")
        >>> [entity.ident for entity in frame.entities]
        ['hero', 'tl3']
        """
        pose = (x, y, z, heading, pitch, roll, vx, vy, vz, ax, ay, az, yaw_rate)
        pose = self._plausible(str(ident), (*pose, length, width, height))
        gears = _NAN if gear is None else gear, _NAN if hand_brake is None else float(hand_brake)
        numbers = (*pose, steer, throttle, brake, *gears)
        own: dict[str, Any] = {f"{CONTROL}{name}": value for name, value in (control or {}).items()}
        own |= {"manual_gear": manual_gear, "ang_vel_x": ang_vel_x, "ang_vel_y": ang_vel_y}
        self.entities.append(
            Entity(
                ident=str(ident),
                kind=_kind_code(kind),
                special=_one_of("special kind", special, SPECIALS) if special else "",
                subkind=str(subkind),
                type_name=str(type_name),
                static=static,
                map_ref=str(map_ref),
                numbers=tuple(map(_inside, NUMBERS, numbers)),
                whole=(_mask_of(lights), _light_code(light_state), 0),
                trailer=str(trailer),
                own=valid_attributes(own) or None,
            )
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the frame as plain values for JSON. Unknown numbers are ``None``, angles are in radians.

        Examples
        --------
        >>> frame = sgstore.Frame(5, ego="hero")
        >>> frame.add("hero", "car", 1.5, 0)
        >>> sgstore.Frame.from_dict(frame.as_dict()).entities == frame.entities
        True
        """
        entities: list[dict[str, Any]] = []
        for entity in self.entities:
            told = {name: getattr(entity, name) for name in _TEXTS if getattr(entity, name)}
            told |= {"kind": KINDS[entity.kind], "static": entity.static, "whole": [*entity.whole]}
            told["numbers"] = [None if math.isnan(one) else one for one in entity.numbers]
            entities.append(told | ({"own": dict(entity.own)} if entity.own else {}))
        told: dict[str, Any] = {"time_ns": self.time_ns, "ego": self.ego, "entities": entities}
        told |= {"noise": self.noise} if self.noise else {}
        return told | {"events": [*map(list, self.events)], "recorded": sorted(self.recorded)}

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Frame:
        """Return the frame that plain values describe, as made by :meth:`as_dict`.

        Raises
        ------
        ValueError
            A value is malformed, or a kind is unknown.
        KeyError
            A value is missing.
        TypeError
            A value has another type.

        Examples
        --------
        >>> sgstore.Frame.from_dict({"time_ns": 5, "ego": "", "entities": [], "events": [], "recorded": []})
        Frame(5, ego='', 0 entities)
        """
        frame = cls(int(told["time_ns"]), str(told["ego"]))
        frame.recorded = frozenset(map(str, told["recorded"]))
        frame.noise = float(told.get("noise", 0.0))
        for event in told["events"]:
            frame.happened(*map(str, event))
        for one in told["entities"]:
            numbers = tuple(_NAN if number is None else float(number) for number in one["numbers"])
            lights, state, derived = map(int, one["whole"])
            if len(numbers) != len(NUMBERS) or math.inf in map(abs, numbers):
                raise ValueError(f"an entity has {len(numbers)} numbers, or an infinite one")
            if not (-1 <= lights < 1 << len(VEHICLE_LIGHTS) and -1 <= state < len(LIGHT_STATES)):
                raise ValueError(f"an entity has impossible lights: {lights}, {state}")
            texts: dict[str, Any] = {name: str(one.get(name, "")) for name in _TEXTS}
            frame.entities.append(
                Entity(
                    kind=_kind_code(str(one["kind"])),
                    static=bool(one["static"]),
                    numbers=(
                        *frame._plausible(texts["ident"], numbers[: len(POSE)]),
                        *numbers[len(POSE) :],
                    ),
                    whole=(lights, state, derived),
                    own=valid_attributes(dict(one.get("own") or {})) or None,
                    **texts,
                )
            )
        return frame

    def _plausible(self, ident: str, pose: tuple[float, ...]) -> tuple[float, ...]:
        """Remove implausible values from pose and motion. Each removed value is reported as a loss.

        An unknown position is reported, too, because the graph then lacks the entity.
        """
        if not (math.isfinite(pose[0]) and math.isfinite(pose[1])):
            self.losses.append((ident, "position is unknown"))
        if is_plausible(*pose[6:9], *pose[13:]):
            return pose
        kept, faults = without_implausible(np.array([pose], np.float64))
        self.losses += [(ident, words) for _, words in faults]
        return tuple(kept[0].tolist())


def _inside(name: str, value: float) -> float:
    """Convert a number to internal units: degrees become radians, infinite values become NaN."""
    value = float(value)
    if not math.isfinite(value):
        return _NAN
    return math.radians(value) if name in _ANGLES else value


def _kind_code(kind: str) -> int:
    return KIND_CODE[_one_of("kind", kind_named(kind) or kind, ENTITY_KINDS)]


def _light_code(state: str | None) -> int:
    if state is None:
        return -1
    return LIGHT_STATE_CODE[_one_of("state of a traffic light", state, LIGHT_STATES)]


def _mask_of(lights: Iterable[str] | None) -> int:
    if lights is None:
        return -1
    mask = 0
    for name in lights:
        mask |= 1 << VEHICLE_LIGHTS.index(_one_of("light of a vehicle", name, VEHICLE_LIGHTS))
    return mask


def _one_of(what: str, name: str, known: Sequence[str]) -> str:
    if name in known:
        return name
    like = suggestion(name, known)
    hint = f"did you mean {like!r}?" if like else f"known: {', '.join(known)}"
    raise ValueError(f"unknown {what} {name!r}; {hint}")


def replayed(blocks: Iterable[FrameBlock], recorded: Iterable[str] = ()) -> Iterator[Frame]:
    """Yield the frames of a recording in order, with their events, as input of the online generator.

    Parameters
    ----------
    blocks : iterable of FrameBlock
        All blocks of a trace.
    recorded : iterable of str
        Kinds of events that the recording contains from the start. Other kinds count from their first event on.

    Yields
    ------
    Frame
        The last frame of a block comes after the next block is read, because later events may belong to it.
    """
    replay, known = Replay(), set(recorded)
    last: list[Frame] = []
    clock, waiting = np.zeros((2, 0), np.int64), list["Event"]()
    for block in blocks:
        clock = np.hstack([clock[:, -1:], np.stack([block.time_ns, block.log_time_ns])])
        waiting += block.events
        places = nearest_frames(waiting, *clock).tolist()
        happened: list[list[Event]] = [[] for _ in clock[0]]
        for event, place in zip(waiting, places, strict=True):
            happened[place].append(event)
        waiting = happened[-1]
        for events, frame in zip(happened, chain(last, replay.frames(block)), strict=True):
            last = [frame]
            if events is not waiting:
                yield _recording(frame, events, known)
    for frame in last:
        yield _recording(frame, waiting, known)


def _recording(frame: Frame, events: Iterable[Event], known: set[str]) -> Frame:
    """Return a frame with its events added. Add the kinds of these events to ``known``."""
    frame.events += [(event.kind, event.ident, event.other) for event in events]
    known.update(kind for kind, _, _ in frame.events)
    frame.recorded = frozenset(known)
    return frame


class Replay:
    """Converter from blocks of recorded frames to single :class:`Frame` objects.

    The frames are the same as those of a client at the simulator. Memory grows with the number of distinct
    entities, as for any reader.
    """

    def __init__(self) -> None:
        self._known: list[tuple[str, int, str, str, str, bool, str]] = []
        self._trailers: list[str] = []

    def frames(self, block: FrameBlock) -> Iterator[Frame]:
        """Yield each frame of the next block of a recording, with unchanged values."""
        new = block.entities
        columns = (new.ident, new.kind.tolist(), new.special, new.subkind, new.type_name)
        columns = (*columns, new.static.tolist(), new.map_ref)
        self._known += zip(*columns, strict=True)
        self._trailers += new.trailer or [""] * len(new)
        standing = self._entities(block.scenery, 0, len(block.scenery))
        for row, (time, ego) in enumerate(
            zip(block.time_ns.tolist(), block.ego.tolist(), strict=True)
        ):
            frame = Frame(time, self._known[ego][0] if ego >= 0 else None)
            start, stop = block.offsets[row : row + 2].tolist()
            there = self._entities(block.states, start, stop)
            if standing:  # In the order of the node ids, so that a client assigns the same ids.
                nodes = [*block.scenery.node.tolist(), *block.states.node[start:stop].tolist()]
                order = np.argsort(nodes, kind="stable").tolist()
                there = [(*standing, *there)[i] for i in order]
                standing = []
            frame.entities, frame.noise = there, block.noise
            yield frame

    def _entities(self, states: States, start: int, stop: int) -> list[Entity]:
        numbers = np.stack([getattr(states, name)[start:stop] for name in NUMBERS], axis=1)
        whole = np.stack([getattr(states, name)[start:stop] for name in WHOLE], axis=1)
        return [
            Entity(
                *self._known[node],
                numbers=tuple(values),
                whole=tuple(codes),
                trailer=self._trailers[node],
                own=own,
                node=node,
            )
            for node, values, codes, own in zip(
                states.node[start:stop].tolist(),
                numbers.tolist(),
                whole.tolist(),
                states.own[start:stop].tolist(),
                strict=True,
            )
        ]


# Graph of one frame as records: the same as from a store, plus each entity's own id.

TRACE: Final = "online"
"""Trace name of the graphs in online mode."""

_BOX: Final = ("x", "y", "z", "length", "width", "height")
_MOTION: Final = ("vx", "vy", "vz", "ax", "ay", "az")
_STILL: Final = dict.fromkeys(("speed", "vx", "vy", "vz"), 0.0)
"""Velocities of static entities: all zero."""
_DERIVED: Final = ("derived_velocity", "derived_acceleration", "derived_yaw_rate")
_MAP_TEXTS: Final = ("name", "lane_type", "road", "junction", "turn")
_MAP_NUMBERS: Final = ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature")


class EntityConstants(NamedTuple):
    """Constant attributes of an object, such as id, kind and type name."""

    node: int
    ident: str
    kind: str
    special: str
    subkind: str
    type_name: str = ""
    lifetime: int = 1

    def attributes(self, *, is_ego: bool, is_static: bool) -> Attributes:
        """Return the constant attributes of an object as node attributes of a scene graph."""
        texts = {name: getattr(self, name) for name in ("type_name", "special", "subkind")}
        return {
            "kind": self.kind,
            "name": f"{self.kind} {self.node}",
            "ident": self.ident,
            "is_ego": is_ego,
            "is_static": is_static,
            "lifetime": self.lifetime,
            **{name: text for name, text in texts.items() if text},
        }


class Records:
    """Converter from blocks of graphs, stored as columns, to single scene graphs.

    Parameters
    ----------
    road_map : RoadMap or None
        The map of the graphs. The attributes of a map node are collected at its first use.
    """

    def __init__(self, road_map: RoadMap | None) -> None:
        self._standing: dict[int, Attributes] = {}
        self._map: MapRecords | None = None
        if road_map is not None:
            edges = road_map.edges
            about = cache(partial(_map_node, road_map))
            along = road_map.places.rows(), road_map.courses.rows()
            reach = LaneDistances(*road_map.reach, *along, road_map.links())
            self._map = MapRecords(about, edges.src, edges.relation, edges.dst, reach)

    def stand(self, known: EntityConstants, states: States, row: int) -> None:
        """Remember the attributes of a static object: a recording contains the object's pose only once."""
        numbers = {name: float(getattr(states, name)[row]) for name in _BOX}
        numbers["heading"] = float(np.degrees(wrapped(states.heading[row])))
        about = known.attributes(is_ego=False, is_static=True)
        self._standing[known.node] = about | _numbers(numbers) | _STILL

    def graph(
        self, graph: GraphBlock, outer: Ints, known: dict[int, EntityConstants]
    ) -> SceneGraph:
        """Convert a block of one frame to a scene graph.

        Parameters
        ----------
        graph : GraphBlock
            Of one frame.
        outer : int64
            Node id of the block → node id of the records. Map nodes keep their ids.
        known : dict
            Node id of the records → entity, for all moving entities of the frame.
        """
        found = self._graph(graph, (graph,), graph.edges, outer, known)
        excluded = frozenset(KINDS[code] for code, _ in graph.left_out.excluded)
        found = replace(found, out_of_world=graph.left_out.beyond_world, excluded=excluded)
        if (world := graph.world) is None:
            return found

        def around() -> SceneGraph:
            edges = graph.edges.differing(world.edges)
            return self._graph(graph, (graph, world), edges, outer, known)

        return replace(found, around=cache(around))

    def _graph(
        self,
        graph: GraphBlock,
        parts: Sequence[GraphBlock | WorldBlock],
        edges: Edges,
        outer: Ints,
        known: dict[int, EntityConstants],
    ) -> SceneGraph:
        """Return the scene graph of one frame, with or without the objects outside its range."""
        frames = graph.frames
        states = chained([part.frames.states for part in parts])
        presence = chained([part.presence for part in parts])
        ego = int(outer[frames.ego[0]]) if frames.ego[0] >= 0 else None
        node = outer[states.node]
        moving = [
            known[one].attributes(is_ego=one == ego, is_static=False) | told
            for one, told in zip(node.tolist(), _moving(states), strict=True)
        ]
        for row in np.flatnonzero(states.carrier >= 0).tolist():
            moving[row]["carrier"] = int(outer[states.carrier[row]])
        src, dst = _outward(edges.src, outer), _outward(edges.dst, outer)
        columns = SceneColumns(
            trace=TRACE,
            frame_id=frames.seq,
            seq=frames.seq,
            time_ns=frames.time_ns,
            ego=[ego],
            moving=(np.zeros_like(node), node, moving),
            presence=StaticPresence(presence.frame, _outward(presence.node, outer)),
            standing=self._standing,
            edges=Edges(edges.frame, edges.relation, src, dst),
            about=edge_attributes(
                chain.from_iterable(
                    _lanes(part.lanes, part.frames.states, outer) for part in parts
                ),
                chain.from_iterable(_gaps(part.gaps, outer) for part in parts),
            ),
            map=self._map,
        )
        unsure = frozenset(outer[states.node[states.lane > 0]].tolist())
        lead = frozenset(outer[parts[-1].unsure].tolist())
        return replace(next(columns.graphs()), unsure_lane=unsure, unsure_lead=lead)


def _map_node(road_map: RoadMap, node: int) -> Attributes:
    """Return the attributes of a road map node in a scene graph."""
    nodes, row = road_map.nodes, -1 - node
    texts = {name: getattr(nodes, name)[row] for name in _MAP_TEXTS}
    numbers = {name: float(getattr(nodes, name)[row]) for name in _MAP_NUMBERS}
    # A store has 32 bits for these numbers.
    numbers |= {
        name: float(np.float32(numbers[name])) for name in ("length", "width", "speed_limit")
    }
    numbers["heading"] = math.degrees(numbers["heading"])
    about: Attributes = {"kind": KINDS[nodes.kind[row]], "is_ego": False, "is_static": True}
    about |= road_map.own.get(row, {})
    about |= {name: text for name, text in texts.items() if text} | _numbers(numbers)
    if about["kind"] not in MAP_KINDS:
        about |= _STILL
    if nodes.lane_type[row]:
        about |= {"section": int(nodes.section[row]), "lane": int(nodes.lane[row])}
    return about


def _moving(states: States) -> list[Attributes]:
    """Return the node attributes of each object state, in output units (degrees, m/s)."""
    columns: dict[str, Floats] = {
        name: getattr(states, name) for name in (*_BOX, *_MOTION, *INPUTS[:3])
    }
    columns["heading"] = np.degrees(wrapped(states.heading))
    columns |= {name: np.degrees(getattr(states, name)) for name in ("pitch", "roll", "yaw_rate")}
    speed = np.sqrt(states.vx**2 + states.vy**2 + np.nan_to_num(states.vz) ** 2)
    columns["speed"] = number(speed).astype(np.float64)
    columns["accel"] = states.ax * np.cos(states.heading) + states.ay * np.sin(states.heading)
    names = tuple(columns)
    table = np.stack([columns[name] for name in names], axis=1)
    known = np.isfinite(table).tolist()
    whole = [states.lights, states.light_state, states.derived, states.gear, states.hand_brake]
    codes = zip(*(column.tolist() for column in whole), strict=True)
    return [
        (own or {})
        | {name: value for name, value, told in zip(names, row, is_known, strict=True) if told}
        | _coded(*whole)
        for row, is_known, whole, own in zip(
            table.tolist(), known, codes, states.own.tolist(), strict=True
        )
    ]


def _coded(lights: int, light: int, derived: int, gear: float, hand_brake: float) -> Attributes:
    """Convert codes to node attributes: vehicle lights, derived values, gear and hand brake."""
    about: Attributes = {}
    if lights >= 0:
        about |= {name: bool(lights >> bit & 1) for bit, name in enumerate(VEHICLE_LIGHTS)}
    if light >= 0:
        about["light_state"] = LIGHT_STATES[light]
    if not math.isnan(gear):
        about["gear"] = int(gear)
    if not math.isnan(hand_brake):
        about["hand_brake"] = bool(hand_brake)
    names = (*_DERIVED, *NOISE_MARKS) if derived & SMOOTHED else _DERIVED
    return about | {name: bool(derived >> bit & 1) for bit, name in enumerate(names)}


def _lanes(
    lanes: LaneStates, states: States, outer: Ints
) -> Iterator[tuple[int, int, int, Attributes]]:
    """Yield frame, source, target and attributes of each ``isIn`` edge (object on a lane).

    While the driven lane is unsure, ``is_primary`` and ``is_own`` are unknown.
    """
    unsure = np.isin(lanes.node, states.node[states.lane > 0])
    told = (lanes.overlap, lanes.offset, lanes.heading_error, lanes.along)
    columns = (
        *(lanes.frame.tolist(), _outward(lanes.node, outer).tolist(), lanes.lane.tolist()),
        *(number(column).tolist() for column in told),
        *(lanes.primary.tolist(), lanes.own.tolist(), unsure.tolist()),
    )
    for frame, node, lane, overlap, offset, error, along, primary, own, either in zip(
        *columns, strict=True
    ):
        numbers = {
            "overlap": overlap,
            "lane_offset": offset,
            "heading_error": math.degrees(error),
            "along": along,
        }
        known: Attributes = {} if either else {"is_primary": primary, "is_own": own}
        yield frame, node, lane, _numbers(numbers) | known


def _gaps(gaps: LaneGaps, outer: Ints) -> Iterator[tuple[int, int, int, Attributes]]:
    """Yield frame, source, target and attributes (gap) of each ``follows`` edge."""
    src, dst = _outward(gaps.src, outer).tolist(), _outward(gaps.dst, outer).tolist()
    for frame, a, b, gap in zip(
        gaps.frame.tolist(), src, dst, number(gaps.gap).tolist(), strict=True
    ):
        yield frame, a, b, _numbers({"gap": gap})


def _outward(nodes: Whole, outer: Ints) -> Ints:
    """Replace the node ids of a block by the ids that the returned scene graphs use."""
    return np.where(nodes >= 0, outer[np.maximum(nodes, 0)], nodes)


def _numbers(values: dict[str, float]) -> Attributes:
    return {name: value for name, value in values.items() if math.isfinite(value)}


# Online generation in bounded memory.
# Node ids are assigned in the order of appearance and never used twice. The tables of a generator grow with
# every new entity. The generator is therefore replaced after most of its entities are gone. Its tables only
# save work, so the graphs do not change. An absent entity is forgotten after :data:`REMEMBERED` other
# entities; if it returns, it is a new entity.

REMEMBERED: Final = 20_000
"""Largest number of absent entities whose ids stay known; about 5 MB."""

SPARE: Final = 2048
"""Number of absent entities above which a new generator replaces the current one."""


class Generator(Protocol):
    """Interface of a scene graph generator that processes blocks of frames."""

    @property
    def kinds(self) -> Codes:
        """Kinds of all objects so far, as codes by node id."""
        ...

    def blocks(self, frames: FrameBlock, egos: Sequence[Ints]) -> list[GraphBlock]:
        """Return the graphs of the next frames as columns: one block of graphs for each ego."""
        ...


class Stepper:
    """Online generator of scene graphs: each call takes one frame, and returns its graphs.

    Parameters
    ----------
    make : callable
        Makes a new generator.
    road_map : RoadMap or None
        The map of the graphs.
    driven : DrivenLanes
        Choice of the lanes that vehicles drive in junctions.
    ego : str
        Default ego for frames without an ego.
    noise : float
        Noise of the positions, as in the settings; m.

    Attributes
    ----------
    last : tuple or None
        The last graphs as blocks, and the kinds of their entities by the blocks' node ids.
    faults : FaultTally
        Implausible sizes and speeds in the frames.
    """

    def __init__(
        self,
        make: Callable[[], Generator],
        road_map: RoadMap | None,
        driven: DrivenLanes,
        ego: str = "",
        noise: float = 0.0,
    ) -> None:
        self._make, self._driven = make, driven
        self._noise = ClientNoise(noise)
        self._generator = make()
        self._ego = ego
        self._records = Records(road_map)
        self._seq = 0
        self._origin: Origin | None = None
        self.last: tuple[list[GraphBlock], Codes] | None = None
        self._next = 0
        # Entities that move, by their id; those of the last frame at the end.
        self._moving: OrderedDict[str, Lives[EntityConstants]] = OrderedDict()
        self.faults = FaultTally()
        self._time_ns: int | None = None
        self._run = 0  # Run of the clock; a backward step starts the next run.
        self._standing: dict[str, tuple[Entity, EntityConstants]] = {}
        # Node id → node id inside the current generator, and the inverse.
        self._inner: dict[int, int] = {}
        self._introduced = 0
        self._outer: Ints = np.zeros(64, np.int64)

    def step(self, frame: Frame, egos: Sequence[str]) -> list[SceneGraph]:
        """Return the scene graphs of the next frame, one per ego.

        Parameters
        ----------
        frame : Frame
        egos : sequence of str
            Ids of the egos. An empty id means the ego of the frame, else that of the config.
        """
        moving, new = self._met(frame)
        if self._introduced > 2 * (len(moving) + len(self._standing)) + SPARE:
            self._generator, self._inner, self._introduced = self._make(), {}, 0
            new = [entity for entity, _ in self._standing.values()]
        block = self._block(frame, moving, new)
        outer = self._outer[block.states.node]
        block = self._driven.now(self._kept(self._noise.smoothed(block, outer)), outer)
        for row, entity in enumerate(new):
            self._records.stand(self._standing[entity.ident][1], block.scenery, row)
        here = {entity.ident for entity in moving}
        named = (ego or frame.ego or self._ego for ego in egos)
        nodes = [
            self._inner[self._moving[ego].last.entity.node] if ego in here else -1 for ego in named
        ]
        self.last = None  # Free the previous graphs, which are large for a crowd.
        graphs = self._generator.blocks(block, [np.array([node]) for node in nodes])
        self._seq += 1
        self.last = graphs, self._generator.kinds
        while len(self._moving) > len(moving) + REMEMBERED:
            _, lives = self._moving.popitem(last=False)
            for life in (lives.last, *lives.left):
                self._inner.pop(life.entity.node, None)
        constants = [self._moving[entity.ident].last.entity for entity in moving]
        known = {one.node: one for one in constants}
        happened = self._happened(frame)
        with GcPaused():
            found = [self._records.graph(graph, self._outer, known) for graph in graphs]
            return [replace(one, events=happened, topics=frame.topics) for one in found]

    def _happened(self, frame: Frame) -> dict[str, list[tuple[int | None, int | None]]]:
        """Return the events of a frame by kind, with node ids. Earlier kinds have at least an empty list."""
        found: dict[str, list[tuple[int | None, int | None]]] = {k: [] for k in frame.recorded}
        for kind, *idents in frame.events:
            a, b = (self._node_of(ident) for ident in idents)
            found.setdefault(kind, []).append((a, b))
        return found

    def _node_of(self, ident: str) -> int | None:
        if ident in self._standing:
            return self._standing[ident][1].node
        return self._moving[ident].last.entity.node if ident in self._moving else None

    def _met(self, frame: Frame) -> tuple[list[Entity], list[Entity]]:
        """Return the moving objects of a frame, and its new static objects, with node ids assigned.

        All checks come first: a rejected frame changes nothing.
        """
        check_entities(frame, self._is_static)
        if self._time_ns is not None and frame.time_ns < self._time_ns:
            self._run += 1
        self._time_ns = frame.time_ns
        for ident, words in frame.losses:
            self.faults.add(ident, words)
        moving = {entity.ident: entity for entity in frame.entities if not entity.static}
        new: dict[str, Entity] = {}
        for entity in frame.entities:
            if entity.static and entity.ident not in self._standing:
                new.setdefault(entity.ident, entity)
        # Same node ids as for a recording: first the new ids, then the ids that have returned.
        for entity in frame.entities:
            if entity.ident not in self._moving and entity.ident not in self._standing:
                known = self._enter(entity)
                if entity.ident in new:
                    self._standing[entity.ident] = entity, known
                else:
                    self._moving[entity.ident] = Lives(Life(known, entity.kind))
        for entity in moving.values():
            self._follow(entity, frame.time_ns)
        return list(moving.values()), list(new.values())

    def _is_static(self, ident: str) -> bool | None:
        if ident in self._standing:
            return True
        return False if ident in self._moving else None

    def _enter(self, entity: Entity, lifetime: int = 1) -> EntityConstants:
        texts = entity.special, entity.subkind, entity.type_name
        is_free = entity.node >= 0 and entity.node not in self._inner
        node = entity.node if is_free else self._next
        self._next = max(self._next, node + 1)
        return EntityConstants(node, entity.ident, KINDS[entity.kind], *texts, lifetime)

    def _follow(self, entity: Entity, time_ns: int) -> None:
        """Record the position of an object. If the id belonged to another object before, it is a new object."""
        lives = self._moving[entity.ident]
        place = (_NAN,) * 3 if entity.whole[_LIGHT] >= 0 else entity.numbers[:3]
        here = Sight(place, time_ns, self._run)
        lives.follow(entity.kind, here, partial(self._enter, entity, lives.count + 1))
        self._moving.move_to_end(entity.ident)

    def _block(self, frame: Frame, moving: list[Entity], standing: list[Entity]) -> FrameBlock:
        """Convert a single frame to a :class:`FrameBlock`, with node ids."""
        first = self._introduced
        new = [*standing, *(e for e in moving if self._node(e) not in self._inner)]
        self._introduced += len(new)
        while self._introduced > len(self._outer):
            self._outer = np.concatenate([self._outer, self._outer])
        for inner, entity in enumerate(new, start=first):
            self._outer[inner] = node = self._node(entity)
            self._inner[node] = inner
        time, none = np.array([frame.time_ns]), np.zeros(0, np.int64)
        return FrameBlock(
            seq=np.array([self._seq]),
            time_ns=time,
            log_time_ns=time,
            offsets=np.array([0, len(moving)]),
            states=self._states(moving),
            ego=np.array([-1]),  # The ego is passed separately.
            entities=entities_of(first, new),
            scenery=self._states(standing),
            messages=MessageRefs(none, none, none, none, none),
            noise=frame.noise,
        )

    def _kept(self, block: FrameBlock) -> FrameBlock:
        """Round the values of a block of frames as a store does."""
        self._origin = self._origin or origin_of(block)
        return quantize(block, self._origin or Origin(0.0, 0.0, 0.0))

    def _node(self, entity: Entity) -> int:
        if entity.static:
            return self._standing[entity.ident][1].node
        return self._moving[entity.ident].last.entity.node

    def _states(self, of: list[Entity]) -> States:
        numbers = np.array([e.numbers for e in of], np.float64).reshape(-1, len(NUMBERS))
        whole = np.array([e.whole for e in of], np.int64).reshape(-1, len(WHOLE))
        lights, light_state, derived = whole.T
        return States.of(
            node=np.array([self._inner[self._node(e)] for e in of], np.int64),
            lights=lights,
            light_state=light_state.astype(np.int8),
            derived=derived,
            own=own_column([e.own for e in of]),
            **{name: numbers[:, i] for i, name in enumerate(NUMBERS)},
        )


def check_entities(frame: Frame, is_static: Callable[[str], bool | None]) -> None:
    """Raise an error if a frame has contradictory objects, or objects that contradict earlier frames.

    Parameters
    ----------
    frame : Frame
    is_static : callable
        Returns for an id: True if the known entity is static, False if it moves, None for an unknown id.

    Raises
    ------
    ValueError
        Two entities have the same id, or a moving entity is now static, or a static one moves.
    """
    here: dict[str, Entity] = {}
    for entity in frame.entities:
        ident, static = entity.ident, is_static(entity.ident)
        if ident in here and not (here[ident].static and entity.static):
            raise ValueError(f"two entities have the id {ident!r}")
        if static is not None and entity.static != static:
            now, before = ("is static", "moved") if entity.static else ("moves", "was static")
            raise ValueError(f"entity {ident!r} {before} before and {now} now")
        here[ident] = entity


class GcPaused:
    """Context manager that pauses Python's garbage collection.

    The records of a graph are thousands of small objects and no garbage. Python would scan them several times
    during their creation, and every few frames all objects of the client: 30 ms and more. Objects freed inside
    the context are never scanned, because Python counts the net growth.
    """

    def __enter__(self) -> None:
        self._running = gc.isenabled()
        gc.disable()

    def __exit__(self, *_exception: object) -> None:
        if self._running:
            gc.enable()


def entities_of(first: int, new: list[Entity]) -> Entities:
    """Return the table of new entities. ``first`` is the number of the first new entity."""
    names = ("ident", "special", "subkind", "type_name", "map_ref", "trailer")
    return Entities(
        first=first,
        kind=np.array([e.kind for e in new], np.int8),
        static=np.array([e.static for e in new], np.bool_),
        **{name: tuple(getattr(e, name) for e in new) for name in names},
    )
