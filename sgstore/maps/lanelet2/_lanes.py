"""Conversion of a Lanelet2 map (lanelets, rules, signs, stop lines) to the lane text format of sgstore."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.display import first_of
from sgstore.errors import MapError
from sgstore.maps.lanelet2._document import LISTED, OsmDocument, read_osm
from sgstore.maps.lanelet2._lanelets import (
    CROSSWALK,
    line_of,
    mean_z,
    read_lanelets,
    roundabout_names,
    type_of,
    with_joints,
    with_neighbours,
)
from sgstore.maps.lanelet2._projection import Projection
from sgstore.maps.lanelet2._signals import Rules, plain_signals
from sgstore.maps.roads import (
    MAX_NAME,
    LaneLine,
    PlainCrosswalk,
    PlainObject,
    lane_text,
    plain_lanes,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Floats


def lanelet2_text(text: str, projection: Projection | None = None) -> str:
    """Convert the text of a Lanelet2 map to the lane text format of sgstore.

    Parameters
    ----------
    text : str
        Text of an ``.osm`` file. It is untrusted: its length bounds time and memory.
    projection : Projection, optional
        Projection from latitude and longitude to metres, if some points lack ``local_x`` and
        ``local_y``. The default is UTM.

    Raises
    ------
    MapError
        The text is not XML or not a Lanelet2 map, exceeds a limit, or has no usable lanelet.
    """
    document = read_osm(text, projection or Projection())
    lanelets = read_lanelets(document)
    if not lanelets:
        reason = "; ".join(document.warnings[:2]) or "it has none: expected a Lanelet2 map"
        raise MapError(f"OpenStreetMap data without usable lanelets: {reason}")
    rules = Rules.of(document, lanelets)
    around = roundabout_names(document)
    lines = [
        replace(
            line_of(
                document, ident, lanelet, type_of(lanelet.element), rules.limits.get(ident, np.nan)
            ),
            roundabout=around.get(ident, ""),
        )
        for ident, lanelet in lanelets.items()
        if type_of(lanelet.element) != CROSSWALK
    ]
    lines = with_joints(document, with_neighbours(document, lines, lanelets), lanelets)
    lanes, warnings = plain_lanes(LaneLine.with_junctions(lines))
    row_of = {lane.name: row for row, lane in enumerate(lanes)}
    signals = plain_signals(document, rules, lanes, row_of)
    crosswalks = [
        PlainCrosswalk(ident, np.concatenate((one.right, one.left[::-1]))[:, :2], mean_z(one))
        for ident, one in lanelets.items()
        if type_of(one.element) == CROSSWALK
    ]
    objects = _areas(document)
    return lane_text(lanes, [*document.warnings, *warnings], signals, crosswalks, objects)


_AREAS: Final = {"building": "building", "vegetation": "vegetation", "traffic_island": "prop"}
"""Subtype of an area without traffic → kind of object."""


def _areas(document: OsmDocument) -> list[PlainObject]:
    """Return outlines of areas such as buildings in a Lanelet2 map. Other areas cause a warning."""
    found: list[PlainObject] = []
    left: Counter[str] = Counter()
    broken: list[str] = []
    for ident, element in document.relations.items():
        if element.tags.get("type") != "multipolygon":
            continue
        subtype = element.tags.get("subtype", "")
        if subtype not in _AREAS:
            left[subtype[:40] or "without a subtype"] += 1
            continue
        ring = _ring(document, element.members_of("outer"))
        if len(ident) > MAX_NAME or len(np.unique(ring[:, :2], axis=0)) < 3:
            broken.append(ident)
        else:
            z = float(ring[:, 2].mean())
            found.append(PlainObject(ident, ring[:, :2], z, _AREAS[subtype]))
    if left:
        told = ", ".join(f"{many} {what}" for what, many in sorted(left.items()))
        document.warnings.append(f"areas left out: {told}")
    if broken:
        what = "expected an outer border that closes; left out"
        document.warnings.append(f"areas {first_of(broken, LISTED)}: {what}")
    return found


def _ring(document: OsmDocument, ways: Sequence[str]) -> Floats:
    """Join consecutive ways to the outline (n, 3) of an area; empty if the outline is open."""
    pieces = [way for way in ways if way in document.lines]
    if not pieces or len(pieces) < len(ways):
        return np.zeros((0, 3))
    first = pieces.pop(0)
    nodes, line = [*document.nodes[first]], [*document.lines[first]]
    while pieces:
        ends = {way: (document.nodes[way][0], document.nodes[way][-1]) for way in pieces}
        found = next((way for way in pieces if nodes[-1] in ends[way]), "")
        if not found:
            return np.zeros((0, 3))
        pieces.remove(found)
        back = document.nodes[found][0] != nodes[-1]
        more, points = document.nodes[found], document.lines[found]
        nodes += (more[::-1] if back else more)[1:]
        line += [*(points[::-1] if back else points)[1:]]
    return np.array(line[:-1]) if nodes[0] == nodes[-1] else np.zeros((0, 3))
