"""How far it is along the lanes, and how they run: ``python oracle_constructs.py 5000 lane_dist``.

Cars stand anywhere on the lanes of a town. ``lane_dist`` from car to car and to parts of the map, the next
junction, light and the like, curvature and slope are asked of a store, of its graphs in memory, and of a
monitor that sees these. By definition every way is tried from where a car stands, by Dijkstra; lanes are cut
into metres, and heights are those of the file.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest
from builders import Recording
from graph_blocks import trace_info
from test_lane_courses import by_elevation, by_its_points
from test_lane_dist import FARTHEST, lane_ways
from test_lane_places import PARTS, SORTS, columns_of, stretches, town, traffic

from sgstore.lang.memory import FrameView
from sgstore.model.config import Config
from sgstore.model.world import TraceReport
from sgstore.query import Store
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph

    Place = tuple[int, float]

TOWNS = ("Town07", "multi_intersections", "Town01", "fabriksgatan")
DATA = Path(os.environ.get("SGSTORE_DATA", Path(__file__).parents[3] / "shared/data"))
COURSES = ("curvature", "slope")
NEXT = tuple(f"to_{sort}" for sort in SORTS)
ROWS = ("lane_dist", "next places", "curvature, slope", "lane_dist of parts")


@cache
def known(name: str) -> tuple[RoadMap, Any, dict[str, list[tuple[int, float, float]]]]:
    """A town, its lanes as ways, and where things of each sort lie on lanes."""
    road_map = town(DATA, name)
    places: dict[str, list[tuple[int, float, float]]] = {sort: [] for sort in SORTS}
    for what, lane, start, end in zip(road_map.places.what, *columns_of(road_map), strict=True):
        places.setdefault(what, []).append((lane, start, end))
    return road_map, lane_ways(road_map), places


class Around:
    """What is reached from a place by driving on."""

    def __init__(self, ways: Any, place: Place) -> None:
        self.lane, self.along = place
        length = ways.edges[(self.lane, "start"), (self.lane, "end")]["weight"]
        self.rest = length - self.along
        self.far = nx.single_source_dijkstra_path_length(ways, (self.lane, "end"), cutoff=FARTHEST)

    def to(self, lane: int, along: float) -> float:
        if lane == self.lane and along >= self.along:
            return along - self.along
        return self.rest + self.far.get((lane, "start"), math.inf) + along


@cache
def stretches_of(name: str) -> dict[int, list[tuple[int, float, float]]]:
    return stretches(known(name)[0])


@cache
def around(name: str, lane: int, along: float) -> Around:
    return Around(known(name)[1], (lane, along))


def tried(number: int) -> Counter[str]:
    """Ask of the traffic of a number; how many cases there were."""
    name = TOWNS[number % len(TOWNS)]
    road_map, _, _ = known(name)
    with tempfile.TemporaryDirectory() as folder:
        file = StoreFile.create(Path(folder) / "s.db")
        block = Recording().block(*traffic(road_map, number))
        answers = ("isIn", "controlsTrafficOf", "travelsTo")
        with file.segment(trace_info(), Config(), road_map=road_map, answers=answers) as segment:
            segment.append(SceneGraphGenerator(road_map, Config()).block(block))
            file.publish(segment.seal(TraceReport(frames=4)))
        store = Store(file.path)
        with store.file.snapshot():
            return compared(store, name)


def compared(store: Store, name: str) -> Counter[str]:
    seen = Counter[str]()
    of_one = [f"{name}(v)" for name in (*NEXT, *COURSES)]
    one = f"MATCH (v:Car) RETURN frame.id, v.id, {', '.join(of_one)}"
    two = "MATCH (v:Car), (w:Car) RETURN frame.id, v.id, w.id, lane_dist(v, w)"
    alone = {tuple(row[:2]): tuple(row[2:]) for row in store.find(one).rows()}
    pairs = {tuple(row[:3]): row[3] for row in store.find(two).rows()}
    seen["tried"] += 2
    parts = {
        label: {
            tuple(row[:3]): row[3]
            for row in store.find(
                f"MATCH (v:Car), (p:{label}) RETURN frame.id, v.id, p.id, lane_dist(v, p)"
            )
        }
        for label in PARTS
    }
    seen["tried"] += len(PARTS)
    over = [f"FIRST({value}) OVER match" for value in of_one]
    online = f"MATCH (v:Car) RETURN {', '.join(over)};"
    online += "MATCH (v:Car), (w:Car) RETURN FIRST(lane_dist(v, w)) OVER match;"
    online += ";".join(
        f"MATCH (v:Car), (p:{label}) RETURN FIRST(lane_dist(v, p)) OVER match" for label in PARTS
    )
    for frame in sorted({frame for frame, _ in alone}):
        graph = store.file.graph(frame)
        view = FrameView(graph)
        events: list[Any] = []
        monitor = Monitor(online, period_s=0.1, on_event=events.append)
        monitor.look([graph])
        monitor.finish()
        told = {
            tuple(e.nodes[n] for n in "vwp" if n in e.nodes): tuple(e.values.values())
            for e in events
        }
        wanted = Defined(graph, name)
        for node in [node for at, node in alone if at == frame]:
            found, memory = (
                alone[frame, node],
                tuple(view.pair(one, node, node) for one in (*NEXT, *COURSES)),
            )
            assert found == memory == told[node,], (name, frame, node, found, memory, told[node,])
            for value, which in zip(found, (*SORTS, *COURSES), strict=True):
                expected = (
                    wanted.course(node, which) if which in COURSES else wanted.next(node, which)
                )
                same(value, expected, (name, frame, node, which))
                seen[ROWS[2 if which in COURSES else 1]] += 1
                seen[f"{ROWS[2 if which in COURSES else 1]} with rows"] += value is not None
        for _, a, b in [key for key in pairs if key[0] == frame]:
            far = pairs[frame, a, b]
            assert far == view.pair("lane_dist", a, b) == told[a, b][0], (name, frame, a, b, far)
            same(far, wanted.between(a, b), (name, frame, a, b))
            seen["lane_dist"] += 1
            seen["lane_dist with rows"] += far is not None
        for label, rows in parts.items():
            name_of_it = "lane_dist" if label in SIGNALS_OF_MAP else "part_dist"
            for _, v, p in [key for key in rows if key[0] == frame]:
                far, about = rows[frame, v, p], (name, frame, v, label, p)
                assert far == view.pair(name_of_it, v, p) == told[v, p][0], (about, far)
                same(far, wanted.part(v, p), about)
                seen[ROWS[3]] += 1
                seen[f"{ROWS[3]} with rows"] += far is not None
    return seen


SIGNALS_OF_MAP = {"TrafficLight", "StopSign", "Sign", "YieldSign"}


def same(found: float | None, wanted: float | None, about: Any) -> None:
    if wanted is not None and abs(abs(wanted) - FARTHEST) < 1e-6:
        return  # at the end of what is looked at, either is right
    assert found == (None if wanted is None else pytest.approx(wanted, abs=2e-6)), (
        about,
        found,
        wanted,
    )


class Defined:
    """The definitions, of the cars of a graph."""

    def __init__(self, graph: SceneGraph, name: str) -> None:
        self.name = name
        self.map, ways, self.places = known(name)
        own = graph.places()
        self.own = {node: [Around(ways, (-2 - n, at)) for n, at in own[node]] for node in own}
        self.idents = {node: about.get("ident", "") for node, about in graph.nodes.items()}
        self.lanes = {-2 - node for node in graph.nodes}
        self.primary = {
            src: (-2 - dst, about["along"])
            for src, relation, dst, about in graph.edges
            if relation == "isIn" and about.get("primary", about.get("is_primary"))
        }

    def next(self, node: int, sort: str) -> float | None:
        ways = [
            0.0 if lane == one.lane and start <= one.along <= end else one.to(lane, start)
            for one in self.own.get(node, [])
            for lane, start, end in self.places[sort]
        ]
        nearest = min(ways, default=math.inf)
        return nearest if nearest <= FARTHEST else None

    def between(self, a: int, b: int) -> float | None:
        here, there = self.own.get(a, []), self.own.get(b, [])
        ahead = min((one.to(o.lane, o.along) for one in here for o in there), default=math.inf)
        back = min((o.to(one.lane, one.along) for one in here for o in there), default=math.inf)
        nearest = ahead if ahead <= back else -back
        return nearest if abs(nearest) <= FARTHEST else None

    def part(self, node: int, part: int) -> float | None:
        """From an entity to a part of the map: to where it begins, or back to where it ended."""
        # A light that was recorded is that of the map after whose column it is called. Edges tie it to
        # lanes, so that only those of the graph count.
        column = -1 - part if part < 0 else int(self.idents[part].split()[1])
        there = [
            stretch
            for stretch in stretches_of(self.name).get(column, [])
            if part < 0 or stretch[0] in self.lanes
        ]
        here = self.own.get(node, [])
        if any(o.lane == lane and a <= o.along <= b for o in here for lane, a, b in there):
            return 0.0
        ahead = min((one.to(lane, a) for one in here for lane, a, _ in there), default=math.inf)
        ends = [around(self.name, lane, b) for lane, _, b in there] if here else []
        back = min((end.to(o.lane, o.along) for end in ends for o in here), default=math.inf)
        nearest = ahead if ahead <= back else -back
        return nearest if abs(nearest) <= FARTHEST else None

    def course(self, node: int, which: str) -> float | None:
        if node not in self.primary:
            return None
        lane, along = self.primary[node]
        if which == "slope":
            return by_elevation(DATA, self.map, lane, along)
        return by_its_points(self.map, lane, along)[0]
