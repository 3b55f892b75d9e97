"""Input and output of abstractions: scene graphs and labelled graphs of many frames as columns.

An abstraction is a function from :class:`GraphColumns`, the nodes and edges of scene graphs, to
:class:`Labelled`, one directed multigraph per frame with labels on nodes and edges.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sgstore.base.tables import begins, spread
from sgstore.graphs.abstractions._subsets import BETWEEN_ENTITIES, SCENERY
from sgstore.model.vocabulary import (
    DRIVING,
    KIND_CODE,
    MOST_KINDS,
    MOST_RELATIONS,
    RELATION_CODE,
    RELATIONS,
    are_entities,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Bools, Codes, Floats, Ints


Labels = NDArray[np.int32]

Part = tuple[NDArray[Any], ...]
"""Columns of nodes or of edges, in a fixed order."""

EGO: Final = "ego"
"""Label of the ego in every abstraction, as in the literature."""

EGOS: Final = (EGO, "ego_car")
"""Labels of the ego node. A node with such a label is named by the label alone."""

_SMALL: Final = np.zeros(MOST_KINDS, np.bool_)
_SMALL[[KIND_CODE[kind] for kind in SCENERY]] = True
_BETWEEN: Final = np.zeros(MOST_RELATIONS, np.bool_)
_BETWEEN[[RELATION_CODE[name] for name in BETWEEN_ENTITIES]] = True
_LANE: Final = KIND_CODE["lane"]


@dataclass(frozen=True, eq=False)
class MapColumns:
    """Nodes and edges of a road map as columns. The node in row ``i`` has the id ``-1 - i``.

    Attributes
    ----------
    kind : (K,) int8
        Codes of :data:`sgstore.model.vocabulary.KINDS`.
    name, lane_type, road, junction : (K,) str
        As in :class:`sgstore.maps.roads.MapNodes`; empty if there is none.
    lane : (K,) int64
        Number of the lane in its road; 0 for other parts.
    relation : (M,) int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    src, dst : (M,) int64
        Node ids, negative.
    courses : tuple
        Node id of the lane, start (m) and curvature (1/m) of lane intervals, by lane and start; empty if
        unknown.
    """

    kind: Codes
    name: NDArray[Any]
    lane_type: NDArray[Any]
    road: NDArray[Any]
    junction: NDArray[Any]
    lane: Ints
    relation: Codes
    src: Ints
    dst: Ints
    courses: tuple[Ints, Floats, Floats] = field(
        default_factory=lambda: (np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    )

    @classmethod
    def of(cls, road_map: RoadMap) -> MapColumns:
        """Return the nodes and edges of a road map as columns. The result is cached with the map."""
        if (known := _MAPS.get(road_map)) is not None:
            return known
        nodes, edges = road_map.nodes, road_map.edges
        names = ("name", "lane_type", "road", "junction")
        texts = {name: np.array(getattr(nodes, name), object) for name in names}
        links = {name: getattr(edges, name) for name in ("relation", "src", "dst")}
        course = road_map.courses
        courses = (-2 - course.lane, course.start, course.curvature)
        _MAPS[road_map] = columns = cls(
            kind=nodes.kind, lane=nodes.lane, **texts, **links, courses=courses
        )
        return columns

    @cached_property
    def driving(self) -> Bools:
        """Mask (K,) of the map nodes that are lanes for driving."""
        return (self.kind == _LANE) & np.array([of in DRIVING for of in self.lane_type], np.bool_)


_MAPS: Final[WeakKeyDictionary[RoadMap, MapColumns]] = WeakKeyDictionary()
"""Cached columns of road maps. An entry is removed together with its map."""


@dataclass(frozen=True, eq=False)
class GraphColumns:
    """Scene graphs of many frames as columns: nodes with kind and pose, and edges.

    Attributes
    ----------
    frames : int
        Number of frames.
    node_frame, node : (N,) int64
        Frame, counted from 0, and node id; ascending.
    kind : (N,) int8
        Codes of :data:`sgstore.model.vocabulary.KINDS`.
    is_ego : (N,) bool
    x, y, z, heading : (N,) float64
        Poses of moving or changing nodes; m, rad. NaN for static nodes and for missing values.
    frame : (E,) int64
    relation : (E,) int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    src, dst : (E,) int64
        Node ids. Edges among parts of the map are excluded: see :meth:`lasting`.
    ego_lane : (frames,) int64
        Node id of the ego's primary lane, or 0.
    grounds : MapColumns or None
        The road map; ``None`` without one.
    ego_along : (frames,) float64 or None
        Place of the ego's centre along its primary lane; m. ``None`` or NaN: unknown.
    """

    frames: int
    node_frame: Ints
    node: Ints
    kind: Codes
    is_ego: Bools
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    frame: Ints
    relation: Codes
    src: Ints
    dst: Ints
    ego_lane: Ints
    grounds: MapColumns | None
    ego_along: Floats | None = None

    @classmethod
    def sorted(cls, frames: int, nodes: Mapping[str, Any], **columns: Any) -> GraphColumns:
        """Create graphs from node columns in any order. They are sorted by frame and node id."""
        order = np.lexsort((nodes["node"], nodes["node_frame"]))
        return cls(frames, **{name: of[order] for name, of in nodes.items()}, **columns)

    @classmethod
    def of(cls, graph: GraphBlock, kinds: Codes, grounds: MapColumns | None) -> GraphColumns:
        """Convert a block of scene graphs to columns for abstractions.

        Parameters
        ----------
        graph : GraphBlock
        kinds : int8
            Kinds of all entities of the trace so far, by node id.
        grounds : MapColumns or None
        """
        frames, states, presence = graph.frames, graph.frames.states, graph.presence
        of_map = np.zeros(0, np.int8) if grounds is None else grounds.kind
        row, still = frames.frame_of, len(presence.node)
        entity = presence.node >= 0
        kind = np.empty(still, np.int8)
        kind[entity] = kinds[presence.node[entity]]
        kind[~entity] = of_map[-1 - presence.node[~entity]]
        nodes = {
            "node_frame": np.concatenate([row, presence.frame]),
            "node": np.concatenate([states.node, presence.node]),
            "kind": np.concatenate([kinds[states.node], kind]),
            "is_ego": np.append(states.node == frames.ego[row], np.zeros(still, np.bool_)),
        } | {
            name: np.append(getattr(states, name), np.full(still, np.nan))
            for name in ("x", "y", "z", "heading")
        }
        edges, lanes = graph.edges, graph.lanes
        own = lanes.primary & (lanes.node == frames.ego[lanes.frame])
        ego_lane = np.zeros(len(frames), np.int64)
        ego_lane[lanes.frame[own]] = lanes.lane[own]
        ego_along = np.full(len(frames), np.nan)
        ego_along[lanes.frame[own]] = lanes.along[own]
        return cls.sorted(
            len(frames),
            nodes,
            frame=edges.frame,
            relation=edges.relation,
            src=edges.src,
            dst=edges.dst,
            ego_lane=ego_lane,
            grounds=grounds,
            ego_along=ego_along,
        )

    def lasting(self, relations: Sequence[int]) -> tuple[Ints, Codes, Ints, Ints]:
        """Return the static map edges in each frame, where both nodes of the edge are in the frame's graph.

        Returns
        -------
        frame, relation, src, dst : (K,)
        """
        none = np.zeros(0, np.int64)
        grounds = self.grounds
        rows = np.flatnonzero(self.node < 0)
        if grounds is None or not len(rows):
            return none, none.astype(np.int8), none, none
        here, column = np.unique(-1 - self.node[rows], return_inverse=True)
        place = np.full(len(grounds.kind), -1)
        place[here] = np.arange(len(here))
        src, dst = place[-1 - grounds.src], place[-1 - grounds.dst]
        wanted = np.flatnonzero((src >= 0) & (dst >= 0) & np.isin(grounds.relation, relations))
        present = np.zeros((self.frames, len(here)), np.bool_)
        present[self.node_frame[rows], column] = True
        frame, edge = np.nonzero(present[:, src[wanted]] & present[:, dst[wanted]])
        edge = wanted[edge]
        return frame, grounds.relation[edge], grounds.src[edge], grounds.dst[edge]

    @cached_property
    def is_traffic(self) -> Bools:
        """Mask (N,) of the nodes that are traffic objects, without scenery such as buildings."""
        return are_entities(self.kind) & ~_SMALL[self.kind]

    @cached_property
    def pairs(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Pairs of traffic objects with at least one relation: frame, both nodes, and one bit per relation.

        Returns
        -------
        frame, src, dst : (K,)
        relations : (K,)
            Bit i represents the relation with code i.
        """
        kept = np.flatnonzero(self.is_traffic)
        node_frame, node = self.node_frame[kept], self.node[kept]
        rows = np.flatnonzero(_BETWEEN[self.relation])
        frame, bit = self.frame[rows], self.relation[rows].astype(np.int64)
        ends = np.concatenate([self.src[rows], self.dst[rows]])
        a, b = found(node_frame, node, np.tile(frame, 2), ends).reshape(2, -1)
        both = np.flatnonzero((a >= 0) & (b >= 0))
        frame, bit, a, b = frame[both], bit[both], a[both], b[both]
        starts = np.searchsorted(node_frame, np.arange(self.frames + 1))
        most = int(np.diff(starts).max(initial=0))
        cell = (frame * most + (a - starts[frame])) * most + (b - starts[frame])
        cells, bits = _united(cell, bit, self.frames * most * most)
        frame, pair = np.divmod(cells, max(most * most, 1))
        a, b = np.divmod(pair, max(most, 1))
        return frame, node[starts[frame] + a], node[starts[frame] + b], bits

    def taken(self, frames: Ints) -> GraphColumns:
        """Return the graphs of some frames, given in ascending order."""
        if len(frames) == self.frames:
            return self
        number = np.full(self.frames, -1)
        number[frames] = np.arange(len(frames))
        nodes = np.flatnonzero(number[self.node_frame] >= 0)
        edges = np.flatnonzero(number[self.frame] >= 0)
        of_nodes = ("node", "kind", "is_ego", "x", "y", "z", "heading")
        some = GraphColumns(
            frames=len(frames),
            node_frame=number[self.node_frame[nodes]],
            **{name: getattr(self, name)[nodes] for name in of_nodes},
            frame=number[self.frame[edges]],
            **{name: getattr(self, name)[edges] for name in ("relation", "src", "dst")},
            ego_lane=self.ego_lane[frames],
            grounds=self.grounds,
            ego_along=None if self.ego_along is None else self.ego_along[frames],
        )
        if self in LANES_OF:
            LANES_OF[some] = LANES_OF[self].taken(number)
        return some

    def row_of(self, frame: Ints, node: Ints) -> Ints:
        """Return the row of a node in a frame's graph; -1 for nodes outside the graph."""
        return found(self.node_frame, self.node, frame, node)


def _united(cell: Ints, bit: Ints, bound: int) -> tuple[Ints, Ints]:
    """Return the distinct keys, ascending, and all bits of each key combined (bitwise OR)."""
    if bound <= _CELLS:
        sums = np.bincount(cell, weights=np.exp2(bit))
        cells = np.flatnonzero(sums)
        bits = sums[cells].astype(np.int64)
    else:
        cells, number = np.unique(cell, return_inverse=True)
        bits = np.bincount(number, weights=np.exp2(bit)).astype(np.int64)
    if int(np.bitwise_count(bits).sum()) == len(cell):
        return cells, bits
    once = np.unique(np.stack([cell, bit]), axis=1)  # sums are unions if each value occurs once
    return _united(once[0], once[1], bound)


def found(frames: Ints, nodes: Ints, frame: Ints, node: Ints) -> Ints:
    """Return the row of each (frame, node) pair in sorted columns; -1 if it does not occur."""
    if not len(nodes):
        return np.full(len(node), -1)
    low, span = int(nodes.min()), int(nodes.max()) - int(nodes.min()) + 1
    here = int(frames.max()) + 1
    if here * span <= _TABLE:
        table = np.full((here + 1, span + 1), -1)  # values outside the table use its edges
        table[frames, nodes - low] = np.arange(len(nodes))
        at = node - low
        return table[np.minimum(frame, here), np.where((at < 0) | (at > span), span, at)]
    ids, column = np.unique(nodes, return_inverse=True)
    place = np.full((here, len(ids)), -1)
    place[frames, column] = np.arange(len(nodes))
    if span <= _TABLE:
        table = np.zeros(span, np.int64)
        table[ids - low] = np.arange(len(ids))
        at = table[np.clip(node - low, 0, span - 1)]
    else:
        at = np.minimum(np.searchsorted(ids, node), len(ids) - 1)
    row = place[np.minimum(frame, len(place) - 1), at]
    return np.where((ids[at] == node) & (frame < len(place)), row, -1)


_TABLE: Final = 1 << 18
"""Largest size of a look-up table. Up to this size it is faster than a binary search."""

_CELLS: Final = 1 << 23
"""Largest number of possible pairs for which an array with one count per pair is used."""


@dataclass(frozen=True)
class Labelled:
    """Labelled graphs of many frames as columns: the result of an abstraction.

    Attributes
    ----------
    frames : int
        Number of frames; a frame without nodes has the empty graph.
    labels : tuple of str
        All distinct labels of nodes and edges.
    node_frame, node : (N,) int64
        Frame, counted from 0, and a number that is unique in the frame: a node id, or a number made
        by the abstraction. Ascending.
    node_label : (N,) int32
        Index into ``labels``.
    frame, src, dst : (E,) int64
        Edges; both ends are nodes of the same frame. An edge may occur more than once.
    label : (E,) int32
        Index into ``labels``, or -1 minus an index into ``bundles`` for several edges with the same
        ends.
    bundles : tuple of tuple of int
        Indices into ``labels``.
    names : mapping of int to str
        Names of nodes that are not named by their label: parts of the map.
    """

    frames: int
    labels: tuple[str, ...]
    node_frame: Ints
    node: Ints
    node_label: Labels
    frame: Ints
    src: Ints
    label: Labels
    dst: Ints
    names: Mapping[int, str] = field(default_factory=dict[int, str])
    bundles: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def assembled(
        cls,
        frames: int,
        nodes: Sequence[Part],
        edges: Sequence[Part],
        labels: Sequence[str],
        names: Mapping[int, str] | None = None,
        bundles: Sequence[Sequence[int]] = (),
    ) -> Labelled:
        """Build labelled graphs from parts: nodes ``(frame, node, label)``, edges ``(frame, src, label, dst)``.

        Labels are indices into ``labels``, which may repeat texts; a negative one represents a
        bundle. Nodes may have any order. A node that occurs twice in a frame is merged.
        """
        table = tuple(dict.fromkeys(labels))
        index = {text: i for i, text in enumerate(table)}
        renumbered = np.array([index[text] for text in labels] or [0], np.int32)
        frame, node, label = _columns(nodes, 3)
        order = np.lexsort((node, frame))
        frame, node, label = frame[order], node[order], label[order]
        fresh = begins(frame, node)
        edge_frame, src, edge_label, dst = _columns(edges, 4)
        return cls(
            frames,
            table,
            frame[fresh],
            node[fresh],
            renumbered[label[fresh]],
            edge_frame,
            src,
            np.where(edge_label < 0, edge_label, renumbered[np.maximum(edge_label, 0)]).astype(
                np.int32
            ),
            dst,
            names or {},
            tuple(tuple(int(renumbered[label]) for label in bundle) for bundle in bundles),
        )

    def related(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Return the edges whose label is a relation, as frame, source, relation code and destination."""
        code = {name: i for i, name in enumerate(RELATIONS)}
        parts = [(code.get(text, -1),) for text in self.labels]
        bundles = [tuple(parts[label][0] for label in bundle) for bundle in self.bundles]
        several = parts + bundles[::-1]  # a negative label counts from the end
        many = np.array([len(of) for of in several] or [0])
        starts = np.cumsum(many) - many
        flat = np.array([one for of in several for one in of] or [-1], np.int64)
        index = np.where(self.label < 0, len(several) + self.label, self.label)
        edge, place = spread(starts[index], many[index])
        relation = flat[place]
        known = relation >= 0
        edge = edge[known]
        return self.frame[edge], self.src[edge], relation[known], self.dst[edge]

    def named(self, number: int) -> tuple[dict[str, str], list[tuple[str, str, str]]]:
        """Return the graph of one frame by names: nodes ``name → label``, and edges ``(name, label, name)``.

        The ego and unique nodes are named by their label, parts of the map by their name, and all
        others ``label_node``, such as ``car_12``.
        """
        rows = np.flatnonzero(self.node_frame == number)
        labels = [self.labels[code] for code in self.node_label[rows].tolist()]
        often = Counter(labels)
        called = {
            node: self.names.get(node)
            or (label if node < 0 and often[label] == 1 else f"{label}_{abs(node)}")
            for node, label in zip(self.node[rows].tolist(), labels, strict=True)
        }
        egos = {n: t for n, t in zip(called, labels, strict=True) if t in EGOS and often[t] == 1}
        called |= egos
        edges = np.flatnonzero(self.frame == number)
        columns = (self.src[edges].tolist(), self.label[edges].tolist(), self.dst[edges].tolist())
        return (
            dict(zip(called.values(), labels, strict=True)),
            [
                (called[a], self.labels[label], called[b])
                for a, r, b in zip(*columns, strict=True)
                for label in ((r,) if r >= 0 else self.bundles[-1 - r])
            ],
        )


def _columns(parts: Iterable[Part], count: int) -> list[NDArray[Any]]:
    none = np.zeros(0, np.int64)
    columns = zip(*parts, (none,) * count, strict=True)
    return [np.concatenate(column).astype(np.int64) for column in columns]


def repeated(columns: Part) -> Bools:
    """Return a mask of the rows that are equal to an earlier row."""
    again = np.zeros(len(columns[0]), np.bool_)
    if len(again):
        order = np.lexsort(columns)
        again[order] = ~begins(*(column[order] for column in columns))
    return again


@dataclass(frozen=True, slots=True)
class EgoLanes:
    """Lanes of many frames with their roles relative to the ego, such as left neighbour.

    Attributes
    ----------
    frame, strand, role : (L,) int64
        Present lanes: lanes with traffic, lanes next to the ego's in range, and lanes with a role
        in their name. ``role`` as in :func:`sgstore.graphs.abstractions._lane_roles.role_name`, or
        :data:`sgstore.graphs.abstractions._lane_roles.NAMELESS`.
    inside : tuple of (I,) int64
        Frame, traffic entity, and its strand; each once.
    inside_lane : tuple of (J,) int64
        Frame, and a lane with traffic.
    off_road : tuple of (O,) int64
        Frame, and an off-road entity.
    """

    frame: Ints
    strand: Ints
    role: Ints
    inside: Part
    inside_lane: Part
    off_road: Part

    def taken(self, number: Ints) -> EgoLanes:
        """Return the lanes of some frames. The frames get new numbers."""

        def some(frame: Ints, *columns: Ints) -> Part:
            rows = np.flatnonzero(number[frame] >= 0)
            return number[frame[rows]], *(column[rows] for column in columns)

        frame, strand, role = some(self.frame, self.strand, self.role)
        inside, inside_lane = some(*self.inside), some(*self.inside_lane)
        return EgoLanes(frame, strand, role, inside, inside_lane, some(*self.off_road))


LANES_OF: Final[WeakKeyDictionary[GraphColumns, EgoLanes]] = WeakKeyDictionary()
"""Cached lanes, by the columns of the graphs. An entry is removed together with the columns."""
