"""Relations that are drawn as lines in a picture of a frame, and their texts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from sgstore.draw._view import SCENERY, clean
from sgstore.model.vocabulary import (
    DIRECTIONS,
    ENTITY_KINDS,
    MAP_KINDS,
    PROXIMITY,
    RELATIONS,
    SIDES,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.graph import SceneGraph

# A frame of forty entities has thousands of edges. The picture shows the most important ones:
# proximity to the ego, and relations among matched nodes. The others are optional.

Relations = Literal["ego", "all", "none"]

Family = Literal["ego", "matched", "entity", "road", "mixed", "light"]

RANK: Final[dict[str, int]] = {name: rank for rank, name in enumerate(PROXIMITY)}

ALONG: Final = ("leads", "follows", "overlaps")

_UNMET: Final = frozenset(MAP_KINDS) | SCENERY
"""Kinds of nodes that get no proximity line to the ego: map parts and scenery."""

_ORDER: Final = (*PROXIMITY, *ALONG, *DIRECTIONS, *SIDES)


@dataclass(frozen=True, slots=True)
class DrawnLink:
    """Edges between two nodes of a scene graph, drawn as one line.

    Attributes
    ----------
    a, b : int
        Node ids. The ego is ``a``.
    there : tuple of str
        Relations from ``b`` to ``a``: ``near, inDFrontOf`` reads *b is near and in front of a*.
    back : tuple of str
        Relations from ``a`` to ``b`` that are not in ``there``.
    family : str
        Family of the line: ``ego``, ``matched``, ``light`` (a signal and the ego's lane), or the
        faint ones ``entity``, ``road`` and ``mixed``.
    """

    a: int
    b: int
    there: tuple[str, ...]
    back: tuple[str, ...]
    family: Family

    @property
    def closeness(self) -> str | None:
        """Return the closest proximity relation between the two nodes of a line; ``None`` if they have none."""
        close = [r for r in (*self.there, *self.back) if r in RANK]
        return min(close, key=RANK.__getitem__, default=None)


def links_of(graph: SceneGraph, matched: frozenset[int], relations: Relations) -> list[DrawnLink]:
    """Return the lines to draw between nodes: first the faint ones, last the lines of matched nodes.

    ``ego``: the ego's proximity to all except scenery (its other relations, if the graph has no
    proximity), signals that control the ego's lane, and every edge among matched nodes. ``all``:
    every edge. ``none``: no edges.
    """
    if relations == "none":
        return []
    pairs = _pairs(graph)
    close_matters = any(RANK.keys() & set(there + back) for there, back in pairs.values())
    asked = frozenset(PROXIMITY + ALONG if close_matters else RELATIONS)
    lane = ego_lane(graph)
    links: dict[Family, list[DrawnLink]] = {
        f: [] for f in ("road", "mixed", "entity", "light", "ego", "matched")
    }
    for (a, b), (there, back) in pairs.items():
        kinds = (graph.nodes[a].get("kind"), graph.nodes[b].get("kind"))
        family = _quiet_family(*kinds) if relations == "all" else None
        if a in matched and b in matched:
            family = "matched"
        elif "controlsTrafficOf" in there + back and lane is not None and lane in (a, b):
            family = "light"
        elif a == graph.ego and kinds[1] not in _UNMET and asked & set(there + back):
            family = "ego"
        if family is not None:
            links[family].append(
                DrawnLink(a, b, _most_telling(there), _most_telling(back, there), family)
            )
    return [link for family in links.values() for link in family]


def _quiet_family(a: object, b: object) -> Family:
    entities = (a in ENTITY_KINDS) + (b in ENTITY_KINDS)
    return ("road", "mixed", "entity")[entities]


def ego_lane(graph: SceneGraph) -> int | None:
    """Return the lane node in which the ego mainly is; ``None`` if it is in no lane."""
    lanes = [
        (not attributes.get("is_primary", False), dst)
        for src, relation, dst, attributes in graph.edges
        if src == graph.ego
        and relation == "isIn"
        and graph.nodes.get(dst, {}).get("kind") == "lane"
    ]
    return min(lanes)[1] if lanes else None


def seen_from_ego(graph: SceneGraph) -> dict[int, tuple[str, ...]]:
    """For each entity, return its relations to the ego, the most informative relation first."""
    if graph.ego is None:
        return {}
    return {
        b: _most_telling(there)
        for (a, b), (there, _) in _pairs(graph).items()
        if a == graph.ego and there and graph.nodes[b].get("kind") in ENTITY_KINDS
    }


def sentences(link: DrawnLink, names: Mapping[int, str]) -> list[str]:
    """Return the relations between two nodes as texts with the nodes' names, such as ``car 3 near car 7``."""
    a, b = (clean(names.get(node) or node, 16) for node in (link.a, link.b))
    there = [f"{b} {', '.join(link.there)} {a}"] if link.there else []
    return there + ([f"{a} {', '.join(link.back)} {b}"] if link.back else [])


def linked(graph: SceneGraph) -> dict[tuple[int, int], tuple[tuple[str, ...], tuple[str, ...]]]:
    """For each pair of connected nodes ``(a, b)``, return its relations from b to a, and from a to b.

    The ego is ``a``. The most informative relations are first.
    """
    return {
        ends: (_most_telling(there), _most_telling(back))
        for ends, (there, back) in _pairs(graph).items()
    }


def _pairs(graph: SceneGraph) -> dict[tuple[int, int], tuple[list[str], list[str]]]:
    """For each pair of connected nodes ``(a, b)``, return its relations from b to a, and from a to b."""
    pairs: dict[tuple[int, int], tuple[list[str], list[str]]] = {}
    for src, relation, dst, _ in graph.edges:
        if src == dst or src not in graph.nodes or dst not in graph.nodes:
            continue
        ahead = dst == graph.ego or (src != graph.ego and dst < src)
        there, back = pairs.setdefault((dst, src) if ahead else (src, dst), ([], []))
        (there if ahead else back).append(relation)
    return pairs


def _most_telling(relations: list[str], without: list[str] | None = None) -> tuple[str, ...]:
    kept = sorted(set(relations) - set(without or ()))
    return tuple(
        sorted(kept, key=lambda name: _ORDER.index(name) if name in _ORDER else len(_ORDER))
    )
