"""Positions of signals and objects: from road coordinates s and t to map coordinates x, y and z."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.maps.opendrive._document import coefficients_of
from sgstore.maps.opendrive._nodes import junction_of
from sgstore.maps.opendrive._piecewise import cubic, last_before
from sgstore.maps.opendrive._plan_view import PlanView, poses

if TYPE_CHECKING:
    from sgstore.maps.opendrive._document import Document
    from sgstore.model.world import Floats, Ints


_PLACE: Final = ("s", "t", "zOffset", "hdg", "hOffset")


def places(
    document: Document, plan: PlanView, road: Ints, s: Floats, t: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Convert road coordinates ``s`` and ``t`` to map positions and headings. Limit ``s`` to the road.

    Returns x, y and z in map axes, and the heading of the road there.
    """
    length = document.numbers("road", "length")[road]
    s = np.clip(s, 0.0, length)
    pose = poses(plan, last_before(plan.road, plan.s, road, s), s)
    at = document.numbers("road/elevation", "s")
    record = last_before(document["road/elevation"].road, at, road, s)
    level = np.zeros((len(at) + 1, 4))
    level[:-1] = coefficients_of(document, "road/elevation")
    into = np.maximum(s - np.append(at, 0.0)[record], 0.0)
    return (
        pose.x - t * np.sin(pose.heading),
        pose.y + t * np.cos(pose.heading),
        cubic(level[record], into),
        pose.heading,
    )


def standing(document: Document, kind: str, rows: Ints, warnings: list[str]) -> Ints:
    """Return the rows of signals or objects with a valid position. Add a warning for each other row."""
    table = document[kind]
    placed = np.ones(len(table), bool)
    for name in _PLACE:
        placed &= np.isfinite(document.rough_numbers(kind, name))
    warnings.extend(
        f"road {document.road_ids[table.road[row]]!r}, <{table.element}>"
        f" {table.attributes[row].get('id', '')!r}: left out, because its position is not a number"
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
    """Return the columns of map nodes (position, heading, size) for signals or objects.

    ``at`` is s, t and the height above the road, else the element's own. The heading is the sum of
    the road's and the element's heading.
    """
    table = document[kind]
    own = {name: document.rough_numbers(kind, name)[rows] for name in _PLACE}
    s, t, up = at or (own["s"], own["t"], own["zOffset"])
    road = table.road[rows]
    x, y, z, heading = places(document, plan, road, s, t)
    heading = heading + own["hdg"] + own["hOffset"]
    return {
        "x": x,
        "y": y,
        "z": z + up,
        "heading": np.pi - (np.pi - heading) % (2 * np.pi),
        "road": tuple(document.road_ids[r] for r in road.tolist()),
        "junction": tuple(junction_of(document, r) for r in road.tolist()),
    }
