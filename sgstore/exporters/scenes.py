"""The scene graphs of many frames, as records, read from the store a window at a time.

The same graphs as :meth:`sgstore.query.Store.graph` gives, for a fraction of the cost: five questions for
a whole window and not for each frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.graph import SceneGraph

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.exporters.export import ClipFrames, Export
    from sgstore.store import Rows

_EGOS: Final = "SELECT frame_id, ego FROM frames WHERE frame_id >= $first AND frame_id <= $last"
_NODES: Final = """
SELECT * FROM nodes WHERE frame_id >= $first AND frame_id <= $last
ORDER BY frame_id, is_static, node_id < 0, abs(node_id)
"""
_EDGES: Final = """
SELECT DISTINCT frame_id, src, relation, dst FROM edges WHERE frame_id >= $first AND frame_id <= $last
ORDER BY frame_id, src, relation, dst
"""
_LANES: Final = """
SELECT * EXCLUDE (src_kind) FROM lane_states WHERE frame_id >= $first AND frame_id <= $last
"""
_GAPS: Final = """
SELECT frame_id, src, dst, gap FROM lane_gaps WHERE frame_id >= $first AND frame_id <= $last
"""

Edge = tuple[int, str, int, dict[str, Any]]


def graphs_of(export: Export, frames: ClipFrames) -> Iterator[SceneGraph]:
    """The scene graphs of some frames of a clip, in their order. How lanes reach is told once for all.

    Yields
    ------
    SceneGraph
        As the store puts together a single one, its edges in order of source, relation and destination.
    """

    def rows(sql: str) -> list[tuple[Any, ...]]:
        return export.store.file.rows(sql, frames.bounds).values

    wanted = {int(frame): i for i, frame in enumerate(frames.frame_id)}
    egos = dict(rows(_EGOS))
    nodes: list[dict[int, dict[str, Any]]] = [{} for _ in wanted]
    found = export.store.file.rows(_NODES, frames.bounds)
    names = found.columns[2:]
    for frame_id, node_id, *values in found.values:
        if frame_id in wanted:
            known = {k: v for k, v in zip(names, values, strict=True) if v is not None}
            nodes[wanted[frame_id]][node_id] = known
    about = _attributes(export.store.file.rows(_LANES, frames.bounds), rows(_GAPS))
    edges: list[list[Edge]] = [[] for _ in wanted]
    for frame_id, src, relation, dst in rows(_EDGES):
        if frame_id in wanted:
            attributes = about.get((frame_id, relation, src, dst), {})
            edges[wanted[frame_id]].append((src, relation, dst, attributes))
    mapped = next((frame for frame, row in wanted.items() if min(nodes[row], default=0) < 0), None)
    reach = None if mapped is None else export.store.file.graph(mapped).reach
    for frame_id, row in wanted.items():
        yield SceneGraph(
            frame_id=frame_id,
            trace=frames.clip.trace,
            seq=int(frames.seq[row]),
            time_ns=int(frames.time_ns[row]),
            ego=egos[frame_id],
            nodes=nodes[row],
            edges=edges[row],
            reach=reach if min(nodes[row], default=0) < 0 else None,
        )


def _attributes(
    lanes: Rows, gaps: list[tuple[Any, ...]]
) -> dict[tuple[int, str, int, int], dict[str, Any]]:
    """What is known of edges: how an entity lies in a lane, how far it is to the one ahead."""
    names = lanes.columns[3:]
    known = {
        (frame_id, "isIn", src, dst): {
            name: value for name, value in zip(names, values, strict=True) if value is not None
        }
        for frame_id, src, dst, *values in lanes
    }
    for frame_id, src, dst, gap in gaps:
        if gap is not None:
            known[frame_id, "follows", src, dst] = {"gap": gap}
            known[frame_id, "leads", dst, src] = {"gap": gap}
    return known
