"""Small scenes in the words of the domain: things with names on a sheet of paper.

::

    ego, ahead = thing("ego"), thing("c1", x=12)
    graph = graph_of(frames([ego, ahead]))
    assert ("c1", "near", "ego") in edges(graph)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
import shapely.affinity

from sgstore.base.geometry import wrapped
from sgstore.graphs.online import Frame
from sgstore.maps.roads import (
    LaneCourses,
    LaneHits,
    MapEdges,
    MapNodes,
    MapPlaces,
    Ribbons,
    RoadMap,
)
from sgstore.maps.roads._map import STOREY
from sgstore.model.config import Config
from sgstore.model.vocabulary import KIND_CODE, RELATION_CODE, RELATIONS
from sgstore.model.world import Entities, Floats, FrameBlock, Ints, MessageRefs, States
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from sgstore.model.graph import GraphBlock

NO_MESSAGES = MessageRefs(*(np.zeros(0, np.int64) for _ in range(5)))


@dataclass(frozen=True)
class Place:
    """Where a world has been moved to, after it was turned about the origin."""

    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    z: float = 0.0

    def placed(self, shape: Any) -> Any:
        turned = shapely.affinity.rotate(shape, self.turn, (0, 0), use_radians=True)
        return shapely.affinity.translate(turned, self.x, self.y)


@dataclass(frozen=True)
class Thing:
    """An entity in one frame; the name is its id in the trace."""

    name: str
    kind: str = "car"
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    z: float = 0.75
    length: float = 4.0
    width: float = 2.0
    height: float = 1.5
    vx: float = 0.0
    vy: float = 0.0
    map_ref: str = ""
    static: bool = False

    def moved(self, to: Place) -> Thing:
        """The same thing in a world that was turned and moved."""
        cos, sin = np.cos(to.turn), np.sin(to.turn)
        return replace(
            self,
            x=to.x + self.x * cos - self.y * sin,
            y=to.y + self.x * sin + self.y * cos,
            z=to.z + self.z,
            heading=self.heading + to.turn,
        )


def thing(name: str, x: float = 0.0, y: float = 0.0, heading: float = 0.0, **other: Any) -> Thing:
    return Thing(name, x=x, y=y, heading=heading, **other)


@dataclass
class Recording:
    """Frames of things as blocks, with node ids that last from block to block."""

    ego: str = "ego"
    names: list[str] = field(default_factory=list)
    seq: int = 0

    def block(self, *frames: list[Thing]) -> FrameBlock:
        """The next frames. Static things become scenery, from this block on."""
        everything = {t.name: t for frame in frames for t in frame}
        new = [t for name, t in everything.items() if name not in self.names]
        first = len(self.names)
        self.names += [t.name for t in new]
        moving = [[t for t in frame if not t.static] for frame in frames]
        seq = self.seq + np.arange(len(frames))
        self.seq += len(frames)
        node = self.names.index(self.ego) if self.ego in self.names else -1
        return FrameBlock(
            seq=seq,
            time_ns=seq * 100_000_000,
            log_time_ns=seq * 100_000_000,
            offsets=np.cumsum([0, *map(len, moving)]),
            states=self.states([t for frame in moving for t in frame]),
            ego=np.array([node if self.ego in {t.name for t in f} else -1 for f in frames], int),
            entities=Entities(
                first=first,
                ident=tuple(t.name for t in new),
                kind=np.array([KIND_CODE[t.kind] for t in new], np.int8),
                special=("",) * len(new),
                subkind=("",) * len(new),
                type_name=("",) * len(new),
                static=np.array([t.static for t in new], np.bool_),
                map_ref=tuple(t.map_ref for t in new),
            ),
            scenery=self.states([t for t in new if t.static]),
            messages=NO_MESSAGES,
        )

    def states(self, things: list[Thing]) -> States:
        columns = {
            name: np.array([getattr(t, name) for t in things], float)
            for name in ("x", "y", "z", "heading", "length", "width", "height", "vx", "vy")
        }
        node = np.array([self.names.index(t.name) for t in things], np.int64)
        return States.of(node=node, **columns)


def frames(*of: list[Thing], ego: str = "ego") -> FrameBlock:
    """One block of frames."""
    return Recording(ego).block(*of)


def frame_of(*things: Thing, ego: str | None = "ego", time_ns: int = 0) -> Frame:
    """The same things as a frame for a graph online."""
    frame = Frame(time_ns, ego)
    for of in things:
        frame.add(
            *(of.name, of.kind, of.x, of.y, of.z),
            heading=math.degrees(of.heading),
            length=of.length,
            width=of.width,
            height=of.height,
            vx=of.vx,
            vy=of.vy,
            static=of.static,
            map_ref=of.map_ref,
        )
    return frame


def graph_of(
    block: FrameBlock, road_map: RoadMap | None = None, config: Config | None = None
) -> GraphBlock:
    return SceneGraphGenerator(road_map, config or Config()).block(block)


Edge = tuple[str, str, str]


def edges(
    graph: GraphBlock,
    frame: int = 0,
    road_map: RoadMap | None = None,
    names: list[str] | None = None,
) -> list[Edge]:
    """The edges of a frame, sorted, with names for node ids (``names``: of a recording with several blocks)."""
    entities = names or graph.frames.entities.ident

    def name(node: int) -> str:
        return entities[node] if node >= 0 else road_map.nodes.name[-1 - node] if road_map else "?"

    of = graph.edges
    rows = np.flatnonzero(of.frame == frame)
    columns = (of.src[rows].tolist(), of.relation[rows].tolist(), of.dst[rows].tolist())
    return sorted((name(s), RELATIONS[r], name(d)) for s, r, d in zip(*columns, strict=True))


def present(graph: GraphBlock, frame: int = 0) -> set[int]:
    """Node ids of the static nodes of a frame."""
    return set(graph.presence.node[graph.presence.frame == frame].tolist())


@dataclass(frozen=True)
class Patch:
    """A rectangle of a paper map: a lane, unless ``crosswalk``; or the ground that a signal stands on.

    ``to``: the lanes that ``travelsTo`` leads to; they need not touch.
    """

    name: str
    x0: float
    y0: float
    x1: float
    y1: float
    kind: str = "lane"
    lane_type: str = "driving"
    z: float = 0.0
    road: str = ""
    junction: str = ""
    controlled_by: str = ""
    to: tuple[str, ...] = ()


class PaperMap(RoadMap):
    """A map of rectangles, turned about the origin and moved. It answers by trying every patch with shapely.

    Lanes run along +x of the paper. ``asked`` counts the footprints that it was asked about.
    """

    def __init__(
        self, *patches: Patch, objects: tuple[tuple[str, str], ...] = (), at: Place = Place()
    ) -> None:
        self.name, self.text, self.digest, self.warnings = "paper", "", "paper", ()
        self.own = {}
        roads = list(dict.fromkeys(p.road for p in patches if p.road))
        junctions = list(dict.fromkeys(p.junction for p in patches if p.junction))
        kinds = ["off_road", *(p.kind for p in patches)]
        kinds += ["road"] * len(roads) + ["junction"] * len(junctions) + [k for _, k in objects]
        names = ("off_road", *(p.name for p in patches), *roads, *junctions)
        names += tuple(name for name, _ in objects)
        self.ids = {name: -1 - i for i, name in enumerate(names)}
        self.patches, self.objects, self.at = patches, objects, at
        self.shapes = {p.name: at.placed(shapely.box(p.x0, p.y0, p.x1, p.y1)) for p in patches}
        self.nodes = _map_nodes(names, kinds, patches)
        links = [("isIn", p.name, p.road) for p in patches if p.road]
        links += dict.fromkeys(("isIn", p.road, p.junction) for p in patches if p.junction)
        links += [("travelsTo", p.name, other) for p in patches for other in p.to]
        links += [
            ("controlsTrafficOf", p.controlled_by, p.name)
            for p in patches
            if p.controlled_by in dict(objects)
        ]
        self.edges = MapEdges(
            relation=np.array([RELATION_CODE[name] for name, _, _ in links], np.int8),
            src=np.array([self.ids[a] for _, a, _ in links], np.int64),
            dst=np.array([self.ids[b] for _, _, b in links], np.int64),
        )
        lanes = [p for p in patches if p.kind == "lane"]
        self.ribbons = _ribbons(lanes, at)
        self._lanes, self.variant, self._ways = len(lanes), "", None
        self.courses = LaneCourses.none()
        self.places = MapPlaces.none()  # along its lanes; a map that was read has them
        self.asked = 0
        self.__dict__["_outlines"] = np.array([None, *self.shapes.values()], object)

    def moved(self, at: Place) -> PaperMap:
        """The same map somewhere else."""
        return PaperMap(*self.patches, objects=self.objects, at=at)

    def touched(self, box: Floats, z: float, kind: str) -> list[tuple[Patch, Any]]:
        """Patches of a kind that a footprint meets on its storey, and the footprint."""
        x, y, heading, length, width = np.where(np.isnan(box), [np.nan, np.nan, 0, 0, 0], box)
        if np.isnan(x + y):
            return []
        around = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
        shape = Place(x, y, heading).placed(around)
        return [
            (p, shape)
            for p in self.patches
            if p.kind == kind
            and (np.isnan(z) or abs(z - p.z - self.at.z) <= STOREY)
            and shape.intersects(self.shapes[p.name])
        ]

    def lanes_of(self, boxes: Floats, z: Floats) -> LaneHits:
        self.asked += len(boxes)
        hits = [(i, *hit) for i in range(len(z)) for hit in self.touched(boxes[i], z[i], "lane")]
        rows = np.array([row for row, _, _ in hits], np.int64)
        shares = [_share(shape, self.shapes[patch.name]) for _, patch, shape in hits]
        middles = [self.shapes[patch.name].centroid for _, patch, _ in hits]
        sin, cos = np.sin(self.at.turn), np.cos(self.at.turn)
        aside = [
            (boxes[row, 1] - middle.y) * cos - (boxes[row, 0] - middle.x) * sin
            for row, middle in zip(rows, middles, strict=True)
        ]
        return LaneHits(
            row=rows,
            lane=np.array([self.ids[p.name] for _, p, _ in hits], np.int64),
            overlap=np.array(shares, float),
            offset=np.array(aside, float),
            heading_error=wrapped(np.nan_to_num(boxes[rows, 2]) - self.at.turn),
            primary=np.append(True, rows[1:] != rows[:-1])[: len(rows)],
        )

    def crosswalks_of(self, boxes: Floats, z: Floats) -> tuple[Ints, Ints]:
        hits = [
            (i, self.ids[p.name])
            for i in range(len(z))
            for p, _ in self.touched(boxes[i], z[i], "crosswalk")
        ]
        rows, nodes = np.array(hits, np.int64).reshape(-1, 2).T
        return rows, nodes

    def near(self, x: Floats, y: Floats, radius: float) -> tuple[Ints, Ints]:
        hits: list[tuple[int, int]] = []
        for row in range(len(x)):
            around = {
                name
                for p in self.patches
                if self.shapes[p.name].distance(shapely.Point(x[row], y[row])) <= radius
                for name in (p.name, p.road, p.junction)
                if name
            }
            around.update(name for name, _ in self.objects)
            hits += [(row, self.ids[name]) for name in sorted(around)]
        rows, nodes = np.array(hits, np.int64).reshape(-1, 2).T
        return rows, nodes

    def lanes_of_signal(self, signal: str) -> Ints:
        lanes = [self.ids[p.name] for p in self.patches if signal and p.controlled_by == signal]
        return np.array(lanes, np.int64)


def _ribbons(lanes: list[Patch], at: Place) -> Ribbons:
    """Two cross sections a lane, at its ends."""
    x = np.array([(p.x0, p.x1) for p in lanes]).ravel()
    left, right = (
        np.array([(p.y1, p.y1, p.y0, p.y0) for p in lanes]).reshape(-1, 2, 2).swapaxes(0, 1)
    )
    cos, sin = np.cos(at.turn), np.sin(at.turn)
    count = len(lanes)
    along = np.array([(0.0, p.x1 - p.x0) for p in lanes]).ravel()
    return Ribbons(
        offsets=2 * np.arange(count + 1),
        left_x=at.x + x * cos - left.ravel() * sin,
        left_y=at.y + x * sin + left.ravel() * cos,
        right_x=at.x + x * cos - right.ravel() * sin,
        right_y=at.y + x * sin + right.ravel() * cos,
        z=np.repeat([p.z + at.z for p in lanes], 2),
        heading=np.full(2 * count, at.turn),
        s=along,
        along=along,
    )


def _map_nodes(names: tuple[str, ...], kinds: list[str], patches: tuple[Patch, ...]) -> MapNodes:
    count = len(names)
    types = {p.name: p.lane_type for p in patches if p.kind == "lane"}
    junctions = {p.name: p.junction for p in patches if p.kind == "lane"}
    widths = {p.name: p.y1 - p.y0 for p in patches}
    missing = np.full(count, np.nan)
    blank, none = ("",) * count, np.zeros(count, np.int64)
    return MapNodes(
        kind=np.array([KIND_CODE[kind] for kind in kinds], np.int8),
        name=names,
        x=np.zeros(count),
        y=np.zeros(count),
        z=np.zeros(count),
        heading=np.zeros(count),
        lane_type=tuple(types.get(name, "") for name in names),
        road=blank,
        junction=tuple(junctions.get(name, "") for name in names),
        turn=blank,
        section=none,
        lane=none,
        length=missing,
        width=np.array([widths.get(name, np.nan) for name in names]),
        speed_limit=missing,
        curvature=missing,
    )


def _share(shape: Any, lane: Any) -> float:
    return shape.intersection(lane).area / shape.area if shape.area else 1.0
