"""Graphs out of a store again, as columns of many frames: what abstractions are made of."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.abstractions import Grounds, Seen
from sgstore.store.packing import BUCKET_BITS, FRAME_BITS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

WINDOW: Final = 8
"""Buckets that are read at once."""

_MAPS: Final = 4
"""Maps that are remembered."""

_GROUNDS: Final = """
SELECT enum_code(kind) AS kind, coalesce(name, '') AS name, coalesce(lane_type, '') AS lane_type,
       coalesce(road, '') AS road, coalesce(junction, '') AS junction, coalesce(lane, 0) AS lane
FROM map_node WHERE map_id = $map_id ORDER BY node_id DESC
"""
_GROUND_EDGES: Final = """
SELECT enum_code(relation) AS relation, src, dst FROM map_edge WHERE map_id = $map_id
ORDER BY relation, src, dst
"""
_FRAMES: Final = """
SELECT frame_id, seq, coalesce(ego, -1) AS ego FROM frame
WHERE frame_id >= $first AND frame_id <= $last ORDER BY frame_id
"""
_MOVING: Final = """
SELECT frame_id, node_id, enum_code(kind) AS kind, is_ego, x, y, z, heading FROM state
WHERE frame_id >= $first AND frame_id <= $last
"""
_STANDING: Final = """
SELECT (n.bucket << 6) + b.bit AS frame_id, n.node_id, enum_code(n.kind) AS kind
FROM node n JOIN bits b ON (n.mask & b.m) <> 0 WHERE n.bucket BETWEEN $first >> 6 AND $last >> 6
      AND (n.bucket << 6) + b.bit BETWEEN $first AND $last
"""
_EDGES: Final = """
SELECT (e.bucket << 6) + b.bit AS frame_id, enum_code(e.relation) AS relation, e.src, e.dst
FROM edge e JOIN bits b ON (e.mask & b.m) <> 0 WHERE e.bucket BETWEEN $first >> 6 AND $last >> 6
      AND (e.bucket << 6) + b.bit BETWEEN $first AND $last
"""
_EGO_LANES: Final = """
SELECT l.frame_id, l.lane FROM lane_state l JOIN frame f ON f.frame_id = l.frame_id AND f.ego = l.node_id
WHERE l.is_primary AND l.frame_id >= $first AND l.frame_id <= $last
"""


class Graphs:
    """Graphs of the traces of a store, some buckets at a time. Maps are remembered."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, Grounds] = OrderedDict()

    def of_trace(
        self, connection: DuckDBPyConnection, trace_id: int
    ) -> Iterator[tuple[NDArray[np.int64], Seen]]:
        """All frames of a trace: their numbers and graphs, window by window."""
        row = connection.execute(
            "SELECT min(bucket), max(bucket) FROM bucket WHERE trace_id = ?", [trace_id]
        ).fetchone()
        if row is None or row[0] is None:
            return
        for low in range(row[0], row[1] + 1, WINDOW):
            high = min(low + WINDOW, row[1] + 1)
            yield self.of_frames(connection, low << FRAME_BITS, (high << FRAME_BITS) - 1)

    def of_frames(
        self, connection: DuckDBPyConnection, first: int, last: int
    ) -> tuple[NDArray[np.int64], Seen]:
        """Frames of one trace from one id to another: their numbers, and their graphs."""
        where = {"first": first, "last": last}

        def columns(sql: str) -> dict[str, NDArray[Any]]:
            return connection.execute(sql, where).fetchnumpy()

        frames = columns(_FRAMES)
        ids = frames["frame_id"].astype(np.int64)

        def frame(of: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
            return np.searchsorted(ids, of["frame_id"].astype(np.int64)).astype(np.int64)

        moving, standing, edges, own = map(columns, (_MOVING, _STANDING, _EDGES, _EGO_LANES))
        still = len(standing["node_id"])
        trace = self._trace(connection, first >> (BUCKET_BITS + FRAME_BITS))
        places = {name: filled(moving[name]) for name in ("x", "y", "z", "heading")}
        for axis in "xyz":
            places[axis] = trace[f"origin_{axis}"] + places[axis]
        nodes = {
            "node_frame": np.append(frame(moving), frame(standing)),
            "node": np.append(moving["node_id"], standing["node_id"]).astype(np.int64),
            "kind": np.append(moving["kind"], standing["kind"]).astype(np.int8),
            "is_ego": np.append(moving["is_ego"].astype(np.bool_), np.zeros(still, np.bool_)),
        } | {name: np.append(of, np.full(still, np.nan)) for name, of in places.items()}
        ego_lane = np.zeros(len(ids), np.int64)
        ego_lane[frame(own)] = own["lane"]
        seen = Seen.sorted(
            len(ids),
            nodes,
            frame=frame(edges),
            relation=edges["relation"].astype(np.int8),
            src=edges["src"].astype(np.int64),
            dst=edges["dst"].astype(np.int64),
            ego_lane=ego_lane,
            grounds=self._grounds(connection, trace["map_id"], trace["digest"]),
        )
        return frames["seq"].astype(np.int64), seen

    def _trace(self, connection: DuckDBPyConnection, trace_id: int) -> dict[str, Any]:
        names = ("origin_x", "origin_y", "origin_z", "map_id", "digest")
        (row,) = connection.execute(
            "SELECT t.origin_x, t.origin_y, t.origin_z, t.map_id, m.digest"
            " FROM trace t LEFT JOIN map m ON m.map_id = t.map_id WHERE t.trace_id = ?",
            [trace_id],
        ).fetchall()
        return dict(zip(names, row, strict=True))

    def _grounds(
        self, connection: DuckDBPyConnection, map_id: int | None, digest: str
    ) -> Grounds | None:
        if map_id is None:
            return None
        if digest not in self._maps:
            where = {"map_id": map_id}
            nodes = connection.execute(_GROUNDS, where).fetchnumpy()
            edges = connection.execute(_GROUND_EDGES, where).fetchnumpy()
            self._maps[digest] = Grounds(
                kind=nodes["kind"].astype(np.int8),
                name=nodes["name"],
                lane_type=nodes["lane_type"],
                road=nodes["road"],
                junction=nodes["junction"],
                lane=nodes["lane"].astype(np.int64),
                relation=edges["relation"].astype(np.int8),
                src=edges["src"].astype(np.int64),
                dst=edges["dst"].astype(np.int64),
            )
            while len(self._maps) > _MAPS:
                self._maps.popitem(last=False)
        self._maps.move_to_end(digest)
        return self._maps[digest]


def filled(values: NDArray[Any]) -> NDArray[np.float64]:
    """Numbers, NaN where there is none."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
