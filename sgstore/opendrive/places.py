"""Places along roads: (road, s, t) → position, for signals and objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.opendrive.grouped import coefficients_of, cubic, last_before
from sgstore.opendrive.nodes import junction_of
from sgstore.opendrive.planview import PlanView, poses

if TYPE_CHECKING:
    from sgstore.opendrive.document import Document
    from sgstore.world import Floats, Ints


@dataclass(frozen=True, slots=True)
class Places:
    """Positions, shape (N,): map axes, and the heading of the road there."""

    x: Floats
    y: Floats
    z: Floats
    heading: Floats


def places(document: Document, plan: PlanView, road: Ints, s: Floats, t: Floats) -> Places:
    """Where ``s`` along roads and ``t`` to their left is; before or beyond a road, its end is taken."""
    length = document.numbers("road", "length")[road]
    s = np.clip(s, 0.0, length)
    pose = poses(plan, last_before(plan.road, plan.s, road, s), s)
    at = document.numbers("road/elevation", "s")
    record = last_before(document["road/elevation"].road, at, road, s)
    level = np.zeros((len(at) + 1, 4))
    level[:-1] = coefficients_of(document, "road/elevation")
    into = np.maximum(s - np.append(at, 0.0)[record], 0.0)
    return Places(
        pose.x - t * np.sin(pose.heading),
        pose.y + t * np.cos(pose.heading),
        cubic(level[record], into),
        pose.heading,
    )


def standing(document: Document, kind: str, rows: Ints, warnings: list[str]) -> Ints:
    """Those ``rows`` of signals or objects whose place is known; a warning for each of the others."""
    table = document[kind]
    placed = np.ones(len(table), bool)
    for name in ("s", "t", "zOffset", "hdg", "hOffset"):
        placed &= np.isfinite(document.rough_numbers(kind, name))
    warnings.extend(
        f"road {document.road_ids[table.road[row]]!r}, <{table.element}>"
        f" {table.attributes[row].get('id', '')!r}: its place is no number, left out"
        for row in rows[~placed[rows]].tolist()
    )
    return rows[placed[rows]]


def node_columns(
    document: Document,
    plan: PlanView,
    kind: str,
    rows: Ints,
    at: tuple[Floats, Floats, Floats] | None = None,
) -> dict[str, Any]:
    """Columns of :class:`~sgstore.roads.MapNodes` that say where signals or objects stand.

    ``at`` is s, t and the height above the road, else the element's own. The heading is the road's plus the
    element's own, as the file has it.
    """
    table = document[kind]
    own = {
        name: document.rough_numbers(kind, name)[rows]
        for name in ("s", "t", "zOffset", "hdg", "hOffset")
    }
    s, t, up = at or (own["s"], own["t"], own["zOffset"])
    road = table.road[rows]
    where = places(document, plan, road, s, t)
    heading = where.heading + own["hdg"] + own["hOffset"]
    return {
        "x": where.x,
        "y": where.y,
        "z": where.z + up,
        "heading": np.pi - (np.pi - heading) % (2 * np.pi),
        "road": tuple(document.road_ids[r] for r in road.tolist()),
        "junction": tuple(junction_of(document, r) for r in road.tolist()),
    }
