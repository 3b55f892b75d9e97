"""Places as shapes, for nodes of a map that have no extent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.world import Floats


def point_shapes(x: Floats, y: Floats) -> NDArray[np.object_]:
    """(N,) shapely points."""
    points: Any = shapely.points(np.column_stack([x, y]))
    return points
