"""Simplified outlines of a road map as plain columns, for drawing programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
import shapely

from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.maps.roads._map import RoadMap

TOLERANCE: Final = 0.05
"""Largest distance between a simplified outline and the original; m."""


@dataclass(frozen=True, slots=True)
class DrawnOutlines:
    """Simplified outlines of a road map (polygons and lines) as plain columns, in the order to draw them.

    Attributes
    ----------
    origin : (float, float)
        Origin of the points; m, in the axes of the map.
    words : tuple of str
        Types of lanes, and kinds of the other nodes.
    x, y : (N,) float32
        Points; m.
    start : (R + 1,) uint32
        First point of each ring or line; the last entry is the number of points.
    node : (R,) int32
        Node id of the outlined part.
    word : (R,) uint8
        Index into ``words``.
    closed : (R,) uint8
        1 if the outline encloses an area.
    arrows : (A, 3) float32
        Points on lanes for motor traffic outside junctions, one in ``ARROW_SPACING``: x, y, and the
        direction of travel; m, rad.
    """

    MOTOR_LANES: ClassVar = frozenset(
        (
            *("driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp"),
            *("slipLane", "bus", "taxi", "HOV"),
        )
    )
    """Types of lanes for motor traffic."""

    ARROW_SPACING: ClassVar = 14.0
    """Distance between two arrows on a lane; m."""

    origin: tuple[float, float]
    words: tuple[str, ...]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    start: NDArray[np.uint32]
    node: NDArray[np.int32]
    word: NDArray[np.uint8]
    closed: NDArray[np.uint8]
    arrows: NDArray[np.float32]

    @staticmethod
    def of(road_map: RoadMap, tolerance: float = TOLERANCE) -> DrawnOutlines:
        """Return the simplified outlines of lanes, crosswalks and objects of a road map.

        Parameters
        ----------
        road_map : RoadMap
        tolerance : float
            Greatest distance between an outline and the original; m.
        """
        nodes = road_map.nodes
        kinds = [str(KINDS[kind]) for kind in nodes.kind.tolist()]
        names = [lane or kind for lane, kind in zip(nodes.lane_type, kinds, strict=True)]
        words = tuple(dict.fromkeys(names))[:255]
        codes = np.array([min(words.index(name) if name in words else 254, 254) for name in names])
        # Pavements are painted below carriageways, and crossings above both.
        layer = np.array([_layer(word) for word in words] or [0])[codes] if len(codes) else codes
        shapes = shapely.simplify(road_map.outlines(), tolerance)
        parts, row = shapely.get_parts(shapes, return_index=True)
        area = np.isin(shapely.get_type_id(parts), [3])
        rings, of = shapely.get_rings(parts[area], return_index=True)
        lines = np.isin(shapely.get_type_id(parts), [1, 2])
        whole = np.concatenate([rings, parts[lines]])
        owner = np.concatenate([row[area][of], row[lines]]).astype(np.int64)
        closed = np.concatenate([np.ones(len(rings)), np.zeros(int(lines.sum()))])
        order = np.lexsort((np.arange(len(whole)), layer[owner])) if len(whole) else np.arange(0)
        whole, owner, closed = whole[order], owner[order], closed[order]
        points, ring = shapely.get_coordinates(whole, return_index=True)
        centre = np.round(points.mean(axis=0)) if len(points) else np.zeros(2)
        start = np.searchsorted(ring, np.arange(len(whole) + 1))
        about = (points - centre).astype(np.float32)
        return DrawnOutlines(
            (float(centre[0]), float(centre[1])),
            words,
            about[:, 0],
            about[:, 1],
            start.astype(np.uint32),
            (-1 - owner).astype(np.int32),
            codes[owner].astype(np.uint8),
            closed.astype(np.uint8),
            _arrows(road_map, centre),
        )


def _arrows(road_map: RoadMap, centre: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return evenly spaced points on the centre lines of lanes, with the direction of travel."""
    nodes, ribbons = road_map.nodes, road_map.ribbons
    found = [np.empty((0, 3))]
    for row, word in enumerate(nodes.lane_type):
        if (
            word not in DrawnOutlines.MOTOR_LANES
            or nodes.junction[row]
            or not 1 <= row < len(ribbons.offsets)
        ):
            continue
        part = slice(*ribbons.offsets[row - 1 : row + 1].tolist())
        x = (ribbons.left_x[part] + ribbons.right_x[part]) / 2
        y = (ribbons.left_y[part] + ribbons.right_y[part]) / 2
        along = np.append(0.0, np.hypot(np.diff(x), np.diff(y)).cumsum())
        count = min(round(along[-1] / DrawnOutlines.ARROW_SPACING), 2000)
        at = (np.arange(count) + 0.5) * along[-1] / max(count, 1)
        here, ahead = (np.stack([np.interp(s, along, v) for v in (x, y)]) for s in (at, at + 0.5))
        angle = np.arctan2(*(ahead - here)[::-1])
        found.append(np.column_stack([*(here - centre[:, None]), angle]))
    return np.concatenate(found).astype(np.float32)


_ABOVE: Final = {"crosswalk": 4, "parking": 3}
_WALKED: Final = frozenset({"sidewalk", "walking", "shoulder", "border", "curb", "median", "none"})


def _layer(word: str) -> int:
    if word in KINDS and word not in _ABOVE:
        return 5
    return _ABOVE.get(word, 0 if word in _WALKED else 2)
