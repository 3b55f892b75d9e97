"""Proximity relations of object pairs, such as ``near``. Each has a distance range; at most one holds.

The distance is between the centres of the boxes, in space; in the plane if a height is unknown.
There is no relation between storeys, to a flat body, or between a carried body and its carrier.
Rungs are half-open, ``(lo, hi]``, as in the code of CARLASGG (its documentation leaves the bounds
open). The nearest rung includes its lower bound.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.graphs.relations._pairs import are_of_kinds
from sgstore.graphs.relations._scene import (
    BlockScene,
    Relation,
    edges_of_pairs,
    even_parts,
    span_up_to,
)
from sgstore.model.vocabulary import PROXIMITY, RELATION_CODE

if TYPE_CHECKING:
    from sgstore.model.config import Config
    from sgstore.model.graph import Edges


def _edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.proximity, scene.pairs
    bounds = [span_up_to(upper, settings.between) for upper in settings.upper]
    codes = np.array(
        [RELATION_CODE[name] for name in (*settings.names, *settings.names[:1])], np.int8
    )
    if bounds and pairs.in_loops and not settings.kinds:
        from sgstore.graphs.relations import _loops

        columns = scene.room.rest(len(pairs))
        many = _loops.rungs(pairs.for_loops, pairs.of_bodies, np.array(bounds), codes, columns)
        return scene.room.filled(columns, many)
    found, holds = np.zeros(len(pairs.span), np.int8), np.zeros(len(pairs.span), np.bool_)
    for part in even_parts(len(found) if bounds else 0):
        span, rung = pairs.span[part], np.zeros(part.stop - part.start, np.int8)
        for bound in bounds:
            rung += span > bound
        found[part] = codes[rung]
        holds[part] = span <= bounds[-1]  # a missing distance is in no rung
    if bounds and len(pairs.of_bodies):
        holds &= pairs.of_bodies
    found, holds = np.concatenate([found, found]), np.concatenate([holds, holds])
    if settings.kinds:
        holds &= are_of_kinds(scene.bodies, scene.ego, (pairs.a, pairs.b), settings.kinds)
    return scene.room.filled(*edges_of_pairs(scene, found, holds))


def rung(name: str) -> Relation:
    """Return the proximity relation with the given name, such as ``near``."""

    def asked(config: Config) -> bool:
        return name in config.proximity.names

    doc = "entity ↔ entity: the distance of the two lies in this rung of `[proximity]`"
    return Relation(name=name, doc=doc, edges=_edges, symmetric=True, of_pairs=True, settings=asked)


SAFETY_HAZARD, NEAR_COLL, SUPER_NEAR, VERY_NEAR, NEAR, VISIBLE = map(rung, PROXIMITY)
