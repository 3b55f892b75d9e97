"""Relations between lanes that come from the road map, such as ``travelsTo`` and ``toLeftOf``.

The relations of this file cannot be omitted: :data:`sgstore.model.vocabulary.MAP_ONLY`.
"""

from __future__ import annotations

from sgstore.graphs.relations._scene import Relation


def _of_lanes(name: str, doc: str, *, symmetric: bool = False) -> Relation:
    return Relation(
        name=name, doc=doc, symmetric=symmetric, needs_map=True, needs_lanes=True, of_map=True
    )


TRAVELS_TO = _of_lanes("travelsTo", "lane → lane: traffic flows on, through junctions too")
LANE_CHANGE = _of_lanes(
    "laneChange", "lane → lane: a neighbour that runs the same way, if markings permit the change"
)
OPPOSES = _of_lanes("opposes", "lane ↔ lane: neighbours that run opposite ways", symmetric=True)
CONFLICTS_WITH = _of_lanes(
    "conflictsWith", "lane ↔ lane: two lanes of a junction that cross or merge", symmetric=True
)
