"""Distance of related bodies from one another: one relation of a ladder of distances, or none.

The distance is between the centres of the boxes, in space. Rungs are half-open, ``(lo, hi]``, as in CARLASGG's
code (its documentation leaves the bounds open), and the nearest holds its lower bound too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations._pairs import are_of_kinds
from sgstore.relations._scene import BlockScene, Relation, edges_between
from sgstore.vocabulary import PROXIMITY, RELATION_CODE

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges


def _edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.proximity, scene.pairs
    # What is beyond the last rung, or has no distance (NaN sorts last), falls behind all of them.
    rung = np.searchsorted(np.array(settings.upper), pairs.distance)
    holds = rung < len(settings.upper)
    if settings.kinds:
        holds &= are_of_kinds(scene.bodies, scene.ego, (pairs.a, pairs.b), settings.kinds)
    on = np.flatnonzero(holds)
    codes = np.array([RELATION_CODE[name] for name in settings.names], np.int8)
    return edges_between(scene, codes[rung[on]], pairs.a[on], pairs.b[on])


def rung(name: str) -> Relation:
    """The relation of a rung, by its name."""

    def asked(config: Config) -> bool:
        return name in config.proximity.names

    doc = "entity ↔ entity: the distance of the two lies in this rung of `[proximity]`"
    return Relation(name=name, doc=doc, edges=_edges, symmetric=True, of_pairs=True, settings=asked)


SAFETY_HAZARD, NEAR_COLL, SUPER_NEAR, VERY_NEAR, NEAR, VISIBLE = map(rung, PROXIMITY)
