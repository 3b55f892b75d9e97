"""What bodies stand on: lanes of any type, waypoints, crosswalks, or nothing that is made for driving.

A footprint is in every lane that it meets on its storey; how far, and which of them is the one above all, are
attributes that go beside the edges (:class:`sgstore.graph.LaneStates`). What stands on no driving lane is in
``off_road``, whether or not it is in a lane of another type too: whatever moves, and of the scenery vehicles,
persons, animals and props. Signals hang over roads rather than stand on them, and are in nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations.scene import Family, Scene, edges_to_map
from sgstore.roads import OFF_ROAD

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges


def _names(config: Config) -> tuple[str, ...]:
    return ("isIn",)


def _edges(scene: Scene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("lanes need a map")
    standing = ground.standing
    at, parts = standing.parts
    rows = np.concatenate([standing.hits.row, at, standing.off_road])
    nowhere = np.full(len(standing.off_road), OFF_ROAD)
    return edges_to_map(scene, "isIn", rows, np.concatenate([standing.hits.lane, parts, nowhere]))


LANES = Family(_names, needs_map=True, edges=_edges)
