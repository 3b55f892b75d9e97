"""Driven lanes of a turned and mirrored world: ``python oracle_turned.py RECORDING ...``.

The map of a recording and its frames are turned by some angles, and mirrored. Primary and own lanes, places
along them, leaders with their gaps, and turns must stay the same. In a mirrored world, traffic drives on the
other side, and left turns are right turns.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.maps.map_files import Maps
from sgstore.maps.roads import PlainLane, lane_text, read_lane_text
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import RELATION_CODE
from sgstore.readers import on_map, open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import Floats, FrameBlock, States

WIDE = Config(range=RangeSettings(radius=2000.0))
SWAPPED = {"left": "right", "right": "left"}
STEP = 5e-4
"""Coordinates of the map are multiples, m: after a turn of ``ANGLES`` they have four decimals."""
ANGLES = (0.0, math.atan2(4, 3), math.atan2(3, -4))
NEAR = 1e-6
"""Greatest difference of places and gaps, m."""


@dataclass(frozen=True)
class World:
    """A map of plain lanes and a turn about its origin; mirrored at the x axis before."""

    angle: float = 0.0
    mirrored: bool = False

    def points(self, x: Any, y: Any) -> tuple[Any, Any]:
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        y = -y if self.mirrored else y
        return x * cos - y * sin, x * sin + y * cos

    def border(self, x: Floats, y: Floats) -> Floats:
        """Points of the border of a lane in this world, which the text of plain lanes has exactly."""
        places = self.points(np.round(x / STEP) * STEP, np.round(y / STEP) * STEP)
        return np.stack(places, axis=1, dtype=np.float64)

    def map_of(self, road_map: RoadMap) -> RoadMap:
        """The lanes of a map in this world, with their links and neighbours."""
        lanes = [self._lane(road_map, number) for number in range(len(road_map.ribbons))]
        return read_lane_text(lane_text(lanes), road_map.name)

    def _lane(self, road_map: RoadMap, number: int) -> PlainLane:
        of, nodes, column = road_map.ribbons, road_map.nodes, 1 + number
        rows = slice(of.offsets[number], of.offsets[number + 1])
        left = self.border(of.left_x[rows], of.left_y[rows])
        right = self.border(of.right_x[rows], of.right_y[rows])
        to_left, to_right = (_others(road_map, name, number) for name in ("toLeftOf", "toRightOf"))
        if self.mirrored:
            left, right, to_left, to_right = right, left, to_right, to_left
        return PlainLane(
            nodes.name[column],
            nodes.lane_type[column],
            nodes.road[column],
            nodes.junction[column],
            int(nodes.section[column]),
            int(nodes.lane[column]),
            left,
            right,
            of.z[rows],
            onto=_others(road_map, "travelsTo", number, source=True),
            left_beside=to_left,
            right_beside=to_right,
            against=_others(road_map, "opposes", number),
        )

    def block_of(self, block: FrameBlock) -> FrameBlock:
        return replace(block, states=self._of(block.states), scenery=self._of(block.scenery))

    def _of(self, states: States) -> States:
        sign = -1.0 if self.mirrored else 1.0
        x, y = self.points(states.x, states.y)
        vx, vy = self.points(states.vx, states.vy)
        ax, ay = self.points(states.ax, states.ay)
        heading, yaw_rate = sign * states.heading + self.angle, sign * states.yaw_rate
        told = {"x": x, "y": y, "vx": vx, "vy": vy, "ax": ax, "ay": ay}
        return replace(states, **told, heading=heading, yaw_rate=yaw_rate)


def _others(
    road_map: RoadMap, relation: str, number: int, *, source: bool = False
) -> tuple[int, ...]:
    """Lanes with an edge to a lane, or from it (``source``)."""
    edges, node = road_map.edges, -2 - number
    here, there = (edges.src, edges.dst) if source else (edges.dst, edges.src)
    kept = (edges.relation == RELATION_CODE[relation]) & (here == node)
    lanes = (-2 - there[kept]).tolist()
    return tuple(one for one in lanes if 0 <= one < len(road_map.ribbons))


Results = dict[tuple[Any, ...], float]


def results(road_map: RoadMap, blocks: Iterable[FrameBlock], *, mirrored: bool) -> Results:
    """What depends on driven lanes: key → place along a lane, or gap; m."""
    generator, found, nodes = SceneGraphGenerator(road_map, WIDE), Results(), road_map.nodes
    for lane, turn in enumerate(nodes.turn):
        found["turn", lane, SWAPPED.get(turn, turn) if mirrored else turn] = 0.0
    for block in generator.recorded(blocks):
        graph = generator.block(block)
        lanes, gaps = graph.lanes, graph.gaps
        for kind, rows in (("primary", lanes.primary), ("own", lanes.own)):
            columns = (lanes.frame[rows], lanes.node[rows], lanes.lane[rows], lanes.along[rows])
            for frame, node, lane, along in zip(*(c.tolist() for c in columns), strict=True):
                found[kind, int(block.seq[frame]), node, lane] = along
        columns = (gaps.frame, gaps.src, gaps.dst, gaps.gap)
        for frame, src, dst, gap in zip(*(c.tolist() for c in columns), strict=True):
            found["follows", int(block.seq[frame]), src, dst] = gap
    return found


def differences(wanted: Results, found: Results) -> list[tuple[Any, ...]]:
    """Keys of two results that only one has, or whose numbers differ."""
    same = wanted.keys() & found.keys()
    far = [key for key in same if abs(wanted[key] - found[key]) > NEAR]
    return sorted([*(wanted.keys() ^ found.keys()), *far], key=repr)


WORLDS = tuple(
    World(angle, mirrored) for angle in ANGLES for mirrored in (False, True) if angle or mirrored
)


def compare(
    road_map: RoadMap, blocks: list[FrameBlock], worlds: Iterable[World] = WORLDS
) -> dict[World, list[tuple[Any, ...]]]:
    """Differences of each world to the given one, whose map has plain lanes, too."""
    wanted = results(World().map_of(road_map), blocks, mirrored=False)
    return {
        world: differences(
            wanted,
            results(
                world.map_of(road_map),
                [world.block_of(block) for block in blocks],
                mirrored=world.mirrored,
            ),
        )
        for world in worlds
    }


def recorded(path: Path) -> tuple[RoadMap, list[FrameBlock]]:
    """The map and the frames of a recording."""
    with open_trace(path) as trace:
        found, _ = Maps(None, Config().signs).of(trace.info)
        assert found is not None
        on_map(trace, found)
        return found, list(trace.blocks())


def main() -> None:
    """Compare recordings; the exit code is 1 if anything differs."""
    differs = 0
    for path in map(Path, sys.argv[1:]):
        for world, apart in compare(*recorded(path)).items():
            print(f"{path.name}: {world}: {len(apart)} differences", *apart[:5], flush=True)
            differs += bool(apart)
    sys.exit(f"{differs} worlds differ" if differs else None)


if __name__ == "__main__":
    main()
