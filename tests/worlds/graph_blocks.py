"""Graphs of blocks made at random, without reader, generator or map: what a store must give back.

::

    trace = RandomTrace(seed=1, frames=150)
    publish(store, trace)
    for graph in trace.blocks: …
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np

from sgstore.maps.roads import LaneCourses, MapEdges, MapNodes, MapPlaces
from sgstore.model.config import Config
from sgstore.model.graph import Edges, GraphBlock, LaneGaps, LaneStates, StaticPresence
from sgstore.model.vocabulary import KIND_CODE, OWN_ENTITY_KINDS, OWN_RELATIONS, RELATION_CODE
from sgstore.model.world import (
    Channel,
    Entities,
    FrameBlock,
    MessageRefs,
    States,
    TraceInfo,
    TraceReport,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.store import StoreFile

PERIOD_NS = 100_000_000
CHANNELS = (
    Channel(3, "ground_truth", "osi3.GroundTruth", "protobuf", "protobuf", -1, "ground_truth"),
    Channel(7, "camera", "foxglove.CompressedImage", "protobuf", "protobuf", -1, "payload"),
    Channel(9, "lidar", "foxglove.PointCloud", "protobuf", "protobuf", -1, "payload"),
    Channel(12, "map", "osi3.MapAsamOpenDrive", "protobuf", "protobuf", -1, "map"),
)
TRUTH, CAMERA, LIDAR, MAP = range(4)
NO_MESSAGES = MessageRefs(*(np.zeros(0, np.int64) for _ in range(5)))


@dataclass(frozen=True, eq=False)
class MapStub:
    """All that a store wants to know of a map."""

    name: str
    text: str
    digest: str
    nodes: MapNodes
    edges: MapEdges
    reach: tuple[Any, Any, Any]
    places: MapPlaces
    courses: LaneCourses


def map_stub(seed: int = 0, lanes: int = 30, name: str = "stub") -> Any:
    """A map of lanes, two roads and a junction, with edges at random."""
    rng = np.random.default_rng(seed)
    kinds = ["off_road", *["lane"] * lanes, "road", "road", "junction"]
    count = len(kinds)
    is_lane = np.array([kind == "lane" for kind in kinds])
    edges = np.unique(rng.integers(0, [6, count, count], (4 * lanes, 3)), axis=0)
    return MapStub(
        name=name,
        text=f"<OpenDRIVE seed='{seed}'/>",
        digest=f"{seed:064x}"[::-1],
        nodes=MapNodes(
            kind=np.array([KIND_CODE[kind] for kind in kinds], np.int8),
            name=tuple(f"{i}/0/-1" if kind == "lane" else str(i) for i, kind in enumerate(kinds)),
            x=rng.uniform(-500, 500, count),
            y=rng.uniform(-500, 500, count),
            z=np.zeros(count),
            heading=rng.uniform(-3, 3, count),
            lane_type=tuple("driving" if lane else "" for lane in is_lane),
            road=tuple("7" if lane else "" for lane in is_lane),
            junction=("",) * count,
            turn=("",) * count,
            section=np.zeros(count, np.int64),
            lane=np.where(is_lane, -1, 0),
            length=np.where(is_lane, 80.0, np.nan),
            width=np.where(is_lane, 3.5, np.nan),
            speed_limit=np.full(count, np.nan),
            curvature=np.full(count, np.nan),
        ),
        edges=MapEdges(
            relation=edges[:, 0].astype(np.int8),
            src=-1 - edges[:, 1],
            dst=-1 - edges[:, 2],
        ),
        reach=_reach(lanes, rng),
        places=MapPlaces.none(),
        courses=_courses(lanes, rng),
    )


def _courses(lanes: int, rng: np.random.Generator) -> LaneCourses:
    """Two stretches of each lane."""
    return LaneCourses(
        np.repeat(np.arange(lanes), 2),
        np.tile([0.0, 40.0], lanes),
        np.tile([40.0, np.inf], lanes),
        rng.uniform(-0.2, 0.2, 2 * lanes),
        rng.uniform(-0.1, 0.1, 2 * lanes),
    )


def _reach(lanes: int, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Ways from lanes to lanes, both ways and some of them double; a lane and itself among them."""
    lane, other = -2 - rng.integers(0, lanes, (2, 4 * lanes))
    start = rng.uniform(10, 190, len(lane))
    itself = -2 - np.arange(lanes)
    columns = (
        np.concatenate([itself, lane, other]),
        np.concatenate([itself, other, lane]),
        np.concatenate([np.zeros(lanes), start, -start]),
    )
    order = np.lexsort(columns[::-1])
    return columns[0][order], columns[1][order], columns[2][order]


def trace_info(path: str | Path = "/recordings/drive.mcap", **other: Any) -> TraceInfo:
    """What is known of a recording that does not exist."""
    values: dict[str, Any] = {
        "path": Path(path),
        "size": 1234,
        "mtime_ns": 5678,
        "digest": "d" * 64,
        "flavour": "osi",
        "channels": CHANNELS,
        "ego": "0",
        "map_text": "",
        "map_name": "",
        "context": MessageRefs(
            *(np.array([v]) for v in (MAP, 5, 100, 17, 42)),
        ),
    }
    return TraceInfo(**(values | other))


class RandomTrace:
    """A trace of ``frames`` frames in blocks of ``size``, with entities that come and go."""

    def __init__(
        self,
        seed: int = 0,
        frames: int = 150,
        size: int = 60,
        road_map: Any = None,
        moving: int = 0,
        **info: Any,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.frames = frames
        self.road_map = road_map
        self.info = trace_info(**({"digest": f"{seed:064x}"[::-1]} | info))
        self.moving = moving or int(self.rng.integers(2, 9))
        self.standing = int(self.rng.integers(0, 4))
        self.kinds = self.rng.integers(0, len(OWN_ENTITY_KINDS), self.moving + self.standing)
        self.blocks = [
            self.block(first, min(first + size, frames)) for first in range(0, frames, size)
        ]
        self.answers = ("isIn", "near", "toLeftOf")

    def block(self, first: int, end: int) -> GraphBlock:
        """Graphs of some frames; the next ones in the order of the trace."""
        rng, count = self.rng, end - first
        here = rng.random((count, self.moving)) < 0.8
        here[:, 0] |= first == 0
        frame, node = np.nonzero(here)
        new = first == 0
        everyone = np.arange(self.moving, self.moving + self.standing)
        frames = FrameBlock(
            seq=np.arange(first, end),
            time_ns=1_000 + np.arange(first, end) * PERIOD_NS,
            log_time_ns=5_000 + np.arange(first, end) * PERIOD_NS,
            offsets=np.concatenate([[0], np.cumsum(here.sum(axis=1))]),
            states=self._states(node),
            ego=np.where(here[:, 0], 0, -1),
            entities=self._entities(new),
            scenery=self._states(everyone if new else everyone[:0]),
            messages=NO_MESSAGES,
        )
        lanes = self._lanes(frame, node)
        edges = _with_lanes(self._edges(here), lanes)
        gaps = _gaps(edges, self.rng)
        return GraphBlock(frames, self._presence(count), edges, lanes, gaps)

    def _entities(self, new: bool) -> Entities:
        count = len(self.kinds) if new else 0
        return Entities(
            first=0 if new else len(self.kinds),
            ident=tuple(f"id{i}" for i in range(count)),
            kind=self.kinds[:count].astype(np.int8),
            special=tuple("taxi" if i % 3 == 1 else "" for i in range(count)),
            subkind=tuple("cone" if i % 4 == 2 else "" for i in range(count)),
            type_name=("thing",) * count,
            static=np.arange(count) >= self.moving,
            map_ref=("",) * count,
        )

    def _states(self, node: Any) -> States:
        rng, count = self.rng, len(node)
        columns = {
            name: rng.uniform(low, high, count)
            for name, low, high in (
                ("x", 4000, 4100),
                ("y", -2000, -1900),
                ("z", 10, 11),
                ("heading", -4, 4),
                ("vx", -15, 15),
                ("vy", -15, 15),
                ("ax", -3, 3),
                ("ay", -3, 3),
                ("yaw_rate", -1, 1),
                ("length", 1, 12),
                ("width", 0.5, 3),
                ("height", 1, 4),
            )
        }
        for name in ("vx", "ax", "length", "heading"):
            columns[name][rng.random(count) < 0.1] = np.nan
        columns["lights"] = rng.integers(-1, 1 << 11, count)
        columns["light_state"] = rng.integers(-1, 7, count).astype(np.int8)
        columns["derived"] = rng.integers(0, 8, count)
        return States.of(node=np.asarray(node, np.int64), **columns)

    def _presence(self, count: int) -> StaticPresence:
        parts = [np.arange(self.moving, self.moving + self.standing)]
        if self.road_map is not None:
            parts.append(-1 - np.arange(len(self.road_map.nodes)))
        nodes = np.concatenate(parts)
        frame, column = np.nonzero(self.rng.random((count, len(nodes))) < 0.6)
        return StaticPresence(frame, nodes[column])

    def _edges(self, here: Any) -> Edges:
        rng = self.rng
        count = 12 * len(here)
        frame = rng.integers(0, len(here), count)
        src, dst = rng.integers(0, self.moving, (2, count))
        if self.road_map is not None:
            dst = np.where(rng.random(count) < 0.3, -1 - rng.integers(0, 5, count), dst)
        kept = here[frame, src] & (src != dst)
        relation = rng.integers(0, len(OWN_RELATIONS), count).astype(np.int8)
        return Edges(frame[kept], relation[kept], src[kept], dst[kept])

    def _lanes(self, frame: Any, node: Any) -> LaneStates:
        rng = self.rng
        kept = rng.random(len(frame)) < (0.5 if self.road_map is not None else 0)
        count = int(kept.sum())
        primary = rng.random(count) < 0.5
        return LaneStates(
            frame=frame[kept],
            node=node[kept],
            lane=-2 - rng.integers(0, 5, count),
            overlap=rng.random(count),
            offset=rng.uniform(-2, 2, count),
            heading_error=rng.uniform(-1, 1, count),
            primary=primary,
            along=rng.uniform(-5, 80, count),
            own=primary | (rng.random(count) < 0.2),
        )


def _with_lanes(edges: Edges, lanes: LaneStates) -> Edges:
    """The edges, and one isIn for each lane state, as every generator gives them."""
    relation = np.full(len(lanes), RELATION_CODE["isIn"], np.int8)
    return Edges(
        np.concatenate([edges.frame, lanes.frame]),
        np.concatenate([edges.relation, relation]),
        np.concatenate([edges.src, lanes.node]),
        np.concatenate([edges.dst, lanes.lane]),
    )


def _gaps(edges: Edges, rng: np.random.Generator) -> LaneGaps:
    """A gap for every pair that follows, some of them missing."""
    leads, follows = RELATION_CODE["leads"], RELATION_CODE["follows"]
    ahead, behind = edges.relation == leads, edges.relation == follows
    rows = np.stack([edges.frame, edges.src, edges.dst])
    frame, src, dst = np.unique(
        np.concatenate([rows[:, behind], rows[:, ahead][[0, 2, 1]]], axis=1), axis=1
    )
    values = rng.uniform(0, 90, len(frame))
    values[rng.random(len(frame)) < 0.1] = np.nan
    return LaneGaps(frame, src, dst, values)


def publish_long(store: StoreFile, frames: int, *, size: int = 240, moving: int = 20) -> None:
    """Bring a trace into a store of which only one block is in memory at a time."""
    trace = RandomTrace(frames=0, moving=moving, road_map=map_stub())
    with store.segment(trace.info, Config(), road_map=trace.road_map) as segment:
        for first in range(0, frames, size):
            segment.append(trace.block(first, min(first + size, frames)))
        store.publish(segment.seal(TraceReport(frames=frames)))


def publish(store: StoreFile, trace: RandomTrace, config: Config | None = None) -> str:
    """Bring a trace into a store; its name there."""
    with store.segment(
        trace.info, config or Config(), road_map=trace.road_map, answers=trace.answers
    ) as segment:
        for graph in trace.blocks:
            segment.append(graph)
        return store.publish(segment.seal(TraceReport(frames=trace.frames)))


def add_labels(path: Path, enum: str, labels: Sequence[str]) -> None:
    """Add labels to an enumeration of a store, as a process with other plugins may have done."""
    with duckdb.connect(str(path)) as connection:
        old = connection.execute(f"SELECT enum_range(NULL::main.{enum})").fetchall()[0][0]
        narrow, wide = (f"ENUM({str(each)[1:-1]})" for each in (old, [*old, *labels]))
        columns = connection.execute(
            "SELECT table_name, column_name FROM duckdb_columns() SEMI JOIN duckdb_tables()"
            " USING (schema_name, table_name) WHERE data_type = $1",
            [narrow],
        ).fetchall()
        assert columns
        for table, column in columns:
            connection.execute(f"ALTER TABLE inside.{table} ALTER {column} TYPE {wide}")
        connection.execute(f"DROP TYPE main.{enum}; CREATE TYPE main.{enum} AS {wide}")
