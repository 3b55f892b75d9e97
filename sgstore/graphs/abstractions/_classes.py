"""Classes of labelled graphs. Isomorphic graphs have the same class. It is computed from a canonical form.

The search finds an order of the nodes that depends on the graph only, even if colours do not
distinguish all nodes.

Colour refinement leaves cells of nodes that look alike. Two kinds of parts do not distinguish
nodes: edges between two cells that exist for all pairs of their nodes, and nodes alone in their
cells. Without them a graph splits into components. Each component is ordered by itself. If each of
its cells has one node there, the order is clear. Otherwise each node of one cell is individualised
in turn, the colours are refined, and the order with the smallest form is kept (McKay and Piperno:
Practical graph isomorphism II, 2014). Two orders with the same form are an automorphism, and a node
equivalent to a tested one need not be tested.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sgstore.base.tables import ascending, begins, chained, components
from sgstore.graphs.abstractions._columns import found
from sgstore.graphs.abstractions._lane_roles import ego_lanes
from sgstore.graphs.abstractions._subsets import OF_JUNCTION
from sgstore.model.vocabulary import MOST_RELATIONS, RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.graphs.abstractions._columns import GraphColumns, Labelled
    from sgstore.model.world import Bools, Ints


Arcs = dict[int, dict[int, int]]
"""Edges of a graph: source node → destination node → label number."""

Form = tuple[object, ...]

_DEEPEST: Final = 150
"""Largest depth of the recursive search for a canonical order."""


class TooSymmetricError(Exception):
    """Error: the search for the canonical node order of a graph exceeds its limit."""


@dataclass(slots=True)
class SymmetrySearch:
    """Search for a canonical order of the nodes of a graph. Isomorphic graphs have the same ordered form.

    Parameters
    ----------
    work : int
        Greatest number of visited edges; the same on every machine.
    """

    work: int
    spent: int = field(default=0)
    depth: int = field(default=0)

    def order(
        self, colours: Sequence[int], edges: Iterable[tuple[int, int, int]]
    ) -> list[int] | None:
        """Return the nodes of a graph in canonical order. Isomorphic graphs are equal in this order.

        Parameters
        ----------
        colours : sequence of int
            Colours of the nodes; the same numbers in every graph.
        edges : iterable of (int, int, int)
            Source, label, destination; at most one for a pair of nodes in one direction, without
            loops. Labels have the same numbers in every graph.

        Returns
        -------
        list of int or None
            ``None`` means that the search exceeds its work limit.
        """
        arcs: Arcs = {node: {} for node in range(len(colours))}
        for src, label, dst in edges:
            arcs[src][dst] = label
        try:
            return self._canonical(arcs, dict(enumerate(colours)))
        except TooSymmetricError:
            return None

    def _canonical(self, arcs: Arcs, colour: dict[int, int]) -> list[int]:
        """Return the canonical node order of a graph: colour refinement first, then each component."""
        colour = self._refined(arcs, colour)
        sizes = Counter(colour.values())
        alone = sorted((n for n in colour if sizes[colour[n]] == 1), key=colour.__getitem__)
        parts = [
            (_form(part, {n: colour[n] for n in order}, order), order)
            for part in _components_of_graph(_telling(arcs, colour, sizes))
            for order in [self._connected(part, {n: colour[n] for n in part})]
        ]
        parts.sort(key=lambda part: part[0])
        return alone + [node for _, order in parts for node in order]

    def _connected(self, arcs: Arcs, colour: dict[int, int]) -> list[int]:
        """Return the canonical node order of a connected graph with stable colours."""
        cells: dict[int, list[int]] = defaultdict(list)
        for node, of in colour.items():
            cells[of].append(node)
        if len(cells) == len(colour):
            return sorted(colour, key=colour.__getitem__)
        _, chosen = min((len(nodes), of) for of, nodes in cells.items() if len(nodes) > 1)
        tried: dict[Form, list[int]] = {}
        orbit = {node: node for node in colour}
        explored: set[int] = set()
        for node in cells[chosen]:
            if _root(orbit, node) in {_root(orbit, other) for other in explored}:
                continue
            explored.add(node)
            # A colour above all others, for this node only.
            self.depth += 1
            order = self._canonical(arcs, colour | {node: max(cells) + 1})
            self.depth -= 1
            form = _form(arcs, colour, order)
            if form in tried:
                for a, b in zip(tried[form], order, strict=True):
                    orbit[_root(orbit, a)] = _root(orbit, b)
            else:
                tried[form] = order
        return tried[min(tried)]

    def _refined(self, arcs: Arcs, colour: dict[int, int]) -> dict[int, int]:
        """Return stable node colours (colour refinement), with the same meaning in every graph."""
        back: Arcs = {node: {} for node in arcs}
        for src, to in arcs.items():
            for dst, label in to.items():
                back[dst][src] = label
        count = len(set(colour.values()))
        cost = len(arcs) + 2 * sum(map(len, arcs.values()))
        while True:
            self.spent += cost
            if self.spent > self.work or self.depth > _DEEPEST:
                raise TooSymmetricError
            keys = {
                node: (
                    colour[node],
                    sorted((label, colour[dst]) for dst, label in arcs[node].items()),
                    sorted((label, colour[src]) for src, label in back[node].items()),
                )
                for node in arcs
            }
            ranked = sorted(keys, key=keys.__getitem__)
            ranks: dict[int, int] = {}
            rank = -1
            last: object = None
            for node in ranked:
                if keys[node] != last:
                    rank, last = rank + 1, keys[node]
                ranks[node] = rank
            colour = ranks
            if rank + 1 == count:
                return colour
            count = rank + 1


def _telling(arcs: Arcs, colour: dict[int, int], sizes: Counter[int]) -> Arcs:
    """Return the edges of a graph without those that connect every node of one colour with all of another."""
    many = Counter(
        (colour[src], label, colour[dst]) for src, to in arcs.items() for dst, label in to.items()
    )
    full = {
        key
        for key, edges in many.items()
        if edges == sizes[key[0]] * (sizes[key[2]] - (key[0] == key[2]))
    }
    return {
        src: {
            dst: label
            for dst, label in to.items()
            if sizes[colour[dst]] > 1 and (colour[src], label, colour[dst]) not in full
        }
        for src, to in arcs.items()
        if sizes[colour[src]] > 1
    }


def _components_of_graph(arcs: Arcs) -> list[Arcs]:
    near: dict[int, set[int]] = {node: set(to) for node, to in arcs.items()}
    for src, to in arcs.items():
        for dst in to:
            near[dst].add(src)
    seen: set[int] = set()
    parts: list[Arcs] = []
    for start in arcs:
        if start in seen:
            continue
        seen.add(start)
        waiting, part = [start], [start]
        while waiting:
            fresh = near[waiting.pop()] - seen
            seen |= fresh
            waiting += fresh
            part += fresh
        parts.append({node: arcs[node] for node in part})
    return parts


def _form(arcs: Arcs, colour: dict[int, int], order: Sequence[int]) -> Form:
    """Return a graph in a given node order: the colour of each node, and the edges by node position."""
    place = {node: i for i, node in enumerate(order)}
    edges = sorted(
        (place[src], place[dst], label) for src, to in arcs.items() for dst, label in to.items()
    )
    return (tuple(colour[node] for node in order), tuple(edges))


def _root(orbit: dict[int, int], node: int) -> int:
    while orbit[node] != node:
        orbit[node] = orbit[orbit[node]]
        node = orbit[node]
    return node


# Classes of graphs: 128 bits of a canonical form, equal exactly for isomorphic graphs. Two labelled
# multigraphs have the same class if and only if there is a bijection of their nodes that preserves
# the labels of nodes and, for each ordered pair of nodes, the count of each edge label (except for
# a collision of 128-bit hashes). A class depends only on its graph: not on the machine, and not on
# other graphs. Colour refinement processes all graphs of a block at once. Colours are 64-bit hashes
# and only *order* the nodes; the class is the hash of the whole graph in that order. Therefore a
# collision of colours costs time but never gives a wrong result. If several nodes keep the same
# colour, edges between all nodes of two cells are ignored, and the rest splits into components. If
# no component has two nodes of one colour, similar nodes are interchangeable (for example twins):
# with stable colours, components that share a colour are then isomorphic. Only the other graphs
# need the search in :mod:`sgstore.graphs.abstractions._classes`, which has a work limit. Beyond the limit
# the class is unknown instead of wrong.

Words = NDArray[np.uint64]

WORK: Final = 5_000_000
"""Largest number of edge visits to find the order of one graph. It takes some seconds."""

REMEMBERED: Final = 8192
"""Number of graphs whose classes are cached."""

_A: Final = np.uint64(0x9E3779B97F4A7C15)
_B: Final = np.uint64(0xBF58476D1CE4E5B9)
_C: Final = np.uint64(0x94D049BB133111EB)
_D: Final = np.uint64(0xD6E8FEB86659FD93)
_SHIFT: Final = np.uint64(32)
"""Constants of the hash functions SplitMix64 and Mulvey's rrmxmx."""

_EDGE: Final = np.dtype([("src", "<u4"), ("dst", "<u4"), ("low", "<u8"), ("high", "<u8")])


def classes_of(graphs: Labelled, work: int = WORK) -> list[str]:
    """Return the class of each graph: 32 hexadecimal digits, or empty if the graph is too symmetric.

    Raises
    ------
    ValueError
        An end of an edge is not a node of its frame: a defect of the abstraction.
    """
    return Classes(work).of(graphs)


class Classes:
    """Cache for the classes of graphs. Isomorphic graphs have the same class.

    Parameters
    ----------
    work : int
        Work limit for one graph.
    """

    def __init__(self, work: int = WORK) -> None:
        self._work = work
        self._known: OrderedDict[bytes, str] = OrderedDict()

    def of(self, *graphs: Labelled) -> list[str]:
        """Return the class of each graph, for several blocks of labelled graphs at once."""
        block = _Block.beside([_Block.of(one) for one in graphs])
        contents = block.contents()
        fresh = {content: i for i, content in enumerate(contents) if content not in self._known}
        rows = sorted(fresh.values())
        for row, name in zip(rows, block.taken(rows).classes(self._work), strict=True):
            self._known[contents[row]] = name
        answer = [self._known[content] for content in contents]
        while len(self._known) > REMEMBERED:
            self._known.popitem(last=False)
        return answer


_TOLD: Final = np.zeros(MOST_RELATIONS, np.bool_)
_TOLD[[RELATION_CODE[name] for name in OF_JUNCTION]] = True


def contents_of(seen: GraphColumns) -> list[bytes]:
    """Return a 256-bit hash for each frame. Equal hashes mean equal classes in the standard abstractions.

    The bits cover the nodes, the edges of ``junction``, and the lanes relative to the ego. Two
    equal frames have the same classes in ``E``, ``EL``, ``ER``, ``RSV`` and ``junction``; only one
    of them needs a labelled graph. Both must have the same map.
    """
    lanes = ego_lanes(seen)
    own = seen.kind.astype(np.int64) * 2 + seen.is_ego
    rows = np.flatnonzero(_TOLD[seen.relation])
    sums = np.zeros((4, seen.frames), np.uint64)
    _told(sums[:2], 0, seen.node_frame, seen.node, own)
    _told(sums[:2], 1, lanes.frame, lanes.strand, lanes.role)
    _told(sums[:2], 2, np.arange(seen.frames), seen.ego_lane)
    _told(sums[2:], 3, seen.frame[rows], seen.src[rows], seen.dst[rows], seen.relation[rows])
    return [row.tobytes() for row in np.ascontiguousarray(sums.T)]


def _told(sums: Words, sort: int, frame: Ints, *columns: NDArray[Any]) -> None:
    """Compute a hash of each table row, and add it to the sum of the row's frame."""
    if not len(frame):
        return
    words = np.full(len(frame), sort, np.uint64)
    for column, factor in zip(columns, (_A, _B, _C), strict=False):
        words += column.astype(np.int64, copy=False).view(np.uint64) * factor
    told = _mixed(words)
    starts = np.flatnonzero(begins(frame))
    for total, values in zip(sums, (told, _mixed(told * _D + words)), strict=True):
        np.add.at(total, frame[starts], np.add.reduceat(values, starts))


@dataclass(frozen=True)
class _Block:
    """Labelled graphs of several frames as columns. Nodes are sorted by graph.

    Parallel edges are merged: the words of the label are the sums of their words, which still
    distinguish any two sets. ``low`` and ``high`` are the two words of the digests of labels.
    """

    graphs: int
    graph: Ints
    node: Ints
    node_low: Words
    node_high: Words
    edge_graph: Ints
    src: Ints
    dst: Ints
    low: Words
    high: Words

    @classmethod
    def of(cls, graphs: Labelled) -> _Block:
        words = _digests(graphs.labels)
        on_edges = _on_edges(words, graphs.bundles)
        ends = np.concatenate([graphs.src, graphs.dst])
        rows = found(graphs.node_frame, graphs.node, np.tile(graphs.frame, 2), ends)
        if rows.min(initial=0) < 0:
            raise ValueError("an edge of an abstraction ends at a node outside its frame")
        src, dst = rows.reshape(2, -1)
        key = src * len(graphs.node) + dst
        order = ascending(key)
        first = np.flatnonzero(begins(key[order]))
        label, alone = on_edges[graphs.label[order]], order[first]
        low, high = label.T.copy() if len(first) == len(key) else np.add.reduceat(label, first).T
        node_low, node_high = words[graphs.node_label].T.copy()
        return cls(
            graphs.frames,
            graphs.node_frame,
            graphs.node,
            node_low,
            node_high,
            graphs.frame[alone],
            src[alone],
            dst[alone],
            low,
            high,
        )

    @classmethod
    def beside(cls, blocks: Sequence[_Block]) -> _Block:
        """Concatenate the graphs of several blocks."""
        if len(blocks) == 1:
            return blocks[0]
        graphs = np.cumsum([0, *(block.graphs for block in blocks)])
        nodes = np.cumsum([0, *(len(block.node) for block in blocks)])
        moved = [
            replace(b, graph=b.graph + g, edge_graph=b.edge_graph + g, src=b.src + n, dst=b.dst + n)
            for b, g, n in zip(blocks, graphs.tolist(), nodes.tolist(), strict=False)
        ]
        return replace(chained(moved), graphs=int(graphs[-1]))

    def contents(self) -> list[bytes]:
        """Return a 128-bit hash of each graph. Graphs with equal nodes, edges and labels have equal hashes."""
        of_node = _mixed(self.node.view(np.uint64) * _A + self.node_low)
        src, dst = self.node[self.src].view(np.uint64), self.node[self.dst].view(np.uint64)
        of_edge = _mixed(_mixed(src * _B + self.low) + dst * _C)
        sums = np.zeros((self.graphs, 4), np.uint64)
        for column, (owner, values) in enumerate(
            (
                (self.graph, of_node),
                (self.graph, _mixed(of_node * _D + self.node_high)),
                (self.edge_graph, of_edge),
                (self.edge_graph, _mixed(of_edge * _D + self.high)),
            )
        ):
            sums[:, column] = _sums(owner, values, self.graphs)
        return [blake2b(row.astype("<u8").tobytes(), digest_size=16).digest() for row in sums]

    def taken(self, rows: list[int]) -> _Block:
        """Return some of the labelled graphs in the block, given in ascending order."""
        if len(rows) == self.graphs:
            return self
        number = np.full(self.graphs, -1)
        number[rows] = np.arange(len(rows))
        nodes = np.flatnonzero(number[self.graph] >= 0)
        place = np.zeros(len(self.graph), np.int64)
        place[nodes] = np.arange(len(nodes))
        edges = np.flatnonzero(number[self.edge_graph] >= 0)
        return _Block(
            graphs=len(rows),
            graph=number[self.graph[nodes]],
            **{name: getattr(self, name)[nodes] for name in ("node", "node_low", "node_high")},
            edge_graph=number[self.edge_graph[edges]],
            **{name: place[getattr(self, name)[edges]] for name in ("src", "dst")},
            **{name: getattr(self, name)[edges] for name in ("low", "high")},
        )

    def classes(self, work: int) -> list[str]:
        """Return the class of each graph in the block."""
        order, known = _ordered(self, _refined(self), work)
        return _hashed(self, order, known)


@lru_cache(maxsize=64)
def _digests(labels: tuple[str, ...]) -> NDArray[np.uint64]:
    """Return a 128-bit hash of each label as two words, (L, 2)."""
    raw = b"".join(
        blake2b(label.encode("utf-8", "surrogatepass"), digest_size=16).digest() for label in labels
    )
    return np.frombuffer(raw, "<u8").astype(np.uint64).reshape(-1, 2)


def _on_edges(words: Words, bundles: tuple[tuple[int, ...], ...]) -> Words:
    """Return the hashes of edge labels, followed by the hashes of label sets."""
    words = _mixed(words)
    several = bundles[::-1]
    flat = np.array([label for bundle in several for label in bundle], np.int64)
    sums = np.zeros((len(several), 2), np.uint64)
    np.add.at(sums, np.repeat(np.arange(len(several)), [*map(len, several)]), words[flat])
    return np.concatenate([words, sums])


def _mixed(words: Words) -> Words:
    words = words ^ (words >> _SHIFT)
    for factor in (_B, _C):
        words *= factor
        words ^= words >> _SHIFT
    return words


def _sums(owner: Ints, values: Words, count: int) -> Words:
    """Return for each graph (or node) the sum of its hashes, modulo 2⁶⁴."""
    total = np.zeros(count, np.uint64)
    if len(owner):
        starts = np.flatnonzero(begins(owner))
        total[owner[starts]] = np.add.reduceat(values, starts)
    return total


def _refined(block: _Block) -> Words:
    """Return stable node colours (colour refinement) for all graphs of a block, as hash words.

    Each graph stops independently, when a round distinguishes no more nodes. Therefore its number
    of rounds and its colours depend on the graph alone. A loop is part of the first colour.
    """
    nodes = len(block.graph)
    colour = block.node_low.copy()
    loops = block.src == block.dst
    np.add.at(colour, block.src[loops], _mixed(block.low[loops] + _D))
    rows = np.flatnonzero(~loops)
    src, dst = block.src[rows], block.dst[rows]
    out_label, back = block.low[rows], ascending(dst)
    src_back, dst_back, in_label = src[back], dst[back], out_label[back] * _D
    size = np.bincount(block.graph, minlength=block.graphs)
    cells = _cells(block, colour)
    active = (size > cells) & (size > 0)
    while active.any():
        out = _sums(src, _mixed(colour[dst] * _A + out_label), nodes)
        into = _sums(dst_back, _mixed(colour[src_back] * _B + in_label), nodes)
        fresh = _mixed(colour + _mixed(out) * _C + _mixed(into) * _A)
        now = _cells(block, fresh)
        grown = active & (now > cells)
        colour = np.where(grown[block.graph], fresh, colour)
        cells = np.where(grown, now, cells)
        active = grown & (cells < size)
    return colour


def _cells(block: _Block, colour: Words) -> Ints:
    """Return the number of different node colours in each graph."""
    order = np.lexsort((colour, block.graph))
    graph = block.graph[order]
    return np.bincount(graph[begins(graph, colour[order])], minlength=block.graphs)


def _ordered(block: _Block, colour: Words, work: int) -> tuple[Ints, Bools]:
    """Return the nodes of each graph in canonical order, and a mask of graphs with a successful search."""
    nodes = len(block.graph)
    order = np.lexsort((colour, block.graph))
    cell = np.zeros(nodes, np.int64)
    cell[order] = np.cumsum(begins(block.graph[order], colour[order])) - 1
    size = np.bincount(cell, minlength=1)
    known = np.ones(block.graphs, np.bool_)
    if not nodes or size.max() == 1:
        return order, known
    part = _components_of_block(block, cell, size)
    order = np.lexsort((part, cell))  # cells are numbered graph after graph
    alike = np.flatnonzero(
        (cell[order][1:] == cell[order][:-1]) & (part[order][1:] == part[order][:-1])
    )
    for number in np.unique(block.graph[order[alike]]).tolist():
        rows = np.flatnonzero(block.graph == number)
        found_order = _searched(block, cell, rows, number, work)
        known[number] = found_order is not None
        if found_order is not None:
            order[rows] = found_order  # the rows of a graph are contiguous, and so are their places
    return order, known


def _components_of_block(block: _Block, cell: Ints, size: Ints) -> Ints:
    """Return the component of each node: nodes joined by edges that can distinguish nodes of equal colour."""
    src, dst = block.src, block.dst
    rows = np.flatnonzero((src != dst) & (size[cell[src]] > 1) & (size[cell[dst]] > 1))
    if not len(rows):
        return np.arange(len(cell))
    src, dst = src[rows], dst[rows]
    a, b = cell[src], cell[dst]
    keys = (block.high[rows], block.low[rows], b, a)
    order = np.lexsort(keys)
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(begins(*(key[order] for key in keys))) - 1
    partial = np.bincount(group)[group] < size[a] * (size[b] - (a == b))
    return components(len(cell), src[partial], dst[partial])


def _searched(block: _Block, cell: Ints, rows: Ints, number: int, work: int) -> Ints | None:
    """Return the nodes of one graph in canonical order; ``None`` if the search exceeds its limit."""
    first, last = np.searchsorted(block.edge_graph, [number, number + 1])
    src, dst = block.src[first:last], block.dst[first:last]
    low, high = block.low[first:last].tolist(), block.high[first:last].tolist()
    rank = {label: i for i, label in enumerate(sorted(set(zip(low, high, strict=True))))}
    edges = [
        (a, rank[label], b)
        for a, b, *label_words in zip(
            (src - rows[0]).tolist(), (dst - rows[0]).tolist(), low, high, strict=True
        )
        for label in [tuple(label_words)]
        if a != b
    ]
    colours = (cell[rows] - cell[rows].min()).tolist()
    order = SymmetrySearch(work).order(colours, edges)
    return None if order is None else rows[order]


def _hashed(block: _Block, order: Ints, known: Bools) -> list[str]:
    """Return a hash of each graph, computed in canonical node order."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    nodes = np.stack([block.node_low[order], block.node_high[order]], axis=1).astype("<u8")
    sorted_edges = ascending(place[block.src] * len(order) + place[block.dst])
    node_ends = np.searchsorted(block.graph, np.arange(block.graphs + 1))
    edge_ends = np.searchsorted(block.edge_graph[sorted_edges], np.arange(block.graphs + 1))
    start = node_ends[block.edge_graph[sorted_edges]]
    edges = np.empty(len(sorted_edges), _EDGE)
    edges["src"] = place[block.src[sorted_edges]] - start
    edges["dst"] = place[block.dst[sorted_edges]] - start
    edges["low"], edges["high"] = block.low[sorted_edges], block.high[sorted_edges]
    names: list[str] = []
    for number in range(block.graphs):
        form = blake2b(digest_size=16, person=b"sgstore class 1")
        form.update(int(node_ends[number + 1] - node_ends[number]).to_bytes(8, "little"))
        form.update(nodes[node_ends[number] : node_ends[number + 1]].tobytes())
        form.update(edges[edge_ends[number] : edge_ends[number + 1]].tobytes())
        names.append(form.hexdigest() if known[number] else "")
    return names
