"""Which lanes signals apply to, and which lie upstream of them, as far as those lanes are in range.

A signal of the trace ``controlsTrafficOf`` the lanes that the map says of the signal that it is; for signals
of the map that is the map's own relation. A signal ``mayAffect`` these lanes and all from which it lies ahead
along the lanes, up to the distance that the settings look.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.graph import Edges
from sgstore.relations.scene import Family, Scene, edges_to_map, joined
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.relations.scene import Ground
    from sgstore.world import Ints


def _names(config: Config) -> tuple[str, ...]:
    return ("controlsTrafficOf", "mayAffect") if config.lanes.ahead > 0 else ("controlsTrafficOf",)


def _edges(scene: Scene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("signals need a map")
    return Edges.chained(
        [
            _of_trace(scene, ground, "controlsTrafficOf", ground.controls),
            _of_trace(scene, ground, "mayAffect", ground.affects),
            _of_map(ground),
        ]
    )


def _of_trace(scene: Scene, ground: Ground, relation: str, table: tuple[Ints, Ints]) -> Edges:
    bodies, (signals, lanes) = scene.bodies, table
    rows, index = joined(signals, bodies.node)
    lanes = lanes[index]
    present = ground.present[bodies.frame[rows], -1 - lanes]
    return edges_to_map(scene, relation, rows[present], lanes[present])


def _of_map(ground: Ground) -> Edges:
    signals, lanes = ground.map_affects
    frame, row = np.nonzero(ground.present[:, -1 - signals] & ground.present[:, -1 - lanes])
    code = np.full(len(frame), RELATION_CODE["mayAffect"], np.int8)
    return Edges(frame, code, signals[row], lanes[row])


CONTROL = Family(_names, needs_map=True, edges=_edges)
