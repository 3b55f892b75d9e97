"""What the preset ``carlasgg`` gives, beside what CARLASGG itself computed for the same traffic.

::

    python -m bench.against_carlasgg TRACE ORACLE [--map FILE.xodr]

TRACE is a recording of CARLA's ROS bridge, ORACLE a folder with ``junction_rsv.jsonl.gz``: one line a frame,
with the nodes and edges of CARLASGG's junction abstraction. Entities are told by their actor ids, lanes by road
and lane number, as CARLASGG names them: it does not know sections. Traffic lights are told by where they stand.

Every difference is looked into, and counted under its cause:

* *tie*: the number that decides is at its threshold, up to the float32 that CARLA computes with;
* *overhang*: CARLASGG takes a lane for boxes, 2 m long, around points every metre: they stick out beyond the
  ends of the lane, and beside it in a bend, so an entity is in a lane that it does not touch;
* *range cut*: it drops the points outside the rectangle with their boxes, so that an entity at the edge is in
  no lane there, and a lane of which the rectangle holds a strip but no point is absent;
* *gap*: towards the end of a lane its points stop up to 2 m short, and where lanes begin in one place only one
  of them keeps its first point;
* *fork*: for the same reason, of the lanes that begin in one place, the one that keeps the point seems to lead
  to the others, and what comes before seems to lead to that one alone;
* *heads*: a light is in range when one of its heads is, and a recording tells where its pole stands;
* *unexplained*: none of these. There should be none.

What of CARLASGG's is a defect, and not imitated, is counted below.
"""

from __future__ import annotations

import argparse
import gzip
import json
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from sgstore.config import preset
from sgstore.ingest import read_map_file
from sgstore.opendrive import read_map
from sgstore.relations.pairs import IS_VEHICLE
from sgstore.relations.scene import IS_SIGNAL
from sgstore.sgg import SceneGraphGenerator, map_of_graphs
from sgstore.traces import open_trace
from sgstore.vocabulary import DIRECTIONS, KIND_CODE, KINDS, PROXIMITY, RELATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.config import Config
    from sgstore.graph import GraphBlock

Edge = tuple[str, str, str]

CONFIG = preset("carlasgg")
BEARINGS = (0.0, 45.0, 90.0, 135.0, 180.0)
SPACING, HALF_BOX = 1.0, 1.0
"""CARLASGG's distance of points along a lane, and half the length of the box around each; m."""
REACH_OF_HEADS = 8.0
"""How far over the road the arm of a traffic light may carry its heads; m."""
FLOAT32 = 2e-4
"""How exact positions are some hundred metres from the origin, rotated and subtracted as float32; m."""


@dataclass
class Row:
    """A line of the comparison.

    Attributes
    ----------
    name : str
    equal, of : int
        How many of how many are equal.
    causes : Counter
        What the others are.
    """

    name: str
    equal: int = 0
    of: int = 0
    causes: Counter[str] = field(default_factory=Counter)

    @property
    def share(self) -> float:
        return self.equal / self.of if self.of else 1.0

    def add(self, ours: set[Any], theirs: set[Any]) -> Iterator[tuple[Any, bool]]:
        """Count what two sets have in common; give what only one has, and whether that is ours."""
        self.equal += len(ours & theirs)
        self.of += len(ours | theirs)
        yield from ((one, True) for one in sorted(ours - theirs))
        yield from ((one, False) for one in sorted(theirs - ours))

    def __str__(self) -> str:
        causes = ", ".join(f"{n} {cause}" for cause, n in self.causes.most_common())
        return (
            f"{self.name:44} {self.equal:>7,} of {self.of:>7,} {100 * self.share:8.2f} %  {causes}"
        )


class Points(NamedTuple):
    """Points along a lane, CARLASGG's boxes around them, and whether it surely has points there."""

    places: Any
    boxes: Any
    sure: Any


@dataclass
class View:
    """A frame of either side, in names: entities by actor id, lanes as ``road_lane``."""

    entities: set[str] = field(default_factory=set)
    lights: set[str] = field(default_factory=set)
    signals: set[str] = field(default_factory=set)
    lanes: set[str] = field(default_factory=set)
    edges: set[Edge] = field(default_factory=set)
    box: dict[str, tuple[float, ...]] = field(default_factory=dict)
    ego: str = ""

    def among(self, *relations: str, entities: bool) -> set[Edge]:
        """Edges between two entities, or between two lanes."""
        ends = self.entities if entities else self.lanes
        return {e for e in self.edges if e[1] in relations and e[0] in ends and e[2] in ends}

    def lanes_in(self, entity: str) -> set[str]:
        return {d for s, r, d in self.edges if r == "isIn" and s == entity and d in self.lanes}


def theirs(line: str) -> View:
    """A frame as CARLASGG has it: of entities, what moves (vehicles and people)."""
    frame = json.loads(line)
    view, names = View(), {}
    for node in frame["nodes"]:
        ident, kind = node["attr"].get("entity_id"), node["base_class"]
        name = node["name"]
        if kind == "ego" or (kind in KIND_CODE and ident is not None and int(ident) >= 0):
            name = str(ident)
            moves = kind in {"ego", "person"} or IS_VEHICLE[KIND_CODE[kind]]
            view.entities |= {name} if moves else set()
            view.ego = name if kind == "ego" else view.ego
        elif match := re.fullmatch(r"Lane (\S+)_([+-])(\d+)", name):
            name = f"{match[1]}_{int(match[2] + match[3])}"
            view.lanes.add(name)
        elif kind == "traffic_light":
            name = placed(node["attr"]["vertex"][0], -node["attr"]["vertex"][1])
            view.lights.add(name)
        elif str(kind).startswith("landmark"):
            name = f"signal {node['attr']['landmark_id']}"
            view.signals.add(name)
        names[node["i"]] = name
    view.edges = {(names[s], label, names[d]) for s, d, label in frame["edges"]}
    return view


def placed(x: float, y: float) -> str:
    return f"light {x:.1f} {y:.1f}"


class Ours:
    """Our graphs of a recording, frame by frame, in CARLASGG's names."""

    def __init__(self, trace: Path, road_map: Path | None, config: Config = CONFIG) -> None:
        self._open = open_trace(trace)
        info = self._open.info
        given = None if road_map is None else read_map_file(road_map)
        self.road_map = read_map(info.map_text, info.map_name) if given is None else given
        self._generator = SceneGraphGenerator(self.road_map, config)
        self._shown = map_of_graphs(self.road_map, config) or self.road_map
        self._idents: list[str] = []
        self._place: dict[str, str] = {}
        self._signal: dict[str, str] = {}
        nodes, lane = self.road_map.nodes, KIND_CODE["lane"]
        self._names = [
            f"{road}_{number}"
            if kind == lane
            else f"signal {name}"
            if IS_SIGNAL[kind]
            else f"{KINDS[kind]} {name}"
            for kind, name, road, number in zip(
                nodes.kind.tolist(), nodes.name, nodes.road, nodes.lane.tolist(), strict=True
            )
        ]
        self._names[0] = "Off Road"

    def views(self) -> Iterator[View]:
        with self._open as trace:
            for block in trace.blocks(60):
                self._idents += block.entities.ident
                refs = zip(block.entities.ident, block.entities.map_ref, strict=True)
                self._signal |= {ident: f"signal {ref}" for ident, ref in refs if ref}
                graph = self._generator.block(block)
                yield from (self._view(graph, frame) for frame in range(len(graph)))

    def controlled(self, signal: str) -> set[str]:
        """Lanes that a signal of the map controls."""
        nodes = self.road_map.lanes_of_signal(signal.removeprefix("signal "))
        return {self._names[-1 - node] for node in nodes.tolist()}

    def is_light(self, signal: str) -> bool:
        """Whether a signal of the map is a traffic light."""
        column = self._names.index(signal)
        return int(self.road_map.nodes.kind[column]) == KIND_CODE["traffic_light"]

    def _view(self, graph: GraphBlock, frame: int) -> View:
        frames, edges, of = graph.frames, graph.edges, self._shown.edges
        rows = np.arange(frames.offsets[frame], frames.offsets[frame + 1])
        states = frames.states.take(rows)
        view = View(ego=self._idents[frames.ego[frame]])
        for i, state in enumerate(states.light_state.tolist()):
            name = self._idents[states.node[i]]
            if state >= 0:
                view.lights.add(self._place.setdefault(name, placed(states.x[i], states.y[i])))
                continue
            view.entities.add(name)
            columns = ("x", "y", "z", "heading", "length", "width", "height")
            view.box[name] = tuple(float(getattr(states, column)[i]) for column in columns)
        there = graph.presence.node[graph.presence.frame == frame]
        present = np.zeros(len(self._names), np.bool_)
        present[-1 - there[there < 0]] = True
        lanes = np.flatnonzero(present & (self.road_map.nodes.kind == KIND_CODE["lane"]))
        view.lanes = {self._names[column] for column in lanes.tolist()}
        static = present[-1 - of.src] & present[-1 - of.dst]
        mine = edges.frame == frame
        for table, rows in ((edges, mine), (of, static)):
            columns = (
                table.src[rows].tolist(),
                table.relation[rows].tolist(),
                table.dst[rows].tolist(),
            )
            view.edges |= {
                (self._name(s, RELATIONS[r]), RELATIONS[r], self._name(d))
                for s, r, d in zip(*columns, strict=True)
            }
        view.signals = {s for s, r, _ in view.edges if r == "mayAffect"}
        return view

    def _name(self, node: int, relation: str = "") -> str:
        """An entity by its id, a light by its place, or as a signal of the map where it may affect lanes."""
        if node < 0:
            return self._names[-1 - node]
        ident = self._idents[node]
        return (self._signal if relation == "mayAffect" else self._place).get(ident, ident)


class Comparison:
    """CARLASGG's graphs of a recording beside ours.

    Attributes
    ----------
    rows : list of Row
    defects : Counter
        What CARLASGG gets wrong, and how often.
    """

    def __init__(self, trace: Path, oracle: Path, road_map: Path | None = None) -> None:
        self._ours = Ours(trace, road_map)
        self.road_map = self._ours.road_map
        names = (
            *("frames with equal entities", "distance relations of the ego"),
            *("front and rear of the ego", "left and right of the ego"),
            *("entities with equal lanes", "entities on or off the road", "lanes in range"),
            *("opposes, lanes in both", "left and right of lanes, lanes in both"),
            *("travelsTo, lanes in both", "traffic lights in range", "lanes that these control"),
            "mayAffect, signals and lanes in both",
        )
        self.rows = [Row(name) for name in names]
        self.defects: Counter[str] = Counter()
        with gzip.open(oracle / "junction_rsv.jsonl.gz", "rt", encoding="utf-8") as lines:
            for ours, line in zip(self._ours.views(), lines, strict=True):
                peer = theirs(line)
                self._compare(ours, peer)
                self._compare_lights(ours, peer)
                self._count_defects(ours, peer)

    def row(self, beginning: str) -> Row:
        return next(row for row in self.rows if row.name.startswith(beginning))

    def _compare(self, ours: View, peer: View) -> None:
        entities, near, front, side, lanes, off_road, present, opposes, beside, flow = self.rows[
            :10
        ]
        entities.of += 1
        entities.equal += ours.entities == peer.entities
        if ours.entities != peer.entities:
            entities.causes["unexplained"] += 1
        for row, relations, causes in (
            (near, PROXIMITY, self._at_distance),
            (front, DIRECTIONS, self._at_bearing),
            (side, ("toLeftOf", "toRightOf"), self._at_axis),
        ):
            both = (view.among(*relations, entities=True) for view in (ours, peer))
            for edge, _ in row.add(*both):
                row.causes[causes(ours, edge)] += 1
        for entity in sorted(ours.entities & peer.entities):
            self._compare_lanes(lanes, ours, peer, entity)
            mine, other = ((entity, "isIn", "Off Road") in view.edges for view in (ours, peer))
            off_road.of += 1
            off_road.equal += mine == other
            if mine != other:
                inside = ours.lanes_in(entity) or peer.lanes_in(entity)
                off_road.causes["as its lanes" if inside else "unexplained"] += 1
        for lane, mine in present.add(ours.lanes, peer.lanes):
            present.causes[self._at_edge(ours, lane, mine=mine)] += 1
        common = ours.lanes & peer.lanes
        for row, relations in (
            (opposes, ("opposes",)),
            (beside, ("toLeftOf", "toRightOf")),
            (flow, ("travelsTo",)),
        ):
            both = (
                {e for e in view.among(*relations, entities=False) if {e[0], e[2]} <= common}
                for view in (ours, peer)
            )
            for edge, mine in row.add(*both):
                row.causes[self._why_lanes(ours, edge, mine=mine)] += 1

    def _compare_lights(self, ours: View, peer: View) -> None:
        lights, control, affect = self.rows[10:]
        for light, _ in lights.add(ours.lights, peer.lights):
            pole = shapely.Point(*map(float, light.split()[1:]))
            near = self._rectangle(ours).exterior.distance(pole) <= REACH_OF_HEADS
            lights.causes["heads" if near else "unexplained"] += 1
        both = (
            {e for e in v.edges if e[1] == "controlsTrafficOf" and e[0] in v.lights}
            for v in (ours, peer)
        )
        for edge, mine in control.add(*both):
            lanes = {e[2] for e in ours.edges if e[:2] == edge[:2]} - {edge[2]}
            start = self._points[edge[2]].places[0]
            if mine and not shapely.intersects(self._rectangle(ours, -SPACING), start):
                control.causes["range cut"] += 1
            else:
                fork = any(self._start_together(edge[2], lane) for lane in lanes)
                control.causes["fork" if mine and fork else "unexplained"] += 1

        common = (ours.lanes & peer.lanes) | (ours.signals & peer.signals)
        both = (
            {e for e in v.edges if e[1] == "mayAffect" and {e[0], e[2]} <= common}
            for v in (ours, peer)
        )
        for edge, mine in affect.add(*both):
            affect.causes[self._why_affected(ours, edge, mine=mine)] += 1

    def _why_affected(self, view: View, edge: Edge, *, mine: bool) -> str:
        """A signal at the very start of a lane is ahead of no point of it, if another lane keeps the first."""
        lanes = self._ours.controlled(edge[0]) & set(self._points)
        twins = [lane for lane in lanes | view.lanes if lane != edge[2]]
        fork = any(self._start_together(edge[2], lane) for lane in twins)
        return "fork" if mine and fork and edge[2] in lanes else "unexplained"

    def _count_defects(self, ours: View, peer: View) -> None:
        found = self.defects
        for name, view in (("CARLASGG", peer), ("sgstore", ours)):
            changes = sum(relation == "laneChange" for _, relation, _ in view.edges)
            found[f"lane changes, {name}"] += changes
        lights = {signal for signal in peer.signals if self._ours.is_light(signal)}
        found["traffic lights that are there a second time, as landmarks"] += len(lights)
        nowhere = {s for s, r, d in peer.edges if d == "Off Road" and s not in peer.entities}
        found["lights and signs that are 'Off Road' for lack of an edge"] += len(nowhere)

    def _compare_lanes(self, row: Row, ours: View, peer: View, entity: str) -> None:
        mine, other = ours.lanes_in(entity), peer.lanes_in(entity)
        row.of += 1
        row.equal += mine == other
        if mine != other:
            causes = {self._at_edge(ours, lane, mine=True, entity=entity) for lane in mine - other}
            causes |= {
                self._at_edge(ours, lane, mine=False, entity=entity) for lane in other - mine
            }
            row.causes[
                "unexplained" if "unexplained" in causes else " and ".join(sorted(causes))
            ] += 1

    # Causes ---------------------------------------------------------------------------------

    def _pair(self, view: View, edge: Edge) -> tuple[float, float, float]:
        """Of the source, seen from the destination: distance of origins, bearing (°), distance off the axis."""
        (bx, by, bz, *_, bh), (ax, ay, az, heading, *_, ah) = view.box[edge[0]], view.box[edge[2]]
        people = {
            name
            for name in (edge[0], edge[2])
            if view.box[name][4] < 1.0 and view.box[name][5] < 1.0
        }
        bz -= 0 if edge[0] in people else bh / 2
        az -= 0 if edge[2] in people else ah / 2
        distance = float(np.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2))
        bearing = np.degrees(np.arctan2(by - ay, bx - ax) - heading)
        bearing = float((bearing + 180) % 360 - 180)
        return distance, bearing, float(np.hypot(bx - ax, by - ay) * np.sin(np.radians(bearing)))

    def _at_distance(self, view: View, edge: Edge) -> str:
        distance = self._pair(view, edge)[0]
        tie = min(abs(distance - bound) for bound in CONFIG.proximity.upper) < FLOAT32
        return "tie" if tie else "unexplained"

    def _at_bearing(self, view: View, edge: Edge) -> str:
        distance, bearing, _ = self._pair(view, edge)
        off = min(abs(abs(bearing) - bound) for bound in BEARINGS)
        tie = (
            np.radians(off) * distance < FLOAT32
            or abs(distance - CONFIG.pairs.ego_within) < FLOAT32
        )
        return "tie" if tie else "unexplained"

    def _at_axis(self, view: View, edge: Edge) -> str:
        distance, _, off_axis = self._pair(view, edge)
        if abs(distance - CONFIG.pairs.ego_within) < FLOAT32:
            return "tie"
        return "dead ahead or behind" if abs(off_axis) < 1e-3 + FLOAT32 else "unexplained"

    @cached_property
    def _points(self) -> dict[str, Points]:
        """Points of each lane and CARLASGG's boxes around them, close to one another."""
        points, lengths = self.road_map.waypoints(SPACING / 4), self.road_map.ribbons.lengths
        ahead = np.stack([np.cos(points.heading), np.sin(points.heading)], axis=1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * (points.width / 2)[:, None]
        centre = np.stack([points.x, points.y], axis=1)
        ahead *= HALF_BOX
        corners = [centre + a * ahead + b * left for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        boxes, places = shapely.polygons(np.stack(corners, axis=1)), shapely.points(centre)
        sure = points.along >= SPACING
        sure &= points.along <= lengths[points.lane] - 2 * SPACING
        rows: dict[str, list[int]] = {}
        nodes = self.road_map.nodes
        for row, lane in enumerate(points.lane.tolist()):
            rows.setdefault(f"{nodes.road[1 + lane]}_{nodes.lane[1 + lane]}", []).append(row)
        return {name: Points(places[of], boxes[of], sure[of]) for name, of in rows.items()}

    def _rectangle(self, view: View, margin: float = 0.0) -> Any:
        x, y, _, heading, *_ = view.box[view.ego]
        of = CONFIG.range
        at = shapely.box(-of.rear - margin, -of.side - margin, of.front + margin, of.side + margin)
        turned = shapely.affinity.rotate(at, heading, (0, 0), use_radians=True)
        return shapely.affinity.translate(turned, x, y)

    def _at_edge(self, view: View, lane: str, *, mine: bool, entity: str = "") -> str:
        """Why only one side has a lane: in range, or under an entity.

        Points every quarter of a metre are all that CARLASGG can have; those every metre are some of them. So
        what only CARLASGG has is explained by any, and what only we have by the lack of points over a metre.
        """
        places, boxes, sure = self._points[lane]
        under = np.ones(len(places), np.bool_)
        if entity:
            under = shapely.intersects(boxes, self._footprint(view, entity))
        if not mine:
            reached = shapely.intersects(self._rectangle(view, FLOAT32), places[under]).any()
            return "overhang" if reached else "unexplained"
        inside = shapely.intersects(self._rectangle(view), places[under])
        if (inside & sure[under]).sum() > SPACING / (SPACING / 4):
            return "unexplained"
        return "gap" if inside.all() else "range cut"

    def _footprint(self, view: View, entity: str) -> Any:
        x, y, _, heading, length, width, _ = view.box[entity]
        shape = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
        shape = shapely.affinity.rotate(shape, heading, (0, 0), use_radians=True)
        return shapely.affinity.translate(shape, x, y)

    def _why_lanes(self, view: View, edge: Edge, *, mine: bool) -> str:
        if edge[1] != "travelsTo":
            return "unexplained"
        if mine:
            end = self._points[edge[0]].places[-1]
            if not shapely.intersects(self._rectangle(view, -2 * SPACING), end):
                return "range cut"
            twins = [lane for lane in view.lanes - {edge[2]} if self._start_together(lane, edge[2])]
            return "fork" if twins else "unexplained"
        return "fork" if self._start_together(edge[0], edge[2]) else "unexplained"

    def _start_together(self, one: str, other: str) -> bool:
        return shapely.distance(self._points[one].places[0], self._points[other].places[0]) < 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description="The preset carlasgg beside CARLASGG itself.")
    parser.add_argument("trace", type=Path)
    parser.add_argument("oracle", type=Path)
    parser.add_argument("--map", type=Path, default=None)
    given = parser.parse_args()
    comparison = Comparison(given.trace, given.oracle, given.map)
    for row in comparison.rows:
        print(row)
    print("\nDefects of CARLASGG, counted and not imitated")
    for name, count in comparison.defects.items():
        print(f"{name:60} {count:>7,}")


if __name__ == "__main__":
    main()
