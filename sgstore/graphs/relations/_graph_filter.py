"""Filter of scene graphs by settings (kinds, relations, map parts). Also changes kinds of objects."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sgstore.base.tables import taken
from sgstore.graphs.relations._registry import relations
from sgstore.graphs.relations._scene import Relation, kinds_mask
from sgstore.model.vocabulary import (
    KIND_CODE,
    KINDS,
    MAP_KINDS,
    RELATION_CODE,
    RELATIONS,
    kinds_labelled,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.maps.roads import RoadMap
    from sgstore.model.config import Config
    from sgstore.model.graph import Edges, LaneGaps, LaneStates
    from sgstore.model.vocabulary import TypeMeaning
    from sgstore.model.world import Bools, Codes, Entities, Ints


Columns = TypeVar("Columns", "Edges", "LaneStates", "LaneGaps")


class Keeping:
    """Filter of the nodes and relations of graphs, as defined by the settings.

    Parameters
    ----------
    config : Config
    road_map : RoadMap or None

    Attributes
    ----------
    parts : (K,) bool
        Mask of the kept map nodes; column i is node -1 - i. A road is kept if one of its lanes is,
        a junction if one of its roads is.
    """

    def __init__(self, config: Config, road_map: RoadMap | None) -> None:
        kept = {kind for label in config.kinds for kind in kinds_labelled(label) or ()}
        kept = kept if config.kinds else set(KINDS)
        without_map = config.lanes.granularity == "none"
        if without_map:
            kept -= set(MAP_KINDS)
        # Without a list of kinds, later kinds are kept, too.
        self._kinds = ~kinds_mask(MAP_KINDS if without_map else ())
        if config.kinds:
            self._kinds = kinds_mask(tuple(sorted(kept)))
        self._without = frozenset(config.without)
        self._no_lanes = "lane" not in kept
        self._no_map = not set(MAP_KINDS) & kept
        dropped = [RELATION_CODE[name] for name in config.without]
        self._relations: Bools = np.ones(len(RELATIONS), np.bool_)
        self._relations[dropped] = False
        self.parts: Bools = np.ones(0, np.bool_)
        self._same: Ints | None = None
        if road_map is not None:
            self.parts = self._kept_parts(road_map, config.lanes.types)
            if not config.lanes.sections:
                self._same = road_map.nodes.first_sections()
        self._everything = bool(not dropped and self.parts.all() and self._same is None)

    def _kept_parts(self, road_map: RoadMap, lane_types: tuple[str, ...]) -> Bools:
        nodes, edges = road_map.nodes, road_map.edges
        kept = self._kinds[nodes.kind]
        if not lane_types:
            return kept
        wanted = {name.lower() for name in lane_types}
        of_type = np.array([name.lower() in wanted for name in nodes.lane_type], np.bool_)
        larger = np.isin(
            nodes.kind, [KIND_CODE[k] for k in ("lane", "road", "junction", "roundabout")]
        )
        used = of_type & (nodes.kind == KIND_CODE["lane"])
        inside = edges.relation == RELATION_CODE["isIn"]
        child, parent = -1 - edges.src[inside], -1 - edges.dst[inside]
        for _ in range(
            2
        ):  # the roads of the lanes, then the junctions and roundabouts of the roads
            used[parent[used[child]]] = True
        return kept & (used | ~larger)

    def names(self, computed: Iterable[Relation], *, with_map: bool) -> set[str]:
        """Return the names of the relations that graphs can have after the filter."""
        kept = {one.name for one in computed} - self._without
        of_map = {one.name for one in relations() if one.of_map} if with_map else set[str]()
        lost = {one.name for one in relations() if self._no_lanes and one.needs_lanes}
        return (kept | of_map) - lost - ({"isIn"} if self._no_map else set())

    def entities(self, kind: Codes) -> Bools:
        """Return a mask of the objects that the settings keep, by kind."""
        return self._kinds[kind]

    def edges(self, edges: Edges) -> Edges:
        """Return the edges that the settings keep, by their relation and both nodes."""
        if self._everything:
            return edges
        kept = self._relations[edges.relation]
        if not self.parts.all():
            kept &= self._stays(edges.src) & self._stays(edges.dst)
        edges = edges if kept.all() else taken(edges, kept)
        if self._same is None:
            return edges
        src, dst = self._standing_for(edges.src), self._standing_for(edges.dst)
        merged = replace(edges, src=src, dst=dst)
        key = np.column_stack([edges.frame, edges.relation, src, dst])
        return taken(merged, np.sort(np.unique(key, axis=0, return_index=True)[1]))

    def lane_states(self, lanes: LaneStates) -> LaneStates:
        """Return the positions on lanes that the settings keep. Merged sections of a lane count once."""
        if self._everything:
            return lanes
        kept = self._stays(lanes.lane) & self._relations[RELATION_CODE["isIn"]]
        lanes = lanes if kept.all() else taken(lanes, kept)
        if self._same is None or not len(lanes):
            return lanes
        lane = self._standing_for(lanes.lane)
        order = np.lexsort((-lanes.overlap, ~lanes.primary, lane, lanes.node, lanes.frame))
        key = np.column_stack([lanes.frame, lanes.node, lane])[order]
        first = np.flatnonzero(np.append(True, (np.diff(key, axis=0) != 0).any(axis=1)))
        overlap = np.minimum(np.add.reduceat(lanes.overlap[order], first), 1.0)
        merged = taken(replace(lanes, lane=lane), order[first])
        return replace(merged, overlap=overlap)

    def gaps(self, gaps: LaneGaps) -> LaneGaps:
        """Return the gaps along lanes; an empty table if the settings drop ``leads`` and ``follows``."""
        wanted = self._relations[[RELATION_CODE["leads"], RELATION_CODE["follows"]]].any()
        return gaps if wanted else taken(gaps, np.zeros(0, np.intp))

    def present(self, present: Bools) -> Bools:
        """Reduce a mask (F, K) of the map nodes in range to those that the graphs contain."""
        present = present & self.parts
        if self._same is None:
            return present
        other = np.flatnonzero(self._same != np.arange(len(self._same)))
        frame, row = np.nonzero(present[:, other])
        present[frame, self._same[other[row]]] = True
        present[:, other] = False
        return present

    def _standing_for(self, node: Ints) -> Ints:
        """Replace each lane node by the node that represents all sections of the lane."""
        if self._same is None:
            return node
        return np.where(node < 0, -1 - self._same[np.where(node < 0, -1 - node, 0)], node)

    def _stays(self, node: Ints) -> Bools:
        return np.append(self.parts, True)[np.where(node < 0, -1 - node, -1)]


def renamed(entities: Entities, types: Mapping[str, TypeMeaning]) -> Entities:
    """Return the objects with the kinds that the settings define for their type names."""
    if not types or not len(entities):
        return entities
    kind = entities.kind.copy()
    special, subkind = list(entities.special), list(entities.subkind)
    for row, name in enumerate(entities.type_name):
        meaning = types.get(name.lower())
        if meaning is not None:
            kind[row] = KIND_CODE[meaning.kind]
            special[row], subkind[row] = meaning.special, meaning.subkind
    return replace(entities, kind=kind, special=tuple(special), subkind=tuple(subkind))
