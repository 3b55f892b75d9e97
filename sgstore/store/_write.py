"""Writer of a trace: builds the graphs outside the store, and prepares them for one transaction.

Only the publication changes the store: it adds a complete trace, or nothing.
"""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final, Self
from weakref import WeakKeyDictionary

import numpy as np

import sgstore.store._packing as packing
import sgstore.store._payloads as payloads
from sgstore.errors import StoreError
from sgstore.model import frame_ids
from sgstore.model.frame_ids import MAX_FRAMES
from sgstore.model.graph import LeftOut
from sgstore.model.vocabulary import KINDS
from sgstore.model.world import BUCKET_FRAMES, Origin, longest_step_ns, origin_of, quantize
from sgstore.store._classes import IngestedClasses
from sgstore.store._locking import spill_folder
from sgstore.store._packing import NodeKinds, texts
from sgstore.store._payloads import FrameTimes, Happenings
from sgstore.store._staging import Sealed, Staging
from sgstore.store._topics import FrameClock, TopicFile, TopicWriter, topic_scratch
from sgstore.store._traces import uri_of

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Codes, FrameBlock, Ints, TraceInfo, TraceReport
    from sgstore.readers import TopicReading
    from sgstore.store._packing import Columns
    from sgstore.store._staging import StagedRows
    from sgstore.store._traces import Identity


class OnMap:
    """Data that all traces on a road map share: a cache of frame classes, and the map's table rows.

    Parameters
    ----------
    road_map : RoadMap or None
        Road map; also an attribute.
    """

    def __init__(self, road_map: RoadMap | None) -> None:
        self.road_map = road_map
        self.classes = IngestedClasses(road_map)

    def insert_into(self, staging: Staging, map_id: int) -> None:
        """Insert the table rows of the road map as the first rows of a new trace."""
        if self.road_map is None:
            return
        if (rows := _ROWS.get(self.road_map)) is not None:
            staging.adopt(rows)
            return
        for table, columns in _map_tables(self.road_map).items():
            count = len(next(iter(columns.values())))
            staging.insert(table, columns | {"map_id": np.full(count, map_id)})
        _ROWS[self.road_map] = staging.shared()


_ROWS: Final[WeakKeyDictionary[RoadMap, StagedRows]] = WeakKeyDictionary()
"""Cached table rows of road maps. An entry is removed together with its map."""


class Segment:
    """Writer of the graphs of one new trace, in files outside the store until publication.

    Parameters
    ----------
    store : Path
        Target store. The file may not exist yet.
    info : TraceInfo
    identity : Identity
        Identity of the trace and its settings.
    on_map : OnMap
        Road map, with data shared by its segments.
    answers : tuple of str
        Relations that the generator can answer.
    place : tuple, optional
        Folder of the segment; see :class:`Staging`. Default: a folder next to the store, removed at close.

    Notes
    -----
    Use it as a context manager. Unpublished data are discarded at the end of the block.
    """

    def __init__(
        self,
        store: Path,
        info: TraceInfo,
        identity: Identity,
        on_map: OnMap,
        answers: tuple[str, ...],
        *,
        place: tuple[Path, int] | None = None,
    ) -> None:
        self._store = store
        self._info = info
        self.identity = identity
        self._answers = answers
        self._road_map = road_map = on_map.road_map
        self._channel_ids = np.array([c.id for c in info.channels], np.int64)
        self._kinds = NodeKinds(
            entities=np.zeros(0, np.int8),
            map=np.zeros(0, np.int8) if road_map is None else road_map.nodes.kind,
        )
        self._origin: Origin | None = None
        self._periods = payloads.Periods()
        self._on_map = on_map
        self._happenings = Happenings(identity.trace_id)
        self._next_seq = 0
        self._uneven = 0
        self._times: list[Ints] = []
        self._left_out = LeftOut()
        self._constants = {name: [np.zeros(0, object)] for name in ("special", "subkind")}
        self._topics: list[TopicFile] = []
        self._staging = Staging(store, place)
        try:
            self._insert_about()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Discard the unpublished graphs of the trace. Published data stay in the store."""
        self._staging.close()

    def as_kept(self, frames: FrameBlock) -> FrameBlock:
        """Return a block of frames with all values rounded to the precision of the store.

        Positions are float32 relative to an origin; other values are float32. The generator uses these rounded
        values, so the store can reproduce its graphs exactly.
        """
        self._origin = self._origin or origin_of(frames)
        return quantize(frames, self._origin or Origin(0.0, 0.0, 0.0))

    def append(self, graph: GraphBlock) -> None:
        """Add the graphs of the next frames of the trace.

        Parameters
        ----------
        graph : GraphBlock
            Graphs of the frames from :meth:`as_kept`.

        Raises
        ------
        StoreError
            The trace is too long for the store, or the disk is full.
        ValueError
            Frames are not consecutive, or nodes were not introduced (an error of the caller).
        """
        frames = graph.frames
        if not len(frames):
            return
        seq = self._next_seq + np.arange(len(frames))
        if not np.array_equal(frames.seq, seq):
            raise ValueError(f"expected frames {seq[0]} … {seq[-1]}, got seq {frames.seq}")
        if seq[-1] >= MAX_FRAMES:
            raise StoreError(f"{self._info.path}: more than {MAX_FRAMES} frames in one trace")
        self._staging.settle(whole=self._next_seq % BUCKET_FRAMES == 0)
        self._next_seq += len(frames)
        self._left_out = self._left_out.more(graph.left_out)
        self._uneven |= graph.uneven
        self._kinds.learn(frames.entities)
        self._origin = self._origin or origin_of(frames)
        self._insert_graph(graph, self.identity.trace_id, self._origin or Origin(0.0, 0.0, 0.0))

    def name_frames(self, seq: Ints, graphs: list[str], places: Ints, images: Ints) -> None:
        """Store the graph names from an imported file for the frames of the trace.

        Parameters
        ----------
        seq : (F,) int64
        graphs : list of str
        places, images : (F,) int64
            Row or line of each graph in the file, and number of source frames that it covers.
        """
        columns = {
            "bucket": frame_ids.trace_bucket(self.identity.trace_id, seq),
            "bit": seq % BUCKET_FRAMES,
            "graph": texts(graphs),
            "place": places,
            "images": images,
        }
        self._staging.insert("imported", self._owned(columns))

    def keep_attributes(
        self, seq: Ints, own: Sequence[tuple[int, int, int, int, str, str]]
    ) -> None:
        """Add user-defined attributes of nodes and edges to the trace.

        Parameters
        ----------
        seq : (F,) int64
        own : sequence of tuple
            Row in ``seq``, node, relation (-1: node attribute), other node, name, and value as JSON.
        """
        if own:
            frame, src, relation, dst, name, value = zip(*own, strict=True)
            of_node = np.array(relation) < 0
            columns: Columns = {
                "frame_id": frame_ids.frame_ids(self.identity.trace_id, seq)[list(frame)],
                "node_id": np.array(src, np.int64),
                "relation": packing.unless(np.array(relation, np.int64), of_node),
                "dst": packing.unless(np.array(dst, np.int64), of_node),
                "attribute": texts(name),
                "value": texts(value),
            }
            self._staging.insert("attribute", columns)

    @contextmanager
    def topics(self, reading: TopicReading) -> Generator[TopicWriter]:
        """Context manager with a writer of the messages of topics. All frames must have been added."""
        time_ns, log_time_ns = np.concatenate(self._times, axis=1)
        identity = self.identity
        clock = FrameClock.of_trace(identity.trace_id, time_ns, log_time_ns)
        bounded = (identity.since, identity.until) != (None, None)
        with topic_scratch(spill_folder()) as connection:
            writer = TopicWriter(connection, self._staging.folder, clock, bounded=bounded)
            yield writer
            self._topics = writer.files(reading)

    def seal(
        self,
        report: TraceReport,
        more: Mapping[str, Any] | None = None,
        parked: Sequence[Codes] = (),
    ) -> Sealed:
        """Complete the files of the trace. Any process can publish the result, but not extend it.

        Parameters
        ----------
        report : TraceReport
        more : mapping, optional
            Additional values of the stored report.
        parked : sequence of (n,) int8
            Parked state of each entity, from the graphs and from all known rows: 1 or 0; -1: unknown.

        Raises
        ------
        StoreError
            The disk is full.
        ValueError
            The segment has no frames.
        """
        if not self._next_seq:
            raise ValueError("a trace without frames")
        staging, identity = self._staging, self.identity
        time_ns, log_time_ns = np.concatenate(self._times, axis=1)
        staging.insert("event", self._owned(self._happenings.rest()))
        for name, known in zip(("parked", "world_parked"), parked, strict=False):
            staging.mark("entity", name, self._parked(known))
        for columns in payloads.joined(
            FrameTimes(log_time_ns),
            staging.messages,
            self._info.channels,
            self._periods,
            identity.payloads,
        ):
            self._insert_payloads(columns)
        period_ns = _period_ns(time_ns)
        staging.insert("bucket", self._owned(self._bucket_columns(time_ns, period_ns)))
        staging.seal()
        origin = self._origin or Origin(0.0, 0.0, 0.0)
        trace = {"map_id": None} | identity.numbers | {
            "trace_id": identity.trace_id,
            "flavour": self._info.flavour,
            "ego": identity.ego or None,
            "since": identity.since,
            "until": identity.until,
            "frames": len(time_ns),
            "start_ns": int(time_ns[0]),
            "end_ns": int(time_ns[-1]),
            "period_ns": period_ns,
            "uneven": self._uneven,
            "origin_x": origin.x,
            "origin_y": origin.y,
            "origin_z": origin.z,
            "answers": list(self._answers),
            "report": packing.as_json(asdict(report) | self.scope | dict(more or {})),
            "version": version("sgstore"),
        }  # fmt: skip
        words, path = staging.words(self._answers), self._info.path
        topics = [asdict(one) for one in self._topics]
        sealed = Sealed(staging.folder, path, identity, trace, staging.checksums, words, topics)
        sealed.write()
        return sealed

    @property
    def scope(self) -> dict[str, Any]:
        """For the report, return how many object states the settings have excluded so far.

        An import excludes none.
        """
        counts, settings = self._left_out, json.loads(self.identity.settings)
        if not counts.states:
            return {}
        around = settings["range"]
        scope = {
            "radius": around["radius"] if around["shape"] == "radius" else None,
            "world": around["world"],
            "states": counts.states,
            "beyond_radius": counts.beyond_radius,
            "beyond_world": counts.beyond_world,
            "excluded": {KINDS[code]: many for code, many in counts.excluded},
            "rate": settings["rate"],
        }
        return {"scope": scope}

    def _parked(self, parked: Codes) -> Ints:
        known = np.full(len(self._kinds.entities), packing.MISSING)
        known[: len(parked)] = packing.unless(parked, parked < 0)[: len(known)]
        return known

    def _insert_payloads(self, columns: Columns) -> None:
        seq = columns.pop("seq")
        bucket = frame_ids.trace_bucket(self.identity.trace_id, seq)
        places = {"bucket": bucket, "bit": seq % BUCKET_FRAMES, **columns}
        self._staging.insert("payload", self._owned(places))
        self._staging.write("payload")

    def _bucket_columns(self, time_ns: Ints, period_ns: int) -> Columns:
        """Return one row per 60 frames with two bit masks: of all frames, and of those without a gap before."""
        seq = np.arange(len(time_ns))
        one = np.left_shift(1, seq % BUCKET_FRAMES)
        step = np.diff(time_ns, prepend=time_ns[0])
        joined = (seq > 0) & (step >= 0) & (step <= longest_step_ns(period_ns))
        starts = seq[::BUCKET_FRAMES]
        columns = {
            "bucket": frame_ids.trace_bucket(self.identity.trace_id, starts),
            "valid": np.bitwise_or.reduceat(one, starts),
            "joined": np.bitwise_or.reduceat(np.where(joined, one, 0), starts),
        }
        number = self.identity.numbers.get("map_id")
        return columns if number is None else columns | {"map_id": np.full(len(starts), number)}

    def _insert_about(self) -> None:
        """Insert the table rows known before the first frame: recording, settings, channels and map."""
        insert, info, identity = self._staging.insert, self._info, self.identity
        self._on_map.insert_into(self._staging, identity.numbers.get("map_id", 0))
        recording = {
            "recording_id": np.array([identity.numbers["recording_id"]]),
            "digest": texts([info.digest]),
            "uri": texts([uri_of(info.path)]),
            "size": np.array([info.size], np.int64),
            "mtime_ns": np.array([info.mtime_ns], np.int64),
        }
        config = {
            "config_id": np.array([identity.numbers["config_id"]]),
            "digest": texts([identity.settings_digest]),
            "settings": texts([identity.settings]),
        }
        insert("recording", recording)
        insert("config", config)
        channels = info.channels
        names = ("topic", "schema", "schema_encoding", "message_encoding", "role")
        columns: Columns = {name: texts(getattr(c, name) for c in channels) for name in names}
        insert("channel", self._owned(columns | {"channel_id": self._channel_ids}))
        context = packing.message_columns(self._info.context, self._channel_ids)
        context["channel_id"] = context.pop("channel")
        insert("context", self._owned(context))

    def _insert_graph(self, graph: GraphBlock, trace_id: int, origin: Origin) -> None:
        kinds, insert = self._kinds, self._staging.insert
        # Crowded frames need most memory here, so this runs first, while few rows wait.
        abstracted = self._on_map.classes.tables(graph, trace_id, kinds.entities)
        of_frames = packing.frame_columns(graph, trace_id)
        if self._road_map is not None:
            of_frames["map_id"] = np.full(len(graph.frames), self.identity.numbers["map_id"])
        insert("frame", self._owned(of_frames))
        entities = packing.entity_columns(graph, origin)
        insert("entity", self._owned(entities))
        states = packing.state_columns(graph, trace_id, kinds, origin)
        known = self._learned(entities)
        insert("state", states | self._constants_of(known, graph.frames.states.node))
        insert("node", packing.node_columns(graph, trace_id, kinds))
        for columns in packing.edge_columns(graph, trace_id, kinds):
            insert("edge", columns)
        insert("lane_single", packing.lane_columns(graph, trace_id, kinds))
        if (world := graph.world) is not None:
            states = packing.state_columns(world, trace_id, kinds, origin)
            insert("world_state", states | self._constants_of(known, world.frames.states.node))
            insert("world_node", packing.node_columns(world, trace_id, kinds))
            for columns in packing.edge_columns(world, trace_id, kinds):
                insert("world_edge", columns)
            insert("world_lane_single", packing.lane_columns(world, trace_id, kinds))
            insert("world_gap_single", packing.gap_columns(world, trace_id))
        for part in (graph, world):
            if part is not None:
                self.keep_attributes(part.frames.seq, packing.own_attributes(part))
        insert("gap_single", packing.gap_columns(graph, trace_id))
        insert("event", self._owned(self._happenings.of(graph.frames)))
        for table, columns in abstracted.items():
            insert(table, columns)
        messages = packing.message_columns(graph.frames.messages, self._channel_ids)
        insert("message", messages)
        self._times.append(np.stack([graph.frames.time_ns, graph.frames.log_time_ns]))
        self._periods.see(payloads.FRAMES, graph.frames.log_time_ns)
        channel = messages["channel"]
        for number in np.unique(channel).tolist():
            self._periods.see(number, messages["log_time_ns"][channel == number])

    def _learned(self, entities: Columns) -> Columns:
        for name, known in self._constants.items():
            known[:] = [np.concatenate([*known, entities[name]])]
        return {name: known[0] for name, known in self._constants.items() if any(known[0])}

    @staticmethod
    def _constants_of(known: Columns, node: Ints) -> Columns:
        return {name: values[node] for name, values in known.items()}

    def _owned(self, columns: Columns) -> Columns:
        count = len(next(iter(columns.values())))
        return columns | {"trace_id": np.full(count, self.identity.trace_id)}


def _period_ns(time_ns: Ints) -> int:
    """Return the median time between frames (the smaller of two middle values); ns. One frame gives 0."""
    steps = np.sort(np.diff(time_ns))
    return int(steps[(len(steps) - 1) // 2]) if len(steps) else 0


def _map_tables(road_map: RoadMap) -> dict[str, Columns]:
    """Return the table rows of a road map: table → columns. All traces on the map share these rows."""
    nodes = road_map.nodes
    count = len(nodes)
    is_lane = np.array([bool(kind) for kind in nodes.lane_type], np.bool_)
    columns: Columns = {
        name: texts(getattr(nodes, name))
        for name in ("name", "lane_type", "road", "junction", "turn")
    }
    for name in ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature"):
        columns[name] = getattr(nodes, name)
    for name in ("section", "lane"):
        columns[name] = packing.unless(getattr(nodes, name), ~is_lane)
    columns |= {"node_id": -1 - np.arange(count), "kind": nodes.kind}
    edges, kind = road_map.edges, road_map.nodes.kind
    src, dst, start = road_map.reach
    places, courses = road_map.places, road_map.courses
    return {
        "map": {name: texts([getattr(road_map, name)]) for name in ("digest", "name", "text")},
        "map_node": columns,
        "map_edge": {
            "relation": edges.relation,
            "src": edges.src,
            "dst": edges.dst,
            "src_kind": kind[-1 - edges.src],
            "dst_kind": kind[-1 - edges.dst],
        },
        "map_reach": {"src": src, "dst": dst, "start": start},
        "map_place": {
            "node_id": -1 - places.part,
            "what": texts(places.what),
            "lane": -2 - places.lane,
            "start": places.start,
            "end": places.end,
        },
        "map_course": {
            "lane": -2 - courses.lane,
            "start": courses.start,
            "end": courses.end,
            "curvature": courses.curvature,
            "slope": courses.slope,
        },
    }
