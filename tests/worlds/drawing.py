"""A small town for pictures: a junction of four arms with crosswalks, and who goes about there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely

from sgstore.maps.roads import MapEdges, MapNodes, Ribbons, RoadMap
from sgstore.model.graph import SceneGraph
from sgstore.model.vocabulary import DIRECTIONS, KIND_CODE, PROXIMITY

WIDTH = 3.5
ARM = 80.0
HALF = 14.0


class Crossing(RoadMap):
    """Four arms of two lanes each way, with sidewalks, around a junction at the origin."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = [{"kind": "off_road", "name": "off_road"}]
        self._outlined: list[shapely.Geometry | None] = [None]
        self._lines: list[tuple[Any, Any]] = []
        for arm in range(4):
            self._arm(arm, arm * math.pi / 2)
        for arm in range(4):
            for turn, name in ((-1, "right"), (0, "straight"), (1, "left")):
                self._connection(arm, turn, name)
        self._add({"kind": "road", "name": "0", "x": 50.0, "y": 0.0})
        self._add({"kind": "junction", "name": "9", "x": 0.0, "y": 0.0})
        for arm in range(4):
            self._crosswalk(arm, arm * math.pi / 2)
        self._add({"kind": "traffic_light", "name": "s1", "x": 14.0, "y": 8.5})
        self._build()

    def _build(self) -> None:
        none = np.empty(0, np.int64)
        shapes = np.empty(len(self._outlined), dtype=object)
        shapes[:] = self._outlined
        super().__init__(
            name="crossing",
            text="",
            nodes=self._nodes(),
            edges=MapEdges(relation=none.astype(np.int8), src=none, dst=none),
            ribbons=self._ribbons(),
            shapes=shapes,
        )

    def _ribbons(self) -> Ribbons:
        left, right = (np.concatenate(side) for side in zip(*self._lines, strict=True))
        unused = np.zeros(len(left))
        offsets = np.cumsum([0, *(len(side) for side, _ in self._lines)])
        borders = {"left_x": left[:, 0], "left_y": left[:, 1]}
        borders |= {"right_x": right[:, 0], "right_y": right[:, 1]}
        return Ribbons(offsets, **borders, z=unused, heading=unused, s=unused, along=unused)

    def node(self, name: str) -> int:
        return -1 - self.nodes.name.index(name)

    def add_scenery(self, kind: str, shape: shapely.Geometry) -> None:
        self._add({"kind": kind, "name": kind, "x": shape.centroid.x, "y": shape.centroid.y}, shape)
        self._build()

    def _arm(self, arm: int, turn: float) -> None:
        for lane in (-3, -2, -1, 1, 2, 3):
            offset = math.copysign(abs(lane) - 0.5, lane) * WIDTH
            line = np.array(((HALF, offset), (ARM, offset)))
            kind = "sidewalk" if abs(lane) == 3 else "driving"
            self._lane(_turned(line if lane < 0 else line[::-1], turn), f"{arm}/0/{lane}", kind)

    def _connection(self, arm: int, turn: int, name: str) -> None:
        """From the inner lane that comes in along an arm to the one that leaves by another."""
        start = _turned(np.array(((HALF, 0.5 * WIDTH), (HALF - 1, 0.5 * WIDTH))), arm * math.pi / 2)
        goal = (arm + 2 + turn) * math.pi / 2
        end = _turned(np.array(((HALF - 1, -0.5 * WIDTH), (HALF, -0.5 * WIDTH))), goal)
        t = np.linspace(0, 1, 15)[:, None]
        knee = _turned(np.array(((0.0, 0.0),)), 0)[0] if turn == 0 else _knee(start, end)
        line = (1 - t) ** 2 * start[0] + 2 * t * (1 - t) * knee + t**2 * end[1]
        line = start[0] + t * (end[1] - start[0]) if turn == 0 else line
        self._lane(line, f"{arm}{turn + 1}/0/-1", "driving", junction="9", turn=name)

    def _lane(self, line: Any, name: str, lane_type: str, **more: str) -> None:
        ahead = np.gradient(line, axis=0)
        ahead /= np.hypot(*ahead.T)[:, None]
        left = np.column_stack((-ahead[:, 1], ahead[:, 0])) * WIDTH / 2
        middle = line[len(line) // 2 : len(line) // 2 + 1].mean(axis=0)
        if len(line) == 2:
            middle = line.mean(axis=0)
        self._add(
            {
                "kind": "lane",
                "name": name,
                "lane_type": lane_type,
                "road": name.split("/", maxsplit=1)[0],
                "x": middle[0],
                "y": middle[1],
                "heading": math.atan2(*(line[-1] - line[0])[::-1]),
                "length": float(np.hypot(*np.diff(line, axis=0).T).sum()),
                "width": WIDTH,
                **more,
            },
        )
        self._lines.append((line + left, line - left))

    def _crosswalk(self, arm: int, turn: float) -> None:
        box = np.array(((HALF + 1, -7.0), (HALF + 4, -7.0), (HALF + 4, 7.0), (HALF + 1, 7.0)))
        at = _turned(np.array(((HALF + 2.5, 0.0),)), turn)[0]
        self._add(
            {"kind": "crosswalk", "name": f"c{arm}", "x": at[0], "y": at[1]},
            shapely.Polygon(_turned(box, turn)),
        )

    def _add(self, row: dict[str, Any], shape: shapely.Geometry | None = None) -> None:
        self._rows.append(row)
        self._outlined.append(shape)

    def _nodes(self) -> MapNodes:
        def texts(name: str) -> tuple[str, ...]:
            return tuple(row.get(name, "") for row in self._rows)

        def numbers(name: str) -> Any:
            return np.array([row.get(name, math.nan) for row in self._rows], np.float64)

        zeros = np.zeros(len(self._rows), np.int64)
        return MapNodes(
            kind=np.array([KIND_CODE[row["kind"]] for row in self._rows], np.int8),
            **{n: texts(n) for n in ("name", "lane_type", "road", "junction", "turn")},
            **{n: numbers(n) for n in ("x", "y", "z", "heading", "length", "width")},
            **{n: numbers(n) for n in ("speed_limit", "curvature")},
            section=zeros,
            lane=zeros,
        )


def graph_of(
    nodes: dict[int, dict[str, Any]],
    edges: list[tuple[int, str, int, dict[str, Any]]] | None = None,
    **more: Any,
) -> SceneGraph:
    ego = next((node for node, a in nodes.items() if a.get("is_ego")), None)
    known = {"frame_id": 1, "trace": "town", "seq": 7, "time_ns": 350_000_000, "ego": ego}
    return SceneGraph(**(known | more), nodes=nodes, edges=edges or [])


def entity(kind: str, x: float, y: float, heading: float = 0.0, **more: Any) -> dict[str, Any]:
    length, width = {
        "car": (4.6, 1.9),
        "truck": (9.0, 2.5),
        "van": (5.5, 2.1),
        "bus": (12.0, 2.6),
        "bicycle": (1.8, 0.6),
        "motorcycle": (2.1, 0.8),
        "person": (0.5, 0.5),
    }.get(kind, (0.4, 0.4))
    known = {"kind": kind, "x": x, "y": y, "z": 0.8, "heading": heading, "speed": 0.0}
    return known | {"length": length, "width": width, "is_ego": False} | more


def related(nodes: dict[int, dict[str, Any]]) -> list[tuple[int, str, int, dict[str, Any]]]:
    """Proximity and direction of all pairs of entities within 25 m, by the rules of the design."""
    edges: list[tuple[int, str, int, dict[str, Any]]] = []
    bodies = {n: a for n, a in nodes.items() if n >= 0 and a["kind"] != "traffic_light"}
    for i, a in bodies.items():
        for j, b in bodies.items():
            away = math.hypot(b["x"] - a["x"], b["y"] - a["y"])
            if i == j or away > 25:
                continue
            near = next(
                name
                for name, hi in zip(PROXIMITY, (2, 4, 7, 10, 16, 25), strict=True)
                if away <= hi
            )
            angle = math.degrees(math.atan2(b["y"] - a["y"], b["x"] - a["x"])) - a["heading"]
            bearing = (angle + 180) % 360 - 180
            ahead = DIRECTIONS[min(3, int(abs(bearing) // 45))]
            edges += [(j, near, i, {}), (j, ahead, i, {})]
            edges += [(j, "toLeftOf" if bearing > 0 else "toRightOf", i, {})]
    return edges


def crowd(road_map: Crossing, count: int = 40, seed: int = 3) -> SceneGraph:
    """A junction full of traffic, the ego about to enter it from the south."""
    random = np.random.default_rng(seed)
    nodes: dict[int, dict[str, Any]] = {0: entity("car", 1.75, -22.0, 90.0, is_ego=True, speed=6.0)}
    kinds = ("car", "car", "car", "van", "truck", "bicycle", "person", "person", "bus")
    lanes = [r for r, s in enumerate(road_map.outlines()) if s is not None]
    lanes = [r for r in lanes if road_map.nodes.lane_type[r] in {"driving", "sidewalk"}]
    while len(nodes) < count:
        row = int(random.choice(lanes))
        walks = road_map.nodes.lane_type[row] == "sidewalk"
        kind = "person" if walks else str(random.choice(kinds[:6]))
        heading = float(road_map.nodes.heading[row])
        along = float(random.uniform(-0.45, 0.45)) * float(road_map.nodes.length[row])
        x = float(road_map.nodes.x[row]) + along * math.cos(heading)
        y = float(road_map.nodes.y[row]) + along * math.sin(heading)
        if min(math.hypot(n["x"] - x, n["y"] - y) for n in nodes.values()) < (2 if walks else 6):
            continue
        speed = float(random.uniform(0, 1.5 if walks else 9))
        nodes[len(nodes)] = entity(kind, x, y, math.degrees(heading), speed=speed)
    for arm, (x, y) in enumerate(((15.0, 8.5), (-8.5, 15.0), (-15.0, -8.5), (8.5, -15.0))):
        state = ("red", "green", "red", "green")[arm]
        nodes[len(nodes)] = entity("traffic_light", x, y, light_state=state)
    edges = related(nodes)
    for name in ("3/0/2", "3/0/1", "00/0/-1", "c3"):
        node = road_map.node(name)
        row = -1 - node
        kind = "crosswalk" if name == "c3" else "lane"
        at = {"x": float(road_map.nodes.x[row]), "y": float(road_map.nodes.y[row])}
        nodes[node] = {"kind": kind, "name": name, "is_ego": False, **at}
    nodes[-1] = {"kind": "off_road", "name": "off_road", "is_ego": False}
    edges.append((0, "isIn", road_map.node("3/0/1"), {"is_primary": True, "overlap": 1.0}))
    edges.append((count + 3, "controlsTrafficOf", road_map.node("3/0/1"), {}))
    return graph_of(nodes, edges)


def _turned(points: Any, angle: float) -> Any:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array(((cos, sin), (-sin, cos)))


def _knee(start: Any, end: Any) -> Any:
    """Where the lines along two segments meet."""
    a, b = start[1] - start[0], end[1] - end[0]
    t = np.linalg.solve(np.column_stack((a, -b)), end[0] - start[0])[0]
    return start[0] + t * a
