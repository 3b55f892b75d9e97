"""An order of the nodes of one graph that depends on the graph only, where colours do not tell all nodes apart.

Colour refinement leaves cells of nodes that look alike. Edges between two cells that hold for all pairs of
their nodes, and nodes that are alone in their cells, tell nothing about which is which; without them a graph
falls into components. Each is put in order by itself: at once if each of its cells has one node there; else by
individualising each node of one cell in turn, refining, and keeping the order with the least form (McKay and
Piperno: Practical graph isomorphism II, 2014). Two orders with the same form are an automorphism, and nodes
that automorphisms map to one another need not be tried again.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Arcs = dict[int, dict[int, int]]
"""Node → node → number of the label of the edge between them."""

Form = tuple[object, ...]


_DEEPEST: Final = 150
"""Nodes that may be individualised one within the other."""


class TooSymmetricError(Exception):
    """The work that was allowed does not suffice. Never leaves the room."""


@dataclass(slots=True)
class Search:
    """The search for the canonical order of one graph.

    Parameters
    ----------
    work : int
        How many edges may be looked at; the same graph takes the same work on every machine.
    """

    work: int
    spent: int = field(default=0)
    depth: int = field(default=0)

    def order(
        self, colours: Sequence[int], edges: Iterable[tuple[int, int, int]]
    ) -> list[int] | None:
        """Nodes 0, 1, … in an order that is the same up to automorphisms, however they were numbered.

        Parameters
        ----------
        colours : sequence of int
            Of the nodes; numbers that mean the same in every graph.
        edges : iterable of (int, int, int)
            Source, label, destination; one for a pair of nodes in one direction, no loops. The numbers of
            labels mean the same in every graph.

        Returns
        -------
        list of int or None
            ``None`` if it takes more work than is allowed.
        """
        arcs: Arcs = {node: {} for node in range(len(colours))}
        for src, label, dst in edges:
            arcs[src][dst] = label
        try:
            return self._canonical(arcs, dict(enumerate(colours)))
        except TooSymmetricError:
            return None

    def _canonical(self, arcs: Arcs, colour: dict[int, int]) -> list[int]:
        """The order of a graph: refined, cut into components, each in order."""
        colour = self._refined(arcs, colour)
        sizes = Counter(colour.values())
        alone = sorted((n for n in colour if sizes[colour[n]] == 1), key=colour.__getitem__)
        parts = [
            (_form(part, {n: colour[n] for n in order}, order), order)
            for part in _components(_telling(arcs, colour, sizes))
            for order in [self._connected(part, {n: colour[n] for n in part})]
        ]
        parts.sort(key=lambda part: part[0])
        return alone + [node for _, order in parts for node in order]

    def _connected(self, arcs: Arcs, colour: dict[int, int]) -> list[int]:
        """The order of a connected graph with stable colours."""
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
            # Beyond all colours there are: the node gets one of its own.
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
        """Stable colours: ranks, which mean the same in every graph."""
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
    """The part of a graph that tells nodes of one cell apart."""
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


def _components(arcs: Arcs) -> list[Arcs]:
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
    """A coloured graph as its nodes in an order, and its edges by their places in it."""
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
