"""Scene graphs of many frames as shared columns, and their conversion to one graph object per frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.model.graph import (
    FOLLOWS,
    IS_IN,
    LEADS,
    EdgeColumns,
    Edges,
    LaneDistances,
    SceneGraph,
    StaticPresence,
)
from sgstore.model.vocabulary import MOST_RELATIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Codes, Ints

    Whole = NDArray[np.signedinteger[Any]]
    Attributes = dict[str, Any]
    EdgeRecord = tuple[int, str, int, Attributes]

MOST_RECORDS: Final = 1 << 16
"""Largest number of edges of a graph that are stored as objects. Larger graphs store columns."""


class MapRecords:
    """Map nodes and edges in scene graphs: node attributes, and edges as columns.

    Parameters
    ----------
    about : callable
        Node id → attributes.
    src, dst : (n,) int64
        Node ids; below zero.
    relation : (n,) int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    reach : LaneDistances

    Attributes
    ----------
    about, reach
        Same objects as the parameters.
    src, relation, dst
        Edges, ordered by source, relation and destination. Ids of map elements descend.
    """

    def __init__(
        self,
        about: Callable[[int], Attributes],
        src: Ints,
        relation: Codes,
        dst: Ints,
        reach: LaneDistances,
    ) -> None:
        self.about, self.reach = about, reach
        order = np.lexsort((-dst, relation, -src))
        self.src, self.relation, self.dst = src[order], relation[order], dst[order]
        self._lowest = min(src.min(initial=0), dst.min(initial=0))

    def among(self, present: Ints) -> Ints:
        """Return the rows of the map edges whose two nodes are both in ``present``."""
        if not len(present):
            return np.zeros(0, np.intp)
        here = np.zeros(1 - min(present.min(), self._lowest), np.bool_)
        here[-present] = True
        return np.flatnonzero(here[-self.src] & here[-self.dst])


@dataclass(frozen=True, slots=True)
class SceneColumns:
    """Scene graphs of several frames of a trace, stored together as columns.

    Attributes
    ----------
    trace : str
    frame_id, seq, time_ns : (F,) int64
    ego : sequence of int or None, F long
    moving : tuple of Ints, Ints and sequence of dict
        Frame (from 0), node id and attributes of moving nodes, in any order.
    presence : StaticPresence
        Static nodes and map elements of each frame.
    standing : mapping
        Node id → attributes of static nodes.
    edges : Edges
        Edges with at least one entity of the trace, in any order. Duplicates are allowed.
    about : mapping
        Frame, relation, source and destination → attributes; see :func:`edge_attributes`.
    map : MapRecords or None
    """

    trace: str
    frame_id: Ints
    seq: Ints
    time_ns: Ints
    ego: Sequence[int | None]
    moving: tuple[Ints, Ints, Sequence[Attributes]]
    presence: StaticPresence
    standing: Mapping[int, Attributes]
    edges: Edges
    about: Mapping[tuple[int, int, int, int], Attributes]
    map: MapRecords | None

    def graphs(self) -> Iterator[SceneGraph]:
        """Yield the scene graph of each frame, with moving nodes, static nodes and map nodes.

        Edges of the trace come before map edges.
        """
        frame, node, about = self.moving
        order = np.lexsort((node, frame))
        moving = _divided(frame[order], len(self.frame_id))
        present = self.presence
        by_place = np.lexsort((abs(present.node), present.node < 0, present.frame))
        standing = _divided(present.frame[by_place], len(self.frame_id))
        edges = self.edges.distinct()
        related = _divided(edges.frame, len(self.frame_id))
        tells = np.isin(np.arange(MOST_RELATIONS), [relation for _, relation, *_ in self.about])
        for row in range(len(self.frame_id)):
            rows = order[moving[row]].tolist()
            nodes = dict(zip(node[rows].tolist(), (about[i] for i in rows), strict=True))
            still = present.node[by_place[standing[row]]]
            for one in still[still >= 0].tolist():
                if (known := self.standing.get(one)) is not None:
                    nodes[one] = dict(known)
            mapped = still[still < 0]
            if self.map is not None:
                nodes |= {one: dict(self.map.about(one)) for one in mapped.tolist()}
            yield SceneGraph(
                frame_id=int(self.frame_id[row]),
                trace=self.trace,
                seq=int(self.seq[row]),
                time_ns=int(self.time_ns[row]),
                ego=self.ego[row],
                nodes=nodes,
                edges=self._edges(row, edges, related[row], mapped, tells),
                reach=self.map.reach if self.map is not None and len(mapped) else None,
            )

    def _edges(
        self, row: int, edges: Edges, own: slice, mapped: Ints, telling: NDArray[np.bool_]
    ) -> Sequence[EdgeRecord]:
        src, relation, dst = edges.src[own], edges.relation[own], edges.dst[own]
        about: dict[int, Attributes] = {}
        tells = np.flatnonzero(telling[relation])
        ends = (column[tells].tolist() for column in (relation, src, dst))
        for place, *key in zip(tells.tolist(), *ends, strict=True):
            if (found := self.about.get((row, *key))) is not None:
                about[place] = found
        if self.map is not None:
            rows = self.map.among(mapped)
            src = np.concatenate([src, self.map.src[rows]])
            dst = np.concatenate([dst, self.map.dst[rows]])
            relation = np.concatenate([relation, self.map.relation[rows]])
        found = EdgeColumns(_narrow(src), relation, _narrow(dst), about)
        return found if len(found) > MOST_RECORDS else found[:]


def edge_attributes(
    lanes: Iterable[tuple[int, int, int, Attributes]],
    gaps: Iterable[tuple[int, int, int, Attributes]],
) -> dict[tuple[int, int, int, int], Attributes]:
    """Return the attributes of each scene graph edge: (frame, relation, source, destination) → attributes.

    Parameters
    ----------
    lanes : iterable of (int, int, int, dict)
        Frame, entity, lane and attributes of an ``isIn`` edge.
    gaps : iterable of (int, int, int, dict)
        Frame, follower, leader and attributes of the ``follows`` and ``leads`` edges.
    """
    known = {(frame, IS_IN, node, lane): about for frame, node, lane, about in lanes}
    for frame, one, other, about in gaps:
        known[frame, FOLLOWS, one, other] = about
        known[frame, LEADS, other, one] = dict(about)
    return known


def _divided(frame: Whole, frames: int) -> list[slice]:
    ends = np.searchsorted(frame, np.arange(frames + 1)).tolist()
    return [slice(*pair) for pair in pairwise(ends)]


def _narrow(nodes: Whole) -> Whole:
    narrow = nodes.astype(np.int32)
    return narrow if np.array_equal(narrow, nodes) else nodes
