"""Graphs that are understood as blocks of scene graphs, as ingest makes them of recordings."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.graph import Edges, GraphBlock, LaneGaps, LaneStates, StaticPresence
from sgstore.importing._resolve import LONGEST, columns_of, gap_of, lane_state_of, part_of, state_of
from sgstore.roads import MapEdges, MapNodes, Ribbons, RoadMap
from sgstore.vocabulary import KIND_CODE, MAP_KINDS, RELATION_CODE
from sgstore.world import Entities, FrameBlock, MessageRefs, States

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.importing._resolve import GivenNode, LabelMeaning, Meant, Part
    from sgstore.world import Ints


_IS_IN: Final = RELATION_CODE["isIn"]
_FOLLOWS: Final = RELATION_CODE["follows"]
_LEADS: Final = RELATION_CODE["leads"]
_LANE_COLUMNS: Final = ("overlap", "offset", "heading_error", "along")
_OF_EDGES: Final = frozenset({"lane_dist"})
"""Attributes that the graphs of this house give edges, and that follow from others."""
_LONGEST_VALUE: Final = 10_000
"""Longest value of an attribute of a client's own, as JSON; characters."""


def parts_map(name: str, variant: str, parts: Mapping[Part, Mapping[str, Any]]) -> RoadMap:
    """A road map of named parts, without any geometry and without edges: these are in the frames.

    Parameters
    ----------
    name, variant : str
        As :class:`sgstore.roads.RoadMap` has them; there is no text.
    parts : mapping
        Kind and name of each part → what is known of it; ``off_road`` is the first.
    """
    order = sorted(parts, key=lambda part: MAP_KINDS.index(part[0]))
    order.insert(0, order.pop(next(i for i, part in enumerate(order) if part[0] == "off_road")))
    nodes = MapNodes.of([kind for kind, _ in order], [own for _, own in order])
    for row, part in enumerate(order):
        known = parts[part]
        for column in ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature"):
            getattr(nodes, column)[row] = known.get(column, np.nan)
        for column in ("section", "lane"):
            getattr(nodes, column)[row] = known.get(column, 0)
    texts: dict[str, Any] = {
        column: tuple(str(parts[part].get(column, "")) for part in order)
        for column in ("road", "junction", "turn")
    }
    texts["lane_type"] = tuple(
        parts[part].get("lane_type", "driving") if part[0] == "lane" else "" for part in order
    )
    columns = {
        column: getattr(nodes, column)
        for column in nodes.__dataclass_fields__
        if column not in texts
    }
    none = np.zeros(0, np.int64)
    empty = Ribbons(np.zeros(1, np.int64), *(np.zeros(0) for _ in range(8)))
    return RoadMap(
        name=name,
        text="",
        variant=variant,
        nodes=MapNodes(**(columns | texts)),
        edges=MapEdges(none.astype(np.int8), none, none),
        ribbons=empty,
        shapes=np.full(len(order), None, object),
    )


class Blocks:
    """Makes blocks of graphs, one after another; entities keep their node ids.

    Parameters
    ----------
    path : Path
    road_map : RoadMap
        Of :func:`parts_map`.
    period_ns : int
        Time from one graph to the next where the file does not tell it; ns.
    any_state : bool
        Whether traffic lights may show what no vocabulary has.

    Attributes
    ----------
    own : list
        Attributes of a client's own in the last block: frame, node, relation (-1: of the node) and other end,
        name, value as JSON.
    """

    def __init__(
        self, path: Path, road_map: RoadMap, period_ns: int, *, any_state: bool = False
    ) -> None:
        self._path = path
        self._period = period_ns
        self._any_state = any_state
        self.own: list[tuple[int, int, int, int, str, str]] = []
        names = zip(road_map.nodes.kind.tolist(), road_map.nodes.name, strict=True)
        codes = {code: kind for kind, code in KIND_CODE.items()}
        self._parts = {(codes[kind], name): -1 - row for row, (kind, name) in enumerate(names)}
        self._entities: dict[tuple[str, str], int] = {}
        self._seq = 0

    def block(self, graphs: Sequence[Meant]) -> GraphBlock:
        """The next graphs as a block of frames; what cannot be kept is counted in each graph's ``lost``."""
        new: list[tuple[GivenNode, LabelMeaning]] = []
        self.own = []
        first = len(self._entities)
        ids = [self._ids(meant, new) for meant in graphs]
        seq = self._seq + np.arange(len(graphs))
        self._seq += len(graphs)
        told = [meant.graph.time_ns for meant in graphs]
        time_ns = np.array(
            [s * self._period if t is None else t for s, t in zip(seq.tolist(), told, strict=True)],
            np.int64,
        )
        many = [len(meant.entities) for meant in graphs]
        ego = [of[meant.ego] if meant.ego else -1 for of, meant in zip(ids, graphs, strict=True)]
        frames = FrameBlock(
            seq=seq,
            time_ns=time_ns,
            log_time_ns=time_ns,
            offsets=np.cumsum([0, *many], dtype=np.int64),
            states=self._states(graphs, ids),
            ego=np.array(ego, np.int64),
            entities=_entities(first, new),
            scenery=States.of(node=np.zeros(0, np.int64)),
            messages=MessageRefs(*(np.zeros(0, np.int64) for _ in range(5))),
        )
        presence = [
            (frame, self._parts[part])
            for frame, meant in enumerate(graphs)
            for part in meant.parts.values()
        ]
        for frame, meant in enumerate(graphs):
            for name, part in meant.parts.items():
                node = meant.graph.nodes[name]
                _, own = part_of(self._path, node.where, node.attributes)
                self._keep(meant.graph.lost, (frame, self._parts[part], -1, 0), own)
        edges, lanes, gaps = self._edges(graphs, ids)
        return GraphBlock(frames, StaticPresence(*_whole(presence, 2)), edges, lanes, gaps)

    def _keep(
        self, lost: dict[str, int], at: tuple[int, int, int, int], own: Mapping[str, Any]
    ) -> None:
        """Take note of attributes of a client's own; what JSON cannot hold, or is very long, is lost."""
        for name, value in own.items():
            if value is None or name in _OF_EDGES:
                continue
            try:
                text = json.dumps(value, ensure_ascii=False, allow_nan=False)
            except ValueError:
                text = ""
            if 0 < len(text) <= _LONGEST_VALUE and 0 < len(name) <= LONGEST:
                self.own.append((*at, name, text))
            else:
                what = f"attribute {name[:80]}" + (" of edges" if at[2] >= 0 else "")
                lost[what] = lost.get(what, 0) + 1

    def _ids(self, meant: Meant, new: list[tuple[GivenNode, LabelMeaning]]) -> dict[str, int]:
        """Node ids of a graph by name."""
        found = {name: self._parts[part] for name, part in meant.parts.items()}
        for name, (node, meaning) in meant.entities.items():
            key = (name, meaning.kind)
            if key not in self._entities:
                self._entities[key] = len(self._entities)
                new.append((node, meaning))
            found[name] = self._entities[key]
        return found

    def _states(self, graphs: Sequence[Meant], ids: Sequence[Mapping[str, int]]) -> States:
        nodes: list[int] = []
        rows: list[dict[str, float]] = []
        for frame, (meant, of) in enumerate(zip(graphs, ids, strict=True)):
            lost = meant.graph.lost
            for name in sorted(meant.entities, key=of.__getitem__):
                node = meant.entities[name][0]
                state, own = state_of(
                    self._path, node.where, node.attributes, lost, any_state=self._any_state
                )
                nodes.append(of[name])
                rows.append(state)
                self._keep(lost, (frame, of[name], -1, 0), own)
        return States.of(node=np.array(nodes, np.int64), **columns_of(rows))

    def _edges(
        self, graphs: Sequence[Meant], ids: Sequence[Mapping[str, int]]
    ) -> tuple[Edges, LaneStates, LaneGaps]:
        rows: list[tuple[int, int, int, int]] = []
        inside: dict[tuple[int, int, int], dict[str, float]] = {}
        gaps: dict[tuple[int, int, int], float] = {}
        for frame, (meant, of) in enumerate(zip(graphs, ids, strict=True)):
            for edge, relation in meant.edges:
                own = edge.attributes
                src, dst = of[edge.src], of[edge.dst]
                rows.append((frame, relation, src, dst))
                part = meant.parts.get(edge.dst, ("",))[0]
                if relation == _IS_IN and src >= 0 and part == "lane":
                    state, own = lane_state_of(self._path, edge.where, edge.attributes)
                    inside[frame, src, dst] = state
                elif relation in {_FOLLOWS, _LEADS}:
                    ends = (src, dst) if relation == _FOLLOWS else (dst, src)
                    gap, own = gap_of(self._path, edge.where, edge.attributes)
                    gaps[frame, *ends] = gaps.get((frame, *ends), gap) if math.isnan(gap) else gap
                if own:
                    self._keep(meant.graph.lost, (frame, src, relation, dst), own)
        frame, relation, src, dst = _whole(rows, 4)
        edges = Edges(frame, relation.astype(np.int8), src, dst)
        frame, src, dst = _whole(list(gaps), 3)
        distances = LaneGaps(frame, src, dst, np.array(list(gaps.values()), np.float64))
        return edges, _lane_states(inside), distances


def _entities(first: int, new: Sequence[tuple[GivenNode, LabelMeaning]]) -> Entities:
    def text(node: GivenNode, name: str, otherwise: str) -> str:
        told = node.attributes.get(name)
        return told[:200] if isinstance(told, str) else otherwise

    return Entities(
        first=first,
        ident=tuple(text(node, "ident", node.name) for node, _ in new),
        kind=np.array([KIND_CODE[meaning.kind] for _, meaning in new], np.int8),
        special=tuple(text(node, "special", meaning.special) for node, meaning in new),
        subkind=tuple(text(node, "subkind", meaning.subkind) for node, meaning in new),
        type_name=tuple(text(node, "type_name", meaning.type_name) for node, meaning in new),
        static=np.zeros(len(new), np.bool_),
        map_ref=("",) * len(new),
    )


def _lane_states(inside: Mapping[tuple[int, int, int], dict[str, float]]) -> LaneStates:
    """Lanes of entities. A lane is the primary one if the file says so, or if it is the only one."""
    frame, node, lane = _whole(list(inside), 3)
    rows = list(inside.values())
    known = {
        name: np.array([row.get(name, np.nan) for row in rows])
        for name in (*_LANE_COLUMNS, "primary")
    }
    _, whose, often = np.unique(
        np.stack([frame, node]), axis=1, return_inverse=True, return_counts=True
    )
    only = often[whose.reshape(-1)] == 1
    primary = np.where(np.isnan(known["primary"]), only, known["primary"] == 1).astype(np.bool_)
    columns: dict[str, Any] = known | {"frame": frame, "node": node, "lane": lane}
    columns |= {"primary": primary, "own": primary}
    return LaneStates(**{column.name: columns[column.name] for column in fields(LaneStates)})


def _whole(rows: Sequence[tuple[int, ...]], width: int) -> list[Ints]:
    """Rows of whole numbers as columns."""
    return list(np.array(rows, np.int64).reshape(-1, width).T.copy())
