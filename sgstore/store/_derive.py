"""Derived sets of relations: edges of graphs that are computed after ingest, from the stored states.

The module returns the stored states as generator input, and stores the result of other settings.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import sgstore.store._packing as packing
import sgstore.store._schema as shape
from sgstore.errors import AbstractionError, StoreError
from sgstore.model import frame_ids
from sgstore.model.frame_ids import FRAME_BITS
from sgstore.model.graph import SceneGraph
from sgstore.model.vocabulary import normalize_name
from sgstore.model.world import (
    BUCKET_FRAMES,
    INPUTS,
    POSE,
    Entities,
    FrameBlock,
    MessageRefs,
    Origin,
    States,
)
from sgstore.store._graphs import Graphs, filled
from sgstore.store._packing import NodeKinds, as_json, texts
from sgstore.store._publish import add, note, widen, writing
from sgstore.store._rows import run
from sgstore.store._staging import Staging
from sgstore.store._traces import trace_named

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.graphs.abstractions import GraphColumns, Labelled
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Ints
    from sgstore.store._locking import Access
    from sgstore.store._packing import Columns


TABLES: Final = ("derived", "derived_node", "derived_edge", "derived_gap")
_BUCKETS: Final = 2
"""Buckets of frames in a block, the same number as during ingest."""

_NUMBERS: Final = (*POSE, *INPUTS)
_POSE: Final = ("x", "y", "z", "heading", "length", "width", "height")

_FRAMES: Final = """
SELECT frame_id, seq, time_ns, log_time_ns, coalesce(ego, -1) AS ego FROM frame
WHERE frame_id >= $low << 6 AND frame_id < $high << 6 ORDER BY frame_id
"""
_STATES: Final = f"""
SELECT frame_id, node_id, coalesce(lights, -1) AS lights, derived, coalesce(carrier, -1) AS carrier,
       coalesce(enum_code(light_state)::INTEGER, -1) AS light_state, coalesce(lane, 0) AS lane,
       {", ".join(_NUMBERS)}
FROM known_state LEFT JOIN (
  SELECT frame_id, node_id,
         max(lane) FILTER (is_primary) * CASE count(*) FILTER (is_own) WHEN 1 THEN 1 ELSE -1 END AS lane
  FROM known_lane_state WHERE bucket >= $low AND bucket < $high GROUP BY frame_id, node_id
) USING (frame_id, node_id)
WHERE frame_id >= $low << 6 AND frame_id < $high << 6 ORDER BY frame_id, node_id
"""
_ENTITIES: Final = """
SELECT e.node_id, enum_code(e.kind) AS kind, e.is_static, coalesce(e.ident, '') AS ident,
       coalesce(e.special, '') AS special, coalesce(e.subkind, '') AS subkind,
       coalesce(e.type_name, '') AS type_name, coalesce(e.map_ref, '') AS map_ref, e.lifetime,
       e.x, e.y, e.z, e.heading, e.length, e.width, e.height, coalesce(p.bucket, 1::BIGINT << 62) AS bucket
FROM entity e LEFT JOIN (
  SELECT node_id, min(bucket) AS bucket FROM (
    SELECT node_id, frame_id >> 6 AS bucket FROM known_state
    WHERE frame_id >= $trace << 24 AND frame_id < ($trace + 1) << 24 UNION ALL
    SELECT node_id, bucket FROM known_node
    WHERE node_id >= 0 AND bucket >= $trace << 18 AND bucket < ($trace + 1) << 18)
  GROUP BY node_id) p ON p.node_id = e.node_id
WHERE e.trace_id = $trace ORDER BY e.node_id
"""


_HERE: Final = "bucket = $bucket AND mask & $bit <> 0"


@dataclass(frozen=True, slots=True)
class DerivedSet:
    """Named set of relations (edges) of one trace. It was computed after ingest from stored object states.

    Attributes
    ----------
    name : str
        Name of the set.
    trace_id : int
    trace : str
        Name of the trace.
    settings : dict
        Config of the set.
    digest : str
        Digest of the config.
    answers : tuple of str
        Relations that the trace can answer.
    """

    name: str
    trace_id: int
    trace: str
    settings: dict[str, Any]
    digest: str
    answers: tuple[str, ...]


class Deriving:
    """Named sets of relations derived after ingest. Created by :attr:`StoreFile.deriving`."""

    def __init__(self, path: Path, access: Access) -> None:
        self._path = path
        self._access = access

    def sets(self) -> tuple[DerivedSet, ...]:
        """Return all sets of relations that were derived after ingest, sorted by set name and trace."""
        with self._access.reading() as connection:
            return sets_of(connection)

    def blocks(self, trace_id: int) -> Iterator[FrameBlock]:
        """Yield the frames of a trace with the stored object states, at most 128 frames at a time.

        An entity is introduced at its first known state, or before a later one with a known state. So the
        generator has the same data as at ingest.
        """
        with self._access.reading() as connection:
            reader = _StateReader(connection, trace_id)
            yield from reader.blocks()

    def seen(self, trace_id: int) -> Iterator[tuple[Ints, GraphColumns]]:
        """Yield frame numbers and graphs of a trace, as columns, with the edges written at ingest."""
        with self._access.reading() as connection:
            yield from Graphs().of_trace(connection, trace_id)

    def building(self, name: str, trace_id: int) -> Building:
        """Return a context manager that writes a named set of relations for a trace, from its states."""
        return Building(self._path, self._access, name, trace_id)

    def remove(self, name: str) -> tuple[str, ...]:
        """Delete a set of relations derived after ingest from all traces, and return the names of these traces.

        Raises
        ------
        AbstractionError
            The set does not exist.
        """
        gone = [one for one in self.sets() if normalize_name(one.name) == normalize_name(name)]
        if not gone:
            raise AbstractionError(f"no derived set {name!r}")
        with writing(self._access) as connection:
            for one in gone:
                _delete(connection, one.name, one.trace_id)
                note(connection, one.trace_id, TABLES)
        return tuple(one.trace for one in gone)

    def graph(self, whole: SceneGraph, name: str) -> SceneGraph:
        """Return a frame's scene graph, with the nodes and edges of a set of relations derived after ingest.

        Parameters
        ----------
        whole : SceneGraph
            Graph from the ingest.
        name : str

        Raises
        ------
        AbstractionError
            The trace has no such set.
        """
        with self._access.reading() as connection:
            trace_id, _ = trace_named(connection, whole.trace)
            known = [s.name for s in sets_of(connection) if s.trace_id == trace_id]
            found = next((n for n in known if normalize_name(n) == normalize_name(name)), None)
            if found is None:
                raise AbstractionError(f"{whole.trace!r} has no derived set {name!r}")
            where = {
                "name": found,
                "bucket": whole.frame_id >> FRAME_BITS,
                "bit": 1 << whole.frame_id % (1 << FRAME_BITS),
                "frame": whole.frame_id,
            }

            def rows(sql: str) -> list[tuple[Any, ...]]:
                used = {key: value for key, value in where.items() if f"${key}" in sql}
                return run(connection, sql, used).values

            present = rows(f"SELECT node_id FROM derived_node WHERE {_HERE} AND set_name = $name")
            ends = "SELECT src, relation::VARCHAR, dst FROM"
            drawn = rows(f"{ends} derived_edge WHERE {_HERE} AND set_name = $name ORDER BY ALL")
            before = rows(
                f"{ends} (SELECT * FROM edge UNION ALL SELECT * FROM world_edge) WHERE {_HERE}"
            )
            gaps = rows(
                "SELECT src, dst, gap FROM derived_gap"
                " WHERE bucket = $frame >> 6 AND bit = $frame & 63 AND set_name = $name AND gap IS NOT NULL"
            )
        whole = whole.known()
        nodes = {node: whole.nodes[node] for (node,) in present if node in whole.nodes}
        about = {(src, relation, dst): more for src, relation, dst, more in whole.edges}
        about |= {(src, "follows", dst): {"gap": gap} for src, dst, gap in gaps}
        about |= {(dst, "leads", src): {"gap": gap} for src, dst, gap in gaps}
        edges = [(a, r, b, dict(about.get((a, r, b), {}))) for a, r, b in drawn]
        # The remaining edges belong to the map.
        old = set(before)
        edges += [e for e in whole.edges if e[:3] not in old and {e[0], e[2]} <= nodes.keys()]
        return SceneGraph(
            whole.frame_id,
            whole.trace,
            whole.seq,
            whole.time_ns,
            whole.ego,
            nodes,
            edges,
            whole.reach,
        )


def sets_of(connection: DuckDBPyConnection) -> tuple[DerivedSet, ...]:
    """Return all sets of relations in a store that were derived after ingest."""
    rows = run(
        connection,
        "SELECT d.name, d.trace_id, t.name AS trace, d.settings, d.digest, d.answers"
        " FROM derived d JOIN trace t ON t.trace_id = d.trace_id ORDER BY d.name, t.ingested_at, t.name",
    ).dicts()
    for row in rows:
        row["settings"], row["answers"] = json.loads(row["settings"]), tuple(row["answers"])
    return tuple(DerivedSet(**row) for row in rows)


class Building:
    """Writer of a set of relations (edges derived after ingest) for one trace."""

    def __init__(self, path: Path, access: Access, name: str, trace_id: int) -> None:
        self._access = access
        self._name = name
        self._trace_id = trace_id
        self._staging = Staging(path)
        self._kinds = NodeKinds(np.zeros(0, np.int8), np.zeros(0, np.int8))
        try:
            self._learn_from_store()
        except BaseException:
            self._staging.close()
            raise

    def _learn_from_store(self) -> None:
        with self._access.reading() as connection:
            kinds = connection.execute(
                "SELECT enum_code(n.kind) AS kind FROM map_node n JOIN trace t ON t.map_id = n.map_id"
                " WHERE t.trace_id = ? ORDER BY n.node_id DESC",
                [self._trace_id],
            ).fetchnumpy()
            static = connection.execute(
                "SELECT node_id FROM entity WHERE trace_id = ? AND is_static", [self._trace_id]
            ).fetchnumpy()
        self._static = static["node_id"].astype(np.int64)
        self._kinds.map = kinds["kind"].astype(np.int8)

    def __enter__(self) -> Building:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._staging.close()

    def append(self, graph: GraphBlock) -> None:
        """Add the graphs of the next frames to the set of relations."""
        if not len(graph):
            return
        self._staging.settle(whole=int(graph.frames.seq[0]) % BUCKET_FRAMES == 0)
        self._kinds.learn(graph.frames.entities)
        still = packing.node_columns(graph, self._trace_id, self._kinds)
        self._insert("derived_node", still | {"moves": np.zeros(len(still["mask"]), np.bool_)})
        frames = graph.frames
        seq = frames.seq[frames.frame_of]
        bucket, node = frame_ids.trace_bucket(self._trace_id, seq), frames.states.node
        first, mask = packing.masks_of((bucket, node), seq % BUCKET_FRAMES)
        moving: Columns = {
            "kind": self._kinds.of(node[first]),
            "bucket": bucket[first],
            "node_id": node[first],
            "mask": mask,
            "moves": np.ones(len(mask), np.bool_),
        }
        self._insert("derived_node", moving)
        for columns in packing.edge_columns(graph, self._trace_id, self._kinds):
            self._insert("derived_edge", columns)
        self._insert("derived_gap", packing.gap_columns(graph, self._trace_id))

    def append_labelled(self, seq: Ints, seen: GraphColumns, graphs: Labelled) -> None:
        """Add the abstracted graphs of the next frames to the set of relations.

        Nodes and edges that a store cannot hold are dropped.

        Kept are nodes of the scene graph, and edges between them with a relation as label.
        """
        self._staging.settle(whole=True)
        rows = seen.row_of(graphs.node_frame, graphs.node)
        rows = rows[rows >= 0]
        bucket = frame_ids.trace_bucket(self._trace_id, seq)
        at, node, kind = seen.node_frame[rows], seen.node[rows], seen.kind[rows]
        first, mask = packing.masks_of((bucket[at], node), seq[at] % BUCKET_FRAMES)
        self._insert(
            "derived_node",
            {
                "kind": kind[first],
                "bucket": bucket[at][first],
                "node_id": node[first],
                "mask": mask,
                "moves": (node[first] >= 0) & ~np.isin(node[first], self._static),
            },
        )
        frame, src, relation, dst = graphs.related()
        a, b = seen.row_of(frame, src), seen.row_of(frame, dst)
        both = np.flatnonzero((a >= 0) & (b >= 0))
        frame, relation, a, b = frame[both], relation[both], a[both], b[both]
        of_ego = seen.is_ego[a] * 2 + seen.is_ego[b]
        keys = (relation, of_ego, bucket[frame], seen.node[a], seen.node[b])
        first, mask = packing.masks_of(keys, seq[frame] % BUCKET_FRAMES)
        a, b = a[first], b[first]
        self._insert(
            "derived_edge",
            {
                "relation": relation[first],
                "src_is_ego": seen.is_ego[a],
                "dst_is_ego": seen.is_ego[b],
                "src_kind": seen.kind[a],
                "dst_kind": seen.kind[b],
                "bucket": bucket[frame][first],
                "src": seen.node[a],
                "dst": seen.node[b],
                "mask": mask,
            },
        )

    def _insert(self, table: str, columns: Columns) -> None:
        named = texts([self._name])
        count = len(next(iter(columns.values())))
        self._staging.insert(table, columns | {"set_name": named.repeat(count)})

    def publish(self, settings: Mapping[str, Any], digest: str, answers: tuple[str, ...]) -> None:
        """Write the set of relations to the store in one transaction. It replaces a set of the same name.

        Raises
        ------
        StoreError
            The trace was removed in the meantime, or another process uses the store for too long.
        """
        self._staging.seal()
        with writing(self._access) as connection:
            there = connection.execute(
                "SELECT 1 FROM store.inside.trace WHERE trace_id = ?", [self._trace_id]
            ).fetchone()
            if there is None:
                raise StoreError("the trace was removed from the store meanwhile")
            _delete(connection, self._name, self._trace_id)
            widen(connection, self._staging.words(answers))
            add(connection, self._access.path, self._staging)
            connection.execute(
                "INSERT INTO store.inside.derived BY NAME SELECT $name AS name, $trace AS trace_id,"
                " $settings AS settings, $digest AS digest, $answers AS answers,"
                " $now AS derived_at, $version AS version",
                {
                    "name": self._name,
                    "trace": self._trace_id,
                    "settings": as_json(dict(settings)),
                    "digest": digest,
                    "answers": list(answers),
                    "now": datetime.now(UTC).replace(tzinfo=None),
                    "version": version("sgstore"),
                },
            )
            note(connection, self._trace_id, TABLES)


def _delete(connection: DuckDBPyConnection, name: str, trace_id: int) -> None:
    connection.execute(
        "DELETE FROM store.inside.derived WHERE name = ? AND trace_id = ?", [name, trace_id]
    )
    for table in ("derived_node", "derived_edge", "derived_gap"):
        connection.execute(
            f"DELETE FROM store.inside.{table} WHERE set_name = ? AND bucket >> 18 = ?",
            [name, trace_id],
        )


class _StateReader:
    """Reader of the object states of one trace. It returns them as blocks of frames."""

    def __init__(self, connection: DuckDBPyConnection, trace_id: int) -> None:
        self._connection = connection
        (row,) = connection.execute(
            "SELECT origin_x, origin_y, origin_z, frames, coalesce(CAST(report->>'noise' AS DOUBLE), 0)"
            " FROM trace WHERE trace_id = ?",
            [trace_id],
        ).fetchall()
        self._noise = row[4]
        self._origin = Origin(*row[:3])
        self._low = trace_id << frame_ids.BUCKET_BITS
        self._high = self._low + -(-row[3] // BUCKET_FRAMES)
        self._entities = connection.execute(_ENTITIES, {"trace": trace_id}).fetchnumpy()
        self._entities["kind"] = shape.codes_of(connection, "kind")[self._entities["kind"]]
        self._lights = shape.codes_of(connection, "light_state")
        first = np.ma.getdata(self._entities["bucket"]).astype(np.int64)
        self._due: Ints = np.minimum.accumulate(first[::-1])[::-1]
        self._next = 0

    def blocks(self) -> Iterator[FrameBlock]:
        for low in range(self._low, self._high, _BUCKETS):
            yield self._block(low, min(low + _BUCKETS, self._high))

    def _block(self, low: int, high: int) -> FrameBlock:
        where = {"low": low, "high": high}
        frames = self._connection.execute(_FRAMES, where).fetchnumpy()
        states = self._connection.execute(_STATES, where).fetchnumpy()
        ids = frames["frame_id"].astype(np.int64)
        end = int(np.searchsorted(self._due, high))  # entities introduced earlier
        rows = slice(self._next, end)
        entities, scenery = self._introduced(rows)
        self._next = end
        none = np.zeros(0, np.int64)
        return FrameBlock(
            seq=frames["seq"].astype(np.int64),
            time_ns=frames["time_ns"].astype(np.int64),
            log_time_ns=frames["log_time_ns"].astype(np.int64),
            offsets=np.searchsorted(states["frame_id"], np.append(ids, high << FRAME_BITS)),
            states=States.of(
                node=states["node_id"].astype(np.int64),
                lights=states["lights"].astype(np.int64),
                light_state=np.append(self._lights, np.int8(-1))[states["light_state"]],
                derived=states["derived"].astype(np.int64),
                carrier=states["carrier"].astype(np.int64),
                lane=states["lane"].astype(np.int64),
                **self._placed(states, _NUMBERS),
            ),
            ego=frames["ego"].astype(np.int64),
            entities=entities,
            scenery=scenery,
            messages=MessageRefs(none, none, none, none, none),
            noise=self._noise,
        )

    def _introduced(self, rows: slice) -> tuple[Entities, States]:
        part = {name: np.ma.getdata(of)[rows] for name, of in self._entities.items()}
        entities = Entities(
            first=rows.start,
            kind=part["kind"].astype(np.int8),
            static=part["is_static"].astype(np.bool_),
            **{
                name: tuple(part[name].tolist())
                for name in ("ident", "special", "subkind", "type_name", "map_ref", "lifetime")
            },
        )
        poses = {name: self._entities[name][rows] for name in _POSE}
        still = np.flatnonzero(entities.static)
        placed = {name: of[still] for name, of in self._placed(poses, _POSE).items()}
        return entities, States.of(node=rows.start + still, **placed)

    def _placed(
        self, columns: Mapping[str, NDArray[Any]], names: tuple[str, ...]
    ) -> dict[str, NDArray[np.float64]]:
        placed = {name: filled(columns[name]) for name in names}
        for axis in "xyz":
            placed[axis] = getattr(self._origin, axis) + placed[axis]
        return placed
