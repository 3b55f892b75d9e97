"""What the graphs of a file mean: entities, parts of the road, relations; and what all have together."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.importing.attributes import part_of
from sgstore.importing.given import wrong
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from sgstore.importing.given import GivenEdge, GivenGraph, GivenNode
    from sgstore.importing.words import Meaning, Words

OFF_ROAD: Final = ("off_road", "off_road")
"""The part that whatever is on no lane is in; there is one."""

MAX_PARTS: Final = 1_000_000
"""Most parts of the road in one file."""

_REMEMBERED: Final = 1 << 16
"""Names whose meaning is remembered."""

Part = tuple[str, str]
"""A part of the road: its kind and its name."""


@dataclass(slots=True)
class Meant:
    """A graph whose words are understood.

    Attributes
    ----------
    graph : GivenGraph
    entities : dict
        Name → node and what it is.
    parts : dict
        Name → part of the road.
    ego : str
        Name of the ego; empty without one.
    edges : list of (GivenEdge, int)
        With the codes of their relations.
    """

    graph: GivenGraph
    entities: dict[str, tuple[GivenNode, Meaning]]
    parts: dict[str, Part]
    ego: str
    edges: list[tuple[GivenEdge, int]]


class Understanding:
    """Understands the graphs of one file, one after another."""

    def __init__(self, path: Path, words: Words) -> None:
        self._path = path
        self._words = words
        self._known: dict[tuple[str, str], Meaning | None] = {}
        self._relations: dict[str, str | None] = {}

    def of(self, graph: GivenGraph) -> Meant:
        """What a graph means; what has no meaning is left out and counted in ``graph.lost``, or is an error.

        Raises
        ------
        TraceError
            A node or a relation is not known, there are two egos, or the ego is no entity.
        """
        meant = Meant(graph, {}, {}, "", [])
        taken: dict[Part, str] = {}
        for node in graph.nodes.values():
            meaning = self._meaning(node)
            told = node.attributes.get("is_ego")
            is_ego = meaning.is_ego if told is None else bool(told)
            if not meaning.is_part:
                meant.entities[node.name] = (node, meaning)
                if is_ego:
                    self._check_ego(meant, node)
                    meant.ego = node.name
                continue
            if is_ego:
                raise wrong(self._path, node.where, f"the ego cannot be a {meaning.kind}")
            part = _part(node, meaning)
            if part in taken:
                both = f"{taken[part]!r} and {node.name!r}"
                raise wrong(self._path, node.where, f"{both} are the same {part[0]} {part[1]!r}")
            taken[part] = node.name
            meant.parts[node.name] = part
        for edge in graph.edges:
            relation = self._relation(edge)
            if relation is not None:
                meant.edges.append((edge, RELATION_CODE[relation]))
            else:
                what = f"relation {edge.relation}"
                graph.lost[what] = graph.lost.get(what, 0) + 1
        return meant

    def _check_ego(self, meant: Meant, node: GivenNode) -> None:
        if meant.ego:
            reason = (
                f"{meant.ego!r} and {node.name!r} are both the ego of graph {meant.graph.name!r}"
            )
            raise wrong(self._path, node.where, f"{reason}; expected one")

    def _meaning(self, node: GivenNode) -> Meaning:
        key = (node.name, node.label)
        if key not in self._known:
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[key] = self._words.meaning(node.name, node.label)
        meaning = self._known[key]
        if meaning is None:
            raise wrong(self._path, node.where, self._words.why_not_kind(node.name, node.label))
        return meaning

    def _relation(self, edge: GivenEdge) -> str | None:
        if edge.relation not in self._relations:
            if len(self._relations) >= _REMEMBERED:
                self._relations.clear()
            self._relations[edge.relation] = self._words.relation(edge.relation)
        relation = self._relations[edge.relation]
        if relation is None and not self._words.unknown_as:
            raise wrong(self._path, edge.where, self._words.why_not_relation(edge.relation))
        return relation


@dataclass(slots=True)
class Survey:
    """What all graphs of a file have together.

    Attributes
    ----------
    graphs : int
    parts : dict
        The parts of the road, with what is known of each where it comes first; ``off_road`` is the first.
    relations : set of int
        Codes of the relations that occur.
    ego : str
        Name of the ego, if it is the same wherever there is one.
    timed : int
        Graphs that tell their time.
    lost : dict
        What is known of parts of the road and cannot be kept → how often.
    """

    graphs: int = 0
    parts: dict[Part, dict[str, Any]] = field(default_factory=lambda: {OFF_ROAD: {}})
    relations: set[int] = field(default_factory=set[int])
    ego: str = ""
    timed: int = 0
    lost: dict[str, int] = field(default_factory=dict[str, int])


def survey(path: Path, graphs: Iterable[GivenGraph], words: Words) -> Survey:
    """Go through a file once: everything that is wrong with it is found here.

    Raises
    ------
    TraceError
        As :meth:`Understanding.of`; some graphs tell their time and others do not; there are too many parts.
    """
    found, understanding = Survey(), Understanding(path, words)
    egos: set[str] = set()
    names = _Names(path)
    for graph in graphs:
        names.see(graph)
        meant = understanding.of(graph)
        found.graphs += 1
        found.timed += graph.time_ns is not None
        if found.timed not in {0, found.graphs}:
            reason = (
                f"graph {graph.name!r} and those before it do not agree on whether there are times"
            )
            raise wrong(path, f"row {graph.place}", f"{reason}; expected all or none")
        for name, part in meant.parts.items():
            if part not in found.parts:
                node = graph.nodes[name]
                found.parts[part] = part_of(path, node.where, node.attributes, found.lost)
        if len(found.parts) > MAX_PARTS:
            raise wrong(path, f"row {graph.place}", f"more than {MAX_PARTS:,} parts of the road")
        found.relations.update(relation for _, relation in meant.edges)
        if meant.ego and len(egos) < 2:
            egos.add(meant.ego)
    names.check()
    found.ego = egos.pop() if len(egos) == 1 else ""
    return found


class _Names:
    """Looks whether graphs of a file have different names, of which 16 bytes each are remembered."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._digests = array("Q")
        self._places = array("q")

    def see(self, graph: GivenGraph) -> None:
        digest = blake2b(graph.name.encode("utf-8", "surrogatepass"), digest_size=8).digest()
        self._digests.append(int.from_bytes(digest, "little"))
        self._places.append(graph.place)

    def check(self) -> None:
        digests = np.frombuffer(self._digests, np.uint64)
        order = np.argsort(digests, kind="stable")
        again = np.flatnonzero(digests[order[1:]] == digests[order[:-1]])
        if len(again):
            first, second = (self._places[int(order[i])] for i in (again[0], again[0] + 1))
            reason = (
                f"a graph of the same name begins at {first} already; expected names that differ,"
            )
            reason += " and the rows of a graph together"
            raise wrong(self._path, f"row {second}", reason)


def _part(node: GivenNode, meaning: Meaning) -> Part:
    if meaning.kind == "off_road":
        return OFF_ROAD
    told = node.attributes.get("name")
    return meaning.kind, told if isinstance(told, str) and told else node.name
