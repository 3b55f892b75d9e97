"""Rigid motions and a mirror: recordings and road maps carried elsewhere, for laws about scene graphs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import shapely
import shapely.affinity

from sgstore.maps.roads import RoadMap
from sgstore.model.vocabulary import RELATION_CODE, VEHICLE_LIGHTS

if TYPE_CHECKING:
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Floats, FrameBlock, States

LEFT, RIGHT = (1 << VEHICLE_LIGHTS.index(f"light_{side}") for side in ("left", "right"))
SIDES = (RELATION_CODE["toLeftOf"], RELATION_CODE["toRightOf"])


@dataclass(frozen=True)
class Motion:
    """A mirror at the x axis or none, then a turn about the origin in rad, then a shift in m."""

    turn: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mirrored: bool = False

    @property
    def side(self) -> float:
        """-1 if left and right change places, else 1."""
        return -1.0 if self.mirrored else 1.0

    def vector(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        y = self.side * y
        return cos * x - sin * y, sin * x + cos * y

    def place(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        x, y = self.vector(x, y)
        return x + self.shift[0], y + self.shift[1]

    def heading(self, heading: Floats) -> Floats:
        return self.side * heading + self.turn

    def states(self, states: States) -> States:
        x, y = self.place(states.x, states.y)
        vx, vy = self.vector(states.vx, states.vy)
        ax, ay = self.vector(states.ax, states.ay)
        return replace(
            states,
            x=x,
            y=y,
            z=states.z + self.shift[2],
            heading=self.heading(states.heading),
            roll=self.side * states.roll,
            vx=vx,
            vy=vy,
            ax=ax,
            ay=ay,
            yaw_rate=self.side * states.yaw_rate,
            steer=self.side * states.steer,
            lights=_swapped_lights(states.lights) if self.mirrored else states.lights,
        )

    def block(self, block: FrameBlock) -> FrameBlock:
        return replace(block, states=self.states(block.states), scenery=self.states(block.scenery))

    def map(self, road_map: RoadMap) -> RoadMap:
        """The map without the places of broad markings and stop lines, which no edge depends on."""
        nodes, ribbons, courses = road_map.nodes, road_map.ribbons, road_map.courses
        x, y = self.place(nodes.x, nodes.y)
        left = self.place(ribbons.left_x, ribbons.left_y)
        right = self.place(ribbons.right_x, ribbons.right_y)
        if self.mirrored:
            left, right = right, left
        return RoadMap(
            name=road_map.name,
            text=f"{road_map.text} {self}",
            nodes=replace(
                nodes,
                x=x,
                y=y,
                z=nodes.z + self.shift[2],
                heading=self.heading(nodes.heading),
                curvature=self.side * nodes.curvature,
            ),
            edges=replace(road_map.edges, relation=self.relations(road_map.edges.relation)),
            ribbons=replace(
                ribbons,
                left_x=left[0],
                left_y=left[1],
                right_x=right[0],
                right_y=right[1],
                z=ribbons.z + self.shift[2],
                heading=self.heading(ribbons.heading),
            ),
            shapes=np.array([self._shape(shape) for shape in road_map.shapes], np.object_),
            lane_changes=road_map.lane_changes,
            road_types=road_map.road_types,
            junction_types=road_map.junction_types,
            controllers=road_map.controllers,
            stops=road_map.stops,
            courses=replace(courses, curvature=self.side * courses.curvature),
        )

    def _shape(self, shape: shapely.Geometry | None) -> shapely.Geometry | None:
        if shape is None:
            return None
        return shapely.transform(shape, lambda xy: np.stack(self.place(*xy.T), axis=1))

    def relations(self, codes: np.ndarray) -> np.ndarray:
        """Codes of relations, left and right exchanged if the world is mirrored."""
        if not self.mirrored:
            return codes
        swapped = codes.copy()
        for one, other in (SIDES, SIDES[::-1]):
            swapped[codes == one] = other
        return swapped

    def edges(self, block: GraphBlock) -> set[tuple[int, int, int, int]]:
        """The edges of the moved world, as those of the world at rest: frame, source, relation, destination."""
        edges = block.edges
        columns = (edges.frame, edges.src, self.relations(edges.relation), edges.dst)
        return set(zip(*(column.tolist() for column in columns), strict=True))


def _swapped_lights(lights: np.ndarray) -> np.ndarray:
    both = LEFT | RIGHT
    one_side = ((lights & both) == LEFT) | ((lights & both) == RIGHT)
    return np.where((lights >= 0) & one_side, lights ^ both, lights)
