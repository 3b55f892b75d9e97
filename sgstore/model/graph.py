"""Scene graphs as columns (for blocks of frames and the store), and as objects (for single frames)."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import starmap
from operator import eq, itemgetter
from typing import TYPE_CHECKING, Any, Final, TypeVar, overload

import numpy as np

from sgstore.base.tables import begins, taken
from sgstore.model.pair_numbers import UNEVEN
from sgstore.model.vocabulary import RELATION_CODE, RELATIONS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    import networkx as nx
    from numpy.typing import NDArray

    from sgstore.model.world import Codes, Floats, FrameBlock, Ints

    Places = Sequence[tuple[int, float]]
    Stretches = Sequence[tuple[int, float, float]]
    Whole = NDArray[np.signedinteger[Any]]
    Attributes = dict[str, Any]
    EdgeRecord = tuple[int, str, int, Attributes]

K = TypeVar("K")
Lane = TypeVar("Lane", int, tuple[int, int])
V = TypeVar("V")

IS_IN, LEADS, FOLLOWS = (RELATION_CODE[name] for name in ("isIn", "leads", "follows"))
"""Codes of the relations whose edges can have attributes (``isIn``, ``leads``, ``follows``)."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of scene graphs as columns, one row per edge and frame; shape (E,).

    Attributes
    ----------
    frame : int32 or int64
        Frame, counted in the block.
    relation : int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    src, dst : int32 or int64
        Node ids: 0 and above in the trace, below zero in the map.
    """

    frame: Whole
    relation: Codes
    src: Whole
    dst: Whole

    def __len__(self) -> int:
        return len(self.frame)

    def distinct(self) -> Edges:
        """Return the edges without duplicates, sorted by frame, source, relation and destination."""
        every, new = _ordered(self)
        return taken(every, new)

    def differing(self, other: Edges) -> Edges:
        """Return the edges that occur in only one of two edge tables."""
        every, new = _ordered(Edges.chained([self.distinct(), other.distinct()]))
        return taken(every, new & np.append(new[1:], True)[: len(new)])

    @classmethod
    def chained(cls, parts: Sequence[Edges]) -> Edges:
        """Concatenate tables of edges. Without any table, return an empty table."""
        none = np.empty(0, np.int8)
        parts = [cls(none, none, none, none), *parts]
        frame, src, dst = (
            np.concatenate(
                [getattr(part, name) for part in parts], dtype=np.int32, casting="same_kind"
            )
            for name in ("frame", "src", "dst")
        )
        return cls(frame, np.concatenate([part.relation for part in parts]), src, dst)


def _ordered(edges: Edges) -> tuple[Edges, NDArray[np.bool_]]:
    """Return the sorted edges, and a mask of the first of equal rows."""
    order = np.lexsort((edges.dst, edges.relation, edges.src, edges.frame))
    every = taken(edges, order)
    return every, begins(every.frame, every.src, every.relation, every.dst)


@dataclass(frozen=True, slots=True)
class LaneGaps:
    """Gaps along lanes between a following object and the object in front of it; shape (K,).

    Attributes
    ----------
    frame : int64
        Frame, counted in the block.
    src, dst : int64
        Node ids: src follows dst.
    gap : float64
        Bumper-to-bumper gap along the lanes; m. NaN means unknown.
    """

    frame: Ints
    src: Ints
    dst: Ints
    gap: Floats

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class StaticPresence:
    """Static nodes (static objects and map parts) in the graph of each frame: one row per node and frame; (M,).

    Attributes
    ----------
    frame : int64
        Frame, counted in the block.
    node : int64
        Node id; static entities of the trace (0 and above) and parts of the map (below zero).
    """

    frame: Ints
    node: Ints

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class LaneStates:
    """Positions of objects on lanes: attributes of ``isIn`` edges (overlap, offset, …); shape (K,).

    Attributes
    ----------
    frame : int64
        Frame, counted in the block.
    node, lane : int64
        Node ids of the entity and of the lane.
    overlap : float64
        Share of the footprint that lies in the lane, 0 … 1.
    offset : float64
        Lateral offset of the box's centre from the lane's centre line, positive to the left of the
        lane's direction; m.
    heading_error : float64
        Heading of the entity less the lane's direction, in (-π, π]; rad.
    primary : bool
        True for the primary lane: in a junction the driven lane, else by centre, heading and overlap.
    along : float64
        Position of the box centre along the lane's centre line, from the lane's start; m. It can lie beyond
        both ends.
    own : bool
        True for the lanes used for distances along the lanes: the primary lane and, in a junction, other lanes
        that contain the centre and (for a vehicle) have its direction.
    """

    frame: Ints
    node: Ints
    lane: Ints
    overlap: Floats
    offset: Floats
    heading_error: Floats
    primary: np.ndarray[Any, np.dtype[np.bool_]]
    along: Floats
    own: np.ndarray[Any, np.dtype[np.bool_]]

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class WorldBlock:
    """Nodes and edges outside the graphs of some frames, for queries about distant objects.

    Attributes
    ----------
    frames : FrameBlock
        Frames with the states outside the graphs.
    presence : StaticPresence
        Static entities and map elements outside the graphs.
    edges : Edges
        Differences of the edges ``isIn``, ``controlsTrafficOf``, ``leads`` and ``follows``: edges that exist
        only with, or only without, the data outside the graphs.
    lanes : LaneStates
        Attributes of the additional ``isIn`` edges.
    gaps : LaneGaps
        Gaps of the additional ``leads`` and ``follows`` edges.
    unsure : int64
        As in :class:`GraphBlock`, for all data around the ego.
    """

    frames: FrameBlock
    presence: StaticPresence
    edges: Edges
    lanes: LaneStates
    gaps: LaneGaps
    unsure: Ints


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Counts of recorded object states that the settings exclude from the graphs. Static objects do not count.

    Attributes
    ----------
    states : int
        Number of all states.
    beyond_radius, beyond_world : int
        Numbers of states out of the range of the graphs, and out of ``[range] world``.
    excluded : tuple of (int, int)
        Codes of the excluded kinds, and the number of states of each.
    """

    states: int = 0
    beyond_radius: int = 0
    beyond_world: int = 0
    excluded: tuple[tuple[int, int], ...] = ()

    def more(self, other: LeftOut) -> LeftOut:
        """Return the sum of two counts of excluded object states."""
        excluded = dict(self.excluded)
        for code, many in other.excluded:
            excluded[code] = excluded.get(code, 0) + many
        return LeftOut(
            self.states + other.states,
            self.beyond_radius + other.beyond_radius,
            self.beyond_world + other.beyond_world,
            tuple(sorted(excluded.items())),
        )


@dataclass(frozen=True, slots=True)
class GraphBlock:
    """Scene graphs of a block of consecutive frames, as columns.

    Attributes
    ----------
    frames : FrameBlock
        Frames with the states that are nodes of their graphs (in range).
    presence : StaticPresence
        Static nodes of each graph. A static map edge belongs to a graph if both its nodes are present.
    edges : Edges
        All other edges.
    lanes : LaneStates
        Attributes of the ``isIn`` edges from entities to lanes.
    gaps : LaneGaps
        Attributes of ``leads`` and ``follows`` edges.
    crowded : tuple of (str, int, int)
        Frames with too many pairs (:mod:`sgstore.graphs.relations._pairs`): kind of the pairs, frame index in
        the block, and number of bodies.
    world : WorldBlock or None
        Data outside the graphs. ``None`` means that the settings exclude such data.
    left_out : LeftOut
        Counts of the excluded states.
    uneven : int
        Special pairs of bodies in the block: bits of :data:`sgstore.model.pair_numbers.UNEVEN`.
    unsure : int64
        Online: node ids of vehicles without a known next vehicle ahead, because a driven lane is not sure.
    """

    frames: FrameBlock
    presence: StaticPresence
    edges: Edges
    lanes: LaneStates
    gaps: LaneGaps
    crowded: tuple[tuple[str, int, int], ...] = ()
    world: WorldBlock | None = None
    left_out: LeftOut = LeftOut()
    uneven: int = sum(UNEVEN.values())
    unsure: Ints = field(default_factory=partial(np.zeros, 0, np.int64))

    def __len__(self) -> int:
        return len(self.frames)


def graph_of_records(
    nodes: Iterable[Mapping[str, Any]], edges: Iterable[Mapping[str, Any]], **about: Any
) -> nx.MultiDiGraph[Any]:
    """Return a ``networkx.MultiDiGraph`` from records of nodes and edges (node-link format).

    Parameters
    ----------
    nodes : iterable of mappings
        ``id`` and attributes.
    edges : iterable of mappings
        ``source``, ``target``, ``relation`` (also the key), and attributes.
    **about
        Attributes of the graph.
    """
    import networkx as nx  # imports in half a second: only on demand

    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph(**about)
    for node in nodes:
        graph.add_node(node["id"], **{k: v for k, v in node.items() if k != "id"})
    for edge in edges:
        known = {k: v for k, v in edge.items() if k not in {"source", "target"}}
        graph.add_edge(edge["source"], edge["target"], key=edge["relation"], **known)
    return graph


def named_graph(
    nodes: Mapping[str, str], edges: Iterable[tuple[str, str, str]], **about: Any
) -> nx.MultiDiGraph[str]:
    """Return a ``networkx.MultiDiGraph`` from labels of nodes and named edges, as in the literature.

    Parameters
    ----------
    nodes : mapping of str to str
        Name → label.
    edges : iterable of (str, str, str)
        Source, label, destination.
    **about
        Attributes of the graph.

    Returns
    -------
    networkx.MultiDiGraph
        Names as nodes, with the attributes ``name`` and ``base_class``; edges with the attribute ``label``,
        which is also the key if it occurs once between two nodes.
    """
    import networkx as nx  # imports in half a second: only on demand

    graph: nx.MultiDiGraph[str] = nx.MultiDiGraph(**about)
    for name, label in nodes.items():
        graph.add_node(name, name=name, base_class=label)
    for src, label, dst in edges:
        again = graph.has_edge(src, dst, key=label)
        key = f"{label} {graph.number_of_edges(src, dst)}" if again else label
        graph.add_edge(src, dst, key=key, label=label)
    return graph


def _grouped(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """Group pairs by key: key → its values, in the order of the pairs."""
    found: dict[K, list[V]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


MOST_PARTS: Final = 256
"""Largest number of parts of a map that count as one lane, because the number of their pairs is its square."""


def lane_chains(links: Iterable[tuple[Lane, Lane, bool]]) -> dict[Lane, Lane]:
    """Return the lanes that continue as one lane, each with the greatest id in its chain.

    A map has a lane in several parts, such as lane sections. A chain ends where a junction begins or ends, and
    where a lane has several next lanes or several previous lanes. It has at most :data:`MOST_PARTS` lanes.

    Parameters
    ----------
    links : iterable of (lane, lane, bool)
        Lanes, their next lanes, and true if both are in one junction or in none.

    Examples
    --------
    >>> lane_chains([(-2, -3, True), (-3, -4, True), (-4, -5, True), (-4, -6, True)])
    {-2: -2, -3: -2, -4: -2}
    """
    links = list(links)
    leaving, coming = (Counter(link[end] for link in links) for end in (0, 1))
    onward = {a: b for a, b, inside in links if inside and leaving[a] == coming[b] == 1}
    chains: dict[Lane, Lane] = {}
    for lane in [*sorted(onward.keys() - onward.values()), *onward]:  # a ring has no first lane
        members: list[Lane] = []
        at: Lane | None = lane
        while at is not None and at not in chains:
            chains[at] = at
            members.append(at)
            at = onward.get(at)
        for first in range(0, len(members), MOST_PARTS):
            part = members[first : first + MOST_PARTS]
            chains |= dict.fromkeys(part, max(part))
    return chains


class LaneDistances:
    """Distances along the lanes of a map, between lanes and to map parts. Also curvature and slope.

    Parameters
    ----------
    lane, other : (n,) int64
        Node ids of lanes. A pair repeats if several routes connect its lanes.
    start : (n,) float64
        Start of ``other``, along the lanes from the start of ``lane``; m. Negative if the route leads from
        ``other`` to ``lane``.
    parts : iterable of (int, str, int, float, float)
        Map elements: node id, kind, lane, and start and end along the lane; m.
    courses : iterable of (int, float, float, float)
        Stretches of lanes, each up to the next: lane, start (m), curvature (1/m) and slope. NaN or ``None``
        means an unknown slope.
    links : iterable of (int, int, bool)
        Lanes, their next lanes, and true if both are in one junction or in none.
    """

    FARTHEST: Final = 200.0
    """Longest distance along lanes that is computed; m. The view ``pairs`` has the same limit."""

    def __init__(
        self,
        lane: Ints,
        other: Ints,
        start: Floats,
        parts: Iterable[tuple[int, str, int, float, float]] = (),
        courses: Iterable[tuple[int, float, float, float | None]] = (),
        links: Iterable[tuple[int, int, bool]] = (),
    ) -> None:
        places = [part for part in parts if not part[1].startswith("{")]  # others are attributes
        self._columns, self._parts = (lane, other, start), tuple(places)
        self._courses, self._links = tuple(courses), links

    @cached_property
    def _chains(self) -> dict[int, int]:
        return lane_chains(self._links)

    def chain(self, lane: int) -> int:
        """Return the number of the chain of lanes that a lane belongs to: see :func:`lane_chains`."""
        return self._chains.get(lane, lane)

    @cached_property
    def _starts(self) -> dict[tuple[int, int], list[float]]:
        rows = zip(*(column.tolist() for column in self._columns), strict=True)
        return _grouped(((lane, other), start) for lane, other, start in rows)

    @cached_property
    def _onward(self) -> dict[int, list[tuple[int, float]]]:
        every = self._starts.items()
        ways = ((lane, (other, start)) for (lane, other), starts in every for start in starts)
        return _grouped(way for way in ways if way[1][1] >= 0)

    @cached_property
    def _of_parts(self) -> dict[int, list[tuple[int, float, float]]]:
        return _grouped((node, (lane, start, end)) for node, _, lane, start, end in self._parts)

    @cached_property
    def _on_lanes(self) -> dict[tuple[str, int], list[tuple[float, float]]]:
        return _grouped(((what, lane), (start, end)) for _, what, lane, start, end in self._parts)

    @cached_property
    def _of_lanes(self) -> dict[int, list[tuple[float, float, float | None]]]:
        """Intervals of each lane with constant curvature: start (m), curvature (1/m) and slope of each."""
        found: dict[int, list[tuple[float, float, float | None]]] = {}
        for lane, start, curvature, slope in self._courses:
            known = None if slope is None or math.isnan(slope) else slope
            found.setdefault(lane, []).append((start, curvature, known))
        for stretches in found.values():
            stretches.sort(key=itemgetter(0))
        return found

    def tells(self, what: str) -> bool:
        """Return True if the map has some data: ``ways`` (lane connections), ``curvature`` or ``slope``."""
        return what in self._told

    @cached_property
    def _told(self) -> frozenset[str]:
        ways, curved = len(self._columns[0]) > 0, bool(self._of_lanes)
        sloped = any(slope is not None for of in self._of_lanes.values() for *_, slope in of)
        known = {"ways": ways, "curvature": curved, "slope": sloped}
        return frozenset(what for what, is_known in known.items() if is_known)

    def course(self, lane: int, along: float) -> tuple[float | None, float | None]:
        """Return curvature (1/m) and slope of a lane at a position along it. Each is ``None`` if unknown."""
        stretches = self._of_lanes.get(lane, ())
        if not stretches:
            return None, None
        return stretches[bisect_right(stretches, max(along, 0.0), key=itemgetter(0)) - 1][1:]

    def stretches(self, node: int) -> Stretches:
        """Return the lanes on which a map part lies, with its start and end along each lane; m."""
        return self._of_parts.get(node, ())

    def stretches_of(self, what: str, lane: int) -> Sequence[tuple[float, float]]:
        """Return start and end along a lane for each map part of a kind (such as crosswalk); m."""
        return self._on_lanes.get((what, lane), ())

    def distance(self, one: Places, other: Places) -> float | None:
        """Return the distance along lanes between two objects; m. ``None`` if no lanes connect them."""
        ends = ([(lane, along, along) for lane, along in places] for places in (one, other))
        return self.between(*ends)

    def between(self, one: Stretches, other: Stretches) -> float | None:
        """Return the gap along lanes between two lane intervals; m. ``None`` if no lanes connect them.

        Overlap gives 0; a stretch behind is negative.
        """
        ahead, behind = math.inf, -math.inf
        for lane, first, last in one:
            for to, start, end in other:
                for way in self._starts.get((lane, to), ()):
                    if (far := way + (start - last)) >= 0:
                        ahead = min(ahead, far)
                    elif (back := way + (end - first)) < 0:
                        behind = max(behind, back)
                    else:
                        ahead = 0.0
        nearest = ahead if ahead <= -behind else behind
        return nearest if abs(nearest) <= self.FARTHEST else None

    def next(self, one: Stretches, what: str) -> float | None:
        """Return the distance along lanes to the next map part of a kind (such as crosswalk); m. 0 on it."""
        found = math.inf
        for lane, first, last in one:
            for to, way in self._onward.get(lane, ()):
                for start, end in self.stretches_of(what, to):
                    if way + (end - first) >= 0:
                        found = min(found, max(way + (start - last), 0.0))
        return found if found <= self.FARTHEST else None


class EdgeColumns(Sequence["EdgeRecord"]):
    """Edges of one scene graph, stored as columns. An edge object is created only on access.

    A record takes about 250 bytes, a row ten. The object equals any sequence of the same records.

    Parameters
    ----------
    src, dst : (n,) int
        Node ids.
    relation : (n,) int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    about : dict
        Row → attributes, for rows with attributes.
    """

    AT_ONCE: Final = 4096
    """Number of rows that are converted to objects at once during iteration."""

    def __init__(
        self, src: Whole, relation: Codes, dst: Whole, about: Mapping[int, dict[str, Any]]
    ) -> None:
        self._src, self._relation, self._dst = src, relation, dst
        self._about = about

    def __len__(self) -> int:
        return len(self._src)

    def __iter__(self) -> Iterator[EdgeRecord]:
        for first in range(0, len(self), self.AT_ONCE):
            yield from self[first : first + self.AT_ONCE]

    @overload
    def __getitem__(self, index: int) -> EdgeRecord: ...

    @overload
    def __getitem__(self, index: slice) -> list[EdgeRecord]: ...

    def __getitem__(self, index: int | slice) -> EdgeRecord | list[EdgeRecord]:
        rows = range(len(self))[index]
        if isinstance(rows, int):
            return self[rows : rows + 1][0]
        codes: list[int] = self._relation[index].tolist()
        ends = (self._src[index].tolist(), self._dst[index].tolist())
        return [
            (src, RELATIONS[code], dst, self._about.get(row, {}))
            for code, src, dst, row in zip(codes, *ends, rows, strict=True)
        ]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, (EdgeColumns, list, tuple)):
            return NotImplemented
        return len(self) == len(other) and all(starmap(eq, zip(self, other, strict=True)))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<{len(self):,} edges>"


@dataclass(frozen=True, slots=True, repr=False)
class SceneGraph:
    """Scene graph of one frame: nodes (objects, map parts), edges (relations) and the ego.

    Attributes
    ----------
    frame_id : int
    trace : str
        Name of the trace.
    seq, time_ns : int
    ego : int or None
        Node id of the ego.
    nodes : dict
        Node id → attributes in outward units (m, s, m/s, degrees): ``kind``, ``name``, ``is_ego``, and all
        known attributes (``x``, ``y``, ``heading``, ``speed``, ``light_state``, …). Unknown attributes are
        absent.
    edges : sequence of tuple
        ``(src, relation, dst, attributes)``. A list, or online with more than 65,536 edges an
        :class:`EdgeColumns`.
    reach : LaneDistances, optional
        Lane distances of the map. Without them, distances along lanes are unknown.
    events : mapping of str to sequence of pairs
        Events of the frame: kind → pairs of entity and other entity. A missing kind means that the trace does
        not record it.
    topics : mapping of str to message
        Online: messages of the frame by topic; see :attr:`sgstore.Frame.topics`.
    around : callable, optional
        Function that returns the graph with all known data around it; see :meth:`known`.
    out_of_world : int
        Online: number of entities out of ``[range] world``, and so unknown.
    excluded : frozenset of str
        Online: kinds in the frame that the settings exclude.
    unsure_lane : frozenset of int
        Online: vehicles in junctions whose driven lane later frames decide.
    unsure_lead : frozenset of int
        Online: vehicles with a next vehicle ahead that depends on such a lane.

    Examples
    --------
    >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
    >>> frame = sgstore.Frame(0, ego="hero")
    >>> frame.add("hero", "car", 0, 0, heading=0)
    >>> frame.add("p7", "person", 6, 1)
    >>> graph = generator.step(frame)
    >>> [(src, relation, dst) for src, relation, dst, _ in graph.edges if src == graph.ego]
    [(0, 'super_near', 1), (0, 'sees', 1)]
    """

    frame_id: int
    trace: str
    seq: int
    time_ns: int
    ego: int | None
    nodes: dict[int, dict[str, Any]]
    edges: Sequence[tuple[int, str, int, dict[str, Any]]]
    reach: LaneDistances | None = field(default=None, compare=False, repr=False)
    events: Mapping[str, Sequence[tuple[int | None, int | None]]] = field(
        default_factory=dict[str, "Sequence[tuple[int | None, int | None]]"],
        compare=False,
        repr=False,
    )
    topics: Mapping[str, Any] = field(default_factory=dict[str, Any], compare=False, repr=False)
    around: Callable[[], SceneGraph] | None = field(default=None, compare=False, repr=False)
    out_of_world: int = field(default=0, compare=False, repr=False)
    excluded: frozenset[str] = field(default=frozenset(), compare=False, repr=False)
    unsure_lane: frozenset[int] = field(default=frozenset(), compare=False, repr=False)
    unsure_lead: frozenset[int] = field(default=frozenset(), compare=False, repr=False)

    def known(self) -> SceneGraph:
        """Return the scene graph of all known objects, including those outside the range of this graph.

        Outside this graph, only the edges ``isIn``, ``controlsTrafficOf``, ``leads``, ``follows`` and map edges
        exist.

        Examples
        --------
        >>> graph = store.file.graph("town#264")
        >>> len(graph.nodes), len(graph.known().nodes)
        (96, 252)
        """
        if self.around is None:
            return self
        cut = {"out_of_world": self.out_of_world, "excluded": self.excluded}
        return replace(self.around(), events=self.events, topics=self.topics, **cut)

    def __repr__(self) -> str:
        size = f"{len(self.nodes)} nodes, {len(self.edges)} edges"
        return f"<SceneGraph {self.trace}#{self.seq}: {size}>"

    def places(self) -> dict[int, list[tuple[int, float]]]:
        """Return positions of objects along their lanes: node id → pairs (lane, distance from its start); m.

        Examples
        --------
        >>> graph = store.file.graph("town#3")
        >>> [(lane, round(along, 1)) for lane, along in graph.places()[1]]
        [(-5, 77.4)]
        """
        found: dict[int, list[tuple[int, float]]] = {}
        for src, relation, dst, about in self.edges:
            if relation == "isIn" and about.get("is_own") and "along" in about:
                found.setdefault(src, []).append((dst, about["along"]))
        return found

    def stretches(self) -> dict[int, Stretches]:
        """Return the lane intervals that objects occupy: node id → (lane, start, end); m.

        Traffic lights and signs are at the stop positions of the lanes they control; see
        :mod:`sgstore.maps.roads._places`.

        Examples
        --------
        >>> graph = store.file.graph("town#3")
        >>> [(lane, round(start, 1), round(end, 1)) for lane, start, end in graph.stretches()[1]]
        [(-5, 77.4, 77.4)]
        """
        found: dict[int, list[tuple[int, float, float]]] = {}
        signals = {node for node, about in self.nodes.items() if about["kind"] in SIGNALS}
        for src, relation, dst, about in self.edges:
            if relation == "isIn" and src not in signals:
                if about.get("is_own") and "along" in about:
                    found.setdefault(src, []).append((dst, about["along"], about["along"]))
            elif relation == "controlsTrafficOf" and src in signals and src >= 0:
                stops = ((dst, *at) for at in self._stops(self.nodes[src]["kind"], dst))
                found.setdefault(src, []).extend(stops)
        return dict(found)

    def _stops(self, what: str, lane: int) -> Sequence[tuple[float, float]]:
        """Return the positions along a lane where vehicles stop for traffic signals of a kind."""
        known = self.reach.stretches_of(what, lane) if self.reach is not None else ()
        about = self.nodes.get(lane, {})
        if not known and ("junction" in about or "length" in about):
            at = 0.0 if "junction" in about else float(about["length"])
            return [(at, at)]
        return known

    def lane_dist(self, a: int, b: int) -> float | None:
        """Return the distance along lanes between two objects or map parts; m. ``None`` if unknown.

        Measured from centre to centre along the centre lines of their own lanes (:attr:`LaneStates.own`) and
        the lanes connected by ``travelsTo``. Positive if the route leads from a to b, negative from b to a; the
        shortest route counts. A lane, road, junction or crosswalk occupies an interval of lanes, so the
        distance inside is 0. A light or sign is at the stop position of the lanes that it controls. ``None``
        means no route of at most 200 m. Routes do not change lanes.

        Examples
        --------
        >>> graph = store.file.graph("town#3")
        >>> round(graph.lane_dist(0, 1), 1), round(graph.lane_dist(1, 0), 1)
        (21.7, -21.7)
        >>> graph.lane_dist(0, 2) is None  # on the lane beside
        True
        """
        if self.reach is None:
            return None
        known = self.stretches()
        ends = (known.get(n, ()) if n >= 0 else self.reach.stretches(n) for n in (a, b))
        return self.reach.between(*ends)

    def to_next(self, node: int, what: str) -> float | None:
        """Return the distance along lanes to the next map part of a kind (such as crosswalk); m. 0 on it.

        ``what`` is ``junction``, ``roundabout``, ``crosswalk``, ``stop_line``, ``traffic_light``, …; ``None``
        means none within 200 m.

        Examples
        --------
        >>> graph = store.file.graph("town#3")
        >>> round(graph.to_next(1, "junction"), 1)
        192.6
        """
        return None if self.reach is None else self.reach.next(self.stretches().get(node, ()), what)

    def curvature(self, node: int) -> float | None:
        """Return the curvature of an object's primary lane at the object's position; 1/m.

        Mean over about a metre of the centre line; positive in a left turn of the lane's traffic. ``None``
        means no lane, or no map.

        Examples
        --------
        >>> graph = store.file.graph("town#425")
        >>> round(graph.curvature(0), 3)  # a left turn
        0.046
        """
        return self._course(node)[0]

    def slope(self, node: int) -> float | None:
        """Return the slope of an object's primary lane at the object's position: 0.05 for 5 % uphill.

        Mean over about a metre; positive if the lane's traffic drives uphill. ``None`` means no lane, no map,
        or a map without heights.

        Examples
        --------
        >>> graph = store.file.graph("town#264")
        >>> graph.slope(graph.ego)
        0.0
        """
        return self._course(node)[1]

    def _course(self, node: int) -> tuple[float | None, float | None]:
        place = self.primary_places().get(node)
        return (None, None) if self.reach is None or place is None else self.reach.course(*place)

    def primary_places(self) -> dict[int, tuple[int, float]]:
        """Return the primary lane of each object: node id → (lane, distance from its start); m.

        Examples
        --------
        >>> graph = store.file.graph("town#3")
        >>> lane, along = graph.primary_places()[1]
        >>> graph.nodes[lane]["kind"], round(along, 1)
        ('lane', 77.4)
        """
        return {
            src: (dst, about["along"])
            for src, relation, dst, about in self.edges
            if relation == "isIn" and about.get("is_primary") and "along" in about
        }

    def to_networkx(self) -> nx.MultiDiGraph[int]:
        """Return the scene graph as a ``networkx.MultiDiGraph``.

        Returns
        -------
        networkx.MultiDiGraph
            Node ids as nodes with their attributes; the key and the attribute ``relation`` of an edge are its
            relation. An edge between entities has the attribute ``lane_dist`` if known (:meth:`lane_dist`). The
            graph's attributes are ``frame_id``, ``trace``, ``seq``, ``time_ns`` and ``ego``.

        Examples
        --------
        >>> graph = store.file.graph("town#264")
        >>> print(graph.to_networkx())
        MultiDiGraph with 96 nodes and 634 edges
        """
        import networkx as nx  # imports in half a second: only on demand

        graph: nx.MultiDiGraph[int] = nx.MultiDiGraph(
            frame_id=self.frame_id,
            trace=self.trace,
            seq=self.seq,
            time_ns=self.time_ns,
            ego=self.ego,
        )
        graph.add_nodes_from(self.nodes.items())
        places = {} if self.reach is None else self.stretches()
        known: dict[tuple[int, int], dict[str, Any]] = {}
        for src, relation, dst, attributes in self.edges:
            more: dict[str, Any] = {}
            if self.reach is not None and src in places and dst in places:
                if (src, dst) not in known:
                    far = self.reach.between(places[src], places[dst])
                    known[src, dst] = {} if far is None else {"lane_dist": far}
                more = known[src, dst]
            about = {"relation": relation, **attributes, **more}
            graph.add_edge(src, dst, key=relation)
            graph.edges[src, dst, relation].update(about)  # names can be arbitrary
        return graph
