"""Graphs out of a store again, as columns of many frames: what abstractions are made of."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.abstractions import Grounds, Seen
from sgstore.store.covering import SEQ_BITS, frames_of, trace_of
from sgstore.store.packing import FRAME_BITS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Numbers = NDArray[np.unsignedinteger[Any]]

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
        rows = connection.execute(_FRAMES, {"first": first, "last": last}).fetchnumpy()
        ids = rows["frame_id"].astype(np.int64)
        trace_id = first >> SEQ_BITS
        parts, _ = self._read(connection, ids, trace_id)
        ((_, seen),) = parts
        return rows["seq"].astype(np.int64), seen

    def of_ids(
        self, connection: DuckDBPyConnection, frame_id: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], Seen]]:
        """Some frames of any traces, whose ids ascend: their rows in what was asked, and their graphs.

        As many are read at once as have about two million edges; those on one map are one :class:`Seen`.
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
    ) -> tuple[list[tuple[NDArray[np.int64], Seen]], int]:
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

    def _grounds(self, connection: DuckDBPyConnection, map_id: int) -> Grounds | None:
        if map_id < 0:
            return None
        (digest,) = connection.execute(
            "SELECT digest FROM map WHERE map_id = ?", [map_id]
        ).fetchall()[0]
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


@dataclass(frozen=True, slots=True)
class _Traces:
    """Where the traces of a store have their origin, and their maps; -1: none."""

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
    """What belongs to the frames of each map, which are numbered anew there."""
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
    """Where each of 0 … ``numbers`` - 1 stands."""
    order = np.argsort(number, kind="stable").astype(np.int64)
    return np.split(order, np.cumsum(np.bincount(number, minlength=numbers))[:-1])


def _seen(frames: int, of: list[dict[str, NDArray[Any]]], grounds: Grounds | None) -> Seen:
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
    return Seen.sorted(
        frames,
        nodes,
        frame=edges["frame"].astype(np.int64),
        relation=edges["relation"].astype(np.int8),
        src=edges["src"].astype(np.int64),
        dst=edges["dst"].astype(np.int64),
        ego_lane=ego_lane,
        grounds=grounds,
    )


def filled(values: NDArray[Any]) -> NDArray[np.float64]:
    """Numbers, NaN where there is none."""
    return np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
