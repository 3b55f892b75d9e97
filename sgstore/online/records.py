"""A block's graph of one frame as records: the same as a store gives of it, and each entity's own id."""

from __future__ import annotations

import math
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from sgstore.geometry import wrapped
from sgstore.graph import Reach, SceneGraph
from sgstore.vocabulary import KINDS, LIGHT_STATES, RELATION_CODE, RELATIONS, VEHICLE_LIGHTS
from sgstore.world import number

if TYPE_CHECKING:
    from sgstore.graph import GraphBlock
    from sgstore.roads import RoadMap
    from sgstore.world import Floats, Ints, States

    Attributes = dict[str, Any]
    Edge = tuple[int, str, int, Attributes]

TRACE: Final = "online"
"""What the graphs of the online mode have for the name of a trace."""

_IS_IN, _LEADS, _FOLLOWS = (RELATION_CODE[name] for name in ("isIn", "leads", "follows"))
_TELLS: Final = np.isin(np.arange(len(RELATIONS)), (_IS_IN, _LEADS, _FOLLOWS))
"""Of each relation whether its edges may have attributes."""
_BOX: Final = ("x", "y", "z", "length", "width", "height")
_MOTION: Final = ("vx", "vy", "vz", "ax", "ay", "az")
_INPUTS: Final = ("steer", "throttle", "brake")
_DERIVED: Final = ("derived_velocity", "derived_acceleration", "derived_yaw_rate")
_MAP_TEXTS: Final = ("name", "lane_type", "road", "junction", "turn")
_MAP_NUMBERS: Final = ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature")


class Known(NamedTuple):
    """What does not change about an entity."""

    node: int
    ident: str
    kind: str
    special: str
    subkind: str

    def attributes(self, *, is_ego: bool, is_static: bool) -> Attributes:
        """As they stand in a graph."""
        texts = {"special": self.special, "subkind": self.subkind}
        return {
            "kind": self.kind,
            "name": f"{self.kind} {self.node}",
            "ident": self.ident,
            "is_ego": is_ego,
            "is_static": is_static,
            **{name: text for name, text in texts.items() if text},
        }


class Records:
    """Makes records of graphs.

    Parameters
    ----------
    road_map : RoadMap or None
        The map that they lie on. What is known of its nodes is put together when they are first met.
    """

    def __init__(self, road_map: RoadMap | None) -> None:
        self._map = road_map
        self._reach = None if road_map is None else Reach(*road_map.reach)
        self._map_nodes: dict[int, Attributes] = {}
        self._standing: dict[int, Attributes] = {}
        if road_map is not None:
            edges = road_map.edges
            order = np.lexsort((-edges.dst, edges.relation, -edges.src))
            self._src, self._dst = edges.src[order], edges.dst[order]
            self._relation = [RELATIONS[code] for code in edges.relation[order].tolist()]

    def stand(self, known: Known, states: States, row: int) -> None:
        """Take note of what stands: its pose comes once."""
        numbers = {name: float(getattr(states, name)[row]) for name in _BOX}
        numbers["heading"] = _degrees(states.heading[row : row + 1])[0]
        about = known.attributes(is_ego=False, is_static=True)
        self._standing[known.node] = about | _numbers(numbers)

    def graph(self, graph: GraphBlock, outer: Ints, known: dict[int, Known]) -> SceneGraph:
        """The graph of a block's only frame.

        Parameters
        ----------
        graph : GraphBlock
            Of one frame.
        outer : int64
            Node id of the block → node id of the records; those of the map are the same.
        known : dict
            Node id of the records → entity, of all that move in the frame.
        """
        frames = graph.frames
        ego = int(outer[frames.ego[0]]) if frames.ego[0] >= 0 else None
        nodes: dict[int, Attributes] = {}
        moving = zip(outer[frames.states.node].tolist(), _moving(frames.states), strict=True)
        for node, told in sorted(moving, key=itemgetter(0)):
            about = known[node].attributes(is_ego=node == ego, is_static=False)
            nodes[node] = about | told
        present = graph.presence.node
        for node in np.sort(outer[present[present >= 0]]).tolist():
            nodes[node] = dict(self._standing[node])
        mapped = -np.sort(-present[present < 0])
        for node in mapped.tolist():
            nodes[node] = dict(self._map_node(node))
        return SceneGraph(
            frame_id=int(frames.seq[0]),
            trace=TRACE,
            seq=int(frames.seq[0]),
            time_ns=int(frames.time_ns[0]),
            ego=ego,
            nodes=nodes,
            edges=_edges(graph, outer) + self._map_edges(mapped),
            reach=self._reach,
        )

    def _map_node(self, node: int) -> Attributes:
        found = self._map_nodes.get(node)
        if found is not None or self._map is None:
            return found or {}
        nodes, row = self._map.nodes, -1 - node
        texts = {name: getattr(nodes, name)[row] for name in _MAP_TEXTS}
        numbers = {name: float(getattr(nodes, name)[row]) for name in _MAP_NUMBERS}
        numbers["heading"] = math.degrees(numbers["heading"])
        about: Attributes = {"kind": KINDS[nodes.kind[row]], "is_ego": False, "is_static": True}
        about |= {name: text for name, text in texts.items() if text} | _numbers(numbers)
        if nodes.lane_type[row]:
            about |= {"section": int(nodes.section[row]), "lane": int(nodes.lane[row])}
        self._map_nodes[node] = about
        return about

    def _map_edges(self, present: Ints) -> list[Edge]:
        """Edges of the map whose ends are both present."""
        if self._map is None or not len(present):
            return []
        here = np.zeros(len(self._map.nodes), np.bool_)
        here[-1 - present] = True
        rows = np.flatnonzero(here[-1 - self._src] & here[-1 - self._dst])
        ends = zip(self._src[rows].tolist(), self._dst[rows].tolist(), rows.tolist(), strict=True)
        return [(a, self._relation[row], b, {}) for a, b, row in ends]


def _moving(states: States) -> list[Attributes]:
    """Attributes of states, in outward units: of whole columns first, then row by row."""
    columns: dict[str, Floats] = {
        name: getattr(states, name) for name in (*_BOX, *_MOTION, *_INPUTS)
    }
    columns["heading"] = np.degrees(wrapped(states.heading))
    columns |= {name: np.degrees(getattr(states, name)) for name in ("pitch", "roll", "yaw_rate")}
    speed = np.sqrt(states.vx**2 + states.vy**2 + np.nan_to_num(states.vz) ** 2)
    columns["speed"] = number(speed).astype(np.float64)
    columns["accel"] = states.ax * np.cos(states.heading) + states.ay * np.sin(states.heading)
    names = tuple(columns)
    table = np.stack([columns[name] for name in names], axis=1)
    known = np.isfinite(table).tolist()
    codes = zip(
        states.lights.tolist(), states.light_state.tolist(), states.derived.tolist(), strict=True
    )
    return [
        {name: value for name, value, told in zip(names, row, is_known, strict=True) if told}
        | _coded(*whole)
        for row, is_known, whole in zip(table.tolist(), known, codes, strict=True)
    ]


def _coded(lights: int, light: int, derived: int) -> Attributes:
    """What codes say: lights of a vehicle, what a traffic light shows, what was derived."""
    about: Attributes = {}
    if lights >= 0:
        about |= {name: bool(lights >> bit & 1) for bit, name in enumerate(VEHICLE_LIGHTS)}
    if light >= 0:
        about["light_state"] = LIGHT_STATES[light]
    return about | {name: bool(derived >> bit & 1) for bit, name in enumerate(_DERIVED)}


def _edges(graph: GraphBlock, outer: Ints) -> list[Edge]:
    """Edges that have an end in the trace, each once, in the order of their ends."""
    edges = graph.edges
    src, dst = _outward(edges.src, outer), _outward(edges.dst, outer)
    order = np.lexsort((dst, edges.relation, src))
    src, relation, dst = src[order], edges.relation[order], dst[order]
    new = np.ones(len(src), np.bool_)
    new[1:] = (np.diff(src) != 0) | (np.diff(relation) != 0) | (np.diff(dst) != 0)
    src, relation, dst = src[new], relation[new], dst[new]
    about: list[Attributes] = [{} for _ in range(len(src))]
    known = _attributes(graph, outer)
    rows = np.flatnonzero(_TELLS[relation])
    keys = zip(relation[rows].tolist(), src[rows].tolist(), dst[rows].tolist(), strict=True)
    for row, key in zip(rows.tolist(), keys, strict=True):
        if key in known:
            about[row] = known[key]
    names = [RELATIONS[code] for code in relation.tolist()]
    return list(zip(src.tolist(), names, dst.tolist(), about, strict=True))


def _attributes(graph: GraphBlock, outer: Ints) -> dict[tuple[int, int, int], Attributes]:
    """Attributes of the edges that have any, by relation and ends."""
    lanes, gaps = graph.lanes, graph.gaps
    told = (lanes.overlap, lanes.offset, lanes.heading_error, lanes.along)
    columns = (
        *(_outward(lanes.node, outer).tolist(), lanes.lane.tolist()),
        *(number(column).tolist() for column in told),
        *(lanes.primary.tolist(), lanes.own.tolist()),
    )
    known: dict[tuple[int, int, int], Attributes] = {}
    for node, lane, overlap, offset, error, along, primary, own in zip(*columns, strict=True):
        numbers = {
            "overlap": overlap,
            "lane_offset": offset,
            "heading_error": math.degrees(error),
            "along": along,
        }
        known[_IS_IN, node, lane] = _numbers(numbers) | {"is_primary": primary, "is_own": own}
    columns = (_outward(gaps.src, outer), _outward(gaps.dst, outer), number(gaps.gap))
    for a, b, gap in zip(*(column.tolist() for column in columns), strict=True):
        known[_FOLLOWS, a, b] = _numbers({"gap": gap})
        known[_LEADS, b, a] = _numbers({"gap": gap})
    return known


def _outward(nodes: Ints, outer: Ints) -> Ints:
    """Node ids of the records for those of a block."""
    return np.where(nodes >= 0, outer[np.maximum(nodes, 0)], nodes)


def _degrees(heading: Floats) -> list[float]:
    """Headings in (-180, 180]."""
    return np.degrees(wrapped(heading)).tolist()


def _numbers(values: dict[str, float]) -> Attributes:
    """What of numbers is known."""
    return {name: value for name, value in values.items() if math.isfinite(value)}
