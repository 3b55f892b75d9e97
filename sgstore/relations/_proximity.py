"""How near related bodies are to one another: one relation of a ladder of distances, or none.

The distance is between the centres of the boxes, in space. Rungs are half-open, ``(lo, hi]``, as in CARLASGG's
code (its documentation leaves the bounds open), and the nearest holds its lower bound too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations._pairs import if_related
from sgstore.relations._scene import BlockScene, RelationFamily, edges_between
from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges


def _names(config: Config) -> tuple[str, ...]:
    return if_related(config, config.proximity.names)


def _edges(scene: BlockScene) -> Edges:
    settings, pairs = scene.config.proximity, scene.pairs
    # What is beyond the last rung, or has no distance (NaN sorts last), falls behind all of them.
    rung = np.searchsorted(np.array(settings.upper), pairs.distance)
    on = np.flatnonzero(rung < len(settings.upper))
    codes = np.array([RELATION_CODE[name] for name in settings.names], np.int8)
    return edges_between(scene, codes[rung[on]], pairs.a[on], pairs.b[on])


PROXIMITY = RelationFamily(_names, needs_map=False, edges=_edges)
