"""Scene graph of one frame, with indexes for the search of patterns."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang.operators import Column
from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import (
    COLUMNS,
    COURSES,
    HUNG,
    NEXT_PARTS,
    OPTIONAL,
    PART_DIST,
    UPRIGHT,
    WAYS,
    PairNumbers,
    low_and_high,
)
from sgstore.model.vocabulary import MAP_KINDS, NOISE_MARKS, SIGNALS

if TYPE_CHECKING:
    from sgstore.lang import ir as b
    from sgstore.model.graph import SceneGraph
    from sgstore.model.world import Floats

ENTITY: Final = (*COLUMNS, *OPTIONAL)
"""Columns of an entity needed for pair numbers."""

Attributes = Mapping[str, Any]

NodePair = tuple["int | None", "int | None"]
"""Nodes of an event. ``None`` means no node."""


@dataclass
class FrameView:
    """Scene graph of one frame, with indexes for the search, and with attributes of frame and trace.

    Parameters
    ----------
    graph : SceneGraph
    frame, trace : mapping
        Known attributes of ``frame`` and ``trace``, by their names in the query language.
    classes : callable, optional
        Function from the name of an abstraction to the class of the graph. It is called once, and only if a
        query needs it. Without it, classes are unknown.
    roles : callable, optional
        Function that returns the roles of lanes relative to the ego, by node id. It is called once, if needed.
    events : mapping, optional
        Events of the frame with their nodes, by kind or by name of a user table. The default is the events of
        the graph.
    recorded : callable, optional
        Function that returns a measure of two nodes from later frames. Without it, such measures are unknown.
    drawn : SceneGraph, optional
        Graph of the frame, if ``graph`` contains all known data around it. Edges of patterns are searched in
        ``drawn``.
    """

    graph: SceneGraph
    frame: Attributes = field(default_factory=dict[str, Any])
    trace: Attributes = field(default_factory=dict[str, Any])
    classes: Callable[[str], str | None] | None = None
    roles: Callable[[], Mapping[int, str]] | None = None
    events: Mapping[str, Sequence[NodePair]] | None = None
    recorded: Callable[[str, int, int], float | None] | None = None
    drawn: SceneGraph | None = None

    def in_world(self) -> FrameView:
        """Return the same frame for ``USING SCOPE world``. It also has entities outside its scene graph."""
        known = self.graph.known()
        if known is self.graph:
            return self
        return replace(self, graph=known, drawn=self.graph)

    def linked(self, edge: b.Edge) -> FrameView:
        """Return the frame data in which an edge is searched: the scene graph, or all known data.

        For an edge in braces it has all data, otherwise the scene graph.
        """
        return self if self.drawn is None or edge.known else self._drawn

    def draws(self, node: int) -> bool:
        """True if a node is in the scene graph of the frame, and not only in other recorded data."""
        return self.drawn is None or node in self.drawn.nodes

    @cached_property
    def _drawn(self) -> FrameView:
        assert self.drawn is not None  # noqa: S101 - checked by the caller
        return FrameView(self.drawn)

    @cached_property
    def nodes(self) -> Mapping[int, Attributes]:
        """Attributes of all nodes of the frame: node id → attributes."""
        return self.graph.nodes

    @cached_property
    def by_kind(self) -> Mapping[str, list[int]]:
        """Ids of all nodes of the frame, including the ego: kind → node ids."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for node, attributes in self.nodes.items():
            found[attributes["kind"]].append(node)
        return found

    @cached_property
    def links(self) -> Mapping[tuple[int, int], dict[str, Attributes]]:
        """Edges of the frame: pair of node ids → relation → attributes of the edge."""
        found: defaultdict[tuple[int, int], dict[str, Attributes]] = defaultdict(dict)
        for src, relation, dst, attributes in self.graph.edges:
            found[src, dst][relation] = attributes
        return found

    @cached_property
    def ahead(self) -> Mapping[tuple[str, int], list[int]]:
        """Nodes to which edges of the frame lead: (relation, source node) → target nodes."""
        return self._neighbours(0, 2)

    @cached_property
    def back(self) -> Mapping[tuple[str, int], list[int]]:
        """Nodes from which edges of the frame come: (relation, target node) → source nodes."""
        return self._neighbours(2, 0)

    def _neighbours(self, at: int, other: int) -> Mapping[tuple[str, int], list[int]]:
        found: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        for edge in self.graph.edges:
            found[edge[1], edge[at]].append(edge[other])  # type: ignore[index, arg-type]
        return found

    @cached_property
    def crowds(self) -> dict[b.Kinds, NodeColumns]:
        """Cache: allowed node kinds → the nodes of these kinds, with arrays of their attributes.

        :mod:`sgstore.lang.memory._evaluate` fills it.
        """
        return {}

    def class_in(self, abstraction: str) -> str | None:
        """Return the class of the frame's scene graph in an abstraction, or None if unknown."""
        if self.graph.ego in self.graph.unsure_lane:
            return None
        if abstraction not in self._classes:
            self._classes[abstraction] = self.classes(abstraction) if self.classes else None
        return self._classes[abstraction]

    @cached_property
    def _classes(self) -> dict[str, str | None]:
        return {}

    def role_of(self, node: int) -> str | None:
        """Return the role of a lane relative to the ego in this frame, or None if unknown."""
        return None if self.graph.ego in self.graph.unsure_lane else self._roles.get(node)

    def chain_of(self, node: int) -> int | None:
        """Return the chain of lanes that a lane belongs to; ``None`` for other nodes."""
        if self.nodes[node]["kind"] != "lane":
            return None
        return node if self.graph.reach is None else self.graph.reach.chain(node)

    @cached_property
    def _roles(self) -> Mapping[int, str]:
        return self.roles() if self.roles else {}

    def happens(self, asked: b.Happened, nodes: tuple[int, ...]) -> bool | None:
        """True if the frame has a recorded event that involves the given nodes.

        ``None`` if the trace does not record such events.
        """
        told = (self.graph.events if self.events is None else self.events).get(asked.kind)
        if told is None:
            return None
        if asked.table or not nodes:
            return any(pair[: len(nodes)] == nodes for pair in told)
        return any(nodes in {pair[: len(nodes)], pair[::-1][: len(nodes)]} for pair in told)

    def is_one(self, node: int, kinds: b.Kinds) -> bool:
        """True if a node of the frame has one of the allowed kinds."""
        kind = self.nodes[node]["kind"]
        return kind in (kinds.ego if node == self.graph.ego else kinds.other)

    def pair(self, name: str, one: int, other: int) -> float | None:
        """Return a number of two entities in this frame, such as ``gap``, or None if a value is missing."""
        if name in WAYS:
            return self._by_lanes(name, one, other)
        if name in RECORDED:
            return self.recorded(name, one, other) if self.recorded else None
        place = self.rows.get(other)
        if place is None or one not in self.rows:
            return None
        key = name, one
        if key not in self._numbers:
            self._numbers[key] = self.pairs(name, one).tolist()
        value = self._numbers[key][place]
        return None if math.isnan(value) else value

    def _by_lanes(self, name: str, one: int, other: int) -> float | None:
        """Return a number of two nodes that depends on lanes, such as their lane distance; None if unknown."""
        reach = self.graph.reach
        if reach is None:
            return None
        if name in NEXT_PARTS:
            return reach.next(self._on(one), NEXT_PARTS[name])
        if name in COURSES:
            at = self._primary.get(one)
            return None if at is None else reach.course(*at)[COURSES.index(name)]
        ends = (self._on(node, parts=name == PART_DIST) for node in (one, other))
        return reach.between(*ends)

    def pairs(self, name: str, one: int, *, ahead: bool = True) -> Floats:
        """Return a number such as ``gap`` between one entity and each entity of the frame, (E,).

        The order is that of :attr:`rows`.

        All pairs are computed at once, because most are needed. NaN means that a needed value is missing.
        Without ``ahead``, the pairs are reversed.
        """
        place = self.rows.get(one)
        if place is None:
            return np.full(len(self.rows), math.nan)
        key = one, ahead
        if key not in self._pairs:
            boxes = self._boxes
            own = np.broadcast_to(boxes[place], boxes.shape)
            self._pairs[key] = PairNumbers(own, boxes) if ahead else PairNumbers(boxes, own)
        return self._pairs[key][name]

    def _on(self, node: int, *, parts: bool = False) -> Sequence[tuple[int, float, float]]:
        """Return the lane intervals of an entity or signal; if ``parts``, also those of other map parts."""
        reach, kind = self.graph.reach, self.nodes[node]["kind"]
        if node >= 0 or reach is None:
            return self._stretches.get(node, ())
        return reach.stretches(node) if parts or kind in SIGNALS else ()

    @cached_property
    def _stretches(self) -> Mapping[int, Sequence[tuple[int, float, float]]]:
        return self.graph.stretches()

    @cached_property
    def _primary(self) -> Mapping[int, tuple[int, float]]:
        return self.graph.primary_places()

    @cached_property
    def _pairs(self) -> dict[tuple[int, bool], PairNumbers]:
        return {}

    @cached_property
    def _numbers(self) -> dict[tuple[str, int], list[float]]:
        return {}

    @cached_property
    def rows(self) -> Mapping[int, int]:
        """Row of each entity in the arrays for numbers of entity pairs: node id → row."""
        known = (n for n, about in self.nodes.items() if about["kind"] not in MAP_KINDS)
        return {node: row for row, node in enumerate(known)}

    @cached_property
    def _boxes(self) -> Floats:
        """Array with pose, size and motion of each entity, for numbers of entity pairs, (E, 15).

        Static entities have acceleration 0.
        """
        rows: list[list[float]] = []
        heights: list[tuple[float, bool, bool]] = []
        for node in self.rows:
            about = self.nodes[node]
            known: Attributes = {"ax": 0.0, "ay": 0.0} if about.get("is_static") else {}
            known = {**known, **about, "node_id": node}
            if about.get("is_static"):
                known["pitch"] = math.nan  # the store has no pitch for static entities
            rows.append([known.get(name, math.nan) for name in ENTITY])
            kind = about["kind"]
            heights.append((about.get("height", math.nan), kind in HUNG, kind in UPRIGHT))
        boxes = np.array(rows, np.float64).reshape(-1, len(ENTITY))
        height, hung, upright = np.array(heights, np.float64).reshape(-1, 3).T
        sides = low_and_high(boxes[:, COLUMNS.index("z")], height, hung > 0, upright > 0)
        for name, side in zip(("low", "high"), sides, strict=True):
            boxes[:, ENTITY.index(name)] = side
        angles = [ENTITY.index(name) for name in ("heading", "pitch")]
        boxes[:, angles] = np.radians(boxes[:, angles])
        return boxes


class NodeColumns:
    """Nodes of one frame that a query variable may match, with arrays of their attributes.

    Parameters
    ----------
    view : FrameView
    kinds : Kinds

    Attributes
    ----------
    nodes : list of int
    """

    def __init__(self, view: FrameView, kinds: b.Kinds) -> None:
        known = (node for kind in kinds.every for node in view.by_kind.get(kind, ()))
        self.nodes = [node for node in known if view.is_one(node, kinds)]
        self._rows = [view.rows.get(node, -1) for node in self.nodes]
        self._columns: dict[object, Column] = {}

    # The view is not stored, because it holds a reference to this object, and reference cycles are freed late.

    def attribute(self, view: FrameView, name: str, *, truth: bool) -> Column:
        """Return an attribute of each node (N,), as numbers; as booleans if ``truth``."""
        column = self._columns.get(name)
        if column is None:
            nodes = view.nodes
            told = [nodes[node].get(name) for node in self.nodes]
            if name in NOISE_MARKS:
                told = [attribute_of(nodes[node], name) for node in self.nodes]
            column = _known(np.array([math.nan if v is None else v for v in told], np.float64))
            if truth:
                column = Column(column.values == 1, column.known)
            self._columns[name] = column
        return column

    def pair(self, view: FrameView, name: str, one: int, *, ahead: bool) -> Column:
        """Return a number such as ``gap`` between one node and each node of this object, (N,).

        If ``ahead`` is false, the candidate is the first of the pair.
        """
        key = name, one, ahead
        column = self._columns.get(key)
        if column is None:
            values = view.pairs(name, one, ahead=ahead)
            column = self._columns[key] = _known(np.append(values, math.nan)[self._rows])
        return column


def attribute_of(about: Mapping[str, Any], name: str) -> Any:
    """Return an attribute of a node. A missing noise mark of an entity counts as False."""
    if name in NOISE_MARKS and "derived_velocity" in about:
        return about.get(name, False)
    return about.get(name)


def _known(values: Floats) -> Column:
    unknown = np.isnan(values)
    return Column(values, ~unknown if unknown.any() else True)


def crowd(view: FrameView, kinds: b.Kinds) -> NodeColumns:
    """Return the nodes of a frame that have allowed kinds, with arrays of attributes. They are cached."""
    found = view.crowds.get(kinds)
    if found is None:
        found = view.crowds[kinds] = NodeColumns(view, kinds)
    return found
