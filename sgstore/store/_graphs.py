"""Scene graphs read from the store: one frame, or columns of many.

Graphs out of a store again, as columns of many frames: what abstractions are made of.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from sgstore.abstractions import GraphColumns, MapColumns
from sgstore.graph import LaneDistances, SceneGraph
from sgstore.store._packing import FRAME_BITS, SEQ_BITS, frames_of, trace_of
from sgstore.store._rows import arrays, run
from sgstore.store._schema import relation_codes
from sgstore.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.store._traces import FrameRef
    from sgstore.world import Ints

    Numbers = NDArray[np.unsignedinteger[Any]]


T = TypeVar("T")

WINDOW: Final = 8
"""Buckets that are read at once."""

_MAPS: Final = 4
"""Maps that are remembered, because many frames lie on one."""

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
SELECT frame_id, seq FROM frame WHERE frame_id >= $first AND frame_id <= $last ORDER BY frame_id
"""
_WANTED: Final = "(SELECT unnest($frames) AS frame_id) w"
_MASKS: Final = "(SELECT unnest($buckets) AS bucket, unnest($masks) AS mask) w"
_MOVING: Final = f"""
SELECT s.frame_id, s.node_id, enum_code(s.kind) AS kind, s.is_ego, s.x, s.y, s.z, s.heading
FROM state s JOIN {_WANTED} ON s.frame_id = w.frame_id WHERE s.frame_id BETWEEN $first AND $last
"""
_STANDING: Final = f"""
SELECT n.bucket, n.mask & w.mask AS mask, n.node_id, enum_code(n.kind) AS kind
FROM node n JOIN {_MASKS} ON n.bucket = w.bucket
WHERE n.bucket BETWEEN $first >> 6 AND $last >> 6 AND (n.mask & w.mask) <> 0
"""
_EDGES: Final = f"""
SELECT e.bucket, e.mask & w.mask AS mask, enum_code(e.relation) AS relation, e.src, e.dst
FROM edge e JOIN {_MASKS} ON e.bucket = w.bucket
WHERE e.bucket BETWEEN $first >> 6 AND $last >> 6 AND (e.mask & w.mask) <> 0
"""
_EGO_LANES: Final = f"""
SELECT l.frame_id, l.lane FROM lane_state l JOIN frame f ON f.frame_id = l.frame_id AND f.ego = l.node_id
       JOIN {_WANTED} ON w.frame_id = f.frame_id
WHERE l.is_primary AND l.frame_id BETWEEN $first AND $last
"""
_TRACES: Final = """
SELECT trace_id, origin_x, origin_y, origin_z, coalesce(map_id, -1) AS map_id
FROM trace WHERE trace_id BETWEEN $first >> 24 AND $last >> 24 ORDER BY trace_id
"""

FIRST: Final = 2_000
"""Frames of any traces that are read first; then as many as have about so many edges together:"""
_EDGES_TOGETHER: Final = 2_000_000


class _RecentMaps(Generic[T]):
    """Maps by their digests; of more than :data:`_MAPS` those that were used last."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, T] = OrderedDict()

    def get(self, digest: str, read: Callable[[], T]) -> T:
        """Return a map; it is read if it is not remembered."""
        if digest not in self._maps:
            self._maps[digest] = read()
            while len(self._maps) > _MAPS:
                self._maps.popitem(last=False)
        self._maps.move_to_end(digest)
        return self._maps[digest]


class Graphs:
    """Graphs of the traces of a store, some buckets at a time. Maps are remembered."""

    def __init__(self) -> None:
        self._maps = _RecentMaps[MapColumns]()

    def of_trace(
        self, connection: DuckDBPyConnection, trace_id: int
    ) -> Iterator[tuple[NDArray[np.int64], GraphColumns]]:
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
    ) -> tuple[NDArray[np.int64], GraphColumns]:
        """Frames of one trace from one id to another: their numbers, and their graphs."""
        rows = connection.execute(_FRAMES, {"first": first, "last": last}).fetchnumpy()
        ids = rows["frame_id"].astype(np.int64)
        trace_id = first >> SEQ_BITS
        parts, _ = self._read(connection, ids, trace_id)
        ((_, seen),) = parts
        return rows["seq"].astype(np.int64), seen

    def of_ids(
        self, connection: DuckDBPyConnection, frame_id: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], GraphColumns]]:
        """Some frames of any traces, whose ids ascend: their rows in what was asked, and their graphs.

        As many are read at once as have about two million edges; those on one map are one
        :class:`GraphColumns`.
        """
        first, many = 0, FIRST
        while first < len(frame_id):
            ids = frame_id[first : first + many]
            parts, edges = self._read(connection, ids)
            for rows, seen in parts:
                yield first + rows, seen
            first += len(ids)
            many = int(np.clip(_EDGES_TOGETHER * len(ids) // max(edges, 1), 100, 4 * len(ids)))

    def _read(
        self,
        connection: DuckDBPyConnection,
        ids: NDArray[np.int64],
        trace_id: int | None = None,
    ) -> tuple[list[tuple[NDArray[np.int64], GraphColumns]], int]:
        """Frames, by their maps; and how many edges they have. Those of no map are together, too.

        Of no frame there is a graph without frames, if it is said of which trace.
        """
        bucket, bit = ids >> FRAME_BITS, ids & ((1 << FRAME_BITS) - 1)
        starts = np.flatnonzero(np.append(True, np.diff(bucket) != 0)) if len(ids) else bucket
        masks = np.bitwise_or.reduceat(1 << bit, starts) if len(ids) else bucket
        whole = (trace_id or 0) << SEQ_BITS
        where = (
            {"first": int(ids[0]), "last": int(ids[-1])}
            if len(ids)
            else {"first": whole, "last": whole}
        )
        by_frame = where | {"frames": ids.tolist()}
        by_mask = where | {"buckets": bucket[starts].tolist(), "masks": masks.tolist()}
        moving, own = (
            connection.execute(sql, by_frame).fetchnumpy() for sql in (_MOVING, _EGO_LANES)
        )
        standing, edges = (
            _each_frame(connection.execute(sql, by_mask).fetchnumpy())
            for sql in (_STANDING, _EDGES)
        )
        edges["relation"] = relation_codes(connection)[edges["relation"]]
        for of in (moving, standing, edges, own):
            of["frame"] = np.searchsorted(ids, of.pop("frame_id").astype(np.int64))
        traces = _Traces.of(connection, where)
        trace = traces.rows(ids)
        for axis in "xyz":
            origin = traces.origin[axis][trace[moving["frame"]]]
            moving[axis] = origin + filled(moving[axis])
        moving["heading"] = filled(moving["heading"])
        map_id = traces.map_id[trace]
        maps = np.unique(map_id if trace_id is None else traces.map_id).tolist()
        # The fewer bits a number has, the sooner it is sorted.
        number = np.searchsorted(maps, map_id).astype(np.min_scalar_type(len(maps)))
        divided = [_by_map(of, number, len(maps)) for of in (moving, standing, edges, own)]
        parts = [
            (rows, _seen(len(rows), of_map, self._grounds(connection, one)))
            for one, rows, *of_map in zip(maps, _places(number, len(maps)), *divided, strict=True)
        ]
        return parts, len(edges["frame"])

    def _grounds(self, connection: DuckDBPyConnection, map_id: int) -> MapColumns | None:
        if map_id < 0:
            return None
        (digest,) = connection.execute(
            "SELECT digest FROM map WHERE map_id = ?", [map_id]
        ).fetchall()[0]
        return self._maps.get(digest, lambda: _map_columns(connection, map_id))


def _map_columns(connection: DuckDBPyConnection, map_id: int) -> MapColumns:
    where = {"map_id": map_id}
    nodes = connection.execute(_GROUNDS, where).fetchnumpy()
    edges = connection.execute(_GROUND_EDGES, where).fetchnumpy()
    return MapColumns(
        kind=nodes["kind"].astype(np.int8),
        name=nodes["name"],
        lane_type=nodes["lane_type"],
        road=nodes["road"],
        junction=nodes["junction"],
        lane=nodes["lane"].astype(np.int64),
        relation=relation_codes(connection)[edges["relation"]],
        src=edges["src"].astype(np.int64),
        dst=edges["dst"].astype(np.int64),
    )


@dataclass(frozen=True, slots=True)
class _Traces:
    """Origins and maps of the traces of a store; map -1: none."""

    trace_id: NDArray[np.int64]
    origin: dict[str, NDArray[np.float64]]
    map_id: NDArray[np.int64]

    @classmethod
    def of(cls, connection: DuckDBPyConnection, where: dict[str, int]) -> _Traces:
        found = connection.execute(_TRACES, where).fetchnumpy()
        origin = {axis: found[f"origin_{axis}"].astype(np.float64) for axis in "xyz"}
        return cls(found["trace_id"].astype(np.int64), origin, found["map_id"].astype(np.int64))

    def rows(self, frame_id: NDArray[np.int64]) -> NDArray[np.int64]:
        """The trace of each frame."""
        return np.searchsorted(self.trace_id, trace_of(frame_id)).astype(np.int64)


def _each_frame(of: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Rows with masks of buckets as rows of single frames."""
    frame_id, row = frames_of(of.pop("bucket").astype(np.int64), of.pop("mask").astype(np.int64))
    return {"frame_id": frame_id, **{name: column[row] for name, column in of.items()}}


def _by_map(of: dict[str, NDArray[Any]], number: Numbers, maps: int) -> list[dict[str, Any]]:
    """Divide rows by the maps of their frames, which are numbered anew for each map."""
    if maps == 1:
        return [of]
    frame = np.empty(len(number), np.int64)
    for rows in _places(number, maps):
        frame[rows] = np.arange(len(rows))
    anew = of | {"frame": frame[of["frame"]]}
    return [
        {name: column[rows] for name, column in anew.items()}
        for rows in _places(number[of["frame"]], maps)
    ]


def _places(number: Numbers, numbers: int) -> list[NDArray[np.int64]]:
    """Positions of each of 0 … ``numbers`` - 1."""
    order = np.argsort(number, kind="stable").astype(np.int64)
    return np.split(order, np.cumsum(np.bincount(number, minlength=numbers))[:-1])


def _seen(
    frames: int, of: list[dict[str, NDArray[Any]]], grounds: MapColumns | None
) -> GraphColumns:
    moving, standing, edges, own = of
    still = len(standing["frame"])
    nodes = {
        "node_frame": np.append(moving["frame"], standing["frame"]).astype(np.int64),
        "node": np.append(moving["node_id"], standing["node_id"]).astype(np.int64),
        "kind": np.append(moving["kind"], standing["kind"]).astype(np.int8),
        "is_ego": np.append(moving["is_ego"].astype(np.bool_), np.zeros(still, np.bool_)),
    } | {
        name: np.append(moving[name], np.full(still, np.nan)) for name in ("x", "y", "z", "heading")
    }
    ego_lane = np.zeros(frames, np.int64)
    ego_lane[own["frame"]] = own["lane"]
    return GraphColumns.sorted(
        frames,
        nodes,
        frame=edges["frame"].astype(np.int64),
        relation=edges["relation"],
        src=edges["src"].astype(np.int64),
        dst=edges["dst"].astype(np.int64),
        ego_lane=ego_lane,
        grounds=grounds,
    )


def filled(values: NDArray[Any]) -> NDArray[np.float64]:
    """Numbers, NaN where there is none."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)


# The scene graph of one frame, looked up by its bucket; the same as the views show of it --------

_FRAME: Final = """
SELECT f.ego, f.map_id, m.digest
FROM frame f LEFT JOIN map m ON m.map_id = f.map_id WHERE f.frame_id = $frame_id
"""
_MOVING_OF_FRAME: Final = (
    "SELECT * FROM nodes WHERE frame_id = $frame_id AND NOT is_static ORDER BY node_id"
)
_STANDING_OF_FRAME: Final = """
SELECT n.node_id, n.kind, e.name, e.special, e.subkind, e.x, e.y, e.z, e.heading, e.length, e.width, e.height,
       0e0 AS speed, 0e0 AS vx, 0e0 AS vy, 0e0 AS vz
FROM node n JOIN entities e ON e.trace_id = $trace_id AND e.node_id = n.node_id
WHERE n.bucket = $bucket AND n.node_id >= 0 AND n.mask & $bit <> 0
ORDER BY n.node_id
"""
_PRESENT: Final = """
SELECT node_id FROM node WHERE bucket = $bucket AND node_id < 0 AND mask & $bit <> 0 ORDER BY node_id DESC
"""
_EDGES_OF_FRAME: Final = """
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
_FIXED: Final = {"is_ego": False, "is_static": True}
_MAP_REACH: Final = "SELECT src, dst, start FROM map_reach WHERE map_id = $map_id"


@dataclass(frozen=True, slots=True)
class _Map:
    """Nodes and edges of a map; ``src`` and ``dst`` are -1 less the node id."""

    nodes: dict[int, dict[str, Any]]
    src: Ints
    dst: Ints
    relation: list[str]
    reach: LaneDistances


class Scenes:
    """Scene graphs of a store, one at a time. Maps are remembered."""

    def __init__(self) -> None:
        self._maps = _RecentMaps[_Map]()

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
        nodes = {row["node_id"]: _known(row) for row in rows(_MOVING_OF_FRAME)}
        nodes |= {row["node_id"]: _known(row | _FIXED) for row in rows(_STANDING_OF_FRAME)}
        lanes = {(row.pop("src"), row.pop("dst")): _known(row) for row in rows(_LANES)}
        gaps = {(row.pop("src"), row.pop("dst")): _known(row) for row in rows(_GAPS)}
        known = {("isIn", *ends): about for ends, about in lanes.items()}
        known |= {("follows", *ends): about for ends, about in gaps.items()}
        known |= {("leads", b, a): dict(about) for (a, b), about in gaps.items()}
        edges = [
            (src, relation, dst, known.get((relation, src, dst), {}))
            for src, relation, dst in run(
                connection, _EDGES_OF_FRAME, {k: where[k] for k in ("bucket", "bit")}
            ).values
        ]
        present = [row["node_id"] for row in rows(_PRESENT)]
        reach = None
        if present:
            map_id = about["map_id"]
            road_map = self._maps.get(about["digest"], lambda: _read_map(connection, map_id))
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


def _read_map(connection: DuckDBPyConnection, map_id: int) -> _Map:
    where = {"map_id": map_id}
    edges = arrays(connection, _MAP_EDGES, where)
    reach = arrays(connection, _MAP_REACH, where)
    return _Map(
        nodes={
            row["node_id"]: _known(row | _FIXED | _velocity(row))
            for row in run(connection, _MAP_NODES, where).dicts()
        },
        src=-1 - edges["src"].astype(np.int64),
        dst=-1 - edges["dst"].astype(np.int64),
        relation=edges["relation"].tolist(),
        reach=LaneDistances(
            reach["src"].astype(np.int64),
            reach["dst"].astype(np.int64),
            reach["start"].astype(np.float64),
        ),
    )


def _velocity(row: dict[str, Any]) -> dict[str, Any]:
    """That of a sign or light of the map, which stands; lanes and roads have none."""
    return {} if row["kind"] in MAP_KINDS else dict.fromkeys(("speed", "vx", "vy", "vz"), 0.0)


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """Attributes of a node or of an edge, without those that are NULL."""
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
