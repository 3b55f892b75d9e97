"""Scene graphs as columns: a block of many frames for the store, a single frame for people and networkx."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import networkx as nx

    from sgstore.world import Codes, Floats, FrameBlock, Ints


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of the graphs of a block, one row an edge and frame; shape (E,).

    Attributes
    ----------
    frame : int64
        Frame, counted in the block.
    relation : int8
        Codes of :data:`sgstore.vocabulary.RELATIONS`.
    src, dst : int64
        Node ids: 0 and above in the trace, below zero in the map.
    """

    frame: Ints
    relation: Codes
    src: Ints
    dst: Ints

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def chained(cls, parts: Sequence[Edges]) -> Edges:
        """One part, of which there is one at least, after another."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass(frozen=True, slots=True)
class LaneGaps:
    """How far it is along the lanes from who follows to who leads: the attribute of both edges; shape (K,).

    Attributes
    ----------
    frame : int64
        Frame, counted in the block.
    src, dst : int64
        Node ids: src follows dst.
    gap : float64
        From bumper to bumper along the lanes; m. NaN where it is not known.
    """

    frame: Ints
    src: Ints
    dst: Ints
    gap: Floats

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class Presence:
    """Which static nodes are in the graph of which frame; shape (M,).

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
    """How entities lie in lanes: the attributes of their ``isIn`` edges; shape (K,).

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
        Whether it is the one lane that the entity is in above all: centre inside, then heading, then overlap.
    along : float64
        Place of the box's centre along the lane's centre line, from the lane's start in its direction, beyond
        its ends too; m.
    """

    frame: Ints
    node: Ints
    lane: Ints
    overlap: Floats
    offset: Floats
    heading_error: Floats
    primary: np.ndarray[Any, np.dtype[np.bool_]]
    along: Floats

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class GraphBlock:
    """Scene graphs of the frames of a block.

    Attributes
    ----------
    frames : FrameBlock
        The frames, with only those states that are nodes of their graphs (in range).
    presence : Presence
        The static nodes of each graph. A static edge of the map holds where both its ends are present.
    edges : Edges
        All other edges.
    lanes : LaneStates
        Attributes of the ``isIn`` edges from entities to lanes.
    gaps : LaneGaps
        Attributes of ``leads`` and ``follows`` edges.
    """

    frames: FrameBlock
    presence: Presence
    edges: Edges
    lanes: LaneStates
    gaps: LaneGaps

    def __len__(self) -> int:
        return len(self.frames)


def graph_of_records(
    nodes: Iterable[Mapping[str, Any]], edges: Iterable[Mapping[str, Any]], **about: Any
) -> nx.MultiDiGraph[Any]:
    """A graph in node-link form as a ``networkx.MultiDiGraph``.

    Parameters
    ----------
    nodes : iterable of mappings
        ``id`` and attributes.
    edges : iterable of mappings
        ``source``, ``target``, ``relation``, which is the key too, and attributes.
    **about
        Attributes of the graph.
    """
    import networkx as nx  # half a second to import: only when asked for

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
    """A graph of names and labels as a ``networkx.MultiDiGraph``, as the literature has them.

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
        which is their key where two nodes have it once.
    """
    import networkx as nx  # half a second to import: only when asked for

    graph: nx.MultiDiGraph[str] = nx.MultiDiGraph(**about)
    for name, label in nodes.items():
        graph.add_node(name, name=name, base_class=label)
    for src, label, dst in edges:
        again = graph.has_edge(src, dst, key=label)
        key = f"{label} {graph.number_of_edges(src, dst)}" if again else label
        graph.add_edge(src, dst, key=key, label=label)
    return graph


@dataclass(frozen=True, slots=True)
class SceneGraph:
    """The scene graph of one frame: ``(V, E, Ego, kind, rel, att)`` of the paper, as records.

    Attributes
    ----------
    frame_id : int
    trace : str
        Name of the trace.
    seq, time_ns : int
    ego : int or None
        Node id of the ego.
    nodes : dict
        Node id → attributes in outward units (m, s, m/s, degrees): ``kind``, ``name``, ``is_ego``, and
        whatever is known (``x``, ``y``, ``heading``, ``speed``, ``light_state``, …). Missing ones are left out.
    edges : list of tuple
        ``(src, relation, dst, attributes)``.
    """

    frame_id: int
    trace: str
    seq: int
    time_ns: int
    ego: int | None
    nodes: dict[int, dict[str, Any]]
    edges: list[tuple[int, str, int, dict[str, Any]]]

    def to_networkx(self) -> nx.MultiDiGraph[int]:
        """The graph as a ``networkx.MultiDiGraph``.

        Returns
        -------
        networkx.MultiDiGraph
            Node ids as nodes with their attributes; an edge's key and its attribute ``relation`` are the
            relation. The graph's attributes are ``frame_id``, ``trace``, ``seq``, ``time_ns`` and ``ego``.
        """
        import networkx as nx  # half a second to import: only when asked for

        graph: nx.MultiDiGraph[int] = nx.MultiDiGraph(
            frame_id=self.frame_id,
            trace=self.trace,
            seq=self.seq,
            time_ns=self.time_ns,
            ego=self.ego,
        )
        graph.add_nodes_from(self.nodes.items())
        for src, relation, dst, attributes in self.edges:
            graph.add_edge(src, dst, key=relation, relation=relation, **attributes)
        return graph
