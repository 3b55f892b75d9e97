"""The scene graph of one frame, looked up by its bucket; the same as the views show of it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.graph import Reach, SceneGraph
from sgstore.store.packing import FRAME_BITS
from sgstore.store.rows import arrays, run

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

    from sgstore.store.traces import FrameRef
    from sgstore.world import Ints

_MAPS: Final = 4
"""Maps whose nodes and edges are remembered."""

_FRAME: Final = """
SELECT f.ego, f.map_id, m.digest
FROM frame f LEFT JOIN map m ON m.map_id = f.map_id WHERE f.frame_id = $frame_id
"""
_MOVING: Final = "SELECT * FROM nodes WHERE frame_id = $frame_id AND NOT is_static ORDER BY node_id"
_STANDING: Final = """
SELECT n.node_id, n.kind, e.name, e.special, e.subkind, e.x, e.y, e.z, e.heading, e.length, e.width, e.height
FROM node n JOIN entities e ON e.trace_id = $trace_id AND e.node_id = n.node_id
WHERE n.bucket = $bucket AND n.node_id >= 0 AND n.mask & $bit <> 0
ORDER BY n.node_id
"""
_PRESENT: Final = """
SELECT node_id FROM node WHERE bucket = $bucket AND node_id < 0 AND mask & $bit <> 0 ORDER BY node_id DESC
"""
_EDGES: Final = """
SELECT DISTINCT src, relation, dst FROM edge
WHERE bucket = $bucket AND mask & $bit <> 0 ORDER BY src, relation, dst
"""
_LANES: Final = """
SELECT src, dst, overlap, lane_offset, heading_error, is_primary, along, is_own
FROM lane_states WHERE frame_id = $frame_id
"""
_GAPS: Final = "SELECT src, dst, gap FROM lane_gaps WHERE frame_id = $frame_id"
_MAP_NODES: Final = """
SELECT node_id, kind, name, x, y, z, degrees(heading) AS heading, length, width, lane_type, road, section,
       lane, junction, turn, speed_limit, curvature
FROM map_node WHERE map_id = $map_id
"""
_MAP_EDGES: Final = """
SELECT src, relation::VARCHAR AS relation, dst FROM map_edge WHERE map_id = $map_id
ORDER BY src DESC, map_edge.relation, dst DESC
"""
_MAP_REACH: Final = "SELECT src, dst, start FROM map_reach WHERE map_id = $map_id"


@dataclass(frozen=True, slots=True)
class _Map:
    """Nodes and edges of a map; ``src`` and ``dst`` are -1 less the node id."""

    nodes: dict[int, dict[str, Any]]
    src: Ints
    dst: Ints
    relation: list[str]
    reach: Reach


class Scenes:
    """Scene graphs of a store, one at a time. Maps are remembered, because many frames lie on one."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, _Map] = OrderedDict()

    def graph(self, connection: DuckDBPyConnection, frame: FrameRef) -> SceneGraph:
        """The scene graph of a frame."""
        where = {
            "frame_id": frame.frame_id,
            "trace_id": frame.trace_id,
            "bucket": frame.frame_id >> FRAME_BITS,
            "bit": 1 << frame.frame_id % (1 << FRAME_BITS),
        }

        def rows(sql: str) -> list[dict[str, Any]]:
            return run(connection, sql, {k: v for k, v in where.items() if f"${k}" in sql}).dicts()

        (about,) = rows(_FRAME)
        nodes = {row["node_id"]: _known(row) for row in rows(_MOVING)}
        fixed = {"is_ego": False, "is_static": True}
        nodes |= {row["node_id"]: _known(row | fixed) for row in rows(_STANDING)}
        lanes = {(row.pop("src"), row.pop("dst")): _known(row) for row in rows(_LANES)}
        gaps = {(row.pop("src"), row.pop("dst")): _known(row) for row in rows(_GAPS)}
        known = {("isIn", *ends): about for ends, about in lanes.items()}
        known |= {("follows", *ends): about for ends, about in gaps.items()}
        known |= {("leads", b, a): dict(about) for (a, b), about in gaps.items()}
        edges = [
            (src, relation, dst, known.get((relation, src, dst), {}))
            for src, relation, dst in run(
                connection, _EDGES, {k: where[k] for k in ("bucket", "bit")}
            ).values
        ]
        present = [row["node_id"] for row in rows(_PRESENT)]
        reach = None
        if present:
            road_map = self._map(connection, about["map_id"], about["digest"])
            reach = road_map.reach
            nodes |= {node: dict(road_map.nodes[node]) for node in present}
            edges += _edges_among(road_map, present)
        return SceneGraph(
            frame_id=frame.frame_id,
            trace=frame.trace,
            seq=frame.seq,
            time_ns=frame.time_ns,
            ego=about["ego"],
            nodes=nodes,
            edges=edges,
            reach=reach,
        )

    def _map(self, connection: DuckDBPyConnection, map_id: int, digest: str) -> _Map:
        if digest not in self._maps:
            where = {"map_id": map_id}
            edges = arrays(connection, _MAP_EDGES, where)
            reach = arrays(connection, _MAP_REACH, where)
            fixed = {"is_ego": False, "is_static": True}
            self._maps[digest] = _Map(
                nodes={
                    row["node_id"]: _known(row | fixed)
                    for row in run(connection, _MAP_NODES, where).dicts()
                },
                src=-1 - edges["src"].astype(np.int64),
                dst=-1 - edges["dst"].astype(np.int64),
                relation=edges["relation"].tolist(),
                reach=Reach(
                    reach["src"].astype(np.int64),
                    reach["dst"].astype(np.int64),
                    reach["start"].astype(np.float64),
                ),
            )
            while len(self._maps) > _MAPS:
                self._maps.popitem(last=False)
        self._maps.move_to_end(digest)
        return self._maps[digest]


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """What is known of a node or of an edge."""
    return {
        name: value
        for name, value in row.items()
        if value is not None and name not in {"frame_id", "node_id"}
    }


def _edges_among(road_map: _Map, present: list[int]) -> list[tuple[int, str, int, dict[str, Any]]]:
    """Edges of a map whose ends are both present."""
    here = np.zeros(len(road_map.nodes), np.bool_)
    here[-1 - np.array(present)] = True
    rows = np.flatnonzero(here[road_map.src] & here[road_map.dst])
    src, dst = (-1 - road_map.src[rows]).tolist(), (-1 - road_map.dst[rows]).tolist()
    return [
        (a, road_map.relation[row], b, {})
        for a, row, b in zip(src, rows.tolist(), dst, strict=True)
    ]
