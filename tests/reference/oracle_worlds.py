"""Random small worlds: as networkx graphs, frame by frame, and as the tables of a store.

The graphs are what an exhaustive search reads; the tables are what the compiler's SQL reads. Both are written
here from the same plain records, with nothing of the store's code in between.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import duckdb
import networkx as nx

from sgstore.lang.catalog import LANE_CHAINS, Catalog, TraceFacts
from sgstore.model.vocabulary import MAP_KINDS
from sgstore.store._locking import without_faults
from sgstore.store._schema import schema_sql

if TYPE_CHECKING:
    from pathlib import Path

SCHEMA = schema_sql()

MAP_NODES: dict[int, dict[str, Any]] = {
    -1: {"kind": "off_road", "name": "off_road"},
    -2: {"kind": "lane", "name": "1/0/-1", "lane_type": "driving", "width": 3.5, "road": "1"},
    -3: {"kind": "lane", "name": "1/0/1", "lane_type": "driving", "width": 3.0, "road": "1"},
    -4: {"kind": "lane", "name": "2/0/-1", "lane_type": "sidewalk", "width": 2.0, "turn": "left"},
    -5: {"kind": "road", "name": "1"},
    -6: {"kind": "junction", "name": "7"},
    -7: {"kind": "crosswalk", "name": "c"},
    -8: {
        "kind": "stop_sign",
        "name": "s8",
        "road": "1",
        "x": 103.0,
        "y": 201.0,
        "z": 0.0,
        "heading": 0.0,
    },
}
MAP_NODES[-4]["junction"] = "7"
MAP_EDGES = [
    (-2, "isIn", -5),
    (-3, "isIn", -5),
    (-4, "isIn", -5),
    (-5, "isIn", -6),
    (-2, "opposes", -3),
    (-3, "opposes", -2),
    (-2, "travelsTo", -4),
    (-4, "travelsTo", -3),
    (-3, "travelsTo", -2),
    (-8, "controlsTrafficOf", -2),
]
# Another map, whose parts have the same numbers and are something else.
OTHER_NODES: dict[int, dict[str, Any]] = {
    -1: {"kind": "off_road", "name": "off_road"},
    -2: {"kind": "lane", "name": "9/0/-1", "lane_type": "driving", "width": 4.0, "road": "9"},
    -3: {"kind": "crosswalk", "name": "c9"},
    -4: {"kind": "lane", "name": "9/0/1", "lane_type": "parking", "width": 2.5, "turn": "right"},
    -5: {"kind": "lane", "name": "9/0/2", "lane_type": "driving", "width": 3.0, "junction": "1"},
    -6: {"kind": "road", "name": "9"},
}
OTHER_EDGES = [
    (-2, "isIn", -6),
    (-4, "isIn", -6),
    (-5, "isIn", -6),
    (-2, "opposes", -4),
    (-2, "travelsTo", -5),
    (-5, "travelsTo", -4),
]
MAPS: dict[int, tuple[str, dict[int, dict[str, Any]], list[tuple[int, str, int]]]] = {
    3: ("town", MAP_NODES, MAP_EDGES),
    8: ("other", OTHER_NODES, OTHER_EDGES),
}
KINDS = ("car", "car", "truck", "person", "bicycle", "traffic_light")
RELATIONS = ("near", "near", "visible", "inDFrontOf", "toLeftOf")
ORIGIN = (100.0, 200.0, 0.0)
STATE = (
    *(
        "x",
        "y",
        "z",
        "heading",
        "pitch",
        "roll",
        "speed",
        "vx",
        "vy",
        "vz",
        "ax",
        "ay",
        "az",
        "yaw_rate",
    ),
    *(
        "length",
        "width",
        "height",
        "lights",
        "light_state",
        "steer",
        "throttle",
        "brake",
        "derived",
    ),
    *("special", "subkind"),
)


@dataclass
class Frame:
    frame_id: int
    trace: Trace
    seq: int
    time_ns: int
    ego: int | None
    states: dict[int, dict[str, Any]]
    present: set[int]
    edges: list[tuple[int, str, int, dict[str, Any]]]
    events: list[tuple[str, int | None, int | None]] = field(default_factory=list)

    @cached_property
    def graph(self) -> nx.MultiDiGraph[int]:
        """The frame as the store's own graphs are: attributes in outward units, missing ones left out."""
        graph = nx.MultiDiGraph(
            frame_id=self.frame_id,
            trace=self.trace.name,
            seq=self.seq,
            time_ns=self.time_ns,
            ego=self.ego,
        )
        for node, state in self.states.items():
            graph.add_node(node, **outward(self.trace, node, state, self.ego))
        for node in self.present:
            graph.add_node(node, **lasting(self.trace, node))
        for src, relation, dst, attributes in self.edges:
            graph.add_edge(src, dst, key=relation, relation=relation, **attributes)
        for src, relation, dst in self.trace.map_edges:
            if {src, dst} <= self.present:
                graph.add_edge(src, dst, key=relation, relation=relation)
        return graph

    @cached_property
    def by_relation(self) -> dict[str, list[tuple[int, int]]]:
        """The ends of the edges of each relation, those of the map among them."""
        found: dict[str, list[tuple[int, int]]] = {}
        for src, dst, relation in self.graph.edges(keys=True):
            found.setdefault(relation, []).append((src, dst))
        return found


@dataclass
class Trace:
    trace_id: int
    name: str
    ego: int
    answers: tuple[str, ...]
    entities: dict[int, dict[str, Any]]
    frames: list[Frame] = field(default_factory=list)
    map_id: int = 3
    records: set[str] = field(default_factory=set)
    """Kinds of events of which it tells."""

    @property
    def hero(self) -> str:
        """What the simulator calls the ego."""
        return f"hero{self.trace_id}"

    @property
    def map_name(self) -> str:
        return MAPS[self.map_id][0]

    @property
    def map_nodes(self) -> dict[int, dict[str, Any]]:
        return MAPS[self.map_id][1]

    @property
    def map_edges(self) -> list[tuple[int, str, int]]:
        return MAPS[self.map_id][2]

    def owner(self, node: int) -> int:
        """Whose number a node id is: that of the trace, or below 0 that of its map."""
        return self.trace_id if node >= 0 else -self.map_id


def outward(trace: Trace, node: int, state: dict[str, Any], ego: int | None) -> dict[str, Any]:
    """Attributes of a moving entity as people see them."""
    entity = trace.entities[node]
    found = {key: value for key, value in state.items() if value is not None}
    for key in ("heading", "yaw_rate"):
        if key in found:
            found[key] = math.degrees(found[key])
    found |= {axis: found[axis] + shift for axis, shift in zip("xyz", ORIGIN, strict=True)}
    if "lights" in found:
        lights = found.pop("lights")
        found |= {"light_left": bool(lights & 1), "light_right": bool(lights & 2)}
    found |= {"kind": entity["kind"], "name": f"{entity['kind']} {node}", "id": node}
    found |= {"is_ego": node == ego, "is_static": False, "ident": entity["ident"]}
    return found


STILL = dict.fromkeys(("speed", "vx", "vy", "vz"), 0.0)


def lasting(trace: Trace, node: int) -> dict[str, Any]:
    """Attributes of a static entity or of a part of the map."""
    common = {"id": node, "is_ego": False, "is_static": True}
    if node < 0:
        found = {**trace.map_nodes[node], **common}
        if "heading" in found:
            found["heading"] = math.degrees(found["heading"])
        if found["kind"] == "lane":
            found["in_junction"] = "junction" in found
        return found | ({} if found["kind"] in MAP_KINDS else STILL)
    entity = trace.entities[node]
    found = {key: value for key, value in entity.items() if value is not None and key != "static"}
    found |= {axis: found[axis] + shift for axis, shift in zip("xyz", ORIGIN, strict=True)}
    found["heading"] = math.degrees(found["heading"])
    return {**found, **common, **STILL, "name": f"{entity['kind']} {node}"}


@dataclass(eq=False)
class World:
    """Traces, a database that holds them, and the catalogue of it."""

    traces: list[Trace]
    connection: duckdb.DuckDBPyConnection

    @cached_property
    def frames(self) -> list[Frame]:
        return [frame for trace in self.traces for frame in trace.frames]

    @cached_property
    def catalog(self) -> Catalog:
        return catalog_of(self.connection)


def catalog_of(connection: duckdb.DuckDBPyConnection) -> Catalog:
    def triples(table: str) -> dict[tuple[str, str, str], int]:
        sql = f"SELECT relation, src_kind, dst_kind, count(*) FROM {table} GROUP BY ALL"
        return {(str(r), str(s), str(d)): n for r, s, d, n in connection.execute(sql).fetchall()}

    def kinds(sql: str) -> frozenset[str]:
        return frozenset(str(kind) for (kind,) in connection.execute(sql).fetchall())

    traces = connection.execute("SELECT trace_id, name, ego, answers FROM trace").fetchall()
    return Catalog(
        edges=triples("edge"),
        map_edges=triples("map_edge"),
        moving=kinds("SELECT DISTINCT kind FROM state"),
        fixed=kinds("SELECT DISTINCT kind FROM entity WHERE is_static"),
        mapped=kinds("SELECT DISTINCT kind FROM map_node"),
        traces=tuple(TraceFacts(i, name, ego or "", frozenset(a)) for i, name, ego, a in traces),
    )


def random_world(
    seed: int,
    *,
    traces: int = 2,
    frames: int = 9,
    static: bool = True,
    maps: int = 1,
    path: Path | None = None,
) -> World:
    """A world whose frames lie on both sides of the end of a bucket; in memory, or in an empty store's file.

    With two maps the last trace has the second one, and the others share the first.
    """
    rng = random.Random(seed)
    made = [
        random_trace(
            rng,
            number + 1,
            frames,
            static=static,
            map_id=8 if maps == 2 and number == traces - 1 else 3,
        )
        for number in range(traces)
    ]
    connection = duckdb.connect(str(path or ":memory:"))
    without_faults(connection)
    if path is None:
        connection.execute(SCHEMA)
        add_chains(connection)
    store_all(connection, made, rng)
    return World(made, connection)


def add_chains(connection: duckdb.DuckDBPyConnection) -> None:
    """Add the table of pairs of lanes that are one lane, as a store does; here, each lane is alone."""
    columns = "map_id BIGINT, src INTEGER, dst INTEGER"
    connection.execute(f'CREATE TEMP TABLE "{LANE_CHAINS}" ({columns})')


def random_trace(
    rng: random.Random, number: int, frames: int, *, static: bool, map_id: int = 3
) -> Trace:
    count = rng.randint(3, 5)
    entities: dict[int, dict[str, Any]] = {}
    for node in range(count):
        kind = "car" if node == 0 else rng.choice(KINDS)
        special = rng.choice((None, None, "emergency", "taxi"))
        subkind = rng.choice((None, "cone"))
        entities[node] = {"kind": kind, "static": False, "ident": f"id{node}"}
        entities[node] |= {"special": special, "subkind": subkind}
    if static:
        pose = {
            "x": 3.0,
            "y": -2.0,
            "z": 0.5,
            "heading": 0.5,
            "length": 4.0,
            "width": 2.0,
            "height": 1.0,
        }
        kind = rng.choice(("car", "prop"))
        entities[count] = {"kind": kind, "static": True, "ident": "still", "special": None}
        entities[count] |= {"subkind": rng.choice((None, "cone")), **pose}
    answers = tuple(
        r for r in ("isIn", "near", "visible", "opposes", "travelsTo") if rng.random() < 0.95
    )
    answers += ("inDFrontOf", "toLeftOf", "controlsTrafficOf", "leads", "follows")
    trace = Trace(number, f"trace{number}", 0, answers, entities, map_id=map_id)
    first = 60 - rng.randint(1, frames - 1)
    time_ns = 0
    for seq in range(first, first + frames):
        time_ns += rng.choice((100, 100, 100, 900)) * 1_000_000
        trace.frames.append(random_frame(rng, trace, seq, time_ns))
    something_happens(trace, random.Random(f"{time_ns} {count}"))
    return trace


def something_happens(trace: Trace, rng: random.Random) -> None:
    """Events of some frames, and whether others would have been told."""
    nodes = [*trace.entities, None]
    for frame in trace.frames:
        for kind, chance in (("collision", 0.3), ("lane_invasion", 0.2), ("environment", 0.1)):
            if rng.random() < chance and not (kind == "collision" and trace.trace_id % 3 == 2):
                a = None if kind == "environment" else rng.choice(nodes)
                b = rng.choice(nodes) if kind == "collision" else None
                frame.events.append((kind, a, b))
                trace.records.add(kind)
    trace.records |= {kind for kind in SCHEMAS if rng.random() < 0.3}


SCHEMAS = {
    "collision": "carla_msgs/msg/CarlaCollisionEvent",
    "lane_invasion": "carla_msgs/msg/CarlaLaneInvasionEvent",
}
"""Schemas of the channels that tell of events."""


def random_frame(rng: random.Random, trace: Trace, seq: int, time_ns: int) -> Frame:
    moving = [n for n, e in trace.entities.items() if not e["static"] and rng.random() < 0.85]
    still = {n for n, e in trace.entities.items() if e["static"] and rng.random() < 0.8}
    parts = trace.map_nodes
    present = still | {node for node in parts if rng.random() < 0.85}
    lanes = [node for node in parts if parts[node]["kind"] == "lane"]
    places = {n for n in parts if parts[n]["kind"] in {"lane", "off_road", "crosswalk"}}
    states = {node: random_state(rng, trace.entities[node]) for node in moving}
    edges: list[tuple[int, str, int, dict[str, Any]]] = []
    everything = [*moving, *still]
    for src in everything:
        for dst in everything:
            chosen = dict.fromkeys((rng.choice(RELATIONS), rng.choice(RELATIONS)))
            edges += [(src, r, dst, {}) for r in chosen if src != dst and rng.random() < 0.35]
        for place in sorted(present & places):
            if rng.random() < 0.35:
                lane = place in lanes
                edges.append((src, "isIn", place, lane_state(rng) if lane else {}))
        if trace.entities[src]["kind"] == "traffic_light":
            edges += [
                (src, "controlsTrafficOf", n, {})
                for n in sorted(present & set(lanes[:2]))
                if rng.random() < 0.6
            ]
    edges += following(random.Random(time_ns + seq), moving)
    bucket = (trace.trace_id << 18) + seq // 60
    ego = trace.ego if trace.ego in moving else None
    return Frame(bucket * 64 + seq % 60, trace, seq, time_ns, ego, states, present, edges)


def following(rng: random.Random, moving: list[int]) -> list[tuple[int, str, int, dict[str, Any]]]:
    """Who follows whom, with the gap or without one."""
    edges: list[tuple[int, str, int, dict[str, Any]]] = []
    for a in moving:
        for b in moving:
            if a != b and rng.random() < 0.2:
                gap = rng.choice(({"gap": 3.0}, {"gap": 8.5}, {"gap": 0.0}, {}))
                edges += [(a, "follows", b, dict(gap)), (b, "leads", a, dict(gap))]
    return edges


def lane_state(rng: random.Random) -> dict[str, Any]:
    return {
        "overlap": rng.choice((0.25, 0.5, 1.0)),
        "lane_offset": rng.choice((-0.5, 0.0, 0.5)),
        "heading_error": 0.0,
        "is_primary": rng.random() < 0.5,
        "is_own": False,
    }


def random_state(rng: random.Random, entity: dict[str, Any]) -> dict[str, Any]:
    def some(*values: Any) -> Any:
        return rng.choice((*values, None))

    state: dict[str, Any] = {
        "x": rng.choice((0.0, 3.0, 6.5, -4.0, 12.0)),
        "y": rng.choice((0.0, 2.5, -3.0, 7.0)),
        "z": rng.choice((0.0, 0.0, 3.0)),
        "heading": rng.choice((0.0, 0.5, -1.5, 3.0)),
        "speed": some(0.0, 1.0, 5.0, 10.0),
        "vx": some(0.0, 2.0, -2.0),
        "vy": some(0.0, 1.0),
        "length": some(4.0, 2.0),
        "width": some(2.0, 1.0),
        "special": entity["special"],
        "subkind": entity["subkind"],
    }
    if entity["kind"] in {"car", "truck", "bicycle"}:
        state["lights"] = some(0, 1, 2, 3)
    if entity["kind"] == "traffic_light":
        state["light_state"] = some("red", "green", "off")
    return state


def store_all(
    connection: duckdb.DuckDBPyConnection, traces: list[Trace], rng: random.Random
) -> None:
    connection.execute("USE inside")
    connection.execute("INSERT INTO config VALUES (1, 'c', '{}')")
    columns = (
        "lane_type",
        "road",
        "section",
        "lane",
        "junction",
        "turn",
        "x",
        "y",
        "z",
        "heading",
        "width",
    )
    for map_id in sorted({trace.map_id for trace in traces}):
        name, parts, edges = MAPS[map_id]
        row = {"map_id": map_id, "digest": f"d{map_id}", "name": name, "text": ""}
        insert(connection, "map", [row])
        rows = [
            {"map_id": map_id, "node_id": node, "kind": about["kind"], "name": about["name"]}
            | {column: about.get(column) for column in columns}
            for node, about in parts.items()
        ]
        insert(connection, "map_node", rows)
        rows = [
            {"map_id": map_id, "relation": r, "src": s, "dst": d}
            | {"src_kind": parts[s]["kind"], "dst_kind": parts[d]["kind"]}
            for s, r, d in edges
        ]
        insert(connection, "map_edge", rows)
    for trace in traces:
        store_trace(connection, trace, rng)


def store_trace(connection: duckdb.DuckDBPyConnection, trace: Trace, rng: random.Random) -> None:
    times = [frame.time_ns for frame in trace.frames]
    row = {
        "trace_id": trace.trace_id,
        "name": trace.name,
        "ego": trace.hero,
        "map_id": trace.map_id,
    }
    row |= {
        "frames": len(times),
        "start_ns": times[0],
        "end_ns": times[-1],
        "period_ns": 100_000_000,
    }
    row |= {"answers": list(trace.answers), "flavour": "osi", "recording_id": trace.trace_id}
    row |= {"config_id": 1, "report": "{}"}
    recording = {"recording_id": trace.trace_id, "digest": f"t{trace.trace_id}"}
    recording |= {"uri": f"/{trace.name}.mcap", "size": 1, "mtime_ns": 1}
    insert(connection, "recording", [recording])
    row |= {"ingested_at": "2026-01-01", "version": "test"}
    row |= dict(zip(("origin_x", "origin_y", "origin_z"), ORIGIN, strict=True))
    insert(connection, "trace", [row])
    insert(
        connection,
        "entity",
        [
            {key: value for key, value in entity.items() if key != "static"}
            | {"trace_id": trace.trace_id, "node_id": node, "is_static": entity["static"]}
            for node, entity in trace.entities.items()
        ],
    )
    insert(connection, "frame", [frame_row(frame) for frame in trace.frames])
    insert(connection, "state", [row for frame in trace.frames for row in state_rows(frame)])
    for table, rows_of in (("lane", lane_rows), ("gap", gap_rows)):
        rows = [row for frame in trace.frames for row in rows_of(frame)]
        for name, some in parted(rows, rng).items():
            insert(connection, f"{table}_{name}", some)
    store_masks(connection, trace, rng)
    channels = [kind for kind in SCHEMAS if kind in trace.records]
    rows = [
        {"trace_id": trace.trace_id, "channel_id": n, "schema": SCHEMAS[kind]}
        for n, kind in enumerate(channels)
    ]
    insert(connection, "channel", rows)
    insert(connection, "event", [row for frame in trace.frames for row in event_rows(frame)])


def event_rows(frame: Frame) -> list[dict[str, Any]]:
    def ident(node: int | None) -> str | None:
        return None if node is None else frame.trace.entities[node]["ident"]

    about = {"trace_id": frame.trace.trace_id, "frame_id": frame.frame_id}
    about |= {"time_ns": frame.time_ns, "log_time_ns": frame.time_ns}
    return [
        about | {"kind": kind, "ident": ident(a), "other": ident(b)} for kind, a, b in frame.events
    ]


def parted(rows: list[dict[str, Any]], rng: random.Random) -> dict[str, list[dict[str, Any]]]:
    """Rows with their frame as bucket and bit, or as bucket and mask: some alone, equal ones together."""
    single: list[dict[str, Any]] = []
    masks: dict[tuple[tuple[str, Any], ...], int] = {}
    for row in rows:
        frame_id = row["frame_id"]
        rest = {key: value for key, value in row.items() if key != "frame_id"}
        rest |= {"bucket": frame_id >> 6}
        if rng.random() < 0.5:
            single.append(rest | {"bit": frame_id & 63})
        else:
            key = tuple(rest.items())
            masks[key] = masks.get(key, 0) | 1 << (frame_id & 63)
    repeated = [dict(key) | {"mask": mask} for key, mask in masks.items()]
    return {"single": single, "repeated": repeated}


def frame_row(frame: Frame) -> dict[str, Any]:
    row = {"trace_id": frame.trace.trace_id, "map_id": frame.trace.map_id}
    row |= {"bucket": frame.frame_id >> 6}
    row |= {"frame_id": frame.frame_id, "bit": frame.frame_id & 63, "seq": frame.seq}
    return row | {"time_ns": frame.time_ns, "log_time_ns": frame.time_ns + 5, "ego": frame.ego}


def state_rows(frame: Frame) -> list[dict[str, Any]]:
    entities = frame.trace.entities
    return [
        {column: state.get(column) for column in STATE}
        | {"frame_id": frame.frame_id, "node_id": node, "kind": entities[node]["kind"]}
        | {"is_ego": node == frame.ego}
        for node, state in frame.states.items()
    ]


def lane_rows(frame: Frame) -> list[dict[str, Any]]:
    entities = frame.trace.entities
    return [
        {"frame_id": frame.frame_id, "node_id": src, "lane": dst, "kind": entities[src]["kind"]}
        | attributes
        for src, relation, dst, attributes in frame.edges
        if attributes and relation == "isIn"
    ]


def gap_rows(frame: Frame) -> list[dict[str, Any]]:
    """Rows of who follows whom; where the gap is not known there may be a row or none."""
    return [
        {"frame_id": frame.frame_id, "src": src, "dst": dst, "gap": attributes.get("gap")}
        for src, relation, dst, attributes in frame.edges
        if relation == "follows" and (attributes or (src + dst) % 2)
    ]


def store_masks(connection: duckdb.DuckDBPyConnection, trace: Trace, rng: random.Random) -> None:
    """Edges and static nodes as masks; now and then one mask in two rows, as a store may have them."""
    masks: dict[tuple[Any, ...], int] = {}
    nodes: dict[tuple[Any, ...], int] = {}
    valid: dict[int, int] = {}
    joined: dict[int, int] = {}
    kinds = {n: e["kind"] for n, e in trace.entities.items()} | {
        n: m["kind"] for n, m in trace.map_nodes.items()
    }
    for before, frame in zip([None, *trace.frames], trace.frames, strict=False):
        bucket, bit = frame.frame_id >> 6, 1 << (frame.frame_id & 63)
        valid[bucket] = valid.get(bucket, 0) | bit
        near = before is not None and frame.time_ns - before.time_ns <= 250_000_000
        joined[bucket] = joined.get(bucket, 0) | (bit if near else 0)
        for src, relation, dst, _ in frame.edges:
            key = (
                relation,
                src == frame.ego,
                dst == frame.ego,
                kinds[src],
                kinds[dst],
                bucket,
                src,
                dst,
            )
            masks[key] = masks.get(key, 0) | bit
        for node in frame.present:
            key = (kinds[node], bucket, node)
            nodes[key] = nodes.get(key, 0) | bit
    names = ("relation", "src_is_ego", "dst_is_ego", "src_kind", "dst_kind", "bucket", "src", "dst")
    rows = [
        dict(zip(names, key, strict=True)) | {"mask": part}
        for key, mask in masks.items()
        for part in parts_of(mask, rng)
    ]
    insert(connection, "edge", rows)
    rows = [
        dict(zip(("kind", "bucket", "node_id"), k, strict=True)) | {"mask": m}
        for k, m in nodes.items()
    ]
    insert(connection, "node", rows)
    base = {"trace_id": trace.trace_id, "map_id": trace.map_id}
    rows = [base | {"bucket": b, "valid": v, "joined": joined[b]} for b, v in valid.items()]
    insert(connection, "bucket", rows)


def parts_of(mask: int, rng: random.Random) -> list[int]:
    one = mask & rng.getrandbits(60)
    return [part for part in (one, mask - one) if part] if rng.random() < 0.2 else [mask]


FILLING = {
    "VARCHAR": "x",
    "JSON": "{}",
    "VARCHAR[]": [],
    "BOOLEAN": False,
    "TIMESTAMP": "2026-01-01",
}
"""What stands in columns that a world does not tell of and a store must have; else 0."""


def insert(connection: duckdb.DuckDBPyConnection, table: str, rows: list[dict[str, Any]]) -> None:
    if not rows:
        return
    known = dict.fromkeys(name for row in rows for name in row)
    needed = connection.execute(
        "SELECT column_name, data_type FROM duckdb_columns() WHERE table_name = ? AND NOT is_nullable",
        [table],
    ).fetchall()
    rest = {name: FILLING.get(kind, 0) for name, kind in needed if name not in known}
    rows = [rest | row for row in rows]
    names = [*known, *rest]
    columns = ", ".join(f'"{name}"' for name in names)
    marks = f"({', '.join('?' for _ in names)})"
    for start in range(0, len(rows), 200):
        part = rows[start : start + 200]
        values = [row.get(name) for row in part for name in names]
        sql = f"INSERT INTO {table} ({columns}) VALUES {', '.join([marks] * len(part))}"
        connection.execute(sql, values)
