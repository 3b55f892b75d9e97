"""Conversion of graphs to columns of store tables: names become codes, frames become bit masks.

A mask covers the 60 frames of a bucket. An edge in many of these frames is one row, and so is a static node.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from sgstore.base.tables import ascending, taken
from sgstore.model.frame_ids import frame_ids, trace_bucket
from sgstore.model.world import (
    BUCKET_FRAMES,
    GAP,
    KEPT,
    TOLERANCE_NS,
    TOLERANCE_SHARE,
    number,
    turned,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.model.graph import Edges, GraphBlock, WorldBlock
    from sgstore.model.world import Bools, Codes, Entities, Ints, MessageRefs, Origin


Whole: TypeAlias = "NDArray[np.signedinteger[Any]]"

Columns: TypeAlias = "dict[str, NDArray[Any]]"
"""Columns of a table by name, of equal length. Missing values are non-finite, :data:`MISSING`, or empty."""

MISSING: Final = -(1 << 31)
"""Missing integer value. DuckDB 1.5 ignores the mask of a masked array."""

EDGE_ROWS: Final = 1 << 18
"""Number of edges that are converted to rows at once. It limits the memory for intermediate arrays."""

TOLERANCE: Final = f"greatest({TOLERANCE_NS}, coalesce(period_ns, 0) // {TOLERANCE_SHARE})"
"""SQL text of :func:`sgstore.model.world.tolerance_ns`, computed from the ``period_ns`` of a trace."""
LONGEST_STEP: Final = f"{GAP} * period_ns + {TOLERANCE}"
"""SQL text of :func:`sgstore.model.world.longest_step_ns`, computed from the ``period_ns`` of a trace."""


@dataclass(slots=True)
class NodeKinds:
    """Kind (such as car or lane) of each node of a trace, by node id. New objects can be added."""

    entities: Codes
    map: Codes

    def learn(self, entities: Entities) -> None:
        """Add the kinds of new objects. The objects must be in the order of their node ids."""
        if len(entities) and entities.first != len(self.entities):
            raise ValueError(f"new entities begin at {entities.first}, not {len(self.entities)}")
        self.entities = np.concatenate([self.entities, entities.kind])

    def of(self, nodes: Whole) -> Codes:
        """Return the kind codes (such as car or lane) of nodes."""
        kinds = np.empty(len(nodes), np.int8)
        kinds[nodes >= 0] = self.entities[nodes[nodes >= 0]]
        kinds[nodes < 0] = self.map[-1 - nodes[nodes < 0]]
        return kinds


def masks_of(keys: Sequence[Whole], bits: Whole) -> tuple[NDArray[np.intp], Ints]:
    """Merge rows with equal keys. The bit numbers of the merged rows become one bit mask.

    Parameters
    ----------
    keys : sequence of (N,) int
        Key columns, most significant first.
    bits : (N,) int
        0 … 59.

    Returns
    -------
    first : (M,) intp
        Index of one row per distinct key, in ascending key order.
    mask : (M,) int64
    """
    if not len(bits):
        return np.zeros(0, np.intp), np.zeros(0, np.int64)
    number = packed(keys)
    if number is None:  # sparse ids: use their ranks
        number = np.unique(np.stack(keys), axis=1, return_inverse=True)[1].reshape(-1)
    order = ascending(number)
    ranked = number[order]
    starts = np.flatnonzero(np.append(True, ranked[1:] != ranked[:-1]))
    masks = np.left_shift(np.int64(1), bits[order])
    return order[starts], np.bitwise_or.reduceat(masks, starts)


def packed(keys: Sequence[NDArray[Any]]) -> Ints | None:
    """Combine key columns into one integer column with the same order; ``None`` if this is impossible.

    Parameters
    ----------
    keys : sequence of (N,) array
        Key columns, most significant first; N > 0.

    Returns
    -------
    (N,) int64 or None
        ``None`` if the number is too large, or a column is not an integer.
    """
    if any(key.dtype.kind == "f" for key in keys):
        return None
    bounds = [(int(key.min()), int(key.max())) for key in keys]
    if math.prod(high - low + 1 for low, high in bounds) >= 1 << 62:
        return None
    number = np.zeros(len(keys[0]), np.int64)
    for key, (low, high) in zip(keys, bounds, strict=True):
        if low < high:
            number *= high - low + 1
            number += key
            number -= low
    return number


def frame_columns(graph: GraphBlock, trace_id: int) -> Columns:
    """Return the rows of the store table ``frame`` as columns."""
    frames = graph.frames
    return {
        "frame_id": frame_ids(trace_id, frames.seq),
        "bucket": trace_bucket(trace_id, frames.seq),
        "bit": frames.seq % BUCKET_FRAMES,
        "seq": frames.seq,
        "time_ns": frames.time_ns,
        "log_time_ns": frames.log_time_ns,
        "ego": unless(frames.ego, frames.ego < 0),
    }


def state_columns(
    graph: GraphBlock | WorldBlock, trace_id: int, kinds: NodeKinds, origin: Origin
) -> Columns:
    """Return the object states of each frame (position, speed, …) as table columns. Kinds are codes."""
    frames, states = graph.frames, graph.frames.states
    row = frames.frame_of
    plain = {name: getattr(states, name) for name in KEPT}
    plain |= {
        "heading": turned(states.heading),
        "x": states.x - origin.x,
        "y": states.y - origin.y,
        "z": states.z - origin.z,
        "speed": np.sqrt(states.vx**2 + states.vy**2 + np.nan_to_num(states.vz) ** 2),
    }
    columns: Columns = {name: number(values) for name, values in plain.items()}
    return columns | {
        "kind": kinds.of(states.node),
        "frame_id": frame_ids(trace_id, frames.seq)[row],
        "node_id": states.node,
        "is_ego": states.node == frames.ego[row],
        "lights": unless(states.lights, states.lights < 0),
        "light_state": unless(states.light_state, states.light_state < 0),
        "derived": states.derived,
        "carrier": unless(states.carrier, states.carrier < 0),
    }


def own_attributes(
    graph: GraphBlock | WorldBlock,
) -> list[tuple[int, int, int, int, str, str]]:
    """Return the object attributes without a table column, as rows of :meth:`Segment.keep_attributes`."""
    frames, states = graph.frames, graph.frames.states
    frame_of = frames.frame_of
    rows = (row for row, own in enumerate(states.own.tolist()) if own)
    return [
        (int(frame_of[row]), int(states.node[row]), -1, 0, name, as_json(value))
        for row in rows
        for name, value in states.own[row].items()
    ]


def node_columns(graph: GraphBlock | WorldBlock, trace_id: int, kinds: NodeKinds) -> Columns:
    """Return the rows of the store table ``node`` as columns. Kinds are codes."""
    seq = graph.frames.seq[graph.presence.frame]
    kind, bucket, node = (
        kinds.of(graph.presence.node),
        trace_bucket(trace_id, seq),
        graph.presence.node,
    )
    first, mask = masks_of((kind, bucket, node), seq % BUCKET_FRAMES)
    return {"kind": kind[first], "bucket": bucket[first], "node_id": node[first], "mask": mask}


def edge_columns(
    graph: GraphBlock | WorldBlock, trace_id: int, kinds: NodeKinds
) -> Iterator[Columns]:
    """Yield rows of the store table ``edge`` as columns, about :data:`EDGE_ROWS` rows at a time.

    Relations and kinds are codes.
    """
    edges = graph.edges
    count = -(-len(edges) // EDGE_ROWS)
    if count <= 1:
        yield _edge_columns(graph, edges, trace_id, kinds)
        return
    piece = (edges.src % count).astype(np.int32)  # edges merged into one row have one source
    for which in range(count):
        rows = np.flatnonzero(piece == which)
        yield _edge_columns(graph, taken(edges, rows), trace_id, kinds)


def _edge_columns(
    graph: GraphBlock | WorldBlock, edges: Edges, trace_id: int, kinds: NodeKinds
) -> Columns:
    seq, ego = graph.frames.seq, graph.frames.ego
    # Without an ego, the value is -1, which is also a map node.
    of = np.where(ego < 0, MISSING, ego).astype(edges.src.dtype)[edges.frame]
    of_ego = (edges.src == of).view(np.int8) * np.int8(2) + (edges.dst == of)
    # Small types save memory: a block has many edges, but few buckets.
    bucket = (seq // BUCKET_FRAMES - seq[0] // BUCKET_FRAMES).astype(np.int32)[edges.frame]
    bit = (seq % BUCKET_FRAMES).astype(np.int8)[edges.frame]
    # Kinds follow from the nodes. The publication sorts the table by kind.
    first, mask = masks_of((edges.relation, of_ego, bucket, edges.src, edges.dst), bit)
    src, dst = edges.src[first], edges.dst[first]
    return {
        "relation": edges.relation[first],
        "src_is_ego": of_ego[first] >= 2,
        "dst_is_ego": of_ego[first] % 2 == 1,
        "src_kind": kinds.of(src),
        "dst_kind": kinds.of(dst),
        "bucket": trace_bucket(trace_id, seq[edges.frame[first]]),
        "src": src,
        "dst": dst,
        "mask": mask,
    }


def lane_columns(graph: GraphBlock | WorldBlock, trace_id: int, kinds: NodeKinds) -> Columns:
    """Return the positions of objects on lanes in each frame as columns. Kinds are codes."""
    lanes = graph.lanes
    seq = graph.frames.seq[lanes.frame]
    return {
        "kind": kinds.of(lanes.node),
        "bucket": trace_bucket(trace_id, seq),
        "bit": seq % BUCKET_FRAMES,
        "node_id": lanes.node,
        "lane": lanes.lane,
        "overlap": number(lanes.overlap),
        "lane_offset": number(lanes.offset),
        "heading_error": number(lanes.heading_error),
        "is_primary": lanes.primary,
        "along": number(lanes.along),
        "is_own": lanes.own,
        "is_ego": graph.frames.ego[lanes.frame] == lanes.node,
    }


def gap_columns(graph: GraphBlock | WorldBlock, trace_id: int) -> Columns:
    """Return the distances along lanes between objects in each frame, as columns."""
    gaps = graph.gaps
    seq = graph.frames.seq[gaps.frame]
    return {
        "bucket": trace_bucket(trace_id, seq),
        "bit": seq % BUCKET_FRAMES,
        "src": gaps.src,
        "dst": gaps.dst,
        "gap": number(gaps.gap),
    }


def entity_columns(graph: GraphBlock, origin: Origin) -> Columns:
    """Return the rows of the store table ``entity`` (objects of a trace) as columns. Kinds are codes."""
    entities, scenery = graph.frames.entities, graph.frames.scenery
    rows = scenery.node - entities.first
    if len(rows) and not 0 <= rows.min() <= rows.max() < len(entities):
        raise ValueError("scenery of entities that the block does not introduce")
    poses = {
        name: np.full(len(entities), np.nan)
        for name in ("x", "y", "z", "heading", "length", "width", "height")
    }
    for name, values in poses.items():
        values[rows] = getattr(scenery, name)
    poses["heading"] = turned(poses["heading"])
    for name in ("x", "y", "z"):
        poses[name] -= getattr(origin, name)
    return {
        "node_id": entities.first + np.arange(len(entities)),
        "kind": entities.kind,
        "ident": texts(entities.ident),
        "special": texts(entities.special),
        "subkind": texts(entities.subkind),
        "type_name": texts(entities.type_name),
        "is_static": entities.static,
        "map_ref": texts(entities.map_ref),
        "lifetime": np.array(entities.lifetime or [1] * len(entities), np.int64),
        **{name: number(values) for name, values in poses.items()},
    }


def message_columns(messages: MessageRefs, channel_ids: Ints) -> Columns:
    """Return the file positions of messages as columns, with the channel ids of the recording."""
    columns = {f.name: getattr(messages, f.name) for f in fields(messages)}
    return columns | {"channel": channel_ids[messages.channel]}


def unless(values: Whole, missing: Bools) -> Ints:
    """Replace masked values of an array by :data:`MISSING`, and return int64 values."""
    return np.where(missing, np.int64(MISSING), values)


def texts(values: Iterable[str]) -> NDArray[Any]:
    """Return texts as an array. Characters that are not valid Unicode become ``?``."""
    told = list(values)
    return np.array(told if "".join(told).isascii() else [plain(value) for value in told], object)


def plain(text: str) -> str:
    """Replace characters that are not valid Unicode, such as lone surrogates, by ``?``."""
    return text if text.isascii() else text.encode("utf-8", "replace").decode()


def as_json(values: Any) -> str:
    """Return values as canonical JSON text. Equal values give equal texts."""
    return plain(json.dumps(values, sort_keys=True, ensure_ascii=False))
