"""Readers of the stored graphs of many frames: as columns for abstractions, or as scene graphs."""

from __future__ import annotations

import json
import re
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.base.quoting import literal
from sgstore.graphs.abstractions import GraphColumns, MapColumns
from sgstore.model.frame_ids import FRAME_BITS, SEQ_BITS, frames_of, trace_of
from sgstore.model.graph import Edges, LaneDistances, StaticPresence
from sgstore.model.scene_columns import MapRecords, SceneColumns, edge_attributes
from sgstore.model.vocabulary import MAP_KINDS, RELATION_CODE
from sgstore.store._rows import run
from sgstore.store._schema import codes_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.model.graph import SceneGraph

    Numbers = NDArray[np.unsignedinteger[Any]]


T = TypeVar("T")

WINDOW: Final = 8
"""Number of frame buckets that are read at once."""

_MAPS: Final = 4
"""Number of cached maps. Many frames share a map."""

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
SELECT l.frame_id, l.lane, l.along
FROM lane_state l JOIN frame f ON f.frame_id = l.frame_id AND f.ego = l.node_id
       JOIN {_WANTED} ON w.frame_id = f.frame_id
WHERE l.is_primary AND l.bucket BETWEEN $first >> 6 AND $last >> 6
"""
_TRACES: Final = """
SELECT trace_id, origin_x, origin_y, origin_z, coalesce(map_id, -1) AS map_id
FROM trace WHERE trace_id BETWEEN $first >> 24 AND $last >> 24 ORDER BY trace_id
"""

# Scene graphs need all columns of the views.
_SCENES: Final = f"""
SELECT f.frame_id, f.seq, f.time_ns, f.ego, t.name, f.map_id, m.digest
FROM frame f JOIN {_WANTED} ON f.frame_id = w.frame_id JOIN trace t ON t.trace_id = f.trace_id
     LEFT JOIN map m ON m.map_id = f.map_id
WHERE f.frame_id BETWEEN $first AND $last ORDER BY f.frame_id
"""
_NODES: Final = f"""
SELECT n.* FROM nodes n JOIN {_WANTED} ON n.frame_id = w.frame_id
WHERE n.frame_id BETWEEN $first AND $last AND NOT n.is_static
"""
_ENTITIES: Final = """
SELECT e.node_id, e.kind, false AS is_ego, e.name, e.ident, e.type_name, e.special, e.subkind, e.lifetime,
       true AS is_static, e.x, e.y, e.z, e.heading, 0e0 AS speed, 0e0 AS vx, 0e0 AS vy, 0e0 AS vz,
       e.length, e.width, e.height
FROM entities e JOIN (SELECT unnest($nodes) AS node_id) w ON w.node_id = e.node_id WHERE e.trace_id = $trace_id
"""
_LANES: Final = f"""
SELECT l.frame_id, l.node_id AS src, l.lane AS dst, l.overlap, l.lane_offset,
       degrees(l.heading_error) AS heading_error, l.is_primary, l.along, l.is_own
FROM lane_state l JOIN {_WANTED} ON l.frame_id = w.frame_id WHERE l.bucket BETWEEN $first >> 6 AND $last >> 6
"""
_GAPS: Final = f"""
SELECT g.frame_id, g.src, g.dst, g.gap
FROM lane_gap g JOIN {_WANTED} ON g.frame_id = w.frame_id WHERE g.bucket BETWEEN $first >> 6 AND $last >> 6
"""
_OWN: Final = f"""
SELECT a.frame_id, a.node_id, a.relation::VARCHAR, a.dst, a.attribute, a.value::VARCHAR
FROM attribute a JOIN {_WANTED} ON a.frame_id = w.frame_id WHERE a.frame_id BETWEEN $first AND $last
"""
_STILL: Final = f"CASE WHEN kind NOT IN ({', '.join(map(literal, sorted(MAP_KINDS)))}) THEN 0e0 END"
_MAP_NODES: Final = f"""
SELECT node_id, kind, false AS is_ego, name, true AS is_static, x, y, z, degrees(heading) AS heading,
       {_STILL} AS speed, {_STILL} AS vx, {_STILL} AS vy, {_STILL} AS vz, length, width,
       lane_type, road, section, lane, junction, turn, speed_limit, curvature
FROM map_node WHERE map_id = $map_id
"""
_MAP_REACH: Final = "SELECT src, dst, start FROM map_reach WHERE map_id = $map_id"
_MAP_PLACES: Final = (
    'SELECT node_id, what, lane, start, "end" FROM map_place WHERE map_id = $map_id'
)
_MAP_COURSES: Final = "SELECT lane, start, curvature, slope FROM map_course WHERE map_id = $map_id"

FIRST: Final = 2_000
"""Number of frames, of any traces, in the first read. Later reads are limited by the number of edges:"""
_EDGES_TOGETHER: Final = 2_000_000


class Graphs:
    """Reader of the graphs in a store, as columns for many frames or as scene graphs.

    Recently used maps are cached.
    """

    def __init__(self) -> None:
        self._columns: OrderedDict[str, MapColumns] = OrderedDict()
        self._records: OrderedDict[str, MapRecords] = OrderedDict()

    def of_trace(
        self, connection: DuckDBPyConnection, trace_id: int
    ) -> Iterator[tuple[NDArray[np.int64], GraphColumns]]:
        """Yield frame numbers and graphs of a whole trace, 512 frames at a time."""
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
        """For a range of frame ids in one trace, return the frame numbers and the graphs."""
        rows = connection.execute(_FRAMES, {"first": first, "last": last}).fetchnumpy()
        ids = rows["frame_id"].astype(np.int64)
        trace_id = first >> SEQ_BITS
        parts, _ = self._read(connection, ids, trace_id)
        ((_, seen),) = parts
        return rows["seq"].astype(np.int64), seen

    def of_ids(
        self, connection: DuckDBPyConnection, frame_id: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], GraphColumns]]:
        """Yield the graphs of frames in groups, with each frame's index in the input. Frame ids must ascend.

        Frames with about two million edges are read at once. Frames on one map form one :class:`GraphColumns`.
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
        """Return the graphs of some frames, grouped by road map, and the total number of edges.

        Frames without a map form one group.

        Without frames, the result is an empty graph if ``trace_id`` is given.
        """
        by_frame, by_mask = _asked(ids, (trace_id or 0) << SEQ_BITS)
        moving, own = (
            connection.execute(sql, by_frame).fetchnumpy() for sql in (_MOVING, _EGO_LANES)
        )
        standing, edges = (
            _each_frame(connection.execute(sql, by_mask).fetchnumpy())
            for sql in (_STANDING, _EDGES)
        )
        edges["relation"] = codes_of(connection, "relation")[edges["relation"]]
        for of in (moving, standing):
            of["kind"] = codes_of(connection, "kind")[of["kind"]]
        for of in (moving, standing, edges, own):
            of["frame"] = np.searchsorted(ids, of.pop("frame_id").astype(np.int64))
        traces = _Traces.of(connection, {name: by_frame[name] for name in ("first", "last")})
        trace = traces.rows(ids)
        for axis in "xyz":
            origin = traces.origin[axis][trace[moving["frame"]]]
            moving[axis] = origin + filled(moving[axis])
        moving["heading"] = filled(moving["heading"])
        map_id = traces.map_id[trace]
        maps = np.unique(map_id if trace_id is None else traces.map_id).tolist()
        # Numbers with fewer bits sort faster.
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
        return _remembered(self._columns, digest, lambda: _map_columns(connection, map_id))

    def scenes(
        self, connection: DuckDBPyConnection, frame_id: NDArray[np.int64], *, known: bool = False
    ) -> Iterator[SceneGraph]:
        """Yield the scene graphs of one trace for ascending frame ids, with all nodes, edges and attributes.

        Memory holds the columns of all frames, and the records of one graph. ``known``: include the data
        outside the graphs.
        """
        of = _of_known if known else str
        by_frame, by_mask = _asked(frame_id)
        frames = connection.execute(_SCENES, by_frame).fetchall()
        _, seq, time_ns, ego, names, map_ids, digests = zip(*frames, strict=True)
        moving = list(_records(connection, of(_NODES), by_frame))
        standing, edges = (
            _each_frame(connection.execute(of(sql), by_mask).fetchnumpy())
            for sql in (_STANDING, _EDGES)
        )
        here = standing["node_id"].astype(np.int64)
        mapped = [(one, digest) for one, digest in zip(map_ids, digests, strict=True) if digest]
        ground = None
        if mapped and (here < 0).any():
            map_id, digest = mapped[0]
            ground = _remembered(self._records, digest, lambda: _map_records(connection, map_id))
        lanes, gaps = (
            (
                (int(np.searchsorted(frame_id, frame)), src, dst, about)
                for (frame, src, dst), about in _records(connection, of(sql), by_frame)
            )
            for sql in (_LANES, _GAPS)
        )
        about = edge_attributes(lanes, gaps)
        own = _own_attributes(connection, by_frame, frame_id, about)
        columns = SceneColumns(
            trace=names[0],
            frame_id=frame_id,
            seq=np.array(seq),
            time_ns=np.array(time_ns),
            ego=ego,
            moving=(
                np.searchsorted(frame_id, [frame for (frame, _), _ in moving]),
                np.array([node for (_, node), _ in moving], np.int64),
                [about for _, about in moving],
            ),
            presence=StaticPresence(np.searchsorted(frame_id, standing["frame_id"]), here),
            standing=_standing(connection, by_frame["first"] >> SEQ_BITS, here),
            edges=Edges(
                np.searchsorted(frame_id, edges["frame_id"]),
                codes_of(connection, "relation")[edges["relation"]],
                edges["src"].astype(np.int64),
                edges["dst"].astype(np.int64),
            ),
            about=about,
            map=ground,
        )
        for graph in columns.graphs():
            for node, name, value in own.get(graph.frame_id, ()):
                if node in graph.nodes:
                    graph.nodes[node] = {name: value, **graph.nodes[node]}
            yield graph


def _of_known(sql: str) -> str:
    sql = sql.replace("SELECT n.* FROM nodes n", "SELECT n.* EXCLUDE (in_graph) FROM world_nodes n")
    return _OF_GRAPHS.sub(r"FROM known_\1", sql)


_OF_GRAPHS: Final = re.compile(r"\bFROM (node|edge|lane_state|lane_gap)\b")


def _remembered(maps: OrderedDict[str, T], digest: str, read: Callable[[], T]) -> T:
    """Return the map with a digest from a cache of recently used maps. ``read`` loads a missing map."""
    if digest not in maps:
        maps[digest] = read()
        while len(maps) > _MAPS:
            maps.popitem(last=False)
    maps.move_to_end(digest)
    return maps[digest]


def _asked(
    frame_id: NDArray[np.int64], otherwise: int = 0
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the SQL parameters of a frame selection in two forms: frame ids, and bit masks of 60 frames.

    ``otherwise``: bounds without any frame.
    """
    bucket, bit = frame_id >> FRAME_BITS, frame_id & ((1 << FRAME_BITS) - 1)
    starts, masks = bucket, bucket
    bounds = {"first": otherwise, "last": otherwise}
    if len(frame_id):
        starts = np.flatnonzero(np.append(True, np.diff(bucket) != 0))
        masks = np.bitwise_or.reduceat(1 << bit, starts)
        bounds = {"first": int(frame_id[0]), "last": int(frame_id[-1])}
    return (
        {**bounds, "frames": frame_id.tolist()},
        {**bounds, "buckets": bucket[starts].tolist(), "masks": masks.tolist()},
    )


def _records(
    connection: DuckDBPyConnection, sql: str, values: dict[str, Any]
) -> Iterator[tuple[tuple[int, ...], dict[str, Any]]]:
    """Run SQL. Yield each row as its ids (frame id, node ids) and a dict of its non-null attributes."""
    found = run(connection, sql, values)
    ids = sum(name in {"frame_id", "node_id", "src", "dst"} for name in found.columns)
    names = found.columns[ids:]
    for row in found:
        known = zip(names, row[ids:], strict=True)
        about = {name: value for name, value in known if value is not None}
        about.pop("trace", None)  # of the frame, not of the node
        yield row[:ids], about


def _own_attributes(
    connection: DuckDBPyConnection,
    by_frame: dict[str, Any],
    frame_id: NDArray[np.int64],
    of_edges: dict[tuple[int, int, int, int], dict[str, Any]],
) -> dict[int, list[tuple[int, str, Any]]]:
    """Return the user-defined attributes of nodes by frame. Add those of edges to the dict ``of_edges``."""
    of_nodes: dict[int, list[tuple[int, str, Any]]] = {}
    for frame, node, relation, dst, name, text in run(connection, _OWN, by_frame).values:
        value = json.loads(text)
        if relation is None:
            of_nodes.setdefault(frame, []).append((node, name, value))
            continue
        row = int(np.searchsorted(frame_id, frame))
        about = of_edges.setdefault((row, RELATION_CODE[relation], node, dst), {})
        about.setdefault(name, value)
    return of_nodes


def _standing(
    connection: DuckDBPyConnection, trace_id: int, here: NDArray[np.int64]
) -> dict[int, dict[str, Any]]:
    nodes = np.unique(here[here >= 0]).tolist()
    asked = {"trace_id": trace_id, "nodes": nodes}
    return {node: about for (node,), about in _records(connection, _ENTITIES, asked)}


def _map_records(connection: DuckDBPyConnection, map_id: int) -> MapRecords:
    where = {"map_id": map_id}
    nodes = {node: about for (node,), about in _records(connection, _MAP_NODES, where)}
    edges = connection.execute(_GROUND_EDGES, where).fetchnumpy()
    reach = connection.execute(_MAP_REACH, where).fetchnumpy()
    src, dst, along, other = (
        of[name].astype(np.int64) for of in (edges, reach) for name in ("src", "dst")
    )
    relation = codes_of(connection, "relation")[edges["relation"]]
    parts = connection.execute(_MAP_PLACES, where).fetchall()
    for node, what, *_ in parts:
        if what.startswith("{"):
            nodes[node] = json.loads(what) | nodes[node]
    courses = connection.execute(_MAP_COURSES, where).fetchall()
    flow = relation == RELATION_CODE["travelsTo"]
    links = [
        (a, b, nodes[a].get("junction") == nodes[b].get("junction"))
        for a, b in zip(src[flow].tolist(), dst[flow].tolist(), strict=True)
    ]
    starts = LaneDistances(along, other, reach["start"].astype(np.float64), parts, courses, links)
    return MapRecords(nodes.__getitem__, src, relation, dst, starts)


def _map_columns(connection: DuckDBPyConnection, map_id: int) -> MapColumns:
    where = {"map_id": map_id}
    nodes = connection.execute(_GROUNDS, where).fetchnumpy()
    edges = connection.execute(_GROUND_EDGES, where).fetchnumpy()
    courses = connection.execute(f"{_MAP_COURSES} ORDER BY lane DESC, start", where).fetchnumpy()
    return MapColumns(
        kind=nodes["kind"].astype(np.int8),
        name=nodes["name"],
        lane_type=nodes["lane_type"],
        road=nodes["road"],
        junction=nodes["junction"],
        lane=nodes["lane"].astype(np.int64),
        relation=codes_of(connection, "relation")[edges["relation"]],
        src=edges["src"].astype(np.int64),
        dst=edges["dst"].astype(np.int64),
        courses=(courses["lane"].astype(np.int64), courses["start"], courses["curvature"]),
    )


@dataclass(frozen=True, slots=True)
class _Traces:
    """Coordinate origin and map id of each trace in a range. Map id -1 means that the trace has no map."""

    trace_id: NDArray[np.int64]
    origin: dict[str, NDArray[np.float64]]
    map_id: NDArray[np.int64]

    @classmethod
    def of(cls, connection: DuckDBPyConnection, where: dict[str, int]) -> _Traces:
        found = connection.execute(_TRACES, where).fetchnumpy()
        origin = {axis: found[f"origin_{axis}"].astype(np.float64) for axis in "xyz"}
        return cls(found["trace_id"].astype(np.int64), origin, found["map_id"].astype(np.int64))

    def rows(self, frame_id: NDArray[np.int64]) -> NDArray[np.int64]:
        """For each frame, return the row of its trace in the table of traces."""
        return np.searchsorted(self.trace_id, trace_of(frame_id)).astype(np.int64)


def _each_frame(of: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    frame_id, row = frames_of(of.pop("bucket").astype(np.int64), of.pop("mask").astype(np.int64))
    return {"frame_id": frame_id, **{name: column[row] for name, column in of.items()}}


def _by_map(of: dict[str, NDArray[Any]], number: Numbers, maps: int) -> list[dict[str, Any]]:
    """Split table rows by the road map of their frame. Each part numbers its frames from 0."""
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
    ego_along = np.full(frames, np.nan)
    ego_along[own["frame"]] = filled(own["along"])
    return GraphColumns.sorted(
        frames,
        nodes,
        frame=edges["frame"].astype(np.int64),
        relation=edges["relation"],
        src=edges["src"].astype(np.int64),
        dst=edges["dst"].astype(np.int64),
        ego_lane=ego_lane,
        grounds=grounds,
        ego_along=ego_along,
    )


def filled(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return float64 values with NaN in place of masked values."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
