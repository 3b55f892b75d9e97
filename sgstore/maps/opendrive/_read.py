"""Reader of road map texts: OpenDRIVE, or the lane text format of sgstore.

See :mod:`sgstore.maps.opendrive` for the steps and the treatment of defects.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.base.tables import chained
from sgstore.errors import MapError
from sgstore.maps.opendrive._contradictions import contradictions
from sgstore.maps.opendrive._document import Document, Record, Spoiled, read_document
from sgstore.maps.opendrive._flows import flows
from sgstore.maps.opendrive._lane_changes import (
    read_broad_lines,
    read_lane_changes,
    read_markings,
)
from sgstore.maps.opendrive._lanes import heights, read_lanes, surface
from sgstore.maps.opendrive._network import Network
from sgstore.maps.opendrive._nodes import (
    FIRST_LANE,
    containment,
    flow_edges,
    junction_types,
    lane_nodes,
    neighbours,
    road_nodes,
    road_types,
)
from sgstore.maps.opendrive._objects import read_objects
from sgstore.maps.opendrive._plan_view import read_plan_view
from sgstore.maps.opendrive._signals import read_controllers, read_signals
from sgstore.maps.roads import (
    LaneCourses,
    MapNodes,
    RoadMap,
    edges_of,
    is_lane_text,
    plain_nodes,
    read_lane_text,
    ribbons_of,
)
from sgstore.model.config import Signs

if TYPE_CHECKING:
    from collections.abc import Container, Mapping

    from numpy.typing import NDArray


SIGNS: Final = Signs()
"""Default settings for reading traffic signals."""
_ROUNDS: Final = 8
"""Largest number of attempts to read a text. Each one leaves out the defective roads of the previous one."""

_KEPT: Final = 4
"""Number of cached maps. A map with 30 MB of text and 6,000 lanes takes 95 MB, a town a tenth of this."""


@lru_cache(maxsize=_KEPT)
def read_map(text: str, name: str, signs: Signs = SIGNS) -> RoadMap:
    """Return the road map of an OpenDRIVE or lane text. Recent maps are cached.

    Parameters
    ----------
    text : str
        The text of an ``.xodr`` file, or plain lanes (:mod:`sgstore.maps.roads._lane_text`). It is
        untrusted: its length bounds time and memory.
    name : str
        Display name; empty means the name in its header, or the first digits of its digest.
    signs : Signs
        Interpretation of signals: configured kinds, and the meaning of orientations. If this
        changes the map, the map has another digest.

    Returns
    -------
    RoadMap
        Roads with a defect are left out; ``warnings`` names each with the reason.

    Raises
    ------
    MapError
        The text is not XML or OpenDRIVE, exceeds a limit, or has no usable road.
    """
    return parse_map(text, name, signs)


def parse_map(text: str, name: str, signs: Signs = SIGNS) -> RoadMap:
    """Parse an OpenDRIVE or lane text into a road map, without the cache."""
    if is_lane_text(text):
        return read_lane_text(text, name or _short_digest(text))
    skip: dict[int, MapError] = {}
    odd: dict[Record, MapError] = {}
    for _ in range(_ROUNDS):
        document = read_document(text, frozenset(skip))
        if not len(document["road"]):
            break
        document.leave_out(odd)
        try:
            road_map = _build(document, text, name, signs)
            left_out = [*map(str, skip.values()), *_without(odd, skip)]
            road_map.warnings = (*left_out, *road_map.warnings)
            return road_map
        except Spoiled as spoiled:
            found = {document.ordinals[row]: error for row, error in spoiled.roads.items()}
            skip |= found
            odd |= spoiled.records
    if skip:
        first = next(iter(skip.values()))
        more = f" (and {len(skip) - 1} more such roads)" if len(skip) > 1 else ""
        raise MapError(f"{first.reason}{more}", road=first.road, element=first.element) from first
    raise MapError("has no road", element="OpenDRIVE")


def _without(odd: Mapping[Record, MapError], skip: Container[int]) -> list[str]:
    """Return warnings about records that are left out (such as lane widths), one per road and kind."""
    groups: dict[tuple[str, int], list[MapError]] = {}
    for (kind, road, _), error in odd.items():
        if road not in skip:
            groups.setdefault((kind, road), []).append(error)
    return [
        f"{errors[0]}: "
        + ("it is left out" if len(errors) == 1 else f"it and {len(errors) - 1} more are left out")
        for errors in groups.values()
    ]


def _build(document: Document, text: str, name: str, signs: Signs) -> RoadMap:
    plan = read_plan_view(document)
    lanes = read_lanes(document)
    document.settle()
    ribbons = surface(document, lanes, plan)
    network = Network.of(document, lanes)
    surfaces = lane_nodes(document, lanes, ribbons)
    signals = read_signals(document, plan, network, signs)
    crosswalks, scenery, parking, parking_road = read_objects(document, plan, network.warnings)
    spaces = ribbons_of(parking)
    before = [
        MapNodes.of("off_road", ["off_road"]),
        surfaces,
        plain_nodes(parking, spaces),
        *road_nodes(document),
        crosswalks.nodes,
    ]
    nodes = chained([*before, signals.nodes, scenery.nodes])
    first_signal = sum(map(len, before))
    lane_changes = read_lane_changes(document, lanes, ribbons)
    edges = [
        *neighbours(lanes, ribbons),
        *flow_edges(lanes, surfaces, ribbons, flows(document, network, ribbons)),
        *containment(document, np.append(lanes.road, parking_road)),
        ("laneChange", FIRST_LANE + lane_changes.lane, FIRST_LANE + lane_changes.to),
        signals.edges(first_signal),
    ]
    poles: Any = shapely.points(signals.nodes.x, signals.nodes.y)
    document.settle()
    signal, lane, s = signals.places(first_signal)
    header_name = next(iter(document["header"].texts("name")), "").strip()
    every = ribbons.followed_by(spaces)
    markings, marking_parts = read_markings(document, lanes)
    return RoadMap(
        name=name or header_name or _short_digest(text),
        text=text,
        nodes=nodes,
        edges=edges_of(edges),
        ribbons=every,
        shapes=_at_the_end([*crosswalks.shapes, *poles, *scenery.shapes], len(nodes)),
        lane_changes=lane_changes,
        road_types=road_types(document),
        junction_types=junction_types(document),
        controllers=read_controllers(document),
        warnings=[*contradictions(document, lanes, plan), *network.warnings],
        stops=(signal, lane, ribbons.along_at(lane, s)),
        stop_lines=signals.stop_lines(first_signal),
        courses=LaneCourses.of(every, heights(document, lanes, every)),
        broad_lines=read_broad_lines(document, lanes, ribbons),
        own=markings | dict(enumerate(signals.about, first_signal)),
        marking_parts=marking_parts,
        variant=signals.told,
    )


def _at_the_end(shapes: list[Any], number: int) -> NDArray[Any]:
    """Return an array of one shape per map node: ``None``, and for the last nodes the given shapes."""
    found = np.full(number, None, object)
    found[number - len(shapes) :] = shapes
    return found


def _short_digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:12]
