"""Relation ``isIn`` (object on a lane), and relations between signals and the lanes that they control.

Bodies are on lanes of any type, waypoints, crosswalks, or off the road.

A footprint is in every lane that it touches on its storey. The overlap and the primary lane are
attributes (:class:`sgstore.model.graph.LaneStates`). A body without a driving lane is in ``off_road``,
even if it is in a lane of another type. This holds for moving entities, and for static vehicles,
persons, animals and props. Signals hang over roads and are in nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.graphs.relations._scene import BlockScene, Relation, edges_to_map, joined
from sgstore.maps.roads import OFF_ROAD
from sgstore.model.graph import Edges
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.graphs.relations._scene import MapContext
    from sgstore.model.world import Ints


def _is_in(scene: BlockScene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("lanes need a map")
    standing = ground.standing
    at, parts = standing.parts
    rows = np.concatenate([standing.hits.row, at, standing.off_road])
    nowhere = np.full(len(standing.off_road), OFF_ROAD)
    return edges_to_map(scene, "isIn", rows, np.concatenate([standing.hits.lane, parts, nowhere]))


IS_IN = Relation(
    name="isIn",
    doc="an entity in a lane (with `overlap`, `lane_offset`, `heading_error`, `is_primary`, `along`), on a"
    " crosswalk, or `off_road`; a lane in its road, a road in its junction or roundabout",
    edges=_is_in,
    needs_map=True,
    of_map=True,
)


# Lanes that signals apply to, and lanes upstream of them, if these lanes are in range. A signal of
# the trace ``controlsTrafficOf`` the lanes of its signal in the map; for signals of the map the
# relation comes from the map. A signal ``mayAffect`` these lanes and all lanes that lead to it, up
# to the distance in the settings.


def _signal_edges(scene: BlockScene) -> Edges:
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


def _of_trace(
    scene: BlockScene, ground: MapContext, relation: str, table: tuple[Ints, Ints]
) -> Edges:
    bodies, (signals, lanes) = scene.bodies, table
    rows, index = joined(signals, bodies.node)
    lanes = lanes[index]
    present = ground.present[bodies.frame[rows], -1 - lanes]
    return edges_to_map(scene, relation, rows[present], lanes[present])


def _of_map(ground: MapContext) -> Edges:
    signals, lanes = ground.map_affects
    frame, row = np.nonzero(ground.present[:, -1 - signals] & ground.present[:, -1 - lanes])
    code = np.full(len(frame), RELATION_CODE["mayAffect"], np.int8)
    return Edges(frame, code, signals[row], lanes[row])


CONTROLS_TRAFFIC_OF = Relation(
    name="controlsTrafficOf",
    doc="signal → lane: a traffic light, or a sign of the map, for the lanes that it applies to",
    edges=_signal_edges,
    needs_map=True,
    needs_lanes=True,
)
MAY_AFFECT = Relation(
    name="mayAffect",
    doc="signal → lane: for these lanes, and those from which it lies ahead along the lanes",
    edges=_signal_edges,
    needs_map=True,
    needs_lanes=True,
    settings=lambda config: config.lanes.ahead > 0,
    legend="a signal that lies ahead on that lane",
)
