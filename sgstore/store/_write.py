"""A trace on its way into a store: built aside, block by block, and published in one short transaction.

The store itself is touched only to publish: then a trace is in it, with everything that belongs to it, or not
at all.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Self

import numpy as np

import sgstore.store._packing as packing
import sgstore.store._payloads as payloads
from sgstore.errors import StoreError
from sgstore.store._classes import IngestedClasses
from sgstore.store._locking import translated
from sgstore.store._packing import MAX_FRAMES, NodeKinds, texts
from sgstore.store._payloads import Happenings
from sgstore.store._publish import MAP_TABLES, fill_trace, publish_in
from sgstore.store._staging import Place, Sealed, Staging
from sgstore.store._traces import Identity
from sgstore.world import BUCKET_FRAMES, Origin, origin_of, quantize

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.config import Config
    from sgstore.graph import GraphBlock
    from sgstore.roads import RoadMap
    from sgstore.store._locking import Access
    from sgstore.store._packing import Columns
    from sgstore.world import Codes, FrameBlock, Ints, TraceInfo, TraceReport


class Segment:
    """The graphs of one trace, until they are published. Made by :meth:`StoreFile.segment` or :func:`segment`.

    Parameters
    ----------
    store : Path
        The store that it is meant for. It need not be there yet.
    info : TraceInfo
    identity : Identity
        What the trace is in the store, and the settings it was read with.
    road_map : RoadMap or None
    answers : tuple of str
        Relations that the generator can answer.
    place : Place, optional
        Where it is built. By default a folder beside the store, which goes with it.
    access : Access, optional
        To the store, for :meth:`publish`.

    Notes
    -----
    Use it as a context manager: what was not published when it is left is forgotten.
    """

    def __init__(
        self,
        store: Path,
        info: TraceInfo,
        identity: Identity,
        road_map: RoadMap | None,
        answers: tuple[str, ...],
        *,
        place: Place | None = None,
        access: Access | None = None,
    ) -> None:
        self._store = store
        self._access = access
        self._info = info
        self._identity = identity
        self._answers = answers
        self._road_map = road_map
        self._channel_ids = np.array([c.id for c in info.channels], np.int64)
        self._kinds = NodeKinds(
            entities=np.zeros(0, np.int8),
            map=np.zeros(0, np.int8) if road_map is None else road_map.nodes.kind,
        )
        self._origin: Origin | None = None
        self._periods = payloads.Periods()
        self._classes = IngestedClasses(road_map)
        self._happenings = Happenings(identity.trace_id)
        self._next_seq = 0
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
        """Forget the segment. What was published stays."""
        self._staging.close()

    def as_kept(self, frames: FrameBlock) -> FrameBlock:
        """The next frames with the numbers that the store will give back of them.

        Positions are kept as float32 about an origin, all else as float32. Graphs that are made of these
        numbers can be made again from the store, to the last edge; so this comes before the generator.
        """
        self._origin = self._origin or origin_of(frames)
        return quantize(frames, self._origin or Origin(0.0, 0.0, 0.0))

    def append(self, graph: GraphBlock) -> None:
        """Add the next frames of the trace.

        Parameters
        ----------
        graph : GraphBlock
            Made of what :meth:`as_kept` gave.

        Raises
        ------
        StoreError
            The trace is longer than a store can number, or the disk is full.
        ValueError
            Frames are not consecutive, or nodes were not introduced: a defect of the caller.
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
        self._kinds.learn(frames.entities)
        self._origin = self._origin or origin_of(frames)
        self._insert_graph(graph, self._identity.trace_id, self._origin or Origin(0.0, 0.0, 0.0))
        self._see_messages(graph)

    def name_frames(self, seq: Ints, graphs: list[str], places: Ints, images: Ints) -> None:
        """Take down what the file of an import calls the graphs that became frames: table ``imported``.

        Parameters
        ----------
        seq : (F,) int64
        graphs : list of str
        places, images : (F,) int64
            Row or line where each begins, and how many frames of the source it stands for.
        """
        columns = {
            "bucket": packing.trace_bucket(self._identity.trace_id, seq),
            "bit": seq % BUCKET_FRAMES,
            "graph": texts(graphs),
            "place": places,
            "images": images,
        }
        self._staging.insert("imported", self._owned(columns))

    def keep_attributes(
        self, seq: Ints, own: Sequence[tuple[int, int, int, int, str, str]]
    ) -> None:
        """Add attributes of a client's own: table ``attribute``.

        Parameters
        ----------
        seq : (F,) int64
        own : sequence of tuple
            Row in ``seq``, node, relation (of an edge; -1: of the node) and the other end, name, value as JSON.
        """
        if own:
            frame, src, relation, dst, name, value = zip(*own, strict=True)
            of_node = np.array(relation) < 0
            columns: Columns = {
                "frame_id": packing.frame_ids(self._identity.trace_id, seq)[list(frame)],
                "node_id": np.array(src, np.int64),
                "relation": packing.unless(np.array(relation, np.int64), of_node),
                "dst": packing.unless(np.array(dst, np.int64), of_node),
                "attribute": texts(name),
                "value": texts(value),
            }
            self._staging.insert("attribute", columns)

    def publish(self, report: TraceReport) -> str:
        """Bring the trace into the store, in one transaction.

        Returns
        -------
        str
            The name of the trace in the store.

        Raises
        ------
        StoreError
            The trace came into the store meanwhile, others keep the store for too long, or the disk is full.
        ValueError
            There are no frames.
        """
        sealed = self.seal(report)
        if self._access is None:
            raise ValueError("a segment without a store is sealed, and published by one")
        return publish_in(self._access, sealed)

    def seal(
        self,
        report: TraceReport,
        more: Mapping[str, Any] | None = None,
        parked: Codes | None = None,
    ) -> Sealed:
        """Complete the files of the trace, so that any process can publish them; nothing can be added then.

        Parameters
        ----------
        report : TraceReport
        more : mapping, optional
            What else the report in the store is to say, as plain values.
        parked : (n,) int8, optional
            Of each entity whether it is parked: 1 or 0; -1: not known.

        Raises
        ------
        StoreError
            The disk is full.
        ValueError
            There are no frames.
        """
        if not self._next_seq:
            raise ValueError("a trace without frames")
        staging, identity = self._staging, self._identity
        with translated(self._store):
            staging.insert("event", self._owned(self._happenings.rest()))
            if parked is not None:
                staging.mark_parked(parked)
            payloads.join(
                staging.connection,
                staging.all_messages(),
                self._info.channels,
                self._periods,
                identity.payloads,
            )
            fill_trace(staging.connection, self._info, identity, self._trace_values(report, more))
            files, checksums = staging.seal()
        of_map = {name: checksums.pop(name) for name in MAP_TABLES if name in checksums}
        words = staging.words(self._answers)
        sealed = Sealed(staging.folder, self._info.path, identity, files, checksums, of_map, words)
        sealed.write()
        return sealed

    def _trace_values(self, report: TraceReport, more: Mapping[str, Any] | None) -> dict[str, Any]:
        origin = self._origin or Origin(0.0, 0.0, 0.0)
        return {
            "origin_x": origin.x,
            "origin_y": origin.y,
            "origin_z": origin.z,
            "answers": list(self._answers),
            "report": packing.as_json(asdict(report) | dict(more or {})),
        }

    def _insert_about(self) -> None:
        """Insert channels, context and map, which are known before the first frame."""
        insert = self._staging.insert
        insert("channel", self._owned(_channel_columns(self._info)))
        context = packing.message_columns(self._info.context, self._channel_ids)
        context["channel_id"] = context.pop("channel")
        insert("context", self._owned(context))
        if self._road_map is not None:
            insert("map", _map_columns(self._road_map))
            insert("map_node", _map_node_columns(self._road_map))
            insert("map_edge", _map_edge_columns(self._road_map))
            insert("map_reach", _map_reach_columns(self._road_map))

    def _insert_graph(self, graph: GraphBlock, trace_id: int, origin: Origin) -> None:
        kinds, insert = self._kinds, self._staging.insert
        # First of all, while little waits: of a crowd what is made on the way takes most.
        abstracted = self._classes.tables(graph, trace_id, kinds.entities)
        insert("frame", self._owned(packing.frame_columns(graph, trace_id)))
        insert("entity", self._owned(packing.entity_columns(graph, origin)))
        insert("state", packing.state_columns(graph, trace_id, kinds, origin))
        insert("node", packing.node_columns(graph, trace_id, kinds))
        for columns in packing.edge_columns(graph, trace_id, kinds):
            insert("edge", columns)
        insert("lane_state", packing.lane_columns(graph, trace_id, kinds))
        insert("lane_gap", packing.gap_columns(graph, trace_id))
        insert("event", self._owned(self._happenings.of(graph.frames)))
        for table, columns in abstracted.items():
            insert(table, columns)

    def _owned(self, columns: Columns) -> Columns:
        """The columns, and whose they are."""
        count = len(next(iter(columns.values())))
        return columns | {"trace_id": np.full(count, self._identity.trace_id)}

    def _see_messages(self, graph: GraphBlock) -> None:
        messages = packing.message_columns(graph.frames.messages, self._channel_ids)
        self._staging.insert("message", messages)
        self._periods.see(payloads.FRAMES, graph.frames.log_time_ns)
        channel = messages["channel"]
        for number in np.unique(channel).tolist():
            self._periods.see(number, messages["log_time_ns"][channel == number])


def new_segment(
    store: Path,
    info: TraceInfo,
    config: Config,
    *,
    road_map: RoadMap | None = None,
    answers: tuple[str, ...] = (),
    part: tuple[float | None, float | None] = (None, None),
    place: Place,
) -> Segment:
    """A segment for a store that need not be there yet, to be sealed and published by another process.

    Parameters
    ----------
    store : Path
    info, config, road_map, answers
        As :meth:`StoreFile.segment` takes them.
    part : tuple
        The part of the recording that is read: since and until; s.
    place : Place
        Where it is built.
    """
    identity = Identity.of(info, config, road_map, part)
    return Segment(store, info, identity, road_map, answers, place=place)


def _channel_columns(info: TraceInfo) -> Columns:
    names = ("topic", "schema", "schema_encoding", "message_encoding", "role")
    columns: Columns = {name: texts(getattr(c, name) for c in info.channels) for name in names}
    return columns | {"channel_id": np.array([c.id for c in info.channels], np.int64)}


def _map_columns(road_map: RoadMap) -> Columns:
    names = ("digest", "name", "text")
    return {name: texts([getattr(road_map, name)]) for name in names}


def _map_node_columns(road_map: RoadMap) -> Columns:
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
    return columns | {"node_id": -1 - np.arange(count), "kind": nodes.kind}


def _map_edge_columns(road_map: RoadMap) -> Columns:
    edges, kind = road_map.edges, road_map.nodes.kind
    return {
        "relation": edges.relation,
        "src": edges.src,
        "dst": edges.dst,
        "src_kind": kind[-1 - edges.src],
        "dst_kind": kind[-1 - edges.dst],
    }


def _map_reach_columns(road_map: RoadMap) -> Columns:
    src, dst, start = road_map.reach
    return {"src": src, "dst": dst, "start": start}
