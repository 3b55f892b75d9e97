"""Which nodes and edges of a graph are shown as a diagram, and which go together in one line.

A frame of forty entities has thousands of edges; a diagram of a few dozen is what a person can read. Shown is
the ego with its neighbours, the lanes that they are in, the roads and junctions of these, and the signals that
control them. Pure functions; no drawing package is met here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from sgstore.draw.links import ego_lane, linked
from sgstore.draw.view import SCENERY, distance
from sgstore.vocabulary import ENTITY_KINDS, PROXIMITY, SIGNALS

if TYPE_CHECKING:
    from sgstore.draw.links import Relations
    from sgstore.graph import SceneGraph

Tier = Literal["entity", "lane", "road", "junction"]
Family = Literal["ego", "matched", "entity", "light", "isIn", "map", "part"]

NEIGHBOURS: Final = 12
"""Entities around the ego that are shown, the nearest first."""
MOST: Final = 60
"""Entities that are shown at most, if every edge is asked for."""

MOST_WORDS: Final = 2
"""Relations that are written on a line, each way; the most telling come first."""

_TIERS: Final[dict[str, Tier]] = {"road": "road", "junction": "junction"}
_ALONG: Final = ("leads", "follows", "overlaps")


@dataclass(frozen=True, slots=True)
class Line:
    """Edges between two nodes, drawn as one line with an arrow from ``a`` to ``b``.

    Attributes
    ----------
    a, b : int
        Node ids.
    relations, back : tuple of str
        From a to b, and, where they are shown in the same line, from b to a.
    family : str
        ``ego``: an entity seen from the ego; ``matched``: among matched nodes; ``entity``: others among
        entities; ``light``: a signal and a lane; ``isIn``: an entity in a lane; ``map``: lane to lane;
        ``part``: a lane in its road, a road in its junction.
    """

    a: int
    b: int
    relations: tuple[str, ...]
    family: Family
    back: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """What is written on it; nothing where the look of the line says it."""
        if self.family in {"isIn", "part", "light"}:
            return ""
        there, back = (", ".join(words[:MOST_WORDS]) for words in (self.relations, self.back))
        return there if back in {"", there} else f"{there} ⇄ {back}"


@dataclass(frozen=True, slots=True)
class Excerpt:
    """What of a graph is shown.

    Attributes
    ----------
    nodes : dict
        Node id → tier; the ego first, then those nearest to it.
    lines : list of Line
        Those that matter most at the end.
    """

    nodes: dict[int, Tier]
    lines: list[Line]

    def edges(self) -> int:
        """How many edges are shown."""
        return sum(len(line.relations) + len(line.back) for line in self.lines)


def excerpt_of(graph: SceneGraph, matched: frozenset[int], relations: Relations) -> Excerpt:
    """Choose what of a graph is shown.

    Parameters
    ----------
    graph : SceneGraph
    matched : frozenset of int
        They are shown whatever else is.
    relations : {"ego", "all", "none"}
        ``ego``: of entities those that the ego is related to by distance, and only their relations to it;
        ``all``: all entities and all their relations; ``none``: no relations among entities.
    """
    entities = _entities(graph, matched, relations)
    lanes, inside = _lanes(graph, entities, matched)
    lights = _lights(graph, lanes, matched)
    parts = _parts(graph, [*lanes, *(n for n in matched if n < 0)])
    shown = [*entities, *lights, *lanes, *inside, *parts, *sorted(matched)]
    tiers: dict[int, Tier] = {n: tier_of(graph, n) for n in shown if n in graph.nodes}
    return Excerpt(tiers, _lines(graph, tiers, matched, relations))


def tier_of(graph: SceneGraph, node: int) -> Tier:
    """Where in a diagram a node belongs."""
    kind = str(graph.nodes[node].get("kind"))
    return "entity" if kind in ENTITY_KINDS else _TIERS.get(kind, "lane")


def _entities(graph: SceneGraph, matched: frozenset[int], relations: Relations) -> list[int]:
    """The ego, the matched entities, and the nearest others."""
    ego = graph.ego if graph.ego in graph.nodes else None
    first = [n for n in ([] if ego is None else [ego]) + sorted(matched) if n in graph.nodes]
    first = [n for n in dict.fromkeys(first) if tier_of(graph, n) == "entity"]
    close = _close(graph) if ego is not None and relations != "all" else None
    others = [
        node
        for node, attributes in graph.nodes.items()
        if node >= 0
        and node not in first
        and attributes.get("kind") in ENTITY_KINDS
        and attributes.get("kind") not in (SCENERY | set(SIGNALS) if close is not None else SCENERY)
        and (close is None or node in close)
    ]
    middle = graph.nodes.get(first[0] if first else -1, {})
    far = {node: distance(middle, graph.nodes[node]) for node in others}
    others.sort(key=lambda n: (math.inf if math.isnan(far[n]) else far[n], n))
    room = MOST if relations == "all" else NEIGHBOURS
    return first + others[: max(room - len(first), 0)]


def _close(graph: SceneGraph) -> set[int]:
    """Entities that the ego is related to by distance; by anything, where the graph has no distances."""
    near: set[int] = set()
    any_way: set[int] = set()
    for src, relation, dst, _ in graph.edges:
        if dst == graph.ego and src >= 0:
            any_way.add(src)
            if relation in PROXIMITY or relation in _ALONG:
                near.add(src)
    return near or any_way


def _lanes(
    graph: SceneGraph, entities: list[int], matched: frozenset[int]
) -> tuple[list[int], list[int]]:
    """Lanes that entities are in above all, and what else of the map they are in: crosswalks, off the road."""
    within: dict[int, list[tuple[bool, int]]] = {}
    other: list[int] = []
    wanted = set(entities)
    for src, relation, dst, attributes in graph.edges:
        if relation != "isIn" or src not in wanted or dst not in graph.nodes:
            continue
        if graph.nodes[dst].get("kind") == "lane":
            within.setdefault(src, []).append((not attributes.get("is_primary", False), dst))
        elif graph.nodes[dst].get("kind") in {"crosswalk", "off_road"}:
            other.append(dst)
    lanes = [min(within[node])[1] for node in entities if node in within]
    lanes += [
        n for n in sorted(matched) if n in graph.nodes and graph.nodes[n].get("kind") == "lane"
    ]
    return list(dict.fromkeys(lanes)), list(dict.fromkeys(other))


def _lights(graph: SceneGraph, lanes: list[int], matched: frozenset[int]) -> list[int]:
    """Signals that control the ego's lane, or a matched one."""
    asked = {n for n in lanes if n in matched} | {ego_lane(graph)}
    return sorted(
        {
            src
            for src, relation, dst, _ in graph.edges
            if relation == "controlsTrafficOf" and dst in asked and src in graph.nodes
        }
    )


def _parts(graph: SceneGraph, lanes: list[int]) -> list[int]:
    """Roads and junctions that lanes belong to."""
    inside: dict[int, list[int]] = {}
    for src, relation, dst, _ in graph.edges:
        if relation == "isIn" and src < 0 and dst in graph.nodes:
            inside.setdefault(src, []).append(dst)
    roads = [road for lane in lanes for road in inside.get(lane, [])]
    return list(dict.fromkeys([*roads, *(j for road in roads for j in inside.get(road, []))]))


def _lines(
    graph: SceneGraph, tiers: dict[int, Tier], matched: frozenset[int], relations: Relations
) -> list[Line]:
    lines: dict[Family, list[Line]] = {
        f: [] for f in ("part", "map", "isIn", "entity", "light", "ego", "matched")
    }
    for (a, b), (there, back) in linked(graph).items():
        if a not in tiers or b not in tiers:
            continue
        both = _together(tiers[a], tiers[b], a in matched and b in matched)
        if there and back and both is not None:
            rest = tuple(name for name in back if name not in there) or back
            lines[both].append(Line(b, a, there, both, rest))
            continue
        for src, dst, names in ((b, a, there), (a, b, back)):
            family = _family(graph, tiers, src, dst, matched)
            if names and family is not None and _is_asked(family, src, dst, graph, relations):
                lines[family].append(Line(src, dst, names, family))
    return [line for family in lines.values() for line in family]


def _together(a: Tier, b: Tier, matched: bool) -> Family | None:  # noqa: FBT001
    """The family of two nodes whose relations there and back go in one line."""
    if a == b == "lane":
        return "map"
    return "matched" if a == b == "entity" and matched else None


def _family(
    graph: SceneGraph, tiers: dict[int, Tier], src: int, dst: int, matched: frozenset[int]
) -> Family | None:
    ends = (tiers[src], tiers[dst])
    if ends == ("entity", "entity"):
        if src in matched and dst in matched:
            return "matched"
        return "ego" if graph.ego in {src, dst} else "entity"
    if ends[0] == "entity":
        return "light" if graph.nodes[src].get("kind") in SIGNALS else "isIn"
    return "map" if ends == ("lane", "lane") else "part"


def _is_asked(family: Family, src: int, dst: int, graph: SceneGraph, relations: Relations) -> bool:
    if family == "ego":
        return relations != "none" and (dst == graph.ego or relations == "all")
    return relations == "all" if family == "entity" else True
