"""A loop that does no more than the arithmetic of scene graphs: a bound of what one core can do.

For every frame all pairs of entities are told (rung, sector, side, both ways), and which quadrangles of lanes
that are close each footprint touches. There are no tables, no shares, no gaps, and no sight.
"""

# ruff: noqa: PLR0913, PLR0917, SLF001

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.base.numba_loops import compiled, use_loops
from sgstore.maps.roads._footprints import _Shapes

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.maps.roads import RoadMap
    from sgstore.model.world import FrameBlock

BOUNDS = np.array([2.0, 4.0, 7.0, 10.0, 16.0, 25.0]) ** 2


def floor(block: FrameBlock, road_map: RoadMap) -> Callable[[], int] | None:
    """Work that counts the edges of a block; None without numba."""
    if not use_loops():
        return None
    of, index = block.states, road_map._index
    boxes = np.stack([of.x, of.y, of.heading, of.length, of.width], axis=1)
    shapes = _Shapes.of(boxes, of.z - of.height / 2)
    close = [np.concatenate(part) for part in zip(*index._candidates(shapes), strict=True)]
    arrays: tuple[Any, ...] = (of.x, of.y, np.cos(of.heading), np.sin(of.heading))
    size = of.length / 2, of.width / 2
    return lambda: (
        _pairs(block.offsets, *arrays, BOUNDS)
        + _lanes(*close, index._quads.corners, *arrays, *size)
    )


@compiled
def _pairs(offsets: Any, x: Any, y: Any, cos: Any, sin: Any, bounds: Any) -> int:
    edges = 0
    for frame in range(len(offsets) - 1):
        for a in range(offsets[frame], offsets[frame + 1]):
            for b in range(offsets[frame], offsets[frame + 1]):
                dx, dy = x[b] - x[a], y[b] - y[a]
                span = dx * dx + dy * dy
                if a == b or (span > bounds[-1] and a > offsets[frame] < b):
                    continue
                rung = 0
                while rung < len(bounds) and span > bounds[rung]:
                    rung += 1
                ahead, left = dx * cos[a] + dy * sin[a], dy * cos[a] - dx * sin[a]
                aside = abs(left)
                sector = (ahead < aside) + (ahead < 0) + (-ahead > aside)
                edges += (rung < len(bounds)) + (sector >= 0) + (aside > 1e-3)
    return edges


@compiled
def _lanes(
    row: Any, quad: Any, corners: Any, x: Any, y: Any, cos: Any, sin: Any, a: Any, b: Any
) -> int:
    edges = 0
    at_x, at_y = np.empty(4), np.empty(4)
    for i in range(len(row)):
        body = row[i]
        for corner in range(4):
            dx, dy = corners[quad[i], corner] - x[body], corners[quad[i], 4 + corner] - y[body]
            at_x[corner] = dx * cos[body] + dy * sin[body]
            at_y[corner] = dy * cos[body] - dx * sin[body]
        apart = at_x.min() > a[body] or at_x.max() < -a[body]
        apart = apart or at_y.min() > b[body] or at_y.max() < -b[body]
        for k in range(4):
            edge_x, edge_y = at_x[k - 3] - at_x[k], at_y[k - 3] - at_y[k]
            beyond = edge_x * at_y[k] - edge_y * at_x[k]
            apart = apart or beyond > a[body] * abs(edge_y) + b[body] * abs(edge_x)
        edges += not apart
    return edges
